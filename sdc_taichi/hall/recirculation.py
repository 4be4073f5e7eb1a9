"""Heat recirculation: which rack breathes whose exhaust, and how much.

With R_ji the share of rack j's intake that is rack i's exhaust,

    T_in,j = (1 - r_j) T_sup + sum_i R_ji T_out,i,    R_ji = r_j w_ji,  sum_i w_ji = 1

(Tang, Gupta and Varsamopoulos 2008, *Energy-efficient thermal-aware task scheduling for homogeneous
high-performance computing data centers*, IEEE TPDS 19(11)). The weights w fall with the length of
the path from exhaust face to inlet face, over the racks or around the ends of the rows; the shares
r are such that the given approach temperatures come out exactly at the design point.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig, HallConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.floor_plan import floor_plan, row_distance_m
from sdc_taichi.types import F64, I32

DENSE_RACKS = 64
"""Halls up to this size keep every weight; larger ones drop those below the cutoff."""
MERGED_RACKS_PER_ROW = 64
"""Rows up to this length are summed whole, rows beside each other in one go."""
MOST_MATRIX_RACKS = 8192
"""Largest hall with a matrix of the user's: half a gigabyte in f64."""
MOST_WEIGHTS = 2**27
"""Weights, or runs of them, that a hall may keep: a gigabyte in f64."""


@dataclass(frozen=True, slots=True)
class RackServers:
    """Server groups of a hall of R racks and G groups, cut at the height zones."""

    start: I32
    """First group of each rack, (R + 1,)."""
    count: F64
    """(G,), as all that follow."""
    full_w: F64
    idle_w: F64
    offset_k: F64
    deviation: F64
    """Load over the rack's mean load, less 1."""
    height: F64
    """Recirculated share of the intake over that of the rack, before it is made to average 1."""

    def per_rack(self, values: F64) -> F64:
        """Sum of group values over each rack, (R,)."""
        return np.add.reduceat(values, self.start[:-1])

    def per_group(self, values: F64) -> F64:
        """Rack values for each group, (G,)."""
        return np.repeat(values, np.diff(self.start))


@dataclass(frozen=True, slots=True)
class DesignPoint:
    """Full load at the highest setpoint; each (R,) unless stated."""

    supply_c: float
    fan_full_airflow_m3s: float
    """Of one server, as given or as the approach temperatures close on."""
    crac_flow_m3s: float
    it_w: F64
    airflow_m3s: F64
    approach_k: F64
    """Airflow-weighted mean inlet over supply."""
    outlet_rise_k: F64
    """Mean outlet over supply."""
    height: F64
    """Recirculated share of the intake of each group over that of its rack, (G,)."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """Weights w as runs of neighbouring racks.

    (w x)_j = norm_j * sum of weights[offset + i] * strength[first + i] * x[first + i] over the runs
    of rack j and i below their length. Racks that see the same surroundings share their weights.
    """

    run_start: I32
    """First run of each rack, (R + 1,)."""
    first: I32
    """First source rack of each run."""
    length: I32
    offset: I32
    """First weight of each run."""
    weights: F64
    strength: F64
    """Exhaust airflow of each rack over the mean, 1 where the weights hold it as those of a user's
    matrix do, (R,)."""
    norm: F64
    """(R,)."""

    def apply(self, values: F64) -> F64:
        """The product w x, (R,)."""
        out, strong = np.zeros(len(self.norm)), values * self.strength
        for racks, sources, weights in self._slices():
            out += np.bincount(racks, weights * strong[sources], len(out))
        return out * self.norm

    def apply_transposed(self, values: F64) -> F64:
        """The product of the transposed w and x, (R,)."""
        out = np.zeros(len(self.norm))
        scaled = values * self.norm
        for racks, sources, weights in self._slices():
            out += np.bincount(sources, weights * scaled[racks], len(out))
        return out * self.strength

    def dense(self) -> F64:
        """w, (R, R)."""
        racks = len(self.norm)
        out = np.zeros((racks, racks))
        for rows, sources, weights in self._slices():
            out[rows, sources] += weights
        return np.asarray(out * self.strength * self.norm[:, None])

    def _slices(self) -> Iterator[tuple[Any, Any, F64]]:
        """Entries (row, column, weight), one position within the runs at a time."""
        rack = np.repeat(np.arange(len(self.norm)), np.diff(self.run_start))
        # Longest first, so that the runs that go on are the first ones.
        order = np.argsort(-self.length, kind="stable")
        rack, first, offset = rack[order], self.first[order], self.offset[order]
        going_on = len(order) - np.cumsum(np.bincount(self.length))
        for i, runs in enumerate(going_on[:-1].tolist()):
            yield rack[:runs], first[:runs] + i, self.weights[offset[:runs] + i]


@dataclass(frozen=True, slots=True)
class Recirculation:
    """Calibrated recirculation of a hall."""

    exchange: Exchange
    share: F64
    """Share of each rack's intake that is exhaust air, r, with containment, (R,)."""
    captured: F64
    """The same for each server group, by height, (G,)."""
    fresh_share: float
    """Share of CRAC air that reaches inlets at the design point; the rest bypasses them."""
    approach_k: F64
    """Mean inlet over supply of each rack at the design point, below ``design.approach_k`` where
    containment closes paths, (R,)."""
    design: DesignPoint
    """Of the open hall."""

    def matrix(self) -> F64:
        """R in receptor form, (R, R)."""
        return np.asarray(self.share[:, None] * self.exchange.dense())


