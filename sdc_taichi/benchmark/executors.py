"""Execution of a study's jobs in worker processes of this machine, and storage of the results."""

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
from sdc_taichi.user_functions import CodePermission, code_permission, set_code_permission

MOST_WORKERS = 1024
"""Maximum number of worker processes."""
MOST_ATTEMPTS = 3
"""Maximum number of attempts for a job whose process is killed."""
_POLL_S = 0.1
_GRACE_S = 5.0

Stop = Callable[[], bool]
"""Function that is called repeatedly, and returns true to end the work early."""


class Executor:
    """Executor that runs jobs one after another in this process.

    Subclasses run jobs in worker processes. The end of a ``with`` block ends the workers and their
    jobs.
    """

    @property
    def workers(self) -> int:
        """Number of jobs that run at the same time."""
        return 1

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs, and yield each job when it has ended.

        Args:
            jobs: the jobs; at most 2 jobs per worker are taken from the iterator in advance.
            inputs: content of all inputs that jobs read, by name.
            stop: if it returns true, the iteration and the jobs in worker processes end.

        Yields:
            Jobs that have ended, successfully or not, in order of completion. A job whose worker is
            lost is repeated, and yielded only once.
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
    """Executor that runs jobs in single-threaded worker processes, which end with this process.

    Each worker process is a separate pool, so that a killed process affects only its current job.
    The job is repeated in another process, with at most ``MOST_ATTEMPTS`` attempts in total.

    Args:
        workers: number of processes; None selects the number of processors available to this
            process.

    Raises:
        ConfigError: the number of processes is not valid.
    """

    def __init__(self, workers: int | None = None) -> None:
        number = default_workers() if workers is None else workers
        self._workers = whole_number("workers", number, 1, MOST_WORKERS)

    @property
    def workers(self) -> int:
        """Number of worker processes."""
        return self._workers

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs as described in ``Executor.results``."""
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
    """Number of jobs that were skipped because their results already existed."""
    failed: tuple[tuple[str, str], ...]
    """Name and error of each job that failed."""
    is_whole: bool
    """True if all jobs were processed; False after an interruption."""


def default_workers() -> int:
    """Return the number of processors available to this process, within its container's quota."""
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
    """Run the jobs whose results do not exist yet, and store their results.

    Only the names of the jobs remain in memory. Warnings that a worker recorded during a job are
    issued again in this process.

    Args:
        jobs: the jobs; a generator can create them on demand.
        store: storage of the results, whose folder must be claimed.
        executor: executor of the jobs.
        inputs: content of inputs by name. A job fails if one of its inputs is missing.
        stop: if it returns true, the work ends; the results so far are stored.
        on_done: called with each job and its outcome, which is None if the result already existed.

    Raises:
        ConfigError: two jobs have the same partition.
        SdcError: a result cannot be written.
    """
    contents = inputs or {}
    partitions: set[tuple[str, ...]] = set()
    failed: list[tuple[str, str]] = []
    running = kept = done = 0
    is_exhausted = False

    def fail(ended: DoneJob) -> None:
        failed.append((ended.job.name, ended.error))
        on_done(ended.job, ended)

    def to_do() -> Iterator[Job]:
        nonlocal running, kept, is_exhausted
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
                running += 1
                yield job
        is_exhausted = True

    for ended in executor.results(to_do(), contents, stop):
        running -= 1
        for text in ended.warnings:
            warnings.warn(text, SdcWarning, stacklevel=2)
        if ended.error:
            fail(ended)
        else:
            store.keep(ended)
            done += 1
            on_done(ended.job, ended)
    return JobSummary(done, kept, tuple(failed), is_exhausted and not running)


def _pool_of_one(inputs: Inputs) -> ProcessPoolExecutor:
    """Return a pool with one worker process, which receives the inputs when it starts."""
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(1, context, _begin_worker, (inputs, code_permission()))


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block the signal of Ctrl-C in this process and in processes that start inside the block.

    A terminal sends the signal to all processes, including workers that are still importing
    modules and cannot handle it yet.
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
    """Terminate processes; kill them after a grace period for deleting temporary files."""
    for process in processes:
        process.terminate()
    deadline_s = time.monotonic() + _GRACE_S
    for process in processes:
        process.join(max(0.0, deadline_s - time.monotonic()))
        if process.exitcode is None:
            process.kill()
            process.join()


def _killed(attempts: int) -> str:
    """Return the error message of a job whose process was killed in every attempt."""
    return (
        f"its process was killed {attempts} times; memory may be short, and fewer --jobs need less"
    )


_inputs: dict[str, bytes] = {}
"""Inputs of jobs, if this process is a worker."""


def _begin_worker(inputs: Inputs, permission: CodePermission | None) -> None:
    """Prepare a worker process: signals, monitoring of the parent, one thread, code, inputs."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    compute_in_one_thread()
    set_code_permission(permission)
    _inputs.update(inputs)


def _run_in_worker(job: Job) -> DoneJob:
    """Run a job in a worker process."""
    signal.signal(signal.SIGTERM, _exit)
    try:
        return run_job(job, _inputs)
    except SystemExit:  # end the process here, as the pool would continue with its next job
        os._exit(1)
    finally:
        # Without a job nothing is left to delete, and libraries may be at their own exit.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _exit(*_: Any) -> None:
    """Signal handler that ends the process by an exception, so that temporary files are deleted."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    raise SystemExit(1)


def _end_with_parent() -> None:
    """Wait for the end of the parent process, for any reason, and then end this process."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_GRACE_S)
        os._exit(1)
