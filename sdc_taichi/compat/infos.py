"""Infos of a step with the keys of the released SustainDC code.

The keys are those of ``dc_gym.py``, ``carbon_ls.py``, ``bat_env_fwd_view.py`` and
``sustaindc_env.py`` (github.com/HewlettPackard/dc-rl, main at a92b475).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F32, F64, StepResult

BATTERY_ACTIONS = {1: (0, "charge"), -1: (1, "discharge"), 0: (2, "idle")}
"""Number and name of the battery's actions in the released code, by the sign of the command."""


def step_infos(
    result: StepResult,
    view: View,
    *,
    bounds_kw: tuple[float, float],
    forecast_ci: F64,
    task_ages: F32,
    shift_h: int,
    is_last: bool,
) -> dict[str, Any]:
    """Return the infos of a step of one data center by their released names.

    Args:
        result: result of the step.
        view: the view after the step.
        bounds_kw: lower and upper bound of IT and HVAC power, in kW.
        forecast_ci: scaled carbon intensity of the steps after the coming one, (n,).
        task_ages: histogram of the ages of queued tasks, (5,).
        shift_h: local standard time minus the clock of ``day`` and ``hour``, in h.
        is_last: True for the last step of an episode.
    """
    r = {name: float(values[0]) for name, values in result.per_dc().items()}
    per_hour = view.fleet.steps_per_hour
    index = int(view.drivers.start[0]) + view.state.step
    day, hour = _clock(index, per_hour, shift_h)
    low_kw, high_kw = bounds_kw
    queue_limit_h = float(view.fleet.values("workload.queue_limit_h")[0])
    queue_limit = queue_limit_h * per_hour * TASKS_PER_STEP
    hvac_kw = r["hvac_w"] / 1e3
    battery, battery_name = BATTERY_ACTIONS[int(np.sign(r["battery_command"]))]
    return {
        "bat_action": battery,
        "bat_SOC": r["soc"],
        "bat_CO2_footprint": r["carbon_g"],
        "bat_avg_CI": r["ci_g_per_kwh"],
        "bat_total_energy_without_battery_KWh": float(result.facility_kwh[0]),
        "bat_total_energy_with_battery_KWh": r["grid_kwh"],
        "bat_max_bat_cap": float(view.sizing.battery_kwh[0]) / 1e3,
        "bat_a_t": battery_name,
        "bat_dcload_min": low_kw * result.step_h,
        "bat_dcload_max": high_kw * result.step_h,
        "ls_original_workload": r["demand"],
        "ls_shifted_workload": r["utilisation"],
        "ls_action": 1 + int(np.sign(r["load_command"])),
        "ls_norm_load_left": 0,
        "ls_unasigned_day_load_left": 0,
        "ls_penalty_flag": 0,
        "ls_queue_max_len": queue_limit,
        "ls_tasks_in_queue": r["queue_tasks"],
        "ls_norm_tasks_in_queue": r["queue_tasks"] / queue_limit,
        "ls_tasks_dropped": r["dropped_tasks"],
        "ls_current_hour": _clock(index - 1, per_hour, shift_h)[1],
        "ls_tasks_processed": r["drained_tasks"],
        "ls_enforced": 0,
        "ls_oldest_task_age": r["oldest_age_h"] / 24.0,
        "ls_average_task_age": r["mean_age_h"] / 24.0,
        "ls_overdue_penalty": r["due_tasks"],
        # Cut off as in the released code: 0.29 * 100 is slightly below 29 and gives 28.
        "ls_computed_tasks": int(r["utilisation"] * TASKS_PER_STEP),
        "ls_task_age_histogram": task_ages,
        "dc_ITE_total_power_kW": r["it_w"] / 1e3,
        "dc_CT_total_power_kW": r["tower_fan_w"] / 1e3,
        "dc_Compressor_total_power_kW": r["chiller_w"] / 1e3,
        "dc_HVAC_total_power_kW": hvac_kw,
        "dc_total_power_kW": r["it_w"] / 1e3 + hvac_kw,
        "dc_crac_setpoint_delta": int(np.sign(r["cooling_command"])),
        "dc_crac_setpoint": r["setpoint_c"],
        "dc_cpu_workload_fraction": r["utilisation"],
        "dc_int_temperature": r["outlet_mean_c"],
        "dc_exterior_ambient_temp": r["outdoor_c"],
        "dc_power_lb_kW": low_kw,
        "dc_power_ub_kW": high_kw,
        "dc_CW_pump_power_kW": r["chilled_pump_w"],
        "dc_CT_pump_power_kW": r["condenser_pump_w"],
        "dc_water_usage": r["water_l"],
        "outside_temp": float(view.now.outdoor_c[0]),
        "day": day,
        "hour": hour,
        "norm_CI": float(forecast_ci[0]),
        "forecast_CI": forecast_ci,
        "isterminal": is_last,
    }


def time_entries(index: int, per_hour: int, shift_h: int) -> list[float]:
    """Return cosine and sine of the hour of the day and of the day of the year, scaled to 0..1.

    Args:
        index: step of the year, in local standard time.
        per_hour: number of steps in an hour.
        shift_h: local standard time minus the clock of the result, in h.
    """
    day, hour = _clock(index, per_hour, shift_h)
    turns = (round(hour / 24.0, 3), round(day / 365.0, 3))
    angles = [2.0 * np.pi * turn for turn in turns]
    return [float(0.5 + 0.5 * f(angle)) for angle in angles for f in (np.cos, np.sin)]


def _clock(index: int, per_hour: int, shift_h: int) -> tuple[int, float]:
    """Return day of the year, from 0, and hour of the day of a step of the year."""
    day, step = divmod(index - shift_h * per_hour, 24 * per_hour)
    return day, step / per_hour