def rack_servers(config: DataCenterConfig) -> RackServers:
    """Server groups of every rack. With recirculation they are cut at the height zones.

    Servers fill a rack from the floor in the order in which its groups are listed.
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
    groups = np.concatenate(racks, axis=1)
    count, full_w, idle_w, deviation, offset_k, level = groups
    return RackServers(
        start=np.concatenate([[0], np.cumsum([r.shape[1] for r in racks])]).astype(np.int32),
        count=count,
        full_w=full_w,
        idle_w=idle_w,
        offset_k=offset_k,
        deviation=deviation,
        height=1.0 + hall.height_gradient * level,
    )


def _rack_columns(groups: F64, zones: int) -> F64:
    """Columns count, full, idle, deviation, offset, level (-1 floor .. 1 top) of one rack."""
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


def design_point(
    config: DataCenterConfig, groups: RackServers | None = None, approach_k: F64 | None = None
) -> DesignPoint:
    """Power, airflow and temperatures of every rack at full load and the highest setpoint.

    Args:
        config: the data center.
        groups: its ``rack_servers``, if at hand.
        approach_k: inlet over supply, (R,); None is as given in the config.

    Raises:
        ConfigError: approach temperatures that leave no room for heating the air.
    """
    groups = rack_servers(config) if groups is None else groups
    approach_k = config.hall.rack_approach_k() if approach_k is None else approach_k
    hall, supply_c = config.hall, config.hvac.setpoint.max_c
    curves = config.servers.curves
    approach = groups.per_group(approach_k)
    one = np.ones(len(groups.count))

    def inlets_c(height: F64) -> F64:
        return np.asarray(supply_c + approach * height + groups.offset_k)

    height = np.ones(len(groups.count))
    if hall.inlet_model == "recirculation":
        # Airflow depends on the inlet, which depends on the mean that airflow weights.
        for _ in range(100):
            moved = groups.count * curves.airflow_ratio(inlets_c(height), one)
            mean = groups.per_rack(moved * groups.height) / groups.per_rack(moved)
            before, height = height, groups.height / groups.per_group(mean)
            if np.max(np.abs(height - before)) < 1e-15:
                break
    inlet_c = inlets_c(height)
    ratio = curves.airflow_ratio(inlet_c, one)
    power_w = curves.cpu_w(inlet_c, one, groups.full_w, groups.idle_w) + curves.fan_w(ratio)
    it_w = groups.per_rack(groups.count * power_w)
    moved = groups.per_rack(groups.count * ratio)
    air = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
    per_w = config.hvac.crac.supply_m3s_per_w
    full_m3s = config.servers.fan_full_airflow_m3s
    if full_m3s is None:
        crac_rise_k = 1.0 / (air * per_w)
        rise_k = crac_rise_k - np.mean(approach_k) - np.mean(np.asarray(hall.return_approach_k))
        if rise_k <= 0:
            raise ConfigError(
                f"{config.name}: servers.fan_full_airflow_m3s null: supply and return approach "
                f"temperatures of {np.mean(approach_k):g} and "
                f"{np.mean(np.asarray(hall.return_approach_k)):g} K leave {rise_k:.3g} K of the "
                f"{crac_rise_k:.3g} K that supply air warms by; valid is above 0"
            )
        full_m3s = float(np.mean(it_w / (air * moved)) / rise_k)
    airflow_m3s = full_m3s * moved
    inlet_rise_k = groups.per_rack(groups.count * ratio * (inlet_c - supply_c)) / moved
    return DesignPoint(
        supply_c=supply_c,
        fan_full_airflow_m3s=full_m3s,
        crac_flow_m3s=per_w * float(it_w.sum()),
        it_w=it_w,
        airflow_m3s=airflow_m3s,
        approach_k=inlet_rise_k,
        outlet_rise_k=inlet_rise_k + it_w / (air * airflow_m3s),
        height=height,
    )


def calibrate(config: DataCenterConfig, groups: RackServers | None = None) -> Recirculation:
    """Recirculation of a hall, from its layout or from a matrix of the user's.

    r_j = a_j / sum_i w_ji (a_i + dT_i) at the design point, less the share that containment
    closes; approach temperatures are those of the open hall.

    Args:
        config: a data center with inlet model ``recirculation``.
        groups: its ``rack_servers``, if at hand.

    Raises:
        ConfigError: a matrix that cannot be read or is no recirculation matrix, or approach
            temperatures that the airflows cannot close on.
    """
    groups = rack_servers(config) if groups is None else groups
    design = design_point(config, groups)
    if config.hall.recirculation.matrix_file is None:
        exchange = layout_exchange(config.hall, design.airflow_m3s)
        share = design.approach_k / exchange.apply(design.outlet_rise_k)
        share = share * (1.0 - config.hall.layout.containment)
    else:
        exchange, share, design = _of_a_file(config, groups, design)
    captured = groups.per_group(share) * design.height
    _check_closes(config, groups, design, exchange, share, captured)
    fresh = float(np.sum((1.0 - share) * design.airflow_m3s)) / design.crac_flow_m3s
    fresh, approach_k = min(fresh, 1.0), design.approach_k
    if config.hall.layout.containment > 0:
        approach_k = _contained_approach_k(config, groups, design, exchange, share, fresh)
    return Recirculation(exchange, share, captured, fresh, approach_k, design)


def _of_a_file(
    config: DataCenterConfig, groups: RackServers, design: DesignPoint
) -> tuple[Exchange, F64, DesignPoint]:
    """Weights, shares and design point by a user's R or D."""
    settings = config.hall.recirculation
    path = Path(settings.matrix_file or "")
    kind, given = read_numbers(config, path)
    if kind == "D" and not settings.calibrate:
        design = _settled(config, groups, lambda at: given @ at.it_w)
    matrix = _share_matrix(config, path, kind, given, design)
    sums = matrix.sum(axis=1)
    none = sums == 0
    wanted_k = design.approach_k * none
    if settings.calibrate and np.any(wanted_k > 0):
        rack = int(np.argmax(wanted_k))
        raise ConfigError(
            f"{path}: row {rack} is zero, so that exhaust air cannot warm rack {rack} by the "
            f"{wanted_k[rack]:g} K of hall.supply_approach_k; valid is 0 K there or "
            "hall.recirculation.calibrate false"
        )
    # A rack that breathes supply air alone has a mix before it all the same: that of all racks.
    weights = np.where(none[:, None], 1.0 / len(sums), matrix / np.where(none, 1.0, sums)[:, None])
    exchange = dense_exchange(weights)
    if settings.calibrate:
        return exchange, design.approach_k / exchange.apply(design.outlet_rise_k), design
    settled = _settled(config, groups, lambda at: sums * exchange.apply(at.outlet_rise_k))
    return exchange, sums, settled


