"""Grid carbon intensity: hourly generation by fuel and its average intensity, stamped in UTC."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import files
from sdc_taichi.exogenous.series import FloatArray, Series
from sdc_taichi.exogenous.synthetic import FUELS, emission_factors
from sdc_taichi.year_clock import DAYS_PER_YEAR, MINUTES_PER_DAY

if TYPE_CHECKING:
    import pandas as pd

Stamp = Literal["auto", "start", "end"]
Pairing = Literal["local", "utc_rows"]

COLUMNS = ("timestamp", *FUELS, "avg_CI")
MAX_CI_G_PER_KWH = 2000.0
MIX_TOLERANCE_G = 1.0
_MAX_GENERATION_MWH = 1e7
_TIMEZONE = r"(?:[Zz]|UTC|[+-]\d\d:?\d\d)$"


def read_carbon(
    path: str | Path,
    utc_offset_h: float,
    stamp: Stamp = "auto",
    *,
    pairing: Pairing = "local",
    longitude_deg: float | None = None,
) -> Series:
    """Read carbon intensity and bring it to the site's local standard time.

    The table has a ``timestamp`` with its UTC offset, generation of WND SUN WAT OIL NG COL NUC OTH
    (any energy unit; all eight or none) and ``avg_CI`` in g CO2e/kWh. A Parquet file written by
    ``data import`` is taken as it is, and must be for the same UTC offset.

    Stamps are moved to local standard time, 29 February is removed, and hours that fall before
    1 January wrap to the end. EIA-930 stamps mark the end of the hour, yet some authorities report
    the start, or did until some day. ``stamp="auto"`` reads it from the solar generation: its
    centre of gravity lies after solar noon when stamps mark the end and before it when they mark
    the start (one change within the file is found); without solar generation it is the end.

    Args:
        path: CSV or Parquet.
        utc_offset_h: local standard time minus UTC, hours, -12..14.
        stamp: what a stamp marks.
        pairing: ``"utc_rows"`` keeps the order of the rows as the released SustainDC does, which
            pairs UTC hours with local ones.
        longitude_deg: of the site, for ``"auto"``; the middle of the time zone if None.

    Returns:
        Carbon intensity, g/kWh, resolution of the file, whole years of 365 days.

    Raises:
        DataError: names file, row, column, value and what would be valid.
    """
    path = files.existing_file(path)
    if not (np.isfinite(utc_offset_h) and -12.0 <= utc_offset_h <= 14.0):
        raise DataError(f"utc_offset_h: {utc_offset_h!r}, expected -12 to 14")
    if stamp not in ("auto", "start", "end"):
        raise DataError(f"stamp: {stamp!r}, expected 'auto', 'start' or 'end'")
    if pairing not in ("local", "utc_rows"):
        raise DataError(f"pairing: {pairing!r}, expected 'local' or 'utc_rows'")
    if files.is_parquet(path):
        metadata = files.read_metadata(path)
        if metadata is not None:
            return _read_imported(path, metadata, utc_offset_h, pairing)
    frame, first_row = files.read_table(path)
    notes = []
    if "timestamp" not in frame.columns and frame.columns[0].strip() in files.BLANK_HEADERS:
        frame = frame.rename(columns={frame.columns[0]: "timestamp"})
        notes.append("blank first header read as timestamp")
    with_fuels = any(fuel in frame.columns for fuel in FUELS)
    files.require_columns(path, frame, COLUMNS if with_fuels else ("timestamp", "avg_CI"))
    rows = first_row + np.arange(len(frame))
    minutes, positions, start_utc = _stamps(path, frame, rows)
    columns = (*FUELS, "avg_CI") if with_fuels else ("avg_CI",)
    values, number_notes = _numbers(path, frame, columns, rows)
    notes += number_notes
    values = files.spread(values, positions)
    grid_rows = rows[np.minimum(np.searchsorted(positions, np.arange(len(values))), rows.size - 1)]
    values, gap_notes = _repair(path, values, minutes, columns, grid_rows, len(frame))
    notes += gap_notes
    intensity = values[:, -1]

    local = start_utc + np.timedelta64(round(utc_offset_h * 3600), "s")
    if pairing == "utc_rows":
        local = start_utc
        notes.append("rows kept in UTC order, as the released SustainDC pairs them")
    else:
        solar = values[:, columns.index("SUN")] if with_fuels else None
        noon = 12.0 if longitude_deg is None else 12.0 + utc_offset_h - longitude_deg / 15.0
        without_leap, _, _ = files.without_leap_days(intensity, local, minutes)
        files.check_length(path, len(without_leap), minutes)
        intensity, shift, note = _apply_stamp(stamp, intensity, solar, local, minutes, noon)
        local = local - shift * np.timedelta64(round(minutes * 60), "s")
        notes.append(note)
    intensity, since, leap_notes = files.without_leap_days(intensity, local, minutes)
    intensity, year_notes = files.whole_years(path, intensity, since, minutes)
    notes += leap_notes + year_notes
    return Series(
        intensity, minutes, "ci_g_per_kwh", "g/kWh", path.name, synthetic=False, notes=tuple(notes)
    )


def _read_imported(
    path: Path, metadata: dict[str, object], utc_offset_h: float, pairing: Pairing
) -> Series:
    kind = files.metadata_value(path, metadata, "kind", str)
    if kind != "carbon":
        raise DataError(f"{path}: metadata kind: {kind!r}, expected 'carbon'")
    offset = files.metadata_value(path, metadata, "utc_offset_h", float)
    if offset != utc_offset_h:
        raise DataError(
            f"{path}: metadata utc_offset_h: {offset:g}, expected {utc_offset_h:g} as the site has"
        )
    if files.metadata_value(path, metadata, "pairing", str) != pairing:
        raise DataError(f"{path}: metadata pairing: {metadata['pairing']!r}, expected {pairing!r}")
    minutes = files.metadata_value(path, metadata, "minutes", float)
    columns = files.read_columns(path, {"ci_g_per_kwh": (0.0, MAX_CI_G_PER_KWH)}, minutes)
    return files.imported_series(path, metadata, "ci_g_per_kwh", "g/kWh", columns, minutes)


def _stamps(
    path: Path, frame: pd.DataFrame, rows: NDArray[np.int64]
) -> tuple[float, NDArray[np.int64], np.datetime64]:
    """Resolution, grid positions and first stamp (UTC) of the timestamp column."""
    import pandas as pd

    text = frame["timestamp"].str.strip()
    parsed = pd.to_datetime(text, utc=True, errors="coerce", format="ISO8601")
    bad = parsed.isna().to_numpy()
    if bad.any():
        at = int(np.argmax(bad))
        valid = "a time such as 2022-01-01 00:00:00+00:00"
        raise files.fault(path, int(rows[at]), "timestamp", text.iloc[at], valid)
    naive = ~text.str.contains(_TIMEZONE, regex=True).to_numpy(dtype=bool)
    if naive.any():
        at = int(np.argmax(naive))
        valid = "a UTC offset at the end, such as +00:00"
        raise files.fault(path, int(rows[at]), "timestamp", text.iloc[at], valid)
    stamps = parsed.dt.tz_localize(None).to_numpy().astype("datetime64[s]")
    minutes, positions = files.grid_of_stamps(path, stamps, rows, "timestamp")
    return minutes, positions, stamps[0]


def _numbers(
    path: Path, frame: pd.DataFrame, columns: tuple[str, ...], rows: NDArray[np.int64]
) -> tuple[FloatArray, list[str]]:
    """Generation and intensity, checked against each other; shape (T, columns)."""
    notes = []
    values = np.stack(
        [
            files.numbers(
                path,
                frame[column],
                column,
                rows,
                0.0,
                MAX_CI_G_PER_KWH if column == "avg_CI" else _MAX_GENERATION_MWH,
            )
            for column in columns
        ],
        axis=1,
    )
    if not np.isnan(values[:, -1]).all() and np.nanmax(values[:, -1]) < 2.0:
        raise DataError(
            f"{path}: row {int(rows[0])}, column avg_CI: at most {np.nanmax(values[:, -1]):g} in "
            "all rows, expected g/kWh (multiply kg/kWh by 1000)"
        )
    if len(columns) == 1:
        return values, ["no fuel mix to check avg_CI against"]
    total = values[:, :-1].sum(axis=1)
    empty = total == 0.0
    if empty.any():
        at = int(np.argmax(empty))
        raise files.fault(path, int(rows[at]), "WND..OTH", 0.0, "some generation")
    mix = values[:, :-1] @ np.array([emission_factors()[fuel] for fuel in FUELS]) / total
    off = np.abs(values[:, -1] - mix) > MIX_TOLERANCE_G
    if off.any():
        at = int(np.argmax(off))
        valid = f"{mix[at]:.2f} +- {MIX_TOLERANCE_G:g} from the fuel mix"
        raise files.fault(path, int(rows[at]), "avg_CI", float(values[at, -1]), valid)
    as_floats = sum(
        bool(
            frame[fuel].str.contains(".", regex=False).any()
            and np.array_equal(np.nan_to_num(x), np.round(np.nan_to_num(x)))
        )
        for fuel, x in zip(columns[:-1], values.T, strict=False)
    )
    if as_floats:
        notes.append(f"integers written as floats in {as_floats} columns")
    return values, notes


def _repair(
    path: Path,
    values: FloatArray,
    minutes: float,
    columns: tuple[str, ...],
    rows: NDArray[np.int64],
    rows_in_file: int,
) -> tuple[FloatArray, list[str]]:
    """Interpolate missing rows and partial hours; shape (T, columns) kept."""
    import pandas as pd

    notes = []
    for i, column in enumerate(columns):  # names the column; below, a row counts as a whole
        files.fill_gaps(path, values[:, i], minutes, column, rows)
    absent = len(values) - rows_in_file
    missing = np.isnan(values).any(axis=1)
    blank = int(missing.sum()) - absent
    if absent:
        notes.append(f"{absent} absent rows interpolated")
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
        for suspect, what in _suspects(values[:, :-1], total, median):
            first = int(rows[np.argmax(suspect)])
            notes.append(
                f"warning: {int(suspect.sum())} rows with {what} kept (first: row {first})"
            )
    filled = [
        files.fill_gaps(path, values[:, i], minutes, column, rows)
        for i, column in enumerate(columns)
    ]
    return np.stack(filled, axis=1), notes


def _suspects(
    fuels: FloatArray, total: FloatArray, median: FloatArray
) -> list[tuple[NDArray[np.bool_], str]]:
    """Rows that look wrong but are kept, and why; only kinds that occur."""
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


# What a stamp marks


def _apply_stamp(
    stamp: Stamp,
    intensity: FloatArray,
    solar: FloatArray | None,
    local: np.datetime64,
    minutes: float,
    noon_h: float,
) -> tuple[FloatArray, int, str]:
    """Intervals in order of their start.

    Returns:
        Values one per interval, by how many intervals the first one starts before its stamp
        (0 or 1), and a note.
    """
    if stamp != "auto":
        return intensity, int(stamp == "end"), f"stamps mark the {stamp} of the interval (given)"
    lateness = None if solar is None else _solar_lateness(solar, local, minutes, noon_h)
    if lateness is None:
        return intensity, 1, "stamps mark the end of the interval (assumed: no solar generation)"
    before, after, day = _split(lateness)
    if (before > 0.0) == (after > 0.0):
        word = "end" if before > 0.0 else "start"
        return intensity, int(before > 0.0), f"stamps mark the {word} of the interval (solar noon)"
    per_day = round(MINUTES_PER_DAY / minutes)
    cut = min(day * per_day, len(intensity) - 1)
    date = (local + np.timedelta64(day, "D")).astype("datetime64[D]")
    if before > 0.0:  # end, then start: one interval is never reported
        gap = 0.5 * (intensity[cut - 1] + intensity[cut])
        joined = np.insert(intensity, cut, gap)
        return joined, 1, f"stamps mark the end until {date}, then the start (solar noon); 1 filled"
    # start, then end: one interval is reported twice, and the last of the year never
    joined = np.append(np.delete(intensity, cut), 0.5 * (intensity[-1] + intensity[0]))
    return joined, 0, f"stamps mark the start until {date}, then the end (solar noon); 1 filled"


def _solar_lateness(
    solar: FloatArray, local: np.datetime64, minutes: float, noon_h: float
) -> FloatArray | None:
    """Hours from solar noon to the centre of solar generation by stamp, per day; NaN on dark days.

    Mean solar noon is corrected by the equation of time (Spencer 1971).
    """
    times = local.astype("datetime64[s]") + np.timedelta64(round(minutes * 60), "s") * np.arange(
        solar.size
    )
    day = (times.astype("datetime64[D]") - times[0].astype("datetime64[D]")).astype(np.int64)
    hour = (times - times.astype("datetime64[D]")) / np.timedelta64(1, "h")
    total = np.bincount(day, solar)
    bright = total > 0.1 * np.median(total[total > 0.0]) if (total > 0.0).any() else total > 0.0
    if bright.sum() < 30:
        return None
    year_angle = (
        2.0
        * np.pi
        / DAYS_PER_YEAR
        * (
            (times[0].astype("datetime64[D]") - times[0].astype("datetime64[Y]")).astype(np.int64)
            + np.arange(total.size)
        )
    )
    equation_h = (
        0.000075
        + 0.001868 * np.cos(year_angle)
        - 0.032077 * np.sin(year_angle)
        - 0.014615 * np.cos(2.0 * year_angle)
        - 0.040849 * np.sin(2.0 * year_angle)
    ) * (12.0 / np.pi)
    late = np.full(total.size, np.nan)
    late[bright] = np.bincount(day, solar * hour)[bright] / total[bright]
    return np.asarray(late - (noon_h - equation_h), dtype=np.float64)


def _split(lateness: FloatArray) -> tuple[float, float, int]:
    """Means before and after the day that best splits the series in two, and that day.

    A split counts only if both parts last 30 days and differ by 0.4 h (a change of what a stamp
    marks is an hour); otherwise both means are that of the whole.
    """
    days = np.flatnonzero(~np.isnan(lateness))
    values = lateness[days]
    n = values.size
    whole = float(np.median(values))
    count = np.arange(1, n)
    left = np.cumsum(values)[:-1]
    right = values.sum() - left
    explained = left**2 / count + right**2 / (n - count)
    allowed = (count >= 30) & (n - count >= 30)
    if not allowed.any():
        return whole, whole, 0
    at = int(np.argmax(np.where(allowed, explained, -np.inf))) + 1
    before, after = float(values[:at].mean()), float(values[at:].mean())
    if abs(after - before) < 0.4:
        return whole, whole, 0
    return before, after, int(days[at])
