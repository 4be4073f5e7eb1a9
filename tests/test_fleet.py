"""Fleets: flat arrays with offsets, copies over sites, sampling, and what all must share."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi import (
    ConfigError,
    DataCenterConfig,
    Simulator,
    build_fleet,
    drivers_from_arrays,
    load_config,
    make_configs,
)
from sdc_taichi.config import apply_overrides, config_from_dict
from sdc_taichi.exogenous import standard_pressure_pa
from sdc_taichi.kernels.hall_arguments import DC_COEFFICIENTS, GROUP_INPUTS
from sdc_taichi.plant.water_side import WaterSideDesign
from sdc_taichi.sim.fleet_configs import locations
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions

TINY = load_config("tiny")


def named(config: DataCenterConfig, name: str, *changes: str) -> DataCenterConfig:
    changed = apply_overrides(config, list(changes)) if changes else config
    return changed.model_copy(update={"name": name})


def ragged() -> list[DataCenterConfig]:
    """Four mixed racks, one rack of one server, three plain racks of different size."""
    return [
        TINY,
        named(TINY, "one", "hall.rows=1", "hall.racks_per_row=1", "hall.supply_approach_k=6",
              "hall.return_approach_k=-3", "servers.groups=[[{count: 1, full_w: 99, idle_w: 9}]]"),
        named(load_config("corrected"), "plain", "hall.rows=3", "hall.racks_per_row=1",
              "hall.inlet_model=approach",
              "hall.supply_approach_k=[1, 2, 9]", "hall.supply_approach_limits_k=[1.5, 5]",
              "hall.return_approach_k=-3", "servers.power_w=[[100, 10], [200, 20], [300, 30]]",
              "hall.servers_per_rack=[5, 6, 7]"),
    ]  # fmt: skip


def test_offsets_of_a_ragged_fleet() -> None:
    fleet = build_fleet(ragged())
    assert fleet.names == ("tiny", "one", "plain")
    assert (fleet.size, fleet.racks, fleet.servers) == (3, 8, 12 + 1 + 18)
    assert fleet.rack_offsets.tolist() == [0, 4, 5, 8]
    assert fleet.rack_dc.tolist() == [0, 0, 0, 0, 1, 2, 2, 2]
    assert fleet.group_offsets.tolist() == [0, 1, 3, 4, 7, 8, 9, 10, 11]
    assert np.diff(fleet.server_offsets).tolist() == [3, 2, 1, 3, 1, 1, 1, 1, 5, 6, 7]
    assert fleet.per_dc_servers().tolist() == [12, 1, 18]
    assert np.bincount(fleet.server_rack()).tolist() == [3, 3, 3, 3, 1, 5, 6, 7]
    assert fleet.approach_k.tolist() == [5.3, 5.0, 4.0, 4.5, 6.0, 1.5, 2.0, 5.0]
    row = dict(zip(GROUP_INPUTS, np.concatenate(fleet.group_rows, axis=1), strict=False))
    assert row["count"].tolist() == np.diff(fleet.server_offsets).tolist()
    assert row["full_w"].tolist()[-3:] == [100, 200, 300]
    assert row["idle_w"].tolist()[-3:] == [10, 20, 30]
    assert row["inlet_offset_k"].tolist() == [0, -0.2, 0.4, 0, -0.3, 0, 0.3, 0, 0, 0, 0]
    mean = (2 * 1.2 + 0.6) / 3
    np.testing.assert_allclose(row["load_deviation"][1:3], [1.2 / mean - 1, 0.6 / mean - 1])
    weighted = np.add.reduceat(row["count"] * row["load_deviation"], fleet.group_offsets[:-1])
    np.testing.assert_allclose(weighted, 0.0, atol=1e-15)
    for offsets in (fleet.rack_offsets, fleet.group_offsets, fleet.server_offsets, fleet.rack_dc):
        assert offsets.dtype == np.int32


def test_parameters_of_each_data_center_reach_the_kernel() -> None:
    straight = ["servers.cpu_power_points=null", "servers.fan_airflow_points=null"]
    configs = [
        named(TINY, "a", *straight),
        named(TINY, "b", "servers.fan_power_exponent=2.5", "servers.fan_reference_w=7",
              "servers.fan_full_airflow_m3s=0.04", "servers.fan_airflow_ratio_limits=null",
              "hall.air_density_kg_m3=1.1"),
    ]  # fmt: skip
    row = dict(zip(DC_COEFFICIENTS, build_fleet(configs).dcs, strict=True))
    np.testing.assert_allclose(row["cpu_slope_per_k"], [1 / 600, 0.0])
    np.testing.assert_allclose(row["cpu_offset"], [-1 / 60, 0.01])
    np.testing.assert_allclose(row["cpu_shift"], [0.99, 0.99 - 15 * 0.04 / 30])
    np.testing.assert_allclose(row["fan_slope_per_k"], [0.215 / 12, 0.0])
    np.testing.assert_allclose(row["fan_offset"], [0.225 - 28 * 0.215 / 12, -0.38])
    np.testing.assert_allclose(row["fan_shift"], [0.215, 0.24])
    assert row["fan_low"].tolist() == [0.2, 0.0]
    assert row["fan_high"].tolist() == [0.62, np.inf]
    assert row["fan_exponent"].tolist() == [3.0, 2.5]
    assert row["fan_reference_w"].tolist() == [10.0, 7.0]
    assert row["fan_full_m3s"].tolist() == [0.03, 0.04]
    rho = float(standard_pressure_pa(3.4)) / (287.05 * 293.15)
    np.testing.assert_allclose(row["air_j_per_m3_k"], [rho * 1006, 1.1 * 1006])


def test_values_of_a_field() -> None:
    fleet = build_fleet(
        [TINY, named(TINY, "b", "workload.deadline_h=null", "battery.capacity_kwh=5")]
    )
    assert fleet.values("hvac.setpoint.max_c").tolist() == [23, 23]
    assert np.array_equal(fleet.values("workload.deadline_h"), [24, np.nan], equal_nan=True)
    assert np.array_equal(fleet.values("battery.capacity_kwh"), [np.nan, 5], equal_nan=True)
    assert fleet.values("hvac.tower.economiser").tolist() == [1, 1]


@pytest.mark.parametrize(
    "change",
    [
        "servers.outlet_model=rack",
        "hvac.setpoint.model=accelerating",
        "hvac.crac.flow_model=constant",
        "hvac.cooling_load_model=paper",
        "hvac.chiller.model=eir_york",
        "hvac.tower.model=released",
        "hvac.pumps.model=released",
        "hvac.water.model=paper",
        "hvac.sizing.model=released",
        "battery.model=paper",
        "workload.model=tasks",
        "simulation.steps_per_hour=1",
        "hvac.total_of=[chiller]",
        "workload.age_horizon_h=48",
    ],
)
def test_what_a_fleet_must_share(change: str) -> None:
    path = change.split("=")[0]
    with pytest.raises(
        ConfigError, match=f"fleet: {re.escape(path)} is .* in tiny and .* in other"
    ):
        build_fleet([TINY, named(TINY, "other", change)])


def test_smallest_lift_is_a_field_of_its_own() -> None:
    base = load_config("corrected")
    configs = [named(base, str(lift), f"hvac.chiller.min_lift_k={lift}") for lift in (6.0, 30.0)]
    year = [20.0], [15.0], [300.0], [0.9]
    with Simulator(configs, drivers=drivers_from_arrays(*year, size=2)) as sim:
        sim.reset()
        low, high = sim.step().chiller_w
        towers = sim.sizing.water_side.rejected_w
    assert high > 1.1 * low > 0
    assert towers[1] > towers[0]


def test_fleets_that_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="no data center given"):
        build_fleet([])
    with pytest.raises(ConfigError, match="'tiny' is used twice"):
        build_fleet([TINY, TINY]).require_distinct_names()
    monkeypatch.setattr("sdc_taichi.sim.fleet.MOST_ENTRIES", 6000)
    huge = named(TINY, "huge", "servers.groups=[[{count: 2000, full_w: 25, idle_w: 9}]]")
    with pytest.raises(ConfigError, match="8000 servers; valid is at most 6,000"):
        build_fleet(huge)
    half = [named(huge, name, "servers.groups.0.0.count=1000") for name in "ab"]
    with pytest.raises(ConfigError, match="fleet: 8,000 servers; valid is at most"):
        build_fleet(half)


def test_approach_temperatures_are_those_that_the_hall_has(tmp_path: Path) -> None:
    np.savez(tmp_path / "r.npz", R=np.full((20, 20), 0.01))
    matrix = [f"hall.recirculation.matrix_file={tmp_path / 'r.npz'}",
              "hall.recirculation.calibrate=none"]  # fmt: skip
    by_rack = ["hall.recirculation.calibrate=rack"]
    for changes in (by_rack, ["hall.layout.containment=0.6", "hvac.crac.units=2"], matrix):
        config = load_config("corrected", changes)
        fleet = build_fleet(config)
        met = Conditions(np.full(fleet.units, config.hall.design_supply_c), np.ones(1))
        found = Hall(fleet, "f64").solve(met).rack_inlet_c - config.hall.design_supply_c
        np.testing.assert_allclose(fleet.approach_k, found, rtol=0.01)
        given = np.allclose(fleet.approach_k, config.hall.rack_approach_k(), rtol=0.2)
        assert given == (changes is by_rack)


def test_rooms_hold_what_has_no_temperature_of_its_own() -> None:
    # Servers hold 30 J/(K W), and at most 410 kJ/K in a rack.
    servers_kj_per_k = 20 * 410.0
    for thermal, kj_per_k in (("quasi_steady", servers_kj_per_k), ("transient", 0.0)):
        config = load_config("corrected", [f"simulation.thermal={thermal}"])
        drivers = drivers_from_arrays([20.0], [15.0], [300.0], [0.5])
        with Simulator(config, drivers=drivers) as sim:
            coils_kj_per_k = 15.0 * config.rack_nameplate_w().sum() / 1e3
            room_kj_per_k = sim.sizing.room_kwh_per_k * 3600
            assert room_kj_per_k == pytest.approx(coils_kj_per_k + kj_per_k)


# --- copies and sampling ------------------------------------------------------------------------

SAMPLE: dict[str, Any] = {
    "servers.fan_reference_w": {"uniform": [5.0, 15.0]},
    "hvac.chiller.reference_cop": {"choice": [4.0, 5.0, 6.0]},
    "workload.deadline_h": {"uniform": [1, 24]},
    "battery.capacity_kwh": {"choice": [None, 100]},
    "hvac.setpoint.initial_c": {"uniform": [16, 23]},
}


def drawn(configs: list[DataCenterConfig]) -> list[tuple[Any, ...]]:
    return [
        (
            c.servers.fan_reference_w,
            c.hvac.chiller.reference_cop,
            c.workload.deadline_h,
            c.battery.capacity_kwh,
            c.hvac.setpoint.initial_c,
        )
        for c in configs
    ]


def test_copies_are_dealt_over_the_sites() -> None:
    found = make_configs(TINY, count=5, sites=["ny", "AZ"])
    assert [c.site.location for c in found] == ["NY", "AZ", "NY", "AZ", "NY"]
    assert len({c.name for c in found}) == 5
    assert [c.name for c in make_configs(TINY, sites=["ny", "az", "wa"])] == ["ny", "az", "wa"]
    (alone,) = make_configs(TINY)
    assert alone.site == TINY.site
    names = [c.name for c in make_configs(TINY, count=12)]
    assert names == sorted(names), "names sort as numbers do"
    assert build_fleet(make_configs(TINY, count=3, sites=["ny", "az"])).size == 3


def test_copies_of_a_named_data_center_keep_its_name() -> None:
    base = load_config("tiny", ["name=Dallas 3"])
    assert [c.name for c in make_configs(base)] == ["Dallas 3"]
    assert [c.name for c in make_configs(base, count=2)] == ["Dallas 3-0", "Dallas 3-1"]
    assert [c.name for c in make_configs(base, sites=["ny", "tx"])] == ["ny", "tx"]


def test_copies_are_named_after_their_places(tmp_path: Path) -> None:
    header = "LOCATION,{},SP,BRA,T,0,-23.5,-46.6,-3.0,800.0\n"
    places = {"São Paulo (2)": "são-paulo-2", "-": "of-no-city", "": "of-no-city", "..": "unnamed"}
    for city, name in places.items():
        path = tmp_path / "of no city.epw"
        for encoding in ("utf-8", "latin-1"):
            path.write_text(header.format(city), encoding)
            base = load_config("tiny", [f"site.weather_file={path}"])
            assert [c.name for c in make_configs(base)] == [name]
            assert locations([base]) == [city if city.strip("-") else "of no city"]
    path.unlink()
    assert [c.name for c in make_configs(base, count=2)] == ["of-no-city-0", "of-no-city-1"]


@pytest.mark.parametrize("field", ["weather_file", "carbon_file"])
def test_sites_beside_a_file_for_all_of_them_are_refused(field: str) -> None:
    base = load_config("tiny", [f"site.{field}=x.any"])
    with pytest.raises(ConfigError, match=rf"sites ny, wa: site\.{field} 'x\.any' of tiny would"):
        make_configs(base, sites=["ny", "wa"])


def test_a_copy_draws_the_same_whatever_the_count() -> None:
    few = drawn(make_configs(TINY, count=3, sample=SAMPLE, seed=4))
    many = drawn(make_configs(TINY, count=40, sample=SAMPLE, seed=4))
    assert many[:3] == few
    assert drawn(make_configs(TINY, count=3, sites=["AZ", "WA"], sample=SAMPLE, seed=4)) == few
    assert drawn(make_configs(TINY, count=3, sample=SAMPLE, seed=5)) != few
    assert len(set(many)) == 40


def test_draws_follow_their_rule() -> None:
    fan, cop, deadline, capacity, initial = zip(
        *drawn(make_configs(TINY, count=300, sample=SAMPLE)), strict=True
    )
    assert all(5 <= x <= 15 for x in fan)
    assert np.mean(fan) == pytest.approx(10, abs=0.6)
    assert np.std(fan) == pytest.approx(10 / 12**0.5, rel=0.1)
    assert {cop.count(x) for x in (4.0, 5.0, 6.0)} <= set(range(75, 126))
    assert set(deadline) == set(range(1, 25)), "whole limits draw whole numbers, both included"
    assert set(capacity) == {None, 100}
    assert set(initial) == set(range(16, 24))


def test_sampled_lists_and_texts() -> None:
    sample = {
        "hall.supply_approach_k": {"choice": [[4, 4, 4, 4], [5, 5, 5, 6]]},
        "workload.trace": {"choice": ["alibaba_1", "google_1"]},
        "hvac.tower.economiser": {"choice": [True, False]},
        "site.start": {"choice": ["01-01", "07-01"]},
    }
    found = make_configs(TINY, count=20, sample=sample)
    assert {c.hall.supply_approach_k for c in found} == {(4, 4, 4, 4), (5, 5, 5, 6)}
    assert {c.workload.trace for c in found} == {"alibaba_1", "google_1"}
    assert {c.hvac.tower.economiser for c in found} == {True, False}
    assert {c.site.start for c in found} == {"01-01", "07-01"}


@pytest.mark.parametrize(
    ("path", "rule", "message"),
    [
        ("battery.capacity_kwh", 5, "valid is {uniform"),
        ("battery.capacity_kwh", {}, "valid is {uniform"),
        ("battery.capacity_kwh", {"unifrom": [1, 2]}, "did you mean 'uniform'"),
        (
            "battery.capacity_kwh",
            {"normal": [1, 2]},
            "unknown kind 'normal'; valid: uniform, choice",
        ),
        ("battery.capacity_kwh", {"choice": []}, "choice needs a list"),
        ("battery.capacity_kwh", {"choice": "abc"}, "choice needs a list"),
        ("battery.capacity_kwh", {"uniform": [2, 1]}, "low <= high"),
        ("battery.capacity_kwh", {"uniform": [1, 2, 3]}, r"needs \[low, high\]"),
        ("battery.capacity_kwh", {"uniform": ["a", "b"]}, r"needs \[low, high\]"),
        ("battery.capacity_kwh", {"uniform": [True, 2]}, r"needs \[low, high\]"),
        ("battery.capacity", {"uniform": [1, 2]}, "did you mean 'capacity_kwh'"),
        ("batery.capacity_kwh", {"uniform": [1, 2]}, "did you mean 'battery'"),
        ("battery.initial_soc", {"uniform": [1.5, 2]}, "less than or equal to 1"),
    ],
)
def test_wrong_sampling_rules(path: str, rule: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_configs(TINY, count=2, sample={path: rule})


def test_a_drawn_value_that_is_not_valid_is_an_error() -> None:
    with pytest.raises(ConfigError, match=r"battery\.initial_soc"):
        make_configs(TINY, count=50, sample={"battery.initial_soc": {"uniform": [0.5, 1.5]}})


@pytest.mark.parametrize("count", [0, -3])
def test_a_fleet_has_at_least_one(count: int) -> None:
    with pytest.raises(ConfigError, match=f"fleet: count {count}: valid is a whole number of 1"):
        make_configs(TINY, count=count)


def _design(*overrides: str) -> WaterSideDesign:
    drivers = drivers_from_arrays([20.0], [15.0], [300.0], [0.5])
    with Simulator(load_config("corrected", list(overrides)), drivers=drivers) as sim:
        return sim.sizing.water_side


def test_towers_and_pumps_are_sized_by_their_own_model() -> None:
    own, released_tower = _design(), _design("hvac.tower.model=released")
    assert own.tower_fan_w == pytest.approx(0.0126 * own.rejected_w)
    assert released_tower.tower_fan_w == released_tower.cooling_w
    assert released_tower.tower_air_m3s > 10.0
    yorkcalc = _design("hvac.sizing.model=released")
    assert yorkcalc.tower_fan_w == pytest.approx(0.0126 * yorkcalc.rejected_w)
    unscaled = _design("hvac.pumps.model=released", "hvac.pumps.released_chilled_w=379")
    assert unscaled.chilled_pump_w == 379.0
    assert own.chilled_pump_w > 5000.0


def test_the_air_of_the_config_reaches_the_tower() -> None:
    released = ["hvac.tower.model=released", "hvac.sizing.model=released"]
    fan_w = []
    for density in (1.225, 1.0):
        config = load_config("sustaindc", [*released, f"hall.air_density_kg_m3={density}"])
        drivers = drivers_from_arrays([20.0], [15.0], [300.0], [1.0])
        with Simulator(config, drivers=drivers, precision="f64") as sim:
            sim.reset()
            result = sim.step()
            share = result.cooling_load_w / sim.sizing.water_side.cooling_w
            fan_w.append(float(result.tower_fan_w[0] / sim.sizing.water_side.tower_fan_w[0]))
            rise = (50.0 - (30.0 - 15.0)) / (50.0 - (20.0 - result.setpoint_c))
            assert fan_w[-1] == pytest.approx(float(np.minimum(share * rise, 1.0)[0]) ** 3)


def test_fewer_data_centers_than_sites_are_refused() -> None:
    with pytest.raises(ConfigError, match="2 data centers for 3 sites"):
        make_configs(load_config("tiny"), count=2, sites=["NY", "CA", "TX"])
    with pytest.raises(ConfigError, match="sites 'NY'"):
        make_configs(load_config("tiny"), sites="NY")


def test_groups_and_power_pairs_exclude_each_other() -> None:
    config = load_config("tiny")
    values = config.model_dump(mode="json")
    values["servers"]["power_w"] = [[100, 10]]
    with pytest.raises(ConfigError, match="power_w and groups are both given"):
        config_from_dict(values)
    pairs = load_config("tiny", ["servers.power_w=[300, 30]"])
    assert pairs.servers.groups is None
    groups = load_config("corrected", ["servers.groups=[[{count: 2, full_w: 99, idle_w: 1}]]"])
    assert groups.servers.power_w is None
    assert build_fleet(groups).servers == 40
