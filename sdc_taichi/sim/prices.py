"""Prices of electricity of a fleet over time, from the tariffs of its configs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.tariff_schema import TariffConfig
from sdc_taichi.sim.drivers import Drivers, FleetSeries, fleet_series
from sdc_taichi.types import F64


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
    found = _beside(drivers.outdoor_c, prices)
    return replace(drivers, price_per_kwh=fleet_series(prices) if found is None else found)


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
