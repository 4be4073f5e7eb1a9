"""The hall kernel again, in plain NumPy f64, straight from the configuration.

Every server on its own, dense matrices over the racks, no groups, no offsets, no Taichi: an
independent way to the same numbers.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sdc_taichi import DataCenterConfig
from sdc_taichi.config import HallConfig
from sdc_taichi.config.hall_schema import ServerGroup
from sdc_taichi.exogenous import site_pressure_pa
from sdc_taichi.hall.rack_servers import rack_servers
from sdc_taichi.hall.recirculation import Recirculation, calibrate
from sdc_taichi.types import F64, I64


@dataclass(frozen=True)
class Twin:
    """Per server (S,), per rack (R,) and per data center (B,), racks and servers in file order."""

    servers: dict[str, F64]
    racks: dict[str, F64]
    dcs: dict[str, F64]


def line(x0: float, x1: float, y0: float, y1: float, x: F64) -> F64:
    """The straight line through (x0, y0) and (x1, y1), at x."""
    return np.asarray(y0 + (y1 - y0) / (x1 - x0) * (x - x0))


def through(points: Sequence[tuple[float, float, float]], inlet_c: F64, load: F64) -> F64:
    """The curve through (inlet, ratio at no load, ratio at full load), at inlet_c and load."""
    at_c, idle, full = np.array(points).T
    no_load = np.interp(inlet_c, at_c, idle)
    return np.asarray(no_load + load * (np.interp(inlet_c, at_c, full) - no_load))


def cpu_w(config: DataCenterConfig, full_w: F64, idle_w: F64, inlet_c: F64, load: F64) -> F64:
    """CPU power of one server, W (Sun et al. 2021: linear in inlet, shifted by load)."""
    s = config.servers
    if s.cpu_power_points is not None:
        ratio = through(s.cpu_power_points, inlet_c, load) + s.cpu_slope_offset_per_k * inlet_c
        return np.maximum(idle_w, full_w * ratio)
    ratio = line(
        *s.inlet_range_c, s.cpu_power_ratio_lb[0], s.cpu_power_ratio_ub[0], inlet_c
    ) + load * (s.cpu_power_ratio_lb[1] - s.cpu_power_ratio_lb[0])
    ratio = ratio + s.cpu_slope_offset_per_k * inlet_c
    return np.maximum(idle_w, full_w * ratio)


def airflow_ratio(config: DataCenterConfig, inlet_c: F64, load: F64) -> F64:
    """Server airflow over full airflow."""
    s = config.servers
    (low, high), shift = s.inlet_range_c, s.fan_airflow_ratio_lb[1] - s.fan_airflow_ratio_lb[0]
    if s.fan_airflow_points is not None:
        ratio = through(s.fan_airflow_points, inlet_c, load)
    elif s.fan_model == "linear":
        ratio = line(low, high, s.fan_airflow_ratio_lb[0], s.fan_airflow_ratio_ub[0], inlet_c)
        ratio = ratio + shift * load
    else:
        # The released code: 10 times the slope, 5 times the offset, one shift per 20 % of load.
        slope = (s.fan_airflow_ratio_ub[0] - s.fan_airflow_ratio_lb[0]) / (high - low)
        offset = s.fan_airflow_ratio_lb[0] - slope * low
        ratio = 10.0 * slope * inlet_c + 5.0 * offset + shift * (100.0 * load) / 20.0
    low, high = s.fan_airflow_ratio_limits or (0.0, np.inf)
    return np.asarray(np.clip(ratio, low, high))


_pressure_pa = functools.cache(site_pressure_pa)


def air_of(config: DataCenterConfig) -> tuple[float, float, float]:
    """rho cp of a site's air at 20 C, and its density at 0 C and its fall per K over that at 20 C.

    A line through the density of an ideal gas at 18 C and 32 C.
    """
    hall = config.hall
    if hall.air_density_kg_m3 is not None:
        return hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k, 1.0, 0.0
    pressure = _pressure_pa(config.site.location, config.site.weather_file)
    at = {t: 293.15 / (t + 273.15) for t in (18.0, 32.0)}
    fall = (at[18.0] - at[32.0]) / 14.0
    rho = pressure / (287.05 * 293.15)
    return rho * hall.air_heat_capacity_j_per_kg_k, at[18.0] + 18.0 * fall, fall


def reference_fan_w(config: DataCenterConfig, groups: Sequence[ServerGroup]) -> list[float]:
    """Fan power of a server of each group at the reference airflow ratio, W."""
    s = config.servers
    return [
        g.fan_w
        if g.fan_w is not None
        else s.fan_reference_w
        if s.fan_reference_w is not None
        else (s.fan_reference_share or 0.0) * g.full_w
        for g in groups
    ]


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
    fan_w = np.repeat(reference_fan_w(config, groups), count)
    fan = fan_w * (ratio / s.fan_reference_ratio) ** s.fan_power_exponent
    full_m3s = [g.full_airflow_m3s or s.fan_full_airflow_m3s for g in groups]
    assert None not in full_m3s, "this twin derives no airflow"
    heat, base, fall = air_of(config)
    flow = np.repeat(np.array(full_m3s, np.float64), count) * ratio * (base - fall * on_curve_c)
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
DRAUGHT = 0.02
"""Share of its full airflow by which a rack that is off loses heat, in transient halls."""


def _data_center(racks: list[dict[str, float]]) -> dict[str, float]:
    def of(name: str) -> F64:
        return np.array([rack[name] for rack in racks])

    return {
        "cpu_w": float(np.sum(of("cpu_w"))),
        "it_fan_w": float(np.sum(of("fan_w"))),
        "it_airflow_m3s": float(np.sum(of("airflow_m3s"))),
        "inlet_mean_c": float(np.mean(of("inlet_c"))),
        "inlet_max_c": float(np.max(of("inlet_max_c"))),
        "outlet_mean_c": float(np.mean(of("outlet_c"))),
    }


# --- recirculating halls ------------------------------------------------------------------------


@dataclass(frozen=True)
class HallTwin:
    """A calibrated recirculating hall, server by server (S,), with dense matrices over racks."""

    config: DataCenterConfig
    rack: I64
    """Rack of each server, (S,)."""
    full_w: F64
    idle_w: F64
    deviation: F64
    """Load weight over the rack's mean, less 1, (S,)."""
    captured: F64
    """Share of each server's intake that is exhaust air at the design point, (S,)."""
    weights: F64
    """w, (R, R)."""
    share: F64
    """r, (R,)."""
    fresh_share: float
    unit_shares: F64
    """(R, U)."""
    unit_design_m3s: F64
    full_m3s: F64
    """Airflow of each server at ratio 1, as volume at its inlet, (S,)."""
    fan_w: F64
    """Fan power of each server at the reference ratio, (S,)."""
    air_j_per_m3_k: float
    parcel_j_per_k: float
    """Room air before each rack."""
    need_m3s: F64 = field(default_factory=lambda: np.zeros(0))
    """Supply air that each rack takes in at the design point, (R,)."""

    def per_rack(self, values: F64) -> F64:
        """Sums over the servers of each rack, (R,)."""
        return np.asarray(np.bincount(self.rack, values, len(self.share)), dtype=np.float64)

    def load(self, rack_load: F64) -> F64:
        """Load of every server from that of its rack, (S,)."""
        u = rack_load[self.rack]
        return u + self.deviation * u * (1.0 - u)

    def servers(
        self, inlet_c: F64, load: F64, powered: F64, breath: F64, draught: float = 0.0
    ) -> tuple[F64, F64, F64]:
        """CPU power, fan power and airflow of every server, (S,) each.

        ``draught`` is the share of its full airflow that passes a server which is off.
        """
        s = self.config.servers
        limit_c = np.inf if s.curve_limit_c is None else s.curve_limit_c
        on_curve_c = np.minimum(inlet_c, limit_c)
        ratio = airflow_ratio(self.config, on_curve_c, load)
        fan = self.fan_w * (ratio / s.fan_reference_ratio) ** s.fan_power_exponent
        on, (_, base, fall) = powered[self.rack], air_of(self.config)
        if draught:
            _, high = s.fan_airflow_ratio_limits or (0.0, np.inf)
            ratio = np.where(on > 0, ratio, np.clip(ratio, 1.0, high))
        moved = ratio * (base - fall * on_curve_c)
        return (
            on * cpu_w(self.config, self.full_w, self.idle_w, on_curve_c, load),
            on * breath[self.rack] * fan,
            (on * breath[self.rack] + (1.0 - on) * draught) * self.full_m3s * moved,
        )


