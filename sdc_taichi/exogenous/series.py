"""Time series of a site: one or more years of values on the simulator's clock.

The clock is local standard time in years of 365 days (``exogenous.year_clock``). Index 0 is the
interval that begins on 1 January at 00:00. A value describes its whole interval.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.year_clock import (
    DAYS_PER_YEAR,
    HOURS_PER_YEAR,
    MINUTES_PER_DAY,
    MONTH_OF_DAY,
)

FloatArray = NDArray[np.float64]

OUTDOOR_LIMITS_C = (-90.0, 60.0)
"""Limits of outdoor temperatures, in C. The extremes on record (WMO) are -89.2 C (Vostok 1983) and
56.7 C (Furnace Creek 1913). Summer temperatures in degrees Fahrenheit exceed the upper limit."""
MEAN_LIMITS_C = (-65.0, 40.0)
"""Limits of the annual mean temperature, in C. The extremes are about -58 C on the Antarctic
plateau and 34.6 C at Dallol (Ethiopia)."""
MOST_SPREAD_K = 115.0
"""Largest valid range of temperatures in a year, in K; the extreme is 105 K at Verkhoyansk."""

DESIGN_QUANTILE = 0.996
"""Quantile of the year that defines a design temperature: exceeded in 0.4 % of the year, as for
ASHRAE design conditions."""
_DESIGN_STEPS_PER_HOUR = 4
"""Time step of the values of which design temperatures are quantiles, whatever step a run has."""


@dataclass(frozen=True, eq=False)
class Series:
    """Values at regular intervals; after the end the series starts again."""

    values: FloatArray
    """Value of each interval, in ``unit``, (T,); finite, read-only."""
    minutes: float
    """Length of an interval, in minutes."""
    name: str
    """Name of the quantity, such as ``outdoor_c``."""
    unit: str
    """Unit of the values, such as ``C``."""
    source: str
    """Origin of the values: a file, or the data to which a synthetic year is fitted."""
    synthetic: bool
    """True if the values were generated, False if they were measured."""
    notes: tuple[str, ...] = field(default=())
    """Repairs with their counts, and warnings."""
    year: int | None = None
    """Calendar year of most of the first 365 days; None for generated and typical years."""

    def __post_init__(self) -> None:
        """Take a read-only copy of the values and check them.

        Raises:
            DataError: the values are not a finite vector, or the resolution is not positive.
        """
        values = np.array(self.values, dtype=np.float64)
        if values.ndim != 1 or values.size == 0:
            raise DataError(f"{self.name}: shape {values.shape}, expected (T,) with T >= 1")
        if not np.isfinite(self.minutes) or self.minutes <= 0:
            raise DataError(f"{self.name}: minutes {self.minutes}, expected a positive number")
        finite = np.isfinite(values)
        if not finite.all():
            at = int(np.argmin(finite))
            raise DataError(f"{self.name}: index {at}: {values[at]}, expected a finite number")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "minutes", float(self.minutes))
        object.__setattr__(self, "notes", tuple(self.notes))

    @property
    def days(self) -> float:
        """Length of the series in days."""
        return self.values.size * self.minutes / MINUTES_PER_DAY


@dataclass(frozen=True)
class DesignConditions:
    """Climatic design conditions of a station (ASHRAE Handbook - Fundamentals 2021, chapter 14)."""

    outdoor_c: float
    """Dry bulb exceeded during 0.4 % of the year, in C."""
    wet_bulb_c: float
    """Wet bulb exceeded during 0.4 % of the year (design value for evaporation), in C."""
    extreme_outdoor_c: float | None = None
    """Highest dry bulb in 20 years, in C; None if it is not known."""

    def __post_init__(self) -> None:
        """Check that the values are possible on Earth.

        Raises:
            DataError: a value is out of range, or the wet bulb is above the dry bulb.
        """
        check_physical("design dry bulb", self.outdoor_c, *OUTDOOR_LIMITS_C)
        check_physical("design wet bulb", self.wet_bulb_c, -90.0, self.outdoor_c)


@dataclass(frozen=True, eq=False)
class Weather:
    """Weather of a station on the simulator's clock, and the location of the station."""

    label: str
    """Name of the place, such as ``Phoenix, Arizona``."""
    latitude_deg: float
    """Latitude, in degrees north."""
    longitude_deg: float
    """Longitude, in degrees east."""
    elevation_m: float
    """Elevation above sea level, in m."""
    utc_offset_h: float
    """Local standard time minus UTC, in h."""
    outdoor_c: Series
    """Outdoor dry bulb, in C."""
    wet_bulb_c: Series
    """Outdoor wet bulb, in C."""
    relative_humidity_pct: Series | None = None
    """Relative humidity, in %; None if it is not known."""
    pressure_pa: Series | None = None
    """Air pressure at the station, in Pa; None if it is not known."""
    design: DesignConditions | None = None
    """Design conditions of the station; None if its file has none."""

    def __post_init__(self) -> None:
        """Check that the temperatures are possible on Earth.

        Raises:
            DataError: the mean or the range of temperatures is outside that of all places.
        """
        outdoor = self.outdoor_c
        mean, spread = float(outdoor.values.mean()), float(np.ptp(outdoor.values))
        low, high = MEAN_LIMITS_C
        fahrenheit = "(degrees Fahrenheit taken for C?)"
        if not low <= mean <= high:
            raise DataError(
                f"{outdoor.source}: mean dry bulb {mean:.1f} C, expected {low:g} to {high:g} C "
                f"{fahrenheit}"
            )
        if spread > MOST_SPREAD_K:
            raise DataError(
                f"{outdoor.source}: dry bulbs differ by {spread:.1f} K, expected at most "
                f"{MOST_SPREAD_K:g} K {fahrenheit}"
            )


