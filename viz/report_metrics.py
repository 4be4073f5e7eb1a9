"""Tables of metrics in a report: all metrics, the ranking of data centers, runs compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sdc_taichi.errors import SdcError
from sdc_taichi.run.folder_reader import RunFolder

from .fleet_figures import MAX_RUNS, RADAR_METRICS, radar
from .plotting import format_number
from .report_html import Cell, html_table, notice, picture_element
from .report_text import metric_text, names_text, run_labels

MAX_DC_COLUMNS = 6
"""Largest number of data centers with a column each."""
COMPARED_PER_TABLE = 4
"""Runs beside the first in one table, as many as a page holds."""
WORST_RANKS, BEST_RANKS = 5, 3
"""Number of data centers in the ranking from the worst and from the best."""

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
        "Work",
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
"""Groups of metrics, and of each metric: its name in metrics.json, what it is, unit."""

COMPARED = (
    *(key for key, *_ in RADAR_METRICS),
    "grid_kwh",
    "cost",
    "peak_kw",
    "pue",
    "cue_kg_per_kwh",
    "wue_l_per_kwh",
    "dropped_tasks",
    "overdue_task_h",
    "hottest_inlet_c",
    "inlet_above_27_h",
)
"""Names of the metrics by which runs are compared."""

RANKED = ("hottest_inlet_c", "pue", "cue_kg_per_kwh", "wue_l_per_kwh", "dropped_tasks")
"""Names of the metrics by which data centers are ranked; more is worse."""


def metrics_section(run: RunFolder) -> str:
    """All metrics, with a column for each of a few data centers, or with their range."""
    dcs, total = run.metrics["data_centers"], run.metrics["total"]
    are_few, are_several = len(dcs) <= MAX_DC_COLUMNS, len(dcs) > 1
    heads = [Cell("metric"), Cell("unit")]
    if are_few:
        heads += [Cell(dc["name"], True) for dc in dcs]
    else:
        heads += [Cell("lowest"), Cell("mean", True), Cell("highest")]
    heads += [Cell("all", True)] if are_several else []
    groups = []
    for group, metrics in METRICS:
        rows = []
        for key, label, unit in metrics:
            cells = [Cell(label), Cell(unit)]
            if are_few:
                cells += [Cell(metric_text(dc["metrics"], key), True) for dc in dcs]
            else:
                low, mean, high = _low_mean_high(dcs, key)
                cells += [Cell(low), Cell(mean, True), Cell(high)]
            cells += [Cell(metric_text(total, key), True)] if are_several else []
            rows.append(cells)
        groups.append((group, rows))
    caption = (
        "Of all data centers, energies, carbon, water, tasks and hours are sums, ratios those of "
        "the sums, queues means and maxima."
        if are_several
        else "Sums and means over the run."
    )
    out = html_table(caption, heads, groups=groups)
    return out if are_few else out + _ranking(dcs)


def _ranking(dcs: Sequence[dict[str, Any]]) -> str:
    """The worst and the best data centers by each of a few metrics."""
    labels = {key: f"{label} ({unit})" for _, group in METRICS for key, label, unit in group}
    ranked = {
        key: sorted(
            ((dc["metrics"][key], dc["name"]) for dc in dcs if dc["metrics"][key] is not None),
            key=lambda pair: -pair[0],
        )
        for key in RANKED
    }
    groups = []
    for group, count, order in (("worst", WORST_RANKS, 1), ("best", BEST_RANKS, -1)):
        columns = [_rank_texts(ranked[key][::order], count) for key in RANKED]
        rows = [
            [Cell(f"{rank + 1}"), *(Cell(column[rank]) for column in columns)]
            for rank in range(count)
        ]
        groups.append((group, rows))
    heads = [Cell("rank"), *(Cell(labels[key]) for key in RANKED)]
    return html_table("Worst and best data centers by five metrics", heads, groups=groups)


def _rank_texts(pairs: Sequence[tuple[float, str]], count: int) -> list[str]:
    """The first pairs of a value and a name as texts; equal values rank nobody."""
    if pairs and pairs[0][0] == pairs[-1][0]:
        return [f"all {format_number(pairs[0][0])}", *["–"] * (count - 1)]
    # A space that does not break: a value alone on a line reads as another entry.
    texts = [f"{name}:\u00a0{format_number(value)}" for value, name in pairs[:count]]
    return texts + ["–"] * (count - len(texts))


def _low_mean_high(dcs: Sequence[dict[str, Any]], key: str) -> list[str]:
    """Lowest, mean and highest value of a metric as texts, the extremes with a data center."""
    known = [(dc["metrics"][key], dc["name"]) for dc in dcs if dc["metrics"][key] is not None]
    if not known:
        return ["–"] * 3
    low, high = min(known, key=lambda k: k[0]), max(known, key=lambda k: k[0])
    mean = format_number(sum(value for value, _ in known) / len(known))
    if low[0] == high[0]:
        return [format_number(low[0]), mean, format_number(high[0])]
    return [f"{format_number(low[0])} {low[1]}", mean, f"{format_number(high[0])} {high[1]}"]


def comparison_section(
    runs: Sequence[RunFolder], shares: Sequence[float | None] | None = None
) -> str:
    """Runs against the first one: metrics, their changes, and a radar of five.

    Args:
        runs: the runs.
        shares: share of the achievable of each, None where it is not known; None without a known
            optimum.

    Raises:
        SdcError: runs of other length than the first one, or too many.
    """
    first, labels = runs[0], run_labels(runs)
    for run in runs[1:]:
        if abs(run.hours - first.hours) > 1e-9:
            raise SdcError(
                f"{run.path}: {run.hours:g} h, {first.path}: {first.hours:g} h; runs to "
                "compare must be of equal length"
            )
    if len(runs) > MAX_RUNS:
        raise SdcError(f"{len(runs)} runs to compare; valid are up to {MAX_RUNS}")
    totals = [run.metrics["total"] for run in runs]
    out = []
    others = [
        label
        for label, run in zip(labels, runs, strict=True)
        if run.metrics["fingerprint"] != first.metrics["fingerprint"]
    ]
    if others:
        out.append(
            notice(
                f"Other configs, inputs or precision than {labels[0]}: {names_text(others)}. "
                "Differences come not from the controller alone."
            )
        )
    for start in range(1, len(runs), COMPARED_PER_TABLE):
        columns = [0, *range(start, min(start + COMPARED_PER_TABLE, len(runs)))]
        own = None if shares is None else [shares[i] for i in columns]
        out.append(
            _comparison_table([labels[i] for i in columns], [totals[i] for i in columns], own)
        )
    worst = "; ".join(
        f"{label} {format_number(max(total[key] for total in totals))} {unit}"
        for key, label, unit in RADAR_METRICS
    )
    out.append(
        picture_element(
            radar(dict(zip(labels, totals, strict=True))),
            f"Radar of five metrics for {names_text(labels)}. Worst values: {worst}.",
            "Each axis runs from the value in the middle to the worst of the runs at the rim; less "
            "is better.",
        )
    )
    return "".join(out)


def _comparison_table(
    labels: Sequence[str],
    totals: Sequence[Mapping[str, Any]],
    shares: Sequence[float | None] | None = None,
) -> str:
    """Metrics of some runs, and their changes against the first one."""
    known = {key: (label, unit) for _, group in METRICS for key, label, unit in group}
    rows = []
    for key in COMPARED:
        base = totals[0][key]
        cells = [Cell(known[key][0]), Cell(known[key][1])]
        for index, total in enumerate(totals):
            text = metric_text(total, key)
            # A temperature has no zero to be a share of.
            if index and base and total[key] is not None and not key.endswith("_c"):
                text += f" ({100 * (total[key] / base - 1):+z.2f} %)"
            cells.append(Cell(text, True))
        rows.append(cells)
    if shares is not None:
        texts = ["–" if share is None else f"{100 * share:z.1f}" for share in shares]
        own = [Cell("share of the achievable"), Cell("%"), *(Cell(text, True) for text in texts)]
        rows.append(own)
    heads = [Cell("metric"), Cell("unit"), *(Cell(label, True) for label in labels)]
    caption = f"All data centers of each run; changes are against {labels[0]}"
    return html_table(caption, heads, rows)
