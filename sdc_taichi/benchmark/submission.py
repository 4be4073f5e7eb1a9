"""Rows of others: a folder with the results of one row is checked and put among those of a suite.

The folder is laid out as that of a study, with ``submission.json`` in it, which says who made the
row. docs/submissions.md tells how to make one.
"""

from __future__ import annotations

import io
import json
import os
import re
import stat
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.atomic_file import FileClaim, atomic_write, naming_errors
from sdc_taichi.benchmark.cases import data_centers
from sdc_taichi.benchmark.jobs import DoneJob, Job, check_file_name
from sdc_taichi.benchmark.store import (
    JOBS,
    METRICS_FILE,
    RESULTS,
    STUDY_FILE,
    ResultStore,
    read_json,
)
from sdc_taichi.benchmark.submission_checks import KnownCase, check_rows
from sdc_taichi.benchmark.suite import REFERENCE
from sdc_taichi.benchmark.suite_results import (
    ACHIEVED,
    BOUND,
    COLUMNS,
    LEARNER,
    SUBMISSION_FILE,
    SUBMISSION_FORMAT,
    SUBMISSION_KEYS,
    CaseResults,
    RowResult,
    SuiteResults,
    checked_partition,
    read_result,
    read_suites,
)
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.learning.evaluation import ALL
from sdc_taichi.learning.split import UNSCORED_DAYS, data_center_weeks
from sdc_taichi.sim.drivers import load_drivers
from sdc_taichi.types import F64
from sdc_taichi.user_file import list_folder, read_bytes

if TYPE_CHECKING:
    import pandas as pd

KINDS = (LEARNER, "controller")
"""Kinds of rows of others: those that were trained, with all seeds of the suite, and all others."""
ROW_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,79}")
"""Name of a row."""
MOST_FILES = 10_000
"""Largest number of files of a submission."""
MOST_BYTES = 512_000_000
"""Largest size of all files of a submission together, in bytes."""
MOST_LETTERS = 1_000
"""Largest length of a text of submission.json that the report shows, in letters."""
_MOST_UNPACKED_BYTES = 256_000_000
_MOST_CORE_S = 1e12
_AT_TOP = (JOBS, RESULTS, STUDY_FILE, SUBMISSION_FILE)


@dataclass(frozen=True, slots=True)
class Submission:
    """A row of others, as its folder holds it."""

    store: ResultStore
    """The folder."""
    about: Mapping[str, Any]
    """Content of submission.json: ``author``, ``about``, ``link`` and ``kind``."""
    suite: str
    """Suite that the row is of."""
    row: str
    """Name of the row."""
    results: tuple[RowResult, ...]
    """Its results by case and seed."""

    @property
    def cases(self) -> tuple[str, ...]:
        """Cases that it has results of."""
        return tuple(dict.fromkeys(_of(result, "case") for result in self.results))


def read_submission(folder: Path) -> Submission:
    """Read the folder of a row of others, whose files must be those that its metrics.json tell of.

    Args:
        folder: the folder.

    Raises:
        SdcError: links, special files, files that are too many, too large, missing, damaged or not
            told of, results of another version, or of several rows.
    """
    _check_files(folder)
    store = ResultStore(folder)
    about = read_json(folder / SUBMISSION_FILE, SUBMISSION_FORMAT, SUBMISSION_KEYS)
    contents = list(store.results())
    for content in contents:
        checked_partition(content["partition"])
    if not contents:
        raise ConfigError(f"{folder}: holds no results; valid is a metrics.json for each seed")
    names = [
        {column: content["partition"].get(column) for column in ("suite", "row")}
        for content in contents
    ]
    if any(name != names[0] for name in names):
        raise ConfigError(f"{folder}: holds {names[0]} and others; valid is one row of one suite")
    results = []
    for content in contents:
        _check_content(store, content)
        _check_parquet(store.rows_path(content["partition"]))
        results.append(read_result(store, content))
    if about["kind"] not in KINDS:
        raise ConfigError(
            f"{folder / SUBMISSION_FILE}: kind {shortened(about['kind'])}; valid are "
            f"{', '.join(KINDS)}"
        )
    for key in ("author", "about", "link"):
        if len(about[key]) > MOST_LETTERS:
            raise ConfigError(
                f"{folder / SUBMISSION_FILE}: {key} of {len(about[key]):,} letters; valid are at "
                f"most {MOST_LETTERS:,}"
            )
    suite, row = (str(names[0][column]) for column in ("suite", "row"))
    return Submission(store, about, suite, row, tuple(results))


