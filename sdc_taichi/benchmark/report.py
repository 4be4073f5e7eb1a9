"""Report on benchmark suites: tables and pictures of each case, from folders of results."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.benchmark.leaderboard import (
    BOARD_TITLES,
    FEWEST,
    OUTAGES,
    Leaderboard,
    leaderboard,
)
from sdc_taichi.benchmark.paper import PAPER, PAPER_TITLES, PAPER_UNITS, compared_tables
from sdc_taichi.benchmark.result_table import PLACE
from sdc_taichi.benchmark.suite_results import (
    ACHIEVED,
    BOUND,
    LEARNER,
    OTHER,
    PLANNER,
    CaseResults,
    SuiteResults,
    read_suites,
)
from sdc_taichi.errors import SdcError, printable
from sdc_taichi.learning.evaluation import ALL, IDLE
from sdc_taichi.learning.evaluation_table import column_samples, literal_markdown
from sdc_taichi.learning.evaluation_table import markdown as _markdown
from sdc_taichi.learning.statistics import performance_profile
from sdc_taichi.viz.fleet_figures import MAX_RUNS, curve_plot, interval_plot, profile_plot
from sdc_taichi.viz.plotting import new_figure
from sdc_taichi.viz.report_html import html_page, names_text, picture, rendered

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_PAPER_CAPTION = "Our figures, carbon with 95 % intervals, beside those printed"
_LEAST_SHARE_PCT = -100.0
"""Minimum share of the achievable saving, in %, for a row to appear in pictures."""
_THRESHOLDS_PCT = np.linspace(-25.0, 110.0, 136)
READING = (
    "Changes are of sums over all scored weeks, against idle commands in the same weeks, in %: "
    "below 0 is better. Values in brackets are 95 % intervals of a bootstrap, which draws seeds, "
    "sites, years within their site, and weeks within their year. The interquartile mean is that "
    "of the changes of all seeds and weeks. The share of the achievable is 0 for idle commands and "
    "100 % for the best path known with perfect foresight.",
    "Rows share a place unless the interval of the paired difference separates each of them from "
    "each row of the next place; the order within a place is that of the suite. Of many pairs that "
    "do not differ, about one in twenty is separated by chance. Optimum and bound know the future "
    "and have no place, nor have rows that were trained with fewer than three seeds, and cases of "
    "fewer than three weeks of a site.",
    "The probability of improvement is that of a lower figure in a week, for a seed of each row; "
    "equal figures count half. Performance profiles show in how many weeks, of all seeds, a row "
    "reaches more than a share of the achievable. Definitions are those of Agarwal et al. (2021, "
    "Deep reinforcement learning at the edge of the statistical precipice, NeurIPS 34).",
    "Coordination is what agents save together beyond the sum of what each saves alone: below 0 "
    "they hinder each other, or save the same carbon twice.",
)
"""Paragraphs that explain how to read the tables of a report."""


@dataclass(frozen=True, slots=True)
class Picture:
    """Picture of the HTML report; the Markdown report has no pictures."""

    draw: Callable[[], Figure]
    """Function that draws the picture."""
    alt: str
    """Alternative text for readers who cannot see the picture."""
    caption: str
    """Caption below the picture."""


Sections = Mapping[str, Sequence[str | Picture]]
"""Content of each section of a report, as blocks of Markdown and pictures, by heading."""


def write_report(
    folders: Sequence[Path], *, html: Path | None = None, markdown: Path | None = None
) -> tuple[str, ...]:
    """Write a report on suites as an HTML page, as Markdown, or both.

    Args:
        folders: folders with the results of suites.
        html: path of the HTML page; None writes no page.
        markdown: path of the Markdown file; None writes no file.

    Returns:
        Notes on missing content of the report.

    Raises:
        SdcError: a folder has no results of a suite, a result is damaged, results cannot be
            compared, or a file cannot be written.
    """
    suites = read_suites(folders)
    title = "Benchmark" if len(suites) > 1 else suites[0].suite.title
    if markdown is not None:
        _write(markdown, markdown_report(title, report_sections(suites, markdown.parent)))
    notes: tuple[str, ...] = ()
    if html is not None:
        sections = report_sections(suites, html.parent)
        if lacking := _lacking_pictures():
            notes = (f"tables alone: {lacking}",)
            sections = {"Without pictures": [_note(lacking)]} | {
                heading: [block for block in blocks if not isinstance(block, Picture)]
                for heading, blocks in sections.items()
            }
        lead = f"Suites: {', '.join(suite.name for suite in suites)}"
        _write(html, html_report(title, lead, sections))
    return notes


def markdown_report(title: str, sections: Sections) -> str:
    """Return a report as Markdown, without pictures."""
    parts = [f"# {literal_markdown(title)}"]
    for heading, blocks in sections.items():
        parts.append(f"## {literal_markdown(heading)}")
        parts += [block for block in blocks if isinstance(block, str)]
    return "\n\n".join(parts) + "\n"


def html_report(title: str, lead: str, sections: Sections) -> str:
    """Return a report as a self-contained HTML page, which needs no network access.

    Args:
        title: heading of the report.
        lead: text below the heading.
        sections: sections of the report.

    Raises:
        SdcError: jinja2 is missing, or the report has pictures and matplotlib is missing.
    """
    from markdown_it import MarkdownIt

    page = MarkdownIt("commonmark", {"html": False}).enable("table")
    shown = {
        heading: [
            rendered(page.render(block))
            if isinstance(block, str)
            else picture(block.draw(), block.alt, block.caption)
            for block in blocks
        ]
        for heading, blocks in sections.items()
    }
    return html_page(title, lead, shown, set())


def report_sections(suites: Iterable[SuiteResults], folder: Path) -> Sections:
    """Return the sections of a report on suites.

    Args:
        suites: results of the suites.
        folder: folder of the report, to which links are relative.
    """
    sections: dict[str, Sequence[str | Picture]] = {}
    for suite in suites:
        boards = {name: leaderboard(case) for name, case in suite.cases.items()}
        sections[f"Suite {suite.name}"] = _suite_blocks(suite, boards)
        if suite.suite.accounting == PAPER:
            for table, rows in compared_tables(suite):
                caption = f"{_PAPER_CAPTION}, site {table.site}"
                heading = f"Table {table.number}: {table.title}"
                sections[heading] = [_table(caption, rows, PAPER_TITLES), PAPER_UNITS]
        for name, board in boards.items():
            sections[f"{suite.name}: {name}"] = _case_blocks(suite, board, folder)
    sections["How to read the tables"] = list(READING)
    return sections


def _note(text: str) -> str:
    """Format a text as a highlighted paragraph in Markdown."""
    return f"> {literal_markdown(text)}"


def _table(caption: str, frame: pd.DataFrame, titles: Mapping[str, str] = BOARD_TITLES) -> str:
    """Return a captioned table as Markdown, with intervals in brackets after their values."""
    return f"{literal_markdown(caption)}\n\n{_markdown(frame, titles)}"


def _suite_blocks(suite: SuiteResults, boards: Mapping[str, Leaderboard]) -> list[str]:
    """Return paragraphs on the subject of a suite, its commands, processor time and notes."""
    blocks = [literal_markdown(suite.suite.about or suite.suite.title)]
    blocks += map(_note, suite_notes(suite))
    blocks += [f"    {printable(' '.join(text.split()))}" for text in suite.commands]
    blocks.append(cost_text(suite))
    if len(boards) > 1:
        blocks.append(_overview(boards))
    return blocks


def cost_text(suite: SuiteResults) -> str:
    """Return a sentence with the processor time of the results of a suite."""
    results = suite.results
    trained = [x for x in results if x.kind == LEARNER and x.submission is None]
    whole_h = sum(x.record.core_s for x in results) / 3600
    trained_h = sum(x.record.core_s for x in trained) / 3600
    optima_h = sum(case.optima_core_s for case in suite.cases.values()) / 3600
    return (
        f"{len(results)} results took {whole_h:.2g} core hours, {trained_h:.2g} of them for "
        f"trained rows; computing the optima took {optima_h:.2g} more."
    )


def _overview(boards: Mapping[str, Leaderboard]) -> str:
    """Return a table of the change against idle commands, with rows by cases."""
    import pandas as pd

    changes = {
        case: board.standings.set_index("row")["change_pct"] for case, board in boards.items()
    }
    names = dict.fromkeys(name for board in boards.values() for name in board.case.rows)
    frame = pd.DataFrame(changes).reindex(list(names)).rename_axis("row").reset_index()
    return _table("Change against idle commands by case (%)", frame)


def suite_notes(suite: SuiteResults) -> list[str]:
    """Return notes on the results of a suite, such as missing results."""
    results = suite.results
    notes = []
    if suite.quick:
        notes.append("Quick form, with few weeks and short trainings: no results of the suite.")
    missing = [f"{case.name}: {x}" for case in suite.cases.values() for x in case.missing]
    if missing:
        notes.append(f"Unfinished, without {names_text(missing)}.")
    for key, what in (("version", "versions of the package"), ("source", "states of the source")):
        values = [getattr(result.record, key)[:12] for result in results]
        counts = Counter(filter(None, values))  # empty for submissions from other software
        if len(counts) > 1:
            several = [f"{value} ({count})" for value, count in counts.items()]
            notes.append(f"Results of several {what}: {names_text(several)}.")
    if len({str(x.record.processor) for x in results if x.record.processor}) > 1:
        notes.append(
            "Results of several kinds of processors: their last bits differ, and so do the trained "
            "policies."
        )
    for case in suite.cases.values():
        notes += [f"{case.name}: {text}" for text in _notes_of_case(case)]
    return notes


def _notes_of_case(case: CaseResults) -> list[str]:
    """Return notes on the results of a case, such as too few seeds."""
    notes = []
    for name, rows in case.rows.items():
        if (about := rows[0].submission) is not None:
            source = ", ".join(filter(None, (about.author, about.about, about.link)))
            notes.append(f"{name} was submitted and not run here: {source}.")
    kinds = case.kinds
    few = [x for x, rows in case.rows.items() if kinds[x] == LEARNER and len(rows) < FEWEST]
    if few:
        notes.append(
            f"fewer than {FEWEST} seeds of {names_text(few)}, so what another training would reach "
            "is not known, and there is no place."
        )
    results = case.results
    frame = results[0].frame
    fewest = int(frame[frame["moves"] == ALL].groupby("site").size().min())
    if fewest < FEWEST:
        notes.append(f"fewer than {FEWEST} weeks of a site, so rows have no place.")
    if not any(result.frame["achieved_figure"].notna().any() for result in results):
        notes.append(
            "no optimum was computed, so stored energy and delayed work at the end of a week have "
            "no value: an empty battery or delayed work counts as a saving."
        )
    return notes


def _case_blocks(suite: SuiteResults, board: Leaderboard, folder: Path) -> list[str | Picture]:
    """Return tables and pictures of a case; links are relative to the report's folder."""
    case = board.case
    blocks: list[str | Picture] = []
    if about := case.settings.about:
        blocks.append(literal_markdown(about))
    blocks.append(literal_markdown(weeks_text(board)))
    tables = [
        (f"Standings, {case.objective}; means of a week where no %", board.standings),
        ("Each row against the best rule, and against the row below", board.pairs),
        ("Weeks in which a row reaches more than a share of the achievable", board.profiles),
        ("What agents save alone, the others idle, and together", board.coordination),
        ("Agents trained together against those trained apart", board.apart),
        ("Change against idle commands by site (%)", board.sites),
        ("Best settings of the trials, in the validation weeks", _best_trials(board)),
    ]
    blocks += _outage_notes(board)
    pictures = case_pictures(board)
    for caption, frame in tables:
        if not frame.empty:
            blocks.append(_table(caption, frame))
            if frame is board.standings:
                blocks += pictures
    if rows := _row_texts(suite, board):
        blocks += ["### Rows", "\n".join(f"- {literal_markdown(text)}" for text in rows)]
    if recordings := _recordings(case, folder):
        blocks += ["### Recordings", "\n".join(recordings)]
    return blocks


