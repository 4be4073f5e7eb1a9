"""Reader of grid carbon intensity: average intensity and hourly generation by fuel, with stamps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError, shortened
from sdc_taichi.exogenous import files, series_file
from sdc_taichi.exogenous.columns import ColumnMap, column_map
from sdc_taichi.exogenous.series import FloatArray, Series
from sdc_taichi.exogenous.series_file import Quantity
from sdc_taichi.exogenous.stamps import Stamp, by_start_of_interval, region_notes
from sdc_taichi.exogenous.synthetic import FUELS, emission_factors
from sdc_taichi.exogenous.year_clock import UTC_OFFSETS_H

Pairing = Literal["local", "utc_rows"]
"""Treatment of UTC rows: moved to local standard time, or kept as if UTC were local time."""

MAX_CI_G_PER_KWH = 2000.0
"""Highest valid carbon intensity, in g/kWh."""
MIX_TOLERANCE_G = 1.0
"""Largest valid difference of ``avg_CI`` from the intensity of the fuel mix, in g/kWh."""
MOST_NEGATIVE_SHARE = 0.01
"""Largest valid sum of negative generation, as a share of all generation. Single hours with
negative values are errors of reports; plants that only consume at night have a lower share."""
_MAX_GENERATION_MWH = 1e7


def read_carbon(
    path: str | Path,
    utc_offset_h: float,
    stamp: Stamp = "auto",
    *,
    pairing: Pairing = "local",
    longitude_deg: float | None = None,
    columns: Mapping[str, str] = MappingProxyType({}),
) -> Series:
    """Read carbon intensity, and convert it to the site's local standard time.

    The table has ``timestamp`` with a UTC offset, and ``avg_CI`` in g CO2e/kWh. It may have
    generation by fuel (WND SUN WAT OIL NG COL NUC OTH, all eight, in any energy unit). A Parquet
    file written by ``data import`` is used unchanged, and must have the same UTC offset.

    Stamps are moved to local standard time, 29 February is removed, and hours before 1 January move
    to the end. EIA-930 stamps mark the end of the hour, but some authorities report the start, or
    did so until a certain day. ``stamp="auto"`` infers the meaning from solar generation, whose
    centre of gravity is after solar noon if stamps mark the end, and before it if they mark the
    start. It also detects one change within the file. Without solar generation it assumes the end.

    Args:
        path: CSV or Parquet file.
        utc_offset_h: local standard time minus UTC, in h, -12..14.
        stamp: moment of an interval that its stamp marks.
        pairing: ``"utc_rows"`` keeps the rows in UTC order, like the released SustainDC, which
            pairs UTC hours with local ones.
        longitude_deg: longitude of the site in degrees east, for ``"auto"``, and for a warning if
            solar generation does not fit it. None stands for the middle of the time zone, without
            a warning.
        columns: column names in the table, by the names above, with the unit if it differs, such
            as ``{"timestamp": "Datetime (UTC)", "avg_CI:lb/MWh": "MOER"}``
            (``exogenous.columns``). If a column name contains UTC, its stamps need no offset.

    Returns:
        Carbon intensity in g/kWh, at the resolution of the file, for whole years of 365 days.

    Raises:
        DataError: the data are not valid; the message names file, row, column, value, valid values.
    """
    path = Path(path)
    if not (np.isfinite(utc_offset_h) and UTC_OFFSETS_H[0] <= utc_offset_h <= UTC_OFFSETS_H[1]):
        raise DataError(f"utc_offset_h: {utc_offset_h!r}, expected -12 to 14")
    if stamp not in ("auto", "start", "end"):
        raise DataError(f"stamp: {shortened(stamp)}, expected 'auto', 'start' or 'end'")
    if pairing not in ("local", "utc_rows"):
        raise DataError(f"pairing: {shortened(pairing)}, expected 'local' or 'utc_rows'")
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path)
        if metadata is not None:
            return _read_imported(path, metadata, utc_offset_h, pairing)
    generation = _read_generation(path, columns)
    minutes, notes, intensity = generation.minutes, generation.notes, generation.values[:, -1]
    if pairing == "utc_rows":
        local = generation.start_utc
        notes.append("rows kept in UTC order, as the released SustainDC pairs them")
    else:
        local = generation.start_utc + np.timedelta64(round(utc_offset_h * 3600), "s")
        known = generation.columns
        solar = generation.values[:, known.index("SUN")] if "SUN" in known else None
        noon_h = 12.0 if longitude_deg is None else 12.0 + utc_offset_h - longitude_deg / 15.0
        is_leap_day = files.leap_days(len(intensity), local, minutes)
        files.check_length(path, int((~is_leap_day).sum()), minutes)
        if solar is not None and longitude_deg is not None:
            notes += region_notes(solar, local, minutes, noon_h)
        intensity, shift, note = by_start_of_interval(
            stamp, intensity, solar, local, minutes, noon_h
        )
        local = local - shift * np.timedelta64(round(minutes * 60), "s")
        notes.append(note)
    intensity, year, year_notes = files.calendar_years(path, intensity, local, minutes)
    notes += year_notes
    return Series(
        intensity,
        minutes,
        "ci_g_per_kwh",
        "g/kWh",
        path.name,
        synthetic=False,
        notes=tuple(notes),
        year=year,
    )


def _read_imported(
    path: Path, metadata: dict[str, object], utc_offset_h: float, pairing: Pairing
) -> Series:
    limits = Quantity("g/kWh", 0.0, MAX_CI_G_PER_KWH)
    series = series_file.read_series(path, metadata, "carbon", {"ci_g_per_kwh": limits})
    offset = series_file.metadata_value(path, metadata, "utc_offset_h", float)
    if offset != utc_offset_h:
        raise DataError(
            f"{path}: metadata utc_offset_h: {offset:g}, expected {utc_offset_h:g} as the site has"
        )
    if series_file.metadata_value(path, metadata, "pairing", str) != pairing:
        raise DataError(
            f"{path}: metadata pairing: {shortened(metadata['pairing'])}, expected {pairing!r}"
        )
    return series["ci_g_per_kwh"]


class _Generation(NamedTuple):
    """Contiguous and repaired rows of a carbon table."""

    minutes: float
    """Resolution, in minutes."""
    start_utc: np.datetime64
    """First stamp, in UTC."""
    columns: tuple[str, ...]
    """Names of the columns: the fuels, if present, then ``avg_CI``."""
    values: FloatArray
    """Generation by fuel in MWh, and intensity in g/kWh, (T, columns)."""
    notes: list[str]
    """Repairs and warnings."""


def _read_generation(path: Path, column_names: Mapping[str, str]) -> _Generation:
    """Read a carbon table; ``column_names`` has the syntax of ``read_carbon``'s ``columns``."""
    named = column_map(column_names)
    table = files.read_table(path, named.names)
    notes = named.notes()
    first_column = table.frame.columns[0]
    if "timestamp" not in table.frame.columns and first_column.strip() in files.BLANK_HEADERS:
        table = files.Table(path, table.frame.rename(columns={first_column: "timestamp"}))
        notes.append("blank first header read as timestamp")
    with_fuels = any(fuel in table.frame.columns for fuel in FUELS)
    columns = (*FUELS, "avg_CI") if with_fuels else ("avg_CI",)
    table.require_columns("timestamp", *columns)
    stamps, has_offset = table.stamps("timestamp")
    table.refuse("timestamp", np.isnat(stamps), "a time such as 2022-01-01 00:00:00+00:00")
    if "UTC" not in named.names.get("timestamp", ""):
        table.refuse("timestamp", ~has_offset, "a UTC offset at the end, such as +00:00")
    minutes, positions = files.grid_of_stamps(table, stamps, "timestamp")
    values, number_notes = _numbers(table, columns, named)
    values, rows, absent_notes = table.spread(values, positions)
    values, gap_notes = _repair(path, values, minutes, columns, rows, len(table.frame))
    notes += number_notes + absent_notes + gap_notes
    return _Generation(minutes, stamps[0], columns, values, notes)


