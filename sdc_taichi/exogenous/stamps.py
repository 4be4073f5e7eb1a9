"""Meaning of the stamps of a carbon file: the start or the end of their interval.

EIA-930 stamps mark the end of the hour, but some authorities report the start, or did so until some
day. Solar generation shows which: its centre of gravity is after solar noon where stamps mark the
end of the hour, and before it where they mark the start.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, MINUTES_PER_DAY

MOST_LATENESS_H = 1.5
"""Largest distance of the centre of solar generation from solar noon at the site, in h: half an
hour for what stamps mark, and an hour for 15 degrees of longitude that solar plants may lie away.
Arizona has the largest of the embedded sites, 1.1 h."""
Stamp = Literal["auto", "start", "end"]
"""Moment of its interval that a stamp marks; ``auto`` infers it from the solar generation."""

HAS_OFFSET = r"(?:[Zz]|UTC|[+-]\d\d:?\d\d)$"
"""Regular expression of a UTC offset at the end of a stamp."""


def by_start_of_interval(
    stamp: Stamp,
    intensity: FloatArray,
    solar: FloatArray | None,
    local: np.datetime64,
    minutes: float,
    noon_h: float,
) -> tuple[FloatArray, int, str]:
    """Values in the order in which their intervals begin.

    Args:
        stamp: what a stamp marks, or ``auto`` to read it from the solar generation.
        intensity: values in the order of the file, (T,).
        solar: solar generation in the order of the file, any unit, (T,); None if not known.
        local: first stamp, in local standard time.
        minutes: length of an interval, in minutes.
        noon_h: mean solar noon, in hours of local standard time.

    Returns:
        One value per interval, (T,) or one more or less; by how many intervals the first one begins
        before its stamp (0 or 1); and a note.
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
    """Warning of solar generation that does not fit the longitude of the site, or an empty list.

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
    """Hours from solar noon to the centre of solar generation by stamp, per day; NaN on dark days.

    Mean solar noon is corrected by the equation of time (Spencer 1971).
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
    """Means before and after the day that best splits the series in two, and that day.

    A split counts only if both parts last 30 days and differ by 0.4 h (a change of what a stamp
    marks is an hour); otherwise both means are that of the whole.
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
