"""Commands per CRAC unit, fan speed and placement by weights."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import (
    Actions,
    Drivers,
    FanAction,
    SdcError,
    Simulator,
    drivers_from_arrays,
    load_config,
)
from sdc_taichi.types import StepResult

UNITS = "hvac.crac.units=4"


def steady(demand: float = 0.6, steps: int = 8) -> Drivers:
    return drivers_from_arrays([25.0] * steps, [18.0] * steps, [300.0] * steps, [demand] * steps)


def simulator(*overrides: str, demand: float = 0.6) -> Simulator:
    config = load_config("corrected", [UNITS, "hall.recirculation.calibrate=rack", *overrides])
    sim = Simulator(config, drivers=steady(demand), precision="f64")
    sim.reset()
    return sim


def run(sim: Simulator, *actions: Actions) -> StepResult:
    with sim:
        return [sim.step(a) for a in actions][-1]


def test_a_unit_of_its_own_setpoint_cools_the_racks_it_supplies() -> None:
    base = run(simulator(), Actions())
    moved = run(simulator(), Actions(cooling=np.array([3.0, 0.0, 0.0, 0.0])))
    assert moved.unit_setpoint_c.tolist() == [21.0, 18.0, 18.0, 18.0]
    assert moved.setpoint_c[0] == pytest.approx(18.75)
    warmer = (moved.rack_inlet_c - base.rack_inlet_c).reshape(4, 5)
    assert np.all(warmer > 0)
    # Unit 0 stands at the left end of rows 0 and 1.
    assert warmer[0, 0] == warmer.max()
    assert warmer[0, 0] > 1.2 * warmer[3, 4]


def test_one_setpoint_command_serves_all_units() -> None:
    one = run(simulator(), Actions(cooling=1.0))
    each = run(simulator(), Actions(cooling=np.ones(4)))
    np.testing.assert_array_equal(one.rack_inlet_c, each.rack_inlet_c)


def test_slower_fans_save_fan_power_and_warm_the_inlets() -> None:
    controlled = "hvac.crac.flow_model=controlled"
    full = run(simulator(controlled, demand=1.0), Actions())
    slow = run(simulator(controlled, demand=1.0), Actions(fan=-4.0))
    assert slow.crac_flow_m3s[0] == pytest.approx(0.8 * full.crac_flow_m3s[0])
    assert slow.crac_fan_w[0] == pytest.approx(0.8**3 * full.crac_fan_w[0])
    assert np.all(slow.rack_inlet_c > full.rack_inlet_c)
    assert slow.rti_pct[0] > full.rti_pct[0]


def test_fan_speed_stays_within_its_range_and_is_remembered() -> None:
    sim = simulator("hvac.crac.flow_model=controlled")
    lowest = run(sim, Actions(fan=-100.0), Actions(fan=FanAction.HOLD))
    full = run(simulator("hvac.crac.flow_model=controlled"), Actions(fan=FanAction.RAISE))
    assert lowest.crac_flow_m3s[0] == pytest.approx(0.3 * full.crac_flow_m3s[0])


def test_weights_move_work_and_keep_its_sum() -> None:
    sim = simulator("workload.placement=weights", "servers.power_w=[150, 10]")
    with sim:
        even = sim.step(Actions())
        weights = np.ones(20)
        weights[7] = 2.0
        moved = sim.step(Actions(placement=weights))
    assert moved.rack_cpu_w[7] > 1.3 * even.rack_cpu_w[7]
    assert np.all(np.delete(moved.rack_cpu_w, 7) < np.delete(even.rack_cpu_w, 7))
    assert moved.executed_tasks[0] == pytest.approx(60.0)
    assert moved.lost_tasks[0] == 0.0


def test_work_beyond_the_racks_with_weight_waits() -> None:
    sim = simulator("workload.placement=weights")
    with sim:
        weights = np.zeros(20)
        weights[:5] = 1.0
        result = sim.step(Actions(placement=weights))
    assert result.executed_tasks[0] == pytest.approx(25.0)
    assert result.queue_tasks[0] == pytest.approx(35.0)


@pytest.mark.parametrize(
    ("actions", "overrides", "message"),
    [
        ({"fan": 1.0}, (), "action fan: given, but hvac.crac.flow_model is follow_servers"),
        ({"cooling": np.ones(3)}, (), r"action cooling: shape \(3,\), expected \(\) or \(1,\)"),
        ({"placement": np.ones(20)}, (), "workload.placement is uniform"),
        (
            {"placement": np.ones(3)},
            ("workload.placement=weights",),
            r"action placement: shape \(3,\), expected \(20,\), one per rack, or \(100,\)",
        ),
        (
            {"placement": np.zeros(20)},
            ("workload.placement=weights",),
            "ny: all placement weights are 0|corrected: all placement weights are 0",
        ),
        (
            {"placement": -np.ones(20)},
            ("workload.placement=weights",),
            "placement weight 0 is -1",
        ),
    ],
)
def test_commands_that_do_not_fit_are_refused(
    actions: dict[str, Any], overrides: tuple[str, ...], message: str
) -> None:
    with simulator(*overrides) as sim, pytest.raises(SdcError, match=message):
        sim.step(Actions(**actions))
