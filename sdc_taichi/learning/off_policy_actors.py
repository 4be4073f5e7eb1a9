"""Policies of HAD3QN and HASAC, which learn from a critic of joint actions.

Learners are updated one after another in random order (Zhong et al. 2024). The update of a learner
uses the new policies of the learners already updated and the old policies of the others, so that no
two learners respond to the same possible improvement.

In shapes, N is the batch size, K the number of actions of all agents together, k the number of
one learner's actions, and L the number of levels of a discrete action. If W agents share the policy
of a learner, k is the number of all their actions. Agents without effect have constant actions, the
first level or 0, so that they add nothing to losses and gradients. Z is the number of rewards: 1 if
all learners have the reward of the team, or else one for each learner. E is the number of critics
of each reward.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from sdc_taichi.learning.algorithms import OffPolicySettings
from sdc_taichi.learning.networks import (
    Adam,
    ContinuousValues,
    JointValues,
    Perceptrons,
    expected,
)
from sdc_taichi.learning.stream import LearnerSpaces

LEAST_LOG_STD, MOST_LOG_STD = -5.0, 2.0
"""Bounds of the logarithm of the standard deviation of actions before the hyperbolic tangent."""

LEAST_SCORE = -1e4
"""Score of a level that is never chosen; its probability is 0 in f32."""

Values = TypeVar("Values", bound=JointValues | ContinuousValues)
"""Type of the critic: for discrete choices, or for continuous actions."""


class Situation(NamedTuple):
    """Normalised shared state and observations of N environments."""

    state: Tensor
    """Shared state, (N, m)."""
    observations: dict[str, Tensor]
    """Observations by learner, (N, n) each, or (N W, n) if W agents share the policy."""
    masks: dict[str, Tensor]
    """True for agents that act, (N, W) each, by learner with a mask."""

    def acting(self, learner: str, width: int) -> Tensor | None:
        """Return True for the actions of agents that act, (N, width); None if all agents act.

        Args:
            learner: name of the learner.
            width: number of actions of all its agents.
        """
        mask = self.masks.get(learner)
        if mask is None or mask.all():
            return None
        return mask.repeat_interleave(width // mask.shape[1], dim=1)


class Actors(Generic[Values]):
    """Policy networks of all learners, which decide K actions together.

    For a discrete action, a network has one output per level. For a continuous action, it has one
    output for the mean and one for the logarithm of the standard deviation.

    Args:
        critic: critic that the policies learn from.
        spaces: sizes of the observations and actions of each learner.
        settings: settings of the algorithm.
        rewards: number of rewards that the critic values, Z.
        generator: random generator of the initial weights.

    Attributes:
        nets: network of each learner.
        adams: optimiser of each learner's network.
        numbers: columns of each learner in an array of all actions, (N, K).
    """

    def __init__(
        self,
        critic: Values,
        spaces: Mapping[str, LearnerSpaces],
        settings: OffPolicySettings,
        rewards: int,
        generator: torch.Generator,
    ) -> None:
        self._critic, self._settings, self._rewards = critic, settings, rewards
        self._reward_of = {name: i if rewards > 1 else 0 for i, name in enumerate(spaces)}
        self._outputs = next(iter(spaces.values())).choices or 2
        self.nets: dict[str, Perceptrons] = {}
        self.numbers: dict[str, slice] = {}
        self.adams: dict[str, Adam] = {}
        self._counts = {name: of.count for name, of in spaces.items()}
        first = 0
        for name, of in spaces.items():
            outputs = self._outputs * of.action_width
            self.nets[name] = net = Perceptrons(
                1, of.observation_width, outputs, settings, generator
            )
            self.adams[name] = Adam(net.weights, settings.rate, settings.gradient_norm)
            self.numbers[name] = slice(first, first + of.action_width * of.count)
            first = self.numbers[name].stop

    def state_dict(self) -> dict[str, Any]:
        """Everything that ``load_state_dict`` needs."""
        return {name: adam.state_dict() for name, adam in self.adams.items()}

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore the state that ``state_dict`` returned."""
        for name, adam in self.adams.items():
            adam.load_state_dict(values[name])

    def _choice_outputs(self, situation: Situation) -> Tensor:
        """Return the network output for each level of each action, (N, K, L)."""
        return torch.cat([self._scores(name, situation) for name in self.nets], dim=1)

    def _scores(self, name: str, situation: Situation) -> Tensor:
        """Return the network output for each level of each action of a learner, (N, k, L).

        Those of actions without effect select the first level.
        """
        scores = self.nets[name](situation.observations[name])
        scores = scores.reshape(len(situation.state), -1, self._outputs)
        acting = situation.acting(name, scores.shape[1])
        if acting is None:
            return scores
        first_level = torch.full((self._outputs,), LEAST_SCORE)
        first_level[0] = 0.0
        return torch.where(acting[..., None], scores, first_level)

    def _least(self, values: Tensor) -> Tensor:
        """Return the least value of the critics of each reward, (Z, N, ...), from (Z E, N, ...)."""
        return values.unflatten(0, (self._rewards, -1)).amin(1)

    def _order(self, generator: torch.Generator) -> list[str]:
        """Return the names of the learners in random order."""
        names = list(self.nets)
        return [names[i] for i in torch.randperm(len(names), generator=generator).tolist()]


