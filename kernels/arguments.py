"""Specs of kernel arguments: types and named array rows. This module does not import Taichi."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Argument:
    """Type of a kernel argument and, for an array with named rows, the meaning of its rows."""

    kind: str
    """``template``, ``i32``, ``f64``, or ``real``, which is f32 or f64 by the kernel's precision.
    Taichi compiles one kernel for each value of a template argument."""
    ndim: int = 0
    """Number of dimensions of the array; 0 for a scalar."""
    lanes: int = 1
    """Length of the vector in each element of the array; 1 for scalar elements."""
    rows: Mapping[str, str] = field(default_factory=dict)
    """Meaning of each named row. An array of two dimensions has one row for each name. In an array
    of one dimension the values of an item are adjacent."""
    of: str = ""
    """Name within the kernel of the items to which the rows belong, such as ``racks``."""


def row_index(rows: Iterable[str], name: str) -> int:
    """Return the index of a named row in its array.

    Raises:
        ValueError: if the name is not a row.
    """
    return list(rows).index(name)


def in_row_order(rows: Mapping[str, str], values: Mapping[str, Any]) -> list[Any]:
    """Return the values of all named rows, in the order of ``rows``.

    Raises:
        ValueError: if rows are missing or names are unknown; the message lists both.
    """
    if rows.keys() != values.keys():
        missing, unknown = rows.keys() - values.keys(), values.keys() - rows.keys()
        raise ValueError(f"rows: missing {sorted(missing)}, unknown {sorted(unknown)}")
    return [values[name] for name in rows]
