"""Stream of transitions from a batch of environments, as tensors for each learner.

A learner has one policy; it acts for one agent, or for all learning agents together. A new episode
begins as soon as the last one ends, and the final step also returns the final observations.

In shapes, B is the number of environments, n the number of entries of a learner's observation, k
the number of its actions, and m the number of entries of the shared state.
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
"""Name of the learner that acts for all learning agents."""


@dataclass(frozen=True, slots=True)
class LearnerSpaces:
    """Sizes of the observation and the action of a learner in one environment."""

    agents: tuple[str, ...]
    """Agents that the learner acts for, in the order of its actions."""
    observation_width: int
    """Number n of entries of the learner's observation."""
    action_width: int
    """Number k of actions that the learner decides."""
    choices: int | None
    """Number of options of each action: 3 for discrete actions, the number of levels for
    continuous actions with levels; None if an action can be any number within -1..1."""


class StreamStep(NamedTuple):
    """Rewards and next observations of one decision of all environments."""

    rewards: dict[str, Tensor]
    """Reward of each learner, (B,) each."""
    team: Tensor
    """Mean reward of the learning agents, (B,)."""
    ended: bool
    """True if all episodes of the batch ended (were truncated) after the step."""
    next_observations: dict[str, Tensor]
    """Observations after the step by learner, (B, n) each. After the last step of an episode, they
    are the final observations of that episode."""
    next_state: Tensor
    """Shared state after the step, (B, m). After the last step of an episode, it is the final
    state of that episode."""


class _Rewards(NamedTuple):
    """Rewards of one step of all environments, (B,) each, by learner and for the team."""

    by_learner: Mapping[str, F64]
    team: F64


class EnvironmentStream:
    """Batch of environments that begin a new episode as soon as the last one ends.

    Args:
        env: batch of environments made by ``sdc_taichi.vector_env``.
        joint: True if one learner acts for all learning agents.
        decision_steps: number of steps from one decision to the next; actions are repeated in
            between.
        levels: number of equally spaced levels from -1 to 1 from which learners choose continuous
            actions; None allows any number.
        shares_state: True to compute the shared state, which takes time.
        against_idle: True to subtract the reward of idle commands in the same step. It has an
            effect only if all episodes of a data center have the same inputs.
        seed: seed of the first reset; environment i has ``seed + i``.

    Attributes:
        learners: names of the learners.
        spaces: sizes of the observations and actions of each learner.
        state_width: number m of entries of the shared state; 0 without a shared state.
        size: number of environments, B.
        decision_steps: number of steps from one decision to the next.
        observations: observations before the next step by learner, (B, n) each.
        state: shared state before the next step, (B, m).
        returns: undiscounted return of the last complete episode, averaged over the environments,
            by learner; empty before an episode has ended.

    Raises:
        ConfigError: observations contain heat maps, which perceptrons cannot read.
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
        if self._joint is not None:
            parts = {JOINT: (core.agents, self._joint.observation_space, self._joint.action_space)}
        else:
            parts = {
                a: ((a,), env.observation_spaces[a], env.action_spaces[a]) for a in core.agents
            }
        self.spaces = {
            name: LearnerSpaces(
                agents,
                int(np.prod(observation.shape or (1,))),
                int(np.prod(action.shape or (1,))),
                levels if isinstance(action, spaces.Box) else CHOICES,
            )
            for name, (agents, observation, action) in parts.items()
        }
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
            actions: actions of each learner, (B, k): indices of options, or numbers within -1..1.

        Returns:
            Observations after the last step, and rewards summed over the steps.
        """
        core, by_agent = self._core, self._by_agent(actions)
        # Episodes that ended at a physical limit begin again; the others are not affected.
        core.restart_ended()
        transition = core.step(by_agent)
        by_learner, team = self._rewards(transition)
        for _ in range(self.decision_steps - 1):
            if transition.ended:
                break
            core.restart_ended()
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
        """Return the state, for ``load_state_dict`` of a stream with the same arguments."""
        sums = {"returns": dict(self.returns), "sums": dict(self._sums)}
        return {"environments": self._core.state_dict(), **sums}

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore the state that ``state_dict`` returned.

        Raises:
            SdcError: the state belongs to different environments.
        """
        self._take(self._core.load_state_dict(values["environments"]))
        self.returns, self._sums = dict(values["returns"]), dict(values["sums"])

    def _by_agent(self, actions: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return actions by agent as arrays; (B,) for a single discrete action, else (B, k)."""
        levels = self._levels
        arrays = {
            name: (values if levels is None else levels[values]).numpy()
            for name, values in actions.items()
        }
        if self._joint is not None:
            return self._joint.actions(arrays[JOINT])
        return {
            agent: values[:, 0] if values.dtype == np.int64 and values.shape[1] == 1 else values
            for agent, values in arrays.items()
        }

    def _rewards(self, transition: Transition) -> _Rewards:
        """Return the rewards of a step, minus those of idle commands if these are recorded."""
        rewards = self._full_rewards(transition)
        if not self._idle:
            return rewards
        idle = self._idle[transition.result.step]
        by_learner = {
            name: rewards.by_learner[name] - idle.by_learner[name] for name in self.learners
        }
        return _Rewards(by_learner, rewards.team - idle.team)

    def _full_rewards(self, transition: Transition) -> _Rewards:
        joint = transition.joint_reward
        by_learner = transition.rewards if self._joint is None else {JOINT: joint}
        return _Rewards(by_learner, joint / len(self._core.agents))

    def _rewards_of_idle(self, seed: int) -> list[_Rewards]:
        """Run an episode with idle commands, and return the rewards of each step.

        These rewards do not depend on the actions of learners, so subtracting them changes no
        optimal policy (Weaver and Tao 2001). The subtraction removes the effects of demand, weather
        and grid on the reward, which are larger than the effect of any action.
        """
        core = self._core
        core.reset(seed)
        return [self._full_rewards(core.step(core.idle_actions())) for _ in range(core.steps)]

    def _take(self, by_agent: Mapping[str, Observation]) -> None:
        """Set the observations and the shared state before the next step."""
        arrays = by_agent if self._joint is None else {JOINT: self._joint.observation(by_agent)}
        self.observations = {name: _tensor(arrays[name]) for name in self.learners}
        if self._shares_state:
            self.state = _tensor(self._core.state())
        else:
            self.state = torch.empty(self.size, 0)


def _tensor(array: Any) -> Tensor:
    """Return a float32 copy of an array as a tensor."""
    return torch.from_numpy(np.array(array, dtype=np.float32))
