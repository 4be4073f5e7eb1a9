"""Collect results in blocks: the data centers in focus in full, and sums over the fleet."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, rank
from sdc_taichi.plant.workload import age_histogram
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.types import F64, I64, Reals, Status, StepResult

from . import hall_rasters as rasters
from .recording_cadence import Cadence
from .recording_log import LogEntry, failure_entries, hottest_server, protection_entries
from .recording_series import AGE_EDGES_H, FIELD_ROWS, FIELDS, FLEET_SUMS

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

HOTTEST_HALLS = 5
"""Number of halls that the list of the hottest has."""
HOTTEST_FIELDS = ("inlet_max_c", "hottest_rack", "hottest_server")
"""Fields that the list of the hottest halls shows."""
_BUFFER_BYTES = 4_000_000
"""Size of the buffer of rows, one per step, that fits into the cache that processors share."""


@dataclass(frozen=True, slots=True)
class Block:
    """T steps of n data centers in focus, with R racks and U CRAC units, end to end.

    Arrays are valid until the next step is added to the builder.
    """

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
        sim: the simulator whose results they are.
        names: names of its data centers.
        focus: indices of the data centers in focus.
        cadence: how often heat maps and 3D halls are recorded.
    """

    def __init__(
        self, sim: Simulator, names: Sequence[str], focus: Sequence[int], cadence: Cadence
    ) -> None:
        fleet = sim.fleet
        self._sim, self._fleet, self._names = sim, fleet, names
        self._shape = fleet.size, fleet.racks
        self._focus, self._cadence = list(focus), cadence
        self._read = operator.attrgetter(*FIELDS, "unit_supply_c", "unit_flow_m3s")
        self._age_edges = np.array(AGE_EDGES_H) * fleet.steps_per_hour
        # Index arrays or slices that pick what is in focus, and where each data center is then.
        self._pick_dcs, _ = _joined([slice(dc, dc + 1) for dc in focus])
        self._rack_slices = [slice(*fleet.rack_offsets[dc : dc + 2].tolist()) for dc in focus]
        unit_slices = [slice(*fleet.unit_offsets[dc : dc + 2].tolist()) for dc in focus]
        self._pick_racks, self.racks = _joined(self._rack_slices)
        self._pick_units, self.units = _joined(unit_slices)
        columns = self._rack_slices
        if cadence.has_servers:
            columns = [
                slice(*fleet.group_offsets[[racks.start, racks.stop]].tolist())
                for racks in self._rack_slices
            ]
            self._levels = rasters.level_groups(fleet, focus, cadence.levels)
        self._pick_hall_columns, hall_columns = _joined(columns)
        counts = [
            (racks.stop - racks.start) * levels
            for racks, levels in zip(self._rack_slices, cadence.levels, strict=True)
        ]
        self.levels = [
            slice(end - n, end) for n, end in zip(counts, np.cumsum(counts), strict=True)
        ]
        """Place of each data center in focus among the levels of all racks."""
        self.reward_names: tuple[str, ...] | None = None
        """Names of the reward terms, known from the first step on."""
        self._last_step = -1
        self._last_status = bytes(fleet.racks)
        self._has_events = any(
            fleet.configs[dc].events.scheduled or fleet.configs[dc].events.sampled for dc in focus
        )
        self._active: list[ActiveEvent] = []
        self._rows = np.empty((0, 0))
        self._make_hall_buffers(hall_columns[-1].stop)
        self._clear()

    def _make_hall_buffers(self, hall_columns: int) -> None:
        """Buffers of heat maps and 3D halls; reused block by block, they stay in the cache."""
        cadence = self._cadence
        intervals = (
            cadence.map_every_steps,
            cadence.hall_every_steps,
            cadence.hall_every_steps_in_events,
        )
        maps, *halls = (-(-cadence.block_steps // steps) for steps in intervals)
        self._maps = np.empty((maps, 4 * self.racks[-1].stop), dtype=np.float32)
        self._halls = np.empty((2, sum(halls), hall_columns), dtype=np.float32)

    def _clear(self) -> None:
        """Begin a block."""
        self._steps: list[int] = []
        self._parts: list[list[F64]] = []
        self._map_steps: list[int] = []
        self._hall_steps: list[int] = []
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
            SdcError: the result is none of the simulator's, or does not follow the one before, or
                has other rewards than it, or rewards that are not one value per data center.
        """
        self._check(result)
        queue = self._sim.state.queue[self._pick_dcs].reshape(-1)
        terms = rewards or {}
        if self.reward_names is None:
            self._make_rows(len(queue), tuple(terms))
        if terms or self.reward_names:
            self._check_rewards(terms)
        row = len(self._steps) % len(self._rows)
        if row == 0 and self._steps:
            self._split_rows()
        np.concatenate((*self._read(result), queue, *terms.values()), out=self._rows[row])
        step = self._last_step = result.step
        # A step that is not listed yet does not count, should reading be interrupted.
        self._steps.append(step)
        self._add_events(result)
        cadence = self._cadence
        if step % cadence.map_every_steps == 0:
            self._add_maps(result)
        every = cadence.hall_every_steps_in_events if self._active else cadence.hall_every_steps
        if step % every == 0:
            self._add_halls(result)

    def take(self) -> Block:
        """The block under way; another begins."""
        if len(self._steps) > len(self._parts) * len(self._rows):
            self._split_rows()
        values, sums, hottest_c, queue_by_age, supply_c, flow_m3s, rewards, above, hottest = (
            np.concatenate(parts) for parts in zip(*self._parts, strict=True)
        )
        inlet_c, outlet_c, cpu_w, fan_w = np.split(self._maps[: len(self._map_steps)], 4, axis=1)
        halls = self._halls[:, : len(self._hall_steps)]
        if self._cadence.has_servers:
            halls = rasters.level_maxima(halls, self._levels)
        has_others = self._fleet.size > 1
        block = Block(
            steps=np.array(self._steps, dtype=np.int64),
            values=values,
            fleet=dict(zip(FLEET_SUMS, sums.T, strict=True)) | {"inlet_max_c": hottest_c},
            queue_by_age=queue_by_age,
            unit_supply_c=supply_c,
            unit_flow_m3s=flow_m3s,
            rewards=rewards if self.reward_names else None,
            map_steps=np.array(self._map_steps, dtype=np.int64),
            maps={
                "inlet": inlet_c,
                "outlet": outlet_c,
                "power": (cpu_w + fan_w) * np.float32(1e-3),
            },
            hall_steps=np.array(self._hall_steps, dtype=np.int64),
            halls=dict(zip(("inlet", "outlet"), halls, strict=True)) if halls.size else {},
            hottest=list(map(self._hottest_text, above.tolist(), hottest)) if has_others else [],
            entries=self._entries,
        )
        self._clear()
        return block

    def _make_rows(self, queue_columns: int, reward_names: tuple[str, ...]) -> None:
        """Make the buffer of rows: fields, CRAC units, queues and reward terms of a step each."""
        size = self._fleet.size
        widths = [
            len(FIELDS) * size,
            *[self._fleet.units] * 2,
            queue_columns,
            len(reward_names) * size,
        ]
        ends = np.cumsum(widths).tolist()
        self._row_parts = [slice(end - n, end) for n, end in zip(widths, ends, strict=True)]
        width = ends[-1]
        rows = min(max(_BUFFER_BYTES // (8 * width), 1), self._cadence.block_steps)
        self._rows = np.empty((rows, width))
        self.reward_names = reward_names

    def _split_rows(self) -> None:
        """Bring the rows of the buffer into the form of a block."""
        k = len(self._steps) - len(self._parts) * len(self._rows)
        fields, supply_c, flow_m3s, queues, rewards = (
            self._rows[:k, part] for part in self._row_parts
        )
        dcs, n, size = self._pick_dcs, len(self._focus), self._fleet.size
        by_dc = fields.reshape(k, len(FIELDS), size)
        self._parts.append([
            by_dc[:, :, dcs].copy(),
            by_dc[:, : len(FLEET_SUMS)].sum(axis=2),
            by_dc[:, FIELD_ROWS["inlet_max_c"]].max(axis=1),
            age_histogram(queues.reshape(k * n, -1), self._age_edges).reshape(k, n, -1),
            supply_c[:, self._pick_units].copy(),
            flow_m3s[:, self._pick_units].copy(),
            rewards.reshape(k, -1, size)[:, :, dcs].copy(),
            *self._hottest_halls(by_dc),
        ])  # fmt: skip

    def _hottest_halls(self, by_dc: F64) -> tuple[F64, F64]:
        """Hottest halls of the fleet in the steps with frames of the 3D hall.

        Args:
            by_dc: values of ``FIELDS`` in the last k steps, (k, F, B).

        Returns:
            Number of halls with an inlet above the recommended range, (frames,), and of the
            hottest ones the data center, inlet, rack and server, (frames, 4, halls).
        """
        first = self._steps[-1] + 1 - len(by_dc)
        rows = np.array([step - first for step in self._hall_steps if step >= first], dtype=np.intp)
        values = by_dc[rows[:, None], [FIELD_ROWS[field] for field in HOTTEST_FIELDS]]
        top = np.argsort(-rank(values[:, 0]), axis=1, kind="stable")[:, None, :HOTTEST_HALLS]
        above = np.count_nonzero(values[:, 0] > RECOMMENDED_C[1] + LEAST_EXCESS_K, axis=1)
        return above, np.concatenate([top, np.take_along_axis(values, top, axis=2)], axis=1)

    def _check(self, result: StepResult) -> None:
        """Refuse a result of another simulator, or one that does not follow the last one."""
        shape = len(result.it_w), len(result.rack_inlet_c)
        if shape != self._shape:
            raise SdcError(
                f"recorder: result of {shape[0]} data centers and {shape[1]} racks, expected "
                f"{self._shape[0]} and {self._shape[1]}"
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
        for dc, racks in zip(self._focus, self._rack_slices, strict=True):
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

    def _add_maps(self, result: StepResult) -> None:
        """Keep what the heat maps of a step show."""
        fields = result.rack_inlet_c, result.rack_outlet_c, result.rack_cpu_w, result.rack_fan_w
        in_focus = [values[self._pick_racks] for values in fields]
        np.concatenate(in_focus, out=self._maps[len(self._map_steps)])
        self._map_steps.append(result.step)

    def _add_halls(self, result: StepResult) -> None:
        """Keep what the 3D halls of a step show."""
        if self._cadence.has_servers:
            groups = self._sim.server_groups()
            inlet_c, outlet_c = groups.inlet_c, groups.outlet_c
        else:
            inlet_c, outlet_c = result.rack_inlet_max_c, result.rack_outlet_c
        frame = len(self._hall_steps)
        self._halls[0, frame] = inlet_c[self._pick_hall_columns]
        self._halls[1, frame] = outlet_c[self._pick_hall_columns]
        self._hall_steps.append(result.step)

    def _hottest_text(self, above: int, hottest: F64) -> str:
        """Markdown of the halls with the hottest inlets in a step.

        Args:
            above: number of halls with an inlet above the recommended range.
            hottest: data center, inlet, rack and server of the hottest halls, (4, halls).
        """
        size, recommended_c = self._fleet.size, RECOMMENDED_C[1]
        lines = [
            f"{above} of {size} halls have inlets above {recommended_c:g} C",
            "",
            "| hall | hottest inlet [C] | row | rack | server from the floor |",
            "|---|---:|---:|---:|---:|",
        ]
        for dc, inlet_c, rack, server in hottest.T.tolist():
            row = int(rack) // self._fleet.configs[int(dc)].hall.racks_per_row
            name = self._names[int(dc)]
            lines.append(f"| {name} | {inlet_c:.2f} | {row} | {int(rack)} | {int(server)} |")
        return "\n".join(lines)


def _joined(parts: Sequence[slice]) -> tuple[slice | I64, list[slice]]:
    """Index of several parts of an array as one, and the place of each part in what it picks."""
    ends = np.cumsum([0, *(part.stop - part.start for part in parts)]).tolist()
    places = [slice(first, last) for first, last in itertools.pairwise(ends)]
    if all(a.stop == b.start for a, b in itertools.pairwise(parts)):
        return slice(parts[0].start, parts[-1].stop), places
    return np.concatenate([np.arange(part.start, part.stop) for part in parts]), places
