"""Options for where jobs run, and sessions that run the jobs of a study with progress."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from sdc_taichi.cli.terminal import (
    EXIT_FAILURE,
    EXIT_INTERRUPTED,
    ProgressLines,
    duration,
    interruptible,
    print_notes,
    stage_bars,
)
from sdc_taichi.errors import SdcError, printable

if TYPE_CHECKING:
    from sdc_taichi.benchmark.executors import Executor, JobSummary, Stop
    from sdc_taichi.benchmark.jobs import DoneJob, Inputs, Job
    from sdc_taichi.benchmark.store import ResultStore, Study

_ADDRESS = re.compile(r"auto|local|(ray://)?[\w.\-]+:\d+|(ray://)?\[[0-9a-fA-F:.]+\]:\d+")


class JobsCommand(typer.core.TyperCommand):
    """Command with ``JobOptions``, in which the value of ``--ray`` is optional."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments, after inserting the default value of ``--ray`` if it is missing."""
        return super().parse_args(ctx, with_ray_address(args))


def with_ray_address(args: list[str]) -> list[str]:
    """Insert ``local`` after each ``--ray`` that is not followed by an address."""
    end = args.index("--") if "--" in args else len(args)
    words: list[str] = []
    for i, (word, after) in enumerate(zip_longest(args, args[1:], fillvalue="")):
        words.append(word)
        if word == "--ray" and i < end and not _ADDRESS.fullmatch(after):
            words.append("local")
    return words


@dataclass(frozen=True)
class JobOptions:
    """Options for where jobs run, and whether to resume an interrupted study.

    A command with these options must be a ``JobsCommand``.
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
        typer.Option("--resume", help="Resume the study in --out: run what is missing."),
    ] = False

    def executor(self) -> Executor:
        """Create the executor that runs the jobs.

        Raises:
            SdcError: the options contradict each other, or Ray is not installed.
        """
        if self.ray is not None:
            from sdc_taichi.benchmark.ray_cluster import RayCluster

            return RayCluster(self.ray, self.jobs)
        from sdc_taichi.benchmark.executors import LocalProcesses

        return LocalProcesses(self.jobs)


class JobSession:
    """Running study, which executes its jobs in stages and shows progress on stderr.

    Args:
        store: folder of the results, claimed by this process.
        executor: executor that runs the jobs.
        stop: function that returns True after the user has interrupted the command.
        shown: True to show progress.
    """

    def __init__(
        self, store: ResultStore, executor: Executor, stop: Stop, *, shown: bool = True
    ) -> None:
        self.store = store
        self.summaries: list[JobSummary] = []
        """Summaries of the jobs of the finished stages."""
        self._executor, self._stop, self._shown = executor, stop, shown

    def run(
        self, stage: str, jobs: Iterable[Job], total: int, inputs: Inputs | None = None
    ) -> JobSummary:
        """Run the jobs of a stage whose results are missing; run none after an interruption.

        Args:
            stage: name of the stage, such as ``rows``, for the progress display.
            jobs: all jobs of the stage.
            total: number of the jobs.
            inputs: contents of shared inputs of the jobs, by name.

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
                raise SdcError(
                    f"{error}; finished jobs are stored, continue with --resume"
                ) from error
        self.summaries.append(done)
        return done

    @property
    def workers(self) -> int:
        """Number of jobs that run at the same time."""
        return self._executor.workers

    @property
    def is_whole(self) -> bool:
        """True unless an interruption left jobs out."""
        return all(each.is_whole for each in self.summaries)

    def finish(self) -> None:
        """End the command with an error code and a message if results are missing.

        Raises:
            typer.Exit: jobs failed, or did not run because of an interruption.
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
    """Begin or resume a study, and release its workers and its folder at the end.

    Args:
        store: folder of the study.
        study: description of the study and its jobs.
        options: options for where jobs run, and whether to resume the study in the folder.
        quiet: True to show neither progress nor notes.

    Yields:
        The running study, which Ctrl-C stops.

    Raises:
        SdcError: the folder is in use or has other content, or the options are not valid.
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
    """Show the number of finished jobs on stderr, as a bar in a terminal or as lines elsewhere.

    Every failed job is printed on a line of its own.

    Args:
        stage: name of the stage.
        total: number of jobs.
        shown: True to show progress, False to print failed jobs only.

    Yields:
        A function to call with each job and its outcome. The outcome is None if the result was
        already stored.
    """
    lines, has_lines = ProgressLines(), shown and not sys.stderr.isatty()
    ended = kept = 0
    with stage_bars(shown=shown) as progress:

        def on_done(job: Job, done: DoneJob | None) -> None:
            nonlocal ended, kept
            ended, kept = ended + 1, kept + (done is None)
            if done is not None and done.error:
                text = f"failed: {printable(job.name)}: {done.error}"
                print(text, file=sys.stderr, flush=True)
            progress(stage, ended, total)
            is_last = ended == total
            if has_lines and (is_last or done is not None):
                state = (
                    "kept" if done is None else "failed" if done.error else duration(done.core_s)
                )
                count = f"{stage} {ended:,}/{total:,}" + (f", {kept:,} kept" if kept else "")
                lines.print(f"{count}: {printable(job.name)} {state}", always=is_last)

        yield on_done
