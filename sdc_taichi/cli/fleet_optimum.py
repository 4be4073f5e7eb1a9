"""``sdc-taichi optimum`` for fleets that share work: bound, achieved figure and controllers."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from sdc_taichi.cli.terminal import (
    count_text,
    figures_table,
    progress_bar,
    wide_console,
)
from sdc_taichi.errors import ConfigError

if TYPE_CHECKING:
    from sdc_taichi.control import Controller, ForecastError
    from sdc_taichi.optimum.fleet import FleetOptimum
    from sdc_taichi.sim.simulator import Simulator
    from sdc_taichi.types import F64


def print_fleet_optimum(
    sim: Simulator,
    steps: int,
    named: Mapping[str, Controller],
    *,
    seed: int,
    error: ForecastError,
    quiet: bool,
    as_json: bool,
    stop: Callable[[], bool],
) -> None:
    """Solve for the least carbon of fleets, run controllers, and print the figures.

    Args:
        sim: simulator of the fleets.
        steps: number of steps.
        named: controllers by name.
        seed: seed of controllers and forecast errors.
        error: standard deviations of forecast errors.
        quiet: True to print neither progress nor a table.
        as_json: True to print JSON in place of the table.
        stop: function that is called regularly; the work ends when it returns True.

    Raises:
        ConfigError: there is no bound, or no plan satisfies the limits.
        StoppedError: ``stop`` returned True.
    """
    from sdc_taichi.optimum.fleet import emissions_g, solve_fleet
    from sdc_taichi.optimum.problem import StoppedError
    from sdc_taichi.run.loop import simulate

    best = solve_fleet(sim, steps=steps, stop=stop)
    reached = {}
    for name, controller in named.items():
        with progress_bar(steps, shown=not quiet) as advance:
            totals = simulate(
                sim, controller, steps, seed, forecast_error=error, on_step=advance, stop=stop
            )
        if stop():
            raise StoppedError("nothing is kept")
        sums = totals.sums
        reached[name] = emissions_g(sim, sums["carbon_g"], sums["transfer_g"], steps)
    if as_json:
        print(json.dumps(_content(best, reached), indent=1))
    elif not quiet:
        _print(sim, best, reached)


def require_carbon_alone(objective: str, **options: Any) -> None:
    """Check that the options of the command are valid for fleets.

    Raises:
        ConfigError: the objective is not carbon, or an option is given that fleets do not have.
    """
    if objective != "carbon":
        raise ConfigError(f"--objective {objective}: valid for fleets that share work is carbon")
    for name, value in options.items():
        if value:
            raise ConfigError(
                f"--{name.replace('_', '-')}: not for fleets that share work; valid without it"
            )


def _content(best: FleetOptimum, reached: Mapping[str, F64]) -> dict[str, Any]:
    """Return the figures of all fleets in kg CO2e, as in the output of ``--json``."""
    names = ("idle", "cooled", "stay", "bound", "achieved")
    figures = {name: (getattr(best, f"{name}_g") / 1e3).tolist() for name in names}
    return {
        "objective": "carbon",
        "unit": "kg CO2e",
        "steps": best.steps,
        **figures,
        "controllers": {name: (g / 1e3).tolist() for name, g in reached.items()},
    }


def _print(sim: Simulator, best: FleetOptimum, reached: Mapping[str, F64]) -> None:
    """Print a table with one column per fleet."""
    fleet = sim.fleet
    sites = fleet.sites_per_fleet
    fleets = fleet.size // sites
    titles = [
        "idle (kg CO2e)",
        "cheapest setpoints (% against idle)",
        "bound without transfers (% against idle)",
        "bound (% against idle)",
        "achieved (% against idle)",
        *(f"{name} (% of the achievable)" for name in reached),
    ]

    def column(fleets_of: slice) -> list[float | None]:
        def take(figures: F64) -> float:
            return float(figures[fleets_of].sum())

        idle, achieved = take(best.idle_g), take(best.achieved_g)
        of_idle = (best.cooled_g, best.stay_g, best.bound_g, best.achieved_g)
        return [
            idle / 1e3,
            *(100.0 * (take(g) / idle - 1.0) for g in of_idle),
            *(100.0 * (idle - take(g)) / (idle - achieved) for g in reached.values()),
        ]

    console = wide_console(200)
    days = best.steps / fleet.steps_per_hour / 24
    console.print(
        f"Optimum of carbon: {count_text(fleets, 'fleet')} of {sites} sites, "
        f"{count_text(days, 'day')}, transfers included, batteries idle"
    )
    names = [f"{fleet.names[i]}..{fleet.names[i + sites - 1]}" for i in range(0, fleet.size, sites)]
    columns = [column(slice(at, at + 1)) for at in range(fleets)]
    total = column(slice(None))
    console.print(figures_table(console, titles, names, columns, total, "z.2f"))
