"""Heat recirculation: the share of each rack's exhaust in the intake of each rack.

R_ji is the share of rack i's exhaust in the intake of rack j, r_j is the share of all exhaust air
in the intake of rack j, and w_ji are weights:

    T_in,j = (1 - r_j) T_sup + sum_i R_ji T_out,i,    R_ji = r_j w_ji,  sum_i w_ji = 1

(Tang, Gupta and Varsamopoulos 2008, *Energy-efficient thermal-aware task scheduling for homogeneous
high-performance computing data centers*, IEEE TPDS 19(11)). The weights w follow from the layout
(``mix_weights``) or from a matrix file (``matrix_file``). The shares r follow from the configured
approach temperatures (inlet minus supply). Those of every rack hold exactly at the design point.
Means of the rows or of the hall hold in a reference hall, whose racks are all alike; there the
racks differ by their places, and in the real hall also by the air that they and their neighbours
draw (``exposure``). With a matrix file, means hold in the real hall, and racks differ by the
matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import EXACT_RACKS, DesignPoint, design_point, design_point_at
from sdc_taichi.hall.exposure import TileAir, exposure, lack_slope, with_lack
from sdc_taichi.hall.matrix_file import read_matrix, share_matrix
from sdc_taichi.hall.mix_weights import MixWeights, dense_weights, layout_weights
from sdc_taichi.hall.rack_servers import RackServers, even_servers, rack_servers
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
"""Tolerance of the iteration for the exhaust mixes of a hall with given exhaust shares, in K."""
_MOST_SCALINGS, _SCALED_WITHIN = 50, 1e-10
"""Maximum number of iterations for supply air that does not suffice, and their tolerance."""


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
    tiles: TileAir
    """Exhaust shares at other airflows of the racks than those of the design point."""
    reference_it_w: float | None
    """IT power of each rack of the reference hall of the approach temperatures, in W; None if they
    are imposed on the racks as they are."""

    def matrix(self) -> F64:
        """Return the share of rack i's exhaust in the intake of rack j as entry [j, i], (R, R)."""
        return np.asarray(self.exhaust_share[:, None] * self.mix_weights.dense())