def _numbers(
    table: files.Table, columns: tuple[str, ...], named: ColumnMap
) -> tuple[FloatArray, list[str]]:
    """Return generation and intensity, (T, columns), checked against each other, and notes.

    Negative generation counts as 0, and in its rows the intensity is that of the fuel mix.
    """
    fuels = columns[:-1]
    generation = [
        table.numbers(name, -_MAX_GENERATION_MWH, _MAX_GENERATION_MWH, unit=named.unit(name))
        for name in fuels
    ]
    generation, corrected, notes = _without_negative(table, fuels, generation)
    text = table.frame["avg_CI"]
    checked = files.Table(table.path, text.mask(corrected, "nan").to_frame())
    intensity = checked.numbers("avg_CI", 0.0, MAX_CI_G_PER_KWH, unit=named.unit("avg_CI"))
    # A grid with only renewables has an intensity of 0 all year.
    if not np.isnan(intensity).all() and 0.0 < np.nanmax(intensity) < 2.0:
        raise DataError(
            f"{table.path}: row {table.frame.index[0]}, column avg_CI: at most "
            f"{np.nanmax(intensity):g} in all rows, expected g/kWh (kg/kWh are read with "
            "--map avg_CI:kg/kWh=COLUMN)"
        )
    if not fuels:
        return intensity[:, None], ["no fuel mix to check avg_CI against"]
    mwh = np.stack(generation, axis=1)
    total = mwh.sum(axis=1)
    table.refuse("WND..OTH", (total == 0.0) & ~corrected, "some generation", value=0.0)
    factors = np.array([emission_factors()[fuel] for fuel in fuels])
    # Rows without any generation but a negative one are missing.
    mix = mwh @ factors / np.where(total == 0.0, np.nan, total)
    off = np.abs(intensity - mix) > MIX_TOLERANCE_G
    valid = f"{mix[np.argmax(off)]:.2f} +- {MIX_TOLERANCE_G:g} from the fuel mix"
    table.refuse("avg_CI", off, valid)
    intensity = np.where(corrected, mix, intensity)
    return np.column_stack([mwh, intensity]), notes


