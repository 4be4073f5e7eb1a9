"""The discrete optimum of a few steps against all sequences of discrete actions there are."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sdc_taichi import Actions, Simulator, load_config
from sdc_taichi.optimum.discrete import DiscretePlans, discrete_plans
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS, Problem
from sdc_taichi.optimum.problems import problems_of
from sdc_taichi.optimum.score import Score
from sdc_taichi.optimum.tables import facility_tables
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.types import F64

pytestmark = pytest.mark.repo

EXAMPLES = Path(__file__).parent.parent / "examples"
STEPS = {"released models": 4}
"""Steps of scenarios that need more than three to show what they are for."""
DAY = 96


@pytest.fixture(scope="module")
def study() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(EXAMPLES)
        yield importlib.import_module("optimum_brute_force")


@pytest.mark.parametrize(
    "name",
    [
        "carbon",
        "bill of two months",
        "released models",
        "discharge limited by the load",
        "full queue",
        "inlet limit",
    ],
)
def test_no_sequence_is_better_than_the_one_found(study: Any, name: str) -> None:
    assert len(study.SCENARIOS) == 6
    scenario, steps = study.SCENARIOS[name], STEPS.get(name, 3)
    outcomes = study.all_outcomes(scenario, steps)
    assert len(outcomes.figure) == 27**steps
    problem, demand = study.problem_at(scenario, steps, outcomes)
    for ends in (None, study.FREE):
        kept = study.permitted(outcomes, scenario, ends, problem.storage.stored_kwh)
        plans = discrete_plans(problem, scenario.config, demand, ends=ends, beam=27**3)
        assert plans.is_complete
        least = outcomes.figure[kept].min()
        assert plans.figure[0] == pytest.approx(least, rel=1e-9)
        reached = study.figures(scenario, plans)
        assert reached[0] == pytest.approx(least, rel=1e-9)
        assert np.all(np.diff(plans.figure) >= 0.0)


def test_scenarios_meet_what_they_are_named_for(study: Any) -> None:
    full = study.all_outcomes(study.SCENARIOS["full queue"], 2)
    assert full.dropped_tasks.max() > 1.0
    scenario = study.SCENARIOS["inlet limit"]
    hot = study.all_outcomes(scenario, 2)
    assert hot.hottest_inlet_c.min() < scenario.inlet_limit_c < hot.hottest_inlet_c.max()


@pytest.fixture(scope="module")
def day() -> tuple[Problem, F64]:
    fleet = build_fleet([load_config("tiny", ["site.location=CA"])])
    with Simulator(fleet, precision="f64") as sim:
        drivers, start = sim.drivers, sim.drivers.start
        tables = facility_tables(fleet, drivers, start=start, steps=DAY, precision="f64")
        objective = Objective(carbon=1.0)
        (problem,) = problems_of(
            fleet, drivers, sim.sizing, tables, start=start, objective=objective
        )
        return problem, drivers.demand.at(start[:, None] + np.arange(DAY))[0]


def scored(plans: DiscretePlans) -> Score:
    size, steps = plans.load.shape
    config = load_config("tiny", ["site.location=CA"])
    with Simulator(build_fleet([config] * size), precision="f64") as sim:
        sim.reset()
        score = Score(Objective(carbon=1.0), sim)
        for t in range(steps):
            commands = (plans.load[:, t], plans.cooling[:, t], plans.battery[:, t])
            score.add(sim.step(Actions(*commands)))
        return score


def test_a_day_is_cheaper_and_ends_as_it_began(day: tuple[Problem, F64]) -> None:
    problem, demand = day
    config = load_config("tiny", ["site.location=CA"])
    plans = discrete_plans(problem, config, demand, beam=60, plans=3)
    assert len(plans.figure) == 3
    assert not plans.is_complete
    for commands in (plans.load, plans.cooling, plans.battery):
        assert set(np.unique(commands)) <= {-1.0, 0.0, 1.0}
    score = scored(plans)
    np.testing.assert_allclose(score.figure, plans.figure, rtol=2e-4)
    still = np.zeros((1, DAY))
    idle = scored(DiscretePlans(still, still, still, np.zeros(1), True)).figure[0]
    assert plans.figure[0] < 0.97 * idle
    assert np.all(score.end_kwh >= score.start_kwh - 1e-9)
    assert np.all(score.end_tasks <= score.start_tasks + 1e-6)
    assert np.all(score.dropped_tasks == 0.0)
    assert np.all(score.most_overdue_tasks == 0.0)


@pytest.mark.parametrize("agent", AGENTS)
def test_agents_that_do_not_act_give_no_command(day: tuple[Problem, F64], agent: str) -> None:
    problem, demand = day
    config = load_config("tiny", ["site.location=CA"])
    (only,) = (a for a in AGENTS if a == agent)
    plans = discrete_plans(replace(problem, agents=(only,)), config, demand, beam=30, plans=1)
    acts = {name: bool(np.any(getattr(plans, name))) for name in AGENTS}
    assert acts == {name: name == agent for name in AGENTS}
    all_three = discrete_plans(problem, config, demand, beam=60, plans=1)
    assert all_three.figure[0] < plans.figure[0]


def test_a_warm_up_that_is_not_scored_may_fill_the_battery(day: tuple[Problem, F64]) -> None:
    problem, demand = day
    warm_up = 24
    weight = np.where(np.arange(DAY) < warm_up, 0.0, problem.kwh_weight)
    config = load_config("tiny", ["site.location=CA"])
    warmed = replace(problem, kwh_weight=weight, scored_from=warm_up)
    plans = discrete_plans(warmed, config, demand, beam=200, plans=1)
    held = replace(warmed, agents=("load", "cooling"))
    assert plans.figure[0] < discrete_plans(held, config, demand, beam=60, plans=1).figure[0]
