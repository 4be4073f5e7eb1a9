"""Section of a report about the work that the sites of a fleet send to each other."""

from __future__ import annotations

import numpy as np

from sdc_taichi.run.folder_reader import FleetFlows, RunFolder, read_steps

from . import flow_figures
from .flow_figures import FlowPanel
from .plotting import format_number
from .report_html import Block, count_text, paragraph, picture, table

PART_H = 6
"""Length of a part of the day on the maps, in h."""
MAX_FLOWS = 20
"""Largest number of flows in the table."""


def flows_section(run: RunFolder, flows: FleetFlows) -> list[Block]:
    """Return the section of flows: maps by part of the day, and a table of the largest flows.

    The maps show the first fleet of a run of several.

    Raises:
        SdcError: steps.parquet is damaged.
    """
    if flows.table.empty:
        return [paragraph("No work was sent from site to site.")]
    blocks = []
    sites = flows.sites_per_fleet
    place_deg = flows.place_deg[:sites]
    if np.all(np.isfinite(place_deg)):
        several = len(run.names) > sites
        first = f"The first of {len(run.names) // sites:,} fleets. " if several else ""
        panels = flow_panels(run, flows)
        moved = sum(float(panel.tasks.sum()) for panel in panels)
        blocks.append(
            picture(
                flow_figures.flow_map(panels, run.names[:sites], place_deg),
                f"Maps of {sites} sites with arrows for the work that they sent to each other, by "
                f"part of the day; {format_number(moved)} tasks a day in all.",
                f"{first}Work sent from site to site, mean day of the run, by part of the day in "
                "UTC. The wider an arrow, the more work; the larger a disc, the more work the "
                "site executed.",
            )
        )
    return [*blocks, _largest_flows(run, flows)]


def flow_panels(run: RunFolder, flows: FleetFlows) -> list[FlowPanel]:
    """Return the flows of the first fleet of a run in each part of the day that the run has.

    Raises:
        SdcError: steps.parquet is damaged.
    """
    sites, step_h = flows.sites_per_fleet, float(run.metrics["step_h"])
    steps = read_steps(run, range(sites), ["executed_tasks", "ci_g_per_kwh"])
    hour = steps[0]["time"].dt.tz_convert("UTC").dt.hour.to_numpy()
    days = np.bincount(hour, minlength=24) * step_h  # Days that have each hour of the day.
    executed, ci = (
        np.array([np.bincount(hour, site[name], minlength=24) for site in steps])
        for name in ("executed_tasks", "ci_g_per_kwh")
    )
    rows = flows.table[flows.table["sender"] < sites]
    sent = np.zeros((24, sites, sites))
    np.add.at(sent, (rows["time"].dt.hour, rows["sender"], rows["receiver"]), rows["tasks"])
    panels = []
    for begin in range(0, 24, PART_H):
        part = [h for h in range(begin, begin + PART_H) if days[h] > 0]
        if part:
            tasks = (sent[part] / days[part, None, None]).sum(axis=0)
            sum_text = f"{format_number(tasks.sum())} tasks sent"
            title = f"{begin:02}:00 to {begin + PART_H:02}:00 UTC: {sum_text}"
            of_sites = (executed[:, part] / days[part]).sum(axis=1)
            mean_ci = ci[:, part].sum(axis=1) * step_h / days[part].sum()
            panels.append(FlowPanel(title, tasks, of_sites, mean_ci))
    return panels


def _largest_flows(run: RunFolder, flows: FleetFlows) -> Block:
    """Return the table of the pairs of sites between which most work was sent."""
    pairs = flows.table.groupby(["sender", "receiver"])[["tasks", "transfer_g", "saved_g"]].sum()
    pairs = pairs.sort_values("tasks", ascending=False, kind="stable")
    total = pairs.sum()

    def cells(tasks: float, transfer_g: float, saved_g: float) -> list[str]:
        share = 100 * tasks / total["tasks"]
        values = (tasks, share, transfer_g / 1e3, saved_g / 1e3, saved_g / tasks)
        return [format_number(value) for value in values]

    rows = [
        (f"{run.names[sender]} to {run.names[receiver]}", *cells(*values))
        for (sender, receiver), values in zip(
            pairs.index[:MAX_FLOWS], pairs.to_numpy()[:MAX_FLOWS], strict=True
        )
    ]
    shown = f", the {MAX_FLOWS} largest" if len(pairs) > MAX_FLOWS else ""
    caption = (
        f"{count_text(len(pairs), 'flow')} from site to site{shown}; what a flow saves is the "
        "facility energy of its work times the difference of the carbon intensities, less the "
        "emissions of the transfer"
    )
    rows.append(("all", *cells(*total)))
    heads = ("flow", "tasks", "share (%)", "transfer (kg CO₂e)", "saved (kg CO₂e)",
             "saved per task (g CO₂e)")  # fmt: skip
    return table(caption, heads, rows, numbers=range(1, len(heads)))
