"""Map of the work that the sites of a fleet send to each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.types import F64

from .plotting import GREY, format_number, literal_text, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_LABELS = 24
"""Largest number of sites with names on a map: those that send and get most."""
_PANEL_IN, _COLUMNS = 5.9, 2
_LARGEST_DISC_PT, _WIDEST_ARROW_PT, _NARROWEST_ARROW_PT = 11.0, 9.0, 1.4
"""Radius of the largest disc, and widths of arrows, in points."""
_ARROW_HEAD_PT = 6.0
_POINTS_OF_SIDE = 40
"""Number of points on each side of an arrow that names avoid."""
_BEND = 0.16
"""Distance of the middle of an arrow from the straight line, divided by its length. It keeps the
arrows of both directions between two sites apart."""
_TOP_IN, _GAP_IN, _LEGEND_IN = 0.3, 0.12, 0.75
_DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Directions from a disc in which its name is tried, as signs of x and y, best first."""


@dataclass(frozen=True, slots=True)
class FlowPanel:
    """Flows of a fleet of S sites in a part of the day, as means over the days of a run."""

    title: str
    """Title of the panel."""
    tasks: F64
    """Work sent in this part of a day, by sender and receiver, in tasks, (S, S)."""
    executed_tasks: F64
    """Work that each site has executed in this part of a day, in tasks, (S,)."""
    ci_g_per_kwh: F64
    """Mean carbon intensity of each site, in g CO2e/kWh, (S,)."""


