"""One data center as a PettingZoo environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

from sdc_taichi.envs.base import (
    METADATA,
    AgentSpaces,
    SingleEnv,
    agent_part,
    as_scalars,
    first_of_batch,
    start_day_option,
)
from sdc_taichi.envs.core import Observation
from sdc_taichi.envs.options import ConfigSource
from sdc_taichi.errors import SdcError


class SdcParallelEnv(SingleEnv, AgentSpaces, ParallelEnv[str, Observation, Any]):  # type: ignore[misc]
    """PettingZoo environment in which the agents of a data center or fleet act at the same time.

    Agents of a fleet that shares work have the names of their sites, such as ``NY/agent_geo``. The
    group ``crac`` has an agent for each CRAC unit: ``crac_0``, ``crac_1`` and so on. An agent
    stays in the environment while its unit is down; its info ``acts`` is then 0, and its action has
    no effect.

    Episodes end by truncation, because their length is a choice and a data center has no final
    state; only a result beyond the physical limits terminates an episode. All agents have the same
    infos, except ``acts`` and ``zone_heat_k_h``: ``ended_by``, ``start_day``, the randomly drawn
    inputs, the facility's quantities of ``StepResult`` by name, and the costs of the option
    ``costs``. Those of ``reset`` have the same keys; ``ended_by``, quantities and costs are 0
    there.

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
        self._groups = self.core.members
        self.possible_agents: list[str] = [a for names in self._groups.values() for a in names]
        self.agents: list[str] = []
        self.observation_spaces, self.action_spaces = (
            {agent: spaces[group] for group, names in self._groups.items() for agent in names}
            for spaces in (self.core.observation_spaces, self.core.action_spaces)
        )

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
        return self._by_agent(observations), self._infos(self.core.infos())

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
        transition = self.core.step(self._by_group(actions))
        agents, infos = self.agents, self._infos(self.core.infos(transition))
        if transition.ended:
            self.agents = []
        return (
            self._by_agent(transition.observations),
            {agent: float(x) for agent, x in self._by_agent(transition.rewards).items()},
            dict.fromkeys(agents, bool(transition.terminated[0])),
            dict.fromkeys(agents, bool(transition.truncated[0])),
            infos,
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
        return self._by_agent(observations)

    def _by_agent(self, by_group: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of the only environment of the batch by agent."""
        values: dict[str, Any] = {}
        for group, names in self._groups.items():
            first = first_of_batch(by_group[group])
            if names == (group,):
                values[group] = first
            else:
                values |= {agent: agent_part(first, i) for i, agent in enumerate(names)}
        return values

    def _by_group(self, actions: Any) -> Any:
        """Return the actions of agents by group, with one environment; wrong ones as they are."""
        if not isinstance(actions, Mapping):
            return actions
        left = dict(actions)
        by_group: dict[str, Any] = {}
        for group, names in self._groups.items():
            if names == (group,):
                if group in left:
                    by_group[group] = [left.pop(group)]
                continue
            for agent in names:
                if agent not in left:
                    raise SdcError(f"actions: none for {agent}; valid: {self.possible_agents}")
            by_group[group] = [[left.pop(agent) for agent in names]]
        return by_group | {agent: [action] for agent, action in left.items()}

    def _infos(self, infos: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the infos of each agent.

        Agents of units and of transfers have ``acts`` in addition, those of CRAC units also
        ``zone_heat_k_h``.
        """
        masks, heat_k_h = self.core.masks(), self.core.zone_heat_k_h()
        differ = any(values.ndim > 1 for values in infos.values())
        shared = {} if differ else as_scalars(infos)
        by_agent: dict[str, dict[str, Any]] = {}
        for group, names in self._groups.items():
            acts = masks[group][0].astype(np.int64).tolist() if group in masks else None
            of_zones = heat_k_h[group][0].tolist() if group in heat_k_h else None
            for i, agent in enumerate(names):
                by_agent[agent] = of_agent = as_scalars(infos, i) if differ else shared.copy()
                if acts is not None:
                    of_agent["acts"] = acts[i]
                if of_zones is not None:
                    of_agent["zone_heat_k_h"] = of_zones[i]
        return by_agent


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
