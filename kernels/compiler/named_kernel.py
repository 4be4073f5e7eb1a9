"""Kernels that are defined from a spec of their arguments, and called with named arguments."""

import linecache
from collections import namedtuple
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import taichi as ti

from ..arguments import Argument
from .functions import SLICE, reals
from .launch import BoundKernel


def define(name: str, source: str, file: str, scope: Mapping[str, Any]) -> Any:
    """Define a function from source text, and register the text where Taichi reads it.

    Args:
        name: name of the function in the source.
        source: Python source of the function, with its decorators.
        file: file name for messages; each source needs a different name.
        scope: globals of the function.

    Returns:
        The function.
    """
    # Like `inspect`, Taichi finds the source of a kernel through the name of its file.
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    names = dict(scope)
    exec(compile(source, file, "exec"), names)
    return names[name]


class NamedRows:
    """Arrays with named rows inside a kernel, read and assigned as ``rows[i].name``.

    An array of two dimensions has a row for each name and a column for each item. In an array of
    one dimension, the values of an item are adjacent.

    Args:
        parts: pairs of row names and array.
        stride: distance between items in arrays of one dimension, in entries. None stands for the
            number of names. With 1, the index of an item is the index of its first entry.
    """

    _data_oriented = True
    """Mark for Taichi to pass objects of this class to functions unchanged."""

    def __init__(self, *parts: tuple[tuple[str, ...], Any], stride: int | None = None) -> None:
        self._places: dict[str, tuple[Any, int, int]] = {}
        for names, array in parts:
            step = 0 if len(array.shape) > 1 else stride or len(names)
            self._places |= {name: (array, row, step) for row, name in enumerate(names)}

    def __getitem__(self, i: Any) -> "Item":
        return Item(self._places, local(i))


class Item:
    """Values of one item of :class:`NamedRows`; each use reads from or writes to the array.

    Args:
        places: by name: array, row, and distance between items in entries (0 in two dimensions).
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
    """Return a copy of a number inside a kernel; without it, each use reads the argument again."""
    return ti.lang.impl.expr_init(value) if isinstance(value, ti.lang.expr.Expr) else value


def shared(**values: Any) -> Any:
    """Return a namedtuple of values for the functions of a kernel; call it in ``ti.static``."""
    values = {name: local(value) for name, value in values.items()}
    return namedtuple("Shared", values)(**values)


_NONE: Mapping[str, Any] = MappingProxyType({})
_SOURCE = """\
@ti.kernel
def {name}({parameters}):
    ti.loop_config(serialize=serial)
    for k in range(slices * {slice}):
        if k % {slice} == 0:
            hall = ti.static(share(zeros=ti.Vector([ti.cast(0.0, real)] * {lanes}), {named}))
            run_slice(hall, k // {slice})
"""
"""Source template of a kernel: a loop over slices, each of which runs on one thread. Taichi reads
the parameters of a kernel from its source, so ``define_kernel`` fills them in from the spec."""


def define_kernel(
    name: str,
    arguments: Mapping[str, Argument],
    run_slice: Callable[..., None],
    *,
    precision: str,
    lanes: int = 1,
    constants: Mapping[str, Any] = _NONE,
    views: Mapping[str, tuple[Mapping[str, str], str]] = _NONE,
) -> Any:
    """Define a Taichi kernel with the arguments of a spec.

    Args:
        name: name of the kernel.
        arguments: spec of the arguments by name, template arguments first. ``serial`` and
            ``slices`` must be among them.
        run_slice: Taichi function (hall, slice) that computes one slice. The attributes of ``hall``
            are the arguments, items with named rows, constants, views, ``real``, and ``zeros``, a
            vector of lanes.
        precision: ``f32`` or ``f64``, the type of ``real`` arguments.
        lanes: length of ``zeros``.
        constants: values known when the kernel is compiled, by name.
        views: further items by name, each with its rows and the name of an array of one dimension.
            The index of an item is the index of its first entry in the array.
    """
    real = reals(precision)

    def share(zeros: Any, **values: Any) -> Any:
        parts: dict[str, list[tuple[Any, Any]]] = {}
        for name, argument in arguments.items():
            if argument.of:
                parts.setdefault(argument.of, []).append((tuple(argument.rows), values[name]))
        items = {of: NamedRows(*rows) for of, rows in parts.items()}
        items |= {
            of: NamedRows((tuple(rows), values[name]), stride=1)
            for of, (rows, name) in views.items()
        }
        return shared(real=real, zeros=zeros, **constants, **values, **items)

    source = _SOURCE.format(
        name=name,
        parameters=", ".join(f"{name}: types[{name!r}]" for name in arguments),
        named=", ".join(f"{name}={name}" for name in arguments),
        slice=SLICE,
        lanes=lanes,
    )
    scope = {
        "real": real,
        "run_slice": run_slice,
        "share": share,
        "ti": ti,
        "types": {name: _type(argument, real) for name, argument in arguments.items()},
        "__name__": __name__,
    }
    return define(name, source, f"<kernel {name} in {precision}>", scope)


def _type(argument: Argument, real: Any) -> Any:
    """Return the Taichi type of an argument."""
    if argument.kind == "template":
        return ti.template()
    element = {"i32": ti.i32, "f64": ti.f64, "real": real}[argument.kind]
    if argument.ndim == 0:
        return element
    if argument.lanes > 1:
        element = ti.types.vector(argument.lanes, element)
    return ti.types.ndarray(dtype=element, ndim=argument.ndim)


class NamedKernel:
    """A kernel with named arguments; a bound argument remains until it is replaced.

    Args:
        kernel: a kernel from ``define_kernel``.
        arguments: the spec from which it was defined.
    """

    def __init__(self, kernel: Any, arguments: Mapping[str, Argument]) -> None:
        templates = sum(argument.kind == "template" for argument in arguments.values())
        self._launch = BoundKernel(kernel, templates)
        self._values: dict[str, Any] = dict.fromkeys(arguments)
        self._missing = set(arguments)

    def bind(self, **values: Any) -> None:
        """Set arguments for the next call and later calls.

        Raises:
            TypeError: if a name is not an argument of the kernel.
        """
        if not values.keys() <= self._values.keys():
            unknown = sorted(values.keys() - self._values.keys())
            raise TypeError(f"kernel: unknown arguments {', '.join(unknown)}")
        self._values.update(values)
        self._missing -= values.keys()

    def __call__(self, **values: Any) -> None:
        """Run the kernel with these arguments and those bound before.

        Raises:
            TypeError: if a name is unknown, an argument was never bound, or an array differs in
                type, order or alignment from the spec.
        """
        self.bind(**values)
        if self._missing:
            raise TypeError(f"kernel: missing arguments {', '.join(sorted(self._missing))}")
        self._launch(*self._values.values())

    def release(self, *names: str) -> None:
        """Drop bound arguments; they must be given again before or in the next call."""
        self._launch.release(*(self._values[name] for name in names))
        self._values.update(dict.fromkeys(names))
        self._missing.update(names)
