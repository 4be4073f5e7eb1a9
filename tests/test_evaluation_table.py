"""Tables of an evaluation, of made-up rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest

from sdc_taichi.learning.evaluation import METRICS, Evaluation
from sdc_taichi.learning.evaluation_table import (
    by_agent,
    by_site,
    differences,
    markdown,
    summary,
)
from sdc_taichi.optimum.objective import Objective

IDLE = np.array([100.0, 200.0, 300.0, 400.0])
ACHIEVED = 0.9 * IDLE


def rows(
    name: str, shares: list[float], training: int | None = None, moves: str = "all"
) -> pd.DataFrame:
    """Rows of a controller that saves given shares of the figure of idle commands."""
    valued = IDLE * (1.0 - np.array(shares))
    made = {
        "controller": name,
        "training": training,
        "moves": moves,
        "site": ["ny", "ny", "ca", "ca"],
        "year": 10,
        "week": [3, 7, 3, 7],
        "figure": valued + 5.0,
        "valued_figure": valued,
        "idle_figure": IDLE,
        "achieved_figure": ACHIEVED,
        "share": np.array(shares) / 0.1,
        "broken": ["" if share < 0.08 else "drops 3 tasks" for share in shares],
    }
    return pd.DataFrame(made | {m: 2.0 * valued for m in METRICS} | {"arrived_tasks": 1000.0})


@pytest.fixture(scope="module")
def found() -> Evaluation:
    every = [
        rows("idle", [0.0] * 4),
        rows("ippo", [0.05, 0.05, 0.05, 0.09], 0),
        rows("ippo", [0.05, 0.05, 0.05, 0.01], 1),
        rows("ippo", [0.02] * 4, 0, "battery"),
        rows("ippo", [0.02] * 4, 1, "battery"),
        rows("g36", [0.02, 0.02, 0.02, 0.02]),
    ]
    return Evaluation(
        rows=pd.concat(every, ignore_index=True),
        objective=Objective(carbon=1.0),
        alone={"load": 0.99 * IDLE, "battery": 0.96 * IDLE},
        uncoordinated={},
        strata=np.array([[0, 0], [0, 0], [1, 0], [1, 0]]),
        missing=(),
    )


def by(table: pd.DataFrame, column: str) -> dict[str, dict[str, Any]]:
    """Rows by what stands in a column."""
    return {
        str(row[column]): {str(k): v for k, v in row.items()} for row in table.to_dict("records")
    }


def test_summary_puts_trainings_together(found: Evaluation) -> None:
    table = by(summary(found), "controller")
    assert list(table) == ["idle", "ippo", "g36"]
    ippo = table["ippo"]
    assert ippo["trainings"] == 2
    assert ippo["change_pct"] == pytest.approx(-5.0)
    assert ippo["share_pct"] == pytest.approx(50.0)
    assert ippo["interquartile_mean_pct"] == pytest.approx(-5.0)
    assert ippo["change_pct_low"] < -5.0 < ippo["change_pct_high"]
    assert ippo["carbon_pct"] == pytest.approx(-5.0)
    assert ippo["broken_pct"] == 100 / 8
    g36 = table["g36"]
    assert g36["change_pct"] == pytest.approx(-2.0)
    assert g36["change_pct_high"] - g36["change_pct_low"] == pytest.approx(0.0, abs=1e-9)
    assert table["idle"]["dropped_pct"] == pytest.approx(100 * 2 * IDLE.sum() / 4000)


def test_sites_and_agents_have_figures_of_their_own(found: Evaluation) -> None:
    sites = by(by_site(found), "controller")
    assert sites["ippo"]["ny"] == pytest.approx(-5.0)
    assert sites["g36"]["ca"] == pytest.approx(-2.0)
    (agent,) = by_agent(found).to_dict("records")
    assert (agent["moves"], agent["controller"]) == ("battery", "ippo")
    assert agent["alone_pct"] == pytest.approx(-4.0)
    assert agent["change_pct"] == pytest.approx(-2.0)
    assert agent["share_pct"] == pytest.approx(50.0)


def test_differences_are_paired(found: Evaluation) -> None:
    table = by(differences(found, "ippo"), "than")
    assert table["g36"]["points"] == pytest.approx(-3.0)
    assert table["g36"]["probability"] == 7 / 8
    assert table["idle"]["probability"] == 1.0
    assert table["g36"]["points_low"] < -3.0 < table["g36"]["points_high"]


def test_of_a_bound_its_figure_alone_is_known(found: Evaluation) -> None:
    is_bound = found.rows["controller"] == "g36"
    rows = found.rows.assign(cfp_kg=found.rows["cfp_kg"].mask(is_bound))
    table = summary(Evaluation(rows, found.objective, {}, {}, found.strata, ()))
    assert table["broken_pct"].isna().tolist() == [name == "g36" for name in table["controller"]]


def test_without_an_optimum_figures_are_compared_as_they_are(found: Evaluation) -> None:
    without = found.rows.assign(valued_figure=np.nan, achieved_figure=np.nan, broken=None)
    table = summary(Evaluation(without, found.objective, {}, {}, found.strata, ()))
    assert table["change_pct"].tolist() == pytest.approx([2.0, -3.0, 0.0])
    assert table["share_pct"].isna().all()
    assert table["broken_pct"].isna().all()
    assert "| - |" in markdown(table)
