"""Pictures of the input data of data centers: workload, temperature and carbon intensity.

The pictures follow figures 10 to 16 of the SustainDC paper. They compare sites over the run, over
the mean day, and by the mean and the daily variation of carbon intensity. Inputs are named pandas
series that are indexed by local standard time, such as a column of steps.parquet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import SdcError, printable
from sdc_taichi.exogenous.series import Series, resample
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, FIRST_DAY_OF_MONTH, HOURS_PER_YEAR

from .plotting import (
    BLUE,
    RED,
    add_title,
    format_time_axis,
    line_style,
    literal_text,
    new_figure,
    remove_frame,
    style_axes,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from pandas.api.typing import SeriesGroupBy

DAILY_FROM_DAYS = 60
"""Length from which ``comparison`` shows weekly means, in days; shorter series show every step."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """Quantity of a series: how its values are scaled, labelled and coloured."""

    label: str
    """Label of the axis, with the unit."""
    colour: str
    """Colour of the line in axes with a single line."""
    factor: float = 1.0
    """Factor that converts values of the series to the unit of the label."""


TEMPERATURE = Quantity("outdoor temperature (°C)", RED)
"""Outdoor temperature, for series in C."""
CARBON = Quantity("carbon intensity (g CO₂e/kWh)", "black")
"""Carbon intensity, for series in g CO2e/kWh."""
WORKLOAD = Quantity("workload (% of capacity)", BLUE, 100.0)
"""Workload, for series in shares of the capacity (0..1)."""


def comparison(series: Mapping[str, pd.Series], quantity: Quantity, title: str = "") -> Figure:
    """Draw series of several sites in one picture: over the run, and over the mean day.

    Args:
        series: values of each site or trace by time, keyed by its name.
        quantity: the quantity of all series.
        title: text above the figure, such as the source of the data.

    Raises:
        SdcError: matplotlib is missing, or a series has fewer than two values.
    """
    check_series(series)
    figure = new_figure(12.0, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=[3, 2], sharey=False)
    by_week = max(map(days_of, series.values())) >= DAILY_FROM_DAYS
    for index, (name, values) in enumerate(series.items()):
        style = line_style(index)
        shown = quantity.factor * values
        curve, times = shown, _times(shown)
        if by_week:
            weeks = shown.resample("7D")
            curve = weeks.mean()
            # A mean is drawn at the middle of its week; the last week may be shorter.
            times = _times(curve) + weeks.count().to_numpy() * (times[1] - times[0]) / 2
        left.plot(times, curve, label=literal_text(name), linewidth=1.3, **style)
        hourly = shown.groupby(_times(shown).hour).mean()
        right.plot(hourly.index + 0.5, hourly, linewidth=1.6, **style)
    for axes in (left, right):
        axes.set_ylabel(quantity.label)
        style_axes(axes)
    left.set_title("weekly means" if by_week else "every step", fontsize=10, loc="left")
    format_time_axis(left)
    right.set_title("mean of each hour of the day", fontsize=10, loc="left")
    right.set_xticks(range(0, 25, 6), [f"{h:02d}:00" for h in range(0, 25, 6)])
    right.set_xlim(0, 24)
    right.set_xlabel("local standard time")
    figure.legend(loc="outside right upper", frameon=False)
    add_title(figure, title)
    return figure


def carbon_variation(series: Mapping[str, pd.Series], title: str = "") -> Figure:
    """Draw the mean carbon intensity of each site against its variation within the day.

    The variation is the coefficient of variation of one day's values (standard deviation divided
    by mean), averaged over the days. Shifting work in time saves more at sites further to the
    right; saving any kWh matters more at sites further up.

    Args:
        series: carbon intensity of each site by time, one day or longer, keyed by the site's name.
        title: text above the figure, such as the source of the data.

    Raises:
        SdcError: matplotlib is missing, a series has fewer than two values, or the mean of a day
            is not positive.
    """
    check_series(series)
    figure = new_figure(7.6, 5.2)
    axes = figure.subplots()
    for index, (name, values) in enumerate(series.items()):
        mean, variation = mean_and_variation(name, values)
        axes.plot(100.0 * variation, mean, "o", color=line_style(index)["color"], markersize=9)
        axes.annotate(literal_text(name), (100.0 * variation, mean), xytext=(8, 4),
                      textcoords="offset points")  # fmt: skip
    axes.margins(0.12)
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("variation within the day: standard deviation over mean, mean of the days (%)")
    axes.set_ylabel("mean carbon intensity (g CO₂e/kWh)")
    remove_frame(axes)
    add_title(figure, title)
    return figure


def mean_and_variation(name: str, values: pd.Series) -> tuple[float, float]:
    """Return the mean of a series and its coefficient of variation within a day.

    The coefficient of variation (standard deviation divided by mean) is averaged over the days.

    Raises:
        SdcError: the mean of a day is not positive.
    """
    days = daily(values)
    mean, deviation = days.mean().to_numpy(), days.std(ddof=0).to_numpy()
    if not np.all(mean > 0.0):
        raise SdcError(f"series {name!r}: a day with a mean of {mean.min():g}; valid is above 0")
    return float(values.mean()), float((deviation / mean).mean())


def daily(values: pd.Series) -> SeriesGroupBy[Any, Any]:
    """Return the values of a series grouped by calendar day."""
    return values.groupby(_times(values).normalize())


def check_series(series: Mapping[str, pd.Series]) -> None:
    """Check that there is at least one series, and that each has two values or more.

    Raises:
        SdcError: there is no series, or a series is too short.
    """
    if not series:
        raise SdcError("no series; valid is one or more")
    for name, values in series.items():
        if len(values) < 2:
            raise SdcError(f"series {name!r}: {len(values)} values; valid are two or more")


def _times(values: pd.Series) -> pd.DatetimeIndex:
    """Return the index of a series as pandas times."""
    import pandas as pd

    return pd.DatetimeIndex(values.index)


def days_of(values: pd.Series) -> float:
    """Return the time from the first to the last value of a series, in days."""
    return float((values.index[-1] - values.index[0]).total_seconds() / 86400.0)


def draw_year(series: tuple[Series, ...], title: str) -> Figure:
    """Draw daily mean and range over a year, and the mean day of four months, of each series.

    Args:
        series: series of one or more whole years, of which the first year is drawn.
        title: title of the figure.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(10.0, 1.0 + 1.9 * len(series))
    synthetic = " (synthetic)" * any(s.synthetic for s in series)
    add_title(figure, printable(title) + synthetic)
    axes = figure.subplots(len(series), 2, squeeze=False, width_ratios=(3, 1))
    for (year, day), s in zip(axes, series, strict=True):
        hourly = resample(s, 1)[:HOURS_PER_YEAR].reshape(DAYS_PER_YEAR, 24)
        days = range(DAYS_PER_YEAR)
        year.fill_between(days, hourly.min(axis=1), hourly.max(axis=1), alpha=0.3, lw=0)
        year.plot(days, hourly.mean(axis=1), lw=1)
        year.set(
            xlim=(0, DAYS_PER_YEAR - 1),
            xticks=FIRST_DAY_OF_MONTH[:-1],
            ylabel=f"{s.name}\n{s.unit}",
        )
        year.set_xticklabels("JFMAMJJASOND", ha="left")
        for month, label in ((0, "Jan"), (3, "Apr"), (6, "Jul"), (9, "Oct")):
            first, end = FIRST_DAY_OF_MONTH[month : month + 2]
            mean = hourly[first:end].mean(axis=0)
            day.plot([h + 0.5 for h in range(24)], mean, label=label)
        day.set(xlim=(0, 24), xticks=(0, 6, 12, 18, 24))
    axes[0, 0].set_title("Daily mean and range")
    axes[0, 1].set_title("Mean day")
    axes[0, 1].legend(fontsize="small")
    return figure
