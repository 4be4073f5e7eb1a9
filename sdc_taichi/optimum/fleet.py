"""Optimum of fleets that share work: a bound by one linear programme per fleet, and its roll-out.

The programme has the convex curves, the queue and the deadline of each site as the programme of a
data center alone (``linear_programme``), without its battery, which rests. Sites send y and get z
through a hub: the sums of both are equal in each step and residency group, so there are 2 S instead
of S^2 variables per step. Work arrives after the delay; y is at most the flexible work that
arrives, y and z are at most what the links of the site carry, and either end pays half of a
transfer. Balances hold for each hour; within an hour work may run in any step. This and the hub,
which ignores the links between pairs and the room of receivers, relax the problem, so the minimum
is a lower bound. What the simulator does with the plan is the achieved figure.

S is the number of sites of a fleet, F of fleets, B = F S of data centers, T of steps and H of
hours.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sdc_taichi.errors import ConfigError, whole_number
from sdc_taichi.optimum.cache import cache_in, key_of
from sdc_taichi.optimum.objective import CARBON, Objective, Score
from sdc_taichi.optimum.paths import cheapest_setpoints_c
from sdc_taichi.optimum.problem import (
    RAMP_K,
    FlexibleWork,
    Problem,
    StoppedError,
    no_table_reasons,
    problems_of,
)
from sdc_taichi.optimum.programme import InfeasibleError, Linear, Programme
from sdc_taichi.optimum.stage_cost import LoadCurves, load_curves, stage_cost
from sdc_taichi.optimum.tables import facility_kwh, facility_tables
from sdc_taichi.plant.cooling import avoid_repeats
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim import snapshot
from sdc_taichi.sim.bills import with_prices
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.shared_work import SharedWork
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.transfer import task_kwh, transfer_kwh_per_task
from sdc_taichi.sim.workload import due_entries, due_steps, due_work, queue_length
from sdc_taichi.types import F64, I64, Actions, State, StepResult

UTILISATIONS = 21
"""Number of utilisations of the tables; with 41, bounds are 0.02 % tighter."""
MOST_H = 31 * 24
"""Maximum length of a plan, in h."""


@dataclass(frozen=True, slots=True)
class Hub:
    """Limits of a fleet of S sites in a programme."""

    flexible_tasks: F64
    """Work that may leave each site in each step, in tasks, (S, T)."""
    most_sent: F64
    """Most work that leaves each site in a step, in tasks, (S,)."""
    most_got: F64
    """Most work that goes to each site in a step, in tasks, (S,)."""
    groups: tuple[tuple[int, ...], ...]
    """Sites of each residency group."""
    delay_h: int
    """Time from departure to arrival, in whole hours."""
    steps_per_hour: int
    """Number of steps in an hour."""
    half_weight: F64
    """Weight of a task that leaves or goes to a site in each step: half of the energy of the
    transfer times the weight of a kWh, (S, T)."""
    power_limit_kwh: float
    """Most energy of all facilities in a step, in kWh; inf without a limit."""
    waiting_tasks: F64
    """Work that waits at the start or is in flight then, in the step from which it can run, in
    tasks, (S, T)."""


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """Plan of a fleet of S sites for T steps."""

    figure: float
    """Minimum of the programme, in kg CO2e."""
    flow_tasks: F64
    """Work that goes from each site (row) to each site (column), in tasks, (T, S, S)."""
    executed_tasks: F64
    """Work that each site executes, in tasks, (T, S)."""


def fleet_plan(
    works: Sequence[FlexibleWork], curves: Sequence[LoadCurves], hub: Hub, *, move: bool = True
) -> FleetPlan:
    """Solve the linear programme of a fleet.

    Queues are empty after the last step, and no work is in flight then.

    Args:
        works: Work of each of S sites.
        curves: Cost and energy of each site by executed work.
        hub: Limits of the transfers.
        move: False keeps all work at its site.

    Raises:
        InfeasibleError: No plan satisfies the limits.
    """
    from scipy import sparse

    programme, base = Programme(), 0.0
    sent, got, run, power = [], [], [], []
    steps, per_hour = len(works[0].arrived_tasks), hub.steps_per_hour
    starts = np.arange(0, steps, per_hour)
    delay, hours = hub.delay_h, len(starts)
    of_hour = np.diff(np.append(starts, steps)).astype(np.float64)
    for s, (work, curve) in enumerate(zip(works, curves, strict=True)):
        size, name = len(curve.step), f"segment {s}"
        programme.variables(name, size, upper=curve.width_tasks, cost=curve.slope_cost)
        places = curve.step // per_hour, np.arange(size)

        def hourly(values: F64, at: I64 = starts) -> F64:
            return np.asarray(np.add.reduceat(values, at))

        def of_segments(per_task: F64, name: str = name, places: Any = places) -> Linear:
            shape = hours, len(per_task)
            return Linear(
                np.zeros(hours), {name: sparse.csr_array((per_task, places), shape=shape)}
            )

        executed = of_segments(np.ones(size)) + hourly(curve.least_tasks)
        power.append(of_segments(curve.slope_kwh) + hourly(curve.base_kwh))
        base += float(curve.base_cost.sum())
        flexible = hourly(hub.flexible_tasks[s])
        # The mean weight of an hour would not be a bound; the lowest is.
        weight = np.minimum.reduceat(hub.half_weight[s], starts)
        most_sent, most_got = (
            of_hour * most[s] if move else np.zeros(hours) for most in (hub.most_sent, hub.most_got)
        )
        y = programme.variables(
            f"sent {s}", hours, upper=np.minimum(flexible, most_sent), cost=weight
        )
        z = programme.variables(f"got {s}", hours, upper=most_got, cost=weight)
        q = programme.variables(f"queue {s}", hours, upper=work.queue_limit_tasks)
        landed = z.shifted(delay)
        waiting = hourly(hub.waiting_tasks[s])
        arrived = hourly(work.arrived_tasks) + waiting
        programme.equal(f"balance {s}", q, q.before(0.0) - y + landed - executed + arrived)
        if work.deadline_steps is not None:
            came = programme.variables(f"came {s}", hours)
            programme.equal(f"coming {s}", came, came.before(0.0) - y + landed + flexible + waiting)
            deadline = -(-work.deadline_steps // per_hour)
            programme.at_most(f"deadline {s}", q, came - came.shifted(deadline))
        programme.equal(f"end {s}", q[-1], 0.0)
        if delay:
            programme.equal(f"in flight {s}", z[np.arange(hours - delay, hours)], 0.0)
        sent.append(y)
        got.append(z)
    for i, group in enumerate(hub.groups):
        programme.equal(f"hub {i}", _sum([sent[s] for s in group]), _sum([got[s] for s in group]))
    if np.isfinite(hub.power_limit_kwh):
        programme.at_most("power", _sum(power), of_hour * hub.power_limit_kwh)
    solution = programme.solve()
    net = np.stack([solution.of(y) - solution.of(z) for y, z in zip(sent, got, strict=True)])
    for s, curve in enumerate(curves):
        used = np.bincount(curve.step, solution.values[f"segment {s}"], minlength=steps)
        run.append(curve.least_tasks + used)
    # Within an hour, work leaves and comes in proportion to what may leave the sender.
    which = np.repeat(np.arange(hours), of_hour.astype(np.int64))
    flexible = hub.flexible_tasks
    shares = flexible / np.maximum(np.add.reduceat(flexible, starts, axis=1)[:, which], 1e-9)
    flows = np.zeros((steps, len(works), len(works)))
    for group in hub.groups:
        rows = list(group)
        out, into = np.maximum(net[rows], 0.0).T, np.maximum(-net[rows], 0.0).T
        total = into.sum(axis=1)[:, None, None]
        pairs = out[:, :, None] * into[:, None, :] / np.where(total > 0.0, total, 1.0)
        flows[np.ix_(range(steps), rows, rows)] = pairs[which] * shares[rows].T[:, :, None]
    return FleetPlan(base + solution.figure, flows, np.stack(run, axis=1))


class WorkCommands:
    """Computes commands with which B data centers of fleets run and send given work.

    Args:
        fleet: F fleets of S sites.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._flexible_share = fleet.values("workload.flexible_share")
        self._capacity = fleet.values("workload.max_utilisation") * TASKS_PER_STEP
        self._due_entries = due_entries(queue_length(fleet), due_steps(fleet))

    def at_site(self, state: State, demand: F64, flow: F64) -> F64:
        """Return the work at each site that is not in its queue, in tasks, (B,).

        Args:
            state: State before the step.
            demand: Work that arrives as a share of capacity, (B,).
            flow: Work to send to each site of the fleet, in tasks, (B, S).
        """
        return np.asarray(demand * TASKS_PER_STEP - flow.sum(axis=1) + state.in_flight[:, 0])

    def actions(
        self, state: State, demand: F64, flow: F64, executed_tasks: F64, rise_c: F64
    ) -> Actions:
        """Return commands that come as close as possible to the given work.

        Args:
            state: State before the step.
            demand: Work that arrives as a share of capacity, (B,).
            flow: Work to send to each site of the fleet, in tasks, (B, S).
            executed_tasks: Work to execute, in tasks, (B,).
            rise_c: Cooling command of each CRAC unit, in steps of the setpoint, (U,).
        """
        flexible = self._flexible_share * demand * TASKS_PER_STEP
        due = due_work(state.queue, self._due_entries)
        forced = np.minimum(due, self._capacity)
        at_site = self.at_site(state, demand, flow)
        neutral = np.minimum(at_site, self._capacity - forced) + forced
        drain = _share(executed_tasks - neutral, self._capacity - neutral)
        may_wait = np.maximum(flexible - flow.sum(axis=1), 0.0) + state.in_flight[:, 0]
        defer = _share(neutral - executed_tasks, may_wait)
        return Actions(
            load=np.where(executed_tasks >= neutral, drain, -defer),
            cooling=rise_c,
            transfer=flow / np.where(flexible > 0.0, flexible, 1.0)[:, None],
        )


