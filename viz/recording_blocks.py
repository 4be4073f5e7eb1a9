"""Blocks of step results for a recording.

A block contains all series of the data centers in focus, and sums and maxima over the fleet.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.plant.workload import age_histogram
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32, F64, I64, Reals, Status, StepResult

from . import hall_rasters as rasters
from .recording_series import (
    AGE_EDGES_H,
    FIELD_ROWS,
    FIELDS,
    FLEET_SUMS,
    Cadence,
    append_pue,
    fleet_series,
)
from .recording_text import LogEntry, failure_entries, protection_entries

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

    from .recording_reference import Reference

MAX_BLOCK_STEPS, MAX_BLOCK_BYTES = 1_024, 16_000_000
"""Number of steps and of bytes at which the block in memory is written to the recording."""
MAP_QUANTITIES = ("inlet", "outlet", "power", "rise")
"""Quantities of the heat maps: temperatures in C, power in kW, and inlet less supply air in K."""
HALL_QUANTITIES = ("inlet", "outlet")
"""Quantities of the 3D hall, in C."""
MAP_EVERY_H = ((200, 0.0), (2_000, 1.0), (20_000, 3.0), (np.inf, 6.0))
"""Interval of heat maps in h, by the largest number of racks in focus; 0 h is every step."""
MAPS_IN_EVENTS = 3
"""Number of heat maps during an event in the time of one without."""
HALL_EVERY_H, HALL_EVERY_H_IN_EVENTS = 3.0, 1.0
"""Smallest interval of frames of the 3D hall, in h, without and with an active event.

The interval is long because each frame reads the temperatures of all servers.
"""
SMALL_HALL_LEVELS, LARGE_HALL_LEVELS = 10, 5
"""Largest number of levels per rack of the 3D hall, for small halls and for larger ones."""
MAX_SERVERS_IN_LEVELS = 100_000
"""Largest number of servers of a fleet whose 3D halls show servers in the levels of a rack."""
_UNREDUCED_BYTES = 4_000_000
"""Size of buffered step results, in bytes, at which they are reduced to what a block contains.

