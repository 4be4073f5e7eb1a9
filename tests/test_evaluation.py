"""Controllers evaluated in weeks of the year, beside idle commands and an optimum."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from known_optimum import KWH_VALUE, made_up_solve
from sdc_taichi import ConfigError, load_config, make_configs, make_controller
from sdc_taichi.control import Controller
from sdc_taichi.learning import evaluation
from sdc_taichi.learning.evaluation import (
    ALL,
    Contender,
    DataCenterWeeks,
    Evaluation,
    evaluate,
    prepare,
    validate,
)
from sdc_taichi.optimum.result import Optimum, with_tabled_ends
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim.workload import queue_limit_tasks

RULES = "load=greedy-ci,cooling=g36,battery=greedy-ci"
CONFIGS = make_configs(load_config("tiny"), sites=["ny", "ca"])


@pytest.fixture(scope="module")
def weeks() -> Iterator[DataCenterWeeks]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "solve", made_up_solve)
        with prepare(CONFIGS, (27, 31), days=2) as made:
            yield made


def named(weeks: DataCenterWeeks, spec: str) -> Controller:
    return make_controller(spec, weeks.sim.fleet)


@pytest.fixture(scope="module")
def found(weeks: DataCenterWeeks) -> Evaluation:
    rules = Contender("rules", named(weeks, RULES), seed=7, agents=("battery",))
    return evaluate(weeks, [Contender("g36", named(weeks, "g36")), rules])


def test_rows_are_of_each_controller_agent_and_week(found: Evaluation) -> None:
    rows = found.rows
    assert rows["week"].tolist() == [27, 31, 27, 31] * 5
    assert rows["site"].tolist() == ["ny", "ny", "ca", "ca"] * 5
    assert rows["controller"].drop_duplicates().tolist() == ["idle", "g36", "rules", "optimum"]
    own = rows[rows["controller"] == "rules"]
    assert own["moves"].tolist() == [ALL] * 4 + ["battery"] * 4
    assert own["training"].tolist() == [7] * 8
    assert rows[rows["controller"] == "g36"]["training"].isna().all()
    assert found.missing == ()
    assert found.strata[:, 0].tolist() == [1, 1, 0, 0]


def test_shares_are_zero_for_idle_commands_and_one_for_the_optimum(
    found: Evaluation, weeks: DataCenterWeeks
) -> None:
    assert weeks.optimum is not None
    of = found.rows.groupby("controller", sort=False)
    idle, best = of.get_group("idle"), of.get_group("optimum")
    assert idle["share"].tolist() == [0.0] * 4
    assert idle["figure"].tolist() == idle["idle_figure"].tolist() == weeks.idle.tolist()
    assert best["figure"].tolist() == weeks.optimum.achieved.tolist()
    np.testing.assert_allclose(best["cfp_kg"], best["figure"], rtol=1e-12)


def test_only_steps_after_the_first_day_are_scored(
    found: Evaluation, weeks: DataCenterWeeks
) -> None:
    whole, scored = np.zeros(4), np.zeros(4)

    def add(result: Any) -> None:
        nonlocal whole, scored
        whole = whole + result.water_l
        if result.step >= 96:
            scored = scored + result.water_l

    simulate(weeks.sim, named(weeks, "g36"), 192, on_step=add)
    own = found.rows[found.rows["controller"] == "g36"]
    np.testing.assert_allclose(own["water_l"], scored, rtol=1e-12)
    assert np.all(scored < whole)


def test_ends_are_valued(found: Evaluation, weeks: DataCenterWeeks) -> None:
    stored = []
    simulate(weeks.sim, named(weeks, "battery=greedy-ci"), 192,
             on_step=lambda result: stored.append(result.stored_kwh.copy()))  # fmt: skip
    gained = stored[-1] - stored[95]
    assert np.abs(gained).max() > 0.1
    own = found.rows[(found.rows["controller"] == "rules") & (found.rows["moves"] == "battery")]
    taken = own["figure"] - own["valued_figure"]
    np.testing.assert_allclose(taken, KWH_VALUE * gained, rtol=1e-6, atol=1e-9)


def test_validation_is_the_evaluation_of_all_weeks_together(
    found: Evaluation, weeks: DataCenterWeeks
) -> None:
    own = found.rows[(found.rows["controller"] == "rules") & (found.rows["moves"] == ALL)]
    quick = validate(named(weeks, RULES), weeks)
    idle, best = own["idle_figure"].sum(), own["achieved_figure"].sum()
    assert quick.share == pytest.approx((idle - own["valued_figure"].sum()) / (idle - best))
    assert quick.change_pct == pytest.approx(100 * (own["valued_figure"].sum() / idle - 1))
    assert quick.broken_weeks == (own["broken"] != "").sum()


def test_without_an_optimum_figures_are_as_they_are(found: Evaluation) -> None:
    with prepare(CONFIGS, (27, 31), days=2, optimum=False) as weeks:
        np.testing.assert_allclose(weeks.idle, found.rows["idle_figure"][:4], rtol=1e-12)
        g36 = named(weeks, "g36")
        quick = validate(g36, weeks)
        assert np.isnan(quick.share)
        own = evaluate(weeks, [Contender("g36", g36)])
        rows = own.rows[own.rows["controller"] == "g36"]
        assert quick.change_pct == pytest.approx(
            100 * (rows["figure"].sum() / weeks.idle.sum() - 1)
        )
        assert rows["share"].isna().all()
        assert own.alone == {}


def test_an_interruption_keeps_whole_runs(weeks: DataCenterWeeks) -> None:
    asked = 0

    def stop() -> bool:
        nonlocal asked
        asked += 1
        return asked > 250

    g36 = Contender("g36", named(weeks, "g36"))
    found = evaluate(weeks, [g36], stop=stop)
    assert found.rows["controller"].drop_duplicates().tolist() == ["idle"]
    assert found.missing == ("g36", "optimum")


def test_what_cannot_be_evaluated_is_named(weeks: DataCenterWeeks) -> None:
    g36 = Contender("g36", named(weeks, "g36"), seed=1)
    with pytest.raises(ConfigError, match="g36 of seed 1 is given twice"):
        evaluate(weeks, [g36, g36])
    with pytest.raises(ConfigError, match="'agent_bat' of g36: valid are load, cooling, battery"):
        evaluate(weeks, [Contender("g36", g36.controller, agents=("agent_bat",))])
    for name in ("idle", "optimum"):
        with pytest.raises(ConfigError, match=f"{name} names other rows"):
            evaluate(weeks, [Contender(name, g36.controller, seed=1)])
    with pytest.raises(ConfigError, match="no weeks"):
        prepare(CONFIGS, ())
    with pytest.raises(ConfigError, match="no data centers"):
        prepare([], (3,))
    with pytest.raises(ConfigError, match=r"days.* 1"):
        prepare(CONFIGS, (3,), days=1)


def test_tabled_ends_are_near_the_bounds() -> None:
    texas = make_configs(load_config("corrected"), sites=["tx"])
    with prepare(texas, (27,), days=2, exact_ends=True, cache=False) as weeks:
        best = weeks.optimum
        assert isinstance(best, Optimum)
        table = with_tabled_ends(best, weeks.sim)
        kwh = 0.98 * weeks.sim.sizing.battery_kwh
        tasks = 0.85 * queue_limit_tasks(weeks.sim.fleet)
        for shares in np.random.default_rng(0).random((4, 4)):
            ends = shares[0] * kwh, shares[1] * tasks, shares[2] * kwh, shares[3] * tasks
            error = table.end_value(*ends) - best.end_value(*ends)
            assert abs(error / (best.idle - best.achieved)) < 0.02
