"""Servers protect themselves from hot air: racks throttle, trip and restart."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sdc_taichi.types import F64, I64, Status, Values

NORMAL, THROTTLED, TRIPPED = 0, 1, 2
"""Status of a rack: in order, limited to ``throttle_share`` because it is too hot, or off."""
LEAST_THROTTLE_SHARE = 0.1
"""Smallest throttle share by which the temperature rise of a throttled rack is divided."""

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
    """Status of each rack after its hottest inlet and outlet have been seen.

    A rack throttles above either limit, and trips above the trip temperature of the inlets. Above
    that of the outlets it trips if it is throttled already: servers throttle within seconds. The
    limit of inlets is usually the upper end of the allowable range of the servers' class (ASHRAE TC
    9.9 Thermal Guidelines, 2021), limits of outlets are those of the exhaust sensors of servers.

    A throttled rack whose fans have failed goes on being throttled while its outlet would pass the
    limit with the rise of full work, which is taken to be the present one over ``throttle_share``.

    Args:
        status: NORMAL, THROTTLED or TRIPPED, (R,).
        inlet_max_c: Hottest inlet temperature of each rack, C, (R,).
        outlet_max_c: Hottest outlet temperature of each rack, C, (R,).
        limit_c: Highest inlet without throttling, C, inf for no protection, () or (R,).
        trip_c: Highest inlet without tripping, C, at least the limit, () or (R,).
        outlet_limit_c: Highest outlet without throttling, C, inf for no limit, () or (R,).
        outlet_trip_c: Highest outlet at which a throttled rack does not trip, C, () or (R,).
        throttle_share: Utilisation that a throttled rack may reach, 0..1, () or (R,).
        fans_failed: Whether fans of each rack have failed, (R,).
        restarts: Tripped racks that start again, (R,).

    Returns:
        New status, (R,); racks that restart are normal.
    """
    rise_k = (outlet_max_c - inlet_max_c) / np.maximum(throttle_share, LEAST_THROTTLE_SHARE)
    throttled = status == THROTTLED
    would_c = np.where(throttled & fans_failed, inlet_max_c + rise_k, outlet_max_c)
    too_hot = (inlet_max_c > limit_c) | (np.maximum(outlet_max_c, would_c) > outlet_limit_c)
    trips = (inlet_max_c > trip_c) | (throttled & (outlet_max_c > outlet_trip_c))
    called_for = np.where(trips, TRIPPED, np.where(too_hot, THROTTLED, NORMAL))
    off = np.where(restarts, NORMAL, TRIPPED)
    return np.where(status == TRIPPED, off, called_for).astype(np.int8)


def ready_min(
    status: Status, before_min: F64, inlet_max_c: F64, cooled: Mask, *, restart_c: Values, dt: float
) -> F64:
    """Minutes for which each tripped rack has been able to restart, (R,); 0 for all others.

    A rack is able to while its inlet is at most the restart temperature and its room is cooled.

    Args:
        status: Status of each rack in the step, (R,).
        before_min: Minutes at the start of the step, (R,).
        inlet_max_c: Hottest inlet of each rack, C, (R,).
        cooled: Whether cooling and fans of each rack are in order, (R,).
        restart_c: Highest inlet at which a tripped rack restarts, C, () or (R,).
        dt: Length of the step, min.
    """
    able = (status == TRIPPED) & cooled & (inlet_max_c <= restart_c)
    return np.where(able, before_min + dt, 0.0)


def first_of_each(wanted: Mask, most: I64, offsets: npt.NDArray[np.integer]) -> Mask:
    """Mask of the racks to restart: the first wanted ones of each data center, (R,).

    Args:
        wanted: Racks to choose from, (R,).
        most: Most racks of each data center, (B,).
        offsets: First rack of each data center and their total, (B + 1,).
    """
    counted = np.concatenate([[0], np.cumsum(wanted)])
    sizes = np.diff(offsets)
    place = counted[1:] - np.repeat(counted[offsets[:-1]], sizes)
    return np.asarray(wanted & (place <= np.repeat(most, sizes)))


def capacity(status: Status, throttle_share: Values) -> F64:
    """Utilisation that each rack may reach, 0..1, (R,).

    A rack in order may reach 1, a throttled one ``throttle_share``, a tripped one 0.

    Args:
        status: NORMAL, THROTTLED or TRIPPED, (R,).
        throttle_share: Utilisation that a throttled rack may reach, 0..1, () or (R,).
    """
    return np.where(status == TRIPPED, 0.0, np.where(status == THROTTLED, throttle_share, 1.0))
