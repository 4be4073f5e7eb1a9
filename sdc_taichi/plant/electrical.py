"""The power path: grid connection, UPS and distribution to the racks.

The losses of a device are quadratic in its load, with coefficients that are shares of its rated
power (N. Rasmussen, "Electrical Efficiency Modeling for Data Centers", Schneider Electric white
paper 113, 2012):

    P_loss = P_rated (a + b x + c x^2),  x = P_load/P_rated

Coefficient a stands for the loss without load, b for losses in semiconductors, and c for losses in
conductors. Arrays of shape (B,) have one value per data center.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64, Values

NO_LIMIT_KW = 1e9
"""Value of a power limit, in kW, that stands for no limit; no data center draws as much."""
ROUND_OFF_SHARE = 1e-9
"""Excess over a limit, divided by the limit, that counts as a rounding error."""


class LossyDevice(NamedTuple):
    """Device of the power path of B data centers: the UPS, or the distribution downstream of it."""

    rated_w: Values
    """Rated power, in W, above 0, (B,)."""
    no_load_share: Values
    """Loss without load, divided by the rated power, (B,)."""
    proportional_share: Values
    """Loss term proportional to the load, divided by the load, (B,)."""
    square_share: Values
    """Loss term quadratic in the load, at full load, divided by the rated power, (B,)."""

    def loss_w(self, load_w: Values) -> Values:
        """Return the loss of the device at a load, in W, (B,).

        Args:
            load_w: Power that the device delivers, W, (B,).
        """
        load_share = load_w / self.rated_w
        load_loss_share = self.proportional_share + self.square_share * load_share
        return self.no_load_share * self.rated_w + load_loss_share * load_w


class PowerPath(NamedTuple):
    """Power path of B data centers, from the grid connection to the racks."""

    ups: LossyDevice
    """Uninterruptible power supply."""
    distribution: LossyDevice
    """Transformers, PDUs and wiring between the UPS and the racks."""

    def losses_w(self, it_w: Values) -> tuple[Values, Values]:
        """Return the losses of UPS and distribution.

        The load of the UPS is the IT power plus the losses of the distribution. The UPS does not
        supply the cooling.

        Args:
            it_w: IT power, W, (B,).

        Returns:
            Loss of the UPS and loss of the distribution, W, each (B,).
        """
        distribution_w = self.distribution.loss_w(it_w)
        return self.ups.loss_w(it_w + distribution_w), distribution_w


def overload_kwh(grid_kwh: Values, limit_kwh: Values) -> F64:
    """Return the energy drawn in a step beyond the limit of the grid connection.

    Args:
        grid_kwh: Energy bought in the step, kWh, (B,).
        limit_kwh: Largest energy that the connection carries in the step, kWh, (B,).

    Returns:
        Energy beyond the limit, kWh, (B,), at least 0. The energy bought includes this excess.
    """
    over_kwh = grid_kwh - limit_kwh
    return np.where(over_kwh > ROUND_OFF_SHARE * limit_kwh, over_kwh, 0.0)
