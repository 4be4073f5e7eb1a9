"""Delay-tolerant work: defer, drain, deadlines and ages in a first-in-first-out queue.

Work is counted in tasks: 1 task is 1 % of the data center's capacity for one step. The models here
compute from the waiting work and the due work how much work runs, waits or is dropped;
``sim.workload`` stores the queues. A queue is one array per data center. Its entry k is the work
that entered the queue by the end of step k and is still queued, oldest step first. Since entries
never decrease along k, queue length, due work and age histogram are entries or differences of two
entries. B is the number of data centers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64, Values, Work

TASKS_PER_STEP = 100.0
"""Capacity of a data center in one step, in tasks."""
RELEASED_QUEUE_TASKS = 90.0
"""Work of a step up to which the released SustainDC starts queued work, in tasks."""


class WorkPoint(NamedTuple):
    """Work, command and limits of one step of B data centers."""

    demand: F64
    """Arriving work as a share of capacity, 0..1, (B,)."""
    command: F64
    """Command of the agent, (B,): -1 defers all flexible work, 0 leaves the queue unchanged, and 1
    runs as much queued work as capacity allows."""
    waiting: F64
    """Work in the queue, in tasks, (B,)."""
    due: F64
    """Part of the waiting work whose deadline has come, in tasks, (B,)."""
    flexible_share: Values
    """Share of the demand that may wait, 0..1, (B,)."""
    max_utilisation: Values
    """Highest utilisation, 0..1, (B,)."""
    queue_limit: Values
    """Longest queue, in tasks, (B,)."""
    sent: Values = 0.0
    """Flexible part of the arriving work that leaves for other sites, in tasks, (B,); only for
    ``fluid``."""
    landed: Values = 0.0
    """Flexible work of other sites that arrives, in tasks, (B,); only for ``fluid``."""


@dataclass(frozen=True, slots=True)
class WorkModel:
    """Model of delay-tolerant work."""

    step: Callable[[WorkPoint], Work]
    """Function that computes the work executed, deferred and dropped in one step."""
    due_after_steps: float
    """Number of steps after its deadline from which work counts as due."""


def fluid(point: WorkPoint) -> Work:
    """Step arbitrarily divisible work: arrived - sent + landed = executed + queued + dropped.

    A negative command defers the share ``-command`` of the flexible work. A positive command drains
    the queue with the share ``command`` of the free capacity (paper, A.1.3). Work beyond the
    capacity of the step is queued as well. Due work runs first, as far as capacity allows. Work
    that does not fit into the queue is dropped.
    """
    arrived = point.demand * TASKS_PER_STEP
    capacity = point.max_utilisation * TASKS_PER_STEP
    flexible = np.maximum(point.flexible_share * arrived - point.sent, 0.0) + point.landed
    at_site = arrived - point.sent + point.landed
    wanted = at_site - np.maximum(-point.command, 0.0) * flexible
    forced = np.minimum(point.due, capacity)
    now = np.minimum(wanted, capacity - forced)
    held_back = at_site - now
    deferred = np.minimum(held_back, _room(point.queue_limit, point.waiting - forced))
    drained = np.minimum(
        point.waiting - forced, np.maximum(point.command, 0.0) * (capacity - now - forced)
    )
    started = now + forced + drained
    return _work(point, arrived, started, forced, deferred, held_back - deferred, drained)


def tasks(point: WorkPoint) -> Work:
    """Step whole tasks, with arrived = executed + queued + dropped.

    Fixed work is rounded up and flexible work down, so a step may execute one task more than
    arrived. The rules are those of ``fluid``, with one exception: a drain runs at most as many
    queued tasks as flexible tasks arrived in the step, as in the released SustainDC.
    """
    arrived, flexible = arriving_tasks(point.demand, point.flexible_share)
    capacity = np.floor(point.max_utilisation * TASKS_PER_STEP)
    forced = np.minimum(point.due, capacity)
    now = np.minimum(arrived - _deferred_by_command(point, flexible), capacity - forced)
    held_back = arrived - now
    deferred = np.minimum(held_back, np.floor(_room(point.queue_limit, point.waiting - forced)))
    drained = _drained(point, flexible, forced, capacity - now - forced)
    started = now + forced + drained
    return _work(point, arrived, started, forced, deferred, held_back - deferred, drained)


def released(point: WorkPoint) -> Work:
    """Step whole tasks as the released SustainDC counts them: arrived = executed + queued.

    In contrast to ``tasks``, arriving work runs before due work, and queued work runs only up to
    ``RELEASED_QUEUE_TASKS``. Tasks that a command holds back and for which the queue has no room
    run too; they count both as dropped and as started. ``max_utilisation``, 1 in the released
    code, limits all work: arriving tasks above it are queued, and dropped if the queue is full.
    """
    arrived, flexible = arriving_tasks(point.demand, point.flexible_share)
    capacity = np.floor(point.max_utilisation * TASKS_PER_STEP)
    most_queued = np.minimum(capacity, RELEASED_QUEUE_TASKS)
    forced = np.minimum(point.due, np.maximum(most_queued - arrived, 0.0))
    wanted = np.minimum(arrived - _deferred_by_command(point, flexible), capacity - forced)
    held_back = arrived - wanted
    deferred = np.minimum(held_back, np.floor(_room(point.queue_limit, point.waiting - forced)))
    now = np.minimum(arrived - deferred, capacity - forced)
    free = np.maximum(most_queued - now - forced, 0.0)
    drained = _drained(point, flexible, forced, free)
    started = now + forced + drained
    return _work(point, arrived, started, forced, deferred, held_back - deferred, drained)


def arriving_tasks(demand: Values, flexible_share: Values) -> tuple[F64, F64]:
    """Return all work and the flexible work that arrive in a step, in whole tasks, (B,) each."""
    fixed = np.ceil(demand * (1.0 - flexible_share) * TASKS_PER_STEP)
    flexible = np.floor(demand * flexible_share * TASKS_PER_STEP)
    return fixed + flexible, flexible


def _deferred_by_command(point: WorkPoint, flexible: F64) -> F64:
    """Return the flexible tasks that a negative command holds back, (B,)."""
    deferred: F64 = np.floor(np.maximum(-point.command, 0.0) * flexible)
    return deferred


def _drained(point: WorkPoint, flexible: F64, forced: F64, free: F64) -> F64:
    """Return the queued tasks that a positive command runs within the free capacity, (B,)."""
    drainable = np.minimum(np.minimum(point.waiting - forced, flexible), free)
    drained: F64 = np.floor(np.maximum(point.command, 0.0) * drainable)
    return drained


def _work(
    point: WorkPoint,
    arrived: F64,
    started: F64,
    forced: F64,
    deferred: F64,
    dropped: F64,
    drained: F64,
) -> Work:
    """Build the result of a step from amounts in tasks.

    Of the queued work that runs, ``forced`` is the due part and ``drained`` the rest.
    """
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
    """Return the free room in the queue, in tasks, (B,)."""
    # Rounding errors may leave slightly more work in a full queue than its limit.
    return np.maximum(queue_limit - waiting, 0.0)


MODELS: dict[str, WorkModel] = {
    "fluid": WorkModel(fluid, due_after_steps=0.0),
    "tasks": WorkModel(tasks, due_after_steps=1.0),
    "released": WorkModel(released, due_after_steps=1.0),
}
"""Work models by their names, the valid values of ``workload.model``."""
NEGLIGIBLE_TASKS = 1e-9
"""Largest rest of a step's queued work, in tasks, that counts as a rounding error. Such a rest is
ignored when the age of queued work is computed."""
UNLIMITED_TASKS = 1e30
"""Queue limit, in tasks, that stands for an unlimited queue."""


def age_histogram(queue: F64, edges_steps: F64) -> F64:
    """Return the number of queued tasks in each age bin, (B, number of edges).

    Args:
        queue: Cumulative queued work by step of arrival, oldest step first, (B, L) for L steps.
        edges_steps: Lower edges of the age bins in steps, ascending from 0; the last bin is open.
    """
    last = queue.shape[1] - 1
    edges = np.asarray(edges_steps).astype(np.int64)
    tasks: F64 = queue.T[np.maximum(last - edges, 0)]
    tasks[:-1] -= tasks[1:]
    return tasks.T
