"""Where the sweeps of quasi-steady halls start: a table of their steady states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.hall.recirculation import DENSE_RACKS, RackServers, Recirculation
from sdc_taichi.plant.servers import ServerCurves
from sdc_taichi.types import F64, I32

LOADS = np.linspace(0.0, 1.0, 65)
"""Loads of the table: airflow and power bend where their limits set in."""
SUPPLY_STEP_K = 0.5
"""Supply temperatures of the table lie so far apart: setpoints move in whole or half kelvins."""
MOST_SUPPLIES = 65
PATTERNS = 7
"""Most patterns of a hall; six are all that 1e-4 K tell apart in a hall of 20 racks."""
SAMPLED_RACKS = 4
"""Racks whose mean tells how a hall that drops weights behaves."""

_BATCH, _LEAST_BATCH = 2**13, 32
"""Values that are computed at a time, so that they stay in the cache, and entries for which so many
or more are computed."""
_FAR_K = 1e-3
"""Moves that tell what racks keep of them."""
_LAST_STEP_K = 2e-3
"""The next would be shorter by a factor of fifty to a hundred."""
_USUALLY_KEPT = 0.2
_MOST_HEAT_K = 100.0
"""Where fans hardly blow, the air is warmed without bounds, which would drown all other entries."""
_MOST_PASSES = 10
_MOST_EXACT_PASSES = 2


@dataclass(frozen=True, slots=True)
class SteadyStateTable:
    """Steady states of a hall as shares of patterns over its racks."""

    supply_c: F64
    """Supply air of the table, evenly spaced, (n,)."""
    patterns: F64
    """Exhaust mix before each rack over supply air, (k, R). Of halls of more than DENSE_RACKS:
    approach and rise in the mix, then of the racks themselves, at the design point, (4, R)."""
    values: npt.NDArray[np.float32]
    """How much of each pattern, and last ``kept``, which is left of a deviation of the mixes after
    it has passed the racks once, (n, len(LOADS), k + 1); of large halls k is 2."""


def initial_guess(
    config: DataCenterConfig, racks: RackServers, flows: Recirculation
) -> SteadyStateTable:
    """Steady states of a hall whose CRAC units cover what it needs, its racks loaded alike.

    Halls of up to DENSE_RACKS are taken as they are, larger ones as the mean of SAMPLED_RACKS.
    """
    setpoint, design, hall = config.hvac.setpoint, flows.design, config.hall
    span_k = setpoint.max_c - setpoint.min_c
    step_k = max(SUPPLY_STEP_K, span_k / (MOST_SUPPLIES - 1))
    rows = 1 + max(1, int(np.ceil(span_k / step_k - 1e-9)))
    supply_c = np.asarray(setpoint.min_c + step_k * np.arange(rows), dtype=np.float64)
    start = racks.start
    columns = np.stack([racks.count, racks.full_w, racks.idle_w, racks.deviation, flows.captured])
    if hall.racks <= DENSE_RACKS:
        weights, mix_k = flows.exchange.dense(), flows.exchange.apply(design.outlet_rise_k)
    else:
        chosen = np.arange(0, hall.racks, -(-hall.racks // SAMPLED_RACKS))
        kept = np.concatenate([np.arange(*start[r : r + 2]) for r in chosen])
        start, columns = np.array([0, len(kept)], dtype=np.int32), columns[:, kept]
        weights, mix_k = np.ones((1, 1)), design.outlet_rise_k[chosen].mean(keepdims=True)
    groups, merged = _by_rack(start, columns), _by_rack(*_merged(start, columns))
    air = hall.air_density_kg_m3 * hall.air_heat_capacity_j_per_kg_k
    shape = len(mix_k), rows * len(LOADS) + 1
    state = _Steady(
        config.servers.curves,
        weights,
        1.0 / (design.fan_full_airflow_m3s * air),
        # The design point comes last.
        np.append(np.repeat(supply_c, len(LOADS)), design.supply_c),
        np.append(np.tile(LOADS, rows), 1.0),
        np.broadcast_to(mix_k[:, None], shape),
        np.full(shape, _USUALLY_KEPT),
    )
    state.settle(merged, _MOST_PASSES)
    if groups.size > merged.size:
        state.settle(groups, _MOST_EXACT_PASSES)
    if hall.racks <= DENSE_RACKS:
        table = state.mix_k[:, :-1]
        # Eigenvectors come with the weakest first; of the small product of the table with itself
        # they take no threads.
        patterns = np.linalg.eigh(table @ table.T)[1].T[: -PATTERNS - 1 : -1]
        parts = patterns @ table
    else:
        scales = np.concatenate([state.inlet_k, state.heat_k])
        parts = (scales / np.maximum(scales[:, -1:], 1e-9))[:, :-1]
        own = np.stack([flows.approach_k, design.outlet_rise_k - design.approach_k])
        patterns = np.concatenate([[flows.exchange.apply(row) for row in own], own])
    values = np.concatenate([parts, state.kept.mean(axis=0, keepdims=True)[:, :-1]])
    shaped = values.T.reshape(rows, len(LOADS), -1)
    return SteadyStateTable(supply_c, patterns, shaped.astype(np.float32))


@dataclass(slots=True)
class _Steady:
    """Exhaust mixes of the racks that settle, for each supply temperature and load."""

    curves: ServerCurves
    weights: F64
    k_per_w: float
    """Over the airflow ratio of the servers."""
    supply_c: F64
    load: F64
    mix_k: F64
    """Over supply air, (R, n), as all that follow."""
    kept: F64
    """Of a deviation of the mix before each rack, by its outlet."""
    inlet_k: F64 | None = None
    heat_k: F64 | None = None
    """What the racks' heat warms their air by."""

    def settle(self, groups: F64, passes: int) -> None:
        """Newton steps, by what the racks kept of the one before."""
        before: tuple[F64, F64] | None = None
        for _ in range(passes):
            outlet_k = self._outlet_k(groups)
            if before is not None:
                moved_k = self.mix_k - before[0]
                far = np.abs(moved_k) > _FAR_K
                kept = np.divide(outlet_k - before[1], moved_k, out=self.kept.copy(), where=far)
                self.kept = np.clip(kept, -0.9, 0.9)
            before = self.mix_k, outlet_k
            step_k = back_k = self.weights @ outlet_k - self.mix_k
            for _ in range(4):
                back_k = self.weights @ (self.kept * back_k)
                step_k = step_k + back_k
            self.mix_k = self.mix_k + step_k
            if np.max(np.abs(step_k)) < _LAST_STEP_K:
                break

    def _outlet_k(self, groups: F64) -> F64:
        count, full_w, idle_w, deviation, captured = (v[..., None] for v in groups)
        self.inlet_k, self.heat_k = np.empty_like(self.mix_k), np.empty_like(self.mix_k)
        each = max(_LEAST_BATCH, _BATCH // count.size)
        for a in range(0, len(self.load), each):
            at = slice(a, a + each)
            inlet_k = self.mix_k[:, None, at] * captured
            load = self.load[at]
            load = load + deviation * (load * (1.0 - load))
            inlet_c = self.supply_c[at] + inlet_k
            ratio = self.curves.airflow_ratio(inlet_c, load)
            power_w = self.curves.cpu_w(inlet_c, load, full_w, idle_w) + self.curves.fan_w(ratio)
            ratio = ratio * count
            flow = np.maximum(np.sum(ratio, axis=1), 1e-9)
            heat_k = np.sum(power_w * count, axis=1) / flow * self.k_per_w
            self.heat_k[:, at] = np.minimum(heat_k, _MOST_HEAT_K)
            self.inlet_k[:, at] = np.sum(inlet_k * ratio, axis=1) / flow
        return np.asarray(self.inlet_k + self.heat_k)


def _by_rack(start: I32, columns: F64) -> F64:
    """Columns of groups, (5, G), as (5, R, most groups of a rack); the rest are none."""
    sizes = np.diff(start)
    place = np.arange(int(sizes.max()))
    out = columns[:, start[:-1, None] + np.minimum(place, sizes[:, None] - 1)]
    out[0] *= place < sizes[:, None]
    return np.asarray(out)


def _merged(start: I32, columns: F64) -> tuple[I32, F64]:
    """One mean group for neighbours in a rack that take in the same share of exhaust air."""
    first = np.diff(columns[-1], prepend=np.nan) != 0.0
    first[start[:-1]] = True
    begin = np.flatnonzero(first)
    count = columns[0]
    servers = np.add.reduceat(count, begin)
    means = np.add.reduceat(count * columns[1:], begin, axis=1) / servers
    return np.searchsorted(begin, start).astype(np.int32), np.concatenate([[servers], means])
