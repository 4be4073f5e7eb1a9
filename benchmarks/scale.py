"""Sweeps on more than one process: what processes and Ray cost beside one batch in one process.

    python benchmarks/scale.py [FOLDER] [--rounds 3] [--setpoints 104] [--months 1 2] [--jobs 2000]

runs a sweep of preset ``corrected`` (setpoints x 8 sites x months, 9,984 data-center months) as one
batch after the other in this process, in one and two local processes, and on Ray with one and two
processors; then many jobs that do nothing, to tell what a job costs its driver. Cases take turns,
each in a process of its own, and no worker uses more than one thread. Processor time is that of the
driver, of all workers and of Ray's own processes: other work on the machine disturbs it less than
the time on the clock. Memory is that of the driver after a quarter of the jobs and after all.
Writes ``scale.json`` to FOLDER and prints tables of medians.

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
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from statistics import median
from typing import Any

from sdc_taichi.benchmark.executors import Executor, LocalProcesses, run_jobs
from sdc_taichi.benchmark.jobs import DoneJob, Job, JobResult
from sdc_taichi.benchmark.ray_cluster import RayCluster
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.sweep import Sweep, sweep_inputs, sweep_jobs
from sdc_taichi.benchmark.vary import Grid
from sdc_taichi.config import load_config
from sdc_taichi.exogenous.year_clock import DAYS_PER_MONTH

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
CASES = ("batch", "processes-1", "processes-2", "ray-1", "ray-2")
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1e6


@dataclass(frozen=True)
class Run:
    """Speed, processor time and memory of one case, such as a sweep in two processes."""

    case: str
    """Name of the executor and its number of workers, such as ``processes-2``."""
    jobs: int
    """Number of jobs."""
    steps: int
    """Steps of data centers in all jobs."""
    start_wall_s: float
    """Time from nothing to workers that have each done a job that does nothing, s."""
    start_core_s: float
    """Processor time of the driver, of all workers and of Ray until then, s."""
    wall_s: float
    """Time from then to the last result that is written, s."""
    job_s: float
    """Processor time within the functions of the jobs, s."""
    core_s: float
    """Processor time of the driver, of all workers and of Ray in that time, s."""
    driver_s: float
    """Processor time of the driver in that time, s."""
    quarter_mb: float
    """Memory of the driver after a quarter of the jobs, MB."""
    end_mb: float
    """Memory of the driver after the last job, MB."""


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
    """Processor time of this process and all that it has started, s."""
    children: dict[int, list[int]] = {}
    ticks: dict[int, int] = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        except OSError:  # it has ended
            continue
        children.setdefault(int(fields[1]), []).append(int(folder.name))
        ticks[int(folder.name)] = sum(map(int, fields[11:15]))  # with those that it waited for
    found, rest = 0, [os.getpid()]
    while rest:
        process = rest.pop()
        found += ticks.get(process, 0)
        rest += children.get(process, [])
    return found / TICKS_PER_S


def memory_mb() -> float:
    """Memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1]) * PAGE_MB


