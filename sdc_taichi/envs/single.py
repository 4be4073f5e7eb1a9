"""One data center as a Gymnasium environment with one learner: an agent, or all agents as one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sdc_taichi.envs.actions import checked_array
from sdc_taichi.envs.base import (
    METADATA,
    HasSpec,
    SingleEnv,
    as_floats,
    first_info,
    first_of_batch,
    start_day_option,
    step_info,
)
from sdc_taichi.envs.core import Core, Observation, Transition
from sdc_taichi.envs.features import entries_of_new_features
from sdc_taichi.envs.options import ConfigSource
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.types import F32, F64


class AgentLearner:
    """One learning agent with its collaborative reward.

    Args:
        core: data centers in which it alone learns.

    Attributes:
        observation_space: space of the agent's observation in one environment.
        action_space: space of the agent's action in one environment.
        features: features of its observation, in order.
    """

    def __init__(self, core: Core) -> None:
        (self._agent,) = core.agents
        self.observation_space: spaces.Space[Any] = core.observation_spaces[self._agent]
        self.action_space: spaces.Space[Any] = core.action_spaces[self._agent]
        self.features = core.features[self._agent]

    def actions(self, given: Any) -> dict[str, Any]:
        """Actions of the agent, which are those of the learner."""
        return {self._agent: given}

    def joined(self, by_agent: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Actions of the learner, which are those of the agent, (B,) or (B, k)."""
        return by_agent[self._agent].astype(self.action_space.dtype)

    def observation(self, by_agent: Mapping[str, Observation]) -> Observation:
        """The agent's observation, (B, n)."""
        return by_agent[self._agent]

    def reward(self, transition: Transition) -> F64:
        """The agent's reward, (B,)."""
        return np.array(transition.rewards[self._agent])


class JointLearner:
    """All learning agents as one learner.

    Its observation is the concatenation of their observations with each feature once. The shared
    state would include features that the option ``features`` leaves out. Its reward is
    ``Transition.joint_reward``; if all three agents learn, the weights of ``collaboration`` cancel
    in sums over the agents.

    Args:
        core: data centers in which the agents learn.

    Attributes:
        observation_space: space of all observations side by side in one environment.
        action_space: space of all actions side by side in one environment.
        features: features of its observation, in order.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._new_entries = entries_of_new_features(core.features)
        self.features = tuple(dict.fromkeys(f for a in core.agents for f in core.features[a]))
        boxes = {agent: _features_box(core, agent) for agent in core.agents}
        low = np.concatenate([boxes[a].low[entries] for a, entries in self._new_entries.items()])
        high = np.concatenate([boxes[a].high[entries] for a, entries in self._new_entries.items()])
        features = spaces.Box(low, high, dtype=np.float32)
        first_space = core.observation_spaces[core.agents[0]]
        self.observation_space: spaces.Space[Any] = features
        if isinstance(first_space, spaces.Dict):
            self.observation_space = spaces.Dict({**first_space.spaces, "features": features})
        self.action_space = _actions_side_by_side([core.action_spaces[a] for a in core.agents])

    def actions(self, given: Any) -> dict[str, Any]:
        """Columns of the learner's actions, (B, k), for each agent.

        Raises:
            SdcError: actions of another shape.
        """
        given = checked_array(given, "actions")
        shape = (self._core.num_envs, *(self.action_space.shape or ()))
        if given.shape != shape:
            raise SdcError(f"actions: shape {given.shape}, expected {shape}")
        out: dict[str, Any] = {}
        first = 0
        for agent in self._core.agents:
            size = self._core.action_spaces[agent].shape
            width = size[0] if size else 1
            out[agent] = given[:, first : first + width] if size else given[:, first]
            first += width
        return out

    def joined(self, by_agent: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Actions side by side, (B, k)."""
        size = self._core.num_envs
        parts = [by_agent[agent].reshape(size, -1) for agent in self._core.agents]
        return np.concatenate(parts, axis=1).astype(self.action_space.dtype)

    def observation(self, by_agent: Mapping[str, Observation]) -> Observation:
        """Observations side by side, each feature once, (B, n)."""
        parts = [_features(by_agent[a])[:, entries] for a, entries in self._new_entries.items()]
        features: F32 = np.concatenate(parts, axis=1)
        of_agent = by_agent[self._core.agents[0]]
        return {**of_agent, "features": features} if isinstance(of_agent, dict) else features

    def reward(self, transition: Transition) -> F64:
        """The reward of all agents together, (B,)."""
        return np.array(transition.joint_reward)


