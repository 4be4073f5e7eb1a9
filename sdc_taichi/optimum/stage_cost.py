"""Minimum cost of each step by its executed work, and the largest convex curves below it.

The cost of a step at a utilisation is the minimum over permitted setpoints of the weighted sum of
facility energy and water. Between the nodes of a table, values are interpolated in three ways:

- along setpoints: by the parabola through the best node and its neighbours;
- along utilisation, if the utilisation is known: by the cubic through four nodes;
- along utilisation, if the plan chooses it: by straight lines between nodes, lowered by
  h^2*f''/8, the largest distance of a parabola from its chord. Here h is the spacing of the nodes
  and f'' their second difference quotient. The lowered lines are below the true curve.
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
"""Number of steps that are processed together, to limit the memory for a year."""


@dataclass(frozen=True, slots=True)
class StageCost:
    """Minimum cost of each of T steps at each of I amounts of executed work."""

    executed_tasks: F64
    """Amounts of executed work, increasing, in tasks, (I,)."""
    cost: F64
    """Minimum weighted cost of all permitted setpoints, (T, I)."""
    facility_kwh: F64
    """Energy of the facility at the cheapest setpoint, in kWh, (T, I)."""
    least_facility_kwh: F64
    """Minimum energy of the facility at all permitted setpoints, in kWh, (T, I)."""
    most_facility_kwh: F64
    """Maximum energy of the facility at all permitted setpoints, in kWh, (T, I)."""
    setpoint_c: F64
    """Cheapest permitted setpoint, in C, (T, I)."""
    highest_tasks: F64
    """Maximum work for which a permitted setpoint exists, in tasks, (T,)."""


@dataclass(frozen=True, slots=True)
class LoadCurves:
    """Cost and energy of T steps as convex piecewise linear functions of the executed work.

    The T curves consist of M segments in total. A curve is its value at the minimum work plus, for
    each segment, the slope times the used part of the segment. Slopes increase along a curve.
    """

    least_tasks: F64
    """Minimum executed work, in tasks, (T,)."""
    base_cost: F64
    """Cost at the minimum work, (T,)."""
    base_kwh: F64
    """Energy of the facility at the minimum work, in kWh, (T,)."""
    step: np.ndarray[tuple[int], np.dtype[np.int64]]
    """Number of the step to which each segment belongs, (M,)."""
    width_tasks: F64
    """Length of each segment, in tasks, (M,)."""
    slope_cost: F64
    """Cost per task in each segment, (M,)."""
    slope_kwh: F64
    """Energy per task in each segment, in kWh, (M,)."""


def stage_cost(problem: Problem, *, warm_up_share: float = 0.0) -> StageCost:
    """Compute the minimum cost of each step at each utilisation of the table.

    A permitted setpoint removes all heat from the room. Its hottest inlet is within the limit, with
    a tolerance of ``INLET_MARGIN_K``; this second condition is dropped if no setpoint satisfies it.
    If the plan does not control cooling, the setpoint is that of idle commands.

    Args:
        problem: The planning problem.
        warm_up_share: Weight of steps before the first scored step, relative to the mean weight.

    Raises:
        ConfigError: In some step, fewer than two utilisations of the table can be cooled.
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
    """Return the weights of a kWh bought and of a litre of water in each step, (T,) each.

    Args:
        problem: The planning problem.
        warm_up_share: Weight of steps before the first scored step, relative to the mean weight.
    """
    weight, first = problem.kwh_weight.copy(), problem.scored_from
    litre = np.full(problem.steps, problem.litre_weight)
    weight[:first] = warm_up_share * weight[first:].mean()
    litre[:first] *= warm_up_share
    return weight, litre


def load_curves(problem: Problem, stage: StageCost) -> LoadCurves:
    """Compute the largest convex curves below cost and minimum energy by executed work."""
    least, most = work_limits(problem)
    return curves_between(stage, least, most, weighs_water=problem.litre_weight > 0)


