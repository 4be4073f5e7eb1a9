"""Share of the achievable: saving of a run relative to the saving of a known optimum.

Both savings are relative to idle commands. The share is 0 for a controller that is as good as idle
commands, and 1 for a controller that is as good as the optimum's achieved path. Stored energy and
queued work at the end of the run are valued (``Optimum.end_value``), so that emptying the battery
does not count as a saving.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.control import PERFECT, Controller, ForecastError, View
from sdc_taichi.errors import SdcError
from sdc_taichi.optimum.fleet import FleetOptimum, FleetScore
from sdc_taichi.optimum.objective import Score
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.optimum.rollout import LEAST_K, LoopFollower, broken_constraints
from sdc_taichi.optimum.task import seeds_of_sampled_events
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import finite_or_none
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, Actions, StepResult

OPTIMUM = "optimum"
"""Name of the controller that follows a known optimum, in run folders and reports."""


class AchievedPath:
    """Controller that repeats the commands of the achieved path of a known optimum.

    Args:
        optimum: The optimum, solved for the controlled data centers.
    """

    def __init__(self, optimum: Optimum) -> None:
        self._optimum = optimum
        self._loops: LoopFollower | None = None

    def reset(self, seed: int | I64) -> None:
        """Do nothing, because the controller has no state."""

    def act(self, view: View) -> Actions:
        """Return the commands of the next step."""
        step, of = view.state.step, self._optimum
        if step >= of.steps:
            raise SdcError(f"step {step} of an optimum of {of.steps} steps")
        if self._loops is None:
            self._loops = LoopFollower(view.fleet, of.loops)
        return Actions(
            load=of.load[step],
            cooling=of.cooling[step],
            battery=of.battery[step],
            **self._loops.commands(view.state),
        )


@dataclass(frozen=True, slots=True)
class Achievement:
    """Score of a controller on B data centers, compared with a known optimum."""

    controller: str
    """Name of the controller."""
    figure: F64
    """Objective value of the scored steps, in the unit of the objective, (B,)."""
    valued_figure: F64
    """``figure`` minus the value of stored energy and queued work at the end, (B,); nan if these
    cannot be valued."""
    share: F64
    """Share of the achievable, (B,); nan if the optimum saves nothing."""
    total_share: float
    """Share of the achievable of all data centers together; nan if the optimum saves nothing."""
    broken: tuple[tuple[str, ...], ...]
    """Texts on the constraints that each data center violated and the achieved path did not."""


def achievement(optimum: Optimum, controller: str, score: Score) -> Achievement:
    """Compare the score of a run with a known optimum.

    Args:
        optimum: Known optimum of the same configs, inputs and steps.
        controller: Name of the controller.
        score: Score of the run, with the objective and the first scored step of the optimum.
    """
    ends = score.start_kwh, score.start_tasks, score.end_kwh, score.end_tasks
    valued = score.figure - optimum.end_value(*ends)
    saving = optimum.idle - optimum.achieved
    share = share_of_achievable(valued, optimum.idle, optimum.achieved)
    best = float(saving.sum())
    total = float((optimum.idle - valued).sum()) / best if best > 0 else float("nan")
    broken = tuple(tuple(_broken(optimum, score, dc)) for dc in range(len(saving)))
    return Achievement(controller, score.figure, valued, share, total, broken)


def fleet_achievement(optimum: FleetOptimum, score: FleetScore) -> Achievement:
    """Compare the score of a run of F fleets with their known optimum.

    Arrays have the shape (F,). The figure already values the work that is left at the end.
    """
    figure, saving = score.figure, float((optimum.idle - optimum.achieved).sum())
    broken = [
        tuple(broken_constraints(dropped_more, (overdue, overdue_best), "", (0.0, 0.0)))
        for dropped_more, overdue, overdue_best in zip(
            score.dropped_of_fleets - optimum.idle_dropped_tasks,
            score.overdue_of_fleets,
            optimum.overdue_tasks,
            strict=True,
        )
    ]
    return Achievement(
        controller="",
        figure=figure,
        valued_figure=figure,
        share=share_of_achievable(figure, optimum.idle, optimum.achieved),
        total_share=float((optimum.idle - figure).sum()) / saving if saving > 0 else float("nan"),
        broken=tuple(broken),
    )


def share_of_achievable(figures: F64, idle: F64, achieved: F64) -> F64:
    """Return the share of the achievable, (B,); nan if the optimum is no better than idle commands.

    Args:
        figures: Objective values of the run, including the value of its end state, (B,).
        idle: Objective values of idle commands, (B,).
        achieved: Objective values of the optimum's achieved path, (B,); nan if there is none.
    """
    saving = idle - achieved
    share = np.full(saving.shape, np.nan)
    np.divide(idle - figures, saving, out=share, where=saving > 0)
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
    """Run a controller for the steps of a known optimum, and compare it with the optimum.

    Args:
        optimum: Known optimum of the simulator's configs and inputs.
        sim: The simulator.
        controller: Controller of the run.
        name: Name of the controller.
        seed: Seed of the simulator's events, the controller and the forecast errors.
        forecast_error: Error model of the forecasts that the controller sees.
        on_step: Callback that receives the result of every step.
        stop: Callback before every step; the run ends if it returns True.

    Returns:
        Comparison of the controller with the optimum; None if the run was stopped.

    Raises:
        SdcError: The optimum belongs to other configs or inputs.
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
    """Reset a simulator for a run that will be compared with a known optimum.

    Args:
        optimum: Known optimum of the simulator's configs and inputs.
        sim: The simulator.
        seed: Seed of the simulator's events.

    Returns:
        Empty score, to which the steps of the run are to be added.

    Raises:
        SdcError: The optimum belongs to other configs or inputs.
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
        content: Content of metrics.json, which is modified.
        optimum: Known optimum of the same configs, inputs and steps.
        reached: Comparison of the run with the optimum.
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
    """Return texts on the constraints that a data center violated and the achieved path did not.

    If no setpoint satisfies a limit, the achieved path violates it as well, which is no fault of
    the controller.
    """
    best, hot = optimum.certificates[dc], ""
    limit_c, hottest_c = optimum.inlet_limit_c[dc], score.hottest_inlet_c[dc]
    if hottest_c > max(limit_c, best["hottest_inlet_c"]) + LEAST_K:
        hot = f"has an inlet of {hottest_c:.2f} C, over the limit of {limit_c:g} C"
        if best["hottest_inlet_c"] > limit_c + LEAST_K:
            # No path keeps the limit in each step.
            hot = f"has an inlet of {hottest_c:.2f} C, over {best['hottest_inlet_c']:.2f} C"
    return broken_constraints(
        score.dropped_tasks[dc] - optimum.idle_dropped_tasks[dc],
        (score.most_overdue_tasks[dc], best["overdue_tasks"]),
        hot,
        (score.unmet_kwh[dc], best["unmet_kwh"]),
    )
