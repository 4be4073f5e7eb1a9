"""Writer that turns the blocks of one recording into entities of the Rerun viewer.

A recording has these entities, where NAME is the name of a data center in focus:

    dc/NAME/map/{inlet,outlet,...}     heat maps, a tile per rack
    dc/NAME/map/{hottest,down,crac}    marks on the maps: hottest rack, CRAC units
    dc/NAME/racks/..., row/...         trends of racks, and the hottest row by time
    dc/NAME/state/racks                states of racks
    dc/NAME/airflow/...                share map of CRAC units, and sources of exhaust
    dc/NAME/zones/..., zone_racks/...  zones of a large hall, and the racks of each zone
    dc/NAME/hall/{inlet,outlet}        3D hall, a voxel per rack and level
    dc/NAME/series/..., crac/...       series, each entity with lines of one unit
    dc/NAME/liquid/...                 loops and CDUs of liquid-cooled racks
    dc/NAME/actions/...                commands, as states
    dc/NAME/events                     log of events
    flows/...                          work that sites of a fleet send to each other
    fleet/...                          sums and maxima over all data centers
    dc/NAME/legend/...                 static colour bars of the maps
    summary                            static text

Its timelines are ``step``, counted from 0 at reset, and ``sim_time``, the start of the step on the
clock of the data center (see ``Drivers.times``). Entities of the fleet use the clock of
the first data center in focus.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import rerun as rr

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.air_metrics import allowable_c, rank
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.types import F64, I64, Reals, StepResult

from . import colour_scales
from . import hall_rasters as rasters
from .colour_scales import ColourScale, InletRange
from .liquid_loop import junction_limits_c
from .rack_histories import RackHistory
from .recording_airflow import AirflowPictures
from .recording_blocks import MAX_BLOCK_BYTES, Block, BlockBuilder, choose_cadence
from .recording_flows import FlowPictures
from .recording_frames import Pictures
from .recording_liquid import LiquidPictures
from .recording_output import RecordingOutput
from .recording_racks import (
    TRENDS,
    HottestRow,
    check_selection,
    down_boxes,
    down_columns,
    down_texts,
    mark_columns,
    mark_texts,
    trend_lines,
    unit_pixels,
)
from .recording_series import (
    COMMAND_STATES,
    FIELD_ROWS,
    FLEET_PLOTS,
    PLOTS,
    QUEUE_ENTITY,
    REWARDS_ENTITY,
    Cadence,
    line_factors,
    low_mean_high,
)
from .recording_states import StatePictures
from .recording_text import ConditionLog, LogEntry, summary_markdown
from .recording_views import (
    FocusTab,
    data_center_entities,
    fleet_entities,
    make_blueprint,
    scale_entities,
)
from .recording_zones import MIN_RACKS, ZonePictures

if TYPE_CHECKING:
    from sdc_taichi.hall.rack_selection import RackSelection
    from sdc_taichi.sim.simulator import Simulator

    from .recording_reference import Reference

LIVE_BLOCK_S, FILE_BLOCK_S = 1.0, 60.0
"""Longest time between two blocks, in s of real time: of a live recording, and of a file."""
MOMENT_ENTITY = "moment"
"""Entity with the time that a viewer shows first, as text."""
_MEANS_OF_MAPS = {"inlet": "inlet_mean_c", "outlet": "outlet_mean_c", "rise": "inlet_mean_c"}
_NO_COMMAND = 2
"""Placeholder for the sign of a command before the first step; differs from -1, 0 and 1."""


class RecordingWriter:
    """Writes one recording, block by block.

    Args:
        sim: the simulator, before its first step.
        names: names of the data centers of the simulator in the recording.
        focus: indices of the data centers in focus.
        description: result of ``describe_run``, or a part of it.
        output: destination of the recording.
        every_steps: interval of heat maps and of frames of the 3D hall, in steps; None derives it
            from the number of racks in focus.
        inlet_range: range of the colours of inlets, see ``colour_scales.inlet_scale``.
        racks: racks whose trends are recorded; None records the default ones.
        reference: reference of the difference of inlets; None is the state before an event.

    Raises:
        ConfigError: a hall does not have the racks, or they are too many.
    """

    def __init__(
        self,
        sim: Simulator,
        names: Sequence[str],
        focus: Sequence[int],
        description: Mapping[str, Any],
        output: RecordingOutput,
        *,
        every_steps: int | None = None,
        inlet_range: InletRange = None,
        racks: RackSelection | None = None,
        reference: Reference | None = None,
    ) -> None:
        fleet = sim.fleet
        self._selections = [
            check_selection(racks, fleet.configs[dc].hall, names[dc]) for dc in focus
        ]
        self._histories = [RackHistory(fleet, dc) for dc in focus]
        self._map_steps: list[int] = []
        self._difference_counts: dict[str, I64] = {
            quantity: np.zeros(colour_scales.MAX_CLASSES + 1, np.int64)
            for quantity in ("rise", "change")
        }
        """Number of values of every class in the maps of differences."""
        self._first_step = 0
        self._hottest_c: list[F64] = []
        """Hottest inlet of each data center in focus, in C, (T, n) of each block."""
        self._fleet, self._description, self._output = fleet, description, output
        self._names, self._focus = names, focus
        self._drivers = sim.drivers.take(focus)
        self._cadence = choose_cadence(fleet, focus, every_steps)
        self._builder = BlockBuilder(sim, focus, self._cadence, reference)
        self._reference_name = "before the event"
        if reference is not None:
            self._reference_name = f"of {reference.name}"
        self._rows_and_factors = {
            entity: ([FIELD_ROWS[f] for _, f, _ in plot.lines], line_factors(plot, sim.step_h))
            for entity, plot in PLOTS.items()
        }
        self._inlet_range = inlet_range
        self._scales: list[dict[str, ColourScale]] = []
        self._tile_grids = [rasters.tile_grid(fleet.configs[dc].hall) for dc in focus]
        units = np.diff(fleet.unit_offsets)
        self._unit_pixels = [
            unit_pixels(fleet.configs[dc].hall, int(units[dc]), grid)
            for dc, grid in zip(focus, self._tile_grids, strict=True)
        ]
        self._condition_logs = [ConditionLog(fleet, dc) for dc in focus]
        self._pictures = [list(_pictures_of(sim, dc, self._cadence)) for dc in focus]
        self._flows: FlowPictures | None = None
        if fleet.shared_work is not None:
            self._flows = FlowPictures(sim, names, focus[0])
        self._last_signs: dict[tuple[int, str], int] = {}
        self.steps_added = 0
        """Number of steps added to the recording."""
        self._block_s = LIVE_BLOCK_S if output.is_live else FILE_BLOCK_S
        # A viewer shows the first step at once: its block counts as late from the beginning.
        self._written_at_s = time.monotonic() - (self._block_s if output.is_live else 0.0)

    @property
    def failed(self) -> bool:
        """True if the recording has ended early."""
        return self._output.failed

    def add(self, result: StepResult, rewards: Mapping[str, F64] | None) -> None:
        """Add a step, and write the current block if it is full or late.

        Args:
            result: result of the step.
            rewards: reward terms by name, (B,) each; None if there are none.

        Raises:
            SdcError: the step does not follow the previous one, or the rewards are not valid.
        """
        if self.failed:
            return
        self._builder.add(result, rewards)
        for history in self._histories:
            history.add(result)
        for dc, pictures in zip(self._focus, self._pictures, strict=True):
            active = self._builder.active_events(dc)
            for picture in pictures:
                picture.add(result, active)
        if self._flows is not None:
            self._flows.add(result)
        self.steps_added += 1
        is_late = time.monotonic() - self._written_at_s > self._block_s
        if is_late or self._builder.is_full or self._picture_bytes > MAX_BLOCK_BYTES:
            self._write_block()

    @property
    def _picture_bytes(self) -> int:
        """Size of the pictures of the current block other than heat maps, in bytes."""
        pictures = itertools.chain.from_iterable(self._pictures)
        flows_bytes = 0 if self._flows is None else self._flows.size_bytes
        return flows_bytes + sum(picture.size_bytes for picture in pictures)

    def flush(self) -> None:
        """Write the steps of the current, incomplete block, and what is known of their racks."""
        if self._builder.steps and not self.failed:
            self._write_block()
            self._write_racks()

    def close(self) -> None:
        """Write the remaining steps, and the index of the file."""
        try:
            self.flush()
        finally:
            self._output.close()

    def _write_block(self) -> None:
        """Write the current block, and begin a new one."""
        self._written_at_s = time.monotonic()
        block = self._builder.take()
        for index, log in enumerate(self._condition_logs):
            block.entries.extend(log.entries(block.steps, block.values[:, :, index]))
        if not self._output.has_room_for(block.size_bytes + self._picture_bytes):
            return
        if not self._output.is_open:
            self._first_step = int(block.steps[0])
            self._scales = [self._scales_of(block, index) for index in range(len(self._focus))]
            self._open()
        times, map_times, hall_times = map(
            self._times, (block.steps, block.map_steps, block.hall_steps)
        )
        self._write_fleet(block, times[0])
        if self._flows is not None:
            for entity, steps, columns in self._flows.take():
                self._output.add_columns(entity, self._times(steps)[0], columns)
        for index, dc in enumerate(self._focus):
            path, values = self._path(dc), block.values[:, :, index]
            self._write_lines(block, index, path, times[index], values)
            self._write_states(index, path, block.steps, values)
            self._write_log(index, path, [e for e in block.entries if e.dc == dc])
            self._write_frames(block, index, path, map_times[index], hall_times[index])
            for picture in self._pictures[index]:
                for entity, steps, columns in picture.take(self._scales[index]):
                    frame_times = self._times(steps)[index]
                    self._output.add_columns(f"{path}/{entity}", frame_times, columns)
            self._write_down(index, path, [(at, units) for at, of, units in block.down if of == dc])
        self._map_steps += block.map_steps.tolist()
        self._hottest_c.append(block.values[:, FIELD_ROWS["inlet_max_c"]])
        self._output.send_block()

    def _write_racks(self) -> None:
        """Write the trends of racks and the hottest row of each hall, and the moment to show."""
        if not self._output.is_open:
            return
        for index, (dc, history) in enumerate(zip(self._focus, self._histories, strict=True)):
            hall, path = self._fleet.configs[dc].hall, self._path(dc)
            peak_c = history.peak_inlet_c()
            racks = self._selections[index].racks(hall, peak_c)
            values = history.of_racks(racks)
            times = self._times(values.steps)[index]
            lines = trend_lines(racks.tolist(), peak_c, hall.racks_per_row)
            for entity in TRENDS:
                self._output.send_static([(f"{path}/racks/{entity}", lines)])
                self._write_scalars(f"{path}/racks/{entity}", times, getattr(values, entity))
            row = HottestRow(f"{path}/row", history, hall, self._scales[index]["inlet"])
            self._output.send_static(row.entities(self._clock_texts(values.steps, index)))
            if self._map_steps:
                steps = np.array(self._map_steps)
                cursor = row.cursor_columns(steps)
                self._output.add_columns(f"{path}/row/cursor", self._times(steps)[index], cursor)
        for quantity, counts in self._difference_counts.items():
            self._fit_colours(quantity, counts)
        self._write_moment()
        self._output.send_block()

    def _fit_colours(self, quantity: str, counts: I64) -> None:
        """Fit the colours of a map of differences to the differences of the run so far."""
        for index, dc in enumerate(self._focus):
            if quantity in self._scales[index]:
                before = self._scales[index][quantity]
                largest_k = colour_scales.largest_difference_k(counts, before)
                scale = colour_scales.difference_scale(largest_k, before.resolution)
                self._scales[index][quantity] = scale
                self._output.send_static(scale_entities(self._path(dc), quantity, scale))

    def _write_moment(self) -> None:
        """Write the time that a viewer shows first, and the maps of that time."""
        hottest_c = rank(np.concatenate(self._hottest_c))
        first, begin, end = self._first_step, 0, len(hottest_c)
        event = self._builder.first_event
        if event is not None:
            begin, end = max(0, event.start_step - first), min(end, event.end_step - first)
        step = first + begin + int(hottest_c[begin:end].max(axis=1).argmax())
        if step not in self._map_steps:
            self._write_maps_at(step)
        moment = str(self._clock(np.array([step]))[0, 0].astype("datetime64[s]"))
        self._output.send_static([(MOMENT_ENTITY, rr.TextDocument(moment))])

    def _write_marks(
        self,
        path: str,
        times: list[rr.TimeColumn],
        inlet_c: Reals,
        hall: HallConfig,
        grid: rasters.TileGrid,
    ) -> None:
        """Write the marks of the hottest rack in M maps.

        Args:
            path: path of the data center's entities.
            times: time columns of the maps.
            inlet_c: inlet of each rack, in C, (M, R).
            hall: the hall.
            grid: geometry of the tiles of the maps.
        """
        outline, texts = mark_columns(inlet_c, hall, grid), mark_texts(inlet_c, hall)
        self._output.add_columns(f"{path}/map/hottest", times, outline)
        self._output.add_columns(f"{path}/map/hottest_text", times, texts)

    def _write_maps_at(self, step: int) -> None:
        """Write the heat maps of the inlets of a step, from the histories of the racks."""
        for index, (dc, history) in enumerate(zip(self._focus, self._histories, strict=True)):
            inlet_c = history.inlet_c(step)
            if inlet_c is None:
                continue
            path, times = self._path(dc), self._times(np.array([step]))[index]
            self._write_map(f"{path}/map/inlet", times, inlet_c[None], index, "inlet")
            hall = self._fleet.configs[dc].hall
            self._write_marks(path, times, inlet_c[None], hall, self._tile_grids[index])
            reference_c = self._builder.reference_c(step)
            if reference_c is not None:
                change_k = inlet_c - reference_c[self._builder.racks[index]]
                self._write_map(f"{path}/map/change", times, change_k[None], index, "change")

    def _write_down(
        self, index: int, path: str, changes: list[tuple[int, tuple[int, ...]]]
    ) -> None:
        """Write the marks of the CRAC units of a data center that are down, where they change."""
        if not changes:
            return
        steps = np.array([step for step, _ in changes])
        down = [units for _, units in changes]
        columns = down_columns(down, self._unit_pixels[index])
        times = self._times(steps)[index]
        self._output.add_columns(f"{path}/map/down", times, columns)
        hall = self._fleet.configs[self._focus[index]].hall
        boxes = down_boxes(down, hall, len(self._unit_pixels[index]))
        self._output.add_columns(f"{path}/hall/down", times, boxes)
        texts = down_texts(down)
        self._output.add_columns(f"{path}/map/down_text", times, texts)

    def _open(self) -> None:
        """Open the output and send the static entities."""
        tabs = []
        for index, (dc, grid) in enumerate(zip(self._focus, self._tile_grids, strict=True)):
            hall = self._fleet.configs[dc].hall
            plan = floor_plan(hall)
            size_m = plan.length_m, plan.width_m, hall.layout.ceiling_m
            name, path = self._names[dc], self._path(dc)
            zones = [p.shapes for p in self._pictures[index] if isinstance(p, ZonePictures)]
            has_airflow = any(isinstance(p, AirflowPictures) for p in self._pictures[index])
            scales_of_dc = self._scales[index]
            tabs.append(
                FocusTab(
                    name,
                    self._reference_name,
                    path,
                    size_m,
                    scales_of_dc,
                    grid.image_shape,
                    has_airflow,
                    self._fleet.configs[dc].liquid is not None,
                    sum(zones, ()),
                )
            )
        rewards = self._builder.reward_names or ()
        self._output.open(make_blueprint(tabs, has_rewards=bool(rewards), flows=self._flows))
        names = {dc: self._names[dc] for dc in self._focus}
        scales = dict(zip(self._focus, self._scales, strict=True))
        text = summary_markdown(
            self._description, self._fleet, names, scales, self._cadence, self._reference_name
        )
        summary = rr.TextDocument(text, media_type="text/markdown")
        self._output.send_static([("summary", summary), *fleet_entities()])
        if self._flows is not None:
            self._output.send_static(self._flows.entities())
        for dc, levels in zip(self._focus, self._cadence.levels, strict=True):
            path = self._path(dc)
            self._output.send_static(
                data_center_entities(self._fleet, dc, path, scales[dc], levels, rewards)
            )
        for index, dc in enumerate(self._focus):
            for picture in self._pictures[index]:
                self._output.send_static(
                    (f"{self._path(dc)}/{entity}", component)
                    for entity, component in picture.entities(self._scales[index])
                )

    def _scales_of(self, block: Block, index: int) -> dict[str, ColourScale]:
        """Return the colour scales of the maps of a data center, from the first block.

        Ranges are those of all data centers in focus, so that their maps compare.

        Args:
            block: the first block.
            index: index of the data center among those in focus.
        """
        classes = [self._fleet.configs[dc].protection.ashrae_class for dc in self._focus]
        limits_c = [allowable_c(name)[1] for name in classes]
        first = block.maps or {
            quantity: block.values[:, FIELD_ROWS[field]]
            for quantity, field in _MEANS_OF_MAPS.items()
        }
        inlets = colour_scales.inlet_scale(
            self._inlet_range, first["inlet"], (limits_c[index], max(limits_c))
        )
        rise_k = float(np.percentile(np.abs(first["rise"]), 99.9))
        resolution_k = 0.1 if rise_k < 9.0 else 0.5
        scales = {
            "inlet": inlets,
            "rise": colour_scales.difference_scale(rise_k, resolution_k),
            "outlet": colour_scales.outlet_scale(self._inlet_range, first["outlet"]),
            "power": colour_scales.power_scale(self._fleet),
        }
        limits = junction_limits_c(self._fleet.configs[self._focus[index]])
        if limits is not None:
            scales["junction"] = colour_scales.junction_scale(*limits)
        if self._builder.has_reference:
            scales["change"] = colour_scales.difference_scale(5.0)
        return scales

    def _write_fleet(self, block: Block, times: list[rr.TimeColumn]) -> None:
        """Write the series of the whole fleet."""
        for entity, plot in FLEET_PLOTS.items():
            values = plot.factor * np.sum([block.fleet[field] for field in plot.fields], axis=0)
            self._write_scalars(f"fleet/{entity}", times, values[:, None])

    def _write_lines(
        self, block: Block, index: int, path: str, times: list[rr.TimeColumn], values: F64
    ) -> None:
        """Write the series of a data center: plots, queue, rewards and CRAC units.

        Args:
            block: the block.
            index: index of the data center among those in focus.
            path: path of the data center's entities.
            times: time columns of the T steps.
            values: values of ``FIELDS`` and PUE, (T, F).
        """
        for entity, (rows, factors) in self._rows_and_factors.items():
            self._write_scalars(f"{path}/series/{entity}", times, values[:, rows] * factors)
        queue = block.queue_by_age[:, index]
        self._write_scalars(f"{path}/series/{QUEUE_ENTITY}", times, queue)
        if block.rewards is not None:
            terms = block.rewards[:, :, index]
            self._write_scalars(f"{path}/series/{REWARDS_ENTITY}", times, terms)
        units = self._builder.units[index]
        supply_c, flow_m3s = block.unit_supply_c[:, units], block.unit_flow_m3s[:, units]
        supply_c, flow_m3s = low_mean_high(supply_c), low_mean_high(flow_m3s)
        air_c = np.concatenate([supply_c, values[:, FIELD_ROWS["return_c"], None]], axis=1)
        self._write_scalars(f"{path}/crac/temperature_c", times, air_c)
        self._write_scalars(f"{path}/crac/airflow_m3s", times, flow_m3s)

    def _write_scalars(self, entity: str, times: list[rr.TimeColumn], values: F64) -> None:
        """Write the lines of an entity.

        Args:
            entity: path of the entity.
            times: time columns of the T steps.
            values: values of the lines, (T, lines).
        """
        self._output.add_columns(entity, times, rr.Scalars.columns(scalars=values))

    def _write_states(self, index: int, path: str, steps: I64, values: F64) -> None:
        """Write the commands of a data center as states, at the steps where their sign changes.

        Args:
            index: index of the data center among those in focus.
            path: path of the data center's entities.
            steps: steps of the block, (T,).
            values: values of ``FIELDS`` and PUE, (T, F).
        """
        for entity, (command, names) in COMMAND_STATES.items():
            signs = np.sign(values[:, FIELD_ROWS[command]]).astype(np.int64)
            before = np.append(self._last_signs.get((index, entity), _NO_COMMAND), signs[:-1])
            changed = np.flatnonzero(signs != before)
            self._last_signs[index, entity] = int(signs[-1])
            if len(changed):
                states = [names[sign + 1] for sign in signs[changed]]
                times = self._times(steps[changed])[index]
                columns = rr.StateChange.columns(state=states)
                self._output.add_columns(f"{path}/actions/{entity}", times, columns)

    def _write_log(self, index: int, path: str, entries: list[LogEntry]) -> None:
        """Write the entries of the event log of a data center."""
        if not entries:
            return
        entries.sort(key=lambda entry: entry.step)
        steps = np.array([entry.step for entry in entries])
        # The text includes day and time of day, because the time column of the viewer is too narrow
        # to show both.
        clock = self._clock_texts(steps, index)
        log = rr.TextLog.columns(
            text=[f"{at} {entry.text}" for at, entry in zip(clock, entries, strict=True)],
            level=[entry.level for entry in entries],
        )
        self._output.add_columns(f"{path}/events", self._times(steps)[index], log)

    def _write_frames(
        self,
        block: Block,
        index: int,
        path: str,
        map_times: list[rr.TimeColumn],
        hall_times: list[rr.TimeColumn],
    ) -> None:
        """Write the heat maps and the 3D hall of a data center.

        Args:
            block: the block.
            index: index of the data center among those in focus.
            path: path of the data center's entities.
            map_times: time columns of the heat maps.
            hall_times: time columns of the frames of the 3D hall.
        """
        racks, levels = self._builder.racks[index], self._builder.levels[index]
        scales, grid = self._scales[index], self._tile_grids[index]
        for quantity, values in block.maps.items():
            self._write_map(f"{path}/map/{quantity}", map_times, values[:, racks], index, quantity)
        if len(block.change_steps):
            times = self._times(block.change_steps)[index]
            changes = block.changes[:, racks]
            self._write_map(f"{path}/map/change", times, changes, index, "change")
        if len(block.map_steps):
            hall = self._fleet.configs[self._focus[index]].hall
            self._write_marks(path, map_times, block.maps["inlet"][:, racks], hall, grid)
        for quantity, values in block.halls.items():
            colours = colour_scales.colours_of(scales[quantity])
            voxels = colours[colour_scales.classes_of(values[:, levels], scales[quantity])]
            columns = rr.VoxelGridMap.columns(colors=voxels.reshape(-1))
            parts = columns.partition(np.full(len(voxels), voxels.shape[1]))
            self._output.add_columns(f"{path}/hall/{quantity}", hall_times, parts)

    def _write_map(
        self, entity: str, times: list[rr.TimeColumn], values: Reals, index: int, quantity: str
    ) -> None:
        """Write heat maps of a quantity of a data center.

        Args:
            entity: path of the heat maps.
            times: time columns of the heat maps.
            values: value of each rack, (M, R).
            index: index of the data center among those in focus.
            quantity: name of the quantity.
        """
        classes = colour_scales.classes_of(values, self._scales[index][quantity])
        if quantity in self._difference_counts:
            counts = np.bincount(classes.reshape(-1), minlength=colour_scales.MAX_CLASSES + 1)
            self._difference_counts[quantity] += counts
        frames = rasters.heat_maps(classes, self._tile_grids[index])
        columns = rr.SegmentationImage.columns(buffer=frames.reshape(len(frames), -1))
        self._output.add_columns(entity, times, columns)

    def _clock(self, steps: I64) -> npt.NDArray[np.datetime64]:
        """Return the times at which T steps begin on the clocks of the n data centers in focus.

        Their shape is (T, n).
        """
        return self._drivers.times(steps, self._fleet.steps_per_hour)

    def _clock_texts(self, steps: I64, index: int) -> list[str]:
        """Return the times at which steps begin in a data center in focus, as ``MM-DD hh:mm``."""
        clock = np.datetime_as_string(self._clock(steps)[:, index], "m").tolist()
        return [f"{at[5:10]} {at[11:]}" for at in clock]

    def _times(self, steps: I64) -> list[list[rr.TimeColumn]]:
        """Return the time columns of both timelines, for each data center in focus."""
        step = rr.TimeColumn("step", sequence=steps)
        clocks = self._clock(steps).astype("datetime64[ns]").T
        return [[step, rr.TimeColumn("sim_time", timestamp=clock)] for clock in clocks]

    def _path(self, dc: int) -> str:
        """Return the path of the entities of a data center, ``dc/NAME``."""
        return f"dc/{rr.escape_entity_path_part(self._names[dc])}"


def _pictures_of(sim: Simulator, dc: int, cadence: Cadence) -> Iterator[Pictures]:
    """Yield the pictures of a data center besides heat maps: states, airflow, zones, liquid."""
    yield StatePictures(sim, dc)
    if sim.fleet.air is not None:
        yield AirflowPictures(sim, dc, cadence)
    if sim.fleet.configs[dc].hall.racks > MIN_RACKS:
        yield ZonePictures(sim, dc)
    if sim.fleet.configs[dc].liquid is not None:
        yield LiquidPictures(sim, dc, cadence)
