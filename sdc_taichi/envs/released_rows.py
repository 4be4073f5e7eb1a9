"""Time entries of the vectors of the released SustainDC: rows by step, scaled by episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.envs.observer import TimeRows, time_rows
from sdc_taichi.envs.released_features import (
    CI_STEPS,
    ENTRY_NUMBERS,
    PAST_STEPS,
    TEMPERATURE_STEPS,
    TIME_FEATURES,
    Z_SCORE_EPSILON,
    cut,
    ranges,
)
from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.types import F32, F64, I64

SMOOTHED_STEPS = 4
"""Steps per mean that the trends of carbon intensity are fitted to (``sustaindc_env.py``)."""
SCALING_DAYS = 30
"""Days from the first step that scale the inputs, fewer where the year ends (``managers.py``)."""

_RANGES = ranges(TIME_FEATURES)


class ReleasedRows:
    """Time entries of a fleet in the units of the inputs, for all steps of the year.

    Args:
        view: a view of the fleet.

    Attributes:
        ci_extremes: least and greatest carbon intensity of the 30 days from each step.
        outdoor_extremes: least and greatest dry bulb of the 30 days from each step.
        rows: rows of all steps; None if they are computed step by step.
    """

    def __init__(self, view: View) -> None:
        drivers, per_hour = view.drivers, view.fleet.steps_per_hour
        window = SCALING_DAYS * 24 * per_hour

        def extremes(series: F64) -> F64:
            return extremes_ahead(series, window)

        self._steps_per_hour = per_hour
        self._time_of_day = _time_of_day_rows(24 * per_hour)
        self._demand = drivers.demand
        self._ci = _row_per_entry(drivers.ci_g_per_kwh, _ci_rows)
        self._outdoor = _row_per_entry(drivers.outdoor_c, _temperature_rows)
        self.ci_extremes = _row_per_entry(drivers.ci_g_per_kwh, extremes)
        self.outdoor_extremes = _row_per_entry(drivers.outdoor_c, extremes)
        self.rows = time_rows(
            (drivers.ci_g_per_kwh, drivers.outdoor_c, drivers.demand),
            self.compute,
            period=len(self._time_of_day),
            row_bytes=8 * len(TIME_FEATURES),
        )

    def made_for(self, view: View) -> bool:
        """Whether the rows are those of the view's inputs."""
        return (
            self._steps_per_hour == view.fleet.steps_per_hour
            and self._demand is view.drivers.demand
            and self._ci.made_from(view.drivers.ci_g_per_kwh)
            and self._outdoor.made_from(view.drivers.outdoor_c)
        )

    def compute(self, index: I64, dc: I64) -> F64:
        """Entries in the order of ``TIME_FEATURES``, (n, entries).

        Args:
            index: steps of the year, (n,).
            dc: data center of each, (n,).
        """
        demand = self._demand

        def arriving(step: I64) -> F64:
            return demand.values.take(demand.offsets[dc] + step % demand.lengths[dc])

        return np.column_stack(
            [
                self._time_of_day.take(index % len(self._time_of_day), axis=0),
                self._ci.at(index, dc),
                arriving(index),
                self._outdoor.at(index, dc),
                arriving(index + 1),
                self._outdoor.at(index + 1, dc)[:, 0],
            ]
        )


