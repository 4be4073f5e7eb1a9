"""What a recording says once, for all times: names, colours, formats, colour bars and the hall."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from sdc_taichi.hall.floor_plan import floor_plan, unit_places_m
from sdc_taichi.sim.fleet import Fleet

from . import hall_layers as layers
from .recording_series import (
    FLEET,
    PALETTE,
    PLOTS,
    QUEUE,
    QUEUE_COLOURS,
    QUEUE_NAMES,
    RED,
    REWARDS,
    STATE_COLOURS,
    STATES,
)

MAX_UNIT_LINES = 24
"""CRAC units beyond which their range is plotted instead of each."""

MOST_SIGNS = 5
"""Rows of the 3D hall with a sign; more would cover each other."""
_ON_ANY_GROUND = (135, 135, 135)
"""Grey of signs, which viewers show on a dark or a light ground."""

Entities = Iterator[tuple[str, Any]]
"""Paths and what is there."""


def fleet_entities(scales: dict[str, layers.Scale]) -> Entities:
    """Colour bars, and the lines of the fleet."""
    for what, scale in scales.items():
        yield from _legend(what, scale).items()
    for entity, line in FLEET.items():
        yield f"fleet/{entity}", _lines([line.title], [line.colour])


def data_center_entities(
    fleet: Fleet,
    dc: int,
    path: str,
    scales: dict[str, layers.Scale],
    zones: int,
    rewards: Sequence[str],
) -> Entities:
    """Lines, states, images and voxels of a data center.

    Args:
        fleet: the fleet.
        dc: the data center.
        path: where it is in the recording.
        scales: of the heat maps.
        zones: heights per rack of its 3D hall.
        rewards: names of the reward terms.
    """
    import rerun as rr

    for entity, plot in PLOTS.items():
        names = [line.name for line in plot.lines]
        yield f"{path}/series/{entity}", _lines(names, [line.colour for line in plot.lines])
    yield f"{path}/series/{QUEUE}", _lines(QUEUE_NAMES, QUEUE_COLOURS)
    if rewards:
        shades = [PALETTE[i % len(PALETTE)] for i in range(len(rewards))]
        yield f"{path}/series/{REWARDS}", _lines([f"{name} [-]" for name in rewards], shades)
    units = int(fleet.unit_offsets[dc + 1] - fleet.unit_offsets[dc])
    supplies, shades = _unit_lines(units, "supply [C]")
    yield f"{path}/crac/temperature_c", _lines([*supplies, "return, all units [C]"], [*shades, RED])
    yield f"{path}/crac/airflow_m3s", _lines(*_unit_lines(units, "airflow [m3/s]"))
    colours = np.array(STATE_COLOURS, np.uint32)
    for entity, (_, states) in STATES.items():
        shown = rr.StateConfiguration(values=states, labels=states, colors=colours)
        yield f"{path}/actions/{entity}", shown
    height, width = layers.tiles(fleet.configs[dc].hall).image
    form = rr.components.ImageFormat(
        width=width, height=height, color_model="L", channel_datatype="F16"
    )
    for what, scale in scales.items():
        image = rr.DepthImage.from_fields(
            format=form,
            colormap=layers.COLOURMAPS[what],
            depth_range=(scale.low, scale.high),
            meter=1.0,
            magnification_filter="Nearest",
        )
        yield f"{path}/map/{what}", image
    yield from _room(fleet, dc, f"{path}/hall", scales, zones, units)


def _room(
    fleet: Fleet, dc: int, path: str, scales: dict[str, layers.Scale], zones: int, units: int
) -> Entities:
    """Voxels, walls and signs of a hall."""
    import rerun as rr

    hall = fleet.configs[dc].hall
    grid = layers.voxels(hall, zones)
    for what, cells in (("inlet", grid.front), ("outlet", grid.back)):
        voxels = rr.VoxelGridMap.from_fields(
            voxel_indices=cells.astype(np.int32),
            voxel_size=grid.size_m,
            value_range=(scales[what].low, scales[what].high),
            colormap=layers.COLOURMAPS[what],
            translation=(hall.layout.end_margin_m, 0.0, 0.0),
        )
        yield f"{path}/{what}", voxels
    plan, height_m = floor_plan(hall), hall.layout.rack_height_m
    walls = layers.outline_m(plan, hall.layout.ceiling_m)
    yield f"{path}/room", rr.LineStrips3D(walls, colors=[[110, 110, 110]], radii=0.02)
    beside = plan.row_ends_m[0] - 0.6
    signed = range(0, hall.rows, -(-hall.rows // MOST_SIGNS))
    rows = rr.Points3D(
        [(beside, plan.centre_m[row * hall.racks_per_row, 1], height_m / 2) for row in signed],
        radii=0.05,
        colors=_ON_ANY_GROUND,
        labels=[f"row {row}" for row in signed],
        show_labels=True,
    )
    yield f"{path}/rows", rows
    boxes = rr.Boxes3D(
        centers=layers.unit_boxes_m(unit_places_m(plan, units), plan, height_m),
        sizes=[(0.8, 1.2, height_m)] * units,
        fill_mode="solid",
        colors=[80, 170, 230],
        labels=[f"CRAC {unit}" for unit in range(units)],
        show_labels=units <= MAX_UNIT_LINES,
    )
    yield f"{path}/crac", boxes


def _unit_lines(units: int, what: str) -> tuple[list[str], list[int]]:
    """Names and colours of what is plotted of so many CRAC units."""
    if units > MAX_UNIT_LINES:
        return [f"{which} {what}" for which in ("lowest", "mean", "highest")], list(PALETTE[:3])
    others = [colour for colour in PALETTE if colour != RED]
    colours = [others[unit % len(others)] for unit in range(units)]
    return [f"unit {unit} {what}" for unit in range(units)], colours


def _lines(names: Sequence[str], colours: Sequence[int]) -> Any:
    return _series_lines(tuple(names), tuple(colours))


@lru_cache(maxsize=128)
def _series_lines(names: tuple[str, ...], colours: tuple[int, ...]) -> Any:
    """Lines of a plot, which nearly all data centers have alike."""
    import rerun as rr

    # An array, because a list of three or four numbers is read as one colour.
    return rr.SeriesLines(names=list(names), colors=np.array(colours, np.uint32))


@lru_cache(maxsize=32)
def _legend(what: str, scale: layers.Scale) -> dict[str, Any]:
    """The viewer has no colour bar: a gradient with labelled points."""
    import rerun as rr

    gradient, marks = layers.legend(scale)
    height, width = gradient.shape
    bar = rr.DepthImage(
        gradient,
        meter=1.0,
        colormap=layers.COLOURMAPS[what],
        depth_range=(scale.low, scale.high),
    )
    x = (np.array(marks) - scale.low) / (scale.high - scale.low) * width
    points = rr.Points2D(
        np.stack([x, np.full_like(x, height + 2.0)], axis=1),
        radii=rr.Radius.ui_points(1.5),
        colors=_ON_ANY_GROUND,
        labels=[f"{mark:g} {scale.unit}" for mark in marks],
        show_labels=True,
    )
    return {f"legend/{what}/bar": bar, f"legend/{what}/ticks": points}
