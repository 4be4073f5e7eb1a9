"""Model-predictive control of fleets: plan load, setpoints and transfers of a day, again and again.

Every few hours, one linear programme per fleet (``optimum.fleet``) plans the coming day with the
forecasts of a view and the tables of a ``FacilityMap``. Work that arrives beyond the forecast runs
at once. S is the number of sites of a fleet, B of data centers, H of steps of a plan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.control.mpc import SETPOINT_STEP_K, expected_demand
from sdc_taichi.control.rules import setpoint_command
from sdc_taichi.control.view import View
from sdc_taichi.optimum.facility_map import FacilityMap, facility_map
from sdc_taichi.optimum.fleet import WorkCommands, fleet_plan, hub_of, with_room
from sdc_taichi.optimum.problem import RAMP_K, FlexibleWork, inlet_limits_c
from sdc_taichi.optimum.programme import InfeasibleError
from sdc_taichi.optimum.stage_cost import StageCost, curves_between
from sdc_taichi.plant.workload import TASKS_PER_STEP, UNLIMITED_TASKS
from sdc_taichi.sim.workload import due_steps, queue_limit_tasks
from sdc_taichi.types import F64, I64, Actions

HORIZON_H = 24.0
"""Length of a plan, in h."""
EVERY_H = 6.0
"""Time between two plans, in h."""


@dataclass(frozen=True, slots=True)
class _Plan:
    """Plan of all fleets from one step on."""

    first: int
    """First step of the plan, counted from reset."""
    demand: F64
    """Expected work as a share of capacity, (B, H)."""
    flow_tasks: F64
    """Work to send to each site of the fleet, in tasks, (H, B, S)."""
    executed_tasks: F64
    """Work to execute, in tasks, (H, B)."""


class FleetPredictive:
    """Controller that plans load, setpoints and transfers of fleets for a day, every 6 hours."""

    commands = ("load", "cooling", "transfer")
    """Fields of ``Actions`` that it gives."""

    def __init__(self) -> None:
        self._facility: FacilityMap | None = None
        self._of: tuple[object, ...] = ()
        self.reset(0)

    def reset(self, seed: int | I64) -> None:
        """Begin an episode that does not depend on earlier ones."""
        self._plan: _Plan | None = None
        self._view: View | None = None
        self._actions = Actions()

    def act(self, view: View) -> Actions:
        """Return the commands; the same view gives the same commands again."""
        if view is not self._view:
            self._actions, self._view = self._commands(view), view
        return self._actions

    def _commands(self, view: View) -> Actions:
        of = (view.sizing, view.drivers.outdoor_c, view.drivers.wet_bulb_c)
        if self._facility is None or any(a is not b for a, b in zip(of, self._of, strict=True)):
            self._facility, self._of = _map_of(view), of
            self._work = WorkCommands(view.fleet)
        step, plan = view.state.step, self._plan
        if plan is None or not 0 <= step - plan.first < EVERY_H / view.step_h:
            self._plan = plan = _planned(view, self._facility)
        at, now = step - plan.first, view.now
        more_tasks = (now.demand - plan.demand[:, at]) * TASKS_PER_STEP
        executed = np.clip(plan.executed_tasks[at] + more_tasks, 0.0, TASKS_PER_STEP)
        best_c = self._facility.best_setpoint_c(
            executed[:, None] / TASKS_PER_STEP, now.outdoor_c[:, None], now.wet_bulb_c[:, None]
        )[:, 0]
        target_c = np.clip(best_c, view.setpoint_c - RAMP_K, view.setpoint_c + RAMP_K)
        command = setpoint_command(target_c, view)[view.fleet.unit_dc]
        return self._work.actions(view.state, now.demand, plan.flow_tasks[at], executed, command)


def _map_of(view: View) -> FacilityMap:
    """Return the energy of each data center by weather, utilisation and setpoint."""
    return facility_map(
        view.fleet,
        view.drivers,
        inlet_limit_c=inlet_limits_c(view.fleet),
        setpoint_step_k=SETPOINT_STEP_K,
        precision=view.precision,
    )


def _planned(view: View, facility: FacilityMap) -> _Plan:
    """Plan the coming day of all fleets."""
    fleet, shared, sites = view.fleet, view.fleet.shared_work, view.fleet.sites_per_fleet
    assert shared is not None
    coming = view.forecast(HORIZON_H)
    demand = expected_demand(view, coming.index)
    arrived = demand * TASKS_PER_STEP
    weight = coming.ci_g_per_kwh / 1e3
    kwh = facility.least_kwh_in(coming.outdoor_c, coming.wet_bulb_c)
    flexible_share = fleet.values("workload.flexible_share")
    capacity = fleet.values("workload.max_utilisation") * TASKS_PER_STEP
    limits, due = queue_limit_tasks(fleet), due_steps(fleet)
    steps = arrived.shape[1]
    waiting, landing = np.zeros_like(arrived), view.state.in_flight[:, :steps]
    waiting[:, : landing.shape[1]] = landing
    waiting[:, 0] += view.state.queue[:, -1]
    works, curves = [], []
    for dc in range(fleet.size):
        flexible = flexible_share[dc] * arrived[dc]
        limit = np.inf if limits[dc] >= UNLIMITED_TASKS else float(limits[dc])
        limit = with_room(limit, shared)
        deadline = None if np.isinf(due[dc]) else int(due[dc])
        most = np.full(steps, capacity[dc])
        works.append(
            FlexibleWork(arrived[dc], arrived[dc], flexible, most, limit, deadline, "fluid")
        )
        cost = weight[dc, :, None] * kwh[dc]
        stage = StageCost(
            executed_tasks=facility.utilisation * TASKS_PER_STEP,
            cost=cost,
            facility_kwh=kwh[dc],
            least_facility_kwh=kwh[dc],
            most_facility_kwh=kwh[dc],
            setpoint_c=np.zeros(cost.shape),
            highest_tasks=np.full(steps, np.inf),
        )
        curves.append(curves_between(stage, arrived[dc] - flexible, most))
    flows, executed = [], []
    for first in range(0, fleet.size, sites):
        part = slice(first, first + sites)
        hub = hub_of(
            fleet,
            shared,
            view.sizing,
            first,
            arrived_tasks=arrived[part],
            kwh_weight=weight[part],
            waiting_tasks=waiting[part],
        )
        try:
            plan = fleet_plan(works[part], curves[part], hub)
            flows.append(plan.flow_tasks)
            executed.append(plan.executed_tasks)
        except InfeasibleError:
            # More waits than can run within a day: run as much as possible.
            flows.append(np.zeros((steps, sites, sites)))
            executed.append(np.tile(capacity[part], (steps, 1)))
    return _Plan(
        view.state.step, demand, np.concatenate(flows, axis=1), np.concatenate(executed, axis=1)
    )
