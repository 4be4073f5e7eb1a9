"""Airflows of servers that are impossible at the design point, or probably a mistake."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import DesignPoint
from sdc_taichi.hall.rack_servers import RackServers
from sdc_taichi.types import F64

MOST_RISE_K = 40.0
"""Most that the air warms by in a server, in K: from an inlet of 27 C to 67 C, the most that parts
behind processors bear."""
MOST_USUAL_RISE_K = 25.0
"""Servers in air warm it by 10 to 20 K at full load, the densest by 25 K."""
MOST_USUAL_RTI_PCT = 200.0
"""Open halls without order in their aisles reach a return temperature index of about 150 %."""
LEAST_USUAL_UNIT_SHARE = 0.9
"""CRAC units smaller than the design airflow make up for it with exhaust air at full load; a tenth
is bearable in halls that never reach full load."""
_MOST_LISTED = 3


def odd_airflow(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> tuple[str, ...]:
    """Messages about airflows at the design point that are possible, but rare.

    Args:
        config: The data center.
        servers: Its ``rack_servers``.
        design: Its design point.

    Raises:
        ConfigError: servers that warm their air by more than ``MOST_RISE_K``.
    """
    if config.servers.outlet_model == "released":
        return ()
    first, rise_k = servers.group_offsets[:-1], design.server_rise_k
    rack_rise_k = np.maximum.reduceat(rise_k, first)
    if np.max(rack_rise_k) > MOST_RISE_K:
        raise ConfigError(
            f"{config.name}: {_racks(rack_rise_k, MOST_RISE_K)} at the design point; valid is at "
            f"most {MOST_RISE_K:g} K (more airflow, by servers.fan_full_airflow_m3s null or "
            "full_airflow_m3s and design_rise_k of the servers, or less power)"
        )
    return tuple(_messages(config, design, rack_rise_k))


def _messages(config: DataCenterConfig, design: DesignPoint, rack_rise_k: F64) -> Iterator[str]:
    if np.max(rack_rise_k) > MOST_USUAL_RISE_K:
        yield (
            f"{_racks(rack_rise_k, MOST_USUAL_RISE_K)} at the design point; up to "
            f"{MOST_USUAL_RISE_K:g} K is usual"
        )
    airflow_m3s = float(design.airflow_m3s.sum())
    rti_pct = 100.0 * airflow_m3s / design.crac_flow_m3s
    if config.hall.inlet_model == "recirculation" and rti_pct > MOST_USUAL_RTI_PCT:
        most = int(np.argmax(design.airflow_m3s))
        yield (
            f"hall: servers move {airflow_m3s:.4g} m3/s at the design point, most through rack "
            f"{most} with {design.airflow_m3s[most]:.3g} m3/s, the CRAC units "
            f"{design.crac_flow_m3s:.4g} m3/s: RTI {rti_pct:.0f} %; up to "
            f"{MOST_USUAL_RTI_PCT:g} % is usual"
        )
    yield from _small_units(config, design)


def _small_units(config: DataCenterConfig, design: DesignPoint) -> Iterator[str]:
    crac = config.hvac.crac
    if crac.airflow_m3s is not None:
        given_m3s = float(np.broadcast_to(crac.airflow_m3s, crac.units).sum())
        if given_m3s < LEAST_USUAL_UNIT_SHARE * design.crac_flow_m3s:
            yield (
                f"hvac.crac.airflow_m3s: the units give {given_m3s:.4g} m3/s at full speed, the "
                f"design point takes {design.crac_flow_m3s:.4g} m3/s"
            )
    if crac.capacity_kw is not None:
        coils_kw = float(np.broadcast_to(crac.capacity_kw, crac.units).sum())
        servers_kw = float(design.it_w.sum()) / 1e3
        if coils_kw < servers_kw:
            yield (
                f"hvac.crac.capacity_kw: the coils take out {coils_kw:.4g} kW, the servers give "
                f"{servers_kw:.4g} kW at full load"
            )


def _racks(rack_rise_k: F64, limit_k: float) -> str:
    """Text that names the racks whose rise exceeds a limit, and by how much they warm the air."""
    found = np.flatnonzero(rack_rise_k > limit_k)
    numbers = ", ".join(map(str, found[:_MOST_LISTED]))
    left = len(found) - _MOST_LISTED
    more = f" and {left:,} more" if left > 0 else ""
    low, high = rack_rise_k[found].min(), rack_rise_k[found].max()
    span = f"{low:.3g}..{high:.3g}" if f"{low:.3g}" != f"{high:.3g}" else f"{high:.3g}"
    racks = f"rack{'s' if len(found) > 1 else ''}"
    return f"hall: servers of {racks} {numbers}{more} warm the air by {span} K"
