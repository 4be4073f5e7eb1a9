"""Sequences of discrete actions over a day: what they keep, and what a simulator makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sdc_taichi import Actions, Simulator, load_config
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.optimum.discrete import DiscretePlans, discrete_plans
from sdc_taichi.optimum.discrete_run import run_discrete
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS, Problem
from sdc_taichi.optimum.problems import problems_of
from sdc_taichi.optimum.score import Score
from sdc_taichi.optimum.tables import facility_tables
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.types import F64

DAY = 96
CARBON = Objective(carbon=1.0)
CONFIG = load_config("tiny", ["site.location=CA"])


def problems(*configs: DataCenterConfig) -> tuple[Fleet, Drivers, list[Problem], F64]:
    """Fleet, inputs, planning problems of a day, and demand, (B, T)."""
    fleet = build_fleet(configs)
    with Simulator(fleet, precision="f64") as sim:
        drivers, start = sim.drivers, sim.drivers.start
        tables = facility_tables(fleet, drivers, start=start, steps=DAY, precision="f64")
        found = problems_of(fleet, drivers, sim.sizing, tables, start=start, objective=CARBON)
        return fleet, drivers, found, drivers.demand.at(start[:, None] + np.arange(DAY))


@pytest.fixture(scope="module")
def day() -> tuple[Problem, F64]:
    _, _, (problem,), demand = problems(CONFIG)
    return problem, demand[0]


def scored(plans: DiscretePlans) -> Score:
    size, steps = plans.load.shape
    with Simulator(build_fleet([CONFIG] * size), precision="f64") as sim:
        sim.reset()
        score = Score(CARBON, sim)
        for t in range(steps):
            commands = (plans.load[:, t], plans.cooling[:, t], plans.battery[:, t])
            score.add(sim.step(Actions(*commands)))
        return score


def test_a_day_is_cheaper_and_ends_as_it_began(day: tuple[Problem, F64]) -> None:
    problem, demand = day
    plans = discrete_plans(problem, CONFIG, demand, beam=60, plans=3)
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
    (only,) = (a for a in AGENTS if a == agent)
    plans = discrete_plans(replace(problem, agents=(only,)), CONFIG, demand, beam=30, plans=1)
    acts = {name: bool(np.any(getattr(plans, name))) for name in AGENTS}
    assert acts == {name: name == agent for name in AGENTS}
    all_three = discrete_plans(problem, CONFIG, demand, beam=60, plans=1)
    assert all_three.figure[0] < plans.figure[0]


def test_a_warm_up_that_is_not_scored_may_fill_the_battery(day: tuple[Problem, F64]) -> None:
    problem, demand = day
    warm_up = 24
    weight = np.where(np.arange(DAY) < warm_up, 0.0, problem.kwh_weight)
    warmed = replace(problem, kwh_weight=weight, scored_from=warm_up, agents=AGENTS[2:])
    plans = discrete_plans(warmed, CONFIG, demand, beam=60, plans=1)
    # A beam of one holds what commands of 0 lead to.
    idle = discrete_plans(warmed, CONFIG, demand, beam=1, plans=1)
    assert plans.figure[0] < 0.97 * idle.figure[0]


def test_each_data_center_of_a_batch_gets_the_best_of_its_own_sequences() -> None:
    other = load_config("tiny", ["name=other", "site.location=AZ", "battery.initial_soc=0.5"])
    fleet, drivers, both, demand = problems(CONFIG, other)
    plans = [
        discrete_plans(problem, config, row, beam=40, plans=count)
        for problem, config, row, count in zip(both, fleet.configs, demand, (3, 5), strict=True)
    ]
    # Worst first, so that the order of the plans does not decide.
    plans = [
        DiscretePlans(x.load[::-1], x.cooling[::-1], x.battery[::-1], x.figure[::-1], False)
        for x in plans
    ]
    found = run_discrete(
        fleet,
        drivers,
        plans,
        agents=AGENTS,
        start=drivers.start,
        objective=CARBON,
        precision="f64",
    )
    assert found is not None
    assert found[0] == scored(plans[0]).figure.min()
    for figure, of in zip(found, plans, strict=True):
        assert figure == pytest.approx(of.figure.min(), rel=2e-4)


def test_without_a_sequence_there_is_no_figure(day: tuple[Problem, F64]) -> None:
    fleet, drivers, _, _ = problems(CONFIG)
    nothing = np.empty((0, DAY))
    none = DiscretePlans(nothing, nothing, nothing, np.empty(0), False)
    found = run_discrete(
        fleet, drivers, [none], agents=AGENTS, start=drivers.start, objective=CARBON
    )
    assert found is not None
    assert np.isnan(found[0])
    stopped = run_discrete(
        fleet,
        drivers,
        [none],
        agents=AGENTS,
        start=drivers.start,
        objective=CARBON,
        stop=lambda: True,
    )
    assert stopped is None


def test_sequences_that_take_from_the_store_do_not_count() -> None:
    fleet = build_fleet([load_config("tiny", ["battery.initial_soc=0.5"])])
    with Simulator(fleet) as sim:
        drivers = sim.drivers

    def least(battery: F64) -> float:
        still = np.zeros((len(battery), 8))
        plans = DiscretePlans(still, still, battery, np.zeros(len(battery)), False)
        found = run_discrete(
            fleet, drivers, [plans], agents=AGENTS, start=drivers.start, objective=CARBON
        )
        assert found is not None
        return float(found[0])

    empties, rests = np.full((1, 8), -1.0), np.zeros((1, 8))
    assert np.isnan(least(empties))
    assert least(np.concatenate([empties, rests])) == least(rests)
