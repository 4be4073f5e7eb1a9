"""Queues of work on the compiled kernel: rows, batches, interrupted steps."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from sdc_taichi.kernels.compiler.launch import BoundKernel
from sdc_taichi.kernels.queue import SERIAL_UP_TO
from sdc_taichi.sim.workload import Queue, QueueState
from sdc_taichi.types import F64


def test_rows_that_hold_nothing_are_told_from_those_that_do() -> None:
    """Queues that fill up and are emptied again and again, and others in between."""
    rng = np.random.default_rng(9)
    size, length = 21, 12
    queues = Queue(length, np.full(size, 5.0))

    def some_queue() -> F64:
        amounts = rng.uniform(0.0, 9.0, (size, length)) * (rng.random((size, length)) < 0.3)
        return np.cumsum(amounts, axis=1)

    queue = some_queue()
    for step in range(120):
        if step % 30 == 29:
            queue = some_queue()
        share = np.where(rng.random(size) < 0.4, 1.0, rng.choice([0.0, 0.5], size))
        dequeued, deferred = share * queue[:, -1], rng.uniform(0.0, 9.0, size) * (step % 7 < 4)
        before = np.maximum(queue[:, 1:] - dequeued[:, None], 0.0)
        expected = np.column_stack([before, before[:, -1] + deferred])
        queue = queues.end_step(queue, dequeued, deferred).queue
        assert np.array_equal(queue, expected), step


def test_many_queues_are_each_as_alone() -> None:
    rng = np.random.default_rng(4)
    size, length = 2 * SERIAL_UP_TO + 1, 9
    due_steps = rng.choice([0.0, 3.0, 8.0, np.inf], size)
    entered = np.sort(
        rng.uniform(0.0, 50.0, (size, length)) * rng.integers(0, 2, (size, 1)), axis=1
    )
    dequeued, deferred = entered[:, -1] * rng.uniform(0.0, 1.0, size), rng.uniform(0.0, 9.0, size)
    some = [0, 7, 8, SERIAL_UP_TO, size - 1]
    all_of, few = Queue(length, due_steps), Queue(length, due_steps[some])
    left = all_of.end_step(entered.copy(), dequeued, deferred)
    own = few.end_step(entered[some], dequeued[some], deferred[some])
    for f in fields(QueueState):
        assert np.array_equal(getattr(left, f.name)[some], getattr(own, f.name)), f.name
    before = np.maximum(entered[:, 1:] - dequeued[:, None], 0.0)
    assert np.array_equal(left.queue[:, :-1], before)
    assert np.array_equal(left.waiting_tasks, before[:, -1] + deferred)


def test_a_step_that_is_interrupted_can_be_done_again(monkeypatch: pytest.MonkeyPatch) -> None:
    queues = Queue(6, np.full(1, np.inf))
    queue = np.array([[0.0, 0.0, 1.0, 2.0, 3.0, 4.0]])
    nothing, everything = np.zeros(1), np.full(1, 4.0)
    queue = queues.end_step(queue, nothing, nothing).queue
    run = BoundKernel.__call__

    def interrupted(*given: Any) -> None:
        run(*given)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(BoundKernel, "__call__", interrupted)
        with pytest.raises(KeyboardInterrupt):
            queues.end_step(queue, everything, nothing)
    after = queues.end_step(queue, nothing, nothing).queue
    assert np.array_equal(after, [[1.0, 2.0, 3.0, 4.0, 4.0, 4.0]])
