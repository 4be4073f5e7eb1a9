"""The on-policy algorithms PPO, IPPO, MAPPO, HAPPO and HAA2C, as special cases of one update.

All agents act for some steps with fixed policies. Then each learner i maximises, by Adam,

    M_i min(r_i A_i, clip(r_i, 1 - eps, 1 + eps) A_i) + c * entropy

where r_i is the ratio of an action's probability under the new policy to that under the old policy,
A_i is the generalised advantage estimate (Schulman et al. 2016) from a critic, and c is the weight
of the entropy. The algorithms differ in the input and the reward of the critic, in M_i, and in
clipping:

- ``ppo`` (Schulman et al. 2017) has one learner, and ``ippo`` (de Witt et al. 2020) has several.
  Each learner has a critic, which takes its observation and learns its reward. M_i is 1.
- ``mappo`` (Yu et al. 2022) has one critic, which takes the shared state and learns the reward of
  the team. M_i is 1. With own rewards each learner has a critic of the shared state.
- ``happo`` (Kuba et al. 2022; Zhong et al. 2024) has the critic of ``mappo``. Learners are updated
  one after another in random order, and M_i is the product of the ratios r_j of the learners j that
  are already updated.
- ``haa2c`` (Zhong et al. 2024) is ``happo`` without clipping, with a single pass over the steps.

Each agent of a group that shares a policy is a row of one learner. A critic that takes the shared
state therefore has the same value for all agents of a group. In M_i, the ratio of such a learner is
the product over its agents. Steps in which an agent is without effect, because its CRAC unit is
down, are left out of all losses and moments, and their ratio is 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from sdc_taichi.learning.algorithms import OnPolicyDefinition, OnPolicySettings, own_share
from sdc_taichi.learning.networks import (
    Actor,
    RunningMoments,
    generators,
    layers_of,
    perceptron,
    policy_network,
)
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.stream import EnvironmentStream, learned_rewards

TEAM = "team"
"""Name of the critic that learns the reward of the team."""
ADAM_EPSILON = 1e-5


class _Critic(NamedTuple):
    """A critic with its optimiser and the running moments of its inputs and returns."""

    net: nn.Sequential
    adam: torch.optim.Adam
    inputs: RunningMoments
    returns: RunningMoments


class _Rollout(NamedTuple):
    """T decisions of B environments under fixed policies.

    Tensors of a learner have shape (T, R, ...), with its R rows; all others (T, B, ...).
    """

    observations: dict[str, Tensor]
    next_observations: dict[str, Tensor]
    state: Tensor
    next_state: Tensor
    actions: dict[str, Tensor]
    log_p: dict[str, Tensor]
    rewards: dict[str, Tensor]
    mean_rewards: dict[str, Tensor]
    masks: dict[str, Tensor]
    team: Tensor
    ended: Tensor

    def acting(self, learner: str) -> Tensor | None:
        """Return the indices of the rows, of T R, whose agents act; None if all agents act."""
        mask = self.masks.get(learner)
        return None if mask is None or mask.all() else mask.flatten().nonzero().squeeze(-1)

    def teaches(self, learner: str) -> bool:
        """Return True if agents of a learner act in at least two rows."""
        acting = self.acting(learner)
        return acting is None or len(acting) > 1


class OnPolicy:
    """On-policy algorithm: learners that are updated from the steps of their current policies.

    Args:
        definition: properties in which the on-policy algorithms differ.
        settings: settings of the algorithm.
        stream: the environments to learn in.
        updates: total number of updates of the training; sets the schedule of the learning rate.
        seed: seed of weights, actions, order of learners and mini-batches.
    """

    def __init__(
        self,
        definition: OnPolicyDefinition,
        settings: OnPolicySettings,
        stream: EnvironmentStream,
        *,
        updates: int,
        seed: int,
    ) -> None:
        self._settings, self._spaces, self._updates = settings, stream.spaces, updates
        self._definition = definition._replace(critic=settings.critic or definition.critic)
        self._own_share = own_share(settings.reward, definition.reward)
        self._done = 0
        self._generators = generators(seed)
        self._actors: dict[str, Actor] = {}
        self._adams: dict[str, torch.optim.Adam] = {}
        self._moments: dict[str, RunningMoments] = {}
        for name, of in self._spaces.items():
            self._actors[name] = actor = Actor(of, settings, self._generators["weights"])
            self._adams[name] = self._adam(actor)
            self._moments[name] = RunningMoments(of.observation_width)
        self._critics = self._make_critics(stream.state_width)

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Act for ``rollout_decisions`` decisions, and learn from them.

        The first update only measures mean and variance of the observations.

        Args:
            stream: the environments.

        Returns:
            Values to log: ``reward/NAME``, the mean reward per step; losses; entropies.
        """
        rollout = self._collect(stream)
        steps = self._settings.decision_steps
        rewards = rollout.mean_rewards
        logged = {f"reward/{name}": float(r.mean()) / steps for name, r in rewards.items()}
        self._done += 1
        if self._done > 1:
            self._anneal()
            logged |= self._learn(rollout)
        for name, moments in self._moments.items():
            moments.add(_rows(rollout.observations[name].flatten(0, 1), rollout.acting(name)))
        for name, critic in self._critics.items():
            inputs = self._critic_inputs(name, rollout)[0].flatten(0, 1)
            critic.inputs.add(_rows(inputs, rollout.acting(name)))
        return logged

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """Return the networks of the current policies."""
        activation = self._settings.activation
        return tuple(
            policy_network(
                layers_of(self._actors[name].net),
                self._moments[name].mean.float().numpy(),
                self._moments[name].std.numpy(),
                of,
                activation,
            )
            for name, of in self._spaces.items()
        )

    def state_dict(self) -> dict[str, Any]:
        """Return the complete state, from which a training continues with identical results."""
        return {
            "done": self._done,
            "generators": {n: g.get_state() for n, g in self._generators.items()},
            "learners": {
                name: {
                    "actor": self._actors[name].state_dict(),
                    "adam": self._adams[name].state_dict(),
                    "moments": self._moments[name].state_dict(),
                }
                for name in self._spaces
            },
            "critics": {
                name: {part: getattr(critic, part).state_dict() for part in critic._fields}
                for name, critic in self._critics.items()
            },
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore a state from ``state_dict`` of an algorithm with the same arguments."""
        self._done = int(values["done"])
        for name, generator in self._generators.items():
            generator.set_state(values["generators"][name])
        for name, of in values["learners"].items():
            self._actors[name].load_state_dict(of["actor"])
            self._adams[name].load_state_dict(of["adam"])
            self._moments[name].load_state_dict(of["moments"])
        for name, of in values["critics"].items():
            for part in self._critics[name]._fields:
                getattr(self._critics[name], part).load_state_dict(of[part])

    # Acting

    def _collect(self, stream: EnvironmentStream) -> _Rollout:
        """Act with the current policies for ``rollout_decisions`` decisions."""
        decisions = []
        with torch.no_grad():
            for _ in range(self._settings.rollout_decisions):
                state, observations, masks = stream.state, stream.observations, stream.masks
                drawn = {
                    name: actor.sample(
                        self._moments[name].normalise(observations[name]),
                        self._generators["actions"],
                    )
                    for name, actor in self._actors.items()
                }
                actions = {name: actions for name, (actions, _) in drawn.items()}
                after = stream.step({n: _within_space(values) for n, values in actions.items()})
                decisions.append(
                    _Rollout(
                        observations=observations,
                        next_observations=after.next_observations,
                        state=state,
                        next_state=after.next_state,
                        actions=actions,
                        log_p={name: log_p for name, (_, log_p) in drawn.items()},
                        rewards=after.rewards,
                        mean_rewards=after.mean_rewards,
                        masks=masks,
                        team=after.team,
                        ended=torch.tensor(float(after.ended)),
                    )
                )
        return _Rollout(*(_stacked(values) for values in zip(*decisions, strict=True)))

    # Learning

    def _learn(self, rollout: _Rollout) -> dict[str, float]:
        """Update each critic and then each policy from a rollout; return the values to log."""
        logged: dict[str, float] = {}
        advantages: dict[str, Tensor] = {}
        # A learner none of whose agents acts, because all their units are down, learns nothing.
        learners = [name for name in self._spaces if rollout.teaches(name)]
        for name in self._critics:
            if not rollout.teaches(name):
                continue
            advantages[name], targets = self._advantages(name, rollout)
            logged[f"value_loss/{name}"] = self._learn_values(name, rollout, targets)
        order = range(len(learners))
        if self._definition.sequential and len(learners) > 1:
            order = torch.randperm(len(learners), generator=self._generators["order"]).tolist()
        weight: Tensor | None = None
        for i in order:
            name = learners[i]
            count = self._spaces[name].count
            if TEAM in advantages:
                weighted = advantages[TEAM].repeat_interleave(count)
            else:
                weighted = advantages[name]
            if weight is not None:
                weighted = weighted * weight.repeat_interleave(count)
            logged |= self._learn_policy(name, rollout, weighted)
            if self._definition.sequential and len(learners) > 1:
                ratio = self._ratio(name, rollout)
                weight = ratio if weight is None else weight * ratio
        return logged

    def _advantages(self, critic: str, rollout: _Rollout) -> tuple[Tensor, Tensor]:
        """Return normalised advantages and normalised target returns, (T * R,) each.

        At the end of a truncated episode, the critic's value of the final situation stands for the
        later rewards. Rewards of the next episode are not included.
        """
        s, of = self._settings, self._critics[critic]
        now, after = self._critic_inputs(critic, rollout)
        mean, std = of.returns.mean.float(), of.returns.std
        with torch.no_grad():
            values = of.net(of.inputs.normalise(now)).squeeze(-1) * std + mean
            next_values = torch.empty_like(values)
            next_values[:-1] = values[1:]
            at_ends = rollout.ended.bool()
            at_ends[-1] = True
            ends = of.inputs.normalise(after[at_ends])
            next_values[at_ends] = of.net(ends).squeeze(-1) * std + mean
        advantages = generalised_advantages(
            self._rewards_of(critic, rollout),
            values,
            next_values,
            rollout.ended,
            discount=s.discount,
            gae_lambda=s.gae_lambda,
        )
        targets, acting = (advantages + values).flatten(), rollout.acting(critic)
        self._rescale(of, _rows(targets, acting))
        flat = advantages.flatten()
        counted = _rows(flat, acting)
        normal = (flat - counted.mean()) / (counted.std() + 1e-8)
        return normal, (targets - of.returns.mean.float()) / of.returns.std

    def _rescale(self, critic: _Critic, targets: Tensor) -> None:
        """Update the moments of returns; adapt the critic's last layer so that its values stay.

        The method is Pop-Art (van Hasselt et al. 2016).
        """
        mean, std = critic.returns.mean.float(), critic.returns.std
        critic.returns.add(targets.unsqueeze(-1))
        last = critic.net[-1]
        assert isinstance(last, nn.Linear)
        new_mean, new_std = critic.returns.mean.float(), critic.returns.std
        with torch.no_grad():
            last.weight.mul_(std / new_std)
            last.bias.mul_(std).add_(mean - new_mean).div_(new_std)

    def _learn_values(self, name: str, rollout: _Rollout, targets: Tensor) -> float:
        """Fit a critic to target returns, and return the mean loss."""
        critic, acting = self._critics[name], rollout.acting(name)
        inputs = _rows(self._critic_inputs(name, rollout)[0].flatten(0, 1), acting)
        inputs, targets = critic.inputs.normalise(inputs), _rows(targets, acting)
        total = 0.0
        batches = self._batches(len(targets))
        for batch in batches:
            values = critic.net(inputs.index_select(0, batch)).squeeze(-1)
            loss = value_loss(values, targets[batch])
            self._descend(loss, critic.net, critic.adam)
            total += float(loss.detach())
        return total / len(batches)

    def _learn_policy(self, name: str, rollout: _Rollout, weighted: Tensor) -> dict[str, float]:
        """Update a policy by the weighted advantages, and return the mean loss and entropy."""
        actor, adam, acting = self._actors[name], self._adams[name], rollout.acting(name)
        observations = _rows(rollout.observations[name].flatten(0, 1), acting)
        inputs = self._moments[name].normalise(observations)
        actions = _rows(rollout.actions[name].flatten(0, 1), acting)
        old_log_p = _rows(rollout.log_p[name].flatten(), acting)
        weighted = _rows(weighted, acting)
        clip = self._settings.clip if self._definition.clips else None
        totals = torch.zeros(2)
        batches = self._batches(len(actions))
        for batch in batches:
            rows = inputs.index_select(0, batch), actions.index_select(0, batch)
            log_p, entropy = actor.evaluate(*rows)
            ratio = (log_p - old_log_p[batch]).exp()
            loss = policy_loss(ratio, weighted[batch], clip)
            self._descend(loss - self._settings.entropy * entropy, actor, adam)
            totals += torch.stack([loss.detach(), entropy.detach()])
        loss_mean, entropy_mean = (totals / len(batches)).tolist()
        return {f"policy_loss/{name}": loss_mean, f"entropy/{name}": entropy_mean}

    def _ratio(self, name: str, rollout: _Rollout) -> Tensor:
        """Return the ratio of the new to the old probability of the learner's actions, (T * B,)."""
        inputs = self._moments[name].normalise(rollout.observations[name].flatten(0, 1))
        with torch.no_grad():
            log_p, _ = self._actors[name].evaluate(inputs, rollout.actions[name].flatten(0, 1))
        ratio = (log_p - rollout.log_p[name].flatten()).exp()
        mask, count = rollout.masks.get(name), self._spaces[name].count
        if mask is not None:
            ratio = torch.where(mask.flatten(), ratio, 1.0)
        return ratio if count == 1 else ratio.view(-1, count).prod(1)

    def _critic_inputs(self, critic: str, rollout: _Rollout) -> tuple[Tensor, Tensor]:
        """Return the inputs of a critic before and after each decision, (T, R, n) each."""
        if self._definition.critic == "state":
            state, next_state = rollout.state, rollout.next_state
            return self._of_rows(critic, state), self._of_rows(critic, next_state)
        return rollout.observations[critic], rollout.next_observations[critic]

    def _rewards_of(self, critic: str, rollout: _Rollout) -> Tensor:
        """Return the rewards that a critic learns, (T, R)."""
        team = self._of_rows(critic, rollout.team)
        return learned_rewards(rollout.rewards.get(critic, team), team, self._own_share)

    def _of_rows(self, critic: str, of_environments: Tensor) -> Tensor:
        """Repeat values of environments, (T, B, ...), for each row of a critic, (T, R, ...)."""
        count = 1 if critic == TEAM else self._spaces[critic].count
        return of_environments if count == 1 else of_environments.repeat_interleave(count, dim=1)

    def _batches(self, rows: int) -> list[Tensor]:
        """Return the row indices of each mini-batch, over all passes."""
        s = self._settings
        if not self._definition.clips:
            # Without clipping, the collected steps are valid for only one gradient step.
            return [torch.arange(rows)]
        generator = self._generators["batches"]
        orders = [torch.randperm(rows, generator=generator) for _ in range(s.epochs)]
        return [batch for order in orders for batch in order.chunk(s.mini_batches)]

    def _descend(self, loss: Tensor, net: nn.Module, adam: torch.optim.Adam) -> None:
        adam.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), self._settings.gradient_norm)
        adam.step()

    def _anneal(self) -> None:
        """Lower the learning rate linearly, from its initial value to 0 during the training."""
        if not self._settings.anneal:
            return
        left = max(1.0 - (self._done - 1) / max(self._updates, 1), 0.0)
        for adam in (*self._adams.values(), *(c.adam for c in self._critics.values())):
            adam.param_groups[0]["lr"] = self._settings.rate * left

    def _make_critics(self, state_width: int) -> dict[str, _Critic]:
        """Create a critic for each learner, or a single critic for the team."""
        shared = self._definition.critic == "state"
        names = [TEAM] if not self._own_share and shared else list(self._spaces)
        critics = {}
        for name in names:
            width = state_width if shared else self._spaces[name].observation_width
            net = perceptron(
                width,
                self._settings.hidden,
                1,
                activation=self._settings.activation,
                last_gain=1.0,
                generator=self._generators["weights"],
            )
            moments = RunningMoments(width), RunningMoments(1)
            critics[name] = _Critic(net, self._adam(net), *moments)
        return critics

    def _adam(self, net: nn.Module) -> torch.optim.Adam:
        rate = self._settings.rate
        return torch.optim.Adam(net.parameters(), rate, eps=ADAM_EPSILON, fused=True)


