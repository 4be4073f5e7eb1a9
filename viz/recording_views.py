"""Views of a recording, and its static entities: line styles, image formats, colour bars, halls.

In the viewer, a recording has a tab for each data center in focus, one for the fleet, and one for
the work that sites of a fleet send to each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64

from . import hall_rasters as rasters
from .colour_scales import ColourScale, annotation_context, invisible_names
from .liquid_loop import SIZE as DIAGRAM_SIZE
from .recording_flows import ABOUT_PATH, FLOW_PLOTS, MAP_PATH, FlowPictures
from .recording_liquid import CDU_PLOTS, liquid_plots
from .recording_racks import (
    DOWN_RGB,
    TRENDS,
    UNIT_RGB,
    mark_entities,
    unit_centres_m,
    unit_half_size_m,
)
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
    device_lines,
    series_lines,
)
from .recording_text import rack_place

PLAYBACK_S_PER_S = 14_400.0
"""Simulated seconds per second of playback."""

MAP_TITLES = {
    "inlet": "rack inlet",
    "change": "rack inlet less that",
    "rise": "rack inlet less supply air",
    "outlet": "rack outlet",
    "power": "rack power",
    "junction": "junction of liquid-cooled racks",
}
"""Titles of the maps, keyed by quantity."""
MAX_UNIT_LABELS = 8
"""Largest number of CRAC units of a 3D hall with a label each; more would cover the racks."""
MAX_ROW_LABELS = 5
"""Largest number of labels of rows in the 3D hall; more labels would cover each other."""
_MAP_BACKGROUND = (20, 20, 20)
"""Background of maps in all themes, which no colour of a rack matches."""
_LABEL_RGB = (135, 135, 135)  # a grey that is legible on dark and on light backgrounds
_LIMIT_LABEL_EDGE, _LIMIT_LABELS_APART = 25, 90
"""Smallest distance of the middle of a label of a limit from the ends of the colour bar, and from
that of the next label, in pixels of the bar. At these, no edge of the view cuts a label, and labels
do not cover each other."""

Entities = Iterator[tuple[str, Any]]
"""Iterator of entity paths, each with the static component or archetype of the entity."""


class FocusTab(NamedTuple):
    """Properties of a data center in focus that the views in its tab need."""

    name: str
    """Name of the data center in the recording."""
    reference: str
    """Reference of the map of changes, which completes its title."""
    path: str
    """Path of the data center's entities."""
    size_m: tuple[float, float, float]
    """Length, width and height of the room, in m."""
    scales: Mapping[str, ColourScale]
    """Colour scales of the heat maps, keyed by quantity."""
    image_shape: tuple[int, int]
    """Height and width of the heat maps, in pixels."""
    has_airflow: bool
    """True if the recording has the airflow of the hall."""
    has_liquid: bool
    """True if the data center has liquid cooling."""
    zones: tuple[tuple[int, int], ...]
    """Number of rows and of places of each zone; empty if the recording has no zones."""


