"""Delay-tolerant work: conservation, deadlines and ages against a queue of single batches."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, fields
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_steps import work_done
from sdc_taichi import Actions, LoadAction, Simulator, drivers_from_arrays, load_config
from sdc_taichi.plant.workload import MODELS, TASKS_PER_STEP, age_histogram
from sdc_taichi.types import F64
from work_steps import work_step

LENGTH = 40
"""Steps of age the queue arrays tell apart, more than any run here lasts."""

STEPS = st.lists(
    st.tuples(st.floats(0, 1), st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1))),
    min_size=10,
    max_size=36,
)


@dataclass(frozen=True)
class Limits:
    """Parameters of one data center."""

    flexible_share: float
    max_utilisation: float
    queue_limit: float
    deadline_steps: float

    def arrays(self) -> dict[str, F64]:
        return {f.name: np.array([getattr(self, f.name)]) for f in fields(self)}


LIMITS = st.builds(
    Limits,
    flexible_share=st.floats(0, 1),
    max_utilisation=st.sampled_from([0.3, 0.7, 0.9, 1.0]),
    queue_limit=st.sampled_from([40.0, 130.0, 1000.0, math.inf]),
    deadline_steps=st.sampled_from([1.0, 3.0, 8.0, math.inf]),
)


@dataclass
class Batch:
    step: int
    amount: float


@dataclass
class Line:
    """A first-in-first-out line of batches, each with the step that put it in."""

    batches: deque[Batch] = field(default_factory=deque)

    @property
    def length(self) -> float:
        return math.fsum(b.amount for b in self.batches)

    def waited(self, steps: float, now: int) -> float:
        """Work that has waited ``steps`` or more at step ``now``."""
        return math.fsum(b.amount for b in self.batches if now - b.step >= steps)

    def take(self, amount: float) -> None:
        while amount > 1e-12 and self.batches:
            taken = min(amount, self.batches[0].amount)
            self.batches[0].amount -= taken
            amount -= taken
            if self.batches[0].amount <= 1e-12:
                self.batches.popleft()

    def ages(self, now: int) -> list[tuple[int, float]]:
        return [(now - b.step, b.amount) for b in self.batches if b.amount > 1e-9]


def expected_step(
    model: str, line: Line, now: int, demand: float, command: float, limits: Limits
) -> dict[str, float]:
    """One step of the line, in words of the model's description."""
    capacity = limits.max_utilisation * 100.0
    defer, drain = max(-command, 0.0), max(command, 0.0)
    if model == "fluid":
        arrived = 100.0 * demand
        flexible = limits.flexible_share * arrived
        due = line.waited(limits.deadline_steps, now)
        forced = min(due, capacity)
        at_once = min(arrived - defer * flexible, capacity - forced)
        held_back = arrived - at_once
    else:
        capacity = math.floor(capacity)
        fixed = math.ceil(demand * (1.0 - limits.flexible_share) * 100.0)
        flexible = math.floor(demand * limits.flexible_share * 100.0)
        arrived = fixed + flexible
        due = line.waited(limits.deadline_steps + 1.0, now)
        for_queued = min(capacity, 90.0) - arrived if model == "released" else capacity
        forced = min(due, max(for_queued, 0.0))
        at_once = min(arrived - math.floor(defer * flexible), capacity - forced)
        held_back = arrived - at_once
    line.take(forced)
    deferred = min(held_back, limits.queue_limit - line.length)
    dropped = held_back - deferred
    if model == "fluid":
        drained = min(line.length, drain * (capacity - at_once - forced))
    elif model == "tasks":
        free = capacity - at_once - forced
        drained = math.floor(drain * min(line.length, flexible, free))
    else:
        # Tasks for which the queue has no room run after all, within the limit.
        at_once = min(arrived - deferred, capacity - forced)
        free = max(min(capacity, 90.0) - at_once - forced, 0.0)
        drained = math.floor(drain * min(line.length, flexible, free))
    executed = at_once + forced + drained
    line.take(drained)
    if deferred > 0:
        line.batches.append(Batch(now, deferred))
    ages = line.ages(now)
    total = math.fsum(amount for _, amount in ages)
    return {
        "utilisation": executed / 100.0,
        "arrived_tasks": arrived,
        "started_tasks": executed,
        "deferred_tasks": deferred,
        "drained_tasks": drained,
        "due_tasks": due,
        "overdue_tasks": due - forced,
        "dropped_tasks": dropped,
        "oldest_age_steps": max((age for age, _ in ages), default=0),
        "mean_age_steps": math.fsum(a * n for a, n in ages) / total if total else 0.0,
    }


