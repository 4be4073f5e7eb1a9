"""Views of a recording: a tab per data center in focus, and one for the fleet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .hall_rasters import ColourScale
from .recording_series import FLEET_PLOTS, PLOTS, QUEUE_ENTITY, REWARDS_ENTITY

if TYPE_CHECKING:
    import rerun.blueprint as rrb

PLAYBACK_S_PER_S = 14_400.0
"""Simulated seconds per second of playback."""


class FocusTab(NamedTuple):
    """Tab of a data center in focus."""

    name: str
    """Name of the data center in the recording."""
    path: str
    """Path of the data center's entities."""
    size_m: tuple[float, float, float]
    """Length, width and height of the room, in m."""
    scales: Mapping[str, ColourScale]
    """Colour scales of the heat maps, by quantity."""
    image_shape: tuple[int, int]
    """Height and width of the heat maps, in pixels."""


def make_blueprint(
    tabs: Sequence[FocusTab], *, has_hottest: bool, has_rewards: bool
) -> rrb.Blueprint:
    """Arrange the views of a recording.

    Args:
        tabs: tabs of the data centers in focus.
        has_hottest: whether the hottest halls are recorded.
        has_rewards: whether reward terms are recorded.
    """
    import rerun.blueprint as rrb

    whole_run = _whole_run()
    focus_tabs = (_focus_tab(tab, whole_run, has_rewards=has_rewards) for tab in tabs)
    return rrb.Blueprint(
        rrb.Tabs(*focus_tabs, _fleet_tab(whole_run, has_hottest=has_hottest)),
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


def _fleet_tab(whole_run: Any, *, has_hottest: bool) -> Any:
    """Texts, and plots over all data centers."""
    import rerun.blueprint as rrb

    texts = [rrb.TextDocumentView(origin="summary", name="summary")]
    if has_hottest:
        texts.append(rrb.TextDocumentView(origin="fleet/hottest", name="hottest halls"))
    plots = [
        _plot_view(f"fleet/{entity}", plot.title, whole_run, legend=False)
        for entity, plot in FLEET_PLOTS.items()
    ]
    return rrb.Horizontal(
        rrb.Vertical(*texts),
        rrb.Grid(*plots, grid_columns=2),
        column_shares=[2, 3],
        name="fleet",
    )


def _focus_tab(tab: FocusTab, whole_run: Any, *, has_rewards: bool) -> Any:
    """Heat maps, 3D hall and log at the left, plots at the right."""
    import rerun.blueprint as rrb

    maps = rrb.Tabs(
        *(_heat_map(tab, quantity, scale) for quantity, scale in tab.scales.items()), active_tab=0
    )
    events = rrb.TextLogView(
        origin=f"{tab.path}/events",
        name="events",
        columns=rrb.TextLogColumns(
            # The text has the time, for which the column is too narrow.
            timeline_columns=[rrb.encodings.TimelineColumn("sim_time", visible=False)],
            text_log_columns=["loglevel", "body"],
        ),
    )
    hottest = rrb.TextDocumentView(origin=f"{tab.path}/hottest", name="why the hottest are hot")
    texts = rrb.Tabs(events, hottest, active_tab=0)
    hall = rrb.Vertical(maps, _hall_view(tab), texts, row_shares=[5, 4, 2])
    return rrb.Horizontal(
        hall,
        _plot_tabs(tab, whole_run, has_rewards=has_rewards),
        column_shares=[4, 5],
        name=tab.name,
    )


def _plot_tabs(tab: FocusTab, whole_run: Any, *, has_rewards: bool) -> Any:
    """Plots of a data center in tabs: overview, cooling and work."""
    import rerun.blueprint as rrb

    def plots(*entities: str) -> list[Any]:
        return [_series_view(tab, entity, whole_run) for entity in entities]

    actions = rrb.StateTimelineView(
        origin=f"{tab.path}/actions", name="actions", time_view=whole_run
    )
    overview = rrb.Grid(
        *plots("temperature_c", "power_kw", "carbon_intensity", QUEUE_ENTITY, "battery"),
        actions,
        grid_columns=2,
        name="overview",
    )
    cooling = rrb.Grid(
        *plots("hvac_kw", "pue"),
        _plot_view(f"{tab.path}/crac/temperature_c", "CRAC supply and return air [C]", whole_run),
        _plot_view(f"{tab.path}/crac/airflow_m3s", "CRAC airflow [m3/s]", whole_run),
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
    return rrb.Tabs(overview, cooling, work, active_tab=0)


def _series_view(tab: FocusTab, entity: str, whole_run: Any) -> Any:
    """Plot of a series of a data center."""
    origin = f"{tab.path}/series/{entity}"
    if entity == QUEUE_ENTITY:
        return _plot_view(origin, "queue by age [tasks]", whole_run)
    if entity == REWARDS_ENTITY:
        return _plot_view(origin, "reward terms [-]", whole_run)
    plot = PLOTS[entity]
    # The title of a plot with one line is its name.
    legend = len(plot.lines) > 1
    return _plot_view(origin, plot.title, whole_run, limits=plot.limits, legend=legend)


def _heat_map(tab: FocusTab, quantity: str, scale: ColourScale) -> Any:
    """Heat map of the racks over its colour bar."""
    import rerun.blueprint as rrb

    bar = rrb.Spatial2DView(
        origin=f"legend/{quantity}",
        name=f"{quantity} scale, {scale.low:g} to {scale.high:g} {scale.unit}",
        visual_bounds=rrb.VisualBounds2D(x_range=(-8, 252), y_range=(-2, 24)),
    )
    height, width = tab.image_shape
    edge = 0.04 * max(height, width)
    image = rrb.Spatial2DView(
        origin=f"{tab.path}/map/{quantity}",
        name=f"rack {quantity} [{scale.unit}]",
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-edge, width + edge), y_range=(-edge, height + edge)
        ),
    )
    return rrb.Vertical(image, bar, row_shares=[5, 2], name=quantity)


def _hall_view(tab: FocusTab) -> Any:
    """The hall in 3D, seen from the side of row 0."""
    import rerun.blueprint as rrb

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
    whole_run: Any,
    *,
    limits: tuple[float, float] | None = None,
    legend: bool = True,
) -> Any:
    """Plot of an entity over time.

    Args:
        origin: path of the entity.
        name: title of the plot.
        whole_run: time axis.
        limits: ends of the vertical axis; None follows the values.
        legend: whether the names of the lines are shown.
    """
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        axis_x=whole_run,
        axis_y=None if limits is None else rrb.ScalarAxis(range=limits),
        # A legend covers what is behind it; the night that a run begins with is the least loss.
        plot_legend=rrb.PlotLegend("LeftTop", visible=legend),
    )


def _whole_run() -> Any:
    """Time axis over the whole run; without it plots open on one minute around the cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    ends = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(link="Independent", view_range=rrb.TimeRange(start=ends[0], end=ends[1]))
