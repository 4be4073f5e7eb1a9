"""Environments with an agent for each CRAC unit of a hall and one for the plant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, overload

from sdc_taichi.envs.agents import AGENT_DEFINITIONS, HALL_AGENTS
from sdc_taichi.envs.options import ConfigSource, fields_set
from sdc_taichi.envs.parallel import SdcParallelEnv
from sdc_taichi.envs.vector import MultiAgentVectorEnv

HALL_OPTIONS: dict[str, Any] = {"agents": HALL_AGENTS, "actions": "continuous", "days": 1}
"""Options of environments of a hall that differ from those of data centers."""
LARGEST_CHANGES = {"fan": ("fan_change", 0.1), "cooling": ("setpoint_change_k", 0.5)}
"""Option and its value that sets the largest change in a step of 5 minutes, by command."""


@overload
def hall_env(
    config: ConfigSource = ..., num_envs: None = None, **arguments: Any
) -> SdcParallelEnv: ...


@overload
def hall_env(config: ConfigSource, num_envs: int, **arguments: Any) -> MultiAgentVectorEnv: ...


@overload
def hall_env(*, num_envs: int, **arguments: Any) -> MultiAgentVectorEnv: ...


def hall_env(
    config: ConfigSource = "hall_agents_6", num_envs: int | None = None, **arguments: Any
) -> SdcParallelEnv | MultiAgentVectorEnv:
    """Create an environment whose agents control the fans and the plant of a hall.

    Args:
        config: a preset, a file or a config of a hall; with ``num_envs`` also several. The fans of
            the CRAC units must be controlled (``hvac.crac.flow_model``).
        num_envs: number of halls in a batch of arrays; None creates a PettingZoo environment of one
            hall.
        arguments: arguments of ``parallel_env`` or ``vector_env``, which take precedence over
            ``HALL_OPTIONS`` and ``LARGEST_CHANGES``.

    Raises:
        SdcError: a config or option is not valid.
    """
    options = arguments.pop("options", None)
    chosen = {} if options is None else fields_set(options)
    arguments = HALL_OPTIONS | chosen | arguments
    if arguments["actions"] == "continuous":
        decided = _decided(arguments["agents"], arguments.get("commands") or {})
        for option, value in (LARGEST_CHANGES[x] for x in LARGEST_CHANGES if x in decided):
            arguments.setdefault(option, value)
    if num_envs is None:
        return SdcParallelEnv(config, **arguments)
    return MultiAgentVectorEnv(num_envs, config, **arguments)


def _decided(agents: Iterable[str], commands: Mapping[str, Iterable[str]]) -> set[str]:
    """Return the commands that agents decide; unknown agents are reported elsewhere."""
    known = [agent for agent in agents if agent in AGENT_DEFINITIONS]
    default = {agent: AGENT_DEFINITIONS[agent].commands[:1] for agent in known}
    return {name for agent in known for name in commands.get(agent, default[agent])}
