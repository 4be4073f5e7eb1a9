"""Server groups of the racks of a hall as flat arrays, split at the boundaries of height zones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.config.hall_schema import ServerConfig, ServerGroup
from sdc_taichi.exogenous.registry import site_pressure_pa
from sdc_taichi.plant.air import CONSTANT, OF_IDEAL_GAS, REFERENCE_C, DensityRatio, density_kg_m3
from sdc_taichi.types import F64, I32


class AirProperties(NamedTuple):
    """Properties of a hall's air; airflows are volume flows at REFERENCE_C and site pressure."""

    density_kg_m3: float
    """Density at REFERENCE_C, in kg/m3."""
    j_per_m3_k: float
    """Volumetric heat capacity rho cp at REFERENCE_C, in J/(m3 K)."""
    density_ratio: DensityRatio
    """Density divided by its value at REFERENCE_C, as a function of temperature."""


def air_properties(config: DataCenterConfig) -> AirProperties:
    """Return density and heat capacity of the air of a hall.

    A configured density applies at all temperatures. Without one, the density follows from the
    height of the site above sea level and from the temperature.

    Raises:
        DataError: The site or weather file does not state the height above sea level.
    """
    hall, site = config.hall, config.site
    configured = hall.air_density_kg_m3
    if configured is not None:
        return AirProperties(configured, configured * hall.air_heat_capacity_j_per_kg_k, CONSTANT)
    density = density_kg_m3(site_pressure_pa(site.location, site.weather_file), REFERENCE_C)
    return AirProperties(density, density * hall.air_heat_capacity_j_per_kg_k, OF_IDEAL_GAS)


@dataclass(frozen=True, slots=True)
class RackServers:
    """Servers of a hall of R racks in G groups, split at height zones, and their air.

    All servers of a group are identical and take in air of the same temperature.
    """

    group_offsets: I32
    """Index of the first group of each rack, and the number of groups, (R + 1,)."""
    count: F64
    """Number of servers of each group, (G,)."""
    full_w: F64
    """CPU power of one server at full load where its power curve has the value 1, in W, (G,)."""
    idle_w: F64
    """Lowest CPU power of one server, in W, (G,)."""
    inlet_offset_k: F64
    """Configured inlet temperature of each group minus that of its rack, in K, (G,)."""
    load_deviation: F64
    """Load weight of each group divided by the mean of its rack, minus 1, (G,)."""
    full_airflow_m3s: F64
    """Configured airflow of one server at an airflow ratio of 1, in m3/s, (G,); NaN where it
    follows from the design point."""
    design_rise_k: F64
    """Configured temperature rise of the air through one server at the design point, in K, (G,);
    NaN where none is configured."""
    fan_reference_w: F64
    """Fan power of one server at the reference airflow ratio, in W, (G,)."""
    height_factor: F64
    """Share of exhaust air in the intake of each group divided by that of its rack, (G,). It
    depends on height, and its airflow-weighted mean in a rack is close to 1."""
    air: AirProperties
    """Properties of the air that the servers take in."""

    def per_rack(self, values: F64) -> F64:
        """Return the sum of group values, (G,), for each rack, (R,)."""
        return np.add.reduceat(values, self.group_offsets[:-1])

    def per_group(self, values: F64) -> F64:
        """Return the value of each group's rack, (G,), from rack values, (R,)."""
        return np.repeat(values, np.diff(self.group_offsets))


def rack_servers(config: DataCenterConfig) -> RackServers:
    """Return the server groups of every rack of a hall.

    Servers fill a rack from the floor up, in the order in which the configuration lists its groups.
    With inlet model ``recirculation``, groups are split at the boundaries of height zones.

    Raises:
        ConfigError: The capacity leaves racks without servers.
        DataError: The site or weather file does not state the height above sea level.
    """
    hall = config.hall
    zones = hall.height_zones if hall.inlet_model == "recirculation" else 1
    columns: dict[Any, F64] = {}
    racks = []
    for rack in config.rack_groups():
        key = tuple(_values(group, config.servers) for group in rack)
        if key not in columns:
            columns[key] = _rack_columns(np.array(key, dtype=np.float64), zones)
        racks.append(columns[key])
    rows = np.concatenate(racks, axis=1)
    count, full_w, idle_w, deviation, offset_k, airflow_m3s, rise_k, fan_w, level = rows
    return RackServers(
        group_offsets=np.concatenate([[0], np.cumsum([r.shape[1] for r in racks])]).astype(
            np.int32
        ),
        count=count,
        full_w=full_w,
        idle_w=idle_w,
        inlet_offset_k=offset_k,
        load_deviation=deviation,
        full_airflow_m3s=airflow_m3s,
        design_rise_k=rise_k,
        fan_reference_w=fan_w,
        height_factor=1.0 + hall.height_gradient * level,
        air=air_properties(config),
    )


