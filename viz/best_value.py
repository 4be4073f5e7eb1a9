"""The best value of a field by month as a picture: how far each value is from the best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sdc_taichi.types import F64

from .plotting import ORANGE, add_title, literal_text, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

MOST_PANELS = 12
"""Largest number of panels of a picture."""
_COLUMNS = 4
"""Largest number of panels beside each other."""
_LEAST_PCT, _MOST_PCT = 0.1, 20.0
"""Least and largest value at the end of the colour bar, in %."""


class MonthlyFigures(NamedTuple):
    """A metric of one data center in M months at V values of a field."""

    name: str
    """Name of the data center, such as its site."""
    months: Sequence[int]
    """Months, 1..12, M of them."""
    values: F64
    """Values of the field, in ascending order, (V,)."""
    figures: F64
    """The metric, of which less is better, (M, V)."""


def plot_best_values(
    panels: Sequence[MonthlyFigures], field: str, metric: str, default: float | None
) -> Figure:
    """Draw how far the metric is above its least in each month, a panel for each data center.

    A dot is the best value of a month, the full line the best fixed value of all months, the dashed
    one the value of the config. Of more than ``MOST_PANELS`` data centers the first are drawn.

    Args:
        panels: the figures of each data center.
        field: name of the field.
        metric: name of the metric.
        default: value of the config; None if it has no such number.

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
    limit_pct = min(max(top_pct, _LEAST_PCT), _MOST_PCT)
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
    """By how much figures, (M, V), are above the least of their month, in %."""
    least = figures.min(axis=1, keepdims=True)
    return np.asarray(100.0 * (figures / np.where(least == 0.0, np.nan, least) - 1.0))


def _draw_panel(
    axes: Axes, panel: MonthlyFigures, above_pct: F64, limit_pct: float, default: float | None
) -> QuadMesh:
    """Draw one data center."""
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
