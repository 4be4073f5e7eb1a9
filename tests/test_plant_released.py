"""Devices of the released code against its own values, at single points and along recorded runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from model_steps import battery_step, chiller_step
from plant_checks import ALL_CHECKS, TRAJECTORIES, recorded
from sdc_taichi.plant.tower import TOWERS, TowerPoint, TowerResult
from sdc_taichi.plant.water import WATER, WaterPoint
from sdc_taichi.types import F64

DATA_CENTERS = [check for check in ALL_CHECKS if "P_comp" in check["expected"]]
COMMAND_OF_CODE = {0: 1.0, 1: -1.0, 2: 0.0}
"""Battery commands of the actions charge, discharge and idle."""


def compressor_w(load_w: Any, outdoor_c: Any, reference_w: float) -> Any:
    result = chiller_step(
        "released",
        np.asarray(load_w),
        reference_w=reference_w,
        outdoor_c=outdoor_c,
        reference_cop=3.0,
        chilled_water_c=6.67,
        condenser_c=29.44,
    )
    np.testing.assert_array_equal(result.rejected_w, load_w)
    return result.power_w


def tower_fan_w(load_w: Any, outdoor_c: Any, setpoint_c: Any, air_m3s: float, fan_w: float) -> Any:
    point = TowerPoint(
        wet_bulb_c=20.0,
        outdoor_c=outdoor_c,
        condenser_setpoint_c=24.0,
        supply_setpoint_c=setpoint_c,
        water_kg_s=40.0,
        reference_water_kg_s=40.0,
        reference_air_m3s=air_m3s,
        design_fan_w=fan_w,
        air_j_per_m3_k=1.225 * 1006.0,
    )
    result: TowerResult = TOWERS["released"].step(np.asarray(load_w), point)
    return result.fan_w


def water_l(wet_bulb_c: Any, return_c: Any, setpoint_c: Any) -> Any:
    point = WaterPoint(
        rejected_w=1e6,
        range_k=5.56,
        water_kg_s=40.0,
        tower_airflow_m3s=26.67,
        outdoor_c=20.0,
        wet_bulb_c=wet_bulb_c,
        pressure_pa=101_325.0,
        return_c=return_c,
        supply_setpoint_c=setpoint_c,
        cycles_of_concentration=5.0,
        drift_share=2e-5,
        dt_s=900.0,
    )
    return WATER["released"](point).water_l


@pytest.mark.parametrize("check", DATA_CENTERS, ids=lambda check: check["id"])
def test_devices_at_single_points(check: dict[str, Any]) -> None:
    at, expected = check["inputs"], check["expected"]
    sized_w, load_w = 2307120.481120018, expected["Q_cool"]
    power_w = compressor_w(load_w, at["ambient_C"], sized_w)
    fan_w = tower_fan_w(load_w, at["ambient_C"], at["setpoint_C"], 53.48945350914959, sized_w)
    litres = water_l(at["wet_bulb_C"], expected["T_ret"], at["setpoint_C"])
    assert float(power_w) == pytest.approx(expected["P_comp"], rel=1e-6)
    assert float(fan_w) == pytest.approx(expected["P_ct"], rel=1e-6)
    assert float(litres) == pytest.approx(expected["water_L_15min"], rel=1e-9)


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_devices_along_a_recorded_run(name: str) -> None:
    run, sizing = recorded(name)
    load_w, outdoor_c, setpoint_c = (
        run[key] for key in ("crac_cooling_w", "dry_bulb_c", "setpoint_c")
    )
    sized_w, air_m3s = sizing["ct_rated_load_w"], sizing["ct_reference_air_flow_m3_s"]
    found: dict[str, F64] = {
        "compressor_kw": compressor_w(load_w, outdoor_c, sized_w) / 1e3,
        "ct_kw": tower_fan_w(load_w, outdoor_c, setpoint_c, air_m3s, sized_w) / 1e3,
        "water_l": water_l(run["wet_bulb_c"], run["return_c"], setpoint_c),
    }
    for column, values in found.items():
        np.testing.assert_allclose(values, run[column], rtol=1e-6, err_msg=column)


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_battery_along_a_recorded_run(name: str) -> None:
    run, sizing = recorded(name)
    capacity_kwh, stored_kwh = 1e3 * sizing["battery_capacity_mwh"], np.zeros(1)
    soc, grid_kwh = [], []
    for action, load_kwh in zip(run["action_bat"], run["dc_kwh"], strict=True):
        result = battery_step(
            "released",
            stored_kwh,
            np.asarray(COMMAND_OF_CODE[int(action)]),
            capacity_kwh=capacity_kwh,
            load_kw=4.0 * load_kwh,
            dt_h=0.25,
        )
        stored_kwh = result.stored_kwh
        soc.append(float(stored_kwh[0]) / capacity_kwh)
        grid_kwh.append(float(result.grid_kwh[0]))
    assert len(soc) == 672
    np.testing.assert_allclose(soc, run["soc"], rtol=1e-6, atol=0.0)
    np.testing.assert_allclose(grid_kwh, run["grid_kwh"], rtol=1e-6)
