"""The power path: grid connection, UPS and distribution to the racks.

Losses of a device follow its load by three shares of its rated power (N. Rasmussen, "Electrical
Efficiency Modeling for Data Centers", Schneider Electric white paper 113, 2012):

    P_loss = P_rated (a + b x + c x^2),  x = P_load/P_rated

a is lost without any load, b in semiconductors, c in conductors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.types import F64, Values

NO_LIMIT_KW = 1e9
"""Limit of a connection without one, in kW: no step draws as much."""
ROUND_OFF_SHARE = 1e-9
"""Share of the limit by which rounding may exceed it."""


@dataclass(frozen=True, slots=True)
class PowerPath:
    """UPS and distribution of B data centers, from the grid's bus to the racks."""

    ups_rated_w: F64
    """Rated power of the UPS, in W, (B,)."""
    ups_no_load_share: F64
    """Loss of the UPS without load over rated power, (B,)."""
    ups_proportional_share: F64
    """Loss of the UPS in proportion to its load, over the load, (B,)."""
    ups_square_share: F64
    """Loss of the UPS by the square of its load, over rated power at full load, (B,)."""
    distribution_rated_w: F64
    """Rated power of transformers, PDUs and wiring behind the UPS, in W, (B,)."""
    distribution_no_load_share: F64
    """Loss of the distribution without load over rated power, (B,)."""
    distribution_proportional_share: F64
    """Loss of the distribution in proportion to its load, over the load, (B,)."""
    distribution_square_share: F64
    """Loss of the distribution by the square of its load, over rated power at full load, (B,)."""


def loss_w(
    load_w: Values,
    rated_w: Values,
    *,
    no_load_share: Values,
    proportional_share: Values,
    square_share: Values,
) -> Values:
    """Loss of a device of the power path.

    Args:
        load_w: Power that it delivers, W, (B,).
        rated_w: Power that it is made for, W, (B,), above 0.
        no_load_share: Loss without load over rated power.
        proportional_share: Loss in proportion to the load, over the load.
        square_share: Loss by the square of the load, over rated power at full load.

    Returns:
        Loss, W, (B,).
    """
    load_share = load_w / rated_w
    return no_load_share * rated_w + (proportional_share + square_share * load_share) * load_w


def power_path_loss_w(it_w: Values, path: PowerPath) -> tuple[Values, Values]:
    """Losses on the way to the racks; the UPS carries those of the distribution behind it.

    Cooling is supplied beside the UPS.

    Args:
        it_w: IT power, W, (B,).
        path: UPS and distribution.

    Returns:
        Losses of the UPS and of the distribution, W, (B,) each.
    """
    distribution_w = loss_w(
        it_w,
        path.distribution_rated_w,
        no_load_share=path.distribution_no_load_share,
        proportional_share=path.distribution_proportional_share,
        square_share=path.distribution_square_share,
    )
    ups_w = loss_w(
        it_w + distribution_w,
        path.ups_rated_w,
        no_load_share=path.ups_no_load_share,
        proportional_share=path.ups_proportional_share,
        square_share=path.ups_square_share,
    )
    return ups_w, distribution_w


def overload_kwh(grid_kwh: Values, limit_kwh: Values) -> F64:
    """Energy that a step draws beyond what the grid connection carries.

    Args:
        grid_kwh: Energy bought in the step, kWh, (B,).
        limit_kwh: Most energy that the connection carries in the step, kWh, (B,).

    Returns:
        Energy beyond the limit, kWh, (B,), at least 0. It is drawn, and part of the energy bought.
    """
    over_kwh = grid_kwh - limit_kwh
    return np.where(over_kwh > ROUND_OFF_SHARE * limit_kwh, over_kwh, 0.0)
