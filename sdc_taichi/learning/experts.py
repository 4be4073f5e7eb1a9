"""Experts that cloning imitates: controllers that tell what to do in any situation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sdc_taichi.control import Controller, View, make_controller
from sdc_taichi.errors import ConfigError
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS, Agent
from sdc_taichi.optimum.rollout import Follower, Targets
from sdc_taichi.optimum.solve import Progress, solve
from sdc_taichi.run.achievable import OPTIMUM, AchievedPath
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, Actions, StepResult

_RECORDED = ("queue_tasks", "setpoint_c", "stored_kwh", "facility_kwh")
"""Fields of ``Targets``, which are those of ``StepResult`` too."""


def make_expert(name: str, fleet: Fleet, steps: int) -> Controller:
    """An expert by name.

    Args:
        name: ``optimum``, ``optimum:OBJECTIVE``, or the name of a controller.
        fleet: the data centers, B.
        steps: number of steps of an episode.

    Raises:
        ConfigError: an unknown name or objective.
    """
    try:
        objective = objective_of_optimum(name)
        if objective is not None:
            return FollowedOptimum(steps, objective)
        return make_controller(name, fleet)
    except ConfigError as error:
        raise ConfigError(f"learning.expert {name!r}: {error}") from None


def objective_of_optimum(name: str) -> Objective | None:
    """Objective of ``optimum`` or ``optimum:OBJECTIVE``; None of a controller's name.

    Raises:
        ConfigError: an objective that is not valid.
    """
    kind, colon, objective = name.partition(":")
    if kind != OPTIMUM:
        return None
    return Objective.parse(objective if colon else "carbon")


class FollowedOptimum:
    """Commands towards the achieved path of the optimum of the episode under way, from any state.

    Each episode is solved before its first step, unless a cache holds its optimum.

    Args:
        steps: number of steps of an episode.
        objective: what is minimised.
        agents: what the plan moves of load, cooling and battery; the rest is idle.
        progress: is told of the stages of solving.
        stop: asked now and then while solving; true raises ``StoppedError``.
    """

    def __init__(
        self,
        steps: int,
        objective: Objective,
        *,
        agents: Sequence[Agent] = AGENTS,
        progress: Progress | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        self._steps, self._objective, self._agents = steps, objective, tuple(agents)
        self._progress, self._stop = progress, stop
        self._follower: Follower | None = None

    def reset(self, seed: int | I64) -> None:
        """Forget the episode before."""
        self._follower = None

    def act(self, view: View) -> Actions:
        """Commands for work, setpoint and battery."""
        if self._follower is None:
            self._follower = Follower(view, self._targets(view))
        return self._follower.actions(view.state)

    def _targets(self, view: View) -> Targets:
        """States that the achieved path goes through."""
        optimum = solve(
            view.fleet,
            steps=self._steps,
            start=view.drivers.start,
            drivers=view.drivers,
            objective=self._objective,
            agents=self._agents,
            precision=view.precision,
            progress=self._progress,
            stop=self._stop,
        )
        rows: dict[str, list[F64]] = {name: [] for name in _RECORDED}

        def record(result: StepResult) -> None:
            for name, of_steps in rows.items():
                of_steps.append(np.array(getattr(result, name)))

        with Simulator(view.fleet, drivers=view.drivers, precision=view.precision) as sim:
            simulate(sim, AchievedPath(optimum), self._steps, 0, on_step=record)
        return Targets(**{name: np.stack(of_steps) for name, of_steps in rows.items()})