def curves_between(
    stage: StageCost, least: F64, most: F64, *, weighs_water: bool = False
) -> LoadCurves:
    """Compute the largest convex curves below cost and minimum energy for a range of work.

    Args:
        stage: Minimum cost and energy of each step.
        least: Minimum executed work of each step, in tasks, (T,).
        most: Maximum executed work of each step, in tasks, (T,).
        weighs_water: True if cost is not proportional to energy.
    """
    most = np.maximum(np.minimum(most, stage.highest_tasks), least)
    nodes = stage.executed_tasks
    x = np.concatenate(
        [least[:, None], np.clip(nodes, least[:, None], most[:, None]), most[:, None]], axis=1
    )
    cost = _lowered(nodes, stage.cost, least, most)
    kwh = _lowered(nodes, stage.least_facility_kwh, least, most)
    corner = _corners(x, cost)
    if weighs_water:
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
    """Return curves that consist of a single point, the work executed under idle commands."""
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
    """Return the minimum and the maximum work that each step can execute, in tasks, (T,) each.

    Arriving work that may not be deferred is executed at once. In models of whole tasks, a step
    drains at most its own amount of flexible work from the queue, in addition to due work. Due work
    is at most the work deferred one deadline earlier.
    """
    work = problem.work
    least = work.arrived_tasks - work.most_deferred_tasks
    most = np.maximum(work.most_executed_tasks, least)
    if work.model != "fluid":
        beyond = work.most_deferred_tasks.copy()
        if work.deadline_steps is not None:
            due = work.most_deferred_tasks[: -work.deadline_steps or None]
            beyond[work.deadline_steps :] += due[: max(len(beyond) - work.deadline_steps, 0)]
        most = np.minimum(most, work.arrived_tasks + beyond)
    return least, most


def _of_steps(
    problem: Problem, steps: slice, weight: F64, litre: F64
) -> tuple[F64, F64, F64, F64, F64]:
    """Compute the arrays of ``StageCost`` for some of the steps, (t, I) each.

    Returns:
        Minimum cost, energy at the cheapest setpoint, minimum and maximum energy, and the cheapest
        setpoint.
    """
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
    # The margin ensures that every run that satisfies the limit uses only permitted setpoints.
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
    """Return where between two adjacent setpoints the inlet reaches its limit, (t, I, J - 1).

    The position is 0 at the lower and 1 at the higher setpoint. It is nan if both setpoints are
    permitted, or neither is.
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
    """Minimise values over permitted setpoints, at and between the nodes.

    Args:
        values: Values at the nodes, (t, I, J).
        permitted: True for permitted setpoints, (t, I, J).
        edge: Position between two nodes at which the inlet reaches its limit, (t, I, J - 1).
        setpoint_c: Setpoints of the nodes, in C, (J,).

    Returns:
        The minimum, and the setpoint of the minimum in C, (t, I) each.
    """
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
    """Extrapolate the values of step t to work that no setpoint can cool, in place.

    The maximum work that can be cooled is between two nodes, so the curve continues in a straight
    line to the second node. A plan there may be impossible, but no controller has a lower cost.

    Args:
        problem: The planning problem.
        tasks: Amounts of executed work, in tasks, (I,).
        t: Number of the step.
        rows: Arrays of ``StageCost``, (T, I) each, the cost first.

    Returns:
        The maximum work that plans may choose, in tasks.
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
    """Return lowered values whose chords are below the true curve, (T, I + 2).

    The columns are the values at the minimum work, at the nodes, and at the maximum work. Each
    value is lowered by the largest distance of the curve from its chord in the two adjacent
    intervals.

    Args:
        nodes: Amounts of work, in tasks, (I,).
        values: Values at the nodes, (T, I).
        least: Minimum work of each step, in tasks, (T,).
        most: Maximum work of each step, in tasks, (T,).
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
    """Find the vertices of the lower convex hull of the points in each row, (T, N).

    Among points with equal x at most one is a vertex. The algorithm is the monotone chain of A. M.
    Andrew, "Another efficient algorithm for convex hulls in two dimensions", Information Processing
    Letters 9 (1979), applied to all rows at once.

    Args:
        x: First coordinates of the points, not decreasing along a row, (T, N).
        y: Second coordinates of the points, (T, N).
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
        has_vertex = k < length
        corner[rows[has_vertex], chain[has_vertex, k]] = True
    return corner


def _below(x: F64, y: F64, corner: Mask) -> F64:
    """Interpolate the convex curves through the hull vertices at all x, (T, N)."""
    below = np.empty(y.shape)
    for t in range(len(y)):
        below[t] = np.interp(x[t], x[t, corner[t]], y[t, corner[t]])
    return below
