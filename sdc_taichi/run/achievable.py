"""Share of the achievable: how much of a known optimum's saving over idle commands a run reaches.

The share of the achievable is 0 for a controller that does as well as idle commands, and 1 for one
that does as well as the optimum's achieved path. Energy stored and work that waits at the end are
valued, so that an empty battery is no saving (``Optimum.end_value``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.control import PERFECT, Controller, ForecastError, View
from sdc_taichi.errors import SdcError
from sdc_taichi.optimum.objective import Score
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.optimum.rollout import LEAST_K, broken_constraints
from sdc_taichi.optimum.task import seeds_of_sampled_events
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import finite_or_none
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, Actions, StepResult

OPTIMUM = "optimum"
"""Name of the controller that follows a known optimum, in run folders and reports."""


class AchievedPath:
    """A controller that gives the commands of the achieved path of a known optimum.

    Args:
        optimum: the optimum, of the data centers that it is to control.
    """

    def __init__(self, optimum: Optimum) -> None:
        self._optimum = optimum

    def reset(self, seed: int | I64) -> None:
        """Do nothing: no memory."""

    def act(self, view: View) -> Actions:
        """Commands of the step to come."""
        step, of = view.state.step, self._optimum
        if step >= of.steps:
            raise SdcError(f"step {step} of an optimum of {of.steps} steps")
        return Actions(load=of.load[step], cooling=of.cooling[step], battery=of.battery[step])


@dataclass(frozen=True, slots=True)
class Achievement:
    """Score of a controller compared with a known optimum, of B data centers."""

    controller: str
    """Name of the controller."""
    figure: F64
    """Figure of the scored steps, in the unit of the objective, (B,)."""
    valued_figure: F64
    """Figure less the value of what is stored and less what waits at the end, (B,); nan where that
    has no value."""
    share: F64
    """Share of the achievable, (B,); nan where there is none."""
    total_share: float
    """Share of the achievable of all data centers together; nan where there is none."""
    broken: tuple[tuple[str, ...], ...]
    """Constraints that each data center broke and the achieved path did not, in words."""


def achievement(optimum: Optimum, controller: str, score: Score) -> Achievement:
    """Compare the score of a run with a known optimum.

    Args:
        optimum: known optimum of the same configs, inputs and steps.
        controller: name of the controller.
        score: score of the run, under the objective and from the first scored step of the optimum.
    """
    ends = score.start_kwh, score.start_tasks, score.end_kwh, score.end_tasks
    valued = score.figure - optimum.end_value(*ends)
    room = optimum.idle - optimum.achieved
    share = share_of_achievable(valued, optimum.idle, optimum.achieved)
    total_room = float(room.sum())
    total = float((optimum.idle - valued).sum()) / total_room if total_room > 0 else float("nan")
    broken = tuple(tuple(_broken(optimum, score, dc)) for dc in range(len(room)))
    return Achievement(controller, score.figure, valued, share, total, broken)


def share_of_achievable(figures: F64, idle: F64, achieved: F64) -> F64:
    """Share of the achievable of each figure; nan where the optimum is no better than idle.

    Args:
        figures: figures, with the value of their ends, (B,).
        idle: those of idle commands, (B,).
        achieved: those of the optimum's achieved path, (B,); nan where there is none.
    """
    room = idle - achieved
    share = np.full(room.shape, np.nan)
    np.divide(idle - figures, room, out=share, where=room > 0)
    return share


def run_beside(
    optimum: Optimum,
    sim: Simulator,
    controller: Controller,
    name: str,
    seed: int = 0,
    *,
    forecast_error: ForecastError = PERFECT,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Achievement | None:
    """Run a controller over the steps of a known optimum, and compare it with that.

    Args:
        optimum: known optimum of the simulator's configs and inputs.
        sim: the simulator.
        controller: gives the actions of every step.
        name: name of the controller.
        seed: of the simulator's events, of the controller and of errors of forecasts.
        forecast_error: how the forecasts err that the controller sees.
        on_step: called with the result of every step.
        stop: asked before every step; true ends the run.

    Returns:
        What the controller reached; None if it was stopped.

    Raises:
        SdcError: the optimum is of other configs or inputs.
    """
    score = begin_score(optimum, sim, seed)

    def add(result: StepResult) -> None:
        score.add(result)
        if on_step is not None:
            on_step(result)

    done = simulate(
        sim,
        controller,
        optimum.steps,
        seed,
        forecast_error=forecast_error,
        on_step=add,
        stop=stop,
    )
    return achievement(optimum, name, score) if done.steps == optimum.steps else None


def begin_score(optimum: Optimum, sim: Simulator, seed: int) -> Score:
    """Reset a simulator for a run to be compared with a known optimum.

    Args:
        optimum: known optimum of the simulator's configs and inputs.
        sim: the simulator.
        seed: of the simulator's events.

    Returns:
        Score to add the steps of the run to.

    Raises:
        SdcError: the optimum is of other configs or inputs.
    """
    sim.reset(seed)
    seeds = seeds_of_sampled_events(sim.state.seed, sim.fleet)
    same = np.array_equal(sim.drivers.start, optimum.start) and np.array_equal(seeds, optimum.seed)
    if sim.fingerprint() != optimum.fingerprint or not same:
        raise SdcError(
            f"optimum of {', '.join(optimum.names[:3])}: of other configs, inputs, precision, "
            "sampled events or first day than the run; solve that of the run"
        )
    return Score(optimum.objective, sim, optimum.scored_from)


def put_beside(content: dict[str, Any], optimum: Optimum, reached: Achievement) -> None:
    """Add the comparison with a known optimum to the content of metrics.json.

    Args:
        content: content of metrics.json, which is added to.
        optimum: known optimum of the same configs, inputs and steps.
        reached: what the run reached.
    """
    figures = {
        "idle_figure": optimum.idle,
        "bound_figure": optimum.bound,
        "achieved_figure": optimum.achieved,
        "valued_figure": reached.valued_figure,
    }
    content["optimum"] = {
        "objective": str(optimum.objective),
        "unit": optimum.objective.unit,
        "agents": list(optimum.agents),
        "scored_from": optimum.scored_from,
        "bound_kinds": list(optimum.bound_kinds),
        "broken": [list(texts) for texts in reached.broken],
    }
    for i, dc in enumerate(content["data_centers"]):
        of_dc = {name: values[i] for name, values in figures.items()}
        of_dc["achievable_share"] = reached.share[i]
        dc["metrics"] |= {name: finite_or_none(x) for name, x in of_dc.items()}
    total = {name: values.sum() for name, values in figures.items()}
    total["achievable_share"] = reached.total_share
    content["total"] |= {name: finite_or_none(x) for name, x in total.items()}


def _broken(optimum: Optimum, score: Score, dc: int) -> list[str]:
    """Constraints that a data center broke and the achieved path did not, in words.

    Where no setpoint keeps a limit, the achieved path does not either.
    """
    best, hot = optimum.certificates[dc], ""
    limit_c, hottest_c = optimum.inlet_limit_c[dc], score.hottest_inlet_c[dc]
    if hottest_c > max(limit_c, best["hottest_inlet_c"]) + LEAST_K:
        hot = f"has an inlet of {hottest_c:.2f} C, over the limit of {limit_c:g} C"
    return broken_constraints(
        score.dropped_tasks[dc] - optimum.idle_dropped_tasks[dc],
        (score.most_overdue_tasks[dc], best["overdue_tasks"]),
        hot,
        (score.unmet_kwh[dc], best["unmet_kwh"]),
    )
