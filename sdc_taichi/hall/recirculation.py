"""Heat recirculation: the share of each rack's exhaust in the intake of each rack.

With R_ji the share of rack j's intake that is rack i's exhaust,

    T_in,j = (1 - r_j) T_sup + sum_i R_ji T_out,i,    R_ji = r_j w_ji,  sum_i w_ji = 1

(Tang, Gupta and Varsamopoulos 2008, *Energy-efficient thermal-aware task scheduling for homogeneous
high-performance computing data centers*, IEEE TPDS 19(11)). The weights w are those of the exhaust
mix before each rack (``mix_weights``) or of a user's matrix (``matrix_file``); the shares r are
such that the configured approach temperatures hold exactly at the design point: of every rack, or
as means of the rows or of the hall. Racks within a row or hall then differ by their exposure
(``exposure``) or by the matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from sdc_taichi.config import DataCenterConfig, HallConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import DesignPoint, design_point, design_point_at
from sdc_taichi.hall.matrix_file import read_matrix, share_matrix
from sdc_taichi.hall.mix_weights import MixWeights, dense_weights, layout_weights
from sdc_taichi.hall.rack_servers import RackServers, rack_servers
from sdc_taichi.types import F64

Result = TypeVar("Result")

_MOST_ITERATIONS = 500
_WITHIN_K = 1e-12
"""Change of the approach temperatures, in K, below which iteration ends."""
_MOST_MEAN_SHARE = 0.9
"""Largest share of the exhaust mix in the mean intake of a row or hall; beyond it, hardly any
supply air reaches the racks."""
_MOST_NEWTON_STEPS = 50
_EXACT_RACKS, _LARGE_WITHIN_K = 10_000, 1e-3
"""Most racks of a hall whose approach temperatures are computed to ``_WITHIN_K`` if their means are
configured, and the change in K that ends iteration in larger halls: each iteration leaves a
twentieth of the change, and takes a second in a hall of a hundred thousand racks."""
_CONTAINED_WITHIN_K = 1e-9
"""Change of the exhaust mixes of a contained hall, in K, below which iteration ends."""


OVER_M = 2.3
"""Length of the range at the end of a row where less exhaust comes over the racks."""
NEIGHBOURS_M = 2.2
"""Length over which racks of an aisle share its supply air."""
LEAST = 0.15
"""Exposure of a rack for which the sum of the terms is 0; a rack of the mean has about 1."""
_REACH = 40.0
"""Distance of the farthest neighbours that count, in lengths: their weight is a rounding error."""


@dataclass(frozen=True, slots=True)
class Recirculation:
    """Calibrated recirculation of a hall of R racks and G server groups."""

    mix_weights: MixWeights
    """Weights w of the exhaust mix before each rack."""
    exhaust_share: F64
    """Share r of each rack's intake that is exhaust air, with containment, 0..1, (R,)."""
    group_exhaust_share: F64
    """Share of each server group's intake that is exhaust air, by its height, 0..1, (G,)."""
    fresh_share: float
    """Share of CRAC air that reaches inlets at the design point; the rest bypasses them."""
    need_m3s: F64
    """Supply air that each rack takes in at the design point, in m3/s, (R,)."""
    design: DesignPoint
    """Design point of the hall, with containment; ``height_factor`` is that of the open hall."""

    def matrix(self) -> F64:
        """R, the share of each rack's intake (rows) that is each rack's exhaust, (R, R)."""
        return np.asarray(self.exhaust_share[:, None] * self.mix_weights.dense())


def calibrate(config: DataCenterConfig, servers: RackServers | None = None) -> Recirculation:
    """Recirculation of a hall, from its layout or from a matrix of the user's.

    r_j = a_j / sum_i w_ji (a_i + dT_i) at the design point, less the share that containment
    closes; the approach temperatures a are those of the open hall, dT is the rise through a rack.
    If only their means are configured, r_j = k e_j / (1 + k e_j): exhaust and supply air share the
    intake as k times the exposure e_j to 1, with the k of the row or of the hall.

    Args:
        config: A data center with inlet model ``recirculation``.
        servers: Its ``rack_servers``; None computes them.

    Raises:
        ConfigError: a matrix that cannot be read or is no recirculation matrix, or approach
            temperatures that the airflows cannot close on.
    """
    servers = rack_servers(config) if servers is None else servers
    design = design_point(config, servers)
    path = config.hall.recirculation.matrix_file
    try:
        return _calibrated(config, servers, design)
    except ConfigError as error:
        # A hall that is valid without its matrix is invalid because of it.
        named = path is None or str(path) in str(error)
        raise ConfigError(str(error) if named else f"{path}: {error}") from None


