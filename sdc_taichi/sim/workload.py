"""Delay-tolerant work of a step: what runs, waits, is due or dropped, and the queues after it.

A queue is one row per data center: entry k is the work still queued that was put in by the end of
step k, oldest step first. It never decreases along k, so length, due part and age histogram are
read off it or are differences of two entries. Work is counted in tasks: 1 task is 1 % of the data
center's capacity for one step. The models of ``plant.workload`` decide what enters and leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.compiler.arrays import unpadded, vector_rows
from sdc_taichi.plant import workload
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I32, QueueQuantities, Work, fields_of

if TYPE_CHECKING:
    from sdc_taichi.kernels.compiler.launch import BoundKernel


@dataclass(frozen=True, slots=True)
class QueueState:
    """The queues of a fleet at the end of a step."""

    queue: F64
    """Work still queued by the step that put it in, oldest first, accumulated, in tasks, (B, L)."""
    waiting_tasks: F64
    """Work that waits, in tasks, (B,)."""
    due_tasks: F64
    """Work that waits and is due when the next step begins, in tasks, (B,)."""
    oldest_age_steps: F64
    """Age of the oldest work that waits, in steps, (B,)."""
    mean_age_steps: F64
    """Mean age of the work that waits, in steps, (B,)."""


def due_entries(length: int, due_steps: F64) -> I32:
    """Entry of each queue that holds the work that is due when a step begins, (B,).

    It is ``length``, beyond the last entry, where work is never due.

    Args:
        length: steps that a queue tells apart, L.
        due_steps: age at which work is due, in steps, inf for never, (B,).
    """
    due_at = length - np.minimum(due_steps, length + 1.0).astype(np.int64)
    return np.where(due_at < 0, length, due_at).astype(np.int32)


def due_work(queue: F64, entries: I32) -> F64:
    """Work that is due when a step begins, in tasks, (B,).

    Args:
        queue: work still queued by the step that put it in, oldest first, (B, L).
        entries: what ``due_entries`` returned, (B,).
    """
    never = np.zeros((1, len(entries)))
    return np.asarray(np.concatenate([queue.T, never])[entries, np.arange(len(entries))])


class Queue:
    """The queues of a fleet.

    Args:
        length: steps that a queue tells apart, L.
        due_steps: age at which work is due, in steps, inf for never, (B,).
    """

    def __init__(self, length: int, due_steps: F64) -> None:
        self._size, self._length = len(due_steps), length
        self._due_row = due_entries(length, due_steps)
        self._kernel: BoundKernel | None = None
        self._rows: Any = None
        """The queue that the last step left, as ``vector_rows``."""
        self._last: F64 | None = None
        """That queue as others see it, (B, L)."""
        self._begin = (np.zeros(0), np.zeros(0))
        """Work that waits and work that is due in the queue ``_last``, in tasks, each (B,)."""

    def begin_step(self, queue: F64) -> tuple[F64, F64]:
        """Work that waits when a step begins, and what of it is due, in tasks, each (B,).

        Args:
            queue: work still queued by the step that put it in, oldest first, (B, L). It is made
                read-only, since what is known of it would not follow a change.
        """
        if queue is not self._last:
            due = due_work(queue, self._due_row)
            self._load(queue)
            self._begin = queue[:, -1].copy(), due
        return self._begin

    def end_step(self, queue: F64, dequeued: F64, deferred: F64) -> QueueState:
        """The queues at the end of a step.

        Args:
            queue: at its beginning, (B, L); read-only from here on.
            dequeued: work that leaves it, oldest first, in tasks, (B,).
            deferred: work that enters it, in tasks, (B,).
        """
        if queue is not self._last:
            self._load(queue)
        assert self._kernel is not None
        self._dequeued[:], self._deferred[:] = dequeued, deferred
        # A step that is interrupted from here on leaves no queue.
        self._last = None
        after = vector_rows(self._length, self._size)
        self._kernel(
            self._serial,
            1,
            NEGLIGIBLE_TASKS,
            self._due_lanes,
            self._empty,
            self._rows,
            self._moved,
            after,
            self._results,
        )
        waiting, due, oldest_steps, mean_steps = self._found.copy()
        self._rows, self._last = after, unpadded(after, self._size).T
        # A copy, since callers may do what they like with results.
        self._begin = self._found[0].copy(), self._found[1].copy()
        self._last.flags.writeable = False
        return QueueState(self._last, waiting, due, oldest_steps, mean_steps)

    def release(self) -> None:
        """Drop the kernel and the arrays that it was last given."""
        self._kernel = self._rows = self._last = None

    def _compile(self) -> None:
        """Make the kernel, and the arrays that are the same in every step."""
        from sdc_taichi.kernels.compiler.launch import BoundKernel
        from sdc_taichi.kernels.queue import SERIAL_UP_TO, queue_kernel

        runtime.ensure_started()
        self._kernel = BoundKernel(queue_kernel(), templates=1)
        self._serial = self._size <= SERIAL_UP_TO
        # Handing an array over takes longer than to copy a few entries.
        self._moved, self._results = (vector_rows(n, self._size) for n in (2, 4))
        self._moved[:] = 0.0
        self._dequeued, self._deferred = unpadded(self._moved, self._size)
        self._found = unpadded(self._results, self._size)
        self._due_lanes = np.full(self._moved.shape[1:], self._length, np.int32)
        self._due_lanes.reshape(-1)[: self._size] = self._due_row
        self._empty = np.zeros(self._moved.shape[1], np.int32)
        """First rows of each vector that hold nothing, which the kernel keeps up to date."""

    def _load(self, queue: F64) -> None:
        """Go on from a queue that the last step did not leave."""
        if self._kernel is None:
            self._compile()
        self._last = None
        self._rows = vector_rows(self._length, self._size)
        self._rows[:] = 0.0
        unpadded(self._rows, self._size)[:] = queue.T
        self._empty[:] = 0
        queue.flags.writeable = False
        self._last = queue


@dataclass
class WorkResult(QueueQuantities, Work):
    """Work of one step of B data centers, and queues that tell L steps apart."""

    queue: F64
    """Work in the queue by the step that put it in, oldest first, accumulated, (B, L)."""


def queue_limit_tasks(fleet: Fleet) -> F64:
    """Longest queue of each data center, in tasks, (B,); ``UNLIMITED_TASKS`` without a limit."""
    limit_h = fleet.values("workload.queue_limit_h")
    limit_tasks = limit_h * (workload.TASKS_PER_STEP * fleet.steps_per_hour)
    return np.where(np.isnan(limit_h), workload.UNLIMITED_TASKS, limit_tasks)


def due_steps(fleet: Fleet) -> F64:
    """Age at which the work of each data center is due, in steps, inf for never, (B,)."""
    deadline_h = fleet.values("workload.deadline_h")
    deadline_steps = np.rint(deadline_h * fleet.steps_per_hour)
    deadline_steps = np.where(np.isnan(deadline_h), np.inf, deadline_steps)
    return deadline_steps + workload.MODELS[fleet.models["workload"]].due_after_steps


class Workload:
    """The workload model of a fleet and its queues.

    Args:
        fleet: B data centers.
    """

    def __init__(self, fleet: Fleet) -> None:
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        v, name = fleet.values, fleet.models["workload"]
        model, per_hour = workload.MODELS[name], fleet.steps_per_hour
        limits = {
            "flexible_share": v("workload.flexible_share"),
            "queue_limit": queue_limit_tasks(fleet),
        }
        self._size, self._step_h = fleet.size, 1.0 / per_hour
        self._decide = CompiledStage(
            lambda **x: fields_of(model.step(workload.WorkPoint(**x, **limits))), fleet.size
        )
        self._max_utilisation = v("workload.max_utilisation")
        # One step for work that enters, one for all that is older than the horizon.
        self._length = int(np.max(np.rint(v("workload.age_horizon_h") * per_hour))) + 2
        self._queue = Queue(self._length, due_steps(fleet))

    def empty_queue(self) -> F64:
        """Queues without work, (B, L)."""
        return np.zeros((self._size, self._length))

    def run(
        self, queue: F64, demand: F64, load_command: F64, max_utilisation: F64 | float
    ) -> WorkResult:
        """Decide what happens to the work of a step, and take it to and from the queues.

        Args:
            queue: Work in the queue by the step that put it in, (B, L); read-only from here on.
            demand: Work that arrives, as a share of capacity, 0..1, (B,).
            load_command: Share to defer (below 0) or drain (above 0), -1..1, (B,).
            max_utilisation: How much work the racks can take, as a share of all servers, (B,).
        """
        waiting, due = self._queue.begin_step(queue)
        decided = self._decide(
            demand=demand,
            command=load_command,
            waiting=waiting,
            due=due,
            max_utilisation=np.minimum(self._max_utilisation, max_utilisation),
        )
        after = self._queue.end_step(queue, decided["dequeued_tasks"], decided["deferred_tasks"])
        return WorkResult(
            **decided,
            queue=after.queue,
            queue_tasks=after.waiting_tasks,
            oldest_age_h=after.oldest_age_steps * self._step_h,
            mean_age_h=after.mean_age_steps * self._step_h,
        )

    def close(self) -> None:
        """Let go of the kernel arrays."""
        self._queue.release()
