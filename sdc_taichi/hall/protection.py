"""Servers protect themselves from hot inlets: racks throttle, trip and restart."""

from __future__ import annotations

import numpy as np

from sdc_taichi.types import F64, Status

Values = F64 | float

NORMAL, THROTTLED, TRIPPED = 0, 1, 2
"""Status of a rack."""


def protect(
    status: Status, inlet_max_c: F64, *, limit_c: Values, trip_c: Values, restart_c: Values
) -> Status:
    """Status of each rack after its hottest inlet has been seen.

    Above the limit a rack throttles, and returns to normal at or below it. Above the trip
    temperature it switches off and stays off until its inlet is at or below the restart
    temperature; it then is what its inlet calls for. The limit is usually the upper end of the
    allowable range of the servers' class (ASHRAE TC 9.9 Thermal Guidelines, 2021).

    Args:
        status: NORMAL, THROTTLED or TRIPPED, (R,).
        inlet_max_c: hottest inlet temperature of each rack, (R,).
        limit_c: highest inlet without throttling, inf for no protection, () or (R,).
        trip_c: highest inlet without tripping, at least the limit, () or (R,).
        restart_c: highest inlet at which a tripped rack starts again, () or (R,).

    Returns:
        New status, (R,).
    """
    called_for = np.where(
        inlet_max_c > trip_c, TRIPPED, np.where(inlet_max_c > limit_c, THROTTLED, NORMAL)
    )
    stays_off = (status == TRIPPED) & (inlet_max_c > restart_c)
    return np.where(stays_off, TRIPPED, called_for).astype(np.int8)


def capacity(status: Status, throttle_share: Values) -> F64:
    """Utilisation each rack may reach: 1, ``throttle_share`` throttled, and 0 tripped, (R,).

    Args:
        status: NORMAL, THROTTLED or TRIPPED, (R,).
        throttle_share: 0..1, () or (R,).
    """
    return np.where(status == TRIPPED, 0.0, np.where(status == THROTTLED, throttle_share, 1.0))
