"""The place that imports Taichi, with `translation.py`; a maintained fork could take its place."""

import ctypes
import inspect
import math
import os
import threading
from collections import namedtuple
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, no_type_check

import numpy as np

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
# For each function that it decorates Taichi asks for the source of what imports it, which is Python
# and has none. `inspect` searches all modules for it unless told, for half of the time to import.
inspect.modulesbyfile.setdefault("<frozen importlib._bootstrap>", "importlib._bootstrap")

import taichi as ti  # noqa: E402
from taichi.lang import kernel_impl, misc  # noqa: E402

from .collector import paused  # noqa: E402
from .translation import replaced, translate  # noqa: E402

__all__ = ["BoundKernel", "aligned", "func", "kernel", "start", "ti"]


OPTIONS = {"cfg_optimization": False, "fast_math": False, "real_matrix_scalarize": False}
"""How bound kernels are compiled, whoever started the runtime. Taichi's analysis of the control
flow takes four fifths of the time and finds nothing that LLVM does not. Vectors stay vectors of the
processor, which load and store as one and take one statement each; LLVM vectors know no casts, no
negation and no functions but floor and sqrt: those go element by element."""
SLICE = 512
"""Iterations of a task: Taichi runs a parallel loop of at most so many on one thread."""
ALIGNMENT = 512
"""Bytes; compiled code takes arrays of vectors to start at a multiple of the vector's length."""


def start(threads: int) -> None:
    """Start the runtime, without the banner that would be in the midst of a user's output."""
    misc.print = print  # to be put back
    with replaced((misc, "print", lambda *_: None)):
        ti.init(arch=ti.cpu, offline_cache=True, log_level=ti.ERROR, cpu_max_num_threads=threads)
    # Taichi sets up memory at the first launch, which may only be in this thread.
    ti.lang.impl.get_runtime().materialize()


def address_of(array: Any) -> int:
    """Where an array begins; ``ndarray.ctypes`` takes four times as long."""
    if array.flags.writeable and array.nbytes:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))
    return int(array.ctypes.data)


def aligned(shape: tuple[int, ...], dtype: Any) -> Any:
    """Array of any content that may be handed over as one of vectors."""
    of = np.dtype(dtype)
    length = math.prod(shape) * of.itemsize
    raw = np.empty(length + ALIGNMENT, np.uint8)
    start = -address_of(raw) % ALIGNMENT
    return raw[start : start + length].view(of).reshape(shape)


_compiling = threading.RLock()
"""Taichi's settings are those of the process."""


def _outside_classes(decorate: Any) -> Any:
    """``ti.func`` or ``ti.kernel`` for functions that stand in no class.

    Taichi asks `inspect` for the class around whatever it decorates, for which that goes through
    the files of all modules: 30 ms at every start.
    """

    def define(function: Any) -> Any:
        with _compiling:
            asked = kernel_impl._inside_class
            kernel_impl._inside_class = lambda *_, **__: False
            try:
                return decorate(function)
            finally:
                kernel_impl._inside_class = asked

    return define


func, kernel = _outside_classes(ti.func), _outside_classes(ti.kernel)

F64_LANES = 8
"""Numbers in f64 that a vector of the processor holds."""
_SAME_SETS_BYTES = 4096


