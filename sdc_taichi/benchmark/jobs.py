"""Jobs: pieces of work that depend on their values alone, and run in any process on any machine."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import time
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from sdc_taichi.benchmark.source import source_digest
from sdc_taichi.errors import SdcError, SdcWarning, one_line, shortened

if TYPE_CHECKING:
    import pandas as pd

Inputs = Mapping[str, bytes]
"""Content of large inputs by name, which travel to each worker once and not with every job."""


@dataclass(frozen=True)
class Job:
    """A piece of work, whose result is decided by its function, its values and its inputs."""

    function: str
    """Import path ``module:name`` of a function of the values and the inputs that returns a
    ``JobResult``."""
    values: Mapping[str, Any]
    """Arguments of the function; everything in them is what JSON can hold."""
    partition: Mapping[str, str]
    """Columns and values that name the result, such as suite, case, row and seed, in their order;
    no two jobs of a study have equal ones."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Identity of each input that the function reads, by name: the digest of its content, or the
    keys of the jobs that made it."""

    @property
    def name(self) -> str:
        """The values of the partition as a path, such as ``carbon/eight-sites/ippo/0``."""
        return "/".join(self.partition.values())

    @cached_property
    def key(self) -> str:
        """Digest of all that decides the result, the version of the package included."""
        content = [self.function, self.values, self.inputs, version("sdc-taichi")]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class JobResult:
    """Rows, figures and files of a job, equal to the bit on all processors of one kind."""

    rows: pd.DataFrame | None
    """Rows of the dataset, to which the columns of the partition are added where it is read; None
    where the job has none."""
    metrics: Mapping[str, Any]
    """Figures of the job as a whole, as JSON can hold them; nan and infinite ones become null."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Content of further files by their path below the folder of the job, such as a policy."""


@dataclass(frozen=True, slots=True)
class DoneJob:
    """A job that has ended, well or not, with its result as it is written to files."""

    job: Job
    """The job."""
    error: str = ""
    """The error of a job that failed, in one line; empty otherwise."""
    rows: bytes = b""
    """Rows of the dataset as a Parquet file; empty where there are none."""
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
    """Have this process, a worker, compute in one thread from here on."""
    import threadpoolctl

    names = ("SDC_TAICHI_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    os.environ |= dict.fromkeys(names, "1")
    threadpoolctl.threadpool_limits(1)  # of libraries that are loaded already


def run_job(job: Job, inputs: Inputs) -> DoneJob:
    """Run a job in this process.

    Args:
        job: the job.
        inputs: content of at least the inputs that the job reads.

    Returns:
        The job with its result, or with the error in one line. An error that is not one of the
        package is told with its class and place.
    """
    start_s = time.process_time()
    seen: list[str] = []
    done: dict[str, Any] = {}
    with warnings.catch_warnings():
        _collect_warnings(seen)
        try:
            result = _function(job.function)(job.values, {n: inputs[n] for n in job.inputs})
            done = _packed(result, job)
        except SdcError as error:
            done = {"error": str(error)}
        except Exception as error:
            done = {"error": _unexpected(error)}
    return DoneJob(
        job,
        **done,
        warnings=tuple(dict.fromkeys(seen)),
        core_s=time.process_time() - start_s,
        source=source_digest(),
        processor=_processor(),
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


def _function(path: str) -> Callable[[Mapping[str, Any], Inputs], JobResult]:
    """The function of an import path."""
    module, _, name = path.partition(":")
    found: Callable[[Mapping[str, Any], Inputs], JobResult] = getattr(import_module(module), name)
    return found


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
        rows = _parquet(result.rows)
    files = {name: bytes(content) for name, content in result.files.items()}
    return {"rows": rows, "metrics": _plain(result.metrics), "files": files}


def _parquet(rows: pd.DataFrame) -> bytes:
    """Content of a Parquet file of rows, which does not depend on the version of pandas."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.Table.from_pandas(rows, preserve_index=False).replace_schema_metadata(None)
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd")
    return buffer.getvalue()


def _plain(value: Any) -> Any:
    """A value as JSON holds it, with null for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(each) for each in value]
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if hasattr(value, "tolist"):  # arrays and numbers of NumPy
        return _plain(value.tolist())
    raise TypeError(f"metrics hold {shortened(value)}, which JSON cannot")


def _collect_warnings(seen: list[str]) -> None:
    """Within ``warnings.catch_warnings``, collect warnings of the package and show the others."""
    show = warnings.showwarning

    def collect(
        message: Warning | str, category: type[Warning], *place: Any, **stream: Any
    ) -> None:
        if issubclass(category, SdcWarning):
            seen.append(one_line(str(message)))
        else:
            show(message, category, *place, **stream)

    warnings.simplefilter("always", SdcWarning)
    warnings.showwarning = collect


def _unexpected(error: Exception) -> str:
    """An error that is not one of the package, with its class and place, in one line."""
    frames = traceback.extract_tb(error.__traceback__)
    place = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "unknown"
    return one_line(f"{type(error).__name__}: {error} (unexpected, at {place})")


@cache
def _processor() -> Mapping[str, str]:
    """Features of this machine, which take some milliseconds to find."""
    from sdc_taichi.run.processor import processor_features

    return processor_features()
