"""Protection of servers from hot air: racks throttle, trip and restart.

R is the number of racks and B the number of data centers. Arrays of shape () or (R,) are one value
for all racks or one per rack.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sdc_taichi.types import F64, I64, Status, Values

NORMAL, THROTTLED, TRIPPED = 0, 1, 2
"""Status of a rack: normal, limited to ``throttle_share`` because it is too hot, or off."""
LEAST_THROTTLE_SHARE = 0.1
"""Lower bound of the throttle share where a temperature rise is divided by it."""

Mask = npt.NDArray[np.bool_]


def protect(
    status: Status,
    inlet_max_c: F64,
    outlet_max_c: F64,
    *,
    limit_c: Values,
    trip_c: Values,
    outlet_limit_c: Values,
    outlet_trip_c: Values,
    throttle_share: Values,
    fans_failed: Mask,
    restarts: Mask,
) -> Status:
    """Return the new status of each rack from its hottest inlet and outlet temperature.

    A rack throttles above the inlet limit or the outlet limit, and trips above the inlet trip
    temperature. Above the outlet trip temperature it trips only if it is already throttled, because
    servers throttle within seconds. The inlet limit is usually the upper end of the allowable range
    of the server class (ASHRAE TC 9.9 Thermal Guidelines, 2021). The outlet limits are those of the
    exhaust sensors of servers.

    A throttled rack with failed fans stays throttled as long as its outlet would exceed the limit
    at full work. The temperature rise at full work is estimated as the present rise divided by
    ``throttle_share``.

    Args:
        status: NORMAL, THROTTLED or TRIPPED, (R,).
        inlet_max_c: Hottest inlet temperature of each rack, C, (R,).
        outlet_max_c: Hottest outlet temperature of each rack, C, (R,).
        limit_c: Highest inlet without throttling, C; inf for no protection; () or (R,).
        trip_c: Highest inlet without tripping, C, at least the limit, () or (R,).
        outlet_limit_c: Highest outlet without throttling, C; inf for no limit; () or (R,).
        outlet_trip_c: Highest outlet at which a throttled rack does not trip, C, () or (R,).
        throttle_share: Highest utilisation of a throttled rack, 0..1, () or (R,).
        fans_failed: True for racks with failed fans, (R,).
        restarts: True for tripped racks that restart, (R,).

    Returns:
        New status, (R,); racks that restart are normal.
    """
    rise_k = (outlet_max_c - inlet_max_c) / np.maximum(throttle_share, LEAST_THROTTLE_SHARE)
    throttled = status == THROTTLED
    full_c = np.where(throttled & fans_failed, inlet_max_c + rise_k, outlet_max_c)
    too_hot = (inlet_max_c > limit_c) | (np.maximum(outlet_max_c, full_c) > outlet_limit_c)
    trips = (inlet_max_c > trip_c) | (throttled & (outlet_max_c > outlet_trip_c))
    if_running = np.where(trips, TRIPPED, np.where(too_hot, THROTTLED, NORMAL))
    if_tripped = np.where(restarts, NORMAL, TRIPPED)
    return np.where(status == TRIPPED, if_tripped, if_running).astype(np.int8)


def ready_min(
    status: Status, before_min: F64, inlet_max_c: F64, cooled: Mask, *, restart_c: Values, dt: float
) -> F64:
    """Return the minutes for which each tripped rack has been able to restart, (R,).

    A tripped rack is able to restart while its inlet is at most the restart temperature and its
    cooling works. The result is 0 for all other racks.

    Args:
        status: Status of each rack in the step, (R,).
        before_min: Result for the previous step, min, (R,).
        inlet_max_c: Hottest inlet temperature of each rack, C, (R,).
        cooled: True for racks whose room cooling and fans work, (R,).
        restart_c: Highest inlet at which a tripped rack restarts, C, () or (R,).
        dt: Length of the step, min.
    """
    able = (status == TRIPPED) & cooled & (inlet_max_c <= restart_c)
    return np.where(able, before_min + dt, 0.0)


def first_of_each(wanted: Mask, most: I64, offsets: npt.NDArray[np.integer]) -> Mask:
    """Return a mask of the first ``most`` wanted racks of each data center, (R,).

    Args:
        wanted: True for racks to choose from, (R,).
        most: Largest number of racks to choose in each data center, (B,).
        offsets: Index of the first rack of each data center, and the number of racks, (B + 1,).
    """
    counted = np.concatenate([[0], np.cumsum(wanted)])
    sizes = np.diff(offsets)
    place = counted[1:] - np.repeat(counted[offsets[:-1]], sizes)
    return np.asarray(wanted & (place <= np.repeat(most, sizes)))


def capacity(status: Status, throttle_share: Values) -> F64:
    """Return the highest utilisation of each rack, 0..1, (R,).

    It is 1 for a normal rack, ``throttle_share`` for a throttled one, and 0 for a tripped one.

    Args:
        status: NORMAL, THROTTLED or TRIPPED, (R,).
        throttle_share: Highest utilisation of a throttled rack, 0..1, () or (R,).
    """
    return np.where(status == TRIPPED, 0.0, np.where(status == THROTTLED, throttle_share, 1.0))
