"""Statistics of a year in a dozen numbers, for tables and for comparing synthetic with real."""

from __future__ import annotations

import numpy as np

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.series import FloatArray, Series, resample
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, HOURS_PER_YEAR, MONTH_OF_DAY


def statistics(series: Series) -> dict[str, float]:
    """Statistics of the hourly means of a series of whole years.

    Args:
        series: any resolution that divides or is a multiple of an hour.

    Returns:
        ``mean``, ``std``, ``min``, ``p1``, ``p50``, ``p99``, ``max`` in the series' unit;
        ``diurnal`` and ``seasonal``: range of the mean by hour of day and by month;
        ``daily_std``: mean over days of the standard deviation within the day;
        ``acf1``, ``acf24``: correlation with the value 1 and 24 hours earlier.

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
