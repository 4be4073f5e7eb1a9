"""Workload traces: the share of the capacity that is asked for, interval by interval."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import files
from sdc_taichi.exogenous.series import Series

if TYPE_CHECKING:
    import pandas as pd

Rows: TypeAlias = NDArray[np.int64]
Stamps: TypeAlias = NDArray[np.datetime64]

_INDEX_HEADERS = frozenset({"index", "hour", "step", "time", "timestamp", "datetime"})
_HINT = " (divide percentages by 100)"


def read_workload(path: str | Path, *, minutes: float | None = None) -> Series:
    """Read a workload trace.

    The table has ``cpu_load`` in [0, 1] and, optionally, a first column with a running index or
    local standard time stamps without UTC offset. Rows without stamps begin on 1 January at 00:00
    and are hourly unless ``minutes`` says otherwise. A Parquet file written by ``data import`` is
    taken as it is.

    Args:
        path: CSV or Parquet.
        minutes: resolution of a file without stamps; None means hourly.

    Returns:
        Utilisation, whole years of 365 days.

    Raises:
        DataError: names file, row, column, value and what would be valid.
    """
    path = files.existing_file(path)
    if minutes is not None and not (np.isfinite(minutes) and minutes > 0.0):
        raise DataError(f"minutes: {minutes!r}, expected a positive number")
    if files.is_parquet(path):
        metadata = files.read_metadata(path)
        if metadata is not None:
            return _read_imported(path, metadata)
    frame, first_row = files.read_table(path)
    files.require_columns(path, frame, ("cpu_load",))
    rows = first_row + np.arange(len(frame))
    values = files.numbers(path, frame["cpu_load"], "cpu_load", rows, 0.0, 1.0, _HINT)
    blank = int(np.isnan(values).sum())
    notes = []
    positions = np.arange(len(frame))
    start = np.datetime64("2001-01-01T00:00:00", "s")
    first, stamped = str(frame.columns[0]), False
    blank_header = first.strip() in files.BLANK_HEADERS
    if blank_header or first.strip().lower() in _INDEX_HEADERS:
        text = frame[first].str.strip()
        stamped = not text.iloc[0].replace(".", "", 1).isdigit()
        if stamped:
            stamps = _stamps(path, text, first, rows)
            found, positions = files.grid_of_stamps(path, stamps, rows, first)
            if minutes is not None and found != minutes:
                raise DataError(f"{path}: column {first}: steps of {found:g} min, not {minutes:g}")
            minutes, start = found, stamps[0]
        else:
            positions = _running_index(path, text, first, rows)
        if blank_header:
            notes.append("blank first header read as " + ("timestamp" if stamped else "index"))
    minutes = 60.0 if minutes is None else float(minutes)
    longest = np.diff(positions).max(initial=1)
    if (longest - 1) * minutes > files.MAX_GAP_H * 60.0:
        at = int(np.argmax(np.diff(positions))) + 1
        hours = (longest - 1) * minutes / 60.0
        raise files.fault(
            path, int(rows[at]), first, f"{hours:g} h without rows", "gaps of at most 24 h"
        )
    values = files.spread(values, positions)
    absent = values.size - len(frame)
    for count, what in ((absent, "absent rows"), (blank, "rows without values")):
        if count:
            notes.append(f"{count} {what} interpolated")
    grid_rows = rows[np.minimum(np.searchsorted(positions, np.arange(values.size)), rows.size - 1)]
    values = files.fill_gaps(path, values, minutes, "cpu_load", grid_rows)
    if values.size % 168 == 0 and np.array_equal(values[168:], values[:-168]):
        notes.append(f"warning: the same 168 rows repeat {values.size // 168} times")
    since = 0.0
    if stamped:
        values, since, leap_notes = files.without_leap_days(values, start, minutes)
        notes += leap_notes
    values, year_notes = files.whole_years(path, values, since, minutes)
    return Series(
        values,
        minutes,
        "utilisation",
        "1",
        path.name,
        synthetic=False,
        notes=tuple(notes + year_notes),
    )


def _stamps(path: Path, text: pd.Series[str], column: str, rows: Rows) -> Stamps:
    """Local stamps; a UTC offset would leave open whose local time is meant."""
    import pandas as pd

    parsed = pd.to_datetime(text, errors="coerce", format="ISO8601", utc=True)
    bad = (parsed.isna() | text.str.contains(r"(?:[Zz]|UTC|:\d\d[+-]\d\d:?\d\d)$")).to_numpy()
    if bad.any():
        at = int(np.argmax(bad))
        valid = "local standard time such as 2022-01-01 00:00:00, without a UTC offset"
        raise files.fault(path, int(rows[at]), column, text.iloc[at], valid)
    return np.asarray(parsed.dt.tz_localize(None).to_numpy(), dtype="datetime64[s]")


def _running_index(path: Path, text: pd.Series[str], column: str, rows: Rows) -> Rows:
    """Positions from a running index of whole numbers, from 0."""
    index = files.numbers(path, text, column, rows, 0.0, 1e9)
    steps = np.diff(index, prepend=index[0] - 1.0)
    bad = ~((index == np.round(index)) & (steps >= 1.0))
    if bad.any():
        at = int(np.argmax(bad))
        valid = "whole numbers that increase from row to row"
        raise files.fault(path, int(rows[at]), column, text.iloc[at], valid)
    return np.asarray(index - index[0], dtype=np.int64)


def _read_imported(path: Path, metadata: dict[str, object]) -> Series:
    kind = files.metadata_value(path, metadata, "kind", str)
    if kind != "workload":
        raise DataError(f"{path}: metadata kind: {kind!r}, expected 'workload'")
    minutes = files.metadata_value(path, metadata, "minutes", float)
    columns = files.read_columns(path, {"utilisation": (0.0, 1.0)}, minutes)
    return files.imported_series(path, metadata, "utilisation", "1", columns, minutes)
