"""Delay-tolerant work: defer, drain, deadlines and ages in a first-in-first-out queue.

The queue is one array per data center: entry k is the work still queued that was put in by the end
of step k, oldest step first. It never decreases along k, so length, due part and age histogram are
read off it or are differences of two entries.
Work is counted in tasks: 1 task is 1 % of the data center's capacity for one step. A model decides
how much work runs, waits or is dropped from the work that waits and that is due; ``sim.workload``
keeps the queues.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64, Values, Work

TASKS_PER_STEP = 100.0
"""Capacity of a data center for one step."""


class WorkPoint(NamedTuple):
    """Work, command and limits of one step of B data centers."""

    demand: F64
    """Arriving work as a share of capacity, 0..1, (B,)."""
    command: F64
    """-1 defers all flexible work, 0 neither defers nor drains, 1 drains all that fits, (B,)."""
    waiting: F64
    """Work in the queue, in tasks, (B,)."""
    due: F64
    """Part of the waiting work whose deadline has come, in tasks, (B,)."""
    flexible_share: Values
    """Share of the demand that may wait, 0..1, (B,)."""
    max_utilisation: Values
    """Highest utilisation, 0..1, (B,); with ``tasks`` that above which no queued work runs."""
    queue_limit: Values
    """Longest queue, in tasks, (B,)."""


@dataclass(frozen=True, slots=True)
class WorkModel:
    """A model of work."""

    step: Callable[[WorkPoint], Work]
    """What happens to the work of a step."""
    due_after_steps: float
    """Steps between the deadline of work and the step in which the model takes it as due."""


def fluid(point: WorkPoint) -> Work:
    """Divisible work, conserved exactly: arrived = executed + queued + dropped.

    Deferring queues ``-command`` of the flexible share, draining takes ``command`` of what fits
    (paper, A.1.3). Work beyond the capacity of the step queues too. Work whose deadline has come
    runs first, as far as capacity allows; what does not fit into the queue is dropped.
    """
    arrived = point.demand * TASKS_PER_STEP
    capacity = point.max_utilisation * TASKS_PER_STEP
    flexible = point.flexible_share * arrived
    wanted = arrived - np.maximum(-point.command, 0.0) * flexible
    forced = np.minimum(point.due, capacity)
    now = np.minimum(wanted, capacity - forced)
    held_back = arrived - now
    deferred = np.minimum(held_back, _room(point.queue_limit, point.waiting - forced))
    drained = np.minimum(
        point.waiting - forced, np.maximum(point.command, 0.0) * (capacity - now - forced)
    )
    started = now + forced + drained
    return _work(point, arrived, started, forced, deferred, held_back - deferred, drained)


def tasks(point: WorkPoint) -> Work:
    """Whole tasks as the released SustainDC counts them: arrived = executed + queued.

    Fixed work is rounded up and flexible work down, so a step may execute one task more than
    arrived. Tasks older than the deadline run first up to the utilisation cap; a drain takes no
    more than the step's flexible tasks and stops at the cap. Work above the cap that nobody
    deferred still runs, as in the released code, and so do tasks that find the queue full: they
    count as dropped and as started.
    """
    fixed = np.ceil(point.demand * (1.0 - point.flexible_share) * TASKS_PER_STEP)
    flexible = np.floor(point.demand * point.flexible_share * TASKS_PER_STEP)
    cap = np.floor(point.max_utilisation * TASKS_PER_STEP)
    arrived = fixed + flexible
    forced = np.minimum(point.due, np.maximum(cap - arrived, 0.0))
    held_back = np.floor(np.maximum(-point.command, 0.0) * flexible)
    deferred = np.minimum(held_back, _room(point.queue_limit, point.waiting - forced))
    free = np.maximum(cap - arrived - forced, 0.0)
    drainable = np.minimum(np.minimum(point.waiting - forced, flexible), free)
    drained = np.floor(np.maximum(point.command, 0.0) * drainable)
    started = arrived - deferred + forced + drained
    return _work(point, arrived, started, forced, deferred, held_back - deferred, drained)


def _work(
    point: WorkPoint,
    arrived: F64,
    started: F64,
    forced: F64,
    deferred: F64,
    dropped: F64,
    drained: F64,
) -> Work:
    """Result of a step, in tasks; ``forced`` is the due work that runs, ``drained`` other work."""
    return Work(
        utilisation=started / TASKS_PER_STEP,
        arrived_tasks=arrived,
        started_tasks=started,
        deferred_tasks=deferred,
        drained_tasks=drained,
        due_tasks=point.due,
        overdue_tasks=point.due - forced,
        dropped_tasks=dropped,
        dequeued_tasks=forced + drained,
    )


def _room(queue_limit: Values, waiting: F64) -> F64:
    """Work that still fits into a queue, in tasks, (B,)."""
    # Rounding may leave more in a full queue than it may hold.
    return np.maximum(queue_limit - waiting, 0.0)


MODELS: dict[str, WorkModel] = {
    "fluid": WorkModel(fluid, due_after_steps=0.0),
    "tasks": WorkModel(tasks, due_after_steps=1.0),
}
"""Models of work by the names that ``workload.model`` takes."""
NEGLIGIBLE_TASKS = 1e-9
"""Amount of work that rounding may leave of a step whose work was taken out in parts; it has no
age."""
UNLIMITED_TASKS = 1e30
"""Limit in tasks that stands for no limit of a queue."""


def age_histogram(queue: F64, edges_steps: F64) -> F64:
    """Queued tasks by age, (B, number of edges).

    Args:
        queue: work still queued by the step that put it in, (B, L).
        edges_steps: lower edges of the age bins in steps, rising from 0; the last bin is open.
    """
    last = queue.shape[1] - 1
    edges = np.asarray(edges_steps).astype(np.int64)
    tasks: F64 = queue.T[np.maximum(last - edges, 0)]
    tasks[:-1] -= tasks[1:]
    return tasks.T
