"""Arguments of the kernel of ``perceptron.py``. This module imports no Taichi."""

from .arguments import Argument

TANH, RELU = 0, 1
"""Numbers of the activations."""
ROWS = 8
"""Rows that are computed as one vector of the processor."""
UNITS = 4
"""Units of a layer that are summed at a time, which reads each input once for all of them."""

PERCEPTRON_ARGUMENTS = {
    "serial": Argument("template"),  # on the calling thread alone
    "slices": Argument("i32"),  # parts of the blocks, each on one thread
    "blocks": Argument("i32"),  # vectors of rows
    "activation": Argument("i32"),
    "clip": Argument("real"),  # largest scaled input, of either sign
    "widths": Argument("i32", 1),  # inputs, then units of each layer
    "mean": Argument("real", 1),  # of each input
    "std": Argument("real", 1),  # of each input
    # Layer after layer, its units UNITS at a time, the last filled up with units of 0: their
    # biases, then their weights from each input, input by input.
    "parameters": Argument("real", 1),
    "inputs": Argument("real", 2, ROWS),  # (blocks, inputs)
    # Work space, (slices, 2 * widest), the widest layer being filled up as its parameters are.
    "work": Argument("real", 2, ROWS),
    "outputs": Argument("real", 2, ROWS),  # (blocks, outputs), filled up
}
"""Arguments of the kernel of ``perceptron_kernel``."""
