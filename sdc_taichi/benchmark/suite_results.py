"""Results of suites as folders hold them, put together for reports.

Everything is read from the folders alone, so results of others, of other machines and of other
versions stand beside each other, as long as they are of the same weeks of the same data centers.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.benchmark.jobs import digest_of
from sdc_taichi.benchmark.store import MOST_FILE_BYTES, STUDY_FILE, ResultStore, read_json
from sdc_taichi.benchmark.suite import REFERENCE, Case, Suite, make_suite
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.learning.evaluation import ALL, Evaluation
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.user_file import decoding, read_bytes

if TYPE_CHECKING:
    import pandas as pd

ACHIEVED, BOUND, LEARNER = "optimum", "bound", "learner"
PLANNER, RULE, OTHER = "planner", "rule", "other"
"""Kinds of rows: the optimum's achieved path, its bound, what was trained, model-predictive
control, other controllers by name, and what is not known."""
SUBMISSION_FILE, SUBMISSION_FORMAT = "submission.json", "sdc-submission/1"
"""File in the folder of a row that others have made, which says who made it, and its format."""
SUBMISSION_KEYS = {"author": str, "about": str, "link": str, "kind": str}
"""Entries of that file."""
COLUMNS = ("suite", "case", "row", "seed")
"""Columns of the partition of a result of a suite."""
_SAME = 1e-6
"""Largest relative difference of figures of idle commands between results of the same weeks."""


@dataclass(frozen=True, slots=True)
class RowResult:
    """A row of a case with one seed."""

    store: ResultStore
    """Where it is."""
    content: Mapping[str, Any]
    """Content of its metrics.json."""
    frame: pd.DataFrame
    """Its rows, one for each data-center week, and for each agent that was run alone."""
    submission: Mapping[str, Any] | None
    """Who made it and how, of results of others."""

    @property
    def folder(self) -> Path:
        """Folder with its metrics.json."""
        return self.store.folder_of(self.content["partition"])

    @property
    def seed(self) -> int:
        """Its seed."""
        return int(self.content["partition"]["seed"])

    @property
    def kind(self) -> str:
        """Kind of its row, such as ``learner``."""
        row = self.content["values"].get("row")
        if self.submission is not None:
            return LEARNER if self.submission["kind"] == LEARNER else OTHER
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
    """Objective of its figures."""
    rows: Mapping[str, Sequence[RowResult]]
    """Results of each row by seed; rows in the order of the suite, those of others last."""
    missing: tuple[str, ...]
    """Results that were asked for and are not there, as ``ROW, seed SEED``."""
    bound: Mapping[tuple[str, int], float]
    """Bound of the figure by site and week, where it is known."""
    optima_core_s: float
    """Processor time that its optima took, in s."""

    @property
    def kinds(self) -> dict[str, str]:
        """Kind of each row."""
        return {name: results[0].kind for name, results in self.rows.items()}


@dataclass(frozen=True, slots=True)
class SuiteResults:
    """All results of a suite."""

    suite: Suite
    """The suite, as study.json has it."""
    quick: bool
    """Whether they are those of its quick form."""
    commands: tuple[str, ...]
    """Command lines that made the results."""
    cases: Mapping[str, CaseResults]
    """Results of each case, in the order of the suite."""

    @property
    def name(self) -> str:
        """Name of the suite."""
        return self.suite.name


def read_suites(folders: Sequence[Path]) -> list[SuiteResults]:
    """Read results of suites, each suite from all folders that hold results of it.

    Args:
        folders: folders of studies.

    Raises:
        SdcError: a folder without a study of a suite, a damaged result, or results that are not of
            the same weeks of the same data centers.
    """
    found: dict[str, list[tuple[ResultStore, dict[str, Any]]]] = {}
    for folder in folders:
        store = ResultStore(folder)
        study = store.study()
        if study["kind"] != "suite":
            raise ConfigError(f"{folder}: holds a {study['kind']}; valid is a suite")
        found.setdefault(suite_of(store, study).name, []).append((store, study))
    return [_suite(studies) for studies in found.values()]


def suite_of(store: ResultStore, study: Mapping[str, Any]) -> Suite:
    """The suite of a study.

    Args:
        store: where the study is.
        study: content of study.json.

    Raises:
        ConfigError: it has none, or one that is not valid.
    """
    values, place = study["settings"].get("suite"), store.folder / STUDY_FILE
    if not isinstance(values, dict):
        raise ConfigError(f"{place}: settings.suite {shortened(values)}; valid is a suite")
    return make_suite(values, f"{place}: settings.suite")


def read_result(store: ResultStore, content: Mapping[str, Any]) -> RowResult:
    """Read the rows of a result and see that they are those that its metrics.json tells of.

    Args:
        store: where it is.
        content: content of its metrics.json.

    Raises:
        SdcError: a file is missing or damaged, or its rows are not those of a row of a suite.
    """
    import pandas as pd

    partition = content["partition"]
    path = store.rows_path(partition)
    data = read_bytes(path, MOST_FILE_BYTES)
    if digest_of(data) != content["rows_sha256"]:
        raise ConfigError(f"{path}: is not the file that {store.folder_of(partition)} tells of")
    with decoding(path, "a Parquet file"):
        frame = pd.read_parquet(io.BytesIO(data))
    needed = ("moves", "site", "week", "figure", "valued_figure", "idle_figure", "achieved_figure")
    lacking = [name for name in needed if name not in frame.columns]
    if lacking or frame.empty:
        raise ConfigError(f"{path}: no {', '.join(lacking) or 'rows'}; valid are rows of a suite")
    submission = store.folder_of(partition).parent / SUBMISSION_FILE
    about = None
    if submission.exists():
        about = read_json(submission, SUBMISSION_FORMAT, SUBMISSION_KEYS)
    return RowResult(store, content, frame, about)


def evaluation_of(case: CaseResults) -> Evaluation:
    """Results of a case as an evaluation, rows as controllers and seeds as trainings.

    What agents do alone is left in it, but for the optimum, whose figures are ``alone``.

    Args:
        case: the case.
    """
    import pandas as pd

    frames, alone = [], {}
    for name, results in case.rows.items():
        for result in results:
            own = result.frame.assign(controller=name, training=result.seed)
            if result.kind == ACHIEVED:
                alone = {
                    str(moves): part["figure"].to_numpy(np.float64)
                    for moves, part in own[own["moves"] != ALL].groupby("moves", sort=False)
                }
                own = own[own["moves"] == ALL]
            frames.append(own)
    rows = pd.concat([each.astype({"broken": object}) for each in frames], ignore_index=True)
    first = frames[0][frames[0]["moves"] == ALL]
    sites = list(dict.fromkeys(first["site"]))
    return Evaluation(
        rows=rows,
        objective=case.objective,
        alone=alone,
        strata=np.array([sites.index(site) for site in first["site"]], dtype=np.int64),
        missing=(),
    )


def weeks_of_frame(frame: pd.DataFrame) -> dict[tuple[str, int], float]:
    """Figure of idle commands by site and week, of the rows of a result.

    Args:
        frame: its rows.
    """
    whole = frame[frame["moves"] == ALL]
    keys = zip(map(str, whole["site"]), map(int, whole["week"]), strict=True)
    return dict(zip(keys, map(float, whole["idle_figure"]), strict=True))


def _suite(studies: Sequence[tuple[ResultStore, Mapping[str, Any]]]) -> SuiteResults:
    """Results of one suite from several folders."""
    suite = suite_of(*studies[0])
    references: list[Mapping[str, Any]] = []
    found: dict[str, dict[str, dict[int, RowResult]]] = {case: {} for case in suite.cases}
    asked: dict[tuple[str, str, int], None] = {}
    for store, study in studies:
        for partition in map(checked_partition, study["partitions"]):
            if not partition["row"].startswith(REFERENCE):
                asked[partition["case"], partition["row"], int(partition["seed"])] = None
        for content in store.results():
            partition = checked_partition(content["partition"])
            if partition["row"].startswith(REFERENCE):
                references.append(content)
                continue
            if partition["case"] not in found:
                raise ConfigError(
                    f"{store.folder_of(partition)}: suite {suite.name} has no such case; valid: "
                    f"{', '.join(found)}"
                )
            by_seed = found[partition["case"]].setdefault(partition["row"], {})
            _take(by_seed, read_result(store, content))
    order = [*suite.rows]
    cases = {}
    for case, rows in found.items():
        if not rows:
            continue
        names = [row for row in order if row in rows] + [row for row in rows if row not in order]
        results = {row: [rows[row][seed] for seed in sorted(rows[row])] for row in names}
        _check_weeks(case, results)
        missing = tuple(
            f"{row}, seed {seed}"
            for of, row, seed in asked
            if of == case and seed not in rows.get(row, {})
        )
        own = [content for content in references if content["partition"]["case"] == case]
        cases[case] = CaseResults(
            suite=suite.name,
            name=case,
            settings=suite.cases[case],
            objective=Objective.parse(suite.objective),
            rows=results,
            missing=missing,
            bound=_bounds(own),
            optima_core_s=sum(float(content["core_s"]) for content in own),
        )
    if not cases:
        raise ConfigError(
            f"{studies[0][0].folder}: holds no results; valid is a suite that was run"
        )
    commands = tuple(dict.fromkeys(study["command"] for _, study in studies))
    return SuiteResults(
        suite=suite,
        quick=any(study["settings"].get("quick") is True for _, study in studies),
        commands=commands,
        cases=cases,
    )


def checked_partition(partition: Mapping[str, Any]) -> Mapping[str, str]:
    """A partition of a suite.

    Args:
        partition: its columns and values.

    Raises:
        ConfigError: other columns, or a seed that is no number.
    """
    texts = [partition.get(column) for column in COLUMNS]
    if set(partition) != set(COLUMNS) or not all(isinstance(text, str) for text in texts):
        raise ConfigError(f"partition {dict(partition)}: valid columns are {', '.join(COLUMNS)}")
    if not re.fullmatch("0|[1-9][0-9]{0,5}", str(partition["seed"])):
        raise ConfigError(f"partition {dict(partition)}: seed; valid is a whole number")
    return partition


def _take(by_seed: dict[int, RowResult], result: RowResult) -> None:
    """Take a result, unless an equal one of another folder is there.

    Raises:
        ConfigError: another one is there.
    """
    other = by_seed.setdefault(result.seed, result)
    if other.content["rows_sha256"] != result.content["rows_sha256"]:
        raise ConfigError(
            f"{result.folder} and {other.folder}: hold other results of one seed of one row; valid "
            "is one of them"
        )


def _check_weeks(case: str, rows: Mapping[str, Sequence[RowResult]]) -> None:
    """See that all rows of a case are of the same weeks of the same data centers.

    Raises:
        ConfigError: they are not.
    """
    idle: dict[int, dict[tuple[str, int], float]] = {}
    first = next(iter(rows.values()))[0]
    for result in (result for results in rows.values() for result in results):
        own = weeks_of_frame(result.frame)
        known = idle.setdefault(result.seed, own)
        if list(own) != list(weeks_of_frame(first.frame)):
            raise ConfigError(
                f"{result.folder}: is of other sites or weeks than {first.folder}, of the same "
                f"case {case}; valid are equal ones"
            )
        worst = max(own, key=lambda key: _relative(own[key], known[key]))
        if _relative(own[worst], known[worst]) > _SAME:
            raise ConfigError(
                f"{result.folder}: idle commands reach {own[worst]:.8g} in week {worst[1]} of "
                f"{worst[0]}, and {known[worst]:.8g} elsewhere in case {case}; valid are results "
                "of the same data centers"
            )


def _relative(value: float, other: float) -> float:
    """Difference of two figures over the larger one; infinite where it is not defined."""
    size = max(abs(value), abs(other))
    if not np.isfinite(size):
        return float("inf")
    return abs(value - other) / size if size else 0.0


def _bounds(references: Sequence[Mapping[str, Any]]) -> dict[tuple[str, int], float]:
    """Bound of the figure by site and week, from the results of jobs that solved for optima."""
    found: dict[tuple[str, int], float] = {}
    for content in references:
        metrics = content["metrics"]
        if metrics.get("part") != "held-out":
            continue
        site, weeks, bounds = (metrics.get(name) for name in ("site", "weeks", "bound_figure"))
        lists = isinstance(weeks, list) and isinstance(bounds, list) and len(weeks) == len(bounds)
        if not lists or {type(x) for x in (*weeks, *bounds)} - {int, float, type(None)}:
            name = "/".join(content["partition"].values())
            raise ConfigError(
                f"metrics.json of {name}: bound_figure {shortened(bounds)} for weeks "
                f"{shortened(weeks)}; valid are as many numbers"
            )
        pairs = zip(weeks, bounds, strict=True)
        found |= {(str(site), week): bound for week, bound in pairs if bound is not None}
    return found
