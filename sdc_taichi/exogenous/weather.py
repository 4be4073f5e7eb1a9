"""Reader of weather files: EnergyPlus EPW, and Parquet files that `data import` wrote."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous import files, series_file
from sdc_taichi.exogenous.psychrometrics import standard_pressure_pa, wet_bulb_c
from sdc_taichi.exogenous.series import (
    OUTDOOR_LIMITS_C,
    DesignConditions,
    FloatArray,
    Series,
    Weather,
    rarely_exceeded,
)
from sdc_taichi.exogenous.year_clock import (
    DAYS_PER_MONTH,
    DAYS_PER_YEAR,
    FIRST_DAY_OF_MONTH,
    HOURS_PER_YEAR,
    MINUTES_PER_DAY,
    UTC_OFFSETS_H,
    YEARS,
)
from sdc_taichi.number_text import parse_number, parse_whole
from sdc_taichi.user_file import MOST_TABLE_BYTES, open_input, read_bytes

HEADER_LINES = 8
"""Number of header lines before the first row of data."""
DATA_COLUMNS = 35
"""Number of columns in a row of data."""
PRESSURE_LIMITS_PA = (31_000.0, 120_000.0)
"""Limits of station pressure in EPW files, in Pa."""


class _Column(NamedTuple):
    """A column of EPW files (EnergyPlus Auxiliary Programs, EPW data dictionary)."""

    name: str
    """Name for messages."""
    limits: tuple[float, float]
    """Smallest and largest valid value."""
    missing: float
    """Number that stands for a missing value."""
    hint: str = ""
    """Probable cause of a value outside the limits, for messages."""


_FAHRENHEIT = " C (degrees Fahrenheit taken for C?)"
_YEAR = "year"
_MONTH, _DAY, _HOUR = "month (column 2)", "day (column 3)", "hour (column 4)"
_DRY_BULB = _Column("dry bulb (column 7)", OUTDOOR_LIMITS_C, 99.9, _FAHRENHEIT)
HUMIDITY_LIMITS_PCT = (0.0, 110.0)
"""Limits of relative humidity, in %; values above 100 % count as 100 %."""
_DEW_POINT = _Column("dew point (column 8)", OUTDOOR_LIMITS_C, 99.9, _FAHRENHEIT)
_HUMIDITY = _Column("relative humidity (column 9)", HUMIDITY_LIMITS_PCT, 999.0)
_PRESSURE = _Column("station pressure (column 10)", PRESSURE_LIMITS_PA, 999_999.0)
_MEASURED = (_DRY_BULB, _DEW_POINT, _HUMIDITY, _PRESSURE)
_COLUMN_NAMES = [_YEAR, _MONTH, _DAY, _HOUR, "minute", "source", *(c.name for c in _MEASURED)]
"""Names of the first columns of a row; no other columns are read."""
_USED = (_DRY_BULB, _HUMIDITY, _PRESSURE)
"""Columns from which the weather is built; the dew point is only checked."""
_DEW_POINT_SLACK_K = 0.2
"""Largest valid excess of a dew point above the dry bulb, in K; both are rounded in files."""
MOST_PRESSURE_SHARE = 0.05
"""Largest valid difference of a month's mean pressure from the standard atmosphere, as a share of
the latter. Weather and climate cause up to 0.03 at inhabited elevations."""
MOST_RISE_K = 15.0
"""Largest change of the dry bulb within an hour without a warning, in K. Weather seldom exceeds it;
damaged records do."""
_COOLING_CELLS = {"outdoor_c": 3, "wet_bulb_c": 9}
"""Cells of the design conditions, counted from the cell ``Cooling``."""
_EXTREME_OUTDOOR_CELL = -3
"""Cell of the highest dry bulb in 20 years; the lowest and highest in 50 years follow it."""
_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
_LONGEST_LINE = 4096
_DAYS_PER_MONTH = np.array(DAYS_PER_MONTH)
_FIRST_DAY_OF_MONTH = np.array(FIRST_DAY_OF_MONTH)


def read_epw(path: str | Path) -> Weather:
    """Read an EPW file: dry bulb, relative humidity and station pressure; compute wet bulb.

    Hour k in the format is the hour that ends at k, in local standard time. Months may be from
    different years, as in typical years. The file may have several years, and several rows per
    hour (DATA PERIODS). 29 February is removed. Missing codes and absent hours are interpolated, up
    to 24 h. The function also reads Parquet files written by ``data import``.

    Args:
        path: EPW or Parquet file.

    Returns:
        Weather for whole years of 365 days.

    Raises:
        DataError: the data are not valid; the message names file, row, column, value, valid values.
    """
    path = Path(path)
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path)
        if metadata is None:
            raise DataError(
                f"{path}: Parquet without sdc_taichi metadata (location, UTC offset, resolution), "
                "expected an EPW file or one written by `data import`"
            )
        return _read_imported(path, metadata)
    lines = _decoded(read_bytes(path, MOST_TABLE_BYTES, DataError)).splitlines()
    location = _location(path, lines)
    per_hour = _records_per_hour(path, lines)
    hours, table, notes = _hours(_rows(path, lines))
    positions = _positions(table, hours, per_hour)
    minutes = 60.0 / per_hour
    columns, column_notes = _columns(table)
    values, rows, absent_notes = table.spread(columns, positions)
    names = [column.name for column in _USED]
    values = files.fill_gaps(path, values, minutes, names, rows)
    notes += spike_notes(values[:, 0], minutes, rows)
    values, year_notes = files.whole_years(path, values, float(hours[0]) * 60.0, minutes)
    air = Air(*values.T)
    notes += column_notes + absent_notes + year_notes
    notes += _pressure_notes(air.pressure_pa, minutes, location["elevation_m"])
    design, design_notes = _design_conditions(lines)
    year = _calendar_year(table, hours, len(values) * minutes)
    return make_weather(path, location, minutes, air, notes + design_notes, design, year=year)


def _calendar_year(
    table: files.Table, hours: NDArray[np.int64], length_minutes: float
) -> int | None:
    """Return the calendar year of most of the first 365 days; None for typical years.

    The months of a typical year are of different years, so that its dates do not follow each other.

    Args:
        table: rows of the file, without 29 February.
        hours: hour of the 365-day year of each row, (T,).
        length_minutes: length of the values that were cut to whole years, in minutes.
    """
    import pandas as pd

    years = pd.to_numeric(table.frame[_YEAR], errors="coerce").to_numpy(np.float64)
    is_new_year = np.diff(hours, prepend=hours[0]) < 0
    is_valid = (years >= YEARS[0]) & (years <= YEARS[1])
    if not np.array_equal(np.diff(years, prepend=years[0]), is_new_year) or not is_valid.all():
        return None
    first = np.datetime64(str(int(years[0])), "Y")
    return files.first_calendar_year(first, float(hours[0]) * 60.0, length_minutes)


class Air(NamedTuple):
    """Outdoor air, for whole years."""

    outdoor_c: FloatArray
    """Dry bulb, in C, (T,)."""
    relative_humidity_pct: FloatArray
    """Relative humidity, in %, (T,)."""
    pressure_pa: FloatArray
    """Station pressure, in Pa, (T,)."""


def make_weather(
    path: Path,
    location: Mapping[str, Any],
    minutes: float,
    air: Air,
    notes: Sequence[str],
    design: DesignConditions | None = None,
    *,
    year: int | None,
) -> Weather:
    """Build the weather of measured air, and compute its wet bulb.

    Args:
        path: file from which the data were read.
        location: location of the station, as fields of ``Weather``.
        minutes: resolution, in minutes.
        air: measured air.
        notes: repairs and warnings.
        design: design conditions in the file; None if it has none.
        year: calendar year of most of the first 365 days; None for a typical year.
    """
    wet_bulb, all_notes = wet_bulb_c(*air), list(notes)

    def series(name: str, unit: str, x: FloatArray) -> Series:
        return Series(
            x, minutes, name, unit, path.name, synthetic=False, notes=tuple(all_notes), year=year
        )

    if design is None:
        dry_c = rarely_exceeded(series("outdoor_c", "C", air.outdoor_c))
        wet_c = rarely_exceeded(series("wet_bulb_c", "C", wet_bulb))
        all_notes.append(
            f"no design conditions: plants are sized for a dry bulb of {dry_c:.1f} C and a wet "
            f"bulb of {wet_c:.1f} C, which this year exceeds for 0.4 % of its hours"
        )
    return Weather(
        **location,
        outdoor_c=series("outdoor_c", "C", air.outdoor_c),
        wet_bulb_c=series("wet_bulb_c", "C", wet_bulb),
        relative_humidity_pct=series("relative_humidity_pct", "%", air.relative_humidity_pct),
        pressure_pa=series("pressure_pa", "Pa", air.pressure_pa),
        design=design,
    )


def spike_notes(outdoor_c: FloatArray, minutes: float, rows: NDArray[np.int64]) -> list[str]:
    """Return a warning about changes of the dry bulb that are hardly weather.

    Args:
        outdoor_c: dry bulb, in C, in the order of the file, (T,).
        minutes: resolution, in minutes.
        rows: row of the file that each value came from, for the message, (T,).
    """
    lag = max(1, round(60.0 / minutes))
    change_k = np.abs(outdoor_c[lag:] - outdoor_c[:-lag]) / max(1.0, minutes / 60.0)
    steep = change_k > MOST_RISE_K
    if not steep.any():
        return []
    return [
        f"warning: {int(steep.sum())} changes of the dry bulb by more than {MOST_RISE_K:g} K in an "
        f"hour kept, up to {change_k.max():.1f} K (first: row {int(rows[lag + np.argmax(steep)])})"
    ]


def read_city(path: str | Path) -> str:
    """Return the city of the station in the header of a weather file; empty if there is none.

    Args:
        path: EPW file, or Parquet file written by ``data import``.

    Raises:
        DataError: the file cannot be read, or has another format.
    """
    path = Path(path)
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path) or {}
        return str(metadata.get("label", "")).split(", ")[0]
    line = _first_line(path)
    _location(path, [line])
    city = line.split(",")[1].strip()
    return "" if city == "-" else city


def read_elevation_m(path: str | Path) -> float:
    """Return the elevation of the station in the header of a weather file, in m above sea level.

    Args:
        path: EPW file, or Parquet file written by ``data import``.

    Raises:
        DataError: the file cannot be read, has another format, or has no elevation.
    """
    path = Path(path)
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path) or {}
        return float(series_file.metadata_value(path, metadata, "elevation_m", float))
    return float(_location(path, [_first_line(path)])["elevation_m"])


def _first_line(path: Path) -> str:
    with open_input(path, MOST_TABLE_BYTES, DataError) as file:
        return (_decoded(file.read(_LONGEST_LINE)).splitlines() or [""])[0]


def _decoded(content: bytes) -> str:
    """Decode the text of an EPW file; place names may be in UTF-8 or Latin-1."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _location(path: Path, lines: list[str]) -> dict[str, Any]:
    """Parse the location of the station in the first line, as fields of ``Weather``."""
    fields = [x.strip() for x in lines[0].split(",")] if lines else [""]
    if fields[0].upper() != "LOCATION":
        raise DataError(
            f"{path}: row 1: starts with {fields[0][:20]!r}, expected LOCATION (an EPW file)"
        )
    if len(fields) < 10:
        raise DataError(f"{path}: row 1: {len(fields)} fields, expected 10 of LOCATION")
    label = ", ".join(x for x in (fields[1], fields[2], fields[3]) if x and x != "-")
    location: dict[str, Any] = {"label": label}
    for field, name, at, low, high in (
        ("latitude_deg", "latitude", 6, -90.0, 90.0),
        ("longitude_deg", "longitude", 7, -180.0, 180.0),
        ("utc_offset_h", "UTC offset", 8, *UTC_OFFSETS_H),
        ("elevation_m", "elevation", 9, -1000.0, 9999.9),
    ):
        try:
            value = parse_number(fields[at])
        except ValueError:
            value = np.nan
        if not low <= value <= high:
            raise files.fault(path, 1, name, fields[at], f"a number from {low:g} to {high:g}")
        location[field] = value
    return location


