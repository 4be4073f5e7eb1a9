"""Critics of the actions of all learners together, for off-policy algorithms.

K numbers are decided in a step. If each is one of L choices, there are L^K joint actions, and a
critic has one output for each: expected values over independent choices are then exact sums.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from sdc_taichi.errors import ConfigError
from sdc_taichi.learning.algorithms import OffPolicySettings
from sdc_taichi.learning.policy import CHOICES

MOST_JOINT_ACTIONS = 729
"""Largest number of joint actions that a critic values: those of six choices out of three."""
LAST_GAIN = 0.01
"""Gain of the last weights, so that all values begin near 0."""


class Perceptrons:
    """Perceptrons of one shape, E side by side.

    Args:
        number: how many, E.
        width: inputs of each.
        out: outputs of each.
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
            parameters: weights and biases in place of its own, as those of a target network.
        """
        given = self.parameters if parameters is None else parameters
        x = inputs.expand(len(given[0]), *inputs.shape)
        for i in range(0, len(given), 2):
            if i:
                x = self._activation(x)
            x = torch.baddbmm(given[i + 1], x, given[i])
        return x


class JointValues:
    """Values of all joint actions of K choices in a state, by E critics.

    The output is dueling (Wang et al. 2016), Q = V + A - mean A, and the advantage of a joint
    action is the sum of one of each choice and one of their combination: A(a) = A_1(a_1) + ... +
    A_K(a_K) + A_all(a). Any table can be told that way, and what a choice does whatever the others
    are is learned from every step in which it was made.

    Args:
        number: how many critics, E.
        width: entries of a state.
        choices: how many choices are made in a step, K.
        settings: hidden layers and their activation.
        generator: source of the weights.
        levels: how many possibilities each choice has, L.

    Attributes:
        parameters: weights and biases of the critics.

    Raises:
        ConfigError: more joint actions than a table has.
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
            parameters: of target networks, in place of its own.
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
            actions: choices of each, (N, K).
            parameters: of target networks, in place of its own.
        """
        table = self(state, parameters)
        joint = (actions.long() * self._places).sum(-1)
        return table.gather(-1, joint.expand(len(table), -1).unsqueeze(-1)).squeeze(-1)


class ContinuousValues:
    """Values of joint actions of K numbers within -1..1 in a state, by E critics.

    Args:
        number: how many critics, E.
        width: entries of a state.
        numbers: how many numbers are decided in a step, K.
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
            actions: numbers of each, (N, K).
            parameters: of target networks, in place of its own.
        """
        return self._nets(torch.cat([state, actions], dim=-1), parameters).squeeze(-1)


def expected(table: Tensor, probabilities: Tensor, kept: Collection[int] = ()) -> Tensor:
    """Expected values of joint actions over independent choices.

    Args:
        table: values of all joint actions, (N, L^K).
        probabilities: probabilities of each choice, (N, K, L).
        kept: choices that stay open, in any order.

    Returns:
        Values of all combinations of the kept choices, (N, L^kept); (N, 1) if none is.
    """
    right, levels = 1, probabilities.shape[-1]
    for choice in reversed(range(probabilities.shape[1])):
        if choice in kept:
            right *= levels
            continue
        table = table.view(len(table), -1, levels, right)
        table = torch.einsum("nlcr,nc->nlr", table, probabilities[:, choice])
        table = table.flatten(1)
    return table
