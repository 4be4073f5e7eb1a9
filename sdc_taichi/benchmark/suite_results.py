"""Results of suites, read from folders and combined for reports.

The folders contain all required data. Results of other authors, machines and package versions can
therefore be compared if they have the same weeks of the same data centers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from sdc_taichi.benchmark.result_table import PLACE, read_suite_rows
from sdc_taichi.benchmark.store import (
    METRICS_FILE,
    STUDY_FILE,
    Record,
    ResultRecord,
    ResultStore,
    read_record,
)
from sdc_taichi.benchmark.suite import REFERENCE, TRIAL, Case, Suite, make_suite
from sdc_taichi.config import validated
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.learning.evaluation import ALL, Evaluation, strata_of
from sdc_taichi.learning.training_settings import MOST_STEPS
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import ALL_AGENTS
from sdc_taichi.optimum.uncoordinated import WAYS

if TYPE_CHECKING:
    import pandas as pd

ACHIEVED, BOUND, LEARNER = "optimum", "bound", "learner"
PLANNER, RULE, OTHER = "planner", "rule", "other"
"""Kinds of rows: achieved path of the optimum, bound of the optimum, trained policy, model
predictive control, other built-in or user-defined controller, and submitted controller."""
SUBMISSION_FILE = "submission.json"
"""Name of the file with the author of a submitted row."""
COLUMNS = ("suite", "case", "row", "seed")
"""Columns that identify a result of a suite (its partition)."""
_SAME = 1e-6
"""Maximum relative difference of idle commands' objective between results of the same weeks."""
_Text = Annotated[str, Field(max_length=1000)]


class TrainingMetrics(Record):
    """Metrics of a training that others read."""

    steps: Annotated[int, Field(ge=0, le=MOST_STEPS)]
    """Number of steps, summed over all data centers."""
    gradient_steps: Annotated[int, Field(ge=0, le=MOST_STEPS)] = 0
    """Number of gradient steps of each learner."""
    validation: dict[str, float | None] | None = None
    """Best result in the validation weeks: ``change_pct``, ``share`` and ``broken_weeks``; None
    without validation."""


class TrialMetrics(Record):
    """Metrics of a trial of settings that others read."""

    learning: dict[str, Any]
    """Settings of the trial that differ from the defaults."""
    trainings: dict[_Text, TrainingMetrics]
    """Metrics of the training."""

    @property
    def change_pct(self) -> float:
        """Change against idle commands in the validation weeks, in %; inf without validation."""
        (training,) = self.trainings.values()
        change = (training.validation or {}).get("change_pct")
        return math.inf if change is None else change


class RowMetrics(Record):
    """Metrics of a result of a row that others read; results of other software have none."""

    chosen: _Text | None = None
    """Name of the controller that was chosen in the validation weeks."""
    trainings: dict[_Text, TrainingMetrics] = Field(default={})
    """Metrics of the training, or of that of each agent."""


class SubmissionRecord(Record):
    """Content of ``submission.json``: author and description of a submitted row."""

    format: Literal["sdc-submission/1"] = "sdc-submission/1"
    """Name and version of the format."""
    author: _Text
    """Name of the author."""
    about: _Text
    """Description of the row in one sentence."""
    link: _Text
    """Web address with more information."""
    kind: Literal["learner", "controller"]
    """Kind of the row: ``learner`` for a trained method with all seeds of the suite, ``controller``
    for any other."""


@dataclass(frozen=True, slots=True)
class RowResult:
    """Result of a row of a case with one seed."""

    store: ResultStore
    """Storage of the study that contains the result."""
    record: ResultRecord
    """Content of the result's ``metrics.json``."""
    frame: pd.DataFrame
    """Table rows: one for each data-center week, and further ones for each agent that also ran
    alone."""
    submission: SubmissionRecord | None
    """Author and description of a submitted row; None if the row is part of the suite."""

    @property
    def folder(self) -> Path:
        """Folder with the ``metrics.json`` of the result."""
        return self.store.folder_of(self.record.partition)

    @property
    def seed(self) -> int:
        """Seed of the result."""
        return int(self.record.partition["seed"])

    @property
    def trainings(self) -> list[TrainingMetrics]:
        """Metrics of the trainings of the result."""
        return list(RowMetrics.model_validate(self.record.metrics).trainings.values())

    @property
    def kind(self) -> str:
        """Kind of the result's row, such as ``learner``."""
        row = self.record.values.get("row")
        if self.submission is not None:
            return LEARNER if self.submission.kind == LEARNER else OTHER
        if not isinstance(row, Mapping):
            return OTHER
        if row.get("optimum") is not None:
            return BOUND if row["optimum"] == "bound" else ACHIEVED
        if row.get("train") is not None:
            return LEARNER
        return PLANNER if "mpc" in str(row.get("controller")) else RULE