def make_blueprint(
    tabs: Sequence[FocusTab], *, has_rewards: bool, flows: FlowPictures | None
) -> rrb.Blueprint:
    """Return the arrangement of the views of a recording.

    Args:
        tabs: tabs of the data centers in focus.
        has_rewards: True if reward terms are recorded.
        flows: flows between the sites of a fleet; None if there are none.
    """
    flow_tabs = [] if flows is None else [_flow_tab(flows.map_zoom)]
    focus_tabs = (_focus_tab(tab, has_rewards=has_rewards) for tab in tabs)
    return rrb.Blueprint(
        rrb.Tabs(*focus_tabs, _fleet_tab(), *flow_tabs),
        rrb.TimePanel(
            timeline="sim_time",
            playback_speed=PLAYBACK_S_PER_S,
            play_state="paused",
            state="collapsed",
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _fleet_tab() -> Any:
    """Return the tab with the summary and the plots of the whole fleet."""
    plots = [
        _plot_view(f"fleet/{entity}", plot.title, legend=False)
        for entity, plot in FLEET_PLOTS.items()
    ]
    return rrb.Horizontal(
        rrb.TextDocumentView(origin="summary", name="summary"),
        rrb.Grid(*plots, grid_columns=2),
        column_shares=[2, 3],
        name="fleet",
    )


def _flow_tab(zoom: float | None) -> Any:
    """Return the tab with the map of flows between sites, and the plots of what sites send.

    Args:
        zoom: zoom of the map; None if there is no map.
    """
    plots = [_plot_view(f"flows/{field}", title) for field, title in FLOW_PLOTS.items()]
    if zoom is None:
        return rrb.Vertical(*plots, name="work between sites")
    flow_map = rrb.Vertical(
        rrb.MapView(origin=MAP_PATH, name="work sent in the past hour", zoom=zoom),
        rrb.TextDocumentView(origin=ABOUT_PATH, name="about the map"),
        row_shares=[5, 1],
    )
    return rrb.Horizontal(
        flow_map, rrb.Vertical(*plots), column_shares=[3, 2], name="work between sites"
    )


def _focus_tab(tab: FocusTab, *, has_rewards: bool) -> Any:
    """Return the tab of a data center: maps, 3D hall and log on the left, plots on the right."""
    maps = {quantity: _heat_map(tab, quantity, scale) for quantity, scale in tab.scales.items()}
    differences = [maps.pop(name) for name in ("change", "rise") if name in maps]
    both = rrb.Horizontal(
        rrb.Tabs(*maps.values(), _state_view(tab), active_tab=0),
        rrb.Tabs(*differences, active_tab=0),
    )
    events = rrb.TextLogView(
        origin=f"{tab.path}/events",
        name="events",
        columns=rrb.TextLogColumns(
            # The time column is hidden because it is too narrow; the text begins with the time.
            timeline_columns=[rrb.encodings.TimelineColumn("sim_time", visible=False)],
            text_log_columns=["loglevel", "body"],
        ),
    )
    hall = rrb.Vertical(both, _hall_view(tab), events, row_shares=[5, 4, 2])
    return rrb.Horizontal(
        hall,
        _plot_tabs(tab, has_rewards=has_rewards),
        column_shares=[1, 1],
        name=tab.name,
    )


def _plot_tabs(tab: FocusTab, *, has_rewards: bool) -> Any:
    """Return tabs of a data center: plots in overview, racks, cooling and work, airflow, zones."""

    def plots(*entities: str) -> list[Any]:
        return [_series_view(tab, entity) for entity in entities]

    actions = rrb.StateTimelineView(
        origin=f"{tab.path}/actions", name="actions", time_view=_whole_run()
    )

    def trends() -> list[Any]:
        return [_plot_view(f"{tab.path}/racks/{entity}", name) for entity, name in TRENDS.items()]

    def hottest_row() -> Any:
        return rrb.Spatial2DView(
            origin=f"{tab.path}/row", name="hottest row: inlets by time and rack"
        )

    overview = rrb.Grid(
        *plots("temperature_c"),
        trends()[0],
        *plots("power_kw"),
        hottest_row(),
        *plots("carbon_intensity", QUEUE_ENTITY, "battery"),
        actions,
        grid_columns=2,
        name="overview",
    )
    racks = rrb.Grid(*trends(), hottest_row(), grid_columns=2, name="racks")
    cooling = rrb.Grid(
        *plots("hvac_kw", "pue"),
        _plot_view(f"{tab.path}/crac/temperature_c", "CRAC supply and return air [C]"),
        _plot_view(f"{tab.path}/crac/airflow_m3s", "CRAC airflow [m3/s]"),
        *plots("weather_c", "water_l"),
        grid_columns=2,
        name="cooling",
    )
    work = rrb.Grid(
        *plots(
            "load", "work_tasks", "queue_age_h", "commands", "carbon_kg", "price", "energy_cost"
        ),
        *(plots(REWARDS_ENTITY) if has_rewards else []),
        grid_columns=2,
        name="work",
    )
    airflow = [_airflow_view(tab)] if tab.has_airflow else []
    zones = [_zones_view(tab)] if tab.zones else []
    liquid = [_liquid_view(tab)] if tab.has_liquid else []
    return rrb.Tabs(overview, racks, *airflow, *zones, cooling, *liquid, work, active_tab=0)


def _airflow_view(tab: FocusTab) -> Any:
    """Return the views of the share map and of the sources of exhaust."""
    shares = _rack_map(
        tab,
        f"{tab.path}/airflow/shares",
        "CRAC unit that gives most of the supply air, stronger colour for a larger share",
        ("racks",),
    )
    close_ups = rrb.Spatial2DView(
        origin=f"{tab.path}/airflow/close_ups",
        name="exhaust that warms the five hottest racks, from the back of racks to their front",
    )
    sources = rrb.TextDocumentView(
        origin=f"{tab.path}/airflow/sources", name="parts of their inlets"
    )
    return rrb.Vertical(shares, close_ups, sources, row_shares=[4, 4, 3], name="airflow")


def _liquid_view(tab: FocusTab) -> Any:
    """Return the diagram of the loops, and the plots of loops and CDUs."""
    diagram = rrb.Spatial2DView(
        origin=f"{tab.path}/liquid/loop",
        name="loops: racks, CDUs, heat reuse, cooler",
        visual_bounds=rrb.VisualBounds2D(
            x_range=(0, DIAGRAM_SIZE[0]), y_range=(0, DIAGRAM_SIZE[1])
        ),
    )
    plots = [
        _plot_view(f"{tab.path}/liquid/{entity}", f"{plot.title} [{plot.unit}]")
        for entity, plot in liquid_plots(has_junctions="junction" in tab.scales).items()
    ]
    cdus = [
        _plot_view(f"{tab.path}/liquid/{entity}", f"CDU {title}")
        for entity, (_, title, _) in CDU_PLOTS.items()
    ]
    return rrb.Vertical(
        diagram, rrb.Grid(*plots, *cdus, grid_columns=2), row_shares=[1, 2], name="liquid"
    )


def _zones_view(tab: FocusTab) -> Any:
    """Return the map of zones, and tabs with the racks of all zones and of each zone."""
    zones = rrb.Spatial2DView(
        origin=f"{tab.path}/zones", name="zones: edge the hottest inlet, middle the mean [C]"
    )
    title = "all zones: hottest inlet of each rack [C]"
    whole = _rack_map(tab, f"{tab.path}/zone_racks", title, ("racks", "crac", "down", "down_text"))
    single = [
        rrb.Spatial2DView(
            origin=f"{tab.path}/zone_racks/{zone}",
            contents=["$origin", f"+ {tab.path}/map/racks"],
            name=f"zone {zone}",
            visual_bounds=rrb.VisualBounds2D(x_range=(-1, places + 1), y_range=(-1, rows + 1)),
        )
        for zone, (rows, places) in enumerate(tab.zones)
    ]
    racks = rrb.Tabs(whole, *single, active_tab=0)
    return rrb.Vertical(zones, racks, row_shares=[1, 1], name="zones")


def _series_view(tab: FocusTab, entity: str) -> Any:
    """Return the plot of an entity of ``PLOTS``, of the queue or of rewards."""
    origin = f"{tab.path}/series/{entity}"
    if entity == QUEUE_ENTITY:
        return _plot_view(origin, "queue by age [tasks]")
    if entity == REWARDS_ENTITY:
        return _plot_view(origin, "reward terms [-]")
    plot = PLOTS[entity]
    # A plot with one line needs no legend, because its title names the line.
    legend = len(plot.lines) > 1
    return _plot_view(origin, f"{plot.title} [{plot.unit}]", limits=plot.limits, legend=legend)


def _heat_map(tab: FocusTab, quantity: str, scale: ColourScale) -> Any:
    """Return the view of a heat map of racks, with its colour bar below."""
    bar = rrb.Spatial2DView(
        origin=f"{tab.path}/legend/{quantity}",
        name=f"colours of {MAP_TITLES[quantity]} [{scale.unit}]",
        visual_bounds=rrb.VisualBounds2D(x_range=(-34, 274), y_range=(-26, 32)),
    )
    name = MAP_TITLES[quantity]
    if quantity == "change":
        name = f"{name} {tab.reference}"
    title = f"{name} [{scale.unit}]"
    marks = ["racks", "crac", "down", "down_text"]
    if quantity != "junction":  # the mark is at the hottest inlet
        marks += ["hottest", "hottest_text"]
    image = _rack_map(tab, f"{tab.path}/map/{quantity}", title, marks)
    return rrb.Vertical(image, bar, row_shares=[5, 2], name=quantity)


def _state_view(tab: FocusTab) -> Any:
    """Return the view of the states of racks, with its legend below."""
    legend = rrb.Spatial2DView(
        origin=f"{tab.path}/legend/state",
        name="states",
        visual_bounds=rrb.VisualBounds2D(x_range=(-30, 210), y_range=(-12, 24)),
    )
    states = _rack_map(
        tab, f"{tab.path}/state", "state of the racks", ("racks", "crac", "down", "down_text")
    )
    return rrb.Vertical(states, legend, row_shares=[5, 2], name="state")


def _rack_map(tab: FocusTab, origin: str, name: str, marks: Sequence[str]) -> Any:
    """Return the view of a map of racks.

    Args:
        tab: the tab.
        origin: path of the map.
        name: title of the view.
        marks: entities that are shown with the map. With ``racks``, a pointer on the map names the
            rack, from the map of names behind it.
    """
    height, width = tab.image_shape
    edge = 0.08 * max(height, width)
    return rrb.Spatial2DView(
        origin=origin,
        contents=["$origin/**", *(f"+ {tab.path}/map/{mark}" for mark in marks)],
        background=_MAP_BACKGROUND,
        name=name,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-edge, width + edge), y_range=(-0.2 * height, 1.15 * height)
        ),
    )


