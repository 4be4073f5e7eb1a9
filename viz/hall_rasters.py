"""Raster data of halls for recordings: heat maps with a tile per rack, and 3D voxels of racks."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32, I64, Reals

TEMPERATURE_RESOLUTION_K = 1 / 16
"""Step to which recorded temperatures are rounded, in K.

Half precision represents multiples of this step exactly below 64 C, and they compress well.
"""
TEMPERATURE_RANGES_C = {"inlet": (10.0, 45.0), "outlet": (10.0, 60.0)}
"""Range of the colour map of each temperature, in C; fixed, so that recordings are comparable."""
COLOURMAPS: dict[str, Literal["inferno", "viridis"]] = {
    "inlet": "inferno",
    "outlet": "inferno",
    "power": "viridis",
}
"""Colour map of each quantity, perceptually uniform and legible with colour vision deficiency."""
MAX_RACKS_WITH_GAPS = 5_000
"""Largest number of racks at which the tiles of a heat map have gaps between them."""
MAX_RACKS_OF_SMALL_HALL = 200
"""Largest number of racks at which a hall has tiles of full size and all levels in 3D."""


class ColourScale(NamedTuple):
    """Range, resolution and unit of the values that a heat map shows."""

    low: float
    """Value at the lower end of the colour map, in ``unit``."""
    high: float
    """Value at the upper end of the colour map, in ``unit``."""
    resolution: float
    """Step to which values are rounded, in ``unit``."""
    unit: str
    """Unit of the values: C or kW."""


def temperature_scale(quantity: str) -> ColourScale:
    """Return the colour scale of a rack temperature, in C.

    Args:
        quantity: ``inlet`` or ``outlet``.
    """
    return ColourScale(*TEMPERATURE_RANGES_C[quantity], TEMPERATURE_RESOLUTION_K, "C")


def power_scale(fleet: Fleet) -> ColourScale:
    """Return the colour scale of rack power, in kW.

    The range begins at 0. Its upper end is 1.1 times the largest nameplate power of a rack (a
    tenth for fans), rounded up to 1, 2 or 5 times a power of ten. The resolution is a power of two
    whose multiples half precision represents exactly over this range.
    """
    nameplate_w = np.concatenate([count * full_w for count, full_w, *_ in fleet.group_rows])
    largest_kw = float(fleet.group_sums(nameplate_w).max()) * 1.1 / 1e3
    decade = 10.0 ** np.floor(np.log10(largest_kw))
    high = float(decade * next(n for n in (1, 2, 5, 10) if n * decade >= largest_kw * (1 - 1e-9)))
    return ColourScale(0.0, high, float(2.0 ** np.ceil(np.log2(high / 2048))), "kW")


def quantised(values: Reals, scale: ColourScale) -> F32:
    """Round values to the resolution of a scale, and clip them to its range.

    Values are clipped because the Rerun web viewer draws values below the range in the hottest
    colour.
    """
    steps = np.rint(values.astype(np.float32) * np.float32(1.0 / scale.resolution))
    rounded = np.clip(steps * np.float32(scale.resolution), scale.low, scale.high)
    return np.asarray(rounded, dtype=np.float32)


class TileGrid(NamedTuple):
    """Geometry of a heat map of a hall, with a tile per rack.

    Rows of the hall run down the image, and the racks of a row run to the right.
    """

    rows: int
    """Number of rows of the hall."""
    racks_per_row: int
    """Number of racks in a row."""
    tile_height: int
    """Height of the tile of a rack, in pixels."""
    tile_width: int
    """Width of the tile of a rack, in pixels."""
    gap: int
    """Distance between tiles, in pixels."""

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width of the image, in pixels."""
        return (
            self.rows * (self.tile_height + self.gap) - self.gap,
            self.racks_per_row * (self.tile_width + self.gap) - self.gap,
        )


def tile_grid(hall: HallConfig) -> TileGrid:
    """Return tiles with which a heat map is about 1.8 times as wide as high.

    Tiles are at most 8 times as wide as high, or as high as wide.
    """
    ratio = min(max(1.8 * hall.rows / hall.racks_per_row, 1 / 8), 8.0)
    has_gaps = hall.racks <= MAX_RACKS_WITH_GAPS
    short_side = 4 if hall.racks <= MAX_RACKS_OF_SMALL_HALL else 2 if has_gaps else 1
    return TileGrid(
        rows=hall.rows,
        racks_per_row=hall.racks_per_row,
        tile_height=round(short_side / min(ratio, 1.0)),
        tile_width=round(short_side * max(ratio, 1.0)),
        gap=1 if has_gaps else 0,
    )


