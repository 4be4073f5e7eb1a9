"""Publish results of suites: tables and pictures of docs/benchmark.md, CSV files, and cells.

    python docs/make/benchmark.py FOLDER... [--docs docs] [--cells tests/reference/benchmark]

reads the results of whole suites. It writes a table and a picture of each suite between the lines
``<!-- SUITE -->`` and ``<!-- end -->`` of DOCS/benchmark.md, all tables into DOCS/benchmark/, and
figures of some rows in one week into CELLS/SUITE, which tests/test_published.py computes again.
The page shows the last case with perfect forecasts, with one line for all rows that share a place.
Results that are not whole, of a quick form, or of several states of the source are refused.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.benchmark.leaderboard import BOARD_TITLES, Leaderboard, leaderboard
from sdc_taichi.benchmark.paper import PAPER, PAPER_TITLES, paper_rows
from sdc_taichi.benchmark.report import case_pictures, cost_text, suite_notes, weeks_text
from sdc_taichi.benchmark.suite_results import LEARNER, SuiteResults, read_suites
from sdc_taichi.cli.jobs import with_ray_address
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.learning.evaluation import ALL
from sdc_taichi.learning.evaluation_table import literal_markdown, markdown
from sdc_taichi.learning.policy import FOLDERS
from sdc_taichi.viz.plotting import drawn, webp

if TYPE_CHECKING:
    import pandas as pd

BOARD_COLUMNS = ("change_pct", "share_pct", "tripped_rack_h")
PAPER_COLUMNS = ("cfp_kg", "printed_cfp_kg", "against_constant")
"""Columns of the table on the page, which has a line for the rows of one place or one table."""
CELL_ROWS = ("idle", "best-constant", "rules", "rules-best", "baselines", "ippo")
"""Rows of the cells, as far as a case has them."""
PLANNED = {"small": "mpc-24h", "carbon": "mpc-24h"}
"""Row of plans in the cells of a suite; in other suites it would take too long to test."""
CELL_COLUMNS = ("figure", "share", "cfp_kg", "grid_kwh", "hvac_kwh", "water_l", "cost")
"""Figures of cells."""
_ELSEWHERE = ("--out", "--jobs", "--ray", "--rows", "--cases")


def publish(folders: Sequence[Path], docs: Path, cells: Path) -> None:
    """Write tables, pictures and cells of suites.

    Args:
        folders: folders of their results.
        docs: folder of benchmark.md.
        cells: folder of cells.

    Raises:
        SdcError: results that are not to be published, or a page without a place for them.
    """
    page = docs / "benchmark.md"
    suites = read_suites(folders)
    for suite in suites:
        check_whole(suite)
    for suite in suites:
        boards = {name: leaderboard(case) for name, case in suite.cases.items()}
        tables = {name: table for name, table in tables_of(suite, boards).items() if len(table)}
        for name, table in tables.items():
            text = table.to_csv(index=False, lineterminator="\n", float_format="%.6g")
            write(docs / "benchmark" / f"{suite.name}-{name}.csv", text.encode())
        cases = suite.suite.cases
        board = [boards[name] for name in boards if not cases[name].forecast_error][-1]
        parts = section(suite, board, tables, docs)
        text = page.read_text("utf-8")
        place = re.search(rf"(?s)(?<=<!-- {suite.name} -->\n).*?(?=<!-- end -->)", text)
        if place is None:
            raise ConfigError(f"{page}: no line <!-- {suite.name} -->; valid is a page with it")
        text = "\n".join([text[: place.start()], "\n\n".join(parts), "", text[place.end() :]])
        write(page, text.encode())
        write_cells(suite, board, cells / suite.name)


def check_whole(suite: SuiteResults) -> None:
    """Check that results are all those of a suite, from one state of the source.

    Raises:
        ConfigError: they are not.
    """
    label = f"suite {suite.name}"
    if suite.quick:
        raise ConfigError(f"{label}: results of its quick form; valid are those of the whole suite")
    for name in suite.suite.cases:
        rows = suite.cases[name].rows if name in suite.cases else {}
        missing = list(suite.cases[name].missing) if name in suite.cases else []
        missing += [x for x in suite.suite.rows if suite.suite.is_for(x, name) and x not in rows]
        if missing:
            raise ConfigError(f"{label}: {name}: {missing[0]} is missing; valid are all rows")
    sources = sorted({x.record.source for x in suite.results if x.submission is None})
    if len(sources) > 1:
        raise ConfigError(
            f"{label}: results of source {sources[0][:12]} and {sources[1][:12]}; valid is one"
        )


def tables_of(suite: SuiteResults, boards: dict[str, Leaderboard]) -> dict[str, pd.DataFrame]:
    """Tables of all cases of a suite by name, with the case in their first column."""
    import pandas as pd

    tables = {}
    for name in ("standings", "sites", "coordination", "apart", "curves", "trials"):
        frames = {case: getattr(board, name) for case, board in boards.items()}
        tables[name] = pd.concat(frames, names=["case"]).reset_index(level=0)
    if suite.suite.accounting == PAPER:
        tables["tables"] = paper_rows(suite)
    return tables


def section(
    suite: SuiteResults, board: Leaderboard, tables: dict[str, pd.DataFrame], docs: Path
) -> list[str]:
    """Paragraphs of a suite on the page; its picture is written."""
    if suite.suite.accounting == PAPER:
        rows = tables["tables"]
        titles = {**PAPER_TITLES, "label": "rows"}
        shown = lines_of(rows[rows["printed_cfp_kg"].notna()], "table", "label", PAPER_COLUMNS)
    else:
        titles = {**BOARD_TITLES, "row": "rows"}
        shown = lines_of(board.standings, "place", "row", BOARD_COLUMNS)
    parts = [markdown(shown, titles)]
    files = [f"[{name}](benchmark/{suite.name}-{name}.csv)" for name in tables]
    commands = dict.fromkeys(f"`{command_of(text)}`" for text in suite.commands)
    about = f"{weeks_text(board)} {cost_text(suite)} {made_by(suite)}"
    end = f"Complete tables are in {', '.join(files)}. All results were computed with "
    end += f"{', '.join(commands)}. {literal_markdown(about)}"
    for at, picture in enumerate(case_pictures(board)[: 1 if board.curves.empty else 2]):
        path = f"img/benchmark-{suite.name}{'-curves' * at}.webp"
        write(docs / path, webp(drawn(picture.draw(), 80)))
        alt = picture.alt.partition(":")[0].rstrip(".")
        parts.append(f"![{alt}: suite {suite.name}]({path})")
        caption = picture.caption.replace("picture", f"picture of case {board.case.name}", 1)
        end = f"{literal_markdown(caption)} {end}"
    parts.append(end)
    return [*parts, *(f"> {literal_markdown(text)}" for text in suite_notes(suite))]


def lines_of(frame: pd.DataFrame, group: str, name: str, columns: Sequence[str]) -> pd.DataFrame:
    """Lines of the table on the page: rows of one place or table, and the range of their figures.

    Args:
        frame: rows of a suite.
        group: column whose equal neighbours make a line; rows without a place have one each.
        name: column with the names of rows.
        columns: columns of figures, as far as the frame has them.
    """
    import pandas as pd

    starts = (frame[group] != frame[group].shift()) | (frame[group] == "-")
    lines = []
    for _, rows in frame.groupby(starts.cumsum()):
        line = {group: str(rows[group].iloc[0]), name: ", ".join(dict.fromkeys(rows[name]))}
        for column in columns:
            if column in rows and rows[column].notna().any():
                ends = dict.fromkeys(f"{x:.2f}" for x in (rows[column].min(), rows[column].max()))
                line[column] = " to ".join(ends)
        lines.append(line)
    return pd.DataFrame(lines)


def command_of(text: str) -> str:
    """A command line that runs a whole suite, without folders and where jobs run."""
    words = iter(with_ray_address(shlex.split(text)))
    shown = []
    for word in words:
        name, is_joined, _ = word.partition("=")
        if name in _ELSEWHERE:
            if not is_joined:
                next(words, None)
        elif word not in ("run", "--resume", "--quiet"):
            shown.append(word)
    return shlex.join(shown)


def made_by(suite: SuiteResults) -> str:
    """Version and processors that made the results of a suite, in words."""
    records = [x.record for x in suite.results if x.submission is None]
    versions = sorted({record.version for record in records})
    features = [(x.processor.get("architecture"), x.processor.get("processor")) for x in records]
    processors = sorted({f"{architecture} with {name}" for architecture, name in features})
    return f"Version {', '.join(versions)} ran on {'; '.join(processors)}."


def write_cells(suite: SuiteResults, board: Leaderboard, folder: Path) -> None:
    """Write figures of some rows in the first week of a site, and the policy of a trained one."""
    import pandas as pd

    case = board.case
    names = (*CELL_ROWS, PLANNED.get(suite.name, ""))
    chosen = {name: case.rows[name] for name in names if name in case.rows}
    frames = []
    for name, results in chosen.items():
        record = results[0].record
        weeks = [x.frame[x.frame["moves"] == ALL].iloc[:1].reset_index(drop=True) for x in results]
        cell = weeks[0][["site", "week", "year", *CELL_COLUMNS]]
        spec = record.metrics.get("chosen") or record.values["row"].get("controller")
        cell.insert(0, "row", name)
        cell.insert(1, "controller", spec or f"policy:{name}")
        figures = [float(week["figure"].iloc[0]) for week in weeks]
        frames.append(cell.assign(lowest_figure=min(figures), highest_figure=max(figures)))
        for file in record.files_sha256 if results[0].kind == LEARNER else ():
            if file.split("/")[0] in FOLDERS:
                content = results[0].store.file(record.partition, file)
                write(folder / name / file.split("/")[1], content)
    text = pd.concat(frames, ignore_index=True).to_csv(index=False, lineterminator="\n")
    write(folder / "cells.csv", text.encode())
    first = next(iter(chosen.values()))[0].record
    published = {
        "suite": case.suite,
        "case": case.name,
        "objective": str(case.objective),
        "case_settings": first.values["case"],
        "row_settings": {name: x[0].record.values["row"] for name, x in chosen.items()},
        "processors": {name: dict(x[0].record.processor) for name, x in chosen.items()},
        "version": first.version,
        "source": first.source,
    }
    write(
        folder / "published.json", f"{json.dumps(published, indent=1, sort_keys=True)}\n".encode()
    )


def write(path: Path, content: bytes) -> None:
    """Write a file, whole or not at all."""
    with atomic_write(path, parents=True) as file:
        file.write(content)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--docs", type=Path, default=Path("docs"))
    parser.add_argument("--cells", type=Path, default=Path("tests/reference/benchmark"))
    options = parser.parse_args()
    try:
        publish(options.folders, options.docs, options.cells)
    except SdcError as error:
        raise SystemExit(f"error: {error}") from None
