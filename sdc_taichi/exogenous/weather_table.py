"""Reader of weather tables, such as the records of a weather station on a roof."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import files
from sdc_taichi.exogenous.columns import ColumnMap, column_map
from sdc_taichi.exogenous.psychrometrics import (
    relative_humidity_from_dew_point_pct,
    standard_pressure_pa,
)
from sdc_taichi.exogenous.series import OUTDOOR_LIMITS_C, FloatArray, Weather
from sdc_taichi.exogenous.weather import (
    HUMIDITY_LIMITS_PCT,
    PRESSURE_LIMITS_PA,
    Air,
    capped_humidity,
    check_dew_point,
    make_weather,
    spike_notes,
)
from sdc_taichi.exogenous.year_clock import UTC_OFFSETS_H

_LIMITS = {
    "dry_bulb": OUTDOOR_LIMITS_C,
    "dew_point": (-100.0, 60.0),
    "relative_humidity": HUMIDITY_LIMITS_PCT,
    "pressure": PRESSURE_LIMITS_PA,
}

_FAHRENHEIT = " C (degrees Fahrenheit are read with --map dry_bulb:F=COLUMN)"


class Place(NamedTuple):
    """Location of a weather station."""

    label: str
    """Name of the place."""
    latitude_deg: float
    """Latitude, in degrees north."""
    longitude_deg: float
    """Longitude, in degrees east."""
    elevation_m: float
    """Elevation above sea level, in m."""
    utc_offset_h: float
    """Local standard time minus UTC, in h."""


def read_weather_table(
    path: str | Path,
    place: Place,
    *,
    columns: Mapping[str, str],
    stamp: Literal["start", "end"] = "start",
) -> Weather:
    """Read weather from a table with time stamps and dry bulb.

    The table has ``timestamp`` and ``dry_bulb``, and either ``relative_humidity`` or ``dew_point``,
    from which humidity is computed (ASHRAE Fundamentals 2017, ch. 1). It may have ``pressure``;
    otherwise the pressure of the standard atmosphere is used. Stamps are in local standard time,
    or all have a UTC offset. 29 February is removed, and gaps of up to 24 h are interpolated.

    Args:
        path: CSV or Parquet file.
        place: location of the station.
        columns: column names in the table, by the names above, with the unit if it is not C, % or
            Pa, such as ``{"dry_bulb:F": "Temp", "dew_point:F": "Dew"}`` (``exogenous.columns``).
        stamp: moment of an interval that its stamp marks, ``start`` or ``end``.

    Returns:
        Weather at the resolution of the file, for whole years of 365 days.

    Raises:
        DataError: the data are not valid; the message names file, row, column, value, valid values.
    """
    path = Path(path)
    _check(place)
    named = column_map(columns)
    table = files.read_table(path, named.names)
    humid = "relative_humidity" if "relative_humidity" in table.frame.columns else "dew_point"
    table.require_columns("timestamp", "dry_bulb", humid)
    stamps = _local_stamps(table, place.utc_offset_h)
    minutes, positions = files.grid_of_stamps(table, stamps, "timestamp")
    if stamp == "end":
        stamps = stamps - np.timedelta64(round(minutes * 60), "s")
    names = ["dry_bulb", humid, *(["pressure"] if "pressure" in table.frame.columns else [])]
    values, notes = _numbers(table, names, named)
    values, rows, absent_notes = table.spread(values, positions)
    values = files.fill_gaps(path, values, minutes, names, rows)
    notes += spike_notes(values[:, 0], minutes, rows)
    values, year, year_notes = files.calendar_years(path, values, stamps[0], minutes)
    notes += absent_notes + year_notes
    outdoor, humidity = values[:, 0], values[:, 1]
    if humid == "dew_point":
        # Both values are rounded, so the dew point may be slightly above the dry bulb.
        humidity = relative_humidity_from_dew_point_pct(outdoor, np.minimum(humidity, outdoor))
    if "pressure" in names:
        pressure = values[:, 2]
    else:
        pressure = np.full(len(values), float(standard_pressure_pa(place.elevation_m)))
        notes.append(f"pressure of the standard atmosphere at {place.elevation_m:g} m")
    air = Air(outdoor, humidity, pressure)
    return make_weather(path, place._asdict(), minutes, air, notes, year=year)


def _check(place: Place) -> None:
    limits = {
        "latitude": (place.latitude_deg, -90.0, 90.0),
        "longitude": (place.longitude_deg, -180.0, 180.0),
        "elevation": (place.elevation_m, -1000.0, 9999.9),
        "utc-offset": (place.utc_offset_h, *UTC_OFFSETS_H),
    }
    for name, (value, low, high) in limits.items():
        if not low <= value <= high:
            raise DataError(f"{name}: {value:g}, expected {low:g} to {high:g}")


def _local_stamps(table: files.Table, utc_offset_h: float) -> NDArray[np.datetime64]:
    """Return the stamps in local standard time, (T,)."""
    stamps, has_offset = table.stamps("timestamp")
    valid = "a time such as 2022-01-01 00:00:00, " + (
        "with its UTC offset as in the first row"
        if has_offset[0]
        else "local standard time, or with a UTC offset in each row"
    )
    table.refuse("timestamp", np.isnat(stamps) | (has_offset != has_offset[0]), valid)
    return stamps + np.timedelta64(round(utc_offset_h * 3600) if has_offset[0] else 0, "s")


def _numbers(
    table: files.Table, names: list[str], named: ColumnMap
) -> tuple[FloatArray, list[str]]:
    """Return the columns as numbers in C, % and Pa, (T, columns), and notes."""
    notes = named.notes()
    values = {}
    for name in names:
        unit = named.unit(name)
        hint = _FAHRENHEIT if name == "dry_bulb" and not unit.symbol else ""
        values[name] = table.numbers(name, *_LIMITS[name], hint, unit)
        if blank := int(np.isnan(values[name]).sum()):
            notes.append(f"{blank} missing values of {name} interpolated")
    if "dew_point" in values:
        check_dew_point(table, "dew_point", values["dew_point"], values["dry_bulb"])
    else:
        values["relative_humidity"], capped = capped_humidity(values["relative_humidity"])
        notes += capped
    return np.stack([values[name] for name in names], axis=1), notes
