"""Bounds and plans of linear programmes: against dynamic programmes, and what moves them where."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sdc_taichi.errors import ConfigError
from sdc_taichi.optimum.linear_programme import bound, plan
from sdc_taichi.optimum.problem import (
    AGENTS,
    BilledMonth,
    Ends,
    FacilityTable,
    FlexibleWork,
    Plan,
    Problem,
    Storage,
)
from sdc_taichi.optimum.stage_cost import stage_cost
from sdc_taichi.types import F64

CLC = Storage("clc", 100.0, 0.0, 0.97, 1.04, 0.5, 1.0, -0.04, 1.0, 0.01, 0.0)
NO_BATTERY = replace(CLC, capacity_kwh=0.0)


def problem(steps: int = 24, **changes: Any) -> Problem:
    """A problem with convex energy, weights that vary, and work of a quarter to three quarters."""
    rng = np.random.default_rng(3)
    u, setpoint = np.linspace(0.0, 1.0, 11), np.linspace(16.0, 23.0, 8)
    kwh = 10.0 + 40.0 * u[:, None] + 8.0 * u[:, None] ** 2 - 0.2 * (setpoint - 16.0)
    table = FacilityTable(
        u,
        setpoint,
        kwh + rng.uniform(0.0, 3.0, (steps, 1, 1)),
        np.full((steps, 11, 8), 5.0),
        np.broadcast_to(setpoint + 2.0, (steps, 11, 8)),
        np.zeros((steps, 11, 8)),
    )
    arrived = rng.uniform(25.0, 75.0, steps)
    fields: dict[str, Any] = {
        "name": "hall",
        "step_h": 0.25,
        "agents": AGENTS,
        "table": table,
        "kwh_weight": rng.uniform(0.1, 0.5, steps),
        "litre_weight": 0.0,
        "months": (),
        "work": FlexibleWork(
            arrived, arrived, 0.3 * arrived, np.full(steps, 100.0), 200.0, 8, "fluid"
        ),
        "storage": CLC,
        "grid_limit_kw": np.inf,
        "inlet_limit_c": np.inf,
        "idle_setpoint_c": np.full(steps, 18.0),
        "setpoint_c": 18.0,
        "ramp_k": 2.0,
        "scored_from": 0,
    }
    return Problem(**fields | changes)


def energy_kwh(p: Problem, tasks: F64) -> F64:
    """Energy of the facility at the highest setpoint, as the table reads, (T,)."""
    u = p.table.utilisation * 100.0
    return np.array(
        [np.interp(w, u, k) for w, k in zip(tasks, p.table.facility_kwh[:, :, -1], strict=True)]
    )


def figure_of(p: Problem, found: Plan) -> float:
    """Weighed cost of a plan at the highest setpoint, with its peaks."""
    bought = energy_kwh(p, found.executed_tasks) + found.charge_kwh - found.discharge_kwh
    peaks = (m.weight_per_kw * bought[m.first : m.end].max() / p.step_h for m in p.months)
    return float((p.kwh_weight * bought).sum() + sum(peaks))


def run_queue(p: Problem, executed: F64) -> tuple[F64, float]:
    """What a first-in-first-out queue does when it is asked for some work, (T,), and its rest."""
    work, done = p.work, []
    ages: list[tuple[int, float]] = []
    assert work.deadline_steps is not None
    for t, asked in enumerate(executed):
        due = sum(amount for since, amount in ages if t - since >= work.deadline_steps)
        arrived = work.arrived_tasks[t]
        out = max(due, asked - arrived)
        into = np.clip(out - (asked - arrived), 0.0, work.most_deferred_tasks[t])
        done.append(arrived + out - into)
        while out > 1e-12 and ages:
            since, amount = ages.pop(0)
            if amount > out:
                ages.insert(0, (since, amount - out))
            out -= min(amount, out)
        ages.append((t, into))
    return np.array(done), sum(amount for _, amount in ages)


def test_a_plan_lies_above_the_bound_and_below_doing_nothing() -> None:
    p = problem(steps=96)
    idle = (p.kwh_weight * energy_kwh(p, p.work.arrived_tasks)).sum()
    low, found = bound(p).figure, figure_of(p, plan(p))
    assert low <= found < 0.99 * idle
    assert found - low < 0.005 * idle


def test_the_queue_can_carry_a_plan_out() -> None:
    p = problem(steps=96)
    executed = plan(p).executed_tasks
    done, rest = run_queue(p, executed)
    np.testing.assert_allclose(done, executed, atol=1e-6)
    assert rest == pytest.approx(0.0, abs=1e-6)


def test_a_battery_is_not_charged_and_discharged_at_once_and_never_beyond_its_limits() -> None:
    p = problem(steps=96)
    found = plan(p)
    stored = np.cumsum(0.97 * found.charge_kwh - 1.04 * found.discharge_kwh)
    assert np.all(np.minimum(found.charge_kwh, found.discharge_kwh) == 0.0)
    assert stored.min() > -1e-7
    assert stored.max() < 100.0
    assert found.discharge_kwh.max() > 1.0


def test_an_inlet_limit_keeps_setpoints_down_and_never_lowers_the_bound() -> None:
    p = problem()
    limited = replace(p, inlet_limit_c=22.5)
    assert bound(limited).figure > bound(p).figure
    np.testing.assert_allclose(stage_cost(limited).setpoint_c, 20.5)


def test_work_that_cannot_be_done_is_told_with_the_name_of_the_data_center() -> None:
    p = problem()
    ends = Ends(start_kwh=0.0, start_tasks=0.0, end_kwh=1e3, end_tasks=0.0)
    with pytest.raises(ConfigError, match="optimum of hall"):
        bound(p, ends)


def test_one_peak_is_shared_by_load_and_battery() -> None:
    months = (BilledMonth(0, 24, 12.0),)
    p = problem(months=months)
    apart = [bound(problem(months=months, agents=(agent,))).figure for agent in AGENTS]
    assert bound(p).figure < min(apart)
    assert figure_of(p, plan(p)) == pytest.approx(bound(p).figure, rel=0.01)


def in_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Solve windows of three to five times the deadline."""
    for name, steps in (("LONGEST_BOUND", 40), ("LONGEST_PLAN", 24), ("AROUND", 16), ("AHEAD", 16)):
        monkeypatch.setattr(f"sdc_taichi.optimum.linear_programme._{name}", steps)


