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

from sdc_taichi.config import (
    DataCenterConfig,
    HallConfig,
    cpu_coefficients,
)
from sdc_taichi.errors import ConfigError
from sdc_taichi.layout import floor_plan, row_distance_m
from sdc_taichi.types import F64

I32 = npt.NDArray[np.int32]

DENSE_RACKS = 64
"""Halls up to this size keep every weight; larger ones drop those below the cutoff."""
MERGED_RACKS_PER_ROW = 64
"""Rows up to this length are summed whole, rows beside each other in one go."""
MOST_MATRIX_RACKS = 8192
"""Largest hall with a matrix of the user's: half a gigabyte in f64."""


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
    """Exhaust airflow of each rack over the mean, (R,)."""
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
        for i in range(int(self.length.max())):
            live = self.length > i
            yield rack[live], self.first[live] + i, self.weights[self.offset[live] + i]


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
    design: DesignPoint

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


def design_point(config: DataCenterConfig) -> DesignPoint:
    """Power, airflow and temperatures of every rack at full load and the highest setpoint.

    Raises:
        ConfigError: approach temperatures that leave no room for heating the air.
    """
    return _design_point(config, rack_servers(config), _approach_k(config))


def _approach_k(config: DataCenterConfig) -> F64:
    return config.hall.rack_approach_k()


def _design_point(config: DataCenterConfig, groups: RackServers, approach_k: F64) -> DesignPoint:
    hall, servers = config.hall, config.servers
    supply_c = config.hvac.setpoint.max_c
    slope, offset, shift = cpu_coefficients(servers)
    limit_c = np.inf if servers.curve_limit_c is None else servers.curve_limit_c
    approach = groups.per_group(approach_k)
    one = np.ones(len(groups.count))

    def ratio_at(height: F64) -> tuple[F64, F64]:
        inlet_c = supply_c + approach * height + groups.offset_k
        return inlet_c, config.airflow_ratio(inlet_c, one)

    height = np.ones(len(groups.count))
    if hall.inlet_model == "recirculation":
        # Airflow depends on the inlet, which depends on the mean that airflow weights.
        for _ in range(100):
            _, ratio = ratio_at(height)
            moved = groups.count * ratio
            mean = groups.per_rack(moved * groups.height) / groups.per_rack(moved)
            before, height = height, groups.height / groups.per_group(mean)
            if np.max(np.abs(height - before)) < 1e-15:
                break
    inlet_c, ratio = ratio_at(height)
    on_curve = slope * np.minimum(inlet_c, limit_c) + offset + shift
    cpu_w = np.maximum(groups.idle_w, groups.full_w * on_curve)
    fan_w = servers.fan_reference_w * (ratio / servers.fan_reference_ratio) ** (
        servers.fan_power_exponent
    )
    it_w = groups.per_rack(groups.count * (cpu_w + fan_w))
    moved = groups.per_rack(groups.count * ratio)
    air = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
    per_w = config.hvac.crac.supply_m3s_per_w
    full_m3s = servers.fan_full_airflow_m3s
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
    settings = config.hall.recirculation
    design = _design_point(config, groups, _approach_k(config))
    if settings.matrix_file is None:
        exchange = layout_exchange(config.hall, design.airflow_m3s)
        share = design.approach_k / exchange.apply(design.outlet_rise_k)
    else:
        path = Path(settings.matrix_file)
        kind, given = read_numbers(config, path)
        if kind == "D" and not settings.calibrate:
            design = _settled(config, groups, lambda at: given @ at.it_w)
        matrix = _share_matrix(config, path, kind, given, design)
        sums = matrix.sum(axis=1)
        weights = matrix / np.where(sums > 0, sums, 1.0)[:, None]
        # A rack that breathes supply air alone needs weights all the same.
        weights[sums == 0] = 1.0 / len(sums)
        exchange = dense_exchange(weights)
        if settings.calibrate:
            share = design.approach_k / exchange.apply(design.outlet_rise_k)
        else:
            share = sums
            design = _settled(config, groups, lambda at: share * exchange.apply(at.outlet_rise_k))
    if settings.matrix_file is None:
        share = share * (1.0 - config.hall.layout.containment)
    captured = groups.per_group(share) * design.height
    _check_closes(config, design, exchange, share, captured)
    fresh = float(np.sum((1.0 - share) * design.airflow_m3s)) / design.crac_flow_m3s
    return Recirculation(exchange, share, captured, min(fresh, 1.0), design)


def _settled(
    config: DataCenterConfig, groups: RackServers, approach_k: Callable[[DesignPoint], F64]
) -> DesignPoint:
    """Design point whose approach temperatures are those that follow from it."""
    before = _approach_k(config)
    for _ in range(500):
        design = _design_point(config, groups, before)
        after = approach_k(design)
        if np.max(np.abs(after - before)) < 1e-12:
            return design
        before = after
    raise ConfigError(
        f"{config.hall.recirculation.matrix_file}: the hall finds no steady state at full load; "
        "valid is less recirculation"
    )