def _design_conditions(lines: list[str]) -> tuple[DesignConditions | None, list[str]]:
    """Parse the design conditions in the header; return None if there are none, and notes."""
    for line in lines[1:HEADER_LINES]:
        cells = [x.strip() for x in line.split(",")]
        if cells[0].upper() != "DESIGN CONDITIONS" or "Cooling" not in cells:
            continue
        cooling = cells.index("Cooling")
        conditions: dict[str, Any] = {}
        try:
            for name, at in _COOLING_CELLS.items():
                conditions[name] = parse_number(cells[cooling + at])
            if "Extremes" in cells[cooling:]:
                conditions["extreme_outdoor_c"] = parse_number(cells[_EXTREME_OUTDOOR_CELL])
            return DesignConditions(**conditions), []
        except (ValueError, IndexError, DataError) as error:
            note = f"warning: design conditions of the header are not usable ({error})"
            return None, [note]
    return None, []


def _pressure_notes(pressure: FloatArray, minutes: float, elevation_m: float) -> list[str]:
    """Return a warning about months whose mean pressure does not fit the station's elevation."""
    standard_pa = float(standard_pressure_pa(elevation_m))
    days = pressure.reshape(-1, DAYS_PER_YEAR, round(MINUTES_PER_DAY / minutes))
    means_pa = np.array([days[:, a:b].mean() for a, b in pairwise(FIRST_DAY_OF_MONTH)])
    odd = np.abs(means_pa / standard_pa - 1.0) > MOST_PRESSURE_SHARE
    if not odd.any():
        return []
    months = ", ".join(name for name, is_odd in zip(_MONTHS, odd, strict=True) if is_odd)
    return [
        f"warning: station pressure of {means_pa[odd].mean() / 1e3:.1f} kPa in {months} does not "
        f"fit the elevation of {elevation_m:g} m, which has about {standard_pa / 1e3:.1f} kPa"
    ]


