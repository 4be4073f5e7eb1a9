"""A stream of transitions from a batch of environments, as tensors, one learner at a time.

A learner is whatever has one policy: one agent, or all learning agents together. Episodes follow
each other without a gap; where they are cut off, a step also holds what they ended with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from sdc_taichi.envs.core import Observation, Transition
from sdc_taichi.envs.episodes import draws_inputs
from sdc_taichi.envs.single import JointLearner
from sdc_taichi.envs.vector import MultiAgentVectorEnv
from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.policy import CHOICES, action_levels
from sdc_taichi.types import F64

JOINT = "joint"
"""Name of the learner that stands for all learning agents."""


@dataclass(frozen=True, slots=True)
class LearnerSpaces:
    """Sizes of the observation and the action of a learner in one environment."""

    agents: tuple[str, ...]
    """Agents that it acts for, in the order of its actions."""
    observation_width: int
    """Number of entries of its observation, n."""
    action_width: int
    """Number of numbers that it decides, k."""
    choices: int | None
    """Number of choices for each number: 3 with discrete actions, or the levels of continuous ones;
    None where each is any number within -1..1."""


class StreamStep(NamedTuple):
    """Rewards, ends of episodes and next observations of a step of all environments."""

    rewards: dict[str, Tensor]
    """Reward of each learner, (B,) each."""
    team: Tensor
    """Mean reward of the learning agents, (B,)."""
    ended: bool
    """Whether the episodes were cut off after the step; those of a batch end together."""
    next_observations: dict[str, Tensor]
    """Observations after the step by learner, (B, n) each; of the same episode even where it was
    cut off."""
    next_state: Tensor
    """Shared state after the step, (B, m); of the same episode even where it was cut off."""


class _Rewards(NamedTuple):
    """Rewards of a step of all environments."""

    by_learner: Mapping[str, F64]
    team: F64


class EnvironmentStream:
    """Environments without end, whose episodes begin anew by themselves.

    Args:
        env: a batch, as ``sdc_taichi.vector_env`` makes it.
        joint: whether all learning agents are one learner.
        decision_steps: steps between two decisions, in which an action is held.
        levels: number of levels, evenly from -1 to 1, that learners choose continuous actions from;
            None is any number.
        shares_state: whether the shared state is wanted, which takes time.
        against_idle: whether rewards of idle commands in the same step are subtracted, where
            all episodes of a data center have the same inputs.
        seed: seed of the first reset; environment i takes ``seed + i``.

    Attributes:
        learners: names of the learners.
        spaces: what each learner sees and does.
        state_width: number of entries of the shared state, m; 0 if it is not wanted.
        size: number of environments, B.
        decision_steps: steps between two decisions.
        observations: observations before the next step by learner, (B, n) each.
        state: shared state before the next step, (B, m).
        returns: sum of the rewards of the last whole episodes by learner, the mean over all
            environments; empty before an episode has ended.

    Raises:
        ConfigError: observations with heat maps, which these networks do not take.
    """

    def __init__(
        self,
        env: MultiAgentVectorEnv,
        *,
        joint: bool = False,
        decision_steps: int = 1,
        levels: int | None = None,
        shares_state: bool = True,
        against_idle: bool = False,
        seed: int = 0,
    ) -> None:
        self._core = core = env.core
        if core.options.heat_map:
            raise ConfigError("heat_map: learners take features alone; valid is False")
        self._joint = JointLearner(core) if joint else None
        self._levels = None
        if core.options.actions == "continuous" and levels is not None:
            self._levels = torch.from_numpy(action_levels(levels))
        self.size, self.decision_steps = core.num_envs, decision_steps
        self.spaces = _spaces(core.agents, env, self._joint, levels)
        self.learners = tuple(self.spaces)
        self._shares_state = shares_state
        self.state_width = int(np.prod(core.state_space.shape or ())) if shares_state else 0
        self.returns: dict[str, float] = {}
        self._sums = dict.fromkeys(self.learners, 0.0)
        self._idle: list[_Rewards] = []
        if against_idle and core.options.start == "fixed" and not draws_inputs(core.options):
            self._idle = self._rewards_of_idle(seed)
        self._take(core.reset(seed))

    def step(self, actions: Mapping[str, Tensor]) -> StreamStep:
        """Advance all environments to the next decision, or to the end of their episodes.

        Args:
            actions: of each learner, (B, k): numbers of choices, or numbers within -1..1.

        Returns:
            The situation after the last step, and rewards summed over the steps.
        """
        core, by_agent = self._core, self._by_agent(actions)
        transition = core.step(by_agent)
        by_learner, team = self._rewards(transition)
        for _ in range(self.decision_steps - 1):
            if transition.ended:
                break
            transition = core.step(by_agent)
            more, more_of_team = self._rewards(transition)
            by_learner = {name: by_learner[name] + more[name] for name in by_learner}
            team = team + more_of_team
        rewards = {name: _tensor(reward) for name, reward in by_learner.items()}
        for name, reward in rewards.items():
            self._sums[name] += float(reward.mean())
        self._take(transition.observations)
        after = StreamStep(rewards, _tensor(team), transition.ended, self.observations, self.state)
        if transition.ended:
            self.returns, self._sums = self._sums, dict.fromkeys(self.learners, 0.0)
            self._take(core.next_episode())
        return after

    @property
    def episode_steps(self) -> int:
        """Number of steps of an episode."""
        return self._core.steps

    def state_dict(self) -> dict[str, Any]:
        """State of the environments, for ``load_state_dict`` of a stream made alike."""
        sums = {"returns": dict(self.returns), "sums": dict(self._sums)}
        return {"environments": self._core.state_dict(), **sums}

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Go on from what ``state_dict`` returned.

        Raises:
            SdcError: a state of other environments.
        """
        self._take(self._core.load_state_dict(values["environments"]))
        self.returns, self._sums = dict(values["returns"]), dict(values["sums"])

    def _by_agent(self, actions: Mapping[str, Tensor]) -> dict[str, Any]:
        """Actions by agent as arrays, (B,) where an agent decides one choice, else (B, k)."""
        levels = self._levels
        arrays = {
            name: (given if levels is None else levels[given]).numpy()
            for name, given in actions.items()
        }
        if self._joint is not None:
            return self._joint.actions(arrays[JOINT])
        return {
            agent: given[:, 0] if given.dtype == np.int64 and given.shape[1] == 1 else given
            for agent, given in arrays.items()
        }

    def _rewards(self, transition: Transition) -> _Rewards:
        """Rewards of a step, less those of idle commands in it if they are known."""
        found = self._rewards_as_they_are(transition)
        if not self._idle:
            return found
        idle = self._idle[transition.result.step]
        by_learner = {
            name: found.by_learner[name] - idle.by_learner[name] for name in self.learners
        }
        return _Rewards(by_learner, found.team - idle.team)

    def _rewards_as_they_are(self, transition: Transition) -> _Rewards:
        joint = transition.joint_reward
        by_learner = transition.rewards if self._joint is None else {JOINT: joint}
        return _Rewards(by_learner, joint / len(self._core.agents))

    def _rewards_of_idle(self, seed: int) -> list[_Rewards]:
        """Rewards of each step of an episode of idle commands.

        They do not depend on what a learner does, so the policy that is best with rewards less
        these is the one that is best without (Weaver and Tao 2001), and demand, weather and grid,
        which move rewards more than any action, are out of the way.
        """
        core = self._core
        core.reset(seed)
        found = []
        for _ in range(core.steps):
            found.append(self._rewards_as_they_are(core.step(core.idle_actions())))
        return found

    def _take(self, by_agent: Mapping[str, Observation]) -> None:
        """Keep observations and shared state before the next step."""
        found = by_agent if self._joint is None else {JOINT: self._joint.observation(by_agent)}
        self.observations = {name: _tensor(found[name]) for name in self.learners}
        if self._shares_state:
            self.state = _tensor(self._core.state())
        else:
            self.state = torch.empty(self.size, 0)


def _spaces(
    agents: tuple[str, ...],
    env: MultiAgentVectorEnv,
    joint: JointLearner | None,
    levels: int | None,
) -> dict[str, LearnerSpaces]:
    """Sizes of the observations and actions of each learner."""
    if joint is not None:
        of_joint = joint.observation_space, joint.action_space
        return {JOINT: _learner_spaces(agents, *of_joint, levels)}
    return {
        a: _learner_spaces((a,), env.observation_spaces[a], env.action_spaces[a], levels)
        for a in agents
    }


def _learner_spaces(
    agents: tuple[str, ...],
    observation: spaces.Space[Any],
    action: spaces.Space[Any],
    levels: int | None,
) -> LearnerSpaces:
    choices = levels if isinstance(action, spaces.Box) else CHOICES
    width, action_width = (int(np.prod(space.shape or (1,))) for space in (observation, action))
    return LearnerSpaces(agents, width, action_width, choices)


def _tensor(array: Any) -> Tensor:
    """A float32 tensor of its own."""
    return torch.from_numpy(np.array(array, dtype=np.float32))
