"""``sdc-taichi data``: list, show and import weather, carbon intensity and workload."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.cli.arguments import out_option
from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import importing
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
from sdc_taichi.exogenous.series import Series, resample
from sdc_taichi.exogenous.statistics import statistics
from sdc_taichi.exogenous.synthetic import (
    DEFAULT_SEED,
    synthetic_site,
    synthetic_sites,
    synthetic_trace,
    synthetic_traces,
)
from sdc_taichi.year_clock import DAYS_PER_YEAR, FIRST_DAY_OF_MONTH, HOURS_PER_YEAR

data_app = typer.Typer(help="Sites and workload traces.", no_args_is_help=True)

Seed = Annotated[int, typer.Option(help="Seed of the synthetic year.", min=0)]


class StampOption(StrEnum):
    """What a stamp of a carbon file marks."""

    AUTO = "auto"
    START = "start"
    END = "end"


@data_app.command("list")
def list_data() -> None:
    """List sites and workload traces, their source, and whether they are synthetic or real."""
    console = Console()
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
def show(
    name: Annotated[str, typer.Argument(help="Site or workload trace.")],
    seed: Seed = DEFAULT_SEED,
    out: Annotated[
        Path | None, out_option("Write a picture (PNG, SVG or PDF) to this file.")
    ] = None,
) -> None:
    """Show the statistics of a site or a workload trace, and a picture of it."""
    console = Console()
    found = find_name("site or trace", name, (*site_names(), *trace_names()))
    if found in site_names():
        site = load_site(found, seed=seed)
        title = f"{found}: {site.label}, UTC{site.utc_offset_h:+g} h, {site.elevation_m:g} m"
        series = site.series
    else:
        series, title = (load_trace(found, seed=seed),), found
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
    for source in dict.fromkeys(s.source for s in series):
        console.print(f"Source: {source}", soft_wrap=True)
    for note in dict.fromkeys(note for s in series for note in s.notes):
        console.print(f"Note: {note}", soft_wrap=True)
    if out is not None:
        write_picture(series, title, out)
        console.print(f"Picture: {out}", soft_wrap=True)


def write_picture(series: tuple[Series, ...], title: str, out: Path) -> None:
    """Draw daily mean and range over the year, and the mean day of four months, per series.

    Args:
        series: whole years; the first year is drawn.
        title: of the figure.
        out: file with a suffix that matplotlib can write.

    Raises:
        SdcError: matplotlib is missing, or the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise DataError(
            'a picture needs matplotlib: pip install "sdc-taichi[plot]" (or leave out --out)'
        ) from None
    kinds = FigureCanvasAgg.get_supported_filetypes()
    kind = out.suffix.lstrip(".").lower()
    if kind not in kinds:
        raise DataError(f"{out}: suffix {out.suffix!r}, expected one of .{', .'.join(kinds)}")
    figure = Figure(figsize=(10.0, 1.0 + 1.9 * len(series)), layout="constrained")
    figure.suptitle(f"{title} (synthetic)" if any(s.synthetic for s in series) else title)
    axes = figure.subplots(len(series), 2, squeeze=False, width_ratios=(3, 1))
    for (year, day), s in zip(axes, series, strict=True):
        hourly = resample(s, 1)[:HOURS_PER_YEAR].reshape(DAYS_PER_YEAR, 24)
        days = range(DAYS_PER_YEAR)
        year.fill_between(days, hourly.min(axis=1), hourly.max(axis=1), alpha=0.3, lw=0)
        year.plot(days, hourly.mean(axis=1), lw=1)
        year.set(
            xlim=(0, DAYS_PER_YEAR - 1),
            xticks=FIRST_DAY_OF_MONTH[:-1],
            ylabel=f"{s.name}\n{s.unit}",
        )
        year.set_xticklabels("JFMAMJJASOND", ha="left")
        for month, label in ((0, "Jan"), (3, "Apr"), (6, "Jul"), (9, "Oct")):
            first, end = FIRST_DAY_OF_MONTH[month : month + 2]
            mean = hourly[first:end].mean(axis=0)
            day.plot([h + 0.5 for h in range(24)], mean, label=label)
        day.set(xlim=(0, 24), xticks=(0, 6, 12, 18, 24))
    axes[0, 0].set_title("Daily mean and range")
    axes[0, 1].set_title("Mean day")
    axes[0, 1].legend(fontsize="small")
    with atomic_write(out) as file:
        figure.savefig(file, dpi=120, format=kind)


@data_app.command("import")
def import_data(
    path: Annotated[Path, typer.Argument(help="EPW or CSV file, or a SustainDC data folder.")],
    site: Annotated[
        str | None, typer.Option(help="Name to import under (of a trace, for a workload file).")
    ] = None,
    base: Annotated[
        str | None, typer.Option(help="Embedded site that gives what the file does not.")
    ] = None,
    utc_offset: Annotated[
        float | None, typer.Option(help="UTC offset (h) of a carbon file without weather.")
    ] = None,
    stamp: Annotated[
        StampOption, typer.Option(help="What a stamp of a carbon file marks.")
    ] = StampOption.AUTO,
) -> None:
    """Validate and align files, and store them in the user's data folder."""
    console = Console()
    if base is not None:
        base = find_name("base", base, synthetic_sites())
    jobs: list[tuple[str, Path, str]]
    left_out: list[tuple[Path, str]] = []
    if path.is_dir():
        if site is not None:
            raise DataError(f"--site {site}: names one file, but {path} is a folder")
        jobs, left_out = importing.plan_folder(path)
    else:
        kind = importing.file_kind(path)
        name = site or (importing.default_name(path) if kind == "workload" else None)
        if name is None:
            raise DataError(f"{path}: a {kind} file, expected --site NAME to import it under")
        jobs = [(kind, path, name)]
    done: list[importing.Imported] = []
    failed: list[DataError] = []
    for kind, file, name in jobs:
        try:
            if kind == "weather":
                done.append(importing.import_weather(file, name, base))
            elif kind == "carbon":
                done.append(
                    importing.import_carbon(
                        file,
                        name,
                        base,
                        utc_offset_h=utc_offset,
                        stamp=stamp.value,
                    )
                )
            else:
                done.append(importing.import_workload(file, name))
        except DataError as error:
            failed.append(error)
            continue
        _report(console, done[-1])
    for file, reason in left_out:
        console.print(f"left out {file}: {reason}", soft_wrap=True)
    for name in dict.fromkeys(x.name for x in done if x.kind != "workload"):
        missing = {"weather", "carbon"} - set(imported_sites().get(name, {}))
        if missing and base is None:
            part = missing.pop()
            console.print(
                f"site {name} lacks {part}: import a {part} file with --site {name}, or import "
                "again with --base SITE to take it from an embedded site",
                soft_wrap=True,
            )
        elif missing:
            console.print(
                f"site {name}: {missing.pop()} of the embedded {base} (synthetic)", soft_wrap=True
            )
    if failed and len(jobs) == 1:
        raise failed[0]
    if failed:
        raise DataError(f"{len(failed)} of {len(jobs)} files not imported; first: {failed[0]}")


def _report(console: Console, item: importing.Imported) -> None:
    console.print(
        f"{item.kind} {item.name}: {item.source.name} -> {item.target}",
        soft_wrap=True,
        markup=False,
    )
    for note in item.notes:
        console.print(f"  {note}", soft_wrap=True, markup=False)
