"""Weather in tables, such as the record of a station on the roof."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

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
from sdc_taichi.exogenous.stamps import HAS_OFFSET
from sdc_taichi.exogenous.weather import (
    HUMIDITY_LIMITS_PCT,
    PRESSURE_LIMITS_PA,
    Air,
    capped_humidity,
    check_dew_point,
    make_weather,
)

if TYPE_CHECKING:
    import pandas as pd

_LIMITS = {
    "dry_bulb": OUTDOOR_LIMITS_C,
    "dew_point": (-100.0, 60.0),
    "relative_humidity": HUMIDITY_LIMITS_PCT,
    "pressure": PRESSURE_LIMITS_PA,
}

_FAHRENHEIT = " C (degrees Fahrenheit are read with --map dry_bulb:F=COLUMN)"


class Place(NamedTuple):
    """Where a station is."""

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
    """Read weather from a table with ``timestamp`` and ``dry_bulb``.

    It also has ``relative_humidity``, or ``dew_point`` from which it follows (ASHRAE Fundamentals
    2017, ch. 1), and may have ``pressure``, which is else that of the standard atmosphere. Stamps
    are in local standard time, or have a UTC offset each; 29 February is removed, and gaps of up
    to 24 h are interpolated.

    Args:
        path: CSV or Parquet.
        place: where the station is.
        columns: the names above, with their units where they are others than C, % and Pa, and the
            names in the table, such as ``{"dry_bulb:F": "Temp", "dew_point:F": "Dew"}``
            (``exogenous.columns``).
        stamp: whether a stamp marks the start or the end of its interval.

    Returns:
        Weather, resolution of the file, whole years of 365 days.

    Raises:
        DataError: names file, row, column, value and what would be valid.
    """
    path = Path(path)
    _check(place)
    named = column_map(columns)
    frame, first_row = files.read_table(path, named.names)
    humid = "relative_humidity" if "relative_humidity" in frame.columns else "dew_point"
    files.require_columns(path, frame, ("timestamp", "dry_bulb", humid))
    rows = first_row + np.arange(len(frame))
    stamps = _stamps(path, frame["timestamp"].str.strip(), rows, place.utc_offset_h)
    minutes, positions = files.grid_of_stamps(path, stamps, rows, "timestamp")
    if stamp == "end":
        stamps = stamps - np.timedelta64(round(minutes * 60), "s")
    read = ["dry_bulb", humid, *(["pressure"] if "pressure" in frame.columns else [])]
    values, notes = _numbers(path, frame, read, rows, named)
    values = files.spread(values, positions)
    if len(values) > len(frame):
        notes.append(f"{len(values) - len(frame)} absent rows interpolated")
    at = rows[np.minimum(np.searchsorted(positions, np.arange(len(values))), rows.size - 1)]
    filled = [
        files.fill_gaps(path, column, minutes, name, at)
        for name, column in zip(read, values.T, strict=True)
    ]
    values, since, leap_notes = files.without_leap_days(
        np.stack(filled, axis=1), stamps[0], minutes
    )
    values, year_notes = files.whole_years(path, values, since, minutes)
    notes += leap_notes + year_notes
    outdoor, humidity = values[:, 0], values[:, 1]
    if humid == "dew_point":
        # Both are rounded, so that it may be slightly above.
        humidity = relative_humidity_from_dew_point_pct(outdoor, np.minimum(humidity, outdoor))
    if "pressure" in read:
        pressure = values[:, 2]
    else:
        pressure = np.full(len(values), float(standard_pressure_pa(place.elevation_m)))
        notes.append(f"pressure of the standard atmosphere at {place.elevation_m:g} m")
    return make_weather(path, place._asdict(), minutes, Air(outdoor, humidity, pressure), notes)


def _check(place: Place) -> None:
    limits = {
        "latitude": (place.latitude_deg, -90.0, 90.0),
        "longitude": (place.longitude_deg, -180.0, 180.0),
        "elevation": (place.elevation_m, -1000.0, 9999.9),
        "utc-offset": (place.utc_offset_h, -12.0, 14.0),
    }
    for name, (value, low, high) in limits.items():
        if not low <= value <= high:
            raise DataError(f"{name}: {value:g}, expected {low:g} to {high:g}")


def _stamps(
    path: Path, text: pd.Series[str], rows: NDArray[np.int64], utc_offset_h: float
) -> NDArray[np.datetime64]:
    """Stamps in local standard time, (T,)."""
    import pandas as pd

    parsed = pd.to_datetime(text, utc=True, errors="coerce", format="ISO8601")
    has_offset = text.str.contains(HAS_OFFSET, regex=True).to_numpy(dtype=bool)
    wrong = parsed.isna().to_numpy() | (has_offset != has_offset[0])
    if wrong.any():
        at = int(np.argmax(wrong))
        valid = "a time such as 2022-01-01 00:00:00, " + (
            "with its UTC offset as in the first row"
            if has_offset[0]
            else "local standard time, or with a UTC offset in each row"
        )
        raise files.fault(path, int(rows[at]), "timestamp", text.iloc[at], valid)
    stamps: NDArray[np.datetime64] = parsed.dt.tz_localize(None).to_numpy("datetime64[s]")
    return stamps + np.timedelta64(round(utc_offset_h * 3600) if has_offset[0] else 0, "s")


def _numbers(
    path: Path,
    frame: pd.DataFrame,
    read: list[str],
    rows: NDArray[np.int64],
    named: ColumnMap,
) -> tuple[FloatArray, list[str]]:
    """Columns as numbers in C, % and Pa, (T, columns), and notes."""
    notes = named.notes()
    values = {}
    for name in read:
        unit = named.unit(name)
        hint = _FAHRENHEIT if name == "dry_bulb" and not unit.symbol else ""
        x = files.numbers(path, frame[name], name, rows, *_LIMITS[name], hint, unit)
        if blank := int(np.isnan(x).sum()):
            notes.append(f"{blank} missing values of {name} interpolated")
        values[name] = x
    if "dew_point" in values:
        check_dew_point(path, "dew_point", rows, values["dew_point"], values["dry_bulb"])
    else:
        values["relative_humidity"], capped = capped_humidity(values["relative_humidity"])
        notes += capped
    return np.stack([values[name] for name in read], axis=1), notes
