"""Plans run by the simulator itself, what that comes to, and whether it keeps the constraints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from sdc_taichi.optimum.commands import (
    arrived_tasks,
    battery_command,
    bus_energy_kwh,
    load_command,
    setpoint_command,
)
from sdc_taichi.optimum.objective import Objective, Score
from sdc_taichi.optimum.problem import Problem
from sdc_taichi.optimum.tables import (
    INLET_MARGIN_K,
    at_utilisation,
    coolest_inlet_c,
    facility_kwh,
)
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.facility import battery_parameters
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.workload import due_entries, due_steps, due_work, queue_limit_tasks
from sdc_taichi.types import F64, I64, Actions, State, StepResult

Stop = Callable[[], bool]
"""Function that returns whether to end the work; called before every step."""
OnStep = Callable[[], None]
"""Called after every step that a simulator has done."""


@dataclass(frozen=True, slots=True)
class Targets:
    """States that B data centers are to reach in T steps.

    A step that falls short of its target is made up for by the steps after it.
    """

    queue_tasks: F64
    """Work in the queue after each step, in tasks, (T, B); nan leaves the load command neutral."""
    setpoint_c: F64
    """Setpoint of each step, in C, (T, B)."""
    stored_kwh: F64
    """Energy stored after each step, in kWh, (T, B); nan leaves the battery idle."""
    facility_kwh: F64
    """Energy that the facility is expected to need in each step, in kWh, (T, B)."""


@dataclass(frozen=True, slots=True)
class RollOut:
    """What the simulator did in T steps of B data centers."""

    facility_kwh: F64
    """Energy of the facility without its battery, in kWh, (T, B)."""
    grid_kwh: F64
    """Energy bought, in kWh, (T, B)."""
    carbon_g: F64
    """Emissions of the energy bought, in g CO2e, (T, B)."""
    energy_cost: F64
    """Price of the energy bought, in the currency of the tariff, (T, B)."""
    queue_tasks: F64
    """Work in the queue after each step, in tasks, (T, B)."""
    stored_kwh: F64
    """Energy stored after each step, in kWh, (T, B)."""
    setpoint_c: F64
    """Mean setpoint of the CRAC units, in C, (T, B)."""
    inlet_max_c: F64
    """Hottest inlet of a server, in C, (T, B)."""
    dropped_tasks: F64
    """Work that found the queue full, in tasks, (T, B)."""
    utilisation: F64
    """Work that was started, as a share of capacity, (T, B)."""
    load_command: F64
    """Load command, -1..1, (T, B)."""
    cooling_command: F64
    """Cooling command, in steps of the setpoint, (T, B)."""
    battery_command: F64
    """Battery command, -1..1, (T, B)."""

    def of(self, where: Sequence[int]) -> RollOut:
        """Copy with some of the data centers.

        Args:
            where: their numbers.
        """
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
    on_step: OnStep | None = None,
    stop: Stop | None = None,
) -> tuple[RollOut, Score] | None:
    """Run plans in the simulator: commands are computed at the true state of every step.

    All CRAC units of a data center move alike.

    Args:
        fleet: B data centers.
        drivers: Their inputs.
        targets: What they are to do.
        start: First step of each, counted from the beginning of the year, (B,).
        objective: What is minimised.
        scored_from: First step that is scored.
        seed: Of the sampled events, one for all or for each data center, (B,).
        precision: Of the hall kernels.
        on_step: Called after every step.
        stop: Asked before every step.

    Returns:
        What they did, and its score; None where ``stop`` ended the work.

    Raises:
        PhysicalLimitError: A result that no data center can reach.
    """
    steps = len(targets.setpoint_c)
    with Simulator(fleet, drivers=drivers, precision=precision) as sim:
        sim.reset(seed, start=start)
        follow = Follower(sim, targets)
        score = Score(objective, sim, scored_from)
        done = {f.name: np.empty((steps, fleet.size)) for f in fields(RollOut)}
        for t in range(steps):
            if stop is not None and stop():
                return None
            result: StepResult = sim.step(follow.actions(sim.state))
            score.add(result)
            for name, values in done.items():
                values[t] = getattr(result, name)
            if on_step is not None:
                on_step()
    return RollOut(**done), score


class Followed(Protocol):
    """Data centers that are taken along a path, such as a simulator that has been reset."""

    @property
    def fleet(self) -> Fleet:
        """The data centers, B."""

    @property
    def drivers(self) -> Drivers:
        """Their inputs."""

    @property
    def sizing(self) -> Sizing:
        """Capacities of their devices."""

    @property
    def step_h(self) -> float:
        """Length of a step, in h."""

    @property
    def state(self) -> State:
        """Their state before the first step."""


class Follower:
    """Commands that take data centers to their targets.

    Args:
        of: The data centers before their first step.
        targets: What they are to do.
    """

    def __init__(self, of: Followed, targets: Targets) -> None:
        fleet = of.fleet
        v, models = fleet.values, fleet.models
        self._drivers, self._step_h, self._targets = of.drivers, of.step_h, targets
        self._work = {
            "flexible_share": v("workload.flexible_share"),
            "max_utilisation": v("workload.max_utilisation"),
            "queue_limit_tasks": queue_limit_tasks(fleet),
        }
        self._work_model, self._battery_model = models["workload"], models["battery"]
        self._due = due_entries(of.state.queue.shape[1], due_steps(fleet))
        self._battery = battery_parameters(fleet)
        loses = self._battery_model != "released"
        one = np.ones(fleet.size)
        self._efficiency = {
            name: getattr(self._battery, name) if loses else one
            for name in ("charge_efficiency", "discharge_factor")
        }
        self._capacity_kwh = of.sizing.battery_kwh
        self._step_k = v("hvac.setpoint.step_k")[fleet.unit_dc]
        self._unit_dc = fleet.unit_dc

    def actions(self, state: State) -> Actions:
        """Commands of the step to come.

        Args:
            state: State before the step.
        """
        return Actions(
            load=self._load(state), cooling=self._cooling(state), battery=self._battery_(state)
        )

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
            due_tasks=due_work(queue, self._due),
            **self._work,
        )
        return np.where(moves, command, 0.0)

    def _cooling(self, state: State) -> F64:
        return setpoint_command(
            self._targets.setpoint_c[state.step][self._unit_dc],
            setpoint_c=state.setpoint_c,
            step_k=self._step_k,
            last=state.cooling_last,
        )

    def _battery_(self, state: State) -> F64:
        target, stored = self._targets.stored_kwh[state.step], state.stored_kwh
        moves = ~np.isnan(target)
        bus_kwh = bus_energy_kwh(np.where(moves, target, stored), stored, **self._efficiency)
        return battery_command(
            bus_kwh,
            model=self._battery_model,
            stored_kwh=stored,
            load_kw=self._targets.facility_kwh[state.step] / self._step_h,
            step_h=self._step_h,
            capacity_kwh=self._capacity_kwh,
            parameters=self._battery,
        )


def repeated(fleet: Fleet, drivers: Drivers, start: I64, times: int) -> tuple[Fleet, Drivers, I64]:
    """Copies of a fleet in one: data center b of copy k is number k*B + b.

    Args:
        fleet: B data centers.
        drivers: Their inputs.
        start: First step of each, (B,).
        times: Number of copies.

    Returns:
        Fleet, drivers and first steps of all copies.
    """
    copies = drivers.take(list(range(fleet.size)) * times)
    return build_fleet(fleet.configs * times), copies, np.tile(start, times)


LARGEST_TABLE_ERROR = 1e-4
"""Largest error of a table, as a share of the energy, with which a bound still is one."""
LEAST_TASKS = 1e-6
"""Work that rounding may leave, in tasks."""
LEAST_K = 1e-3
"""Temperature by which the precision of the kernels may exceed a limit, in K."""
_LEAST_STORED_SHARE = 1e-6
"""Share of the capacity that may be missing from the battery at the end."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """What the simulator measured in the scored steps along a path of one data center."""

    figure: float
    """Figure of the scored steps, in the unit of the objective."""
    table_error: float
    """Sum of the absolute differences of the facility's energy in each step from the table at the
    utilisation and setpoint of the step, divided by the energy of all steps."""
    start_kwh: float
    """Energy stored at the first scored step, in kWh."""
    end_kwh: float
    """Energy stored at the end, in kWh."""
    start_tasks: float
    """Work that waits at the first scored step, in tasks."""
    end_tasks: float
    """Work that waits at the end, in tasks."""
    dropped_tasks: float
    """Work that finds the queue full, in tasks."""
    overdue_tasks: float
    """Most due work that does not fit into a step, in tasks."""
    hottest_inlet_c: float
    """Hottest inlet, in C."""
    over_limit_k: float
    """Most by which an inlet exceeds the limit, or the coolest of all setpoints where none keeps
    it, in K."""
    unmet_kwh: float
    """Cooling load that stays in the room, in kWh."""

    def failures(self, idle: Certificate, capacity_kwh: float) -> tuple[str, ...]:
        """What the path breaks, in words; nothing where it may count as achieved.

        Args:
            idle: Certificate of idle commands.
            capacity_kwh: Capacity of the battery, in kWh.
        """
        missing_kwh = self.start_kwh - self.end_kwh
        more_tasks = self.end_tasks - self.start_tasks
        dropped = self.dropped_tasks - idle.dropped_tasks
        texts = []
        if missing_kwh > _LEAST_STORED_SHARE * capacity_kwh:
            texts.append(f"ends with {missing_kwh:.4g} kWh less in the battery")
        if more_tasks > LEAST_TASKS:
            texts.append(f"ends with {more_tasks:.4g} tasks more in the queue")
        if dropped > LEAST_TASKS:
            texts.append(f"drops {dropped:.4g} tasks more than idle commands")
        if self.overdue_tasks > idle.overdue_tasks + LEAST_TASKS:
            texts.append(f"leaves up to {self.overdue_tasks:.4g} tasks overdue")
        if self.over_limit_k > LEAST_K:
            texts.append(f"has inlets up to {self.over_limit_k:.3g} K over the limit")
        if self.unmet_kwh > idle.unmet_kwh * (1.0 + 1e-6) + 1e-6:
            texts.append(f"leaves {self.unmet_kwh - idle.unmet_kwh:.4g} kWh of heat in the room")
        return tuple(texts)


def certificate(problem: Problem, done: RollOut, score: Score, i: int) -> Certificate:
    """What the simulator measured along one path, and how far that is from the table.

    Args:
        problem: Planning problem of the data center.
        done: What the simulator did, of this path alone.
        score: Score of several paths.
        i: Number of the path in the score.
    """
    scored = slice(problem.scored_from, None)
    measured = done.facility_kwh[scored, 0]
    expected = facility_kwh(problem.table, done.utilisation[:, 0], done.setpoint_c[:, 0])
    return Certificate(
        figure=float(score.figure[i]),
        table_error=float(np.abs(expected[scored] - measured).sum() / measured.sum()),
        start_kwh=float(score.start_kwh[i]),
        end_kwh=float(score.end_kwh[i]),
        start_tasks=float(score.start_tasks[i]),
        end_tasks=float(score.end_tasks[i]),
        dropped_tasks=float(score.dropped_tasks[i]),
        overdue_tasks=float(score.most_overdue_tasks[i]),
        hottest_inlet_c=float(score.hottest_inlet_c[i]),
        over_limit_k=float(_over_limit_k(problem, done)[scored].max()),
        unmet_kwh=float(score.unmet_kwh[i]),
    )


def _over_limit_k(problem: Problem, done: RollOut) -> F64:
    """By how much the hottest inlet of each step exceeds what it has to keep, in K, (T,)."""
    table, limit_c = problem.table, problem.inlet_limit_c
    if np.isinf(limit_c):
        return np.zeros(problem.steps)
    inlet_c, unmet_w = (
        at_utilisation(values, table.utilisation, done.utilisation[:, 0])
        for values in (table.inlet_max_c, table.unmet_w)
    )
    coolest_c = coolest_inlet_c(inlet_c, unmet_w)[:, 0]
    within = coolest_c <= limit_c - INLET_MARGIN_K
    return np.asarray(
        done.inlet_max_c[:, 0] - np.where(within, limit_c, coolest_c + INLET_MARGIN_K)
    )
