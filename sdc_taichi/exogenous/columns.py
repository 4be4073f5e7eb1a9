"""Names and units of the columns of a table, where they differ from those that readers expect.

A column is named ``NAME=COLUMN``, or ``NAME:UNIT=COLUMN`` where its numbers are in another unit.
The user states the unit. It is never inferred from the name of a column or from its numbers.
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
    """A unit, as a linear function of the unit that the reader expects."""

    symbol: str
    """Symbol, for messages; empty for the unit of the reader."""
    size: float = 1.0
    """One of this unit in the unit of the reader."""
    zero: float = 0.0
    """The number in this unit that is 0 in the unit of the reader."""

    def convert(self, values: Numbers) -> Numbers:
        """Numbers in the unit of the reader."""
        return (values - self.zero) * self.size

    def invert(self, values: Numbers) -> Numbers:
        """Numbers in this unit."""
        return values / self.size + self.zero


def _units(**sizes: float) -> dict[str, Unit]:
    return {symbol: Unit(symbol, size) for symbol, size in sizes.items()}


LB_KG = 0.45359237
"""Kilograms of a pound (NIST Special Publication 811, 2008, appendix B.8)."""
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
"""Units of each column, those of the reader first."""
COLUMN_NAMES = tuple(_UNITS)
"""Names of columns that the readers know."""
_RANGE = re.compile(r"([kM]?W),(.+)\.\.(.+)")
_RANGE_EXAMPLE = "kW,120..800 (power when idle and at full load)"


class ColumnMap(NamedTuple):
    """Columns of a table by the names that the readers expect."""

    names: Mapping[str, str]
    """Names in the table."""
    units: Mapping[str, Unit]
    """Units of the columns whose unit the user has stated."""

    def unit(self, name: str) -> Unit:
        """Unit of a column."""
        return self.units.get(name, Unit(""))

    def notes(self) -> list[str]:
        """Notes that say which column was read as which quantity."""
        return [
            f"{column} read as {name}" + (f", in {unit.symbol}" if unit.symbol else "")
            for name, column in self.names.items()
            for unit in [self.unit(name)]
        ]


def column_map(columns: Mapping[str, str]) -> ColumnMap:
    """Names and units of columns.

    Args:
        columns: names in the table, by ``NAME`` or ``NAME:UNIT``.

    Raises:
        DataError: a name that is not known or comes twice, or a unit that the column cannot have.
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
