"""What depends on time alone, a row for every step of the year and distinct site, in observations.

Entries of an observation are of two kinds: those that depend on time alone, gathered from rows, and
the others, computed in every step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.drivers import Table
from sdc_taichi.types import F32, I64

TABLE_BYTES = 2**28
"""Most memory of one observer's tables; more series are read step by step."""


@dataclass(frozen=True, slots=True)
class TimeRows:
    """Rows of several data centers end to end; data center i reads ``length[i]`` of them."""

    values: npt.NDArray[Any]
    """(entries, columns)."""
    offset: I64
    length: I64

    def entries(self, index: I64) -> I64:
        """Where in ``values`` row ``index`` of every data center is, repeating, (B,)."""
        return self.offset + index % self.length

    def at(self, index: I64) -> npt.NDArray[Any]:
        """Row ``index`` of every data center, repeating, (B, columns)."""
        return self.values.take(self.entries(index), axis=0)


def time_rows(
    tables: Sequence[Table],
    read: Callable[[I64, I64], npt.NDArray[Any]],
    *,
    period: int,
    row_bytes: int,
) -> TimeRows | None:
    """Rows of all steps, once for data centers that read the same series.

    Args:
        tables: the series that the rows depend on.
        read: rows of steps ``index`` of data centers ``dc``, each (n,).
        period: steps after which the clock repeats, as far as the rows depend on it.
        row_bytes: of each row and what else is kept per step.

    Returns:
        None where the series of a data center are no rows of one length: they differ in length or
        end within a period; or where there are too many.
    """
    length = tables[0].length
    alike = all(np.array_equal(table.length, length) for table in tables)
    if not alike or np.any(length % period):
        return None
    places = np.stack([*(table.offset for table in tables), length], axis=1)
    _, first, which = np.unique(places, axis=0, return_index=True, return_inverse=True)
    lengths = length[first]
    if int(lengths.sum()) * row_bytes > TABLE_BYTES:
        return None
    parts = [read(np.arange(n), np.full(n, dc)) for dc, n in zip(first, lengths, strict=True)]
    offsets = np.cumsum(lengths) - lengths
    return TimeRows(np.concatenate(parts), offsets[which.reshape(-1)], length)


class Layout:
    """Where an observation takes its entries from.

    Args:
        columns: of each entry, in their order: below ``timed`` of what depends on time alone, from
            there on of the rest.
        timed: number of entries that depend on time alone.
    """

    def __init__(self, columns: Sequence[int], timed: int) -> None:
        given = np.array(columns)
        self.width = len(given)
        # Any for the others, which are written over.
        self._timed = np.where(given < timed, given, 0)
        starts = np.flatnonzero((np.diff(given, prepend=-2) != 1) | (given == timed)).tolist()
        # Others that stand side by side here and there.
        self._runs = [
            (slice(here, end), slice(first, first + end - here))
            for here, end in zip(starts, [*starts[1:], self.width], strict=True)
            if (first := int(given[here]) - timed) >= 0
        ]

    def of(self, rows: F32) -> F32:
        """Rows of this observation, (n, width), from rows of all that depends on time alone."""
        return rows.take(self._timed, axis=1)

    def filled(self, rows: F32, entries: I64 | None, others: F32) -> F32:
        """Observations, (B, width).

        Args:
            rows: what ``of`` gave.
            entries: row of each data center, (B,), or None where each has its own, which is then
                written to.
            others: the other entries, (m, B).
        """
        out = rows if entries is None else rows.take(entries, axis=0)
        for here, there in self._runs:
            out[:, here] = others[there].T
        return out
