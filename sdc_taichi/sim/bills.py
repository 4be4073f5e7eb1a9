"""Electricity bills: prices over time, and the highest power of each month."""

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
    """Inputs of a fleet with its prices of electricity; given prices stay.

    Args:
        drivers: inputs of B data centers.
        configs: their configs, B.
    """
    if drivers.price_per_kwh is not None:
        return drivers
    per_hour = configs[0].simulation.steps_per_hour
    of_tariff: dict[TariffConfig, F64] = {}
    known: dict[int, F64] = {}
    for tariff in (config.tariff for config in configs):
        # Copies share the section itself, which is faster to find than an equal one.
        if id(tariff) not in known:
            if tariff not in of_tariff:
                of_tariff[tariff] = np.repeat(tariff.hourly_prices(), per_hour)
            known[id(tariff)] = of_tariff[tariff]
    prices = [known[id(config.tariff)] for config in configs]
    beside = _beside(drivers.outdoor_c, prices)
    return replace(drivers, price_per_kwh=fleet_series(prices) if beside is None else beside)


def _beside(series: FleetSeries, prices: Sequence[F64]) -> FleetSeries | None:
    """Prices stored at the same places as another series, so that both are read at once.

    Args:
        series: a series of each data center.
        prices: prices of each data center over a year, (steps of a year,) each, equal ones as the
            very same array.

    Returns:
        None where series are not as long as a year, or data centers share one but not the tariff.
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
    """Highest power of B data centers in the months of a run, as bills count it.

    A month that a run covers in part counts by the part that it covers.
    """

    start: I64
    """First step of the run, counted from the beginning of the year, (B,)."""
    steps_per_day: int
    """Number of steps in a day."""
    peak_kw: F64
    """Highest power of the run, mean over a step, in kW, (B,)."""
    billed_kw_months: F64
    """Highest power of each month that has ended times the part of it in the run, summed over the
    months, in kW, (B,)."""
    month_peak_kw: F64
    """Highest power of the month under way, in kW, (B,)."""
    month_begin: I64
    """First step of the month under way, counted from the beginning of the run, 0 or less, (B,)."""
    month_end: I64
    """First step of the next month, counted from the beginning of the run, (B,)."""
    next_end: int
    """Step in which a month of any data center ends next, counted from the beginning."""


def no_demand(start: I64, steps_per_hour: int) -> BilledDemand:
    """Demand of no steps.

    Args:
        start: first step of each data center, counted from the beginning of the year, (B,).
        steps_per_hour: number of steps in an hour.
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
    """Add the power of a step, in place.

    Args:
        demand: of the steps before.
        step: the step, counted from the beginning of the run.
        power_kw: mean power over the step, in kW, (B,).
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
    """Highest power of each month times the part of it in the run, over all months, kW, (B,).

    Args:
        demand: of the steps of a run.
        steps: number of these steps.
    """
    covered = steps - np.maximum(demand.month_begin, 0)
    share = covered / (demand.month_end - demand.month_begin)
    return np.asarray(demand.billed_kw_months + demand.month_peak_kw * share)


def month_around(step: I64, steps_per_day: int) -> tuple[I64, I64]:
    """First step of the month with a step of the year, and of the month after it, (B,) each."""
    firsts = np.array(FIRST_DAY_OF_MONTH)
    years, day = np.divmod(step // steps_per_day, DAYS_PER_YEAR)
    month = np.searchsorted(firsts, day, side="right") - 1
    first_day = years * DAYS_PER_YEAR
    begin, end = first_day + firsts[month], first_day + firsts[month + 1]
    return begin * steps_per_day, end * steps_per_day
