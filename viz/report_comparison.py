"""Section of a report that compares the runs of one hall, for a decision between variants."""

from __future__ import annotations

from collections.abc import Sequence

from sdc_taichi.run.comparison import Comparison, Figure

from .fleet_figures import variant_bars
from .plotting import format_number
from .report_html import DASH, Block, bullets, names_text, paragraph, picture, table
from .report_pictures import ShownDataCenter, rack_maps_blocks

COMPARED_PER_TABLE = 4
"""Largest number of runs, besides the first, in a table of a comparison; more do not fit a page."""
MAX_MAPPED_RUNS = 4
"""Largest number of runs whose racks are drawn."""
MAX_MAPPED_DCS = 2
"""Largest number of data centers whose racks are drawn for each run."""


def comparison_section(
    comparison: Comparison,
    shown: Sequence[ShownDataCenter] = (),
    shares: Sequence[float | None] | None = None,
) -> list[Block]:
    """Return what differs between runs, their figures and savings a year, bars, and rack maps.

    Args:
        comparison: the comparison.
        shown: data centers of the first run whose racks are drawn.
        shares: share of the achievable of each run, None if it is unknown; None for all runs if
            there is no optimum.
    """
    first, *variants = comparison.names
    blocks = []
    for start in range(0, len(variants), COMPARED_PER_TABLE):
        columns = [0, *range(1 + start, 1 + min(start + COMPARED_PER_TABLE, len(variants)))]
        blocks += _tables(comparison, columns, shares)
    if comparison.notes:
        blocks.append(bullets(comparison.notes))
    bars = [figure for figure in comparison.figures if _has_bars(figure)]
    if bars:
        blocks.append(
            picture(
                variant_bars(comparison.names, bars),
                f"Bars of {', '.join(figure.label for figure in bars)} of "
                f"{names_text(comparison.names)}.",
                f"Bars begin at zero; percentages are changes against {first}.",
            )
        )
    runs = dict(list(comparison.runs.items())[:MAX_MAPPED_RUNS])
    for dc in shown[:MAX_MAPPED_DCS]:
        blocks += rack_maps_blocks(runs, dc)
    if len(runs) < len(comparison.runs) and shown:
        blocks.append(paragraph(f"The racks of the first {len(runs)} runs are shown."))
    return blocks


def difference_rows(comparison: Comparison, columns: Sequence[int]) -> list[list[str]]:
    """Return a row of cells for each field or input in which runs differ."""
    return [
        [
            f"{each.name}: {each.meaning}" if each.meaning else each.name,
            *(each.values[index] for index in columns),
        ]
        for each in comparison.differences
    ]


def figure_rows(
    comparison: Comparison, columns: Sequence[int], shares: Sequence[float | None] | None = None
) -> list[list[str]]:
    """Return a row of cells for each figure, with changes against the first run in %.

    Args:
        comparison: the comparison.
        columns: indices of the runs, the first of which is 0.
        shares: share of the achievable of each run; None without a known optimum.
    """
    rows = []
    for figure in comparison.figures:
        cells = [figure.label, figure.unit]
        cells += [_figure_text(figure, index) for index in columns]
        rows.append(cells)
    if comparison.redundancy:
        of_runs = [comparison.redundancy[name].text() for name in comparison.names]
        label = "CRAC units that can fail at full load before a rack throttles"
        rows.append([label, "units", *(of_runs[index] for index in columns)])
    if shares is not None:
        texts = [DASH if share is None else f"{100 * share:z.1f}" for share in shares]
        rows.append(["share of the achievable", "%", *(texts[index] for index in columns)])
    return rows


def savings_title(comparison: Comparison) -> str:
    """Return the title of the table of ``saving_rows``."""
    return f"Savings a year against {comparison.names[0]}; negative values are increases"


def saving_rows(comparison: Comparison, columns: Sequence[int]) -> list[list[str]]:
    """Return a row of cells for each saving against the first run, and the payback of each variant.

    Args:
        comparison: the comparison.
        columns: indices of the variants, without 0.
    """
    rows = []
    for figure in comparison.figures:
        if figure.has_savings:
            savings = figure.savings()
            texts = [_saving_text(figure, savings[index]) for index in columns]
            rows.append([figure.label, figure.unit, *texts])
    if comparison.costs:
        payback = comparison.payback_years()
        costs, years = [], []
        for name in (comparison.names[index] for index in columns):
            cost = comparison.costs.get(name)
            costs.append(DASH if cost is None else format_number(cost))
            time = payback.get(name)
            never = "never, it saves no money" if cost is not None else DASH
            years.append(never if time is None else format_number(time))
        rows.append(["cost of the measure", "currency", *costs])
        rows.append(["simple payback", "years", *years])
    return rows


def _tables(
    comparison: Comparison, columns: Sequence[int], shares: Sequence[float | None] | None
) -> list[Block]:
    """Return the tables of some runs, the first of which is the reference."""
    names = comparison.names
    heads = [names[index] for index in columns]
    out = []
    if comparison.differences:
        rows = difference_rows(comparison, columns)
        out.append(table("What differs between the runs", ["field or input", *heads], rows))
    out.append(
        table(
            savings_title(comparison),
            ["saving", "unit", *heads[1:]],
            saving_rows(comparison, columns[1:]),
            numbers=range(2, len(columns) + 1),
        )
    )
    out.append(
        table(
            f"Figures; percentages are changes against {names[0]}",
            ["figure", "unit", *heads],
            figure_rows(comparison, columns, shares),
            numbers=range(2, len(columns) + 2),
        )
    )
    return out


def _figure_text(figure: Figure, index: int) -> str:
    """Return the value of a figure in a run, with its change against the first run."""
    value, base = figure.values[index], figure.values[0]
    if value is None:
        return DASH
    text = f"{value:.1f}" if figure.unit == "°C" else format_number(value)
    if index and base and figure.has_savings:
        text += f" ({100 * (value / base - 1):+z.1f} %)"
    elif index and base is not None and figure.unit == "°C":
        text += f" ({value - base:+z.1f} K)"
    return text


def _saving_text(figure: Figure, saving: float | None) -> str:
    """Return a saving with its share of the figure of the first run."""
    base = figure.values[0]
    if saving is None:
        return DASH
    share = f" ({100 * saving / base:z.1f} %)" if base else ""
    return f"{format_number(saving)}{share}"


def _has_bars(figure: Figure) -> bool:
    """Return True if a figure is drawn as bars from zero."""
    is_amount = figure.has_savings or figure.key == "inlet_above_27_h"
    return is_amount and any(figure.values)
