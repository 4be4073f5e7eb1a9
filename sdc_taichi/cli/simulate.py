"""``sdc-taichi simulate``: simulate data centers under a controller and write a run folder."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sdc_taichi.cli import completion
from sdc_taichi.cli.arguments import (
    Debug,
    FolderForce,
    Overrides,
    Quiet,
    Source,
    json_option,
    out_option,
    read_config,
)
from sdc_taichi.cli.optimum import solve_beside
from sdc_taichi.cli.scenario import (
    EXIT_INTERRUPTED,
    Carbon,
    Days,
    ErrorOfForecasts,
    Precision,
    Seed,
    Site,
    Start,
    Weather,
    Workload,
    data_centers,
    default_folder,
)
from sdc_taichi.cli.session import (
    interruptible,
    make_recorder,
    print_notes,
    print_recording,
    progress_bar,
    recording,
    serve_until_interrupted,
)
from sdc_taichi.cli.summary import print_summary
from sdc_taichi.errors import printable
from sdc_taichi.exogenous.year_clock import whole_steps

if TYPE_CHECKING:
    from sdc_taichi.types import StepResult

MAX_DCS = 100_000
"""Largest number of data centers of ``--dcs``."""


def simulate_command(
    source: Source = None,
    site: Site = None,
    days: Days = 365.0,
    start: Start = None,
    dcs: Annotated[
        int | None,
        typer.Option(min=1, max=MAX_DCS, help="Number of data centers; sites are dealt in turn."),
    ] = None,
    controller: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="idle, random, g36, coldest, warmest, constant:C, lookahead-3h, lookahead-24h, "
            "greedy-ci, mpc-24h, policy:FOLDER; or module:name of your own; or per agent, such as "
            "load=greedy-ci,cooling=g36,battery=policy:runs/happo.",
            autocompletion=completion.controllers,
        ),
    ] = "idle",
    seed: Seed = 0,
    forecast_error: ErrorOfForecasts = None,
    optimum: Annotated[
        str | None,
        typer.Option(
            metavar="TERMS",
            help="Also solve for the optimum of carbon, energy, cost, water or a sum such as "
            "carbon+0.002*water, and tell the run's share of the achievable.",
        ),
    ] = None,
    precision: Precision = "f32",
    overrides: Overrides = None,
    sample: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML of fields to vary between data centers."),
    ] = None,
    weather: Weather = None,
    carbon: Carbon = None,
    workload: Workload = None,
    out: Annotated[
        Path | None, out_option("Output folder. [default: runs/PRESET-SITES-START]", "DIR")
    ] = None,
    record: Annotated[
        str | None,
        typer.Option(
            "--record",
            metavar="FILE.rrd|ADDRESS",
            help="Also write a Rerun recording, or show the run in a viewer that listens there.",
        ),
    ] = None,
    focus: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME...]", help="Data centers recorded in full. [default: the first 2]"
        ),
    ] = None,
    every: Annotated[
        int | None,
        typer.Option(min=1, help="Steps between two recorded heat maps. [default: by size]"),
    ] = None,
    serve: Annotated[
        bool,
        typer.Option("--serve", help="Let viewers of this machine watch the run, until Ctrl-C."),
    ] = False,
    serve_port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Serve on this port; 0 is any free one. [default: 9876]"
        ),
    ] = None,
    force: FolderForce = False,
    quiet: Quiet = False,
    as_json: Annotated[bool, json_option("Print metrics.json instead of the summary.")] = False,
    debug: Debug = False,
) -> None:
    """Simulate data centers and record every step.

    Writes steps.parquet, metrics.json and the configuration to the output folder. Ctrl-C ends the
    run and leaves whole files of the steps done. Without weather, carbon or workload files the
    inputs are synthetic years.
    """
    from sdc_taichi.control import PERFECT, ForecastError, make_controller
    from sdc_taichi.optimum.objective import Objective
    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.run.folder_writer import metrics_json, prepare_folder, simulate_to_folder
    from sdc_taichi.run.optimum_folder import FOLDER, write_optimum
    from sdc_taichi.sim.events import require_events_start_before
    from sdc_taichi.sim.fleet import build_fleet
    from sdc_taichi.sim.simulator import Simulator

    base, label = read_config(source, overrides)
    configs = data_centers(
        base,
        site,
        start=start,
        weather=weather,
        carbon=carbon,
        workload=workload,
        dcs=dcs,
        sample=sample,
        seed=seed,
    )
    fleet = build_fleet(configs)
    error = PERFECT if forecast_error is None else ForecastError.parse(forecast_error)
    request = RunRequest(controller, whole_steps(days, fleet.steps_per_hour, "--days"), seed, error)
    require_events_start_before(24.0 * days, fleet.configs)
    driver = make_controller(controller, fleet)
    aim = None if optimum is None else Objective.parse(optimum)
    recorder = make_recorder(record, focus, every, serve, serve_port)
    folder = out if out is not None else default_folder(label, configs)
    with Simulator(fleet, precision=precision) as sim:
        print_notes(sim.drivers.notes)
        with interruptible() as interrupted, recording(recorder, sim, request) as record_step:
            prepare_folder(folder, force=force)
            best = (
                None
                if aim is None
                else solve_beside(sim, aim, request.steps, seed=seed, quiet=quiet, stop=interrupted)
            )
            with progress_bar(request.steps, shown=not quiet) as advance:

                def after_step(result: StepResult) -> None:
                    record_step(result)
                    advance(result)

                metrics = simulate_to_folder(
                    sim,
                    driver,
                    request,
                    folder,
                    force=force,
                    optimum=best,
                    on_step=after_step,
                    stop=interrupted,
                )
            if metrics is None:
                print("interrupted before the first step; nothing written", file=sys.stderr)
                raise typer.Exit(EXIT_INTERRUPTED)
            is_whole = metrics["steps_done"] == request.steps
            if best is not None and is_whole:
                is_whole = write_optimum(sim, best, folder / FOLDER, seed=seed, stop=interrupted)
            if as_json:
                print(metrics_json(metrics))
            elif not quiet:
                print_summary(metrics, label, folder, fleet.steps_per_hour)
                print_recording(recorder)
            serve_until_interrupted(recorder, interrupted)
    if not is_whole:
        done = metrics["steps_done"]
        where = f"after {done} of {request.steps} steps; {printable(folder)} holds the steps done"
        if done == request.steps:
            where = f"after the run; {printable(folder)} holds it without the path of the optimum"
        print(f"interrupted {where}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED)