@dataclass(frozen=True, eq=False, kw_only=True)
class SiteData(Weather):
    """Weather and grid carbon intensity of one site, on one clock.

    The series may differ in resolution and length. ``resample`` converts each of them to the time
    step of a simulation.
    """

    name: str
    """Name of the site in configurations."""
    ci_g_per_kwh: Series
    """Carbon intensity of the grid, in g CO2e/kWh."""

    @property
    def series(self) -> tuple[Series, ...]:
        """All known series, temperatures first."""
        every = (
            self.outdoor_c,
            self.wet_bulb_c,
            self.ci_g_per_kwh,
            self.relative_humidity_pct,
            self.pressure_pa,
        )
        return tuple(s for s in every if s is not None)

    @property
    def synthetic(self) -> bool:
        """True if dry bulb, wet bulb or carbon intensity was generated."""
        return any(s.synthetic for s in (self.outdoor_c, self.wet_bulb_c, self.ci_g_per_kwh))


def rarely_exceeded(series: Series) -> float:
    """Return the value that a series exceeds in 0.4 % of its time, in the unit of the series.

    For temperatures it is the design temperature of a site without design conditions.
    """
    return float(np.quantile(resample(series, _DESIGN_STEPS_PER_HOUR), DESIGN_QUANTILE))


def step_minutes(steps_per_hour: int) -> int:
    """Return the length of a step, in minutes.

    Raises:
        DataError: ``steps_per_hour`` does not divide 60 minutes.
    """
    whole = not isinstance(steps_per_hour, bool) and isinstance(steps_per_hour, int | np.integer)
    if not whole or steps_per_hour < 1 or 60 % int(steps_per_hour):
        raise DataError(
            f"steps_per_hour: {steps_per_hour!r}, expected one of "
            "1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30, 60"
        )
    return 60 // int(steps_per_hour)


