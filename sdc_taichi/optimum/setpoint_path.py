"""The best path of a setpoint that moves by a limited change per step, by dynamic programming."""

from __future__ import annotations

import numpy as np

from sdc_taichi.types import F64

_ROUND_OFF_K = 1e-9
"""By how much rounding may make a change of the setpoint larger than it is, in K."""


def setpoint_path(cost: F64, setpoint_c: F64, *, ramp_k: float, start_c: float) -> F64:
    """Setpoints of least cost among the nodes of a grid, in C, (T,).

    Bellman's recursion from the last step on: the least cost from step t and node j on is the cost
    of t there plus the least of what may follow (R. Bellman, Dynamic Programming, 1957). A node
    that is barred in a step is used where there is no other way, as rarely as can be.

    Args:
        cost: Cost of each step and node, inf where the node is barred, (T, J).
        setpoint_c: Setpoints of the nodes, rising, in C, (J,).
        ramp_k: Largest change between two steps, in K; inf without a limit.
        start_c: Setpoint before the first step, in C.
    """
    cost = _finite(cost)
    steps = len(cost)
    reach_k = ramp_k + _ROUND_OFF_K
    apart_k = np.abs(setpoint_c[:, None] - setpoint_c)
    allowed = np.where(apart_k <= reach_k, 0.0, np.inf)
    best_next = np.empty(cost.shape, dtype=np.int64)
    to_go = np.zeros(len(setpoint_c))
    for t in range(steps - 1, -1, -1):
        # Entry i is the node from which step t starts, entry j the one that it moves to.
        options = allowed + (cost[t] + to_go)
        best_next[t] = options.argmin(axis=1)
        to_go = options[np.arange(len(to_go)), best_next[t]]
        if t == 0:
            from_start = np.abs(setpoint_c - start_c)
            reachable = from_start <= max(reach_k, from_start.min() + _ROUND_OFF_K)
            first = int(np.where(reachable, options.min(axis=0), np.inf).argmin())
    path = np.empty(steps, dtype=np.int64)
    path[0] = first
    for t in range(1, steps):
        path[t] = best_next[t, path[t - 1]]
    return np.asarray(setpoint_c[path])


def _finite(cost: F64) -> F64:
    """Cost with barred nodes at more than all other steps together can differ by, (T, J)."""
    barred = np.isinf(cost)
    if not barred.any():
        return cost
    open_cost = np.where(barred, np.nan, cost)
    some = ~barred.all(axis=1)
    low, high = np.zeros(len(cost)), np.zeros(len(cost))
    low[some] = np.nanmin(open_cost[some], axis=1)
    high[some] = np.nanmax(open_cost[some], axis=1)
    penalty = 1.0 + 2.0 * float((high - low).sum())
    return np.where(barred, high[:, None] + penalty, cost)
