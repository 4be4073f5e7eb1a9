"""Jobs: pieces of work that depend on their values and inputs alone and run in any process."""

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
from sdc_taichi.errors import SdcError, SdcWarning, one_line, shortened
from sdc_taichi.user_file import read_bytes

if TYPE_CHECKING:
    import pandas as pd

Inputs = Mapping[str, bytes]
"""Content of large inputs by name; each worker process receives it once, not with every job."""
FILE_FIELDS = (
    "site.weather_file",
    "site.carbon_file",
    "site.workload_file",
    "hall.recirculation.matrix_file",
)
"""Fields of the configuration that name files, whose content decides results."""
MOST_INPUT_BYTES = 2**28
"""Largest input file that is read, in bytes."""
_SOURCE_FOLDERS = ("", "configs", "data", "kernels", "viz")
_SOURCE_SUFFIXES = (".py", ".yaml", ".csv", ".json")


@dataclass(frozen=True)
class Job:
    """A piece of work, whose result is decided by its function, its values and its inputs."""

    function: str
    """Import path ``module:name`` of a function of the values and the inputs that returns a
    ``JobResult``."""
    values: Mapping[str, Any]
    """Arguments of the function, as JSON can hold them."""
    partition: Mapping[str, str]
    """Columns and values that name the result, such as suite, case, row and seed, in their order;
    no two jobs of a study have equal ones."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Identity of each input that the function reads, by name: the digest of its content, or the
    key of the job that makes it."""

    @property
    def name(self) -> str:
        """The values of the partition as a path, such as ``carbon/eight-sites/ippo/0``."""
        return "/".join(self.partition.values())

    @cached_property
    def key(self) -> str:
        """Digest of all that decides the result, the version of the package included."""
        content = [self.function, self.values, self.inputs, version("sdc-taichi")]
        return digest_of(json.dumps(content, sort_keys=True).encode())


@dataclass(frozen=True, slots=True)
class JobResult:
    """Rows, figures and files of a job, equal to the bit on all processors of one kind."""

    rows: pd.DataFrame | None
    """Rows of the dataset; reading the dataset adds the columns of the partition. None if the job
    has no rows."""
    metrics: Mapping[str, Any]
    """Figures of the job as a whole; NaN and infinite ones become null in JSON."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Content of further files by their path below the folder of the job, such as a policy."""


@dataclass(frozen=True, slots=True)
class DoneJob:
    """A job that has ended, successfully or not, with its result as it is written to files."""

    job: Job
    """The job."""
    error: str = ""
    """Error of a job that failed, in one line; empty otherwise."""
    rows: bytes = b""
    """Rows of the dataset as a Parquet file; empty if there are none."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """Figures of the job as a whole, as JSON can hold them."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Content of further files by their path below the folder of the job."""
    warnings: tuple[str, ...] = ()
    """Warnings of the package while the job ran, each in one line."""
    core_s: float = 0.0
    """Processor time that the job took, in s."""
    source: str = ""
    """Digest of the source files of the package where the job ran."""
    processor: Mapping[str, str] = field(default_factory=dict)
    """Features of the processor and the libraries on which the last bits of the result depend."""


def digest_of(content: bytes) -> str:
    """Digest of the content of an input or file, as hexadecimal SHA-256."""
    return hashlib.sha256(content).hexdigest()


@cache
def compute_in_one_thread() -> None:
    """Limit this process to one thread of computation."""
    import threadpoolctl

    names = ("SDC_TAICHI_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    os.environ |= dict.fromkeys(names, "1")
    threadpoolctl.threadpool_limits(1)  # for libraries that are loaded already


def run_job(job: Job, inputs: Inputs) -> DoneJob:
    """Run a job in this process.

    Args:
        job: the job.
        inputs: content of at least the inputs that the job reads.

    Returns:
        The job with its result, or with its error in one line. An error that does not belong to
        the package is reported with its class and place.
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
    """Check the path of a file below the folder of a job.

    Raises:
        SdcError: the path is empty or hidden, leaves the folder, or is the one of the metrics.
    """
    parts = PurePosixPath(name).parts
    wrong = not parts or name.startswith("/") or "\\" in name or "\0" in name
    if wrong or any(part.startswith(".") for part in parts) or name == "metrics.json":
        raise SdcError(
            f"file {shortened(name)} of a result: valid is a path below the folder of the job, "
            "such as policy/networks.safetensors"
        )


def input_paths(config: DataCenterConfig) -> list[str]:
    """Paths of the files that a configuration names, each once.

    Args:
        config: the configuration.
    """
    named = (value_at(config, name) for name in FILE_FIELDS)
    return list(dict.fromkeys(path for path in named if path is not None))


def read_input(path: str) -> bytes:
    """Content of an input file.

    Args:
        path: the file.

    Raises:
        SdcError: it cannot be read, or is too large.
    """
    return read_bytes(path, MOST_INPUT_BYTES)


@cache
def source_digest() -> str:
    """SHA-256 of names and content of the package's source files, equal wherever it is installed.

    A result keeps it beside the version, because many states of the source share a version.
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
    """The fields of ``DoneJob`` that hold a result.

    Raises:
        SdcError: rows with columns of the partition, or files with paths that are not valid.
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
    return {"rows": rows, "metrics": json.loads(metrics), "files": files}


def parquet(rows: pd.DataFrame) -> bytes:
    """Content of a Parquet file of rows, which does not depend on the version of pandas.

    Args:
        rows: the rows.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata(None)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _unexpected(error: Exception) -> str:
    """An error of another library, with its class and place, in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "unknown"
    return one_line(f"{type(error).__name__}: {error} (unexpected, at {place})")
