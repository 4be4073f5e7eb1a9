"""Networks of policies and critics, and distributions of actions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.forward import Activation
from sdc_taichi.learning.normalise import CLIP, RunningMoments
from sdc_taichi.learning.policy import CHOICES, PolicyNetwork
from sdc_taichi.learning.settings import OnPolicySettings
from sdc_taichi.learning.stream import LearnerSpaces
from sdc_taichi.types import F32


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
    """Weight, (out, in), and bias, (out,), of each layer, as arrays of their own."""
    return tuple(
        (layer.weight.detach().float().numpy().copy(), layer.bias.detach().float().numpy().copy())
        for layer in net
        if isinstance(layer, nn.Linear)
    )


def policy_network(
    net: nn.Sequential, moments: RunningMoments, spaces: LearnerSpaces, activation: Activation
) -> PolicyNetwork:
    """The network of a policy that a perceptron has come to, with arrays of its own.

    Its actions are the choices of the highest scores, or the outputs cut at -1 and 1.

    Args:
        net: the perceptron.
        moments: moments of its observations.
        spaces: what its learner sees and does.
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


def load_network(
    net: nn.Sequential, moments: RunningMoments, network: PolicyNetwork, rows: int
) -> None:
    """Make a perceptron and the moments of its inputs those of a policy's network.

    Args:
        net: the perceptron.
        moments: moments of what it observes.
        network: the policy's network.
        rows: rows that the moments are taken to have seen: the more, the slower they change.

    Raises:
        ConfigError: layers or functions that differ.
    """
    layers = [layer for layer in net if isinstance(layer, nn.Linear)]
    sizes = (layers[0].in_features, *(layer.out_features for layer in layers))
    who = f"network of {', '.join(network.agents)}"
    if network.sizes != sizes:
        raise ConfigError(f"{who}: has {network.sizes} units; valid here is {sizes}")
    kinds = [
        name for name, kind in ACTIVATIONS.items() if len(net) == 1 or isinstance(net[1], kind)
    ]
    if network.activation not in kinds:
        raise ConfigError(f"{who}: has {network.activation} units; valid here is {kinds[0]}")
    if network.clip != CLIP:
        raise ConfigError(f"{who}: cuts observations at {network.clip:g}; valid here is {CLIP:g}")
    with torch.no_grad():
        for layer, (weight, bias) in zip(layers, network.layers, strict=True):
            layer.weight.copy_(torch.from_numpy(weight.copy()))
            layer.bias.copy_(torch.from_numpy(bias.copy()))
    moments.mean = torch.from_numpy(network.mean.astype(np.float64))
    moments.variance = torch.from_numpy(network.std.astype(np.float64) ** 2)
    moments.count = rows


class Actor(nn.Module):
    """Policy of a learner: a distribution of its actions for each observation.

    Actions are k independent choices, or, where any number is possible, k independent normal
    distributions whose standard deviations do not depend on the observation.

    Args:
        spaces: what the learner sees and does.
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
            last_gain=0.01,
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
