"""Make-up water: reference values, balances, climates."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_steps import assert_batch, floating_point_errors  # noqa: F401
from sdc_taichi.exogenous import psychrometrics
from sdc_taichi.plant import moist_air
from sdc_taichi.plant.water import WATER, WaterPoint
from sdc_taichi.types import WaterQuantities

FIELDS = tuple(f.name for f in fields(WaterQuantities))

PROPERTY = settings(max_examples=80, deadline=None, derandomize=True)
five: dict[str, Any] = {"min_size": 5, "max_size": 5}


def run(name: str, **changes: Any) -> WaterQuantities:
    arguments: dict[str, Any] = {
        "rejected_w": 1e6,
        "range_k": 5.56,
        "water_kg_s": 1e6 / (4184.0 * 5.56),
        "tower_airflow_m3s": 26.67,
        "outdoor_c": 20.0,
        "wet_bulb_c": 15.0,
        "pressure_pa": 101_325.0,
        "return_c": 30.0,
        "supply_setpoint_c": 18.0,
        "cycles_of_concentration": 5.0,
        "drift_share": 2e-5,
        "dt_s": 900.0,
    }
    return WATER[name](WaterPoint(**{**arguments, **changes}))


@given(
    st.lists(st.floats(0.0, 1e7, allow_subnormal=False), **five),
    st.lists(st.floats(0.0, 30.0, allow_subnormal=False), **five),
    st.lists(st.floats(-40.0, 35.0), **five),
    st.lists(st.floats(1.05, 10.0), **five),
    st.sampled_from(sorted(WATER)),
)
@PROPERTY
def test_balance_and_batch(
    heat: list[float], range_k: list[float], wet: list[float], cycles: list[float], name: str
) -> None:
    changes = {
        "rejected_w": np.array(heat),
        "range_k": np.array(range_k),
        "outdoor_c": np.array(wet) + 3.0,
        "wet_bulb_c": np.array(wet),
        "return_c": 18.0 + np.array(range_k),
        "cycles_of_concentration": np.array(cycles),
    }
    result = run(name, **changes)
    np.testing.assert_allclose(
        result.water_l,
        result.evaporation_l + result.drift_l + result.blowdown_l,
        rtol=1e-12,
        atol=1e-12,
    )
    assert_batch(result, lambda i: run(name, **{k: v[i] for k, v in changes.items()}))
    if name != "paper":
        assert all((getattr(result, field) >= -1e-12).all() for field in FIELDS)


@given(st.floats(1e3, 1e7), st.floats(1.5, 10.0), st.floats(1e-3, 22.0))
@PROPERTY
def test_solids_are_conserved(heat_w: float, cycles: float, range_k: float) -> None:
    result = run(
        "mass_balance",
        rejected_w=heat_w,
        range_k=range_k,
        water_kg_s=heat_w / (4184.0 * range_k),
        cycles_of_concentration=cycles,
        drift_share=1e-6,
    )
    # What enters with the make-up leaves, concentrated, with drift and blowdown.
    leaving = cycles * (result.drift_l + result.blowdown_l)
    if result.blowdown_l > 0.0:
        np.testing.assert_allclose(leaving, result.water_l, rtol=1e-9)
    np.testing.assert_allclose(result.evaporation_l * 2.45e6, heat_w * 900.0, rtol=1e-12)


def test_loss_factor_follows_flow_and_range() -> None:
    """EnergyPlus: 0.2 % of the water flow for each kelvin, which is 1.17 times the heat."""
    result = run("loss_factor", range_k=np.array([2.5, 5.0]), water_kg_s=40.0)
    np.testing.assert_allclose(result.evaporation_l, [0.002 * 2.5 * 36e3, 0.002 * 5 * 36e3])
    twice = run("loss_factor", range_k=5.0, water_kg_s=40.0, evaporation_per_k=0.004)
    assert twice.evaporation_l == pytest.approx(2.0 * result.evaporation_l[1])
    by_heat = run("mass_balance").evaporation_l
    assert run("loss_factor").evaporation_l / by_heat == pytest.approx(0.002 * 2.45e6 / 4184.0)


@pytest.mark.parametrize("airflow_m3s", [6.0, 13.0, 26.67])
def test_evaporation_in_deep_frost_is_small_but_physical(airflow_m3s: float) -> None:
    """Against saturated air by the equations of ASHRAE, down to the coldest weather on earth."""
    wet_bulb_c = np.linspace(-60.0, -5.0, 56)
    found = run("saturated_exit", wet_bulb_c=wet_bulb_c, outdoor_c=wet_bulb_c,
                tower_airflow_m3s=airflow_m3s, dt_s=1.0)  # fmt: skip
    grid_c = np.linspace(-65.0, 45.0, 20_001)
    ratio = psychrometrics.humidity_ratio(grid_c, 100.0, 101_325.0)
    enthalpy = np.asarray(moist_air.enthalpy_j_per_kg(grid_c, ratio))
    entering = np.interp(wet_bulb_c, grid_c, ratio)
    dry_air_kg_s = airflow_m3s * moist_air.dry_air_kg_m3(wet_bulb_c, entering, 101_325.0)
    at = np.interp(wet_bulb_c, grid_c, enthalpy) + 1e6 / dry_air_kg_s
    expected = dry_air_kg_s * (np.interp(at, enthalpy, ratio) - entering)
    np.testing.assert_allclose(found.evaporation_l, expected, rtol=0.05, atol=2e-4)
    assert np.all(found.evaporation_l > 0.0)
    assert np.all(np.diff(found.evaporation_l) > 0.0)


def test_drift_beyond_the_blowdown_needs_no_blowdown() -> None:
    result = run("mass_balance", drift_share=np.array([0.0, 1e-2]))
    assert result.blowdown_l[0] == pytest.approx(result.evaporation_l[0] / 4.0)
    assert result.blowdown_l[1] == 0.0
    assert result.water_l[1] == result.evaporation_l[1] + result.drift_l[1]


@pytest.mark.parametrize("name", ["mass_balance", "saturated_exit", "loss_factor"])
def test_idle_tower_only_drifts(name: str) -> None:
    result = run(name, rejected_w=np.array([0.0, -1e5]), range_k=0.0, water_kg_s=50.0)
    np.testing.assert_allclose(result.water_l, 50.0 * 2e-5 * 900.0)
    np.testing.assert_array_equal(result.evaporation_l, 0.0)


def test_evaporation_follows_the_climate() -> None:
    """Litres per kWh rejected: in frost much heat leaves as warmth, in the desert none."""
    weather = {
        "outdoor_c": np.array([-15.0, 0.0, 15.0, 30.0, 40.0]),
        "wet_bulb_c": np.array([-16.0, -2.0, 12.0, 24.0, 20.0]),
    }
    litres = run("saturated_exit", dt_s=3600.0, **weather).evaporation_l / 1e3
    assert (np.diff(litres) > 0.05).all()
    assert 0.5 < litres[0] < 0.8
    assert 1.3 < litres[3] < 1.6
    assert litres[4] > 3.6e6 / 2.45e6  # Warm dry air gives heat of its own.


@pytest.mark.parametrize("pressure_pa", [70_000.0, 85_000.0, 101_325.0])
def test_polynomials_of_moist_air(pressure_pa: float) -> None:
    """Against the equations of whole years, from frost to the tropics."""
    outdoor_c, humidity = np.meshgrid(np.linspace(-30.0, 34.0, 33), np.linspace(20.0, 100.0, 9))
    wet_bulb_c = psychrometrics.wet_bulb_c(outdoor_c, humidity, pressure_pa)
    ratio = psychrometrics.humidity_ratio(outdoor_c, humidity, pressure_pa)
    at_wet_bulb = moist_air.saturated_ratio(wet_bulb_c, pressure_pa)
    # The wet bulb just above 0 C has two meanings.
    sure = (wet_bulb_c < -0.5) | (wet_bulb_c > 0.5)
    found = np.asarray(moist_air.humidity_ratio(outdoor_c, wet_bulb_c, at_wet_bulb))
    np.testing.assert_allclose(found[sure], ratio[sure], atol=8e-5)

    saturated_c = np.linspace(-15.0, 50.0, 66)
    expected = psychrometrics.humidity_ratio(saturated_c, 100.0, pressure_pa)
    enthalpy = np.asarray(moist_air.enthalpy_j_per_kg(saturated_c, expected))
    bounded = enthalpy <= 260e3
    found = np.asarray(moist_air.saturated_ratio_by_enthalpy(enthalpy, pressure_pa))
    np.testing.assert_allclose(found[bounded], expected[bounded], atol=1e-4)
    density = moist_air.dry_air_kg_m3(20.0, 0.0, pressure_pa)
    assert density == pytest.approx(1.2041 * pressure_pa / 101_325.0, rel=1e-3)


@pytest.mark.parametrize("name", sorted(WATER))
def test_litres_scale_with_the_step(name: str) -> None:
    quarter, hour = run(name), run(name, dt_s=3600.0)
    for field in FIELDS:
        np.testing.assert_allclose(getattr(hour, field), 4.0 * getattr(quarter, field), rtol=1e-6)


def test_fits_never_turn_into_a_source() -> None:
    place = {"wet_bulb_c": -30.0, "return_c": 18.0}
    assert float(run("released", **place).water_l) == 0.0
    assert float(run("paper", **place).evaporation_l) == 0.0
    # As printed, the drift stays on the unclipped use.
    assert float(run("paper", **place).water_l) == pytest.approx((0.1 - 1.32) * 0.01 * 250.0)
