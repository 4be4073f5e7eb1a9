"""Run the jobs of a study in worker processes of this machine, and keep their results."""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Self

from sdc_taichi.benchmark.jobs import DoneJob, Inputs, Job, compute_in_one_thread, run_job
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.errors import ConfigError, SdcWarning, whole_number
from sdc_taichi.kernels.compiler.runtime import allowed_processors, processor_quota

MOST_WORKERS = 1024
"""Largest number of worker processes."""
MOST_ATTEMPTS = 3
"""Number of times that a job is begun if its process is killed each time."""
_POLL_S = 0.1
_GRACE_S = 5.0

Stop = Callable[[], bool]
"""Returns true once work is to end early; polled."""


class Executor:
    """Runs jobs one after the other in this process; subclasses run them in worker processes.

    As a context manager it ends its workers, and the jobs that they run.
    """

    @property
    def workers(self) -> int:
        """Number of jobs that run at a time."""
        return 1

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs, and yield each one when it has ended.

        Args:
            jobs: the jobs; at most 2 per worker are taken before others have ended.
            inputs: content of all inputs that jobs read, by name.
            stop: once true, the iteration ends, and jobs that run in other processes.

        Yields:
            Jobs that have ended, successfully or not, in order of completion. A job that is lost
            with its worker is run again and yielded once.
        """
        for job in jobs:
            if stop():
                return
            yield run_job(job, inputs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class LocalProcesses(Executor):
    """Runs jobs in spawned processes of one thread each, which end with this process.

    Each process is a pool of its own, so that a process that is killed loses the job that it runs
    and no other. The job begins again in another process, ``MOST_ATTEMPTS`` times in all.

    Args:
        workers: number of processes; None is one for each processor that this process may use.

    Raises:
        ConfigError: a number that is not valid.
    """

    def __init__(self, workers: int | None = None) -> None:
        number = default_workers() if workers is None else workers
        self._workers = whole_number("workers", number, 1, MOST_WORKERS)

    @property
    def workers(self) -> int:
        """Number of processes."""
        return self._workers

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs as ``Executor.results`` does."""
        before = set(multiprocessing.active_children())
        idle: list[ProcessPoolExecutor] = []
        waiting: Iterator[tuple[Job, int]] = zip(jobs, itertools.repeat(1))
        running: dict[Future[DoneJob], tuple[ProcessPoolExecutor, Job, int]] = {}
        try:
            while not stop():
                for job, attempt in itertools.islice(waiting, self._workers - len(running)):
                    pool = idle.pop() if idle else _pool_of_one(inputs)
                    with _interrupts_blocked():
                        running[pool.submit(_run_in_worker, job)] = pool, job, attempt
                if not running:
                    return
                ended = []
                for future in wait(running, _POLL_S, FIRST_COMPLETED).done:
                    pool, job, attempt = running.pop(future)
                    try:
                        ended.append(future.result())
                        idle.append(pool)
                    except BrokenProcessPool:
                        if attempt < MOST_ATTEMPTS:
                            waiting = itertools.chain([(job, attempt + 1)], waiting)
                        else:
                            ended.append(DoneJob(job, _killed(attempt)))
                yield from ended
        finally:
            for pool in [*idle, *(pool for pool, *_ in running.values())]:
                pool.shutdown(wait=False, cancel_futures=True)
            _end(set(multiprocessing.active_children()) - before)


@dataclass(frozen=True, slots=True)
class JobSummary:
    """Outcome of the jobs of a study."""

    done: int
    """Number of jobs that were run successfully."""
    kept: int
    """Number of jobs whose results existed already."""
    failed: tuple[tuple[str, str], ...]
    """Name and error of each job that failed."""
    is_whole: bool
    """True unless an interruption left jobs out."""


def default_workers() -> int:
    """Number of processors that this process may use, within the quota of its container."""
    return int(min(len(allowed_processors()), processor_quota(), MOST_WORKERS))


def run_jobs(
    jobs: Iterable[Job],
    store: ResultStore,
    executor: Executor,
    inputs: Inputs | None = None,
    *,
    stop: Stop = lambda: False,
    on_done: Callable[[Job, DoneJob | None], None] = lambda *_: None,
) -> JobSummary:
    """Run the jobs that are not done, and keep their results.

    Memory does not grow with the number of jobs, except for their names. Warnings of jobs are
    issued again here.

    Args:
        jobs: the jobs, which may be generated as they are needed.
        store: where results are kept; its folder is claimed.
        executor: runs the jobs.
        inputs: content of inputs by name. A job fails if one of its inputs is not among them.
        stop: once true, the work ends with what is done.
        on_done: called with each job and its outcome; None if its result existed already.

    Raises:
        ConfigError: two jobs have the same partition.
        SdcError: a result cannot be written.
    """
    contents = inputs or {}
    partitions: set[tuple[str, ...]] = set()
    failed: list[tuple[str, str]] = []
    taken = kept = done = 0
    is_exhausted = False

    def fail(ended: DoneJob) -> None:
        failed.append((ended.job.name, ended.error))
        on_done(ended.job, ended)

    def to_do() -> Iterator[Job]:
        nonlocal taken, kept, is_exhausted
        for job in jobs:
            if stop():
                return
            partition = tuple(job.partition.values())
            if partition in partitions:
                raise ConfigError(f"{job.name}: two jobs have this partition; valid is one")
            partitions.add(partition)
            missing = next((name for name in job.inputs if name not in contents), None)
            if store.is_done(job):
                kept += 1
                on_done(job, None)
            elif missing is not None:
                fail(DoneJob(job, f"input {missing} is missing, because its job has failed"))
            else:
                taken += 1
                yield job
        is_exhausted = True

    for ended in executor.results(to_do(), contents, stop):
        taken -= 1
        for text in ended.warnings:
            warnings.warn(text, SdcWarning, stacklevel=2)
        if ended.error:
            fail(ended)
        else:
            store.keep(ended)
            done += 1
            on_done(ended.job, ended)
    return JobSummary(done, kept, tuple(failed), is_exhausted and not taken)


def _pool_of_one(inputs: Inputs) -> ProcessPoolExecutor:
    """A pool of one worker process, which gets the inputs when it starts."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, _begin_worker, (inputs,))


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C; processes that start meanwhile inherit this.

    A terminal sends Ctrl-C to all processes, including those that are still importing modules.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(processes: Iterable[multiprocessing.process.BaseProcess]) -> None:
    """End processes, after some time in which they can delete their temporary files."""
    for process in processes:
        process.terminate()
    deadline_s = time.monotonic() + _GRACE_S
    for process in processes:
        process.join(max(0.0, deadline_s - time.monotonic()))
        if process.exitcode is None:
            process.kill()
            process.join()


def _killed(attempts: int) -> str:
    """Error of a job whose process was killed each time."""
    return (
        f"its process was killed {attempts} times; memory may be short, and fewer --jobs need less"
    )


_inputs: dict[str, bytes] = {}
"""Inputs of the jobs of this process, if it is a worker."""


def _begin_worker(inputs: Inputs) -> None:
    """Prepare a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    compute_in_one_thread()
    _inputs.update(inputs)


def _run_in_worker(job: Job) -> DoneJob:
    """Run a job in a worker process."""
    try:
        return run_job(job, _inputs)
    except SystemExit:  # temporary files are deleted; a pool would go on with its next job
        os._exit(1)


def _exit(*_: Any) -> None:
    """End this process by an exception, so that its temporary files are deleted."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise SystemExit(1)


def _end_with_parent() -> None:
    """End this process when the one that started it has ended, by whatever cause."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_GRACE_S)
        os._exit(1)
