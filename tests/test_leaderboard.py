"""Standings of suites: places, pairs and profiles of made-up results, and folders put together."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from made_studies import ROWS, done_job, frame_of, frames_of_row, write_study
from sdc_taichi import ConfigError, SdcError
from sdc_taichi.benchmark.leaderboard import Leaderboard, leaderboard, places
from sdc_taichi.benchmark.report import write_report
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.suite_results import read_suites


@pytest.fixture(scope="module")
def board(study: Path) -> Leaderboard:
    (suite,) = read_suites([study])
    return leaderboard(suite.cases["two-sites"])


def by_row(table: pd.DataFrame) -> dict[str, dict[str, Any]]:
    return {str(x["row"]): {str(k): v for k, v in x.items()} for x in table.to_dict("records")}


def test_rows_share_places_that_intervals_do_not_tell_apart(board: Leaderboard) -> None:
    place_of = {name: row["place"] for name, row in by_row(board.standings).items()}
    assert place_of == {
        "mpc-24h": "1",
        "g36": "2 to 3",
        "ippo": "2 to 3",
        "idle": "4",
        "coldest": "5",
        "optimum": "-",
        "bound": "-",
    }
    # ippo has the lower figure, and stands behind all the same: within a place, suites decide.
    standing = by_row(board.standings)
    assert standing["ippo"]["change_pct"] < standing["g36"]["change_pct"]


def test_no_two_places_have_an_interval_that_includes_0() -> None:
    generator = np.random.Generator(np.random.PCG64(3))
    for spread in (0.01, 0.3, 1.0, 3.0):
        values = {str(i): float(x) for i, x in enumerate(generator.normal(size=12))}
        drawn = {name: x + spread * generator.normal(size=400) for name, x in values.items()}
        shared = places(values, drawn)
        assert sorted(shared) == sorted(values)
        for one, (_, last) in shared.items():
            for other, (first, _) in shared.items():
                if last < first:
                    assert np.percentile(drawn[one] - drawn[other], 97.5) < 0.0
        firsts = [first for first, _ in shared.values()]
        assert firsts == sorted(firsts)


def test_too_few_seeds_or_weeks_have_no_place(study: Path, tmp_path: Path) -> None:
    few = write_study(tmp_path / "seeds", leave_out=["made-up/two-sites/ippo/1"])
    (suite,) = read_suites([few])
    board = leaderboard(suite.cases["two-sites"])
    standings = [(row["row"], row["place"]) for row in board.standings.to_dict("records")]
    assert standings[:3] == [("mpc-24h", "1"), ("g36", "2"), ("idle", "3")]
    assert standings[4:6] == [("ippo", "-"), ("optimum", "-")]
    assert ("ippo", "g36") in [(row["row"], row["than"]) for row in board.pairs.to_dict("records")]
    store = ResultStore(tmp_path / "weeks")
    shutil.copytree(study, store.folder)
    for name in ("idle", "g36", "coldest"):
        frame = frames_of_row(name, 0)
        store.keep(done_job(name, 0, frame[frame["week"] != 7], spec=ROWS[name]))
    for name in ("mpc-24h", "ippo", "optimum", "bound"):
        shutil.rmtree(store.folder / f"jobs/suite=made-up/case=two-sites/row={name}")
    (suite,) = read_suites([store.folder])
    assert set(leaderboard(suite.cases["two-sites"]).standings["place"]) == {"-"}


def test_figures_of_the_tables(board: Leaderboard) -> None:
    standing, profile = by_row(board.standings), by_row(board.profiles)
    assert standing["optimum"]["share_pct"] == pytest.approx(100.0)
    assert standing["coldest"]["change_pct"] == pytest.approx(20.0)
    assert np.isnan(standing["bound"]["carbon_pct"])
    ippo = standing["ippo"]
    assert (ippo["trainings"], ippo["core_min"]) == (3, pytest.approx(1.8))
    assert (profile["idle"]["above_0_pct"], profile["ippo"]["above_25_pct"]) == (0.0, 50.0)
    together = by_row(board.coordination)
    assert together["ippo"]["parts_pct"] == pytest.approx(-2.0)
    assert together["optimum"]["worth_points"] == pytest.approx(2.0)
    assert together["optimum"]["together"] == pytest.approx(-6.0)
    assert together["optimum"]["in_turn"] == pytest.approx(-9.0)
    assert np.isnan(together["ippo"]["in_turn"])


def test_constraints_have_a_column_where_one_is_broken(board: Leaderboard, tmp_path: Path) -> None:
    assert "throttled_rack_h" not in board.standings
    store = ResultStore(write_study(tmp_path / "made-up", leave_out=["made-up/two-sites/g36/0"]))
    frame = frames_of_row("g36", 0).assign(throttled_rack_h=[6.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    store.keep(done_job("g36", 0, frame, spec=ROWS["g36"]))
    (suite,) = read_suites([store.folder])
    standing = by_row(leaderboard(suite.cases["two-sites"]).standings)
    assert (standing["g36"]["throttled_rack_h"], standing["idle"]["throttled_rack_h"]) == (1.0, 0.0)
    assert (standing["g36"]["throttled_rack_h_low"], standing["idle"]["throttled_rack_h_high"]) == (
        0,
        0,
    )
    assert standing["g36"]["throttled_rack_h_high"] > 1.0
    out = tmp_path / "tables.md"
    write_report([store.folder], markdown=out)
    assert "> Places are by carbon alone." in out.read_text()


def test_each_row_stands_against_the_best_rule_and_the_row_below(board: Leaderboard) -> None:
    assert board.best_rule == "g36"
    pairs = [(row["row"], row["than"]) for row in board.pairs.to_dict("records")]
    assert ("mpc-24h", "g36") in pairs
    assert ("ippo", "idle") in pairs
    assert all(one not in ("optimum", "bound") for pair in pairs for one in pair)
    (pair,) = (x for x in board.pairs.to_dict("records") if x["row"] == "mpc-24h")
    assert pair["probability"] == 1.0
    assert pair["points_low"] <= pair["points"] <= pair["points_high"] < 0.0


def test_agents_trained_apart_stand_against_those_trained_together(tmp_path: Path) -> None:
    store = ResultStore(write_study(tmp_path / "made-up"))
    spec = ROWS["ippo"] | {"apart": True}
    store.keep(done_job("ippo-apart", 0, frame_of(0.01), spec=spec))
    (suite,) = read_suites([store.folder])
    (row,) = leaderboard(suite.cases["two-sites"]).apart.to_dict("records")
    assert (row["row"], row["than"]) == ("ippo", "ippo-apart")
    assert row["points"] < 0.0


def test_figures_of_a_row_do_not_depend_on_the_rows_beside_it(
    board: Leaderboard, tmp_path: Path
) -> None:
    without = [f"made-up/two-sites/{name}/0" for name in ("coldest", "mpc-24h", "bound")]
    (suite,) = read_suites([write_study(tmp_path / "made-up", leave_out=without)])
    fewer = leaderboard(suite.cases["two-sites"])
    whole, part = (by_row(each.standings)["ippo"] for each in (board, fewer))
    assert part.pop("place") == "1 to 2"
    assert whole.pop("place") == "2 to 3"
    assert part == whole
    assert by_row(fewer.pairs)["ippo"] == by_row(board.pairs)["ippo"]
    assert suite.cases["two-sites"].missing == tuple(
        f"{name}, seed 0" for name in ("coldest", "mpc-24h", "bound")
    )


def test_seeds_of_events_are_paired_with_those_of_idle_commands(tmp_path: Path) -> None:
    store = ResultStore(write_study(tmp_path / "made-up"))
    shutil.rmtree(store.folder / "jobs" / "suite=made-up")
    for seed, factor in enumerate((1.0, 3.0, 0.5)):
        for name, saved in (("idle", 0.0), ("g36", 0.02)):
            frame = frame_of(saved)
            frame[["figure", "idle_figure"]] *= factor
            frame = frame.assign(valued_figure=np.nan, achieved_figure=np.nan, share=np.nan)
            store.keep(done_job(name, seed, frame, spec=ROWS[name]))
    (suite,) = read_suites([store.folder])
    standing = by_row(leaderboard(suite.cases["two-sites"]).standings)
    assert standing["g36"]["place"] == "1"
    assert standing["g36"]["change_pct"] == pytest.approx(-2.0)
    assert standing["g36"]["change_pct_high"] - standing["g36"]["change_pct_low"] < 1e-9
    assert "share_pct" not in standing["g36"]


def test_folders_with_results_of_one_suite_are_put_together(study: Path, tmp_path: Path) -> None:
    half = [f"made-up/two-sites/ippo/{seed}" for seed in (0, 1)]
    first = write_study(tmp_path / "first", leave_out=half)
    (suite,) = read_suites([first, study])
    assert [x.seed for x in suite.cases["two-sites"].rows["ippo"]] == [0, 1, 2]
    assert suite.cases["two-sites"].missing == ()


def test_results_that_cannot_be_compared_are_refused(study: Path, tmp_path: Path) -> None:
    store = ResultStore(tmp_path / "copy")
    shutil.copytree(study, store.folder)
    frame = frames_of_row("g36", 0)
    other = frame.assign(idle_figure=1.001 * frame["idle_figure"])
    store.keep(done_job("g36", 0, other, spec=ROWS["g36"]))
    with pytest.raises(ConfigError, match=r"row=g36/seed=0: idle commands reach 100\.1 in week 3"):
        read_suites([store.folder])
    store.keep(done_job("g36", 0, frame[frame["week"] != 7], spec=ROWS["g36"]))
    with pytest.raises(ConfigError, match="row=g36/seed=0: is of other sites, years or weeks"):
        read_suites([store.folder])
    store.keep(done_job("g36", 0, frame.assign(figure=1.0), spec=ROWS["g36"]))
    with pytest.raises(ConfigError, match="hold other results of one seed of one row"):
        read_suites([store.folder, study])


def test_damaged_folders_are_one_line(study: Path, tmp_path: Path) -> None:
    store = ResultStore(tmp_path / "copy")
    shutil.copytree(study, store.folder)
    partition = {"suite": "made-up", "case": "two-sites", "row": "g36", "seed": "0"}
    path = store.rows_path(partition)
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(ConfigError, match="has another digest"):
        read_suites([store.folder])
    path.write_bytes(content)
    moved = store.folder_of(partition).parent / "seed=9"
    store.folder_of(partition).rename(moved)
    with pytest.raises(ConfigError, match="valid is the folder of that"):
        read_suites([store.folder])
    shutil.rmtree(store.folder / "jobs")
    with pytest.raises(ConfigError, match="holds no results"):
        read_suites([store.folder])
    content_of = json.loads((store.folder / "study.json").read_text())
    (store.folder / "study.json").write_text(json.dumps(content_of | {"kind": "sweep"}))
    with pytest.raises(ConfigError, match="holds a sweep; valid is a suite"):
        read_suites([store.folder])
    with pytest.raises(SdcError, match=r"study\.json"):
        read_suites([tmp_path / "nothing"])


def test_budgets_and_curves_are_means_of_the_seeds_of_trained_rows(
    study: Path, tmp_path: Path
) -> None:
    shutil.copytree(study, copy := tmp_path / "copy")
    store = ResultStore(copy)
    for seed in range(3):
        curve = f"steps,change_pct\n1000,{-1.0 - seed}\n4000,{-3.0 - seed}\n".encode()
        trainings = {"training": {"steps": 4000, "gradient_steps": 80 + 10 * seed, "updates": 9}}
        store.keep(
            done_job("ippo", seed, frames_of_row("ippo", seed), spec=ROWS["ippo"],
                     files={"validation.csv": curve}, metrics={"trainings": trainings})
        )  # fmt: skip
    (suite,) = read_suites([copy])
    board = leaderboard(suite.cases["two-sites"])
    standing = by_row(board.standings)
    columns = ("steps", "gradient_steps", "training_core_s")
    assert [standing["ippo"][x] for x in columns] == [4000.0, 90.0, 30.0]
    assert np.isnan(standing["g36"]["steps"])
    assert board.curves["change_pct"].tolist() == [-2.0, -4.0]
    assert board.curves["core_s"].tolist() == [7.5, 30.0]
    assert (board.curves["change_pct_low"] < board.curves["change_pct"]).all()
