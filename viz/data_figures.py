"""Pictures of what drives data centers: workload, temperature and carbon intensity.

They show what figures 10 to 16 of the SustainDC paper show of its data: workload traces, outdoor
temperature and carbon intensity of the sites over a year, and how far the intensity of a grid
varies within the day against its mean. Every function takes named pandas series of values by local
standard time, as ``trace_series`` and ``site_series`` give for the embedded and imported years, and
a column of steps.parquet for a run.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.exogenous.registry import load_site, load_trace
from sdc_taichi.exogenous.series import Series
from sdc_taichi.year_clock import FIRST_YEAR, MINUTES_PER_YEAR

from .figures import BLUE, RED, clean, finish, format_time, new_figure, plain, set_title
from .fleet_figures import line_style

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from pandas.api.typing import SeriesGroupBy

_DAILY_FROM_DAYS = 60
"""Runs from this length on are shown by the day, shorter ones by the hour."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """What a series is of."""

    label: str
    """With its unit."""
    colour: str
    factor: float = 1.0


TEMPERATURE = Quantity("outdoor temperature (°C)", RED)
CARBON = Quantity("carbon intensity (g CO₂e/kWh)", "black")
WORKLOAD = Quantity("workload (% of capacity)", BLUE, 100.0)


def site_series(names: Sequence[str], field: str, seed: int = 10) -> dict[str, pd.Series]:
    """One series of several sites, embedded or imported.

    Args:
        names: of the sites.
        field: ``outdoor_c``, ``wet_bulb_c`` or ``ci_g_per_kwh``.
        seed: of synthetic years.

    Raises:
        DataError: an unknown site, or a file that is damaged.
    """
    sites = [load_site(name, seed=seed) for name in names]
    return {site.name: as_pandas(getattr(site, field)) for site in sites}


def trace_series(names: Sequence[str], seed: int = 10) -> dict[str, pd.Series]:
    """Several workload traces, embedded or imported, as shares of the capacity.

    Raises:
        DataError: an unknown trace, or a file that is damaged.
    """
    return {name: as_pandas(load_trace(name, seed=seed)) for name in names}


def as_pandas(series: Series) -> pd.Series:
    """Values of the first year by time."""
    import pandas as pd

    count = min(series.values.size, round(MINUTES_PER_YEAR / series.minutes))
    begin = pd.Timestamp(year=FIRST_YEAR, month=1, day=1)
    times = pd.date_range(begin, periods=count, freq=pd.Timedelta(minutes=series.minutes))
    return pd.Series(series.values[:count], index=times)


def panels(series: Mapping[str, pd.Series], quantity: Quantity, title: str = "") -> Figure:
    """One panel per site or trace: mean and range of each day of the year.

    Series shorter than two months are drawn as they are.

    Args:
        series: name to values by time.
        quantity: what they are.
        title: written above, such as where the data come from.

    Raises:
        SdcError: matplotlib is missing, or a series has fewer than two values.
    """
    _check(series)
    columns = min(len(series), 4)
    rows = -(-len(series) // columns)
    figure = new_figure(max(3.4 * columns, 7.0), 0.5 + 2.5 * rows)
    grid = figure.subplots(rows, columns, sharex=_same_times(series), sharey=True, squeeze=False)
    for axes in grid.ravel()[len(series) :]:
        axes.set_visible(False)
    for index, (axes, (name, values)) in enumerate(zip(grid.ravel(), series.items(), strict=False)):
        shown = quantity.factor * values
        if _days(values) >= _DAILY_FROM_DAYS:
            days = daily(shown)
            low, high = days.min(), days.max()
            axes.fill_between(low.index, low, high, color=quantity.colour, alpha=0.2, linewidth=0)
            shown = days.mean()
        axes.plot(shown.index, shown, color=quantity.colour, linewidth=0.9)
        axes.set_title(plain(name), fontsize=10, loc="left")
        clean(axes)
        format_time(axes)
        axes.set_xlabel("")
        axes.label_outer()
        if index % columns == 0:
            axes.set_ylabel(quantity.label.replace(" (", "\n("))
    figure.supxlabel("local standard time; lines are daily means, bands the range of each day"
                     if _longest_days(series) >= _DAILY_FROM_DAYS else "local standard time",
                     fontsize=9)  # fmt: skip
    set_title(figure, title)
    return figure


def comparison(series: Mapping[str, pd.Series], quantity: Quantity, title: str = "") -> Figure:
    """Sites or traces in one picture: over the year by week, and over the hours of the mean day.

    Args:
        series: name to values by time.
        quantity: what they are.
        title: written above, such as where the data come from.

    Raises:
        SdcError: matplotlib is missing, or a series has fewer than two values.
    """
    _check(series)
    figure = new_figure(12.0, 4.4)
    left, right = figure.subplots(1, 2, width_ratios=[3, 2], sharey=False)
    by_week = _longest_days(series) >= _DAILY_FROM_DAYS
    for index, (name, values) in enumerate(series.items()):
        style = line_style(index)
        shown = quantity.factor * values
        over, times = shown, _times(shown)
        if by_week:
            weeks = shown.resample("7D")
            over = weeks.mean()
            # At its middle; the last one is not whole.
            times = _times(over) + weeks.count().to_numpy() * (times[1] - times[0]) / 2
        left.plot(times, over, label=plain(name), linewidth=1.3, **style)
        hourly = shown.groupby(_times(shown).hour).mean()
        right.plot(hourly.index + 0.5, hourly, linewidth=1.6, **style)
    for axes in (left, right):
        axes.set_ylabel(quantity.label)
        clean(axes)
    left.set_title("weekly means" if by_week else "every step", fontsize=10, loc="left")
    format_time(left)
    right.set_title("mean of each hour of the day", fontsize=10, loc="left")
    right.set_xticks(range(0, 25, 6), [f"{h:02d}:00" for h in range(0, 25, 6)])
    right.set_xlim(0, 24)
    right.set_xlabel("local standard time")
    figure.legend(loc="outside right upper", frameon=False)
    set_title(figure, title)
    return figure


def week(series: Mapping[str, pd.Series], quantity: Quantity, title: str = "") -> Figure:
    """Sites or traces over the first week that all of them have.

    Args:
        series: name to values by time.
        quantity: what they are.
        title: written above, such as where the data come from.

    Raises:
        SdcError: matplotlib is missing, a series has fewer than two values, or they share no time.
    """
    import pandas as pd

    _check(series)
    begin = max(values.index[0] for values in series.values())
    end = begin + pd.Timedelta(days=7)
    figure = new_figure(12.0, 3.8)
    axes = figure.subplots()
    for index, (name, values) in enumerate(series.items()):
        shown = quantity.factor * values[(values.index >= begin) & (values.index < end)]
        if shown.empty:
            raise SdcError(f"series {name!r} ends before {begin}, where another begins")
        axes.plot(shown.index, shown, label=plain(name), linewidth=1.4, **line_style(index))
    axes.set_ylabel(quantity.label)
    finish(axes)
    format_time(axes)
    set_title(figure, title)
    return figure


def carbon_variation(series: Mapping[str, pd.Series], title: str = "") -> Figure:
    """Mean carbon intensity of each site against how far it varies within the day.

    The variation is the coefficient of variation of a day's values, standard deviation over mean,
    averaged over the days. To the right, time of use matters more; above, every kWh does.

    Args:
        series: name to carbon intensity by time, of a day or more.
        title: written above, such as where the data come from.

    Raises:
        SdcError: matplotlib is missing, or a series has fewer than two values or a mean of zero.
    """
    _check(series)
    figure = new_figure(7.6, 5.2)
    axes = figure.subplots()
    for index, (name, values) in enumerate(series.items()):
        mean, variation = mean_and_variation(name, values)
        axes.plot(100.0 * variation, mean, "o", color=line_style(index)["color"], markersize=9)
        axes.annotate(plain(name), (100.0 * variation, mean), xytext=(8, 4),
                      textcoords="offset points")  # fmt: skip
    axes.margins(0.12)
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("variation within the day: standard deviation over mean, mean of the days (%)")
    axes.set_ylabel("mean carbon intensity (g CO₂e/kWh)")
    axes.spines[:].set_visible(False)
    axes.grid(alpha=0.25)
    set_title(figure, title)
    return figure


def mean_and_variation(name: str, values: pd.Series) -> tuple[float, float]:
    """Mean, and standard deviation over mean of each day averaged over the days.

    Raises:
        SdcError: a day with a mean that is not positive.
    """
    days = daily(values)
    mean, deviation = days.mean().to_numpy(), days.std(ddof=0).to_numpy()
    if not np.all(mean > 0.0):
        raise SdcError(f"series {name!r}: a day with a mean of {mean.min():g}; valid is above 0")
    return float(values.mean()), float((deviation / mean).mean())


def daily(values: pd.Series) -> SeriesGroupBy[Any, Any]:
    """Values by the days that they have; 29 February is none."""
    return values.groupby(_times(values).normalize())


def _check(series: Mapping[str, pd.Series]) -> None:
    if not series:
        raise SdcError("no series; valid is one or more")
    for name, values in series.items():
        if len(values) < 2:
            raise SdcError(f"series {name!r}: {len(values)} values; valid are two or more")


def _times(values: pd.Series) -> pd.DatetimeIndex:
    import pandas as pd

    return pd.DatetimeIndex(values.index)


def _days(values: pd.Series) -> float:
    return float((values.index[-1] - values.index[0]).total_seconds() / 86400.0)


def _longest_days(series: Mapping[str, pd.Series]) -> float:
    return max(_days(values) for values in series.values())


def _same_times(series: Mapping[str, pd.Series]) -> bool:
    spans = {(values.index[0], values.index[-1]) for values in series.values()}
    return len(spans) == 1
