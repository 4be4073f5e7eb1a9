"""How the viewer lays a recording out: a tab per data center in focus, and one for the fleet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .hall_layers import Scale
from .recording_series import FLEET, PLOTS, QUEUE, REWARDS

if TYPE_CHECKING:
    import rerun.blueprint as rrb

PLAYBACK_S_PER_S = 14_400.0


class Tab(NamedTuple):
    """What a data center in focus shows."""

    name: str
    path: str
    size_m: tuple[float, float, float]
    """Of the room."""
    scales: Mapping[str, Scale]
    """Of its heat maps."""
    image: tuple[int, int]
    """Height and width of these."""


def blueprint(tabs: Sequence[Tab], *, hottest: bool, rewards: bool) -> rrb.Blueprint:
    """Layout of a recording.

    Args:
        tabs: data centers in focus.
        hottest: whether a table of the hottest halls is recorded.
        rewards: whether reward terms are.
    """
    import rerun.blueprint as rrb

    whole_run = _whole_run()
    overall = [
        _plot(f"fleet/{entity}", line.title, whole_run, legend=False)
        for entity, line in FLEET.items()
    ]
    texts = [rrb.TextDocumentView(origin="summary", name="summary")]
    if hottest:
        texts.append(rrb.TextDocumentView(origin="fleet/hottest", name="hottest halls"))
    fleet = rrb.Horizontal(
        rrb.Vertical(*texts),
        rrb.Grid(*overall, grid_columns=2),
        column_shares=[2, 3],
        name="fleet",
    )
    return rrb.Blueprint(
        rrb.Tabs(*(_data_center(tab, whole_run, rewards=rewards) for tab in tabs), fleet),
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


def _data_center(tab: Tab, whole_run: Any, *, rewards: bool) -> Any:
    import rerun.blueprint as rrb

    def plots(*entities: str) -> list[Any]:
        titles = {name: plot.title for name, plot in PLOTS.items()}
        titles |= {QUEUE: "queue by age [tasks]", REWARDS: "reward terms [-]"}
        limits = {name: plot.limits for name, plot in PLOTS.items()}
        # The title of a plot with one line is its name.
        alone = {name for name, plot in PLOTS.items() if len(plot.lines) == 1}
        return [
            _plot(
                f"{tab.path}/series/{e}",
                titles[e],
                whole_run,
                limits=limits.get(e),
                legend=e not in alone,
            )
            for e in entities
        ]

    actions = rrb.StateTimelineView(
        origin=f"{tab.path}/actions", name="actions", time_view=whole_run
    )
    overview = rrb.Grid(
        *plots("temperature_c", "power_kw", "carbon_intensity", QUEUE, "battery"),
        actions,
        grid_columns=2,
        name="overview",
    )
    cooling = rrb.Grid(
        *plots("hvac_kw", "pue"),
        _plot(f"{tab.path}/crac/temperature_c", "CRAC supply and return air [C]", whole_run),
        _plot(f"{tab.path}/crac/airflow_m3s", "CRAC airflow [m3/s]", whole_run),
        *plots("weather_c", "water_l"),
        grid_columns=2,
        name="cooling",
    )
    work = rrb.Grid(
        *plots("load", "work_tasks", "queue_age_h", "commands", "carbon_kg"),
        *(plots(REWARDS) if rewards else []),
        grid_columns=2,
        name="work",
    )
    maps = rrb.Tabs(
        *(_heat_map(tab, what, scale) for what, scale in tab.scales.items()), active_tab=0
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
    places = rrb.Vertical(maps, _hall(tab), events, row_shares=[5, 4, 2])
    return rrb.Horizontal(
        places,
        rrb.Tabs(overview, cooling, work, active_tab=0),
        column_shares=[4, 5],
        name=tab.name,
    )


def _heat_map(tab: Tab, what: str, scale: Scale) -> Any:
    import rerun.blueprint as rrb

    bar = rrb.Spatial2DView(
        origin=f"legend/{what}",
        name=f"{what} scale, {scale.low:g} to {scale.high:g} {scale.unit}",
        visual_bounds=rrb.VisualBounds2D(x_range=(-8, 252), y_range=(-2, 24)),
    )
    height, width = tab.image
    edge = 0.04 * max(height, width)
    image = rrb.Spatial2DView(
        origin=f"{tab.path}/map/{what}",
        name=f"rack {what} [{scale.unit}]",
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-edge, width + edge), y_range=(-edge, height + edge)
        ),
    )
    return rrb.Vertical(image, bar, row_shares=[5, 2], name=what)


def _hall(tab: Tab) -> Any:
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


def _plot(
    origin: str,
    name: str,
    whole_run: Any,
    *,
    limits: tuple[float, float] | None = None,
    legend: bool = True,
) -> Any:
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
    """On a timestamp timeline plots open on one minute around the cursor: pin the whole run."""
    import rerun as rr
    import rerun.blueprint as rrb

    ends = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(link="Independent", view_range=rrb.TimeRange(start=ends[0], end=ends[1]))
