"""Results of the optimisation: bound, best simulated plan, and the value of end states."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from sdc_taichi.optimum.cache import Cache
from sdc_taichi.optimum.linear_programme import bound
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import Agent, Ends, Problem, StoppedError
from sdc_taichi.optimum.task import Task
from sdc_taichi.plant.workload import UNLIMITED_TASKS
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.workload import queue_limit_tasks
from sdc_taichi.types import F64, I64


@dataclass(frozen=True, slots=True)
class Optimum:
    """Bound, best simulated figure and best commands of B data centers in a run of T steps.

    Figures are values of the objective; smaller figures are better.
    """

    names: tuple[str, ...]
    """Names of the data centers."""
    fingerprint: str
    """Fingerprint of configs, inputs and precision (``Simulator.fingerprint``)."""
    objective: Objective
    """Objective that the plans minimise."""
    agents: tuple[Agent, ...]
    """Agents that the plans control; the others follow idle commands."""
    start: I64
    """First step of each data center, counted from the beginning of the year, (B,)."""
    seed: I64
    """Seed of the sampled events of each data center, (B,); 0 without sampled events."""
    steps: int
    """Number of steps, T."""
    scored_from: int
    """Number of the first scored step."""
    inlet_limit_c: F64
    """Highest inlet temperature that plans may cause if another setpoint avoids it, in C, (B,); inf
    without a limit."""
    idle: F64
    """Figure under idle commands, (B,)."""
    idle_dropped_tasks: F64
    """Work dropped because the queue is full under idle commands, in tasks, (B,)."""
    bound: F64
    """Lower bound of the figure, (B,); nan if there is none. It holds for every controller that
    satisfies the constraints and ends in the state in which it began."""
    achieved: F64
    """Lowest figure of the simulated plans that satisfy the constraints, (B,)."""
    alone: Mapping[str, F64]
    """Lowest figure of simulated plans that move one agent alone, by agent, (B,) each."""
    uncoordinated: Mapping[str, F64]
    """Figures of plans that agents make without coordination, (B,) each, by the names of
    ``uncoordinated.uncoordinated``; empty if they were not asked for."""
    bound_kinds: tuple[str, ...]
    """Kind of each data center's bound: ``bound``, or ``estimate`` or ``none`` and the reason."""
    failures: tuple[tuple[str, ...], ...]
    """Constraints that simulated plans of each data center break, in words."""
    certificates: tuple[Mapping[str, float], ...]
    """Measurements of the simulator for the best plan of each data center, by name."""
    load: F64
    """Load commands of the best plan, (T, B)."""
    cooling: F64
    """Cooling commands of the best plan, in steps of the setpoint, (T, B)."""
    battery: F64
    """Battery commands of the best plan, (T, B)."""
    loops: F64
    """Commands of the coolant loops in the best plan, (T, B, 3): supply setpoint in C, flow as a
    share of design, and approach in K; nan holds the loops."""
    bound_of_ends: Callable[[int, Ends], float]
    """Function that returns the bound of a data center, by its index, for given start and end
    states; nan if there is no bound."""

    @property
    def gap_points(self) -> F64:
        """Difference between achieved figure and bound, in % of the idle figure, (B,)."""
        return np.asarray(100.0 * (self.achieved - self.bound) / self.idle)

    def end_value(self, start_kwh: F64, start_tasks: F64, end_kwh: F64, end_tasks: F64) -> F64:
        """Return the minimum cost of reaching a run's end state instead of its start state.

        The cost is V(start, end) - V(start, start), where V is the bound for given start and end
        states.

        Args:
            start_kwh: Energy stored at the first scored step, in kWh, (B,).
            start_tasks: Work that waits at the first scored step, in tasks, (B,).
            end_kwh: Energy stored at the end, in kWh, (B,).
            end_tasks: Work that waits at the end, in tasks, (B,).

        Returns:
            The cost in the unit of the objective, (B,); 0 if start and end state are equal, nan if
            they differ and there is no bound.
        """
        value = np.zeros(len(self.names))
        for i in range(len(self.names)):
            kwh, tasks = start_kwh[i], start_tasks[i]
            if (end_kwh[i], end_tasks[i]) == (kwh, tasks):
                continue
            ends, cyclic = Ends(kwh, tasks, end_kwh[i], end_tasks[i]), Ends(kwh, tasks, kwh, tasks)
            value[i] = self.bound_of_ends(i, ends) - self.bound_of_ends(i, cyclic)
        return value


_KWH_SHARES = np.array([0.0, 0.35, 0.65, 0.95])
"""Stored energy at the nodes of a curve, as a share of capacity. A full battery is no node, because
it may be unreachable."""
_TASK_SHARES = np.array([0, 1, 2, 3, 4, 6, 8, 13]) / 16.0
"""Waiting work at the nodes of a curve, as a share of the longest queue. Nodes are dense at short
queues, where costs change fastest. A full queue is no node, because it may be unreachable."""


