"""Pictures of fleets of data centers, comparisons of runs, sweeps and benchmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.run.metrics import Metric
from sdc_taichi.types import F64

from .plotting import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    add_title,
    colour_range,
    draw_steps,
    format_number,
    format_time_axis,
    line_style,
    literal_text,
    new_figure,
    repeat_last,
    scale_thousands,
    step_edges,
    step_hours,
    style_axes,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

    from sdc_taichi.run.comparison import Figure as ComparedFigure

RADAR_METRICS = (
    ("cfp_kg", "carbon footprint", "kg CO₂e"),
    ("hvac_kwh", "HVAC energy", "kWh"),
    ("it_kwh", "IT energy", "kWh"),
    ("water_l", "water", "L"),
    ("queue_mean_tasks", "task queue, mean", "tasks"),
)
"""Five metrics by which the SustainDC paper compares controllers (section 5, figure 4).

Each has its name in metrics.json, label and unit.
"""
MAX_RUNS = 12
"""Largest number of runs in one radar chart."""
CENTRES_PCT = (99.0, 98.0, 95.0, 90.0, 80.0, 50.0, 0.0)
"""Values at which the axis of a radar chart may begin in the centre, in % of the worst run."""
MAX_MAP_ROWS = 40
"""Largest number of data centers in ``fleet_map``."""


def radar(runs: Mapping[str, Mapping[str, Metric]]) -> Figure:
    """Draw five metrics of several runs as a radar chart.

    Less is better in every metric, so the smallest polygon is the best. Each axis runs from a
    printed value at the centre to the worst run's value at the rim. The value at the centre is 0
    or close enough below the best run to make small differences visible.

    Args:
        runs: metrics of each run, as ``total`` or ``metrics`` in metrics.json, keyed by name.

    Raises:
        SdcError: matplotlib or a metric is missing, or there are fewer than two or more than
            ``MAX_RUNS`` runs.
    """
    figure = new_figure(11.0, 6.4)
    values = _radar_values(runs)
    worst = values.max(axis=0)
    # A metric that is zero in all runs has the best possible share, 0 %, in each of them.
    share = 100.0 * values / np.where(worst > 0.0, worst, 1.0)
    centre = np.array([_centre_pct(column) for column in share.T])
    radius = (share - centre) / (100.0 - centre)
    angle = np.arange(len(RADAR_METRICS)) * 2 * np.pi / len(RADAR_METRICS)
    # The layout engine leaves no room for labels beside a circle.
    figure.set_layout_engine("none")
    axes: Any = figure.add_axes((0.17, 0.12, 0.42, 0.72), projection="polar")
    axes.set_theta_offset(np.pi / 2)
    axes.set_theta_direction(-1)
    for index, (name, row) in enumerate(zip(runs, radius, strict=True)):
        style = line_style(index)
        axes.plot(np.append(angle, 0.0), np.append(row, row[0]), linewidth=2.0, marker="o",
                  clip_on=False, markersize=4, label=literal_text(name), **style)  # fmt: skip
        axes.fill(angle, row, color=style["color"], alpha=0.06)
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([0.25, 0.5, 0.75, 1.0], [])
    labels = [
        _radar_label(label, unit, rim, rim * centre_pct / 100)
        for (_, label, unit), rim, centre_pct in zip(RADAR_METRICS, worst, centre, strict=True)
    ]
    axes.set_xticks(angle, labels, fontsize=9)
    axes.tick_params(axis="x", pad=6)
    for text, side in zip(axes.get_xticklabels(), np.sin(angle), strict=True):
        text.set_horizontalalignment("left" if side > 0.1 else "right" if side < -0.1 else "center")
        text.set_verticalalignment("center" if abs(side) > 0.1 else "bottom")
    axes.spines["polar"].set_color(GREY)
    figure.legend(loc="upper right", frameon=False, title="less is better")
    return figure


def variant_bars(names: Sequence[str], compared: Sequence[ComparedFigure]) -> Figure:
    """Draw figures of several runs as bars from zero, with a panel for each figure.

    Args:
        names: names of the runs, the first of which is the reference.
        compared: the figures.

    Raises:
        SdcError: matplotlib is missing.
    """
    columns = 2
    rows = -(-len(compared) // columns)
    figure = new_figure(11.0, rows * (0.75 + 0.28 * len(names)))
    panels = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat[len(compared) :]:
        axes.remove()
    places = np.arange(len(names))
    for axes, each in zip(panels.flat, compared, strict=False):
        values = np.array([np.nan if value is None else value for value in each.values])
        colours = [GREY, *(BLUE for _ in names[1:])]
        axes.barh(places, np.nan_to_num(values), color=colours, height=0.7)
        base = values[0]
        for place, value in zip(places, values, strict=True):
            text = "unknown" if np.isnan(value) else format_number(value)
            if place and base > 0 and np.isfinite(value):
                text += f" ({100 * (value / base - 1):+z.1f} %)"
            axes.annotate(text, (np.nan_to_num(value), place), xytext=(4, 0),
                          textcoords="offset points", va="center", fontsize=9)  # fmt: skip
        axes.set_yticks(places, [literal_text(name) for name in names])
        axes.invert_yaxis()
        top = float(np.nanmax(values)) if np.isfinite(values).any() else 1.0
        axes.set_xlim(0.0, 1.45 * top or 1.0)
        axes.set_title(f"{each.label} ({each.unit})", fontsize=10, loc="left")
        axes.tick_params(axis="y", length=0)
        axes.set_xticks([])
        axes.spines[["top", "right", "bottom"]].set_visible(False)
    return figure


def fleet_overview(steps: pd.DataFrame) -> Figure:
    """Draw power, PUE, carbon and hottest inlets of a whole fleet over a run.

    Args:
        steps: one row per step, two or more. Its columns are ``time`` on the clock of the first
            data center; ``it_w``, ``overhead_w`` and ``carbon_g``, each the sum over all data
            centers; and ``inlet_low_c``, ``inlet_mid_c``, ``inlet_high_c`` and ``inlet_max_c``,
            which are 10th percentile, median, 90th percentile and maximum over the data centers
            of the hottest inlet of each.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(12.0, 9.0)
    edges = step_edges(steps)
    panels = figure.subplots(4, 1, sharex=True, height_ratios=[3, 2, 2, 3])
    power, pue, carbon, inlets = panels
    tops, unit = scale_thousands(
        np.cumsum([steps["it_w"], steps["overhead_w"]], axis=0) / 1e3, "kW", "MW"
    )
    for low, high, colour, label in (
        (0 * tops[0], tops[0], BLUE, "IT"),
        (*tops, ORANGE, "HVAC and counted losses"),
    ):
        power.fill_between(edges, repeat_last(low), repeat_last(high), color=colour, label=label,
                           linewidth=0, step="post")  # fmt: skip
    power.set_ylabel(f"power ({unit})")
    power.set_ylim(bottom=0)
    draw_steps(pue, steps, (tops[1] / np.where(tops[0] > 0, tops[0], np.nan)), color="black")
    pue.set_ylabel("PUE")
    emitted, unit = scale_thousands(
        steps["carbon_g"].to_numpy() / 1e3 / step_hours(steps), "kg", "t"
    )
    carbon.fill_between(
        edges, repeat_last(emitted), color=GREY, alpha=0.5, linewidth=0, step="post"
    )
    carbon.set_ylabel(f"emitted ({unit} CO₂e/h)")
    carbon.set_ylim(bottom=0)
    low_c, high_c = repeat_last(steps["inlet_low_c"]), repeat_last(steps["inlet_high_c"])
    inlets.fill_between(edges, low_c, high_c,
                        color=ORANGE, alpha=0.3, linewidth=0, step="post",
                        label="80 % of the data centers")  # fmt: skip
    draw_steps(inlets, steps, steps["inlet_mid_c"], color=ORANGE, label="median")
    draw_steps(inlets, steps, steps["inlet_max_c"], color=RED, label="hottest of all")
    inlets.set_ylabel("hottest inlet (°C)")
    for axes in (pue, carbon):
        style_axes(axes)
    for axes in (power, inlets):
        style_axes_with_legend(axes)
    format_time_axis(inlets)
    return figure


