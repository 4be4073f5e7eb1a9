"""PPO, IPPO, MAPPO, HAPPO and HAA2C: one update, of which each algorithm is a case.

All agents act for some steps with fixed policies. Then each learner i maximises, by Adam,

    M_i min(r_i A_i, clip(r_i, 1 - eps, 1 + eps) A_i) + entropy

where r_i is the probability of an action under the new policy over that under the old, and A_i is
the generalised advantage (Schulman et al. 2016) by a critic. The algorithms differ in the critic's
input, in whose reward it learns, in M_i, and in clipping:

- ``ppo`` (Schulman et al. 2017) has one learner; ``ippo`` (de Witt et al. 2020) several, each with
  a critic of its own observation and reward. M_i = 1.
- ``mappo`` (Yu et al. 2022): a critic of the shared state learns the reward of the team. M_i = 1.
- ``happo`` (Kuba et al. 2022; Zhong et al. 2024): as ``mappo``, but learners are updated one after
  another in random order, and M_i is the product of the ratios r_j of those already updated.
- ``haa2c`` (Zhong et al. 2024): as ``happo`` without clipping, in a single pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from sdc_taichi.learning.algorithms import OnPolicyDefinition, OnPolicySettings
from sdc_taichi.learning.networks import (
    Actor,
    RunningMoments,
    generators,
    perceptron,
    policy_network,
)
from sdc_taichi.learning.policy import PolicyNetwork
from sdc_taichi.learning.stream import EnvironmentStream

TEAM = "team"
"""Name of the critic of the team's reward."""
ADAM_EPSILON = 1e-5


class _Critic(NamedTuple):
    """A critic, with the moments of what it sees and of the returns that it learns."""

    net: nn.Sequential
    adam: torch.optim.Adam
    inputs: RunningMoments
    returns: RunningMoments


class _Rollout(NamedTuple):
    """Decisions of all environments under fixed policies, (T, B, ...) each."""

    observations: dict[str, Tensor]
    next_observations: dict[str, Tensor]
    state: Tensor
    next_state: Tensor
    actions: dict[str, Tensor]
    log_p: dict[str, Tensor]
    rewards: dict[str, Tensor]
    team: Tensor
    ended: Tensor


