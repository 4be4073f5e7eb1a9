"""Heat recirculation: which rack breathes whose exhaust, and how much.

With R_ji the share of rack j's intake that is rack i's exhaust,

    T_in,j = (1 - r_j) T_sup + sum_i R_ji T_out,i,    R_ji = r_j w_ji,  sum_i w_ji = 1

(Tang, Gupta and Varsamopoulos 2008, *Energy-efficient thermal-aware task scheduling for homogeneous
high-performance computing data centers*, IEEE TPDS 19(11)). The weights w are those of the exhaust
mix before each rack (``mix_weights``) or of a user's matrix (``matrix_file``); the shares r are
such that the given approach temperatures come out exactly at the design point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.design_point import DesignPoint, design_point
from sdc_taichi.hall.matrix_file import read_matrix, share_matrix
from sdc_taichi.hall.mix_weights import MixWeights, dense_weights, layout_weights
from sdc_taichi.hall.rack_servers import RackServers, rack_servers
from sdc_taichi.types import F64

_MOST_ITERATIONS = 500


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
    approach_k: F64
    """Mean inlet over supply of each rack at the design point, in K, (R,); below
    ``design.approach_k`` where containment closes paths."""
    design: DesignPoint
    """Design point of the hall without containment."""

    def matrix(self) -> F64:
        """R, the share of each rack's intake (rows) that is each rack's exhaust, (R, R)."""
        return np.asarray(self.exhaust_share[:, None] * self.mix_weights.dense())


def calibrate(config: DataCenterConfig, servers: RackServers | None = None) -> Recirculation:
    """Recirculation of a hall, from its layout or from a matrix of the user's.

    r_j = a_j / sum_i w_ji (a_i + dT_i) at the design point, less the share that containment
    closes; the approach temperatures a are those of the open hall, dT is the rise through a rack.

    Args:
        config: A data center with inlet model ``recirculation``.
        servers: Its ``rack_servers``, if at hand.

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
        # What follows from a matrix is wrong because of it, if the hall alone is right.
        named = path is None or str(path) in str(error)
        raise ConfigError(str(error) if named else f"{path}: {error}") from None


def _calibrated(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> Recirculation:
    """Recirculation of a hall that has a design point without it."""
    if config.hall.recirculation.matrix_file is None:
        weights = layout_weights(config.hall, design.airflow_m3s)
        share = design.approach_k / weights.apply(design.outlet_rise_k)
        share = share * (1.0 - config.hall.layout.containment)
    else:
        weights, share, design = _from_matrix_file(config, servers, design)
    group_share = servers.per_group(share) * design.height_factor
    _check_intakes(config, servers, group_share)
    _check_airflows(config, design, weights, share)
    fresh = float(np.sum((1.0 - share) * design.airflow_m3s)) / design.crac_flow_m3s
    fresh, approach_k = min(fresh, 1.0), design.approach_k
    if config.hall.layout.containment > 0:
        approach_k = _contained_approach_k(config, servers, design, weights, share, fresh)
    return Recirculation(weights, share, group_share, fresh, approach_k, design)


def _from_matrix_file(
    config: DataCenterConfig, servers: RackServers, design: DesignPoint
) -> tuple[MixWeights, F64, DesignPoint]:
    """Weights, exhaust shares and design point by a user's R or D."""
    settings = config.hall.recirculation
    path = Path(settings.matrix_file or "")
    kind, given = read_matrix(config, path)
    if kind == "D" and not settings.calibrate:
        design = _solve_design_point(config, servers, lambda at: given @ at.it_w)
    matrix = share_matrix(config, path, kind, given, design)
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
    weights = dense_weights(
        np.where(none[:, None], 1.0 / len(sums), matrix / np.where(none, 1.0, sums)[:, None])
    )
    if settings.calibrate:
        return weights, design.approach_k / weights.apply(design.outlet_rise_k), design
    design = _solve_design_point(config, servers, lambda at: sums * weights.apply(at.outlet_rise_k))
    return weights, sums, design


def _solve_design_point(
    config: DataCenterConfig,
    servers: RackServers,
    approach_k: Callable[[DesignPoint], F64],
    within_k: float = 1e-12,
) -> DesignPoint:
    """Design point whose approach temperatures are those that follow from it.

    Power and airflow depend on the inlets, which depend on the outlets that power and airflow make:
    the fixed point is found by repeated substitution.

    Args:
        config: The data center.
        servers: Its ``rack_servers``.
        approach_k: Inlet over supply air, K, (R,), that follows from a design point.
        within_k: Change of the approach temperatures at which they count as found, K.

    Raises:
        ConfigError: no steady state.
    """
    before = config.hall.rack_approach_k()
    for _ in range(_MOST_ITERATIONS):
        design = design_point(config, servers, before)
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
    servers: RackServers,
    design: DesignPoint,
    weights: MixWeights,
    share: F64,
    fresh_share: float,
) -> F64:
    """Inlet over supply behind containment, in K, (R,), to a thousandth of a kelvin."""
    full = {"fan_full_airflow_m3s": design.fan_full_airflow_m3s}
    contained = config.model_copy(update={"servers": config.servers.model_copy(update=full)})

    def approach_k(at: DesignPoint) -> F64:
        # Air that the units cannot supply comes from the exhaust mix too.
        need = float(np.sum((1.0 - share) * at.airflow_m3s))
        covered = min(1.0, fresh_share * design.crac_flow_m3s / need)
        return (1.0 - (1.0 - share) * covered) * weights.apply(at.outlet_rise_k)

    return _solve_design_point(contained, servers, approach_k, within_k=1e-3).approach_k


def _check_intakes(config: DataCenterConfig, servers: RackServers, group_share: F64) -> None:
    """Make sure that no server would have to breathe more exhaust air than it takes in at all."""
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
    """Make sure that exhausts and CRAC units give the air that the racks take in."""
    left = design.airflow_m3s - weights.apply_transposed(share * design.airflow_m3s)
    worst = int(np.argmin(left))
    if left[worst] < 0:
        raise ConfigError(
            f"{config.name}: the racks around rack {worst} breathe "
            f"{1 - left[worst] / design.airflow_m3s[worst]:.3g} times the air it exhausts; valid "
            "is at most 1 (lower hall.supply_approach_k or raise the rack's airflow)"
        )
    fresh = float(np.sum((1.0 - share) * design.airflow_m3s))
    # Containment turns recirculation into demand for supply air, which may then fall short.
    if fresh > design.crac_flow_m3s * (1 + 1e-9) and config.hall.layout.containment == 0:
        raise ConfigError(
            f"{config.name}: servers draw {fresh:.4g} m3/s of supply air at full load, the CRAC "
            f"units give {design.crac_flow_m3s:.4g}; lower servers.fan_full_airflow_m3s (null "
            "derives it) or raise hvac.crac.supply_m3s_per_w"
        )
