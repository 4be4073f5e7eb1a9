"""``sdc-taichi hall failover``: how long a hall lasts without a part of its cooling."""

from __future__ import annotations

import csv
import io
import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.cli.options import (
    ConfigOptions,
    check_out_file,
    force_option,
    json_option,
    out_option,
)
from sdc_taichi.errors import printable

if TYPE_CHECKING:
    from sdc_taichi.run.failover import Failover

LISTED = 30
"""Most losses that the table on the screen lists."""


class LostParts(StrEnum):
    """Kinds of equipment that a failover study takes out of service."""

    units = "units"
    plant = "plant"


def failover_command(
    *,
    config: ConfigOptions,
    of: Annotated[
        LostParts, typer.Option("--of", help="Lose CRAC units, or devices of the plant.")
    ] = LostParts.units,
    out: Annotated[
        Path | None,
        out_option("Draw floor plan and curves, and write all losses beside it.", "FILE.png"),
    ] = None,
    force: Annotated[bool, force_option()] = False,
    as_json: Annotated[bool, json_option("Print all losses as JSON.")] = False,
) -> None:
    """Lose each CRAC unit and each pair of them at full load: time to throttle and to trip.

    An hour of transient temperatures in design weather. --out FILE.png also writes FILE.csv.
    """
    from sdc_taichi.run.failover import failover_rows, failover_values, study_failover

    check_out_file(out, ".png", force=force)
    table_path = None if out is None else out.with_suffix(".csv")
    check_out_file(table_path, ".csv", force=force)
    study = study_failover(config.read()[0], of.value)
    if out is not None and table_path is not None:
        from sdc_taichi.viz.failover_figure import failover_figure
        from sdc_taichi.viz.plotting import save_picture

        save_picture(failover_figure(study), out, parents=True)
        _write_rows(table_path, failover_rows(study, study.worst))
    if as_json:
        typer.echo(json.dumps(failover_values(study), indent=2))
        return
    _print_study(study)
    if out is not None:
        typer.echo(f"Figure: {printable(out)}, all losses: {printable(str(table_path))}")


def _print_study(study: Failover) -> None:
    """Print what was studied, and a table of the worst losses."""
    from sdc_taichi.run.failover import MINUTES, SHOWN_AFTER_MIN, failover_rows

    hall = study.config.hall
    typer.echo(
        f"{printable(study.config.name)}: {hall.racks:,} racks at full load, {study.it_kw:,.0f} kW "
        f"IT, supply {study.supply_c:g} C, outdoors {study.outdoor_c:.1f} C (wet bulb "
        f"{study.wet_bulb_c:.1f} C), class {study.config.protection.ashrae_class}"
    )
    table = Table()
    table.add_column("lost", no_wrap=True)
    names = ("throttle, min", "trip, min", *(f"C, {m} min" for m in SHOWN_AFTER_MIN), "racks off")
    for name in names:
        table.add_column(name, justify="right")
    order = [0, *(i for i in study.worst if i != 0)]
    for row in failover_rows(study, order[: LISTED + 1]):
        name, *numbers, off = row.values()
        table.add_row(
            name, *(_minutes(x) for x in numbers[:2]), *(f"{x:.1f}" for x in numbers[2:]), f"{off}"
        )
    Console().print(table)
    if len(order) > LISTED + 1:
        typer.echo(f"The worst {LISTED} of {len(order) - 1} losses.")
    if study.note:
        typer.echo(study.note)
    typer.echo(
        "C is the hottest inlet of the hall; times count to the end of a whole minute, - is not "
        f"within {MINUTES} min; racks off are those after {MINUTES} min."
    )


def _minutes(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def _write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    with atomic_write(path, parents=True) as file:
        file.write(text.getvalue().encode())
