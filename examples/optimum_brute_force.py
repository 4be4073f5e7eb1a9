"""All sequences of discrete actions of a few steps, and the best of them as a search finds it.

    python examples/optimum_brute_force.py [STEPS]

runs, for each scenario, every sequence of discrete actions of a small data center (27 per step,
531,441 of four steps, which is the default), and prints the least figure beside that of
``optimum.discrete``. The two agree to rounding.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from sdc_taichi import Actions, Simulator, load_config
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.optimum.discrete import DiscretePlans, discrete_plans
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS, Agent, Ends, FacilityTable, Problem
from sdc_taichi.optimum.problems import problems_of
from sdc_taichi.optimum.score import Score
from sdc_taichi.optimum.tables import TableGrid, facility_tables
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.steady_facility import SteadyFacility
from sdc_taichi.types import F64

# Short deadlines and queues make few steps enough to meet them.
COMMON = ("workload.age_horizon_h=1", "workload.deadline_h=0.5")
SUMMER_NOON = 195 * 96 + 48
FREE = Ends(start_kwh=0.0, start_tasks=0.0, end_kwh=0.0, end_tasks=np.inf)
ANY_TASKS = 1e-6
ANY_SHARE = 1e-9


@dataclass(frozen=True)
class Scenario:
    """A small data center, what is minimised, and when."""

    overrides: tuple[str, ...]
    objective: str = "carbon"
    start: int = SUMMER_NOON
    inlet_limit_c: float | None = None
    agents: tuple[Agent, ...] = AGENTS

    @property
    def config(self) -> DataCenterConfig:
        """Configuration of the data center."""
        return load_config("tiny", [*COMMON, *self.overrides])


SCENARIOS: dict[str, Scenario] = {
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


@dataclass(frozen=True)
class Outcomes:
    """Figures and constraints of all N sequences of commands that the simulator ran."""

    figure: F64
    end_kwh: F64
    end_tasks: F64
    dropped_tasks: F64
    overdue_tasks: F64
    hottest_inlet_c: F64
    utilisation: F64
    """Utilisations that occur, (I,)."""
    setpoint_c: F64
    """Setpoints that occur, in C, (J,)."""


def all_outcomes(scenario: Scenario, steps: int) -> Outcomes:
    """Run all sequences, those that begin with one joint action in a batch."""
    commands = commands_of(scenario.agents)
    per_step = len(commands)
    batch = per_step ** (steps - 1)
    objective = Objective.parse(scenario.objective)
    later = np.stack(np.unravel_index(np.arange(batch), (per_step,) * (steps - 1)))
    start = np.full(batch, scenario.start)
    parts: list[Sequence[F64]] = []
    utilisation, setpoint_c = np.zeros(0), np.zeros(0)
    with Simulator(build_fleet([scenario.config] * batch), precision="f64") as sim:
        for first in range(per_step):
            sim.reset(start=start)
            score, overdue = Score(objective, sim), np.zeros(batch)
            for t in range(steps):
                which = np.full(batch, first) if t == 0 else later[t - 1]
                load, cooling, battery = commands[which].T
                result = sim.step(Actions(load=load, cooling=cooling, battery=battery))
                score.add(result)
                overdue += result.overdue_tasks
                # Values that differ by rounding make one node of a table.
                utilisation = np.unique(np.append(utilisation, result.utilisation.round(12)))
                setpoint_c = np.unique(np.append(setpoint_c, result.setpoint_c.round(12)))
            parts.append(
                (score.figure, score.end_kwh, score.end_tasks, score.dropped_tasks, overdue,
                 score.hottest_inlet_c)
            )  # fmt: skip
    joined = [np.concatenate(values) for values in zip(*parts, strict=True)]
    figure, end_kwh, end_tasks, dropped, overdue, hottest_c = joined
    return Outcomes(
        figure,
        end_kwh,
        end_tasks,
        dropped,
        overdue,
        hottest_c,
        np.minimum(utilisation, 1.0),
        setpoint_c,
    )


def commands_of(agents: tuple[Agent, ...]) -> F64:
    """Joint discrete commands of load, cooling and battery, (27, 3) where all three act."""
    three = [-1.0, 0.0, 1.0]
    each = [three if agent in agents else [0.0] for agent in AGENTS]
    return np.stack(np.meshgrid(*each, indexing="ij"), axis=-1).reshape(-1, 3)


def permitted(
    outcomes: Outcomes, scenario: Scenario, ends: Ends | None, start_kwh: float
) -> npt.NDArray[np.bool_]:
    """Mask of the sequences that keep all constraints, (N,)."""
    neutral = len(outcomes.figure) // 2
    kept = outcomes.dropped_tasks <= outcomes.dropped_tasks[neutral] + ANY_TASKS
    kept &= outcomes.overdue_tasks <= outcomes.overdue_tasks[neutral] + ANY_TASKS
    if scenario.inlet_limit_c is not None:
        kept &= outcomes.hottest_inlet_c <= scenario.inlet_limit_c + 1e-6
    if ends is None:
        kept &= outcomes.end_kwh >= start_kwh * (1.0 - ANY_SHARE)
        kept &= outcomes.end_tasks <= ANY_TASKS
    return np.asarray(kept)


def problem_at(scenario: Scenario, steps: int, outcomes: Outcomes) -> tuple[Problem, F64]:
    """The planning problem, with a table at just what occurs, and the demand of the steps, (T,)."""
    fleet = build_fleet([scenario.config])
    start = np.array([scenario.start])
    with Simulator(fleet, precision="f64") as sim:
        drivers, sizing = sim.drivers, sim.sizing
        tables = facility_tables(
            fleet, drivers, start=start, steps=steps, grid=TableGrid(3, 50.0), precision="f64"
        )
        (problem,) = problems_of(
            fleet,
            drivers,
            sizing,
            tables,
            start=start,
            objective=Objective.parse(scenario.objective),
            agents=scenario.agents,
            inlet_limit_c=scenario.inlet_limit_c,
        )
    levels, setpoints = outcomes.utilisation, outcomes.setpoint_c
    of = np.zeros(len(levels) * len(setpoints), np.int64)
    facility = SteadyFacility(
        fleet.configs,
        drivers,
        of=of,
        utilisation=np.repeat(levels, len(setpoints)),
        setpoint_c=np.tile(setpoints, len(levels)),
        precision="f64",
    )
    index = scenario.start + np.arange(steps)[None]
    weather = zip(drivers.outdoor_c.at(index)[0], drivers.wet_bulb_c.at(index)[0], strict=True)
    found = [facility.at(np.full(len(of), dry), np.full(len(of), wet)) for dry, wet in weather]
    shape = (steps, len(levels), len(setpoints))
    table = FacilityTable(
        utilisation=levels,
        setpoint_c=setpoints,
        facility_kwh=np.stack([x.facility_kwh for x in found]).reshape(shape),
        water_l=np.stack([x.water_l for x in found]).reshape(shape),
        inlet_max_c=np.broadcast_to(facility.inlet_max_c.reshape(shape[1:]), shape),
        unmet_w=np.stack([x.unmet_w for x in found]).reshape(shape),
    )
    facility.close()
    return replace(problem, table=table), drivers.demand.at(index)[0]


def figures(scenario: Scenario, plans: DiscretePlans) -> F64:
    """Figures of plans as the simulator runs them, (K,)."""
    size, steps = plans.load.shape
    with Simulator(build_fleet([scenario.config] * size), precision="f64") as sim:
        sim.reset(start=np.full(size, scenario.start))
        score = Score(Objective.parse(scenario.objective), sim)
        for t in range(steps):
            commands = (plans.load[:, t], plans.cooling[:, t], plans.battery[:, t])
            score.add(sim.step(Actions(*commands)))
        return score.figure


def compare(scenario: Scenario, steps: int) -> list[tuple[float, float, bool]]:
    """Least figure, figure found and whether the search was complete, with ends kept and free."""
    outcomes = all_outcomes(scenario, steps)
    problem, demand = problem_at(scenario, steps, outcomes)
    found = []
    for ends in (None, FREE):
        kept = permitted(outcomes, scenario, ends, problem.storage.stored_kwh)
        plans = discrete_plans(problem, scenario.config, demand, ends=ends, beam=27**3)
        reached = figures(scenario, plans)
        found.append((float(outcomes.figure[kept].min()), float(reached[0]), plans.is_complete))
    return found


def main(steps: int) -> None:
    """Print the least figures of all scenarios."""
    print(f"{'scenario':32} {'ends':5} {'least of all':>18} {'found':>18}  relative  time")
    for name, scenario in SCENARIOS.items():
        began = time.perf_counter()
        for ends, (least, found, complete) in zip(
            ("kept", "free"), compare(scenario, steps), strict=True
        ):
            note = "" if complete else "  (states were left out)"
            spent = time.perf_counter() - began
            print(
                f"{name:32} {ends:5} {least:18.12g} {found:18.12g}  {found / least - 1:8.1e}  "
                f"{spent:.0f} s{note}"
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4)
