"""Results of suites as they are published: tables and pictures of docs/benchmark.md, and cells.

    python examples/publish_benchmark.py FOLDER... [--docs docs] [--cells tests/reference/benchmark]

reads the results of whole suites. Between the lines ``<!-- SUITE -->`` and ``<!-- end -->`` of
DOCS/benchmark.md it writes their tables, and pictures into DOCS/img; the prose around stays. Cells
are what tests/test_published.py runs again: figures of a few rows in one week of a site, and the
policy of one of them, in CELLS/SUITE. Results that are not whole, of a quick form, or of several
states of the source are refused; ``--draft`` writes such tables, and no cells.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.benchmark.leaderboard import BOARD_TITLES, OUTAGES, Leaderboard, leaderboard
from sdc_taichi.benchmark.paper_report import PAPER, paper_sections
from sdc_taichi.benchmark.report import (
    READING,
    cost_text,
    outage_notes,
    overview,
    row_texts,
    suite_notes,
    weeks_text,
)
from sdc_taichi.benchmark.report_blocks import (
    Block,
    Command,
    Heading,
    Items,
    Note,
    Paragraph,
    Picture,
    Table,
    markdown_blocks,
)
from sdc_taichi.benchmark.report_pictures import case_pictures
from sdc_taichi.benchmark.suite_results import (
    LEARNER,
    CaseResults,
    RowResult,
    SuiteResults,
    read_suites,
)
from sdc_taichi.cli.jobs import with_ray_address
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.evaluation import ALL
from sdc_taichi.learning.evaluation_table import literal_markdown
from sdc_taichi.learning.policy import FOLDERS
from sdc_taichi.user_file import MOST_CONFIG_BYTES, read_text
from sdc_taichi.viz.plotting import webp

if TYPE_CHECKING:
    import pandas as pd

PAGE = "benchmark.md"
READING_SECTION = "how to read the tables"
STANDINGS = (
    *("place", "row", "trainings", "change_pct", "interquartile_mean_pct", "share_pct"),
    *(*OUTAGES, "core_min"),
)
"""Columns of the first table of a case; intervals stand beside their values."""
BESIDE = (
    *("row", "carbon_pct", "energy_pct", "water_pct", "cost_pct", "peak_pct", "over_27_degree_h"),
    *("overdue_task_h", "dropped_pct", "broken_pct", "unmet_cooling_kwh"),
)
"""Columns of the second table: what else rows came to, beside the objective."""
CELL_ROWS = ("idle", "best-constant", "rules", "baselines", "ippo")
"""Rows that cells are made of, as far as a case has them."""
PLANNED = {"small": "mpc-24h", "carbon": "mpc-24h"}
"""Row of plans that is also in the cells of a suite; elsewhere it would take too long to test."""
CELL_COLUMNS = ("figure", "share", "cfp_kg", "grid_kwh", "hvac_kwh", "water_l", "cost")
"""Figures of cells."""
DPI = 80


def main() -> None:
    """Publish results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument("--cells", type=Path, default=Path("tests/reference/benchmark"))
    parser.add_argument("--draft", action="store_true")
    given = parser.parse_args()
    for text in publish(given.folders, given.docs, given.cells, draft=given.draft):
        print(text)


def publish(folders: Sequence[Path], docs: Path, cells: Path, *, draft: bool = False) -> list[str]:
    """Write tables, pictures and cells of suites.

    Args:
        folders: folders of their results.
        docs: folder of benchmark.md.
        cells: folder of cells.
        draft: whether results are shown that are not those of a suite; without cells.

    Returns:
        What was written, in words.

    Raises:
        SdcError: results that are not to be published, or a page without their section.
    """
    suites = read_suites(folders)
    page = docs / PAGE
    text, done = read_text(page, MOST_CONFIG_BYTES, ConfigError), []
    if not draft:
        for suite in suites:
            check_whole(suite)
    reading = markdown_blocks([Paragraph(x) for x in READING], docs)
    text = with_section(text, READING_SECTION, reading)
    for suite in suites:
        if has_section(text, suite.name):
            text = with_section(text, suite.name, section(suite, docs))
            done.append(f"{page}: tables of {suite.name}")
        if not draft:
            names = write_cells(suite, cells / suite.name)
            done.append(f"{cells / suite.name}: {', '.join(names)}")
    write(page, text.encode())
    return done


