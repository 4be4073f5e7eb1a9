"""A week of July in New York: what hall and plant of preset hall_of_2026 do, as pictures.

    python examples/plot_hall.py FOLDER

writes FOLDER/hall.png, FOLDER/week.png and FOLDER/overview.png, the picture of the README. Flexible
work waits and the battery feeds the hall while the grid is dirtier than its mean over the day.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from sdc_taichi import Actions, Fleet, SdcError, Simulator, StepResult, load_config
from sdc_taichi.viz.figures import (
    check_result,
    clock_text,
    draw_hall,
    hall_map,
    overview,
    step_time,
)
from sdc_taichi.viz.plotting import check_steps, format_time_axis, new_figure
from sdc_taichi.viz.step_panels import COLUMNS, draw_carbon, draw_power, draw_storage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DAY = 96
STEPS = 7 * DAY
DRAIN_SHARE = 0.1
BATTERY_SHARE = 0.1


def run(sim: Simulator) -> list[StepResult]:
    """Simulate a week with a rule on the carbon intensity of each day."""
    sim.reset()
    days = np.reshape([sim.drivers.at(step).ci_g_per_kwh for step in range(STEPS)], (-1, DAY))
    cleaner = (days.mean(axis=1, keepdims=True) - days) / days.std(axis=1, keepdims=True)
    results = []
    for command in np.clip(cleaner.ravel(), -1.0, 1.0):
        # A full command would empty the queue, or fill the battery, within a step or two.
        load = command if command < 0.0 else DRAIN_SHARE * command
        results.append(sim.step(Actions(load=load, battery=BATTERY_SHARE * command)))
    return results


def readme_picture(result: StepResult, fleet: Fleet, steps: pd.DataFrame, dc: int = 0) -> Figure:
    """The hall at one step beside power and carbon of the run, 1600 x 700 pixels at 100 dpi.

    Args:
        result: one step of the run; it is marked in the series.
        fleet: the fleet it belongs to.
        steps: the run of that data center, as for ``overview``.
        dc: index of the data center.

    Raises:
        SdcError: as ``hall_map`` and ``overview``, or a step that the run does not have.
    """
    figure = new_figure(16.0, 7.0)
    check_result(result, fleet, dc)
    check_steps(steps, COLUMNS)
    when = step_time(result, fleet, dc)
    if when not in steps["time"].to_numpy():
        raise SdcError(f"step {result.step} at {when}: the run has no such time")
    left, right = figure.subfigures(1, 2, width_ratios=[4, 5], squeeze=False)[0]
    for quantity, axes in zip(("inlet", "outlet"), left.subplots(2, 1), strict=True):
        draw_hall(axes, quantity, result, fleet, dc)
    left.suptitle(f"Racks on {clock_text(result, fleet, dc)}", fontsize=13)
    right.suptitle("Power, carbon, queue and battery", fontsize=13)
    all_axes = right.subplots(3, 1, sharex=True, height_ratios=[4, 3, 3])
    for axes, draw in zip(all_axes, (draw_power, draw_carbon, draw_storage), strict=True):
        draw(axes, steps)
        axes.axvline(when, color="black", linewidth=1, linestyle=":")
    format_time_axis(all_axes[-1])
    return figure


def main(folder: Path) -> None:
    """Write the pictures."""
    config = load_config("hall_of_2026", ["site.location=NY", "site.start=07-01"])
    with Simulator(config) as sim:
        results = run(sim)
        fleet = sim.fleet
    times = pd.date_range("2001-07-01", periods=STEPS, freq="15min")
    steps = pd.DataFrame(
        {"time": times, **{k: [r.per_dc()[k][0] for r in results] for k in results[0].per_dc()}}
    )
    hottest = max(results, key=lambda r: float(r.rack_outlet_c.max()))
    folder.mkdir(parents=True, exist_ok=True)
    hall_map(hottest, fleet).savefig(folder / "hall.png")
    overview(steps).savefig(folder / "week.png")
    readme_picture(hottest, fleet, steps).savefig(folder / "overview.png")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/plot_hall.py FOLDER")
    main(Path(sys.argv[1]))