def measure(
    case: str, jobs: Iterable[Job], total: int, steps: int, inputs: Mapping[str, bytes]
) -> Run:
    """Run jobs in one case, and keep their results in a folder that is deleted."""
    memory: list[float] = []
    within_s = 0.0

    def note(_job: Job, ended: DoneJob | None) -> None:
        nonlocal within_s
        if ended is None or ended.error:
            raise RuntimeError(ended.error if ended else "the folder is not empty")
        within_s += ended.core_s
        memory.append(memory_mb())

    marks = [time.perf_counter()]
    with tempfile.TemporaryDirectory() as folder, executor_of(case) as executor:
        for _ in executor.results(numbered(2 * executor.workers), {}, lambda: False):
            pass
        marks.append(time.perf_counter())
        start_core_s, start_driver_s = tree_s(), time.process_time()
        run_jobs(jobs, ResultStore(Path(folder)), executor, inputs, on_done=note)
        marks.append(time.perf_counter())
        return Run(
            case=case,
            jobs=total,
            steps=steps,
            start_wall_s=marks[1] - marks[0],
            start_core_s=start_core_s,
            wall_s=marks[2] - marks[1],
            job_s=within_s,
            core_s=tree_s() - start_core_s,
            driver_s=time.process_time() - start_driver_s,
            quarter_mb=memory[total // 4],
            end_mb=memory[-1],
        )


def numbered(number: int) -> Iterator[Job]:
    """Jobs that do nothing."""
    return (Job("scale:nothing", {"number": i}, {"number": str(i)}) for i in range(number))


def sweep(case: str, setpoints: int, months: Sequence[int]) -> Run:
    """A sweep of setpoints and sites, in months."""
    config = load_config("corrected")
    asked = Sweep(
        config,
        (
            Grid("hvac.setpoint.initial_c", tuple(16 + 0.1 * i for i in range(setpoints))),
            Grid("site.location", SITES),
        ),
        months=tuple(months),
    )
    inputs = sweep_inputs(asked)
    jobs = list(sweep_jobs(asked, inputs))
    steps = setpoints * len(SITES) * sum(DAYS_PER_MONTH[month - 1] * 96 for month in months)
    return measure(case, jobs, len(jobs), steps, inputs)


def table(runs: Sequence[Run]) -> str:
    """Medians of sweeps, as ratios to one batch in one process, and what a job costs its driver."""
    lines = [
        "| sweep | start, core s | start, s | steps per core second | ratio | of it in jobs "
        "| steps/s | driver, MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    sweeps = medians([run for run in runs if run.steps])
    for run in sweeps:
        rate, first = run.steps / run.core_s, sweeps[0].steps / sweeps[0].core_s
        lines.append(
            f"| {run.case} | {run.start_core_s:.1f} | {run.start_wall_s:.1f} | {rate:,.0f} "
            f"| {rate / first:.3f} | {run.job_s / run.core_s:.1%} | {run.steps / run.wall_s:,.0f} "
            f"| {run.quarter_mb:.0f} to {run.end_mb:.0f} |"
        )
    lines += ["", "| jobs that do nothing | number | jobs/s | driver, ms a job | driver, MB |"]
    lines.append("|---|---|---|---|---|")
    lines += [
        f"| {run.case} | {run.jobs:,} | {run.jobs / run.wall_s:,.0f} "
        f"| {1000 * run.driver_s / run.jobs:.2f} | {run.quarter_mb:.1f} to {run.end_mb:.1f} |"
        for run in medians([run for run in runs if not run.steps])
    ]
    return "\n".join(lines)


def medians(runs: Sequence[Run]) -> list[Run]:
    """Median of each figure over the rounds of a case."""
    of_cases: dict[tuple[str, int], list[Run]] = {}
    for run in runs:
        of_cases.setdefault((run.case, run.jobs), []).append(run)
    return [
        Run(case, jobs, *(median(each) for each in zip(*map(figures, rounds), strict=True)))
        for (case, jobs), rounds in of_cases.items()
    ]


def figures(run: Run) -> tuple[Any, ...]:
    """Times in s, rates and memory of a run by name, without its case and its number of jobs."""
    return astuple(run)[2:]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs/bench-scale"))
    parser.add_argument("--cases", nargs="+", choices=CASES, default=CASES)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--setpoints", type=int, default=104)
    parser.add_argument("--months", type=int, nargs="+", default=list(range(1, 13)))
    parser.add_argument("--jobs", type=int, nargs="*", default=[2000], help="that do nothing")
    parser.add_argument("--here", help="measure one case here, and print its JSON")
    given = parser.parse_args(arguments)
    if given.here:
        here = (
            measure(given.here, numbered(given.jobs[0]), given.jobs[0], 0, {})
            if given.jobs
            else sweep(given.here, given.setpoints, given.months)
        )
        print(json.dumps(asdict(here)))
        return
    runs = []
    one_thread = os.environ | {"SDC_TAICHI_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    turns = itertools.product(range(given.rounds), ([], *([each] for each in given.jobs)))
    for (_, jobs), case in itertools.product(turns, given.cases):
        command = [sys.executable, __file__, "--here", case, "--setpoints", str(given.setpoints)]
        command += ["--jobs", *map(str, jobs), "--months", *map(str, given.months)]
        done = subprocess.run(
            command, check=True, stdout=subprocess.PIPE, text=True, env=one_thread
        )
        runs.append(Run(**json.loads(done.stdout.splitlines()[-1])))
        print(runs[-1], file=sys.stderr, flush=True)
    given.folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"runs": [asdict(run) for run in runs]}, indent=1, allow_nan=False)
    (given.folder / "scale.json").write_text(text + "\n", encoding="utf-8")
    print(table(runs))


if __name__ == "__main__":
    main()
