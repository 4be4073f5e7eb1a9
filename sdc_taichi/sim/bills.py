"""Electricity bills: energy prices over time, and the peak power of each month."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.electrical_schema import TariffConfig
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, FIRST_DAY_OF_MONTH
from sdc_taichi.sim.drivers import Drivers, FleetSeries, fleet_series
from sdc_taichi.types import F64, I64


def with_prices(drivers: Drivers, configs: Sequence[DataCenterConfig]) -> Drivers:
    """Add the electricity prices of the tariffs to the inputs of a fleet.

    Inputs that already have prices are returned unchanged.
    """
    if drivers.price_per_kwh is not None:
        return drivers
    per_hour = configs[0].simulation.steps_per_hour
    of_tariff: dict[TariffConfig, F64] = {}
    by_id: dict[int, F64] = {}
    for tariff in (config.tariff for config in configs):
        # Copies of a data center share the tariff object; a look-up by id avoids hashing it.
        if id(tariff) not in by_id:
            if tariff not in of_tariff:
                of_tariff[tariff] = np.repeat(tariff.hourly_prices(), per_hour)
            by_id[id(tariff)] = of_tariff[tariff]
    prices = [by_id[id(config.tariff)] for config in configs]
    aligned = _aligned(drivers.outdoor_c, prices)
    return replace(drivers, price_per_kwh=fleet_series(prices) if aligned is None else aligned)


def _aligned(series: FleetSeries, prices: Sequence[F64]) -> FleetSeries | None:
    """Store prices at the same indices as another series, so that both share index arrays.

    Args:
        series: One series per data center.
        prices: Prices of each data center over a year, one array (steps of a year,) each; equal
            tariffs must be the same array object.

    Returns:
        The prices; None if the series are not a year long, or if data centers share a series but
        not a tariff.
    """
    values = np.empty_like(series.values)
    stored: dict[int, F64] = {}
    for offset, length, price in zip(
        series.offsets.tolist(), series.lengths.tolist(), prices, strict=True
    ):
        if length != len(price) or stored.setdefault(offset, price) is not price:
            return None
    for offset, price in stored.items():
        values[offset : offset + len(price)] = price
    return FleetSeries(values, series.offsets, series.lengths)


@dataclass(slots=True)
class BilledDemand:
    """Peak power of B data centers in each month of a run, as demand charges count it.

    A month that the run covers only in part is weighted by the covered share.
    """

    start: I64
    """First step of the run, counted from the beginning of the year, (B,)."""
    steps_per_day: int
    """Number of steps in a day."""
    peak_kw: F64
    """Largest step-mean power of the run so far, in kW, (B,)."""
    billed_kw_months: F64
    """Sum over the completed months of peak power times covered share of the month, in kW,
    (B,)."""
    month_peak_kw: F64
    """Peak power of the current month, in kW, (B,)."""
    month_begin: I64
    """First step of the current month, counted from the beginning of the run, (B,); negative if
    the month began before the run."""
    month_end: I64
    """First step of the next month, counted from the beginning of the run, (B,)."""
    next_end: int
    """Earliest ``month_end`` of all data centers."""


def no_demand(start: I64, steps_per_hour: int) -> BilledDemand:
    """Return the billed demand before the first step of a run.

    Args:
        start: First step of each data center, counted from the beginning of the year, (B,).
        steps_per_hour: Number of steps in an hour.
    """
    begin, end = month_around(start, 24 * steps_per_hour)
    return BilledDemand(
        start=start.copy(),
        steps_per_day=24 * steps_per_hour,
        peak_kw=np.zeros(len(start)),
        billed_kw_months=np.zeros(len(start)),
        month_peak_kw=np.zeros(len(start)),
        month_begin=begin - start,
        month_end=end - start,
        next_end=int((end - start).min()),
    )


def add_power(demand: BilledDemand, step: int, power_kw: F64) -> None:
    """Add the power of a step to the billed demand, in place.

    Args:
        demand: Billed demand of the previous steps, which is modified.
        step: Index of the step, counted from the beginning of the run.
        power_kw: Mean power during the step, in kW, (B,).
    """
    if step >= demand.next_end:
        ended = step >= demand.month_end
        demand.billed_kw_months[ended] = billed_kw_months(demand, step)[ended]
        demand.month_peak_kw[ended] = 0.0
        begin, end = month_around(demand.start + step, demand.steps_per_day)
        demand.month_begin, demand.month_end = begin - demand.start, end - demand.start
        demand.next_end = int(demand.month_end.min())
    np.maximum(demand.month_peak_kw, power_kw, out=demand.month_peak_kw)
    np.maximum(demand.peak_kw, power_kw, out=demand.peak_kw)


def billed_kw_months(demand: BilledDemand, steps: int) -> F64:
    """Return the sum over all months of peak power times covered share, in kW, (B,)."""
    covered = steps - np.maximum(demand.month_begin, 0)
    share = covered / (demand.month_end - demand.month_begin)
    return np.asarray(demand.billed_kw_months + demand.month_peak_kw * share)


def month_around(step: I64, steps_per_day: int) -> tuple[I64, I64]:
    """Return the first steps of the month that contains ``step`` and of the next month.

    All steps are counted from the beginning of the year and have shape (B,).
    """
    firsts = np.array(FIRST_DAY_OF_MONTH)
    years, day = np.divmod(step // steps_per_day, DAYS_PER_YEAR)
    month = np.searchsorted(firsts, day, side="right") - 1
    first_day = years * DAYS_PER_YEAR
    begin, end = first_day + firsts[month], first_day + firsts[month + 1]
    return begin * steps_per_day, end * steps_per_day
