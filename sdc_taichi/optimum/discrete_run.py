"""Sequences of discrete actions run by the simulator, and the best of them for each data center."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

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


@dataclass(frozen=True, slots=True)
class DiscretePath:
    """The best sequence of discrete actions of a data center that the simulator has run."""

    figure: float
    """Figure of the scored steps, in the unit of the objective; nan where no sequence was found
    that keeps the constraints."""
    is_complete: bool
    """Whether the search left no state out, so that no sequence is better by the table."""
    load: F64
    """Load commands, (T,)."""
    cooling: F64
    """Cooling commands, (T,)."""
    battery: F64
    """Battery commands, (T,)."""


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
) -> list[DiscretePath] | None:
    """Run all plans of B data centers in one batch, and take the best of each.

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
        The best path of each data center, B; None where ``stop`` ended the work.
    """
    most = max(max(len(of.figure) for of in plans), 1)
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
        figure = score.figure.reshape(most, fleet.size)
    return [_best(of, figure[:, i]) for i, of in enumerate(plans)]


def _filled(commands: F64, most: int) -> F64:
    """Commands of so many sequences, (most, T), where the first stands for those that lack."""
    found = np.zeros((most, commands.shape[1]))
    found[: len(commands)] = commands
    if len(commands):
        found[len(commands) :] = commands[0]
    return found


def _best(plans: DiscretePlans, figure: F64) -> DiscretePath:
    """The best of some plans by the figures that the simulator reached, (K,) and more."""
    count, steps = plans.load.shape
    if not count:
        still = np.zeros(steps)
        return DiscretePath(float("nan"), plans.is_complete, still, still, still)
    best = int(figure[:count].argmin())
    return DiscretePath(
        figure=float(figure[best]),
        is_complete=plans.is_complete,
        load=plans.load[best],
        cooling=plans.cooling[best],
        battery=plans.battery[best],
    )