def fleet_map(edges: npt.NDArray[np.datetime64], inlet_max_c: F64, names: Sequence[str]) -> Figure:
    """Draw the hottest inlet of each of B data centers over time, as a heat map.

    Data centers are sorted from the hottest down; at most ``MAX_MAP_ROWS`` are shown.

    Args:
        edges: begin of each of n intervals and the end of the last one, (n + 1,).
        inlet_max_c: hottest inlet in each interval and data center, in C, (n, B).
        names: names of the data centers, (B,).

    Raises:
        SdcError: matplotlib is missing, or the shapes of the arguments are inconsistent.
    """
    from matplotlib.dates import date2num

    if inlet_max_c.shape != (len(edges) - 1, len(names)):
        raise SdcError(
            f"inlet_max_c has shape {inlet_max_c.shape}, expected {(len(edges) - 1, len(names))}"
        )
    order = np.argsort(-rank(inlet_max_c.max(axis=0)), kind="stable")[:MAX_MAP_ROWS]
    shown = inlet_max_c[:, order].T
    figure = new_figure(12.0, 1.6 + 0.24 * max(len(order), 4))
    axes = figure.subplots()
    low, high = colour_range(shown)
    image = axes.pcolormesh(date2num(edges), np.arange(len(order) + 1), shown,  # type: ignore[no-untyped-call]
                            cmap="inferno", vmin=low, vmax=high)  # fmt: skip
    axes.set_yticks(
        np.arange(len(order)) + 0.5, [literal_text(names[dc]) for dc in order], fontsize=8
    )
    axes.invert_yaxis()
    axes.xaxis_date()
    format_time_axis(axes)
    axes.tick_params(axis="y", length=0)
    axes.spines[:].set_visible(False)
    if len(order) < len(names):
        axes.set_ylabel(f"the {len(order)} hottest of {len(names):,} data centers")
    figure.colorbar(image, ax=axes, label="hottest inlet (°C)")
    return figure


