"""Blocks that reports of suites are made of, and their Markdown and HTML.

Texts come from files of others: both forms show them literally.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from sdc_taichi.errors import printable
from sdc_taichi.learning.evaluation_table import literal_markdown, markdown, text_rows
from sdc_taichi.viz.report_html import html_page, html_table, notice, picture_element

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading within a section."""

    text: str
    """Its text."""


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A paragraph of text."""

    text: str
    """Its text."""


@dataclass(frozen=True, slots=True)
class Items:
    """A list of short texts."""

    texts: Sequence[str]
    """The texts."""


@dataclass(frozen=True, slots=True)
class Links:
    """A list of links to files."""

    files: Mapping[str, Path]
    """Each file by the text of its link."""


@dataclass(frozen=True, slots=True)
class Note:
    """A paragraph that stands out."""

    text: str
    """Its text."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command line."""

    text: str
    """The line."""


@dataclass(frozen=True, slots=True)
class Table:
    """A table, intervals in brackets behind their values."""

    caption: str
    """Subject of the table or picture, with units, printed beside it."""
    frame: pd.DataFrame
    """Its rows; columns ``NAME_low`` and ``NAME_high`` are the ends of the interval of ``NAME``."""
    titles: Mapping[str, str]
    """Title of each column by its name."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture, which Markdown is without."""

    draw: Callable[[], Figure]
    """Draws it."""
    alt: str
    """Text in place of the picture, for readers who cannot see it."""
    caption: str
    """Text below it."""


TextBlock = Heading | Paragraph | Items | Links | Note | Command | Table
"""Part of a section of a report that is no picture."""
Block = TextBlock | Picture
"""Part of a section of a report."""
Sections = Mapping[str, Sequence[Block]]
"""Blocks of each section of a report, by its heading."""


def markdown_report(title: str, sections: Sections, folder: Path) -> str:
    """A report as Markdown, without its pictures.

    Args:
        title: heading of the report.
        sections: its sections.
        folder: where the report will be, which links begin at.
    """
    parts = [f"# {literal_markdown(title)}"]
    for heading, blocks in sections.items():
        parts.append(f"## {literal_markdown(heading)}")
        parts += markdown_blocks(blocks, folder)
    return "\n\n".join(parts) + "\n"


def markdown_blocks(
    blocks: Sequence[Block], folder: Path, picture: Callable[[Picture], str] | None = None
) -> list[str]:
    """Blocks as Markdown, one text each.

    Args:
        blocks: the blocks.
        folder: where the file will stand, from which links lead.
        picture: gives the Markdown of a picture; None leaves pictures out.
    """
    found = []
    for block in blocks:
        if not isinstance(block, Picture):
            found.append(_markdown_block(block, folder))
        elif picture is not None:
            found.append(picture(block))
    return found


def html_report(title: str, lead: str, sections: Sections, folder: Path) -> str:
    """A report as one HTML page, which holds all that it shows and needs no network.

    Args:
        title: heading of the report.
        lead: text below it.
        sections: its sections.
        folder: where the report will be, which links begin at.

    Raises:
        SdcError: there are pictures, and matplotlib is missing.
    """
    shown = {
        heading: "".join(_html_block(block, folder) for block in blocks)
        for heading, blocks in sections.items()
    }
    return html_page(title, lead, shown, set())


def _markdown_block(block: TextBlock, folder: Path) -> str:
    """A block as Markdown."""
    match block:
        case Heading(text):
            return f"### {literal_markdown(text)}"
        case Paragraph(text):
            return literal_markdown(text)
        case Items(texts):
            return "\n".join(f"- {literal_markdown(text)}" for text in texts)
        case Links(files):
            return "\n".join(
                f"- [{literal_markdown(text)}](<{_address(path, folder)}>)"
                for text, path in files.items()
            )
        case Note(text):
            return f"> {literal_markdown(text)}"
        case Command(text):
            return "    " + printable(" ".join(text.split()))
        case Table(caption, frame, titles):
            return f"{literal_markdown(caption)}\n\n{markdown(frame, titles)}"


def _html_block(block: Block, folder: Path) -> str:
    """A block as HTML."""
    match block:
        case Heading(text):
            return f"<h3>{escape(text)}</h3>\n"
        case Paragraph(text):
            return f"<p>{escape(text)}</p>\n"
        case Items(texts):
            items = "".join(f"<li>{escape(text)}</li>\n" for text in texts)
            return f"<ul>{items}</ul>\n"
        case Links(files):
            items = "".join(
                f'<li><a href="{escape(_address(path, folder))}">{escape(text)}</a></li>\n'
                for text, path in files.items()
            )
            return f"<ul>{items}</ul>\n"
        case Note(text):
            return notice(text)
        case Command(text):
            return f"<pre>{escape(text)}</pre>\n"
        case Table(caption, frame, titles):
            return _html_table(caption, frame, titles)
        case Picture(draw, alt, caption):
            return picture_element(draw(), alt, caption)


def _address(path: Path, folder: Path) -> str:
    """Address of a file from a folder, in which nothing has a meaning of its own."""
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def _html_table(caption: str, frame: pd.DataFrame, titles: Mapping[str, str]) -> str:
    """A table as HTML, all but its first column aligned to the right."""
    heads, rows = text_rows(frame, titles)
    return html_table(caption, heads, rows, numbers=range(1, len(heads)))
