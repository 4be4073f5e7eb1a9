"""Carbon intensity and weather, now and some hours ahead: known exactly, or with errors."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from sdc_taichi.control.view import (
    CI_WALK,
    PERFECT,
    TEMPERATURE_WALK,
    ForecastError,
    RandomWalks,
)
from sdc_taichi.errors import ConfigError, RuntimeStateError
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.types import F32, I64

CI_LEADS_H = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 20.0, 24.0)
"""Leads of the carbon-intensity forecast unless told otherwise, in h."""
WEATHER_LEADS_H = (3.0, 6.0, 12.0, 24.0)
"""Leads of the weather forecasts unless told otherwise, in h."""
LONGEST_LEAD_H = float(HOURS_PER_YEAR)
"""Longest valid lead, in h."""
LeadH = Annotated[float, Field(gt=0, le=LONGEST_LEAD_H, allow_inf_nan=False)]
"""Lead of a forecast, above 0 and at most a year of 8,760 h."""
_ALL = slice(None)


def lead_steps(name: str, leads_h: Sequence[float], steps_per_hour: int) -> I64:
    """Leads in steps, (n,).

    Args:
        name: name of the option, for errors.
        leads_h: leads in h.
        steps_per_hour: number of steps in an hour.

    Raises:
        ConfigError: leads that do not rise, or that are no positive multiples of the step.
    """
    if isinstance(leads_h, str) or any(
        isinstance(h, bool) or not isinstance(h, int | float | np.number) for h in leads_h
    ):
        raise ConfigError(f"{name} {leads_h!r}: valid is a list of hours")
    last = 0
    steps = []
    for hours in leads_h:
        wanted = float(hours) * steps_per_hour
        longest = LONGEST_LEAD_H * steps_per_hour
        if not (0.0 < wanted <= longest and abs(wanted - round(wanted)) < 1e-6):
            raise ConfigError(
                f"{name}: {hours:g} h; valid is a positive multiple of the step, "
                f"{60 // steps_per_hour} min, up to {LONGEST_LEAD_H:g} h"
            )
        if round(wanted) <= last:
            raise ConfigError(f"{name}: {hours:g} h after {last / steps_per_hour:g} h; leads rise")
        last = round(wanted)
        steps.append(last)
    return np.array(steps, dtype=np.int64)


class Forecasts:
    """Carbon intensity, dry bulb and wet bulb of a fleet at present and at each lead.

    Args:
        steps_per_hour: number of steps in an hour.
        ci_leads_h: leads of the carbon intensity in h, rising multiples of the step.
        weather_leads_h: leads of both temperatures in h, rising multiples of the step.
        error: how forecasts err.

    Attributes:
        ci_leads: 0 for the present, then the leads of the carbon intensity, in steps, (1 + k,).

    Raises:
        ConfigError: leads that are not valid.
    """

    def __init__(
        self,
        steps_per_hour: int,
        *,
        ci_leads_h: Sequence[float] = CI_LEADS_H,
        weather_leads_h: Sequence[float] = WEATHER_LEADS_H,
        error: ForecastError = PERFECT,
    ) -> None:
        now = np.zeros(1, dtype=np.int64)
        self.ci_leads = np.append(now, lead_steps("ci_leads_h", ci_leads_h, steps_per_hour))
        self._weather_leads = np.append(
            now, lead_steps("weather_leads_h", weather_leads_h, steps_per_hour)
        )
        self._error = error
        self._step_h = 1.0 / steps_per_hour
        self._tables: tuple[FleetSeries, ...] = ()
        self._walks: RandomWalks | None = None

    def reset(self, drivers: Drivers, walks: RandomWalks | Sequence[int] | I64 = ()) -> bool:
        """Start an episode.

        Args:
            drivers: inputs of the fleet.
            walks: walks of the errors, or a seed for each data center; unused without errors.

        Returns:
            Whether the series differ from those of the episode before.

        Raises:
            ConfigError: another number of keys than of data centers.
        """
        if not self.perfect and not isinstance(walks, RandomWalks):
            if len(walks) != drivers.size:
                raise ConfigError(
                    f"{len(walks)} random keys for {drivers.size} data centers; valid is one each"
                )
            walks = RandomWalks(walks, self._step_h)
        tables = (drivers.ci_g_per_kwh, drivers.outdoor_c, drivers.wet_bulb_c)
        new = not all(map(operator.is_, tables, self._tables)) or not self._tables
        if new:
            self._tables = tables
            self._ci = ExtendedSeries(tables[0], self.ci_leads)
            self._outdoor = ExtendedSeries(tables[1], self._weather_leads)
            self._wet_bulb = ExtendedSeries(tables[2], self._weather_leads)
        self._walks = walks if isinstance(walks, RandomWalks) and not self.perfect else None
        return new

    @property
    def perfect(self) -> bool:
        """Whether forecasts do not err."""
        return self._error == PERFECT

    def truth(self, index: I64, dc: I64 | slice = _ALL) -> tuple[F32, F32, F32]:
        """The true carbon intensity, dry bulb and wet bulb at present and at each lead.

        Args:
            index: steps since the start of the year, (n,).
            dc: data center of each index, (n,); one index for each by default.

        Returns:
            Carbon intensity in g/kWh, (1 + CI leads, n), dry bulb and wet bulb in C, (1 + weather
            leads, n) each.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        if not self._tables:
            raise RuntimeStateError("the forecasts have not been reset; call reset() first")
        return self._ci.at(index, dc), self._outdoor.at(index, dc), self._wet_bulb.at(index, dc)

    def forecast(self, index: I64, step: int) -> tuple[F32, F32, F32]:
        """Carbon intensity, dry bulb and wet bulb of all data centers as forecast at present.

        Args:
            index: steps since the start of the year, (B,).
            step: steps since reset.

        Returns:
            Carbon intensity in g/kWh, (1 + CI leads, B), dry bulb and wet bulb in C, (1 + weather
            leads, B) each; the present, which comes first, has no error.

        Raises:
            RuntimeStateError: before ``reset``, or, with errors, a step before one seen already.
        """
        ci, outdoor, wet_bulb = self.truth(index)
        if self._walks is None:
            return ci, outdoor, wet_bulb
        if self._error.ci_share > 0:
            walked = self._walks.increments(CI_WALK, step, self.ci_leads).astype(np.float32)
            ci *= 1.0 + float(self._error.ci_share) * walked
            np.maximum(ci, 0.0, out=ci)
        if self._error.temperature_k > 0:
            leads = self._weather_leads
            walked = self._walks.increments(TEMPERATURE_WALK, step, leads).astype(np.float32)
            error = float(self._error.temperature_k) * walked
            outdoor += error
            wet_bulb += error
        return ci, outdoor, wet_bulb


class ExtendedSeries:
    """A series of each data center in f32, repeated past its end by the longest lead.

    Args:
        table: the series.
        leads: 0 for the present, then the leads in steps, (1 + k,).
    """

    def __init__(self, table: FleetSeries, leads: I64) -> None:
        series, which = table.distinct()
        ahead = int(leads[-1])
        parts = [np.resize(one.astype(np.float32), len(one) + ahead) for one in series]
        first_entries = np.cumsum([0, *(len(part) for part in parts[:-1])])
        self._values = np.concatenate(parts)
        self._first_entries = first_entries[which]
        self._lengths = table.lengths
        self._leads = leads[:, None]

    def at(self, index: I64, dc: I64 | slice) -> F32:
        """Values of data centers ``dc`` at steps ``index`` and at each lead, (1 + k, n)."""
        first = self._first_entries[dc] + index % self._lengths[dc]
        return np.asarray(self._values.take(first + self._leads))
