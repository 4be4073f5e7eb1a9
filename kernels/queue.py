"""The queue of delay-tolerant work at the end of a step, see ``plant.workload``."""

from functools import cache
from typing import Any, no_type_check

from .backend import BoundKernel, ti

SERIAL_UP_TO = 64
"""Data centers that one thread computes sooner than several are woken."""


def bound_queue_kernel() -> BoundKernel:
    """``queue_kernel`` for arrays of one fleet."""
    return BoundKernel(queue_kernel(), templates=1)


@cache
def queue_kernel() -> Any:
    """Kernel that takes work out of the queue, puts new work in, and reads the ages.

    Entry k of a queue is the work still queued that was put in by the end of step k, oldest first.
    Work of no more than ``negligible`` is left by rounding, and has no age.

    Arguments: whether one thread does it; negligible work; the queues before and the work taken and
    deferred, (B,); and for the results the queues after, (B, L), and two rows, (2, B): the age of
    the oldest work and the mean age in steps.
    """
    rows = ti.types.ndarray(dtype=ti.f64, ndim=2)
    reals = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.kernel
    @no_type_check
    def queue_after(
        serial: ti.template(),
        negligible: ti.f64,
        before: rows,
        taken: reals,
        deferred: reals,
        after: rows,
        ages: rows,
    ):
        ti.loop_config(serialize=serial)
        for b in range(before.shape[0]):
            last = before.shape[1] - 1
            out = taken[b]
            aged = 0
            waited = ti.f64(0.0)
            left = ti.f64(0.0)
            for k in range(last):
                left = ti.max(before[b, k + 1] - out, ti.f64(0.0))
                after[b, k] = left
                # Work of the newest step has age 0; older work counts once per step it has waited.
                if left > negligible:
                    aged += 1
                    waited += left
            total = left + deferred[b]
            after[b, last] = total
            ages[0, b] = ti.cast(aged, ti.f64)
            ages[1, b] = ti.f64(0.0)
            if total > 0.0:
                ages[1, b] = waited / total

    return queue_after
