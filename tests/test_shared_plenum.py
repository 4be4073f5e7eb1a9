"""CRAC units that share a plenum: whose air racks draw, what too much air does, and where it
returns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import Actions, ConfigError, Simulator, drivers_from_arrays, load_config
from sdc_taichi.hall.floor_plan import floor_plan, unit_places_m
from sdc_taichi.hall.unit_supply import unit_weights, weighted_shares
from sdc_taichi.kernels.arguments import row_index
from sdc_taichi.kernels.hall_arguments import DC_COEFFICIENTS
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions, HallSums
from sdc_taichi.sim.inlet_parts import Inlets
from sdc_taichi.types import F64

GIVEN = "hvac.crac.flow_model=controlled"
SIXTEEN = (
    "hvac.crac.units=16", "hvac.crac.spare_units=2", "hvac.crac.capacity_kw=null",
    "hvac.crac.supply_length_m=4",
)  # fmt: skip
LAYOUTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "corrected": ("corrected", ("hvac.crac.units=4",)),
    "hall_of_2026": ("hall_of_2026", ()),
    "sixteen": ("hall_of_2026", SIXTEEN),
    "large": ("large", ()),
}
# Shares and air needs of three racks, airflows of two units, and shares at couplings of 1 and 0.75.
SHARES = np.array([[0.8, 0.2], [0.5, 0.5], [0.1, 0.9]])
NEED_M3S = np.array([1.0, 2.0, 1.0])


def coupled(coupling: float, oversupply: float = 0.0) -> tuple[str, str]:
    return (
        f"hvac.crac.plenum_coupling={coupling}",
        f"hall.recirculation.oversupply_decay={oversupply}",
    )


def solved(
    layout: str,
    speed: Any,
    *overrides: str,
    load: float = 0.6,
    rack_load: F64 | None = None,
    running: F64 | None = None,
) -> tuple[Fleet, Hall, HallSums]:
    """Steady air of a hall whose fans have given speeds."""
    preset, units = LAYOUTS[layout]
    fleet = build_fleet([load_config(preset, [*units, GIVEN, *overrides])])
    hall = Hall(fleet, "f64", samples=False)
    speeds = np.broadcast_to(np.asarray(speed, np.float64), (fleet.units,)).copy()
    conditions = Conditions(
        np.full(fleet.units, 20.0), np.full(1, load), rack_load, unit_low=speeds,
        unit_high=speeds, unit_running=running,
    )  # fmt: skip
    return fleet, hall, hall.solve(conditions)


def supply_shares(fleet: Fleet, hall: Hall, coupling: float) -> F64:
    """Shares of the units in the supply of each rack after a step, (R, U)."""
    assert fleet.air is not None
    strength = hall.intake_air(np.zeros(fleet.units)).unit_weight
    return weighted_shares(fleet.air.unit_shares.reshape(fleet.racks, -1), strength)


@pytest.mark.parametrize(
    ("unit_m3s", "coupling", "expected"),
    [
        ([2.0, 2.0], 1.0, [0.820541374, 0.533381591, 0.112695443]),
        ([3.0, 1.0], 1.0, [0.954308837, 0.83926751, 0.367156143]),
        ([3.0, 1.0], 0.75, [0.932509055, 0.775492823, 0.277352253]),
        ([3.0, 1.0], 0.0, [0.8, 0.5, 0.1]),
    ],
)
def test_shares_follow_airflows_by_the_coupling(
    unit_m3s: list[float], coupling: float, expected: list[float]
) -> None:
    weight = unit_weights(SHARES, NEED_M3S, np.array(unit_m3s))
    shares = weighted_shares(SHARES, weight**coupling)
    np.testing.assert_allclose(shares[:, 0], expected, atol=1e-6)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("coupling", [1.0, 0.6])
def test_racks_draw_from_units_in_proportion_to_their_airflow(layout: str, coupling: float) -> None:
    units = 16 if layout == "sixteen" else {"corrected": 4, "hall_of_2026": 6, "large": 10}[layout]
    speed = np.random.default_rng(5).uniform(0.4, 1.0, units)
    fleet, hall, result = solved(layout, speed, *coupled(coupling))
    assert fleet.air is not None
    need_m3s = fleet.air.rack_need_m3s
    layout_shares = fleet.air.unit_shares.reshape(fleet.racks, -1)
    found = supply_shares(fleet, hall, coupling)
    if coupling == 1.0:
        taken_m3s = found.T @ need_m3s
        np.testing.assert_allclose(
            taken_m3s / taken_m3s.sum(),
            result.unit_airflow_m3s / result.unit_airflow_m3s.sum(),
            rtol=1e-9 if layout != "large" else 1e-8,
        )
    weight = unit_weights(layout_shares, need_m3s, result.unit_airflow_m3s)
    np.testing.assert_allclose(
        found, weighted_shares(layout_shares, weight**coupling), rtol=0, atol=1e-7
    )


def test_a_whole_plenum_covers_every_rack_alike() -> None:
    speed = [0.3, 0.6, 0.3, 0.6]
    spread = []
    for coupling in (0.0, 0.5, 1.0):
        fleet, hall, result = solved("corrected", speed, *coupled(coupling), load=1.0)
        air = hall.intake_air(np.zeros(4))
        cover = supply_shares(fleet, hall, coupling) @ air.fresh_ratio
        spread.append(float(np.ptp(cover)))
        assert result.inlet_max_c[0] > 27.0
    assert spread[0] > 1.5 * spread[1] > 3 * spread[2]


@pytest.mark.parametrize("oversupply", [0.0, 3.0])
def test_exhaust_shares_fall_with_oversupply(oversupply: float) -> None:
    for speed in (0.4, 0.75, 1.0):
        fleet, hall, result = solved("hall_of_2026", speed, *coupled(0.0, oversupply))
        assert fleet.air is not None
        fresh_m3s = hall._fresh_m3s * speed
        share = fleet.air.exhaust_share
        need_m3s = (1.0 - share) * result.rack_airflow_m3s
        shares = fleet.air.unit_shares.reshape(fleet.racks, -1)
        ratio = shares @ (fresh_m3s / (shares.T @ need_m3s))
        lowered = Inlets(fleet, 0, hall.intake_air(np.full(6, 20.0)))._exhaust_share
        # Height factors weigh the airflow of servers, which this sum over a rack neglects.
        expected = share * np.exp(-oversupply * np.maximum(0.0, ratio - 1.0))
        np.testing.assert_allclose(lowered, expected, rtol=0.02)


def test_more_air_than_racks_need_cools_inlets_only_with_oversupply() -> None:
    def hottest(speed: float, oversupply: float) -> float:
        return float(solved("hall_of_2026", speed, *coupled(0.0, oversupply))[2].inlet_max_c[0])

    assert hottest(0.9, 0.0) == pytest.approx(hottest(0.75, 0.0), abs=1e-6)
    assert hottest(0.9, 3.0) < hottest(0.75, 3.0) - 0.3 < hottest(0.75, 0.0) - 0.6
    # Oversupply has no effect if the units deliver less air than the racks need.
    assert hottest(0.35, 3.0) == pytest.approx(hottest(0.35, 0.0), abs=1e-6)


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
@pytest.mark.parametrize("down", [False, True])
def test_parts_of_inlets_add_up_with_weighted_shares(thermal: str, down: bool) -> None:
    events = "events.scheduled=[{kind: crac_down, unit: 2, start_h: 0, duration_h: 9}]"
    config = load_config(
        "hall_of_2026",
        [GIVEN, f"simulation.thermal={thermal}", *coupled(0.75, 4.0), *([events] if down else [])],
    )
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 0.6)))
    with Simulator(config, drivers=drivers, precision="f64") as sim:
        sim.reset(0)
        for _ in range(3):
            result = sim.step(Actions(fan=np.array([-6.0, 1, 0, 2, -2, 0])))
        inlets = Inlets(sim.fleet, 0, sim.intake_air())
        for rack in inlets.hottest(5):
            parts = inlets.parts(rack)
            by_rack = parts.setpoint_c + parts.warming_k + parts.exhaust_k.sum() + parts.lag_k
            assert parts.inlet_c == pytest.approx(by_rack, abs=1e-9)
            causes_k = parts.layout_k + parts.height_k + parts.shortfall_k
            assert causes_k == pytest.approx(parts.exhaust_k.sum() + parts.lag_k, abs=1e-9)
            if thermal == "quasi_steady":
                assert parts.inlet_c == pytest.approx(result.rack_inlet_max_c[rack], abs=1e-9)
            else:
                servers = sim.servers().inlet_c
                assert parts.inlet_c <= servers.max() + 1e-9
        np.testing.assert_allclose(
            sim.servers().inlet_c.max(), inlets.parts(inlets.hottest(1)[0]).inlet_c, atol=1e-9
        )


@pytest.mark.parametrize("flow", ["follow_servers", "pressure", "hottest_inlet", "constant"])
@pytest.mark.parametrize("coupling", [0.75, 1.0])
def test_steady_and_transient_air_agree_while_a_unit_is_down(flow: str, coupling: float) -> None:
    events = "events.scheduled=[{kind: crac_down, unit: 2, start_h: 0, duration_h: 99}]"
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 0.6)))
    found = []
    for thermal in ("quasi_steady", "transient"):
        values = [
            f"hvac.crac.flow_model={flow}", "hvac.crac.units=4", "hvac.crac.spare_units=1",
            f"simulation.thermal={thermal}", *coupled(coupling, 4.0), events,
        ]  # fmt: skip
        with Simulator(load_config("corrected", values), drivers=drivers, precision="f64") as sim:
            sim.reset(0)
            for _ in range(2 if thermal == "quasi_steady" else 24):
                result = sim.step()
            found.append(result)
    np.testing.assert_allclose(found[1].unit_flow_m3s, found[0].unit_flow_m3s, rtol=5e-3)
    np.testing.assert_allclose(found[1].rack_inlet_c, found[0].rack_inlet_c, atol=0.05)


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_a_hall_whose_racks_are_all_off_has_finite_air(thermal: str) -> None:
    values = [
        "hvac.crac.units=3", f"simulation.thermal={thermal}", *coupled(0.75, 4.0),
        "protection.ashrae_class=A1",
        "events.scheduled=[{kind: crac_down, start_h: 0.5, duration_h: 1}]",
    ]  # fmt: skip
    with Simulator(load_config("corrected", values)) as sim:
        sim.reset(0)
        results = [sim.step() for _ in range(12)]
    assert min(r.it_w[0] for r in results) < 0.01 * results[0].it_w[0]
    for result in results:
        assert np.isfinite(result.rack_inlet_c).all()
        assert 0.0 < result.inlet_max_c[0] < 200.0


RETURN_SETPOINT = (
    "hvac.crac.temperature_control=return", "hvac.setpoint.min_c=28", "hvac.setpoint.max_c=38",
    "hvac.setpoint.initial_c=33",
)  # fmt: skip
OWN = "hvac.crac.return_air=own"
# Halls whose return air acts on their supply air: layout, overrides, and units that run.
RETURNS: dict[str, tuple[str, list[str], list[float]]] = {
    "coils at their limit": (
        "hall_of_2026",
        ["hvac.crac.capacity_kw=[200, 520, 520, 520, 200, 520]"],
        [1, 1, 1, 1, 1, 1],
    ),
    "a unit down": ("hall_of_2026", [*coupled(0.75, 4.0)], [1, 1, 0, 1, 1, 1]),
    "fixed shares, a unit down": ("hall_of_2026", [*coupled(0.0)], [1, 0, 1, 1, 1, 1]),
    "return-air control": ("hall_of_2026", [*RETURN_SETPOINT, *coupled(0.75)], [1, 1, 1, 1, 1, 1]),
    "small units": (
        "corrected",
        ["hvac.crac.capacity_kw=[60, 200, 200, 200]", *coupled(1.0, 4.0)],
        [1, 1, 1, 1],
    ),
}


def returns_by_balance(fleet: Fleet, hall: Hall, result: HallSums) -> F64:
    """Return air of each unit by balances of air and heat of every rack and unit, in C, (U,)."""
    assert fleet.air is not None
    assert fleet.air.return_shares is not None
    heat_w = result.rack_cpu_w + result.rack_fan_w
    recirculated_m3s = hall._places.values_of_racks(hall._memory["captured_m3s"][None])[0]
    fresh_m3s = result.rack_airflow_m3s - recirculated_m3s
    air = hall.intake_air(np.zeros(fleet.units))
    layout_shares = fleet.air.unit_shares.reshape(fleet.racks, -1)
    from_unit = weighted_shares(layout_shares, air.unit_weight) * air.fresh_ratio
    from_unit /= from_unit.sum(axis=1, keepdims=True)
    drawn_m3s = fresh_m3s @ from_unit
    air_j_per_m3_k = fleet.dcs[row_index(DC_COEFFICIENTS, "air_j_per_m3_k"), 0]
    returned_m3k_s = heat_w / air_j_per_m3_k + fresh_m3s * (from_unit @ air.supply_c)
    to_unit = fleet.air.return_shares.reshape(fleet.racks, -1)
    to_unit = weighted_shares(to_unit, unit_weights(to_unit, fresh_m3s, drawn_m3s))
    bypass_m3s = result.unit_airflow_m3s - drawn_m3s
    returned = returned_m3k_s @ to_unit + bypass_m3s * air.supply_c
    return np.asarray(returned / result.unit_airflow_m3s)


@pytest.mark.parametrize("kind", RETURNS)
def test_own_returns_close_the_balances_of_air_and_heat(kind: str) -> None:
    layout, overrides, running = RETURNS[kind]
    runs = np.array(running, np.float64)
    speed = np.where(runs > 0, np.linspace(1.0, 0.7, len(runs)), 0.1)
    fleet, hall, result = solved(layout, speed, OWN, *overrides, running=runs)
    offset_k = hall._unit_state["return_offset_k"]
    return_c = result.units_return_c[0] + offset_k
    flow_m3s = result.unit_airflow_m3s
    mean_c = flow_m3s @ return_c / flow_m3s.sum()
    assert mean_c == pytest.approx(result.units_return_c[0], rel=1e-12)
    np.testing.assert_allclose(return_c, returns_by_balance(fleet, hall, result), rtol=1e-9)
    assert np.ptp(return_c) > (0.15 if kind == "return-air control" else 0.5)
    # Coils at their limit, units that are down and return-air control act on a unit's own return.
    at_limit = flow_m3s * fleet.dcs[row_index(DC_COEFFICIENTS, "air_j_per_m3_k"), 0]
    at_limit *= return_c - result.unit_supply_c
    at_limit += 1e3 * fleet.unit_design_m3s * speed**3
    limited = (runs > 0) & (result.unit_supply_c > 20.0 + 1e-6)
    if kind == "return-air control":
        rise_k = return_c - result.unit_supply_c
        over_k = fleet.setpoint_over_supply_k[0]
        share = np.maximum(0.0, over_k - rise_k) * (1.0 - 2.0 / over_k)
        np.testing.assert_allclose(result.unit_supply_c, 20.0 + share, atol=1e-6)
    else:
        np.testing.assert_allclose(at_limit[limited], fleet.unit_capacity_w[limited], rtol=1e-6)
        assert limited.any() == ("capacity" in overrides[0])
    np.testing.assert_allclose(result.unit_supply_c[runs == 0], return_c[runs == 0], atol=1e-6)


def test_the_unit_beside_dense_racks_draws_warmer_air() -> None:
    """Racks of row 0 work, the others idle: units at the near ends of the walls draw their heat."""
    values = ["hvac.crac.capacity_kw=520", "hvac.crac.supply_length_m=3", *coupled(0.0)]
    load = np.repeat(np.where(np.arange(12) < 4, 1.0, 0.1), 18)
    found = []
    for kind in ("own", "common"):
        _, hall, result = solved(
            "hall_of_2026", 0.9, f"hvac.crac.return_air={kind}", *values, rack_load=load
        )
        found.append(result.units_return_c[0] + hall._unit_state["return_offset_k"])
    own_c, common_c = found
    # Units 0 and 1 stand beside the first rows, units 4 and 5 beside the last.
    assert own_c[:2].min() > own_c[2:4].max() > own_c[4:].max()
    np.testing.assert_array_equal(common_c, common_c[0])


@pytest.mark.parametrize("kind", RETURNS)
def test_steady_and_transient_own_returns_agree(kind: str) -> None:
    layout, overrides, running = RETURNS[kind]
    preset, units = LAYOUTS[layout]
    down = [
        f"{{kind: crac_down, unit: {k}, start_h: 0, duration_h: 99}}"
        for k, runs in enumerate(running)
        if not runs
    ]
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 0.6)))
    found = []
    for thermal in ("quasi_steady", "transient"):
        values = [
            *units, GIVEN, OWN, *overrides, f"simulation.thermal={thermal}",
            f"events.scheduled=[{', '.join(down)}]",
        ]  # fmt: skip
        with Simulator(load_config(preset, values), drivers=drivers, precision="f64") as sim:
            sim.reset(0)
            for _ in range(1 if thermal == "quasi_steady" else 24):
                result = sim.step()
            found.append(result)
    np.testing.assert_allclose(found[1].unit_supply_c, found[0].unit_supply_c, atol=0.05)
    np.testing.assert_allclose(found[1].rack_inlet_c, found[0].rack_inlet_c, atol=0.05)
    np.testing.assert_allclose(found[1].hvac_w, found[0].hvac_w, rtol=2e-3)


def test_a_unit_passes_its_own_return_air_while_it_is_down_and_after_its_restart() -> None:
    event = "events.scheduled=[{kind: crac_down, unit: 0, start_h: 0.5, duration_h: 1}]"
    values = ["simulation.thermal=transient", "hvac.crac.supply_length_m=3", event]
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 0.6)))
    found = {}
    for kind in ("own", "common"):
        config = load_config("hall_of_2026", [*values, f"hvac.crac.return_air={kind}"])
        with Simulator(config, drivers=drivers, precision="f64") as sim:
            sim.reset(0)
            found[kind] = [(sim.step(), sim.state) for _ in range(12)]
    # A step's supply air is a mean, which return air at its end agrees with once both are steady.
    for result, state in found["own"][4:6]:
        assert result.unit_supply_c[0] == pytest.approx(state.return_air_c[0], abs=0.1)
        assert abs(result.unit_supply_c[0] - result.return_c[0]) > 0.3
    for _, state in found["common"][4:6]:
        np.testing.assert_array_equal(state.return_air_c, state.return_air_c[0])
    np.testing.assert_allclose(found["own"][11][0].unit_supply_c, 23.0, atol=0.05)


def test_a_unit_without_airflow_has_the_return_air_of_the_hall() -> None:
    running = np.array([0.0, 1.0, 1.0, 1.0])
    _, hall, sums = solved("corrected", running, OWN, load=0.9, running=running)
    assert hall.sweeps[0] < 100
    offset_k = hall._unit_state["return_offset_k"]
    assert offset_k[0] == 0.0
    assert 0.0 < np.abs(offset_k[1:]).max() < 10.0
    assert hall._unit_state["supply_c"][0] == pytest.approx(sums.units_return_c[0], abs=1e-6)


@pytest.mark.parametrize("flow_model", ["follow_servers", "pressure", "controlled"])
def test_a_saved_hall_goes_on_the_same_while_a_unit_is_down(flow_model: str) -> None:
    event = "events.scheduled=[{kind: crac_down, unit: 1, start_h: 0.25, duration_h: 0.5}]"
    config = load_config(
        "corrected",
        ["hvac.crac.units=4", f"hvac.crac.flow_model={flow_model}", event,
         "simulation.thermal=transient"],
    )  # fmt: skip
    drivers = drivers_from_arrays(*(np.full((1, 1), x) for x in (20.0, 14.0, 300.0, 0.8)))
    with Simulator(config, drivers=drivers) as sim, Simulator(config, drivers=drivers) as fresh:
        sim.reset(0)
        fresh.reset(0)
        for _ in range(4):
            fresh.load_state_dict(sim.state_dict())
            expected, found = sim.step(), fresh.step()
            for name in ("rack_inlet_c", "unit_flow_m3s", "unit_supply_c"):
                np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize(
    ("preset", "overrides", "expected"),
    [
        ("corrected", ["hvac.crac.units=4"], (0.75, 4.0, True)),
        ("corrected", [], (0.0, 0.0, False)),
        ("hall_of_2026", ["hall.layout.returns=end_wall"], (0.75, 2.6, True)),
        ("hall_of_2026", [*coupled(0.0), "hvac.crac.return_air=common"], (0.0, 0.0, False)),
        ("corrected", [f"hvac.crac.unit_shares={[[0.5, 0.5]] * 20}", "hvac.crac.units=2"],
         (0.0, 4.0, False)),
        ("sustaindc", [], (0.0, 0.0, False)),
        ("paper", [], (0.0, 0.0, False)),
    ],
)  # fmt: skip
def test_halls_with_raised_floors_couple_their_units_by_default(
    preset: str, overrides: list[str], expected: tuple[float, float, bool]
) -> None:
    fleet = build_fleet([load_config(preset, overrides)])
    found = fleet.plenum_coupling[0], fleet.oversupply_decay[0], bool(fleet.own_return[0])
    assert found == expected
    # Without recirculation there is nothing on which oversupply and return air could act.
    assert (fleet.air is None) == (preset in ("sustaindc", "paper"))


def near_and_far(fleet: Fleet, unit: int) -> tuple[Any, Any]:
    """True for the fifth of the racks nearest to a unit, and for the fifth farthest from it."""
    plan = floor_plan(fleet.configs[0].hall)
    place_m = unit_places_m(plan, fleet.units)[unit]
    distance_m = np.hypot(*(plan.front_m - place_m).T)
    return distance_m <= np.quantile(distance_m, 0.2), distance_m >= np.quantile(distance_m, 0.8)


@pytest.mark.parametrize("unit", [0, 3])
def test_a_lost_unit_warms_the_racks_near_it_most(unit: int) -> None:
    """At constant speeds nothing replaces its air; coupling leaves the lack of air near it."""
    runs = np.ones(6)
    runs[unit] = 0.0
    spread_k = {}
    for coupling in (0.75, 0.0):
        warmer_k = []
        for running in (np.ones(6), runs):
            speed = np.where(running > 0, 0.6, 0.1)
            fleet, _, result = solved(
                "hall_of_2026", speed, OWN, *coupled(coupling, 4.0), running=running, load=0.9
            )
            warmer_k.append(result.rack_inlet_c)
        near, far = near_and_far(fleet, unit)
        change_k = warmer_k[1] - warmer_k[0]
        spread_k[coupling] = change_k[near].mean(), change_k[far].mean()
    coupled_k, fixed_k = spread_k[0.75], spread_k[0.0]
    assert coupled_k[0] > 1.3 * coupled_k[1] > 0.0
    assert coupled_k[0] - coupled_k[1] > 1.5 * (fixed_k[0] - fixed_k[1])


def test_more_air_of_one_unit_cools_its_racks() -> None:
    speed = np.full(6, 0.75)
    faster = speed.copy()
    faster[2] = 1.0
    for coupling in (0.0, 0.75):
        inlets_c = [
            solved("hall_of_2026", s, *coupled(coupling, 4.0), "hall.layout.containment=0.5")
            for s in (speed, faster)
        ]
        near, far = near_and_far(inlets_c[0][0], 2)
        change_k = inlets_c[1][2].rack_inlet_c - inlets_c[0][2].rack_inlet_c
        assert change_k[near].mean() < -0.25
        assert change_k[near].mean() < 1.4 * change_k[far].mean() < 0.0


@pytest.mark.parametrize(("thermal", "precision"), [("quasi_steady", "f64"), ("transient", "f32")])
def test_plain_halls_keep_their_bits_beside_halls_with_coupled_units(
    thermal: str, precision: Any
) -> None:
    """Without coupling, oversupply and own returns a kernel without this work computes a hall."""
    event = "events.scheduled=[{kind: crac_down, unit: 2, start_h: 0.5, duration_h: 0.5}]"
    values = [
        GIVEN, f"simulation.thermal={thermal}", "hvac.crac.units=4",
        "hvac.crac.capacity_kw=[60, 200, 200, 200]", event, "name=plain",
    ]  # fmt: skip
    plain = load_config("corrected", [*values, *coupled(0.0), "hvac.crac.return_air=common"])
    other = load_config("corrected", [*values, *coupled(0.75, 4.0), OWN, "name=other"])
    results = []
    for configs in ([plain], [plain, other], [other]):
        with Simulator(configs, precision=precision) as sim:
            sim.reset([0] * len(configs))
            for _ in range(4):
                result = sim.step(Actions(fan=np.tile([-3.0, 1, 0, 2], len(configs))))
            results.append(result)
    alone, beside, last = results
    for name in ("rack_inlet_c", "unit_supply_c", "hvac_w", "return_c"):
        first, second = np.split(getattr(beside, name), 2)
        np.testing.assert_array_equal(first, getattr(alone, name))
        np.testing.assert_array_equal(second, getattr(last, name))
        assert not np.array_equal(first, second)


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_split_halls_and_batches_have_the_bits_of_one(precision: Any) -> None:
    """A large hall is split among threads; its weights need a call of their own."""
    config = load_config(
        "large", [GIVEN, *coupled(0.9, 4.0), OWN, f"hvac.crac.capacity_kw={[1200] + [2000] * 9}"]
    )
    fans = np.linspace(-6.0, 2.0, 10)
    results = []
    for batch in (1, 2):
        with Simulator([config] * batch, precision=precision) as sim:
            sim.reset([0] * batch)
            for _ in range(2):
                result = sim.step(Actions(fan=np.tile(fans, batch)))
            results.append(result)
            saved = sim.state_dict()
            going_on = sim.step(Actions(fan=np.tile(fans, batch)))
            sim.load_state_dict(saved)
            again = sim.step(Actions(fan=np.tile(fans, batch)))
            np.testing.assert_array_equal(again.rack_inlet_c, going_on.rack_inlet_c)
    one, two = results
    np.testing.assert_array_equal(two.rack_inlet_c[: len(one.rack_inlet_c)], one.rack_inlet_c)
    np.testing.assert_array_equal(two.unit_flow_m3s[:10], one.unit_flow_m3s)


@pytest.mark.parametrize(
    ("field", "bad"),
    [
        ("hvac.crac.plenum_coupling", "1.1"),
        ("hvac.crac.plenum_coupling", "-0.1"),
        ("hall.recirculation.oversupply_decay", "-1"),
        ("hall.recirculation.oversupply_decay", "21"),
    ],
)
def test_values_out_of_bounds_are_refused(field: str, bad: str) -> None:
    with pytest.raises(ConfigError, match=field.rsplit(".", 1)[1]):
        load_config("corrected", [f"{field}={bad}"])
