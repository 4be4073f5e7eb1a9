"""``sdc-taichi sweep``: run all combinations of config values, sites, months and controllers."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdc_taichi.cli.jobs import JobOptions, job_session
from sdc_taichi.cli.options import (
    ConfigOptions,
    ForecastRunOptions,
    Quiet,
    Site,
    Start,
    controllers_option,
    out_option,
    site_names,
    with_start,
)
from sdc_taichi.cli.terminal import EXIT_FAILURE, first_lines, print_notes, print_table
from sdc_taichi.errors import ConfigError, SdcError, one_line, printable

if TYPE_CHECKING:
    from sdc_taichi.benchmark.jobs import Job
    from sdc_taichi.benchmark.store import ResultStore
    from sdc_taichi.benchmark.sweep import Sweep
    from sdc_taichi.config import DataCenterConfig

_MOST_LINES = 10
"""Largest number of printed reasons for failed runs."""


def sweep_command(
    context: typer.Context,
    *,
    config: ConfigOptions,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=VALUES",
            help="Field to vary: A,B,C, or START:STOP:STEP, or LOW..HIGH to draw samples from; "
            "repeatable.",
        ),
    ] = None,
    site: Site = None,
    months: Annotated[
        str | None,
        typer.Option(
            metavar="all|N,N", help="Months, each a run of its own. [default: one run of --days]"
        ),
    ] = None,
    days: Annotated[
        float | None,
        typer.Option(help="Length of each run, in days. [default: the month, or 365]"),
    ] = None,
    start: Start = None,
    controller: Annotated[
        list[str] | None,
        controllers_option("Controller, as of simulate; repeatable. [default: idle]"),
    ] = None,
    sample: Annotated[
        int, typer.Option(metavar="N", min=0, help="Samples of the fields with LOW..HIGH.")
    ] = 0,
    run: ForecastRunOptions,
    best: Annotated[
        str | None,
        typer.Option(
            metavar="METRIC",
            help="Also find the value with the lowest metric in each month, such as cfp_kg.",
        ),
    ] = None,
    batch: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=100_000,
            help="Most data centers that run as one job. [default: 1024, fewer with large halls]",
        ),
    ] = None,
    most: Annotated[int, typer.Option(min=1, help="Most runs; a sweep of more is refused.")] = (
        100_000
    ),
    jobs: JobOptions,
    out: Annotated[
        Path | None, out_option("Output folder. [default: sweeps/PRESET-FIELDS]", "DIR")
    ] = None,
    show: Annotated[bool, typer.Option("--show", help="Print what would run, and end.")] = False,
    quiet: Quiet = False,
) -> None:
    """Run all combinations of values, sites, months and controllers, and store their metrics.

    Writes a Parquet dataset with a row for each run. Ctrl-C ends the sweep, and --resume continues
    it. Combinations that are not valid are reported, and the others run.
    """
    from sdc_taichi.benchmark.store import RESULTS, ResultStore, Study
    from sdc_taichi.benchmark.sweep import check_sweep, sweep_inputs, sweep_jobs

    base, label = config.read()
    if start is not None and months is not None:
        raise ConfigError(
            f"--start {start} with --months {months}: a month starts on its first day; valid is "
            "one of the two"
        )
    sweep = _sweep(
        with_start(base, start),
        vary or [],
        site,
        most,
        samples=sample,
        controllers=tuple(controller or ["idle"]),
        months=_months(months),
        days=days,
        seed=run.seed,
        forecast_error=run.error(),
        precision=run.precision,
        batch=batch,
    )
    if best is not None:
        sweep = _with_best(sweep, best)
    check_sweep(sweep, most)
    inputs = sweep_inputs(sweep)
    partitions = [dict(job.partition) for job in sweep_jobs(sweep, inputs)]
    if show:
        print(_shown(sweep, label, len(partitions)), end="")
        return
    folder = out if out is not None else _default_folder(label, sweep)
    store = ResultStore(folder)
    command = shlex.join(["sdc-taichi", *context.obj])
    study = Study(kind="sweep", command=command, settings=sweep.settings(), partitions=partitions)
    with job_session(store, study, jobs, quiet=quiet) as under_way:
        under_way.run("sweep", sweep_jobs(sweep, inputs), len(partitions), inputs)
        done, failed = _print_failures(store, sweep_jobs(sweep, inputs))
        if under_way.is_whole:
            if not quiet:
                place = printable(folder / RESULTS)
                print(f"{done:,} of {sweep.runs:,} runs have their rows in {place}")
            if best is not None and done:
                _write_best(store, sweep, best, quiet=quiet)
        under_way.finish()
    if failed:
        raise typer.Exit(EXIT_FAILURE)


def _sweep(
    config: DataCenterConfig,
    vary: list[str],
    site: str | None,
    most: int,
    **options: Any,
) -> Sweep:
    """Create the sweep for the options of the command.

    Args:
        config: base config of all runs.
        vary: values of ``--vary``.
        site: value of ``--site``; its sites are values of the field ``site.location``.
        most: largest number of runs.
        options: further arguments of ``Sweep``.
    """
    from sdc_taichi.benchmark.sweep import Sweep
    from sdc_taichi.benchmark.vary import Grid, parse_vary

    varied = [parse_vary(text, config, most) for text in vary]
    sites = tuple(name.upper() for name in site_names(site))
    if sites:
        varied.insert(0, Grid("site.location", sites))
    sweep = Sweep(config, tuple(varied), **options)
    if not sweep.varied and sweep.runs == 1:
        raise ConfigError(
            "sweep: nothing varies; valid is --vary FIELD=VALUES, --site, --months, or more than "
            "one --controller"
        )
    return sweep


def _months(text: str | None) -> tuple[int, ...]:
    """Parse the value of ``--months``; an absent option gives an empty tuple."""
    if text is None:
        return ()
    if text.strip() == "all":
        return tuple(range(1, 13))
    months: list[int] = []
    for part in (part.strip() for part in text.split(",")):
        if not part.isascii() or not part.isdecimal() or not 1 <= int(part) <= 12:
            raise ConfigError(
                f"--months {text!r}: {part!r}; valid are all, or months 1..12 such as 1,7"
            )
        if int(part) in months:
            raise ConfigError(f"--months {text!r}: {part} is given twice; valid is each once")
        months.append(int(part))
    return tuple(months)


def _with_best(sweep: Sweep, metric: str) -> Sweep:
    """Return the sweep with the configured value of the varied field added to its values.

    Raises:
        ConfigError: the metric of ``--best`` is unknown, or there is no field to choose for.
    """
    from sdc_taichi.benchmark.best_value import with_default
    from sdc_taichi.benchmark.sweep import metric_names
    from sdc_taichi.errors import suggestion_or_valid

    names = metric_names(sweep.config)
    if metric not in names:
        raise ConfigError(f"--best {metric!r}: unknown metric{suggestion_or_valid(metric, names)}")
    return with_default(sweep)


def _shown(sweep: Sweep, label: str, jobs: int) -> str:
    """Return size and settings of a sweep as YAML, for ``--show``."""
    import yaml

    settings = sweep.settings() | {"config": label}
    counts = {"runs": sweep.runs, "combinations": sweep.combinations, "jobs": jobs}
    return yaml.safe_dump({**counts, **settings}, sort_keys=False)


def _default_folder(label: str, sweep: Sweep) -> Path:
    """Return the folder for a sweep without ``--out``, named by preset and varied fields."""
    fields = [field.rpartition(".")[2] for field in sweep.fields]
    return Path("sweeps") / "-".join([Path(label).stem, *fields])


def _print_failures(store: ResultStore, jobs: Iterable[Job]) -> tuple[int, int]:
    """Print the distinct reasons for failed runs on stderr.

    Returns:
        Number of runs with results, and number of failed runs in finished jobs.
    """
    from sdc_taichi.benchmark.sweep import stored_metrics

    runs = 0
    reasons: dict[str, list[str]] = {}
    notes: dict[str, None] = {}
    for count, metrics in stored_metrics(store, jobs):
        runs += count
        notes |= dict.fromkeys(metrics.notes)
        for failure in metrics.failed:
            reasons.setdefault(failure.error, []).append(failure.combination)
    print_notes(notes)
    lines = [
        one_line(f"{' '.join(first_lines(combinations, 1, ''))}: {error}")
        for error, combinations in reasons.items()
    ]
    for line in first_lines(lines, _MOST_LINES, " reasons, in metrics.json of the jobs"):
        print(f"failed: {line}", file=sys.stderr)
    failed = sum(map(len, reasons.values()))
    return runs - failed, failed


def _write_best(store: ResultStore, sweep: Sweep, metric: str, *, quiet: bool) -> None:
    """Write and print the best value of a field by month, with a picture if matplotlib is there.

    Args:
        store: folder of the results of the sweep.
        sweep: the sweep.
        metric: name of the metric to minimise.
        quiet: True to print nothing.
    """
    from sdc_taichi.atomic_file import atomic_write
    from sdc_taichi.benchmark.best_value import (
        best_by_month,
        chosen_grid,
        figures_by_month,
        group_columns,
    )
    from sdc_taichi.benchmark.vary import value_at
    from sdc_taichi.learning.evaluation_table import markdown
    from sdc_taichi.viz.fleet_figures import MonthlyFigures, plot_best_values
    from sdc_taichi.viz.plotting import save_picture

    field = chosen_grid(sweep).field
    rows = store.rows([*group_columns(sweep), "month", field, metric], [field, metric])
    table = best_by_month(rows, sweep, metric)
    if not len(table):
        print_notes(["no value has a run in each month, so none is best"])
        return
    texts = {"best.csv": table.to_csv(index=False), "best.md": markdown(table) + "\n"}
    for name, text in texts.items():
        with atomic_write(store.folder / name) as file:
            file.write(text.encode())
    names = [*texts, "best.png"]
    configured = value_at(sweep.config, field)
    default = configured if isinstance(configured, int | float) else None
    panels = [MonthlyFigures(*each) for each in figures_by_month(rows, sweep, metric)]
    try:
        picture = plot_best_values(panels, field, metric, default)
        save_picture(picture, store.folder / names[-1])
    except SdcError as error:
        print_notes([f"no picture: {error}"])
        names.pop()
    if not quiet:
        print_table(f"{field} of least {metric}", table)
        print(f"Files in {printable(store.folder)}: {', '.join(names)}")
