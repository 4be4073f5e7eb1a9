"""How often a recording shows heat maps and 3D halls, by the size of the halls in focus."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdc_taichi.sim.fleet import Fleet

from . import hall_rasters as rasters
from .recording_series import FIELDS

MAX_BLOCK_STEPS, MAX_BLOCK_BYTES = 1_024, 16_000_000
"""Largest size of a block, which is in memory until it is written, in steps and bytes."""
MAP_EVERY_H = ((200, 0.0), (2_000, 1.0), (20_000, 3.0))
"""Largest number of racks in focus, and the hours between two heat maps, 0 being every step."""
LARGEST_MAP_EVERY_H = 6.0
"""Time between two heat maps of more racks, in h."""
HALL_EVERY_H, HALL_EVERY_H_IN_EVENTS = 3.0, 1.0
"""Least time between two frames of the 3D hall, which need a pass over all servers, in h."""
SMALL_HALL_LEVELS, LARGE_HALL_LEVELS = 10, 5
"""Levels of a rack of the 3D hall, in small and in larger halls."""
MAX_SERVERS_IN_LEVELS = 100_000
"""Number of servers of the fleet up to which the levels of a rack show its servers."""


@dataclass(frozen=True, slots=True)
class Cadence:
    """How often heat maps and 3D halls are recorded, and how finely."""

    map_every_steps: int
    """Steps between two heat maps."""
    hall_every_steps: int
    """Steps between two frames of the 3D hall."""
    hall_every_steps_in_events: int
    """Steps between two frames of the 3D hall while a failure or weather event lasts."""
    levels: tuple[int, ...]
    """Levels per rack of the 3D hall of each data center in focus."""
    has_servers: bool
    """Whether levels show servers; else a rack shows its hottest inlet and its mean outlet."""
    block_steps: int
    """Number of steps in a block."""


def choose_cadence(fleet: Fleet, focus: Sequence[int], every_steps: int | None) -> Cadence:
    """Cadence for the halls in focus.

    Args:
        fleet: the fleet.
        focus: indices of the data centers in focus.
        every_steps: steps between two heat maps and between two frames of the 3D hall; None
            follows the number of racks in focus.
    """
    racks = int(np.diff(fleet.rack_offsets)[focus].sum())
    per_hour = fleet.steps_per_hour
    map_every = every_steps or max(1, round(map_every_h(racks) * per_hour))
    hall_every = every_steps or max(map_every, round(HALL_EVERY_H * per_hour))
    in_events = every_steps or max(map_every, round(HALL_EVERY_H_IN_EVENTS * per_hour))
    has_servers = fleet.servers <= MAX_SERVERS_IN_LEVELS
    is_small = racks <= rasters.MAX_RACKS_OF_SMALL_HALL
    most_levels = SMALL_HALL_LEVELS if is_small else LARGE_HALL_LEVELS
    levels = tuple(
        min(most_levels, _fewest_servers(fleet, dc)) if has_servers else 1 for dc in focus
    )
    step_bytes: float = 8 * len(FIELDS) * (len(focus) + 2)
    step_bytes += _map_bytes(fleet, focus) / map_every
    step_bytes += _hall_bytes(fleet, focus, levels, has_servers=has_servers) / hall_every
    return Cadence(
        map_every_steps=map_every,
        hall_every_steps=hall_every,
        hall_every_steps_in_events=in_events,
        levels=levels,
        has_servers=has_servers,
        block_steps=min(MAX_BLOCK_STEPS, max(1, int(MAX_BLOCK_BYTES / step_bytes))),
    )


def _map_bytes(fleet: Fleet, focus: Sequence[int]) -> int:
    """Bytes of the heat maps of one step."""
    halls = [fleet.configs[dc].hall for dc in focus]
    pixels = sum(math.prod(rasters.tile_grid(hall).image_shape) for hall in halls)
    return 2 * len(rasters.COLOURMAPS) * pixels


def _hall_bytes(
    fleet: Fleet, focus: Sequence[int], levels: Sequence[int], *, has_servers: bool
) -> int:
    """Bytes of the 3D halls of one step, and of the server groups that they are made from."""
    halls = [fleet.configs[dc].hall for dc in focus]
    values = sum(hall.racks * count for hall, count in zip(halls, levels, strict=True))
    if has_servers:
        values += int(np.diff(fleet.group_offsets[fleet.rack_offsets])[focus].sum())
    return 4 * len(rasters.TEMPERATURE_RANGES_C) * values


def _fewest_servers(fleet: Fleet, dc: int) -> int:
    """Number of servers of the smallest rack of a data center."""
    first, last = fleet.rack_offsets[dc : dc + 2]
    return int(np.diff(fleet.server_offsets[fleet.group_offsets[first : last + 1]]).min())


def map_every_h(racks: int) -> float:
    """Time between two heat maps of so many racks in focus, in h."""
    return next((hours for most, hours in MAP_EVERY_H if racks <= most), LARGEST_MAP_EVERY_H)