def heat_capacity_j_per_k(hall: HallTwin) -> F64:
    """Heat capacity of every server, (S,)."""
    given = hall.config.servers.heat_capacity_kj_per_k
    if given is not None:
        return np.full(len(hall.full_w), 1e3 * given)
    of_rack = 30.0 * hall.per_rack(hall.full_w)
    return 30.0 * hall.full_w * (np.minimum(of_rack, 410e3) / of_rack)[hall.rack]


def path_lengths_m(hall: HallConfig) -> F64:
    """Shortest way from the exhaust of rack i to the inlet of rack j, (R, R) as [j, i]."""
    m = hall.layout
    row_y = [0.0]
    for row in range(1, hall.rows):
        aisle = m.cold_aisle_m if row % 2 else m.hot_aisle_m
        row_y.append(row_y[-1] + m.rack_depth_m + aisle)
    x = np.tile((np.arange(hall.racks_per_row) + 0.5) * m.rack_pitch_m, hall.rows)
    y = np.repeat(row_y, hall.racks_per_row)
    facing = np.repeat([1 if row % 2 == 0 else -1 for row in range(hall.rows)], hall.racks_per_row)
    half = m.rack_depth_m / 2
    across = np.abs((y + facing * half)[:, None] - (y - facing * half))
    over = m.rack_height_m + np.hypot(x[:, None] - x, across)
    ends = (0.0, hall.racks_per_row * m.rack_pitch_m)
    around = np.min([np.abs(x - end) + np.abs(x - end)[:, None] for end in ends], axis=0) + across
    return np.asarray(np.minimum(over, around))


