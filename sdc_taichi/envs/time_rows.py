"""Precomputed rows of the observation entries that depend on time and site alone.

Clock, weather, carbon intensity, prices and arriving work depend on the step of the year and the
site, and not on what happens in the data center. Their entries are therefore computed for many
steps at once, with one row per step and distinct site. An observation copies its row. The number of
precomputed rows depends on the case:

- By default the rows of all steps of the year are computed, if they fit into memory.
- If they do not fit, or if episodes draw their inputs at random, the rows of a block of coming
  steps are computed.
- If forecasts have errors, the rows of a single step are computed, one for each data center.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence

import numpy as np

from sdc_taichi.control.view import CI_WALK, PERFECT, TEMPERATURE_WALK, View
from sdc_taichi.envs.features import (
    LONGEST_LEAD_H,
    Feature,
    TimeInputs,
    feature_slices,
    scale,
)
from sdc_taichi.errors import ConfigError
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR
from sdc_taichi.sim.drivers import Drivers, FleetSeries
from sdc_taichi.types import F32, I64

MAX_ROW_BYTES = 2**28
"""Maximum memory of an observer's rows for a whole year, in bytes. Larger tables are computed block
by block."""
STRETCH_BYTES = 2**23
"""Memory of the rows of one block of steps, in bytes, small enough for the processor's cache."""
_ENDLESS = 2**62
"""Number of steps, larger than any episode, that marks rows without an end or a repetition."""
_ALL = slice(None)