def _records_per_hour(path: Path, lines: list[str]) -> int:
    """Return the number of records per hour, from the DATA PERIODS line (last of the header)."""
    if len(lines) < HEADER_LINES:
        raise DataError(f"{path}: row {len(lines)}: ends in the header, expected 8 header lines")
    fields = [x.strip() for x in lines[HEADER_LINES - 1].split(",")]
    if fields[0].upper() != "DATA PERIODS":
        raise DataError(
            f"{path}: row 8: starts with {fields[0][:20]!r}, expected DATA PERIODS "
            "(the last of 8 header lines)"
        )
    text = fields[2] if len(fields) > 2 else ""
    with contextlib.suppress(ValueError):
        if (per_hour := parse_whole(text)) > 0 and 60 % per_hour == 0:
            return per_hour
    raise files.fault(path, 8, "records per hour", text, "a divisor of 60")


def _rows(path: Path, lines: list[str]) -> files.Table:
    """Return the first columns of the data rows, named as in ``_COLUMN_NAMES``."""
    import pandas as pd

    data = lines[HEADER_LINES:]
    while data and not data[-1].strip():
        data.pop()
    if not data:
        raise DataError(f"{path}: row {HEADER_LINES}: no rows of data after the header")
    cells = []
    for at, line in enumerate(data):
        row = line.split(",", len(_COLUMN_NAMES))
        if len(row) < len(_COLUMN_NAMES):
            raise DataError(
                f"{path}: row {HEADER_LINES + 1 + at}: {len(row)} columns, "
                f"expected {DATA_COLUMNS} (at least the first 10)"
            )
        cells.append(row[: len(_COLUMN_NAMES)])
    rows = range(HEADER_LINES + 1, HEADER_LINES + 1 + len(cells))
    return files.Table(path, pd.DataFrame(cells, rows, _COLUMN_NAMES, dtype=str))


