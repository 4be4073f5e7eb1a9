"""Damaged weather, carbon and workload files: one line that names the file and the place."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import exogenous_builders as build
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import files, read_carbon, read_epw, read_workload

Lines = list[str]


def cell(row: int, column: int, value: str) -> Callable[[Lines], Lines]:
    return lambda lines: build.with_cell(lines, row, column, value)


def cut(first: int, last: int) -> Callable[[Lines], Lines]:
    return lambda lines: build.without_rows(lines, first, last)


def replace_row(row: int, text: str) -> Callable[[Lines], Lines]:
    return lambda lines: [*lines[: row - 1], text, *lines[row:]]


def repeat_row(row: int) -> Callable[[Lines], Lines]:
    return lambda lines: [*lines[:row], *lines[row - 1 :]]


def swap_rows(row: int) -> Callable[[Lines], Lines]:
    return lambda lines: [*lines[: row - 1], lines[row], lines[row - 1], *lines[row + 1 :]]


def every_cell(column: int, value: str, first: int, last: int) -> Callable[[Lines], Lines]:
    def change(lines: Lines) -> Lines:
        for row in range(first, last + 1):
            lines = build.with_cell(lines, row, column, value)
        return lines

    return change


def without_column(column: int) -> Callable[[Lines], Lines]:
    def change(lines: Lines) -> Lines:
        cells = [line.split(",") for line in lines]
        return [",".join(row[:column] + row[column + 1 :]) for row in cells]

    return change


def without_zone(lines: Lines) -> Lines:
    return [line.replace("+00:00", "") for line in lines]


def parquet(columns: dict[str, Any], metadata: dict[str, Any] | None) -> bytes:
    table = pa.table(columns)
    if metadata is not None:
        table = table.replace_schema_metadata({b"sdc_taichi": json.dumps(metadata).encode()})
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue().to_pybytes())


def with_value(n: int, value: float, at: int, bad: float) -> np.ndarray:
    values = np.full(n, value)
    values[at] = bad
    return values


PROVENANCE = {"format": "sdc-series/1", "source_file": "a", "sha256": "0", "notes": []}
CARBON_META = {
    **PROVENANCE,
    "kind": "carbon",
    "utc_offset_h": -5.0,
    "pairing": "local",
    "minutes": 60.0,
}
WEATHER_META = {
    **PROVENANCE,
    "kind": "weather",
    "label": "x",
    "latitude_deg": 40.0,
    "longitude_deg": -75.0,
    "elevation_m": 1.0,
    "utc_offset_h": -5.0,
    "minutes": 60.0,
}
WORKLOAD_META = {**PROVENANCE, "kind": "workload", "minutes": 60.0}
WEATHER_COLUMNS = {
    "outdoor_c": np.full(8760, 20.0),
    "wet_bulb_c": np.full(8760, 15.0),
    "relative_humidity_pct": np.full(8760, 60.0),
    "pressure_pa": np.full(8760, 101e3),
}
CI = np.full(8760, 300.0)

# Content of a damaged file, or the change of an undamaged one; and what the message says.
Damage = bytes | Callable[[Lines], Lines]
DAMAGES: dict[str, list[tuple[Damage, tuple[str, ...]]]] = {
    "x.epw": [
        (b"", ("row 1", "LOCATION")),
        (bytes(range(256)) * 40, ("row 1", "LOCATION")),
        (lambda x: x[8:], ("row 1", "LOCATION")),
        (lambda x: x[:5], ("row 5", "8 header")),
        (cut(3, 3), ("row 8", "DATA PERIODS")),
        (lambda x: x[:8], ("row 8", "no rows")),
        (replace_row(1, "LOCATION,Here,NY,USA"), ("row 1", "4 fields")),
        (cell(1, 6, "140.7"), ("row 1", "latitude", "'140.7'")),
        (cell(1, 8, "EST"), ("row 1", "UTC offset", "'EST'")),
        (replace_row(8, "DATA PERIODS,1,7,Data"), ("row 8", "'7'", "divisor of 60")),
        (lambda x: x[:-1], ("8759", "8760", "365 days")),
        # 8,760 rows of a leap year, and an hour with three of four quarters.
        (lambda _: list(build.epw_lines("2024-01-01", "2024-12-31")), ("8736", "8760")),
        (
            lambda _: build.without_rows(build.epw_lines(per_hour=4), 1000, 1000),
            ("row 997", "3 rows", "expected 4"),
        ),
        (replace_row(77, "2021,1,3,21,60,?9"), ("row 77", "6 columns", "35")),
        (cell(123, 6, "warm"), ("row 123", "dry bulb", "'warm'")),
        (cell(124, 6, "85"), ("row 124", "dry bulb", "'85'")),
        (cell(125, 6, "inf"), ("row 125", "'inf'")),
        (cell(9, 6, "77.0"), ("row 9", "77.0", "-90 to 60 C", "Fahrenheit")),
        (cell(200, 8, "111"), ("row 200", "humidity", "'111'")),
        (cell(300, 9, "1013.2"), ("row 300", "pressure", "31000")),
        (cell(400, 7, "45.0"), ("row 400", "dew point", "45.0", "dry bulb")),
        (cell(500, 1, "13"), ("row 500", "month", "'13'")),
        (cell(501, 3, "0"), ("row 501", "hour", "'0'")),
        (cell(1000, 2, "30"), ("row 1000", "day", "month 2")),
        (repeat_row(600), ("row 601", "repeats")),
        (swap_rows(700), ("row 701", "after the row above")),
        (cut(800, 824), ("row 800", "24 h", "25 h")),
        (every_cell(6, "99.9", 900, 924), ("row 900", "dry bulb", "25 h")),
    ],
    "ci.csv": [
        (b"", ("empty",)),
        (lambda x: x[:1], ("no rows",)),
        (b"timestamp,avg_CI\n\xff\xfe", ("UTF-8",)),
        (b"t\0i\0m\0e\0,\0a\0", ("zero bytes", "UTF-8")),
        (without_column(7), ("row 1", "NUC")),
        (without_column(9), ("row 1", "avg_CI")),
        (lambda x: [*x[:50], x[50] + ",1,2", *x[51:]], ("line 51", "saw 12")),
        (cell(60, 0, "yesterday"), ("row 60", "timestamp", "'yesterday'")),
        (without_zone, ("row 2", "UTC offset")),
        (repeat_row(70), ("row 71", "not seen before")),
        (swap_rows(80), ("row 81", "timestamp")),
        (cell(90, 0, "2022-01-04 16:30:00+00:00"), ("row 90", "60 min")),
        (cut(100, 125), ("row 100", "24 h", "26 h")),
        (every_cell(9, "", 200, 224), ("row 200", "avg_CI", "25 h")),
        (lambda x: [r.replace(",2000,", ",,") for r in x], ("row 2", "NUC", "8760 h")),
        (cell(300, 5, "n.v."), ("row 300", "NG", "'n.v.'")),
        (cell(300, 5, "x" * 9000), ("row 300", "xx…, ex")),
        (cell(301, 2, "-2e6"), ("row 301", "SUN", "'-2e6'")),
        (cell(302, 9, "222.5"), ("row 302", "avg_CI", "222.5", "fuel mix")),
        (
            replace_row(303, "2022-01-13 13:00:00+00:00,0,0,0,0,0,0,0,0,300"),
            ("row 303", "some generation"),
        ),
        (
            lambda x: ["timestamp,avg_CI", *(f"{r.split(',')[0]},0.3" for r in x[1:])],
            ("avg_CI", "0.3", "--map avg_CI:kg/kWh=COLUMN"),
        ),
        (cell(304, 9, "9e9"), ("row 304", "2000")),
        (lambda x: x[:-1], ("8759", "8760")),
    ],
    "load.csv": [
        (b"", ("empty",)),
        (replace_row(1, ",load"), ("row 1", "cpu_load", "(blank), load")),
        (cell(2, 1, "50"), ("row 2", "cpu_load", "'50'", "--map cpu_load:%=COLUMN")),
        (cell(3, 1, "-0.1"), ("row 3", "'-0.1'")),
        (cell(4, 1, "idle"), ("row 4", "'idle'")),
        (repeat_row(5), ("row 6", "increase")),
        (cell(6, 0, "six"), ("row 6", "'six'")),
        (cut(10, 34), ("row 10", "25 h")),
        (every_cell(1, "", 10, 34), ("row 10", "25 h")),
        (lambda x: x[:8760], ("8759", "8760")),
        (
            lambda x: ["timestamp,cpu_load", "2022-01-01 00:00:00+00:00,0.5", *x[2:]],
            ("row 2", "without a UTC offset"),
        ),
    ],
}
# Columns and metadata of damaged Parquet files, and what the message says.
STAMPS = [row.split(",")[0] for row in build.carbon_lines()[1:]]
PARQUET: list[tuple[str, dict[str, Any], dict[str, Any] | None, tuple[str, ...]]] = [
    ("w", WEATHER_COLUMNS, None, ("metadata", "location")),
    ("w", WEATHER_COLUMNS, {**WEATHER_META, "kind": "soil"}, ("metadata kind", "'soil'")),
    ("w", WEATHER_COLUMNS, {**WEATHER_META, "format": "series/9"}, ("format", "series/9")),
    ("w", WEATHER_COLUMNS, {**WEATHER_META, "utc_offset_h": "east"}, ("utc_offset_h", "'east'")),
    ("w", WEATHER_COLUMNS, {**WEATHER_META, "minutes": -60.0}, ("resolution", "-60")),
    ("w", {"outdoor_c": CI}, WEATHER_META, ("row 1", "outdoor_c", "300")),
    ("w", {"outdoor_c": CI / 20.0}, WEATHER_META, ("missing column wet_bulb_c",)),
    (
        "w",
        {**WEATHER_COLUMNS, "wet_bulb_c": with_value(8760, 15.0, 41, 21.0)},
        WEATHER_META,
        ("row 42", "wet_bulb_c", "21.0"),
    ),
    ("c", {"ci_g_per_kwh": with_value(8760, 3.0, 7, np.nan)}, CARBON_META, ("row 8", "nan")),
    ("c", {"ci_g_per_kwh": ["high"] * 8760}, CARBON_META, ("ci_g_per_kwh", "string")),
    ("c", {"ci_g_per_kwh": CI[:8000]}, CARBON_META, ("8000", "8760")),
    ("c", {"ci_g_per_kwh": CI}, {**CARBON_META, "utc_offset_h": 1.0}, ("utc_offset_h", "-5")),
    ("c", {"timestamp": STAMPS, "avg_CI": with_value(8760, 3.0, 9, -1.0)}, None, ("row 10",)),
    ("l", {"utilisation": with_value(8760, 0.5, 3, 1.5)}, WORKLOAD_META, ("row 4", "1.5")),
    ("l", {"load": CI}, None, ("row 1", "cpu_load")),
]
UNDAMAGED: dict[str, Callable[[], bytes]] = {
    "x.epw": lambda: build.text(build.epw_lines()).encode(),
    "ci.csv": lambda: build.text(build.carbon_lines()).encode(),
    "load.csv": lambda: build.text(build.workload_lines()).encode(),
    "w.parquet": lambda: parquet(WEATHER_COLUMNS, WEATHER_META),
    "c.parquet": lambda: parquet({"ci_g_per_kwh": CI}, CARBON_META),
    "l.parquet": lambda: parquet({"utilisation": CI / 600.0}, WORKLOAD_META),
}


def read(path: Path) -> None:
    if path.name[0] in "xw":
        read_epw(path)
    elif path.name[0] == "c":
        read_carbon(path, -5.0)
    else:
        read_workload(path)


def refused(path: Path, content: bytes, places: tuple[str, ...]) -> None:
    """Check that a file is refused in one line that names the file and the place."""
    path.write_bytes(content)
    with pytest.raises(DataError) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    for place in places:
        assert place in message.removeprefix(str(path))


@pytest.mark.parametrize(
    ("name", "at"), [(name, at) for name, each in DAMAGES.items() for at in range(len(each))]
)
def test_malformed_files_end_in_one_line_that_names_the_place(
    name: str, at: int, tmp_path: Path
) -> None:
    damage, places = DAMAGES[name][at]
    if callable(damage):
        damage = build.text(damage(UNDAMAGED[name]().decode().splitlines())).encode()
    refused(tmp_path / name, damage, places)


@pytest.mark.parametrize(("name", "columns", "metadata", "places"), PARQUET)
def test_malformed_parquet_files(
    name: str,
    columns: dict[str, Any],
    metadata: dict[str, Any] | None,
    places: tuple[str, ...],
    tmp_path: Path,
) -> None:
    refused(tmp_path / f"{name}.parquet", parquet(columns, metadata), places)


def test_a_parquet_file_that_is_cut_off(tmp_path: Path) -> None:
    content = UNDAMAGED["w.parquet"]()[:-100]
    refused(tmp_path / "w.parquet", content, ("cannot be read as a Parquet file",))


@pytest.mark.parametrize("name", UNDAMAGED)
def test_the_undamaged_files_are_read(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(UNDAMAGED[name]())
    read(path)


@pytest.mark.parametrize("reader", [read_epw, read_workload, lambda p: read_carbon(p, -5.0)])
def test_a_folder_or_nothing_is_no_file(reader: Callable[[Path], Any], tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is a folder"):
        reader(tmp_path)
    with pytest.raises(DataError, match="no such file"):
        reader(tmp_path / "absent.csv")


@pytest.mark.parametrize("minutes", [0.0, -60.0, 7.0, 2880.0, 1e308])
def test_resolutions_that_do_not_divide_a_day_are_refused(minutes: float) -> None:
    with pytest.raises(DataError, match="expected a positive one that divides a day"):
        files.rows_per_year(Path("x.parquet"), minutes)
