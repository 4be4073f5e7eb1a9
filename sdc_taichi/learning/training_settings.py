"""Settings of a training: algorithm, data centers, environments, validation and checkpoints.

Settings are written as YAML, as configurations are. This module does not import PyTorch.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from pydantic import (
    AfterValidator,
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
from sdc_taichi.control.registry import is_path
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, AGENTS, HALL_AGENTS, Agent
from sdc_taichi.envs.hall import LARGEST_CHANGES
from sdc_taichi.envs.options import EnvOptions, fields_set
from sdc_taichi.errors import ConfigError, shortened, suggestion_or_valid
from sdc_taichi.learning.algorithms import LEARNING_SETTINGS, LearningSettings
from sdc_taichi.learning.split import (
    DAYS_PER_WEEK,
    TRAINING,
    UNSCORED_DAYS,
    VALIDATION,
    WEEKS,
    data_center_weeks,
    in_year,
    of_week,
)
from sdc_taichi.number_text import parse_number
from sdc_taichi.sim.fleet_configs import make_configs
from sdc_taichi.sim.hall_family import hall_family
from sdc_taichi.user_file import MOST_CONFIG_BYTES, read_text
from sdc_taichi.user_functions import check_file_names

SITES = ("AZ", "CA", "GA", "IL", "NY", "TX", "VA", "WA")
"""Sites (US states) of the data centers in every scenario."""
_FLEXIBLE = {
    "workload": {"flexible_share": 0.4, "queue_limit_h": 5.0},
    "battery": {
        "hours_of_design_load": 4.0,
        "charge_limit_c_rate": 0.25,
        "discharge_limit_c_rate": 0.25,
    },
}
"""Overrides for more flexible data centers: a larger share of deferrable work, and a battery that
stores the design load of four hours."""
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
"""Overrides for data centers with failures: four CRAC units without redundancy, servers of ASHRAE
class A1, and failures and heat waves ten times as frequent as in practice, so that they occur even
in a few weeks."""
_COOL = {"agent_dc": {"cooling_carbon": 10.0, "hot_inlets": 1.0}}
"""Default rewards with ten times the weight of hot server inlets."""
HALL_OBJECTIVE = "energy+140*heat"
"""Objective of halls: the energy, and for each hour and kelvin by which the hottest inlet exceeds
27 C as much as the rewards of the agents weigh it in ``hall_agents_6``."""
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
    "hall": {
        "config": "hall_agents_6",
        "weeks": None,
        "data_centers": 32,
        "environment": {"agents": HALL_AGENTS, "days": 1},
        # Air reacts within minutes, so fans need a decision in every step, and small changes.
        "learning": {"decision_steps": 1, "levels": None},
        "validation": {"optimum": False, "weeks": (1, 25), "days": 2, "objective": HALL_OBJECTIVE},
    },
}
"""Training settings of each scenario. Scenarios with ``sites`` use preset ``corrected``: ``carbon``
minimises carbon emissions, ``bill`` the electricity bill (time-of-use energy prices and a demand
charge). Scenarios ``-rich`` have more deferrable work and a larger battery. ``failures`` minimises
carbon emissions with failing cooling equipment and a penalty for hot server inlets. ``hall`` has an
agent for each CRAC unit of a hall and one for the plant, which minimise energy and hot inlets."""

CI_LEADS_H = tuple(range(1, 25))
"""Lead times of the carbon-intensity and price forecasts that agents observe, in h."""
SETPOINT_CHANGE_K = 0.5
"""Maximum setpoint change per step in trainings, in K; small because actions are repeated for
several steps."""
_SHAPE_OF_DAY = ("ci_rank", "ci_relative", "ci_swing")
_OWN_PARTS = ("default", "bill")
"""Reward functions in which each agent's reward depends on its own part of the data center; sharing
such rewards between agents would only add noise."""
_PRICES = ("price", "price_forecast")


def training_environment(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the default environment options of trainings.

    By default, actions are continuous, and agents observe hourly forecasts for the coming day: the
    carbon intensity relative to its range and, with rewards that depend on it, the price.

    Args:
        options: options that the user or a scenario sets, by name; they take precedence over the
            defaults.
    """
    agents, commands = options.get("agents") or AGENTS, options.get("commands") or {}
    # Ignore invalid values here; they are reported when all options are validated.
    learning = agents if isinstance(agents, list | tuple) else []
    agents = [x for x in learning if x in AGENTS]
    commands = commands if isinstance(commands, Mapping) else {}
    defaults: dict[str, Any] = {}
    if options.get("actions", "continuous") == "continuous":
        defaults["actions"] = "continuous"
        for agent in ("agent_dc", *HALL_AGENTS):
            decided = commands.get(agent, (AGENT_DEFINITIONS[agent].command,))
            if agent not in learning or not isinstance(decided, list | tuple):
                continue
            if "cooling" in decided:
                defaults["setpoint_change_k"] = SETPOINT_CHANGE_K
            if "fan" in decided and agent in HALL_AGENTS:
                name, largest = LARGEST_CHANGES["fan"]
                defaults[name] = largest
    if options.get("rewards", "default") in _OWN_PARTS:
        defaults["collaboration"] = 1.0
    if agents and options.get("observations", "default") == "default":
        defaults["ci_leads_h"] = CI_LEADS_H
        # The features of an agent with other commands are those of the environment.
        if features := {x: _features(x, options) for x in agents if x not in commands}:
            defaults["features"] = features
    return defaults


