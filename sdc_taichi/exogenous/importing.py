"""Import of user files: validate, align to the clock, and store in the data folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
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
from sdc_taichi.user_file import list_folder

KINDS = ("weather", "carbon", "workload")
"""Kinds of files, in the order in which a folder is imported."""


@dataclass(frozen=True)
class Imported:
    """Result of the import of one file."""

    kind: str
    """Kind of data in the file: ``weather``, ``carbon`` or ``workload``."""
    name: str
    """Name of the site or trace to which the data belong."""
    source: Path
    """File that was read."""
    target: Path
    """Parquet file that was written."""
    notes: tuple[str, ...]
    """Repairs with their counts, and warnings."""


def file_kind(path: Path, columns: Mapping[str, str] = MappingProxyType({})) -> str:
    """Detect the kind of a file from its content.

    Args:
        path: the file.
        columns: column names in the file by the names that the readers expect, in the syntax of
            ``exogenous.columns``.

    Returns:
        ``weather``, ``weather table``, ``carbon`` or ``workload``.

    Raises:
        DataError: the file is of none of these kinds.
    """
    if files.is_parquet(path):
        metadata = series_file.read_metadata(path) or {}
        if metadata.get("kind") in KINDS:
            return str(metadata["kind"])
        header = set(series_file.column_names(path))
    else:
        names = files.csv_header(path)
        if names and names[0].strip().upper() == "LOCATION":
            return "weather"
        header = {name.strip() for name in names}
    kinds = {"avg_CI": "carbon", "cpu_load": "workload", "dry_bulb": "weather table"}
    mapped = column_map(columns).names
    for column, kind in sorted(kinds.items(), key=lambda item: item[0] not in mapped):
        if mapped.get(column, column) in header:
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
    """Provenance of a fetched file, which is stored with its data."""

    service: str
    """Name and publisher of the service."""
    licence: str
    """Licence of the data, as far as it is known."""
    downloads: tuple[Mapping[str, Any], ...]
    """Address, time in UTC and checksum of each download from which the file was built."""
    notes: tuple[str, ...] = ()
    """Conversions between the downloads and the file, with their counts."""


def site_name(name: str) -> str:
    """Return the name under which a site is or will be stored.

    Raises:
        DataError: the name is not usable, or belongs to an embedded site.
    """
    return _stored_name(new_name("site", name, synthetic_sites()), imported_sites())


def import_weather(
    path: Path,
    name: str,
    base: str | None,
    *,
    place: Place | None = None,
    stamp: Literal["start", "end"] = "start",
    columns: Mapping[str, str] = MappingProxyType({}),
    origin: Origin | None = None,
) -> Imported:
    """Store a weather file as ``sites/NAME/weather.parquet``, with its origin if it was fetched.

    A table does not contain the location of its station, so ``read_weather_table`` reads it with
    ``place``, ``stamp`` and ``columns``. Without a place, the file must be an EPW file.
    """
    name = site_name(name)
    if place is None:
        weather = read_epw(path)
    else:
        weather = read_weather_table(path, place, columns=columns, stamp=stamp)
    series = [
        weather.outdoor_c,
        weather.wet_bulb_c,
        weather.relative_humidity_pct,
        weather.pressure_pa,
    ]
    if origin is not None and place is not None:
        # Services offer tables of typical years, whose stamps have a placeholder for the year.
        series = [x and replace(x, year=None) for x in series]
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
    target = user_data_dir() / "sites" / name / "weather.parquet"
    return _store(path, name, target, [s for s in series if s is not None], metadata, origin)


def _design_metadata(design: DesignConditions | None) -> dict[str, float] | None:
    """Return the known design conditions as numbers by name."""
    if design is None:
        return None
    return {name: value for name, value in asdict(design).items() if value is not None}


def import_carbon(
    path: Path,
    name: str,
    base: str | None,
    *,
    utc_offset_h: float | None = None,
    stamp: Stamp = "auto",
    columns: Mapping[str, str] = MappingProxyType({}),
    origin: Origin | None = None,
) -> Imported:
    """Store a carbon file, with its origin if it was fetched, as ``sites/NAME/carbon.parquet``.

    ``site_clock`` describes the UTC offset; ``read_carbon`` describes ``stamp`` and ``columns``.

    Raises:
        DataError: the UTC offset is not known, or differs from that of the weather.
    """
    name = site_name(name)
    offset, longitude = site_clock(name, base, utc_offset_h=utc_offset_h)
    series = read_carbon(path, offset, stamp, longitude_deg=longitude, columns=columns)
    metadata = {"kind": "carbon", "utc_offset_h": offset, "pairing": "local", "base": base}
    target = user_data_dir() / "sites" / name / "carbon.parquet"
    return _store(path, name, target, [series], metadata, origin)


def site_clock(
    name: str, base: str | None, *, utc_offset_h: float | None
) -> tuple[float, float | None]:
    """Return the UTC offset of a site in h, and its longitude in degrees east (None if unknown).

    The offset is that of the weather imported under the same name. Without weather it is
    ``utc_offset_h``, and without that the offset of the base.

    Args:
        name: name of the site.
        base: embedded site that supplies missing data.
        utc_offset_h: local standard time minus UTC, in h.

    Raises:
        DataError: no offset is known, or ``utc_offset_h`` differs from the known one.
    """
    offset, longitude = utc_offset_h, None
    weather_path = imported_sites().get(name, {}).get("weather")
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
    path: Path, name: str, *, columns: Mapping[str, str] = MappingProxyType({})
) -> Imported:
    """Store a workload file as ``traces/NAME.parquet``; see ``read_workload`` for ``columns``."""
    name = _stored_name(new_name("trace", name, synthetic_traces()), imported_traces())
    target = user_data_dir() / "traces" / f"{name}.parquet"
    trace = read_workload(path, columns=columns)
    return _store(path, name, target, [trace], {"kind": "workload"})


def plan_folder(folder: Path) -> tuple[list[tuple[str, Path, str]], list[tuple[Path, str]]]:
    """Plan the import of a folder with carbon, weather and workload files, like SustainDC's.

    Every weather file becomes a site, with the carbon file of the same state. The site name of a
    state's main station is like ``NY-real``; other stations append their own name. The main station
    is the one to which the embedded year was fitted, or else the first. Every workload file becomes
    a trace.

    Returns:
        Kind, path and name of each import, weather before carbon; and the skipped files, each with
        the reason.

    Raises:
        DataError: the folder has none of the subfolders, or they contain no files.
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
    """Return the stem of a file name as a valid name, with ``-`` for invalid characters."""
    return _clean(path.stem)


def _stored_name(name: str, existing: Iterable[str]) -> str:
    """Return the name with the spelling of an existing name that differs only in case."""
    return next((x for x in existing if x.casefold() == name.casefold()), name)


def _clean(text: str) -> str:
    """Return the text with ``-`` in place of each character that is not valid in a name."""
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
            "year": series[0].year,
            "source_file": source.name,
            "sha256": files.sha256(source),
            "notes": list(notes),
            "created_by": f"sdc-taichi {version('sdc-taichi')}",
        },
    )
    return Imported(metadata["kind"], name, source, target, notes)
