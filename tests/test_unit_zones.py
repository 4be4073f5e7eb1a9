"""Zones of CRAC units: their racks, the errors of their sensors, and the pressure before tiles."""

from __future__ import annotations

import numpy as np
import pytest

from sdc_taichi import Actions, DataCenterConfig, Simulator, load_config
from sdc_taichi.control import view_maker
from sdc_taichi.control.unit_zones import UnitZones
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.types import F64

QUIET = ["events.sampled=[]", "workload.zone_loads.fixed=[0.9, 0.3, 0.6, 0.6]"]


def shares_of(config: DataCenterConfig) -> F64:
    air = build_fleet(config).air
    assert air is not None
    return air.unit_shares.reshape(config.hall.racks, config.hvac.crac.units)


def test_zones_hold_the_racks_that_units_feed_most() -> None:
    configs = [load_config("tiny"), *map(load_config, ("hall_agents_6", "hall_agents_16"))]
    shares = shares_of(configs[2])
    zones = UnitZones(build_fleet(configs[1:]))
    everything = zones.racks(np.ones(22))
    assert everything.count.sum() == 432
    down = np.ones(22)
    down[6] = 0.0
    some = zones.racks(down)
    for index, running in ((everything, np.ones(16)), (some, down[6:])):
        for unit in range(16):
            racks = index.racks[index.first[6 + unit] :][: int(index.count[6 + unit])] - 216
            best = np.where(running > 0, shares, -1.0).argmax(axis=1)
            expected = best == unit if running[unit] else shares.argmax(axis=1) == unit
            np.testing.assert_array_equal(racks, np.flatnonzero(expected))
            assert len(racks)
    assert some.count[7:].sum() == 216
    np.testing.assert_array_equal(some.count[:6], everything.count[:6])
    # The one unit of a hall without recirculation has all of its racks.
    np.testing.assert_array_equal(
        UnitZones(build_fleet(configs[0])).racks(np.ones(1)).racks, range(4)
    )


def test_units_that_feed_no_rack_most_have_the_rack_that_they_feed_most() -> None:
    shares = [[0.6, 0.3, 0.1], [0.6, 0.2, 0.2]]
    config = load_config(
        "corrected",
        ["hall.rows=1", "hall.racks_per_row=2", "servers.power_w=[150, 10]",
         "hall.supply_approach_k=5", "hall.return_approach_k=-3", "hvac.crac.units=3",
         f"hvac.crac.unit_shares={shares}"],
    )  # fmt: skip
    index = UnitZones(build_fleet(config)).racks(np.ones(3))
    np.testing.assert_array_equal(index.racks, [0, 1, 0, 1])
    np.testing.assert_array_equal(index.count, [2, 1, 1])


def test_view_shows_the_last_step_with_the_errors_of_the_sensors() -> None:
    config = load_config("hall_agents_6", QUIET)
    with Simulator(config) as sim:
        sim.reset(seed=4)
        view_of = view_maker(sim)
        first = view_of(None)
        errors = first.zone_hottest_c - first.zone_hottest_true_c
        np.testing.assert_array_equal(first.zone_hottest_true_c, 23.0)
        np.testing.assert_array_equal(first.zone_supply_ratio, 1.0)
        assert 0.3 < np.abs(errors).max() <= 0.5
        assert np.ptp(errors) > 0.3
        result = sim.step()
        view = view_of(result)
        zone = shares_of(config).argmax(axis=1)
        for unit in range(6):
            racks = zone == unit
            assert view.zone_hottest_true_c[unit] == result.rack_inlet_max_c[racks].max()
            mean_c = result.rack_inlet_c[racks].mean() + errors[unit]
            np.testing.assert_allclose(view.zone_mean_c[unit], mean_c, atol=1e-4)
        np.testing.assert_allclose(view.zone_hottest_c, view.zone_hottest_true_c + errors)
        np.testing.assert_array_equal(view.unit_running, 1.0)
        np.testing.assert_allclose(view.rack_load.reshape(12, 18)[0, [0, -1]], [0.9, 0.3])
        mean = view.rack_load @ sim.fleet.per_rack_servers() / sim.fleet.servers
        np.testing.assert_allclose(view.now.demand, mean)
        sim.reset(seed=4)
        np.testing.assert_allclose(view_of(None).zone_hottest_c - 23.0, errors)
        sim.reset(seed=5)
        assert not np.allclose(view_of(None).zone_hottest_c - 23.0, errors)


def test_data_centers_measure_alike_alone_and_in_a_fleet() -> None:
    config = load_config("hall_agents_6", [*QUIET[1:], "events.sampled.0.per_year=8000"])
    with Simulator([config] * 3) as sim, Simulator(config) as alone:
        sim.reset(seed=[1, 2, 3])
        alone.reset(seed=[3])
        views, own = view_maker(sim), view_maker(alone)
        down = 0
        for _ in range(60):
            view, other = views(sim.step()), own(alone.step())
            np.testing.assert_array_equal(view.zone_hottest_c[12:], other.zone_hottest_c)
            np.testing.assert_array_equal(view.zone_supply_ratio[12:], other.zone_supply_ratio)
            down += int((other.unit_running == 0).sum())
    assert down > 0


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_supply_over_need_is_that_of_the_design_exhaust_shares(thermal: str) -> None:
    # Exhaust shares of racks that are loaded alike are those of the design point.
    even = "workload.zone_loads.fixed=[0.6, 0.6, 0.6, 0.6]"
    change = [even, "hvac.crac.plenum_coupling=0", f"simulation.thermal={thermal}"]
    config = load_config("hall_agents_6", [*QUIET, *change])
    with Simulator(config, precision="f64") as sim:
        sim.reset()
        fans = np.array([3.0, 0, 0, 0, 0, -2.0])
        for _ in range(6):
            result = sim.step(Actions(fan=fans))
            fans = 0.0 * fans
        view = view_maker(sim)(result)
        air, shares = sim.fleet.air, shares_of(config)
        assert air is not None
        of_rack = (1.0 - air.exhaust_share) * result.rack_airflow_m3s
        fresh = sim.fleet.rack_sums(air.rack_need_m3s) / sim.fleet.design_flow_m3s
        expected = fresh * result.unit_flow_m3s / (of_rack @ shares)
        np.testing.assert_allclose(view.zone_supply_ratio, expected, rtol=0.02)
        assert view.zone_supply_ratio[0] > view.zone_supply_ratio[5]
