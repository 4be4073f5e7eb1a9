"""Results: bound, achieved figure and path of data centers, and the value of states at the end."""

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
    """Bound and achieved figure of B data centers over T steps, and the commands that achieve it.

    Figures are in the unit of the objective, and less is better.
    """

    names: tuple[str, ...]
    """Names of the data centers."""
    fingerprint: str
    """Fingerprint of configs, inputs and precision (``Simulator.fingerprint``)."""
    objective: Objective
    """Objective that plans minimise."""
    agents: tuple[Agent, ...]
    """Agents that the plans may move."""
    start: I64
    """First step of each data center, counted from the beginning of the year, (B,)."""
    seed: I64
    """Seed of the sampled events of each data center, (B,); 0 where none are sampled."""
    steps: int
    """Number of steps, T."""
    scored_from: int
    """First step that counts."""
    inlet_limit_c: F64
    """Highest inlet that plans may cause where they have a choice, in C, (B,); inf without."""
    idle: F64
    """Figure under idle commands, (B,)."""
    idle_dropped_tasks: F64
    """Work that finds the queue full under idle commands, in tasks, (B,)."""
    bound: F64
    """No controller that keeps the constraints and ends as it began comes below this figure, (B,);
    nan if none is known."""
    achieved: F64
    """Lowest figure that the simulator reached and that keeps the constraints, (B,)."""
    alone: Mapping[str, F64]
    """Lowest figure reached with one agent alone, by its name, (B,) each."""
    bound_kinds: tuple[str, ...]
    """Kind of the bound of each data center: ``bound``, or ``estimate`` or ``none``, and why."""
    failures: tuple[tuple[str, ...], ...]
    """Certificates of each data center that do not hold, in words."""
    certificates: tuple[Mapping[str, float], ...]
    """Measurements when the simulator ran the plan of each data center, by name."""
    load: F64
    """Load commands of the achieved path, (T, B)."""
    cooling: F64
    """Cooling commands of the achieved path, in steps of the setpoint, (T, B)."""
    battery: F64
    """Battery commands of the achieved path, (T, B)."""
    bound_of_ends: Callable[[int, Ends], float]
    """Bound of a data center, by its index, with given ends; nan where there is none."""

    @property
    def gap_points(self) -> F64:
        """Distance of the achieved figure from the bound, in % of the idle figure, (B,)."""
        return np.asarray(100.0 * (self.achieved - self.bound) / self.idle)

    def end_value(self, start_kwh: F64, start_tasks: F64, end_kwh: F64, end_tasks: F64) -> F64:
        """Least cost of ending as a controller did, beyond that of ending as it began.

        It is V(start, end) - V(start, start), where V is the bound with given ends.

        Args:
            start_kwh: Energy stored at the first scored step, in kWh, (B,).
            start_tasks: Work that waits at the first scored step, in tasks, (B,).
            end_kwh: Energy stored at the end, in kWh, (B,).
            end_tasks: Work that waits at the end, in tasks, (B,).

        Returns:
            The value in the unit of the objective, (B,); nan where there is no bound and ends
            differ.
        """
        value = np.zeros(len(self.names))
        for i in range(len(self.names)):
            kwh, tasks = start_kwh[i], start_tasks[i]
            if (end_kwh[i], end_tasks[i]) == (kwh, tasks):
                continue
            own, cyclic = Ends(kwh, tasks, end_kwh[i], end_tasks[i]), Ends(kwh, tasks, kwh, tasks)
            value[i] = self.bound_of_ends(i, own) - self.bound_of_ends(i, cyclic)
        return value


_KWH_SHARES = np.array([0.0, 0.35, 0.65, 0.95])
"""Energy stored at the nodes of a curve, as a share of capacity; it may never be full."""
_TASK_SHARES = np.array([0, 1, 2, 3, 4, 6, 8, 13]) / 16.0
"""Work that waits at the nodes of a curve, as a share of the longest queue. The first hours of it
cost most, and the longest queue may be unreachable."""


