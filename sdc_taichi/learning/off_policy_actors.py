"""Policies of HAD3QN and HASAC, which learn from a critic of joint actions.

Learners are updated one after another in random order (Zhong et al. 2024). Each is updated for the
new policies of the learners before it and the old policies of those after it, so that no two of
them react to the same gain.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from sdc_taichi.learning.algorithms import OffPolicySettings
from sdc_taichi.learning.networks import (
    LAST_GAIN,
    ContinuousValues,
    JointValues,
    expected,
    perceptron,
)
from sdc_taichi.learning.stream import LearnerSpaces

LEAST_LOG_STD, MOST_LOG_STD = -5.0, 2.0
"""Bounds of the logarithm of the standard deviation of actions before the hyperbolic tangent."""

Values = TypeVar("Values", bound=JointValues | ContinuousValues)
"""Type of the critic: of choices, or of continuous numbers."""


class Situation(NamedTuple):
    """Normalised shared state and observations of N environments."""

    state: Tensor
    """Shared state, (N, m)."""
    observations: dict[str, Tensor]
    """Observations by learner, (N, n) each."""


class Actors(Generic[Values]):
    """Networks of all learners, which decide K numbers side by side.

    A network has an output for each choice of a number. For a continuous number it has one output
    for the mean and one for the logarithm of the standard deviation.

    Args:
        critic: critic that the policies learn from.
        spaces: sizes of the observations and actions of each learner.
        settings: settings of the algorithm.
        generator: source of the weights.

    Attributes:
        nets: network of each learner.
        adams: optimiser of each learner's network.
        numbers: columns of each learner's numbers.
    """

    def __init__(
        self,
        critic: Values,
        spaces: Mapping[str, LearnerSpaces],
        settings: OffPolicySettings,
        generator: torch.Generator,
    ) -> None:
        self._critic, self._settings = critic, settings
        self._outputs = next(iter(spaces.values())).choices or 2
        self.nets: dict[str, nn.Sequential] = {}
        self.numbers: dict[str, slice] = {}
        self.adams: dict[str, torch.optim.Adam] = {}
        first = 0
        for name, of in spaces.items():
            self.nets[name] = net = perceptron(
                of.observation_width,
                settings.hidden,
                self._outputs * of.action_width,
                activation=settings.activation,
                last_gain=LAST_GAIN,
                generator=generator,
            )
            self.adams[name] = adam(net.parameters(), settings.rate)
            self.numbers[name] = slice(first, first + of.action_width)
            first += of.action_width

    def state_dict(self) -> dict[str, Any]:
        """Everything that ``load_state_dict`` needs."""
        return {
            name: {"net": net.state_dict(), "adam": self.adams[name].state_dict()}
            for name, net in self.nets.items()
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore the state that ``state_dict`` returned."""
        for name, net in self.nets.items():
            net.load_state_dict(values[name]["net"])
            self.adams[name].load_state_dict(values[name]["adam"])

    def _choice_outputs(self, situation: Situation) -> Tensor:
        """Outputs for each choice of each number, (N, K, L)."""
        return torch.cat(
            [
                self.nets[name](seen).unflatten(-1, (-1, self._outputs))
                for name, seen in situation.observations.items()
            ],
            dim=1,
        )

    def _descend(self, loss: Tensor, name: str) -> None:
        """Take a gradient step of a learner's network."""
        descend(
            loss, list(self.nets[name].parameters()), self.adams[name], self._settings.gradient_norm
        )

    def _order(self, generator: torch.Generator) -> list[str]:
        """Learners in random order."""
        names = list(self.nets)
        return [names[i] for i in torch.randperm(len(names), generator=generator).tolist()]


