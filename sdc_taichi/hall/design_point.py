"""Power, airflow and temperatures of a hall at its design point: full load, design supply air."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.rack_servers import RackServers, rack_servers
from sdc_taichi.types import F64

_MOST_HEIGHT_ITERATIONS = 100
EXACT_RACKS = 10_000
"""Largest number of racks of a hall whose design point is iterated to the last digits; an iteration
takes up to a second in a hall of 100,000 racks."""
_EXACT_FACTOR, _LARGE_FACTOR = 1e-15, 1e-7
"""Tolerances of height factors of halls of up to EXACT_RACKS, and of larger halls."""


MOST_RISE_K = 40.0
"""Largest allowed temperature rise of the air in a server, in K. With an inlet of 27 C the air
reaches 67 C, the limit of components downstream of the processors."""
MOST_USUAL_RISE_K = 25.0
"""Largest usual temperature rise of the air in a server at full load, in K. Most servers have 10 to
20 K, the densest ones 25 K."""
MOST_USUAL_RTI_PCT = 200.0
"""Largest usual return temperature index, in %. Open halls without cold and hot aisles have about
150 %."""
LEAST_USUAL_UNIT_SHARE = 0.9
"""Smallest usual airflow of all CRAC units, divided by the design airflow. Smaller units make racks
take in more exhaust air at full load, but many halls never reach full load."""
_MOST_LISTED = 3


@dataclass(frozen=True, slots=True)
class DesignPoint:
    """Hall of R racks and G server groups at full load and design supply temperature."""

    supply_c: float
    """Supply air temperature, in C."""
    full_airflow_m3s: F64
    """Airflow of one server of each group at an airflow ratio of 1, as volume at the inlet
    temperature, in m3/s, (G,). It is configured or follows from the heat balance of the hall."""
    air_j_per_m3_k: float
    """Volumetric heat capacity rho cp of air at the reference temperature, in J/(m3 K)."""
    crac_flow_m3s: float
    """Total airflow of the CRAC units, in m3/s."""
    it_w: F64
    """IT power of each rack, fans included, in W, (R,)."""
    airflow_m3s: F64
    """Airflow through the servers of each rack, as volume at the reference temperature of
    ``plant.air``, in m3/s, (R,)."""
    server_rise_k: F64
    """Temperature rise of the air through the servers of each group, in K, (G,)."""
    approach_k: F64
    """Airflow-weighted mean inlet temperature of each rack minus supply air, in K, (R,)."""
    outlet_rise_k: F64
    """Airflow-weighted mean outlet temperature of each rack minus supply air, in K, (R,)."""
    height_factor: F64
    """Share of exhaust air in the intake of each group divided by that of its rack, (G,). It
    depends on height, and its airflow-weighted mean in a rack is 1."""

    def setpoint_over_supply_k(self, config: DataCenterConfig) -> float:
        """Return the setpoint of the CRAC units minus their lowest supply air temperature, in K.

        With return air control it is the rise from supply to return air at this design point,
        P/(rho cp V_crac); with supply air control it is 0.
        """
        if config.hvac.crac.temperature_control == "supply":
            return 0.0
        return float(self.it_w.sum()) / (self.air_j_per_m3_k * self.crac_flow_m3s)


def design_point(
    config: DataCenterConfig,
    servers: RackServers | None = None,
    approach_k: F64 | None = None,
    near: DesignPoint | None = None,
) -> DesignPoint:
    """Compute power, airflow and temperatures of every rack at full load and design supply air.

    Outlet temperatures follow from the heat balance of a rack, T_out = T_in + P/(rho cp V).

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``; None computes them.
        approach_k: Inlet minus supply temperature of each rack, K, (R,); None takes the configured
            ones.
        near: A design point near that of the result, from which the iteration starts.

    Raises:
        ConfigError: The approach temperatures leave no positive temperature rise for the servers.
    """
    servers = rack_servers(config) if servers is None else servers
    approach_k = config.hall.rack_approach_k() if approach_k is None else approach_k
    supply_c = config.hall.design_supply_c
    group_approach_k = servers.per_group(approach_k)
    height_factor = np.ones(len(servers.count))
    if config.hall.inlet_model == "recirculation":
        start = height_factor if near is None else near.height_factor
        height_factor = _height_factor(config, servers, approach_k, start)
    inlet_c = _inlet_c(servers, supply_c, group_approach_k, height_factor)
    return design_point_at(config, servers, inlet_c, height_factor, approach_k=approach_k)


def design_point_at(
    config: DataCenterConfig,
    servers: RackServers,
    inlet_c: F64,
    height_factor: F64,
    *,
    approach_k: F64 | None = None,
    full_airflow_m3s: F64 | None = None,
) -> DesignPoint:
    """Compute power, airflow and temperatures at full load with given inlet temperatures.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        inlet_c: Inlet temperature of each server group, C, (G,).
        height_factor: Height factors of the groups, dimensionless, (G,).
        approach_k: Inlet minus supply temperature of each rack, K, (R,); it determines the airflow
            of servers for which none is configured.
        full_airflow_m3s: Airflow of one server of each group at an airflow ratio of 1, m3/s, (G,);
            None takes the configured airflow, or derives it from ``approach_k``.

    Raises:
        ConfigError: The approach temperatures leave no positive temperature rise for the servers.
    """
    supply_c, air_j_per_m3_k = config.hall.design_supply_c, servers.air.j_per_m3_k
    server_w, moved = _at_full_load(config, servers, inlet_c)
    if full_airflow_m3s is None:
        rack_k = config.hall.rack_approach_k() if approach_k is None else approach_k
        full_airflow_m3s = _full_airflow_m3s(config, servers, server_w, moved, rack_k)
    it_w = servers.per_rack(servers.count * server_w)
    largest_m3s = float(full_airflow_m3s.max())
    server_rise_k = server_w / (air_j_per_m3_k * full_airflow_m3s * moved)
    # Relative airflows of identical servers are exactly 1, so their sums have no rounding errors.
    moved = servers.count * (full_airflow_m3s / largest_m3s) * moved
    rack_moved = servers.per_rack(moved)
    airflow_m3s = largest_m3s * rack_moved
    inlet_rise_k = servers.per_rack(moved * (inlet_c - supply_c)) / rack_moved
    return DesignPoint(
        supply_c=supply_c,
        full_airflow_m3s=full_airflow_m3s,
        air_j_per_m3_k=air_j_per_m3_k,
        crac_flow_m3s=config.hvac.crac.supply_m3s_per_w * float(it_w.sum()),
        it_w=it_w,
        airflow_m3s=airflow_m3s,
        server_rise_k=server_rise_k,
        approach_k=inlet_rise_k,
        outlet_rise_k=inlet_rise_k + it_w / (air_j_per_m3_k * airflow_m3s),
        height_factor=height_factor,
    )


def _inlet_c(servers: RackServers, supply_c: float, approach_k: F64, height_factor: F64) -> F64:
    """Return the inlet temperature of each group, in C, (G,)."""
    return np.asarray(supply_c + approach_k * height_factor + servers.inlet_offset_k)


def _at_full_load(config: DataCenterConfig, servers: RackServers, inlet_c: F64) -> tuple[F64, F64]:
    """Return power with fans, in W, and relative airflow of one server of each group, (G,).

    The relative airflow is a volume at the reference temperature divided by the full airflow at the
    inlet temperature.
    """
    curves, full_load = config.servers.curves, np.ones(len(servers.count))
    ratio = curves.airflow_ratio(inlet_c, full_load)
    cpu_w = curves.cpu_w(inlet_c, full_load, servers.full_w, servers.idle_w)
    server_w = cpu_w + curves.fan_w(ratio, servers.fan_reference_w)
    return server_w, curves.moved_ratio(ratio, inlet_c, servers.air.density_ratio)


def _height_factor(
    config: DataCenterConfig,
    servers: RackServers,
    approach_k: F64,
    start: F64,
) -> F64:
    """Return height factors of the groups with an airflow-weighted mean of 1 in each rack, (G,).

    Airflow depends on the inlet temperatures, which in turn depend on the height factors. Fixed
    point iteration resolves this dependence.
    """
    supply_c, group_approach_k = config.hall.design_supply_c, servers.per_group(approach_k)
    factor = start
    within = _EXACT_FACTOR if config.hall.racks <= EXACT_RACKS else _LARGE_FACTOR
    for _ in range(_MOST_HEIGHT_ITERATIONS):
        inlet_c = _inlet_c(servers, supply_c, group_approach_k, factor)
        server_w, moved = _at_full_load(config, servers, inlet_c)
        full_m3s = _full_airflow_m3s(config, servers, server_w, moved, approach_k)
        airflow = servers.count * full_m3s * moved
        mean = servers.per_rack(airflow * servers.height_factor) / servers.per_rack(airflow)
        previous, factor = factor, servers.height_factor / servers.per_group(mean)
        if np.max(np.abs(factor - previous)) < within:
            break
    return factor


def _full_airflow_m3s(
    config: DataCenterConfig, servers: RackServers, server_w: F64, moved: F64, approach_k: F64
) -> F64:
    """Return the airflow of one server of each group at an airflow ratio of 1, in m3/s, (G,).

    The airflow is configured or follows from the design rise of the group. Servers with neither
    have an airflow proportional to their power. The factor is such that the mean temperature rise
    of their racks and the approach temperatures satisfy the heat balance of the hall.

    Args:
        config: The data center.
        servers: Servers of the hall.
        server_w: Power of one server of each group, from ``_at_full_load``, W, (G,).
        moved: Relative airflow of one server of each group, from ``_at_full_load``, (G,).
        approach_k: Inlet minus supply temperature of each rack, K, (R,).
    """
    full_m3s = servers.full_airflow_m3s
    if not np.isnan(full_m3s).any():
        return full_m3s
    per_rise_m3s = server_w / (servers.air.j_per_m3_k * moved)
    full_m3s = np.where(np.isnan(full_m3s), per_rise_m3s / servers.design_rise_k, full_m3s)
    open_count = servers.count * np.isnan(full_m3s)
    if open_count.any():
        heat_w = servers.per_rack(open_count * server_w)
        w_moved = servers.per_rack(open_count * servers.full_w * moved)
        racks = w_moved > 0
        rise_k = _server_rise_k(config, approach_k, servers.air.j_per_m3_k)
        m3s_per_w = np.mean(heat_w[racks] / (servers.air.j_per_m3_k * w_moved[racks])) / rise_k
        full_m3s = np.where(open_count > 0, m3s_per_w * servers.full_w, full_m3s)
    return np.asarray(full_m3s)


def _server_rise_k(config: DataCenterConfig, approach_k: F64, air_j_per_m3_k: float) -> float:
    """Return the mean temperature rise through the racks by the hall's heat balance, in K.

    It is the rise of the CRAC air minus the mean approaches of supply and return air.
    """
    crac_rise_k = 1.0 / (air_j_per_m3_k * config.hvac.crac.supply_m3s_per_w)
    supply_k = np.mean(approach_k)
    return_k = np.mean(np.asarray(config.hall.return_approach_k))
    rise_k = float(crac_rise_k - supply_k - return_k)
    if rise_k <= 0:
        raise ConfigError(
            f"{config.name}: servers.fan_full_airflow_m3s null: supply and return approach "
            f"temperatures of {supply_k:g} and {return_k:g} K leave {rise_k:.3g} K of the "
            f"{crac_rise_k:.3g} K that supply air warms by; valid is above 0"
        )
    return rise_k


def odd_airflow(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> tuple[str, ...]:
    """Return warnings about possible but unusual airflows at the design point.

    Raises:
        ConfigError: Servers heat their air by more than ``MOST_RISE_K``, or a rack needs more air
            than ``hall.most_face_velocity_m_s`` allows.
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
    _check_face_velocity(config, design)
    return tuple(_messages(config, design, rack_rise_k))


