"""``sdc-taichi export``: write a table of a run as CSV, Excel or a log of points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from sdc_taichi.cli.options import check_out_file, force_option, out_option
from sdc_taichi.errors import ConfigError, printable


def export_command(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder of a run.", show_default=False)
    ],
    *,
    to: Annotated[
        Literal["csv", "xlsx", "bms"],
        typer.Option(
            help="csv, xlsx (Excel), or bms: a CSV line of point, UTC time, value and unit for "
            "each value, as trend logs of building management systems."
        ),
    ],
    table: Annotated[
        Literal["steps", "racks"], typer.Option(help="steps.parquet or racks.parquet.")
    ] = "steps",
    columns: Annotated[
        str | None,
        typer.Option(metavar="NAME[,NAME...]", help="Quantities. [default: all]"),
    ] = None,
    dc: Annotated[
        str | None,
        typer.Option(metavar="NAME[,NAME...]", help="Data centers. [default: all]"),
    ] = None,
    racks: Annotated[
        str | None,
        typer.Option(
            metavar="RACK|row:ROW|hottest:COUNT|...", help="Racks of racks.parquet, as of simulate."
        ),
    ] = None,
    points: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE",
            help="Names of points of --to bms, with {dc}, {quantity}, and for racks {row}, {place} "
            "and {rack}. [default: {dc}/{quantity} or {dc}/row{row}/rack{rack}/{quantity}]",
        ),
    ] = None,
    out: Annotated[
        Path | None, out_option("Output file. [default: DIR/TABLE.csv, .xlsx or .bms.csv]", "FILE")
    ] = None,
    force: Annotated[bool, force_option("Replace an existing file of --out.")] = False,
) -> None:
    """Write a table of a run for a spreadsheet or a building management system.

    Times of csv have the UTC offset of the site, those of bms are UTC, and those of xlsx are local
    standard time.
    """
    from sdc_taichi.hall.rack_selection import parse_racks
    from sdc_taichi.run.export import ExportRequest, export_table
    from sdc_taichi.run.folder_reader import read_run

    if force and out is None:
        raise ConfigError("--force: valid with --out; files in DIR are replaced without it")
    check_out_file(out, ".xlsx" if to == "xlsx" else ".csv", force=force)
    request = ExportRequest(
        to,
        table,
        _names(columns),
        _names(dc),
        None if racks is None else parse_racks(racks),
        points,
    )
    written = export_table(read_run(folder), request, out)
    size = written.stat().st_size
    typer.echo(f"Export: {printable(written)} ({size / 1e6:.3g} MB)")


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(","))
