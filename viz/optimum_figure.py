"""One day of a data center under several controllers, an optimum among them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.types import F64

from .dashboards import is_over_a_year, rows_of_day
from .plotting import (
    GREY,
    LINE_COLOURS,
    RED,
    add_title,
    check_steps,
    date_text,
    draw_steps,
    literal_text,
    new_figure,
    short_name,
    step_edges,
    style_axes,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = ("time", "ci_g_per_kwh", "price_per_kwh", "utilisation", "setpoint_c", "soc")
"""Columns of steps.parquet that the picture reads."""
IDLE = "idle"
"""Label that is drawn in grey."""
_DAY = np.timedelta64(1, "D")


def optimum_day(
    steps_of: Mapping[str, pd.DataFrame], date: str, title: str = "", *, by_price: bool = False
) -> Figure:
    """What grid, load, setpoint and battery do over a day under each of some controllers.

    Args:
        steps_of: steps of one data center under each controller, by label.
        date: ``MM-DD``, the first such day of the run, or with the year of its times before it.
        title: written above, such as the name of the data center.
        by_price: whether to draw the price of a kWh in place of its carbon intensity.

    Raises:
        SdcError: matplotlib or a column is missing, runs of other times, or without the day.
    """
    from matplotlib.dates import DateFormatter, HourLocator

    figure = new_figure(11.0, 9.0)
    first = next(iter(steps_of.values()))
    for label, steps in steps_of.items():
        check_steps(steps, COLUMNS)
        if not np.array_equal(steps["time"], first["time"]):
            raise SdcError(f"steps of {label}: of other times than the first")
    rows = rows_of_day(first, date)
    panels = figure.subplots(4, 1, sharex=True, height_ratios=[2, 3, 3, 3])
    shown = first.iloc[slice(*rows)]
    check_steps(shown, COLUMNS)
    column, label = (
        ("price_per_kwh", "price of a kWh\n(currency)")
        if by_price
        else ("ci_g_per_kwh", "carbon intensity\n(g CO₂e/kWh)")
    )
    draw_steps(panels[0], shown, shown[column], color=RED)
    panels[0].set_ylabel(label)
    style_axes(panels[0])
    _draw_controllers(panels[1:], steps_of, rows)
    panels[1].set_ylabel("utilisation (%)")
    panels[2].set_ylabel("setpoint (°C)")
    panels[3].set_ylabel("battery charge (%)")
    panels[3].set_ylim(-3, 103)
    style_axes_with_legend(panels[1])
    style_axes(panels[2])
    style_axes(panels[3])
    panels[-1].xaxis.set_major_locator(HourLocator(range(0, 24, 3)))  # type: ignore[no-untyped-call]
    panels[-1].xaxis.set_major_formatter(DateFormatter("%H:%M"))  # type: ignore[no-untyped-call]
    begin = shown["time"].iloc[0].normalize()
    panels[-1].set_xlim(begin, begin + _DAY)
    name = date_text(begin, over_a_year=is_over_a_year(first))
    panels[-1].set_xlabel(f"local standard time on {name}")
    add_title(figure, short_name(title))
    return figure


def day_of_most_saved(saved: F64, times: pd.Series) -> str:
    """Day on which most is saved, YYYY-MM-DD, the first if several are equal.

    Args:
        saved: what is saved in each step.
        times: times at which the steps begin.
    """
    days = times.dt.strftime("%Y-%m-%d").to_numpy()
    names, of_step = np.unique(days, return_inverse=True)
    # Rounded, because sums of equal days may differ in their last digits.
    sums = np.bincount(of_step, weights=saved)
    steps = np.bincount(of_step)
    # Days that the run has in part are shown only where there are no others.
    whole = np.where(steps == steps.max(), sums, -np.inf)
    return str(names[int(np.argmax(np.round(whole, 6)))])


def _draw_controllers(
    panels: list[Axes], steps_of: Mapping[str, pd.DataFrame], rows: tuple[int, int]
) -> None:
    """Draw utilisation, setpoint and battery charge under each controller."""
    colours = iter(LINE_COLOURS * len(steps_of))
    first, after = rows
    for index, (label, steps) in enumerate(steps_of.items()):
        colour = GREY if label == IDLE else next(colours)
        style: dict[str, Any] = {"color": colour, "linewidth": 1.3, "label": literal_text(label)}
        style["zorder"] = 2 + index
        shown = steps.iloc[first:after]
        draw_steps(panels[0], shown, 100.0 * shown["utilisation"], **style)
        draw_steps(panels[1], shown, shown["setpoint_c"], **style)
        # The day begins with what the step before left.
        before = steps.iloc[max(first - 1, 0) : after]
        panels[2].plot(step_edges(before)[1:], 100.0 * before["soc"], **style)