def heat_maps(rack_values: Reals, grid: TileGrid, scale: ColourScale) -> npt.NDArray[np.float16]:
    """Return heat maps of rack values, one per frame; gaps have the lower end of the range.

    Args:
        rack_values: value of each of T frames and R racks, (T, R).
        grid: geometry of the tiles.
        scale: range and resolution of the values.

    Returns:
        Values of the pixels, (T, height, width).
    """
    rows, per_row, height, width, gap = grid
    frames, racks = rack_values.shape
    # Gaps are looked up like racks: index ``racks`` is the value of gaps, and index ``rows`` is
    # an image line that consists of gaps.
    values = np.full((frames, racks + 1), scale.low, dtype=np.float16)
    values[:, :racks] = quantised(rack_values, scale)
    rack_of_pixel = np.full((rows + 1, per_row, width + gap), racks)
    rack_of_pixel[:rows, :, :width] = np.arange(racks).reshape(rows, per_row, 1)
    row_of_line = np.full((rows, height + gap), rows)
    row_of_line[:, :height] = np.arange(rows).reshape(rows, 1)
    image_height, image_width = grid.image_shape
    lines = values.take(rack_of_pixel.reshape(rows + 1, -1)[:, :image_width], axis=1)
    return lines.take(row_of_line.reshape(-1)[:image_height], axis=1)


def colour_bar(scale: ColourScale) -> tuple[F32, list[float]]:
    """Return the image of a colour bar, and the values of its tick marks.

    Args:
        scale: range of the colour bar.

    Returns:
        A horizontal gradient over the range, (height, width), and at most nine round values within
        the range.
    """
    width, height = 240, 10
    gradient = np.tile(np.linspace(scale.low, scale.high, width, dtype=np.float32), (height, 1))
    span = scale.high - scale.low
    interval = next(
        n for k in (1e-3, 1e-2, 0.1, 1, 10, 100, 1e3) for n in (k, 2 * k, 5 * k) if span / n <= 8
    )
    count = int(np.floor(span / interval + 1e-9))
    return gradient, [scale.low + i * interval for i in range(count + 1)]


class RackVoxels(NamedTuple):
    """Racks as voxels of half a rack's depth: a front and a back voxel per level of each rack.

    All voxels are on one grid, which rounds the widths of aisles to half a rack's depth.
    """

    size_m: tuple[float, float, float]
    """Size of a voxel along the row, across the row and upwards, in m."""
    front: I64
    """Grid indices x, y, z of front voxels, rack by rack from the floor up, (R * levels, 3)."""
    back: I64
    """Grid indices x, y, z of back voxels, rack by rack from the floor up, (R * levels, 3)."""
    levels: int
    """Number of levels of equal height per rack."""


def rack_voxels(hall: HallConfig, levels: int) -> RackVoxels:
    """Return the voxels of the racks of a hall.

    Args:
        hall: config of the hall, with R racks.
        levels: number of levels of equal height per rack.
    """
    plan, measures = floor_plan(hall), hall.layout
    half_m = measures.rack_depth_m / 2
    x = np.tile(np.arange(hall.racks_per_row), hall.rows)
    low = np.rint((plan.centre_m[:, 1] - half_m) / half_m).astype(np.int64)
    # The front is the half with larger y in racks that face towards larger y.
    ahead = (plan.facing > 0).astype(np.int64)
    z = np.arange(levels)

    def indices(y: I64) -> I64:
        columns = np.broadcast_arrays(x[:, None], y[:, None], z[None, :])
        return np.stack(columns, axis=-1).reshape(-1, 3)

    return RackVoxels(
        size_m=(measures.rack_pitch_m, half_m, measures.rack_height_m / levels),
        front=indices(low + ahead),
        back=indices(low + 1 - ahead),
        levels=levels,
    )


def level_starts(servers: I64, levels: int) -> I64:
    """Return the index of the first server of each level of each rack, (R * levels,).

    Indices count the servers of all racks, rack by rack from the floor up.

    Args:
        servers: number of servers of each rack, (R,), at least one per level.
        levels: number of levels of equal height per rack.
    """
    first = np.cumsum(servers) - servers
    # Server j of n is in level j * levels // n.
    below = (np.arange(levels) * servers[:, None] + levels - 1) // levels
    return (first[:, None] + below).reshape(-1)
