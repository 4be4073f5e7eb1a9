"""Clock of a simulation: years of 365 days in local standard time.

Every year begins on 1 January at 00:00, without 29 February and without daylight saving time.
Hour h of the year is therefore the same hour of the same day in every year. Days and steps of the
year are counted from 0.
"""

from __future__ import annotations

import re
from itertools import accumulate

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import ConfigError, shortened

DAYS_PER_MONTH = (31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31)
"""Number of days in each month, January first."""
FIRST_DAY_OF_MONTH = (0, *accumulate(DAYS_PER_MONTH))
"""Day of the year on which each month begins, January first; the last entry is 365."""
MONTH_OF_DAY = tuple(month for month, days in enumerate(DAYS_PER_MONTH, 1) for _ in range(days))
"""Month, 1..12, of each day of the year."""
DAYS_PER_YEAR = FIRST_DAY_OF_MONTH[-1]
"""Number of days in a year: 365."""
HOURS_PER_YEAR = 24 * DAYS_PER_YEAR
"""Number of hours in a year: 8760."""
MINUTES_PER_DAY = 24 * 60
"""Number of minutes in a day: 1440."""
MINUTES_PER_YEAR = MINUTES_PER_DAY * DAYS_PER_YEAR
"""Number of minutes in a year: 525,600."""
TYPICAL_YEAR = 2018
"""Calendar year of runs whose config and input files name none, such as those of typical years. It
has 365 days and begins on a Monday, like every year of the tariffs."""
YEARS = (1900, 2100)
"""First and last valid calendar year of a first step."""
UTC_OFFSETS_H = (-12.0, 14.0)
"""Smallest and largest valid local standard time minus UTC, in h."""
MOST_DAYS = 36_500
"""Maximum length of a run, in days: a century."""


def whole_steps(days: float, steps_per_hour: int, what: str = "days") -> int:
    """Return the number of steps in a duration.

    Args:
        days: duration, in days.
        steps_per_hour: number of steps in an hour.
        what: name of the duration, for the message.

    Raises:
        ConfigError: the duration is out of bounds, or is not a whole number of steps.
    """
    per_day = 24 * steps_per_hour
    steps = days * per_day
    if not 0 < days <= MOST_DAYS or abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
        raise ConfigError(
            f"{what} {days:g}: valid is a positive number of days, at most {MOST_DAYS:,}, that "
            f"makes whole steps of {60 // steps_per_hour} min, that is n/{per_day}"
        )
    return round(steps)


def day_of_year(month_day: object) -> int:
    """Return the day of the year, 0..364, of a text such as ``07-01``.

    Raises:
        ValueError: the text is not a day of a 365-day year.
    """
    match = re.fullmatch(r"([0-9]{1,2})-([0-9]{1,2})", str(month_day).strip())
    if match:
        month, day = int(match[1]), int(match[2])
        if 1 <= month <= 12 and 1 <= day <= DAYS_PER_MONTH[month - 1]:
            return FIRST_DAY_OF_MONTH[month - 1] + day - 1
    raise ValueError(
        f"start {shortened(month_day)} is no day of a 365-day year; valid is MM-DD, for example "
        "07-01"
    )


def step_times(
    start: npt.NDArray[np.int64],
    steps: npt.NDArray[np.int64],
    steps_per_hour: int,
    year: npt.NDArray[np.int64],
) -> npt.NDArray[np.datetime64]:
    """Return the local standard time at which each step begins.

    The 29 February of a calendar leap year is skipped.

    Args:
        start: first step of each data center, counted from the beginning of its year, (B,).
        steps: steps since reset, (n,).
        steps_per_hour: number of steps in an hour.
        year: calendar year of the first step of each data center, (B,).

    Returns:
        Time stamps in milliseconds, (n, B).
    """
    minutes = (start + steps[:, None]) * (60 // steps_per_hour)
    years, within = year + minutes // MINUTES_PER_YEAR, minutes % MINUTES_PER_YEAR
    from_march = within >= MINUTES_PER_DAY * FIRST_DAY_OF_MONTH[2]
    within = within + MINUTES_PER_DAY * (_is_leap_year(years) & from_march)
    new_year = (years - 1970).astype("datetime64[Y]").astype("datetime64[ms]")
    return np.asarray(new_year + within.astype("timedelta64[m]"))


def is_leap_day(times: npt.NDArray[np.datetime64]) -> npt.NDArray[np.bool_]:
    """Return True for each calendar time, of any shape, that is on 29 February."""
    months = times.astype("datetime64[M]")
    month = months.astype(np.int64) % 12
    day = (times.astype("datetime64[D]") - months.astype("datetime64[D]")).astype(np.int64)
    return np.asarray((month == 1) & (day == 28))


def minutes_into_year(time: np.datetime64) -> float:
    """Return the minutes of the 365-day year that have passed at a calendar time.

    Args:
        time: any time that is not on 29 February.
    """
    year = time.astype("datetime64[Y]")
    minutes = float((time - year.astype(time.dtype)) / np.timedelta64(1, "m"))
    leap_year = bool(_is_leap_year(year.astype(np.int64) + 1970))
    if leap_year and minutes >= MINUTES_PER_DAY * FIRST_DAY_OF_MONTH[2]:
        minutes -= MINUTES_PER_DAY
    return minutes


def _is_leap_year(years: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return True for each year of the Gregorian calendar with a 29 February."""
    years = np.asarray(years, dtype=np.int64)
    return np.asarray((years % 4 == 0) & ((years % 100 != 0) | (years % 400 == 0)))
