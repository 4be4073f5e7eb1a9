"""Simulation of plans: commands that follow target states, resulting figures, and constraints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from sdc_taichi.config.liquid_schema import APPROACH_LIMITS_K
from sdc_taichi.optimum.loop_map import LOOP_COMMANDS
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.problem import Problem, arrived_tasks
from sdc_taichi.optimum.tables import (
    INLET_MARGIN_K,
    at_utilisation,
    coolest_inlet_c,
    facility_kwh,
)
from sdc_taichi.plant.battery import (
    BATTERIES,
    BatteryParameters,
    BatteryPoint,
    Conversion,
    conversion,
)
from sdc_taichi.plant.cooling import avoid_repeats
from sdc_taichi.plant.workload import RELEASED_QUEUE_TASKS, TASKS_PER_STEP, arriving_tasks
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.facility import battery_parameters
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.workload import (
    due_entries,
    due_steps,
    due_work,
    queue_length,
    queue_limit_tasks,
)
from sdc_taichi.types import F64, I64, Actions, State, StepResult


@dataclass(frozen=True, slots=True)
class Targets:
    """Target states of B data centers in each of T steps.

    Later steps compensate for a target that a step misses.
    """

    queue_tasks: F64
    """Work in the queue after each step, in tasks, (T, B); nan means a neutral load command."""
    setpoint_c: F64
    """Setpoint of each step, in C, (T, B)."""
    stored_kwh: F64
    """Energy stored after each step, in kWh, (T, B); nan means an idle battery."""
    facility_kwh: F64
    """Expected energy of the facility in each step, in kWh, (T, B)."""
    loops: F64
    """Commands of the coolant loops in each step, (T, B, 3): supply setpoint in C, flow as a share
    of design, and approach in K; nan means held loops."""


@dataclass(frozen=True, slots=True)
class RollOut:
    """Simulated results of B data centers in each of T steps."""

    facility_kwh: F64
    """Energy of the facility without its battery, in kWh, (T, B)."""
    grid_kwh: F64
    """Energy bought, in kWh, (T, B)."""
    carbon_g: F64
    """Emissions of the energy bought, in g CO2e, (T, B)."""
    energy_cost: F64
    """Cost of the energy bought, in the currency of the tariff, (T, B)."""
    queue_tasks: F64
    """Work in the queue after each step, in tasks, (T, B)."""
    stored_kwh: F64
    """Energy stored after each step, in kWh, (T, B)."""
    setpoint_c: F64
    """Mean setpoint of the CRAC units, in C, (T, B)."""
    inlet_max_c: F64
    """Highest inlet temperature of all servers, in C, (T, B)."""
    dropped_tasks: F64
    """Work dropped because the queue was full, in tasks, (T, B)."""
    utilisation: F64
    """Executed work, as a share of capacity, (T, B)."""
    load_command: F64
    """Load command, -1..1, (T, B)."""
    cooling_command: F64
    """Cooling command, in steps of the setpoint, (T, B)."""
    battery_command: F64
    """Battery command, -1..1, (T, B)."""
    loops_lag_k: F64
    """Largest difference between the supply setpoint of a CDU and its target, in K, (T, B)."""

    def of(self, where: Sequence[int]) -> RollOut:
        """Return the results of some of the data centers."""
        return RollOut(*(getattr(self, f.name)[:, list(where)] for f in fields(self)))


def roll_out(
    fleet: Fleet,
    drivers: Drivers,
    targets: Targets,
    *,
    start: I64,
    objective: Objective,
    scored_from: int = 0,
    seed: int | I64 = 0,
    precision: Precision = "f32",
    on_step: Callable[[], None] = lambda: None,
) -> tuple[RollOut, Score]:
    """Simulate B data centers with commands that follow target states.

    The commands of a step are computed from the simulator's state before the step. All CRAC units
    of a data center have the same setpoint.

    Args:
        fleet: B data centers.
        drivers: Inputs of the data centers.
        targets: Target states of each step.
        start: First step of each data center, counted from the beginning of the year, (B,).
        objective: Objective whose value the figure is.
        scored_from: Number of the first scored step.
        seed: Seed of the sampled events, one for all data centers or one for each, (B,).
        precision: Floating-point precision of the hall kernels.
        on_step: Called after every step; an error that it raises ends the work.

    Returns:
        Results of all steps, and their score.

    Raises:
        PhysicalLimitError: A result is outside the physical limits.
    """
    steps = len(targets.setpoint_c)
    with Simulator(fleet, drivers=drivers, precision=precision) as sim:
        sim.reset(seed, start=start)
        follower = Follower(fleet, sim.drivers, sim.sizing, targets)
        score = Score(objective, sim, scored_from)
        done = {f.name: np.empty((steps, fleet.size)) for f in fields(RollOut)}
        lag_k = done.pop("loops_lag_k")
        for t in range(steps):
            result: StepResult = sim.step(follower.actions(sim.state))
            score.add(result)
            for name, values in done.items():
                values[t] = getattr(result, name)
            lag_k[t] = follower.loops_lag_k(sim.state)
            on_step()
    return RollOut(**done, loops_lag_k=lag_k), score


class Follower:
    """Computes commands that bring B data centers to their target states.

    Args:
        fleet: B data centers.
        drivers: Inputs of the data centers, with the first step of the run.
        sizing: Device sizes of the data centers.
        targets: Target states of each step.
    """

    def __init__(self, fleet: Fleet, drivers: Drivers, sizing: Sizing, targets: Targets) -> None:
        v, models = fleet.values, fleet.models
        self._fleet, self._drivers, self._targets = fleet, drivers, targets
        self._step_h = 1.0 / fleet.steps_per_hour
        self._work = {
            "flexible_share": v("workload.flexible_share"),
            "max_utilisation": v("workload.max_utilisation"),
            "queue_limit_tasks": queue_limit_tasks(fleet),
        }
        self._work_model, self._battery_model = models["workload"], models["battery"]
        self._due_entries = due_entries(queue_length(fleet), due_steps(fleet))
        self._battery = battery_parameters(fleet)
        self._capacity_kwh = sizing.battery_kwh
        self._converted = conversion(
            self._battery_model, self._battery, self._capacity_kwh, self._step_h
        )
        self._step_k = v("hvac.setpoint.step_k")[fleet.unit_dc]
        self._unit_dc = fleet.unit_dc
        self._loops = LoopFollower(fleet, targets.loops)

    def actions(self, state: State) -> Actions:
        """Return the commands of the coming step."""
        return Actions(
            load=self._load(state),
            cooling=self._cooling(state),
            battery=self._battery_command(state),
            **self._loops.commands(state),
        )

    def loops_lag_k(self, state: State) -> F64:
        """Return the largest difference between setpoint and target of a CDU, in K, (B,)."""
        lag_k = np.zeros(self._fleet.size)
        target_c = self._targets.loops[state.step - 1, self._fleet.cdu_dc, 0]
        apart_k = np.abs(state.cdu_setpoint_c - target_c)
        np.maximum.at(lag_k, self._fleet.cdu_dc, np.nan_to_num(apart_k))
        return lag_k

    def _load(self, state: State) -> F64:
        target = self._targets.queue_tasks[state.step]
        moves = ~np.isnan(target)
        if not moves.any():
            return np.zeros(len(target))
        queue, demand = state.queue, self._drivers.at(state.step).demand
        arrived = arrived_tasks(self._work_model, demand, self._work["flexible_share"])
        command = load_command(
            queue[:, -1] + arrived - np.where(moves, target, 0.0),
            model=self._work_model,
            demand=demand,
            waiting_tasks=queue[:, -1],
            due_tasks=due_work(queue, self._due_entries),
            **self._work,
        )
        return np.where(moves, command, 0.0)

    def _cooling(self, state: State) -> F64:
        rise_k = self._targets.setpoint_c[state.step][self._unit_dc] - state.setpoint_c
        return avoid_repeats(rise_k / self._step_k, state.cooling_last)

    def _battery_command(self, state: State) -> F64:
        target, stored = self._targets.stored_kwh[state.step], state.stored_kwh
        moves = ~np.isnan(target)
        bus_kwh = bus_energy_kwh(np.where(moves, target, stored), stored, self._converted)
        return battery_command(
            bus_kwh,
            model=self._battery_model,
            stored_kwh=stored,
            load_kw=self._targets.facility_kwh[state.step] / self._step_h,
            step_h=self._step_h,
            capacity_kwh=self._capacity_kwh,
            parameters=self._battery,
        )


class LoopFollower:
    """Computes the commands of coolant loops from their values in each step.

    Args:
        fleet: B data centers.
        loops: Commands of each step, (T, B, 3), as in ``Targets``; nan holds the loops.
    """

    def __init__(self, fleet: Fleet, loops: F64) -> None:
        self._cdu_dc, self._wanted = fleet.cdu_dc, loops
        self._moves = not np.isnan(loops).all()
        sections = [config.liquid for config in fleet.configs]
        self._held_approach_k = np.array(
            [APPROACH_LIMITS_K[0] if s is None else s.cdus.approach_k for s in sections]
        )

    def commands(self, state: State) -> dict[str, F64]:
        """Return the commands of the coming step by field of ``Actions``; empty if all hold."""
        if not self._moves:
            return {}
        setpoint_c, flow, wanted_k = self._wanted[state.step].T
        held = state.cdu_setpoint_c, state.cdu_flow, self._held_approach_k
        wanted = setpoint_c[self._cdu_dc], flow[self._cdu_dc], wanted_k
        values = (np.where(np.isnan(x), hold, x) for x, hold in zip(wanted, held, strict=True))
        return dict(zip(LOOP_COMMANDS, values, strict=True))


def load_command(
    executed_tasks: F64,
    *,
    model: str,
    demand: F64,
    waiting_tasks: F64,
    due_tasks: F64,
    flexible_share: F64,
    max_utilisation: F64,
    queue_limit_tasks: F64,
) -> F64:
    """Return the load command under which a step executes a given amount of work, (B,).

    The function inverts the workload models of ``plant.workload``. If the amount is impossible, the
    command comes as close as it can. Due work is always executed. Deferred work never exceeds the
    room in the queue, so following a plan drops no work. Models of whole tasks execute the
    nearest whole number.

    Args:
        executed_tasks: work to execute, in tasks, (B,).
        model: name of the workload model.
        demand: work that arrives, as a share of capacity, 0..1, (B,).
        waiting_tasks: work in the queue, in tasks, (B,).
        due_tasks: work in the queue whose deadline has come, in tasks, (B,).
        flexible_share: share of the demand that may wait, 0..1, (B,).
        max_utilisation: highest utilisation, 0..1, (B,).
        queue_limit_tasks: longest queue, in tasks, (B,).
    """
    values = (executed_tasks, demand, waiting_tasks, due_tasks)
    limits = (flexible_share, max_utilisation, queue_limit_tasks)
    if model == "fluid":
        return _fluid_command(*values, *limits)
    return _whole_command(*values, *limits, is_released=model == "released")


def _fluid_command(
    executed: F64, demand: F64, waiting: F64, due: F64, flexible_share: F64, cap: F64, limit: F64
) -> F64:
    """Return the load command for workload model ``fluid``, (B,); see ``load_command``."""
    arrived, capacity = demand * TASKS_PER_STEP, cap * TASKS_PER_STEP
    forced = np.minimum(due, capacity)
    room = np.maximum(limit - (waiting - forced), 0.0)
    most_held_back = np.minimum(flexible_share * arrived, room)
    neutral = np.minimum(arrived, capacity - forced) + forced
    drain = _share(executed - neutral, capacity - neutral)
    defer = _share(
        np.minimum(arrived + forced - executed, most_held_back), flexible_share * arrived
    )
    return np.where(executed >= neutral, drain, -defer)


def _whole_command(
    executed: F64,
    demand: F64,
    waiting: F64,
    due: F64,
    flexible_share: F64,
    cap: F64,
    limit: F64,
    *,
    is_released: bool,
) -> F64:
    """Return the load command for the models of whole tasks, (B,); see ``load_command``."""
    arrived, flexible = arriving_tasks(demand, flexible_share)
    capacity = most_queued = np.floor(cap * TASKS_PER_STEP)
    forced = np.minimum(due, capacity)
    if is_released:
        most_queued = np.minimum(capacity, RELEASED_QUEUE_TASKS)
        forced = np.minimum(due, np.maximum(most_queued - arrived, 0.0))
    room = np.maximum(limit - (waiting - forced), 0.0)
    now = np.minimum(arrived, capacity - forced)
    more = np.rint(executed - now - forced)
    free = np.maximum(most_queued - now - forced, 0.0)
    drainable = np.minimum(np.minimum(waiting - forced, flexible), free)
    held_back = np.minimum(np.minimum(arrived - now - more, flexible), np.floor(room))
    # The workload models round down, so half a task is added to obtain exactly the whole number.
    drain = np.where(more > 0, _share(more + 0.5, drainable), 0.0)
    defer = np.where(held_back > 0, _share(held_back + 0.5, flexible), 0.0)
    return np.where(more >= 0, drain, -defer)


def battery_command(
    bus_kwh: F64,
    *,
    model: str,
    stored_kwh: F64,
    load_kw: F64,
    step_h: float,
    capacity_kwh: F64,
    parameters: BatteryParameters,
) -> F64:
    """Return the battery command under which a step draws or delivers a given energy, (B,).

    If the energy is impossible, the command comes as close as it can.

    Args:
        bus_kwh: energy that the battery draws from the bus, standby included, in kWh, (B,);
            negative if it delivers.
        model: name of the battery model.
        stored_kwh: stored energy before the step, in kWh, (B,).
        load_kw: expected power of the facility, in kW, (B,).
        step_h: length of the step, in h.
        capacity_kwh: capacity of the battery, in kWh, (B,).
        parameters: efficiencies, rates and limits, (B,) each. The limit of the grid connection is
            ignored here; the simulator applies it.
    """
    standby_kwh = conversion(model, parameters, capacity_kwh, step_h).standby_kwh
    charges = bus_kwh >= standby_kwh
    full = BATTERIES[model].step(
        stored_kwh,
        np.where(charges, 1.0, -1.0),
        BatteryPoint(capacity_kwh, load_kw, step_h, parameters),
    )
    full_kwh = full.charge_kwh - full.discharge_kwh - standby_kwh
    share = _share(np.abs(bus_kwh - standby_kwh), np.abs(full_kwh))
    return np.where(charges, share, -share)


def bus_energy_kwh(target_kwh: F64, stored_kwh: F64, converted: Conversion) -> F64:
    """Return the energy that a battery must draw from the bus to store a target energy, kWh, (B,).

    The energy is negative if the battery must deliver.

    Args:
        target_kwh: target of the stored energy, in kWh, (B,).
        stored_kwh: stored energy, in kWh, (B,).
        converted: conversion between bus and store in a step, (B,).
    """
    rise_kwh = target_kwh - stored_kwh
    drawn_kwh = converted.drawn_kwh(np.maximum(rise_kwh, 0.0))
    return np.asarray(
        drawn_kwh - converted.delivered_kwh(np.maximum(-rise_kwh, 0.0)) + converted.standby_kwh
    )


def _share(part: F64, whole: F64) -> F64:
    """Return part divided by whole, clipped to 0..1; 0 if the whole is not positive."""
    some = whole > 0
    return np.where(some, np.clip(part / np.where(some, whole, 1.0), 0.0, 1.0), 0.0)


LARGEST_TABLE_ERROR = 1e-4
"""Maximum error of a table, as a share of the energy, for a bound to count as ``bound``. Larger
errors make it an ``estimate``."""
_LEAST_TASKS = 1e-6
"""Tolerance of constraints on work for rounding errors, in tasks."""
LEAST_K = 1e-3
"""Tolerance of temperature limits for the precision of the kernels, in K."""
_LEAST_STORED_SHARE = 1e-6
"""Tolerance of the stored energy at the end, as a share of capacity."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """Measurements in the scored steps of one simulated plan of a data center."""

    figure: float
    """Value of the objective in the scored steps."""
    table_error: float
    """Relative error of the table: the sum of absolute differences between simulated and tabulated
    energy of each step, divided by the simulated energy of these steps. Steps in which supply
    setpoints of coolant loops are still on the way to their targets do not count."""
    start_kwh: float
    """Energy stored at the first scored step, in kWh."""
    end_kwh: float
    """Energy stored at the end, in kWh."""
    start_tasks: float
    """Work that waits at the first scored step, in tasks."""
    end_tasks: float
    """Work that waits at the end, in tasks."""
    dropped_tasks: float
    """Work dropped because the queue is full, in tasks."""
    overdue_tasks: float
    """Maximum due work that a step cannot execute, in tasks."""
    hottest_inlet_c: float
    """Highest inlet temperature, in C."""
    over_limit_k: float
    """Maximum excess of an inlet over the limit, in K. In steps in which no setpoint satisfies the
    limit, the lowest inlet temperature of all setpoints takes its place."""
    inlet_limit_c: float
    """Limit of inlet temperatures, in C; inf without a limit."""
    reachable_limit_c: float
    """Lowest limit, at least ``inlet_limit_c``, that some setpoint satisfies in each step, in C."""
    unmet_kwh: float
    """Heat that the cooling does not remove from the room, in kWh."""

    def failures(self, idle: Certificate, capacity_kwh: float) -> tuple[str, ...]:
        """Return the constraints that the plan breaks, in words; empty for a valid plan."""
        return (*self.worse_ends(capacity_kwh), *self.broken(idle))

    def worse_ends(self, capacity_kwh: float) -> tuple[str, ...]:
        """Return in words how the end state is worse than that of the first scored step."""
        missing_kwh = self.missing_kwh(capacity_kwh)
        more_tasks = self.end_tasks - self.start_tasks
        texts = []
        if missing_kwh > 0.0:
            texts.append(f"ends with {missing_kwh:.4g} kWh less in the battery")
        if more_tasks > _LEAST_TASKS:
            texts.append(f"ends with {more_tasks:.4g} tasks more in the queue")
        return tuple(texts)

    def missing_kwh(self, capacity_kwh: float) -> float:
        """Return the stored energy that the end lacks, in kWh; 0 within rounding errors."""
        missing_kwh = self.start_kwh - self.end_kwh
        return missing_kwh if missing_kwh > _LEAST_STORED_SHARE * capacity_kwh else 0.0

    def broken(self, idle: Certificate) -> tuple[str, ...]:
        """Return the constraints on work and temperatures that the plan breaks, in words."""
        hot = ""
        if self.over_limit_k > LEAST_K:
            over_k = self.hottest_inlet_c - self.inlet_limit_c
            hot = f"has inlets up to {over_k:.3g} K over the limit of {self.inlet_limit_c:g} C"
            if over_k > self.over_limit_k + LEAST_K:
                hot += f", {self.over_limit_k:.3g} K over the least possible in a step"
        texts = broken_constraints(
            self.dropped_tasks - idle.dropped_tasks,
            (self.overdue_tasks, idle.overdue_tasks),
            hot,
            (self.unmet_kwh, idle.unmet_kwh),
        )
        return tuple(texts)


def broken_constraints(
    dropped_more: float, overdue: tuple[float, float], hot: str, unmet_kwh: tuple[float, float]
) -> list[str]:
    """Return the constraints that a run breaks, compared with a reference run, in words.

    Args:
        dropped_more: Work dropped in addition to that under idle commands, in tasks.
        overdue: Maximum overdue work of the run and of the reference run, in tasks.
        hot: Text about inlets above their limit; empty if there are none.
        unmet_kwh: Heat not removed from the room in the run and in the reference run, in kWh.
    """
    texts = []
    if dropped_more > _LEAST_TASKS:
        texts.append(f"drops {dropped_more:.4g} tasks more than idle commands")
    if overdue[0] > overdue[1] + _LEAST_TASKS:
        texts.append(f"leaves up to {overdue[0]:.4g} tasks overdue")
    if hot:
        texts.append(hot)
    if unmet_kwh[0] > unmet_kwh[1] * (1.0 + 1e-6) + 1e-6:
        texts.append(f"leaves {unmet_kwh[0]:.4g} kWh of heat in the room")
    return texts


def certificate(problem: Problem, done: RollOut, score: Score, i: int) -> Certificate:
    """Measure the constraints, the figure and the table error of one simulated plan.

    Args:
        problem: Planning problem of the data center, with the agents that the plan moves.
        done: Simulated results of this plan alone.
        score: Score of all plans that were simulated together.
        i: Index of this plan in the score.
    """
    scored = slice(problem.scored_from, None)
    measured = done.facility_kwh[scored, 0]
    expected = facility_kwh(problem.table, done.utilisation[:, 0], done.setpoint_c[:, 0])
    limits_c = _reachable_limits_c(problem, done)
    settled = done.loops_lag_k[scored, 0] <= LEAST_K
    apart = np.abs(expected[scored] - measured)[settled].sum()
    has_limit = np.isfinite(problem.inlet_limit_c)
    over_k = done.inlet_max_c[:, 0] - limits_c if has_limit else np.zeros(problem.steps)
    return Certificate(
        figure=float(score.figure[i]),
        table_error=float(apart / measured[settled].sum()) if settled.any() else 0.0,
        start_kwh=float(score.start_kwh[i]),
        end_kwh=float(score.end_kwh[i]),
        start_tasks=float(score.start_tasks[i]),
        end_tasks=float(score.end_tasks[i]),
        dropped_tasks=float(score.dropped_tasks[i]),
        overdue_tasks=float(score.most_overdue_tasks[i]),
        hottest_inlet_c=float(score.hottest_inlet_c[i]),
        over_limit_k=float(over_k[scored].max()),
        inlet_limit_c=problem.inlet_limit_c,
        reachable_limit_c=float(limits_c[scored].max()),
        unmet_kwh=float(score.unmet_kwh[i]),
    )


def _reachable_limits_c(problem: Problem, done: RollOut) -> F64:
    """Return the lowest limit of inlets that some setpoint satisfies in each step, in C, (T,).

    It is the limit of the problem where some setpoint satisfies this limit.
    """
    table, limit_c = problem.table, problem.inlet_limit_c
    if np.isinf(limit_c):
        return np.full(problem.steps, limit_c)
    inlet_c, unmet_w = (
        at_utilisation(values, table.utilisation, done.utilisation[:, 0])
        for values in (table.inlet_max_c, table.unmet_w)
    )
    coolest_c = coolest_inlet_c(inlet_c, unmet_w)[:, 0]
    return np.asarray(np.maximum(limit_c, coolest_c + INLET_MARGIN_K))
