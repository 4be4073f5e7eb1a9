"""The one place that imports Taichi, so that a maintained fork could take its place."""

import os
from typing import Any

import numpy as np

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")

import taichi as ti

__all__ = ["BoundKernel", "ti"]


OPTIONS = {"cfg_optimization": False}
"""How bound kernels are compiled, whoever started the runtime. Taichi's analysis of the control
flow takes four fifths of the time and finds nothing that LLVM does not."""


class BoundKernel:
    """A kernel that is called again and again with mostly the same arrays.

    Taichi checks and hands over every argument on every call, which costs 0.4 ms for the 25 arrays
    of a hall. A call keeps the launch context of the one before with the same template arguments,
    and hands over scalars and those arrays that are other objects than then.

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
            launch = self._launches[key] = _Launch(self._kernel, args, self._templates)
        launch.run(given)


class _Launch:
    """One compiled kernel with its arguments in place."""

    def __init__(self, kernel: Any, args: tuple[Any, ...], templates: int) -> None:
        primal = kernel._primal
        compiled = primal.compiled_kernels[primal.ensure_compiled(*args)]
        self.program = ti.lang.impl.get_runtime().prog
        config = self.program.config()
        before = {name: getattr(config, name) for name in OPTIONS}
        try:
            for name, value in OPTIONS.items():
                setattr(config, name, value)
            self._compiled = self.program.compile_kernel(
                config, self.program.get_device_caps(), compiled
            )
        finally:
            for name, value in before.items():
                setattr(config, name, value)
        self._context = compiled.make_launch_context()
        annotations = [argument.annotation for argument in primal.arguments[templates:]]
        self._element_dims = [getattr(getattr(a, "dtype", None), "ndim", 0) for a in annotations]
        self._given: list[Any] = [None] * len(annotations)
        self._put(args[templates:])

    def run(self, given: tuple[Any, ...]) -> None:
        self._put(given)
        self.program.launch_kernel(self._compiled, self._context)

    def _put(self, given: tuple[Any, ...]) -> None:
        context, held = self._context, self._given
        for i, value in enumerate(given):
            if value is held[i]:
                continue
            if isinstance(value, np.ndarray):
                former = held[i]
                alike = former is None or (former.dtype, former.ndim) == (value.dtype, value.ndim)
                if not (alike and value.flags.c_contiguous):
                    raise TypeError(f"argument {i}: {value.dtype} array of other type or order")
                shape = value.shape[: value.ndim - self._element_dims[i]]
                context.set_arg_external_array_with_shape(
                    (i,), value.ctypes.data, value.nbytes, shape, 0
                )
            elif isinstance(value, float):
                context.set_arg_float((i,), value)
            else:
                context.set_arg_int((i,), int(value))
            held[i] = value
