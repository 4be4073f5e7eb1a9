"""``sdc-taichi benchmark``: run benchmark suites, report their results, and add results to them."""

from __future__ import annotations

import importlib.util
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from sdc_taichi.cli.jobs import JobOptions, JobsCommand, job_session
from sdc_taichi.cli.options import (
    CommandApp,
    Quiet,
    check_out_file,
    completed_by,
    force_option,
    out_option,
)
from sdc_taichi.cli.terminal import duration, print_notes, stage_bars
from sdc_taichi.errors import ConfigError, printable

if TYPE_CHECKING:
    from sdc_taichi.benchmark.suite import Suite

_RUN = "run"


def _suites() -> list[str]:
    from sdc_taichi.benchmark.suite import suite_names

    return suite_names()


class _Suites(typer.core.TyperGroup):
    """Group of the benchmark commands; ``benchmark SUITE`` is short for ``benchmark run SUITE``."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments, after inserting ``run`` if the first one is not a command."""
        if args and args[0] not in (*self.commands, *ctx.help_option_names):
            args = [_RUN, *args]
        return super().parse_args(ctx, args)


benchmark_app = CommandApp(
    cls=_Suites,
    no_args_is_help=True,
    help="Compare controllers in suites: sdc-taichi benchmark SUITE, such as carbon.",
)


@benchmark_app.command(_RUN, cls=JobsCommand, may_allow_code=True)
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

    The result of each job is stored, so --resume runs what is missing.
    """
    from sdc_taichi.benchmark.cases import check_suite
    from sdc_taichi.benchmark.estimate import core_s_of
    from sdc_taichi.benchmark.store import ResultStore
    from sdc_taichi.benchmark.suite import load_suite
    from sdc_taichi.benchmark.suite_run import planned_jobs, run_suite, study_of

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
        if not quiet:
            left = [job for job in planned_jobs(chosen) if not store.is_done(job)]
            core_s = sum(map(core_s_of, left))
            text = f"jobs to run: {len(left):,}, about {duration(core_s)} of processor time, or "
            text += f"{duration(core_s / session.workers)} with --jobs {session.workers}"
            print(text, file=sys.stderr, flush=True)
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


@benchmark_app.command("report")
def report_command(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Folders of results of suites.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        out_option("Page with tables and pictures. [default: DIR/report.html]", "FILE.html"),
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE.md", help="Also write the tables as Markdown.")
    ] = None,
    force: Annotated[bool, force_option("Replace existing files of --out, --markdown.")] = False,
) -> None:
    """Make tables and pictures of suites: one HTML page, and Markdown.

    Results of one suite may be in several folders. Nothing is run. Rows whose 95 % confidence
    intervals overlap share a rank.
    """
    from sdc_taichi.benchmark.report import write_report

    if force and out is None and markdown is None:
        raise ConfigError("--force: valid with --out or --markdown; DIR/report.html is replaced")
    check_out_file(out, ".html", force=force)
    check_out_file(markdown, ".md", option="--markdown", force=force)
    for index, folder in enumerate(folders):
        if folder.resolve() in [other.resolve() for other in folders[:index]]:
            raise ConfigError(f"{folder}: is given twice; valid is each folder once")
    page = folders[0] / "report.html" if out is None else out
    print_notes(write_report(folders, html=page, markdown=markdown))
    print(f"Report: {printable(page)}")
    if markdown is not None:
        print(f"Tables: {printable(markdown)}")


@benchmark_app.command("add", may_allow_code=True)
def add_command(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Results of a row.", show_default=False)
    ],
    to: Annotated[
        Path, typer.Option("--to", metavar="DIR", help="Folder of the results of its suite.")
    ],
    verify: Annotated[
        int,
        typer.Option(
            min=0, max=52, metavar="N", help="Run its policies again in N weeks, and compare."
        ),
    ] = 0,
) -> None:
    """Check a row that was run elsewhere, and add it to the results of a suite.

    The row must be complete, and of the same weeks and data centers. The documentation of suites
    describes how to make one.
    """
    from sdc_taichi.benchmark.submission import add_submission, read_submission, rerun

    if verify:
        with stage_bars(shown=True) as progress:
            worst = rerun(read_submission(folder), to, verify, progress)
        print(f"Run again in {verify} weeks of each site: figures differ by {worst:.2g} at most")
    submission = add_submission(folder, to)
    cases = ", ".join(submission.cases)
    print(f"Added {printable(submission.row)} to {printable(to)}: {printable(cases)}")


def _names(text: str | None) -> list[str]:
    """Split names at commas; an absent option gives an empty list."""
    return [] if text is None else [name.strip() for name in text.split(",")]


def _require_torch(suite: Suite) -> None:
    """Check that PyTorch is installed if rows of the suite learn.

    The check comes before the optima are solved, which takes long.

    Raises:
        ConfigError: PyTorch is missing.
    """
    trained = [name for name, row in suite.rows.items() if row.train is not None]
    if trained and importlib.util.find_spec("torch") is None:
        raise ConfigError(
            f"rows {', '.join(trained)}: training needs PyTorch, which is not installed: pip "
            'install "sdc-taichi[train]"; valid without are --rows that do not learn'
        )
