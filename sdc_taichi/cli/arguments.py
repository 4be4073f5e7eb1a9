"""Arguments and options that several commands share, and how they are checked."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from sdc_taichi.cli import completion
from sdc_taichi.config import DataCenterConfig, load_config
from sdc_taichi.errors import ConfigError

Source = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PRESET|FILE] [A.B=C]...",
        help="Preset, YAML file or SustainDC dc_config.json, and overrides of its fields.",
        show_default=False,
        autocompletion=completion.presets_and_fields,
    ),
]
"""Argument of a command that reads a configuration."""
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=C", help="Override a field of the config; repeatable."),
]
"""Option of a command that reads a configuration."""
Compared = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Controller to compare, as of simulate; repeatable.",
        autocompletion=completion.controllers,
    ),
]
"""Option of a command that compares controllers with an optimum."""
NoCache = Annotated[
    bool, typer.Option("--no-cache", help="Solve anew, and keep nothing for later.")
]
"""Option of a command that solves for an optimum."""
FolderForce = Annotated[bool, typer.Option("--force", help="Write into a folder with other files.")]
"""Option of a command that writes a folder."""
Quiet = Annotated[bool, typer.Option("--quiet", help="No progress, no summary.")]
"""Option of a command that prints a summary of what it has done."""
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")]


def out_option(help: str, metavar: str | None = None) -> Any:
    """Option ``--out`` of a command that writes a file or a folder."""
    return typer.Option("--out", metavar=metavar, help=help)


def force_option(help: str = "Replace an existing file.") -> Any:
    """Option ``--force`` of a command that replaces nothing without it."""
    return typer.Option("--force", help=help)


def json_option(help: str) -> Any:
    """Option ``--json`` of a command that prints JSON in place of text."""
    return typer.Option("--json", help=help)


def check_out_file(out: Path | None, suffix: str, *, force: bool, option: str = "--out") -> None:
    """Check the file of an option such as ``--out`` before any work; None is no file.

    Args:
        out: the file.
        suffix: the only valid suffix, such as ``.png``.
        force: whether an existing file may be replaced.
        option: the option, for messages.

    Raises:
        ConfigError: another suffix, a folder, or an existing file without ``force``.
    """
    if out is None:
        return
    if out.suffix.lower() != suffix:
        raise ConfigError(f"{option} {out}: valid is a name that ends in {suffix}")
    if os.path.isdir(out):
        raise ConfigError(f"{option} {out}: is a folder; valid is a file")
    if os.path.exists(out) and not force:
        raise ConfigError(f"{option} {out}: exists; choose another name or replace it with --force")


def parse_source(source: list[str] | None) -> tuple[str | None, list[str]]:
    """The preset or file that ``Source`` names, None if it names none, and its overrides.

    Raises:
        ConfigError: two presets or files.
    """
    given = source or []
    files = [text for text in given if "=" not in text or os.path.isfile(text)]
    if len(files) > 1:
        raise ConfigError(
            f"{files[1]!r}: a second preset or file after {files[0]!r}; valid is one, and "
            "overrides section.key=value"
        )
    return next(iter(files), None), [text for text in given if text not in files]


def read_config(
    source: list[str] | None, overrides: list[str] | None
) -> tuple[DataCenterConfig, str]:
    """The config that ``Source`` and ``Overrides`` give, and the name of its preset or file.

    Raises:
        ConfigError: two presets or files, or a config that is not valid.
    """
    found, assigned = parse_source(source)
    name = "corrected" if found is None else found
    return load_config(name, [*(overrides or []), *assigned]), name
