"""Sweeps on more than one process: what processes and Ray cost beside one batch in one process.

    python benchmarks/scale.py [FOLDER] [--setpoints 104] [--months 1 2] [--jobs 2000]

runs a sweep of preset ``corrected`` (setpoints x 8 sites x months, 9,984 data-center months) batch
by batch in this process, in one and two local processes, and on Ray with one and two
processors; then many jobs that do nothing, whose cost is that of handing them out. Each case has a
process of its own, and no worker uses more than one thread. Processor time is that of the command,
of all workers and of Ray's own processes, their start included: other work on the machine disturbs
it less than the time on the clock. Writes ``scale.json`` to FOLDER and prints tables.

Needs the extra ``scale``, and Linux for processor time and memory.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from fresh import most_mb
from steps import SITES

from sdc_taichi.benchmark.executors import Executor, LocalProcesses, run_jobs
from sdc_taichi.benchmark.jobs import DoneJob, Job, JobResult
from sdc_taichi.benchmark.ray_cluster import RayCluster
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.sweep import Sweep, sweep_inputs, sweep_jobs
from sdc_taichi.benchmark.vary import Grid
from sdc_taichi.config import load_config
from sdc_taichi.exogenous.year_clock import DAYS_PER_MONTH

CASES = ("batch", "processes-1", "processes-2", "ray-1", "ray-2")
TICKS_PER_S = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Run:
    """Speed, processor time and memory of one case, such as a sweep in two processes."""

    case: str
    """Name of the executor and its number of workers, such as ``processes-2``."""
    jobs: int
    """Number of jobs."""
    steps: int
    """Steps of data centers in all jobs."""
    wall_s: float
    """Time until the last result is written, in s."""
    job_s: float
    """Processor time within the functions of the jobs, in s."""
    core_s: float
    """Processor time of the command, of all workers and of Ray, in s."""
    driver_s: float
    """Processor time of the command alone, in s."""
    most_mb: float
    """Largest memory of the command, in MB."""


def nothing(values: Mapping[str, Any], _inputs: Mapping[str, bytes]) -> JobResult:
    """A job that returns its number."""
    return JobResult(None, {"number": values["number"]})


def executor_of(case: str) -> Executor:
    """The executor that runs the jobs of a case: this process, local processes, or Ray."""
    kind, _, workers = case.partition("-")
    if kind == "batch":
        return Executor()
    return (
        LocalProcesses(int(workers)) if kind == "processes" else RayCluster("local", int(workers))
    )


def tree_s() -> float:
    """Processor time of this process and all that it has started, in s."""
    children: dict[int, list[int]] = {}
    ticks: dict[int, int] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        children.setdefault(int(fields[1]), []).append(int(folder.name))
        ticks[int(folder.name)] = sum(map(int, fields[11:15]))  # with those that it waited for
    total, rest = 0, [os.getpid()]
    while rest:
        process = rest.pop()
        total += ticks.get(process, 0)
        rest += children.get(process, [])
    return total / TICKS_PER_S


def measure(
    case: str, jobs: Iterable[Job], total: int, steps: int, inputs: Mapping[str, bytes]
) -> Run:
    """Run jobs in one case, and keep their results in a folder that is deleted."""
    within_s, begin_s, before_s, driver_s = 0.0, time.perf_counter(), tree_s(), time.process_time()

    def note(_job: Job, ended: DoneJob | None) -> None:
        nonlocal within_s
        if ended is None or ended.error:
            raise RuntimeError(ended.error if ended else "the folder is not empty")
        within_s += ended.core_s

    with tempfile.TemporaryDirectory() as folder, executor_of(case) as executor:
        run_jobs(jobs, ResultStore(Path(folder)), executor, inputs, on_done=note)
        return Run(
            case=case,
            jobs=total,
            steps=steps,
            wall_s=time.perf_counter() - begin_s,
            job_s=within_s,
            core_s=tree_s() - before_s,
            driver_s=time.process_time() - driver_s,
            most_mb=most_mb(),
        )


def numbered(number: int) -> Iterator[Job]:
    """Jobs that do nothing."""
    return (Job("scale:nothing", {"number": i}, {"number": str(i)}) for i in range(number))


def sweep(case: str, setpoints: int, months: Sequence[int]) -> Run:
    """A sweep of setpoints and sites, in months."""
    setpoint = Grid("hvac.setpoint.initial_c", tuple(16 + 0.1 * i for i in range(setpoints)))
    varied = (setpoint, Grid("site.location", SITES))
    runs = Sweep(load_config("corrected"), varied, months=tuple(months))
    inputs = sweep_inputs(runs)
    jobs = list(sweep_jobs(runs, inputs))
    steps = setpoints * len(SITES) * sum(DAYS_PER_MONTH[month - 1] * 96 for month in months)
    return measure(case, jobs, len(jobs), steps, inputs)


def table(runs: Sequence[Run]) -> str:
    """Speed of sweeps, also relative to the first, and what a job costs the command."""
    lines = [
        "| sweep | steps per core second | ratio | of it in jobs | steps/s | command, MB |",
        "|---|---|---|---|---|---|",
    ]
    sweeps = [run for run in runs if run.steps]
    for run in sweeps:
        rate, first = run.steps / run.core_s, sweeps[0].steps / sweeps[0].core_s
        lines.append(
            f"| {run.case} | {rate:,.0f} | {rate / first:.3f} | {run.job_s / run.core_s:.1%} "
            f"| {run.steps / run.wall_s:,.0f} | {run.most_mb:.0f} |"
        )
    lines += ["", "| jobs that do nothing | number | jobs/s | command, ms a job | command, MB |"]
    lines.append("|---|---|---|---|---|")
    lines += [
        f"| {run.case} | {run.jobs:,} | {run.jobs / run.wall_s:,.0f} "
        f"| {1000 * run.driver_s / run.jobs:.2f} | {run.most_mb:.0f} |"
        for run in runs
        if not run.steps
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs/bench-scale"))
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--setpoints", type=int, default=104)
    parser.add_argument("--months", type=int, nargs="+", default=list(range(1, 13)))
    parser.add_argument("--jobs", type=int, default=2000, help="number of those that do nothing")
    parser.add_argument("--here", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here is not None:
        case, kind = options.here
        run = (
            sweep(case, options.setpoints, options.months)
            if kind == "sweep"
            else measure(case, numbered(options.jobs), options.jobs, 0, {})
        )
        print(json.dumps(asdict(run)))
        return
    runs = []
    one_thread = os.environ | {"SDC_TAICHI_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    for kind, case in itertools.product(("sweep", "nothing"), options.cases):
        command = [sys.executable, __file__, *sys.argv[1:], "--here", case, kind]
        done = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=one_thread
        )
        runs.append(Run(**json.loads(done.stdout.splitlines()[-1])))
        print(runs[-1], file=sys.stderr, flush=True)
    options.folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"runs": [asdict(run) for run in runs]}, indent=1, allow_nan=False)
    (options.folder / "scale.json").write_text(text + "\n", encoding="utf-8")
    print(table(runs))


if __name__ == "__main__":
    main()
