"""Tables of metrics in a report: all metrics, and a ranking of data centers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sdc_taichi.run.folder_reader import RunFolder
from sdc_taichi.run.metrics import without_repeated_pue

from .plotting import format_number
from .report_html import (
    DASH,
    Block,
    metric_text,
    table,
)

MAX_DC_COLUMNS = 6
"""Largest number of data centers with one column each in the table of metrics."""
WORST_RANKS, BEST_RANKS = 5, 3
"""Number of worst and of best data centers in the ranking."""

WORK = "Work"
"""Title of the group of metrics of work, which runs show only where work was shifted."""
METRICS = (
    (
        "Energy",
        (
            ("it_kwh", "IT energy, servers with their fans", "kWh"),
            ("hvac_kwh", "HVAC energy", "kWh"),
            ("ups_loss_kwh", "lost in the UPS", "kWh"),
            ("distribution_loss_kwh", "lost in the distribution behind it", "kWh"),
            ("facility_kwh", "facility energy, IT, HVAC and counted losses", "kWh"),
            ("battery_charge_kwh", "drawn into the battery", "kWh"),
            ("battery_discharge_kwh", "delivered by the battery", "kWh"),
            ("battery_net_kwh", "battery, drawn less delivered", "kWh"),
            ("grid_kwh", "grid energy, facility and battery", "kWh"),
            ("grid_overload_kwh", "beyond the limit of the grid connection", "kWh"),
            ("unserved_kwh", "unserved in outages", "kWh"),
            ("pue", "PUE", "1"),
            ("pue_with_losses", "PUE with losses of UPS and distribution", "1"),
            ("partial_pue", "partial PUE of chiller and tower", "1"),
        ),
    ),
    (
        "Money",
        (
            ("energy_cost", "energy at the prices of the tariff", "currency"),
            ("demand_charge", "demand charges", "currency"),
            ("cost", "cost, energy and demand", "currency"),
            ("peak_kw", "highest power from the grid, mean over a step", "kW"),
        ),
    ),
    (
        "Carbon and water",
        (
            ("cfp_kg", "carbon footprint", "kg CO₂e"),
            ("cue_kg_per_kwh", "CUE, carbon over IT energy", "kg CO₂e/kWh"),
            ("water_l", "make-up water", "L"),
            ("wue_l_per_kwh", "WUE, water over IT energy", "L/kWh"),
        ),
    ),
    (
        WORK,
        (
            ("arrived_tasks", "arrived", "tasks"),
            ("executed_tasks", "executed", "tasks"),
            ("queue_end_tasks", "queued at the end", "tasks"),
            ("queue_mean_tasks", "mean queue", "tasks"),
            ("queue_max_tasks", "longest queue", "tasks"),
            ("dropped_tasks", "found the queue full", "tasks"),
            ("lost_tasks", "lost with their servers", "tasks"),
            ("overdue_task_h", "overdue", "task h"),
            ("overdue_max_tasks", "most overdue at a time", "tasks"),
        ),
    ),
    (
        "Hall",
        (
            ("hottest_inlet_c", "hottest server inlet", "°C"),
            ("inlet_above_27_h", "time with an inlet above 27 °C", "h"),
            ("over_27_degree_h", "inlets over 27 °C, mean over the servers", "K h"),
            ("unmet_cooling_kwh", "heat beyond the plant's capacity", "kWh"),
            ("throttled_rack_h", "racks throttled", "rack h"),
            ("tripped_rack_h", "racks tripped", "rack h"),
            ("time_to_throttle_min", "first event to first throttled rack", "min"),
            ("shi", "supply heat index SHI", "1"),
            ("rhi", "return heat index RHI", "1"),
            ("rti_pct", "return temperature index RTI", "%"),
            ("rci_hi_pct", "rack cooling index RCI, high end", "%"),
            ("rci_hi_min_pct", "the same, worst step", "%"),
            ("rci_lo_pct", "rack cooling index RCI, low end", "%"),
        ),
    ),
)
"""Groups of metrics in the order of the table.

