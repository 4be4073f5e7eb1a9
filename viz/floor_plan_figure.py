"""Floor plans of a hall to scale: at its design point, and after the worst loss of cooling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.hall.floor_plan import FloorPlan, floor_plan, unit_places_m
from sdc_taichi.run.failover import MINUTES, SHOWN_AFTER_MIN, Failover
from sdc_taichi.sim.design_hall import DesignHall, solve_design_hall
from sdc_taichi.types import F64

from .plotting import (
    BLUE,
    DPI,
    GREEN,
    GREY,
    LINE_COLOURS,
    LINE_STYLES,
    ORANGE,
    RED,
    SKY,
    colour_range,
    literal_text,
    new_figure,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LONG_SIDE_IN = 11.0
"""Largest width of the plan, in inches."""
SHORT_SIDE_IN = (2.2, 8.0)
"""Least and largest height of the plan, in inches; halls beyond them are drawn stretched."""
MAX_UNTOLD_STRETCH = 1.02
"""Stretch up to which the axis does not mention it."""
RACK_LABEL_PX = (34.0, 15.0)
"""Width and height that the number in a rack needs, in pixels."""
MIN_ROW_PITCH_PX = 6.0
"""Distance of rows below which aisles and fronts are left out, in pixels; they would blur."""
LINE_LABEL_PX = 13.0
"""Height of a line of text, in pixels."""
UNIT_SIZE_M = (0.9, 2.0)
"""Size of the symbol of a CRAC unit, off the wall and along it, in m."""


@dataclass(frozen=True, slots=True)
class RackValues:
    """What the colours of the R racks of a floor plan tell."""

    values: F64
    """Value of each rack, (R,)."""
    label: str
    """What the values are, with their unit, for the colour bar."""
    marked: int
    """The rack that is outlined."""
    mark_label: str
    """What the outlined rack is, for the legend."""
    digits: int = 1
    """Decimals of the numbers in the racks."""


def floor_plan_figure(
    hall: DataCenterConfig | DesignHall, shown: RackValues | None = None
) -> Figure:
    """Walls, rows, aisles, floor tiles, returns and CRAC units, to scale.

    The longer side of the room runs to the right. Labels that would not fit are left out.

    Args:
        hall: a data center, or what ``solve_design_hall`` found of it.
        shown: what the colours of the racks tell; None is their inlets at the design point.

    Raises:
        SdcError: matplotlib is missing, or the hall cannot be solved.
    """
    figure = new_figure(1.0, 1.0)
    found = solve_design_hall(hall) if isinstance(hall, DataCenterConfig) else hall
    _FloorPlanDrawing(found, figure, _inlet_values(found) if shown is None else shown).draw()
    return figure


def _inlet_values(found: DesignHall) -> RackValues:
    """Inlets at the design point."""
    return RackValues(
        values=found.inlet_c,
        label="rack inlet at the design point (°C)",
        marked=found.hottest_rack,
        mark_label=f"hottest server, {found.inlet_max_c.max():.1f} °C",
    )


def is_transposed(plan: FloorPlan) -> bool:
    """Whether y runs to the right, because that is the longer side of the room."""
    return plan.width_m > plan.length_m


def to_page(plan: FloorPlan, xy: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Points of the room, (..., 2) in m, as a picture places them, longer side to the right."""
    return xy[..., ::-1] if is_transposed(plan) else xy


def rack_boxes(plan: FloorPlan, pitch_m: float, depth_m: float) -> F64:
    """Corners of the racks as a picture places them, (R, 4, 2) in m.

    Args:
        plan: floor plan of the hall.
        pitch_m: width of a rack along the row, in m.
        depth_m: depth of a rack, in m.
    """
    half = np.array([pitch_m / 2, depth_m / 2])
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return to_page(plan, plan.centre_m[:, None] + corners * half)


