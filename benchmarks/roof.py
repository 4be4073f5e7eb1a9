"""The memory roof: how fast three layers can be stored at all."""

import time
from collections.abc import Callable
from typing import no_type_check

RUN = 256
"""Values that one pass of the inner loop stores: long against a vector."""


def core_s(call: Callable[[], object], repeats: int) -> float:
    """Least core time of several runs, s."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def store_s(servers: int, repeats: int) -> float:
    """Core time of a plain store of three layers of ``servers`` values, s.

    A parallel loop over all values stores them one by one, at half the speed of memory; a serial
    loop of fixed length within is vectorised, where the run's value comes from the same tree.
    """
    from sdc_taichi.kernels.backend import SLICE, ti

    slices = 64

    @ti.kernel
    @no_type_check
    def store(
        a: ti.template(), b: ti.template(), c: ti.template(), of_run: ti.template(), runs: ti.i32
    ):
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                part = ti.cast(k // SLICE, ti.i64)
                first = ti.cast(part * runs // slices, ti.i32)
                last = ti.cast((part + 1) * runs // slices, ti.i32)
                for run in range(first, last):
                    x = of_run[run]
                    at = run * RUN
                    for i in range(RUN):
                        a[at + i] = x
                        b[at + i] = x
                        c[at + i] = x

    runs = -(-servers // RUN)
    fields = [ti.field(ti.f32) for _ in range(4)]
    builder = ti.FieldsBuilder()
    for field, length in zip(fields, (runs * RUN, runs * RUN, runs * RUN, runs), strict=True):
        builder.dense(ti.i, length).place(field)
    tree = builder.finalize()
    spent = core_s(lambda: (store(*fields, runs), ti.sync()), repeats)
    tree.destroy()
    return spent
