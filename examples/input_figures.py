"""Pictures of what drives data centers: workload, temperature and carbon intensity of a year.

They show what figures 10 to 14 of the SustainDC paper show of its data. Every function takes named
pandas series of values by local standard time, as ``trace_series`` and ``site_series`` give.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd
from matplotlib.figure import Figure

from sdc_taichi import SdcError
from sdc_taichi.exogenous.registry import load_site, load_trace
from sdc_taichi.exogenous.series import Series
from sdc_taichi.exogenous.year_clock import FIRST_YEAR, MINUTES_PER_YEAR
from sdc_taichi.viz.data_figures import DAILY_FROM_DAYS, Quantity, check_series, daily, days_of
from sdc_taichi.viz.plotting import (
    add_title,
    format_time_axis,
    line_style,
    literal_text,
    new_figure,
    style_axes,
    style_axes_with_legend,
)


def site_series(names: Sequence[str], field: str, seed: int = 10) -> dict[str, pd.Series]:
    """A series of each of several sites, embedded or imported.

    Args:
        names: names of the sites.
        field: ``outdoor_c``, ``wet_bulb_c`` or ``ci_g_per_kwh``.
        seed: seed of synthetic years.

    Raises:
        DataError: an unknown site, or a file that is damaged.
    """
    sites = [load_site(name, seed=seed) for name in names]
    return {site.name: as_pandas(getattr(site, field)) for site in sites}


def trace_series(names: Sequence[str], seed: int = 10) -> dict[str, pd.Series]:
    """Workload traces, embedded or imported, as shares of the capacity.

    Args:
        names: names of the traces.
        seed: seed of synthetic years.

    Raises:
        DataError: an unknown trace, or a file that is damaged.
    """
    return {name: as_pandas(load_trace(name, seed=seed)) for name in names}


def as_pandas(series: Series) -> pd.Series:
    """Values of the first year of a series by time."""
    count = min(series.values.size, round(MINUTES_PER_YEAR / series.minutes))
    begin = pd.Timestamp(year=FIRST_YEAR, month=1, day=1)
    times = pd.date_range(begin, periods=count, freq=pd.Timedelta(minutes=series.minutes))
    return pd.Series(series.values[:count], index=times)


def year_panels(series: Mapping[str, pd.Series], quantity: Quantity, title: str = "") -> Figure:
    """One panel per site or trace: mean and range of each day of the year.

    Series shorter than two months are drawn as they are.

    Args:
        series: name to values by time.
        quantity: what they are.
        title: written above, such as where the data come from.

    Raises:
        SdcError: matplotlib is missing, or a series has fewer than two values.
    """
    check_series(series)
    columns = min(len(series), 4)
    rows = -(-len(series) // columns)
    figure = new_figure(max(3.4 * columns, 7.0), 0.5 + 2.5 * rows)
    grid = figure.subplots(rows, columns, sharex=_same_times(series), sharey=True, squeeze=False)
    for axes in grid.ravel()[len(series) :]:
        axes.set_visible(False)
    for index, (axes, (name, values)) in enumerate(zip(grid.ravel(), series.items(), strict=False)):
        shown = quantity.factor * values
        if days_of(values) >= DAILY_FROM_DAYS:
            days = daily(shown)
            low, high = days.min(), days.max()
            axes.fill_between(low.index, low, high, color=quantity.colour, alpha=0.2, linewidth=0)
            shown = days.mean()
        axes.plot(shown.index, shown, color=quantity.colour, linewidth=0.9)
        axes.set_title(literal_text(name), fontsize=10, loc="left")
        style_axes(axes)
        format_time_axis(axes)
        axes.set_xlabel("")
        axes.label_outer()
        if index % columns == 0:
            axes.set_ylabel(quantity.label.replace(" (", "\n("))
    by_day = max(map(days_of, series.values())) >= DAILY_FROM_DAYS
    note = "; lines are daily means, bands the range of each day" if by_day else ""
    figure.supxlabel(f"local standard time{note}", fontsize=9)
    add_title(figure, title)
    return figure


def first_week(series: Mapping[str, pd.Series], quantity: Quantity, title: str = "") -> Figure:
    """Sites or traces over the first week that all of them have.

    Args:
        series: name to values by time.
        quantity: what they are.
        title: written above, such as where the data come from.

    Raises:
        SdcError: matplotlib is missing, a series has fewer than two values, or they share no time.
    """
    check_series(series)
    begin = max(values.index[0] for values in series.values())
    end = begin + pd.Timedelta(days=7)
    figure = new_figure(12.0, 3.8)
    axes = figure.subplots()
    for index, (name, values) in enumerate(series.items()):
        shown = quantity.factor * values[(values.index >= begin) & (values.index < end)]
        if shown.empty:
            raise SdcError(f"series {name!r} ends before {begin}, where another begins")
        axes.plot(shown.index, shown, label=literal_text(name), linewidth=1.4, **line_style(index))
    axes.set_ylabel(quantity.label)
    style_axes_with_legend(axes)
    format_time_axis(axes)
    add_title(figure, title)
    return figure


def _same_times(series: Mapping[str, pd.Series]) -> bool:
    """Whether all series begin and end at the same times."""
    spans = {(values.index[0], values.index[-1]) for values in series.values()}
    return len(spans) == 1
