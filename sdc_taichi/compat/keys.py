"""Constructor keys of the released SustainDC class, and the configuration that they describe.

The keys and their defaults are those of ``EnvConfig`` in ``sustaindc_env.py``, and of the wrappers
of HARL (github.com/HewlettPackard/dc-rl, main at a92b475).
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from sdc_taichi.config import DataCenterConfig, load_config, validated, with_values
from sdc_taichi.config.fields import FileName, Name, Section, Share
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.errors import ConfigError, shortened, similar_names

LABEL = "env_config"
"""Source of the keys in error messages."""
KEYS: dict[str, str] = {
    "agents": "agents of parallel_env",
    "location": "site.location",
    "cintensity_file": "site.carbon_file",
    "weather_file": "site.weather_file",
    "workload_file": "workload.trace or site.workload_file",
    "datacenter_capacity_mw": "hall.capacity_mw",
    "timezone_shift": "the clock of a fleet, fleet.sites",
    "days_per_episode": "days of parallel_env",
    "max_bat_cap_Mw": "battery.capacity_kwh",
    "dc_config_file": "the config itself",
    "individual_reward_weight": "collaboration of parallel_env",
    "flexible_load": "workload.flexible_share",
    "ls_reward": "rewards of parallel_env",
    "dc_reward": "rewards of parallel_env",
    "bat_reward": "rewards of parallel_env",
    "evaluation": "no option; it has no effect",
    "actions_are_logits": "no option; actions are integers",
    "month": "months or start_day of parallel_env",
    "partial_obs": "observations of parallel_env",
    "nonoverlapping_shared_obs_space": "state() of parallel_env",
    "is_render": "recorder of parallel_env",
    "rbc_agents": "others of parallel_env",
    "state_type": "no option; it chooses the critic in HARL",
}
"""Each constructor key of the released class, with what this package has in its place."""
TRACES = {
    "Alibaba_CPU_Data_Hourly_1.csv": "alibaba_1",
    "Alibaba_CPU_Data_Hourly_2.csv": "alibaba_2",
    "GoogleClusteData_CPU_Data_Hourly_1.csv": "google_1",
}
"""Name of the workload trace that belongs to each file in ``data/Workload`` of the released code;
the last name is spelt as there."""
DEFAULT_CONFIG_FILE = "dc_config.json"
"""File that describes the hall of the released code, which preset ``sustaindc`` contains."""
_STATE_OF_WEATHER = re.compile(r"USA_([A-Z]{2})_")
_STATE_OF_CARBON = re.compile(r"([A-Z]{2})[A-Z]*_NG_")


class EnvConfig(Section):
    """Values of the constructor keys; see ``KEYS``.

    A key that is left out has the value that the released code uses, also where that code reads a
    key without using it.
    """

    agents: tuple[Literal["agent_ls", "agent_dc", "agent_bat"], ...] = AGENTS  # type: ignore[assignment]
    """Agents that learn; the others stay neutral."""
    location: Name = "ny"
    """Name of the site."""
    cintensity_file: FileName | None = None
    """File of carbon intensity, or the name of the site's file in the released code."""
    weather_file: FileName | None = None
    """EPW file of weather, or the name of the site's file in the released code."""
    workload_file: FileName = "Alibaba_CPU_Data_Hourly_1.csv"
    """File of a workload trace, a key of ``TRACES``, or the name of a trace."""
    datacenter_capacity_mw: Annotated[float, Field(gt=0, le=1e5)] | None = None
    """Limit of the nameplate IT power, in MW."""
    timezone_shift: Annotated[int, Field(ge=-12, le=14)] = 0
    """Local standard time of the site minus the clock of ``day`` and ``hour``, in h."""
    days_per_episode: Annotated[int, Field(ge=1, le=365)] = 7
    """Length of an episode, in days."""
    max_bat_cap_Mw: Annotated[float, Field(ge=0, le=1e5)] | None = None  # noqa: N815
    """Battery capacity, in MWh; the released code names it as a power. None means an hour of the
    design power."""
    dc_config_file: FileName = DEFAULT_CONFIG_FILE
    """File in the format of ``dc_config.json``, or the name of the released file."""
    individual_reward_weight: Share = 1.0
    """Weight of an agent's individual reward in its reward, 0..1."""
    flexible_load: Share | None = None
    """Share of the work that may wait, 0..1; None means that of the preset, 0.2."""
    ls_reward: Any = "default_ls_reward"
    """Reward of agent_ls: a name of ``compat.rewards``, an import path or a function."""
    dc_reward: Any = "default_dc_reward"
    """Reward of agent_dc: a name of ``compat.rewards``, an import path or a function."""
    bat_reward: Any = "default_bat_reward"
    """Reward of agent_bat: a name of ``compat.rewards``, an import path or a function."""
    evaluation: bool = False
    """Without effect, as in the released code."""
    actions_are_logits: bool = False
    """Must be False."""
    month: Annotated[int, Field(ge=0, le=11)]
    """Month near whose first day episodes start, 0..11."""
    partial_obs: bool = True
    """Must be True, as in the released code."""
    nonoverlapping_shared_obs_space: bool = True
    """Kind of shared state that the wrapper of HARL makes; without effect here."""
    is_render: bool = False
    """Without effect, because there is no dashboard."""
    rbc_agents: tuple[str, ...] = ()
    """Must be empty, because the released code has no rules in their place."""
    state_type: Literal["EP", "FP"] = "EP"
    """Choice of the critic in HARL; without effect here."""

    @field_validator("agents")
    @classmethod
    def _at_least_one_each_once(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        if not value or len(set(value)) < len(value):
            raise ValueError(f"{list(value)}; valid is one or more, each once")
        return value

    @field_validator("actions_are_logits", "partial_obs", "rbc_agents")
    @classmethod
    def _only_default(cls, value: Any, info: Any) -> Any:
        default = cls.model_fields[info.field_name].default
        if value != default:
            raise ValueError(f"should be {default}")
        return value


def read_keys(env_config: Mapping[str, Any]) -> EnvConfig:
    """Check the constructor keys.

    Args:
        env_config: values by key. With an attribute ``worker_index``, as RLlib sets it, the month
            follows from the index and replaces that of the key.

    Raises:
        ConfigError: a key is unknown or missing, or a value is not valid.
    """
    if not isinstance(env_config, Mapping):
        raise ConfigError(f"{LABEL} {shortened(env_config)}: valid is a dict of keys to values")
    for key in env_config:
        if key not in KEYS:
            near = similar_names(key, KEYS)
            meant = [f"did you mean {name!r}, here {KEYS[name]}?" for name in near]
            known = meant or [f"valid: {', '.join(KEYS)}"]
            raise ConfigError(f"{LABEL}: unknown key {key!r}; {known[0]}")
    values = dict(env_config)
    worker = getattr(env_config, "worker_index", None)
    if worker is not None:
        values["month"] = (worker - 1) % 12
    return validated(EnvConfig, values, LABEL)


def config_of(keys: EnvConfig, overrides: Mapping[str, Any]) -> DataCenterConfig:
    """Return the data center that the constructor keys describe.

    Args:
        keys: values of the keys.
        overrides: values that replace those of the configuration, by section.key.

    Raises:
        ConfigError: a file is missing, does not belong to the location, or is not valid.
    """
    values: dict[str, Any] = {"site.location": keys.location}
    values |= _site_file("weather_file", keys.weather_file, keys.location, _STATE_OF_WEATHER)
    values |= _site_file("cintensity_file", keys.cintensity_file, keys.location, _STATE_OF_CARBON)
    if os.path.isfile(keys.workload_file):
        values["site.workload_file"] = keys.workload_file
    else:
        values["workload.trace"] = TRACES.get(keys.workload_file, keys.workload_file)
    if keys.flexible_load is not None:
        values["workload.flexible_share"] = keys.flexible_load
    if keys.max_bat_cap_Mw is not None:
        values["battery.capacity_kwh"] = 1e3 * keys.max_bat_cap_Mw
    config = with_values(_hall(keys.dc_config_file), values | dict(overrides))
    if keys.datacenter_capacity_mw is not None:
        _check_capacity(config, keys.datacenter_capacity_mw)
    return config


def _hall(file: str) -> DataCenterConfig:
    """Return preset ``sustaindc``, with the hall of a file if it is not that of the preset."""
    if os.path.isfile(file):
        return load_config(file)
    if os.path.basename(file) != DEFAULT_CONFIG_FILE:
        raise ConfigError(
            f"{LABEL}: dc_config_file {file!r}: no such file; valid is the path of a file, or "
            f"{DEFAULT_CONFIG_FILE}, the hall of preset sustaindc"
        )
    return load_config("sustaindc")


def _site_file(
    key: str, file: str | None, location: str, pattern: re.Pattern[str]
) -> dict[str, str]:
    """Return the field for an input file of a site; none for the released file of the location."""
    if file is None:
        return {}
    if os.path.isfile(file):
        return {KEYS[key]: file}
    state = pattern.match(os.path.basename(file))
    if state is None:
        raise ConfigError(
            f"{LABEL}: {key} {file!r}: no such file; valid is the path of a file, or no key"
        )
    if not location.upper().startswith(state[1]):
        raise ConfigError(
            f"{LABEL}: {key} {file!r}: is that of {state[1]}, and location is {location!r}; valid "
            "is the path of a file, or no key, which takes that of the location"
        )
    return {}


def _check_capacity(config: DataCenterConfig, capacity_mw: float) -> None:
    """Check that no rack exceeds its share of a capacity, so that the capacity has no effect.

    The released code leaves out servers of racks above their share (``dc_config_reader.py``).

    Raises:
        ConfigError: a rack exceeds its share.
    """
    rack_w = config.rack_nameplate_w()
    least_mw = rack_w.max() * len(rack_w) / 1e6
    if capacity_mw < least_mw:
        raise ConfigError(
            f"{LABEL}: datacenter_capacity_mw {capacity_mw:g}: the racks need {least_mw:g}; valid "
            "is that or more, or overrides with hall.capacity_mw, which scales the servers"
        )
