"""Execution of a suite: jobs that compute the optima, then jobs of the rows, which use them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, Protocol, get_args

from sdc_taichi.benchmark.cases import data_centers, number_of_seeds, training_steps, years_of
from sdc_taichi.benchmark.executors import JobSummary
from sdc_taichi.benchmark.jobs import Inputs, Job, digest_of, input_paths, read_input
from sdc_taichi.benchmark.store import ResultStore, Study
from sdc_taichi.benchmark.suite import REFERENCE, TRIAL, Case, Part, Row, Suite
from sdc_taichi.benchmark.suite_jobs import check_reference, check_row, check_trial, packed
from sdc_taichi.control.registry import parts_of
from sdc_taichi.learning.policy import WEIGHTS
from sdc_taichi.learning.training_settings import merged

_FUNCTIONS = "sdc_taichi.benchmark.suite_jobs"
OPTIMA, TRIALS, ROWS, OTHER_CASES = "optima", "trials", "rows", "rows of other cases"
"""Names of the stages of a suite's execution; the last one has cases with ``trained_in``."""
_NOT_OF_OPTIMA = {"about", "rows", "forecast_error", "trained_in"}
"""Fields of cases on which optima do not depend."""
_NOT_OF_ROWS = {"about", "seeds", "cases"}
"""Fields of rows on which their results do not depend."""
_SEED_OF_TRIALS = 1000
"""Seed of all trials, which no row has."""
_MAY_CHANGE = (
    "suite.rows.*",
    "suite.tuning*",
    "suite.cases.*.rows",
    "suite.title",
    "suite.seeds",
    "suite.training*",
    "*.about",
)
"""Patterns of suite settings that may change when a study is resumed; affected jobs run again."""


class RunStage(Protocol):
    """Function that runs those jobs of a stage that have no results yet, and stores the results."""

    def __call__(
        self, stage: str, jobs: Sequence[Job], total: int, inputs: Inputs | None = None, /
    ) -> JobSummary:
        """Run the jobs of a stage."""
        ...


def study_of(suite: Suite, chosen: Suite, command: str, *, quick: bool = False) -> Study:
    """Return the study for a run of a suite, with its settings and planned jobs.

    Args:
        suite: the whole suite.
        chosen: the suite reduced to the selected cases, rows and seeds.
        command: command line that runs or resumes the suite.
        quick: True for the short version of a suite.
    """
    return Study(
        kind="suite",
        command=command,
        settings={"quick": quick, "suite": suite.model_dump(mode="json", exclude={"quick"})},
        partitions=[dict(job.partition) for job in planned_jobs(chosen)],
        may_change=_MAY_CHANGE,
    )


def planned_jobs(suite: Suite) -> list[Job]:
    """Return all jobs of a suite: optima, trials of settings, and rows."""
    references = reference_jobs(suite)
    trials = trial_jobs(suite, references)
    return [*references, *trials, *row_jobs(suite, references, trials)]


def reference_jobs(suite: Suite) -> list[Job]:
    """Return the jobs that compute the optima of a suite, one for each case, part, site and year.

    Cases with the same optima, such as those with other forecasts, share the jobs of the first.
    """
    jobs: dict[str, Job] = {}
    for name in suite.cases:
        for part in _parts_needed(suite, name):
            for job in _references(suite, name, part):
                jobs.setdefault(job.key, job)
    return list(jobs.values())


def _references(suite: Suite, name: str, part: Part) -> list[Job]:
    """Return the jobs that compute the optima of a part of a case, one for each site and year."""
    jobs = []
    case = suite.cases[name]
    files = _files(case)
    configs = data_centers(case, part) if case.optimum else ()
    for (site, config), year in product(enumerate(configs), years_of(case, part) or (None,)):
        values = {
            "case": case.model_dump(mode="json", exclude=_NOT_OF_OPTIMA),
            "part": part,
            "site": site,
            "year": year,
            "objective": suite.objective,
            **files,
        }
        row = f"{REFERENCE}-{part}-{config.name}" + ("" if year is None else f"-{year}")
        partition = _partition(suite, name, row, 0)
        jobs.append(Job(f"{_FUNCTIONS}:solve_reference", values, partition, check=check_reference))
    return jobs


