"""Tables of what a step costs: they are the simulator's own steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sdc_taichi import Actions, Simulator, build_fleet, load_config
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, OddInputWarning
from sdc_taichi.optimum import tables
from sdc_taichi.optimum.tables import TableGrid, facility_tables
from sdc_taichi.sim.drivers import Drivers, FleetSeries, load_drivers

JULY = "site.start=07-01"
GRID = TableGrid(utilisations=3, setpoint_step_k=4.0)
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
    start, steps = drivers.start + 40, 3
    (table,) = facility_tables(fleet, drivers, start=start, steps=steps, grid=GRID, precision="f64")
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
    together = facility_tables(build_fleet(configs), drivers, start=start, steps=2, grid=GRID)
    assert together[0] is together[2]
    assert [len(t.setpoint_c) for t in together] == [3, 2, 3]
    for config, found in zip(configs, together, strict=True):
        own = load_drivers([config])
        (alone,) = facility_tables(build_fleet(config), own, start=own.start, steps=2, grid=GRID)
        assert np.array_equal(alone.facility_kwh, found.facility_kwh)
        assert np.array_equal(alone.water_l, found.water_l)


def test_batches_of_any_size_give_the_same_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    configs = [load_config("tiny", [JULY, f"site.location={site}"]) for site in ("NY", "CA", "AZ")]
    fleet, drivers = build_fleet(configs), load_drivers(configs)
    whole = facility_tables(fleet, drivers, start=drivers.start, steps=2, grid=GRID)
    monkeypatch.setattr(tables, "MOST_COPIES", 9)
    seen: list[tuple[int, int]] = []
    parts = facility_tables(
        fleet,
        drivers,
        start=drivers.start,
        steps=2,
        grid=GRID,
        on_step=lambda done, of: seen.append((done, of)),
    )
    assert seen == [(n, 6) for n in range(1, 7)]
    for one, other in zip(whole, parts, strict=True):
        assert np.array_equal(one.facility_kwh, other.facility_kwh)


def test_a_table_is_given_up_when_it_is_told_to() -> None:
    config = load_config("tiny", [])
    drivers = load_drivers([config])
    found = facility_tables(
        build_fleet(config), drivers, start=drivers.start, steps=5, grid=GRID, stop=lambda: True
    )
    assert found == []


def test_entries_in_which_racks_throttle_are_barred() -> None:
    config = load_config("tiny", ["hvac.setpoint.max_c=32", "protection.ashrae_class=A1"])
    drivers = load_drivers([config])
    (table,) = facility_tables(
        build_fleet(config), drivers, start=drivers.start, steps=1, grid=GRID
    )
    assert np.array_equal(np.isinf(table.unmet_w), table.inlet_max_c > 32.0)
    assert 0 < np.isinf(table.unmet_w).sum() < table.unmet_w.size


def test_heat_that_the_plant_leaves_is_in_the_table() -> None:
    config = load_config("corrected", ["hvac.crac.capacity_kw=300"])
    drivers = load_drivers([config])
    with pytest.warns(OddInputWarning, match="take out 300 kW"):
        fleet = build_fleet(config)
    (table,) = facility_tables(fleet, drivers, start=drivers.start, steps=1, grid=GRID)
    assert table.unmet_w[0, -1].min() > 0
    assert np.all(table.unmet_w[0, 0] == 0)


@pytest.mark.parametrize(
    "values", [{"utilisations": 1}, {"setpoint_step_k": 0.0}, {"setpoint_step_k": float("nan")}]
)
def test_a_grid_without_nodes_is_an_error(values: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="table: "):
        TableGrid(**values)  # type: ignore[arg-type]
