"""The off-policy algorithms HAD3QN and HASAC, as special cases of one update.

All agents act for some steps, which are added to a replay buffer. Then batches of n-step
transitions are drawn from the buffer. E critics Q_e, which take the shared state and the actions of
all learners, are fitted by Adam to the targets

    y = r_0 + ... + gamma^(n-1) r_(n-1) + gamma^n V(s_n),

where r is the reward of the team and V comes from target critics (slowly updated copies). If the
learners have own rewards, each learner has E critics of its own reward in place of that of the
team. Episodes are truncated, never terminated, so V is also added at the end of an episode. The
learners are updated one after another in random order. The algorithms differ in V and in that
update:

- ``had3qn`` (Zhong et al. 2024) has one dueling critic (Wang et al. 2016). Each learner has its own
  action values, which are fitted to the critic's. The learners' values select the best actions, and
  V is the target critic's value of these actions (double Q-learning, van Hasselt et al. 2016).
  Exploration is epsilon-greedy with a decreasing epsilon.
- ``hasac`` (Liu et al. 2024) has two critics and uses the minimum of their values. V is the soft
  value: the expected value under the policies plus the policies' entropies, weighted by
  temperatures. The learners maximise the soft value.

Agents of a group that shares a policy are rows of one learner, but the critics take the actions of
each of them. The steps in which an agent is without effect, because its CRAC unit is down, are left
out of the losses of its learner.

The published HASAC has an additional temperature for the critic. Here V uses the temperatures of
the learners, so that critic and learners have the same objective.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.algorithms import OffPolicyDefinition, OffPolicySettings, own_share
from sdc_taichi.learning.networks import (
    Adam,
    ContinuousValues,
    JointValues,
    RunningMoments,
    generators,
    layers_of,
    policy_network,
)
from sdc_taichi.learning.off_policy_actors import (
    GaussianActors,
    GreedyActors,
    Situation,
    SoftActors,
)
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.stream import (
    EnvironmentStream,
    LearnerSpaces,
    StreamStep,
    learned_rewards,
)

STATE = "state"
"""Name of the columns that hold the shared state."""
LEAST_SCALE = 1e-6
"""Lower bound of the standard deviation of returns by which targets are divided."""


class OffPolicy:
    """Off-policy algorithm: learners that are updated from transitions in a replay buffer.

    Args:
        definition: properties in which the off-policy algorithms differ.
        settings: settings of the algorithm.
        stream: the environments to learn in.
        updates: total number of updates of the training; sets the schedules of exploration and
            learning rate.
        seed: seed of weights, actions, order of learners and drawn transitions.

    Raises:
        ConfigError: the algorithm does not support the environments' actions.
    """

    def __init__(
        self,
        definition: OffPolicyDefinition,
        settings: OffPolicySettings,
        stream: EnvironmentStream,
        *,
        updates: int,
        seed: int,
    ) -> None:
        self._settings, self._spaces, self._updates = settings, stream.spaces, updates
        self._done = 0
        self._generators = generators(seed)
        self._columns = _columns(self._spaces, stream.state_width)
        self._numbers = _numbers(self._spaces)
        self._soft = definition.soft
        self._own_share = own_share(
            settings.reward,
            definition.reward,
            shared_policy=any(of.count > 1 for of in self._spaces.values()),
        )
        rewards = len(self._spaces) if self._own_share else 1
        self._critic, self._actors = _critic_and_actors(
            definition,
            settings,
            self._spaces,
            stream.state_width,
            rewards,
            self._generators["weights"],
        )
        self._targets = self._critic.weights.detach().clone()
        self._adam = Adam(self._critic.weights, settings.rate, settings.gradient_norm)
        plain = [STATE, *(name for name, of in self._spaces.items() if not _has_rows(of))]
        self._plain = slice(self._columns[plain[-1]].stop)
        self._moments = RunningMoments(self._plain.stop)
        self._unit_moments = {
            name: RunningMoments(of.observation_width)
            for name, of in self._spaces.items()
            if _has_rows(of)
        }
        self._rewards = RunningMoments(rewards)
        self._returns = RunningMoments(rewards)
        self._running_return = torch.zeros(0, rewards)
        self._replay: Replay | None = None

    @property
    def exploration(self) -> float:
        """Probability of a random choice (epsilon) in the current update."""
        s = self._settings
        done = self._done / max(1.0, s.exploration_share * self._updates)
        return max(s.exploration, 1.0 - (1.0 - s.exploration) * done)

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Act for ``rollout_decisions`` decisions, and learn from the replay buffer.

        Returns:
            Values to log: ``reward/NAME``, the mean reward per step; losses, entropies and
            temperatures, averaged over the gradient steps; ``exploration`` for ``had3qn``.
        """
        if self._replay is None:
            self._replay = self._new_replay(stream.size)
        logged = self._collect(stream, self._replay)
        self._anneal()
        totals: dict[str, Tensor] = {}
        for _ in range(self._settings.gradient_steps):
            for name, value in self._learn(self._replay).items():
                totals[name] = totals[name] + value if name in totals else value
        logged |= {n: float(x) / self._settings.gradient_steps for n, x in totals.items()}
        self._done += 1
        return logged

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """Return the current policies without randomness (highest score, or mean action)."""
        networks = []
        for name, sizes in self._spaces.items():
            *inner, (weight, bias) = layers_of(self._actors.nets[name])
            outputs = sizes.action_width * (sizes.choices or 1)
            layers = (*inner, (weight[:outputs], bias[:outputs]))
            seen, part = self._moments, self._columns[name]
            if name in self._unit_moments:
                seen, part = self._unit_moments[name], slice(None)
            moments = seen.mean.float().numpy()[part], seen.std.numpy()[part]
            activation = self._settings.activation
            networks.append(policy_network(layers, *moments, sizes, activation, "tanh"))
        return tuple(networks)

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state of the training, including the replay buffer."""
        return {
            "done": self._done,
            "generators": {n: g.get_state() for n, g in self._generators.items()},
            "critic": self._adam.state_dict(),
            "targets": self._targets,
            "actors": self._actors.state_dict(),
            "moments": {n: m.state_dict() for n, m in self._all_moments().items()},
            "running_return": self._running_return,
            "replay": {} if self._replay is None else self._replay.state_dict(),
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore a state from ``state_dict`` of an algorithm with the same arguments."""
        self._done = int(values["done"])
        for name, generator in self._generators.items():
            generator.set_state(values["generators"][name])
        self._adam.load_state_dict(values["critic"])
        self._targets.copy_(torch.as_tensor(values["targets"]))
        self._actors.load_state_dict(values["actors"])
        for name, moments in self._all_moments().items():
            moments.load_state_dict(values["moments"][name])
        self._running_return = torch.as_tensor(values["running_return"]).clone()
        self._replay = None
        if values["replay"]:
            self._replay = self._new_replay(len(self._running_return))
            self._replay.load_state_dict(values["replay"])

    def _all_moments(self) -> dict[str, RunningMoments]:
        of_units = {f"seen/{name}": moments for name, moments in self._unit_moments.items()}
        of_all = {"seen": self._moments, "rewards": self._rewards, "returns": self._returns}
        return of_all | of_units

    def _new_replay(self, num_envs: int) -> Replay:
        return Replay(
            self._settings.replay_size,
            num_envs,
            max(part.stop for part in self._columns.values()),
            self._numbers,
            len(self._rewards.mean),
            steps=self._settings.n_steps,
            discount=self._settings.discount,
        )

    # Acting

    def _collect(self, stream: EnvironmentStream, replay: Replay) -> dict[str, float]:
        """Act with the current policies, and return the values to log, such as mean rewards."""
        rewards = {name: torch.zeros(()) for name in self._spaces}
        situations = []
        with torch.no_grad():
            for _ in range(self._settings.rollout_decisions):
                before = self._joined(stream.state, stream.observations, stream.masks)
                situations.append(before)
                actions = self._actors.act(
                    self._situation(before), self.exploration, self._generators["actions"]
                )
                after = stream.step(
                    {
                        name: actions[:, part].reshape(-1, self._spaces[name].action_width)
                        for name, part in self._actors.numbers.items()
                    }
                )
                learned = self._learned(after)
                replay.add(before, actions, learned)
                self._measure(learned)
                if after.ended:
                    ends = after.next_state, after.next_observations, after.next_masks
                    replay.end(self._joined(*ends))
                for name in rewards:
                    rewards[name] += after.mean_rewards[name].mean()
            together = torch.cat(situations)
            self._moments.add(together[:, self._plain])
            for name, moments in self._unit_moments.items():
                rows = together[:, self._columns[name]].reshape(-1, len(moments.mean))
                if self._spaces[name].has_mask:
                    rows = rows[together[:, self._columns[_mask_of(name)]].flatten() > 0]
                moments.add(rows)
        steps = self._settings.rollout_decisions * self._settings.decision_steps
        logged = {f"reward/{n}": float(x) / steps for n, x in rewards.items()}
        return logged if self._soft else logged | {"exploration": self.exploration}

    def _learned(self, after: StreamStep) -> Tensor:
        """Return the rewards that the critics learn, (B, Z): of each learner, or of the team."""
        if not self._own_share:
            return after.team[:, None]
        return torch.stack(
            [
                learned_rewards(after.mean_rewards[name], after.team, self._own_share)
                for name in self._spaces
            ],
            dim=1,
        )

    def _measure(self, rewards: Tensor) -> None:
        """Update the running moments of rewards and returns with the rewards of a step, (B, Z)."""
        self._rewards.add(rewards)
        if not len(self._running_return):
            self._running_return = torch.zeros_like(rewards)
        above = rewards - self._rewards.mean.float()
        self._running_return = self._settings.discount * self._running_return + above
        self._returns.add(self._running_return)

    def _situation(self, columns: Tensor) -> Situation:
        """Split the columns from ``_joined``, (N, width), and normalise states and observations."""
        normal = self._moments.normalise(columns[:, self._plain])
        observations, masks = {}, {}
        for name, of in self._spaces.items():
            part = self._columns[name]
            if name not in self._unit_moments:
                observations[name] = normal[:, part]
                continue
            rows = columns[:, part].reshape(-1, of.observation_width)
            observations[name] = self._unit_moments[name].normalise(rows)
            if of.has_mask:
                masks[name] = columns[:, self._columns[_mask_of(name)]] > 0
        return Situation(normal[:, self._columns[STATE]], observations, masks)

    def _joined(
        self, state: Tensor, observations: Mapping[str, Tensor], masks: Mapping[str, Tensor]
    ) -> Tensor:
        """Concatenate shared states, observations and masks of each environment, (B, width)."""
        parts = {STATE: state, **observations}
        parts |= {_mask_of(name): mask.float() for name, mask in masks.items()}
        return torch.cat([parts[name].reshape(len(state), -1) for name in self._columns], 1)

    # Learning

    def _anneal(self) -> None:
        """Lower the learning rate linearly, from its initial value to 0 during the training."""
        if self._settings.anneal:
            rate = self._settings.rate * max(0.0, 1.0 - self._done / self._updates)
            for optimiser in (self._adam, *self._actors.adams.values()):
                optimiser.rate = rate

    def _learn(self, replay: Replay) -> dict[str, Tensor]:
        """Take a gradient step of the critics and of each learner, and update the target critics.

        Return the losses, entropies and temperatures to log.
        """
        s = self._settings
        drawn = replay.sample(s.batch_size, self._generators["batches"])
        before, after = self._situation(drawn.before), self._situation(drawn.after)
        with torch.no_grad():
            targets = self._critic_targets(drawn, after)
        loss = critic_loss(self._critic.of_actions(before.state, drawn.actions), targets)
        self._adam.descend(loss)
        logged = self._actors.improve(before, self._generators["order"])
        self._targets.lerp_(self._critic.weights.detach(), s.target_rate)
        return {"critic_loss": loss.detach(), **logged}

    def _critic_targets(self, drawn: Transitions, after: Situation) -> Tensor:
        """Return the targets y of the critics, (Z, N).

        The mean reward is subtracted from every reward; this changes no optimal policy because
        episodes never terminate. The returns are then divided by the standard deviation of
        discounted returns, so that values are of order one for any reward.
        """
        discount = self._settings.discount
        later = discount**drawn.steps
        terms = (1.0 - later) / (1.0 - discount) if discount < 1.0 else drawn.steps
        scale = self._returns.variance.sqrt().clamp_min(LEAST_SCALE).float()
        means = self._rewards.mean.float()[:, None]
        returns = (drawn.returns - terms * means) / scale[:, None]
        generator = self._generators["order"]
        return returns + later * self._actors.next_values(self._targets, after, generator)


