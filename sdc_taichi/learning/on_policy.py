"""The on-policy algorithms PPO, IPPO, MAPPO, HAPPO and HAA2C, as special cases of one update.

All agents act for some steps with fixed policies. Then each learner i maximises, by Adam,

    M_i min(r_i A_i, clip(r_i, 1 - eps, 1 + eps) A_i) + c * entropy

where r_i is the ratio of an action's probability under the new policy to that under the old policy,
A_i is the generalised advantage estimate (Schulman et al. 2016) from a critic, and c is the weight
of the entropy. The algorithms differ in the input and the reward of the critic, in M_i, and in
clipping:

- ``ppo`` (Schulman et al. 2017) has one learner, and ``ippo`` (de Witt et al. 2020) has several.
  Each learner has a critic, which takes its observation and learns its reward. M_i is 1.
- ``mappo`` (Yu et al. 2022) has a critic for each learner, which takes the shared state and learns
  the reward of the learner. M_i is 1.
- ``happo`` (Kuba et al. 2022; Zhong et al. 2024) has the critics of ``mappo``. Learners are updated
  one after another in random order, and M_i is the product of the ratios r_j of the learners j that
  are already updated.
- ``haa2c`` (Zhong et al. 2024) is ``happo`` without clipping, with a single pass over the steps.

In the publications of the last three, one critic learns the reward of the team, as here with
setting ``reward=team``. The proof that no update of ``happo`` makes the team worse holds for that
reward alone.

Each agent of a group that shares a policy is a row of one learner. A critic that takes the shared
state therefore has the same value for all agents of a group. In M_i, the ratio of such a learner is
the product over its agents. Steps in which an agent is without effect, because its CRAC unit is
down, are left out of all losses and moments, and their ratio is 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sdc_taichi.learning.algorithms import OnPolicyDefinition, OnPolicySettings, own_share
from sdc_taichi.learning.networks import (
    Actor,
    Adam,
    Perceptrons,
    RunningMoments,
    generators,
    layers_of,
    policy_network,
)
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.stream import EnvironmentStream, learned_rewards

TEAM = "team"
"""Name of the critic that learns the reward of the team."""
ADAM_EPSILON = 1e-5
_SAVED = ("adam", "inputs", "returns")
"""Parts of a critic that checkpoints contain; the optimiser's state includes the weights."""


class _Critic(NamedTuple):
    """A critic with its optimiser and the running moments of its inputs and returns."""

    net: Perceptrons
    adam: Adam
    inputs: RunningMoments
    returns: RunningMoments


