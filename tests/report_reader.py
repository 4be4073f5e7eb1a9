"""Read a report back: its elements, text, tables and pictures, and whether it is well formed."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

from sdc_taichi.viz.report_html import Block, html_blocks

VOID = {"meta", "img", "br", "source"}


@dataclass
class Page(HTMLParser):
    """Elements with their attributes in order, and the text in the body."""

    elements: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    tables: list[list[list[str]]] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.problems.append(f"</{tag}> closes nothing")

    def handle_data(self, data: str) -> None:
        if "style" in self.open:
            return
        if "td" in self.open or "th" in self.open:
            self.tables[-1][-1][-1] += data
        self.texts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.texts).split())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def rows(self, *first: str) -> list[list[str]]:
        """Rows of all tables whose first cell is one of these."""
        return [row for table in self.tables for row in table if row and row[0] in first]


def read_page(html: str) -> Page:
    page = Page()
    page.feed(html)
    page.close()
    page.problems += [f"<{tag}> is not closed" for tag in page.open]
    return page


def read_blocks(blocks: Sequence[Block]) -> Page:
    return read_page(html_blocks(blocks))


def pictures(page: Page) -> list[Any]:
    """Every picture, decoded."""
    from PIL import Image

    out = []
    for attributes in page.all("img"):
        head, _, data = str(attributes["src"]).partition(",")
        assert head == "data:image/webp;base64"
        image = Image.open(io.BytesIO(base64.b64decode(data, validate=True)))
        image.load()
        assert image.size == (int(attributes["width"] or 0), int(attributes["height"] or 0))
        out.append(image)
    return out
