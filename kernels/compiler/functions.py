"""Building blocks of kernels: number types, tasks of a parallel loop, functions of vectors."""

from typing import Any, no_type_check

import taichi as ti

SLICE = 512
"""Iterations of a task: Taichi runs a parallel loop of at most so many on one thread."""


def reals(precision: str) -> Any:
    """Taichi's type of the real numbers of a kernel in ``f32`` or ``f64``."""
    return {"f32": ti.f32, "f64": ti.f64}[precision]


@ti.func
@no_type_check
def larger(a, b):
    """Elementwise maximum in one instruction; ``ti.max`` takes more, as it also looks for NaN."""
    return ti.select(a > b, a, b)


@ti.func
@no_type_check
def smaller(a, b):
    """Elementwise minimum in one instruction; ``ti.min`` takes more, as it also looks for NaN."""
    return ti.select(a < b, a, b)


@ti.func
@no_type_check
def part_of(part, parts, items):
    """First item of one of ``parts`` equal parts of ``items``, and the end of the part."""
    first = ti.cast(ti.cast(part, ti.i64) * items // parts, ti.i32)
    end = ti.cast((ti.cast(part, ti.i64) + 1) * items // parts, ti.i32)
    return first, end
