"""Delay-tolerant work: defer, drain, deadlines and ages in a first-in-first-out queue.

The queue is one array per data center: entry k is the work still queued that was put in by the end
of step k, oldest step first. It never decreases along k, so length, due part and age histogram are
read off it or are differences of two entries.
Work is counted in tasks: 1 task is 1 % of the data center's capacity for one step. A model decides
what happens to work from what waits and what is due; ``Queue`` does it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi import runtime
from sdc_taichi.types import F64

TASKS_PER_STEP = 100.0
"""Capacity of a data center for one step."""


@dataclass(frozen=True, slots=True)
class Work:
    """Outcome of one step, each (B,), in tasks unless stated."""

    utilisation: F64
    arrived: F64
    executed: F64
    deferred: F64
    drained: F64
    due: F64
    overdue: F64
    dropped: F64
    taken: F64
    """Work that left the queue."""


WorkModel = Callable[..., Work]


def fluid(
    demand: F64,
    command: F64,
    waiting: F64,
    due: F64,
    *,
    flexible_share: F64,
    max_utilisation: F64,
    queue_limit: F64,
) -> Work:
    """Divisible work, conserved exactly: arrived = executed + queued + dropped.

    Deferring queues ``-command`` of the flexible share, draining takes ``command`` of what fits
    (paper, A.1.3). Work beyond the capacity of the step queues too. Work whose deadline has come
    runs first, as far as capacity allows; what does not fit into the queue is dropped.

    Args:
        demand: arriving work as a share of capacity, (B,).
        command: -1 defer all flexible work .. 0 .. 1 drain all that fits, (B,).
        waiting: work in the queue, (B,).
        due: part of it whose deadline has come, (B,).
        flexible_share: share of the demand that may wait, (B,).
        max_utilisation: capacity limit, (B,).
        queue_limit: longest queue in tasks, (B,).
    """
    arrived = demand * TASKS_PER_STEP
    capacity = max_utilisation * TASKS_PER_STEP
    flexible = flexible_share * arrived
    wanted = arrived - np.maximum(-command, 0.0) * flexible
    forced = np.minimum(due, capacity)
    now = np.minimum(wanted, capacity - forced)
    held_back = arrived - now
    room = queue_limit - (waiting - forced)
    deferred = np.minimum(held_back, room)
    drained = np.minimum(waiting - forced, np.maximum(command, 0.0) * (capacity - now - forced))
    executed = now + forced + drained
    return Work(
        executed / TASKS_PER_STEP,
        arrived,
        executed,
        deferred,
        drained,
        due,
        due - forced,
        held_back - deferred,
        forced + drained,
    )


def tasks(
    demand: F64,
    command: F64,
    waiting: F64,
    due: F64,
    *,
    flexible_share: F64,
    max_utilisation: F64,
    queue_limit: F64,
) -> Work:
    """Whole tasks as the released SustainDC counts them; arguments as in ``fluid``.

    Fixed work is rounded up and flexible work down, so a step may execute one task more than
    arrived. Tasks older than the deadline run first up to the utilisation cap; a drain takes no
    more than the step's flexible tasks and stops at the cap. Work above the cap that nobody
    deferred still runs, as in the released code.
    """
    fixed = np.ceil(demand * (1.0 - flexible_share) * TASKS_PER_STEP)
    flexible = np.floor(demand * flexible_share * TASKS_PER_STEP)
    cap = np.floor(max_utilisation * TASKS_PER_STEP)
    arrived = fixed + flexible
    forced = np.minimum(due, np.maximum(cap - arrived, 0.0))
    held_back = np.floor(np.maximum(-command, 0.0) * flexible)
    deferred = np.minimum(held_back, queue_limit - (waiting - forced))
    free = np.maximum(cap - arrived - forced, 0.0)
    drainable = np.minimum(np.minimum(waiting - forced, flexible), free)
    drained = np.floor(np.maximum(command, 0.0) * drainable)
    # As released: tasks that find the queue full count as dropped and run all the same.
    executed = arrived - deferred + forced + drained
    return Work(
        executed / TASKS_PER_STEP,
        arrived,
        executed,
        deferred,
        drained,
        due,
        due - forced,
        held_back - deferred,
        forced + drained,
    )


MODELS: dict[str, WorkModel] = {"fluid": fluid, "tasks": tasks}
DUE_AFTER_STEPS = {"fluid": 0.0, "tasks": 1.0}
"""Steps between the deadline and when the models take work as due."""
UNLIMITED_TASKS = 1e30
"""Limit of a queue without one; larger than any, and still a number."""


class Queue:
    """What every step does to the queues of a fleet.

    A queue is the work still queued by the step that put it in, oldest first, (B, L).

    Args:
        length: L.
        due_steps: age at which work is due, inf for never, (B,).
    """

    def __init__(self, length: int, due_steps: F64) -> None:
        due_at = length - np.minimum(due_steps, length + 1.0).astype(np.int64)
        self._dcs = np.arange(len(due_steps))
        self._due_at = np.maximum(due_at, 0)
        self._never = due_at < 0
        self._after: Any = None

    def due(self, queue: F64) -> F64:
        """Work that is due when the coming step starts, (B,)."""
        return np.where(self._never, 0.0, queue[self._dcs, self._due_at])

    def after(self, queue: F64, taken: F64, deferred: F64) -> tuple[F64, F64, F64]:
        """The queue at the end of a step, a new array.

        Args:
            queue: at its start.
            taken: work that leaves it, oldest first, (B,).
            deferred: work that enters it, (B,).

        Returns:
            Age of the oldest work and mean age in steps, (B,), and the queue.
        """
        from sdc_taichi.kernels.queue import SERIAL_UP_TO, bound_queue_kernel

        if self._after is None:
            runtime.ensure_started()
            self._after = bound_queue_kernel()
        after, ages = np.empty_like(queue), np.empty((2, len(queue)))
        serial = len(queue) <= SERIAL_UP_TO
        self._after(serial, _NEGLIGIBLE_TASKS, queue, taken, deferred, after, ages)
        return ages[0], ages[1], after

    def forget(self) -> None:
        """Let go of the kernel and the arrays that it was last given."""
        self._after = None


def age_histogram(queue: F64, edges_steps: F64) -> F64:
    """Queued tasks by age, (B, number of edges).

    Args:
        queue: work still queued by the step that put it in, (B, L).
        edges_steps: lower edges of the age bins in steps, rising from 0; the last bin is open.
    """
    last = queue.shape[1] - 1
    edges = np.asarray(edges_steps).astype(np.int64)
    found: F64 = queue.T[np.maximum(last - edges, 0)]
    found[:-1] -= found[1:]
    return found.T


_NEGLIGIBLE_TASKS = 1e-9
"""Left by rounding where a step's work was taken out in parts; no age is read off it."""
