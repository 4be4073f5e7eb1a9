"""Jobs: pieces of work that depend only on their values and inputs, and run in any process."""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from pydantic_core import to_json

from sdc_taichi.benchmark.vary import value_at
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import SdcError, SdcWarning, one_line, place_in_user_code, shortened
from sdc_taichi.user_file import read_bytes

if TYPE_CHECKING:
    import pandas as pd

Inputs = Mapping[str, bytes]
"""Content of large inputs by name; a worker process receives it once, not with every job."""
FILE_FIELDS = (
    "site.weather_file",
    "site.carbon_file",
    "site.workload_file",
    "hall.recirculation.matrix_file",
)
"""Configuration fields that contain the paths of input files."""
MOST_INPUT_BYTES = 2**28
"""Maximum size of an input file, in bytes."""
_SOURCE_FOLDERS = ("", "configs", "data", "kernels", "viz")
_SOURCE_SUFFIXES = (".py", ".yaml", ".csv", ".json")


@dataclass(frozen=True)
class Job:
    """A piece of work; function, values and inputs determine its result."""

    function: str
    """Import path ``module:name`` of a function that takes the values and the inputs, and returns a
    ``JobResult``."""
    values: Mapping[str, Any]
    """Arguments of the function; they can be written as JSON."""
    partition: Mapping[str, str]
    """Identification of the result by columns and values, such as suite, case, row and seed. It is
    unique within a study."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Identity of each input that the function reads, by name: the digest of its content, or the
    key of the job that creates it."""
    check: Callable[[Mapping[str, Any], Mapping[str, Any], bytes], None] | None = None
    """Function that takes the values, stored metrics and the content of a Parquet file, which is
    empty without rows, and raises ``SdcError`` if they cannot be a result of the job; None checks
    nothing."""

    @property
    def name(self) -> str:
        """Values of the partition as a path, such as ``carbon/eight-sites/ippo/0``."""
        return "/".join(self.partition.values())

    @cached_property
    def key(self) -> str:
        """Digest of everything that determines the result, including the package version."""
        content = [self.function, self.values, self.inputs, version("sdc-taichi")]
        return digest_of(json.dumps(content, sort_keys=True).encode())


@dataclass(frozen=True, slots=True)
class JobResult:
    """Table rows, metrics and files of a job; bit-identical on processors of the same kind."""

    rows: pd.DataFrame | None
    """Table rows of the job without the partition, whose columns are added when the rows of a study
    are read. None if the job has no rows."""
    metrics: Mapping[str, Any]
    """Metrics of the job as a whole; NaN and infinite values become null in JSON."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Content of further files, such as a policy, by path relative to the job's folder."""
    training_core_s: float = 0.0
    """Processor time of the trainings of the job, in s, which differs between repetitions."""


@dataclass(frozen=True, slots=True)
class DoneJob:
    """A job that has ended, successfully or not, with its result in serialised form."""

    job: Job
    """The job."""
    error: str = ""
    """Error message of a failed job, in one line; empty after success."""
    rows: bytes = b""
    """Content of a Parquet file with the table rows; empty if the job has no rows."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """Metrics of the job as a whole; they can be written as JSON."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Content of further files by path relative to the job's folder."""
    warnings: tuple[str, ...] = ()
    """Warnings that the package issued during the job, each in one line."""
    core_s: float = 0.0
    """Processor time of the job, in s."""
    training_core_s: float = 0.0
    """Processor time of the trainings of the job, in s."""
    source: str = ""
    """Digest of the package's source files in the process that ran the job."""
    processor: Mapping[str, str] = field(default_factory=dict)
    """Properties of processor and libraries that affect the last bits of the result."""


def digest_of(content: bytes) -> str:
    """Return the SHA-256 digest of the content of an input or file, in hexadecimal."""
    return hashlib.sha256(content).hexdigest()


