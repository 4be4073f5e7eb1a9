"""``sdc-taichi data``: list, show and import weather, carbon intensity and workload."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.table import Table

from sdc_taichi.cli.data_fetch import fetch_app, print_imported, print_missing_parts
from sdc_taichi.cli.options import CommandApp, completed_by, out_option
from sdc_taichi.cli.terminal import PlainConsole
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import importing
from sdc_taichi.exogenous.columns import COLUMN_NAMES, column_map
from sdc_taichi.exogenous.registry import (
    find_name,
    imported_sites,
    imported_traces,
    load_site,
    load_trace,
    site_names,
    trace_names,
    user_data_dir,
)
from sdc_taichi.exogenous.series import DesignConditions, Series, statistics
from sdc_taichi.exogenous.stamps import Stamp
from sdc_taichi.exogenous.synthetic import (
    DEFAULT_SEED,
    synthetic_site,
    synthetic_sites,
    synthetic_trace,
    synthetic_traces,
)
from sdc_taichi.exogenous.weather_table import Place

data_app = CommandApp(help="Sites and workload traces.", no_args_is_help=True)
data_app.add_typer(fetch_app, name="fetch")

Seed = Annotated[int, typer.Option(help="Seed of the synthetic year.", min=0)]


def _sites_and_traces() -> list[str]:
    return [*site_names(), *trace_names()]


@data_app.command("list")
def list_data() -> None:
    """List sites and workload traces, their source, and whether they are synthetic or real."""
    console = PlainConsole()
    sites = Table("site", "place", "kind", "weather", "carbon", title="Sites")
    for name in synthetic_sites():
        site = synthetic_site(name)
        sources = (_fitted_to(site.outdoor_c), _fitted_to(site.ci_g_per_kwh))
        sites.add_row(name, site.label, "synthetic", *sources)
    for name, parts in imported_sites().items():
        missing = sorted({"weather", "carbon"} - set(parts))
        try:
            imported = load_site(name)
        except DataError as error:
            kind = f"incomplete: no {missing[0]}" if missing else "damaged"
            sites.add_row(name, "", kind, "" if missing else str(error), "")
            continue
        kind = "synthetic in part" if imported.synthetic else "real"
        sources = (imported.outdoor_c.source, imported.ci_g_per_kwh.source)
        sites.add_row(name, imported.label, kind, *sources)
    traces = Table("trace", "kind", "source", title="Workload traces")
    for name in synthetic_traces():
        traces.add_row(name, "synthetic", _fitted_to(synthetic_trace(name)))
    for name in imported_traces():
        try:
            traces.add_row(name, "real", load_trace(name).source)
        except DataError as error:
            traces.add_row(name, "damaged", str(error))
    console.print(sites)
    console.print(traces)
    console.print(f"Imported files: {user_data_dir()}", soft_wrap=True)


def _fitted_to(series: Series) -> str:
    return "fitted to " + series.source.split("fitted to ")[-1]


@data_app.command("show")
def show_data(
    name: Annotated[
        str,
        typer.Argument(
            help="Site or workload trace.", autocompletion=completed_by(_sites_and_traces)
        ),
    ],
    seed: Seed = DEFAULT_SEED,
    out: Annotated[
        Path | None, out_option("Write a picture (PNG, SVG or PDF) to this file.")
    ] = None,
) -> None:
    """Show the statistics of a site or a workload trace, and a picture of it."""
    console = PlainConsole()
    name = find_name("site or trace", name, (*site_names(), *trace_names()))
    if name in site_names():
        site = load_site(name, seed=seed)
        title = f"{name}: {site.label}, UTC{site.utc_offset_h:+g} h, {site.elevation_m:g} m"
        series = site.series
        design = _design_text(site.design)
    else:
        series, title, design = (load_trace(name, seed=seed),), name, ""
    table = Table("", title=title)
    for s in series:
        table.add_column(f"{s.name.replace('_', ' ')}\n{s.unit}", justify="right")
    columns = [statistics(s) for s in series]
    for row in columns[0]:
        table.add_row(row, *(f"{column[row]:.4g}" for column in columns))
    table.add_row("kind", *("synthetic" if s.synthetic else "real" for s in series))
    table.add_row("resolution", *(f"{s.minutes:g} min" for s in series))
    table.add_row("days", *(f"{s.days:g}" for s in series))
    console.print(table)
    if design:
        console.print(design, soft_wrap=True)
    for source in dict.fromkeys(s.source for s in series):
        console.print(f"Source: {source}", soft_wrap=True)
    for note in dict.fromkeys(note for s in series for note in s.notes):
        console.print(f"Note: {note}", soft_wrap=True)
    if out is not None:
        _write_picture(series, title, out)
        console.print(f"Picture: {out}", soft_wrap=True)


def _design_text(design: DesignConditions | None) -> str:
    """Return the design conditions of a site as text; empty if it has none."""
    if design is None:
        return ""
    extreme = design.extreme_outdoor_c
    highest = "" if extreme is None else f", {extreme:g} C once in 20 years"
    return (
        f"Design conditions: dry bulb {design.outdoor_c:g} C, wet bulb {design.wet_bulb_c:g} C "
        f"(exceeded for 0.4 % of the year){highest}"
    )


def _write_picture(series: tuple[Series, ...], title: str, out: Path) -> None:
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
    except ImportError:
        raise DataError(
            'a picture needs matplotlib: pip install "sdc-taichi[plot]" (or leave out --out)'
        ) from None
    from sdc_taichi.viz.data_figures import draw_year
    from sdc_taichi.viz.plotting import save_picture

    known = FigureCanvasAgg.get_supported_filetypes()
    suffix = out.suffix.lstrip(".").lower()
    if suffix not in known:
        raise DataError(f"{out}: suffix {out.suffix!r}, expected one of .{', .'.join(known)}")
    save_picture(draw_year(series, title), out)


@data_app.command("import")
def import_data(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE|FOLDER...",
            help="EPW or CSV file; a SustainDC data folder; or tables of a service, with --map.",
        ),
    ],
    site: Annotated[
        str | None, typer.Option(help="Name to import under (of a trace, for a workload file).")
    ] = None,
    base: Annotated[
        str | None, typer.Option(help="Embedded site that gives what the file does not.")
    ] = None,
    mapped: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="NAME[:UNIT]=COLUMN|SERVICE",
            help="Column of the file that holds timestamp, avg_CI, a fuel, cpu_load, dry_bulb, "
            "dew_point, relative_humidity or pressure, and its unit, as avg_CI:lb/MWh=MOER; "
            "repeatable. Or the layout of a service: electricity-maps, eia-930, entsoe, watttime.",
        ),
    ] = None,
    area: Annotated[
        str | None,
        typer.Option(help="Balancing authority or zone, of tables that hold several."),
    ] = None,
    stamp: Annotated[
        Stamp, typer.Option(help="What a stamp of a carbon or weather table marks.")
    ] = "auto",
    utc_offset: Annotated[
        float | None,
        typer.Option(help="UTC offset (h), of a carbon file without weather or a weather table."),
    ] = None,
    latitude: Annotated[
        float | None, typer.Option(help="Degrees north, of the station of a weather table.")
    ] = None,
    longitude: Annotated[
        float | None, typer.Option(help="Degrees east, of the station of a weather table.")
    ] = None,
    elevation: Annotated[
        float | None, typer.Option(help="Height above sea level (m), of the station.")
    ] = None,
) -> None:
    """Validate and align files, and store them in the user's data folder."""
    console = PlainConsole()
    if base is not None:
        base = find_name("base", base, synthetic_sites())
    service, columns = _mapping(mapped or [])
    where = {"latitude": latitude, "longitude": longitude, "elevation": elevation}
    if service is not None:
        _refuse_place(where, paths[0])
        item = _import_tables(paths, service, site, base, area, stamp, utc_offset)
        print_imported(console, item)
        print_missing_parts(console, [item], base)
        return
    if len(paths) > 1:
        raise DataError(f"{len(paths)} files: expected one, or tables of one service, with --map")
    if area is not None:
        raise DataError(f"--area {area}: only tables of a service, named by --map, hold several")
    jobs, left_out = _plan_import(paths[0], site, columns)
    if not any(kind == "weather table" for kind, _, _ in jobs):
        _refuse_place(where, paths[0])
    done: list[importing.Imported] = []
    failed: list[DataError] = []
    for kind, file, name in jobs:
        try:
            if kind == "weather":
                item = importing.import_weather(file, name, base)
            elif kind == "weather table":
                place = _place(name, file, utc_offset, where)
                marks: Literal["start", "end"] = "end" if stamp == "end" else "start"
                item = importing.import_weather(
                    file, name, base, place=place, stamp=marks, columns=columns
                )
            elif kind == "carbon":
                item = importing.import_carbon(
                    file, name, base, utc_offset_h=utc_offset, stamp=stamp, columns=columns
                )
            else:
                item = importing.import_workload(file, name, columns=columns)
        except DataError as error:
            failed.append(error)
            continue
        done.append(item)
        print_imported(console, item)
    for file, reason in left_out:
        console.print(f"left out {file}: {reason}", soft_wrap=True)
    print_missing_parts(console, done, base)
    if failed and len(jobs) == 1:
        raise failed[0]
    if failed:
        raise DataError(f"{len(failed)} of {len(jobs)} files not imported; first: {failed[0]}")


