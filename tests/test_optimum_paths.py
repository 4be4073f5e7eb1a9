"""Commands that reach targets, paths of least cost, and roll-outs of them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from model_steps import work_done
from sdc_taichi import Actions, Simulator, build_fleet, load_config
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.paths import battery_path, setpoint_path, storage_parameters
from sdc_taichi.optimum.problem import Problem, Storage, problems_of
from sdc_taichi.optimum.rollout import (
    RollOut,
    Targets,
    battery_command,
    load_command,
    roll_out,
)
from sdc_taichi.optimum.tables import FacilityTable
from sdc_taichi.plant.battery import BATTERIES, BatteryParameters, BatteryPoint
from sdc_taichi.plant.workload import MODELS
from sdc_taichi.sim.drivers import Drivers, load_drivers
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, Work

CLC = Storage("clc", 100.0, 20.0, 0.97, 1.04, 0.5, 1.0, -0.04, 1.0, 0.01, 0.0)
LOSSY = replace(CLC, square_loss_h=0.05, standby_per_h=0.01)
RELEASED = Storage("released", 100.0, 20.0, 1.0, 1.0, 0.1, 1.0, -0.04, 1.0, 0.01, 0.0)


@pytest.mark.parametrize("model", MODELS)
def test_load_commands_do_the_work_that_was_wanted(model: str) -> None:
    rng = np.random.default_rng(0)
    n = 2000
    demand, waiting = rng.random(n), np.floor(300.0 * rng.random(n) * (rng.random(n) < 0.8))
    due = np.floor(waiting * rng.random(n) * (rng.random(n) < 0.3))
    share, cap = np.full(n, 0.3), np.full(n, 0.95)
    limit = np.where(rng.random(n) < 0.5, waiting + np.floor(20.0 * rng.random(n)), 1e30)

    limits = {"flexible_share": share, "max_utilisation": cap, "queue_limit": limit}

    def run(command: F64) -> Work:
        return work_done(model, demand, command, waiting, due, **limits)

    wanted = run(rng.uniform(-1.0, 1.0, n))
    command = load_command(
        wanted.started_tasks,
        model=model,
        demand=demand,
        waiting_tasks=waiting,
        due_tasks=due,
        flexible_share=share,
        max_utilisation=cap,
        queue_limit_tasks=limit,
    )
    done, neutral = run(command), run(np.zeros(n))
    assert np.all(done.dropped_tasks <= neutral.dropped_tasks + 1e-9), "a plan drops work"
    kept = wanted.dropped_tasks <= neutral.dropped_tasks
    assert kept.mean() > 0.5
    np.testing.assert_allclose(done.started_tasks[kept], wanted.started_tasks[kept], atol=1e-9)


@pytest.mark.parametrize("storage", [CLC, LOSSY, RELEASED])
def test_battery_commands_draw_and_deliver_what_was_wanted(storage: Storage) -> None:
    n = 200
    rng = np.random.default_rng(1)
    stored, own = 100.0 * rng.random(n), rng.uniform(-1.0, 1.0, n)
    load_kw = np.full(n, 60.0)
    parameters = BatteryParameters(*(np.full(n, x) for x in storage_parameters(storage)))
    capacity = np.full(n, 100.0)

    def run(command: F64) -> F64:
        point = BatteryPoint(capacity, load_kw, 0.25, parameters)
        done = BATTERIES[storage.model].step(stored, command, point)
        return np.asarray(done.charge_kwh - done.discharge_kwh)

    wanted = run(own)
    command = battery_command(
        wanted,
        model=storage.model,
        stored_kwh=stored,
        load_kw=load_kw,
        step_h=0.25,
        capacity_kwh=capacity,
        parameters=parameters,
    )
    np.testing.assert_allclose(run(command), wanted, atol=1e-12)


@pytest.mark.parametrize("bars", [0.0, 0.3, 1.0])
def test_setpoint_paths_are_those_of_least_cost(bars: float) -> None:
    rng = np.random.default_rng(int(10 * bars))
    grid = np.array([16.0, 17.0, 18.0, 19.0])
    cost = np.where(rng.random((5, 4)) < bars, np.inf, rng.random((5, 4)))

    def price(path: tuple[int, ...]) -> tuple[int, float]:
        paid = cost[np.arange(5), path]
        return int(np.isinf(paid).sum()), float(paid[np.isfinite(paid)].sum())

    def keeps_ramp(path: tuple[int, ...]) -> bool:
        return bool(np.all(np.abs(np.diff([17.2, *grid[list(path)]])) <= 1.0))

    best = min(price(p) for p in itertools.product(range(4), repeat=5) if keeps_ramp(p))
    found_c = setpoint_path(cost, grid, ramp_k=1.0, start_c=17.2)
    found = tuple(np.searchsorted(grid, found_c).tolist())
    assert keeps_ramp(found)
    assert price(found) == pytest.approx(best)


def test_setpoint_paths_from_outside_the_grid_begin_at_the_node_nearest_by() -> None:
    found = setpoint_path(
        np.array([[3.0, 2.0, 1.0]] * 3), np.array([20.0, 21.0, 22.0]), ramp_k=1.0, start_c=10.0
    )
    np.testing.assert_array_equal(found, [20.0, 21.0, 22.0])


def square_wave(low: float, high: float) -> F64:
    return np.where(np.arange(96) % 48 < 24, low, high)


@pytest.mark.parametrize("storage", [CLC, RELEASED])
def test_battery_paths_charge_when_it_is_cheap_and_keep_the_end(storage: Storage) -> None:
    weight, facility = square_wave(1.0, 3.0), np.full(96, 50.0)
    path = battery_path(storage, facility, weight, step_h=0.25, end_kwh=20.0)
    assert path[-1] >= 20.0 - 1e-9
    assert path[23] > path[0]
    assert path[47] < path[23]
    rise = np.diff(path, prepend=20.0)
    grid = facility + np.where(rise > 0, rise / storage.charge_efficiency, rise)
    assert (weight * grid).sum() < (weight * facility).sum()


def test_battery_paths_keep_below_a_peak_where_they_can() -> None:
    facility = np.full(96, 10.0)
    facility[40:44] = 16.0
    path = battery_path(CLC, facility, np.ones(96), step_h=0.25, end_kwh=20.0, most_grid_kw=48.0)
    rise = np.diff(path, prepend=20.0)
    grid_kwh = facility + np.where(rise > 0, rise / 0.97, rise / 1.04)
    assert grid_kwh.max() / 0.25 <= 48.0 + 1e-6


def neutral(steps: int, size: int, setpoint_c: float) -> Targets:
    nothing = np.full((steps, size), np.nan)
    held = np.full((steps, size, 3), np.nan)
    return Targets(
        nothing, np.full((steps, size), setpoint_c), nothing, np.ones((steps, size)), held
    )


def run(fleet: Fleet, drivers: Drivers, targets: Targets, start: I64) -> RollOut:
    found = roll_out(fleet, drivers, targets, start=start, objective=Objective(carbon=1.0))
    return found[0]


@pytest.mark.parametrize("preset", ["tiny", "sustaindc"])
def test_neutral_targets_are_idle_to_the_bit(preset: str) -> None:
    fleet = build_fleet(load_config(preset))
    drivers, start = load_drivers(fleet.configs), np.array([1000])
    done = run(fleet, drivers, neutral(8, 1, 18.0), start)
    with Simulator(fleet, drivers=drivers) as sim:
        sim.reset(start=start)
        for t in range(8):
            result = sim.step(Actions())
            np.testing.assert_array_equal(result.grid_kwh, done.grid_kwh[t])
            np.testing.assert_array_equal(result.setpoint_c, done.setpoint_c[t])


def test_targets_are_reached_as_far_as_models_allow() -> None:
    fleet = build_fleet(load_config("tiny"))
    drivers, start = load_drivers(fleet.configs), np.array([1000])

    targets = Targets(
        queue_tasks=np.array([[5.0, 10.0, 12.0, 4.0, 0.0, 0.0]]).T,
        setpoint_c=np.array([[20.0, 22.0, 22.5, 21.0, 19.0, 18.0]]).T,
        stored_kwh=np.array([[0.02, 0.03, 0.03, 0.01, 0.005, 0.01]]).T,
        facility_kwh=np.ones((6, 1)),
        loops=np.full((6, 1, 3), np.nan),
    )
    done = run(fleet, drivers, targets, start)
    np.testing.assert_allclose(done.queue_tasks, targets.queue_tasks, atol=1e-9)
    np.testing.assert_allclose(done.setpoint_c, targets.setpoint_c, atol=1e-9)
    np.testing.assert_allclose(done.stored_kwh, targets.stored_kwh, atol=1e-9)
    assert done.dropped_tasks.max() == 0.0


def test_figures_count_scored_steps_and_the_part_of_a_month() -> None:
    fleet = build_fleet(load_config("tiny"))
    drivers, start = load_drivers(fleet.configs), np.array([0])

    def figure(text: str, scored_from: int = 0) -> tuple[RollOut, float]:
        found = roll_out(
            fleet,
            drivers,
            neutral(8, 1, 18.0),
            start=start,
            objective=Objective.parse(text),
            scored_from=scored_from,
        )
        return found[0], float(found[1].figure[0])

    done, carbon_kg = figure("carbon")
    assert carbon_kg == pytest.approx(done.carbon_g.sum() / 1e3)
    assert figure("carbon", 4)[1] == pytest.approx(done.carbon_g[4:].sum() / 1e3)
    peak_kw = 4.0 * done.grid_kwh[4:].max()
    bill = done.energy_cost[4:].sum() + 12.0 * peak_kw * 4 / (31 * 96)
    assert figure("cost", 4)[1] == pytest.approx(bill)


def problem_of(preset: str, changes: list[str], steps: int, **arguments: Any) -> Problem:
    fleet = build_fleet(load_config(preset, changes))
    with Simulator(fleet) as sim:
        start = np.array([30 * 96])
        grid = np.linspace(0.0, 1.0, 2), np.array([16.0, 23.0])
        nothing = np.zeros((steps, 2, 2))
        table = FacilityTable(*grid, nothing, nothing, nothing, nothing)
        found = problems_of(fleet, sim.drivers, sim.sizing, [table], start=start, **arguments)
    return found[0]


def test_problems_have_the_limits_of_their_configs() -> None:
    carbon = Objective(carbon=1.0)
    free = problem_of("tiny", [], 8, objective=carbon)
    assert free.months == ()
    assert free.inlet_limit_c == np.inf
    assert np.all(free.idle_setpoint_c == 18.0)
    assert np.isfinite(free.grid_limit_kw)
    changes = ["protection.ashrae_class=A2", "electrical.grid_limit_ratio=null"]
    limited = problem_of("tiny", changes, 8, objective=carbon)
    assert limited.inlet_limit_c == 35.0
    assert limited.grid_limit_kw == np.inf
    assert problem_of("tiny", changes, 8, objective=carbon, inlet_limit_c=27.0).inlet_limit_c == 27


def test_problems_know_the_work_that_idle_commands_do_and_drop() -> None:
    problem = problem_of("tiny", [], 96, objective=Objective(carbon=1.0))
    np.testing.assert_allclose(problem.work.idle_tasks, problem.work.arrived_tasks)
    np.testing.assert_allclose(problem.work.most_deferred_tasks, 0.2 * problem.work.arrived_tasks)
    changes = ["workload.max_utilisation=0.3", "workload.queue_limit_h=0.5"]
    crowded = problem_of("tiny", changes, 96, objective=Objective(carbon=1.0))
    assert crowded.work.idle_tasks.max() == pytest.approx(30.0)
    assert crowded.work.most_dropped_tasks > 0.0
