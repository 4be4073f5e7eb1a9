"""Random hostile inputs in small, and the judge of `make fuzz`, which must be able to fail."""

from __future__ import annotations

import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import fuzz
from fuzz_kinds import KINDS, Case
from sdc_taichi import SdcError

SECRET = "abcdef-0123"


def fails(error: Exception) -> None:
    raise error


def two_lines() -> None:
    error = SdcError("x")
    error.args = ("one\ntwo",)
    raise error


@pytest.mark.parametrize(
    ("case", "said"),
    [
        (Case("x", lambda: fails(TypeError("odd"))), "TypeError: odd"),
        (Case("x", two_lines), "other than one line"),
        (Case("x", lambda: None, must_refuse=True), "accepted; it must be refused"),
        (Case("x", lambda: Path(fuzz.MARK).touch()), "code of a file has run"),
        (Case("x", lambda: fails(SdcError(f"no {SECRET.upper()}")), secret=SECRET), "in a message"),
        (Case("x", lambda: logging.debug(SECRET), secret=SECRET), "in a message"),
        (Case("x", lambda: Path("a").write_text(SECRET), secret=SECRET), "the secret is in a"),
    ],
)
def test_a_case_fails_if_it_is_not_clean(
    case: Case, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    verdict = fuzz.judge(case, tmp_path)
    assert verdict.outcome == "failed"
    assert said in verdict.text


@pytest.mark.skipif(fuzz.peak_mb() == 0.0, reason="the system does not tell the memory")
def test_a_case_fails_if_it_takes_much_memory(tmp_path: Path) -> None:
    case = Case("x", lambda: np.ones(int(1.2 * fuzz.MOST_MB * 1e6 / 8)))
    assert "MB; valid is at most" in fuzz.judge(case, tmp_path).text


@pytest.mark.parametrize(
    ("run", "outcome"), [(lambda: None, "ran"), (lambda: fails(SdcError("no")), "refused")]
)
def test_clean_cases_run_or_are_refused(
    run: Callable[[], None], outcome: str, tmp_path: Path
) -> None:
    assert fuzz.judge(Case("x", run), tmp_path).outcome == outcome


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Folder of what cases share and of their own folders."""
    tempfile.tempdir = str(tmp_path_factory.mktemp("cases"))
    yield
    tempfile.tempdir = None


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("kind", KINDS)
def test_some_cases_of_each_kind_are_clean(kind: str) -> None:
    jobs = [job for job in fuzz.planned(27, 0, None) if job.kind == kind]
    assert jobs
    for job in jobs:
        verdict = fuzz.run_case(job)
        assert verdict.outcome != "failed", f"{job.command()}\n{verdict.text}"


def test_a_case_that_takes_too_long_is_a_failure_and_the_next_ones_go_on() -> None:
    jobs = fuzz.planned(2, 0, "saved-states")
    verdicts = fuzz.run_all(jobs, 1, time.monotonic() + 600.0, limit_s=0.001)
    assert [verdict.outcome for verdict in verdicts.values()] == ["failed", "failed"]
    assert "took over 0.001 s" in verdicts[jobs[0]].text


def test_a_case_depends_on_its_kind_seed_and_number_alone(tmp_path: Path) -> None:
    before = os.environ.get("SDC_TAICHI_DATA")
    job = fuzz.Job("malformed-configurations", 5, 3)
    first, again = (fuzz.run_case(job) for _ in range(2))
    assert first.outcome == again.outcome
    assert first.text.partition("\n")[0] == again.text.partition("\n")[0]
    assert len(set(fuzz.planned(100, 0, None))) == 100
    assert os.environ.get("SDC_TAICHI_DATA") == before
