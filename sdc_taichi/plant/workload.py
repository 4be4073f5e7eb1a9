"""Delay-tolerant work: defer, drain, deadlines and ages in a first-in-first-out queue.

The queue is one array per data center: entry k is the work still queued that was put in by the end
of step k, oldest step first. It never decreases along k, so length, due part and age histogram are
read off it or are differences of two entries.
Work is counted in tasks: 1 task is 1 % of the data center's capacity for one step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

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
    oldest_age_steps: F64
    mean_age_steps: F64
    queue: F64
    """Work still queued by the step that put it in, (B, L)."""


WorkModel = Callable[..., Work]


def fluid(
    demand: F64,
    command: F64,
    queue: F64,
    *,
    flexible_share: F64,
    max_utilisation: F64,
    queue_limit: F64,
    deadline_steps: F64,
) -> Work:
    """Divisible work, conserved exactly: arrived = executed + queued + dropped.

    Deferring queues ``-command`` of the flexible share, draining takes ``command`` of what fits
    (paper, A.1.3). Work beyond the capacity of the step queues too. Work whose deadline has come
    runs first, as far as capacity allows; what does not fit into the queue is dropped.

    Args:
        demand: arriving work as a share of capacity, (B,).
        command: -1 defer all flexible work .. 0 .. 1 drain all that fits, (B,).
        queue: work still queued by the step that put it in, oldest first, (B, L).
        flexible_share: share of the demand that may wait, (B,).
        max_utilisation: capacity limit, (B,).
        queue_limit: longest queue in tasks, inf for none, (B,).
        deadline_steps: age at which work is due, inf for none, (B,).
    """
    arrived = demand * TASKS_PER_STEP
    capacity = max_utilisation * TASKS_PER_STEP
    waiting = queue[:, -1]
    due = _older_than(queue, deadline_steps)
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
        *_queue_after(queue, forced + drained, deferred),
    )


def tasks(
    demand: F64,
    command: F64,
    queue: F64,
    *,
    flexible_share: F64,
    max_utilisation: F64,
    queue_limit: F64,
    deadline_steps: F64,
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
    waiting = queue[:, -1]
    due = _older_than(queue, deadline_steps + 1.0)
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
        *_queue_after(queue, forced + drained, deferred),
    )


MODELS: dict[str, WorkModel] = {"fluid": fluid, "tasks": tasks}


def age_histogram(queue: F64, edges_steps: F64) -> F64:
    """Queued tasks by age, (B, number of edges).

    Args:
        queue: work still queued by the step that put it in, (B, L).
        edges_steps: lower edges of the age bins in steps, rising from 0; the last bin is open.
    """
    last = queue.shape[1] - 1
    at_least = queue[:, np.clip(last - np.asarray(edges_steps).astype(np.int64), 0, last)]
    return at_least - np.append(at_least[:, 1:], np.zeros((len(queue), 1)), axis=1)


_NEGLIGIBLE_TASKS = 1e-9
"""Left by rounding where a step's work was taken out in parts; no age is read off it."""


def _older_than(queue: F64, steps: F64) -> F64:
    """Queued work that has waited ``steps`` or more when the coming step starts, (B,)."""
    length = queue.shape[1]
    position = length - np.minimum(steps, length + 1.0).astype(np.int64)
    due = queue[np.arange(len(queue)), np.maximum(position, 0)]
    return np.where(position < 0, 0.0, due)


def _queue_after(queue: F64, taken: F64, deferred: F64) -> tuple[F64, F64, F64]:
    """Oldest age and mean age in steps, (B,), and the queue, (B, L), at the end of the step."""
    after = np.empty_like(queue)
    older = after[:, :-1]
    np.maximum(np.subtract(queue[:, 1:], taken[:, None], out=older), 0.0, out=older)
    after[:, -1] = older[:, -1] + deferred
    # Work of the newest step has age 0; each older task is counted once per step it has waited.
    aged = older > _NEGLIGIBLE_TASKS
    total = after[:, -1]
    waited = np.einsum("bl,bl->b", older, aged)
    mean = np.divide(waited, total, out=np.zeros_like(total), where=total > 0)
    return np.count_nonzero(aged, axis=1).astype(np.float64), mean, after
