"""Pictures of a benchmark: intervals, performance profiles, and scores as a radar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.types import F64

from .plotting import (
    BLUE,
    GREY,
    line_style,
    literal_text,
    new_figure,
    place_radar_labels,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ROOM = 0.15
"""Part of a radar's axis that is left below the lowest score."""


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


def score_radar(scores: Mapping[str, Sequence[float]], labels: Sequence[str]) -> Figure:
    """Several scores as a polygon for each of what is compared; the larger it is, the better.

    The dotted circle is a score of 0.

    Args:
        scores: name to the scores, as many as labels, more is better.
        labels: what the scores are of.

    Raises:
        SdcError: matplotlib is missing, or there are no names or fewer than three labels.
    """
    if not scores or len(labels) < 3:
        raise SdcError(
            f"radar of {len(scores)} names and {len(labels)} scores; valid are one name and three "
            "scores or more"
        )
    values = np.array(list(scores.values()), dtype=np.float64)
    low, high = min(values.min(), 0.0), max(values.max(), 0.0)
    width = max(high - low, 1e-9)

    def radius(score: F64) -> F64:
        return np.asarray(_ROOM + (1.0 - _ROOM) * (score - low) / width)

    angle = np.arange(len(labels)) * 2 * np.pi / len(labels)
    figure = new_figure(9.0, 5.6)
    # The layout engine leaves no room for labels beside a circle.
    figure.set_layout_engine("none")
    axes: Any = figure.add_axes((0.15, 0.1, 0.46, 0.76), projection="polar")
    axes.set_theta_offset(np.pi / 2)
    axes.set_theta_direction(-1)
    for index, (name, row) in enumerate(zip(scores, radius(values), strict=True)):
        style = line_style(index)
        axes.plot(np.append(angle, 0.0), np.append(row, row[0]), linewidth=1.8, marker="o",
                  clip_on=False, markersize=3, label=literal_text(name), **style)  # fmt: skip
    circle = np.linspace(0.0, 2 * np.pi, 181)
    axes.plot(circle, radius(0.0 * circle), color=GREY, linewidth=1.0, linestyle=":")
    axes.set_ylim(0.0, 1.0)
    axes.set_yticks([])
    axes.set_xticks(angle, [literal_text(label) for label in labels], fontsize=9)
    place_radar_labels(axes, angle)
    axes.spines["polar"].set_color(GREY)
    figure.legend(loc="upper right", frameon=False, fontsize=9, title="outside is better")
    return figure