class FleetFollower:
    """Computes commands with which B data centers follow the plans of their fleets.

    Args:
        fleet: F fleets of S sites.
        drivers: Inputs of the data centers, with the first step of the run.
        flows: Planned transfers, in tasks, (T, F, S, S).
        queue_tasks: Planned work in the queue after each step, in tasks, (T, B).
        setpoint_c: Planned setpoint of each step, in C, (T, B).
    """

    def __init__(
        self, fleet: Fleet, drivers: Drivers, flows: F64, queue_tasks: F64, setpoint_c: F64
    ) -> None:
        self._drivers, self._unit_dc = drivers, fleet.unit_dc
        self._flows = flows.reshape(len(flows), fleet.size, -1)
        self._queue_tasks, self._setpoint_c = queue_tasks, setpoint_c
        self._commands = WorkCommands(fleet)
        self._step_k = fleet.values("hvac.setpoint.step_k")[fleet.unit_dc]

    def actions(self, state: State) -> Actions:
        """Return the commands of the coming step."""
        flow, demand = self._flows[state.step], self._drivers.at(state.step).demand
        at_site = self._commands.at_site(state, demand, flow)
        executed = state.queue[:, -1] + at_site - self._queue_tasks[state.step]
        rise_k = self._setpoint_c[state.step][self._unit_dc] - state.setpoint_c
        rise_k = np.clip(rise_k, -RAMP_K, RAMP_K)
        command = avoid_repeats(rise_k / self._step_k, state.cooling_last)
        return self._commands.actions(state, demand, flow, executed, command)