def _hall_view(tab: FocusTab) -> Any:
    """Return the view of the hall in 3D, seen from the side of row 0."""
    length, width, _ = tab.size_m
    far = max(length, width)
    eye = rrb.EyeControls3D(
        kind="Orbital",
        position=(length / 2 - 0.24 * far, -0.28 * far, 0.48 * far),
        look_target=(length / 2, 0.4 * width, 0.0),
        eye_up=(0.0, 0.0, 1.0),
    )
    return rrb.Spatial3DView(
        origin=f"{tab.path}/hall",
        name="hall: fronts show inlets, backs outlets, in the colours of the maps",
        eye_controls=eye,
        line_grid=False,
    )


def _plot_view(
    origin: str,
    name: str,
    *,
    limits: tuple[float, float] | None = None,
    legend: bool = True,
) -> Any:
    """Return the plot of an entity over time.

    Args:
        origin: path of the entity.
        name: title of the plot.
        limits: ends of the vertical axis; None scales the axis to the values.
        legend: True to show the names of the lines.
    """
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=_whole_run(),
        axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
        # The legend covers a part of the curves. At the left it covers the first hours of the run,
        # which are at night and least interesting.
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
    )


def _whole_run() -> Any:
    """Return a time axis that spans the whole run; Rerun's default is one minute at the cursor."""
    ends = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(link="Independent", view_range=rrb.TimeRange(start=ends[0], end=ends[1]))


