"""Summary of a run that ``sdc-taichi simulate`` prints: a few figures per data center."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sdc_taichi.cli.terminal import (
    count_text,
    figure_text,
    figures_table,
    first_lines,
    wide_console,
)
from sdc_taichi.run.metrics import without_repeated_pue

NUMBER_FORMAT = "z.4g"
"""Format specification of figures below 1000."""
MOST_LINES = 12
"""Largest number of printed sources of inputs, and of printed remarks on the optimum."""
EVENT_LINES = 8
"""Largest number of printed events."""

_ROWS = (
    ("IT energy (kWh)", "it_kwh"),
    ("HVAC energy (kWh)", "hvac_kwh"),
    ("facility energy (kWh)", "facility_kwh"),
    ("grid energy (kWh)", "grid_kwh"),
    ("cost (currency of the tariff)", "cost"),
    ("highest grid power (kW)", "peak_kw"),
    ("PUE", "pue"),
    ("PUE with losses of UPS and distribution", "pue_with_losses"),
    ("WUE (L/kWh)", "wue_l_per_kwh"),
    ("CUE (kg/kWh)", "cue_kg_per_kwh"),
    ("CFP (kg CO2e)", "cfp_kg"),
    ("water (L)", "water_l"),
    ("mean queue (tasks)", "queue_mean_tasks"),
    ("longest queue (tasks)", "queue_max_tasks"),
    ("dropped (tasks)", "dropped_tasks"),
    ("overdue (task hours)", "overdue_task_h"),
    ("hottest inlet (C)", "hottest_inlet_c"),
    ("inlet above 27 C (h)", "inlet_above_27_h"),
    ("inlet over 27 C (degree hours per server)", "over_27_degree_h"),
    ("SHI", "shi"),
    ("RTI (%)", "rti_pct"),
    ("RCI hi (%)", "rci_hi_pct"),
    ("RCI lo (%)", "rci_lo_pct"),
    ("lost (tasks)", "lost_tasks"),
    ("unserved energy (kWh)", "unserved_kwh"),
    ("grid overload (kWh)", "grid_overload_kwh"),
    ("battery throughput (kWh)", "battery_throughput_kwh"),
)


def print_summary(metrics: dict[str, Any], label: str, folder: Path, steps_per_hour: int) -> None:
    """Print the summary of a run.

    Args:
        metrics: content of metrics.json.
        label: name of the preset or file that the run was simulated with.
        folder: the run folder.
        steps_per_hour: number of steps in an hour.
    """
    console = wide_console(200)
    dcs, steps = metrics["data_centers"], metrics["steps_done"]
    days = steps / steps_per_hour / 24
    console.print(
        f"{label}: {count_text(len(dcs), 'data center')}, {days:g} days from "
        f"{dcs[0]['start']} ({steps} steps of {60 // steps_per_hour} min), "
        f"controller {metrics['controller']}"
    )
    label_of = {key: label for label, key in _ROWS}
    keys = without_repeated_pue([*label_of], [dc["metrics"] for dc in dcs])
    titles = [label_of[key] for key in keys]
    columns = [[dc["metrics"][key] for key in keys] for dc in dcs]
    total = [metrics["total"][key] for key in keys]
    names = [dc["name"] for dc in dcs]
    console.print(figures_table(console, titles, names, columns, total, NUMBER_FORMAT))
    console.print(_hottest_line(metrics))
    if "optimum" in metrics:
        for line in _optimum_lines(metrics):
            console.print(line)
    for line in _event_lines(metrics):
        console.print(line)
    if metrics["synthetic"]:
        console.print("These figures rest on SYNTHETIC inputs, not on measurements:")
    sources = dict.fromkeys(
        f"{kind}: {source}" for dc in dcs for kind, source in dc["provenance"].items()
    )
    for line in first_lines(sorted(sources), MOST_LINES, ", see metrics.json"):
        console.print(f"  {line}")
    config_file = "config.yaml" if len(dcs) == 1 else "configs.yaml"
    more = ", flows.parquet" if "moved_tasks" in metrics["total"] else ""
    more += ", optimum/" if "optimum" in metrics else ""
    console.print(f"Files in {folder}: steps.parquet, metrics.json, {config_file}{more}")


def _hottest_line(metrics: dict[str, Any]) -> str:
    total = metrics["total"]
    where = f"{total['hottest_dc']}, " if len(metrics["data_centers"]) > 1 else ""
    return (
        f"Hottest inlet: {total['hottest_inlet_c']:.1f} C at {where}row {total['hottest_row']}, "
        f"rack {total['hottest_rack']}, server {total['hottest_server']} from the floor, step "
        f"{total['hottest_step']}"
    )


def _optimum_lines(metrics: dict[str, Any]) -> list[str]:
    from sdc_taichi.run.optimum_folder import remarks_beside

    total, optimum = metrics["total"], metrics["optimum"]
    names = ("idle_figure", "bound_figure", "achieved_figure")
    idle, bound, achieved = (figure_text(total[name], NUMBER_FORMAT) for name in names)
    share = total["achievable_share"]
    reached = "-" if share is None else f"{100 * share:z.1f} %"
    return [
        f"Share of the achievable ({optimum['objective']}): {reached}; idle {idle}, achieved "
        f"{achieved}, bound {bound} {optimum['unit']}; work and energy left at the end are valued",
        *first_lines(remarks_beside(metrics), MOST_LINES, ", see metrics.json"),
    ]


def _event_lines(metrics: dict[str, Any]) -> list[str]:
    lines = []
    for dc in metrics["data_centers"]:
        for event in dc["events"]:
            target = f" {event['target']}" if "target" in event else ""
            amount = f", {event['share']:.0%} left" if "share" in event else ""
            amount += f", {event['offset_k']:+g} K" if "offset_k" in event else ""
            lines.append(
                f"Event: {dc['name']}: {event['kind']}{target}{amount}, steps "
                f"{event['start_step']}..{event['end_step'] - 1}"
            )
    return first_lines(lines, EVENT_LINES, " events, see metrics.json")
