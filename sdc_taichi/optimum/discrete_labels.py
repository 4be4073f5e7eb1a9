"""What sequences of discrete actions lead to: states of a data center, and their costs.

A label is the state that some sequence of actions leads to, and the least cost at which it does.
Work, setpoint and battery move by the models of ``plant``; energy, water and inlets of a step come
from the table.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.optimum.battery_path import battery_model
from sdc_taichi.optimum.problem import Problem
from sdc_taichi.plant.cooling import SETPOINTS
from sdc_taichi.plant.workload import MODELS, TASKS_PER_STEP, UNLIMITED_TASKS
from sdc_taichi.types import F64, I64

_INLET_TOLERANCE_K = 1e-6
"""Excess of an inlet over its limit that is taken for rounding, in K."""
_SAME_TASKS = 1e-7
"""Difference of queues that is taken for rounding, in tasks."""
_SAME_SHARE = 1e-10
"""Difference of stored energies that is taken for rounding, over capacity."""
MOST_UNMET_W = 1e30
"""Cooling load that stands for one that cannot be, in W."""
_UNMET_TOLERANCE_W = 1e-3
"""Cooling load left in the room that is taken for rounding, in W."""
_NO_COMMAND = -7.0
"""Stands for the last cooling command before the first step."""
_Keys = npt.NDArray[np.uint64]


@dataclass(frozen=True, slots=True)
class Labels:
    """States that n sequences of actions lead to, and what the sequences cost."""

    setpoint_c: F64
    """Setpoint, in C, (n,)."""
    cooling_run: I64
    """Equal cooling commands in a row, (n,)."""
    cooling_last: F64
    """Last cooling command, in steps, nan before the first, (n,)."""
    stored_kwh: F64
    """Energy in the battery, in kWh, (n,)."""
    deferred_by: F64
    """Work that had entered the queue by the end of each of the last W steps, in tasks, (n, W);
    that of step t in column t modulo W."""
    deferred_tasks: F64
    """Work that has entered the queue, in tasks, (n,)."""
    dequeued_tasks: F64
    """Work that has left the queue, in tasks, (n,)."""
    dropped_tasks: F64
    """Work that found the queue full, in tasks, (n,)."""
    overdue_tasks: F64
    """Due work that did not fit into its step, summed over the steps, in tasks, (n,)."""
    start_kwh: F64
    """Energy in the battery at the first scored step, in kWh, (n,)."""
    start_tasks: F64
    """Work in the queue at the first scored step, in tasks, (n,)."""
    cost: F64
    """Weighed energy, water and demand of the scored steps, (n,)."""
    peak_kw: F64
    """Highest power of the billed month under way, in kW, (n,)."""

    @property
    def queue_tasks(self) -> F64:
        """Work in the queue, in tasks, (n,)."""
        return np.maximum(self.deferred_tasks - self.dequeued_tasks, 0.0)

    def take(self, rows: I64) -> Labels:
        """Some of the labels."""
        return Labels(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True, slots=True)
class Successors:
    """States one step after n labels: l load, c cooling and b battery commands to choose from."""

    labels: Labels
    """Labels before the step, n."""
    deferred_tasks: F64
    """Work that has entered the queue, in tasks, (n, l)."""
    dequeued_tasks: F64
    """Work that has left the queue, in tasks, (n, l)."""
    dropped_tasks: F64
    """Work that found the queue full, in tasks, (n, l)."""
    overdue_tasks: F64
    """Due work that did not fit, summed over the steps, in tasks, (n, l)."""
    setpoint_c: F64
    """Setpoint, in C, (n, c)."""
    cooling_run: I64
    """Equal cooling commands in a row, (n, c)."""
    cooling_last: F64
    """Last cooling command, in steps, (n, c)."""
    stored_kwh: F64
    """Energy in the battery, in kWh, (n, l, c, b)."""
    cost: F64
    """Weighed energy, water and demand, inf for what is not permitted, (n, l, c, b)."""
    peak_kw: F64
    """Highest power of the billed month under way, in kW, (n, l, c, b)."""

    @property
    def queue_tasks(self) -> F64:
        """Work in the queue, in tasks, (n, l)."""
        return np.maximum(self.deferred_tasks - self.dequeued_tasks, 0.0)


class DiscreteModel:
    """The discrete actions of a data center and what they do.

    Args:
        problem: Its planning problem.
        config: Its configuration.
        demand: Work that arrives in each step, as a share of capacity, 0..1, (T,).
    """

    def __init__(self, problem: Problem, config: DataCenterConfig, demand: F64) -> None:
        self.problem, self._demand = problem, demand
        three = np.array([-1.0, 0.0, 1.0])
        self.commands = {
            name: three if name in problem.agents else np.zeros(1)
            for name in ("load", "cooling", "battery")
        }
        if problem.storage.capacity_kwh <= 0:
            self.commands["battery"] = np.zeros(1)
        work, setpoint = config.workload, config.hvac.setpoint
        self._work_model = MODELS[work.model]
        limit = problem.work.queue_limit_tasks
        self._work_limits = {
            "flexible_share": np.float64(work.flexible_share),
            "max_utilisation": np.float64(work.max_utilisation),
            "queue_limit": np.float64(UNLIMITED_TASKS if np.isinf(limit) else limit),
        }
        self._setpoint_model = SETPOINTS[setpoint.model]
        self._accelerates = setpoint.model == "accelerating"
        self._setpoint_limits = {
            "step_k": np.float64(setpoint.step_k),
            "low_c": np.float64(setpoint.min_c),
            "high_c": np.float64(setpoint.max_c),
        }
        due = problem.work.deadline_steps
        # Work that is due after the end is never due.
        self._window = 0 if due is None or due >= problem.steps else due
        draws = np.random.Generator(np.random.PCG64(0))
        self._age_weights = draws.uniform(1.0, 2.0, self._window)
        self._factors = draws.integers(1, 2**63, 16, dtype=np.uint64) | np.uint64(1)
        self._battery = battery_model(problem.storage, problem.step_h, problem.grid_limit_kw)

    @property
    def setpoint_step_k(self) -> float:
        """Change of the setpoint by a command of 1, in K."""
        return float(self._setpoint_limits["step_k"])

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of load, cooling and battery commands."""
        load, cooling, battery = (len(x) for x in self.commands.values())
        return load, cooling, battery

    @property
    def neutral(self) -> int:
        """Place of the commands that are all 0 among the joint commands."""
        middle = [len(x) // 2 for x in self.commands.values()]
        return int(np.ravel_multi_index(middle, self.shape))

    def first(self) -> Labels:
        """The state before the first step."""
        zero = np.zeros(1)
        stored = np.array([self.problem.storage.stored_kwh])
        return Labels(
            setpoint_c=np.array([self.problem.setpoint_c]),
            cooling_run=np.zeros(1, np.int64),
            cooling_last=np.array([np.nan]),
            stored_kwh=stored,
            deferred_by=np.zeros((1, self._window)),
            deferred_tasks=zero,
            dequeued_tasks=zero,
            dropped_tasks=zero,
            overdue_tasks=zero,
            start_kwh=stored,
            start_tasks=zero,
            cost=zero,
            peak_kw=zero,
        )

    def successors(self, labels: Labels, t: int) -> Successors:
        """What the commands of step ``t`` make of labels."""
        work, executed = self._move_work(labels, t)
        setpoint_c, run, last = self._move_setpoint(labels, t)
        facility_kwh, water_l, barred = self._facility(executed / TASKS_PER_STEP, setpoint_c, t)
        stored_kwh, grid_kwh = self.move_store(
            labels.stored_kwh[:, None, None, None],
            self.commands["battery"],
            facility_kwh[..., None],
        )
        problem = self.problem
        cost = labels.cost[:, None, None, None] + problem.kwh_weight[t] * grid_kwh
        if problem.litre_weight and t >= problem.scored_from:
            cost = cost + problem.litre_weight * water_l[..., None]
        cost, peak_kw = self._bill(cost, labels.peak_kw[:, None, None, None], grid_kwh, t)
        repeated = self._repeats(work, setpoint_c)
        return Successors(
            labels=labels,
            **work,
            setpoint_c=setpoint_c,
            cooling_run=run,
            cooling_last=last,
            stored_kwh=stored_kwh,
            cost=np.where((barred | repeated)[..., None], np.inf, cost),
            peak_kw=peak_kw,
        )

    def pick(self, found: Successors, chosen: I64, t: int) -> Labels:
        """Labels after step ``t`` of some successors, by their places in (n, l, c, b)."""
        shape = (len(found.labels.cost), *self.shape)
        row, load, cooling, _ = np.unravel_index(chosen, shape)
        before = found.labels
        deferred = found.deferred_tasks[row, load]
        dequeued = found.dequeued_tasks[row, load]
        stored = found.stored_kwh.reshape(-1)[chosen]
        deferred_by = before.deferred_by[row]
        if self._window:
            deferred_by[:, t % self._window] = deferred
        begins = t + 1 == self.problem.scored_from
        return Labels(
            setpoint_c=found.setpoint_c[row, cooling],
            cooling_run=found.cooling_run[row, cooling],
            cooling_last=found.cooling_last[row, cooling],
            stored_kwh=stored,
            deferred_by=deferred_by,
            deferred_tasks=deferred,
            dequeued_tasks=dequeued,
            dropped_tasks=found.dropped_tasks[row, load],
            overdue_tasks=found.overdue_tasks[row, load],
            start_kwh=stored if begins else before.start_kwh[row],
            start_tasks=np.maximum(deferred - dequeued, 0.0) if begins else before.start_tasks[row],
            cost=found.cost.reshape(-1)[chosen],
            peak_kw=found.peak_kw.reshape(-1)[chosen],
        )

    def keys(self, found: Successors, t: int) -> _Keys:
        """Numbers that are equal where states are, to rounding, (n, l, c, b).

        Sums of whole multiples of the quantities of a state, modulo 2**64, with random factors:
        unlike states share one by an odd chance of 1 in 2**64.
        """
        labels = found.labels
        capacity = max(self.problem.storage.capacity_kwh, 1.0)
        of_load = self._whole(0, self._queue_hash(found, t), _SAME_TASKS)
        of_load = of_load + self._whole(1, found.dropped_tasks, _SAME_TASKS)
        of_load = of_load + self._whole(2, found.overdue_tasks, _SAME_TASKS)
        of_load = of_load + self._whole(3, labels.start_tasks, _SAME_TASKS)[:, None]
        of_load = of_load + self._whole(4, labels.start_kwh, _SAME_SHARE * capacity)[:, None]
        of_cooling = self._whole(5, found.setpoint_c, 1e-9)
        if self._accelerates:
            of_cooling = of_cooling + self._whole(6, found.cooling_run, 1.0)
            of_cooling = of_cooling + self._whole(7, found.cooling_last, 1.0)
        of_battery = self._whole(8, found.stored_kwh, _SAME_SHARE * capacity)
        if self.problem.months:
            of_battery = of_battery + self._whole(9, found.peak_kw, 1e-9)
        return of_load[:, :, None, None] + of_cooling[:, None, :, None] + of_battery

    def move_work(self, waiting: F64, due: F64, command: F64, t: int) -> tuple[F64, F64, F64, F64]:
        """Work that starts, enters and leaves the queue and finds it full in step ``t``, tasks."""
        found = self._work_model(self._demand[t], command, waiting, due, **self._work_limits)
        return found.started_tasks, found.deferred_tasks, found.dequeued_tasks, found.dropped_tasks

    def move_store(self, stored_kwh: F64, command: F64, facility_kwh: F64) -> tuple[F64, F64]:
        """Energy stored after a step and energy bought in it, in kWh."""
        if self.problem.storage.capacity_kwh <= 0:
            shape = np.broadcast_shapes(stored_kwh.shape, command.shape, facility_kwh.shape)
            return np.broadcast_to(stored_kwh, shape), np.broadcast_to(facility_kwh, shape)
        found = self._battery(stored_kwh, command, facility_kwh)
        return found.stored_kwh, found.grid_kwh

    def _move_work(self, labels: Labels, t: int) -> tuple[dict[str, F64], F64]:
        """Work counted since the beginning, and work that starts, in tasks, (n, l)."""
        waiting = labels.queue_tasks[:, None]
        due = np.zeros_like(waiting)
        if self._window and t >= self._window:
            by_then = labels.deferred_by[:, t % self._window]
            due = np.maximum(by_then - labels.dequeued_tasks, 0.0)[:, None]
            waiting = np.maximum(waiting, due)
        command = self.commands["load"]
        found = self._work_model(self._demand[t], command, waiting, due, **self._work_limits)
        shape = (len(waiting), len(command))

        def summed(before: F64, now: F64) -> F64:
            return np.broadcast_to(before[:, None] + now, shape)

        return {
            "deferred_tasks": summed(labels.deferred_tasks, found.deferred_tasks),
            "dequeued_tasks": summed(labels.dequeued_tasks, found.dequeued_tasks),
            "dropped_tasks": summed(labels.dropped_tasks, found.dropped_tasks),
            "overdue_tasks": summed(labels.overdue_tasks, found.overdue_tasks),
        }, np.broadcast_to(found.started_tasks, shape)

    def _move_setpoint(self, labels: Labels, t: int) -> tuple[F64, I64, F64]:
        """Setpoint, equal commands in a row and last command, (n, c)."""
        command = np.broadcast_to(self.commands["cooling"], (len(labels.cost), self.shape[1]))
        setpoint_c, run, last = self._setpoint_model(
            labels.setpoint_c[:, None],
            command,
            labels.cooling_run[:, None],
            labels.cooling_last[:, None],
            **self._setpoint_limits,
        )
        if "cooling" not in self.problem.agents:
            setpoint_c = np.full(command.shape, self.problem.idle_setpoint_c[t])
        return setpoint_c, np.broadcast_to(run, command.shape), last

    def _facility(
        self, utilisation: F64, setpoint_c: F64, t: int
    ) -> tuple[F64, F64, npt.NDArray[np.bool_]]:
        """Energy, in kWh, water, in l, and whether it is not permitted, (n, l, c)."""
        table, limit_c = self.problem.table, self.problem.inlet_limit_c
        at = table_place(self.problem, utilisation[:, :, None], setpoint_c[:, None, :])
        # What is not possible at all has an unmet load of inf.
        unmet_w = np.minimum(table.unmet_w[t], MOST_UNMET_W)
        barred = read_table(unmet_w, at) > _UNMET_TOLERANCE_W
        if np.isfinite(limit_c):
            coldest_c = np.full((1, 1, 1), self._coldest_c(t))
            coldest = table_place(self.problem, utilisation[:, :, None], coldest_c)
            most_c = np.maximum(limit_c, read_table(table.inlet_max_c[t], coldest))
            barred |= read_table(table.inlet_max_c[t], at) > most_c + _INLET_TOLERANCE_K
        if barred.all():
            barred[:] = False
        water_l = np.zeros(1)
        if self.problem.litre_weight:
            water_l = read_table(table.water_l[t], at)
        return read_table(table.facility_kwh[t], at), water_l, barred

    def _coldest_c(self, t: int) -> float:
        """Coldest setpoint that single steps reach in step ``t``, in C."""
        if "cooling" not in self.problem.agents:
            return float(self.problem.idle_setpoint_c[t])
        limits = self._setpoint_limits
        return float(max(self.problem.setpoint_c - (t + 1) * limits["step_k"], limits["low_c"]))

    def _bill(self, cost: F64, peak_kw: F64, grid_kwh: F64, t: int) -> tuple[F64, F64]:
        """Cost with the demand of months that end, and the highest power of that under way."""
        for month in self.problem.months:
            if month.first <= t < month.end:
                peak_kw = np.maximum(peak_kw, grid_kwh / self.problem.step_h)
                if t + 1 == month.end:
                    return cost + month.weight_per_kw * peak_kw, np.zeros_like(peak_kw)
                return cost, peak_kw
        return cost, np.broadcast_to(peak_kw, cost.shape)

    def _repeats(self, work: dict[str, F64], setpoint_c: F64) -> npt.NDArray[np.bool_]:
        """Whether commands other than 0 do what 0 does, (n, l, c)."""
        n, (loads, coolings, _) = len(setpoint_c), self.shape
        repeated = np.zeros((n, loads, coolings), np.bool_)
        if loads == 3:
            for k in (0, 2):
                same = np.ones(n, np.bool_)
                for values in work.values():
                    same &= values[:, k] == values[:, 1]
                repeated[:, k] |= same[:, None]
        if coolings == 3 and not self._accelerates:
            for k in (0, 2):
                repeated[:, :, k] |= (setpoint_c[:, k] == setpoint_c[:, 1])[:, None]
        return repeated

    def _queue_hash(self, found: Successors, t: int) -> F64:
        """A number that tells queues apart by the ages of their work, in tasks, (n, l)."""
        queue = found.queue_tasks
        if not self._window or len(self.commands["load"]) == 1:
            return queue
        step = np.arange(self._window)
        weights = self._age_weights[(t - step) % self._window]
        weights[t % self._window] = 0.0
        by = found.labels.deferred_by
        ages = [
            np.maximum(by - found.dequeued_tasks[:, k : k + 1], 0.0) @ weights
            for k in range(queue.shape[1])
        ]
        return queue + np.stack(ages, axis=1)

    def _whole(self, factor: int, values: F64 | I64, unit: float) -> _Keys:
        """Values in whole units times one of the random factors, modulo 2**64."""
        whole = np.rint(np.asarray(values) * (1.0 / unit))
        number = np.nan_to_num(whole, nan=_NO_COMMAND).astype(np.int64).astype(np.uint64)
        return np.asarray(number * self._factors[factor : factor + 1])


_Place = tuple[I64, F64, I64, F64]


def table_place(problem: Problem, utilisation: F64, setpoint_c: F64) -> _Place:
    """Nodes below some utilisations and setpoints, and the parts of the way to the next ones.

    Args:
        problem: With the table.
        utilisation: Utilisations, of a shape that broadcasts with that of the setpoints.
        setpoint_c: Setpoints, in C.
    """
    nodes, setpoints = problem.table.utilisation, problem.table.setpoint_c
    u = np.clip(utilisation, nodes[0], nodes[-1])
    i = np.clip(np.searchsorted(nodes, u, side="right") - 1, 0, max(len(nodes) - 2, 0))
    j = np.clip(np.searchsorted(setpoints, setpoint_c, side="right") - 1, 0, None)
    j = np.minimum(j, max(len(setpoints) - 2, 0))
    rise = (u - nodes[i]) / (nodes[i + 1] - nodes[i]) if len(nodes) > 1 else np.zeros_like(u)
    if len(setpoints) == 1:
        return i, rise, j, np.zeros_like(setpoint_c)
    along = (setpoint_c - setpoints[j]) / (setpoints[j + 1] - setpoints[j])
    return i, rise, j, np.clip(along, 0.0, 1.0)


def read_table(values: F64, at: _Place) -> F64:
    """Values of a step, (I, J), read linearly at places of ``table_place``."""
    i, rise, j, along = at
    i_next, j_next = np.minimum(i + 1, len(values) - 1), np.minimum(j + 1, values.shape[1] - 1)
    low = values[i, j] * (1.0 - along) + values[i, j_next] * along
    high = values[i_next, j] * (1.0 - along) + values[i_next, j_next] * along
    return np.asarray(low * (1.0 - rise) + high * rise)
