"""Observation entries that depend on time alone, gathered from rows computed once.

An observation has entries of two kinds. Time entries (clock, weather, carbon intensity, arriving
work) depend on the step of the year and the site alone: one row for every step and distinct site,
read by all data centers of that site. Measured entries (queue, hall, battery) are computed in every
step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.types import F32, I64

MAX_ROW_BYTES = 2**28
"""Most memory that the rows of one observer take, in bytes; series that need more are read
in stretches."""
STRETCH_BYTES = 2**23
"""Memory of the rows of a stretch, in bytes."""
_ENDLESS = 2**62
"""Length of rows that do not repeat, in steps."""


@dataclass(frozen=True, slots=True)
class TimeRows:
    """Rows of several series end to end, and which of them each data center reads."""

    values: npt.NDArray[Any]
    """Rows of all distinct series end to end, (rows, columns)."""
    first_rows: I64
    """First row that each data center reads, (B,)."""
    lengths: I64
    """Number of rows after which the series of each data center repeats, (B,)."""

    def row_numbers(self, index: I64) -> I64:
        """Row of ``values`` that each data center reads at step ``index`` of its series, (B,)."""
        return self.first_rows + index % self.lengths

    def at(self, index: I64) -> npt.NDArray[Any]:
        """Rows of all data centers at step ``index`` of their series, (B, columns)."""
        return self.values.take(self.row_numbers(index), axis=0)


def time_rows(
    series: Sequence[FleetSeries],
    read: Callable[[I64, I64], npt.NDArray[Any]],
    *,
    period: int,
    row_bytes: int,
) -> TimeRows | None:
    """Compute the rows of all steps, once for data centers that read the same series.

    Args:
        series: the series that the rows depend on, each for all data centers.
        read: computes rows, (n, columns), from steps of the year, (n,), and data centers, (n,).
        period: steps after which the clock repeats, as far as the rows depend on it.
        row_bytes: memory of a row and of whatever else is kept per row, in bytes.

    Returns:
        None where there can be no such rows: the series of a data center differ in length, end
        within a period, or need more memory than ``MAX_ROW_BYTES``.
    """
    length = series[0].lengths
    alike = all(np.array_equal(one.lengths, length) for one in series)
    if not alike or np.any(length % period):
        return None
    places = np.stack([*(one.offsets for one in series), length], axis=1)
    _, first, which = np.unique(places, axis=0, return_index=True, return_inverse=True)
    lengths = length[first]
    if int(lengths.sum()) * row_bytes > MAX_ROW_BYTES:
        return None
    parts = [read(np.arange(n), np.full(n, dc)) for dc, n in zip(first, lengths, strict=True)]
    first_rows = np.cumsum(lengths) - lengths
    return TimeRows(np.concatenate(parts), first_rows[which.reshape(-1)], length)


class RowStretches:
    """Rows of an episode, computed for some steps ahead at a time.

    They are computed once for data centers that read the same series from the same step on.

    Args:
        series: the series that the rows depend on, each for all data centers.
        read: computes rows, (n, columns), from steps of the year, (n,), and data centers, (n,).
        start: first step of each data center in the year, (B,).
        most_steps: largest number of steps of a stretch.
        row_bytes: memory of a row and of whatever else is kept per row, in bytes.
    """

    def __init__(
        self,
        series: Sequence[FleetSeries],
        read: Callable[[I64, I64], npt.NDArray[Any]],
        *,
        start: I64,
        most_steps: int,
        row_bytes: int,
    ) -> None:
        places = [start, *(a for one in series for a in (one.offsets, one.lengths))]
        _, first, which = np.unique(
            np.stack(places, axis=1), axis=0, return_index=True, return_inverse=True
        )
        self._read, self._start, self._first = read, start, first
        # Few enough rows that the processor keeps them in its cache.
        self._steps = min(max(STRETCH_BYTES // (len(first) * row_bytes), 1), most_steps)
        self._dcs = np.repeat(first, self._steps)
        self._first_rows = which.reshape(-1) * self._steps - start
        self._lengths = np.full(len(start), _ENDLESS, dtype=np.int64)

    def beginning_at(self, step: int) -> tuple[TimeRows, range]:
        """Rows of the stretch that begins at a step, and the steps that they are for."""
        steps = range(step, step + self._steps)
        index = self._start[self._first][:, None] + np.array(steps)
        rows = self._read(index.reshape(-1), self._dcs)
        return TimeRows(rows, self._first_rows - step, self._lengths), steps


class EntryOrder:
    """The order of an observation's entries, taken from time entries and measured entries.

    Args:
        columns: where each entry of the observation comes from: below ``time_width`` the column of
            a time row, from there on ``time_width`` plus the row of the measured entries.
        time_width: number of time entries that a row has.

    Attributes:
        width: number of entries of the observation.
    """

    def __init__(self, columns: Sequence[int], time_width: int) -> None:
        given = np.array(columns)
        self.width = len(given)
        # Places of measured entries take any time entry and are written over afterwards.
        self._time_columns = np.where(given < time_width, given, 0)
        breaks = np.diff(given, prepend=-2) != 1
        run_starts = np.flatnonzero(breaks | (given == time_width)).tolist()
        # Measured entries that are neighbours in the observation and in their source are copied
        # together.
        self._measured_runs = [
            (slice(here, end), slice(source, source + end - here))
            for here, end in zip(run_starts, [*run_starts[1:], self.width], strict=True)
            if (source := int(given[here]) - time_width) >= 0
        ]

    def arrange(self, time_rows: F32) -> F32:
        """Time rows, (n, time_width), in the order of this observation, (n, width)."""
        return time_rows.take(self._time_columns, axis=1)

    def assemble(self, arranged: F32, row_numbers: I64 | None, measured: F32) -> F32:
        """Observations of all data centers, (B, width).

        Args:
            arranged: rows that ``arrange`` gave, (n, width).
            row_numbers: row of each data center, (B,); None if ``arranged`` has a row for each,
                which is then written to.
            measured: measured entries of all data centers, (m, B).
        """
        out = arranged if row_numbers is None else arranged.take(row_numbers, axis=0)
        for here, source in self._measured_runs:
            out[:, here] = measured[source].T
        return out
