"""Whole steps of delay-tolerant work, for tests: a model's decision and the queue after it."""

from __future__ import annotations

from types import SimpleNamespace

from model_steps import work_done
from sdc_taichi.plant import workload
from sdc_taichi.sim.workload import Queue
from sdc_taichi.types import F64


def work_step(
    model: str, demand: F64, command: F64, queue: F64, *, deadline_steps: F64, **limits: F64
) -> SimpleNamespace:
    """Fields of ``Work``, ages in steps, and the queue at the end of a step."""
    late = workload.MODELS[model].due_after_steps
    queues = Queue(queue.shape[1], deadline_steps + late)
    work = work_done(model, demand, command, *queues.begin_step(queue), **limits)
    after = queues.end_step(queue, work.dequeued_tasks, work.deferred_tasks)
    return SimpleNamespace(
        **vars(work),
        oldest_age_steps=after.oldest_age_steps,
        mean_age_steps=after.mean_age_steps,
        queue=after.queue,
    )
