"""Delay-tolerant work of a step: what runs, waits, is due or dropped, and the queue after it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.plant import workload
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.queue import Queue
from sdc_taichi.types import F64, QueueQuantities, Work, fields_of


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
    return deadline_steps + workload.DUE_AFTER_STEPS[fleet.models["workload"]]


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
        self._decide = CompiledStage(lambda **x: fields_of(model(**x, **limits)), fleet.size)
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
