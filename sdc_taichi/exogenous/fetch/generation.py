"""Generation by type of energy, as a carbon table of the columns that ``read_carbon`` knows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous.files import MAX_GAP_H
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.synthetic import FUELS, emission_factors

STORAGE = None
"""What a type of energy counts as that only gives back what was generated before."""


class Period(NamedTuple):
    """A part of a year that one request covers."""

    first: int
    """First hour, counted from 1 January 00:00 UTC."""
    stop: int
    """Hour after the last."""


def check_year(year: int, first: int, this_year: int) -> None:
    """Check that a service can have a whole calendar year.

    Args:
        year: the year that is asked for.
        first: first year of the service.
        this_year: the year of today.

    Raises:
        DataError: before the first, or not over yet.
    """
    if not first <= year < this_year:
        raise DataError(
            f"--year {year}: expected {first} to {this_year - 1}, a calendar year that is over"
        )


def hours_of_year(year: int) -> int:
    """Number of hours of a calendar year."""
    days = np.datetime64(f"{year + 1}-01-01") - np.datetime64(f"{year}-01-01")
    return int(days.astype(int)) * 24


def by_column(
    by_type: Mapping[str, FloatArray],
    columns: Mapping[str, str | None],
    periods: Sequence[Period],
) -> tuple[FloatArray, list[str]]:
    """Generation of the eight columns of a carbon table.

    Services leave out what an area does not have, so a type counts as 0 in more than a day before
    its first and after its last value, and in periods without any value of it. Other hours stay
    missing, for the reader to fill or to refuse.

    Args:
        by_type: generation in each hour of the year, in MWh, (T,) for each type; NaN is missing.
        columns: the column that each type counts as, or None for storage, which is left out.
        periods: parts of the year that were asked for one by one.

    Returns:
        Generation in MWh, (T, 8), NaN where it is missing, and notes.
    """
    hours = periods[-1].stop
    values = np.zeros((hours, len(FUELS)))
    notes = []
    for name, series in sorted(by_type.items()):
        column = columns.get(name, "OTH")
        if name not in columns:
            notes.append(f"warning: type {name} is not known and counts as OTH")
        if column is STORAGE:
            notes.append(f"{name} (storage) left out")
            continue
        if column != name:
            notes.append(f"{name} counts as {column}")
        series = series.copy()
        absent = _absent(series, periods)
        series[absent] = 0.0
        if absent.any():
            notes.append(f"{name} is not reported for {int(absent.sum())} h, which count as 0")
        below = series < 0.0
        if below.any():
            notes.append(f"{int(below.sum())} negative values of {name} set to 0")
            series[below] = 0.0
        values[:, FUELS.index(column)] += series
    # An hour of which nothing at all is known.
    values[~(np.nansum(values, axis=1) > 0.0)] = np.nan
    return values, notes


def _absent(series: FloatArray, periods: Sequence[Period]) -> NDArray[np.bool_]:
    """Hours in which a type of energy is not reported rather than missing, (T,)."""
    missing = np.isnan(series)
    absent = np.zeros(missing.size, dtype=bool)
    known = np.flatnonzero(~missing)
    ends = (known[0], known[-1] + 1) if known.size else (missing.size, missing.size)
    for edge in (slice(0, ends[0]), slice(ends[1], None)):
        absent[edge] = absent[edge].size > MAX_GAP_H
    for first, stop in periods:
        if missing[first:stop].all():
            absent[first:stop] = True
    return absent


def carbon_table(start: np.datetime64, values: FloatArray) -> bytes:
    """A carbon table as CSV, with the average intensity by the factors of this package.

    Args:
        start: first hour, in UTC.
        values: generation of each hour in MWh, (T, 8), NaN where it is missing.
    """
    factors = np.array([emission_factors()[fuel] for fuel in FUELS])
    intensity = values @ factors / values.sum(axis=1)
    stamps = start.astype("datetime64[h]") + np.arange(len(values))
    lines = [",".join(("timestamp", *FUELS, "avg_CI"))]
    for stamp, row, average in zip(stamps.tolist(), values.tolist(), intensity, strict=True):
        cells = ["" if np.isnan(x) else f"{x:.6g}" for x in row]
        cells.append("" if np.isnan(average) else f"{average:.3f}")
        lines.append(f"{stamp:%Y-%m-%d %H:%M:%S}+00:00,{','.join(cells)}")
    return ("\n".join(lines) + "\n").encode()
