"""Model-predictive control: what it finds, what it keeps to, and what it depends on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import (
    ConfigError,
    DataCenterConfig,
    Drivers,
    ForecastError,
    Simulator,
    build_fleet,
    drivers_from_arrays,
    load_config,
    make_controller,
    simulate,
)
from sdc_taichi.control import PERFECT, view_maker
from sdc_taichi.control.mpc import expected_demand
from sdc_taichi.envs.core import Core
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.types import F64, StepResult

DAY = 96
CHEAP, DEAR = 200.0, 500.0
SQUARE = np.tile(np.repeat([CHEAP, DEAR], DAY // 2), 4)
"""Half a day of low, half a day of high carbon intensity."""


def tiny(*overrides: str, name: str = "dc") -> DataCenterConfig:
    return load_config("tiny", [f"name={name}", *overrides])


def inputs(ci: F64 = SQUARE, demand: Any = 0.5, outdoor_c: Any = 20.0) -> Drivers:
    def series(values: Any) -> F64:
        return np.broadcast_to(np.asarray(values, dtype=np.float64), ci.shape)

    outdoor = series(outdoor_c)
    return drivers_from_arrays(outdoor, outdoor - 5.0, ci, series(demand))


def results(
    spec: str,
    config: DataCenterConfig | list[DataCenterConfig],
    steps: int,
    *,
    drivers: Drivers | None = None,
    error: ForecastError = PERFECT,
    seed: int = 0,
) -> list[StepResult]:
    kept: list[StepResult] = []
    with Simulator(config, drivers=drivers) as sim:
        controller = make_controller(spec, sim.fleet)
        simulate(sim, controller, steps, seed, forecast_error=error, on_step=kept.append)
    return kept


def column(kept: list[StepResult], name: str, dc: int = 0) -> F64:
    return np.array([getattr(r, name)[dc] for r in kept])


# What it finds


def test_battery_is_full_when_cheap_hours_end_and_empty_when_dear_ones_do() -> None:
    kept = results("battery=mpc-24h", tiny(), DAY, drivers=inputs())
    soc = column(kept, "soc")
    assert soc[DAY // 2 - 1] > 0.97
    assert soc[-1] < 0.02
    dear = column(kept, "ci_g_per_kwh") == DEAR
    assert not column(kept, "charge_kwh")[dear].any()
    assert not column(kept, "discharge_kwh")[~dear].any()


def test_work_of_dear_hours_runs_in_cheap_ones() -> None:
    kept = results("load=mpc-24h", tiny(), 2 * DAY, drivers=inputs())
    dear = column(kept, "ci_g_per_kwh") == DEAR
    np.testing.assert_allclose(column(kept, "load_command")[dear], -1.0)
    # What was deferred in half a day of dear hours runs in the half day that follows.
    assert column(kept, "queue_tasks")[3 * DAY // 2 - 1] < 1.0
    arrived, executed = (column(kept, f"{n}_tasks").sum() for n in ("arrived", "executed"))
    assert arrived == pytest.approx(executed + kept[-1].queue_tasks[0], rel=1e-12)


def test_setpoint_is_the_one_of_least_energy() -> None:
    kept = results("cooling=mpc-24h", tiny(), 12, drivers=inputs())
    setpoints = np.arange(16.0, 23.1, 0.5)
    held = [results(f"constant:{c:g}", tiny(), 1, drivers=inputs())[0] for c in setpoints]
    best_c = setpoints[np.argmin([r.facility_kwh[0] for r in held])]
    assert kept[-1].setpoint_c[0] == pytest.approx(best_c)
    assert np.max(np.abs(np.diff(column(kept, "setpoint_c"), prepend=18.0))) < 2.0 + 1e-9


def test_all_agents_save_more_than_each() -> None:
    def carbon(spec: str) -> float:
        return float(column(results(spec, tiny(), 2 * DAY, drivers=inputs()), "carbon_g").sum())

    idle, whole = carbon("idle"), carbon("mpc-24h")
    alone = [carbon(f"{agent}=mpc-24h") for agent in ("load", "cooling", "battery")]
    assert whole < min(alone)
    assert max(alone) < idle


def test_cost_follows_prices_and_shaves_the_peak_of_the_month() -> None:
    tariff = ["tariff.price_per_kwh=0.1", "tariff.periods=[]", "tariff.demand_charge_per_kw=20"]
    demand = np.tile(np.repeat([0.3, 0.9], DAY // 2), 4)
    drivers = inputs(np.full(len(demand), 300.0), demand)

    def peak_kw(spec: str) -> float:
        kept = results(spec, tiny(*tariff), DAY, drivers=drivers)
        return float(column(kept, "grid_kwh").max())

    assert peak_kw("mpc-24h:cost") < 0.93 * peak_kw("mpc-24h")


# What it keeps to


@pytest.mark.parametrize(
    "overrides",
    [
        ("workload.flexible_share=0.6", "workload.queue_limit_h=0.5"),
        ("workload.flexible_share=0.6", "workload.deadline_h=2", "workload.max_utilisation=0.7"),
        ("workload.model=tasks", "battery.model=released", "hvac.setpoint.model=accelerating"),
        ("protection.ashrae_class=A1", "hvac.setpoint.initial_c=23", "battery.model=paper"),
        ("electrical.grid_limit_ratio=1.0",),
    ],
)
def test_work_is_conserved_and_limits_hold(overrides: tuple[str, ...]) -> None:
    rng = np.random.default_rng(1)
    drivers = inputs(SQUARE * rng.uniform(0.7, 1.3, len(SQUARE)), rng.uniform(0.2, 0.7, 4 * DAY))
    kept, idle = (
        results(s, tiny(*overrides), 2 * DAY, drivers=drivers) for s in ("mpc-24h", "idle")
    )
    assert column(kept, "dropped_tasks").sum() <= column(idle, "dropped_tasks").sum()
    assert not column(kept, "overdue_tasks").any()
    assert column(kept, "carbon_g").sum() < column(idle, "carbon_g").sum()
    if overrides and overrides[0].startswith("protection"):
        assert column(kept, "inlet_max_c").max() <= 32.0 + 1e-6
        assert not column(kept, "throttled_racks").any()


@pytest.mark.parametrize("preset", [("sustaindc",), ("corrected", "simulation.thermal=transient")])
def test_other_presets_save_carbon(preset: tuple[str, ...]) -> None:
    config = load_config(preset[0], ["name=dc", *preset[1:]])
    drivers = inputs() if preset[0] == "corrected" else None
    kept, idle = (results(spec, config, DAY, drivers=drivers) for spec in ("mpc-24h", "idle"))
    assert column(kept, "carbon_g").sum() < column(idle, "carbon_g").sum()
    assert not column(kept, "overdue_tasks").any()


# What it depends on


def mixed() -> list[DataCenterConfig]:
    return [
        tiny("site.location=NY", name="a"),
        tiny("site.location=CA", "workload.deadline_h=6", name="b"),
        tiny("site.location=AZ", "battery.capacity_kwh=0", "hvac.setpoint.max_c=21", name="c"),
    ]


@pytest.mark.parametrize("error", [ForecastError(), ForecastError(0.1, 1.0)])
def test_batch_equals_each_alone(error: ForecastError) -> None:
    together = results("mpc-24h", mixed(), 30, error=error)
    for dc, config in enumerate(mixed()):
        alone = results("mpc-24h", config, 30, error=error)
        for name in ("load_command", "cooling_command", "battery_command", "carbon_g"):
            np.testing.assert_array_equal(column(together, name, dc), column(alone, name), name)


def test_erring_forecasts_are_reproducible_and_matter() -> None:
    error = ForecastError(0.3, 3.0)
    runs = [
        column(results("mpc-24h", tiny(), 40, error=error, seed=seed), "carbon_g")
        for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.any(runs[0] != runs[2])


def expected(demand: np.ndarray, now: int, hours: float) -> np.ndarray:
    drivers = inputs(ci=np.full(len(demand), 300.0), demand=demand)
    with Simulator(tiny(), drivers=drivers) as sim:
        sim.reset(0, start=np.array([now]))
        view = view_maker(sim)(None)
        return np.asarray(expected_demand(view, view.forecast(hours).index)[0])


def test_later_work_is_expected_as_on_the_last_days() -> None:
    of_day = np.random.default_rng(0).uniform(0.1, 0.8, DAY)
    days = np.tile(of_day, 9)
    now = 8 * DAY + 7
    np.testing.assert_allclose(expected(days, now, 30.0), np.resize(np.roll(of_day, -7), 120))
    level = np.repeat(np.linspace(-0.06, 0.06, 7), DAY)
    days[DAY : 8 * DAY] += level - level.mean()
    days[now - 8 * DAY :][: 7 * DAY] = days[DAY + 7 : now]
    usual = np.mean([days[now - k * DAY :][:DAY] for k in range(1, 8)], axis=0)
    days[now] += 0.1
    found = expected(days, now, 24.0)
    fading = (days[now] - usual[0]) * np.exp(-np.arange(DAY) / 12.0)
    np.testing.assert_allclose(found, usual + fading, rtol=1e-12)


def test_later_work_is_not_foreseen() -> None:
    """Work that nobody can know of changes nothing before it comes."""
    demand = np.full(4 * DAY, 0.5)
    other = demand.copy()
    other[20:DAY] = 0.9
    first, second = (
        results("mpc-24h", tiny(), 20, drivers=inputs(demand=d)) for d in (demand, other)
    )
    for name in ("load_command", "cooling_command", "battery_command"):
        np.testing.assert_array_equal(column(first, name), column(second, name))


def test_runs_do_not_depend_on_those_before() -> None:
    with Simulator(tiny(), drivers=inputs()) as sim:
        controller = make_controller("mpc-24h:cost", sim.fleet)
        runs = []
        for _ in range(2):
            kept: list[StepResult] = []
            simulate(sim, controller, 12, on_step=kept.append)
            runs.append(column(kept, "grid_kwh"))
    np.testing.assert_array_equal(runs[0], runs[1])


def test_environments_with_drawn_starts_and_years() -> None:
    others = "load=mpc-24h,battery=mpc-24h"
    options = EnvOptions(agents=("agent_dc",), days=1, start="sampled", years=(0, 1), others=others)

    def episode(core: Core, seed: int) -> F64:
        core.reset(seed)
        hold = {"agent_dc": np.ones(core.num_envs, dtype=np.int64)}
        return np.array([core.step(hold).result.grid_kwh for _ in range(6)])

    core = Core([tiny()], options, num_envs=2)
    episode(core, 5)
    second = episode(core, 9)
    core.close()
    fresh = Core([tiny()], options, num_envs=2)
    np.testing.assert_array_equal(episode(fresh, 9), second)
    fresh.close()


# Names


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("mpc-0h", r"valid is a horizon of 1\.\.168 h"),
        ("mpc-200h", r"valid is a horizon of 1\.\.168 h"),
        ("mpc-x", "valid is mpc-HOURSh or mpc-HOURSh:OBJECTIVE"),
        ("mpc", "valid is mpc-HOURSh"),
        ("mpc-nanh", "valid is mpc-HOURSh"),
        ("load=mpc-24", "valid is mpc-HOURSh"),
        ("mpc-24h:", "objective ''"),
        ("mpc-24h:coal", "objective 'coal'"),
        ("battery=mpc-24h:carbon+0.1*water", "water is not planned"),
    ],
)
def test_wrong_names(spec: str, message: str) -> None:
    fleet = build_fleet(tiny())
    with pytest.raises(ConfigError, match=message):
        make_controller(spec, fleet)
