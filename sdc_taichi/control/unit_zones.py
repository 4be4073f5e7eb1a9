"""Zones of CRAC units: the racks that each unit feeds most, and what its sensors read there."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, StepResult

MOST_NEIGHBOURS = 8
"""Largest number of neighbouring units that an agent observes."""
_STREAM = zlib.crc32(b"inlet sensors")
"""Last key of the random streams of the sensor errors."""


@dataclass(frozen=True, slots=True)
class ZoneReadings:
    """Air of the zones of U CRAC units in one step."""

    hottest_true_c: F64
    """Hottest server inlet of each zone, in C, (U,)."""
    hottest_c: F64
    """Hottest server inlet of each zone as the sensors of its unit measure it, in C, (U,)."""
    mean_c: F64
    """Mean rack inlet of each zone as the sensors of its unit measure it, in C, (U,)."""
    unit_running: F64
    """1 for running units, 0 for units that are down, (U,)."""


@dataclass(frozen=True, slots=True)
class _ZoneIndex:
    """Racks of the zones for one set of running units, sorted by unit."""

    racks: I64
    """Racks of the fleet in the order of the zones; a rack can be in two zones."""
    first: I64
    """First entry of each zone in ``racks``, (U,)."""
    count: F64
    """Number of racks of each zone, (U,)."""


class UnitZones:
    """Zones of the U CRAC units of B data centers.

    A rack is in the zone of the running unit with the largest share of its supply air. A unit that
    has no rack this way has the rack of which it feeds the largest share. A unit that is down keeps
    the zone that it has when all units run, and its racks are in zones of other units as well.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._all = np.ones(fleet.units)
        self._of_set: dict[tuple[int, bytes], list[I64]] = {}
        self._running = self._all
        self._index: _ZoneIndex | None = None
        self._seed: I64 | None = None
        self._error_k = np.zeros(fleet.units)
        self._last: StepResult | None = None
        self._readings: ZoneReadings | None = None

    def readings(self, last: StepResult | None, setpoint_c: F64, seed: I64) -> ZoneReadings:
        """Return the air of the zones in a step.

        Args:
            last: Result of the step; None before the first step, when the air has the temperature
                of the setpoints.
            setpoint_c: Setpoint of each unit, in C, (U,), read before the first step alone.
            seed: Seed of each data center, on which the sensor errors depend, (B,).
        """
        if self._readings is not None and last is not None and last is self._last:
            return self._readings
        error_k = self.sensor_error_k(seed)
        if last is None:
            measured_c = setpoint_c + error_k
            return ZoneReadings(setpoint_c, measured_c, measured_c, self._all)
        racks = self.racks(last.unit_running)
        hottest_c = np.maximum.reduceat(last.rack_inlet_max_c[racks.racks], racks.first)
        inlet_c = last.rack_inlet_c[racks.racks].astype(np.float64)
        mean_c = np.add.reduceat(inlet_c, racks.first) / racks.count
        hottest_c = hottest_c.astype(np.float64)
        self._readings, self._last = (
            ZoneReadings(hottest_c, hottest_c + error_k, mean_c + error_k, last.unit_running),
            last,
        )
        return self._readings

    def sensor_error_k(self, seed: I64) -> F64:
        """Return the error of the inlet sensors of each unit in a run, in K, (U,)."""
        if seed is not self._seed:
            self._error_k = np.concatenate(
                [
                    _sensor_error_k(config.hall.sensor_error_k, int(key), config.name, units)
                    for config, key, units in zip(
                        self._fleet.configs,
                        seed,
                        np.diff(self._fleet.unit_offsets).tolist(),
                        strict=True,
                    )
                ]
            )
            self._seed, self._last = seed, None
        return self._error_k

    def racks(self, running: F64) -> _ZoneIndex:
        """Return the racks of the zones for the running units: 1 for these, 0 else, (U,)."""
        if self._index is None or (
            running is not self._running and not np.array_equal(running, self._running)
        ):
            self._index, self._running = self._indexed(running), running.copy()
        return self._index

    @cached_property
    def nearest(self) -> I64:
        """Units whose supply reaches the same racks as that of each unit, most first, (8, U).

        In data centers with fewer than nine units, the unit itself fills the last places.
        """
        fleet, air = self._fleet, self._fleet.air
        nearest = np.tile(np.arange(fleet.units), (MOST_NEIGHBOURS, 1))
        for dc in range(fleet.size if air is not None else 0):
            assert air is not None
            units = slice(*fleet.unit_offsets[dc : dc + 2])
            racks = slice(*fleet.rack_offsets[dc : dc + 2])
            at = slice(*air.unit_share_offsets[dc : dc + 2])
            shares = air.unit_shares[at].reshape(racks.stop - racks.start, -1)
            common = shares.T @ (air.rack_need_m3s[racks, None] * shares)
            np.fill_diagonal(common, -1.0)
            order = np.argsort(-common, axis=0, kind="stable")[
                : min(MOST_NEIGHBOURS, len(common) - 1)
            ]
            nearest[: len(order), units] = units.start + order
        return nearest

    def _indexed(self, running: F64) -> _ZoneIndex:
        fleet, zones = self._fleet, []
        for dc in range(fleet.size):
            runs = running[slice(*fleet.unit_offsets[dc : dc + 2])]
            zones += [fleet.rack_offsets[dc] + racks for racks in self._zones_of(dc, runs)]
        count = np.array([len(racks) for racks in zones])
        first = np.concatenate([[0], np.cumsum(count)[:-1]])
        return _ZoneIndex(np.concatenate(zones), first, count.astype(np.float64))

    def _zones_of(self, dc: int, runs: F64) -> list[I64]:
        """Return the racks of the zone of each unit of a data center."""
        fleet, air = self._fleet, self._fleet.air
        n_racks = int(np.diff(fleet.rack_offsets[dc : dc + 2])[0])
        if air is None:
            return [np.arange(n_racks)]
        key = int(air.steady_state_of_dc[dc]), runs.tobytes()
        if key not in self._of_set:
            at = slice(*air.unit_share_offsets[dc : dc + 2])
            shares = air.unit_shares[at].reshape(n_racks, len(runs))
            self._of_set[key] = _zones(shares, runs > 0)
        return self._of_set[key]


def _zones(shares: F64, runs: npt.NDArray[np.bool_]) -> list[I64]:
    """Return the racks of the zone of each of U units by their shares in R racks, (R, U)."""
    whole = _largest(shares)
    if runs.all() or not runs.any():
        return whole
    running = np.flatnonzero(runs)
    zones = list(whole)
    for unit, racks in zip(running, _largest(shares[:, running]), strict=True):
        zones[unit] = racks
    return zones


def _largest(shares: F64) -> list[I64]:
    """Return the racks of which each unit feeds the largest share, or else most; one at least."""
    zone = shares.argmax(axis=1)
    racks = [np.flatnonzero(zone == unit) for unit in range(shares.shape[1])]
    most = shares.argmax(axis=0)
    return [own if len(own) else most[[unit]] for unit, own in enumerate(racks)]


def _sensor_error_k(most_k: float, seed: int, name: str, units: int) -> F64:
    """Return the errors of the sensors of the units of a data center in a run, in K, (U,)."""
    if most_k == 0.0:
        return np.zeros(units)
    key = np.random.SeedSequence([seed, zlib.crc32(name.encode()), _STREAM])
    return np.random.Generator(np.random.PCG64(key)).uniform(-most_k, most_k, units)