def _radar_values(runs: Mapping[str, Mapping[str, Metric]]) -> F64:
    """Return the values of ``RADAR_METRICS`` of each run, (runs, metrics).

    Raises:
        SdcError: there are fewer than two or too many runs, or a metric is missing or negative.
    """
    if not 2 <= len(runs) <= MAX_RUNS:
        raise SdcError(f"{len(runs)} runs to compare; valid are 2 to {MAX_RUNS}")
    rows = []
    for name, metrics in runs.items():
        row = [metrics.get(key) for key, *_ in RADAR_METRICS]
        for (key, *_), value in zip(RADAR_METRICS, row, strict=True):
            if not isinstance(value, int | float) or not 0.0 <= value < np.inf:
                raise SdcError(f"run {name!r}: {key} is {value!r}; valid is a number, not negative")
        rows.append(row)
    return np.array(rows, dtype=np.float64)


def _radar_label(label: str, unit: str, rim: float, middle: float) -> str:
    """Return the label of an axis of a radar chart, with its values at the rim and the centre."""
    if rim == 0.0:
        return f"{label}\n0 {unit} for all"
    ends = f"{format_number(rim)} {unit} at the rim\n{format_number(middle)} in the middle"
    return f"{label}\n{ends}"


def _centre_pct(share_pct: F64) -> float:
    """Return the largest of ``CENTRES_PCT`` that puts the best run a quarter of the axis outwards.

    Args:
        share_pct: values of one metric in all runs, in % of the worst run.
    """
    best = float(share_pct.min())
    return next(c for c in CENTRES_PCT if best >= c + 0.25 * (100.0 - c) or c == 0.0)