def fleet_entities() -> Entities:
    """Yield the static entities of the fleet: line styles."""
    for entity, plot in FLEET_PLOTS.items():
        yield f"fleet/{entity}", series_lines([plot.title], [plot.colour])


def data_center_entities(
    fleet: Fleet,
    dc: int,
    path: str,
    scales: Mapping[str, ColourScale],
    levels: int,
    rewards: Sequence[str],
) -> Entities:
    """Yield the static entities of a data center: line styles, states, image formats, 3D hall.

    Args:
        fleet: the fleet.
        dc: index of the data center.
        path: path of the data center in the recording.
        scales: colour scales of the heat maps, keyed by quantity.
        levels: number of levels per rack of the 3D hall.
        rewards: names of the reward terms.
    """
    for entity, plot in PLOTS.items():
        names = [f"{name} [{plot.unit}]" for name, *_ in plot.lines]
        yield f"{path}/series/{entity}", series_lines(names, [colour for *_, colour in plot.lines])
    yield f"{path}/series/{QUEUE_ENTITY}", series_lines(QUEUE_NAMES, QUEUE_COLOURS)
    if rewards:
        reward_colours = [PALETTE[i % len(PALETTE)] for i in range(len(rewards))]
        names = [f"{name} [-]" for name in rewards]
        yield f"{path}/series/{REWARDS_ENTITY}", series_lines(names, reward_colours)
    units = int(fleet.unit_offsets[dc + 1] - fleet.unit_offsets[dc])
    names, unit_colours = device_lines(units, "unit", "supply [C]")
    names, unit_colours = [*names, "return, all units [C]"], [*unit_colours, RED]
    yield f"{path}/crac/temperature_c", series_lines(names, unit_colours)
    yield f"{path}/crac/airflow_m3s", series_lines(*device_lines(units, "unit", "airflow [m3/s]"))
    state_colours = np.array(STATE_COLOURS, np.uint32)
    for entity, (_, states) in COMMAND_STATES.items():
        shown = rr.StateConfiguration(values=states, labels=states, colors=state_colours)
        yield f"{path}/actions/{entity}", shown
    yield from _map_entities(fleet.configs[dc].hall, path, scales)
    hall = fleet.configs[dc].hall
    yield from mark_entities(f"{path}/map", hall, units, rasters.tile_grid(hall))
    yield from _hall_entities(fleet, dc, f"{path}/hall", levels, units)


