"""Blocks of the reports of suites, as Markdown and as HTML.

Texts come from files of other people: both forms show them literally.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Literal
from urllib.parse import quote

from sdc_taichi.errors import printable
from sdc_taichi.learning.evaluation_table import literal_markdown, markdown, text_rows
from sdc_taichi.viz.report_html import html_page, html_table, notice, picture_element

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Text:
    """A text on its own."""

    text: str
    """The text."""
    style: Literal["paragraph", "heading", "note", "command"] = "paragraph"
    """Meaning of the text; a note stands out, a command is set as code."""


@dataclass(frozen=True, slots=True)
class Items:
    """A list of short texts."""

    items: Mapping[str, Path | None]
    """The texts, and the file that each links to, if any."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table, with intervals in brackets after their values."""

    caption: str
    """Subject of the table, with units."""
    frame: pd.DataFrame
    """Its rows; columns ``NAME_low`` and ``NAME_high`` are the ends of the interval of ``NAME``."""
    titles: Mapping[str, str]
    """Title of each column by its name."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture, which Markdown leaves out."""

    draw: Callable[[], Figure]
    """Draws the picture."""
    alt: str
    """Text in place of the picture, for readers who cannot see it."""
    caption: str
    """Text below the picture."""


Block = Text | Items | Table | Picture
"""Part of a section of a report."""
Sections = Mapping[str, Sequence[Block]]
"""Blocks of each section of a report, by its heading."""


def markdown_report(title: str, sections: Sections, folder: Path) -> str:
    """A report as Markdown, without its pictures.

    Args:
        title: heading of the report.
        sections: its sections.
        folder: folder of the report; links are relative to it.
    """
    parts = [f"# {literal_markdown(title)}"]
    for heading, blocks in sections.items():
        parts.append(f"## {literal_markdown(heading)}")
        parts += [_markdown(block, folder) for block in blocks if not isinstance(block, Picture)]
    return "\n\n".join(parts) + "\n"


def html_report(title: str, lead: str, sections: Sections, folder: Path) -> str:
    """A report as one HTML page, which contains all that it shows and needs no network.

    Args:
        title: heading of the report.
        lead: text below it.
        sections: its sections.
        folder: folder of the report; links are relative to it.

    Raises:
        SdcError: there are pictures, and matplotlib is missing.
    """
    shown = {
        heading: "".join(_html(block, folder) for block in blocks)
        for heading, blocks in sections.items()
    }
    return html_page(title, lead, shown, set())


def _markdown(block: Text | Items | Table, folder: Path) -> str:
    """A block as Markdown."""
    match block:
        case Text(text, "command"):
            return f"    {printable(' '.join(text.split()))}"
        case Text(text, style):
            return {"heading": "### ", "note": "> "}.get(style, "") + literal_markdown(text)
        case Items(items):
            texts = {literal_markdown(text): path for text, path in items.items()}
            return "\n".join(
                f"- {text}" if path is None else f"- [{text}](<{_address(path, folder)}>)"
                for text, path in texts.items()
            )
        case Table(caption, frame, titles):
            return f"{literal_markdown(caption)}\n\n{markdown(frame, titles)}"


def _html(block: Block, folder: Path) -> str:
    """A block as HTML."""
    match block:
        case Text(text, "note"):
            return notice(text)
        case Text(text, style):
            tag = {"heading": "h3", "command": "pre"}.get(style, "p")
            return f"<{tag}>{escape(text)}</{tag}>\n"
        case Items(items):
            texts = {escape(text): path for text, path in items.items()}
            lines = [
                text if path is None else f'<a href="{escape(_address(path, folder))}">{text}</a>'
                for text, path in texts.items()
            ]
            return f"<ul>{''.join(f'<li>{line}</li>' for line in lines)}</ul>\n"
        case Table(caption, frame, titles):
            heads, rows = text_rows(frame, titles)
            return html_table(caption, heads, rows, numbers=range(1, len(heads)))
        case Picture(draw, alt, caption):
            return picture_element(draw(), alt, caption)


def _address(path: Path, folder: Path) -> str:
    """Address of a file relative to a folder, with special characters quoted."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())
