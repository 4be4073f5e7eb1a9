"""Blocks of reports, and texts for numbers, names and times in them.

All HTML comes from the Jinja template ``report.html``, which escapes every text.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.errors import SdcError, printable
from sdc_taichi.exogenous.year_clock import HOURS_PER_YEAR, day_of_year, step_times
from sdc_taichi.run.folder_reader import RunFolder
from sdc_taichi.run.folder_writer import METRICS_FILE

from .plotting import darken, date_text, drawn, format_number, webp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PICTURE_DPI = 110
"""Highest resolution of pictures in reports, in pixels per inch."""
MAX_WIDTH_PX = 1216
"""Largest width of a picture in a report, in pixels; it is the width of the page on a screen."""
ENCODINGS = ((256, 60), (96, 45), (48, 30), (24, 15))
"""Number of colours and quality of lossy encoding of the pictures of a report, best first. The
first is used with which the report has at most ``MAX_BYTES``, else the last."""
MAX_BYTES = 1_500_000
"""Size of a report, in bytes, above which its pictures get fewer colours."""
IMAGES = frozenset({"data", "dark_data"})
"""Names of the images in the content of a block."""
LONG_WORD = 24
"""Smallest length of words in a table, such as hashes, that may be broken when printed."""
DASH = "–"
"""Text of a table cell without a value."""
MAX_ROWS = 40
"""Largest number of rows of tables and lists of events, sources and notes."""
NAMES_PER_CELL = 6
"""Largest number of data centers named in a table cell."""


@dataclass(frozen=True, slots=True)
class Block:
    """Part of a section of a report, such as a table, without HTML."""

    macro: str
    """Macro of the template ``report.html`` that renders the block."""
    content: Mapping[str, Any]
    """Arguments of the macro; it escapes all texts."""


@cache
def _macros() -> Any:
    """Load the template ``report.html``, and return the module of its macros."""
    try:
        import jinja2
    except ImportError as error:
        raise SdcError(
            f'reports need jinja2 ({error}); install it with: pip install "sdc-taichi[plot]"'
        ) from None
    templates = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent, encoding="utf-8"), autoescape=True
    )
    templates.tests["has_long_word"] = lambda text: max(map(len, text.split(" "))) >= LONG_WORD
    return templates.get_template("report.html").module


def html_page(
    title: str, lead: str, sections: Mapping[str, Sequence[Block]], own_page: set[str]
) -> str:
    """Return the complete HTML page of a report.

    Args:
        title: title and main heading of the page.
        lead: text below the main heading.
        sections: blocks of each section, keyed by its heading.
        own_page: headings of the sections that begin a new page when printed.
    """
    for encoding in ENCODINGS:
        encoded = {
            heading: [_encoded(block, encoding) for block in blocks]
            for heading, blocks in sections.items()
        }
        page = str(_macros().page(title, lead, encoded, own_page))
        html = "\n".join(map(printable, page.split("\n")))
        if len(html.encode("utf-8", "replace")) <= MAX_BYTES:
            break
    return html


def html_blocks(blocks: Sequence[Block]) -> str:
    """Return blocks as HTML, as they appear in a page."""
    return str(_macros().blocks([_encoded(block, ENCODINGS[0]) for block in blocks]))


def _encoded(block: Block, encoding: tuple[int, int]) -> Block:
    """Return a block whose images are texts in base 64, in an encoding of ``ENCODINGS``."""
    content = {
        name: base64.b64encode(webp(value, *encoding)).decode() if name in IMAGES else value
        for name, value in block.content.items()
    }
    return Block(block.macro, content)


def picture(figure: Figure, alt: str, caption: str) -> Block:
    """Return a picture for light and dark pages, with a caption.

    Args:
        figure: the picture; its ink and paper are changed to those of a dark page.
        alt: description of the picture for readers who cannot see it.
        caption: text below the picture.
    """
    dpi = min(PICTURE_DPI, round(MAX_WIDTH_PX / figure.get_figwidth()))
    image = drawn(figure, dpi)
    darken(figure)
    return Block(
        "picture",
        {
            "data": image,
            "dark_data": drawn(figure, dpi),
            "width": image.width,
            "height": image.height,
            "alt": alt,
            "caption": caption,
        },
    )


def table(
    caption: str,
    heads: Sequence[str] | None,
    rows: Sequence[Sequence[str]] = (),
    *,
    numbers: Iterable[int] = (),
    groups: Mapping[str, Sequence[Sequence[str]]] | None = None,
) -> Block:
    """Return a table in which the first cell of each row is the head of the row.

    Args:
        caption: text above the table.
        heads: heads of the columns; None for a table of two columns without heads.
        rows: cell texts of each row.
        numbers: indices of columns of numbers, which are aligned to the right.
        groups: further rows, keyed by the title of their group.
    """
    titled = ([("", rows)] if rows else []) + list((groups or {}).items())
    content = {"caption": caption, "heads": heads, "groups": titled, "numbers": set(numbers)}
    return Block("table", content)


def paragraph(text: str) -> Block:
    """Return a paragraph."""
    return Block("paragraph", {"text": text})


def notice(text: str) -> Block:
    """Return a highlighted paragraph."""
    return Block("notice", {"text": text})


def bullets(texts: Iterable[str]) -> Block:
    """Return a list of texts."""
    return Block("bullets", {"texts": list(texts)})


def key_figures(figures: Iterable[tuple[str, str]]) -> Block:
    """Return boxes side by side, each with a label and a figure."""
    return Block("key_figures", {"figures": list(figures)})


def rendered(html: str) -> Block:
    """Return HTML that a library has rendered and escaped."""
    return Block("rendered", {"html": html})


def folded(summary: str, text: str) -> Block:
    """Return a long text that the reader unfolds."""
    return Block("folded", {"summary": summary, "text": text})


def metric_text(metrics: Mapping[str, Any], key: str) -> str:
    """Return the value of a metric as text, or a dash if it is unknown or undefined."""
    value = metrics.get(key)
    return DASH if value is None else format_number(value)


def names_text(names: Sequence[str]) -> str:
    """Return the first ``NAMES_PER_CELL`` names, and the number of further names."""
    if len(names) <= NAMES_PER_CELL:
        return ", ".join(names)
    return f"{', '.join(names[:NAMES_PER_CELL])} and {len(names) - NAMES_PER_CELL:,} more"


def first_texts(texts: Sequence[str]) -> list[str]:
    """Return the first ``MAX_ROWS`` texts, and a text with the number of further ones."""
    if len(texts) <= MAX_ROWS:
        return list(texts)
    return [*texts[:MAX_ROWS], f"and {len(texts) - MAX_ROWS} more, see {METRICS_FILE}"]


def local_time(run: RunFolder, dc: int, step: int) -> datetime:
    """Return the time at which a step begins, on the clock of a data center."""
    per_hour = round(1 / run.metrics["step_h"])
    first_day = day_of_year(run.metrics["data_centers"][dc]["start"])
    start = np.array([first_day * 24 * per_hour])
    year = np.array([run.metrics["data_centers"][dc]["year"]])
    moment: datetime = step_times(start, np.array([step]), per_hour, year)[0, 0].astype(datetime)
    return moment


def time_text(run: RunFolder, moment: datetime) -> str:
    """Return day and time of day as text, with the year in runs over a year."""
    day = date_text(moment, over_a_year=run.hours > HOURS_PER_YEAR)
    return f"{day} {moment:%H:%M}"


def count_text(value: float, noun: str) -> str:
    """Return a number and a noun, with a plural "s" unless the number is 1."""
    return f"{format_number(value)} {noun}" + ("" if value == 1 else "s")


def time_span_text(run: RunFolder) -> str:
    """Return a text with number of data centers, length, begin and end of a run."""
    begin, last = local_time(run, 0, 0), local_time(run, 0, run.metrics["steps_done"])
    size, length = count_text(len(run.names), "data center"), count_text(run.hours / 24, "day")
    span = f"{time_text(run, begin)} to {time_text(run, last)}, local standard time"
    return f"{size}, {length} from {span}"
