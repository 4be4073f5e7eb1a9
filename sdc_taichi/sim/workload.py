"""Delay-tolerant work of a step: started, queued, due and dropped work, and the queues.

The queue of a data center is a cumulative sum by arrival step, oldest step first: entry k is the
queued work that arrived up to the k-th step. The last entry is the length of the queue, one entry
is the due work, and differences of entries give the ages. Work is counted in tasks: 1 task is 1 %
of the data center's capacity during one step. The models of ``plant.workload`` decide which work
enters and leaves the queue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.compiler.arrays import unpadded, vector_rows
from sdc_taichi.plant import workload
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I32, QueueQuantities, TransferQuantities, Work, fields_of

if TYPE_CHECKING:
    from sdc_taichi.kernels.compiler.launch import BoundKernel


@dataclass(frozen=True, slots=True)
class QueueState:
    """The queues of a fleet at the end of a step."""

    queue: F64
    """Cumulative sum of the queued tasks by arrival step, oldest step first, (B, L)."""
    waiting_tasks: F64
    """Queued work, in tasks, (B,)."""
    due_tasks: F64
    """Queued work that is due at the start of the next step, in tasks, (B,)."""
    oldest_age_steps: F64
    """Age of the oldest queued work, in steps, (B,)."""
    mean_age_steps: F64
    """Mean age of the queued work, in steps, (B,)."""


def due_entries(length: int, due_steps: F64) -> I32:
    """Return the index of each queue's entry that equals the due work at the start of a step, (B,).

    If work is never due, the index is ``length``, one beyond the last entry.

    Args:
        length: Number L of arrival steps that a queue distinguishes.
        due_steps: Age at which work is due, in steps, inf for never, (B,).
    """
    due_at = length - np.minimum(due_steps, length + 1.0).astype(np.int64)
    return np.where(due_at < 0, length, due_at).astype(np.int32)


def due_work(queue: F64, entries: I32) -> F64:
    """Return the work that is due at the start of a step, in tasks, (B,).

    Args:
        queue: Cumulative sum of the queued tasks by arrival step, oldest step first, (B, L).
        entries: Return value of ``due_entries``, (B,).
    """
    never = np.zeros((1, len(entries)))
    return np.asarray(np.concatenate([queue.T, never])[entries, np.arange(len(entries))])


class Queue:
    """Updates the queues of a fleet with a kernel.

    Args:
        length: Number L of arrival steps that a queue distinguishes.
        due_steps: Age at which work is due, in steps, inf for never, (B,).
        delay_steps: Age of the work that enters as ``landed``, in steps; 0 if there is none.
    """

    def __init__(self, length: int, due_steps: F64, delay_steps: int = 0) -> None:
        self._size, self._length, self._delay = len(due_steps), length, delay_steps
        self._due_row = due_entries(length, due_steps)
        self._kernel: BoundKernel | None = None
        self._rows: Any = None
        """Queue at the end of the last step, as ``vector_rows`` for the kernel."""
        self._last: F64 | None = None
        """View of ``_rows`` with shape (B, L), as returned to callers."""
        self._begin = (np.zeros(0), np.zeros(0))
        """Queued work and due work of the queue ``_last``, in tasks, (B,) each."""

    def begin_step(self, queue: F64) -> tuple[F64, F64]:
        """Return queued work and due work at the start of a step, in tasks, (B,) each.

        Args:
            queue: Cumulative sum of the queued tasks by arrival step, oldest step first, (B, L).
                It becomes read-only, because the stored sums would not follow a change.
        """
        if queue is not self._last:
            due = due_work(queue, self._due_row)
            self._load(queue)
            self._begin = queue[:, -1].copy(), due
        return self._begin

    def end_step(
        self, queue: F64, dequeued: F64, deferred: F64, landed: F64 | None = None
    ) -> QueueState:
        """Update the queues and return them at the end of a step.

        Args:
            queue: Queues at the start of the step, (B, L); they become read-only.
            dequeued: Work that leaves each queue, oldest first, in tasks, (B,).
            deferred: Work that enters each queue, in tasks, (B,).
            landed: Work that enters each queue with the age ``delay_steps``, in tasks, (B,); None
                if there is none.
        """
        if queue is not self._last:
            self._load(queue)
        assert self._kernel is not None
        self._dequeued[:], self._deferred[:] = dequeued, deferred
        if self._delay:
            self._landed[:] = 0.0 if landed is None else landed
        # Invalid until the kernel has finished, in case the step is interrupted.
        self._last = None
        after = vector_rows(self._length, self._size)
        self._kernel(
            self._serial,
            self._delay,
            1,
            NEGLIGIBLE_TASKS,
            self._due_lanes,
            self._empty,
            self._rows,
            self._moved,
            after,
            self._results,
        )
        waiting, due, oldest_steps, mean_steps = self._statistics.copy()
        self._rows, self._last = after, unpadded(after, self._size).T
        # A second copy, because callers can modify the returned arrays.
        self._begin = self._statistics[0].copy(), self._statistics[1].copy()
        self._last.flags.writeable = False
        return QueueState(self._last, waiting, due, oldest_steps, mean_steps)

    def release(self) -> None:
        """Release the kernel and its arrays."""
        self._kernel = self._rows = self._last = None

    def _compile(self) -> None:
        """Create the kernel and the arrays that it uses in every step."""
        from sdc_taichi.kernels.compiler.launch import BoundKernel
        from sdc_taichi.kernels.queue import SERIAL_UP_TO, queue_kernel

        runtime.ensure_started()
        self._kernel = BoundKernel(queue_kernel(), templates=2)
        self._serial = self._size <= SERIAL_UP_TO
        # These arrays are bound once: passing a new array costs more than copying a few entries.
        self._moved, self._results = (vector_rows(n, self._size) for n in (3, 4))
        self._moved[:] = 0.0
        self._dequeued, self._deferred, self._landed = unpadded(self._moved, self._size)
        self._statistics = unpadded(self._results, self._size)
        self._due_lanes = np.full(self._moved.shape[1:], self._length, np.int32)
        self._due_lanes.reshape(-1)[: self._size] = self._due_row
        self._empty = np.zeros(self._moved.shape[1], np.int32)
        """Number of leading rows without work in each vector, which the kernel updates."""

    def _load(self, queue: F64) -> None:
        """Copy in a queue that is not the result of the last step, such as that of a snapshot."""
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
    """Work of one step of B data centers, and the queues at its end."""

    queue: F64
    """Cumulative sum of the queued tasks by arrival step, oldest step first, (B, L)."""


def queue_limit_tasks(fleet: Fleet) -> F64:
    """Return the maximum queue of each data center, in tasks, (B,); ``UNLIMITED_TASKS`` if none."""
    limit_h = fleet.values("workload.queue_limit_h")
    limit_tasks = limit_h * (workload.TASKS_PER_STEP * fleet.steps_per_hour)
    return np.where(np.isnan(limit_h), workload.UNLIMITED_TASKS, limit_tasks)


def due_steps(fleet: Fleet) -> F64:
    """Return the age at which queued work is due, in steps, inf for never, (B,)."""
    deadline_h = fleet.values("workload.deadline_h")
    deadline_steps = np.rint(deadline_h * fleet.steps_per_hour)
    deadline_steps = np.where(np.isnan(deadline_h), np.inf, deadline_steps)
    return deadline_steps + workload.MODELS[fleet.models["workload"]].due_after_steps


def queue_length(fleet: Fleet) -> int:
    """Return the number L of arrival steps that the queues of a fleet distinguish.

    There are two entries more than steps in the longest age horizon: one for the work that arrives,
    and one for all older work together.
    """
    horizon_steps = np.rint(fleet.values("workload.age_horizon_h") * fleet.steps_per_hour)
    return int(np.max(horizon_steps)) + 2


class Workload:
    """Runs the workload model of a fleet and updates its queues."""

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
        self._length, self._queue_limit = queue_length(fleet), limits["queue_limit"]
        shared = fleet.shared_work
        self._flexible_share = None if shared is None else limits["flexible_share"]
        delay_steps = 0 if shared is None else shared.delay_steps
        self._queue = Queue(self._length, due_steps(fleet), delay_steps)

    def empty_queue(self) -> F64:
        """Return empty queues, (B, L)."""
        return np.zeros((self._size, self._length))

    def run(
        self,
        queue: F64,
        demand: F64,
        load_command: F64,
        max_utilisation: F64 | float,
        transfer: TransferQuantities | None = None,
    ) -> WorkResult:
        """Run the workload model for a step and update the queues.

        Args:
            queue: Queues at the start of the step, (B, L); they become read-only.
            demand: Arriving work as a share of capacity, 0..1, (B,).
            load_command: Share to defer (below 0) or drain (above 0), -1..1, (B,).
            max_utilisation: Maximum work that the racks can run, as a share of all servers, (B,)
                or one value for all.
            transfer: Work that the sites of a fleet send and get in the step; None or that of data
                centers alone moves nothing.
        """
        waiting, due = self._queue.begin_step(queue)
        point = {
            "demand": demand,
            "command": load_command,
            "waiting": waiting,
            "due": due,
            "max_utilisation": np.minimum(self._max_utilisation, max_utilisation),
        }
        if self._flexible_share is None or transfer is None:
            decided = self._decide(**point)
            after = self._queue.end_step(
                queue, decided["dequeued_tasks"], decided["deferred_tasks"]
            )
        else:
            decided = self._decide(**point, sent=transfer.sent_tasks, landed=transfer.landed_tasks)
            # The youngest flexible work waits first, that of other sites after it.
            own = self._flexible_share * decided["arrived_tasks"] - transfer.sent_tasks
            deferred = decided["deferred_tasks"]
            landed = np.clip(deferred - np.maximum(own, 0.0), 0.0, transfer.landed_tasks)
            after = self._queue.end_step(
                queue, decided["dequeued_tasks"], deferred - landed, landed
            )
        return WorkResult(
            **decided,
            queue=after.queue,
            queue_tasks=after.waiting_tasks,
            oldest_age_h=after.oldest_age_steps * self._step_h,
            mean_age_h=after.mean_age_steps * self._step_h,
        )

    def put_back(self, work: WorkResult, tasks: F64) -> tuple[WorkResult, F64]:
        """Put started work back into the queues, as work that arrived in this step.

        Args:
            work: Work of the step.
            tasks: Work to put back, in tasks, (B,).

        Returns:
            Work of the step with the queues after that, and work that finds no room, in tasks,
            (B,).
        """
        if not tasks.any():
            return work, tasks
        room = np.maximum(self._queue_limit - work.queue_tasks, 0.0)
        back = np.minimum(tasks, room)
        if not back.any():
            return work, tasks - back
        queue, waiting = work.queue.copy(), work.queue_tasks + back
        queue[:, -1] += back
        some = np.where(waiting > 0.0, waiting, 1.0)
        after = replace(
            work,
            queue=queue,
            queue_tasks=waiting,
            mean_age_h=work.mean_age_h * (work.queue_tasks / some),
        )
        return after, tasks - back

    def close(self) -> None:
        """Release the kernel arrays."""
        self._queue.release()
