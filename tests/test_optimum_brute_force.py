"""The discrete optimum of a few steps against all sequences of discrete actions there are."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sdc_taichi.optimum.discrete import discrete_plans

pytestmark = pytest.mark.repo

EXAMPLES = Path(__file__).parent.parent / "examples"
STEPS = {"released models": 4}
"""Steps of scenarios that need more than three to show what they are for."""


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