def _check_face_velocity(config: DataCenterConfig, design: DesignPoint) -> None:
    """Raise an error if a rack needs more air than passes its front.

    Servers could do with less air if it became warmer, so racks are judged at the largest usual
    temperature rise, ``MOST_USUAL_RISE_K``. The densest racks that are cooled by air alone hold
    four servers of 14.3 kW each (NVIDIA 2024, *DGX B200 User Guide*): 57 kW and, if their air warms
    by 16 K (assumed), 2.3 m/s through a front of 0.6 m x 2.1 m.
    """
    most_m_s, layout = config.hall.most_face_velocity_m_s, config.hall.layout
    face_m2 = layout.rack_pitch_m * layout.rack_height_m
    usual_m3s = design.it_w / (design.air_j_per_m3_k * MOST_USUAL_RISE_K)
    airflow_m3s = np.minimum(design.airflow_m3s, usual_m3s)
    rack = int(np.argmax(airflow_m3s))
    if most_m_s is None or airflow_m3s[rack] <= most_m_s * face_m2:
        return
    raise ConfigError(
        f"{config.name}: hall: rack {rack} with servers of {design.it_w[rack] / 1e3:.4g} kW needs "
        f"{airflow_m3s[rack]:.3g} m3/s of air that warms by {MOST_USUAL_RISE_K:g} K, "
        f"{airflow_m3s[rack] / face_m2:.3g} m/s through its front of {layout.rack_pitch_m:g} x "
        f"{layout.rack_height_m:g} m; valid is at most {most_m_s:g} m/s "
        "(hall.most_face_velocity_m_s; null allows any velocity)"
    )


