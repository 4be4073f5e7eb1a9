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
    as_floats,
    first_info,
    first_of_batch,
    start_day_option,
    step_info,
)
from sdc_taichi.envs.core import Observation
from sdc_taichi.envs.options import ConfigSource


class SdcParallelEnv(SingleEnv, AgentSpaces, ParallelEnv[str, Observation, Any]):  # type: ignore[misc]
    """A PettingZoo environment: the learning agents of one data center act at the same time.

    Episodes end by truncation, as their length is a choice and the data center runs on. All agents
    have the same infos: after ``reset`` ``start_day`` and drawn inputs, after a step every (B,)
    quantity of ``StepResult`` by name and the costs of the option ``costs``.

    Args:
        config: a preset, a file or a config.
        arguments: ``overrides``, ``options``, ``precision``, ``render_mode``, ``recorder`` and
            fields of ``EnvOptions``, as docs/environments.md lists them.

    Raises:
        SdcError: a config or option that is not valid.
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
            seed: seed of all randomness from here on; None continues the present generator.
            options: ``start_day``, a day of the year as ``MM-DD`` or counted from 0.

        Raises:
            ConfigError: a seed or day that is not valid.
        """
        observations = self.core.reset(seed, start_day_option(options, strict=False))
        self.agents = list(self.possible_agents)
        info = first_info(self.core)
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
        """Advance by one step.

        Args:
            actions: one per learning agent.

        Raises:
            SdcError: actions that are missing, too many, or outside their space.
            RuntimeStateError: before ``reset``, or after the end of the episode.
        """
        if isinstance(actions, Mapping):
            actions = {agent: [action] for agent, action in actions.items()}
        transition = self.core.step(actions)
        agents, info = self.agents, as_floats(step_info(transition))
        if transition.ended:
            self.agents = []
        return (
            _first_of_each(transition.observations),
            as_floats(transition.rewards),
            dict.fromkeys(agents, False),
            dict.fromkeys(agents, transition.ended),
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
    """A PettingZoo environment whose agents act in turn, by PettingZoo's own conversion.

    Args:
        config: a preset, a file or a config.
        arguments: the same as those of ``parallel_env``.

    Raises:
        SdcError: a config or option that is not valid.
    """
    return parallel_to_aec(parallel_env(config, **arguments))


def _first_of_each(observations: Mapping[str, Observation]) -> dict[str, Observation]:
    """Observations of a batch of one by agent, (n,) each."""
    return {agent: first_of_batch(values) for agent, values in observations.items()}