def weights_of_days(steps: int, first: int = 0) -> F64:
    """Weights that vary within days of 24 steps and between them, 0 before the first scored."""
    t = np.arange(steps)
    return np.where(t < first, 0.0, 0.3 + 0.15 * np.sin(2 * np.pi * t / 24) + 0.02 * np.sin(t / 50))


@pytest.mark.parametrize("first", [0, 10])
def test_windows_bound_what_one_programme_bounds(
    monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    weight = weights_of_days(200, first)
    months = (BilledMonth(max(first, 0), 90, 4.0), BilledMonth(90, 200, 6.0))
    # Work that crosses a border loses its age, of which there are four; months end at the other.
    for billed, longest, share in ((), 40, 0.01), (months, 110, 0.03):
        p = problem(200, kwh_weight=weight, scored_from=first, months=billed)
        whole = bound(p).figure
        with monkeypatch.context() as patch:
            in_windows(patch)
            patch.setattr("sdc_taichi.optimum.linear_programme._LONGEST_BOUND", longest)
            parts = bound(p).figure
        assert whole * (1 - share) < parts <= whole * (1 + 1e-9)


@pytest.mark.parametrize("first", [0, 10])
def test_plans_of_windows_keep_queue_battery_and_ends(
    monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    in_windows(monkeypatch)
    p = problem(200, kwh_weight=weights_of_days(200, first), scored_from=first)
    found = plan(p)
    done, rest = run_queue(p, found.executed_tasks)
    waiting = np.cumsum(p.work.arrived_tasks - done)
    stored = np.cumsum(0.97 * found.charge_kwh - 1.04 * found.discharge_kwh)
    np.testing.assert_allclose(done, found.executed_tasks, atol=1e-6)
    assert rest <= (waiting[first - 1] if first else 0.0) + 1e-6
    assert stored[-1] >= (stored[first - 1] if first else 0.0) - 1e-6
    low = bound(p).figure
    assert low <= figure_of(p, found) < low * 1.01
