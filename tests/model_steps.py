"""Steps of device models by name, for tests, and what every result of a model must hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from sdc_taichi.plant.battery import BATTERIES, BatteryParameters, BatteryPoint
from sdc_taichi.plant.chiller import CHILLERS, ChillerParameters, ChillerPoint, ChillerResult
from sdc_taichi.plant.workload import MODELS, WorkPoint
from sdc_taichi.types import BatteryResult, Work, fields_of


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


@pytest.fixture(autouse=True, scope="module")
def floating_point_errors() -> Iterator[None]:
    """Raise where a model divides by zero, overflows or makes NaN."""
    with np.errstate(all="raise", under="ignore"):
        yield


def assert_batch(result: Any, alone: Callable[[slice], Any]) -> None:
    """Assert that results are finite f64 of five data centers, each the same alone."""
    for field, values in fields_of(result).items():
        assert (values.shape, values.dtype) == ((5,), np.float64)
        assert np.isfinite(values).all()
        for i in range(5):
            assert getattr(alone(slice(i, i + 1)), field)[0] == values[i]
