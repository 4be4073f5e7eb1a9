"""What an environment lets agents do, see and be rewarded for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from sdc_taichi.config import explain
from sdc_taichi.envs.features import AGENTS
from sdc_taichi.envs.forecasts import CI_LEADS_H, PERFECT, WEATHER_LEADS_H, ForecastError
from sdc_taichi.errors import ConfigError
from sdc_taichi.year_clock import DAYS_PER_YEAR, MONTH_OF_DAY

Agent = Literal["agent_ls", "agent_dc", "agent_bat"]


def _plain(value: Any) -> Any:
    return int(value) if isinstance(value, np.integer) else value


Whole = Annotated[int, Field(strict=True), BeforeValidator(_plain)]
Month = Annotated[Whole, Field(ge=1, le=12)]
Price = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Tariff(BaseModel):
    """Price of electricity, for the reward terms ``cost`` and ``demand_charge``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    price_per_kwh: tuple[Price, ...] = (
        *(0.08,) * 7, *(0.12,) * 9, *(0.20,) * 5, *(0.12,) * 3,
    )  # fmt: skip
    """One price, or one for each local hour of the day from midnight on."""
    demand_charge_per_kw: Price = 12.0
    """Price of the highest mean power of a step, per bill of 30 days."""

    @field_validator("price_per_kwh")
    @classmethod
    def _hours(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in (1, 24):
            raise ValueError(f"{len(value)} prices; valid is 1, or 24 from midnight on")
        return value


class EnvOptions(BaseModel):
    """Options of every environment; see docs/environments.md."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    agents: tuple[Agent, ...] = AGENTS  # type: ignore[assignment]
    """Who learns; ``others`` plays the rest."""
    others: str = "idle"
    """Controller of what nobody learns, as on the command line: a name or ``agent=name`` parts."""
    actions: Literal["discrete", "continuous"] = "discrete"
    action_order: Literal["paper", "sustaindc"] | None = None
    """Order of the battery's discrete actions: charge, hold, discharge as in the paper, or charge,
    discharge, hold as in the released code; None is that of the preset."""
    setpoint_change_k: Annotated[float, Field(gt=0, le=20)] = 2.0
    """Largest change of a continuous setpoint action in one step."""
    days: Annotated[Whole, Field(ge=1, le=365)] = 7
    """Length of an episode."""
    start: Literal["sampled", "fixed"] = "sampled"
    """Episodes start at midnight of a day of ``months`` or on ``site.start``."""
    months: tuple[Month, ...] = tuple(range(1, 13))
    """Months that sampled episodes lie in from start to end."""
    observations: Literal["default", "sustaindc"] = "default"
    features: Mapping[str, tuple[str, ...]] | None = None
    """Names of the features of agents, in place of the default."""
    ci_leads_h: tuple[float, ...] = CI_LEADS_H
    weather_leads_h: tuple[float, ...] = WEATHER_LEADS_H
    forecast_error: ForecastError = PERFECT
    heat_map: bool = False
    """Adds an image of the hall to every observation, which becomes a dict."""
    rewards: Any = "default"
    """A named set, agent to term to scale, or a function or its import path ``module:name``."""
    collaboration: Annotated[float, Field(ge=0, le=1)] = 0.8
    """Share a of an agent's own reward in what it gets; the others' share the rest evenly (paper,
    section 4.5). 1 is no collaboration."""
    tariff: Tariff = Tariff()

    @field_validator("agents", "months")
    @classmethod
    def _some_once(cls, value: tuple[Any, ...]) -> tuple[Any, ...]:
        if not value or len(set(value)) < len(value):
            raise ValueError(f"{list(value)}; valid is one or more, each once")
        return value

    @field_validator("agents")
    @classmethod
    def _in_order(cls, value: tuple[Agent, ...]) -> tuple[Agent, ...]:
        return tuple(sorted(value, key=AGENTS.index))

    @model_validator(mode="after")
    def _fits(self) -> Self:
        for names, without_effect, why in self._idle_options():
            given = [name for name in names if name in self.model_fields_set]
            if given and without_effect:
                raise ValueError(f"{', '.join(given)}: without effect {why}")
        for agent in self.features or {}:
            if agent in AGENTS and agent not in self.agents:
                raise ValueError(
                    f"features: without effect for {agent}, which does not learn; valid for "
                    f"{', '.join(self.agents)}"
                )
        if self.start == "sampled" and not self.start_days():
            raise ValueError(
                f"days {self.days}: no episode of that length lies in the months "
                f"{list(self.months)}; valid is fewer days or more months"
            )
        return self

    def _idle_options(self) -> list[tuple[tuple[str, ...], bool, str]]:
        """Names of options, whether they change nothing here, and why."""
        continuous = self.actions == "continuous"
        named = isinstance(self.rewards, Mapping) or (
            isinstance(self.rewards, str) and self.rewards in ("default", "sustaindc")
        )
        return [
            (
                ("features", "ci_leads_h", "weather_leads_h", "forecast_error"),
                self.observations == "sustaindc",
                "on observations sustaindc; valid with observations default",
            ),
            (("months",), self.start == "fixed", "with start fixed; valid with start sampled"),
            (("others",), set(self.agents) == set(AGENTS), "as all agents learn; valid with fewer"),
            (("action_order",), continuous, "with actions continuous; valid with discrete"),
            (
                ("action_order",),
                "agent_bat" not in self.agents,
                "as agent_bat does not learn; valid where it does",
            ),
            (
                ("setpoint_change_k",),
                not continuous,
                "with actions discrete; valid with continuous",
            ),
            (
                ("setpoint_change_k",),
                "agent_dc" not in self.agents,
                "as agent_dc does not learn; valid where it does",
            ),
            (
                ("collaboration",),
                not named,
                "on a function's rewards; valid with rewards default, sustaindc or a dict",
            ),
        ]

    def start_days(self) -> list[int]:
        """Days of the year, from 0, on which a sampled episode may start.

        All year round, episodes may run past 31 December, where the inputs repeat.
        """
        if len(self.months) == 12:
            return list(range(DAYS_PER_YEAR))
        inside = [month in self.months for month in MONTH_OF_DAY]
        last = DAYS_PER_YEAR - self.days
        return [d for d in range(last + 1) if all(inside[d : d + self.days])]


def make_options(**given: Any) -> EnvOptions:
    """Options by keyword.

    Raises:
        ConfigError: an unknown option or a value that is not valid.
    """
    try:
        return EnvOptions.model_validate(given)
    except ValidationError as error:
        raise ConfigError(explain(error, "environment", EnvOptions)) from None
