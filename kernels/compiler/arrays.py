"""NumPy arrays with the alignment and layout of SIMD vectors, for kernels."""

import ctypes
import math
from typing import Any

import numpy as np

ALIGNMENT = 1024
"""Alignment in bytes: compiled code expects an array of vectors to start at a multiple of the
vector's length."""
F64_LANES = 8
"""Numbers in f64 per SIMD vector."""
_SAME_SETS_BYTES = 4096


def address_of(array: Any) -> int:
    """Return the address of an array's first byte, four times as fast as ``ndarray.ctypes``."""
    if array.flags.writeable and array.nbytes:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    return int(array.ctypes.data)


def aligned(shape: tuple[int, ...], dtype: Any) -> Any:
    """Return an uninitialised array that is aligned for arrays of vectors."""
    element = np.dtype(dtype)
    length = math.prod(shape) * element.itemsize
    raw = np.empty(length + ALIGNMENT, np.uint8)
    first = -address_of(raw) % ALIGNMENT
    return raw[first : first + length].view(element).reshape(shape)


def vector_rows(rows: int, length: int) -> Any:
    """Return uninitialised rows of f64, padded to whole vectors.

    Rows at distances of multiples of 4 KiB compete for the same sets of the processor's cache. A
    kernel that reads many such rows together takes twice as long, so they get one more vector.

    Args:
        rows: number of rows.
        length: number of entries in a row.

    Returns:
        An array (rows, vectors, F64_LANES).
    """
    vectors = -(-length // F64_LANES)
    vectors += vectors % (_SAME_SETS_BYTES // (8 * F64_LANES)) == 0
    return aligned((rows, vectors, F64_LANES), np.float64)


def unpadded(rows: Any, length: int) -> Any:
    """Return a view of ``vector_rows`` without padding, (rows, length)."""
    return rows.reshape(len(rows), -1)[:, :length]
