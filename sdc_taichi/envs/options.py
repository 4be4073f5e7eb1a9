"""Options of an environment: actions, observations and rewards of its agents."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, Self, TypeAlias

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

from sdc_taichi.config import (
    DataCenterConfig,
    apply_overrides,
    config_from_dict,
    load_config,
    validated,
    with_values,
)
from sdc_taichi.config.electrical_schema import TariffConfig
from sdc_taichi.control import check_controller, commands_of
from sdc_taichi.control.unit_zones import MOST_NEIGHBOURS
from sdc_taichi.control.view import PERFECT, ForecastError
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, AGENTS, ALL_AGENTS, HALL_AGENTS, Agent
from sdc_taichi.envs.features import (
    CI_LEADS_H,
    WEATHER_LEADS_H,
    LeadH,
)
from sdc_taichi.envs.rewards import REWARD_SETS
from sdc_taichi.errors import ConfigError, suggestion_or_valid
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, MONTH_OF_DAY
from sdc_taichi.sim.step_inputs import LIQUID_COMMANDS
from sdc_taichi.types import I64


def _plain_int(value: Any) -> Any:
    """Convert NumPy integers to Python integers; return all other values unchanged."""
    return int(value) if isinstance(value, np.integer) else value


PLAIN_INT = BeforeValidator(_plain_int)
"""Pydantic validator that accepts NumPy integers in fields with ``strict=True``. Such fields still
refuse floats and booleans."""
Month = Annotated[int, Field(strict=True, ge=1, le=12), PLAIN_INT]
"""A month, 1..12."""
MOST_YEARS = 2**31
"""Maximum number of years from which episodes draw."""
MOST_LISTED_YEARS = 100_000
"""Maximum length of a ``range`` of years, which is converted to a list."""
Year = Annotated[int, Field(strict=True, ge=0, le=2**63 - 1), PLAIN_INT]
"""Seed of a synthetic year, 0..2**63 - 1."""
YearCount = Annotated[int, Field(strict=True, ge=1, le=MOST_YEARS), PLAIN_INT]
"""Number of years to draw from."""


class EnvOptions(BaseModel):
    """Options of every environment; see docs/environments.md."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    agents: tuple[Agent, ...] = AGENTS  # type: ignore[assignment]
    """Groups of agents that learn. The controller ``others`` commands all other agents."""
    others: Any = "idle"
    """Controller of the agents that do not learn. Valid are a name as on the command line, a list
    of parts such as ``load=name,cooling=name,battery=name``, or an object with the methods
    ``reset(seed)`` and ``act(view)``. Each environment uses its own copy of the object."""
    actions: Literal["discrete", "continuous"] = "discrete"
    """Kind of actions: ``discrete`` chooses among three commands, ``continuous`` is a number of
    -1..1."""
    action_order: Literal["paper", "sustaindc"] | None = None
    """Order of the battery's discrete actions 0, 1 and 2: ``paper`` means charge, hold, discharge;
    ``sustaindc`` means charge, discharge, hold, as in the released code. None chooses the order of
    the preset."""
    commands: Mapping[str, tuple[str, ...]] | None = None
    """Commands that agents decide, by agent, in the order of the numbers in the action. agent_ls
    can decide ``load`` and ``placement``; agent_dc ``cooling``, ``fan`` and ``placement``;
    agent_bat ``battery``; agent_geo ``transfer``; crac ``fan`` and ``cooling``; plant ``cooling``,
    ``chilled_water``, ``facility_approach_k`` and ``reuse_share``; cdu ``cdu_setpoint_c`` and
    ``cdu_flow``; power_cap ``power_cap``. A cdu that is left out decides both of its commands, and
    other agents decide the first of theirs."""
    setpoint_change_k: Annotated[float, Field(gt=0, le=20)] = 2.0
    """Change of the setpoint in one step at a continuous action of 1, in K. This is the largest
    change."""
    fan_change: Annotated[float, Field(ge=0.001, le=1)] = 0.2
    """Change of the CRAC fan speed in one step at a continuous action of 1, as a share of full
    speed, 0.001..1. This is the largest change."""
    clip_actions: bool | None = None
    """True to clip continuous actions to -1..1, because Gaussian policies exceed this range; False
    to refuse actions outside it. Values that are not finite are always refused. None means True in
    the batches of ``gymnasium.make_vec`` and ``vector_env``, and False elsewhere."""
    days: Annotated[int, Field(strict=True, ge=1, le=365), PLAIN_INT] = 7
    """Length of an episode, in days."""
    start: Literal["sampled", "fixed"] = "sampled"
    """Start of episodes: ``sampled`` means midnight of a random day in ``months``, ``fixed`` means
    midnight of the day ``site.start``."""
    months: tuple[Month, ...] = tuple(range(1, 13))
    """Months, 1..12, of sampled episodes. All days of an episode are in these months."""
    years: YearCount | tuple[Year, ...] | None = None
    """Years from which each episode draws one at random. A year is a seed of the synthetic series
    and replaces ``site.seed``. A number n means the seeds 0 to n - 1, a list names the seeds, and
    None means ``site.seed`` in all episodes."""
    traces: tuple[Annotated[str, Field(min_length=1)], ...] | None = None
    """Workload traces, by name or file, from which each episode draws one at random. None means
    ``workload.trace`` in all episodes."""
    observations: Literal["default", "sustaindc"] = "default"
    """Kind of observations: ``default`` means named features, ``sustaindc`` means the observation
    vectors of the released SustainDC code."""
    features: Mapping[str, tuple[str, ...]] | None = None
    """Names of the features that agents observe, by agent. Agents that are left out observe their
    default features."""
    ci_leads_h: tuple[LeadH, ...] = CI_LEADS_H
    """Leads of the carbon-intensity forecast, in h."""
    weather_leads_h: tuple[LeadH, ...] = WEATHER_LEADS_H
    """Leads of the weather forecasts, in h."""
    forecast_error: ForecastError = PERFECT
    """Errors of the forecasts of carbon intensity and weather."""
    neighbours: Annotated[int, Field(strict=True, ge=0, le=MOST_NEIGHBOURS), PLAIN_INT] = 0
    """Number of neighbouring CRAC units whose fan speeds and hottest inlets an agent ``crac``
    observes, 0..8."""
    heat_map: bool = False
    """True if every observation is a dict of features and an image of the hall."""
    rewards: Any = "default"
    """Rewards of the agents. Valid are the reward sets ``default``, ``bill``, ``paper`` and
    ``sustaindc`` and, for agents of CRAC units, ``own``; a dict of agent to term to scale; or a
    function, by the object, by its registered name (``register_reward``) or by its import path
    ``module:name``."""
    collaboration: Annotated[float, Field(ge=0, le=1)] = 0.8
    """Weight a, 0..1, of an agent's individual reward in the reward that the agent receives. The
    individual rewards of the N - 1 other agents have the weight (1 - a)/(N - 1) each (paper,
    section 4.5, with three agents). 1 means no collaboration."""
    tariff: TariffConfig | None = None
    """Electricity tariff that replaces the tariff of all configs; None keeps theirs."""
    costs: Any = None
    """Costs of each step for ``info["cost"]``: a list of names, functions or import paths
    ``module:name``, or a dict from these to weights. None means no costs."""

    @field_validator("years", "traces", mode="before")
    @classmethod
    def _plain_list(cls, value: Any) -> Any:
        """Convert ranges, lists and tuples to lists of numbers and text."""
        if isinstance(value, range):
            if len(value) > MOST_LISTED_YEARS:
                raise ValueError(f"{value}; valid is a range of at most {MOST_LISTED_YEARS:,}")
            return list(value)
        if isinstance(value, list | tuple):
            return [os.fspath(x) if isinstance(x, os.PathLike) else x for x in value]
        return value

    @field_validator("agents", "months", "years", "traces")
    @classmethod
    def _at_least_one_each_once(cls, value: Any) -> Any:
        if isinstance(value, tuple) and (not value or len(set(value)) < len(value)):
            raise ValueError(f"{list(value)[:8]}; valid is one or more, each once")
        return value

    @field_validator("commands")
    @classmethod
    def _commands_of_agents(cls, value: Any) -> Any:
        for agent, names in (value or {}).items():
            if agent not in ALL_AGENTS:
                raise ValueError(f"unknown agent {agent!r}{suggestion_or_valid(agent, ALL_AGENTS)}")
            valid = AGENT_DEFINITIONS[agent].commands
            for name in names:
                if name not in valid:
                    raise ValueError(f"{agent}: {name!r}{suggestion_or_valid(name, valid)}")
            if not names or len(set(names)) < len(names):
                raise ValueError(f"{agent}: {list(names)}; valid is one or more, each once")
        return value

    @field_validator("others")
    @classmethod
    def _a_controller(cls, value: Any) -> Any:
        return value if isinstance(value, str) else check_controller(value)

    @field_validator("agents")
    @classmethod
    def _in_order(cls, value: tuple[Agent, ...]) -> tuple[Agent, ...]:
        return tuple(sorted(value, key=ALL_AGENTS.index))

    @model_validator(mode="after")
    def _options_fit_each_other(self) -> Self:
        for names, without_effect, why in self._without_effect():
            unused = [name for name in names if name in self.model_fields_set]
            if unused and without_effect:
                raise ValueError(f"{', '.join(unused)}: without effect {why}")
        for option in ("features", "commands"):
            for agent in getattr(self, option) or {}:
                if agent in ALL_AGENTS and agent not in self.agents:
                    raise ValueError(
                        f"{option}: without effect for {agent}, which does not learn; valid for "
                        f"{', '.join(self.agents)}"
                    )
        deciding: dict[str, str] = {}
        for agent in self.agents:
            for name in self.commands_of(agent):
                if name in deciding:
                    raise ValueError(
                        f"commands: {name} is decided by {deciding[name]} and {agent}; valid is one"
                    )
                deciding[name] = agent
        if self.observations == "sustaindc" and not set(self.agents) <= set(AGENTS):
            raise ValueError(
                f"observations sustaindc: are those of {', '.join(AGENTS)}; valid for others is "
                "default"
            )
        if self.start == "sampled" and not self.start_days():
            raise ValueError(
                f"days {self.days}: no episode of that length lies in the months "
                f"{list(self.months)}; valid is fewer days or more months"
            )
        return self

    def _without_effect(self) -> list[tuple[tuple[str, ...], bool, str]]:
        """List conditions of options without effect: names, True if it applies, and the reason."""
        continuous = self.actions == "continuous"
        cooling = ", ".join(a for a in self.agents if a in ("agent_dc", *HALL_AGENTS))
        decided = [name for agent in self.agents for name in self.commands_of(agent)]
        shared = isinstance(self.rewards, Mapping) or (
            isinstance(self.rewards, str) and self.rewards in REWARD_SETS
        )
        return [
            (
                ("features", "ci_leads_h", "weather_leads_h", "forecast_error"),
                self.observations == "sustaindc",
                "on observations sustaindc; valid with observations default",
            ),
            (("months",), self.start == "fixed", "with start fixed; valid with start sampled"),
            (
                ("others",),
                set(self.agents) >= set(AGENTS) and not self._others_beyond(),
                "as all agents learn; valid with fewer",
            ),
            (("action_order",), continuous, "with actions continuous; valid with discrete"),
            (
                ("action_order",),
                "agent_bat" not in self.agents,
                "as agent_bat does not learn; valid where it does",
            ),
            (
                ("setpoint_change_k", "fan_change", "clip_actions"),
                not continuous,
                "with actions discrete; valid with continuous",
            ),
            (
                ("setpoint_change_k", "fan_change"),
                not cooling,
                "as agent_dc does not learn; valid where it does",
            ),
            (
                ("setpoint_change_k",),
                "cooling" not in decided,
                f"without the command cooling of {cooling}; valid with it",
            ),
            (
                ("fan_change",),
                "fan" not in decided,
                f"without the command fan of {cooling}; valid with it",
            ),
            (
                ("neighbours",),
                "crac" not in self.agents,
                "as crac does not learn; valid where it does",
            ),
            (
                ("collaboration",),
                not shared,
                "on a function's rewards; valid with rewards by name or a dict",
            ),
        ]

    def _others_beyond(self) -> bool:
        """True if ``others`` moves work between sites, or controls liquid-cooled racks."""
        if isinstance(self.others, str):
            return any(
                part.strip().startswith(("geo", "liquid")) for part in self.others.split(",")
            )
        return not {"transfer", *LIQUID_COMMANDS}.isdisjoint(commands_of(self.others))

    def commands_of(self, agent: str) -> tuple[str, ...]:
        """Return the commands that an agent decides if it learns, in the order of its action."""
        return (self.commands or {}).get(agent, AGENT_DEFINITIONS[agent].default_commands)

    def start_days(self) -> list[int]:
        """Return the days of the year, from 0, on which a sampled episode may start.

        If ``months`` contains all months, episodes may continue past 31 December; the inputs then
        repeat from 1 January.
        """
        if len(self.months) == 12:
            return list(range(DAYS_PER_YEAR))
        inside = [month in self.months for month in MONTH_OF_DAY]
        last = DAYS_PER_YEAR - self.days
        return [d for d in range(last + 1) if all(inside[d : d + self.days])]


