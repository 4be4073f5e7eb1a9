"""``sdc-taichi benchmark``: suites of controllers, and what was found by them."""

from __future__ import annotations

import importlib.util
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from sdc_taichi.cli.benchmark_results import add_command, report_command
from sdc_taichi.cli.jobs import JobOptions, JobsCommand, job_session
from sdc_taichi.cli.options import CommandApp, Quiet, completed_by, out_option
from sdc_taichi.errors import ConfigError, printable

if TYPE_CHECKING:
    from sdc_taichi.benchmark.suite import Suite

_RUN = "run"


def _suites() -> list[str]:
    from sdc_taichi.benchmark.suite import suite_names

    return suite_names()


class _Suites(typer.core.TyperGroup):
    """Commands of the benchmark, of which ``run`` may be left out before the name of a suite."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments, with ``run`` put in where no command is named."""
        if args and args[0] not in (*self.commands, *ctx.help_option_names):
            args = [_RUN, *args]
        return super().parse_args(ctx, args)


benchmark_app = CommandApp(
    cls=_Suites,
    no_args_is_help=True,
    help="Compare controllers in suites: sdc-taichi benchmark SUITE, such as carbon.",
)
benchmark_app.command("report")(report_command)
benchmark_app.command("add")(add_command)


@benchmark_app.command(_RUN, cls=JobsCommand)
def run_command(
    context: typer.Context,
    *,
    suite: Annotated[
        str,
        typer.Argument(
            metavar="SUITE|FILE",
            help="Suite (see benchmark list), or YAML file.",
            autocompletion=completed_by(_suites),
        ),
    ],
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1, max=1000, help="Seeds of random rows, such as trainings. [default: of the suite]"
        ),
    ] = None,
    rows: Annotated[
        str | None, typer.Option(metavar="NAME[,NAME]", help="Rows to run. [default: all]")
    ] = None,
    cases: Annotated[
        str | None, typer.Option(metavar="NAME[,NAME]", help="Cases to run. [default: all]")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Its quick form: few weeks, short trainings.")
    ] = False,
    show: Annotated[
        bool, typer.Option("--show", help="Print the suite as YAML, and do not run it.")
    ] = False,
    out: Annotated[
        Path | None,
        out_option("Folder of results. [default: results/SUITE, or SUITE-quick]", "DIR"),
    ] = None,
    jobs: JobOptions,
    quiet: Quiet = False,
) -> None:
    """Run the controllers of a suite in held-out weeks, trained ones with several seeds.

    Results are kept job by job, so --resume runs what is missing.
    """
    from sdc_taichi.benchmark.cases import check_suite
    from sdc_taichi.benchmark.store import ResultStore
    from sdc_taichi.benchmark.suite import load_suite
    from sdc_taichi.benchmark.suite_run import run_suite, study_of

    whole = load_suite(suite, quick=quick)
    chosen = whole.chosen(cases=_names(cases), rows=_names(rows), seeds=seeds)
    if show:
        print(chosen.to_yaml(), end="")
        return
    check_suite(chosen)
    if jobs.ray is None:
        _require_torch(chosen)
    folder = Path("results") / (f"{chosen.name}-quick" if quick else chosen.name)
    store = ResultStore(folder if out is None else out)
    study = study_of(whole, chosen, shlex.join(["sdc-taichi", *context.obj]), quick=quick)
    with job_session(store, study, jobs, quiet=quiet) as session:
        run_suite(chosen, store, session.run)
    if not quiet and session.is_whole:
        place = printable(store.folder)
        print(f"Results in {place}; make tables with: sdc-taichi benchmark report {place}")
    session.finish()


@benchmark_app.command("list")
def list_command() -> None:
    """List the suites that come with the package."""
    from sdc_taichi.benchmark.suite import load_suite, suite_names

    names = suite_names()
    width = max(map(len, names))
    for name in names:
        print(f"{name:{width}}  {load_suite(name).title}")


def _names(text: str | None) -> list[str]:
    """Names that commas part; none of no text."""
    return [] if text is None else [name.strip() for name in text.split(",")]


def _require_torch(suite: Suite) -> None:
    """See that rows can be trained here, before optima are solved for a long time.

    Raises:
        ConfigError: they cannot.
    """
    trained = [name for name, row in suite.rows.items() if row.train is not None]
    if trained and importlib.util.find_spec("torch") is None:
        raise ConfigError(
            f"rows {', '.join(trained)}: training needs PyTorch, which is not installed: pip "
            'install "sdc-taichi[train]"; valid without are --rows that do not learn'
        )