class _FloorPlanDrawing:
    """Drawing of one floor plan.

    Args:
        hall: the hall with its air at the design point.
        figure: where to draw.
        shown: what the colours of the racks tell.
    """

    def __init__(self, hall: DesignHall, figure: Figure, shown: RackValues) -> None:
        self._found, self._figure, self._shown = hall, figure, shown
        self._hall, self._size = hall.config.hall, hall.config.hall.layout
        plan = hall.plan
        room = (plan.length_m, plan.width_m)
        self._is_transposed = is_transposed(plan)
        self._room = room[::-1] if self._is_transposed else room
        # Units stand outside the end walls, so that the room is drawn clear; large halls get
        # larger symbols.
        deep, wide = self._room[::-1] if self._is_transposed else self._room
        self._unit_m = (
            max(UNIT_SIZE_M[0], (0.15 if self._is_transposed else 0.02) * deep),
            max(UNIT_SIZE_M[1], 0.02 * wide),
        )
        near = 1.3 * self._unit_m[0]
        far = near if len(hall.unit_m3s) > 1 else 0.3 * near
        # Left and right, then top and bottom of the page.
        rims = ((0.3 * near, 0.3 * near), (near, far))
        self._rims = rims if self._is_transposed else rims[::-1]
        wide, high = (r + sum(m) for r, m in zip(self._room, self._rims, strict=True))
        high_in = float(np.clip(LONG_SIDE_IN * high / wide, *SHORT_SIDE_IN))
        wide_in = min(LONG_SIDE_IN, high_in * wide / high)
        self._stretch = (high_in / high) / (wide_in / wide)
        self._px_per_m = (DPI * wide_in / wide, DPI * high_in / high)
        rows = self._hall.rows
        ends_y = plan.centre_m[[0, -1], 1]
        self._row_gap_m = float(np.ptp(ends_y)) / (rows - 1) if rows > 1 else plan.width_m
        self._is_coarse = (
            self._row_gap_m * self._px_per_m[0 if self._is_transposed else 1] < MIN_ROW_PITCH_PX
        )
        figure.set_size_inches(wide_in + 1.9, high_in + 1.3)

    def draw(self) -> None:
        """Draw the hall."""
        from matplotlib.ticker import MaxNLocator

        axes = self._figure.subplots()
        axes.set_aspect(self._stretch)
        (left, right), (top, bottom) = self._rims
        axes.set_xlim(-left, self._room[0] + right)
        axes.set_ylim(self._room[1] + bottom, -top)
        for axis, length_m in zip((axes.xaxis, axes.yaxis), self._room, strict=True):
            ticks = MaxNLocator(8, steps=[1, 2, 5, 10]).tick_values(0.0, length_m)
            axis.set_ticks([t for t in ticks if 0.0 <= t <= length_m])
        if not self._is_coarse:
            self._draw_aisles(axes)
            self._draw_fronts(axes)
        self._draw_racks(axes)
        self._draw_walls(axes)
        self._draw_units(axes)
        self._write_labels(axes)

    def _place(self, x: float, y: float) -> tuple[float, float]:
        """Point of the room as the picture places it, in m."""
        across, up = to_page(self._found.plan, np.array([x, y]))
        return float(across), float(up)

    def _box(self, x0: float, x1: float, y0: float, y1: float) -> F64:
        """Corners of a rectangle of the room as the picture places them, (4, 2) in m."""
        return to_page(self._found.plan, np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))

    def _fits(self, x_m: float, y_m: float, px: tuple[float, float]) -> bool:
        """Whether a rectangle of the room is drawn at least as large as ``px``."""
        across, up = (y_m, x_m) if self._is_transposed else (x_m, y_m)
        return across * self._px_per_m[0] >= px[0] and up * self._px_per_m[1] >= px[1]

    def _draw_aisles(self, axes: Axes) -> None:
        """Tint the aisles; tiles lie in the cold ones, ceiling grilles above the hot ones."""
        from matplotlib.collections import PolyCollection

        hall, plan, depth = self._hall, self._found.plan, self._size.rack_depth_m
        row_y = plan.centre_m[:: hall.racks_per_row, 1]
        low = np.concatenate([[0.0], row_y + depth / 2])
        high = np.concatenate([row_y - depth / 2, [plan.width_m]])
        x0, x1 = plan.row_ends_m
        ceiling = self._size.returns == "ceiling"
        for first, name, colour in ((0, "hot aisle", ORANGE), (1, "cold aisle", SKY)):
            mine = range(first, len(low), 2)
            boxes = [self._box(x0, x1, low[i], high[i]) for i in mine]
            tint = PolyCollection(boxes, facecolor=colour, alpha=0.22, edgecolor="none")
            axes.add_collection(tint)
            if name == "cold aisle" or ceiling:
                pitch = self._size.rack_pitch_m
                if self._fits(pitch, pitch, (9.0, 9.0)):
                    self._draw_openings(axes, low[first::2], high[first::2], name, colour)
            for i in mine:
                self._label_aisle(axes, name, float(low[i]), float(high[i]))

    def _draw_openings(self, axes: Axes, low: F64, high: F64, name: str, colour: str) -> None:
        """Draw floor tiles or ceiling grilles of aisles."""
        from matplotlib.collections import LineCollection

        x0, x1 = self._found.plan.row_ends_m
        cuts = x0 + self._size.rack_pitch_m * np.arange(self._hall.racks_per_row + 1)
        lines = []
        for y0, y1 in zip(low, high, strict=True):
            middle = (y0 + y1) / 2
            lines += [[self._place(x, y0), self._place(x, y1)] for x in cuts]
            lines.append([self._place(x0, middle), self._place(x1, middle)])
        style = "solid" if name == "cold aisle" else "dotted"
        axes.add_collection(
            LineCollection(lines, colors=colour, linewidths=0.7, linestyles=style, alpha=0.9)
        )

    def _label_aisle(self, axes: Axes, name: str, y0: float, y1: float) -> None:
        """Write the name of an aisle into it, if it fits."""
        x0, x1 = self._found.plan.row_ends_m
        along_px = (x1 - x0) * self._px_per_m[1 if self._is_transposed else 0]
        across_px = (y1 - y0) * self._px_per_m[0 if self._is_transposed else 1]
        if across_px < LINE_LABEL_PX or along_px < 75.0:
            return
        axes.text(
            *self._place((x0 + x1) / 2, (y0 + y1) / 2),
            name,
            ha="center",
            va="center",
            fontsize=9,
            rotation=90 if self._is_transposed else 0,
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5},
        )

    def _draw_fronts(self, axes: Axes) -> None:
        """A line along the inlet faces of each row."""
        from matplotlib.collections import LineCollection

        plan = self._found.plan
        front_y = plan.front_m[:: self._hall.racks_per_row, 1]
        ends = plan.row_ends_m
        thick = float(np.clip(0.06 * self._px_per_m[0 if self._is_transposed else 1], 0.3, 3.5))
        axes.add_collection(
            LineCollection(
                [[self._place(x, y) for x in ends] for y in front_y],
                colors=BLUE,
                linewidths=thick,
                label="front (inlet) of the racks",
                zorder=3,
            )
        )

    def _draw_racks(self, axes: Axes) -> None:
        """Draw racks in the colours of their values, with numbers where they fit."""
        from matplotlib.collections import PolyCollection
        from matplotlib.ticker import MaxNLocator

        shown, plan, size = self._shown, self._found.plan, self._size
        deep_m = self._row_gap_m if self._is_coarse else size.rack_depth_m
        boxes = rack_boxes(plan, size.rack_pitch_m, deep_m)
        edged = self._fits(size.rack_pitch_m, size.rack_depth_m, (8.0, 8.0))
        low, high = colour_range(shown.values)
        racks = PolyCollection(
            list(boxes),
            array=shown.values,
            cmap="inferno",
            clim=(low, high),
            edgecolor="white" if edged else "face",
            linewidth=0.8 if edged else 0.1,
        )
        axes.add_collection(racks)
        if self._fits(size.rack_pitch_m, size.rack_depth_m, RACK_LABEL_PX):
            for rack, value in enumerate(shown.values):
                ink = "black" if value > (low + high) / 2 else "white"
                where = self._place(*plan.centre_m[rack])
                text = f"{value:z.{shown.digits}f}"
                axes.text(*where, text, color=ink, ha="center", va="center", fontsize=9)
        self._mark_rack(axes, boxes[shown.marked])
        self._figure.colorbar(
            racks,
            ax=axes,
            label=shown.label,
            ticks=MaxNLocator(6, steps=[1, 2, 5, 10]),
            shrink=0.85,
            pad=0.01,
        )

    def _mark_rack(self, axes: Axes, corners: F64) -> None:
        """Outline the marked rack, or ring it where it is too small."""
        from matplotlib.patches import Polygon

        label = self._shown.mark_label
        if self._fits(self._size.rack_pitch_m, self._size.rack_depth_m, (16.0, 16.0)):
            box = 0.92 * corners + 0.08 * corners.mean(axis=0)
            axes.add_patch(
                Polygon(box, fill=False, edgecolor=SKY, linewidth=3.0, zorder=3, label=label)
            )
            return
        axes.plot(*corners.mean(axis=0), "o", color=SKY, markersize=13, mfc="none", mew=2.2,
                  ls="none", label=label)  # fmt: skip

    def _draw_walls(self, axes: Axes) -> None:
        """Draw the walls, and return grilles in them."""
        from matplotlib.collections import PolyCollection

        plan = self._found.plan
        room = self._box(0.0, plan.length_m, 0.0, plan.width_m)
        axes.add_collection(
            PolyCollection([room], facecolor="none", edgecolor="black", linewidth=2.0)
        )
        if self._size.returns != "end_wall":
            return
        for n, x in enumerate((0.0, plan.length_m)):
            a, b = self._place(x, 0.0), self._place(x, plan.width_m)
            axes.plot(
                [a[0], b[0]], [a[1], b[1]], color=ORANGE, linewidth=4.5, linestyle=(0, (2, 1)),
                label=None if n else "return grilles in the end walls",
            )  # fmt: skip

    def _draw_units(self, axes: Axes) -> None:
        """Draw CRAC units outside of the end walls, with their airflow where it fits."""
        from matplotlib.collections import PolyCollection

        found, plan = self._found, self._found.plan
        depth, wide = self._unit_m
        units = len(found.unit_m3s)
        wide = min(wide, 0.8 * plan.width_m / max((units + 1) // 2, 1))
        boxes, labels = [], []
        for unit, (x, y) in enumerate(found.unit_places_m):
            away = -depth if x == 0.0 else depth
            boxes.append(self._box(x, x + away, y - wide / 2, y + wide / 2))
            labels.append((unit, self._place(x + away / 2, y)))
        axes.add_collection(
            PolyCollection(
                boxes, facecolor="#DDDDDD", edgecolor="black", linewidth=1.0, label="CRAC unit"
            )
        )
        whole = self._fits(depth, wide, (72.0, 28.0) if self._is_transposed else (28.0, 72.0))
        brief = self._fits(depth, wide, (16.0, 12.0))
        for unit, (x, y) in labels:
            if not brief:
                break
            text = (
                f"CRAC {unit}\n{_airflow_text(found.unit_m3s[unit])} m³/s" if whole else f"{unit}"
            )
            axes.text(
                x, y, text, ha="center", va="center", fontsize=7.5,
                rotation=0 if self._is_transposed or not whole else 90,
            )  # fmt: skip

    def _write_labels(self, axes: Axes) -> None:
        """Write title, labels of the axes, row numbers and legend."""
        found, hall = self._found, self._hall
        names: list[Callable[..., object]] = [axes.set_xlabel, axes.set_ylabel]
        words = ["y, across the rows (m)", "x, along the rows (m)"]
        if not self._is_transposed:
            words = words[::-1]
        if not 1 / MAX_UNTOLD_STRETCH < self._stretch < MAX_UNTOLD_STRETCH:
            words[1] += f"\nstretched {self._stretch:.1f} times"
        if self._is_coarse:
            words[0] += "; rows too close to draw their aisles"
        for name, text in zip(names, words, strict=True):
            name(text)
        axes.spines[:].set_visible(False)
        row_y = found.plan.centre_m[:: hall.racks_per_row, 1]
        self._label_rows(axes, row_y)
        flow = found.unit_m3s.sum()
        axes.set_title(
            f"{literal_text(found.config.name)}: {hall.rows} rows of {hall.racks_per_row} racks, "
            f"{found.plan.length_m:.4g} x {found.plan.width_m:.4g} m, "
            f"{found.it_w.sum() / 1e3:,.0f} kW IT, {_airflow_text(flow)} m³/s supply "
            f"at {found.supply_c:g} °C",
            fontsize=10,
            loc="left",
            pad=22,
        )
        axes.legend(
            loc="lower left",
            bbox_to_anchor=(0, 1),
            ncols=4,
            fontsize=8.5,
            frameon=False,
            borderaxespad=0.2,
            handlelength=1.6,
        )

    def _label_rows(self, axes: Axes, row_y: F64) -> None:
        """Row numbers beside the row ends, as many as fit."""
        per_m = self._px_per_m[0 if self._is_transposed else 1]
        if self._size.end_margin_m * self._px_per_m[1 if self._is_transposed else 0] < 16.0:
            return
        gap_m = float(row_y[-1] - row_y[0]) / max(len(row_y) - 1, 1)
        every = 1 if len(row_y) == 1 else int(np.ceil(max(1.0, 22.0 / max(gap_m * per_m, 1e-9))))
        x = self._found.plan.row_ends_m[0] - 0.15 * self._size.end_margin_m
        for row in range(0, len(row_y), every):
            u, v = self._place(x, row_y[row])
            axes.text(
                u, v, f"row {row}" if gap_m * per_m > 40.0 else f"{row}",
                ha="center" if self._is_transposed else "right",
                va="bottom" if self._is_transposed else "center",
                fontsize=8, color=GREY,
            )  # fmt: skip


def _airflow_text(value: float) -> str:
    """A flow with three digits, or all those before the point."""
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"


CURVES = 6
"""Losses whose hottest inlet is drawn over time, the worst ones, beside that without a loss."""
LABELLED_UNITS = 24
"""Most CRAC units that show how long the hall lasts without them."""
UNIT_M = (0.06, 0.5)
"""Size of the symbol of a CRAC unit: off the wall as a share of the longer side of the room, and
along it as a share of the distance between units."""


def failover_figure(study: Failover) -> Figure:
    """Floor plan with the inlets of the worst loss, and the hottest inlet of the worst over time.

    Units are coloured by what their own loss does: racks trip, throttle, or neither.

    Args:
        study: What ``study_failover`` found.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(13.0, 5.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
    _draw_plan(left, study)
    _draw_curves(right, study)
    return figure


def _draw_plan(axes: Axes, study: Failover) -> None:
    """Racks by their hottest inlet a quarter of an hour after the worst loss, and the units."""
    from matplotlib.collections import PolyCollection

    hall, plan = study.config.hall, floor_plan(study.config.hall)
    worst = study.worst[0]
    inlet_c = study.rack_inlet_c[worst]
    racks = PolyCollection(
        list(rack_boxes(plan, hall.layout.rack_pitch_m, hall.layout.rack_depth_m)),
        array=inlet_c,
        cmap="inferno",
        clim=colour_range(inlet_c),
        edgecolor="white",
        linewidth=0.4,
    )
    axes.add_collection(racks)
    room = to_page(plan, np.array([(0, 0), (plan.length_m, 0), (plan.length_m, plan.width_m),
                                   (0, plan.width_m)]))  # fmt: skip
    axes.add_collection(PolyCollection([room], facecolor="none", edgecolor="black", linewidth=1.5))
    rim = _draw_units(axes, study, plan) if any(loss.units for loss in study.losses) else 0.0
    wide, high = room.max(axis=0)
    axes.set(aspect="equal", xlim=(-rim, wide + rim), ylim=(high + rim, -rim), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    after = SHOWN_AFTER_MIN[0]
    axes.set_title(
        f"{literal_text(study.config.name)}: {after} minutes after the loss of "
        f"{study.losses[worst].name}",
        fontsize=10,
        loc="left",
    )
    axes.figure.colorbar(racks, ax=axes, label="hottest inlet of the rack (°C)", shrink=0.8)


def _draw_units(axes: Axes, study: Failover, plan: FloorPlan) -> float:
    """CRAC units outside of the end walls, by what their loss does; return the rim, in m."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Patch

    count = study.config.hvac.crac.units
    places = unit_places_m(plan, count)
    deep = UNIT_M[0] * max(plan.length_m, plan.width_m)
    wide = UNIT_M[1] * plan.width_m / ((count + 1) // 2)
    single = {loss.units[0]: i for i, loss in enumerate(study.losses) if len(loss.units) == 1}
    down = study.losses[study.worst[0]].units
    boxes, colours, edges = [], [], []
    for unit, (x, y) in enumerate(places):
        near, far = (-0.15 * deep, -deep) if x == 0.0 else (x + 0.15 * deep, x + deep)
        low, high = y - wide / 2, y + wide / 2
        box: F64 = np.array([(near, low), (far, low), (far, high), (near, high)])
        boxes.append(to_page(plan, box))
        colours.append(_unit_colour(study, single.get(unit)))
        edges.append(3.0 if unit in down else 0.6)
        if count <= LABELLED_UNITS:
            across, up = to_page(plan, np.array([(near + far) / 2, y]))
            axes.text(float(across), float(up), f"{unit}", ha="center", va="center", fontsize=8)
    axes.add_collection(
        PolyCollection(boxes, facecolor=colours, edgecolor="black", linewidth=edges)
    )
    shown = ((RED, "racks trip"), (ORANGE, "racks throttle"), (GREEN, "neither"))
    keys = [Patch(facecolor=colour, edgecolor="black", label=text) for colour, text in shown]
    axes.legend(
        handles=keys, loc="upper left", bbox_to_anchor=(0, 0), ncols=3, frameon=False, fontsize=8.5,
        title="loss of this CRAC unit alone (thick: lost here)", title_fontsize=8.5,
        alignment="left",
    )  # fmt: skip
    return 1.2 * deep


def _unit_colour(study: Failover, loss: int | None) -> str:
    """Colour of a CRAC unit by what its loss does; grey for one that was not lost."""
    if loss is None:
        return GREY
    if np.isfinite(study.trip_min[loss]):
        return RED
    return ORANGE if np.isfinite(study.throttle_min[loss]) else GREEN


def _draw_curves(axes: Axes, study: Failover) -> None:
    """Hottest inlet over time after the worst losses, with the limits of the class."""
    minutes = np.arange(MINUTES + 1)
    # All begin in the steady state of a hall in order.
    inlet_c = study.inlet_max_c[[0, *range(MINUTES)]]
    inlet_c[0] = inlet_c[0, 0]
    drawn = [i for i in study.worst if i != 0][:CURVES]
    for n, i in enumerate(drawn):
        style = LINE_STYLES[n // len(LINE_COLOURS) % len(LINE_STYLES)]
        axes.plot(minutes, inlet_c[:, i], style, color=LINE_COLOURS[n],
                  label=study.losses[i].name)  # fmt: skip
    axes.plot(minutes, inlet_c[:, 0], color=GREY, linewidth=2.5, label="no loss")
    protection = study.config.protection
    assert protection.ashrae_class is not None
    limit_c = allowable_c(protection.ashrae_class)[1]
    for level_c, text in (
        (limit_c, "throttle"),
        (limit_c + protection.trip_margin_k, "trip"),
    ):
        axes.axhline(level_c, color="black", linestyle=":", linewidth=1.0)
        axes.text(MINUTES, level_c, f"{text}, {level_c:g} °C", ha="right", va="bottom", fontsize=8)
    axes.set(
        xlim=(0, MINUTES), xlabel="minutes after the loss", ylabel="hottest inlet of the hall (°C)"
    )
    axes.spines[:].set_visible(False)
    axes.grid(alpha=0.25)
    axes.set_title(
        f"full load, supply {study.supply_c:g} °C, class {protection.ashrae_class}",
        fontsize=10,
        loc="left",
    )
    axes.legend(loc="upper left", bbox_to_anchor=(0, -0.12), ncols=3, frameon=False, fontsize=8.5)
