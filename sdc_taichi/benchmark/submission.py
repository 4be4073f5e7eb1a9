"""Submissions: results of other people, which are checked and added to the results of a suite.

A submission has the folder structure of a study, with an additional file ``submission.json`` that
names the author. The checks cover schema and completeness only, and cannot detect invented results.
``rerun`` therefore repeats the runs of submitted policies and compares the results.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from sdc_taichi.atomic_file import FileClaim, naming_errors
from sdc_taichi.benchmark.cases import data_centers, years_of
from sdc_taichi.benchmark.jobs import DoneJob, Job, check_file_name, parquet
from sdc_taichi.benchmark.result_table import METRIC_COLUMNS, PLACE
from sdc_taichi.benchmark.store import JOBS, METRICS_FILE, ResultStore, read_record, write_record
from sdc_taichi.benchmark.suite import REFERENCE
from sdc_taichi.benchmark.suite_results import (
    ACHIEVED,
    BOUND,
    COLUMNS,
    LEARNER,
    SUBMISSION_FILE,
    CaseResults,
    RowResult,
    SubmissionRecord,
    SuiteResults,
    check_partition,
    check_weeks,
    read_result,
    read_suites,
)
from sdc_taichi.control import Controller, Idle, PerAgent
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.evaluation import ALL, Contender, evaluate, prepare
from sdc_taichi.learning.policy import FOLDERS, WEIGHTS, Policy
from sdc_taichi.optimum.problem import AGENTS
from sdc_taichi.optimum.solve import Progress
from sdc_taichi.sim.fleet import Fleet

if TYPE_CHECKING:
    import pandas as pd

ROW_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,79}")
"""Pattern of a valid row name."""
_SAME = 1e-3
"""Maximum relative difference between submitted and repeated results. Rounding differs between
processors, and policies amplify it."""


@dataclass(frozen=True, slots=True)
class Submission:
    """A submitted row (controller or trained policy) with its results."""

    store: ResultStore
    """Folder of the submission."""
    about: SubmissionRecord
    """Content of ``submission.json``."""
    suite: str
    """Name of the suite."""
    row: str
    """Name of the row."""
    results: tuple[RowResult, ...]
    """Result of each case and seed."""

    def of_case(self, name: str) -> list[RowResult]:
        """Return the results of one case."""
        return [x for x in self.results if x.record.partition["case"] == name]

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases for which the submission has results."""
        return tuple(dict.fromkeys(x.record.partition["case"] for x in self.results))


def read_submission(folder: Path) -> Submission:
    """Read the folder of a submitted row and check its schema.

    Raises:
        SdcError: files are missing or damaged, have a different format or version of the package,
            or belong to several rows.
    """
    store = ResultStore(folder)
    about = read_record(folder / SUBMISSION_FILE, SubmissionRecord)
    results = []
    for record in store.results():
        place = store.folder_of(record.partition) / METRICS_FILE
        check_partition(record.partition)
        if record.version != version("sdc-taichi"):
            raise ConfigError(
                f"{place}: version {shortened(record.version)}; valid is {version('sdc-taichi')}"
            )
        if not record.rows_sha256 or not store.is_whole(record):
            raise ConfigError(f"{place}: rows or files do not have the digests that it lists")
        results.append(read_result(store, record))
    names = {(x.record.partition["suite"], x.record.partition["row"]) for x in results}
    if len(names) != 1:
        raise ConfigError(f"{folder}: holds {len(names)} rows; valid is one row of one suite")
    ((suite, row),) = names
    return Submission(store, about, suite, row, tuple(results))


