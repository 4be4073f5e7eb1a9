"""Planning problems of the data centers of a fleet, from their configs, devices and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import (
    AGENTS,
    RAMP_K,
    Agent,
    BilledMonth,
    FacilityTable,
    FlexibleWork,
    Problem,
    Storage,
)
from sdc_taichi.optimum.rollout import arrived_tasks
from sdc_taichi.plant.electrical import NO_LIMIT_KW
from sdc_taichi.plant.workload import TASKS_PER_STEP, UNLIMITED_TASKS
from sdc_taichi.sim.bills import month_around
from sdc_taichi.sim.crac_units import schedules_c
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.facility import BATTERY_PARAMETERS
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.workload import Workload, due_steps, queue_limit_tasks
from sdc_taichi.types import F64, I64


def problems_of(
    fleet: Fleet,
    drivers: Drivers,
    sizing: Sizing,
    tables: Sequence[FacilityTable],
    *,
    start: I64,
    objective: Objective,
    agents: tuple[Agent, ...] = AGENTS,
    scored_from: int = 0,
    inlet_limit_c: float | None = None,
    ramp_k: float = RAMP_K,
) -> list[Problem]:
    """The planning problem of each data center, B.

    Args:
        fleet: B data centers.
        drivers: Their inputs, with prices.
        sizing: Their devices.
        tables: What their steps cost, B of T steps.
        start: First step of each, counted from the beginning of the year, (B,).
        objective: What a plan minimises.
        agents: What a plan may move.
        scored_from: First step that is scored.
        inlet_limit_c: Highest inlet that a plan may cause where it has a choice, in C; None is the
            limit of ``protection.ashrae_class``, and none where that is not set.
        ramp_k: Largest change of the setpoint in a step, in K.
    """
    steps = len(tables[0].facility_kwh)
    index = start[:, None] + np.arange(steps)
    assert drivers.price_per_kwh is not None, "a simulator has filled it in"
    weight = objective.kwh_weight(drivers.ci_g_per_kwh.at(index), drivers.price_per_kwh.at(index))
    weight[:, :scored_from] = 0.0
    demand, idle_c = drivers.demand.at(index), _idle_setpoint_c(fleet, index)
    work, storage = _work(fleet, demand, scored_from), _storage(fleet, sizing)
    per_kw = objective.kw_month_weight(fleet)
    limit_kw = np.where(sizing.grid_limit_kw < NO_LIMIT_KW, sizing.grid_limit_kw, np.inf)
    inlet_c = inlet_limits_c(fleet, inlet_limit_c)
    initial_c = fleet.values("hvac.setpoint.initial_c")
    return [
        Problem(
            name=name,
            step_h=1.0 / fleet.steps_per_hour,
            agents=agents,
            table=tables[i],
            kwh_weight=weight[i],
            litre_weight=objective.water,
            months=_months(int(start[i]), steps, scored_from, fleet.steps_per_hour, per_kw[i]),
            work=work[i],
            storage=storage[i],
            grid_limit_kw=float(limit_kw[i]),
            inlet_limit_c=float(inlet_c[i]),
            idle_setpoint_c=idle_c[i],
            setpoint_c=float(initial_c[i]),
            ramp_k=ramp_k,
            scored_from=scored_from,
        )
        for i, name in enumerate(fleet.names)
    ]


def inlet_limits_c(fleet: Fleet, given_c: float | None = None) -> F64:
    """Highest inlet that plans may cause, in C, (B,); inf without a limit.

    Args:
        fleet: B data centers.
        given_c: The limit, in C; None is that of ``protection.ashrae_class``, if it is set.
    """
    if given_c is not None:
        return np.full(fleet.size, given_c)
    classes = [config.protection.ashrae_class for config in fleet.configs]
    return np.array([np.inf if c is None else allowable_c(c)[1] for c in classes])


def _idle_setpoint_c(fleet: Fleet, index: I64) -> F64:
    """Setpoints under idle commands: those of the schedule, and the initial one without, (B, T)."""
    initial_c = np.repeat(fleet.values("hvac.setpoint.initial_c")[:, None], index.shape[1], axis=1)
    schedules = schedules_c(fleet)
    if schedules is None:
        return initial_c
    scheduled_c = schedules.at(index)
    return np.where(np.isnan(scheduled_c), initial_c, scheduled_c)


def _months(
    start: int, steps: int, scored_from: int, steps_per_hour: int, weight_per_kw: float
) -> tuple[BilledMonth, ...]:
    """The months of a run whose highest power is charged for; none at weight 0.

    A month that is scored in part counts by this part of it, as in ``sim.bills``.
    """
    months: list[BilledMonth] = []
    first = start + scored_from
    while weight_per_kw > 0 and first < start + steps:
        begin, end = (int(x[0]) for x in month_around(np.array([first]), 24 * steps_per_hour))
        last = min(end, start + steps)
        share = (last - first) / (end - begin)
        months.append(BilledMonth(first - start, last - start, weight_per_kw * share))
        first = last
    return tuple(months)


def _work(fleet: Fleet, demand: F64, scored_from: int) -> list[FlexibleWork]:
    """Work of each data center, B, from its demand, (B, T)."""
    model = fleet.models["workload"]
    limits, due = queue_limit_tasks(fleet), due_steps(fleet)
    idle_tasks, dropped_tasks = _under_idle_commands(fleet, demand)
    found = []
    for i, config in enumerate(fleet.configs):
        share, cap = (
            config.workload.flexible_share,
            config.workload.max_utilisation * TASKS_PER_STEP,
        )
        arrived = arrived_tasks(model, demand[i], share)
        deadline = None if np.isinf(due[i]) else int(due[i])
        if model == "tasks":
            most_deferred = np.floor(demand[i] * share * TASKS_PER_STEP)
            most_executed = np.maximum(arrived, np.floor(cap))
        else:
            most_deferred = _most_deferred_fluid(arrived, share, cap, deadline)
            most_executed = np.full(len(arrived), cap)
        found.append(
            FlexibleWork(
                arrived_tasks=arrived,
                idle_tasks=idle_tasks[i],
                most_deferred_tasks=most_deferred,
                most_executed_tasks=most_executed,
                queue_limit_tasks=np.inf if limits[i] >= UNLIMITED_TASKS else float(limits[i]),
                deadline_steps=deadline,
                model=model,
                most_dropped_tasks=float(dropped_tasks[i, scored_from:].sum()),
            )
        )
    return found


def _under_idle_commands(fleet: Fleet, demand: F64) -> tuple[F64, F64]:
    """Work that is done and dropped in each step under idle commands, in tasks, (B, T) each."""
    workload = Workload(fleet)
    queue, idle = workload.empty_queue(), np.zeros(fleet.size)
    done, dropped = np.empty(demand.shape), np.empty(demand.shape)
    for t in range(demand.shape[1]):
        work = workload.run(queue, demand[:, t], idle, 1.0)
        queue = work.queue
        done[:, t], dropped[:, t] = work.started_tasks, work.dropped_tasks
    workload.close()
    return done, dropped


def _most_deferred_fluid(arrived: F64, share: float, cap: float, deadline: int | None) -> F64:
    """Most of the arriving work that can wait, in tasks, (T,).

    It is the flexible share, and beyond that what finds no room beside work whose deadline has
    come. That is at most what was deferred a deadline earlier, as long as every step can do all of
    the work that arrives in one; where it cannot, all arriving work may have to wait.
    """
    most = share * arrived
    if np.any(arrived > cap):
        return arrived.copy()
    if deadline is None:
        return most
    for t in range(deadline, len(arrived)):
        most[t] = max(most[t], min(arrived[t], arrived[t] + most[t - deadline] - cap))
    return most


def _storage(fleet: Fleet, sizing: Sizing) -> list[Storage]:
    """Battery of each data center, B, full to the initial state of charge."""
    initial_kwh = fleet.values("battery.initial_soc") * sizing.battery_kwh
    return [
        Storage(
            model=fleet.models["battery"],
            capacity_kwh=float(sizing.battery_kwh[i]),
            stored_kwh=float(initial_kwh[i]),
            **{name: getattr(config.battery, name) for name in BATTERY_PARAMETERS},
        )
        for i, config in enumerate(fleet.configs)
    ]
