"""Stream of transitions from a batch of environments, as tensors for each learner.

A learner has one policy. It acts for an agent, for all agents of a group, which then share the
policy, or for all learning agents together. A new episode begins as soon as the last one ends, and
the final step also returns the final observations.

In shapes, B is the number of environments, n the number of entries of a learner's observation, k
the number of its actions, and m the number of entries of the shared state. R is the number of rows
of a learner: B, or for a group with W agents in each environment B W, one environment after
another.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from sdc_taichi.envs.agents import AGENT_DEFINITIONS, Agent
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
    """Agents that the learner acts for, in the order of its actions; the name of a group stands for
    all its agents, which share the policy."""
    observation_width: int
    """Number n of entries of the learner's observation."""
    action_width: int
    """Number k of actions that the learner decides."""
    choices: int | None
    """Number of options of each action: 3 for discrete actions, the number of levels for
    continuous actions with levels; None if an action can be any number within -1..1."""
    count: int = 1
    """Number W of agents in each environment that share the policy."""
    has_mask: bool = False
    """True for agents that may be without effect: those of units while these are down,
    and those of transfers while the links of their sites are down."""


class StreamStep(NamedTuple):
    """Rewards and next observations of one decision of all environments."""

    rewards: dict[str, Tensor]
    """Reward of each row of each learner, (R,) each."""
    mean_rewards: dict[str, Tensor]
    """Mean reward of the agents of each learner, (B,) each."""
    team: Tensor
    """Mean reward of the learning agents, (B,)."""
    ended: bool
    """True if all episodes of the batch ended (were truncated) after the step."""
    next_observations: dict[str, Tensor]
    """Observations after the step by learner, (R, n) each. After the last step of an episode, they
    are the final observations of that episode."""
    next_state: Tensor
    """Shared state after the step, (B, m). After the last step of an episode, it is the final
    state of that episode."""
    next_masks: dict[str, Tensor]
    """Masks after the step, (R,) each, as the attribute ``masks`` of the stream."""


def learned_rewards(own: Tensor, team: Tensor, own_share: float) -> Tensor:
    """Return the mixture of own rewards and rewards of the team that learners learn from.

    Args:
        own: own rewards of a learner.
        team: mean rewards of the learning agents, of the same shape.
        own_share: share of the own rewards, 0..1.
    """
    if own_share in (0.0, 1.0):
        return own if own_share else team
    return own_share * own + (1.0 - own_share) * team


class _Rewards(NamedTuple):
    """Rewards of one step of all environments."""

    by_learner: Mapping[str, F64]
    """Rewards of the rows of each learner, (R,) each."""
    team: F64
    """Mean reward of the learning agents, (B,)."""


