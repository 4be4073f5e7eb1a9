"""Dashboards of a run of one data center, drawn from its rows of steps.parquet.

Every function takes a pandas DataFrame with a column ``time`` and the columns of
``StepResult.per_dc()``, one row per step, and returns a matplotlib ``Figure``. Times are local
standard time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import RECOMMENDED_C, rank
from sdc_taichi.types import F64

from .figures import PANEL_COLUMNS, draw_carbon, draw_power, draw_storage
from .plotting import (
    BLUE,
    DAY,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    add_title,
    check_steps,
    date_text,
    draw_steps,
    format_day_axis,
    format_time_axis,
    is_over_a_year,
    new_figure,
    remove_frame,
    rows_of_day,
    scale_thousands,
    short_name,
    step_edges,
    step_hours,
    style_axes,
    style_axes_with_legend,
    with_local_time,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DAY_COLUMNS = (
    "supply_c",
    "inlet_max_c",
    "load_command",
    "cooling_command",
    "battery_command",
    "throttled_racks",
    "tripped_racks",
    "grid_up",
)
"""Columns of steps.parquet that ``day`` reads in addition to ``PANEL_COLUMNS``."""

CARPETS = (
    ("outdoor_c", 1.0, "outdoor (°C)", "inferno"),
    ("inlet_max_c", 1.0, "hottest inlet (°C)", "inferno"),
    ("it_w", 1e-3, "IT power (kW)", "viridis"),
    ("hvac_w", 1e-3, "HVAC power (kW)", "viridis"),
    ("ci_g_per_kwh", 1.0, "carbon intensity (g CO₂e/kWh)", "cividis"),
    ("carbon_kg_per_h", 1.0, "emitted (kg CO₂e/h)", "cividis"),
)
"""Quantities that ``year`` shows as heat maps by day and hour: column, factor, label, colour map.

Values of the column are multiplied by the factor to get the unit of the label.
"""

ENERGY_COLUMNS = ("it_kwh", "hvac_kwh", "carbon_g")
"""Columns that ``year`` sums by month or day and shows as bars."""
MAX_SCATTER_POINTS = 3_000
"""Largest number of points in a scatter plot; longer runs show a random sample of their steps."""
MAX_DAYS_BY_STEP = 62
"""Largest number of days whose single steps ``year`` draws; longer runs show hourly means."""
MAX_NAMED_BARS = 13
"""Largest number of labelled bars; with more bars, only every second, third, ... has a label."""
EVENT_SHADES = {
    "crac_down": (BLUE, "//"),
    "chiller_derate": (GREEN, "\\\\"),
    "pump_down": (GREEN, "||"),
    "tank_down": (GREEN, ".."),
    "tower_cell_down": (GREEN, "xx"),
    "dry_cooler_down": (GREEN, "++"),
    "outdoor_air_closed": (GREEN, "oo"),
    "rack_fan_failure": (GREY, ".."),
    "cdu_down": (PINK, "//"),
    "cdu_pump_down": (PINK, "||"),
    "facility_pump_down": (PINK, "xx"),
    "cooler_down": (PINK, "++"),
    "leak": (PINK, ".."),
    "heat_wave": ("#B8A800", "--"),
    "link_down": (GREY, "//"),
}
"""Colour and hatching of each kind of event.

