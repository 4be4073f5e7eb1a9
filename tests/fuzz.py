"""Random hostile inputs: each must end in a correct run, or in one clean error: `make fuzz`.

Each case depends only on its kind, the seed and its number, so a failing case can be run alone. A
case fails if it raises another exception than an ``SdcError`` of one line, takes too long or too
much memory, ends the process, shows a secret, or runs code of a file.
"""

from __future__ import annotations

import argparse
import faulthandler
import logging
import multiprocessing
import os
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from fuzz_kinds import Case

LIMIT_S = 60.0
"""Longest time of a case, in s; a case that compiles kernels takes several seconds."""
MOST_MB = 500.0
"""Largest growth of the memory of the process during a case, in MB."""
MARK = "code_ran"
"""File that code of hostile files writes."""


class Job(NamedTuple):
    """A case by its kind and its number."""

    kind: str
    seed: int
    number: int

    def command(self) -> str:
        return f"python tests/fuzz.py --only {self.kind} --seed {self.seed} --case {self.number}"


class Verdict(NamedTuple):
    """How a case ended."""

    outcome: str
    """``ran``, ``refused`` or ``failed``."""
    text: str
    """Description of the hostile input, and of the failure if the case failed."""
    seconds: float


# A case


def judge(case: Case, folder: Path) -> Verdict:
    """Run a case, whose folder is the current one, and judge how it ends."""
    from sdc_taichi import SdcError, SdcWarning

    logs: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: logs.append(record.getMessage())  # type: ignore[method-assign]
    logging.getLogger().addHandler(handler)
    level = logging.getLogger().level
    if case.secret:
        logging.getLogger().setLevel(logging.DEBUG)
    begin, memory_mb = time.monotonic(), peak_mb(reset=True)
    failures, message, outcome = [], "", "ran"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "'locale.getdefaultlocale'", DeprecationWarning)
            warnings.simplefilter("ignore", SdcWarning)
            case.run()
    except SdcError as error:
        outcome, message = "refused", str(error)
        if len(message.splitlines()) != 1:
            failures.append(f"a message of other than one line: {message!r}")
    except Exception:
        failures.append(traceback.format_exc())
    finally:
        logging.getLogger().removeHandler(handler)
        logging.getLogger().setLevel(level)
    seconds = time.monotonic() - begin
    if case.must_refuse and outcome == "ran" and not failures:
        failures.append("accepted; it must be refused")
    if (grown_mb := peak_mb() - memory_mb) > MOST_MB:
        failures.append(f"takes {grown_mb:.0f} MB; valid is at most {MOST_MB:.0f} MB")
    for path in folder.rglob("*"):
        if path.name == MARK:
            failures.append("code of a file has run")
        if case.secret and case.secret.casefold().encode() in seen_in(path):
            failures.append(f"the secret is in {path.relative_to(folder)}")
    if case.secret and case.secret.casefold() in "\n".join([message, *logs]).casefold():
        failures.append(f"the secret is in a message: {message}")
    if failures:
        return Verdict("failed", "\n".join([case.about, *failures]), seconds)
    return Verdict(outcome, f"{case.about}\n{message}", seconds)


def seen_in(path: Path) -> bytes:
    """Return path and content of a file in lower case."""
    content = path.read_bytes() if path.is_file() else b""
    return str(path).casefold().encode() + content.lower()


def peak_mb(*, reset: bool = False) -> float:
    """Return the largest memory of this process in MB, since the start or the last reset.

    Systems other than Linux do not tell it; there the result is 0.
    """
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((float(x.split()[1]) / 1024.0 for x in lines if x.startswith("VmHWM")), 0.0)


def run_case(job: Job) -> Verdict:
    """Draw a case and run it in a new folder, which is deleted afterwards."""
    from fuzz_kinds import KINDS

    home, before = Path.cwd(), dict(os.environ)
    path, modules = list(sys.path), set(sys.modules)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name).resolve()
        os.chdir(folder)
        os.environ["SDC_TAICHI_DATA"] = str(folder / "data")
        rng = np.random.default_rng([job.seed, zlib.crc32(job.kind.encode()), job.number])
        try:
            case = KINDS[job.kind][0](rng, folder)
            return judge(case, folder)
        except Exception:
            return Verdict("failed", f"the case cannot be drawn\n{traceback.format_exc()}", 0.0)
        finally:
            os.chdir(home)
            os.environ.clear()
            os.environ.update(before)
            sys.path[:] = path
            for module in set(sys.modules) - modules:
                if module.partition(".")[0] == "marks":
                    del sys.modules[module]


# Processes


