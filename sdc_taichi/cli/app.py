"""The command ``sdc-taichi``: simulate, look at configurations, manage data."""

from __future__ import annotations

import contextlib
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TextIO

import typer
import typer.core

import sdc_taichi
from sdc_taichi.cli.arguments import Overrides, Source, read_config
from sdc_taichi.cli.data import data_app
from sdc_taichi.cli.hall import hall_app
from sdc_taichi.cli.report import report_command
from sdc_taichi.cli.view import view_command
from sdc_taichi.config import (
    DataCenterConfig,
    load_config,
    load_yaml,
    preset_names,
)
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.year_clock import day_of_year

if TYPE_CHECKING:
    from rich.table import Table

    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.sim.simulator import Simulator
    from sdc_taichi.types import StepResult
    from sdc_taichi.viz.recorder import Recorder

EXIT_FAILURE, EXIT_INPUT, EXIT_INTERRUPTED = 1, 2, 130
MAX_DCS = 100_000
TABLE_DCS = 12
"""Up to this many data centers have a column of their own in the summary."""

EVENT_LINES = 8
"""Up to this many events are listed in the summary."""

_SUMMARY = (
    ("IT energy (kWh)", "it_kwh"),
    ("HVAC energy (kWh)", "hvac_kwh"),
    ("facility energy (kWh)", "facility_kwh"),
    ("grid energy (kWh)", "grid_kwh"),
    ("PUE", "pue"),
    ("PUE with UPS losses", "pue_with_ups"),
    ("WUE (L/kWh)", "wue_l_per_kwh"),
    ("CUE (kg/kWh)", "cue_kg_per_kwh"),
    ("CFP (kg CO2e)", "cfp_kg"),
    ("water (L)", "water_l"),
    ("mean queue (tasks)", "queue_mean_tasks"),
    ("longest queue (tasks)", "queue_max_tasks"),
    ("dropped (tasks)", "dropped_tasks"),
    ("overdue (task hours)", "overdue_task_h"),
    ("hottest inlet (C)", "hottest_inlet_c"),
    ("inlet above 27 C (h)", "inlet_above_27_h"),
    ("inlet over 27 C (degree hours per server)", "over_27_degree_h"),
    ("SHI", "shi"),
    ("RTI (%)", "rti_pct"),
    ("RCI hi (%)", "rci_hi_pct"),
    ("RCI lo (%)", "rci_lo_pct"),
    ("lost (tasks)", "lost_tasks"),
    ("unserved energy (kWh)", "unserved_kwh"),
    ("battery throughput (kWh)", "battery_throughput_kwh"),
)


class _Commands(typer.core.TyperGroup):
    """Turns errors into one line and an exit code."""

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> Any:
        given = sys.argv[1:] if args is None else list(args)
        extra["standalone_mode"] = False
        try:
            code = super().main(args, *more, **extra)
        except Exception as error:
            if "--debug" in given:
                traceback.print_exc()
            code = _report_error(error)
        sys.exit(code if isinstance(code, int) else 0)


app = typer.Typer(
    cls=_Commands,
    name="sdc-taichi",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
config_app = typer.Typer(help="Show and check configurations.", no_args_is_help=True)
app.add_typer(config_app, name="config")
app.add_typer(data_app, name="data")
app.add_typer(hall_app, name="hall")
app.command("report")(report_command)
app.command("view")(view_command)

Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")]


def main() -> None:
    """Entry point of the console script."""
    app()


def _show_version(asked: bool) -> None:
    if asked:
        print(f"sdc-taichi {sdc_taichi.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", is_eager=True, callback=_show_version
        ),
    ] = False,
    debug: Debug = False,
) -> None:
    """Simulate data centers: workload, cooling, battery, carbon, and every server's air."""


