"""Building blocks of kernels: number types, parts of parallel loops, and vector functions."""

from typing import Any, no_type_check

import taichi as ti

SLICE = 512
"""Iterations of a task: Taichi runs a parallel loop of up to 512 iterations on one thread."""


def reals(precision: str) -> Any:
    """Return Taichi's real number type for the precision ``f32`` or ``f64``."""
    return {"f32": ti.f32, "f64": ti.f64}[precision]


@ti.func
@no_type_check
def larger(a, b):
    """Return the elementwise maximum, in one instruction; ``ti.max`` also has to check for NaN."""
    return ti.select(a > b, a, b)


@ti.func
@no_type_check
def smaller(a, b):
    """Return the elementwise minimum, in one instruction; ``ti.min`` also has to check for NaN."""
    return ti.select(a < b, a, b)


@ti.func
@no_type_check
def part_of(part, parts, items):
    """Return the first item and the end of part ``part`` of ``parts`` equal parts of ``items``."""
    first = ti.cast(ti.cast(part, ti.i64) * items // parts, ti.i32)
    end = ti.cast((ti.cast(part, ti.i64) + 1) * items // parts, ti.i32)
    return first, end
