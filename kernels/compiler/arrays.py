"""NumPy arrays that kernels take as vectors of the processor."""

import ctypes
import math
from typing import Any

import numpy as np

ALIGNMENT = 512
"""Bytes; compiled code takes arrays of vectors to start at a multiple of the vector's length."""
F64_LANES = 8
"""Numbers in f64 that a vector of the processor holds."""
_SAME_SETS_BYTES = 4096


def address_of(array: Any) -> int:
    """Address of the first byte of an array; ``ndarray.ctypes`` takes four times as long."""
    if array.flags.writeable and array.nbytes:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    return int(array.ctypes.data)


def aligned(shape: tuple[int, ...], dtype: Any) -> Any:
    """Array of undefined content that starts where an array of vectors may start."""
    element = np.dtype(dtype)
    length = math.prod(shape) * element.itemsize
    raw = np.empty(length + ALIGNMENT, np.uint8)
    first = -address_of(raw) % ALIGNMENT
    return raw[first : first + length].view(element).reshape(shape)


def vector_rows(rows: int, length: int) -> Any:
    """Rows of f64 of undefined content, padded to whole vectors.

    Rows that are multiples of 4 KiB apart compete for the same sets of the processor's cache, and a
    kernel that reads many of them at a time takes twice as long. Such rows get one vector more.

    Args:
        rows: number of rows.
        length: entries of a row.

    Returns:
        An array (rows, vectors, F64_LANES).
    """
    vectors = -(-length // F64_LANES)
    vectors += vectors % (_SAME_SETS_BYTES // (8 * F64_LANES)) == 0
    return aligned((rows, vectors, F64_LANES), np.float64)


def unpadded(rows: Any, length: int) -> Any:
    """View of ``vector_rows`` without their padding, (rows, length)."""
    return rows.reshape(len(rows), -1)[:, :length]
