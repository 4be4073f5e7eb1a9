"""The racks of a hall as an image, an observation for convolutional networks."""

from __future__ import annotations

import numpy as np
from gymnasium.spaces import Box

from sdc_taichi.control.view import View
from sdc_taichi.envs.features import Feature, scale
from sdc_taichi.envs.observer import mean_setpoint_c
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32

HEAT_MAP_CHANNELS = (
    Feature("rack_inlet", "C", 10.0, 50.0, "inlet of the rack, mean over its servers"),
    Feature("rack_outlet", "C", 10.0, 70.0, "outlet of the rack"),
    Feature("rack_power", "share", 0.0, 2.0, "IT power over the hall's design power per rack"),
)
"""Channels of the heat map in order, all of the last step."""


def heat_map(view: View) -> F32:
    """Racks of the last step as images, 0..1, (B, rows, racks per row, channels).

    The values are float rather than bytes, as 8 bits would leave steps of 0.16 K. Before the first
    step all air has the temperature of the setpoint and no rack draws power.

    Raises:
        ConfigError: halls that differ in rows or racks per row.
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
    """Space of the heat map of one data center, (rows, racks per row, channels).

    Raises:
        ConfigError: halls that differ in rows or racks per row.
    """
    return Box(0.0, 1.0, (*_shape_of_halls(fleet), len(HEAT_MAP_CHANNELS)), dtype=np.float32)


def _shape_of_halls(fleet: Fleet) -> tuple[int, int]:
    """Rows and racks per row that all halls of the fleet have."""
    shapes = [(c.hall.rows, c.hall.racks_per_row) for c in fleet.configs]
    for config, shape in zip(fleet.configs, shapes, strict=True):
        if shape != shapes[0]:
            raise ConfigError(
                f"heat map: {config.name} has {shape[0]} x {shape[1]} racks, "
                f"{fleet.configs[0].name} has {shapes[0][0]} x {shapes[0][1]}; "
                "valid is one shape for all"
            )
    return shapes[0]