def _map_entities(hall: HallConfig, path: str, scales: Mapping[str, ColourScale]) -> Entities:
    """Yield the static entities of the maps of a hall: classes, colour bars, names of racks."""
    grid = rasters.tile_grid(hall)
    height, width = grid.image_shape
    for quantity, scale in scales.items():
        image_format = rr.components.ImageFormat(
            width=width, height=height, color_model="L", channel_datatype="U8"
        )
        image = rr.SegmentationImage.from_fields(format=image_format, opacity=1.0)
        yield f"{path}/map/{quantity}", image
        yield from scale_entities(path, quantity, scale)
    per_row = hall.racks_per_row
    if hall.racks <= rasters.MAX_NAMED_RACKS:
        names = [rack_place(rack, per_row) for rack in range(hall.racks)]
    else:
        names = [
            f"row {row}, racks {row * per_row} to {(row + 1) * per_row - 1}"
            for row in range(hall.rows)
        ]
    # Names are drawn in no colour behind the maps, only for the pointer.
    yield f"{path}/map/racks", invisible_names(names)
    numbers = rr.SegmentationImage(rasters.rack_numbers(grid), opacity=1.0, draw_order=-100.0)
    yield f"{path}/map/racks", numbers


def scale_entities(path: str, quantity: str, scale: ColourScale) -> Entities:
    """Yield the static entities of the colours of a map: its classes, and its colour bar."""
    yield f"{path}/map/{quantity}", annotation_context(scale)
    yield from _colour_bar(f"{path}/legend/{quantity}", scale)


def _hall_entities(
    fleet: Fleet,
    dc: int,
    path: str,
    levels: int,
    units: int,
) -> Entities:
    """Yield the static entities of a 3D hall: voxels, walls, row labels and CRAC units."""
    hall = fleet.configs[dc].hall
    grid = rasters.rack_voxels(hall, levels)
    for quantity, cells in (("inlet", grid.front), ("outlet", grid.back)):
        voxels = rr.VoxelGridMap.from_fields(
            voxel_indices=cells.astype(np.int32),
            voxel_size=grid.size_m,
            translation=(hall.layout.end_margin_m, 0.0, 0.0),
        )
        yield f"{path}/{quantity}", voxels
    plan, height_m = floor_plan(hall), hall.layout.rack_height_m
    corners = [(0.0, 0.0), (plan.length_m, 0.0), (plan.length_m, plan.width_m), (0.0, plan.width_m)]
    walls = [[(x, y, z) for x, y in (*corners, corners[0])] for z in (0.0, hall.layout.ceiling_m)]
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
        centers=unit_centres_m(hall, units),
        half_sizes=[unit_half_size_m(hall)] * units,
        fill_mode="solid",
        colors=UNIT_RGB,
        labels=[f"CRAC {unit}" for unit in range(units)],
        show_labels=units <= MAX_UNIT_LABELS,
    )
    yield f"{path}/crac", boxes
    # In small halls the label of the unit itself is at the same place.
    style = rr.Boxes3D.from_fields(
        fill_mode="solid", colors=DOWN_RGB, show_labels=units > MAX_UNIT_LABELS
    )
    yield f"{path}/down", style


def _colour_bar(path: str, scale: ColourScale) -> Entities:
    """Yield the entities of a colour bar: a gradient, and points labelled with values.

    The viewer has no colour bars of its own.
    """
    gradient, ticks = rasters.colour_bar(scale)
    height, width = gradient.shape
    yield f"{path}/bar", annotation_context(scale)
    yield f"{path}/bar", rr.SegmentationImage(gradient, opacity=1.0)

    def places(values: Sequence[float]) -> F64:
        share = (np.array(values) - scale.low) / (scale.high - scale.low)
        return np.asarray(share * width, np.float64)

    def points(x: F64, y: float, texts: Sequence[str] = (), radius: float = 1.5) -> rr.Points2D:
        return rr.Points2D(
            np.stack([x, np.full_like(x, y)], axis=1),
            radii=rr.Radius.ui_points(radius),
            colors=_LABEL_RGB,
            labels=texts or None,
            show_labels=bool(texts),
        )

    names = [f"{tick:g} {scale.unit}" for tick in ticks]
    yield f"{path}/ticks", points(places(ticks), height + 2.0, names)
    if scale.marks:
        x = places([value for value, _ in scale.marks])
        yield f"{path}/limits", points(x, -2.0)
        # The viewer draws labels below their points. Those of limits at an end of the bar are
        # moved inwards, because an edge of the view would cut them.
        inside = np.clip(x, _LIMIT_LABEL_EDGE, width - _LIMIT_LABEL_EDGE)
        has_space = np.diff(inside, append=np.inf) >= _LIMIT_LABELS_APART
        texts = [
            f"{name} {value:g}" if fits else f"{value:g}"
            for (value, name), fits in zip(scale.marks, has_space, strict=True)
        ]
        yield f"{path}/limit_names", points(inside, -25.0, texts, 0.0)
