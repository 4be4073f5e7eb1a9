"""Plans for queues and batteries by dynamic programming (kernels in ``kernels/planning.py``).

B is the number of data centers, H the number of steps of a plan, and C the number of candidate
commands of the next step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from sdc_taichi.kernels.arguments import Argument, in_row_order
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.planning_arguments import (
    QUEUE_ARGUMENTS,
    STORE_ARGUMENTS,
)
from sdc_taichi.optimum.facility_map import FacilityMap
from sdc_taichi.plant import workload
from sdc_taichi.plant.battery import (
    BATTERIES,
    BatteryParameters,
    BatteryPoint,
    Conversion,
    conversion,
)
from sdc_taichi.plant.workload import TASKS_PER_STEP, UNLIMITED_TASKS
from sdc_taichi.sim.facility import battery_parameters
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.workload import due_steps, queue_limit_tasks
from sdc_taichi.types import F64, I64, BatteryResult, Work

MOST_AT_ONCE = 256
"""Largest number of data centers per kernel call; it limits the memory of the work space."""


def first_commands() -> F64:
    """Return candidate commands of the next step, (C,), in ascending order of absolute value.

    Of commands with equal cost, plans choose the first.
    """
    steps = np.concatenate([[0.01, 0.02, 0.04, 0.06, 0.08], np.arange(1, 11) / 10.0])
    return np.concatenate([[0.0], np.stack([-steps, steps], axis=1).ravel()])


class PlanningKernel:
    """Planning kernel with its work space.

    Args:
        kernel: Taichi kernel.
        arguments: Specification of the arguments of the kernel.
        levels: Number of grid levels of the planned state (queue or stored energy).
    """

    def __init__(self, kernel: Any, arguments: Mapping[str, Argument], levels: int) -> None:
        from sdc_taichi.kernels.compiler.named_kernel import NamedKernel

        self._threads = runtime.ensure_started()
        self._kernel = NamedKernel(kernel, arguments)
        self._kernel.bind(serial=False, levels=levels)
        self._arguments, self._levels = arguments, levels

    def run(
        self,
        size: int,
        horizon: int,
        *,
        commands: F64,
        peaks: int,
        table: F64 | None = None,
        facility_kwh: F64 | None = None,
        **of_each: F64 | Mapping[str, F64],
    ) -> tuple[I64, F64]:
        """Run the kernel for all data centers.

        Args:
            size: Number of data centers, B.
            horizon: Number of coming steps, H.
            commands: Candidate commands of steps after the first.
            peaks: Number of candidates for the month's peak power.
            table: Argument ``table`` of the kernel, if the kernel has one.
            facility_kwh: Energy of the facility in each step, kWh, (B, H); None computes it.
            of_each: Other arguments by name, with the data centers along the first axis; of an
                argument with rows, each row by its name.

        Returns:
            Index of the best first command, (B,), and ``facility_kwh``.
        """
        chosen = np.zeros(size, dtype=np.int32)
        kwh = np.zeros((size, horizon)) if facility_kwh is None else facility_kwh
        by_dc: dict[str, Any] = {"chosen": chosen, "facility_kwh": kwh}
        for name, values in of_each.items():
            if isinstance(values, Mapping):
                by_row = in_row_order(self._arguments[name].rows, values)
                by_dc[name] = np.stack(by_row, axis=-1)
            else:
                by_dc[name] = values
        shared = {"commands": commands, "peaks": peaks, "horizon": horizon}
        if table is not None:
            shared["table"] = table
        for first in range(0, size, MOST_AT_ONCE):
            part = slice(first, min(first + MOST_AT_ONCE, size))
            count = part.stop - first
            chunk = {name: np.ascontiguousarray(values[part]) for name, values in by_dc.items()}
            flat = {n: v.reshape(-1) for n, v in chunk.items() if self._arguments[n].of}
            self._kernel(
                size=count,
                slices=min(count, 4 * self._threads),
                **shared,
                **(chunk | flat),
                **self._work_space(count, horizon, table),
            )
        return chosen.astype(np.int64), kwh

    def _work_space(self, count: int, horizon: int, table: F64 | None) -> dict[str, Any]:
        space: dict[str, Any] = {"cost": np.empty((count, 2, self._levels))}
        if table is not None:
            space["policy"] = np.empty((count, horizon, self._levels), dtype=np.int32)
            space["kwh"] = np.empty((count, table.shape[-1]))
        return space


QUEUE_LEVELS, STORE_LEVELS = 51, 41
"""Numbers of grid levels of the queue and of the stored energy in plans."""
COMMANDS = (0.0, -0.25, 0.25, -0.5, 0.5, -0.75, 0.75, -1.0, 1.0)
"""Candidate commands of steps after the first. Of commands with equal cost, plans choose the
first."""


class Weather(NamedTuple):
    """Forecast weather of the coming steps."""

    outdoor_c: F64
    """Outdoor dry-bulb temperature, in C, (B, H)."""
    wet_bulb_c: F64
    """Outdoor wet-bulb temperature, in C, (B, H)."""


class EnergyCost(NamedTuple):
    """Cost of energy in the coming steps, in the unit of the objective."""

    weight: F64
    """Cost per kWh in each step, (B, H)."""
    peak_kwh: F64
    """Largest energy of a step so far in the month, which sets its demand charge, in kWh, (B,)."""
    peak_cost: F64
    """Additional cost per kWh by which a step exceeds ``peak_kwh``, (B,); 0 without demand
    charge."""


class QueuePlan(NamedTuple):
    """Load command of the next step, with the work and energy of the plan."""

    load: F64
    """Load command, (B,)."""
    executed_tasks: F64
    """Work executed in each step of the plan, in tasks, (B, H)."""
    facility_kwh: F64
    """Energy of the facility in each step of the plan, in kWh, (B, H)."""


class QueuePlanner:
    """Planner of the work of B data centers.

    Args:
        fleet: Data centers.
        facility: Energy of a step by load, weather and setpoint.
        moves_work: True if plans may move work; False computes the energy of neutral commands.
        moves_setpoint: True if each step has its best setpoint; False keeps the present setpoint.
    """

    def __init__(
        self, fleet: Fleet, facility: FacilityMap, *, moves_work: bool, moves_setpoint: bool
    ) -> None:
        from sdc_taichi.kernels.planning import queue_kernel

        self._facility, self._moves_setpoint = facility, moves_setpoint
        self._table = _kwh_of_best_setpoint(facility) if moves_setpoint else _kwh(facility)
        self._model = fleet.models["workload"]
        self._share = fleet.values("workload.flexible_share")[:, None]
        self._cap = fleet.values("workload.max_utilisation")[:, None]
        self._limit = queue_limit_tasks(fleet)
        self._due_steps = due_steps(fleet)
        self._kernel = PlanningKernel(queue_kernel(), QUEUE_ARGUMENTS, QUEUE_LEVELS)
        most_kwh = [kwh.max() for kwh in facility.at_own_nodes(self._table)]
        self._most_kwh = np.array(most_kwh)[facility.which]
        self._first = first_commands() if moves_work else np.zeros(1)
        self._later = np.array(COMMANDS if moves_work else (0.0,))

    def plan(
        self,
        queue: F64,
        demand: F64,
        weather: Weather,
        cost: EnergyCost,
        setpoint_c: F64,
        *,
        peaks: int,
    ) -> QueuePlan:
        """Plan the work of the coming steps.

        Args:
            queue: Cumulative queued work by step of arrival, in tasks, oldest step first, (B, L).
            demand: Arriving work as a share of capacity, (B, H).
            weather: Weather of the coming steps.
            cost: Cost of energy in the coming steps.
            setpoint_c: Present setpoint, C, (B,).
            peaks: Number of candidates for the month's peak power; 1 without a demand charge.
        """
        size, horizon = demand.shape
        waiting, due = queue[:, -1], _due_by(queue, self._due_steps, horizon)
        now = self._first_step(demand[:, :1], waiting[:, None], due[:, :1])
        coming = self._coming(demand, weather, cost.weight, waiting, due)
        dearest = cost.weight.max(axis=1) + cost.peak_cost
        of_dc = {
            "map": self._facility.which.astype(np.float64),
            "setpoint": np.zeros(size) if self._moves_setpoint else self._place_of(setpoint_c),
            "limit": self._limit,
            "end_weight": cost.weight.mean(axis=1),
            "mean_tasks": np.ascontiguousarray(coming["arrived"]).mean(axis=1),
            "late_cost": dearest * self._most_kwh,
            "peak_kwh": cost.peak_kwh,
            "peak_cost": cost.peak_cost,
        }
        executed_tasks = np.zeros((size, horizon))
        chosen, facility_kwh = self._kernel.run(
            size,
            horizon,
            commands=self._later,
            peaks=peaks,
            table=self._table,
            of_dc=of_dc,
            coming=coming,
            first_executed=now.started_tasks,
            first_waiting=waiting[:, None] + now.deferred_tasks - now.dequeued_tasks,
            first_late=now.dropped_tasks,
            executed=executed_tasks,
        )
        return QueuePlan(
            load=self._first[chosen],
            executed_tasks=executed_tasks,
            facility_kwh=facility_kwh,
        )

    def _first_step(self, demand: F64, waiting: F64, due: F64) -> Work:
        """Compute the work of the next step for each candidate command, (B, C)."""
        shape = len(demand), len(self._first)
        demand, command, waiting, due = (
            np.broadcast_to(x, shape) for x in (demand, self._first, waiting, due)
        )
        limits = self._share, self._cap, self._limit[:, None]
        point = workload.WorkPoint(demand, command, waiting, due, *limits)
        return workload.MODELS[self._model].step(point)

    def _coming(
        self, demand: F64, weather: Weather, weight: F64, waiting: F64, due: F64
    ) -> dict[str, F64]:
        """Return the inputs of all coming steps by the names of ``STEP_ROWS``, each (B, H)."""
        arrived = demand * TASKS_PER_STEP
        flexible = arrived * self._share
        capacity = np.broadcast_to(self._cap * TASKS_PER_STEP, demand.shape)
        most_drained, most_due = np.full(demand.shape, UNLIMITED_TASKS), capacity
        if self._model != "fluid":
            arrived, flexible = workload.arriving_tasks(demand, self._share)
            capacity, most_drained = np.floor(capacity), flexible
            most_due = capacity
        if self._model == "released":
            # Arriving work runs first, and beyond the limit of queued work.
            now = np.minimum(arrived, capacity)
            capacity = np.maximum(np.minimum(capacity, workload.RELEASED_QUEUE_TASKS), now)
            most_due = capacity - now
        held_back = np.maximum(flexible, arrived - capacity)
        lead, depression = self._facility.places_of_weather(weather.outdoor_c, weather.wet_bulb_c)
        most_waiting = (waiting[:, None] - due) + self._not_due(held_back)
        reached = np.minimum(waiting[:, None] + np.cumsum(held_back, axis=1), most_waiting)
        reached = np.minimum(reached, self._limit[:, None])
        return {
            "weight": weight,
            "weather": lead,
            "depression": depression,
            "arrived": arrived,
            "flexible": flexible,
            "capacity": capacity,
            "most_drained": most_drained,
            "most_due": most_due,
            "not_due": most_waiting - held_back,
            "spacing": np.where(reached > 0, reached, 1.0) / (QUEUE_LEVELS - 1),
        }

    def _not_due(self, held_back: F64) -> F64:
        """Return the largest work of the coming steps that may wait after each step, (B, H)."""
        total = np.cumsum(held_back, axis=1)
        horizon = held_back.shape[1]
        before = np.arange(horizon) - np.minimum(self._due_steps, horizon)[:, None].astype(np.int64)
        gone = np.take_along_axis(total, np.maximum(before, 0), axis=1)
        return total - np.where(before >= 0, gone, 0.0)

    def _place_of(self, setpoint_c: F64) -> F64:
        """Return the fractional index of setpoints on the grid of the facility map, (B,)."""
        low, share = self._facility.places_of_setpoints(setpoint_c[:, None])
        return (low + share)[:, 0]


def _kwh(facility: FacilityMap) -> F64:
    """Return energy by map, weather, setpoint and utilisation, with at least two setpoints."""
    kwh = np.ascontiguousarray(np.moveaxis(facility.facility_kwh, 4, 3))
    return kwh if kwh.shape[3] > 1 else np.repeat(kwh, 2, axis=3)


def _kwh_of_best_setpoint(facility: FacilityMap) -> F64:
    """Return energy at the best setpoint, twice: the kernel interpolates between two setpoints."""
    return np.stack([facility.least_kwh] * 2, axis=3)


def _due_by(queue: F64, due_after_steps: F64, horizon: int) -> F64:
    """Return the queued work that is due by each coming step, in tasks, (B, H).

    Args:
        queue: Cumulative queued work by step of arrival, in tasks, oldest step first, (B, L).
        due_after_steps: Age at which work is due, in steps, (B,); inf means no deadline.
        horizon: Number of coming steps, H.
    """
    length = queue.shape[1]
    first = length - np.minimum(due_after_steps, length + horizon).astype(np.int64)
    row = np.minimum(first[:, None] + np.arange(horizon), length - 1)
    due = np.take_along_axis(queue, np.maximum(row, 0), axis=1)
    return np.where((row < 0) | np.isinf(due_after_steps)[:, None], 0.0, due)


_AMPLE_KW, _SLIGHT_KW = 1e9, 1e-3
"""Facility powers, in kW, of which the first never and the second always limits a discharge."""


class StorePlanner:
    """Planner of the batteries of B data centers.

    Args:
        fleet: Data centers.
        sizing: Sizes of the devices of the data centers.
        step_h: Length of a step, h.
    """

    def __init__(self, fleet: Fleet, sizing: Sizing, step_h: float) -> None:
        from sdc_taichi.kernels.planning import store_kernel

        self._model = BATTERIES[fleet.models["battery"]]
        parameters = (np.asarray(values)[:, None] for values in battery_parameters(fleet))
        self._parameters = BatteryParameters(*parameters)
        self._capacity_kwh, self._step_h = sizing.battery_kwh, step_h
        self._limit_kw = sizing.grid_limit_kw
        self._kernel = PlanningKernel(store_kernel(), STORE_ARGUMENTS, STORE_LEVELS)
        self._first, self._later = first_commands(), np.array(COMMANDS)
        levels_kwh = sizing.battery_kwh[:, None] * np.linspace(0.0, 1.0, STORE_LEVELS)
        # Standby is a load beside that of the facility, which the kernel receives as such.
        without = self._parameters._replace(standby_per_h=np.zeros((fleet.size, 1)))
        charged = self._step(levels_kwh, 1.0, _AMPLE_KW, without)
        ample, slight = (
            self._step(levels_kwh, -1.0, kw, without) for kw in (_AMPLE_KW, _SLIGHT_KW)
        )
        self._most = {
            "most_charge": charged.charge_kwh,
            "most_discharge": ample.discharge_kwh,
            "load_share": slight.discharge_kwh / (_SLIGHT_KW * step_h),
        }
        self._conversion = Conversion(
            *(
                np.broadcast_to(np.asarray(values, np.float64).reshape(-1), fleet.size)
                for values in conversion(
                    fleet.models["battery"], self._parameters, sizing.battery_kwh[:, None], step_h
                )
            )
        )

    def plan(self, stored_kwh: F64, facility_kwh: F64, cost: EnergyCost, *, peaks: int) -> F64:
        """Return the battery command of the next step, (B,).

        Args:
            stored_kwh: Stored energy, kWh, (B,).
            facility_kwh: Energy of the facility in the coming steps, kWh, (B, H).
            cost: Cost of energy in the coming steps.
            peaks: Number of candidates for the month's peak power; 1 without a demand charge.
        """
        size, horizon = facility_kwh.shape
        load_kw = facility_kwh[:, :1] / self._step_h
        now = self._step(
            stored_kwh[:, None],
            self._first[None],
            load_kw,
            self._parameters,
            self._limit_kw[:, None],
        )
        converted = self._conversion
        capacity_kwh = np.where(self._capacity_kwh > 0, self._capacity_kwh, 1.0)
        of_dc = {
            "spacing": capacity_kwh / (STORE_LEVELS - 1),
            "charge_efficiency": converted.charge_efficiency,
            "discharge_factor": converted.discharge_factor,
            "square_per_kwh": converted.square_per_kwh,
            "grid_limit": self._limit_kw * self._step_h,
            "end_value": cost.weight.mean(axis=1) / converted.discharge_factor,
            "peak_kwh": cost.peak_kwh,
            "peak_cost": cost.peak_cost,
        }
        chosen, _ = self._kernel.run(
            size,
            horizon,
            commands=self._later,
            peaks=peaks,
            facility_kwh=facility_kwh + np.asarray(converted.standby_kwh)[:, None],
            of_dc=of_dc,
            weight=cost.weight,
            first_grid=now.grid_kwh,
            first_stored=now.stored_kwh,
            **self._most,
        )
        return self._first[chosen]

    def _step(
        self,
        stored_kwh: F64,
        command: F64 | float,
        load_kw: F64 | float,
        parameters: BatteryParameters,
        limit: F64 | None = None,
    ) -> BatteryResult:
        """Step each battery from several stored energies or with several commands, (B, n)."""
        return self._model.step(
            stored_kwh,
            command,
            BatteryPoint(
                capacity_kwh=self._capacity_kwh[:, None],
                load_kw=load_kw,
                dt_h=self._step_h,
                parameters=parameters,
                grid_limit_kw=limit,
            ),
        )