def _hours(table: files.Table) -> tuple[NDArray[np.int64], files.Table, list[str]]:
    """Return each row's hour of the 365-day year, (T,), rows without 29 February, and notes."""
    dates = []
    for column, high in ((_MONTH, 12), (_DAY, 31), (_HOUR, 24)):
        values = table.numbers(column, 1.0, high)
        wrong = np.isnan(values) | (values != np.round(values))
        table.refuse(column, wrong, f"a whole number from 1 to {high}")
        dates.append(values.astype(np.int64))
    month, day, hour = dates
    leap = (month == 2) & (day == 29)
    wrong = day > _DAYS_PER_MONTH[month - 1] + leap
    table.refuse(_DAY, wrong, f"a day of month {month[np.argmax(wrong)]}")
    of_year = (_FIRST_DAY_OF_MONTH[month - 1] + day - 1) * 24 + hour - 1
    if leap.all():
        raise DataError(
            f"{table.path}: row {HEADER_LINES + 1}: only 29 February, expected 365 days"
        )
    notes = [f"29 February removed ({int(leap.sum())} rows)"] if leap.any() else []
    return of_year[~leap], files.Table(table.path, table.frame[~leap]), notes


def _positions(table: files.Table, hours: NDArray[np.int64], per_hour: int) -> NDArray[np.int64]:
    """Return the position of each row on a regular grid that begins at the first row, (T,)."""
    rows = table.frame.index.to_numpy()
    starts = np.flatnonzero(np.diff(hours, prepend=hours[0] - 1))
    counts = np.diff(starts, append=hours.size)
    if (counts > per_hour).any():
        row = int(rows[starts[np.argmax(counts > per_hour)] + per_hour])
        raise DataError(
            f"{table.path}: row {row}, column hour: repeats the hour above, expected {per_hour} "
            f"row{'s' if per_hour > 1 else ''} per hour (DATA PERIODS)"
        )
    if (counts < per_hour).any():
        at = int(np.argmax(counts < per_hour))
        raise DataError(
            f"{table.path}: row {int(rows[starts[at]])}, column hour: {int(counts[at])} rows in "
            f"the hour, expected {per_hour} (DATA PERIODS)"
        )
    steps = np.diff(hours[starts]) % HOURS_PER_YEAR
    bad = steps - 1 > files.MAX_GAP_H
    if bad.any():
        at = int(np.argmax(bad)) + 1
        month, day, hour = table.frame.iloc[starts[at]][[_MONTH, _DAY, _HOUR]].str.strip()
        back = steps[at - 1] > HOURS_PER_YEAR // 2
        valid = (
            "an hour after the row above"
            if back
            else f"gaps of at most 24 h, not {int(steps[at - 1] - 1)} h"
        )
        stamp = f"month {month} day {day} hour {hour}"
        raise files.fault(table.path, int(rows[starts[at]]), "date", stamp, valid)
    hour_position = np.concatenate([[0], np.cumsum(steps)])
    within = np.arange(hours.size) - np.repeat(starts, counts)
    return np.asarray(np.repeat(hour_position, counts) * per_hour + within, dtype=np.int64)