@dataclass(frozen=True, slots=True)
class FleetOptimum:
    """Bound and achieved emissions of F fleets in a run of T steps, transfers included."""

    steps: int
    """Number of steps, T."""
    idle_g: F64
    """Emissions of each fleet under idle commands, in g CO2e, (F,)."""
    cooled_g: F64
    """Emissions of each fleet if all work runs where and when it arrives, at the cheapest
    setpoints, in g CO2e, (F,)."""
    stay_g: F64
    """Lower bound of the emissions if all work stays at its site, in g CO2e, (F,)."""
    bound_g: F64
    """Lower bound of the emissions, in g CO2e, (F,)."""
    achieved_g: F64
    """Emissions of the simulated plan, in g CO2e, (F,)."""
    table_error: F64
    """Relative error of the tables' energy in the simulated plan, by which the bounds are lowered,
    (F,)."""
    idle_dropped_tasks: F64
    """Work that is dropped because queues are full under idle commands, in tasks, (F,)."""
    overdue_tasks: F64
    """Largest overdue work of the sites in a step of the simulated plan, in tasks, (F,)."""

    @property
    def idle(self) -> F64:
        """Emissions under idle commands, in kg CO2e, (F,)."""
        return self.idle_g / 1e3

    @property
    def bound(self) -> F64:
        """Lower bound of the emissions, in kg CO2e, (F,)."""
        return self.bound_g / 1e3

    @property
    def achieved(self) -> F64:
        """Emissions of the simulated plan, in kg CO2e, (F,)."""
        return self.achieved_g / 1e3


