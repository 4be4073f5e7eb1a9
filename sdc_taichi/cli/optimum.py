"""``sdc-taichi optimum``: compute a lower bound for all controllers and an achieved figure."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdc_taichi.cli.fleet_optimum import print_fleet_optimum, require_carbon_alone
from sdc_taichi.cli.options import (
    Compared,
    ConfigOptions,
    Days,
    FolderForce,
    ForecastRunOptions,
    NoCache,
    SiteOptions,
    Start,
    json_option,
    out_option,
)
from sdc_taichi.cli.terminal import (
    EXIT_INTERRUPTED,
    count_text,
    exit_if_stopped,
    figures_table,
    first_lines,
    interruptible,
    print_notes,
    progress_bar,
    stage_bars,
    wide_console,
)
from sdc_taichi.errors import ConfigError, printable, suggestion
from sdc_taichi.exogenous.year_clock import whole_steps

if TYPE_CHECKING:
    from sdc_taichi.control import Controller, ForecastError
    from sdc_taichi.optimum.problem import Agent
    from sdc_taichi.optimum.result import Optimum
    from sdc_taichi.run.achievable import Achievement
    from sdc_taichi.sim.fleet import Fleet
    from sdc_taichi.sim.simulator import Simulator


MOST_LINES = 12
"""Largest number of printed remarks about single data centers."""


def optimum_command(
    *,
    config: ConfigOptions,
    sites: SiteOptions,
    days: Days = 31.0,
    start: Start = None,
    objective: Annotated[
        str,
        typer.Option(
            metavar="TERMS",
            help="What is minimised: carbon, energy, cost, water, or a sum such as "
            "carbon+0.002*water.",
        ),
    ] = "carbon",
    controller: Compared = None,
    agents: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME]",
            help="What may be moved: load, cooling, battery, and liquid (coolant loops). "
            "[default: all]",
        ),
    ] = None,
    uncoordinated: Annotated[
        bool,
        typer.Option(
            "--uncoordinated", help="Also the figures of agents that do not plan together."
        ),
    ] = False,
    warm_up: Annotated[
        float,
        typer.Option(
            metavar="DAYS", help="Days before the figures count; the run ends as it is after them."
        ),
    ] = 0.0,
    max_inlet: Annotated[
        float | None,
        typer.Option(
            min=10.0,
            max=60.0,
            metavar="C",
            help="Hottest inlet to allow. [default: of protection.ashrae_class]",
        ),
    ] = None,
    run: ForecastRunOptions,
    no_cache: NoCache = False,
    out: Annotated[
        Path | None, out_option("Run folder to write the achieved path to. [default: none]", "DIR")
    ] = None,
    force: FolderForce = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no table.")] = False,
    as_json: Annotated[bool, json_option("Print optimum.json instead of the table.")] = False,
) -> None:
    """Find the least carbon, energy, cost or water that data centers can reach.

    Prints a lower bound for all controllers, a figure that the simulator has reached, and where
    named controllers are between idle commands and that figure. All inputs are known in advance.
    For a fleet that shares work, load, cooling and transfers are moved for the least carbon.
    """
    from sdc_taichi.control import make_controller
    from sdc_taichi.optimum.objective import Objective
    from sdc_taichi.run.folder_writer import metrics_json, prepare_folder
    from sdc_taichi.run.optimum_folder import optimum_content, write_optimum
    from sdc_taichi.sim.events import require_events_start_before
    from sdc_taichi.sim.fleet import build_fleet
    from sdc_taichi.sim.simulator import Simulator

    aim = Objective.parse(objective)
    fleet = build_fleet(sites.data_centers(config.read()[0], start=start))
    steps = whole_steps(days, fleet.steps_per_hour, "--days")
    scored_from = _warm_up_steps(warm_up, steps, fleet.steps_per_hour)
    require_events_start_before(24.0 * days, fleet.configs)
    fleet.require_distinct_names()
    movable = _agents(agents, fleet)
    if uncoordinated and len(set(movable) - {"liquid"}) < 2:
        raise ConfigError(
            f"--uncoordinated --agents {agents}: valid is with two or more of load, cooling and "
            "battery"
        )
    error = run.error()
    named = {name: make_controller(name, fleet) for name in controller or ()}
    if fleet.sites_per_fleet > 1:
        require_carbon_alone(str(aim), warm_up=warm_up, max_inlet=max_inlet, out=out)
        with Simulator(fleet, precision=run.precision) as sim, interruptible() as interrupted:
            print_notes(sim.drivers.notes)
            with exit_if_stopped():
                print_fleet_optimum(
                    sim,
                    steps,
                    named,
                    seed=run.seed,
                    error=error,
                    quiet=quiet,
                    as_json=as_json,
                    stop=interrupted,
                )
        return
    for name, named_controller in named.items():
        _require_movable(name, named_controller, movable)
    if out is not None:
        prepare_folder(out, force=force)
    with Simulator(fleet, precision=run.precision) as sim, interruptible() as interrupted:
        print_notes(sim.drivers.notes)
        optimum = solve_beside(
            sim,
            objective=aim,
            steps=steps,
            seed=run.seed,
            agents=movable,
            scored_from=scored_from,
            inlet_limit_c=max_inlet,
            uncoordinated=uncoordinated,
            cache=not no_cache,
            quiet=quiet,
            stop=interrupted,
        )
        reached = _run_controllers(sim, optimum, named, run.seed, error, quiet, interrupted)
        if as_json:
            print(metrics_json(optimum_content(optimum, reached)))
        elif not quiet:
            _print_optimum(optimum_content(optimum, reached), fleet.steps_per_hour)
        is_written = False
        if out is not None and not interrupted():
            with progress_bar(steps, shown=not quiet) as advance:
                is_written = write_optimum(
                    sim,
                    optimum,
                    out,
                    reached=reached,
                    seed=run.seed,
                    force=force,
                    on_step=advance,
                    stop=interrupted,
                )
        if is_written and not (quiet or as_json):
            print(f"Files in {printable(out)}: optimum.json, and the run of the achieved path")
        if interrupted():
            missing = [name for name in named if name not in {r.controller for r in reached}]
            _print_interruption(missing, out if not is_written else None)
            raise typer.Exit(EXIT_INTERRUPTED)


def solve_beside(
    sim: Simulator, *, quiet: bool, stop: Callable[[], bool], **options: Any
) -> Optimum:
    """Solve for the optimum of a simulator's data centers and inputs, with progress bars.

    Args:
        sim: the simulator.
        quiet: True to show no progress.
        stop: function that is called regularly; the work ends when it returns True.
        options: further arguments of ``optimum.solve``.

    Raises:
        typer.Exit: the user stopped the solver; a message on stderr lists the stored results.
        SdcError: there is no optimum for these data centers and inputs.
    """
    from sdc_taichi.optimum import solve

    with exit_if_stopped(), stage_bars(shown=not quiet) as progress:
        return solve(
            sim.fleet,
            drivers=sim.drivers,
            precision=sim.precision,
            progress=progress,
            stop=stop,
            **options,
        )


def _run_controllers(
    sim: Simulator,
    optimum: Optimum,
    named: dict[str, Controller],
    seed: int,
    error: ForecastError,
    quiet: bool,
    stop: Callable[[], bool],
) -> list[Achievement]:
    """Run controllers, and return figure and share of the achievable of each complete run."""
    from sdc_taichi.run.achievable import run_beside

    reached = []
    for name, controller in named.items():
        with progress_bar(optimum.steps, shown=not quiet) as advance:
            achievement = run_beside(
                optimum,
                sim,
                controller,
                name,
                seed,
                forecast_error=error,
                on_step=advance,
                stop=stop,
            )
        if achievement is not None:
            reached.append(achievement)
    return reached


def _print_interruption(missing: list[str], out: Path | None) -> None:
    """Print on stderr which results are missing after an interruption.

    Args:
        missing: names of controllers without a figure.
        out: run folder that was not written; None if it was, or without ``--out``.
    """
    left = [f"controllers {', '.join(missing)}"] if missing else []
    left += [f"files in {printable(out)}"] if out is not None else []
    text = f"; without {' and '.join(left)}" if left else ""
    print(f"interrupted{text}; the figures above are whole", file=sys.stderr)


def _agents(text: str | None, fleet: Fleet) -> tuple[Agent, ...]:
    """Parse the value of ``--agents``, and return its agents in their usual order."""
    from sdc_taichi.optimum.task import checked_agents

    known = checked_agents(None, fleet)
    if text is None:
        return known
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in known:
            meant = suggestion(name, known, " (did you mean {!r}?)")
            raise ConfigError(f"--agents {text!r}: {name!r}; valid are {', '.join(known)}{meant}")
        if names.count(name) > 1:
            raise ConfigError(f"--agents {text!r}: {name} is given twice; valid is each once")
    return tuple(agent for agent in known if agent in names)


def _require_movable(name: str, controller: Controller, movable: tuple[Agent, ...]) -> None:
    """Raise ``ConfigError`` if a controller decides commands that the optimum leaves idle."""
    from sdc_taichi.control import commands_of
    from sdc_taichi.optimum.loop_map import LOOP_COMMANDS

    moved = (*movable, *(LOOP_COMMANDS if "liquid" in movable else ()))
    more = [command for command in commands_of(controller) if command not in moved]
    if more:
        raise ConfigError(
            f"--controller {name}: moves {' and '.join(more)}, which --agents "
            f"{','.join(movable)} leaves idle"
        )


def _warm_up_steps(days: float, steps: int, steps_per_hour: int) -> int:
    """Return the number of steps of ``--warm-up``, which must be less than ``steps``."""
    if days == 0.0:
        return 0
    count = whole_steps(days, steps_per_hour, "--warm-up")
    if count >= steps:
        raise ConfigError(f"--warm-up {days:g}: valid is less than --days")
    return count


def _print_optimum(content: Mapping[str, Any], steps_per_hour: int) -> None:
    """Print the table of figures of an optimum, and remarks about them."""
    from sdc_taichi.optimum.uncoordinated import title_of
    from sdc_taichi.run.optimum_folder import optimum_remarks

    console = wide_console(200)
    dcs, scored = content["data_centers"], content["steps"] - content["scored_from"]
    days = scored / steps_per_hour / 24
    warm_up = content["scored_from"] / steps_per_hour / 24
    after = f" after a warm-up of {count_text(warm_up, 'day')}" if warm_up else ""
    count = f"{count_text(len(dcs), 'data center')}, {count_text(days, 'day')}"
    console.print(f"Optimum of {content['objective']}: {count}{after}")
    names, controllers = [dc["name"] for dc in dcs], content["controllers"]
    titles = [
        f"idle ({content['unit']})",
        "bound (% against idle)",
        "achieved (% against idle)",
        "gap (points)",
        *(f"{name} alone (%)" for name in content["total"]["alone"]),
        *(f"{title_of(way)} (%)" for way in content["total"]["uncoordinated"]),
        *(f"{each['controller']} (% of the achievable)" for each in controllers),
    ]
    columns = [
        _values(dc, [each["data_centers"][i]["share"] for each in controllers])
        for i, dc in enumerate(dcs)
    ]
    total = _values(content["total"], [each["share"] for each in controllers])
    console.print(figures_table(console, titles, names, columns, total, "z.2f"))
    for line in first_lines(optimum_remarks(content), MOST_LINES, ", see --json"):
        console.print(line)


def _values(figures: Mapping[str, Any], shares: Sequence[float | None]) -> list[float | None]:
    """Return the column of the table for a data center, or for all data centers.

    Args:
        figures: figures of the data center, or of all, in optimum.json.
        shares: share of the achievable of each controller.
    """
    idle = figures["idle"]

    def change_pct(value: float | None) -> float | None:
        return None if value is None or not idle else 100.0 * (value / idle - 1.0)

    return [
        idle,
        change_pct(figures["bound"]),
        change_pct(figures["achieved"]),
        figures["gap_points"],
        *(change_pct(value) for value in figures["alone"].values()),
        *(change_pct(value) for value in figures["uncoordinated"].values()),
        *(None if share is None else 100.0 * share for share in shares),
    ]
