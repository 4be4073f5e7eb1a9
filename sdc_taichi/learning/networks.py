"""Networks of policies and critics, distributions of actions, moments of inputs, random numbers.

Off-policy critics estimate the value of joint actions, which consist of the K actions of all
learners in a step. If each of the K actions is one of L levels, there are L^K joint actions, and a
critic has one output for each of them. Expected values over independent choices are then exact
sums.

In shapes, B and N are numbers of rows of a batch, n is the number of inputs, and E the number of
critics.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.algorithms import OffPolicySettings, OnPolicySettings
from sdc_taichi.learning.policy import CHOICES, Activation, Head, PolicyNetwork
from sdc_taichi.learning.stream import LearnerSpaces
from sdc_taichi.types import F32

USES = ("weights", "actions", "batches", "order")
"""Uses of random numbers: initial weights of networks, actions drawn from policies, choice of the
steps in a batch, and the order in which learners are updated."""


def generators(seed: int) -> dict[str, torch.Generator]:
    """Return a random generator for each use, so that the numbers of one use affect no other.

    Args:
        seed: seed of the training, from which each generator gets a different seed.
    """
    return {use: torch.Generator().manual_seed(seed * len(USES) + i) for i, use in enumerate(USES)}


LEAST_STD = 1e-2
"""Lower bound of the standard deviation for normalisation; nearly constant inputs stay small."""
CLIP = 10.0
"""Maximum absolute value of a normalised input."""
MEAN_SHARE, SQUARE_SHARE = 0.9, 0.999
"""Shares of the previous values in the moving averages of Adam (beta_1 and beta_2)."""
LAST_GAIN = 0.01
"""Gain of the last layer's initial weights; small, so that the initial outputs are near 0."""


class RunningMoments:
    """Running mean and variance of each column of the added rows (Chan, Golub, LeVeque 1983).

    Attributes:
        mean: mean of each column, (width,).
        variance: variance of each column, (width,).
        count: number of added rows.
        std: standard deviation of each column, at least ``LEAST_STD``, (width,), f32.
    """

    def __init__(self, width: int) -> None:
        self._set(torch.zeros(width), torch.ones(width), 0)

    def add(self, rows: Tensor) -> None:
        """Update the moments with rows, (n, width)."""
        n = len(rows)
        if not n:
            return
        row_mean = rows.mean(0)
        # This is many times faster than Tensor.var, which iterates over single rows.
        variance = (rows - row_mean).square_().mean(0).double()
        mean = row_mean.double()
        total = self.count + n
        shift = mean - self.mean
        weight = self.count / total
        variance = (
            weight * self.variance
            + (1.0 - weight) * variance
            + weight * (1.0 - weight) * shift * shift
        )
        self._set(self.mean + (1.0 - weight) * shift, variance, total)

    def normalise(self, values: Tensor) -> Tensor:
        """Subtract the mean, divide by the standard deviation, and clip to -CLIP..CLIP."""
        return (values - self._mean).div_(self.std).clamp_(-CLIP, CLIP)

    def state_dict(self) -> dict[str, object]:
        """Return the moments, for ``load_state_dict``."""
        return {"mean": self.mean, "variance": self.variance, "count": self.count}

    def load_state_dict(self, values: dict[str, object]) -> None:
        """Restore the moments that ``state_dict`` returned."""
        self._set(values["mean"], values["variance"], int(str(values["count"])))

    def _set(self, mean: object, variance: object, count: int) -> None:
        self.mean = torch.as_tensor(mean, dtype=torch.float64)
        self.variance = torch.as_tensor(variance, dtype=torch.float64)
        self.count = count
        self._mean = self.mean.float()
        self.std = self.variance.sqrt().clamp_min(LEAST_STD).float()