@cache
def compute_in_one_thread() -> None:
    """Limit numerical libraries and kernels in this process to one thread."""
    import threadpoolctl

    names = ("SDC_TAICHI_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    os.environ |= dict.fromkeys(names, "1")
    threadpoolctl.threadpool_limits(1)  # for libraries that have read the variables before


def run_job(job: Job, inputs: Inputs) -> DoneJob:
    """Run a job in this process.

    Args:
        job: the job.
        inputs: content of inputs by name, including all inputs that the job reads.

    Returns:
        The job with its result, or with an error message in one line. For errors other than
        ``SdcError``, the message includes the class and the place in the source.
    """
    from sdc_taichi.run.description import processor_features

    start_s = time.process_time()
    outcome: dict[str, Any] = {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SdcWarning)
        try:
            module, _, name = job.function.partition(":")
            function: Callable[..., JobResult] = getattr(import_module(module), name)
            outcome = _packed(function(job.values, {n: inputs[n] for n in job.inputs}), job)
        except SdcError as error:
            outcome = {"error": str(error)}
        except Exception as error:
            outcome = {"error": _unexpected(error)}
    texts = []
    for each in caught:
        if issubclass(each.category, SdcWarning):
            texts.append(one_line(str(each.message)))
        else:
            warnings.showwarning(each.message, each.category, each.filename, each.lineno)
    return DoneJob(
        job,
        **outcome,
        warnings=tuple(dict.fromkeys(texts)),
        core_s=time.process_time() - start_s,
        source=source_digest(),
        processor=processor_features(),
    )


def check_file_name(name: str) -> None:
    """Check that a relative path is valid for a file in a job's folder.

    Raises:
        SdcError: the path is empty or hidden, leaves the folder, or is that of the metrics file.
    """
    parts = PurePosixPath(name).parts
    wrong = not parts or name.startswith("/") or "\\" in name or "\0" in name
    if wrong or any(part.startswith(".") for part in parts) or name == "metrics.json":
        raise SdcError(
            f"file {shortened(name)} of a result: valid is a path below the folder of the job, "
            "such as policy/networks.safetensors"
        )


def input_paths(config: DataCenterConfig) -> list[str]:
    """Return the paths of all input files in a configuration, without duplicates."""
    named = (value_at(config, name) for name in FILE_FIELDS)
    return list(dict.fromkeys(path for path in named if path is not None))


def read_input(path: str) -> bytes:
    """Read an input file.

    Raises:
        SdcError: the file cannot be read, or is too large.
    """
    return read_bytes(path, MOST_INPUT_BYTES)


@cache
def source_digest() -> str:
    """Return the SHA-256 digest of the names and contents of the package's source files.

    The digest does not depend on the installation folder. Results record it in addition to the
    package version, because the source can change without a new version.
    """
    paths: dict[str, Path] = {}
    for folder in _SOURCE_FOLDERS:
        spec = find_spec(f"sdc_taichi.{folder}".rstrip("."))
        for root in (spec and spec.submodule_search_locations) or ():
            for path in Path(root).rglob("*"):
                if path.suffix in _SOURCE_SUFFIXES and "__pycache__" not in path.parts:
                    paths[Path(folder, path.relative_to(root)).as_posix()] = path
    digest = hashlib.sha256()
    for name, path in sorted(paths.items()):
        content = path.read_bytes()
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def _packed(result: JobResult, job: Job) -> dict[str, Any]:
    """Serialise a result; return it as fields of ``DoneJob``.

    Raises:
        SdcError: the rows contain columns of the partition, or the path of a file is not valid.
    """
    for name in result.files:
        check_file_name(name)
    rows = b""
    if result.rows is not None and len(result.rows):
        clash = [str(name) for name in result.rows.columns if name in job.partition]
        if clash:
            raise SdcError(f"rows of {job.function}: {clash[0]} is a column of the partition")
        rows = parquet(result.rows)
    metrics = to_json(result.metrics, inf_nan_mode="null", fallback=lambda array: array.tolist())
    files = {name: bytes(content) for name, content in result.files.items()}
    return {
        "rows": rows,
        "metrics": json.loads(metrics),
        "files": files,
        "training_core_s": result.training_core_s,
    }


def parquet(rows: pd.DataFrame) -> bytes:
    """Return table rows as the content of a Parquet file, independent of the version of pandas."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata(None)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _unexpected(error: Exception) -> str:
    """Return the message, class and place of an error of another library, in one line."""
    if user_place := place_in_user_code(error):
        return one_line(f"{type(error).__name__}: {error} (at {user_place})")
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "unknown"
    return one_line(f"{type(error).__name__}: {error} (unexpected, at {place})")
