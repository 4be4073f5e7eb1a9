"""Environments whose agents control the air or the liquid cooling of a hall."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np

from sdc_taichi.config import DataCenterConfig, load_config
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, HALL_AGENTS
from sdc_taichi.envs.options import ConfigSource, fields_set
from sdc_taichi.envs.parallel import SdcParallelEnv
from sdc_taichi.envs.vector import MultiAgentVectorEnv
from sdc_taichi.sim.hall_family import hall_family

HALL_OPTIONS: dict[str, Any] = {"agents": HALL_AGENTS, "actions": "continuous", "days": 1}
"""Options of environments of a hall that differ from those of data centers."""
LIQUID_OPTIONS: dict[str, Any] = HALL_OPTIONS | {
    "agents": ("plant", "cdu", "power_cap"),
    "commands": {"plant": ("facility_approach_k", "reuse_share")},
}
"""Options of environments of a hall with liquid-cooled racks."""
LARGEST_CHANGES = {"fan": ("fan_change", 0.1), "cooling": ("setpoint_change_k", 0.5)}
"""Option and its value that sets the largest change in a step of 5 minutes, by command."""


@dataclass(frozen=True)
class HallFamily:
    """Draws halls that differ in size, units, density, containment and plenum.

    It is a valid ``config`` of environments, which then have another hall in each episode.
    """

    base: str | DataCenterConfig = "hall_agents_16"
    """Preset, file or config from which the halls have everything that does not differ."""
    units: tuple[int, int] = (4, 24)
    """Fewest and most CRAC units."""
    ranges: Mapping[str, Any] = field(default_factory=dict)
    """Other ranges by the name of the argument of ``sdc_taichi.sim.hall_family.hall_family``."""

    @property
    def most_units(self) -> int:
        """Largest number of CRAC units of a hall."""
        return self.units[1]

    def __call__(self, rng: np.random.Generator) -> DataCenterConfig:
        """Return a hall.

        Args:
            rng: source of the random numbers.

        Raises:
            ConfigError: a range is not valid.
        """
        base = load_config(self.base) if isinstance(self.base, str) else self.base
        return hall_family(rng, 1, base, units=self.units, **self.ranges)[0]


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
    """Create an environment whose agents control the cooling of a hall.

    They are ``crac`` and ``plant``, and in a hall with liquid-cooled racks ``cdu``, ``plant`` and
    ``power_cap``.

    Args:
        config: a preset, a file or a config of a hall, or a ``HallFamily``; with ``num_envs`` also
            several configs. Agents ``crac`` need controlled fans of the CRAC units
            (``hvac.crac.flow_model``).
        num_envs: number of halls in a batch of arrays; None creates a PettingZoo environment of one
            hall.
        arguments: arguments of ``parallel_env`` or ``vector_env``, which take precedence over
            ``HALL_OPTIONS`` or ``LIQUID_OPTIONS``, and ``LARGEST_CHANGES``.

    Raises:
        SdcError: a config or option is not valid.
    """
    options = arguments.pop("options", None)
    chosen = {} if options is None else fields_set(options)
    named = chosen | arguments
    defaults = LIQUID_OPTIONS if _has_liquid(config) else HALL_OPTIONS
    if "plant" not in named.get("agents", ("plant",)):
        defaults = {name: value for name, value in defaults.items() if name != "commands"}
    arguments = defaults | named
    if arguments["actions"] == "continuous":
        decided = _decided(arguments["agents"], arguments.get("commands") or {})
        for option, value in (LARGEST_CHANGES[x] for x in LARGEST_CHANGES if x in decided):
            arguments.setdefault(option, value)
    if num_envs is None:
        return SdcParallelEnv(config, **arguments)
    return MultiAgentVectorEnv(num_envs, config, **arguments)


def _has_liquid(config: Any) -> bool:
    """Return True if the first of several configs has liquid-cooled racks."""
    one = config
    if isinstance(config, Sequence) and not isinstance(config, str) and config:
        one = config[0]
    if isinstance(one, str | os.PathLike):
        one = load_config(one)
    return (
        one.get("liquid") if isinstance(one, Mapping) else getattr(one, "liquid", None)
    ) is not None


def _decided(agents: Iterable[str], commands: Mapping[str, Iterable[str]]) -> set[str]:
    """Return the commands that agents decide; unknown agents are reported elsewhere."""
    known = [agent for agent in agents if agent in AGENT_DEFINITIONS]
    default = {agent: AGENT_DEFINITIONS[agent].default_commands for agent in known}
    return {name for agent in known for name in commands.get(agent, default[agent])}
