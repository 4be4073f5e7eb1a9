"""Reader of stored table rows, which may come from anyone: declared columns, types and ranges.

The size of a table is checked before its values are read. A Parquet file of a few kilobytes can
contain billions of equal values, and a short reference to a long text in each row.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.learning.evaluation import ALL, METRICS, MOVES
from sdc_taichi.learning.split import WEEKS
from sdc_taichi.optimum.problem import ALL_AGENTS
from sdc_taichi.optimum.uncoordinated import WAYS
from sdc_taichi.sim.physical_limits import AIR_LIMITS_C
from sdc_taichi.user_file import decoding, open_parquet, read_parquet

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

MOST_ROWS = 200_000
"""Maximum number of rows of a table: twice the largest batch of a sweep."""
MOST_COLUMNS = 1_000
"""Maximum number of columns of a table."""
MOST_TABLE_BYTES = 256_000_000
"""Maximum size of a table in memory, in bytes."""
MOST_CHARACTERS = 10_000
"""Maximum length of a text, in characters; the same as that of names in configurations."""
_LARGEST = 1e15
"""Largest number, which is far above that of any data center, in any unit and currency."""
_ROUND_OFF = 1e-3
"""Amount by which a sum of energies that cannot be negative may be below 0 due to rounding."""
_INFLATING = "DELTA_BYTE_ARRAY"
"""Encoding of texts that stores only the difference to the preceding text, so that the size in
memory is unknown before reading."""


@dataclass(frozen=True, slots=True)
class Column:
    """Valid values of a column of a result table."""

    kind: str = "finite number"
    """Type of the values: ``finite number``, ``whole number``, ``text``, or ``value`` for any of
    these and for booleans."""
    low: float = 0.0
    """Smallest valid number."""
    high: float = _LARGEST
    """Largest valid number."""
    texts: tuple[str, ...] = ()
    """Valid texts; an empty tuple allows any text of up to ``MOST_CHARACTERS``."""
    may_lack: bool = False
    """True if values may be missing (null or nan)."""

    @property
    def valid(self) -> str:
        """Description of the valid values, for messages."""
        if self.texts:
            text = f"one of {', '.join(self.texts)}"
        elif self.kind == "text":
            text = f"a text of at most {MOST_CHARACTERS:,} characters"
        elif self.kind == "value":
            text = f"a finite number, a text of at most {MOST_CHARACTERS:,} characters or a boolean"
        else:
            text = f"a {self.kind} {self.low:g}..{self.high:g}"
        return f"{text}, or none" if self.may_lack else text


METRIC_COLUMNS: Mapping[str, Column] = {
    **dict.fromkeys(METRICS, Column(may_lack=True)),
    "hottest_inlet_c": Column(low=AIR_LIMITS_C[0], high=AIR_LIMITS_C[1], may_lack=True),
}
"""Columns of the metrics of a run that the tables of suites contain."""
PLACE = ("site", "year", "week")
"""Columns that identify a data-center week."""
SUITE_COLUMNS: Mapping[str, Column] = {
    "moves": Column("text", texts=(ALL, *dict.fromkeys((*MOVES, *ALL_AGENTS)), *WAYS)),
    "site": Column("text"),
    "year": Column("whole number"),
    "week": Column("whole number", high=WEEKS - 1),
    "figure": Column(),
    "valued_figure": Column(may_lack=True),
    "idle_figure": Column(),
    "achieved_figure": Column(may_lack=True),
    "share": Column(low=-_LARGEST, may_lack=True),
    "broken": Column("text", may_lack=True),
    **METRIC_COLUMNS,
}
"""Columns of the table rows of a suite, all of which must exist; see ``Evaluation.rows``."""
ANY = Column("value", low=-1e20, high=1e20, may_lack=True)
"""Any finite number, text or boolean."""
NUMBER = Column(low=-1e20, high=1e20, may_lack=True)
"""Any finite number."""


def read_rows(content: bytes, path: Path, columns: Mapping[str, Column]) -> pd.DataFrame:
    """Read the declared columns of a table; other columns are ignored.

    Args:
        content: content of a Parquet file.
        path: path of the file, for messages.
        columns: the columns, each of which must exist.

    Raises:
        SdcError: the content is not a Parquet file, the table is empty or too large, a column is
            missing or exists twice, or a value is not valid; the message names file and column.
    """
    import pandas as pd

    with decoding(path, "a Parquet file"):
        opened = open_parquet(io.BytesIO(content))
    _check_names(opened, path, columns)
    _check_size(opened, path, columns)
    types = {name: opened.schema_arrow.field(name).type for name in columns}
    for name, column in columns.items():
        _check_type(types[name], path, name, column)
    texts = [name for name in columns if _is_text(types[name])]
    with decoding(path, "a Parquet file"):
        # Texts stay references to distinct texts, because equal texts may be long and many.
        opened = open_parquet(io.BytesIO(content), read_dictionary=texts)
        table = read_parquet(opened, list(columns)).select(list(columns))
        table.validate(full=True)
    values = {}
    for name, column in columns.items():
        with decoding(path, f"column {name}"):
            values[name] = _values(table.column(name), path, name, column)
    return pd.DataFrame(values)


def read_suite_rows(content: bytes, path: Path) -> pd.DataFrame:
    """Read the table rows of a suite's result: the same weeks of all agents and of single ones.

    Args:
        content: content of a Parquet file.
        path: path of the file, for messages.

    Raises:
        SdcError: as in ``read_rows``; or a week is missing or exists twice, or some metrics are
            missing.
    """
    frame = read_rows(content, path, SUITE_COLUMNS)
    weeks = {
        str(moves): list(zip(*(rows[name] for name in PLACE), strict=True))
        for moves, rows in frame.groupby("moves", sort=False)
    }
    expected = list(itertools.product(*(frame[name].unique() for name in PLACE)))
    for moves in {ALL: None, **weeks}:
        if weeks.get(moves) != expected:
            count = len(weeks.get(moves, []))
            raise ConfigError(
                f"{path}: columns {', '.join(PLACE)}, {count} rows of moves {moves}; valid are "
                f"{len(expected)}, each week of each year of each site once, in this order"
            )
    missing = frame[[*METRICS]].isna()
    # Runs have all metrics, and bounds of the optimum have none.
    for name in METRICS:
        for moves in weeks:
            is_moved = frame["moves"] == moves
            if missing.loc[is_moved, name].any() and not missing[is_moved].all(axis=None):
                raise ConfigError(
                    f"{path}: column {name}; valid is a finite number in each row of moves "
                    f"{moves}, or none in all columns of metrics"
                )
    return frame


def read_any_rows(
    content: bytes,
    path: Path,
    names: Iterable[str] | None = None,
    declared: Mapping[str, Column] = MappingProxyType({}),
    other: Column = ANY,
) -> pd.DataFrame:
    """Read columns of a table of any kind, such as that of a sweep.

    Args:
        content: content of a Parquet file.
        path: path of the file, for messages.
        names: names of the columns to read; columns that do not exist are ignored. None selects all
            columns.
        declared: valid values of some columns. Those of metrics of suites are declared already.
        other: valid values of all other columns.

    Raises:
        SdcError: as in ``read_rows``.
    """
    known = {**declared, **METRIC_COLUMNS}

    with decoding(path, "a Parquet file"):
        existing = open_parquet(io.BytesIO(content)).schema_arrow.names
    chosen = existing if names is None else [name for name in names if name in existing]
    return read_rows(content, path, {x: known.get(x, other) for x in chosen})


def _check_names(opened: pq.ParquetFile, path: Path, columns: Mapping[str, Column]) -> None:
    """Check that each declared column exists exactly once.

    Raises:
        ConfigError: a column is missing or exists twice, or there are too many columns.
    """
    existing = list(opened.schema_arrow.names)
    if len(existing) > MOST_COLUMNS:
        raise ConfigError(f"{path}: {len(existing):,} columns; valid are at most {MOST_COLUMNS:,}")
    for name in columns:
        if name not in existing:
            raise ConfigError(f"{path}: no column {name}; valid is {columns[name].valid}")
        if existing.count(name) > 1:
            raise ConfigError(f"{path}: column {name} exists twice; valid is once")


def _check_size(opened: pq.ParquetFile, path: Path, columns: Mapping[str, Column]) -> None:
    """Check numbers of rows and bytes before any value is read.

    Raises:
        ConfigError: the table is empty or too large, or the numbers contradict each other.
    """
    metadata = opened.metadata
    with decoding(path, "a Parquet file"):
        groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
        rows = sum(group.num_rows for group in groups)
        chunks = [
            (group, chunk)
            for group in groups
            for chunk in (group.column(i) for i in range(group.num_columns))
            if chunk.path_in_schema in columns
        ]
    if not rows or rows != metadata.num_rows or min(group.num_rows for group in groups) < 0:
        raise ConfigError(f"{path}: {rows:,} rows; valid is one or more, as its end says")
    if rows > MOST_ROWS:
        raise ConfigError(f"{path}: {rows:,} rows; valid are at most {MOST_ROWS:,}")
    in_memory = 8 * rows * len(columns) + sum(chunk.total_uncompressed_size for _, chunk in chunks)
    if in_memory > MOST_TABLE_BYTES:
        raise ConfigError(
            f"{path}: needs {in_memory / 1e6:,.0f} MB; valid are at most "
            f"{MOST_TABLE_BYTES / 1e6:,.0f} MB"
        )
    for group, chunk in chunks:
        name = chunk.path_in_schema
        if chunk.num_values != group.num_rows:
            raise ConfigError(
                f"{path}: column {name}: {chunk.num_values:,} values in {group.num_rows:,} rows; "
                "valid is one in each row"
            )
        if _INFLATING in chunk.encodings and chunk.physical_type == "BYTE_ARRAY":
            raise ConfigError(
                f"{path}: column {name}: texts in encoding {_INFLATING}; valid is a dictionary or "
                "plain text"
            )


def _is_text(of_type: pa.DataType) -> bool:
    """Return True for the types of texts, including references to distinct texts."""
    import pyarrow as pa

    of_value = of_type.value_type if pa.types.is_dictionary(of_type) else of_type
    return bool(pa.types.is_string(of_value) or pa.types.is_large_string(of_value))


def _check_type(of_type: pa.DataType, path: Path, name: str, column: Column) -> None:
    """Check that the type of a column can have valid values.

    Raises:
        ConfigError: the type is another one.
    """
    import pyarrow as pa

    is_whole = pa.types.is_integer(of_type)
    fits = {
        "text": _is_text(of_type),
        "whole number": is_whole,
        "finite number": is_whole or pa.types.is_floating(of_type),
    }
    is_valid = fits.get(column.kind, any(fits.values()) or pa.types.is_boolean(of_type))
    if not is_valid and not (column.may_lack and pa.types.is_null(of_type)):
        raise ConfigError(
            f"{path}: column {name} is of type {shortened(str(of_type))}; valid is {column.valid}"
        )


def _values(cells: pa.ChunkedArray, path: Path, name: str, column: Column) -> Any:
    """Return the values of a column as an array; missing values are nan or None.

    Raises:
        ConfigError: a value is not valid; the message names its row.
    """
    import pyarrow as pa

    if pa.types.is_null(cells.type) and column.kind != "text":
        return np.full(len(cells), np.nan)
    if pa.types.is_null(cells.type) or _is_text(cells.type):
        return _texts(cells, path, name, column)
    values = cells.to_numpy()
    # Missing booleans are None, which becomes nan.
    numbers = values.astype(np.float64)
    valid = (numbers >= column.low - _ROUND_OFF) & (numbers <= column.high)
    if column.may_lack:
        valid |= np.isnan(numbers)
    _require_valid(valid, cells, path, name, column)
    return (
        values
        if column.kind == "value"
        else values.astype(np.int64 if column.kind == "whole number" else np.float64)
    )


def _texts(cells: pa.ChunkedArray, path: Path, name: str, column: Column) -> Any:
    """Return texts as an array of objects, in which equal texts are the same object.

    Raises:
        ConfigError: a text is not valid; the message names its row.
    """
    import pyarrow as pa

    if not pa.types.is_dictionary(cells.type):
        cells = cells.cast(pa.string()).dictionary_encode()
    parts, valid_parts = [], []
    for chunk in cells.chunks:
        # The last entry stands for a missing text.
        distinct = np.array([*chunk.dictionary.to_pylist(), None], dtype=object)
        valid = np.array([_is_valid_text(text, column) for text in distinct])
        codes = chunk.indices.fill_null(len(distinct) - 1).to_numpy(zero_copy_only=False)
        parts.append(distinct[codes])
        valid_parts.append(valid[codes])
    values = np.concatenate(parts)
    _require_valid(np.concatenate(valid_parts), values, path, name, column)
    return values


def _is_valid_text(text: str | None, column: Column) -> bool:
    """Return True if a column may contain a text; None stands for a missing text."""
    if text is None:
        return column.may_lack
    return text in column.texts if column.texts else len(text) <= MOST_CHARACTERS


def _require_valid(valid: Any, cells: Any, path: Path, name: str, column: Column) -> None:
    """Raise ``ConfigError`` with row and value of the first cell that is not valid."""
    if valid.all():
        return
    row = int(np.argmin(valid))
    cell = cells[row]
    value = cell if cell is None or isinstance(cell, str) else cell.as_py()
    missing = value is None or (isinstance(value, float) and math.isnan(value))
    text = "is missing" if missing else f"is {shortened(value)}"
    raise ConfigError(f"{path}: column {name}, row {row + 1}: {text}; valid is {column.valid}")
