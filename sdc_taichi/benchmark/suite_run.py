"""The run of a suite: optima first, then the rows, which read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from sdc_taichi.benchmark.cases import training_steps
from sdc_taichi.benchmark.executors import JobSummary
from sdc_taichi.benchmark.jobs import Inputs, Job
from sdc_taichi.benchmark.store import ResultStore, Study
from sdc_taichi.benchmark.suite import Suite
from sdc_taichi.benchmark.suite_jobs import packed, reference_jobs, row_jobs

OPTIMA, ROWS = "optima", "rows"
"""Names of the stages of a suite."""
_MAY_CHANGE = ("suite.rows.*", "suite.title", "suite.seeds", "suite.training*", "*.about")
"""Settings of a suite that may change while its study goes on; what depends on them is redone."""


class RunStage(Protocol):
    """Runs the jobs of a stage that are not done, and keeps their results."""

    def __call__(
        self, stage: str, jobs: Sequence[Job], total: int, inputs: Inputs | None = None, /
    ) -> JobSummary:
        """Run jobs.

        Args:
            stage: name of the stage.
            jobs: the jobs.
            total: number of the jobs.
            inputs: content of inputs by name.
        """
        ...


def study_of(suite: Suite, chosen: Suite, command: str, *, quick: bool = False) -> Study:
    """The study of a run of a suite: its settings, and the jobs that it is to do.

    Args:
        suite: the whole suite.
        chosen: the suite with the cases, rows and seeds that are asked for.
        command: command line that runs the suite, or goes on with it.
        quick: whether it is the quick form of a suite.
    """
    references = reference_jobs(chosen)
    return Study(
        kind="suite",
        command=command,
        settings={"quick": quick, "suite": suite.model_dump(mode="json", exclude={"quick"})},
        partitions=[dict(job.partition) for job in [*references, *row_jobs(chosen, references)]],
        may_change=_MAY_CHANGE,
    )


def run_suite(suite: Suite, store: ResultStore, run: RunStage) -> None:
    """Run the jobs of a suite that are not done.

    Args:
        suite: the suite.
        store: where results are kept; the folder is claimed.
        run: runs the jobs of a stage.

    Raises:
        SdcError: a result cannot be written or read.
    """
    references = reference_jobs(suite)
    if references:
        run(OPTIMA, references, len(references))
    rows = sorted(row_jobs(suite, references), key=_steps, reverse=True)
    run(ROWS, rows, len(rows), _optima(store, references))


def _optima(store: ResultStore, references: Sequence[Job]) -> Mapping[str, bytes]:
    """Optima that are solved, as inputs by the names of their jobs."""
    found = {}
    for job in references:
        if store.is_done(job):
            names = store.result(job.partition).files_sha256
            found[job.name] = packed({name: store.file(job.partition, name) for name in names})
    return found


def _steps(job: Job) -> int:
    """Steps that a job trains for: the longest jobs begin first, so that workers end together."""
    train = job.values["row"]["train"]
    if train is None:
        return 0
    return training_steps(job.values["training"], train)