def _messages(config: DataCenterConfig, design: DesignPoint, rack_rise_k: F64) -> Iterator[str]:
    if np.max(rack_rise_k) > MOST_USUAL_RISE_K:
        yield (
            f"{_racks(rack_rise_k, MOST_USUAL_RISE_K)} at the design point; up to "
            f"{MOST_USUAL_RISE_K:g} K is usual"
        )
    airflow_m3s = float(design.airflow_m3s.sum())
    rti_pct = 100.0 * airflow_m3s / design.crac_flow_m3s
    if config.hall.inlet_model == "recirculation" and rti_pct > MOST_USUAL_RTI_PCT:
        rack = int(np.argmax(design.airflow_m3s))
        yield (
            f"hall: servers move {airflow_m3s:.4g} m3/s at the design point, most through rack "
            f"{rack} with {design.airflow_m3s[rack]:.3g} m3/s, the CRAC units "
            f"{design.crac_flow_m3s:.4g} m3/s: RTI {rti_pct:.0f} %; up to "
            f"{MOST_USUAL_RTI_PCT:g} % is usual"
        )
    yield from _small_units(config, design)


def _small_units(config: DataCenterConfig, design: DesignPoint) -> Iterator[str]:
    crac = config.hvac.crac
    if crac.airflow_m3s is not None:
        units_m3s = float(np.broadcast_to(crac.airflow_m3s, crac.units).sum())
        if units_m3s < LEAST_USUAL_UNIT_SHARE * design.crac_flow_m3s:
            yield (
                f"hvac.crac.airflow_m3s: the units give {units_m3s:.4g} m3/s at full speed, the "
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
    """Return a text that names the racks whose temperature rise exceeds a limit."""
    warm = np.flatnonzero(rack_rise_k > limit_k)
    numbers = ", ".join(map(str, warm[:_MOST_LISTED]))
    left = len(warm) - _MOST_LISTED
    more = f" and {left:,} more" if left > 0 else ""
    low, high = rack_rise_k[warm].min(), rack_rise_k[warm].max()
    span = f"{low:.3g}..{high:.3g}" if f"{low:.3g}" != f"{high:.3g}" else f"{high:.3g}"
    racks = f"rack{'s' if len(warm) > 1 else ''}"
    return f"hall: servers of {racks} {numbers}{more} warm the air by {span} K"