def _columns(table: files.Table) -> tuple[FloatArray, list[str]]:
    """Return dry bulb, relative humidity and pressure, (T, 3), NaN for missing, and notes."""
    import pandas as pd

    values, notes = {}, []
    for column in _MEASURED:
        # Files write missing codes with any number of decimals.
        text = table.frame[column.name]
        is_code = pd.to_numeric(text, errors="coerce") == column.missing
        known = files.Table(table.path, text.mask(is_code, "nan").to_frame())
        values[column] = known.numbers(column.name, *column.limits, column.hint)
        missing = int(np.isnan(values[column]).sum())
        if missing and column in _USED:
            notes.append(f"{missing} missing values of {column.name} interpolated")
    check_dew_point(table, _DEW_POINT.name, values[_DEW_POINT], values[_DRY_BULB])
    values[_HUMIDITY], humidity_notes = capped_humidity(values[_HUMIDITY])
    notes += humidity_notes
    known_pa = values[_PRESSURE][~np.isnan(values[_PRESSURE])]
    if known_pa.size and known_pa.std() < 100.0:
        notes.append(f"warning: station pressure is nearly constant ({known_pa.mean():.0f} Pa)")
    return np.stack([values[column] for column in _USED], axis=1), notes


def check_dew_point(
    table: files.Table, column: str, dew_point_c: FloatArray, outdoor_c: FloatArray
) -> None:
    """Check that no dew point is above the dry bulb, both in C, (T,).

    Raises:
        DataError: a dew point is too high; the message names file, row, column and value.
    """
    above = dew_point_c > outdoor_c + _DEW_POINT_SLACK_K
    dry_bulb = f"{outdoor_c[np.argmax(above)]:g} C"
    table.refuse(column, above, f"at most the dry bulb of {dry_bulb} (the wet bulb would be above)")


