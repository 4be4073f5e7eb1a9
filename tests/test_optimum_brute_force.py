"""The bound against all sequences of discrete actions over a few steps, run by the simulator."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest

from sdc_taichi import Actions, Simulator, load_config
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall.protection import Mask
from sdc_taichi.optimum import Objective, solve
from sdc_taichi.optimum.objective import Score
from sdc_taichi.optimum.problem import Ends
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.types import F64

STEPS = 3
SUMMER_NOON = 195 * 96 + 48
ACTIONS = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
"""Discrete commands of load, cooling and battery in a step, (27, 3); the middle row is idle."""
ROUNDING = 1e-6


@dataclass(frozen=True)
class Scenario:
    """A small data center, what is minimised, and when."""

    overrides: tuple[str, ...]
    objective: str = "carbon"
    start: int = SUMMER_NOON
    inlet_limit_c: float | None = None

    @property
    def config(self) -> DataCenterConfig:
        # Short deadlines and queues make few steps enough to reach them.
        common = ("workload.age_horizon_h=1", "workload.deadline_h=0.5")
        return load_config("tiny", [*common, *self.overrides])


SCENARIOS = {
    "carbon": Scenario(("site.location=CA", "battery.initial_soc=0.2")),
    "bill of two months": Scenario(
        (
            "battery.initial_soc=0.3",
            "battery.hours_of_design_load=0.5",
            "workload.flexible_share=0.5",
            "tariff.demand_charge_per_kw=1000",
        ),
        objective="cost",
        start=31 * 96 - 2,
    ),
    "released models": Scenario(
        (
            "site.location=AZ",
            "workload.model=tasks",
            "workload.max_utilisation=0.9",
            "battery.model=released",
            "battery.initial_soc=0.4",
            "hvac.setpoint.model=accelerating",
            "hvac.setpoint.max_c=21.6",
            "hvac.setpoint.min_c=15",
        ),
    ),
    "discharge limited by the load": Scenario(
        (
            "site.location=TX",
            "battery.model=paper",
            "battery.initial_soc=0.06",
            "battery.hours_of_design_load=4",
            "battery.discharge_limit_c_rate=3",
        ),
        objective="energy",
        start=9 * 96 + 12,
    ),
    "full queue": Scenario(
        (
            "site.location=WA",
            "workload.flexible_share=0.8",
            "workload.queue_limit_h=0.15",
            "workload.max_utilisation=0.8",
            "workload.trace=alibaba_1",
        ),
    ),
    "inlet limit": Scenario(
        ("site.location=GA", "hvac.setpoint.initial_c=20", "battery.initial_soc=0.2"),
        objective="carbon+0.01*water",
        inlet_limit_c=25.2,
    ),
}  # fmt: skip


FIELDS = ("figure", "start_kwh", "end_kwh", "start_tasks", "end_tasks", "dropped_tasks",
          "most_overdue_tasks", "hottest_inlet_c")  # fmt: skip
Scores = dict[str, F64]
"""Values of ``Score`` by name, for each of N sequences, (N,)."""


def run_all(scenario: Scenario) -> Scores:
    """Scores of all 27**STEPS sequences; those that begin with one action are one batch."""
    size = len(ACTIONS) ** (STEPS - 1)
    later = np.unravel_index(np.arange(size), (len(ACTIONS),) * (STEPS - 1))
    scores = []
    with Simulator(build_fleet([scenario.config] * size), precision="f64") as sim:
        for first in range(len(ACTIONS)):
            sim.reset(start=np.full(size, scenario.start))
            score = Score(Objective.parse(scenario.objective), sim)
            for which in (np.full(size, first), *later):
                load, cooling, battery = ACTIONS[which].T
                score.add(sim.step(Actions(load=load, cooling=cooling, battery=battery)))
            scores.append(score)
    return {name: np.concatenate([getattr(score, name) for score in scores]) for name in FIELDS}


def keeps_constraints(scores: Scores, scenario: Scenario) -> Mask:
    """Whether each sequence keeps the constraints of work and inlets, (N,)."""
    idle = len(scores["figure"]) // 2
    keeps = np.ones(len(scores["figure"]), dtype=bool)
    for name in ("dropped_tasks", "most_overdue_tasks"):
        keeps &= scores[name] <= scores[name][idle] + ROUNDING
    if scenario.inlet_limit_c is not None:
        keeps &= scores["hottest_inlet_c"] <= scenario.inlet_limit_c + ROUNDING
    return keeps


@pytest.mark.parametrize("name", SCENARIOS)
def test_no_sequence_comes_below_the_bound(name: str) -> None:
    scenario = SCENARIOS[name]
    scores = run_all(scenario)
    optimum = solve(
        scenario.config,
        steps=STEPS,
        start=[scenario.start],
        objective=scenario.objective,
        inlet_limit_c=scenario.inlet_limit_c,
        precision="f64",
        cache=False,
    )
    keeps = keeps_constraints(scores, scenario)
    cyclic = keeps & (scores["end_kwh"] >= scores["start_kwh"] - ROUNDING)
    cyclic &= scores["end_tasks"] <= scores["start_tasks"] + ROUNDING
    assert keeps.sum() > cyclic.sum() > 1
    least = scores["figure"][cyclic].min()
    assert optimum.bound[0] <= least
    # Continuous actions reach what discrete ones do.
    assert optimum.achieved[0] <= least * (1.0 + 1e-9)
    assert optimum.bound[0] >= least - 0.02 * optimum.idle[0]
    free = optimum.bound_of_ends(0, Ends(float(scores["start_kwh"][0]), 0.0, 0.0, np.inf))
    assert free <= scores["figure"][keeps].min() * (1.0 + 1e-6)
