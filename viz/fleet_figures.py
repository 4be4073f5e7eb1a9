"""Pictures of many data centers, and of several runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

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
    colour_range,
    draw_steps,
    format_number,
    format_time_axis,
    line_style,
    literal_text,
    new_figure,
    place_radar_labels,
    repeat_last,
    scale_thousands,
    step_edges,
    step_hours,
    style_axes,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

RADAR_METRICS = (
    ("cfp_kg", "carbon footprint", "kg CO₂e"),
    ("hvac_kwh", "HVAC energy", "kWh"),
    ("it_kwh", "IT energy", "kWh"),
    ("water_l", "water", "L"),
    ("queue_mean_tasks", "task queue, mean", "tasks"),
)
"""The five metrics by which the SustainDC paper compares controllers (section 5, figure 4): name in
metrics.json, label, unit."""
MAX_RUNS = 12
"""Largest number of runs in one radar."""
CENTRES_PCT = (99.0, 98.0, 95.0, 90.0, 80.0, 50.0, 0.0)
"""Values that the middle of a radar's axis may stand for, in % of the worst run."""
MAX_MAP_ROWS = 40
"""Largest number of data centers in ``fleet_map``."""


def radar(runs: Mapping[str, Mapping[str, Metric]]) -> Figure:
    """Five metrics of several runs; less is better, so the smallest polygon is the best.

    Each axis ends at the worst of the runs, which is printed with its value. Its middle stands for
    0 or a share of the worst, printed too, such that small differences can be seen.

    Args:
        runs: name to the metrics of a run, as ``total`` or ``metrics`` in metrics.json.

    Raises:
        SdcError: matplotlib or a metric is missing, or there are fewer than two or more than
            ``MAX_RUNS`` runs.
    """
    figure = new_figure(11.0, 6.4)
    values = _radar_values(runs)
    worst = values.max(axis=0)
    # Where all are zero, all are as good as can be.
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
        _radar_label(label, unit, most, most * low / 100)
        for (_, label, unit), most, low in zip(RADAR_METRICS, worst, centre, strict=True)
    ]
    axes.set_xticks(angle, labels, fontsize=9)
    axes.tick_params(axis="x", pad=6)
    place_radar_labels(axes, angle)
    axes.spines["polar"].set_color(GREY)
    figure.legend(loc="upper right", frameon=False, title="less is better")
    return figure


def fleet_overview(steps: pd.DataFrame) -> Figure:
    """A run of a fleet: power, carbon, PUE and the hottest inlets of all data centers together.

    Args:
        steps: two rows or more: ``time`` on the clock of the first data center; ``it_w``,
            ``overhead_w`` and ``carbon_g``, sums over the data centers; ``inlet_low_c``,
            ``inlet_mid_c``, ``inlet_high_c`` and ``inlet_max_c``, 10 %, median, 90 % and the
            highest of their hottest inlets.

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
    """Which halls run hot, and when: the hottest inlet of each data center over time.

    The hottest data centers stand above, ``MAX_MAP_ROWS`` at most.

    Args:
        edges: beginnings of the intervals shown and the end of the last, (n + 1,).
        inlet_max_c: hottest inlet of each interval and data center, (n, B).
        names: of the data centers, (B,).

    Raises:
        SdcError: matplotlib is missing, or the shapes do not fit.
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
    """Values of the radar's metrics, (runs, metrics).

    Raises:
        SdcError: fewer than two or too many runs, or a metric that is missing or negative.
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
    """Label of an axis with the values at the rim and in the middle."""
    if rim == 0.0:
        return f"{label}\n0 {unit} for all"
    ends = f"{format_number(rim)} {unit} at the rim\n{format_number(middle)} in the middle"
    return f"{label}\n{ends}"


def _centre_pct(share_pct: F64) -> float:
    """The highest of ``CENTRES_PCT`` that leaves a quarter of the axis below the best value."""
    best = float(share_pct.min())
    return next(c for c in CENTRES_PCT if best >= c + 0.25 * (100.0 - c) or c == 0.0)
