"""Section of a report that says why the hottest racks are hot."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from sdc_taichi.errors import ConfigError
from sdc_taichi.run.folder_reader import RunFolder
from sdc_taichi.run.inlets_of_run import InletsAtStep, hottest_inlets
from sdc_taichi.sim.inlet_parts import HOTTEST_RACKS, InletParts, rack_text, state_texts

from .report_html import Cell, html_table
from .report_text import local_time, time_text

NAMED_SOURCES = 3
"""Racks that are named with what their exhaust adds."""
HEADS = (
    "rack",
    "inlet (°C)",
    "supply setpoint (°C)",
    "supply over setpoint (K)",
    "exhaust of other racks (K)",
    "own exhaust (K)",
    "height in the rack (K)",
    "CRAC air that falls short (K)",
    "most from (K)",
)
"""Heads of the table of a hall with recirculation. The inlet is the sum of the four numbers that
follow it."""
APPROACH_HEADS = (*HEADS[:4], "approach temperature (K)")
"""Heads of the table of a hall whose inlets are given. The inlet is the sum of the three numbers
that follow it."""


def hot_racks_section(run: RunFolder, dcs: Sequence[int]) -> str:
    """Why the hottest racks of some data centers are as hot as they are.

    Args:
        run: the run.
        dcs: indices of the data centers.

    Raises:
        SdcError: steps.parquet is damaged.
    """
    out = [
        "<p>Each inlet is the sum of setpoint, supply air over its setpoint, and exhausts or the "
        "approach temperature of the config. Height and missing CRAC air are why a part of the "
        "exhausts reaches it.</p>\n"
    ]
    for dc in dcs:
        name = run.names[dc]
        try:
            found = hottest_inlets(run, dc)
        except ConfigError as error:
            out.append(f"<p>{escape(f'{name}: {error}')}</p>\n")
            continue
        if found is None:
            out.append(
                f"<p>{escape(name)}: the run has too many racks for the air of a step to be kept; "
                "<code>sdc-taichi hall why</code> simulates it again.</p>\n"
            )
        else:
            out.append(_data_center(run, dc, found))
    return "".join(out)


def _data_center(run: RunFolder, dc: int, found: InletsAtStep) -> str:
    """Table of the hottest racks of a data center, and what is behind the hottest."""
    per_row = found.config.hall.racks_per_row
    all_parts = [found.inlets.parts(rack) for rack in found.inlets.hottest(HOTTEST_RACKS)]
    when = time_text(run, local_time(run, dc, found.step))
    recirculates = found.config.hall.inlet_model == "recirculation"
    rows = [_row(parts, per_row, recirculates=recirculates) for parts in all_parts]
    heads = [
        Cell(text, text not in (HEADS[0], HEADS[-1]))
        for text in (HEADS if recirculates else APPROACH_HEADS)
    ]
    caption = (
        f"Hottest racks of {run.names[dc]} at the end of the step of its hottest inlet, "
        f"{found.hottest_c:.2f} °C on {when}"
    )
    lines = [f"{text[0].upper()}{text[1:]}." for text in state_texts(all_parts[0])]
    if recirculates:
        share = f"{100 * all_parts[0].exhaust_share:.1f} %"
        lines.insert(0, f"Of the intake of the hottest, {share} is exhaust air.")
    items = "".join(f"<li>{escape(line)}</li>\n" for line in lines)
    return html_table(caption, heads, rows) + f"<ul>{items}</ul>\n"


def _row(parts: InletParts, racks_per_row: int, *, recirculates: bool) -> list[Cell]:
    """Cells of one rack."""
    numbers = [parts.inlet_c, parts.setpoint_c, parts.warming_k]
    if recirculates:
        others_k = float(parts.exhaust_k.sum()) - parts.own_exhaust_k + parts.lag_k
        numbers += [others_k, parts.own_exhaust_k, parts.height_k, parts.shortfall_k]
    else:
        numbers.append(parts.approach_k)
    cells = [Cell(rack_text(parts.rack, racks_per_row))]
    cells += [Cell(f"{number:z.2f}", True) for number in numbers]
    if recirculates:
        sources = ", ".join(f"rack {rack} {k:.2f}" for rack, k in parts.sources(NAMED_SOURCES))
        cells.append(Cell(sources or "–"))
    return cells
