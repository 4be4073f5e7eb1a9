"""Demand that electricity bills charge for: the highest power of each month."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, FIRST_DAY_OF_MONTH
from sdc_taichi.types import F64, I64


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
