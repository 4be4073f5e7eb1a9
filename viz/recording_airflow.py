"""Airflow of a hall in a recording: the CRAC unit that feeds each rack, and sources of exhaust.

The share map shows each rack in the colour of the CRAC unit that gives most of its supply air, the
stronger the larger its share. Close-ups show the racks around each of the hottest racks, with
arrows from the racks whose exhaust warms it. Both follow from ``Inlets``, as the parts of inlet
temperatures that ``sdc-taichi hall why`` prints.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import rerun as rr

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.hall.floor_plan import floor_plan
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.inlet_parts import HOTTEST_RACKS, InletParts, Inlets, intake_air_of
from sdc_taichi.types import F32, F64, I64, Reals, StepResult

from .colour_scales import ColourScale, annotation_context, classes_of, named_classes
from .hall_rasters import tile_grid
from .recording_frames import (
    Columns,
    Entities,
    Frames,
    class_format,
    class_image,
    rack_pixels,
    rgb,
)
from .recording_racks import DOWN_RGB, unit_pixels
from .recording_series import PALETTE, RED, Cadence
from .recording_text import rack_place

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

NEW_MAXIMUM_K = 0.5
"""Rise of the hottest inlet above that of all earlier frames, in K, that causes another frame."""
TOLERANCE_K = 1.0
"""Change of an inlet of the hottest racks, in K, that causes another frame of the close-ups."""
STRENGTH_TOLERANCE = 0.02
"""Change of a unit's supply, relative to that of the strongest unit, that changes the share map."""
BANDS = ("up to 25 %", "25 to 50 %", "50 to 75 %", "more than 75 %")
"""Bands of the share of a unit in the supply air of a rack, smallest first."""
UNIT_COLOURS = tuple(colour for colour in PALETTE if colour != RED)
"""Colours of CRAC units in turn, as 0xRRGGBBAA; red marks units that are down."""
MAX_UNIT_LABELS = 8
"""Largest number of labels of CRAC units at a wall; more would cover each other."""
_DOWN_COLOUR = int.from_bytes((*DOWN_RGB, 255))
"""Colour of units that are down, as 0xRRGGBBAA."""
NO_UNIT = 0
"""Class of racks that no CRAC unit supplies, in the share map."""
_GREY_RGB = np.array([110.0, 110.0, 110.0])
_GREY_SHARES = (0.7, 0.45, 0.2, 0.0)
"""Share of grey in the colour of a unit, by band of its share."""
_REACH_PLACES, _REACH_PIXELS = 4, 6
"""Distance from the hot rack to the edge of a close-up: in places along the row, and in halves of a
rack's depth across it."""
_GAP_PIXELS = 3
"""Distance between two close-ups, in pixels."""
_WIDEST_PIXELS, _NARROWEST_PIXELS = 0.5, 0.06
"""Width of the widest and of the narrowest arrow, in pixels."""
_CLEARANCE_PIXELS = 0.4
"""Distance from an arrow's head to the middle of the front of the hot rack, in pixels."""
_EDGE_PIXELS = 0.05
"""Width of the pale edge of an arrow, in pixels."""
_DARK, _GREY, _PALE = (25, 25, 25), (135, 135, 135), (245, 245, 245)


_UNIT_RADIUS, _DOWN_RADIUS = -4.0, -7.0
"""Radius of the mark of a CRAC unit, running and down. Rerun takes negative radii for points of the
screen."""
_UnitMarks = list[tuple[int, float, str]]


def share_classes(unit: I64, share: F64) -> npt.NDArray[np.uint16]:
    """Return the class of each rack in the share map, (R,).

    Class ``NO_UNIT`` is a rack without supply air. Unit k has the classes 4 k + 1 to 4 k + 4, one
    for each of ``BANDS``.

    Args:
        unit: CRAC unit that gives each rack most of its supply air, counted from 0, (R,).
        share: Share of this unit in the supply air of the rack, 0..1, (R,).
    """
    band = np.minimum((share * len(BANDS)).astype(np.int64), len(BANDS) - 1)
    return np.where(share > 0.0, 1 + unit * len(BANDS) + band, NO_UNIT).astype(np.uint16)