def _solved(suite: Suite, name: str, part: Part, references: Sequence[Job]) -> dict[str, str]:
    """Return the inputs with the optima of a part of a case: keys of jobs by their names."""
    names = {job.key: job.name for job in references}
    return {names[x.key]: x.key for x in _references(suite, name, part) if x.key in names}


def _of_case(suite: Suite, name: str) -> dict[str, Any]:
    """Return the values of the jobs of a case that are equal for all rows, trials and seeds."""
    case = suite.cases[name]
    values = case.model_dump(mode="json", exclude={"about", "rows"})
    return {"case": values, "objective": suite.objective, **_files(case)}


def _of_row(suite: Suite, label: str, row: Row, seed: int) -> dict[str, Any]:
    """Return the values of a job that trains or runs a row, beside those of its case."""
    return {
        "name": label,
        "row": row.model_dump(mode="json", exclude=_NOT_OF_ROWS),
        "training": suite.training if row.train is not None else {},
        "seed": seed,
    }


def _partition(suite: Suite, case: str, row: str, seed: int) -> dict[str, str]:
    """Return the partition of the result of a job."""
    return {"suite": suite.name, "case": case, "row": row, "seed": str(seed)}


def trial_jobs(suite: Suite, references: Sequence[Job]) -> list[Job]:
    """Return the jobs that try settings of trainings, one for each case, algorithm and trial.

    The other settings of a trial are those of the first row of its algorithm.

    Args:
        suite: the suite.
        references: finished jobs that computed the optima of the suite.
    """
    jobs: list[Job] = []
    tuning = suite.tuning
    if tuning is None:
        return jobs
    for name, case in suite.cases.items():
        if case.trained_in is not None:
            continue
        inputs, of_case = _solved(suite, name, "validation", references), _of_case(suite, name)
        learners: dict[str, dict[str, Any]] = {}
        for label, row in suite.rows.items():
            if suite.is_for(label, name) and row.train is not None:
                learners.setdefault(row.train["algorithm"], row.train)
        for algorithm in (x for x in tuning.space if x in learners):
            label = f"{TRIAL}-{algorithm}"
            for trial in range(tuning.trials):
                changes = {"steps": tuning.steps, "learning": tuning.learning(algorithm, trial)}
                row = Row(train=merged(learners[algorithm], changes))
                values = of_case | _of_row(suite, label, row, _SEED_OF_TRIALS)
                partition = _partition(suite, name, label, trial)
                jobs.append(Job(f"{_FUNCTIONS}:run_trial", values, partition, inputs, check_trial))
    return jobs


def row_jobs(suite: Suite, references: Sequence[Job], trials: Sequence[Job] = ()) -> list[Job]:
    """Return the jobs that run the rows of a suite, one for each case, row and seed.

    Args:
        suite: the suite.
        references: finished jobs that computed the optima of the suite.
        trials: finished jobs that tried settings of trainings.
    """
    jobs: list[Job] = []
    solved = {
        (name, part): _solved(suite, name, part, references)
        for name in suite.cases
        for part in _parts_needed(suite, name)
    }
    of_cases = {name: _of_case(suite, name) for name in suite.cases}
    made: dict[tuple[str, str], list[Job]] = {}
    # Cases in which policies are trained come before those that take them.
    cases = sorted(suite.cases.items(), key=lambda pair: pair[1].trained_in is not None)
    for label, row in suite.rows.items():
        for name, case in cases:
            if not suite.is_for(label, name):
                continue
            policies, parts = _policies(row), _parts_of(row, case)
            optima = {k: v for part in parts for k, v in solved[name, part].items()}
            for seed in range(number_of_seeds(suite, name, label)):
                inputs = dict(optima)
                values = of_cases[name] | _of_row(suite, label, row, seed)
                if policies:
                    values["policies"] = policies
                partition = _partition(suite, name, label, seed)
                if case.trained_in is not None and row.chooses:
                    # With one seed there, it is that of all seeds here.
                    made_there = made[case.trained_in, label]
                    maker = made_there[min(seed, len(made_there) - 1)]
                    values["made_by"] = maker.name
                    inputs |= {maker.name: maker.key}
                elif row.train is not None:
                    tried = name, f"{TRIAL}-{row.train['algorithm']}"
                    of_row = [
                        x for x in trials if (x.partition["case"], x.partition["row"]) == tried
                    ]
                    values["trials"] = [job.name for job in of_row]
                    inputs |= {job.name: job.key for job in of_row}
                job = Job(f"{_FUNCTIONS}:run_row", values, partition, inputs, check_row)
                made.setdefault((name, label), []).append(job)
                jobs.append(job)
    return jobs


