"""The run of a suite: jobs that solve for optima, then jobs of the rows, which read the optima."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, get_args

from sdc_taichi.benchmark.cases import data_centers, number_of_seeds, training_steps
from sdc_taichi.benchmark.executors import JobSummary
from sdc_taichi.benchmark.jobs import Inputs, Job, digest_of, input_paths, read_input
from sdc_taichi.benchmark.store import ResultStore, Study
from sdc_taichi.benchmark.suite import REFERENCE, Case, Part, Row, Suite
from sdc_taichi.benchmark.suite_jobs import packed
from sdc_taichi.control.registry import parts_of
from sdc_taichi.learning.policy import WEIGHTS

_FUNCTIONS = "sdc_taichi.benchmark.suite_jobs"
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
        chosen: the suite with the chosen cases, rows and seeds.
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


def reference_jobs(suite: Suite) -> list[Job]:
    """Jobs that solve for the optima of a suite, one for each case, part and site.

    Args:
        suite: the suite.
    """
    jobs = []
    for name, case in suite.cases.items():
        parts, files = (_parts_needed(suite, name), _files(case)) if case.optimum else ((), {})
        for part in parts:
            for site, config in enumerate(data_centers(case, part)):
                values = {
                    "case": case.model_dump(mode="json", exclude={"about"}),
                    "part": part,
                    "site": site,
                    "objective": suite.objective,
                    **files,
                }
                partition = {
                    "suite": suite.name,
                    "case": name,
                    "row": f"{REFERENCE}-{part}-{config.name}",
                    "seed": "0",
                }
                jobs.append(Job(f"{_FUNCTIONS}:solve_reference", values, partition))
    return jobs


def row_jobs(suite: Suite, references: Sequence[Job]) -> list[Job]:
    """Jobs that run the rows of a suite, one for each case, row and seed.

    Args:
        suite: the suite.
        references: jobs that have solved for its optima.
    """
    jobs = []
    files = {name: _files(case) for name, case in suite.cases.items()}
    for label, row in suite.rows.items():
        for name, case in suite.cases.items():
            if not suite.is_for(label, name):
                continue
            parts, policies = _parts_of(row), _policies(row)
            inputs = {
                job.name: job.key
                for job in references
                if job.partition["case"] == name and job.values["part"] in parts
            }
            for seed in range(number_of_seeds(suite, name, label)):
                values = {
                    "name": label,
                    "case": case.model_dump(mode="json", exclude={"about"}),
                    "row": row.model_dump(mode="json", exclude={"about", "seeds", "cases"}),
                    "training": suite.training if row.train is not None else {},
                    "objective": suite.objective,
                    "seed": seed,
                    **files[name],
                }
                if policies:
                    values["policies"] = policies
                partition = {"suite": suite.name, "case": name, "row": label, "seed": str(seed)}
                jobs.append(Job(f"{_FUNCTIONS}:run_row", values, partition, inputs))
    return jobs


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
    optima = {}
    for job in references:
        if store.is_done(job):
            names = store.result(job.partition).files_sha256
            optima[job.name] = packed({name: store.file(job.partition, name) for name in names})
    return optima


def _steps(job: Job) -> int:
    """Steps that a job trains for: the longest jobs begin first, so that workers end together."""
    train = job.values["row"]["train"]
    if train is None:
        return 0
    return training_steps(job.values["training"], train)


def _files(case: Case) -> dict[str, dict[str, str]]:
    """Digests of the input files that data centers of a case name, by path; empty without any.

    Another file in the place makes other jobs, though the case is the same.

    Raises:
        SdcError: a file that cannot be read.
    """
    configs = [x for part in get_args(Part) for x in data_centers(case, part)]
    paths = sorted({path for config in configs for path in input_paths(config)})
    return {"files": {path: digest_of(read_input(path)) for path in paths}} if paths else {}


def _policies(row: Row) -> dict[str, str]:
    """Digests of the policies that the controllers of a row name, by their folders.

    Another policy in the folder makes another job, though the row is the same.
    """
    digests = {}
    for spec in row.controllers:
        for name in parts_of(spec).values() or [spec]:
            kind, _, folder = name.partition(":")
            if kind == "policy":
                files = sorted(Path(folder).rglob(WEIGHTS))
                digests[folder] = digest_of(b"".join(path.read_bytes() for path in files))
    return digests


def _parts_needed(suite: Suite, case: str) -> tuple[Part, ...]:
    """Parts of a case whose optima its rows need."""
    of_rows = [_parts_of(row) for name, row in suite.rows.items() if suite.is_for(name, case)]
    needed = {part for parts in of_rows for part in parts}
    order: tuple[Part, ...] = ("held-out", "validation")
    return tuple(part for part in order if part in needed)


def _parts_of(row: Row) -> tuple[Part, ...]:
    """Parts of a case whose optima a row needs."""
    chooses = row.train is not None or row.best_of is not None
    return ("held-out", "validation") if chooses else ("held-out",)
