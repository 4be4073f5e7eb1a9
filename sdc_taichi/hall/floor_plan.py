"""Where racks and CRAC units stand, from the measures of ``hall.layout``.

Coordinates in m: x along the rows, y across them, from one corner of the room. Even rows face
towards larger y, odd rows towards smaller y, so that rows 0 and 1 share a cold aisle, rows 1 and 2
a hot aisle, and so on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig, LayoutConfig
from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Floor plan of a hall of R racks, row by row."""

    centre_m: F64
    """Centres of the racks, x and y in m, (R, 2)."""
    front_m: F64
    """Middles of the inlet faces, x and y in m, (R, 2)."""
    back_m: F64
    """Middles of the exhaust faces, x and y in m, (R, 2)."""
    facing: npt.NDArray[np.int64]
    """1 where the inlet faces larger y, -1 where it faces smaller y, (R,)."""
    row_ends_m: tuple[float, float]
    """x of both ends of the rows, in m."""
    length_m: float
    """Length of the room along x, in m."""
    width_m: float
    """Width of the room along y, in m."""
    air_m3: float
    """Volume of the room less that of the racks, in m3."""


def floor_plan(hall: HallConfig) -> FloorPlan:
    """Floor plan of a hall, with racks placed row by row by the measures of its layout."""
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
    """Distance of the middle of each row from that of row 0, in m.

    Args:
        measures: Depths of racks and aisles.
        row: Row numbers, any shape; numbers below 0 give negative distances.
    """
    cold = measures.rack_depth_m + measures.cold_aisle_m
    hot = measures.rack_depth_m + measures.hot_aisle_m
    return np.asarray(row // 2 * (cold + hot) + row % 2 * cold, dtype=np.float64)


def unit_places_m(plan: FloorPlan, units: int) -> F64:
    """Places of the CRAC units along both end walls in turn, x and y in m, (U, 2).

    Args:
        plan: Floor plan of the hall.
        units: Number of CRAC units, U.
    """
    index = np.arange(units)
    walls = index % 2
    on_wall = np.array([(units + 1) // 2, units // 2])[walls]
    y = (index // 2 + 0.5) / on_wall * plan.width_m
    return np.stack([walls * plan.length_m, y], axis=1)


def unit_shares(plan: FloorPlan, units: int, length_m: float) -> F64:
    """Share of each CRAC unit in the supply of each rack, (R, U); rows sum to 1.

    A share falls with the distance from unit to inlet face as exp(-distance/length).

    Args:
        plan: Floor plan of the hall.
        units: Number of CRAC units, U.
        length_m: Distance over which a share falls to 1/e, m.
    """
    places = unit_places_m(plan, units)
    distance = np.hypot(*np.moveaxis(plan.front_m[:, None] - places[None], -1, 0))
    nearest = distance.min(axis=1, keepdims=True)
    weight = np.exp(-(distance - nearest) / length_m)
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))
