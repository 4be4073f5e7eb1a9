"""Networks of policies and critics, distributions of actions, moments of inputs, random numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sdc_taichi.learning.algorithms import OnPolicySettings
from sdc_taichi.learning.policy import CHOICES, Activation, PolicyNetwork
from sdc_taichi.learning.stream import LearnerSpaces
from sdc_taichi.types import F32

USES = ("weights", "actions", "batches", "order")
"""Uses of random numbers: first weights of networks, actions drawn from policies, steps to learn
from, and the order in which learners are updated."""


def generators(seed: int) -> dict[str, torch.Generator]:
    """Generators by use, so that drawing more for one use changes no other.

    Args:
        seed: seed of the training, from which each generator gets a seed that no other has.
    """
    return {use: torch.Generator().manual_seed(seed * len(USES) + i) for i, use in enumerate(USES)}


LEAST_STD = 1e-2
"""Smallest standard deviation to divide by, so that almost constant entries stay small."""
CLIP = 10.0
"""Largest absolute normalised value."""
LAST_GAIN = 0.01
"""Gain of the last weights of policies and of critics of actions, whose outputs begin near 0."""


class RunningMoments:
    """Mean and variance of all rows seen, by column (Chan, Golub, LeVeque 1983).

    Args:
        width: number of columns.

    Attributes:
        mean: mean of each column, (width,).
        variance: variance of each column, (width,).
        count: number of rows seen.
    """

    def __init__(self, width: int) -> None:
        self.mean = torch.zeros(width, dtype=torch.float64)
        self.variance = torch.ones(width, dtype=torch.float64)
        self.count = 0

    @property
    def std(self) -> Tensor:
        """Standard deviation to divide by, (width,), f32."""
        return self.variance.sqrt().clamp_min(LEAST_STD).float()

    def add(self, rows: Tensor) -> None:
        """Take rows, (n, width), into account."""
        n = len(rows)
        row_mean = rows.mean(0)
        # Many times faster than Tensor.var, which goes through rows one by one.
        variance = (rows - row_mean).square_().mean(0).double()
        mean = row_mean.double()
        total = self.count + n
        shift = mean - self.mean
        weight = self.count / total
        self.variance = (
            weight * self.variance
            + (1.0 - weight) * variance
            + weight * (1.0 - weight) * shift * shift
        )
        self.mean = self.mean + (1.0 - weight) * shift
        self.count = total

    def normalise(self, values: Tensor) -> Tensor:
        """Values less the mean over the standard deviation, within -CLIP..CLIP."""
        return ((values - self.mean.float()) / self.std).clamp_(-CLIP, CLIP)

    def state_dict(self) -> dict[str, object]:
        """Everything that ``load_state_dict`` needs."""
        return {"mean": self.mean, "variance": self.variance, "count": self.count}

    def load_state_dict(self, values: dict[str, object]) -> None:
        """Restore the state that ``state_dict`` returned."""
        self.mean, self.variance = _tensor(values["mean"]), _tensor(values["variance"])
        self.count = int(str(values["count"]))


def _tensor(value: object) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone()


class _TanhBySigmoid(torch.autograd.Function):
    """The hyperbolic tangent by the logistic function, tanh(x) = 2 s(2 x) - 1.

    PyTorch's logistic function takes a sixth of the time of its tanh on processors with AVX-512.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        out = (2.0 * x).sigmoid_().mul_(2.0).sub_(1.0)
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (out,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradients[0], out)


class Tanh(nn.Module):
    """Hyperbolic tangent, to within rounding."""

    def forward(self, x: Tensor) -> Tensor:
        """Tangents of x, of its shape."""
        return _TanhBySigmoid.apply(x)


ACTIVATIONS = {"tanh": Tanh, "relu": nn.ReLU}
FIRST_STD = 0.5
"""Standard deviation of continuous actions before training."""


def perceptron(
    width: int,
    hidden: Sequence[int],
    out: int,
    *,
    activation: str,
    last_gain: float,
    generator: torch.Generator,
) -> nn.Sequential:
    """Layers with orthogonal weights (Saxe et al. 2014) and biases of 0.

    Args:
        width: number of inputs.
        hidden: units of each hidden layer.
        out: number of outputs.
        activation: ``tanh`` or ``relu``, after all layers but the last.
        last_gain: gain of the weights of the last layer.
        generator: source of the weights.
    """
    layers: list[nn.Module] = []
    for units in hidden:
        layers += [_linear(width, units, math.sqrt(2.0), generator), ACTIVATIONS[activation]()]
        width = units
    return nn.Sequential(*layers, _linear(width, out, last_gain, generator))