def _check_closes(
    config: DataCenterConfig, design: DesignPoint, exchange: Exchange, share: F64, captured: F64
) -> None:
    name, worst = config.name, int(np.argmax(captured))
    if captured[worst] >= 1.0:
        rack = int(np.searchsorted(np.cumsum(np.bincount(_rack_of(config))), worst, side="right"))
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


def _rack_of(config: DataCenterConfig) -> npt.NDArray[np.int64]:
    start = rack_servers(config).start
    return np.repeat(np.arange(len(start) - 1), np.diff(start))


def layout_exchange(hall: HallConfig, airflow_m3s: F64 | None = None) -> Exchange:
    """Weights exp(-d/decay) times the exhaust airflow of the source, rows summing to 1.

    d is the shorter of two paths from exhaust face to inlet face: up and over the racks (rack
    height plus distance), or along the rows and around one of their ends.

    Args:
        hall: rows, measures and the decay length.
        airflow_m3s: airflow of each rack at the design point, (R,); None is the same for all.
    """
    flow = np.ones(hall.racks) if airflow_m3s is None else airflow_m3s
    if hall.racks <= DENSE_RACKS:
        plan = floor_plan(hall)
        front, back = plan.front_m, plan.back_m
        weights = _path_weight(
            hall,
            front[:, None, 0],
            back[None, :, 0],
            np.abs(front[:, None, 1] - back[None, :, 1]),
            plan.row_ends_m,
        )
        return dense_exchange(weights, flow)
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


def _path_weight(
    hall: HallConfig, front_x: F64, back_x: F64, across: F64, ends: tuple[float, float]
) -> F64:
    settings = hall.recirculation
    over = hall.layout.rack_height_m + np.hypot(front_x - back_x, across)
    around = np.minimum(
        *(np.abs(back_x - end) + np.abs(front_x - end) for end in ends),
    )
    path_m = np.minimum(over, around + across)
    return np.asarray(np.exp(-path_m / settings.decay_m), dtype=np.float64)


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

    # Largest sum of weights that a rack amid the hall collects: weights below the cutoff of it go.
    every = np.arange(-(rows // 2), rows - rows // 2)
    total = max(
        float(_path_weight(hall, x[per_row // 2], x, across(parity, every)[:, None], ends).sum())
        for parity in (0, 1)
    )
    reach_m = max(-decay_m * np.log(max(cutoff * total, 1e-12)), 0.0)
    spacing_m = layout.rack_depth_m + min(layout.cold_aisle_m, layout.hot_aisle_m)
    row_reach = min(rows - 1, int(np.ceil(reach_m / spacing_m)))
    shifts = np.arange(-row_reach, row_reach + 1)
    merged = per_row <= MERGED_RACKS_PER_ROW
    rack_reach = per_row if merged else int(np.ceil(reach_m / layout.rack_pitch_m))
    place = np.arange(per_row)
    low = np.zeros_like(place) if merged else np.maximum(place - rack_reach, 0)
    high = np.full_like(place, per_row) if merged else np.minimum(place + rack_reach + 1, per_row)
    tables = []
    begins = np.zeros((2, per_row, len(shifts)), dtype=np.int64)
    ends_at = np.zeros_like(begins)
    for parity in (0, 1):
        far = across(parity, shifts)[:, None]
        for p in place:
            block = _path_weight(hall, x[p], x[low[p] : high[p]], far, ends)
            near = block >= cutoff * total
            begins[parity, p] = np.argmax(near, axis=1)
            ends_at[parity, p] = np.where(
                near.any(axis=1),
                near.shape[1] - np.argmax(near[:, ::-1], axis=1),
                begins[parity, p],
            )
            tables.append(np.where(near, block, 0.0).reshape(-1))
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
        hall = config.hall
        air = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
        rise = given * (air * design.airflow_m3s)
        matrix = np.asarray(np.linalg.solve(np.eye(len(rise)) + rise.T, rise.T).T, np.float64)
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
    try:
        if path.suffix == ".npz":
            with open(path, "rb") as raw:
                file = np.load(raw, allow_pickle=False)
                found = [name for name in ("R", "D") if name in file.files]
                if len(found) != 1:
                    raise ConfigError(
                        f"{path}: holds {sorted(file.files)}; valid is one of the arrays R and D"
                    )
                if wanted not in (None, found[0]):
                    raise ConfigError(
                        f"{path}: holds {found[0]}, hall.recirculation.matrix_kind is {wanted}"
                    )
                return found[0], np.asarray(file[found[0]], dtype=np.float64)
        if wanted is None:
            raise ConfigError(f"{path}: a .csv needs hall.recirculation.matrix_kind R or D")
        return wanted, np.loadtxt(path, delimiter=",", ndmin=2, dtype=np.float64)
    except (OSError, ValueError, EOFError, KeyError, BadZipFile) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{path}: cannot be read as a matrix ({error})") from None