def _best_trials(board: Leaderboard) -> pd.DataFrame:
    """Return the best trial of each algorithm, beside the default settings (trial 0)."""
    trials = board.trials
    if trials.empty:
        return trials
    default = trials[trials["trial"] == 0].set_index("algorithm")["change_pct"]
    table = trials[trials["best"]].set_index("algorithm")[["settings", "change_pct"]]
    table["default_pct"] = default
    return table.rename_axis("row").reset_index()


def _outage_notes(board: Leaderboard) -> list[str]:
    """Return a note that ranks ignore outages, if work is lost or racks are off in the case."""
    broken = [BOARD_TITLES[name] for name in OUTAGES if name in board.standings]
    text = (
        f"Places are by {board.case.objective} alone. Racks that are off and work that is lost "
        f"draw no power: read the places beside {', '.join(broken)}."
    )
    return [_note(text)] if broken else []


def weeks_text(board: Leaderboard) -> str:
    """Return a sentence with objective, weeks and sites of a case."""
    first = next(iter(board.case.rows.values()))[0].frame
    sites, years, weeks = (list(dict.fromkeys(first[name])) for name in PLACE)
    objective = board.case.objective
    named = f" of years {', '.join(map(str, years))}" if len(years) > 1 else ""
    return (
        f"The objective is {objective} ({objective.unit}), in weeks "
        f"{', '.join(map(str, weeks))}{named} of {names_text([str(site) for site in sites])}."
    )


