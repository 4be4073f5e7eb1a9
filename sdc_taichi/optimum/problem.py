"""Planning problem of one data center for T steps: tables, weights, work, battery and limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.hall.air_metrics import allowable_c
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.tables import FacilityTable
from sdc_taichi.plant.battery import BatteryParameters, Conversion, conversion
from sdc_taichi.plant.electrical import NO_LIMIT_KW
from sdc_taichi.plant.workload import MODELS as WORK_MODELS
from sdc_taichi.plant.workload import (
    RELEASED_QUEUE_TASKS,
    TASKS_PER_STEP,
    UNLIMITED_TASKS,
    WorkPoint,
    arriving_tasks,
)
from sdc_taichi.sim.bills import month_around
from sdc_taichi.sim.crac_units import schedules_c
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.workload import Workload, due_steps, queue_limit_tasks
from sdc_taichi.types import F64, I64

Agent = Literal["load", "cooling", "battery", "liquid"]
AGENTS: tuple[Agent, ...] = ("load", "cooling", "battery")
"""Agents of every data center that a plan may control, named by their fields of ``Actions``."""
ALL_AGENTS: tuple[Agent, ...] = (*AGENTS, "liquid")
"""All agents that a plan may control; ``liquid`` commands the coolant loops where there are any."""
RAMP_K = 2.0
"""Maximum change of the setpoint in a step, in K, equal to the default of environments."""


class StoppedError(SdcError):
    """The caller stopped the optimisation; the message says which results are cached."""


@dataclass(frozen=True, slots=True)
class FlexibleWork:
    """Arriving work of T steps and the part that may wait, in tasks.

    A task is 1 % of the work of a step at full load.
    """

    arrived_tasks: F64
    """Work that arrives in each step, in tasks, (T,)."""
    idle_tasks: F64
    """Work executed in each step under idle commands, in tasks, (T,)."""
    most_deferred_tasks: F64
    """Maximum arriving work that can be deferred in each step, in tasks, (T,)."""
    most_executed_tasks: F64
    """Maximum work that can be executed in each step, in tasks, (T,)."""
    queue_limit_tasks: float
    """Maximum length of the queue, in tasks; inf without a limit."""
    deadline_steps: int | None
    """Number of steps after which deferred work must be executed; None means no deadline."""
    model: str
    """Name of the workload model, see ``plant.workload``."""
    most_dropped_tasks: float = 0.0
    """Maximum work that may be dropped in all scored steps, in tasks; equal to the work dropped
    under idle commands."""


@dataclass(frozen=True, slots=True)
class Storage:
    """A battery, described by the parameters of ``plant.battery``."""

    model: str
    """Name of the battery model: ``clc``, ``paper`` or ``released``."""
    capacity_kwh: float
    """Capacity, in kWh."""
    stored_kwh: float
    """Energy stored before the first step, in kWh."""
    charge_efficiency: float
    """Ratio of stored energy to energy drawn."""
    discharge_factor: float
    """Ratio of energy taken from the store to energy delivered."""
    charge_limit_c_rate: float
    """Maximum charge rate into the store, in capacities per hour."""
    discharge_limit_c_rate: float
    """Maximum discharge rate out of the store, in capacities per hour."""
    upper_u_h: float
    """Slope of the maximum stored energy with respect to charge power, in h (kWh per kW)."""
    upper_v: float
    """Maximum stored energy at zero charge power, as a share of capacity."""
    lower_u_h: float
    """Slope of the minimum stored energy with respect to discharge power, in h (kWh per kW)."""
    lower_v: float
    """Minimum stored energy at zero discharge power, as a share of capacity."""
    square_loss_h: float = 0.0
    """Loss of conversion that rises with the square of the power, times the capacity and divided by
    this square, in h."""
    standby_per_h: float = 0.0
    """Power drawn from the bus at all times, divided by the capacity, in 1/h."""

    def conversion(self, step_h: float) -> Conversion:
        """Return the conversion between bus and store in a step."""
        parameters = BatteryParameters(*(getattr(self, name) for name in BatteryParameters._fields))
        return conversion(self.model, parameters, self.capacity_kwh, step_h)


@dataclass(frozen=True, slots=True)
class BilledMonth:
    """The scored part of a calendar month with a demand charge."""

    first: int
    """Number of the first scored step of the month, counted from the first step of the plan."""
    end: int
    """Number of the first step after the scored part of the month."""
    weight_per_kw: float
    """Weight per kW of the month's highest power, where power is the mean of a step."""


