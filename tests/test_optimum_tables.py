"""Tables of what a step costs: they are the simulator's own steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sdc_taichi import Actions, Simulator, build_fleet, load_config
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import OddInputWarning
from sdc_taichi.optimum import tables
from sdc_taichi.optimum.facility_map import FacilityMap, facility_map
from sdc_taichi.optimum.problem import no_table_reasons, uncooled_reason
from sdc_taichi.optimum.tables import (
    FacilityTable,
    Nodes,
    facility_tables,
)
from sdc_taichi.sim.drivers import Drivers, FleetSeries, load_drivers

JULY = "site.start=07-01"
GRID: dict[str, Any] = {"utilisations": 3, "setpoint_step_k": 4.0}
CASES = {
    "tiny": ("tiny", JULY),
    "corrected": ("corrected", JULY),
    "paper": ("paper", JULY),
    "sustaindc": (
        "sustaindc",
        "workload.model=fluid",
        "workload.max_utilisation=1",
        "hvac.setpoint.model=symmetric",
    ),
    "hall_of_2026": ("hall_of_2026", "protection.ashrae_class=null"),
    "air_cooled": (
        "tiny",
        "hvac.plant=air_cooled",
        "hvac.chiller.model=electric_air_cooled",
    ),
    "air_side": (
        "tiny",
        "hvac.plant=air_side",
        "hvac.chiller.model=electric_air_cooled",
        "site.start=04-01",
    ),
    "counted": ("corrected", "electrical.losses=counted"),
    "return_air": (
        "corrected",
        "hvac.crac.temperature_control=return",
        "hvac.setpoint.min_c=30",
        "hvac.setpoint.max_c=38",
        "hvac.setpoint.initial_c=34",
    ),
    "fill": ("tiny", "workload.placement=fill"),
    "pressure": ("corrected", "hvac.crac.flow_model=pressure", "hvac.crac.units=2"),
    "hottest_inlet": ("corrected", "hvac.crac.flow_model=hottest_inlet"),
    "constant": ("corrected", "hvac.crac.flow_model=constant"),
}


def at_demand(drivers: Drivers, demand: float) -> Drivers:
    """Inputs with the same work in every step."""
    size = drivers.size
    whole = np.ones(size, np.int64)
    return replace(drivers, demand=FleetSeries(np.array([demand]), 0 * whole, whole))


def config_of(case: str) -> DataCenterConfig:
    preset, *overrides = CASES[case]
    return load_config(preset, overrides)


@pytest.mark.parametrize("case", CASES)
def test_entries_are_what_the_simulator_does(case: str) -> None:
    config = config_of(case)
    drivers, fleet = load_drivers([config]), build_fleet(config)
    assert no_table_reasons(fleet) == (None,)
    start, steps = drivers.start + 40, 3
    (table,) = facility_tables(fleet, drivers, start=start, steps=steps, **GRID, precision="f64")
    assert np.all(table.unmet_w == 0)
    with Simulator(fleet, drivers=drivers, precision="f64") as sim:
        for i, level in enumerate(table.utilisation):
            for j, setpoint_c in enumerate(table.setpoint_c):
                sim.reset(start=start, drivers=at_demand(drivers, float(level)))
                for t in range(steps):
                    moves = (setpoint_c - sim.state.setpoint_c) / config.hvac.setpoint.step_k
                    result = sim.step(Actions(cooling=moves))
                    at = t, i, j
                    assert result.facility_kwh[0] == pytest.approx(table.facility_kwh[at], rel=1e-9)
                    assert result.water_l[0] == pytest.approx(table.water_l[at], rel=1e-9)
                    assert result.inlet_max_c[0] == pytest.approx(table.inlet_max_c[at], rel=1e-9)


def test_a_data_center_has_the_same_table_alone_and_beside_others() -> None:
    configs = [
        load_config("tiny", [JULY, "site.location=CA"]),
        load_config("tiny", [JULY, "hvac.setpoint.max_c=20"]),
        load_config("tiny", [JULY, "site.location=CA", "name=twin"]),
    ]
    drivers = load_drivers(configs)
    start = drivers.start
    together = facility_tables(build_fleet(configs), drivers, start=start, steps=2, **GRID)
    assert together[0] is together[2]
    assert [len(t.setpoint_c) for t in together] == [3, 2, 3]
    for config, found in zip(configs, together, strict=True):
        own = load_drivers([config])
        (alone,) = facility_tables(build_fleet(config), own, start=own.start, steps=2, **GRID)
        assert np.array_equal(alone.facility_kwh, found.facility_kwh)
        assert np.array_equal(alone.water_l, found.water_l)


def test_tables_are_fine_enough_between_their_nodes() -> None:
    counts = []
    for preset in ("corrected", "hall_of_2026"):
        config = load_config(preset, [])
        fleet, drivers = build_fleet(config), load_drivers([config])
        start = drivers.start
        (table,) = facility_tables(fleet, drivers, start=start, steps=2, setpoint_step_k=10.0)
        counts.append(len(table.utilisation))
        spacing = table.utilisation[1]
        midway = np.arange(0.2, 0.9, 0.1) // spacing * spacing + spacing / 2
        outdoor_c, wet_bulb_c = (
            series.at(start[:, None] + np.arange(2))
            for series in (drivers.outdoor_c, drivers.wet_bulb_c)
        )
        (exact,) = tables.tabulate(
            fleet, drivers, [Nodes(0, midway, table.setpoint_c)], outdoor_c, wet_bulb_c, "f32"
        )
        for kwh, expected in zip(table.facility_kwh[0].T, exact.facility_kwh[0].T, strict=True):
            read = np.interp(midway, table.utilisation, kwh)
            assert read == pytest.approx(expected, rel=2e-3)
            assert read.mean() == pytest.approx(expected.mean(), rel=2e-4)
    assert counts[0] < counts[1]


def test_entries_in_which_racks_throttle_are_barred() -> None:
    config = load_config("tiny", ["hvac.setpoint.max_c=32", "protection.ashrae_class=A1"])
    drivers = load_drivers([config])
    (table,) = facility_tables(build_fleet(config), drivers, start=drivers.start, steps=1, **GRID)
    assert np.array_equal(np.isinf(table.unmet_w), table.inlet_max_c > 32.0)
    assert 0 < np.isinf(table.unmet_w).sum() < table.unmet_w.size


def test_heat_that_the_plant_leaves_is_in_the_table() -> None:
    config = load_config("corrected", ["hvac.crac.capacity_kw=300"])
    drivers = load_drivers([config])
    with pytest.warns(OddInputWarning, match="take out 300 kW"):
        fleet = build_fleet(config)
    (table,) = facility_tables(fleet, drivers, start=drivers.start, steps=1, **GRID)
    assert table.unmet_w[0, -1].min() > 0
    assert np.all(table.unmet_w[0, 0] == 0)


@pytest.mark.parametrize(
    "override",
    [
        "simulation.thermal=transient",
        "events.scheduled=[{kind: heat_wave, start_h: 1, duration_h: 2, offset_k: 5}]",
        "events.sampled=[{kind: grid_outage, per_year: 2, duration_h: [1, 2]}]",
        "workload.placement=coolest-first",
        "workload.placement=inlet-aware",
        "workload.placement=weights",
        "hvac.crac.flow_model=controlled",
    ],
)
def test_tables_of_some_data_centers_are_not_exact(override: str) -> None:
    (reason,) = no_table_reasons(build_fleet(load_config("corrected", [override])))
    assert reason


def test_loads_that_no_setpoint_cools_are_told() -> None:
    utilisation = np.array([0.0, 0.5, 1.0])
    unmet_w = np.zeros((3, 3, 2))
    unmet_w[:, 2] = 5.0
    unmet_w[2, 1] = 5.0, 0.0
    ones = np.ones_like(unmet_w)
    table = FacilityTable(utilisation, np.array([16.0, 20.0]), ones, ones, ones, unmet_w)
    assert uncooled_reason(table, np.array([0.1, 0.4, 0.5])) is None
    told = uncooled_reason(table, np.array([0.1, 0.9, 0.6]))
    assert told is not None
    assert "2 of 3 steps" in told


def a_map(configs: list[DataCenterConfig], **options: Any) -> tuple[FacilityMap, Drivers]:
    fleet, drivers = build_fleet(configs), load_drivers(configs)
    options = {"inlet_limit_c": np.full(len(configs), np.inf)} | options
    return facility_map(
        fleet, drivers, utilisations=3, setpoint_step_k=4.0, weather_step_k=10.0, **options
    ), drivers


@pytest.mark.parametrize("plant", ["water_cooled", "air_side"])
def test_a_map_has_the_simulators_figures_at_its_nodes(plant: str) -> None:
    chiller = {"water_cooled": "centrifugal_vsd", "air_side": "electric_air_cooled"}[plant]
    config = load_config("tiny", [f"hvac.plant={plant}", f"hvac.chiller.model={chiller}"])
    found, drivers = a_map([config], precision="f64")
    lead_c = found.first_c[0] + 10.0 * np.arange(found.facility_kwh.shape[1])
    below_k = 2 * found.depression_step_k[0]
    outdoor_c = lead_c + below_k if plant == "water_cooled" else lead_c
    still = np.zeros(1, np.int64)
    for node, outside_c in enumerate(outdoor_c):
        outdoor, wet_bulb = (
            FleetSeries(np.array([value_c]), still, still + 1)
            for value_c in (outside_c, outside_c - below_k)
        )
        (table,) = facility_tables(
            build_fleet(config),
            replace(drivers, outdoor_c=outdoor, wet_bulb_c=wet_bulb),
            start=still,
            steps=1,
            **GRID,
            precision="f64",
        )
        assert found.facility_kwh[0, node, 2] == pytest.approx(table.facility_kwh[0], rel=1e-9)


@pytest.mark.parametrize("plant", ["water_cooled", "air_side"])
def test_a_data_center_has_the_same_map_alone_and_beside_others(plant: str) -> None:
    chiller = {"water_cooled": "centrifugal_vsd", "air_side": "electric_air_cooled"}[plant]
    shared = [f"hvac.plant={plant}", f"hvac.chiller.model={chiller}"]
    configs = [
        load_config("tiny", [*shared, *own])
        for own in (["site.location=WA"], ["site.location=AZ", "hvac.setpoint.max_c=30"])
    ]
    together, _ = a_map(configs)
    outdoor_c = np.array([[-40.0, -3.0, 12.0, 33.0, 60.0]] * 2)
    wet_bulb_c = outdoor_c - np.array([0.0, 1.5, 7.0, 18.0, 50.0])
    level = np.full(outdoor_c.shape, 0.3)
    best_c = together.best_setpoint_c(level, outdoor_c, wet_bulb_c)
    places = together.places_of_weather(outdoor_c, wet_bulb_c)
    for dc, config in enumerate(configs):
        alone, _ = a_map([config])
        own = slice(dc, dc + 1)
        at = outdoor_c[own], wet_bulb_c[own]
        assert np.array_equal(alone.best_setpoint_c(level[own], *at), best_c[own])
        for one, of_all in zip(alone.places_of_weather(*at), places, strict=True):
            assert np.array_equal(one, of_all[own])
        assert np.array_equal(alone.least_kwh[0], together.at_own_nodes(together.least_kwh)[dc])


def test_the_best_setpoint_of_a_map_is_that_of_least_energy() -> None:
    found_c = []
    for limit_c in (np.inf, 23.0):
        found, _ = a_map([load_config("corrected", [])], inlet_limit_c=np.array([limit_c]))
        wet_bulb_c = found.first_c[0] + 10.0 * np.arange(found.facility_kwh.shape[1])[None]
        best_c = found.best_setpoint_c(np.full(wet_bulb_c.shape, 0.5), wet_bulb_c, wet_bulb_c)
        kwh = np.where(found.allowed, found.facility_kwh, np.inf)[0, :, 0, 1]
        assert np.array_equal(best_c[0], found.setpoint_c[0, kwh.argmin(axis=-1)])
        found_c.append(best_c)
    free_c, limited_c = found_c
    assert np.any(limited_c < free_c)
