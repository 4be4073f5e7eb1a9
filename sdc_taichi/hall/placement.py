"""Placement of work: distribution of a data center's utilisation over its racks or server groups.

Bins are the places for work, racks or groups of equal servers, in one array for all data centers.
Work is conserved: the loads, weighted by the servers of each bin, sum to the utilisation, as far as
the usable servers suffice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.types import F64, I64

POLICIES = ("uniform", "fill", "coolest-first", "inlet-aware", "weights")
"""Policies by the names that ``workload.placement`` takes."""
MIN_HEADROOM_K = 0.1
"""Headroom, in K, that a bin at or above its limit counts as having under ``inlet-aware``."""
_LEAST_WEIGHT = 1e-100
"""Smallest weight over the largest of a data center; smaller positive weights count as this."""

Mask = npt.NDArray[np.bool_]


class PlacementError(SdcError):
    """Work cannot be placed as asked."""


@dataclass(frozen=True, slots=True)
class Bins:
    """Places for work in B data centers, n in all: racks, or groups of equal servers."""

    offsets: I64
    """First bin of each data center, and the number of bins, (B + 1,)."""
    dc: I64
    """Data center of each bin, (n,)."""
    names: tuple[str, ...]
    """Name of each data center, for errors, (B,)."""
    by_size: tuple[I64, ...]
    """Bins of the data centers of similar size, one row a data center; index n fills shorter rows
    up."""

    def sums(self, values: npt.NDArray[np.float64 | np.int64]) -> F64:
        """Sum of bin values, (n,), over each data center, (B,)."""
        return np.asarray(np.add.reduceat(values, self.offsets[:-1]), dtype=np.float64)

    def running_sums(self, values: F64) -> F64:
        """Sum of bin values over a bin and those before it in its data center, (n,)."""
        out, padded = np.empty(len(values) + 1), np.append(values, 0.0)
        for rows in self.by_size:
            out[rows] = np.cumsum(padded[rows], axis=1)
        return out[:-1]

    def later_sums(self, values: F64) -> F64:
        """Sum of bin values over those after a bin in its data center, (n,)."""
        out, padded = np.empty(len(values) + 1), np.append(values, 0.0)
        for rows in self.by_size:
            # Summed from the end: a difference from the total would lose small values.
            later = np.cumsum(padded[rows][:, :0:-1], axis=1)[:, ::-1]
            out[rows] = np.append(later, np.zeros((len(rows), 1)), axis=1)
        return out[:-1]

    def order(self, key: F64) -> I64:
        """Bins of each data center by rising key, ties by index, (n,)."""
        out, padded = np.empty(len(key) + 1, dtype=np.int64), np.append(key, np.inf)
        for rows in self.by_size:
            by_key = np.argsort(padded[rows], axis=1, kind="stable")
            out[rows] = np.take_along_axis(rows, by_key, axis=1)
        return out[:-1]


def make_bins(bin_offsets: npt.NDArray[np.integer], names: Sequence[str] = ()) -> Bins:
    """Arrange the bins of a fleet for ``place``; done once per fleet.

    Args:
        bin_offsets: First bin of each data center, and the number of bins, (B + 1,); each data
            center has a bin or more.
        names: Names of the data centers, for errors; none names them by their numbers.
    """
    offsets = np.asarray(bin_offsets, dtype=np.int64)
    sizes = np.diff(offsets)
    # One class per power of two: rows are at most half empty, and the classes few.
    size_class = np.ceil(np.log2(sizes)).astype(np.int64)
    by_size = []
    for chosen in (np.flatnonzero(size_class == c) for c in np.unique(size_class)):
        column = np.arange(sizes[chosen].max())
        inside = column < sizes[chosen, None]
        by_size.append(np.where(inside, offsets[chosen, None] + column, offsets[-1]))
    return Bins(
        offsets=offsets,
        dc=np.repeat(np.arange(len(sizes)), sizes),
        names=tuple(names) or tuple(f"data center {i}" for i in range(len(sizes))),
        by_size=tuple(by_size),
    )


def place(
    policy: str,
    utilisation: F64,
    *,
    bins: Bins,
    count: F64,
    capacity: F64,
    inlet_c: F64,
    limit_c: F64,
    weights: F64 | None = None,
) -> tuple[F64, F64]:
    """Spread the utilisation of each data center over its bins.

    - ``uniform``: the same load everywhere; where that exceeds a bin's capacity, the bins that have
      room share the rest evenly.
    - ``fill``: bins in order of their index, each up to its capacity.
    - ``coolest-first``: bins in order of their inlet temperature, those of equal rank
      (``air_metrics.rank``) by index, each up to its capacity.
    - ``inlet-aware``: loads in proportion to the headroom max(limit - inlet, ``MIN_HEADROOM_K``),
      up to capacity.
    - ``weights``: loads in proportion to ``weights``, up to capacity; weight 0 gets none, even when
      the others are full.

    Loads in proportion and up to capacity are min(capacity, level*weight), with one exact level for
    a data center: bins are full in the order in which a rising level fills them, as long as the
    work suffices.

    Args:
        policy: Name of a policy, see above.
        utilisation: Work as a share of all servers, at least 0, (B,).
        bins: Bins of the fleet, see ``make_bins``.
        count: Servers of each bin, above 0, (n,).
        capacity: Utilisation each bin may reach, 0..1, (n,).
        inlet_c: Last known inlet temperature of each bin, C, (n,).
        limit_c: Inlet temperature that ``inlet-aware`` keeps away from, C, (B,).
        weights: Relative loads, at least 0 and above 0 for a bin or more of each data center, (n,);
            for ``weights`` alone.

    Returns:
        Load of each bin, 0..capacity, (n,), and the utilisation really placed, (B,):
        min(utilisation, sum(count*capacity)/sum(count)), the sum of capacities over the bins that
        may be used. sum(count*load) = placed*sum(count) to rounding.

    Raises:
        PlacementError: weights that are negative, not finite, or all 0 in a data center.
    """
    if policy == "uniform":
        return _uniform(utilisation, bins, count, capacity)
    weight = np.ones(len(count))
    if weights is not None:
        weight = _relative_weights(weights, bins)
    elif policy == "inlet-aware":
        weight = np.maximum(limit_c[bins.dc] - inlet_c, MIN_HEADROOM_K)
    usable = np.where(weight > 0.0, capacity, 0.0)
    placed, work, full = _placeable(utilisation, bins, count, usable)
    if policy in ("fill", "coolest-first"):
        order = np.arange(len(count)) if policy == "fill" else bins.order(rank(inlet_c))
        load = _fill_in_order(order, work, bins, count, usable)
    else:
        load = _in_proportion(weight, work, bins, count, usable)
    return np.where(full[bins.dc], usable, load), placed


def _uniform(utilisation: F64, bins: Bins, count: F64, capacity: F64) -> tuple[F64, F64]:
    """Load of each bin, (n,), and utilisation placed, (B,), the same everywhere if it fits."""
    unhindered = utilisation <= np.minimum.reduceat(capacity, bins.offsets[:-1])
    if np.all(unhindered):
        return utilisation[bins.dc], utilisation.copy()
    placed, work, full = _placeable(utilisation, bins, count, capacity)
    load = _in_proportion(np.ones(len(count)), work, bins, count, capacity)
    load = np.where(full[bins.dc], capacity, load)
    # To the bit what a batch without a limited bin gets.
    load = np.where(unhindered[bins.dc], utilisation[bins.dc], load)
    return load, np.where(unhindered, utilisation, placed)


def _placeable(utilisation: F64, bins: Bins, count: F64, capacity: F64) -> tuple[F64, F64, Mask]:
    """Utilisation that fits, servers that it keeps busy, and whether it fills all, each (B,)."""
    servers = bins.sums(count)
    highest = bins.sums(count * capacity) / servers
    placed = np.minimum(utilisation, highest)
    return placed, placed * servers, utilisation >= highest


def _fill_in_order(order: I64, work: F64, bins: Bins, count: F64, capacity: F64) -> F64:
    """Load of bins that are filled in the given order, (n,)."""
    room = count * capacity
    in_order = bins.running_sums(room[order]) <= work[bins.dc]
    full = np.empty(len(room), dtype=np.bool_)
    full[order] = in_order
    load = np.where(full, capacity, 0.0)
    # The running sum only tells which bins are full; what is left for the next one is exact.
    rest = work - bins.sums(np.where(full, room, 0.0))
    position = bins.offsets[:-1] + np.add.reduceat(in_order.astype(np.int64), bins.offsets[:-1])
    some = position < bins.offsets[1:]
    following = order[position[some]]
    load[following] = np.clip(rest[some] / count[following], 0.0, capacity[following])
    return load


def _in_proportion(weight: F64, work: F64, bins: Bins, count: F64, capacity: F64) -> F64:
    """Load min(capacity, level*weight) with the level that places all work, (n,).

    Where the weight is 0, so is the capacity.
    """
    room, weighted = count * capacity, count * weight
    level_full = capacity / np.where(weight > 0.0, weight, 1.0)
    order = bins.order(level_full)
    # Work done when the level just fills a bin: all before it are full, those after it are not.
    at_level = bins.running_sums(room[order]) + level_full[order] * bins.later_sums(weighted[order])
    full = np.empty(len(room), dtype=np.bool_)
    full[order] = at_level <= work[bins.dc]
    rest = work - bins.sums(np.where(full, room, 0.0))
    open_weight = bins.sums(np.where(full, 0.0, weighted))
    some = open_weight > 0.0
    level = np.where(some, rest, 0.0) / np.where(some, open_weight, 1.0)
    return np.where(full, capacity, np.clip(level[bins.dc] * weight, 0.0, capacity))


def _relative_weights(values: F64, bins: Bins) -> F64:
    """Weights divided by the largest of their data center, (n,)."""
    wrong = np.flatnonzero(~(np.isfinite(values) & (values >= 0.0)))
    if len(wrong):
        dc = bins.dc[wrong[0]]
        raise PlacementError(
            f"{bins.names[dc]}: placement weight {wrong[0] - bins.offsets[dc]} is "
            f"{values[wrong[0]]}; valid is a finite number of at least 0"
        )
    largest = np.maximum.reduceat(values, bins.offsets[:-1])
    without = np.flatnonzero(largest == 0.0)
    if len(without):
        raise PlacementError(
            f"{bins.names[without[0]]}: all placement weights are 0; valid is at least one above 0"
        )
    relative = values / largest[bins.dc]
    return np.where(values > 0.0, np.maximum(relative, _LEAST_WEIGHT), 0.0)
