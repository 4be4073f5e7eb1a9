"""Storage of a study in a folder: settings, results of the jobs, and a dataset of all table rows.

``study.json`` contains the settings. ``jobs/COLUMN=VALUE/.../`` contains the files of a job. Its
``metrics.json`` is written last: a job is done if this file exists and its digests match the other
files. ``results/COLUMN=VALUE/.../rows.parquet`` contains the table rows of a job; together these
files are a Parquet dataset with Hive partitions.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar
from urllib.parse import quote

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from sdc_taichi.atomic_file import FileClaim, atomic_write, naming_errors
from sdc_taichi.benchmark.jobs import DoneJob, Job, check_file_name, digest_of, source_digest
from sdc_taichi.config import load_json
from sdc_taichi.config.fields import explain
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.learning.training_settings import leaves
from sdc_taichi.user_file import MOST_METRICS_BYTES, list_folder, read_bytes, read_text

if TYPE_CHECKING:
    import pandas as pd

STUDY_FILE, METRICS_FILE, ROWS_FILE = "study.json", "metrics.json", "rows.parquet"
"""File names of a study's settings, a job's metrics and a job's table rows."""
JOBS, RESULTS = "jobs", "results"
"""Subfolders of a study for the files of jobs and for table rows."""
MOST_FILE_BYTES = 2_000_000_000
"""Maximum size of a result file, in bytes."""
_MOST_SEGMENT_BYTES = 255  # maximum length of a file name in common file systems
_MOST_DIFFERENCES = 3


def _checked_file_name(name: str) -> str:
    """Return the path of a file in a job's folder after ``check_file_name``."""
    try:
        check_file_name(name)
    except SdcError as error:
        raise ValueError(str(error)) from None
    return name


class Record(BaseModel):
    """Content of a JSON file with a known format; unknown entries are ignored."""

    model_config = ConfigDict(strict=True, frozen=True)


class Study(Record):
    """Settings and planned jobs of a study; content of ``study.json``."""

    format: Literal["sdc-study/1"] = "sdc-study/1"
    """Name and version of the format."""
    kind: str
    """Kind of the study: ``suite`` or ``sweep``."""
    command: str
    """Command line that runs all jobs of the study."""
    settings: dict[str, Any]
    """Values on which the results depend, in a form for JSON; they are the same for all results in
    a folder."""
    version: str = Field(default_factory=lambda: version("sdc-taichi"))
    """Version of the package."""
    source: str = Field(default_factory=source_digest)
    """Digest of the source files of the package."""
    partitions: list[dict[str, str]]
    """Partition of each planned job of the study."""
    may_change: tuple[str, ...] = Field(default=(), exclude=True)
    """Patterns of dotted setting names that may change when the study is resumed; results in the
    folder can differ in these settings."""


class ResultRecord(Record):
    """Content of ``metrics.json``; repetitions of a job differ only in the last three entries."""

    format: Literal["sdc-result/1"]
    """Name and version of the format."""
    key: str
    """Digest of everything that determines the result (``Job.key``)."""
    function: str
    """Import path of the job's function."""
    values: dict[str, Any]
    """Arguments of the job's function."""
    inputs: dict[str, str]
    """Identity of each input of the job, by name."""
    partition: dict[str, str]
    """Columns and values that identify the result."""
    version: str
    """Version of the package."""
    source: str
    """Digest of the source files of the package."""
    rows_sha256: str
    """Digest of the Parquet file with the table rows; empty if the job has no rows."""
    files_sha256: dict[Annotated[str, AfterValidator(_checked_file_name)], str]
    """Digest of each further file, by path relative to the job's folder."""
    metrics: dict[str, Any]
    """Metrics of the job as a whole."""
    core_s: Annotated[float, Field(ge=0.0, le=1e12)]
    """Processor time of the job, in s."""
    training_core_s: Annotated[float, Field(ge=0.0, le=1e12)] = 0.0
    """Processor time of the trainings of the job, in s."""
    processor: dict[str, Any]
    """Properties of processor and libraries that affect the last bits of the result."""


AnyRecord = TypeVar("AnyRecord", bound=Record)


