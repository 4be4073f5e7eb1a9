"""``sdc-taichi benchmark report`` and ``add``: tables of suites, and submitted rows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sdc_taichi.cli.options import check_out_file, force_option, out_option
from sdc_taichi.cli.terminal import print_notes, stage_bars
from sdc_taichi.errors import ConfigError, printable


def report_command(
    folders: Annotated[
        list[Path],
        typer.Argument(metavar="DIR...", help="Folders of results of suites.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        out_option("Page with tables and pictures. [default: DIR/report.html]", "FILE.html"),
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option(metavar="FILE.md", help="Also write the tables as Markdown.")
    ] = None,
    force: Annotated[bool, force_option("Replace existing files of --out, --markdown.")] = False,
) -> None:
    """Make tables and pictures of suites: one HTML page, and Markdown.

    Results of one suite may lie in several folders. Nothing is run. Rows share a place unless 95 %
    intervals tell them apart.
    """
    from sdc_taichi.benchmark.report import write_report

    if force and out is None and markdown is None:
        raise ConfigError("--force: valid with --out or --markdown; DIR/report.html is replaced")
    check_out_file(out, ".html", force=force)
    check_out_file(markdown, ".md", option="--markdown", force=force)
    for index, folder in enumerate(folders):
        if folder.resolve() in [other.resolve() for other in folders[:index]]:
            raise ConfigError(f"{folder}: is given twice; valid is each folder once")
    page = folders[0] / "report.html" if out is None else out
    print_notes(write_report(folders, html=page, markdown=markdown))
    print(f"Report: {printable(page)}")
    if markdown is not None:
        print(f"Tables: {printable(markdown)}")


def add_command(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Results of a row.", show_default=False)
    ],
    to: Annotated[
        Path, typer.Option("--to", metavar="DIR", help="Folder of the results of its suite.")
    ],
    verify: Annotated[
        int,
        typer.Option(
            min=0, max=52, metavar="N", help="Run its policies again in N weeks, and compare."
        ),
    ] = 0,
) -> None:
    """Check a row that somebody else has run, and add it to the results of a suite.

    The row has to be complete and of the same weeks of the same data centers. The documentation
    of suites says how to make one.
    """
    from sdc_taichi.benchmark.submission import add_submission, read_submission, rerun

    if verify:
        with stage_bars(shown=True) as progress:
            worst = rerun(read_submission(folder), to, verify, progress)
        print(f"Run again in {verify} weeks of each site: figures differ by {worst:.2g} at most")
    submission = add_submission(folder, to)
    cases = ", ".join(submission.cases)
    print(f"Added {printable(submission.row)} to {printable(to)}: {printable(cases)}")
