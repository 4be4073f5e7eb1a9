"""Public names of the package; each is imported from its module on first use."""

from . import compat as compat
from .config import DataCenterConfig as DataCenterConfig
from .config import load_config as load_config
from .config import preset_names as preset_names
from .config import with_values as with_values
from .control import ForecastError as ForecastError
from .control import View as View
from .control import make_controller as make_controller
from .control import register_controller as register_controller
from .envs.core import EndedBy as EndedBy
from .envs.costs import register_cost as register_cost
from .envs.hall import HallFamily as HallFamily
from .envs.hall import hall_env as hall_env
from .envs.options import EnvOptions as EnvOptions
from .envs.parallel import aec_env as aec_env
from .envs.parallel import parallel_env as parallel_env
from .envs.recording import EpisodeRecorder as EpisodeRecorder
from .envs.rewards import register_reward as register_reward
from .envs.vector import RecordEpisodes as RecordEpisodes
from .envs.vector import vector_env as vector_env
from .errors import ConfigError as ConfigError
from .errors import DataError as DataError
from .errors import OddInputWarning as OddInputWarning
from .errors import PhysicalLimitError as PhysicalLimitError
from .errors import RuntimeStateError as RuntimeStateError
from .errors import SdcError as SdcError
from .errors import SdcWarning as SdcWarning
from .run.description import RunRequest as RunRequest
from .run.folder_writer import simulate_to_folder as simulate_to_folder
from .run.loop import simulate as simulate
from .sim.drivers import Drivers as Drivers
from .sim.drivers import drivers_from_arrays as drivers_from_arrays
from .sim.drivers import load_drivers as load_drivers
from .sim.fleet import Fleet as Fleet
from .sim.fleet import build_fleet as build_fleet
from .sim.fleet_configs import make_configs as make_configs
from .sim.simulator import Simulator as Simulator
from .types import Actions as Actions
from .types import BatteryAction as BatteryAction
from .types import CoolAction as CoolAction
from .types import Exogenous as Exogenous
from .types import FanAction as FanAction
from .types import LoadAction as LoadAction
from .types import ServerLayers as ServerLayers
from .types import State as State
from .types import StepResult as StepResult
from .viz.recorder import Recorder as Recorder

__all__: list[str]
__version__: str