@dataclass(frozen=True, slots=True)
class Ends:
    """States of a plan at its first scored step and at its end.

    Without ``Ends`` a plan must end with at least the stored energy and at most the queue of its
    first scored step.
    """

    start_kwh: float
    """Energy stored at the first scored step, in kWh."""
    start_tasks: float
    """Work of any age that waits at the first scored step, in tasks."""
    end_kwh: float
    """Minimum energy stored at the end, in kWh."""
    end_tasks: float
    """Maximum work that waits at the end, in tasks."""


@dataclass(frozen=True, slots=True)
class Problem:
    """Planning problem of one data center in a run of T steps."""

    name: str
    """Name of the data center."""
    step_h: float
    """Length of a step, in h."""
    agents: tuple[Agent, ...]
    """Agents that the plan may control; the others follow ``work.idle_tasks``, ``idle_setpoint_c``
    and ``battery_kwh``."""
    table: FacilityTable
    """Energy, water and inlet temperature of each step, by utilisation and setpoint."""
    kwh_weight: F64
    """Weight of a kWh bought in each step, (T,); 0 in steps that are not scored."""
    litre_weight: float
    """Weight of a litre of make-up water."""
    months: tuple[BilledMonth, ...]
    """Months with a demand charge."""
    work: FlexibleWork
    """Arriving work and limits of its execution."""
    storage: Storage
    """The battery; without a battery its capacity is 0."""
    grid_limit_kw: float
    """Power bought at which the battery stops charging, in kW; inf without a limit."""
    inlet_limit_c: float
    """Highest inlet temperature that a plan may cause if another setpoint avoids it, in C; inf
    without a limit."""
    idle_setpoint_c: F64
    """Setpoint of each step under idle commands, in C, (T,)."""
    setpoint_c: float
    """Setpoint before the first step, in C."""
    ramp_k: float
    """Maximum change of the setpoint between two steps, in K."""
    scored_from: int
    """Number of the first scored step."""
    battery_kwh: F64 | None = None
    """Energy that a battery outside ``agents`` draws from the bus in each step, standby included,
    in kWh, (T,); negative where the battery delivers. None means an idle battery."""
    held: FacilityTable | None = None
    """Table with held coolant loops; None where ``table`` is that."""
    loops_error: float = 0.0
    """Energy by which the commands of coolant loops in ``table`` exceed the best ones, relative."""
    end_margin_kwh: float = 0.0
    """Energy that the plan of a battery stores at the end beyond what the end needs, in kWh."""

    @property
    def steps(self) -> int:
        """Number of steps, T."""
        return len(self.kwh_weight)

    def moving(self, agents: tuple[Agent, ...]) -> Problem:
        """Return the problem of a plan that controls only some of the agents."""
        if self.held is None or "liquid" in agents:
            return replace(self, agents=agents)
        return replace(self, agents=agents, table=self.held, held=None)


def movable_agents(fleet: Fleet) -> tuple[Agent, ...]:
    """Return the agents that a plan may control in a fleet."""
    return ALL_AGENTS if fleet.cdus else AGENTS


