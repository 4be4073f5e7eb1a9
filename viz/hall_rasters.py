"""Heat maps and voxels of halls: the pixels of each rack, and the voxels of its levels."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32, I64, Reals

TEMPERATURE_RESOLUTION_K = 1 / 16
"""Resolution of temperatures: exact in half precision below 64 C, and it compresses well."""
TEMPERATURE_RANGES_C = {"inlet": (10.0, 45.0), "outlet": (10.0, 60.0)}
"""Ranges of the colours by quantity, in C, so that colours mean the same in every recording."""
COLOURMAPS: dict[str, Literal["inferno", "viridis"]] = {
    "inlet": "inferno",
    "outlet": "inferno",
    "power": "viridis",
}
"""Colour maps by quantity, perceptually uniform and legible to people who are colour-blind."""
MAX_RACKS_WITH_GAPS = 5_000
"""Number of racks up to which the tiles of a heat map have gaps between them."""
MAX_RACKS_OF_SMALL_HALL = 200
"""Number of racks up to which a hall has the largest tiles, and the most levels in 3D."""


class ColourScale(NamedTuple):
    """Range and resolution of the values that a heat map shows."""

    low: float
    """Value at the lower end of the colour map, in ``unit``."""
    high: float
    """Value at the upper end of the colour map, in ``unit``."""
    resolution: float
    """Step to which values are rounded, in ``unit``."""
    unit: str
    """Unit of the values: C or kW."""


def temperature_scale(quantity: str) -> ColourScale:
    """Colour scale of a temperature.

    Args:
        quantity: ``inlet`` or ``outlet``.
    """
    return ColourScale(*TEMPERATURE_RANGES_C[quantity], TEMPERATURE_RESOLUTION_K, "C")


def power_scale(fleet: Fleet) -> ColourScale:
    """Colour scale of rack power: 0 to the largest nameplate power and a tenth for fans, in kW.

    The upper end is rounded up to 1, 2 or 5 times a power of ten; the resolution is the power of
    two that half precision holds exactly over this range.
    """
    nameplate_w = np.concatenate([count * full_w for count, full_w, *_ in fleet.group_rows])
    largest_kw = float(fleet.group_sums(nameplate_w).max()) * 1.1 / 1e3
    decade = 10.0 ** np.floor(np.log10(largest_kw))
    high = float(decade * next(n for n in (1, 2, 5, 10) if n * decade >= largest_kw * (1 - 1e-9)))
    return ColourScale(0.0, high, float(2.0 ** np.ceil(np.log2(high / 2048))), "kW")


def quantised(values: Reals, scale: ColourScale) -> F32:
    """Values rounded to the resolution of a scale and limited to its range, of the same shape.

    The viewer in a browser draws what is below the range, or nan, as hot.
    """
    steps = np.rint(values.astype(np.float32) * np.float32(1.0 / scale.resolution))
    rounded = np.clip(steps * np.float32(scale.resolution), scale.low, scale.high)
    return np.asarray(rounded, dtype=np.float32)


class TileGrid(NamedTuple):
    """Heat map of a hall: rows of the hall downwards, racks of a row to the right, a tile each."""

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
    """Tiles shaped so that a hall is about 1.8 times as wide as high (tiles at most 8:1)."""
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
    """Heat maps of rack values; gaps have the lower end of the range.

    Args:
        rack_values: a value per frame and rack, (T, R).
        grid: tiles of the hall.
        scale: range and resolution of the values.

    Returns:
        Pixels, (T, height, width).
    """
    rows, per_row, height, width, gap = grid
    frames, racks = rack_values.shape
    # A value for the gaps follows those of the racks, and a line of gaps those of the rows.
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
    """Image of a colour bar and the values to mark on it.

    Args:
        scale: range of the bar.

    Returns:
        A gradient over the range, (height, width), and at most nine round values within it.
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
    """Racks as voxels of half a rack's depth, so that a rack has a front and a back.

    Voxels lie on one grid, so aisles are rounded to half a rack's depth.
    """

    size_m: tuple[float, float, float]
    """Size of a voxel along the row, across the row and upwards, in m."""
    front: I64
    """Grid indices x, y, z of the fronts, rack by rack from the floor up, (R levels, 3)."""
    back: I64
    """Grid indices x, y, z of the backs, rack by rack from the floor up, (R levels, 3)."""
    levels: int
    """Number of equal heights that a rack is cut into."""


def rack_voxels(hall: HallConfig, levels: int) -> RackVoxels:
    """Voxels of the racks of a hall.

    Args:
        hall: the hall of R racks.
        levels: number of equal heights that a rack is cut into.
    """
    plan, measures = floor_plan(hall), hall.layout
    half_m = measures.rack_depth_m / 2
    x = np.tile(np.arange(hall.racks_per_row), hall.rows)
    low = np.rint((plan.centre_m[:, 1] - half_m) / half_m).astype(np.int64)
    # The front is the half with larger y where racks face that way.
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
    """First server of each level of racks, counted over the servers of all of them, (R levels,).

    Args:
        servers: number of servers of each rack, (R,), at least one per level.
        levels: number of equal heights that a rack is cut into.
    """
    first = np.cumsum(servers) - servers
    # Server j of n is in level j * levels // n.
    below = (np.arange(levels) * servers[:, None] + levels - 1) // levels
    return (first[:, None] + below).reshape(-1)
