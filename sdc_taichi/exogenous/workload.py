"""Reader of workload traces: requested share of the capacity in each interval."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import files, series_file
from sdc_taichi.exogenous.columns import column_map
from sdc_taichi.exogenous.series import Series
from sdc_taichi.exogenous.series_file import Quantity
from sdc_taichi.number_text import parse_number

_INDEX_HEADERS = frozenset({"index", "hour", "step", "time", "timestamp", "datetime"})
_PERCENT_HINT = " (percentages are read with --map cpu_load:%=COLUMN)"


def read_workload(
    path: str | Path,
    *,
    minutes: float | None = None,
    columns: Mapping[str, str] = MappingProxyType({}),
) -> Series:
    """Read a workload trace.

    The table has ``cpu_load`` in [0, 1]. An optional first column has a running index, or stamps in
    local standard time without UTC offset. Rows without stamps begin on 1 January at 00:00 and are
    hourly unless ``minutes`` is given. A Parquet file written by ``data import`` is used unchanged.

    Args:
        path: CSV or Parquet file.
        minutes: resolution of a file without stamps, in minutes; None means hourly.
        columns: column names in the table, by ``cpu_load`` (with the unit if it differs) and
            ``timestamp``, such as ``{"cpu_load:kW,120..800": "PDU"}`` (``exogenous.columns``).

    Returns:
        Utilisation, for whole years of 365 days.

    Raises:
        DataError: the data are not valid; the message names file, row, column, value, valid values.
    """
    path = Path(path)
    if minutes is not None and not (np.isfinite(minutes) and minutes > 0.0):
        raise DataError(f"minutes: {minutes!r}, expected a positive number")
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path)
        if metadata is not None:
            return _read_imported(path, metadata)
    named = column_map(columns)
    table = files.read_table(path, named.names)
    table.require_columns("cpu_load")
    unit = named.unit("cpu_load")
    values = table.numbers("cpu_load", 0.0, 1.0, "" if unit.symbol else _PERCENT_HINT, unit)
    blank = int(np.isnan(values).sum())
    minutes, positions, first_stamp, notes = _clock(table, minutes)
    grid, rows, absent_notes = table.spread(values[:, None], positions)
    notes += named.notes() + absent_notes
    if blank:
        notes.append(f"{blank} rows without values interpolated")
    values = files.fill_gaps(path, grid, minutes, ["cpu_load"], rows)[:, 0]
    if values.size % 168 == 0 and np.array_equal(values[168:], values[:-168]):
        notes.append(f"warning: the same 168 rows repeat {values.size // 168} times")
    year = None
    if first_stamp is None:
        values, year_notes = files.whole_years(path, values, 0.0, minutes)
    else:
        values, year, year_notes = files.calendar_years(path, values, first_stamp, minutes)
    notes += year_notes
    return Series(
        values,
        minutes,
        "utilisation",
        "1",
        path.name,
        synthetic=False,
        notes=tuple(notes),
        year=year,
    )


def _clock(
    table: files.Table, minutes: float | None
) -> tuple[float, NDArray[np.int64], np.datetime64 | None, list[str]]:
    """Determine the times of the rows from stamps or a running index in the first column.

    Args:
        table: the table.
        minutes: requested resolution in minutes, or None.

    Returns:
        Resolution in minutes, position of each row on a regular grid, (T,), first stamp (None
        without stamps), and notes.

    Raises:
        DataError: stamps have another resolution, or there is a gap of more than 24 h.
    """
    first = str(table.frame.columns[0])
    blank_header = first.strip() in files.BLANK_HEADERS
    positions, first_stamp = np.arange(len(table.frame)), None
    notes = []
    if blank_header or first.strip().lower() in _INDEX_HEADERS:
        if _is_number(table.frame[first].iloc[0]):
            positions = _running_index(table, first)
        else:
            stamps, has_offset = table.stamps(first)
            valid = "local standard time such as 2022-01-01 00:00:00, without a UTC offset"
            table.refuse(first, np.isnat(stamps) | has_offset, valid)
            file_minutes, positions = files.grid_of_stamps(table, stamps, first)
            if minutes is not None and file_minutes != minutes:
                raise DataError(
                    f"{table.path}: column {first}: steps of {file_minutes:g} min, not {minutes:g}"
                )
            minutes, first_stamp = file_minutes, stamps[0]
        if blank_header:
            kind = "index" if first_stamp is None else "timestamp"
            notes.append(f"blank first header read as {kind}")
    minutes = 60.0 if minutes is None else float(minutes)
    gaps_h = (np.diff(positions, prepend=-1) - 1) * minutes / 60.0
    if gaps_h.max() > files.MAX_GAP_H:
        value = f"{gaps_h.max():g} h without rows"
        wrong = gaps_h == gaps_h.max()
        table.refuse(first, wrong, f"gaps of at most {files.MAX_GAP_H:g} h", value)
    return minutes, positions, first_stamp, notes


def _is_number(text: str) -> bool:
    try:
        parse_number(text)
    except ValueError:
        return False
    return True


def _running_index(table: files.Table, column: str) -> NDArray[np.int64]:
    """Return grid positions from 0, (T,), from a running index of whole numbers."""
    index = table.numbers(column, 0.0, 1e9)
    steps = np.diff(index, prepend=index[0] - 1.0)
    wrong = ~((index == np.round(index)) & (steps >= 1.0))
    table.refuse(column, wrong, "whole numbers that increase from row to row")
    return np.asarray(index - index[0], dtype=np.int64)


def _read_imported(path: Path, metadata: dict[str, object]) -> Series:
    quantities = {"utilisation": Quantity("1", 0.0, 1.0)}
    return series_file.read_series(path, metadata, "workload", quantities)["utilisation"]
