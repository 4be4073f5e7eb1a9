"""The planning problem of one data center over T steps, in the numbers that planners need."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.tables import FacilityTable
from sdc_taichi.plant.battery import BatteryParameters
from sdc_taichi.plant.electrical import NO_LIMIT_KW
from sdc_taichi.plant.workload import MODELS as WORK_MODELS
from sdc_taichi.plant.workload import TASKS_PER_STEP, UNLIMITED_TASKS, WorkPoint
from sdc_taichi.sim.bills import month_around
from sdc_taichi.sim.crac_units import schedules_c
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.workload import Workload, due_steps, queue_limit_tasks
from sdc_taichi.types import F64, I64

Agent = Literal["load", "cooling", "battery"]
AGENTS: tuple[Agent, ...] = ("load", "cooling", "battery")
"""Agents that a plan may move, by the names of the fields of ``Actions``."""
RAMP_K = 2.0
"""Largest change of the setpoint in a step, in K, as that of environments by default."""


class StoppedError(SdcError):
    """Solving was stopped before its end; the message says what is kept."""


@dataclass(frozen=True, slots=True)
class FlexibleWork:
    """Work that arrives over T steps, and what of it may wait; in tasks, 1 % of a full step."""

    arrived_tasks: F64
    """Work that arrives, (T,)."""
    idle_tasks: F64
    """Work that is done under idle commands, (T,)."""
    most_deferred_tasks: F64
    """Most of it that can be deferred, (T,)."""
    most_executed_tasks: F64
    """Most work that a step can do, (T,)."""
    queue_limit_tasks: float
    """Longest queue; inf without a limit."""
    deadline_steps: int | None
    """Steps after which deferred work has to run; None is never."""
    model: str
    """Name of the model of work: ``fluid`` or ``tasks``."""
    most_dropped_tasks: float = 0.0
    """Most work that may be dropped in all scored steps: as much as under idle commands."""


@dataclass(frozen=True, slots=True)
class Storage:
    """A battery, in the parameters of ``plant.battery``."""

    model: str
    """Name of the battery model: ``clc``, ``paper`` or ``released``."""
    capacity_kwh: float
    """Capacity, in kWh."""
    stored_kwh: float
    """Energy stored before the first step, in kWh."""
    charge_efficiency: float
    """Energy stored per energy drawn."""
    discharge_factor: float
    """Energy taken from the store per energy delivered."""
    charge_limit_c_rate: float
    """Largest rate into the store, in capacities per hour."""
    discharge_limit_c_rate: float
    """Largest rate out of the store, in capacities per hour."""
    upper_u_h: float
    """Rise of the highest stored energy with the charge power, in h."""
    upper_v: float
    """Highest stored energy without charge power, as a share of capacity."""
    lower_u_h: float
    """Rise of the lowest stored energy with the discharge power, in h."""
    lower_v: float
    """Lowest stored energy without discharge power, as a share of capacity."""


@dataclass(frozen=True, slots=True)
class BilledMonth:
    """A month, or the part of it that is scored, whose highest power a bill charges for."""

    first: int
    """First step of the plan that counts."""
    end: int
    """First step after it that does not."""
    weight_per_kw: float
    """Weight of each kW of the highest mean power of a step."""


@dataclass(frozen=True, slots=True)
class Ends:
    """States that a plan starts from and has to leave, if not the state before the first step.

    Without ``Ends`` a plan leaves at least the stored energy and at most the queue that there were
    at the first scored step.
    """

    start_kwh: float
    """Energy stored at the first scored step, in kWh."""
    start_tasks: float
    """Work that waits at the first scored step, in tasks, of any age."""
    end_kwh: float
    """Least energy stored at the end, in kWh."""
    end_tasks: float
    """Most work that waits at the end, in tasks."""


@dataclass(frozen=True, slots=True)
class Problem:
    """The planning problem of one data center over T steps."""

    name: str
    """Name of the data center."""
    step_h: float
    """Length of a step, in h."""
    agents: tuple[Agent, ...]
    """Agents that the plan may move; the others follow idle commands."""
    table: FacilityTable
    """Energy, water and inlets of each step."""
    kwh_weight: F64
    """Weight of a kWh bought in each step, (T,); 0 in steps that are not scored."""
    litre_weight: float
    """Weight of a litre of make-up water."""
    months: tuple[BilledMonth, ...]
    """Months with a demand charge."""
    work: FlexibleWork
    """Work to do."""
    storage: Storage
    """The battery; of capacity 0 where there is none."""
    grid_limit_kw: float
    """Power beyond which the battery does not charge, in kW; inf without a limit."""
    inlet_limit_c: float
    """Highest inlet that a plan may cause where it has a choice, in C; inf without a limit."""
    idle_setpoint_c: F64
    """Setpoint of each step under idle commands, in C, (T,)."""
    setpoint_c: float
    """Setpoint before the first step, in C."""
    ramp_k: float
    """Largest change of the setpoint between two steps, in K."""
    scored_from: int
    """First step that is scored."""

    @property
    def steps(self) -> int:
        """Number of steps, T."""
        return len(self.kwh_weight)


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
        tables: Tables of their T steps, B.
        start: First step of each, counted from the beginning of the year, (B,).
        objective: Objective that plans minimise.
        agents: Agents that plans may move.
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
    works = []
    for i, config in enumerate(fleet.configs):
        share = config.workload.flexible_share
        cap = config.workload.max_utilisation * TASKS_PER_STEP
        arrived = arrived_tasks(model, demand[i], share)
        deadline = None if np.isinf(due[i]) else int(due[i])
        if model == "tasks":
            most_deferred = np.floor(demand[i] * share * TASKS_PER_STEP)
            most_executed = np.maximum(arrived, np.floor(cap))
        else:
            most_deferred = _most_deferred_fluid(arrived, share, cap, deadline)
            most_executed = np.full(len(arrived), cap)
        works.append(
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
    return works


def arrived_tasks(model: str, demand: F64, flexible_share: F64 | float) -> F64:
    """Work that arrives as a model of work counts it, in tasks.

    Args:
        model: name of the model of work.
        demand: work that arrives, as a share of capacity, 0..1.
        flexible_share: share of it that may wait, 0..1.
    """
    nothing = np.zeros(np.shape(demand))
    work = WORK_MODELS[model].step(
        WorkPoint(
            demand,
            nothing,
            nothing,
            nothing,
            flexible_share=flexible_share,
            max_utilisation=1.0,
            queue_limit=0.0,
        )
    )
    return np.asarray(work.arrived_tasks)


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
            **{name: getattr(config.battery, name) for name in BatteryParameters._fields},
        )
        for i, config in enumerate(fleet.configs)
    ]


_PLACEMENT = {
    "coolest-first": "placement coolest-first follows the inlets of the step before",
    "inlet-aware": "placement inlet-aware follows the inlets of the step before",
    "weights": "placement weights lets actions move work between racks",
}
"""Policies of placement whose work lies elsewhere than in the table."""


def no_table_reasons(fleet: Fleet) -> tuple[str | None, ...]:
    """Why the cost of a step follows from more than utilisation, setpoint and weather.

    Args:
        fleet: B data centers.

    Returns:
        The reasons of each data center in words, or None where its tables are exact, B.
    """
    return tuple("; ".join(_reasons(config)) or None for config in fleet.configs)


def uncooled_reason(table: FacilityTable, utilisation: F64) -> str | None:
    """Why idle commands leave a table: steps in which no setpoint keeps up with the load.

    Args:
        table: Table of the steps.
        utilisation: Utilisation of each step, 0..1, (T,).

    Returns:
        The reason in words; None where some setpoint does in every step.
    """
    cooled = (table.unmet_w == 0.0).any(axis=2)
    high = np.searchsorted(table.utilisation, utilisation).clip(1, len(table.utilisation) - 1)
    steps = np.arange(len(utilisation))
    # A utilisation at a node, if rounded, needs no more than that node.
    share = (utilisation - table.utilisation[high - 1]) / np.diff(table.utilisation)[high - 1]
    kept = (cooled[steps, high - 1] | (share > 1.0 - 1e-9)) & (cooled[steps, high] | (share < 1e-9))
    if kept.all():
        return None
    return (
        f"in {np.count_nonzero(~kept)} of {len(kept)} steps no setpoint cools the hall without "
        "heat that stays in the room or racks that throttle"
    )


def forced_discharge_reason(problem: Problem) -> str | None:
    """Why a battery that no plan moves may move: it delivers what the grid does not carry.

    Args:
        problem: Planning problem of the data center.

    Returns:
        The reason in words; None where the battery stays at rest.
    """
    table, limit_kw = problem.table, problem.grid_limit_kw
    most_kw = float(np.where(table.unmet_w == 0.0, table.facility_kwh, 0.0).max()) / problem.step_h
    if "battery" in problem.agents or problem.storage.stored_kwh <= 0 or most_kw <= limit_kw:
        return None
    return (
        f"the facility may need {most_kw:.4g} kW where the grid connection carries {limit_kw:.4g}, "
        "and a battery that plans do not move then delivers the difference"
    )


def _reasons(config: DataCenterConfig) -> list[str]:
    """Reasons why the table of a data center is not exact, in words."""
    events = config.events
    reasons = []
    if config.simulation.thermal == "transient":
        reasons.append("servers and air of transient halls remember their temperatures")
    if events.scheduled:
        kinds = ", ".join(sorted({event.kind for event in events.scheduled}))
        reasons.append(f"scheduled events change the plant or the weather on the way ({kinds})")
    if events.sampled:
        kinds = ", ".join(sorted({event.kind for event in events.sampled}))
        reasons.append(f"sampled events are not known in advance ({kinds})")
    if config.workload.placement in _PLACEMENT:
        reasons.append(_PLACEMENT[config.workload.placement])
    if config.hvac.crac.flow_model == "controlled":
        reasons.append("actions move the fans (flow model controlled)")
    return reasons
