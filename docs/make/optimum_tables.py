"""Make the tables and the picture of docs/optimum.md from synthetic years.

    python docs/make/optimum_tables.py FOLDER [--sites NY CA] [--weeks 3 15] [--days 7]

prints, for the sites: carbon in four seasons; controllers, single agents, optimum and bound in the
held-out weeks (also with more flexible work and a larger battery, and for the bill); and
model-predictive control by horizon and error of its forecasts. FOLDER/optimum_day.png shows the day
of a summer on which the optimum saves most carbon.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from sdc_taichi import (
    DataCenterConfig,
    ForecastError,
    Simulator,
    StepResult,
    load_config,
    make_controller,
    simulate,
)
from sdc_taichi.control import PERFECT, Controller
from sdc_taichi.learning.split import HELD_OUT, first_day
from sdc_taichi.optimum import solve
from sdc_taichi.run.achievable import AchievedPath, run_beside
from sdc_taichi.types import F64
from sdc_taichi.viz.figures import OPTIMUM_COLUMNS, day_of_most_saved, optimum_day
from sdc_taichi.viz.plotting import save_picture

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
SEASONS = ("01-08", "04-02", "07-02", "10-01")
"""First day of a week of winter, spring, summer and autumn."""
RULES = "load=greedy-ci,cooling=g36,battery=lookahead-24h"
BESIDE = (("g36", PERFECT), ("lookahead-24h", PERFECT), (RULES, PERFECT), ("mpc-24h", PERFECT))
"""Controllers beside the optimum, and how their forecasts err."""
ERRING = ForecastError(ci_share=0.1, temperature_k=1.0)
HORIZONS = [(f"mpc-{hours}h", error) for hours in (12, 24, 72) for error in (PERFECT, ERRING)]
FLEXIBLE = (
    "workload.flexible_share=0.4",
    "workload.queue_limit_h=5",
    "battery.hours_of_design_load=4",
    "battery.charge_limit_c_rate=0.25",
    "battery.discharge_limit_c_rate=0.25",
)
"""Twice the work that may wait, and a battery of four hours."""
STEPS_PER_DAY = 96


def data_centers(
    sites: Sequence[str], starts: Sequence[str], overrides: Sequence[str] = ()
) -> list[DataCenterConfig]:
    """One data center per site and first day, site by site."""
    return [
        load_config("corrected", [f"name={site}-{start}", f"site.location={site}",
                                  f"site.start={start}", *overrides])
        for site in sites
        for start in starts
    ]  # fmt: skip


def changes(figure: F64, idle: F64, sites: int) -> list[float]:
    """Change against idle of each site and of all sites together, in %."""
    by_site = figure.reshape(sites, -1).sum(axis=1), idle.reshape(sites, -1).sum(axis=1)
    ratio = [*(by_site[0] / by_site[1]), figure.sum() / idle.sum()]
    return [100.0 * (float(x) - 1.0) for x in ratio]


def table(heads: Sequence[str], rows: Mapping[str, Sequence[float]]) -> str:
    """A Markdown table with a row title before each row of numbers."""
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    lines += [f"| {title} | {' | '.join(f'{x:.2f}' for x in row)} |" for title, row in rows.items()]
    return "\n".join(lines)


def season_tables(sites: Sequence[str], days: int) -> Iterator[str]:
    """Achieved carbon and bound by season, for each site and all."""
    for start in SEASONS:
        best = solve(data_centers(sites, [start]), steps=days * STEPS_PER_DAY)
        rows = {
            name: changes(figure, best.idle, len(sites))
            for name, figure in (("achieved", best.achieved), ("bound", best.bound))
        }
        yield table([f"from {start}", *sites, "all"], rows)


def week_table(
    title: str,
    configs: Sequence[DataCenterConfig],
    sites: Sequence[str],
    days: int,
    objective: str = "carbon",
    beside: Sequence[tuple[str, ForecastError]] = BESIDE,
) -> str:
    """Controllers, single agents, achieved path and bound; the first day is not scored."""
    rows: dict[str, list[float]] = {}
    with Simulator(configs) as sim:
        best = solve(
            sim.fleet,
            steps=days * STEPS_PER_DAY,
            drivers=sim.drivers,
            objective=objective,
            scored_from=STEPS_PER_DAY,
        )
        room = (best.idle - best.achieved).sum()
        for name, error in beside:
            spec = f"{name}:{objective}" if "mpc" in name and objective != "carbon" else name
            controller = make_controller(spec, sim.fleet)
            reached = run_beside(best, sim, controller, spec, forecast_error=error)
            assert reached is not None
            values = changes(reached.valued_figure, best.idle, len(sites))
            erring = "" if error == PERFECT else ", forecasts err"
            rows[f"{spec}{erring}"] = [*values, 100.0 * reached.total_share]
    figures = {f"optimum, {agent} alone": figure for agent, figure in best.alone.items()}
    for name, figure in {**figures, "optimum": best.achieved, "bound": best.bound}.items():
        share = 100.0 * float((best.idle - figure).sum() / room)
        rows[name] = [*changes(figure, best.idle, len(sites)), share]
    return table([f"{title}, against idle (%)", *sites, "all", "share (%)"], rows)


def day_picture(path: Path, site: str, days: int) -> None:
    """Draw the day of a summer on which the optimum saves most carbon against idle commands."""
    with Simulator(data_centers([site], [SEASONS[2]])) as sim:
        steps = days * STEPS_PER_DAY
        best = solve(sim.fleet, steps=steps, drivers=sim.drivers)
        controllers: dict[str, Controller] = {
            label: make_controller(name, sim.fleet)
            for label, name in (("idle", "idle"), ("greedy", RULES), ("mpc-24h", "mpc-24h"))
        }
        controllers["optimum"] = AchievedPath(best)
        runs = {label: steps_under(sim, each, steps) for label, each in controllers.items()}
    saved = (runs["idle"]["carbon_g"] - runs["optimum"]["carbon_g"]).to_numpy()
    day = day_of_most_saved(saved, runs["idle"]["time"])
    save_picture(optimum_day(runs, day, f"{site}, synthetic year"), path)


def steps_under(sim: Simulator, controller: Controller, steps: int) -> pd.DataFrame:
    """Columns of a run of one data center that the picture reads."""
    results: list[StepResult] = []
    simulate(sim, controller, steps, on_step=results.append)
    columns = {
        name: [float(getattr(result, name)[0]) for result in results]
        for name in (*OPTIMUM_COLUMNS[1:], "carbon_g")
    }
    times = sim.drivers.times(np.arange(steps), sim.fleet.steps_per_hour)
    return pd.DataFrame({"time": times[:, 0], **columns})


def main() -> None:
    """Print the tables and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sites", nargs="+", default=list(SITES))
    parser.add_argument("--weeks", nargs="+", type=int, default=list(HELD_OUT))
    parser.add_argument("--days", type=int, default=7)
    options = parser.parse_args()
    sites, days = options.sites, options.days
    starts = [first_day(week) for week in options.weeks]
    weeks, rich = data_centers(sites, starts), data_centers(sites, starts, FLEXIBLE)
    for text in season_tables(sites, days):
        print(text, "\n", flush=True)
    print(week_table("carbon", weeks, sites, days), "\n", flush=True)
    print(week_table("carbon, flexible", rich, sites, days), "\n", flush=True)
    print(week_table("bill", weeks, sites, days, objective="cost"), "\n", flush=True)
    print(week_table("carbon", weeks, sites, days, beside=HORIZONS), flush=True)
    options.folder.mkdir(parents=True, exist_ok=True)
    day_picture(options.folder / "optimum_day.png", "CA", days)


if __name__ == "__main__":
    main()