class Adam:
    """Optimiser Adam (Kingma and Ba 2015) of one tensor, with limited norms of gradients.

    Args:
        weights: tensor to update.
        rate: learning rate.
        norm: maximum norm of a gradient; larger gradients are scaled down.
        epsilon: lower bound of the divisor of a step.

    Attributes:
        rate: learning rate.
    """

    def __init__(
        self, weights: Tensor, rate: float, norm: float = math.inf, epsilon: float = 1e-8
    ) -> None:
        self.rate, self._norm, self._epsilon = rate, norm, epsilon
        self._leaf, self._weights = weights, weights.detach()
        self._mean, self._square = torch.zeros_like(weights), torch.zeros_like(weights)
        self._steps = 0

    def descend(self, loss: Tensor) -> None:
        """Take a step that lowers a loss, shape (); no other gradient is computed."""
        self.step(*torch.autograd.grad(loss, self._leaf))

    def step(self, gradient: Tensor) -> None:
        """Take a step against the gradient of the weights."""
        norm = float(torch.linalg.vector_norm(gradient))
        if norm > self._norm:
            gradient = gradient * (self._norm / norm)
        self._steps += 1
        self._mean.lerp_(gradient, 1.0 - MEAN_SHARE)
        self._square.mul_(SQUARE_SHARE).addcmul_(gradient, gradient, value=1.0 - SQUARE_SHARE)
        size = (self._square / (1.0 - SQUARE_SHARE**self._steps)).sqrt_().add_(self._epsilon)
        rate = self.rate / (1.0 - MEAN_SHARE**self._steps)
        self._weights.addcdiv_(self._mean, size, value=-rate)

    def state_dict(self) -> dict[str, Any]:
        """Return weights and moments, for ``load_state_dict``."""
        moments = {"mean": self._mean, "square": self._square, "steps": self._steps}
        return {"weights": self._weights, **moments}

    def load_state_dict(self, values: Mapping[str, Any]) -> None:
        """Restore weights and moments that ``state_dict`` returned."""
        self._weights.copy_(torch.as_tensor(values["weights"]))
        self._mean.copy_(torch.as_tensor(values["mean"]))
        self._square.copy_(torch.as_tensor(values["square"]))
        self._steps = int(values["steps"])


FIRST_STD = 0.5
"""Standard deviation of continuous actions before training."""