def run_suite(suite: Suite, store: ResultStore, run: RunStage) -> None:
    """Run those jobs of a suite that have no results yet.

    Args:
        suite: the suite.
        store: storage of the results, whose folder must be claimed.
        run: function that runs the jobs of a stage.

    Raises:
        SdcError: a result cannot be written or read.
    """
    references = reference_jobs(suite)
    if references:
        run(OPTIMA, references, len(references))
    optima = _packed_results(store, references)
    if trials := trial_jobs(suite, references):
        run(TRIALS, trials, len(trials), optima)
    rows = sorted(row_jobs(suite, references, trials), key=_steps, reverse=True)
    of_others = [job for job in rows if "made_by" in job.values]
    rows = [job for job in rows if "made_by" not in job.values]
    run(ROWS, rows, len(rows), {**optima, **_packed_results(store, trials)})
    if of_others:
        makers = {job.values["made_by"] for job in of_others}
        made = _packed_results(store, [job for job in rows if job.name in makers])
        run(OTHER_CASES, of_others, len(of_others), {**optima, **made})


def _packed_results(store: ResultStore, jobs: Sequence[Job]) -> dict[str, bytes]:
    """Return metrics and files of finished jobs as inputs, by the names of the jobs."""
    results = {}
    for job in jobs:
        if store.is_done(job):
            record = store.result(job.partition)
            files = {name: store.file(job.partition, name) for name in record.files_sha256}
            results[job.name] = packed(files, record.metrics)
    return results


def _steps(job: Job) -> int:
    """Return a job's training steps, for starting long jobs first so that all end together."""
    train = job.values["row"]["train"]
    if train is None:
        return 0
    return training_steps(job.values["training"], train)


def _files(case: Case) -> dict[str, dict[str, str]]:
    """Return the digests of the input files of a case's data centers, by path.

    The digests are part of the jobs' values, so that the jobs change with the content of a file.

    Raises:
        SdcError: a file cannot be read.
    """
    configs = [x for part in get_args(Part) for x in data_centers(case, part)]
    paths = sorted({path for config in configs for path in input_paths(config)})
    return {"files": {path: digest_of(read_input(path)) for path in paths}} if paths else {}


def _policies(row: Row) -> dict[str, str]:
    """Return the digests of the policies in a row's controllers, by folder.

    The digests are part of the jobs' values, so that the jobs change with the policy in a folder.
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
    """Return the parts of a case (held-out, validation) whose optima its rows need."""
    settings = suite.cases[case]
    rows = [row for name, row in suite.rows.items() if suite.is_for(name, case)]
    needed = {part for row in rows for part in _parts_of(row, settings)}
    order: tuple[Part, ...] = ("held-out", "validation")
    return tuple(part for part in order if part in needed)


def _parts_of(row: Row, case: Case) -> tuple[Part, ...]:
    """Return the parts of a case (held-out, validation) whose optima a row needs."""
    chooses_here = row.chooses and case.trained_in is None
    return ("held-out", "validation") if chooses_here else ("held-out",)
