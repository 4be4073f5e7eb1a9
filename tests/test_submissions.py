"""Submitted rows: complete ones join the report, others are refused in one line each."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from made_studies import IDLE, frame_of
from policies import interface, policy
from sdc_taichi import ConfigError, SdcError
from sdc_taichi.benchmark.cases import data_centers
from sdc_taichi.benchmark.jobs import run_job
from sdc_taichi.benchmark.leaderboard import leaderboard
from sdc_taichi.benchmark.report import write_report
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.submission import add_submission, read_submission, write_submission
from sdc_taichi.benchmark.suite import make_suite
from sdc_taichi.benchmark.suite_results import read_suites
from sdc_taichi.benchmark.suite_run import row_jobs, study_of
from sdc_taichi.cli.app import app
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.evaluation import Contender, evaluate, prepare

PARTITION = {"suite": "made-up", "case": "two-sites", "row": "theirs", "seed": "0"}


@pytest.fixture
def target(study: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(study, tmp_path / "target"))


def write_row(out: Path, *saved: float, **names: Any) -> Path:
    """The folder of a row, with a seed for each share that it saves."""
    frames = {seed: frame_of(share) for seed, share in enumerate(saved or (0.05,))}
    defaults: dict[str, Any] = {
        "suite": "made-up",
        "case": "two-sites",
        "row": "theirs",
        "kind": "controller",
        "author": "A <b>university</b>",
    }
    write_submission(out, frames, **(defaults | names))
    return out


def edited(path: Path, **values: Any) -> None:
    """Change entries of a JSON file."""
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_a_row_of_others_enters_the_report_and_is_told_as_theirs(
    target: Path, tmp_path: Path
) -> None:
    files = {0: {"best/policy.json": b"{}"}}
    row = write_row(tmp_path / "row", 0.05, link="https://x.org/a", files=files)
    submission = add_submission(row, target)
    assert (submission.row, submission.cases) == ("theirs", ("two-sites",))
    (suite,) = read_suites([target])
    board = leaderboard(suite.cases["two-sites"]).standings.set_index("row")
    assert board.loc["theirs", "change_pct"] == pytest.approx(-5.0)
    assert board.loc["theirs", "place"] == "2"
    assert ResultStore(target).file(PARTITION, "best/policy.json") == b"{}"
    of_row = [ResultStore(x).folder_of(PARTITION) / "metrics.json" for x in (row, target)]
    assert of_row[0].read_bytes() == of_row[1].read_bytes()
    out = tmp_path / "tables.md"
    write_report([target], markdown=out)
    assert (
        "> two-sites: theirs was submitted and not run here: A "
        "\\<b\\>university\\</b\\>, https://x.org/a."
    ) in out.read_text().splitlines()
    assert "Results of several" not in out.read_text()  # a table has no source and no processor
    with pytest.raises(ConfigError, match="row theirs: the name is taken"):
        add_submission(row, target)


def test_what_was_trained_needs_all_seeds_of_the_suite(target: Path, tmp_path: Path) -> None:
    best = write_row(tmp_path / "best", 0.09, kind="learner")
    with pytest.raises(ConfigError, match="seeds 0; valid are 3 of them, from 0"):
        add_submission(best, target)
    add_submission(write_row(tmp_path / "all", 0.09, 0.05, 0.04, kind="learner"), target)
    (suite,) = read_suites([target])
    assert suite.cases["two-sites"].kinds["theirs"] == "learner"


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"row": "g36"}, "row g36: the name is taken; valid is another"),
        ({"row": "reference-x"}, "row 'reference-x': .*not beginning with reference"),
        ({"row": "../x"}, r"row '\.\./x': valid are at most 80 lower-case letters"),
        ({"case": "three-sites"}, "case 'three-sites': made-up has no results of it; valid: two"),
        ({"suite": "carbon"}, "is of suite 'carbon'; valid is made-up"),
    ],
)
def test_names_of_a_row(study: Path, tmp_path: Path, names: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        add_submission(write_row(tmp_path / "row", **names), study)


def job_folder(folder: Path) -> Path:
    return ResultStore(folder).folder_of(PARTITION)


FORGERIES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no rows": (
        lambda x: ResultStore(x).rows_path(PARTITION).unlink(),
        r"rows\.parquet: no such file",
    ),
    "other version": (
        lambda x: edited(job_folder(x) / "metrics.json", version="9.9"),
        r"version '9\.9'; valid is",
    ),
    "file that leaves": (
        lambda x: edited(job_folder(x) / "metrics.json", files_sha256={"../../x": "0" * 64}),
        r"file '\.\./\.\./x' of a result: valid is a path below",
    ),
    "two rows": (
        lambda x: write_row(x, row="another"),
        "holds 2 rows; valid is one row of one suite",
    ),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_forged_folders_are_one_line(study: Path, tmp_path: Path, name: str) -> None:
    forge, message = FORGERIES[name]
    row = write_row(tmp_path / "row")
    read_submission(row)
    forge(row)
    before = sorted(study.rglob("*"))
    with pytest.raises(SdcError, match=message) as raised:
        add_submission(row, study)
    assert "\n" not in str(raised.value)
    assert sorted(study.rglob("*")) == before


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (frame_of(0.05).drop(columns="cfp_kg"), "column cfp_kg; valid is a finite number"),
        (frame_of(0.05).assign(water_l=float("nan")), "column water_l; valid is a finite number"),
        (frame_of(0.05)[::-1], "is of other sites, years or weeks than"),
        (
            frame_of(0.05).assign(idle_figure=1.00001 * IDLE),
            "idle commands reach 100.001 ",
        ),
    ],
)
def test_rows_have_all_figures_in_the_weeks_of_the_case(
    study: Path, tmp_path: Path, frame: pd.DataFrame, message: str
) -> None:
    out = tmp_path / "row"
    write_submission(out, {0: frame}, suite="made-up", case="two-sites", row="theirs",
                     kind="controller", author="a")  # fmt: skip
    with pytest.raises(ConfigError, match=message) as raised:
        add_submission(out, study)
    assert "\n" not in str(raised.value)


def test_policies_of_others_run_again(tmp_path: Path) -> None:
    target = tmp_path / "target"
    suite = make_suite(
        {
            "name": "small",
            "title": "A small suite",
            "seeds": 1,
            "cases": {
                "hall": {"config": "tiny", "weeks": [3], "days": 2, "optimum": False},
            },
            "rows": {"idle": {"controller": "idle"}},
        }
    )
    store, (job,) = ResultStore(target), row_jobs(suite, [])
    with store.claimed(study_of(suite, suite, "sdc-taichi benchmark small.yaml")):
        store.keep(run_job(job, {}))
    theirs = policy(interface(actions="continuous"))
    theirs.save(tmp_path / "policy")
    files = {f"policy/{x.name}": x.read_bytes() for x in (tmp_path / "policy").iterdir()}
    hall = data_centers(suite.cases["hall"], "held-out")
    with prepare(hall, [3], optimum=False, days=2) as weeks:
        contender = Contender("theirs", PolicyController(theirs, weeks.sim.fleet))
        frame = evaluate(weeks, [contender], beside=False).rows.drop(columns="training")
    names: dict[str, Any] = {"suite": "small", "case": "hall", "kind": "learner", "author": "a"}

    def add(row: str, figures: pd.DataFrame, policies: dict[str, bytes], weeks: int = 1) -> Result:
        write_submission(tmp_path / row, {0: figures}, **names, row=row, files={0: policies})
        arguments = ["add", str(tmp_path / row), "--to", str(target), "--verify", str(weeks)]
        return CliRunner().invoke(app, ["benchmark", *arguments])

    done = add("theirs", frame, files, weeks=2)
    assert "verify 2: case hall has 1 weeks; valid are no more" in done.stderr
    done = add("theirs", frame, files)
    assert done.exit_code == 0, done.output
    assert "Run again in 1 weeks of each site: figures differ by 0 at most" in done.stdout
    assert "Added theirs to" in done.stdout
    better = frame.assign(**{x: 0.99 * frame[x] for x in ("figure", "cfp_kg")})
    done = add("better", better, files)
    assert done.exit_code == 2
    assert "valid are figures of the policy" in done.stderr
    done = add("without", frame, {})
    assert "holds no policy; valid is to add it without --verify" in done.stderr
    assert not (target / "jobs/suite=small/case=hall/row=better").exists()