class FleetScore(Score):
    """Accumulates the emissions of F fleets, and sums and extremes of their B data centers.

    Args:
        sim: the simulator, directly after a reset.
    """

    def __init__(self, sim: Simulator) -> None:
        super().__init__(CARBON, sim)
        self._sim, self._transfer_g = sim, np.zeros(sim.size)

    def add(self, result: StepResult) -> None:
        """Add the result of the next step; steps must be added in order."""
        super().add(result)
        self._transfer_g += result.transfer_g

    @property
    def figure(self) -> F64:
        """Emissions of each fleet, with transfers and the work that is left, in kg CO2e, (F,)."""
        return self.emitted_g / 1e3

    @property
    def emitted_g(self) -> F64:
        """Emissions of each fleet, with transfers and the work that is left, in g CO2e, (F,)."""
        return emissions_g(self._sim, self._sums["carbon_g"], self._transfer_g, self._steps)

    @property
    def dropped_of_fleets(self) -> F64:
        """Work dropped because queues were full, in tasks, (F,)."""
        return np.asarray(self._of_sites(self.dropped_tasks).sum(axis=1))

    @property
    def overdue_of_fleets(self) -> F64:
        """Maximum overdue work of a site in a step, in tasks, (F,)."""
        return np.asarray(self._of_sites(self.most_overdue_tasks).max(axis=1))

    def _of_sites(self, values: F64) -> F64:
        return values.reshape(-1, self._sim.fleet.sites_per_fleet)


def emissions_g(sim: Simulator, carbon_g: F64, transfer_g: F64, steps: int) -> F64:
    """Return the emissions of each fleet in a run, (F,), with those of work that is left.

    Work that waits or is in flight at the end counts as executed at the mean carbon intensity of
    its site during the run.

    Args:
        sim: Simulator at the end of the run.
        carbon_g: Emissions of each facility, in g CO2e, (B,).
        transfer_g: Emissions of transfers, in g CO2e, (B,).
        steps: Number of steps of the run.
    """
    state, fleet, drivers = sim.state, sim.fleet, sim.drivers
    mean_ci = drivers.ci_g_per_kwh.at(drivers.start[:, None] + np.arange(steps)).mean(axis=1)
    left_tasks = state.queue[:, -1] + state.in_flight.sum(axis=1)
    left_g = left_tasks * task_kwh(fleet, sim.sizing) * mean_ci
    emitted = carbon_g + transfer_g + left_g
    return np.asarray(emitted.reshape(-1, fleet.sites_per_fleet).sum(axis=1))


