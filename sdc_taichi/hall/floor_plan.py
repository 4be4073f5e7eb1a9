"""Positions of racks and CRAC units, from the dimensions in ``hall.layout``.

Coordinates are in m from one corner of the room, with x along the rows and y across them. The
inlets of even rows face larger y and those of odd rows smaller y. Rows 0 and 1 thus share a cold
aisle, rows 1 and 2 a hot aisle, and so on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig, LayoutConfig
from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Floor plan of a hall of R racks, listed row by row."""

    centre_m: F64
    """Coordinates x and y of the rack centres, in m, (R, 2)."""
    front_m: F64
    """Coordinates x and y of the centres of the inlet faces, in m, (R, 2)."""
    back_m: F64
    """Coordinates x and y of the centres of the exhaust faces, in m, (R, 2)."""
    facing: npt.NDArray[np.int64]
    """1 for racks whose inlet faces larger y, -1 for racks whose inlet faces smaller y, (R,)."""
    row_ends_m: tuple[float, float]
    """Coordinate x of both ends of the rows, in m."""
    length_m: float
    """Length of the room along x, in m."""
    width_m: float
    """Width of the room along y, in m."""
    air_m3: float
    """Volume of the room minus that of the racks, in m3."""


def floor_plan(hall: HallConfig) -> FloorPlan:
    """Return the floor plan of a hall by the dimensions of its layout."""
    measures = hall.layout
    row = np.arange(hall.rows)
    facing = np.where(row % 2 == 0, 1, -1)
    row_y = measures.side_margin_m + measures.rack_depth_m / 2 + row_distance_m(measures, row)
    rack_x = measures.end_margin_m + (np.arange(hall.racks_per_row) + 0.5) * measures.rack_pitch_m
    centre = np.stack(np.broadcast_arrays(rack_x[None, :], row_y[:, None]), axis=-1).reshape(-1, 2)
    per_rack = np.repeat(facing, hall.racks_per_row)
    half = np.zeros_like(centre)
    half[:, 1] = per_rack * measures.rack_depth_m / 2
    row_length_m = hall.racks_per_row * measures.rack_pitch_m
    length_m = row_length_m + 2 * measures.end_margin_m
    width_m = float(row_y[-1]) + measures.rack_depth_m / 2 + measures.side_margin_m
    rack_m3 = measures.rack_pitch_m * measures.rack_depth_m * measures.rack_height_m
    return FloorPlan(
        centre_m=centre,
        front_m=centre + half,
        back_m=centre - half,
        facing=per_rack,
        row_ends_m=(measures.end_margin_m, measures.end_margin_m + row_length_m),
        length_m=length_m,
        width_m=width_m,
        air_m3=length_m * width_m * measures.ceiling_m - hall.racks * rack_m3,
    )


def row_distance_m(measures: LayoutConfig, row: npt.NDArray[np.int64]) -> F64:
    """Return the distance of the centre line of each row from that of row 0, in m.

    Args:
        measures: Layout with the depths of racks and aisles.
        row: Row numbers, any shape; numbers below 0 give negative distances.
    """
    cold = measures.rack_depth_m + measures.cold_aisle_m
    hot = measures.rack_depth_m + measures.hot_aisle_m
    return np.asarray(row // 2 * (cold + hot) + row % 2 * cold, dtype=np.float64)


def unit_places_m(plan: FloorPlan, units: int) -> F64:
    """Return x and y of the CRAC units, which alternate between both end walls, in m, (U, 2)."""
    index = np.arange(units)
    walls = index % 2
    on_wall = np.array([(units + 1) // 2, units // 2])[walls]
    y = (index // 2 + 0.5) / on_wall * plan.width_m
    return np.stack([walls * plan.length_m, y], axis=1)


def unit_shares(plan: FloorPlan, units: int, length_m: float) -> F64:
    """Return the share of each CRAC unit in the supply air of each rack, (R, U); rows sum to 1.

    A share is proportional to exp(-d/length_m), with the distance d from unit to inlet face.

    Args:
        plan: Floor plan of the hall.
        units: Number of CRAC units, U.
        length_m: Distance at which a share falls to 1/e, m.
    """
    return _shares_by_distance(plan.front_m, unit_places_m(plan, units), length_m)


def return_shares(plan: FloorPlan, units: int, length_m: float) -> F64:
    """Return the share of each CRAC unit in the returns of each rack, (R, U); rows sum to 1.

    A share is proportional to exp(-d/length_m), with the distance d from exhaust face to unit.
    Arguments as in ``unit_shares``.
    """
    return _shares_by_distance(plan.back_m, unit_places_m(plan, units), length_m)


def _shares_by_distance(face_m: F64, places: F64, length_m: float) -> F64:
    """Return shares of units at ``places``, (U, 2), for rack faces, (R, 2), in m; (R, U)."""
    distance = np.hypot(*np.moveaxis(face_m[:, None] - places[None], -1, 0))
    nearest = distance.min(axis=1, keepdims=True)
    weight = np.exp(-(distance - nearest) / length_m)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
