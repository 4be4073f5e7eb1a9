"""Heat recirculation: the share of each rack's exhaust in the intake of each rack.

R_ji is the share of rack i's exhaust in the intake of rack j, r_j is the share of all exhaust air
in the intake of rack j, and w_ji are weights:

    T_in,j = (1 - r_j) T_sup + sum_i R_ji T_out,i,    R_ji = r_j w_ji,  sum_i w_ji = 1

(Tang, Gupta and Varsamopoulos 2008, *Energy-efficient thermal-aware task scheduling for homogeneous
high-performance computing data centers*, IEEE TPDS 19(11)). The weights w follow from the layout
(``mix_weights``) or from a matrix file (``matrix_file``). The shares r are such that the configured
approach temperatures (inlet minus supply) hold exactly at the design point, either for every rack
or as means of the rows or of the hall. With means, the racks of a row or hall differ by their
exposure (``exposure``) or by the matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from sdc_taichi.config import DataCenterConfig, HallConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import EXACT_RACKS, DesignPoint, design_point, design_point_at
from sdc_taichi.hall.matrix_file import read_matrix, share_matrix
from sdc_taichi.hall.mix_weights import MixWeights, dense_weights, layout_weights
from sdc_taichi.hall.rack_servers import RackServers, rack_servers
from sdc_taichi.types import F64

Result = TypeVar("Result")

_MOST_ITERATIONS = 500
_WITHIN_K = 1e-12
"""Tolerance of the iteration for approach temperatures, in K."""
_MOST_MEAN_SHARE = 0.9
"""Largest mean share of exhaust air in the intake of a row or hall; at larger shares, hardly any
supply air would reach the racks."""
_MOST_NEWTON_STEPS = 50
_LARGE_WITHIN_K = 1e-3
"""Tolerance for halls of more than EXACT_RACKS if means of the approach temperatures are
configured, in K."""
_CONTAINED_WITHIN_K = 1e-9
"""Tolerance of the iteration for the exhaust mixes of a hall with containment, in K."""


OVER_M = 2.3
"""Length, in m, of the zone at a row's end where less exhaust air comes over the racks."""
NEIGHBOURS_M = 2.2
"""Decay length of the weights by which racks share the supply air of their aisle, in m."""
LEAST = 0.15
"""Exposure of a rack for which the sum of the terms is 0; the mean exposure is about 1."""
_REACH = 40.0
"""Distance beyond which the weights of neighbours are neglected, in decay lengths."""


@dataclass(frozen=True, slots=True)
class Recirculation:
    """Calibrated recirculation of a hall of R racks and G server groups."""

    mix_weights: MixWeights
    """Weights w of the exhaust mix of each rack."""
    exhaust_share: F64
    """Share r of exhaust air in the intake of each rack, with containment, 0..1, (R,)."""
    group_exhaust_share: F64
    """Share of exhaust air in the intake of each server group, which depends on its height, 0..1,
    (G,)."""
    fresh_share: float
    """Share of CRAC air that reaches rack inlets at the design point; the rest bypasses them."""
    need_m3s: F64
    """Supply air that each rack takes in at the design point, in m3/s, (R,)."""
    design: DesignPoint
    """Design point of the hall with containment, but ``height_factor`` without containment."""

    def matrix(self) -> F64:
        """Return the share of rack i's exhaust in the intake of rack j as entry [j, i], (R, R)."""
        return np.asarray(self.exhaust_share[:, None] * self.mix_weights.dense())


def calibrate(config: DataCenterConfig, servers: RackServers | None = None) -> Recirculation:
    """Calibrate the recirculation of a hall, from its layout or from a matrix file.

    The exhaust share of rack j is r_j = a_j / sum_i w_ji (a_i + dT_i) at the design point, with the
    approach temperatures a and the temperature rises dT through the racks. If only means of the
    approach temperatures are configured, r_j = k e_j / (1 + k e_j): the ratio of exhaust to supply
    air is the exposure e_j times a factor k, which is equal for all racks of the row or hall.
    Containment reduces the exhaust shares if the approach temperatures are those of the open hall.

    Args:
        config: A data center with inlet model ``recirculation``.
        servers: Servers of the hall, see ``rack_servers``; None computes them.

    Raises:
        ConfigError: The matrix file is invalid, or no recirculation gives the approach temperatures
            with the configured airflows.
    """
    servers = rack_servers(config) if servers is None else servers
    design = design_point(config, servers)
    path = config.hall.recirculation.matrix_file
    try:
        return _calibrated(config, servers, design)
    except ConfigError as error:
        # The design point above is valid, so the error is due to the matrix file, if there is one.
        named = path is None or str(path) in str(error)
        raise ConfigError(str(error) if named else f"{path}: {error}") from None


