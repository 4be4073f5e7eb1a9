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
from collections.abc import Collection, Sequence
from typing import Any

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
LAST_GAIN = 0.01
"""Gain of the last layer's initial weights; small, so that the initial outputs are near 0."""


class RunningMoments:
    """Running mean and variance of each column of the added rows (Chan, Golub, LeVeque 1983).

    Args:
        width: number of columns.

    Attributes:
        mean: mean of each column, (width,).
        variance: variance of each column, (width,).
        count: number of added rows.
    """

    def __init__(self, width: int) -> None:
        self.mean = torch.zeros(width, dtype=torch.float64)
        self.variance = torch.ones(width, dtype=torch.float64)
        self.count = 0

    @property
    def std(self) -> Tensor:
        """Standard deviation of each column, at least ``LEAST_STD``, (width,), f32."""
        return self.variance.sqrt().clamp_min(LEAST_STD).float()

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
        self.variance = (
            weight * self.variance
            + (1.0 - weight) * variance
            + weight * (1.0 - weight) * shift * shift
        )
        self.mean = self.mean + (1.0 - weight) * shift
        self.count = total

    def normalise(self, values: Tensor) -> Tensor:
        """Subtract the mean, divide by the standard deviation, and clip to -CLIP..CLIP."""
        return ((values - self.mean.float()) / self.std).clamp_(-CLIP, CLIP)

    def state_dict(self) -> dict[str, object]:
        """Return the moments, for ``load_state_dict``."""
        return {"mean": self.mean, "variance": self.variance, "count": self.count}

    def load_state_dict(self, values: dict[str, object]) -> None:
        """Restore the moments that ``state_dict`` returned."""
        self.mean, self.variance = _tensor(values["mean"]), _tensor(values["variance"])
        self.count = int(str(values["count"]))


def _tensor(value: object) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64).clone()


class _TanhBySigmoid(torch.autograd.Function):
    """Hyperbolic tangent computed from the logistic function s, tanh(x) = 2 s(2 x) - 1.

    On processors with AVX-512, PyTorch's logistic function is six times as fast as its tanh.
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
    """Layer with the hyperbolic tangent, equal to ``torch.tanh`` except for rounding."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the hyperbolic tangent of each element of x."""
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
    """Return a perceptron with orthogonal initial weights (Saxe et al. 2014) and biases of 0.

    Args:
        width: number of inputs.
        hidden: number of units in each hidden layer.
        out: number of outputs.
        activation: activation function of all layers except the last, ``tanh`` or ``relu``.
        last_gain: gain of the weights of the last layer.
        generator: random generator of the initial weights.
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
    """Return copies of each layer's weight, (out, in), and bias, (out,)."""
    return tuple(
        (layer.weight.detach().float().numpy().copy(), layer.bias.detach().float().numpy().copy())
        for layer in net
        if isinstance(layer, nn.Linear)
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


class Actor(nn.Module):
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
            generator: random generator of the actions.

        Returns:
            Actions, (B, k), and the logarithm of their joint probability, (B,). Continuous actions
            can be outside -1..1.
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
        """Return the log-probability of actions, (B,), and the mean entropy of the policy, ().

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
        """Return the log-probability of each option of each action, (B, k, choices)."""
        # log_softmax along a short last axis takes ten times as long as along a short first axis.
        by_choice = out.unflatten(-1, (-1, self.choices)).movedim(-1, 0).contiguous()
        return by_choice.log_softmax(0).movedim(0, -1)

    def _log_density(self, noise: Tensor) -> Tensor:
        """Return the log-density of actions, (B,), from standardised deviations from the mean."""
        each = -0.5 * noise * noise - self.log_std - 0.5 * math.log(2.0 * math.pi)
        return each.sum(-1)


def _of_chosen(log_p: Tensor, actions: Tensor) -> Tensor:
    """Return the joint log-probability of the chosen options, (B,)."""
    return log_p.gather(-1, actions.unsqueeze(-1)).squeeze(-1).sum(-1)


MOST_JOINT_ACTIONS = 729
"""Maximum number of joint actions, and so of critic outputs: 3^6, six actions of three options."""


class Perceptrons:
    """Ensemble of E perceptrons of equal shape, evaluated together.

    Args:
        number: number of perceptrons, E.
        width: number of inputs of each perceptron.
        out: number of outputs of each perceptron.
        settings: settings of the algorithm, with hidden layers and activation function.
        generator: random generator of the orthogonal initial weights (Saxe et al. 2014).

    Attributes:
        parameters: weights, (E, in, out), and biases, (E, 1, out), layer by layer.
    """

    def __init__(
        self,
        number: int,
        width: int,
        out: int,
        settings: OffPolicySettings,
        generator: torch.Generator,
    ) -> None:
        self.parameters: list[Tensor] = []
        self._activation = {"tanh": torch.tanh, "relu": torch.relu}[settings.activation]
        for units in (*settings.hidden, out):
            weights = torch.empty(number, width, units)
            gain = LAST_GAIN if len(self.parameters) == 2 * len(settings.hidden) else math.sqrt(2.0)
            for weight in weights:
                torch.nn.init.orthogonal_(weight, gain, generator=generator)
            self.parameters += [weights, torch.zeros(number, 1, units)]
            width = units
        for parameter in self.parameters:
            parameter.requires_grad_()

    def __call__(self, inputs: Tensor, parameters: Sequence[Tensor] | None = None) -> Tensor:
        """Return the outputs of all perceptrons, (E, N, out).

        Args:
            inputs: inputs, the same for all perceptrons, (N, width).
            parameters: parameters to use in place of the attribute, such as those of a target
                network.
        """
        used = self.parameters if parameters is None else parameters
        x = inputs.expand(len(used[0]), *inputs.shape)
        for i in range(0, len(used), 2):
            if i:
                x = self._activation(x)
            x = torch.baddbmm(used[i + 1], x, used[i])
        return x


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
        parameters: weights and biases of the critics.

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
        self.parameters = self._nets.parameters

    def __call__(self, state: Tensor, parameters: Sequence[Tensor] | None = None) -> Tensor:
        """Return the values of all joint actions, (E, N, L^K); the last choice varies fastest.

        Args:
            state: states, (N, width).
            parameters: parameters to use in place of the attribute, such as those of a target
                network.
        """
        out = self._nets(state, parameters)
        of_choices = len(self._of_choices)
        advantage = out[..., 1 : 1 + of_choices] @ self._of_choices.to(out.dtype)
        advantage = advantage + out[..., 1 + of_choices :]
        return out[..., :1] + advantage - advantage.mean(-1, keepdim=True)

    def of_actions(
        self, state: Tensor, actions: Tensor, parameters: Sequence[Tensor] | None = None
    ) -> Tensor:
        """Return the values of joint actions, (E, N).

        Args:
            state: states, (N, width).
            actions: chosen options, (N, K).
            parameters: parameters to use in place of the attribute, such as those of a target
                network.
        """
        table = self(state, parameters)
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
        parameters: weights and biases of the critics.
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
        self.parameters = self._nets.parameters

    def of_actions(
        self, state: Tensor, actions: Tensor, parameters: Sequence[Tensor] | None = None
    ) -> Tensor:
        """Return the values of joint actions, (E, N).

        Args:
            state: states, (N, width).
            actions: actions within -1..1, (N, K).
            parameters: parameters to use in place of the attribute, such as those of a target
                network.
        """
        return self._nets(torch.cat([state, actions], dim=-1), parameters).squeeze(-1)


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