@app.command()
def simulate(
    source: Source = None,
    site: Annotated[
        str | None,
        typer.Option(metavar="SITE[,SITE...]", help="Sites, one data center each (see data list)."),
    ] = None,
    days: Annotated[float, typer.Option(help="Length, in days; may exceed a year.")] = 365.0,
    start: Annotated[
        str | None, typer.Option(metavar="MM-DD", help="First day, local standard time.")
    ] = None,
    dcs: Annotated[
        int | None,
        typer.Option(min=1, max=MAX_DCS, help="Number of data centers; sites are dealt in turn."),
    ] = None,
    controller: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="idle, random, g36, coldest, warmest, constant:C, lookahead-3h, lookahead-24h, "
            "greedy-ci; or per agent, such as load=greedy-ci,cooling=g36,battery=lookahead-24h.",
        ),
    ] = "idle",
    seed: Annotated[
        int, typer.Option(min=0, help="Of controller and --sample (not of the synthetic year).")
    ] = 0,
    precision: Annotated[
        Literal["f32", "f64"], typer.Option(help="Of the per-server kernels.")
    ] = "f32",
    overrides: Overrides = None,
    sample: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="YAML of fields to vary between data centers."),
    ] = None,
    weather: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="EPW file; repeated, one per site in their order."),
    ] = None,
    carbon: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="Carbon-intensity CSV; repeated, one per site."),
    ] = None,
    workload: Annotated[
        list[str] | None,
        typer.Option(metavar="FILE", help="Workload CSV for all sites; or repeated, one per site."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Output folder. [default: runs/PRESET-SITES-START]"),
    ] = None,
    recording: Annotated[
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
    force: Annotated[
        bool, typer.Option("--force", help="Write into a folder with other files.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print metrics.json instead of the summary.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Simulate data centers and record every step.

    Writes steps.parquet, metrics.json and the configuration to the output folder. Ctrl-C ends the
    run and leaves whole files of the steps done. Without weather, carbon or workload files the
    inputs are synthetic years.
    """
    from sdc_taichi.control import make_controller
    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.run.folder_writer import metrics_json, prepare_folder, simulate_to_folder
    from sdc_taichi.sim.fleet import build_fleet
    from sdc_taichi.sim.simulator import Simulator

    base, label = read_config(source, overrides)
    configs = _data_centers(base, site, start, dcs, sample, seed)
    configs = _with_files(configs, _site_names(site), weather, carbon, workload)
    fleet = build_fleet(configs)
    asked = RunRequest(controller, _whole_steps(days, fleet.steps_per_hour), seed)
    driver = make_controller(controller, fleet)
    recorder = _recorder(recording, focus, every, serve, serve_port)
    folder = out if out is not None else _default_folder(label, configs)
    with Simulator(fleet, precision=precision) as sim:
        for note in sim.drivers.notes:
            print(f"note: {note}", file=sys.stderr)
        with _interruptible() as interrupted, _recording(recorder, sim, asked):
            prepare_folder(folder, force=force)
            with _progress(asked.steps, shown=not quiet) as advance:

                def each(result: StepResult) -> None:
                    if recorder is not None:
                        recorder.add(result)
                    advance(result)

                content = simulate_to_folder(
                    sim, driver, asked, folder, force=force, on_step=each, stop=interrupted
                )
            if content is None:
                print("interrupted before the first step; nothing written", file=sys.stderr)
                raise typer.Exit(EXIT_INTERRUPTED)
            if as_json:
                print(metrics_json(content))
            elif not quiet:
                _print_summary(content, label, folder, sim.fleet.steps_per_hour)
                if recorder is not None and recorder.file is not None and not recorder.lost:
                    print(
                        f"Recording: {recorder.file} (open with: sdc-taichi view {recorder.file})"
                    )
            if recorder is not None and recorder.served is not None and not recorder.lost:
                recorder.flush()
                _wait(interrupted, recorder.served)
    if content["steps_done"] < asked.steps:
        print(
            f"interrupted after {content['steps_done']} of {asked.steps} steps; {folder} holds the "
            "steps done",
            file=sys.stderr,
        )
        raise typer.Exit(EXIT_INTERRUPTED)


@config_app.command("show")
def show_config(source: Source = None, overrides: Overrides = None) -> None:
    """Print a configuration in full, as YAML that can be read back."""
    config, _ = read_config(source, overrides)
    print(config.to_yaml(), end="")


@config_app.command("check")
def check_config(source: Source = None, overrides: Overrides = None) -> None:
    """Check a configuration and the inputs it names, without simulating."""
    from sdc_taichi.sim.drivers import load_drivers
    from sdc_taichi.sim.fleet import build_fleet

    config, label = read_config(source, overrides)
    fleet = build_fleet(config)
    drivers = load_drivers(fleet.configs)
    for note in drivers.notes:
        print(f"note: {note}", file=sys.stderr)
    nameplate_kw = sum(g.count * g.full_w for rack in config.rack_groups() for g in rack) / 1e3
    print(
        f"{label}: valid; {fleet.racks} racks, {fleet.servers:,} servers, {nameplate_kw:,.6g} kW "
        f"nameplate, site {config.site.location}"
    )


@config_app.command("list")
def list_configs() -> None:
    """List the presets."""
    names = preset_names()
    width = max(map(len, names))
    for name in names:
        print(f"{name:<{width}}  {load_config(name).description}")


def _report_error(error: Exception) -> int:
    """Print one line on stderr and return the exit code."""
    if isinstance(error, typer.TyperException):
        # Empty when help was shown because nothing was asked.
        text, code = error.format_message(), error.exit_code
    elif isinstance(error, SdcError):
        text, code = str(error), EXIT_INPUT
    else:
        text = f"{type(error).__name__}: {error} (unexpected; --debug shows where)"
        code = EXIT_FAILURE
    line = " ".join(text.split())
    if line:
        print(f"error: {line}", file=sys.stderr)
    return code


def _site_names(site: str | None) -> list[str]:
    if site is None:
        return []
    names = [name.strip() for name in site.split(",")]
    folded = [name.casefold() for name in names]
    if not all(names):
        raise ConfigError(f"--site {site!r}: an empty name; valid is SITE or SITE,SITE")
    for index, name in enumerate(folded):
        if name in folded[:index]:
            raise ConfigError(
                f"--site {site!r}: {names[index]} is given twice; valid is each site once "
                "(--dcs makes copies)"
            )
    return names


def _data_centers(
    base: DataCenterConfig,
    site: str | None,
    start: str | None,
    dcs: int | None,
    sample: Path | None,
    seed: int,
) -> list[DataCenterConfig]:
    from sdc_taichi.sim.fleet import make_configs

    if start is not None:
        try:
            day_of_year(start)
        except ValueError as error:
            raise ConfigError(f"--start: {error}") from None
        moved = base.site.model_copy(update={"start": start.strip()})
        base = base.model_copy(update={"site": moved})
    rules = None if sample is None else _read_sample(sample)
    try:
        return make_configs(base, count=dcs, sites=_site_names(site), sample=rules, seed=seed)
    except ConfigError as error:
        if sample is None:
            raise
        raise ConfigError(f"{sample}: {error}") from None


def _read_sample(path: Path) -> dict[str, Any]:
    try:
        rules = load_yaml(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML ({error})") from None
    wrong = [name for name in rules if not isinstance(name, str)] if isinstance(rules, dict) else []
    if not isinstance(rules, dict) or wrong:
        found = f"key {wrong[0]!r}" if wrong else f"the top level is a {type(rules).__name__}"
        raise ConfigError(
            f"{path}: {found}; valid is a mapping of fields, such as hvac.chiller.reference_cop, "
            "to {uniform: [low, high]} or {choice: [a, b]}"
        )
    return rules


def _with_files(
    configs: list[DataCenterConfig],
    sites: list[str],
    weather: list[str] | None,
    carbon: list[str] | None,
    workload: list[str] | None,
) -> list[DataCenterConfig]:
    """Give every data center the files of its site."""
    count = max(len(sites), 1)
    files = {"weather_file": weather, "carbon_file": carbon, "workload_file": workload}
    for field, paths in files.items():
        if not paths:
            continue
        shared = field == "workload_file" and len(paths) == 1
        if len(paths) != count and not shared:
            option = field.removesuffix("_file")
            raise ConfigError(
                f"--{option}: {len(paths)} given for {count} of --site; valid is one per site, in "
                "their order"
            )
        absolute = [str(Path(path).absolute()) for path in paths]
        configs = [
            config.model_copy(
                update={"site": config.site.model_copy(update={field: absolute[i % len(absolute)]})}
            )
            for i, config in enumerate(configs)
        ]
    return configs


def _whole_steps(days: float, steps_per_hour: int) -> int:
    per_day = 24 * steps_per_hour
    steps = days * per_day
    if not 0 < steps < 1e12 or abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
        raise ConfigError(
            f"--days {days:g}: valid is a positive number of days that makes whole steps of "
            f"{60 // steps_per_hour} min, that is n/{per_day}"
        )
    return round(steps)


def _default_folder(label: str, configs: Sequence[DataCenterConfig]) -> Path:
    sites = list(dict.fromkeys(c.site.location.lower() for c in configs))
    where = "-".join(sites) if len(sites) <= 4 else f"{len(sites)}sites"
    return Path("runs") / f"{Path(label).stem}-{where}-{configs[0].site.start}"


@contextlib.contextmanager
def _interruptible() -> Iterator[Callable[[], bool]]:
    """Whether the run was asked to end; a second request ends it at once."""
    asked: list[int] = []

    def handle(number: int, _frame: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)

    before = {s: signal.signal(s, handle) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _recorder(
    target: str | None, focus: str | None, every: int | None, serve: bool, port: int | None
) -> Recorder | None:
    """None without a recording."""
    from sdc_taichi.viz.streams import DEFAULT_PORT, is_address

    if serve or port is not None:
        port = DEFAULT_PORT if port is None else port
    elif target is None:
        for name, value in (("--focus", focus), ("--every", every)):
            if value is not None:
                raise ConfigError(
                    f"{name}: given without a recording; valid with --record, --serve"
                )
        return None
    from sdc_taichi.viz.recorder import Recorder

    if target is not None and target.endswith(".rrd") and not is_address(target):
        with contextlib.suppress(OSError):  # the recorder says what is wrong with it
            Path(target).parent.mkdir(parents=True, exist_ok=True)
    names = None if focus is None else [name.strip() for name in focus.split(",")]
    return Recorder(target, focus=names, every=every, serve_port=port)


@contextlib.contextmanager
def _recording(recorder: Recorder | None, sim: Simulator, asked: RunRequest) -> Iterator[None]:
    """Record while the context lasts, if there is a recorder."""
    if recorder is None:
        yield
        return
    from sdc_taichi.run.description import describe_run
    from sdc_taichi.viz.streams import RecordingWarning

    with warnings.catch_warnings(), recorder:
        warnings.simplefilter("always", RecordingWarning)
        warnings.showwarning = _show_warning
        recorder.begin(sim, describe_run(sim, asked))
        if recorder.served is not None:
            command = f"sdc-taichi view {recorder.served}"
            print(f"serving the run; watch it with: {command} [--web]", file=sys.stderr)
        yield


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    print(f"warning: {message}", file=sys.stderr)


def _wait(ended: Callable[[], bool], address: str) -> None:
    """Until Ctrl-C."""
    if not ended():
        print(f"the run is done and still served at {address}; Ctrl-C ends it", file=sys.stderr)
    while not ended():
        time.sleep(0.1)


@contextlib.contextmanager
def _progress(steps: int, *, shown: bool) -> Iterator[Callable[[StepResult], None]]:
    """A progress bar on stderr, if that is a terminal."""
    if not shown or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    every = max(1, steps // 1000)
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=steps)

        def advance(result: StepResult) -> None:
            if result.step % every == 0:
                progress.update(task, completed=result.step + 1)

        yield advance


def _print_summary(report: dict[str, Any], label: str, folder: Path, steps_per_hour: int) -> None:
    from rich.console import Console

    # A pipe or a file has no width to fit into.
    console = Console(
        markup=False, highlight=False, width=None if sys.stdout.isatty() else 200, soft_wrap=True
    )
    dcs, steps = report["data_centers"], report["steps_done"]
    days = steps / steps_per_hour / 24
    count = "1 data center" if len(dcs) == 1 else f"{len(dcs)} data centers"
    console.print(
        f"{label}: {count}, {days:g} days from {dcs[0]['start']} ({steps} steps of "
        f"{60 // steps_per_hour} min), controller {report['controller']}"
    )
    table = _per_dc_table(report)
    if len(dcs) > TABLE_DCS or console.measure(table).maximum > console.width:
        table = _aggregate_table(report)
    console.print(table)
    console.print(_hottest_line(report))
    for line in _event_lines(report):
        console.print(line)
    if report["synthetic"]:
        console.print("These figures rest on SYNTHETIC inputs, not on measurements:")
    sources = dict.fromkeys(
        f"{kind}: {source}" for dc in dcs for kind, source in dc["provenance"].items()
    )
    for line in sorted(sources)[:TABLE_DCS]:
        console.print(f"  {line}")
    if len(sources) > TABLE_DCS:
        console.print(f"  and {len(sources) - TABLE_DCS} more, see metrics.json")
    config_file = "config.yaml" if len(dcs) == 1 else "configs.yaml"
    console.print(f"Files in {folder}: steps.parquet, metrics.json, {config_file}")


def _hottest_line(report: dict[str, Any]) -> str:
    total = report["total"]
    where = f"{total['hottest_dc']}, " if len(report["data_centers"]) > 1 else ""
    return (
        f"Hottest inlet: {total['hottest_inlet_c']:.1f} C at {where}row {total['hottest_row']}, "
        f"rack {total['hottest_rack']}, server {total['hottest_server']} from the floor, step "
        f"{total['hottest_step']}"
    )


def _event_lines(report: dict[str, Any]) -> list[str]:
    lines = []
    for dc in report["data_centers"]:
        for event in dc["events"]:
            target = f" {event['target']}" if "target" in event else ""
            amount = f", {event['share']:.0%} left" if "share" in event else ""
            amount += f", {event['offset_k']:+g} K" if "offset_k" in event else ""
            lines.append(
                f"Event: {dc['name']}: {event['kind']}{target}{amount}, steps "
                f"{event['start_step']}..{event['end_step'] - 1}"
            )
    if len(lines) > EVENT_LINES:
        lines[EVENT_LINES:] = [f"and {len(lines) - EVENT_LINES} more events, see metrics.json"]
    return lines


def _per_dc_table(report: dict[str, Any]) -> Table:
    from rich.table import Table

    dcs = report["data_centers"]
    several = len(dcs) > 1
    table = Table("")
    for dc in dcs:
        table.add_column(dc["name"], justify="right", no_wrap=True)
    if several:
        table.add_column("all", justify="right", no_wrap=True)
    for title, name in _SUMMARY:
        values = [dc["metrics"][name] for dc in dcs] + ([report["total"][name]] if several else [])
        table.add_row(title, *map(_figure, values))
    return table


def _aggregate_table(report: dict[str, Any]) -> Table:
    from rich.table import Table

    table = Table("")
    for column in ("lowest", "mean", "highest", "all"):
        table.add_column(column, justify="right", no_wrap=True)
    for title, name in _SUMMARY:
        values = [dc["metrics"][name] for dc in report["data_centers"]]
        known = [v for v in values if v is not None]
        spread = [min(known), sum(known) / len(known), max(known)] if known else [None] * 3
        table.add_row(title, *map(_figure, [*spread, report["total"][name]]))
    return table


def _figure(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
