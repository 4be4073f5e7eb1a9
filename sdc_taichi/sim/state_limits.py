"""Limits that no value of a state leaves, whatever a run does; saved states are held against them.

Values within the limits of all fields may still be no state that a run can come to.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sdc_taichi.hall.protection import NORMAL, TRIPPED
from sdc_taichi.plant.workload import NEGLIGIBLE_TASKS, TASKS_PER_STEP
from sdc_taichi.sim.actions import MOST_MOVES
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.physical_limits import AIR_LIMITS_C
from sdc_taichi.sim.sizing import Sizing

MOST_STEPS = 10**9
"""Most steps since reset: 1,900 years of minutes."""
LAST_START = 2**53
"""Latest first step: beyond, steps would not be exact as f64."""
HALL_LIMITS_C = (-273.15, 1e6)
"""Limits of temperatures within a rack, in C: absolute zero, and more than a failing fan lets its
servers reach before the means of the hall leave ``AIR_LIMITS_C``."""
AIRFLOW_FACTOR = 100.0
"""Limit of airflows over those at the design point: fans reach a few times their speed there."""
ROUNDING = 1e-5
"""What rounding may add to a limit, as a share of it: sized devices and results in f32 differ by
less between processors."""
ROUNDING_KWH = 1e-5
"""What the battery of the released code rounds its store to, 8 decimals of a MWh."""

Limits = tuple[Any, Any]
"""Lowest and highest value of a field: numbers, or arrays that broadcast to it."""


def state_limits(fleet: Fleet, sizing: Sizing, step: int) -> dict[str, Limits]:
    """Lowest and highest value of each field of ``State`` by name, but for its ``step``.

    Args:
        fleet: B data centers with R racks, G server groups and U CRAC units.
        sizing: their sized devices.
        step: steps done since reset, which limit what can have come together.
    """
    per_unit, per_rack = fleet.unit_dc, fleet.rack_dc
    lowest_c, highest_c = fleet.values("hvac.setpoint.min_c"), fleet.values("hvac.setpoint.max_c")
    # No more than all work that has arrived can wait, and no more than the queue holds.
    limit_steps = fleet.values("workload.queue_limit_h") * fleet.steps_per_hour
    tasks = np.fmin(limit_steps, float(step)) * TASKS_PER_STEP
    spare_kwh = ROUNDING * sizing.battery_kwh + ROUNDING_KWH
    is_protected = np.array([c.protection.ashrae_class is not None for c in fleet.configs])
    most_m3s = AIRFLOW_FACTOR * fleet.unit_sums(fleet.unit_design_m3s)
    strength = 1.0 if fleet.air is None else fleet.air.mix_weights.strength
    return {
        "seed": (0, np.inf),
        "start": (0, LAST_START),
        "setpoint_c": (lowest_c[per_unit], highest_c[per_unit]),
        "cooling_run": (0, step),
        "cooling_last": (-MOST_MOVES, MOST_MOVES),
        "fan_speed": (fleet.values("hvac.crac.min_flow_ratio")[per_unit], 1.0),
        "queue": (0.0, (tasks * (1.0 + ROUNDING) + NEGLIGIBLE_TASKS)[:, None]),
        "stored_kwh": (-spare_kwh, sizing.battery_kwh + spare_kwh),
        # Heat in the room warms the supply air, and what is missing cools it.
        "room_heat_kwh": (
            (AIR_LIMITS_C[0] - highest_c) * sizing.room_kwh_per_k,
            (AIR_LIMITS_C[1] - lowest_c) * sizing.room_kwh_per_k,
        ),
        "restart_wait_min": (0.0, 60.0 * step / fleet.steps_per_hour),
        "rack_status": (NORMAL, np.where(is_protected, TRIPPED, NORMAL)[per_rack]),
        "group_inlet_c": HALL_LIMITS_C,
        "server_c": HALL_LIMITS_C,
        "mixed_c": HALL_LIMITS_C,
        "exhaust_c": (HALL_LIMITS_C[0] * strength, HALL_LIMITS_C[1] * strength),
        "captured_m3s": (0.0, most_m3s[per_rack]),
        "need_m3s": (0.0, most_m3s[per_unit]),
        "following": (0.0, most_m3s[per_unit] / np.maximum(fleet.unit_design_m3s, 1e-30)),
        "supply_excess_k": (AIR_LIMITS_C[0] - AIR_LIMITS_C[1], AIR_LIMITS_C[1] - AIR_LIMITS_C[0]),
    }