class GreedyActors(Actors[JointValues]):
    """Values of each learner's choices, of which it takes the best: HAD3QN (Zhong et al. 2024).

    A learner's values are fitted to the row of the critic's table for the choices of the others:
    the updated choices of the learners before it in a random order, the current ones of those
    after it. The source fits the value of the best choice alone; the row has those of all choices.
    """

    def act(self, situation: Situation, exploration: float, generator: torch.Generator) -> Tensor:
        """Best choices, (N, K), some of them replaced by random ones.

        Args:
            situation: what the learners observe.
            exploration: probability of a random choice, epsilon.
            generator: source of the draws.
        """
        best = self._choice_outputs(situation).argmax(-1)
        explores = torch.rand(best.shape, generator=generator) < exploration
        return torch.where(
            explores, torch.randint(self._outputs, best.shape, generator=generator), best
        )

    def next_values(
        self, targets: Sequence[Tensor], after: Situation, _: torch.Generator
    ) -> Tensor:
        """Values of the best choices by the target critic, (N,) (van Hasselt et al. 2016)."""
        best = self._choice_outputs(after).argmax(-1)
        return self._critic.of_actions(after.state, best, targets).amin(0)

    def improve(self, situation: Situation, generator: torch.Generator) -> dict[str, Tensor]:
        """Fit individual values to the critic's table, and return the loss of each learner."""
        outputs = self._choice_outputs(situation)
        with torch.no_grad():
            table = self._critic(situation.state).amin(0)
            order = [
                number
                for name in self._order(generator)
                for number in range(*self.numbers[name].indices(outputs.shape[1]))
            ]
            rows = best_replies(table, outputs.argmax(-1), order, self._outputs)
            rows -= rows.mean(-1, keepdim=True)
        losses = {}
        for name, numbers in self.numbers.items():
            loss = (outputs[:, numbers] - rows[:, numbers]).square().mean()
            self._descend(loss, name)
            losses[f"policy_loss/{name}"] = loss.detach()
        return losses