def check_submission(submission: Submission, suite: SuiteResults) -> None:
    """Check that a submitted row belongs to a suite and is complete.

    Args:
        submission: the submitted row.
        suite: results of the suite to which the row shall be added.

    Raises:
        ConfigError: the name exists already or is not valid, the suite or a case differs, or seeds,
            weeks or values are missing.
    """
    place, row = submission.store.folder, submission.row
    if submission.suite != suite.name:
        raise ConfigError(
            f"{place}: is of suite {shortened(submission.suite)}; valid is {suite.name}"
        )
    if not ROW_NAME.fullmatch(row) or row.startswith(REFERENCE):
        raise ConfigError(
            f"{place}: row {shortened(row)}: valid are at most 80 lower-case letters, digits and "
            f". _ -, not beginning with {REFERENCE}"
        )
    if row in suite.suite.rows or any(row in case.rows for case in suite.cases.values()):
        raise ConfigError(f"{place}: row {row}: the name is taken; valid is another")
    for name in submission.cases:
        if name not in suite.cases:
            raise ConfigError(
                f"{place}: case {shortened(name)}: {suite.name} has no results of it; valid: "
                f"{', '.join(suite.cases)}"
            )
        _check_case(submission, suite.suite.seeds, suite.cases[name])


def add_submission(folder: Path, to: Path) -> Submission:
    """Check a submitted row and copy it into the results of a suite.

    Args:
        folder: folder of the submission.
        to: folder of the study with the suite's results.

    Raises:
        SdcError: the submission is not valid, another process uses ``to``, or ``to`` is not
            writable.
    """
    submission, target = read_submission(folder), ResultStore(to)
    (suite,) = read_suites([to])
    check_submission(submission, suite)
    with naming_errors(to):
        claim = FileClaim(to / JOBS)
    try:
        for result in submission.results:
            record, store = result.record, submission.store
            files = {name: store.file(record.partition, name) for name in record.files_sha256}
            # Write the author first, so that a result never exists without it.
            about = target.folder_of(record.partition).parent / SUBMISSION_FILE
            write_record(about, submission.about)
            target.write(record, store.rows_file(record), files)
    finally:
        claim.release()
    return submission


def write_submission(
    out: Path,
    frames: Mapping[int, pd.DataFrame],
    *,
    suite: str,
    case: str,
    row: str,
    kind: Literal["learner", "controller"],
    author: str,
    about: str = "",
    link: str = "",
    files: Mapping[int, Mapping[str, bytes]] | None = None,
) -> None:
    """Write a submission folder with results that were computed without this package.

    Args:
        out: the folder.
        frames: table of results for each seed, with one line for each data-center week in the order
            of the suite, and the columns of the suite's results.
        suite: name of the suite.
        case: name of the case.
        row: name of the submitted row.
        kind: ``learner`` for a trained method with all seeds of the suite, or ``controller``.
        author: name of the author.
        about: description of the row in one sentence.
        link: web address with more information.
        files: content of further files by path for each seed, such as a policy.

    Raises:
        SdcError: a name is not valid, or a file cannot be written.
    """
    record = SubmissionRecord(author=author, about=about, link=link, kind=kind)
    write_record(out / SUBMISSION_FILE, record)
    store = ResultStore(out)
    for seed, frame in frames.items():
        partition = dict(zip(COLUMNS, (suite, case, row, str(seed)), strict=True))
        seed_files = dict((files or {}).get(seed, {}))
        for name in seed_files:
            check_file_name(name)
        job = Job("", {"name": row, "seed": seed}, partition)
        store.keep(DoneJob(job, rows=parquet(frame), files=seed_files))


def rerun(submission: Submission, to: Path, weeks: int, progress: Progress | None = None) -> float:
    """Repeat the runs of submitted policies in some weeks of each site, and compare the results.

    Args:
        submission: the submitted row.
        to: folder of the study with the suite's results.
        weeks: number of weeks per site, at least 1 and at most the number of the case.
        progress: progress callback ``(stage, done, total)``; counts results.

    Returns:
        Maximum relative difference of a week's objective.

    Raises:
        SdcError: the submission has no policies, a policy does not fit, ``weeks`` is too large, or
            the policies do not reproduce the submitted results.
    """
    (suite,) = read_suites([to])
    check_submission(submission, suite)
    worst = 0.0
    for done, result in enumerate(submission.results):
        if progress is not None:
            progress("running again", done, len(submission.results))
        case = suite.cases[result.record.partition["case"]]
        worst = max(worst, _rerun_result(result, case, weeks))
    return worst


