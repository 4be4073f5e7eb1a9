"""Planned paths of one data center: target states that the simulator then follows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from sdc_taichi.optimum.linear_programme import plan
from sdc_taichi.optimum.loop_map import in_range
from sdc_taichi.optimum.problem import Agent, Problem, Storage
from sdc_taichi.optimum.rollout import Targets, battery_command, bus_energy_kwh
from sdc_taichi.optimum.tables import (
    INLET_MARGIN_K,
    FacilityTable,
    at_utilisation,
    barred,
    energy_at_utilisation,
    facility_kwh,
)
from sdc_taichi.plant.battery import (
    BATTERIES,
    BatteryParameters,
    BatteryPoint,
    conversion,
)
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.types import F64, BatteryResult

IDLE = "idle commands"
"""Name of the path under idle commands."""
JOINT = "all agents"
"""Name of the path for which all agents of a problem are planned together."""
_UNSCORED_SHARE = 1e-3
"""Weight of a kWh in steps that are not scored, relative to the mean weight of scored steps. It
breaks ties between otherwise equal paths."""
_PEAK_SHARES = (np.inf, 1.0, 0.97, 0.94, 0.9, 0.86, 0.82, 0.78)
"""Candidate limits of the power bought under a demand charge, relative to the highest load."""
_STORED_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Candidate states of charge at the first scored step."""


def agents_of(problem: Problem) -> dict[str, tuple[Agent, ...]]:
    """Return the paths to plan for a data center, by name, with the agents that each path moves.

    The paths are that of idle commands, one for each agent alone, and one for all agents together.
    """
    named: dict[str, tuple[Agent, ...]] = {IDLE: ()}
    named |= {agent: (agent,) for agent in problem.agents}
    return named | ({JOINT: problem.agents} if len(problem.agents) > 1 else {})


def path_of(
    problem: Problem, agents: tuple[Agent, ...], check: Callable[[], None] = lambda: None
) -> Targets:
    """Plan a path of low cost that moves some agents and leaves the others idle.

    The path is planned in three stages. A linear programme gives the work of each step, dynamic
    programming gives the setpoints for this work, and the battery is planned for the energy that
    the facility then needs. Coolant loops have their best steady commands for this work.

    Args:
        problem: The planning problem.
        agents: Agents that the path may move.
        check: Called before every linear programme; an error that it raises ends the work.

    Raises:
        ConfigError: No plan satisfies the limits.
    """
    problem = problem.moving(agents)
    plans: dict[Agent, F64] = {}
    if "load" in agents:
        plans["load"] = plan(problem, check=check).executed_tasks
    for agent in agents:
        if agent in ("cooling", "battery"):
            plans[agent] = best_response(problem, agent, plans)
    return targets_of(problem, plans)


def best_response(
    problem: Problem,
    agent: Agent,
    others: Mapping[Agent, F64],
    check: Callable[[], None] = lambda: None,
) -> F64:
    """Return the best plan of one agent while other agents follow known plans, (T,).

    The plan of ``load`` is the executed work in tasks, that of ``cooling`` the setpoint in C, and
    that of ``battery`` the energy stored after each step in kWh. Coolant loops have no plan: if the
    problem moves them, they follow the work of each step.

    Args:
        problem: The planning problem.
        agent: Agent of the plan.
        others: Plans of other agents; agents without a plan are idle.
        check: Called before every linear programme; an error that it raises ends the work.

    Raises:
        ConfigError: No plan satisfies the limits.
    """
    known = _following(problem, others)
    if agent == "load":
        return plan(replace(known, agents=(agent,)), check=check).executed_tasks
    utilisation = _utilisation(known)
    if agent == "cooling":
        return cheapest_setpoints_c(known, utilisation)
    return _stored_kwh(known, facility_kwh(known.table, utilisation, known.idle_setpoint_c))


def targets_of(problem: Problem, plans: Mapping[Agent, F64]) -> Targets:
    """Return the target states of a path on which agents follow their plans.

    Args:
        problem: The planning problem.
        plans: Plans as from ``best_response``; agents without a plan are idle.
    """
    known = _following(problem, plans)
    utilisation = _utilisation(known)
    facility = facility_kwh(known.table, utilisation, known.idle_setpoint_c)
    nothing = np.full(problem.steps, np.nan)
    queue = _queue_tasks(problem, plans["load"]) if "load" in plans else nothing
    stored = plans.get("battery", nothing)
    loops, of_table = np.full((problem.steps, 3), np.nan), known.table.loops
    if of_table is not None:
        loops = in_range(at_utilisation(of_table, known.table.utilisation, utilisation).T).T
    return Targets(
        queue_tasks=queue[:, None],
        setpoint_c=known.idle_setpoint_c[:, None],
        stored_kwh=stored[:, None],
        facility_kwh=facility[:, None],
        loops=loops[:, None],
    )