class EnvironmentStream:
    """Batch of environments that begin a new episode as soon as the last one ends.

    Args:
        env: batch of environments made by ``sdc_taichi.vector_env``.
        joint: True if one learner acts for all learning agents.
        own_policies: groups of which each agent is a learner; the agents of other groups share one.
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
        own_policies: groups of units whose agents do not share a policy.
        spaces: sizes of the observations and actions of each learner.
        state_width: number m of entries of the shared state; 0 without a shared state.
        size: number of environments, B.
        decision_steps: number of steps from one decision to the next.
        observations: observations before the next step by learner, (R, n) each.
        masks: True for the rows whose agents act in the next step, (R,) each, by learner with a
            mask.
        state: shared state before the next step, (B, m).
        returns: undiscounted return of the last complete episode, averaged over the environments,
            by learner; empty before an episode has ended.

    Raises:
        ConfigError: observations contain heat maps, which perceptrons cannot read, or one learner
            is to act for all agents of a fleet.
    """

    def __init__(
        self,
        env: MultiAgentVectorEnv,
        *,
        joint: bool = False,
        own_policies: Collection[str] = (),
        decision_steps: int = 1,
        levels: int | None = None,
        shares_state: bool = True,
        against_idle: bool = False,
        seed: int = 0,
    ) -> None:
        self._core = core = env.core
        if core.options.heat_map:
            raise ConfigError("heat_map: learners take features alone; valid is False")
        if joint and core.sim.fleet.sites_per_fleet > 1:
            raise ConfigError(
                "ppo: one network for all agents of a fleet; valid are algorithms with a network "
                "for each agent, such as ippo"
            )
        self._joint = JointLearner(core) if joint else None
        of_units: list[Any] = [a for a in core.agents if AGENT_DEFINITIONS[a].per_unit]
        self.own_policies: tuple[Agent, ...] = tuple(
            a for a in of_units if joint or a in own_policies
        )
        self._levels = None
        if core.options.actions == "continuous" and levels is not None:
            self._levels = torch.from_numpy(action_levels(levels))
        self.size, self.decision_steps = core.num_envs, decision_steps
        self.spaces: dict[str, LearnerSpaces] = {}
        if self._joint is not None:
            members = tuple(agent for names in core.members.values() for agent in names)
            of_joint = self._joint.observation_space, self._joint.action_space
            self.spaces[JOINT] = _learner_spaces(members, *of_joint, levels)
        for group, names in {} if joint else core.members.items():
            of_group = core.observation_spaces[group], core.action_spaces[group], levels
            own = group in self.own_policies
            for agents in [(name,) for name in names] if own else [(group,)]:
                of_agent = _learner_spaces(agents, *of_group)
                count = 1 if own else len(names)
                has_mask = group in core.masked_groups
                self.spaces[agents[0]] = replace(of_agent, count=count, has_mask=has_mask)
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
            actions: actions of each learner, (R, k): indices of options, or numbers within -1..1.

        Returns:
            Observations after the last step, and rewards summed over the steps.
        """
        core, by_agent = self._core, self._by_agent(actions)
        # Episodes that ended at a physical limit begin again; the others are not affected.
        core.restart_ended()
        transition = core.step(by_agent, observes=False)
        by_learner, team = self._rewards(transition)
        for _ in range(self.decision_steps - 1):
            if transition.ended:
                break
            core.restart_ended()
            transition = core.step(by_agent, observes=False)
            more, more_of_team = self._rewards(transition)
            by_learner = {name: by_learner[name] + more[name] for name in by_learner}
            team = team + more_of_team
        rewards = {name: _tensor(reward) for name, reward in by_learner.items()}
        means = {name: _tensor(self._mean(name, reward)) for name, reward in by_learner.items()}
        for name, reward in means.items():
            self._sums[name] += float(reward.mean())
        self._take(core.observe())
        after = StreamStep(
            rewards,
            means,
            _tensor(team),
            transition.ended,
            self.observations,
            self.state,
            self.masks,
        )
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
        """Return actions by group as arrays; (B,) for a single discrete action, else (B, k).

        Those of agents of units have the units as second axis.
        """
        levels = self._levels
        arrays = {
            name: (values if levels is None else levels[values]).numpy()
            for name, values in actions.items()
        }
        if self._joint is not None:
            return self._joint.actions(arrays[JOINT])
        by_group: dict[str, Any] = {}
        for group, names in self._core.members.items():
            if group in self.own_policies:
                values = np.stack([arrays[name] for name in names], axis=1)
            else:
                values = arrays[group]
            rows = () if names == (group,) else (len(names),)
            shape = self._core.action_spaces[group].shape or ()
            by_group[group] = values.reshape(self.size, *rows, *shape)
        return by_group

    def _by_learner(self, by_group: Mapping[str, Any]) -> dict[str, Any]:
        """Return values by group, (B, ...) or (B, W, ...), as rows of learners, (R, ...)."""
        rows: dict[str, Any] = {}
        for group, values in by_group.items():
            names = self._core.members[group]
            if group in self.own_policies:
                rows |= {name: values[:, i] for i, name in enumerate(names)}
            elif names == (group,):
                rows[group] = values
            else:
                rows[group] = values.reshape(-1, *values.shape[2:])
        return rows

    def _mean(self, name: str, rewards: F64) -> F64:
        """Return the mean reward of the agents of a learner, (B,), from those of its rows, (R,)."""
        if self.spaces[name].count == 1:
            return rewards
        by_agent = rewards.reshape(self.size, -1)
        slots = self._core.slots.get(name)
        exists = np.ones_like(by_agent) if slots is None else slots.exists
        return np.asarray((by_agent * exists).sum(axis=1) / exists.sum(axis=1))

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
        by_learner = {JOINT: joint} if self._joint else self._by_learner(transition.rewards)
        return _Rewards(by_learner, joint / len(self._core.agents))

    def _rewards_of_idle(self, seed: int) -> list[_Rewards]:
        """Run an episode with idle commands, and return the rewards of each step.

        These rewards do not depend on the actions of learners, so subtracting them changes no
        optimal policy (Weaver and Tao 2001). The subtraction removes the effects of demand, weather
        and grid on the reward, which are larger than the effect of any action.
        """
        core = self._core
        core.reset(seed)
        return [
            self._full_rewards(core.step(core.idle_actions(), observes=False))
            for _ in range(core.steps)
        ]

    def _take(self, by_agent: Mapping[str, Observation]) -> None:
        """Set the observations, the masks and the shared state before the next step."""
        arrays = self._by_learner(by_agent) if self._joint is None else {}
        if self._joint is not None:
            arrays = {JOINT: self._joint.observation(by_agent)}
        self.observations = {name: _tensor(arrays[name]) for name in self.learners}
        masks = {} if self._joint is not None else self._by_learner(self._core.masks())
        self.masks = {name: torch.from_numpy(mask.copy()) for name, mask in masks.items()}
        if self._shares_state:
            self.state = _tensor(self._core.state())
        else:
            self.state = torch.empty(self.size, 0)


def _learner_spaces(
    agents: tuple[str, ...],
    observation: spaces.Space[Any],
    action: spaces.Space[Any],
    levels: int | None,
) -> LearnerSpaces:
    """Return the sizes of a learner from its spaces in one environment.

    Args:
        agents: agents that the learner acts for.
        observation: space of the observation.
        action: space of the action.
        levels: number of levels of continuous actions; None if they can be any number.
    """
    return LearnerSpaces(
        agents,
        int(np.prod(observation.shape or (1,))),
        int(np.prod(action.shape or (1,))),
        levels if isinstance(action, spaces.Box) else CHOICES,
    )


def _tensor(array: Any) -> Tensor:
    """Return a float32 copy of an array as a tensor."""
    return torch.from_numpy(np.array(array, dtype=np.float32))
