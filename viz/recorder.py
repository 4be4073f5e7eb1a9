"""Recordings of a run for the Rerun viewer, written as the run goes, in blocks of steps.

Entities of a recording, NAME being a data center in focus:

    dc/NAME/map/{inlet,outlet,power}   a pixel tile per rack
    dc/NAME/hall/{inlet,outlet}        a voxel per rack and height, in 3D
    dc/NAME/series/..., crac/...       lines, an entity per unit
    dc/NAME/actions/...                what was done, as states
    dc/NAME/events                     log
    fleet/...                          sums and extremes over all data centers
    legend/..., summary                static

Timelines are ``step``, from 0 at reset, and ``sim_time``, the start of the step on the data
center's own clock (see ``year_clock.step_times``); the fleet has the clock of the first one in
focus.
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.run.description import RunRequest, describe_run
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, I64, StepResult
from sdc_taichi.year_clock import step_times

from . import hall_layers as layers
from .blueprint import Tab, blueprint
from .recording_events import Entry, Watch
from .recording_reader import Block, Cadence, Reader
from .recording_series import (
    FIELDS,
    FLEET,
    PLOTS,
    QUEUE,
    REWARDS,
    ROW,
    STATES,
    rows_and_factors,
    with_pue,
)
from .recording_static import MAX_UNIT_LINES, data_center_entities, fleet_entities
from .recording_summary import summary
from .streams import (
    Stream,
    Times,
    blobs,
    check_address,
    check_path,
    check_port,
    column,
    import_rerun,
    is_address,
    served_at,
)

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

Real = TypeVar("Real", bound=np.floating[Any])
Pictures: TypeAlias = dict[tuple[int, str], npt.NDArray[Real]]
"""By hall in focus and quantity."""

BLOCK_STEPS, BLOCK_BYTES = 1_024, 16_000_000
"""A block has as many steps as either allows: each costs some kB per entity on top of its values,
and what it holds is in memory until it is written."""
MAX_FOCUS, DEFAULT_FOCUS = 4, 2
"""Data centers in full that may be asked for, and those that are taken unasked."""
EVERY_H = ((200, 0.0), (2_000, 1.0), (20_000, 3.0))
"""Racks in focus up to which heat maps are that many hours apart, 0 being every step."""
LARGEST_EVERY_H = 6.0
HALL_H, HALL_IN_EVENTS_H = 3.0, 1.0
"""Hours between two shots of the 3D hall, at the least: they need a pass over all servers."""
ZONES, LARGE_ZONES = 10, 5
"""Heights of the 3D hall at which a rack shows its servers, in small and in larger halls."""
SERVER_LAYERS_UP_TO = 100_000
"""Servers of the fleet beyond which a rack of the 3D hall has a single value."""
LIVE_S, FILE_S = 1.0, 60.0
"""A block ends after so long, whatever it holds, if somebody may watch and if nobody does."""
ROOM_BYTES, ROOM_PER_VALUE, ROOM_PER_DC = 8_000_000, 8, 20_000
"""What a recording leaves free for the files of its run: something, each value, each config."""
_NO_SIGN = 2
"""Of an action before the first step."""


class Recorder:
    """Writes step results to a Rerun recording, or to a viewer that shows them at once.

    A file has its name from the first block on, and holds every whole block whatever ends the run;
    ``close`` adds the index that readers find their way by. Once it cannot go on (a full disk, a
    viewer that was closed) there is one ``RecordingWarning``, and further steps are ignored.

    Args:
        path_or_address: file to write, ending in .rrd, or the address of a running viewer such as
            rerun+http://127.0.0.1:9876/proxy; None with ``serve_port`` alone.
        focus: names of up to 4 data centers to record in full; None is the first 2. The others
            count in the fleet series. Where names are not distinct, NAME#INDEX tells them apart.
        every: steps between two heat maps, and between two shots of the 3D hall; None follows the
            number of racks in focus. Series always have every step.
        serve_port: also let viewers connect to this port of 127.0.0.1; 0 picks a free one.

    Raises:
        SdcError: rerun-sdk is missing, or an argument is not valid.
    """

    def __init__(
        self,
        path_or_address: str | os.PathLike[str] | None,
        *,
        focus: Sequence[str] | None = None,
        every: int | None = None,
        serve_port: int | None = None,
    ) -> None:
        import_rerun()
        self._file: Path | None = None
        self._address: str | None = None
        if path_or_address is None:
            if serve_port is None:
                raise SdcError("recorder: neither a file, an address nor a port to serve is given")
        elif is_address(path_or_address):
            self._address = check_address(path_or_address)
        else:
            self._file = check_path(path_or_address)
        if self._address is not None and serve_port is not None:
            raise SdcError(f"recorder: {self._address} and a port to serve; valid is one of them")
        self._port = None if serve_port is None else check_port(serve_port)
        self._focus = None if focus is None else _check_focus(focus)
        whole = isinstance(every, int) and not isinstance(every, bool)
        if every is not None and not (whole and every > 0):
            raise SdcError(f"every {every!r}: valid is a positive integer")
        self._every = every
        self._episodes = 0
        self._episode: _Episode | None = None

    @property
    def file(self) -> Path | None:
        """File of the present episode, or of the last one."""
        if self._file is None or self._episodes < 2:
            return self._file
        return self._file.with_name(f"{self._file.stem}-{self._episodes}{self._file.suffix}")

    @property
    def served(self) -> str | None:
        """Address that viewers connect to, if there is one."""
        return None if self._port is None else served_at(self._port)

    @property
    def lost(self) -> bool:
        """Whether the present episode could not be recorded to here; there was a warning."""
        return self._episode is not None and self._episode.lost

    def begin(self, sim: Simulator, about: Mapping[str, Any] | None = None) -> None:
        """Begin to record an episode of a simulator, before its first step.

        An episode under way is closed. The first is written to the file that was named, the next to
        NAME-2.rrd and so on; nothing is written before there is a step.

        Args:
            sim: its steps are those that ``add`` is given.
            about: what ``describe_run`` says of the run; None is what the simulator knows.

        Raises:
            SdcError: a name in focus that there is not, a file that cannot be written, or too
                little room on its disk.
        """
        self.close()
        self._episodes += 1
        described = describe_run(sim, RunRequest("", 0)) if about is None else about
        if about is None:
            described = {k: v for k, v in described.items() if k not in ("controller", "seed")}
        fleet = sim.fleet
        values = int(described.get("steps_asked", 0)) * fleet.size * len(fields(StepResult))
        stream = Stream(
            file=self.file,
            address=self._address,
            port=self._port,
            name=self.file.stem if self.file is not None else "sdc-taichi",
            keep_bytes=ROOM_BYTES + ROOM_PER_VALUE * values + ROOM_PER_DC * fleet.size,
        )
        try:
            self._episode = _Episode(sim, described, stream, self._focus, self._every)
        except BaseException:
            self._episodes -= 1
            raise

    def add(self, result: StepResult, *, rewards: Mapping[str, F64] | None = None) -> None:
        """Add a step, right after it was done.

        Args:
            result: the step.
            rewards: reward terms by name, each (B,); of every step or of none.

        Raises:
            SdcError: there is no episode, or the step is none of its simulator's, or does not
                follow the step before.
        """
        if self._episode is None:
            raise SdcError("recorder: begin(sim) comes before the first step")
        self._episode.add(result, rewards)

    def flush(self) -> None:
        """Write the steps that wait for their block to be full."""
        if self._episode is not None:
            self._episode.flush()

    def close(self) -> None:
        """Write what is left; closing again does nothing."""
        episode, self._episode = self._episode, None
        if episode is None:
            return
        episode.close()
        if episode.steps_added == 0:
            self._episodes -= 1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Episode:
    """One recording."""

    def __init__(
        self,
        sim: Simulator,
        about: Mapping[str, Any],
        stream: Stream,
        focus: Sequence[str] | None,
        every: int | None,
    ) -> None:
        fleet = sim.fleet
        self._fleet, self._about, self._stream = fleet, about, stream
        self._names = distinct(fleet.names)
        self._focus = _in_focus(self._names, focus)
        self._start = sim.drivers.start[self._focus]
        self._cadence = _cadence(fleet, self._focus, every)
        self._reader = Reader(sim, self._names, self._focus, self._cadence)
        self._plots = {e: rows_and_factors(plot, sim.step_h) for e, plot in PLOTS.items()}
        self._scales = {what: layers.temperature_scale(what) for what in layers.LIMITS_C}
        self._scales["power"] = layers.power_scale(fleet)
        self._tiles = [layers.tiles(fleet.configs[dc].hall) for dc in self._focus]
        self._watches = [Watch(fleet, dc) for dc in self._focus]
        self._states: dict[tuple[int, str], int] = {}
        self.steps_added = 0
        self._limit_s = LIVE_S if stream.live else FILE_S
        # The first step of a live recording is shown at once.
        self._written = time.monotonic() - (self._limit_s if stream.live else 0.0)

    def add(self, result: StepResult, rewards: Mapping[str, F64] | None) -> None:
        """Read a step, and write the block that it fills."""
        if self._stream.lost:
            return
        self._reader.add(result, rewards)
        self.steps_added += 1
        late = time.monotonic() - self._written > self._limit_s
        if late or self._reader.held == self._cadence.block_steps:
            self._write()

    @property
    def lost(self) -> bool:
        """Whether the stream has ended early."""
        return self._stream.lost

    def flush(self) -> None:
        """Write what is left."""
        if self._reader.held and not self._stream.lost:
            self._write()

    def close(self) -> None:
        """Write what is left, and the index."""
        self.flush()
        self._stream.close()

    def _write(self) -> None:
        """Write the block that was read."""
        self._written = time.monotonic()
        block = self._reader.take()
        values = with_pue(block.values)
        for index, watch in enumerate(self._watches):
            block.entries.extend(watch.look(block.steps, values[:, :, index]))
        images, cells = self._images(block), self._cells(block)
        size_bytes = 2 * values.nbytes + sum(image.nbytes for image in images.values())
        if not self._stream.room_for(size_bytes + sum(part.nbytes for part in cells.values())):
            return
        if not self._stream.started:
            self._open()
        every_step, map_steps, hall_steps = map(
            self._clock, (block.steps, block.map_steps, block.hall_steps)
        )
        self._send_fleet(block, every_step[0], hall_steps[0])
        for index, dc in enumerate(self._focus):
            path, own = self._path(dc), values[:, :, index]
            self._send_lines(block, index, path, every_step[index], own)
            self._send_states(index, path, block.steps, own)
            self._send_log(index, path, [e for e in block.entries if e.dc == dc])
            self._send_pictures(index, path, images, map_steps[index], cells, hall_steps[index])
        self._stream.end_block()

    def _send_fleet(self, block: Block, every_step: list[Times], hall_steps: list[Times]) -> None:
        import rerun as rr

        for entity, line in FLEET.items():
            self._lines(f"fleet/{entity}", every_step, line.value(block.fleet)[:, None])
        if block.hottest:
            kinds = ["text/markdown"] * len(block.hottest)
            tables = rr.TextDocument.columns(text=block.hottest, media_type=kinds)
            self._stream.columns("fleet/hottest", hall_steps, tables)

    def _send_lines(
        self, block: Block, index: int, path: str, times: list[Times], values: F64
    ) -> None:
        for entity, (rows, factors) in self._plots.items():
            self._lines(f"{path}/series/{entity}", times, values[:, rows] * factors)
        self._lines(f"{path}/series/{QUEUE}", times, block.ages[:, index])
        if block.rewards is not None:
            self._lines(f"{path}/series/{REWARDS}", times, block.rewards[:, :, index])
        units = self._reader.units[index]
        supply_c, flow_m3s = block.supply_c[:, units], block.flow_m3s[:, units]
        if units.stop - units.start > MAX_UNIT_LINES:
            supply_c, flow_m3s = _range(supply_c), _range(flow_m3s)
        air_c = np.concatenate([supply_c, values[:, ROW["return_c"], None]], axis=1)
        self._lines(f"{path}/crac/temperature_c", times, air_c)
        self._lines(f"{path}/crac/airflow_m3s", times, flow_m3s)

    def _lines(self, entity: str, times: list[Times], values: F64) -> None:
        import rerun as rr

        self._stream.columns(entity, times, [column(rr.Scalars.descriptor_scalars(), values)])

    def _send_states(self, index: int, path: str, steps: I64, values: F64) -> None:
        """Actions of a data center where they change."""
        import rerun as rr

        for entity, (command, names) in STATES.items():
            signs = np.sign(values[:, ROW[command]]).astype(np.int64)
            before = np.append(self._states.get((index, entity), _NO_SIGN), signs[:-1])
            changed = np.flatnonzero(signs != before)
            self._states[index, entity] = int(signs[-1])
            if len(changed):
                states = [names[sign + 1] for sign in signs[changed]]
                times = self._clock(steps[changed])[index]
                entity_path = f"{path}/actions/{entity}"
                self._stream.columns(entity_path, times, rr.StateChange.columns(state=states))

    def _send_log(self, index: int, path: str, entries: list[Entry]) -> None:
        import rerun as rr

        if not entries:
            return
        entries.sort(key=lambda entry: entry.step)
        steps = np.array([entry.step for entry in entries])
        # Day and time of day are in the text, for which the viewer's column of times is too narrow.
        clock = np.datetime_as_string(self._when(steps)[:, index], "m").tolist()
        log = rr.TextLog.columns(
            text=[f"{at[5:10]} {at[11:]} {e.text}" for at, e in zip(clock, entries, strict=True)],
            level=[entry.level for entry in entries],
        )
        self._stream.columns(f"{path}/events", self._clock(steps)[index], log)

    def _send_pictures(
        self,
        index: int,
        path: str,
        images: Pictures[np.float16],
        map_steps: list[Times],
        cells: Pictures[np.float32],
        hall_steps: list[Times],
    ) -> None:
        import rerun as rr

        buffer, values = rr.DepthImage.descriptor_buffer(), rr.VoxelGridMap.descriptor_values()
        for what in self._scales:
            if (index, what) in images:
                shots = images[index, what]
                shown = blobs(buffer, shots.reshape(len(shots), -1))
                self._stream.columns(f"{path}/map/{what}", map_steps, [shown])
            if (index, what) in cells:
                shown = column(values, cells[index, what])
                self._stream.columns(f"{path}/hall/{what}", hall_steps, [shown])

    def _images(self, block: Block) -> Pictures[np.float16]:
        """Heat maps, (M, height, width), by hall and quantity."""
        if not len(block.map_steps):
            return {}
        return {
            (index, what): layers.pixels(shots[:, racks], self._tiles[index], self._scales[what])
            for index, racks in enumerate(self._reader.racks)
            for what, shots in block.maps.items()
        }

    def _cells(self, block: Block) -> Pictures[np.float32]:
        """Voxels, (H, racks zones), by hall and quantity."""
        return {
            (index, what): layers.quantised(shots[:, cells], self._scales[what])
            for index, cells in enumerate(self._reader.cells)
            for what, shots in block.halls.items()
        }

    def _when(self, steps: I64) -> npt.NDArray[np.datetime64]:
        """Clock of each data center in focus, (T, n)."""
        return step_times(self._start, steps, self._fleet.steps_per_hour)

    def _clock(self, steps: I64) -> list[list[Times]]:
        """Both timelines for each data center in focus."""
        step = Times("step", steps)
        own = self._when(steps).astype("datetime64[ns]").T
        return [[step, Times("sim_time", times)] for times in own]

    def _path(self, dc: int) -> str:
        import rerun as rr

        return f"dc/{rr.escape_entity_path_part(self._names[dc])}"

    def _open(self) -> None:
        """Open the stream and send what holds at all times."""
        import rerun as rr

        tabs = []
        for dc, shape in zip(self._focus, self._tiles, strict=True):
            hall = self._fleet.configs[dc].hall
            plan = floor_plan(hall)
            size_m = plan.length_m, plan.width_m, hall.layout.ceiling_m
            tabs.append(Tab(self._names[dc], self._path(dc), size_m, self._scales, shape.image))
        rewards = self._reader.reward_names or ()
        self._stream.start(blueprint(tabs, hottest=self._fleet.size > 1, rewards=bool(rewards)))
        names = {dc: self._names[dc] for dc in self._focus}
        text = summary(self._about, self._fleet, names, self._scales, self._cadence)
        self._stream.static("summary", rr.TextDocument(text, media_type="text/markdown"))
        for entity, what in fleet_entities(self._scales):
            self._stream.static(entity, what)
        for dc, zones in zip(self._focus, self._cadence.zones, strict=True):
            for entity, what in data_center_entities(
                self._fleet, dc, self._path(dc), self._scales, zones, rewards
            ):
                self._stream.static(entity, what)


def _cadence(fleet: Fleet, focus: Sequence[int], every: int | None) -> Cadence:
    """Defaults by the size of the halls in focus."""
    racks = int(np.diff(fleet.rack_offsets)[focus].sum())
    map_every = every or max(1, round(_every_h(racks) * fleet.steps_per_hour))
    per_server = fleet.servers <= SERVER_LAYERS_UP_TO
    most = ZONES if racks <= layers.SMALL_RACKS else LARGE_ZONES
    fewest = [_fewest_servers(fleet, dc) for dc in focus]
    hall_every = every or max(map_every, round(HALL_H * fleet.steps_per_hour))
    zones = tuple(min(most, servers) if per_server else 1 for servers in fewest)
    return Cadence(
        map_every=map_every,
        hall_every=hall_every,
        hall_every_in_events=every
        or max(map_every, round(HALL_IN_EVENTS_H * fleet.steps_per_hour)),
        zones=zones,
        per_server=per_server,
        block_steps=_block_steps(fleet, focus, map_every, hall_every, zones, per_server),
    )


def _block_steps(
    fleet: Fleet,
    focus: Sequence[int],
    map_every: int,
    hall_every: int,
    zones: Sequence[int],
    per_server: bool,
) -> int:
    """Steps whose values and pictures fill a block."""
    halls = [fleet.configs[dc].hall for dc in focus]
    pixels = sum(math.prod(layers.tiles(hall).image) for hall in halls)
    cells = sum(hall.racks * heights for hall, heights in zip(halls, zones, strict=True))
    if per_server:
        cells += int(np.diff(fleet.group_offsets[fleet.rack_offsets])[focus].sum())
    step_bytes: float = 8 * len(FIELDS) * (len(focus) + 2)
    step_bytes += 2 * len(layers.COLOURMAPS) * pixels / map_every
    step_bytes += 4 * len(layers.LIMITS_C) * cells / hall_every
    return min(BLOCK_STEPS, max(1, int(BLOCK_BYTES / step_bytes)))


def _fewest_servers(fleet: Fleet, dc: int) -> int:
    """Servers of the smallest rack of a data center."""
    first, last = fleet.rack_offsets[dc : dc + 2]
    return int(np.diff(fleet.server_offsets[fleet.group_offsets[first : last + 1]]).min())


def _range(units: F64) -> F64:
    """Lowest, mean and highest of the units, (T, 3)."""
    return np.stack([units.min(axis=1), units.mean(axis=1), units.max(axis=1)], axis=1)


def distinct(names: Sequence[str]) -> tuple[str, ...]:
    """Names, with their index where they are not distinct."""
    counts = Counter(names)
    return tuple(n if counts[n] == 1 else f"{n}#{i}" for i, n in enumerate(names))


def _check_focus(focus: Sequence[str]) -> tuple[str, ...]:
    names = (focus,) if isinstance(focus, str) else focus
    listed = isinstance(names, Sequence) and all(isinstance(name, str) for name in names)
    if not (listed and 0 < len(names) <= MAX_FOCUS and len(set(names)) == len(names)):
        raise SdcError(f"focus {focus!r}: valid are 1 to {MAX_FOCUS} different names")
    return tuple(names)


def _in_focus(names: Sequence[str], focus: Sequence[str] | None) -> list[int]:
    if focus is None:
        return list(range(min(len(names), DEFAULT_FOCUS)))
    for name in focus:
        if name not in names:
            shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
            raise SdcError(f"focus {name!r}: no such data center; valid: {shown}")
    return [names.index(name) for name in focus]


def _every_h(racks: int) -> float:
    """Hours between two heat maps of so many racks."""
    return next((hours for most, hours in EVERY_H if racks <= most), LARGEST_EVERY_H)
