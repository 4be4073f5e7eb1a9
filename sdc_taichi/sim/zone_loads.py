"""Loads of the zones of halls, as random processes that depend on the run's seed and step alone.

The load of a zone is x(t) clipped to its limits, with the Ornstein-Uhlenbeck process

    x(0) = m + s z_0,   x(t + 1) = m + a (x(t) - m) + s sqrt(1 - a^2) z_t,   a = exp(-dt/T),

its mean m of the run, standard deviation s, reversion time T and independent standard normal z.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.step_inputs import Commands
from sdc_taichi.types import F64, I64, Exogenous

_DRAWN_STEPS = 128
"""Number of steps whose random numbers are drawn at once."""
_STREAM = zlib.crc32(b"zone loads")
"""Last key of the random streams of the loads."""


@dataclass(frozen=True, slots=True)
class RackLoads:
    """Loads of one step: B data centers with R racks."""

    demand: F64
    """Arriving work as a share of capacity, 0..1, (B,)."""
    rack_load: F64
    """Load of each rack, 0..1, (R,); ``demand`` in data centers without loads by zone."""


@dataclass(slots=True)
class _Run:
    """Loads of a run at one step, from which those of later steps follow."""

    seed: I64
    """Seed of each data center, (B,)."""
    streams: list[np.random.Generator]
    """Random stream of each data center with random loads."""
    mean: F64
    """Means of the Z random loads, (Z,)."""
    value: F64
    """The loads before they are clipped, (Z,)."""
    step: int
    """Step of ``value``."""
    drawn: F64
    """Standard normal numbers of the coming steps, (``_DRAWN_STEPS``, Z)."""


class ZoneLoads:
    """Loads of the zones of a fleet.

    Loads of a data center depend on its seed, its name, its config and the step, so they are the
    same alone and in a fleet.

    Args:
        fleet: B data centers, of which at least one has ``workload.zone_loads``.
        seed: Seed of each data center, (B,).
    """

    def __init__(self, fleet: Fleet, seed: I64) -> None:
        sections = [config.workload.zone_loads for config in fleet.configs]
        self._names, self._step_h = fleet.names, 1.0 / fleet.steps_per_hour
        self._sections = sections
        self._has_zones = np.array([section is not None for section in sections])
        self._random = [
            dc
            for dc, section in enumerate(sections)
            if section is not None and section.fixed is None
        ]
        counts = [1 if section is None else section.zones for section in sections]
        first = np.concatenate([[0], np.cumsum(counts)])
        self._zone_of_rack = np.concatenate(
            [at + zone_of_rack(config) for at, config in zip(first, fleet.configs, strict=False)]
        )
        self._fixed = np.concatenate(
            [
                (1.0,) * count if section is None or section.fixed is None else section.fixed
                for section, count in zip(sections, counts, strict=True)
            ]
        )
        self._places = np.concatenate(
            [np.arange(first[dc], first[dc + 1]) for dc in self._random]
            or [np.zeros(0, dtype=np.int64)]
        )
        self._low, self._high, self._keep, self._noise = (
            np.repeat(values, np.array([counts[dc] for dc in self._random], dtype=np.int64))
            for values in np.reshape([self._coefficients(dc) for dc in self._random], (-1, 4)).T
        )
        self._rack_sums, self._rack_dc = fleet.rack_sums, fleet.rack_dc
        self._rack_share = fleet.per_rack_servers() / fleet.per_dc_servers()[fleet.rack_dc]
        self._seed = seed
        self._run: _Run | None = None

    def reseed(self, seed: I64) -> None:
        """Use other seeds, (B,)."""
        self._seed = seed

    def _coefficients(self, dc: int) -> tuple[float, float, float, float]:
        """Return lowest and highest load, a, and s sqrt(1 - a^2) of a data center's zones."""
        section = self._sections[dc]
        assert section is not None
        keep = math.exp(-self._step_h / section.reversion_h)
        return section.low, section.high, keep, section.deviation * math.sqrt(1.0 - keep**2)

    def at(self, step: int, demand: F64) -> RackLoads:
        """Return the loads of a step.

        Args:
            step: Number of the step, from 0 at reset.
            demand: Arriving work of data centers without loads by zone, 0..1, (B,).
        """
        load = self._fixed.copy()
        load[self._places] = np.minimum(np.maximum(self._values(step), self._low), self._high)
        rack_load = load[self._zone_of_rack]
        mean = np.minimum(self._rack_sums(rack_load * self._rack_share), 1.0)
        demand = np.where(self._has_zones, mean, demand)
        rack_load = np.where(self._has_zones[self._rack_dc], rack_load, demand[self._rack_dc])
        return RackLoads(demand, rack_load)

    def _values(self, step: int) -> F64:
        """Return the random loads of a step before they are clipped, (Z,)."""
        run = self._run
        if run is None or step < run.step or run.seed is not self._seed:
            run = self._run = self._begun()
        while run.step < step:
            at = run.step % _DRAWN_STEPS
            if at == 0:
                run.drawn = self._draw(run.streams, _DRAWN_STEPS)
            noise = self._noise * run.drawn[at]
            run.value = run.mean + self._keep * (run.value - run.mean) + noise
            run.step += 1
        return run.value

    def _begun(self) -> _Run:
        """Return the loads of the first step."""
        streams, means, scales = [], [], []
        for dc in self._random:
            section = self._sections[dc]
            assert section is not None
            key = [int(self._seed[dc]), zlib.crc32(self._names[dc].encode()), _STREAM]
            stream = np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))
            means.append(stream.uniform(*section.mean, section.zones))
            scales.append(np.full(section.zones, section.deviation))
            streams.append(stream)
        none = np.zeros(0)
        mean = np.concatenate([none, *means])
        value = mean + np.concatenate([none, *scales]) * self._draw(streams, 1)[0]
        return _Run(self._seed, streams, mean, value, 0, none)

    def _draw(self, streams: list[np.random.Generator], steps: int) -> F64:
        """Draw standard normal numbers of all random loads, (steps, Z)."""
        drawn = []
        for dc, stream in zip(self._random, streams, strict=True):
            section = self._sections[dc]
            assert section is not None
            drawn.append(stream.standard_normal((steps, section.zones)))
        return np.concatenate([np.zeros((steps, 0)), *drawn], axis=1)


