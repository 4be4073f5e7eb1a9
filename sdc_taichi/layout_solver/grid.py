"""Grid of a hall for the layout solver, with cell faces aligned to racks, aisles and containment.

R is the number of racks, N the number of air cells, and X x Y x Z the size of the grid.
"""

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
"""Largest number of cells of a grid, solid cells included; it needs about 4 GB on two threads."""
CELL_RANGE_M = (0.05, 2.0)
"""Smallest and largest valid cell length, in m."""
DEFAULT_CELL_M = 0.3
"""Default cell length, in m."""
LEAST_LEAK = 1e-3
"""Smallest share of the free area that containment leaves open. It represents gaps, and lets the
flow balance even where racks draw more air than the floor tiles of their aisle supply."""

_EDGE = (0.25, 0.5)
"""Lengths of the two cells next to a rack edge, divided by the usual cell length. They are short
because potential flow is singular at edges."""
_CELL_HEIGHT = 0.5
"""Height of a cell divided by its length. Cells are flat because temperatures vary with height."""
_WEST, _FRONT, _FLOOR, _EAST, _BACK, _CEILING = range(6)


@dataclass(frozen=True, slots=True)
class RackFaces:
    """Cell faces at the inlet side or the exhaust side of R racks, listed rack by rack."""

    face_offsets: I32
    """Index of the first face of each rack, and the number of faces, (R + 1,)."""
    cell: I32
    """Index of the air cell adjacent to each face, (faces,)."""
    m3s: F64
    """Airflow through each face, in m3/s, (faces,)."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Grid of N air cells with six faces each, and the airflows through the hall's boundaries.

    Arrays over cells have a dummy last entry, where areas are 1 and all other values 0. The faces
    of a cell are in the order west (smaller x), front (smaller y), floor, east, back, ceiling.
    """

    widths_m: tuple[F64, F64, F64]
    """Widths of the cells along the rows, across the rows, and upwards, in m, for air and solid
    cells."""
    beyond: I32
    """Index of the neighbouring cell at each face, N if there is none, (N + 1, 6)."""
    conductance_m: F64
    """Free area of each face divided by the distance of the cell centres, in m, (N + 1, 6)."""
    boundary_m3s: F64
    """Flow that leaves the air of the hall through each face, in m3/s, (N + 1, 6)."""
    area_m2: F64
    """Area of the faces normal to each axis, in m2, (N + 1, 3)."""
    fronts: RackFaces
    """Inlet faces of the racks."""
    backs: RackFaces
    """Exhaust faces of the racks."""
    supply_cell: I32
    """Cells above floor tiles, (tile cells,)."""
    supply_m3s: F64
    """Supply air into each cell above floor tiles, in m3/s, (tile cells,)."""
    return_cell: I32
    """Cells adjacent to return air openings, (return cells,)."""
    return_m3s: F64
    """Return air that leaves through each of the return cells, in m3/s, (return cells,)."""

    @property
    def cells(self) -> int:
        """Number of air cells, N."""
        return len(self.beyond) - 1


def build_grid(hall: HallConfig, airflow_m3s: F64, supply_m3s: float, cell_m: float) -> Grid:
    """Divide the hall into cells and place racks, tiles, returns and containment.

    Every dimension of the layout is a whole number of cells, which are at most ``cell_m`` long and
    half as high. Floor tiles fill the cold aisles between the row ends. The supply air of a cold
    aisle is proportional to the airflow of the racks that face it, and the return air above a hot
    aisle to that of the racks adjacent to it. Returns in the end walls are above the height of the
    racks and have a uniform air speed.

    Args:
        hall: Configuration of the hall.
        airflow_m3s: Airflow of each rack, m3/s, (R,).
        supply_m3s: Total airflow of the floor tiles, m3/s.
        cell_m: Largest cell length, m.

    Raises:
        ConfigError: The cell length is out of range, or the grid has too many cells.
    """
    plan = floor_plan(hall)
    cuts = _cut_hall(hall, plan, cell_m)
    beyond, conductance, area = _links(cuts, hall)
    boundary = np.zeros((cuts.cells + 1, 6))
    fronts, backs = _place_racks(boundary, cuts, hall, plan, airflow_m3s)
    supply, returns = _place_tiles_and_returns(boundary, cuts, hall, airflow_m3s, supply_m3s)
    return Grid(
        cuts.widths_m, beyond, conductance, boundary, area, fronts, backs, *supply, *returns
    )


