"""The power path: grid connection, UPS and distribution to the racks.

Losses of a device follow its load by three shares of its rated power (N. Rasmussen, "Electrical
Efficiency Modeling for Data Centers", Schneider Electric white paper 113, 2012):

    P_loss = P_rated (a + b x + c x^2),  x = P_load/P_rated

a is lost without any load, b in semiconductors, c in conductors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64, Values

NO_LIMIT_KW = 1e9
"""Limit in kW that stands for no limit: no step draws as much."""
ROUND_OFF_SHARE = 1e-9
"""Share of the limit by which rounding may exceed it."""


class LossyDevice(NamedTuple):
    """A device of the power path of B data centers: the UPS, or the distribution behind it."""

    rated_w: Values
    """Power that the device is made for, in W, above 0, (B,)."""
    no_load_share: Values
    """Loss without load, divided by the rated power, (B,)."""
    proportional_share: Values
    """Loss in proportion to the load, divided by the load, (B,)."""
    square_share: Values
    """Loss by the square of the load, divided by the rated power, at full load, (B,)."""

    def loss_w(self, load_w: Values) -> Values:
        """Loss while the device delivers a load, in W, (B,).

        Args:
            load_w: Power that it delivers, W, (B,).
        """
        load_share = load_w / self.rated_w
        load_loss_share = self.proportional_share + self.square_share * load_share
        return self.no_load_share * self.rated_w + load_loss_share * load_w


class PowerPath(NamedTuple):
    """Power path of B data centers, from the grid's bus to the racks."""

    ups: LossyDevice
    """Uninterruptible power supply."""
    distribution: LossyDevice
    """Transformers, PDUs and wiring between the UPS and the racks."""

    def losses_w(self, it_w: Values) -> tuple[Values, Values]:
        """Losses of UPS and distribution; the UPS delivers those of the distribution as well.

        Cooling gets its power beside the UPS.

        Args:
            it_w: IT power, W, (B,).

        Returns:
            Loss of the UPS and loss of the distribution, W, (B,) each.
        """
        distribution_w = self.distribution.loss_w(it_w)
        return self.ups.loss_w(it_w + distribution_w), distribution_w


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