class TimeRows:
    """Computes rows of scaled entries that depend on time alone, for the data centers of a fleet.

    Args:
        features: features that depend on time alone, from ``time_features``.
        forecasts: carbon intensity, weather and prices at the leads of ``features``.
        columns: for each agent's observation, the column of a row to which each entry belongs.
        steps_per_hour: number of steps in an hour.
        new_inputs: True if inputs may differ from episode to episode. Rows of the whole year are
            then not computed, because only one episode would use them.
    """

    def __init__(
        self,
        features: Sequence[Feature],
        forecasts: Forecasts,
        columns: Mapping[str, I64],
        *,
        steps_per_hour: int,
        new_inputs: bool,
    ) -> None:
        self._features = list(zip(features, feature_slices(features).values(), strict=True))
        self._width = sum(f.size for f in features)
        self._forecasts, self._columns = forecasts, columns
        self._row_bytes = 4 * (self._width + sum(len(x) for x in columns.values()))
        self._values: F32 = np.zeros((0, self._width), dtype=np.float32)
        self._time_of_day = _sine_and_cosine(24 * steps_per_hour)
        self._time_of_year = _sine_and_cosine(HOURS_PER_YEAR * steps_per_hour)
        self._new_inputs = new_inputs
        self._arranged: dict[str, F32] = {}
        # Range of the steps since reset that the rows cover, then the index of each data center's
        # first row and the number of rows after which its rows repeat, (B,) each.
        self._steps = range(0)
        self._first_rows = self._lengths = np.zeros(0, dtype=np.int64)

    def reset(self, view: View) -> None:
        """Start an episode."""
        drivers = view.drivers
        has_year = self._steps.stop == _ENDLESS
        new_series = self._forecasts.reset(view)
        self._start = drivers.start
        if has_year and not new_series and self._forecasts.are_perfect:
            return
        self._steps = range(0)
        if not self._forecasts.are_perfect:
            self._site_dcs = self._site_of = np.arange(view.size)
            return
        if new_series and not self._new_inputs and self._fill_year(drivers):
            return
        keys = [(s.offsets, s.lengths) for s in self._forecasts.series]
        self._site_dcs, self._site_of = _distinct(drivers.start, *(x for key in keys for x in key))

    def rows(self, view: View) -> tuple[F32, dict[str, F32], I64]:
        """Return the rows that contain the entries of a view.

        Args:
            view: the controller's view before a step.

        Returns:
            Rows in the order of the features, (rows, width); the same rows in the order of each
            agent's observation, (rows, n) each; and the index of each data center's row, (B,).
        """
        step = view.state.step
        if step not in self._steps:
            self._fill_stretch(step)
        row_numbers = self._first_rows + (self._start + step) % self._lengths
        return self._values, self._arranged, row_numbers

    def _fill_year(self, drivers: Drivers) -> bool:
        """Compute the rows of all steps of the year; return False if that is not possible.

        It is not possible if series do not cover whole years, or if the rows need too much memory.
        """
        series = self._forecasts.series
        length = series[0].lengths
        alike = all(np.array_equal(one.lengths, length) for one in series)
        if not alike or np.any(length % len(self._time_of_year)):
            return False
        dcs, site_of = _distinct(length, *(one.offsets for one in series))
        lengths = length[dcs]
        if int(lengths.sum()) * self._row_bytes > MAX_ROW_BYTES:
            return False
        parts = [
            self._entries(np.arange(n), np.full(n, i)) for i, n in zip(dcs, lengths, strict=True)
        ]
        first_rows = np.cumsum(lengths) - lengths
        self._keep(np.concatenate(parts), first_rows[site_of], length, range(_ENDLESS))
        return True

    def _fill_stretch(self, step: int) -> None:
        """Compute the rows of a block of steps, the first of which is ``step`` since reset."""
        dcs = self._site_dcs
        most = len(self._time_of_day) if self._forecasts.are_perfect else 1
        count = min(max(STRETCH_BYTES // (len(dcs) * self._row_bytes), 1), most)
        index = self._start[dcs][:, None] + np.arange(step, step + count)
        rows = self._entries(index.reshape(-1), np.repeat(dcs, count), step)
        first_rows = self._site_of * count - self._start - step
        endless = np.full(len(first_rows), _ENDLESS, dtype=np.int64)
        self._keep(rows, first_rows, endless, range(step, step + count))

    def _keep(self, rows: F32, first_rows: I64, lengths: I64, steps: range) -> None:
        self._values = rows
        self._arranged = {name: rows.take(c, axis=1) for name, c in self._columns.items()}
        self._first_rows, self._lengths, self._steps = first_rows, lengths, steps

    def _entries(self, index: I64, dc: I64, step: int = 0) -> F32:
        """Compute the scaled entries of n pairs of data center and step, (n, width).

        Args:
            index: step of each pair, from the start of the year, (n,).
            dc: index of the data center of each pair, (n,).
            step: number of steps since reset, on which forecast errors depend.
        """
        day, year = self._time_of_day, self._time_of_year
        ci, outdoor, wet_bulb, price, demand = self._forecasts.at(index, dc, step)
        inputs = TimeInputs(
            time_of_day=day.take(index % len(day), axis=0).T,
            time_of_year=year.take(index % len(year), axis=0).T,
            ci=ci,
            outdoor_c=outdoor,
            wet_bulb_c=wet_bulb,
            price=price,
            workload=demand,
        )
        out = np.empty((len(index), self._width), dtype=np.float32)
        for feature, columns in self._features:
            out[:, columns] = scale(feature.value(inputs), feature).T
        return out


class Forecasts:
    """Current values and forecasts of carbon intensity, weather and prices, and arriving work.

    Args:
        steps_per_hour: number of steps in an hour.
        ci_leads_h: leads of carbon intensity and price, in h; increasing multiples of the step.
        weather_leads_h: leads of dry and wet bulb, in h; increasing multiples of the step.

    Attributes:
        series: series of the episode: carbon intensity, dry bulb, wet bulb, price, arriving work.
        are_perfect: True if forecasts have no errors.

    Raises:
        ConfigError: a lead is not valid.
    """

    def __init__(
        self,
        steps_per_hour: int,
        ci_leads_h: Sequence[float],
        weather_leads_h: Sequence[float],
    ) -> None:
        ci_leads = lead_steps("ci_leads_h", ci_leads_h, steps_per_hour)
        weather_leads = lead_steps("weather_leads_h", weather_leads_h, steps_per_hour)
        self._ci_leads, self._weather_leads = (np.append(0, x) for x in (ci_leads, weather_leads))
        self.series: tuple[FleetSeries, ...] = ()
        self.are_perfect = True

    def reset(self, view: View) -> bool:
        """Start an episode with the inputs and the forecast errors of a view.

        Returns:
            True if the series differ from those of the previous episode.
        """
        drivers, self._error, self._walks = view.drivers, view.forecast_error, view.walks
        self.are_perfect = self._error == PERFECT
        physical = (drivers.ci_g_per_kwh, drivers.outdoor_c, drivers.wet_bulb_c, drivers.demand)
        if self.series and all(map(operator.is_, physical, (*self.series[:3], self.series[4]))):
            return False
        price = drivers.price_per_kwh
        assert price is not None, "a simulator has filled it in"
        self.series = (*physical[:3], price, drivers.demand)
        now = self._ci_leads[:1]
        leads = (self._ci_leads, self._weather_leads, self._weather_leads, self._ci_leads, now)
        tables = (*physical[:3], _relative_to_mean(price), drivers.demand)
        self._extended = [ExtendedSeries(s, x) for s, x in zip(tables, leads, strict=True)]
        return True

    def at(self, index: I64, dc: I64, step: int = 0) -> list[F32]:
        """Return current values, which have no error, and forecasts of n pairs of step and site.

        Args:
            index: step of each pair, from the start of the year, (n,).
            dc: index of the data center of each pair, (n,). If forecasts have errors, ``dc`` must
                contain all data centers in order.
            step: number of steps since reset.

        Returns:
            Carbon intensity in g/kWh, (1 + CI leads, n), dry bulb and wet bulb in C, (1 + weather
            leads, n), price relative to its mean, (1 + CI leads, n), arriving work, (1, n).

        Raises:
            RuntimeStateError: forecasts have errors, and ``step`` is earlier than in a previous
                call.
        """
        values = [series.at(index, dc) for series in self._extended]
        if self._walks is None or self.are_perfect:
            return values
        ci, outdoor, wet_bulb = values[:3]
        if self._error.ci_share > 0:
            walked = self._walks.increments(CI_WALK, step, self._ci_leads).astype(np.float32)
            ci *= 1.0 + float(self._error.ci_share) * walked
            np.maximum(ci, 0.0, out=ci)
        if self._error.temperature_k > 0:
            leads = self._weather_leads
            walked = self._walks.increments(TEMPERATURE_WALK, step, leads).astype(np.float32)
            error_k = float(self._error.temperature_k) * walked
            outdoor += error_k
            wet_bulb += error_k
        return values


class ExtendedSeries:
    """Series of each data center in f32, extended past its end by the longest lead.

    The extension repeats the first values, so that a look-up at a lead needs no modulo.

    Args:
        table: the series of each data center.
        leads: 0 for the current value, then k leads in steps, (1 + k,).
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

    def at(self, index: I64, dc: I64 | slice = _ALL) -> F32:
        """Return values of data centers ``dc`` at steps ``index`` plus each lead, (1 + k, n)."""
        first = self._first_entries[dc] + index % self._lengths[dc]
        return np.asarray(self._values.take(first + self._leads))


def lead_steps(name: str, leads_h: Sequence[float], steps_per_hour: int) -> I64:
    """Convert leads from hours to steps, (n,).

    Args:
        name: name of the option, for error messages.
        leads_h: leads in h.
        steps_per_hour: number of steps in an hour.

    Raises:
        ConfigError: leads do not increase, or are not multiples of the step.
    """
    last = 0
    steps = []
    for hours in leads_h:
        wanted = hours * steps_per_hour
        if abs(wanted - round(wanted)) >= 1e-6:
            raise ConfigError(
                f"{name}: {hours:g} h; valid is a positive multiple of the step, "
                f"{60 // steps_per_hour} min, up to {LONGEST_LEAD_H:g} h"
            )
        if round(wanted) <= last:
            raise ConfigError(f"{name}: {hours:g} h after {last / steps_per_hour:g} h; leads rise")
        last = round(wanted)
        steps.append(last)
    return np.array(steps, dtype=np.int64)


def _distinct(*columns: I64) -> tuple[I64, I64]:
    """Find data centers with equal values in all columns, (B,) each.

    Returns:
        Index of the first data center of each distinct combination of values, and for each data
        center the index of its combination, (B,).
    """
    _, first, which = np.unique(
        np.stack(columns, axis=1), axis=0, return_index=True, return_inverse=True
    )
    return first, which.reshape(-1)


def _relative_to_mean(series: FleetSeries) -> FleetSeries:
    """Divide each series by its mean; series of zeros stay unchanged."""
    values = series.values.copy()
    for first, length in {*zip(series.offsets.tolist(), series.lengths.tolist(), strict=True)}:
        one = values[first : first + length]
        mean = one.mean()
        one /= mean if mean > 0 else 1.0
    return FleetSeries(values, series.offsets, series.lengths)


def _sine_and_cosine(period: int) -> F32:
    """Return sine and cosine of the phase of each step in a period, (period, 2)."""
    angle = 2.0 * np.pi * np.arange(period) / period
    return np.stack([np.sin(angle), np.cos(angle)], axis=1).astype(np.float32)
