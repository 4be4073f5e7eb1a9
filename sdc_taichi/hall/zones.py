"""Zones of a hall: blocks of adjacent rows, cut into sections where rows are long.

Zones summarise halls that have more racks than a picture can show. They are numbered from 0: first
along the rows, then across them, as the racks are. Both rows of a cold aisle are in the same zone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.config import HallConfig
from sdc_taichi.hall.floor_plan import row_distance_m
from sdc_taichi.types import F64, I64, Reals

RACKS_PER_ZONE = 100
"""Smallest mean number of racks of a zone, except that a hall has at least one zone."""
MOST_ZONES = 24
"""Largest number of zones of a hall."""


@dataclass(frozen=True, slots=True)
class Zones:
    """The Z zones of a hall of R racks: all pairs of a block of rows and a section of the rows."""

    first_row: I64
    """First row of each block of rows, then the number of rows, (blocks + 1,)."""
    first_place: I64
    """First place of each section of the rows, then the number of racks of a row,
    (sections + 1,)."""

    @property
    def shape(self) -> tuple[int, int]:
        """Number of blocks of rows, and number of sections of the rows."""
        return len(self.first_row) - 1, len(self.first_place) - 1

    @property
    def count(self) -> int:
        """Number of zones, Z."""
        blocks, sections = self.shape
        return blocks * sections

    def bounds(self, zone: int) -> tuple[slice, slice]:
        """Return the rows and the places in the rows of a zone."""
        block, section = divmod(zone, self.shape[1])
        return (
            slice(int(self.first_row[block]), int(self.first_row[block + 1])),
            slice(int(self.first_place[section]), int(self.first_place[section + 1])),
        )

    def racks(self, zone: int) -> I64:
        """Return the indices of the racks of a zone, row by row, (racks of the zone,)."""
        rows, places = self.bounds(zone)
        per_row = int(self.first_place[-1])
        first = np.arange(rows.start, rows.stop) * per_row
        return (first[:, None] + np.arange(places.start, places.stop)).reshape(-1)

    def of_racks(self, racks: I64) -> I64:
        """Return the zones of racks, both by their index in the hall, of the same shape."""
        row, place = np.divmod(racks, self.first_place[-1])
        block = np.searchsorted(self.first_row, row, side="right") - 1
        section = np.searchsorted(self.first_place, place, side="right") - 1
        return np.asarray(block * self.shape[1] + section)

    def highest(self, rack_values: Reals) -> Reals:
        """Return the highest value of each zone from one value per rack, (..., R) to (..., Z)."""
        of_blocks = np.maximum.reduceat(self._by_row(rack_values), self.first_row[:-1], axis=-2)
        of_zones: Reals = np.maximum.reduceat(of_blocks, self.first_place[:-1], axis=-1)
        return of_zones.reshape(*of_zones.shape[:-2], -1)

    def mean(self, rack_values: Reals) -> F64:
        """Return the mean value of each zone from one value per rack, (..., R) to (..., Z)."""
        rows = self._by_row(rack_values)
        of_blocks = np.add.reduceat(rows, self.first_row[:-1], axis=-2, dtype=np.float64)
        sums = np.add.reduceat(of_blocks, self.first_place[:-1], axis=-1)
        racks = np.diff(self.first_row)[:, None] * np.diff(self.first_place)
        means: F64 = sums / racks
        return means.reshape(*means.shape[:-2], -1)

    def _by_row(self, rack_values: Reals) -> Reals:
        """Return values of the racks as (..., rows, places)."""
        rows, per_row = int(self.first_row[-1]), int(self.first_place[-1])
        return rack_values.reshape(*rack_values.shape[:-1], rows, per_row)


def hall_zones(hall: HallConfig) -> Zones:
    """Return the zones of a hall, about as long as wide, and nearly of equal size."""
    wanted = min(max(hall.racks // RACKS_PER_ZONE, 1), MOST_ZONES)
    pairs = -(-hall.rows // 2)
    length_m = hall.racks_per_row * hall.layout.rack_pitch_m
    width_m = float(row_distance_m(hall.layout, np.array(2 * pairs)))
    sections = round(np.sqrt(wanted * length_m / width_m))
    sections = min(max(sections, -(-wanted // pairs), 1), wanted, hall.racks_per_row)
    blocks = min(wanted // sections, pairs)
    first_row = np.arange(blocks + 1) * pairs // blocks * 2
    return Zones(
        first_row=np.minimum(first_row, hall.rows),
        first_place=np.arange(sections + 1) * hall.racks_per_row // sections,
    )