def _without_negative(
    table: files.Table, fuels: Sequence[str], generation: Sequence[FloatArray]
) -> tuple[list[FloatArray], NDArray[np.bool_], list[str]]:
    """Set negative generation to 0; return it, True for each changed row, (T,), and notes."""
    all_mwh = sum(float(np.nansum(np.abs(mwh))) for mwh in generation)
    changed = np.zeros(len(table.frame), dtype=bool)
    notes = []
    for fuel, mwh in zip(fuels, generation, strict=True):
        negative = mwh < 0.0
        if not negative.any():
            continue
        if -mwh[negative].sum() > MOST_NEGATIVE_SHARE * all_mwh:
            valid = f"0 or more (at most {MOST_NEGATIVE_SHARE:.0%} of all generation is negative)"
            table.refuse(fuel, negative, valid)
        first = int(table.frame.index[int(np.argmax(negative))])
        notes.append(
            f"warning: {int(negative.sum())} negative values of {fuel} set to 0, the lowest is "
            f"{mwh[negative].min():g} MWh (first: row {first})"
        )
        changed |= negative
    return [np.where(mwh < 0.0, 0.0, mwh) for mwh in generation], changed, notes


def _repair(
    path: Path,
    values: FloatArray,
    minutes: float,
    columns: tuple[str, ...],
    rows: NDArray[np.int64],
    rows_in_file: int,
) -> tuple[FloatArray, list[str]]:
    """Interpolate missing rows and partial hours; return values, (T, columns), and notes."""
    import pandas as pd

    notes = []
    # First refuse long gaps of single columns; after that, rows are missing or present as a whole.
    files.fill_gaps(path, values, minutes, columns, rows)
    missing = np.isnan(values).any(axis=1)
    blank = int(missing.sum()) - (len(values) - rows_in_file)
    if blank:
        notes.append(f"{blank} rows without values interpolated")
    values = values.copy()
    values[missing] = np.nan
    if len(columns) > 1:
        total = values[:, :-1].sum(axis=1)
        window = max(3, round(25 * 60 / minutes)) | 1
        median = pd.Series(total).rolling(window, center=True, min_periods=1).median().to_numpy()
        partial = total < 0.5 * median
        if partial.any():
            values[partial] = np.nan
            notes.append(
                f"{int(partial.sum())} rows with under half of the 25 h median generation "
                "interpolated"
            )
        for suspect, what in _suspicious_rows(values[:, :-1], total, median):
            first = int(rows[np.argmax(suspect)])
            notes.append(
                f"warning: {int(suspect.sum())} rows with {what} kept (first: row {first})"
            )
    return files.fill_gaps(path, values, minutes, columns, rows), notes


def _suspicious_rows(
    fuels: FloatArray, total: FloatArray, median: FloatArray
) -> list[tuple[NDArray[np.bool_], str]]:
    """Find rows that look wrong but stay; return mask, (T,), and reason of each kind found."""
    nuclear, other = fuels[:, FUELS.index("NUC")], fuels[:, FUELS.index("OTH")]
    reporting = np.where(np.isnan(total), np.inf, (fuels > 0.0).sum(axis=1))
    kinds = [
        (total > 2.0 * median, "over twice the 25 h median generation"),
        (
            (nuclear < 0.05 * np.nanmedian(nuclear)) & (other > 3.0 * np.nanmedian(other)),
            "no nuclear but high OTH (nuclear reported as OTH?)",
        ),
        ((reporting == 1) & (np.median(reporting) >= 3), "one fuel only"),
    ]
    return [(rows, why) for rows, why in kinds if rows.any()]
