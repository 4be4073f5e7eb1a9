"""Tables of carbon intensity and generation that were saved by hand from the pages of services.

Each service has a layout of its own (``services.yaml``). A layout is brought to the carbon table
that ``read_carbon`` reads, which is kept beside the downloads of the service and imported as these
are.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sdc_taichi.errors import DataError, shortened, suggestion
from sdc_taichi.exogenous import files, importing
from sdc_taichi.exogenous.carbon import MAX_CI_G_PER_KWH
from sdc_taichi.exogenous.columns import column_map
from sdc_taichi.exogenous.fetch.download import downloads_dir, write_file
from sdc_taichi.exogenous.fetch.generation import Period, by_column, carbon_table
from sdc_taichi.exogenous.fetch.services import SavedTable, Service, services

if TYPE_CHECKING:
    import pandas as pd

_MOST_MW = 1e7
_LONGEST_LIST = 12
_BRUSSELS = "Europe/Brussels"
_INTERVAL = r"^(\d\d)[./](\d\d)[./](\d{4}) (\d\d:\d\d)(?::\d\d)?(?: \((CET|CEST|UTC)\))? - .*$"
"""Interval of a table of ENTSO-E: day, month, year, time, and a mark where clocks go back."""


class _Table(NamedTuple):
    """A table of a file, with the number of its row in the file as index."""

    path: Path
    frame: pd.DataFrame
    layout: SavedTable

    def column(self, pattern: str, expected: str) -> str:
        """Name of the first column that a pattern fits."""
        for name in self.frame.columns:
            if re.fullmatch(pattern, name):
                return str(name)
        raise DataError(
            f"{self.path}: row 1: columns {shortened(', '.join(self.frame.columns), 200)}, "
            f"expected {expected}"
        )

    def refuse(self, column: str, wrong: Any, valid: str) -> None:
        """Raise an error that names the first row that is wrong, if one is."""
        if wrong.any():
            at = int(np.argmax(wrong))
            text = self.frame[column].iloc[at]
            raise files.fault(self.path, int(self.frame.index[at]), column, text, valid)


def saved_table_services() -> dict[str, Service]:
    """Services whose saved tables can be imported, by name."""
    return {name: each for name, each in services().items() if each.saved_table is not None}


def find_service(name: str) -> Service:
    """A service whose saved tables can be imported.

    Raises:
        DataError: no such service.
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
    data_dir: Path | None = None,
    *,
    area: str | None = None,
    utc_offset_h: float | None = None,
) -> importing.Imported:
    """Import tables of a service as the carbon intensity of a site.

    Args:
        paths: the files, which are joined in the order of their stamps.
        service_name: name of the service, of ``saved_table_services``.
        site: name of the site.
        base: embedded site that gives what the tables do not.
        data_dir: folder of imported files instead of the user's.
        area: balancing authority or zone, of tables that hold several.
        utc_offset_h: of the site, in h; None is that of its weather or base.

    Raises:
        DataError: names file, row, column, value and what would be valid.
    """
    service = find_service(service_name)
    name = importing.site_name(site, data_dir)
    importing.site_clock(name, base, data_dir, utc_offset_h=utc_offset_h)
    tables = [_read(path, service, area) for path in paths]
    convert = _intensity_table if tables[0].layout.intensity else _generation_table
    content, notes = convert(tables, service)
    folder = downloads_dir(service, data_dir)
    table = write_file(folder / f"{name}_by_hand.csv", content)
    saved = tuple({"file": path.name, "sha256": files.sha256(path)} for path in paths)
    origin = importing.Origin(service.title, service.licence, saved, tuple(notes))
    return importing.import_carbon(
        table,
        name,
        base,
        data_dir,
        utc_offset_h=utc_offset_h,
        stamp=service.stamp,
        origin=origin,
    )


