"""Execution of jobs on a Ray cluster, on one machine or several with the same package version.

Ray does the scheduling: it starts the workers, assigns the jobs, repeats a job if its worker or
machine is lost, and shows the progress in its dashboard.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Any, Self

from sdc_taichi.benchmark.executors import MOST_ATTEMPTS, Executor, Stop, default_workers
from sdc_taichi.benchmark.jobs import (
    DoneJob,
    Inputs,
    Job,
    compute_in_one_thread,
    run_job,
    source_digest,
)
from sdc_taichi.errors import ConfigError, RuntimeStateError, one_line
from sdc_taichi.user_functions import CodePermission, code_permission, set_code_permission

LOCAL = "local"
"""Address that stands for a new cluster on this machine, which ends with the study."""
_POLL_S = 0.2


class RayCluster(Executor):
    """Executor that runs each job as a Ray task, with one processor and one thread.

    If the worker or the machine of a job is lost, the job is repeated elsewhere, with at most
    ``MOST_ATTEMPTS`` attempts in total. Ray's object store transfers the content of each input to
    each machine once.

    Args:
        address: ``local`` starts a cluster on this machine; ``auto`` connects to the cluster that
            runs on this machine or that the environment variable ``RAY_ADDRESS`` names;
            ``HOST:PORT`` connects to a head node.
        workers: number of processors of a cluster with address ``local``; None selects the number
            of processors available to this process.

    Raises:
        ConfigError: Ray is not installed, or ``workers`` is set for an existing cluster.
    """

    def __init__(self, address: str = LOCAL, workers: int | None = None) -> None:
        # Ray reads these variables when it is imported. They disable usage reports to its
        # developers, and limit how often a job that exceeds the memory is repeated.
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_task_oom_retries", str(MOST_ATTEMPTS - 1))
        try:
            import ray
        except ImportError:
            raise ConfigError(
                '--ray needs Ray, which is not installed: pip install "sdc-taichi[scale]"'
            ) from None
        if workers is not None and address != LOCAL:
            raise ConfigError(
                f"--jobs {workers}: given with --ray {address}; valid with --ray {LOCAL}, as other "
                "clusters use the processors that their machines have"
            )
        self._ray: Any = ray
        self._address = address
        self._started: dict[str, Any] = {}  # keyword arguments for starting a new cluster
        if address == LOCAL:
            self._started = {"num_cpus": workers or default_workers(), "include_dashboard": False}

    @property
    def workers(self) -> int:
        """Current number of processors of all machines in the cluster."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 0)))

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs as described in ``Executor.results``.

        Raises:
            RuntimeStateError: a machine of the cluster lacks the package, or has different source
                files of the package.
        """
        ray = self._ray
        task = ray.remote(num_cpus=1, max_retries=MOST_ATTEMPTS - 1)(_run)
        references: dict[str, Any] = {}
        running: dict[Any, Job] = {}
        while not stop():
            for _ in range(2 * self.workers - len(running)):
                job = next(jobs, None)
                if job is None:
                    break
                for name in job.inputs.keys() - references.keys():
                    references[name] = ray.put(inputs[name])
                contents = [references[name] for name in job.inputs]
                running[task.remote(job, sys.path, code_permission(), *contents)] = job
            if not running:
                return
            ended, _ = ray.wait(list(running), timeout=_POLL_S)
            for reference in ended:
                yield self._result(reference, running.pop(reference))

    def _result(self, reference: Any, job: Job) -> DoneJob:
        """Return the job of a task that has ended, with its result or error.

        Raises:
            RuntimeStateError: the task could not begin, or the source files of the package differ
                between the worker and this process.
        """
        try:
            done: DoneJob = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:  # not raised for errors inside a job
            raise RuntimeStateError(
                "a machine of the Ray cluster cannot run jobs; install the same sdc-taichi on all "
                f"of them: {str(error.cause).splitlines()[0]}"
            ) from error
        except self._ray.exceptions.RayError as error:
            return DoneJob(job, f"Ray could not finish it: {_reason(error)}")
        if done.source != source_digest():
            raise RuntimeStateError(
                "a machine of the Ray cluster has other source files of sdc-taichi than this one; "
                "install the same on all of them"
            )
        return done

    def __enter__(self) -> Self:
        """Connect to the cluster, or start it.

        Raises:
            ConfigError: there is no cluster at the address.
        """
        handler = signal.getsignal(signal.SIGTERM)
        try:
            self._ray.init(
                self._address, log_to_driver=False, logging_level="error", **self._started
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise ConfigError(
                f"--ray {self._address}: {_reason(error)}; valid is the HOST:PORT that `ray start "
                f"--head` prints, auto for the cluster that runs here, or {LOCAL} for a new one"
            ) from error
        finally:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, handler)  # restore, because Ray sets its own handler
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()


def _run(
    job: Job, path: Sequence[str], permission: CodePermission | None, *contents: bytes
) -> DoneJob:
    """Run a job in a Ray worker.

    Args:
        job: the job.
        path: ``sys.path`` of the driver process, so that the worker finds modules of users.
        permission: permission of the driver process to run users' code.
        *contents: contents of the job's inputs, in the order of ``job.inputs``.
    """
    compute_in_one_thread()
    set_code_permission(permission)
    sys.path += [folder for folder in path if folder not in sys.path]
    return run_job(job, dict(zip(job.inputs, contents, strict=True)))


def _reason(error: object) -> str:
    """Return the first sentence of an error of Ray, because its messages are long."""
    return one_line(str(error)).partition(". ")[0]