def _following(problem: Problem, plans: Mapping[Agent, F64]) -> Problem:
    """Return a problem in which agents follow plans instead of idle commands."""
    known = problem
    if "load" in plans:
        known = replace(known, work=replace(problem.work, idle_tasks=plans["load"]))
    if "cooling" in plans:
        known = replace(known, idle_setpoint_c=plans["cooling"])
    if "battery" in plans:
        stored, storage = plans["battery"], problem.storage
        before = np.concatenate([[storage.stored_kwh], stored[:-1]])
        bus_kwh = bus_energy_kwh(stored, before, storage.conversion(problem.step_h))
        known = replace(known, battery_kwh=bus_kwh)
    return known


def _utilisation(problem: Problem) -> F64:
    """Return the utilisation of each step under the work of a problem's load, 0..1, (T,)."""
    return np.minimum(problem.work.idle_tasks / TASKS_PER_STEP, 1.0)


def with_battery_for(problem: Problem, path: Targets, facility_kwh: F64) -> Targets:
    """Plan the battery of a path again for a better estimate of the facility's energy.

    Args:
        problem: The planning problem.
        path: A path that moves the battery.
        facility_kwh: Energy of the facility in each step of the path, in kWh, (T,).
    """
    stored = _stored_kwh(problem, facility_kwh)
    return replace(path, stored_kwh=stored[:, None], facility_kwh=facility_kwh[:, None])


def weight_of_kwh(problem: Problem) -> F64:
    """Return the weight of a kWh in each step, including demand charges, (T,).

    The demand charge of a month is divided evenly among its hours. Steps that are not scored have a
    small positive weight.
    """
    weight = problem.kwh_weight.copy()
    for month in problem.months:
        hours = (month.end - month.first) * problem.step_h
        weight[month.first : month.end] += month.weight_per_kw / hours
    scored = weight[problem.scored_from :]
    weight[: problem.scored_from] = _UNSCORED_SHARE * (scored.mean() or 1.0)
    return weight


def _queue_tasks(problem: Problem, executed_tasks: F64) -> F64:
    """Return the work in the queue after each step, in tasks, (T,); a full queue drops work."""
    rise = problem.work.arrived_tasks - executed_tasks
    limit = problem.work.queue_limit_tasks
    if problem.work.most_dropped_tasks == 0.0:
        return np.clip(np.cumsum(rise), 0.0, limit)
    queue, waiting = np.empty(len(rise)), 0.0
    for t, more in enumerate(rise.tolist()):
        queue[t] = waiting = min(max(waiting + more, 0.0), limit)
    return queue


def cheapest_setpoints_c(problem: Problem, utilisation: F64) -> F64:
    """Return the setpoints of lowest cost for the utilisation of each step, in C, (T,)."""
    table = problem.table
    energy = energy_at_utilisation(table.facility_kwh, table.utilisation, utilisation)
    water, inlet_c, unmet_w = (
        at_utilisation(values, table.utilisation, utilisation)
        for values in (table.water_l, table.inlet_max_c, table.unmet_w)
    )
    cost = weight_of_kwh(problem)[:, None] * energy + problem.litre_weight * water
    cost[barred(inlet_c, unmet_w, problem.inlet_limit_c - INLET_MARGIN_K)] = np.inf
    return setpoint_path(cost, table.setpoint_c, ramp_k=problem.ramp_k, start_c=problem.setpoint_c)


def _stored_kwh(problem: Problem, facility_kwh: F64) -> F64:
    """Plan the stored energy after each step for a known energy of the facility, in kWh, (T,)."""
    storage = problem.storage
    if storage.model == "released":
        return _released_kwh(problem, facility_kwh)
    battery = plan(replace(problem, agents=("battery",), table=_known_facility(facility_kwh)))
    return np.clip(battery.stored_kwh, 0.0, storage.capacity_kwh)


def _known_facility(facility_kwh: F64) -> FacilityTable:
    """Return a table with a known energy that does not depend on utilisation or setpoint."""
    values = np.broadcast_to(facility_kwh[:, None, None], (len(facility_kwh), 2, 1))
    nothing = np.zeros(values.shape)
    return FacilityTable(np.array([0.0, 1.0]), np.array([20.0]), values, nothing, nothing, nothing)


