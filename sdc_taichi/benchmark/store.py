"""The folder of a study: its settings, the result of each job, and all rows as one dataset.

``study.json`` holds the settings. ``jobs/COLUMN=VALUE/.../`` holds the files of a job and, written
last, its metrics.json: a job is done if that exists and its digests fit the files. Rows are in
``results/COLUMN=VALUE/.../rows.parquet``, a dataset with hive partitions.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sdc_taichi.atomic_file import FileClaim, atomic_write, naming_errors
from sdc_taichi.benchmark.jobs import DoneJob, Job, check_file_name, digest_of, source_digest
from sdc_taichi.config.fields import explain
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.learning.training_settings import leaves
from sdc_taichi.user_file import MOST_METRICS_BYTES, list_folder, read_bytes, read_text

if TYPE_CHECKING:
    import pandas as pd

STUDY_FILE, METRICS_FILE, ROWS_FILE = "study.json", "metrics.json", "rows.parquet"
"""Files of a study and of a job."""
JOBS, RESULTS = "jobs", "results"
"""Folders of a study."""
MOST_FILE_BYTES = 2_000_000_000
"""Largest file of a result, in bytes."""
_MOST_SEGMENT_BYTES = 255  # of a name in usual file systems
_MOST_DIFFERENCES = 3


class Record(BaseModel):
    """Content of a JSON file of a known format; further entries are ignored."""

    model_config = ConfigDict(strict=True, frozen=True)


class Study(Record):
    """A study: its settings and the jobs that it is to do; content of study.json."""

    format: Literal["sdc-study/1"] = "sdc-study/1"
    """Name and version of the format."""
    kind: str
    """Kind of the study: ``suite`` or ``sweep``."""
    command: str
    """Command line that runs all jobs of the study."""
    settings: dict[str, Any]
    """Values, as JSON can hold them, on which the results depend; equal for all results of a
    folder."""
    version: str = Field(default_factory=lambda: version("sdc-taichi"))
    """Version of the package."""
    source: str = Field(default_factory=source_digest)
    """Digest of the source files of the package."""
    partitions: list[dict[str, str]]
    """Partition of each job that the study is to do."""
    may_change: tuple[str, ...] = Field(default=(), exclude=True)
    """Patterns of the dotted names of settings that may change while the study goes on; its jobs
    may differ in them."""


class ResultRecord(Record):
    """Content of metrics.json; equal runs differ in the last two entries alone."""

    format: Literal["sdc-result/1"]
    """Name and version of the format."""
    key: str
    """Key of the job."""
    function: str
    """Function of the job."""
    values: dict[str, Any]
    """Values of the job."""
    inputs: dict[str, str]
    """Identity of each input of the job."""
    partition: dict[str, str]
    """Columns and values that name the result."""
    version: str
    """Version of the package."""
    source: str
    """Digest of the source files of the package."""
    rows_sha256: str
    """Digest of the file of rows; empty if there is none."""
    files_sha256: dict[str, str]
    """Digest of each further file by its path below the folder of the job."""
    metrics: dict[str, Any]
    """Figures of the job as a whole."""
    core_s: float
    """Processor time that the job took, in s."""
    processor: dict[str, Any]
    """Features of the processor and the libraries."""


AnyRecord = TypeVar("AnyRecord", bound=Record)


class ResultStore:
    """Results of jobs in the folder of a study.

    Args:
        folder: the folder of the study; nothing is read or made yet.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @contextlib.contextmanager
    def claimed(self, study: Study, *, resume: bool = False) -> Iterator[tuple[str, ...]]:
        """Keep other processes out of the folder while a study runs there.

        Args:
            study: settings and jobs; written to study.json.
            resume: whether to continue the study in the folder. A new or empty folder begins it.

        Yields:
            Notes on results that are kept.

        Raises:
            SdcError: the folder holds other files, a study without ``resume``, or one of other
                settings or of another version; another process runs a study there; or nothing can
                be written there.
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
        """Content of study.json.

        Raises:
            ConfigError: there is none, or it is damaged.
        """
        return read_record(self.folder / STUDY_FILE, Study)

    def folder_of(self, partition: Mapping[str, str]) -> Path:
        """Folder with metrics.json and further files of a job, whether it is done or not.

        Args:
            partition: columns and values that name the job.

        Raises:
            ConfigError: a column or value that cannot be the name of a folder.
        """
        return self.folder / JOBS / partition_path(partition)

    def rows_path(self, partition: Mapping[str, str]) -> Path:
        """File with the rows of a job, whether it is done or not.

        Args:
            partition: columns and values that name the job.

        Raises:
            ConfigError: a column or value that cannot be the name of a folder.
        """
        return self.folder / RESULTS / partition_path(partition) / ROWS_FILE

    def result(self, partition: Mapping[str, str]) -> ResultRecord:
        """Content of metrics.json of a job.

        Args:
            partition: columns and values that name the job.

        Raises:
            ConfigError: there is none, or it is damaged.
        """
        return read_record(self.folder_of(partition) / METRICS_FILE, ResultRecord)

    def results(self) -> Iterator[ResultRecord]:
        """Content of each metrics.json, in order of their folders.

        Raises:
            ConfigError: one of them is damaged, or not in the folder that its partition names.
        """
        for path in sorted((self.folder / JOBS).rglob(METRICS_FILE)):
            record = read_record(path, ResultRecord)
            if path.parent != self.folder_of(record.partition):
                raise ConfigError(
                    f"{path}: is of {shortened(record.partition)}; valid is the folder of that"
                )
            yield record

    def file(self, partition: Mapping[str, str], name: str) -> bytes:
        """Content of a file of a job.

        Args:
            partition: columns and values that name the job.
            name: path of the file below the folder of the job.

        Raises:
            SdcError: there is no such file, or it cannot be read.
        """
        check_file_name(name)
        return read_bytes(self.folder_of(partition) / name, MOST_FILE_BYTES)

    def rows_file(self, record: ResultRecord) -> bytes:
        """Content of the file of rows of a result; empty if it has none.

        Raises:
            SdcError: the file is missing, cannot be read, or has another digest.
        """
        if not record.rows_sha256:
            return b""
        path = self.rows_path(record.partition)
        content = read_bytes(path, MOST_FILE_BYTES)
        if digest_of(content) != record.rows_sha256:
            raise ConfigError(f"{path}: has another digest than {METRICS_FILE} lists")
        return content

    def is_done(self, job: Job) -> bool:
        """Whether the result of the job exists, with all of its files undamaged."""
        try:
            record = self.result(job.partition)
            is_of_job = (record.key, record.partition) == (job.key, dict(job.partition))
            return is_of_job and self.is_whole(record)
        except SdcError:
            return False

    def is_whole(self, record: ResultRecord) -> bool:
        """Whether the further files of a result have the digests that its metrics.json lists.

        Args:
            record: content of metrics.json of a job.

        Raises:
            SdcError: a file is missing, cannot be read, or would lie outside of the folder; or
                rows are damaged.
        """
        self.rows_file(record)
        files = record.files_sha256.items()
        return all(digest_of(self.file(record.partition, name)) == x for name, x in files)

    def keep(self, done: DoneJob) -> None:
        """Write the result of a job that has ended successfully.

        Args:
            done: the job with its result.

        Raises:
            SdcError: something cannot be written.
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
            processor=dict(done.processor),
        )
        self.write(record, done.rows, done.files)

    def write(self, record: ResultRecord, rows: bytes, files: Mapping[str, bytes]) -> None:
        """Write a result, metrics.json last.

        Args:
            record: content of metrics.json.
            rows: content of the file of rows; empty if there is none.
            files: content of further files by their paths.

        Raises:
            SdcError: something cannot be written.
        """
        folder, rows_path = self.folder_of(record.partition), self.rows_path(record.partition)
        with naming_errors(folder):
            # Until it exists again, the job is not done.
            (folder / METRICS_FILE).unlink(missing_ok=True)
            rows_path.unlink(missing_ok=True)
        for name, content in sorted(files.items()):
            _write(folder / name, content)
        if rows:
            _write(rows_path, rows)
        write_record(folder / METRICS_FILE, record)

    def rows(self, columns: Sequence[str] | None = None) -> pd.DataFrame:
        """Rows of all jobs that are done, with the columns of their partitions.

        Args:
            columns: names of the columns to read; None is all.

        Raises:
            SdcError: there are none, or a file is damaged.
        """
        import pyarrow as pa
        import pyarrow.dataset as ds

        base = self.folder / RESULTS
        paths = [str(self.rows_path(x.partition)) for x in self.results() if x.rows_sha256]
        if not paths:
            raise ConfigError(f"{self.folder}: holds no rows; valid is the folder of a study")
        try:
            hive = ds.HivePartitioning.discover(infer_dictionary=False)
            dataset = ds.dataset(paths, partitioning=hive, partition_base_dir=str(base))
            # The schema of a dataset is that of its first file.
            schemas = [fragment.physical_schema for fragment in dataset.get_fragments()]
            schema = pa.unify_schemas([dataset.schema, *schemas], promote_options="permissive")
            table = dataset.replace_schema(schema).to_table(columns)
        except (pa.ArrowException, OSError) as error:
            raise ConfigError(f"{base}: cannot be read as a dataset: {error}") from error
        frame: pd.DataFrame = table.to_pandas()
        return frame

    def _begun_study(self, *, resume: bool) -> Study | None:
        """The study that the folder holds; None if the folder is empty.

        Raises:
            ConfigError: the folder is not free.
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
        """A study that goes on, with the jobs of both, and notes on it.

        Raises:
            ConfigError: their settings differ, which the error lists.
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
    """Path of a partition below ``jobs`` and ``results``, as hive names it: ``COLUMN=VALUE/...``.

    Args:
        partition: columns and values; values may hold any characters, which are quoted as in URLs.

    Raises:
        ConfigError: a column or value that cannot be the name of a folder.
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
    """Content of a JSON file of a known format.

    Args:
        path: the file.
        model: its format.

    Raises:
        ConfigError: it cannot be read, or is not of the format.
    """
    text = read_text(path, MOST_METRICS_BYTES, ConfigError)
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise ConfigError(explain(error, str(path), model)) from None


def write_record(path: Path, record: Record) -> None:
    """Write a JSON file, whole or not at all.

    Args:
        path: the file.
        record: its content.

    Raises:
        SdcError: it cannot be written.
    """
    content = json.dumps(record.model_dump(), indent=1, allow_nan=False)
    _write(path, f"{content}\n".encode())


def _flat_settings(study: Study) -> dict[str, Any]:
    """Kind, version and settings of a study by their dotted names."""
    settings = study.model_dump(mode="json")["settings"]
    return {"kind": study.kind, "version": study.version, **dict(leaves("", settings))}


def _setting_text(values: Mapping[str, Any], name: str) -> str:
    """A setting in messages."""
    return shortened(values[name]) if name in values else "not given"


def _write(path: Path, content: bytes) -> None:
    """Write a file and the folders it lies in, whole or not at all."""
    with atomic_write(path, parents=True) as file:
        file.write(content)