def vector_rows(rows: int, length: int) -> Any:
    """Rows of so many f64, of any content, that kernels take as vectors.

    Their shape is (rows, vectors, F64_LANES).

    Rows that are multiples of 4 KiB apart compete for the same sets of the cache, and a kernel that
    goes through many of them at a time takes twice as long. Such rows get a vector more.
    """
    vectors = -(-length // F64_LANES)
    vectors += vectors % (_SAME_SETS_BYTES // (8 * F64_LANES)) == 0
    return aligned((rows, vectors, F64_LANES), np.float64)


def held(rows: Any, length: int) -> Any:
    """What such rows hold, (rows, length)."""
    return rows.reshape(len(rows), -1)[:, :length]


@func
@no_type_check
def larger(a, b):
    """As ``ti.max`` of vectors; one instruction, where that looks for NaN as well."""
    return ti.select(a > b, a, b)


@func
@no_type_check
def smaller(a, b):
    """As ``ti.min``, likewise."""
    return ti.select(a < b, a, b)


class Table:
    """Arrays of named rows within a kernel: ``table[i].name``, to read and to assign.

    Arrays of two dimensions have a row for each name; in those of one dimension the values of an
    item stand next to each other.

    Args:
        parts: names of the rows of each array, and the array.
        apart: places from an item to the next in arrays of one dimension; None for no gaps, 1 where
            an item is told by the place of its first row.
    """

    _data_oriented = True
    """By this Taichi hands objects on as they are; those of :class:`Item` likewise."""

    def __init__(self, *parts: tuple[tuple[str, ...], Any], apart: int | None = None) -> None:
        self._places: dict[str, tuple[Any, int, int]] = {}
        for names, array in parts:
            length = 0 if len(array.shape) > 1 else apart or len(names)
            self._places |= {name: (array, row, length) for row, name in enumerate(names)}

    def __getitem__(self, i: Any) -> "Item":
        return Item(self._places, local(i))


class Item:
    """The values of one item of a :class:`Table`; every use reads or writes the array anew."""

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


def reals(precision: str) -> Any:
    """Type of the numbers of a kernel in ``f32`` or ``f64``."""
    return {"f32": ti.f32, "f64": ti.f64}[precision]


@func
@no_type_check
def part_of(part, parts, items):
    """First of the items of one of equal parts, and the end of the last."""
    first = ti.cast(ti.cast(part, ti.i64) * items // parts, ti.i32)
    end = ti.cast((ti.cast(part, ti.i64) + 1) * items // parts, ti.i32)
    return first, end


@contextmanager
def _options(config: Any) -> Iterator[Any]:
    """The runtime's configuration with OPTIONS."""
    before = {name: getattr(config, name) for name in OPTIONS}
    try:
        for name, value in OPTIONS.items():
            setattr(config, name, value)
        yield config
    finally:
        for name, value in before.items():
            setattr(config, name, value)


class BoundKernel:
    """A kernel that is called again and again with mostly the same arrays.

    Taichi checks and hands over every argument on every call, 11 us for an array. A call keeps the
    launch context of the one before with the same template arguments, and hands over scalars and
    those arrays that are other objects than then.

    Args:
        kernel: a Taichi kernel with template arguments first, then scalars and NumPy arrays.
        templates: number of template arguments.
    """

    def __init__(self, kernel: Any, templates: int) -> None:
        self._kernel, self._templates = kernel, templates
        self._launches: dict[tuple[Any, ...], _Launch] = {}

    def __call__(self, *args: Any) -> None:
        """Run the kernel; arrays are C-contiguous and of the kernel's types."""
        key, given = args[: self._templates], args[self._templates :]
        launch = self._launches.get(key)
        if launch is None or launch.program is not ti.lang.impl.get_runtime().prog:
            with _compiling, paused():
                launch = self._launches[key] = _Launch(self._kernel, args, self._templates)
        launch.run(given)

    def let_go(self, *arrays: Any) -> None:
        """Forget arrays of past calls, which otherwise live until others take their places."""
        for launch in self._launches.values():
            launch.let_go({id(array) for array in arrays})


class _Launch:
    """One compiled kernel with its arguments in place."""

    def __init__(self, kernel: Any, args: tuple[Any, ...], templates: int) -> None:
        primal = kernel._primal
        compiled = primal.compiled_kernels[translate(primal, args)]
        self.program = ti.lang.impl.get_runtime().prog
        with _options(self.program.config()) as config:
            self._compiled = self.program.compile_kernel(
                config, self.program.get_device_caps(), compiled
            )
        self._context = compiled.make_launch_context()
        annotations = [argument.annotation for argument in primal.arguments[templates:]]
        self._element_dims = [getattr(getattr(a, "dtype", None), "ndim", 0) for a in annotations]
        self._given: list[Any] = [None] * len(annotations)
        self._kinds: list[Any] = [None] * len(annotations)
        self._put(args[templates:])

    def run(self, given: tuple[Any, ...]) -> None:
        self._put(given)
        self.program.launch_kernel(self._compiled, self._context)

    def let_go(self, arrays: set[int]) -> None:
        self._given = [None if id(held) in arrays else held for held in self._given]

    def _put(self, given: tuple[Any, ...]) -> None:
        context, held, kinds = self._context, self._given, self._kinds
        for i, value in enumerate(given):
            if value is held[i]:
                continue
            if isinstance(value, np.ndarray):
                kind = (value.dtype, value.ndim)
                if kinds[i] is None:
                    kinds[i] = kind
                if kinds[i] != kind or not value.flags.c_contiguous:
                    raise TypeError(f"argument {i}: {value.dtype} array of other type or order")
                shape, address = value.shape, address_of(value)
                if self._element_dims[i]:
                    if address % (shape[-1] * value.itemsize):
                        raise TypeError(f"argument {i}: vectors that do not start at whole ones")
                    shape = shape[:-1]
                context.set_arg_external_array_with_shape((i,), address, value.nbytes, shape, 0)
            elif isinstance(value, float):
                context.set_arg_float((i,), value)
            else:
                context.set_arg_int((i,), int(value))
            held[i] = value