def zone_loads(fleet: Fleet, seed: I64) -> ZoneLoads | None:
    """Return the loads of the zones of a fleet, or None if no data center has any."""
    has_any = any(config.workload.zone_loads is not None for config in fleet.configs)
    return ZoneLoads(fleet, seed) if has_any else None


def zone_of_rack(config: DataCenterConfig) -> I64:
    """Return the zone of each rack of a data center, (R,); 0 without loads by zone."""
    section, hall = config.workload.zone_loads, config.hall
    if section is None:
        return np.zeros(hall.racks, dtype=np.int64)
    row = np.arange(hall.rows) * section.row_blocks // hall.rows
    place = np.arange(hall.racks_per_row) * section.place_blocks // hall.racks_per_row
    return np.asarray(row[:, None] * section.place_blocks + place, dtype=np.int64).reshape(-1)


def with_loads(
    loads: RackLoads, fleet: Fleet, exogenous: Exogenous, commands: Commands
) -> tuple[Exogenous, Commands]:
    """Return inputs and commands of a step by which racks run at the loads of their zones.

    Args:
        loads: Loads of the step.
        fleet: The data centers.
        exogenous: Inputs of the step, whose demand is replaced.
        commands: Commands; those that place work stay.
    """
    if commands.group_weights is None:
        # Weights of data centers that are loaded evenly must not be 0.
        weights = np.where(loads.rack_load > 0.0, loads.rack_load, 1.0)
        commands.group_weights = np.repeat(weights, np.diff(fleet.group_offsets))
    return replace(exogenous, demand=loads.demand), commands
