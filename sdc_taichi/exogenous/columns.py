"""Names and units of the columns of a user's table, if they differ from those that readers expect.

The syntax for a column is ``NAME=COLUMN``, or ``NAME:UNIT=COLUMN`` for numbers in another unit. The
user states the unit. It is never inferred from the name of a column or from its numbers.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import numpy as np

from sdc_taichi.errors import DataError, shortened, suggestion
from sdc_taichi.exogenous.synthetic import FUELS
from sdc_taichi.number_text import parse_number

Numbers = TypeVar("Numbers", float, np.ndarray)


class Unit(NamedTuple):
    """A unit of measurement, with its linear conversion to the unit that the reader expects."""

    symbol: str
    """Symbol for messages; empty for the unit that the reader expects."""
    size: float = 1.0
    """Size of this unit, in units that the reader expects."""
    zero: float = 0.0
    """Number in this unit that corresponds to 0 in the unit that the reader expects."""

    def convert(self, values: Numbers) -> Numbers:
        """Convert numbers from this unit to the unit that the reader expects."""
        return (values - self.zero) * self.size

    def invert(self, values: Numbers) -> Numbers:
        """Convert numbers from the unit that the reader expects to this unit."""
        return values / self.size + self.zero


def _units(**sizes: float) -> dict[str, Unit]:
    return {symbol: Unit(symbol, size) for symbol, size in sizes.items()}


LB_KG = 0.45359237
"""Kilograms per pound (NIST Special Publication 811, 2008, appendix B.8)."""
_TEMPERATURE = {
    "C": Unit("C"),
    "F": Unit("F", 1.0 / 1.8, 32.0),
    "K": Unit("K", 1.0, 273.15),
}
_ENERGY = _units(MWh=1.0, MW=1.0, kWh=1e-3, kW=1e-3, GWh=1e3, GW=1e3)
_UNITS: dict[str, dict[str, Unit]] = {
    "timestamp": {},
    **dict.fromkeys(FUELS, _ENERGY),
    "avg_CI": _units(
        **{"g/kWh": 1.0, "kg/MWh": 1.0, "kg/kWh": 1e3, "t/MWh": 1e3, "g/MJ": 3.6},
        **{"lb/MWh": LB_KG, "lb/kWh": LB_KG * 1e3},
    ),
    "cpu_load": {"1": Unit("1"), "%": Unit("%", 0.01)},
    "dry_bulb": _TEMPERATURE,
    "dew_point": _TEMPERATURE,
    "relative_humidity": {"%": Unit("%"), "1": Unit("1", 100.0)},
    # Conventional inch and millimetre of mercury, NIST SP 811.
    "pressure": _units(Pa=1.0, hPa=100.0, mbar=100.0, kPa=1e3, inHg=3386.389, mmHg=133.3224),
}
"""Valid units of each column; the first is the unit that the reader expects."""
COLUMN_NAMES = tuple(_UNITS)
"""Column names that the readers know."""
_RANGE = re.compile(r"([kM]?W),(.+)\.\.(.+)")
_RANGE_EXAMPLE = "kW,120..800 (power when idle and at full load)"


class ColumnMap(NamedTuple):
    """Column names and units of a user's table, by the names that the readers expect."""

    names: Mapping[str, str]
    """Column names in the table."""
    units: Mapping[str, Unit]
    """Units of columns, if the user has stated them."""

    def unit(self, name: str) -> Unit:
        """Return the unit of a column; without a stated unit, the one that the reader expects."""
        return self.units.get(name, Unit(""))

    def notes(self) -> list[str]:
        """Return notes that say which column was read as which quantity."""
        return [
            f"{column} read as {name}" + (f", in {unit.symbol}" if unit.symbol else "")
            for name, column in self.names.items()
            for unit in [self.unit(name)]
        ]


def column_map(columns: Mapping[str, str]) -> ColumnMap:
    """Parse the user's column names and units.

    Args:
        columns: column names in the table, by ``NAME`` or ``NAME:UNIT``.

    Raises:
        DataError: a name is unknown or repeated, or the column cannot have the unit.
    """
    names: dict[str, str] = {}
    units: dict[str, Unit] = {}
    for key, column in columns.items():
        name, colon, symbol = key.partition(":")
        if name not in _UNITS or name in names:
            raise DataError(
                f"column {shortened(key)}: expected each name once, of "
                f"{', '.join(COLUMN_NAMES)}{suggestion(name, COLUMN_NAMES)}"
            )
        names[name] = column
        if colon:
            units[name] = _unit(name, symbol)
    return ColumnMap(names, units)


def _unit(name: str, symbol: str) -> Unit:
    known = _UNITS[name]
    if symbol in known:
        return known[symbol]
    if name == "cpu_load" and (bounds := _RANGE.fullmatch(symbol)):
        try:
            idle, full = parse_number(bounds[2]), parse_number(bounds[3])
        except ValueError:
            idle = full = 0.0
        if 0.0 <= idle < full:
            return Unit(symbol, 1.0 / (full - idle), idle)
    valid = [*known, _RANGE_EXAMPLE] if name == "cpu_load" else list(known)
    raise DataError(
        f"column {name}: unit {shortened(symbol)}, expected "
        f"{'one of ' + ', '.join(valid) if valid else 'none'}{suggestion(symbol, list(known))}"
    )
