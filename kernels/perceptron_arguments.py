"""Arguments of the kernel of ``perceptron.py``. This module does not import Taichi."""

from .arguments import Argument

TANH, RELU = 0, 1
"""Values of ``activation``."""
ROWS = 8
"""Input rows per SIMD vector."""
UNITS = 4
"""Units of a layer that are summed together, so that each input is read once for all of them."""

PERCEPTRON_ARGUMENTS = {
    "serial": Argument("template"),  # True: run on the calling thread alone
    "slices": Argument("i32"),  # number of parts of the blocks, one thread each
    "blocks": Argument("i32"),  # number of vectors of rows
    "activation": Argument("i32"),
    "clip": Argument("real"),  # limit of the magnitude of scaled inputs
    "widths": Argument("i32", 1),  # number of inputs, then units of each layer
    "mean": Argument("real", 1),  # mean of each input
    "std": Argument("real", 1),  # standard deviation of each input
    # Parameters, layer after layer, in groups of UNITS units; the last group is padded with zero
    # units. Each group has its biases, then its weights input by input.
    "parameters": Argument("real", 1),
    "inputs": Argument("real", 2, ROWS),  # (blocks, inputs)
    # Work space, (slices, 2 * widest); the widest layer is padded like its parameters.
    "work": Argument("real", 2, ROWS),
    "outputs": Argument("real", 2, ROWS),  # (blocks, outputs), padded
}
"""Arguments of the kernel of ``perceptron_kernel``."""
