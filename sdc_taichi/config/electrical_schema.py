"""Sections ``electrical`` and ``tariff``: grid connection, UPS, distribution and prices."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from sdc_taichi.config.fields import Section, Share
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, HOURS_PER_YEAR, MONTH_OF_DAY
from sdc_taichi.types import F64


class UpsConfig(Section):
    """Losses of the UPS.

    The default is a UPS with an efficiency of 97.0 % at full load, 96.3 % at half load and 94.1 %
    at a quarter (V. Avelar, "Making Large UPS Systems More Efficient", Schneider Electric white
    paper 108, 2010). Transformerless double-conversion units reach these values today.
    """

    no_load_share: Share = 0.01333
    """Loss without load, divided by the rated power, 0..1."""
    proportional_share: Share = 0.0064
    """Loss in proportion to the load, divided by the load, 0..1."""
    square_share: Share = 0.01081
    """Loss by the square of the load, divided by the rated power, at full load, 0..1."""


class DistributionConfig(Section):
    """Losses of transformers, PDUs and wiring between UPS and racks.

    The default is a dry-type transformer of 300 kVA with the efficiency that the USA have required
    since 2016 (99.02 % at 35 % load, where half of its loss is no-load loss; 10 CFR 431.196), plus
    a loss of 1 % in the wiring at full load (Rasmussen, Schneider Electric white paper 113, 2012).
    """

    no_load_share: Share = 0.0017
    """Loss without load, divided by the rated power, 0..1."""
    proportional_share: Share = 0.0
    """Loss in proportion to the load, divided by the load, 0..1."""
    square_share: Share = 0.024
    """Loss by the square of the load, divided by the rated power, at full load, 0..1."""


class ElectricalConfig(Section):
    """Grid connection, UPS and distribution of a data center."""

    losses: Literal["counted", "reported"] = "counted"
    """Treatment of the losses of UPS and distribution: ``counted`` in grid energy, PUE, carbon and
    cost, as ISO/IEC 30134-2 defines PUE, or only ``reported`` separately."""
    capacity_ratio: Annotated[float, Field(ge=1, le=10)] = 1.25
    """Rated power of UPS and distribution divided by their load at the design point, 1..10: 1.25 if
    four of five modules suffice (N+1), 2 if one of two paths suffices (2N)."""
    ups: UpsConfig = UpsConfig()
    """Losses of the UPS."""
    distribution: DistributionConfig = DistributionConfig()
    """Losses of transformers, PDUs and wiring."""
    grid_limit_kw: Annotated[float, Field(ge=0.1, le=1e8)] | None = None
    """Largest power of the grid connection, in kW, 0.1..1e8: from a single server to ten times the
    largest campus that has been announced; None uses ``grid_limit_ratio``."""
    grid_limit_ratio: Annotated[float, Field(ge=0.01, le=1000)] | None = None
    """Largest power of the grid connection divided by the facility's power at the design point,
    0.01..1,000. It applies if ``grid_limit_kw`` is None; if both are None, there is no limit."""


Price = Annotated[float, Field(ge=0, le=1e9)]
"""Price in any currency, 0..1e9; the upper bound also suits currencies with large amounts."""
DAYS_PER_WEEK = 7
"""Number of days of a week, which begins on Monday."""
WORKING_DAYS = 5
"""Number of working days of a week, from Monday to Friday."""


class TariffPeriod(Section):
    """Electricity price for selected hours, days of the week and months."""

    months: tuple[Annotated[int, Field(ge=1, le=12)], ...] = tuple(range(1, 13))
    """Months of the period, 1..12."""
    days: Literal["all", "weekdays", "weekends"] = "all"
    """Days of the week of the period; every year begins on a Monday, and there are no holidays."""
    from_h: Annotated[int, Field(ge=0, le=23)] = 0
    """Local hour at which the period begins, 0..23."""
    to_h: Annotated[int, Field(ge=1, le=24)] = 24
    """Local hour at which the period ends, 1..24. If it is not after ``from_h``, the period extends
    past midnight; ``days`` and ``months`` then apply to the hours after midnight by their own
    date."""
    price_per_kwh: Price
    """Price of a kWh in the period. It replaces the price of the tariff and of earlier periods."""

    @field_validator("months")
    @classmethod
    def _each_once(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if not value or len(set(value)) < len(value):
            raise ValueError(f"{list(value)}; valid is one or more months, each once")
        return value

    def hours(self) -> np.ndarray:
        """Return a mask of the hours of a year in which the period applies, (8760,)."""
        hour = np.arange(24)
        if self.to_h > self.from_h:
            of_day = (hour >= self.from_h) & (hour < self.to_h)
        else:
            of_day = (hour >= self.from_h) | (hour < self.to_h)
        working = np.arange(DAYS_PER_YEAR) % DAYS_PER_WEEK < WORKING_DAYS
        of_week = {"all": working | True, "weekdays": working, "weekends": ~working}[self.days]
        of_year = of_week & np.isin(MONTH_OF_DAY, self.months)
        return np.asarray(of_year[:, None] & of_day).reshape(-1)


class TariffConfig(Section):
    """Prices of electricity in one currency, by local standard time.

    The default prices of a kWh have a mean of 0.125. For comparison, commercial customers in the
    USA paid 0.127 $/kWh in 2024, all charges included (EIA, Electric Power Monthly, table 5.3). The
    default demand charge is added to the price of energy.
    """

    price_per_kwh: Price | tuple[Price, ...] = (
        *(0.08,) * 7, *(0.12,) * 9, *(0.20,) * 5, *(0.12,) * 3,
    )  # fmt: skip
    """Price of a kWh: one value for all hours, or 24 values, one for each local hour of the day,
    midnight first."""
    periods: tuple[TariffPeriod, ...] = ()
    """Prices for some months, days of the week and hours; where periods overlap, the later entry
    applies."""
    demand_charge_per_kw: Price = 12.0
    """Monthly price per kW of the highest power in the month; powers are means of a step."""

    @field_validator("price_per_kwh")
    @classmethod
    def _one_or_each_hour(cls, value: float | tuple[float, ...]) -> float | tuple[float, ...]:
        if isinstance(value, tuple) and len(value) not in (1, 24):
            raise ValueError(f"{len(value)} prices; valid is 1, or 24 from midnight on")
        return value

    def hourly_prices(self) -> F64:
        """Return the price of a kWh in each hour of the year, (8760,)."""
        prices = np.resize(np.array(self.price_per_kwh), HOURS_PER_YEAR)
        for period in self.periods:
            prices = np.where(period.hours(), period.price_per_kwh, prices)
        return prices
