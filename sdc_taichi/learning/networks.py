"""Networks of policies and critics, distributions of actions, moments of inputs, random numbers.

Off-policy critics value the actions of all learners together. K numbers are decided in a step. If
each is one of L choices, there are L^K joint actions, and a critic has one output for each:
expected values over independent choices are then exact sums.
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
    layers: tuple[tuple[F32, F32], ...],
    mean: F32,
    std: F32,
    spaces: LearnerSpaces,
    activation: Activation = "tanh",
    head: Head = "clip",
) -> PolicyNetwork:
    """The network of the policy of a learner.

    Args:
        layers: weight, (out, in), and bias, (out,), of each layer.
        mean: mean of the observations, (n,).
        std: standard deviation of the observations, (n,).
        spaces: sizes of the observations and actions of the learner.
        activation: function of all layers but the last.
        head: how continuous actions follow from the outputs; choices are those of highest score.
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


MOST_JOINT_ACTIONS = 729
"""Largest number of joint actions that a critic values: those of six choices out of three."""


class Perceptrons:
    """E perceptrons of equal shape, evaluated together.

    Args:
        number: number of perceptrons, E.
        width: number of inputs of each.
        out: number of outputs of each.
        settings: hidden layers and their activation.
        generator: source of the weights, which are orthogonal (Saxe et al. 2014).

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
        """Outputs, (E, N, out).

        Args:
            inputs: (N, width).
            parameters: weights and biases to use instead, such as those of a target network.
        """
        used = self.parameters if parameters is None else parameters
        x = inputs.expand(len(used[0]), *inputs.shape)
        for i in range(0, len(used), 2):
            if i:
                x = self._activation(x)
            x = torch.baddbmm(used[i + 1], x, used[i])
        return x


class JointValues:
    """Values of all joint actions of K choices in a state, by E critics.

    The output is dueling (Wang et al. 2016), Q = V + A - mean A. The advantage of a joint action is
    the sum of one term for each choice and one for their combination: A(a) = A_1(a_1) + ... +
    A_K(a_K) + A_all(a). Any table has this form, and the effect of a choice that does not depend on
    the other choices is learned from every step in which it was made.

    Args:
        number: number of critics, E.
        width: number of entries of a state.
        choices: number of choices in a step, K.
        settings: hidden layers and their activation.
        generator: source of the weights.
        levels: number of possibilities of each choice, L.

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
        # Outputs are V, then A_1 ... A_K, one for each level, then A_all.
        self._of_choices = one_hot.T.float()
        out = 1 + levels * choices + joint_actions
        self._nets = Perceptrons(number, width, out, settings, generator)
        self.parameters = self._nets.parameters

    def __call__(self, state: Tensor, parameters: Sequence[Tensor] | None = None) -> Tensor:
        """Values of all joint actions in each state, (E, N, L^K); the last choice varies fastest.

        Args:
            state: (N, width).
            parameters: weights and biases to use instead, such as those of a target network.
        """
        out = self._nets(state, parameters)
        of_choices = len(self._of_choices)
        advantage = out[..., 1 : 1 + of_choices] @ self._of_choices.to(out.dtype)
        advantage = advantage + out[..., 1 + of_choices :]
        return out[..., :1] + advantage - advantage.mean(-1, keepdim=True)

    def of_actions(
        self, state: Tensor, actions: Tensor, parameters: Sequence[Tensor] | None = None
    ) -> Tensor:
        """Values of joint actions, (E, N).

        Args:
            state: (N, width).
            actions: choices, (N, K).
            parameters: weights and biases to use instead, such as those of a target network.
        """
        table = self(state, parameters)
        joint = (actions.long() * self._places).sum(-1)
        return table.gather(-1, joint.expand(len(table), -1).unsqueeze(-1)).squeeze(-1)


class ContinuousValues:
    """Values of joint actions of K numbers within -1..1 in a state, by E critics.

    Args:
        number: number of critics, E.
        width: number of entries of a state.
        numbers: number of actions in a step, K.
        settings: hidden layers and their activation.
        generator: source of the weights.

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
        """Values of joint actions, (E, N).

        Args:
            state: (N, width).
            actions: numbers, (N, K).
            parameters: weights and biases to use instead, such as those of a target network.
        """
        return self._nets(torch.cat([state, actions], dim=-1), parameters).squeeze(-1)


def expected(table: Tensor, probabilities: Tensor, free: Collection[int] = ()) -> Tensor:
    """Expected values of joint actions under independent choices.

    Args:
        table: values of all joint actions, (N, L^K).
        probabilities: probabilities of each choice, (N, K, L).
        free: numbers of the F choices for which no expectation is taken.

    Returns:
        Values of all combinations of the free choices, (N, L^F).
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
