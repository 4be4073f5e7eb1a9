"""Floor plans of a hall, to scale: at its design point, and after the worst cooling failure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig, HallConfig
from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.hall.floor_plan import FloorPlan, floor_plan, unit_places_m
from sdc_taichi.run.failover import MINUTES, Failover
from sdc_taichi.run.rack_places import RackPlaces
from sdc_taichi.sim.design_hall import DesignHall, solve_design_hall
from sdc_taichi.types import F64

from .liquid_loop import junction_limits_c
from .plotting import (
    BLUE,
    DPI,
    GREEN,
    GREY,
    LINE_COLOURS,
    ORANGE,
    RED,
    SKY,
    colour_range,
    literal_text,
    new_figure,
    remove_frame,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONG_SIDE_IN = 11.0
"""Largest width of a floor plan, in inches."""
FAILOVER_SIDE_IN = 6.0
"""Largest width of the floor plan in the figure of a failover study, in inches."""
SHORT_SIDE_IN = (2.2, 8.0)
"""Smallest and largest height of a floor plan, in inches.

Halls of more extreme proportions are stretched to this range.
"""
MAX_UNTOLD_STRETCH = 1.02
"""Largest ratio of vertical to horizontal scale that the axis label does not mention."""
RACK_LABEL_PX = (34.0, 15.0)
"""Width and height that the number in a rack needs, in pixels."""
MIN_ROW_PITCH_PX = 6.0
"""Smallest distance of rows at which aisles and rack fronts are drawn, in pixels."""
UNIT_SIZE_M = (0.9, 2.0)
"""Smallest depth (away from the wall) and width of the symbol of a CRAC unit, in m."""
CURVES = 6
"""Number of worst losses whose hottest inlet is drawn over time, besides the case without loss."""


@dataclass(frozen=True, slots=True)
class RackValues:
    """Values of the R racks of a floor plan, which the colours of the racks show."""

    values: F64
    """Value of each rack, (R,); racks whose values are masked are grey."""
    label: str
    """Name of the values with their unit, for the colour bar."""
    marked: int
    """Index of the rack that is outlined."""
    mark_label: str
    """Description of the outlined rack, for the legend."""
    digits: int = 1
    """Number of decimals of the numbers in the racks."""


def floor_plan_figure(
    hall: DataCenterConfig | DesignHall, shown: RackValues | None = None
) -> Figure:
    """Draw walls, rows, aisles, floor tiles, air returns and CRAC units of a hall, to scale.

    The longer side of the room is horizontal. Labels that do not fit are omitted.

    Args:
        hall: config of a data center, or the result of ``solve_design_hall`` for it.
        shown: values that colour the racks; None shows the rack inlets at the design point.

    Raises:
        SdcError: matplotlib is missing, or the hall has no solution at its design point.
    """
    figure = new_figure(1.0, 1.0)
    solved = solve_design_hall(hall) if isinstance(hall, DataCenterConfig) else hall
    shown = shown or RackValues(
        values=solved.inlet_c,
        label="rack inlet at the design point (°C)",
        marked=solved.hottest_rack,
        mark_label=f"hottest server, {solved.inlet_max_c.max():.1f} °C",
    )
    page = _page(solved.config.hall, len(solved.unit_m3s), LONG_SIDE_IN)
    figure.set_size_inches(page.size_in[0] + 1.9, page.size_in[1] + 1.3)
    axes = figure.subplots()
    _draw_room(axes, page)
    _draw_racks(axes, page, shown)
    _draw_design_units(axes, page, solved.unit_m3s)
    _label_rows(axes, page)
    _add_title_and_legend(
        axes,
        f"{literal_text(solved.config.name)}: {page.hall.rows} rows of {page.hall.racks_per_row} "
        f"racks, {page.plan.length_m:.4g} x {page.plan.width_m:.4g} m, "
        f"{solved.it_w.sum() / 1e3:,.0f} kW IT, {_airflow_text(solved.unit_m3s.sum())} m³/s supply "
        f"at {solved.supply_c:g} °C",
        columns=4,
    )
    return figure


def places_figure(study: RackPlaces) -> Figure:
    """Draw the floor plan of a hall with new racks at the best candidate, marked by crosses.

    Raises:
        SdcError: matplotlib is missing, or the hall has no solution at its design point.
    """
    from matplotlib.collections import PolyCollection

    best, solved = study.candidates[0], solve_design_hall(study.best)
    shown = RackValues(
        values=best.rack_inlet_c,
        label="hottest inlet of the rack at full load (°C)",
        marked=best.hottest_rack,
        mark_label=f"hottest rack, {best.hottest_c:.1f} °C",
    )
    figure = floor_plan_figure(solved, shown)
    axes = figure.axes[0]
    page = _page(study.config.hall, len(solved.unit_m3s), LONG_SIDE_IN)
    axes.add_collection(
        PolyCollection(
            list(_rack_boxes(page)[list(best.racks)]),
            facecolor="none",
            edgecolor=GREEN,
            linewidth=2.5,
            label=f"new racks of {literal_text(study.type)}",
        )
    )
    fits = "fits" if not best.exceeded else f"exceeds: {'; '.join(best.exceeded)}"
    _add_title_and_legend(
        axes,
        f"{literal_text(study.config.name)} with {study.count} {literal_text(study.type)} at "
        f"{literal_text(best.places)}: {best.it_kw:,.0f} kW IT, {fits}",
        columns=5,
    )
    return figure


def _add_title_and_legend(axes: Axes, title: str, *, columns: int) -> None:
    """Set the title of a floor plan, and a legend with a number of columns below it."""
    axes.set_title(title, fontsize=10, loc="left", pad=22)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, fontsize=8.5, frameon=False,
                borderaxespad=0.2, handlelength=1.6)  # fmt: skip


def failover_figure(study: Failover) -> Figure:
    """Draw a failover study: racks after the worst loss, and their hottest one over time.

    The floor plan shows the inlets 15 minutes after the worst loss of cooling, and colours each
    CRAC unit by the effect of losing that unit alone: racks trip, racks throttle, or neither. The
    curves show the hottest inlet of the hall after each of the worst losses. Studies of liquid
    cooling show junctions if there are some, and on the floor plan the hottest minute, because
    junctions cool once racks have tripped.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(13.0, 5.6)
    axes, curves = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    worst = study.worst[0]
    rack_c = study.rack_c[worst]
    hottest = int(rack_c.argmax())
    page = _page(study.config.hall, study.config.hvac.crac.units, FAILOVER_SIDE_IN)
    _draw_room(axes, page)
    label = "hottest inlet of the rack (°C)"
    if study.of_junctions:
        rack_c, label = np.ma.masked_equal(rack_c, 0.0), "hottest junction of the rack (°C)"
    _draw_racks(axes, page, RackValues(rack_c, label, hottest, "hottest rack"))
    if any(loss.units for loss in study.losses):
        _draw_failed_units(axes, page, study)
    minute = study.shown_min[worst]
    when = f"hottest minute, {minute} min" if study.lost == "liquid" else f"{minute} minutes"
    axes.set_title(
        f"{literal_text(study.config.name)}: {when} after the loss of {study.losses[worst].name}",
        fontsize=10,
        loc="left",
    )
    _draw_curves(curves, study)
    return figure


