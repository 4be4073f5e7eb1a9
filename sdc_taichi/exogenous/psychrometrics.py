"""Moist air: pressure by elevation, humidity, and wet bulb of whole years at station pressure.

The equations are those of ASHRAE Handbook - Fundamentals (2017), chapter 1. The library psychrolib
solves the same equations for one state at a time, which takes seconds for a year.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sdc_taichi.exogenous.series import FloatArray, check_physical

TRIPLE_POINT_C = 0.01
MIN_HUMIDITY_RATIO = 1e-7
ELEVATION_LIMITS_M = (-1000.0, 10_000.0)
"""Limits of elevations above sea level, in m."""
_BISECTIONS = 40  # 180 K / 2**40 < 1e-9 K


def standard_pressure_pa(elevation_m: ArrayLike) -> FloatArray:
    """Return the pressure of the standard atmosphere, about the annual mean at an elevation.

    Args:
        elevation_m: elevation above sea level, in m, -1,000..10,000, any shape.

    Returns:
        Pressure in Pa, same shape (ASHRAE Fundamentals 2017, ch. 1, eq. 3).

    Raises:
        DataError: an elevation is outside this range.
    """
    check_physical("elevation_m", elevation_m, *ELEVATION_LIMITS_M)
    ratio = 1.0 - 2.25577e-5 * np.asarray(elevation_m, dtype=np.float64)
    return np.asarray(101_325.0 * ratio**5.2559, dtype=np.float64)


def saturation_pressure_pa(temperature_c: ArrayLike) -> FloatArray:
    """Return the saturation vapour pressure over ice (up to the triple point) or water.

    Args:
        temperature_c: temperature in C, any shape.

    Returns:
        Pressure in Pa, same shape (ASHRAE Fundamentals 2017, ch. 1, eq. 5 and 6; Hyland and Wexler
        1983).
    """
    t_c = np.asarray(temperature_c, dtype=np.float64)
    t = t_c + 273.15
    log_t = np.log(t)
    ice = (
        -5.6745359e3 / t
        + 6.3925247
        + t * (-9.677843e-3 + t * (6.2215701e-7 + t * (2.0747825e-9 - 9.484024e-13 * t)))
        + 4.1635019 * log_t
    )
    water = (
        -5.8002206e3 / t
        + 1.3914993
        + t * (-4.8640239e-2 + t * (4.1764768e-5 - 1.4452093e-8 * t))
        + 6.5459673 * log_t
    )
    return np.asarray(np.exp(np.where(t_c <= TRIPLE_POINT_C, ice, water)), dtype=np.float64)


def relative_humidity_from_dew_point_pct(
    outdoor_c: ArrayLike, dew_point_c: ArrayLike
) -> FloatArray:
    """Return relative humidity in % from dry bulb and dew point in C (eq. 11, 22 and 36)."""
    share = saturation_pressure_pa(dew_point_c) / saturation_pressure_pa(outdoor_c)
    return np.asarray(100.0 * share, dtype=np.float64)


def humidity_ratio(
    outdoor_c: ArrayLike, relative_humidity_pct: ArrayLike, pressure_pa: ArrayLike
) -> FloatArray:
    """Return the humidity ratio, kg water per kg dry air, at least 1e-7 (eq. 20 with eq. 22)."""
    vapour = np.asarray(relative_humidity_pct) / 100.0 * saturation_pressure_pa(outdoor_c)
    ratio = 0.621945 * vapour / (np.asarray(pressure_pa) - vapour)
    return np.asarray(np.maximum(ratio, MIN_HUMIDITY_RATIO), dtype=np.float64)


def wet_bulb_c(
    outdoor_c: ArrayLike, relative_humidity_pct: ArrayLike, pressure_pa: ArrayLike
) -> FloatArray:
    """Return the thermodynamic wet-bulb temperature at station pressure.

    The function solves ASHRAE Fundamentals (2017) ch. 1, eq. 33 (wet bulb above 0 C) and 35 (below)
    by bisection to 1e-9 K. The two equations differ at 0 C, so some states have a solution on
    each side of it. Bisection between dew point and dry bulb finds the same one as psychrolib.

    Args:
        outdoor_c: dry bulb in C, -100..70; the shapes of all arguments broadcast.
        relative_humidity_pct: relative humidity in %, 0..100.
        pressure_pa: station pressure in Pa, 31,000..120,000.

    Returns:
        Wet bulb in C, never above the dry bulb.

    Raises:
        DataError: an input is outside its range.
    """
    check_physical("outdoor_c", outdoor_c, -100.0, 70.0)
    check_physical("relative_humidity_pct", relative_humidity_pct, 0.0, 100.0)
    check_physical("pressure_pa", pressure_pa, 31_000.0, 120_000.0)
    t, humidity, pressure = (
        np.asarray(a, dtype=np.float64)
        for a in np.broadcast_arrays(outdoor_c, relative_humidity_pct, pressure_pa)
    )
    ratio = humidity_ratio(t, humidity, pressure)
    low, high = _dew_point_c(ratio, pressure, t), t.copy()
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        vapour = saturation_pressure_pa(middle)
        saturated = 0.621945 * vapour / (pressure - vapour)
        above = (
            np.where(
                middle >= 0.0,
                ((2501.0 - 2.326 * middle) * saturated - 1.006 * (t - middle))
                / (2501.0 + 1.86 * t - 4.186 * middle),
                ((2830.0 - 0.24 * middle) * saturated - 1.006 * (t - middle))
                / (2830.0 + 1.86 * t - 2.1 * middle),
            )
            > ratio
        )
        high = np.where(above, middle, high)
        low = np.where(above, low, middle)
    return np.asarray(0.5 * (low + high), dtype=np.float64)


def _dew_point_c(ratio: FloatArray, pressure: FloatArray, outdoor: FloatArray) -> FloatArray:
    """Return the dew point in C, at most the dry bulb, by bisection of eq. 5 and 6."""
    vapour = pressure * ratio / (0.621945 + ratio)
    low, high = np.full_like(outdoor, -110.0), outdoor
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        above = saturation_pressure_pa(middle) > vapour
        high = np.where(above, middle, high)
        low = np.where(above, low, middle)
    return np.asarray(0.5 * (low + high), dtype=np.float64)


def stull_wet_bulb_c(outdoor_c: ArrayLike, relative_humidity_pct: ArrayLike) -> FloatArray:
    """Return the wet bulb in C by Stull's fit for 101.325 kPa, for comparison only.

    Stull (2011), "Wet-bulb temperature from relative humidity and air temperature", Journal of
    Applied Meteorology and Climatology 50(11), eq. 1. Valid for 5..99 percent and -20..50 C.

    Args:
        outdoor_c: dry bulb, in C.
        relative_humidity_pct: relative humidity, in %.

    Returns:
        Wet bulb, in C.
    """
    t = np.asarray(outdoor_c, dtype=np.float64)
    rh = np.asarray(relative_humidity_pct, dtype=np.float64)
    return np.asarray(
        t * np.arctan(0.151977 * np.sqrt(rh + 8.313659))
        + np.arctan(t + rh)
        - np.arctan(rh - 1.676331)
        + 0.00391838 * rh**1.5 * np.arctan(0.023101 * rh)
        - 4.686035,
        dtype=np.float64,
    )
