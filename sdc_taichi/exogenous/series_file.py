"""Parquet format of imported data: series of one kind, with their provenance.

Each column is a series, and each row an interval of the simulator's clock. The schema metadata
contains JSON with format, kind, name, resolution, source and notes. `data import` writes it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import DataError, SdcError, shortened
from sdc_taichi.exogenous.files import check_length, fault, read_arrow, read_schema, rows_per_year
from sdc_taichi.exogenous.series import FloatArray, Series
from sdc_taichi.exogenous.year_clock import YEARS

if TYPE_CHECKING:
    import pyarrow as pa

METADATA_KEY = b"sdc_taichi"
"""Key in the metadata of the Parquet schema under which the JSON is stored."""
FORMAT = "sdc-series/1"
"""Name and version of the format."""


def write_parquet(
    path: Path, columns: Mapping[str, FloatArray], metadata: Mapping[str, Any]
) -> None:
    """Write columns with metadata atomically: readers see the old file or the complete new one.

    Raises:
        DataError: the file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table(dict(columns)).replace_schema_metadata(
        {METADATA_KEY: json.dumps({"format": FORMAT, **metadata}).encode()}
    )
    try:
        with atomic_write(path, parents=True) as file:
            pq.write_table(table, file)
    except SdcError as error:
        raise DataError(str(error)) from None


def read_metadata(path: Path) -> dict[str, Any] | None:
    """Return the metadata of a file that `data import` wrote; None for other Parquet files.

    Raises:
        DataError: the metadata are not readable, or have another version.
    """
    raw = (read_schema(path).metadata or {}).get(METADATA_KEY)
    if raw is None:
        return None
    try:
        metadata: dict[str, Any] = json.loads(raw)
    except (RecursionError, ValueError):
        raise DataError(f"{path}: metadata sdc_taichi: not JSON") from None
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        version = metadata.get("format") if isinstance(metadata, dict) else metadata
        raise DataError(f"{path}: metadata format: {shortened(version)}, expected {FORMAT!r}")
    return metadata


def metadata_value(path: Path, metadata: Mapping[str, Any], key: str, kind: type) -> Any:
    """Return one metadata value, checked for the expected type.

    Raises:
        DataError: the value is missing or has another type.
    """
    value = metadata.get(key)
    good = isinstance(value, int | float) if kind is float else isinstance(value, kind)
    if not good or isinstance(value, bool) or (kind is float and not math.isfinite(value or 0)):
        raise DataError(f"{path}: metadata {key}: {shortened(value)}, expected {kind.__name__}")
    return kind(value)


class Quantity(NamedTuple):
    """Unit and valid range of a quantity in a file."""

    unit: str
    """Unit of the values."""
    low: float
    """Smallest valid value."""
    high: float
    """Largest valid value."""


def read_series(
    path: Path, metadata: Mapping[str, Any], kind: str, quantities: Mapping[str, Quantity]
) -> dict[str, Series]:
    """Read series from a Parquet file that `data import` wrote, and check them like other input.

    Args:
        path: the file.
        metadata: metadata of the file.
        kind: expected kind of data: ``weather``, ``carbon`` or ``workload``.
        quantities: quantities to read, by the names of their columns.

    Raises:
        DataError: the data are of another kind, or a column is missing, not numeric, not finite,
            outside its limits, or shorter than a year.
    """
    if (stored := metadata_value(path, metadata, "kind", str)) != kind:
        raise DataError(f"{path}: metadata kind: {shortened(stored)}, expected {kind!r}")
    minutes = metadata_value(path, metadata, "minutes", float)
    source = metadata_value(path, metadata, "source_file", str)
    digest = metadata_value(path, metadata, "sha256", str)
    notes = tuple(str(note) for note in metadata_value(path, metadata, "notes", list))
    if metadata.get("origin") is not None:
        origin = metadata_value(path, metadata, "origin", dict)
        source = f"{origin.get('service')}: {source}"
    source = f"{source} (sha256 {digest[:12]})"
    year = None
    if metadata.get("year") is not None:
        year = metadata_value(path, metadata, "year", int)
        if not YEARS[0] <= year <= YEARS[1]:
            valid = f"{YEARS[0]} to {YEARS[1]}"
            raise DataError(f"{path}: metadata year: {year}, expected {valid}")
    table = read_arrow(path)
    series = {}
    for name, quantity in quantities.items():
        values = _column(path, table, name, quantity)
        check_length(path, values.size, minutes)
        if values.size % rows_per_year(path, minutes):
            raise DataError(f"{path}: {values.size} rows, expected whole years of 365 days")
        series[name] = Series(
            values, minutes, name, quantity.unit, source, synthetic=False, notes=notes, year=year
        )
    return series


def _column(path: Path, table: pa.Table, name: str, quantity: Quantity) -> FloatArray:
    """Return the values of a column, checked against the limits of its quantity."""
    if name not in table.column_names:
        raise DataError(f"{path}: missing column {name}; found {', '.join(table.column_names)}")
    try:
        values = np.asarray(table[name].to_numpy(), dtype=np.float64)
    except (TypeError, ValueError):
        kind = table.schema.field(name).type
        raise DataError(f"{path}: column {name}: type {kind}, expected numbers") from None
    valid = (values >= quantity.low) & (values <= quantity.high)
    if not valid.all():
        at = int(np.argmin(valid))
        limits = f"a number from {quantity.low:g} to {quantity.high:g}"
        raise fault(path, at + 1, name, float(values[at]), limits)
    return values


def column_names(path: Path) -> list[str]:
    """Return the column names of a Parquet file.

    Raises:
        DataError: the file is not readable.
    """
    return [str(name) for name in read_schema(path).names]