def _settled(
    config: DataCenterConfig,
    groups: RackServers,
    approach_k: Callable[[DesignPoint], F64],
    within_k: float = 1e-12,
) -> DesignPoint:
    """Design point whose approach temperatures are those that follow from it."""
    before = config.hall.rack_approach_k()
    for _ in range(500):
        design = design_point(config, groups, before)
        after = approach_k(design)
        if np.max(np.abs(after - before)) < within_k:
            return design
        before = after
    raise ConfigError(
        f"{config.hall.recirculation.matrix_file or config.name}: the hall finds no steady state "
        "at full load; valid is less recirculation"
    )


def _contained_approach_k(
    config: DataCenterConfig,
    groups: RackServers,
    design: DesignPoint,
    exchange: Exchange,
    share: F64,
    fresh_share: float,
) -> F64:
    """Inlet over supply behind containment, (R,), to a thousandth of a kelvin."""
    full = {"fan_full_airflow_m3s": design.fan_full_airflow_m3s}
    servers = config.servers.model_copy(update=full)

    def approach_k(at: DesignPoint) -> F64:
        # What the units cannot supply comes from the exhaust mix too.
        need = float(np.sum((1.0 - share) * at.airflow_m3s))
        covered = min(1.0, fresh_share * design.crac_flow_m3s / need)
        return (1.0 - (1.0 - share) * covered) * exchange.apply(at.outlet_rise_k)

    hall = config.model_copy(update={"servers": servers})
    return _settled(hall, groups, approach_k, within_k=1e-3).approach_k


