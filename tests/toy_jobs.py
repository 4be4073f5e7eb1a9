"""Functions of jobs for tests, which worker processes import."""

from __future__ import annotations

import os
import signal
import threading
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sdc_taichi.benchmark.jobs import Job, JobResult
from sdc_taichi.errors import ConfigError, OddInputWarning


def job(name: str, number: int, inputs: Mapping[str, str] | None = None, **values: Any) -> Job:
    """A job of the function ``name`` of this module."""
    partition = {"suite": "toy", "case": f"c/{name}", "number": str(number)}
    return Job(f"toy_jobs:{name}", {"number": number, **values}, partition, inputs or {})


def draw(values: Mapping[str, Any], inputs: Mapping[str, bytes]) -> JobResult:
    """Random rows, a sum that depends on its order, and a file."""
    if "seconds" in values:
        time.sleep(values["seconds"])
    numbers = np.random.default_rng(values["number"]).normal(size=1000)
    rows = pd.DataFrame({"site": ["NY", "CA"], "sum": [numbers.sum(), (numbers**3).mean()]})
    read = {name: len(content) for name, content in inputs.items()}
    metrics = {"sum": numbers.sum(), "bound": float("nan"), "read": read}
    return JobResult(rows, metrics, {"policy/weights.bin": numbers.tobytes()})


def without_rows(values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    return JobResult(None, {"number": values["number"]})


def refuse(values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    raise ConfigError(f"number {values['number']}: valid is\nanother")


def divide(values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    return JobResult(None, {"quotient": 1 / (values["number"] - values["number"])})


def warn(values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    warnings.warn("odd", OddInputWarning, stacklevel=2)
    return JobResult(None, {})


def killed_once(values: Mapping[str, Any], inputs: Mapping[str, bytes]) -> JobResult:
    """Kill the process the first time."""
    mark = Path(values["mark"])
    if not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return draw(values, inputs)


def killed(values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError


def about_process(_values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    """What a worker is told about threads."""
    import threadpoolctl

    pools = [each["num_threads"] for each in threadpoolctl.threadpool_info()]
    threads = os.environ.get("SDC_TAICHI_THREADS")
    main = threading.current_thread() is threading.main_thread()
    return JobResult(None, {"pools": pools, "taichi": threads, "pid": os.getpid(), "main": main})


def sleep_long(values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    """Write the process's number to a file and go on for a minute."""
    Path(values["mark"]).write_text(str(os.getpid()))
    time.sleep(60)
    raise AssertionError


def other_columns(_values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    return JobResult(pd.DataFrame({"site": ["AZ"], "sum": [1], "cost": [5]}), {})


def interrupt(_values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    """Interrupt the command as Ctrl-C does, which the job itself survives."""
    os.kill(os.getpid(), signal.SIGINT)
    return JobResult(None, {})