def flow_map(panels: Sequence[FlowPanel], names: Sequence[str], place_deg: F64) -> Figure:
    """Draw flows on maps of the sites, with a panel for each part of the day.

    Sites are discs, whose area is the executed work and whose colour is the mean carbon intensity.
    The width of an arrow is the work that went from site to site. All panels have the same scales.

    Args:
        panels: flows of each part of the day.
        names: names of the S sites.
        place_deg: latitude and longitude of each site, in degrees, (S, 2).

    Raises:
        SdcError: matplotlib is missing.
    """
    from matplotlib.colors import Normalize

    x_y, limits = _projected(place_deg)
    (left, right), (bottom, top) = limits
    columns = min(_COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    height_in = float(np.clip(_PANEL_IN * (top - bottom) / (right - left), 2.0, 5.0))
    size_in = (
        columns * (_PANEL_IN + _GAP_IN) + _GAP_IN,
        rows * (_TOP_IN + height_in + _GAP_IN) + _LEGEND_IN,
    )
    figure = new_figure(*size_in)
    # Names are placed by their distances on paper, so the size of the panels must not change.
    figure.set_layout_engine("none")
    all_ci = np.array([panel.ci_g_per_kwh for panel in panels])
    colours = Normalize(all_ci.min(), max(all_ci.max(), all_ci.min() + 1.0))
    most = max(float(panel.tasks.max()) for panel in panels)
    most_executed = max(float(panel.executed_tasks.max()) for panel in panels)
    for index, panel in enumerate(panels):
        row, column = divmod(index, columns)
        corner_in = (
            _GAP_IN + column * (_PANEL_IN + _GAP_IN),
            size_in[1] - (row + 1) * (_TOP_IN + height_in) - row * _GAP_IN,
        )
        axes = figure.add_axes(
            (
                corner_in[0] / size_in[0],
                corner_in[1] / size_in[1],
                _PANEL_IN / size_in[0],
                height_in / size_in[1],
            )
        )
        axes.set(xlim=limits[0], ylim=limits[1], xticks=[], yticks=[])
        axes.spines[:].set_color(GREY)
        axes.spines[:].set_linewidth(0.6)
        axes.set_title(panel.title, fontsize=10, loc="left")
        radii_pt = _LARGEST_DISC_PT * np.sqrt(panel.executed_tasks / (most_executed or 1.0))
        arrows = _draw_arrows(axes, panel.tasks / (most or 1.0), x_y, radii_pt)
        discs = axes.scatter(
            x_y[:, 0],
            x_y[:, 1],
            s=(2 * radii_pt) ** 2,
            c=panel.ci_g_per_kwh,
            norm=colours,
            cmap="viridis",
            edgecolors="black",
            linewidths=0.8,
            zorder=3,
        )
        busiest = panel.tasks.sum(axis=0) + panel.tasks.sum(axis=1)
        _draw_names(axes, names, x_y, radii_pt, busiest, arrows)
    _draw_legend(figure, discs, size_in, most, most_executed)
    return figure


def _projected(place_deg: F64) -> tuple[F64, tuple[tuple[float, float], tuple[float, float]]]:
    """Return x and y of sites, (S, 2), and the limits of x and of y of their map, with a margin.

    A degree of longitude has the length that it has at the middle latitude of the sites. The map
    is cut at the widest gap between the longitudes.
    """
    latitude, longitude = place_deg.T
    ordered = np.sort(longitude)
    gaps = np.diff(ordered, append=ordered[0] + 360.0)
    first = ordered[(int(gaps.argmax()) + 1) % len(ordered)]
    middle = np.radians((latitude.min() + latitude.max()) / 2)
    x_y = np.stack([(longitude - first) % 360.0 * np.cos(middle), latitude], axis=1)
    low, high = x_y.min(axis=0), x_y.max(axis=0)
    margin = 0.1 * max(float((high - low).max()), 1.0)
    width, height = high - low + 2 * margin
    # A panel is at most 2.5 times as wide as high, and at most 1.2 times as high as wide.
    wider, higher = max(height / 0.84 - width, 0.0) / 2, max(width / 2.5 - height, 0.0) / 2
    return x_y, (
        (low[0] - margin - wider, high[0] + margin + wider),
        (low[1] - margin - higher, high[1] + margin + higher),
    )


def _draw_arrows(axes: Axes, shares: F64, x_y: F64, radii_pt: F64) -> F64:
    """Draw an arrow for each flow, wide ones first, and return points on them, (n, 2), in pixels.

    Args:
        axes: axes of a panel.
        shares: flows divided by the largest one, (S, S).
        x_y: places of the sites, (S, 2).
        radii_pt: radii of their discs, in points, (S,).
    """
    points: list[F64] = [np.empty((0, 2))]
    for sender, receiver in sorted(np.argwhere(shares), key=lambda pair: -shares[tuple(pair)]):
        ends = (radii_pt[sender], radii_pt[receiver])
        share = shares[sender, receiver]
        arrow = axes.add_patch(_arrow(x_y[sender], x_y[receiver], share, ends, _BEND))
        outline = arrow.get_path().transformed(arrow.get_transform())
        points.append(np.asarray(outline.interpolated(_POINTS_OF_SIDE).vertices, dtype=np.float64))
    return np.concatenate(points)


def _arrow(begin: F64, end: F64, share: float, shrink_pt: tuple[float, float], bend: float) -> Any:
    """Return an arrow whose width is a share of the widest one."""
    from matplotlib.patches import ArrowStyle, FancyArrowPatch

    width_pt = max(_WIDEST_ARROW_PT * share, _NARROWEST_ARROW_PT)
    style = ArrowStyle.Simple(
        head_length=_ARROW_HEAD_PT + 0.5 * width_pt,
        head_width=_ARROW_HEAD_PT + 1.2 * width_pt,
        tail_width=width_pt,
    )
    return FancyArrowPatch(
        tuple(begin), tuple(end), arrowstyle=style, connectionstyle=f"arc3,rad={bend}",
        shrinkA=shrink_pt[0], shrinkB=shrink_pt[1] + 1, mutation_scale=1.0, facecolor="#666666",
        edgecolor="white", linewidth=0.5, zorder=2,
    )  # fmt: skip


def _draw_names(
    axes: Axes, names: Sequence[str], x_y: F64, radii_pt: F64, importance: F64, arrows_px: F64
) -> None:
    """Write names beside discs where they cover no disc and no other name, if possible no arrow.

    A name without such a place is left out. The most important sites choose first.

    Args:
        axes: axes of a panel.
        names: names of the S sites.
        x_y: places of the sites, (S, 2).
        radii_pt: radii of their discs, in points, (S,).
        importance: importance of each site, (S,).
        arrows_px: points on the arrows, in pixels, (n, 2).
    """
    figure: Any = axes.figure
    points = 72.0 / figure.dpi
    centres = axes.transData.transform(x_y) * points
    arrows = arrows_px * points
    frame = axes.get_window_extent().get_points() * points
    taken = [np.stack([c - r, c + r]) for c, r in zip(centres, radii_pt + 1.0, strict=True)]
    for site in np.argsort(-importance, kind="stable")[:MAX_LABELS]:
        text = literal_text(names[site])
        x, y = x_y[site].tolist()
        label = axes.text(x, y, text, fontsize=9, ha="center", va="center", zorder=4)
        extent = label.get_window_extent().get_points() * points
        size = extent[1] - extent[0]
        middles = np.array([*_places(centres[site], radii_pt[site], size)])
        low, high = middles - size / 2, middles + size / 2
        fits = np.all((low >= frame[0]) & (high <= frame[1]), axis=1)
        for box in taken:
            fits &= np.any((low >= box[1]) | (high <= box[0]), axis=1)
        if not fits.any():
            label.remove()
            continue
        on_arrows = np.all((arrows > low[:, None]) & (arrows < high[:, None]), axis=2)
        best = int(np.where(fits, on_arrows.sum(axis=1), np.inf).argmin())
        x, y = axes.transData.inverted().transform(middles[best] / points).tolist()
        label.set_position((x, y))
        taken.append(np.stack([low[best], high[best]]))


def _places(centre: F64, radius_pt: float, size_pt: F64) -> Iterator[F64]:
    """Yield middles of a name around a disc, near ones first, in points, (2,) each."""
    for distance_pt in (2.0, 8.0, 14.0):
        for direction in _DIRECTIONS:
            # Towards a corner, the name may be nearer, because a disc has none.
            apart = radius_pt * (0.75 if all(direction) else 1.0) + distance_pt
            yield centre + np.array(direction) * (apart + size_pt / 2)


def _round_down(value: float) -> float:
    """Return the largest of 1, 2 or 5 times a power of ten that is at most a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(factor for factor in (1, 2, 5) if factor * power <= value))


def _draw_legend(
    figure: Figure, discs: Any, size_in: tuple[float, float], most: float, most_executed: float
) -> None:
    """Draw the scales of arrows, discs and colours below the panels."""
    width, height = size_in
    axes = figure.add_axes((0.0, 0.0, 0.6, (_LEGEND_IN - _GAP_IN) / height))
    axes.set(xlim=(0.0, 0.6 * width), ylim=(0.0, _LEGEND_IN - _GAP_IN))
    axes.set_axis_off()
    x, y = 2 * _GAP_IN, (_LEGEND_IN - _GAP_IN) / 2
    if most:
        for tasks in (_round_down(most), _round_down(most / 4)):
            ends = np.array([x, y]), np.array([x + 0.6, y])
            axes.add_patch(_arrow(*ends, tasks / most, (0.0, 0.0), 0.0))
            text = f"{format_number(tasks)} tasks sent"
            axes.text(x + 0.7, y, text, va="center", fontsize=9)
            x += 2.1
    if most_executed:
        tasks = _round_down(most_executed)
        area = (2 * _LARGEST_DISC_PT) ** 2 * tasks / most_executed
        axes.scatter([x + 0.2], [y], s=area, facecolors="none", edgecolors="black",
                     linewidths=0.8)  # fmt: skip
        text = f"{format_number(tasks)} tasks executed"
        axes.text(x + 0.45, y, text, va="center", fontsize=9)
    bar = figure.add_axes((0.66, 0.42 / height, 0.32, 0.11 / height))
    figure.colorbar(discs, cax=bar, orientation="horizontal")
    bar.set_title("mean carbon intensity (g CO₂e/kWh)", fontsize=9, pad=3)
    bar.tick_params(labelsize=8, length=2, pad=1)