def _row_texts(suite: SuiteResults, board: Leaderboard) -> list[str]:
    """Return the descriptions of the rows of a case."""
    texts = []
    for name, results in board.case.rows.items():
        about = suite.suite.rows[name].about if name in suite.suite.rows else ""
        chosen = results[0].record.metrics.get("chosen")
        parts = [about] if about else []
        parts += [f"chosen in the validation weeks: {chosen}"] if chosen else []
        tuned = results[0].record.metrics.get("tuned")
        parts += [f"settings of the best trial: {json.dumps(tuned)}"] if tuned else []
        if parts:
            texts.append(f"{name}: {'; '.join(parts)}")
    return texts


def _recordings(case: CaseResults, folder: Path) -> list[str]:
    """Return links to the recordings of a case's results, relative to a folder."""
    links = []
    for name, results in case.rows.items():
        for result in results:
            for file in result.record.files_sha256:
                if file.endswith(".rrd"):
                    path = os.path.relpath((result.folder / file).resolve(), folder.resolve())
                    text = literal_markdown(f"{name}, seed {result.seed}: {file}")
                    links.append(f"- [{text}](<{quote(Path(path).as_posix())}>)")
    return links


def case_pictures(board: Leaderboard) -> list[Picture]:
    """Return the pictures of a case."""
    pictures: list[Picture] = []
    if picture := _interval_picture(board):
        pictures.append(picture)
    if not board.curves.empty:
        pictures.append(_curve_picture(board))
    if not board.profiles.empty:
        pictures.append(_profile_picture(board))
    return pictures


