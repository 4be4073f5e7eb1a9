"""Tables of carbon intensity and generation that were saved by hand from the pages of services.

Each service has a layout of its own. A layout is brought to the carbon table that ``read_carbon``
knows, which is kept beside the downloads of the service, and imported as these are.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sdc_taichi.errors import DataError, shortened, suggestion
from sdc_taichi.exogenous import files, importing
from sdc_taichi.exogenous.carbon import MAX_CI_G_PER_KWH
from sdc_taichi.exogenous.columns import LB_KG
from sdc_taichi.exogenous.fetch import eia, electricity_maps, entsoe
from sdc_taichi.exogenous.fetch.generation import Period, by_column, carbon_table
from sdc_taichi.exogenous.fetch.kept_downloads import downloads_dir, write_file
from sdc_taichi.exogenous.fetch.request import Service
from sdc_taichi.exogenous.stamps import Stamp

if TYPE_CHECKING:
    import pandas as pd

WATTTIME = Service(
    name="watttime",
    title="WattTime",
    licence="terms of WattTime; most data need a subscription",
    page="https://docs.watttime.org",
)
"""The service of marginal intensities."""
_WATTTIME_COLUMNS = (("point_time", "value"), ("timestamp", "MOER"))
"""Columns of stamps and of pounds of CO2 per MWh, of version 3 and of version 2."""
_MARGINAL = (
    "warning: marginal intensity, what one more kWh emits; results of average intensity, which "
    "other files hold, do not compare with it"
)
_MOST_MW = 1e7
_LONGEST_LIST = 12

_EIA_STAMP, _EIA_AREA = "UTC Time at End of Hour", "Balancing Authority"
_EIA_FUEL = re.compile(r"Net Generation \(MW\) from (.*?)\s*(\(Imputed\)|\(Adjusted\))?")
_EIA_TYPES: tuple[tuple[str, str], ...] = (
    # Beginnings of names, the longer before the shorter; EIA renames the rest now and then.
    ("Coal", "COL"),
    ("Natural Gas", "NG"),
    ("Nuclear", "NUC"),
    ("All Petroleum", "OIL"),
    ("Hydropower", "WAT"),
    ("Pumped Storage", "PS"),
    ("Solar", "SUN"),
    ("Wind", "WND"),
    ("Geothermal", "GEO"),
    ("Battery Storage", "BAT"),
    ("Other Energy Storage", "OES"),
    ("Unknown Energy Storage", "UES"),
    ("Other Fuel", "OTH"),
    ("Unknown Fuel", "UNK"),
)
"""Codes of energy sources by the beginning of their names."""

_ENTSOE_TYPES = {
    "Biomass": "B01",
    "Fossil Brown coal/Lignite": "B02",
    "Fossil Coal-derived gas": "B03",
    "Fossil Gas": "B04",
    "Fossil Hard coal": "B05",
    "Fossil Oil": "B06",
    "Fossil Oil shale": "B07",
    "Fossil Peat": "B08",
    "Geothermal": "B09",
    "Hydro Pumped Storage": "B10",
    "Hydro Run-of-river and poundage": "B11",
    "Hydro Run-of-river and pondage": "B11",
    "Hydro Water Reservoir": "B12",
    "Marine": "B13",
    "Nuclear": "B14",
    "Other renewable": "B15",
    "Solar": "B16",
    "Waste": "B17",
    "Wind Offshore": "B18",
    "Wind Onshore": "B19",
    "Other": "B20",
    "Energy storage": "B25",
}
"""Codes of the types of the platform by their names."""
_ENTSOE_AREA, _ENTSOE_TYPE = "Area", "Production Type"
_ENTSOE_WIDE = re.compile(r"(.*?)\s*-\s*Actual Aggregated \[MW\].*")
_ENTSOE_MISSING = frozenset({"n/e", "-"})
_INTERVAL = re.compile(
    r"(\d\d)[./](\d\d)[./](\d{4}) (\d\d:\d\d)(?::\d\d)?(?: \((CET|CEST|UTC)\))? - .*"
)
_BRUSSELS = "Europe/Brussels"


class Export(NamedTuple):
    """Layout of the tables of a service."""

    service: Service
    """The service."""
    stamp: Stamp
    """What its stamps mark."""
    convert: Callable[[Sequence[Path], str | None], tuple[bytes, list[str]]]
    """Makes a carbon table, and notes, of files and the area that is asked for."""


def check_service(name: str) -> None:
    """Check the name of a service whose tables can be imported.

    Raises:
        DataError: another name.
    """
    if name not in EXPORTS:
        raise DataError(
            f"--map {shortened(name)}: expected NAME=COLUMN, or one of {', '.join(EXPORTS)}"
            f"{suggestion(name, tuple(EXPORTS))}"
        )


def import_export(
    paths: Sequence[Path],
    service: str,
    site: str,
    base: str | None = None,
    data_dir: Path | None = None,
    *,
    area: str | None = None,
    utc_offset_h: float | None = None,
) -> importing.Imported:
    """Import tables of a service as the carbon intensity of a site.

    Args:
        paths: the files, which are joined in the order of their stamps.
        service: name of the service, of ``EXPORTS``.
        site: name of the site.
        base: embedded site that gives what the tables do not.
        data_dir: folder of imported files instead of the user's.
        area: balancing authority or zone, of tables that hold several.
        utc_offset_h: of the site, in h; None is that of its weather or base.

    Raises:
        DataError: names file, row, column, value and what would be valid.
    """
    check_service(service)
    export = EXPORTS[service]
    name = importing.site_name(site, data_dir)
    importing.site_clock(name, base, data_dir, utc_offset_h=utc_offset_h)
    content, notes = export.convert(paths, area)
    folder = downloads_dir(export.service, data_dir)
    table = write_file(folder / f"{name}_by_hand.csv", content)
    saved = tuple({"file": path.name, "sha256": files.sha256(path)} for path in paths)
    origin = importing.Origin(export.service.title, export.service.licence, saved, tuple(notes))
    return importing.import_carbon(
        table,
        name,
        base,
        data_dir,
        utc_offset_h=utc_offset_h,
        stamp=export.stamp,
        origin=origin,
    )


# Intensities


def _electricity_maps(paths: Sequence[Path], area: str | None) -> tuple[bytes, list[str]]:
    _refuse_area(area)
    tables = []
    for path in paths:
        frame, first_row = files.read_table(path)
        columns = electricity_maps.intensity_columns(list(frame.columns), str(path))
        tables.append(_Intensity(path, frame, first_row, columns["timestamp"], columns["avg_CI"]))
    return _joined(tables, 1.0), [f"{tables[0].intensity} read as avg_CI"]


def _watttime(paths: Sequence[Path], area: str | None) -> tuple[bytes, list[str]]:
    _refuse_area(area)
    tables = []
    for path in paths:
        frame, first_row = files.read_table(path)
        found = [pair for pair in _WATTTIME_COLUMNS if set(pair) <= set(frame.columns)]
        if not found:
            expected = " or ".join(", ".join(pair) for pair in _WATTTIME_COLUMNS)
            raise DataError(
                f"{path}: row 1: columns {shortened(', '.join(frame.columns), 200)}, expected "
                f"{expected}, as WattTime has them"
            )
        tables.append(_Intensity(path, frame, first_row, *found[0]))
    return _joined(tables, LB_KG), [f"{tables[0].intensity} read as avg_CI, in lb/MWh", _MARGINAL]


class _Intensity(NamedTuple):
    """A table of intensities."""

    path: Path
    frame: pd.DataFrame
    first_row: int
    stamp: str
    intensity: str


def _joined(tables: Sequence[_Intensity], g_per_kwh: float) -> bytes:
    """Carbon table of intensities, by stamp.

    Args:
        tables: the tables, whose stamps are in UTC or have an offset.
        g_per_kwh: one unit of their intensities, in g/kWh.
    """
    import pandas as pd

    parts = []
    for path, frame, first_row, stamp, intensity in tables:
        rows = first_row + np.arange(len(frame))
        text = frame[stamp].str.strip()
        stamps = pd.to_datetime(text, utc=True, errors="coerce", format="ISO8601")
        _refuse(
            path, rows, stamp, text, stamps.isna().to_numpy(), "a time such as 2023-01-01 00:00"
        )
        most = MAX_CI_G_PER_KWH / g_per_kwh
        values = files.numbers(path, frame[intensity], intensity, rows, 0.0, most) * g_per_kwh
        parts.append(pd.Series(values, index=stamps))
    series = pd.concat(parts).sort_index()
    _refuse_repeated(tables[0].path, series.index)
    lines = ["timestamp,avg_CI"]
    for at, value in zip(series.index, series.to_numpy(), strict=True):
        lines.append(f"{at:%Y-%m-%d %H:%M:%S}+00:00,{'' if np.isnan(value) else f'{value:.3f}'}")
    return ("\n".join(lines) + "\n").encode()


# Generation


def _eia(paths: Sequence[Path], area: str | None) -> tuple[bytes, list[str]]:
    import pandas as pd

    parts = []
    for path in paths:
        frame, first_row = files.read_table(path)
        files.require_columns(path, frame, (_EIA_STAMP, _EIA_AREA))
        frame.index = pd.Index(first_row + np.arange(len(frame)))
        frame = _of_area(path, frame, _EIA_AREA, area.upper() if area else None)
        sources = {
            column: found
            for column in frame.columns
            if (found := _EIA_FUEL.fullmatch(" ".join(column.split())))
        }
        adjusted = any(found[2] == "(Adjusted)" for found in sources.values())
        wanted = "(Adjusted)" if adjusted else None
        codes = {
            column: _eia_code(path, found[1])
            for column, found in sources.items()
            if found[2] == wanted
        }
        text = frame[_EIA_STAMP].str.strip()
        stamps = pd.to_datetime(text, errors="coerce", format="%m/%d/%Y %I:%M:%S %p")
        valid = "a time such as 07/01/2023 5:00:00 AM"
        _refuse(path, frame.index.to_numpy(), _EIA_STAMP, text, stamps.isna().to_numpy(), valid)
        parts.append(_by_type(path, frame, codes, pd.DatetimeIndex(stamps)))
    return _generation_table(paths, parts, eia.COLUMNS)


def _eia_code(path: Path, source: str) -> str:
    """Code of an energy source by its name."""
    for beginning, code in _EIA_TYPES:
        if source.startswith(beginning):
            return code
    raise DataError(
        f"{path}: row 1: energy source {shortened(source)}, expected one that begins with "
        f"{', '.join(name for name, _ in _EIA_TYPES)}"
    )


def _entsoe(paths: Sequence[Path], area: str | None) -> tuple[bytes, list[str]]:
    import pandas as pd

    parts = []
    for path in paths:
        frame, first_row = files.read_table(path)
        frame.index = pd.Index(first_row + np.arange(len(frame)))
        interval = next((name for name in frame.columns if name.startswith(("MTU", "Time"))), "MTU")
        files.require_columns(path, frame, (interval, _ENTSOE_AREA))
        frame = _of_area(path, frame, _ENTSOE_AREA, area)
        if _ENTSOE_TYPE in frame.columns:
            frame, columns = _widened(path, frame, interval)
        else:
            found = ((name, _ENTSOE_WIDE.fullmatch(name)) for name in frame.columns)
            columns = {name: match[1] for name, match in found if match}
        codes = {column: _entsoe_code(path, kind) for column, kind in columns.items()}
        stamps, known = _interval_starts(path, frame, interval, list(codes))
        parts.append(_by_type(path, frame[known], codes, stamps))
    return _generation_table(paths, parts, entsoe.COLUMNS)


def _entsoe_code(path: Path, kind: str) -> str:
    """Code of a type of generation by its name."""
    name = " ".join(kind.split())
    if name not in _ENTSOE_TYPES:
        raise DataError(
            f"{path}: production type {shortened(name)}, expected one of "
            f"{', '.join(_ENTSOE_TYPES)}{suggestion(name, tuple(_ENTSOE_TYPES))}"
        )
    return _ENTSOE_TYPES[name]


def _widened(path: Path, frame: pd.DataFrame, interval: str) -> tuple[pd.DataFrame, dict[str, str]]:
    """Table with a column for each type, of one with a row for each type, and their types."""
    import pandas as pd

    power = next((name for name in frame.columns if name.startswith("Generation")), "")
    if not power:
        files.require_columns(path, frame, ("Generation (MW)",))
    # An hour that comes twice, where clocks go back, is told apart by the order of its rows.
    again = frame.groupby([interval, _ENTSOE_TYPE], sort=False).cumcount()
    frame = frame.assign(_again=again)
    rows = frame.index.to_series().groupby([frame[interval], frame["_again"]], sort=False).first()
    wide = frame.pivot(index=[interval, "_again"], columns=_ENTSOE_TYPE, values=power).fillna("")
    wide = wide.reindex(rows.index)
    kinds = {str(name): str(name) for name in wide.columns}
    wide[interval] = wide.index.get_level_values(0)
    wide.index = pd.Index(rows.to_numpy())
    return wide, kinds


def _interval_starts(
    path: Path, frame: pd.DataFrame, interval: str, columns: list[str]
) -> tuple[Any, Any]:
    """Starts of intervals in UTC, and which rows have one, (T,)."""
    import pandas as pd

    text = frame[interval].str.strip()
    parts = text.str.extract(f"^{_INTERVAL.pattern}$")
    rows = frame.index.to_numpy()
    valid = "an interval such as 01.01.2023 00:00 - 01.01.2023 01:00"
    _refuse(path, rows, interval, text, parts[0].isna().to_numpy(), valid)
    iso = parts[2] + "-" + parts[1] + "-" + parts[0] + " " + parts[3]
    naive = pd.to_datetime(iso, errors="coerce", format="%Y-%m-%d %H:%M")
    _refuse(path, rows, interval, text, naive.isna().to_numpy(), "a day of the calendar")
    zone = "UTC" if "UTC" in interval or text.iloc[0].endswith("(UTC)") else _BRUSSELS
    if zone == "UTC":
        return pd.DatetimeIndex(naive), np.ones(len(frame), dtype=bool)
    is_summer = parts[4].map({"CEST": True, "CET": False})
    # Tables without marks have the two hours in order.
    ambiguous: Any = "infer"
    if is_summer.notna().any():
        ambiguous = is_summer.eq(other=True).to_numpy(dtype=bool)
    local = pd.DatetimeIndex(naive)
    try:
        starts = local.tz_localize(_BRUSSELS, ambiguous=ambiguous, nonexistent="NaT")
    except ValueError as error:
        raise DataError(
            f"{path}: column {interval}: {shortened(str(error))}; export the table in UTC"
        ) from None
    absent = np.asarray(starts.isna())
    values = frame[columns].apply(lambda x: x.str.strip().str.lower())
    blank = values.isin(files.MISSING_TEXT | _ENTSOE_MISSING).all(axis=1).to_numpy()
    _refuse(path, rows, interval, text, absent & ~blank, "an hour that clocks do not skip")
    return starts[~absent].tz_convert("UTC").tz_localize(None), ~absent


def _by_type(
    path: Path, frame: pd.DataFrame, codes: Mapping[str, str], stamps: pd.DatetimeIndex
) -> pd.DataFrame:
    """Hourly generation of a table by type, in MWh, indexed by stamps in UTC."""
    import pandas as pd

    if not codes:
        raise DataError(f"{path}: row 1: no column of generation, as the service has them")
    _refuse_repeated(path, stamps)
    rows = frame.index.to_numpy()
    found: dict[str, Any] = {}
    for column, code in codes.items():
        text = frame[column].str.replace(",", "", regex=False)
        text = text.mask(text.str.strip().isin(_ENTSOE_MISSING), "")
        values = files.numbers(path, text, column, rows, -_MOST_MW, _MOST_MW)
        series = pd.Series(values, index=stamps)
        # Where a type has several columns, those without a value count as 0.
        found[code] = series if code not in found else found[code].add(series, fill_value=0.0)
    table = pd.DataFrame(found).sort_index()
    steps = np.diff(table.index.to_numpy()).astype("timedelta64[m]").astype(int)
    minutes = int(np.bincount(steps).argmax()) if steps.size else 60
    if minutes not in (15, 30, 60) or (steps % minutes).any():
        raise DataError(f"{path}: steps of {minutes} min, expected 15, 30 or 60 in all rows")
    first, last = table.index[0].floor("h"), table.index[-1].floor("h")
    slots = pd.date_range(first, last + pd.Timedelta(60 - minutes, "min"), freq=f"{minutes}min")
    regular = table.reindex(slots).to_numpy().reshape(-1, 60 // minutes, table.shape[1])
    return pd.DataFrame(
        regular.mean(axis=1), index=pd.date_range(first, last, freq="h"), columns=table.columns
    )


def _generation_table(
    paths: Sequence[Path], parts: Sequence[pd.DataFrame], columns: Mapping[str, str | None]
) -> tuple[bytes, list[str]]:
    """Carbon table of parts of a year."""
    import pandas as pd

    ordered = sorted(parts, key=lambda part: part.index[0])
    whole = pd.concat(ordered)
    _refuse_repeated(paths[0], whole.index)
    hours = pd.date_range(whole.index[0], whole.index[-1], freq="h")
    whole = whole.reindex(hours)
    starts = [int((part.index[0] - hours[0]).total_seconds() // 3600) for part in ordered]
    periods = [
        Period(first, stop) for first, stop in zip(starts, [*starts[1:], len(hours)], strict=True)
    ]
    by_type = {str(name): whole[name].to_numpy(dtype=np.float64) for name in whole.columns}
    values, notes = by_column(by_type, columns, periods)
    return carbon_table(hours[0].to_datetime64(), values), notes


# Helpers


def _of_area(path: Path, frame: pd.DataFrame, column: str, area: str | None) -> pd.DataFrame:
    """Rows of an area; of a table that holds one area, all."""
    names = frame[column].str.strip()
    known = sorted(set(names))
    if area is None and len(known) == 1:
        return frame
    chosen = [name for name in known if area is not None and area in (name, name.split("|")[-1])]
    if len(chosen) != 1:
        some = ", ".join(known[:_LONGEST_LIST]) + (", ..." if len(known) > _LONGEST_LIST else "")
        given = "" if area is None else f" {shortened(area)}"
        raise DataError(f"{path}: column {column}: expected --area{given} to be one of {some}")
    return frame[names == chosen[0]]


def _refuse(
    path: Path, rows: Any, column: str, text: pd.Series[str], wrong: Any, valid: str
) -> None:
    if wrong.any():
        at = int(np.argmax(wrong))
        raise files.fault(path, int(rows[at]), column, text.iloc[at], valid)


def _refuse_repeated(path: Path, stamps: pd.Index) -> None:
    again = stamps.duplicated()
    if again.any():
        at = stamps[int(np.argmax(again))]
        raise DataError(f"{path}: {at} UTC comes twice, in this file or another one of the import")


def _refuse_area(area: str | None) -> None:
    if area is not None:
        raise DataError(f"--area {shortened(area)}: a file of this service holds one area")


EXPORTS = {
    export.service.name: export
    for export in (
        Export(electricity_maps.SERVICE, "start", _electricity_maps),
        Export(eia.SERVICE, "auto", _eia),
        Export(entsoe.SERVICE, "start", _entsoe),
        Export(WATTTIME, "start", _watttime),
    )
}
"""Layouts by the name of the service."""
