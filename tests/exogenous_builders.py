"""Well-formed weather, carbon and workload files as text, for tests to damage."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from typer.testing import CliRunner, Result

from sdc_taichi.cli.data import data_app

EPW_HEADER = (
    "LOCATION,Test.Station,NY,USA,TEST,000000,40.70000,-75.00000,{offset},10.0",
    "DESIGN CONDITIONS,0",
    "TYPICAL/EXTREME PERIODS,0",
    "GROUND TEMPERATURES,0",
    "HOLIDAYS/DAYLIGHT SAVINGS,No,0,0,0",
    "COMMENTS 1,test",
    "COMMENTS 2,test",
    "DATA PERIODS,1,{per_hour},Data,Sunday,1/ 1,12/31",
)
CARBON_HEADER = "timestamp,WND,SUN,WAT,OIL,NG,COL,NUC,OTH,avg_CI"
FACTORS = {"SUN": 41.0, "NG": 490.0, "NUC": 12.0}


DESIGN_LINE = (
    "DESIGN CONDITIONS,1,2021 ASHRAE Handbook -- Fundamentals - Chapter 14 Climatic Design "
    "Information,,Heating,1,-18.7,-16.0,-24.1,0.4,-18.0,-21.6,0.6,-15.2,11.9,-0.8,11.0,-1.4,4.7,"
    "270,0.565,Cooling,7,9.8,32.9,23.4,31.4,22.7,30.0,21.9,25.2,30.7,24.2,29.2,23.3,28.0,5.1,220,"
    "23.5,18.8,28.6,22.6,17.7,27.4,21.7,16.7,26.3,78.0,30.5,73.8,29.5,70.1,28.2,28.5,Extremes,"
    "10.9,9.3,8.4,-22.3,35.2,3.8,2.0,-25.1,36.7,-27.3,37.9,-29.5,39.0,-32.3,40.5"
)
"""Design conditions of Chicago: dry bulb 32.9 C, wet bulb 25.2 C, 39.0 C once in 20 years."""


def days(start: str, stop: str) -> np.ndarray:
    """Every day from start up to, not including, stop."""
    return np.arange(np.datetime64(start, "D"), np.datetime64(stop, "D"))


def hours(start: str, stop: str) -> list[str]:
    """Every hour from the day start up to, not including, the day stop, as text."""
    return np.arange(np.datetime64(start, "h"), np.datetime64(stop, "h")).astype(str).tolist()


@cache
def epw_lines(
    start: str = "2021-01-01", stop: str = "2022-01-01", per_hour: int = 1, offset: float = -5.0
) -> tuple[str, ...]:
    """Lines of an EPW file: warm afternoons and summers, 60 % relative humidity."""
    lines = [line.format(per_hour=per_hour, offset=offset) for line in EPW_HEADER]
    middle = "?9?9?9?9E0?9?9?9?9?9?9?9?9?9?9?9?9?9*9*9?9*9"
    rest = ",0,0,300,0,0,0,0,0,0,0,180,3.0,5,5,9999,77777,9,999999999,20,0.1,0,88,0.2,0.0,0.0"
    for day in days(start, stop).tolist():
        season = -10.0 * np.cos(2 * np.pi * (day.timetuple().tm_yday - 15) / 365)
        for hour in range(24):
            pressure = 101_000 + 25 * (day.timetuple().tm_yday % 20)
            dry = 12.0 + season - 5.0 * np.cos(2 * np.pi * (hour - 3) / 24)
            for part in range(per_hour):
                minute = 60 if per_hour == 1 else (part + 1) * 60 // per_hour
                lines.append(
                    f"{day.year},{day.month},{day.day},{hour + 1},{minute},{middle},"
                    f"{dry:.2f},{dry - 8:.2f},60,{pressure}{rest}"
                )
    return tuple(lines)


def solar_noon_generation(local_hour: np.ndarray) -> np.ndarray:
    """Solar generation of an interval whose middle is at the given local hour; peak at 12."""
    return np.round(np.maximum(0.0, 6000.0 * np.cos(2 * np.pi * (local_hour - 12.0) / 28.0)), 1)


def carbon_lines(
    start: str = "2022-01-01",
    stop: str = "2023-01-01",
    utc_offset_h: float = -5.0,
    minutes: int = 60,
    marks: str = "end",
    change: str | None = None,
) -> list[str]:
    """Lines of a carbon file stamped in UTC, its solar generation symmetric about local noon.

    ``marks`` is what stamps mark, until the day ``change`` if that is given, then the other.
    """
    step = np.timedelta64(minutes, "m")
    stamps = np.arange(np.datetime64(start, "m"), np.datetime64(stop, "m"), step)
    is_end = np.full(stamps.size, marks == "end")
    if change is not None:
        is_end ^= stamps >= np.datetime64(change, "m")
    middle = stamps + np.where(is_end, -1, 1) * (step / 2).astype("timedelta64[m]")
    local = middle + np.timedelta64(round(utc_offset_h * 60), "m")
    hour = (local - local.astype("datetime64[D]")) / np.timedelta64(60, "m")
    sun = np.where((hour > 5) & (hour < 19), solar_noon_generation(hour), 0.0)
    gas, nuclear = 8000.0 - sun, 2000.0
    intensity = (FACTORS["SUN"] * sun + FACTORS["NG"] * gas + FACTORS["NUC"] * nuclear) / 10_000.0
    text = np.datetime_as_string(stamps, unit="m")
    rows = [
        f"{t.replace('T', ' ')}:00+00:00,0,{s:.1f},0,0,{g:.1f},0,{nuclear:.0f},0,{c:.4f}"
        for t, s, g, c in zip(text.tolist(), sun, gas, intensity, strict=True)
    ]
    return [CARBON_HEADER, *rows]


def workload_lines(n: int = 8760) -> list[str]:
    """Lines of a workload file: a daily and a slow wave."""
    hour = np.arange(n)
    load = 0.5 + 0.2 * np.sin(2 * np.pi * hour / 24) + 0.1 * np.sin(hour / 777)
    return [",cpu_load", *(f"{i + 1},{x:.6f}" for i, x in enumerate(load.tolist()))]


def text(lines: Sequence[str], newline: str = "\n") -> str:
    """Join lines, with a final newline."""
    return newline.join(lines) + newline


def with_cell(lines: Sequence[str], row: int, column: int, value: str) -> list[str]:
    """Replace one cell; row as an editor counts, column from 0."""
    changed = list(lines)
    cells = changed[row - 1].split(",")
    cells[column] = value
    changed[row - 1] = ",".join(cells)
    return changed


def without_rows(lines: Sequence[str], first: int, last: int) -> list[str]:
    """Remove rows first to last, both included."""
    return [*lines[: first - 1], *lines[last:]]


def run_data(*arguments: str) -> Result:
    """Result of ``sdc-taichi data``; its errors are raised."""
    result = CliRunner().invoke(data_app, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result