def capped_humidity(percent: FloatArray) -> tuple[FloatArray, list[str]]:
    """Limit relative humidity, in %, (T,), to 100 %; return it with notes."""
    over = percent > 100.0
    if not over.any():
        return percent, []
    notes = [f"{int(over.sum())} values of relative humidity over 100 % set to 100 %"]
    return np.where(over, 100.0, percent), notes


_QUANTITIES = {
    "outdoor_c": series_file.Quantity("C", *OUTDOOR_LIMITS_C),
    "wet_bulb_c": series_file.Quantity("C", -100.0, 70.0),
    "relative_humidity_pct": series_file.Quantity("%", 0.0, 100.0),
    "pressure_pa": series_file.Quantity("Pa", *PRESSURE_LIMITS_PA),
}
"""Quantities in a weather file that ``data import`` wrote."""
_PLACE_FIELDS = ("latitude_deg", "longitude_deg", "elevation_m", "utc_offset_h")


def _read_imported(path: Path, metadata: dict[str, Any]) -> Weather:
    series = series_file.read_series(path, metadata, "weather", _QUANTITIES)
    outdoor_c, wet_bulb = series["outdoor_c"].values, series["wet_bulb_c"].values
    above = wet_bulb > outdoor_c + 1e-6
    if above.any():
        at = int(np.argmax(above))
        valid = f"at most the dry bulb of {outdoor_c[at]:g} C"
        raise files.fault(path, at + 1, "wet_bulb_c", float(wet_bulb[at]), valid)
    fields: dict[str, Any] = {
        name: series_file.metadata_value(path, metadata, name, float) for name in _PLACE_FIELDS
    }
    fields |= series
    label = series_file.metadata_value(path, metadata, "label", str)
    design = _imported_design(path, metadata)
    return Weather(label=label, design=design, **fields)


def _imported_design(path: Path, metadata: dict[str, Any]) -> DesignConditions | None:
    """Return the design conditions that ``data import`` stored; None if there are none."""
    if metadata.get("design") is None:
        return None
    stored = series_file.metadata_value(path, metadata, "design", dict)
    try:
        return DesignConditions(**{name: float(value) for name, value in stored.items()})
    except (TypeError, ValueError, DataError) as error:
        raise DataError(
            f"{path}: metadata design: {shortened(stored)}, expected design conditions as written "
            f"by `data import` ({error})"
        ) from None
