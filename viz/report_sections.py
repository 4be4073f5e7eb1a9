"""Sections of a report in words and tables: summary, events, provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.run.folder_reader import RunFolder, read_configs
from sdc_taichi.run.folder_writer import METRICS_FILE

from .plotting import format_number
from .report_html import Cell, html_table, notice
from .report_text import (
    MAX_ROWS,
    count_text,
    first_texts,
    local_time,
    metric_text,
    names_text,
    time_text,
)

KEY_METRICS = (
    ("facility energy", "facility_kwh", "kWh"),
    ("PUE", "pue", ""),
    ("cost, currency of the tariff", "cost", ""),
    ("carbon footprint", "cfp_kg", "kg CO₂e"),
    ("make-up water", "water_l", "L"),
    ("hottest inlet", "hottest_inlet_c", "°C"),
    ("dropped work", "dropped_tasks", "tasks"),
)
"""Metrics at the head of the summary: label, name in metrics.json, unit."""


def summary_section(run: RunFolder) -> str:
    """Notices, key figures, where it was hot, where the work went, and what ran."""
    total = run.metrics["total"]
    cards = "".join(
        f"<div><dt>{label}</dt><dd>{escape(metric_text(total, key))} {unit}</dd></div>"
        for label, key, unit in KEY_METRICS
    )
    texts = [_hottest_inlet_text(run), *_work_texts(run)]
    items = "".join(f"<li>{escape(text)}</li>\n" for text in texts)
    return (
        "".join(map(notice, _notices(run)))
        + f'<dl class="key">{cards}</dl>\n'
        + f"<ul>{items}</ul>\n"
        + _what_ran(run)
    )


def _notices(run: RunFolder) -> list[str]:
    """Notices at the top of a report: an interruption, synthetic inputs, notes of the loaders."""
    done, asked = run.metrics["steps_done"], run.metrics["steps_asked"]
    texts = []
    if done < asked:
        texts.append(
            f"The run was interrupted: {done:,} of {asked:,} steps were done, and all figures "
            "are of these."
        )
    if run.metrics["synthetic"]:
        texts.append(
            "Inputs are SYNTHETIC, at least in part: these figures do not rest on measurements "
            "alone (see Provenance)."
        )
    return texts + [f"Note: {note}" for note in first_texts(run.metrics["notes"])]


def _what_ran(run: RunFolder) -> str:
    """Table of what ran: data centers, controller, steps, versions."""
    metrics, names = run.metrics, run.names
    sites = list(dict.fromkeys(dc["location"] for dc in metrics["data_centers"]))
    length = count_text(run.hours / 24, "day")
    steps = f"{metrics['steps_done']:,} of {60 * metrics['step_h']:g} min, {length}"
    versions = ", ".join(f"{name} {version}" for name, version in metrics["versions"].items())
    rows = [
        ("data centers", f"{len(names):,}: {names_text(names)}"),
        ("sites", names_text(sites)),
        ("controller", metrics["controller"]),
        ("steps", steps),
        ("seed", f"{metrics['seed']}"),
        ("precision of the kernels", metrics["precision"]),
        ("folder", run.path.resolve().name),
        ("versions", versions),
        ("fingerprint of configs, inputs and precision", metrics["fingerprint"]),
    ]
    return html_table("What ran", None, [[Cell(name), Cell(value)] for name, value in rows])


def _hottest_inlet_text(run: RunFolder) -> str:
    """Place and time of the hottest inlet, and how long the hall was too hot, in words."""
    total = run.metrics["total"]
    where = total["hottest_dc"]
    dc = run.names.index(where)
    moment = time_text(run, local_time(run, dc, total["hottest_step"]))
    hours = run.metrics["data_centers"][dc]["metrics"]["inlet_above_27_h"]
    (config,) = read_configs(run, [dc])
    row, rack = divmod(total["hottest_rack"], config.hall.racks_per_row)
    return (
        f"The hottest inlet was {metric_text(total, 'hottest_inlet_c')} °C in {where}, row {row}, "
        f"rack {rack}, server {total['hottest_server']} from the floor, on {moment}. An inlet "
        f"there was above {RECOMMENDED_C[1]:g} °C for {format_number(hours)} h, "
        f"{100 * hours / run.hours:.3g} % of the time."
    )


def _work_texts(run: RunFolder) -> list[str]:
    """Where work, stored energy and capacity went, in words."""
    total = run.metrics["total"]
    arrived = total["arrived_tasks"]
    dropped, lost = total["dropped_tasks"], total["lost_tasks"]
    dropped_pct = 100 * dropped / arrived if arrived else 0.0
    (config,) = read_configs(run, [0])
    full = (
        f"were done, {format_number(dropped)} of them at once because the queue was full "
        f"({dropped_pct:.3g} %), and {format_number(lost)}"
        if config.workload.model == "tasks"
        else f"were done, {format_number(dropped)} dropped ({dropped_pct:.3g} %) and "
        f"{format_number(lost)}"
    )
    texts = [
        f"Of {format_number(arrived)} tasks that arrived, {metric_text(total, 'executed_tasks')} "
        f"{full} lost with their servers; {metric_text(total, 'queue_end_tasks')} were queued at "
        "the end."
    ]
    if total["battery_charge_kwh"] > 0:
        texts.append(
            f"The battery took {metric_text(total, 'battery_charge_kwh')} kWh from the grid and "
            f"gave {metric_text(total, 'battery_discharge_kwh')} kWh back."
        )
    else:
        texts.append("The battery was not charged.")
    for key, text in (
        ("throttled_rack_h", "Racks were throttled for {} rack h because of hot air."),
        ("tripped_rack_h", "Racks were switched off for {} rack h because of hot air."),
        ("unserved_kwh", "In grid outages, {} kWh could not be served."),
        ("grid_overload_kwh", "The grid connection carried {} kWh beyond its limit."),
        ("unmet_cooling_kwh", "The plant lacked capacity for {} kWh of heat."),
    ):
        if total[key] > 0:
            texts.append(text.format(format_number(total[key])))
    if total["time_to_throttle_min"] is not None:
        minutes = metric_text(total, "time_to_throttle_min")
        texts.append(f"The first rack throttled {minutes} min after an event began.")
    return texts


def events_section(run: RunFolder) -> str:
    """Events that the run met, one by one, or by kind if there are many."""
    met = [(i, event) for i, dc in enumerate(run.metrics["data_centers"]) for event in dc["events"]]
    if not met:
        return "<p>None: the run met no failure, outage or heat wave.</p>\n"
    caption = f"{count_text(len(met), 'event')} that the run met"
    if len(met) > MAX_ROWS:
        return _events_by_kind(run, met, f"{caption}, by kind; all are in {METRICS_FILE}")
    rows = []
    for index, event in met:
        begin, end = event["start_step"], event["end_step"]
        amount = f"{100 * event['share']:.0f} % left" if "share" in event else ""
        amount += f"{event['offset_k']:+g} K" if "offset_k" in event else ""
        cells = [run.names[index], _kind_text(event), str(event.get("target", "")), amount,
                 time_text(run, local_time(run, index, begin))]  # fmt: skip
        rows.append([*map(Cell, cells), Cell(format_number(_event_hours(run, event)), True),
                     Cell(f"{begin} to {end - 1}", True)])  # fmt: skip
    heads = ["data center", "event", "unit or rack in hall", "amount", "from (local standard time)"]
    return html_table(
        caption, [*map(Cell, heads), Cell("duration (h)", True), Cell("steps", True)], rows
    )


def _events_by_kind(
    run: RunFolder, met: Sequence[tuple[int, Mapping[str, Any]]], caption: str
) -> str:
    """Table of events with a row for each kind."""
    groups: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    for index, event in met:
        groups.setdefault(_kind_text(event), []).append((index, event))
    rows = []
    for kind, own in sorted(groups.items()):
        index, first = min(own, key=lambda each: each[1]["start_step"])
        hours = sum(_event_hours(run, event) for _, event in own)
        counts = (len(own), len({dc for dc, _ in own}), hours)
        when = (
            f"{time_text(run, local_time(run, index, first['start_step']))} in {run.names[index]}"
        )
        rows.append(
            [Cell(kind), *(Cell(format_number(count), True) for count in counts), Cell(when)]
        )
    heads = [Cell(text, True) for text in ("events", "data centers", "duration together (h)")]
    return html_table(caption, [Cell("event"), *heads, Cell("first (local standard time)")], rows)


def _kind_text(event: Mapping[str, Any]) -> str:
    """Kind of an event in words."""
    return str(event["kind"]).replace("_", " ")


def _event_hours(run: RunFolder, event: Mapping[str, Any]) -> float:
    """Length of an event, in h."""
    return float((event["end_step"] - event["start_step"]) * run.metrics["step_h"])


def provenance_section(run: RunFolder) -> str:
    """Source of every input, with the SHA-256 of files and the data centers that use it."""
    users: dict[tuple[str, str, str], list[str]] = {}
    for dc in run.metrics["data_centers"]:
        sources, hashes = dc["provenance"], dc["sha256"]
        for kind in (*sources, *(kind for kind in hashes if kind not in sources)):
            key = (
                kind,
                str(sources.get(kind, "file that the config names")),
                str(hashes.get(kind, "")),
            )
            users.setdefault(key, []).append(dc["name"])
    rows = [
        [Cell(kind), Cell(source), Cell(digest or "–"), Cell(names_text(names))]
        for (kind, source, digest), names in sorted(users.items())
    ]
    heads = [Cell(text) for text in ("input", "source", "SHA-256 of the file", "data centers")]
    caption = f"Where the inputs come from; {count_text(len(rows), 'source')}"
    if len(rows) > MAX_ROWS:
        caption += f", the first {MAX_ROWS}, all are in {METRICS_FILE}"
    return html_table(caption, heads, rows[:MAX_ROWS])
