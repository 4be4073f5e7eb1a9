"""Run the jobs of a study with an executor, and keep what they return in its folder."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from sdc_taichi.benchmark.jobs import DoneJob, Inputs, Job, run_job
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.errors import ConfigError, SdcWarning

Stop = Callable[[], bool]
"""Says whether work is to end before it is done."""


class Executor(Protocol):
    """Interface of what runs jobs in worker processes, here or on other machines.

    As a context manager it ends its workers, and the jobs that they run.
    """

    @property
    def workers(self) -> int:
        """Number of jobs that run at a time."""
        ...

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs, and return each when it has ended.

        Args:
            jobs: the jobs; no more than 2 for each worker are taken ahead of those that have ended.
            inputs: content of all inputs that jobs read, by name.
            stop: asked again and again; true ends the jobs that run, and the results.

        Returns:
            Jobs that have ended, well or not, in order of completion. Each job ends once: what is
            lost with a worker is run again.
        """
        ...

    def __enter__(self) -> Self:
        """Begin to use the executor."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
        /,
    ) -> None:
        """End the workers."""
        ...


class InProcess:
    """Runs jobs one after the other in this process, for tests and debuggers."""

    workers = 1

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs as ``Executor.results`` does; a job that runs is not ended by ``stop``."""
        for job in jobs:
            if stop():
                return
            yield run_job(job, inputs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


@dataclass(frozen=True, slots=True)
class JobSummary:
    """Numbers of the jobs of a study that are done and were kept, and those that failed."""

    done: int
    """Number of jobs that were run and ended well."""
    kept: int
    """Number of jobs whose results were there already."""
    failed: tuple[tuple[str, str], ...]
    """Name and error of each job that failed."""
    is_whole: bool
    """True unless an interruption left jobs out."""


def run_jobs(
    jobs: Iterable[Job],
    store: ResultStore,
    executor: Executor,
    inputs: Inputs | None = None,
    *,
    stop: Stop | None = None,
    on_done: Callable[[Job, DoneJob | None], None] | None = None,
) -> JobSummary:
    """Run the jobs that are not done, and keep their results.

    Memory does not grow with the number of jobs, but for their names. Warnings of jobs are issued
    again here.

    Args:
        jobs: the jobs, which may be generated as they are needed.
        store: where results are kept; the folder is claimed.
        executor: what runs the jobs.
        inputs: content of inputs by name. A job with an input that is not among them fails.
        stop: asked again and again; true ends the work with what is done.
        on_done: called with each job that has ended, and how; None where its result was kept.

    Raises:
        ConfigError: two jobs have the same partition.
        SdcError: a result cannot be written.
    """
    work = _Work(jobs, store, inputs or {}, stop or (lambda: False), on_done or (lambda *_: None))
    done = 0
    for ended in executor.results(work.to_do(), work.inputs, work.stop):
        work.under_way -= 1
        for text in ended.warnings:
            warnings.warn(text, SdcWarning, stacklevel=2)
        if ended.error:
            work.fail(ended)
        else:
            store.keep(ended)
            done += 1
            work.on_done(ended.job, ended)
    is_whole = work.is_exhausted and not work.under_way
    return JobSummary(done, work.kept, tuple(work.failed), is_whole)


class _Work:
    """The jobs of a study as they are handed out."""

    def __init__(
        self,
        jobs: Iterable[Job],
        store: ResultStore,
        inputs: Inputs,
        stop: Stop,
        on_done: Callable[[Job, DoneJob | None], None],
    ) -> None:
        self._jobs, self._store = jobs, store
        self.inputs, self.stop, self.on_done = inputs, stop, on_done
        self.under_way = self.kept = 0
        self.failed: list[tuple[str, str]] = []
        self.is_exhausted = False

    def to_do(self) -> Iterator[Job]:
        """The jobs that are not done and have their inputs."""
        seen: set[tuple[str, ...]] = set()
        for job in self._jobs:
            if self.stop():
                return
            place = tuple(job.partition.values())
            if place in seen:
                raise ConfigError(f"{job.name}: two jobs have this partition; valid is one")
            seen.add(place)
            missing = next((name for name in job.inputs if name not in self.inputs), None)
            if self._store.is_done(job):
                self.kept += 1
                self.on_done(job, None)
            elif missing is not None:
                self.fail(DoneJob(job, f"input {missing} is missing, as what makes it has failed"))
            else:
                self.under_way += 1
                yield job
        self.is_exhausted = True

    def fail(self, ended: DoneJob) -> None:
        """Note a job that has failed."""
        self.failed.append((ended.job.name, ended.error))
        self.on_done(ended.job, ended)