def layout_weights(hall: HallConfig, airflow: F64) -> F64:
    """w of the layout and the airflow of the racks, (R, R): rows sum to 1."""
    weight = np.exp(-path_lengths_m(hall) / hall.recirculation.decay_m)
    if hall.racks > 64:
        weight[weight < hall.recirculation.cutoff * _amid_the_hall(hall)] = 0.0
    weight = weight * airflow
    return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _amid_the_hall(hall: HallConfig) -> float:
    """Sum of the weights that a rack in the middle of the hall collects."""
    per_row, middle = hall.racks_per_row, hall.racks_per_row // 2
    sums = []
    for parity in (0, 1):
        # A hall with that row in its middle, extended by whole pairs of rows.
        before = hall.rows // 2
        shift = before + (before + parity) % 2
        wide = hall.model_copy(update={"rows": shift + hall.rows - before})
        d = path_lengths_m(wide)[shift * per_row + middle]
        d = d[(shift - before) * per_row :]
        sums.append(float(np.exp(-d / hall.recirculation.decay_m).sum()))
    return max(sums)


def _supply_shares(config: DataCenterConfig) -> F64:
    """Share of every CRAC unit in the supply of each rack, (R, U)."""
    hall, crac, m = config.hall, config.hvac.crac, config.hall.layout
    if crac.unit_shares is not None:
        return np.array(crac.unit_shares)
    length_m = hall.racks_per_row * m.rack_pitch_m + 2 * m.end_margin_m
    row_y = [m.side_margin_m + m.rack_depth_m / 2]
    for row in range(1, hall.rows):
        aisle = m.cold_aisle_m if row % 2 else m.hot_aisle_m
        row_y.append(row_y[-1] + m.rack_depth_m + aisle)
    width_m = row_y[-1] + m.rack_depth_m / 2 + m.side_margin_m
    out = np.empty((hall.racks, crac.units))
    for j in range(hall.racks):
        row, k = divmod(j, hall.racks_per_row)
        x = m.end_margin_m + (k + 0.5) * m.rack_pitch_m
        y = row_y[row] + (0.5 if row % 2 == 0 else -0.5) * m.rack_depth_m
        for u in range(crac.units):
            on_wall = len(range(u % 2, crac.units, 2))
            unit_y = (u // 2 + 0.5) * width_m / on_wall
            unit_x = length_m if u % 2 else 0.0
            out[j, u] = np.exp(-np.hypot(x - unit_x, y - unit_y) / crac.supply_length_m)
    return np.asarray(out / out.sum(axis=1, keepdims=True))


@functools.lru_cache(maxsize=128)
def calibrated(config: DataCenterConfig) -> HallTwin:
    """A hall at its design point, which tests of both precisions share."""
    return calibrated_to(config)


def calibrated_to(config: DataCenterConfig, matrix: F64 | None = None) -> HallTwin:
    """A hall at its design point; ``matrix`` is the R of a user's file."""
    hall, s = config.hall, config.servers
    racks = hall.racks
    columns: list[F64] = []
    for index, groups in enumerate(config.rack_groups()):
        count = [g.count for g in groups]
        weight = np.repeat([g.load_weight for g in groups], count)
        servers = len(weight)
        zones = min(hall.height_zones, servers)
        heights_u = np.repeat([g.height_u or 1.0 for g in groups], count)
        tops = np.concatenate([[0.0], np.cumsum(heights_u)])
        # Servers below the upper end of each zone, the last of them in part.
        ends = [
            round(float(np.interp(tops[-1] * (z + 1) / zones, tops, np.arange(servers + 1))))
            for z in range(zones)
        ]
        zone = np.array([next(z for z in range(zones) if n < ends[z]) for n in range(servers)])
        level = (2 * zone + 1) / zones - 1.0
        full_w, idle_w = (np.repeat([float(getattr(g, n)) for g in groups], count) for n in POWERS)
        columns.append(
            np.stack(
                [
                    np.full(servers, float(index)),
                    full_w,
                    idle_w,
                    weight / weight.mean() - 1.0,
                    1.0 + hall.height_gradient * level,
                    *(
                        np.repeat(values, count)
                        for values in (
                            [g.full_airflow_m3s or np.nan for g in groups],
                            [g.design_rise_k or np.nan for g in groups],
                            reference_fan_w(config, groups),
                        )
                    ),
                ]
            )
        )
    rows = np.concatenate(columns, axis=1)
    rack_number, full_w, idle_w, deviation, raw_height, given_m3s, rise_k, fan_w = rows
    rack = rack_number.astype(np.int64)
    air = air_of(config)[0]
    supply_c = config.hall.design_supply_c
    twin = HallTwin(
        config, rack, full_w, idle_w, deviation, raw_height, np.zeros((racks, racks)),
        np.zeros(racks), 1.0, _supply_shares(config), np.zeros(0), np.ones(len(rack)), fan_w, air,
        air * _air_m3(hall) / racks,
    )  # fmt: skip
    approach_k = np.broadcast_to(np.asarray(hall.supply_approach_k, np.float64), (racks,)).copy()
    load, on = np.ones(len(rack)), np.ones(racks)

    def full_airflow(inlet_c: F64, approach_k: F64) -> F64:
        """Airflow of every server at ratio 1, as volume at its inlet, (S,)."""
        cpu, fan, ratio = twin.servers(inlet_c, load, on, on)
        by_rise = (cpu + fan) / (air * rise_k * ratio)
        one_for_all = np.nan if s.fan_full_airflow_m3s is None else s.fan_full_airflow_m3s
        full = np.where(np.isnan(given_m3s), one_for_all, given_m3s)
        full = np.where(np.isnan(rise_k), full, by_rise)
        left = np.isnan(full)
        if left.any():
            crac_rise_k = 1.0 / (air * config.hvac.crac.supply_m3s_per_w)
            back_k = np.broadcast_to(np.asarray(hall.return_approach_k, np.float64), (racks,))
            mean_k = crac_rise_k - approach_k.mean() - back_k.mean()
            heat = twin.per_rack(left * (cpu + fan))
            moved = twin.per_rack(left * full_w * ratio)
            full[left] = np.mean(heat[heat > 0] / moved[heat > 0]) / (air * mean_k) * full_w[left]
        return full

    def design(approach_k: F64) -> tuple[F64, F64, F64, F64, F64]:
        """Height factor (S,), and airflow, IT power, outlet rise (R,), and full airflow (S,)."""
        height = raw_height
        for _ in range(60):
            inlet_c = supply_c + approach_k[rack] * height
            flow = full_airflow(inlet_c, approach_k) * twin.servers(inlet_c, load, on, on)[2]
            mean = twin.per_rack(flow * raw_height) / twin.per_rack(flow)
            before, height = height, raw_height / mean[rack]
            if np.array_equal(height, before):
                break
        inlet_c = supply_c + approach_k[rack] * height
        cpu, fan, ratio = twin.servers(inlet_c, load, on, on)
        full_m3s = full_airflow(inlet_c, approach_k)
        it_w, airflow = twin.per_rack(cpu + fan), twin.per_rack(full_m3s * ratio)
        mean_in_k = twin.per_rack(full_m3s * ratio * (inlet_c - supply_c)) / airflow
        return height, airflow, it_w, mean_in_k + it_w / (air * airflow), full_m3s

    scaled_to = hall.recirculation.scaled_to
    if matrix is None and scaled_to in ("row", "hall"):
        return _of_reference_hall(twin)
    parts = {"row": hall.rows, "hall": 1}.get(scaled_to, racks)
    if scaled_to != "none":
        approach_k = np.repeat(approach_k.reshape(parts, -1).mean(axis=1), racks // parts)
    exposed = np.ones(racks)
    if matrix is None:
        weights = layout_weights(hall, design(approach_k)[1])
    else:
        weights = matrix.copy()
        for j in range(racks):
            total = matrix[j].sum()
            weights[j] = matrix[j] / total if total > 0 else 1.0 / racks
        exposed = matrix.sum(axis=1)
    if scaled_to == "rack":
        height, airflow, it_w, rise, full_m3s = design(approach_k)
        share = approach_k / (weights @ rise)
    elif scaled_to != "none":
        wanted_k = approach_k
        for _ in range(40):
            height, airflow, it_w, rise, full_m3s = design(approach_k)
            share = shares_of_means(weights @ rise, exposed, wanted_k, parts)
            approach_k = share * (weights @ rise)
    else:
        assert matrix is not None
        share = matrix.sum(axis=1)
        for _ in range(30):
            height, airflow, it_w, rise, full_m3s = design(approach_k)
            approach_k = share * (weights @ rise)
    crac_m3s = config.hvac.crac.supply_m3s_per_w * float(it_w.sum())
    bypassed = max(0.0, 1.0 - float(((1.0 - share) * airflow).sum()) / crac_m3s)
    is_open = 1.0 - hall.layout.containment
    if hall.recirculation.approach_of == "hall" or (
        hall.recirculation.approach_of is None and scaled_to == "rack"
    ):
        is_open = 1.0
    captured = is_open * share[rack] * height
    for _ in range(60):
        inlet_c = supply_c + (weights @ rise)[rack] * captured
        cpu, fan, ratio = twin.servers(inlet_c, load, on, on)
        moved = twin.per_rack(full_m3s * ratio)
        rise = twin.per_rack(full_m3s * ratio * (inlet_c - supply_c) + (cpu + fan) / air) / moved
    fresh_m3s = twin.per_rack((1.0 - captured) * full_m3s * ratio)
    need = twin.unit_shares.T @ fresh_m3s
    return replace(
        twin,
        need_m3s=fresh_m3s,
        captured=captured,
        weights=weights,
        share=is_open * share,
        fresh_share=1.0 - is_open * bypassed,
        unit_design_m3s=need / (1.0 - is_open * bypassed),
        full_m3s=full_m3s,
    )


@functools.lru_cache(maxsize=128)
def _recirculation(config: DataCenterConfig) -> Recirculation:
    return calibrate(config)


def _of_reference_hall(twin: HallTwin) -> HallTwin:
    """A hall whose exhaust shares follow from a reference hall; test_exposure.py tests the shares.

    Weights, airflows and sums are those of the twin.
    """
    found = _recirculation(twin.config)
    count = rack_servers(twin.config).count.astype(np.int64)
    full_m3s = np.repeat(found.design.full_airflow_m3s, count)
    captured = np.repeat(found.group_exhaust_share, count)
    twin = replace(twin, full_m3s=full_m3s)
    load, on = np.ones(len(twin.rack)), np.ones(len(found.exhaust_share))
    supply_c, air = twin.config.hall.design_supply_c, twin.air_j_per_m3_k
    weights, rise = found.mix_weights.dense(), found.design.outlet_rise_k
    for _ in range(60):
        inlet_c = supply_c + (weights @ rise)[twin.rack] * captured
        cpu, fan, flow = twin.servers(inlet_c, load, on, on)
        moved = twin.per_rack(flow)
        rise = twin.per_rack(flow * (inlet_c - supply_c) + (cpu + fan) / air) / moved
    need_m3s = twin.per_rack((1.0 - captured) * flow)
    return replace(
        twin,
        need_m3s=need_m3s,
        captured=captured,
        weights=weights,
        share=found.exhaust_share,
        fresh_share=found.fresh_share,
        unit_design_m3s=twin.unit_shares.T @ need_m3s / found.fresh_share,
    )


def at_loads(hall: HallTwin, load: F64, powered: F64, breath: F64) -> HallTwin:
    """The hall with the exhaust shares of racks that work unlike, at a load of every server."""
    tiles = _recirculation(hall.config).tiles
    part = hall.full_m3s / hall.per_rack(hall.full_m3s)[hall.rack]
    rack_load = hall.per_rack(part * load)
    if max(np.ptp(rack_load), np.ptp(powered), np.ptp(breath)) < 1e-9:
        return hall
    airflow_m3s = tiles.airflow_m3s(rack_load) * powered * breath
    share = tiles.exhaust_share(airflow_m3s)
    ratio = np.divide(share, hall.share, out=np.zeros_like(share), where=hall.share > 0)
    return replace(hall, captured=hall.captured * ratio[hall.rack], share=share)


def shares_of_means(mix_k: F64, exposed: F64, wanted_k: F64, parts: int) -> F64:
    """k e / (1 + k e) whose mean warming of each part is as wanted, (R,), by bisection."""
    out = []
    for mix, e, goal in zip(
        *(v.reshape(parts, -1) for v in (mix_k, exposed, wanted_k)), strict=True
    ):
        low, high = 0.0, 1e6
        for _ in range(100):
            k = (low + high) / 2
            if np.mean(mix * k * e / (1 + k * e)) < goal[0]:
                low = k
            else:
                high = k
        out.append(low * e / (1 + low * e))
    return np.concatenate(out)


def _air_m3(hall: HallConfig) -> float:
    m = hall.layout
    aisles = sum(m.cold_aisle_m if row % 2 else m.hot_aisle_m for row in range(1, hall.rows))
    width_m = hall.rows * m.rack_depth_m + aisles + 2 * m.side_margin_m
    length_m = hall.racks_per_row * m.rack_pitch_m + 2 * m.end_margin_m
    rack_m3 = m.rack_pitch_m * m.rack_depth_m * m.rack_height_m
    return length_m * width_m * m.ceiling_m - hall.racks * rack_m3


def with_units_down(hall: HallTwin, running: F64) -> HallTwin:
    """The hall with unit shares that fit what its units give while some are down."""
    if running.all() or not running.any():
        return hall
    full = hall.unit_design_m3s
    coasting = hall.config.hvac.crac.coasting_flow_ratio * full * (1.0 - running)
    speed = (full.sum() - coasting.sum()) / (running @ full)
    given = coasting + min(speed, 1.0) * running * full
    given *= hall.need_m3s.sum() / given.sum()
    taken = hall.unit_shares * hall.need_m3s[:, None]
    for _ in range(200):
        if np.max(np.abs(given / taken.sum(axis=0) - 1.0)) < 1e-13:
            break
        taken = taken * (given / taken.sum(axis=0))
        taken *= (hall.need_m3s / taken.sum(axis=1))[:, None]
    return replace(hall, unit_shares=taken / hall.need_m3s[:, None])


@dataclass(frozen=True)
class Flows:
    """Where the air of a hall goes, m3/s."""

    unit: F64
    """Through each CRAC unit, (U,)."""
    speed: F64
    """Of its fan over full speed, (U,)."""
    need: F64
    """Supply air that the racks ask of each unit, (U,)."""
    fresh_ratio: F64
    """Share of its racks' need that a unit is able to cover, (U,)."""
    bypass: F64
    """From each unit past the racks, (U,)."""
    from_unit: F64
    """Share of each server's intake that a unit supplies, (S, U)."""
    exhaust: F64
    """Share of each server's intake that is exhaust, (S,)."""
    captured: F64
    """Exhaust that each rack takes in, (R,)."""


def flows(
    hall: HallTwin, airflow: F64, low: F64, high: F64, fresh_ratio: F64 | None = None
) -> Flows:
    """Mass balance for the airflow of every server; units cover what they can, or a given share."""
    unit_share = hall.unit_shares[hall.rack]
    fresh_need = (1.0 - hall.captured) * airflow
    need = fresh_need @ unit_share
    speed = np.clip(wanted_speed(hall, need), low, high)
    unit = hall.unit_design_m3s * speed
    offered = hall.fresh_share * unit
    able = np.where(need > offered, offered / np.where(need > 0, need, 1.0), 1.0)
    covered = able if fresh_ratio is None else fresh_ratio
    from_unit = (1.0 - hall.captured)[:, None] * unit_share * covered
    exhaust = 1.0 - from_unit.sum(axis=1)
    return Flows(
        unit, speed, need, able, unit - covered * need, from_unit, exhaust,
        hall.per_rack(airflow * exhaust),
    )  # fmt: skip


def wanted_speed(hall: HallTwin, need: F64) -> F64:
    """Fan speed of each unit over full speed that would just cover its racks' need, (U,)."""
    design = hall.fresh_share * hall.unit_design_m3s
    return np.where(design > 0, need / np.where(design > 0, design, 1.0), 0.0)


def mixing(hall: HallTwin, breath: F64) -> F64:
    """Share of each rack's exhaust in the mix before every other, (R, R): rows sum to 1.

    What failing fans lack of a rack's exhaust is made up from the mix before that rack, which may
    hold such air itself: mix = w (k outlet + (1 - k) mix).
    """
    missing = np.eye(len(breath)) - hall.weights * (1.0 - breath)
    return np.asarray(np.linalg.solve(missing, hall.weights * breath), dtype=np.float64)


def steady(
    hall: HallTwin,
    unit_supply_c: F64,
    load: F64,
    *,
    low: F64,
    high: F64,
    running: F64,
    powered: F64,
    breath: F64,
) -> Twin:
    """Temperatures that reproduce themselves, with a dense solve for the outlets in each round.

    Args:
        hall: the hall.
        unit_supply_c: supply air, (U,).
        load: load of every server, (S,).
        low: lowest fan speed of every unit, (U,).
        high: highest fan speed of every unit, (U,).
        running: 1 for units that run, 0 for those that coast, (U,).
        powered: share of the step that each rack is on, (R,).
        breath: airflow left to the fans of each rack, (R,).
    """
    racks, rack, air = len(hall.share), hall.rack, hall.air_j_per_m3_k
    count, mix = np.bincount(rack), mixing(hall, breath)
    inlet_c = np.full(len(rack), unit_supply_c.mean() + 4.0)
    setpoint_c, return_c = unit_supply_c, float(unit_supply_c.mean())
    for _ in range(20000):
        cpu, fan, flow = hall.servers(inlet_c, load, powered, breath)
        moved = flows(hall, flow, low, high)
        rack_flow = hall.per_rack(flow)
        still = rack_flow == 0
        part = np.where(still[rack], 1.0 / count[rack], 0.0)
        part += flow / np.where(still, 1.0, rack_flow)[rack]
        power = hall.per_rack(cpu + fan)
        rise = np.where(still, 0.0, power / (air * np.where(still, 1.0, rack_flow)))
        matrix = hall.per_rack(part * moved.exhaust)[:, None] * mix
        unit_supply_c = supply_by_unit(setpoint_c, running, return_c)
        supplied = moved.from_unit @ unit_supply_c
        outlet_c = np.linalg.solve(np.eye(racks) - matrix, hall.per_rack(part * supplied) + rise)
        before = inlet_c
        inlet_c = moved.exhaust * (mix @ outlet_c)[rack] + supplied
        outlets: F64 = np.asarray(outlet_c, dtype=np.float64)
        return_c, _ = return_air(hall, moved, rack_flow, outlets, unit_supply_c, breath)
        if np.max(np.abs(inlet_c - before)) < 1e-13 * np.max(np.abs(inlet_c)):
            break
    else:
        raise AssertionError("the twin finds no steady state")
    heat = cpu + fan
    blown = flow > 0
    server_outlet_c = inlet_c + np.where(blown, heat / (air * np.where(blown, flow, 1.0)), 0.0)
    return_c, _ = return_air(hall, moved, rack_flow, outlets, unit_supply_c, breath)
    supply_c = float(moved.unit @ unit_supply_c / moved.unit.sum())
    found = {
        "cpu_w": hall.per_rack(cpu),
        "fan_w": hall.per_rack(fan),
        "airflow_m3s": rack_flow,
        "inlet_c": hall.per_rack(part * inlet_c),
        "inlet_max_c": np.array([inlet_c[rack == j].max() for j in range(racks)]),
        "outlet_c": outlet_c,
    }
    dcs = {
        **_data_center([{k: float(v[j]) for k, v in found.items()} for j in range(racks)]),
        "over_27_sum_k": float(np.maximum(inlet_c - 27.0, 0.0).sum()),
        "under_18_sum_k": float(np.maximum(18.0 - inlet_c, 0.0).sum()),
        "inlet_m3k_s": float(flow @ (inlet_c - supply_c)),
        "outlet_m3k_s": float(rack_flow @ (outlet_c - supply_c)),
        "units_flow_m3s": float(moved.unit.sum()),
        "supply_c": supply_c,
        "units_return_c": return_c,
    }
    return Twin(
        {"inlet_c": inlet_c, "outlet_c": server_outlet_c, "power_w": heat},
        found,
        {name: np.array([value]) for name, value in dcs.items()}
        | {"unit_airflow_m3s": moved.unit}
        | {"cubed_flow_m3s": np.array([(running * moved.unit * moved.speed**2).sum()])},
    )


def supply_by_unit(setpoint_c: F64, running: F64, return_c: float) -> F64:
    """Supply air of each unit: units that are down pass on what returns, while any runs."""
    if not running.any():
        return setpoint_c
    return np.where(running > 0, setpoint_c, return_c)


def return_air(
    hall: HallTwin,
    moved: Flows,
    rack_flow: F64,
    outlet_c: F64,
    unit_supply_c: F64,
    breath: F64 | None = None,
) -> tuple[float, F64]:
    """Return temperature from what no rack takes back, and those flows, (R,)."""
    mix = hall.weights if breath is None else mixing(hall, breath)
    left_over = rack_flow - mix.T @ moved.captured
    warm = left_over @ outlet_c + moved.bypass @ unit_supply_c
    return float(warm / moved.unit.sum()), left_over


@dataclass(frozen=True)
class Memory:
    """What a transient hall remembers."""

    server_c: F64
    """(S,)."""
    mixed_c: F64
    """Recirculated air before each rack, (R,), as the next two."""
    given_c: F64
    """What each rack gives to the mixes: its outlet and, for air it does not move, its own mix."""
    captured_m3s: F64
    need_m3s: F64
    """Supply air that the racks would ask of each unit if all units ran, (U,)."""
    following: F64
    """Fan speed of each unit that would just cover their need, over full speed, (U,)."""
    room_j: float
    excess_k: F64
    """Air behind each coil over its setpoint and the warmth of the room, if the unit runs, (U,)."""
    casing_c: F64
    """Air in the casing of each unit, (U,)."""
    return_c: float
    """Air that comes back to the units."""


def advance(
    hall: HallTwin,
    memory: Memory,
    setpoint_c: F64,
    load: F64,
    *,
    low: F64,
    high: F64,
    running: F64,
    powered: F64,
    breath: F64,
    room_j_per_k: float,
    limit_w: float,
    fan_w_per_m3s: float,
    step_s: float,
    substeps: int,
) -> tuple[dict[str, Any], Memory]:
    """Means over a step and the memory at its end; arguments as in ``steady``."""
    h, air, s = step_s / substeps, hall.air_j_per_m3_k, hall.config.servers
    capacity = heat_capacity_j_per_k(hall)
    whole, casing_m3 = calibrated(hall.config), 0.3 * hall.unit_design_m3s
    of_part, of_whole = hall.need_m3s @ hall.unit_shares, hall.need_m3s @ whole.unit_shares
    is_drawn = of_part * of_whole > 0
    share_left = np.where(is_drawn, of_part, 1.0) / np.where(is_drawn, of_whole, 1.0)
    need = memory.need_m3s * share_left
    now, parts = replace(memory, need_m3s=need, following=wanted_speed(hall, need)), []
    for _ in range(substeps):
        coil_c = setpoint_c + now.room_j / room_j_per_k + now.excess_k
        coil_c = supply_by_unit(coil_c, running, now.return_c)
        emptied = hall.unit_design_m3s * np.clip(now.following, low, high) * h / casing_m3
        supply_c = coil_c - (now.casing_c - coil_c) * np.expm1(-emptied) / emptied
        casing_c = coil_c + (now.casing_c - coil_c) * np.exp(-emptied)
        casings_w = air * casing_m3 * (casing_c - now.casing_c) / h
        target = hall.weights @ now.given_c
        # A still parcel is stirred by its part of the CRAC air.
        units_m3s = hall.unit_design_m3s * np.clip(now.following, low, high)
        stirred = units_m3s.sum() / len(now.mixed_c) * air / hall.parcel_j_per_k
        rate = np.maximum(now.captured_m3s * air / hall.parcel_j_per_k, min(stirred, 1.0 / 128.0))
        mixed_end = target + (now.mixed_c - target) * np.exp(-rate * h)
        mixed = target + (now.mixed_c - mixed_end) / (rate * h)
        parcel_w = float(np.sum(mixed_end - now.mixed_c)) * hall.parcel_j_per_k / h
        # Airflow is not known before the inlets, so the units cover what was asked before.
        offered = hall.fresh_share * hall.unit_design_m3s * np.clip(now.following, low, high)
        asked = now.need_m3s > offered
        ratio = np.where(asked, offered / np.where(asked, now.need_m3s, 1.0), 1.0)
        covered = (1.0 - hall.captured)[:, None] * hall.unit_shares[hall.rack] * ratio
        inlet_c = (1.0 - covered.sum(axis=1)) * mixed[hall.rack] + covered @ supply_c
        cpu, fan, flow = hall.servers(inlet_c, load, powered, breath, DRAUGHT)
        moved = flows(hall, flow, low, high, ratio)
        k = s.heat_exchange_effectiveness * air * flow
        blown = k > 0
        tau = capacity / np.where(blown, k, 1.0)
        final = inlet_c + cpu / np.where(blown, k, 1.0)
        gone = -np.expm1(-h / tau)
        mean_c = final + (now.server_c - final) * gone * tau / h
        to_air = np.where(blown, k * (mean_c - inlet_c), 0.0)
        warmer = np.where(blown, now.server_c + (final - now.server_c) * gone, now.server_c)
        # Without air a server keeps its temperature: it draws nothing then.
        rack_flow = hall.per_rack(flow)
        still = rack_flow == 0
        count = np.bincount(hall.rack)
        carried = hall.per_rack(flow * inlet_c + (to_air + fan) / air)
        plain = hall.per_rack(inlet_c) / count
        outlet_c = np.where(still, plain, carried / np.where(still, 1.0, rack_flow))
        warmed_k = s.heat_exchange_effectiveness * (warmer - inlet_c)
        warmed_k += fan / (air * np.where(blown, flow, 1.0))
        server_outlet_c = inlet_c + np.where(blown, warmed_k, 0.0)
        hottest_c = np.full(len(rack_flow), -np.inf)
        np.maximum.at(hottest_c, hall.rack, server_outlet_c)
        inflow = hall.per_rack(flow * inlet_c) / np.where(still, 1.0, rack_flow)
        rack_inlet = np.where(still, plain, inflow)
        captured = hall.per_rack(flow * moved.exhaust)
        passed_c = rack_inlet + DRAUGHT * (outlet_c - rack_inlet)
        given_c = np.where(powered > 0, outlet_c, passed_c)
        warm = rack_flow @ outlet_c - captured @ mixed - parcel_w / air
        return_c = float((warm + moved.bypass @ supply_c) / moved.unit.sum())
        taken = air * moved.unit * (return_c - supply_c) - casings_w
        drawn = running * moved.speed**3 * fan_w_per_m3s * hall.unit_design_m3s
        load_w = float(np.sum(taken + drawn))
        warmth = moved.unit @ supply_c / moved.unit.sum()
        wanted = float(running @ (taken + drawn)) + (now.room_j / h if running.any() else 0.0)
        coil_w = min(max(wanted, 0.0), limit_w)
        parts.append(
            {
                "cpu_w": cpu.sum(), "it_fan_w": fan.sum(),
                "it_airflow_m3s": flow.sum(),
                "inlet_mean_c": rack_inlet.mean(), "outlet_mean_c": outlet_c.mean(),
                "inlet_m3k_s": flow @ (inlet_c - warmth),
                "over_27_sum_k": np.maximum(inlet_c - 27, 0).sum(),
                "under_18_sum_k": np.maximum(18 - inlet_c, 0).sum(),
                "outlet_m3k_s": carried.sum() - rack_flow.sum() * warmth,
                "thermal_storage_w": np.sum(capacity * (warmer - now.server_c)) / h
                + parcel_w + casings_w.sum(),
                "units_flow_m3s": moved.unit.sum(),
                "supply_c": warmth, "units_return_c": return_c,
                "units_load_w": load_w, "coil_w": coil_w,
                "unit_airflow_m3s": moved.unit,
                "cubed_flow_m3s": (running * moved.unit * moved.speed**2).sum(),
                "rack_cpu_w": hall.per_rack(cpu), "rack_fan_w": hall.per_rack(fan),
                "rack_airflow_m3s": rack_flow, "rack_inlet_c": rack_inlet,
                "rack_outlet_c": outlet_c,
                "inlet_max_c": inlet_c.max(), "rack_outlet_max_c": hottest_c,
            }
        )  # fmt: skip
        room_j = now.room_j + (load_w - coil_w) * h
        now = Memory(
            warmer, mixed_end, mixed + breath * (given_c - mixed), captured, moved.need,
            wanted_speed(hall, moved.need),
            room_j, np.zeros(len(setpoint_c)), casing_c, return_c,
        )  # fmt: skip
    found: dict[str, Any] = {}
    for name in parts[0]:
        values = np.array([p[name] for p in parts])
        found[name] = values.max(axis=0) if name.endswith("_max_c") else sum(values) / substeps
    return found, replace(now, need_m3s=now.need_m3s / share_left)
