"""Servers protect themselves from hot inlets: racks throttle, trip and restart."""

from __future__ import annotations

import numpy as np

from sdc_taichi.types import F64, Status, Values

NORMAL, THROTTLED, TRIPPED = 0, 1, 2
"""Status of a rack: works as asked, works less because an inlet is too hot, or is off."""


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
        inlet_max_c: Hottest inlet temperature of each rack, C, (R,).
        limit_c: Highest inlet without throttling, C, inf for no protection, () or (R,).
        trip_c: Highest inlet without tripping, C, at least the limit, () or (R,).
        restart_c: Highest inlet at which a tripped rack restarts, C, () or (R,).

    Returns:
        New status, (R,).
    """
    called_for = np.where(
        inlet_max_c > trip_c, TRIPPED, np.where(inlet_max_c > limit_c, THROTTLED, NORMAL)
    )
    stays_off = (status == TRIPPED) & (inlet_max_c > restart_c)
    return np.where(stays_off, TRIPPED, called_for).astype(np.int8)


def capacity(status: Status, throttle_share: Values) -> F64:
    """Utilisation that each rack may reach, 0..1, (R,).

    A rack in order may reach 1, a throttled one ``throttle_share``, a tripped one 0.

    Args:
        status: NORMAL, THROTTLED or TRIPPED, (R,).
        throttle_share: Utilisation that a throttled rack may reach, 0..1, () or (R,).
    """
    return np.where(status == TRIPPED, 0.0, np.where(status == THROTTLED, throttle_share, 1.0))