@dataclass(frozen=True, slots=True)
class CaseResults:
    """All results of a case of a suite."""

    suite: str
    """Name of the suite."""
    name: str
    """Name of the case."""
    settings: Case
    """Data centers and weeks of the case."""
    objective: Objective
    """Objective by which the rows are compared."""
    rows: Mapping[str, Sequence[RowResult]]
    """Results of each row, sorted by seed; rows are in the order of the suite, with submitted rows
    last."""
    missing: tuple[str, ...]
    """Planned results that do not exist yet, as ``ROW, seed SEED``."""
    trials: Sequence[ResultRecord]
    """Results of the trials of settings."""
    optima_core_s: float
    """Processor time for computing the optima of the case, in s."""

    @property
    def kinds(self) -> dict[str, str]:
        """Kind of each row."""
        return {name: results[0].kind for name, results in self.rows.items()}

    @property
    def results(self) -> list[RowResult]:
        """Results of all rows and seeds."""
        return [result for results in self.rows.values() for result in results]


@dataclass(frozen=True, slots=True)
class SuiteResults:
    """All results of a suite."""

    suite: Suite
    """The suite, as recorded in ``study.json``."""
    quick: bool
    """True if the results are from the short version of the suite."""
    commands: tuple[str, ...]
    """Command lines that produced the results."""
    cases: Mapping[str, CaseResults]
    """Results of each case, in the order of the suite."""

    @property
    def name(self) -> str:
        """Name of the suite."""
        return self.suite.name

    @property
    def results(self) -> list[RowResult]:
        """Results of all cases."""
        return [result for case in self.cases.values() for result in case.results]


def read_suites(folders: Sequence[Path]) -> list[SuiteResults]:
    """Read the results of suites; results of a suite in several folders are combined.

    Raises:
        SdcError: a folder contains no study of a suite, a result is damaged, or results differ in
            their weeks or data centers.
    """
    stores: dict[str, list[ResultStore]] = {}
    for store in map(ResultStore, folders):
        stores.setdefault(suite_of(store).name, []).append(store)
    return [_suite(group) for group in stores.values()]


def suite_of(store: ResultStore) -> Suite:
    """Return the suite of a study.

    Raises:
        ConfigError: the study is not a run of a suite, or its suite is not valid.
    """
    study = store.study()
    if study.kind != "suite":
        raise ConfigError(f"{store.folder}: holds a {study.kind}; valid is a suite")
    values, place = study.settings.get("suite"), store.folder / STUDY_FILE
    if not isinstance(values, dict):
        raise ConfigError(f"{place}: settings.suite {shortened(values)}; valid is a suite")
    return make_suite(values, f"{place}: settings.suite")


def read_result(store: ResultStore, record: ResultRecord) -> RowResult:
    """Read the table rows of a result, and check them against the digest in ``metrics.json``.

    Args:
        store: storage of the study that contains the result.
        record: content of the result's ``metrics.json``.

    Raises:
        SdcError: a file is missing or damaged, or does not contain results of a suite.
    """
    place = store.folder_of(record.partition) / METRICS_FILE
    validated(RowMetrics, record.metrics, f"{place}: metrics")
    frame = read_suite_rows(store.rows_file(record), store.rows_path(record.partition))
    about = store.folder_of(record.partition).parent / SUBMISSION_FILE
    submission = read_record(about, SubmissionRecord) if about.exists() else None
    return RowResult(store, record, frame, submission)


def evaluation_of(case: CaseResults) -> Evaluation:
    """Convert results of a case to an evaluation, with rows as controllers, seeds as trainings.

    Runs of single agents are included, except for those of the optimum, whose objective values
    become ``Evaluation.alone`` and ``Evaluation.uncoordinated``.
    """
    import pandas as pd

    frames, beside = [], {}
    for name, results in case.rows.items():
        for result in results:
            frame = result.frame.assign(controller=name, training=result.seed)
            if result.kind == ACHIEVED:
                beside = {
                    str(moves): part["figure"].to_numpy(np.float64)
                    for moves, part in frame[frame["moves"] != ALL].groupby("moves", sort=False)
                }
                frame = frame[frame["moves"] == ALL]
            frames.append(frame)
    rows = pd.concat([each.astype({"broken": object}) for each in frames], ignore_index=True)
    first = frames[0][frames[0]["moves"] == ALL]
    return Evaluation(
        rows=rows,
        objective=case.objective,
        alone={moves: x for moves, x in beside.items() if moves in ALL_AGENTS},
        uncoordinated={moves: x for moves, x in beside.items() if moves in WAYS},
        strata=strata_of(first["site"], first["year"]),
        missing=(),
    )


def check_partition(partition: Mapping[str, str]) -> None:
    """Check that a partition can identify a result of a suite.

    Raises:
        ConfigError: the columns are not ``COLUMNS``, or the seed is not a whole number.
    """
    if set(partition) != set(COLUMNS):
        raise ConfigError(
            f"partition {shortened(partition)}: valid columns are {', '.join(COLUMNS)}"
        )
    if not re.fullmatch("0|[1-9][0-9]{0,5}", partition["seed"]):
        raise ConfigError(
            f"partition {shortened(partition)}: seed {shortened(partition['seed'])}; valid is a "
            "whole number"
        )


