"""A console for text that users have made: names of files and data centers, sources, notes."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.text import Text

from sdc_taichi.errors import printable


class PlainConsole(Console):
    """A console that reads no markup in texts, and escapes what a terminal would obey."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Text as it is shown; every string of a line or table passes here."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **options)
