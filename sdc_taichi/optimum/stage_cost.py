"""Least cost of each step by the work that it does, and the largest convex curves below it.

The cost of a step with utilisation u is the least over permitted setpoints of the weighed energy
of the facility and water. Three estimates lie between the nodes of a table:

- of setpoints: the parabola through the best node and its neighbours;
- of utilisation, where it is given: the cubic through four nodes;
- of utilisation, where it is free: straight lines between nodes, lowered by the sag h^2*f''/8 of a
  curve with the second differences of the nodes, so that they lie below the curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.protection import Mask
from sdc_taichi.optimum.problem import Problem
from sdc_taichi.optimum.tables import INLET_MARGIN_K, at_setpoint, cubic
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F64

_STEPS_AT_ONCE = 512
"""Steps whose tables are searched at once, so that a year takes little memory."""


@dataclass(frozen=True, slots=True)
class StageCost:
    """The least cost of T steps at each of I amounts of work."""

    executed_tasks: F64
    """Amounts of work, rising, in tasks, (I,)."""
    cost: F64
    """Least weighed cost over permitted setpoints, (T, I)."""
    facility_kwh: F64
    """Energy of the facility at the cheapest setpoint, in kWh, (T, I)."""
    least_facility_kwh: F64
    """Least energy of the facility over permitted setpoints, in kWh, (T, I)."""
    most_facility_kwh: F64
    """Largest energy of the facility over permitted setpoints, in kWh, (T, I)."""
    setpoint_c: F64
    """The cheapest setpoint, in C, (T, I)."""
    highest_tasks: F64
    """Most work for which a permitted setpoint exists, in tasks, (T,)."""


@dataclass(frozen=True, slots=True)
class LoadCurves:
    """Cost and energy of T steps as convex piecewise linear functions of the work that they do.

    Both are a value at the least amount of work and the sum over M segments of their slope times
    how much of them is used; slopes of a step rise.
    """

    least_tasks: F64
    """Least amount of work, in tasks, (T,)."""
    base_cost: F64
    """Cost of the least amount, (T,)."""
    base_kwh: F64
    """Energy of the facility at the least amount, in kWh, (T,)."""
    step: np.ndarray[tuple[int], np.dtype[np.int64]]
    """Step of each segment, (M,)."""
    width_tasks: F64
    """Length of each segment, in tasks, (M,)."""
    slope_cost: F64
    """Cost of a task of each segment, (M,)."""
    slope_kwh: F64
    """Energy of a task of each segment, in kWh, (M,)."""


def stage_cost(problem: Problem, *, warm_up_share: float = 0.0) -> StageCost:
    """The least cost of each step at each utilisation of the table.

    A setpoint is permitted where it leaves no heat in the room, and where the hottest inlet is
    within its limit, with a tolerance of ``INLET_MARGIN_K``, if that is so at any setpoint. Without
    the agent of cooling the setpoint is that of idle commands.

    Args:
        problem: The planning problem.
        warm_up_share: Weight of steps before the first scored one, relative to the mean weight.

    Raises:
        ConfigError: at some step hardly any utilisation can be cooled.
    """
    weight, litre = step_weights(problem, warm_up_share)
    parts = [
        _of_steps(problem, slice(a, a + _STEPS_AT_ONCE), weight, litre)
        for a in range(0, problem.steps, _STEPS_AT_ONCE)
    ]
    cost, facility, least, most, setpoint = (np.concatenate(x) for x in zip(*parts, strict=True))
    tasks = problem.table.utilisation * TASKS_PER_STEP
    highest = np.full(problem.steps, np.inf)
    for t in np.flatnonzero(~np.isfinite(cost).all(axis=1)).tolist():
        highest[t] = _extend(problem, tasks, t, (cost, facility, least, most, setpoint))
    return StageCost(tasks, cost, facility, least, most, setpoint, highest)


def step_weights(problem: Problem, warm_up_share: float = 0.0) -> tuple[F64, F64]:
    """Weights of a kWh bought and of a litre in each step, (T,) each.

    Args:
        problem: The planning problem.
        warm_up_share: Weight of steps before the first scored one, relative to the mean weight.
    """
    weight, first = problem.kwh_weight.copy(), problem.scored_from
    litre = np.full(problem.steps, problem.litre_weight)
    weight[:first] = warm_up_share * weight[first:].mean()
    litre[:first] *= warm_up_share
    return weight, litre


def load_curves(problem: Problem, stage: StageCost) -> LoadCurves:
    """The largest convex curves below cost and least energy, from the least to the most work.

    Args:
        problem: The planning problem.
        stage: Least cost of its steps.
    """
    least, most = work_limits(problem)
    most = np.maximum(np.minimum(most, stage.highest_tasks), least)
    nodes = stage.executed_tasks
    x = np.concatenate(
        [least[:, None], np.clip(nodes, least[:, None], most[:, None]), most[:, None]], axis=1
    )
    cost = _lowered(nodes, stage.cost, least, most)
    kwh = _lowered(nodes, stage.least_facility_kwh, least, most)
    corner = _corners(x, cost)
    if problem.litre_weight:
        of_energy = _corners(x, kwh)
        cost, kwh = _below(x, cost, corner), _below(x, kwh, of_energy)
        corner |= of_energy
    # First and last column are hull vertices (identical if there is one point).
    step, column = np.nonzero(corner)
    same = step[1:] == step[:-1]
    at, last, after = step[1:][same], column[:-1][same], column[1:][same]
    width = x[at, after] - x[at, last]
    wide = width > 0
    at, last, after, width = at[wide], last[wide], after[wide], width[wide]
    return LoadCurves(
        least_tasks=least,
        base_cost=cost[:, 0],
        base_kwh=kwh[:, 0],
        step=at,
        width_tasks=width,
        slope_cost=(cost[at, after] - cost[at, last]) / width,
        slope_kwh=(kwh[at, after] - kwh[at, last]) / width,
    )


def given_curves(problem: Problem, stage: StageCost) -> LoadCurves:
    """Curves of a single point: the work that idle commands do.

    Args:
        problem: The planning problem.
        stage: Least cost of its steps.
    """
    tasks, none = problem.work.idle_tasks, np.zeros(0)
    return LoadCurves(
        least_tasks=tasks,
        base_cost=cubic(stage.executed_tasks, stage.cost, tasks),
        base_kwh=cubic(stage.executed_tasks, stage.least_facility_kwh, tasks),
        step=np.zeros(0, np.int64),
        width_tasks=none,
        slope_cost=none,
        slope_kwh=none,
    )


def work_limits(problem: Problem) -> tuple[F64, F64]:
    """Least and most work that each step can do, in tasks, (T,) each.

    What may not be deferred runs at once. With ``tasks``, a drain takes no more than the flexible
    work of the step, and due work is at most what was deferred a deadline earlier.
    """
    work = problem.work
    least = work.arrived_tasks - work.most_deferred_tasks
    most = np.maximum(work.most_executed_tasks, least)
    if work.model == "tasks":
        beyond = work.most_deferred_tasks.copy()
        if work.deadline_steps is not None:
            due = work.most_deferred_tasks[: -work.deadline_steps or None]
            beyond[work.deadline_steps :] += due[: max(len(beyond) - work.deadline_steps, 0)]
        most = np.minimum(most, work.arrived_tasks + beyond)
    return least, most


def _of_steps(
    problem: Problem, steps: slice, weight: F64, litre: F64
) -> tuple[F64, F64, F64, F64, F64]:
    """Cost, energy, least and largest energy, and setpoint of some steps, each (t, I)."""
    table = problem.table
    kwh, water_l = table.facility_kwh[steps], table.water_l[steps]
    cooled = table.unmet_w[steps] == 0.0
    weight, litre = weight[steps, None], litre[steps, None]
    if "cooling" not in problem.agents:
        idle_c = problem.idle_setpoint_c[steps]
        energy = at_setpoint(np.where(cooled, kwh, np.inf), table.setpoint_c, idle_c[:, None])
        cost = weight * energy
        if problem.litre_weight:
            cost = cost + litre * at_setpoint(water_l, table.setpoint_c, idle_c[:, None])
        cost = np.where(np.isfinite(energy), cost, np.inf)
        return cost, energy, energy, energy, np.broadcast_to(idle_c[:, None], cost.shape)
    permitted, inlet_c = cooled, table.inlet_max_c[steps]
    # No run that counts as keeping the limit has a setpoint that is not permitted here.
    limit_c = problem.inlet_limit_c + INLET_MARGIN_K
    if np.isfinite(limit_c):
        surely = cooled & (inlet_c <= problem.inlet_limit_c - INLET_MARGIN_K)
        within = cooled & (inlet_c <= limit_c)
        permitted = np.where(surely.any(axis=2, keepdims=True), within, cooled)
    edge = _edges(permitted, cooled, inlet_c, limit_c)
    most = np.where(permitted, kwh, -np.inf).max(axis=2)
    least, least_c = _least(kwh, permitted, edge, table.setpoint_c)
    if not problem.litre_weight:
        return np.where(np.isfinite(least), weight * least, np.inf), least, least, most, least_c
    weighed = weight[..., None] * kwh + litre[..., None] * water_l
    cost, cost_c = _least(weighed, permitted, edge, table.setpoint_c)
    free = (weight == 0.0) & (litre == 0.0)
    cost_c = np.where(free, least_c, cost_c)
    return cost, at_setpoint(kwh, table.setpoint_c, cost_c), least, most, cost_c


def _edges(permitted: Mask, cooled: Mask, inlet_c: F64, limit_c: float) -> F64:
    """Share of the way to the next setpoint at which the inlet reaches its limit, (t, I, J - 1).

    It is nan where two neighbours are both permitted or both not.
    """
    share = np.full(permitted[..., 1:].shape, np.nan)
    if not np.isfinite(limit_c):
        return share
    change = permitted[..., 1:] != permitted[..., :-1]
    change &= cooled[..., 1:] & cooled[..., :-1]
    before, after = inlet_c[..., :-1][change], inlet_c[..., 1:][change]
    share[change] = (limit_c - before) / (after - before)
    return share


def _least(values: F64, permitted: Mask, edge: F64, setpoint_c: F64) -> tuple[F64, F64]:
    """The least value over setpoints between and at the nodes, and where it is, (t, I) each."""
    best = np.where(permitted, values, np.inf)
    j = best.argmin(axis=2)[..., None]
    least = np.take_along_axis(best, j, axis=2)[..., 0]
    best_c = setpoint_c[j[..., 0]]
    count = len(setpoint_c)
    if count < 2:
        return least, best_c
    spacing = setpoint_c[1] - setpoint_c[0]
    if count > 2:
        middle = np.clip(j, 1, count - 2)
        y = [np.take_along_axis(values, middle + k, axis=2)[..., 0] for k in (-1, 0, 1)]
        ok = [np.take_along_axis(permitted, middle + k, axis=2)[..., 0] for k in (-1, 0, 1)]
        off = (j - middle)[..., 0]
        bend, slope = y[0] - 2 * y[1] + y[2], 0.5 * (y[2] - y[0])
        bent = ok[0] & ok[1] & ok[2] & (bend > 0)
        at = np.zeros(bend.shape)
        np.divide(-slope, bend, out=at, where=bent)
        at = np.clip(at, np.maximum(off - 0.5, -1.0), np.minimum(off + 0.5, 1.0))
        lowest = y[1] + slope * at + 0.5 * bend * at**2
        lower = bent & (lowest < least)
        least = np.where(lower, lowest, least)
        best_c = np.where(lower, setpoint_c[middle[..., 0]] + at * spacing, best_c)
    for k in np.flatnonzero(np.isfinite(edge).any(axis=(0, 1))):
        share = edge[..., k]
        there = values[..., k] + share * (values[..., k + 1] - values[..., k])
        lower = there < least
        least = np.where(lower, there, least)
        best_c = np.where(lower, setpoint_c[k] + share * spacing, best_c)
    return least, best_c


def _extend(problem: Problem, tasks: F64, t: int, rows: tuple[F64, ...]) -> float:
    """Continue the values of a step beyond what can be cooled, in place.

    The most work that can be cooled lies between two nodes, so the curve continues to the second in
    a straight line: a plan may not do that, but no controller can do better.

    Returns:
        The highest amount of work that is permitted, in tasks.
    """
    known = np.flatnonzero(np.isfinite(rows[0][t]))
    if len(known) < 2:
        raise ConfigError(
            f"optimum of {problem.name}: in step {t} no setpoint of the table cools the hall at "
            "two utilisations or more; valid are halls whose cooling meets the load"
        )
    first, last = known[0], known[-1]
    for values in rows:
        row = values[t]
        row[first:last] = np.interp(tasks[first:last], tasks[known], row[known])
        for inner, outer, beyond in (
            (first + 1, first, slice(0, first)),
            (last - 1, last, slice(last + 1, None)),
        ):
            slope = (row[outer] - row[inner]) / (tasks[outer] - tasks[inner])
            row[beyond] = row[outer] + slope * (tasks[beyond] - tasks[outer])
    return float(tasks[min(last + 1, len(tasks) - 1)])


def _lowered(nodes: F64, values: F64, least: F64, most: F64) -> F64:
    """Values at the least amount, at nodes within the limits, and at the most, (T, I + 2).

    They are lowered by the largest sag of the curve beside each node.
    """
    gap = np.diff(nodes)
    slope = np.diff(values, axis=1) / gap
    bend = np.zeros(values.shape)
    bend[:, 1:-1] = 2 * np.diff(slope, axis=1) / (gap[1:] + gap[:-1])
    bend[:, 0], bend[:, -1] = (bend[:, 1], bend[:, -2]) if len(nodes) > 2 else (0.0, 0.0)
    bend = np.maximum(bend, 0.0)
    sag = np.maximum(bend[:, 1:], bend[:, :-1]) * gap**2 / 8
    beside = np.maximum(
        np.pad(sag, ((0, 0), (1, 0)), mode="edge"), np.pad(sag, ((0, 0), (0, 1)), mode="edge")
    )
    ends = []
    for tasks in (least, most):
        k = np.clip(np.searchsorted(nodes, tasks, side="right") - 1, 0, len(gap) - 1)
        ends.append(cubic(nodes, values, tasks) - np.take_along_axis(sag, k[:, None], 1)[:, 0])
    first, last = ends[0][:, None], ends[1][:, None]
    middle = np.where(nodes <= least[:, None], first, values - beside)
    return np.concatenate([first, np.where(nodes >= most[:, None], last, middle), last], axis=1)


def _corners(x: F64, y: F64) -> Mask:
    """Which points are corners of the largest convex curve below all points of a row, (T, N).

    Of points at the same place only one can be a corner. This is the monotone chain of A. M.
    Andrew, "Another efficient algorithm for convex hulls in two dimensions", Information Processing
    Letters 9 (1979), for all rows at once.

    Args:
        x: Places of the points, which do not fall along a row, (T, N).
        y: Their values, (T, N).
    """
    rows = np.arange(len(x))
    chain = np.zeros(x.shape, np.int64)
    length = np.ones(len(x), np.int64)
    for i in range(1, x.shape[1]):
        new = x[:, i] > x[rows, chain[rows, length - 1]]
        while True:
            at, before = chain[rows, length - 1], chain[rows, length - 2]
            turn = (y[rows, at] - y[rows, before]) * (x[:, i] - x[rows, at]) - (
                y[:, i] - y[rows, at]
            ) * (x[rows, at] - x[rows, before])
            drop = new & (length > 1) & (turn >= 0)
            if not drop.any():
                break
            length -= drop
        chain[rows[new], length[new]] = i
        length += new
    corner = np.zeros(x.shape, bool)
    for k in range(int(length.max())):
        kept = k < length
        corner[rows[kept], chain[kept, k]] = True
    return corner


def _below(x: F64, y: F64, corner: Mask) -> F64:
    """Values of the convex curves through corners at all places, (T, N)."""
    below = np.empty(y.shape)
    for t in range(len(y)):
        below[t] = np.interp(x[t], x[t, corner[t]], y[t, corner[t]])
    return below