def _mapping(mapped: list[str]) -> tuple[str | None, dict[str, str]]:
    """Parse the values of ``--map``.

    Returns:
        Name of the service whose table layout applies, or None; and columns of the file, keyed by
        ``NAME`` or ``NAME:UNIT``.
    """
    columns: dict[str, str] = {}
    for text in mapped:
        key, sign, column = text.partition("=")
        if not sign and len(mapped) == 1:
            return key, {}
        if not sign or not column or key in columns:
            raise DataError(
                f"--map {text}: expected NAME=COLUMN or NAME:UNIT=COLUMN, each name once, of "
                f"{', '.join(COLUMN_NAMES)}; or one service alone"
            )
        columns[key] = column
    try:
        column_map(columns)
    except DataError as error:
        raise DataError(f"--map: {error}") from None
    return None, columns


def _import_tables(
    paths: list[Path],
    service: str,
    site: str | None,
    base: str | None,
    area: str | None,
    stamp: Stamp,
    utc_offset_h: float | None,
) -> importing.Imported:
    """Import tables that have the layout of a service."""
    from sdc_taichi.exogenous.fetch.saved_tables import find_service, import_saved_tables

    find_service(service)
    if stamp != "auto":
        raise DataError(f"--stamp {stamp}: what stamps mark is known for tables of {service}")
    if site is None:
        raise DataError(f"--map {service}: expected --site NAME to import the tables under")
    return import_saved_tables(paths, service, site, base, area=area, utc_offset_h=utc_offset_h)