class ResultStore:
    """Access to the results of jobs in the folder of a study.

    Args:
        folder: folder of the study; the constructor does not access it.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextlib.contextmanager
    def claimed(self, study: Study, *, resume: bool = False) -> Iterator[tuple[str, ...]]:
        """Lock the folder against other processes while a study runs there.

        Args:
            study: settings and jobs to write to ``study.json``.
            resume: True to continue the study in the folder; a new or empty folder is valid, too.

        Yields:
            Notes on existing results.

        Raises:
            SdcError: the folder contains other files, a study (without ``resume``), or a study with
                different settings or package version; another process runs a study there; or the
                folder is not writable.
        """
        with naming_errors(self.folder):
            if self.folder.exists() and not self.folder.is_dir():
                raise ConfigError(f"{self.folder}: is a file; valid is a folder for results")
            self.folder.mkdir(parents=True, exist_ok=True)
        claim = FileClaim(self.folder / JOBS)
        try:
            whole, notes = study, tuple[str, ...]()
            if (begun := self._begun_study(resume=resume)) is not None:
                whole, notes = self._continued(begun, study)
            write_record(self.folder / STUDY_FILE, whole)
            yield notes
        finally:
            claim.release()

    def study(self) -> Study:
        """Read ``study.json``.

        Raises:
            ConfigError: the file does not exist, or is damaged.
        """
        return read_record(self.folder / STUDY_FILE, Study)

    def folder_of(self, partition: Mapping[str, str]) -> Path:
        """Return the folder of a job's files, even if the job is not done.

        Args:
            partition: columns and values that identify the job.

        Raises:
            ConfigError: a column or value cannot be part of a folder name.
        """
        return self.folder / JOBS / partition_path(partition)

    def rows_path(self, partition: Mapping[str, str]) -> Path:
        """Return the path of the file with a job's table rows, even if the job is not done.

        Args:
            partition: columns and values that identify the job.

        Raises:
            ConfigError: a column or value cannot be part of a folder name.
        """
        return self.folder / RESULTS / partition_path(partition) / ROWS_FILE

    def result(self, partition: Mapping[str, str]) -> ResultRecord:
        """Read ``metrics.json`` of a job.

        Args:
            partition: columns and values that identify the job.

        Raises:
            ConfigError: the file does not exist, or is damaged.
        """
        return read_record(self.folder_of(partition) / METRICS_FILE, ResultRecord)

    def results(self) -> Iterator[ResultRecord]:
        """Yield the content of each ``metrics.json``, in the order of the folders.

        Raises:
            ConfigError: a file is damaged, or its folder does not match its partition.
        """
        for path in sorted((self.folder / JOBS).rglob(METRICS_FILE)):
            record = read_record(path, ResultRecord)
            if path.parent != self.folder_of(record.partition):
                raise ConfigError(
                    f"{path}: is of {shortened(record.partition)}; valid is the folder of that"
                )
            yield record

    def file(self, partition: Mapping[str, str], name: str) -> bytes:
        """Read a file of a job.

        Args:
            partition: columns and values that identify the job.
            name: path of the file relative to the job's folder.

        Raises:
            SdcError: the file does not exist, or cannot be read.
        """
        check_file_name(name)
        return read_bytes(self.folder_of(partition) / name, MOST_FILE_BYTES)

    def rows_file(self, record: ResultRecord) -> bytes:
        """Read the Parquet file with a result's table rows; empty if the result has no rows.

        Raises:
            SdcError: the file is missing or cannot be read, or its digest does not match.
        """
        if not record.rows_sha256:
            return b""
        path = self.rows_path(record.partition)
        content = read_bytes(path, MOST_FILE_BYTES)
        if digest_of(content) != record.rows_sha256:
            raise ConfigError(f"{path}: has another digest than {METRICS_FILE} lists")
        return content

    def is_done(self, job: Job) -> bool:
        """Return True if a valid result of a job exists with all files undamaged."""
        try:
            record = self.result(job.partition)
            stored = record.key, record.function, record.values, record.inputs, record.partition
            values = json.loads(json.dumps(job.values))
            if stored != (job.key, job.function, values, dict(job.inputs), dict(job.partition)):
                return False
            if job.check is not None:
                job.check(values, record.metrics, self.rows_file(record))
            return self.is_whole(record)
        except SdcError:
            return False

    def is_whole(self, record: ResultRecord) -> bool:
        """Return True if the files of a result match the digests in its ``metrics.json``.

        Args:
            record: content of ``metrics.json`` of a job.

        Raises:
            SdcError: a file is missing, cannot be read, or is outside of the folder; or the table
                rows are damaged.
        """
        self.rows_file(record)
        files = record.files_sha256.items()
        return all(digest_of(self.file(record.partition, name)) == x for name, x in files)

    def keep(self, done: DoneJob) -> None:
        """Store the result of a successful job.

        Args:
            done: the job with its result.

        Raises:
            SdcError: a file cannot be written.
        """
        job = done.job
        record = ResultRecord(
            format="sdc-result/1",
            key=job.key,
            function=job.function,
            values=dict(job.values),
            inputs=dict(job.inputs),
            partition=dict(job.partition),
            version=version("sdc-taichi"),
            source=done.source,
            rows_sha256=digest_of(done.rows) if done.rows else "",
            files_sha256={name: digest_of(done.files[name]) for name in sorted(done.files)},
            metrics=dict(done.metrics),
            core_s=round(done.core_s, 3),
            training_core_s=round(done.training_core_s, 3),
            processor=dict(done.processor),
        )
        self.write(record, done.rows, done.files)

    def write(self, record: ResultRecord, rows: bytes, files: Mapping[str, bytes]) -> None:
        """Write the files of a result, with ``metrics.json`` last.

        Args:
            record: content of ``metrics.json``.
            rows: content of the Parquet file with the table rows; empty if there are no rows.
            files: content of further files, by path relative to the job's folder.

        Raises:
            SdcError: a file cannot be written.
        """
        folder, rows_path = self.folder_of(record.partition), self.rows_path(record.partition)
        with naming_errors(folder):
            # Delete metrics.json first, so that the job counts as not done until the end.
            (folder / METRICS_FILE).unlink(missing_ok=True)
            rows_path.unlink(missing_ok=True)
        for name, content in sorted(files.items()):
            _write(folder / name, content)
        if rows:
            _write(rows_path, rows)
        write_record(folder / METRICS_FILE, record)

    def rows(
        self, columns: Sequence[str] | None = None, numbers: Sequence[str] = ()
    ) -> pd.DataFrame:
        """Read the table rows of all jobs that are done, with the columns of their partitions.

        Args:
            columns: names of the columns to read; None selects all columns.
            numbers: names of columns that must contain numbers.

        Raises:
            SdcError: there are no rows, no file has a column, or a file is damaged.
        """
        import pandas as pd

        from sdc_taichi.benchmark.result_table import NUMBER, read_any_rows

        declared = dict.fromkeys(numbers, NUMBER)
        frames = []
        partition_columns: dict[str, None] = {}
        for record in self.results():
            if record.rows_sha256:
                content, path = self.rows_file(record), self.rows_path(record.partition)
                frame = read_any_rows(content, path, columns, declared)
                for name, value in record.partition.items():
                    frame[name] = value
                frames.append(frame)
                partition_columns |= dict.fromkeys(record.partition)
        if not frames:
            raise ConfigError(f"{self.folder}: holds no rows; valid is the folder of a study")
        rows = pd.concat(frames, ignore_index=True)
        for name in partition_columns:
            if rows[name].str.fullmatch("[0-9]{1,9}").all():
                rows[name] = rows[name].astype("int64")
        for name in columns or ():
            if name not in rows:
                raise ConfigError(f"{self.folder}: column {name} is missing in all tables")
        return rows if columns is None else rows[list(columns)]

    def _begun_study(self, *, resume: bool) -> Study | None:
        """Return the study in the folder; None if the folder is empty or does not exist.

        Raises:
            ConfigError: the folder contains other files, or a study without ``resume``.
        """
        names = [name for name in list_folder(self.folder) if not name.startswith(".")]
        if STUDY_FILE in names:
            if not resume:
                raise ConfigError(
                    f"{self.folder}: holds a study; go on with it with --resume, or choose another "
                    "folder with --out"
                )
            return self.study()
        if names:
            raise ConfigError(
                f"{self.folder}: holds other files ({shortened(', '.join(names))}); choose an "
                "empty folder with --out"
            )
        return None

    def _continued(self, begun: Study, wanted: Study) -> tuple[Study, tuple[str, ...]]:
        """Merge the jobs of the existing and the new study; return the result and notes on it.

        Raises:
            ConfigError: the settings of the two studies differ; the message lists the differences.
        """
        before, now = _flat_settings(begun), _flat_settings(wanted)
        different = [
            f"{name} {_setting_text(before, name)}, here {_setting_text(now, name)}"
            for name in {**before, **now}
            if (name in before, before.get(name)) != (name in now, now.get(name))
            and not any(fnmatch(name, pattern) for pattern in wanted.may_change)
        ]
        if different:
            more = len(different) - _MOST_DIFFERENCES
            some = "; ".join(different[:_MOST_DIFFERENCES]) + f"; and {more} more" * (more > 0)
            raise ConfigError(
                f"{self.folder}: holds a study with {some}; valid is to resume with its settings, "
                "or another folder"
            )
        notes: tuple[str, ...] = ()
        if begun.source != wanted.source:
            notes = (
                f"{self.folder}: results of other source files of version {wanted.version} are "
                "kept; a new folder has all from one source",
            )
        known = {tuple(partition.items()) for partition in begun.partitions}
        added = [x for x in wanted.partitions if tuple(x.items()) not in known]
        changes = {
            "command": wanted.command if added else begun.command,
            "partitions": [*begun.partitions, *added],
        }
        return wanted.model_copy(update=changes), notes


def partition_path(partition: Mapping[str, str]) -> Path:
    """Return the relative path of a partition in Hive's notation, ``COLUMN=VALUE/...``.

    Args:
        partition: columns and values; special characters of values are quoted as in URLs.

    Raises:
        ConfigError: a column or value cannot be part of a folder name.
    """
    segments = []
    for column, value in partition.items():
        segment = f"{column}={quote(value, safe='')}"
        if not re.fullmatch(r"[A-Za-z]\w*", column) or not value:
            raise ConfigError(f"partition {column}={value!r}: valid is a name and a value")
        if len(segment.encode()) > _MOST_SEGMENT_BYTES:
            raise ConfigError(
                f"{column} {shortened(value)}: makes a name of {len(segment)} characters; valid "
                f"are at most {_MOST_SEGMENT_BYTES}"
            )
        segments.append(segment)
    return Path(*segments)


def read_record(path: Path, model: type[AnyRecord]) -> AnyRecord:
    """Read a JSON file with a known format.

    Raises:
        ConfigError: the file cannot be read, or has a different format.
    """
    text, values = read_text(path, MOST_METRICS_BYTES, ConfigError), None
    try:
        record = model.model_validate_json(text)
        load_json(text)  # refuses numbers that are not finite, and keys that exist twice
    except ValidationError as error:
        with contextlib.suppress(ValueError):
            values = json.loads(text)
        raise ConfigError(explain(error, str(path), model, values)) from None
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    return record


def write_record(path: Path, record: Record) -> None:
    """Write a JSON file atomically.

    Raises:
        SdcError: the file cannot be written.
    """
    content = json.dumps(record.model_dump(), indent=1, allow_nan=False)
    _write(path, f"{content}\n".encode())


def _flat_settings(study: Study) -> dict[str, Any]:
    """Return kind, version and settings of a study by dotted name."""
    settings = study.model_dump(mode="json")["settings"]
    return {"kind": study.kind, "version": study.version, **dict(leaves("", settings))}


def _setting_text(values: Mapping[str, Any], name: str) -> str:
    """Return name and value of a setting as text for messages."""
    return shortened(values[name]) if name in values else "not given"


def _write(path: Path, content: bytes) -> None:
    """Write a file atomically, and create its parent folders."""
    with atomic_write(path, parents=True) as file:
        file.write(content)
