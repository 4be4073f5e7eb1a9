"""Zones of a large hall in a recording: a map of the zones, and the racks of each zone.

The map of zones shows the hottest and the mean inlet of each zone in every step. The racks of a
zone are recorded again when an inlet has changed by ``TOLERANCE_K``; if there are more such zones
than a step may record, those with the largest changes come first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import rerun as rr

from sdc_taichi.hall.zones import Zones, hall_zones
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.types import F32, Reals, StepResult

from .colour_scales import Classes, ColourScale, annotation_context, classes_of
from .hall_rasters import tile_grid
from .recording_frames import (
    Columns,
    Entities,
    Frames,
    class_format,
    placed,
)
from .recording_racks import MARK_RGB, MARK_TEXT_RGB
from .recording_text import rack_place

if TYPE_CHECKING:
    from sdc_taichi.sim.simulator import Simulator

MIN_RACKS = 2_000
"""Number of racks above which a recording has zones."""
TOLERANCE_K = 0.25
"""Change of a rack's inlet at which the racks of its zone are recorded again, in K."""
MOST_RACKS_PER_STEP = 6_400
"""Largest number of racks that a step records again, which bounds its size."""
_LABEL_RGB = (135, 135, 135)  # legible on dark and on light backgrounds
_BESIDE_PIXELS = 4.0
"""Distance of the number of a zone from the map of zones, in pixels."""
_TILE_PIXELS = 6
"""Height of the tile of a zone, in pixels, and smallest width."""


def zone_shape(zones: Zones) -> tuple[int, int]:
    """Return height and width of the tile of a zone in the map of zones, in pixels.

    The map is about 1.8 times as wide as high.
    """
    blocks, sections = zones.shape
    return _TILE_PIXELS, min(max(round(_TILE_PIXELS * 1.8 * blocks / sections), _TILE_PIXELS), 60)


def zone_map(zones: Zones, hottest: Classes, mean: Classes) -> Classes:
    """Return the map of zones, one per frame, (T, height, width).

    The edge of the tile of a zone has the class of its hottest inlet, the middle that of its mean
    inlet. Between two tiles is one pixel of class 0.

    Args:
        zones: the Z zones of the hall.
        hottest: class of the hottest inlet of each zone in each of T frames, (T, Z).
        mean: class of the mean inlet, (T, Z).
    """
    height, width = zone_shape(zones)
    tiles = np.zeros((*hottest.shape, height + 1, width + 1), dtype=np.uint8)
    tiles[..., :height, :width] = hottest[..., None, None]
    quarter = width // 4
    tiles[..., 1 : height - 1, quarter : width - quarter] = mean[..., None, None]
    blocks, sections = zones.shape
    rows = tiles.reshape(-1, blocks, sections, height + 1, width + 1).swapaxes(2, 3)
    image = rows.reshape(-1, blocks * (height + 1), sections * (width + 1))
    return np.ascontiguousarray(image[:, :-1, :-1])


def zone_pixels(zones: Zones) -> npt.NDArray[np.float64]:
    """Return the middle of each tile of the map of zones, x and y in pixels, (Z, 2)."""
    height, width = zone_shape(zones)
    block, section = np.divmod(np.arange(zones.count), zones.shape[1])
    return np.stack(
        [section * (width + 1) + width / 2.0, block * (height + 1) + height / 2.0], axis=1
    )


