"""Collect results in blocks: the data centers in focus in full, and sums over the fleet."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, rank
from sdc_taichi.plant.workload import age_histogram
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32, F64, I64, Reals, Status, StepResult

from . import hall_rasters as rasters
from .recording_series import AGE_EDGES_H, FIELD_ROWS, FIELDS, FLEET_SUMS, Cadence
from .recording_text import LogEntry, failure_entries, hottest_server, protection_entries

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

MAX_BLOCK_STEPS, MAX_BLOCK_BYTES = 1_024, 16_000_000
"""Largest size of a block, which is in memory until it is written, in steps and bytes."""
MAP_EVERY_H = ((200, 0.0), (2_000, 1.0), (20_000, 3.0), (np.inf, 6.0))
"""Largest number of racks in focus, and the hours between two heat maps, 0 being every step."""
HALL_EVERY_H, HALL_EVERY_H_IN_EVENTS = 3.0, 1.0
"""Least time between two frames of the 3D hall, which need a pass over all servers, in h."""
SMALL_HALL_LEVELS, LARGE_HALL_LEVELS = 10, 5
"""Levels of a rack of the 3D hall, in small and in larger halls."""
MAX_SERVERS_IN_LEVELS = 100_000
"""Number of servers of the fleet up to which the levels of a rack show its servers."""
HOTTEST_HALLS = 5
"""Number of halls that the list of the hottest has."""
HOTTEST_FIELDS = ("inlet_max_c", "hottest_rack", "hottest_server")
"""Fields that the list of the hottest halls shows."""
_UNREDUCED_BYTES = 4_000_000
"""Size of the results that wait until they are reduced to the data centers in focus; it fits into
the cache that processors share."""


def choose_cadence(fleet: Fleet, focus: Sequence[int], every_steps: int | None) -> Cadence:
    """Cadence for the halls in focus.

    Args:
        fleet: the fleet.
        focus: indices of the data centers in focus.
        every_steps: steps between two heat maps and between two frames of the 3D hall; None
            follows the number of racks in focus.
    """
    racks = int(np.diff(fleet.rack_offsets)[focus].sum())
    map_every_h = next(hours for most, hours in MAP_EVERY_H if racks <= most)
    per_hour = fleet.steps_per_hour
    map_every = every_steps or max(1, round(map_every_h * per_hour))
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


@dataclass(frozen=True, slots=True)
class Block:
    """T steps of n data centers in focus, with R racks and U CRAC units, end to end."""

    steps: I64
    """Steps, counted from 0 at reset, (T,)."""
    values: F64
    """Values of ``FIELDS``, F in all, in their units, (T, F, n)."""
    fleet: dict[str, F64]
    """Sums of ``FLEET_SUMS`` over all data centers, and the highest ``inlet_max_c``, (T,) each."""
    queue_by_age: F64
    """Queued work by age band, in tasks, (T, n, bands)."""
    unit_supply_c: F64
    """Supply air of the CRAC units, in C, (T, U)."""
    unit_flow_m3s: F64
    """Airflow of the CRAC units, in m3/s, (T, U)."""
    rewards: F64 | None
    """Reward terms, (T, terms, n); None without any."""
    map_steps: I64
    """Steps with heat maps, (M,)."""
    maps: dict[str, Reals]
    """Values of the racks by quantity: inlet and outlet in C, power in kW, (M, R) each."""
    hall_steps: I64
    """Steps with frames of the 3D hall, (H,)."""
    halls: dict[str, Reals]
    """Inlets and outlets of the levels of all racks from the floor up, in C, (H, levels) each."""
    hottest: list[str]
    """Markdown list of the hottest halls for each of ``hall_steps``; empty for one hall."""
    entries: list[LogEntry]
    """Entries of the log, step by step."""


class BlockBuilder:
    """Collects the results of a simulator until they are taken as a block.

    Args:
        sim: the simulator that makes the results.
        names: names of its data centers.
        focus: indices of the data centers in focus.
        cadence: how often heat maps and 3D halls are recorded.
    """

    def __init__(
        self, sim: Simulator, names: Sequence[str], focus: Sequence[int], cadence: Cadence
    ) -> None:
        fleet = sim.fleet
        self._sim, self._fleet, self._names = sim, fleet, names
        self._focus, self._cadence = list(focus), cadence
        self._read = operator.attrgetter(*FIELDS)
        self._age_edges = np.array(AGE_EDGES_H) * fleet.steps_per_hour
        self._pick_racks, self.racks = _pick(fleet.rack_offsets, focus)
        """Indices of the racks in focus, and the place of each data center among these."""
        self._pick_units, self.units = _pick(fleet.unit_offsets, focus)
        """Indices of the CRAC units in focus, and the place of each data center among these."""
        self._pick_hall = self._pick_racks
        if cadence.has_servers:
            self._pick_hall, _ = _pick(fleet.group_offsets[fleet.rack_offsets], focus)
            self._levels = rasters.level_groups(fleet, focus, cadence.levels)
        racks = np.diff(fleet.rack_offsets)[self._focus]
        ends = np.cumsum([0, *(racks * cadence.levels)]).tolist()
        self.levels = list(itertools.starmap(slice, itertools.pairwise(ends)))
        """Place of each data center in focus among the levels of all racks."""
        self.reward_names: tuple[str, ...] | None = None
        """Names of the reward terms, known from the first step on."""
        self._last_step = -1
        self._last_status = bytes(fleet.racks)
        self._has_events = any(
            fleet.configs[dc].events.scheduled or fleet.configs[dc].events.sampled for dc in focus
        )
        self._active: list[ActiveEvent] = []
        self._clear()

    def _clear(self) -> None:
        """Begin a block."""
        self._steps: list[int] = []
        self._unreduced: list[tuple[npt.NDArray[Any], ...]] = []
        self._reduced: list[tuple[F64, ...]] = []
        self._map_steps: list[int] = []
        self._maps: list[F32] = []
        self._hall_steps: list[int] = []
        self._halls: list[F32] = []
        self._hottest: list[str] = []
        self._entries: list[LogEntry] = []

    @property
    def steps(self) -> int:
        """Number of steps in the block under way."""
        return len(self._steps)

    def add(self, result: StepResult, rewards: Mapping[str, F64] | None) -> None:
        """Add a step to the block under way.

        Args:
            result: result of the step.
            rewards: reward terms by name, (B,) each.

        Raises:
            SdcError: the result is of another simulator, or does not follow the one before, or
                has other rewards than it, or rewards that are not one value per data center.
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
        # Only steps and frames that are listed count, should an interruption come in between.
        self._steps.append(step)
        self._add_events(result)
        cadence = self._cadence
        if step % cadence.map_every_steps == 0:
            self._add_map(result)
        every = cadence.hall_every_steps_in_events if self._active else cadence.hall_every_steps
        if step % every == 0:
            if self._fleet.size > 1:
                self._hottest.append(self._hottest_text(fields.reshape(len(FIELDS), -1)))
            self._add_hall(result)
        if fields.nbytes * len(self._unreduced) >= _UNREDUCED_BYTES:
            self._reduce()

    def take(self) -> Block:
        """The block under way; another begins."""
        if self._unreduced:
            self._reduce()
        values, sums, hottest_c, queue_by_age, supply_c, flow_m3s, *rewards = (
            np.concatenate(parts)[: len(self._steps)] for parts in zip(*self._reduced, strict=True)
        )
        maps, halls = self._maps[: len(self._map_steps)], self._halls[: len(self._hall_steps)]
        inlet_outlet = np.stack(halls, axis=1) if halls else np.empty((0, 0, 0), dtype=np.float32)
        if halls and self._cadence.has_servers:
            inlet_outlet = rasters.level_maxima(inlet_outlet, self._levels)
        block = Block(
            steps=np.array(self._steps),
            values=values,
            fleet=dict(zip(FLEET_SUMS, sums.T, strict=True)) | {"inlet_max_c": hottest_c},
            queue_by_age=queue_by_age,
            unit_supply_c=supply_c,
            unit_flow_m3s=flow_m3s,
            rewards=np.stack(rewards, axis=1) if rewards else None,
            map_steps=np.array(self._map_steps, dtype=np.int64),
            maps=dict(zip(rasters.COLOURMAPS, np.stack(maps, axis=1), strict=True)) if maps else {},
            hall_steps=np.array(self._hall_steps, dtype=np.int64),
            halls=dict(zip(rasters.TEMPERATURE_RANGES_C, inlet_outlet, strict=False)),
            hottest=self._hottest[: len(self._hall_steps)],
            entries=self._entries,
        )
        self._clear()
        return block

    def _reduce(self) -> None:
        """Reduce the results that wait to data centers in focus and sums over the fleet."""
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
        """Refuse a result of another simulator, or one that does not follow the last one."""
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
        """Refuse reward terms of other names than in the first step, or of another shape."""
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
        """Log failures, weather events and racks that changed their status."""
        step, fleet, status = result.step, self._fleet, result.rack_status.tobytes()
        if self._has_events:
            active = [e for e in self._sim.active_events(step) if e.dc in self._focus]
            self._entries += failure_entries(step, self._active, active, fleet)
            self._active = active
        if status == self._last_status:
            return
        after = result.rack_status
        before: Status = np.frombuffer(self._last_status, after.dtype)
        self._last_status = status
        inlet_c: Reals | None = None
        for dc in self._focus:
            racks = slice(*fleet.rack_offsets[dc : dc + 2].tolist())
            if np.array_equal(before[racks], after[racks]):
                continue
            if inlet_c is None and self._cadence.has_servers:
                inlet_c = self._sim.server_groups().inlet_c

            def hottest(
                rack: int, first: int = racks.start, inlet_c: Reals | None = inlet_c
            ) -> tuple[int | None, float]:
                if inlet_c is None:
                    return None, float(result.rack_inlet_max_c[first + rack])
                return hottest_server(inlet_c, fleet, first + rack)

            per_row = fleet.configs[dc].hall.racks_per_row
            self._entries += protection_entries(
                step, dc, per_row, before[racks], after[racks], hottest
            )

    def _add_map(self, result: StepResult) -> None:
        """Keep what the heat maps of a step show."""
        fields = result.rack_inlet_c, result.rack_outlet_c, result.rack_cpu_w, result.rack_fan_w
        inlet_c, outlet_c, cpu_w, fan_w = (
            values[self._pick_racks].astype(np.float32) for values in fields
        )
        self._maps.append(np.stack([inlet_c, outlet_c, (cpu_w + fan_w) * np.float32(1e-3)]))
        self._map_steps.append(result.step)

    def _add_hall(self, result: StepResult) -> None:
        """Keep what the 3D halls of a step show."""
        inlet_c, outlet_c = result.rack_inlet_max_c, result.rack_outlet_c
        if self._cadence.has_servers:
            groups = self._sim.server_groups()
            inlet_c, outlet_c = groups.inlet_c, groups.outlet_c
        pair = np.stack([inlet_c[self._pick_hall], outlet_c[self._pick_hall]])
        self._halls.append(pair.astype(np.float32))
        self._hall_steps.append(result.step)

    def _hottest_text(self, by_dc: F64) -> str:
        """Markdown of the halls with the hottest inlets in a step.

        Args:
            by_dc: values of ``FIELDS``, (F, B).
        """
        inlet_c, racks, servers = (by_dc[FIELD_ROWS[field]] for field in HOTTEST_FIELDS)
        recommended_c = RECOMMENDED_C[1]
        above = np.count_nonzero(inlet_c > recommended_c + LEAST_EXCESS_K)
        lines = [
            f"{above} of {len(inlet_c)} halls have inlets above {recommended_c:g} C",
            "",
            "| hall | hottest inlet [C] | row | rack | server from the floor |",
            "|---|---:|---:|---:|---:|",
        ]
        for dc in np.argsort(-rank(inlet_c), kind="stable")[:HOTTEST_HALLS].tolist():
            rack = int(racks[dc])
            row = rack // self._fleet.configs[dc].hall.racks_per_row
            place = f"{row} | {rack} | {int(servers[dc])}"
            lines.append(f"| {self._names[dc]} | {inlet_c[dc]:.2f} | {place} |")
        return "\n".join(lines)


def _pick(offsets: npt.NDArray[np.integer[Any]], focus: Sequence[int]) -> tuple[I64, list[slice]]:
    """Indices of the parts of the data centers in focus, and the place of each among these."""
    parts = [np.arange(*offsets[dc : dc + 2]) for dc in focus]
    ends = np.cumsum([0, *map(len, parts)]).tolist()
    return np.concatenate(parts), list(itertools.starmap(slice, itertools.pairwise(ends)))
