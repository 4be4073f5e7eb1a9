"""Known optimum of coolant loops: how much their commands can save while all other agents idle.

The work of a step does not depend on the loops as long as no GPU throttles, so in quasi-steady
halls the steps are independent, and the best commands of each are those of its steady state
(``LoopMap``). The bound is the figure of these commands if setpoints could move at once; the
achieved figure is that of controller ``liquid-greedy``, whose setpoints move by 2 K a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.optimum.loop_map import LoopCommands
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, Actions

TABLE_ERROR = 1e-4
"""Most by which the commands of the tables are worse than the best steady ones, relative."""


@dataclass(frozen=True, slots=True)
class LoopOptimum:
    """Figures of the objective for B data centers, (B,) each; smaller figures are better."""

    idle: F64
    """Figure with held setpoints and flows."""
    bound: F64
    """Lower bound for all commands of setpoints, flows and facility water that throttle no GPU."""
    achieved: F64
    """Figure of simulated commands."""


def loop_optimum(
    fleet: Fleet,
    drivers: Drivers,
    *,
    start: I64,
    steps: int,
    objective: Objective,
    precision: Precision = "f32",
    on_step: Callable[[], None] = lambda: None,
) -> LoopOptimum:
    """Compute the optimum of the coolant loops of B data centers in a run of T steps.

    Args:
        fleet: the data centers, with liquid-cooled racks.
        drivers: their inputs.
        start: first step of each data center, counted from the beginning of the year, (B,).
        steps: number of steps, T.
        objective: objective to minimise.
        precision: floating-point precision of the hall kernels.
        on_step: called after every step; an error that it raises ends the work.

    Raises:
        ConfigError: steps depend on each other, or a data center has no liquid-cooled racks.
    """
    for config in fleet.configs:
        if config.liquid is None:
            raise ConfigError(f"{config.name}: no optimum of coolant loops without section liquid")
        if config.simulation.thermal == "transient" or config.events.scheduled:
            raise ConfigError(
                f"{config.name}: no optimum of coolant loops in transient halls or with events; "
                "valid with simulation.thermal=quasi_steady and events.scheduled=[]"
            )
    commands = LoopCommands(fleet, drivers)
    size = fleet.size
    # Three copies of each data center: held, free to move at once, and limited to 2 K a step.
    copies = build_fleet(fleet.configs * 3)
    cdu_dc, cdus = fleet.cdu_dc, fleet.cdus
    approach_k = copies.values("liquid.cdus.approach_k")
    with Simulator(copies, drivers=drivers.take([*range(size)] * 3), precision=precision) as sim:
        sim.reset(0, start=np.tile(start, 3))
        score = Score(objective, sim)
        for step in range(steps):
            now = sim.drivers.at(step)
            weather = (x[:size] for x in (now.outdoor_c, now.wet_bulb_c, now.demand))
            best_c, flow, best_k = commands.at(*weather)
            state = sim.state
            setpoint_c, flows = state.cdu_setpoint_c.copy(), state.cdu_flow.copy()
            setpoint_c[cdus : 2 * cdus] = best_c[cdu_dc]
            sim.continue_from(replace(state, cdu_setpoint_c=setpoint_c), sim.drivers)
            wanted_c = np.concatenate([setpoint_c[: 2 * cdus], best_c[cdu_dc]])
            flows[cdus:] = np.tile(flow[cdu_dc], 2)
            approach_k[size:] = np.tile(best_k, 2)
            score.add(
                sim.step(
                    Actions(cdu_setpoint_c=wanted_c, cdu_flow=flows, facility_approach_k=approach_k)
                )
            )
            on_step()
        idle, bound, achieved = score.figure.reshape(3, size)
    bound = np.minimum(bound, achieved)
    return LoopOptimum(idle, bound - TABLE_ERROR * np.abs(bound), achieved)
