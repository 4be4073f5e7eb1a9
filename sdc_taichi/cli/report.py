"""``sdc-taichi report``: one HTML file about the folder of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sdc_taichi.cli.options import check_out_file, force_option, out_option
from sdc_taichi.errors import ConfigError, printable


def report_command(
    folders: Annotated[
        list[Path],
        typer.Argument(
            metavar="DIR...",
            help="Folder of a recorded run, and of others to compare it with.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        out_option("Output file. [default: DIR/report.html]", "FILE.html"),
    ] = None,
    force: Annotated[bool, force_option("Replace an existing file of --out.")] = False,
) -> None:
    """Write a report of a recorded run: one HTML file with summary, tables and pictures.

    It reads steps.parquet and metrics.json of the first folder. Further folders, of runs of equal
    length, are compared with it in a table and a radar. The file needs no network.
    """
    from sdc_taichi.run.folder_reader import read_run
    from sdc_taichi.viz.report import write_report

    if force and out is None:
        raise ConfigError("--force: valid with --out; DIR/report.html is replaced without it")
    check_out_file(out, ".html", force=force)
    for index, folder in enumerate(folders):
        if folder.resolve() in [other.resolve() for other in folders[:index]]:
            raise ConfigError(f"{folder}: is given twice; valid is each run once")
    runs = [read_run(folder) for folder in folders]
    for run in runs:
        done, asked = run.metrics["steps_done"], run.metrics["steps_asked"]
        if done < asked:
            typer.echo(
                f"note: {printable(run.path)}: interrupted after {done} of {asked} steps", err=True
            )
    typer.echo(f"Report: {printable(write_report(runs[0], runs[1:], out))}")
