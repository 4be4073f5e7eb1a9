"""Best steady commands of coolant loops by weather and utilisation.

A map holds, for each data center with liquid-cooled racks, the supply setpoint, the flow and the
facility water that need least power in a steady state: that of the racks and their loops, and of
the air-side cooling for the heat that they leave in the air. The air side is represented by its
power per heat, since the air changes little with these commands. No GPU comes closer than
``MARGIN_K`` to its throttling limit where some commands avoid it.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np

from sdc_taichi.config.liquid_schema import APPROACH_LIMITS_K, FLOW_LIMITS, SETPOINT_LIMITS_C
from sdc_taichi.plant.liquid import LiquidFleet
from sdc_taichi.sim.commanded_loops import CommandedLoops, LoopConditions, part_of
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet, build_fleet
from sdc_taichi.sim.room_dew_point import RoomDewPoint
from sdc_taichi.types import F64

MARGIN_K = 0.2
"""Headroom to throttling that the commands keep, in K; it covers interpolation between nodes."""
PENALTY_PER_K, PENALTY_OF_WORK = 0.1, 10.0
"""Charges for each kelvin of missing headroom, and for the work of a full load that hot GPUs do not
complete, as shares of the power of the racks."""
WEATHER_STEP_K = 4.0
"""Spacing of the nodes of dry bulb and of wet-bulb depression, in K."""
UTILISATIONS = np.array([0.0, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0])
"""Utilisations of the nodes."""
AIR_SIDE_W_PER_W = 0.25
"""Power of the air-side cooling per heat that it removes, of which the commands depend little."""
SAMPLES = 48
"""Number of steps in which the commands of a table are compared with others."""
_TRIED, _ROUNDS = 512, 3
"""Number of other commands in each round of the comparison, and number of rounds."""
_SPANS = np.array([6.0, 0.3, 5.0])
"""Largest distance of the other commands in the first round: of the setpoint in K, of the flow, and
of the approach in K. It halves from round to round."""
LOOP_COMMANDS = "cdu_setpoint_c", "cdu_flow", "facility_approach_k"
"""Fields of ``Actions`` that the tables give."""
_LIMITS = np.array([SETPOINT_LIMITS_C, FLOW_LIMITS, APPROACH_LIMITS_K])
_COUNTS, _FINER_COUNTS = (14, 5, 4), (5, 5, 3)
"""Numbers of setpoints, flows and approaches of the first grid, and of the finer ones."""
_FINER, _NARROWER = 3, 0.5
"""Number of finer grids, and factor by which each narrows the ranges."""


@dataclass(frozen=True, slots=True)
class LoopMap:
    """Best commands of the loops of a data center at nodes of weather and utilisation."""

    outdoor_c: F64
    """Dry bulb of the nodes, increasing in equal steps, in C, (W,)."""
    depression_k: F64
    """Dry bulb minus wet bulb of the nodes, increasing in equal steps, in K, (P,)."""
    commands: F64
    """Supply setpoint in C, flow as a share of design, and approach in K, (3, W, P, I), with the
    utilisations ``UTILISATIONS``."""

    def at(self, outdoor_c: F64, wet_bulb_c: F64, utilisation: F64) -> F64:
        """Interpolate the commands at any weather and utilisation, (3, ...).

        Args:
            outdoor_c: dry bulb, in C, (...).
            wet_bulb_c: wet bulb, in C, of the same shape.
            utilisation: utilisation, 0..1, of the same shape.
        """
        places = [
            _place(self.outdoor_c, outdoor_c),
            _place(self.depression_k, outdoor_c - wet_bulb_c),
            _place(UTILISATIONS, utilisation),
        ]
        out, counts = np.zeros((3, *np.shape(outdoor_c))), self.commands.shape[1:]
        for corner in np.ndindex(2, 2, 2):
            index = tuple(
                np.minimum(low + up, count - 1)
                for (low, _), up, count in zip(places, corner, counts, strict=True)
            )
            shares = [
                share if up else 1.0 - share for (_, share), up in zip(places, corner, strict=True)
            ]
            weight = np.prod(shares, axis=0)
            out += weight * self.commands[(slice(None), *index)]
        return in_range(out)


def loop_map(
    loops: LiquidFleet,
    *,
    outdoor_c: F64,
    wet_bulb_c: F64,
    dew_point_c: Callable[[F64, F64], F64],
    follows_humidity: bool = False,
) -> LoopMap:
    """Compute the map of one data center for a range of weather.

    Args:
        loops: its racks, CDUs and facility loop.
        outdoor_c: dry bulbs of which the extremes are used, in C, (T,).
        wet_bulb_c: wet bulbs of the same steps, in C, (T,).
        dew_point_c: function from dry bulb and wet bulb to the dew point of the room, in C, (1,)
            each.
        follows_humidity: True if this dew point depends on the weather.
    """
    dry = _nodes(outdoor_c)
    # Dry coolers do not depend on the wet bulb, but the dew point of the room may.
    depression = np.zeros(1)
    if np.any(loops.plants.rejection) or follows_humidity:
        depression = _nodes(outdoor_c - wet_bulb_c)
    racks, levels = int(loops.rack_offsets[-1]), len(UTILISATIONS)
    trials = {
        counts: CommandedLoops(loops, levels * int(np.prod(counts)))
        for counts in (_COUNTS, _FINER_COUNTS)
    }
    commands = np.empty((3, len(dry), len(depression), levels))
    for w, p in np.ndindex(len(dry), len(depression)):
        middle = np.repeat(_LIMITS.mean(axis=1)[:, None], levels, axis=1)
        half = np.repeat(np.ptp(_LIMITS, axis=1)[:, None] / 2.0, levels, axis=1)
        for counts in (_COUNTS, *[_FINER_COUNTS] * _FINER):
            offsets = np.stack(
                [x.ravel() for x in np.meshgrid(*(np.linspace(-1, 1, n) for n in counts))]
            )
            tried = middle[:, :, None] + half[:, :, None] * offsets[:, None, :]
            tried = np.clip(tried, _LIMITS[:, :1, None], _LIMITS[:, 1:, None])
            load = np.repeat(UTILISATIONS, offsets.shape[1])
            conditions = LoopConditions(
                np.repeat(load[:, None], racks, axis=1),
                np.ones(racks),
                float(dry[w]),
                float(dry[w] - depression[p]),
                float(dew_point_c(dry[w : w + 1], dry[w : w + 1] - depression[p])[0]),
            )
            states = trials[counts].at(tried.reshape(3, -1), conditions)
            lack_k = np.maximum(MARGIN_K - states.headroom_k, 0.0)
            excess = PENALTY_PER_K * lack_k + PENALTY_OF_WORK * states.lost
            cost = states.power_w * (1.0 + excess) + AIR_SIDE_W_PER_W * states.plant_load_w
            best = cost.reshape(levels, -1).argmin(axis=1)
            middle = tried[:, np.arange(levels), best]
            # The next grid spans the neighbours of the best point of the first one.
            spacing = 2.0 / (np.array(counts)[:, None] - 1.0)
            half = half * (spacing if counts == _COUNTS else _NARROWER)
        commands[:, w, p] = middle
    for each in trials.values():
        each.close()
    return LoopMap(dry, depression, commands)


class LoopCommands:
    """Best steady commands of the loops of a fleet, in any weather of its year.

    Args:
        fleet: B data centers, some with liquid-cooled racks; for the others the commands are those
            in the middle of their ranges, without effect.
        drivers: their inputs.

    Attributes:
        fleet: the data centers.
    """

    def __init__(self, fleet: Fleet, drivers: Drivers) -> None:
        self.fleet = fleet
        assert fleet.liquid is not None
        maps: dict[Hashable, LoopMap] = {}
        self._maps: list[LoopMap] = []
        middle = np.repeat(_LIMITS.mean(axis=1), len(UTILISATIONS)).reshape(3, 1, 1, -1)
        without = LoopMap(np.zeros(1), np.zeros(1), middle)
        self._dew_points_c = [RoomDewPoint(build_fleet(config)).at for config in fleet.configs]
        for dc, config in enumerate(fleet.configs):
            if config.liquid is None:
                self._maps.append(without)
                continue
            series = drivers.outdoor_c, drivers.wet_bulb_c
            places = tuple((int(s.offsets[dc]), int(s.lengths[dc])) for s in series)
            key = config.hall, config.liquid, config.site.location, places
            if key not in maps:
                hours = max(int(s.lengths[dc]) for s in series)
                outdoor_c, wet_bulb_c = (
                    s.values.take(int(s.offsets[dc]) + np.arange(hours) % int(s.lengths[dc]))
                    for s in series
                )
                maps[key] = loop_map(
                    part_of(fleet.liquid, dc),
                    outdoor_c=outdoor_c,
                    wet_bulb_c=wet_bulb_c,
                    dew_point_c=self._dew_points_c[dc],
                    follows_humidity=config.liquid.dew_point_c is None,
                )
            self._maps.append(maps[key])

    def of(self, dc: int) -> LoopMap:
        """Return the map of one data center."""
        return self._maps[dc]

    def at(self, outdoor_c: F64, wet_bulb_c: F64, utilisation: F64) -> F64:
        """Return supply setpoint in C, flow as a share of design, and approach in K, (3, B).

        Args:
            outdoor_c: dry bulb, in C, (B,).
            wet_bulb_c: wet bulb, in C, (B,).
            utilisation: work as a share of capacity, 0..1, (B,).
        """
        inputs = zip(self._maps, outdoor_c, wet_bulb_c, utilisation, strict=True)
        return np.stack([each.at(*(np.asarray(x) for x in values)) for each, *values in inputs], 1)

    def excess_w(self, dc: int, outdoor_c: F64, wet_bulb_c: F64, utilisation: F64) -> F64:
        """Return how much more power the commands need than the best of many others, in W, (n,).

        The others are random, around the commands and then around the best ones so far. The power
        of the air side is represented as in the maps.

        Args:
            dc: index of the data center.
            outdoor_c: dry bulb, in C, (n,).
            wet_bulb_c: wet bulb, in C, (n,).
            utilisation: work as a share of capacity, 0..1, (n,).

        Returns:
            The excess; inf where the commands throttle GPUs and others do not.
        """
        assert self.fleet.liquid is not None
        loops = part_of(self.fleet.liquid, dc)
        racks, trials = int(loops.rack_offsets[-1]), CommandedLoops(loops, _TRIED)
        offsets = np.random.default_rng(0).uniform(-1.0, 1.0, (_ROUNDS, 3, _TRIED))
        offsets[:, :, 0] = 0.0
        dew_point_c = np.broadcast_to(
            self._dew_points_c[dc](outdoor_c, wet_bulb_c), outdoor_c.shape
        )
        excess_w = np.zeros(len(outdoor_c))
        for k, centre in enumerate(self.of(dc).at(outdoor_c, wet_bulb_c, utilisation).T):
            conditions = LoopConditions(
                np.full(racks, utilisation[k]),
                np.ones(racks),
                float(outdoor_c[k]),
                float(wet_bulb_c[k]),
                float(dew_point_c[k]),
            )
            costs_w = []
            for i, each in enumerate(offsets):
                tried = in_range(centre[:, None] + 0.5**i * _SPANS[:, None] * each)
                states = trials.at(tried, conditions)
                cost_w = states.power_w + AIR_SIDE_W_PER_W * states.plant_load_w
                cost_w[states.lost > 0.0] = np.inf
                costs_w += [cost_w[0], cost_w.min()]
                centre = tried[:, cost_w.argmin()]
            if np.isfinite(costs_w[-1]):
                excess_w[k] = costs_w[0] - min(costs_w)
        trials.close()
        return excess_w


def in_range(commands: F64) -> F64:
    """Return interpolated commands, (3, ...), in their ranges, which rounding errors may exceed."""
    return np.asarray(np.clip(commands.T, *_LIMITS.T).T)


def _nodes(values: F64) -> F64:
    """Return nodes that cover the values, in equal steps of at most ``WEATHER_STEP_K``."""
    low, high = float(values.min()), float(values.max())
    return np.linspace(low, high, int(np.ceil((high - low) / WEATHER_STEP_K)) + 1)


def _place(nodes: F64, at: F64) -> tuple[np.ndarray, F64]:
    """Return the index of the node below each position, and the fraction to the next node, 0..1."""
    if len(nodes) == 1:
        return np.zeros(np.shape(at), dtype=np.int64), np.zeros(np.shape(at))
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    return low, np.clip((at - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)