def fields_set(options: EnvOptions) -> dict[str, Any]:
    """Return the options that were set explicitly, by name.

    Options at their defaults are left out, because setting an option without effect is an error.
    """
    return {name: getattr(options, name) for name in options.model_fields_set}


def make_options(**values: Any) -> EnvOptions:
    """Create environment options from keywords.

    Raises:
        ConfigError: an option is unknown, or a value is not valid.
    """
    return validated(EnvOptions, values, "environment")


OneConfig: TypeAlias = DataCenterConfig | Mapping[str, Any]
"""A config, or a dict of its sections as plain values."""
DrawFunction: TypeAlias = Callable[[np.random.Generator], OneConfig]
"""Function that draws a config with a random generator. If agents of CRAC units learn, it has an
attribute ``most_units``, the largest number of units of its halls."""
ConfigSource: TypeAlias = str | os.PathLike[str] | OneConfig | Sequence[OneConfig] | DrawFunction
"""Name of a preset, a file, a config or a dict of its sections; for batches also a sequence of
configs or dicts; or a function that draws a config for each environment and episode."""
Overrides: TypeAlias = Mapping[str, Any] | Sequence[str]
"""Values that replace those of the config: a dict of section.key to value, or a list of
``section.key=value``."""


class ConfigDraw:
    """Draws the config of each environment and episode.

    Attributes:
        most_units: largest number of CRAC units of a config; None if ``draw`` does not say.
    """

    def __init__(self, draw: DrawFunction, overrides: Overrides) -> None:
        self._draw, self._overrides = draw, overrides
        self.most_units: int | None = getattr(draw, "most_units", None)

    def configs(self, keys: I64) -> list[DataCenterConfig]:
        """Return the configs that belong to random keys, (E,).

        Raises:
            ConfigError: the function returned no config, or one that is not valid.
        """
        drawn = [self._draw(np.random.Generator(np.random.PCG64(int(key)))) for key in keys]
        return [_with_overrides(_checked_config(one), self._overrides) for one in drawn]


