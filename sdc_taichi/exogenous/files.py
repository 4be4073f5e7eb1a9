"""Text tables: numbers, time stamps, errors with row numbers, gaps, and cutting to whole years.

Row numbers are line numbers of the file from 1, headers included, as an editor shows them. (Rows of
a Parquet file count from 1 without headers.)
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous.columns import COLUMN_NAMES, Unit
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.stamps import HAS_OFFSET
from sdc_taichi.exogenous.year_clock import (
    MINUTES_PER_DAY,
    MINUTES_PER_YEAR,
    is_leap_day,
    minutes_into_year,
)
from sdc_taichi.user_file import (
    MOST_TABLE_BYTES,
    decoding,
    open_input,
    open_parquet,
    read_parquet,
)

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

MOST_ROWS = 20_000_000
"""Largest number of rows of a Parquet file, 38 years of minutes; compression can hide the size."""
MAX_GAP_H = 24.0
"""Longest gap that is interpolated, in h."""
BLANK_HEADERS = frozenset({"", "Unnamed: 0"})
"""Column names that count as blank; pandas names a blank first column ``Unnamed: 0``."""
MISSING_TEXT = frozenset({"", "nan", "na", "n/a", "null", "none"})
"""Texts, in lower case, that represent a missing number."""
NO_UNIT = Unit("")
"""Placeholder for the unit that the reader expects."""
_HEADER_BYTES = 1 << 16
"""Largest size of the header of a CSV file, in bytes."""
_FIRST_BYTES = 4096


def fault(path: Path | str, row: int, column: str, value: object, valid: str) -> DataError:
    """Return an error that names file, row, column, value, and valid values."""
    return DataError(f"{path}: row {row}, column {column}: {shortened(value)}, expected {valid}")


def sha256(path: Path) -> str:
    """Return the SHA-256 hash of a file's bytes, hexadecimal.

    Raises:
        DataError: the file cannot be read.
    """
    with open_input(path, error=DataError) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_parquet(path: Path) -> bool:
    """Return True if a file is Parquet, by its name or its first bytes.

    Raises:
        DataError: the file cannot be read.
    """
    with open_input(path, MOST_TABLE_BYTES, DataError) as file:
        return path.suffix.lower() in {".parquet", ".pq"} or file.read(4) == b"PAR1"


class Table(NamedTuple):
    """A table of text with the row numbers of its file."""

    path: Path | str
    """File or address of the table, for messages."""
    frame: pd.DataFrame
    """Cells of the table; its index contains the row numbers."""

    def refuse(self, column: str, wrong: Any, valid: str, value: object = None) -> None:
        """Raise an error that names the first invalid row, if there is one.

        Args:
            column: name of the column.
            wrong: True for each invalid row, (T,).
            valid: description of valid values, for the message.
            value: value for the message; None stands for the text of the cell.

        Raises:
            DataError: at least one row is invalid.
        """
        wrong = np.asarray(wrong, dtype=bool)
        if wrong.any():
            at = int(np.argmax(wrong))
            value = self.frame[column].iloc[at] if value is None else value
            raise fault(self.path, int(self.frame.index[at]), column, value, valid)

    def require_columns(self, *columns: str) -> None:
        """Check that the table has all of these columns.

        Raises:
            DataError: columns are missing; the message lists missing and present ones.
        """
        names = self.frame.columns
        missing = [column for column in columns if column not in names]
        if missing:
            present = ", ".join(
                "(blank)" if str(name) in BLANK_HEADERS else str(name)[:48] for name in names[:12]
            )
            raise DataError(
                f"{self.path}: row 1: missing column {', '.join(missing)}; found {present}; "
                f"expected {', '.join(columns)}{mapping_hint(names)}"
            )

    def numbers(
        self, column: str, low: float, high: float, hint: str = "", unit: Unit = NO_UNIT
    ) -> FloatArray:
        """Return a column as numbers; blanks and NaN markers become NaN.

        Args:
            column: name of the column.
            low: smallest valid value.
            high: largest valid value.
            hint: text appended to the valid range in the message.
            unit: unit of the cells.

        Returns:
            Numbers in the unit of ``low`` and ``high``, (T,).

        Raises:
            DataError: a cell is not a number, or its value is outside [low, high].
        """
        import pandas as pd

        text = self.frame[column].str.strip()
        values = unit.convert(np.array(pd.to_numeric(text, errors="coerce"), dtype=np.float64))
        missing = text.str.lower().isin(MISSING_TEXT).to_numpy(dtype=bool)
        ends = f"{unit.invert(low):g} to {unit.invert(high):g} {unit.symbol}".rstrip()
        wrong = ~missing & ~((values >= low) & (values <= high))
        self.refuse(column, wrong, f"a number from {ends}{hint}")
        values[missing] = np.nan
        return values

    def stamps(
        self, column: str, time_format: str = "ISO8601"
    ) -> tuple[NDArray[np.datetime64], NDArray[np.bool_]]:
        """Return the time stamps of a column, and which of them have a UTC offset.

        Args:
            column: name of the column.
            time_format: format of the stamps, in the syntax of ``strptime``.

        Returns:
            Times, (T,), in UTC if they have an offset, else unchanged; NaT for a cell that is not a
            time. Second, True for each stamp with an offset, (T,).
        """
        import pandas as pd

        text = self.frame[column].str.strip()
        times = pd.to_datetime(text, utc=True, errors="coerce", format=time_format)
        has_offset = text.str.contains(HAS_OFFSET, regex=True).to_numpy(dtype=bool)
        return times.dt.tz_localize(None).to_numpy().astype("datetime64[s]"), has_offset

    def spread(
        self, values: FloatArray, positions: NDArray[np.int64]
    ) -> tuple[FloatArray, NDArray[np.int64], list[str]]:
        """Place the values of the rows on a regular grid.

        Args:
            values: values of the rows, (T, ...).
            positions: grid positions of the rows, increasing from 0, (T,).

        Returns:
            Grid values, NaN at positions without a row, (N, ...); the file's row number at or after
            each position, (N,); and notes.
        """
        grid = np.full((int(positions[-1]) + 1, *values.shape[1:]), np.nan)
        grid[positions] = values
        at = np.searchsorted(positions, np.arange(len(grid)))
        absent = len(grid) - len(self.frame)
        notes = [f"{absent} absent rows interpolated"] if absent else []
        return grid, self.frame.index.to_numpy()[at], notes


# Reading


def read_table(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> Table:
    """Read a CSV file as text, or a Parquet file that `data import` did not write.

    Args:
        path: the file.
        columns: column names in the file, by their new names.

    Raises:
        DataError: the file is no readable table, has no rows, lacks one of ``columns``, or has
            several columns of a name that may be read. With ``columns`` these are the named ones
            and ``COLUMN_NAMES``, otherwise all.
    """
    import pandas as pd

    may_be_read = {*columns.values(), *COLUMN_NAMES} if columns else None
    if is_parquet(path):
        arrow = read_arrow(path)
        _refuse_repeated(path, arrow.column_names, may_be_read)
        frame = arrow.to_pandas()
        if not isinstance(frame.index, pd.RangeIndex):
            frame = frame.reset_index()
        first_row = 1
        frame = frame.astype(object).where(frame.notna(), "").astype(str)
    else:
        header, frame = _read_csv(path)
        _refuse_repeated(path, header, may_be_read)
        first_row = 2
    while len(frame) and not "".join(str(x) for x in frame.iloc[-1]).strip():
        frame = frame.iloc[:-1]
    if frame.empty:
        raise DataError(f"{path}: no rows of data")
    frame.index = pd.RangeIndex(first_row, first_row + len(frame))
    table = Table(path, frame)
    if not columns:
        return table
    table.require_columns(*columns.values())
    clashes = [name for name, column in columns.items() if name in frame.columns and name != column]
    if clashes or len(set(columns.values())) < len(columns):
        raise DataError(
            f"{path}: columns {dict(columns)}: expected each column once, and no name that "
            f"another column of the file has"
        )
    frame = frame.rename(columns={column: name for name, column in columns.items()})
    # Put time stamps first, where the workload reader expects them.
    return Table(path, frame[sorted(frame.columns, key=lambda name: name != "timestamp")])


def _refuse_repeated(path: Path, header: Sequence[str], may_be_read: Set[str] | None) -> None:
    for at, name in enumerate(header):
        other = header.index(name)
        is_read = name.strip() not in BLANK_HEADERS and (may_be_read is None or name in may_be_read)
        if other < at and is_read:
            raise DataError(
                f"{path}: row 1: columns {other + 1} and {at + 1} are both named "
                f"{shortened(name)}, expected each name once"
            )


def _read_csv(path: Path) -> tuple[list[str], pd.DataFrame]:
    """Read the header of a CSV file, and all of its columns as text."""
    import pandas as pd

    with (
        open_input(path, MOST_TABLE_BYTES, DataError) as file,
        decoding(path, "a CSV table", DataError),
        warnings.catch_warnings(),
    ):
        if b"\0" in file.read(_FIRST_BYTES):
            raise DataError(f"{path}: holds zero bytes, expected UTF-8 text")
        file.seek(0)
        # Rows with a wrong number of cells cause an error later, about the missing values.
        warnings.simplefilter("ignore", pd.errors.ParserWarning)
        options: dict[str, Any] = {
            "dtype": str,
            "keep_default_na": False,
            "skip_blank_lines": False,
            "encoding": "utf-8-sig",
            "index_col": False,
            "on_bad_lines": "error",
        }
        try:
            header = pd.read_csv(file, header=None, nrows=1, **options).iloc[0].tolist()
            file.seek(0)
            frame = pd.read_csv(file, **options)
        except pd.errors.EmptyDataError:
            raise DataError(f"{path}: empty, expected a header and rows") from None
        except UnicodeDecodeError as error:
            raise DataError(f"{path}: byte {error.start}: not UTF-8 text") from None
    return [str(name) for name in header], frame.fillna("")


def csv_header(path: Path) -> list[str]:
    """Return the names of the columns of a CSV file with any kind of line ends.

    Raises:
        DataError: the file cannot be read.
    """
    with (
        open_input(path, MOST_TABLE_BYTES, DataError) as file,
        decoding(path, "a CSV table", DataError),
    ):
        text = file.read(_HEADER_BYTES).decode("utf-8-sig", errors="replace")
        return next(csv.reader(io.StringIO(text, newline=None)), [])


def read_arrow(path: Path) -> pa.Table:
    """Read a Parquet file as an Arrow table.

    Raises:
        DataError: the file is not a readable Parquet file, or has too many rows.
    """
    with (
        open_input(path, MOST_TABLE_BYTES, DataError) as file,
        decoding(path, "a Parquet file", DataError),
    ):
        opened = open_parquet(file)
        rows = opened.metadata.num_rows
        if rows > MOST_ROWS:
            raise DataError(f"{path}: {rows:,} rows, expected at most {MOST_ROWS:,}")
        return read_parquet(opened)


def read_schema(path: Path) -> pa.Schema:
    """Read names, types and metadata of the columns of a Parquet file.

    Raises:
        DataError: the file is not a readable Parquet file.
    """
    with (
        open_input(path, MOST_TABLE_BYTES, DataError) as file,
        decoding(path, "a Parquet file", DataError),
    ):
        return open_parquet(file).schema_arrow


def mapping_hint(columns: Iterable[object]) -> str:
    """Return a hint, for messages, on how to import a table of Electricity Maps.

    The hint is empty for other tables.

    Args:
        columns: names of the columns of the file.
    """
    names = [str(name) for name in columns]
    intensities = [x for x in names if x.casefold().startswith("carbon intensity gco")]
    if "Datetime (UTC)" not in names or not intensities:
        return ""
    return " (a table of Electricity Maps: data import FILE --map electricity-maps)"


# Gaps and whole years


def fill_gaps(
    path: Path | str,
    values: FloatArray,
    minutes: float,
    columns: Sequence[str],
    rows: NDArray[np.int64],
) -> FloatArray:
    """Interpolate missing values (NaN) linearly; at the ends, repeat the nearest value.

    Args:
        path: file, for messages.
        values: values of each column, (T, columns).
        minutes: resolution, in minutes.
        columns: names of the columns, for messages.
        rows: row of the file that each value came from, for messages, (T,).

    Raises:
        DataError: a gap is longer than 24 h, or there is no value at all.
    """
    filled, index = values.copy(), np.arange(len(values))
    for column, of_column in zip(columns, filled.T, strict=True):
        missing = np.isnan(of_column)
        if not missing.any():
            continue
        edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(np.int8), [0]])))
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            hours = (end - start) * minutes / 60.0
            if hours > MAX_GAP_H:
                gap = f"{hours:g} h without a value"
                valid = f"gaps of at most {MAX_GAP_H:g} h"
                raise fault(path, int(rows[start]), column, gap, valid)
        of_column[missing] = np.interp(index[missing], index[~missing], of_column[~missing])
    return filled


def rows_per_year(path: Path | str, minutes: float) -> int:
    """Return the number of intervals in 365 days.

    Raises:
        DataError: the resolution is not positive or does not divide a day.
    """
    per_day = MINUTES_PER_DAY / minutes if minutes > 0.0 else 0.5
    if per_day < 1.0 - 1e-9 or abs(per_day - round(per_day)) > 1e-9:
        raise DataError(
            f"{path}: resolution {minutes:g} min, expected a positive one that divides a day"
        )
    return round(MINUTES_PER_YEAR / minutes)


def check_length(path: Path | str, n: int, minutes: float) -> None:
    """Reject files shorter than a year of 365 days (8,760 hourly rows).

    Raises:
        DataError: there are too few rows; the message names the required number.
    """
    least = rows_per_year(path, minutes)
    if n < least:
        raise DataError(
            f"{path}: row {n}: {n} rows of {minutes:g} min without 29 February, "
            f"expected at least {least} (365 days)"
        )


def whole_years(
    path: Path | str, values: FloatArray, since_minutes: float, minutes: float
) -> tuple[FloatArray, list[str]]:
    """Cut contiguous values to whole 365-day years and begin them on 1 January at 00:00.

    Values before the first 1 January move to the end. If the first value starts within an interval
    (a UTC offset with a half hour), values are averaged by overlap, which conserves the mean.

    Args:
        path: file, for messages.
        values: shape (T, ...), without 29 February.
        since_minutes: start of the first value, in minutes since 1 January 00:00 of a 365-day year.
        minutes: resolution, in minutes.

    Returns:
        Values, shape (years * rows per year, ...), and notes.

    Raises:
        DataError: the values cover fewer than 365 days.
    """
    notes = []
    check_length(path, len(values), minutes)
    per_year = rows_per_year(path, minutes)
    extra = len(values) % per_year
    if extra:
        values = values[:-extra]
        notes.append(f"truncated to {len(values) // per_year} x 365 days ({extra} rows cut)")
    before = (-since_minutes % MINUTES_PER_YEAR) / minutes
    first = math.ceil(before - 1e-9)
    values = np.roll(values, -first, axis=0)
    late = first - before
    if late > 1e-9:
        values = (1.0 - late) * values + late * np.roll(values, 1, axis=0)
        notes.append(f"averaged by overlap: rows start {late * minutes:g} min into the interval")
    if first > len(values) // 2:
        notes.append(f"{len(values) - first} rows after 31 December 24:00 moved to the start")
    elif first:
        notes.append(f"{first} rows before 1 January 00:00 moved to the end")
    return values, notes


def calendar_years(
    path: Path | str, values: FloatArray, start: np.datetime64, minutes: float
) -> tuple[FloatArray, int, list[str]]:
    """Cut contiguous calendar values to whole 365-day years, as ``whole_years`` does.

    Args:
        path: file, for messages.
        values: values of intervals one after another, (T, ...).
        start: local start of the first interval.
        minutes: resolution, in minutes.

    Returns:
        Values, shape (years * rows per year, ...); calendar year of most of the first 365 days; and
        notes.

    Raises:
        DataError: the values cover fewer than 365 days.
    """
    leap = leap_days(len(values), start, minutes)
    first = start + np.timedelta64(round(float(np.argmin(leap)) * minutes * 60), "s")
    since_minutes = 0.0 if leap.all() else minutes_into_year(first)
    values, notes = whole_years(path, values[~leap], since_minutes, minutes)
    year = first_calendar_year(first, since_minutes, len(values) * minutes)
    removed = [f"29 February removed ({int(leap.sum())} rows)"] * bool(leap.any())
    return values, year, removed + notes


def first_calendar_year(first: np.datetime64, since_minutes: float, length_minutes: float) -> int:
    """Return the calendar year of most of the first 365 days of values that ``whole_years`` cut.

    ``whole_years`` moves values before the first 1 January to the end. Several years then begin
    with the next calendar year; a single year consists of days of both.

    Args:
        first: local start of the first value.
        since_minutes: the same, in minutes since 1 January 00:00 of a 365-day year.
        length_minutes: length of the values that were cut to whole years, in minutes.
    """
    year = int(first.astype("datetime64[Y]").astype(np.int64)) + 1970
    latest = MINUTES_PER_YEAR / 2 if length_minutes < 1.5 * MINUTES_PER_YEAR else 0.0
    return year + int(since_minutes > latest)


def leap_days(count: int, start: np.datetime64, minutes: float) -> NDArray[np.bool_]:
    """Return True for each of ``count`` contiguous intervals that begins on 29 February, (count,).

    Args:
        count: number of intervals.
        start: local start of the first interval.
        minutes: resolution, in minutes.
    """
    seconds = np.timedelta64(round(minutes * 60), "s")
    return is_leap_day(start.astype("datetime64[s]") + seconds * np.arange(count))


def grid_of_stamps(
    table: Table, stamps: NDArray[np.datetime64], column: str
) -> tuple[float, NDArray[np.int64]]:
    """Return the resolution of increasing stamps, and their positions on the regular grid.

    Args:
        table: the table.
        stamps: time stamps of the rows, datetime64[s], (T,).
        column: name of the stamps' column, for messages.

    Returns:
        Resolution in minutes (the most frequent step), and grid positions from 0, (T,).

    Raises:
        DataError: stamps repeat, decrease, are not on the grid, or leave a gap of more than 24 h.
    """
    path, rows = table.path, table.frame.index
    if stamps.size < 2:
        raise DataError(f"{path}: row {rows[0]}: 1 row of data, expected 365 days")
    steps = np.diff(stamps).astype("timedelta64[s]").astype(np.int64)
    back = steps <= 0
    if back.any():
        at = int(np.argmax(back)) + 1
        what = "a stamp not seen before" if steps[at - 1] == 0 else "a stamp after the row above"
        raise fault(path, int(rows[at]), column, str(stamps[at]), what)
    sizes, counts = np.unique(steps, return_counts=True)
    step = int(sizes[np.argmax(counts)])
    off = (steps % step != 0) | (steps > MAX_GAP_H * 3600 + step)
    if off.any():
        at = int(np.argmax(off)) + 1
        hours = steps[at - 1] / 3600.0
        if steps[at - 1] % step:
            valid = f"steps of {step / 60:g} min as in most rows, not {hours:g} h"
        else:
            valid = f"gaps of at most {MAX_GAP_H:g} h, not {hours - step / 3600.0:g} h"
        raise fault(path, int(rows[at]), column, str(stamps[at]), valid)
    positions = np.concatenate([[0], np.cumsum(steps // step)]).astype(np.int64)
    return step / 60.0, positions
