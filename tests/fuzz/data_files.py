"""Weather, carbon and workload files: cells, columns, units, codings, bytes, kinds of file."""

from __future__ import annotations

import os
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

import exogenous_builders as build
from fuzz import damage, physics
from fuzz.case import DefectError, Scratch
from sdc_taichi import load_config
from sdc_taichi.config import with_values
from sdc_taichi.exogenous import Series, importing, read_carbon, read_epw, read_workload
from sdc_taichi.exogenous.series import FloatArray
from sdc_taichi.exogenous.series_file import read_metadata, write_parquet

KINDS = ("weather", "carbon", "workload")
UTC_OFFSET_H = -5.0
SUFFIXES = {"weather": "epw", "carbon": "csv", "workload": "csv"}
LIMITS = {
    "outdoor_c": (-90.0, 60.0),
    "wet_bulb_c": (-90.0, 60.0),
    "ci_g_per_kwh": (0.0, 5_000.0),
    "cpu_load": (0.0, 1.0),
}
"""Lowest and highest physical value of each series."""
HEADERS = {"weather": 8, "carbon": 1, "workload": 1}


@cache
def lines_of(kind: str) -> tuple[str, ...]:
    """Lines of a valid file."""
    if kind == "weather":
        return build.epw_lines()
    return tuple(build.carbon_lines() if kind == "carbon" else build.workload_lines())


def data_files(scratch: Scratch) -> None:
    """Read a damaged file, and simulate with what has been read."""
    kind = scratch.pick(KINDS)
    path = _made(scratch, kind)
    if kind == "weather":
        weather = read_epw(path)
        series: tuple[Series, ...] = (weather.outdoor_c, weather.wet_bulb_c)
    else:
        series = (read_carbon(path, UTC_OFFSET_H) if kind == "carbon" else read_workload(path),)
    for one in series:
        _check_series(one)
    if scratch.chance(0.15):
        fields = {f"site.{kind}_file": str(path)}
        physics.run(scratch, with_values(load_config("tiny"), fields))


def _check_series(series: Series) -> None:
    low, high = LIMITS.get(series.name, (-np.inf, np.inf))
    values = series.values
    if not np.all(np.isfinite(values) & (values >= low) & (values <= high)):
        raise DefectError(f"{series.name} within {values.min():g}..{values.max():g}")
    years = values.size * series.minutes / (365 * 24 * 60)
    if years < 1 or abs(years - round(years)) > 1e-9:
        raise DefectError(f"{series.name} of {years:g} years")


def _made(scratch: Scratch, kind: str) -> Path:
    """A file of some kind, mostly damaged."""
    rng, name = scratch.rng, f"{kind}.{SUFFIXES[kind]}"
    way = scratch.rng.random()
    if way < 0.06:
        return _of_another_kind(scratch, name)
    if way < 0.16:
        return _parquet(scratch, kind)
    lines = list(lines_of(kind))
    for _ in range(int(rng.integers(0, 3))):
        lines = _changed(scratch, kind, lines)
    text = damage.lone_surrogates_escaped("\n".join(lines) + "\n")
    if scratch.chance(0.25):
        return scratch.write(name, damage.damaged_text(rng, text))
    return scratch.write(name, text.encode())


def _changed(scratch: Scratch, kind: str, lines: list[str]) -> list[str]:
    """Lines with another cell, header, column, unit, order or length."""
    rng, first = scratch.rng, HEADERS[kind]
    how = int(rng.integers(9))
    row = int(rng.integers(first, len(lines))) if how else int(rng.integers(first))
    cells = lines[row].split(",")
    column = int(rng.integers(len(cells)))
    if how <= 2:
        cells[column] = damage.scalar(rng)[:2000]
        return [*lines[:row], ",".join(cells), *lines[row + 1 :]]
    if how == 3:
        last = row + int(rng.choice([1, 2, 30, 4000]))
        return lines[:row] + lines[last:]
    if how == 4:
        return [*lines[:row], *lines[row:][::-1]] if scratch.chance(0.3) else [*lines, *lines]
    if how == 5:
        delimiter = str(rng.choice([";", "\t", " ", "|"]))
        return [line.replace(",", delimiter) for line in lines]
    table = [line.split(",") for line in lines[first:]]
    column = int(rng.integers(min(map(len, table))))
    if how == 6:
        factor, offset = ((1.8, 32.0), (1e3, 0.0), (0.0, 0.0), (-1.0, 0.0))[int(rng.integers(4))]
        for line in table:
            line[column] = _converted(line[column], factor, offset)
    elif how == 7:
        for line in table:
            del line[column]
    else:
        value = damage.scalar(rng)[:50]
        for line in table:
            line[column] = value
    return [*lines[:first], *(",".join(line) for line in table)]


def _converted(text: str, factor: float, offset: float) -> str:
    try:
        return f"{float(text) * factor + offset:.6g}"
    except ValueError:
        return text


def _of_another_kind(scratch: Scratch, name: str) -> Path:
    """No file, a folder, a pipe, a device, or a link to none."""
    path = scratch.folder / name
    scratch.named.append(name)
    how = int(scratch.rng.integers(6))
    if how == 0:
        return path
    path = scratch.output(name)
    if how == 1:
        path.mkdir()
    elif how == 2 and hasattr(os, "mkfifo"):
        os.mkfifo(path)
    elif how == 3:
        path.symlink_to(path)
    elif how == 4:
        path.symlink_to("/dev/zero")
    else:
        path = path.with_name("n" * 5000 + name)
    return path


@cache
def _imported(kind: str) -> tuple[dict[str, FloatArray], dict[str, object]]:
    """Columns and metadata that `data import` writes for a valid file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{kind}.{SUFFIXES[kind]}"
        path.write_text("\n".join(lines_of(kind)) + "\n", encoding="utf-8")
        if kind == "weather":
            target = importing.import_weather(path, "x", None, Path(folder)).target
        elif kind == "carbon":
            target = importing.import_carbon(
                path, "x", None, Path(folder), utc_offset_h=UTC_OFFSET_H
            ).target
        else:
            target = importing.import_workload(path, "x", Path(folder)).target
        metadata = read_metadata(target) or {}
        frame = pd.read_parquet(target)
    return {str(name): frame[name].to_numpy() for name in frame}, metadata


def _parquet(scratch: Scratch, kind: str) -> Path:
    """What `data import` writes, or nearly so."""
    rng = scratch.rng
    made_by_import, stored = _imported(kind)
    columns, metadata = dict(made_by_import), dict(stored)
    if scratch.chance(0.4):
        metadata[scratch.pick(list(metadata))] = scratch.pick(
            (None, -1, 0, 1e308, "²", [], {}, "x" * 5000, True, float("nan"), "\x1b[31m")
        )
    if scratch.chance(0.4):
        name = scratch.pick(list(columns))
        factor = float(rng.choice([0.0, 1.0, 1.8, np.nan, 1e300, -1.0]))
        columns[name] = columns[name] * factor
    if scratch.chance(0.2):
        rows = int(rng.integers(1, 9000))
        columns = {name: values[:rows] for name, values in columns.items()}
    made = scratch.output("made.parquet")
    write_parquet(made, columns, metadata)
    content = made.read_bytes()
    if scratch.chance(0.3):
        content = damage.damaged_bytes(rng, content)
    return scratch.write(f"{kind}.parquet", content)