class OnPolicy:
    """A learner for each policy, updated from steps that the policies have just made.

    Args:
        definition: properties in which the algorithm differs from others.
        settings: settings.
        stream: the environments to learn in.
        updates: number of updates of the whole training, over which the learning rate falls.
        seed: of weights, actions, order of learners and of mini-batches.
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
        self._definition = definition._replace(
            critic=settings.critic or definition.critic, reward=settings.reward or definition.reward
        )
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

        The first update only measures mean and variance of what is observed.

        Args:
            stream: the environments.

        Returns:
            Numbers to log: ``reward/NAME``, the mean over steps; losses; entropies.
        """
        rollout = self._collect(stream)
        held = self._settings.decision_steps
        logged = {f"reward/{n}": float(r.mean()) / held for n, r in rollout.rewards.items()}
        self._done += 1
        if self._done > 1:
            self._anneal()
            logged |= self._learn(rollout)
        for name, moments in self._moments.items():
            moments.add(rollout.observations[name].flatten(0, 1))
        for name, critic in self._critics.items():
            critic.inputs.add(self._critic_inputs(name, rollout)[0].flatten(0, 1))
        return logged

    def networks(self) -> tuple[PolicyNetwork, ...]:
        """The policies as they are."""
        activation = self._settings.activation
        return tuple(
            policy_network(self._actors[name].net, self._moments[name], of, activation)
            for name, of in self._spaces.items()
        )

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides how the training goes on."""
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
        """Go on from what ``state_dict`` returned, of an algorithm made alike."""
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
        """Act with the policies as they are."""
        steps, size = self._settings.rollout_decisions, stream.size

        def room(width: int | None, kind: torch.dtype = torch.float32) -> Tensor:
            return torch.empty((steps, size) if width is None else (steps, size, width), dtype=kind)

        of_each = self._spaces.items()
        kinds = {n: torch.float32 if of.choices is None else torch.int64 for n, of in of_each}
        out = _Rollout(
            {n: room(of.observation_width) for n, of in of_each},
            {n: room(of.observation_width) for n, of in of_each},
            room(stream.state_width),
            room(stream.state_width),
            {n: room(of.action_width, kinds[n]) for n, of in of_each},
            {n: room(None) for n in self._spaces},
            {n: room(None) for n in self._spaces},
            room(None),
            torch.zeros(steps),
        )
        with torch.no_grad():
            for t in range(steps):
                out.state[t] = stream.state
                for name in self._spaces:
                    seen = stream.observations[name]
                    actions, log_p = self._actors[name].sample(
                        self._moments[name].normalise(seen), self._generators["actions"]
                    )
                    out.observations[name][t] = seen
                    out.actions[name][t], out.log_p[name][t] = actions, log_p
                after = stream.step({n: _within_space(out.actions[n][t]) for n in self._spaces})
                for name in self._spaces:
                    out.rewards[name][t] = after.rewards[name]
                    out.next_observations[name][t] = after.next_observations[name]
                out.team[t] = after.team
                out.next_state[t], out.ended[t] = after.next_state, float(after.ended)
        return out

    # Learning

    def _learn(self, rollout: _Rollout) -> dict[str, float]:
        """Learn from a rollout: each critic, then each learner's policy."""
        logged: dict[str, float] = {}
        advantages: dict[str, Tensor] = {}
        for name in self._critics:
            advantages[name], targets = self._advantages(name, rollout)
            logged[f"value_loss/{name}"] = self._learn_values(name, rollout, targets)
        learners = list(self._spaces)
        order = range(len(learners))
        if self._definition.sequential and len(learners) > 1:
            order = torch.randperm(len(learners), generator=self._generators["order"]).tolist()
        weight: Tensor | None = None
        for i in order:
            name = learners[i]
            advantage = advantages[TEAM if TEAM in advantages else name]
            logged |= self._learn_policy(name, rollout, advantage, weight)
            if self._definition.sequential and len(learners) > 1:
                ratio = self._ratio(name, rollout)
                weight = ratio if weight is None else weight * ratio
        return logged

    def _advantages(self, critic: str, rollout: _Rollout) -> tuple[Tensor, Tensor]:
        """Normalised advantages and normalised returns, (T * B,) each.

        An episode that is cut off has the value of the situation after its last step, and nothing
        of the next episode.
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
        targets = (advantages + values).flatten()
        self._rescale(of, targets)
        flat = advantages.flatten()
        normal = (flat - flat.mean()) / (flat.std() + 1e-8)
        return normal, (targets - of.returns.mean.float()) / of.returns.std

    def _rescale(self, critic: _Critic, targets: Tensor) -> None:
        """Take returns into account, and keep what the critic says (van Hasselt et al. 2016)."""
        mean, std = critic.returns.mean.float(), critic.returns.std
        critic.returns.add(targets.unsqueeze(-1))
        last = critic.net[-1]
        assert isinstance(last, nn.Linear)
        new_mean, new_std = critic.returns.mean.float(), critic.returns.std
        with torch.no_grad():
            last.weight.mul_(std / new_std)
            last.bias.mul_(std).add_(mean - new_mean).div_(new_std)

    def _learn_values(self, name: str, rollout: _Rollout, targets: Tensor) -> float:
        """Fit a critic to returns, and return the mean loss."""
        critic = self._critics[name]
        inputs = critic.inputs.normalise(self._critic_inputs(name, rollout)[0].flatten(0, 1))
        total = 0.0
        batches = self._batches(len(targets))
        for batch in batches:
            values = critic.net(inputs.index_select(0, batch)).squeeze(-1)
            loss = value_loss(values, targets[batch])
            self._descend(loss, critic.net, critic.adam)
            total += float(loss.detach())
        return total / len(batches)

    def _learn_policy(
        self, name: str, rollout: _Rollout, advantages: Tensor, weight: Tensor | None
    ) -> dict[str, float]:
        """Improve a policy, and return the mean loss and entropy."""
        actor, adam = self._actors[name], self._adams[name]
        seen = self._moments[name].normalise(rollout.observations[name].flatten(0, 1))
        actions = rollout.actions[name].flatten(0, 1)
        old_log_p = rollout.log_p[name].flatten()
        weighed = advantages if weight is None else advantages * weight
        clip = self._settings.clip if self._definition.clips else None
        totals = torch.zeros(2)
        batches = self._batches(len(actions))
        for batch in batches:
            rows = seen.index_select(0, batch), actions.index_select(0, batch)
            log_p, entropy = actor.evaluate(*rows)
            ratio = (log_p - old_log_p[batch]).exp()
            loss = policy_loss(ratio, weighed[batch], clip)
            self._descend(loss - self._settings.entropy * entropy, actor, adam)
            totals += torch.stack([loss.detach(), entropy.detach()])
        loss_mean, entropy_mean = (totals / len(batches)).tolist()
        return {f"policy_loss/{name}": loss_mean, f"entropy/{name}": entropy_mean}

    def _ratio(self, name: str, rollout: _Rollout) -> Tensor:
        """New probability of the actions that were made over the old one, (T * B,)."""
        seen = self._moments[name].normalise(rollout.observations[name].flatten(0, 1))
        with torch.no_grad():
            log_p, _ = self._actors[name].evaluate(seen, rollout.actions[name].flatten(0, 1))
        return (log_p - rollout.log_p[name].flatten()).exp()

    def _critic_inputs(self, critic: str, rollout: _Rollout) -> tuple[Tensor, Tensor]:
        """Inputs of a critic before and after each step, (T, B, n) each."""
        if self._definition.critic == "state":
            return rollout.state, rollout.next_state
        return rollout.observations[critic], rollout.next_observations[critic]

    def _rewards_of(self, critic: str, rollout: _Rollout) -> Tensor:
        """Rewards that a critic learns, (T, B)."""
        if self._definition.reward == TEAM:
            return rollout.team
        return rollout.rewards[critic]

    def _batches(self, rows: int) -> list[Tensor]:
        """Rows of each mini-batch of all passes."""
        s = self._settings
        if not self._definition.clips:
            # Without clipping, ratios are right in the first step alone.
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
        """Set the learning rate of the update."""
        if not self._settings.anneal:
            return
        left = max(1.0 - (self._done - 1) / max(self._updates, 1), 0.0)
        for adam in (*self._adams.values(), *(c.adam for c in self._critics.values())):
            adam.param_groups[0]["lr"] = self._settings.rate * left

    def _make_critics(self, state_width: int) -> dict[str, _Critic]:
        """A critic for each learner, or one for the team."""
        shared = self._definition.critic == "state"
        names = [TEAM] if self._definition.reward == "team" and shared else list(self._spaces)
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
    """Generalised advantages of steps (Schulman et al. 2016, eq. 16), (T, B).

    Args:
        rewards: rewards, (T, B).
        values: values before each step, (T, B).
        next_values: values after each step, of the same episode, (T, B).
        ended: 1 where the episodes were cut off after the step, else 0, (T,).
        discount: weight of a reward one step later.
        gae_lambda: weight of later steps in the advantage.
    """
    errors = rewards + discount * next_values - values
    advantages = torch.empty_like(rewards)
    later = torch.zeros_like(rewards[0])
    for t in range(len(rewards) - 1, -1, -1):
        later = errors[t] + discount * gae_lambda * (1.0 - ended[t]) * later
        advantages[t] = later
    return advantages


def policy_loss(ratio: Tensor, advantages: Tensor, clip: float | None) -> Tensor:
    """Negative of the surrogate objective of a policy (Schulman et al. 2017, eq. 7).

    Args:
        ratio: probability of each action under the policy over that under the old one, (n,).
        advantages: advantage of each action, (n,).
        clip: largest change of the ratio that pays; None is any.
    """
    gain = ratio * advantages
    if clip is not None:
        gain = torch.minimum(gain, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages)
    return -gain.mean()


def value_loss(values: Tensor, targets: Tensor) -> Tensor:
    """Half the mean squared error of values, (n,)."""
    return 0.5 * (values - targets).square().mean()


def _within_space(actions: Tensor) -> Tensor:
    """Actions of an environment: choices as they are, numbers cut at -1 and 1."""
    return actions if actions.dtype == torch.int64 else actions.clamp(-1.0, 1.0)
