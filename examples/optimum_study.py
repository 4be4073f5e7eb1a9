"""Known optima of eight sites: four seasons, the held-out weeks, flexible halls, bills, and a day.

    python examples/optimum_study.py FOLDER [--quick]

prints the tables of docs/optimum.md and writes FOLDER/optimum_day.png. All inputs are synthetic
years. ``--quick`` takes fewer sites and days.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi import DataCenterConfig, Simulator, load_config, make_controller, simulate
from sdc_taichi.control import Controller
from sdc_taichi.learning.split import HELD_OUT, first_day
from sdc_taichi.optimum import solve
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.run.achievable import AchievedPath, Achievement, run_beside
from sdc_taichi.types import F64, StepResult
from sdc_taichi.viz.optimum_figure import COLUMNS, day_of_most_saved, optimum_day
from sdc_taichi.viz.plotting import save_picture

if TYPE_CHECKING:
    import pandas as pd

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
SEASONS = {"winter": "01-08", "spring": "04-02", "summer": "07-02", "autumn": "10-01"}
"""First day of a week of each season."""
RULES = "load=greedy-ci,cooling=g36,battery=lookahead-24h"
CONTROLLERS = ("idle", "g36", "lookahead-24h", RULES, "mpc-24h")
FLEXIBLE = (
    "workload.flexible_share=0.4",
    "workload.queue_limit_h=5",
    "battery.hours_of_design_load=4",
    "battery.charge_limit_c_rate=0.25",
    "battery.discharge_limit_c_rate=0.25",
)
"""Twice the work that may wait, and a battery of four hours."""
STEPS_PER_DAY = 96


@dataclass(frozen=True, slots=True)
class Case:
    """A table of held-out weeks."""

    title: str
    """Title of the table."""
    objective: str
    """Objective, as ``sdc-taichi optimum --objective`` takes it."""
    overrides: tuple[str, ...]
    """Overrides of preset ``corrected``."""
    sites: Sequence[str]
    """The sites."""
    weeks: Sequence[int]
    """Weeks of the year."""
    controllers: Sequence[str]
    """Controllers beside the optimum."""


def data_centers(
    sites: Sequence[str], starts: Mapping[str, str], overrides: Sequence[str] = ()
) -> list[DataCenterConfig]:
    """One data center per site and first day, site by site.

    Args:
        sites: the sites.
        starts: first day of each period, by its name.
        overrides: further values.
    """
    return [
        load_config("corrected", [f"name={site}-{name}", f"site.location={site}",
                                  f"site.start={start}", *overrides])
        for site in sites
        for name, start in starts.items()
    ]  # fmt: skip


def week_starts(weeks: Sequence[int]) -> dict[str, str]:
    """First days of weeks of the year, by the number of the week."""
    return {str(week): first_day(week) for week in weeks}


def season_table(sites: Sequence[str], days: int) -> str:
    """Achieved carbon against idle, and the bound, by site and season."""
    configs = data_centers(sites, SEASONS)
    found = solve(configs, steps=days * STEPS_PER_DAY)
    shape = (len(sites), len(SEASONS))
    idle, achieved, bound = (x.reshape(shape) for x in (found.idle, found.achieved, found.bound))
    lines = [
        f"| carbon against idle (%), {days} days | {' | '.join(SEASONS)} | all |",
        "|---|" + "---|" * (len(SEASONS) + 1),
    ]
    for name, *rows in zip(
        (*sites, "all"), *(with_total(x) for x in (idle, achieved, bound)), strict=True
    ):
        cells = [f"{change(a, i):.2f} ({change(b, i):.2f})" for i, a, b in zip(*rows, strict=True)]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def with_total(values: F64) -> F64:
    """A table with sums of rows and columns."""
    rows = np.vstack([values, values.sum(axis=0)])
    return np.hstack([rows, rows.sum(axis=1, keepdims=True)])


def change(value: float, idle: float) -> float:
    """Change against idle, in %."""
    return 100.0 * (value / idle - 1.0)


def week_table(case: Case, days: int) -> str:
    """Controllers, single agents, achieved path and bound over held-out weeks.

    The first day of each week is not scored, and the achieved path ends as it is after that day.

    Args:
        case: what to solve.
        days: days of each week to take.
    """
    configs = data_centers(case.sites, week_starts(case.weeks), case.overrides)
    steps = days * STEPS_PER_DAY
    with Simulator(configs) as sim:
        found = solve(
            sim.fleet,
            steps=steps,
            drivers=sim.drivers,
            objective=case.objective,
            scored_from=STEPS_PER_DAY,
        )
        reached = [
            each
            for name in case.controllers
            if (each := run_beside(found, sim, make_controller(name, sim.fleet), name)) is not None
        ]
    return "\n".join([f"{case.title}, {len(configs)} data-center weeks", "",
                      *week_lines(found, reached, case.sites)])  # fmt: skip


def week_lines(found: Optimum, reached: Sequence[Achievement], sites: Sequence[str]) -> list[str]:
    """Lines of a table of held-out weeks: all sites together, each site, share, broken weeks."""
    heads = ["against idle (%)", "all", *sites, "share (%)", "weeks that break a constraint"]
    lines = [f"| {' | '.join(heads)} |", "|---|" + "---|" * (len(heads) - 1)]

    def add(name: str, figure: F64, share: float | None, broken: int | None) -> None:
        both = [with_total(x.reshape(len(sites), -1))[:, -1] for x in (figure, found.idle)]
        cells = [f"{change(x, idle):.2f}" for x, idle in zip(*both, strict=True)]
        known = "" if share is None or np.isnan(share) else f"{100 * share:.1f}"
        end = [known, "" if broken is None else f"{broken}"]
        lines.append(f"| {' | '.join([name, cells[-1], *cells[:-1], *end])} |")

    for each in reached:
        add(each.controller, each.valued_figure, each.total_share, sum(map(bool, each.broken)))
    for agent, figure in found.alone.items():
        add(f"optimum, {agent} alone", figure, share_of(found, figure), None)
    add("optimum", found.achieved, 1.0, sum(map(bool, found.failures)))
    add("bound", found.bound, None, None)
    return lines


def share_of(found: Optimum, figure: F64) -> float:
    """Share of the achievable of figures whose ends are those of the optimum."""
    return float((found.idle - figure).sum() / (found.idle - found.achieved).sum())


def day_picture(path: Path, site: str, days: int, controllers: Mapping[str, str]) -> None:
    """Draw the day of a summer on which the optimum saves most carbon against idle.

    Args:
        path: the picture.
        site: the site.
        days: days to solve.
        controllers: controllers beside the optimum, by label; the first is what it saves against.
    """
    config = load_config("corrected", [f"site.location={site}", "site.start=07-02"])
    steps = days * STEPS_PER_DAY
    with Simulator(config) as sim:
        found = solve(sim.fleet, steps=steps, drivers=sim.drivers)
        runs = {
            label: steps_under(sim, make_controller(name, sim.fleet), steps)
            for label, name in controllers.items()
        }
        runs["optimum"] = steps_under(sim, AchievedPath(found), steps)
    first = next(iter(runs.values()))
    saved = (first["carbon_g"] - runs["optimum"]["carbon_g"]).to_numpy()
    day = day_of_most_saved(saved, first["time"])
    save_picture(optimum_day(runs, day, f"{site}, synthetic year"), path)


def steps_under(sim: Simulator, controller: Controller, steps: int) -> pd.DataFrame:
    """Columns of a run of one data center that the picture reads."""
    import pandas as pd

    from sdc_taichi.exogenous.year_clock import step_times

    results: list[StepResult] = []
    simulate(sim, controller, steps, on_step=results.append)
    columns = {
        name: [float(getattr(result, name)[0]) for result in results]
        for name in (*COLUMNS[1:], "carbon_g")
    }
    times = step_times(sim.drivers.start, np.arange(steps), sim.fleet.steps_per_hour)
    return pd.DataFrame({"time": times[:, 0], **columns})


def main() -> None:
    """Print the tables and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--quick", action="store_true", help="fewer sites and days")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    sites, weeks = (("CA",), (3,)) if given.quick else (SITES, HELD_OUT)
    few_sites, few_weeks = (sites, weeks) if given.quick else (("NY", "CA", "AZ"), (3, 15, 27, 39))
    days = 2 if given.quick else 7
    rich = "carbon with 40 % flexible work and 4 h of battery"
    print(season_table(sites, 1 if given.quick else 7), "\n", flush=True)
    for case in (
        Case("carbon", "carbon", (), sites, weeks, CONTROLLERS),
        Case(rich, "carbon", FLEXIBLE, few_sites, few_weeks, CONTROLLERS),
        Case("the bill", "cost", (), few_sites, few_weeks, (*CONTROLLERS[:-1], "mpc-24h:cost")),
    ):
        print(week_table(case, days), "\n", flush=True)
    controllers = {"idle": "idle", "greedy": RULES, "mpc-24h": "mpc-24h"}
    day_picture(given.folder / "optimum_day.png", "CA", 2 if given.quick else 7, controllers)


if __name__ == "__main__":
    main()