MOST_PANELS = 12
"""Largest number of panels of ``plot_best_values``."""
_COLUMNS = 4
"""Largest number of panels in a row of ``plot_best_values``."""
_MIN_LIMIT_PCT, _MAX_LIMIT_PCT = 0.1, 20.0
"""Smallest and largest permitted upper end of the colour bar, in %."""


class MonthlyFigures(NamedTuple):
    """A metric of one data center in M months, at each of V values of a config field."""

    name: str
    """Name of the data center, such as its site."""
    months: Sequence[int]
    """Numbers of the M months, 1..12."""
    values: F64
    """Values of the config field, in ascending order, (V,)."""
    figures: F64
    """Value of the metric in each month at each value of the field, (M, V); less is better."""


def plot_best_values(
    panels: Sequence[MonthlyFigures], field: str, metric: str, default: float | None
) -> Figure:
    """Draw which value of a config field minimises a metric in each month, per data center.

    Each data center has a panel, in which colours show by how many percent the metric exceeds its
    minimum of the month. Dots mark the best value of each month, the solid line marks the best
    constant value for all months, and the dashed line marks the configured value. At most
    ``MOST_PANELS`` data centers are drawn, in the order of ``panels``.

    Args:
        panels: the metric of each data center.
        field: name of the config field.
        metric: name of the metric.
        default: configured value of the field; None if it is not a number.

    Raises:
        SdcError: matplotlib is missing.
    """
    shown = panels[:MOST_PANELS]
    columns = min(len(shown), _COLUMNS)
    rows = -(-len(shown) // columns)
    figure = new_figure(max(3.0 * columns + 1.0, 6.0), 2.8 * rows + 0.6)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for axis in axes.flat[len(shown) :]:
        axis.set_visible(False)
    above_pct = [_above_least_pct(panel.figures) for panel in shown]
    top_pct = max(float(np.nanmax(above, initial=0.0)) for above in above_pct)
    limit_pct = min(max(top_pct, _MIN_LIMIT_PCT), _MAX_LIMIT_PCT)
    for axis, panel, above in zip(axes.flat, shown, above_pct, strict=False):
        image = _draw_panel(axis, panel, above, limit_pct, default)
    for axis in axes[:, 0]:
        axis.set_ylabel(literal_text(field))
    label = f"{literal_text(metric)} above its least (%)"
    extend = "max" if top_pct > limit_pct else "neither"
    figure.colorbar(image, ax=axes, label=label, extend=extend)
    left_out = f" (first {len(shown)} of {len(panels)})" if len(panels) > len(shown) else ""
    lines = "line: best fixed" + ("" if default is None else ", dashed: config")
    add_title(figure, f"Best {field} by month (dots; {lines}){left_out}")
    return figure


def _above_least_pct(figures: F64) -> F64:
    """Return the excess of a metric over its minimum of the month, in %, (M, V).

    Args:
        figures: metric in each month at each value of the field, (M, V).
    """
    least = figures.min(axis=1, keepdims=True)
    return np.asarray(100.0 * (figures / np.where(least == 0.0, np.nan, least) - 1.0))


def _draw_panel(
    axes: Axes, panel: MonthlyFigures, above_pct: F64, limit_pct: float, default: float | None
) -> QuadMesh:
    """Draw the panel of one data center in ``plot_best_values``.

    Args:
        axes: axes to draw in.
        panel: the metric of the data center.
        above_pct: excess of the metric over its minimum of the month, in %, (M, V).
        limit_pct: upper end of the colour bar, in %.
        default: configured value of the field; None if it is not a number.

    Returns:
        The coloured mesh, for the colour bar.
    """
    figures, places = panel.figures, np.arange(len(panel.months))
    image = axes.pcolormesh(
        places,
        panel.values,
        above_pct.T,
        cmap="cividis",
        vmin=0.0,
        vmax=limit_pct,
        shading="nearest",
    )
    axes.axhline(panel.values[figures.sum(axis=0).argmin()], color=ORANGE, linewidth=1.6)
    if default is not None:
        axes.axhline(default, color="white", linewidth=1.2, linestyle="--")
    axes.plot(places, panel.values[figures.argmin(axis=1)], "o", color="white", mec="black", ms=6)
    axes.set_xticks(places, [str(month) for month in panel.months])
    axes.set_title(literal_text(panel.name), fontsize=10)
    axes.set_xlabel("month")
    return image


def interval_plot(
    intervals: Mapping[str, tuple[float, float, float]],
    label: str,
    *,
    marks: Sequence[float] = (),
) -> Figure:
    """Draw named values with their confidence intervals, one below the other.

    Args:
        intervals: value, lower end and upper end of each interval, keyed by name, top row first.
        label: label of the axis of values, with the unit.
        marks: values at which vertical lines are drawn.

    Raises:
        SdcError: matplotlib is missing, or there are no intervals.
    """
    if not intervals:
        raise SdcError("no intervals to draw; valid is one or more")
    figure = new_figure(9.0, 1.2 + 0.28 * len(intervals))
    axes = figure.subplots()
    for at, (value, low, high) in enumerate(intervals.values()):
        axes.plot([low, high], [at, at], color=BLUE, linewidth=5.0, alpha=0.35,
                  solid_capstyle="butt")  # fmt: skip
        axes.plot(value, at, "o", color=BLUE, markersize=5)
    for mark in marks:
        axes.axvline(mark, color=GREY, linewidth=1.0, linestyle=":")
    axes.set_yticks(range(len(intervals)), [literal_text(name) for name in intervals], fontsize=9)
    axes.set_ylim(len(intervals) - 0.5, -0.5)
    axes.set_xlabel(label)
    axes.spines[:].set_visible(False)
    axes.grid(axis="x", alpha=0.25)
    axes.tick_params(axis="y", length=0)
    return figure


def curve_plot(
    curves: Mapping[str, Mapping[str, F64]], columns: Mapping[str, str], label: str
) -> Figure:
    """Draw learning curves with their intervals, a panel for each measure of effort.

    Args:
        curves: points of each method: its efforts by column, and ``value``, ``low`` and ``high``,
            (P,) each, keyed by method.
        columns: name of each measure of effort, with its unit, by column.
        label: name of the value, with its unit.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(10.0, 4.5)
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axes, (column, title) in zip(panels, columns.items(), strict=True):
        for index, (name, points) in enumerate(curves.items()):
            style = line_style(index)
            axes.plot(points[column], points["value"], linewidth=1.6, label=literal_text(name),
                      **style)  # fmt: skip
            axes.fill_between(points[column], points["low"], points["high"], alpha=0.15,
                              linewidth=0.0, color=style.get("color"))  # fmt: skip
        axes.set(xlabel=title)
        style_axes(axes)
    panels[0].set(ylabel=label)
    # A legend of one panel would take its width from the others.
    names = panels[0].get_legend_handles_labels()
    figure.legend(*names, loc="outside upper left", ncols=7, fontsize=9, frameon=False)
    return figure


def profile_plot(thresholds: F64, profiles: Mapping[str, F64], label: str) -> Figure:
    """Draw performance profiles after Dolan and Moré (2002).

    A profile is the share of a method's weeks with a score above a threshold, as a function of
    that threshold.

    Args:
        thresholds: thresholds of the score, (T,).
        profiles: share of weeks whose score exceeds each threshold, 0..1, (T,), keyed by method.
        label: name of the score, with its unit.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(9.0, 5.0)
    axes = figure.subplots()
    for index, (name, shares) in enumerate(profiles.items()):
        axes.plot(thresholds, 100.0 * shares, linewidth=1.6, label=literal_text(name),
                  **line_style(index))  # fmt: skip
    axes.set_ylim(0.0, 100.0)
    axes.set(xlabel=f"threshold: {label}", ylabel="weeks above the threshold (%)")
    style_axes_with_legend(axes)
    return figure