def check_whole(suite: SuiteResults) -> None:
    """See that results are all those of a suite, from one state of the source.

    Raises:
        ConfigError: they are not.
    """
    label = f"suite {suite.name}"
    if suite.quick:
        raise ConfigError(f"{label}: results of its quick form; valid are those of the whole suite")
    for name in suite.suite.cases:
        if name not in suite.cases:
            raise ConfigError(f"{label}: no results of case {name}; valid are those of all cases")
    for name, case in suite.cases.items():
        if case.missing:
            raise ConfigError(f"{label}: {name}: {case.missing[0]} is missing; valid are all")
        for row in suite.suite.rows:
            if suite.suite.is_for(row, name) and row not in case.rows:
                raise ConfigError(f"{label}: {name}: no row {row}; valid are all rows")
    for key in ("version", "source"):
        found = sorted({str(getattr(result.record, key)) for result in own_results(suite)})
        if len(found) > 1:
            raise ConfigError(
                f"{label}: results of {key} {found[0][:12]} and {found[1][:12]}; valid is one"
            )


def own_results(suite: SuiteResults) -> list[RowResult]:
    """Results that were run here."""
    rows = (rows for case in suite.cases.values() for rows in case.rows.values())
    return [result for results in rows for result in results if result.submission is None]


def section(suite: SuiteResults, docs: Path) -> list[str]:
    """Markdown of a suite; its pictures are written."""
    boards = {name: leaderboard(case) for name, case in suite.cases.items()}
    blocks: list[Block] = [Paragraph(suite.suite.about or suite.suite.title)]
    blocks += [Command(text) for text in dict.fromkeys(map(command_of, suite.commands))]
    blocks.append(Paragraph(f"{cost_text(suite)} {made_by(suite)}"))
    blocks += [Note(text) for text in suite_notes(suite)]
    if suite.suite.accounting == PAPER:
        blocks += paper_blocks(suite, boards)
    else:
        for name, board in boards.items():
            blocks += [Heading(name)] * (len(boards) > 1) + case_blocks(suite, board)
        if len(boards) > 1:
            blocks.append(overview(boards))
    number = itertools.count(1)
    for old in (docs / "img").glob(f"benchmark-{suite.name}-[0-9]*.webp"):
        old.unlink()

    def picture(block: Picture) -> str:
        path = f"img/benchmark-{suite.name}-{next(number)}.webp"
        *_, content = webp(block.draw(), DPI)
        write(docs / path, content)
        alt = literal_markdown(block.alt)
        return f"![{alt}]({path})\n\n{literal_markdown(block.caption)}"

    return markdown_blocks(blocks, docs, picture)


def command_of(text: str) -> str:
    """A command line that runs a whole suite, without what differs from run to run.

    Folders, and where jobs run, are anybody's own; parts of a suite were run one after the other.
    """
    words = iter(with_ray_address(shlex.split(text)))
    kept = []
    for word in words:
        name, is_joined, _ = word.partition("=")
        if name in ("--out", "--jobs", "--ray", "--rows", "--cases"):
            if not is_joined:
                next(words, None)
        elif word not in ("--resume", "--quiet"):
            kept.append(word)
    return shlex.join(kept)


def made_by(suite: SuiteResults) -> str:
    """Version and processors that made the results of a suite, in words."""
    contents = [result.record for result in own_results(suite)]
    versions = sorted({content.version for content in contents})
    processors = sorted({text_of(content.processor) for content in contents})
    return f"Version {', '.join(versions)}; {'; '.join(processors)}."


def text_of(processor: dict[str, str]) -> str:
    """Features of a processor in words."""
    return f"{processor.get('architecture', '')} with {processor.get('processor', '')}"


def case_blocks(suite: SuiteResults, board: Leaderboard) -> list[Block]:
    """Tables of a case, and the picture of its intervals."""
    case, about = board.case, board.case.settings.about
    rows = row_texts(suite, board)
    tables = [
        (f"What else they came to, beside {case.objective}; means of a week where no %",
         columns(board.standings, BESIDE)),
        ("Change against idle commands by site (%)", board.sites),
        ("What agents save alone, the others idle, and together", board.coordination),
        ("Agents trained together against those trained apart", board.apart),
    ]  # fmt: skip
    standings = columns(board.standings, STANDINGS)
    blocks: list[Block] = [
        *([Paragraph(about)] if about else []),
        Paragraph(weeks_text(board)),
        *outage_notes(board),
        Table(f"Standings, {case.objective}", standings, BOARD_TITLES),
        *case_pictures(board)[:1],
        *([Items(rows)] if rows else []),
    ]
    return blocks + [Table(text, own, BOARD_TITLES) for text, own in tables if not own.empty]


