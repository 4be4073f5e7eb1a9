"""Halls as images and as voxels: which pixel and which voxel is which rack, and what they show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.floor_plan import FloorPlan, floor_plan
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, Reals

Shots = npt.NDArray[np.float32]

QUANTUM_K = 1 / 16
"""Resolution of temperatures: exact in half precision below 64 C, and it compresses well."""
LIMITS_C = {"inlet": (10.0, 45.0), "outlet": (10.0, 60.0)}
"""Ranges of the temperatures, so that colours mean the same in every recording."""
COLOURMAPS: dict[str, Literal["inferno", "viridis"]] = {
    "inlet": "inferno",
    "outlet": "inferno",
    "power": "viridis",
}
"""Perceptually uniform, and legible to people who are colour-blind."""
GAPS_UP_TO_RACKS = 5_000
SMALL_RACKS = 200


class Scale(NamedTuple):
    """Range and resolution of a heat map."""

    low: float
    high: float
    quantum: float
    unit: str


def temperature_scale(what: str) -> Scale:
    """Of a temperature of ``LIMITS_C``."""
    return Scale(*LIMITS_C[what], QUANTUM_K, "C")


def power_scale(fleet: Fleet) -> Scale:
    """From 0 to the nameplate power of the fleet's largest rack with a tenth for its fans, in kW.

    The upper end is rounded up to 1, 2 or 5 times a power of ten; the resolution is the power of
    two that half precision holds exactly over this range.
    """
    nameplate_w = np.concatenate([count * full_w for count, full_w, *_ in fleet.group_rows])
    largest_kw = float(fleet.group_sums(nameplate_w).max()) * 1.1 / 1e3
    decade = 10.0 ** np.floor(np.log10(largest_kw))
    high = float(decade * next(n for n in (1, 2, 5, 10) if n * decade >= largest_kw * (1 - 1e-9)))
    return Scale(0.0, high, float(2.0 ** np.ceil(np.log2(high / 2048))), "kW")


def quantised(values: Reals, scale: Scale) -> Shots:
    """Values in steps of the resolution and within the range, f32.

    What is below the range, or nan, the viewer in a browser draws as hot.
    """
    steps = np.rint(values.astype(np.float32) * np.float32(1.0 / scale.quantum))
    found = np.clip(steps * np.float32(scale.quantum), scale.low, scale.high)
    return np.asarray(found, dtype=np.float32)


class Tiles(NamedTuple):
    """How a hall becomes an image: rows of the hall downwards, racks of a row to the right."""

    rows: int
    racks_per_row: int
    height: int
    """Pixels of a rack."""
    width: int
    gap: int
    """Pixels between racks."""

    @property
    def image(self) -> tuple[int, int]:
        """Height and width of the image."""
        return (
            self.rows * (self.height + self.gap) - self.gap,
            self.racks_per_row * (self.width + self.gap) - self.gap,
        )


def tiles(hall: HallConfig) -> Tiles:
    """Tiles shaped so that a hall is about 1.8 times as wide as high (tiles at most 8:1)."""
    ratio = min(max(1.8 * hall.rows / hall.racks_per_row, 1 / 8), 8.0)
    short = 4 if hall.racks <= SMALL_RACKS else 2 if hall.racks <= GAPS_UP_TO_RACKS else 1
    return Tiles(
        rows=hall.rows,
        racks_per_row=hall.racks_per_row,
        height=round(short / min(ratio, 1.0)),
        width=round(short * max(ratio, 1.0)),
        gap=1 if hall.racks <= GAPS_UP_TO_RACKS else 0,
    )


def pixels(racks: Reals, shape: Tiles, scale: Scale) -> npt.NDArray[np.float16]:
    """Images (T, height, width) of rack values (T, R); gaps have the lower end of the range."""
    rows, per_row, height, width, gap = shape
    shots, count = racks.shape
    # A value for the gaps follows those of the racks, and a line of gaps those of the rows.
    values = np.full((shots, count + 1), scale.low, dtype=np.float16)
    values[:, :count] = quantised(racks, scale)
    across = np.full((rows + 1, per_row, width + gap), count)
    across[:rows, :, :width] = np.arange(count).reshape(rows, per_row, 1)
    down = np.full((rows, height + gap), rows)
    down[:, :height] = np.arange(rows).reshape(rows, 1)
    lines = values.take(across.reshape(rows + 1, -1)[:, : shape.image[1]], axis=1)
    return lines.take(down.reshape(-1)[: shape.image[0]], axis=1)


def legend(scale: Scale) -> tuple[Shots, list[float]]:
    """A gradient over the range, one pixel high per tenth of its width, and the marked values."""
    width, height = 240, 10
    gradient = np.tile(np.linspace(scale.low, scale.high, width, dtype=np.float32), (height, 1))
    span = scale.high - scale.low
    each = next(
        n for k in (1e-3, 1e-2, 0.1, 1, 10, 100, 1e3) for n in (k, 2 * k, 5 * k) if span / n <= 8
    )
    count = int(np.floor(span / each + 1e-9))
    return gradient, [scale.low + i * each for i in range(count + 1)]


class Voxels(NamedTuple):
    """Racks as voxels of half a rack's depth, so that a rack has a front and a back.

    Voxels lie on one grid, so aisles are rounded to half a rack's depth.
    """

    size_m: tuple[float, float, float]
    front: I64
    """Grid indices of the front of every rack and zone, from the floor up, rack by rack,
    (R zones, 3)."""
    back: I64
    zones: int


def voxels(hall: HallConfig, zones: int) -> Voxels:
    """Voxels of a hall whose racks are cut into zones of equal height."""
    plan, measures = floor_plan(hall), hall.layout
    half_m = measures.rack_depth_m / 2
    x = np.tile(np.arange(hall.racks_per_row), hall.rows)
    low = np.rint((plan.centre_m[:, 1] - half_m) / half_m).astype(np.int64)
    # The front is the half with larger y where racks face that way.
    ahead = (plan.facing > 0).astype(np.int64)
    z = np.arange(zones)

    def indices(y: I64) -> I64:
        columns = np.broadcast_arrays(x[:, None], y[:, None], z[None, :])
        return np.stack(columns, axis=-1).reshape(-1, 3)

    return Voxels(
        size_m=(measures.rack_pitch_m, half_m, measures.rack_height_m / zones),
        front=indices(low + ahead),
        back=indices(low + 1 - ahead),
        zones=zones,
    )


def outline_m(plan: FloorPlan, height_m: float) -> list[list[tuple[float, float, float]]]:
    """Lines around the floor and the ceiling of a hall."""
    corners = [(0.0, 0.0), (plan.length_m, 0.0), (plan.length_m, plan.width_m), (0.0, plan.width_m)]
    return [[(x, y, z) for x, y in (*corners, corners[0])] for z in (0.0, height_m)]


class Zones(NamedTuple):
    """What the zones of all racks of some data centers show."""

    groups: I64
    """Server groups in each zone, all of whose servers have the same values; counted over the
    groups of these data centers."""
    starts: I64
    """First of these in each zone, rack by rack from the floor up."""


def zones_of(fleet: Fleet, dcs: Sequence[int], zones: Sequence[int]) -> Zones:
    """Zones of data centers whose racks have so many zones each, and at least as many servers."""
    groups: list[I64] = []
    starts: list[I64] = []
    earlier = 0
    for dc, heights in zip(dcs, zones, strict=True):
        racks = np.arange(*fleet.rack_offsets[dc : dc + 2])
        first_group, end_group = fleet.group_offsets[fleet.rack_offsets[dc : dc + 2]].tolist()
        of_groups = fleet.server_offsets[first_group:end_group]
        first = fleet.server_offsets[fleet.group_offsets[racks]].astype(np.int64)
        count = fleet.server_offsets[fleet.group_offsets[racks + 1]] - first
        # Server j of n stands in zone j * zones // n.
        before = (np.arange(heights) * count[:, None] + heights - 1) // heights
        zone_first = (first[:, None] + before).reshape(-1)
        own = np.union1d(zone_first, of_groups)
        starts.append(np.searchsorted(own, zone_first) + sum(map(len, groups)))
        groups.append(np.searchsorted(of_groups, own, side="right") - 1 + earlier)
        earlier += len(of_groups)
    return Zones(np.concatenate(groups), np.concatenate(starts))


def zone_peaks(layers: Shots, zones: Zones) -> Shots:
    """Highest value of each zone, (..., zones), in layers of the groups, (..., G)."""
    of_groups = layers[..., zones.groups]
    if len(zones.starts) == len(zones.groups):
        return of_groups
    return np.asarray(np.maximum.reduceat(of_groups, zones.starts, axis=-1))


def unit_boxes_m(places_m: F64, plan: FloorPlan, height_m: float) -> F64:
    """Centres of boxes for CRAC units whose places are on the end walls, outside of the room."""
    outside = np.where(places_m[:, 0] > plan.length_m / 2, 0.5, -0.5)
    return np.stack(
        [places_m[:, 0] + outside, places_m[:, 1], np.full(len(places_m), height_m / 2)], axis=1
    )
