"""``sdc-taichi evaluate``: compare policies and controllers in held-out weeks."""

from __future__ import annotations

import dataclasses
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sdc_taichi.cli.options import (
    Compared,
    FolderForce,
    ForecastRunOptions,
    NoCache,
    Overrides,
    SiteOptions,
    json_option,
    out_option,
    read_config,
)
from sdc_taichi.cli.terminal import (
    EXIT_INTERRUPTED,
    exit_if_stopped,
    interruptible,
    print_notes,
    print_table,
    stage_bars,
)
from sdc_taichi.config import apply_overrides
from sdc_taichi.errors import ConfigError, SdcError, one_line, printable

if TYPE_CHECKING:
    from sdc_taichi.config import DataCenterConfig
    from sdc_taichi.learning.evaluation import Contender, DataCenterWeeks, Evaluation
    from sdc_taichi.learning.training_settings import TrainingSettings
    from sdc_taichi.sim.fleet import Fleet
    from sdc_taichi.types import StepResult


def evaluate_command(
    context: typer.Context,
    *,
    runs: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[RUN]...",
            help="Folders of trainings or policies; seeds of one training are put together.",
            show_default=False,
        ),
    ] = None,
    sites: SiteOptions,
    weeks: Annotated[
        str,
        typer.Option(metavar="NAME|N,N", help="held-out, validation, training, or weeks 0..51."),
    ] = "held-out",
    controller: Compared = None,
    objective: Annotated[
        str | None,
        typer.Option(
            metavar="TERMS",
            help="What is compared, as of optimum. [default: of the training's validation]",
        ),
    ] = None,
    config: Annotated[
        str | None,
        typer.Option(metavar="PRESET|FILE", help="Data center. [default: that of the training]"),
    ] = None,
    overrides: Overrides = None,
    days: Annotated[
        int, typer.Option(min=2, max=7, help="Days of each week; the first is not scored.")
    ] = 7,
    run: ForecastRunOptions,
    no_optimum: Annotated[
        bool, typer.Option("--no-optimum", help="No share of the achievable, no value of ends.")
    ] = False,
    exact_ends: Annotated[
        bool,
        typer.Option("--exact-ends", help="Value the ends of each run anew: slow, for bills."),
    ] = False,
    no_agents: Annotated[
        bool, typer.Option("--no-agents", help="Leave out each agent alone.")
    ] = False,
    no_cache: NoCache = False,
    out: Annotated[
        Path | None, out_option("Folder for tables, rows and figures. [default: none]", "DIR")
    ] = None,
    force: FolderForce = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress, no tables.")] = False,
    as_json: Annotated[bool, json_option("Print evaluation.json instead of the tables.")] = False,
) -> None:
    """Compare policies and controllers in weeks that no training has seen.

    All begin in equal weeks and states; the first day of each week is run but not scored. The share
    of the achievable is 0 for idle commands and 1 for the known optimum. Halls with loads by zone
    have no known optimum, and therefore no shares.
    """
    from sdc_taichi.learning.evaluation import check_contenders, training_settings
    from sdc_taichi.learning.evaluation_table import (
        EVALUATION_FILE,
        ROWS_FILE,
        TABLE_FILE,
        content_json,
        evaluation_content,
        prepare_evaluation_folder,
        write_evaluation,
    )
    from sdc_taichi.learning.split import parse_weeks
    from sdc_taichi.optimum.problem import require_traces
    from sdc_taichi.sim.fleet import build_fleet

    folders, named = list(runs or ()), list(controller or ())
    if not folders and not named:
        raise ConfigError("evaluate: nothing to evaluate; valid is RUN or --controller")
    chosen = parse_weeks(weeks)
    settings = training_settings(folders) if config is None else None
    base = _base_config(settings, config, overrides)
    if sites.site is None and settings is not None and settings.sites:
        trained_on = None if sites.weather or sites.carbon else ",".join(settings.sites)
        sites = dataclasses.replace(sites, site=trained_on)
    configs = sites.data_centers(base)
    if objective is None:
        objective = "carbon" if settings is None else settings.validation.objective
    # Invalid names and policies must fail before solving for the optimum, which may take hours.
    with warnings.catch_warnings(action="ignore"):
        fleet = build_fleet(configs)
        check_contenders(_contenders(fleet, folders, named))
    seeks_optimum = not no_optimum
    if seeks_optimum:
        try:
            require_traces(fleet)
        except ConfigError as error:
            _note_missing_optimum(error)
            seeks_optimum = False
    if out is not None:
        prepare_evaluation_folder(out, force=force)
    with interruptible() as stop:
        with stage_bars(shown=not quiet) as progress:
            prepared = _prepared(
                configs,
                chosen,
                optimum=seeks_optimum,
                exact_ends=exact_ends,
                objective=objective,
                days=days,
                seed=run.seed,
                forecast_error=run.error(),
                precision=run.precision,
                cache=not no_cache,
                progress=progress,
                stop=stop,
            )
        with prepared:
            evaluation = _evaluated(
                prepared, folders, named, agents_alone=not no_agents, quiet=quiet, stop=stop
            )
            command = shlex.join(["sdc-taichi", *context.obj])
            content = evaluation_content(evaluation, prepared, command=command, folders=folders)
            if as_json:
                print(content_json(content), end="")
            elif not quiet and len(evaluation.rows):
                _print_tables(evaluation, prepared)
            if out is not None and len(evaluation.rows):
                write_evaluation(out, evaluation, prepared, content)
                if not (quiet or as_json):
                    files = f"{EVALUATION_FILE}, {ROWS_FILE}, {TABLE_FILE}"
                    print(f"Files in {printable(out)}: {files}")
    if evaluation.missing:
        left = ", ".join(evaluation.missing)
        print(f"interrupted; figures are whole, without {left}", file=sys.stderr)
        raise typer.Exit(EXIT_INTERRUPTED)
    if prepared.optimum is None and seeks_optimum:
        raise SdcError(
            "evaluate: no optimum, so no shares; valid without an optimum is --no-optimum"
        )


