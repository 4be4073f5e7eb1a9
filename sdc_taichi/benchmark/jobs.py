"""Jobs: pieces of work that depend on their values alone, and run in any process on any machine."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from sdc_taichi.errors import SdcError, one_line

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
    """What a job returns. It is equal to the bit wherever the job ran on one kind of processor."""

    rows: pd.DataFrame
    """Rows of the dataset, to which the store adds the columns of the partition."""
    metrics: Mapping[str, Any]
    """Figures of the job as a whole, as JSON can hold them."""
    files: Mapping[str, bytes] = field(default_factory=dict)
    """Content of further files by their path below the folder of the job, such as a policy."""


@dataclass(frozen=True, slots=True)
class DoneJob:
    """A job that has ended, well or not."""

    job: Job
    """The job."""
    result: JobResult | None
    """Its result; None where it failed."""
    error: str
    """The error of a job that failed, in one line; empty otherwise."""
    core_s: float
    """Processor time that it took, in s."""


def digest_of(content: bytes) -> str:
    """Digest of the content of an input or file, as hexadecimal SHA-256."""
    return hashlib.sha256(content).hexdigest()


def run_job(job: Job, inputs: Inputs) -> DoneJob:
    """Run a job in this process.

    Args:
        job: the job.
        inputs: content of all inputs of the study, of which the job reads its own.

    Returns:
        The job with its result; with the error in one line where the function raised one of the
        package.
    """
    import time

    start_s = time.process_time()
    result, error = None, ""
    try:
        result = _function(job.function)(job.values, {name: inputs[name] for name in job.inputs})
    except SdcError as failure:
        error = one_line(str(failure))
    return DoneJob(job, result, error, time.process_time() - start_s)


def _function(path: str) -> Callable[[Mapping[str, Any], Inputs], JobResult]:
    """The function of an import path."""
    module, _, name = path.partition(":")
    found: Callable[[Mapping[str, Any], Inputs], JobResult] = getattr(import_module(module), name)
    return found