def _interval_picture(board: Leaderboard) -> Picture | None:
    """Return a picture of the share of the achievable saving, or of the change against idle."""
    table = board.standings
    has_share = "share_pct" in table
    column = "share_pct" if has_share else "change_pct"
    kinds = board.case.kinds
    ends: dict[str, tuple[float, float, float]] = {}
    excluded, excluded_texts = _far(board), []
    for values in table.to_dict("records"):
        name, value = str(values["row"]), float(values[column])
        if kinds[name] == BOUND or not math.isfinite(value):
            continue
        if name in excluded:
            excluded_texts.append(f"{name} ({value:.0f} %)")
            continue
        label = f"{name} ({values['place']})" if values["place"] != "-" else name
        ends[label] = value, float(values[f"{column}_low"]), float(values[f"{column}_high"])
    if len(ends) < 2:
        return None
    what = "share of the achievable (%)" if has_share else "change against idle commands (%)"
    caption = f"The picture shows the {what} of each row with its 95 % interval, and its place in "
    caption += "brackets."
    if excluded_texts:
        caption += f" Rows outside its range are left out: {', '.join(excluded_texts)}."

    def draw() -> Figure:
        return interval_plot(ends, what, marks=(0.0, 100.0) if has_share else (0.0,))

    alt = "; ".join(f"{name} {value:.1f}" for name, (value, *_) in ends.items())
    return Picture(draw, f"{what}: {alt}", caption)


