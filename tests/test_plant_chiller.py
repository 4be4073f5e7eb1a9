"""Chillers: reference values, energy balances, curves and their bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_steps import assert_batch, chiller_step, floating_point_errors  # noqa: F401
from sdc_taichi.plant import chiller
from sdc_taichi.plant.chiller import CHILLERS, ChillerResult

FIELDS = ChillerResult.__slots__
CURVES = (
    "centrifugal_vsd",
    "carnot",
    "eir_york",
    "electric_water_cooled",
    "electric_air_cooled",
    "eir_air_cooled",
    "released",
)

PROPERTY = settings(max_examples=60, deadline=None, derandomize=True)
# Shares of a capacity that a float cannot hold are no loads.
loads = st.lists(st.one_of(st.just(0.0), st.floats(1e-3, 3e6)), min_size=5, max_size=5)
temperatures = st.lists(st.floats(-60.0, 80.0, allow_subnormal=False), min_size=5, max_size=5)
names = st.sampled_from(sorted(CHILLERS))


def run(name: str, load_w: Any, **changes: Any) -> ChillerResult:
    arguments: dict[str, Any] = {
        "reference_w": 1e6,
        "chilled_water_c": 6.67,
        "condenser_c": 29.44,
        "outdoor_c": 35.0,
        "reference_cop": 5.96,
    }
    return chiller_step(name, np.asarray(load_w, float), **{**arguments, **changes})


@given(names, loads, temperatures, temperatures, temperatures)
@PROPERTY
def test_energy_balance_bounds_and_batch(
    name: str, load: list[float], chilled: list[float], condenser: list[float], air: list[float]
) -> None:
    loads_w = np.array(load)
    places = {
        "chilled_water_c": np.array(chilled),
        "condenser_c": np.array(condenser),
        "outdoor_c": np.array(air),
        "reference_w": 1e6 + np.array(air),
    }
    result = run(name, loads_w, **places)
    assert_batch(result, lambda i: run(name, loads_w[i], **{k: v[i] for k, v in places.items()}))
    assert all((getattr(result, field) >= 0.0).all() for field in FIELDS)
    np.testing.assert_allclose(result.evaporator_w + result.unmet_w, load, rtol=1e-12)
    np.testing.assert_allclose(result.cop * result.power_w, result.evaporator_w, rtol=1e-12)
    np.testing.assert_allclose(result.plr * result.available_w, result.evaporator_w, rtol=1e-12)
    assert (result.evaporator_w <= result.available_w).all()
    if name not in ("released", "paper"):
        np.testing.assert_allclose(
            result.rejected_w, result.evaporator_w + result.power_w, rtol=1e-12
        )


@given(names, st.floats(4.0, 20.0), st.floats(5.0, 40.0))
@PROPERTY
def test_power_rises_with_load(name: str, chilled_c: float, condenser_c: float) -> None:
    result = run(
        name,
        np.linspace(0.0, 2e6, 401),
        chilled_water_c=chilled_c,
        condenser_c=condenser_c,
        outdoor_c=condenser_c,
    )
    assert result.power_w[0] == 0.0
    assert (np.diff(result.power_w) >= 0.0).all()
    assert (np.diff(result.power_w)[result.plr[1:] < 1.0] > 0.0).all()


@pytest.mark.parametrize("name", sorted(CHILLERS))
def test_no_load_no_power(name: str) -> None:
    for load_w in (0.0, -5e4):
        result = run(name, [load_w])
        for field in ("power_w", "evaporator_w", "unmet_w", "plr", "cop", "rejected_w"):
            assert getattr(result, field)[0] == 0.0


@pytest.mark.parametrize("name", CURVES)
def test_machine_cycles_below_its_least_load(name: str) -> None:
    minimum = {"electric_water_cooled": 0.15, "electric_air_cooled": 0.05, "released": 0.05,
               "eir_air_cooled": 0.25}  # fmt: skip
    least = minimum.get(name, 0.1)
    least_w = least * run(name, [1.0]).available_w
    at_least, half, just_above = (run(name, least_w * f).power_w for f in (1.0, 0.5, 1.0 + 1e-9))
    np.testing.assert_allclose(half, 0.5 * at_least, rtol=1e-12)
    np.testing.assert_allclose(just_above, at_least, rtol=1e-8)
    # Above the least load the curve, not the cycling, decides.
    assert abs(run(name, least_w * 2.0).power_w / (2.0 * at_least) - 1.0) > 1e-3


@pytest.mark.parametrize("name", ["centrifugal_vsd", "carnot"])
def test_cop_is_calibrated_at_the_york_reference_point(name: str) -> None:
    result = run(name, 1e6, reference_cop=np.array([5.96, 4.0]))
    np.testing.assert_allclose(result.cop, [5.96, 4.0], rtol=1e-12)


def test_lift_over_the_evaporator_temperature_is_the_power_down_to_the_smallest_lift() -> None:
    evaporator_k, reference_lift_k = 283.15, 29.44 - 6.67
    condenser_c = np.array([25.0, 16.11, 9.0, -9.0])
    lift_k = np.array([15.0, 6.11, 6.11, 6.11])
    for name, added_k in (("carnot", 0.0), ("centrifugal_vsd", 22.0)):
        cop = run(name, 1e6, chilled_water_c=10.0, condenser_c=condenser_c).cop
        expected = 5.96 * (reference_lift_k + added_k) / 279.82 * evaporator_k / (lift_k + added_k)
        np.testing.assert_allclose(cop, expected, rtol=1e-12)
        lower = run(name, 1e6, chilled_water_c=10.0, condenser_c=9.0, min_lift_k=3.0)
        np.testing.assert_allclose(lower.cop / cop[3], (6.11 + added_k) / (3.0 + added_k))


def test_carnot_part_load_follows_the_york_curve() -> None:
    a, b, c = chiller.YORK_PART_LOAD
    for plr in (0.1, 0.4, 0.85):
        ratio = run("carnot", plr * 1e6).power_w / run("carnot", 1e6).power_w
        assert float(ratio) == pytest.approx((a + b * plr + c * plr**2) / (a + b + c), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "water", "low", "high"),
    [
        ("centrifugal_vsd", "chilled_water_c", 4, 20),
        ("carnot", "chilled_water_c", 4, 20),
        ("eir_york", "chilled_water_c", 4.44, 8.89),
        ("eir_york", "condenser_c", 12.78, 35.0),
        ("eir_air_cooled", "chilled_water_c", 4, 20),
    ],
)
def test_temperatures_are_held_within_the_curve(
    name: str, water: str, low: float, high: float
) -> None:
    inside = run(name, 6e5, **{water: np.array([low, high])})
    outside = run(name, 6e5, **{water: np.array([low - 9.0, high + 9.0])})
    between = run(name, 6e5, **{water: np.array([low + 0.1, high - 0.1])})
    np.testing.assert_array_equal(inside.power_w, outside.power_w)
    np.testing.assert_array_equal(inside.available_w, outside.available_w)
    assert (inside.power_w != between.power_w).all()


def test_electric_difference_is_held_above_minus_15_k() -> None:
    # Water-cooled: condenser water at 29.44 - 15*2.682759 = -10.8 C and design chilled water.
    cold = run(
        "electric_water_cooled",
        6e5,
        chilled_water_c=6.667,
        condenser_c=np.array([-10.801385, -30.0, -10.0]),
    )
    assert cold.available_w[0] == pytest.approx(cold.available_w[1], rel=1e-9)
    assert cold.available_w[2] < cold.available_w[1]
    air = run("electric_air_cooled", 6e5, outdoor_c=np.array([-6.67, -40.0, -6.0]))
    assert air.available_w[0] == pytest.approx(air.available_w[1], rel=1e-9)
    assert air.available_w[2] < air.available_w[1]


def test_air_cooled_chiller_in_frost_and_in_extreme_heat() -> None:
    # Head-pressure control keeps the condensing pressure; compressors unload above 52 C.
    cold = run("eir_air_cooled", 6e5, outdoor_c=np.array([-30.0, -5.0, 4.0, 12.0]))
    np.testing.assert_array_equal(cold.power_w[:2], cold.power_w[2])
    assert cold.power_w[3] > cold.power_w[2]
    hot = run("eir_air_cooled", 2e6, outdoor_c=np.array([44.0, 52.0, 56.0, 60.0, 70.0]))
    assert np.all(np.diff(hot.available_w[:4]) < 0.0)
    assert hot.available_w[2] == pytest.approx(0.5 * hot.available_w[1], rel=0.06)
    np.testing.assert_array_equal(hot.available_w[3:], 0.0)
    water = np.linspace(4.0, 20.0, 33)
    for outdoor_c in (-10.0, 5.0, 12.0, 20.0, 35.0, 45.0):
        warmer = run("eir_air_cooled", 6e5, chilled_water_c=water, outdoor_c=outdoor_c)
        assert np.all(np.diff(warmer.power_w) <= 1e-9 * warmer.power_w[1:])


def test_condenser_side_each_model_sees() -> None:
    by_water = {n: run(n, 6e5, condenser_c=np.array([20.0, 30.0])).power_w for n in CHILLERS}
    by_air = {n: run(n, 6e5, outdoor_c=np.array([20.0, 30.0])).power_w for n in CHILLERS}
    seen = {
        n: "water" * bool(np.ptp(by_water[n]) > 0.0) + "air" * bool(np.ptp(by_air[n]) > 0.0)
        for n in CHILLERS
    }
    assert seen == {
        "centrifugal_vsd": "water",
        "carnot": "water",
        "eir_york": "water",
        "electric_water_cooled": "water",
        "electric_air_cooled": "air",
        "eir_air_cooled": "air",
        "released": "air",
        "constant_cop": "",
        "paper": "",
    }, "a new model belongs here, with the side that its equations read"


def test_heat_wave_beyond_the_electric_curve_leaves_no_capacity() -> None:
    result = run("electric_water_cooled", 6e5, condenser_c=np.array([75.0]))
    assert result.available_w[0] == 0.0
    assert result.unmet_w[0] == 6e5
    assert result.power_w[0] == 0.0


def test_constant_cop_is_limited_by_its_capacity() -> None:
    result = run("constant_cop", [4e5, 1.5e6], reference_cop=4.0)
    np.testing.assert_allclose(result.power_w, [1e5, 2.5e5])
    np.testing.assert_allclose(result.unmet_w, [0.0, 5e5])
    np.testing.assert_allclose(result.cop, 4.0)
    np.testing.assert_allclose(result.plr, [0.4, 1.0])


def test_paper_counts_the_rejected_heat_as_electricity() -> None:
    result = run("paper", [4e5, 1.5e6], reference_cop=5.0)
    np.testing.assert_allclose(result.power_w, [4.8e5, 1.8e6])
    np.testing.assert_array_equal(result.rejected_w, result.power_w)
    np.testing.assert_array_equal(result.unmet_w, 0.0)
    np.testing.assert_allclose(result.plr, [0.4, 1.0])


def test_released_chiller_prefers_heat_and_hands_its_load_to_the_tower() -> None:
    result = run("released", 3e6, outdoor_c=np.array([20.0, 30.0, 40.0]), reference_cop=3.0)
    assert (np.diff(result.available_w) > 0.0).all()
    assert (result.unmet_w > 1e6).all()
    np.testing.assert_array_equal(result.rejected_w, 3e6)
    part_load = run("released", 4e5, outdoor_c=np.array([20.0, 30.0, 40.0]), reference_cop=3.0)
    assert (np.diff(part_load.power_w) < 0.0).all()