def _calibrated(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> Recirculation:
    """Calibrate the recirculation from a design point without recirculation.

    If the approach temperatures are those of the open hall, containment c reduces both paths by the
    factor 1 - c: the exhaust share r of the racks and the share of supply air that bypasses them.
    The CRAC airflow is sized for the resulting airflows. Approach temperatures of the hall as it
    stands include what containment does.
    """
    if config.hall.recirculation.matrix_file is None:
        weights, open_share, design = _from_layout(config, servers, design)
    else:
        weights, open_share, design = _from_matrix_file(config, servers, design)
    open_part = config.hall.remaining_paths
    share = open_share * open_part
    group_share = servers.per_group(share) * design.height_factor
    _check_intakes(config, servers, group_share)
    _check_airflows(config, design, weights, share)
    fresh = _open_fresh_share(config, design, open_share)
    if open_part < 1.0:
        fresh = 1.0 - (1.0 - fresh) * open_part
        design = _contained_design(config, servers, design, weights, group_share)
    # The exhaust share of an intake is its approach temperature divided by its exhaust mix.
    need_m3s = design.airflow_m3s * (1.0 - design.approach_k / weights.apply(design.outlet_rise_k))
    if open_part < 1.0:
        design = replace(design, crac_flow_m3s=float(need_m3s.sum()) / fresh)
    return Recirculation(weights, share, group_share, fresh, need_m3s, design)


def _from_layout(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> tuple[MixWeights, F64, DesignPoint]:
    """Return weights, exhaust shares and design point from the layout, without containment."""
    if config.hall.recirculation.scaled_to == "rack":
        weights = layout_weights(config.hall, design.airflow_m3s)
        return weights, design.approach_k / weights.apply(design.outlet_rise_k), design
    mean_k, airflow_m3s = _mean_approach_k(config), design.airflow_m3s
    if np.any(mean_k != config.hall.rack_approach_k()):
        airflow_m3s = design_point(config, servers, mean_k).airflow_m3s
    weights = layout_weights(config.hall, airflow_m3s)
    return weights, *_shares_by_exposure(
        config, servers, weights, exposure(config.hall, airflow_m3s)
    )


def _from_matrix_file(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> tuple[MixWeights, F64, DesignPoint]:
    """Return weights, exhaust shares and design point from a matrix file, without containment."""
    settings = config.hall.recirculation
    path = Path(settings.matrix_file or "")
    kind, values = read_matrix(config, path)
    if settings.scaled_to in ("row", "hall"):
        design = design_point(config, servers, _mean_approach_k(config))
    elif kind == "D" and settings.scaled_to == "none":
        design = _solve_design_point(config, servers, lambda at: values @ at.it_w)
    matrix = share_matrix(config, path, kind, values, design)
    sums = matrix.sum(axis=1)
    no_exhaust = sums == 0
    wanted_k = design.approach_k * no_exhaust
    if settings.scaled_to == "rack" and np.any(wanted_k > 0):
        rack = int(np.argmax(wanted_k))
        raise ConfigError(
            f"{path}: row {rack} is zero, so that exhaust air cannot warm rack {rack} by the "
            f"{wanted_k[rack]:g} K of hall.supply_approach_k; valid is 0 K there or "
            "another hall.recirculation.calibrate than rack"
        )
    # Weights must sum to 1 even for racks without exhaust air, which therefore use equal weights.
    row_sums = np.where(no_exhaust, 1.0, sums)[:, None]
    weights = dense_weights(np.where(no_exhaust[:, None], 1.0 / len(sums), matrix / row_sums))
    if settings.scaled_to == "rack":
        return weights, design.approach_k / weights.apply(design.outlet_rise_k), design
    if settings.scaled_to != "none":
        return weights, *_shares_by_exposure(config, servers, weights, sums)
    design = _solve_design_point(config, servers, lambda at: sums * weights.apply(at.outlet_rise_k))
    return weights, sums, design


def _parts(config: DataCenterConfig) -> int:
    """Return the number of equal parts of the hall for which means are configured: rows, or 1."""
    return config.hall.rows if config.hall.recirculation.scaled_to == "row" else 1


def _mean_approach_k(config: DataCenterConfig) -> F64:
    """Return the means of the configured approach temperatures by row or hall, in K, (R,)."""
    hall, parts = config.hall, _parts(config)
    means = hall.rack_approach_k().reshape(parts, -1).mean(axis=1)
    return np.repeat(means, hall.racks // parts)


def _shares_by_exposure(
    config: DataCenterConfig, servers: RackServers, weights: MixWeights, exposed: F64
) -> tuple[F64, DesignPoint]:
    """Return exhaust shares that give the configured mean approaches, and the design point.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        weights: Weights of the exhaust mix of each rack.
        exposed: Exposure of each rack, 0 or more, (R,).

    Raises:
        ConfigError: The means are too large for the exhaust air, or the iteration fails.
    """
    wanted_k = _mean_approach_k(config)
    exact, near = config.hall.racks <= EXACT_RACKS, None

    def update(approach_k: F64) -> tuple[F64, tuple[F64, DesignPoint]]:
        nonlocal near
        design = design_point(config, servers, approach_k, near)
        near = None if exact else design
        mix_k = weights.apply(design.outlet_rise_k)
        share = _mean_share(config, mix_k, exposed, wanted_k)
        return share * mix_k, (share, design)

    within_k = _WITHIN_K if exact else _LARGE_WITHIN_K
    return _settled(config, wanted_k, update, within_k)


def _mean_share(config: DataCenterConfig, mix_k: F64, exposed: F64, wanted_k: F64) -> F64:
    """Return exhaust shares k e / (1 + k e) that give the wanted mean approaches, (R,).

    Each part (row or hall) has its own k. The mean is a concave, rising function of k, so Newton's
    method from k = 0 converges from below.
    """
    hall, parts = config.hall, _parts(config)
    mix, e, wanted = (values.reshape(parts, -1) for values in (mix_k, exposed, wanted_k))
    goal = wanted[:, 0]
    mean_mix = np.mean(mix * (e > 0), axis=1)
    if np.any(goal > _MOST_MEAN_SHARE * mean_mix):
        part = int(np.argmax(goal - _MOST_MEAN_SHARE * mean_mix))
        where = f" of row {part}" if hall.recirculation.scaled_to == "row" else ""
        raise ConfigError(
            f"{hall.recirculation.matrix_file or config.name}: hall.supply_approach_k{where} is "
            f"{goal[part]:.3g} K on the mean, but the exhaust that its racks take in is "
            f"{mean_mix[part]:.3g} K above supply air on the mean; valid is at most "
            f"{100 * _MOST_MEAN_SHARE:g} % of that"
        )
    k = np.zeros(parts)
    for _ in range(_MOST_NEWTON_STEPS):
        odds = k[:, None] * e
        residual = goal - np.mean(mix * odds / (1.0 + odds), axis=1)
        slope = np.mean(mix * e / (1.0 + odds) ** 2, axis=1)
        step = residual / np.where(slope > 0, slope, 1.0)
        k = k + step
        if np.all(np.abs(step) <= 1e-14 * k):
            break
    odds = k[:, None] * e
    return np.asarray(odds / (1.0 + odds)).reshape(-1)


def _solve_design_point(
    config: DataCenterConfig,
    servers: RackServers,
    approach_k: Callable[[DesignPoint], F64],
) -> DesignPoint:
    """Find the design point that is consistent with its own approach temperatures.

    Power and airflow depend on the inlets, and the inlets depend on the outlets, which follow from
    power and airflow. Fixed-point iteration resolves this dependence.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        approach_k: Function from a design point to inlet minus supply temperatures, K, (R,).

    Raises:
        ConfigError: The iteration does not converge.
    """

    def update(before_k: F64) -> tuple[F64, DesignPoint]:
        design = design_point(config, servers, before_k)
        return approach_k(design), design

    return _settled(config, config.hall.rack_approach_k(), update, _WITHIN_K)


def _contained_design(
    config: DataCenterConfig,
    servers: RackServers,
    design: DesignPoint,
    weights: MixWeights,
    group_share: F64,
) -> DesignPoint:
    """Compute the design point with containment, except for the airflow of the CRAC units.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        design: Design point without containment.
        weights: Weights of the exhaust mix of each rack.
        group_share: Share of exhaust air in each group's intake, with containment, (G,).

    Raises:
        ConfigError: The iteration does not converge.
    """

    def update(mix_k: F64) -> tuple[F64, DesignPoint]:
        contained = design_point_at(
            config,
            servers,
            design.supply_c + servers.per_group(mix_k) * group_share,
            design.height_factor,
            full_airflow_m3s=design.full_airflow_m3s,
        )
        return weights.apply(contained.outlet_rise_k), contained

    return _settled(config, weights.apply(design.outlet_rise_k), update, _CONTAINED_WITHIN_K)


def _settled(
    config: DataCenterConfig,
    start_k: F64,
    update: Callable[[F64], tuple[F64, Result]],
    within_k: float,
) -> Result:
    """Repeat an update of temperatures until they change by less than ``within_k``.

    Args:
        config: The data center, for the error.
        start_k: Temperatures minus supply temperature for the first update, K, (R,).
        update: Function from previous temperatures to new temperatures, K, (R,), and a result that
            belongs to the new temperatures.
        within_k: Change below which the iteration ends, K.

    Returns:
        Result of the last update.

    Raises:
        ConfigError: The iteration does not converge.
    """
    before_k, last_change_k = start_k, None
    for _ in range(_MOST_ITERATIONS):
        after_k, result = update(before_k)
        change_k = after_k - before_k
        if np.max(np.abs(change_k)) < within_k:
            return result
        before_k = after_k
        if within_k >= _LARGE_WITHIN_K and last_change_k is not None:
            # Iterations are slow here, so add what later changes would sum up to if they kept
            # shrinking by the same factor (Aitken 1926).
            factor = np.sum(change_k * last_change_k) / np.sum(last_change_k**2)
            before_k = after_k + factor / (1.0 - factor) * change_k if factor < 0.5 else after_k
        last_change_k = change_k
    raise ConfigError(
        f"{config.hall.recirculation.matrix_file or config.name}: the hall finds no steady state "
        "at full load; valid is less recirculation"
    )


def _check_intakes(config: DataCenterConfig, servers: RackServers, group_share: F64) -> None:
    """Raise an error unless the share of exhaust air in every server's intake is below 1."""
    worst = int(np.argmax(group_share))
    if group_share[worst] >= 1.0:
        rack = int(np.searchsorted(servers.group_offsets, worst, side="right")) - 1
        raise ConfigError(
            f"{config.name}: hall.supply_approach_k of rack {rack} needs {group_share[worst]:.3g} "
            "of the top servers' intake to be exhaust air; valid is below 1 (lower the approach "
            "temperature or hall.height_gradient)"
        )


def _check_airflows(
    config: DataCenterConfig, design: DesignPoint, weights: MixWeights, share: F64
) -> None:
    """Raise an error if all racks together take in more exhaust air of a rack than it emits."""
    left = design.airflow_m3s - weights.apply_transposed(share * design.airflow_m3s)
    worst = int(np.argmin(left))
    if left[worst] < 0:
        raise ConfigError(
            f"{config.name}: the racks around rack {worst} breathe "
            f"{1 - left[worst] / design.airflow_m3s[worst]:.3g} times the air it exhausts; valid "
            "is at most 1 (lower hall.supply_approach_k or raise the rack's airflow)"
        )


def _open_fresh_share(config: DataCenterConfig, design: DesignPoint, share: F64) -> float:
    """Return the share of the CRAC air that racks take in without containment, at most 1.

    Raises:
        ConfigError: The CRAC units supply less air than the racks take in.
    """
    need_m3s = float(np.sum((1.0 - share) * design.airflow_m3s))
    if need_m3s > design.crac_flow_m3s * (1 + 1e-9):
        raise ConfigError(
            f"{config.name}: servers draw {need_m3s:.4g} m3/s of supply air at full load, the CRAC "
            f"units give {design.crac_flow_m3s:.4g}; lower servers.fan_full_airflow_m3s (null "
            "derives it) or raise hvac.crac.supply_m3s_per_w"
        )
    return min(need_m3s / design.crac_flow_m3s, 1.0)


@dataclass(frozen=True, slots=True)
class _Coefficients:
    """Coefficients of the exposure of racks for one position of the return air openings."""

    around: float
    """Additional exposure at the end of a row due to air that flows around this end."""
    around_length_m: float
    """Decay length of the exposure to air that flows around the end of a row, in m."""
    around_closed: float
    """Relative reduction of ``around`` by full containment, in addition to its general effect on
    all paths."""
    over: float
    """Reduction of exposure at the end of a row, where less air flows over the racks."""
    over_closed: float
    """Relative reduction of ``over`` by full containment, in addition to its general effect on all
    paths."""
    demand: float
    """Change of the exposure divided by the relative change of the aisle's local air demand."""


_BY_RETURNS = {
    "ceiling": _Coefficients(4.0, 0.6, 0.0, 0.4, 1.0, 10.0),
    "end_wall": _Coefficients(0.6, 0.5, 0.35, 0.6, 0.0, 4.0),
}


def exposure(hall: HallConfig, airflow_m3s: F64) -> F64:
    """Return the relative exposure of every rack to exhaust air, above 0, (R,).

    Exhaust air reaches an inlet around the ends of the rows and over the racks. Its amount rises
    with the airflow that a rack and its neighbours draw in excess of the local floor supply. The
    exposure of rack j, with distances x to the ends of its row, is

        e_j = 1 + around sum_ends exp(-x / around_length) - over sum_ends exp(-x / OVER_M)
                + demand (v_j - 1)

    and is bounded to stay above 0. Here v_j is a weighted mean airflow of the racks that face the
    aisle near rack j, with weights exp(-distance / NEIGHBOURS_M), divided by the mean of the aisle.
    The coefficients are fitted to the inlet temperatures that ``sdc-taichi hall solve`` computes
    for 63 halls of 8 to 200 racks; docs/hall.md shows the quality of the fit.

    Args:
        hall: Configuration of the hall.
        airflow_m3s: Airflow of each rack at the design point, m3/s, (R,).
    """
    values, closed = _BY_RETURNS[hall.layout.returns], hall.layout.containment
    places: F64 = np.arange(hall.racks_per_row, dtype=np.float64)
    along = (places + 0.5) * hall.layout.rack_pitch_m
    around = values.around * (1.0 - values.around_closed * closed)
    over = values.over * (1.0 - values.over_closed * closed)
    ends: F64 = around * _from_ends(along, values.around_length_m)
    ends -= over * _from_ends(along, OVER_M)
    demand = _demand(hall, airflow_m3s.reshape(hall.rows, hall.racks_per_row))
    raw = 1.0 + ends + values.demand * (demand - 1.0)
    # This smooth, monotonic function keeps the exposure above 0 even if ``raw`` is negative.
    return np.asarray(raw + np.hypot(raw, 2.0 * LEAST)).reshape(-1) / 2.0


def _from_ends(along_m: F64, length_m: float) -> F64:
    """Return the sum of exp(-distance / length) over both ends of a row, for P racks, (P,)."""
    from_first: F64 = np.exp(-along_m / length_m)
    return np.asarray(from_first + from_first[::-1], dtype=np.float64)


def _demand(hall: HallConfig, airflow_m3s: F64) -> F64:
    """Return the airflow drawn near each rack divided by the mean of its aisle, (rows, P).

    Args:
        hall: Configuration of the hall, with the pitch of the P racks in a row.
        airflow_m3s: Airflow of each rack, m3/s, (rows, P).
    """
    rows, per_row = airflow_m3s.shape
    # Rows 0 and 1 face the same aisle, and so on; if their number is odd, the last faces a wall.
    drawn = np.add.reduceat(airflow_m3s, np.arange(0, rows, 2), axis=0)
    drawn = drawn / drawn.mean(axis=1, keepdims=True)
    pitches = NEIGHBOURS_M / hall.layout.rack_pitch_m
    reach = min(per_row - 1, int(np.ceil(_REACH * pitches)))
    weights = np.exp(-np.abs(np.arange(-reach, reach + 1)) / pitches)

    def smoothed(values: F64) -> F64:
        return np.asarray(np.convolve(values, weights)[reach : reach + per_row])

    whole = smoothed(np.ones(per_row))
    # Compute equal aisles, which are most aisles of a hall, only once.
    distinct, aisle = np.unique(drawn, axis=0, return_inverse=True)
    around = np.stack([smoothed(values) / whole for values in distinct])
    return np.asarray(np.repeat(around[aisle.reshape(-1)], 2, axis=0)[:rows])
