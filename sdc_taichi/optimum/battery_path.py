"""The best path of a battery whose load is known, by dynamic programming over its stored energy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np

from sdc_taichi.optimum.commands import battery_command, bus_energy_kwh
from sdc_taichi.optimum.problem import Storage
from sdc_taichi.plant.battery import BATTERIES, BatteryResult
from sdc_taichi.types import F64

LEVELS = 201
"""Levels of stored energy at which the value of what is stored is computed."""
COMMANDS = np.linspace(-1.0, 1.0, 21)
"""Battery commands among which a step chooses."""
BatteryModel = Callable[[F64, F64, F64 | float], BatteryResult]
"""What a step does, from the energy stored, a command, and the energy of the facility, in kWh."""
_SHORTAGE_FACTOR = 10.0
"""Price of a kWh that is missing at the end, over the highest price of a kWh delivered."""


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
    """Stored energy after each step of the cheapest path, in kWh, (T,).

    The value of stored energy at the end of each step is computed backwards at ``LEVELS`` levels
    and read linearly between them; commands of least cost are then followed forwards with the model
    itself, so that the path is one that the battery can take.

    Args:
        storage: The battery, with what it stores before the first step.
        facility_kwh: Energy of the facility in each step, in kWh, (T,).
        kwh_weight: Weight of a kWh bought in each step, (T,).
        step_h: Length of a step, in h.
        end_kwh: Least energy stored at the end, in kWh.
        grid_limit_kw: Power beyond which the battery does not charge, in kW; inf without a limit.
        most_grid_kw: Power bought that the path is to keep below where it can, in kW.
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
        found = run(levels[:, None], COMMANDS, facility_kwh[t])
        options = cost(t, found.grid_kwh) + np.interp(found.stored_kwh, levels, values[t + 1])
        values[t] = options.min(axis=1)
    return _follow(storage, facility_kwh, values, levels, run, cost, step_h, end_kwh)


def storage_parameters(storage: Storage) -> dict[str, float]:
    """Efficiencies, rates and limits of a battery by the names of the models' arguments."""
    beside = ("model", "capacity_kwh", "stored_kwh")
    return {f.name: getattr(storage, f.name) for f in fields(storage) if f.name not in beside}


def battery_model(storage: Storage, step_h: float, grid_limit_kw: float) -> BatteryModel:
    """The model of a battery as a function of stored energy, command and energy of the facility.

    Args:
        storage: The battery.
        step_h: Length of a step, in h.
        grid_limit_kw: Power beyond which the battery does not charge, in kW; inf without a limit.
    """
    model, parameters = BATTERIES[storage.model], storage_parameters(storage)

    def run(stored_kwh: F64, command: F64, facility_kwh: F64 | float) -> BatteryResult:
        return model(
            stored_kwh,
            command,
            capacity_kwh=storage.capacity_kwh,
            load_kw=facility_kwh / step_h,
            dt_h=step_h,
            grid_limit_kw=None if np.isinf(grid_limit_kw) else grid_limit_kw,
            **parameters,
        )

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
    """Stored energy after each step along the commands of least cost, in kWh, (T,)."""
    stored = np.array([storage.stored_kwh])
    path = np.empty(len(facility_kwh))
    fine = np.linspace(-1.0, 1.0, 4 * (len(COMMANDS) - 1) + 1)
    capacity = np.array([storage.capacity_kwh])
    parameters = {name: np.array([x]) for name, x in storage_parameters(storage).items()}
    for t, load_kwh in enumerate(facility_kwh):
        to_end = bus_energy_kwh(
            np.array([end_kwh]),
            stored,
            charge_efficiency=parameters["charge_efficiency"],
            discharge_factor=parameters["discharge_factor"],
        )
        exact = battery_command(
            to_end,
            model=storage.model,
            stored_kwh=stored,
            load_kw=np.array([load_kwh / step_h]),
            step_h=step_h,
            capacity_kwh=capacity,
            parameters=parameters,
        )
        found = run(stored, np.concatenate([fine, exact, np.zeros(1)]), load_kwh)
        options = cost(t, found.grid_kwh) + np.interp(found.stored_kwh, levels, values[t + 1])
        stored = found.stored_kwh[[int(options.argmin())]]
        path[t] = stored[0]
    return path
