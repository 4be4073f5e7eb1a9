"""Static parts of a recording: names, colours, formats, colour bars and the hall."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from sdc_taichi.hall.floor_plan import floor_plan, unit_places_m
from sdc_taichi.sim.fleet import Fleet

from . import hall_rasters as rasters
from .recording_series import (
    COMMAND_STATES,
    FLEET_PLOTS,
    PALETTE,
    PLOTS,
    QUEUE_COLOURS,
    QUEUE_ENTITY,
    QUEUE_NAMES,
    RED,
    REWARDS_ENTITY,
    STATE_COLOURS,
)

MAX_UNIT_LINES = 24
"""Largest number of CRAC units with a line each; of more their range is plotted."""

MAX_ROW_LABELS = 5
"""Largest number of rows of the 3D hall with a label; more would cover each other."""
_LABEL_RGB = (135, 135, 135)  # a grey that can be read on a dark and on a light ground

Entities = Iterator[tuple[str, Any]]
"""Paths of entities, and the component or archetype that each holds."""


def fleet_entities(scales: dict[str, rasters.ColourScale]) -> Entities:
    """Colour bars, and the lines of the fleet.

    Args:
        scales: colour scales of the heat maps, by quantity.
    """
    for quantity, scale in scales.items():
        yield from _colour_bar(quantity, scale).items()
    for entity, plot in FLEET_PLOTS.items():
        yield f"fleet/{entity}", _lines([plot.title], [plot.colour])


def data_center_entities(
    fleet: Fleet,
    dc: int,
    path: str,
    scales: dict[str, rasters.ColourScale],
    levels: int,
    rewards: Sequence[str],
) -> Entities:
    """Lines, states, images and voxels of a data center.

    Args:
        fleet: the fleet.
        dc: index of the data center.
        path: path of the data center in the recording.
        scales: colour scales of the heat maps, by quantity.
        levels: levels per rack of its 3D hall.
        rewards: names of the reward terms.
    """
    import rerun as rr

    for entity, plot in PLOTS.items():
        names = [line.name for line in plot.lines]
        yield f"{path}/series/{entity}", _lines(names, [line.colour for line in plot.lines])
    yield f"{path}/series/{QUEUE_ENTITY}", _lines(QUEUE_NAMES, QUEUE_COLOURS)
    if rewards:
        reward_colours = [PALETTE[i % len(PALETTE)] for i in range(len(rewards))]
        names = [f"{name} [-]" for name in rewards]
        yield f"{path}/series/{REWARDS_ENTITY}", _lines(names, reward_colours)
    units = int(fleet.unit_offsets[dc + 1] - fleet.unit_offsets[dc])
    names, unit_colours = _unit_lines(units, "supply [C]")
    names, unit_colours = [*names, "return, all units [C]"], [*unit_colours, RED]
    yield f"{path}/crac/temperature_c", _lines(names, unit_colours)
    yield f"{path}/crac/airflow_m3s", _lines(*_unit_lines(units, "airflow [m3/s]"))
    state_colours = np.array(STATE_COLOURS, np.uint32)
    for entity, (_, states) in COMMAND_STATES.items():
        shown = rr.StateConfiguration(values=states, labels=states, colors=state_colours)
        yield f"{path}/actions/{entity}", shown
    height, width = rasters.tile_grid(fleet.configs[dc].hall).image_shape
    image_format = rr.components.ImageFormat(
        width=width, height=height, color_model="L", channel_datatype="F16"
    )
    for quantity, scale in scales.items():
        image = rr.DepthImage.from_fields(
            format=image_format,
            colormap=rasters.COLOURMAPS[quantity],
            depth_range=(scale.low, scale.high),
            meter=1.0,
            magnification_filter="Nearest",
        )
        yield f"{path}/map/{quantity}", image
    yield from _hall_entities(fleet, dc, f"{path}/hall", scales, levels, units)


def _hall_entities(
    fleet: Fleet,
    dc: int,
    path: str,
    scales: dict[str, rasters.ColourScale],
    levels: int,
    units: int,
) -> Entities:
    """Voxels, walls, row labels and CRAC units of a hall in 3D."""
    import rerun as rr

    hall = fleet.configs[dc].hall
    grid = rasters.rack_voxels(hall, levels)
    for quantity, cells in (("inlet", grid.front), ("outlet", grid.back)):
        voxels = rr.VoxelGridMap.from_fields(
            voxel_indices=cells.astype(np.int32),
            voxel_size=grid.size_m,
            value_range=(scales[quantity].low, scales[quantity].high),
            colormap=rasters.COLOURMAPS[quantity],
            translation=(hall.layout.end_margin_m, 0.0, 0.0),
        )
        yield f"{path}/{quantity}", voxels
    plan, height_m = floor_plan(hall), hall.layout.rack_height_m
    walls = rasters.room_outline_m(plan, hall.layout.ceiling_m)
    yield f"{path}/room", rr.LineStrips3D(walls, colors=[[110, 110, 110]], radii=0.02)
    beside = plan.row_ends_m[0] - 0.6
    labelled = range(0, hall.rows, -(-hall.rows // MAX_ROW_LABELS))
    rows = rr.Points3D(
        [(beside, plan.centre_m[row * hall.racks_per_row, 1], height_m / 2) for row in labelled],
        radii=0.05,
        colors=_LABEL_RGB,
        labels=[f"row {row}" for row in labelled],
        show_labels=True,
    )
    yield f"{path}/rows", rows
    boxes = rr.Boxes3D(
        centers=rasters.crac_box_centres_m(unit_places_m(plan, units), plan, height_m),
        sizes=[(0.8, 1.2, height_m)] * units,
        fill_mode="solid",
        colors=[80, 170, 230],
        labels=[f"CRAC {unit}" for unit in range(units)],
        show_labels=units <= MAX_UNIT_LINES,
    )
    yield f"{path}/crac", boxes


def _unit_lines(units: int, quantity: str) -> tuple[list[str], list[int]]:
    """Names and colours of the lines of CRAC units, or of their range if there are many."""
    if units > MAX_UNIT_LINES:
        return [f"{which} {quantity}" for which in ("lowest", "mean", "highest")], list(PALETTE[:3])
    others = [colour for colour in PALETTE if colour != RED]
    colours = [others[unit % len(others)] for unit in range(units)]
    return [f"unit {unit} {quantity}" for unit in range(units)], colours


def _lines(names: Sequence[str], colours: Sequence[int]) -> Any:
    """Names and colours of the lines of a plot."""
    return _series_lines(tuple(names), tuple(colours))


@lru_cache(maxsize=128)
def _series_lines(names: tuple[str, ...], colours: tuple[int, ...]) -> Any:
    """Names and colours of lines, kept because nearly all data centers have the same."""
    import rerun as rr

    # An array, because a list of three or four numbers is read as one colour.
    return rr.SeriesLines(names=list(names), colors=np.array(colours, np.uint32))


@lru_cache(maxsize=32)
def _colour_bar(quantity: str, scale: rasters.ColourScale) -> dict[str, Any]:
    """A gradient with labelled points, because the viewer has no colour bar of its own."""
    import rerun as rr

    gradient, marks = rasters.colour_bar(scale)
    height, width = gradient.shape
    bar = rr.DepthImage(
        gradient,
        meter=1.0,
        colormap=rasters.COLOURMAPS[quantity],
        depth_range=(scale.low, scale.high),
    )
    x = (np.array(marks) - scale.low) / (scale.high - scale.low) * width
    points = rr.Points2D(
        np.stack([x, np.full_like(x, height + 2.0)], axis=1),
        radii=rr.Radius.ui_points(1.5),
        colors=_LABEL_RGB,
        labels=[f"{mark:g} {scale.unit}" for mark in marks],
        show_labels=True,
    )
    return {f"legend/{quantity}/bar": bar, f"legend/{quantity}/ticks": points}