def solve_fleet(
    sim: Simulator,
    *,
    steps: int,
    cache: bool | str | os.PathLike[str] = False,
    stop: Callable[[], bool] = lambda: False,
) -> FleetOptimum:
    """Compute the least carbon that fleets can emit if all inputs are known.

    Args:
        sim: Simulator of F fleets; it is reset.
        steps: Number of steps, T, from the start of its drivers.
        cache: Whether to read and write an entry for each fleet in the user's cache, or the folder
            to use instead.
        stop: Called before every programme; the work ends when it returns True.

    Raises:
        ConfigError: The data centers share no work, or no plan satisfies the limits.
        StoppedError: ``stop`` returned True.
    """

    def check() -> None:
        if stop():
            raise StoppedError("nothing is kept")

    fleet, shared = sim.fleet, sim.fleet.shared_work
    if shared is None:
        raise ConfigError("optimum of a fleet: the data centers share no work")
    least = shared.delay_steps + 1
    steps = whole_number("steps", steps, least, MOST_H * fleet.steps_per_hour)
    reasons = [reason for reason in no_table_reasons(fleet) if reason]
    if fleet.cdus:
        reasons.append("actions move coolant loops (section liquid), which plans hold")
    if reasons:
        raise ConfigError(f"optimum of a fleet: no bound, since {reasons[0]}")
    sim.reset()
    drivers, sizing, sites = sim.drivers, sim.sizing, fleet.sites_per_fleet
    used_cache = cache_in(cache)
    keys = [] if used_cache is None else _keys(sim, steps)
    if used_cache is not None:
        known = (used_cache.find_figures(key, _FIGURES) for key in keys)
        entries = [entry for entry in known if entry is not None]
        if len(entries) == len(keys):
            return FleetOptimum(steps, **{x: np.array([e[x] for e in entries]) for x in _FIGURES})
    problems = _problems(fleet, drivers, sizing, steps, sim.precision)
    stages = [stage_cost(problem) for problem in problems]
    curves = [load_curves(problem, stage) for problem, stage in zip(problems, stages, strict=True)]
    stay: list[float] = []
    bound: list[float] = []
    flows, queues, setpoints = list[F64](), list[F64](), list[F64]()
    for first in range(0, fleet.size, sites):
        part = slice(first, first + sites)
        works = [problem.work for problem in problems[part]]
        hub = hub_of(
            fleet,
            shared,
            sizing,
            first,
            arrived_tasks=np.stack([work.arrived_tasks for work in works]),
            kwh_weight=np.stack([problem.kwh_weight for problem in problems[part]]),
        )
        roomy = [
            replace(w, queue_limit_tasks=with_room(w.queue_limit_tasks, shared)) for w in works
        ]
        try:
            check()
            plan = fleet_plan(roomy, curves[part], hub)
            check()
            bound.append(fleet_plan(works, curves[part], hub).figure)
        except InfeasibleError:
            names = f"{fleet.names[first]} to {fleet.names[first + sites - 1]}"
            raise ConfigError(f"optimum of {names}: no plan satisfies the limits") from None
        try:
            check()
            stay.append(fleet_plan(works, curves[part], hub, move=False).figure)
        except InfeasibleError:
            # Without transfers, the limit of the power cannot be met.
            stay.append(np.nan)
        flows.append(plan.flow_tasks)
        queues.append(_queue_tasks(works, plan, shared.delay_steps))
        setpoints += [
            _cheapest_c(problem, executed)
            for problem, executed in zip(problems[part], plan.executed_tasks.T, strict=True)
        ]
    follower = FleetFollower(
        fleet,
        drivers,
        np.stack(flows, axis=1),
        np.concatenate(queues, axis=1),
        np.stack(setpoints, axis=1),
    )
    cooled = FleetFollower(
        fleet,
        drivers,
        np.zeros((steps, fleet.size // sites, sites, sites)),
        np.zeros((steps, fleet.size)),
        np.stack([_cheapest_c(p, p.work.idle_tasks) for p in problems], axis=1),
    )
    # Scores read the state at the end of their run, so their emissions are taken before the next.
    score, _ = _run(sim, steps, lambda _: Actions(), problems)
    idle_g, idle_dropped_tasks = score.emitted_g, score.dropped_of_fleets
    cooled_g = _run(sim, steps, cooled.actions, problems)[0].emitted_g
    score, error = _run(sim, steps, follower.actions, problems)
    lowered = 1.0 - error - 1e-6
    optimum = FleetOptimum(
        steps=steps,
        idle_g=idle_g,
        cooled_g=cooled_g,
        stay_g=1e3 * np.array(stay) * lowered,
        bound_g=1e3 * np.array(bound) * lowered,
        achieved_g=score.emitted_g,
        table_error=error,
        idle_dropped_tasks=idle_dropped_tasks,
        overdue_tasks=score.overdue_of_fleets,
    )
    for at, key in enumerate(keys):
        assert used_cache is not None  # Without a cache there are no keys.
        used_cache.keep_figures(key, {name: getattr(optimum, name)[at] for name in _FIGURES})
    return optimum


_FIGURES = tuple(field.name for field in fields(FleetOptimum) if field.name != "steps")
"""Names of the figures of a fleet that a cache keeps."""


def _keys(sim: Simulator, steps: int) -> list[str]:
    """Return the cache key of each fleet: a hash of configs, inputs and length of the run."""
    fleet, drivers, sites = sim.fleet, sim.drivers, sim.fleet.sites_per_fleet
    keys = []
    for first in range(0, fleet.size, sites):
        where = list(range(first, first + sites))
        fingerprint = snapshot.fingerprint(
            build_fleet([fleet.configs[i] for i in where]), drivers.take(where), sim.precision
        )
        options = {"fleet": steps, "start": drivers.start[where].tolist()}
        keys.append(key_of(fingerprint, options))
    return keys


def with_room(queue_limit_tasks: float, shared: SharedWork) -> float:
    """Return the longest queue of a plan, which leaves a site room for the work on its way to it.

    A site takes no work for which its queue has no room (``sim.transfer``).
    """
    on_way_tasks = (shared.delay_steps + 1) * TASKS_PER_STEP
    return max(queue_limit_tasks - on_way_tasks, 0.5 * queue_limit_tasks)


def _problems(
    fleet: Fleet, drivers: Drivers, sizing: Sizing, steps: int, precision: Precision
) -> list[Problem]:
    """Return the planning problem of each of B data centers, with load and cooling to move."""
    priced = with_prices(drivers, fleet.configs)
    tables = facility_tables(
        fleet,
        priced,
        start=drivers.start,
        steps=steps,
        utilisations=UTILISATIONS,
        precision=precision,
    )
    problems = problems_of(
        fleet,
        priced,
        sizing,
        tables,
        start=drivers.start,
        objective=Objective(carbon=1.0),
        agents=("load", "cooling"),
    )
    # A step executes at least its work that may not wait, or else all that its capacity allows.
    return [
        replace(p, work=replace(p.work, most_deferred_tasks=share * p.work.arrived_tasks))
        for p, share in zip(problems, fleet.values("workload.flexible_share"), strict=True)
    ]


def hub_of(
    fleet: Fleet,
    shared: SharedWork,
    sizing: Sizing,
    first: int,
    *,
    arrived_tasks: F64,
    kwh_weight: F64,
    waiting_tasks: F64 | None = None,
) -> Hub:
    """Return the limits of one fleet of a batch, with the delay rounded down to whole hours.

    Args:
        fleet: F fleets of S sites.
        shared: Their links and budgets.
        sizing: Their sized devices.
        first: Index of the fleet's first data center.
        arrived_tasks: Work that arrives at each site, in tasks, (S, T).
        kwh_weight: Weight of a kWh at each site, (S, T).
        waiting_tasks: See ``Hub``; None means no work.
    """
    sites = fleet.sites_per_fleet
    part = slice(first, first + sites)
    allowed, site_tasks = shared.allowed[part] > 0.0, shared.site_tasks[part]
    pairs = np.where(allowed, shared.pair_tasks[part], 0.0)
    groups = dict.fromkeys(
        tuple(np.flatnonzero(row | (np.arange(sites) == s)).tolist())
        for s, row in enumerate(allowed)
    )
    share = fleet.values("workload.flexible_share")[part]
    kwh = transfer_kwh_per_task(fleet, sizing)[part]
    return Hub(
        flexible_tasks=share[:, None] * arrived_tasks,
        most_sent=np.minimum(pairs.sum(axis=1), site_tasks),
        most_got=np.minimum(pairs.sum(axis=0), site_tasks),
        groups=tuple(groups),
        delay_h=shared.delay_steps // fleet.steps_per_hour,
        steps_per_hour=fleet.steps_per_hour,
        half_weight=0.5 * kwh[:, None] * kwh_weight,
        power_limit_kwh=float(
            np.nan_to_num(shared.power_kw(sizing.facility_w)[first], nan=np.inf)
            / fleet.steps_per_hour
        ),
        waiting_tasks=np.zeros(arrived_tasks.shape) if waiting_tasks is None else waiting_tasks,
    )


def _cheapest_c(problem: Problem, executed_tasks: F64) -> F64:
    """Return the cheapest setpoints for known work, in C, (T,)."""
    return cheapest_setpoints_c(problem, np.minimum(executed_tasks / TASKS_PER_STEP, 1.0))


def _queue_tasks(works: Sequence[FlexibleWork], plan: FleetPlan, delay_steps: int) -> F64:
    """Return the work in the queue of each site after each step, in tasks, (T, S)."""
    landed = np.zeros(plan.executed_tasks.shape)
    landed[delay_steps:] = plan.flow_tasks.sum(axis=1)[:-delay_steps]
    arrived = np.stack([work.arrived_tasks for work in works], axis=1)
    rise = arrived - plan.flow_tasks.sum(axis=2) + landed - plan.executed_tasks
    queue, waiting = np.empty(rise.shape), np.zeros(len(works))
    limit = np.array([work.queue_limit_tasks for work in works])
    for t, more in enumerate(rise):
        queue[t] = waiting = np.clip(waiting + more, 0.0, limit)
    return queue


def _run(
    sim: Simulator,
    steps: int,
    actions: Callable[[State], Actions],
    problems: Sequence[Problem],
) -> tuple[FleetScore, F64]:
    """Run all data centers; return the score and the error of the tables, (F,)."""
    sim.reset()
    rows = {name: np.empty((steps, sim.size)) for name in ("utilisation", "setpoint_c", "kwh")}
    score = FleetScore(sim)
    for t in range(steps):
        result = sim.step(actions(sim.state))
        score.add(result)
        rows["utilisation"][t], rows["setpoint_c"][t] = result.utilisation, result.setpoint_c
        rows["kwh"][t] = result.facility_kwh
    off_kwh = [
        abs(
            facility_kwh(p.table, rows["utilisation"][:, i], rows["setpoint_c"][:, i])
            - rows["kwh"][:, i]
        ).sum()
        for i, p in enumerate(problems)
    ]
    sites = sim.fleet.sites_per_fleet
    of_fleets = np.array(off_kwh).reshape(-1, sites).sum(axis=1)
    return score, of_fleets / rows["kwh"].sum(axis=0).reshape(-1, sites).sum(axis=1)


def _sum(parts: Sequence[Linear]) -> Linear:
    """Return the sum of expressions of T rows each."""
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def _share(part: F64, whole: F64) -> F64:
    """Return part / whole limited to 0..1, 0 where the whole is 0."""
    return np.clip(part / np.where(whole > 1e-9, whole, np.inf), 0.0, 1.0)
