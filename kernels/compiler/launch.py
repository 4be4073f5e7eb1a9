"""Calling a kernel again and again, without what Taichi does anew at every call.

kernels/README.md says what each departure from Taichi's public interface gains, and how
``SDC_TAICHI_PLAIN`` turns all of them off.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import taichi as ti
from taichi._lib import core
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext, Builder

from .arrays import address_of
from .runtime import uses_plain_taichi


@contextmanager
def no_positions() -> Iterator[None]:
    """Replace what finds, formats and passes on the position of every node, and put it back."""
    nowhere = core.DebugInfo("")
    places: tuple[tuple[Any, str, Any], ...] = (
        (Builder, "__call__", _build),
        (ASTTransformerContext, "get_pos_info", lambda *_: ""),
        (core, "DebugInfo", lambda *_: nowhere),
        (ti.lang.impl.get_runtime(), "src_info_stack", [""]),
    )
    before = [getattr(owner, name) for owner, name, _ in places]
    try:
        for owner, name, value in places:
            setattr(owner, name, value)
        yield
    finally:
        for (owner, name, _), value in zip(places, before, strict=True):
            setattr(owner, name, value)


def _build(builder: Any, context: Any, node: Any) -> Any:
    """Translate a node; its errors are found again, with positions, by a second translation."""
    return getattr(builder, f"build_{type(node).__name__}")(context, node)


OPTIONS = {"fast_math": False, "real_matrix_scalarize": False}
"""Options that kernels are compiled with, also in a runtime that another library started.

Without ``fast_math`` a sum has the same bits in every kernel. Without ``real_matrix_scalarize`` a
vector is loaded, stored and computed as one vector of the processor."""

_compiling = threading.RLock()
"""Held while options are set: they belong to the runtime, which the whole process shares."""


class BoundKernel:
    """A kernel that is called again and again with mostly the same arrays.

    Taichi checks and hands over every argument at every call, 7 us for an array. A bound kernel
    keeps the launch context of its last call with the same template arguments, and hands over
    scalars and those arrays that are other objects than before.

    Args:
        kernel: a Taichi kernel with template arguments first, then scalars and NumPy arrays.
        templates: number of template arguments.
    """

    def __init__(self, kernel: Any, templates: int) -> None:
        self._kernel, self._templates = kernel, templates
        self._plain = uses_plain_taichi()
        self._launches: dict[tuple[Any, ...], _Launch] = {}

    def __call__(self, *args: Any) -> None:
        """Run the kernel.

        Args:
            args: template arguments, numbers, and C-contiguous arrays of the types that the kernel
                names; those of vectors start at multiples of the vector's length.

        Raises:
            TypeError: an array of another type, order or alignment (of another type or order what
                Taichi raises, where its public interface is called).
        """
        if self._plain:
            with _compiling, _options(ti.cfg):
                self._kernel(*args)
            return
        key, given = args[: self._templates], args[self._templates :]
        launch = self._launches.get(key)
        if launch is None or launch.program is not ti.lang.impl.get_runtime().prog:
            with _compiling:
                launch = self._launches[key] = _Launch(self._kernel, args, self._templates)
        launch.run(given)

    def release(self, *arrays: Any) -> None:
        """Drop arrays of past calls, which otherwise live until others take their places."""
        for launch in self._launches.values():
            launch.release({id(array) for array in arrays})


def run_once(kernel: Any, **arguments: Any) -> None:
    """Run a kernel that is seldom called, through Taichi's public interface, with OPTIONS.

    Args:
        kernel: a Taichi kernel.
        arguments: its arguments by name.
    """
    with _compiling, _options(ti.cfg):
        kernel(**arguments)


class _Launch:
    """One compiled kernel with its arguments in place."""

    def __init__(self, kernel: Any, args: tuple[Any, ...], templates: int) -> None:
        primal = kernel._primal
        translated = primal.compiled_kernels[_translate(primal, args)]
        self.program = ti.lang.impl.get_runtime().prog
        with _options(self.program.config()) as config:
            self._compiled = self.program.compile_kernel(
                config, self.program.get_device_caps(), translated
            )
        self._context = translated.make_launch_context()
        annotations = [argument.annotation for argument in primal.arguments[templates:]]
        self._element_dims = [getattr(getattr(a, "dtype", None), "ndim", 0) for a in annotations]
        self._given: list[Any] = [None] * len(annotations)
        """Arguments that the context holds."""
        self._kinds: list[Any] = [None] * len(annotations)
        """Type and number of dimensions of arrays, those of the first call."""
        self._set(args[templates:])

    def run(self, given: tuple[Any, ...]) -> None:
        """Run the kernel with arguments that are not templates."""
        self._set(given)
        self.program.launch_kernel(self._compiled, self._context)

    def release(self, arrays: set[int]) -> None:
        """Drop arrays by identity."""
        self._given = [None if id(value) in arrays else value for value in self._given]

    def _set(self, given: tuple[Any, ...]) -> None:
        """Hand over arguments that are other objects than those of the last call."""
        context, last, kinds = self._context, self._given, self._kinds
        for i, value in enumerate(given):
            if value is last[i]:
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
            last[i] = value


def _translate(primal: Any, args: tuple[Any, ...]) -> Any:
    """Translate a kernel for such arguments; return the key by which Taichi finds it.

    Whole numbers in kernels have 32 bits, whatever the options of the runtime.
    """
    runtime = ti.lang.impl.get_runtime()
    before = runtime.default_ip
    try:
        runtime.default_ip = ti.i32
        try:
            with no_positions():
                return primal.ensure_compiled(*args)
        except Exception:
            # Once more for the message, which says where in the source the error is.
            return primal.ensure_compiled(*args)
    finally:
        runtime.default_ip = before


@contextmanager
def _options(config: Any) -> Iterator[Any]:
    """Set OPTIONS in a configuration, and put back what was there on leaving."""
    before = {name: getattr(config, name) for name in OPTIONS}
    try:
        for name, value in OPTIONS.items():
            setattr(config, name, value)
        yield config
    finally:
        for name, value in before.items():
            setattr(config, name, value)