def _calibrated(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> Recirculation:
    """Recirculation of a hall that has a design point without it.

    Containment c closes the share c of the paths both ways: racks take in r (1 - c) of exhaust air,
    and b (1 - c) of the supply air bypasses them. The units are sized for the remaining airflows.
    """
    if config.hall.recirculation.matrix_file is None:
        weights, open_share, design = _from_layout(config, servers, design)
    else:
        weights, open_share, design = _from_matrix_file(config, servers, design)
    open_part = 1.0 - config.hall.layout.containment
    share = open_share * open_part
    group_share = servers.per_group(share) * design.height_factor
    _check_intakes(config, servers, group_share)
    _check_airflows(config, design, weights, share)
    fresh = _open_fresh_share(config, design, open_share)
    if open_part < 1.0:
        fresh = 1.0 - (1.0 - fresh) * open_part
        design = _contained_design(config, servers, design, weights, group_share)
    # Inlets are warmed by the exhaust that they take in.
    need_m3s = design.airflow_m3s * (1.0 - design.approach_k / weights.apply(design.outlet_rise_k))
    if open_part < 1.0:
        design = replace(design, crac_flow_m3s=float(need_m3s.sum()) / fresh)
    return Recirculation(weights, share, group_share, fresh, need_m3s, design)


def _from_layout(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> tuple[MixWeights, F64, DesignPoint]:
    """Weights, exhaust shares and design point of the open hall by its layout."""
    if config.hall.recirculation.scaled_to == "rack":
        weights = layout_weights(config.hall, design.airflow_m3s)
        return weights, design.approach_k / weights.apply(design.outlet_rise_k), design
    airflow_m3s = design_point(config, servers, _mean_approach_k(config)).airflow_m3s
    weights = layout_weights(config.hall, airflow_m3s)
    return weights, *_shares_by_exposure(
        config, servers, weights, exposure(config.hall, airflow_m3s)
    )


def _from_matrix_file(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> tuple[MixWeights, F64, DesignPoint]:
    """Weights, exhaust shares and design point by a user's R or D."""
    settings = config.hall.recirculation
    path = Path(settings.matrix_file or "")
    kind, values = read_matrix(config, path)
    if settings.scaled_to in ("row", "hall"):
        design = design_point(config, servers, _mean_approach_k(config))
    elif kind == "D" and settings.scaled_to == "none":
        design = _solve_design_point(config, servers, lambda at: values @ at.it_w)
    matrix = share_matrix(config, path, kind, values, design)
    sums = matrix.sum(axis=1)
    none = sums == 0
    wanted_k = design.approach_k * none
    if settings.scaled_to == "rack" and np.any(wanted_k > 0):
        rack = int(np.argmax(wanted_k))
        raise ConfigError(
            f"{path}: row {rack} is zero, so that exhaust air cannot warm rack {rack} by the "
            f"{wanted_k[rack]:g} K of hall.supply_approach_k; valid is 0 K there or "
            "another hall.recirculation.calibrate than rack"
        )
    # A rack that takes in supply air alone also has a mix before it: that of all racks.
    weights = dense_weights(
        np.where(none[:, None], 1.0 / len(sums), matrix / np.where(none, 1.0, sums)[:, None])
    )
    if settings.scaled_to == "rack":
        return weights, design.approach_k / weights.apply(design.outlet_rise_k), design
    if settings.scaled_to != "none":
        return weights, *_shares_by_exposure(config, servers, weights, sums)
    design = _solve_design_point(config, servers, lambda at: sums * weights.apply(at.outlet_rise_k))
    return weights, sums, design


def _parts(config: DataCenterConfig) -> int:
    """Number of equal parts of a hall whose mean approach temperatures hold: its rows, or 1."""
    return config.hall.rows if config.hall.recirculation.scaled_to == "row" else 1


def _mean_approach_k(config: DataCenterConfig) -> F64:
    """Approach temperatures of the config, plain means over the rows or over the hall, K, (R,)."""
    hall, parts = config.hall, _parts(config)
    means = hall.rack_approach_k().reshape(parts, -1).mean(axis=1)
    return np.repeat(means, hall.racks // parts)


def _shares_by_exposure(
    config: DataCenterConfig, servers: RackServers, weights: MixWeights, exposed: F64
) -> tuple[F64, DesignPoint]:
    """Exhaust shares whose approach temperatures have the given means, and the design point.

    Args:
        config: The data center.
        servers: Its ``rack_servers``.
        weights: Weights of the exhaust mix before each rack.
        exposed: Exposure of each rack, 0 or more, (R,).

    Raises:
        ConfigError: means that exhaust air cannot bring about, or no steady state.
    """
    wanted_k = _mean_approach_k(config)

    def update(approach_k: F64) -> tuple[F64, tuple[F64, DesignPoint]]:
        design = design_point(config, servers, approach_k)
        mix_k = weights.apply(design.outlet_rise_k)
        share = _mean_share(config, mix_k, exposed, wanted_k)
        return share * mix_k, (share, design)

    within_k = _WITHIN_K if config.hall.racks <= _EXACT_RACKS else _LARGE_WITHIN_K
    return _settled(config, wanted_k, update, within_k)


def _mean_share(config: DataCenterConfig, mix_k: F64, exposed: F64, wanted_k: F64) -> F64:
    """Exhaust shares k e / (1 + k e) with the k of each part that gives the wanted means, (R,).

    The mean rises ever less with k, so that Newton's steps from 0 come near it from below.
    """
    hall, parts = config.hall, _parts(config)
    mix, e, wanted = (values.reshape(parts, -1) for values in (mix_k, exposed, wanted_k))
    goal = wanted[:, 0]
    most = np.mean(mix * (e > 0), axis=1)
    if np.any(goal > _MOST_MEAN_SHARE * most):
        part = int(np.argmax(goal - _MOST_MEAN_SHARE * most))
        where = f" of row {part}" if hall.recirculation.scaled_to == "row" else ""
        raise ConfigError(
            f"{hall.recirculation.matrix_file or config.name}: hall.supply_approach_k{where} is "
            f"{goal[part]:.3g} K on the mean, but the exhaust that its racks take in is "
            f"{most[part]:.3g} K above supply air on the mean; valid is at most "
            f"{100 * _MOST_MEAN_SHARE:g} % of that"
        )
    k = np.zeros(parts)
    for _ in range(_MOST_NEWTON_STEPS):
        odds = k[:, None] * e
        lacking = goal - np.mean(mix * odds / (1.0 + odds), axis=1)
        slope = np.mean(mix * e / (1.0 + odds) ** 2, axis=1)
        step = lacking / np.where(slope > 0, slope, 1.0)
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
    """Design point whose approach temperatures are those that follow from it.

    Power and airflow depend on the inlets, which depend on the outlets that power and airflow make.

    Args:
        config: The data center.
        servers: Its ``rack_servers``.
        approach_k: Inlet above supply air, K, (R,), that follows from a design point.

    Raises:
        ConfigError: no steady state.
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
    """Design point behind containment, but for the airflow of the CRAC units.

    Args:
        config: The data center.
        servers: Its ``rack_servers``.
        design: Design point of the open hall.
        weights: Weights of the exhaust mix before each rack.
        group_share: Share of each group's intake that is exhaust air, with containment, (G,).

    Raises:
        ConfigError: no steady state.
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
        start_k: Temperatures above supply air that the first update takes, K, (R,).
        update: Temperatures that follow from those before, K, (R,), and the result that goes with
            them.
        within_k: Change at which the temperatures count as steady, K.

    Returns:
        Result of the last update.

    Raises:
        ConfigError: no steady state.
    """
    before_k = start_k
    for _ in range(_MOST_ITERATIONS):
        after_k, result = update(before_k)
        if np.max(np.abs(after_k - before_k)) < within_k:
            return result
        before_k = after_k
    raise ConfigError(
        f"{config.hall.recirculation.matrix_file or config.name}: the hall finds no steady state "
        "at full load; valid is less recirculation"
    )


def _check_intakes(config: DataCenterConfig, servers: RackServers, group_share: F64) -> None:
    """Check that exhaust air is less than the whole intake of every server."""
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
    """Check that racks together take in no more of an exhaust than there is."""
    left = design.airflow_m3s - weights.apply_transposed(share * design.airflow_m3s)
    worst = int(np.argmin(left))
    if left[worst] < 0:
        raise ConfigError(
            f"{config.name}: the racks around rack {worst} breathe "
            f"{1 - left[worst] / design.airflow_m3s[worst]:.3g} times the air it exhausts; valid "
            "is at most 1 (lower hall.supply_approach_k or raise the rack's airflow)"
        )


def _open_fresh_share(config: DataCenterConfig, design: DesignPoint, share: F64) -> float:
    """Share of the CRAC air that the racks of the open hall take in, at most 1.

    Raises:
        ConfigError: CRAC units that do not give the air that the racks take in.
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
    """Coefficients of the exposure for one place of the returns."""

    around: float
    """Exposure at the very end of a row to air that comes round it."""
    around_length_m: float
    """Length over which air that comes round the end of a row fades, in m."""
    around_closed: float
    """Share of ``around`` that full containment takes away beyond what it takes from all paths."""
    over: float
    """Reduction of the exposure at the very end of a row to air that comes over the racks."""
    over_closed: float
    """Share of ``over`` that full containment takes away beyond what it takes from all paths."""
    demand: float
    """Change of the exposure divided by that of the demand for air, relative to its mean."""


_BY_RETURNS = {
    "ceiling": _Coefficients(4.0, 0.6, 0.0, 0.4, 1.0, 10.0),
    "end_wall": _Coefficients(0.6, 0.5, 0.35, 0.6, 0.0, 4.0),
}


def exposure(hall: HallConfig, airflow_m3s: F64) -> F64:
    """Exposure of every rack to exhaust air, relative to the other racks of its row, above 0, (R,).

    Air comes to an inlet round the ends of the rows and over the racks, and the more of it the more
    a rack and its neighbours draw than the floor gives them. The exposure of rack j, whose
    distances to the ends of its row are x,

        e_j = 1 + around sum_ends exp(-x / around_length) - over sum_ends exp(-x / OVER_M)
                + demand (v_j - 1)

    with v_j the airflow of the racks that face the aisle around j (weights exp(-distance /
    NEIGHBOURS_M)) over the mean of the aisle, kept above 0. Coefficients are fitted to the inlets
    that ``sdc-taichi hall solve`` finds for 63 halls of 8 to 200 racks; docs/hall.md shows how
    well.

    Args:
        hall: Rows, measures, returns and containment.
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
    # Above 0 and in the same order, where the floor gives more than the racks draw.
    return np.asarray(raw + np.hypot(raw, 2.0 * LEAST)).reshape(-1) / 2.0


def _from_ends(along_m: F64, length_m: float) -> F64:
    """Sum over both ends of a row of exp(-distance / length), (P,)."""
    from_first: F64 = np.exp(-along_m / length_m)
    return np.asarray(from_first + from_first[::-1], dtype=np.float64)


def _demand(hall: HallConfig, airflow_m3s: F64) -> F64:
    """Airflow drawn from the aisle around each rack over the mean of the aisle, (rows, P).

    Args:
        hall: Gives the distance of the racks.
        airflow_m3s: Airflow of each rack, m3/s, (rows, P).
    """
    rows, per_row = airflow_m3s.shape
    # Rows 0 and 1 face each other, and so on; the last of an odd number faces the wall.
    drawn = np.add.reduceat(airflow_m3s, np.arange(0, rows, 2), axis=0)
    drawn = drawn / drawn.mean(axis=1, keepdims=True)
    pitches = NEIGHBOURS_M / hall.layout.rack_pitch_m
    reach = min(per_row - 1, int(np.ceil(_REACH * pitches)))
    weights = np.exp(-np.abs(np.arange(-reach, reach + 1)) / pitches)

    def smoothed(values: F64) -> F64:
        return np.asarray(np.convolve(values, weights)[reach : reach + per_row])

    whole = smoothed(np.ones(per_row))
    # Most aisles of a hall are equal.
    distinct, aisle = np.unique(drawn, axis=0, return_inverse=True)
    around = np.stack([smoothed(values) / whole for values in distinct])
    return np.asarray(np.repeat(around[aisle.reshape(-1)], 2, axis=0)[:rows])