def share_legend(units: int) -> rr.AnnotationContext:
    """Return name and colour of each class of the share map of a hall with that many units."""
    names, colours = ["no supply air"], [0x000000FF]
    for unit in range(units):
        full = np.array(rgb(UNIT_COLOURS[unit % len(UNIT_COLOURS)]), dtype=np.float64)
        for name, grey in zip(BANDS, _GREY_SHARES, strict=True):
            red, green, blue = np.rint(grey * _GREY_RGB + (1.0 - grey) * full).astype(int).tolist()
            names.append(f"CRAC {unit} gives {name}")
            colours.append(red << 24 | green << 16 | blue << 8 | 0xFF)
    return named_classes(names, colours, first=NO_UNIT)


class Arrows(NamedTuple):
    """Arrows to the hottest racks from A racks whose exhaust warms them."""

    start: F64
    """Start of each arrow, x and y in pixels of the close-ups, (A, 2)."""
    end: F64
    """Tip of each arrow, x and y in pixels of the close-ups, (A, 2)."""
    warming_k: F64
    """Warming of the inlet at the tip by the exhaust of the rack at the start, in K, (A,)."""


class CloseUps:
    """Close-ups of a hall of R racks around chosen racks, side by side in one image.

    A pixel is as wide as a rack and half as deep: a rack has one pixel for its front and one for
    its back. Aisles are rounded to half a rack's depth.
    """

    def __init__(self, hall: HallConfig) -> None:
        plan, half_m = floor_plan(hall), hall.layout.rack_depth_m / 2
        per_row = self._per_row = hall.racks_per_row
        first_pixel = (plan.centre_m[::per_row, 1] - half_m) / half_m
        self._first_pixel = np.rint(first_pixel).astype(np.int64)
        """First of the two pixels of each row across the hall, (rows,)."""
        self._front_last = plan.facing[::per_row] > 0
        """True for rows whose front is the second of these pixels, (rows,)."""
        self._row_of_pixel = np.full(int(self._first_pixel[-1]) + 2 + 2 * _REACH_PIXELS, -1)
        """Row at each pixel across the hall and beyond its walls; -1 is none."""
        for row, first in enumerate((self._first_pixel + _REACH_PIXELS).tolist()):
            self._row_of_pixel[first : first + 2] = row

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width of the image, in pixels."""
        width = 2 * _REACH_PLACES + 1
        return 2 * _REACH_PIXELS + 2, HOTTEST_RACKS * (width + _GAP_PIXELS) - _GAP_PIXELS

    def image(self, racks: Sequence[int], rack_values: Reals) -> F32:
        """Return the image of one value per rack, (height, width); pixels without a rack are nan.

        Args:
            racks: the racks in the middle of the close-ups, at most ``HOTTEST_RACKS``.
            rack_values: the values, (R,).
        """
        image = np.full(self.image_shape, np.nan, dtype=np.float32)
        for number, rack in enumerate(racks):
            row, place = divmod(rack, self._per_row)
            places = place + np.arange(-_REACH_PLACES, _REACH_PLACES + 1)
            first = int(self._first_pixel[row])
            rows = self._row_of_pixel[first : first + len(image), None]
            is_rack = (rows >= 0) & (places >= 0) & (places < self._per_row)
            left = _left(number)
            part = image[:, left : left + len(places)]
            part[is_rack] = rack_values[(rows * self._per_row + places)[is_rack]]
        return image

    def title_place(self, number: int) -> tuple[float, float]:
        """Return where the title of a close-up is, x and y in pixels."""
        return _left(number) + _REACH_PLACES + 0.5, -1.0

    def arrows(self, number: int, parts: InletParts) -> Arrows:
        """Return arrows in a close-up from the backs of source racks to the front of the hot rack.

        The hot rack itself is a source too. Arrows from racks beyond the close-up begin at its
        edge.

        Args:
            number: number of the close-up, counted from 0.
            parts: parts of the inlet temperature of the hot rack.
        """
        sources = [*parts.sources(), (parts.rack, parts.own_exhaust_k)]
        sources = [(rack, warming_k) for rack, warming_k in sources if warming_k > 0.0]
        front = self._middle(parts.rack, front=True)
        backs = np.array([self._middle(rack, front=False) for rack, _ in sources])
        away = backs.reshape(-1, 2) - front
        beyond = np.abs(away) / (_REACH_PLACES + 0.5, _REACH_PIXELS + 0.5)
        away /= np.maximum(beyond.max(axis=1, keepdims=True, initial=0.0), 1.0)
        length = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)[:, None]
        row, place = divmod(parts.rack, self._per_row)
        origin = place - _REACH_PLACES, self._first_pixel[row] - _REACH_PIXELS
        end = front - origin + (_left(number), 0.0)
        return Arrows(
            start=end + away,
            end=end + away * np.minimum(_CLEARANCE_PIXELS / length, 0.4),
            warming_k=np.array([warming_k for _, warming_k in sources]),
        )

    def _middle(self, rack: int, *, front: bool) -> F64:
        """Return the middle of the front or the back of a rack, in pixels of the whole hall."""
        row, place = divmod(rack, self._per_row)
        is_last = bool(self._front_last[row]) == front
        return np.array([place + 0.5, self._first_pixel[row] + is_last + 0.5])


def _left(number: int) -> int:
    """Return the first column of a close-up, in pixels."""
    return number * (2 * _REACH_PLACES + 1 + _GAP_PIXELS)


class _Exhaust(NamedTuple):
    """Close-ups of the hottest racks at one step, with arrows from the racks that warm them."""

    image_c: F32
    """Hottest inlet of the racks in the close-ups, in C, (height, width); nan without a rack."""
    arrows: Arrows
    """Arrows in all close-ups."""
    racks: list[int]
    """The racks in the middle of the close-ups, hottest first."""
    titles: list[str]
    """Title of each close-up."""
    text: str
    """Markdown table of the sources."""


class AirflowPictures:
    """Share map and close-ups of one data center with recirculation.

    Frames may be recorded at the times of the 3D hall, when failures or other events begin or end,
    and when the hottest inlet exceeds that of all earlier frames by ``NEW_MAXIMUM_K``. Of these,
    the share map is recorded when the strength of a unit has changed by ``STRENGTH_TOLERANCE``, and
    the close-ups when other racks are the hottest, or an inlet of these has changed by
    ``TOLERANCE_K``.

    Args:
        sim: the simulator.
        dc: index of the data center.
        cadence: how often the 3D hall is recorded.
    """

    def __init__(self, sim: Simulator, dc: int, cadence: Cadence) -> None:
        self._sim, self._dc, self._cadence = sim, dc, cadence
        fleet = sim.fleet
        self._hall = fleet.configs[dc].hall
        self._racks = slice(*fleet.rack_offsets[dc : dc + 2].tolist())
        self._units = int(fleet.unit_offsets[dc + 1] - fleet.unit_offsets[dc])
        self._close_ups = CloseUps(self._hall)
        self._active: Sequence[ActiveEvent] | None = None
        self._hottest_c = -np.inf
        self._strength: F64 | None = None
        self._shown: I64 | None = None
        """The hottest racks in the latest frame of the close-ups, hottest first."""
        self._shown_c: Reals | None = None
        """Their inlets, in C."""
        self._marks: Frames[_UnitMarks] = Frames()
        self._shares: Frames[npt.NDArray[np.uint16]] = Frames()
        self._exhaust: Frames[_Exhaust] = Frames()

    @property
    def size_bytes(self) -> int:
        """Size of the frames that ``take`` returns, in bytes."""
        return 2 * self._hall.racks * len(self._shares) + 4_000 * len(self._exhaust)

    def add(self, result: StepResult, active: Sequence[ActiveEvent]) -> None:
        """Record the airflow after a step if a frame is due.

        Args:
            result: result of the step.
            active: events of the data center that are active in the step.
        """
        hottest_c = float(result.inlet_max_c[self._dc])
        every = self._cadence.hall_every_steps
        if active:
            every = self._cadence.hall_every_steps_in_events
        is_due = result.step % every == 0 or hottest_c > self._hottest_c + NEW_MAXIMUM_K
        if (not is_due and active == self._active) or not np.isfinite(hottest_c):
            return
        is_other_event = active != self._active
        if is_other_event:
            self._marks.append(result.step, self._unit_marks(active))
        self._active, self._hottest_c = active, max(self._hottest_c, hottest_c)
        air = self._sim.intake_air()
        if len(self._sim.fleet.configs) > 1:
            air = intake_air_of(self._sim.fleet, air, self._dc)
        strength = air.unit_weight * air.fresh_ratio
        strength /= max(strength.max(), 1e-30)
        has_other_shares = (
            self._strength is None or np.abs(strength - self._strength).max() > STRENGTH_TOLERANCE
        )
        has_other_racks = self._has_other_racks(result.rack_inlet_max_c[self._racks])
        if not (has_other_shares or has_other_racks or is_other_event):
            return
        inlets = Inlets(self._sim.fleet, self._dc, air)
        if has_other_shares:
            self._shares.append(result.step, share_classes(*inlets.main_units()))
            self._strength = strength
        if has_other_racks or is_other_event:
            parts = [inlets.parts(rack) for rack in inlets.hottest(HOTTEST_RACKS)]
            self._exhaust.append(result.step, self._sources(parts, result.rack_inlet_max_c))

    def _has_other_racks(self, inlet_c: Reals) -> bool:
        """Return True if the hottest racks or their inlets differ from the latest close-ups.

        Args:
            inlet_c: hottest inlet of each rack of the hall, in C, (R,).
        """
        hottest = np.argsort(-rank(inlet_c), kind="stable")[:HOTTEST_RACKS]
        if self._shown is not None and self._shown_c is not None:
            change_k = np.abs(inlet_c[self._shown] - self._shown_c)
            if set(hottest.tolist()) == set(self._shown.tolist()) and (
                change_k.max() < TOLERANCE_K
            ):
                return False
        self._shown, self._shown_c = hottest, inlet_c[hottest]
        return True

    def _sources(self, parts: Sequence[InletParts], inlet_c: Reals) -> _Exhaust:
        """Return where the exhaust before the hottest racks comes from.

        Args:
            parts: parts of the inlet temperatures of the hottest racks, hottest first.
            inlet_c: hottest inlet of each rack of the fleet, in C.
        """
        racks, per_row = [part.rack for part in parts], self._hall.racks_per_row
        arrows = [self._close_ups.arrows(number, part) for number, part in enumerate(parts)]
        return _Exhaust(
            image_c=self._close_ups.image(racks, inlet_c[self._racks]),
            arrows=Arrows(*map(np.concatenate, zip(*arrows, strict=True))),
            racks=racks,
            titles=[f"rack {part.rack}: {part.inlet_c:.1f} C" for part in parts],
            text=sources_markdown(parts, per_row),
        )

    def entities(self, scales: Mapping[str, ColourScale]) -> Entities:
        """Yield the static entities, by their paths below that of the data center.

        Args:
            scales: colour scales of the heat maps, keyed by quantity.
        """
        yield "airflow/shares/units", share_legend(self._units)
        yield "airflow/shares/units", class_image(self._hall, "U16")
        places = unit_pixels(self._hall, self._units, tile_grid(self._hall))
        yield "airflow/shares/crac", rr.Points2D.from_fields(positions=places, show_labels=True)
        marks = rr.Points2D.from_fields(radii=rr.Radius.ui_points(4.0), colors=_PALE)
        yield "airflow/shares/hottest", marks
        yield "airflow/close_ups/racks", annotation_context(scales["inlet"])
        yield "airflow/close_ups/racks", class_format(self._close_ups.image_shape)
        for name, colour, order in (("edges", _PALE, 10.0), ("arrows", _DARK, 20.0)):
            style = rr.Arrows2D.from_fields(colors=colour, draw_order=order, show_labels=False)
            yield f"airflow/close_ups/{name}", style
        titles = [self._close_ups.title_place(number) for number in range(HOTTEST_RACKS)]
        points = rr.Points2D(titles, radii=0.0, colors=_GREY, show_labels=True)
        yield "airflow/close_ups/titles", points
        yield "airflow/sources", rr.TextDocument.from_fields(media_type="text/markdown")

    def _unit_marks(self, active: Sequence[ActiveEvent]) -> _UnitMarks:
        """Return colour, radius and label of the mark of each CRAC unit beside the share map."""
        # Units alternate between both walls.
        every = max(1, -(-self._units // (2 * MAX_UNIT_LABELS)))
        down = {event.target for event in active if event.kind == "crac_down"}
        marks = []
        for unit in range(self._units):
            name = f"CRAC {unit}" if unit // 2 % every == 0 else ""
            mark = UNIT_COLOURS[unit % len(UNIT_COLOURS)], _UNIT_RADIUS, name
            is_down = unit in down or None in down
            marks.append((_DOWN_COLOUR, _DOWN_RADIUS, f"CRAC {unit} down") if is_down else mark)
        return marks

    def take(self, scales: Mapping[str, ColourScale]) -> Iterator[Columns]:
        """Yield the columns of all frames that have not been written, and forget the frames.

        Args:
            scales: colour scales of the heat maps, keyed by quantity.
        """
        if len(self._marks):
            steps, unit_marks = self._marks.take()
            colours, radii, names = zip(*itertools.chain.from_iterable(unit_marks), strict=True)
            columns = rr.Points2D.columns(
                colors=np.array(colours, np.uint32), radii=radii, labels=names
            )
            yield "airflow/shares/crac", steps, columns.partition([self._units] * len(steps))
        if len(self._shares):
            steps, classes = self._shares.take()
            pixels = np.stack(classes).view(np.uint8)
            yield "airflow/shares/units", steps, rr.SegmentationImage.columns(buffer=pixels)
        if len(self._exhaust):
            yield from self._exhaust_columns(*self._exhaust.take(), scales["inlet"])

    def _exhaust_columns(
        self, steps: I64, frames: Sequence[_Exhaust], scale: ColourScale
    ) -> Iterator[Columns]:
        """Yield the columns of the sources of exhaust.

        Args:
            steps: steps of the frames, (T,).
            frames: the frames.
            scale: colour scale of inlets.
        """
        images = classes_of(np.stack([frame.image_c for frame in frames]), scale)
        buffer = images.reshape(len(images), -1)
        yield "airflow/close_ups/racks", steps, rr.SegmentationImage.columns(buffer=buffer)
        start, end, warming_k = (
            np.concatenate([frame.arrows[part] for frame in frames]) for part in range(3)
        )
        counts = [len(frame.arrows.warming_k) for frame in frames]
        largest_k = [float(frame.arrows.warming_k.max(initial=1e-9)) for frame in frames]
        width = _WIDEST_PIXELS * warming_k / np.repeat(largest_k, counts)
        width = np.maximum(width, _NARROWEST_PIXELS)
        labels = [f"{k:+.2f} K" for k in warming_k.tolist()]
        for name, edge, texts in (("edges", _EDGE_PIXELS, None), ("arrows", 0.0, labels)):
            columns = rr.Arrows2D.columns(
                origins=start, vectors=end - start, radii=width / 2.0 + edge, labels=texts
            )
            yield f"airflow/close_ups/{name}", steps, columns.partition(counts)
        titles = [title for frame in frames for title in frame.titles]
        racks = [len(frame.racks) for frame in frames]
        columns = rr.Points2D.columns(labels=titles)
        yield "airflow/close_ups/titles", steps, columns.partition(racks)
        marks = rack_pixels(self._hall, np.concatenate([frame.racks for frame in frames]))
        columns = rr.Points2D.columns(positions=marks)
        yield "airflow/shares/hottest", steps, columns.partition(racks)
        documents = rr.TextDocument.columns(text=[frame.text for frame in frames])
        yield "airflow/sources", steps, documents


def sources_markdown(parts: Sequence[InletParts], per_row: int) -> str:
    """Return a Markdown table of the parts of the inlet temperatures of racks.

    Args:
        parts: parts of the inlet temperature of each rack, hottest first.
        per_row: number of racks in a row of the hall.
    """
    lines = [
        "| rack | inlet, C | supply, C | own exhaust, K | exhaust of other racks, K |",
        "|---|---:|---:|---:|---|",
    ]
    for part in parts:
        sources = part.sources()
        listed_k = part.own_exhaust_k + sum(warming_k for _, warming_k in sources)
        texts = [f"{rack}: {warming_k:+.2f}" for rack, warming_k in sources]
        texts.append(f"rest {float(part.exhaust_k.sum()) - listed_k:+.2f}")
        lines.append(
            f"| {rack_place(part.rack, per_row)} | {part.inlet_c:.2f} | {part.supply_c:.2f} | "
            f"{part.own_exhaust_k:+.2f} | {', '.join(texts)} |"
        )
    return "\n".join(lines)
