"""Sites and workload traces by name, both embedded ones and those that the user imported.

Imported files are in ``$SDC_TAICHI_DATA``, or in the platform's folder for user data. They are
``sites/NAME/weather.parquet``, ``sites/NAME/carbon.parquet`` and ``traces/NAME.parquet``. An
imported site or trace cannot have the name of an embedded one.
"""

from __future__ import annotations

import os
import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from sdc_taichi.errors import DataError, shortened, similar_names
from sdc_taichi.exogenous import series_file
from sdc_taichi.exogenous.carbon import Pairing, read_carbon
from sdc_taichi.exogenous.psychrometrics import standard_pressure_pa
from sdc_taichi.exogenous.series import Series, SiteData, Weather
from sdc_taichi.exogenous.stamps import Stamp
from sdc_taichi.exogenous.synthetic import (
    DEFAULT_SEED,
    coefficients,
    synthetic_site,
    synthetic_sites,
    synthetic_trace,
    synthetic_traces,
)
from sdc_taichi.exogenous.weather import read_elevation_m, read_epw
from sdc_taichi.exogenous.workload import read_workload
from sdc_taichi.user_file import list_folder

_STATE_OF_CARBON_FILE = re.compile(r"([A-Z]{2})_NG_")
_FILE_FIELDS = {
    "site": "site.weather_file and site.carbon_file (--weather, --carbon)",
    "trace": "site.workload_file (--workload)",
}
"""Fields and options for files in place of names, by what the name would be of."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


def user_data_dir(data_dir: str | Path | None = None) -> Path:
    """Return the folder of imported files: ``data_dir``, ``$SDC_TAICHI_DATA``, or the default."""
    if data_dir is not None:
        return Path(data_dir)
    if os.environ.get("SDC_TAICHI_DATA"):
        return Path(os.environ["SDC_TAICHI_DATA"])
    import platformdirs

    return Path(platformdirs.user_data_dir("sdc-taichi", appauthor=False))


def imported_sites(data_dir: str | Path | None = None) -> dict[str, dict[str, Path]]:
    """Return the files of each imported site, by ``weather`` and ``carbon``; one may be missing."""
    sites: dict[str, dict[str, Path]] = {}
    folder = user_data_dir(data_dir) / "sites"
    for name in list_folder(folder, DataError):
        paths = {part: folder / name / f"{part}.parquet" for part in ("carbon", "weather")}
        parts = {part: path for part, path in paths.items() if os.path.lexists(path)}
        if parts:
            sites[name] = parts
    return sites


def imported_traces(data_dir: str | Path | None = None) -> dict[str, Path]:
    """Return the path of each imported workload trace, by name."""
    folder = user_data_dir(data_dir) / "traces"
    names = [x for x in list_folder(folder, DataError) if x.endswith(".parquet")]
    return {name.removesuffix(".parquet"): folder / name for name in names}


def site_names(data_dir: str | Path | None = None) -> tuple[str, ...]:
    """Return the names of all sites, embedded ones first."""
    return (*synthetic_sites(), *imported_sites(data_dir))


def trace_names(data_dir: str | Path | None = None) -> tuple[str, ...]:
    """Return the names of all workload traces, embedded ones first."""
    return (*synthetic_traces(), *imported_traces(data_dir))


def find_name(kind: str, name: str, valid: tuple[str, ...]) -> str:
    """Return the valid name that equals ``name``, ignoring case.

    Raises:
        DataError: no valid name is equal; the message lists the most similar ones.
    """
    by_folded = {x.casefold(): x for x in valid}
    valid_name = by_folded.get(name.strip().casefold())
    if valid_name is None:
        near = similar_names(name, valid, most=3)
        nearest = f"; nearest: {', '.join(near)}" if near else ""
        is_file = re.search(r"[/\\]|\.[a-z]\w+$", name.lower()) and kind in _FILE_FIELDS
        file = f"; a file is the value of {_FILE_FIELDS[kind]}" if is_file else ""
        raise DataError(
            f"{kind} {shortened(name)}: expected one of {', '.join(valid)}{nearest}{file}"
        )
    return valid_name


def new_name(kind: str, name: str, embedded: tuple[str, ...]) -> str:
    """Check the name of a new import, and return it.

    Raises:
        DataError: the name cannot be a folder name, or belongs to an embedded site or trace.
    """
    if not _NAME.fullmatch(name):
        raise DataError(
            f"{kind} {shortened(name)}: expected 1 to 64 letters, digits, '_' or '-', beginning "
            "with a letter or digit"
        )
    if name.casefold() in {x.casefold() for x in embedded}:
        raise DataError(
            f"{kind} {name!r}: is the embedded synthetic one, expected another name such as "
            f"{name}-real"
        )
    return name


def load_site(
    name: str, *, seed: int = DEFAULT_SEED, data_dir: str | Path | None = None
) -> SiteData:
    """Load weather and carbon intensity of a site.

    Args:
        name: name of an embedded or imported site; case is ignored.
        seed: seed of the synthetic year, for embedded sites and embedded parts of imported sites.
        data_dir: folder of imported files instead of the user's.

    Raises:
        DataError: the name is unknown, an imported site lacks a part and has no base, or an
            imported file is damaged.
    """
    name = find_name("site", name, site_names(data_dir))
    if name in synthetic_sites():
        return synthetic_site(name, seed)
    parts = imported_sites(data_dir)[name]
    bases = {str(m["base"]) for m in map(_metadata, parts.values()) if m.get("base")}
    missing = sorted({"weather", "carbon"} - set(parts))
    if missing and not bases:
        raise DataError(
            f"site {name!r}: imported without {missing[0]}; import a {missing[0]} file with "
            f"--site {name}, or import again with --base SITE to take it from an embedded site"
        )
    base = (
        synthetic_site(find_name("base", bases.pop(), synthetic_sites()), seed) if bases else None
    )
    return site_from_files(base, parts.get("weather"), parts.get("carbon"), name)


def site_pressure_pa(
    name: str, weather_file: str | Path | None = None, *, data_dir: str | Path | None = None
) -> float:
    """Return the pressure of the standard atmosphere at the elevation of a site, in Pa.

    Unlike ``load_site``, this function reads only the header of a file.

    Args:
        name: name of an embedded or imported site; case is ignored.
        weather_file: EPW or imported Parquet file that replaces the weather of ``name``.
        data_dir: folder of imported files instead of the user's.

    Raises:
        DataError: the name is unknown, or a file is damaged.
    """
    if weather_file is not None:
        return float(standard_pressure_pa(read_elevation_m(weather_file)))
    name = find_name("site", name, site_names(data_dir))
    if name not in synthetic_sites():
        parts = imported_sites(data_dir)[name]
        if "weather" in parts:
            return site_pressure_pa(name, parts["weather"])
        name = str(_metadata(parts["carbon"]).get("base", ""))
        name = find_name("base", name, synthetic_sites())
    return float(standard_pressure_pa(coefficients()["weather"][name]["elevation_m"]))


def load_trace(
    name: str, *, seed: int = DEFAULT_SEED, data_dir: str | Path | None = None
) -> Series:
    """Load a workload trace, as a share of the capacity.

    Args:
        name: name of an embedded or imported trace; case is ignored.
        seed: seed of the synthetic year, for embedded traces.
        data_dir: folder of imported files instead of the user's.

    Raises:
        DataError: the name is unknown, or an imported file is damaged.
    """
    name = find_name("trace", name, trace_names(data_dir))
    if name in synthetic_traces():
        return synthetic_trace(name, seed)
    return read_workload(imported_traces(data_dir)[name])


def site_from_files(
    base: SiteData | None,
    weather: str | Path | None = None,
    carbon: str | Path | None = None,
    name: str | None = None,
    *,
    stamp: Stamp = "auto",
    pairing: Pairing = "local",
) -> SiteData:
    """Build a site from a weather file, a carbon file, or both, without importing them.

    The weather file's header gives location and UTC offset. ``base`` supplies the data without a
    file, which are synthetic if the base is.

    Args:
        base: site that supplies missing data; None if both files are given.
        weather: EPW or imported Parquet file.
        carbon: CSV or imported Parquet file.
        name: name of the site; None stands for that of the base, or the stem of the weather file.
        stamp: moment that a stamp of the carbon file marks, see ``read_carbon``.
        pairing: see ``read_carbon``.

    Raises:
        DataError: a part has neither a file nor a base, or a file is not valid.
    """
    if weather is not None:
        station: Weather = read_epw(weather)
        name = name or (base.name if base else Path(weather).stem)
    elif base is not None:
        station = base
        name = name or base.name
    else:
        raise DataError("weather: no file and no base site, expected one of them")
    if carbon is not None:
        intensity = read_carbon(
            carbon,
            station.utc_offset_h,
            stamp,
            pairing=pairing,
            longitude_deg=station.longitude_deg,
        )
        here = base.name if weather is None and base is not None else _state(station.label)
        intensity = _with_region_note(intensity, here)
    elif base is not None:
        intensity = base.ci_g_per_kwh
        if base.utc_offset_h != station.utc_offset_h:
            note = f"of {base.name} at UTC{base.utc_offset_h:+g} h, on the clock of that site"
            intensity = replace(intensity, notes=(*intensity.notes, note))
    else:
        raise DataError("carbon: no file and no base site, expected one of them")
    of_weather = {field.name: getattr(station, field.name) for field in fields(Weather)}
    return SiteData(name=name, ci_g_per_kwh=intensity, **of_weather)


def _state(label: str) -> str | None:
    """Return the state of a US weather station, from the label of its file; else None."""
    *_, state, country = ("", "", *label.split(", "))
    return state if country == "USA" else None


def _with_region_note(intensity: Series, state: str | None) -> Series:
    """Add a warning to carbon intensity if its file name has the code of another state.

    Args:
        intensity: carbon intensity from a file; SustainDC's files are named after states.
        state: two-letter code of the state of the weather; None if it is not known.
    """
    named = _STATE_OF_CARBON_FILE.match(intensity.source)
    has_note = any("another region" in note for note in intensity.notes)
    if named is None or state is None or named[1] == state or has_note:
        return intensity
    note = f"warning: named after {named[1]}, another region than the weather's, {state}"
    return replace(intensity, notes=(*intensity.notes, note))


def _metadata(path: Path) -> dict[str, Any]:
    metadata = series_file.read_metadata(path)
    if metadata is None:
        raise DataError(f"{path}: no sdc_taichi metadata, expected a file written by `data import`")
    return metadata
