"""Sequences of discrete actions run by the simulator, and the figure of the best of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sdc_taichi.optimum.certificates import measured
from sdc_taichi.optimum.discrete import DiscretePlans
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import Agent
from sdc_taichi.optimum.rollout import repeated
from sdc_taichi.optimum.score import Score
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, Actions


def run_discrete(
    fleet: Fleet,
    drivers: Drivers,
    plans: Sequence[DiscretePlans],
    *,
    agents: tuple[Agent, ...],
    start: I64,
    objective: Objective,
    scored_from: int = 0,
    seed: int | I64 = 0,
    precision: Precision = "f32",
    stop: Callable[[], bool] | None = None,
) -> F64 | None:
    """Run all plans of B data centers in one batch, and take the least figure of each.

    A sequence counts if the simulator shows that it keeps what a plan has to keep; of inlets, which
    a limit bars by step, the table has been asked.

    Args:
        fleet: B data centers.
        drivers: Their inputs.
        plans: What each is to do, best first by its table, B of T steps.
        agents: What plans move; without cooling, setpoints follow their schedules.
        start: First step of each, counted from the beginning of the year, (B,).
        objective: What is minimised.
        scored_from: First step that is scored.
        seed: Of the sampled events, one for all or for each data center, (B,).
        precision: Of the hall kernels.
        stop: Asked before every step.

    Returns:
        Figure of the best sequence of each data center, in the unit of the objective, (B,), nan
        where none counts; None where ``stop`` ended the work.
    """
    # Idle commands fill up what is missing, and are the last sequence of all.
    most = 1 + max(len(of.figure) for of in plans)
    steps = plans[0].load.shape[1]
    load, cooling, battery = (
        np.stack([_filled(getattr(of, name), most) for of in plans], axis=1).reshape(-1, steps)
        for name in ("load", "cooling", "battery")
    )
    copies, inputs, first = repeated(fleet, drivers, start, most)
    seeds = seed if np.ndim(seed) == 0 else np.tile(seed, most)
    with Simulator(copies, drivers=inputs, precision=precision) as sim:
        sim.reset(seeds, start=first)
        score = Score(objective, sim, scored_from)
        for t in range(steps):
            if stop is not None and stop():
                return None
            setpoints = cooling[:, t] if "cooling" in agents else None
            score.add(sim.step(Actions(load[:, t], setpoints, battery[:, t])))
        capacity_kwh = sim.sizing.battery_kwh
    found = [measured(score, i) for i in range(copies.size)]
    idle = found[-fleet.size :]
    least = np.full(fleet.size, np.nan)
    for i, of in enumerate(plans):
        own = found[i :: fleet.size][: len(of.figure)]
        kept = [each.figure for each in own if not each.failures(idle[i], capacity_kwh[i])]
        least[i] = min(kept, default=np.nan)
    return least


def _filled(commands: F64, most: int) -> F64:
    """Commands of so many sequences, (most, T), of which those that lack are 0."""
    found = np.zeros((most, commands.shape[1]))
    found[: len(commands)] = commands
    return found
