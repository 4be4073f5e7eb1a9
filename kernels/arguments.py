"""Specs of kernel arguments: types, and named rows of arrays. This module imports no Taichi."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Argument:
    """Type of an argument, and for arrays of named rows what they hold."""

    kind: str
    """``template``, ``i32``, ``f64``, or ``real``, which is f32 or f64 by the kernel's precision.
    For each value of a template the kernel is compiled apart."""
    ndim: int = 0
    """Dimensions of the array; 0 for a number."""
    lanes: int = 1
    """Numbers in an element of the array; more than 1 for vectors."""
    rows: Mapping[str, str] = field(default_factory=dict)
    """Meaning of each named row. Arrays of two dimensions have a row for each; in those of one
    dimension the values of an item stand next to each other."""
    of: str = ""
    """Items whose values the rows are, by their name in the kernel."""


def row_index(rows: Iterable[str], name: str) -> int:
    """Place of a named row in its array.

    Raises:
        ValueError: a name that is no row.
    """
    return list(rows).index(name)


def in_row_order(rows: Mapping[str, str], values: Mapping[str, Any]) -> list[Any]:
    """Values of all named rows, in the order of ``rows``.

    Raises:
        ValueError: naming the rows that are missing and the names that are no row.
    """
    if rows.keys() != values.keys():
        missing, unknown = rows.keys() - values.keys(), values.keys() - rows.keys()
        raise ValueError(f"rows: missing {sorted(missing)}, unknown {sorted(unknown)}")
    return [values[name] for name in rows]
