"""Images of a hall: heat maps for convolutional networks, and rendered pictures of the racks."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from sdc_taichi.config import HallConfig
from sdc_taichi.control.view import View, mean_setpoint_c
from sdc_taichi.envs.features import Feature, scale
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.floor_plan import floor_plan, row_distance_m
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32

HEAT_MAP_CHANNELS = (
    Feature("rack_inlet", "C", 10.0, 50.0, "inlet of the rack, mean over its servers"),
    Feature("rack_outlet", "C", 10.0, 70.0, "outlet of the rack"),
    Feature("rack_power", "share", 0.0, 2.0, "IT power over the hall's design power per rack"),
)
"""Channels of the heat map in order; all of them are results of the last step."""


def heat_map(view: View) -> F32:
    """Return heat maps of the racks after the last step, 0..1, (B, rows, racks per row, channels).

    The values are floats because 8-bit integers would resolve the inlets to 0.16 K only. Before the
    first step all air is at the temperature of the setpoint and no rack draws power.

    Raises:
        ConfigError: the halls differ in their rows or racks per row.
    """
    shape = _shape_of_halls(view.fleet)
    racks = shape[0] * shape[1]
    channels = np.empty((view.size, racks, len(HEAT_MAP_CHANNELS)), dtype=np.float32)
    if view.last is None:
        channels[...] = mean_setpoint_c(view)[:, None, None]
        channels[:, :, 2] = 0.0
    else:
        design_w = view.sizing.it_w[:, None] / racks
        channels[:, :, 0] = view.last.rack_inlet_c.reshape(view.size, racks)
        channels[:, :, 1] = view.last.rack_outlet_c.reshape(view.size, racks)
        channels[:, :, 2] = view.last.rack_power_w.reshape(view.size, racks) / design_w
    for k, channel in enumerate(HEAT_MAP_CHANNELS):
        channels[:, :, k] = scale(channels[:, :, k], channel)
    return channels.reshape(view.size, *shape, len(HEAT_MAP_CHANNELS))


def heat_map_space(fleet: Fleet) -> Box:
    """Return the space of the heat map of one data center, (rows, racks per row, channels).

    Raises:
        ConfigError: the halls differ in their rows or racks per row.
    """
    return Box(0.0, 1.0, (*_shape_of_halls(fleet), len(HEAT_MAP_CHANNELS)), dtype=np.float32)


def _shape_of_halls(fleet: Fleet) -> tuple[int, int]:
    """Return the number of rows and of racks per row, which all halls of the fleet must share."""
    shapes = [(c.hall.rows, c.hall.racks_per_row) for c in fleet.configs]
    for config, shape in zip(fleet.configs, shapes, strict=True):
        if shape != shapes[0]:
            raise ConfigError(
                f"heat map: {config.name} has {shape[0]} x {shape[1]} racks, "
                f"{fleet.configs[0].name} has {shapes[0][0]} x {shapes[0][1]}; "
                "valid is one shape for all"
            )
    return shapes[0]


Image = npt.NDArray[np.uint8]
"""A picture, (height, width, 3), with red, green and blue of 0..255."""

RENDER_MODES = ("rgb_array",)
"""Valid values of ``render_mode`` besides None."""
RANGE_C = (15.0, 35.0)
"""Temperatures at both ends of the colour scale, in C: the lowest setpoint of the presets and the
allowable limit of class A2 (ASHRAE TC 9.9)."""
PX_PER_M = 40.0
"""Scale of a picture, in pixels per metre; smaller if a side would exceed ``LONGEST_PX``."""
LONGEST_PX = 1024
"""Longest side of a picture, in pixels. Larger halls have a smaller scale, down to one pixel per
rack; only then a side may be longer."""
_SEPARATED_PX = 6.0
"""Minimum width of a rack, in pixels, for a gap between adjacent racks."""
_FLOOR, _COLD, _HOT = (225, 225, 225), (198, 219, 239), (252, 205, 190)
_INFERNO = (
    (0, 0, 4), (24, 12, 60), (66, 10, 104), (106, 23, 110), (147, 38, 103), (188, 55, 84),
    (221, 81, 58), (243, 118, 27), (252, 165, 10), (246, 215, 70), (252, 255, 164),
)  # fmt: skip
"""Eleven equally spaced colours of the perceptually uniform colour map "inferno" (Smith and van der
Walt 2015, CC0)."""


def check_render_mode(mode: str | None) -> None:
    """Refuse an unknown render mode.

    Raises:
        ConfigError: ``mode`` is neither None nor one of ``RENDER_MODES``.
    """
    if mode is not None and mode not in RENDER_MODES:
        raise ConfigError(f"render_mode {mode!r}: valid is None or {', '.join(RENDER_MODES)}")


def frame(view: View, env: int) -> Image:
    """Draw the hall of one environment after the last step, (height, width, 3).

    Before the first step all inlets are at the mean setpoint.
    """
    fleet = view.fleet
    hall = fleet.configs[env].hall
    if view.last is None:
        inlet_c = np.full(hall.racks, mean_setpoint_c(view)[env])
    else:
        racks = slice(*fleet.rack_offsets[env : env + 2])
        inlet_c = np.asarray(view.last.rack_inlet_c[racks], dtype=np.float64)
    return hall_image(hall, inlet_c)


def hall_image(hall: HallConfig, inlet_c: npt.NDArray[np.float64]) -> Image:
    """Draw the floor plan of a hall with racks coloured by their inlet temperatures.

    Args:
        hall: racks and dimensions of the hall.
        inlet_c: inlet temperature of each rack, in C, (racks,).

    Returns:
        The picture, (height, width, 3). Its size depends on the hall alone.
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
    """Return the colours, (n, 3), of temperatures in C, (n,), clipped to ``RANGE_C``."""
    anchors = np.array(_INFERNO, dtype=np.float64)
    at_c = np.linspace(*RANGE_C, len(anchors))
    channels = [np.interp(celsius, at_c, anchor) for anchor in anchors.T]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)
