"""Density of dry air, as an ideal gas.

Airflows in halls are volume flows of air at REFERENCE_C and the pressure of the site. They are
therefore proportional to mass flows and add up where streams of different temperature mix. A fan
moves the volume that this air has at its actual temperature.
"""

from __future__ import annotations

from dataclasses import dataclass

from sdc_taichi.types import F64

GAS_CONSTANT_J_PER_KG_K = 287.05
"""Gas constant of dry air, in J/(kg K) (ASHRAE Fundamentals 2017, chapter 1)."""
ZERO_C_K = 273.15
"""Temperature of 0 C, in K."""
REFERENCE_C = 20.0
"""Reference temperature of volume flows, in C; fan ratings use standard air of this temperature."""
EXACT_AT_C = (18.0, 32.0)
"""Two temperatures, in C, at which the linear ``OF_IDEAL_GAS`` equals the ideal gas law."""


@dataclass(frozen=True, slots=True)
class DensityRatio:
    """Density of air divided by that at REFERENCE_C and equal pressure, linear in temperature."""

    base: float
    """Ratio at 0 C, dimensionless."""
    fall_per_k: float
    """Fall of the ratio with temperature, in 1/K."""

    def at(self, temperature_c: F64) -> F64:
        """Return the density ratio, dimensionless, at temperatures in C of any shape."""
        return self.base - self.fall_per_k * temperature_c


def _line() -> DensityRatio:
    low_c, high_c = EXACT_AT_C
    low, high = ((REFERENCE_C + ZERO_C_K) / (t + ZERO_C_K) for t in EXACT_AT_C)
    fall_per_k = (low - high) / (high_c - low_c)
    return DensityRatio(low + fall_per_k * low_c, fall_per_k)


OF_IDEAL_GAS = _line()
"""Linear fit to the density of an ideal gas, which falls as 1/T. Its error is at most 0.06 % within
15..35 C, 0.2 % at 10 C and 0.4 % at 45 C."""
CONSTANT = DensityRatio(1.0, 0.0)
"""Density ratio of air whose density does not depend on temperature: 1 everywhere."""


def density_kg_m3(pressure_pa: float, temperature_c: float) -> float:
    """Return the density p/(R T) of dry air, in kg/m3, from its pressure and temperature."""
    return pressure_pa / (GAS_CONSTANT_J_PER_KG_K * (temperature_c + ZERO_C_K))
