"""Racks and CRAC units of a recording: trends of racks, the hottest row by time, marks on maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr

from sdc_taichi.config import HallConfig
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.hall.floor_plan import floor_plan, unit_places_m
from sdc_taichi.hall.rack_selection import RackSelection, default_racks
from sdc_taichi.types import F64, I64, Reals

from .colour_scales import ColourScale, annotation_context, classes_of, invisible_names
from .hall_rasters import TileGrid
from .rack_histories import RackHistory, thinned
from .recording_series import GREY, PALETTE, RED
from .recording_text import rack_place

MAX_RACK_LINES = 200
"""Largest number of racks whose trends are recorded."""
TRENDS = {"inlet_c": "hottest inlet of racks [C]", "outlet_c": "outlet of racks [C]",
          "power_kw": "power of racks [kW]"}  # fmt: skip
"""Titles of the trends of racks, keyed by entity, which is a field of ``RackValues``."""
MAX_ROW_TIMES = 1_000
"""Largest number of times in the picture of the hottest row."""
ROW_ASPECT = 2.2
"""Width of the picture of the hottest row, as a multiple of its height."""
MARK_RGB = (60, 255, 90)
"""Colour of the mark of the hottest rack, which no palette of the maps contains."""
MARK_TEXT_RGB = (30, 155, 65)
"""Colour of its name, a green that is legible on dark and on light backgrounds."""
UNIT_RGB, DOWN_RGB = (80, 170, 230), (255, 60, 60)
"""Colours of CRAC units that run and of those that are down."""
_LABEL_RGB = (135, 135, 135)

Entities = Iterator[tuple[str, Any]]
"""Iterator of entity paths, each with its component or archetype."""


def check_selection(selection: RackSelection | None, hall: HallConfig, name: str) -> RackSelection:
    """Return a valid selection of racks of a hall, the default one if None.

    Raises:
        ConfigError: the hall does not have these racks, or they are too many to record.
    """
    if selection is None:
        return default_racks(hall)
    selection.check(hall, name)
    count = len(selection.racks(hall, np.zeros(hall.racks)))
    if count > MAX_RACK_LINES:
        raise ConfigError(
            f"{selection.option}: {count:,} racks of {name}; valid are at most {MAX_RACK_LINES} "
            "in a recording"
        )
    return selection


def trend_lines(racks: Sequence[int], peak_c: F64, racks_per_row: int) -> rr.SeriesLines:
    """Return names, colours and widths of the trends of racks; the warmest is red and wide."""
    names = [f"{rack_place(rack, racks_per_row)}, to {peak_c[rack]:.1f} C" for rack in racks]
    warmest = max(racks, key=lambda rack: rank(peak_c[rack]))
    others = [colour for colour in PALETTE if colour not in (RED, GREY)]
    colours = [others[i % len(others)] for i in range(len(racks))]
    # The coolest of several racks is there for comparison with the others.
    coolest = min(racks, key=lambda rack: rank(peak_c[rack]))
    widths = [1.2] * len(racks)
    for rack, colour, width in ((coolest, GREY, 2.0), (warmest, RED, 2.5)):
        colours[racks.index(rack)], widths[racks.index(rack)] = colour, width
    return rr.SeriesLines(names=names, colors=np.array(colours, np.uint32), widths=widths)


def mark_columns(inlet_c: Reals, hall: HallConfig, grid: TileGrid) -> Any:
    """Return the outline of the rack with the hottest inlet on the maps.

    Args:
        inlet_c: inlet of each of R racks in M maps, in C, (M, R).
        hall: the hall.
        grid: geometry of the tiles of the maps.
    """
    racks = np.argmax(rank(inlet_c), axis=1)
    row, place = np.divmod(racks, hall.racks_per_row)
    left, top = place * (grid.tile_width + grid.gap), row * (grid.tile_height + grid.gap)
    right, bottom = left + grid.tile_width, top + grid.tile_height
    corners = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
    strips = np.array(corners, dtype=np.float32).transpose(2, 0, 1)
    return rr.LineStrips2D.columns(strips=strips)


def mark_texts(inlet_c: Reals, hall: HallConfig) -> Any:
    """Return the name and the inlet of the rack with the hottest inlet, for the text of maps.

    Args:
        inlet_c: inlet of each of R racks in M maps, in C, (M, R).
        hall: the hall.
    """
    racks = np.argmax(rank(inlet_c), axis=1)
    hottest_c = inlet_c[np.arange(len(racks)), racks]
    labels = [
        f"hottest: {rack_place(int(rack), hall.racks_per_row)}, {value:.1f} C"
        for rack, value in zip(racks, hottest_c, strict=True)
    ]
    return rr.Points2D.columns(labels=labels)


def mark_entities(path: str, hall: HallConfig, units: int, grid: TileGrid) -> Entities:
    """Yield the static entities of the marks on maps: style of the hottest rack, CRAC units.

    Args:
        path: path of the maps in the recording.
        hall: the hall.
        units: number of CRAC units.
        grid: geometry of the tiles of the maps.
    """
    outline = rr.LineStrips2D.from_fields(colors=MARK_RGB, radii=rr.Radius.ui_points(1.5))
    yield f"{path}/hottest", outline
    # Texts are above and below the map, where they hide no rack and no edge of the view cuts them.
    height, width = grid.image_shape
    for entity, y, colour in (("hottest_text", -0.16, MARK_TEXT_RGB), ("down_text", 1.0, DOWN_RGB)):
        text = rr.Points2D(
            [(width / 2, y * height)],
            radii=rr.Radius.ui_points(0.5),
            colors=colour,
            show_labels=True,
        )
        yield f"{path}/{entity}", text
    names = [f"CRAC {unit}" for unit in range(units)]
    points = rr.Points2D(
        unit_pixels(hall, units, grid),
        radii=rr.Radius.ui_points(4.0),
        colors=UNIT_RGB,
        labels=names,
        show_labels=False,
    )
    yield f"{path}/crac", points
    down = rr.Points2D.from_fields(
        radii=rr.Radius.ui_points(7.0), colors=DOWN_RGB, show_labels=False, draw_order=40.0
    )
    yield f"{path}/down", down


def unit_pixels(hall: HallConfig, units: int, grid: TileGrid) -> F64:
    """Return the positions of the CRAC units beside the maps, in pixels, (U, 2)."""
    plan = floor_plan(hall)
    height, width = grid.image_shape
    places_m = unit_places_m(plan, units)
    beside = 0.03 * max(height, width)
    x = np.where(places_m[:, 0] > plan.length_m / 2, width + beside, -beside)
    return np.stack([x, places_m[:, 1] / plan.width_m * height], axis=1)


def unit_centres_m(hall: HallConfig, units: int) -> F64:
    """Return the centres of the CRAC units in the 3D hall, outside its end walls, in m, (U, 3)."""
    plan = floor_plan(hall)
    places_m = unit_places_m(plan, units)
    x = places_m[:, 0] + np.where(places_m[:, 0] > plan.length_m / 2, 0.5, -0.5)
    return np.stack([x, places_m[:, 1], np.full(units, hall.layout.rack_height_m / 2)], axis=1)


def unit_half_size_m(hall: HallConfig) -> tuple[float, float, float]:
    """Return half of the size of a CRAC unit in the 3D hall, in m."""
    return 0.4, 0.6, hall.layout.rack_height_m / 2


def down_boxes(down: Sequence[Sequence[int]], hall: HallConfig, units: int) -> Any:
    """Return the CRAC units that are down in the 3D hall, at each time at which they change.

    Args:
        down: units that are down at each time.
        hall: the hall.
        units: number of CRAC units.
    """
    names = [unit for at_time in down for unit in at_time]
    # Slightly larger than the units, which they hide.
    half_size_m = 1.1 * np.array(unit_half_size_m(hall))
    columns = rr.Boxes3D.columns(
        centers=unit_centres_m(hall, units)[names].reshape(-1, 3),
        half_sizes=np.tile(half_size_m, (len(names), 1)),
        labels=[f"CRAC {unit} down" for unit in names],
    )
    return columns.partition([len(at_time) for at_time in down])


def down_columns(down: Sequence[Sequence[int]], places: F64) -> Any:
    """Return the CRAC units that are down, at each time at which they change.

    Args:
        down: units that are down at each time.
        places: positions of all units, in pixels, (U, 2).
    """
    units = [unit for at_time in down for unit in at_time]
    columns = rr.Points2D.columns(
        positions=places[units].reshape(-1, 2), labels=[f"CRAC {unit} down" for unit in units]
    )
    return columns.partition([len(at_time) for at_time in down])


def down_texts(down: Sequence[Sequence[int]]) -> Any:
    """Return a text about the CRAC units that are down, at each time at which they change."""
    texts = [
        f"CRAC {', '.join(map(str, units[:4]))}{', ...' if len(units) > 4 else ''} down"
        for units in down
        if units
    ]
    columns = rr.Points2D.columns(labels=texts)
    return columns.partition([1 if units else 0 for units in down])


class HottestRow:
    """Picture of the inlets of the row with the hottest inlet, by time and rack."""

    def __init__(
        self, path: str, history: RackHistory, hall: HallConfig, scale: ColourScale
    ) -> None:
        self._path, self._hall, self._scale = path, hall, scale
        per_row = hall.racks_per_row
        peak_c = history.peak_inlet_c()
        self.row = int(np.argmax(rank(peak_c))) // per_row
        """Number of the row."""
        self._racks = np.arange(self.row * per_row, (self.row + 1) * per_row)
        self._values = history.of_racks(self._racks)
        inlet_c, self._length = thinned(self._values.inlet_c, MAX_ROW_TIMES)
        times = len(inlet_c)
        # Pixels are repeated, so that the picture is wide and no side is thinner than the labels.
        wide, high = times, per_row
        self._across = max(1, round(max(240, ROW_ASPECT * high) / wide))
        self._down = max(1, round(wide * self._across / ROW_ASPECT / high))
        pixels = classes_of(inlet_c.T, scale)
        self._pixels = pixels.repeat(self._down, axis=0).repeat(self._across, axis=1)

    def entities(self, clock: Sequence[str]) -> Entities:
        """Yield the static entities: picture, names of times and racks, labels, hottest inlet.

        Args:
            clock: beginning of each time of the history, as ``MM-DD hh:mm``.
        """
        height, width = self._pixels.shape
        per_row = self._hall.racks_per_row
        columns = clock[:: self._length]
        yield f"{self._path}/inlet", annotation_context(self._scale)
        yield f"{self._path}/inlet", rr.SegmentationImage(self._pixels, opacity=1.0)
        # Invisible pictures behind name rack and time at the pointer.
        for entity, names, axis in (
            ("racks", [rack_place(int(rack), per_row) for rack in self._racks], 0),
            ("times", columns, 1),
        ):
            numbers = np.arange(1, len(names) + 1, dtype=np.uint16)
            numbers = numbers.repeat(self._down if axis == 0 else self._across)
            grid = np.broadcast_to(numbers[:, None] if axis == 0 else numbers, (height, width))
            yield f"{self._path}/{entity}", invisible_names(names)
            image = rr.SegmentationImage(np.ascontiguousarray(grid), opacity=1.0, draw_order=-100.0)
            yield f"{self._path}/{entity}", image
        yield f"{self._path}/labels", self._labels(columns, height, width)
        place, at = np.unravel_index(int(np.argmax(self._values.inlet_c.T)), (per_row, len(clock)))
        name = rack_place(int(self._racks[place]), per_row)
        hottest_c = float(self._values.inlet_c[at, place])
        mark = rr.Points2D(
            [self._pixel(int(at), int(place)), (width / 2, -0.4 * height)],
            radii=[-5.0, -0.5],  # negative: points of the screen
            colors=[MARK_RGB, MARK_TEXT_RGB],
            labels=["", f"hottest: {name}, {hottest_c:.1f} C, {clock[int(at)]}"],
            show_labels=True,
        )
        yield f"{self._path}/hottest", mark
        cursor = rr.LineStrips2D.from_fields(colors=_LABEL_RGB, radii=rr.Radius.ui_points(1.0))
        yield f"{self._path}/cursor", cursor

    def cursor_columns(self, steps: I64) -> Any:
        """Return lines across the picture at the times of steps, at which the viewer may be."""
        height, _ = self._pixels.shape
        at = np.searchsorted(self._values.steps, steps, side="right") - 1
        x = (at // self._length + 0.5) * self._across
        top, bottom = np.full_like(x, -4.0), np.full_like(x, height + 4.0)
        strips = np.stack([np.stack([x, top], 1), np.stack([x, bottom], 1)], axis=1)
        return rr.LineStrips2D.columns(strips=strips.astype(np.float32))

    def _labels(self, columns: Sequence[str], height: int, width: int) -> rr.Points2D:
        """Return labels of times below the picture, and of racks at its left side."""
        ticks = np.unique(
            np.linspace(0, len(columns) - 1, min(3, len(columns))).round().astype(int)
        )
        # The first and the last time may be at the same day, of which the time of day suffices.
        part = slice(6, None) if columns[0][:5] == columns[-1][:5] else slice(0, 5)
        below = [((tick + 0.5) * self._across, 1.05 * height) for tick in ticks.tolist()]
        last = self._hall.racks_per_row - 1
        places = sorted({0, last // 2, last})
        # The viewer draws labels below their points, in the same size for every picture.
        beside = [(-0.27 * width, (place + 0.5) * self._down - 0.1 * height) for place in places]
        names = [f"rack {self._racks[place]}" for place in places]
        names[0] = rack_place(int(self._racks[0]), self._hall.racks_per_row)
        return rr.Points2D(
            [*below, *beside],
            radii=rr.Radius.ui_points(1.5),
            colors=_LABEL_RGB,
            labels=[*(columns[tick][part] for tick in ticks.tolist()), *names],
            show_labels=True,
        )

    def _pixel(self, at: int, place: int) -> tuple[float, float]:
        """Return the middle of a time and a place of the row in the picture."""
        return (at // self._length + 0.5) * self._across, (place + 0.5) * self._down
