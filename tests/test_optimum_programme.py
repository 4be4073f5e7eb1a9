"""Bounds and plans of linear programmes: against dynamic programmes, and what moves them where."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from model_steps import battery_step
from sdc_taichi.errors import ConfigError
from sdc_taichi.optimum.dispatch import Dispatch, battery_limits
from sdc_taichi.optimum.linear_programme import bound, plan
from sdc_taichi.optimum.paths import storage_parameters
from sdc_taichi.optimum.problem import (
    AGENTS,
    BilledMonth,
    Ends,
    FlexibleWork,
    Problem,
    Storage,
)
from sdc_taichi.optimum.stage_cost import stage_cost
from sdc_taichi.optimum.tables import FacilityTable
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


def figure_of(p: Problem, found: Dispatch) -> float:
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


def test_a_battery_is_not_charged_and_discharged_at_once_and_never_beyond_its_limits() -> None:
    p = problem(steps=96)
    found = plan(p)
    stored = np.cumsum(0.97 * found.charge_kwh - 1.04 * found.discharge_kwh)
    assert np.all(np.minimum(found.charge_kwh, found.discharge_kwh) == 0.0)
    assert stored.min() > -1e-7
    assert stored.max() < 100.0
    assert found.discharge_kwh.max() > 1.0


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


def battery_by_states(p: Problem, states: int) -> float:
    """Least cost of a ``clc`` battery by a dynamic programme over stored energy."""
    s, h = p.storage, p.step_h
    grid = np.linspace(0.0, s.capacity_kwh, states)
    rise = grid[None] - grid[:, None]
    charge, discharge = np.maximum(rise, 0) / s.charge_efficiency, np.maximum(-rise, 0) / 1.04
    most_in = np.minimum(0.5 * s.capacity_kwh / 0.97 * h, (s.capacity_kwh - grid) * h / 0.2825)
    most_out = np.minimum(s.capacity_kwh / 1.04 * h, grid * h / 0.27)
    allowed = (charge <= most_in[:, None] + 1e-9) & (discharge <= most_out[:, None] + 1e-9)
    load = energy_kwh(p, p.work.idle_tasks)
    rest = np.where(grid >= s.stored_kwh - 1e-9, 0.0, np.inf)
    for weight, kwh in zip(p.kwh_weight[::-1], load[::-1], strict=True):
        ok = allowed & (discharge <= kwh + 1e-9)
        cost = np.where(ok, weight * (kwh + charge - discharge) + rest[None], np.inf)
        rest = cost.min(axis=1)
    return float(rest[np.abs(grid - s.stored_kwh).argmin()])


def test_the_battery_agrees_with_a_dynamic_programme_over_stored_energy() -> None:
    p = problem(agents=("battery", "cooling"), storage=replace(CLC, stored_kwh=40.0))
    low, by_states = bound(p).figure, battery_by_states(p, 501)
    # The grid cannot do all that the battery can.
    assert low - 0.01 <= by_states <= low * 1.002


def test_the_queue_without_deadline_agrees_with_a_dynamic_programme_over_its_length() -> None:
    p = problem(agents=("load", "cooling"), storage=NO_BATTERY)
    p = replace(p, work=replace(p.work, deadline_steps=None, queue_limit_tasks=40.0))
    grid = np.linspace(0.0, 40.0, 161)
    rest = np.where(grid > 0.0, np.inf, 0.0)
    for t in range(p.steps)[::-1]:
        done = p.work.arrived_tasks[t] + grid[:, None] - grid[None]
        most = p.work.most_deferred_tasks[t]
        ok = (done <= 100.0) & (done >= p.work.arrived_tasks[t] - most)
        kwh = np.interp(done, p.table.utilisation * 100, p.table.facility_kwh[t, :, -1])
        rest = np.where(ok, p.kwh_weight[t] * kwh + rest[None], np.inf).min(axis=1)
    # Below the lines between nodes by the sag of the curve, and finer than the grid.
    assert bound(p).figure == pytest.approx(rest[0], rel=2e-3)
    assert bound(p).figure <= rest[0]


@pytest.mark.parametrize(
    "fewer_limits",
    [
        {"work": {"deadline_steps": None}},
        {"work": {"deadline_steps": 12}},
        {"work": {"queue_limit_tasks": 16.0}},
        {"work": {"most_deferred_tasks": np.full(24, 60.0)}},
        {"storage": {"capacity_kwh": 200.0}},
        {"storage": {"charge_limit_c_rate": 3.0}},
        {"storage": {"charge_efficiency": 1.0}},
        {"storage": {"discharge_factor": 1.0}},
        {"grid_limit_kw": np.inf},
        {"inlet_limit_c": np.inf},
        {"months": (BilledMonth(0, 24, 0.0),)},
    ],
    ids=str,
)
def test_a_limit_less_never_raises_the_bound(fewer_limits: dict[str, Any]) -> None:
    p = problem(months=(BilledMonth(0, 24, 0.01),), grid_limit_kw=160.0, inlet_limit_c=22.5)
    p = replace(p, work=replace(p.work, queue_limit_tasks=12.0, deadline_steps=1))
    p = replace(p, storage=replace(CLC, charge_limit_c_rate=1.0))
    freed = p
    for name, value in fewer_limits.items():
        inner = replace(getattr(p, name), **value) if isinstance(value, dict) else value
        freed = replace(freed, **{name: inner})
    assert bound(freed).figure < bound(p).figure * (1 - 1e-7)


def test_prices_are_what_a_little_more_in_queue_and_store_changes() -> None:
    p = problem()
    p = replace(p, work=replace(p.work, deadline_steps=None))

    def cost(tasks: float, kwh: float) -> float:
        return bound(p, Ends(kwh, tasks, 50.0, 0.0)).figure

    found = bound(p, Ends(50.0, 20.0, 50.0, 0.0))
    # One task or kWh more at the end of the first step is one more at its beginning, where neither
    # limits what the first step does.
    assert found.task_price[0] > 0.0
    assert found.kwh_price[0] > 0.0
    per_task = [(cost(20.0 + d, 50.0) - cost(20.0, 50.0)) / d for d in (-1e-3, 1e-3)]
    per_kwh = [(cost(20.0, 50.0) - cost(20.0, 50.0 + d)) / d for d in (-1e-3, 1e-3)]
    assert per_task[0] - 1e-6 <= found.task_price[0] <= per_task[1] + 1e-6
    assert per_kwh[1] - 1e-6 <= found.kwh_price[0] <= per_kwh[0] + 1e-6


def test_ends_that_ask_for_more_cost_more() -> None:
    p = problem(steps=48, scored_from=10, kwh_weight=weights_of_days(48, 10))
    own = bound(p).figure
    same = bound(p, Ends(30.0, 10.0, 30.0, 10.0)).figure
    assert own <= same * (1 + 1e-9)
    assert bound(p, Ends(30.0, 10.0, 60.0, 10.0)).figure > same
    assert bound(p, Ends(30.0, 10.0, 30.0, 0.0)).figure > same
    assert bound(p, Ends(30.0, 30.0, 30.0, 10.0)).figure > same


def test_nothing_to_move_costs_what_idle_commands_cost() -> None:
    p = problem(storage=NO_BATTERY)
    idle = (p.kwh_weight * energy_kwh(p, p.work.arrived_tasks)).sum()
    for still in (
        replace(p.work, most_deferred_tasks=np.zeros(24)),
        replace(p.work, queue_limit_tasks=0.0),
    ):
        fixed = replace(p, work=still)
        assert bound(fixed).figure == pytest.approx(idle, rel=2e-3)
        np.testing.assert_allclose(plan(fixed).executed_tasks, p.work.arrived_tasks, atol=1e-9)


@pytest.mark.parametrize("losses", [{}, {"square_loss_h": 0.1, "standby_per_h": 0.01}])
@pytest.mark.parametrize("model", ["clc", "paper", "released"])
@pytest.mark.parametrize("start_share", [0.0, 0.4, 1.0])
def test_a_model_never_beats_the_limits_of_its_battery(
    model: str, start_share: float, losses: dict[str, float]
) -> None:
    rng = np.random.default_rng(5)
    storage = replace(CLC, model=model, upper_v=0.9, lower_v=0.1, **losses)
    standby_kwh = storage.conversion(0.25).standby_kwh
    assert standby_kwh == (0.25 if losses and model == "clc" else 0.0)
    limits = battery_limits(storage, 0.25, start_share * 100.0)
    stored, load = np.full(50, start_share * 100.0), 120.0
    parameters = storage_parameters(storage)._asdict()
    for _ in range(40):
        command = rng.choice([-1.0, 1.0, 0.3, -0.5], 50)
        step = battery_step(
            model, stored, command, capacity_kwh=100.0, load_kw=load, dt_h=0.25, **parameters
        )
        bus_kwh = step.charge_kwh - step.discharge_kwh - standby_kwh
        charged, discharged = np.maximum(bus_kwh, 0.0), np.maximum(-bus_kwh, 0.0)
        for done, lines, most in (
            (charged, limits.charge, limits.most_charge_kwh),
            (discharged, limits.discharge, limits.most_discharge_kwh),
        ):
            assert np.all(done <= most + 1e-9)
            for line, slope in lines:
                assert np.all(done <= np.maximum(line + slope * stored, 0.0) + 1e-9)
        most_kwh = limits.discharge_load_share * (load * 0.25 + standby_kwh)
        assert np.all(discharged <= most_kwh + 1e-9)
        gain = through_pieces(charged, limits.charge_pieces())
        gain = gain - through_pieces(discharged, limits.discharge_pieces())
        assert np.all(step.stored_kwh - stored <= gain + limits.rounding_kwh + 1e-9)
        stored = step.stored_kwh


def through_pieces(energy_kwh: F64, pieces: tuple[tuple[float, float], ...]) -> F64:
    """Energy of the store for an energy of the bus that fills one piece after the other."""
    ends_kwh = np.cumsum([0.0, *(most for most, _ in pieces)])
    parts = np.diff(np.minimum(energy_kwh[:, None], ends_kwh), axis=1)
    return np.asarray(parts @ np.array([ratio for _, ratio in pieces]))


def test_square_losses_bend_the_pieces_of_a_battery() -> None:
    storage = replace(CLC, square_loss_h=0.1)
    limits, energy = battery_limits(storage, 0.25, 0.0), np.linspace(0.0, 12.0, 50)
    converted, nothing = storage.conversion(0.25), np.zeros(50)
    stored = through_pieces(energy, limits.charge_pieces())
    exact = converted.rise_kwh(energy, nothing)
    assert np.all((stored >= exact - 1e-12) & (stored < exact + 0.05))
    taken = through_pieces(energy, limits.discharge_pieces())
    exact = np.asarray(-converted.rise_kwh(nothing, energy))
    assert np.all((taken <= exact + 1e-12) & (taken > exact - 0.2))
    assert exact[-1] > 1.04 * 12.0 + 0.5


def test_water_has_a_weight_of_its_own() -> None:
    p = problem(storage=NO_BATTERY)
    wet = replace(p.table, water_l=np.broadcast_to(100.0 - 10.0 * np.arange(8.0), (24, 11, 8)))
    dry = replace(p.table, water_l=np.broadcast_to(30.0 + 10.0 * np.arange(8.0), (24, 11, 8)))
    # Each kelvin saves 0.2 kWh, at 0.1 to 0.5, and takes or saves 10 l at 0.1.
    assert np.all(stage_cost(replace(p, table=wet, litre_weight=0.1)).setpoint_c == 23.0)
    assert np.all(stage_cost(replace(p, table=dry, litre_weight=0.1)).setpoint_c == 16.0)
    free = bound(replace(p, table=wet)).figure
    weighed = bound(replace(p, table=wet, litre_weight=0.1)).figure
    assert weighed == pytest.approx(free + 24 * 30.0 * 0.1, rel=1e-6)


def test_work_beyond_what_can_be_cooled_is_not_planned() -> None:
    p = problem()
    unmet = np.where(p.table.utilisation[:, None] > 0.75, 1e3, np.zeros((24, 11, 8)))
    p = replace(p, table=replace(p.table, unmet_w=unmet))
    assert bound(p).executed_tasks.max() <= 80.0 + 1e-9


def test_a_hall_that_nothing_cools_is_told_with_its_name() -> None:
    p = problem()
    p = replace(p, table=replace(p.table, unmet_w=np.full((24, 11, 8), np.inf)))
    with pytest.raises(ConfigError, match="optimum of hall: in step 0"):
        bound(p)


def test_whole_tasks_are_drained_no_faster_than_the_flexible_work_of_a_step() -> None:
    p = problem(steps=48, agents=("load", "cooling"))
    p = replace(p, work=replace(p.work, model="tasks"))
    drained = plan(p).executed_tasks - p.work.arrived_tasks
    assert drained.max() > 5.0
    assert np.all(drained <= p.work.most_deferred_tasks + 1e-9)
