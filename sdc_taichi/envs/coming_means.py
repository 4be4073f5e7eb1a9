"""Means of series over the coming hours, computed once for all steps."""

from __future__ import annotations

import numpy as np

from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.types import F64


def coming_means(series: FleetSeries, steps: int) -> FleetSeries:
    """Mean of each series over the steps from a step on, for every step.

    Args:
        series: a series of each data center, each repeated after its last value.
        steps: number of steps, the present one included.

    Returns:
        Series of the means, as long as those given.
    """
    distinct, which = series.distinct()
    lengths = np.array([len(values) for values in distinct])
    first_places = np.cumsum(lengths) - lengths
    return FleetSeries(
        values=np.concatenate([_coming_means(values, steps) for values in distinct]),
        offsets=first_places[which],
        lengths=series.lengths,
    )


def _coming_means(values: F64, steps: int) -> F64:
    """Mean over ``steps`` values from each on, as differences of running sums, (T,)."""
    sums: F64 = np.cumsum(np.resize(values, len(values) + steps))
    means: F64 = (sums[steps - 1 : -1] - np.append(0.0, sums[: len(values) - 1])) / steps
    return means
