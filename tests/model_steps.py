"""Steps of device models by name, for tests: all values of a point as keywords."""

from __future__ import annotations

from typing import Any

from sdc_taichi.plant.battery import BATTERIES, BatteryParameters, BatteryPoint, BatteryResult
from sdc_taichi.plant.chiller import CHILLERS, ChillerParameters, ChillerPoint, ChillerResult
from sdc_taichi.plant.workload import MODELS, WorkPoint
from sdc_taichi.types import Work


def chiller_step(name: str, load_w: Any, **values: Any) -> ChillerResult:
    """One step of a chiller at ``ChillerPoint`` and ``ChillerParameters``."""
    machine = {key: values.pop(key) for key in ChillerParameters._fields if key in values}
    return CHILLERS[name].step(load_w, ChillerPoint(machine=ChillerParameters(**machine), **values))


def battery_step(name: str, stored_kwh: Any, command: Any, **values: Any) -> BatteryResult:
    """One step of a battery at ``BatteryPoint`` and ``BatteryParameters``."""
    given = {key: values.pop(key) for key in BatteryParameters._fields if key in values}
    point = BatteryPoint(parameters=BatteryParameters(**given), **values)
    return BATTERIES[name].step(stored_kwh, command, point)


def work_done(name: str, demand: Any, command: Any, waiting: Any, due: Any, **limits: Any) -> Work:
    """What a model of work does in one step."""
    return MODELS[name].step(WorkPoint(demand, command, waiting, due, **limits))
