"""Time stamps of tables: points in time that carry the UTC offset of the sites."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta, timezone, tzinfo
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.types import F64, I64


def zone_name(utc_offset_h: F64 | Sequence[float]) -> str:
    """Return the time zone of a column of several sites, such as ``-07:00``.

    The zone is ``UTC`` if the sites have different offsets, because a column has only one zone.

    Args:
        utc_offset_h: Local standard time minus UTC, in h, (B,).
    """
    (minutes, *others) = sorted({round(60 * each) for each in utc_offset_h})
    if others or minutes == 0:
        return "UTC"
    hours, minutes_of_hour = divmod(abs(minutes), 60)
    return f"{'+' if minutes > 0 else '-'}{hours:02}:{minutes_of_hour:02}"


def zone(utc_offset_h: float) -> tzinfo:
    """Return the time zone of a site by its local standard time minus UTC, in h."""
    return timezone(timedelta(minutes=round(60 * utc_offset_h)))


def utc_times(local: npt.NDArray[np.datetime64], utc_offset_h: F64) -> npt.NDArray[np.datetime64]:
    """Return local standard times of B sites in UTC, in the shape of ``local``, (n, B)."""
    minutes = np.round(60 * utc_offset_h).astype("timedelta64[m]")
    return np.asarray(local - minutes)


def time_column(drivers: Drivers, steps: I64, steps_per_hour: int) -> Any:
    """Return the times at which steps begin as an Arrow array with a time zone.

    Args:
        drivers: Inputs of B data centers, with their calendar years and UTC offsets.
        steps: Steps, counted from 0 at reset, (n,).
        steps_per_hour: Number of steps in an hour.

    Returns:
        ``timestamp[ms]`` in the zone ``zone_name``, (n * B,): steps in order, and within a step the
        data centers in order.
    """
    import pyarrow as pa

    times = utc_times(drivers.times(steps, steps_per_hour), drivers.utc_offset_h)
    kind = pa.timestamp("ms", tz=zone_name(drivers.utc_offset_h))
    return pa.array(times.reshape(-1).astype("datetime64[ms]").astype(np.int64)).cast(kind)
