"""``sdc-taichi new``: a configuration to start from, with a comment on each field."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.cli import completion
from sdc_taichi.cli.arguments import check_out_file, force_option
from sdc_taichi.config import load_config
from sdc_taichi.errors import printable


def new_command(
    out: Annotated[Path, typer.Argument(metavar="FILE.yaml", help="File to write.")],
    preset: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="PRESET",
            help="Preset whose values it has.",
            autocompletion=completion.presets,
        ),
    ] = "corrected",
    force: Annotated[bool, force_option()] = False,
) -> None:
    """Write a configuration to start from, with unit, bounds and meaning above each field."""
    from sdc_taichi.config.reference import commented_yaml

    check_out_file(out, ".yaml", force=force, option="FILE")
    head = f"# A data center, from preset {preset}. Fields that are left out have defaults.\n\n"
    content = head + commented_yaml(load_config(preset))
    with atomic_write(out) as file:
        file.write(content.encode())
    place = printable(out)
    print(f"Wrote {place}; try it with: sdc-taichi simulate {place} --days 7 --out runs/first")
