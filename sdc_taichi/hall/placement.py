"""Placement of work: distribution of a data center's utilisation over its racks or server groups.

A bin is a rack or a group of equal servers. The n bins of all B data centers are in one array. Work
is conserved as far as the capacity of the bins suffices: the mean of the loads, weighted by the
number of servers, equals the utilisation of the data center.
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
"""Names of the placement policies, the valid values of ``workload.placement``."""
MIN_HEADROOM_K = 0.1
"""Lower bound of the headroom of a bin under ``inlet-aware``, in K."""
_LEAST_WEIGHT = 1e-100
"""Lower bound of positive weights divided by the largest weight of the data center."""
CLEARLY_BELOW = 1.0 - 1e-9
"""Share of a bin's capacity below which its load is below the capacity in spite of rounding."""

Mask = npt.NDArray[np.bool_]


class PlacementError(SdcError):
    """Placement weights are invalid."""


@dataclass(frozen=True, slots=True)
class Bins:
    """The n bins (racks, or groups of equal servers) of B data centers."""

    offsets: I64
    """Index of the first bin of each data center, and the number of bins, (B + 1,)."""
    dc: I64
    """Index of the data center of each bin, (n,)."""
    names: tuple[str, ...]
    """Name of each data center, for error messages, (B,)."""
    by_size: tuple[I64, ...]
    """Matrices of bin indices, one for each class of data centers of similar size. Each row lists
    the bins of one data center, padded with the index n."""

    def sums(self, values: npt.NDArray[np.float64 | np.int64]) -> F64:
        """Return the sum of bin values, (n,), for each data center, (B,)."""
        return np.asarray(np.add.reduceat(values, self.offsets[:-1]), dtype=np.float64)

    def running_sums(self, values: F64) -> F64:
        """Return the cumulative sum of bin values within each data center, (n,)."""
        out, padded = np.empty(len(values) + 1), np.append(values, 0.0)
        for rows in self.by_size:
            out[rows] = np.cumsum(padded[rows], axis=1)
        return out[:-1]

    def later_sums(self, values: F64) -> F64:
        """Return the sum of values over all later bins of the same data center, (n,)."""
        out, padded = np.empty(len(values) + 1), np.append(values, 0.0)
        for rows in self.by_size:
            # Add from the last bin backwards: total minus cumulative sum would lose small values.
            later = np.cumsum(padded[rows][:, :0:-1], axis=1)[:, ::-1]
            out[rows] = np.append(later, np.zeros((len(rows), 1)), axis=1)
        return out[:-1]

    def order(self, key: F64) -> I64:
        """Return the bins of each data center sorted by ascending key, then by index, (n,)."""
        out, padded = np.empty(len(key) + 1, dtype=np.int64), np.append(key, np.inf)
        for rows in self.by_size:
            by_key = np.argsort(padded[rows], axis=1, kind="stable")
            out[rows] = np.take_along_axis(rows, by_key, axis=1)
        return out[:-1]