class ScaledEpisode:
    """Time entries of an episode, scaled by the 30 days that follow its first step.

    Args:
        rows: time entries of the fleet.
        start: first step of each data center in the year, (B,).

    Attributes:
        row_numbers: row of each data center among those of ``at``, (B,).
    """

    def __init__(self, rows: ReleasedRows, start: I64) -> None:
        dcs = self.row_numbers = np.arange(len(start))
        if rows.rows is not None:
            # Data centers that read the same entries from the same step on see the same.
            _, dcs, self.row_numbers = np.unique(
                rows.rows.row_numbers(start), return_index=True, return_inverse=True
            )
            shared = rows.rows
            self._read = TimeRows(shared.values, shared.first_rows[dcs], shared.lengths[dcs]).at
        else:
            self._read = partial(rows.compute, dc=dcs)
        self._start = start[dcs]
        shape = (len(dcs), len(TIME_FEATURES))
        self._low, self._span = np.zeros(shape), np.ones(shape)
        for columns, extremes in (
            (_CI_COLUMNS, rows.ci_extremes),
            (_OUTDOOR_COLUMNS, rows.outdoor_extremes),
        ):
            low, high = extremes.at(self._start, dcs).T
            # Without a range all reads 0, as any part of infinity does.
            span = np.where(high > low, high - low, np.inf)
            self._low[:, columns.levels] = low[:, None]
            self._span[:, [*columns.levels, *columns.differences]] = span[:, None]
        ci, outdoor = _CI_COLUMNS, _OUTDOOR_COLUMNS
        self._std = slice(ci.std, outdoor.std + 1, outdoor.std - ci.std)
        self._z_score = slice(ci.z_score, outdoor.z_score + 1, outdoor.z_score - ci.z_score)
        self._least_std = Z_SCORE_EPSILON * self._span[:, self._std]

    def at(self, step: int) -> F32:
        """Rows of a step after reset, scaled and within their ranges, (rows, entries)."""
        found = self._read(self._start + step)
        np.add(found[:, self._std], self._least_std, out=self._span[:, self._z_score])
        found -= self._low
        found /= self._span
        return cut(found.astype(np.float32), *_RANGES)


@dataclass(frozen=True, slots=True)
class _ScaledColumns:
    """Columns of a time row that the range of one input scales."""

    levels: tuple[int, ...]
    """Columns that are 0 at the minimum and 1 at the maximum."""
    differences: tuple[int, ...]
    """Columns that are differences of levels."""
    std: int
    """Column of the standard deviation over the window."""
    z_score: int
    """Column of the z-score, which the standard deviation scales."""


def _scaled_columns(name: str, levels: Sequence[str], slopes: Sequence[str]) -> _ScaledColumns:
    return _ScaledColumns(
        levels=tuple(ENTRY_NUMBERS[n] for n in (name, f"{name}_mean_next", *levels)),
        differences=tuple(ENTRY_NUMBERS[n] for n in (*slopes, f"{name}_std_next")),
        std=ENTRY_NUMBERS[f"{name}_std_next"],
        z_score=ENTRY_NUMBERS[f"{name}_z_score"],
    )


_CI_COLUMNS = _scaled_columns("ci", (), ("ci_slope_next", "ci_slope_past"))
_OUTDOOR_COLUMNS = _scaled_columns("outdoor", ("outdoor_next",), ("outdoor_slope_next",))


@dataclass(frozen=True, slots=True)
class _RowPerEntry:
    """A row for each entry of a driver's series, those of all distinct series end to end."""

    series: FleetSeries
    """The series that the rows were made from."""
    rows: F64
    """Rows of all distinct series, (entries, columns)."""
    first_rows: I64
    """Row of the first entry of each data center's series, (B,)."""

    def at(self, index: I64, dc: I64) -> F64:
        """Rows ``index`` of the series of data centers ``dc``, repeating, (n, columns)."""
        return self.rows.take(self.first_rows[dc] + index % self.series.lengths[dc], axis=0)

    def made_from(self, series: FleetSeries) -> bool:
        """Whether the rows are those of ``series``."""
        return (
            self.series.values is series.values
            and np.array_equal(self.series.offsets, series.offsets)
            and np.array_equal(self.series.lengths, series.lengths)
        )


def _row_per_entry(series: FleetSeries, build: Callable[[F64], F64]) -> _RowPerEntry:
    """Build the rows, (entries, columns), of each distinct series once."""
    distinct, which = series.distinct()
    parts = [build(values) for values in distinct]
    first_rows = np.concatenate([[0], np.cumsum([len(part) for part in parts[:-1]])])
    return _RowPerEntry(series, np.concatenate(parts), first_rows.astype(np.int64)[which])


def _time_of_day_rows(steps_per_day: int) -> F64:
    """Cosine and sine of the time of day, 0..1, (steps per day, 2)."""
    share = np.array([round(step / steps_per_day, 3) for step in range(steps_per_day)])
    angle = 2.0 * np.pi * share
    return np.stack([0.5 + 0.5 * np.cos(angle), 0.5 + 0.5 * np.sin(angle)], axis=1)


