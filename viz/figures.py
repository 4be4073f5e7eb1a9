"""Pictures of a hall in one step, of a run over time, and of one day under several controllers.

Public functions return a ``matplotlib.figure.Figure``; ``figure.savefig(path)`` writes it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.exogenous.year_clock import TYPICAL_YEAR, day_of_year, step_times
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, Reals, StepResult

from .plotting import (
    BLUE,
    GREEN,
    GREY,
    LINE_COLOURS,
    MAX_LABELLED_RACKS,
    ORANGE,
    PINK,
    RED,
    SKY,
    add_title,
    check_steps,
    colour_range,
    draw_rack_grid,
    draw_steps,
    format_day_axis,
    format_time_axis,
    is_over_a_year,
    literal_text,
    new_figure,
    outline_hottest,
    repeat_last,
    rows_of_day,
    short_name,
    step_edges,
    step_hours,
    style_axes,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def hall_map(result: StepResult, fleet: Fleet, dc: int = 0) -> Figure:
    """Draw inlet and outlet temperature of every rack of one hall, hottest racks outlined.

    Args:
        result: result of one step of the fleet.
        fleet: the fleet.
        dc: index of the data center.

    Raises:
        SdcError: matplotlib is missing, the result is of another fleet, or the index is invalid.
    """
    figure = new_figure(9.6, 4.2)
    check_result(result, fleet, dc)
    for quantity, axes in zip(("inlet", "outlet"), figure.subplots(1, 2), strict=True):
        draw_hall(axes, quantity, result, fleet, dc)
    add_title(figure, f"{short_name(fleet.names[dc])}: {clock_text(result, fleet, dc)}")
    return figure


def step_at(results: Iterable[StepResult], fleet: Fleet, when: str, dc: int = 0) -> StepResult:
    """Return the first step that covers a time of day on the clock of a data center.

    Args:
        results: results of steps in order, as a list or a generator. A generator is read up to
            the step that covers the time.
        fleet: the fleet of the results.
        when: ``MM-DD HH:MM``, local standard time.
        dc: index of the data center.

    Raises:
        SdcError: the time has another format, or no step covers it.
    """
    if re.fullmatch(r"\d\d-\d\d \d\d:\d\d", when) is None:
        raise SdcError(f"time {when!r}: valid is MM-DD HH:MM, for example 07-01 15:00")
    begins: list[str] = []
    for result in results:
        begin = step_time(result, fleet, dc).astype(datetime)
        begins = [*begins[:1], f"{begin:%m-%d %H:%M}"]
        minutes = (int(when[6:8]) - begin.hour) * 60 + int(when[9:]) - begin.minute
        if when[:5] == f"{begin:%m-%d}" and 0 <= minutes < 60 * result.step_h:
            return result
    if not begins:
        raise SdcError(f"time {when!r}: no step covers it; there are no steps")
    raise SdcError(
        f"time {when!r}: no step covers it; the steps are those from {begins[0]} to {begins[-1]}"
    )


def overview(steps: pd.DataFrame) -> Figure:
    """Draw a run of one data center: weather, power by device, carbon, task queue and battery.

    Args:
        steps: one row per step with ``time`` and the columns of ``StepResult.per_dc``.

    Raises:
        SdcError: matplotlib or a column is missing, there are fewer than two rows, or the times do
            not increase.
    """
    figure = new_figure(12.0, 9.0)
    steps = check_steps(steps, PANEL_COLUMNS)
    draws = (draw_temperatures, draw_power, draw_carbon, draw_storage)
    all_axes = figure.subplots(4, 1, sharex=True, height_ratios=[3, 4, 3, 3])
    for axes, draw in zip(all_axes, draws, strict=True):
        draw(axes, steps)
    format_time_axis(all_axes[-1])
    return figure


def step_time(result: StepResult, fleet: Fleet, dc: int) -> np.datetime64:
    """Return the time at which a step begins, on the clock of a data center.

    The time is local standard time in the year of the config, or else ``TYPICAL_YEAR``.
    """
    site = fleet.configs[dc].site
    start = np.array([day_of_year(site.start) * 24 * fleet.steps_per_hour])
    year = np.array([TYPICAL_YEAR if site.year is None else site.year])
    times = step_times(start, np.array([result.step]), fleet.steps_per_hour, year)
    return np.datetime64(times[0, 0], "s")


def check_result(result: StepResult, fleet: Fleet, dc: int) -> None:
    """Check that a result has the racks of a fleet, and that ``dc`` is an index of the fleet."""
    if not 0 <= dc < fleet.size:
        raise SdcError(f"data center {dc}: valid is 0..{fleet.size - 1}")
    if len(result.rack_inlet_c) != fleet.racks:
        raise SdcError(
            f"result of {len(result.rack_inlet_c)} racks, expected {fleet.racks} as in the fleet"
        )


def clock_text(result: StepResult, fleet: Fleet, dc: int) -> str:
    """Return day and time of day at which a step begins, such as ``1 July 15:00``."""
    when: datetime = step_time(result, fleet, dc).astype(datetime)
    return f"{when.day} {when:%B %H:%M}"


def draw_hall(axes: Axes, quantity: str, result: StepResult, fleet: Fleet, dc: int) -> None:
    """Draw the inlet or outlet temperatures of racks of a hall, also as numbers in small halls."""
    from matplotlib.ticker import MaxNLocator

    hall = fleet.configs[dc].hall
    temperatures: Reals = result.rack_inlet_c if quantity == "inlet" else result.rack_outlet_c
    grid = np.asarray(temperatures[slice(*fleet.rack_offsets[dc : dc + 2])], dtype=np.float64)
    grid = grid.reshape(hall.rows, hall.racks_per_row)
    low, high = colour_range(grid)
    image = draw_rack_grid(axes, grid, "inferno", (low, high))
    if grid.size <= MAX_LABELLED_RACKS:
        for (row, rack), value in np.ndenumerate(grid):
            ink = "black" if value > (low + high) / 2 else "white"
            axes.text(rack + 0.5, row + 0.5, f"{value:.1f}", color=ink, ha="center", va="center")
    place = outline_hottest(axes, grid)
    title = f"Rack {quantity}: hottest {grid.max():.1f} °C, {place}"
    axes.set_title(title, fontsize=10, loc="left")
    ticks = MaxNLocator(6, steps=[1, 2, 5, 10])
    axes.figure.colorbar(image, ax=axes, label=f"{quantity} (°C)", ticks=ticks)


POWERS = {
    "it_w": ("IT", BLUE),
    "chiller_w": ("chiller", ORANGE),
    "tower_fan_w": ("tower fan", SKY),
    "chilled_pump_w": ("chilled-water pump", GREEN),
    "condenser_pump_w": ("condenser pump", PINK),
    "crac_fan_w": ("CRAC fan", RED),
}
"""Powers of devices that ``draw_power`` stacks: name and colour, keyed by column."""

PANEL_COLUMNS = (
    "time",
    "outdoor_c",
    "wet_bulb_c",
    "setpoint_c",
    *POWERS,
    "overhead_w",
    "ci_g_per_kwh",
    "carbon_g",
    "queue_tasks",
    "soc",
)
"""Columns of steps.parquet that the panels of ``overview`` and of a day read."""


def draw_temperatures(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw outdoor temperature, wet-bulb temperature and supply setpoint, in C."""
    for name, colour, label in (
        ("outdoor_c", RED, "outdoor"),
        ("wet_bulb_c", SKY, "wet bulb"),
        ("setpoint_c", "black", "setpoint"),
    ):
        draw_steps(axes, steps, steps[name], color=colour, linewidth=1.2, label=label)
    axes.set_ylabel("temperature (°C)")
    style_axes_with_legend(axes)