def make_bins(bin_offsets: npt.NDArray[np.integer], names: Sequence[str] = ()) -> Bins:
    """Arrange the bins of a fleet for ``place``; call this function once per fleet.

    Args:
        bin_offsets: Index of the first bin of each data center, and the number of bins, (B + 1,);
            each data center has at least one bin.
        names: Names of the data centers, for error messages; if empty, their numbers are used.
    """
    offsets = np.asarray(bin_offsets, dtype=np.int64)
    sizes = np.diff(offsets)
    # With one class per power of two, padding is at most half of a row and there are few classes.
    size_class = np.ceil(np.log2(sizes)).astype(np.int64)
    by_size = []
    for dcs in (np.flatnonzero(size_class == c) for c in np.unique(size_class)):
        column = np.arange(sizes[dcs].max())
        inside = column < sizes[dcs, None]
        by_size.append(np.where(inside, offsets[dcs, None] + column, offsets[-1]))
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
    """Distribute the utilisation of each data center over its bins.

    - ``uniform``: all bins have the same load. Work above the capacity of some bins is distributed
      evenly over the other bins.
    - ``fill``: bins are filled to capacity in the order of their index.
    - ``coolest-first``: bins are filled to capacity in the order of their inlet temperature. Bins
      of equal rank (``air_metrics.rank``) are filled in the order of their index.
    - ``inlet-aware``: loads are proportional to the headroom max(limit - inlet,
      ``MIN_HEADROOM_K``), up to capacity.
    - ``weights``: loads are proportional to ``weights``, up to capacity. Bins of weight 0 have no
      load, even if all others are full.

    Loads proportional to weights are min(capacity, level*weight). The level of a data center is
    computed exactly, and is such that all work is placed.

    Args:
        policy: Name of a policy, see above.
        utilisation: Work as a share of all servers, at least 0, (B,).
        bins: Bins of the fleet, see ``make_bins``.
        count: Number of servers of each bin, above 0, (n,).
        capacity: Highest utilisation of each bin, 0..1, (n,).
        inlet_c: Last known inlet temperature of each bin, C, (n,).
        limit_c: Upper limit of the inlet temperature for ``inlet-aware``, C, (B,).
        weights: Relative loads for policy ``weights``, at least 0, and above 0 for at least one bin
            of each data center, (n,).

    Returns:
        Load of each bin, 0..capacity, (n,), and the utilisation placed, (B,). The latter is
        min(utilisation, sum(count*capacity)/sum(count)), where the sum of capacities excludes bins
        of weight 0. Up to rounding errors, sum(count*load) = placed*sum(count).

    Raises:
        PlacementError: Weights are negative, not finite, or all 0 in a data center.
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
    """Return equal loads as far as capacity allows, (n,), and the utilisation placed, (B,)."""
    unhindered = utilisation <= np.minimum.reduceat(capacity, bins.offsets[:-1])
    if np.all(unhindered):
        return utilisation[bins.dc], utilisation.copy()
    placed, work, full = _placeable(utilisation, bins, count, capacity)
    load = _in_proportion(np.ones(len(count)), work, bins, count, capacity)
    load = np.where(full[bins.dc], capacity, load)
    # Unlimited data centers must have exactly the loads that the early return above gives.
    load = np.where(unhindered[bins.dc], utilisation[bins.dc], load)
    return load, np.where(unhindered, utilisation, placed)


def _placeable(utilisation: F64, bins: Bins, count: F64, capacity: F64) -> tuple[F64, F64, Mask]:
    """Return utilisation placed, its work in servers, and True if all bins are full, each (B,)."""
    servers = bins.sums(count)
    highest = bins.sums(count * capacity) / servers
    placed = np.minimum(utilisation, highest)
    return placed, placed * servers, utilisation >= highest


def _fill_in_order(order: I64, work: F64, bins: Bins, count: F64, capacity: F64) -> F64:
    """Return the loads of bins that are filled in the given order, (n,)."""
    room = count * capacity
    in_order = bins.running_sums(room[order]) <= work[bins.dc]
    full = np.empty(len(room), dtype=np.bool_)
    full[order] = in_order
    load = np.where(full, capacity, 0.0)
    # The cumulative sum determines only which bins are full; the rest is recomputed exactly.
    rest = work - bins.sums(np.where(full, room, 0.0))
    position = bins.offsets[:-1] + np.add.reduceat(in_order.astype(np.int64), bins.offsets[:-1])
    some = position < bins.offsets[1:]
    following = order[position[some]]
    load[following] = np.clip(rest[some] / count[following], 0.0, capacity[following])
    return load


def _in_proportion(weight: F64, work: F64, bins: Bins, count: F64, capacity: F64) -> F64:
    """Return loads min(capacity, level*weight) with the level that places all work, (n,).

    Bins of weight 0 must have capacity 0.
    """
    weighted = count * weight
    level = _ratio(work, bins.sums(weighted))
    load = level[bins.dc] * weight
    fits = (load < capacity * CLEARLY_BELOW) | (weight == 0.0)
    fits_all = np.logical_and.reduceat(fits, bins.offsets[:-1])
    if np.all(fits_all):
        return load
    if np.any(fits_all):
        # Most data centers of a batch usually have no full bins, which take most of the time.
        some = ~fits_all[bins.dc]
        load[some] = _in_proportion(
            weight[some], work[~fits_all], _part(bins, ~fits_all), count[some], capacity[some]
        )
        return load
    room = count * capacity
    level_full = capacity / np.where(weight > 0.0, weight, 1.0)
    order = bins.order(level_full)
    # Work placed at the level that just fills a bin: earlier bins are full, later ones are not.
    at_level = bins.running_sums(room[order]) + level_full[order] * bins.later_sums(weighted[order])
    full = np.empty(len(room), dtype=np.bool_)
    full[order] = at_level <= work[bins.dc]
    rest = work - bins.sums(np.where(full, room, 0.0))
    level = _ratio(rest, bins.sums(np.where(full, 0.0, weighted)))
    return np.where(full, capacity, np.clip(level[bins.dc] * weight, 0.0, capacity))


def _part(bins: Bins, chosen: Mask) -> Bins:
    """Return the bins of the chosen data centers, (B,)."""
    return make_bins(np.append(0, np.cumsum(np.diff(bins.offsets)[chosen])))


def _ratio(work: F64, weight: F64) -> F64:
    """Return work divided by weight, (B,); 0 where the weight is 0."""
    some = weight > 0.0
    return np.asarray(np.where(some, work, 0.0) / np.where(some, weight, 1.0))


def _relative_weights(values: F64, bins: Bins) -> F64:
    """Return weights divided by the largest weight of their data center, (n,)."""
    invalid = np.flatnonzero(~(np.isfinite(values) & (values >= 0.0)))
    if len(invalid):
        dc = bins.dc[invalid[0]]
        raise PlacementError(
            f"{bins.names[dc]}: placement weight {invalid[0] - bins.offsets[dc]} is "
            f"{values[invalid[0]]}; valid is a finite number of at least 0"
        )
    largest = np.maximum.reduceat(values, bins.offsets[:-1])
    all_zero = np.flatnonzero(largest == 0.0)
    if len(all_zero):
        raise PlacementError(
            f"{bins.names[all_zero[0]]}: all placement weights are 0; valid is at least one above 0"
        )
    relative = values / largest[bins.dc]
    return np.where(values > 0.0, np.maximum(relative, _LEAST_WEIGHT), 0.0)
