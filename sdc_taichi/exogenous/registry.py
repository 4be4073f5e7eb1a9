"""Sites and workload traces by name: the embedded ones and those the user imported.

Imported files are in ``$SDC_TAICHI_DATA``, or in the platform's folder for user data:
``sites/NAME/weather.parquet``, ``sites/NAME/carbon.parquet``, ``traces/NAME.parquet``. An imported
name never hides an embedded one.
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
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


def user_data_dir(data_dir: str | Path | None = None) -> Path:
    """Folder of imported files: the argument, ``$SDC_TAICHI_DATA``, or the platform's folder."""
    if data_dir is not None:
        return Path(data_dir)
    if os.environ.get("SDC_TAICHI_DATA"):
        return Path(os.environ["SDC_TAICHI_DATA"])
    import platformdirs

    return Path(platformdirs.user_data_dir("sdc-taichi", appauthor=False))


def imported_sites(data_dir: str | Path | None = None) -> dict[str, dict[str, Path]]:
    """Imported sites: name to ``{"weather": path, "carbon": path}``, either may be missing."""
    sites: dict[str, dict[str, Path]] = {}
    folder = user_data_dir(data_dir) / "sites"
    for name in list_folder(folder, DataError):
        paths = {part: folder / name / f"{part}.parquet" for part in ("carbon", "weather")}
        parts = {part: path for part, path in paths.items() if os.path.lexists(path)}
        if parts:
            sites[name] = parts
    return sites


def imported_traces(data_dir: str | Path | None = None) -> dict[str, Path]:
    """Imported workload traces: name to path."""
    folder = user_data_dir(data_dir) / "traces"
    names = [x for x in list_folder(folder, DataError) if x.endswith(".parquet")]
    return {name.removesuffix(".parquet"): folder / name for name in names}


def site_names(data_dir: str | Path | None = None) -> tuple[str, ...]:
    """Embedded sites, then imported ones."""
    return (*synthetic_sites(), *imported_sites(data_dir))


def trace_names(data_dir: str | Path | None = None) -> tuple[str, ...]:
    """Embedded workload traces, then imported ones."""
    return (*synthetic_traces(), *imported_traces(data_dir))


def find_name(kind: str, name: str, valid: tuple[str, ...]) -> str:
    """The valid name that equals ``name`` up to case.

    Raises:
        DataError: none does; names the nearest valid ones.
    """
    by_folded = {x.casefold(): x for x in valid}
    valid_name = by_folded.get(name.strip().casefold())
    if valid_name is None:
        near = similar_names(name, valid, most=3)
        nearest = f"; nearest: {', '.join(near)}" if near else ""
        raise DataError(f"{kind} {shortened(name)}: expected one of {', '.join(valid)}{nearest}")
    return valid_name


def new_name(kind: str, name: str, embedded: tuple[str, ...]) -> str:
    """Check a name for an import.

    Raises:
        DataError: not usable as a folder name, or that of an embedded site or trace.
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
    """Weather and carbon intensity of a site.

    Args:
        name: embedded or imported, any case.
        seed: of the synthetic year, for embedded sites and for embedded parts of imported ones.
        data_dir: folder of imported files instead of the user's.

    Raises:
        DataError: unknown name, an imported site that lacks a part and was not given a base, or
            an imported file that is damaged.
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
    """Air pressure of the standard atmosphere at the height of a site, in Pa.

    Reads no more than the header of a file, unlike ``load_site``.

    Args:
        name: embedded or imported, any case.
        weather_file: EPW or imported Parquet in place of the weather of ``name``.
        data_dir: folder of imported files instead of the user's.

    Raises:
        DataError: unknown name, or a file that is damaged.
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
    """A workload trace, share of the capacity.

    Args:
        name: embedded or imported, any case.
        seed: of the synthetic year, for embedded traces.
        data_dir: folder of imported files instead of the user's.

    Raises:
        DataError: unknown name, or an imported file that is damaged.
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
    """A site from a weather file, a carbon file, or both, without importing them.

    The weather file's header gives location and UTC offset. What no file gives is taken from
    ``base``, and is then synthetic if the base is.

    Args:
        base: site that gives what is missing; None if both files are given.
        weather: EPW or imported Parquet.
        carbon: CSV or imported Parquet.
        name: name of the site; None is that of the base, or the stem of the weather file.
        stamp: what a stamp of the carbon file marks, see ``read_carbon``.
        pairing: see ``read_carbon``.

    Raises:
        DataError: neither file nor base gives a part, or a file is not valid.
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
    """State of a weather station of the USA, by the label of its file; else None."""
    *_, state, country = ("", "", *label.split(", "))
    return state if country == "USA" else None


def _with_region_note(intensity: Series, state: str | None) -> Series:
    """Carbon intensity with a warning if its file is named after another state, as SustainDC's are.

    Args:
        intensity: read from a file.
        state: two letters of the state of the weather; None if it is not known.
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
