"""Maps of the racks of a hall: highest inlet, hours above the recommended one, junctions.

Several runs of one hall are drawn beside each other with the same colours, so that variants can be
compared rack by rack.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sdc_taichi.config import HallConfig
from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.types import F64

from .plotting import (
    MIN_COLOUR_RANGE_K,
    ON_COLOUR,
    draw_rack_grid,
    literal_text,
    new_figure,
    outline_hottest,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

MAX_RACKS_IN_COLUMNS = 12
"""Largest number of racks in a row for which two maps are drawn side by side."""
MAX_NUMBERED_RACKS = 300
"""Largest number of racks of a map whose cells show their values as numbers."""
MAX_NUMBERED_RACKS_PER_ROW = 24
"""Largest number of racks in a row of a map whose cells show their values as numbers."""
_WIDTH_IN = 11.0
_ROW_IN = 0.3
"""Height of a row of racks in a map, in inches; large halls have lower rows."""
_LOWEST_MAP_IN, _HIGHEST_MAP_IN = 2.0, 6.0
_BAR_IN = 0.22
"""Width of a colour bar, in inches."""
_TICKS_APART = 12
"""Least distance of a tick of the colour bar from a limit, as a divisor of the range of the bar."""
_BEYOND_LIMIT = "#4B0055"
"""Colour of racks above the allowable inlet, or above the junction temperature of a trip."""
_SHADES = 256
"""Number of colours of a map."""


def inlet_map(racks_of: Mapping[str, pd.DataFrame], hall: HallConfig, allowable_c: float) -> Figure:
    """Draw the highest inlet of every rack over a run, in colours that change at the limits.

    Blue and green racks stayed within the recommended range, yellow to red racks were above it,
    and violet racks were above the allowable limit of their class.

    Args:
        racks_of: statistics of the racks, as ``read_racks`` returns them, keyed by name of the run.
        hall: the hall of the runs.
        allowable_c: highest allowable inlet of the servers, in C.

    Raises:
        SdcError: matplotlib or a column is missing, or the number of rows is not that of racks.
    """
    grids = _grids(racks_of, hall, "inlet_max_c")
    low_c = min(float(np.floor(grid.min())) for grid in grids.values())
    high_c = max(float(np.ceil(grid.max())) for grid in grids.values())
    limits = low_c, max(high_c, low_c + MIN_COLOUR_RANGE_K)
    titles = {}
    for name, grid in grids.items():
        over_k = float(grid.max()) - RECOMMENDED_C[1]
        side = "above" if over_k > 0 else "below"
        titles[name] = (
            f"hottest inlet {grid.max():.1f} °C, {abs(over_k):.1f} K {side} the recommended "
            f"{RECOMMENDED_C[1]:g} °C, at "
        )
    cmap = _banded_colours(limits, RECOMMENDED_C[1], allowable_c)
    figure, image = _draw_maps(grids, titles, _Scale(cmap, limits, ".1f"), has_marks=True)
    named = ((RECOMMENDED_C[1], "recommended"), (allowable_c, "allowable"))
    _mark_limits(_colour_bar(figure, image, "highest inlet (°C)"), limits, named)
    return figure


def junction_map(junction_c: F64, hall: HallConfig, limits_c: tuple[float, float]) -> Figure:
    """Draw the junction temperature of every liquid-cooled rack; racks cooled by air are grey.

    Args:
        junction_c: junction temperature of each rack, in C, (R,); 0 for racks cooled by air.
        hall: the hall.
        limits_c: junction temperatures at which GPUs throttle and at which racks trip, in C.

    Raises:
        SdcError: matplotlib is missing.
    """
    grid = np.ma.masked_equal(junction_c.reshape(hall.rows, hall.racks_per_row), 0.0)
    throttle_c, trip_c = limits_c
    low_c, high_c = float(np.floor(grid.min())), float(np.ceil(grid.max()))
    limits = low_c, max(high_c, throttle_c, low_c + MIN_COLOUR_RANGE_K)
    below_k = throttle_c - float(grid.max())
    title = (
        f"hottest junction {grid.max():.1f} °C, {abs(below_k):.1f} K "
        f"{'below' if below_k > 0 else 'above'} the {throttle_c:g} °C of throttling, at "
    )
    scale = _Scale(_banded_colours(limits, throttle_c, trip_c), limits, ".1f")
    figure, image = _draw_maps({"": grid}, {"": title}, scale, has_marks=True)
    named = ((throttle_c, "throttle"), (trip_c, "trip"))
    _mark_limits(_colour_bar(figure, image, "junction (°C)"), limits, named)
    return figure


def hours_map(racks_of: Mapping[str, pd.DataFrame], hall: HallConfig) -> Figure:
    """Draw for how many hours of a run the hottest inlet of each rack was above the recommended.

    Grey racks never were.

    Args:
        racks_of: statistics of the racks, as ``read_racks`` returns them, keyed by name of the run.
        hall: the hall of the runs.

    Raises:
        SdcError: matplotlib or a column is missing, or the number of rows is not that of racks.
    """
    grids = _grids(racks_of, hall, "above_27_h")
    longest_h = max(float(grid.max()) for grid in grids.values())
    titles = {
        name: f"{np.count_nonzero(grid):,} of {grid.size:,} racks were above {RECOMMENDED_C[1]:g} "
        f"°C, the longest for {grid.max():,.4g} h"
        for name, grid in grids.items()
    }
    shown = {name: np.ma.masked_equal(grid, 0.0) for name, grid in grids.items()}
    scale = _Scale("YlOrRd", (0.0, longest_h or 1.0), ",.4g")
    figure, image = _draw_maps(shown, titles, scale, has_marks=False)
    _colour_bar(figure, image, f"above {RECOMMENDED_C[1]:g} °C (h)")
    return figure


class _Scale(NamedTuple):
    """Colours and numbers of the cells of a map."""

    cmap: str | Colormap
    limits: tuple[float, float]
    """Values at the ends of the colours."""
    number_format: str


def _grids(racks_of: Mapping[str, pd.DataFrame], hall: HallConfig, column: str) -> dict[str, F64]:
    """Return a column of the racks of each run, (rows, racks per row), keyed by name of the run.

    Raises:
        SdcError: the column is missing, or the number of rows is not that of racks.
    """
    grids = {}
    for name, racks in racks_of.items():
        if column not in racks.columns:
            raise SdcError(f"racks: missing columns {column}")
        if len(racks) != hall.racks:
            raise SdcError(f"racks: {len(racks)} rows; valid is one for each of {hall.racks} racks")
        grids[name] = racks[column].to_numpy().reshape(hall.rows, hall.racks_per_row)
    return grids


def _draw_maps(
    grids: Mapping[str, Any], titles: Mapping[str, str], scale: _Scale, *, has_marks: bool
) -> tuple[Figure, Any]:
    """Draw one map for each run; return the figure and the last map, for the colour bar.

    Args:
        grids: values of the racks of each run, keyed by its name; masked racks are grey.
        titles: text above each map, after the name of the run if there are several.
        scale: colours and numbers of the cells.
        has_marks: True to mark the hottest racks, and to name them after the title.
    """
    rows, racks_per_row = next(iter(grids.values())).shape
    columns = 2 if len(grids) > 1 and racks_per_row <= MAX_RACKS_IN_COLUMNS else 1
    lines = -(-len(grids) // columns)
    map_in = float(np.clip(_ROW_IN * rows, _LOWEST_MAP_IN, _HIGHEST_MAP_IN))
    figure = new_figure(_WIDTH_IN, lines * (map_in + 0.9))
    panels = figure.subplots(lines, columns, squeeze=False)
    for axes in panels.flat[len(grids) :]:
        axes.remove()
    image: Any = None
    for axes, (name, grid) in zip(panels.flat, grids.items(), strict=False):
        image = draw_rack_grid(axes, grid, scale.cmap, scale.limits)
        axes.set_facecolor("#DDDDDD")
        _number_racks(axes, image, grid, scale, columns)
        outlined = _has_numbers(grid, columns)
        title = titles[name] + (outline_hottest(axes, grid, outlined) if has_marks else "")
        lead = f"{literal_text(name)}: " if name else ""
        axes.set_title(lead + title, fontsize=10 if columns == 1 else 8, loc="left")
    return figure, image


def _colour_bar(figure: Figure, image: Any, label: str) -> Any:
    """Add a colour bar of constant width beside all maps of a figure."""
    height_in = figure.get_figheight()
    return figure.colorbar(
        image, ax=figure.axes, label=label, aspect=height_in / _BAR_IN, fraction=0.05, pad=0.02
    )


def _mark_limits(bar: Any, limits: tuple[float, float], named: Sequence[tuple[float, str]]) -> None:
    """Mark temperatures on a colour bar with their names, if they are within its range.

    Args:
        bar: the colour bar.
        limits: values at the ends of the colours, in C.
        named: temperatures in C, each with its name.
    """
    marks = {limit_c: text for limit_c, text in named if limits[0] <= limit_c <= limits[1]}
    apart_k = (limits[1] - limits[0]) / _TICKS_APART
    inside = [t for t in bar.get_ticks() if limits[0] <= t <= limits[1]]
    ticks = [t for t in inside if all(abs(t - limit_c) >= apart_k for limit_c in marks)]
    texts = [f"{t:g}" for t in ticks] + [f"{c:g} {text}" for c, text in marks.items()]
    bar.set_ticks([*ticks, *marks], labels=texts)
    for limit_c in marks:
        bar.ax.axhline(limit_c, color="black", linewidth=2.0)


def _number_racks(axes: Axes, image: Any, grid: Any, scale: _Scale, columns: int) -> None:
    """Write the value of each rack into its cell, if the cells are large enough."""
    if not _has_numbers(grid, columns):
        return
    racks_per_row = grid.shape[1]
    for row, rack in zip(*np.nonzero(~np.ma.getmaskarray(grid)), strict=True):
        value = float(grid[row, rack])
        red, green, blue, _ = image.cmap(image.norm(value))
        is_light = 0.3 * red + 0.59 * green + 0.11 * blue > 0.55
        axes.text(
            rack + 0.5,
            row + 0.5,
            format(value, scale.number_format),
            color="black" if is_light else "white",
            gid=ON_COLOUR,
            ha="center",
            va="center",
            fontsize=9 if columns * racks_per_row <= MAX_RACKS_IN_COLUMNS else 7,
        )


def _has_numbers(grid: Any, columns: int) -> bool:
    """Return True if the cells of a map are large enough for numbers."""
    return bool(
        grid.size <= MAX_NUMBERED_RACKS and columns * grid.shape[1] <= MAX_NUMBERED_RACKS_PER_ROW
    )


def _banded_colours(limits: tuple[float, float], warm_c: float, hot_c: float) -> Colormap:
    """Return colours of temperatures that change at two limits.

    Args:
        limits: temperatures at the ends of the colours, in C.
        warm_c: temperature up to which the colours are blue and green, in C.
        hot_c: temperature from which the colour is violet, in C.
    """
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap, to_rgba

    low_c, high_c = limits
    shade_c = low_c + (high_c - low_c) * (np.arange(_SHADES) + 0.5) / _SHADES
    cool_top_c, warm_top_c = min(high_c, warm_c), min(high_c, hot_c)
    cool = np.interp(shade_c, (min(low_c, cool_top_c - 1e-3), cool_top_c), (0.05, 0.8))
    warm_low_c = max(low_c, warm_c)
    warm = np.interp(shade_c, (warm_low_c, max(warm_top_c, warm_low_c + 1e-3)), (0.2, 0.95))
    colours = np.where(
        (shade_c <= warm_c)[:, None], colormaps["YlGnBu_r"](cool), colormaps["YlOrRd"](warm)
    )
    colours[shade_c > hot_c] = to_rgba(_BEYOND_LIMIT)
    return ListedColormap(colours)