def _far(board: Leaderboard) -> set[str]:
    """Return rows that are much worse than idle commands, which pictures leave out."""
    table = board.standings
    if "share_pct" not in table:
        return set()
    return {str(name) for name in table["row"][table["share_pct"] < _LEAST_SHARE_PCT]}


def _chosen(board: Leaderboard) -> list[str]:
    """Return the rows for line plots in table order; few enough to distinguish the lines."""
    kinds = {name: kind for name, kind in board.case.kinds.items() if name not in _far(board)}
    ranks = {LEARNER: 0, OTHER: 0, PLANNER: 1, ACHIEVED: 5}
    rank = {name: ranks.get(kind, 4) for name, kind in kinds.items() if kind != BOUND}
    for name in (board.best_rule, IDLE):
        if name in rank:
            rank[name] = 2
    order = [name for name in map(str, board.standings["row"]) if name in rank]
    chosen = sorted(order, key=lambda name: rank[name])[:MAX_RUNS]
    return [name for name in order if name in chosen]


def _profile_picture(board: Leaderboard) -> Picture:
    """Return a picture of the performance profiles.

    A profile is the share of weeks in which a row exceeds a share of the achievable saving.
    """
    shares = column_samples(board.evaluation, "share")
    shown = {
        name: performance_profile(100.0 * shares[name], _THRESHOLDS_PCT)
        for name in _chosen(board)
        if np.isfinite(shares[name]).any() and board.case.kinds[name] != ACHIEVED
    }

    def draw() -> Figure:
        return profile_plot(_THRESHOLDS_PCT, shown, "share of the achievable (%)")

    return Picture(
        draw,
        f"Performance profiles of {', '.join(shown)}.",
        "Weeks of all seeds in which a row reaches more than a share of the achievable: the higher "
        "the line, the better.",
    )


def _curve_picture(board: Leaderboard) -> Picture:
    """Return a picture of the validations of trained rows, over steps and over core seconds."""
    names = {"change_pct": "value", "change_pct_low": "low", "change_pct_high": "high"}
    curves = {
        str(name): {x: points[x].to_numpy(np.float64) for x in ("steps", "core_s", *names.values())}
        for name, points in board.curves.rename(columns=names).groupby("row", sort=False)
    }

    def draw() -> Figure:
        efforts = {"steps": "steps of all data centers", "core_s": "core seconds of the training"}
        return curve_plot(curves, efforts, "change against idle commands, validation weeks (%)")

    return Picture(
        draw,
        f"Learning curves of {', '.join(curves)}.",
        "Validations during the trainings, means of the seeds with 95 % intervals, over steps and "
        "over core seconds, of which each step has an equal share.",
    )


def _lacking_pictures() -> str:
    """Return the reason why pictures cannot be drawn; empty if they can."""
    try:
        new_figure(1.0, 1.0)
    except SdcError as error:
        return str(error)
    return ""


def _write(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path, parents=True) as file:
        file.write(text.encode("utf-8", "replace"))
