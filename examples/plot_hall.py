"""A week of July in New York: what the hall and the plant do, as pictures.

    python examples/plot_hall.py FOLDER

writes FOLDER/hall.png, FOLDER/week.png and FOLDER/overview.png, the picture of the README. Flexible
work waits and the battery feeds the hall while the grid is dirtier than its mean over the day.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from sdc_taichi import Actions, Simulator, StepResult, load_config
from sdc_taichi.viz.figures import hall_map, overview, readme_picture

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


def main(folder: Path) -> None:
    """Write the pictures."""
    config = load_config("corrected", ["site.location=NY", "site.start=07-01"])
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
