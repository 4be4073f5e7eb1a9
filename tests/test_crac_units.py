"""CRAC units as equipment: their sizes, their control, and who takes over for one that is lost."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import (
    Actions,
    OddInputWarning,
    SdcError,
    Simulator,
    StepResult,
    drivers_from_arrays,
    load_config,
)
from sdc_taichi.hall.unit_supply import unit_weights, weighted_shares
from sdc_taichi.sim.crac_units import CracUnits
from sdc_taichi.sim.design_hall import solve_design_hall
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.sim.sizing import air_j_per_m3_k
from sdc_taichi.sim.step_inputs import UnitIndex
from sdc_taichi.types import CoolAction

FOUR = "hvac.crac.units=4"
N_PLUS_1 = "hvac.crac.spare_units=1"
UNLIMITED = "hvac.crac.unit_sizes=null", "hvac.crac.capacity_kw=null"
MINUTES = (
    "simulation.thermal=transient",
    "simulation.steps_per_hour=60",
    "simulation.substep_s=15",
)
PROTECTED = "protection.ashrae_class=A2"
LOST = "events.scheduled=[{kind: crac_down, unit: 0, start_h: 0.05, duration_h: 100}]"


def run_at_full_load(*overrides: str, steps: int = 1) -> tuple[Fleet, list[StepResult]]:
    """Results of steps of ``corrected`` at full load."""
    config = load_config("corrected", list(overrides))
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 1.0)))
    with Simulator(config, drivers=drivers, precision="f64") as sim:
        sim.reset()
        return sim.fleet, [sim.step() for _ in range(steps)]


def test_balanced_shares_give_what_units_give() -> None:
    rng = np.random.default_rng(3)
    shares, need = rng.dirichlet(np.ones(5), 30), rng.uniform(0.5, 2.0, 30)
    given = rng.uniform(0.1, 3.0, 5)
    found = weighted_shares(shares, unit_weights(shares, need, given))
    np.testing.assert_allclose(found.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(need @ found / need.sum(), given / given.sum(), rtol=1e-9)
    # The ratio of two units is changed alike for all racks.
    change = found[:, 0] * shares[:, 1] / (found[:, 1] * shares[:, 0])
    np.testing.assert_allclose(change, change[0], rtol=1e-9)


def test_spare_units_run_at_part_speed_and_take_over_for_one_that_is_lost() -> None:
    fleet, whole = run_at_full_load(FOUR, N_PLUS_1, *MINUTES, steps=2)
    _, lost = run_at_full_load(FOUR, N_PLUS_1, PROTECTED, *MINUTES, LOST, steps=60)
    largest = fleet.unit_design_m3s.max()
    assert fleet.unit_design_m3s.sum() - largest == pytest.approx(fleet.design_flow_m3s[0])
    before = whole[-1].unit_flow_m3s / fleet.unit_design_m3s
    after = lost[-1].unit_flow_m3s / fleet.unit_design_m3s
    np.testing.assert_allclose(before, before[0], rtol=2e-3)
    # All others take over, those near it a little more than the rest.
    np.testing.assert_allclose(after[1:], after[1], rtol=0.03)
    assert after[0] == pytest.approx(0.1)
    # The others give what is missing: of every rack's air, none falls short.
    total = lost[-1].crac_flow_m3s[0]
    assert total == pytest.approx(whole[-1].crac_flow_m3s[0], rel=0.03)
    assert lost[-1].inlet_max_c[0] < whole[-1].inlet_max_c[0] + 1.5
    assert all(result.throttled_racks[0] == 0 for result in lost)


@pytest.mark.parametrize(("flow_model", "takes_over"), [("pressure", True), ("constant", False)])
def test_fans_that_hold_a_pressure_take_over_and_fixed_ones_do_not(
    flow_model: str, takes_over: bool
) -> None:
    model = f"hvac.crac.flow_model={flow_model}"
    fleet, lost = run_at_full_load(FOUR, N_PLUS_1, model, *MINUTES, LOST, steps=5)
    design = fleet.design_flow_m3s[0]
    assert lost[0].crac_flow_m3s[0] == pytest.approx(design)
    assert bool(lost[-1].crac_flow_m3s[0] == pytest.approx(design)) is takes_over
    # Less load takes as much air.
    low = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 0.2)))
    with Simulator(load_config("corrected", [FOUR, N_PLUS_1, model]), drivers=low) as sim:
        sim.reset()
        assert sim.step().crac_flow_m3s[0] == pytest.approx(design)


def test_unlike_units_give_air_by_their_size() -> None:
    sizes = [15.0, 10.0, 5.0, 10.0]
    fleet, results = run_at_full_load(FOUR, f"hvac.crac.airflow_m3s={sizes}")
    assert fleet.unit_design_m3s.tolist() == sizes
    flow = results[0].unit_flow_m3s
    np.testing.assert_allclose(flow / sizes, flow.sum() / 40.0, rtol=1e-3)
    # Units alike in size give as much as those that are sized for their racks.
    _, sized = run_at_full_load(FOUR)
    assert flow.sum() == pytest.approx(sized[0].crac_flow_m3s[0], rel=1e-6)


@pytest.mark.parametrize("spare_units", [0, 1, 2])
def test_spare_units_leave_the_design_point_as_it_is(spare_units: int) -> None:
    plain = solve_design_hall(load_config("corrected", [FOUR]))
    spare = solve_design_hall(
        load_config("corrected", [FOUR, f"hvac.crac.spare_units={spare_units}"])
    )
    assert spare.design_flow_m3s == pytest.approx(plain.design_flow_m3s)
    np.testing.assert_allclose(spare.inlet_c, plain.inlet_c, rtol=0, atol=1e-9)
    assert spare.air is not None
    assert plain.air is not None
    assert spare.air.return_c == pytest.approx(plain.air.return_c)


@pytest.mark.parametrize("preset", ["corrected", "hall_of_2026"])
@pytest.mark.parametrize(("units", "spare_units"), [(8, 2), (5, 1), (3, 2)])
def test_spare_units_make_equal_units_of_which_the_rest_suffice(
    preset: str, units: int, spare_units: int
) -> None:
    crac = [f"hvac.crac.{name}" for name in (f"units={units}", f"spare_units={spare_units}")]
    fleet = build_fleet(load_config(preset, [*crac, *UNLIMITED]))
    size_m3s = fleet.design_flow_m3s[0] / (units - spare_units)
    np.testing.assert_allclose(fleet.unit_design_m3s, size_m3s, rtol=1e-12)
    assert fleet.air is not None
    drawn_m3s = fleet.air.rack_need_m3s @ fleet.air.unit_shares.reshape(-1, units)
    np.testing.assert_allclose(drawn_m3s, drawn_m3s[0], rtol=1e-9)


def test_two_spare_units_take_over_for_two_that_are_lost() -> None:
    two = LOST.replace("]", ", {kind: crac_down, unit: 5, start_h: 0.05, duration_h: 100}]")
    eight = "hvac.crac.units=8", "hvac.crac.spare_units=2"
    _, whole = run_at_full_load(*eight, *MINUTES, steps=2)
    fleet, lost = run_at_full_load(*eight, PROTECTED, *MINUTES, two, steps=60)
    runs = np.delete(lost[-1].unit_flow_m3s / fleet.unit_design_m3s, [0, 5])
    np.testing.assert_allclose(runs, runs[0], rtol=0.02)
    assert lost[-1].inlet_max_c[0] < whole[-1].inlet_max_c[0] + 1.5
    assert all(result.throttled_racks[0] == 0 for result in lost)


def test_units_of_either_size_are_chosen_by_name() -> None:
    def sizes(*overrides: str) -> list[float]:
        crac = [f"hvac.crac.{override}" for override in overrides]
        return list(build_fleet(load_config("corrected", crac)).unit_design_m3s)

    by_need = sizes("units=8")
    assert max(by_need) > 1.1 * min(by_need)
    assert sizes("units=8", "unit_sizes=equal") == pytest.approx([sum(by_need) / 8] * 8)
    spare = sizes("units=8", "unit_sizes=by_need", "spare_units=2")
    assert spare == pytest.approx([size * spare[0] / by_need[0] for size in by_need])


@pytest.mark.parametrize("flow_model", ["follow_servers", "constant", "controlled"])
def test_units_that_are_far_too_large_run_at_their_lowest_speed(flow_model: str) -> None:
    overrides = [FOUR, "hvac.crac.spare_units=3", f"hvac.crac.flow_model={flow_model}"]
    config = load_config("corrected", [*overrides, "hvac.setpoint.initial_c=23"])
    shown = solve_design_hall(config)
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 1.0)))
    with Simulator(config, drivers=drivers, precision="f64") as sim:
        sim.reset()
        found = sim.step()
        sim.load_state_dict(sim.state_dict())
    # A quarter of full speed would do.
    np.testing.assert_allclose(found.unit_flow_m3s, 0.3 * shown.unit_m3s, rtol=1e-9)
    assert shown.design_flow_m3s == pytest.approx(found.crac_flow_m3s[0])
    np.testing.assert_allclose(found.rack_inlet_c, shown.inlet_c, rtol=0, atol=1e-6)


HEAT_UNITS = {
    "down": [N_PLUS_1, LOST],
    "one coil small": ["hvac.crac.capacity_kw=[60, 200, 200, 200]"],
    "three coils at their limit": ["hvac.crac.capacity_kw=[80, 140, 200, 300]"],
    "coils too small": ["hvac.crac.capacity_kw=100"],
    "return air": [
        "hvac.crac.temperature_control=return",
        "hvac.setpoint={min_c: 28, max_c: 38, initial_c: 33}",
        "hall.design_supply_c=18.5",
    ],
}
THERMAL = {"quasi_steady": (), "transient": MINUTES}


@pytest.mark.filterwarnings("ignore:.*the coils take out:sdc_taichi.OddInputWarning")
@pytest.mark.parametrize("thermal", THERMAL)
@pytest.mark.parametrize("case", HEAT_UNITS)
def test_heat_closes_over_the_units(case: str, thermal: str) -> None:
    fleet, results = run_at_full_load(FOUR, *THERMAL[thermal], *HEAT_UNITS[case], steps=12)
    held = 0.0
    for r in results:
        taken_w = air_j_per_m3_k(fleet) * r.unit_flow_m3s * (r.return_c - r.unit_supply_c)
        if thermal == "quasi_steady":
            # What servers give to the air is what units take out of it.
            assert taken_w.sum() == pytest.approx(r.it_w[0], rel=1e-9)
        left_kwh = (r.cooling_load_w[0] - r.heat_removed_w[0]) * r.step_h / 1e3
        assert r.room_heat_kwh[0] - held == pytest.approx(left_kwh, abs=1e-9 * r.it_w[0])
        held = float(r.room_heat_kwh[0])


def coil_w(fleet: Fleet, result: StepResult) -> np.ndarray:
    """Heat that each coil takes out, that of its fan included."""
    speed = result.unit_flow_m3s / fleet.unit_design_m3s
    fan_w = 1000.0 * fleet.unit_design_m3s * speed**3
    rise_k = result.return_c - result.unit_supply_c
    return np.asarray(air_j_per_m3_k(fleet) * result.unit_flow_m3s * rise_k + fan_w)


def test_a_coil_takes_no_more_than_its_capacity_and_the_others_take_the_rest() -> None:
    limit_w = np.array([80e3, 140e3, 200e3, 300e3])
    limits = ["hvac.crac.return_air=common", *HEAT_UNITS["three coils at their limit"]]
    fleet, results = run_at_full_load(FOUR, *limits)
    taken_w = coil_w(fleet, results[0])
    np.testing.assert_allclose(taken_w[:3], limit_w[:3], rtol=1e-9)
    assert limit_w[2] < taken_w[3] < limit_w[3]
    assert results[0].unit_supply_c[3] == 18.0
    assert results[0].unmet_w[0] == 0.0
    # In the end a transient hall is the same.
    _, slowly = run_at_full_load(FOUR, *MINUTES, *limits, steps=90)
    np.testing.assert_allclose(slowly[-1].unit_supply_c, results[0].unit_supply_c, atol=0.05)


@pytest.mark.filterwarnings("ignore:.*the coils take out:sdc_taichi.OddInputWarning")
def test_coils_that_are_too_small_leave_the_rest_to_the_room() -> None:
    _, results = run_at_full_load(FOUR, *MINUTES, "hvac.crac.capacity_kw=100", steps=30)
    for r in results:
        assert r.heat_removed_w[0] <= 400e3 * (1 + 1e-12)
    assert results[-1].room_heat_kwh[0] > results[-2].room_heat_kwh[0] > 1.0


def test_air_of_a_unit_that_is_down_passes_uncooled_to_the_racks_near_it() -> None:
    common = "hvac.crac.return_air=common"
    _, results = run_at_full_load(FOUR, N_PLUS_1, common, *MINUTES, LOST, steps=6)
    down = results[-1]
    assert down.unit_supply_c[0] == pytest.approx(down.return_c[0], abs=0.1)
    warmer = (down.rack_inlet_c - results[1].rack_inlet_c).reshape(4, 5)
    # Unit 0 stands at the low end of the rows.
    assert np.all(warmer[:2, 0] > warmer[:2, 4] + 0.1)


@pytest.mark.parametrize(("load", "supply_c"), [(1.0, (18.0, 19.0)), (0.5, (24.0, 27.0))])
def test_return_air_control_warms_the_supply_air_at_part_load(
    load: float, supply_c: tuple[float, float]
) -> None:
    """STULZ: 33 C return air, 15 K at full load: 18 C supply, at 40 to 60 % load 27 to 24 C."""
    overrides = [*HEAT_UNITS["return air"], "hvac.crac.flow_model=constant"]
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, load)))
    found = []
    for thermal in THERMAL.values():
        with Simulator(load_config("corrected", [*overrides, *thermal]), drivers=drivers) as sim:
            sim.reset()
            found.append([sim.step() for _ in range(20)][-1])
    for r in found:
        assert supply_c[0] < r.supply_c[0] < supply_c[1]
        assert 33.0 - 2.0 < r.return_c[0] < 33.0 + 0.1
    assert found[0].supply_c[0] == pytest.approx(found[1].supply_c[0], abs=0.02)


@pytest.mark.parametrize("case", ["down", "three coils at their limit", "return air"])
def test_substeps_down_to_five_seconds_converge(case: str) -> None:
    hottest, supply = {}, {}
    for substep_s in (5, 10, 20, 60):
        overrides = [FOUR, *HEAT_UNITS[case], *MINUTES, f"simulation.substep_s={substep_s}"]
        _, results = run_at_full_load(*overrides, steps=12)
        hottest[substep_s] = np.array([r.inlet_max_c[0] for r in results])
        supply[substep_s] = np.array([r.supply_c[0] for r in results])
    for found in (hottest, supply):
        error = {s: np.max(np.abs(found[s] - found[5])) for s in (10, 20, 60)}
        assert error[10] < error[60] + 1e-9
        assert error[10] < 0.1
        assert error[60] < 0.3


RESTART = "events.scheduled=[{kind: crac_down, unit: 0, start_h: 0.1, duration_h: 0.6}]"


@pytest.mark.parametrize(
    ("units", "spare_units", "flow_model"),
    [
        (1, 0, "follow_servers"), (4, 0, "follow_servers"), (4, 1, "follow_servers"),
        (4, 0, "pressure"), (2, 1, "constant"), (4, 1, "controlled"), (4, 1, "hottest_inlet"),
    ],
)  # fmt: skip
def test_a_unit_that_restarts_cools_the_hall_at_once(
    units: int, spare_units: int, flow_model: str
) -> None:
    hottest = {}
    for substep_s in (5, 60):
        _, results = run_at_full_load(
            f"hvac.crac.units={units}", f"hvac.crac.spare_units={spare_units}",
            f"hvac.crac.flow_model={flow_model}", f"simulation.substep_s={substep_s}",
            *MINUTES, RESTART, steps=46,
        )  # fmt: skip
        hottest[substep_s] = np.array([r.inlet_max_c[0] for r in results])
    # The last minute without the unit is minute 41; its casing holds a third of a second of air.
    for of_minute in hottest.values():
        assert of_minute[41] > of_minute[5] + 0.1, "the loss of the unit was felt"
        assert of_minute[42] < of_minute[41]
        assert of_minute[43:46].max() < of_minute[41]
    np.testing.assert_allclose(hottest[60], hottest[5], atol=0.3)


@pytest.mark.parametrize("kind", ["chiller_derate", "pump_down"])
def test_long_substeps_follow_the_loss_of_the_plant(kind: str) -> None:
    loss = f"events.scheduled=[{{kind: {kind}, start_h: 0.1, duration_h: 0.1, share: 0}}]"
    hottest = []
    for substep_s in (5, 60):
        overrides = [FOUR, *MINUTES, loss, f"simulation.substep_s={substep_s}"]
        _, results = run_at_full_load(*overrides, steps=16)
        hottest.append([r.inlet_max_c[0] for r in results])
    np.testing.assert_allclose(hottest[1], hottest[0], atol=0.3)


@pytest.mark.parametrize("containment", [0.0, 0.8])
@pytest.mark.parametrize("target_c", [24.0, 26.0, 30.0])
def test_fans_follow_the_hottest_inlet_between_their_limits(
    target_c: float, containment: float
) -> None:
    config = load_config(
        "corrected",
        [
            "hvac.crac.flow_model=hottest_inlet",
            f"hvac.crac.inlet_target_c={target_c}",
            f"hall.layout.containment={containment}",
        ],
    )
    loads = np.linspace(0.0, 1.0, 101)
    fleet = build_fleet([config] * len(loads))
    supply = CracUnits(fleet, UnitIndex(fleet)).initial_supply()
    met = Conditions(
        supply.coldest_supply_c, loads, unit_low=supply.unit_low, unit_high=supply.unit_high
    )
    hall = Hall(fleet, "f32")
    found = hall.solve(met)
    speed = found.unit_airflow_m3s / fleet.unit_design_m3s
    wanted = np.clip(1.0 + 0.7 * (found.inlet_max_c - target_c) / 4.0, 0.3, 1.0)
    np.testing.assert_allclose(speed, wanted, atol=1e-4)
    assert np.max(np.abs(np.diff(speed))) < 0.05
    assert hall.sweeps.max() < 500


def test_fans_that_follow_inlets_settle_where_steady_air_is() -> None:
    model = ["hvac.crac.flow_model=hottest_inlet", "hvac.crac.inlet_target_c=31"]
    _, steady = run_at_full_load(FOUR, *model)
    for substep_s in (5, 30):
        overrides = [FOUR, *model, *MINUTES, f"simulation.substep_s={substep_s}"]
        _, slowly = run_at_full_load(*overrides, steps=60)
        assert slowly[-1].inlet_max_c[0] == pytest.approx(steady[0].inlet_max_c[0], abs=0.05)
    # A unit that is lost warms inlets, and the others speed up.
    event = "events.scheduled=[{kind: crac_down, unit: 0, start_h: 1, duration_h: 100}]"
    fleet, lost = run_at_full_load(FOUR, N_PLUS_1, *model, *MINUTES, event, steps=90)
    speed = [r.unit_flow_m3s[1:] / fleet.unit_design_m3s[1:] for r in (lost[55], lost[-1])]
    assert np.all(speed[1] > speed[0] + 0.05)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("hvac.crac.airflow_m3s=5", r"airflow_m3s: the units give 5 m3/s .* takes 34\.63 m3/s"),
        (
            "hvac.crac.capacity_kw=300",
            r"capacity_kw: the coils take out 300 kW, .* give 611\.\d kW",
        ),
    ],
)
def test_units_too_small_for_the_hall_are_told(change: str, said: str) -> None:
    with pytest.warns(OddInputWarning, match=said):
        build_fleet(load_config("corrected", [change]))


def run_with_water(chilled_water: object, *overrides: str, setpoints: object = 0.0) -> StepResult:
    """Result of a step of a batch of two halls of four units in warm weather."""
    config = load_config("corrected", [FOUR, *overrides])
    drivers = drivers_from_arrays(*(np.full((2, 1), x) for x in (33.0, 24.0, 300.0, 0.8)))
    with Simulator([config, config], drivers=drivers, precision="f64") as sim:
        sim.reset()
        commands: dict[str, Any] = {"cooling": setpoints, "chilled_water": chilled_water}
        return sim.step(Actions(**commands))


@pytest.mark.parametrize(
    "plant",
    [(), ("hvac.chiller.model=eir_york",), ("hvac.chiller.model=electric_air_cooled",)],
    ids=["centrifugal", "york", "air_cooled"],
)
def test_colder_chilled_water_costs_power_and_changes_no_air(plant: tuple[str, ...]) -> None:
    usual = run_with_water(None, *plant)
    same = run_with_water(usual.chilled_water_c, *plant)
    np.testing.assert_allclose(same.hvac_w, usual.hvac_w, rtol=1e-12)
    colder = run_with_water([float(usual.chilled_water_c[0]), 5.0], *plant)
    np.testing.assert_allclose(colder.chilled_water_c, [usual.chilled_water_c[0], 5.0])
    assert colder.hvac_w[0] == pytest.approx(usual.hvac_w[0], rel=1e-12)
    assert colder.chiller_w[1] > 1.03 * usual.chiller_w[1]
    np.testing.assert_array_equal(colder.rack_inlet_c, usual.rack_inlet_c)


@pytest.mark.parametrize(
    ("water", "setpoints", "message"),
    [
        (10.1, 0.0, r"of corrected: 10\.1 C; valid is 4\.\.10 C, as the coldest supply"),
        ([9.0, 3.0], 0.0, r"of corrected: 3 C; valid is 4\.\.10 C"),
        # The coldest unit of the second hall is 2 K colder.
        ([10.0, 9.0], [0, 0, 0, 0, 0, -2, 0, 0], r"of corrected: 9 C; valid is 4\.\.8 C"),
        (np.nan, 0.0, r": nan; valid is a finite number"),
        ([9.0] * 3, 0.0, r": shape \(3,\), expected \(\) or \(2,\)"),
        ("cold", 0.0, r": 'cold' are no numbers"),
        (CoolAction.HOLD, 0.0, r": CoolAction.HOLD is no number"),
    ],
)
def test_chilled_water_that_coils_cannot_use_is_refused(
    water: object, setpoints: object, message: str
) -> None:
    with pytest.raises(SdcError, match="action chilled_water ?" + message):
        run_with_water(water, setpoints=setpoints)
