"""Repeated kernel calls without the work that Taichi repeats at every call.

kernels/README.md lists each use of Taichi's private interfaces, with its gain, and says how
``SDC_TAICHI_PLAIN`` disables all of them.
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
    """Disable Taichi's tracking of source positions during translation, and restore it on exit."""
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
    """Translate a syntax node; ``_translate`` repeats a failed translation to get positions."""
    return getattr(builder, f"build_{type(node).__name__}")(context, node)


OPTIONS: dict[str, bool | int] = {
    "fast_math": False,
    "real_matrix_scalarize": False,
    "opt_level": 0,
}
"""Compiler options of all kernels, also in a runtime that another library started.

Without ``fast_math``, a sum has the same bits in every kernel. Without ``real_matrix_scalarize``,
Taichi loads, stores and computes a vector as one SIMD vector. At ``opt_level`` 0 Taichi does not
search the whole kernel for common subexpressions, which takes half the time of compilation; LLVM
finds them anyway."""

_compiling = threading.RLock()
"""Lock for changes of compiler options, which belong to the runtime of the whole process."""


class BoundKernel:
    """A kernel for repeated calls with mostly the same arrays.

    Taichi checks and passes every argument at every call, which takes 7 us per array. A bound
    kernel reuses the launch context of its last call with equal template arguments. It passes only
    scalars and those arrays that are different objects than before.

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
                declares. Arrays of vectors start at multiples of the vector's length.

        Raises:
            TypeError: if an array has another type, order or alignment. (In plain mode, Taichi
                raises its own error for another type or order.)
        """
        if self._plain:
            with _compiling, _options(ti.cfg):
                self._kernel(*args)
            return
        key, values = args[: self._templates], args[self._templates :]
        launch = self._launches.get(key)
        if launch is None or launch.program is not ti.lang.impl.get_runtime().prog:
            with _compiling:
                launch = self._launches[key] = _Launch(self._kernel, args, self._templates)
        launch.run(values)

    def release(self, *arrays: Any) -> None:
        """Drop references to arrays of past calls; otherwise they live until they are replaced."""
        for launch in self._launches.values():
            launch.release({id(array) for array in arrays})


def run_once(kernel: Any, **arguments: Any) -> None:
    """Run a rarely called kernel through Taichi's public interface, with OPTIONS.

    Args:
        kernel: a Taichi kernel.
        arguments: arguments of the kernel, by name.
    """
    with _compiling, _options(ti.cfg):
        kernel(**arguments)


class _Launch:
    """One compiled kernel with a launch context that holds its arguments."""

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
        self._passed: list[Any] = [None] * len(annotations)
        """Arguments in the context."""
        self._kinds: list[Any] = [None] * len(annotations)
        """Type and number of dimensions of each array, from the first call."""
        self._set(args[templates:])

    def run(self, values: tuple[Any, ...]) -> None:
        """Run the kernel; ``values`` are the arguments after the template arguments."""
        self._set(values)
        self.program.launch_kernel(self._compiled, self._context)

    def release(self, arrays: set[int]) -> None:
        """Drop references to the arrays with these ``id`` values."""
        self._passed = [None if id(value) in arrays else value for value in self._passed]

    def _set(self, values: tuple[Any, ...]) -> None:
        """Pass the arguments that are different objects than in the last call."""
        context, last, kinds = self._context, self._passed, self._kinds
        for i, value in enumerate(values):
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
    """Translate a kernel for these arguments; return the key of the result in Taichi's table.

    Whole numbers in kernels have 32 bits, whatever the options of the runtime are.
    """
    runtime = ti.lang.impl.get_runtime()
    before = runtime.default_ip
    try:
        runtime.default_ip = ti.i32
        try:
            with no_positions():
                return primal.ensure_compiled(*args)
        except Exception:
            # Translate again with positions, so that the message names the line of the error.
            return primal.ensure_compiled(*args)
    finally:
        runtime.default_ip = before


@contextmanager
def _options(config: Any) -> Iterator[Any]:
    """Set OPTIONS in a configuration, and restore the previous values on exit."""
    before = {name: getattr(config, name) for name in OPTIONS}
    try:
        for name, value in OPTIONS.items():
            setattr(config, name, value)
        yield config
    finally:
        for name, value in before.items():
            setattr(config, name, value)
