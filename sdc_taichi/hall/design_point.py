"""Power, airflow and temperatures of a hall at its design point: full load, design supply air."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.rack_servers import RackServers, rack_servers
from sdc_taichi.plant.servers import ServerCurves
from sdc_taichi.types import F64

_MOST_HEIGHT_ITERATIONS = 100


@dataclass(frozen=True, slots=True)
class DesignPoint:
    """A hall of R racks and G server groups at full load and design supply air."""

    supply_c: float
    """Supply air, in C."""
    fan_full_airflow_m3s: float
    """Airflow of one server at an airflow ratio of 1, in m3/s: as configured, or else such that the
    approach temperatures close the heat balance of the hall."""
    crac_flow_m3s: float
    """Airflow of all CRAC units together, in m3/s."""
    it_w: F64
    """IT power of each rack, fans included, in W, (R,)."""
    airflow_m3s: F64
    """Airflow through the servers of each rack, in m3/s, (R,)."""
    approach_k: F64
    """Airflow-weighted mean inlet of each rack over supply air, in K, (R,)."""
    outlet_rise_k: F64
    """Airflow-weighted mean outlet of each rack over supply air, in K, (R,)."""
    height_factor: F64
    """Exhaust share of the intake of each group over that of its rack, by height, (G,). Its mean
    over the airflow of a rack is 1."""


def design_point(
    config: DataCenterConfig, servers: RackServers | None = None, approach_k: F64 | None = None
) -> DesignPoint:
    """Power, airflow and temperatures of every rack at full load and design supply air.

    Outlets follow from the heat balance of a rack, T_out = T_in + P/(rho cp V).

    Args:
        config: The data center.
        servers: Its ``rack_servers``, if at hand.
        approach_k: Inlet over supply air, K, (R,); None is as given in the config.

    Raises:
        ConfigError: approach temperatures that leave no room for heating the air.
    """
    servers = rack_servers(config) if servers is None else servers
    approach_k = config.hall.rack_approach_k() if approach_k is None else approach_k
    supply_c = config.hall.design_supply_c
    group_approach_k = servers.per_group(approach_k)
    height_factor = np.ones(len(servers.count))
    if config.hall.inlet_model == "recirculation":
        curves = config.servers.curves
        height_factor = _height_factor(servers, curves, supply_c, group_approach_k)
    inlet_c = _inlet_c(servers, supply_c, group_approach_k, height_factor)
    return design_point_at(config, servers, inlet_c, height_factor, approach_k=approach_k)


def design_point_at(
    config: DataCenterConfig,
    servers: RackServers,
    inlet_c: F64,
    height_factor: F64,
    *,
    approach_k: F64 | None = None,
    fan_full_airflow_m3s: float | None = None,
) -> DesignPoint:
    """Power, airflow and temperatures at full load with given inlets.

    Args:
        config: The data center.
        servers: Its ``rack_servers``.
        inlet_c: Inlet of each server group, C, (G,).
        height_factor: Height factors of the groups, dimensionless, (G,).
        approach_k: Inlet over supply air, K, (R,), that the airflow of the servers follows from
            unless it is given.
        fan_full_airflow_m3s: Airflow of one server at an airflow ratio of 1, m3/s; None is as
            configured, or else as follows from ``approach_k``.

    Raises:
        ConfigError: approach temperatures that leave no room for heating the air.
    """
    hall, curves, supply_c = config.hall, config.servers.curves, config.hall.design_supply_c
    full_load = np.ones(len(servers.count))
    ratio = curves.airflow_ratio(inlet_c, full_load)
    cpu_w = curves.cpu_w(inlet_c, full_load, servers.full_w, servers.idle_w)
    it_w = servers.per_rack(servers.count * (cpu_w + curves.fan_w(ratio)))
    rack_ratio = servers.per_rack(servers.count * ratio)
    air_j_per_m3_k = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
    full_m3s = fan_full_airflow_m3s or config.servers.fan_full_airflow_m3s
    if full_m3s is None:
        given_k = config.hall.rack_approach_k() if approach_k is None else approach_k
        rise_k = _server_rise_k(config, given_k, air_j_per_m3_k)
        full_m3s = float(np.mean(it_w / (air_j_per_m3_k * rack_ratio)) / rise_k)
    airflow_m3s = full_m3s * rack_ratio
    inlet_rise_k = servers.per_rack(servers.count * ratio * (inlet_c - supply_c)) / rack_ratio
    return DesignPoint(
        supply_c=supply_c,
        fan_full_airflow_m3s=full_m3s,
        crac_flow_m3s=config.hvac.crac.supply_m3s_per_w * float(it_w.sum()),
        it_w=it_w,
        airflow_m3s=airflow_m3s,
        approach_k=inlet_rise_k,
        outlet_rise_k=inlet_rise_k + it_w / (air_j_per_m3_k * airflow_m3s),
        height_factor=height_factor,
    )


def _inlet_c(servers: RackServers, supply_c: float, approach_k: F64, height_factor: F64) -> F64:
    """Inlet of each group, in C, (G,), from the approach temperature of its rack."""
    return np.asarray(supply_c + approach_k * height_factor + servers.inlet_offset_k)


def _height_factor(
    servers: RackServers, curves: ServerCurves, supply_c: float, approach_k: F64
) -> F64:
    """Height factors of the groups, scaled to average 1 over the airflow of each rack, (G,).

    Airflow depends on the inlet, which depends on the factors that airflow weights: the fixed point
    is found by repeated substitution.
    """
    full_load = np.ones(len(servers.count))
    factor = np.ones(len(servers.count))
    for _ in range(_MOST_HEIGHT_ITERATIONS):
        inlet_c = _inlet_c(servers, supply_c, approach_k, factor)
        airflow = servers.count * curves.airflow_ratio(inlet_c, full_load)
        mean = servers.per_rack(airflow * servers.height_factor) / servers.per_rack(airflow)
        before, factor = factor, servers.height_factor / servers.per_group(mean)
        if np.max(np.abs(factor - before)) < 1e-15:
            break
    return factor


def _server_rise_k(config: DataCenterConfig, approach_k: F64, air_j_per_m3_k: float) -> float:
    """Mean temperature rise through the servers that the approach temperatures leave, in K."""
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
