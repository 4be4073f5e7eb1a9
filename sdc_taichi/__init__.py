"""Simulate data centers in batches: workload, cooling, battery, carbon, and every server's air."""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from sdc_taichi.config import DataCenterConfig, load_config, preset_names
from sdc_taichi.envs import registration
from sdc_taichi.errors import ConfigError, DataError, RuntimeStateError, SdcError
from sdc_taichi.sim.drivers import Drivers, drivers_from_arrays, load_drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet, make_configs
from sdc_taichi.sim.simulator import Simulator
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

if TYPE_CHECKING:
    from sdc_taichi.envs.parallel import aec_env, parallel_env
    from sdc_taichi.envs.recording import EpisodeRecorder, RecordEpisodes
    from sdc_taichi.envs.rewards import register_reward
    from sdc_taichi.envs.vector import vector_env

__version__ = version("sdc-taichi")

registration.register()

__all__ = [
    "Actions",
    "BatteryAction",
    "ConfigError",
    "CoolAction",
    "DataCenterConfig",
    "DataError",
    "Drivers",
    "EpisodeRecorder",
    "Exogenous",
    "FanAction",
    "Fleet",
    "LoadAction",
    "RecordEpisodes",
    "RuntimeStateError",
    "SdcError",
    "ServerLayers",
    "Simulator",
    "State",
    "StepResult",
    "aec_env",
    "build_fleet",
    "drivers_from_arrays",
    "load_config",
    "load_drivers",
    "make_configs",
    "parallel_env",
    "preset_names",
    "register_reward",
    "vector_env",
]

# Imported on first use, as they bring PettingZoo and the environments with them.
_LAZY = {
    "EpisodeRecorder": "sdc_taichi.envs.recording",
    "RecordEpisodes": "sdc_taichi.envs.recording",
    "aec_env": "sdc_taichi.envs.parallel",
    "parallel_env": "sdc_taichi.envs.parallel",
    "register_reward": "sdc_taichi.envs.rewards",
    "vector_env": "sdc_taichi.envs.vector",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found = getattr(import_module(_LAZY[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
