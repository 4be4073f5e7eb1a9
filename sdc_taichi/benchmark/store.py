"""The folder of a study: what was asked, the result of each job, and their rows as one dataset.

``study.json`` says what was asked. ``jobs/COLUMN=VALUE/.../`` holds the files of a job and, written
last, its metrics.json, so a job is done when that is there and fits them. Rows are in
``results/COLUMN=VALUE/.../rows.parquet``, a dataset with hive partitions.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from sdc_taichi.atomic_file import FileClaim, atomic_write, naming_errors
from sdc_taichi.benchmark.jobs import DoneJob, Job, check_file_name, digest_of
from sdc_taichi.benchmark.source import source_digest
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.user_file import MOST_METRICS_BYTES, list_folder, read_bytes, read_text

if TYPE_CHECKING:
    import pandas as pd

STUDY_FORMAT, RESULT_FORMAT = "sdc-study/1", "sdc-result/1"
"""Versions of the formats of study.json and metrics.json."""
STUDY_FILE, METRICS_FILE, ROWS_FILE = "study.json", "metrics.json", "rows.parquet"
"""Files of a study and of a job."""
JOBS, RESULTS = "jobs", "results"
"""Folders of a study."""
MOST_FILE_BYTES = 2_000_000_000
"""Largest file of a result, in bytes."""
_MOST_SEGMENT_BYTES = 255  # of a name in usual file systems
_MOST_DIFFERENCES = 3


@dataclass(frozen=True, slots=True)
class Study:
    """A study as it is asked for: its settings and the jobs that it is to do."""

    kind: str
    """Kind of the study: ``suite`` or ``sweep``."""
    command: str
    """Command line that runs the study. One that goes on without asking for more jobs does not take
    the place of the first."""
    settings: Mapping[str, Any]
    """Everything that decides what the results mean, as JSON can hold it. A folder takes results of
    equal settings alone."""
    partitions: Sequence[Mapping[str, str]]
    """Partition of each job that the study is to do. A study that goes on may ask for more."""
    may_change: Sequence[str] = ()
    """Patterns of the dotted names of settings that may change while the study goes on, as those
    that differ between its jobs may."""


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
            study: what is to be done; written to study.json.
            resume: whether to go on with the study in the folder. A new or empty folder begins it.

        Yields:
            What is to be known of results that are kept, in words.

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
            kept = self._kept_study(resume=resume)
            content = _study_content(study)
            notes: list[str] = []
            if kept is not None:
                _refuse_other_settings(self.folder, kept, content, study.may_change)
                asked = _union(kept["partitions"], content["partitions"])
                if len(asked) == len(kept["partitions"]):
                    content["command"] = kept["command"]  # which asks for all of them
                content["partitions"] = asked
                if kept["source"] != content["source"]:
                    notes.append(
                        f"{self.folder}: results of other source files of version "
                        f"{content['version']} are kept; a new folder has all from one source"
                    )
            _write_json(self.folder / STUDY_FILE, content)
            yield tuple(notes)
        finally:
            claim.release()

    def study(self) -> dict[str, Any]:
        """Content of study.json.

        Raises:
            ConfigError: there is none, or it is damaged.
        """
        path = self.folder / STUDY_FILE
        content = read_json(path, STUDY_FORMAT, _STUDY_KEYS)
        for each in content["partitions"]:
            values = each.values() if isinstance(each, dict) else [None]
            if not all(isinstance(value, str) for value in values):
                raise ConfigError(f"{path}: partition {shortened(each)}; valid are texts by name")
        return content

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

    def result(self, partition: Mapping[str, str]) -> dict[str, Any]:
        """Content of metrics.json of a job.

        Args:
            partition: columns and values that name the job.

        Raises:
            ConfigError: there is none, or it is damaged.
        """
        return read_json(self.folder_of(partition) / METRICS_FILE, RESULT_FORMAT, _RESULT_KEYS)

    def results(self) -> Iterator[dict[str, Any]]:
        """Content of each metrics.json, in order of their folders.

        Raises:
            ConfigError: one of them is damaged, or not in the folder that its partition names.
        """
        for path in sorted((self.folder / JOBS).rglob(METRICS_FILE)):
            content = read_json(path, RESULT_FORMAT, _RESULT_KEYS)
            if path.parent != self.folder_of(content["partition"]):
                raise ConfigError(
                    f"{path}: is of {shortened(content['partition'])}; valid is the folder of that"
                )
            yield content

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

    def is_done(self, job: Job) -> bool:
        """Whether a result with the key of the job is kept, with all of its files undamaged."""
        try:
            content = self.result(job.partition)
            is_of_job = (content["key"], content["partition"]) == (job.key, dict(job.partition))
            return is_of_job and self.is_whole(content)
        except SdcError:
            return False

    def is_whole(self, content: Mapping[str, Any]) -> bool:
        """Whether rows and files of a result have the digests that its metrics.json lists.

        Args:
            content: content of metrics.json of a job.

        Raises:
            SdcError: a file is missing, cannot be read, or would lie outside of the folder.
        """
        partition = content["partition"]
        for name in content["files_sha256"]:
            check_file_name(name)
        files = {self.folder_of(partition) / n: d for n, d in content["files_sha256"].items()}
        if content["rows_sha256"]:
            files[self.rows_path(partition)] = content["rows_sha256"]
        return all(digest_of(read_bytes(path, MOST_FILE_BYTES)) == d for path, d in files.items())

    def keep(self, done: DoneJob) -> None:
        """Write the result of a job that has ended well; metrics.json last.

        Args:
            done: the job with its result.

        Raises:
            SdcError: something cannot be written.
        """
        job = done.job
        folder, rows_path = self.folder_of(job.partition), self.rows_path(job.partition)
        with naming_errors(folder):
            # Until it is there again, the job is not done.
            (folder / METRICS_FILE).unlink(missing_ok=True)
            rows_path.unlink(missing_ok=True)
        for name, content in sorted(done.files.items()):
            _write(folder / name, content)
        if done.rows:
            _write(rows_path, done.rows)
        _write_json(folder / METRICS_FILE, _result_content(done))

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
        paths = [
            str(self.rows_path(content["partition"]))
            for content in self.results()
            if content["rows_sha256"]
        ]
        if not paths:
            raise ConfigError(f"{self.folder}: holds no rows; valid is the folder of a study")
        try:
            hive = ds.HivePartitioning.discover(infer_dictionary=False)
            found = ds.dataset(paths, partitioning=hive, partition_base_dir=str(base))
            # Its own schema is that of the first file.
            schemas = [fragment.physical_schema for fragment in found.get_fragments()]
            schema = pa.unify_schemas([found.schema, *schemas], promote_options="permissive")
            table = found.replace_schema(schema).to_table(columns)
        except (pa.ArrowException, OSError) as error:
            raise ConfigError(f"{base}: cannot be read as a dataset: {error}") from error
        frame: pd.DataFrame = table.to_pandas()
        return frame

    def _kept_study(self, *, resume: bool) -> dict[str, Any] | None:
        """Content of study.json of a study that goes on; None where the folder is empty.

        Raises:
            ConfigError: the folder is not free.
        """
        others = [name for name in list_folder(self.folder) if not name.startswith(".")]
        if STUDY_FILE in others:
            if not resume:
                raise ConfigError(
                    f"{self.folder}: holds a study; go on with it with --resume, or choose another "
                    "folder with --out"
                )
            return self.study()
        if others:
            some = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
            raise ConfigError(
                f"{self.folder}: holds other files ({some}); choose an empty folder with --out"
            )
        return None


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


_STUDY_KEYS = {
    "kind": str,
    "command": str,
    "settings": dict,
    "version": str,
    "source": str,
    "partitions": list,
}
_TEXTS = ("partition", "inputs", "files_sha256")
_RESULT_KEYS = {
    "key": str,
    "function": str,
    "values": dict,
    "inputs": dict,
    "partition": dict,
    "version": str,
    "source": str,
    "rows_sha256": str,
    "files_sha256": dict,
    "metrics": dict,
    "core_s": (int, float),
    "processor": dict,
}


def _study_content(study: Study) -> dict[str, Any]:
    """Content of study.json."""
    content = {
        "format": STUDY_FORMAT,
        "kind": study.kind,
        "command": study.command,
        "settings": study.settings,
        "version": version("sdc-taichi"),
        "source": source_digest(),
        "partitions": [dict(partition) for partition in study.partitions],
    }
    found: dict[str, Any] = json.loads(json.dumps(content))
    return found


def _result_content(done: DoneJob) -> dict[str, Any]:
    """Content of metrics.json, in which equal runs differ in the last two entries alone."""
    job = done.job
    return {
        "format": RESULT_FORMAT,
        "key": job.key,
        "function": job.function,
        "values": job.values,
        "inputs": dict(job.inputs),
        "partition": dict(job.partition),
        "version": version("sdc-taichi"),
        "source": done.source,
        "rows_sha256": digest_of(done.rows) if done.rows else "",
        "files_sha256": {name: digest_of(done.files[name]) for name in sorted(done.files)},
        "metrics": done.metrics,
        "core_s": round(done.core_s, 3),
        "processor": dict(done.processor),
    }


def _refuse_other_settings(
    folder: Path, kept: Mapping[str, Any], asked: Mapping[str, Any], may_change: Sequence[str]
) -> None:
    """Refuse to go on with a study of other settings.

    Raises:
        ConfigError: they differ; it tells in what.
    """
    names = ("kind", "version", "settings")
    theirs, ours = (_flat({n: each[n] for n in names}) for each in (kept, asked))
    different = [
        f"{name.removeprefix('settings.')} {_told(theirs, name)}, here {_told(ours, name)}"
        for name in {**theirs, **ours}
        if theirs.get(name, _told) != ours.get(name, _told)
        and not any(fnmatch(name.removeprefix("settings."), pattern) for pattern in may_change)
    ]
    if different:
        more = len(different) - _MOST_DIFFERENCES
        some = "; ".join(different[:_MOST_DIFFERENCES]) + (f"; and {more} more" * (more > 0))
        raise ConfigError(
            f"{folder}: holds a study with {some}; valid is to resume with its settings, or "
            "another folder"
        )


def _told(values: Mapping[str, Any], name: str) -> str:
    """A setting as messages tell it."""
    return shortened(values[name]) if name in values else "not given"


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values of nested mappings by their dotted names."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            found |= _flat(value, f"{prefix}{name}.")
        else:
            found[f"{prefix}{name}"] = value
    return found


def _union(first: Sequence[Any], second: Sequence[Any]) -> list[Any]:
    """Partitions of both lists, each once, in order."""
    return list({json.dumps(each, sort_keys=True): each for each in (*first, *second)}.values())


def read_json(path: Path, form: str, keys: Mapping[str, Any]) -> dict[str, Any]:
    """Content of a JSON file of a known format.

    Args:
        path: the file.
        form: name and version of the format, which is its entry ``format``.
        keys: types of other entries that it must have, by name.

    Raises:
        ConfigError: it cannot be read, or is not of the format.
    """
    text = read_text(path, MOST_METRICS_BYTES, ConfigError)
    try:
        content = json.loads(text, parse_constant=_no_number)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: is no JSON ({error})") from None
    found = content.get("format") if isinstance(content, dict) else None
    if found != form:
        raise ConfigError(f"{path}: format {shortened(found)}; valid is {form!r}")
    for name, kind in keys.items():
        if not isinstance(content.get(name), kind) or isinstance(content[name], bool):
            raise ConfigError(f"{path}: {name} {shortened(content.get(name))} is not valid")
        for each in content[name].values() if name in _TEXTS else ():
            if not isinstance(each, str):
                raise ConfigError(f"{path}: {name} holds {shortened(each)}; valid is text")
    return dict(content)


def _no_number(text: str) -> float:
    """Refuse what JSON does not have.

    Raises:
        ValueError: always.
    """
    raise ValueError(f"{text} is no number")


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file, whole or not at all."""
    _write(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def _write(path: Path, content: bytes) -> None:
    """Write a file and the folders it lies in, whole or not at all."""
    with atomic_write(path, parents=True) as file:
        file.write(content)
