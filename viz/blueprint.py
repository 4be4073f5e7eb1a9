"""How the viewer lays a recording out: a tab per data center in focus, and one for the fleet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .hall_layers import Scale
from .recording_series import FLEET, PLOTS, QUEUE, REWARDS

if TYPE_CHECKING:
    import rerun as rr
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

    plot = _Plots()
    overall = [plot(f"fleet/{entity}", line.title, legend=False) for entity, line in FLEET.items()]
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
        rrb.Tabs(*(_data_center(tab, plot, rewards=rewards) for tab in tabs), fleet),
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


def _data_center(tab: Tab, plot: _Plots, *, rewards: bool) -> Any:
    import rerun.blueprint as rrb

    def plots(*entities: str) -> list[Any]:
        titles = {name: given.title for name, given in PLOTS.items()}
        titles |= {QUEUE: "queue by age [tasks]", REWARDS: "reward terms [-]"}
        limits = {name: given.limits for name, given in PLOTS.items()}
        # The title of a plot with one line is its name.
        alone = {name for name, given in PLOTS.items() if len(given.lines) == 1}
        return [
            plot(
                f"{tab.path}/series/{e}",
                titles[e],
                limits=limits.get(e),
                legend=e not in alone,
            )
            for e in entities
        ]

    actions = rrb.StateTimelineView(
        origin=f"{tab.path}/actions", name="actions", time_view=plot.whole_run
    )
    overview = rrb.Grid(
        *plots("temperature_c", "power_kw", "carbon_intensity", QUEUE, "battery"),
        actions,
        grid_columns=2,
        name="overview",
    )
    cooling = rrb.Grid(
        *plots("hvac_kw", "pue"),
        plot(f"{tab.path}/crac/temperature_c", "CRAC supply and return air [C]"),
        plot(f"{tab.path}/crac/airflow_m3s", "CRAC airflow [m3/s]"),
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


class _Plots:
    """Plots over time, which have their properties in common."""

    def __init__(self) -> None:
        import rerun as rr
        import rerun.blueprint as rrb

        ends = rr.TimeRangeBoundary.infinite(), rr.TimeRangeBoundary.infinite()
        whole_run = rrb.TimeRange(start=ends[0], end=ends[1])
        # On a timestamp timeline plots open on one minute around the cursor.
        self.whole_run = rrb.TimeAxis(link="Independent", view_range=whole_run)
        self._axis = _Once(self.whole_run)
        # A legend covers what is behind it; the night that a run begins with is the least loss.
        self._legend = {
            visible: _Once(rrb.PlotLegend("LeftTop", visible=visible)) for visible in (False, True)
        }
        self._contents = rrb.archetypes.ViewContents("$origin/**")

    def __call__(
        self,
        origin: str,
        name: str,
        *,
        limits: tuple[float, float] | None = None,
        legend: bool = True,
    ) -> rrb.View:
        import rerun.blueprint as rrb

        properties: dict[str, rr.AsComponents] = {
            "TimeAxis": self._axis,
            "PlotLegend": self._legend[legend],
        }
        if limits is not None:
            properties["ScalarAxis"] = _Once(rrb.ScalarAxis(range=limits))
        # As TimeSeriesView would, with properties that are not converted for each plot.
        return rrb.View(
            class_identifier="TimeSeries",
            origin=origin,
            contents=self._contents,
            name=name,
            properties=properties,
        )


class _Once:
    """Properties of views, converted for Rerun once."""

    def __init__(self, given: rr.AsComponents) -> None:
        self._batches = given.as_component_batches()

    def as_component_batches(self) -> list[rr.DescribedComponentBatch]:
        return self._batches