@dataclass(frozen=True, slots=True)
class _Page:
    """Placement of a room on a page, with the longer side of the room horizontal."""

    hall: HallConfig
    """Config of the hall."""
    plan: FloorPlan
    """Positions of the racks and walls of the hall."""
    is_turned: bool
    """True if y is the longer side of the room, so that y is horizontal on the page."""
    unit_places_m: F64
    """Positions of the U CRAC units on the end walls, in m, (U, 2)."""
    unit_m: tuple[float, float]
    """Depth (away from the wall) and width of the symbol of a CRAC unit, in m."""
    limits_m: tuple[tuple[float, float], tuple[float, float]]
    """Lower and upper end of the picture along x, and along y, in m."""
    size_in: tuple[float, float]
    """Width and height of the picture, in inches."""
    px_per_m: tuple[float, float]
    """Scale of the picture along x and y, in pixels per m."""

    def place(self, xy: npt.ArrayLike) -> npt.NDArray[Any]:
        """Convert points (x, y) of the room to page coordinates, in m, shape (..., 2)."""
        points = np.asarray(xy)
        return points[..., ::-1] if self.is_turned else points

    def point(self, x: float, y: float) -> tuple[float, float]:
        """Convert a point of the room to page coordinates, in m."""
        return (y, x) if self.is_turned else (x, y)

    def box(self, x0: float, x1: float, y0: float, y1: float) -> npt.NDArray[Any]:
        """Return the corners of a rectangle of the room in page coordinates, in m, (4, 2)."""
        return self.place([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])

    def fits(self, x_m: float, y_m: float, px: tuple[float, float]) -> bool:
        """Return True if a text fits into a rectangle of the room.

        Args:
            x_m: size of the rectangle along x, in m.
            y_m: size of the rectangle along y, in m.
            px: width and height of the text, in pixels.
        """
        size = (x_m * self.px_per_m[0], y_m * self.px_per_m[1])
        width, height = size[::-1] if self.is_turned else size
        return width >= px[0] and height >= px[1]

    @property
    def row_y_m(self) -> F64:
        """Coordinate y of the middle of each row, in m, (rows,)."""
        return self.plan.centre_m[:: self.hall.racks_per_row, 1]

    @property
    def row_gap_m(self) -> float:
        """Mean distance between the middles of adjacent rows, in m; of one row the room's width."""
        y = self.row_y_m
        return float(np.ptp(y)) / (len(y) - 1) if len(y) > 1 else self.plan.width_m

    @property
    def is_coarse(self) -> bool:
        """True if the rows are too close on the page to draw their aisles."""
        return self.row_gap_m * self.px_per_m[1] < MIN_ROW_PITCH_PX

    @property
    def stretch(self) -> float:
        """Ratio of vertical to horizontal scale on the page."""
        x, y = self.px_per_m
        return x / y if self.is_turned else y / x