Results of this size fit into the last-level cache of the processor.
"""


def choose_cadence(fleet: Fleet, focus: Sequence[int], every_steps: int | None) -> Cadence:
    """Return how often and how finely the halls in focus are recorded.

    Args:
        fleet: the fleet.
        focus: indices of the data centers in focus.
        every_steps: interval of heat maps and of frames of the 3D hall, in steps; None derives it
            from the number of racks in focus.
    """
    racks = int(np.diff(fleet.rack_offsets)[focus].sum())
    map_every_h = next(hours for most, hours in MAP_EVERY_H if racks <= most)
    per_hour = fleet.steps_per_hour
    map_every = every_steps or max(1, round(map_every_h * per_hour))
    map_in_events = every_steps or max(1, round(map_every_h * per_hour / MAPS_IN_EVENTS))
    hall_every = every_steps or max(map_every, round(HALL_EVERY_H * per_hour))
    in_events = every_steps or max(map_in_events, round(HALL_EVERY_H_IN_EVENTS * per_hour))
    has_servers = fleet.servers <= MAX_SERVERS_IN_LEVELS and racks <= rasters.MAX_HALL_PARTS
    is_small = racks <= rasters.MAX_RACKS_OF_SMALL_HALL
    most_levels = SMALL_HALL_LEVELS if is_small else LARGE_HALL_LEVELS
    levels = tuple(
        min(most_levels, int(_servers_of_racks(fleet, dc).min())) if has_servers else 1
        for dc in focus
    )
    return Cadence(
        map_every_steps=map_every,
        map_every_steps_in_events=map_in_events,
        hall_every_steps=hall_every,
        hall_every_steps_in_events=in_events,
        levels=levels,
        has_servers=has_servers,
    )


def _servers_of_racks(fleet: Fleet, dc: int) -> I64:
    """Return the number of servers of each of the R racks of a data center, (R,)."""
    first, last = fleet.rack_offsets[dc : dc + 2]
    return np.diff(fleet.server_offsets[fleet.group_offsets[first : last + 1]]).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Block:
    """Recorded values of T consecutive steps of n data centers in focus.

    The data centers in focus have R racks and U CRAC units in all, concatenated in the order of
    the focus.
    """

    steps: I64
    """Steps, counted from 0 at reset, (T,)."""
    size_bytes: int
    """Approximate size of the recorded block, in bytes."""
    values: F64
    """Values of the F quantities ``FIELDS`` and PUE, each in its own unit, (T, F, n)."""
    fleet: dict[str, F64]
    """Series of the whole fleet by name, (T,) each, see ``fleet_series``."""
    queue_by_age: F64
    """Queued work in each age band, in tasks, (T, n, bands)."""
    unit_supply_c: F64
    """Supply air temperature of the CRAC units, in C, (T, U)."""
    unit_flow_m3s: F64
    """Airflow of the CRAC units, in m3/s, (T, U)."""
    rewards: F64 | None
    """Reward terms, (T, terms, n); None if no rewards are recorded."""
    map_steps: I64
    """Steps of the M heat maps, (M,)."""
    maps: dict[str, Reals]
    """Rack values of heat maps, (M, R), by quantity of ``MAP_QUANTITIES``."""
    change_steps: I64
    """Steps of the C maps of the difference from the reference, (C,)."""
    changes: F32
    """Inlet less that of the reference, in K, (C, R)."""
    hall_steps: I64
    """Steps of the H frames of the 3D hall, (H,)."""
    halls: dict[str, Reals]
    """Inlet and outlet of each level of each rack, floor to top, in C, (H, levels) each."""
    entries: list[LogEntry]
    """Entries of the event log, ordered by step."""
    down: list[tuple[int, int, tuple[int, ...]]]
    """Changes of the CRAC units that are down: step, data center, and units that are down."""


class BlockBuilder:
    """Collects the step results of a simulator until ``take`` returns them as a block.

    Args:
        sim: the simulator whose results are recorded.
        focus: indices of the data centers in focus.
        cadence: how often and how finely heat maps and 3D halls are recorded.
        reference: reference of the difference of inlets; None is the state before an event.
    """

    def __init__(
        self,
        sim: Simulator,
        focus: Sequence[int],
        cadence: Cadence,
        reference: Reference | None = None,
    ) -> None:
        fleet = sim.fleet
        self._sim, self._fleet = sim, fleet
        self._focus, self._cadence = list(focus), cadence
        self._read = operator.attrgetter(*FIELDS)
        self._age_edges = np.array(AGE_EDGES_H) * fleet.steps_per_hour
        self._pick_racks, self.racks = _pick(fleet.rack_offsets, focus)
        """Fleet indices of the racks in focus, and each data center's slice of these racks."""
        self._dc_of_racks = fleet.rack_dc[self._pick_racks]
        """Data center of each rack in focus."""
        self._pick_units, self.units = _pick(fleet.unit_offsets, focus)
        """Fleet indices of the CRAC units in focus, and each data center's slice of these units."""
        if cadence.has_servers:
            first_servers = fleet.server_offsets[fleet.group_offsets[fleet.rack_offsets]]
            self._pick_servers, parts = _pick(first_servers, focus)
            """Fleet indices of the servers in focus."""
            self._level_starts = np.concatenate([
                part.start + rasters.level_starts(_servers_of_racks(fleet, dc), levels)
                for part, dc, levels in zip(parts, focus, cadence.levels, strict=True)
            ])  # fmt: skip
            """Index into the servers in focus of the first server of each level of each rack."""
        shapes = [rasters.tile_grid(fleet.configs[dc].hall).image_shape for dc in focus]
        self._map_bytes = len(MAP_QUANTITIES) * sum(map(math.prod, shapes))
        starts = [rasters.voxel_starts(fleet.configs[dc].hall) for dc in focus]
        self._voxel_starts = np.concatenate(
            [racks.start + first for racks, first in zip(self.racks, starts, strict=True)]
        )
        """Index into the racks in focus of the first rack of each part of the 3D halls."""
        parts_of_dc = np.array([len(first) for first in starts])
        ends = np.cumsum([0, *(parts_of_dc * cadence.levels)]).tolist()
        self.levels = list(itertools.starmap(slice, itertools.pairwise(ends)))
        """Slice of each data center in focus in the array of the levels of all racks in focus."""
        self.reward_names: tuple[str, ...] | None = None
        """Names of the reward terms; None before the first step."""
        self._last_step = -1
        self._last_status = bytes(fleet.racks)
        self._has_events = any(
            fleet.configs[dc].events.scheduled or fleet.configs[dc].events.sampled for dc in focus
        )
        self.has_reference = reference is not None or self._has_events
        """True if there are maps of the difference from a reference."""
        self._reference = reference
        self._before_event_c: Reals | None = None
        self._before_first_event_c: Reals | None = None
        self._last_inlet_c: Reals | None = None
        self._active: list[ActiveEvent] = []
        self.first_event: ActiveEvent | None = None
        """First event of a data center in focus; None before it."""
        self._clear()

    def _clear(self) -> None:
        """Empty all buffers to begin a new block."""
        self._steps: list[int] = []
        self._bytes = 0
        self._unreduced: list[tuple[npt.NDArray[Any], ...]] = []
        self._reduced: list[tuple[F64, ...]] = []
        self._map_steps: list[int] = []
        self._maps: list[F32] = []
        self._change_steps: list[int] = []
        self._changes: list[F32] = []
        self._hall_steps: list[int] = []
        self._halls: list[F32] = []
        self._entries: list[LogEntry] = []
        self._down: list[tuple[int, int, tuple[int, ...]]] = []

    @property
    def steps(self) -> int:
        """Number of steps in the current block."""
        return len(self._steps)

    @property
    def is_full(self) -> bool:
        """True if the current block has reached its size limit and must be written."""
        return self.steps >= MAX_BLOCK_STEPS or self._bytes >= MAX_BLOCK_BYTES

    def active_events(self, dc: int) -> list[ActiveEvent]:
        """Return the events of a data center in focus that are active in the latest step."""
        return [event for event in self._active if event.dc == dc]

    def add(self, result: StepResult, rewards: Mapping[str, F64] | None) -> None:
        """Add a step to the current block.

        Args:
            result: result of the step.
            rewards: reward terms by name, (B,) each; None if there are none.

        Raises:
            SdcError: the result is of another simulator or does not follow the previous step, or
                the rewards have other names than in the first step or a shape other than (B,).
        """
        self._check(result)
        terms = rewards or {}
        if self.reward_names is None:
            self.reward_names = tuple(terms)
        if terms or self.reward_names:
            self._check_rewards(terms)
        fields = np.concatenate(self._read(result), dtype=np.float64)
        queue = self._sim.state.queue[self._focus]
        self._unreduced.append(
            (fields, queue, result.unit_supply_c, result.unit_flow_m3s, *terms.values())
        )
        step = self._last_step = result.step
        # ``_steps``, ``_map_steps`` and ``_hall_steps`` are extended last: if an interruption falls
        # in between, ``take`` discards data without an entry in these lists.
        self._steps.append(step)
        self._bytes += 8 * len(FIELDS) * (len(self._focus) + 2)
        self._add_events(result)
        cadence = self._cadence
        map_every = cadence.map_every_steps_in_events if self._active else cadence.map_every_steps
        if step % map_every == 0:
            self._add_map(result)
        every = cadence.hall_every_steps_in_events if self._active else cadence.hall_every_steps
        if step % every == 0:
            self._add_hall(result)
        if fields.nbytes * len(self._unreduced) >= _UNREDUCED_BYTES:
            self._reduce()

    def take(self) -> Block:
        """Return the current block and begin a new one."""
        if self._unreduced:
            self._reduce()
        values, sums, hottest_c, queue_by_age, supply_c, flow_m3s, *rewards = (
            np.concatenate(parts)[: len(self._steps)] for parts in zip(*self._reduced, strict=True)
        )
        maps, halls = self._maps[: len(self._map_steps)], self._halls[: len(self._hall_steps)]
        block = Block(
            steps=np.array(self._steps),
            size_bytes=self._bytes,
            values=append_pue(values),
            fleet=fleet_series(sums, hottest_c),
            queue_by_age=queue_by_age,
            unit_supply_c=supply_c,
            unit_flow_m3s=flow_m3s,
            rewards=np.stack(rewards, axis=1) if rewards else None,
            map_steps=np.array(self._map_steps, dtype=np.int64),
            maps=_by_quantity(MAP_QUANTITIES, maps),
            change_steps=np.array(self._change_steps, dtype=np.int64),
            changes=np.array(self._changes[: len(self._change_steps)], dtype=np.float32),
            hall_steps=np.array(self._hall_steps, dtype=np.int64),
            halls=_by_quantity(HALL_QUANTITIES, halls),
            entries=self._entries,
            down=self._down,
        )
        self._clear()
        return block

    def _reduce(self) -> None:
        """Reduce the buffered results to the data centers in focus and to values of the fleet."""
        fields, queues, supply_c, flow_m3s, *rewards = map(
            np.stack, zip(*self._unreduced, strict=True)
        )
        steps, n = len(fields), len(self._focus)
        by_dc = fields.reshape(steps, len(FIELDS), -1)
        self._reduced.append((
            by_dc[:, :, self._focus],
            by_dc[:, : len(FLEET_SUMS)].sum(axis=2),
            by_dc[:, FIELD_ROWS["inlet_max_c"]].max(axis=1),
            age_histogram(queues.reshape(steps * n, -1), self._age_edges).reshape(steps, n, -1),
            supply_c[:, self._pick_units],
            flow_m3s[:, self._pick_units],
            *(term[:, self._focus] for term in rewards),
        ))  # fmt: skip
        self._unreduced = []

    def _check(self, result: StepResult) -> None:
        """Raise ``SdcError`` for a result of another simulator or not of the next step."""
        dcs, racks, fleet = len(result.it_w), len(result.rack_inlet_c), self._fleet
        if (dcs, racks) != (fleet.size, fleet.racks):
            raise SdcError(
                f"recorder: result of {dcs} data centers and {racks} racks, expected "
                f"{fleet.size} and {fleet.racks}"
            )
        step, done = result.step, self._sim.state.step
        if step != done - 1:
            raise SdcError(
                f"recorder: result of step {step}, but the simulator has done {done} steps; add "
                "each step right after it"
            )
        if step != self._last_step + 1 and self._last_step >= 0:
            raise SdcError(
                f"recorder: step {step} after step {self._last_step}; an episode has all of its "
                "steps in order, and begin(sim) begins another"
            )

    def _check_rewards(self, terms: Mapping[str, F64]) -> None:
        """Raise ``SdcError`` for reward terms with other names than in the first step, or shapes.

        Each term must have the shape (B,).
        """
        if tuple(terms) != self.reward_names:
            raise SdcError(
                f"recorder: rewards {', '.join(terms) or 'none'}, expected "
                f"{', '.join(self.reward_names or ()) or 'none'} as in the first step"
            )
        for name, values in terms.items():
            if np.shape(values) != (self._fleet.size,):
                raise SdcError(
                    f"recorder: reward {name} has shape {np.shape(values)}; valid is one value per "
                    f"data center, ({self._fleet.size},)"
                )

    def _add_events(self, result: StepResult) -> None:
        """Add log entries for failures, weather events and racks with a changed status."""
        step, fleet, status = result.step, self._fleet, result.rack_status.tobytes()
        if self._has_events:
            active = [e for e in self._sim.active_events(step) if e.dc in self._focus]
            self._entries += failure_entries(step, self._active, active, fleet)
            self._add_units_down(step, active)
            if active and not self._active and self._last_inlet_c is not None:
                self._before_event_c = self._last_inlet_c[self._pick_racks]
                if self._before_first_event_c is None:
                    self._before_first_event_c = self._before_event_c
            self._last_inlet_c = result.rack_inlet_max_c
            if active and self.first_event is None:
                self.first_event = active[0]
            self._active = active
        if status == self._last_status:
            return
        after = result.rack_status
        before: Status = np.frombuffer(self._last_status, after.dtype)
        self._last_status = status
        for dc in self._focus:
            racks = slice(*fleet.rack_offsets[dc : dc + 2].tolist())
            inlet_c, per_row = result.rack_inlet_max_c[racks], fleet.configs[dc].hall.racks_per_row
            self._entries += protection_entries(
                step, dc, per_row, before[racks], after[racks], inlet_c
            )

    def _add_units_down(self, step: int, active: Sequence[ActiveEvent]) -> None:
        """Store the CRAC units of each data center that are down, if they have changed."""
        for dc in self._focus:
            before, now = (
                [event.target for event in events if event.dc == dc and event.kind == "crac_down"]
                for events in (self._active, active)
            )
            if before != now:
                count = int(np.diff(self._fleet.unit_offsets)[dc])
                units = range(count) if None in now else sorted({u for u in now if u is not None})
                self._down.append((step, dc, tuple(units)))

    def _add_map(self, result: StepResult) -> None:
        """Store the rack values of the heat maps of a step."""
        fields = result.rack_inlet_max_c, result.rack_outlet_c, result.rack_cpu_w, result.rack_fan_w
        inlet_c, outlet_c, cpu_w, fan_w = (
            values[self._pick_racks].astype(np.float32) for values in fields
        )
        rise_k = inlet_c - result.supply_c.astype(np.float32)[self._dc_of_racks]
        self._maps.append(np.stack([inlet_c, outlet_c, (cpu_w + fan_w) * np.float32(1e-3), rise_k]))
        self._bytes += self._map_bytes
        reference_c = self.reference_c(result.step)
        if reference_c is not None:
            self._changes.append((inlet_c - reference_c).astype(np.float32))
            self._change_steps.append(result.step)
        self._map_steps.append(result.step)

    def reference_c(self, step: int) -> Reals | None:
        """Return the inlets with which those of a step compare, in C, (R,); None without any.

        Args:
            step: the last step that was added, or a step during the first event.
        """
        if self._reference is not None:
            return self._reference.inlet_c(step)
        if self.first_event is not None and step < self.first_event.end_step:
            return self._before_first_event_c
        return self._before_event_c

    def _add_hall(self, result: StepResult) -> None:
        """Store the level temperatures of the 3D halls of a step."""
        if self._cadence.has_servers:
            servers = self._sim.servers()
            layers = np.stack([servers.inlet_c, servers.outlet_c])[:, self._pick_servers]
            values = np.maximum.reduceat(layers, self._level_starts, axis=-1)
        else:
            values = np.stack([result.rack_inlet_max_c, result.rack_outlet_c])[:, self._pick_racks]
            values = np.maximum.reduceat(values, self._voxel_starts, axis=-1)
        self._halls.append(values.astype(np.float32))
        self._bytes += 4 * values.size
        self._hall_steps.append(result.step)


def _pick(offsets: npt.NDArray[np.integer[Any]], focus: Sequence[int]) -> tuple[I64, list[slice]]:
    """Return the indices of the parts (racks, units or servers) of the data centers in focus.

    Args:
        offsets: index of the first part of each data center of the fleet, then the total, (B + 1,).
        focus: indices of the data centers in focus.

    Returns:
        Concatenated fleet indices of the parts, and each data center's slice of that array.
    """
    parts = [np.arange(*offsets[dc : dc + 2]) for dc in focus]
    ends = np.cumsum([0, *map(len, parts)]).tolist()
    return np.concatenate(parts), list(itertools.starmap(slice, itertools.pairwise(ends)))


def _by_quantity(names: Iterable[str], frames: Sequence[F32]) -> dict[str, F32]:
    """Return all frames of each quantity, stacked, from frames that have one row per quantity."""
    return dict(zip(names, np.stack(frames, axis=1), strict=True)) if frames else {}
