"""Words of a report: numbers, names, times and counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

import numpy as np

from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR, day_of_year, step_times
from sdc_taichi.run.folder_reader import RunFolder
from sdc_taichi.run.folder_writer import METRICS_FILE

from .plotting import date_text, format_number

MAX_ROWS = 40
"""Largest number of rows of a list that grows with the run: events, sources, notes."""
NAMES_PER_CELL = 6
"""Largest number of data centers that a cell names."""


def metric_text(metrics: Mapping[str, Any], key: str) -> str:
    """A metric as text, a dash where it is not defined."""
    value = metrics[key]
    return "–" if value is None else format_number(value)


def names_text(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    if len(names) <= NAMES_PER_CELL:
        return ", ".join(names)
    return f"{', '.join(names[:NAMES_PER_CELL])} and {len(names) - NAMES_PER_CELL:,} more"


def first_texts(texts: Sequence[str]) -> list[str]:
    """The first texts of a list, and how many more there are."""
    if len(texts) <= MAX_ROWS:
        return list(texts)
    return [*texts[:MAX_ROWS], f"and {len(texts) - MAX_ROWS} more, see {METRICS_FILE}"]


def local_time(run: RunFolder, dc: int, step: int) -> datetime:
    """Time at which a step begins on the clock of a data center.

    Args:
        run: the run.
        dc: index of the data center.
        step: the step, counted from 0 at reset.
    """
    per_hour = round(1 / run.metrics["step_h"])
    first_day = day_of_year(run.metrics["data_centers"][dc]["start"])
    start = np.array([first_day * 24 * per_hour])
    moment: datetime = step_times(start, np.array([step]), per_hour)[0, 0].astype(datetime)
    return moment


def time_text(run: RunFolder, moment: datetime) -> str:
    """Day and time of day, with the year of the run if it is longer than a year."""
    day = date_text(moment, over_a_year=run.hours > HOURS_PER_YEAR)
    return f"{day} {moment:%H:%M}"


def count_text(value: float, noun: str) -> str:
    """A number and a noun, in the plural unless the number is 1."""
    return f"{format_number(value)} {noun}" + ("" if value == 1 else "s")


def time_span_text(run: RunFolder) -> str:
    """Data centers, length, begin and end of a run in words."""
    begin, last = local_time(run, 0, 0), local_time(run, 0, run.metrics["steps_done"])
    size, length = count_text(len(run.names), "data center"), count_text(run.hours / 24, "day")
    span = f"{time_text(run, begin)} to {time_text(run, last)}, local standard time"
    return f"{size}, {length} from {span}"


def run_labels(runs: Sequence[RunFolder]) -> list[str]:
    """Names of runs: their controllers, with their folders where these do not tell them apart."""
    names = [run.metrics["controller"] for run in runs]
    if len(set(names)) < len(names):
        names = [f"{n} ({run.path.resolve().name})" for n, run in zip(names, runs, strict=True)]
    if len(set(names)) < len(names):
        names = [f"{name} #{index + 1}" for index, name in enumerate(names)]
    return names
