"""Initial guess of the exhaust mixes of a hall's racks, from a table of steady states.

The *mix* of a rack is the weighted mean of the outlet temperatures that recirculate to it. In
steady air the mixes follow from the outlets, and the outlets from the mixes, so the kernel iterates
over the racks until both agree. A good initial guess saves most iterations. If all racks have the
same load, the solution depends only on supply temperature and load. It is therefore computed once
per hall on a grid of both and stored as coefficients of a few patterns over the racks. The kernel
interpolates the table with cubic polynomials.

Worked example: a hall has two racks, whose air intake is 10 % exhaust air of the other rack. The
supply air has 20 C, the load is full, and the racks heat their air by 12 and 8 K, independent of
the inlet. All temperatures below are relative to the supply. The mix of rack 0 is the outlet of
rack 1, and vice versa; the inlet of a rack is 0.1 times its mix. From mixes of 0 follow the outlets
(12, 8) K, hence the mixes (8, 12) K, the inlets (0.8, 1.2) K, and the outlets (12.8, 9.2) K. The
*feedback gain*, the change of an outlet divided by the change of its mix, is 0.1. The *residual* r
is the mix that follows from the outlets minus the mix from which the outlets were computed, here
(8, 12) - (0, 0). A Newton step is the series r + w G r + w G w G r + ..., with the weights
w = [[0, 1], [1, 0]] and the gains G = 0.1, that is (8, 12) + 0.1 (12, 8) + 0.01 (8, 12) + ... =
(9.29, 12.93) K, the exact solution. Racks of a real hall move more air at higher inlet
temperatures. Their gains are estimated from the last two steps, so that few steps suffice.

The solutions at all supply temperatures and loads are then written as sums of patterns. If the
mixes of the two racks were (9.29, 12.93) K times the load everywhere, the pattern (0.58, 0.81) with
coefficient 15.9 K times the load would represent all of them. A hall has up to ``PATTERNS``
patterns, the principal components of its table.

The heat that liquid-cooled racks give to the air depends on their coolant as well. Tables of halls
with such racks are computed at three heats, and their coefficients are parabolas of the heat.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall.design_point import DesignPoint
from sdc_taichi.hall.rack_servers import RackServers
from sdc_taichi.hall.recirculation import Recirculation
from sdc_taichi.hall.steady_modes import SteadyModes
from sdc_taichi.plant.air import DensityRatio
from sdc_taichi.plant.servers import ServerCurves
from sdc_taichi.types import F32, F64, I32

TABLE_LOADS = np.linspace(0.0, 1.0, 161)
"""Grid of loads of the table. It is fine because airflow and power have kinks at their limits, at a
different load for each rack and height."""
SUPPLY_STEP_K = 0.5
"""Spacing of the supply temperatures of the table, in K, chosen because setpoints change by whole
or half kelvins. The spacing is wider if the range of setpoints is wide, see ``MOST_SUPPLIES``."""
MOST_SUPPLIES = 65
"""Largest number of supply temperatures of the table."""
PATTERNS = 7
"""Largest number of patterns of a hall. For 20 racks, 7 patterns reproduce all mixes to within
2e-4 K."""
_SAMPLED_LOADS_STEP = 8
"""Step through the loads of the table for the sampled racks of a large hall, interpolated between
them: these racks are so few that another of their sweeps costs little."""

_BATCH_VALUES, _LEAST_BATCH = 2**13, 32
"""Number of values per batch, chosen so that a batch fits into the processor's cache, and smallest
number of table entries per batch."""
_IS_LIQUID = 6
"""Row of ``_HallPart.columns`` that is 1 for servers of liquid-cooled racks."""
_HEAT_STEP = 0.05
"""Change of the heat of liquid-cooled racks between the levels of a table, divided by their heat at
full load."""
_SECANT_K = 1e-3
"""Smallest change of a mix, in K, from which a feedback gain is estimated."""
_LAST_STEP_K = 2e-3
"""Newton step below which the iteration ends, in K; the next step would be 50 to 100 times
smaller."""
USUAL_GAIN = 0.2
"""Initial value of the feedback gains, which is typical of halls."""
_MOST_GAIN = 0.9
"""Largest absolute value of a feedback gain."""
_MOST_HEAT_K = 100.0
"""Upper limit of the temperature rise of the air, in K. Without this limit, table entries with
almost no airflow would dominate the patterns."""
_MOST_PASSES = 10
"""Largest number of Newton steps with merged server groups."""
_MOST_EXACT_PASSES = 2
"""Largest number of Newton steps with all server groups, starting from the merged solution."""
_NEUMANN_TERMS = 4
"""Number of terms of the Neumann series that gives a Newton step."""


@dataclass(frozen=True, slots=True)
class SteadyStateTable:
    """Table of steady states of a hall of R racks, as coefficients of patterns over the racks."""

    supply_c: F64
    """Supply temperatures of the table, evenly spaced, in C, (n,)."""
    patterns: F64
    """Patterns of exhaust mix minus supply temperature over the racks, (k, R)."""
    pattern_shares: F32
    """Coefficients of the patterns in each steady state, (levels, n, len(TABLE_LOADS), k). In halls
    with liquid-cooled racks level i is multiplied by the i-th power of the heat that these racks
    give to the air, divided by that at full load. Other halls have level 0 alone."""
    feedback_gain: F32
    """Change of a rack's outlet divided by the change of its exhaust mix, in K/K, averaged over the
    racks, (n, len(TABLE_LOADS))."""


def initial_guess(
    config: DataCenterConfig,
    servers: RackServers,
    recirculation: Recirculation,
    modes: SteadyModes | None = None,
) -> SteadyStateTable:
    """Compute the table of steady states of a hall, or of the sampled racks of a large hall.

    All racks have the same load, and the CRAC units supply enough air.

    Args:
        config: The data center.
        servers: Servers of the hall, see ``rack_servers``.
        recirculation: Calibrated recirculation of the hall.
        modes: Modes of a large hall, whose sampled racks are computed; None computes all racks.
    """
    supply_c = table_supplies_c(config, recirculation.design)
    loads = TABLE_LOADS if modes is None else TABLE_LOADS[::_SAMPLED_LOADS_STEP]
    part = _hall_part(config, servers, recirculation, modes)
    liquid = part.columns[:3, part.columns[_IS_LIQUID] > 0.0]
    usual, *others = (
        _steady_states(config, servers, part, recirculation, supply_c, loads, more_heat)
        for more_heat in ((0.0, -_HEAT_STEP, _HEAT_STEP) if liquid.size else (0.0,))
    )
    mixes_k = np.stack([states.mix_k[:, :-1] for states in (usual, *others)], axis=1)
    patterns, shares = _strongest_patterns(mixes_k.reshape(len(mixes_k), -1))
    levels = shares.reshape(len(patterns), *mixes_k.shape[1:])
    if others:
        count, full_w, idle_w = liquid
        idle = np.sum(count * idle_w) / np.sum(count * full_w)
        usual_heat = np.tile(idle + loads * (1.0 - idle), len(supply_c))
        levels = _powers_of_heat(levels, usual_heat)
    gain = usual.feedback_gain.mean(axis=0)[:-1]
    rows = np.concatenate([levels.reshape(-1, gain.size), gain[None]]).reshape(-1, len(loads))
    between = np.stack([np.interp(TABLE_LOADS, loads, row) for row in rows])
    table = between.reshape(-1, len(supply_c), len(TABLE_LOADS)).astype(np.float32)
    return SteadyStateTable(
        supply_c=supply_c,
        patterns=patterns,
        pattern_shares=np.moveaxis(table[:-1].reshape(*levels.shape[:2], *table.shape[1:]), 0, 3),
        feedback_gain=table[-1],
    )


def _powers_of_heat(shares: F64, heat: F64) -> F64:
    """Return the coefficients of the parabola of heat through three values of pattern shares.

    Args:
        shares: Pattern shares at the usual heat, ``_HEAT_STEP`` below and above it, (k, 3, m).
        heat: Usual heat of liquid-cooled racks, divided by that at full load, (m,).

    Returns:
        Coefficients of the powers 0, 1 and 2 of the heat, (k, 3, m).
    """
    at, below, above = np.moveaxis(shares, 1, 0)
    slope = (above - below) / (2.0 * _HEAT_STEP)
    bend = (above + below - 2.0 * at) / (2.0 * _HEAT_STEP**2)
    return np.stack([at - heat * (slope - heat * bend), slope - 2.0 * heat * bend, bend], axis=1)


def table_supplies_c(config: DataCenterConfig, design: DesignPoint) -> F64:
    """Return supply temperatures that cover the range of setpoints, in C, (n,)."""
    setpoint = config.hvac.setpoint
    over_k = design.setpoint_over_supply_k(config)
    low_c, span_k = setpoint.min_c - over_k, setpoint.max_c - setpoint.min_c + over_k
    step_k = max(SUPPLY_STEP_K, span_k / (MOST_SUPPLIES - 1))
    count = 1 + max(1, int(np.ceil(span_k / step_k - 1e-9)))
    return np.asarray(low_c + step_k * np.arange(count), dtype=np.float64)


class _HallPart(NamedTuple):
    """Racks whose steady states are computed: all racks, or the sampled racks of a large hall."""

    group_offsets: I32
    """Index of the first server group of each of R racks, and the number of groups, (R + 1,)."""
    columns: F64
    """Properties of the G server groups, (8, G). The rows are count, full power, idle power, load
    deviation, full airflow divided by that of the largest server, fan power at the reference ratio,
    1 for servers of liquid-cooled racks and 0 for others, and exhaust share."""
    weights: F64
    """Weights of the exhaust mix, (R, R)."""
    first_mix_k: F64
    """First estimate of the exhaust mix of each rack minus supply temperature, in K, (R,)."""


def _hall_part(
    config: DataCenterConfig,
    servers: RackServers,
    recirculation: Recirculation,
    modes: SteadyModes | None,
) -> _HallPart:
    """Return all racks of a hall, or the racks that its modes sample."""
    is_liquid = np.zeros(config.hall.racks)
    is_liquid[[*config.liquid_racks()]] = 1.0
    offsets = servers.group_offsets
    columns = _columns(servers, recirculation, servers.per_group(is_liquid))
    outlet_k = recirculation.design.outlet_rise_k
    if modes is None:
        weights = recirculation.mix_weights
        return _HallPart(offsets, columns, weights.dense(), weights.apply(outlet_k))
    groups = [np.arange(*offsets[rack : rack + 2]) for rack in modes.racks]
    return _HallPart(
        group_offsets=np.cumsum([0, *map(len, groups)], dtype=np.int32),
        columns=columns[:, np.concatenate(groups)],
        weights=modes.sample_weights,
        first_mix_k=outlet_k[modes.racks],
    )


def _columns(servers: RackServers, recirculation: Recirculation, is_liquid: F64) -> F64:
    """Return the properties of the server groups for ``_HallPart.columns``, (8, G)."""
    full_m3s = recirculation.design.full_airflow_m3s
    return np.stack(
        [
            servers.count,
            servers.full_w,
            servers.idle_w,
            servers.load_deviation,
            full_m3s / full_m3s.max(),
            servers.fan_reference_w,
            is_liquid,
            recirculation.group_exhaust_share,
        ]
    )


def _steady_states(
    config: DataCenterConfig,
    servers: RackServers,
    part: _HallPart,
    recirculation: Recirculation,
    supply_c: F64,
    loads: F64,
    more_heat: float,
) -> _SteadyStates:
    """Compute the steady states of the whole table and, as the last entry, of the design point.

    ``more_heat`` is the heat of liquid-cooled racks above that of their load, divided by that at
    full load.
    """
    design = recirculation.design
    shape = len(part.first_mix_k), len(supply_c) * len(loads) + 1
    states = _SteadyStates(
        curves=config.servers.curves,
        weights=part.weights,
        density_ratio=servers.air.density_ratio,
        k_per_w=1.0 / (float(design.full_airflow_m3s.max()) * design.air_j_per_m3_k),
        supply_c=np.append(np.repeat(supply_c, len(loads)), design.supply_c),
        load=np.append(np.tile(loads, len(supply_c)), 1.0),
        more_heat=more_heat,
        mix_k=np.broadcast_to(part.first_mix_k[:, None], shape),
        feedback_gain=np.full(shape, USUAL_GAIN),
    )
    groups = _by_rack(part.group_offsets, part.columns)
    merged = _by_rack(*_merge_neighbours(part.group_offsets, part.columns))
    states.solve(merged, _MOST_PASSES)
    if groups.size > merged.size:
        states.solve(groups, _MOST_EXACT_PASSES)
    return states


def _strongest_patterns(mix_k: F64) -> tuple[F64, F64]:
    """Return the principal components of m vectors of exhaust mixes, (R, m).

    Returns:
        Patterns, (k, R), strongest first, and their coefficients, (k, m).
    """
    # ``eigh`` sorts by ascending eigenvalue. The (R, R) product is so small that NumPy starts no
    # threads for it.
    patterns = np.linalg.eigh(mix_k @ mix_k.T)[1].T[: -PATTERNS - 1 : -1]
    return patterns, patterns @ mix_k


@dataclass(slots=True)
class _SteadyStates:
    """Solver for the steady exhaust mixes of R racks at m pairs of supply temperature and load."""

    curves: ServerCurves
    """Power and airflow curves of the servers."""
    weights: F64
    """Weights of the exhaust mix, (R, R)."""
    density_ratio: DensityRatio
    """Density of air divided by its value at the reference temperature."""
    k_per_w: float
    """Temperature rise of the air divided by power, for the largest server at an airflow ratio of
    1, in K/W."""
    supply_c: F64
    """Supply temperature of each pair, in C, (m,)."""
    load: F64
    """Load of each pair, 0..1, (m,)."""
    more_heat: float
    """Heat of liquid-cooled racks above that of their load, divided by that at full load."""
    mix_k: F64
    """Exhaust mix of each rack minus supply temperature, in K, (R, m)."""
    feedback_gain: F64
    """Change of each rack's outlet divided by the change of its exhaust mix, in K/K, (R, m)."""

    def solve(self, groups: F64, passes: int) -> None:
        """Take Newton steps towards mixes that are consistent with their outlets.

        With the outlets T(m) at the mixes m, the residual is w T(m) - m. A step s solves
        (1 - w G) s = residual by a Neumann series, where the diagonal matrix G contains the
        feedback gains, estimated as secants from the previous step.

        Args:
            groups: Server groups by rack, see ``_by_rack``, (8, R, largest number of groups).
            passes: Largest number of steps.
        """
        previous: tuple[F64, F64] | None = None
        for _ in range(passes):
            outlet_k = self._outlet_k(groups)
            if previous is not None:
                self._update_gain(outlet_k - previous[1], self.mix_k - previous[0])
            previous = self.mix_k, outlet_k
            step_k = term_k = self.weights @ outlet_k - self.mix_k
            for _ in range(_NEUMANN_TERMS):
                term_k = self.weights @ (self.feedback_gain * term_k)
                step_k = step_k + term_k
            self.mix_k = self.mix_k + step_k
            if np.max(np.abs(step_k)) < _LAST_STEP_K:
                break

    def _update_gain(self, outlet_change_k: F64, mix_change_k: F64) -> None:
        """Update feedback gains where the changes of the mixes, (R, m), are large enough."""
        gain = np.divide(
            outlet_change_k,
            mix_change_k,
            out=self.feedback_gain.copy(),
            where=np.abs(mix_change_k) > _SECANT_K,
        )
        self.feedback_gain = np.clip(gain, -_MOST_GAIN, _MOST_GAIN)

    def _outlet_k(self, groups: F64) -> F64:
        """Return outlet minus supply temperatures for the present mixes, in K, (R, m)."""
        rows = (row[..., None] for row in groups)
        count, full_w, idle_w, deviation, full_airflow, fan_w, is_liquid, exhaust_share = rows
        outlet_k = np.empty_like(self.mix_k)
        batch = max(_LEAST_BATCH, _BATCH_VALUES // count.size)
        for first in range(0, len(self.load), batch):
            at = slice(first, first + batch)
            inlet_k = self.mix_k[:, None, at] * exhaust_share
            load = self.load[at]
            load = load + deviation * (load * (1.0 - load))
            inlet_c = self.supply_c[at] + inlet_k
            ratio = self.curves.airflow_ratio(inlet_c, load)
            power_w = self.curves.cpu_w(inlet_c, load, full_w, idle_w)
            if is_liquid.any():
                heat_w = idle_w + load * (full_w - idle_w) + self.more_heat * full_w
                power_w = np.where(is_liquid, heat_w, power_w)
            power_w += self.curves.fan_w(ratio, fan_w)
            ratio = self.curves.moved_ratio(ratio, inlet_c, self.density_ratio)
            ratio = ratio * (count * full_airflow)
            flow = np.maximum(np.sum(ratio, axis=1), 1e-9)
            heat_k = np.sum(power_w * count, axis=1) / flow * self.k_per_w
            inlet_k = np.sum(inlet_k * ratio, axis=1) / flow
            outlet_k[:, at] = inlet_k + np.minimum(heat_k, _MOST_HEAT_K)
        return outlet_k


def _by_rack(group_offsets: I32, columns: F64) -> F64:
    """Arrange columns of groups, (8, G), by rack as (8, R, largest number of groups).

    Padding groups have a count of 0.
    """
    sizes = np.diff(group_offsets)
    place = np.arange(int(sizes.max()))
    out = columns[:, group_offsets[:-1, None] + np.minimum(place, sizes[:, None] - 1)]
    out[0] *= place < sizes[:, None]
    return np.asarray(out)


def _merge_neighbours(group_offsets: I32, columns: F64) -> tuple[I32, F64]:
    """Merge neighbouring groups of a rack that have the same exhaust share into a mean group."""
    first = np.diff(columns[-1], prepend=np.nan) != 0.0
    first[group_offsets[:-1]] = True
    begin = np.flatnonzero(first)
    count = columns[0]
    servers = np.add.reduceat(count, begin)
    means = np.add.reduceat(count * columns[1:], begin, axis=1) / servers
    merged = np.searchsorted(begin, group_offsets).astype(np.int32)
    return merged, np.concatenate([[servers], means])
