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
from sdc_taichi.learning.networks import LAST_GAIN
from sdc_taichi.learning.policy import CHOICES

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
