"""One data center as a Gymnasium environment with one learner, for one agent or all agents."""

from __future__ import annotations

import math
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
    as_scalars,
    first_of_batch,
    start_day_option,
)
from sdc_taichi.envs.core import Core, Observation, Transition
from sdc_taichi.envs.features import Feature, entries_of_new_features
from sdc_taichi.envs.options import ConfigSource
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.types import F32, F64


class AgentLearner:
    """A learner that controls one agent and receives this agent's collaborative reward.

    Args:
        core: batch of data centers with exactly one learning agent.

    Attributes:
        observation_space: space of the agent's observation in one environment.
        action_space: space of the agent's action in one environment.
        features: features of the agent's observation, in order.
    """

    def __init__(self, core: Core) -> None:
        (self._agent,) = core.agents
        self.observation_space: spaces.Space[Any] = core.observation_spaces[self._agent]
        self.action_space: spaces.Space[Any] = core.action_spaces[self._agent]
        self.features = core.features[self._agent]

    def actions(self, values: Any) -> dict[str, Any]:
        """Convert the learner's actions to actions by agent; the values are the same."""
        return {self._agent: values}

    def joined(self, by_agent: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Convert actions by agent to the learner's actions, (B,) or (B, k)."""
        return by_agent[self._agent].astype(self.action_space.dtype)

    def observation(self, by_agent: Mapping[str, Observation]) -> Observation:
        """Return the agent's observation, (B, n)."""
        return by_agent[self._agent]

    def reward(self, transition: Transition) -> F64:
        """Return the agent's reward, (B,)."""
        return np.array(transition.rewards[self._agent])


class JointLearner:
    """A single learner that controls all learning agents.

    The learner's observation concatenates the observations of the agents and contains each feature
    once. Unlike the shared state, it leaves out features that no agent observes. The learner's
    reward is ``Transition.joint_reward``. If all three agents learn, the sum of their rewards does
    not depend on the weight ``collaboration``.

    Args:
        core: batch of data centers in which the agents learn.

    Attributes:
        observation_space: space of the concatenated observations in one environment.
        action_space: space of the concatenated actions in one environment.
        features: features of the learner's observation, in order.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._new_entries, self.features = _joined_features(core)
        boxes = [
            (_features_box(core, group), len(names), self._new_entries[group])
            for group, names in core.members.items()
        ]
        low = np.concatenate([np.tile(box.low, n)[entries] for box, n, entries in boxes])
        high = np.concatenate([np.tile(box.high, n)[entries] for box, n, entries in boxes])
        features = spaces.Box(low, high, dtype=np.float32)
        first_space = core.observation_spaces[core.agents[0]]
        self.observation_space: spaces.Space[Any] = features
        if isinstance(first_space, spaces.Dict):
            self.observation_space = spaces.Dict({**first_space.spaces, "features": features})
        self.action_space = _actions_side_by_side(
            [core.action_spaces[group] for group, names in core.members.items() for _ in names]
        )

    def actions(self, values: Any) -> dict[str, Any]:
        """Split the learner's actions, (B, k), into actions by agent.

        Raises:
            SdcError: the actions have a wrong shape.
        """
        values = checked_array(values, "actions")
        shape = (self._core.num_envs, *(self.action_space.shape or ()))
        if values.shape != shape:
            raise SdcError(f"actions: shape {values.shape}, expected {shape}")
        out: dict[str, Any] = {}
        first = 0
        for group, names in self._core.members.items():
            size = self._core.action_spaces[group].shape or ()
            end = first + len(names) * math.prod(size)
            rows = () if names == (group,) else (len(names),)
            out[group] = values[:, first:end].reshape(len(values), *rows, *size)
            first = end
        return out

    def joined(self, by_agent: Mapping[str, npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Concatenate actions by agent to the learner's actions, (B, k)."""
        size = self._core.num_envs
        parts = [by_agent[agent].reshape(size, -1) for agent in self._core.agents]
        return np.concatenate(parts, axis=1).astype(self.action_space.dtype)

    def observation(self, by_agent: Mapping[str, Observation]) -> Observation:
        """Concatenate observations by agent, with each feature once, (B, n)."""
        size = self._core.num_envs
        parts = [
            _features(by_agent[group]).reshape(size, -1)[:, entries]
            for group, entries in self._new_entries.items()
        ]
        features: F32 = np.concatenate(parts, axis=1)
        of_agent = by_agent[self._core.agents[0]]
        return {**of_agent, "features": features} if isinstance(of_agent, dict) else features

    def reward(self, transition: Transition) -> F64:
        """Return the joint reward of all learning agents, (B,)."""
        return np.array(transition.joint_reward)


Learner: TypeAlias = AgentLearner | JointLearner
"""Converts between the single learner of a batch and its agents. The first axis of all arrays is
the environment."""


def make_learner(core: Core, agent: str | None) -> Learner:
    """Create the learner for one agent, or for all learning agents if ``agent`` is None.

    The agents of CRAC units, and those of the sites of a fleet, have one learner together.
    """
    several = agent is None or core.members[agent] != (agent,)
    return JointLearner(core) if several else AgentLearner(core)


def learning_agent(agent: str | None, registered_agent: str | None) -> str | None:
    """Return the only learning agent, or None if one learner controls all ``agents``.

    Args:
        agent: the user's argument ``agent``, or None.
        registered_agent: agent of the Gymnasium id, or None.

    Raises:
        ConfigError: ``agent`` differs from the agent of the Gymnasium id.
    """
    if registered_agent is not None and agent not in (None, registered_agent):
        raise ConfigError(
            f"agent {agent!r}: the one agent here is {registered_agent}; valid with another id"
        )
    return registered_agent or agent


def _joined_features(
    core: Core,
) -> tuple[dict[str, npt.NDArray[np.int64] | slice], tuple[Feature, ...]]:
    """Return which features a joint observation contains, so that each is there once.

    Returns:
        Entries of the observations of a group, one agent after another, by group; and the features
        in the order of these entries.
    """
    groups = {agent: group for group, names in core.members.items() for agent in names}
    new = entries_of_new_features({a: core.features[group] for a, group in groups.items()})
    by_group: dict[str, npt.NDArray[np.int64] | slice] = {}
    features: list[Feature] = []
    for group, names in core.members.items():
        of_agent = core.features[group]
        numbers = np.arange(sum(f.size for f in of_agent))
        feature_of_entry = np.repeat(np.arange(len(of_agent)), [f.size for f in of_agent])
        for agent in names:
            features += [of_agent[i] for i in np.unique(feature_of_entry[new[agent]])]
        entries = [i * len(numbers) + numbers[new[agent]] for i, agent in enumerate(names)]
        by_group[group] = new[group] if names == (group,) else np.concatenate(entries)
    return by_group, tuple(features)


def _features_box(core: Core, agent: str) -> spaces.Box:
    """Return the space of an agent's features, without the heat map."""
    space = core.observation_spaces[agent]
    features = space["features"] if isinstance(space, spaces.Dict) else space
    assert isinstance(features, spaces.Box)
    return features


def _features(observation: Observation) -> F32:
    """Return the features of an observation, without the heat map."""
    return observation["features"] if isinstance(observation, dict) else observation


def _actions_side_by_side(parts: list[spaces.Space[Any]]) -> spaces.Space[Any]:
    boxes = [p for p in parts if isinstance(p, spaces.Box)]
    if boxes:
        low, high = (np.concatenate([getattr(b, side) for b in boxes]) for side in ("low", "high"))
        return spaces.Box(low, high, dtype=np.float32)
    widths = [p.shape[0] if p.shape else 1 for p in parts]
    return spaces.MultiDiscrete([3] * sum(widths))


class SdcEnv(HasSpec, SingleEnv, gymnasium.Env[Any, Any]):
    """Gymnasium environment of one data center with one learner.

    Episodes end by truncation, because their length is a choice and a data center has no final
    state; only a result beyond the physical limits terminates an episode. Infos are ``ended_by``,
    ``start_day``, the randomly drawn inputs, the facility's quantities of ``StepResult`` by name,
    and the costs of the option ``costs``. Those of ``reset`` have the same keys; ``ended_by``,
    quantities and costs are 0 there.

    Args:
        config: a preset, a file or a config.
        agent: the only learning agent; the controller ``others`` commands the rest. With None one
            learner controls all ``agents``.
        registered_agent: agent of the Gymnasium id, if the id has a single agent.
        arguments: ``overrides``, ``options``, ``precision``, ``render_mode``, ``recorder`` and
            fields of ``EnvOptions``; see docs/environments.md.

    Raises:
        SdcError: a config or option is not valid.
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
            seed: seed of the random generator; None continues the current generator.
            options: dict with ``start_day``, a day as ``MM-DD`` or as number of the day in the
                year, from 0.

        Raises:
            ConfigError: the seed, an option or the day is not valid.
        """
        observations = self.core.reset(seed, start_day_option(options))
        super().reset(seed=None if seed is None else int(seed))
        observation = first_of_batch(self._learner.observation(observations))
        return observation, as_scalars(self.core.infos())

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance the data center by one step.

        Raises:
            SdcError: the action is outside its space.
            RuntimeStateError: the environment has not been reset, or the episode is over.
        """
        transition = self.core.step(self._learner.actions([action]))
        observation = first_of_batch(self._learner.observation(transition.observations))
        reward = float(self._learner.reward(transition)[0])
        info = as_scalars(self.core.infos(transition))
        terminated, truncated = bool(transition.terminated[0]), bool(transition.truncated[0])
        return observation, reward, terminated, truncated, info

    def load_state_dict(self, values: Mapping[str, Any]) -> Observation:
        """Continue from the ``state_dict`` of an environment with the same arguments.

        Returns:
            The observation before the next step.

        Raises:
            SdcError: the state belongs to another environment, or is incomplete.
        """
        return first_of_batch(self._learner.observation(self.core.load_state_dict(values)))
