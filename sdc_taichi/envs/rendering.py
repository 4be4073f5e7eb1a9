"""Pictures of halls as arrays, with NumPy alone.

A plan to scale with the longer side of the room to the right: floor in grey, cold aisles blue, hot
aisles red, racks in the colour of their inlet, rack 0 at the top left. The colours run from
``RANGE_C[0]`` (black) to ``RANGE_C[1]`` (light yellow) whatever the data, so that pictures of
different steps and halls compare.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import HallConfig
from sdc_taichi.envs.core import Core
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.floor_plan import floor_plan, row_distance_m

Image = npt.NDArray[np.uint8]
"""A picture, (height, width, 3), in red, green and blue of 0..255."""

RENDER_MODES = ("rgb_array",)
"""Valid values of ``render_mode`` beside None."""
RANGE_C = (15.0, 35.0)
"""Temperatures in C between which the colours run: from the coldest setpoint of the presets up to
what class A2 allows (ASHRAE TC 9.9)."""
PX_PER_M = 40.0
"""Scale of a picture, in pixels per metre, unless the hall is larger than ``LONGEST_PX``."""
LONGEST_PX = 1024
"""Longest side of a picture in pixels; larger halls are drawn smaller, down to a pixel per rack."""
_SEPARATED_PX = 6.0
"""Least width of a rack in pixels at which neighbours are drawn apart."""
_FLOOR, _COLD, _HOT = (225, 225, 225), (198, 219, 239), (252, 205, 190)
_INFERNO = (
    (0, 0, 4), (24, 12, 60), (66, 10, 104), (106, 23, 110), (147, 38, 103), (188, 55, 84),
    (221, 81, 58), (243, 118, 27), (252, 165, 10), (246, 215, 70), (252, 255, 164),
)  # fmt: skip
"""Every tenth of the inferno map (Smith and van der Walt 2015, CC0), perceptually uniform."""


def check_render_mode(mode: str | None) -> None:
    """Refuse a mode that does not exist.

    Raises:
        ConfigError: neither None nor one of ``RENDER_MODES``.
    """
    if mode is not None and mode not in RENDER_MODES:
        raise ConfigError(f"render_mode {mode!r}: valid is None or {', '.join(RENDER_MODES)}")


def require_render_mode(mode: str | None) -> None:
    """Refuse to draw for an environment that was made without a mode.

    Raises:
        ConfigError: the mode is None.
    """
    if mode is None:
        raise ConfigError("render: made without render_mode; valid is render_mode='rgb_array'")


def frame(core: Core, env: int) -> Image:
    """The hall of one environment after the last step, (height, width, 3).

    Before the first step all inlets are at the mean setpoint.

    Raises:
        RuntimeStateError: before ``reset``.
    """
    view = core.view
    fleet = view.fleet
    hall = fleet.configs[env].hall
    if view.last is None:
        units = slice(*fleet.unit_offsets[env : env + 2])
        inlet_c = np.full(hall.racks, view.state.setpoint_c[units].mean())
    else:
        racks = slice(*fleet.rack_offsets[env : env + 2])
        inlet_c = np.asarray(view.last.rack_inlet_c[racks], dtype=np.float64)
    return hall_image(hall, inlet_c)


def hall_image(hall: HallConfig, inlet_c: npt.NDArray[np.float64]) -> Image:
    """A plan of the hall with the racks coloured by their inlets.

    Args:
        hall: racks and measures of the hall.
        inlet_c: inlet temperature of each rack, in C, (racks,).

    Returns:
        (height, width, 3); the size depends on the hall alone.
    """
    plan, measures = floor_plan(hall), hall.layout
    pitch_m, depth_m = measures.rack_pitch_m, measures.rack_depth_m
    scale = min(PX_PER_M, LONGEST_PX / max(plan.length_m, plan.width_m))
    scale = max(scale, 1.0 / min(pitch_m, depth_m))
    x_m = (np.arange(round(plan.length_m * scale)) + 0.5) / scale
    y_m = (np.arange(round(plan.width_m * scale)) + 0.5) / scale

    across = (x_m - plan.row_ends_m[0]) / pitch_m
    in_row = (across >= 0) & (across < hall.racks_per_row)
    column = np.clip(across.astype(np.int64), 0, hall.racks_per_row - 1)
    centre_m = plan.centre_m[0, 1] + row_distance_m(measures, np.arange(hall.rows))
    row = np.abs(y_m[:, None] - centre_m).argmin(axis=1)
    from_row_m = np.abs(y_m - centre_m[row])

    between = np.searchsorted(centre_m, y_m) - 1
    inside = (between >= 0) & (between < hall.rows - 1)
    aisle = np.where(inside, 1 + between % 2, 0)
    image = np.array([_FLOOR, _COLD, _HOT], dtype=np.uint8)[np.where(in_row, aisle[:, None], 0)]

    rack = (from_row_m < depth_m / 2)[:, None] & in_row
    if pitch_m * scale >= _SEPARATED_PX:
        rack &= (across % 1.0) * pitch_m * scale >= 1.0
    colour = colours(inlet_c).reshape(hall.rows, hall.racks_per_row, 3)
    image[rack] = colour[row[:, None], column][rack]
    return image if plan.length_m >= plan.width_m else image.swapaxes(0, 1).copy()


def colours(celsius: npt.NDArray[np.float64]) -> Image:
    """Colours, (n, 3), of temperatures in C, (n,), which are cut at the ends of ``RANGE_C``."""
    anchors = np.array(_INFERNO, dtype=np.float64)
    at_c = np.linspace(*RANGE_C, len(anchors))
    channels = [np.interp(celsius, at_c, anchor) for anchor in anchors.T]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)