class _Rollout(NamedTuple):
    """T decisions of B environments under fixed policies, F of which are the last of an episode.

    The last decision of the rollout counts among the F. Tensors of a learner have shape (T, R, n),
    with its R rows; all others (T, B, ...). Those of the F final situations have F in place of T.
    """

    observations: dict[str, Tensor]
    state: Tensor
    actions: dict[str, Tensor]
    log_p: dict[str, Tensor]
    rewards: dict[str, Tensor]
    mean_rewards: dict[str, Tensor]
    masks: dict[str, Tensor]
    team: Tensor
    ended: Tensor
    final_observations: dict[str, Tensor]
    final_state: Tensor

    def acting(self, learner: str) -> Tensor | None:
        """Return the indices of the rows, of T R, whose agents act; None if all agents act."""
        mask = self.masks.get(learner)
        return None if mask is None or mask.all() else mask.flatten().nonzero().squeeze(-1)

    def acting_rows(self, learner: str) -> int:
        """Return the number of rows whose agents act."""
        acting = self.acting(learner)
        return self.actions[learner].shape[:2].numel() if acting is None else len(acting)

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
        threads: maximum number of networks that are updated at the same time.
    """

    def __init__(
        self,
        definition: OnPolicyDefinition,
        settings: OnPolicySettings,
        stream: EnvironmentStream,
        *,
        updates: int,
        seed: int,
        threads: int = 1,
    ) -> None:
        self._settings, self._spaces, self._updates = settings, stream.spaces, updates
        self._threads = threads
        self._definition = definition._replace(critic=settings.critic or definition.critic)
        self._own_share = own_share(
            settings.reward,
            definition.reward,
            shared_policy=self._definition.critic == "state"
            and any(of.count > 1 for of in self._spaces.values()),
        )
        self._done = 0
        self._generators = generators(seed)
        self._actors: dict[str, Actor] = {}
        self._adams: dict[str, Adam] = {}
        self._moments: dict[str, RunningMoments] = {}
        for name, of in self._spaces.items():
            self._actors[name] = actor = Actor(of, settings, self._generators["weights"])
            self._adams[name] = self._adam(actor.net)
            self._moments[name] = RunningMoments(of.observation_width)
        self._critics = self._make_critics(stream.state_width)

    def update(self, stream: EnvironmentStream) -> dict[str, float]:
        """Act for ``rollout_decisions`` decisions, and learn from them.

        The first update only measures mean and variance of the observations.

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
        seen = [(m, name, rollout.observations[name]) for name, m in self._moments.items()]
        if self._definition.critic == "state":
            state = rollout.state
            seen += [(c.inputs, n, self._of_rows(n, state)) for n, c in self._critics.items()]
        for moments, name, inputs in seen:
            moments.add(*_rows((inputs.flatten(0, 1),), rollout.acting(name)))
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
                name: {"actor": adam.state_dict(), "moments": self._moments[name].state_dict()}
                for name, adam in self._adams.items()
            },
            "critics": {
                name: {part: getattr(critic, part).state_dict() for part in _SAVED}
                for name, critic in self._critics.items()
            },
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore a state from ``state_dict`` of an algorithm with the same arguments."""
        self._done = int(values["done"])
        for name, generator in self._generators.items():
            generator.set_state(values["generators"][name])
        for name, of in values["learners"].items():
            self._adams[name].load_state_dict(of["actor"])
            self._moments[name].load_state_dict(of["moments"])
        for name, of in values["critics"].items():
            for part in _SAVED:
                getattr(self._critics[name], part).load_state_dict(of[part])

    # Acting

    def _collect(self, stream: EnvironmentStream) -> _Rollout:
        """Act with the current policies for ``rollout_decisions`` decisions."""
        decisions, finals = [], []
        for left in range(self._settings.rollout_decisions - 1, -1, -1):
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
                {
                    "observations": observations,
                    "state": state,
                    "actions": actions,
                    "log_p": {name: log_p for name, (_, log_p) in drawn.items()},
                    "rewards": after.rewards,
                    "mean_rewards": after.mean_rewards,
                    "masks": masks,
                    "team": after.team,
                    "ended": torch.tensor(float(after.ended)),
                }
            )
            if after.ended or not left:
                finals.append(
                    {
                        "final_observations": after.next_observations,
                        "final_state": after.next_state,
                    }
                )
        return _Rollout(**_stacked(decisions), **_stacked(finals))

    # Learning

    def _learn(self, rollout: _Rollout) -> dict[str, float]:
        """Update all critics and policies from a rollout, and return the values to log.

        Networks that do not wait for each other are updated in parallel threads. Their number does
        not change the result, because each network is updated in one thread.
        """
        # A learner none of whose agents acts, because all their units are down, learns nothing.
        learners = [name for name in self._spaces if rollout.teaches(name)]
        if self._definition.sequential and len(learners) > 1:
            order = torch.randperm(len(learners), generator=self._generators["order"])
            learners = [learners[i] for i in order.tolist()]
        inputs = {
            name: self._moments[name].normalise(rollout.observations[name].flatten(0, 1))
            for name in learners
        }
        jobs: list[Callable[[], dict[str, float]]] = []
        advantages: dict[str, Tensor] = {}
        for name in self._critics:
            if not rollout.teaches(name):
                continue
            of_critic = self._critic_inputs(name, rollout, inputs)
            advantages[name], targets = self._advantages(name, rollout, of_critic)
            rows = _rows((of_critic, targets), rollout.acting(name))
            jobs.append(partial(self._learn_values, name, rows, self._batches(len(rows[0]))))
        groups = [learners] if self._definition.sequential else [[name] for name in learners]
        for names in groups:
            batches = [self._batches(rollout.acting_rows(name)) for name in names]
            jobs.append(partial(self._learn_policies, names, rollout, inputs, advantages, batches))
        logged: dict[str, float] = {}
        with ThreadPoolExecutor(self._threads) as pool:
            for values in pool.map(lambda job: job(), jobs):
                logged |= values
        return logged

    def _critic_inputs(
        self, critic: str, rollout: _Rollout, of_learners: Mapping[str, Tensor]
    ) -> Tensor:
        """Return the normalised inputs of a critic before each decision, (T R, n).

        Args:
            critic: name of the critic.
            rollout: the rollout.
            of_learners: normalised observations of each learner, (T R, n) each.
        """
        if self._definition.critic == "observation":
            return of_learners[critic]
        state = self._critics[critic].inputs.normalise(rollout.state)
        return self._of_rows(critic, state).flatten(0, 1)

    def _advantages(self, critic: str, rollout: _Rollout, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return normalised advantages and normalised target returns, (T R,) each.

        At the end of a truncated episode, the critic's value of the final situation stands for the
        later rewards. Rewards of the next episode are not included.

        Args:
            critic: name of the critic.
            rollout: the rollout.
            inputs: normalised inputs of the critic, (T R, n).
        """
        s, of = self._settings, self._critics[critic]
        mean, std = of.returns.mean.float(), of.returns.std
        if self._definition.critic == "state":
            after = self._of_rows(critic, rollout.final_state)
        else:
            after = rollout.final_observations[critic]
        rewards = self._rewards_of(critic, rollout)
        values = of.net.run(inputs[None])[-1].view_as(rewards) * std + mean
        finals = of.net.run(of.inputs.normalise(after).flatten(0, 1)[None])[-1]
        next_values = torch.empty_like(values)
        next_values[:-1] = values[1:]
        at_ends = rollout.ended.bool()
        at_ends[-1] = True
        next_values[at_ends] = finals.view(after.shape[:2]) * std + mean
        advantages = generalised_advantages(
            rewards,
            values,
            next_values,
            rollout.ended,
            discount=s.discount,
            gae_lambda=s.gae_lambda,
        )
        flat, targets = advantages.flatten(), (advantages + values).flatten()
        counted, acting_targets = _rows((flat, targets), rollout.acting(critic))
        self._rescale(of, acting_targets)
        normal = (flat - counted.mean()) / (counted.std() + 1e-8)
        return normal, (targets - of.returns.mean.float()) / of.returns.std

    def _rescale(self, critic: _Critic, targets: Tensor) -> None:
        """Update the moments of returns; adapt the critic's last layer so that its values stay.

        The method is Pop-Art (van Hasselt et al. 2016).
        """
        mean, std = critic.returns.mean.float(), critic.returns.std
        critic.returns.add(targets.unsqueeze(-1))
        weight, bias = critic.net.layers(critic.net.weights.detach())[-1]
        new_mean, new_std = critic.returns.mean.float(), critic.returns.std
        weight.mul_(std / new_std)
        bias.mul_(std).add_(mean - new_mean).div_(new_std)

    def _learn_values(
        self, name: str, rows: Sequence[Tensor], batches: Sequence[Tensor]
    ) -> dict[str, float]:
        """Fit a critic to target returns, and return the mean loss.

        Args:
            name: name of the critic.
            rows: normalised inputs, (N, n), and normalised target returns, (N,).
            batches: indices of the rows of each mini-batch.
        """
        critic, losses = self._critics[name], []
        for batch in batches:
            inputs, targets = _rows(rows, batch)
            values = critic.net.run(inputs[None])
            loss, of_values = value_loss(values[-1], targets.view_as(values[-1]))
            critic.adam.step(critic.net.gradient(values, of_values))
            losses.append(loss)
        return {f"value_loss/{name}": float(torch.stack(losses).mean())}

    def _learn_policies(
        self,
        learners: Sequence[str],
        rollout: _Rollout,
        inputs: Mapping[str, Tensor],
        advantages: Mapping[str, Tensor],
        batches: Sequence[Sequence[Tensor]],
    ) -> dict[str, float]:
        """Update policies one after another, and return the mean losses and entropies.

        Args:
            learners: names of the learners.
            rollout: the rollout.
            inputs: normalised observations of each learner, (T R, n) each.
            advantages: normalised advantages of each critic, (T R,) each.
            batches: indices of the rows of each mini-batch of each learner.
        """
        logged: dict[str, float] = {}
        weight: Tensor | None = None
        for name, of_learner in zip(learners, batches, strict=True):
            count = self._spaces[name].count
            weighted = advantages.get(name)
            if weighted is None:
                weighted = advantages[TEAM].repeat_interleave(count)
            if weight is not None:
                weighted = weighted * weight.repeat_interleave(count)
            logged |= self._learn_policy(name, rollout, inputs[name], weighted, of_learner)
            if len(learners) > 1:
                ratio = self._ratio(name, rollout, inputs[name])
                weight = ratio if weight is None else weight * ratio
        return logged

    def _learn_policy(
        self,
        name: str,
        rollout: _Rollout,
        inputs: Tensor,
        weighted: Tensor,
        batches: Sequence[Tensor],
    ) -> dict[str, float]:
        """Update a policy by the weighted advantages, and return the mean loss and entropy."""
        actor, adam, of_entropy = self._actors[name], self._adams[name], -self._settings.entropy
        actions, old_log_p = rollout.actions[name].flatten(0, 1), rollout.log_p[name].flatten()
        rows = _rows((inputs, actions, old_log_p, weighted), rollout.acting(name))
        clip = self._settings.clip if self._definition.clips else None
        losses, entropies = [], []
        for batch in batches:
            seen, acted, before, gain = _rows(rows, batch)
            found = actor.evaluate(seen, acted)
            loss, of_log_p = policy_loss((found.log_p - before).exp_(), gain, clip)
            losses.append(loss)
            entropies.append(found.entropy)
            adam.step(actor.gradient(found, of_log_p, of_entropy))
        logged = {"policy_loss": losses, "entropy": entropies}
        return {f"{kind}/{name}": float(torch.stack(x).mean()) for kind, x in logged.items()}

    def _ratio(self, name: str, rollout: _Rollout, inputs: Tensor) -> Tensor:
        """Return the ratio of the new to the old probability of the learner's actions, (T * B,)."""
        now = self._actors[name].evaluate(inputs, rollout.actions[name].flatten(0, 1))
        ratio = (now.log_p - rollout.log_p[name].flatten()).exp()
        mask, count = rollout.masks.get(name), self._spaces[name].count
        if mask is not None:
            ratio = torch.where(mask.flatten(), ratio, 1.0)
        return ratio if count == 1 else ratio.view(-1, count).prod(1)

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

    def _anneal(self) -> None:
        """Lower the learning rate linearly, from its initial value to 0 during the training."""
        if not self._settings.anneal:
            return
        left = max(1.0 - (self._done - 1) / max(self._updates, 1), 0.0)
        for adam in (*self._adams.values(), *(c.adam for c in self._critics.values())):
            adam.rate = self._settings.rate * left

    def _make_critics(self, state_width: int) -> dict[str, _Critic]:
        """Create a critic for each learner, or a single critic for the team."""
        shared = self._definition.critic == "state"
        names = [TEAM] if not self._own_share and shared else list(self._spaces)
        critics = {}
        for name in names:
            inputs = RunningMoments(state_width) if shared else self._moments[name]
            width, weights = len(inputs.mean), self._generators["weights"]
            net = Perceptrons(1, width, 1, self._settings, weights, last_gain=1.0)
            critics[name] = _Critic(net, self._adam(net), inputs, RunningMoments(1))
        return critics

    def _adam(self, net: Perceptrons) -> Adam:
        s = self._settings
        return Adam(net.weights, s.rate, s.gradient_norm, ADAM_EPSILON)


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