class GreedyActors(Actors[JointValues]):
    """Learners of HAD3QN, which choose the action with the highest value (Zhong et al. 2024).

    The critic has a table of values with an entry for each joint action. The values of a learner
    are fitted to the row of that table in which the other learners' actions are fixed: new actions
    of the learners already updated, old actions of the others. The publication fits only the value
    of the best action; here the values of all actions of the row are fitted.
    """

    def act(self, situation: Situation, exploration: float, generator: torch.Generator) -> Tensor:
        """Return epsilon-greedy choices, (N, K).

        Args:
            situation: normalised shared state and observations.
            exploration: probability epsilon of a random choice.
            generator: random generator of the exploration.
        """
        best = self._choice_outputs(situation).argmax(-1)
        explores = torch.rand(best.shape, generator=generator) < exploration
        chosen = torch.where(
            explores, torch.randint(self._outputs, best.shape, generator=generator), best
        )
        for name, numbers in self.numbers.items():
            acting = situation.acting(name, numbers.stop - numbers.start)
            if acting is not None:
                chosen[:, numbers] *= acting
        return chosen

    def next_values(self, targets: Tensor, after: Situation, _: torch.Generator) -> Tensor:
        """Return the target critic's values of the learners' best choices, (Z, N).

        Selection by the learners and evaluation by the critic is double Q-learning (van Hasselt et
        al. 2016).
        """
        best = self._choice_outputs(after).argmax(-1)
        return self._least(self._critic.of_actions(after.state, best, targets))

    def improve(self, situation: Situation, generator: torch.Generator) -> dict[str, Tensor]:
        """Fit each learner's action values to the critic's table; return the losses by learner."""
        outputs = self._choice_outputs(situation)
        with torch.no_grad():
            tables = self._least(self._critic(situation.state))
            order = {
                number: tables[self._reward_of[name]]
                for name in self._order(generator)
                for number in range(*self.numbers[name].indices(outputs.shape[1]))
            }
            rows = best_replies(order, outputs.argmax(-1), self._outputs)
            rows -= rows.mean(-1, keepdim=True)
        losses = {}
        for name, numbers in self.numbers.items():
            errors = (outputs[:, numbers] - rows[:, numbers]).square()
            acting = situation.acting(name, errors.shape[1])
            loss = errors.mean() if acting is None else _mean_of(errors.mean(-1), acting)
            self.adams[name].descend(loss)
            losses[f"policy_loss/{name}"] = loss.detach()
        return losses