def even_servers(
    servers: RackServers, full_airflow_m3s: F64, rack_kw: float | None = None
) -> RackServers:
    """Return the servers of a hall of the same total power and airflow whose racks are all alike.

    Args:
        servers: Servers of the hall; returned themselves if its racks are alike and ``rack_kw`` is
            None.
        full_airflow_m3s: Airflow of one server of each group at an airflow ratio of 1, m3/s, (G,).
        rack_kw: Power of the servers of a rack at full load, without fans, kW; None keeps the mean
            of the hall.
    """
    racks, groups = len(servers.group_offsets) - 1, np.diff(servers.group_offsets)
    columns = [
        getattr(servers, name)
        for name in ("count", "full_w", "idle_w", "inlet_offset_k", "load_deviation")
    ]
    columns += [servers.full_airflow_m3s, servers.design_rise_k, servers.fan_reference_w]
    columns += [servers.height_factor]
    if rack_kw is None and np.all(groups == groups[0]):
        by_rack = np.stack(columns).reshape(len(columns), racks, -1)
        if np.array_equal(by_rack, np.broadcast_to(by_rack[:, :1], by_rack.shape), equal_nan=True):
            return servers
    total = servers.count.sum()
    scale = 1.0
    if rack_kw is not None:
        scale = 1e3 * rack_kw * racks / float(np.sum(servers.count * servers.full_w))
    full_w, idle_w, fan_w, airflow_m3s = (
        scale * float(np.sum(servers.count * values)) / total
        for values in (servers.full_w, servers.idle_w, servers.fan_reference_w, full_airflow_m3s)
    )
    # The levels of the height factors, one group for each.
    level, of_group = np.unique(servers.height_factor, return_inverse=True)
    count = np.bincount(of_group, servers.count) / racks
    each = racks * len(level)
    return RackServers(
        group_offsets=np.arange(racks + 1, dtype=np.int32) * np.int32(len(level)),
        count=np.tile(count, racks),
        full_w=np.full(each, full_w),
        idle_w=np.full(each, idle_w),
        inlet_offset_k=np.zeros(each),
        load_deviation=np.zeros(each),
        full_airflow_m3s=np.full(each, airflow_m3s),
        design_rise_k=np.full(each, np.nan),
        fan_reference_w=np.full(each, fan_w),
        height_factor=np.tile(level, racks),
        air=servers.air,
    )


def _values(group: ServerGroup, servers: ServerConfig) -> tuple[float | None, ...]:
    """Return the properties of a group in the order that ``_rack_columns`` requires.

    A value of None stands for a property that is not configured.
    """
    airflow_m3s = group.full_airflow_m3s
    if airflow_m3s is None and group.design_rise_k is None:
        airflow_m3s = servers.fan_full_airflow_m3s
    fan_w = group.fan_w
    if fan_w is None:
        share = servers.fan_reference_share
        fan_w = servers.fan_reference_w if share is None else share * group.full_w
    return (
        *(group.count, group.full_w, group.idle_w, group.load_weight, group.inlet_offset_k),
        *(airflow_m3s, group.design_rise_k, fan_w, group.height_u or 1.0),
    )


def _rack_columns(groups: F64, zones: int) -> F64:
    """Split the groups of one rack at its height zones, (9, number of groups after the split).

    Args:
        groups: Properties of the groups, (groups, 9): count, full power, idle power, load weight,
            inlet offset, full airflow, design rise, fan power, and height of a server.
        zones: Number of height zones of the rack.

    Returns:
        Rows with count, full power, idle power, load deviation, inlet offset, full airflow, design
        rise, fan power, and level, which is -1 at the floor and 1 at the top of the rack.
    """
    count, weight, height_u = groups[:, 0], groups[:, 3], groups[:, 8]
    listed = groups.T[:8].copy()
    listed[3] = weight / (np.sum(count * weight) / np.sum(count)) - 1.0
    servers = int(count.sum())
    zones = min(zones, servers)
    # Compute the number of servers below the upper end of each zone.
    tops_u = np.concatenate([[0.0], np.cumsum(count * height_u)])
    numbers = np.concatenate([[0.0], np.cumsum(count)])
    zone_ends = np.rint(np.interp(np.arange(1, zones + 1) * tops_u[-1] / zones, tops_u, numbers))
    ends = np.unique(np.concatenate([zone_ends, numbers[1:]]))
    ends = ends[ends > 0.0]
    begins = np.concatenate([[0.0], ends[:-1]])
    group = np.searchsorted(numbers[1:], begins, side="right")
    zone = np.searchsorted(zone_ends, begins, side="right")
    level = (2.0 * zone + 1.0) / zones - 1.0
    return np.stack([ends - begins, *listed[1:, group], level])
