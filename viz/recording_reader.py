"""Reads results into blocks: the data centers in focus, and sums and extremes of all."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.plant.workload import age_histogram
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.types import F64, I64, Reals, Status, StepResult

from . import hall_layers as layers
from .recording_events import Entry, failure_entries, hottest_server, protection_entries
from .recording_series import AGE_EDGES_H, FIELDS, ROW, SUMMED

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

HOTTEST = 5
"""Halls in the table of the hottest."""
HOTTEST_FIELDS = ("inlet_max_c", "hottest_rack", "hottest_server")
_ROWS_BYTES = 4_000_000
"""Steps are read row by row; rows of so much are taken apart at once, before they leave the cache
that processors share."""


@dataclass(frozen=True, slots=True)
class Cadence:
    """How often what is read, and how finely."""

    map_every: int
    """Steps between two heat maps."""
    hall_every: int
    """Steps between two shots of the 3D hall."""
    hall_every_in_events: int
    """The same while a failure or weather event lasts."""
    zones: tuple[int, ...]
    """Heights per rack of each hall in focus."""
    per_server: bool
    """Whether heights show servers; else a rack shows its hottest inlet and mean outlet."""
    block_steps: int


@dataclass(frozen=True, slots=True)
class Block:
    """T steps of n data centers in focus; R racks and U CRAC units of these, end to end.

    Good until the reader is given another step.
    """

    steps: I64
    """(T,)."""
    values: F64
    """Of ``FIELDS``, (T, FIELDS, n)."""
    fleet: dict[str, F64]
    """Sums of ``SUMMED`` over all data centers of the fleet, and the highest ``inlet_max_c``."""
    ages: F64
    """Queued tasks by age, (T, n, bands)."""
    supply_c: F64
    """(T, U)."""
    flow_m3s: F64
    rewards: F64 | None
    """(T, terms, n)."""
    map_steps: I64
    """(M,)."""
    maps: dict[str, Reals]
    """Inlet and outlet in C, power in kW, (M, R)."""
    hall_steps: I64
    """(H,)."""
    halls: dict[str, Reals]
    """Inlet and outlet, rack by rack from the floor up, (H, zones of R)."""
    hottest: list[str]
    """Markdown table of the hottest halls for each of ``hall_steps``; empty for one hall."""
    entries: list[Entry]


class Reader:
    """Reads results into blocks.

    Args:
        sim: the simulator whose results they are.
        names: of its data centers.
        focus: data centers to read in full.
        cadence: how often what is read.
    """

    def __init__(
        self, sim: Simulator, names: Sequence[str], focus: Sequence[int], cadence: Cadence
    ) -> None:
        fleet = sim.fleet
        self._sim, self._fleet, self._names = sim, fleet, names
        self._shape = fleet.size, fleet.racks
        self._focus, self._cadence = list(focus), cadence
        self._every_focus, _ = end_to_end([slice(dc, dc + 1) for dc in focus])
        self._read = operator.attrgetter(*FIELDS, "unit_supply_c", "unit_flow_m3s")
        self._edges = np.array(AGE_EDGES_H) * fleet.steps_per_hour
        self._racks = [slice(*fleet.rack_offsets[dc : dc + 2].tolist()) for dc in focus]
        self._units = [slice(*fleet.unit_offsets[dc : dc + 2].tolist()) for dc in focus]
        self._every_rack, self.racks = end_to_end(self._racks)
        self._every_unit, self.units = end_to_end(self._units)
        shown = self._racks
        if cadence.per_server:
            shown = [slice(*fleet.group_offsets[[r.start, r.stop]].tolist()) for r in self._racks]
            self._zones = layers.zones_of(fleet, focus, cadence.zones)
        self._every_shown, ends = end_to_end(shown)
        cells = [(r.stop - r.start) * n for r, n in zip(self._racks, cadence.zones, strict=True)]
        self.cells = [slice(end - n, end) for n, end in zip(cells, np.cumsum(cells), strict=True)]
        self._status = bytes(fleet.racks)
        self._has_events = any(
            fleet.configs[dc].events.scheduled or fleet.configs[dc].events.sampled for dc in focus
        )
        self._active: list[ActiveEvent] = []
        self.reward_names: tuple[str, ...] | None = None
        """Known from the first step on."""
        self._last_step = -1
        self._rows = np.empty((0, 0))
        # Written over block by block, so that it stays in the cache.
        each = (cadence.map_every, cadence.hall_every, cadence.hall_every_in_events)
        maps, *halls = (-(-cadence.block_steps // steps) for steps in each)
        self._maps = np.empty((maps, 4 * self.racks[-1].stop), dtype=np.float32)
        self._halls = np.empty((2, sum(halls), ends[-1].stop), dtype=np.float32)
        self._clear()

    def _clear(self) -> None:
        self._steps: list[int] = []
        self._parts: list[list[F64]] = []
        self._map_steps: list[int] = []
        self._hall_steps: list[int] = []
        self._entries: list[Entry] = []

    @property
    def held(self) -> int:
        """Steps of the block under way."""
        return len(self._steps)

    def add(self, result: StepResult, rewards: Mapping[str, F64] | None) -> None:
        """Read a step.

        Raises:
            SdcError: it is none of the simulator's, or does not follow the one before, or has other
                rewards than it, or rewards that are not one value per data center.
        """
        self._check(result)
        queue = self._sim.state.queue[self._every_focus].reshape(-1)
        terms = rewards or {}
        if self.reward_names is None:
            self._lay_out(len(queue), tuple(terms))
        if terms or self.reward_names:
            self._check_rewards(terms)
        row = len(self._steps) % len(self._rows)
        if row == 0 and self._steps:
            self._take_apart()
        np.concatenate((*self._read(result), queue, *terms.values()), out=self._rows[row])
        step = self._last_step = result.step
        # What is not listed yet does not count, should reading be interrupted.
        self._steps.append(step)
        self._add_events(result)
        cadence = self._cadence
        if step % cadence.map_every == 0:
            self._add_maps(result)
        if step % (cadence.hall_every_in_events if self._active else cadence.hall_every) == 0:
            self._add_halls(result)

    def _lay_out(self, queued: int, reward_names: tuple[str, ...]) -> None:
        """Make room for what is read of a step: fields, CRAC units, queues and reward terms."""
        size = self._fleet.size
        widths = [len(FIELDS) * size, *[self._fleet.units] * 2, queued, len(reward_names) * size]
        ends = np.cumsum(widths).tolist()
        self._kinds = [slice(end - n, end) for n, end in zip(widths, ends, strict=True)]
        width = ends[-1]
        held = min(max(_ROWS_BYTES // (8 * width), 1), self._cadence.block_steps)
        self._rows = np.empty((held, width))
        self.reward_names = reward_names

    def _take_apart(self) -> None:
        """Bring what was read of several steps into the form of a block."""
        k = len(self._steps) - len(self._parts) * len(self._rows)
        fields, supply_c, flow_m3s, queues, rewards = (self._rows[:k, part] for part in self._kinds)
        focus, n, size = self._every_focus, len(self._focus), self._fleet.size
        of_dcs = fields.reshape(k, len(FIELDS), size)
        self._parts.append([
            of_dcs[:, :, focus].copy(),
            of_dcs[:, : len(SUMMED)].sum(axis=2),
            of_dcs[:, ROW["inlet_max_c"]].max(axis=1),
            age_histogram(queues.reshape(k * n, -1), self._edges).reshape(k, n, -1),
            supply_c[:, self._every_unit].copy(),
            flow_m3s[:, self._every_unit].copy(),
            rewards.reshape(k, -1, size)[:, :, focus].copy(),
            *self._hottest(of_dcs),
        ])  # fmt: skip

    def _hottest(self, of_dcs: F64) -> tuple[F64, F64]:
        """Hot halls and the hottest inlets where the 3D halls are shown, of the rows read.

        Returns:
            Number of halls above what is recommended, (shots,), and hall, inlet, rack and server
            of the hottest ones, (shots, 4, halls).
        """
        first = self._steps[-1] + 1 - len(of_dcs)
        at = np.array([step - first for step in self._hall_steps if step >= first], dtype=np.intp)
        shown = of_dcs[at[:, None], [ROW[field] for field in HOTTEST_FIELDS]]
        top = np.argsort(-shown[:, 0], axis=1, kind="stable")[:, None, :HOTTEST]
        above = np.count_nonzero(shown[:, 0] > RECOMMENDED_C[1], axis=1)
        return above, np.concatenate([top, np.take_along_axis(shown, top, axis=2)], axis=1)

    def take(self) -> Block:
        """The block under way; another begins."""
        if len(self._steps) > len(self._parts) * len(self._rows):
            self._take_apart()
        values, total, hottest_c, ages, supply_c, flow_m3s, rewards, above, hottest = (
            np.concatenate(parts) for parts in zip(*self._parts, strict=True)
        )
        inlet_c, outlet_c, cpu_w, fan_w = np.split(self._maps[: len(self._map_steps)], 4, axis=1)
        halls = self._halls[:, : len(self._hall_steps)]
        if self._cadence.per_server:
            halls = layers.zone_peaks(halls, self._zones)
        block = Block(
            steps=np.array(self._steps, dtype=np.int64),
            values=values,
            fleet=dict(zip(SUMMED, total.T, strict=True)) | {"inlet_max_c": hottest_c},
            ages=ages,
            supply_c=supply_c,
            flow_m3s=flow_m3s,
            rewards=rewards if self.reward_names else None,
            map_steps=np.array(self._map_steps, dtype=np.int64),
            maps={
                "inlet": inlet_c,
                "outlet": outlet_c,
                "power": (cpu_w + fan_w) * np.float32(1e-3),
            },
            hall_steps=np.array(self._hall_steps, dtype=np.int64),
            halls=dict(zip(("inlet", "outlet"), halls, strict=True)) if halls.size else {},
            hottest=list(map(self._table, above.tolist(), hottest)) if self._fleet.size > 1 else [],
            entries=self._entries,
        )
        self._clear()
        return block

    def _check(self, result: StepResult) -> None:
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
        step, fleet, status = result.step, self._fleet, result.rack_status.tobytes()
        if self._has_events:
            active = [e for e in self._sim.active_events(step) if e.dc in self._focus]
            self._entries += failure_entries(step, self._active, active, fleet)
            self._active = active
        if status == self._status:
            return
        after = result.rack_status
        before: Status = np.frombuffer(self._status, after.dtype)
        self._status = status
        inlet_c: Reals | None = None
        for dc, racks in zip(self._focus, self._racks, strict=True):
            if np.array_equal(before[racks], after[racks]):
                continue
            if inlet_c is None and self._cadence.per_server:
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
        shown = result.rack_inlet_c, result.rack_outlet_c, result.rack_cpu_w, result.rack_fan_w
        of_focus = [values[self._every_rack] for values in shown]
        np.concatenate(of_focus, out=self._maps[len(self._map_steps)])
        self._map_steps.append(result.step)

    def _add_halls(self, result: StepResult) -> None:
        if self._cadence.per_server:
            groups = self._sim.server_groups()
            inlet_c, outlet_c = groups.inlet_c, groups.outlet_c
        else:
            inlet_c, outlet_c = result.rack_inlet_max_c, result.rack_outlet_c
        shot = len(self._hall_steps)
        self._halls[0, shot] = inlet_c[self._every_shown]
        self._halls[1, shot] = outlet_c[self._every_shown]
        self._hall_steps.append(result.step)

    def _table(self, above: int, hottest: F64) -> str:
        """Markdown table of the halls with the hottest inlets in a step."""
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


def end_to_end(parts: Sequence[slice]) -> tuple[slice | I64, list[slice]]:
    """Several parts of an array as one, and where each is then."""
    ends = np.cumsum([0, *(part.stop - part.start for part in parts)]).tolist()
    own = [slice(first, last) for first, last in itertools.pairwise(ends)]
    if all(a.stop == b.start for a, b in itertools.pairwise(parts)):
        return slice(parts[0].start, parts[-1].stop), own
    return np.concatenate([np.arange(part.start, part.stop) for part in parts]), own
