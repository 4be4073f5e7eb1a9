"""Heat, work, energy, water and carbon close on every step of a year at every site."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

import reference_twin
from ledgers import LEDGERS, OF_LIQUID, TRANSIENT_LEDGERS, Run, quantities, residual, stocks
from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Drivers,
    Simulator,
    StepResult,
    View,
    drivers_from_arrays,
    load_config,
    make_configs,
    simulate,
)
from sdc_taichi.exogenous import site_names
from sdc_taichi.run.metrics import metrics_of_fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.sizing import air_j_per_m3_k
from sdc_taichi.types import F64

MONTHS = tuple(f"{month:02d}-01" for month in range(1, 13))
MONTH_STEPS = 31 * 96
"""Twelve runs of 31 days reach over the year, so one fleet does all of it at once."""

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")

TOLERANCE: dict[Precision, float] = {"f64": 1e-12, "f32": 1e-5}
PRECISIONS: tuple[Precision, ...] = ("f64", "f32")
SEASONS: dict[Precision, tuple[str, ...]] = {"f64": MONTHS, "f32": MONTHS[::3]}
STEPS: dict[Precision, int] = {"f64": MONTH_STEPS, "f32": MONTH_STEPS // 3}
"""Rounding in f32 shows in a third of a month of each season as well as in all twelve."""
TRANSIENT_STEPS = MONTH_STEPS // 3
"""Ten days of the months fill and empty what has thermal mass many times."""
THERMAL = ("quasi_steady", "transient")


def held(rng: np.random.Generator, steps: int, size: int, draw: Callable[[int], F64]) -> F64:
    """Commands that last for hours up to days, (steps, size): they fill and empty the stores."""
    columns = []
    for _ in range(size):
        lengths = rng.integers(1, 150, steps // 20)
        columns.append(np.repeat(draw(len(lengths)), lengths)[:steps])
    return np.stack(columns, axis=1)


def flow_balance(sim: Simulator, twins: list[reference_twin.HallTwin], result: StepResult) -> F64:
    """Heat that air carries out of each hall over its IT power, less 1, (B,).

    From R, the airflow that the servers' power and warming tell and the rack outlets: exhaust that
    no rack takes back and supply air that passes them by, against supply air.
    """
    fleet, layers, out = sim.fleet, sim.servers(), np.empty(sim.size)
    first = fleet.server_offsets[fleet.group_offsets[fleet.rack_offsets]]
    for i, twin in enumerate(twins):
        servers, racks = slice(first[i], first[i + 1]), slice(*fleet.rack_offsets[i : i + 2])
        inlet_c, outlet_c, power_w = (
            np.asarray(getattr(layers, name)[servers], dtype=np.float64)
            for name in ("inlet_c", "outlet_c", "power_w")
        )
        flow = power_w / (twin.air_j_per_m3_k * (outlet_c - inlet_c))
        speed = np.ones(1) * result.crac_flow_m3s[i] / twin.unit_design_m3s
        moved = reference_twin.flows(twin, flow, speed, speed)
        supply_c, outlets = result.supply_c[i : i + 1], result.rack_outlet_c[racks]
        return_c, left_over = reference_twin.return_air(
            twin, moved, twin.per_rack(flow), np.asarray(outlets, np.float64), supply_c
        )
        assert np.all(left_over > 0)
        assert return_c == pytest.approx(result.return_c[i], rel=1e-5)
        carried = twin.air_j_per_m3_k * moved.unit[0] * (return_c - supply_c[0])
        out[i] = carried / power_w.sum() - 1.0
    return out


def record(
    configs: list[DataCenterConfig],
    steps: int,
    drivers: Drivers | None,
    precision: Precision,
    *,
    watch_flows_every: int = 0,
) -> Run:
    rng = np.random.default_rng(7)
    size = len(configs)
    load, battery = (held(rng, steps, size, lambda n: rng.uniform(-1, 1, n).round(1)) for _ in "ab")
    cooling = rng.integers(-1, 2, (steps, size)).astype(np.float64)
    values: dict[str, F64] = {}
    # Halls of a site are alike.
    of_site = {config.site.location: config for config in configs if watch_flows_every}
    twins = [reference_twin.calibrated(of_site[c.site.location]) for c in configs if of_site]
    flows = []
    with Simulator(configs, precision=precision, drivers=drivers) as sim:
        state = sim.reset()
        start, battery_kwh = stocks(state), sim.sizing.battery_kwh
        for t in range(steps):
            result = sim.step(Actions(load[t], cooling[t], battery[t]))
            now = quantities(sim.fleet, result)
            if watch_flows_every and t % watch_flows_every == 0:
                flows.append(flow_balance(sim, twins, result))
            for name, value in now.items():
                if t == 0:
                    values[name] = np.empty((steps, size))
                values[name][t] = value
    air = air_j_per_m3_k(sim.fleet)
    counts_losses = configs[0].electrical.losses == "counted"
    return Run(
        values,
        start,
        sim.fleet.values,
        air,
        sim.step_h,
        counts_losses,
        np.array(flows),
        battery_kwh,
    )


def sites_and_seasons(
    overrides: list[str], sites: tuple[str, ...], starts: tuple[str, ...]
) -> list[DataCenterConfig]:
    """Sites in one run per start of the year."""
    base = load_config("corrected", overrides)
    configs = []
    for start in starts:
        site = base.site.model_copy(update={"start": start})
        for config in make_configs(base.model_copy(update={"site": site}), sites=sites):
            configs.append(config.model_copy(update={"name": f"{config.name}-{start}"}))
    return configs


@pytest.fixture(scope="module", params=PRECISIONS)
def year(request: pytest.FixtureRequest) -> tuple[Precision, Run]:
    """Every site through every step of the year."""
    configs = sites_and_seasons([], SITES, SEASONS[request.param])
    return request.param, record(
        configs, STEPS[request.param], None, request.param, watch_flows_every=149
    )


@pytest.fixture(scope="module", params=PRECISIONS)
def transient_year(request: pytest.FixtureRequest) -> tuple[Precision, Run]:
    """Run of transient halls, over ten days from each of several dates of the year."""
    overrides = ["simulation.thermal=transient"]
    configs = sites_and_seasons(overrides, SITES, SEASONS[request.param])
    return request.param, record(configs, TRANSIENT_STEPS, None, request.param)


def troubled(thermal: str) -> tuple[list[DataCenterConfig], int, Drivers]:
    """Units, chillers, fans and the grid fail; racks throttle and trip."""
    rng = np.random.default_rng(3)
    steps, size = 960, 6
    hour = np.arange(steps) / 4.0 % 24.0
    wet_bulb = 16.0 - 6.0 * np.cos(2 * np.pi * (hour - 3) / 24) + rng.uniform(-1, 1, (size, 1))
    demand = rng.uniform(0.2, 1.0, (size, steps))
    demand[:, 240:260] = 1.0
    drivers = drivers_from_arrays(
        wet_bulb + 6.0, wet_bulb, rng.uniform(50, 600, (size, steps)), demand
    )
    base = load_config(
        "corrected",
        [
            f"simulation.thermal={thermal}",
            "hvac.crac.units=2",
            "hvac.sizing.design_wet_bulb_c=10",
            "hvac.sizing.margin=1",
            "protection.ashrae_class=A1",
            "protection.trip_margin_k=2",
            "workload.queue_limit_h=1",
            "battery.hours_of_design_load=0.3",
            "electrical.losses=counted",
            "battery.initial_soc=0.5",
            "events.sampled=[{kind: crac_down, per_year: 400, duration_h: [0.5, 4]},"
            "{kind: chiller_derate, per_year: 300, duration_h: [0.5, 5], share: 0.4},"
            "{kind: rack_fan_failure, per_year: 1000, duration_h: [0.5, 6], share: 0.5},"
            "{kind: heat_wave, per_year: 200, duration_h: [1, 8], offset_k: 6},"
            "{kind: grid_outage, per_year: 300, duration_h: [0.25, 2]}]",
            # The last is an outage in weather that the facility was not designed for.
            "events.scheduled=[{kind: crac_down, start_h: 30, duration_h: 1},"
            "{kind: heat_wave, start_h: 61, duration_h: 4, offset_k: 20},"
            "{kind: grid_outage, start_h: 62, duration_h: 1}]",
        ],
    )
    return make_configs(base, count=size), steps, drivers


@cache
def run_of_trouble(thermal: str, precision: Precision) -> Run:
    return record(*troubled(thermal), precision)


@pytest.fixture(scope="module", params=[(p, t) for p in PRECISIONS for t in THERMAL])
def trouble(request: pytest.FixtureRequest) -> tuple[Precision, Run]:
    """Halls in trouble, steady and transient."""
    precision, thermal = request.param
    return precision, run_of_trouble(thermal, precision)


@pytest.fixture(scope="module", params=PRECISIONS)
def heat_wave(request: pytest.FixtureRequest) -> tuple[Precision, Run]:
    """Plants too small for hot afternoons at full load: heat stays in the room and leaves later."""
    return request.param, run_of_heat_wave(request.param)


@cache
def run_of_heat_wave(precision: Precision) -> Run:
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
            "electrical.losses=counted",
            "workload.queue_limit_h=1",
        ],
    )
    return record(make_configs(base, count=size), steps, drivers, precision)


@pytest.fixture(scope="module")
def failed() -> Run:
    """Transient halls in trouble, f64."""
    return run_of_trouble("transient", "f64")


def assert_closes(name: str, run: Run, tolerance: float, floor: float = 0.0) -> None:
    if name == "battery":
        # Charge and discharge include standby, whose rounding exceeds the last of a store.
        floor = max(floor, 1e-6)
    left = residual(LEDGERS[name](run), floor)
    step, dc = np.unravel_index(np.argmax(left), left.shape)
    assert left[step, dc] <= tolerance, f"{name}: {left[step, dc]:.2e} at step {step} of dc {dc}"


@pytest.mark.slow
@pytest.mark.parametrize("name", LEDGERS)
def test_ledger_closes_on_every_step_of_the_year(name: str, year: tuple[Precision, Run]) -> None:
    precision, run = year
    assert run["it_w"].shape == (STEPS[precision], len(SITES) * len(SEASONS[precision]))
    assert_closes(name, run, TOLERANCE[precision])


@pytest.mark.slow
def test_heat_leaves_with_the_air_all_year(year: tuple[Precision, Run]) -> None:
    precision, run = year
    assert run.flow_balance.shape == (
        -(-STEPS[precision] // 149),
        len(SITES) * len(SEASONS[precision]),
    )
    assert np.max(np.abs(run.flow_balance)) <= TOLERANCE[precision]


@pytest.mark.slow
@pytest.mark.parametrize("name", TRANSIENT_LEDGERS)
def test_ledger_closes_on_every_step_of_the_transient_year(
    name: str, transient_year: tuple[Precision, Run]
) -> None:
    precision, run = transient_year
    assert run["it_w"].shape == (TRANSIENT_STEPS, len(SITES) * len(SEASONS[precision]))
    assert_closes(name, run, TOLERANCE[precision])


@pytest.mark.slow
def test_sums_of_the_transient_year_close(transient_year: tuple[Precision, Run]) -> None:
    precision, run = transient_year
    assert np.all(run["thermal_storage_w"].min(axis=0) < -1e4)
    assert np.all(run["thermal_storage_w"].max(axis=0) > 1e4)
    generated = run.kwh("it_w").sum(axis=0) + run.kwh("crac_fan_w").sum(axis=0)
    removed = run.kwh("heat_removed_w").sum(axis=0)
    kept = run["room_heat_kwh"][-1] + run.kwh("thermal_storage_w").sum(axis=0)
    assert np.max(np.abs(generated - removed - kept) / generated) <= TOLERANCE[precision]
    # What servers and air have gained in a month is little against what has passed them.
    assert np.all(np.abs(run.kwh("thermal_storage_w").sum(axis=0)) < 1e-3 * generated)


@pytest.mark.parametrize("name", LEDGERS)
def test_ledger_closes_when_the_plant_is_too_small(
    name: str, heat_wave: tuple[Precision, Run]
) -> None:
    precision, run = heat_wave
    assert_closes(name, run, TOLERANCE[precision])


@pytest.mark.parametrize("name", LEDGERS)
def test_ledger_closes_through_failures(name: str, trouble: tuple[Precision, Run]) -> None:
    precision, run = trouble
    if name in TRANSIENT_LEDGERS or not np.any(run["thermal_storage_w"]):
        # Rounding in halls without power is rounding of what they do with it.
        assert_closes(name, run, TOLERANCE[precision], floor=1e-3)


def test_failures_leave_traces_in_every_store(trouble: tuple[Precision, Run]) -> None:
    _, run = trouble
    for name in ("tripped_racks", "throttled_racks", "lost_tasks", "dropped_tasks", "queue_tasks",
                 "room_heat_kwh", "recovered_w", "unmet_w"):  # fmt: skip
        assert np.all(run[name].max(axis=0) > 0), name
        assert np.all(np.isfinite(run[name]))
    assert np.all(run["grid_up"].min(axis=0) == 0)
    assert np.all(run["powered"].min(axis=0) < 1)
    for name in ("executed_tasks", "lost_tasks", "dropped_tasks", "grid_kwh", "unserved_kwh",
                 "it_w", "heat_removed_w"):  # fmt: skip
        assert run[name].min() >= -1e-9, name


# A term that is 0 in steady halls, and one for each that needs a failure.
LEFT_OUT = {
    "heat": 6, "cooling load": 4, "coils": 4, "server air": 2, "room air": 2, "cooling": 4,
    "rejected heat": 4, "work": 6, "queue": 5, "battery": 4, "battery loss": 5, "grid": 6,
    "hvac": 6, "water": 4, "blowdown": 3, "carbon": 2, "server power": 3, "rack CPU power": 2,
    "rack fan power": 2, "rack airflow": 2, "overhead": 4, "cost": 2,
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "left_out"),
    [
        pytest.param(name, i, id=f"{name}-{i}")
        for name, count in LEFT_OUT.items()
        for i in range(count)
    ],
)
def test_ledger_does_not_close_without_one_of_its_terms(
    name: str, left_out: int, heat_wave: tuple[Precision, Run], failed: Run
) -> None:
    precision, run = heat_wave
    terms = LEDGERS[name](run)
    if not np.any(terms[left_out]):
        terms, precision = LEDGERS[name](failed), "f64"
    without = [term for i, term in enumerate(terms) if i != left_out]
    assert np.max(residual(without)) > 100 * TOLERANCE[precision]


def test_every_term_of_every_ledger_is_left_out_once(heat_wave: tuple[Precision, Run]) -> None:
    counts = {name: len(ledger(heat_wave[1])) for name, ledger in LEDGERS.items()}
    # tests/test_liquid_halls.py leaves out the terms of liquid cooling.
    of_air = {name: count - OF_LIQUID.get(name, 0) for name, count in counts.items()}
    assert {name: count for name, count in of_air.items() if count} == LEFT_OUT


def test_heat_wave_stores_heat_and_gives_it_back(heat_wave: tuple[Precision, Run]) -> None:
    _, run = heat_wave
    assert np.all(run["room_heat_kwh"].max(axis=0) > 0), "nothing stored"
    assert np.all(run["recovered_w"].max(axis=0) > 0), "nothing recovered"
    assert np.all(run["room_heat_kwh"][-1] < 1e-9), "not recovered by the end"
    kj_per_k = run.fleet_values("room_heat_capacity_kj_per_k")
    # Servers in steady state warm with the room.
    kwh_per_k = (kj_per_k + run.fleet_values("server_heat_capacity_kj_per_k")) * 4000 / 3600
    warmed = run["supply_c"] - run["setpoint_c"]
    np.testing.assert_allclose(warmed, run.before("room_heat_kwh") / kwh_per_k, atol=1e-12)
    assert not np.any((run["unmet_w"] > 0) & (run["recovered_w"] > 0))


class _Defer:
    """Defers all that may wait."""

    def reset(self, seed: int) -> None:
        """Nothing is random here."""

    def act(self, view: View) -> Actions:
        return Actions(load=-1.0)


@pytest.mark.parametrize(
    ("model", "dropped_and_not_run"), [("fluid", 1.0), ("tasks", 1.0), ("released", 0.0)]
)
def test_work_of_a_run_adds_up_with_a_full_queue(model: str, dropped_and_not_run: float) -> None:
    values = [f"workload.model={model}", "workload.queue_limit_h=1"]
    with Simulator(load_config("tiny", values)) as sim:
        found = metrics_of_fleet(simulate(sim, _Defer(), 96), sim.fleet)
    arrived, executed, dropped, lost, queued = (
        float(found[f"{name}_tasks"] or 0.0)
        for name in ("arrived", "executed", "dropped", "lost", "queue_end")
    )
    assert dropped > 0
    assert queued > 0
    assert arrived == pytest.approx(executed + lost + queued + dropped_and_not_run * dropped)


@pytest.mark.slow
def test_sums_of_the_year_close(year: tuple[Precision, Run]) -> None:
    _, run = year
    work = np.sum([term.sum(axis=0) for term in LEDGERS["work"](run)[:4]], axis=0)
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
