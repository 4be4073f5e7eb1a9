"""Jobs on a Ray cluster, on this machine or on others with the same version of the package.

Ray starts the workers, places the jobs, runs again what is lost with a worker or a machine, and
shows all of it in its dashboard. Nothing is scheduled here.
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

LOCAL = "local"
"""Address of a cluster that is started on this machine, and ends with the study."""
_POLL_S = 0.2


class RayCluster(Executor):
    """Runs jobs as tasks of Ray, each on one processor and in one thread.

    A job whose worker is killed or whose machine is lost is run again on another, ``MOST_ATTEMPTS``
    times at most. The content of an input travels once to each machine, by Ray's object store.

    Args:
        address: ``local`` starts a cluster on this machine; ``auto`` is the one that runs here, or
            that the environment variable ``RAY_ADDRESS`` names; else ``HOST:PORT`` of a head node.
        workers: number of processors of the cluster that is started; None is one for each that
            this process may use. Other clusters have what their machines have.

    Raises:
        ConfigError: Ray is not installed, or a number of workers with another cluster.
    """

    def __init__(self, address: str = LOCAL, workers: int | None = None) -> None:
        # Read when Ray is imported: nothing is sent to its makers, and a job that needs more memory
        # than there is fails some day.
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
        self._started: dict[str, Any] = {}  # what a new cluster is started with
        if address == LOCAL:
            self._started = {"num_cpus": workers or default_workers(), "include_dashboard": False}

    @property
    def workers(self) -> int:
        """Number of processors of all machines that are in the cluster at present."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 0)))

    def results(self, jobs: Iterator[Job], inputs: Inputs, stop: Stop) -> Iterator[DoneJob]:
        """Run jobs as ``Executor.results`` does.

        Raises:
            RuntimeStateError: a machine of the cluster lacks the package, or has other source files
                of it.
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
                running[task.remote(job, sys.path, *contents)] = job
            if not running:
                return
            ended, _ = ray.wait(list(running), timeout=_POLL_S)
            for reference in ended:
                yield self._result(reference, running.pop(reference))

    def _result(self, reference: Any, job: Job) -> DoneJob:
        """The job of a task that has ended.

        Raises:
            RuntimeStateError: the task could not begin, or ran with other source files than those
                here.
        """
        try:
            done: DoneJob = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:  # errors of jobs are in their results
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
        """Connect to the cluster.

        Raises:
            ConfigError: there is none at the address.
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
                signal.signal(signal.SIGTERM, handler)  # Ray sets its own
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()


def _run(job: Job, path: Sequence[str], *contents: bytes) -> DoneJob:
    """Run a job in a worker of Ray.

    Args:
        job: the job.
        path: folders in which the driver finds modules; those of users are in some of them.
        *contents: contents of the job's inputs in their order.
    """
    compute_in_one_thread()
    sys.path += [folder for folder in path if folder not in sys.path]
    return run_job(job, dict(zip(job.inputs, contents, strict=True)))


def _reason(error: object) -> str:
    """The first sentence of an error of Ray, whose texts are long."""
    return one_line(str(error)).partition(". ")[0]
