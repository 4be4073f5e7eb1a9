"""Raster data of halls for recordings: heat maps with a tile per rack, and 3D voxels of racks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.types import I64

from .colour_scales import Classes, ColourScale, classes_of

MAX_RACKS_WITH_GAPS = 5_000
"""Largest number of racks at which the tiles of a heat map have gaps between them."""
MAX_NAMED_RACKS = 20_000
"""Largest number of racks of a hall whose maps name every rack; larger ones name the rows."""
MAX_HALL_PARTS = 20_000
"""Largest number of racks of a 3D hall that has a voxel for the front of each rack."""
MAX_RACKS_OF_SMALL_HALL = 200
"""Largest number of racks at which a hall has tiles of full size and all levels in 3D."""


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


def heat_maps(rack_classes: Classes, grid: TileGrid) -> Classes:
    """Return maps of the classes of racks, one per frame; gaps have class 0.

    Args:
        rack_classes: class of each rack in each of T frames, (T, R).
        grid: geometry of the tiles.

    Returns:
        Classes of the pixels, (T, height, width).
    """
    rows, per_row, height, width, gap = grid
    frames, racks = rack_classes.shape
    # Gaps are looked up like racks: index ``racks`` is the class of gaps, and index ``rows`` is
    # an image line that consists of gaps.
    values = np.zeros((frames, racks + 1), dtype=rack_classes.dtype)
    values[:, :racks] = rack_classes
    rack_of_pixel = np.full((rows + 1, per_row, width + gap), racks)
    rack_of_pixel[:rows, :, :width] = np.arange(racks).reshape(rows, per_row, 1)
    row_of_line = np.full((rows, height + gap), rows)
    row_of_line[:, :height] = np.arange(rows).reshape(rows, 1)
    image_height, image_width = grid.image_shape
    lines = values.take(rack_of_pixel.reshape(rows + 1, -1)[:, :image_width], axis=1)
    return lines.take(row_of_line.reshape(-1)[:image_height], axis=1)


def rack_numbers(grid: TileGrid) -> npt.NDArray[np.uint16]:
    """Return the number of the rack of each pixel plus 1, (height, width).

    Gaps belong to the rack before them. Halls of more racks than 16 bits can number have the number
    of the row instead.
    """
    rows, per_row, height, width, gap = grid
    numbers = np.arange(rows * per_row).reshape(rows, per_row)
    if rows * per_row > MAX_NAMED_RACKS:
        numbers = numbers // per_row
    pixels = numbers.repeat(height + gap, axis=0).repeat(width + gap, axis=1)
    image_height, image_width = grid.image_shape
    return (pixels[:image_height, :image_width] + 1).astype(np.uint16)


def colour_bar(scale: ColourScale) -> tuple[Classes, list[float]]:
    """Return the image of a colour bar, and the values of its tick marks.

    Returns:
        Classes of a horizontal gradient over the range, (height, width), and at most nine round
        values within the range.
    """
    width, height = 240, 10
    values = np.linspace(scale.low, scale.high, width, dtype=np.float32)
    gradient = np.tile(classes_of(values, scale), (height, 1))
    span = scale.high - scale.low
    interval = next(
        n for k in (1e-3, 1e-2, 0.1, 1, 10, 100, 1e3) for n in (k, 2 * k, 5 * k) if span / n <= 8
    )
    begin = int(np.ceil(scale.low / interval - 1e-9))
    end = int(np.floor(scale.high / interval + 1e-9))
    return gradient, [i * interval for i in range(begin, end + 1)]


def voxel_starts(hall: HallConfig) -> I64:
    """Return the first rack of each part of the 3D hall, (parts,).

    A part is a rack, or some adjacent racks of a row in halls of more than ``MAX_HALL_PARTS``.
    """
    together = -(-hall.racks // MAX_HALL_PARTS)
    row_starts = np.arange(hall.rows)[:, None] * hall.racks_per_row
    return np.asarray(row_starts + np.arange(0, hall.racks_per_row, together)).reshape(-1)


class RackVoxels(NamedTuple):
    """Racks as voxels of half a rack's depth: a front and a back voxel per level of each part.

    All voxels are on one grid, which rounds the widths of aisles to half a rack's depth.
    """

    size_m: tuple[float, float, float]
    """Size of a voxel along the row, across the row and upwards, in m."""
    front: I64
    """Grid indices x, y, z of front voxels, part by part from the floor up, (parts * levels, 3)."""
    back: I64
    """Grid indices x, y, z of back voxels, part by part from the floor up, (parts * levels, 3)."""
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
    starts, together = voxel_starts(hall), -(-hall.racks // MAX_HALL_PARTS)
    x = starts % hall.racks_per_row // together
    low = np.rint((plan.centre_m[starts, 1] - half_m) / half_m).astype(np.int64)
    # The front is the half with larger y in racks that face towards larger y.
    ahead = (plan.facing[starts] > 0).astype(np.int64)
    z = np.arange(levels)

    def indices(y: I64) -> I64:
        columns = np.broadcast_arrays(x[:, None], y[:, None], z[None, :])
        return np.stack(columns, axis=-1).reshape(-1, 3)

    return RackVoxels(
        size_m=(measures.rack_pitch_m * together, half_m, measures.rack_height_m / levels),
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
