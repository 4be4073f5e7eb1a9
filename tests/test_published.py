"""Published results of suites are reached again, and new ones are published as they should be."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from made_studies import ROWS, done_job, frames_of_row, write_study
from published import (
    FIGURES,
    FOLDER,
    SUITES,
    WAITING,
    cells,
    described,
    suite_of,
    tolerance,
)
from sdc_taichi import make_controller
from sdc_taichi.benchmark.cases import data_centers
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.suite import Case, Row
from sdc_taichi.learning.evaluation import Contender, evaluate, prepare

pytestmark = pytest.mark.repo

ROOT = Path(__file__).parent.parent
SHARES = "small"
"""Suite whose shares of the achievable are computed again, which needs an optimum."""


@pytest.mark.parametrize("suite", SUITES)
def test_suites_are_still_those_that_were_published(suite: str) -> None:
    if suite in WAITING:
        pytest.skip(f"suite {suite} waits to be published again: it may be defined anew")
    published, now = described(suite), suite_of(suite)
    assert str(now.objective) == published["objective"]
    # Fields that were added since have their defaults, and those that were removed had none.
    case = now.cases[published["case"]].model_copy(update={"about": ""})
    assert case == Case.model_validate(published["case_settings"])
    leave_out = {"about": "", "seeds": None, "cases": None}
    for name, values in published["row_settings"].items():
        row = Row.model_validate({key: value for key, value in values.items() if value})
        assert now.rows[name].model_copy(update=leave_out) == row


@pytest.mark.parametrize("suite", SUITES)
def test_cells_are_reached_again(suite: str) -> None:
    if suite in WAITING:
        pytest.skip(f"suite {suite} waits to be published again: its models have changed")
    published, cell_of = described(suite), cells(suite)
    case = suite_of(suite).cases[published["case"]]
    site, week = cell_of["idle"]["site"], cell_of["idle"]["week"]
    configs = [x for x in data_centers(case, "held-out") if x.name == site]
    solved = suite == SHARES
    with prepare(
        configs,
        [week],
        years=[int(year)] if (year := cell_of["idle"].get("year")) else (),
        objective=published["objective"],
        optimum=solved,
        days=case.days,
        cache=False,
    ) as weeks:
        contenders = []
        for name, cell in cell_of.items():
            spec = cell["controller"].replace("policy:", f"policy:{FOLDER / suite}/")
            contenders.append(Contender(f"row {name}", make_controller(spec, weeks.sim.fleet)))
        rows = evaluate(weeks, contenders, beside=False).rows
    assert len(rows) == len(cell_of) > 1
    for (name, cell), reached in zip(cell_of.items(), rows.to_dict("records"), strict=True):
        limit = tolerance(name, published)
        for figure in FIGURES:
            assert reached[figure] == pytest.approx(cell[figure], rel=limit), (name, figure)
        if solved:
            assert reached["share"] == pytest.approx(cell["share"], abs=100 * limit), name


# --- Publishing -----------------------------------------------------------------------------------


@pytest.fixture
def publisher(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "docs" / "make")
    return importlib.import_module("benchmark")


@pytest.fixture
def docs(tmp_path: Path) -> Path:
    folder = tmp_path / "docs"
    folder.mkdir()
    (folder / "benchmark.md").write_text(
        "# Results\nFound: nothing.\n<!-- made-up -->\nold\n<!-- end -->\nNo more.\n"
    )
    return folder


def test_tables_pictures_and_cells_of_a_suite(
    publisher: ModuleType, docs: Path, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    study, out = write_study(tmp_path / "made-up"), tmp_path / "cells"
    store = ResultStore(study)
    curve = b"steps,change_pct\n1000,-1.0\n2000,-2.0\n"
    files = {"best/policy.json": b"{}", "validation.csv": curve}
    store.keep(done_job("ippo", 0, frames_of_row("ippo", 0), spec=ROWS["ippo"], files=files))
    publisher.publish([study], docs, out)
    page = (docs / "benchmark.md").read_text("utf-8")
    assert page.startswith("# Results\nFound")
    assert "Found: nothing.\n<!-- made-up -->\n" in page
    assert page.endswith("<!-- end -->\nNo more.\n")
    assert "\nold\n" not in page
    assert "computed with `sdc-taichi benchmark made-up`." in page
    assert "| 1 | mpc-24h | -8.97 |" in page
    assert "[standings](benchmark/made-up-standings.csv)" in page
    board = pd.read_csv(docs / "benchmark" / "made-up-standings.csv")
    assert board["change_pct"][0] == pytest.approx(-8.97, abs=0.005)
    assert "(img/benchmark-made-up.webp)" in page
    assert (docs / "img" / "benchmark-made-up.webp").read_bytes()[8:12] == b"WEBP"
    assert (docs / "img" / "benchmark-made-up-curves.webp").read_bytes()[8:12] == b"WEBP"
    curves = pd.read_csv(docs / "benchmark" / "made-up-curves.csv")
    assert curves["core_s"].tolist() == [15.0, 30.0]
    assert curves["change_pct"].tolist() == [-1.0, -2.0]
    lines = (out / "made-up" / "cells.csv").read_text("utf-8").splitlines()
    assert [line.split(",")[:4] for line in lines[1:]] == [
        ["idle", "idle", "ca", "3"],
        ["ippo", "policy:ippo", "ca", "3"],
    ]
    assert [path.name for path in (out / "made-up" / "ippo").iterdir()] == ["policy.json"]