def _check_closes(
    config: DataCenterConfig,
    groups: RackServers,
    design: DesignPoint,
    exchange: Exchange,
    share: F64,
    captured: F64,
) -> None:
    name, worst = config.name, int(np.argmax(captured))
    if captured[worst] >= 1.0:
        rack = int(np.searchsorted(groups.start, worst, side="right")) - 1
        raise ConfigError(
            f"{name}: hall.supply_approach_k of rack {rack} needs {captured[worst]:.3g} of the top "
            "servers' intake to be exhaust air; valid is below 1 (lower the approach temperature "
            "or hall.height_gradient)"
        )
    left = design.airflow_m3s - exchange.apply_transposed(share * design.airflow_m3s)
    worst = int(np.argmin(left))
    if left[worst] < 0:
        raise ConfigError(
            f"{name}: the racks around rack {worst} breathe "
            f"{1 - left[worst] / design.airflow_m3s[worst]:.3g} times the air it exhausts; valid "
            "is at most 1 (lower hall.supply_approach_k or raise the rack's airflow)"
        )
    fresh = float(np.sum((1.0 - share) * design.airflow_m3s))
    # Containment turns recirculation into demand for supply air, which may then fall short.
    if fresh > design.crac_flow_m3s * (1 + 1e-9) and config.hall.layout.containment == 0:
        raise ConfigError(
            f"{name}: servers draw {fresh:.4g} m3/s of supply air at full load, the CRAC units "
            f"give {design.crac_flow_m3s:.4g}; lower servers.fan_full_airflow_m3s (null derives "
            "it) or raise hvac.crac.supply_m3s_per_w"
        )


def layout_exchange(hall: HallConfig, airflow_m3s: F64 | None = None) -> Exchange:
    """Weights exp(-d/decay) times the exhaust airflow of the source, rows summing to 1.

    d is the shorter of two paths from exhaust face to inlet face: up and over the racks (rack
    height plus distance), or along the rows and around one of their ends.

    Args:
        hall: rows, measures and the decay length.
        airflow_m3s: airflow of each rack at the design point, (R,); None is the same for all.

    Raises:
        ConfigError: a cutoff that leaves a rack no source, or more weights than fit.
    """
    flow = np.ones(hall.racks) if airflow_m3s is None else airflow_m3s
    if hall.racks <= DENSE_RACKS:
        plan = floor_plan(hall)
        front, back = plan.front_m, plan.back_m
        path_m = _path_m(
            hall,
            front[:, None, 0],
            back[None, :, 0],
            np.abs(front[:, None, 1] - back[None, :, 1]),
            plan.row_ends_m,
        )
        return dense_exchange(_weights(hall, path_m, path_m.min(axis=1, keepdims=True)), flow)
    return _normalised(*_bands(hall), flow)