def _released_kwh(problem: Problem, facility_kwh: F64) -> F64:
    """Plan the stored energy of a ``released`` battery after each step, in kWh, (T,).

    The plan is the cheapest of those for several candidate peaks and initial states of charge.
    """
    peaks = _PEAK_SHARES if problem.months else _PEAK_SHARES[:1]
    starts = _STORED_SHARES if problem.scored_from else (None,)
    best, least = np.full(problem.steps, problem.storage.stored_kwh), np.inf
    highest_kw = float(facility_kwh.max()) / problem.step_h
    for start in starts:
        for peak in peaks:
            path = _released_once(problem, facility_kwh, start, peak * highest_kw)
            cost = _battery_cost(problem, facility_kwh, path)
            if cost < least:
                best, least = path, cost
    return best


def _released_once(
    problem: Problem, facility_kwh: F64, start_share: float | None, most_grid_kw: float
) -> F64:
    """Plan a ``released`` battery for one candidate peak and one initial state of charge.

    Args:
        problem: The planning problem.
        facility_kwh: Energy of the facility in each step, in kWh, (T,).
        start_share: State of charge at the first scored step, 0..1; None if all steps are scored.
        most_grid_kw: Candidate limit of the power bought, in kW.

    Returns:
        Stored energy after each step, in kWh, (T,).
    """
    weight, split = weight_of_kwh(problem), problem.scored_from
    storage, before = problem.storage, np.empty(0)
    limits = {
        "step_h": problem.step_h,
        "grid_limit_kw": problem.grid_limit_kw,
        "most_grid_kw": most_grid_kw,
    }
    if start_share is not None:
        before = battery_path(
            storage,
            facility_kwh[:split],
            weight[:split],
            end_kwh=start_share * storage.capacity_kwh,
            **limits,
        )
        storage = replace(storage, stored_kwh=float(before[-1]))
    after = battery_path(
        storage, facility_kwh[split:], weight[split:], end_kwh=storage.stored_kwh, **limits
    )
    return np.concatenate([before, after])


def _battery_cost(problem: Problem, facility_kwh: F64, stored_kwh: F64) -> float:
    """Return the cost of the stored energies of a battery without losses.

    The cost is inf if the battery stores less at the end than at the first scored step.
    """
    grid_kwh = facility_kwh + np.diff(stored_kwh, prepend=problem.storage.stored_kwh)
    split = problem.scored_from
    begin = stored_kwh[split - 1] if split else problem.storage.stored_kwh
    if stored_kwh[-1] < begin - 1e-6 * problem.storage.capacity_kwh:
        return np.inf
    cost = float((problem.kwh_weight * grid_kwh).sum())
    for month in problem.months:
        highest_kw = grid_kwh[month.first : month.end].max() / problem.step_h
        cost += month.weight_per_kw * float(highest_kw)
    return cost


_ROUND_OFF_K = 1e-9
"""Tolerance of the ramp limit of setpoints for rounding errors, in K."""


