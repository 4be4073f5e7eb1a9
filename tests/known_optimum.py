"""An invented optimum of a simulator, for tests of how optima are reported; nothing is solved."""

from __future__ import annotations

from typing import Any

import numpy as np

from sdc_taichi import Actions, Fleet, Simulator
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.problem import AGENTS, Ends
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.types import F64

KWH_VALUE = 0.05
"""Value of a kWh that is stored at the end."""
TASK_VALUE = 1e-4
"""Value of a task that does not wait at the end."""


def made_up_optimum(
    sim: Simulator, steps: int, objective: str = "carbon", scored_from: int = 0
) -> Optimum:
    """An optimum whose achieved path raises the setpoint by 2 K and uses the battery once."""
    aim = Objective.parse(objective)
    shape = (steps, sim.size)
    cooling, battery = np.zeros(shape), np.zeros(shape)
    cooling[0] = 2.0
    battery[:8] = 1.0
    battery[60:] = -1.0
    idle = run_commands(sim, aim, np.zeros(shape), np.zeros(shape), scored_from)
    best = run_commands(sim, aim, cooling, battery, scored_from)

    def bound_of_ends(dc: int, ends: Ends) -> float:
        stored, waiting = ends.end_kwh - ends.start_kwh, ends.end_tasks - ends.start_tasks
        return float(0.9 * best.figure[dc] + KWH_VALUE * stored - TASK_VALUE * waiting)

    kinds = ("bound", *["estimate: made up"] * (sim.size - 1))
    return Optimum(
        names=tuple(sim.fleet.names),
        fingerprint=sim.fingerprint(),
        objective=aim,
        agents=AGENTS,
        start=sim.drivers.start.copy(),
        seed=np.zeros(sim.size, dtype=np.int64),
        steps=steps,
        scored_from=scored_from,
        inlet_limit_c=np.full(sim.size, np.inf),
        idle=idle.figure,
        idle_dropped_tasks=idle.dropped_tasks,
        bound=0.9 * best.figure,
        achieved=best.figure,
        alone={"cooling": 0.5 * (idle.figure + best.figure)},
        uncoordinated={},
        bound_kinds=kinds,
        failures=((), *[("facility energy off by 1e-3",)] * (sim.size - 1)),
        certificates=tuple(
            {"overdue_tasks": 0.0, "hottest_inlet_c": float(inlet_c), "unmet_kwh": 0.0}
            for inlet_c in best.hottest_inlet_c
        ),
        load=np.zeros(shape),
        cooling=cooling,
        battery=battery,
        loops=np.full((*shape, 3), np.nan),
        bound_of_ends=bound_of_ends,
    )


def made_up_solve(
    fleet: Fleet, *, steps: int, drivers: Any, objective: Any, scored_from: int, **_: Any
) -> Optimum:
    """Stands in for ``solve``."""
    with Simulator(fleet, drivers=drivers) as sim:
        return made_up_optimum(sim, steps, str(objective), scored_from)


def run_commands(
    sim: Simulator, objective: Objective, cooling: F64, battery: F64, scored_from: int
) -> Score:
    """Score of a run with given commands, (T, B) each."""
    sim.reset(0)
    score = Score(objective, sim, scored_from)
    for cool, store in zip(cooling, battery, strict=True):
        score.add(sim.step(Actions(cooling=cool, battery=store)))
    return score
