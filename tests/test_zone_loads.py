"""Loads of the zones of a hall: the process, its limits, and racks that run at them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import Actions, ConfigError, DataCenterConfig, Simulator, load_config
from sdc_taichi.config import with_values
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.zone_loads import ZoneLoads, zone_of_rack

ZONES = "workload.zone_loads"
TRACE = ["workload.placement=weights", "hvac.crac.units=4"]


def hall(*zones: str, name: str = "dc") -> DataCenterConfig:
    section = ", ".join(zones)
    return load_config("corrected", [*TRACE, f"{ZONES}={{{section}}}", f"name={name}"])


def at(sim: Simulator, step: int) -> Any:
    assert sim.zone_loads is not None
    return sim.zone_loads.at(step, np.zeros(sim.size)).rack_load


def test_zones_are_blocks_of_rows_and_places() -> None:
    zones = zone_of_rack(hall("row_blocks: 2", "place_blocks: 3")).reshape(4, 5)
    np.testing.assert_array_equal(zones[:, 0], [0, 0, 3, 3])
    np.testing.assert_array_equal(zones[0], [0, 0, 1, 1, 2])
    assert not zone_of_rack(load_config("corrected")).any()


def test_racks_run_at_the_fixed_loads_of_their_zones() -> None:
    config = hall("fixed: [0.9, 0.3, 0.6, 0.1]", "row_blocks: 2", "place_blocks: 2")
    with Simulator(config, precision="f64") as sim, Simulator(config, precision="f64") as other:
        sim.reset()
        other.reset()
        placed = np.array([0.9, 0.3, 0.6, 0.1])[zone_of_rack(config)]
        one, two = sim.step(), other.step(Actions(placement=placed))
        np.testing.assert_allclose(one.demand, placed.mean(), rtol=1e-12)
        np.testing.assert_allclose(one.utilisation, placed.mean(), rtol=1e-12)
        np.testing.assert_array_equal(one.rack_cpu_w, two.rack_cpu_w)
        # Another placement of the same work replaces that of the zones.
        three = sim.step(Actions(placement=np.ones(20)))
        np.testing.assert_allclose(three.utilisation, one.utilisation)
        assert np.ptp(three.rack_cpu_w[1:3]) < np.ptp(one.rack_cpu_w[1:3])


def test_loads_follow_seed_and_step_alone_or_in_a_fleet_and_after_a_restart() -> None:
    configs = [
        hall("mean: [0.4, 0.4]", name="first"),
        load_config("corrected", [*TRACE, "name=trace"]),
        hall("reversion_h: 5", "place_blocks: 1", name="third"),
    ]
    seeds = [5, 6, 7]
    with Simulator(configs) as sim, Simulator(configs[2]) as alone, Simulator(configs[1]) as trace:
        for each, seed in ((sim, seeds), (alone, [7]), (trace, [6])):
            each.reset(seed=seed)
        results = [sim.step() for _ in range(150)]
        for result in results:
            own, of_trace = alone.step(), trace.step()
            np.testing.assert_array_equal(result.rack_cpu_w[40:], own.rack_cpu_w)
            np.testing.assert_array_equal(result.demand, [*result.demand[:1], *of_trace.demand,
                                                          *own.demand])  # fmt: skip
            np.testing.assert_array_equal(result.rack_inlet_c[20:40], of_trace.rack_inlet_c)
        assert len({float(result.demand[0]) for result in results}) == 150
        saved = sim.state_dict()
        after = sim.step().rack_cpu_w
        sim.reset(seed=[8, 6, 7])
        assert not np.array_equal(sim.step().demand[0], results[0].demand[0])
        sim.load_state_dict(saved)
        np.testing.assert_array_equal(sim.step().rack_cpu_w, after)


def test_process_has_the_mean_deviation_and_reversion_of_its_config() -> None:
    section = ["mean: [0.5, 0.5]", "deviation: 0.1", "reversion_h: 2", "low: 0.1", "high: 1"]
    fleet = build_fleet([hall(*section, "row_blocks: 4", "place_blocks: 5", name="many")])
    loads = ZoneLoads(fleet, np.array([1]))
    values = np.array([loads.at(step, np.zeros(1)).rack_load for step in range(4000)])
    assert abs(values.mean() - 0.5) < 0.005
    assert abs(values.std() - 0.1) < 0.004
    change = values - values.mean()
    lag = 8  # The reversion time of two hours.
    correlation = (change[lag:] * change[:-lag]).mean() / change.var()
    assert abs(correlation - np.exp(-1.0)) < 0.04
    between = np.corrcoef(values.T) - np.eye(20)
    assert np.abs(between).max() < 0.2
    wide = ZoneLoads(build_fleet([hall("deviation: 1")]), np.array([1]))
    clipped = np.array([wide.at(step, np.zeros(1)).rack_load for step in range(300)])
    assert (clipped.min(), clipped.max()) == (0.1, 1.0)


def test_means_of_runs_fill_their_range() -> None:
    config = hall("deviation: 0", "mean: [0.3, 0.9]")
    with Simulator(config) as sim:
        means = []
        for seed in range(100):
            sim.reset(seed=seed)
            means.append(np.unique(at(sim, 3)))
    assert np.min(means) > 0.3
    assert np.max(means) < 0.9
    assert abs(np.mean(means) - 0.6) < 0.03
    assert all(len(each) == 4 for each in means)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({f"{ZONES}.low": 0.5}, r"mean \(0.3, 0.9\) with low 0.5 and high 1: valid is low <="),
        ({f"{ZONES}.high": 1.5}, r"zone_loads.high.* less than or equal to 1"),
        ({f"{ZONES}.fixed": [0.5]}, r"fixed has 1 loads; valid is 4, row_blocks 2 x place_blocks"),
        ({f"{ZONES}.fixed": [0.5, 0.5, 0.5, 0]}, r"fixed.3.* greater than or equal to 0.01"),
        ({f"{ZONES}.row_blocks": 5}, r"zone_loads.row_blocks 5: valid is 1..4, hall.rows"),
        ({f"{ZONES}.place_blocks": 9}, r"place_blocks 9: valid is 1..5, hall.racks_per_row"),
        ({"workload.placement": "fill"}, r"zone_loads with placement fill: valid is placement w"),
    ],
)
def test_zones_that_do_not_fit(values: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says) as error:
        with_values(hall(), values)
    assert "\n" not in str(error.value)
