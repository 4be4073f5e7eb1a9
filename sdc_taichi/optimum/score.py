"""The figure of a run under an objective, and what it keeps or breaks, added up step by step."""

from __future__ import annotations

import numpy as np

from sdc_taichi.optimum.objective import Objective
from sdc_taichi.sim.bills import add_power, billed_kw_months, no_demand
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult


class Score:
    """What the scored steps of B data centers come to.

    Args:
        objective: what is minimised.
        sim: the simulator, which has been reset and has done no step.
        scored_from: first step that counts.
    """

    def __init__(self, objective: Objective, sim: Simulator, scored_from: int = 0) -> None:
        fleet, start = sim.fleet, sim.drivers.start
        self._objective, self._step_h, self._from = objective, sim.step_h, scored_from
        self._charge_per_kw = fleet.values("tariff.demand_charge_per_kw")
        self._demand = no_demand(start + scored_from, fleet.steps_per_hour)
        names = ("carbon_g", "grid_kwh", "energy_cost", "water_l", "dropped_tasks", "unmet_w")
        self._sums = {name: np.zeros(sim.size) for name in names}
        self._steps = 0
        self.start_kwh, self.start_tasks = _memory(sim)
        """Energy stored, in kWh, and work that waits, in tasks, at the first scored step, (B,)."""
        self.end_kwh, self.end_tasks = _memory(sim)
        """Energy stored, in kWh, and work that waits, in tasks, after the last step, (B,)."""
        self.most_overdue_tasks = np.zeros(sim.size)
        """Most overdue work of a scored step, in tasks, (B,)."""
        self.hottest_inlet_c = np.full(sim.size, -np.inf)
        """Hottest inlet of the scored steps, in C, (B,)."""

    def add(self, result: StepResult) -> None:
        """Add the step that follows those added before."""
        self.end_kwh = result.stored_kwh.copy()
        self.end_tasks = result.queue_tasks.copy()
        if result.step < self._from:
            self.start_kwh, self.start_tasks = self.end_kwh, self.end_tasks
            return
        add_power(self._demand, self._steps, result.grid_kwh / self._step_h)
        self._steps += 1
        for name, total in self._sums.items():
            total += getattr(result, name)
        np.maximum(self.most_overdue_tasks, result.overdue_tasks, out=self.most_overdue_tasks)
        np.maximum(self.hottest_inlet_c, result.inlet_max_c, out=self.hottest_inlet_c)

    @property
    def figure(self) -> F64:
        """The figure of the scored steps, in the unit of the objective, (B,)."""
        kw_months = billed_kw_months(self._demand, self._steps)
        return self._objective.figure(
            cfp_kg=self._sums["carbon_g"] / 1e3,
            grid_kwh=self._sums["grid_kwh"],
            cost=self._sums["energy_cost"] + kw_months * self._charge_per_kw,
            water_l=self._sums["water_l"],
        )

    @property
    def dropped_tasks(self) -> F64:
        """Work that found the queue full, in tasks, (B,)."""
        return self._sums["dropped_tasks"]

    @property
    def unmet_kwh(self) -> F64:
        """Heat that stayed in the room, in kWh, (B,)."""
        return self._sums["unmet_w"] * self._step_h / 1e3


def _memory(sim: Simulator) -> tuple[F64, F64]:
    """Energy stored, in kWh, and work that waits, in tasks, of each data center, (B,)."""
    state = sim.state
    return state.stored_kwh.copy(), state.queue[:, -1].copy()
