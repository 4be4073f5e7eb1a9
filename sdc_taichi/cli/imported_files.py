"""What commands that import files print of them."""

from __future__ import annotations

from collections.abc import Sequence

from sdc_taichi.cli.console import PlainConsole
from sdc_taichi.exogenous.importing import Imported
from sdc_taichi.exogenous.registry import imported_sites


def print_imported(console: PlainConsole, item: Imported) -> None:
    """Print what a file was imported as, with its repairs and warnings."""
    console.print(
        f"{item.kind} {item.name}: {item.source.name} -> {item.target}",
        soft_wrap=True,
    )
    for note in item.notes:
        console.print(f"  {note}", soft_wrap=True)


def print_missing_parts(console: PlainConsole, done: Sequence[Imported], base: str | None) -> None:
    """Say of each imported site that lacks weather or carbon where that comes from."""
    for name in dict.fromkeys(item.name for item in done if item.kind != "workload"):
        missing = {"weather", "carbon"} - set(imported_sites().get(name, {}))
        if not missing:
            continue
        part = missing.pop()
        text = (
            f"site {name} lacks {part}: import a {part} file with --site {name}, or import "
            "again with --base SITE to take it from an embedded site"
            if base is None
            else f"site {name}: {part} of the embedded {base} (synthetic)"
        )
        console.print(text, soft_wrap=True)
