"""Reads results into blocks: the data centers in focus, and sums and extremes of all."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sdc_taichi.air_metrics import RECOMMENDED_C
from sdc_taichi.errors import SdcError
from sdc_taichi.events import ActiveEvent
from sdc_taichi.fleet import Fleet
from sdc_taichi.plant.workload import age_histogram
from sdc_taichi.types import F64, I64, Reals, Status, StepResult

from . import hall_layers as layers
from .recording_events import Entry, failure_entries, hottest_server, protection_entries
from .recording_series import AGE_EDGES_H, FIELDS

if TYPE_CHECKING:
    from sdc_taichi.sim import Simulator

HOTTEST = 5
"""Halls in the table of the hottest."""


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
    """T steps of n data centers in focus; R racks and U CRAC units of these, end to end."""

    steps: I64
    """(T,)."""
    values: F64
    """Of ``FIELDS``, (T, FIELDS, n)."""
    total: F64
    """Over all data centers of the fleet, (T, FIELDS)."""
    most: F64
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
    halls: list[dict[str, Reals]]
    """Inlet and outlet of each hall, rack by rack from the floor up, (H, racks zones)."""
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
        self._focus, self._cadence = list(focus), cadence
        self._every_focus, _ = end_to_end([slice(dc, dc + 1) for dc in focus])
        self._read = operator.attrgetter(*FIELDS)
        self._edges = np.array(AGE_EDGES_H) * fleet.steps_per_hour
        self._racks = [slice(*fleet.rack_start[dc : dc + 2].tolist()) for dc in focus]
        self._units = [slice(*fleet.unit_start[dc : dc + 2].tolist()) for dc in focus]
        self._every_rack, self.racks = end_to_end(self._racks)
        self._every_unit, self.units = end_to_end(self._units)
        self._zone_starts = [
            layers.zone_starts(fleet, dc, zones)
            for dc, zones in zip(focus, cadence.zones, strict=True)
        ]
        self._server_end = [int(fleet.server_start[fleet.group_start[r.stop]]) for r in self._racks]
        self._status: Status = np.zeros(fleet.racks, dtype=np.int8)
        self._has_events = any(
            fleet.configs[dc].events.scheduled or fleet.configs[dc].events.sampled for dc in focus
        )
        self._active: list[ActiveEvent] = []
        self.reward_names: tuple[str, ...] | None = None
        """Known from the first step on."""
        self._last_step = -1
        # Arrays that are written over block by block stay in the cache.
        steps, n, fields = cadence.block_steps, len(focus), len(FIELDS)
        shots = -(-steps // cadence.map_every)
        self._values = np.empty((steps, fields, n))
        self._row = np.empty(fields * fleet.size)
        self._every_dc = self._row.reshape(fields, fleet.size)
        self._total, self._most = np.empty((steps, fields)), np.empty((steps, fields))
        self._queues: F64 = np.empty((0, n, 0))
        self._supply_c = np.empty((steps, self.units[-1].stop))
        self._flow_m3s = np.empty_like(self._supply_c)
        self._rewards = np.empty((steps, 0, n))
        self._maps = {
            what: np.empty((shots, self.racks[-1].stop), dtype=np.float32)
            for what in layers.COLOURMAPS
        }
        self._clear()

    def _clear(self) -> None:
        self._steps: list[int] = []
        self._map_steps: list[int] = []
        self._hall_steps: list[int] = []
        self._halls: list[dict[str, list[Reals]]] = [
            {what: [] for what in layers.LIMITS_C} for _ in self._focus
        ]
        self._hottest: list[str] = []
        self._entries: list[Entry] = []

    @property
    def held(self) -> int:
        """Steps of the block under way."""
        return len(self._steps)

    def add(self, result: StepResult, rewards: Mapping[str, F64] | None) -> None:
        """Read a step.

        Raises:
            SdcError: it is none of the simulator's, or does not follow the one before, or has other
                rewards than it.
        """
        self._check(result)
        k, step = len(self._steps), result.step
        self._add_rewards(k, rewards)
        self._last_step = step
        self._steps.append(step)
        np.concatenate(self._read(result), out=self._row)
        self._values[k] = self._every_dc[:, self._every_focus]
        np.add.reduce(self._every_dc, axis=1, out=self._total[k])
        np.maximum.reduce(self._every_dc, axis=1, out=self._most[k])
        queue = self._sim.state.queue
        if not len(self._queues):
            self._queues = np.empty((len(self._values), len(self._focus), queue.shape[1]))
        self._queues[k] = queue[self._every_focus]
        self._supply_c[k] = result.unit_supply_c[self._every_unit]
        self._flow_m3s[k] = result.unit_flow_m3s[self._every_unit]
        self._add_events(result)
        if step % self._cadence.map_every == 0:
            self._add_maps(result)
        cadence = self._cadence
        if step % (cadence.hall_every_in_events if self._active else cadence.hall_every) == 0:
            self._add_halls(result)

    def take(self) -> Block:
        """The block under way; another begins. Its arrays are nobody else's."""
        k, shots = len(self._steps), len(self._map_steps)
        ages = age_histogram(self._queues[:k].reshape(-1, self._queues.shape[-1]), self._edges)
        maps = {what: shown[:shots].copy() for what, shown in self._maps.items()}
        maps["power"] *= np.float32(1e-3)
        block = Block(
            steps=np.array(self._steps, dtype=np.int64),
            values=self._values[:k].copy(),
            total=self._total[:k].copy(),
            most=self._most[:k].copy(),
            ages=ages.reshape(k, len(self._focus), -1),
            supply_c=self._supply_c[:k].copy(),
            flow_m3s=self._flow_m3s[:k].copy(),
            rewards=self._rewards[:k].copy() if self.reward_names else None,
            map_steps=np.array(self._map_steps, dtype=np.int64),
            maps=dict(maps),
            hall_steps=np.array(self._hall_steps, dtype=np.int64),
            halls=[
                {what: np.stack(shown) for what, shown in hall.items() if shown}
                for hall in self._halls
            ],
            hottest=self._hottest,
            entries=self._entries,
        )
        self._clear()
        return block

    def _check(self, result: StepResult) -> None:
        dcs, racks = len(result.it_w), len(result.rack_inlet_c)
        if dcs != self._fleet.size or racks != self._fleet.racks:
            raise SdcError(
                f"recorder: result of {dcs} data centers and {racks} racks, expected "
                f"{self._fleet.size} and {self._fleet.racks}"
            )
        if result.step != self._sim.state.step - 1:
            raise SdcError(
                f"recorder: result of step {result.step}, but the simulator has done "
                f"{self._sim.state.step} steps; add each step right after it"
            )
        if result.step <= self._last_step:
            raise SdcError(
                f"recorder: step {result.step} after step {self._last_step}; an episode has its "
                "steps in order, and begin(sim) begins another"
            )

    def _add_rewards(self, k: int, rewards: Mapping[str, F64] | None) -> None:
        names = tuple(rewards or ())
        if self.reward_names is None:
            self.reward_names = names
            self._rewards = np.empty((len(self._values), len(names), len(self._focus)))
        if names != self.reward_names:
            raise SdcError(
                f"recorder: rewards {', '.join(names) or 'none'}, expected "
                f"{', '.join(self.reward_names) or 'none'} as in the first step"
            )
        for row, values in enumerate((rewards or {}).values()):
            self._rewards[k, row] = np.asarray(values, dtype=np.float64)[self._every_focus]

    def _add_events(self, result: StepResult) -> None:
        step, fleet = result.step, self._fleet
        if self._has_events:
            active = [e for e in self._sim.active_events(step) if e.dc in self._focus]
            self._entries += failure_entries(step, self._active, active, fleet)
            self._active = active
        before, after = self._status, result.rack_status
        if (before == after).all():
            return
        self._status = after
        inlet_c: Reals | None = None
        for dc, racks in zip(self._focus, self._racks, strict=True):
            if np.array_equal(before[racks], after[racks]):
                continue
            if inlet_c is None and self._cadence.per_server:
                inlet_c = self._sim.servers().inlet_c

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
        racks, shot = self._every_rack, len(self._map_steps)
        self._map_steps.append(result.step)
        self._maps["inlet"][shot] = result.rack_inlet_c[racks]
        self._maps["outlet"][shot] = result.rack_outlet_c[racks]
        power_w = self._maps["power"][shot]
        np.add(result.rack_cpu_w[racks], result.rack_fan_w[racks], out=power_w, casting="same_kind")

    def _add_halls(self, result: StepResult) -> None:
        self._hall_steps.append(result.step)
        if self._cadence.per_server:
            servers = self._sim.servers()
            given = {"inlet": servers.inlet_c, "outlet": servers.outlet_c}
            for index, (starts, end) in enumerate(
                zip(self._zone_starts, self._server_end, strict=True)
            ):
                for what, values in given.items():
                    self._halls[index][what].append(layers.zone_peaks(values, starts, end))
        else:
            for index, racks in enumerate(self._racks):
                self._halls[index]["inlet"].append(result.rack_inlet_max_c[racks])
                self._halls[index]["outlet"].append(result.rack_outlet_c[racks])
        if self._fleet.size > 1:
            self._hottest.append(_hottest_halls(result, self._fleet, self._names))


