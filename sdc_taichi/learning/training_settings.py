"""Settings of a training: algorithm, data centers, environments, validation and checkpoints.

They are YAML as configurations are, and no PyTorch is needed to read and check them.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import (
    Field,
    SerializeAsAny,
    field_serializer,
    field_validator,
    model_validator,
)

from sdc_taichi.config import (
    DataCenterConfig,
    apply_override,
    config_from_dict,
    load_config,
    load_yaml,
    preset_names,
    validated,
    with_values,
)
from sdc_taichi.config.fields import Section
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, AGENTS
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.errors import ConfigError, shortened, suggestion_or_valid
from sdc_taichi.learning.algorithms import LEARNING_SETTINGS, LearningSettings
from sdc_taichi.learning.split import (
    DAYS_PER_WEEK,
    TRAINING,
    UNSCORED_DAYS,
    WEEKS,
    data_center_weeks,
)
from sdc_taichi.number_text import parse_number
from sdc_taichi.sim.fleet_configs import make_configs
from sdc_taichi.user_file import MOST_CONFIG_BYTES, read_text

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
"""Sites of all scenarios."""
_FLEXIBLE = {
    "workload": {"flexible_share": 0.4, "queue_limit_h": 5.0},
    "battery": {
        "hours_of_design_load": 4.0,
        "charge_limit_c_rate": 0.25,
        "discharge_limit_c_rate": 0.25,
    },
}
"""Twice the work that may wait, and a battery of four hours."""
_BILL = {"rewards": "bill"}
_EVENTS = [
    {"kind": "crac_down", "per_year": 26, "duration_h": [2, 24]},
    {"kind": "chiller_derate", "per_year": 13, "duration_h": [2, 24], "share": 0.5},
    {"kind": "pump_down", "per_year": 6, "duration_h": [1, 8], "share": 0.5},
    {"kind": "tower_cell_down", "per_year": 13, "duration_h": [4, 48], "share": 0.5},
    {"kind": "heat_wave", "per_year": 13, "duration_h": [24, 96], "offset_k": 8},
]
_FAILURES = {
    "hvac": {"crac": {"units": 4}},
    "protection": {"ashrae_class": "A1"},
    "events": {"sampled": _EVENTS},
}
"""Four CRAC units without a spare one, servers of class A1, and failures and heat waves that come
ten times as often as in practice, so that a few weeks have some."""
_COOL = {"agent_dc": {"cooling_carbon": 10.0, "hot_inlets": 1.0}}
"""Rewards as by default, with ten times the weight of hot inlets."""
SCENARIOS: Mapping[str, Mapping[str, Any]] = {
    "carbon": {"sites": SITES},
    "carbon-rich": {"sites": SITES, "overrides": _FLEXIBLE},
    "bill": {"sites": SITES, "environment": _BILL, "validation": {"objective": "cost"}},
    "bill-rich": {
        "sites": SITES,
        "overrides": _FLEXIBLE,
        "environment": _BILL,
        "validation": {"objective": "cost"},
    },
    "failures": {
        "sites": SITES,
        "overrides": _FAILURES,
        "environment": {"rewards": _COOL, "collaboration": 1.0},
        "validation": {"optimum": False},
    },
}
"""Settings of each scenario, all of preset ``corrected``: the carbon of the hall as it is, the same
with twice the work that may wait and a battery of four hours, and of both the electricity bill,
which is energy by time of use and a demand charge; and carbon where cooling fails and hot inlets
cost."""

CI_LEADS_H = tuple(range(1, 25))
"""Leads of the forecasts of carbon intensity and price that trained agents observe, in h."""
SETPOINT_CHANGE_K = 0.5
"""Largest change of the setpoint in a step by trained agents, who hold it for some steps, in K."""
_SHAPE_OF_DAY = ("ci_rank", "ci_relative", "ci_swing")
_OWN_PARTS = ("default", "bill")
"""Rewards that pay each agent for its own part; sharing rewards would add noise."""
_PRICES = ("price", "price_forecast")


def training_environment(options: Mapping[str, Any]) -> dict[str, Any]:
    """Default options of environments for trainings, below the options that are set.

    Actions are continuous, and agents observe the hourly shape of the coming day: the carbon
    intensity relative to its range and, with rewards ``bill``, the price.

    Args:
        options: options that the user or a scenario sets, by name.
    """
    agents, commands = options.get("agents") or AGENTS, options.get("commands") or {}
    # Invalid values are refused later, together with those of all other options.
    agents = [x for x in agents if x in AGENTS] if isinstance(agents, list | tuple) else []
    commands = commands if isinstance(commands, Mapping) else {}
    defaults: dict[str, Any] = {}
    if options.get("actions", "continuous") == "continuous":
        defaults["actions"] = "continuous"
        decided = commands.get("agent_dc", ("cooling",))
        moves_setpoint = isinstance(decided, list | tuple) and "cooling" in decided
        if "agent_dc" in agents and moves_setpoint:
            defaults["setpoint_change_k"] = SETPOINT_CHANGE_K
    if options.get("rewards", "default") in _OWN_PARTS:
        defaults["collaboration"] = 1.0
    if options.get("observations", "default") == "default":
        defaults["ci_leads_h"] = CI_LEADS_H
        if not commands:
            defaults["features"] = {agent: _features(agent, options) for agent in agents}
    return defaults


def _features(agent: str, options: Mapping[str, Any]) -> tuple[str, ...]:
    """Default features of an agent, with hourly forecasts in place of those they replace."""
    names = AGENT_DEFINITIONS[agent].features
    if agent == "agent_dc":
        return (*(name for name in names if name != "ci_forecast"), "queue")
    names = tuple(name for name in names if name not in ("ci_forecast", "ci_change"))
    prices = _PRICES if options.get("rewards") == "bill" else ()
    return (*names, *_SHAPE_OF_DAY, *prices)


MOST_STEPS = 10**12
"""Largest number of steps of a training: years of the fastest machine."""
Week = Annotated[int, Field(strict=True, ge=0, lt=WEEKS)]
"""Week of the year, 0..51."""
_FIXED_BY_WEEKS = ("start", "months")

Steps = Annotated[int, Field(strict=True, ge=1, le=MOST_STEPS)]
"""Number of steps of all data centers together, 1..1e12."""


class ValidationSettings(Section):
    """Settings of the validation weeks, by which a training chooses its best policy."""

    steps: Annotated[int, Field(strict=True, ge=0, le=MOST_STEPS)] = 200_000
    """Steps of all data centers together between two validations, 0..1e12; 0 is no validation."""
    weeks: Literal["validation"] | tuple[Week, ...] = "validation"
    """Weeks of the year, 0..51; ``validation`` is weeks 1, 9, ..., 49."""
    days: Annotated[int, Field(strict=True, gt=UNSCORED_DAYS, le=DAYS_PER_WEEK)] = DAYS_PER_WEEK
    """Days of each week that are run, 2..7; the first is not scored."""
    objective: Annotated[str, Field(min_length=1, max_length=200)] = "carbon"
    """Objective whose share of the achievable is measured: ``carbon``, ``energy``, ``cost``,
    ``water``, or a sum such as ``carbon+0.002*water``."""
    optimum: bool = True
    """Whether to solve, once, for the optimum of these weeks, which values stored energy and
    waiting work at their ends and gives the share of the achievable; else policies are compared
    with idle commands alone."""

    @field_validator("weeks")
    @classmethod
    def _each_week_once(cls, value: Any) -> Any:
        return _weeks_once(value)


class TrainingSettings(Section):
    """Everything that decides a training."""

    algorithm: str
    """Name of the algorithm: ``ppo``, ``ippo``, ``mappo``, ``happo``, ``haa2c``, ``had3qn``,
    ``hasac`` or ``cross-entropy``."""
    scenario: str | None = None
    """Scenario whose settings lie beneath those given: ``carbon``, ``carbon-rich``, ``bill``,
    ``bill-rich`` or ``failures``; None is none."""
    config: Annotated[str, Field(min_length=1)] | dict[str, Any] = "corrected"
    """Data center: a preset, a file, or the sections of a configuration."""
    overrides: dict[str, Any] = Field(default={})
    """Values put into the configuration, section by section."""
    sites: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Sites, one data center for each; none is the site of the configuration."""
    weeks: Literal["training"] | tuple[Week, ...] | None = "training"
    """Weeks of the year, 0..51, that episodes begin in, one data center for each site and week;
    ``training`` is all that are neither held out nor for validation, None takes the first days
    from ``environment``."""
    data_centers: Annotated[int, Field(strict=True, ge=1, le=1_000_000)] | None = None
    """Number of data centers at once, to which those of all sites and weeks are dealt in turn; None
    is the smallest multiple of theirs from 256 on."""
    environment: EnvOptions = EnvOptions()
    """Options of the environments, as in docs/environments.md."""
    precision: Literal["f32", "f64"] = "f32"
    """Precision of the server kernels."""
    steps: Steps = 2_000_000
    """Steps of all data centers together, 1..1e12; those of a last update that would exceed it are
    left out."""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**31)] = 0
    """Seed of networks, actions, mini-batches and episodes, 0..2^31 - 1."""
    learning: SerializeAsAny[LearningSettings] = Field(default={}, validate_default=True)
    """Settings of the algorithm."""
    checkpoint_steps: Steps = 100_000
    """Steps of all data centers together between two checkpoints, 1..1e12."""
    validation: ValidationSettings = ValidationSettings()
    """Weeks in which policies are tried."""
    tensorboard: bool = True
    """Whether to write TensorBoard events."""

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_scenario(cls, values: Any) -> Any:
        """Merge the values with those of their scenario and the defaults of all trainings."""
        if not isinstance(values, Mapping):
            return values
        name = values.get("scenario")
        if name is not None:
            if name not in SCENARIOS:
                raise ValueError(f"scenario {name!r}{suggestion_or_valid(name, SCENARIOS)}")
            values = merged(SCENARIOS[name], values)
        options = values.get("environment") or {}
        if isinstance(options, EnvOptions):
            options = _set_options(options)
        if not isinstance(options, Mapping):
            return values
        return merged({"environment": training_environment(options)}, values)

    @field_validator("algorithm")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in LEARNING_SETTINGS:
            raise ValueError(f"no algorithm{suggestion_or_valid(value, LEARNING_SETTINGS)}")
        return value

    @field_validator("config")
    @classmethod
    def _found_from_anywhere(cls, value: Any) -> Any:
        """Files by their absolute path, as a training may be resumed elsewhere."""
        is_file = isinstance(value, str) and value not in preset_names() and os.path.isfile(value)
        return os.path.abspath(value) if is_file else value

    @field_validator("sites")
    @classmethod
    def _each_once(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        names = [name.strip().upper() for name in value]
        if len(set(names)) < len(names):
            raise ValueError(f"{list(value)}; valid is each site once")
        return tuple(names)

    @field_validator("steps", "checkpoint_steps", mode="before")
    @classmethod
    def _whole_steps(cls, value: Any) -> Any:
        return whole_steps(value)

    @field_validator("weeks")
    @classmethod
    def _each_week_once(cls, value: Any) -> Any:
        return _weeks_once(value)

    @field_validator("learning", mode="before")
    @classmethod
    def _of_the_algorithm(cls, value: Any, info: Any) -> Any:
        """Settings of the class that the algorithm has."""
        kind = LEARNING_SETTINGS.get(info.data.get("algorithm"))
        if kind is None or isinstance(value, kind):
            return value
        return validated(kind, value, f"settings of {info.data['algorithm']}")

    @field_validator("environment")
    @classmethod
    def _plain(cls, value: EnvOptions) -> EnvOptions:
        """Refuse objects, which cannot be written down."""
        for name in value.model_fields_set:
            option = getattr(value, name)
            if callable(option) or (name == "others" and not isinstance(option, str)):
                raise ValueError(
                    f"{name}: {type(option).__name__}; valid in settings is its name, or its path "
                    "module:name"
                )
        return value

    @field_serializer("environment")
    def _options_set(self, value: EnvOptions) -> dict[str, Any]:
        """The options that were set: others would be errors, or follow from these."""
        dumped = value.model_dump(mode="json", exclude_unset=True)
        follow = json.loads(json.dumps(training_environment(dumped)))
        return {k: v for k, v in dumped.items() if k not in follow or v != follow[k]}

    @model_validator(mode="after")
    def _weeks_fit_episodes(self) -> Self:
        if self.weeks is None:
            return self
        names = [name for name in _FIXED_BY_WEEKS if name in self.environment.model_fields_set]
        if names:
            raise ValueError(
                f"environment.{names[0]}: without effect with weeks; valid with weeks null"
            )
        if self.environment.days > DAYS_PER_WEEK:
            raise ValueError(
                f"environment.days {self.environment.days}: episodes would run into other weeks; "
                f"valid is at most {DAYS_PER_WEEK}, or weeks null"
            )
        return self

    def to_yaml(self) -> str:
        """YAML text that ``load_settings`` reads back equal."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)

    def options(self) -> EnvOptions:
        """Options of the environments, with the first days that ``weeks`` fixes."""
        if self.weeks is None:
            return self.environment
        return EnvOptions.model_validate(_set_options(self.environment) | {"start": "fixed"})

    def _config(self) -> DataCenterConfig:
        """The data center, with its overrides, before sites and weeks."""
        overrides = dict(leaves("", self.overrides))
        if isinstance(self.config, str):
            return load_config(self.config, [f"{k}={json.dumps(v)}" for k, v in overrides.items()])
        return with_values(config_from_dict(self.config), overrides)

    def data_centers_of_weeks(self) -> list[DataCenterConfig]:
        """Data centers to train in: one for each site and week, site by site.

        Raises:
            ConfigError: a file, value or site that is not valid.
        """
        of_sites = self.data_centers_of_sites()
        if self.weeks is None:
            return of_sites
        return data_center_weeks(of_sites, TRAINING if self.weeks == "training" else self.weeks)

    def data_centers_of_sites(self) -> list[DataCenterConfig]:
        """One data center for each site, or that of the configuration.

        Raises:
            ConfigError: a file, value or site that is not valid.
        """
        config, tariff = self._config(), self.environment.tariff
        if tariff is not None:
            config = config.model_copy(update={"tariff": tariff})
        return make_configs(config, sites=self.sites)

    def difference(self, other: TrainingSettings) -> str | None:
        """The first setting but ``steps`` in which others differ, with both values.

        Args:
            other: settings to compare with.
        """
        ours, others = (dict(leaves("", s.model_dump(mode="json"))) for s in (self, other))
        for name in [*ours, *others]:
            one, two = ours.get(name), others.get(name)
            is_section = {} in (one, two)
            if name != "steps" and one != two and not is_section:
                return f"{name}: {shortened(one)}, not {shortened(two)}"
        return None


def make_settings(values: Mapping[str, Any], label: str = "settings") -> TrainingSettings:
    """Settings of plain values.

    Args:
        values: settings as in a YAML file.
        label: where they come from, at the start of every message.

    Raises:
        ConfigError: naming the setting, its value and what would be valid.
    """
    return validated(TrainingSettings, values, label)


def load_settings(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> TrainingSettings:
    """Read settings from a YAML file.

    Args:
        path: the file.
        overrides: ``a.b=c`` assignments applied last.

    Raises:
        ConfigError: naming the file, the setting, its value and what would be valid.
    """
    values = read_values(path)
    for override in overrides:
        apply_override(values, override)
    return make_settings(values, str(path))


def read_values(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Plain values of a YAML file of settings, not yet checked.

    Raises:
        ConfigError: no such file, or no YAML.
    """
    try:
        values = load_yaml(read_text(path, MOST_CONFIG_BYTES, ConfigError))
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{path}: not valid YAML ({error})") from None
    if not isinstance(values, dict):
        raise ConfigError(
            f"{path}: the top level is a {type(values).__name__}; valid is a mapping of settings"
        )
    return values


def _weeks_once(value: Any) -> Any:
    """Weeks of the year, at least one and each once; other values as they are."""
    if isinstance(value, tuple) and (not value or len(set(value)) < len(value)):
        raise ValueError(f"{list(value)}; valid is one or more weeks, each once")
    return value


def whole_steps(value: Any) -> Any:
    """A number of steps that may be written as ``2e6``; other values as they are."""
    if isinstance(value, str):
        try:
            value = parse_number(value)
        except ValueError:
            return value
    return int(value) if isinstance(value, float) and value.is_integer() else value


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Values with some of them replaced, section by section.

    Args:
        base: the values.
        over: values that replace those of ``base``; a section may be an object.
    """
    out = dict(base)
    for key, value in over.items():
        if isinstance(value, EnvOptions):
            value = _set_options(value)
        old = out.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merged(old, value)
        out[key] = value
    return out


def _set_options(options: EnvOptions) -> dict[str, Any]:
    """Options that were set explicitly, by name; setting others could be an error."""
    return {name: getattr(options, name) for name in options.model_fields_set}


def leaves(path: str, values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Values that are no sections, by their dotted paths.

    Args:
        path: dotted path of the values; empty at the top.
        values: the values.
    """
    for key, value in values.items():
        name = f"{path}.{key}".lstrip(".")
        if isinstance(value, Mapping) and value:
            yield from leaves(name, value)
        else:
            yield name, value
