"""Properties of moist air as polynomials, cheap enough for every step of every data center.

The polynomials are fitted to the equations of ASHRAE Handbook - Fundamentals (2017), chapter 1,
which ``exogenous.psychrometrics`` solves for whole years of weather. Equation numbers refer to that
chapter. Arguments are float64 arrays of shape (B,), B data centers, or anything that broadcasts to
it.
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.types import Values, as_array

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

SATURATION_BOUNDS_C = (-90.0, 60.0)
"""Lowest and highest temperature at which the saturation pressure is evaluated, in C."""
_TRIPLE_PA = 611.2
"""Saturation pressure at 0 C, in Pa."""
_OVER_WATER, _OVER_ICE = (18.678, 257.14, 1.0 / 234.5), (23.036, 279.82, 1.0 / 333.7)
"""Coefficients a, b (C) and c (1/C) of the saturation pressure by Buck: the exponent is
(a - c*T)*T/(b + T), T in C."""
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
_COLD_J_PER_KG_K = 1100.0
"""Growth of the enthalpy of saturated air with its temperature, in J/(kg K), around -35 C."""


def saturation_pa(temperature_c: Values) -> Values:
    """Return the saturation pressure of water vapour (above ice if below 0 C), in Pa.

    The equation is that of Buck (Journal of Applied Meteorology 20, 1981, with the coefficients of
    1996), within 0.1 % of that of ASHRAE at -40..60 C.

    Args:
        temperature_c: Temperature, C; values are clipped to -90..60 C.
    """
    bounded_c = np.clip(temperature_c, *SATURATION_BOUNDS_C)
    a, b, c = _buck(bounded_c)
    return as_array(_TRIPLE_PA * np.exp((a - c * bounded_c) * bounded_c / (b + bounded_c)))


def saturated_ratio(temperature_c: Values, pressure_pa: Values) -> Values:
    """Return the humidity ratio of saturated air, in kg of water per kg of dry air.

    Args:
        temperature_c: Temperature, C; values are clipped to -90..60 C.
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
    """Return the humidity ratio of saturated air from its enthalpy, in kg/kg, to within 1e-5.

    A polynomial gives a first temperature, which one step of Newton's method corrects. In air that
    is colder than the range of the polynomial, the first temperature follows the enthalpy linearly.

    Args:
        enthalpy_j_per_kg: Enthalpy, J per kg of dry air, up to 260,000 J/kg.
        pressure_pa: Air pressure, Pa, 65,000..105,000.
    """
    bounded = np.clip(enthalpy_j_per_kg * 1e-3, *ENTHALPY_BOUNDS_KJ_PER_KG)
    root = np.sqrt(bounded + 40.0)
    q = pressure_pa / STANDARD_PA - 1.0
    at_sea_level_c = _polynomial(_SATURATED_C, root)
    by_pressure_c = _polynomial(_SATURATED_C_BY_PRESSURE, root)
    first_c = at_sea_level_c + q * (by_pressure_c + q * _SATURATED_C_BY_SQUARE * root)
    colder_j_per_kg = np.minimum(enthalpy_j_per_kg - 1e3 * ENTHALPY_BOUNDS_KJ_PER_KG[0], 0.0)
    first_c = first_c + colder_j_per_kg / _COLD_J_PER_KG_K
    first = saturated_ratio(first_c, pressure_pa)
    a, b, c = _buck(first_c)
    relative_growth = (a * b - c * first_c * (2.0 * b + first_c)) / (b + first_c) ** 2
    growth = first * (1.0 + first / WATER_TO_DRY_AIR) * relative_growth
    slope = DRY_AIR_J_PER_KG_K + growth * VAPOUR_J_PER_KG
    of_first = DRY_AIR_J_PER_KG_K * first_c + first * (
        VAPOUR_J_PER_KG + VAPOUR_J_PER_KG_K * first_c
    )
    return first + growth * (enthalpy_j_per_kg - of_first) / slope


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


def dew_point_c(outdoor_c: Values, wet_bulb_c: Values, pressure_pa: Values) -> Values:
    """Return the dew point from dry bulb and wet bulb, in C, at least -60 C.

    The Magnus equation with the coefficients of Alduchov and Eskridge (Journal of Applied
    Meteorology 35, 1996) is inverted; it is within 0.4 % of measured pressures at -40..50 C.

    Args:
        outdoor_c: Dry-bulb temperature, C.
        wet_bulb_c: Wet-bulb temperature, C.
        pressure_pa: Air pressure, Pa.
    """
    ratio = humidity_ratio(outdoor_c, wet_bulb_c, saturated_ratio(wet_bulb_c, pressure_pa))
    vapour_pa = pressure_pa * ratio / (WATER_TO_DRY_AIR + ratio)
    x = np.log(np.maximum(vapour_pa, 1.0) / 610.94)
    return np.minimum(243.04 * x / (17.625 - x), outdoor_c)


def dry_air_kg_m3(outdoor_c: Values, ratio: Values, pressure_pa: Values) -> Values:
    """Return the mass of dry air per volume of moist air, in kg/m3 (eq. 26).

    Args:
        outdoor_c: Dry-bulb temperature, C.
        ratio: Humidity ratio, kg/kg.
        pressure_pa: Air pressure, Pa.
    """
    moist_share = 1.0 + ratio * (1.0 / WATER_TO_DRY_AIR)
    return pressure_pa / (GAS_CONSTANT_J_PER_KG_K * (outdoor_c + 273.15) * moist_share)


def _buck(temperature_c: Values) -> tuple[Values, ...]:
    """Return the coefficients of the saturation pressure above water, or above ice below 0 C."""
    frost = np.less(temperature_c, 0.0)
    pairs = zip(_OVER_ICE, _OVER_WATER, strict=True)
    return tuple(np.where(frost, ice, water) for ice, water in pairs)


def _polynomial(coefficients: tuple[float, ...], x: Values) -> Values:
    """Evaluate a polynomial in x; ``coefficients`` start with the constant term."""
    total: Values = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = coefficient + x * total
    return total
