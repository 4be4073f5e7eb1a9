"""Arrays whose rows have names within a kernel, as in ``hall.racks[i].inlet_c``."""

from collections import namedtuple
from typing import Any

import taichi as ti


class NamedRows:
    """Arrays of named rows within a kernel: ``rows[i].name``, to read and to assign.

    An array of two dimensions has a row for each name and a column for each item. In an array of
    one dimension the values of an item stand next to each other.

    Args:
        parts: pairs of the names of the rows of an array, and the array.
        stride: in arrays of one dimension, entries from an item to the next; None is the number of
            names, and with 1 the index of an item is that of its first entry.
    """

    _data_oriented = True
    """Taichi hands objects of such classes to functions as they are."""

    def __init__(self, *parts: tuple[tuple[str, ...], Any], stride: int | None = None) -> None:
        self._places: dict[str, tuple[Any, int, int]] = {}
        for names, array in parts:
            step = 0 if len(array.shape) > 1 else stride or len(names)
            self._places |= {name: (array, row, step) for row, name in enumerate(names)}

    def __getitem__(self, i: Any) -> "Item":
        return Item(self._places, local(i))


class Item:
    """The values of one item of :class:`NamedRows`; every use reads or writes the array anew.

    Args:
        places: array, row, and entries from an item to the next (0 in two dimensions) by name.
        i: index of the item.
    """

    _data_oriented = True

    def __init__(self, places: dict[str, tuple[Any, int, int]], i: Any) -> None:
        self._places, self._i = places, i

    def __getattr__(self, name: str) -> Any:
        if name not in self._places:
            raise AttributeError(f"{name}; known are {', '.join(self._places)}")
        array, row, step = self._places[name]
        at = (self._i * step + row,) if step else (row, self._i)
        return ti.lang.impl.subscript(None, array, *at)


def local(value: Any) -> Any:
    """Copy of a number within a kernel; arguments that are not copied are read at every use."""
    return ti.lang.impl.expr_init(value) if isinstance(value, ti.lang.expr.Expr) else value


def shared(**values: Any) -> Any:
    """Namedtuple of values that the functions of a kernel share; to be called in ``ti.static``."""
    values = {name: local(value) for name, value in values.items()}
    return namedtuple("Shared", values)(**values)
