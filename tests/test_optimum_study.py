"""The study of known optima prints tables that add up, and draws a day."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from known_optimum import made_up_optimum
from sdc_taichi import Simulator
from sdc_taichi.optimum.result import Optimum

pytestmark = pytest.mark.repo

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.fixture
def solved() -> list[Optimum]:
    """Optima that the study asked for, in order."""
    return []


@pytest.fixture
def study(solved: list[Optimum], monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    def solve(
        configs: Any, *, steps: int, drivers: Any = None, objective: str = "carbon", **_: Any
    ) -> Optimum:
        with Simulator(configs, drivers=drivers) as sim:
            solved.append(made_up_optimum(sim, steps, objective))
        return solved[-1]

    monkeypatch.syspath_prepend(str(EXAMPLES))
    module = importlib.import_module("optimum_study")
    monkeypatch.setattr(module, "solve", solve)
    return module


def cells(table: str) -> dict[str, list[str]]:
    rows = [line.strip("|").split("|") for line in table.splitlines() if line.startswith("| ")]
    return {row[0].strip(): [cell.strip() for cell in row[1:]] for row in rows}


def test_seasons_have_a_row_for_each_site_and_a_sum(
    study: ModuleType, solved: list[Optimum]
) -> None:
    rows = cells(study.season_table(("CA", "NY"), 1))
    assert list(rows)[1:] == ["CA", "NY", "all"]
    (found,) = solved
    change = 100 * (found.achieved / found.idle - 1)
    bound = 100 * (found.bound / found.idle - 1)
    shown = [f"{a:.2f} ({b:.2f})" for a, b in zip(change, bound, strict=True)]
    assert [*rows["CA"][:4], *rows["NY"][:4]] == shown
    total = 100 * (found.achieved.sum() / found.idle.sum() - 1)
    assert rows["all"][-1].startswith(f"{total:.2f} (")


def test_weeks_have_controllers_agents_optimum_and_bound(
    study: ModuleType, solved: list[Optimum]
) -> None:
    case = study.Case("the bill", "cost", (), ("CA", "NY"), (3, 15), ("idle", "g36"))
    rows = cells(study.week_table(case, 1))
    names = ["idle", "g36", "optimum, cooling alone", "optimum", "bound"]
    assert list(rows)[1:] == names
    assert rows["idle"][:3] == ["0.00"] * 3
    assert rows["idle"][4] == "0"
    (found,) = solved
    assert str(found.objective) == "cost"
    by_site = (found.achieved.reshape(2, 2).sum(axis=1) / found.idle.reshape(2, 2).sum(axis=1)) - 1
    assert rows["optimum"][1:3] == [f"{100 * x:.2f}" for x in by_site]
    assert float(rows["bound"][0]) < float(rows["optimum"][0])


def test_picture_of_a_day(study: ModuleType, tmp_path: Path) -> None:
    from PIL import Image

    path = tmp_path / "day.png"
    study.day_picture(path, "CA", 1, {"idle": "idle", "rule": "g36"})
    with Image.open(path) as picture:
        assert picture.size == (1100, 900)
        assert len(np.unique(np.asarray(picture.convert("L")))) > 50
