"""Arrays whose rows have names within a kernel, as in ``hall.racks[i].inlet_c``."""

from collections import namedtuple
from typing import Any

import taichi as ti


class NamedRows:
    """Arrays of named rows within a kernel: ``rows[i].name``, to read and to assign.

    Arrays of two dimensions have a row for each name; in those of one dimension the values of an
    item stand next to each other.

    Args:
        parts: names of the rows of each array, and the array.
        apart: places from an item to the next in arrays of one dimension; None for no gaps, 1 where
            an item is told by the place of its first row.
    """

    _data_oriented = True
    """By this Taichi hands objects on as they are."""

    def __init__(self, *parts: tuple[tuple[str, ...], Any], apart: int | None = None) -> None:
        self._places: dict[str, tuple[Any, int, int]] = {}
        for names, array in parts:
            length = 0 if len(array.shape) > 1 else apart or len(names)
            self._places |= {name: (array, row, length) for row, name in enumerate(names)}

    def __getitem__(self, i: Any) -> "Item":
        return Item(self._places, local(i))


class Item:
    """The values of one item of :class:`NamedRows`; every use reads or writes the array anew."""

    _data_oriented = True

    def __init__(self, places: dict[str, tuple[Any, int, int]], i: Any) -> None:
        self._places, self._i = places, i

    def __getattr__(self, name: str) -> Any:
        if name not in self._places:
            raise AttributeError(f"{name}; known are {', '.join(self._places)}")
        array, row, length = self._places[name]
        at = (self._i * length + row,) if length else (row, self._i)
        return ti.lang.impl.subscript(None, array, *at)


def local(value: Any) -> Any:
    """A copy of a number within a kernel, whose arguments are otherwise read at every use."""
    return ti.lang.impl.expr_init(value) if isinstance(value, ti.lang.expr.Expr) else value


def shared(**values: Any) -> Any:
    """What the functions of a kernel share, by name; to be called within ``ti.static``."""
    values = {name: local(value) for name, value in values.items()}
    return namedtuple("Shared", values)(**values)
