"""Supply of the racks by the CRAC units: airflow of each unit, and its share in each rack's supply.

All U units supply a common plenum of R racks. The share of a unit in a rack's supply depends on
their distance. If a unit delivers less than its share, for example because it has failed, air of
the other units replaces it.
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.config.hvac_schema import CracConfig
from sdc_taichi.types import F64, I64

_MOST_PASSES, _LEAST_PASSES = 200, 20
_MOST_PRODUCTS = 2e8
"""Largest number of products of share and weight in all passes, about a second of computing time.
``_LEAST_PASSES`` takes precedence."""
_WITHIN = 1e-13
"""Relative difference up to which the airflow of a unit and the airflow taken from it are equal."""
_LEAST_WEIGHT = 1e-12
"""Smallest weight of a unit; a positive value keeps a rack supplied that has only one unit."""
_RACKS_AT_ONCE = 1024
"""Number of racks whose shares are compared at once, so that the shares stay in the cache."""


def full_airflow_m3s(crac: CracConfig, need_m3s: F64, design_m3s: float) -> F64:
    """Return the airflow of each CRAC unit at full speed, in m3/s, (U,).

    If it is not configured, the design airflow is distributed equally or in proportion to the need
    of the racks for the air of each unit. The result is then scaled up so that the units deliver
    the design airflow even without the ``spare_units`` largest units.

    Args:
        crac: Configuration of the units.
        need_m3s: Supply air that the racks take in from each unit at the design point, m3/s, (U,).
        design_m3s: Airflow of all units at the design point, m3/s.
    """
    if crac.airflow_m3s is not None:
        return np.broadcast_to(np.asarray(crac.airflow_m3s, np.float64), (crac.units,)).copy()
    size = need_m3s if crac.sized_by_need else np.ones(crac.units)
    airflow_m3s = np.asarray(design_m3s * size / size.sum())
    if crac.spare_units:
        left_m3s = np.sort(airflow_m3s)[: crac.units - crac.spare_units].sum()
        airflow_m3s = airflow_m3s * (design_m3s / left_m3s)
    return airflow_m3s


def unit_weights(shares: F64, rack_need_m3s: F64, given_m3s: F64) -> F64:
    """Return weights of the units that match their shares to their airflows, at most 1, (U,).

    With weights w, the share of unit k in the supply of rack j is
    s'_jk = s_jk w_k / sum_l s_jl w_l. The weights are such that the airflow that racks take from
    each unit, sum_j s'_jk need_j, is proportional to the airflow of the unit. The weights are
    found by scaling rows and columns in turn (Deming and Stephan 1940, *On a least squares
    adjustment of a sampled frequency table*, Ann. Math. Stat. 11(4)).

    Args:
        shares: Shares of the units by distance; rows sum to 1, (R, U).
        rack_need_m3s: Supply air that each rack takes in, m3/s, (R,).
        given_m3s: Airflow of each unit, m3/s, (U,); only the ratios of its values matter.
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
    """Return the shares of the units after weighting, (R, U); rows sum to 1.

    The share of a rack's only unit stays 1.

    Args:
        shares: Shares of the units, (R, U).
        weight: Weights of the units, (U,).
    """
    if np.all(weight == 1.0):
        return shares
    weighted = shares * weight
    return np.asarray(weighted / weighted.sum(axis=1, keepdims=True))


def largest_shares(shares: F64, strength: F64) -> tuple[I64, F64]:
    """Return the unit that gives each rack most of its supply air, and its share, (R,) each.

    The share of unit k in the supply of rack j is s_jk a_k / sum_l s_jl a_l; it is 0 for racks
    that no unit supplies.

    Args:
        shares: Shares s of the units, (R, U).
        strength: Factor a of each unit, from 0, (U,).
    """
    racks = len(shares)
    unit, share = np.zeros(racks, dtype=np.int64), np.zeros(racks)
    for first in range(0, racks, _RACKS_AT_ONCE):
        block = slice(first, first + _RACKS_AT_ONCE)
        part = shares[block] * strength
        unit[block] = part.argmax(axis=1)
        total = part.sum(axis=1)
        largest = np.take_along_axis(part, unit[block, None], axis=1)[:, 0]
        share[block] = largest / np.where(total > 0.0, total, 1.0)
    return unit, share


def airflow_with_losses_m3s(
    full_m3s: F64, running: F64, *, coasting_ratio: float, design_m3s: float
) -> F64:
    """Return the airflow of each unit at the design point if some units have failed, in m3/s, (U,).

    The running units replace the missing air; all have the same speed, at most full speed.

    Args:
        full_m3s: Airflow of each unit at full speed, m3/s, (U,).
        running: 1 for running units, 0 for failed units, (U,); at least one unit runs.
        coasting_ratio: Airflow of a failed unit divided by its airflow at full speed.
        design_m3s: Airflow of all units at the design point, m3/s.
    """
    coasting_m3s = (1.0 - running) * coasting_ratio * full_m3s
    running_m3s = running * full_m3s
    speed = min(max((design_m3s - coasting_m3s.sum()) / running_m3s.sum(), 0.01), 1.0)
    return np.asarray(coasting_m3s + speed * running_m3s)
