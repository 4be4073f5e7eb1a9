"""Server groups of the racks of a hall as flat arrays, cut where servers meet different air."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.types import F64, I32


@dataclass(frozen=True, slots=True)
class RackServers:
    """Server groups of a hall of R racks and G groups, cut at the height zones.

    The servers of a group are alike and meet the same air.
    """

    group_offsets: I32
    """First group of each rack, and the number of groups, (R + 1,)."""
    count: F64
    """Servers of each group, (G,)."""
    full_w: F64
    """CPU power of one server at full load and a power ratio of 1, in W, (G,)."""
    idle_w: F64
    """Lowest CPU power of one server, in W, (G,)."""
    inlet_offset_k: F64
    """Inlet of each group over the inlet of its rack, in K, (G,)."""
    load_deviation: F64
    """Load weight of each group over the mean of its rack, less 1, (G,)."""
    height_factor: F64
    """Exhaust share of the intake of each group over that of its rack, by height, (G,). Its mean
    over the airflow of a rack is near 1."""

    def per_rack(self, values: F64) -> F64:
        """Sum of group values, (G,), over each rack, (R,)."""
        return np.add.reduceat(values, self.group_offsets[:-1])

    def per_group(self, values: F64) -> F64:
        """Rack values, (R,), repeated for each group, (G,)."""
        return np.repeat(values, np.diff(self.group_offsets))


def rack_servers(config: DataCenterConfig) -> RackServers:
    """Server groups of every rack of a hall.

    Servers fill a rack from the floor in the order in which its groups are listed. With inlet model
    ``recirculation`` groups are cut at the height zones.
    """
    hall = config.hall
    zones = hall.height_zones if hall.inlet_model == "recirculation" else 1
    columns: dict[Any, F64] = {}
    racks = []
    for rack in config.rack_groups():
        key = tuple((g.count, g.full_w, g.idle_w, g.load_weight, g.inlet_offset_k) for g in rack)
        if key not in columns:
            columns[key] = _rack_columns(np.array(key, dtype=np.float64), zones)
        racks.append(columns[key])
    count, full_w, idle_w, deviation, offset_k, level = np.concatenate(racks, axis=1)
    return RackServers(
        group_offsets=np.concatenate([[0], np.cumsum([r.shape[1] for r in racks])]).astype(
            np.int32
        ),
        count=count,
        full_w=full_w,
        idle_w=idle_w,
        inlet_offset_k=offset_k,
        load_deviation=deviation,
        height_factor=1.0 + hall.height_gradient * level,
    )


def _rack_columns(groups: F64, zones: int) -> F64:
    """Groups of one rack, cut at its height zones, (6, cut groups).

    Args:
        groups: count, full power, idle power, load weight and inlet offset, (groups, 5).
        zones: height zones of the rack.

    Returns:
        Rows count, full power, idle power, load deviation, inlet offset, and level from -1 at the
        floor to 1 at the top.
    """
    count, full_w, idle_w, weight, offset_k = groups.T
    deviation = weight / (np.sum(count * weight) / np.sum(count)) - 1.0
    servers = int(count.sum())
    zones = min(zones, servers)
    zone_ends = np.rint(np.arange(1, zones + 1) * servers / zones)
    ends = np.unique(np.concatenate([zone_ends, np.cumsum(count)]))
    begins = np.concatenate([[0.0], ends[:-1]])
    group = np.searchsorted(np.cumsum(count), begins, side="right")
    zone = np.searchsorted(zone_ends, begins, side="right")
    level = (2.0 * zone + 1.0) / zones - 1.0
    return np.stack(
        [ends - begins, full_w[group], idle_w[group], deviation[group], offset_k[group], level]
    )
