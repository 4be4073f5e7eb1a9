"""Picture of a site or a workload trace over the year."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sdc_taichi.errors import printable
from sdc_taichi.exogenous.series import Series, resample
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, FIRST_DAY_OF_MONTH, HOURS_PER_YEAR

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_year(series: tuple[Series, ...], title: str) -> Figure:
    """Daily mean and range over the year, and the mean day of four months, for each series.

    Args:
        series: whole years; the first year is drawn.
        title: title of the figure.

    Raises:
        ImportError: matplotlib is missing.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 1.0 + 1.9 * len(series)), dpi=120, layout="constrained")
    written = printable(title).replace("$", r"\$")
    figure.suptitle(f"{written} (synthetic)" if any(s.synthetic for s in series) else written)
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