def _refuse_place(where: Mapping[str, float | None], path: Path) -> None:
    """Raise ``DataError`` if options for weather tables are given with a file of another kind.

    Args:
        where: latitude, longitude and elevation; None if not given.
        path: the file.
    """
    options = [f"--{option}" for option, value in where.items() if value is not None]
    if options:
        raise DataError(
            f"{', '.join(options)}: without effect on {path}, which is no weather table"
        )


def _place(
    name: str, path: Path, utc_offset_h: float | None, where: Mapping[str, float | None]
) -> Place:
    """Return the place of the weather station of a weather table.

    Args:
        name: name of the site.
        path: the weather table, for messages.
        utc_offset_h: UTC offset of the station, in h; None if not given.
        where: latitude and longitude in degrees, elevation in m; None if not given.

    Raises:
        DataError: a value is missing.
    """
    options = {**where, "utc-offset": utc_offset_h}
    if missing := [f"--{option}" for option, value in options.items() if value is None]:
        raise DataError(f"{path}: a weather table, expected {', '.join(missing)} of its station")
    latitude, longitude, elevation, offset = (float(value or 0.0) for value in options.values())
    return Place(name, latitude, longitude, elevation, offset)


def _plan_import(
    path: Path, site: str | None, columns: Mapping[str, str]
) -> tuple[list[tuple[str, Path, str]], list[tuple[Path, str]]]:
    """Determine what to import from a file or a folder.

    Returns:
        Kind, file and site or trace name of each import; and each omitted file with the reason.
    """
    if os.path.isdir(path):
        if columns:
            raise DataError(f"--map: names columns of one file, but {path} is a folder")
        if site is not None:
            raise DataError(f"--site {site}: names one file, but {path} is a folder")
        return importing.plan_folder(path)
    kind = importing.file_kind(path, columns)
    if kind == "weather" and columns:
        raise DataError(f"--map: without effect on the weather file {path}")
    name = site or (importing.default_name(path) if kind == "workload" else None)
    if name is None:
        raise DataError(f"{path}: a {kind} file, expected --site NAME to import it under")
    return [(kind, path, name)], []
