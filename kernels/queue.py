"""The queue of delay-tolerant work at the end of a step, see ``plant.workload``."""

from functools import cache
from typing import Any, no_type_check

from .backend import BoundKernel, ti

LANES = 8
"""Data centers that are computed at a time."""
BLOCKS_AT_ONCE = 64
"""Least that a thread takes on."""
SERIAL_UP_TO = 256
"""Data centers that one thread computes sooner than several are woken."""


def bound_queue_kernel() -> BoundKernel:
    """``queue_kernel`` for arrays of one fleet."""
    return BoundKernel(queue_kernel(), templates=1)


@cache
def queue_kernel() -> Any:
    """Kernel that takes work out of the queue, puts new work in, and reads the ages.

    Row k of the queues is the work still queued that was put in by the end of step k, oldest first.
    Work of no more than ``negligible`` is left by rounding, and has no age.

    Arguments: whether one thread does it; negligible work; number of data centers, B; row of the
    queue that is due when the next step starts, (B,), L for none; the queues before, L rows of
    vectors of LANES data centers; the work taken and deferred, (B,). For the results: the queues
    after, and four rows, (4, B): work that waits, what of it will be due, the age of the oldest
    work and the mean age in steps.
    """
    blocks = ti.types.ndarray(dtype=ti.types.vector(LANES, ti.f64), ndim=2)
    rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
    reals = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.kernel
    @no_type_check
    def queue_after(
        serial: ti.template(),
        negligible: ti.f64,
        n: ti.i32,
        due_row: reals,
        before: blocks,
        taken: reals,
        deferred: reals,
        after: blocks,
        found: rows,
    ):
        ti.loop_config(serialize=serial, block_dim=BLOCKS_AT_ONCE)
        for block in range(before.shape[1]):
            last = before.shape[0] - 1
            zeros = ti.Vector([ti.f64(0.0)] * LANES)
            ones = zeros + ti.f64(1.0)
            limit = zeros + negligible
            out, new, due_at = zeros, zeros, zeros
            for i in range(LANES):
                b = ti.min(block * LANES + i, n - 1)
                out[i] = taken[b]
                new[i] = deferred[b]
                due_at[i] = due_row[b]
            left, aged, waited, due, row = zeros, zeros, zeros, zeros, zeros
            for k in range(last):
                left = before[k + 1, block] - out
                left = ti.select(left > zeros, left, zeros)
                after[k, block] = left
                # Work of the newest step has age 0; older work counts once per step it has waited.
                waits = left > limit
                aged += ti.select(waits, ones, zeros)
                waited += ti.select(waits, left, zeros)
                due = ti.select(row == due_at, left, due)
                row += ones
            total = left + new
            after[last, block] = total
            due = ti.select(row == due_at, total, due)
            for i in range(LANES):
                b = block * LANES + i
                if b < n:
                    found[0, b] = total[i]
                    found[1, b] = due[i]
                    found[2, b] = aged[i]
                    found[3, b] = ti.f64(0.0)
                    if total[i] > 0.0:
                        found[3, b] = waited[i] / total[i]

    return queue_after