def check_weeks(
    case: str, weeks_of_case: Sequence[int], rows: Mapping[str, Sequence[RowResult]]
) -> None:
    """Check that all rows of a case have the same weeks of the same data centers.

    Raises:
        ConfigError: the weeks differ, or the objective of idle commands differs for equal seeds.
    """
    first_of_seed: dict[int, pd.DataFrame] = {}
    first = next(iter(rows.values()))[0]
    index = _weeks(first).index
    other_weeks = set(index.unique("week")) - set(weeks_of_case)
    if other_weeks:
        raise ConfigError(
            f"{first.folder}: has rows of week {min(other_weeks)}; valid are weeks "
            f"{', '.join(map(str, weeks_of_case))} of case {case}"
        )
    for result in (result for results in rows.values() for result in results):
        weeks = _weeks(result)
        if not weeks.index.equals(index):
            raise ConfigError(
                f"{result.folder}: is of other sites, years or weeks than {first.folder}, of the "
                f"same case {case}; valid are equal ones"
            )
        idle = weeks["idle_figure"]
        known = first_of_seed.setdefault(result.seed, weeks)["idle_figure"]
        same = np.isclose(idle, known, rtol=_SAME, atol=0.0)
        if not same.all():
            at = weeks.index[int(np.argmin(same))]
            site, year, week = at
            raise ConfigError(
                f"{result.folder}: idle commands reach {idle[at]:.8g} in week {week} of year "
                f"{year} of {site}, and {known[at]:.8g} elsewhere in case {case}; valid are "
                "results of the same data centers"
            )


def _weeks(result: RowResult) -> pd.DataFrame:
    """Return the table rows of a result in which all agents act, indexed by site, year and week."""
    return result.frame[result.frame["moves"] == ALL].set_index([*PLACE])


def _suite(stores: Sequence[ResultStore]) -> SuiteResults:
    """Combine the results of one suite from several folders."""
    suite, studies = suite_of(stores[0]), [store.study() for store in stores]
    references: list[ResultRecord] = []
    trials: list[ResultRecord] = []
    rows: dict[str, dict[str, dict[int, RowResult]]] = {case: {} for case in suite.cases}
    for store in stores:
        for record in store.results():
            check_partition(record.partition)
            case, row = record.partition["case"], record.partition["row"]
            if case not in rows:
                raise ConfigError(
                    f"{store.folder_of(record.partition)}: suite {suite.name} has no such case; "
                    f"valid: {', '.join(rows)}"
                )
            if row.startswith(REFERENCE):
                references.append(record)
            elif row.startswith(TRIAL):
                validated(TrialMetrics, record.metrics, f"{store.folder_of(record.partition)}")
                trials.append(record)
            else:
                _add(rows[case].setdefault(row, {}), read_result(store, record))
    wanted: dict[str, dict[tuple[str, int], None]] = {}
    for partition in (x for study in studies for x in study.partitions):
        check_partition(partition)
        if not partition["row"].startswith((REFERENCE, TRIAL)):
            pair = partition["row"], int(partition["seed"])
            wanted.setdefault(partition["case"], {})[pair] = None
    cases = {}
    for name, of_case in rows.items():
        if not of_case:
            continue
        order = [*(row for row in suite.rows if row in of_case), *of_case]
        results = {row: [x for _, x in sorted(of_case[row].items())] for row in order}
        check_weeks(name, suite.cases[name].weeks, results)
        solved = [x for x in references if x.partition["case"] == name]
        cases[name] = CaseResults(
            suite=suite.name,
            name=name,
            settings=suite.cases[name],
            objective=Objective.parse(suite.objective),
            rows=results,
            missing=tuple(
                f"{row}, seed {seed}"
                for row, seed in wanted.get(name, ())
                if seed not in of_case.get(row, {})
            ),
            trials=[x for x in trials if x.partition["case"] == name],
            optima_core_s=sum(x.core_s for x in solved),
        )
    if not cases:
        raise ConfigError(f"{stores[0].folder}: holds no results; valid is a suite that was run")
    return SuiteResults(
        suite=suite,
        quick=any(study.settings.get("quick") is True for study in studies),
        commands=tuple(dict.fromkeys(study.command for study in studies)),
        cases=cases,
    )


def _add(by_seed: dict[int, RowResult], result: RowResult) -> None:
    """Add a result to the results by seed; ignore a duplicate from another folder.

    Raises:
        ConfigError: another folder has a different result with the same seed.
    """
    other = by_seed.setdefault(result.seed, result)
    if other.record.rows_sha256 != result.record.rows_sha256:
        raise ConfigError(
            f"{result.folder} and {other.folder}: hold other results of one seed of one row; valid "
            "is one of them"
        )