def _ci_rows(series: F64) -> F64:
    """Value, slopes to come and past, and window columns, in g/kWh, (n, 8)."""
    following = _ahead(series, CI_STEPS)
    past = [np.roll(series, k) for k in range(PAST_STEPS, 0, -1)]
    slope_past = _weighted_sum(_smoothed_trend_weights(PAST_STEPS + 1), [*past, series])
    # A year has no past before its first hours: the released code then sees none.
    slope_past[:PAST_STEPS] = 0.0
    slope_next = _weighted_sum(_smoothed_trend_weights(CI_STEPS + 1), [series, *following])
    return np.column_stack([series, slope_next, slope_past, _window_columns(series, following)])


def _temperature_rows(series: F64) -> F64:
    """Value, slope to come, and window columns, in C, (n, 7)."""
    following = _ahead(series, TEMPERATURE_STEPS)
    slope = _weighted_sum(_trend_weights(TEMPERATURE_STEPS + 1), [series, *following])
    return np.column_stack([series, slope, _window_columns(series, following)])


def _window_columns(now: F64, following: Sequence[F64]) -> F64:
    """Mean, standard deviation, present excess over the mean, steps to peak and valley, (n, 5).

    Args:
        now: present values, (n,).
        following: values of each step of the window, (n,) each.
    """
    count = len(following)
    total = np.zeros_like(now)
    for value in following:
        total = total + value
    mean = total / count
    square = np.zeros_like(now)
    for value in following:
        square = square + (value - mean) ** 2
    path = [now, *following]
    # Central differences, one-sided at the ends, as in numpy.gradient; only the signs matter.
    slopes = [path[min(i + 1, count)] - path[max(i - 1, 0)] for i in range(count + 1)]
    peak, valley = np.full_like(now, count), np.full_like(now, count)
    for i in reversed(range(count)):
        peak = np.where((slopes[i] > 0) & (slopes[i + 1] <= 0), i, peak)
        valley = np.where((slopes[i] < 0) & (slopes[i + 1] >= 0), i, valley)
    return np.stack(
        [mean, np.sqrt(square / count), now - mean, peak / count, valley / count], axis=-1
    )


def _ahead(series: F64, steps: int) -> list[F64]:
    """The series as seen 1, 2, .. ``steps`` steps ahead, (n,) each."""
    return [np.roll(series, -k) for k in range(1, steps + 1)]


def _weighted_sum(weights: F64, values: Sequence[F64]) -> F64:
    """Sum of arrays times weights, in order."""
    total = np.zeros_like(values[0])
    for weight, value in zip(weights, values, strict=True):
        total = total + weight * value
    return total


def _trend_weights(points: int) -> F64:
    """Weights of the least-squares slope per step, (points,)."""
    position = np.arange(points) - (points - 1) / 2.0
    return np.asarray(position / np.sum(position**2))


def _smoothed_trend_weights(points: int) -> F64:
    """Weights of a least-squares slope per step over means of ``SMOOTHED_STEPS``, (points,)."""
    smoothed = points - SMOOTHED_STEPS + 1
    return np.convolve(_trend_weights(smoothed), np.full(SMOOTHED_STEPS, 1.0 / SMOOTHED_STEPS))


def extremes_ahead(series: F64, window: int) -> F64:
    """Least and greatest of each entry and those that follow within ``window``, (n, 2).

    Windows end with the series. Each one is the end of a block of ``window`` entries and the start
    of the next, so accumulated extremes of the blocks are enough (van Herk 1992).
    """
    count = len(series)
    blocks = -(-count // window) + 1

    def least(values: F64) -> F64:
        padded = np.full(blocks * window, np.inf)
        padded[:count] = values
        by_block = padded.reshape(blocks, window)
        forward = np.minimum.accumulate(by_block, axis=1).reshape(-1)
        backward = np.minimum.accumulate(by_block[:, ::-1], axis=1)[:, ::-1].reshape(-1)
        return np.minimum(backward[:count], forward[window - 1 : window - 1 + count])

    return np.stack([least(series), -least(-series)], axis=1)