def dense_exchange(weights: F64, airflow_m3s: F64 | None = None) -> Exchange:
    """One run over all racks for each rack.

    Args:
        weights: relative weights of the sources (columns) for each rack (rows), (R, R).
        airflow_m3s: exhaust airflow of the sources that multiplies them, (R,).
    """
    racks = len(weights)
    index = np.arange(racks, dtype=np.int32)
    flow = np.ones(racks) if airflow_m3s is None else airflow_m3s
    runs = (
        np.arange(racks + 1, dtype=np.int32),
        np.zeros(racks, dtype=np.int32),
        np.full(racks, racks, dtype=np.int32),
        index * np.int32(racks),
    )
    return _normalised(runs, np.ascontiguousarray(weights).reshape(-1), flow)


def _normalised(runs: tuple[I32, I32, I32, I32], weights: F64, airflow_m3s: F64) -> Exchange:
    strength = airflow_m3s / airflow_m3s.mean()
    racks = len(strength)
    sums = Exchange(*runs, weights, strength, np.ones(racks)).apply(np.ones(racks))
    return Exchange(*runs, weights, strength, 1.0 / sums)


def _path_m(
    hall: HallConfig, front_x: F64, back_x: F64, across: F64, ends: tuple[float, float]
) -> F64:
    over = hall.layout.rack_height_m + np.hypot(front_x - back_x, across)
    around = np.minimum(
        *(np.abs(back_x - end) + np.abs(front_x - end) for end in ends),
    )
    return np.asarray(np.minimum(over, around + across), dtype=np.float64)


def _weights(hall: HallConfig, path_m: F64, shortest_m: F64) -> F64:
    """Weights of a rack's sources over that of its nearest; the scale cancels in its norm."""
    return np.asarray(np.exp((shortest_m - path_m) / hall.recirculation.decay_m))


