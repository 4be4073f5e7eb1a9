"""Weights of the exhaust mix before each rack, by how easily each exhaust reaches its inlet.

The weight w_ji of source rack i for rack j falls with the length d of the path from exhaust face to
inlet face, exp(-d/decay), over the racks or around the ends of the rows, times the exhaust airflow
of the source. The weights of each rack sum to 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.config import HallConfig, LayoutConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.floor_plan import floor_plan, row_distance_m
from sdc_taichi.types import F64, I32, I64

DENSE_RACKS = 64
"""Largest number of racks of a hall that keeps every weight; larger halls drop weights below the
cutoff."""
MERGED_RACKS_PER_ROW = 64
"""Largest number of racks of a row that is kept whole, so that neighbouring rows make one run."""
MOST_WEIGHTS = 2**27
"""Largest number of weights, or of runs, of a hall; they take 1 GB in f64."""


@dataclass(frozen=True, slots=True)
class MixWeights:
    """Weights w of R racks as runs of neighbouring source racks.

    (w x)_j = norm_j * sum of weights[run_first_weight + i] * strength[run_first_rack + i] *
    x[run_first_rack + i] over the runs of rack j and i below their length. Racks that see the same
    surroundings share their weights.
    """

    run_offsets: I32
    """First run of each rack, and the number of runs, (R + 1,)."""
    run_first_rack: I32
    """First source rack of each run, (runs,)."""
    run_length: I32
    """Source racks of each run, (runs,)."""
    run_first_weight: I32
    """Entry of ``weights`` that belongs to the first source rack of each run, (runs,)."""
    weights: F64
    """Relative weights of the sources, before strength and norm, (weights,)."""
    strength: F64
    """Exhaust airflow of each rack over the mean of its hall, (R,); 1 with a user's matrix, whose
    weights already hold it."""
    norm: F64
    """Factor of each rack that makes its weights sum to 1, (R,)."""

    def apply(self, values: F64) -> F64:
        """Product w x of the weights and rack values, (R,): the exhaust mix of outlet values."""
        out, strong = np.zeros(len(self.norm)), values * self.strength
        for racks, sources, weights in self._slices():
            out += np.bincount(racks, weights * strong[sources], len(out))
        return out * self.norm

    def apply_transposed(self, values: F64) -> F64:
        """Product of the transposed w and rack values, (R,)."""
        out = np.zeros(len(self.norm))
        scaled = values * self.norm
        for racks, sources, weights in self._slices():
            out += np.bincount(sources, weights * scaled[racks], len(out))
        return out * self.strength

    def dense(self) -> F64:
        """W as a matrix, receiving racks by source racks, (R, R)."""
        racks = len(self.norm)
        out = np.zeros((racks, racks))
        for rows, sources, weights in self._slices():
            out[rows, sources] += weights
        return np.asarray(out * self.strength * self.norm[:, None])

    def row(self, rack: int) -> tuple[I64, F64]:
        """Source racks of one rack, (n,), and their weights, which sum to 1, (n,)."""
        runs = slice(self.run_offsets[rack], self.run_offsets[rack + 1])
        lengths = self.run_length[runs]
        within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        sources = np.repeat(self.run_first_rack[runs], lengths) + within
        weights = self.weights[np.repeat(self.run_first_weight[runs], lengths) + within]
        return sources, np.asarray(weights * self.strength[sources] * self.norm[rack])

    def _slices(self) -> Iterator[tuple[Any, Any, F64]]:
        """Entries (row, column, weight), one position within the runs at a time."""
        rack = np.repeat(np.arange(len(self.norm)), np.diff(self.run_offsets))
        # Longest first, so that the runs that reach a position are the first ones.
        order = np.argsort(-self.run_length, kind="stable")
        rack, first_rack = rack[order], self.run_first_rack[order]
        first_weight = self.run_first_weight[order]
        reaching = len(order) - np.cumsum(np.bincount(self.run_length))
        for i, runs in enumerate(reaching[:-1].tolist()):
            yield rack[:runs], first_rack[:runs] + i, self.weights[first_weight[:runs] + i]


_Runs = tuple[I32, I32, I32, I32]
"""``run_offsets``, ``run_first_rack``, ``run_length`` and ``run_first_weight``."""


def layout_weights(hall: HallConfig, airflow_m3s: F64 | None = None) -> MixWeights:
    """Weights of a hall from its layout.

    A path from exhaust face to inlet face is the shorter of two: up and over the racks (rack height
    plus distance), or along the rows and around one of their ends.

    Args:
        hall: Rows, measures and the decay length.
        airflow_m3s: Airflow of each rack at the design point, m3/s, (R,); None is the same for all.

    Raises:
        ConfigError: a cutoff that leaves a rack no source, or more weights than fit.
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
    """Weights of a hall as one run over all racks for each rack.

    Args:
        weights: Relative weights of the sources (columns) for each rack (rows), (R, R).
        airflow_m3s: Exhaust airflow of the sources that multiplies them, m3/s, (R,); None is 1.
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
    """Weights with the norms that make those of each rack sum to 1."""
    strength = airflow_m3s / airflow_m3s.mean()
    racks = len(strength)
    sums = MixWeights(*runs, weights, strength, np.ones(racks)).apply(np.ones(racks))
    return MixWeights(*runs, weights, strength, 1.0 / sums)


def _path_m(
    hall: HallConfig, front_x: F64, back_x: F64, across: F64, row_ends: tuple[float, float]
) -> F64:
    """Length of the shorter path from exhaust faces to inlet faces, in m.

    Args:
        hall: Gives the height of the racks.
        front_x: x of the inlet faces, m.
        back_x: x of the exhaust faces, m.
        across: Distance from exhaust to inlet faces across the rows, m.
        row_ends: x of both ends of the rows, m.
    """
    over = hall.layout.rack_height_m + np.hypot(front_x - back_x, across)
    around = np.minimum(*(np.abs(back_x - end) + np.abs(front_x - end) for end in row_ends))
    return np.asarray(np.minimum(over, around + across), dtype=np.float64)


def _path_weights(hall: HallConfig, path_m: F64, shortest_m: F64) -> F64:
    """Weights of a rack's sources divided by that of its nearest; the scale cancels in its norm."""
    return np.asarray(np.exp((shortest_m - path_m) / hall.recirculation.decay_m))


