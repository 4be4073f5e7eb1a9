"""Grid carbon intensity: hourly generation by fuel and its average intensity, stamped in UTC."""

from __future__ import annotations

from collections.abc import Mapping
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

Pairing = Literal["local", "utc_rows"]
"""Whether rows are moved to local time, or kept as if UTC were local time."""

MAX_CI_G_PER_KWH = 2000.0
"""Highest valid carbon intensity, in g/kWh."""
MIX_TOLERANCE_G = 1.0
"""Largest difference of ``avg_CI`` from what the fuel mix gives, in g/kWh."""
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
    """Read carbon intensity and bring it to the site's local standard time.

    The table has a ``timestamp`` with its UTC offset, generation from WND SUN WAT OIL NG COL NUC
    OTH (any energy unit; all eight or none) and ``avg_CI`` in g CO2e/kWh. A Parquet file written by
    ``data import`` is taken as it is, and must be for the same UTC offset.

    Stamps are moved to local standard time, 29 February is removed, and hours that fall before
    1 January wrap to the end. EIA-930 stamps mark the end of the hour, yet some authorities report
    the start, or did until some day. ``stamp="auto"`` reads it from the solar generation: its
    centre of gravity lies after solar noon when stamps mark the end and before it when they mark
    the start (one change within the file is detected); without solar generation it is the end.

    Args:
        path: CSV or Parquet.
        utc_offset_h: local standard time minus UTC, hours, -12..14.
        stamp: what a stamp marks.
        pairing: ``"utc_rows"`` keeps the order of the rows as the released SustainDC does, which
            pairs UTC hours with local ones.
        longitude_deg: longitude of the site, for ``"auto"`` and for a warning if solar generation
            does not fit it; None is the middle of the time zone, without a warning.
        columns: names of the columns above, with their units where these differ, and the names in
            the table, such as ``{"timestamp": "Datetime (UTC)", "avg_CI:lb/MWh": "MOER"}``
            (``exogenous.columns``); stamps of a column whose name says UTC need no offset.

    Returns:
        Carbon intensity, g/kWh, resolution of the file, whole years of 365 days.

    Raises:
        DataError: names file, row, column, value and what would be valid.
    """
    path = Path(path)
    if not (np.isfinite(utc_offset_h) and -12.0 <= utc_offset_h <= 14.0):
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
    intensity, year_notes = files.calendar_years(path, intensity, local, minutes)
    notes += year_notes
    return Series(
        intensity, minutes, "ci_g_per_kwh", "g/kWh", path.name, synthetic=False, notes=tuple(notes)
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
    """Contiguous rows of a carbon table, repaired."""

    minutes: float
    """Resolution, in minutes."""
    start_utc: np.datetime64
    """First stamp, in UTC."""
    columns: tuple[str, ...]
    """Names of the columns: fuels if there are any, then ``avg_CI``."""
    values: FloatArray
    """Generation and intensity, (T, columns)."""
    notes: list[str]
    """Repairs and warnings."""


def _read_generation(path: Path, column_names: Mapping[str, str]) -> _Generation:
    """Read a carbon table, its columns named as of ``read_carbon``."""
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
    """Generation and intensity, checked against each other, (T, columns), and notes."""
    highest = dict.fromkeys(FUELS, _MAX_GENERATION_MWH) | {"avg_CI": MAX_CI_G_PER_KWH}
    values = np.stack(
        [
            table.numbers(column, 0.0, highest[column], unit=named.unit(column))
            for column in columns
        ],
        axis=1,
    )
    # A grid of renewables alone has 0 all year.
    if not np.isnan(values[:, -1]).all() and 0.0 < np.nanmax(values[:, -1]) < 2.0:
        raise DataError(
            f"{table.path}: row {table.frame.index[0]}, column avg_CI: at most "
            f"{np.nanmax(values[:, -1]):g} in all rows, expected g/kWh (kg/kWh are read with "
            "--map avg_CI:kg/kWh=COLUMN)"
        )
    if len(columns) == 1:
        return values, ["no fuel mix to check avg_CI against"]
    total = values[:, :-1].sum(axis=1)
    table.refuse("WND..OTH", total == 0.0, "some generation", value=0.0)
    mix = values[:, :-1] @ np.array([emission_factors()[fuel] for fuel in FUELS]) / total
    off = np.abs(values[:, -1] - mix) > MIX_TOLERANCE_G
    valid = f"{mix[np.argmax(off)]:.2f} +- {MIX_TOLERANCE_G:g} from the fuel mix"
    table.refuse("avg_CI", off, valid)
    return values, []


def _repair(
    path: Path,
    values: FloatArray,
    minutes: float,
    columns: tuple[str, ...],
    rows: NDArray[np.int64],
    rows_in_file: int,
) -> tuple[FloatArray, list[str]]:
    """Interpolate missing rows and partial hours, (T, columns), and notes."""
    import pandas as pd

    notes = []
    # Long gaps are refused by their column here; below, a row counts as a whole.
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
    """Rows that look wrong but stay, (T,), with the reason; only reasons that occur."""
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