def check_submission(submission: Submission, suite: SuiteResults) -> tuple[str, ...]:
    """See that a row of others is whole, of the same data centers, and free of contradictions.

    Args:
        submission: the row.
        suite: results of the suite that it is to stand among.

    Returns:
        What is to be known, in words.

    Raises:
        ConfigError: it is not.
    """
    notes: list[str] = []
    place = submission.store.folder
    if submission.suite != suite.name:
        raise ConfigError(
            f"{place}: is of suite {shortened(submission.suite)}; valid is {suite.name}"
        )
    taken = {*suite.suite.rows, *(row for case in suite.cases.values() for row in case.rows)}
    row = submission.row
    if not ROW_NAME.fullmatch(row) or row.startswith(REFERENCE):
        raise ConfigError(
            f"{place}: row {shortened(row)}: valid are at most 80 lower-case letters, digits and "
            f". _ -, not beginning with {REFERENCE}"
        )
    if row in taken:
        raise ConfigError(f"{place}: row {row}: the name is taken; valid is another")
    for name in submission.cases:
        case = suite.cases.get(name)
        if case is None:
            raise ConfigError(
                f"{place}: case {shortened(name)}: no results to hold it against; valid: "
                f"{', '.join(suite.cases)}"
            )
        own = [result for result in submission.results if _of(result, "case") == name]
        notes += _check_case(submission, own, suite, case)
    return tuple(notes)


def add_submission(folder: Path, to: Path) -> tuple[Submission, tuple[str, ...]]:
    """Check a row of others and put it among the results of a suite.

    Args:
        folder: folder with the results of the row.
        to: folder of the study of the suite.

    Returns:
        The row, and what is to be known, in words.

    Raises:
        SdcError: the row is not valid, a study is under way in ``to``, or it cannot be written.
    """
    submission = read_submission(folder)
    target = ResultStore(to)
    if folder.resolve() == to.resolve():
        raise ConfigError(f"{folder}: is the folder that it is to be added to; valid is another")
    (suite,) = read_suites([to])
    notes = check_submission(submission, suite)
    with naming_errors(to):
        claim = FileClaim(to / JOBS)
    try:
        for result in submission.results:
            partition = result.content["partition"]
            # Written first, so that nobody's work is ever shown as that of this package.
            with atomic_write(
                target.folder_of(partition).parent / SUBMISSION_FILE, parents=True
            ) as file:
                file.write((json.dumps(submission.about, indent=1) + "\n").encode())
            target.keep(_done_job(result))
    finally:
        claim.release()
    return submission, notes


