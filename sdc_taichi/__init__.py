"""Simulate data centers in batches: workload, cooling, battery, carbon, and every server's air."""

from importlib.metadata import version

from sdc_taichi.config import DataCenterConfig, load_config, preset_names
from sdc_taichi.drivers import Drivers, drivers_from_arrays, load_drivers
from sdc_taichi.errors import ConfigError, DataError, RuntimeStateError, SdcError
from sdc_taichi.fleet import Fleet, build_fleet, make_configs
from sdc_taichi.sim import Simulator
from sdc_taichi.types import (
    Actions,
    BatteryAction,
    CoolAction,
    Exogenous,
    FanAction,
    LoadAction,
    ServerLayers,
    State,
    StepResult,
)

__version__ = version("sdc-taichi")

__all__ = [
    "Actions",
    "BatteryAction",
    "ConfigError",
    "CoolAction",
    "DataCenterConfig",
    "DataError",
    "Drivers",
    "Exogenous",
    "FanAction",
    "Fleet",
    "LoadAction",
    "RuntimeStateError",
    "SdcError",
    "ServerLayers",
    "Simulator",
    "State",
    "StepResult",
    "build_fleet",
    "drivers_from_arrays",
    "load_config",
    "load_drivers",
    "make_configs",
    "preset_names",
]