def calibrate(config: DataCenterConfig, servers: RackServers | None = None) -> Recirculation:
    """Calibrate the recirculation of a hall, from its layout or from a matrix file.

    The exhaust share of rack j is r_j = a_j / sum_i w_ji (a_i + dT_i) at the design point, with the
    approach temperatures a and the temperature rises dT through the racks. If only means of the
    approach temperatures are configured, r_j = k e_j / (1 + k e_j): the ratio of exhaust to supply
    air is the exposure e_j times a factor k, which is equal for all racks of the row or hall. k is
    found in the reference hall, whose racks are alike (``even_servers``). In the real hall the
    exposure is that of its airflows, and racks whose tiles lack air take in more (``TileAir``).
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
        calibrated = _from_layout(config, servers, design)
    else:
        calibrated = _from_matrix_file(config, servers, design)
    hall = config.hall
    weights, open_share, design = calibrated.weights, calibrated.share, calibrated.design
    open_part = hall.remaining_paths
    even_share = open_share if calibrated.even_odds is None else _share(calibrated.even_odds)
    even_share = open_part * even_share
    tiles = _tile_air(config, servers, calibrated, _odds(even_share), hall.layout.containment)
    if open_part < 1.0:
        tiles = replace(tiles, supply_scale=1.0)
    share = open_share if open_part == 1.0 else tiles.at_full_load()
    group_share = servers.per_group(share) * design.height_factor
    _check_intakes(config, servers, group_share)
    _check_airflows(config, design, weights, share)
    fresh = _open_fresh_share(config, design, open_share)
    if open_part < 1.0:
        fresh = 1.0 - (1.0 - fresh) * open_part
        design = _design_at_shares(config, servers, design, weights, group_share)
    # The exhaust share of an intake is its approach temperature divided by its exhaust mix.
    need_m3s = design.airflow_m3s * (1.0 - design.approach_k / weights.apply(design.outlet_rise_k))
    if open_part < 1.0:
        design = replace(design, crac_flow_m3s=float(need_m3s.sum()) / fresh)
    return Recirculation(
        weights, share, group_share, fresh, need_m3s, design, tiles, calibrated.reference_it_w
    )


@dataclass(frozen=True, slots=True)
class _Calibrated:
    """Recirculation without the effect of containment on approach temperatures of an open hall."""

    weights: MixWeights
    """Weights of the exhaust mix of each rack."""
    share: F64
    """Share of exhaust air in the intake of each rack, (R,)."""
    design: DesignPoint
    """Design point with these shares."""
    even_odds: F64 | None = None
    """Ratio of exhaust to supply air of racks that draw what their tiles give, (R,); None if the
    exhaust shares are imposed on the racks as they are."""
    supply_scale: float = 1.0
    """Factor of the supply air in all intakes, at most 1, see ``TileAir``."""
    reference_it_w: float | None = None
    """IT power of each rack of the reference hall, in W; None if there is none."""

    @property
    def is_computed(self) -> bool:
        """True if the exhaust shares are computed from a reference hall."""
        return self.even_odds is not None


def _odds(share: F64) -> F64:
    """Return the ratio of exhaust to supply air for exhaust shares, of the same shape."""
    return np.asarray(share / (1.0 - share))


def _share(odds: F64) -> F64:
    """Return the exhaust shares for ratios of exhaust to supply air, of the same shape."""
    return np.asarray(odds / (1.0 + odds))


def _tile_air(
    config: DataCenterConfig,
    servers: RackServers,
    calibrated: _Calibrated,
    odds: F64,
    containment: float,
) -> TileAir:
    """Return the exhaust shares of a hall at any airflow of its racks.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        calibrated: Recirculation without containment.
        odds: Ratio of exhaust to supply air of racks that draw what their tiles give, (R,), or at
            the design point if the exhaust shares are imposed.
        containment: Share of the air paths that containment closes, 0..1.
    """
    hall, ones, design = config.hall, np.ones(config.hall.racks), calibrated.design
    most_height = np.maximum.reduceat(design.height_factor, servers.group_offsets[:-1])
    tiles = TileAir(
        hall=hall,
        curves=config.servers.curves,
        density_ratio=servers.air.density_ratio,
        full_m3s=servers.per_rack(servers.count * design.full_airflow_m3s),
        inlet_c=design.supply_c + float(hall.rack_approach_k().mean()),
        odds=odds,
        balance=ones,
        slope=lack_slope(hall.layout.returns, containment),
        supply_scale=calibrated.supply_scale,
        of_height=servers.per_rack(design.height_factor) / servers.per_rack(servers.height_factor),
        most_share=1.0 / most_height,
    )
    return (
        tiles
        if calibrated.is_computed
        else replace(tiles, balance=tiles.draw(tiles.airflow_m3s(ones)))
    )


def _from_layout(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> _Calibrated:
    """Calibrate the recirculation of the layout, without containment."""
    if config.hall.recirculation.scaled_to == "rack":
        weights = layout_weights(config.hall, design.airflow_m3s)
        return _Calibrated(weights, design.approach_k / weights.apply(design.outlet_rise_k), design)
    settings, mean_k = config.hall.recirculation, _mean_approach_k(config)
    nominal = design_point(config, servers, mean_k)
    even = even_servers(servers, nominal.full_airflow_m3s, settings.reference_rack_kw)
    reference = nominal if even is servers else design_point(config, even, mean_k)
    weights = layout_weights(config.hall, reference.airflow_m3s)
    share, design, k = _shares_by_exposure(config, even, weights, _exposure(config, reference))
    reference_it_w = float(reference.it_w.mean())
    if even is servers:
        return _Calibrated(weights, share, design, _odds(share), reference_it_w=reference_it_w)
    even_odds = k * _exposure(config, nominal)
    if settings.reference_rack_kw is not None:
        # The floor is made for the reference hall, and gives the racks as much air as there.
        nominal = replace(nominal, crac_flow_m3s=reference.crac_flow_m3s)
        drawn = nominal.airflow_m3s.sum() / reference.airflow_m3s.sum()
        even_odds = with_lack(even_odds, (1.0 + even_odds) * (drawn - 1.0))
    calibrated = _Calibrated(
        layout_weights(config.hall, nominal.airflow_m3s),
        _share(even_odds),
        nominal,
        even_odds,
        reference_it_w=reference_it_w,
    )
    return _computed(config, servers, calibrated)


def _exposure(config: DataCenterConfig, design: DesignPoint) -> F64:
    """Return the exposure of every rack at the airflows of a design point, (R,)."""
    supply_share = design.crac_flow_m3s / float(design.airflow_m3s.sum())
    return exposure(config.hall, design.airflow_m3s, supply_share)


def _computed(
    config: DataCenterConfig, servers: RackServers, calibrated: _Calibrated
) -> _Calibrated:
    """Compute exhaust shares and design point of the real racks of a hall.

    Racks that lack air before their tiles take in more exhaust. If all racks together would take in
    more supply air than the floor gives, all take in the same share less.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        calibrated: Weights, ``even_odds``, and the design point at the mean approach temperatures.

    Raises:
        ConfigError: The hall finds no steady state.
    """
    assert calibrated.even_odds is not None
    hall, floor_m3s = config.hall, calibrated.design.crac_flow_m3s
    closed = hall.layout.containment if hall.remaining_paths == 1.0 else 0.0
    tiles, scale = _tile_air(config, servers, calibrated, calibrated.even_odds, closed), 1.0
    for _ in range(_MOST_SCALINGS):
        share = replace(tiles, supply_scale=scale).at_full_load()
        design = _design_of_shares(config, servers, calibrated, share)
        need_m3s = float(np.sum((1.0 - share) * design.airflow_m3s))
        if need_m3s <= floor_m3s * (1.0 + _SCALED_WITHIN):
            break
        scale *= floor_m3s / need_m3s
    design = replace(design, crac_flow_m3s=floor_m3s)
    return replace(calibrated, share=share, design=design, supply_scale=scale)


def _design_of_shares(
    config: DataCenterConfig, servers: RackServers, calibrated: _Calibrated, share: F64
) -> DesignPoint:
    """Return the design point of a hall with given exhaust shares of its racks.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        calibrated: Weights, and a design point with the same airflow of servers at full speed.
        share: Share of exhaust air in the intake of each rack, (R,).
    """
    near = calibrated.design
    # Servers with a design rise keep it; all others keep the airflow of the reference hall.
    by_rise = ~np.isnan(servers.design_rise_k)
    full_m3s = np.where(by_rise, servers.full_airflow_m3s, near.full_airflow_m3s)
    servers = replace(servers, full_airflow_m3s=full_m3s)

    def update(approach_k: F64) -> tuple[F64, DesignPoint]:
        nonlocal near
        near = design_point(config, servers, approach_k, near)
        return share * calibrated.weights.apply(near.outlet_rise_k), near

    exact = config.hall.racks <= EXACT_RACKS
    within_k = _WITHIN_K if exact else _LARGE_WITHIN_K
    return _settled(config, near.approach_k, update, within_k)


def _from_matrix_file(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> _Calibrated:
    """Calibrate the recirculation of a matrix file."""
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
        return _Calibrated(weights, design.approach_k / weights.apply(design.outlet_rise_k), design)
    if settings.scaled_to != "none":
        share, design, _ = _shares_by_exposure(config, servers, weights, sums)
        return _Calibrated(weights, share, design)
    design = _solve_design_point(config, servers, lambda at: sums * weights.apply(at.outlet_rise_k))
    return _Calibrated(weights, sums, design)


def _parts(config: DataCenterConfig) -> int:
    """Return the number of equal parts of the hall with their own mean: racks, rows, or 1.

    In a layout, one approach temperature for all racks is the mean of the hall, as it says nothing
    about rows.
    """
    hall, settings = config.hall, config.hall.recirculation
    by_rows = settings.matrix_file is not None or isinstance(hall.supply_approach_k, tuple)
    rows = hall.rows if by_rows else 1
    return {"rack": hall.racks, "row": rows}.get(settings.scaled_to, 1)


def _mean_approach_k(config: DataCenterConfig) -> F64:
    """Return the means of the configured approach temperatures by row or hall, in K, (R,)."""
    hall, parts = config.hall, _parts(config)
    means = hall.rack_approach_k().reshape(parts, -1).mean(axis=1)
    return np.repeat(means, hall.racks // parts)


def _shares_by_exposure(
    config: DataCenterConfig, servers: RackServers, weights: MixWeights, exposed: F64
) -> tuple[F64, DesignPoint, F64]:
    """Return exhaust shares for the configured mean approaches, design point, and factors k, (R,).

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

    def update(approach_k: F64) -> tuple[F64, tuple[F64, DesignPoint, F64]]:
        nonlocal near
        design = design_point(config, servers, approach_k, near)
        near = None if exact else design
        mix_k = weights.apply(design.outlet_rise_k)
        k = _exhaust_factor(config, mix_k, exposed, wanted_k)
        share = _share(k * exposed)
        return share * mix_k, (share, design, k)

    within_k = _WITHIN_K if exact else _LARGE_WITHIN_K
    return _settled(config, wanted_k, update, within_k)


