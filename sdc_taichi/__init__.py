"""Simulate data centers in batches: workload, cooling, battery, carbon, and every server's air."""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from sdc_taichi.config import DataCenterConfig, load_config, preset_names, with_values
from sdc_taichi.envs import register as register_environments
from sdc_taichi.errors import (
    ConfigError,
    DataError,
    OddInputWarning,
    PhysicalLimitError,
    RuntimeStateError,
    SdcError,
    SdcWarning,
)
from sdc_taichi.sim.drivers import Drivers, drivers_from_arrays, load_drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.fleet_configs import make_configs
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
    from sdc_taichi.control import ForecastError, View, make_controller, register_controller
    from sdc_taichi.envs.costs import register_cost
    from sdc_taichi.envs.options import EnvOptions
    from sdc_taichi.envs.parallel import aec_env, parallel_env
    from sdc_taichi.envs.recording import EpisodeRecorder, RecordEpisodes
    from sdc_taichi.envs.rewards import register_reward
    from sdc_taichi.envs.vector import vector_env
    from sdc_taichi.run.description import RunRequest
    from sdc_taichi.run.folder_writer import simulate_to_folder
    from sdc_taichi.run.loop import simulate
    from sdc_taichi.viz.recorder import Recorder

__version__ = version("sdc-taichi")

register_environments()

__all__ = [
    "Actions",
    "BatteryAction",
    "ConfigError",
    "CoolAction",
    "DataCenterConfig",
    "DataError",
    "Drivers",
    "EnvOptions",
    "EpisodeRecorder",
    "Exogenous",
    "FanAction",
    "Fleet",
    "ForecastError",
    "LoadAction",
    "OddInputWarning",
    "PhysicalLimitError",
    "RecordEpisodes",
    "Recorder",
    "RunRequest",
    "RuntimeStateError",
    "SdcError",
    "SdcWarning",
    "ServerLayers",
    "Simulator",
    "State",
    "StepResult",
    "View",
    "aec_env",
    "build_fleet",
    "drivers_from_arrays",
    "load_config",
    "load_drivers",
    "make_configs",
    "make_controller",
    "parallel_env",
    "preset_names",
    "register_controller",
    "register_cost",
    "register_reward",
    "simulate",
    "simulate_to_folder",
    "vector_env",
    "with_values",
]

# Imported on first use, as they bring PettingZoo, the environments or the viewer with them.
_LAZY = {
    "EnvOptions": "sdc_taichi.envs.options",
    "EpisodeRecorder": "sdc_taichi.envs.recording",
    "ForecastError": "sdc_taichi.control",
    "RecordEpisodes": "sdc_taichi.envs.recording",
    "Recorder": "sdc_taichi.viz.recorder",
    "RunRequest": "sdc_taichi.run.description",
    "View": "sdc_taichi.control",
    "aec_env": "sdc_taichi.envs.parallel",
    "make_controller": "sdc_taichi.control",
    "parallel_env": "sdc_taichi.envs.parallel",
    "register_controller": "sdc_taichi.control",
    "register_cost": "sdc_taichi.envs.costs",
    "register_reward": "sdc_taichi.envs.rewards",
    "simulate": "sdc_taichi.run.loop",
    "simulate_to_folder": "sdc_taichi.run.folder_writer",
    "vector_env": "sdc_taichi.envs.vector",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found = getattr(import_module(_LAZY[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
