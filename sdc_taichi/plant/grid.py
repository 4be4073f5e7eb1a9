"""The connection to the grid: where it carries more than it is made for."""

from __future__ import annotations

import numpy as np

from sdc_taichi.types import F64, Values

NO_LIMIT_KW = 1e9
"""Limit of a connection without one, in kW: no step draws as much."""
ROUND_OFF_SHARE = 1e-9
"""Share of the limit by which rounding may exceed it."""


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