def _features(agent: str, options: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the default features of an agent, with hourly instead of coarse forecasts."""
    names = AGENT_DEFINITIONS[agent].features
    if agent == "agent_dc":
        return (*(name for name in names if name != "ci_forecast"), "queue")
    names = tuple(name for name in names if name not in ("ci_forecast", "ci_change"))
    return (*names, *_SHAPE_OF_DAY, *(_PRICES if _has_costs(options.get("rewards")) else ()))


def _has_costs(rewards: Any) -> bool:
    """Return True if rewards depend on prices: reward set ``bill``, or terms such as ``cost``."""
    if not isinstance(rewards, Mapping):
        return bool(rewards == "bill")
    scales = [x for x in rewards.values() if isinstance(x, Mapping)]
    return any(str(term).endswith("cost") for terms in scales for term in terms)


LEAST_DATA_CENTERS = 256
"""Minimum number of data centers in a training whose settings leave the number open."""
MOST_STEPS = 10**12
"""Maximum number of steps of a training; even the fastest machine would take years for it."""
Week = Annotated[int, Field(strict=True, ge=0, lt=WEEKS)]
"""Week of the year, 0..51."""


def _years_once(value: tuple[int, ...]) -> tuple[int, ...]:
    """Check that a tuple of years has no duplicates; return it."""
    if len(set(value)) < len(value):
        raise ValueError(f"{list(value)}; valid is each year once")
    return value


Years = Annotated[
    tuple[Annotated[int, Field(strict=True, ge=0, lt=2**31)], ...], AfterValidator(_years_once)
]
"""Seeds of synthetic years, 0..2^31 - 1, each once."""
_FIXED_BY_WEEKS = ("start", "months")

Steps = Annotated[int, Field(strict=True, ge=1, le=MOST_STEPS)]
"""Number of steps, summed over all data centers, 1..1e12."""


class ValidationSettings(Section):
    """Settings of the validation weeks, by which a training chooses its best policy."""

    steps: Annotated[int, Field(strict=True, ge=0, le=MOST_STEPS)] = 200_000
    """Number of steps between two validations, summed over all data centers, 0..1e12; 0 disables
    validation."""
    weeks: Literal["validation"] | tuple[Week, ...] = "validation"
    """Weeks of the year, 0..51; ``validation`` stands for weeks 5, 18, 31 and 44."""
    years: Years = ()
    """Seeds of the synthetic years of each data center; an empty list selects that of the
    configuration."""
    days: Annotated[int, Field(strict=True, gt=UNSCORED_DAYS, le=DAYS_PER_WEEK)] = DAYS_PER_WEEK
    """Number of days simulated in each week, 2..7; the first day is not scored."""
    objective: Annotated[str, Field(min_length=1, max_length=200)] = "carbon"
    """Objective by which policies are compared: ``carbon``, ``energy``, ``cost``, ``water``,
    without an optimum ``heat``, or a sum such as ``carbon+0.002*water``."""
    optimum: bool = True
    """True to compute the optimum of the validation weeks once. It gives the share of the
    achievable saving, and the value of stored energy and waiting work at the end of a week. False
    to compare policies with idle commands only."""

    @field_validator("weeks")
    @classmethod
    def _each_week_once(cls, value: Any) -> Any:
        return _weeks_once(value)


class HallDraws(Section):
    """Halls drawn at random from the family of the configuration (``sim.hall_family``)."""

    count: Annotated[int, Field(strict=True, ge=1, le=10_000)]
    """Number of halls, 1..10,000."""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**31)] = 0
    """Seed of the draws, 0..2^31 - 1; other seeds give other halls."""


class TrainingSettings(Section):
    """All settings of a training; they determine its result."""

    algorithm: str
    """Name of the algorithm: ``ppo``, ``ippo``, ``mappo``, ``happo``, ``haa2c``, ``had3qn``,
    ``hasac`` or ``cross-entropy``."""
    scenario: str | None = None
    """Scenario that provides default settings: ``carbon``, ``carbon-rich``, ``bill``,
    ``bill-rich``, ``failures`` or ``hall``; None selects no scenario."""
    config: Annotated[str, Field(min_length=1)] | dict[str, Any] = "corrected"
    """Configuration of the data center: a preset, a file, or the sections of a configuration."""
    overrides: dict[str, Any] = Field(default={})
    """Values that replace those of the configuration, by section."""
    sites: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    """Sites, with one data center for each site; an empty list selects the configuration's site."""
    halls: HallDraws | None = None
    """Halls drawn at random, which have the sites in turn, in place of one data center for each
    site; None selects the hall of the configuration."""
    weeks: Literal["training"] | tuple[Week, ...] | None = "training"
    """Weeks of the year, 0..51, in which episodes begin, with one data center for each site and
    week. ``training`` stands for all weeks that are neither held out nor used for validation. None
    takes the first days of episodes from ``environment``."""
    years: Years = ()
    """Seeds of synthetic years. Each pair of site and week is in one of them, the pairs in turn. An
    empty list selects the year of the configuration."""
    data_centers: Annotated[int, Field(strict=True, ge=1, le=1_000_000)] | None = None
    """Number of data centers that are simulated at once. The pairs of site and week are assigned to
    them in turn. None selects the smallest multiple of the number of pairs that is at least 256."""
    environment: EnvOptions = EnvOptions()
    """Options of the environments, as in docs/environments.md."""
    precision: Literal["f32", "f64"] = "f32"
    """Precision of the server kernels."""
    steps: Steps = 2_000_000
    """Maximum number of steps, summed over all data centers, 1..1e12; the training makes as many
    complete updates as fit."""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**31)] = 0
    """Seed of networks, actions, mini-batches and episodes, 0..2^31 - 1."""
    own_policies: tuple[Agent, ...] = ()
    """Groups of which each agent learns a policy of its own. By default all agents of a group share
    a policy, which then also controls halls with other numbers of CRAC units."""
    learning: SerializeAsAny[LearningSettings] = Field(default={}, validate_default=True)
    """Settings of the algorithm."""
    checkpoint_steps: Steps = 100_000
    """Number of steps between two checkpoints, summed over all data centers, 1..1e12."""
    validation: ValidationSettings = ValidationSettings()
    """Settings of the validation, by which the best policy is chosen."""
    tensorboard: bool = True
    """True to write TensorBoard events."""

    @model_validator(mode="before")
    @classmethod
    def _on_top_of_scenario(cls, values: Any) -> Any:
        """Add the values of the scenario, and the defaults of all trainings, to those given."""
        if not isinstance(values, Mapping):
            return values
        name = values.get("scenario")
        # The field itself refuses a name that is no text.
        if isinstance(name, str):
            if name not in SCENARIOS:
                raise ValueError(f"scenario {name!r}{suggestion_or_valid(name, SCENARIOS)}")
            values = merged(SCENARIOS[name], values)
        options = values.get("environment") or {}
        if isinstance(options, EnvOptions):
            options = fields_set(options)
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
        """Replace file names by absolute paths, as a training may be resumed in another folder."""
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

    @field_validator("years")
    @classmethod
    def _years_have_weeks(cls, value: tuple[int, ...], info: Any) -> tuple[int, ...]:
        if value and info.data.get("weeks", ()) is None:
            raise ValueError("without effect with weeks null; valid is environment.years")
        return value

    @field_validator("learning", mode="before")
    @classmethod
    def _of_the_algorithm(cls, value: Any, info: Any) -> Any:
        """Convert plain values to the settings class of the algorithm."""
        kind = LEARNING_SETTINGS.get(info.data.get("algorithm"))
        if kind is None or isinstance(value, kind):
            return value
        return validated(kind, value, f"settings of {info.data['algorithm']}")

    @field_validator("learning")
    @classmethod
    def _of_several_learners(cls, value: LearningSettings, info: Any) -> LearningSettings:
        """Refuse a reward of its own for the only learner, whose reward is that of the team."""
        if info.data.get("algorithm") == "ppo" and value.reward not in (None, "team", 0.0):
            raise ValueError(
                f"reward {value.reward!r}: ppo has one learner for all agents; valid is team"
            )
        return value

    @field_validator("environment")
    @classmethod
    def _plain(cls, value: EnvOptions) -> EnvOptions:
        """Refuse Python objects as options, because they cannot be written as YAML."""
        for name in value.model_fields_set:
            option = getattr(value, name)
            if callable(option) or (name == "others" and not isinstance(option, str)):
                raise ValueError(
                    f"{name}: {type(option).__name__}; valid in settings is its name, or its path "
                    "module:name"
                )
        return value

    @field_validator("own_policies")
    @classmethod
    def _of_units(cls, value: tuple[str, ...], info: Any) -> tuple[str, ...]:
        """Refuse groups with a single agent, and algorithms with a single network."""
        environment = info.data.get("environment", EnvOptions())
        valid = [a for a in environment.agents if AGENT_DEFINITIONS[a].per_unit]
        if not set(value) <= set(valid):
            raise ValueError(f"{list(value)}; valid are groups of CRAC units that learn: {valid}")
        if value and info.data.get("algorithm") == "ppo":
            raise ValueError("without effect with ppo, which has one network; valid with others")
        return tuple(dict.fromkeys(value))

    @field_serializer("environment")
    def _options_set(self, value: EnvOptions) -> dict[str, Any]:
        """Return the options that were set explicitly and differ from the defaults of trainings."""
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
        """Return the settings as YAML text, from which ``load_settings`` reads equal settings."""
        # Fingerprints of trainings before these settings do not contain them.
        unset = {name for name in ("own_policies", "years", "halls") if not getattr(self, name)}
        values = self.model_dump(mode="json", exclude=unset)
        if not self.validation.years:
            del values["validation"]["years"]
        return yaml.safe_dump(values, sort_keys=False)

    def options(self) -> EnvOptions:
        """Return the options of the environments; if ``weeks`` is set, first days are fixed."""
        if self.weeks is None:
            return self.environment
        return EnvOptions.model_validate(fields_set(self.environment) | {"start": "fixed"})

    def _config(self) -> DataCenterConfig:
        """Return the configuration with its overrides, before sites and weeks are applied."""
        overrides = dict(leaves("", self.overrides))
        if isinstance(self.config, str):
            return load_config(self.config, [f"{k}={json.dumps(v)}" for k, v in overrides.items()])
        return with_values(config_from_dict(self.config), overrides)

    def data_centers_of_weeks(self) -> list[DataCenterConfig]:
        """Return the data centers or fleets of the training: one for each site and week, in order.

        Raises:
            ConfigError: a file, value or site is not valid.
        """
        configs = self.data_centers_of_sites()
        if self.weeks is None:
            return configs
        weeks = TRAINING if self.weeks == "training" else self.weeks
        if not self.years:
            return data_center_weeks(configs, weeks)
        # Each year has as many weeks of each site, spread over the year.
        return [
            of_week(in_year(config, self.years[(site + at) % len(self.years)]), week)
            for site, config in enumerate(configs)
            for at, week in enumerate(weeks)
        ]

    def data_centers_of_sites(self) -> list[DataCenterConfig]:
        """Return one data center for each site; without ``sites``, that of the configuration.

        A configuration of a fleet stands for the data centers of its sites. Halls drawn at random
        have the sites in turn.

        Raises:
            ConfigError: a file, value or site is not valid.
        """
        config, tariff = self._config(), self.environment.tariff
        if tariff is not None:
            config = config.model_copy(update={"tariff": tariff})
        if self.halls is not None:
            return self._drawn(config, self.halls)
        is_fleet = config.fleet is not None and not self.sites
        return [config] if is_fleet else make_configs(config, sites=self.sites)

    def _drawn(self, config: DataCenterConfig, halls: HallDraws) -> list[DataCenterConfig]:
        """Return halls drawn from the family of a configuration, named after number and site."""
        rng = np.random.Generator(np.random.PCG64(halls.seed))
        sites = make_configs(config, sites=self.sites)
        drawn = []
        for at, hall in enumerate(hall_family(rng, halls.count, config)):
            place = sites[at % len(sites)]
            name = f"hall{at}-{place.name}"
            drawn.append(hall.model_copy(update={"name": name, "site": place.site}))
        return drawn

    @property
    def places(self) -> int:
        """Number of data centers, or of fleets that share work, not counting weeks and years."""
        return max(len(self.sites), 1) if self.halls is None else self.halls.count

    def validation_weeks(self) -> int:
        """Return the number of validation weeks of all sites together."""
        weeks, years = self.validation.weeks, self.validation.years
        number = len(VALIDATION if weeks == "validation" else weeks)
        return self.places * max(len(years), 1) * number

    def difference(self, other: TrainingSettings) -> str | None:
        """Describe the first setting that differs, ignoring ``steps``; None if all are equal.

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
    """Create checked settings from plain values.

    Args:
        values: settings as in a YAML file.
        label: origin of the values, which begins every error message.

    Raises:
        ConfigError: a setting is not valid; the message names it, its value and valid values.
    """
    return validated(TrainingSettings, values, label)


def load_settings(
    path: str | os.PathLike[str], overrides: Sequence[str] = (), *, allow_code: bool = False
) -> TrainingSettings:
    """Read settings from a YAML file.

    Args:
        path: the file.
        overrides: assignments ``a.b=c``, which take precedence over the file.
        allow_code: True if import paths ``module:name`` in the file are valid.

    Raises:
        ConfigError: a setting is not valid; the message names the file, the setting, its value and
            valid values.
    """
    values = read_values(path, allow_code=allow_code)
    for override in overrides:
        apply_override(values, override)
    return make_settings(values, str(path))


def read_values(path: str | os.PathLike[str], *, allow_code: bool = False) -> dict[str, Any]:
    """Read plain values from a YAML file of settings, without checking the settings.

    Args:
        path: the file.
        allow_code: True if import paths ``module:name`` in the file are valid.

    Raises:
        ConfigError: the file does not exist, is not valid YAML, or names code.
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
    check_file_names(values, path, is_path=is_path, allow_code=allow_code)
    return values


