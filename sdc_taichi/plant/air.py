"""Density of dry air, as an ideal gas.

In halls, airflows are volume flows of air at REFERENCE_C and the pressure of the site: flows add up
where streams of unlike temperature mix, since each stands for a mass. What passes a fan is the
volume at its own temperature.
"""

from __future__ import annotations

from dataclasses import dataclass

from sdc_taichi.types import F64

GAS_CONSTANT_J_PER_KG_K = 287.05
"""Gas constant of dry air, in J/(kg K) (ASHRAE Fundamentals 2017, chapter 1)."""
ZERO_C_K = 273.15
"""Temperature of 0 C, in K."""
REFERENCE_C = 20.0
"""Temperature at which airflows are given as volumes, in C: that of the standard air of fans."""
EXACT_AT_C = (18.0, 32.0)
"""Temperatures at which the straight line of ``OF_IDEAL_GAS`` is exact, in C."""


@dataclass(frozen=True, slots=True)
class DensityRatio:
    """Density of air divided by that at REFERENCE_C and equal pressure, linear in temperature."""

    base: float
    """Ratio at 0 C, dimensionless."""
    fall_per_k: float
    """Fall of the ratio with temperature, in 1/K."""

    def at(self, temperature_c: F64) -> F64:
        """Ratio at temperatures in C, of any shape, dimensionless."""
        return self.base - self.fall_per_k * temperature_c


def _line() -> DensityRatio:
    low_c, high_c = EXACT_AT_C
    low, high = ((REFERENCE_C + ZERO_C_K) / (t + ZERO_C_K) for t in EXACT_AT_C)
    fall_per_k = (low - high) / (high_c - low_c)
    return DensityRatio(low + fall_per_k * low_c, fall_per_k)


OF_IDEAL_GAS = _line()
"""The density of an ideal gas falls as 1/T; the line errs by at most 0.06 % within 15..35 C, 0.2 %
at 10 C and 0.4 % at 45 C."""
CONSTANT = DensityRatio(1.0, 0.0)
"""Ratio of an air whose density does not depend on its temperature."""


def density_kg_m3(pressure_pa: float, temperature_c: float) -> float:
    """Density of dry air, in kg/m3, from its pressure in Pa and temperature in C: p/(R T)."""
    return pressure_pa / (GAS_CONSTANT_J_PER_KG_K * (temperature_c + ZERO_C_K))
