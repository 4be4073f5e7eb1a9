"""Measurements at CDUs: coolant return in C, hottest junction in C, and headroom in K."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.room_dew_point import RoomDewPoint
from sdc_taichi.types import F64, State, StepResult


class LoopReadings(NamedTuple):
    """Readings of the C coolant distribution units (CDUs) of a step."""

    running: F64
    """1 for CDUs through which coolant flows, else 0, (C,)."""
    return_c: F64
    """Temperature of the coolant from the racks, in C, (C,)."""
    junction_c: F64
    """Hottest GPU junction of the racks that the CDU serves, in C, (C,); 0 without GPUs."""
    headroom_k: F64
    """Smallest throttling limit minus junction of these racks, in K, (C,); inf without GPUs."""


class CoolantLoops:
    """Racks and CDUs of the coolant loops of B data centers.

    Args:
        fleet: the data centers, of which some have liquid-cooled racks.

    Attributes:
        cdu_manifold: index of each CDU's manifold, (C,).
        rack_manifold: index of each liquid-cooled rack's manifold, (L,).
    """

    def __init__(self, fleet: Fleet) -> None:
        loops = fleet.liquid
        assert loops is not None
        self.cdu_manifold, self.rack_manifold = loops.cdu_manifold, loops.rack_manifold
        self._racks, self._first = fleet.liquid_racks, loops.rack_offsets[:-1]
        gpus, limit_c = np.asarray(loops.racks.gpus), np.asarray(loops.racks.throttle_c)
        # Racks with a rear door have no GPUs.
        self._throttle_c = np.where(gpus > 0.0, limit_c, np.inf)
        plants, dc = loops.plants, fleet.cdu_dc
        j_per_m3_k = np.asarray(plants.density_kg_m3 * plants.heat_capacity_j_per_kg_k)
        self._j_per_m3_k = np.broadcast_to(j_per_m3_k, fleet.size)[dc]
        self._dew_point = RoomDewPoint(fleet)
        self._dew_margin_k = np.broadcast_to(np.asarray(plants.dew_margin_k), fleet.size)
        self._cdu_offsets = fleet.cdu_offsets
        self._last: tuple[StepResult | None, LoopReadings] | None = None

    def readings(self, last: StepResult | None, state: State) -> LoopReadings:
        """Return the readings of the last step.

        Before the first step all CDUs run, and coolant and junctions are at the setpoints.

        Args:
            last: result of the last step; None before the first step.
            state: state after the last step.
        """
        if self._last is not None and self._last[0] is last and last is not None:
            return self._last[1]
        if last is None:
            set_c = state.cdu_setpoint_c
            limits_c = np.minimum.reduceat(self._throttle_c, self._first)[self.cdu_manifold]
            junction_c = np.where(np.isinf(limits_c), 0.0, set_c)
            readings = LoopReadings(np.ones(len(set_c)), set_c, junction_c, limits_c - set_c)
        else:
            rate = last.cdu_flow_m3s * self._j_per_m3_k
            rise_k = last.cdu_heat_w / np.where(rate > 0.0, rate, 1.0)
            junction_c = last.rack_junction_c[self._racks].astype(np.float64)
            hottest_c = np.maximum.reduceat(junction_c, self._first)
            headroom_k = np.minimum.reduceat(self._throttle_c - junction_c, self._first)
            readings = LoopReadings(
                (rate > 0.0).astype(np.float64),
                last.cdu_supply_each_c + np.where(rate > 0.0, rise_k, 0.0),
                hottest_c[self.cdu_manifold],
                headroom_k[self.cdu_manifold],
            )
        self._last = last, readings
        return readings

    def dew_shortfall_k(self, last: StepResult, state: State) -> F64:
        """Return by how much setpoints miss the dew point of the room plus margin, in K, (B,).

        It is that of the lowest setpoint after a step, at least 0.
        """
        least_c = self._dew_point.at(last.outdoor_c, last.wet_bulb_c) + self._dew_margin_k
        coldest_c = lowest(state.cdu_setpoint_c, self._cdu_offsets)
        return np.asarray(np.maximum(least_c - coldest_c, 0.0))


def lowest(values: F64, offsets: npt.NDArray[np.integer]) -> F64:
    """Return the lowest value of the parts of each data center, (B,); inf for those without.

    Args:
        values: values of the parts of all data centers.
        offsets: index of each data center's first part, then the total number, (B + 1,).
    """
    with_end = np.append(values, np.inf)
    counts = np.diff(offsets)
    least = np.minimum.reduceat(with_end, np.minimum(offsets[:-1], len(values)))
    return np.asarray(np.where(counts > 0, least, np.inf))
