"""Workload traces: the share of the capacity that is asked for, interval by interval."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous import files, series_file
from sdc_taichi.exogenous.columns import column_map
from sdc_taichi.exogenous.series import Series
from sdc_taichi.number_text import parse_number

if TYPE_CHECKING:
    import pandas as pd

Rows: TypeAlias = NDArray[np.int64]
Stamps: TypeAlias = NDArray[np.datetime64]

_INDEX_HEADERS = frozenset({"index", "hour", "step", "time", "timestamp", "datetime"})
_PERCENT_HINT = " (percentages are read with --map cpu_load:%=COLUMN)"


def read_workload(
    path: str | Path,
    *,
    minutes: float | None = None,
    columns: Mapping[str, str] = MappingProxyType({}),
) -> Series:
    """Read a workload trace.

    The table has ``cpu_load`` in [0, 1] and, optionally, a first column with a running index or
    local standard time stamps without UTC offset. Rows without stamps begin on 1 January at 00:00
    and are hourly unless ``minutes`` says otherwise. A Parquet file written by ``data import`` is
    taken as it is.

    Args:
        path: CSV or Parquet.
        minutes: resolution of a file without stamps; None means hourly.
        columns: ``cpu_load``, with its unit where it is another, or ``timestamp``, and the names
            that they have in the table, such as ``{"cpu_load:kW,120..800": "PDU"}``
            (``exogenous.columns``).

    Returns:
        Utilisation, whole years of 365 days.

    Raises:
        DataError: names file, row, column, value and what would be valid.
    """
    path = Path(path)
    if minutes is not None and not (np.isfinite(minutes) and minutes > 0.0):
        raise DataError(f"minutes: {minutes!r}, expected a positive number")
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path)
        if metadata is not None:
            return _read_imported(path, metadata)
    named = column_map(columns)
    frame, first_row = files.read_table(path, named.names)
    files.require_columns(path, frame, ("cpu_load",))
    rows = first_row + np.arange(len(frame))
    unit = named.unit("cpu_load")
    hint = "" if unit.symbol else _PERCENT_HINT
    values = files.numbers(path, frame["cpu_load"], "cpu_load", rows, 0.0, 1.0, hint, unit)
    blank = int(np.isnan(values).sum())
    minutes, positions, first_stamp, notes = _clock(path, frame, rows, minutes)
    notes += named.notes()
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
    if first_stamp is not None:
        values, since, leap_notes = files.without_leap_days(values, first_stamp, minutes)
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


def _clock(
    path: Path, frame: pd.DataFrame, rows: Rows, minutes: float | None
) -> tuple[float, Rows, np.datetime64 | None, list[str]]:
    """Where the rows lie in time, by the first column if it holds stamps or a running index.

    Args:
        path: file, for messages.
        frame: the table, as text.
        rows: rows of the file, for messages, (T,).
        minutes: resolution that was asked for, in minutes, or None.

    Returns:
        Resolution in minutes, place of each row on a regular grid, (T,), first stamp (None without
        stamps), and notes.

    Raises:
        DataError: stamps of another resolution, or a gap of over 24 h.
    """
    first = str(frame.columns[0])
    blank_header = first.strip() in files.BLANK_HEADERS
    positions, first_stamp = np.arange(len(frame)), None
    notes = []
    if blank_header or first.strip().lower() in _INDEX_HEADERS:
        text = frame[first].str.strip()
        if _is_number(text.iloc[0]):
            positions = _running_index(path, text, first, rows)
        else:
            stamps = _stamps(path, text, first, rows)
            file_minutes, positions = files.grid_of_stamps(path, stamps, rows, first)
            if minutes is not None and file_minutes != minutes:
                raise DataError(
                    f"{path}: column {first}: steps of {file_minutes:g} min, not {minutes:g}"
                )
            minutes, first_stamp = file_minutes, stamps[0]
        if blank_header:
            kind = "index" if first_stamp is None else "timestamp"
            notes.append(f"blank first header read as {kind}")
    minutes = 60.0 if minutes is None else float(minutes)
    longest = np.diff(positions).max(initial=1)
    if (longest - 1) * minutes > files.MAX_GAP_H * 60.0:
        at = int(np.argmax(np.diff(positions))) + 1
        hours = (longest - 1) * minutes / 60.0
        raise files.fault(
            path, int(rows[at]), first, f"{hours:g} h without rows", "gaps of at most 24 h"
        )
    return minutes, positions, first_stamp, notes


def _is_number(text: str) -> bool:
    try:
        parse_number(text)
    except ValueError:
        return False
    return True


def _stamps(path: Path, text: pd.Series[str], column: str, rows: Rows) -> Stamps:
    """Stamps in local standard time, (T,); with a UTC offset it would be unclear whose they are."""
    import pandas as pd

    parsed = pd.to_datetime(text, errors="coerce", format="ISO8601", utc=True)
    bad = (parsed.isna() | text.str.contains(r"(?:[Zz]|UTC|:\d\d[+-]\d\d:?\d\d)$")).to_numpy()
    if bad.any():
        at = int(np.argmax(bad))
        valid = "local standard time such as 2022-01-01 00:00:00, without a UTC offset"
        raise files.fault(path, int(rows[at]), column, text.iloc[at], valid)
    return np.asarray(parsed.dt.tz_localize(None).to_numpy(), dtype="datetime64[s]")


def _running_index(path: Path, text: pd.Series[str], column: str, rows: Rows) -> Rows:
    """Places on the regular grid, from 0, of a running index of whole numbers, (T,)."""
    index = files.numbers(path, text, column, rows, 0.0, 1e9)
    steps = np.diff(index, prepend=index[0] - 1.0)
    bad = ~((index == np.round(index)) & (steps >= 1.0))
    if bad.any():
        at = int(np.argmax(bad))
        valid = "whole numbers that increase from row to row"
        raise files.fault(path, int(rows[at]), column, text.iloc[at], valid)
    return np.asarray(index - index[0], dtype=np.int64)


def _read_imported(path: Path, metadata: dict[str, object]) -> Series:
    kind = series_file.metadata_value(path, metadata, "kind", str)
    if kind != "workload":
        raise DataError(f"{path}: metadata kind: {shortened(kind)}, expected 'workload'")
    minutes = series_file.metadata_value(path, metadata, "minutes", float)
    columns = series_file.read_columns(path, {"utilisation": (0.0, 1.0)}, minutes)
    return series_file.imported_series(path, metadata, "utilisation", "1", columns, minutes)
