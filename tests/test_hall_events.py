"""What happens in a hall when something goes wrong, and where its work runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sdc_taichi import (
    Actions,
    DataCenterConfig,
    Drivers,
    Simulator,
    StepResult,
    build_fleet,
    drivers_from_arrays,
    load_config,
)
from sdc_taichi.config import apply_overrides
from sdc_taichi.hall.protection import NORMAL, THROTTLED, TRIPPED
from sdc_taichi.run.metrics import add_step, empty_totals, metrics_of_fleet, metrics_per_dc
from sdc_taichi.sim.events import seeds_of_fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.sizing import air_j_per_m3_k
from sdc_taichi.types import F64
from simulated import actions_of, assert_same, part_of, random_actions, run

PRECISIONS: tuple[Precision, ...] = ("f64", "f32")
THERMAL = ("quasi_steady", "transient")
POLICIES = ("uniform", "fill", "coolest-first", "inlet-aware", "weights")


def constant(
    demand: Any = 0.8, *, outdoor_c: float = 20.0, wet_bulb_c: float = 14.0, size: int = 1
) -> Drivers:
    series = np.broadcast_to(np.atleast_1d(np.asarray(demand, np.float64)), (size, np.size(demand)))
    ones = np.ones(series.shape)
    return drivers_from_arrays(outdoor_c * ones, wet_bulb_c * ones, 300.0 * ones, series.copy())


def hall_of(overrides: list[str]) -> DataCenterConfig:
    """A hall whose racks take in equal shares of exhaust, so that they differ by events alone."""
    return load_config("corrected", ["hall.recirculation.calibrate=rack", *overrides])


def simulate(
    overrides: list[str], steps: int, drivers: Drivers | None = None, **kwargs: Any
) -> list[StepResult]:
    with Simulator(hall_of(overrides), drivers=drivers or constant(), precision="f64") as sim:
        sim.reset()
        return [sim.step(Actions(**kwargs)) for _ in range(steps)]


def column(results: list[StepResult], name: str) -> F64:
    """A quantity over the steps, (T,), or (T, n) for n racks or CRAC units."""
    values = np.array([getattr(result, name) for result in results])
    return values[:, 0] if values.shape[1] == 1 else values


def simulate_both(event: str, steps: int) -> tuple[list[StepResult], list[StepResult]]:
    """Steps of a hall with an event and without it."""
    return simulate([events(event)], steps), simulate([], steps)


def events(*listed: str) -> str:
    return f"events.scheduled=[{', '.join('{' + e + '}' for e in listed)}]"


# --- CRAC units ---------------------------------------------------------------------------------


def test_a_unit_that_is_down_coasts_and_warms_the_hall() -> None:
    overrides = ["hvac.crac.units=2", "hvac.crac.coasting_flow_ratio=0.25"]
    down = simulate([*overrides, events("kind: crac_down, unit: 1, start_h: 1, duration_h: 1")], 40)
    whole = simulate(overrides, 40)
    running = column(down, "unit_running")
    assert np.array_equal(running[:, 1] == 0, (np.arange(40) >= 4) & (np.arange(40) < 8))
    assert np.all(running[:, 0] == 1)
    design = build_fleet(hall_of(overrides)).unit_design_m3s
    assert column(down, "unit_flow_m3s")[4, 1] == pytest.approx(0.25 * design[1], rel=1e-9)
    warmer = column(down, "rack_inlet_c") - column(whole, "rack_inlet_c")
    assert np.all(warmer[:4] == 0)
    rows = warmer[4].reshape(4, 5)
    assert np.all(rows > 1)
    # The coil of the other one takes what it can; the rest warms the room until both are back.
    room = column(down, "room_heat_kwh")
    assert np.all(np.diff(room[3:8]) > 0)
    assert np.all(column(down, "unmet_w")[4:8] > 0)
    assert room[-1] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(warmer[-1], 0, atol=1e-9)


@pytest.mark.parametrize("thermal", THERMAL)
def test_without_any_unit_nothing_is_removed(thermal: str) -> None:
    overrides = [f"simulation.thermal={thermal}", "hvac.crac.units=3", "protection.ashrae_class=A1"]
    results = simulate([*overrides, events("kind: crac_down, start_h: 1, duration_h: 1")], 40)
    removed, fan_w = column(results, "heat_removed_w"), column(results, "crac_fan_w")
    down = slice(4, 8)
    assert np.all(removed[down] == 0)
    assert np.all(fan_w[down] == 0)
    assert np.all(column(results, "chiller_w")[down] == 0)
    assert np.all(removed[:4] > 0)
    assert np.all(removed[8:] > 0)
    assert np.all(column(results, "tripped_racks")[5:8] == 20)
    assert np.all(column(results, "tripped_racks")[16:] == 0)
    assert np.all(column(results, "utilisation")[-4:] == 0.8)


def test_units_keep_setpoints_of_their_own() -> None:
    config = hall_of(["hvac.crac.units=2"])
    with Simulator(config, drivers=constant(), precision="f64") as sim:
        sim.reset()
        for _ in range(3):
            result = sim.step(Actions(cooling=np.array([1.0, -0.5])))
    assert result.unit_setpoint_c.tolist() == [21.0, 16.5]
    assert result.setpoint_c[0] == 18.75
    flow = result.unit_flow_m3s
    assert result.supply_c[0] == pytest.approx(flow @ result.unit_setpoint_c / flow.sum())
    rows = result.rack_inlet_c.reshape(4, 5)
    assert np.all(np.diff(rows, axis=1) < 0)


def test_fan_speed_is_a_control_of_its_own() -> None:
    overrides = ["hvac.crac.flow_model=controlled", "hvac.crac.fan_step=0.1",
                 "hvac.crac.min_flow_ratio=0.5", "hvac.crac.units=2"]  # fmt: skip
    config = hall_of(overrides)
    with Simulator(config, drivers=constant(), precision="f64") as sim:
        sim.reset()
        results = [sim.step(Actions(fan=np.array([-1.0, 0.0]))) for _ in range(8)]
        design_w = float(sim.sizing.crac_fan_w[0])
        design = sim.fleet.unit_design_m3s
    speed = column(results, "unit_flow_m3s") / design
    np.testing.assert_allclose(speed[:, 0], [0.9, 0.8, 0.7, 0.6, 0.5, 0.5, 0.5, 0.5], rtol=1e-12)
    np.testing.assert_allclose(speed[:, 1], 1.0, rtol=1e-12)
    expected = design_w * (speed**3 @ design) / design.sum()
    np.testing.assert_allclose(column(results, "crac_fan_w"), expected, rtol=1e-12)
    assert np.all(np.diff(column(results, "inlet_mean_c")[:5]) >= 0)
    assert np.ptp(column(results, "inlet_mean_c")) > 0.5
    rise_k = column(results, "it_w") / (
        air_j_per_m3_k(sim.fleet) * column(results, "crac_flow_m3s")
    )
    np.testing.assert_allclose(column(results, "return_c") - 18.0, rise_k, rtol=1e-10)


# --- protection ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("thermal", "margin_k"), [("quasi_steady", 12.0), ("transient", 8.0)])
def test_hot_racks_throttle_and_then_trip_with_their_work_counted(
    thermal: str, margin_k: float
) -> None:
    results = simulate(
        [
            f"simulation.thermal={thermal}", "hvac.crac.units=2", "protection.ashrae_class=A1",
            f"protection.trip_margin_k={margin_k}", "protection.throttle_share=0.7",
            "workload.queue_limit_h=0.01", "servers.heat_capacity_kj_per_k=4.155",
            events("kind: crac_down, unit: 0, start_h: 1, duration_h: 3"),
        ],
        48,
    )  # fmt: skip
    status, hottest = column(results, "rack_status"), column(results, "rack_inlet_max_c")
    before = np.concatenate([np.zeros((1, 20), np.int8), status[:-1]])
    seen = {NORMAL: False, THROTTLED: False, TRIPPED: False}
    for t in range(48):
        for j in range(20):
            hot = hottest[t, j]
            called = TRIPPED if hot > 32 + margin_k else THROTTLED if hot > 32 else NORMAL
            # Racks restart below the mean of the recommended and the allowable limit, 27 and 32 C.
            kept_off = before[t, j] == TRIPPED and hot > 29.5
            assert status[t, j] == (TRIPPED if kept_off else called)
            seen[int(status[t, j])] = True
    assert all(seen.values()), "a status was never reached"
    for name, code in (("throttled_racks", THROTTLED), ("tripped_racks", TRIPPED)):
        assert np.array_equal(column(results, name), (status == code).sum(axis=1))
    cpu_w, fan_w = column(results, "rack_cpu_w"), column(results, "rack_fan_w")
    off = before == TRIPPED
    assert np.all(cpu_w[off] == 0)
    assert np.all(fan_w[off] == 0)
    assert np.all(cpu_w[~off] > 0)
    executed, lost = column(results, "executed_tasks"), column(results, "lost_tasks")
    # What racks could do at the start of the step, and what the tripping ones had done of it.
    room = np.where(before == TRIPPED, 0.0, np.where(before == THROTTLED, 0.7, 1.0))
    placed = np.minimum(0.8, room.mean(axis=1))
    np.testing.assert_allclose(executed + lost, 100 * placed, rtol=1e-9)
    tripping = (status == TRIPPED) & ~off
    assert np.any(tripping)
    assert np.array_equal(lost > 0, np.any(tripping, axis=1))
    uniform = np.all(before == NORMAL, axis=1)
    expected = 80.0 * tripping.sum(axis=1) / 20
    np.testing.assert_allclose(lost[uniform], expected[uniform], rtol=1e-12)
    # Nothing is met in silence: what did not fit was dropped.
    dropped, queue = column(results, "dropped_tasks"), column(results, "queue_tasks")
    change = np.diff(np.concatenate([[0.0], queue]))
    np.testing.assert_allclose(executed + lost + dropped + change, 80.0, rtol=1e-12)
    assert dropped.max() > 10


def test_a_hardier_class_keeps_running() -> None:
    first, unmet = {}, {}
    for name in ("A1", "A2", "A3", "A4", "null"):
        results = simulate(
            [f"protection.ashrae_class={name}", "hvac.crac.units=2", "hvac.setpoint.initial_c=19",
             "simulation.thermal=transient", "workload.queue_limit_h=0.01",
             events("kind: crac_down, unit: 0, start_h: 1, duration_h: 3")],
            20,
            constant(0.6),
        )  # fmt: skip
        limited = column(results, "throttled_racks") + column(results, "tripped_racks")
        first[name] = int(np.argmax(np.append(limited, 1.0) > 0))
        unmet[name] = float(np.sum(column(results, "dropped_tasks")))
    assert [*first.values()] == sorted(first.values())
    assert first["A1"] < first["A4"] < first["null"] == 20
    assert unmet["A1"] > unmet["null"] == 0


def all_units_down(thermal: str, *more: str) -> list[StepResult]:
    """Four units down from minute 6 to 36 of 90, at 90 % load and 22 C, steps of a minute."""
    return simulate(
        [f"simulation.thermal={thermal}", "hvac.crac.units=4", "hvac.setpoint.initial_c=22",
         "protection.ashrae_class=A2", "simulation.steps_per_hour=60", "simulation.substep_s=15",
         "hvac.sizing.design_wet_bulb_c=26",
         events("kind: crac_down, start_h: 0.1, duration_h: 0.5"), *more],
        90,
        constant(0.9, outdoor_c=30.0, wet_bulb_c=22.0),
    )  # fmt: skip


@pytest.mark.parametrize("thermal", THERMAL)
def test_racks_restart_in_stages_and_with_cooling_alone(thermal: str) -> None:
    results = all_units_down(thermal)
    status, it_w = column(results, "rack_status"), column(results, "it_w")
    up = np.array([(r.unit_running > 0).any() for r in results])
    assert np.flatnonzero(~up).tolist() == list(range(6, 36))
    off = status == TRIPPED
    starts = (~off[1:] & off[:-1]).sum(axis=1)
    assert off.sum(axis=1).max() >= 15
    assert np.all(starts[:35] == 0)
    # Five minutes of cool inlets, then a tenth of the racks a minute.
    assert np.all(starts[35:39] == 0)
    assert starts.max() == 2
    assert starts.sum() == off.any(axis=0).sum()
    assert np.all(status[-1] == NORMAL)
    assert it_w[35] < 0.2 * it_w[0]
    assert it_w[-1] == pytest.approx(it_w[0], rel=0.01)


def test_time_to_throttle_runs_from_the_first_event() -> None:
    config = load_config(
        "corrected",
        ["name=lost", "simulation.thermal=transient", "simulation.steps_per_hour=60",
         "hvac.crac.units=4", "hvac.setpoint.initial_c=22", "protection.ashrae_class=A2",
         events("kind: crac_down, start_h: 0.2, duration_h: 1")],
    )  # fmt: skip
    calm = apply_overrides(config, ["name=calm", "events.scheduled=[]"])
    totals = empty_totals(2, 1 / 60)
    with Simulator([config, calm], drivers=constant(0.9, size=2), precision="f64") as sim:
        sim.reset()
        results = [sim.step() for _ in range(20)]
        for result in results:
            add_step(totals, result)
        lost, none = (m["time_to_throttle_min"] for m in metrics_per_dc(totals, sim.fleet))
        assert metrics_of_fleet(totals, sim.fleet)["time_to_throttle_min"] == lost
    assert none is None
    hot = [r.throttled_racks[0] + r.tripped_racks[0] > 0 for r in results]
    assert not any(hot[:12])
    assert lost == pytest.approx(hot.index(True) + 1 - 12)
    assert [r.active_events.tolist() for r in results] == [[float(t >= 12), 0.0] for t in range(20)]


def test_the_heat_of_tripped_servers_goes_to_the_room() -> None:
    results = all_units_down("transient")
    off = slice(25, 34)
    assert np.all(column(results, "tripped_racks")[off] >= 15)
    stored_w, load_w = column(results, "thermal_storage_w"), column(results, "cooling_load_w")
    assert np.all(stored_w[off] < 0), "off servers keep their heat"
    assert np.all(np.diff(column(results, "room_heat_kwh")[off]) > 0)
    assert np.all(np.diff(column(results, "supply_c")[off]) > 0)
    np.testing.assert_allclose(column(results, "it_w")[off] - stored_w[off], load_w[off], rtol=1e-9)
    # The hall warms as the servers cool.
    inlet_c, outlet_c = (column(results, f"{name}_mean_c")[off] for name in ("inlet", "outlet"))
    assert np.all(np.diff(inlet_c) > 0)
    assert np.all(np.diff(outlet_c) < 0)
    assert np.all(inlet_c < outlet_c)


@pytest.mark.parametrize(("thermal", "per_hour"), [("quasi_steady", 4), ("transient", 60)])
def test_a_rack_with_a_tenth_of_its_air_throttles_trips_and_waits_for_its_fans(
    thermal: str, per_hour: int
) -> None:
    results = simulate(
        [f"simulation.thermal={thermal}", f"simulation.steps_per_hour={per_hour}",
         "servers.power_w=[150, 10]", "servers.heat_capacity_kj_per_k=4.5",
         "protection.ashrae_class=A2",
         events("kind: rack_fan_failure, rack: 7, share: 0.1, start_h: 0.5, duration_h: 3")],
        5 * per_hour,
        constant(1.0),
    )  # fmt: skip
    status = column(results, "rack_status")
    others = np.delete(status, 7, axis=1)
    assert np.all(others == NORMAL)
    rack, outlet_c = status[:, 7], column(results, "rack_outlet_max_c")[:, 7]
    first = {code: int(np.argmax(rack == code)) for code in (THROTTLED, TRIPPED)}
    assert per_hour // 2 <= first[THROTTLED] < first[TRIPPED] < 2.5 * per_hour
    # It is off to the end of the failure, and back after it.
    end = int(3.5 * per_hour)
    assert np.all(rack[first[TRIPPED] : end] == TRIPPED)
    assert np.all(rack[-per_hour // 2 :] == NORMAL)
    assert np.all(outlet_c[first[TRIPPED] + 1 :] < 80.0)
    if thermal == "transient":
        assert outlet_c.max() < 81.0


# --- grid ---------------------------------------------------------------------------------------


def test_the_battery_carries_an_outage_as_far_as_it_reaches() -> None:
    results = simulate(
        ["battery.hours_of_design_load=0.5", "battery.discharge_limit_c_rate=3",
         "battery.initial_soc=1", "battery.lower_v=0",
         events("kind: grid_outage, start_h: 1, duration_h: 2")],
        20,
        battery=0.3,
    )  # fmt: skip
    out = slice(4, 12)
    assert np.array_equal(column(results, "grid_up"), np.r_[np.ones(4), np.zeros(8), np.ones(8)])
    for name in ("grid_kwh", "carbon_g", "charge_kwh", "unserved_kwh"):
        assert np.all(column(results, name)[out] == 0), name
    powered = column(results, "powered")
    assert np.all(np.diff(powered[out]) <= 0)
    assert powered[4] == 1.0 > powered[11]
    facility = column(results, "it_kwh") + column(results, "overhead_w") / 4e3
    np.testing.assert_allclose(facility[out], column(results, "discharge_kwh")[out], rtol=1e-9)
    assert column(results, "soc")[11] < 0.05
    executed = column(results, "executed_tasks")
    np.testing.assert_allclose(executed[out], 100 * np.minimum(0.8, powered[out]), rtol=1e-9)
    assert np.all(column(results, "grid_kwh")[12:] > 0)
    assert column(results, "powered")[12] == 1.0


@pytest.mark.parametrize("thermal", THERMAL)
def test_an_outage_without_battery_stops_everything(thermal: str) -> None:
    results = simulate(
        [f"simulation.thermal={thermal}", "battery.capacity_kwh=0", "workload.queue_limit_h=0.5",
         events("kind: grid_outage, start_h: 1, duration_h: 1.5")],
        14,
    )  # fmt: skip
    dark = slice(4, 10)
    for name in ("it_w", "hvac_w", "heat_removed_w", "executed_tasks", "grid_kwh", "lost_tasks",
                 "water_l"):  # fmt: skip
        assert np.all(column(results, name)[dark] == 0), name
    # Warm servers draw a little air.
    airflow = column(results, "it_airflow_m3s")
    draught = 0.1 * airflow[0] if thermal == "transient" else 0.0
    assert np.all(airflow[dark] <= draught)
    assert np.all((airflow[dark] > 0) == (thermal == "transient"))
    assert np.all(column(results, "powered")[dark] == 0)
    running = np.array([r.unit_running for r in results])
    assert np.all(running[dark] == 0)
    assert np.all(running[:4] == 1)
    coasting = load_config("corrected").hvac.crac.coasting_flow_ratio
    flow = column(results, "crac_flow_m3s")
    assert np.all(flow[dark] < 1.5 * coasting / 0.2 * flow[0])
    assert np.all(np.isfinite(column(results, "return_c")))
    queue, dropped = column(results, "queue_tasks"), column(results, "dropped_tasks")
    assert queue[9] == 200.0
    assert dropped[dark].sum() == pytest.approx(6 * 80 - 200)
    assert np.all(column(results, "executed_tasks")[10:] >= 80)


# --- racks, chiller, weather --------------------------------------------------------------------


def test_a_rack_whose_fans_fail_blows_less_and_hotter() -> None:
    failure = "kind: rack_fan_failure, rack: 7, share: 0.3, start_h: 1, duration_h: 0.5"
    failed, whole = simulate_both(failure, 10)
    flow = column(failed, "rack_airflow_m3s") / column(whole, "rack_airflow_m3s")
    fans = column(failed, "rack_fan_w") / column(whole, "rack_fan_w")
    during = slice(4, 6)
    # Its inlet moves a little, and the curve with it.
    np.testing.assert_allclose(flow[during, 7], 0.3, rtol=0.05)
    np.testing.assert_allclose(fans[during, 7], 0.3, rtol=0.15)
    others = np.delete(np.arange(20), 7)
    np.testing.assert_allclose(flow[during][:, others], 1.0, rtol=0.05)
    hotter = column(failed, "rack_outlet_c") - column(whole, "rack_outlet_c")
    assert np.all(hotter[during, 7] > 20)
    assert np.all(hotter[:4] == 0)
    np.testing.assert_allclose(hotter[6:], 0, atol=1e-9)
    moved = np.abs(column(failed, "rack_inlet_c") - column(whole, "rack_inlet_c"))[4]
    assert moved[[6, 8]].min() > moved[19] > 0


def test_a_heat_wave_warms_dry_and_wet_bulb_alike() -> None:
    hot, normal = simulate_both("kind: heat_wave, offset_k: 7.5, start_h: 0.5, duration_h: 1", 8)
    during = (np.arange(8) >= 2) & (np.arange(8) < 6)
    for name in ("outdoor_c", "wet_bulb_c"):
        offset = column(hot, name) - column(normal, name)
        np.testing.assert_allclose(offset, np.where(during, 7.5, 0.0), atol=1e-12)
    more = column(hot, "chiller_w") - column(normal, "chiller_w")
    assert np.all(more[during] > 1000)
    assert np.all(more[~during] == 0)


def test_a_derated_chiller_leaves_heat_behind_and_fetches_it_later() -> None:
    weather = constant(outdoor_c=30.0, wet_bulb_c=24.0)
    event = "kind: chiller_derate, share: {}, start_h: 1, duration_h: 1"
    base = ["hvac.sizing.design_wet_bulb_c=24"]
    derated = simulate([*base, events(event.format(0.3))], 60, weather)
    whole = simulate(base, 60, weather)
    same = simulate([*base, events(event.format(1))], 60, weather)
    for result in same:
        result.active_events[:] = 0
    assert_same(whole, same)
    during = slice(4, 8)
    assert np.all(column(derated, "unmet_w")[during] > 1e5)
    removed, able = column(derated, "heat_removed_w"), column(whole, "heat_removed_w")
    assert np.all(removed[during] < 0.5 * able[during])
    assert np.all(np.diff(column(derated, "room_heat_kwh")[3:8]) > 0)
    assert np.all(np.diff(column(derated, "supply_c")[4:8]) > 0)
    assert np.all(column(derated, "recovered_w")[8:12] > 0)
    kept = np.sum(column(derated, "unmet_w") - column(derated, "recovered_w")) / 4000
    assert kept == pytest.approx(column(derated, "room_heat_kwh")[-1], abs=1e-9)
    assert column(derated, "room_heat_kwh")[-1] < 1e-9


# --- placement ----------------------------------------------------------------------------------

LINEAR = [
    "servers.cpu_power_ratio_lb=[0, 1]", "servers.cpu_power_ratio_ub=[0, 1]",
    "servers.power_w=[150, 0]", "hall.height_zones=2",
]  # fmt: skip
"""CPU power in proportion to the load, wherever it runs."""


def rack_loads(results: list[StepResult]) -> F64:
    return np.asarray(column(results, "rack_cpu_w") / (200 * 150.0))


@pytest.mark.parametrize(
    ("policy", "thermal"),
    [*((policy, "quasi_steady") for policy in POLICIES), ("coolest-first", "transient")],
)
def test_placement_conserves_work_and_keeps_to_capacity(policy: str, thermal: str) -> None:
    weights = np.linspace(0.1, 3, 20) if policy == "weights" else None
    demand = np.array([0.05, 0.3, 0.62, 0.97, 1.0])
    results = simulate(
        [*LINEAR, f"workload.placement={policy}", f"simulation.thermal={thermal}"],
        5,
        constant(demand),
        placement=weights,
    )
    loads = rack_loads(results)
    np.testing.assert_allclose(loads.mean(axis=1), column(results, "utilisation"), rtol=1e-12)
    np.testing.assert_allclose(column(results, "executed_tasks"), 100 * demand, rtol=1e-12)
    assert np.all((loads >= 0) & (loads <= 1 + 1e-12))
    spread = np.ptp(loads, axis=1)
    if policy == "uniform":
        assert np.all(spread < 1e-12)
    else:
        assert np.all(spread[:3] > 1e-4)


def test_fill_and_weights_say_where_work_goes() -> None:
    filled = rack_loads(simulate([*LINEAR, "workload.placement=fill"], 1, constant(0.52)))[0]
    np.testing.assert_allclose(filled, np.r_[np.ones(10), 0.4, np.zeros(9)], atol=1e-12)
    weights = np.r_[0.0, 0.0, np.ones(9), 2 * np.ones(9)]
    loads = rack_loads(
        simulate([*LINEAR, "workload.placement=weights"], 1, constant(0.27), placement=weights)
    )[0]
    np.testing.assert_allclose(loads, 0.27 * 20 / 27 * weights, rtol=1e-12)
    # By server group, and more work than the chosen ones can do: the rest waits.
    groups = np.zeros(40)
    groups[5] = 1.0
    result = simulate([*LINEAR, "workload.placement=weights"], 1, constant(0.3), placement=groups)
    assert result[0].utilisation[0] == pytest.approx(1 / 40)
    assert rack_loads(result)[0][2] == pytest.approx(0.5)
    assert result[0].queue_tasks[0] == pytest.approx(30 - 2.5)


def test_policies_by_temperature_look_at_the_step_before() -> None:
    steps = 6
    base = [*LINEAR, "hall.supply_approach_k=[1,1,1,1,1,2,2,2,2,2,3,3,3,3,3,4,4,4,4,4]"]
    config = hall_of([*base, "workload.placement=coolest-first"])
    with Simulator(config, drivers=constant(0.5), precision="f64") as sim:
        sim.reset()
        for step in range(steps):
            known = sim.state.group_inlet_c.copy()
            result = sim.step()
            layers = sim.servers().power_w
            idle = float(layers.min())
            busy = layers.reshape(40, 100).mean(axis=1) > idle + 75
            # Equal groups at half load: one half runs, and none outside it is cooler.
            assert busy.sum() == 20, step
            assert known[busy].max() <= known[~busy].min()
            np.testing.assert_array_equal(
                sim.state.group_inlet_c, sim.servers().inlet_c.reshape(40, 100)[:, 0]
            )
    results = simulate([*base, "workload.placement=inlet-aware"], steps, constant(0.5))
    loads, inlets = rack_loads(results)[1:], column(results, "rack_inlet_c")[:-1]
    for load, inlet in zip(loads, inlets, strict=True):
        order = np.argsort(inlet)
        assert load[order[0]] > load[order[-1]]
        # In proportion to the headroom below the limit of class A2.
        assert np.corrcoef(load, 35.0 - inlet)[0, 1] > 0.99
    assert result.inlet_max_c[0] > 0


def test_throttled_racks_get_what_they_may_do() -> None:
    results = simulate(
        [*LINEAR, "workload.placement=fill", "hvac.crac.units=2", "protection.ashrae_class=A1",
         "protection.trip_margin_k=50", "protection.throttle_share=0.25",
         events("kind: crac_down, unit: 0, start_h: 0.5, duration_h: 4")],
        18,
        constant(0.6),
    )  # fmt: skip
    status, loads = column(results, "rack_status"), rack_loads(results)
    throttled = status[:-1] == THROTTLED
    assert np.any(throttled)
    assert np.all(loads[1:][throttled] <= 0.25 + 1e-12)
    room = np.where(throttled, 0.25, 1.0).mean(axis=1)
    waiting = column(results, "queue_tasks")[:-1] > 0
    expected = np.minimum(0.6, room)
    assert np.all(loads[1:].mean(axis=1) >= expected - 1e-9)
    assert np.all(loads[1:].mean(axis=1) <= room + 1e-9)
    assert np.any(waiting)


# --- the hottest place --------------------------------------------------------------------------


def test_hottest_server_is_where_the_layers_say() -> None:
    config = hall_of(["workload.placement=weights"])
    rng = np.random.default_rng(0)
    with Simulator(config, drivers=constant(0.5), precision="f64") as sim:
        sim.reset()
        places = set()
        for _ in range(6):
            result = sim.step(Actions(placement=rng.uniform(0, 1, 20) ** 4))
            inlets = sim.servers().inlet_c
            index = int(np.argmax(inlets))
            place = (int(result.hottest_rack[0]), int(result.hottest_server[0]))
            assert place == divmod(index, 200)
            assert result.inlet_max_c[0] == inlets[index]
            assert result.over_27_mean_k[0] == pytest.approx(np.maximum(inlets - 27, 0).mean())
            places.add(place)
    assert len(places) > 1


# --- batches, repetition, snapshots -------------------------------------------------------------


def troubled_fleet(thermal: str, policy: str) -> list[DataCenterConfig]:
    """Halls of different size with failures of their own, planned and sampled."""
    base = load_config(
        "corrected", [f"simulation.thermal={thermal}", f"workload.placement={policy}"]
    )
    sampled = (
        "events.sampled=[{kind: crac_down, per_year: 900, duration_h: [0.5, 2]},"
        "{kind: rack_fan_failure, per_year: 2000, duration_h: [0.25, 3], share: 0.4},"
        "{kind: grid_outage, per_year: 400, duration_h: [0.25, 1]}]"
    )
    small = ["hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=3",
             "hall.return_approach_k=-3", "servers.power_w=[300, 60]",
             "hall.servers_per_rack=7"]  # fmt: skip
    changes: list[list[str]] = [
        ["hvac.crac.units=2", "protection.ashrae_class=A1", "battery.initial_soc=0.3",
         events("kind: crac_down, start_h: 1, duration_h: 1.5",
                "kind: grid_outage, start_h: 4, duration_h: 0.75")],
        [],
        [*small, "hvac.crac.units=3", "protection.ashrae_class=A3", sampled],
        [*small, "site.location=AZ", "site.start=07-01",
         events("kind: heat_wave, offset_k: 9, start_h: 1, duration_h: 3",
                "kind: chiller_derate, share: 0.2, start_h: 2, duration_h: 2")],
    ]  # fmt: skip
    return [
        apply_overrides(base, change).model_copy(update={"name": f"dc{i}"})
        for i, change in enumerate(changes)
    ]


@pytest.mark.parametrize(
    ("policy", "thermal", "precision"),
    [
        ("uniform", "quasi_steady", "f64"),
        ("uniform", "transient", "f32"),
        ("fill", "quasi_steady", "f32"),
        ("coolest-first", "transient", "f64"),
        ("inlet-aware", "quasi_steady", "f32"),
        ("weights", "transient", "f64"),
    ],
)
def test_a_troubled_day_of_a_batch_equals_each_data_center_alone(
    policy: str, thermal: str, precision: Precision
) -> None:
    configs = troubled_fleet(thermal, policy)
    actions = random_actions(30, configs, places=policy == "weights")
    with Simulator(configs, precision=precision) as sim:
        sim.reset(seed=4)
        batch = run(sim, actions)
    if policy == "uniform":
        for name in ("tripped_racks", "lost_tasks"):
            assert np.any([getattr(r, name) > 0 for r in batch]), f"{name}: nothing happened"
        assert np.any([r.grid_up < 1 for r in batch])
    for i, config in enumerate(configs):
        with Simulator(config, precision=precision) as sim:
            sim.reset(seed=4)
            alone = run(sim, [actions_of(a, configs, i) for a in actions])
        assert_same(alone, [part_of(r, configs, i) for r in batch])


@pytest.mark.parametrize(("thermal", "precision"), [("quasi_steady", "f32"), ("transient", "f64")])
@pytest.mark.parametrize("at", [5, 11, 17], ids=["unit down", "recovering", "outage"])
def test_snapshots_in_the_midst_of_events_continue_to_the_bit(
    at: int, thermal: str, precision: Precision, tmp_path: Path
) -> None:
    configs = troubled_fleet(thermal, "coolest-first")
    actions = random_actions(26, configs)
    with Simulator(configs, precision=precision) as sim:
        sim.reset(seed=9)
        first = run(sim, actions[:at])
        sim.save(tmp_path / "state.npz")
        snapshot = sim.state_dict()
        second = run(sim, actions[at:])
        sim.reset(seed=1)
        run(sim, actions[:3])
        sim.load_state_dict(snapshot)
        assert_same(second, run(sim, actions[at:]))
        sim.reset(seed=9)
        assert_same(first + second, run(sim, actions))
    with Simulator(configs, precision=precision) as other:
        other.load(tmp_path / "state.npz")
        assert_same(second, run(other, actions[at:]))


def test_the_seed_decides_what_goes_wrong() -> None:
    config = troubled_fleet("quasi_steady", "uniform")[2]
    events_of_runs = []
    with Simulator(config, drivers=constant()) as sim:
        for seed in (0, 1, 0):
            sim.reset(seed=seed)
            results = [sim.step() for _ in range(200)]
            parts = ("unit_running", "rack_airflow_m3s", "grid_up")
            events_of_runs.append(np.concatenate([np.ravel(column(results, n)) for n in parts]))
    first, other, again = events_of_runs
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_data_centers_of_one_name_meet_events_of_their_own() -> None:
    config = load_config(
        "tiny", ["events.sampled=[{kind: grid_outage, per_year: 2000, duration_h: [1, 2]}]"]
    )
    other = config.model_copy(update={"name": "other"})

    def supplied(configs: list[DataCenterConfig], seed: Any) -> list[F64]:
        with Simulator(configs) as sim:
            state = sim.reset(seed=seed)
            steps = [sim.step().grid_up for _ in range(96)]
            assert state.seed.tolist() == (seeds if len(configs) == 4 else [seed])
            return list(np.array(steps).T)

    seeds = seeds_of_fleet(3, ["tiny", "tiny", "other", "tiny"]).tolist()
    assert seeds[0] == seeds[2] == 3
    fleet = [config, config, other, config]
    together = supplied(fleet, 3)
    assert len({each.tobytes() for each in together}) == 4
    for i, each in enumerate(together):
        assert np.array_equal(each, supplied([fleet[i]], seeds[i])[0])
    assert np.array_equal(together, supplied(fleet, seeds))


def test_a_dark_hall_of_flow_by_power_returns_supply_air() -> None:
    results = simulate(
        ["hall.inlet_model=approach", "hvac.crac.flow_model=per_watt", "battery.capacity_kwh=0",
         events("kind: grid_outage, start_h: 0.5, duration_h: 0.5")],
        5,
    )  # fmt: skip
    assert column(results, "crac_flow_m3s")[2] == 0
    assert column(results, "return_c")[2] == column(results, "supply_c")[2]


@pytest.mark.parametrize("thermal", THERMAL)
def test_supply_of_the_units_averages_to_that_of_the_hall(thermal: str) -> None:
    results = simulate(
        [f"simulation.thermal={thermal}", "hvac.crac.units=3",
         events("kind: crac_down, start_h: 0.5, duration_h: 0.5")],
        8,
    )  # fmt: skip
    flow = np.array([r.unit_flow_m3s for r in results])
    supply = np.array([r.unit_supply_c for r in results])
    mean = (flow * supply).sum(axis=1) / flow.sum(axis=1)
    np.testing.assert_allclose(mean, column(results, "supply_c"), rtol=1e-9)
    if thermal == "transient":
        assert supply[2].min() > supply[0].max() + 1.0