@dataclass(frozen=True, slots=True)
class _Window:
    """Sources around a rack at place p of a row of P that may lie within reach."""

    row_shifts: I64
    """Rows of the sources less the row of the rack, -S..S, (2 S + 1,)."""
    first_place: I64
    """First place of the sources in their rows, (P,)."""
    end_place: I64
    """Place after the last source in their rows, (P,)."""
    whole_rows: bool
    """Whether rows are kept whole, so that those beside each other make one run."""


@dataclass(frozen=True, slots=True)
class _Blocks:
    """Weights of a rack by the parity of its row and its place p in a row of P.

    Rows of one parity face alike, so that their racks share weights. The block of a rack holds the
    weights of its window, row by row.
    """

    first_weight: I64
    """Where the block of each parity and place begins, (2, P)."""
    first_near: I64
    """First source within reach in each row of the window, (2, P, 2 S + 1)."""
    end_near: I64
    """Place after the last source within reach in each row of the window, (2, P, 2 S + 1)."""
    weights: F64
    """Weights of all blocks, 0 beyond reach."""


def _truncated_weights(hall: HallConfig) -> tuple[_Runs, F64]:
    """Runs and weights of the sources above the cutoff, for halls of more than DENSE_RACKS.

    Every second row sees the same surroundings, so that weights are kept once for each parity and
    place in a row.
    """
    reach_m = _reach_m(hall)
    window = _window(hall, reach_m)
    blocks = _weight_blocks(hall, window, reach_m)
    runs = _merged_runs(hall, window, blocks) if window.whole_rows else _runs(hall, window, blocks)
    return runs, blocks.weights


def _rack_x_m(hall: HallConfig) -> F64:
    """X of the racks of a row from its end, in m, (P,)."""
    places: F64 = np.arange(hall.racks_per_row, dtype=np.float64)
    return (places + 0.5) * hall.layout.rack_pitch_m


def _row_ends_m(hall: HallConfig) -> tuple[float, float]:
    """X of both ends of the rows, in m, from the first."""
    return 0.0, hall.racks_per_row * hall.layout.rack_pitch_m


def _across_m(measures: LayoutConfig, parity: int, shifts: I64) -> F64:
    """Distance across the rows from exhausts of rows a + shifts to inlets of row a, in m."""
    source = parity + shifts
    half = measures.rack_depth_m / 2
    inlet = row_distance_m(measures, np.array(parity)) + (half if parity == 0 else -half)
    exhaust = row_distance_m(measures, source) - np.where(source % 2 == 0, half, -half)
    return np.abs(inlet - exhaust)


def _reach_m(hall: HallConfig) -> float:
    """Longest path whose weight is kept, in m.

    A weight is dropped below the cutoff times the sum of weights of a rack amid the hall. Weights
    are compared by their paths, since a weight by itself may be too small for a number.
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
    """Rows and places around a rack that paths of a given length may reach.

    Raises:
        ConfigError: more weights than fit.
    """
    rows, per_row, measures = hall.rows, hall.racks_per_row, hall.layout
    # Racks are nearer than their rows by the depth of one.
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
    """Weights of racks at every place of rows of both parities.

    Raises:
        ConfigError: a cutoff that leaves a rack no source.
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
    """Error of a rack whose nearest source lies beyond reach."""
    cutoff, decay_m = hall.recirculation.cutoff, hall.recirculation.decay_m
    return ConfigError(
        f"hall.recirculation.cutoff {cutoff:g} with decay_m {decay_m:g} leaves racks at place "
        f"{place} of their rows without any source: their largest weight is "
        f"{cutoff * np.exp(short_of_reach_m / decay_m):.3g}; valid is a cutoff below that"
    )


def _shift_bounds(hall: HallConfig, window: _Window, row: I64) -> tuple[I64, I64]:
    """First and last row shift of the window that lies within the hall, for racks of given rows."""
    row_reach = int(window.row_shifts[-1])
    return np.maximum(-row_reach, -row), np.minimum(row_reach, hall.rows - 1 - row)


def _merged_runs(hall: HallConfig, window: _Window, blocks: _Blocks) -> _Runs:
    """One run for each rack, over whole rows beside each other."""
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
    """One run for each rack and each row of its window, from first to last source within reach."""
    per_row, row_reach = hall.racks_per_row, window.row_shifts[-1]
    row, place = np.divmod(np.arange(hall.racks), per_row)
    first_shift, last_shift = _shift_bounds(hall, window, row)
    counts = last_shift - first_shift + 1
    run_offsets = np.concatenate([[0], np.cumsum(counts)])
    # Each run has a rack, a row of sources, and the row and place of its rack.
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
    """Runs as the 32-bit integers that the kernels take."""
    return (
        run_offsets.astype(np.int32),
        first_rack.astype(np.int32),
        length.astype(np.int32),
        first_weight.astype(np.int32),
    )
