"""Power and airflow of servers against inlet temperature and load, as pure functions.

CPU power and airflow ratio (volume at the inlet divided by that at full speed) are linear in the
inlet temperature and shift with the load; fan power is a power of the airflow ratio (Sun et al.
2021, *Prototype energy models for data centers*, Energy and Buildings 231; EnergyPlus Engineering
Reference, ElectricEquipment:ITE:AirCooled). ``kernels/servers.py`` holds the same curves compiled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.plant.air import DensityRatio
from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class ServerCurves:
    """Coefficients of the curves of one kind of server.

    With x = min(inlet_c, curve_limit_c) and the utilisation u of the server, CPU power is
    max(idle, full*(cpu_slope*x + cpu_offset + cpu_shift*u)), the airflow ratio is
    y = clip(fan_slope*x + fan_offset + fan_shift*u, fan_low, fan_high), and fan power divided by
    that at the reference is (y/fan_reference_ratio)^fan_exponent.
    """

    cpu_slope_per_k: float
    """Rise of CPU power over full power with the inlet temperature, in 1/K."""
    cpu_offset: float
    """CPU power over full power at an inlet of 0 C and no load."""
    cpu_shift: float
    """Rise of CPU power over full power from no load to full load."""
    fan_slope_per_k: float
    """Rise of the airflow ratio with the inlet temperature, in 1/K."""
    fan_offset: float
    """Airflow ratio at an inlet of 0 C and no load, before it is limited."""
    fan_shift: float
    """Rise of the airflow ratio from no load to full load."""
    fan_low: float
    """Lowest airflow ratio, at least 0."""
    fan_high: float
    """Highest airflow ratio, inf for none."""
    fan_reference_ratio: float
    """Airflow ratio at which the fans of a server draw their reference power."""
    fan_exponent: float
    """Exponent of fan power over the airflow ratio, 1..3."""
    curve_limit_c: float
    """Inlet temperature above which power and airflow no longer rise, in C, inf for none."""

    def airflow_ratio(self, inlet_c: F64, utilisation: F64) -> F64:
        """Airflow of servers over their full airflow, dimensionless.

        Args:
            inlet_c: inlet temperature of each server in C, any shape.
            utilisation: load of each server, 0..1, of the same shape.
        """
        on_curve_c = np.minimum(inlet_c, self.curve_limit_c)
        ratio = self.fan_slope_per_k * on_curve_c + self.fan_offset + self.fan_shift * utilisation
        return np.asarray(np.clip(ratio, self.fan_low, self.fan_high))

    def moved_ratio(self, airflow_ratio: F64, inlet_c: F64, density_ratio: DensityRatio) -> F64:
        """Airflow over full airflow as volume at the reference temperature of ``plant.air``.

        Args:
            airflow_ratio: airflow ratio of each server, any shape.
            inlet_c: inlet temperature of each server in C, of the same shape.
            density_ratio: density of the air divided by that at the reference temperature.
        """
        on_curve_c = np.minimum(inlet_c, self.curve_limit_c)
        return np.asarray(airflow_ratio * density_ratio.at(on_curve_c))

    def cpu_w(self, inlet_c: F64, utilisation: F64, full_w: F64, idle_w: F64) -> F64:
        """Power of servers without their fans, in W.

        Args:
            inlet_c: inlet temperature of each server in C, any shape.
            utilisation: load of each server, 0..1, of the same shape.
            full_w: CPU power of each server at full load and a power ratio of 1, in W.
            idle_w: lowest CPU power of each server, in W.
        """
        on_curve_c = np.minimum(inlet_c, self.curve_limit_c)
        ratio = self.cpu_slope_per_k * on_curve_c + self.cpu_offset + self.cpu_shift * utilisation
        return np.asarray(np.maximum(idle_w, full_w * ratio))

    def fan_w(self, airflow_ratio: F64, reference_w: F64 | float) -> F64:
        """Power of the fans of servers, in W.

        Args:
            airflow_ratio: airflow ratio of each server, any shape.
            reference_w: fan power of each server at the reference airflow ratio, in W.
        """
        speed = airflow_ratio / self.fan_reference_ratio
        return np.asarray(reference_w * speed**self.fan_exponent)


def linear_curve(
    inlet_range_c: tuple[float, float],
    ratio_at_coolest: tuple[float, float],
    ratio_at_warmest: tuple[float, float],
) -> tuple[float, float, float]:
    """Slope (1/K), offset and load shift of the line through given points (Sun et al. 2021).

    Args:
        inlet_range_c: coolest and warmest inlet of the curve, in C.
        ratio_at_coolest: ratio without load and at full load, at the coolest inlet.
        ratio_at_warmest: ratio without load and at full load, at the warmest inlet; the latter is
            not read, since the load shift is that of the coolest inlet.
    """
    coolest_c, warmest_c = inlet_range_c
    slope = (ratio_at_warmest[0] - ratio_at_coolest[0]) / (warmest_c - coolest_c)
    offset = ratio_at_warmest[0] - slope * warmest_c
    return slope, offset, ratio_at_coolest[1] - ratio_at_coolest[0]
