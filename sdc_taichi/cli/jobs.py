"""Options that say where jobs run, and a study of jobs with its progress and its end."""

from __future__ import annotations

import contextlib
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from sdc_taichi.cli.terminal import (
    EXIT_FAILURE,
    EXIT_INTERRUPTED,
    SECONDS_BETWEEN_LINES,
    duration,
    interruptible,
    print_notes,
    rich_progress,
)
from sdc_taichi.errors import SdcError, printable

if TYPE_CHECKING:
    from sdc_taichi.benchmark.executors import Executor, JobSummary, Stop
    from sdc_taichi.benchmark.jobs import DoneJob, Inputs, Job
    from sdc_taichi.benchmark.store import ResultStore, Study

_ADDRESS = re.compile(r"auto|local|(ray://)?[\w.\-]+:\d+|(ray://)?\[[0-9a-fA-F:.]+\]:\d+")


class JobsCommand(typer.core.TyperCommand):
    """A command with ``JobOptions``; the value of ``--ray`` may be left out."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments, with the value of ``--ray`` put in where it is left out."""
        return super().parse_args(ctx, with_ray_address(args))


def with_ray_address(args: list[str]) -> list[str]:
    """Arguments of a command, with ``local`` after each ``--ray`` that no address follows.

    Args:
        args: arguments of a command line.
    """
    end = args.index("--") if "--" in args else len(args)
    found = []
    for i, (word, after) in enumerate(zip_longest(args, args[1:], fillvalue="")):
        found.append(word)
        if word == "--ray" and i < end and not _ADDRESS.fullmatch(after):
            found.append("local")
    return found


@dataclass(frozen=True)
class JobOptions:
    """Where jobs run, and whether those of a study that was cut off are left out.

    A command with these options is a ``JobsCommand``.
    """

    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            min=1,
            max=1024,
            metavar="N",
            help="Processes that compute at a time. [default: one for each processor]",
        ),
    ] = None
    ray: Annotated[
        str | None,
        typer.Option(
            "--ray",
            metavar="[ADDRESS]",
            help="Run jobs on Ray: on a cluster that is started here, or on that at HOST:PORT or "
            "auto.",
        ),
    ] = None
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the study in --out: run what is missing."),
    ] = False

    def executor(self) -> Executor:
        """The executor that runs the jobs.

        Raises:
            SdcError: options that are not valid together, or no Ray.
        """
        if self.ray is not None:
            from sdc_taichi.benchmark.ray_cluster import RayCluster

            return RayCluster(self.ray, self.jobs)
        from sdc_taichi.benchmark.executors import LocalProcesses

        return LocalProcesses(self.jobs)


class JobSession:
    """A study under way: its jobs run in stages, with progress on stderr.

    Args:
        store: where results are kept; the folder is claimed.
        executor: what runs the jobs.
        stop: says whether the user has interrupted the command.
        shown: whether progress is shown.
    """

    def __init__(
        self, store: ResultStore, executor: Executor, stop: Stop, *, shown: bool = True
    ) -> None:
        self.store = store
        self.summaries: list[JobSummary] = []
        """Summary of the jobs of each stage that has ended."""
        self._executor, self._stop, self._shown = executor, stop, shown

    def run(
        self, stage: str, jobs: Iterable[Job], total: int, inputs: Inputs | None = None
    ) -> JobSummary:
        """Run the jobs of a stage that are not done. After an interruption it runs none.

        Args:
            stage: name of the stage, for the progress, such as ``rows``.
            jobs: the jobs.
            total: number of the jobs.
            inputs: content of inputs by name.

        Raises:
            SdcError: a result cannot be written, or two jobs have the same partition.
        """
        from sdc_taichi.benchmark.executors import run_jobs

        with job_progress(stage, total, shown=self._shown) as on_done:
            try:
                done = run_jobs(
                    jobs, self.store, self._executor, inputs, stop=self._stop, on_done=on_done
                )
            except SdcError as error:
                raise SdcError(f"{error}; what is done is kept, go on with --resume") from error
        self.summaries.append(done)
        return done

    @property
    def is_whole(self) -> bool:
        """True unless an interruption left jobs out."""
        return all(each.is_whole for each in self.summaries)

    def finish(self) -> None:
        """Say on stderr what is missing, and end the command if anything is.

        Raises:
            typer.Exit: jobs failed, or were left out because of an interruption.
        """
        failed = sum(len(each.failed) for each in self.summaries)
        whole = sum(each.done + each.kept for each in self.summaries)
        if not self.is_whole:
            print(f"interrupted after {whole:,} jobs; go on with --resume", file=sys.stderr)
            raise typer.Exit(EXIT_INTERRUPTED)
        if failed:
            text = f"{failed:,} of {failed + whole:,} jobs failed; --resume runs them again"
            print(text, file=sys.stderr)
            raise typer.Exit(EXIT_FAILURE)