def _exhaust_factor(config: DataCenterConfig, mix_k: F64, exposed: F64, wanted_k: F64) -> F64:
    """Return factors k whose exhaust shares k e / (1 + k e) give the wanted mean approaches, (R,).

    Each part (row or hall) has its own k. The mean is a concave, rising function of k, so Newton's
    method from k = 0 converges from below.
    """
    hall, parts = config.hall, _parts(config)
    mix, e, wanted = (values.reshape(parts, -1) for values in (mix_k, exposed, wanted_k))
    goal = wanted[:, 0]
    mean_mix = np.mean(mix * (e > 0), axis=1)
    if np.any(goal > _MOST_MEAN_SHARE * mean_mix):
        part = int(np.argmax(goal - _MOST_MEAN_SHARE * mean_mix))
        where = f" of row {part}" if parts > 1 else ""
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
    return np.repeat(k, hall.racks // parts)


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


def _design_at_shares(
    config: DataCenterConfig,
    servers: RackServers,
    design: DesignPoint,
    weights: MixWeights,
    group_share: F64,
) -> DesignPoint:
    """Compute the design point with given exhaust shares, except for the CRAC airflow.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        design: Design point with the same servers and height factors.
        weights: Weights of the exhaust mix of each rack.
        group_share: Share of exhaust air in each group's intake, (G,).

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