def configs_and_options(
    config: ConfigSource,
    overrides: Overrides,
    options: EnvOptions | None,
    keywords: Mapping[str, Any],
    only_agent: str | None = None,
) -> tuple[list[DataCenterConfig] | ConfigDraw, EnvOptions]:
    """Return configs and options from the arguments of an environment's constructor.

    Args:
        config: a preset, a file, a config, several configs, or a function that draws configs.
        overrides: values that replace those of every config.
        options: options of the environment; None means the default options.
        keywords: fields of ``EnvOptions``, which take precedence over ``options``.
        only_agent: the learning agent of an environment with a single agent; None otherwise.

    Raises:
        ConfigError: a config, override or option is not valid.
    """
    changes = _checked_overrides(overrides)
    configs = ConfigDraw(config, changes) if callable(config) else _configs(config, changes)
    return configs, _options(options, keywords, only_agent)


def _configs(source: Any, overrides: Overrides) -> list[DataCenterConfig]:
    if isinstance(source, str | os.PathLike):
        if isinstance(overrides, Mapping):
            return [_with_overrides(load_config(source), overrides)]
        # Overrides are applied before validation: some files are valid only with their overrides.
        return [load_config(source, list(overrides))]
    listed: list[Any] = list(source) if isinstance(source, Sequence) else [source]
    if not listed:
        raise ConfigError("config: an empty list; valid is at least one data center")
    return [_with_overrides(_checked_config(one), overrides) for one in listed]


