"""What the rest of a run costs by queue, by setpoint and by stored energy, each for itself.

Three dynamic programmes over one quantity each, while the other two follow a guide, rank the labels
of a beam search. They decide which labels are kept, never what one costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sdc_taichi.hall.protection import Mask
from sdc_taichi.optimum.discrete_labels import (
    DiscreteModel,
    Successors,
    read_table,
    table_place,
)
from sdc_taichi.optimum.problem import Ends, Plan, Problem
from sdc_taichi.optimum.table_lookup import barred
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F64

TARGETS = 10
"""Parts of queue and store that are tried as what there is at the first scored step."""
FULL_SHARE = 0.9
"""Share of the capacity up to which the energy at the first scored step is chosen."""
QUEUE_LEVELS = 201
"""Levels of the queue at which the rest of a run is costed."""
STORE_LEVELS = 121
"""Levels of the stored energy at which the rest of a run is costed."""
_SHORTAGE_FACTOR = 10.0
"""Price of what is missing at the end, over the highest price of a step."""


_Step = Callable[[int], tuple[F64, F64]]
"""Costs of commands in a step and what levels they lead to, (levels, commands) each."""


@dataclass(frozen=True, slots=True)
class Guide:
    """A path of a data center around which the rest of a run is costed, over T steps."""

    utilisation: F64
    """Work that starts, as a share of capacity, 0..1, (T,)."""
    setpoint_c: F64
    """Setpoint, in C, (T,)."""
    facility_kwh: F64
    """Energy of the facility, in kWh, (T,)."""
    bus_kwh: F64
    """Energy drawn into the battery, below 0 where it delivers, in kWh, (T,)."""


@dataclass(frozen=True, slots=True)
class CostsToGo:
    """Cost of the steps to come by queue, by setpoint and by stored energy, T + 1 times."""

    queue_tasks: F64
    """Levels of the queue, in tasks, (Q,)."""
    of_queue: F64
    """Cost by queue, (T + 1, Q)."""
    setpoint_c: F64
    """Setpoints, in C, (J,)."""
    of_setpoint: F64
    """Cost by setpoint, (T + 1, J)."""
    stored_kwh: F64
    """Levels of the stored energy, in kWh, (S,)."""
    of_store: F64
    """Cost by stored energy, (T + 1, S)."""
    target_tasks: float
    """Work in the queue at the first scored step for which ``of_queue`` is right, in tasks."""
    target_kwh: float
    """Energy stored at the first scored step for which ``of_store`` is right, in kWh."""
    has_begun: Mask
    """Whether the steps before each one include a scored one, (T + 1,)."""
    peak_kw: F64
    """Highest power of the guide in the billed month of each step, in kW, (T,); 0 without one."""
    peak_weight: F64
    """Weight of each kW of the highest power of that month, (T,)."""

    def rank(self, found: Successors, t: int) -> F64:
        """Cost of successors of step ``t`` with what the rest of the run costs, (n, l, c, b).

        What a label held at the first scored step it has to leave at the end; more or less of it
        than the target is held to the end.
        """
        queue_tasks, stored_kwh = found.queue_tasks, found.stored_kwh
        if self.has_begun[t]:
            labels = found.labels
            queue_tasks = queue_tasks - (labels.start_tasks - self.target_tasks)[:, None]
            stored_kwh = stored_kwh - (labels.start_kwh - self.target_kwh)[:, None, None, None]
        of_load = np.interp(queue_tasks, self.queue_tasks, self.of_queue[t + 1])
        of_cooling = np.interp(found.setpoint_c, self.setpoint_c, self.of_setpoint[t + 1])
        rank = found.cost + (of_load[:, :, None, None] + of_cooling[:, None, :, None])
        if len(self.stored_kwh) > 1:
            rank += np.interp(stored_kwh, self.stored_kwh, self.of_store[t + 1])
        if self.peak_weight[t]:
            rank += self.peak_weight[t] * np.maximum(found.peak_kw, self.peak_kw[t])
        return np.asarray(rank)


def guide_of(model: DiscreteModel, plan: Plan | None) -> Guide:
    """The path of a plan, or without one that of commands that are all 0.

    Args:
        model: The discrete actions of the data center.
        plan: What a plan does in T steps.
    """
    problem = model.problem
    if plan is None:
        executed = problem.work.idle_tasks
        setpoint_c, bus_kwh = problem.idle_setpoint_c, np.zeros(problem.steps)
    else:
        executed, setpoint_c = plan.executed_tasks, plan.setpoint_c
        bus_kwh = plan.charge_kwh - plan.discharge_kwh
    utilisation = executed / TASKS_PER_STEP
    facility_kwh = np.array(
        [
            read_table(table, table_place(problem, np.asarray(u), np.asarray(s)))
            for table, u, s in zip(problem.table.facility_kwh, utilisation, setpoint_c, strict=True)
        ]
    )
    return Guide(utilisation, setpoint_c, facility_kwh, bus_kwh)


def costs_to_go(model: DiscreteModel, guide: Guide, ends: Ends | None) -> CostsToGo:
    """Cost of the steps to come around a guide.

    Args:
        model: The discrete actions of the data center.
        guide: The path that the other two quantities follow.
        ends: What is to be left at the end in place of what there was.
    """
    problem = model.problem
    grid_kw = (guide.facility_kwh + guide.bus_kwh) / problem.step_h
    peak_kw, peak_weight = np.zeros(problem.steps), np.zeros(problem.steps)
    for month in problem.months:
        of_month = slice(month.first, month.end)
        peak_kw[of_month] = grid_kw[of_month].max()
        peak_weight[of_month] = month.weight_per_kw
    costs = _StepCosts(problem, peak_kw, peak_weight)
    queue_tasks, of_queue, target_tasks = _of_queue(model, guide, costs, ends)
    stored_kwh, of_store, target_kwh = _of_store(model, guide, costs, ends)
    return CostsToGo(
        queue_tasks=queue_tasks,
        of_queue=of_queue,
        setpoint_c=problem.table.setpoint_c,
        of_setpoint=_of_setpoint(model, guide, costs),
        stored_kwh=stored_kwh,
        of_store=of_store,
        target_tasks=target_tasks,
        target_kwh=target_kwh,
        has_begun=np.arange(problem.steps + 1) >= (problem.scored_from if ends is None else np.inf),
        peak_kw=peak_kw,
        peak_weight=peak_weight,
    )


@dataclass(frozen=True, slots=True)
class _StepCosts:
    """Weighed cost of a step."""

    problem: Problem
    """Planning problem."""
    peak_kw: F64
    """Power above which a step costs demand, in kW, (T,)."""
    peak_weight: F64
    """Cost of each kW above it, (T,)."""

    def of_grid(self, t: int, grid_kwh: F64) -> F64:
        """Cost of energy bought, and of power above that of the guide."""
        cost = self.problem.kwh_weight[t] * grid_kwh
        if self.peak_weight[t]:
            over_kw = grid_kwh / self.problem.step_h - self.peak_kw[t]
            cost = cost + self.peak_weight[t] * np.maximum(over_kw, 0.0)
        return np.asarray(cost)

    def of_nodes(self, t: int, bus_kwh: float) -> F64:
        """Cost of the nodes of the table with some energy drawn into the battery, (I, J).

        A node that no plan may use costs more than any other.
        """
        problem, table = self.problem, self.problem.table
        cost = self.of_grid(t, table.facility_kwh[t] + bus_kwh)
        if t >= problem.scored_from:
            cost = cost + problem.litre_weight * table.water_l[t]
        bars = barred(table.inlet_max_c[t], table.unmet_w[t], problem.inlet_limit_c)
        return np.where(bars, cost + self.shortage * table.facility_kwh[t].max(), cost)

    @property
    def shortage(self) -> float:
        """Price of a kWh that is missing at the end."""
        problem = self.problem
        dearest = float(problem.kwh_weight.max())
        if self.peak_weight.any():
            dearest += float(self.peak_weight.max()) / problem.step_h
        return _SHORTAGE_FACTOR * (dearest + problem.litre_weight)


def _of_setpoint(model: DiscreteModel, guide: Guide, costs: _StepCosts) -> F64:
    """Cost of the steps to come by setpoint, at the utilisation of the guide, (T + 1, J)."""
    problem, table = model.problem, model.problem.table
    nodes, steps = table.setpoint_c, problem.steps
    found = np.zeros((steps + 1, len(nodes)))
    if "cooling" not in problem.agents:
        return found
    moved_c = nodes[:, None] + model.commands["cooling"] * model.setpoint_step_k
    moved_c = np.clip(moved_c, nodes[0], nodes[-1])
    for t in range(steps - 1, -1, -1):
        place = table_place(problem, np.asarray(guide.utilisation[t]), nodes)
        cost = read_table(costs.of_nodes(t, guide.bus_kwh[t]), place) + found[t + 1]
        found[t] = np.interp(moved_c, nodes, cost).min(axis=1)
    return found


def _of_queue(
    model: DiscreteModel, guide: Guide, costs: _StepCosts, ends: Ends | None
) -> tuple[F64, F64, float]:
    """Levels of the queue, (Q,), cost of the steps to come by them, (T + 1, Q), and the target."""
    problem, work = model.problem, model.problem.work
    most = min(work.queue_limit_tasks, _longest_queue(problem))
    if "load" not in problem.agents or most <= 0:
        return np.array([0.0]), np.zeros((problem.steps + 1, 1)), 0.0
    levels = np.linspace(0.0, most, QUEUE_LEVELS)
    command, nothing = model.commands["load"], np.zeros(1)
    # Energy of a task, at most what a full step takes per task.
    price = costs.shortage * float(problem.table.facility_kwh.max()) / TASKS_PER_STEP
    nodes = problem.table.utilisation

    def step(t: int) -> tuple[F64, F64]:
        started, deferred, dequeued, dropped = model.move_work(levels[:, None], nothing, command, t)
        of_nodes = costs.of_nodes(t, guide.bus_kwh[t])
        if "cooling" in problem.agents:
            best = of_nodes.min(axis=1)
        else:
            at = table_place(problem, nodes, np.asarray(problem.idle_setpoint_c[t]))
            best = read_table(of_nodes, at)
        cost = np.interp(started / TASKS_PER_STEP, nodes, best) + price * dropped
        return cost, levels[:, None] + deferred - dequeued

    def left_over(targets: F64) -> F64:
        return _penalty(price, levels[-1], levels - targets[:, None])

    end_tasks = None if ends is None else ends.end_tasks
    return levels, *_back(problem, levels, 0.0, end_tasks, most, left_over, step)


def _of_store(
    model: DiscreteModel, guide: Guide, costs: _StepCosts, ends: Ends | None
) -> tuple[F64, F64, float]:
    """Levels of stored energy, (S,), cost of the steps to come, (T + 1, S), and the target."""
    problem, storage = model.problem, model.problem.storage
    if "battery" not in problem.agents or storage.capacity_kwh <= 0:
        return np.array([0.0]), np.zeros((problem.steps + 1, 1)), storage.stored_kwh
    levels = np.linspace(0.0, storage.capacity_kwh, STORE_LEVELS)
    command = model.commands["battery"]

    def step(t: int) -> tuple[F64, F64]:
        after, grid_kwh = model.move_store(levels[:, None], command, guide.facility_kwh[t])
        return costs.of_grid(t, grid_kwh), after

    def missing(targets: F64) -> F64:
        return _penalty(costs.shortage, levels[-1], targets[:, None] - levels)

    end_kwh = None if ends is None else ends.end_kwh
    # The last part of a battery takes ever longer to fill, so that no run begins and ends there.
    most_kwh = FULL_SHARE * storage.capacity_kwh
    return levels, *_back(problem, levels, storage.stored_kwh, end_kwh, most_kwh, missing, step)


def _penalty(price: float, most: float, short: F64) -> F64:
    """Cost of what is short at the end, (K, levels): anything at all costs more than all the rest.

    Args:
        price: Price that is higher than that of any step.
        most: Most that can be short.
        short: What is short by target and level, below 0 where there is more, (K, levels).
    """
    return np.where(short > 0.0, price * (most + short), 0.0)


def _back(
    problem: Problem,
    levels: F64,
    start: float,
    end: float | None,
    most: float,
    terminal: Callable[[F64], F64],
    step: _Step,
) -> tuple[F64, float]:
    """Cost of the steps to come by levels of a quantity, (T + 1, levels), and the target.

    The target is what the scored steps begin with, and leave if ``end`` says nothing else. Where
    steps before them are not scored, a level is worth what a run costs that begins and ends at it,
    and the target is where the cheapest path comes to.

    Args:
        problem: Planning problem.
        levels: Levels of the quantity.
        start: Level before the first step.
        end: Level to be left at the end; None is the target.
        most: Highest target that is chosen.
        terminal: Cost of levels at the end, (K, levels), by what is to be left, (K,).
        step: Costs of commands in a step and the levels that they lead to, (levels, commands) each.
    """
    begin, last = problem.scored_from, problem.steps
    if begin == 0 or end is not None:
        left = _nearest(levels, start) if end is None else end
        found = _recursion(terminal(np.array([left])), levels, step, 0, last)
        return found[:, 0], left
    targets = levels[levels <= most]
    targets = targets[:: max(len(targets) // TARGETS, 1)]
    of_target = _recursion(terminal(targets), levels, step, begin, last)[0]
    cyclic = [np.interp(x, levels, row) for x, row in zip(targets, of_target, strict=True)]
    beyond = np.maximum(levels - targets[-1], 0.0)
    value = np.interp(levels, targets, cyclic) + terminal(targets[-1:]).max() * beyond / levels[-1]
    before = _recursion(value[None], levels, step, 0, begin)[:, 0]
    target = _nearest(levels, _follow(before, levels, start, step))
    found = _recursion(terminal(np.array([target])), levels, step, begin, last)[1:, 0]
    return np.concatenate([before, found]), target


def _nearest(levels: F64, value: float) -> float:
    """Level that is nearest to a value: what is short of a level is told apart from what is not."""
    return float(levels[np.abs(levels - value).argmin()])


def _follow(values: F64, levels: F64, start: float, step: _Step) -> float:
    """Level that the cheapest commands lead to from a level before the first step."""
    level = start
    for t in range(len(values) - 1):
        cost, after = step(t)
        cost, after = (
            np.array([np.interp(level, levels, x) for x in np.broadcast_arrays(each, after)[0].T])
            for each in (cost, after)
        )
        level = float(after[(cost + np.interp(after, levels, values[t + 1])).argmin()])
    return level


def _recursion(values: F64, levels: F64, step: _Step, begin: int, end: int) -> F64:
    """Bellman's recursion from the values after a step back to another, (steps + 1, K, levels)."""
    found = np.empty((end - begin + 1, *values.shape))
    found[-1] = values
    for t in range(end - 1, begin - 1, -1):
        cost, after = step(t)
        place = np.clip(after * (1.0 / levels[1]), 0.0, len(levels) - 1.0)
        low = np.minimum(place.astype(np.int64), len(levels) - 2)
        along, values = place - low, found[t - begin + 1]
        to_go = values[:, low] * (1.0 - along) + values[:, low + 1] * along
        found[t - begin] = (cost + to_go).min(axis=-1)
    return found


def _longest_queue(problem: Problem) -> float:
    """Most work that deferring can bring into the queue before it is due, in tasks."""
    deferred = np.cumsum(problem.work.most_deferred_tasks)
    waits = problem.work.deadline_steps
    if waits is None or waits >= problem.steps:
        return float(deferred[-1])
    return float(max(deferred[waits - 1], (deferred[waits:] - deferred[:-waits]).max()))
