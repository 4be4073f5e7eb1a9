"""Weights of the exhaust mix of each rack, by distance from exhaust faces to its inlet face.

The exhaust mix of rack j is the mean outlet temperature of all source racks i with the weights
w_ji. A weight is proportional to exp(-d/decay) times the exhaust airflow of rack i, where d is the
length of the path from exhaust face to inlet face over the racks or around the ends of the rows.
The weights of each rack sum to 1. R is the number of racks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sdc_taichi.config import HallConfig, LayoutConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.floor_plan import floor_plan, row_distance_m
from sdc_taichi.types import F64, I32, I64

DENSE_RACKS = 64
"""Largest number of racks of a hall that stores all weights; larger halls drop weights below the
cutoff."""
MERGED_RACKS_PER_ROW = 64
"""Largest number of racks of a row for which weights of whole rows are stored, so that neighbouring
rows form one run."""
MOST_WEIGHTS = 2**27
"""Largest number of weights, or of runs, of a hall; this many weights take 1 GB in f64."""

_MOST_COPIED_WEIGHTS = 2**22
"""Largest number of weights of all runs that are copied to sum them faster; they take 34 MB."""


@dataclass(frozen=True)
class MixWeights:
    """Weights w of R racks, stored as runs of consecutive source racks.

    The product (w x)_j is norm_j times the sum of weights[run_first_weight + i] *
    strength[run_first_rack + i] * x[run_first_rack + i] over all runs of rack j and all
    i < run_length. Racks with identical surroundings share their entries of ``weights``.
    """

    run_offsets: I32
    """Index of the first run of each rack, and the number of runs, (R + 1,)."""
    run_first_rack: I32
    """Index of the first source rack of each run, (runs,)."""
    run_length: I32
    """Number of source racks of each run, (runs,)."""
    run_first_weight: I32
    """Index into ``weights`` for the first source rack of each run, (runs,)."""
    weights: F64
    """Relative weights of the sources, without the factors strength and norm, (weights,)."""
    strength: F64
    """Exhaust airflow of each rack divided by the mean of its hall, (R,). It is 1 for weights from
    a matrix file, which already include the airflow."""
    norm: F64
    """Factor of each rack that makes its weights sum to 1, (R,)."""

    def apply(self, values: F64) -> F64:
        """Return the product of weights and rack values, (R,): the mix of outlet temperatures."""
        out, strong = np.zeros(len(self.norm)), values * self.strength
        if len(out) <= DENSE_RACKS:
            for racks, sources, weights in self._slices():
                out += np.bincount(racks, weights * strong[sources], len(out))
            return out * self.norm
        of_run = np.zeros(len(self.run_length))
        windows = {n: sliding_window_view(strong, n) for n in np.unique(self.run_length) if n}
        for runs, first_rack, weights in self._run_batches:
            sources = windows[weights.shape[-1]][first_rack]
            # einsum adds in an order that does not depend on the number of threads or of runs.
            of_run[runs] = np.einsum("ij,ij->i", sources, weights)
        rack = np.repeat(np.arange(len(out)), np.diff(self.run_offsets))
        return np.asarray(np.bincount(rack, of_run, len(out)) * self.norm)

    @cached_property
    def _run_batches(self) -> list[tuple[I64, I32, F64]]:
        """Runs that are summed together, as their indices, first racks and weights.

        Runs of large halls are summed together if they share their weights, (1, length). In halls
        whose copied weights, (runs, length), fit into memory, all runs of equal length are.
        """
        key = self.run_length.astype(np.int64)
        copies = int(key.sum()) <= _MOST_COPIED_WEIGHTS
        if not copies:
            key += self.run_first_weight * (np.int64(1) + self.run_length.max())
        order = np.argsort(key, kind="stable")
        batches = []
        for runs in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            length = int(self.run_length[runs[0]])
            if length:
                first = self.run_first_weight[runs]
                every = sliding_window_view(self.weights, length)
                weights = every[first if copies else first[:1]]
                batches.append((runs, self.run_first_rack[runs], weights))
        return batches

    def apply_transposed(self, values: F64) -> F64:
        """Return the product of the transposed weights and rack values, (R,)."""
        out = np.zeros(len(self.norm))
        scaled = values * self.norm
        for racks, sources, weights in self._slices():
            out += np.bincount(sources, weights * scaled[racks], len(out))
        return out * self.strength

    def dense(self) -> F64:
        """Return the weights as a matrix, receiving racks by source racks, (R, R)."""
        racks = len(self.norm)
        out = np.zeros((racks, racks))
        for rows, sources, weights in self._slices():
            out[rows, sources] += weights
        return np.asarray(out * self.strength * self.norm[:, None])

    def row(self, rack: int) -> tuple[I64, F64]:
        """Return the n source racks of one rack, (n,), and their weights, which sum to 1, (n,)."""
        runs = slice(self.run_offsets[rack], self.run_offsets[rack + 1])
        lengths = self.run_length[runs]
        _, sources = items_of_ranges(self.run_first_rack[runs], lengths)
        weights = self.weights[items_of_ranges(self.run_first_weight[runs], lengths)[1]]
        return sources, np.asarray(weights * self.strength[sources] * self.norm[rack])

    def _slices(self) -> Iterator[tuple[Any, Any, F64]]:
        """Yield arrays (receiving rack, source rack, weight) for each position within the runs."""
        rack = np.repeat(np.arange(len(self.norm)), np.diff(self.run_offsets))
        # With the longest runs first, the runs that contain a position are a leading slice.
        order = np.argsort(-self.run_length, kind="stable")
        rack, first_rack = rack[order], self.run_first_rack[order]
        first_weight = self.run_first_weight[order]
        reaching = len(order) - np.cumsum(np.bincount(self.run_length))
        for i, runs in enumerate(reaching[:-1].tolist()):
            yield rack[:runs], first_rack[:runs] + i, self.weights[first_weight[:runs] + i]


_Runs = tuple[I32, I32, I32, I32]
"""Tuple of ``run_offsets``, ``run_first_rack``, ``run_length`` and ``run_first_weight``."""


def items_of_ranges(first: I32 | I64, lengths: I32 | I64) -> tuple[I64, I64]:
    """Return the items of n ranges of whole numbers, one range after another.

    Args:
        first: First item of each range, (n,).
        lengths: Number of items of each range, (n,).

    Returns:
        Index of the range of each item, and the items, (sum of the lengths,) each.
    """
    of_range = np.repeat(np.arange(len(lengths)), lengths)
    before = np.cumsum(lengths, dtype=np.int64) - lengths
    return of_range, np.arange(len(of_range)) + (first - before)[of_range]


def layout_weights(hall: HallConfig, airflow_m3s: F64 | None = None) -> MixWeights:
    """Compute the weights of a hall from its layout.

    The path from exhaust face to inlet face is the shorter of two paths: over the racks (rack
    height plus horizontal distance), or along the rows and around one of their ends.

    Args:
        hall: Configuration of the hall.
        airflow_m3s: Airflow of each rack at the design point, m3/s, (R,); None means equal
            airflows.

    Raises:
        ConfigError: The cutoff leaves a rack without sources, or leaves too many weights.
    """
    flow = np.ones(hall.racks) if airflow_m3s is None else airflow_m3s
    if hall.racks > DENSE_RACKS:
        return _normalised(*_truncated_weights(hall), flow)
    plan = floor_plan(hall)
    front, back = plan.front_m, plan.back_m
    path_m = _path_m(
        hall,
        front[:, None, 0],
        back[None, :, 0],
        np.abs(front[:, None, 1] - back[None, :, 1]),
        plan.row_ends_m,
    )
    return dense_weights(_path_weights(hall, path_m, path_m.min(axis=1, keepdims=True)), flow)


def dense_weights(weights: F64, airflow_m3s: F64 | None = None) -> MixWeights:
    """Build ``MixWeights`` that store all weights, with one run per rack.

    Args:
        weights: Relative weights of the sources (columns) for each receiving rack (rows), (R, R).
        airflow_m3s: Exhaust airflow of the sources, by which their weights are multiplied, m3/s,
            (R,); None means equal airflows.
    """
    racks = len(weights)
    index = np.arange(racks, dtype=np.int32)
    flow = np.ones(racks) if airflow_m3s is None else airflow_m3s
    runs = (
        np.arange(racks + 1, dtype=np.int32),
        np.zeros(racks, dtype=np.int32),
        np.full(racks, racks, dtype=np.int32),
        index * np.int32(racks),
    )
    return _normalised(runs, np.ascontiguousarray(weights).reshape(-1), flow)


def _normalised(runs: _Runs, weights: F64, airflow_m3s: F64) -> MixWeights:
    """Build ``MixWeights`` with norms that make the weights of each rack sum to 1."""
    strength = airflow_m3s / airflow_m3s.mean()
    racks = len(strength)
    sums = MixWeights(*runs, weights, strength, np.ones(racks)).apply(np.ones(racks))
    return MixWeights(*runs, weights, strength, 1.0 / sums)


def _path_m(
    hall: HallConfig, front_x: F64, back_x: F64, across: F64, row_ends: tuple[float, float]
) -> F64:
    """Return the length of the shorter path from exhaust faces to inlet faces, in m.

    Args:
        hall: Configuration of the hall, with the height of the racks.
        front_x: Coordinate x of the inlet faces, m.
        back_x: Coordinate x of the exhaust faces, m.
        across: Distance from exhaust to inlet faces in direction y, across the rows, m.
        row_ends: Coordinate x of both ends of the rows, m.
    """
    over = hall.layout.rack_height_m + np.hypot(front_x - back_x, across)
    around = np.minimum(*(np.abs(back_x - end) + np.abs(front_x - end) for end in row_ends))
    return np.asarray(np.minimum(over, around + across), dtype=np.float64)


def _path_weights(hall: HallConfig, path_m: F64, shortest_m: F64) -> F64:
    """Return the weights of a rack's sources divided by the weight of its nearest source.

    The factor ``norm`` of the rack cancels this scale, which prevents underflow.
    """
    return np.asarray(np.exp((shortest_m - path_m) / hall.recirculation.decay_m))


@dataclass(frozen=True, slots=True)
class _Window:
    """Range of rows and places that contains all sources within reach of a rack.

    A rack has place p in a row of P racks.
    """

    row_shifts: I64
    """Row of the source minus row of the rack, -S..S, (2 S + 1,)."""
    first_place: I64
    """First place of the sources in their row, for each place of the rack, (P,)."""
    end_place: I64
    """Place after the last source in its row, for each place of the rack, (P,)."""
    whole_rows: bool
    """True if the range contains whole rows, so that neighbouring rows form one run."""


@dataclass(frozen=True, slots=True)
class _Blocks:
    """Blocks of weights, one for each row parity (even or odd) and each of P places in a row.

    Rows of equal parity have the same orientation, so their racks share weights. The block of a
    rack contains the weights of its ``_Window``, row by row.
    """

    first_weight: I64
    """Index into ``weights`` of the first weight of each block, (2, P)."""
    first_near: I64
    """First source within reach in each row of the window, (2, P, 2 S + 1)."""
    end_near: I64
    """Place after the last source within reach in each row of the window, (2, P, 2 S + 1)."""
    weights: F64
    """Weights of all blocks, one after the other; 0 for sources beyond reach."""


def _truncated_weights(hall: HallConfig) -> tuple[_Runs, F64]:
    """Compute runs and weights above the cutoff, for halls of more than DENSE_RACKS racks.

    Every second row has the same surroundings, so weights are stored once for each row parity and
    place in a row.
    """
    reach_m = _reach_m(hall)
    window = _window(hall, reach_m)
    blocks = _weight_blocks(hall, window, reach_m)
    runs = _merged_runs(hall, window, blocks) if window.whole_rows else _runs(hall, window, blocks)
    return runs, blocks.weights


def _rack_x_m(hall: HallConfig) -> F64:
    """Return the distance of the P racks of a row from its first end, in m, (P,)."""
    places: F64 = np.arange(hall.racks_per_row, dtype=np.float64)
    return (places + 0.5) * hall.layout.rack_pitch_m


def _row_ends_m(hall: HallConfig) -> tuple[float, float]:
    """Return the distance of both ends of the rows from the first end, in m."""
    return 0.0, hall.racks_per_row * hall.layout.rack_pitch_m


def _across_m(measures: LayoutConfig, parity: int, shifts: I64) -> F64:
    """Return the distance in y from exhausts of rows parity + shifts to inlets of row parity.

    The distance is in m and has the shape of ``shifts``.
    """
    source = parity + shifts
    half = measures.rack_depth_m / 2
    inlet = row_distance_m(measures, np.array(parity)) + (half if parity == 0 else -half)
    exhaust = row_distance_m(measures, source) - np.where(source % 2 == 0, half, -half)
    return np.abs(inlet - exhaust)


def _reach_m(hall: HallConfig) -> float:
    """Return the length of the longest path whose weight is stored, in m.

    A weight is dropped if it is below the cutoff times the sum of weights of a rack in the middle
    of the hall. Path lengths are compared instead of weights, because weights may underflow.
    """
    rows, cutoff = hall.rows, hall.recirculation.cutoff
    x = _rack_x_m(hall)
    shifts = np.arange(-(rows // 2), rows - rows // 2)
    reach_m = np.inf
    for parity in (0, 1) if cutoff > 0 else ():
        across = _across_m(hall.layout, parity, shifts)[:, None]
        path_m = _path_m(hall, x[len(x) // 2], x, across, _row_ends_m(hall))
        total = _path_weights(hall, path_m, path_m.min()).sum()
        beyond_nearest_m = -hall.recirculation.decay_m * np.log(cutoff * total)
        reach_m = min(reach_m, float(path_m.min() + beyond_nearest_m))
    return reach_m


def _window(hall: HallConfig, reach_m: float) -> _Window:
    """Return the rows and places around a rack that paths of a given length may reach.

    Raises:
        ConfigError: The cutoff leaves more than ``MOST_WEIGHTS`` weights.
    """
    rows, per_row, measures = hall.rows, hall.racks_per_row, hall.layout
    # The distance of faces is smaller than that of the centre lines of rows by one rack depth.
    spacing_m = measures.rack_depth_m + min(measures.cold_aisle_m, measures.hot_aisle_m)
    row_reach = int(np.clip((reach_m + measures.rack_depth_m) / spacing_m, 0, rows - 1))
    place = np.arange(per_row)
    whole_rows = per_row <= MERGED_RACKS_PER_ROW
    if whole_rows:
        first_place, end_place = np.zeros_like(place), np.full_like(place, per_row)
    else:
        rack_reach = int(np.clip(reach_m / measures.rack_pitch_m, 0, per_row))
        first_place = np.maximum(place - rack_reach, 0)
        end_place = np.minimum(place + rack_reach + 1, per_row)
    row_shifts = np.arange(-row_reach, row_reach + 1)
    weights = 2 * len(row_shifts) * int(np.sum(end_place - first_place))
    runs = hall.racks * (1 if whole_rows else len(row_shifts))
    if max(weights, runs) > MOST_WEIGHTS:
        settings = hall.recirculation
        raise ConfigError(
            f"hall.recirculation.cutoff {settings.cutoff:g} with decay_m {settings.decay_m:g} "
            f"keeps {weights:.3g} weights for {hall.racks:,} racks; valid is at most "
            f"{MOST_WEIGHTS:,} (raise cutoff or lower decay_m)"
        )
    return _Window(row_shifts, first_place, end_place, whole_rows)


def _weight_blocks(hall: HallConfig, window: _Window, reach_m: float) -> _Blocks:
    """Compute the weights of the racks at every place of even and odd rows.

    Raises:
        ConfigError: The cutoff leaves a rack without sources.
    """
    x = _rack_x_m(hall)
    blocks = []
    first_near = np.zeros((2, len(x), len(window.row_shifts)), dtype=np.int64)
    end_near = np.zeros_like(first_near)
    for parity in (0, 1):
        across = _across_m(hall.layout, parity, window.row_shifts)[:, None]
        for place in range(len(x)):
            sources = slice(window.first_place[place], window.end_place[place])
            path_m = _path_m(hall, x[place], x[sources], across, _row_ends_m(hall))
            near = path_m <= reach_m
            if not near.any():
                raise _no_source(hall, place, float(reach_m - path_m.min()))
            first = np.argmax(near, axis=1)
            end = near.shape[1] - np.argmax(near[:, ::-1], axis=1)
            first_near[parity, place] = first
            end_near[parity, place] = np.where(near.any(axis=1), end, first)
            weights = _path_weights(hall, path_m, path_m.min())
            blocks.append(np.where(near, weights, 0.0).reshape(-1))
    first_weight = np.cumsum([0, *(len(block) for block in blocks)])[:-1].reshape(2, len(x))
    return _Blocks(first_weight, first_near, end_near, np.concatenate(blocks))


def _no_source(hall: HallConfig, place: int, short_of_reach_m: float) -> ConfigError:
    """Return the error for a rack whose nearest source is beyond reach."""
    cutoff, decay_m = hall.recirculation.cutoff, hall.recirculation.decay_m
    return ConfigError(
        f"hall.recirculation.cutoff {cutoff:g} with decay_m {decay_m:g} leaves racks at place "
        f"{place} of their rows without any source: their largest weight is "
        f"{cutoff * np.exp(short_of_reach_m / decay_m):.3g}; valid is a cutoff below that"
    )


def _shift_bounds(hall: HallConfig, window: _Window, row: I64) -> tuple[I64, I64]:
    """Return the first and the last row shift of the window inside the hall, for each row."""
    row_reach = int(window.row_shifts[-1])
    return np.maximum(-row_reach, -row), np.minimum(row_reach, hall.rows - 1 - row)


def _merged_runs(hall: HallConfig, window: _Window, blocks: _Blocks) -> _Runs:
    """Build one run per rack, which extends over neighbouring whole rows."""
    per_row, row_reach = hall.racks_per_row, window.row_shifts[-1]
    row, place = np.divmod(np.arange(hall.racks), per_row)
    first_shift, last_shift = _shift_bounds(hall, window, row)
    first_weight = blocks.first_weight[row % 2, place] + (first_shift + row_reach) * per_row
    return _as_runs(
        np.arange(hall.racks + 1),
        (row + first_shift) * per_row,
        (last_shift - first_shift + 1) * per_row,
        first_weight,
    )


def _runs(hall: HallConfig, window: _Window, blocks: _Blocks) -> _Runs:
    """Build one run per rack and row of its window, from first to last source within reach."""
    per_row, row_reach = hall.racks_per_row, window.row_shifts[-1]
    row, place = np.divmod(np.arange(hall.racks), per_row)
    first_shift, last_shift = _shift_bounds(hall, window, row)
    counts = last_shift - first_shift + 1
    run_offsets = np.concatenate([[0], np.cumsum(counts)])
    # The following arrays have one entry per run.
    rack = np.repeat(np.arange(hall.racks), counts)
    shift = first_shift[rack] + np.arange(len(rack)) - run_offsets[rack]
    row, place = row[rack], place[rack]
    begin = blocks.first_near[row % 2, place, shift + row_reach]
    end = blocks.end_near[row % 2, place, shift + row_reach]
    width = (window.end_place - window.first_place)[place]
    first_weight = blocks.first_weight[row % 2, place] + (shift + row_reach) * width + begin
    first_rack = (row + shift) * per_row + window.first_place[place] + begin
    return _as_runs(run_offsets, first_rack, end - begin, first_weight)


def _as_runs(run_offsets: I64, first_rack: I64, length: I64, first_weight: I64) -> _Runs:
    """Convert runs to the 32-bit integers that the kernels require."""
    return (
        run_offsets.astype(np.int32),
        first_rack.astype(np.int32),
        length.astype(np.int32),
        first_weight.astype(np.int32),
    )
