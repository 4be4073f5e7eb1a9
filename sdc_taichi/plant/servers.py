"""Power and airflow of servers as functions of inlet temperature and load.

CPU power and airflow ratio (volume flow at the inlet divided by that at full fan speed) are linear
in the load, and linear or piecewise linear in the inlet temperature. Fan power is a power function
of the airflow ratio (Sun et al. 2021, *Prototype energy models for data centers*, Energy and
Buildings 231; EnergyPlus Engineering Reference, ElectricEquipment:ITE:AirCooled).
``kernels/servers.py`` has a compiled version of these curves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from sdc_taichi.plant.air import DensityRatio
from sdc_taichi.types import F64


class Knee(NamedTuple):
    """Inlet temperature at which the slope of a curve changes.

    With the utilisation u, the curve contains the term (slope + shift*u) * max(x, inlet_c) of the
    inlet temperature x.
    """

    inlet_c: float
    """Inlet temperature, in C."""
    slope_per_k: float
    """Change of the slope at no load, in 1/K."""
    shift_per_k: float
    """Increase of this change from no load to full load, in 1/K."""


@dataclass(frozen=True, slots=True)
class ServerCurves:
    """Coefficients of the power and airflow curves of one server model.

    With x = min(inlet_c, curve_limit_c) and the utilisation u of the server, CPU power is
    max(idle, full*(cpu_slope*x + cpu_offset + cpu_shift*u)), the airflow ratio is
    y = clip(fan_slope*x + fan_offset + fan_shift*u, fan_low, fan_high), and fan power divided by
    its reference value is (y/fan_reference_ratio)^fan_exponent. The terms of the knees are added to
    both lines.
    """

    cpu_slope_per_k: float
    """Slope of CPU power divided by full power against the inlet temperature, in 1/K."""
    cpu_offset: float
    """CPU power divided by full power at an inlet of 0 C and no load."""
    cpu_shift: float
    """Increase of CPU power from no load to full load, divided by full power."""
    fan_slope_per_k: float
    """Slope of the airflow ratio against the inlet temperature, in 1/K."""
    fan_offset: float
    """Airflow ratio at an inlet of 0 C and no load, before the limits are applied."""
    fan_shift: float
    """Increase of the airflow ratio from no load to full load."""
    fan_low: float
    """Lowest airflow ratio, at least 0."""
    fan_high: float
    """Highest airflow ratio; inf means no upper limit."""
    fan_reference_ratio: float
    """Airflow ratio at which the fans of a server draw their reference power."""
    fan_exponent: float
    """Exponent of the airflow ratio in the fan power, 1..3."""
    curve_limit_c: float
    """Inlet temperature above which power and airflow no longer rise, in C; inf means no limit."""
    cpu_knees: tuple[Knee, ...] = ()
    """Knees of CPU power divided by full power."""
    fan_knees: tuple[Knee, ...] = ()
    """Knees of the airflow ratio."""

    def airflow_ratio(self, inlet_c: F64, utilisation: F64) -> F64:
        """Return the airflow of servers divided by their airflow at full fan speed, dimensionless.

        Args:
            inlet_c: Inlet temperature of each server, C, any shape.
            utilisation: Load of each server, 0..1, of the same shape.
        """
        on_curve_c = np.minimum(inlet_c, self.curve_limit_c)
        ratio = self.fan_slope_per_k * on_curve_c + self.fan_offset + self.fan_shift * utilisation
        ratio = _add_knees(ratio, self.fan_knees, on_curve_c, utilisation)
        return np.asarray(np.clip(ratio, self.fan_low, self.fan_high))

    def moved_ratio(self, airflow_ratio: F64, inlet_c: F64, density_ratio: DensityRatio) -> F64:
        """Convert an airflow ratio from volume at the inlet temperature to reference temperature.

        The reference temperature is ``REFERENCE_C`` of ``plant.air``.

        Args:
            airflow_ratio: Airflow ratio of each server, any shape.
            inlet_c: Inlet temperature of each server, C, of the same shape.
            density_ratio: Density of air divided by its value at the reference temperature.
        """
        on_curve_c = np.minimum(inlet_c, self.curve_limit_c)
        return np.asarray(airflow_ratio * density_ratio.at(on_curve_c))

    def cpu_w(self, inlet_c: F64, utilisation: F64, full_w: F64, idle_w: F64) -> F64:
        """Return the power of servers without their fans, in W.

        Args:
            inlet_c: Inlet temperature of each server, C, any shape.
            utilisation: Load of each server, 0..1, of the same shape.
            full_w: CPU power of each server where the curve has the value 1, W.
            idle_w: Lowest CPU power of each server, W.
        """
        on_curve_c = np.minimum(inlet_c, self.curve_limit_c)
        ratio = self.cpu_slope_per_k * on_curve_c + self.cpu_offset + self.cpu_shift * utilisation
        ratio = _add_knees(ratio, self.cpu_knees, on_curve_c, utilisation)
        return np.asarray(np.maximum(idle_w, full_w * ratio))

    def fan_w(self, airflow_ratio: F64, reference_w: F64 | float) -> F64:
        """Return the power of the fans of servers, in W.

        Args:
            airflow_ratio: Airflow ratio of each server, any shape.
            reference_w: Fan power of each server at the reference airflow ratio, W.
        """
        speed = airflow_ratio / self.fan_reference_ratio
        return np.asarray(reference_w * speed**self.fan_exponent)


def linear_curve(
    inlet_range_c: tuple[float, float],
    ratio_at_coolest: tuple[float, float],
    ratio_at_warmest: tuple[float, float],
) -> tuple[float, float, float]:
    """Return slope (1/K), offset and load shift of the line through two points (Sun et al. 2021).

    Args:
        inlet_range_c: Coolest and warmest inlet temperature of the curve, C.
        ratio_at_coolest: Ratios at no load and at full load, at the coolest inlet.
        ratio_at_warmest: Ratios at no load and at full load, at the warmest inlet. The ratio at
            full load is not used, because the load shift is taken from the coolest inlet.
    """
    coolest_c, warmest_c = inlet_range_c
    slope = (ratio_at_warmest[0] - ratio_at_coolest[0]) / (warmest_c - coolest_c)
    offset = ratio_at_warmest[0] - slope * warmest_c
    return slope, offset, ratio_at_coolest[1] - ratio_at_coolest[0]


@lru_cache(maxsize=64)
def curve_through(
    points: tuple[tuple[float, float, float], ...], curve_limit_c: float
) -> tuple[float, float, tuple[Knee, ...]]:
    """Return offset, load shift and knees of the curve through points, whose slope is otherwise 0.

    The curve is linear between the points and constant beyond them.

    Args:
        points: Inlet temperature, C, and ratios at no load and at full load, by rising temperature.
        curve_limit_c: Inlet temperature above which the curve is constant, C; knees there have no
            effect and are left out.
    """
    slopes = [(0.0, 0.0)]
    for (low_c, *low), (high_c, *high) in pairwise(points):
        idle, full = ((b - a) / (high_c - low_c) for a, b in zip(low, high, strict=True))
        slopes.append((idle, full - idle))
    slopes.append((0.0, 0.0))
    knees = tuple(
        Knee(inlet_c, after[0] - before[0], after[1] - before[1])
        for (inlet_c, *_), (before, after) in zip(points, pairwise(slopes), strict=True)
        if inlet_c < curve_limit_c and before != after
    )
    _, idle, full = points[0]
    offset = idle - sum(knee.inlet_c * knee.slope_per_k for knee in knees)
    return offset, full - idle - sum(knee.inlet_c * knee.shift_per_k for knee in knees), knees


def _add_knees(ratio: F64, knees: tuple[Knee, ...], on_curve_c: F64, utilisation: F64) -> F64:
    """Add the terms of knees to the ratio of a straight line."""
    for knee in knees:
        slope = knee.slope_per_k + knee.shift_per_k * utilisation
        ratio = ratio + slope * np.maximum(on_curve_c, knee.inlet_c)
    return ratio
