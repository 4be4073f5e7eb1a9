"""Arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sdc_taichi.config import DataCenterConfig, load_config
from sdc_taichi.errors import ConfigError

Source = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[PRESET|FILE] [A.B=C]...",
        help="Preset, YAML file or SustainDC dc_config.json, and overrides of its fields.",
        show_default=False,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="A.B=C", help="Override a field of the config; repeatable."),
]


def read_config(
    source: list[str] | None, overrides: list[str] | None
) -> tuple[DataCenterConfig, str]:
    """The config and the name of its preset or file, from arguments in any order."""
    given = source or []
    files = [text for text in given if "=" not in text or Path(text).is_file()]
    if len(files) > 1:
        raise ConfigError(
            f"{files[1]!r}: a second preset or file after {files[0]!r}; valid is one, and "
            "overrides section.key=value"
        )
    assigned = [text for text in given if text not in files]
    name = files[0] if files else "corrected"
    return load_config(name, [*(overrides or []), *assigned]), name