Grid outages have no entry, because the column ``grid_up`` of the steps already shows them.
"""


def day(
    steps: pd.DataFrame, date: str, title: str = "", events: Sequence[Mapping[str, Any]] = ()
) -> Figure:
    """Draw one day: temperatures, power by device, carbon, commands, task queue and battery.

    Times are shaded while racks are throttled or tripped, the grid is down or an event lasts.

    Args:
        steps: steps of the data center.
        date: ``MM-DD`` for the first such day of the run, or ``YYYY-MM-DD`` with the year that
            the column ``time`` has on that day.
        title: text above the figure, such as the name of the data center.
        events: events of the data center, as in metrics.json.

    Raises:
        SdcError: matplotlib or a column is missing, or the run does not have the day.
    """
    figure = new_figure(12.0, 12.0)
    check_steps(steps, PANEL_COLUMNS)
    steps = check_steps(steps, ("time", *DAY_COLUMNS))
    first, after = rows_of_day(steps, date)
    shown = steps.iloc[first:after]
    check_steps(shown, PANEL_COLUMNS)
    panels = figure.subplots(5, 1, sharex=True, height_ratios=[4, 4, 3, 2, 3])
    _draw_day_temperatures(panels[0], shown, events)
    draw_power(panels[1], shown)
    draw_carbon(panels[2], shown)
    _draw_commands(panels[3], shown)
    # Queue and charge are values at the end of a step, so the curves begin at midnight with those
    # of the previous day's last step.
    draw_storage(panels[4], steps.iloc[max(first - 1, 0) : after])
    format_day_axis(panels[-1], shown, over_a_year=is_over_a_year(steps))
    add_title(figure, short_name(title))
    return figure


def hottest_day(steps: pd.DataFrame) -> str:
    """Return the day with the hottest rack inlet of the run, YYYY-MM-DD; the earliest on a tie."""
    row = int(rank(steps["inlet_max_c"].to_numpy()).argmax())
    return str(with_local_time(steps)["time"].iloc[row].strftime("%Y-%m-%d"))


def year(steps: pd.DataFrame, title: str = "") -> Figure:
    """Draw a run of two days or more: heat maps by day and hour, and monthly or daily totals.

    Args:
        steps: steps of the data center.
        title: text above the figure, such as the name of the data center.

    Raises:
        SdcError: matplotlib or a column is missing, or the run is shorter than two days.
    """
    figure = new_figure(14.0, 12.5)
    columns = {name for name, *_ in CARPETS} - {"carbon_kg_per_h"}
    steps = check_steps(steps, ("time", *sorted(columns), *ENERGY_COLUMNS))
    step_h = step_hours(steps)
    if len(steps) * step_h < 48.0:
        raise SdcError(
            f"steps: {len(steps) * step_h:g} h; valid are two days or more, figures.overview shows "
            "shorter runs"
        )
    shown = steps.assign(carbon_kg_per_h=steps["carbon_g"] / 1e3 / step_h)
    grid = figure.subplots(4, 2, height_ratios=[3, 3, 3, 3])
    for axes, (name, factor, label, cmap) in zip(grid[:3].ravel(), CARPETS, strict=True):
        _draw_carpet(axes, shown["time"], factor * shown[name].to_numpy(), label, cmap)
    for axes in grid[:2].ravel():
        axes.tick_params(labelbottom=False)
        axes.set_xlabel("")
    _draw_totals(grid[3], steps)
    add_title(figure, short_name(title))
    return figure


def setpoint_scatter(steps: pd.DataFrame, title: str = "") -> Figure:
    """Draw setpoint, relative HVAC power and hottest inlet against weather and load.

    Each point is a step, at its outdoor temperature and IT power. The three panels colour the
    points by the setpoint, by the ratio of HVAC to IT power, and by the hottest inlet.

    Args:
        steps: steps of the data center.
        title: text above the figure, such as the name of the data center.

    Raises:
        SdcError: matplotlib or a column is missing.
    """
    figure = new_figure(14.0, 4.8)
    steps = check_steps(steps, ("time", "outdoor_c", "it_w", "hvac_w", "setpoint_c", "inlet_max_c"))
    shown = steps[(steps["it_w"] > 0).to_numpy()]
    # Points are drawn in a fixed random order, so that no season covers the points of another.
    shown = shown.iloc[np.random.default_rng(0).permutation(len(shown))[:MAX_SCATTER_POINTS]]
    share = 100.0 * shown["hvac_w"] / shown["it_w"]
    for axes, values, label, cmap in zip(
        figure.subplots(1, 3, sharex=True, sharey=True),
        (shown["setpoint_c"], share, shown["inlet_max_c"]),
        ("setpoint (°C)", "HVAC / IT power (%)", "hottest inlet (°C)"),
        ("viridis", "cividis", "inferno"),
        strict=True,
    ):
        marks = axes.scatter(
            shown["outdoor_c"],
            shown["it_w"] / 1e3,
            c=values,
            cmap=cmap,
            s=4.0 if len(shown) > 1500 else 12.0,
            linewidths=0,
        )
        figure.colorbar(marks, ax=axes, label=label, orientation="horizontal", shrink=0.9)
        axes.set_xlabel("outdoor (°C)")
        remove_frame(axes)
        if axes.get_subplotspec().is_first_col():
            axes.set_ylabel("IT power (kW)")
    add_title(figure, short_name(title))
    return figure


def battery_profile(steps: pd.DataFrame, title: str = "") -> Figure:
    """Draw carbon intensity, battery power and battery charge by the hour of the day.

    Lines are means over the days of the run; bands are from the 10th to the 90th percentile.

    Args:
        steps: steps of the data center.
        title: text above the figure, such as the name of the data center.

    Raises:
        SdcError: matplotlib or a column is missing.
    """
    figure = new_figure(9.0, 8.0)
    steps = check_steps(steps, ("time", "ci_g_per_kwh", "charge_kwh", "discharge_kwh", "soc"))
    step_h = step_hours(steps)
    hours = _hour_of_day(steps)
    panels = figure.subplots(3, 1, sharex=True)
    _draw_daily_band(panels[0], steps["ci_g_per_kwh"], hours + step_h / 2, RED)
    panels[0].set_ylabel("carbon intensity\n(g CO₂e/kWh)")
    edges = np.append(np.unique(hours), np.unique(hours)[-1] + step_h)
    for name, sign, colour, label in (
        ("charge_kwh", 1.0, BLUE, "charging"),
        ("discharge_kwh", -1.0, ORANGE, "discharging"),
    ):
        power = sign * (steps[name] / step_h).groupby(hours).mean().to_numpy()
        panels[1].stairs(power, edges, fill=True, color=colour, label=label, alpha=0.85)
    panels[1].axhline(0.0, color="black", linewidth=0.8)
    panels[1].set_ylabel("battery, mean (kW)")
    # ``soc`` is the state of charge at the end of a step.
    _draw_daily_band(panels[2], 100.0 * steps["soc"], hours + step_h, GREEN)
    panels[2].set_ylabel("battery charge (%)")
    panels[2].set_ylim(0, 100)
    for axes in panels:
        style_axes_with_legend(axes)
    panels[-1].set_xticks(range(0, 25, 3), [f"{h:02d}:00" for h in range(0, 25, 3)])
    panels[-1].set_xlim(0, 24)
    panels[-1].set_xlabel("local standard time")
    add_title(figure, short_name(title))
    return figure


def _draw_day_temperatures(
    axes: Axes, steps: pd.DataFrame, events: Sequence[Mapping[str, Any]]
) -> None:
    """Draw the temperatures of a day in C, and shade the times of disturbances."""
    for name, colour, label, width in (
        ("outdoor_c", GREY, "outdoor", 1.4),
        ("wet_bulb_c", SKY, "wet bulb", 1.4),
        ("inlet_max_c", RED, "hottest inlet", 1.4),
        # Supply air and setpoint are mostly equal, so the supply air gets a wider line behind.
        ("supply_c", "#80B8D8", "supply air", 4.0),
        ("setpoint_c", "black", "setpoint", 1.2),
    ):
        draw_steps(axes, steps, steps[name], color=colour, linewidth=width, label=label)
    axes.axhline(RECOMMENDED_C[1], color=RED, linewidth=0.8, linestyle=":")
    edges = step_edges(steps)
    for flag, colour, hatch, label in _disturbances(steps, events):
        change = np.diff(flag.astype(np.int8), prepend=0, append=0)
        spans = zip(np.flatnonzero(change == 1), np.flatnonzero(change == -1), strict=True)
        for count, (first, after) in enumerate(spans):
            axes.axvspan(edges[first], edges[after], facecolor=(colour, 0.25),
                         edgecolor=(colour, 0.5), hatch=hatch, linewidth=0,
                         label="" if count else label)  # fmt: skip
    axes.set_ylabel("temperature (°C)")
    style_axes_with_legend(axes)


def _disturbances(
    steps: pd.DataFrame, events: Sequence[Mapping[str, Any]]
) -> list[tuple[npt.NDArray[np.bool_], str, str, str]]:
    """Return mask over the steps, colour, hatching and label of each kind of disturbance."""
    shades = [
        ((steps["throttled_racks"] > 0).to_numpy(), ORANGE, "", "racks throttled"),
        ((steps["tripped_racks"] > 0).to_numpy(), RED, "", "racks tripped"),
        ((steps["grid_up"] < 1).to_numpy(), PINK, "", "grid down"),
    ]
    masks: dict[str, npt.NDArray[np.bool_]] = {}
    for event in events:
        if event["kind"] != "grid_outage":
            step = steps["step"].to_numpy()
            lasts = (step >= event["start_step"]) & (step < event["end_step"])
            masks[event["kind"]] = masks.get(event["kind"], False) | lasts
    return shades + [
        (mask, *EVENT_SHADES.get(kind, (GREY, "")), kind.replace("_", " "))
        for kind, mask in masks.items()
    ]


def _draw_commands(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw the three commands of a controller, in widths that show lines of equal values."""
    for name, colour, label, width in (
        ("load_command", PINK, "load (− defer, + drain)", 5.0),
        ("cooling_command", SKY, "setpoint (steps)", 2.8),
        ("battery_command", "black", "battery (− discharge, + charge)", 1.2),
    ):
        draw_steps(axes, steps, steps[name], color=colour, linewidth=width, label=label)
    axes.set_ylabel("command")
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, -1.1), max(high, 1.1))
    style_axes_with_legend(axes)