Each group has a title and its metrics: name in metrics.json, label, unit.
"""

RANKED = ("hottest_inlet_c", "pue", "cue_kg_per_kwh", "wue_l_per_kwh", "dropped_tasks")
"""Names of the metrics in the ranking of data centers; larger values are worse."""
LABELS = {key: (label, unit) for _, group in METRICS for key, label, unit in group}
"""Label and unit of each metric, keyed by its name."""


def metrics_section(run: RunFolder) -> list[Block]:
    """Return the table of all metrics, and a ranking of the data centers if there are many.

    The table has one column per data center, or for many data centers their range.
    """
    dcs, total = run.metrics["data_centers"], run.metrics["total"]
    are_few, are_several = len(dcs) <= MAX_DC_COLUMNS, len(dcs) > 1
    columns = [dc["name"] for dc in dcs] if are_few else ["lowest", "mean", "highest"]
    heads = ["metric", "unit", *columns, *["all"] * are_several]
    names = without_repeated_pue([*LABELS], [dc["metrics"] for dc in dcs])
    groups = {}
    for group, metrics in METRICS:
        if group == WORK and not has_shifted_work(run):
            continue
        groups[group] = [
            [
                label,
                unit,
                *([metric_text(dc["metrics"], key) for dc in dcs] if are_few else _range(dcs, key)),
                *[metric_text(total, key)] * are_several,
            ]
            for key, label, unit in metrics
            if key in names
        ]
    caption = (
        "Of all data centers, energies, carbon, water, tasks and hours are sums, ratios those of "
        "the sums, queues means and maxima."
        if are_several
        else "Sums and means over the run."
    )
    numbers = range(2, len(heads)) if are_few else (3, 5)
    whole = table(caption, heads, numbers=numbers, groups=groups)
    return [whole] if are_few else [whole, _ranking(dcs)]


def has_shifted_work(run: RunFolder) -> bool:
    """Return True if work of a run waited, or was dropped or lost."""
    total = run.metrics["total"]
    return any(total[key] > 0 for key in ("queue_max_tasks", "dropped_tasks", "lost_tasks"))


def _ranking(dcs: Sequence[dict[str, Any]]) -> Block:
    """Return the table of the worst and the best data centers in each metric of ``RANKED``."""
    ranked = {key: sorted(_values(dcs, key), key=lambda pair: -pair[0]) for key in RANKED}
    groups = {}
    for group, count, order in (("worst", WORST_RANKS, 1), ("best", BEST_RANKS, -1)):
        columns = [_rank_texts(pairs[::order], count) for pairs in ranked.values()]
        ranks = [str(rank + 1) for rank in range(count)]
        groups[group] = list(zip(ranks, *columns, strict=True))
    heads = ["rank", *("{} ({})".format(*LABELS[key]) for key in RANKED)]
    return table("Worst and best data centers by five metrics", heads, groups=groups)


def _values(dcs: Sequence[dict[str, Any]], key: str) -> list[tuple[float, str]]:
    """Return the value of a metric and the data center's name, for data centers with a value."""
    pairs = [(dc["metrics"].get(key), dc["name"]) for dc in dcs]
    return [pair for pair in pairs if pair[0] is not None]


def _rank_texts(pairs: Sequence[tuple[float, str]], count: int) -> list[str]:
    """Return the first pairs of value and name as texts, padded with dashes.

    If all values are equal, there is no ranking, and the first text says so.

    Args:
        pairs: values and names of data centers, in the order of the ranking.
        count: number of texts.
    """
    if pairs and pairs[0][0] == pairs[-1][0]:
        texts = [f"all {format_number(pairs[0][0])}"]
    else:
        # The no-break space keeps name and value on one line; otherwise the value alone on a line
        # looks like another entry.
        texts = [f"{name}:\u00a0{format_number(value)}" for value, name in pairs[:count]]
    return texts + [DASH] * (count - len(texts))


def _range(dcs: Sequence[dict[str, Any]], key: str) -> list[str]:
    """Return minimum, mean and maximum of a metric over the data centers, as texts.

    Minimum and maximum include the name of their data center.
    """
    values = _values(dcs, key)
    if not values:
        return [DASH] * 3
    low, high = min(values, key=lambda v: v[0]), max(values, key=lambda v: v[0])
    mean = format_number(sum(value for value, _ in values) / len(values))
    if low[0] == high[0]:
        return [format_number(low[0]), mean, format_number(high[0])]
    return [f"{format_number(low[0])} {low[1]}", mean, f"{format_number(high[0])} {high[1]}"]