def _rerun_result(result: RowResult, case: CaseResults, weeks: int) -> float:
    """Repeat one result in some weeks of each site; return the maximum relative difference."""
    settings, count = case.settings, len(case.settings.weeks)
    if weeks > count:
        raise ConfigError(f"verify {weeks}: case {case.name} has {count} weeks; valid are no more")
    with prepare(
        data_centers(settings, "held-out"),
        [settings.weeks[count * k // weeks] for k in range(weeks)],
        years=years_of(settings, "held-out"),
        objective=case.objective,
        optimum=False,
        days=settings.days,
        seed=result.seed,
        forecast_error=settings.error,
    ) as prepared:
        controller = _submitted_policy(result, prepared.sim.fleet)
        again = evaluate(prepared, [Contender("again", controller)], beside=False).rows
    whole = result.frame[result.frame["moves"] == ALL]
    both = again.merge(whole, on=[*PLACE], suffixes=("", "_stated"))
    difference = ((both["figure_stated"] - both["figure"]) / both["figure"]).abs()
    if (worst := float(difference.max())) > _SAME:
        row = both.iloc[int(np.argmax(difference))]
        raise ConfigError(
            f"{result.folder}: week {row['week']} of year {row['year']} of {row['site']}: figure "
            f"{row['figure_stated']:.9g}, and its policy reaches {row['figure']:.9g}; valid are "
            "figures of the policy"
        )
    return worst


def _submitted_policy(result: RowResult, fleet: Fleet) -> Controller:
    """Return a controller that runs the submitted policy, or one policy for each agent.

    Raises:
        SdcError: the result has no policy, or the policy does not fit the data centers.
    """
    loaded: dict[str, Controller] = {
        name: PolicyController(Policy.load(folder), fleet, str(folder))
        for name, folder in {x: result.folder / x for x in ("", *AGENTS)}.items()
        if any((folder / part / WEIGHTS).is_file() for part in ("", *FOLDERS))
    }
    if not loaded:
        raise ConfigError(f"{result.folder}: holds no policy; valid is to add it without --verify")
    return loaded.get("") or PerAgent(*(loaded.get(name, Idle()) for name in AGENTS))


def _check_case(submission: Submission, seeds: int, case: CaseResults) -> None:
    """Check that seeds, weeks and values of a case are complete and of the same data centers.

    Raises:
        ConfigError: the check failed; the message names the place and what would be valid.
    """
    results = submission.of_case(case.name)
    place = f"{submission.store.folder}: case {case.name}"
    rows = [x for name, x in case.rows.items() if case.kinds[name] not in (ACHIEVED, BOUND)]
    # If events are sampled, the objective of idle commands depends on the seed.
    needed = len(max(rows, key=len, default=())) if _idle_differs(rows) else 1
    needed = max(needed, seeds) if submission.about.kind == LEARNER else needed
    if sorted(x.seed for x in results) != list(range(needed)):
        raise ConfigError(
            f"{place}: seeds {', '.join(str(x.seed) for x in results)}; valid are {needed} of "
            "them, from 0, as of the suite"
        )
    check_weeks(case.name, case.settings.weeks, {**case.rows, submission.row: results})
    for result in results:
        whole = result.frame[result.frame["moves"] == ALL]
        for name in METRIC_COLUMNS:
            if whole[name].isna().any():
                path = submission.store.rows_path(result.record.partition)
                raise ConfigError(f"{path}: column {name}; valid is a finite number in each row")


def _idle_differs(rows: Sequence[Sequence[RowResult]]) -> bool:
    """Return True if the objective of idle commands differs between the seeds of a row."""
    return any(
        not np.array_equal(x.frame["idle_figure"], results[0].frame["idle_figure"])
        for results in rows
        for x in results
    )