def _read(path: Path, service: Service, area: str | None) -> _Table:
    """Rows of an area in a file."""
    import pandas as pd

    layout = service.saved_table
    assert layout is not None
    frame, first_row = files.read_table(path)
    frame.index = pd.Index(first_row + np.arange(len(frame)))
    if layout.area is None:
        if area is not None:
            raise DataError(f"--area {shortened(area)}: a file of this service holds one area")
        return _Table(path, frame, layout)
    files.require_columns(path, frame, (layout.area,))
    names = frame[layout.area].str.strip()
    known = sorted(set(names))
    if area is not None or len(known) > 1:
        asked = (area or "").upper()
        chosen = [name for name in known if asked in (name.upper(), name.upper().split("|")[-1])]
        if len(chosen) != 1:
            some = ", ".join(known[:_LONGEST_LIST]) + (", ..." * (len(known) > _LONGEST_LIST))
            value = "" if area is None else f" {shortened(area)}"
            raise DataError(
                f"{path}: column {layout.area}: expected --area{value} to be one of {some}"
            )
        frame = frame[names == chosen[0]]
    return _Table(path, frame, layout)


def _intensity_table(tables: Sequence[_Table], service: Service) -> tuple[bytes, list[str]]:
    """Carbon table, and notes, of tables of intensities."""
    import pandas as pd

    layout = tables[0].layout
    assert layout.intensity is not None
    unit = column_map({f"avg_CI:{layout.unit}" if layout.unit else "avg_CI": "x"}).unit("avg_CI")
    parts = []
    for table in tables:
        time = table.column(layout.time, layout.expected)
        intensity = table.column(layout.intensity, layout.expected)
        text = table.frame[intensity]
        rows = table.frame.index.to_numpy()
        values = files.numbers(table.path, text, intensity, rows, 0.0, MAX_CI_G_PER_KWH, "", unit)
        parts.append(pd.Series(values, index=_stamps(table, time)))
    series = pd.concat(parts).sort_index()
    _refuse_repeated(tables[0].path, series.index)
    lines = ["timestamp,avg_CI"]
    for at, value in zip(series.index, series.to_numpy(), strict=True):
        lines.append(f"{at:%Y-%m-%d %H:%M:%S}+00:00,{'' if np.isnan(value) else f'{value:.3f}'}")
    notes = [f"{intensity} read as avg_CI" + (f", in {layout.unit}" if layout.unit else "")]
    return ("\n".join(lines) + "\n").encode(), notes + ([layout.note] if layout.note else [])


def _stamps(table: _Table, column: str) -> pd.DatetimeIndex:
    """Stamps of a column, in UTC."""
    import pandas as pd

    text = table.frame[column].str.strip()
    stamps = pd.to_datetime(text, utc=True, errors="coerce", format=table.layout.time_format)
    table.refuse(column, stamps.isna().to_numpy(), f"a time such as {table.layout.time_example}")
    return pd.DatetimeIndex(stamps).tz_localize(None)