def _base_config(
    settings: TrainingSettings | None, config: str | None, overrides: list[str] | None
) -> DataCenterConfig:
    """Return the config of ``--config``, or that of a training, with overrides applied.

    Args:
        settings: settings of the training; None with ``--config`` or without a training.
        config: preset or file of ``--config``; None without it.
        overrides: values of ``--set``.
    """
    if settings is None:
        return read_config([] if config is None else [config], overrides)[0]
    return apply_overrides(settings.data_centers_of_sites()[0], overrides or [])


def _prepared(
    configs: Sequence[DataCenterConfig],
    weeks: tuple[int, ...],
    *,
    optimum: bool,
    stop: Callable[[], bool],
    **options: Any,
) -> DataCenterWeeks:
    """Prepare the weeks of an evaluation, and solve for their optimum if asked.

    If there is no optimum, a note on stderr gives the reason, and the weeks have none.

    Raises:
        typer.Exit: the user stopped the solver; a message on stderr lists the stored results.
    """
    from sdc_taichi.learning.evaluation import prepare
    from sdc_taichi.optimum import StoppedError

    with exit_if_stopped():
        try:
            return prepare(configs, weeks, optimum=optimum, stop=stop, **options)
        except SdcError as error:
            if not optimum or isinstance(error, StoppedError):
                raise
            failed = error
        weeks_without = prepare(configs, weeks, optimum=False, stop=stop, **options)
    _note_missing_optimum(failed)
    return weeks_without


def _note_missing_optimum(reason: SdcError) -> None:
    """Print on stderr why there is no optimum."""
    print(f"note: no optimum, so no shares: {one_line(str(reason))}", file=sys.stderr)


def _evaluated(
    weeks: DataCenterWeeks,
    folders: Sequence[Path],
    named: Sequence[str],
    *,
    agents_alone: bool,
    quiet: bool,
    stop: Callable[[], bool],
) -> Evaluation:
    """Evaluate policies and named controllers, with a progress bar for each run.

    Args:
        weeks: the prepared weeks.
        folders: folders of policies.
        named: names of controllers.
        agents_alone: True to also evaluate each agent of a policy alone.
        quiet: True to show no progress.
        stop: function that returns True after an interruption.
    """
    from sdc_taichi.learning.evaluation import evaluate

    print_notes(weeks.sim.drivers.notes)
    contenders = _contenders(weeks.sim.fleet, folders, named, agents_alone=agents_alone)
    with stage_bars(shown=not quiet) as progress:

        def on_run(name: str) -> Callable[[StepResult], None]:
            return lambda result: progress(name, result.step + 1, weeks.steps)

        return evaluate(weeks, contenders, on_run=on_run, stop=stop)


def _contenders(
    fleet: Fleet, folders: Sequence[Path], named: Sequence[str], *, agents_alone: bool = True
) -> list[Contender]:
    """Return the policies and controllers to evaluate, built for the data centers of a fleet."""
    from sdc_taichi.control import make_controller
    from sdc_taichi.learning.evaluation import Contender, contenders_of

    contenders = contenders_of(folders, fleet, agents_alone=agents_alone)
    return contenders + [Contender(name, make_controller(name, fleet)) for name in named]


def _print_tables(evaluation: Evaluation, weeks: DataCenterWeeks) -> None:
    """Print the tables of an evaluation."""
    from sdc_taichi.learning.evaluation_table import remarks, tables_of

    for title, table in tables_of(evaluation, weeks):
        print_table(title, table)
    for line in remarks(weeks):
        print(printable(line))
