"""Validate, align and store files in the user's data folder."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import files, series_file
from sdc_taichi.exogenous.carbon import read_carbon
from sdc_taichi.exogenous.columns import column_map
from sdc_taichi.exogenous.registry import (
    find_name,
    imported_sites,
    imported_traces,
    new_name,
    user_data_dir,
)
from sdc_taichi.exogenous.series import DesignConditions, Series
from sdc_taichi.exogenous.stamps import Stamp
from sdc_taichi.exogenous.synthetic import (
    coefficients,
    synthetic_site,
    synthetic_sites,
    synthetic_traces,
)
from sdc_taichi.exogenous.weather import read_epw
from sdc_taichi.exogenous.weather_table import Place, read_weather_table
from sdc_taichi.exogenous.workload import read_workload
from sdc_taichi.user_file import MOST_TABLE_BYTES, list_folder, open_input

KINDS = ("weather", "carbon", "workload")
"""Kinds of files, in the order in which a folder is imported."""


@dataclass(frozen=True)
class Imported:
    """A file that was imported."""

    kind: str
    """Kind of data in the file: ``weather``, ``carbon`` or ``workload``."""
    name: str
    """Name of the site or trace that it became, or became part of."""
    source: Path
    """The file that was read."""
    target: Path
    """The Parquet file that was written."""
    notes: tuple[str, ...]
    """Repairs, with counts, and warnings."""


def file_kind(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> str:
    """Kind of a file by its content: ``weather``, ``weather table``, ``carbon`` or ``workload``.

    Args:
        path: the file.
        columns: names of columns as the readers expect them, and their names in the file, as of
            ``exogenous.columns``.

    Raises:
        DataError: none of them.
    """
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path) or {}
        if metadata.get("kind") in KINDS:
            return str(metadata["kind"])
        header = set(series_file.column_names(path))
    else:
        with open_input(path, MOST_TABLE_BYTES, DataError) as handle:
            line = handle.readline(4096).decode("utf-8", errors="replace").lstrip("\ufeff").strip()
        if line.upper().startswith("LOCATION,"):
            return "weather"
        header = {cell.strip() for cell in next(csv.reader([line]), [])}
    kinds = {"avg_CI": "carbon", "cpu_load": "workload", "dry_bulb": "weather table"}
    names = column_map(columns).names
    for column, kind in sorted(kinds.items(), key=lambda item: item[0] not in names):
        if names.get(column, column) in header:
            return kind
    hint = files.mapping_hint(header) or (
        " or --map avg_CI=COLUMN, --map cpu_load=COLUMN, --map dry_bulb=COLUMN"
    )
    raise DataError(
        f"{path}: row 1: expected an EPW file (LOCATION,...), a column avg_CI (carbon) or "
        f"a column cpu_load (workload){hint}"
    )


@dataclass(frozen=True)
class Origin:
    """Source of a fetched file, which is stored with its data."""

    service: str
    """Name of the service, with its publisher."""
    licence: str
    """Licence of the data, or what is known of it."""
    downloads: tuple[Mapping[str, Any], ...]
    """Address, time in UTC and checksum of each download that the file was made of."""
    notes: tuple[str, ...] = ()
    """What was done to the downloads to make the file, with counts."""


def site_name(name: str, data_dir: Path | None = None) -> str:
    """Name under which a site is or will be imported.

    Raises:
        DataError: not usable, or that of an embedded site.
    """
    return _stored_name(new_name("site", name, synthetic_sites()), imported_sites(data_dir))


def import_weather(
    path: Path,
    name: str,
    base: str | None,
    data_dir: Path | None = None,
    *,
    place: Place | None = None,
    stamp: Literal["start", "end"] = "start",
    columns: Mapping[str, str] = MappingProxyType({}),
    origin: Origin | None = None,
) -> Imported:
    """Store a weather file as ``sites/NAME/weather.parquet``, with its origin if it was fetched.

    A table, which does not say where its station is, is read by ``read_weather_table`` with
    ``place``, ``stamp`` and ``columns``; without a place the file is an EPW file.
    """
    name = site_name(name, data_dir)
    if place is None:
        weather = read_epw(path)
    else:
        weather = read_weather_table(path, place, columns=columns, stamp=stamp)
    series = (
        weather.outdoor_c,
        weather.wet_bulb_c,
        weather.relative_humidity_pct,
        weather.pressure_pa,
    )
    metadata = {
        "kind": "weather",
        "label": weather.label,
        "latitude_deg": weather.latitude_deg,
        "longitude_deg": weather.longitude_deg,
        "elevation_m": weather.elevation_m,
        "utc_offset_h": weather.utc_offset_h,
        "design": _design_metadata(weather.design),
        "base": base,
    }
    target = user_data_dir(data_dir) / "sites" / name / "weather.parquet"
    return _store(path, name, target, [s for s in series if s is not None], metadata, origin)


def _design_metadata(design: DesignConditions | None) -> dict[str, float] | None:
    """Design conditions as numbers by name, without what is not known."""
    if design is None:
        return None
    return {name: value for name, value in asdict(design).items() if value is not None}


def import_carbon(
    path: Path,
    name: str,
    base: str | None,
    data_dir: Path | None = None,
    *,
    utc_offset_h: float | None = None,
    stamp: Stamp = "auto",
    columns: Mapping[str, str] = MappingProxyType({}),
    origin: Origin | None = None,
) -> Imported:
    """Store a carbon file, with its origin if it was fetched, as ``sites/NAME/carbon.parquet``.

    The UTC offset is that of ``site_clock``; ``stamp`` and ``columns`` are those of
    ``read_carbon``.

    Raises:
        DataError: the UTC offset is not known, or differs from that of the weather.
    """
    name = site_name(name, data_dir)
    offset, longitude = site_clock(name, base, data_dir, utc_offset_h=utc_offset_h)
    series = read_carbon(path, offset, stamp, longitude_deg=longitude, columns=columns)
    metadata = {"kind": "carbon", "utc_offset_h": offset, "pairing": "local", "base": base}
    target = user_data_dir(data_dir) / "sites" / name / "carbon.parquet"
    return _store(path, name, target, [series], metadata, origin)


def site_clock(
    name: str,
    base: str | None,
    data_dir: Path | None = None,
    *,
    utc_offset_h: float | None = None,
) -> tuple[float, float | None]:
    """UTC offset of a site, in h, and its longitude, in degrees east, None if it is not known.

    The offset is that of the weather imported under the same name. Without weather it is
    ``utc_offset_h``, and without that the offset of the base.

    Args:
        name: name of the site.
        base: embedded site that gives what is missing.
        data_dir: folder of imported files instead of the user's.
        utc_offset_h: local standard time minus UTC, in h.

    Raises:
        DataError: none of them is known, or they differ.
    """
    offset, longitude = utc_offset_h, None
    weather_path = imported_sites(data_dir).get(name, {}).get("weather")
    if weather_path is not None or (base is not None and offset is None):
        if weather_path is not None:
            station = read_epw(weather_path)
            known, longitude = station.utc_offset_h, station.longitude_deg
        else:
            site = synthetic_site(find_name("base", base or "", synthetic_sites()))
            known, longitude = site.utc_offset_h, site.longitude_deg
        if offset is not None and offset != known:
            raise DataError(f"utc_offset_h: {offset:g}, expected {known:g} as in the weather file")
        offset = known
    if offset is None:
        raise DataError(
            f"UTC offset of site {name!r} unknown, expected the weather imported first, "
            "--base SITE or --utc-offset HOURS"
        )
    return offset, longitude


def import_workload(
    path: Path,
    name: str,
    data_dir: Path | None = None,
    *,
    columns: Mapping[str, str] = MappingProxyType({}),
) -> Imported:
    """Store a workload file, with ``columns`` of ``read_workload``, as ``traces/NAME.parquet``."""
    name = _stored_name(new_name("trace", name, synthetic_traces()), imported_traces(data_dir))
    target = user_data_dir(data_dir) / "traces" / f"{name}.parquet"
    trace = read_workload(path, columns=columns)
    return _store(path, name, target, [trace], {"kind": "workload"})


def plan_folder(folder: Path) -> tuple[list[tuple[str, Path, str]], list[tuple[Path, str]]]:
    """Plan the import of a SustainDC ``data`` folder, or of one with carbon, weather, workload.

    Every weather file becomes a site, with the carbon file of its state. The station that the
    embedded year is fitted to, or without it the first of the state, is named like ``NY-real``;
    other stations have their own name added. Every workload file becomes a trace.

    Returns:
        Kind, path and name of each import, weather before carbon; and the files left out, each
        with the reason.

    Raises:
        DataError: the folder has none of the subfolders, or no file in them.
    """
    subfolders = {
        "weather": ("weather", ".epw"),
        "carbonintensity": ("carbon", ".csv"),
        "carbon": ("carbon", ".csv"),
        "workload": ("workload", ".csv"),
    }
    files_of_kind: dict[str, list[Path]] = {kind: [] for kind in KINDS}
    for name in list_folder(folder, DataError):
        if name.casefold() in subfolders:
            kind, suffix = subfolders[name.casefold()]
            inside = [folder / name / x for x in list_folder(folder / name, DataError)]
            files_of_kind[kind] += [path for path in inside if path.suffix.lower() == suffix]
    if not any(files_of_kind.values()):
        raise DataError(
            f"{folder}: expected subfolders CarbonIntensity, Weather, Workload with EPW and CSV "
            "files (the data folder of SustainDC)"
        )
    carbon = {path.name.split("_")[0]: path for path in files_of_kind["carbon"]}
    fitted = {name: str(table["station"]) for name, table in coefficients()["weather"].items()}
    by_state: dict[str, list[tuple[Path, str]]] = {}
    for path in files_of_kind["weather"]:
        parts = path.stem.split("_", 2)
        is_state = len(parts) == 3 and parts[0] == "USA"
        state, station = (parts[1], parts[2]) if is_state else (path.stem, path.stem)
        by_state.setdefault(state, []).append((path, station))
    plan: list[tuple[str, Path, str]] = []
    for state, stations in by_state.items():
        stations.sort(key=lambda x: (not fitted.get(state, "").startswith(x[1]), x[1]))
        for i, (path, station) in enumerate(stations):
            name = _clean(f"{state}-real" if i == 0 else f"{state}-{station}-real")
            plan.append(("weather", path, name))
            if state in carbon:
                plan.append(("carbon", carbon[state], name))
    plan += [("workload", path, default_name(path)) for path in files_of_kind["workload"]]
    left_out = [
        (path, f"no weather file of {key}; import it with --site NAME --base SITE")
        for key, path in carbon.items()
        if key not in by_state
    ]
    return plan, left_out


def default_name(path: Path) -> str:
    """Name of a file without suffix, made valid as a name."""
    return _clean(path.stem)


def _stored_name(name: str, existing: Iterable[str]) -> str:
    """The name as it is stored already, if it differs in case alone."""
    return next((x for x in existing if x.casefold() == name.casefold()), name)


def _clean(text: str) -> str:
    """The text with what is not valid in a name replaced by ``-``."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in text).strip(
        "-"
    )


def _store(
    source: Path,
    name: str,
    target: Path,
    series: list[Series],
    metadata: dict[str, Any],
    origin: Origin | None = None,
) -> Imported:
    from importlib.metadata import version

    notes = series[0].notes
    if origin is not None:
        notes = (f"licence: {origin.licence}", *origin.notes, *notes)
        known = {"service": origin.service, "licence": origin.licence}
        metadata |= {"origin": known | {"downloads": [dict(x) for x in origin.downloads]}}
    series_file.write_parquet(
        target,
        {s.name: s.values for s in series},
        {
            **metadata,
            "name": name,
            "minutes": series[0].minutes,
            "source_file": source.name,
            "sha256": files.sha256(source),
            "notes": list(notes),
            "created_by": f"sdc-taichi {version('sdc-taichi')}",
        },
    )
    return Imported(metadata["kind"], name, source, target, notes)