def paper_blocks(suite: SuiteResults, boards: dict[str, Leaderboard]) -> list[Block]:
    """Tables and radars of the paper, and what can be read of each case."""
    blocks: list[Block] = []
    for heading, own in paper_sections(suite).items():
        blocks += [Heading(heading), *own]
    for name, board in boards.items():
        blocks += [Heading(f"All rows of case {name}"), Paragraph(weeks_text(board))]
        blocks += case_pictures(board)[:1]
        if len(board.sites.columns) > 2:
            caption = "Change against idle commands by site (%)"
            blocks.append(Table(caption, board.sites, BOARD_TITLES))
    return blocks


def columns(frame: pd.DataFrame, names: Sequence[str]) -> pd.DataFrame:
    """Some columns of a table with their intervals, as far as it has them."""
    wanted = [name + end for name in names for end in ("", "_low", "_high")]
    return frame[[name for name in wanted if name in frame]]


# --- The page -------------------------------------------------------------------------------------


def has_section(text: str, name: str) -> bool:
    """Whether a page has the marker of a name, after which its generated text is put."""
    return pattern(name).search(text) is not None


def with_section(text: str, name: str, parts: Sequence[str]) -> str:
    """A page with what is made under a name in its place.

    Raises:
        ConfigError: it has no such place.
    """
    if not has_section(text, name):
        raise ConfigError(f"{PAGE}: no lines <!-- {name} --> and <!-- end -->; valid is with them")
    inner = "\n\n".join(parts)
    return pattern(name).sub(lambda _: f"<!-- {name} -->\n\n{inner}\n\n<!-- end -->", text, 1)


def pattern(name: str) -> re.Pattern[str]:
    """Pattern of the place of a section."""
    return re.compile(rf"<!-- {re.escape(name)} -->\n.*?<!-- end -->", re.S)


# --- Cells ----------------------------------------------------------------------------------------


def write_cells(suite: SuiteResults, folder: Path) -> list[str]:
    """Write figures of some rows in the first week of a site, and the policy of one that learned.

    Args:
        suite: its results.
        folder: where cells.csv, published.json and policies go.

    Returns:
        Names of the rows.
    """
    import pandas as pd

    case = list(suite.cases.values())[-1]
    names = (*CELL_ROWS, PLANNED.get(suite.name, ""))
    chosen = {name: case.rows[name][0] for name in names if name in case.rows}
    frames = [cell_of(name, case.rows[name]) for name in chosen]
    out = pd.concat(frames, ignore_index=True).to_csv(index=False, lineterminator="\n")
    write(folder / "cells.csv", out.encode())
    for name, result in chosen.items():
        for file in result.record.files_sha256:
            if result.kind == LEARNER and file.split("/")[0] in FOLDERS:
                content = result.store.file(result.record.partition, file)
                write(folder / name / file.split("/")[1], content)
    described = json.dumps(description(case, chosen), indent=1, sort_keys=True)
    write(folder / "published.json", f"{described}\n".encode())
    return list(chosen)


def cell_of(name: str, results: Sequence[RowResult]) -> pd.DataFrame:
    """Figures of a row with its first seed, and the lowest and highest figure of all its seeds."""
    first = results[0].record
    frames = [x.frame[x.frame["moves"] == ALL].iloc[:1].reset_index(drop=True) for x in results]
    spec = first.metrics.get("chosen") or first.values["row"].get("controller")
    own = frames[0][["site", "week", *CELL_COLUMNS]]
    own.insert(0, "row", name)
    own.insert(1, "controller", spec or f"policy:{name}")
    figures = [float(frame["figure"].iloc[0]) for frame in frames]
    return own.assign(lowest_figure=min(figures), highest_figure=max(figures))


def description(case: CaseResults, chosen: dict[str, RowResult]) -> dict[str, Any]:
    """Suite, case, site and week of the cells that were run, and the processor."""
    first = next(iter(chosen.values())).record
    return {
        "suite": case.suite,
        "case": case.name,
        "objective": str(case.objective),
        "case_settings": first.values["case"],
        "row_settings": {name: x.record.values["row"] for name, x in chosen.items()},
        "processors": {name: dict(x.record.processor) for name, x in chosen.items()},
        "version": first.version,
        "source": first.source,
    }


def write(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all."""
    with atomic_write(path, parents=True) as file:
        file.write(content)


if __name__ == "__main__":
    try:
        main()
    except SdcError as error:
        raise SystemExit(f"error: {error}") from None
