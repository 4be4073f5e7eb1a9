"""Supply of the racks by the CRAC units: airflow of each unit, and its share in each rack's supply.

All units supply a common plenum. The share of a unit in a rack's supply depends on their distance;
where a unit gives less than its share, as when it is down, air of the other units replaces it.
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.config.hvac_schema import CracConfig
from sdc_taichi.types import F64

_MOST_PASSES, _LEAST_PASSES = 200, 20
_MOST_PRODUCTS = 2e8
"""Most products of share and weight in all passes, but for the least number of passes: about a
second."""
_WITHIN = 1e-13
"""Relative difference at which the airflow of units and that taken from them count as equal."""
_LEAST_WEIGHT = 1e-12
"""Smallest weight of a unit, so that the only unit of a rack goes on supplying it."""


def full_airflow_m3s(crac: CracConfig, need_m3s: F64, design_m3s: float) -> F64:
    """Airflow of each CRAC unit at full speed, in m3/s, (U,).

    As configured; else the design airflow, divided by what the racks need of each unit and raised
    so that the units give it with the ``spare_units`` largest of them lost.

    Args:
        crac: The units.
        need_m3s: Supply air that the racks take in of each unit at the design point, m3/s, (U,).
        design_m3s: Airflow of all units at the design point, m3/s.
    """
    if crac.airflow_m3s is not None:
        return np.broadcast_to(np.asarray(crac.airflow_m3s, np.float64), (crac.units,)).copy()
    airflow_m3s = np.asarray(design_m3s * need_m3s / need_m3s.sum())
    if crac.spare_units:
        left_m3s = np.sort(airflow_m3s)[: crac.units - crac.spare_units].sum()
        airflow_m3s = airflow_m3s * (design_m3s / left_m3s)
    return airflow_m3s


def unit_weights(shares: F64, rack_need_m3s: F64, given_m3s: F64) -> F64:
    """Weights of units by which their shares fit what each of them gives, at most 1, (U,).

    The share of unit k in the supply of rack j becomes s_jk w_k / sum_l s_jl w_l, such that what
    the racks take of each unit, sum_j s'_jk need_j, is its part of what all give. The weights are
    found by scaling rows and columns in turn (Deming and Stephan 1940, *On a least squares
    adjustment of a sampled frequency table*, Ann. Math. Stat. 11(4)).

    Args:
        shares: Shares of the units by distance; rows sum to 1, (R, U).
        rack_need_m3s: Supply air that each rack takes in, m3/s, (R,).
        given_m3s: Airflow of each unit, m3/s; its sum does not matter, (U,).
    """
    wanted_m3s = given_m3s * (rack_need_m3s.sum() / given_m3s.sum())
    weight = np.ones(len(given_m3s))
    passes = int(np.clip(_MOST_PRODUCTS / shares.size, _LEAST_PASSES, _MOST_PASSES))
    for _ in range(passes):
        taken_m3s = weight * ((rack_need_m3s / (shares @ weight)) @ shares)
        ratio = wanted_m3s / np.maximum(taken_m3s, 1e-30)
        if np.max(np.abs(ratio - 1.0)) < _WITHIN:
            break
        weight = np.maximum(weight * ratio, _LEAST_WEIGHT)
        weight /= weight.max()
    return weight


def weighted_shares(shares: F64, weight: F64) -> F64:
    """Shares of the units after weighting, (R, U); rows sum to 1. A rack with one unit keeps it.

    Args:
        shares: Shares of the units, (R, U).
        weight: Weights of the units, (U,).
    """
    if np.all(weight == 1.0):
        return shares
    weighted = shares * weight
    return np.asarray(weighted / weighted.sum(axis=1, keepdims=True))


def airflow_with_losses_m3s(
    full_m3s: F64, running: F64, *, coasting_ratio: float, design_m3s: float
) -> F64:
    """Airflow of each unit at the design point where some are down, in m3/s, (U,).

    The others replace the missing air, all at one speed and up to full speed.

    Args:
        full_m3s: Airflow of each unit at full speed, m3/s, (U,).
        running: 1 for units that run, 0 for those that are down, (U,); at least one runs.
        coasting_ratio: Airflow of a unit that is down divided by that at full speed.
        design_m3s: Airflow of all units at the design point, m3/s.
    """
    coasting_m3s = (1.0 - running) * coasting_ratio * full_m3s
    running_m3s = running * full_m3s
    speed = min(max((design_m3s - coasting_m3s.sum()) / running_m3s.sum(), 0.01), 1.0)
    return np.asarray(coasting_m3s + speed * running_m3s)