class EntropicActors(Actors[Values]):
    """Stochastic policies with an entropy bonus.

    The weight of the entropy is the temperature. Each learner has a temperature, which is adjusted
    until the entropy of the learner's policy equals a target (Haarnoja et al. 2018). Arguments are
    as in ``Actors``.
    """

    def __init__(
        self,
        critic: Values,
        spaces: Mapping[str, LearnerSpaces],
        settings: OffPolicySettings,
        rewards: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__(critic, spaces, settings, rewards, generator)
        self._target_entropies: dict[str, float] = {}
        for name, sizes in spaces.items():
            per_action = settings.continuous_entropy
            if sizes.choices is not None:
                per_action = settings.entropy_share * math.log(sizes.choices)
            self._target_entropies[name] = per_action * sizes.action_width
        start = math.log(settings.temperature)
        self._log_temperatures = {name: torch.tensor(start, requires_grad=True) for name in spaces}
        self._temperature_adams = {
            name: Adam(log, settings.temperature_rate)
            for name, log in self._log_temperatures.items()
        }

    def temperature(self, name: str) -> Tensor:
        """Return the temperature of a learner, shape ()."""
        return self._log_temperatures[name].detach().exp()

    def state_dict(self) -> dict[str, Any]:
        """Everything that ``load_state_dict`` needs."""
        temperatures = {name: adam.state_dict() for name, adam in self._temperature_adams.items()}
        return super().state_dict() | {"temperatures": temperatures}

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore the state that ``state_dict`` returned."""
        super().load_state_dict(values)
        for name, adam in self._temperature_adams.items():
            adam.load_state_dict(values["temperatures"][name])

    def _per_agent(self, name: str, entropy: Tensor, situation: Situation) -> Tensor:
        """Return the mean entropy of an agent that acts, from that of all such agents, (N,)."""
        if name not in situation.masks:
            return entropy.mean() / self._counts[name]
        return entropy.sum() / situation.masks[name].sum().clamp_min(1)

    def _soft(self, values: Tensor, entropies: Mapping[str, Tensor]) -> Tensor:
        """Add the entropies of learners, (N,) each, times their temperatures to values, (Z, N).

        The reward of the team is valued with the entropies of all learners, the own reward of a
        learner with its own.
        """
        bonuses = [self.temperature(name) * entropies[name] for name in self.nets]
        return values + (torch.stack(bonuses) if len(values) > 1 else sum(bonuses))

    def _step(self, name: str, loss: Tensor, entropy: Tensor) -> dict[str, Tensor]:
        """Update the network and the temperature of a learner, and return values to log."""
        self.adams[name].descend(loss)
        log = self._log_temperatures[name]
        excess = log * (entropy - self._target_entropies[name])
        self._temperature_adams[name].descend(excess)
        return {
            f"policy_loss/{name}": loss.detach(),
            f"entropy/{name}": entropy,
            f"temperature/{name}": self.temperature(name),
        }


class SoftActors(EntropicActors[JointValues]):
    """Learners of HASAC with discrete choices: stochastic policies with an entropy bonus.

    HASAC is by Liu et al. (2024). The critic has an output for each joint action, so that all
    expected values are exact, as in the single-agent algorithm of Christodoulou (2019).
    """

    def act(self, situation: Situation, _: float, generator: torch.Generator) -> Tensor:
        """Draw choices from the policies, (N, K)."""
        scores = self._choice_outputs(situation)
        noise = torch.empty_like(scores).exponential_(generator=generator).log_()
        return (scores - noise).argmax(-1)

    def next_values(self, targets: Tensor, after: Situation, _: torch.Generator) -> Tensor:
        """Return soft values of the target critic, (Z, N).

        A soft value is the expected value plus the entropies times the temperatures.
        """
        log_p = self._choice_outputs(after).log_softmax(-1)
        tables, p = self._least(self._critic(after.state, targets)), log_p.exp()
        values = torch.stack([expected(table, p).squeeze(-1) for table in tables])
        return self._soft(
            values, {name: entropies(log_p[:, part]) for name, part in self.numbers.items()}
        )

    def improve(self, situation: Situation, generator: torch.Generator) -> dict[str, Tensor]:
        """Raise the soft value by one learner after another, and return losses and entropies."""
        with torch.no_grad():
            tables = self._least(self._critic(situation.state))
        log_p = {name: self._log_p(name, situation) for name in self.nets}
        probabilities = torch.cat(list(log_p.values()), dim=1).detach().exp()
        logged: dict[str, Tensor] = {}
        for name in self._order(generator):
            numbers = self.numbers[name]
            free = range(*numbers.indices(probabilities.shape[1]))
            values = expected(tables[self._reward_of[name]], probabilities, free)
            loss = soft_policy_loss(log_p[name], values, self.temperature(name))
            entropy = entropies(log_p[name].detach())
            logged |= self._step(name, loss, self._per_agent(name, entropy, situation))
            with torch.no_grad():
                probabilities[:, numbers] = self._log_p(name, situation).exp()
        return logged

    def _log_p(self, name: str, situation: Situation) -> Tensor:
        """Return the log-probability of each level of a learner's choices, (N, k, L)."""
        return self._scores(name, situation).log_softmax(-1)


class GaussianActors(EntropicActors[ContinuousValues]):
    """Learners of HASAC with continuous actions: stochastic policies with an entropy bonus.

    HASAC is by Liu et al. (2024). An action is the hyperbolic tangent of a normally distributed
    number (Haarnoja et al. 2018). The critic is differentiated with respect to the action.
    """

    def act(self, situation: Situation, _: float, generator: torch.Generator) -> Tensor:
        """Draw actions from the policies, (N, K)."""
        return self._draw_all(situation, generator)[0]

    def next_values(self, targets: Tensor, after: Situation, generator: torch.Generator) -> Tensor:
        """Return the target critic's soft values of actions drawn from the policies, (Z, N)."""
        actions, log_p = self._draw_all(after, generator)
        values = self._least(self._critic.of_actions(after.state, actions, targets))
        return self._soft(values, {name: -x for name, x in log_p.items()})

    def improve(self, situation: Situation, generator: torch.Generator) -> dict[str, Tensor]:
        """Raise the soft value by one learner after another, and return losses and entropies."""
        drawn = {name: self._draw(name, situation, generator) for name in self.nets}
        actions = torch.cat([part.detach() for part, _ in drawn.values()], dim=1)
        logged: dict[str, Tensor] = {}
        fixed = self._critic.weights.detach()
        for name in self._order(generator):
            numbers = self.numbers[name]
            part, log_p = drawn[name]
            joint = torch.cat([actions[:, : numbers.start], part, actions[:, numbers.stop :]], 1)
            values = self._least(self._critic.of_actions(situation.state, joint, fixed))
            value = values[self._reward_of[name]]
            loss = (self.temperature(name) * log_p - value).mean()
            entropy = self._per_agent(name, -log_p.detach(), situation)
            logged |= self._step(name, loss, entropy)
            with torch.no_grad():
                actions[:, numbers] = self._draw(name, situation, generator)[0]
        return logged

    def _draw_all(
        self, situation: Situation, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Draw the actions of all learners, (N, K); return them and each learner's log-density."""
        drawn = {name: self._draw(name, situation, generator) for name in self.nets}
        joint = torch.cat([actions for actions, _ in drawn.values()], dim=1)
        return joint, {name: log_p for name, (_, log_p) in drawn.items()}

    def _draw(
        self, name: str, situation: Situation, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw the actions of a learner, (N, k); return them and their log-densities, (N,).

        Actions without effect are 0 and do not count in the log-densities.
        """
        mean, log_std = self.nets[name](situation.observations[name])[0].chunk(2, dim=-1)
        log_std = log_std.clamp(LEAST_LOG_STD, MOST_LOG_STD)
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        actions, log_p = squashed(mean, log_std, noise)
        size = len(situation.state)
        actions = actions.reshape(size, -1)
        acting = situation.acting(name, actions.shape[1])
        if acting is not None:
            actions = actions.where(acting, 0.0)
            log_p = log_p.where(situation.masks[name].flatten(), 0.0)
        return actions, log_p if len(log_p) == size else log_p.reshape(size, -1).sum(-1)


def _mean_of(values: Tensor, chosen: Tensor) -> Tensor:
    """Return the mean of the chosen elements, shape (); 0 if none is chosen."""
    return values.where(chosen, 0.0).sum() / chosen.sum().clamp_min(1)


def best_replies(tables: Mapping[int, Tensor], choices: Tensor, levels: int) -> Tensor:
    """Return the values of each action's levels while the other actions are fixed.

    The actions are processed one after another. Each is set to its best level before the next.

    Args:
        tables: values of all joint actions, (N, L^K), for the index of each action, in the order of
            processing.
        choices: initial level of each action, (N, K).
        levels: number of levels of each action, L.

    Returns:
        Value of each level of each action, (N, K, L).
    """
    dtype = next(iter(tables.values())).dtype
    taken = nn.functional.one_hot(choices, levels).to(dtype)
    rows = torch.empty_like(taken)
    for number, table in tables.items():
        row = expected(table, taken, (number,))
        rows[:, number] = row
        taken[:, number] = nn.functional.one_hot(row.argmax(-1), levels).to(dtype)
    return rows


def soft_policy_loss(log_p: Tensor, values: Tensor, temperature: Tensor) -> Tensor:
    """Return the negative mean soft value of k independent choices (Christodoulou 2019, eq. 12).

    Args:
        log_p: log-probability of each level of each choice, (N, k, L).
        values: values of all combinations of the choices, (N, L^k).
        temperature: weight of the entropy, shape ().
    """
    value = expected(values, log_p.exp()).squeeze(-1)
    return -(value + temperature * entropies(log_p)).mean()


def entropies(log_p: Tensor) -> Tensor:
    """Return the joint entropy of k independent choices, in nats, (N,).

    Args:
        log_p: log-probability of each level of each choice, (N, k, L).
    """
    return -(log_p.exp() * log_p).sum((-1, -2))


def squashed(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return hyperbolic tangents of normally distributed numbers, and their log-densities.

    With u = mean + std * noise, the density of tanh(u) is the density of u divided by
    1 - tanh(u)^2 (Haarnoja et al. 2018, appendix C). The logarithm of 1 - tanh(u)^2 is
    2 (log 2 - u - softplus(-2 u)).

    Args:
        mean: means, (N, k).
        log_std: logarithms of standard deviations, (N, k).
        noise: standard normal numbers, (N, k).

    Returns:
        Actions, (N, k), and log-densities of the k actions together, (N,).
    """
    u = mean + log_std.exp() * noise
    normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    slope = 2.0 * (math.log(2.0) - u - nn.functional.softplus(-2.0 * u))
    return u.tanh(), (normal - slope).sum(-1)
