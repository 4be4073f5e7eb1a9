"""CRAC units that share a plenum: whose air racks draw, what too much air does, and where it
returns."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sdc_taichi import Actions, ConfigError, Simulator, drivers_from_arrays, load_config
from sdc_taichi.hall.unit_supply import unit_weights, weighted_shares
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Conditions, Hall, HallSums
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
    layout: str, speed: Any, *overrides: str, load: float = 0.6
) -> tuple[Fleet, Hall, HallSums]:
    """Steady air of a hall whose fans have given speeds."""
    preset, units = LAYOUTS[layout]
    fleet = build_fleet([load_config(preset, [*units, GIVEN, *overrides])])
    hall = Hall(fleet, "f64", samples=False)
    speeds = np.broadcast_to(np.asarray(speed, np.float64), (fleet.units,)).copy()
    conditions = Conditions(
        np.full(fleet.units, 20.0), np.full(1, load), unit_low=speeds, unit_high=speeds
    )
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


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_split_halls_and_batches_have_the_bits_of_one(precision: Any) -> None:
    """A large hall is split among threads; its weights need a call of their own."""
    config = load_config("large", [GIVEN, *coupled(0.9, 4.0)])
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
