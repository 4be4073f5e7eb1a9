"""HTML of a report: the page with its style, tables, notices and pictures."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

from sdc_taichi.errors import printable

from .plotting import webp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURE_DPI = 110
"""Resolution of the pictures, in pixels per inch."""
LONG_WORD = 24
"""Length from which words of a table, such as names and hashes, may be broken on paper."""

STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; padding: 1.5rem; max-width: 76rem; color: #1a1a1a; background: #fff;
  font: 16px/1.45 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; margin: 2.2rem 0 .6rem; border-bottom: 2px solid #0072B2;
  overflow-wrap: anywhere; }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .4rem; overflow-wrap: anywhere; }
p, ul { max-width: 62rem; }
.lead { color: #444; margin-top: 0; overflow-wrap: anywhere; }
.notice { border-left: 5px solid #E69F00; background: #fff6e0; padding: .5rem .9rem;
  margin: .8rem 0; overflow-wrap: anywhere; }
.key { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: .6rem;
  margin: 1rem 0; padding: 0; }
.key div { border: 1px solid #ccc; border-radius: 6px; padding: .5rem .8rem; }
.key dt { font-size: .85rem; color: #444; }
.key dd { margin: 0; font-size: 1.25rem; font-weight: 600; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; margin: .4rem 0; }
caption { text-align: left; color: #444; padding-bottom: .3rem; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid #ddd; text-align: left;
  vertical-align: top; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
td.n { white-space: nowrap; }
td { min-width: 3.5rem; }
thead th { border-bottom: 2px solid #888; }
tbody th { font-weight: 400; }
th.group { font-weight: 600; padding-top: .7rem; }
code { font-size: .85em; overflow-wrap: anywhere; }
pre { font-size: .75rem; overflow-x: auto; background: #f5f5f5; padding: .8rem; }
figure { margin: 1rem 0 1.6rem; }
img { max-width: 100%; height: auto; }
figcaption { font-size: .88rem; color: #444; max-width: 62rem; overflow-wrap: anywhere; }
nav ul { columns: 2; padding-left: 1.2rem; }
a { color: #0060a0; }
@page { size: A4; margin: 14mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  nav, details { display: none; }
  h2, h3, caption, thead, tr.group { break-after: avoid; }
  section.own { break-before: page; }
  figure, .key, .notice, tr { break-inside: avoid; }
  thead { display: table-header-group; }
  table { font-size: 8pt; width: 100%; }
  th, td { padding: .12rem .35rem; }
  td { min-width: 0; }
  td.n { white-space: normal; }
  .long { overflow-wrap: anywhere; }
  .wide { overflow: visible; }
  img { max-height: 230mm; }
  a { color: inherit; text-decoration: none; }
}
"""
"""Style sheet of the page, on screens and on paper."""


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of a table."""

    text: str
    """Text of the cell."""
    is_number: bool = False
    """Whether the text is a number, which is aligned to the right."""


def html_page(title: str, lead: str, sections: Mapping[str, str], own_page: set[str]) -> str:
    """The whole page.

    Args:
        title: title and heading.
        lead: text below the heading.
        sections: from the heading of each section to its HTML.
        own_page: headings of the sections that begin a new page on paper.
    """
    ids = {name: f"s{index}" for index, name in enumerate(sections)}
    links = "".join(f'<li><a href="#{ids[name]}">{escape(name)}</a></li>\n' for name in sections)
    body = "".join(
        f'<section class="{"own" if name in own_page else "all"}" aria-labelledby="{ids[name]}">'
        f'<h2 id="{ids[name]}">{escape(name)}</h2>\n{content}</section>\n'
        for name, content in sections.items()
    )
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    page = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(lead)}</p>\n'
        f'<nav aria-label="Contents"><ul>\n{links}</ul></nav>\n{body}</main>\n</body>\n</html>\n'
    )
    return "\n".join(map(printable, page.split("\n")))


def picture_element(figure: Figure, alt: str, caption: str) -> str:
    """A figure with its caption, the picture as data in it.

    Args:
        figure: the picture.
        alt: what the picture shows, for readers who do not see it.
        caption: text below the picture.
    """
    width, height, data = webp(figure, PICTURE_DPI)
    source = base64.b64encode(data).decode()
    return (
        f'<figure><img src="data:image/webp;base64,{source}" width="{width}" height="{height}" '
        f'alt="{escape(alt)}"><figcaption>{escape(caption)}</figcaption></figure>\n'
    )


def html_table(
    caption: str,
    heads: Sequence[Cell] | None,
    rows: Sequence[Sequence[Cell]] = (),
    *,
    groups: Iterable[tuple[str, Iterable[Sequence[Cell]]]] = (),
) -> str:
    """A table whose rows are headed by their first cell.

    Args:
        caption: text above the table.
        heads: heads of the columns; None is a table of two columns without heads.
        rows: cells of each row.
        groups: further rows, each group with its title.
    """
    head = ""
    if heads is not None:
        cells = "".join(_cell_element("th", cell, ' scope="col"') for cell in heads)
        head = f"<thead><tr>{cells}</tr></thead>"
    bodies = [f"<tbody>{_table_rows(rows)}</tbody>"] if rows else []
    for title, own in groups:
        across = len(heads) if heads is not None else 2
        bodies.append(
            f'<tbody><tr class="group"><th class="group" scope="rowgroup" colspan="{across}">'
            f"{escape(title)}</th></tr>\n{_table_rows(own)}</tbody>"
        )
    return (
        f'<div class="wide" role="region" aria-label="{escape(caption)}" tabindex="0"><table>'
        f"<caption>{escape(caption)}</caption>{head}{''.join(bodies)}</table></div>\n"
    )


def _table_rows(rows: Iterable[Sequence[Cell]]) -> str:
    """Rows of a table."""
    return "".join(
        "<tr>"
        + _cell_element("th", row[0], ' scope="row"')
        + "".join(_cell_element("td", cell) for cell in row[1:])
        + "</tr>\n"
        for row in rows
    )


def _cell_element(tag: str, cell: Cell, attributes: str = "") -> str:
    """An element for a cell, ``th`` or ``td``."""
    is_long = max(map(len, cell.text.split(" "))) >= LONG_WORD
    classes = " ".join(["n"] * cell.is_number + ["long"] * is_long)
    kind = f' class="{classes}"' if classes else ""
    return f"<{tag}{attributes}{kind}>{escape(cell.text)}</{tag}>"


def notice(text: str) -> str:
    """A paragraph that stands out."""
    return f'<p class="notice" role="note">{escape(text)}</p>\n'
