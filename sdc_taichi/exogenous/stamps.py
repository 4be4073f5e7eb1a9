"""Detection of whether the stamps of a carbon file mark the start or the end of an interval.

EIA-930 stamps mark the end of the hour, but some authorities report the start, or did so until a
certain day. Solar generation shows the difference: its centre of gravity is after solar noon if
stamps mark the end of the hour, and before it if they mark the start.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, MINUTES_PER_DAY

MOST_LATENESS_H = 1.5
"""Largest valid distance of the centre of solar generation from solar noon at the site, in h. Half
an hour is for the meaning of stamps, and an hour for solar plants up to 15 degrees of longitude
away. The largest distance of an embedded site is 1.1 h, in Arizona."""
Stamp = Literal["auto", "start", "end"]
"""Moment of its interval that a stamp marks; ``auto`` infers it from solar generation."""

HAS_OFFSET = r"(?:[Zz]|UTC|[+-]\d\d:?\d\d)$"
"""Regular expression for a UTC offset at the end of a stamp."""


def by_start_of_interval(
    stamp: Stamp,
    intensity: FloatArray,
    solar: FloatArray | None,
    local: np.datetime64,
    minutes: float,
    noon_h: float,
) -> tuple[FloatArray, int, str]:
    """Return one value per interval, in the order of the intervals.

    Args:
        stamp: moment that a stamp marks, or ``auto`` to infer it from solar generation.
        intensity: values in the order of the file, (T,).
        solar: solar generation in the order of the file, any unit, (T,); None if not known.
        local: first stamp, in local standard time.
        minutes: length of an interval, in minutes.
        noon_h: mean solar noon, in hours of local standard time.

    Returns:
        Values, (T,) or one more; number of intervals by which the first interval begins before its
        stamp (0 or 1); and a note.
    """
    if stamp != "auto":
        return intensity, int(stamp == "end"), f"stamps mark the {stamp} of the interval (given)"
    lateness = None if solar is None else _solar_lateness(solar, local, minutes, noon_h)
    if lateness is None:
        return intensity, 1, "stamps mark the end of the interval (assumed: no solar generation)"
    before, after, day = _best_split(lateness)
    if (before > 0.0) == (after > 0.0):
        word = "end" if before > 0.0 else "start"
        return intensity, int(before > 0.0), f"stamps mark the {word} of the interval (solar noon)"
    per_day = round(MINUTES_PER_DAY / minutes)
    cut = min(day * per_day, len(intensity) - 1)
    date = (local + np.timedelta64(day, "D")).astype("datetime64[D]")
    if before > 0.0:  # end, then start: one interval is never reported
        gap = 0.5 * (intensity[cut - 1] + intensity[cut])
        joined = np.insert(intensity, cut, gap)
        return joined, 1, f"stamps mark the end until {date}, then the start (solar noon); 1 filled"
    # start, then end: one interval is reported twice, and the last of the year never
    joined = np.append(np.delete(intensity, cut), 0.5 * (intensity[-1] + intensity[0]))
    return joined, 0, f"stamps mark the start until {date}, then the end (solar noon); 1 filled"


def region_notes(
    solar: FloatArray, local: np.datetime64, minutes: float, noon_h: float
) -> list[str]:
    """Return a warning if solar generation does not fit the site's longitude, else an empty list.

    Args:
        solar: solar generation in the order of the file, any unit, (T,).
        local: first stamp, in local standard time of the site.
        minutes: length of an interval, in minutes.
        noon_h: mean solar noon at the site, in hours of local standard time.
    """
    lateness = _solar_lateness(solar, local, minutes, noon_h)
    mean_h = 0.0 if lateness is None else float(np.nanmean(lateness))
    if abs(mean_h) <= MOST_LATENESS_H:
        return []
    word = "after" if mean_h > 0.0 else "before"
    return [
        f"warning: solar generation is centred {abs(mean_h):.1f} h {word} solar noon at the site, "
        "so it may be of another region than the weather"
    ]


def _solar_lateness(
    solar: FloatArray, local: np.datetime64, minutes: float, noon_h: float
) -> FloatArray | None:
    """Return hours from solar noon to the centre of solar generation, per day; NaN on dark days.

    The equation of time (Spencer 1971) corrects the mean solar noon.
    """
    times = local.astype("datetime64[s]") + np.timedelta64(round(minutes * 60), "s") * np.arange(
        solar.size
    )
    day = (times.astype("datetime64[D]") - times[0].astype("datetime64[D]")).astype(np.int64)
    hour = (times - times.astype("datetime64[D]")) / np.timedelta64(1, "h")
    total = np.bincount(day, solar)
    bright = total > 0.1 * np.median(total[total > 0.0]) if (total > 0.0).any() else total > 0.0
    if bright.sum() < 30:
        return None
    year_angle = (
        2.0
        * np.pi
        / DAYS_PER_YEAR
        * (
            (times[0].astype("datetime64[D]") - times[0].astype("datetime64[Y]")).astype(np.int64)
            + np.arange(total.size)
        )
    )
    equation_h = (
        0.000075
        + 0.001868 * np.cos(year_angle)
        - 0.032077 * np.sin(year_angle)
        - 0.014615 * np.cos(2.0 * year_angle)
        - 0.040849 * np.sin(2.0 * year_angle)
    ) * (12.0 / np.pi)
    late = np.full(total.size, np.nan)
    late[bright] = np.bincount(day, solar * hour)[bright] / total[bright]
    return np.asarray(late - (noon_h - equation_h), dtype=np.float64)


def _best_split(lateness: FloatArray) -> tuple[float, float, int]:
    """Return the means before and after the day that best splits the series in two, and that day.

    A split counts only if both parts last 30 days and differ by 0.4 h (a change in the meaning of
    stamps is an hour). Otherwise both means are the median of the whole series.
    """
    days = np.flatnonzero(~np.isnan(lateness))
    values = lateness[days]
    n = values.size
    whole = float(np.median(values))
    count = np.arange(1, n)
    left = np.cumsum(values)[:-1]
    right = values.sum() - left
    explained = left**2 / count + right**2 / (n - count)
    allowed = (count >= 30) & (n - count >= 30)
    if not allowed.any():
        return whole, whole, 0
    at = int(np.argmax(np.where(allowed, explained, -np.inf))) + 1
    before, after = float(values[:at].mean()), float(values[at:].mean())
    if abs(after - before) < 0.4:
        return whole, whole, 0
    return before, after, int(days[at])