def draw_power(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw the power of each device, stacked, and of losses that count on top, in kW."""
    powers = [steps[column] / 1e3 for column in POWERS]
    styles = [*POWERS.values()]
    counted = (steps["it_w"] + steps["overhead_w"]) / 1e3
    lost = counted - sum(powers)
    if np.all(lost > 1e-6 * counted):
        powers.append(lost)
        styles.append(("UPS and distribution", GREY))
    axes.stackplot(
        step_edges(steps),
        [repeat_last(power) for power in powers],
        labels=[name for name, _ in styles],
        colors=[colour for _, colour in styles],
        linewidth=0,
        step="post",
    )
    # A preset may exclude devices from the HVAC total; then the total is not the sum of devices.
    if not np.allclose(counted, sum(powers), rtol=1e-6):
        draw_steps(axes, steps, counted, color="black", linewidth=1.2, label="counted in total")
    axes.set_ylabel("power (kW)")
    axes.set_ylim(bottom=0)
    style_axes_with_legend(axes)


def draw_carbon(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw carbon intensity as a line, and emissions as an area behind the line."""
    emitted = axes.twinx()
    kg_per_h = steps["carbon_g"] / 1e3 / step_hours(steps)
    emitted.fill_between(step_edges(steps), repeat_last(kg_per_h), color=GREY, alpha=0.35,
                         linewidth=0, step="post")  # fmt: skip
    emitted.set_ylabel("emitted (kg CO₂e/h)", color=GREY)
    emitted.set_ylim(bottom=0)
    draw_steps(axes, steps, steps["ci_g_per_kwh"], color=RED)
    axes.set_ylabel("carbon intensity\n(g CO₂e/kWh)", color=RED)
    _put_in_front(axes, emitted)


def draw_storage(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw task queue and battery charge, which are values at the end of each step."""
    ends = step_edges(steps)[1:]
    charge = axes.twinx()
    charge.fill_between(ends, 100 * steps["soc"], color=GREEN, alpha=0.3, linewidth=0)
    charge.set_ylabel("battery charge (%)", color=GREEN)
    charge.set_ylim(0, 100)
    axes.plot(ends, steps["queue_tasks"], color=PINK, linewidth=1.4)
    axes.set_ylabel("queue (tasks)", color=PINK)
    axes.set_ylim(0, 1.05 * max(1.0, steps["queue_tasks"].max()))
    _put_in_front(axes, charge)


def _put_in_front(axes: Axes, behind: Axes) -> None:
    """Draw axes in front of the twin axes ``behind``."""
    axes.set_zorder(behind.get_zorder() + 1)
    axes.patch.set_visible(False)
    behind.spines[:].set_visible(False)
    style_axes(axes)


OPTIMUM_COLUMNS = ("time", "ci_g_per_kwh", "price_per_kwh", "utilisation", "setpoint_c", "soc")
"""Columns of steps.parquet that ``optimum_day`` reads."""
IDLE = "idle"
"""Label of the idle controller, whose lines are grey."""


def optimum_day(
    steps_of: Mapping[str, pd.DataFrame], date: str, title: str = "", *, by_price: bool = False
) -> Figure:
    """Draw grid, load, setpoint and battery over one day, under each of several controllers.

    Args:
        steps_of: steps of one data center under each controller, keyed by label.
        date: ``MM-DD`` for the first such day of the run, or ``YYYY-MM-DD`` with the year that
            the column ``time`` has on that day.
        title: text above the figure, such as the name of the data center.
        by_price: True to draw the price of a kWh instead of its carbon intensity.

    Raises:
        SdcError: matplotlib or a column is missing, the runs have different times, or the run
            does not contain the day.
    """
    figure = new_figure(11.0, 9.0)
    steps_of = {label: check_steps(each, OPTIMUM_COLUMNS) for label, each in steps_of.items()}
    first = next(iter(steps_of.values()))
    for label, steps in steps_of.items():
        if not np.array_equal(steps["time"], first["time"]):
            raise SdcError(f"steps of {label}: of other times than the first")
    rows = rows_of_day(first, date)
    panels = figure.subplots(4, 1, sharex=True, height_ratios=[2, 3, 3, 3])
    shown = first.iloc[slice(*rows)]
    check_steps(shown, OPTIMUM_COLUMNS)
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
    format_day_axis(panels[-1], shown, over_a_year=is_over_a_year(first))
    add_title(figure, short_name(title))
    return figure


def day_of_most_saved(saved: F64, times: pd.Series) -> str:
    """Return the day with the largest saving, YYYY-MM-DD; the earliest on a tie."""
    days = times.dt.strftime("%Y-%m-%d").to_numpy()
    names, of_step = np.unique(days, return_inverse=True)
    # Sums are compared after rounding, because equal days may differ by rounding errors.
    sums = np.bincount(of_step, weights=saved)
    steps = np.bincount(of_step)
    # Days that the run covers only in part are excluded unless there are no complete days.
    whole = np.where(steps == steps.max(), sums, -np.inf)
    return str(names[int(np.argmax(np.round(whole, 6)))])


def _draw_controllers(
    panels: list[Axes], steps_of: Mapping[str, pd.DataFrame], rows: tuple[int, int]
) -> None:
    """Draw utilisation, setpoint and battery charge under each controller.

    Args:
        panels: axes of the three quantities.
        steps_of: steps of one data center under each controller, keyed by label.
        rows: first row of the day, and first row after the day.
    """
    colours = iter(LINE_COLOURS * len(steps_of))
    first, after = rows
    for index, (label, steps) in enumerate(steps_of.items()):
        colour = GREY if label == IDLE else next(colours)
        style: dict[str, Any] = {"color": colour, "linewidth": 1.3, "label": literal_text(label)}
        style["zorder"] = 2 + index
        shown = steps.iloc[first:after]
        draw_steps(panels[0], shown, 100.0 * shown["utilisation"], **style)
        draw_steps(panels[1], shown, shown["setpoint_c"], **style)
        # The charge is a value at the end of a step, so the curve begins at midnight with that of
        # the previous day's last step.
        before = steps.iloc[max(first - 1, 0) : after]
        panels[2].plot(step_edges(before)[1:], 100.0 * before["soc"], **style)