Learner: TypeAlias = AgentLearner | JointLearner
"""Conversion between the single learner of a batch and its agents; environments come first."""


def make_learner(core: Core, agent: str | None) -> Learner:
    """Learner for one agent, or with None for all learning agents together."""
    return JointLearner(core) if agent is None else AgentLearner(core)


def learning_agent(agent: str | None, registered_agent: str | None) -> str | None:
    """The single learning agent, or None if all ``agents`` learn as one.

    Raises:
        ConfigError: an agent that differs from that of the id.
    """
    if registered_agent is not None and agent not in (None, registered_agent):
        raise ConfigError(
            f"agent {agent!r}: the one agent here is {registered_agent}; valid with another id"
        )
    return registered_agent or agent


def _features_box(core: Core, agent: str) -> spaces.Box:
    """Space of an agent's features, without the heat map."""
    space = core.observation_spaces[agent]
    features = space["features"] if isinstance(space, spaces.Dict) else space
    assert isinstance(features, spaces.Box)
    return features


def _features(observation: Observation) -> F32:
    """Features of an observation, without the heat map."""
    return observation["features"] if isinstance(observation, dict) else observation


def _actions_side_by_side(parts: list[spaces.Space[Any]]) -> spaces.Space[Any]:
    boxes = [p for p in parts if isinstance(p, spaces.Box)]
    if boxes:
        low, high = (np.concatenate([getattr(b, side) for b in boxes]) for side in ("low", "high"))
        return spaces.Box(low, high, dtype=np.float32)
    widths = [p.shape[0] if p.shape else 1 for p in parts]
    return spaces.MultiDiscrete([3] * sum(widths))


class SdcEnv(HasSpec, SingleEnv, gymnasium.Env[Any, Any]):
    """One data center with one learner.

    Episodes end by truncation, as their length is a choice and the data center runs on. Infos after
    ``reset`` are ``start_day`` and drawn inputs; infos of a step are every (B,) quantity of
    ``StepResult`` by name and the costs of the option ``costs``.

    Args:
        config: a preset, a file or a config.
        agent: agent that learns while ``others`` commands the rest; None is all ``agents`` as one.
        registered_agent: set by the ids of one agent.
        arguments: ``overrides``, ``options``, ``precision``, ``render_mode``, ``recorder`` and
            fields of ``EnvOptions``, as docs/environments.md lists them.

    Raises:
        SdcError: a config or option that is not valid.
    """

    metadata: dict[str, Any] = METADATA

    def __init__(
        self,
        config: ConfigSource = "corrected",
        *,
        agent: str | None = None,
        registered_agent: str | None = None,
        **arguments: Any,
    ) -> None:
        agent = learning_agent(agent, registered_agent)
        self._open(config, 1, agent, **arguments)
        self._learner = make_learner(self.core, agent)
        self.observation_space = self._learner.observation_space
        self.action_space = self._learner.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: seed of all randomness from here on; None continues the present generator.
            options: ``start_day``, a day of the year as ``MM-DD`` or counted from 0.

        Raises:
            ConfigError: a seed, option or day that is not valid.
        """
        observations = self.core.reset(seed, start_day_option(options))
        super().reset(seed=None if seed is None else int(seed))
        observation = first_of_batch(self._learner.observation(observations))
        return observation, first_info(self.core)

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance by one step.

        Raises:
            SdcError: an action outside its space.
            RuntimeStateError: before ``reset``, or after the end of the episode.
        """
        transition = self.core.step(self._learner.actions([action]))
        observation = first_of_batch(self._learner.observation(transition.observations))
        reward = float(self._learner.reward(transition)[0])
        info = as_floats(step_info(transition))
        return observation, reward, False, transition.ended, info

    def load_state_dict(self, values: Mapping[str, Any]) -> Observation:
        """Continue from the ``state_dict`` of an environment with the same arguments.

        Returns:
            The observation before the next step.

        Raises:
            SdcError: the state belongs to another environment, or is incomplete.
        """
        return first_of_batch(self._learner.observation(self.core.load_state_dict(values)))