class BoundOfEnds:
    """Bounds of data centers with given ends, computed when they are first asked for.

    Args:
        task: The data centers.
        kinds: Kind of the bound of each, B.
        cache: Keeps them for later; None keeps none.
    """

    def __init__(self, task: Task, kinds: Sequence[str], cache: Cache | None = None) -> None:
        self._task, self._kinds, self._cache = task, kinds, cache
        self._problem: tuple[int, Problem] | None = None
        self._known: dict[int, dict[Ends, float]] = {}

    def __call__(self, dc: int, ends: Ends) -> float:
        """Bound of a data center, by its number, with given ends; nan where there is none."""
        if self._kinds[dc].startswith("none"):
            return float("nan")
        if dc not in self._known:
            kept = {} if self._cache is None else self._cache.find_ends(self._keys[dc])
            self._known[dc] = kept
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
        """Planning problem of a data center; that of the last call is kept."""
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
    """An optimum that values ends by curves, for many controllers to be compared with it.

    What energy stored at the end is worth hardly depends on the work that waits there, nor either
    of them on the state days before. So the bound with given ends is the sum of two curves, linear
    between a dozen bounds and beyond the last of them; only its differences between ends mean
    something. The last segments go on to a full battery and queue, where bounds bend: the last
    percent of a battery fills so slowly that a kWh there is worth ten of those before, and no more
    work can wait than may still be put off.

    With random ends below these bends (up to 98 % of the battery and 85 % of the queue), values
    were off by up to 0.015 % of the figure of a week of preset ``corrected``, which is 0.4 % of the
    achievable. With more flexible work and a battery of 4 h it was 0.3 % and 2 %, for the bill,
    where the state at the beginning shaves the peak of the demand charge, 0.4 % and 3 %. Errors
    have either sign, and cancel over many weeks.

    Args:
        optimum: Optimum of the simulator's data centers.
        sim: The simulator.
        progress: Progress callback ``(stage, done, total)`` in data centers.
        stop: Returns whether to end the work; called before each data center.

    Returns:
        The optimum; the one given where a queue has no limit.

    Raises:
        StoppedError: ``stop`` was true; what the optimum keeps is kept.
    """
    limits = queue_limit_tasks(sim.fleet)
    if np.any(limits >= UNLIMITED_TASKS):
        return optimum
    full_kwh = sim.sizing.battery_kwh * sim.fleet.values("battery.upper_v")
    curves = []
    for dc in range(sim.size):
        if stop is not None and stop():
            raise StoppedError("values of ends were stopped")
        if progress is not None:
            progress("values of ends", dc, sim.size)
        most_kwh = float(full_kwh[dc]) if "battery" in optimum.agents else 0.0
        most_tasks = float(limits[dc]) if "load" in optimum.agents else 0.0
        curves.append(_ends_curve(partial(optimum.bound_of_ends, dc), most_kwh, most_tasks))
    return replace(optimum, bound_of_ends=lambda dc, ends: curves[dc](ends))


def _ends_curve(
    bound_of: Callable[[Ends], float], most_kwh: float, most_tasks: float
) -> Callable[[Ends], float]:
    """Approximate bound of a data center by what is stored and by what waits at the end."""
    kwh, tasks = np.unique(most_kwh * _KWH_SHARES), np.unique(most_tasks * _TASK_SHARES)

    def exact(end_kwh: float, end_tasks: float) -> float:
        return bound_of(Ends(most_kwh / 2, 0.0, float(end_kwh), float(end_tasks)))

    of_kwh = np.array([exact(x, 0.0) for x in kwh])
    of_tasks = np.array([of_kwh[0], *(exact(0.0, x) for x in tasks[1:])])
    return lambda ends: (
        _line(ends.end_kwh, kwh, of_kwh) + _line(ends.end_tasks, tasks, of_tasks) - float(of_kwh[0])
    )


def _line(x: float, nodes: F64, values: F64) -> float:
    """Linear interpolation, that of the last two nodes beyond them."""
    if len(nodes) == 1:
        return float(values[0])
    i = int(np.clip(np.searchsorted(nodes, x), 1, len(nodes) - 1))
    slope = (values[i] - values[i - 1]) / (nodes[i] - nodes[i - 1])
    return float(values[i] + slope * (x - nodes[i]))
