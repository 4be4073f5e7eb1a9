"""Rows that other people have run, which are checked and join the results of a suite.

The folder is laid out as that of a study, with ``submission.json`` beside it, which names the
author. The checks are of schema and completeness: figures that were made up with care pass them, so
``rerun`` runs submitted policies again and compares the figures.
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
from sdc_taichi.benchmark.cases import data_centers
from sdc_taichi.benchmark.jobs import DoneJob, Job, check_file_name, parquet
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
from sdc_taichi.control import PERFECT, Controller, ForecastError, Idle, PerAgent
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
"""Valid name of a row."""
_SAME = 1e-3
"""Largest relative difference of figures that are run again: policies magnify the last bits, which
differ between processors."""
_NEEDED = ("figure", "idle_figure", "cfp_kg", "grid_kwh", "hvac_kwh", "it_kwh", "water_l")


@dataclass(frozen=True, slots=True)
class Submission:
    """A row as its folder holds it."""

    store: ResultStore
    """The folder."""
    about: SubmissionRecord
    """Content of submission.json."""
    suite: str
    """Name of the suite."""
    row: str
    """Name of the row."""
    results: tuple[RowResult, ...]
    """Its results by case and seed."""

    def of_case(self, name: str) -> list[RowResult]:
        """Results of one case."""
        return [x for x in self.results if x.record.partition["case"] == name]

    @property
    def cases(self) -> tuple[str, ...]:
        """Names of the cases that it has results of."""
        return tuple(dict.fromkeys(x.record.partition["case"] for x in self.results))


def read_submission(folder: Path) -> Submission:
    """Read the folder of a submitted row and check its schema.

    Args:
        folder: the folder.

    Raises:
        SdcError: files are missing, damaged, of another format or of another version of the
            package, or belong to several rows.
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
    """Check that a row belongs to a suite and is complete.

    Args:
        submission: the row.
        suite: results of the suite that the row is to join.

    Raises:
        ConfigError: the name is taken or not valid, the suite or case is another, or seeds, weeks
            or figures are missing.
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
    """Check a row and copy it into the results of a suite.

    Args:
        folder: folder with the results of the row.
        to: folder of the study of the suite.

    Raises:
        SdcError: the row is not valid, another process uses ``to``, or it cannot be written.
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
            # Written first, so that a row never appears without its author.
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
    """Write the folder of a row that was not run by this package, to be added to a suite.

    Args:
        out: the folder.
        frames: rows of each seed, one for each data-center week in the order of the suite, with the
            columns of the suite's rows.
        suite: name of the suite.
        case: name of the case.
        row: name of the row.
        kind: ``learner``, which has all seeds of the suite, or ``controller``.
        author: name of the author.
        about: description of the row in a sentence.
        link: address of more information.
        files: further files of each seed by their paths, such as a policy.

    Raises:
        SdcError: a name that is not valid, or a file that cannot be written.
    """
    record = SubmissionRecord(author=author, about=about, link=link, kind=kind)
    write_record(out / SUBMISSION_FILE, record)
    store = ResultStore(out)
    for seed, frame in frames.items():
        partition = dict(zip(COLUMNS, (suite, case, row, str(seed)), strict=True))
        of_seed = dict((files or {}).get(seed, {}))
        for name in of_seed:
            check_file_name(name)
        job = Job("", {"name": row, "seed": seed}, partition)
        store.keep(DoneJob(job, rows=parquet(frame), files=of_seed))


def rerun(submission: Submission, to: Path, weeks: int, progress: Progress | None = None) -> float:
    """Run the policies of a row again in some weeks of each site, and compare the figures.

    Args:
        submission: the row.
        to: folder of the study of its suite.
        weeks: number of weeks of each site, 1 or more and no more than the case has.
        progress: progress callback ``(stage, done, total)``; counts results.

    Returns:
        Largest relative difference of the figure of a week.

    Raises:
        SdcError: no policies, policies that do not fit, too many weeks, or figures that the
            policies do not reach.
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
    """Largest relative difference of the figures of one result in some weeks of each site."""
    settings, count = case.settings, len(case.settings.weeks)
    if weeks > count:
        raise ConfigError(f"verify {weeks}: case {case.name} has {count} weeks; valid are no more")
    error = result.record.metrics.get("forecast_error")
    with prepare(
        data_centers(settings, "held-out"),
        [settings.weeks[count * k // weeks] for k in range(weeks)],
        objective=case.objective,
        optimum=False,
        days=settings.days,
        seed=result.seed,
        forecast_error=PERFECT if error is None else ForecastError.parse(str(error)),
    ) as prepared:
        controller = _submitted_policy(result, prepared.sim.fleet)
        again = evaluate(prepared, [Contender("again", controller)], beside=False).rows
    whole = result.frame[result.frame["moves"] == ALL]
    both = again.merge(whole, on=["site", "week"], suffixes=("", "_stated"))
    difference = ((both["figure_stated"] - both["figure"]) / both["figure"]).abs()
    if (worst := float(difference.max())) > _SAME:
        row = both.iloc[int(np.argmax(difference))]
        raise ConfigError(
            f"{result.folder}: week {row['week']} of {row['site']}: figure "
            f"{row['figure_stated']:.9g}, and its policy reaches {row['figure']:.9g}; valid are "
            "figures of the policy"
        )
    return worst


def _submitted_policy(result: RowResult, fleet: Fleet) -> Controller:
    """The policy of a result as a controller, or one policy for each agent.

    Raises:
        SdcError: the result has no policy, or one that does not fit.
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
    """Check that seeds, weeks and figures of a case are complete and of the same data centers.

    Raises:
        ConfigError: naming the place and what would be valid.
    """
    results = submission.of_case(case.name)
    place = f"{submission.store.folder}: case {case.name}"
    rows = [x for name, x in case.rows.items() if case.kinds[name] not in (ACHIEVED, BOUND)]
    # Where events are sampled, idle commands reach other figures with each seed.
    needed = len(max(rows, key=len, default=())) if _idle_differs(rows) else 1
    needed = max(needed, seeds) if submission.about.kind == LEARNER else needed
    if sorted(x.seed for x in results) != list(range(needed)):
        raise ConfigError(
            f"{place}: seeds {', '.join(str(x.seed) for x in results)}; valid are {needed} of "
            "them, from 0, as of the suite"
        )
    check_weeks(case.name, {**case.rows, submission.row: results})
    for result in results:
        whole = result.frame[result.frame["moves"] == ALL]
        for name in _NEEDED:
            if name not in whole or not np.isfinite(whole[name].to_numpy(np.float64)).all():
                raise ConfigError(f"{place}: column {name}; valid is a finite number in each row")


def _idle_differs(rows: Sequence[Sequence[RowResult]]) -> bool:
    """Whether figures of idle commands differ between the seeds of a row."""
    return any(
        not np.array_equal(x.frame["idle_figure"], results[0].frame["idle_figure"])
        for results in rows
        for x in results
    )
