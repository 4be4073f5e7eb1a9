"""Model-predictive control in weeks of eight sites: horizons, errors of forecasts, single agents.

    python examples/mpc_study.py [--sites NY CA] [--weeks 3 7] [--days 7] [--objective carbon]

prints a table of docs/optimum.md: what each controller changes against idle commands, and its share
of what can be achieved, in the weeks that docs/training.md leaves out of training. The first day of
a week is run and not scored. All inputs are synthetic years.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

from optimum_study import RULES, SITES, STEPS_PER_DAY, data_centers, week_starts

from sdc_taichi import ForecastError, Simulator, make_controller
from sdc_taichi.control import PERFECT
from sdc_taichi.learning.split import HELD_OUT
from sdc_taichi.optimum import solve
from sdc_taichi.run.achievable import run_beside

ERRING = ForecastError(ci_share=0.1, temperature_k=1.0)
"""Errors of forecasts at 24 h: 10 % of the carbon intensity, and 1 K."""
CONTROLLERS = (
    (RULES, PERFECT),
    (RULES, ERRING),
    ("load=mpc-24h", PERFECT),
    ("cooling=mpc-24h", PERFECT),
    ("battery=mpc-24h", PERFECT),
    ("mpc-12h", PERFECT),
    ("mpc-24h", PERFECT),
    ("mpc-24h", ERRING),
    ("mpc-72h", PERFECT),
    ("mpc-72h", ERRING),
)
"""Controllers, and how their forecasts err."""
HEAD = (
    "| controller | forecasts | against idle (%) | with ends valued (%) | share (%) | stored (%) "
    "| waiting (tasks) | weeks that break a limit |"
)


def study(sites: Sequence[str], weeks: Sequence[int], days: int, objective: str) -> Iterator[str]:
    """Lines of the table, each as soon as it is known.

    Args:
        sites: the sites.
        weeks: weeks of the year.
        days: days of each week, the first of which is not scored.
        objective: what is minimised; plans have the same.
    """
    configs = data_centers(sites, week_starts(weeks))
    steps = days * STEPS_PER_DAY
    suffix = "" if objective == "carbon" else f":{objective}"
    with Simulator(configs) as sim:
        found = solve(
            sim.fleet,
            steps=steps,
            drivers=sim.drivers,
            objective=objective,
            scored_from=STEPS_PER_DAY,
        )
        idle = found.idle.sum()
        best, bound = (100.0 * (x.sum() / idle - 1.0) for x in (found.achieved, found.bound))
        yield from (f"achieved {best:.2f} %, bound {bound:.2f} %", "", HEAD, "|---" * 8 + "|")
        for name, error in CONTROLLERS:
            spec = f"{name}{suffix}" if "mpc" in name else name
            controller = make_controller(spec, sim.fleet)
            reached = run_beside(found, sim, controller, spec, forecast_error=error)
            assert reached is not None
            stored = 100.0 * sim.state.stored_kwh.sum() / sim.sizing.battery_kwh.sum()
            waiting = sim.state.queue[:, -1].mean()
            plain, valued = (
                100.0 * (x.sum() / idle - 1.0) for x in (reached.figure, reached.valued_figure)
            )
            broken = sum(bool(each) for each in reached.broken)
            known = "perfect" if error == PERFECT else "10 %, 1 K"
            yield (
                f"| {spec.replace(',', ', ')} | {known} | {plain:.2f} | {valued:.2f} "
                f"| {100.0 * reached.total_share:.1f} | {stored:.0f} | {waiting:.0f} "
                f"| {broken} |"
            )


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sites", nargs="+", default=list(SITES))
    parser.add_argument("--weeks", nargs="+", type=int, default=list(HELD_OUT))
    parser.add_argument("--days", type=int, default=7)
    parser.add_argument("--objective", default="carbon")
    given = parser.parse_args(arguments)
    for line in study(given.sites, given.weeks, given.days, given.objective):
        print(line, flush=True)


if __name__ == "__main__":
    main()