def end_to_end(parts: Sequence[slice]) -> tuple[slice | I64, list[slice]]:
    """Several parts of an array as one, and where each is then."""
    ends = np.cumsum([0, *(part.stop - part.start for part in parts)]).tolist()
    own = [slice(first, last) for first, last in itertools.pairwise(ends)]
    if all(a.stop == b.start for a, b in itertools.pairwise(parts)):
        return slice(parts[0].start, parts[-1].stop), own
    return np.concatenate([np.arange(part.start, part.stop) for part in parts]), own


def _hottest_halls(result: StepResult, fleet: Fleet, names: Sequence[str]) -> str:
    """Markdown table of the halls with the hottest inlets."""
    hottest = result.inlet_max_c
    lines = [
        f"{int(np.count_nonzero(hottest > RECOMMENDED_C[1]))} of {fleet.size} halls have inlets "
        f"above {RECOMMENDED_C[1]:g} C",
        "",
        "| hall | hottest inlet [C] | row | rack | server from the floor |",
        "|---|---:|---:|---:|---:|",
    ]
    for dc in np.argsort(-hottest, kind="stable")[:HOTTEST]:
        rack = int(result.hottest_rack[dc])
        row = rack // fleet.configs[dc].hall.racks_per_row
        server = int(result.hottest_server[dc])
        lines.append(f"| {names[dc]} | {hottest[dc]:.2f} | {row} | {rack} | {server} |")
    return "\n".join(lines)
