"""One data center as a PettingZoo environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

from sdc_taichi.envs.base import (
    METADATA,
    AgentSpaces,
    SingleEnv,
    as_scalars,
    first_of_batch,
    start_day_option,
)
from sdc_taichi.envs.core import Observation
from sdc_taichi.envs.options import ConfigSource


class SdcParallelEnv(SingleEnv, AgentSpaces, ParallelEnv[str, Observation, Any]):  # type: ignore[misc]
    """PettingZoo environment in which the learning agents of one data center act at the same time.

    Episodes end by truncation, because their length is a choice and a data center has no final
    state; only a result beyond the physical limits terminates an episode. All agents have the same
    infos: ``ended_by``, ``start_day``, the randomly drawn inputs, the facility's quantities of
    ``StepResult`` by name, and the costs of the option ``costs``. Those of ``reset`` have the same
    keys; ``ended_by``, quantities and costs are 0 there.

    Args:
        config: a preset, a file or a config.
        arguments: ``overrides``, ``options``, ``precision``, ``render_mode``, ``recorder`` and
            fields of ``EnvOptions``; see docs/environments.md.

    Raises:
        SdcError: a config or option is not valid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as the base class has it
        "name": "sdc_taichi_v0",
        **METADATA,
        "is_parallelizable": True,
    }

    def __init__(self, config: ConfigSource = "corrected", **arguments: Any) -> None:
        self._open(config, 1, **arguments)
        self.possible_agents: list[str] = list(self.core.agents)
        self.agents: list[str] = []
        self.observation_spaces = self.core.observation_spaces
        self.action_spaces = self.core.action_spaces

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode.

        Args:
            seed: seed of the random generator; None continues the current generator.
            options: dict with ``start_day``, a day as ``MM-DD`` or as number of the day in the
                year, from 0.

        Raises:
            ConfigError: the seed or the day is not valid.
        """
        observations = self.core.reset(seed, start_day_option(options, strict=False))
        self.agents = list(self.possible_agents)
        info = as_scalars(self.core.infos())
        return _first_of_each(observations), {agent: dict(info) for agent in self.agents}

    def step(
        self, actions: Mapping[str, Any]
    ) -> tuple[
        dict[str, Observation],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Advance the data center by one step.

        Args:
            actions: one action per learning agent, by agent.

        Raises:
            SdcError: the action of an agent is missing or outside its space, or there is an action
                of an agent that does not learn.
            RuntimeStateError: the environment has not been reset, or the episode is over.
        """
        if isinstance(actions, Mapping):
            actions = {agent: [action] for agent, action in actions.items()}
        transition = self.core.step(actions)
        agents, info = self.agents, as_scalars(self.core.infos(transition))
        if transition.ended:
            self.agents = []
        return (
            _first_of_each(transition.observations),
            as_scalars(transition.rewards),
            dict.fromkeys(agents, bool(transition.terminated[0])),
            dict.fromkeys(agents, bool(transition.truncated[0])),
            {agent: dict(info) for agent in agents},
        )

    def load_state_dict(self, values: Mapping[str, Any]) -> dict[str, Observation]:
        """Continue from the ``state_dict`` of an environment with the same arguments.

        Returns:
            Observations before the next step.

        Raises:
            SdcError: the state belongs to another environment, or is incomplete.
        """
        observations = self.core.load_state_dict(values)
        self.agents = [] if self.core.episode_over else list(self.possible_agents)
        return _first_of_each(observations)


parallel_env = SdcParallelEnv


def aec_env(config: ConfigSource = "corrected", **arguments: Any) -> AECEnv[str, Observation, Any]:
    """Create a PettingZoo environment whose agents act in turn, with PettingZoo's own conversion.

    Args:
        config: a preset, a file or a config.
        arguments: arguments of ``parallel_env``.

    Raises:
        SdcError: a config or option is not valid.
    """
    return parallel_to_aec(parallel_env(config, **arguments))


def _first_of_each(observations: Mapping[str, Observation]) -> dict[str, Observation]:
    """Return the observations of the only environment of a batch by agent, (n,) each."""
    return {agent: first_of_batch(values) for agent, values in observations.items()}