def setpoint_path(cost: F64, setpoint_c: F64, *, ramp_k: float, start_c: float) -> F64:
    """Return the sequence of setpoints with the lowest total cost, in C, (T,).

    Dynamic programming goes backwards from the last step: the cost-to-go at a node is the cost of
    the step there plus the smallest cost-to-go of a node that the ramp limit allows next (R.
    Bellman, Dynamic Programming, 1957). A node with infinite cost is used only if no path avoids
    such nodes, and then as rarely as possible.

    Args:
        cost: Cost of each step and node, inf for nodes that are not allowed, (T, J).
        setpoint_c: Setpoints of the nodes, increasing, in C, (J,).
        ramp_k: Maximum change of the setpoint between two steps, in K; inf without a limit.
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
        # Row i is the node before step t, column j the node in step t.
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
    """Replace infinite costs by a finite penalty, (T, J).

    The penalty exceeds all cost differences that the other steps together can cause.
    """
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


LEVELS = 201
"""Number of equally spaced levels of stored energy for the dynamic programme of a battery."""
COMMANDS = np.linspace(-1.0, 1.0, 21)
"""Candidate battery commands of a step in the dynamic programme."""
BatteryModel = Callable[[F64, F64, F64 | float], BatteryResult]
"""Battery model: maps stored energy in kWh, command and facility energy in kWh to a result."""
_SHORTAGE_FACTOR = 10.0
"""Price of a kWh missing from the battery at the end, relative to the highest price of a kWh."""


def battery_path(
    storage: Storage,
    facility_kwh: F64,
    kwh_weight: F64,
    *,
    step_h: float,
    end_kwh: float,
    grid_limit_kw: float = np.inf,
    most_grid_kw: float = np.inf,
) -> F64:
    """Plan the stored energy after each step by dynamic programming, in kWh, (T,).

    A backward pass computes the cost-to-go at ``LEVELS`` levels of stored energy in each step, and
    interpolates linearly between them. A forward pass then applies the cheapest commands with the
    battery model itself, so the battery can follow the path exactly.

    Args:
        storage: The battery, with its stored energy before the first step.
        facility_kwh: Energy of the facility in each step, in kWh, (T,).
        kwh_weight: Weight of a kWh bought in each step, (T,).
        step_h: Length of a step, in h.
        end_kwh: Minimum energy stored at the end, in kWh.
        grid_limit_kw: Power bought at which the battery stops charging, in kW; inf without a limit.
        most_grid_kw: Soft upper limit of the power bought, in kW; inf without a limit.
    """
    steps, capacity = len(facility_kwh), storage.capacity_kwh
    if capacity <= 0:
        return np.full(steps, storage.stored_kwh)
    run = battery_model(storage, step_h, grid_limit_kw)
    price = float(kwh_weight.max()) or 1.0
    over_price = _SHORTAGE_FACTOR * steps * price

    def cost(t: int, grid_kwh: F64) -> F64:
        over_kwh = np.maximum(grid_kwh - most_grid_kw * step_h, 0.0)
        return np.asarray(kwh_weight[t] * grid_kwh + over_price * over_kwh)

    levels = np.linspace(0.0, capacity, LEVELS)
    missing_price = _SHORTAGE_FACTOR * price / min(storage.charge_efficiency, 1.0)
    values = np.empty((steps + 1, LEVELS))
    values[steps] = missing_price * np.maximum(end_kwh - levels, 0.0)
    for t in range(steps - 1, -1, -1):
        result = run(levels[:, None], COMMANDS, facility_kwh[t])
        options = cost(t, result.grid_kwh) + np.interp(result.stored_kwh, levels, values[t + 1])
        values[t] = options.min(axis=1)
    return _follow(storage, facility_kwh, values, levels, run, cost, step_h, end_kwh)


def storage_parameters(storage: Storage) -> BatteryParameters:
    """Return the parameters of the battery models: efficiencies, rates and limits."""
    return BatteryParameters(*(getattr(storage, name) for name in BatteryParameters._fields))


def battery_model(storage: Storage, step_h: float, grid_limit_kw: float) -> BatteryModel:
    """Return a battery model as a function of stored energy, command and facility energy.

    Args:
        storage: The battery.
        step_h: Length of a step, in h.
        grid_limit_kw: Power bought at which the battery stops charging, in kW; inf without a limit.
    """
    model, parameters = BATTERIES[storage.model], storage_parameters(storage)

    def run(stored_kwh: F64, command: F64, facility_kwh: F64 | float) -> BatteryResult:
        limit_kw = None if np.isinf(grid_limit_kw) else grid_limit_kw
        load_kw = facility_kwh / step_h
        point = BatteryPoint(storage.capacity_kwh, load_kw, step_h, parameters, limit_kw)
        return model.step(stored_kwh, command, point)

    return run


def _follow(
    storage: Storage,
    facility_kwh: F64,
    values: F64,
    levels: F64,
    run: BatteryModel,
    cost: Callable[[int, F64], F64],
    step_h: float,
    end_kwh: float,
) -> F64:
    """Apply the cheapest command in each step; return the stored energy after it, in kWh, (T,).

    Args:
        storage: The battery, with its stored energy before the first step.
        facility_kwh: Energy of the facility in each step, in kWh, (T,).
        values: Cost-to-go by step and level, (T + 1, levels).
        levels: Levels of stored energy, in kWh, (levels,).
        run: Battery model.
        cost: Cost of the energy bought in a step, by number of the step and energy in kWh.
        step_h: Length of a step, in h.
        end_kwh: Minimum energy stored at the end, in kWh.
    """
    stored = np.array([storage.stored_kwh])
    path = np.empty(len(facility_kwh))
    fine = np.linspace(-1.0, 1.0, 4 * (len(COMMANDS) - 1) + 1)
    capacity = np.array([storage.capacity_kwh])
    parameters = BatteryParameters(*(np.array([x]) for x in storage_parameters(storage)))
    converted = conversion(storage.model, parameters, capacity, step_h)
    for t, load_kwh in enumerate(facility_kwh):
        exact = battery_command(
            bus_energy_kwh(np.array([end_kwh]), stored, converted),
            model=storage.model,
            stored_kwh=stored,
            load_kw=np.array([load_kwh / step_h]),
            step_h=step_h,
            capacity_kwh=capacity,
            parameters=parameters,
        )
        result = run(stored, np.concatenate([fine, exact, np.zeros(1)]), load_kwh)
        options = cost(t, result.grid_kwh) + np.interp(result.stored_kwh, levels, values[t + 1])
        stored = result.stored_kwh[[int(options.argmin())]]
        path[t] = stored[0]
    return path
