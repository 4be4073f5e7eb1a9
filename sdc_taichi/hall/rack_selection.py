"""Racks that a user selects in words, such as ``7,2:5,row:3,hottest:10,median``.

The terms of a selection are separated by commas:

| term | racks |
|---|---|
| ``7`` | rack 7, counted from 0 over the hall |
| ``2:5`` | the rack at place 5 of row 2, both counted from 0 |
| ``row:3`` | all racks of row 3 |
| ``zone:3`` | all racks of zone 3, see ``hall.zones`` |
| ``hottest:10`` | the ten racks with the warmest inlets, warmest first |
| ``median`` | the rack with the median inlet |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.config import HallConfig
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.hall.zones import hall_zones
from sdc_taichi.number_text import parse_whole
from sdc_taichi.types import I64, Reals

HOTTEST_BY_DEFAULT = 10
"""Number of hottest racks in ``default_racks``."""
VALID_TERMS = "RACK, ROW:PLACE, row:ROW, zone:ZONE, hottest:COUNT or median, separated by commas"
"""Valid terms of a selection, for help texts and errors."""


class Term(NamedTuple):
    """One term of a selection."""

    kind: str
    """``rack``, ``place``, ``row``, ``zone``, ``hottest`` or ``median``."""
    numbers: tuple[int, ...]
    """Numbers of the term: rack, row and place, row, zone, or count."""
    text: str
    """The term as the user wrote it."""


@dataclass(frozen=True, slots=True)
class RackSelection:
    """Racks that a user has selected, for halls of any size."""

    terms: tuple[Term, ...]
    """Terms of the selection, in the user's order."""
    option: str = "--racks"
    """Name of the option or argument that holds the selection, for errors."""

    @property
    def needs_inlets(self) -> bool:
        """True if the racks depend on inlet temperatures."""
        return any(term.kind in ("hottest", "median") for term in self.terms)

    def check(self, hall: HallConfig, name: str = "") -> None:
        """Check that a hall has the selected racks.

        Raises:
            ConfigError: The hall does not have a selected rack or row, or not as many racks.
        """
        for term in self.terms:
            for number, (low, high) in zip(term.numbers, _valid_numbers(term, hall), strict=True):
                if not low <= number <= high:
                    of_hall = f" of {name}" if name else ""
                    raise ConfigError(
                        f"{self.option} {shortened(term.text)}: the hall{of_hall} has {hall.rows} "
                        f"rows of {hall.racks_per_row} racks; valid is {_valid_text(term, hall)}"
                    )

    def racks(self, hall: HallConfig, inlet_c: Reals | None = None) -> I64:
        """Return the indices of the selected racks of a hall of R racks, without duplicates.

        Racks are in the order of the terms. Of racks with equal inlets the first counts as warmer.

        Args:
            hall: Hall of a data center; ``check`` accepts it.
            inlet_c: Inlet temperature of each rack, C, (R,); needed if ``needs_inlets``.
        """
        by_heat = None
        if inlet_c is not None:
            by_heat = np.argsort(-rank(inlet_c), kind="stable")
        indices: list[int] = []
        for kind, numbers, _ in self.terms:
            if kind in ("rack", "place"):
                indices.append(_rack_index(numbers, hall))
            elif kind == "row":
                first = numbers[0] * hall.racks_per_row
                indices.extend(range(first, first + hall.racks_per_row))
            elif kind == "zone":
                indices.extend(hall_zones(hall).racks(numbers[0]).tolist())
            else:
                assert by_heat is not None, "inlet_c is needed"
                middle = len(by_heat) // 2
                chosen = by_heat[: numbers[0]] if numbers else by_heat[middle : middle + 1]
                indices.extend(chosen.tolist())
        return np.array(list(dict.fromkeys(indices)), dtype=np.int64)


def parse_racks(text: str, option: str = "--racks") -> RackSelection:
    """Parse a selection of racks such as ``7,2:5,row:3,hottest:10,median``.

    Args:
        text: The selection.
        option: Name of the option or argument that holds the selection, for errors.

    Raises:
        ConfigError: A term is not valid in any hall.
    """
    return RackSelection(tuple(_term(part, option) for part in text.split(",")), option)


def default_racks(hall: HallConfig) -> RackSelection:
    """Return the ten hottest racks, or fewer in a smaller hall, and the median one."""
    return parse_racks(f"hottest:{min(HOTTEST_BY_DEFAULT, hall.racks)},median")


def parse_rack(text: str, hall: HallConfig) -> int:
    """Return the index of the single rack of a hall that a text RACK or ROW:PLACE names.

    Raises:
        ConfigError: The text is no such term, or the hall has no such rack.
    """
    try:
        term = _term(text, "--rack")
        RackSelection((term,), "--rack").check(hall)
        if term.kind in ("rack", "place"):
            return _rack_index(term.numbers, hall)
    except ConfigError:
        pass
    raise ConfigError(
        f"--rack {text!r}: valid is a rack 0..{hall.racks - 1}, or ROW:PLACE up to "
        f"{hall.rows - 1}:{hall.racks_per_row - 1}"
    )


def _term(text: str, option: str) -> Term:
    """Parse one term of a selection; raise ``ConfigError`` if it has no valid form."""
    text = text.strip()
    head, colon, tail = text.partition(":")
    try:
        if text == "median":
            return Term("median", (), text)
        if head in ("row", "zone", "hottest") and colon:
            return Term(head, (parse_whole(tail),), text)
        if colon:
            return Term("place", (parse_whole(head), parse_whole(tail)), text)
        return Term("rack", (parse_whole(text),), text)
    except ValueError:
        shown = shortened(text)
    raise ConfigError(f"{option} {shown}: valid are {VALID_TERMS}, such as 7,2:5,row:3,hottest:10")


def _valid_numbers(term: Term, hall: HallConfig) -> tuple[tuple[int, int], ...]:
    """Return the lowest and highest valid value of each number of a term in a hall."""
    rows, places, racks = hall.rows - 1, hall.racks_per_row - 1, hall.racks
    if term.kind == "zone":
        return ((0, hall_zones(hall).count - 1),)
    return {
        "rack": ((0, racks - 1),),
        "place": ((0, rows), (0, places)),
        "row": ((0, rows),),
        "hottest": ((1, racks),),
        "median": (),
    }[term.kind]


def _valid_text(term: Term, hall: HallConfig) -> str:
    """Return the valid numbers of a term in a hall as text."""
    ranges = ":".join(f"{low}..{high}" for low, high in _valid_numbers(term, hall))
    return f"{term.kind}:{ranges}" if term.kind in ("row", "zone", "hottest") else ranges


def _rack_index(numbers: tuple[int, ...], hall: HallConfig) -> int:
    """Return the index of a rack from its number, or from its row and its place in the row."""
    if len(numbers) == 1:
        return numbers[0]
    row, place = numbers
    return row * hall.racks_per_row + place