def write_submission(
    out: Path,
    frames: Mapping[int, pd.DataFrame],
    *,
    suite: str,
    case: str,
    row: str,
    kind: str,
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
        author: who made it.
        about: what it is, in a sentence.
        link: where more is to be found.
        files: further files of each seed by their paths, such as a policy.

    Raises:
        SdcError: a name that is not valid, or a file that cannot be written.
    """
    content = {"format": SUBMISSION_FORMAT, "author": author, "about": about, "link": link}
    with atomic_write(out / SUBMISSION_FILE, parents=True) as file:
        file.write((json.dumps(content | {"kind": kind}, indent=1) + "\n").encode())
    store = ResultStore(out)
    for seed, frame in frames.items():
        partition = {"suite": suite, "case": case, "row": row, "seed": str(seed)}
        packed = io.BytesIO()
        frame.to_parquet(packed, index=False)
        own = dict((files or {}).get(seed, {}))
        for name in own:
            check_file_name(name)
        job = Job("", {"name": row, "seed": seed}, partition)
        store.keep(DoneJob(job, rows=packed.getvalue(), files=own))


def _done_job(result: RowResult) -> DoneJob:
    """A result as a job that has ended, to be kept elsewhere."""
    content, store = result.content, result.store
    partition = content["partition"]
    return DoneJob(
        Job(content["function"], content["values"], partition, content["inputs"]),
        rows=read_bytes(store.rows_path(partition), MOST_BYTES),
        metrics=content["metrics"],
        files={name: store.file(partition, name) for name in content["files_sha256"]},
        core_s=content["core_s"],
        source=content["source"],
        processor=content["processor"],
    )


def _of(result: RowResult, column: str) -> str:
    """Value of a column of the partition of a result."""
    return str(result.content["partition"][column])


def _check_files(folder: Path) -> None:
    """Refuse links, special files, and files that are too many or too large.

    Raises:
        SdcError: there are some, or there is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; valid is one with {SUBMISSION_FILE}")
    for name in list_folder(folder):
        if name not in _AT_TOP:
            raise ConfigError(f"{folder / name}: valid are {', '.join(_AT_TOP)}")
    count, size = 0, 0
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(place, name)
            with naming_errors(path):
                status = path.lstat()
            if not (stat.S_ISREG(status.st_mode) or stat.S_ISDIR(status.st_mode)):
                raise ConfigError(f"{path}: is a link or no file; valid are files and folders")
            if name in files:
                count, size = count + 1, size + status.st_size
            if count > MOST_FILES or size > MOST_BYTES:
                raise ConfigError(
                    f"{folder}: more than {MOST_FILES:,} files or {MOST_BYTES / 1e6:,.0f} MB at "
                    f"{path}; valid are fewer"
                )


def _check_content(store: ResultStore, content: Mapping[str, Any]) -> None:
    """Refuse a result whose digests do not match, or of another version.

    Raises:
        SdcError: it is not valid, or a file is missing.
    """
    partition = content["partition"]
    folder = store.folder_of(partition)
    place = folder / METRICS_FILE
    if list(partition) != list(COLUMNS):
        raise ConfigError(f"{place}: partition {list(partition)}; valid is {', '.join(COLUMNS)}")
    if not 0.0 <= content["core_s"] < _MOST_CORE_S:
        raise ConfigError(f"{place}: core_s {content['core_s']}; valid is 0 or more seconds")
    if content["version"] != version("sdc-taichi"):
        raise ConfigError(
            f"{place}: version {shortened(content['version'])}; valid is {version('sdc-taichi')}"
        )
    job = Job(content["function"], content["values"], partition, content["inputs"])
    if job.key != content["key"]:
        raise ConfigError(f"{place}: key {shortened(content['key'])}; valid is {job.key}")
    for name in content["files_sha256"]:
        check_file_name(name)
    if not content["rows_sha256"] or not store.is_whole(content):
        raise ConfigError(f"{place}: rows or files are not those that it tells of by their digests")
    told = {folder / name for name in content["files_sha256"]} | {place}
    for path in folder.rglob("*"):
        if path.is_file() and path not in told:
            raise ConfigError(f"{path}: {METRICS_FILE} does not tell of it; valid are others")


def _check_parquet(path: Path) -> None:
    """Refuse a file of rows that would take much memory.

    Raises:
        SdcError: it is no Parquet file, or would.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        found = pq.ParquetFile(path).metadata
        groups = [found.row_group(index) for index in range(found.num_row_groups)]
    except (pa.ArrowException, OSError) as error:
        raise ConfigError(f"{path}: cannot be read as a Parquet file: {error}") from None
    size = sum(group.total_byte_size for group in groups)
    if size > _MOST_UNPACKED_BYTES:
        raise ConfigError(
            f"{path}: {size / 1e6:,.0f} MB unpacked; valid is at most "
            f"{_MOST_UNPACKED_BYTES / 1e6:,.0f} MB"
        )


def _check_case(
    submission: Submission, own: Sequence[RowResult], suite: SuiteResults, case: CaseResults
) -> tuple[str, ...]:
    """Check the results of a case; return what is to be known, in words.

    Raises:
        ConfigError: seeds are missing, or figures are not those of the case.
    """
    known = [
        results
        for name, results in case.rows.items()
        if case.kinds[name] not in (ACHIEVED, BOUND) and results[0].submission is None
    ]
    if not known:
        raise ConfigError(f"{case.suite}, {case.name}: no controller to hold a row against")
    most = max(known, key=len)
    # A seed decides which failures are sampled, so figures of idle commands differ by seed too.
    by_seed = {result.seed: result for result in most} if _idle_differs(most) else {}
    count = len(by_seed) or 1
    if submission.about["kind"] == LEARNER:
        count = max(count, suite.suite.seeds)
    seeds = sorted(result.seed for result in own)
    if seeds != list(range(count)):
        raise ConfigError(
            f"{submission.store.folder}: case {case.name}: seeds {', '.join(map(str, seeds))}; "
            f"valid are {count} of them, from 0, as of the suite"
        )
    ci_g_per_kwh, notes = _intensity(case)
    for result in own:
        beside = by_seed.get(result.seed, most[0])
        check_rows(result.frame, _known(case, beside, ci_g_per_kwh), str(result.folder))
    return notes


def _idle_differs(results: Sequence[RowResult]) -> bool:
    """Whether idle commands reach other figures by seed."""
    figures = [result.frame["idle_figure"].to_numpy(np.float64) for result in results]
    return any(not np.array_equal(figure, figures[0]) for figure in figures)


def _known(case: CaseResults, beside: RowResult, ci_g_per_kwh: F64) -> KnownCase:
    """Figures and limits that rows of others in a case are held against."""
    frame = beside.frame[beside.frame["moves"] == ALL].reset_index(drop=True)
    keys = zip(map(str, frame["site"]), map(int, frame["week"]), strict=True)
    bound = np.array([case.bound.get(key, np.nan) for key in keys])
    days = case.settings.days
    return KnownCase(case.objective, days, frame, bound, ci_g_per_kwh)


def _intensity(case: CaseResults) -> tuple[F64, tuple[str, ...]]:
    """Lowest and highest carbon intensity of each week, in g/kWh, (W, 2), and what is to be known.

    It is not known where files that the case names are not here.
    """
    chosen = case.settings
    try:
        configs = data_center_weeks(data_centers(chosen, "held-out"), chosen.weeks)
        drivers = load_drivers(configs)
    except SdcError as error:
        note = f"case {case.name}: carbon intensity is not known, so cfp_kg is not tested: {error}"
        first = next(iter(case.rows.values()))[0].frame
        return np.full((int((first["moves"] == ALL).sum()), 2), np.nan), (note,)
    per_day = 24 * configs[0].simulation.steps_per_hour
    scored = np.arange(UNSCORED_DAYS * per_day, chosen.days * per_day)
    values = drivers.ci_g_per_kwh.at(drivers.start[:, None] + scored)
    return np.stack([values.min(axis=1), values.max(axis=1)], axis=1), ()
