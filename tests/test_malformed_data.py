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


def epw(change: Callable[[Lines], Lines], **kwargs: Any) -> bytes:
    return build.text(change(list(build.epw_lines(**kwargs)))).encode()


def carbon(change: Callable[[Lines], Lines]) -> bytes:
    return build.text(change(build.carbon_lines())).encode()


def workload(change: Callable[[Lines], Lines]) -> bytes:
    return build.text(change(build.workload_lines())).encode()


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
WEATHER = "x.epw"
CARBON = "ci.csv"
LOAD = "load.csv"

# Name of the file, its bytes (made when needed), and what the message must say about the place.
CASES: dict[str, tuple[str, Callable[[], bytes], tuple[str, ...]]] = {
    "epw empty": (WEATHER, lambda: b"", ("row 1", "LOCATION")),
    "epw binary": (WEATHER, lambda: bytes(range(256)) * 40, ("row 1", "LOCATION")),
    "epw without header": (WEATHER, lambda: epw(lambda x: x[8:]), ("row 1", "LOCATION")),
    "epw ends in the header": (WEATHER, lambda: epw(lambda x: x[:5]), ("row 5", "8 header")),
    "epw header line missing": (WEATHER, lambda: epw(cut(3, 3)), ("row 8", "DATA PERIODS")),
    "epw without data": (WEATHER, lambda: epw(lambda x: x[:8]), ("row 8", "no rows")),
    "epw location short": (
        WEATHER,
        lambda: epw(replace_row(1, "LOCATION,Here,NY,USA")),
        ("row 1", "4 fields"),
    ),
    "epw latitude": (WEATHER, lambda: epw(cell(1, 6, "140.7")), ("row 1", "latitude", "'140.7'")),
    "epw time zone": (WEATHER, lambda: epw(cell(1, 8, "EST")), ("row 1", "UTC offset", "'EST'")),
    "epw records per hour": (
        WEATHER,
        lambda: epw(replace_row(8, "DATA PERIODS,1,7,Data,Sunday,1/ 1,12/31")),
        ("row 8", "'7'", "divisor of 60"),
    ),
    "epw one row short": (WEATHER, lambda: epw(lambda x: x[:-1]), ("8759", "8760", "365 days")),
    "epw leap year cut to 8760 rows": (
        WEATHER,
        lambda: epw(lambda x: x[: 8 + 8760], start="2024-01-01", stop="2025-01-01"),
        ("8736", "8760"),
    ),
    "epw row cut off": (
        WEATHER,
        lambda: epw(replace_row(77, "2021,1,3,21,60,?9")),
        ("row 77", "6 columns", "35"),
    ),
    "epw text": (WEATHER, lambda: epw(cell(123, 6, "warm")), ("row 123", "dry bulb", "'warm'")),
    "epw too hot": (WEATHER, lambda: epw(cell(124, 6, "85")), ("row 124", "dry bulb", "'85'")),
    "epw infinite": (WEATHER, lambda: epw(cell(125, 6, "inf")), ("row 125", "'inf'")),
    "epw fahrenheit": (
        WEATHER,
        lambda: epw(cell(9, 6, "77.0")),
        ("row 9", "77.0", "-90 to 60 C", "Fahrenheit"),
    ),
    "epw humidity": (WEATHER, lambda: epw(cell(200, 8, "111")), ("row 200", "humidity", "'111'")),
    "epw pressure in hPa": (
        WEATHER,
        lambda: epw(cell(300, 9, "1013.2")),
        ("row 300", "pressure", "31000"),
    ),
    "epw wet bulb above dry bulb": (
        WEATHER,
        lambda: epw(cell(400, 7, "45.0")),
        ("row 400", "dew point", "45.0", "dry bulb"),
    ),
    "epw month": (WEATHER, lambda: epw(cell(500, 1, "13")), ("row 500", "month", "'13'")),
    "epw hour": (WEATHER, lambda: epw(cell(501, 3, "0")), ("row 501", "hour", "'0'")),
    "epw day": (WEATHER, lambda: epw(cell(1000, 2, "30")), ("row 1000", "day", "month 2")),
    "epw hour twice": (WEATHER, lambda: epw(repeat_row(600)), ("row 601", "repeats")),
    "epw hours swapped": (WEATHER, lambda: epw(swap_rows(700)), ("row 701", "after the row above")),
    "epw gap": (WEATHER, lambda: epw(cut(800, 824)), ("row 800", "24 h", "25 h")),
    "epw missing codes over a day": (
        WEATHER,
        lambda: epw(every_cell(6, "99.9", 900, 924)),
        ("row 900", "dry bulb", "25 h"),
    ),
    "epw part of an hour": (
        WEATHER,
        lambda: epw(cut(1000, 1000), per_hour=4),
        ("row 997", "3 rows", "expected 4"),
    ),
    "carbon empty": (CARBON, lambda: b"", ("empty",)),
    "carbon header only": (CARBON, lambda: carbon(lambda x: x[:1]), ("no rows",)),
    "carbon binary": (CARBON, lambda: b"timestamp,avg_CI\n\xff\xfe", ("UTF-8",)),
    "carbon in UTF-16": (CARBON, lambda: b"t\0i\0m\0e\0,\0a\0", ("zero bytes", "UTF-8")),
    "carbon fuel missing": (CARBON, lambda: carbon(without_column(7)), ("row 1", "NUC")),
    "carbon intensity missing": (CARBON, lambda: carbon(without_column(9)), ("row 1", "avg_CI")),
    "carbon row too long": (
        CARBON,
        lambda: carbon(lambda x: [*x[:50], x[50] + ",1,2", *x[51:]]),
        ("line 51", "saw 12"),
    ),
    "carbon stamp": (
        CARBON,
        lambda: carbon(cell(60, 0, "yesterday")),
        ("row 60", "timestamp", "'yesterday'"),
    ),
    "carbon without zone": (CARBON, lambda: carbon(without_zone), ("row 2", "UTC offset")),
    "carbon stamp twice": (CARBON, lambda: carbon(repeat_row(70)), ("row 71", "not seen before")),
    "carbon stamps swapped": (CARBON, lambda: carbon(swap_rows(80)), ("row 81", "timestamp")),
    "carbon half an hour off": (
        CARBON,
        lambda: carbon(cell(90, 0, "2022-01-04 16:30:00+00:00")),
        ("row 90", "60 min"),
    ),
    "carbon gap": (CARBON, lambda: carbon(cut(100, 125)), ("row 100", "24 h", "26 h")),
    "carbon blank over a day": (
        CARBON,
        lambda: carbon(every_cell(9, "", 200, 224)),
        ("row 200", "avg_CI", "25 h"),
    ),
    "carbon fuel without values": (
        CARBON,
        lambda: carbon(lambda x: [x[0], *(r.replace(",2000,", ",,") for r in x[1:])]),
        ("row 2", "NUC", "8760 h"),
    ),
    "carbon text": (CARBON, lambda: carbon(cell(300, 5, "n.v.")), ("row 300", "NG", "'n.v.'")),
    "carbon long text": (CARBON, lambda: carbon(cell(300, 5, "x" * 9000)), ("row 300", "xx…, ex")),
    "carbon negative": (CARBON, lambda: carbon(cell(301, 2, "-3")), ("row 301", "SUN", "'-3'")),
    "carbon off its mix": (
        CARBON,
        lambda: carbon(cell(302, 9, "222.5")),
        ("row 302", "avg_CI", "222.5", "fuel mix"),
    ),
    "carbon no generation": (
        CARBON,
        lambda: carbon(replace_row(303, "2022-01-13 13:00:00+00:00,0,0,0,0,0,0,0,0,300")),
        ("row 303", "some generation"),
    ),
    "carbon in kg": (
        CARBON,
        lambda: carbon(lambda x: ["timestamp,avg_CI", *(f"{r.split(',')[0]},0.3" for r in x[1:])]),
        ("avg_CI", "0.3", "--map avg_CI:kg/kWh=COLUMN"),
    ),
    "carbon too high": (CARBON, lambda: carbon(cell(304, 9, "9e9")), ("row 304", "2000")),
    "carbon one row short": (CARBON, lambda: carbon(lambda x: x[:-1]), ("8759", "8760")),
    "workload empty": (LOAD, lambda: b"", ("empty",)),
    "workload column": (
        LOAD,
        lambda: workload(replace_row(1, ",load")),
        ("row 1", "cpu_load", "(blank), load"),
    ),
    "workload in percent": (
        LOAD,
        lambda: workload(cell(2, 1, "50")),
        ("row 2", "cpu_load", "'50'", "--map cpu_load:%=COLUMN"),
    ),
    "workload negative": (LOAD, lambda: workload(cell(3, 1, "-0.1")), ("row 3", "'-0.1'")),
    "workload text": (LOAD, lambda: workload(cell(4, 1, "idle")), ("row 4", "'idle'")),
    "workload index twice": (LOAD, lambda: workload(repeat_row(5)), ("row 6", "increase")),
    "workload index text": (LOAD, lambda: workload(cell(6, 0, "six")), ("row 6", "'six'")),
    "workload gap": (LOAD, lambda: workload(cut(10, 34)), ("row 10", "25 h")),
    "workload blank over a day": (
        LOAD,
        lambda: workload(every_cell(1, "", 10, 34)),
        ("row 10", "25 h"),
    ),
    "workload short": (LOAD, lambda: workload(lambda x: x[:8760]), ("8759", "8760")),
    "workload zone": (
        LOAD,
        lambda: workload(lambda x: ["timestamp,cpu_load", "2022-01-01 00:00:00+00:00,0.5", *x[2:]]),
        ("row 2", "without a UTC offset"),
    ),
    "parquet cut off": (
        "w.parquet",
        lambda: parquet(WEATHER_COLUMNS, WEATHER_META)[:-100],
        ("cannot be read as a Parquet file",),
    ),
    "parquet weather without metadata": (
        "w.parquet",
        lambda: parquet(WEATHER_COLUMNS, None),
        ("metadata", "location"),
    ),
    "parquet of another kind": (
        "w.parquet",
        lambda: parquet(WEATHER_COLUMNS, {**WEATHER_META, "kind": "soil"}),
        ("metadata kind", "'soil'"),
    ),
    "parquet of another version": (
        "w.parquet",
        lambda: parquet(WEATHER_COLUMNS, {**WEATHER_META, "format": "sdc-series/9"}),
        ("metadata format", "sdc-series/9"),
    ),
    "parquet metadata value": (
        "w.parquet",
        lambda: parquet(WEATHER_COLUMNS, {**WEATHER_META, "utc_offset_h": "east"}),
        ("metadata utc_offset_h", "'east'"),
    ),
    "parquet resolution": (
        "w.parquet",
        lambda: parquet(WEATHER_COLUMNS, {**WEATHER_META, "minutes": -60.0}),
        ("resolution", "-60"),
    ),
    "parquet column": (
        "w.parquet",
        lambda: parquet({"outdoor_c": WEATHER_COLUMNS["outdoor_c"]}, WEATHER_META),
        ("missing column wet_bulb_c",),
    ),
    "parquet wet bulb above dry bulb": (
        "w.parquet",
        lambda: parquet(
            {**WEATHER_COLUMNS, "wet_bulb_c": with_value(8760, 15.0, 41, 21.0)}, WEATHER_META
        ),
        ("row 42", "wet_bulb_c", "21.0"),
    ),
    "parquet carbon NaN": (
        "c.parquet",
        lambda: parquet({"ci_g_per_kwh": with_value(8760, 300.0, 7, np.nan)}, CARBON_META),
        ("row 8", "ci_g_per_kwh", "nan"),
    ),
    "parquet carbon text": (
        "c.parquet",
        lambda: parquet({"ci_g_per_kwh": ["high"] * 8760}, CARBON_META),
        ("ci_g_per_kwh", "string"),
    ),
    "parquet carbon short": (
        "c.parquet",
        lambda: parquet({"ci_g_per_kwh": CI[:8000]}, CARBON_META),
        ("8000", "8760"),
    ),
    "parquet carbon zone": (
        "c.parquet",
        lambda: parquet({"ci_g_per_kwh": CI}, {**CARBON_META, "utc_offset_h": 1.0}),
        ("utc_offset_h", "-5"),
    ),
    "parquet table negative": (
        "c.parquet",
        lambda: parquet(
            {
                "timestamp": [r.split(",")[0] for r in build.carbon_lines()[1:]],
                "avg_CI": with_value(8760, 300.0, 9, -1.0),
            },
            None,
        ),
        ("row 10", "avg_CI", "-1.0"),
    ),
    "parquet workload over 1": (
        "l.parquet",
        lambda: parquet({"utilisation": with_value(8760, 0.5, 3, 1.5)}, WORKLOAD_META),
        ("row 4", "utilisation", "1.5"),
    ),
    "parquet workload column": (
        "l.parquet",
        lambda: parquet({"load": np.full(8760, 0.5)}, None),
        ("row 1", "cpu_load"),
    ),
}


def read(path: Path) -> None:
    if path.name[0] in "xw":
        read_epw(path)
    elif path.name[0] == "c":
        read_carbon(path, -5.0)
    else:
        read_workload(path)


@pytest.mark.parametrize("case", CASES)
def test_malformed_files_end_in_one_line_that_names_the_place(case: str, tmp_path: Path) -> None:
    name, content, places = CASES[case]
    path = tmp_path / name
    path.write_bytes(content())
    with pytest.raises(DataError) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    for place in places:
        assert place in message.removeprefix(str(path))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        (WEATHER, lambda: epw(list)),
        (CARBON, lambda: carbon(list)),
        (LOAD, lambda: workload(list)),
        ("w.parquet", lambda: parquet(WEATHER_COLUMNS, WEATHER_META)),
        ("c.parquet", lambda: parquet({"ci_g_per_kwh": CI}, CARBON_META)),
        ("l.parquet", lambda: parquet({"utilisation": CI / 600.0}, WORKLOAD_META)),
    ],
)
def test_the_undamaged_files_are_read(
    name: str, content: Callable[[], bytes], tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_bytes(content())
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