def _checked_config(config: Any) -> DataCenterConfig:
    if isinstance(config, Mapping):
        return config_from_dict(dict(config))
    if not isinstance(config, DataCenterConfig):
        raise ConfigError(
            f"config {config!r}: valid is a preset, a file, DataCenterConfigs, or dicts of their "
            "sections"
        )
    return config


def _with_overrides(config: DataCenterConfig, overrides: Overrides) -> DataCenterConfig:
    if not overrides:
        return config
    if isinstance(overrides, Mapping):
        return with_values(config, overrides)
    return apply_overrides(config, list(overrides))


def _checked_overrides(value: Any) -> Overrides:
    listed = isinstance(value, Mapping | Sequence) and not isinstance(value, str | bytes)
    if not listed or not all(isinstance(one, str) for one in value):
        raise ConfigError(
            f"overrides {value!r}: valid is a list of section.key=value, or a dict of section.key "
            "to value"
        )
    checked: Overrides = value
    return checked


def _options(options: Any, keywords: Mapping[str, Any], only_agent: str | None) -> EnvOptions:
    if options is not None and not isinstance(options, EnvOptions):
        raise ConfigError(f"options {options!r}: valid is EnvOptions, or its fields by keyword")
    values = (fields_set(options) if options else {}) | dict(keywords)
    if only_agent is not None:
        agents = values.setdefault("agents", (only_agent,))
        if agents not in ((only_agent,), [only_agent]):
            raise ConfigError(
                f"agents {agents!r}: the one agent here is {only_agent}; valid with "
                "sdc_taichi/Joint-v0"
            )
    return make_options(**values)
