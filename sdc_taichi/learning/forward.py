"""Outputs of a perceptron for many rows of inputs, each row alike whatever the others are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.compiler.arrays import aligned
from sdc_taichi.kernels.perceptron_arguments import (
    PERCEPTRON_ARGUMENTS,
    RELU,
    ROWS,
    TANH,
    UNITS,
)
from sdc_taichi.types import F32

Activation = Literal["tanh", "relu"]
"""Function of the units of hidden layers."""
SERIAL_PRODUCTS = 2_000_000
"""Products of a call that one thread computes sooner than several are woken."""


class Forward:
    """The compiled forward pass of a perceptron with scaled inputs.

    Args:
        mean: subtracted from each input, (n,).
        std: divides each input afterwards, (n,).
        clip: largest scaled input, of either sign.
        layers: weight, (out, in), and bias, (out,), of each layer.
        activation: function of the units of all layers but the last.
    """

    def __init__(
        self,
        mean: F32,
        std: F32,
        clip: float,
        layers: Sequence[tuple[F32, F32]],
        activation: Activation,
    ) -> None:
        from sdc_taichi.kernels.compiler.named_kernel import NamedKernel
        from sdc_taichi.kernels.perceptron import perceptron_kernel

        self._threads = runtime.ensure_started()
        widths = [len(mean), *(len(bias) for _, bias in layers)]
        self._products = sum(weight.size for weight, _ in layers)
        self._inputs, self._outputs = widths[0], widths[-1]
        self._widest = max(map(_whole_units, widths))
        self._kernel = NamedKernel(perceptron_kernel(), PERCEPTRON_ARGUMENTS)
        self._kernel.bind(
            activation={"tanh": TANH, "relu": RELU}[activation],
            clip=clip,
            widths=np.array(widths, dtype=np.int32),
            mean=mean,
            std=std,
            parameters=np.concatenate([_parameters(*layer) for layer in layers]),
        )

    def __call__(self, inputs: F32) -> F32:
        """Outputs of each row, (B, outputs), of inputs, (B, n)."""
        size, blocks = len(inputs), -(-len(inputs) // ROWS)
        rows = np.zeros((blocks * ROWS, self._inputs), dtype=np.float32)
        rows[:size] = inputs
        given = aligned((blocks, self._inputs, ROWS), np.float32)
        given[:] = rows.reshape(blocks, ROWS, -1).transpose(0, 2, 1)
        outputs = aligned((blocks, _whole_units(self._outputs), ROWS), np.float32)
        serial = size * self._products <= SERIAL_PRODUCTS
        slices = 1 if serial else min(blocks, 4 * self._threads)
        self._kernel(
            serial=serial,
            slices=slices,
            blocks=blocks,
            inputs=given,
            work=aligned((slices, 2 * self._widest, ROWS), np.float32),
            outputs=outputs,
        )
        found = outputs.transpose(0, 2, 1).reshape(blocks * ROWS, -1)
        return np.ascontiguousarray(found[:size, : self._outputs])


def _whole_units(count: int) -> int:
    """A number of units, filled up as the kernel computes them."""
    return -(-count // UNITS) * UNITS


def _parameters(weight: F32, bias: F32) -> F32:
    """Parameters of a layer in the order of the kernel."""
    outs, ins = weight.shape
    by_unit = np.zeros((_whole_units(outs), 1 + ins), dtype=np.float32)
    by_unit[:outs, 0], by_unit[:outs, 1:] = bias, weight
    return by_unit.reshape(-1, UNITS, 1 + ins).transpose(0, 2, 1).reshape(-1)