def critic_loss(values: Tensor, targets: Tensor) -> Tensor:
    """Return half the mean squared error of the values, summed over the critics.

    Args:
        values: values of N transitions, (Z E, N), of E critics of each of Z rewards.
        targets: targets of each reward, (Z, N).
    """
    errors = values.unflatten(0, (len(targets), -1)) - targets[:, None]
    return 0.5 * errors.square().mean(-1).sum()


def _columns(spaces: Mapping[str, LearnerSpaces], state_width: int) -> dict[str, slice]:
    """Return the columns of the shared state and of each learner when concatenated.

    Those of learners with rows, which have moments of their own, and then the masks, come last.
    """
    plain = {n: x.observation_width for n, x in spaces.items() if not _has_rows(x)}
    rows = {n: x.observation_width * x.count for n, x in spaces.items() if _has_rows(x)}
    masks = {_mask_of(n): x.count for n, x in spaces.items() if x.has_mask}
    widths = {STATE: state_width, **plain, **rows, **masks}
    ends = accumulate(widths.values())
    return {
        n: slice(end - width, end) for (n, width), end in zip(widths.items(), ends, strict=True)
    }


def _has_rows(of: LearnerSpaces) -> bool:
    """Return True if several agents share a policy, or agents may be without effect."""
    return of.count > 1 or of.has_mask