@contextlib.contextmanager
def job_session(
    store: ResultStore, study: Study, options: JobOptions, *, quiet: bool = False
) -> Iterator[JobSession]:
    """Begin a study, or go on with it, and end its workers and its claim on the folder.

    Args:
        store: folder of the study.
        study: what is to be done.
        options: where the jobs run, and whether the study in the folder goes on.
        quiet: whether to show neither progress nor notes.

    Yields:
        The study under way, whose jobs end at Ctrl-C.

    Raises:
        SdcError: the folder is not free, or options are not valid.
    """
    executor, resume = options.executor(), options.resume
    with interruptible() as stop, executor, store.claimed(study, resume=resume) as notes:
        if not quiet:
            print_notes(notes)
        yield JobSession(store, executor, stop, shown=not quiet)


@contextlib.contextmanager
def job_progress(
    stage: str, total: int, *, shown: bool
) -> Iterator[Callable[[Job, DoneJob | None], None]]:
    """Show on stderr how many jobs have ended: a bar in a terminal, lines elsewhere.

    Jobs that fail are a line each in any case.

    Args:
        stage: name of what the jobs do.
        total: number of jobs.
        shown: whether to show more than what fails.

    Yields:
        A function to call with each job and how it ended; None where its result was kept.
    """
    if shown and sys.stderr.isatty():
        with rich_progress() as progress:
            task = progress.add_task(stage, total=total)

            def advance(job: Job, ended: DoneJob | None) -> None:
                if ended is not None and ended.error:
                    text = _failure(job, ended)
                    progress.console.print(text, markup=False, highlight=False, soft_wrap=True)
                progress.advance(task)

            yield advance
    else:
        yield _Lines(stage, total, shown=shown).tell


class _Lines:
    """Progress in lines, not too many of them."""

    def __init__(self, stage: str, total: int, *, shown: bool) -> None:
        self._stage, self._total, self._shown = stage, total, shown
        self._ended = self._kept = 0
        self._told_s = -SECONDS_BETWEEN_LINES

    def tell(self, job: Job, ended: DoneJob | None) -> None:
        """Count a job, and tell of it if there is something to tell."""
        self._ended += 1
        self._kept += ended is None
        is_last = self._ended == self._total
        if ended is not None and ended.error:
            print(_failure(job, ended), file=sys.stderr, flush=True)
        if not self._shown:
            return
        if is_last or (ended and time.monotonic() - self._told_s >= SECONDS_BETWEEN_LINES):
            self._told_s = time.monotonic()
            kept = f", {self._kept:,} kept" if self._kept else ""
            place = f"{self._stage} {self._ended:,}/{self._total:,}{kept}"
            line = f"{place}: {printable(job.name)} {_how(ended)}"
            print(line, file=sys.stderr, flush=True)


def _failure(job: Job, ended: DoneJob) -> str:
    """A job that failed, in one line."""
    return f"failed: {printable(job.name)}: {ended.error}"


def _how(ended: DoneJob | None) -> str:
    """How a job ended: in what processor time, or why in none."""
    if ended is None:
        return "kept"
    return "failed" if ended.error else duration(ended.core_s)