def _draw_carpet(axes: Axes, times: pd.Series, values: F64, label: str, cmap: str) -> None:
    """Draw a heat map with one column per day and one row per time of day.

    Times without a step stay white. Runs of more than ``MAX_DAYS_BY_STEP`` days show means over an
    hour, because steps would be thinner than a pixel of a printed page.

    Args:
        axes: axes to draw in.
        times: times at which the steps begin.
        values: one value per step.
        label: label of the colour bar, with the unit.
        cmap: name of the colour map.
    """
    from matplotlib.dates import date2num
    from matplotlib.ticker import MaxNLocator

    moments = times.to_numpy()
    dates = moments.astype("datetime64[D]")
    interval = moments[1] - moments[0]
    slots = (moments - dates) // interval
    columns = ((dates - dates[0]) / DAY).astype(np.int64)
    shown = np.full((int(DAY // interval), columns[-1] + 1), np.nan)
    shown[slots, columns] = values
    per_hour = len(shown) // 24
    if shown.shape[1] > MAX_DAYS_BY_STEP and per_hour > 1:
        shown = shown.reshape(24, per_hour, -1).mean(axis=1)
    span = [float(date2num(d)) for d in (dates[0], dates[-1] + DAY)]  # type: ignore[no-untyped-call]
    image = axes.imshow(
        np.ma.masked_invalid(shown),
        aspect="auto",
        origin="lower",
        extent=(span[0], span[1], 0.0, 24.0),
        cmap=cmap,
        interpolation="nearest",
    )
    axes.xaxis_date()
    format_time_axis(axes)
    axes.set_yticks(range(0, 25, 6), [f"{h:02d}:00" for h in range(0, 25, 6)])
    axes.set_ylabel("time of day")
    axes.spines[:].set_visible(False)
    figure = axes.figure
    figure.colorbar(image, ax=axes, label=label, ticks=MaxNLocator(5, steps=[1, 2, 5, 10]))


def _draw_totals(both: npt.NDArray[np.object_], steps: pd.DataFrame) -> None:
    """Draw energy and carbon per month, or per day if the run is shorter than 62 days.

    Args:
        both: the two axes, for energy and for carbon.
        steps: steps of the data center.
    """
    import pandas as pd

    times = steps["time"]
    months = (times.iloc[-1] - times.iloc[0]).days >= 62
    period = pd.PeriodIndex(times, freq="M" if months else "D")
    sums = steps[list(ENERGY_COLUMNS)].groupby(period).sum()
    names = [each.strftime("%b" if months else "%d") for each in pd.PeriodIndex(sums.index)]
    places = np.arange(len(sums))
    per = "month" if months else "day"
    energy, carbon = both
    tops, unit = scale_thousands(
        sums[["it_kwh", "hvac_kwh"]].to_numpy().cumsum(axis=1), "kWh", "MWh"
    )
    energy.bar(places, tops[:, 0], color=BLUE, label="IT")
    energy.bar(places, tops[:, 1] - tops[:, 0], bottom=tops[:, 0], color=ORANGE, label="HVAC")
    energy.set_ylabel(f"energy ({unit}/{per})")
    style_axes_with_legend(energy)
    emitted, unit = scale_thousands(sums["carbon_g"].to_numpy() / 1e3, "kg", "t")
    carbon.bar(places, emitted, color=GREY)
    carbon.set_ylabel(f"emitted ({unit} CO₂e/{per})")
    style_axes(carbon)
    every = -(-len(sums) // MAX_NAMED_BARS)
    over = is_over_a_year(steps)
    span = " to ".join(date_text(times.iloc[i], over_a_year=over) for i in (0, -1))
    for axes in (energy, carbon):
        axes.set_axisbelow(True)
        axes.set_xticks(places[::every], names[::every])
        axes.set_xlabel(f"{'month' if months else 'day of the month'}, {span}")


def _hour_of_day(steps: pd.DataFrame) -> F64:
    """Return the time of day at which each step begins, in h, one value per step."""
    times = steps["time"].to_numpy()
    since = times - times.astype("datetime64[D]")
    return np.asarray(since / np.timedelta64(1, "h"), dtype=np.float64)


def _draw_daily_band(axes: Axes, values: pd.Series, hours: F64, colour: str) -> None:
    """Draw mean and 10th to 90th percentile over the days, by the hour of the day.

    Args:
        axes: axes to draw in.
        values: one value per step.
        hours: hour of the day at which each value is drawn, one per step.
        colour: colour of line and band.
    """
    groups = values.groupby(hours)
    mean, low, high = groups.mean(), groups.quantile(0.1), groups.quantile(0.9)
    axes.fill_between(
        mean.index, low, high, color=colour, alpha=0.25, linewidth=0, label="80 % of days"
    )
    axes.plot(mean.index, mean, color=colour, linewidth=1.6, label="mean")