def _mask_of(learner: str) -> str:
    """Return the name of the columns with the mask of a learner."""
    return f"mask/{learner}"


def _numbers(spaces: Mapping[str, LearnerSpaces]) -> int:
    """Return the number of actions of all learners in an environment, K."""
    return sum(of.action_width * of.count for of in spaces.values())


def _critic_and_actors(
    definition: OffPolicyDefinition,
    settings: OffPolicySettings,
    spaces: Mapping[str, LearnerSpaces],
    state_width: int,
    rewards: int,
    generator: torch.Generator,
) -> tuple[JointValues | ContinuousValues, GreedyActors | SoftActors | GaussianActors]:
    """Return the critics of each of Z rewards, and the policies that learn from them."""
    shape = rewards * definition.critics, state_width, _numbers(spaces), settings, generator
    levels = next(iter(spaces.values())).choices
    if levels is not None:
        table = JointValues(*shape, levels)
        kind = SoftActors if definition.soft else GreedyActors
        return table, kind(table, spaces, settings, rewards, generator)
    if not definition.soft:
        raise ConfigError(
            "had3qn: learns choices alone; valid is discrete actions, or levels of continuous ones"
        )
    critic = ContinuousValues(*shape)
    return critic, GaussianActors(critic, spaces, settings, rewards, generator)


