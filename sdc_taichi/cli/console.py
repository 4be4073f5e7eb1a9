"""A console for text that users have made: names of files and data centers, sources, notes."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.text import Text

from sdc_taichi.errors import printable

if TYPE_CHECKING:
    import pandas as pd


class PlainConsole(Console):
    """A console that reads no markup in texts, and escapes what a terminal would obey."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text as it is shown; every string of a line or table passes here."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **options)


def print_table(title: str, table: pd.DataFrame) -> None:
    """Print a table with a title, the first column to the left and the others to the right."""
    from rich.table import Table

    from sdc_taichi.learning.evaluation_table import text_rows

    width = None if sys.stdout.isatty() else 240
    console = PlainConsole(highlight=False, width=width, soft_wrap=True)
    console.print(title)
    titles, rows = text_rows(table)
    shown = Table()
    for i, head in enumerate(titles):
        shown.add_column(head, justify="right" if i else "left", no_wrap=True)
    for cells in rows:
        shown.add_row(*cells)
    console.print(shown)
