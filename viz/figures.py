"""Pictures of results: rack temperatures of a hall at one step, and a run over time.

``hall_map`` and ``overview`` return a ``matplotlib.figure.Figure``, which ``figure.savefig(path)``
writes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.exogenous.year_clock import day_of_year, step_times
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import Reals, StepResult

from .plotting import (
    MAX_LABELLED_RACKS,
    add_title,
    check_steps,
    colour_range,
    draw_rack_grid,
    format_time_axis,
    new_figure,
    outline_hottest,
    short_name,
)
from .step_panels import COLUMNS, draw_carbon, draw_power, draw_storage, draw_temperatures

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def hall_map(result: StepResult, fleet: Fleet, dc: int = 0) -> Figure:
    """Inlet and outlet temperature of every rack of one hall, hottest racks outlined.

    Args:
        result: one step.
        fleet: the fleet it belongs to.
        dc: index of the data center.

    Raises:
        SdcError: matplotlib is missing, or result, fleet and index do not fit together.
    """
    figure = new_figure(9.6, 4.2)
    check_result(result, fleet, dc)
    for quantity, axes in zip(("inlet", "outlet"), figure.subplots(1, 2), strict=True):
        draw_hall(axes, quantity, result, fleet, dc)
    add_title(figure, f"{short_name(fleet.names[dc])}: {clock_text(result, fleet, dc)}")
    return figure


def step_at(results: Iterable[StepResult], fleet: Fleet, when: str, dc: int = 0) -> StepResult:
    """The first of some steps that covers a time of the data center's clock.

    Args:
        results: steps in order, such as a list or what a loop yields; read up to the one found.
        fleet: the fleet they belong to.
        when: ``MM-DD HH:MM``, local standard time.
        dc: index of the data center.

    Raises:
        SdcError: the text is no such time, or no step covers it.
    """
    if re.fullmatch(r"\d\d-\d\d \d\d:\d\d", when) is None:
        raise SdcError(f"time {when!r}: valid is MM-DD HH:MM, for example 07-01 15:00")
    found: list[str] = []
    for result in results:
        begin = step_time(result, fleet, dc).astype(datetime)
        found = [*found[:1], f"{begin:%m-%d %H:%M}"]
        minutes = (int(when[6:8]) - begin.hour) * 60 + int(when[9:]) - begin.minute
        if when[:5] == f"{begin:%m-%d}" and 0 <= minutes < 60 * result.step_h:
            return result
    span = f"the steps are those from {found[0]} to {found[-1]}" if found else "there are no steps"
    raise SdcError(f"time {when!r}: no step covers it; {span}")


def overview(steps: pd.DataFrame) -> Figure:
    """A run of one data center: weather, power by device, carbon, queue and battery.

    Args:
        steps: one row per step with ``time`` and the columns of ``StepResult.per_dc``.

    Raises:
        SdcError: matplotlib is missing, a column is missing, fewer than two rows, or times that do
            not increase.
    """
    figure = new_figure(12.0, 9.0)
    check_steps(steps, COLUMNS)
    draws = (draw_temperatures, draw_power, draw_carbon, draw_storage)
    all_axes = figure.subplots(4, 1, sharex=True, height_ratios=[3, 4, 3, 3])
    for axes, draw in zip(all_axes, draws, strict=True):
        draw(axes, steps)
    format_time_axis(all_axes[-1])
    return figure


def step_time(result: StepResult, fleet: Fleet, dc: int) -> np.datetime64:
    """Time at which a step begins on the clock of a data center, as in steps.parquet."""
    day = day_of_year(fleet.configs[dc].site.start)
    start = np.array([day * 24 * fleet.steps_per_hour])
    found = step_times(start, np.array([result.step]), fleet.steps_per_hour)
    return np.datetime64(found[0, 0], "s")


def check_result(result: StepResult, fleet: Fleet, dc: int) -> None:
    """Refuse a result that is none of the fleet, or an index that the fleet does not have."""
    if not 0 <= dc < fleet.size:
        raise SdcError(f"data center {dc}: valid is 0..{fleet.size - 1}")
    if len(result.rack_inlet_c) != fleet.racks:
        raise SdcError(
            f"result of {len(result.rack_inlet_c)} racks, expected {fleet.racks} as in the fleet"
        )


def clock_text(result: StepResult, fleet: Fleet, dc: int) -> str:
    """Day and time of day at which a step begins."""
    when: datetime = step_time(result, fleet, dc).astype(datetime)
    return f"{when.day} {when:%B %H:%M}"


def draw_hall(axes: Axes, quantity: str, result: StepResult, fleet: Fleet, dc: int) -> None:
    """Draw inlet or outlet of the racks of a hall, with numbers in a small one."""
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