class Transitions(NamedTuple):
    """Batch of N multi-step transitions; each spans one or more steps."""

    before: Tensor
    """Shared states and observations before the first step, (N, width)."""
    actions: Tensor
    """Actions of the first step, (N, actions)."""
    returns: Tensor
    """Discounted sums of each of the Z rewards of a transition's steps, (Z, N)."""
    steps: Tensor
    """Number of steps of each transition, at least 1, (N,)."""
    after: Tensor
    """Shared states and observations after the last step, (N, width)."""


class Replay:
    """Replay buffer with the latest steps of B environments, whose episodes end together.

    A situation is the shared state and the observations of one environment at one time. A row of
    the buffer holds the situations of all environments before a step, with the actions and rewards
    of the step. The end of an episode has a further row without actions. The row after a step
    therefore always holds the situations that followed the step.

    Args:
        size: capacity in situations, summed over all environments.
        num_envs: number of environments, B.
        width: number of entries of a situation.
        actions: number of actions in each step.
        rewards: number of rewards in each step, Z.
        steps: maximum number n of steps of a transition.
        discount: discount factor per step.

    Attributes:
        rows: capacity in rows.
        num_envs: number of environments, B.

    Raises:
        ConfigError: the buffer is too small for a transition of n steps.
    """

    def __init__(
        self,
        size: int,
        num_envs: int,
        width: int,
        actions: int,
        rewards: int = 1,
        *,
        steps: int,
        discount: float,
    ) -> None:
        self.rows, self.num_envs = size // num_envs, num_envs
        least = steps + 2
        if self.rows < least:
            raise ConfigError(
                f"learning.replay_size {size}: holds {self.rows} steps of {num_envs} data centers; "
                f"valid is at least {least * num_envs}"
            )
        self._width, self._paid, self._steps, self._discount = (
            width,
            width + actions,
            steps,
            discount,
        )
        # Situation, actions and rewards are adjacent in memory, so that a draw makes one access.
        self._data = torch.empty(self.rows, num_envs, self._paid + rewards)
        self._is_end = torch.zeros(self.rows, dtype=torch.bool)
        self._count = 0
        self._starts: Tensor | None = None
        self._spans = torch.empty(0, dtype=torch.int64)

    @property
    def filled(self) -> int:
        """Number of rows in use."""
        return min(self._count, self.rows)

    def add(self, situations: Tensor, actions: Tensor, rewards: Tensor) -> None:
        """Append one step of all environments.

        Args:
            situations: situations before the step, (B, width).
            actions: actions of the step, (B, actions).
            rewards: rewards of the step, (B, Z).
        """
        row = self._next_row(is_end=False)
        row[:, : self._width] = situations
        row[:, self._width : self._paid] = actions
        row[:, self._paid :] = rewards

    def end(self, situations: Tensor) -> None:
        """Append the situations at the end of the episodes, (B, width)."""
        row = self._next_row(is_end=True)
        row[:, : self._width] = situations
        row[:, self._width :] = 0.0

    def sample(self, number: int, generator: torch.Generator) -> Transitions:
        """Draw transitions uniformly at random.

        A transition is shorter than n steps if the episode or the recorded data end earlier.

        Args:
            number: number of transitions, N.
            generator: random generator of the draws.

        Raises:
            SdcError: the buffer does not contain a transition yet.
        """
        if self._starts is None:
            self._starts = self._find_starts()
        draws = torch.randint(
            len(self._starts) * self.num_envs, (number,), generator=generator, dtype=torch.int64
        )
        at = self._starts[draws // self.num_envs]
        environment = draws % self.num_envs
        span = self._spans[at]
        data = self._data.view(-1, self._data.shape[-1])
        first = data.index_select(0, at * self.num_envs + environment)
        later = (at + span) % self.rows * self.num_envs + environment
        after = data.index_select(0, later)[:, : self._width]
        returns = first[:, self._paid :].T.clone()
        for step in range(1, self._steps):
            row = (at + step) % self.rows
            rewards = data[row * self.num_envs + environment, self._paid :].T
            returns += torch.where(step < span, self._discount**step * rewards, 0.0)
        return Transitions(
            first[:, : self._width], first[:, self._width : self._paid], returns, span, after
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the content of the buffer, for ``load_state_dict``."""
        return {
            "data": self._data[: self.filled],
            "is_end": self._is_end[: self.filled],
            "count": self._count,
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore the content that ``state_dict`` of a buffer with the same arguments returned.

        Raises:
            SdcError: the saved content has a different shape.
        """
        data = torch.as_tensor(values["data"])
        filled = min(int(values["count"]), self.rows)
        expected = (filled, *self._data.shape[1:])
        if tuple(data.shape) != expected:
            raise SdcError(f"state: replay is {tuple(data.shape)}; valid is {expected}")
        self._count = int(values["count"])
        self._data[:filled] = data
        self._is_end[:filled] = torch.as_tensor(values["is_end"])
        self._starts = None

    def _next_row(self, *, is_end: bool) -> Tensor:
        """Return a view of the next row to write, (B, columns); the oldest row is overwritten."""
        at = self._count % self.rows
        self._is_end[at] = is_end
        self._count += 1
        self._starts = None
        return self._data[at]

    def _find_starts(self) -> Tensor:
        """Return the rows in which transitions can start; set the transition length of each row."""
        in_time = torch.arange(self._count - self.filled, self._count)
        stops = self._is_end[in_time % self.rows].clone()
        stops[-1] = True
        after_all = len(in_time)
        next_stop = torch.where(stops, torch.arange(after_all), after_all)
        next_stop = next_stop.flip(0).cummin(0).values.flip(0)
        spans = (next_stop - torch.arange(after_all)).clamp_max(self._steps)
        self._spans = torch.zeros(self.rows, dtype=torch.int64)
        self._spans[in_time % self.rows] = spans
        starts = (in_time % self.rows)[~stops]
        if not len(starts):
            raise SdcError("replay: no transitions yet; valid is after two steps")
        return starts
