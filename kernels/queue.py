"""Kernel that updates the queue of delay-tolerant work at the end of a step (``sim/queue.py``)."""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.arrays import F64_LANES
from .compiler.functions import SLICE

TASK_BLOCKS = 32
"""Number of adjacent vectors of a row that one task processes."""
TASK_ROWS = 8
"""Rows that a task processes together; twice as many compete for the same sets of the cache."""
SERIAL_UP_TO = 512
"""Largest number of data centers that one thread computes faster than several."""


@cache
def queue_kernel() -> Any:
    """Return the kernel that removes and adds work of the queue, and measures the age of the work.

    Row k of a queue is the waiting part of the work added by the end of step k, oldest first, in L
    rows. A task processes TASK_ROWS rows of TASK_BLOCKS vectors together, in memory order. It does
    not read the oldest rows that are known to be 0.

    Arguments. All but the first five are arrays with the layout of
    ``compiler.arrays.vector_rows``, with data centers as entries:

    - serial: True if the calling thread does all work.
    - delay: age of work that enters from other sites, in steps, less than L; 0 if there is none.
    - one: always 1, see "Loops of step 1" in README.md.
    - negligible: largest amount of work that counts as rounding error and has no age.
    - due_row: row of the queue that is due when the next step starts, L for none, (vectors, lanes).
    - empty_rows: number of the oldest rows of a vector that are 0 after the step, input and output,
      (vectors,).
    - before: queues before the step, (L, vectors).
    - moved: work removed, work added, and work added with the age ``delay``, (3, vectors).
    - after: output, queues after the step, (L, vectors).
    - statistics: output, (4, vectors): waiting work, work that will be due, age of the oldest work
      in steps, and mean age in steps.
    """
    blocks = ti.types.ndarray(dtype=ti.types.vector(F64_LANES, ti.f64), ndim=2)
    ints = ti.types.ndarray(dtype=ti.i32, ndim=2)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    @no_type_check
    def queue_after(
        serial: ti.template(),
        delay: ti.template(),
        one: ti.i32,
        negligible: ti.f64,
        due_row: ints,
        empty_rows: ints_1d,
        before: blocks,
        moved: blocks,
        after: blocks,
        statistics: blocks,
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
                    statistics[0, block] = zeros
                    statistics[2, block] = zeros
                    statistics[3, block] = zeros
                    block += one
                row = 0
                while row < last:
                    row_end = ti.min(row + TASK_ROWS, last)
                    block = first
                    while block < end:
                        out, filled = moved[0, block], statistics[0, block]
                        aged, waited = statistics[2, block], statistics[3, block]
                        k, zero_end = row, ti.min(empty_rows[block], row_end)
                        if ti.static(delay > 0):
                            zero_end = ti.min(zero_end, last - delay)
                        while k < zero_end:
                            after[k, block] = zeros
                            k += one
                        while k < row_end:
                            left = before[k + 1, block] - out
                            if ti.static(delay > 0):
                                left = ti.select(left > zeros, left, zeros)
                                if k >= last - delay:
                                    left += moved[2, block]
                            filled += ti.select(left > zeros, ones, zeros)
                            left = ti.select(left > zeros, left, zeros)
                            after[k, block] = left
                            # Work of the newest step has age 0; older work counts once per step it
                            # has waited.
                            waits = left > limit
                            aged += ti.select(waits, ones, zeros)
                            waited += ti.select(waits, left, zeros)
                            k += one
                        statistics[0, block] = filled
                        statistics[2, block] = aged
                        statistics[3, block] = waited
                        block += one
                    row = row_end
                block = first
                while block < end:
                    # A row that is 0 in all lanes moves to the previous row in each step.
                    filled, most = statistics[0, block], ti.f64(0.0)
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
                    mean = statistics[3, block] / ti.select(some, total, ones)
                    statistics[0, block] = total
                    statistics[1, block] = due
                    statistics[3, block] = ti.select(some, mean, zeros)
                    block += one

    return queue_after
