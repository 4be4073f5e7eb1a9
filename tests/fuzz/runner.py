"""Runs cases in processes of their own, which may crash or hang, and prints a table."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from fuzz.areas import AREAS, SEED
from fuzz.case import TIME_LIMIT_S, Outcome, run_case

SPARE_S = 30
"""Time beyond that of a case after which its process is ended."""
Job = tuple[str, int]
"""Area and number of a case."""


def work(jobs: Sequence[Job], seed: int, keep: Path, out: Connection) -> None:
    """Run cases one after the other and send each outcome."""
    for name, number in jobs:
        out.send(run_case(name, AREAS[name].area, seed, number, keep))
    out.close()


class Worker:
    """A process that runs a part of the cases, and another one after a crash or a hang."""

    def __init__(self, jobs: Sequence[Job], seed: int, keep: Path) -> None:
        self.jobs, self.seed, self.keep = list(jobs), seed, keep
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.outcomes, sent = context.Pipe(duplex=False)
        self.process = context.Process(target=work, args=(self.jobs, self.seed, self.keep, sent))
        self.process.start()
        sent.close()
        self.since = time.monotonic()

    def next(self) -> Outcome | None:
        """The outcome that is there; None while the case still runs."""
        name, number = self.jobs[0]
        if self.outcomes.poll():
            try:
                outcome: Outcome = self.outcomes.recv()
                self.jobs.pop(0)
                self.since = time.monotonic()
                return outcome
            except EOFError:
                self.process.join()
                text = f"the process ended with code {self.process.exitcode}"
        elif time.monotonic() - self.since > TIME_LIMIT_S + SPARE_S:
            self.process.kill()
            self.process.join()
            text = f"no end within {TIME_LIMIT_S + SPARE_S} s, not even by an alarm"
        else:
            return None
        self.jobs.pop(0)
        if self.jobs:
            self._start()
        return Outcome(name, number, "failure", text)


def outcomes(jobs: Sequence[Job], seed: int, keep: Path, processes: int) -> Iterator[Outcome]:
    """Outcomes of cases, as they end, from some processes at a time."""
    workers = [Worker(part, seed, keep) for i in range(processes) if (part := jobs[i::processes])]
    while workers:
        wait([worker.outcomes for worker in workers], timeout=1.0)
        for worker in workers:
            outcome = worker.next()
            if outcome is not None:
                yield outcome
        workers = [worker for worker in workers if worker.jobs]


def table(found: Counter[tuple[str, str]]) -> str:
    """Cases, clean errors, correct runs and failures of each area."""
    kinds = ("error", "run", "failure")
    rows: list[tuple[str, ...]] = [("", "cases", "clean errors", "correct runs", "failures")]
    for name in AREAS:
        counts = [found[name, kind] for kind in kinds]
        if sum(counts):
            rows.append((name, *map(str, (sum(counts), *counts))))
    counts = [sum(found[name, kind] for name in AREAS) for kind in kinds]
    rows.append(("all", *map(str, (sum(counts), *counts))))
    return "\n".join("  ".join(f"{cell:>12}" for cell in row) for row in rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run cases and print how they ended; 1 if any failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=SEED, help="other cases with another seed")
    parser.add_argument("--case", action="append", help="AREA or AREA:NUMBER; repeatable")
    parser.add_argument("--sample", action="store_true", help="only the cases of the suite")
    parser.add_argument("--keep", type=Path, default=Path("runs/fuzz"), help="for failing inputs")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--verbose", action="store_true", help="print every outcome")
    given = parser.parse_args(arguments)
    counts = {n: plan.sample if given.sample else plan.cases for n, plan in AREAS.items()}
    jobs = [(name, number) for name, count in counts.items() for number in range(count)]
    if given.case:
        parts = [text.partition(":") for text in given.case]
        jobs = [
            (name, number)
            for name, _, text in parts
            for number in ([int(text)] if text else range(counts[name]))
        ]
    given.keep.mkdir(parents=True, exist_ok=True)
    found: Counter[tuple[str, str]] = Counter()
    start = time.monotonic()
    for outcome in outcomes(jobs, given.seed, given.keep.resolve(), given.processes):
        found[outcome.area, outcome.kind] += 1
        if outcome.kind == "failure" or given.verbose:
            print(_told(outcome, given), flush=True)
    print(table(found))
    print(f"{time.monotonic() - start:.0f} s; inputs of failures are in {given.keep}")
    return int(any(kind == "failure" for _, kind in found))


def _told(outcome: Outcome, given: Any) -> str:
    """A case, how to run it again, and how it ended."""
    again = f"python -m tests.fuzz --seed {given.seed} --case {outcome.area}:{outcome.number}"
    return f"{outcome.kind}: {again}\n{outcome.text}".rstrip() + "\n"
