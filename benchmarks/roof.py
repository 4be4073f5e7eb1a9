"""The memory roof: how fast three layers can be stored at all, and how calls are compared."""

import time
from collections.abc import Callable, Mapping
from typing import Any, no_type_check

import numpy as np

from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.types import F64

RUN = 32
"""Vectors that one value is stored to, as to the servers of a group."""


def core_s(calls: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, F64]:
    """Core time of each call in each round, s, (rounds,).

    The calls of a round follow each other, so that what memory and processors have to bear from
    outside meets all of them: what a call takes over another is the median over the rounds.
    """
    for call in calls.values():
        call()
    spent = {name: np.zeros(rounds) for name in calls}
    for at in range(rounds):
        for name, call in calls.items():
            start = time.process_time()
            call()
            spent[name][at] = time.process_time() - start
    return spent


def plain_store(servers: int) -> Callable[[], object]:
    """A store of three layers of ``servers`` values on all threads, in whole vectors."""
    import taichi as ti

    from sdc_taichi.kernels.compiler.arrays import aligned
    from sdc_taichi.kernels.compiler.functions import SLICE, part_of
    from sdc_taichi.kernels.compiler.launch import BoundKernel

    lanes, slices = 8, 64
    blocks_1d = ti.types.ndarray(dtype=ti.types.vector(lanes, ti.f32), ndim=1)

    @ti.kernel
    @no_type_check
    def store(slices: ti.i32, values: blocks_1d, a: blocks_1d, b: blocks_1d, c: blocks_1d):
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                first, end = part_of(k // SLICE, slices, values.shape[0])
                for run in range(first, end):
                    x = values[run]
                    for at in range(run * RUN, (run + 1) * RUN):
                        a[at] = x
                        b[at] = x
                        c[at] = x

    runtime.ensure_started()
    runs = -(-servers // (lanes * RUN))
    arrays: list[Any] = [aligned((n, lanes), np.float32) for n in (runs, *[runs * RUN] * 3)]
    for array in arrays:
        array[:] = 0.0
    bound = BoundKernel(store, templates=0)
    return lambda: bound(slices, *arrays)