@dataclass(frozen=True, slots=True)
class _Cuts:
    """Division of a hall into X x Y x Z cells, of which those inside racks are solid."""

    widths_m: tuple[F64, F64, F64]
    """Widths of the cells along the rows, across the rows, and upwards, in m."""
    place_of_x: I32
    """Place in the row of the racks at each x index, (X,); -1 or the number of racks per row in the
    margins."""
    strip_of_y: I32
    """Number of the strip at each y index, (Y,); aisles have even and rows odd numbers."""
    low: npt.NDArray[np.bool_]
    """True for z indices below the top of the racks, (Z,)."""
    beside: npt.NDArray[np.bool_]
    """True for x indices between the row ends, (X,)."""
    number: I32
    """Index of each air cell, and the number of air cells for solid cells, (X, Y, Z)."""
    cells: int
    """Number of air cells."""

    @property
    def aisle_of_y(self) -> I32:
        """Number of the aisle at each y index, (Y,); -1 in rows. Odd aisles are cold."""
        return np.where(self.strip_of_y % 2 == 0, self.strip_of_y // 2, -1)


def _cut_hall(hall: HallConfig, plan: FloorPlan, cell_m: float) -> _Cuts:
    """Divide a hall into cells and number the air cells.

    Raises:
        ConfigError: The cell length is out of range, or the grid has too many cells.
    """
    low_m, high_m = CELL_RANGE_M
    if not low_m <= cell_m <= high_m:
        raise ConfigError(f"cell_m {cell_m:g}: valid is {low_m:g}..{high_m:g} m")
    measures = hall.layout
    margin, pitch = measures.end_margin_m, measures.rack_pitch_m
    along = [margin, *[pitch] * hall.racks_per_row, margin]
    across = _strips_m(plan, hall)
    up = [measures.rack_height_m, measures.ceiling_m - measures.rack_height_m]
    ends = (0, hall.racks_per_row) if margin else ()
    x, segment_of_x = _cut(along, cell_m, ends)
    y, strip_of_y = _cut(across, cell_m, range(len(across) - 1))
    z, level = _cut(up, cell_m * _CELL_HEIGHT, (0,))
    boxes = len(x) * len(y) * len(z)
    if boxes > MOST_CELLS:
        raise ConfigError(
            f"cell_m {cell_m:g}: a hall of {plan.length_m:.4g} x {plan.width_m:.4g} x "
            f"{measures.ceiling_m:.4g} m makes {boxes:,} cells; valid is at most {MOST_CELLS:,}, "
            "with longer cells"
        )
    place_of_x = segment_of_x - 1
    beside = (place_of_x >= 0) & (place_of_x < hall.racks_per_row)
    low, in_row = level == 0, strip_of_y % 2 == 1
    air = ~(beside[:, None, None] & in_row[None, :, None] & low)
    cells = int(air.sum())
    number = np.full(air.shape, cells, np.int32)
    number[air] = np.arange(cells, dtype=np.int32)
    return _Cuts((x, y, z), place_of_x, strip_of_y, low, beside, number, cells)


def _place_racks(
    boundary: F64, cuts: _Cuts, hall: HallConfig, plan: FloorPlan, airflow_m3s: F64
) -> tuple[RackFaces, RackFaces]:
    """Add the airflow of the racks to ``boundary`` and return their inlet and exhaust faces.

    Args:
        boundary: Flow that leaves the hall through each face, m3/s, (N + 1, 6); changed in place.
        cuts: Cells of the hall.
        hall: Configuration of the hall.
        plan: Floor plan with the orientation of the racks.
        airflow_m3s: Airflow of each rack, m3/s, (R,).
    """
    x, _, z = cuts.widths_m
    number, low_z = cuts.number, np.flatnonzero(cuts.low)
    fronts, backs = [], []
    for rack, flow in enumerate(airflow_m3s):
        row, place = divmod(rack, hall.racks_per_row)
        xs = np.flatnonzero(cuts.place_of_x == place)
        ys = np.flatnonzero(cuts.strip_of_y == 2 * row + 1)
        share = x[xs][:, None] * z[cuts.low]
        m3s = (flow * share / share.sum()).ravel()
        after, before = ys[-1] + 1, ys[0] - 1
        forward = plan.facing[rack] > 0
        ahead, behind = (after, before) if forward else (before, after)
        front = number[xs[:, None], ahead, low_z].ravel()
        back = number[xs[:, None], behind, low_z].ravel()
        boundary[front, _FRONT if forward else _BACK] += m3s
        boundary[back, _BACK if forward else _FRONT] -= m3s
        fronts.append((front, m3s))
        backs.append((back, m3s))
    return _rack_faces(fronts), _rack_faces(backs)


def _place_tiles_and_returns(
    boundary: F64, cuts: _Cuts, hall: HallConfig, airflow_m3s: F64, supply_m3s: float
) -> tuple[tuple[I32, F64], tuple[I32, F64]]:
    """Add supply and return air to ``boundary`` and return cells and flows, in m3/s, of both.

    ``supply_m3s`` is the total airflow of the floor tiles; other arguments are as in
    ``_place_racks``.
    """
    x, y, z = cuts.widths_m
    number, aisle_of_y = cuts.number, cuts.aisle_of_y
    row_m3s = airflow_m3s.reshape(hall.rows, -1).sum(axis=1)
    tiles = np.zeros((len(x), len(y)))
    grilles = np.zeros((len(x), len(y)))
    for aisle in range(hall.rows + 1):
        drawn = row_m3s[max(aisle - 1, 0) : aisle + 1].sum() / row_m3s.sum()
        floor = np.where(cuts.beside, x, 0.0)[:, None] * np.where(aisle_of_y == aisle, y, 0.0)
        into = tiles if aisle % 2 else grilles
        into += supply_m3s * drawn * floor / floor.sum()
    supply = _open_faces(boundary, number[:, :, 0], tiles, _FLOOR, -1.0)
    if hall.layout.returns == "ceiling":
        return supply, _open_faces(boundary, number[:, :, -1], grilles, _CEILING, 1.0)
    wall = y[:, None] * np.where(cuts.low, 0.0, z)
    wall *= supply_m3s / (2.0 * wall.sum())
    west_cell, west_m3s = _open_faces(boundary, number[0], wall, _WEST, 1.0)
    east_cell, east_m3s = _open_faces(boundary, number[-1], wall, _EAST, 1.0)
    returns = np.concatenate([west_cell, east_cell]), np.concatenate([west_m3s, east_m3s])
    return supply, returns


def _strips_m(plan: FloorPlan, hall: HallConfig) -> F64:
    """Return the depths of alternating aisles and rows across the hall, in m, (2 rows + 1,)."""
    row_y = plan.centre_m[:: hall.racks_per_row, 1]
    half = hall.layout.rack_depth_m / 2
    sides = np.stack([row_y - half, row_y + half], axis=1).ravel()
    return np.diff(sides, prepend=0.0, append=plan.width_m)


def _cut(lengths_m: Iterable[float], cell_m: float, edges: Sequence[int]) -> tuple[F64, I32]:
    """Divide consecutive segments into cells; return cell widths, in m, and segment numbers.

    Each segment has at least two cells, so that gradients within it are resolved.

    Args:
        lengths_m: Lengths of the segments, m.
        cell_m: Largest cell length, m.
        edges: Numbers of the segments that end at a rack edge.
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


def _links(cuts: _Cuts, hall: HallConfig) -> tuple[I32, F64, F64]:
    """Compute the neighbours, conductances and face areas of all air cells.

    Containment closes the faces between cold aisles (below the top of the racks) and the rest of
    the hall, except for a leak.

    Returns:
        ``beyond``, ``conductance_m`` and ``area_m2`` of ``Grid``.
    """
    number, cells, aisle_of_y = cuts.number, cuts.cells, cuts.aisle_of_y
    in_cold_aisle = (aisle_of_y >= 0) & (aisle_of_y % 2 == 1)
    cold = cuts.beside[:, None, None] & in_cold_aisle[None, :, None] & cuts.low
    leak = max(1.0 - hall.layout.containment, LEAST_LEAK)
    air = number < cells
    beyond = np.full((cells + 1, 6), cells, np.int32)
    conductance = np.zeros((cells + 1, 6))
    area = np.ones((cells + 1, 3))
    size = [
        np.reshape(width, [-1 if a == b else 1 for b in range(3)])
        for a, width in enumerate(cuts.widths_m)
    ]
    for axis in range(3):
        first, second = size[(axis + 1) % 3], size[(axis + 2) % 3]
        across = np.broadcast_to(first * second, number.shape)
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


def _open_faces(boundary: F64, numbers: I32, m3s: F64, face: int, sign: float) -> tuple[I32, F64]:
    """Add positive flows of ``m3s`` to ``boundary``; return their cells and values.

    Args:
        boundary: Flow that leaves the hall through each face, m3/s, (N + 1, 6); changed in place.
        numbers: Indices of the cells of one layer of the hall.
        m3s: Flow through a face of each of these cells, m3/s.
        face: Index of the face, 0..5.
        sign: 1 if the flow leaves the hall, -1 if it enters.
    """
    there = m3s > 0
    cell, flow = numbers[there], m3s[there]
    boundary[cell, face] += sign * flow
    return cell, flow


def _rack_faces(faces: Sequence[tuple[I32, F64]]) -> RackFaces:
    """Concatenate the cells and flows of all racks into ``RackFaces``."""
    counts = [len(cell) for cell, _ in faces]
    return RackFaces(
        face_offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        cell=np.concatenate([cell for cell, _ in faces]),
        m3s=np.concatenate([m3s for _, m3s in faces]),
    )
