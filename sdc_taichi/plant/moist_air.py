"""Properties of moist air as polynomials, cheap enough for every step of every data center.

The polynomials are fitted to the equations of ASHRAE Handbook - Fundamentals (2017), chapter 1,
which ``exogenous.psychrometrics`` solves for whole years of weather. Equation numbers refer to that
chapter. Arguments are float64 arrays of shape (B,), B data centers, or anything that broadcasts to
it.
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.types import Values

WATER_TO_DRY_AIR = 0.621945
"""Molar mass of water divided by that of dry air."""
DRY_AIR_J_PER_KG_K = 1006.0
"""Specific heat capacity of dry air, in J/(kg K)."""
VAPOUR_J_PER_KG_K = 1860.0
"""Specific heat capacity of water vapour, in J/(kg K)."""
VAPOUR_J_PER_KG = 2.501e6
"""Specific enthalpy of water vapour at 0 C, in J/kg."""
GAS_CONSTANT_J_PER_KG_K = 287.042
"""Gas constant of dry air, in J/(kg K)."""
STANDARD_PA = 101_325.0
"""Pressure of the standard atmosphere at sea level, in Pa."""

SATURATION_BOUNDS_C = (-40.0, 35.0)
"""Lowest and highest temperature at which the saturation pressure is evaluated, in C."""
_SATURATION_PA = (605.455, 46.1143, 1.39563, 0.0234096, 0.000343549, 3.52573e-06)
"""Coefficients of the saturation pressure in powers of the temperature in C; error at most 6 Pa."""
FREEZING_BAND_K = 0.2
"""Range of the wet bulb below 0 C within which a wick counts as partly frozen, in K."""
ENTHALPY_BOUNDS_KJ_PER_KG = (-15.0, 260.0)
"""Lowest and highest enthalpy at which the temperature of saturated air is evaluated, in kJ per kg
of dry air; at sea level they correspond to -21 C and 57 C."""
_SATURATED_C = (-38.1362, -5.41559, 3.30688, -0.347603, 0.0156315, -0.000264233)
_SATURATED_C_BY_PRESSURE = (-14.5864, 3.54943, -0.0968119)
_SATURATED_C_BY_SQUARE = -0.711883
"""Coefficients of the temperature of saturated air, in C, in powers of sqrt(h + 40), h in kJ/kg.

The three sets hold the temperature at sea level, its term in q, and its term in q^2, where q + 1 is
the pressure divided by that of the standard atmosphere. The error is at most 0.17 K at 65..105 kPa.
"""


def saturation_pa(temperature_c: Values) -> Values:
    """Return the saturation pressure of water vapour (above ice if below 0 C), in Pa.

    Args:
        temperature_c: Temperature, C; values are clipped to -40..35 C.
    """
    return _polynomial(_SATURATION_PA, np.clip(temperature_c, *SATURATION_BOUNDS_C))


def saturated_ratio(temperature_c: Values, pressure_pa: Values) -> Values:
    """Return the humidity ratio of saturated air, in kg of water per kg of dry air.

    Args:
        temperature_c: Temperature, C; values are clipped to -40..35 C.
        pressure_pa: Air pressure, Pa.
    """
    return vapour_ratio(saturation_pa(temperature_c), pressure_pa)


def vapour_ratio(vapour_pa: Values, pressure_pa: Values) -> Values:
    """Return the humidity ratio of air, in kg of water per kg of dry air.

    Args:
        vapour_pa: Partial pressure of water vapour, Pa.
        pressure_pa: Air pressure, Pa.
    """
    return WATER_TO_DRY_AIR * vapour_pa / (pressure_pa - vapour_pa)


def enthalpy_j_per_kg(temperature_c: Values, ratio: Values) -> Values:
    """Return the enthalpy of moist air, in J per kg of dry air; 0 for dry air and water at 0 C.

    Args:
        temperature_c: Temperature, C.
        ratio: Humidity ratio, kg/kg.
    """
    of_vapour = VAPOUR_J_PER_KG + VAPOUR_J_PER_KG_K * temperature_c
    return DRY_AIR_J_PER_KG_K * temperature_c + ratio * of_vapour


def saturated_ratio_by_enthalpy(enthalpy_j_per_kg: Values, pressure_pa: Values) -> Values:
    """Return the humidity ratio of saturated air from its enthalpy, in kg/kg, to within 8e-5.

    Args:
        enthalpy_j_per_kg: Enthalpy, J per kg of dry air; values are clipped to
            -15,000..260,000 J/kg where the temperature is computed.
        pressure_pa: Air pressure, Pa, 65,000..105,000.
    """
    bounded = np.clip(enthalpy_j_per_kg * 1e-3, *ENTHALPY_BOUNDS_KJ_PER_KG)
    root = np.sqrt(bounded + 40.0)
    q = pressure_pa / STANDARD_PA - 1.0
    at_sea_level_c = _polynomial(_SATURATED_C, root)
    by_pressure_c = _polynomial(_SATURATED_C_BY_PRESSURE, root)
    temperature_c = at_sea_level_c + q * (by_pressure_c + q * _SATURATED_C_BY_SQUARE * root)
    of_vapour = VAPOUR_J_PER_KG + VAPOUR_J_PER_KG_K * temperature_c
    return (enthalpy_j_per_kg - DRY_AIR_J_PER_KG_K * temperature_c) / of_vapour


def humidity_ratio(outdoor_c: Values, wet_bulb_c: Values, at_wet_bulb: Values) -> Values:
    """Return the humidity ratio from dry bulb and wet bulb, in kg/kg (eq. 33; eq. 35 below 0 C).

    The two equations, for a wick of water and of ice, differ at 0 C. The ratio changes from one to
    the other within ``FREEZING_BAND_K`` below 0 C.

    Args:
        outdoor_c: Dry-bulb temperature, C.
        wet_bulb_c: Wet-bulb temperature, C.
        at_wet_bulb: Humidity ratio of saturated air at the wet-bulb temperature, kg/kg.
    """
    ice = np.clip(-wet_bulb_c / FREEZING_BAND_K, 0.0, 1.0)
    water = 1.0 - ice
    vapour = ice * (2830.0 - 0.24 * wet_bulb_c) + water * (2501.0 - 2.326 * wet_bulb_c)
    of_water = ice * (2.1 * wet_bulb_c - 329.0) + water * (4.186 * wet_bulb_c)
    taken_up = vapour * at_wet_bulb - 1.006 * (outdoor_c - wet_bulb_c)
    return np.maximum(taken_up / (2501.0 + 1.86 * outdoor_c - of_water), 0.0)


def dry_air_kg_m3(outdoor_c: Values, ratio: Values, pressure_pa: Values) -> Values:
    """Return the mass of dry air per volume of moist air, in kg/m3 (eq. 26).

    Args:
        outdoor_c: Dry-bulb temperature, C.
        ratio: Humidity ratio, kg/kg.
        pressure_pa: Air pressure, Pa.
    """
    moist_share = 1.0 + ratio * (1.0 / WATER_TO_DRY_AIR)
    return pressure_pa / (GAS_CONSTANT_J_PER_KG_K * (outdoor_c + 273.15) * moist_share)


def _polynomial(coefficients: tuple[float, ...], x: Values) -> Values:
    """Evaluate a polynomial in x; ``coefficients`` start with the constant term."""
    total: Values = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = coefficient + x * total
    return total