def _linear(width: int, out: int, gain: float, generator: torch.Generator) -> nn.Linear:
    layer = nn.utils.skip_init(nn.Linear, width, out)
    nn.init.orthogonal_(layer.weight, gain, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


def layers_of(net: nn.Sequential) -> tuple[tuple[F32, F32], ...]:
    """Copies of the weight, (out, in), and bias, (out,), of each layer."""
    return tuple(
        (layer.weight.detach().float().numpy().copy(), layer.bias.detach().float().numpy().copy())
        for layer in net
        if isinstance(layer, nn.Linear)
    )


def policy_network(
    net: nn.Sequential, moments: RunningMoments, spaces: LearnerSpaces, activation: Activation
) -> PolicyNetwork:
    """The network of a policy with copies of the weights of a perceptron.

    Its actions are the choices with the highest scores, or the outputs cut at -1 and 1.

    Args:
        net: the perceptron.
        moments: moments of its observations.
        spaces: sizes of the observations and actions of its learner.
        activation: function of all layers but the last.
    """
    return PolicyNetwork(
        agents=spaces.agents,
        mean=moments.mean.float().numpy().copy(),
        std=moments.std.numpy().copy(),
        clip=CLIP,
        layers=layers_of(net),
        activation=activation,
        head="clip" if spaces.choices is None else "argmax",
        choices=spaces.choices or CHOICES,
    )


class Actor(nn.Module):
    """Policy of a learner: a distribution of its actions for each observation.

    Actions are k independent choices, or, where any number is possible, k independent normal
    distributions whose standard deviations do not depend on the observation.

    Args:
        spaces: sizes of the observations and actions of the learner.
        settings: hidden layers and activation.
        generator: source of the weights.
    """

    def __init__(
        self, spaces: LearnerSpaces, settings: OnPolicySettings, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.choices = spaces.choices
        outputs = spaces.action_width * (spaces.choices or 1)
        self.net = perceptron(
            spaces.observation_width,
            settings.hidden,
            outputs,
            activation=settings.activation,
            last_gain=LAST_GAIN,
            generator=generator,
        )
        if spaces.choices is None:
            self.log_std = nn.Parameter(torch.full((outputs,), math.log(FIRST_STD)))

    def sample(self, observations: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw actions.

        Args:
            observations: normalised observations, (B, n).
            generator: source of the draws.

        Returns:
            Actions, (B, k), and logarithms of their probabilities, (B,). Continuous ones may lie
            beyond -1..1.
        """
        out = self.net(observations)
        if self.choices is not None:
            log_p = self._log_probabilities(out)
            noise = torch.empty(log_p.shape, dtype=log_p.dtype).exponential_(generator=generator)
            actions = (log_p - noise.log_()).argmax(-1)
            return actions, _of_chosen(log_p, actions)
        std = self.log_std.exp()
        noise = torch.randn(out.shape, generator=generator, dtype=out.dtype)
        actions = out + std * noise
        return actions, self._log_density(noise)

    def evaluate(self, observations: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms of the probabilities of actions, (B,), and the mean entropy.

        Args:
            observations: normalised observations, (B, n).
            actions: actions, (B, k).
        """
        out = self.net(observations)
        if self.choices is not None:
            log_p = self._log_probabilities(out)
            return _of_chosen(log_p, actions), -(log_p.exp() * log_p).sum((-1, -2)).mean()
        entropy = (self.log_std + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
        return self._log_density((actions - out) / self.log_std.exp()), entropy

    def _log_probabilities(self, out: Tensor) -> Tensor:
        """Logarithms of the probabilities of each choice, (B, k, choices)."""
        # Over a few columns, log_softmax takes ten times as long as over as few long rows.
        by_choice = out.unflatten(-1, (-1, self.choices)).movedim(-1, 0).contiguous()
        return by_choice.log_softmax(0).movedim(0, -1)

    def _log_density(self, noise: Tensor) -> Tensor:
        """Logarithm of the density at a distance from the mean in standard deviations, (B,)."""
        each = -0.5 * noise * noise - self.log_std - 0.5 * math.log(2.0 * math.pi)
        return each.sum(-1)


def _of_chosen(log_p: Tensor, actions: Tensor) -> Tensor:
    """Logarithm of the probability of the choices made, (B,)."""
    return log_p.gather(-1, actions.unsqueeze(-1)).squeeze(-1).sum(-1)