def _weeks_once(value: Any) -> Any:
    """Check that a tuple of weeks is not empty and has no duplicates; return the value."""
    if isinstance(value, tuple) and (not value or len(set(value)) < len(value)):
        raise ValueError(f"{list(value)}; valid is one or more weeks, each once")
    return value


def whole_steps(value: Any) -> Any:
    """Convert a number of steps such as ``2e6`` to an integer; return other values unchanged."""
    if isinstance(value, str):
        try:
            value = parse_number(value)
        except ValueError:
            return value
    return int(value) if isinstance(value, float) and value.is_integer() else value


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge two nested mappings, section by section.

    Args:
        base: values of lower precedence.
        over: values that replace those of ``base``; a section may be an ``EnvOptions`` object.
    """
    out = dict(base)
    for key, value in over.items():
        if isinstance(value, EnvOptions):
            value = fields_set(value)
        old = out.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merged(old, value)
        out[key] = value
    return out


def leaves(path: str, values: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the dotted path and the value of each leaf of a nested mapping.

    Args:
        path: dotted path of ``values``; empty at the top level.
        values: the nested mapping.
    """
    for key, value in values.items():
        name = f"{path}.{key}".lstrip(".")
        if isinstance(value, Mapping) and value:
            yield from leaves(name, value)
        else:
            yield name, value
