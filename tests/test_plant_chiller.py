"""Chillers: reference values, energy balances, curves and their bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_steps import chiller_step
from plant_checks import assert_batch, checks_of, floating_point_errors  # noqa: F401
from sdc_taichi.plant import chiller
from sdc_taichi.plant.chiller import CHILLERS, ChillerResult

FIELDS = ChillerResult.__slots__
CURVES = (
    "centrifugal_vsd",
    "carnot",
    "eir_york",
    "electric_water_cooled",
    "electric_air_cooled",
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


# Reference checks


def evaluated(check: dict[str, Any]) -> dict[str, float]:
    """What the model of a check gives for each quantity the check can expect."""
    inputs = check["inputs"]
    if "max_cooling_cap" in inputs:
        result = run(
            "released",
            inputs["load_W"],
            reference_w=inputs["max_cooling_cap"],
            outdoor_c=inputs["ambient_C"],
            reference_cop=3.0,
        )
        return {"P_W": float(result.power_w)}
    if "T_cond_ent" in inputs:
        name, cop, condenser_c = "eir_york", inputs["COP_nom"], inputs["T_cond_ent"]
        evaporator_c, part_load_sum = inputs["T_evap_lvg"], sum(chiller.YORK_PART_LOAD)
    elif "T_cond_in" in inputs:
        name, cop, condenser_c = "electric_water_cooled", 4.75, inputs["T_cond_in"]
        evaporator_c, part_load_sum = inputs["T_evap_out"], sum(chiller.ELECTRIC_PART_LOAD)
    else:
        name, cop, condenser_c = "electric_air_cooled", 3.0, None
        evaporator_c, part_load_sum = inputs["T_evap_out"], sum(chiller.ELECTRIC_PART_LOAD)
    place = {
        "reference_w": inputs["Q_nom_W"],
        "chilled_water_c": evaporator_c,
        "condenser_c": np.nan if condenser_c is None else condenser_c,
        "outdoor_c": inputs.get("T_amb", np.nan),
        "reference_cop": cop,
    }
    result = run(name, inputs["load_W"], **place)
    full = run(name, result.available_w, **place)
    full_load_ratio = float(full.power_w * cop / result.available_w / part_load_sum)
    capacity = float(result.available_w) / inputs["Q_nom_W"]
    return {
        "AvailNomCapRat": capacity,
        "capFunT": capacity,
        "FullLoadPowerRat": full_load_ratio,
        "EIRFunT": full_load_ratio,
        "EIRFunPLR": float(result.power_w / full.power_w) * part_load_sum,
        "PLR": float(result.plr),
        "P_W": float(result.power_w),
        "Q_evap_W": float(result.evaporator_w),
        "COP": float(result.cop),
        "unmet_W": float(result.unmet_w),
    }


@checks_of("chiller")
def test_check(check: dict[str, Any]) -> None:
    # DeltaTemp is an intermediate of Chiller:Electric; the capacity ratio is a function of it.
    expected = {k: v for k, v in check["expected"].items() if k != "DeltaTemp"}
    got = evaluated(check)
    assert {k: got[k] for k in expected} == pytest.approx(expected, **check["tolerance"], abs=1e-6)


# Invariants


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


@given(st.floats(-20.0, 60.0), st.floats(0.0, 30.0), st.floats(0.0, 10.0))
@PROPERTY
def test_power_rises_with_lift(condenser_c: float, chilled_c: float, by_k: float) -> None:
    for name in ("centrifugal_vsd", "carnot"):
        base = run(name, 6e5, condenser_c=condenser_c, chilled_water_c=chilled_c).power_w
        hotter = run(name, 6e5, condenser_c=condenser_c + by_k, chilled_water_c=chilled_c).power_w
        colder = run(name, 6e5, condenser_c=condenser_c, chilled_water_c=chilled_c - by_k).power_w
        assert hotter >= base
        assert colder >= base


@pytest.mark.parametrize("name", sorted(CHILLERS))
def test_no_load_no_power(name: str) -> None:
    for load_w in (0.0, -5e4):
        result = run(name, [load_w])
        for field in ("power_w", "evaporator_w", "unmet_w", "plr", "cop", "rejected_w"):
            assert getattr(result, field)[0] == 0.0


@pytest.mark.parametrize("name", CURVES)
def test_machine_cycles_below_its_least_load(name: str) -> None:
    minimum = {"electric_water_cooled": 0.15, "electric_air_cooled": 0.05, "released": 0.05}
    least = minimum.get(name, 0.1)
    least_w = least * run(name, [1.0]).available_w
    at_least, half, just_above = (run(name, least_w * f).power_w for f in (1.0, 0.5, 1.0 + 1e-9))
    np.testing.assert_allclose(half, 0.5 * at_least, rtol=1e-12)
    np.testing.assert_allclose(just_above, at_least, rtol=1e-8)
    # Above the least load the curve, not the cycling, decides.
    assert run(name, least_w * 2.0).power_w < 2.0 * at_least * (1.0 - 1e-3)


# Single equations


@pytest.mark.parametrize("name", ["centrifugal_vsd", "carnot"])
def test_cop_is_calibrated_at_the_york_reference_point(name: str) -> None:
    result = run(name, 1e6, reference_cop=np.array([5.96, 4.0]))
    np.testing.assert_allclose(result.cop, [5.96, 4.0], rtol=1e-12)


def test_smallest_lift_limits_the_cop_of_the_default() -> None:
    at_floor = run("centrifugal_vsd", 1e6, chilled_water_c=10.0, condenser_c=np.array([16.11, 9.0]))
    np.testing.assert_allclose(at_floor.cop, 5.96 * 283.15 / 279.82 * 44.77 / 28.11, rtol=1e-4)
    lower = run("centrifugal_vsd", 1e6, chilled_water_c=10.0, condenser_c=9.0, min_lift_k=3.0)
    np.testing.assert_allclose(lower.cop / at_floor.cop[0], 28.11 / 25.0, rtol=1e-6)


def test_carnot_cop_is_proportional_to_evaporator_temperature_over_lift() -> None:
    result = run("carnot", 1e6, chilled_water_c=np.array([10.0]), condenser_c=25.0)
    effectiveness = 5.96 * (29.44 - 6.67) / (6.67 + 273.15)
    np.testing.assert_allclose(result.cop, effectiveness * 283.15 / 15.0, rtol=1e-12)


def test_carnot_part_load_follows_the_york_curve() -> None:
    a, b, c = chiller.YORK_PART_LOAD
    for plr in (0.1, 0.4, 0.85):
        ratio = run("carnot", plr * 1e6).power_w / run("carnot", 1e6).power_w
        assert float(ratio) == pytest.approx((a + b * plr + c * plr**2) / (a + b + c), rel=1e-12)


def test_carnot_lift_has_a_floor() -> None:
    assert pytest.approx(6.11) == chiller.MIN_LIFT_K
    at_floor = run("carnot", 6e5, chilled_water_c=10.0, condenser_c=16.11)
    np.testing.assert_allclose(
        run("carnot", 6e5, chilled_water_c=10.0, condenser_c=np.array([16.0, 5.0, -9.0])).power_w,
        at_floor.power_w,
    )
    assert run("carnot", 6e5, chilled_water_c=10.0, condenser_c=16.2).power_w > at_floor.power_w
    lower = run("carnot", 6e5, chilled_water_c=10.0, condenser_c=12.0, min_lift_k=3.055)
    np.testing.assert_allclose(2.0 * lower.power_w, at_floor.power_w, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("centrifugal_vsd", 4, 20), ("carnot", 4, 20), ("eir_york", 4.44, 8.89)],
)
def test_chilled_water_is_held_within_the_curve(name: str, low: float, high: float) -> None:
    assert CHILLERS[name].chilled_water_bounds_c == (low, high)
    inside = run(name, 6e5, chilled_water_c=np.array([low, high])).power_w
    outside = run(name, 6e5, chilled_water_c=np.array([low - 9.0, high + 9.0])).power_w
    np.testing.assert_array_equal(inside, outside)
    assert inside[0] > inside[1]


def test_york_condenser_water_is_held_within_the_curve() -> None:
    inside = run("eir_york", 6e5, condenser_c=np.array([12.78, 35.0]))
    outside = run("eir_york", 6e5, condenser_c=np.array([0.0, 45.0]))
    np.testing.assert_array_equal(inside.power_w, outside.power_w)
    np.testing.assert_array_equal(inside.available_w, outside.available_w)
    between = run("eir_york", 6e5, condenser_c=np.array([12.9, 34.9]))
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


def test_electric_trades_chilled_water_for_condenser_temperature() -> None:
    # One kelvin of chilled water is worth the temperature rise coefficient on the other side.
    water = run(
        "electric_water_cooled",
        6e5,
        chilled_water_c=np.array([6.667, 9.667]),
        condenser_c=np.array([22.0, 22.0 + 3.0 * 2.682759]),
    )
    air = run(
        "electric_air_cooled",
        6e5,
        chilled_water_c=np.array([6.67, 9.67]),
        outdoor_c=np.array([22.0, 22.0 + 3.0 * 2.778]),
    )
    for result in (water, air):
        assert result.available_w[0] == pytest.approx(result.available_w[1], rel=1e-12)
        assert result.power_w[0] == pytest.approx(result.power_w[1], rel=1e-12)


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


def test_released_chiller_prefers_heat() -> None:
    result = run("released", 4e5, outdoor_c=np.array([20.0, 30.0, 40.0]), reference_cop=3.0)
    assert (np.diff(result.power_w) < 0.0).all()
    assert (np.diff(result.available_w) > 0.0).all()


def test_released_hands_the_unmet_load_to_the_tower_too() -> None:
    result = run("released", [3e6], outdoor_c=30.0, reference_cop=3.0)
    assert result.unmet_w[0] > 1e6
    assert result.rejected_w[0] == 3e6