class Perceptrons:
    """Ensemble of E perceptrons of equal shape, evaluated together.

    Initial weights are orthogonal (Saxe et al. 2014), and initial biases are 0. ``run`` and
    ``gradient`` take less time than automatic differentiation, as calls of small operations do.

    Args:
        number: number of perceptrons, E.
        width: number of inputs of each perceptron.
        out: number of outputs of each perceptron.
        settings: settings of the algorithm, with hidden layers and activation function.
        generator: random generator of the initial weights.
        last_gain: gain of the weights of the last layer.
        further: number of further parameters of the caller.

    Attributes:
        weights: weights and biases of all layers in one tensor, and then the further parameters.
    """

    def __init__(
        self,
        number: int,
        width: int,
        out: int,
        settings: OnPolicySettings | OffPolicySettings,
        generator: torch.Generator,
        *,
        last_gain: float = LAST_GAIN,
        further: int = 0,
    ) -> None:
        self._number, self._is_tanh = number, settings.activation == "tanh"
        self._shapes: list[tuple[int, int, int]] = []
        for before, after in pairwise((width, *settings.hidden, out)):
            self._shapes += [(number, before, after), (number, 1, after)]
        ends = [0, *accumulate(map(math.prod, self._shapes))]
        self._places = [slice(*places) for places in pairwise(ends)]
        self.weights = torch.zeros(ends[-1] + further, requires_grad=True)
        self._flat = self.weights.detach()
        self._layers = self.layers(self._flat)
        for i, (weights, _) in enumerate(self._layers):
            gain = last_gain if i == len(settings.hidden) else math.sqrt(2.0)
            for weight in weights:
                nn.init.orthogonal_(weight, gain, generator=generator)

    def __call__(self, inputs: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the outputs of all perceptrons, (E, N, out), for automatic differentiation.

        Args:
            inputs: inputs, the same for all perceptrons, (N, width).
            weights: weights to use in place of the attribute, such as those of a target network.
        """
        used = self.weights if weights is None else weights
        return self.run(inputs.expand(self._number, -1, -1), used)[-1]

    def layers(self, weights: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return views of weights: weight, (E, in, out), and bias, (E, 1, out), of each layer.

        Args:
            weights: tensor like the attribute.
        """
        parts = zip(self._places, self._shapes, strict=True)
        views = [weights[place].view(shape) for place, shape in parts]
        return list(zip(views[::2], views[1::2], strict=True))

    def run(self, inputs: Tensor, weights: Tensor | None = None) -> list[Tensor]:
        """Return the inputs of each layer, (E, N, in) each, and the outputs, (E, N, out).

        Args:
            inputs: inputs, (E, N, width).
            weights: weights to use in place of the attribute.
        """
        values = [inputs]
        layers = self._layers if weights is None else self.layers(weights)
        for i, (weight, bias) in enumerate(layers):
            if i:
                values[i] = values[i].tanh_() if self._is_tanh else values[i].relu_()
            values.append(torch.baddbmm(bias, values[i], weight))
        return values

    def gradient(self, values: Sequence[Tensor], of_out: Tensor) -> Tensor:
        """Return the gradient of the weights; that of further parameters is 0.

        Args:
            values: inputs of each layer, as ``run`` returned them.
            of_out: gradient of the outputs, (E, N, out).
        """
        gradient = torch.zeros_like(self._flat)
        parts = list(zip(self._layers, self.layers(gradient), values, strict=False))
        for i, ((weight, _), (of_weight, of_bias), inputs) in reversed(list(enumerate(parts))):
            torch.bmm(inputs.transpose(1, 2), of_out, out=of_weight)
            torch.sum(of_out, 1, keepdim=True, out=of_bias)
            if i:
                of_out = torch.bmm(of_out, weight.transpose(1, 2))
                if self._is_tanh:
                    _TANH_BACKWARD(of_out, inputs, grad_input=of_out)
                else:
                    _RELU_BACKWARD(of_out, inputs, 0, grad_input=of_out)
        return gradient


_TANH_BACKWARD = torch.ops.aten.tanh_backward.grad_input
_RELU_BACKWARD = torch.ops.aten.threshold_backward.grad_input


def layers_of(net: Perceptrons) -> tuple[tuple[F32, F32], ...]:
    """Return copies of each layer's weight, (out, in), and bias, (out,), of a single perceptron."""
    return tuple(
        (weight[0].T.float().numpy().copy(), bias[0, 0].float().numpy().copy())
        for weight, bias in net.layers(net.weights.detach())
    )


def policy_network(
    layers: tuple[tuple[F32, F32], ...],
    mean: F32,
    std: F32,
    spaces: LearnerSpaces,
    activation: Activation = "tanh",
    head: Head = "clip",
) -> PolicyNetwork:
    """Return a learner's policy as a network that runs without PyTorch.

    Args:
        layers: weight, (out, in), and bias, (out,), of each layer.
        mean: mean of the observations, (n,).
        std: standard deviation of the observations, (n,).
        spaces: sizes of the observations and actions of the learner.
        activation: activation function of all layers except the last.
        head: function that maps outputs to continuous actions; for discrete choices, the option
            with the highest score is taken instead.
    """
    return PolicyNetwork(
        agents=spaces.agents,
        mean=mean,
        std=std,
        clip=CLIP,
        layers=layers,
        activation=activation,
        head=head if spaces.choices is None else "argmax",
        choices=spaces.choices or CHOICES,
    )


class Evaluation(NamedTuple):
    """Probability of N actions, with the values that the gradients are computed from."""

    log_p: Tensor
    """Logarithm of the joint probability of the k actions, (N,)."""
    entropy: Tensor
    """Mean entropy of the policy, shape ()."""
    values: list[Tensor]
    """Inputs and outputs of the layers of the network."""
    parts: tuple[Tensor, ...]
    """Intermediate results."""


class Actor:
    """Stochastic policy of a learner: a distribution of its k actions for each observation.

    The k actions are independent. Discrete actions have categorical distributions. Continuous
    actions have normal distributions whose standard deviations do not depend on the observation.

    Args:
        spaces: sizes of the observations and actions of the learner.
        settings: settings of the algorithm, with hidden layers and activation function.
        generator: random generator of the initial weights.
    """

    def __init__(
        self, spaces: LearnerSpaces, settings: OnPolicySettings, generator: torch.Generator
    ) -> None:
        self.choices = spaces.choices
        width, outputs = spaces.observation_width, spaces.action_width * (spaces.choices or 1)
        further = outputs if spaces.choices is None else 0
        self.net = Perceptrons(1, width, outputs, settings, generator, further=further)
        if spaces.choices is None:
            self.log_std = self.net.weights.detach()[-outputs:].fill_(math.log(FIRST_STD))

    def sample(self, observations: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw actions.

        Args:
            observations: normalised observations, (B, n).
            generator: random generator of the actions.

        Returns:
            Actions, (B, k), and the logarithm of their joint probability, (B,). Continuous actions
            can be outside -1..1.
        """
        out = self.net.run(observations[None])[-1][0]
        if self.choices is not None:
            log_p = self._log_probabilities(out)
            noise = torch.empty_like(log_p).exponential_(generator=generator)
            actions = (log_p - noise.log_()).argmax(1)
            return actions.T, _of_chosen(log_p, actions.unsqueeze(1))
        noise = torch.randn(out.shape, generator=generator, dtype=out.dtype)
        return out + self.log_std.exp() * noise, self._log_density(noise)

    def evaluate(self, observations: Tensor, actions: Tensor) -> Evaluation:
        """Return the log-probability of actions and the entropy of the policy.

        Args:
            observations: normalised observations, (N, n).
            actions: actions, (N, k).
        """
        values = self.net.run(observations[None])
        out = values[-1][0]
        if self.choices is not None:
            log_p, chosen = self._log_probabilities(out), actions.T.unsqueeze(1)
            p = log_p.exp()
            weighted = p * log_p
            each = weighted.sum(1, keepdim=True)
            entropy = -each.sum() / len(out)
            return Evaluation(
                _of_chosen(log_p, chosen), entropy, values, (chosen, p, weighted, each)
            )
        deviation = (actions - out) / self.log_std.exp()
        entropy = (self.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
        return Evaluation(self._log_density(deviation), entropy, values, (deviation,))

    def gradient(self, evaluation: Evaluation, of_log_p: Tensor, of_entropy: float) -> Tensor:
        """Return the gradient of a loss for all weights; the evaluation is used up.

        Args:
            evaluation: result of ``evaluate``.
            of_log_p: derivative of the loss for the log-probability of each action, (N,).
            of_entropy: derivative of the loss for the mean entropy.
        """
        if self.choices is not None:
            chosen, p, weighted, each = evaluation.parts
            share = -of_entropy / len(of_log_p)
            # The derivative of log_p for out is 1 (of the chosen option) less p, and that of the
            # entropy is p (each - log p).
            of_out = weighted.mul_(share).addcmul_(
                p, torch.add(of_log_p, each, alpha=share), value=-1
            )
            of_out.scatter_add_(1, chosen, of_log_p.expand(chosen.shape))
            return self.net.gradient(evaluation.values, of_out.flatten(0, 1).T[None])
        (deviation,) = evaluation.parts
        of_out = of_log_p[:, None] * deviation / self.log_std.exp()
        gradient = self.net.gradient(evaluation.values, of_out[None])
        of_log_std = (of_log_p[:, None] * (deviation.square() - 1.0)).sum(0) + of_entropy
        gradient[-len(of_log_std) :] = of_log_std
        return gradient

    def _log_probabilities(self, out: Tensor) -> Tensor:
        """Return the log-probability of each option of each action, (k, choices, N)."""
        # log_softmax along a short last axis takes ten times as long as along a short first axis.
        by_choice = out.T.contiguous().unflatten(0, (-1, self.choices))
        return by_choice.log_softmax(1)

    def _log_density(self, deviation: Tensor) -> Tensor:
        """Return the log-density of actions, (N,), from standardised deviations from the mean."""
        each = -0.5 * deviation * deviation - self.log_std - 0.5 * math.log(2.0 * math.pi)
        return each.sum(-1)


def _of_chosen(log_p: Tensor, chosen: Tensor) -> Tensor:
    """Return the joint log-probability of chosen options, (k, 1, N), as (N,)."""
    return log_p.gather(1, chosen).sum((0, 1))


MOST_JOINT_ACTIONS = 729
"""Maximum number of joint actions, and so of critic outputs: 3^6, six actions of three options."""


class JointValues:
    """E critics that estimate the value of every joint action of K discrete choices in a state.

    The critics are dueling networks (Wang et al. 2016), Q = V + A - mean A. The advantage of a
    joint action is the sum of one term for each choice and one for their combination: A(a) =
    A_1(a_1) + ... + A_K(a_K) + A_all(a). Any table of values can be written in this form. If the
    effect of a choice does not depend on the other choices, it is learned from every step with
    that choice.

    Args:
        number: number of critics, E.
        width: number of entries of a state.
        choices: number of choices in a step, K.
        settings: settings of the algorithm, with hidden layers and activation function.
        generator: random generator of the initial weights.
        levels: number of options of each choice, L.

    Attributes:
        weights: weights and biases of the critics.

    Raises:
        ConfigError: there are more than ``MOST_JOINT_ACTIONS`` joint actions.
    """

    def __init__(
        self,
        number: int,
        width: int,
        choices: int,
        settings: OffPolicySettings,
        generator: torch.Generator,
        levels: int = CHOICES,
    ) -> None:
        joint_actions = levels**choices
        if joint_actions > MOST_JOINT_ACTIONS:
            raise ConfigError(
                f"{choices} choices of {levels} in a step are {joint_actions} joint actions; valid "
                f"is at most {MOST_JOINT_ACTIONS}: fewer levels, another algorithm, or hasac with "
                "continuous actions and levels=null"
            )
        self._places = levels ** torch.arange(choices - 1, -1, -1)
        digits = torch.arange(joint_actions)[:, None] // self._places % levels
        one_hot = torch.nn.functional.one_hot(digits, levels).flatten(1)
        # The outputs are V, then A_1 ... A_K with L levels each, then A_all.
        self._of_choices = one_hot.T.float()
        out = 1 + levels * choices + joint_actions
        self._nets = Perceptrons(number, width, out, settings, generator)
        self.weights = self._nets.weights

    def __call__(self, state: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the values of all joint actions, (E, N, L^K); the last choice varies fastest.

        Args:
            state: states, (N, width).
            weights: weights to use in place of the attribute, such as those of a target network.
        """
        out = self._nets(state, weights)
        of_choices = len(self._of_choices)
        advantage = out[..., 1 : 1 + of_choices] @ self._of_choices.to(out.dtype)
        advantage = advantage + out[..., 1 + of_choices :]
        return out[..., :1] + advantage - advantage.mean(-1, keepdim=True)

    def of_actions(self, state: Tensor, actions: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the values of joint actions, (E, N).

        Args:
            state: states, (N, width).
            actions: chosen options, (N, K).
            weights: weights to use in place of the attribute, such as those of a target network.
        """
        table = self(state, weights)
        joint = (actions.long() * self._places).sum(-1)
        return table.gather(-1, joint.expand(len(table), -1).unsqueeze(-1)).squeeze(-1)


class ContinuousValues:
    """E critics that estimate the value of K continuous actions, each within -1..1, in a state.

    Args:
        number: number of critics, E.
        width: number of entries of a state.
        numbers: number of actions in a step, K.
        settings: settings of the algorithm, with hidden layers and activation function.
        generator: random generator of the initial weights.

    Attributes:
        weights: weights and biases of the critics.
    """

    def __init__(
        self,
        number: int,
        width: int,
        numbers: int,
        settings: OffPolicySettings,
        generator: torch.Generator,
    ) -> None:
        self._nets = Perceptrons(number, width + numbers, 1, settings, generator)
        self.weights = self._nets.weights

    def of_actions(self, state: Tensor, actions: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the values of joint actions, (E, N).

        Args:
            state: states, (N, width).
            actions: actions within -1..1, (N, K).
            weights: weights to use in place of the attribute, such as those of a target network.
        """
        return self._nets(torch.cat([state, actions], dim=-1), weights).squeeze(-1)


def expected(table: Tensor, probabilities: Tensor, free: Collection[int] = ()) -> Tensor:
    """Return the expected values of joint actions under independent random choices.

    Args:
        table: values of all joint actions, (N, L^K).
        probabilities: probability of each option of each choice, (N, K, L).
        free: indices of the F choices for which no expectation is taken.

    Returns:
        Expected value of each combination of the free choices, (N, L^F).
    """
    right, levels = 1, probabilities.shape[-1]
    for choice in reversed(range(probabilities.shape[1])):
        if choice in free:
            right *= levels
            continue
        table = table.view(len(table), -1, levels, right)
        table = torch.einsum("nlcr,nc->nlr", table, probabilities[:, choice])
        table = table.flatten(1)
    return table