def _bands(hall: HallConfig) -> tuple[tuple[I32, I32, I32, I32], F64]:
    """Runs and weights above the cutoff, with tables that every second row shares."""
    rows, per_row, layout = hall.rows, hall.racks_per_row, hall.layout
    cutoff, decay_m = hall.recirculation.cutoff, hall.recirculation.decay_m
    x: F64 = (np.arange(per_row, dtype=np.float64) + 0.5) * layout.rack_pitch_m
    ends = (0.0, per_row * layout.rack_pitch_m)

    def across(parity: int, shifts: npt.NDArray[np.int64]) -> F64:
        """Distance along y from the exhausts of the rows a + shifts to the inlets of row a."""
        source = parity + shifts
        half = layout.rack_depth_m / 2
        inlet = row_distance_m(layout, np.array(parity)) + (half if parity == 0 else -half)
        exhaust = row_distance_m(layout, source) - np.where(source % 2 == 0, half, -half)
        return np.abs(inlet - exhaust)

    # Sources go that are below the cutoff of what a rack amid the hall collects. In lengths, since
    # a weight by itself may be too small for a number.
    every = np.arange(-(rows // 2), rows - rows // 2)
    reach_m = np.inf
    for parity in (0, 1) if cutoff > 0 else ():
        path_m = _path_m(hall, x[per_row // 2], x, across(parity, every)[:, None], ends)
        total = _weights(hall, path_m, path_m.min()).sum()
        reach_m = min(reach_m, float(path_m.min() - decay_m * np.log(cutoff * total)))
    # Racks are nearer than their rows by the depth of one.
    spacing_m = layout.rack_depth_m + min(layout.cold_aisle_m, layout.hot_aisle_m)
    row_reach = int(np.clip((reach_m + layout.rack_depth_m) / spacing_m, 0, rows - 1))
    shifts = np.arange(-row_reach, row_reach + 1)
    merged = per_row <= MERGED_RACKS_PER_ROW
    rack_reach = per_row if merged else int(np.clip(reach_m / layout.rack_pitch_m, 0, per_row))
    place = np.arange(per_row)
    low = np.zeros_like(place) if merged else np.maximum(place - rack_reach, 0)
    high = np.full_like(place, per_row) if merged else np.minimum(place + rack_reach + 1, per_row)
    kept = 2 * len(shifts) * int(np.sum(high - low))
    if max(kept, hall.racks * (1 if merged else len(shifts))) > MOST_WEIGHTS:
        raise ConfigError(
            f"hall.recirculation.cutoff {cutoff:g} with decay_m {decay_m:g} keeps {kept:.3g} "
            f"weights for {hall.racks:,} racks; valid is at most {MOST_WEIGHTS:,} (raise cutoff or "
            "lower decay_m)"
        )
    tables = []
    begins = np.zeros((2, per_row, len(shifts)), dtype=np.int64)
    ends_at = np.zeros_like(begins)
    for parity in (0, 1):
        far = across(parity, shifts)[:, None]
        for p in place:
            path_m = _path_m(hall, x[p], x[low[p] : high[p]], far, ends)
            near = path_m <= reach_m
            if not near.any():
                raise ConfigError(
                    f"hall.recirculation.cutoff {cutoff:g} with decay_m {decay_m:g} leaves racks "
                    f"at place {p} of their rows without any source: their largest weight is "
                    f"{cutoff * np.exp((reach_m - path_m.min()) / decay_m):.3g}; valid is a cutoff "
                    "below that"
                )
            begins[parity, p] = np.argmax(near, axis=1)
            ends_at[parity, p] = np.where(
                near.any(axis=1),
                near.shape[1] - np.argmax(near[:, ::-1], axis=1),
                begins[parity, p],
            )
            block = np.where(near, _weights(hall, path_m, path_m.min()), 0.0)
            tables.append(block.reshape(-1))
    weights = np.concatenate(tables)
    table_start = np.cumsum([0, *(len(t) for t in tables)])[:-1].reshape(2, per_row)

    row, place = np.divmod(np.arange(hall.racks), per_row)
    base, span, low = table_start[row % 2, place], (high - low)[place], low[place]
    first_shift = np.maximum(-row_reach, -row)
    last_shift = np.minimum(row_reach, rows - 1 - row)
    if merged:
        runs = np.ones_like(row)
        first = (row + first_shift) * per_row
        length = (last_shift - first_shift + 1) * per_row
        offset = base + (first_shift + row_reach) * per_row
    else:
        runs = last_shift - first_shift + 1
        owner = np.repeat(np.arange(hall.racks), runs)
        starts = np.cumsum(runs) - runs
        shift = first_shift[owner] + np.arange(len(owner)) - starts[owner]
        # A run starts and ends with sources within reach.
        table = (row[owner] % 2, place[owner], shift + row_reach)
        begin, end = begins[table], ends_at[table]
        first = (row[owner] + shift) * per_row + low[owner] + begin
        length = end - begin
        offset = base[owner] + (shift + row_reach) * span[owner] + begin
    run_start = np.concatenate([[0], np.cumsum(runs)])
    index = (run_start, first, length, offset)
    return tuple(x.astype(np.int32) for x in index), weights  # type: ignore[return-value]


def _share_matrix(
    config: DataCenterConfig, path: Path, kind: str, given: F64, design: DesignPoint
) -> F64:
    """R of a user's R or D, (R, R).

    D is in K/W at the design airflow: T_in = T_sup + D P, from which R = M (1 + M)^-1 with
    M = D rho cp V.

    Raises:
        ConfigError: naming the file and what is wrong with it.
    """
    matrix = given
    if kind == "D":
        j, i = np.unravel_index(np.argmin(given), given.shape)
        if given[j, i] < -1e-9 * np.max(np.abs(given)):
            raise ConfigError(f"{path}: D[{j}, {i}] is {given[j, i]:.3g} K/W; valid is at least 0")
        hall = config.hall
        air = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
        rise = given * (air * design.airflow_m3s)
        try:
            solved = np.linalg.solve(np.eye(len(rise)) + rise.T, rise.T).T
        except np.linalg.LinAlgError:
            raise ConfigError(
                f"{path}: no R belongs to this D, since 1 + D rho cp V is singular; valid is D of "
                "a hall in which every rack gives its heat to the air"
            ) from None
        matrix = np.asarray(solved, dtype=np.float64)
    j, i = np.unravel_index(np.argmin(matrix), matrix.shape)
    if matrix[j, i] < -1e-9:
        raise ConfigError(
            f"{path}: rack {j} takes a share of {matrix[j, i]:.3g} of its air from rack {i}; valid "
            "is at least 0"
        )
    # Rounding of the inverse alone.
    matrix = np.maximum(matrix, 0.0)
    worst = int(np.argmax(matrix.sum(axis=1)))
    total = float(matrix[worst].sum())
    if total >= 1.0:
        raise ConfigError(
            f"{path}: row {worst} sums to {total:.6g}; valid is below 1, the rest being supply air"
        )
    return matrix


def read_numbers(config: DataCenterConfig, path: Path) -> tuple[str, F64]:
    """Kind, R or D, and numbers of a user's file, (R, R).

    An .npz file holds an array ``R`` or ``D``, a .csv file the numbers alone, one row per receiving
    rack, with ``hall.recirculation.matrix_kind``.

    Raises:
        ConfigError: naming the file and what is wrong with it.
    """
    kind, given = _read_numbers(config, path)
    racks = config.hall.racks
    if given.shape != (racks, racks):
        raise ConfigError(f"{path}: {kind} has shape {given.shape}, expected ({racks}, {racks})")
    if not np.all(np.isfinite(given)):
        j, i = np.argwhere(~np.isfinite(given))[0]
        raise ConfigError(f"{path}: {kind}[{j}, {i}] is {given[j, i]}; valid is a finite number")
    return kind, given


def _read_numbers(config: DataCenterConfig, path: Path) -> tuple[str, F64]:
    racks, wanted = config.hall.racks, config.hall.recirculation.matrix_kind
    if racks > MOST_MATRIX_RACKS:
        raise ConfigError(
            f"{path}: a matrix for {racks:,} racks; valid is at most {MOST_MATRIX_RACKS:,}"
        )
    suffix = path.suffix.lower()
    if suffix not in (".npz", ".csv"):
        raise ConfigError(f"{path}: ends in {path.suffix!r}; valid are .npz and .csv")
    if suffix == ".csv" and wanted is None:
        raise ConfigError(f"{path}: a .csv needs hall.recirculation.matrix_kind R or D")
    try:
        if suffix == ".csv":
            return str(wanted), np.loadtxt(path, delimiter=",", ndmin=2, dtype=np.float64)
        with open(path, "rb") as raw:
            file = np.load(raw, allow_pickle=False)
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise ConfigError(
                    f"{path}: holds one array without a name; valid is an .npz with R or D"
                )
            found = [name for name in ("R", "D") if name in file.files]
            if len(found) != 1:
                raise ConfigError(
                    f"{path}: holds {sorted(file.files)}; valid is one of the arrays R and D"
                )
            if wanted not in (None, found[0]):
                raise ConfigError(
                    f"{path}: holds {found[0]}, hall.recirculation.matrix_kind is {wanted}"
                )
            given = file[found[0]]
    except (OSError, ValueError, EOFError, KeyError, BadZipFile) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: cannot be read as a matrix ({error})") from None
    if given.dtype.kind not in "fiu":
        raise ConfigError(f"{path}: {found[0]} holds {given.dtype}; valid are real numbers")
    return found[0], np.asarray(given, dtype=np.float64)
