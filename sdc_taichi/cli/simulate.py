"""``sdc-taichi simulate``: simulate data centers under a controller and write a run folder."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sdc_taichi.cli.arguments import (
    Debug,
    Overrides,
    Source,
    force_option,
    json_option,
    out_option,
    read_config,
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
from sdc_taichi.config import DataCenterConfig, load_yaml
from sdc_taichi.errors import ConfigError, printable
from sdc_taichi.exogenous.year_clock import day_of_year
from sdc_taichi.user_file import MOST_CONFIG_BYTES, read_text

if TYPE_CHECKING:
    from sdc_taichi.types import StepResult

EXIT_INTERRUPTED = 130
"""Exit code of a run that Ctrl-C ended."""
MOST_DAYS = 36_500
"""Longest run, in days: a century."""
MAX_DCS = 100_000
"""Largest number of data centers of ``--dcs``."""


def simulate_command(
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
        int,
        typer.Option(
            min=0, max=2**63 - 1, help="Of controller and --sample (not of the synthetic year)."
        ),
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
    force: Annotated[bool, force_option("Write into a folder with other files.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")] = False,
    as_json: Annotated[bool, json_option("Print metrics.json instead of the summary.")] = False,
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
    from sdc_taichi.sim.events import require_events_start_before
    from sdc_taichi.sim.fleet import build_fleet
    from sdc_taichi.sim.simulator import Simulator

    base, label = read_config(source, overrides)
    sites = _site_names(site)
    files = _files_of_sites(sites, weather, carbon, workload)
    configs = _data_centers(base, sites, files, start, dcs, sample, seed)
    fleet = build_fleet(configs)
    request = RunRequest(controller, _whole_steps(days, fleet.steps_per_hour), seed)
    require_events_start_before(24.0 * days, fleet.configs)
    driver = make_controller(controller, fleet)
    recorder = make_recorder(record, focus, every, serve, serve_port)
    folder = out if out is not None else _default_folder(label, configs)
    with Simulator(fleet, precision=precision) as sim:
        print_notes(sim.drivers.notes)
        with interruptible() as interrupted, recording(recorder, sim, request) as record_step:
            prepare_folder(folder, force=force)
            with progress_bar(request.steps, shown=not quiet) as advance:

                def after_step(result: StepResult) -> None:
                    record_step(result)
                    advance(result)

                metrics = simulate_to_folder(
                    sim, driver, request, folder, force=force, on_step=after_step, stop=interrupted
                )
            if metrics is None:
                print("interrupted before the first step; nothing written", file=sys.stderr)
                raise typer.Exit(EXIT_INTERRUPTED)
            if as_json:
                print(metrics_json(metrics))
            elif not quiet:
                print_summary(metrics, label, folder, fleet.steps_per_hour)
                print_recording(recorder)
            serve_until_interrupted(recorder, interrupted)
    if metrics["steps_done"] < request.steps:
        print(
            f"interrupted after {metrics['steps_done']} of {request.steps} steps; "
            f"{printable(folder)} holds "
            "the steps done",
            file=sys.stderr,
        )
        raise typer.Exit(EXIT_INTERRUPTED)


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
    sites: list[str],
    files: Mapping[str, list[str]],
    start: str | None,
    dcs: int | None,
    sample: Path | None,
    seed: int,
) -> list[DataCenterConfig]:
    """Configs of ``--site``, ``--dcs`` and ``--sample`` that read the files of their sites."""
    from sdc_taichi.sim.fleet_configs import make_configs

    if start is not None:
        try:
            day_of_year(start)
        except ValueError as error:
            raise ConfigError(f"--start: {error}") from None
        base = _with_site(base, start=start.strip())
    # Files of a site are its own, and without sites there is one of each.
    base = _with_site(base, **{field: None if sites else of[0] for field, of in files.items()})
    rules = None if sample is None else _read_sample(sample)
    try:
        configs = make_configs(base, count=dcs, sites=sites, sample=rules, seed=seed)
    except ConfigError as error:
        if sample is None:
            raise
        raise ConfigError(f"{sample}: {error}") from None
    return [
        _with_site(config, **{field: of[i % len(of)] for field, of in files.items()})
        for i, config in enumerate(configs)
    ]


def _with_site(config: DataCenterConfig, **update: str | None) -> DataCenterConfig:
    site = config.site.model_copy(update=update)
    return config.model_copy(update={"site": site})


def _read_sample(path: Path) -> dict[str, Any]:
    text = read_text(path, MOST_CONFIG_BYTES, ConfigError)
    try:
        rules = load_yaml(text)
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


def _files_of_sites(
    sites: list[str],
    weather: list[str] | None,
    carbon: list[str] | None,
    workload: list[str] | None,
) -> dict[str, list[str]]:
    """Fields of ``site`` that files are given for, and the files, one per site or one for all."""
    count = max(len(sites), 1)
    given = {"weather_file": weather, "carbon_file": carbon, "workload_file": workload}
    found = {}
    for field, paths in given.items():
        if not paths:
            continue
        shared = field == "workload_file" and len(paths) == 1
        if len(paths) != count and not shared:
            option = field.removesuffix("_file")
            raise ConfigError(
                f"--{option}: {len(paths)} given for {count} of --site; valid is one per site, in "
                "their order"
            )
        found[field] = [str(Path(path).absolute()) for path in paths]
    return found


def _whole_steps(days: float, steps_per_hour: int) -> int:
    per_day = 24 * steps_per_hour
    steps = days * per_day
    if not 0 < days <= MOST_DAYS or abs(steps - round(steps)) > 1e-6 or round(steps) < 1:
        raise ConfigError(
            f"--days {days:g}: valid is a positive number of days, at most {MOST_DAYS:,}, that "
            f"makes whole steps of {60 // steps_per_hour} min, that is n/{per_day}"
        )
    return round(steps)


def _default_folder(label: str, configs: Sequence[DataCenterConfig]) -> Path:
    from sdc_taichi.sim.fleet_configs import place_names

    sites = list(dict.fromkeys(place_names(configs)))
    where = "-".join(sites) if len(sites) <= 4 else f"{len(sites)}sites"
    return Path("runs") / f"{Path(label).stem}-{where}-{configs[0].site.start}"