class EntropicActors(Actors[Values]):
    """Stochastic policies with a reward for their entropy.

    Each learner has a temperature, which is adjusted until its entropy equals a target (Haarnoja et
    al. 2018).

    Args:
        critic: critic that the policies learn from.
        spaces: sizes of the observations and actions of each learner.
        settings: settings of the algorithm.
        generator: source of the weights.
    """

    def __init__(
        self,
        critic: Values,
        spaces: Mapping[str, LearnerSpaces],
        settings: OffPolicySettings,
        generator: torch.Generator,
    ) -> None:
        super().__init__(critic, spaces, settings, generator)
        self._wanted_entropies: dict[str, float] = {}
        for name, of in spaces.items():
            of_number = settings.continuous_entropy
            if of.choices is not None:
                of_number = settings.entropy_share * math.log(of.choices)
            self._wanted_entropies[name] = of_number * of.action_width
        start = math.log(settings.temperature)
        self._log_temperatures = {name: torch.tensor(start, requires_grad=True) for name in spaces}
        self._temperature_adams = {
            name: adam([log], settings.temperature_rate)
            for name, log in self._log_temperatures.items()
        }

    def temperature(self, name: str) -> Tensor:
        """Temperature of a learner, ()."""
        return self._log_temperatures[name].detach().exp()

    def state_dict(self) -> dict[str, Any]:
        """Everything that ``load_state_dict`` needs."""
        temperatures = {
            name: {"log": log.detach(), "adam": self._temperature_adams[name].state_dict()}
            for name, log in self._log_temperatures.items()
        }
        return super().state_dict() | {"temperatures": temperatures}

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore the state that ``state_dict`` returned."""
        super().load_state_dict(values)
        for name, log in self._log_temperatures.items():
            of = values["temperatures"][name]
            with torch.no_grad():
                log.copy_(torch.as_tensor(of["log"]))
            self._temperature_adams[name].load_state_dict(of["adam"])

    def _step(self, name: str, loss: Tensor, entropy: Tensor) -> dict[str, Tensor]:
        """Update the network and the temperature of a learner, and return numbers to log."""
        self._descend(loss, name)
        log = self._log_temperatures[name]
        excess = log * (entropy - self._wanted_entropies[name])
        descend(excess, [log], self._temperature_adams[name], math.inf)
        return {
            f"policy_loss/{name}": loss.detach(),
            f"entropy/{name}": entropy,
            f"temperature/{name}": self.temperature(name),
        }


class SoftActors(EntropicActors[JointValues]):
    """Random choices of each learner, with a reward for entropy: HASAC (Liu et al. 2024).

    The critic has an output for each joint action, so that all expected values are exact, as in
    Christodoulou (2019) for one agent.
    """

    def act(self, situation: Situation, _: float, generator: torch.Generator) -> Tensor:
        """Choices drawn from the policies, (N, K)."""
        scores = self._choice_outputs(situation)
        noise = torch.empty_like(scores).exponential_(generator=generator).log_()
        return (scores - noise).argmax(-1)

    def next_values(
        self, targets: Sequence[Tensor], after: Situation, _: torch.Generator
    ) -> Tensor:
        """Soft values of the target critic, (N,): expected value plus temperature x entropy."""
        log_p = self._choice_outputs(after).log_softmax(-1)
        value = expected(self._critic(after.state, targets).amin(0), log_p.exp()).squeeze(-1)
        return value + sum(
            self.temperature(name) * entropies(log_p[:, numbers])
            for name, numbers in self.numbers.items()
        )

    def improve(self, situation: Situation, generator: torch.Generator) -> dict[str, Tensor]:
        """Raise the soft value by one learner after another, and return losses and entropies."""
        with torch.no_grad():
            table = self._critic(situation.state).amin(0)
        log_p = {name: self._log_p(name, situation) for name in self.nets}
        probabilities = torch.cat(list(log_p.values()), dim=1).detach().exp()
        logged: dict[str, Tensor] = {}
        for name in self._order(generator):
            numbers = self.numbers[name]
            free = range(*numbers.indices(probabilities.shape[1]))
            values = expected(table, probabilities, free)
            loss = soft_policy_loss(log_p[name], values, self.temperature(name))
            logged |= self._step(name, loss, entropies(log_p[name].detach()).mean())
            with torch.no_grad():
                probabilities[:, numbers] = self._log_p(name, situation).exp()
        return logged

    def _log_p(self, name: str, situation: Situation) -> Tensor:
        """Logarithms of a learner's probabilities of each choice, (N, k, L)."""
        scores = self.nets[name](situation.observations[name])
        return scores.unflatten(-1, (-1, self._outputs)).log_softmax(-1)


