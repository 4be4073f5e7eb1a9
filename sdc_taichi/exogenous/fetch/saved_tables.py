"""Import of tables of carbon intensity and generation that users saved from services' pages.

``services.yaml`` describes the layout of each service. A table is converted to the carbon table
that ``read_carbon`` reads. The carbon table is stored beside the downloads of the service and
imported like them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import DataError, shortened, suggestion
from sdc_taichi.exogenous import files, importing
from sdc_taichi.exogenous.carbon import MAX_CI_G_PER_KWH
from sdc_taichi.exogenous.columns import column_map
from sdc_taichi.exogenous.fetch.download import downloads_dir, write_file
from sdc_taichi.exogenous.fetch.generation import carbon_table, hourly_means
from sdc_taichi.exogenous.fetch.services import SavedTable, Service, services

if TYPE_CHECKING:
    import pandas as pd

_MOST_MW = 1e7
_LONGEST_LIST = 12
_BRUSSELS = "Europe/Brussels"
_INTERVAL = r"^(\d\d)[./](\d\d)[./](\d{4}) (\d\d:\d\d)(?::\d\d)?(?: \((CET|CEST|UTC)\))? - .*$"
"""Pattern of an interval in tables of ENTSO-E: day, month, year, time, and optional time zone."""


def saved_table_services() -> dict[str, Service]:
    """Return the services whose saved tables can be imported, by name."""
    return {name: each for name, each in services().items() if each.saved_table is not None}


def find_service(name: str) -> Service:
    """Return a service whose saved tables can be imported.

    Raises:
        DataError: there is no such service.
    """
    valid = saved_table_services()
    if name not in valid:
        raise DataError(
            f"--map {shortened(name)}: expected NAME=COLUMN, or one of {', '.join(valid)}"
            f"{suggestion(name, tuple(valid))}"
        )
    return valid[name]


def import_saved_tables(
    paths: Sequence[Path],
    service_name: str,
    site: str,
    base: str | None = None,
    *,
    area: str | None = None,
    utc_offset_h: float | None = None,
) -> importing.Imported:
    """Import tables of a service as the carbon intensity of a site.

    Args:
        paths: files of the tables, which are joined in the order of their stamps.
        service_name: name of the service, one of ``saved_table_services``.
        site: name of the site.
        base: embedded site that supplies missing data.
        area: balancing authority or zone, for tables with several.
        utc_offset_h: UTC offset of the site, in h; None stands for that of its weather or base.

    Raises:
        DataError: the data are not valid; the message names file, row, column, value, valid values.
    """
    service = find_service(service_name)
    name = importing.site_name(site)
    importing.site_clock(name, base, utc_offset_h=utc_offset_h)
    tables = [_read(path, service, area) for path in paths]
    convert = _intensity_table if _layout(service).intensity else _generation_table
    content, notes = convert(tables, service)
    folder = downloads_dir(service)
    table = write_file(folder / f"{name}_by_hand.csv", content)
    saved = tuple({"file": path.name, "sha256": files.sha256(path)} for path in paths)
    origin = importing.Origin(service.title, service.licence, saved, tuple(notes))
    return importing.import_carbon(
        table,
        name,
        base,
        utc_offset_h=utc_offset_h,
        stamp=service.stamp,
        origin=origin,
    )


def _read(path: Path, service: Service, area: str | None) -> files.Table:
    """Read the rows of one area from a file."""
    layout = _layout(service)
    table = files.read_table(path)
    if layout.area is None:
        if area is not None:
            raise DataError(f"--area {shortened(area)}: a file of this service holds one area")
        return table
    table.require_columns(layout.area)
    names = table.frame[layout.area].str.strip()
    known = sorted(set(names))
    if area is None and len(known) == 1:
        return table
    wanted_area = (area or "").upper()
    chosen = [name for name in known if wanted_area in (name.upper(), name.upper().split("|")[-1])]
    if len(chosen) != 1:
        some = ", ".join(known[:_LONGEST_LIST]) + (", ..." * (len(known) > _LONGEST_LIST))
        value = "" if area is None else f" {shortened(area)}"
        raise DataError(f"{path}: column {layout.area}: expected --area{value} to be one of {some}")
    return files.Table(path, table.frame[names == chosen[0]])


def _layout(service: Service) -> SavedTable:
    assert service.saved_table is not None
    return service.saved_table


def _column(table: files.Table, pattern: str, expected: str) -> str:
    """Return the name of the first column that matches a pattern."""
    for name in table.frame.columns:
        if re.fullmatch(pattern, name):
            return str(name)
    raise DataError(
        f"{table.path}: row 1: columns {shortened(', '.join(table.frame.columns), 200)}, "
        f"expected {expected}"
    )


def _intensity_table(tables: Sequence[files.Table], service: Service) -> tuple[bytes, list[str]]:
    """Convert tables of intensities to a carbon table; return it as CSV, with notes."""
    import pandas as pd

    layout = _layout(service)
    assert layout.intensity is not None
    unit = column_map({f"avg_CI:{layout.unit}" if layout.unit else "avg_CI": "x"}).unit("avg_CI")
    parts = []
    for table in tables:
        time = _column(table, layout.time, layout.expected)
        intensity = _column(table, layout.intensity, layout.expected)
        values = table.numbers(intensity, 0.0, MAX_CI_G_PER_KWH, unit=unit)
        parts.append(pd.Series(values, index=_stamps(table, time, layout)))
    series = pd.concat(parts).sort_index()
    _refuse_repeated(tables[0].path, series.index)
    stamps = pd.DatetimeIndex(series.index).strftime("%Y-%m-%d %H:%M:%S+00:00")
    frame = pd.DataFrame({"timestamp": stamps, "avg_CI": series.to_numpy()})
    content = frame.to_csv(index=False, float_format="%.3f", lineterminator="\n").encode()
    notes = [f"{intensity} read as avg_CI" + (f", in {layout.unit}" if layout.unit else "")]
    return content, notes + ([layout.note] if layout.note else [])


def _stamps(table: files.Table, column: str, layout: SavedTable) -> pd.DatetimeIndex:
    """Return the stamps of a column, in UTC."""
    import pandas as pd

    stamps, _ = table.stamps(column, layout.time_format)
    table.refuse(column, np.isnat(stamps), f"a time such as {layout.time_example}")
    return pd.DatetimeIndex(stamps)


def _generation_table(tables: Sequence[files.Table], service: Service) -> tuple[bytes, list[str]]:
    """Convert tables of generation, parts of a year, to a carbon table as CSV, with notes."""
    import pandas as pd

    parts = sorted((_by_type(table, service) for table in tables), key=lambda part: part.index[0])
    stamps = parts[0].index.append([part.index for part in parts[1:]])
    _refuse_repeated(tables[0].path, stamps)
    starts = [part.index[0] for part in parts]
    ends = [*starts[1:], stamps[-1] + pd.Timedelta(1, "h")]
    contiguous = [
        part.reindex(pd.date_range(start, end, freq="h", inclusive="left"))
        for part, start, end in zip(parts, starts, ends, strict=True)
    ]
    return carbon_table(contiguous, service)


def _by_type(table: files.Table, service: Service) -> pd.DataFrame:
    """Return the hourly generation in a table by type, in MWh, indexed by stamps in UTC."""
    import pandas as pd

    layout = _layout(service)
    time = _column(table, layout.time, layout.time.replace("(MTU|Time).*", "MTU"))
    if layout.type in table.frame.columns:
        table = _with_column_per_type(table, layout, time)
        columns = {str(name): str(name) for name in table.frame.columns if name != time}
    else:
        columns = _generation_columns(table, layout)
    codes = {column: _code(table, kind, service) for column, kind in columns.items()}
    if "%" in layout.time_format:
        stamps = _stamps(table, time, layout)
    else:
        table, stamps = _interval_starts(table, layout, time, list(codes))
    _refuse_repeated(table.path, stamps)
    frame = table.frame[list(codes)].apply(lambda cells: cells.str.strip())
    frame = frame.apply(lambda cells: cells.str.replace(",", "", regex=False))
    numbers = files.Table(table.path, frame.mask(frame.isin(layout.missing), ""))
    by_type: dict[str, Any] = {}
    for column, code in codes.items():
        series = pd.Series(numbers.numbers(column, -_MOST_MW, _MOST_MW), index=stamps)
        # If a type has several columns, missing values in some of them count as 0.
        by_type[code] = by_type[code].add(series, fill_value=0.0) if code in by_type else series
    return _hourly(table.path, pd.DataFrame(by_type).sort_index())


def _generation_columns(table: files.Table, layout: SavedTable) -> dict[str, str]:
    """Return the type name of each column of generation."""
    for pattern in layout.generation:
        fits = {
            str(name): match[1].strip()
            for name in table.frame.columns
            if (match := re.fullmatch(pattern, " ".join(name.split())))
        }
        if fits:
            return fits
    raise DataError(f"{table.path}: row 1: no column of generation, as the service has them")


def _code(table: files.Table, kind: str, service: Service) -> str:
    """Return the code of a type, given its name or a longer name that begins with it."""
    kind = " ".join(kind.split())
    codes = {name: code for code, each in service.types.items() for name in each.names}
    # Services sometimes rename or split types: "Solar without Integrated Battery Storage".
    begins = [name for name in codes if kind.startswith(name)]
    if not begins:
        raise DataError(
            f"{table.path}: row 1: type of generation {shortened(kind)}, expected one of "
            f"{', '.join(codes)}{suggestion(kind, tuple(codes))}"
        )
    return codes[max(begins, key=len)]


def _with_column_per_type(table: files.Table, layout: SavedTable, time: str) -> files.Table:
    """Convert a table with one row per type to a table with one column per type."""
    import pandas as pd

    assert layout.type is not None
    assert layout.value is not None
    frame, value = table.frame, _column(table, layout.value, "Generation (MW)")
    # When clocks go back, an hour occurs twice; the order of its rows distinguishes the two.
    repetition = frame.groupby([time, layout.type], sort=False).cumcount()
    keys = [frame[time], repetition.rename("_again")]
    rows = frame.index.to_series().groupby(keys, sort=False).first()
    wide = frame.assign(_again=repetition).pivot(
        index=[time, "_again"], columns=layout.type, values=value
    )
    wide = wide.fillna("").reindex(rows.index)
    wide[time] = wide.index.get_level_values(0)
    wide.index = pd.Index(rows.to_numpy())
    return files.Table(table.path, wide)


def _interval_starts(
    table: files.Table, layout: SavedTable, column: str, values: list[str]
) -> tuple[files.Table, pd.DatetimeIndex]:
    """Return the rows whose interval exists, and the starts of these intervals in UTC."""
    import pandas as pd

    text = table.frame[column].str.strip()
    parts = text.str.extract(_INTERVAL)
    valid = f"an interval such as {layout.time_example}"
    table.refuse(column, parts[0].isna(), valid)
    iso = parts[2] + "-" + parts[1] + "-" + parts[0] + " " + parts[3]
    naive = pd.to_datetime(iso, errors="coerce", format="%Y-%m-%d %H:%M")
    table.refuse(column, naive.isna(), "a day of the calendar")
    if "UTC" in column or text.iloc[0].endswith("(UTC)"):
        return table, pd.DatetimeIndex(naive)
    is_summer = parts[4].map({"CEST": True, "CET": False})
    # In tables without time zones, the two hours at the end of summer time are in order.
    ambiguous: Any = "infer"
    if is_summer.notna().any():
        ambiguous = is_summer.eq(other=True).to_numpy(dtype=bool)
    try:
        starts = pd.DatetimeIndex(naive).tz_localize(
            _BRUSSELS, ambiguous=ambiguous, nonexistent="NaT"
        )
    except ValueError as error:
        raise DataError(
            f"{table.path}: column {column}: {shortened(str(error))}; export the table in UTC"
        ) from None
    skipped = np.asarray(starts.isna())
    cells = table.frame[values].apply(lambda each: each.str.strip().str.lower())
    blank = cells.isin(files.MISSING_TEXT | set(layout.missing)).all(axis=1).to_numpy()
    table.refuse(column, skipped & ~blank, "an hour that clocks do not skip")
    left = files.Table(table.path, table.frame[~skipped])
    return left, starts[~skipped].tz_convert("UTC").tz_localize(None)


def _hourly(path: Path | str, table: pd.DataFrame) -> pd.DataFrame:
    """Return hourly means of a table with intervals of 15, 30 or 60 minutes."""
    import pandas as pd

    steps = np.diff(table.index.to_numpy()).astype("timedelta64[m]").astype(int)
    minutes = int(np.bincount(steps).argmax()) if steps.size else 60
    if minutes not in (15, 30, 60) or (steps % minutes).any():
        raise DataError(f"{path}: steps of {minutes} min, expected 15, 30 or 60 in all rows")
    first, last = table.index[0].floor("h"), table.index[-1].floor("h")
    return hourly_means(table, pd.date_range(first, last, freq="h"), minutes)


def _refuse_repeated(path: Path | str, stamps: pd.Index) -> None:
    is_repeated = stamps.duplicated()
    if is_repeated.any():
        at = stamps[int(np.argmax(is_repeated))]
        raise DataError(f"{path}: {at} UTC comes twice, in this file or another one of the import")
