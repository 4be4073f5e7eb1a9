"""``sdc-taichi simulate``: simulate data centers under a controller and write a run folder."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sdc_taichi.cli.optimum import solve_beside
from sdc_taichi.cli.options import (
    ConfigOptions,
    Days,
    FolderForce,
    ForecastRunOptions,
    Quiet,
    SiteOptions,
    Start,
    controllers_option,
    json_option,
    out_option,
)
from sdc_taichi.cli.summary import print_summary
from sdc_taichi.cli.terminal import EXIT_INTERRUPTED, interruptible, print_notes, progress_bar
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, printable
from sdc_taichi.exogenous.year_clock import whole_steps

if TYPE_CHECKING:
    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.sim.simulator import Simulator
    from sdc_taichi.types import StepResult
    from sdc_taichi.viz.recorder import Recorder

MAX_DCS = 100_000
"""Largest valid number of data centers in ``--dcs``."""


@dataclass(frozen=True)
class RecordingOptions:
    """Options for the Rerun recording of a run, in a file or for viewers during the run."""

    record: Annotated[
        str | None,
        typer.Option(
            "--record",
            metavar="FILE.rrd|ADDRESS",
            help="Also write a Rerun recording, or show the run in a viewer that listens there.",
        ),
    ] = None
    focus: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME...]", help="Data centers recorded in full. [default: the first 2]"
        ),
    ] = None
    every: Annotated[
        int | None,
        typer.Option(min=1, help="Steps between two recorded heat maps. [default: by size]"),
    ] = None
    against: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Run of the same halls, simulated again; a recorded map shows inlets less those "
            "of this run. [default: the state before an event]",
        ),
    ] = None
    racks: Annotated[
        str | None,
        typer.Option(
            metavar="RACK|row:ROW|hottest:COUNT|...",
            help="Racks whose history is written to racks.parquet, and whose trends are recorded, "
            "separated by commas: numbers, ROW:PLACE, row:ROW, zone:ZONE, hottest:COUNT, median. "
            "[default: none in racks.parquet, hottest:10,median in a recording]",
        ),
    ] = None
    inlet_range: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH|same",
            help="Inlets that the colours of recorded maps cover, in C; same is 10:45. "
            "[default: what the halls use]",
        ),
    ] = None
    serve: Annotated[
        bool,
        typer.Option("--serve", help="Let viewers of this machine watch the run, until Ctrl-C."),
    ] = False
    serve_port: Annotated[
        int | None,
        typer.Option(
            min=0, max=65535, help="Serve on this port; 0 is any free one. [default: 9876]"
        ),
    ] = None

    def recorder(self) -> Recorder | None:
        """Create the recorder for the options; return None if no recording is requested.

        Raises:
            SdcError: options for recordings are given without a recording, or the recording cannot
                be created.
        """
        from sdc_taichi.viz.recording_output import DEFAULT_PORT, is_address

        port = self.serve_port
        if self.serve or port is not None:
            port = DEFAULT_PORT if port is None else port
        elif self.record is None:
            only_recorded = {
                "--focus": self.focus,
                "--every": self.every,
                "--against": self.against,
                "--inlet-range": self.inlet_range,
            }
            for name, value in only_recorded.items():
                if value is not None:
                    raise ConfigError(
                        f"{name}: given without a recording; valid with --record, --serve"
                    )
            return None
        from sdc_taichi.hall.rack_selection import parse_racks
        from sdc_taichi.viz.colour_scales import parse_inlet_range
        from sdc_taichi.viz.recorder import Recorder

        target = self.record
        if target is not None and target.endswith(".rrd") and not is_address(target):
            with contextlib.suppress(OSError):  # the recorder reports the error
                Path(target).parent.mkdir(parents=True, exist_ok=True)
        names = None if self.focus is None else [name.strip() for name in self.focus.split(",")]
        inlet_range = None if self.inlet_range is None else parse_inlet_range(self.inlet_range)
        return Recorder(
            target,
            focus=names,
            every=self.every,
            serve_port=port,
            inlet_range=inlet_range,
            against=self.against,
            racks=None if self.racks is None else parse_racks(self.racks),
        )


def simulate_command(
    *,
    config: ConfigOptions,
    sites: SiteOptions,
    days: Days = 365.0,
    start: Start = None,
    dcs: Annotated[
        int | None,
        typer.Option(min=1, max=MAX_DCS, help="Number of data centers; sites are dealt in turn."),
    ] = None,
    sample: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML of fields to vary between data centers."),
    ] = None,
    controller: Annotated[
        str,
        controllers_option(
            "idle, rules, random, g36, coldest, warmest, constant:C, lookahead-3h, "
            "lookahead-24h, rank-24h, drain, greedy-ci, follow, local-pi, common-pi, "
            "g36-trim-respond, one-speed, geo-central, geo-all-to-cleanest, geo-three-cleanest, "
            "geo-all-cleaner, geo-mpc, liquid-wet-bulb, liquid-reset, liquid-greedy, mpc-24h, "
            "policy:FOLDER; or module:name of your own; or per agent, such as "
            "load=greedy-ci,cooling=g36,battery=policy:runs/happo; geo-... is for fleets, "
            "liquid-... for coolant loops, and follow to one-speed are for fans that are "
            "controlled."
        ),
    ] = "idle",
    run: ForecastRunOptions,
    optimum: Annotated[
        str | None,
        typer.Option(
            metavar="TERMS",
            help="Also solve for the optimum of carbon, energy, cost, water or a sum such as "
            "carbon+0.002*water, and print the run's share of the achievable.",
        ),
    ] = None,
    out: Annotated[
        Path | None, out_option("Output folder. [default: runs/PRESET-SITES-START]", "DIR")
    ] = None,
    rack_history: Annotated[
        str | None,
        typer.Option(
            metavar="every=TIME[,unit-shares]",
            help="Write temperatures, power and airflow of racks (--racks, or all) to "
            "racks.parquet, as means of a TIME such as 15min, 1h or step; unit-shares adds the "
            "CRAC units that supply each rack.",
        ),
    ] = None,
    recording: RecordingOptions,
    force: FolderForce = False,
    quiet: Quiet = False,
    as_json: Annotated[bool, json_option("Print metrics.json instead of the summary.")] = False,
) -> None:
    """Simulate data centers and record every step.

    Writes steps.parquet, metrics.json and the configuration to the output folder. Ctrl-C ends the
    run and leaves whole files of the steps done. Without weather, carbon or workload files the
    inputs are synthetic years.
    """
    from sdc_taichi.control import make_controller
    from sdc_taichi.optimum.objective import Objective
    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.run.folder_writer import metrics_json, prepare_folder, simulate_to_folder
    from sdc_taichi.run.optimum_folder import FOLDER, write_optimum
    from sdc_taichi.run.rack_history import RACK_HISTORY_FILE, check_history, history_request
    from sdc_taichi.sim.events import require_events_start_before
    from sdc_taichi.sim.fleet import build_fleet
    from sdc_taichi.sim.simulator import Simulator

    base, label = config.read()
    configs = sites.data_centers(base, start=start, dcs=dcs, sample=sample, seed=run.seed)
    fleet = build_fleet(configs)
    steps = whole_steps(days, fleet.steps_per_hour, "--days")
    request = RunRequest(controller, steps, run.seed, run.error())
    require_events_start_before(24.0 * days, fleet.configs)
    driver = make_controller(controller, fleet)
    objective = None if optimum is None else Objective.parse(optimum)
    history = history_request(recording.racks, rack_history)
    recorder = recording.recorder()
    folder = out if out is not None else _default_folder(label, configs)
    with Simulator(fleet, precision=run.precision) as sim:
        print_notes(sim.drivers.notes)
        with interruptible() as interrupted, _recorded(recorder, sim, request) as record_step:
            prepare_folder(folder, force=force)
            if history is not None:
                check_history(history, fleet, steps, folder)
            best = (
                None
                if objective is None
                else solve_beside(
                    sim,
                    objective=objective,
                    steps=steps,
                    seed=run.seed,
                    quiet=quiet,
                    stop=interrupted,
                )
            )
            with progress_bar(steps, shown=not quiet) as advance:

                def after_step(result: StepResult) -> None:
                    record_step(result)
                    advance(result)

                metrics = simulate_to_folder(
                    sim,
                    driver,
                    request,
                    folder,
                    force=force,
                    history=history,
                    optimum=best,
                    on_step=after_step,
                    stop=interrupted,
                )
            if metrics is None:
                print("interrupted before the first step; nothing written", file=sys.stderr)
                raise typer.Exit(EXIT_INTERRUPTED)
            is_whole = metrics["steps_done"] == steps
            if best is not None and is_whole:
                is_whole = write_optimum(
                    sim, best, folder / FOLDER, seed=run.seed, stop=interrupted
                )
            if as_json:
                print(metrics_json(metrics))
            elif not quiet:
                print_summary(metrics, label, folder, fleet.steps_per_hour)
                if history is not None:
                    file = folder / RACK_HISTORY_FILE
                    print(f"Racks: {printable(file)} ({file.stat().st_size / 1e6:.3g} MB)")
                _print_recording(recorder)
            _serve_until_interrupted(recorder, interrupted)
    if not is_whole:
        done = metrics["steps_done"]
        where = f"after {done} of {steps} steps; {printable(folder)} holds the steps done"
        if done == steps:
            where = f"after the run; {printable(folder)} holds it without the path of the optimum"
        print(f"interrupted {where}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED)


def _default_folder(label: str, configs: Sequence[DataCenterConfig]) -> Path:
    """Return the run folder for a run without ``--out``, named by preset, sites and first day."""
    from sdc_taichi.sim.fleet_configs import place_names

    sites = list(dict.fromkeys(place_names(configs)))
    where = "-".join(sites) if len(sites) <= 4 else f"{len(sites)}sites"
    return Path("runs") / f"{Path(label).stem}-{where}-{configs[0].site.start}"


@contextlib.contextmanager
def _recorded(
    recorder: Recorder | None, sim: Simulator, request: RunRequest
) -> Iterator[Callable[[StepResult], None]]:
    """Record a run, if there is a recorder.

    Args:
        recorder: the recorder; None records nothing.
        sim: the simulator, before its first step.
        request: controller, length and seed of the run.

    Yields:
        A function to call with the result of every step.
    """
    if recorder is None:
        yield lambda _: None
        return
    from sdc_taichi.run.description import describe_run

    with recorder:
        recorder.begin(sim, describe_run(sim, request))
        if recorder.served_address is not None:
            command = f"sdc-taichi view {recorder.served_address}"
            print(f"serving the run; watch it with: {command} [--web]", file=sys.stderr)
        yield recorder.add


def _print_recording(recorder: Recorder | None) -> None:
    """Print the path of the recording file of a run, if there is one."""
    if recorder is not None and recorder.file is not None and not recorder.failed:
        file = printable(recorder.file)
        print(f"Recording: {file} (open with: sdc-taichi view {file})")


def _serve_until_interrupted(recorder: Recorder | None, interrupted: Callable[[], bool]) -> None:
    """Serve the recording of a finished run until Ctrl-C; without ``--serve`` do nothing."""
    if recorder is None or recorder.served_address is None or recorder.failed:
        return
    recorder.flush()
    if not interrupted():
        text = f"the run is finished and still served at {recorder.served_address}; Ctrl-C ends it"
        print(text, file=sys.stderr)
    while not interrupted():
        time.sleep(0.1)
