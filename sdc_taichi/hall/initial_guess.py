"""First guess of the exhaust mixes before the racks, from a table of a hall's steady states.

In steady air the mixes follow from the outlets, and the outlets from the mixes: the kernel sweeps
over the racks until they agree. A guess near the answer saves most of the sweeps. Where racks are
loaded alike the answer depends on supply temperature and load alone, so it is computed once per
hall for a grid of both and stored as shares of a few patterns over the racks. The kernel reads the
table with cubics.

Worked example: a hall of two racks, each of which takes in 10 % exhaust air, all of it from the
other rack, at a supply of 20 C and full load. Let the racks warm their air by 12 and 8 K. The
*mix* before rack 0 is the outlet of rack 1 above the supply, and the other way round; the inlet of
a rack is 0.1 times its mix. Starting from mixes of 0, the outlets are (12, 8) K above the supply,
so the mixes that they make are (8, 12) K, the inlets 0.8 and 1.2 K, and the outlets then 12.8 and
9.2 K, if the rise of a rack does not change with its inlet: the *feedback gain*, the change of an
outlet with its mix, is 0.1. The *residual* of a search is the mix that the outlets make less the
mix that they were computed for, here (8, 12) - (0, 0). A Newton step adds what the residual brings
about in turn, r + w G r + w G w G r + ..., with weights w = [[0, 1], [1, 0]] and gains G = 0.1: (8,
12) + 0.1 (12, 8) + 0.01 (8, 12) + ... = (9.29, 12.93) K, which is the answer. Racks of a real hall
move more air as they get warmer, so gains are read off the last two steps, and few steps are
needed.

The answers of all supplies and loads are then written as sums of patterns. If the mixes of the two
racks were (9.29, 12.93) K times the load everywhere, one pattern (0.58, 0.81) would hold them all,
with shares of 15.9 K times the load; a hall has up to ``PATTERNS`` of them, the principal
components of its table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall.design_point import DesignPoint
from sdc_taichi.hall.mix_weights import DENSE_RACKS
from sdc_taichi.hall.rack_servers import RackServers
from sdc_taichi.hall.recirculation import Recirculation
from sdc_taichi.plant.air import DensityRatio
from sdc_taichi.plant.servers import ServerCurves
from sdc_taichi.types import F32, F64, I32

TABLE_LOADS = np.linspace(0.0, 1.0, 161)
"""Loads of the table. They are close because airflow and power have kinks where their limits set
in, at a different load for each rack and height."""
SUPPLY_STEP_K = 0.5
"""Distance of the supply temperatures of the table, in K; setpoints move in whole or half kelvins.
A wide range of setpoints has wider steps."""
MOST_SUPPLIES = 65
"""Most supply temperatures of the table of a wide range of setpoints."""
PATTERNS = 7
"""Largest number of patterns of a hall; they reproduce all mixes of a hall of 20 racks to 2e-4
K."""
SAMPLED_RACKS = 4
"""Number of racks whose mean represents all racks of a hall that drops weights."""

_BATCH_VALUES, _LEAST_BATCH = 2**13, 32
"""Number of values per batch, so that a batch fits into the processor's cache, and smallest number
of table entries per batch."""
_SECANT_K = 1e-3
"""Smallest move of a mix, in K, from which a feedback gain is read."""
_LAST_STEP_K = 2e-3
"""Largest Newton step that ends the search, in K; the next one would be 50 to 100 times shorter."""
_USUAL_GAIN = 0.2
"""Feedback gain of a usual hall, with which the search starts."""
_MOST_GAIN = 0.9
"""Largest absolute feedback gain that the search uses."""
_MOST_HEAT_K = 100.0
"""Upper limit of the temperature rise of the air, in K. Without it, entries at almost no airflow
would dominate the patterns."""
_MOST_PASSES = 10
"""Most Newton steps with merged server groups."""
_MOST_EXACT_PASSES = 2
"""Most Newton steps with all server groups, from the result with merged ones."""
_NEUMANN_TERMS = 4
"""Terms of the Neumann series that solves for a Newton step."""


@dataclass(frozen=True, slots=True)
class SteadyStateTable:
    """Steady states of a hall as shares of patterns over its racks."""

    supply_c: F64
    """Supply temperatures of the table, evenly spaced, in C, (n,)."""
    patterns: F64
    """Patterns over the racks, (k, R). In halls of up to DENSE_RACKS they are patterns of the
    exhaust mix above supply air. In larger halls they are, at the design point and in K, the mix of
    approach temperatures, the mix of temperature rises, the approach temperatures and the rises of
    the racks themselves, (4, R)."""
    pattern_shares: F32
    """How much of each pattern a steady state holds, (n, len(TABLE_LOADS), k). In larger halls k is
    2: one share for approach temperatures, one for rises, of mixes and racks alike."""
    feedback_gain: F32
    """Change of a rack's outlet with a change of the mix before it, in K/K, mean over the racks,
    (n, len(TABLE_LOADS))."""


def initial_guess(
    config: DataCenterConfig, servers: RackServers, recirculation: Recirculation
) -> SteadyStateTable:
    """Table of the steady states of a hall whose CRAC units supply enough air for its racks.

    All racks have the same load. Halls of up to DENSE_RACKS are computed as they are, larger ones
    as the mean of SAMPLED_RACKS racks.

    Args:
        config: The data center.
        servers: Its ``rack_servers``.
        recirculation: Its calibrated recirculation.
    """
    supply_c = _table_supplies_c(config, recirculation.design)
    dense = config.hall.racks <= DENSE_RACKS
    part = (_whole_hall if dense else _sampled_racks)(servers, recirculation)
    states = _steady_states(config, servers, part, recirculation, supply_c)
    if dense:
        patterns, shares = _strongest_patterns(states.mix_k[:, :-1])
    else:
        patterns, shares = _design_patterns(states, recirculation)
    gain = states.feedback_gain.mean(axis=0)[:-1]
    grid = len(supply_c), len(TABLE_LOADS)
    return SteadyStateTable(
        supply_c=supply_c,
        patterns=patterns,
        pattern_shares=shares.T.reshape(*grid, -1).astype(np.float32),
        feedback_gain=gain.reshape(grid).astype(np.float32),
    )


def _table_supplies_c(config: DataCenterConfig, design: DesignPoint) -> F64:
    """Supply temperatures of the table, which cover the range of setpoints, in C, (n,)."""
    setpoint = config.hvac.setpoint
    over_k = design.setpoint_over_supply_k(config)
    low_c, span_k = setpoint.min_c - over_k, setpoint.max_c - setpoint.min_c + over_k
    step_k = max(SUPPLY_STEP_K, span_k / (MOST_SUPPLIES - 1))
    count = 1 + max(1, int(np.ceil(span_k / step_k - 1e-9)))
    return np.asarray(low_c + step_k * np.arange(count), dtype=np.float64)


class _HallPart(NamedTuple):
    """Racks whose steady states are computed: all of a hall, or a sample of it as one rack."""

    group_offsets: I32
    """First server group of each rack, (R + 1,)."""
    columns: F64
    """Rows count, full power, idle power, load deviation, full airflow divided by that of the
    largest server, fan power at the reference ratio and exhaust share of the server groups, (7,
    G)."""
    weights: F64
    """Weights of the exhaust mix, (R, R)."""
    design_mix_k: F64
    """Exhaust mix before each rack above supply air at the design point, in K, (R,)."""


def _whole_hall(servers: RackServers, recirculation: Recirculation) -> _HallPart:
    """All racks of a hall."""
    weights = recirculation.mix_weights
    return _HallPart(
        group_offsets=servers.group_offsets,
        columns=_columns(servers, recirculation),
        weights=weights.dense(),
        design_mix_k=weights.apply(recirculation.design.outlet_rise_k),
    )


def _sampled_racks(servers: RackServers, recirculation: Recirculation) -> _HallPart:
    """A sample of the racks of a hall as one rack that takes in its own exhaust."""
    offsets, outlet_rise_k = servers.group_offsets, recirculation.design.outlet_rise_k
    racks = len(outlet_rise_k)
    # Racks at the ends of rows breathe more exhaust than others: some of each.
    places = (2 * np.arange(SAMPLED_RACKS) + 1) * racks // (2 * SAMPLED_RACKS)
    sample = np.sort(np.argsort(recirculation.exhaust_share, kind="stable")[places])
    groups = np.concatenate([np.arange(*offsets[rack : rack + 2]) for rack in sample])
    return _HallPart(
        group_offsets=np.array([0, len(groups)], dtype=np.int32),
        columns=_columns(servers, recirculation)[:, groups],
        weights=np.ones((1, 1)),
        design_mix_k=outlet_rise_k[sample].mean(keepdims=True),
    )


def _columns(servers: RackServers, recirculation: Recirculation) -> F64:
    """Values of the server groups that the steady states need, see ``_HallPart``, (7, G)."""
    full_m3s = recirculation.design.full_airflow_m3s
    return np.stack(
        [
            servers.count,
            servers.full_w,
            servers.idle_w,
            servers.load_deviation,
            full_m3s / full_m3s.max(),
            servers.fan_reference_w,
            recirculation.group_exhaust_share,
        ]
    )


def _steady_states(
    config: DataCenterConfig,
    servers: RackServers,
    part: _HallPart,
    recirculation: Recirculation,
    supply_c: F64,
) -> _SteadyStates:
    """Steady states of the whole table and, as the last entry, of the design point."""
    design = recirculation.design
    shape = len(part.design_mix_k), len(supply_c) * len(TABLE_LOADS) + 1
    states = _SteadyStates(
        curves=config.servers.curves,
        weights=part.weights,
        density_ratio=servers.air.density_ratio,
        k_per_w=1.0 / (float(design.full_airflow_m3s.max()) * design.air_j_per_m3_k),
        supply_c=np.append(np.repeat(supply_c, len(TABLE_LOADS)), design.supply_c),
        load=np.append(np.tile(TABLE_LOADS, len(supply_c)), 1.0),
        mix_k=np.broadcast_to(part.design_mix_k[:, None], shape),
        feedback_gain=np.full(shape, _USUAL_GAIN),
    )
    groups = _by_rack(part.group_offsets, part.columns)
    merged = _by_rack(*_merge_neighbours(part.group_offsets, part.columns))
    states.solve(merged, _MOST_PASSES)
    if groups.size > merged.size:
        states.solve(groups, _MOST_EXACT_PASSES)
    return states


def _strongest_patterns(mix_k: F64) -> tuple[F64, F64]:
    """Principal components of the mixes, (R, m), and how much of each they hold.

    Returns:
        Patterns, (k, R), strongest first, and shares, (k, m).
    """
    # Eigenvectors come weakest first; those of the small product of the table with itself take no
    # threads.
    patterns = np.linalg.eigh(mix_k @ mix_k.T)[1].T[: -PATTERNS - 1 : -1]
    return patterns, patterns @ mix_k


def _design_patterns(states: _SteadyStates, recirculation: Recirculation) -> tuple[F64, F64]:
    """Patterns of the design point, (4, R), and shares of approach and rise over it, (2, m)."""
    scales = np.concatenate([states.inlet_k, states.heat_k])
    shares = (scales / np.maximum(scales[:, -1:], 1e-9))[:, :-1]
    design = recirculation.design
    racks = np.stack([design.approach_k, design.outlet_rise_k - design.approach_k])
    mixes = [recirculation.mix_weights.apply(row) for row in racks]
    return np.concatenate([mixes, racks]), shares


@dataclass(slots=True)
class _SteadyStates:
    """Search for the steady exhaust mixes of R racks at m pairs of supply temperature and load."""

    curves: ServerCurves
    """Curves of the servers."""
    weights: F64
    """Weights of the exhaust mix, (R, R)."""
    density_ratio: DensityRatio
    """Density of the air divided by that at the reference temperature."""
    k_per_w: float
    """Temperature rise of the air of the largest server per power at an airflow ratio of 1, in
    K/W."""
    supply_c: F64
    """Supply temperature of each pair, in C, (m,)."""
    load: F64
    """Load of each pair, 0..1, (m,)."""
    mix_k: F64
    """Exhaust mix before each rack above supply air, in K, (R, m)."""
    feedback_gain: F64
    """Change of each rack's outlet with a change of the mix before it, in K/K, (R, m)."""
    inlet_k: F64 | None = None
    """Airflow-weighted mean inlet of each rack above supply air, in K, (R, m)."""
    heat_k: F64 | None = None
    """Temperature rise of the air through each rack, in K, (R, m)."""

    def solve(self, groups: F64, passes: int) -> None:
        """Take Newton steps towards mixes that their own outlets make.

        With outlets T(m) of the mixes m, the residual is w T(m) - m and a step s solves
        (1 - w G) s = residual by its Neumann series; the diagonal G holds the feedback gains, as
        secants over the step before.

        Args:
            groups: Server groups by rack, see ``_by_rack``, (7, R, most groups of a rack).
            passes: Most steps.
        """
        before: tuple[F64, F64] | None = None
        for _ in range(passes):
            outlet_k = self._outlet_k(groups)
            if before is not None:
                self._update_gain(outlet_k - before[1], self.mix_k - before[0])
            before = self.mix_k, outlet_k
            step_k = term_k = self.weights @ outlet_k - self.mix_k
            for _ in range(_NEUMANN_TERMS):
                term_k = self.weights @ (self.feedback_gain * term_k)
                step_k = step_k + term_k
            self.mix_k = self.mix_k + step_k
            if np.max(np.abs(step_k)) < _LAST_STEP_K:
                break

    def _update_gain(self, outlet_change_k: F64, mix_change_k: F64) -> None:
        """Feedback gains from changes, (R, m), where mixes have moved far enough."""
        gain = np.divide(
            outlet_change_k,
            mix_change_k,
            out=self.feedback_gain.copy(),
            where=np.abs(mix_change_k) > _SECANT_K,
        )
        self.feedback_gain = np.clip(gain, -_MOST_GAIN, _MOST_GAIN)

    def _outlet_k(self, groups: F64) -> F64:
        """Outlets of the racks above supply air with the present mixes, in K, (R, m).

        Keeps ``inlet_k`` and ``heat_k``, of which outlets are the sum.
        """
        rows = (row[..., None] for row in groups)
        count, full_w, idle_w, deviation, full_airflow, fan_w, exhaust_share = rows
        self.inlet_k, self.heat_k = np.empty_like(self.mix_k), np.empty_like(self.mix_k)
        batch = max(_LEAST_BATCH, _BATCH_VALUES // count.size)
        for first in range(0, len(self.load), batch):
            at = slice(first, first + batch)
            inlet_k = self.mix_k[:, None, at] * exhaust_share
            load = self.load[at]
            load = load + deviation * (load * (1.0 - load))
            inlet_c = self.supply_c[at] + inlet_k
            ratio = self.curves.airflow_ratio(inlet_c, load)
            power_w = self.curves.cpu_w(inlet_c, load, full_w, idle_w)
            power_w += self.curves.fan_w(ratio, fan_w)
            ratio = self.curves.moved_ratio(ratio, inlet_c, self.density_ratio)
            ratio = ratio * (count * full_airflow)
            flow = np.maximum(np.sum(ratio, axis=1), 1e-9)
            heat_k = np.sum(power_w * count, axis=1) / flow * self.k_per_w
            self.heat_k[:, at] = np.minimum(heat_k, _MOST_HEAT_K)
            self.inlet_k[:, at] = np.sum(inlet_k * ratio, axis=1) / flow
        return np.asarray(self.inlet_k + self.heat_k)


def _by_rack(group_offsets: I32, columns: F64) -> F64:
    """Columns of server groups, (7, G), as (7, R, most groups of a rack), filled up with none."""
    sizes = np.diff(group_offsets)
    place = np.arange(int(sizes.max()))
    out = columns[:, group_offsets[:-1, None] + np.minimum(place, sizes[:, None] - 1)]
    out[0] *= place < sizes[:, None]
    return np.asarray(out)


def _merge_neighbours(group_offsets: I32, columns: F64) -> tuple[I32, F64]:
    """One mean group for neighbours in a rack that take in the same share of exhaust air."""
    first = np.diff(columns[-1], prepend=np.nan) != 0.0
    first[group_offsets[:-1]] = True
    begin = np.flatnonzero(first)
    count = columns[0]
    servers = np.add.reduceat(count, begin)
    means = np.add.reduceat(count * columns[1:], begin, axis=1) / servers
    merged = np.searchsorted(begin, group_offsets).astype(np.int32)
    return merged, np.concatenate([[servers], means])
