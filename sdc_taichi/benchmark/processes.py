"""Jobs in processes of this machine, each of which computes in one thread."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator
from itertools import islice
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Self

from sdc_taichi.benchmark.jobs import DoneJob, Inputs, Job, compute_in_one_thread, run_job
from sdc_taichi.benchmark.runner import Stop
from sdc_taichi.errors import whole_number
from sdc_taichi.kernels.compiler import processors

MOST_WORKERS = 1024
"""Largest number of worker processes that may be asked for."""
MOST_ATTEMPTS = 3
"""Number of times that a job is begun whose process is killed each time."""
_POLL_S = 0.1
_GRACE_S = 5.0


def default_workers() -> int:
    """Number of processors that this process may use, no more than its container grants."""
    return int(min(len(processors.allowed()), processors.quota(), MOST_WORKERS))


class LocalProcesses:
    """Runs jobs in processes that are started anew (spawned) and live until the end.

    A process gets a job at a time, and the content of an input with the first job that reads it.
    When it is killed, its job is run again in another one, ``MOST_ATTEMPTS`` times at most. The
    processes end with this one, however it ends.

    Args:
        workers: number of processes; None is one for each processor that this process may use.

    Raises:
        ConfigError: a number that is not valid.
    """

    def __init__(self, workers: int | None = None) -> None:
        asked = default_workers() if workers is None else workers
        self.workers = whole_number("workers", asked, 1, MOST_WORKERS)
        self._idle: list[_Worker] = []

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs as ``Executor.results`` does."""
        again: deque[_Attempt] = deque()
        busy: dict[Connection, tuple[_Worker, _Attempt]] = {}

        def hand_out() -> None:
            free = self.workers - len(busy)
            attempts = [again.popleft() for _ in range(min(free, len(again)))]
            attempts += [_Attempt(job, 1) for job in islice(jobs, free - len(attempts))]
            # All are started before the first gets its job, which it takes once it has started.
            self._idle += [_Worker() for _ in range(len(attempts) - len(self._idle))]
            for attempt in attempts:
                worker = self._idle.pop()
                worker.begin(attempt.job, inputs)
                busy[worker.connection] = worker, attempt

        try:
            while not stop():
                hand_out()
                if not busy:
                    return
                ended = []
                ready = set(wait(list(busy), timeout=_POLL_S))
                for connection in [each for each in busy if each in ready]:
                    worker, attempt = busy.pop(connection)
                    done = worker.result()
                    if done is not None:
                        self._idle.append(worker)
                    elif attempt.number < MOST_ATTEMPTS:
                        again.append(_Attempt(attempt.job, attempt.number + 1))
                    else:
                        done = DoneJob(attempt.job, _lost(worker.exit_code))
                    ended += [] if done is None else [done]
                if ended and not stop():
                    hand_out()  # so that processes work while results are written
                yield from ended
        finally:
            _end([worker for worker, _ in busy.values()])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        _end(self._idle)
        self._idle = []


class _Attempt(NamedTuple):
    """A job that is run, and how often it has been begun."""

    job: Job
    number: int


class _Worker:
    """A process that runs jobs."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with _interrupts_held():
            self.process.start()
        theirs.close()
        self._sent: set[str] = set()

    def begin(self, job: Job, inputs: Inputs) -> None:
        """Send a job, with what the process lacks of its inputs."""
        lacking = {i: inputs[n] for n, i in job.inputs.items() if i not in self._sent}
        self._sent |= lacking.keys()
        with contextlib.suppress(OSError):  # it was killed, which `result` finds
            self.connection.send((job, lacking))

    def result(self) -> DoneJob | None:
        """The job that has ended; None if the process has, which is then put away."""
        try:
            done: DoneJob = self.connection.recv()
        except (EOFError, OSError):
            _end([self])
            return None
        return done

    @property
    def exit_code(self) -> int | None:
        """Exit code of a process that has ended; the number of a signal if negative."""
        return self.process.exitcode


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back, as processes that are started meanwhile do from then on.

    It reaches all processes of a terminal, also those that are still importing modules.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(workers: list[_Worker]) -> None:
    """End processes; they get the time to delete their temporary files."""
    for worker in workers:
        worker.connection.close()
        worker.process.terminate()
    deadline_s = time.monotonic() + _GRACE_S
    for worker in workers:
        worker.process.join(max(0.0, deadline_s - time.monotonic()))
        if worker.process.exitcode is None:
            worker.process.kill()
            worker.process.join()


def _lost(exit_code: int | None) -> str:
    """Why a job failed whose processes have ended."""
    how = f"exit code {exit_code}"
    if exit_code is not None and exit_code < 0:
        how = f"signal {-exit_code}"
        with contextlib.suppress(ValueError):
            how = signal.Signals(-exit_code).name
    hint = "; memory may be short, fewer --jobs need less" if how == "SIGKILL" else ""
    return f"its process ended {MOST_ATTEMPTS} times, the last time by {how}{hint}"


def _serve(connection: Connection) -> None:
    """Run the jobs that come through a connection, in a process of their own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _exit)
    compute_in_one_thread()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    held: dict[str, bytes] = {}
    while True:
        try:
            job, lacking = connection.recv()
            held |= lacking
            connection.send(run_job(job, {name: held[i] for name, i in job.inputs.items()}))
        except (EOFError, OSError):  # the driver has no more jobs, or has ended
            # Libraries that clean up at exit are to be ended without a traceback.
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            return


def _exit(*_: Any) -> None:
    """End this process, with its temporary files deleted."""
    raise SystemExit(1)


def _end_with_parent() -> None:
    """End this process when the one that started it has ended, however that was."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(_GRACE_S)
        os._exit(1)
