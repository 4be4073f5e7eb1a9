"""Cooling towers: reference values, YorkCalc, fans."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_steps import assert_batch, floating_point_errors  # noqa: F401
from sdc_taichi.errors import SdcError
from sdc_taichi.plant import tower
from sdc_taichi.plant.tower import TOWERS, TowerPoint, TowerResult
from sdc_taichi.plant.water import WATER, WaterPoint

PROPERTY = settings(max_examples=60, deadline=None, derandomize=True)
wet_bulbs = st.floats(-34.4, 26.7)
ranges = st.floats(1.1, 22.2)
five: dict[str, Any] = {"min_size": 5, "max_size": 5}

# Design point of a York tower: 25.55 C wet bulb, 5.56 K range, 3.89 K approach.
HEAT_W = 1e6
WATER_KG_S = HEAT_W / (4184.0 * 5.56)
REFERENCE_WATER_KG_S = float(
    tower.yorkcalc_reference_water_kg_s(WATER_KG_S, wet_bulb_c=25.55, range_k=5.56, approach_k=3.89)
)
DESIGN_FAN_W = 2e4


def run(name: str, heat_w: Any, **changes: Any) -> TowerResult:
    arguments: dict[str, Any] = {
        "wet_bulb_c": 20.0,
        "outdoor_c": 25.0,
        "condenser_setpoint_c": 24.0,
        "supply_setpoint_c": 18.0,
        "water_kg_s": WATER_KG_S,
        "reference_water_kg_s": REFERENCE_WATER_KG_S,
        "reference_air_m3s": 53.48945350914959,
        "design_fan_w": DESIGN_FAN_W,
        "air_j_per_m3_k": 1.225 * 1006.0,
    }
    return TOWERS[name].step(np.asarray(heat_w, float), TowerPoint(**{**arguments, **changes}))


# YorkCalc


@given(wet_bulbs, ranges)
@PROPERTY
def test_ratio_is_the_least_air_that_reaches_the_approach(
    wet_bulb_c: float, range_k: float
) -> None:
    beyond = tower.yorkcalc_liquid_gas_ratio(wet_bulb_c, range_k, np.linspace(-5.0, 60.0, 131))
    assert ((beyond >= 0.0) & (beyond <= 8.0)).all()
    assert (np.diff(beyond) >= -1e-12).all()
    # Against a search over a grid of ratios, from much air to little.
    wanted_k = np.linspace(1.2, 39.8, 100)
    grid = np.linspace(0.0, 8.0, 4001)
    approach = tower.yorkcalc_approach_k(wet_bulb_c, range_k, grid)
    ratio = tower.yorkcalc_liquid_gas_ratio(wet_bulb_c, range_k, wanted_k)
    for k, x in zip(wanted_k, ratio, strict=True):
        exceeded = np.flatnonzero(approach > k)
        first = grid[exceeded[0]] if exceeded.size else 8.0
        assert x == pytest.approx(first, abs=4e-3)


def test_approach_is_evaluated_within_its_bounds() -> None:
    approach = tower.yorkcalc_approach_k
    assert approach(40.0, 6.0, 1.0) == approach(26.7, 6.0, 1.0) != approach(26.5, 6.0, 1.0)
    assert approach(-50.0, 6.0, 1.0) == approach(-34.4, 6.0, 1.0) != approach(-34.0, 6.0, 1.0)
    assert approach(20.0, -0.1, 1.0) == approach(20.0, 0.0, 1.0) != approach(20.0, 0.1, 1.0)
    assert approach(20.0, 30.0, 1.0) == approach(20.0, 22.2, 1.0) != approach(20.0, 22.19, 1.0)
    assert approach(20.0, 3.0, 20.0) == approach(20.0, 3.0, 8.0) != approach(20.0, 3.0, 7.9)
    assert 0.0 < approach(20.0, 1.1, 0.5) < 1.1
    assert approach(26.0, 0.0, 0.1) == 0.0
    assert approach(-30.0, 20.0, 4.0) > 40.0


def test_reference_flow_meets_the_design_point_at_full_air() -> None:
    result = run("yorkcalc", HEAT_W, wet_bulb_c=25.55, condenser_setpoint_c=25.55 + 3.89)
    assert float(result.air_ratio) == pytest.approx(1.0, rel=1e-9)
    assert float(result.fan_w) == pytest.approx(DESIGN_FAN_W, rel=1e-9)
    assert float(result.approach_k) == pytest.approx(3.89)
    assert float(result.range_k) == pytest.approx(5.56)


def test_unreachable_design_approach_is_an_error() -> None:
    with pytest.raises(
        SdcError, match=r"of 4 K at wet bulb -20 C and range 5\.56 K; .* above 5\.81 K"
    ):
        tower.yorkcalc_reference_water_kg_s(
            WATER_KG_S, wet_bulb_c=np.array([20.0, -20.0]), range_k=5.56, approach_k=4.0
        )


@given(
    st.lists(st.just(0.0) | st.floats(1.0, 5e6), **five),
    st.lists(st.floats(-60.0, 50.0), **five),
    st.lists(st.floats(5.0, 40.0), **five),
    st.sampled_from(sorted(TOWERS)),
)
@PROPERTY
def test_heat_balance_bounds_and_batch(
    heat: list[float], wet_bulb: list[float], setpoint: list[float], name: str
) -> None:
    wet, outdoor = np.array(wet_bulb), np.array(wet_bulb) + 3.0
    changes = {"wet_bulb_c": wet, "outdoor_c": outdoor, "condenser_setpoint_c": np.array(setpoint)}
    result = run(name, heat, **changes)
    heat_w = np.array(heat)
    assert_batch(result, lambda i: run(name, heat_w[i], **{k: v[i] for k, v in changes.items()}))
    np.testing.assert_allclose(result.range_k * WATER_KG_S * 4184.0, heat, rtol=1e-12)
    np.testing.assert_allclose(result.leaving_c - wet, result.approach_k, rtol=1e-12, atol=1e-12)
    assert (result.fan_w >= 0.0).all()
    assert (result.air_ratio >= 0.0).all()
    if name != "paper":
        assert (result.air_ratio <= 1.0).all()
    if name == "released":
        np.testing.assert_allclose(result.fan_w, DESIGN_FAN_W * result.air_ratio**3, rtol=1e-12)
    if name == "yorkcalc":
        assert (result.leaving_c >= np.array(setpoint) - 1e-9).all()
        above = result.leaving_c > np.array(setpoint) + 1e-9
        assert (result.air_ratio[above] == 1.0).all()
        assert (result.approach_k[above] >= 0.0).all()
        # The mean cube of the speeds of a fan that goes on and off is at most their mean.
        assert (result.fan_w <= DESIGN_FAN_W * result.air_ratio * (1.0 + 1e-9)).all()
        assert (result.air_ratio[result.fan_w > 0.0] >= tower.FREE_CONVECTION_SHARE).all()
        assert (result.air_ratio[np.array(heat) > 0.0] > 0.0).all()


@given(st.floats(1e4, 3e6), st.floats(-30.0, 30.0))
@PROPERTY
def test_fan_slows_as_the_setpoint_rises(heat_w: float, wet_bulb_c: float) -> None:
    result = run(
        "yorkcalc", heat_w, wet_bulb_c=wet_bulb_c, condenser_setpoint_c=np.linspace(0.0, 60.0, 121)
    )
    assert (np.diff(result.air_ratio) <= 1e-9).all()
    assert (np.diff(result.leaving_c) >= -1e-9).all()


def test_full_speed_lets_the_water_rise_above_the_setpoint() -> None:
    result = run("yorkcalc", HEAT_W, wet_bulb_c=15.0, condenser_setpoint_c=np.array([16.0, 10.0]))
    full = tower.yorkcalc_approach_k(15.0, 5.56, WATER_KG_S / REFERENCE_WATER_KG_S)
    np.testing.assert_array_equal(result.air_ratio, 1.0)
    np.testing.assert_array_equal(result.fan_w, DESIGN_FAN_W)
    np.testing.assert_allclose(result.leaving_c, 15.0 + full, rtol=1e-12)


def test_fan_is_off_once_free_convection_carries_the_heat() -> None:
    heat_w, wet_bulb_c = 2e5, -10.0
    range_k = heat_w / (4184.0 * WATER_KG_S)
    water_ratio = WATER_KG_S / REFERENCE_WATER_KG_S
    # T_in - T_out = f*(T_in - T_out_full), f = 1/8: at full speed the range is eight times that.
    full = tower.yorkcalc_approach_k(wet_bulb_c, 8.0 * range_k, water_ratio)
    threshold_c = wet_bulb_c + full + 7.0 * range_k
    setpoint_c = threshold_c + np.array([-1e-3, 1e-3])
    result = run("yorkcalc", heat_w, wet_bulb_c=wet_bulb_c, condenser_setpoint_c=setpoint_c)
    assert 0.0 < result.fan_w[0] < 0.01 * 0.2**3 * DESIGN_FAN_W
    assert result.fan_w[1] == 0.0
    np.testing.assert_allclose(result.air_ratio, tower.FREE_CONVECTION_SHARE, rtol=5e-3)
    np.testing.assert_allclose(result.leaving_c, setpoint_c)


@pytest.mark.parametrize("wet_bulb_c", [-20.0, 0.0, 15.0, 26.0])
@pytest.mark.parametrize("approach_k", [9.0, 15.0, 25.0])
def test_air_at_rest_is_proportional_to_a_small_heat(wet_bulb_c: float, approach_k: float) -> None:
    heat_w = 1e3 * np.array([1e-3, 0.1, 1.0, 10.0])
    result = run(
        "yorkcalc",
        heat_w,
        wet_bulb_c=wet_bulb_c,
        condenser_setpoint_c=wet_bulb_c + approach_k,
        water_kg_s=0.2 * WATER_KG_S,
    )
    np.testing.assert_array_equal(result.fan_w, 0.0)
    per_w = result.air_ratio / heat_w
    np.testing.assert_allclose(per_w[:3], per_w[0], rtol=0.05)
    assert np.all(result.air_ratio > 0.0)
    assert np.all(result.air_ratio < tower.FREE_CONVECTION_SHARE)


@pytest.mark.parametrize("dry_k", [0.0, 8.0, 22.0])
@pytest.mark.parametrize("wet_bulb_c", [-10.0, 5.0, 15.0, 24.0])
def test_a_tower_at_rest_evaporates_what_its_heat_and_the_warmth_of_its_air_allow(
    wet_bulb_c: float, dry_k: float
) -> None:
    heat_w = HEAT_W * np.geomspace(1e-4, 0.2, 40)
    water_kg_s = np.maximum(WATER_KG_S * heat_w / HEAT_W, 0.2 * WATER_KG_S)
    outdoor_c, pressure_pa, design_m3s = wet_bulb_c + dry_k, 101_325.0, 2.667e-5 * HEAT_W
    done = run(
        "yorkcalc",
        heat_w,
        wet_bulb_c=wet_bulb_c,
        condenser_setpoint_c=wet_bulb_c + 6.0,
        water_kg_s=water_kg_s,
    )
    air_m3s = done.air_ratio * design_m3s
    place = (outdoor_c, wet_bulb_c, pressure_pa, 30.0, 18.0, 5.0, 0.0, 1.0)
    water = WATER["saturated_exit"](WaterPoint(heat_w, done.range_k, water_kg_s, air_m3s, *place))
    at_rest = done.fan_w == 0.0
    assert at_rest[0]
    latent_w = water.evaporation_l[at_rest] * 2.45e6
    # The air cools at most to the wet bulb, and gives the water that warmth.
    warmth_w = 1.25 * 1006.0 * air_m3s[at_rest] * dry_k
    assert np.all(latent_w <= 1.05 * (heat_w[at_rest] + warmth_w))
    # The enthalpy that the air gains does not vanish with the heat.
    assert np.max(latent_w / heat_w[at_rest]) < 1.0 + dry_k / 6.0


def test_fan_goes_on_and_off_below_its_lowest_speed() -> None:
    """Fan power falls evenly from that of the lowest speed to 0."""
    heat_w, wet_bulb_c = 4e5, 5.0
    range_k, water_ratio = heat_w / (4184.0 * WATER_KG_S), WATER_KG_S / REFERENCE_WATER_KG_S
    slow = tower.yorkcalc_approach_k(wet_bulb_c, range_k, water_ratio / tower.MIN_AIR_RATIO)
    off = tower.yorkcalc_approach_k(wet_bulb_c, 8.0 * range_k, water_ratio) + 7.0 * range_k
    approach_k = slow + (off - slow) * np.array([-0.01, 0.0, 0.25, 0.75, 1.0])
    result = run(
        "yorkcalc", heat_w, wet_bulb_c=wet_bulb_c, condenser_setpoint_c=wet_bulb_c + approach_k
    )
    share = result.fan_w / (0.2**3 * DESIGN_FAN_W)
    np.testing.assert_allclose(share[1:], [1.0, 0.75, 0.25, 0.0], atol=1e-9)
    assert share[0] > 1.0
    np.testing.assert_allclose(result.air_ratio[1:], 0.125 + 0.075 * share[1:])


def test_idle_tower_costs_nothing() -> None:
    for name in TOWERS:
        result = run(name, [0.0], water_kg_s=0.0)
        assert result.fan_w[0] == 0.0
        assert result.range_k[0] == 0.0
        assert result.leaving_c[0] == 24.0
    assert run("yorkcalc", [0.0]).air_ratio[0] == 0.0  # With water, and no heat.


# Air-side towers


def test_released_airflow_carries_the_heat_up_to_full_speed() -> None:
    # 50 - (45 - 18) = 23 K, and at least 1 K.
    heat_w = 1225.0 * 1.006 * 23.0 * 26.744726754574795
    assert float(run("released", heat_w, outdoor_c=45.0).air_ratio) == pytest.approx(0.5)
    assert float(run("released", heat_w, outdoor_c=45.0).fan_w) == pytest.approx(DESIGN_FAN_W / 8)
    assert float(run("released", 1e9).fan_w) == DESIGN_FAN_W
    warm = run("released", 1e3, outdoor_c=np.array([67.0, 90.0])).air_ratio
    assert warm[0] == warm[1] == pytest.approx(1e3 / (1225.0 * 1.006) / 53.48945350914959)
    other_air = run("released", heat_w, outdoor_c=45.0, air_j_per_m3_k=2.45 * 503.0)
    assert float(other_air.air_ratio) == pytest.approx(0.5)


def test_paper_fan_power_falls_with_the_cube_of_the_airflow() -> None:
    heat_w = 1225.0 * 1.006 * 43.0 * 53.48945350914959
    result = run("paper", heat_w * np.array([1.0, 0.5, 2.0]))
    np.testing.assert_allclose(result.air_ratio, [1.0, 0.5, 2.0])
    np.testing.assert_allclose(result.fan_w, DESIGN_FAN_W * np.array([1.0, 8.0, 0.125]))
    assert run("paper", heat_w, outdoor_c=-20.0).fan_w > DESIGN_FAN_W