def resample(series: Series, steps_per_hour: int, *, hold: bool = False) -> FloatArray:
    """Convert a series to the time step of a simulation.

    For a finer step, values are interpolated linearly between the centres of intervals, with the
    last interval next to the first. This neither stretches nor shifts the year. With ``hold`` (for
    flows such as work), each value applies to its whole interval instead. For a coarser step,
    values are averaged by overlap. Averaging and holding conserve the mean; interpolation does so
    if the step divides the resolution.

    Args:
        series: the series, with resolution ``series.minutes``.
        steps_per_hour: number of steps per hour, a divisor of 60.
        hold: True to hold values over their interval instead of interpolating.

    Returns:
        Values, (N,), float64; N is the length of the series divided by the step.

    Raises:
        DataError: the step does not divide an hour, or the series is not a whole number of steps.
    """
    step = step_minutes(steps_per_hour)
    total = series.values.size * series.minutes
    n = round(total / step)
    if n < 1 or abs(n * step - total) > 1e-6 * step:
        raise DataError(
            f"{series.name}: {series.values.size} values of {series.minutes:g} min are not a whole "
            f"number of {step} min steps"
        )
    values = series.values
    if n == values.size:
        return values.copy()
    if n < values.size:
        if values.size % n == 0:
            return np.asarray(values.reshape(n, -1).mean(axis=1), dtype=np.float64)
        return _mean_by_overlap(values, n)
    if hold:
        return (
            np.repeat(values, n // values.size)
            if n % values.size == 0
            else _mean_by_overlap(values, n)
        )
    centres = (np.arange(n) + 0.5) * (values.size / n) - 0.5
    left = np.floor(centres).astype(np.int64)
    share = centres - left
    return np.asarray(
        (1.0 - share) * values[left % values.size] + share * values[(left + 1) % values.size],
        dtype=np.float64,
    )


def _mean_by_overlap(values: FloatArray, n: int) -> FloatArray:
    """Return values on n equal intervals: the mean of the input, weighted by overlap."""
    mean = values.mean()  # subtracted to keep the running sum small
    total = np.concatenate([[0.0], np.cumsum(values - mean)])
    edges = np.linspace(0.0, values.size, n + 1)
    return np.asarray(
        mean + np.diff(np.interp(edges, np.arange(values.size + 1), total)) * (n / values.size),
        dtype=np.float64,
    )


def check_physical(name: str, values: ArrayLike, low: float, high: float) -> None:
    """Check that all values are from ``low`` to ``high``.

    Raises:
        DataError: a value is outside; the message names the first index.
    """
    array: Any = np.asarray(values, dtype=np.float64)
    good = (array >= low) & (array <= high)
    if not np.all(good):
        at = int(np.argmin(good))
        value = float(array.ravel()[at])
        raise DataError(f"{name}: index {at}: {value:g}, expected {low:g} to {high:g}")


def statistics(series: Series) -> dict[str, float]:
    """Compute statistics of the hourly means of a series of whole years.

    Args:
        series: series whose resolution divides an hour or is a multiple of it.

    Returns:
        ``mean``, ``std``, ``min``, ``p1``, ``p50``, ``p99``, ``max`` in the series' unit;
        ``diurnal`` and ``seasonal``: range of the means by hour of the day and by month;
        ``daily_std``: standard deviation within a day, mean over all days;
        ``acf1``, ``acf24``: autocorrelation at lags of 1 and 24 hours.

    Raises:
        DataError: the series is not a whole number of 365-day years.
    """
    hourly = resample(series, 1)
    if hourly.size % HOURS_PER_YEAR:
        raise DataError(f"{series.name}: {series.days:g} days, expected whole years of 365 days")
    by_day = hourly.reshape(-1, 24)
    months = np.tile(MONTH_OF_DAY, len(by_day) // DAYS_PER_YEAR)
    monthly = [by_day[months == month].mean() for month in range(1, 13)]
    p1, p50, p99 = np.percentile(hourly, [1, 50, 99])
    return {
        "mean": float(hourly.mean()),
        "std": float(hourly.std()),
        "min": float(hourly.min()),
        "p1": float(p1),
        "p50": float(p50),
        "p99": float(p99),
        "max": float(hourly.max()),
        "diurnal": float(np.ptp(by_day.mean(axis=0))),
        "seasonal": float(np.ptp(monthly)),
        "daily_std": float(by_day.std(axis=1).mean()),
        "acf1": _lag_correlation(hourly, 1),
        "acf24": _lag_correlation(hourly, 24),
    }


def _lag_correlation(values: FloatArray, lag: int) -> float:
    """Correlation of a series with itself ``lag`` values earlier; 0 for a constant series."""
    if np.ptp(values) == 0.0:
        return 0.0
    return float(np.corrcoef(values[lag:], values[:-lag])[0, 1])
