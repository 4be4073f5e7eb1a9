"""Rows of others: whole ones enter the report, and forged or unfinished ones are one line each."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from made_studies import ACHIEVED, ARRIVED, BOUND, IDLE, SITES, WEEKS, frame_of, write_study
from policies import interface, policy
from sdc_taichi import ConfigError, SdcError
from sdc_taichi.benchmark.cases import data_centers
from sdc_taichi.benchmark.jobs import run_job
from sdc_taichi.benchmark.leaderboard import leaderboard
from sdc_taichi.benchmark.report import write_report
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.submission import add_submission, read_submission, write_submission
from sdc_taichi.benchmark.submission_checks import KnownCase, check_rows
from sdc_taichi.benchmark.suite import make_suite
from sdc_taichi.benchmark.suite_jobs import row_jobs
from sdc_taichi.benchmark.suite_results import read_suites
from sdc_taichi.benchmark.suite_run import study_of
from sdc_taichi.cli.app import app
from sdc_taichi.learning.controller import PolicyController
from sdc_taichi.learning.evaluation import Contender, evaluate, prepare
from sdc_taichi.optimum.objective import Objective

PARTITION = {"suite": "made-up", "case": "two-sites", "row": "theirs", "seed": "0"}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_study(tmp_path_factory.mktemp("study") / "made-up")


@pytest.fixture
def target(study: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(study, tmp_path / "target"))


def write_row(out: Path, *saved: float, **names: Any) -> Path:
    """The folder of a row, with a seed for each share that it saves."""
    frames = {seed: frame_of(share) for seed, share in enumerate(saved or (0.05,))}
    given: dict[str, Any] = {
        "suite": "made-up",
        "case": "two-sites",
        "row": "theirs",
        "kind": "controller",
        "author": "A <b>university</b>",
    }
    write_submission(out, frames, **(given | names))
    return out


def edited(path: Path, **values: Any) -> None:
    """Change entries of a JSON file."""
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_a_row_of_others_enters_the_report_and_is_told_as_theirs(
    target: Path, tmp_path: Path
) -> None:
    files = {0: {"best/policy.json": b"{}"}}
    row = write_row(tmp_path / "row", 0.05, link="https://x.org/a", files=files)
    submission, notes = add_submission(row, target)
    assert (submission.row, submission.cases, notes) == ("theirs", ("two-sites",), ())
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
        "> two-sites: theirs is the work of others and was not run here: A "
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
        ({"case": "three-sites"}, "case 'three-sites': no results to hold it against; valid: two"),
        ({"suite": "carbon"}, "is of suite 'carbon'; valid is made-up"),
        ({"about": "x" * 1001}, "about of 1,001 letters; valid are at most 1,000"),
        ({"kind": "best"}, "kind 'best'; valid are learner, controller"),
    ],
)
def test_names_of_a_row(study: Path, tmp_path: Path, names: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        add_submission(write_row(tmp_path / "row", **names), study)


def big(folder: Path) -> None:
    with open(folder / "jobs/suite=made-up/case=two-sites/row=theirs/seed=0/x", "wb") as file:
        file.truncate(10**12)


def job_folder(folder: Path) -> Path:
    return ResultStore(folder).folder_of(PARTITION)


FORGERIES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no rows": (
        lambda x: ResultStore(x).rows_path(PARTITION).unlink(),
        r"rows\.parquet: no such file",
    ),
    "cut rows": (
        lambda x: os.truncate(ResultStore(x).rows_path(PARTITION), 100),
        "rows or files are not those that it tells of",
    ),
    "no metrics": (
        lambda x: (job_folder(x) / "metrics.json").unlink(),
        "holds no results; valid is a metrics.json for each seed",
    ),
    "no author": (lambda x: (x / "submission.json").unlink(), r"submission\.json: no such file"),
    "other format": (
        lambda x: edited(job_folder(x) / "metrics.json", format="sdc-result/9"),
        "format 'sdc-result/9'; valid is 'sdc-result/1'",
    ),
    "other version": (
        lambda x: edited(job_folder(x) / "metrics.json", version="9.9"),
        r"version '9\.9'; valid is",
    ),
    "other values": (
        lambda x: edited(job_folder(x) / "metrics.json", values={"seed": 7}),
        "key '[0-9a-f]+'; valid is [0-9a-f]+",
    ),
    "other partition": (
        lambda x: edited(job_folder(x) / "metrics.json", partition=PARTITION | {"row": "g36"}),
        "valid is the folder of that",
    ),
    "file that leaves": (
        lambda x: edited(job_folder(x) / "metrics.json", files_sha256={"../../x": "0" * 64}),
        r"file '\.\./\.\./x' of a result: valid is a path below",
    ),
    "file not told of": (
        lambda x: (job_folder(x) / "virus.exe").write_text("x"),
        r"virus\.exe: metrics\.json does not tell of it",
    ),
    "link": (
        lambda x: (job_folder(x) / "passwd").symlink_to("/etc/passwd"),
        "passwd: is a link or no file",
    ),
    "huge file": (big, "more than 10,000 files or 512 MB"),
    "other folder": (lambda x: (x / "more").mkdir(), "more: valid are jobs, results"),
    "two rows": (
        lambda x: write_row(x, row="another"),
        "holds .* and others; valid is one row of one suite",
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


KNOWN = KnownCase(
    objective=Objective(carbon=1.0),
    days=7,
    frame=frame_of(0.0),
    bound=BOUND,
    ci_g_per_kwh=np.tile([150.0, 300.0], (len(IDLE), 1)),
)


def row_with(**columns: Any) -> pd.DataFrame:
    return frame_of(0.05).assign(**columns)


def test_rows_that_fit_together_pass() -> None:
    check_rows(frame_of(0.05), KNOWN, "row")
    check_rows(frame_of(0.0), KNOWN, "row")
    alone = frame_of(0.01, "battery", figures_alone=True)
    check_rows(pd.concat([frame_of(0.1), alone]), KNOWN, "row")


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (row_with().drop(columns="cfp_kg"), "no column cfp_kg"),
        (row_with(virus=1.0), "column 'virus'; valid are moves"),
        (row_with(cfp_kg="much"), "column cfp_kg is of .*; valid are numbers"),
        (row_with(moves="racks"), "moves 'racks'; valid are all, load, cooling, battery"),
        (row_with(moves="load"), "no rows that move all"),
        (row_with()[:-1], "row, all: week 11 of ny is missing; valid is each week once"),
        (row_with(week=[3, 7, 12] * 2), "week 11 of ca is missing"),
        (row_with(site=["ca"] * 3 + ["tx"] * 3), "week 3 of ny is missing"),
        (pd.concat([row_with(), row_with()]), "row, all: 12 rows, not in the order of the case"),
        (row_with()[::-1], "row, all: 6 rows, not in the order of the case"),
        (row_with(water_l=np.nan), "week 3 of ca: water_l nan; valid is a finite number"),
        (row_with(valued_figure=np.inf), "valued_figure inf; valid is a finite number"),
        (row_with(hvac_kwh=-1.0), "hvac_kwh -1; valid is 0 or more"),
        (row_with(idle_figure=1.00001 * IDLE), r"idle_figure 100\.001, and 100 in other rows"),
        (row_with(achieved_figure=0.91 * IDLE), "achieved_figure 91, and 90 in other rows"),
        (row_with(arrived_tasks=0.9 * ARRIVED), "arrived_tasks 4500, and 5000 in other rows"),
        (row_with(figure=0.9 * IDLE), "figure 90, and 95 by its metrics; valid are equal ones"),
        (row_with(share=0.9), r"share 0\.9, and 0\.5 by its figures"),
        (
            row_with(valued_figure=0.99 * BOUND, share=(IDLE - 0.99 * BOUND) / (IDLE - ACHIEVED)),
            r"valued_figure 88\.11, below the bound 89 that nothing can reach",
        ),
        (row_with(it_kwh=5000.0), r"grid_kwh 380; valid is at least 5072\.2"),
        (row_with(peak_kw=1.0), r"peak_kw 1; valid is at least the mean power, 2\.63888889"),
        (row_with(executed_tasks=2 * ARRIVED), "executes and drops 10000 tasks, and 5000 arrive"),
        (row_with(over_27_degree_h=1.0), "over_27_degree_h 1 with hottest_inlet_c 25; valid is 0"),
    ],
)
def test_figures_that_contradict_each_other(frame: pd.DataFrame, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        check_rows(frame, KNOWN, "row")
    assert "\n" not in str(raised.value)


def test_curves_may_value_ends_below_the_bound() -> None:
    frame = frame_of(0.3)
    near = BOUND - 0.04 * (BOUND - frame["figure"].to_numpy())
    share = (IDLE - near) / (IDLE - ACHIEVED)
    check_rows(frame.assign(valued_figure=near, share=share), KNOWN, "row")


def test_carbon_is_grid_energy_at_intensities_of_the_week(study: Path, tmp_path: Path) -> None:
    frame = frame_of(0.05)
    for name in ("grid_kwh", "it_kwh", "hvac_kwh"):
        frame[name] *= 1.5  # 0.167 kg/kWh, which New York does not have in these weeks
    out = tmp_path / "row"
    write_submission(out, {0: frame}, suite="made-up", case="two-sites", row="theirs",
                     kind="controller", author="a")  # fmt: skip
    with pytest.raises(ConfigError, match="week 3 of ny: cfp_kg 209; valid is 290"):
        add_submission(out, study)


def test_the_weeks_of_the_tests_are_those_of_the_case() -> None:
    assert KNOWN.frame["site"].tolist() == [site for site in SITES for _ in WEEKS]


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
    names = {"suite": "small", "case": "hall", "kind": "learner", "author": "a"}

    def add(row: str, told: pd.DataFrame, policies: dict[str, bytes], weeks: int = 1) -> Result:
        write_submission(tmp_path / row, {0: told}, **names, row=row, files={0: policies})
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
