"""The thermal kernel again, in plain NumPy f64, straight from the configuration.

Every server on its own, no groups, no offsets, no Taichi: an independent way to the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdc_taichi import DataCenterConfig
from sdc_taichi.types import F64


@dataclass(frozen=True)
class Twin:
    """Per server (S,), per rack (R,) and per data center (B,), racks and servers in file order."""

    servers: dict[str, F64]
    racks: dict[str, F64]
    dcs: dict[str, F64]


def line(x0: float, x1: float, y0: float, y1: float, x: F64) -> F64:
    """The straight line through (x0, y0) and (x1, y1), at x."""
    return np.asarray(y0 + (y1 - y0) / (x1 - x0) * (x - x0))


def cpu_w(config: DataCenterConfig, full_w: F64, idle_w: F64, inlet_c: F64, load: F64) -> F64:
    """CPU power of one server, W (Sun et al. 2021: linear in inlet, shifted by load)."""
    s = config.servers
    ratio = line(
        *s.inlet_range_c, s.cpu_power_ratio_lb[0], s.cpu_power_ratio_ub[0], inlet_c
    ) + load * (s.cpu_power_ratio_lb[1] - s.cpu_power_ratio_lb[0])
    ratio = ratio + s.cpu_slope_offset_per_k * inlet_c
    return np.maximum(idle_w, full_w * ratio)


def airflow_ratio(config: DataCenterConfig, inlet_c: F64, load: F64) -> F64:
    """Server airflow over full airflow."""
    s = config.servers
    (low, high), shift = s.inlet_range_c, s.fan_airflow_ratio_lb[1] - s.fan_airflow_ratio_lb[0]
    if s.fan_model == "linear":
        ratio = line(low, high, s.fan_airflow_ratio_lb[0], s.fan_airflow_ratio_ub[0], inlet_c)
        ratio = ratio + shift * load
    else:
        # The released code: 10 times the slope, 5 times the offset, one shift per 20 % of load.
        slope = (s.fan_airflow_ratio_ub[0] - s.fan_airflow_ratio_lb[0]) / (high - low)
        offset = s.fan_airflow_ratio_lb[0] - slope * low
        ratio = 10.0 * slope * inlet_c + 5.0 * offset + shift * (100.0 * load) / 20.0
    if s.fan_airflow_ratio_limits is not None:
        ratio = np.clip(ratio, *s.fan_airflow_ratio_limits)
    return np.asarray(ratio)


def evaluate(configs: Sequence[DataCenterConfig], supply_c: F64, utilisation: F64) -> Twin:
    """Temperatures and power of every server at the given supply air and load."""
    servers: list[dict[str, F64]] = []
    racks: list[dict[str, float]] = []
    dcs: list[dict[str, float]] = []
    for config, supply, u in zip(configs, supply_c, utilisation, strict=True):
        found = [_rack(config, i, supply, u) for i in range(config.hall.racks)]
        servers += [s for s, _ in found]
        racks += [r for _, r in found]
        dcs.append(_data_center([r for _, r in found]))
    return Twin(
        {name: np.concatenate([s[name] for s in servers]) for name in servers[0]},
        {name: np.array([r[name] for r in racks]) for name in racks[0]},
        {name: np.array([d[name] for d in dcs]) for name in dcs[0]},
    )


def _rack(
    config: DataCenterConfig, index: int, supply_c: float, utilisation: float
) -> tuple[dict[str, F64], dict[str, float]]:
    hall, s = config.hall, config.servers
    approach = hall.supply_approach_k
    approach_k = approach[index] if isinstance(approach, tuple) else approach
    if hall.supply_approach_limits_k is not None:
        approach_k = float(np.clip(approach_k, *hall.supply_approach_limits_k))
    groups = config.rack_groups()[index]
    count = [g.count for g in groups]
    weight = np.repeat([g.load_weight for g in groups], count)
    # A heavier share shows at partial load alone: idle and full racks load all servers alike.
    load = utilisation + (weight / weight.mean() - 1.0) * utilisation * (1.0 - utilisation)
    inlet_c = supply_c + approach_k + np.repeat([g.inlet_offset_k for g in groups], count)
    full_w, idle_w = (np.repeat([getattr(g, n) for g in groups], count) for n in POWERS)
    on_curve_c = np.minimum(inlet_c, np.inf if s.curve_limit_c is None else s.curve_limit_c)
    cpu = cpu_w(config, full_w, idle_w, on_curve_c, load)
    ratio = airflow_ratio(config, on_curve_c, load)
    fan = s.fan_reference_w * (ratio / s.fan_reference_ratio) ** s.fan_power_exponent
    flow = s.fan_full_airflow_m3s * ratio
    heat = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
    power, total_flow, mean_inlet = np.sum(cpu + fan), np.sum(flow), np.mean(inlet_c)
    if s.outlet_model == "server":
        outlet_c = inlet_c + (cpu + fan) / (heat * flow)
        rack_outlet_c = np.sum(flow * outlet_c) / total_flow
    elif s.outlet_model == "rack":
        rack_outlet_c = mean_inlet + power / (heat * total_flow)
        outlet_c = np.full(len(inlet_c), rack_outlet_c)
    else:
        lift = 1.918 * power**1.096 / (0.526 * heat * total_flow**0.824) - 14.01
        rack_outlet_c = mean_inlet + lift
        outlet_c = np.full(len(inlet_c), rack_outlet_c)
    return (
        {"inlet_c": inlet_c, "outlet_c": outlet_c, "power_w": cpu + fan},
        {
            "cpu_w": float(np.sum(cpu)),
            "fan_w": float(np.sum(fan)),
            "airflow_m3s": float(total_flow),
            "inlet_c": float(mean_inlet),
            "inlet_max_c": float(np.max(inlet_c)),
            "outlet_c": float(rack_outlet_c),
        },
    )


POWERS = ("full_w", "idle_w")


def _data_center(racks: list[dict[str, float]]) -> dict[str, float]:
    def of(name: str) -> F64:
        return np.array([rack[name] for rack in racks])

    return {
        "cpu_w": float(np.sum(of("cpu_w"))),
        "fan_w": float(np.sum(of("fan_w"))),
        "airflow_m3s": float(np.sum(of("airflow_m3s"))),
        "inlet_mean_c": float(np.mean(of("inlet_c"))),
        "inlet_max_c": float(np.max(of("inlet_max_c"))),
        "outlet_mean_c": float(np.mean(of("outlet_c"))),
    }