def _page(hall: HallConfig, units: int, long_side_in: float) -> _Page:
    """Return the placement of a room on a page.

    Args:
        hall: config of the hall.
        units: number of CRAC units; their symbols are outside the end walls, clear of the racks.
        long_side_in: largest width of the picture, in inches.
    """
    plan = floor_plan(hall)
    is_turned = plan.width_m > plan.length_m
    # In large halls symbols are drawn larger than the units are, so that they remain visible.
    deep_m = max(UNIT_SIZE_M[0], (0.15 if is_turned else 0.03) * plan.length_m)
    wide_m = max(UNIT_SIZE_M[1], 0.05 * plan.width_m)
    near_m = 1.3 * deep_m
    far_m = near_m if units > 1 else 0.3 * near_m
    limits_m = ((-near_m, plan.length_m + far_m), (-0.3 * near_m, plan.width_m + 0.3 * near_m))
    spans_m = [float(np.ptp(ends)) for ends in limits_m]
    across_m, up_m = spans_m[::-1] if is_turned else spans_m
    high_in = float(np.clip(long_side_in * up_m / across_m, *SHORT_SIDE_IN))
    wide_in = min(long_side_in, high_in * across_m / up_m)
    scale = (DPI * wide_in / across_m, DPI * high_in / up_m)
    return _Page(
        hall=hall,
        plan=plan,
        is_turned=is_turned,
        unit_places_m=unit_places_m(plan, units),
        unit_m=(deep_m, min(wide_m, 0.8 * plan.width_m / ((units + 1) // 2))),
        limits_m=limits_m,
        size_in=(wide_in, high_in),
        px_per_m=scale[::-1] if is_turned else scale,
    )


def _draw_room(axes: Axes, page: _Page) -> None:
    """Draw axes in m, aisles, fronts of the rows, walls, and return grilles in the end walls."""
    from matplotlib.collections import LineCollection, PolyCollection
    from matplotlib.ticker import MaxNLocator

    plan = page.plan
    axes.set_aspect(page.stretch)
    names = ["x, along the rows (m)", "y, across the rows (m)"]
    right, up = (1, 0) if page.is_turned else (0, 1)
    lengths_m = plan.length_m, plan.width_m
    axes.set_xlim(page.limits_m[right])
    axes.set_ylim(page.limits_m[up][::-1])
    for axis, side in ((axes.xaxis, right), (axes.yaxis, up)):
        ticks = MaxNLocator(8, steps=[1, 2, 5, 10]).tick_values(0.0, lengths_m[side])
        axis.set_ticks([t for t in ticks if 0.0 <= t <= lengths_m[side]])
    stretched = not 1 / MAX_UNTOLD_STRETCH < page.stretch < MAX_UNTOLD_STRETCH
    close = "; rows too close to draw their aisles" if page.is_coarse else ""
    axes.set_xlabel(names[right] + close)
    axes.set_ylabel(names[up] + (f"\nstretched {page.stretch:.1f} times" if stretched else ""))
    axes.spines[:].set_visible(False)
    if not page.is_coarse:
        _draw_aisles(axes, page)
        front_y = plan.front_m[:: page.hall.racks_per_row, 1]
        lines = [page.place([(x, y) for x in plan.row_ends_m]) for y in front_y]
        thick = float(np.clip(0.06 * page.px_per_m[1], 0.3, 3.5))
        axes.add_collection(LineCollection(lines, colors=BLUE, linewidths=thick, zorder=3,
                                           label="front (inlet) of the racks"))  # fmt: skip
    walls = page.box(0.0, plan.length_m, 0.0, plan.width_m)
    axes.add_collection(PolyCollection([walls], facecolor="none", edgecolor="black", linewidth=2.0))
    if page.hall.layout.returns == "end_wall":
        for x, label in ((0.0, "return grilles in the end walls"), (plan.length_m, None)):
            axes.plot(*page.place([(x, 0.0), (x, plan.width_m)]).T, color=ORANGE, linewidth=4.5,
                      linestyle=(0, (2, 1)), label=label)  # fmt: skip


def _draw_aisles(axes: Axes, page: _Page) -> None:
    """Draw tinted aisles, with tiles in cold aisles and ceiling grilles above hot aisles."""
    from matplotlib.collections import LineCollection, PolyCollection

    plan, layout = page.plan, page.hall.layout
    half_m = layout.rack_depth_m / 2
    low = np.concatenate([[0.0], page.row_y_m + half_m])
    high = np.concatenate([page.row_y_m - half_m, [plan.width_m]])
    x0, x1 = plan.row_ends_m
    cuts = x0 + layout.rack_pitch_m * np.arange(page.hall.racks_per_row + 1)
    for first, name, colour, dashes in (
        (0, "hot aisle", ORANGE, "dotted"),
        (1, "cold aisle", SKY, "solid"),
    ):
        aisles = list(zip(low[first::2], high[first::2], strict=True))
        boxes = [page.box(x0, x1, y0, y1) for y0, y1 in aisles]
        axes.add_collection(PolyCollection(boxes, facecolor=colour, alpha=0.22, edgecolor="none"))
        has_openings = name == "cold aisle" or layout.returns == "ceiling"
        if has_openings and page.fits(layout.rack_pitch_m, layout.rack_pitch_m, (9.0, 9.0)):
            lines = [page.place([(x, y0), (x, y1)]) for y0, y1 in aisles for x in cuts]
            middles = [(y0 + y1) / 2 for y0, y1 in aisles]
            lines += [page.place([(x0, y), (x1, y)]) for y in middles]
            axes.add_collection(LineCollection(lines, colors=colour, linewidths=0.7,
                                               linestyles=dashes, alpha=0.9))  # fmt: skip
        for y0, y1 in aisles:
            if (y1 - y0) * page.px_per_m[1] >= 13.0 and (x1 - x0) * page.px_per_m[0] >= 75.0:
                axes.text(
                    *page.point((x0 + x1) / 2, (y0 + y1) / 2), name, ha="center", va="center",
                    fontsize=9, rotation=90 if page.is_turned else 0,
                    bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5},
                )  # fmt: skip


def _rack_boxes(page: _Page) -> F64:
    """Return the corners of each rack on the page, (R, 4, 2)."""
    layout = page.hall.layout
    depth_m = page.row_gap_m if page.is_coarse else layout.rack_depth_m
    half_m = np.array([layout.rack_pitch_m, depth_m]) / 2
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return page.place(page.plan.centre_m[:, None] + corners * half_m)


def _draw_racks(axes: Axes, page: _Page, shown: RackValues) -> None:
    """Draw racks in the colours of their values, with the values as numbers if they fit."""
    from matplotlib import colormaps
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Polygon
    from matplotlib.ticker import MaxNLocator

    layout, plan = page.hall.layout, page.plan
    size_m = layout.rack_pitch_m, layout.rack_depth_m
    boxes = _rack_boxes(page)
    has_edges = page.fits(*size_m, (8.0, 8.0))
    low, high = colour_range(shown.values)
    racks = PolyCollection(
        list(boxes),
        array=shown.values,
        cmap=colormaps["inferno"].with_extremes(bad="#DDDDDD"),
        clim=(low, high),
        edgecolor="white" if has_edges else "face",
        linewidth=0.8 if has_edges else 0.1,
    )
    axes.add_collection(racks)
    if page.fits(*size_m, RACK_LABEL_PX):
        for (x, y), value in zip(plan.centre_m, shown.values, strict=True):
            if value is np.ma.masked:
                continue
            ink = "black" if value > (low + high) / 2 else "white"
            text = f"{value:z.{shown.digits}f}"
            axes.text(*page.point(x, y), text, color=ink, ha="center", va="center", fontsize=9)
    box, middle = boxes[shown.marked], boxes[shown.marked].mean(axis=0)
    if page.fits(*size_m, (16.0, 16.0)):
        axes.add_patch(Polygon(0.92 * box + 0.08 * middle, fill=False, edgecolor=SKY,
                               linewidth=3.0, zorder=3, label=shown.mark_label))  # fmt: skip
    else:
        axes.plot(*middle, "o", color=SKY, markersize=13, mfc="none", mew=2.2, ls="none",
                  label=shown.mark_label)  # fmt: skip
    axes.figure.colorbar(racks, ax=axes, label=shown.label, shrink=0.85, pad=0.01,
                         ticks=MaxNLocator(6, steps=[1, 2, 5, 10]))  # fmt: skip


def _draw_units(axes: Axes, page: _Page, texts: Sequence[str], **style: Any) -> None:
    """Draw CRAC units outside the end walls.

    Args:
        axes: axes to draw in.
        page: placement of the room.
        texts: text on the symbol of each unit.
        style: matplotlib properties of the symbols.
    """
    from matplotlib.collections import PolyCollection

    deep_m, wide_m = page.unit_m
    boxes = []
    for text, (x, y) in zip(texts, page.unit_places_m, strict=True):
        away = -deep_m if x == 0.0 else deep_m
        boxes.append(page.box(x, x + away, y - wide_m / 2, y + wide_m / 2))
        axes.text(*page.point(x + away / 2, y), text, ha="center", va="center", fontsize=7.5,
                  rotation=90 if "\n" in text and not page.is_turned else 0)  # fmt: skip
    axes.add_collection(PolyCollection(boxes, edgecolor="black", **style))


def _draw_design_units(axes: Axes, page: _Page, unit_m3s: F64) -> None:
    """Draw CRAC units, labelled with index and airflow in m³/s if the label fits."""
    texts = [""] * len(unit_m3s)
    if page.fits(*page.unit_m, (72.0, 28.0) if page.is_turned else (28.0, 72.0)):
        texts = [f"CRAC {unit}\n{_airflow_text(m3s)} m³/s" for unit, m3s in enumerate(unit_m3s)]
    elif page.fits(*page.unit_m, (16.0, 12.0)):
        texts = [str(unit) for unit in range(len(unit_m3s))]
    _draw_units(axes, page, texts, facecolor="#DDDDDD", linewidth=1.0, label="CRAC unit")


def _draw_failed_units(axes: Axes, page: _Page, study: Failover) -> None:
    """Draw CRAC units, each in a colour for the effect of losing that unit alone.

    A thick edge marks the units that fail in the worst loss. A unit is grey if the study did not
    include the loss of that unit alone.
    """
    from matplotlib.patches import Patch

    colours = dict.fromkeys(range(len(page.unit_places_m)), GREY)
    for i, loss in enumerate(study.losses):
        if len(loss.units) == 1:
            trips, throttles = np.isfinite([study.trip_min[i], study.throttle_min[i]])
            colours[loss.units[0]] = RED if trips else ORANGE if throttles else GREEN
    lost = study.losses[study.worst[0]].units
    fits = page.fits(*page.unit_m, (16.0, 12.0))
    _draw_units(
        axes,
        page,
        [str(unit) if fits else "" for unit in colours],
        facecolor=list(colours.values()),
        linewidth=[3.0 if unit in lost else 0.6 for unit in colours],
    )
    effects = ((RED, "racks trip"), (ORANGE, "racks throttle"), (GREEN, "neither"))
    keys = [Patch(facecolor=colour, edgecolor="black", label=text) for colour, text in effects]
    axes.legend(
        handles=keys, loc="upper left", bbox_to_anchor=(0, 0), borderaxespad=4.5, ncols=3,
        frameon=False, fontsize=8.5, title="loss of this CRAC unit alone (thick: lost here)",
        title_fontsize=8.5, alignment="left",
    )  # fmt: skip


def _label_rows(axes: Axes, page: _Page) -> None:
    """Draw row numbers beside the ends of the rows, leaving out rows if space is short."""
    margin_m, gap_px = page.hall.layout.end_margin_m, page.row_gap_m * page.px_per_m[1]
    if margin_m * page.px_per_m[0] < 16.0:
        return
    x = page.plan.row_ends_m[0] - 0.15 * margin_m
    for row in range(0, page.hall.rows, int(np.ceil(max(1.0, 22.0 / gap_px)))):
        axes.text(
            *page.point(x, page.row_y_m[row]), f"row {row}" if gap_px > 40.0 else f"{row}",
            ha="center" if page.is_turned else "right",
            va="bottom" if page.is_turned else "center", fontsize=8, color=GREY,
        )  # fmt: skip


def _airflow_text(value: float) -> str:
    """Return an airflow as text, with three significant digits, or as an integer from 100 on."""
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"


def _draw_curves(axes: Axes, study: Failover) -> None:
    """Draw the hottest rack over time after the worst losses, and the protection's limits."""
    minutes = np.arange(MINUTES + 1)
    # At minute 0 all curves have the steady-state temperature of the hall without a loss.
    hottest_c = study.hottest_c[[0, *range(MINUTES)]]
    hottest_c[0] = hottest_c[0, 0]
    drawn = [i for i in study.worst if i != 0][:CURVES]
    for i, colour in zip(drawn, LINE_COLOURS, strict=False):
        axes.plot(minutes, hottest_c[:, i], color=colour, label=study.losses[i].name)
    axes.plot(minutes, hottest_c[:, 0], color=GREY, linewidth=2.5, label="no loss")
    protection = study.config.protection
    assert protection.ashrae_class is not None
    limit_c = allowable_c(protection.ashrae_class)[1]
    limits_c, quantity = (limit_c, limit_c + protection.trip_margin_k), "inlet"
    if study.of_junctions:
        limits_c, quantity = junction_limits_c(study.config) or limits_c, "junction"
    for level_c, text in zip(limits_c, ("throttle", "trip"), strict=True):
        axes.axhline(level_c, color="black", linestyle=":", linewidth=1.0)
        axes.text(MINUTES, level_c, f"{text}, {level_c:g} °C", ha="right", va="bottom", fontsize=8)
    label = f"hottest {quantity} of the hall (°C)"
    axes.set(xlim=(0, MINUTES), xlabel="minutes after the loss", ylabel=label)
    remove_frame(axes)
    title = f"full load, supply {study.supply_c:g} °C, class {protection.ashrae_class}"
    axes.set_title(title, fontsize=10, loc="left")
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.12), ncols=3, frameon=False, fontsize=8.5)