def work(jobs: Connection, limit_s: float) -> None:
    """Run the cases that arrive, until None arrives; one that takes too long ends the process."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        # Optima and what cases share are not left behind; kernels stay in their usual cache.
        tempfile.tempdir = name
        limit_memory()
        np.seterr(divide="raise", invalid="raise")
        while (job := jobs.recv()) is not None:
            faulthandler.dump_traceback_later(limit_s, exit=True)
            verdict = run_case(job)
            faulthandler.cancel_dump_traceback_later()
            jobs.send(verdict)


def limit_memory() -> None:
    """Let requests for more than 6 GB fail at once, where the system has such a limit."""
    try:
        import resource

        size_pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        return
    most = size_pages * resource.getpagesize() + 6 * 1024**3
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.getrlimit(resource.RLIMIT_AS)[1]))


@dataclass
class Worker:
    """A process that runs one case after another."""

    process: Any
    jobs: Connection
    job: Job

    @classmethod
    def started(cls, job: Job, limit_s: float) -> Worker:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=work, args=(theirs, limit_s), daemon=True)
        process.start()
        theirs.close()
        ours.send(job)
        return cls(process, ours, job)


def run_all(
    jobs: Sequence[Job], processes: int, end: float, limit_s: float = LIMIT_S
) -> dict[Job, Verdict]:
    """Run cases in processes until all are done or the time is over; print those that fail."""
    waiting, verdicts = deque(jobs), {}
    workers = [
        Worker.started(waiting.popleft(), limit_s) for _ in range(min(processes, len(waiting)))
    ]
    while workers:
        ready = wait([worker.jobs for worker in workers])
        for worker in [each for each in workers if each.jobs in ready]:
            workers.remove(worker)
            try:
                verdict = worker.jobs.recv()
            except EOFError:
                worker.process.join()
                code = worker.process.exitcode
                text = f"the process ended with {code}: it took over {limit_s:g} s, or crashed"
                verdict = Verdict("failed", text, limit_s)
            verdicts[worker.job] = verdict
            if verdict.outcome == "failed":
                print(f"\nFAILED {worker.job.command()}\n{verdict.text}", flush=True)
            if len(verdicts) % 300 == 0:
                print(f"{len(verdicts)} of {len(jobs)} cases", flush=True)
            alive = worker.process.is_alive() and not worker.process.exitcode
            if waiting and time.monotonic() < end:
                job = waiting.popleft()
                if alive:
                    worker.jobs.send(job)
                    workers.append(Worker(worker.process, worker.jobs, job))
                else:
                    workers.append(Worker.started(job, limit_s))
            elif alive:
                worker.jobs.send(None)
                worker.process.join()
    return verdicts


def table(verdicts: dict[Job, Verdict], planned: Sequence[Job]) -> str:
    """Return counts and times of each kind as text."""
    rows: list[tuple[str, ...]] = [
        ("kind", "cases", "ran", "refused", "failed", "mean s", "longest s")
    ]
    for kind in [*dict.fromkeys(job.kind for job in planned), None]:
        of_kind = [v for job, v in verdicts.items() if kind in (None, job.kind)]
        counts = [str(sum(v.outcome == x for v in of_kind)) for x in ("ran", "refused", "failed")]
        seconds = [v.seconds for v in of_kind] or [0.0]
        mean, longest = f"{np.mean(seconds):.2f}", f"{max(seconds):.1f}"
        rows.append((kind or "all", str(len(of_kind)), *counts, mean, longest))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows
    )


def planned(cases: int, seed: int, only: str | None) -> list[Job]:
    """Return cases of all kinds in proportion to their shares, in a mixed order."""
    from fuzz_kinds import KINDS

    shares = {name: share for name, (_, share) in KINDS.items() if only in (None, name)}
    total = sum(shares.values())
    # The n-th case of a kind comes after (n + 0.5) / share of the whole.
    places = [
        ((n + 0.5) / share, Job(name, seed, n))
        for name, share in shares.items()
        for n in range(int(cases * share / total) + 1)
    ]
    return [job for _, job in sorted(places, key=lambda each: (each[0], each[1].kind))][:cases]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases that the command line asks for; return the exit code."""
    from fuzz_kinds import KINDS

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=3000, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="seed of all cases")
    parser.add_argument("--only", choices=list(KINDS), help="one kind of cases")
    parser.add_argument("--case", type=int, help="number of the only case, with --only")
    parser.add_argument("--minutes", type=float, default=15.0, help="longest time")
    parser.add_argument(
        "--processes", type=int, default=len(os.sched_getaffinity(0)) if hasattr(
            os, "sched_getaffinity"
        ) else os.cpu_count() or 1, help="number of processes",
    )  # fmt: skip
    asked = parser.parse_args(arguments)
    if asked.case is not None:
        if asked.only is None:
            parser.error("--case needs --only")
        jobs = [Job(asked.only, asked.seed, asked.case)]
    else:
        jobs = planned(asked.cases, asked.seed, asked.only)
    begin = time.monotonic()
    verdicts = run_all(jobs, asked.processes, begin + 60.0 * asked.minutes)
    if asked.case is not None:
        print("\n".join(verdict.text for verdict in verdicts.values()))
    print(f"\n{table(verdicts, jobs)}\n{time.monotonic() - begin:.0f} s, seed {asked.seed}")
    if len(verdicts) < len(jobs):
        print(f"only {len(verdicts)} of {len(jobs)} cases were run in {asked.minutes:g} min")
    failed = any(verdict.outcome == "failed" for verdict in verdicts.values())
    return int(failed or len(verdicts) < len(jobs))


if __name__ == "__main__":
    sys.exit(main())