def generalised_advantages(
    rewards: Tensor,
    values: Tensor,
    next_values: Tensor,
    ended: Tensor,
    *,
    discount: float,
    gae_lambda: float,
) -> Tensor:
    """Return generalised advantage estimates (Schulman et al. 2016, eq. 16), (T, B).

    Args:
        rewards: rewards, (T, B).
        values: values before each step, (T, B).
        next_values: values after each step, within the same episode, (T, B).
        ended: 1 if the episodes were truncated after the step, else 0, (T,).
        discount: discount factor gamma per step.
        gae_lambda: parameter lambda of the estimator.
    """
    errors = rewards + discount * next_values - values
    advantages = torch.empty_like(rewards)
    later = torch.zeros_like(rewards[0])
    for t in range(len(rewards) - 1, -1, -1):
        later = errors[t] + discount * gae_lambda * (1.0 - ended[t]) * later
        advantages[t] = later
    return advantages


def policy_loss(ratio: Tensor, advantages: Tensor, clip: float | None) -> Tensor:
    """Return the negative surrogate objective of a policy (Schulman et al. 2017, eq. 7).

    Args:
        ratio: ratio of each action's probability under the new policy to that under the old policy,
            (n,).
        advantages: advantage of each action, (n,).
        clip: clipping range of the ratio; None does not clip.
    """
    gain = ratio * advantages
    if clip is not None:
        gain = torch.minimum(gain, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages)
    return -gain.mean()


def value_loss(values: Tensor, targets: Tensor) -> Tensor:
    """Return half the mean squared error of n values, shape ()."""
    return 0.5 * (values - targets).square().mean()


def _rows(values: Tensor, chosen: Tensor | None) -> Tensor:
    """Return the chosen rows of a tensor; all rows if ``chosen`` is None."""
    return values if chosen is None else values.index_select(0, chosen)


def _stacked(values: Sequence[Any]) -> Any:
    """Stack the tensors of T decisions, (T, ...); dicts of tensors are stacked by name."""
    if isinstance(values[0], dict):
        return {name: torch.stack([value[name] for value in values]) for name in values[0]}
    return torch.stack(list(values))


def _within_space(actions: Tensor) -> Tensor:
    """Clip continuous actions to -1..1; discrete choices are unchanged."""
    return actions if actions.dtype == torch.int64 else actions.clamp(-1.0, 1.0)