def one_step(
    model: str, queue: F64, demand: float, command: float, limits: Limits
) -> SimpleNamespace:
    return work_step(model, np.array([demand]), np.array([command]), queue, **limits.arrays())


def whole(steps: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Commands as agents give them: whole tasks depend on the last bit of a share of them."""
    return [(demand, float(np.sign(command))) for demand, command in steps]


@pytest.mark.parametrize("model", MODELS)
@settings(max_examples=60)
@given(steps=STEPS, limits=LIMITS)
def test_every_step_equals_a_line_of_batches(
    model: str, steps: list[tuple[float, float]], limits: Limits
) -> None:
    queue, line = np.zeros((1, LENGTH)), Line()
    for now, (demand, command) in enumerate(steps if model == "fluid" else whole(steps)):
        work = one_step(model, queue, demand, command, limits)
        queue = work.queue
        expected = expected_step(model, line, now, demand, command, limits)
        for name, value in expected.items():
            tolerance = 0.0 if model != "fluid" and name not in ("mean_age_steps",) else 1e-8
            if name == "oldest_age_steps" and model == "fluid":
                continue  # what rounding leaves of a batch is compared below
            found = float(getattr(work, name)[0])
            assert abs(found - value) <= tolerance + 1e-12 * abs(value), (now, name, found, value)
        if model == "fluid":
            old = line.waited(work.oldest_age_steps[0] + 1.0, now)
            assert old <= 1e-8, "older work than reported"
            assert line.waited(work.oldest_age_steps[0], now) >= min(1e-9, line.length) - 1e-10
        edges = np.array([0.0, 1.0, 3.0, 10.0, 20.0])
        bins = [
            math.fsum(n for a, n in line.ages(now) if low <= a < high)
            for low, high in zip(edges, [*edges[1:], math.inf], strict=True)
        ]
        np.testing.assert_allclose(age_histogram(queue, edges)[0], bins, rtol=0, atol=1e-7)


@settings(max_examples=60)
@given(steps=STEPS, limits=LIMITS)
def test_fluid_work_is_conserved_and_within_its_limits(
    steps: list[tuple[float, float]], limits: Limits
) -> None:
    queue = np.zeros((1, LENGTH))
    arrived = executed = dropped = 0.0
    capacity = TASKS_PER_STEP * limits.max_utilisation
    for demand, command in steps:
        before = queue[0, -1]
        work = one_step("fluid", queue, demand, command, limits)
        queue = work.queue
        a, e, d = (
            float(x[0]) for x in (work.arrived_tasks, work.started_tasks, work.dropped_tasks)
        )
        assert a == pytest.approx(e + queue[0, -1] - before + d, abs=1e-10)
        assert min(e, d, queue[0, -1], float(work.deferred_tasks[0])) >= 0.0
        assert e <= capacity * (1 + 1e-12)
        assert queue[0, -1] <= limits.queue_limit * (1 + 1e-12)
        assert np.all(np.diff(queue[0]) >= 0.0)
        if d > 1e-9:
            assert queue[0, -1] == pytest.approx(limits.queue_limit), "dropped before it was full"
        if work.overdue_tasks[0] > 1e-9:
            assert e == pytest.approx(capacity), "overdue with capacity to spare"
        elif work.due_tasks[0] == 0 and command == 0 and a <= capacity:
            assert e == a, "neutral runs what arrives"
        if command == 1:
            assert e == pytest.approx(min(a + before, capacity), abs=1e-9), "drain runs all it can"
        arrived, executed, dropped = arrived + a, executed + e, dropped + d
    assert arrived == pytest.approx(executed + queue[0, -1] + dropped, abs=1e-9)


@pytest.mark.parametrize("model", ["tasks", "released"])
@settings(max_examples=60)
@given(steps=STEPS, limits=LIMITS)
def test_whole_tasks_stay_whole_within_their_limits_and_are_conserved(
    model: str, steps: list[tuple[float, float]], limits: Limits
) -> None:
    queue = np.zeros((1, LENGTH))
    cap = math.floor(limits.max_utilisation * 100.0)
    for demand, command in steps:
        before = queue[0, -1]
        work = one_step(model, queue, demand, command, limits)
        queue = work.queue
        for name, values in vars(work).items():
            if name not in ("utilisation", "mean_age_steps"):
                assert np.array_equal(values, np.rint(values)), name
        arrived, started = work.arrived_tasks[0], work.started_tasks[0]
        not_run = arrived - (started + queue[0, -1] - before)
        if model == "tasks":
            assert not_run == work.dropped_tasks[0]
            if work.overdue_tasks[0] > 0:
                assert started == cap, "overdue with capacity to spare"
        else:
            # Tasks that find the queue full count as dropped, and run if the limit allows.
            assert not_run <= work.dropped_tasks[0]
            assert not_run == 0 or started == cap
        assert abs(arrived - 100.0 * demand) < 1.0 + 1e-9
        assert started <= cap
        assert queue[0, -1] <= limits.queue_limit


@given(steps=STEPS, limits=LIMITS, deadline=st.sampled_from([1.0, 3.0, 8.0]))
def test_no_work_outlives_its_deadline_where_capacity_allows(
    steps: list[tuple[float, float]], limits: Limits, deadline: float
) -> None:
    limits = Limits(limits.flexible_share, 1.0, limits.queue_limit, deadline)
    queue = np.zeros((1, LENGTH))
    for demand, command in steps:
        work = one_step("fluid", queue, 0.5 * demand, -abs(command), limits)
        queue = work.queue
        # At most half the capacity arrives, and no more than that can be due in one step.
        assert work.overdue_tasks[0] <= 1e-9
        assert work.oldest_age_steps[0] < deadline


@pytest.mark.parametrize("model", MODELS)
def test_full_queue_drops(model: str) -> None:
    limits = Limits(0.5, 0.9, 120.0, math.inf)
    queue, dropped = np.zeros((1, LENGTH)), []
    for _ in range(6):
        work = one_step(model, queue, 0.8, -1.0, limits)
        queue = work.queue
        dropped.append(float(work.dropped_tasks[0]))
    assert dropped == [0, 0, 0, 40, 40, 40]
    assert queue[0, -1] == 120
    assert work.started_tasks[0] == (80 if model == "released" else 40)


@pytest.mark.parametrize("model", MODELS)
def test_work_older_than_the_array_is_kept_and_counted_at_its_end(model: str) -> None:
    limits = Limits(0.5, 0.9, math.inf, math.inf)
    queue = one_step(model, np.zeros((1, 6)), 0.8, -1.0, limits).queue
    for _ in range(9):
        work = one_step(model, queue, 0.0, -1.0, limits)
        queue = work.queue
    assert queue[0, -1] == 40
    assert work.oldest_age_steps[0] == work.mean_age_steps[0] == 5


def test_due_work_runs_before_what_arrives() -> None:
    """Deferred work whose deadline comes while the data center is full does not wait longer."""
    config = load_config("tiny", ["workload.deadline_h=2"])
    demand = [0.5] * 8 + [1.0] * 24
    drivers = drivers_from_arrays([20.0] * 32, [15.0] * 32, [300.0] * 32, demand)
    with Simulator(config, drivers=drivers) as sim:
        sim.reset()
        results = [sim.step(Actions(load=LoadAction.DEFER if t < 8 else 0.0)) for t in range(32)]
    assert max(float(r.due_tasks[0]) for r in results) > 0
    assert all(r.overdue_tasks[0] == 0 for r in results)
    assert max(float(r.oldest_age_h[0]) for r in results) <= 2.0


@pytest.mark.parametrize("model", MODELS)
def test_a_queue_that_rounding_overfills_takes_nothing(model: str) -> None:
    limit = np.array([0.3])
    work = work_done(
        model,
        np.array([0.5]),
        np.array([-1.0]),
        np.nextafter(limit, 1.0),
        np.zeros(1),
        flexible_share=np.array([0.5]),
        max_utilisation=np.ones(1),
        queue_limit=limit,
    )
    assert work.deferred_tasks == 0.0


@pytest.mark.parametrize("preset", ["tiny", "sustaindc"])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("limit", [0.05, 0.29, 0.6])
def test_no_run_exceeds_its_highest_utilisation(preset: str, model: str, limit: float) -> None:
    values = [f"workload.model={model}", f"workload.max_utilisation={limit}"]
    rng = np.random.default_rng(1)
    arrived = executed = dropped = 0.0
    with Simulator(load_config(preset, values)) as sim:
        sim.reset()
        for _ in range(130):
            step = sim.step(Actions(load=rng.uniform(-1.0, 1.0, 1)))
            assert step.utilisation[0] <= limit + 1e-12
            arrived += step.arrived_tasks[0]
            executed += step.executed_tasks[0]
            dropped += step.dropped_tasks[0]
    if model != "released":
        assert arrived == pytest.approx(executed + dropped + step.queue_tasks[0])
    assert executed > 0.8 * 100.0 * limit * 130 if limit < 0.3 else executed > 0
