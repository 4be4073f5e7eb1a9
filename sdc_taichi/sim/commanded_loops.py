"""Steady states of the coolant loops of one data center under many commands at once."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from sdc_taichi.plant.liquid import (
    CduParameters,
    LiquidFleet,
    Offsets,
    PlantParameters,
    RackParameters,
)
from sdc_taichi.sim.liquid import Liquid, LiquidInputs
from sdc_taichi.types import F64

_Parameters = TypeVar("_Parameters", RackParameters, CduParameters, PlantParameters)


@dataclass(frozen=True, slots=True)
class LoopConditions:
    """Load, weather and failures of a data center with L liquid-cooled racks and C CDUs."""

    utilisation: F64
    """Utilisation of each rack, 0..1, (L,), or (n, L) for that of each of n copies."""
    powered: F64
    """1 for racks that are on, else 0, (L,)."""
    outdoor_c: float
    """Outdoor dry bulb, in C."""
    wet_bulb_c: float
    """Outdoor wet bulb, in C."""
    dew_point_c: float
    """Dew point of the room, in C."""
    cdu_up: F64 | None = None
    """1 for CDUs that run, else 0, (C,); None means that all run."""


@dataclass(frozen=True, slots=True)
class LoopStates:
    """Steady states of n copies of the loops of a data center, (n,) each."""

    power_w: F64
    """Power of the liquid-cooled racks and of their pumps, fans, chillers and heat pumps, in W."""
    plant_load_w: F64
    """Heat that the plant of the CRAC units removes, in W: that of these racks, their lines and
    pumps in the air of the hall, and that which it takes from facility water."""
    lost: F64
    """Work that hot GPUs do not complete, as a share of what the racks complete at full load."""
    headroom_k: F64
    """Smallest throttling limit minus junction temperature, in K; inf without GPUs."""


class CommandedLoops:
    """Copies of the loops of a data center in steady states, each with its own commands.

    Args:
        loops: racks, CDUs and facility loop of one data center.
        copies: number n of copies.
    """

    def __init__(self, loops: LiquidFleet, copies: int) -> None:
        self.copies = copies
        """Number n of copies."""
        self._racks = int(loops.rack_offsets[-1])
        self._cdus = int(loops.cdu_offsets[-1])
        self._liquid = Liquid(_copies(loops, copies), step_s=900.0)
        gpus = np.broadcast_to(np.asarray(loops.racks.gpus), self._racks)
        self._throttle_c = np.where(gpus > 0.0, loops.racks.throttle_c, np.inf)

    def at(self, commands: F64, conditions: LoopConditions) -> LoopStates:
        """Return the steady states at some commands, each the same for all CDUs of a copy.

        Args:
            commands: supply setpoint in C, flow divided by the design flow, and supply setpoint
                minus setpoint of the facility water in K, (3, n).
            conditions: load, weather and failures.
        """
        setpoint_c, flow, approach_k = commands
        n, ones = self.copies, np.ones(self.copies)
        up = conditions.cdu_up
        inputs = LiquidInputs(
            utilisation=np.broadcast_to(conditions.utilisation, (n, self._racks)).ravel(),
            powered=np.tile(conditions.powered, n),
            outdoor_c=conditions.outdoor_c * ones,
            wet_bulb_c=conditions.wet_bulb_c * ones,
            dew_point_c=conditions.dew_point_c * ones,
            facility_approach_k=approach_k,
            cdu_up=None if up is None or up.all() else np.tile(up, n),
        )
        initial = self._liquid.initial_state(inputs)
        state = replace(
            initial,
            cdu_setpoint_c=np.repeat(setpoint_c, self._cdus),
            cdu_flow=np.repeat(flow, self._cdus),
        )
        _, result = self._liquid.step(state, inputs)
        junction_c = result.junction_each_c.reshape(n, -1)
        return LoopStates(
            power_w=result.liquid_it_w
            + result.cdu_pump_w
            + result.facility_pump_w
            + result.cooler_fan_w
            + result.trim_chiller_w
            + result.heat_pump_w,
            plant_load_w=result.liquid_air_w + result.liquid_to_plant_w,
            lost=result.lost_utilisation.reshape(n, -1).mean(axis=1),
            headroom_k=(self._throttle_c - junction_c).min(axis=1),
        )

    def close(self) -> None:
        """Release the kernel arrays."""
        self._liquid.close()


def part_of(loops: LiquidFleet, dc: int) -> LiquidFleet:
    """Return the loops of one of B data centers."""
    first, end = (int(x) for x in loops.manifold_offsets[dc : dc + 2])
    racks, cdus = loops.rack_offsets[first : end + 1], loops.cdu_offsets[first : end + 1]
    return replace(
        loops,
        rack_offsets=racks - racks[0],
        cdu_offsets=cdus - cdus[0],
        manifold_offsets=np.array([0, end - first]),
        racks=_taken(loops.racks, slice(racks[0], racks[-1])),
        cdus=_taken(loops.cdus, slice(cdus[0], cdus[-1])),
        plants=_taken(loops.plants, slice(dc, dc + 1)),
    )


def _taken(parameters: _Parameters, chosen: slice) -> _Parameters:
    """Return the parameters of some of the parts; one value for all stays."""
    values = {f.name: getattr(parameters, f.name) for f in fields(parameters)}
    return replace(parameters, **{name: x[chosen] for name, x in values.items() if np.ndim(x) > 0})


def _copies(loops: LiquidFleet, copies: int) -> LiquidFleet:
    """Return n copies of the loops of a data center."""

    def tiled(parameters: _Parameters) -> _Parameters:
        values = {f.name: getattr(parameters, f.name) for f in fields(parameters)}
        arrays = {name: x for name, x in values.items() if np.ndim(x) > 0}
        return replace(parameters, **{name: np.tile(x, copies) for name, x in arrays.items()})

    offsets = {
        name: _tiled_offsets(getattr(loops, name), copies)
        for name in ("rack_offsets", "cdu_offsets", "manifold_offsets")
    }
    return replace(
        loops,
        **offsets,
        racks=tiled(loops.racks),
        cdus=tiled(loops.cdus),
        plants=tiled(loops.plants),
    )


def _tiled_offsets(offsets: Offsets, copies: int) -> Offsets:
    """Return the offsets of n copies of parts one after another."""
    first = (np.arange(copies)[:, None] * offsets[-1] + offsets[:-1]).ravel()
    return np.append(first, copies * offsets[-1])