class ZonePictures:
    """Map of the zones of one data center, and the racks of each zone."""

    def __init__(self, sim: Simulator, dc: int) -> None:
        fleet = sim.fleet
        self._hall = fleet.configs[dc].hall
        self._racks = slice(*fleet.rack_offsets[dc : dc + 2].tolist())
        self.zones = hall_zones(self._hall)
        self._of_zone = [self.zones.racks(zone) for zone in range(self.zones.count)]
        self._recorded_c = np.full(self._hall.racks, -np.inf, dtype=np.float32)
        """Recorded inlet of each rack, in C, (R,)."""
        self._map: Frames[F32] = Frames()
        """Hottest and mean inlet of each zone, in C, (2, Z)."""
        self._hottest: Frames[tuple[int, float]] = Frames()
        self._zone_racks: list[Frames[F32]] = [Frames() for _ in self._of_zone]

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        """Number of rows and of places of each zone."""
        bounds = (self.zones.bounds(zone) for zone in range(self.zones.count))
        return tuple(
            (rows.stop - rows.start, places.stop - places.start) for rows, places in bounds
        )

    @property
    def size_bytes(self) -> int:
        """Size of the frames that ``take`` returns, in bytes."""
        racks = sum(
            len(frames) * len(racks)
            for frames, racks in zip(self._zone_racks, self._of_zone, strict=True)
        )
        height, width = zone_shape(self.zones)
        return racks + len(self._map) * self.zones.count * (height + 1) * (width + 1)

    def add(self, result: StepResult, active: Sequence[ActiveEvent]) -> None:
        """Add the zones of a step, and the racks of changed zones; arguments as in ``Pictures``."""
        step = result.step
        hottest_c = result.rack_inlet_max_c[self._racks].astype(np.float32)
        mean_c = self.zones.mean(result.rack_inlet_c[self._racks])
        self._map.append(step, np.stack([self.zones.highest(hottest_c), mean_c.astype(np.float32)]))
        rack = int(np.argmax(hottest_c))
        self._hottest.append(step, (rack, float(hottest_c[rack])))
        change_k = np.abs(hottest_c - self._recorded_c)
        for zone in self._changed(self.zones.highest(change_k)):
            racks = self._of_zone[zone]
            self._recorded_c[racks] = hottest_c[racks]
            self._zone_racks[zone].append(step, hottest_c[racks])

    def _changed(self, change_k: Reals) -> list[int]:
        """Return the zones whose racks are to be recorded again, largest change first.

        Args:
            change_k: largest change of an inlet of each zone since it was recorded, in K, (Z,).
        """
        order = np.argsort(-change_k, kind="stable")
        changed = order[change_k[order] >= TOLERANCE_K]
        if np.isinf(change_k).any():  # at the first step
            return list(changed)
        racks = np.cumsum([len(self._of_zone[zone]) for zone in changed.tolist()])
        return list(changed[racks <= MOST_RACKS_PER_STEP])

    def entities(self, scales: Mapping[str, ColourScale]) -> Entities:
        """Yield the static entities, by their paths below that of the data center.

        Args:
            scales: colour scales of the heat maps, keyed by quantity.
        """
        classes = annotation_context(scales["inlet"])
        height, width = zone_shape(self.zones)
        blocks, sections = self.zones.shape
        shape = blocks * (height + 1) - 1, sections * (width + 1) - 1
        yield "zones/map", classes
        yield "zones/map", class_format(shape)
        # Numbers of zones are beside the map, because no colour is legible on all tiles. Those
        # between the first and the last section have no space.
        sides = {0: -_BESIDE_PIXELS, sections - 1: shape[1] + _BESIDE_PIXELS}
        names = [str(zone) for zone in range(self.zones.count) if zone % sections in sides]
        top = zone_pixels(self.zones)[:, 1] - height / 2.0
        beside = [(sides[int(zone) % sections], top[int(zone)]) for zone in names]
        labels = rr.Points2D(beside, radii=0.0, colors=_LABEL_RGB, labels=names, show_labels=True)
        yield "zones/names", labels
        style = rr.Points2D.from_fields(radii=rr.Radius.ui_points(5.0), colors=MARK_RGB)
        yield "zones/hottest", style
        text = rr.Points2D(
            [(shape[1] / 2.0, -0.13 * shape[0])], radii=0.0, colors=MARK_TEXT_RGB, show_labels=True
        )
        yield "zones/hottest_text", text
        yield "zone_racks", classes
        grid = tile_grid(self._hall)
        pixel = grid.tile_width + grid.gap, grid.tile_height + grid.gap
        for zone, shape in enumerate(self.shapes):
            rows, places = self.zones.bounds(zone)
            at = places.start * pixel[0], rows.start * pixel[1]
            yield f"zone_racks/{zone}", placed(class_format(shape), scale=pixel, at=at)

    def take(self, scales: Mapping[str, ColourScale]) -> Iterator[Columns]:
        """Yield the columns of all frames that have not been written, and forget the frames.

        Args:
            scales: colour scales of the heat maps, keyed by quantity.
        """
        scale = scales["inlet"]
        if len(self._map):
            steps, frames = self._map.take()
            hottest, mean = classes_of(np.stack(frames, axis=1), scale)
            pixels = zone_map(self.zones, hottest, mean).reshape(len(steps), -1)
            yield "zones/map", steps, rr.SegmentationImage.columns(buffer=pixels)
        if len(self._hottest):
            steps, hottest_racks = self._hottest.take()
            per_row = self._hall.racks_per_row
            zones = self.zones.of_racks(np.array([rack for rack, _ in hottest_racks]))
            labels = [
                f"hottest: zone {zone}, {rack_place(rack, per_row)}, {c:.1f} C"
                for zone, (rack, c) in zip(zones.tolist(), hottest_racks, strict=True)
            ]
            positions = zone_pixels(self.zones)[zones]
            yield "zones/hottest", steps, rr.Points2D.columns(positions=positions)
            yield "zones/hottest_text", steps, rr.Points2D.columns(labels=labels)
        for zone, zone_frames in enumerate(self._zone_racks):
            if len(zone_frames):
                steps, inlets_c = zone_frames.take()
                pixels = classes_of(np.stack(inlets_c), scale)
                yield f"zone_racks/{zone}", steps, rr.SegmentationImage.columns(buffer=pixels)
