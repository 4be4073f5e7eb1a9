"""Tables 2 to 7 and figure 4 of SustainDC in a report, our figures beside those printed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sdc_taichi.benchmark.leaderboard import interval_columns
from sdc_taichi.benchmark.paper_accounting import (
    CONSTANT_ROW,
    ComparedRow,
    PaperTable,
    compared,
    finding,
    paper_tables,
    radar,
)
from sdc_taichi.benchmark.report_blocks import Block, Paragraph, Picture, Table
from sdc_taichi.benchmark.suite_results import SuiteResults
from sdc_taichi.learning.split import UNSCORED_DAYS
from sdc_taichi.learning.statistics import Interval
from sdc_taichi.viz.benchmark_figures import score_radar

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

PAPER = "paper"
"""Accounting of suites whose tables are those of SustainDC."""
_CAPTION = "Our figures, carbon with 95 % intervals, beside those printed"
_UNITS = (
    " Columns are in the units that the printed ones hold, not in those of their headings: mean "
    "powers, carbon of a quarter hour at an intensity that is raised by that of the first hour of "
    "the year, and a sum of hourly rates of water."
)
_COLUMNS = {
    "cfp_kg": "CFP (kg per quarter hour)",
    "hvac_kw": "HVAC (kW)",
    "it_kw": "IT (kW)",
    "queue_tasks": "task queue",
    "water_m3h": "water (sum of m3/h)",
}
_TITLES = (
    {"label": "row", "seeds": "seeds", "against_constant": f"CFP against {CONSTANT_ROW} (%)"}
    | _COLUMNS
    | {f"printed_{name}": f"printed {title}" for name, title in _COLUMNS.items()}
)


def paper_sections(suite: SuiteResults) -> dict[str, list[Block]]:
    """Sections of the tables of the paper whose cases have results.

    Args:
        suite: results of suite ``paper``.
    """
    import pandas as pd

    sections: dict[str, list[Block]] = {}
    for table in paper_tables():
        case = suite.cases.get(table.case)
        if case is None:
            continue
        frames = [
            result.frame.assign(case=table.case, row=name, seed=result.seed)
            for name, results in case.rows.items()
            for result in results
        ]
        days = case.settings.days
        rows = compared(table, pd.concat(frames, ignore_index=True), 24.0 * (days - UNSCORED_DAYS))
        sections[f"Table {table.number}: {table.title}"] = [
            Table(f"{_CAPTION}, site {table.site}", _frame(rows), _TITLES),
            Paragraph(finding(rows) + _UNITS),
            *_radars(table, rows),
        ]
    return sections


def _frame(rows: Sequence[ComparedRow]) -> pd.DataFrame:
    """Rows of a table of the paper, ours and as printed."""
    import pandas as pd

    return pd.DataFrame([_values(row) for row in rows])


def _values(row: ComparedRow) -> dict[str, Any]:
    """Cells of a row; nan where there is no figure."""
    nothing = Interval(math.nan, math.nan, math.nan)
    values: dict[str, Any] = {"label": row.label, "seeds": row.seeds}
    ours = row.ours or (nothing,) * len(_COLUMNS)
    printed = row.printed or (math.nan,) * len(_COLUMNS)
    for name, interval, other in zip(_COLUMNS, ours, printed, strict=True):
        both = interval_columns(name, interval) if name == "cfp_kg" else {name: interval.value}
        values |= both | {f"printed_{name}": other}
    return values | interval_columns("against_constant", row.against_constant_pct or nothing)


def _radars(table: PaperTable, rows: Sequence[ComparedRow]) -> list[Block]:
    """Panel of figure 4 of a table, ours beside the printed one."""
    found: list[Block] = []
    for printed, what in ((False, "our figures"), (True, "the printed figures")):
        names, scores = radar(list(rows), printed=printed)
        if len(names) > 1:
            found.append(_radar(names, scores.tolist(), f"Figure 4{table.panel} of {what}"))
    return found


def _radar(names: Sequence[str], scores: Sequence[Sequence[float]], what: str) -> Picture:
    """A radar of rows."""

    def draw() -> Figure:
        return score_radar(dict(zip(names, scores, strict=True)), list(_COLUMNS.values()))

    return Picture(
        draw,
        f"{what}: {', '.join(names)}.",
        f"{what}: each column less its mean over the rows, over their standard deviation, the "
        "lowest outside. It magnifies differences however small they are.",
    )