def policy_loss(ratio: Tensor, advantages: Tensor, clip: float | None) -> tuple[Tensor, Tensor]:
    """Return the negative surrogate objective of a policy (Schulman et al. 2017, eq. 7).

    Args:
        ratio: ratio of each action's probability under the new policy to that under the old policy,
            (N,).
        advantages: advantage of each action, (N,).
        clip: clipping range of the ratio; None does not clip.

    Returns:
        The loss, shape (), and its derivative for the logarithm of each ratio, (N,).
    """
    gain = ratio * advantages
    if clip is None:
        return -gain.mean(), gain / -len(gain)
    limited = ratio.clamp(1.0 - clip, 1.0 + clip) * advantages
    loss = -torch.minimum(gain, limited).mean()
    # A ratio beyond the clip that pays no more has no derivative.
    return loss, gain.where(gain <= limited, 0.0).div_(-len(gain))


def value_loss(values: Tensor, targets: Tensor) -> tuple[Tensor, Tensor]:
    """Return half the mean squared error of N values, and its derivative for each value."""
    errors = values - targets
    return 0.5 * errors.square().mean(), errors.div_(errors.numel())


def _rows(values: Iterable[Tensor], chosen: Tensor | None) -> list[Tensor]:
    """Return the chosen rows of each tensor; all rows if ``chosen`` is None."""
    return [x if chosen is None else x.index_select(0, chosen) for x in values]


def _stacked(values: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Stack the tensors of each name; dicts of tensors are stacked by name in turn."""
    return {
        name: _stacked([value[name] for value in values])
        if isinstance(first, dict)
        else torch.stack([value[name] for value in values])
        for name, first in values[0].items()
    }


def _within_space(actions: Tensor) -> Tensor:
    """Clip continuous actions to -1..1; discrete choices are unchanged."""
    return actions if actions.dtype == torch.int64 else actions.clamp(-1.0, 1.0)
