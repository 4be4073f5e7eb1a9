"""Linear limits of what a battery charges and discharges in a step, by the energy stored before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from sdc_taichi.optimum.problem import Storage
from sdc_taichi.plant.battery import BATTERIES, BatteryPoint
from sdc_taichi.types import F64

Line = tuple[float, float]
"""A limit in kWh of an empty battery, and its rise with each kWh stored."""

_STATES = 2001
"""States of charge at which the ``released`` battery is sampled."""
_ROUNDING_KWH = 5e-6
"""Most that the ``released`` battery gains in a step by rounding, in kWh."""
_UNLIMITED_KW = 1e12
"""Load that never limits a discharge, in kW."""


@dataclass(frozen=True, slots=True)
class BatteryLimits:
    """What a battery can do in a step, as the least of linear functions of the energy stored."""

    charge_efficiency: float
    """Energy stored per energy drawn."""
    discharge_factor: float
    """Energy taken from the store per energy delivered."""
    charge: tuple[Line, ...]
    """Limits of the energy charged."""
    discharge: tuple[Line, ...]
    """Limits of the energy discharged."""
    most_charge_kwh: float
    """Most energy charged at any energy stored, in kWh."""
    most_discharge_kwh: float
    """Most energy discharged at any energy stored, in kWh."""
    discharge_load_share: float
    """Largest ratio of the energy discharged to the energy of the facility."""
    rounding_kwh: float
    """Energy that a step may gain by rounding, in kWh."""


@lru_cache(maxsize=256)
def battery_limits(storage: Storage, step_h: float, start_kwh: float) -> BatteryLimits:
    """Linear limits of a battery that hold at every energy it can have stored.

    The limits of ``clc`` and ``paper`` are linear themselves (``plant.battery``). Those of
    ``released`` depend on the state of charge in other ways; here they are the least concave curve
    above them, so a battery within these limits does all that the model does, and more.

    Args:
        storage: The battery.
        step_h: Length of a step, in h.
        start_kwh: Energy stored before the first step, in kWh.
    """
    capacity = storage.capacity_kwh
    if storage.model == "released":
        return _released(capacity, step_h)
    eta_c, eta_d = storage.charge_efficiency, storage.discharge_factor
    if storage.model == "paper":
        most_c, most_d = storage.charge_limit_c_rate, storage.discharge_limit_c_rate
        upper, lower, rise_c, rise_d = capacity, 0.0, 0.0, 0.0
    else:
        most_c, most_d = storage.charge_limit_c_rate / eta_c, storage.discharge_limit_c_rate / eta_d
        upper, lower = storage.upper_v * capacity, storage.lower_v * capacity
        rise_c, rise_d = -storage.upper_u_h, storage.lower_u_h
    # A battery that starts beyond these limits stays there until it is used.
    upper, lower = max(upper, start_kwh), min(lower, start_kwh)
    in_h, out_h = eta_c * step_h + rise_c, eta_d * step_h + rise_d
    return BatteryLimits(
        charge_efficiency=eta_c,
        discharge_factor=eta_d,
        charge=((upper * step_h / in_h, -step_h / in_h),),
        discharge=((-lower * step_h / out_h, step_h / out_h),),
        most_charge_kwh=most_c * capacity * step_h,
        most_discharge_kwh=most_d * capacity * step_h,
        discharge_load_share=1.0,
        rounding_kwh=0.0,
    )


def _released(capacity_kwh: float, step_h: float) -> BatteryLimits:
    """Limits of the ``released`` battery: the least concave curves above it."""
    stored = np.linspace(0.0, capacity_kwh, _STATES)
    energy = {}
    for name, command in (("charge", 1.0), ("discharge", -1.0)):
        point = BatteryPoint(capacity_kwh, _UNLIMITED_KW, step_h)
        step = BATTERIES["released"].step(stored, command, point)
        energy[name] = np.asarray(getattr(step, f"{name}_kwh"))
    # The load carries a quarter of its power over a duration that depends on the state of charge.
    point = BatteryPoint(capacity_kwh, 1e-6 * capacity_kwh, step_h)
    light = BATTERIES["released"].step(stored, -1.0, point)
    share = float(np.max(light.discharge_kwh) / (1e-6 * capacity_kwh * step_h))
    return BatteryLimits(
        charge_efficiency=1.0,
        discharge_factor=1.0,
        charge=_lines_above(stored, energy["charge"]),
        discharge=_lines_above(stored, energy["discharge"]),
        most_charge_kwh=float(energy["charge"].max()) * (1 + 1e-6),
        most_discharge_kwh=float(energy["discharge"].max()) * (1 + 1e-6),
        discharge_load_share=share * (1 + 1e-6),
        rounding_kwh=_ROUNDING_KWH,
    )


def _lines_above(x: F64, y: F64, count: int = 6) -> tuple[Line, ...]:
    """Lines whose least is above a curve: some edges of its upper hull, raised above all points.

    Between samples the curve rises above its chords by no more than the largest second difference.
    """
    corners = [0]
    for i in range(1, len(x)):
        while len(corners) > 1:
            a, b = corners[-2:]
            if (y[b] - y[a]) * (x[i] - x[a]) > (y[i] - y[a]) * (x[b] - x[a]):
                break
            corners.pop()
        corners.append(i)
    margin = float(np.abs(np.diff(y, 2)).max())
    slopes = np.diff(y[corners]) / np.diff(x[corners])
    picked = np.unique(np.linspace(0, len(slopes) - 1, count).round().astype(int))
    return tuple((float((y - s * x).max()) + margin, float(s)) for s in slopes[picked])