def require_traces(fleet: Fleet) -> None:
    """Check that the arriving work of every data center is that of a trace, which plans need.

    Raises:
        ConfigError: A data center has loads by zone.
    """
    for config in fleet.configs:
        if config.workload.zone_loads is not None:
            raise ConfigError(
                f"{config.name}: workload.zone_loads: plans need the work of a trace; valid is null"
            )


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
    held: Sequence[FacilityTable] | None = None,
) -> list[Problem]:
    """Create the planning problem of each data center of a fleet.

    Args:
        fleet: B data centers.
        drivers: Inputs of the data centers, including prices.
        sizing: Device sizes of the data centers.
        tables: Tables of the T steps of each data center, B.
        start: First step of each data center, counted from the beginning of the year, (B,).
        objective: Objective that the plans minimise.
        agents: Agents that the plans may control.
        scored_from: Number of the first scored step.
        inlet_limit_c: Highest inlet temperature that a plan may cause if another setpoint avoids
            it, in C. None means the limit of ``protection.ashrae_class``, or no limit without it.
        ramp_k: Maximum change of the setpoint in a step, in K.
        held: Tables with held coolant loops; None where ``tables`` are that.
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
            held=None if held is None else held[i],
        )
        for i, name in enumerate(fleet.names)
    ]


def inlet_limits_c(fleet: Fleet, given_c: float | None = None) -> F64:
    """Return the limit of inlet temperatures of each data center, in C, (B,); inf without a limit.

    Args:
        fleet: B data centers.
        given_c: Common limit, in C; None means the limits of ``protection.ashrae_class``.
    """
    if given_c is not None:
        return np.full(fleet.size, given_c)
    classes = [config.protection.ashrae_class for config in fleet.configs]
    return np.array([np.inf if c is None else allowable_c(c)[1] for c in classes])


def _idle_setpoint_c(fleet: Fleet, index: I64) -> F64:
    """Return the setpoints under idle commands, in C, (B, T): scheduled, or else initial ones."""
    initial_c = np.repeat(fleet.values("hvac.setpoint.initial_c")[:, None], index.shape[1], axis=1)
    schedules = schedules_c(fleet)
    if schedules is None:
        return initial_c
    scheduled_c = schedules.at(index)
    return np.where(np.isnan(scheduled_c), initial_c, scheduled_c)


def _months(
    start: int, steps: int, scored_from: int, steps_per_hour: int, weight_per_kw: float
) -> tuple[BilledMonth, ...]:
    """Return the months of a run with a demand charge; there are none if the weight is 0.

    The charge of a partly scored month is proportional to the scored part, as in ``sim.bills``.
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
    """Compute the work of each of B data centers from the demand, a share of capacity, (B, T)."""
    model = fleet.models["workload"]
    limits, due = queue_limit_tasks(fleet), due_steps(fleet)
    idle_tasks, dropped_tasks = _under_idle_commands(fleet, demand)
    works = []
    for i, config in enumerate(fleet.configs):
        share = config.workload.flexible_share
        cap = config.workload.max_utilisation * TASKS_PER_STEP
        arrived = arrived_tasks(model, demand[i], share)
        deadline = None if np.isinf(due[i]) else int(due[i])
        flexible = share * arrived
        if model != "fluid":
            cap = float(np.floor(cap))
            flexible = arriving_tasks(demand[i], share)[1]
        if model == "released":
            # Due work takes no capacity from arriving work.
            most_deferred = np.maximum(flexible, arrived - cap)
            most_executed = np.maximum(np.minimum(arrived, cap), min(cap, RELEASED_QUEUE_TASKS))
        else:
            most_deferred = _most_deferred(arrived, flexible, cap, deadline)
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
    """Return the arriving work as a workload model counts it, in tasks.

    Args:
        model: name of the workload model.
        demand: work that arrives, as a share of capacity, 0..1.
        flexible_share: share of the demand that may wait, 0..1.
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
    """Return executed and dropped work of each step under idle commands, in tasks, (B, T) each."""
    workload = Workload(fleet)
    queue, idle = workload.empty_queue(), np.zeros(fleet.size)
    done, dropped = np.empty(demand.shape), np.empty(demand.shape)
    for t in range(demand.shape[1]):
        work = workload.run(queue, demand[:, t], idle, 1.0)
        queue = work.queue
        done[:, t], dropped[:, t] = work.started_tasks, work.dropped_tasks
    workload.close()
    return done, dropped


def _most_deferred(arrived: F64, flexible: F64, cap: float, deadline: int | None) -> F64:
    """Return the maximum arriving work that can wait if due work runs first, in tasks, (T,).

    The flexible share may wait by choice. In addition, arriving work must wait if due work leaves
    no capacity for it. Due work is at most the work deferred one deadline earlier, provided that
    every step can execute all work that arrives in it. Otherwise all arriving work may have to
    wait.

    Args:
        arrived: Arriving work, in tasks, (T,).
        flexible: Arriving work that may wait by choice, in tasks, (T,).
        cap: Maximum work of a step, in tasks.
        deadline: Deadline in steps; None means no deadline.
    """
    most = flexible.copy()
    if np.any(arrived > cap):
        return arrived.copy()
    if deadline is None:
        return most
    for t in range(deadline, len(arrived)):
        most[t] = max(most[t], min(arrived[t], arrived[t] + most[t - deadline] - cap))
    return most


def _storage(fleet: Fleet, sizing: Sizing) -> list[Storage]:
    """Return the battery of each of B data centers at its initial state of charge."""
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
"""Placement policies for which a table is not exact, with the reason in words."""


def no_table_reasons(fleet: Fleet) -> tuple[str | None, ...]:
    """Return why the tables of data centers are not exact.

    A table is exact if the energy of a step follows from utilisation, setpoint and weather alone.

    Returns:
        Reasons for each data center in words, or None if its table is exact, B.
    """
    return tuple("; ".join(_reasons(config)) or None for config in fleet.configs)


def uncooled_reason(table: FacilityTable, utilisation: F64) -> str | None:
    """Return why idle commands leave the range of a table: steps that no setpoint can cool.

    Args:
        table: Table of the steps.
        utilisation: Utilisation of each step under idle commands, 0..1, (T,).

    Returns:
        The reason in words, or None if some setpoint can cool the hall in every step.
    """
    cooled = (table.unmet_w == 0.0).any(axis=2)
    high = np.searchsorted(table.utilisation, utilisation).clip(1, len(table.utilisation) - 1)
    steps = np.arange(len(utilisation))
    # A utilisation that equals a node up to rounding depends on this node alone.
    share = (utilisation - table.utilisation[high - 1]) / np.diff(table.utilisation)[high - 1]
    kept = (cooled[steps, high - 1] | (share > 1.0 - 1e-9)) & (cooled[steps, high] | (share < 1e-9))
    if kept.all():
        return None
    return (
        f"in {np.count_nonzero(~kept)} of {len(kept)} steps no setpoint cools the hall without "
        "heat that stays in the room or racks that throttle"
    )


def forced_discharge_reason(problem: Problem) -> str | None:
    """Return why an idle battery may discharge: the load may exceed the grid connection's limit.

    Returns:
        The reason in words, or None if an idle battery never discharges.
    """
    table, limit_kw = problem.table, problem.grid_limit_kw
    most_kwh = float(np.where(table.unmet_w == 0.0, table.facility_kwh, 0.0).max())
    standby_kwh = float(problem.storage.conversion(problem.step_h).standby_kwh)
    most_kw = (most_kwh + standby_kwh) / problem.step_h
    if "battery" in problem.agents or problem.storage.stored_kwh <= 0 or most_kw <= limit_kw:
        return None
    return (
        f"the facility may need {most_kw:.4g} kW where the grid connection carries {limit_kw:.4g}, "
        "and a battery that plans do not move then delivers the difference"
    )


def _reasons(config: DataCenterConfig) -> list[str]:
    """Return all reasons why the table of a data center is not exact, in words."""
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


def loops_reason(problem: Problem, config: DataCenterConfig) -> str | None:
    """Return why the commands of coolant loops in a table may not be the best ones.

    Returns:
        The reason in words, or None if they are the best ones or loops are held.
    """
    if problem.table.loops is None or config.liquid is None:
        return None
    if problem.litre_weight > 0:
        return "the tables of coolant loops hold the commands of least energy, not of least water"
    if config.workload.placement != "uniform":
        return (
            "the tables of coolant loops are of equal loads on all racks, not of placement "
            f"{config.workload.placement}"
        )
    if np.isinf(problem.loops_error):
        return "commands of the tables of coolant loops throttle GPUs, and others do not"
    return None
