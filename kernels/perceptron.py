"""Multilayer perceptrons over rows of inputs; eight rows form one SIMD vector.

A lane is a row, and every sum follows the order of the inputs. A row therefore has the same bits
alone and in any batch, which linear-algebra libraries do not guarantee.
``sdc_taichi/learning/policy.py`` prepares the inputs.
"""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import larger, part_of, smaller
from .compiler.named_kernel import define_kernel
from .elementary import log_and_exp
from .perceptron_arguments import PERCEPTRON_ARGUMENTS, ROWS, TANH, UNITS


@cache
def perceptron_kernel() -> Any:
    """Return the kernel that computes outputs of rows; PERCEPTRON_ARGUMENTS are its arguments."""
    _, exp_of = log_and_exp("f32", ROWS)
    return define_kernel(
        "perceptron",
        PERCEPTRON_ARGUMENTS,
        _blocks_of_slice,
        precision="f32",
        lanes=ROWS,
        constants={"exp_of": exp_of},
    )


@ti.func
@no_type_check
def _blocks_of_slice(net: ti.template(), number):
    """Compute the outputs of all blocks of a slice."""
    first, end = part_of(number, net.slices, net.blocks)
    layers = net.widths.shape[0] - 1
    low, high = net.zeros - net.clip, net.zeros + net.clip
    for block in range(first, end):
        source, target, at = 0, net.work.shape[1] // 2, 0
        for i in range(net.widths[0]):
            scaled = (net.inputs[block, i] - net.mean[i]) / net.std[i]
            net.work[number, i] = larger(smaller(scaled, high), low)
        for layer in range(layers):
            ins, outs = net.widths[layer], net.widths[layer + 1]
            unit = 0
            while unit < outs:
                _sum_units(net, number, source, ins, at, target + unit)
                if layer + 1 < layers:
                    _activate_units(net, number, target + unit)
                at += UNITS * (1 + ins)
                unit += UNITS
            source, target = target, source
        for unit in range(net.outputs.shape[1]):
            net.outputs[block, unit] = net.work[number, source + unit]


@ti.func
@no_type_check
def _sum_units(net: ti.template(), number, source, ins, at, target):
    """Store biases plus weighted inputs of UNITS units in the work space, from ``target`` on."""
    a = net.zeros + net.parameters[at]
    b = net.zeros + net.parameters[at + 1]
    c = net.zeros + net.parameters[at + 2]
    d = net.zeros + net.parameters[at + 3]
    for i in range(ins):
        value = net.work[number, source + i]
        weights = at + UNITS * (1 + i)
        a += value * net.parameters[weights]
        b += value * net.parameters[weights + 1]
        c += value * net.parameters[weights + 2]
        d += value * net.parameters[weights + 3]
    net.work[number, target] = a
    net.work[number, target + 1] = b
    net.work[number, target + 2] = c
    net.work[number, target + 3] = d


@ti.func
@no_type_check
def _activate_units(net: ti.template(), number, target):
    """Apply the activation to UNITS units of the work space; tanh x = 1 - 2 / (e^2x + 1)."""
    for i in range(UNITS):
        value = net.work[number, target + i]
        if net.activation == TANH:
            one = net.zeros + net.real(1.0)
            power = net.exp_of(value + value)
            net.work[number, target + i] = one - (one + one) / (power + one)
        else:
            net.work[number, target + i] = larger(value, net.zeros)
