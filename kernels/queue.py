"""The queue of delay-tolerant work at the end of a step, see ``sim/queue.py``."""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.arrays import F64_LANES
from .compiler.functions import SLICE

TASK_BLOCKS = 32
"""Vectors side by side in a row that one task takes on."""
TASK_ROWS = 8
"""Rows that a task goes through at a time; twice as many compete for the same sets of the cache."""
SERIAL_UP_TO = 512
"""Data centers that one thread computes sooner than several are woken."""


@cache
def queue_kernel() -> Any:
    """Kernel that takes work out of the queue, puts new work in, and reads the ages.

    Row k of a queue is the work still queued that was put in by the end of step k, oldest first, in
    L rows. A task goes through TASK_ROWS rows of TASK_BLOCKS vectors at a time, as they lie in
    memory; the oldest rows that are known to be 0 are not read.

    Arguments, all arrays but the first four being ``compiler.arrays.vector_rows`` of data centers:

    - serial: whether the calling thread does all.
    - one: 1, see "Loops of step 1" in README.md.
    - negligible: work up to this is round-off, and has no age.
    - due_row: row of the queue that is due when the next step starts, L for none, (vectors, lanes).
    - empty_rows: how many of the oldest rows of a vector will be 0 after the step; read and kept up
      to date, (vectors,).
    - before: queues before the step, (L, vectors).
    - moved: work taken out, and work put in, (2, vectors).
    - after: queues after the step, (L, vectors).
    - found: work that waits, work that will be due, age of the oldest work and mean age in steps,
      (4, vectors).
    """
    blocks = ti.types.ndarray(dtype=ti.types.vector(F64_LANES, ti.f64), ndim=2)
    ints = ti.types.ndarray(dtype=ti.i32, ndim=2)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    @no_type_check
    def queue_after(
        serial: ti.template(),
        one: ti.i32,
        negligible: ti.f64,
        due_row: ints,
        empty_rows: ints_1d,
        before: blocks,
        moved: blocks,
        after: blocks,
        found: blocks,
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
                block = first
                while block < end:
                    found[0, block] = zeros
                    found[2, block] = zeros
                    found[3, block] = zeros
                    block += one
                row = 0
                while row < last:
                    row_end = ti.min(row + TASK_ROWS, last)
                    block = first
                    while block < end:
                        out, filled = moved[0, block], found[0, block]
                        aged, waited = found[2, block], found[3, block]
                        k, zero_end = row, ti.min(empty_rows[block], row_end)
                        while k < zero_end:
                            after[k, block] = zeros
                            k += one
                        while k < row_end:
                            left = before[k + 1, block] - out
                            filled += ti.select(left > zeros, ones, zeros)
                            left = ti.select(left > zeros, left, zeros)
                            after[k, block] = left
                            # Work of the newest step has age 0; older work counts once per step it
                            # has waited.
                            waits = left > limit
                            aged += ti.select(waits, ones, zeros)
                            waited += ti.select(waits, left, zeros)
                            k += one
                        found[0, block] = filled
                        found[2, block] = aged
                        found[3, block] = waited
                        block += one
                    row = row_end
                block = first
                while block < end:
                    # A row of 0 in all lanes is the one before it a step later.
                    filled, most = found[0, block], ti.f64(0.0)
                    for i in range(F64_LANES):
                        most = ti.max(most, filled[i])
                    empty_rows[block] = ti.max(last - 1 - ti.cast(most, ti.i32), 0)
                    total = after[last - 1, block] + moved[1, block]
                    after[last, block] = total
                    due = zeros
                    for i in range(F64_LANES):
                        if due_row[block, i] <= last:
                            due_of = after[due_row[block, i], block]
                            due[i] = due_of[i]
                    some = total > zeros
                    mean = found[3, block] / ti.select(some, total, ones)
                    found[0, block] = total
                    found[1, block] = due
                    found[3, block] = ti.select(some, mean, zeros)
                    block += one

    return queue_after
