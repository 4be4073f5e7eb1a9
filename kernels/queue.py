"""The queue of delay-tolerant work at the end of a step, see ``plant.workload``."""

from functools import cache
from typing import Any, no_type_check

from .backend import F64_LANES, SLICE, BoundKernel, ti

TASK_BLOCKS = 32
"""Vectors side by side in a row that one task takes on."""
TASK_ROWS = 8
"""Rows that a task goes through at a time; twice as many compete for the same sets of the cache."""
SERIAL_UP_TO = 512
"""Data centers that one thread computes sooner than several are woken."""


def bound_queue_kernel() -> BoundKernel:
    """``queue_kernel`` for arrays of one fleet."""
    return BoundKernel(queue_kernel(), templates=1)


@cache
def queue_kernel() -> Any:
    """Kernel that takes work out of the queue, puts new work in, and reads the ages.

    Row k of the queues is the work still queued that was put in by the end of step k, oldest first.
    Work of no more than ``negligible`` is left by rounding, and has no age. A task goes through a
    few rows of many data centers at a time, side by side as they lie in memory.

    Arguments: whether one thread does it; negligible work; number of data centers, B; 1, which
    compilers cannot know, so that they make no copies of the loop that advances by it; row of the
    queue that is due when the next step starts, (B,), L for none; the queues before, L
    ``backend.vector_rows`` of data centers; the work taken and deferred, (B,); room for three such
    rows. For the results: the queues after, and four rows, (4, B): work that waits, what of it will
    be due, the age of the oldest work and the mean age in steps.
    """
    blocks = ti.types.ndarray(dtype=ti.types.vector(F64_LANES, ti.f64), ndim=2)
    rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
    reals = ti.types.ndarray(dtype=ti.f64, ndim=1)
    ints = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    @no_type_check
    def queue_after(
        serial: ti.template(),
        negligible: ti.f64,
        n: ti.i32,
        step: ti.i32,
        due_row: ints,
        before: blocks,
        taken: reals,
        deferred: reals,
        room: blocks,
        after: blocks,
        found: rows,
    ):
        n_tasks = (before.shape[1] + (TASK_BLOCKS - 1)) // TASK_BLOCKS
        ti.loop_config(serialize=serial)
        for at in range(n_tasks * SLICE):
            if at % SLICE == 0:
                first = at // SLICE * TASK_BLOCKS
                end = ti.min(first + TASK_BLOCKS, before.shape[1])
                last = before.shape[0] - 1
                zeros = ti.Vector([ti.f64(0.0)] * F64_LANES)
                ones = zeros + ti.f64(1.0)
                limit = zeros + negligible
                for block in range(first, end):
                    out = zeros
                    for i in range(F64_LANES):
                        out[i] = taken[ti.min(block * F64_LANES + i, n - 1)]
                    room[0, block] = out
                    room[1, block] = zeros
                    room[2, block] = zeros
                for rows_at in range((last + (TASK_ROWS - 1)) // TASK_ROWS):
                    row = rows_at * TASK_ROWS
                    for block in range(first, end):
                        out, aged, waited = room[0, block], room[1, block], room[2, block]
                        k = row
                        while k < ti.min(row + TASK_ROWS, last):
                            left = before[k + 1, block] - out
                            left = ti.select(left > zeros, left, zeros)
                            after[k, block] = left
                            # Work of the newest step has age 0; older work counts once per step it
                            # has waited.
                            waits = left > limit
                            aged += ti.select(waits, ones, zeros)
                            waited += ti.select(waits, left, zeros)
                            k += step
                        room[1, block] = aged
                        room[2, block] = waited
                for block in range(first, end):
                    new = zeros
                    for i in range(F64_LANES):
                        new[i] = deferred[ti.min(block * F64_LANES + i, n - 1)]
                    total = after[last - 1, block] + new
                    after[last, block] = total
                    aged, waited = room[1, block], room[2, block]
                    for i in range(F64_LANES):
                        b = block * F64_LANES + i
                        if b < n:
                            found[0, b] = total[i]
                            found[1, b] = ti.f64(0.0)
                            if due_row[b] <= last:
                                due = after[due_row[b], block]
                                found[1, b] = due[i]
                            found[2, b] = aged[i]
                            found[3, b] = ti.f64(0.0)
                            if total[i] > 0.0:
                                found[3, b] = waited[i] / total[i]

    return queue_after