def _generation_table(tables: Sequence[_Table], service: Service) -> tuple[bytes, list[str]]:
    """Carbon table, and notes, of tables of generation that are parts of a year."""
    import pandas as pd

    parts = sorted((_by_type(table, service) for table in tables), key=lambda part: part.index[0])
    whole = pd.concat(parts)
    _refuse_repeated(tables[0].path, whole.index)
    hours = pd.date_range(whole.index[0], whole.index[-1], freq="h")
    whole = whole.reindex(hours)
    starts = [int((part.index[0] - hours[0]).total_seconds() // 3600) for part in parts]
    periods = [
        Period(first, stop) for first, stop in zip(starts, [*starts[1:], len(hours)], strict=True)
    ]
    by_type = {str(name): whole[name].to_numpy(dtype=np.float64) for name in whole.columns}
    values, notes = by_column(by_type, service, periods)
    return carbon_table(hours[0].to_datetime64(), values), notes


def _by_type(table: _Table, service: Service) -> pd.DataFrame:
    """Hourly generation of a table by type, in MWh, indexed by stamps in UTC."""
    import pandas as pd

    layout = table.layout
    time = table.column(layout.time, layout.time.replace("(MTU|Time).*", "MTU"))
    if layout.type in table.frame.columns:
        table = _with_column_per_type(table, time)
        columns = {str(name): str(name) for name in table.frame.columns if name != time}
    else:
        columns = _generation_columns(table)
    codes = {column: _code(table, kind, service) for column, kind in columns.items()}
    if "%" in layout.time_format:
        stamps, known = _stamps(table, time), np.ones(len(table.frame), dtype=bool)
    else:
        stamps, known = _interval_starts(table, time, list(codes))
    _refuse_repeated(table.path, stamps)
    frame = table.frame[known]
    by_type: dict[str, Any] = {}
    for column, code in codes.items():
        text = frame[column].str.replace(",", "", regex=False)
        text = text.mask(text.str.strip().isin(layout.missing), "")
        values = files.numbers(
            table.path, text, column, frame.index.to_numpy(), -_MOST_MW, _MOST_MW
        )
        series = pd.Series(values, index=stamps)
        # Where a type has several columns, those without a value count as 0.
        by_type[code] = by_type[code].add(series, fill_value=0.0) if code in by_type else series
    return _hourly(table.path, pd.DataFrame(by_type).sort_index())


def _generation_columns(table: _Table) -> dict[str, str]:
    """Name of the type of each column of generation."""
    for pattern in table.layout.generation:
        fits = {
            str(name): match[1].strip()
            for name in table.frame.columns
            if (match := re.fullmatch(pattern, " ".join(name.split())))
        }
        if fits:
            return fits
    raise DataError(f"{table.path}: row 1: no column of generation, as the service has them")


def _code(table: _Table, kind: str, service: Service) -> str:
    """Code of a type by its name, or by the longest beginning of it that is known."""
    kind = " ".join(kind.split())
    codes = {name: code for code, each in service.types.items() for name in each.names}
    # Services rename and split types now and then: "Solar without Integrated Battery Storage".
    begins = [name for name in codes if kind.startswith(name)]
    if not begins:
        raise DataError(
            f"{table.path}: row 1: type of generation {shortened(kind)}, expected one of "
            f"{', '.join(codes)}{suggestion(kind, tuple(codes))}"
        )
    return codes[max(begins, key=len)]


def _with_column_per_type(table: _Table, time: str) -> _Table:
    """Table with a column for each type, of one with a row for each type."""
    import pandas as pd

    path, frame, layout = table
    assert layout.type is not None
    assert layout.value is not None
    value = table.column(layout.value, "Generation (MW)")
    # An hour that comes twice, where clocks go back: the order of its rows distinguishes them.
    again = frame.groupby([time, layout.type], sort=False).cumcount()
    keys = [frame[time], again.rename("_again")]
    rows = frame.index.to_series().groupby(keys, sort=False).first()
    wide = frame.assign(_again=again).pivot(
        index=[time, "_again"], columns=layout.type, values=value
    )
    wide = wide.fillna("").reindex(rows.index)
    wide[time] = wide.index.get_level_values(0)
    wide.index = pd.Index(rows.to_numpy())
    return _Table(path, wide, layout)


def _interval_starts(table: _Table, column: str, values: list[str]) -> tuple[pd.DatetimeIndex, Any]:
    """Starts of intervals in UTC, and which rows have one, (T,)."""
    import pandas as pd

    text = table.frame[column].str.strip()
    parts = text.str.extract(_INTERVAL)
    valid = f"an interval such as {table.layout.time_example}"
    table.refuse(column, parts[0].isna().to_numpy(), valid)
    iso = parts[2] + "-" + parts[1] + "-" + parts[0] + " " + parts[3]
    naive = pd.to_datetime(iso, errors="coerce", format="%Y-%m-%d %H:%M")
    table.refuse(column, naive.isna().to_numpy(), "a day of the calendar")
    if "UTC" in column or text.iloc[0].endswith("(UTC)"):
        return pd.DatetimeIndex(naive), np.ones(len(text), dtype=bool)
    is_summer = parts[4].map({"CEST": True, "CET": False})
    # Tables without marks have the two hours in order.
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
    blank = cells.isin(files.MISSING_TEXT | set(table.layout.missing)).all(axis=1).to_numpy()
    table.refuse(column, skipped & ~blank, "an hour that clocks do not skip")
    return starts[~skipped].tz_convert("UTC").tz_localize(None), ~skipped


def _hourly(path: Path, table: pd.DataFrame) -> pd.DataFrame:
    """Hourly means of a table of 15, 30 or 60 minutes."""
    import pandas as pd

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


def _refuse_repeated(path: Path, stamps: pd.Index) -> None:
    again = stamps.duplicated()
    if again.any():
        at = stamps[int(np.argmax(again))]
        raise DataError(f"{path}: {at} UTC comes twice, in this file or another one of the import")