class BoundOfEnds:
    """Computes bounds of data centers for given start and end states, and stores them.

    Args:
        task: The data centers with their inputs and options.
        kinds: Kind of each data center's bound, B.
        cache: Cache of bounds on disk; None uses no cache.
    """

    def __init__(self, task: Task, kinds: Sequence[str], cache: Cache | None = None) -> None:
        self._task, self._kinds, self._cache = task, kinds, cache
        self._problem: tuple[int, Problem] | None = None
        self._known: dict[int, dict[Ends, float]] = {}

    def __call__(self, dc: int, ends: Ends) -> float:
        """Return the bound of data center ``dc`` for given end states; nan if there is none."""
        if self._kinds[dc].startswith("none"):
            return float("nan")
        if dc not in self._known:
            cached = {} if self._cache is None else self._cache.find_ends(self._keys[dc])
            self._known[dc] = cached
        known = self._known[dc]
        if ends not in known:
            known[ends] = bound(self._problem_of(dc), ends).figure
            if self._cache is not None:
                self._cache.keep_ends(self._keys[dc], known)
        return known[ends]

    @cached_property
    def _keys(self) -> list[str]:
        return self._task.keys()

    def _problem_of(self, dc: int) -> Problem:
        """Return the planning problem of a data center, and store it for the next call."""
        if self._problem is None or self._problem[0] != dc:
            part = self._task.part([dc])
            self._problem = dc, part.problems()[0]
        return self._problem[1]


def with_tabled_ends(
    optimum: Optimum,
    sim: Simulator,
    *,
    progress: Callable[[str, int, int], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Optimum:
    """Return an optimum that approximates the bound of end states by fast curves.

    The curves serve to compare many controllers. The value of stored energy at the end hardly
    depends on the work that waits at the end, and neither value depends much on the state days
    before. The approximate bound is therefore the sum of two piecewise linear curves, through a
    dozen exact bounds. Only differences of this sum between two end states are meaningful.

    The last segments are extrapolated to a full battery and a full queue, where the exact bounds
    are nonlinear. The last percent of a battery fills so slowly that a kWh there is worth ten
    times as much as the previous ones, and a queue cannot exceed the work that may still be
    deferred.

    The error was measured at random end states of up to 98 % of the battery and 85 % of the queue.
    For a week of preset ``corrected`` it was up to 0.015 % of the figure, or 0.4 % of the
    achievable saving. With more flexible work and a battery of 4 h it was 0.3 % and 2 %. For the
    bill, whose peak depends on the initial state, it was 0.4 % and 3 %. Errors have both signs and
    cancel in means of many weeks.

    Args:
        optimum: Optimum of the simulator's data centers.
        sim: The simulator.
        progress: Progress callback ``(stage, done, total)``, in data centers.
        stop: Called before each exact bound; the work ends if it returns True.

    Returns:
        An optimum with approximate end values, or ``optimum`` itself if a queue has no limit.

    Raises:
        StoppedError: ``stop`` returned True; bounds that were computed stay in the cache.
    """
    limits = queue_limit_tasks(sim.fleet)
    if np.any(limits >= UNLIMITED_TASKS):
        return optimum

    def bound_of(dc: int, ends: Ends) -> float:
        if stop is not None and stop():
            raise StoppedError("values of ends were stopped")
        return optimum.bound_of_ends(dc, ends)

    full_kwh = sim.sizing.battery_kwh * sim.fleet.values("battery.upper_v")
    curves = []
    for dc in range(sim.size):
        if progress is not None:
            progress("values of ends", dc, sim.size)
        most_kwh = float(full_kwh[dc]) if "battery" in optimum.agents else 0.0
        most_tasks = float(limits[dc]) if "load" in optimum.agents else 0.0
        curves.append(_ends_curve(partial(bound_of, dc), most_kwh, most_tasks))
    return replace(optimum, bound_of_ends=lambda dc, ends: curves[dc](ends))


def _ends_curve(
    bound_of: Callable[[Ends], float], most_kwh: float, most_tasks: float
) -> Callable[[Ends], float]:
    """Return a function that approximates the bound by stored energy and waiting work at the end.

    Args:
        bound_of: Exact bound for given start and end states.
        most_kwh: Stored energy of a full battery, in kWh.
        most_tasks: Longest queue, in tasks.
    """
    kwh, tasks = np.unique(most_kwh * _KWH_SHARES), np.unique(most_tasks * _TASK_SHARES)

    def exact(end_kwh: float, end_tasks: float) -> float:
        return bound_of(Ends(most_kwh / 2, 0.0, float(end_kwh), float(end_tasks)))

    of_kwh = np.array([exact(x, 0.0) for x in kwh])
    of_tasks = np.array([of_kwh[0], *(exact(0.0, x) for x in tasks[1:])])
    return lambda ends: (
        _line(ends.end_kwh, kwh, of_kwh) + _line(ends.end_tasks, tasks, of_tasks) - float(of_kwh[0])
    )


def _line(x: float, nodes: F64, values: F64) -> float:
    """Interpolate linearly between nodes; outside the nodes, continue the nearest segment."""
    if len(nodes) == 1:
        return float(values[0])
    i = int(np.clip(np.searchsorted(nodes, x), 1, len(nodes) - 1))
    slope = (values[i] - values[i - 1]) / (nodes[i] - nodes[i - 1])
    return float(values[i] + slope * (x - nodes[i]))
