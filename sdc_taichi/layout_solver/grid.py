"""Grid of a hall for the layout solver: cells whose faces lie on racks, aisles and containment."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.floor_plan import FloorPlan, floor_plan
from sdc_taichi.types import F64, I32

MOST_CELLS = 4_000_000
"""About 2 GB on two threads."""
CELL_RANGE_M = (0.05, 2.0)
DEFAULT_CELL_M = 0.3
LEAST_LEAK = 1e-3
"""Share of its free area that containment always leaves open: gaps, and a flow that must balance
even where racks draw more than their closed aisle is given."""

_EDGE = (0.25, 0.5)
"""Cells at the edges of racks, in cells: potential flow is singular there."""
_CELL_HEIGHT = 0.5
"""Height of a cell over its length: halls are flat, and aisles are stratified."""
_AROUND = ((-1, 0, 0), (0, -1, 0), (0, 0, -1), (1, 0, 0), (0, 1, 0), (0, 0, 1))
_WEST, _FRONT, _FLOOR, _EAST, _BACK, _CEILING = range(6)


@dataclass(frozen=True, slots=True)
class Runs:
    """Faces of racks: the cells before them and the flow through each, rack by rack."""

    start: I32
    """(R + 1,)."""
    cell: I32
    m3s: F64


@dataclass(frozen=True, slots=True)
class Grid:
    """N cells of air. Arrays have a last entry for no cell, where all is 0 and areas are 1."""

    widths_m: tuple[F64, F64, F64]
    """Cells along the rows, across them, and from the floor up; solid ones included."""
    beyond: I32
    """Cell beyond each face, N if none, (N + 1, 6)."""
    conductance_m: F64
    """Free area over the distance of the centres, (N + 1, 6)."""
    boundary_m3s: F64
    """Flow that leaves the hall through a face, (N + 1, 6)."""
    area_m2: F64
    """Of the faces across each axis, (N + 1, 3)."""
    fronts: Runs
    backs: Runs
    supply_cell: I32
    supply_m3s: F64
    return_cell: I32
    return_m3s: F64

    @property
    def cells(self) -> int:
        """Cells that hold air."""
        return len(self.beyond) - 1


def build_grid(hall: HallConfig, airflow_m3s: F64, supply_m3s: float, cell_m: float) -> Grid:
    """Cut the hall into cells and place racks, tiles, returns and containment.

    Every measure of the layout is a whole number of cells, at most ``cell_m`` long and half as
    high. Floor tiles fill the cold aisles between the row ends. What an aisle is given, and what is
    taken above it with ceiling returns, goes by the airflow of the racks that face it; with returns
    in the end walls it leaves evenly above the height of the racks.

    Args:
        hall: shape of the hall.
        airflow_m3s: of each rack, (R,).
        supply_m3s: of all floor tiles.
        cell_m: longest cell.

    Raises:
        ConfigError: a cell length out of range, or more cells than memory is made for.
    """
    low_m, high_m = CELL_RANGE_M
    if not low_m <= cell_m <= high_m:
        raise ConfigError(f"cell_m {cell_m:g}: valid is {low_m:g}..{high_m:g} m")
    measures = hall.layout
    margin, pitch = measures.end_margin_m, measures.rack_pitch_m
    along = [margin, *[pitch] * hall.racks_per_row, margin]
    plan = floor_plan(hall)
    across = _strips_m(plan, hall)
    up = [measures.rack_height_m, measures.ceiling_m - measures.rack_height_m]
    ends = (0, hall.racks_per_row) if margin else ()
    x, rack_of_x = _cut(along, cell_m, ends)
    y, strip_of_y = _cut(across, cell_m, range(len(across) - 1))
    z, level = _cut(up, cell_m * _CELL_HEIGHT, (0,))
    boxes = len(x) * len(y) * len(z)
    if boxes > MOST_CELLS:
        raise ConfigError(
            f"cell_m {cell_m:g}: a hall of {plan.length_m:.4g} x {plan.width_m:.4g} x "
            f"{measures.ceiling_m:.4g} m makes {boxes:,} cells; valid is at most {MOST_CELLS:,}, "
            "with longer cells"
        )
    rack_of_x -= 1
    beside = (rack_of_x >= 0) & (rack_of_x < hall.racks_per_row)
    aisle_of_y = np.where(strip_of_y % 2 == 0, strip_of_y // 2, -1)
    low = level == 0

    air = ~(beside[:, None, None] & (aisle_of_y < 0)[None, :, None] & low)
    cells = int(air.sum())
    number = np.full(air.shape, cells, np.int32)
    number[air] = np.arange(cells, dtype=np.int32)
    in_cold = (aisle_of_y >= 0) & (aisle_of_y % 2 == 1)
    cold = beside[:, None, None] & in_cold[None, :, None] & low
    leak = max(1.0 - measures.containment, LEAST_LEAK)
    beyond, conductance, area = _links((x, y, z), number, cells, cold, leak)

    boundary = np.zeros((cells + 1, 6))
    fronts, backs = [], []
    for rack, flow in enumerate(airflow_m3s):
        row, place = divmod(rack, hall.racks_per_row)
        xs, ys = np.flatnonzero(rack_of_x == place), np.flatnonzero(strip_of_y == 2 * row + 1)
        share = x[xs][:, None] * z[low]
        m3s = (flow * share / share.sum()).ravel()
        after, before = ys[-1] + 1, ys[0] - 1
        forward = plan.facing[rack] > 0
        ahead, behind = (after, before) if forward else (before, after)
        front = number[xs[:, None], ahead, np.flatnonzero(low)].ravel()
        back = number[xs[:, None], behind, np.flatnonzero(low)].ravel()
        boundary[front, _FRONT if forward else _BACK] += m3s
        boundary[back, _BACK if forward else _FRONT] -= m3s
        fronts.append((front, m3s))
        backs.append((back, m3s))

    row_m3s = airflow_m3s.reshape(hall.rows, -1).sum(axis=1)
    tiles = np.zeros((len(x), len(y)))
    grilles = np.zeros((len(x), len(y)))
    for aisle in range(hall.rows + 1):
        drawn = row_m3s[max(aisle - 1, 0) : aisle + 1].sum() / row_m3s.sum()
        floor = np.where(beside, x, 0.0)[:, None] * np.where(aisle_of_y == aisle, y, 0.0)
        into = tiles if aisle % 2 else grilles
        into += supply_m3s * drawn * floor / floor.sum()
    supply = _place(boundary, number[:, :, 0], tiles, _FLOOR, -1.0)
    if measures.returns == "ceiling":
        returns = _place(boundary, number[:, :, -1], grilles, _CEILING, 1.0)
    else:
        wall = y[:, None] * np.where(low, 0.0, z)
        wall *= supply_m3s / (2.0 * wall.sum())
        west = _place(boundary, number[0], wall, _WEST, 1.0)
        east = _place(boundary, number[-1], wall, _EAST, 1.0)
        returns = (np.concatenate([west[0], east[0]]), np.concatenate([west[1], east[1]]))
    return Grid(
        (x, y, z), beyond, conductance, boundary, area, _runs(fronts), _runs(backs), *supply,
        *returns,
    )  # fmt: skip


def _strips_m(plan: FloorPlan, hall: HallConfig) -> F64:
    """Depths of aisles and rows in turn, across the hall."""
    row_y = plan.centre_m[:: hall.racks_per_row, 1]
    half = hall.layout.rack_depth_m / 2
    sides = np.stack([row_y - half, row_y + half], axis=1).ravel()
    return np.diff(sides, prepend=0.0, append=plan.width_m)


def _cut(lengths_m: Iterable[float], cell_m: float, edges: Sequence[int]) -> tuple[F64, I32]:
    """Widths of the cells of consecutive segments, and the segment of each.

    ``edges`` are the segments after which an edge of a rack lies. Each segment has two cells or
    more, so that none hides a gradient.
    """
    widths, owner = [], []
    for segment, length in enumerate(lengths_m):
        if length == 0:
            continue
        low = list(_EDGE) if segment - 1 in edges else []
        high = list(_EDGE[::-1]) if segment in edges else []
        edged = sum(low) + sum(high)
        middle = max(0 if edged else 2, int(np.ceil(length / cell_m - edged - 1e-9)))
        parts = np.array([*low, *[1.0] * middle, *high])
        widths.append(parts * (length / parts.sum()))
        owner.append(np.full(len(parts), segment, np.int32))
    return np.concatenate(widths), np.concatenate(owner)


def _links(
    widths_m: tuple[F64, F64, F64],
    number: I32,
    cells: int,
    cold: npt.NDArray[np.bool_],
    leak: float,
) -> tuple[I32, F64, F64]:
    """Neighbours, conductances and face areas of all cells."""
    air = number < cells
    shape = number.shape
    beyond = np.full((cells + 1, 6), cells, np.int32)
    conductance = np.zeros((cells + 1, 6))
    area = np.ones((cells + 1, 3))
    size = [np.reshape(w, [-1 if a == b else 1 for b in range(3)]) for a, w in enumerate(widths_m)]
    for axis in range(3):
        first, second = size[(axis + 1) % 3], size[(axis + 2) % 3]
        across = np.broadcast_to(first * second, shape)
        area[:-1, axis] = across[air]
        below = tuple(slice(None, -1) if a == axis else slice(None) for a in range(3))
        above = tuple(slice(1, None) if a == axis else slice(None) for a in range(3))
        both = air[below] & air[above]
        distance = (size[axis][below] + size[axis][above]) / 2.0
        free = np.where(cold[below] != cold[above], leak, 1.0)
        value = (across[below] * free / distance)[both]
        here, there = number[below][both], number[above][both]
        beyond[here, axis + 3], beyond[there, axis] = there, here
        conductance[here, axis + 3] = conductance[there, axis] = value
    return beyond, conductance, area


def _place(boundary: F64, numbers: I32, m3s: F64, face: int, sign: float) -> tuple[I32, F64]:
    """Let air through the faces where ``m3s`` is positive; gives the cells and their flows."""
    there = m3s > 0
    cell, flow = numbers[there], m3s[there]
    boundary[cell, face] += sign * flow
    return cell, flow


def _runs(faces: Sequence[tuple[I32, F64]]) -> Runs:
    counts = [len(cell) for cell, _ in faces]
    return Runs(
        start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        cell=np.concatenate([cell for cell, _ in faces]),
        m3s=np.concatenate([m3s for _, m3s in faces]),
    )
