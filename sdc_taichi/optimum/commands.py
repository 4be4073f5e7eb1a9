"""From what a step is to do to the commands that do it, for all data centers at once."""

from __future__ import annotations

import numpy as np

from sdc_taichi.plant.battery import BATTERIES, BatteryParameters, BatteryPoint
from sdc_taichi.plant.cooling import avoid_repeats
from sdc_taichi.plant.workload import MODELS as WORK_MODELS
from sdc_taichi.plant.workload import TASKS_PER_STEP, WorkPoint
from sdc_taichi.types import F64


def load_command(
    executed_tasks: F64,
    *,
    model: str,
    demand: F64,
    waiting_tasks: F64,
    due_tasks: F64,
    flexible_share: F64,
    max_utilisation: F64,
    queue_limit_tasks: F64,
) -> F64:
    """Load command by which a step does some amount of work, or comes as close as it can, (B,).

    It inverts the models of ``plant.workload``. Work whose deadline has come runs in any case, and
    no more is deferred than fits into the queue, so that nothing is dropped for a plan. Model
    ``tasks`` does the nearest whole number of tasks.

    Args:
        executed_tasks: work to do, in tasks, (B,).
        model: name of the model of work, ``fluid`` or ``tasks``.
        demand: work that arrives, as a share of capacity, 0..1, (B,).
        waiting_tasks: work in the queue, in tasks, (B,).
        due_tasks: part of it whose deadline has come, in tasks, (B,).
        flexible_share: share of the demand that may wait, 0..1, (B,).
        max_utilisation: highest utilisation, 0..1, (B,).
        queue_limit_tasks: longest queue, in tasks, (B,).
    """
    of_model = _tasks_command if model == "tasks" else _fluid_command
    return of_model(
        executed_tasks,
        demand,
        waiting_tasks,
        due_tasks,
        flexible_share,
        max_utilisation,
        queue_limit_tasks,
    )


def _fluid_command(
    executed: F64, demand: F64, waiting: F64, due: F64, flexible_share: F64, cap: F64, limit: F64
) -> F64:
    """Load command of model ``fluid``, (B,); see ``load_command``."""
    arrived, capacity = demand * TASKS_PER_STEP, cap * TASKS_PER_STEP
    forced = np.minimum(due, capacity)
    room = np.maximum(limit - (waiting - forced), 0.0)
    most_held_back = np.minimum(flexible_share * arrived, room)
    neutral = np.minimum(arrived, capacity - forced) + forced
    drain = _share(executed - neutral, capacity - neutral)
    defer = _share(
        np.minimum(arrived + forced - executed, most_held_back), flexible_share * arrived
    )
    return np.where(executed >= neutral, drain, -defer)


def _tasks_command(
    executed: F64, demand: F64, waiting: F64, due: F64, flexible_share: F64, cap: F64, limit: F64
) -> F64:
    """Load command of model ``tasks``, (B,); see ``load_command``."""
    flexible = np.floor(demand * flexible_share * TASKS_PER_STEP)
    arrived = np.ceil(demand * (1.0 - flexible_share) * TASKS_PER_STEP) + flexible
    capacity = np.floor(cap * TASKS_PER_STEP)
    forced = np.minimum(due, np.maximum(capacity - arrived, 0.0))
    room = np.maximum(limit - (waiting - forced), 0.0)
    more = np.rint(executed - arrived - forced)
    free = np.maximum(capacity - arrived - forced, 0.0)
    drainable = np.minimum(np.minimum(waiting - forced, flexible), free)
    held_back = np.minimum(np.minimum(-more, flexible), np.floor(room))
    # The models round down: half a task more than a whole number gives just this number.
    drain = np.where(more > 0, _share(more + 0.5, drainable), 0.0)
    defer = np.where(held_back > 0, _share(held_back + 0.5, flexible), 0.0)
    return np.where(more >= 0, drain, -defer)


def battery_command(
    bus_kwh: F64,
    *,
    model: str,
    stored_kwh: F64,
    load_kw: F64,
    step_h: float,
    capacity_kwh: F64,
    parameters: BatteryParameters,
) -> F64:
    """Battery command by which a step draws or delivers some energy, or as much as it can, (B,).

    Args:
        bus_kwh: energy to draw from the bus into the battery, below 0 to deliver, in kWh, (B,).
        model: name of the battery model.
        stored_kwh: energy in the store before the step, in kWh, (B,).
        load_kw: power that the facility is expected to draw, in kW, (B,).
        step_h: length of the step, in h.
        capacity_kwh: capacity, in kWh, (B,).
        parameters: efficiencies, rates and limits, (B,) each; the limit of the grid connection is
            left to the model.
    """
    charges = bus_kwh >= 0
    full = BATTERIES[model].step(
        stored_kwh,
        np.where(charges, 1.0, -1.0),
        BatteryPoint(capacity_kwh, load_kw, step_h, parameters),
    )
    share = _share(np.abs(bus_kwh), np.where(charges, full.charge_kwh, full.discharge_kwh))
    return np.where(charges, share, -share)


def bus_energy_kwh(
    target_kwh: F64, stored_kwh: F64, *, charge_efficiency: F64, discharge_factor: F64
) -> F64:
    """Energy to draw from the bus, below 0 to deliver, that brings a store to a target, kWh, (B,).

    Args:
        target_kwh: energy to be stored, in kWh, (B,).
        stored_kwh: energy in the store, in kWh, (B,).
        charge_efficiency: energy stored per energy drawn, (B,).
        discharge_factor: energy taken from the store per energy delivered, (B,).
    """
    rise_kwh = target_kwh - stored_kwh
    return np.where(rise_kwh >= 0, rise_kwh / charge_efficiency, rise_kwh / discharge_factor)


def arrived_tasks(model: str, demand: F64, flexible_share: F64 | float) -> F64:
    """Work that arrives as a model of work counts it, in tasks.

    Args:
        model: name of the model of work.
        demand: work that arrives, as a share of capacity, 0..1.
        flexible_share: share of it that may wait, 0..1.
    """
    nothing = np.zeros(np.shape(demand))
    work = WORK_MODELS[model].step(
        WorkPoint(
            demand,
            nothing,
            nothing,
            nothing,
            flexible_share=flexible_share,
            max_utilisation=1.0,
            queue_limit=0.0,
        )
    )
    return np.asarray(work.arrived_tasks)


def setpoint_command(target_c: F64, *, setpoint_c: F64, step_k: F64, last: F64) -> F64:
    """Cooling command that moves setpoints to their targets, in steps, (n,).

    Args:
        target_c: setpoints to reach, in C, (n,).
        setpoint_c: present setpoints, in C, (n,).
        step_k: change by a command of 1, in K, (n,).
        last: commands of the step before, in steps, (n,).
    """
    return avoid_repeats((target_c - setpoint_c) / step_k, last)


def _share(part: F64, whole: F64) -> F64:
    """Part of a whole, within 0..1; 0 where there is nothing to share."""
    some = whole > 0
    return np.where(some, np.clip(part / np.where(some, whole, 1.0), 0.0, 1.0), 0.0)
