"""Pictures of a benchmark: intervals and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from sdc_taichi.errors import SdcError
from sdc_taichi.types import F64

from .plotting import (
    BLUE,
    GREY,
    line_style,
    literal_text,
    new_figure,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def interval_plot(
    intervals: Mapping[str, tuple[float, float, float]],
    label: str,
    *,
    marks: Sequence[float] = (),
) -> Figure:
    """Values with their intervals, one below the other.

    Args:
        intervals: name to a value and the ends of its interval, from the top to the bottom.
        label: what the values are, with their unit.
        marks: values at which vertical lines stand.

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


def profile_plot(thresholds: F64, profiles: Mapping[str, F64], label: str) -> Figure:
    """Share of runs above each of several thresholds, after Dolan and Moré (2002).

    Args:
        thresholds: of the score, (T,).
        profiles: name to the share of runs whose score is above each threshold, 0..1, (T,).
        label: what the score is, with its unit.

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
