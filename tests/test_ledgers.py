"""Heat, work, energy, water and carbon close on every step of a year at every site."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Drivers,
    Simulator,
    drivers_from_arrays,
    load_config,
    make_configs,
)
from sdc_taichi.exogenous import site_names
from sdc_taichi.hall import Precision
from sdc_taichi.types import F64

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
STARTS = ("01-01", "04-02", "07-02", "10-01")
QUARTER_STEPS = 92 * 96
"""Four runs of 92 days reach over the year, so one fleet does all of it at once."""

TOLERANCE: dict[Precision, float] = {"f64": 1e-12, "f32": 1e-5}
PRECISIONS: tuple[Precision, ...] = ("f64", "f32")


@dataclass(frozen=True)
class Run:
    """What a fleet did: every quantity of a step by name, (T, B), and the state before step 0."""

    values: dict[str, F64]
    start: dict[str, F64]
    fleet_values: Callable[[str], F64]
    step_h: float

    def __getitem__(self, name: str) -> F64:
        return self.values[name]

    def before(self, name: str) -> F64:
        """A stock at the start of each step, (T, B)."""
        return np.concatenate([self.start[name][None], self.values[name][:-1]])

    def kwh(self, name: str) -> F64:
        return self.values[name] * self.step_h / 1e3


def held(rng: np.random.Generator, steps: int, size: int, draw: Callable[[int], F64]) -> F64:
    """Commands that last for hours up to days, (steps, size): they fill and empty the stores."""
    columns = []
    for _ in range(size):
        lengths = rng.integers(1, 150, steps // 20)
        columns.append(np.repeat(draw(len(lengths)), lengths)[:steps])
    return np.stack(columns, axis=1)


def record(
    configs: list[DataCenterConfig], steps: int, precision: Precision, drivers: Drivers | None
) -> Run:
    rng = np.random.default_rng(7)
    size = len(configs)
    load, battery = (held(rng, steps, size, lambda n: rng.uniform(-1, 1, n).round(1)) for _ in "ab")
    cooling = rng.integers(-1, 2, (steps, size)).astype(np.float64)
    values: dict[str, F64] = {}
    with Simulator(configs, precision=precision, drivers=drivers) as sim:
        state = sim.reset()
        start = {
            "stored_kwh": state.stored_kwh,
            "room_heat_kwh": state.room_heat_kwh,
            "queue_tasks": state.queue[:, -1],
        }
        fleet = sim.fleet
        first = fleet.rack_start[:-1]
        v = fleet.values
        air = (v("hall.air_density_kg_m3") * v("hall.air_heat_capacity_j_per_kg_k"))[fleet.rack_dc]
        for t in range(steps):
            result = sim.step(Actions(load[t], cooling[t], battery[t]))
            rack_cpu, rack_fan, rack_flow, rack_in, rack_out = (
                getattr(result, f"rack_{name}").astype(np.float64)
                for name in ("cpu_w", "fan_w", "airflow_m3s", "inlet_c", "outlet_c")
            )
            now = result.per_dc() | {
                "racks_cpu_w": np.add.reduceat(rack_cpu, first),
                "racks_fan_w": np.add.reduceat(rack_fan, first),
                "racks_airflow_m3s": np.add.reduceat(rack_flow, first),
                "racks_air_w": np.add.reduceat(air * rack_flow * (rack_out - rack_in), first),
            }
            for name, value in now.items():
                if t == 0:
                    values[name] = np.empty((steps, size))
                values[name][t] = value
    return Run(values, start, fleet.values, sim.step_h)


@pytest.fixture(scope="module", params=PRECISIONS)
def year(request: pytest.FixtureRequest) -> tuple[Precision, Run]:
    """Every site through every step of the year, in four runs of a quarter each."""
    base = load_config("corrected")
    configs = []
    for start in STARTS:
        site = base.site.model_copy(update={"start": start})
        for config in make_configs(base.model_copy(update={"site": site}), sites=SITES):
            configs.append(config.model_copy(update={"name": f"{config.name}-{start}"}))
    return request.param, record(configs, QUARTER_STEPS, request.param, None)


@pytest.fixture(scope="module", params=PRECISIONS)
def heat_wave(request: pytest.FixtureRequest) -> tuple[Precision, Run]:
    """Plants too small for hot afternoons at full load: heat stays in the room and leaves later."""
    rng = np.random.default_rng(1)
    steps, size = 960, 6
    hour = np.arange(steps) / 4.0 % 24.0
    wet_bulb = 20.0 - 6.0 * np.cos(2 * np.pi * (hour - 3) / 24) + rng.uniform(-1, 1, (size, 1))
    afternoon = (hour >= 14) & (hour < 16)
    demand = np.where(afternoon, 1.0, rng.uniform(0.1, 0.6, (size, steps)))
    drivers = drivers_from_arrays(
        wet_bulb + 6.0, wet_bulb, rng.uniform(50, 600, (size, steps)), demand
    )
    base = load_config(
        "corrected",
        [
            "hvac.chiller.model=electric_water_cooled",
            "hvac.chiller.reference_cop=4.75",
            "hvac.sizing.margin=1",
            "hvac.sizing.design_wet_bulb_c=18",
            "workload.queue_limit_h=1",
        ],
    )
    return request.param, record(make_configs(base, count=size), steps, request.param, drivers)


Ledger = Callable[[Run], list[F64]]
"""The terms of a balance with their signs, each (T, B); they add up to zero."""

LEDGERS: dict[str, Ledger] = {
    "heat": lambda r: [
        r.kwh("it_w"),
        r.kwh("crac_fan_w"),
        -r.kwh("heat_removed_w"),
        r.before("room_heat_kwh"),
        -r["room_heat_kwh"],
    ],
    "cooling load": lambda r: [
        r["cooling_load_w"],
        -r["heat_removed_w"],
        -r["unmet_w"],
        r["recovered_w"],
    ],
    "server air": lambda r: [r["it_w"], -r["racks_air_w"]],
    "room air": lambda r: [
        r["it_w"],
        -r.fleet_values("hall.air_density_kg_m3")
        * r.fleet_values("hall.air_heat_capacity_j_per_kg_k")
        * r["crac_flow_m3s"]
        * (r["return_c"] - r["supply_c"]),
    ],
    "cooling": lambda r: [r["heat_removed_w"], -r["economiser_w"], -r["chiller_load_w"]],
    "rejected heat": lambda r: [r["rejected_w"], -r["heat_removed_w"], -r["chiller_w"]],
    "work": lambda r: [
        r["arrived_tasks"],
        -r["executed_tasks"],
        -r["dropped_tasks"],
        r.before("queue_tasks"),
        -r["queue_tasks"],
    ],
    "queue": lambda r: [
        r.before("queue_tasks"),
        r["deferred_tasks"],
        -r["drained_tasks"],
        r["overdue_tasks"] - r["due_tasks"],
        -r["queue_tasks"],
    ],
    "battery": lambda r: [
        r.before("stored_kwh"),
        r.fleet_values("battery.charge_efficiency") * r["charge_kwh"],
        -r.fleet_values("battery.discharge_factor") * r["discharge_kwh"],
        -r["stored_kwh"],
    ],
    "battery loss": lambda r: [
        r.before("stored_kwh"),
        r["charge_kwh"],
        -r["discharge_kwh"],
        -r["battery_loss_kwh"],
        -r["stored_kwh"],
    ],
    "grid": lambda r: [
        r["grid_kwh"],
        -r.kwh("it_w"),
        -r.kwh("hvac_w"),
        -r["charge_kwh"],
        r["discharge_kwh"],
    ],
    "hvac": lambda r: [
        r["hvac_w"],
        -r["chiller_w"],
        -r["tower_fan_w"],
        -r["chilled_pump_w"],
        -r["condenser_pump_w"],
        -r["crac_fan_w"],
    ],
    "water": lambda r: [r["water_l"], -r["evaporation_l"], -r["drift_l"], -r["blowdown_l"]],
    "blowdown": lambda r: [
        r["evaporation_l"] / (r.fleet_values("hvac.water.cycles_of_concentration") - 1.0),
        -r["drift_l"],
        -r["blowdown_l"],
    ],
    "carbon": lambda r: [r["carbon_g"], -r["grid_kwh"] * r["ci_g_per_kwh"]],
    "server power": lambda r: [r["it_w"], -r["cpu_w"], -r["it_fan_w"]],
    "rack CPU power": lambda r: [r["cpu_w"], -r["racks_cpu_w"]],
    "rack fan power": lambda r: [r["it_fan_w"], -r["racks_fan_w"]],
    "rack airflow": lambda r: [r["it_airflow_m3s"], -r["racks_airflow_m3s"]],
}


def residual(terms: list[F64]) -> F64:
    """What is left over the largest term, (T, B)."""
    total = np.sum(terms, axis=0)
    largest = np.max(np.abs(terms), axis=0)
    return np.asarray(np.abs(total) / np.where(largest > 0, largest, 1.0))


def assert_closes(name: str, run: Run, tolerance: float) -> None:
    left = residual(LEDGERS[name](run))
    step, dc = np.unravel_index(np.argmax(left), left.shape)
    assert left[step, dc] <= tolerance, f"{name}: {left[step, dc]:.2e} at step {step} of dc {dc}"


@pytest.mark.slow
@pytest.mark.parametrize("name", LEDGERS)
def test_ledger_closes_on_every_step_of_the_year(name: str, year: tuple[Precision, Run]) -> None:
    precision, run = year
    assert run["it_w"].shape == (QUARTER_STEPS, len(SITES) * len(STARTS))
    assert_closes(name, run, TOLERANCE[precision])


@pytest.mark.parametrize("name", LEDGERS)
def test_ledger_closes_when_the_plant_is_too_small(
    name: str, heat_wave: tuple[Precision, Run]
) -> None:
    precision, run = heat_wave
    assert_closes(name, run, TOLERANCE[precision])


@pytest.mark.parametrize(
    ("name", "left_out"),
    [
        pytest.param(name, i, id=f"{name}-{i}")
        for name, count in {
            "heat": 5, "cooling load": 4, "server air": 2, "room air": 2, "cooling": 3,
            "rejected heat": 3, "work": 5, "queue": 5, "battery": 4, "battery loss": 5, "grid": 5,
            "hvac": 6, "water": 4, "blowdown": 3, "carbon": 2, "server power": 3,
            "rack CPU power": 2, "rack fan power": 2, "rack airflow": 2,
        }.items()
        for i in range(count)
    ],
)  # fmt: skip
def test_ledger_does_not_close_without_one_of_its_terms(
    name: str, left_out: int, heat_wave: tuple[Precision, Run]
) -> None:
    precision, run = heat_wave
    terms = LEDGERS[name](run)
    without = [term for i, term in enumerate(terms) if i != left_out]
    assert np.max(residual(without)) > 100 * TOLERANCE[precision]


def test_every_term_of_every_ledger_is_left_out_once(heat_wave: tuple[Precision, Run]) -> None:
    marks = test_ledger_does_not_close_without_one_of_its_terms.pytestmark  # type: ignore[attr-defined]
    tried = {tuple(case.values) for case in marks[0].args[1]}
    terms = {(name, i) for name in LEDGERS for i in range(len(LEDGERS[name](heat_wave[1])))}
    assert tried == terms


def test_heat_wave_stores_heat_and_gives_it_back(heat_wave: tuple[Precision, Run]) -> None:
    _, run = heat_wave
    assert np.all(run["room_heat_kwh"].max(axis=0) > 0), "nothing stored"
    assert np.all(run["recovered_w"].max(axis=0) > 0), "nothing recovered"
    assert np.all(run["room_heat_kwh"][-1] < 1e-9), "not recovered by the end"
    kwh_per_k = run.fleet_values("hall.room_heat_capacity_kj_per_k_per_server") * 4000 / 3600
    warmed = run["supply_c"] - run["setpoint_c"]
    np.testing.assert_allclose(warmed, run.before("room_heat_kwh") / kwh_per_k, atol=1e-12)
    assert not np.any((run["unmet_w"] > 0) & (run["recovered_w"] > 0))


@pytest.mark.slow
def test_sums_of_the_year_close(year: tuple[Precision, Run]) -> None:
    _, run = year
    work = np.sum([term.sum(axis=0) for term in LEDGERS["work"](run)[:3]], axis=0)
    arrived = run["arrived_tasks"].sum(axis=0)
    assert np.max(np.abs(work - run["queue_tasks"][-1]) / arrived) <= 1e-12
    generated = run.kwh("it_w").sum(axis=0) + run.kwh("crac_fan_w").sum(axis=0)
    kept = run["room_heat_kwh"][-1]
    removed = run.kwh("heat_removed_w").sum(axis=0)
    assert np.max(np.abs(generated - removed - kept) / generated) <= 1e-12
    charge, discharge = run["charge_kwh"].sum(axis=0), run["discharge_kwh"].sum(axis=0)
    assert np.all((discharge > 100) & (charge > discharge))
    lost = run["battery_loss_kwh"].sum(axis=0)
    assert np.max(np.abs(charge - discharge - lost - run["stored_kwh"][-1]) / charge) <= 1e-11


@pytest.mark.slow
def test_year_visits_the_corners(year: tuple[Precision, Run]) -> None:
    _, run = year
    assert set(SITES) <= {name.upper() for name in site_names()}
    per_site = {
        name: run[name].reshape(QUARTER_STEPS, len(STARTS), len(SITES)) for name in run.values
    }
    assert np.any(run["dropped_tasks"] > 0)
    for name in ("due_tasks", "drained_tasks", "charge_kwh", "discharge_kwh", "chiller_w",
                 "economiser_w", "tower_fan_w"):  # fmt: skip
        per_site = run[name].reshape(-1, len(SITES)).max(axis=0)
        assert np.all(per_site > 0), name
    assert np.all(run["grid_kwh"] >= 0)
    assert np.all((run["soc"] >= 0) & (run["soc"] <= 1))
    assert np.all(run["soc"].max(axis=0) > 0.9)
    assert np.all((run["utilisation"] >= 0) & (run["utilisation"] <= 1))
    assert np.all((run["setpoint_c"] >= 16) & (run["setpoint_c"] <= 23))
    assert np.all(np.ptp(run["setpoint_c"], axis=0) == 7)
    assert all(np.all(np.isfinite(values)) for values in run.values.values())