class GaussianActors(EntropicActors[ContinuousValues]):
    """Continuous actions of each learner, with a reward for entropy: HASAC (Liu et al. 2024).

    An action is the hyperbolic tangent of a normal number (Haarnoja et al. 2018), and gradients of
    the critic reach the policy through the action.
    """

    def act(self, situation: Situation, _: float, generator: torch.Generator) -> Tensor:
        """Actions drawn from the policies, (N, K)."""
        return self._draw_all(situation, generator)[0]

    def next_values(
        self, targets: Sequence[Tensor], after: Situation, generator: torch.Generator
    ) -> Tensor:
        """Soft values of drawn actions by the target critic, (N,)."""
        actions, log_p = self._draw_all(after, generator)
        value = self._critic.of_actions(after.state, actions, targets).amin(0)
        return value - sum(self.temperature(name) * log_p[name] for name in self.nets)

    def improve(self, situation: Situation, generator: torch.Generator) -> dict[str, Tensor]:
        """Raise the soft value by one learner after another, and return losses and entropies."""
        drawn = {name: self._draw(name, situation, generator) for name in self.nets}
        actions = torch.cat([part.detach() for part, _ in drawn.values()], dim=1)
        logged: dict[str, Tensor] = {}
        for name in self._order(generator):
            numbers = self.numbers[name]
            part, log_p = drawn[name]
            joint = torch.cat([actions[:, : numbers.start], part, actions[:, numbers.stop :]], 1)
            value = self._critic.of_actions(situation.state, joint).amin(0)
            loss = (self.temperature(name) * log_p - value).mean()
            logged |= self._step(name, loss, -log_p.detach().mean())
            with torch.no_grad():
                actions[:, numbers] = self._draw(name, situation, generator)[0]
        return logged

    def _draw_all(
        self, situation: Situation, generator: torch.Generator
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Actions of all learners, (N, K), and logarithms of the density of each, (N,)."""
        drawn = {name: self._draw(name, situation, generator) for name in self.nets}
        joint = torch.cat([actions for actions, _ in drawn.values()], dim=1)
        return joint, {name: log_p for name, (_, log_p) in drawn.items()}

    def _draw(
        self, name: str, situation: Situation, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Actions of a learner, (N, k), and logarithms of their densities, (N,)."""
        mean, log_std = self.nets[name](situation.observations[name]).chunk(2, dim=-1)
        log_std = log_std.clamp(LEAST_LOG_STD, MOST_LOG_STD)
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        return squashed(mean, log_std, noise)


def adam(parameters: Any, rate: float) -> torch.optim.Adam:
    """Adam (Kingma, Ba 2015), fused: one pass over all parameters."""
    return torch.optim.Adam(parameters, rate, fused=True)


def descend(
    loss: Tensor, parameters: Sequence[Tensor], optimiser: torch.optim.Adam, norm: float
) -> None:
    """Take a gradient step of some parameters, without gradients of others.

    Args:
        loss: the loss, ().
        parameters: parameters of the optimiser.
        optimiser: the optimiser.
        norm: largest norm of the gradient.
    """
    for parameter, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
        parameter.grad = gradient
    if norm < math.inf:
        nn.utils.clip_grad_norm_(parameters, norm)
    optimiser.step()


def best_replies(table: Tensor, choices: Tensor, order: Sequence[int], levels: int) -> Tensor:
    """Values of each number's choices for fixed choices of the others, one number after another.

    Args:
        table: values of all joint actions, (N, L^K).
        choices: choices at the beginning, (N, K).
        order: numbers in the order in which each changes to its best choice.
        levels: number of possibilities of each choice, L.

    Returns:
        Values, (N, K, L).
    """
    taken = nn.functional.one_hot(choices, levels).to(table.dtype)
    rows = torch.empty_like(taken)
    for number in order:
        row = expected(table, taken, (number,))
        rows[:, number] = row
        taken[:, number] = nn.functional.one_hot(row.argmax(-1), levels).to(table.dtype)
    return rows


def soft_policy_loss(log_p: Tensor, values: Tensor, temperature: Tensor) -> Tensor:
    """Negative of the soft value of k independent choices (Christodoulou 2019, eq. 12).

    Args:
        log_p: logarithms of the probabilities of each choice, (N, k, L).
        values: values of all combinations of the choices, (N, L^k).
        temperature: weight of the entropy, ().
    """
    value = expected(values, log_p.exp()).squeeze(-1)
    return -(value + temperature * entropies(log_p)).mean()


def entropies(log_p: Tensor) -> Tensor:
    """Entropies of independent choices, (N,), nats.

    Args:
        log_p: logarithms of the probabilities of each choice, (N, k, L).
    """
    return -(log_p.exp() * log_p).sum((-1, -2))


def squashed(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Hyperbolic tangents of normal numbers, and logarithms of their densities.

    With u = mean + std noise, the density of tanh(u) is that of u over 1 - tanh(u)^2 (Haarnoja et
    al. 2018, appendix C), whose logarithm is 2 (log 2 - u - softplus(-2 u)).

    Args:
        mean: means, (N, k).
        log_std: logarithms of standard deviations, (N, k).
        noise: standard normal numbers, (N, k).

    Returns:
        Actions, (N, k), and logarithms of their densities, (N,).
    """
    u = mean + log_std.exp() * noise
    normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
    slope = 2.0 * (math.log(2.0) - u - nn.functional.softplus(-2.0 * u))
    return u.tanh(), (normal - slope).sum(-1)
