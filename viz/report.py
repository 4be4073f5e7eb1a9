"""One HTML file that tells what a recorded run did: summary, tables, pictures.

The file holds everything it shows, styles and pictures as data, and no script; its content security
policy forbids whatever would reach for the network. Equal runs give equal bytes. What grows with
the number of data centers is cut: tables show the extremes, pictures a few chosen data centers.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import SdcError
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.run.folder_reader import (
    RunFolder,
    is_number,
    read_configs,
    read_fleet_steps,
    read_steps,
)
from sdc_taichi.run.folder_writer import METRICS_FILE, REPORT_FILE
from sdc_taichi.year_clock import HOURS_PER_YEAR, day_of_year, step_times

from . import dashboards, data_figures, figures, fleet_figures
from .fleet_figures import MAP_ROWS, MOST_RUNS, RADAR, number

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

COLUMN_DCS = 6
"""Up to this many data centers have a column of their own."""
SHOWN_DCS = 4
"""Up to this many data centers have pictures of their own."""
COMPARED_RUNS = 4
"""Runs beside the first in one table."""
RANKS_WORST, RANKS_BEST = 5, 3
MOST_ROWS = 40
"""Most rows of a list that grows with the run: events, sources, notes."""
NAMES_PER_CELL = 6
PICTURE_DPI = 110
LONG_WORD = 24
"""Words of a table from this length on, such as names and hashes, may be broken on paper."""
YEAR_FROM_H = 48.0

METRICS = (
    (
        "Energy",
        (
            ("it_kwh", "IT energy, servers with their fans", "kWh"),
            ("hvac_kwh", "HVAC energy", "kWh"),
            ("facility_kwh", "facility energy, IT and HVAC", "kWh"),
            ("battery_charge_kwh", "drawn into the battery", "kWh"),
            ("battery_discharge_kwh", "delivered by the battery", "kWh"),
            ("battery_net_kwh", "battery, drawn less delivered", "kWh"),
            ("grid_kwh", "grid energy, facility and battery", "kWh"),
            ("unserved_kwh", "unserved in outages", "kWh"),
            ("pue", "PUE", "1"),
            ("pue_with_ups", "PUE with UPS losses", "1"),
            ("partial_pue", "partial PUE of chiller and tower", "1"),
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
            ("queue_mean_tasks", "mean queue", "tasks"),
            ("queue_max_tasks", "longest queue", "tasks"),
            ("dropped_tasks", "dropped, the queue being full", "tasks"),
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
            ("shi", "supply heat index SHI", "1"),
            ("rhi", "return heat index RHI", "1"),
            ("rti_pct", "return temperature index RTI", "%"),
            ("rci_hi_pct", "rack cooling index RCI, high end", "%"),
            ("rci_hi_min_pct", "the same, worst step", "%"),
            ("rci_lo_pct", "rack cooling index RCI, low end", "%"),
        ),
    ),
)
"""Section, and of each metric: its name in metrics.json, what it is, unit."""

COMPARED = (
    *(key for key, *_ in RADAR),
    "grid_kwh",
    "pue",
    "cue_kg_per_kwh",
    "wue_l_per_kwh",
    "dropped_tasks",
    "overdue_task_h",
    "hottest_inlet_c",
    "inlet_above_27_h",
)
"""Metrics of the table that compares runs."""

RANKED = ("hottest_inlet_c", "pue", "cue_kg_per_kwh", "wue_l_per_kwh", "dropped_tasks")
"""Metrics that rank data centers; more is worse."""

STYLE = """
:root { color-scheme: light; }
body { margin: 0 auto; padding: 1.5rem; max-width: 76rem; color: #1a1a1a; background: #fff;
  font: 16px/1.45 system-ui, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.3rem; margin: 2.2rem 0 .6rem; border-bottom: 2px solid #0072B2;
  overflow-wrap: anywhere; }
h3 { font-size: 1.05rem; margin: 1.4rem 0 .4rem; overflow-wrap: anywhere; }
p, ul { max-width: 62rem; }
.lead { color: #444; margin-top: 0; overflow-wrap: anywhere; }
.notice { border-left: 5px solid #E69F00; background: #fff6e0; padding: .5rem .9rem;
  margin: .8rem 0; overflow-wrap: anywhere; }
.key { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: .6rem;
  margin: 1rem 0; padding: 0; }
.key div { border: 1px solid #ccc; border-radius: 6px; padding: .5rem .8rem; }
.key dt { font-size: .85rem; color: #444; }
.key dd { margin: 0; font-size: 1.25rem; font-weight: 600; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; margin: .4rem 0; }
caption { text-align: left; color: #444; padding-bottom: .3rem; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid #ddd; text-align: left;
  vertical-align: top; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
td { min-width: 3.5rem; }
thead th { border-bottom: 2px solid #888; }
tbody th { font-weight: 400; }
th.group { font-weight: 600; padding-top: .7rem; }
code { font-size: .85em; overflow-wrap: anywhere; }
pre { font-size: .75rem; overflow-x: auto; background: #f5f5f5; padding: .8rem; }
figure { margin: 1rem 0 1.6rem; }
img { max-width: 100%; height: auto; }
figcaption { font-size: .88rem; color: #444; max-width: 62rem; overflow-wrap: anywhere; }
nav ul { columns: 2; padding-left: 1.2rem; }
a { color: #0060a0; }
@page { size: A4; margin: 14mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  nav, details { display: none; }
  h2, h3, caption, thead, tr.group { break-after: avoid; }
  section.own { break-before: page; }
  figure, .key, .notice, tr { break-inside: avoid; }
  thead { display: table-header-group; }
  table { font-size: 8pt; width: 100%; }
  th, td { padding: .12rem .35rem; }
  td { min-width: 0; }
  .long { overflow-wrap: anywhere; }
  .wide { overflow: visible; }
  img { max-height: 230mm; }
  a { color: inherit; text-decoration: none; }
}
"""


@dataclass(frozen=True, slots=True)
class _Cell:
    """A cell of a table: text, and whether it is a number."""

    text: str
    number: bool = False


@dataclass(frozen=True, slots=True)
class _Shown:
    """A data center with pictures of its own."""

    index: int
    why: str
    steps: pd.DataFrame
    config: DataCenterConfig


def write_report(run: RunFolder, others: Sequence[RunFolder] = (), out: Path | None = None) -> Path:
    """Write the report of a recorded run.

    Args:
        run: the run, from ``recorded.read_run``.
        others: runs to compare it with, of equal length.
        out: the file; None is ``report.html`` in the run's folder, replaced if it exists.

    Returns:
        The file.

    Raises:
        SdcError: matplotlib is missing, steps.parquet is damaged, the runs cannot be compared, or
            the file cannot be written.
    """
    target = run.path / REPORT_FILE if out is None else out
    # Opened first, so that a place that cannot be written is known before the work.
    with atomic_write(target) as file:
        file.write(report_html(run, others).encode("utf-8", "replace"))
    return target


def report_html(run: RunFolder, others: Sequence[RunFolder] = ()) -> str:
    """The report as text.

    Raises:
        SdcError: as ``write_report``.
    """
    for each in (run, *others):
        _check_metrics(each)
    sections = {
        "Summary": _summary(run),
        "Metrics": _metrics(run),
    }
    if others:
        sections["Comparison"] = _comparison([run, *others])
    sections["Events"] = _events(run)
    shown = _shown(run)
    if len(run.names) > 1 and run.metrics["steps_done"] > 1:
        sections["All data centers"] = _fleet(run)
    for dc in shown:
        sections[f"Data center {run.names[dc.index]}"] = _data_center(run, dc)
    if run.metrics["steps_done"] > 1:
        sections["Inputs"] = _inputs(run, shown)
    sections["Provenance"] = _provenance(run)
    return _page(run, sections)


def _check_metrics(run: RunFolder) -> None:
    path, dcs = run.path / METRICS_FILE, run.metrics["data_centers"]
    # Racks of a hall and servers of a rack are far fewer.
    places = dict.fromkeys(("hottest_row", "hottest_rack", "hottest_server"), 10**9)
    places["hottest_step"] = run.metrics["steps_done"] - 1
    ratios = {"pue", "pue_with_ups", "partial_pue", "cue_kg_per_kwh", "wue_l_per_kwh"}
    given = [("total", run.metrics["total"])]
    given += [(f"data_centers[{i}].metrics", dc["metrics"]) for i, dc in enumerate(dcs)]
    for where, metrics in given:
        for key in (key for _, group in METRICS for key, *_ in group):
            value = metrics.get(key)
            empty = value is None and key in ratios and metrics.get("it_kwh") == 0
            if not (is_number(value) or (key in metrics and empty)):
                found = f"is {value!r}" if key in metrics else "is missing"
                raise SdcError(f"{path}: {where}.{key} {found}; valid is a number")
        for key, most in places.items():
            value = metrics.get(key)
            if not (is_number(value) and isinstance(value, int) and 0 <= value <= most):
                raise SdcError(
                    f"{path}: {where}.{key} is {value!r}; valid is a whole number, 0..{most}"
                )
    hottest = run.metrics["total"].get("hottest_dc")
    if hottest not in run.names:
        raise SdcError(f"{path}: total.hottest_dc {hottest!r}: no such data center")


def picture(figure: Figure, alt: str, caption: str) -> str:
    """A figure element with the picture in it."""
    width, height, data = figures.webp(figure, PICTURE_DPI)
    source = base64.b64encode(data).decode()
    return (
        f'<figure><img src="data:image/webp;base64,{source}" width="{width}" height="{height}" '
        f'alt="{escape(alt)}"><figcaption>{escape(caption)}</figcaption></figure>\n'
    )


def _page(run: RunFolder, sections: Mapping[str, str]) -> str:
    count = len(run.names)
    names = ", ".join(run.names) if count <= COLUMN_DCS else f"{count:,} data centers"
    title = f"Run of {names} under {run.metrics['controller']}"
    ids = {name: f"s{index}" for index, name in enumerate(sections)}
    links = "".join(f'<li><a href="#{ids[name]}">{escape(name)}</a></li>\n' for name in sections)
    own = {f"Data center {name}" for name in run.names}
    body = "".join(
        f'<section class="{"own" if name in own else "all"}" aria-labelledby="{ids[name]}">'
        f'<h2 id="{ids[name]}">{escape(name)}</h2>\n{content}</section>\n'
        for name, content in sections.items()
    )
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<main>\n"
        f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(_span(run))}</p>\n'
        f'<nav aria-label="Contents"><ul>\n{links}</ul></nav>\n{body}</main>\n</body>\n</html>\n'
    )


def _summary(run: RunFolder) -> str:
    about, total = run.metrics, run.metrics["total"]
    done, asked = about["steps_done"], about["steps_asked"]
    out = []
    if done < asked:
        out.append(
            _notice(
                f"The run was interrupted: {done:,} of {asked:,} steps were done, and all figures "
                "are of these."
            )
        )
    if about["synthetic"]:
        out.append(
            _notice(
                "Inputs are SYNTHETIC, at least in part: these figures do not rest on measurements "
                "alone (see Provenance)."
            )
        )
    out += [_notice(f"Note: {note}") for note in _cut(about["notes"])]
    key = (
        ("facility energy", "facility_kwh", "kWh"),
        ("PUE", "pue", ""),
        ("carbon footprint", "cfp_kg", "kg CO₂e"),
        ("make-up water", "water_l", "L"),
        ("hottest inlet", "hottest_inlet_c", "°C"),
        ("dropped work", "dropped_tasks", "tasks"),
    )
    cards = "".join(
        f"<div><dt>{name}</dt><dd>{escape(_value(total, key))} {unit}</dd></div>"
        for name, key, unit in key
    )
    out.append(f'<dl class="key">{cards}</dl>\n')
    facts = [_hottest_fact(run), *_work_facts(run)]
    out.append("<ul>" + "".join(f"<li>{escape(fact)}</li>\n" for fact in facts) + "</ul>\n")
    versions = ", ".join(f"{name} {number}" for name, number in about["versions"].items())
    rows = [
        ("data centers", f"{len(run.names):,}: {_names(run.names)}"),
        ("sites", _names(list(dict.fromkeys(dc["location"] for dc in about["data_centers"])))),
        ("controller", about["controller"]),
        ("steps", f"{done:,} of {60 * about['step_h']:g} min, {_count(run.hours / 24, 'day')}"),
        ("seed", f"{about['seed']}"),
        ("precision of the kernels", about["precision"]),
        ("folder", run.path.resolve().name),
        ("versions", versions),
        ("fingerprint of configs, inputs and precision", about["fingerprint"]),
    ]
    table = _table("What ran", None, [[_Cell(a), _Cell(b)] for a, b in rows])
    return "".join(out) + table


def _hottest_fact(run: RunFolder) -> str:
    total = run.metrics["total"]
    where = total["hottest_dc"]
    dc = run.names.index(where)
    moment = _clock(run, _local(run, dc, total["hottest_step"]))
    hours = run.metrics["data_centers"][dc]["metrics"]["inlet_above_27_h"]
    (config,) = read_configs(run, [dc])
    row, rack = divmod(total["hottest_rack"], config.hall.racks_per_row)
    return (
        f"The hottest inlet was {_value(total, 'hottest_inlet_c')} °C in {where}, row {row}, rack "
        f"{rack}, server {total['hottest_server']} from the floor, on {moment}. An inlet "
        f"there was above {RECOMMENDED_C[1]:g} °C for {number(hours)} h, "
        f"{100 * hours / run.hours:.3g} % of the time."
    )


def _work_facts(run: RunFolder) -> list[str]:
    total = run.metrics["total"]
    arrived = total["arrived_tasks"]
    dropped, lost = total["dropped_tasks"], total["lost_tasks"]
    late = 100 * dropped / arrived if arrived else 0.0
    # Queues are empty at first; sums of many steps leave a rest of rounding.
    left = arrived - total["executed_tasks"] - dropped - lost
    left = left if left > 1e-9 * arrived else 0.0
    facts = [
        f"Of {number(arrived)} tasks that arrived, {number(total['executed_tasks'])} were done, "
        f"{number(dropped)} dropped ({late:.3g} %) and {number(lost)} lost with their servers; "
        f"{number(left)} were queued at the end."
    ]
    if total["battery_charge_kwh"] > 0:
        facts.append(
            f"The battery took {number(total['battery_charge_kwh'])} kWh from the grid and gave "
            f"{number(total['battery_discharge_kwh'])} kWh back."
        )
    else:
        facts.append("The battery was not charged.")
    for key, text in (
        ("throttled_rack_h", "Racks were throttled for {} rack h because of hot inlets."),
        ("tripped_rack_h", "Racks were switched off for {} rack h because of hot inlets."),
        ("unserved_kwh", "In grid outages, {} kWh could not be served."),
        ("unmet_cooling_kwh", "The plant lacked capacity for {} kWh of heat."),
    ):
        if total[key] > 0:
            facts.append(text.format(number(total[key])))
    return facts


def _metrics(run: RunFolder) -> str:
    dcs, total = run.metrics["data_centers"], run.metrics["total"]
    few = len(dcs) <= COLUMN_DCS
    several = len(dcs) > 1
    heads = [_Cell("metric"), _Cell("unit")]
    if few:
        heads += [_Cell(dc["name"], True) for dc in dcs]
    else:
        heads += [_Cell("lowest"), _Cell("mean", True), _Cell("highest")]
    heads += [_Cell("all", True)] if several else []
    groups = []
    for group, metrics in METRICS:
        rows = []
        for key, label, unit in metrics:
            cells = [_Cell(label), _Cell(unit)]
            if few:
                cells += [_Cell(_value(dc["metrics"], key), True) for dc in dcs]
            else:
                low, mean, high = _spread(dcs, key)
                cells += [_Cell(low), _Cell(mean, True), _Cell(high)]
            cells += [_Cell(_value(total, key), True)] if several else []
            rows.append(cells)
        groups.append((group, rows))
    note = (
        "Of all data centers, energies, carbon, water, tasks and hours are sums, ratios those of "
        "the sums, queues means and maxima."
        if several
        else "Sums and means over the run."
    )
    out = _table(note, heads, groups=groups)
    return out if few else out + _ranking(dcs)


def _ranking(dcs: Sequence[dict[str, Any]]) -> str:
    labels = {key: f"{label} ({unit})" for _, group in METRICS for key, label, unit in group}
    ranked = {
        key: sorted(
            ((dc["metrics"][key], dc["name"]) for dc in dcs if dc["metrics"][key] is not None),
            key=lambda pair: -pair[0],
        )
        for key in RANKED
    }
    groups = []
    for group, count, sign in (("worst", RANKS_WORST, 1), ("best", RANKS_BEST, -1)):
        columns = [_ranks(ranked[key][::sign], count) for key in RANKED]
        rows = [
            [_Cell(f"{rank + 1}"), *(_Cell(column[rank]) for column in columns)]
            for rank in range(count)
        ]
        groups.append((group, rows))
    heads = [_Cell("rank"), *(_Cell(labels[key]) for key in RANKED)]
    return _table("Worst and best data centers by five metrics", heads, groups=groups)


def _ranks(pairs: Sequence[tuple[float, str]], count: int) -> list[str]:
    """The first pairs as text; equal values rank nobody."""
    if pairs and pairs[0][0] == pairs[-1][0]:
        return [f"all {number(pairs[0][0])}", *["–"] * (count - 1)]
    # Held together: a value alone on a line reads as another entry.
    texts = [f"{name}:\u00a0{number(value)}" for value, name in pairs[:count]]
    return texts + ["–"] * (count - len(texts))


def _comparison(runs: Sequence[RunFolder]) -> str:
    first, labels = runs[0], _run_labels(runs)
    for run in runs[1:]:
        if abs(run.hours - first.hours) > 1e-9:
            raise SdcError(
                f"{run.path}: {run.hours:g} h, {first.path}: {first.hours:g} h; runs to "
                "compare must be of equal length"
            )
    if len(runs) > MOST_RUNS:
        raise SdcError(f"{len(runs)} runs to compare; valid are up to {MOST_RUNS}")
    totals = [run.metrics["total"] for run in runs]
    out = []
    other = [
        label
        for label, run in zip(labels, runs, strict=True)
        if run.metrics["fingerprint"] != first.metrics["fingerprint"]
    ]
    if other:
        out.append(
            _notice(
                f"Other configs, inputs or precision than {labels[0]}: {_names(other)}. "
                "Differences come not from the controller alone."
            )
        )
    # As many columns as a page holds.
    for start in range(1, len(runs), COMPARED_RUNS):
        columns = [0, *range(start, min(start + COMPARED_RUNS, len(runs)))]
        out.append(_comparison_table([labels[i] for i in columns], [totals[i] for i in columns]))
    worst = "; ".join(
        f"{label} {number(max(total[key] for total in totals))} {unit}"
        for key, label, unit in RADAR
    )
    out.append(
        picture(
            fleet_figures.radar(dict(zip(labels, totals, strict=True))),
            f"Radar of five metrics for {_names(labels)}. Worst values: {worst}.",
            "Each axis runs from the value in the middle to the worst of the runs at the rim; less "
            "is better.",
        )
    )
    return "".join(out)


def _comparison_table(labels: Sequence[str], totals: Sequence[Mapping[str, Any]]) -> str:
    known = {key: (label, unit) for _, group in METRICS for key, label, unit in group}
    rows = []
    for key in COMPARED:
        base = totals[0][key]
        cells = [_Cell(known[key][0]), _Cell(known[key][1])]
        for index, total in enumerate(totals):
            text = _value(total, key)
            # A temperature has no zero to be a share of.
            if index and base and total[key] is not None and not key.endswith("_c"):
                text += f" ({100 * (total[key] / base - 1):+.2f} %)"
            cells.append(_Cell(text, True))
        rows.append(cells)
    heads = [_Cell("metric"), _Cell("unit"), *(_Cell(label, True) for label in labels)]
    caption = f"All data centers of each run; changes are against {labels[0]}"
    return _table(caption, heads, rows)


def _run_labels(runs: Sequence[RunFolder]) -> list[str]:
    """Controllers, with the folder where they are not enough to tell the runs apart."""
    names = [run.metrics["controller"] for run in runs]
    if len(set(names)) < len(names):
        names = [f"{n} ({run.path.resolve().name})" for n, run in zip(names, runs, strict=True)]
    if len(set(names)) < len(names):
        names = [f"{name} #{index + 1}" for index, name in enumerate(names)]
    return names


def _events(run: RunFolder) -> str:
    met = [(i, event) for i, dc in enumerate(run.metrics["data_centers"]) for event in dc["events"]]
    if not met:
        return "<p>None: the run met no failure, outage or heat wave.</p>\n"
    caption = f"{_count(len(met), 'event')} that the run met"
    if len(met) > MOST_ROWS:
        return _event_kinds(run, met, f"{caption}, by kind; all are in {METRICS_FILE}")
    rows = []
    for index, event in met:
        begin, end = event["start_step"], event["end_step"]
        amount = f"{100 * event['share']:.0f} % left" if "share" in event else ""
        amount += f"{event['offset_k']:+g} K" if "offset_k" in event else ""
        cells = [run.names[index], _kind(event), str(event.get("target", "")), amount,
                 _clock(run, _local(run, index, begin))]  # fmt: skip
        rows.append([*map(_Cell, cells), _Cell(number(_event_hours(run, event)), True),
                     _Cell(f"{begin} to {end - 1}", True)])  # fmt: skip
    heads = ["data center", "event", "unit or rack in hall", "amount", "from (local standard time)"]
    return _table(
        caption, [*map(_Cell, heads), _Cell("duration (h)", True), _Cell("steps", True)], rows
    )


def _event_kinds(run: RunFolder, met: Sequence[tuple[int, Mapping[str, Any]]], caption: str) -> str:
    """A row for each kind of event."""
    groups: dict[str, list[tuple[int, Mapping[str, Any]]]] = {}
    for index, event in met:
        groups.setdefault(_kind(event), []).append((index, event))
    rows = []
    for kind, own in sorted(groups.items()):
        index, first = min(own, key=lambda each: each[1]["start_step"])
        hours = sum(_event_hours(run, event) for _, event in own)
        counts = (len(own), len({dc for dc, _ in own}), hours)
        when = f"{_clock(run, _local(run, index, first['start_step']))} in {run.names[index]}"
        rows.append([_Cell(kind), *(_Cell(number(count), True) for count in counts), _Cell(when)])
    heads = [_Cell(text, True) for text in ("events", "data centers", "duration together (h)")]
    return _table(caption, [_Cell("event"), *heads, _Cell("first (local standard time)")], rows)


def _kind(event: Mapping[str, Any]) -> str:
    return str(event["kind"]).replace("_", " ")


def _event_hours(run: RunFolder, event: Mapping[str, Any]) -> float:
    return float((event["end_step"] - event["start_step"]) * run.metrics["step_h"])


def _fleet(run: RunFolder) -> str:
    fleet = read_fleet_steps(run)
    count = len(run.names)
    powers_kw = (fleet.series["it_w"] + fleet.series["hvac_w"]).to_numpy() / 1e3
    power, unit = figures.scaled(powers_kw, "kW", "MW")
    out = picture(
        fleet_figures.fleet_overview(fleet.series),
        f"Power, PUE, emitted carbon and hottest inlets of all {count} data centers over the run. "
        f"Highest power {power.max():.3g} {unit}, "
        f"hottest inlet {fleet.series['inlet_max_c'].max():.1f} °C.",
        f"Sums over the {count:,} data centers step by step, each on its own clock; the axis shows "
        f"that of {run.names[0]}. Below, the hottest inlet of each data center: median, the middle "
        "80 % and the highest.",
    )
    if len(fleet.inlet_max_c) > 1:
        order = np.argsort(-fleet.inlet_max_c.max(axis=0), kind="stable")[:3]
        hottest = ", ".join(run.names[dc] for dc in order)
        cut = f" The {MAP_ROWS} hottest of {count:,} are shown." if count > MAP_ROWS else ""
        out += picture(
            fleet_figures.fleet_map(fleet.edge_times, fleet.inlet_max_c, run.names),
            f"Hottest inlet of each data center over time, hottest data centers first: {hottest}.",
            f"Which halls ran hot, and when: the hottest inlet of each.{cut}",
        )
    return out


def _shown(run: RunFolder) -> list[_Shown]:
    """The data centers with pictures: all of a few, else the extremes."""
    dcs = run.metrics["data_centers"]
    if len(dcs) <= SHOWN_DCS:
        why = dict.fromkeys(range(len(dcs)), "")
    else:
        why = {}
        for key, best, text in (
            ("hottest_inlet_c", max, "hottest inlet"),
            ("pue", max, "highest PUE"),
            ("cue_kg_per_kwh", max, "most carbon per IT energy"),
            ("cue_kg_per_kwh", min, "least carbon per IT energy"),
        ):
            known = [i for i, dc in enumerate(dcs) if dc["metrics"][key] is not None]
            # Equal values tell nobody apart.
            if len({dcs[i]["metrics"][key] for i in known}) > 1:
                found = best(known, key=lambda i: dcs[i]["metrics"][key])
                why[found] = f"{why[found]}, {text}" if found in why else f"it has the {text}"
        why = why or {0: "hottest inlet, PUE and carbon are equal in all"}
    tables = read_steps(run, list(why))
    configs = read_configs(run, list(why))
    return [
        _Shown(index, reason, steps, config)
        for (index, reason), steps, config in zip(why.items(), tables, configs, strict=True)
    ]


def _data_center(run: RunFolder, dc: _Shown) -> str:
    steps, hall = dc.steps, dc.config.hall
    out = []
    if dc.why:
        out.append(f"<p>Shown because {dc.why} of {len(run.names):,}.</p>\n")
    about = f"{hall.rows} rows of {hall.racks_per_row} racks, site {dc.config.site.location}."
    if dc.config.description:
        about = f"{dc.config.description.rstrip('.')}; {about}"
    out.append(f"<p>{escape(about)}</p>\n")
    if len(steps) < 2:
        out.append("<p>A single step has no pictures.</p>\n")
        return "".join(out) + _yaml(dc)
    at = steps.iloc[int(steps["inlet_max_c"].to_numpy().argmax())]
    hot = f"{at['inlet_max_c']:.1f} °C on {_clock(run, at['time'].to_pydatetime())}"
    out.append(
        f"<p>At its hottest inlet, {hot}: outdoor {at['outdoor_c']:.1f} °C, wet bulb "
        f"{at['wet_bulb_c']:.1f} °C, setpoint {at['setpoint_c']:.1f} °C, supply air "
        f"{at['supply_c']:.1f} °C, IT {number(at['it_w'] / 1e3)} kW, HVAC "
        f"{number(at['hvac_w'] / 1e3)} kW, airflow of CRAC units {number(at['crac_flow_m3s'])} and "
        f"of servers {number(at['it_airflow_m3s'])} m³/s.</p>\n"
    )
    return "".join(out) + _pictures(run, dc, hot) + _yaml(dc)


def _pictures(run: RunFolder, dc: _Shown, hot: str) -> str:
    """Pictures of one data center, whose hottest inlet is told in words."""
    name, steps, hall = run.names[dc.index], dc.steps, dc.config.hall
    out = []
    racks = steps["hottest_rack"].astype(int)
    most = int(racks.mode().iloc[0])
    row, column = divmod(most, hall.racks_per_row)
    share = 100 * float((racks == most).mean())
    out.append(
        picture(
            dashboards.hot_racks(steps, hall, name),
            f"Racks of {name} by the time that each had the hottest inlet of the hall; most often "
            f"row {row}, rack {column}, {share:.0f} % of the time.",
            "Where the hall ran hot: how long each rack had the hottest inlet, and how hot it was "
            "there. Grey racks never had it. Row 0 is on top.",
        )
    )
    if run.hours >= YEAR_FROM_H:
        out.append(
            picture(
                dashboards.year(steps, name),
                f"Weather, hottest inlet, power and carbon of {name} by day and hour of the day, "
                "and energy and carbon by day or month.",
                "The run by day, to the right, and time of day, upwards.",
            )
        )
    elif run.hours > 24.0:
        out.append(
            picture(
                figures.overview(steps),
                f"Weather, power by device, carbon, queue and battery of {name} over the run.",
                f"The whole run of {name}.",
            )
        )
    date = dashboards.hottest_day(steps)
    if int((steps["time"].dt.strftime("%Y-%m-%d") == date).sum()) > 1:
        events = run.metrics["data_centers"][dc.index]["events"]
        out.append(
            picture(
                dashboards.day(steps, date, name, events),
                f"Temperatures, power, carbon, commands, queue and battery of {name} on the day of "
                f"its hottest inlet, {hot}.",
                "The day of the hottest inlet. The dotted line is 27 °C, the highest recommended "
                "inlet; failures and racks under protection are shaded.",
            )
        )
    out.append(
        picture(
            dashboards.setpoint_scatter(steps, name),
            f"Steps of {name} by outdoor temperature and IT power, coloured by setpoint, by HVAC "
            "over IT power and by hottest inlet.",
            "Which setpoint was used at which weather and load, what cooling cost there and how "
            "hot it became.",
        )
    )
    if float(steps["charge_kwh"].max()) > 0 or float(steps["discharge_kwh"].max()) > 0:
        out.append(
            picture(
                dashboards.battery_profile(steps, name),
                f"Carbon intensity, battery power and battery charge of {name} by time of day.",
                "What the battery did over the day. Lines are means over the days, bands hold 80 % "
                "of them.",
            )
        )
    return "".join(out)


def _inputs(run: RunFolder, shown: Sequence[_Shown]) -> str:
    names = [run.names[dc.index] for dc in shown]
    origin = "as the run read them" + (", SYNTHETIC in part" if run.metrics["synthetic"] else "")
    out = []
    for column, quantity, what in (
        ("outdoor_c", data_figures.TEMPERATURE, "Outdoor temperature"),
        ("ci_g_per_kwh", data_figures.CARBON, "Carbon intensity"),
        ("demand", data_figures.WORKLOAD, "Arriving work"),
    ):
        series = _alike(names, [dc.steps.set_index("time")[column] for dc in shown])
        means = ", ".join(
            f"{name} {quantity.factor * values.mean():.4g}" for name, values in series.items()
        )
        out.append(
            picture(
                data_figures.comparison(series, quantity),
                f"{what} by time and by hour of the day. Means: {means}.",
                f"{what}, {origin}.",
            )
        )
        # A day without emissions has no relative variation.
        some = all(data_figures.daily(values).mean().min() > 0 for values in series.values())
        if column == "ci_g_per_kwh" and some and len(series) > 1:
            out.append(
                picture(
                    data_figures.carbon_variation(series),
                    "Mean carbon intensity against its variation within the day.",
                    "Mean carbon intensity against its variation within the day: to the right, the "
                    "time of use matters more.",
                )
            )
    return "".join(out)


def _alike(names: Sequence[str], every: Sequence[pd.Series]) -> dict[str, pd.Series]:
    """Series by name; data centers with the same one share it."""
    users: list[tuple[list[str], pd.Series]] = []
    for name, values in zip(names, every, strict=True):
        same = next((own for own, series in users if series.equals(values)), None)
        if same is None:
            users.append(([name], values))
        else:
            same.append(name)
    return {", ".join(own): series for own, series in users}


def _provenance(run: RunFolder) -> str:
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
        [_Cell(kind), _Cell(source), _Cell(digest or "–"), _Cell(_names(names))]
        for (kind, source, digest), names in sorted(users.items())
    ]
    heads = [_Cell(text) for text in ("input", "source", "SHA-256 of the file", "data centers")]
    caption = f"Where the inputs come from; {_count(len(rows), 'source')}"
    if len(rows) > MOST_ROWS:
        caption += f", the first {MOST_ROWS}, all are in {METRICS_FILE}"
    return _table(caption, heads, rows[:MOST_ROWS])


def _yaml(dc: _Shown) -> str:
    text = escape(dc.config.to_yaml())
    return f"<details><summary>Configuration</summary><pre>{text}</pre></details>\n"


def _table(
    caption: str,
    heads: Sequence[_Cell] | None,
    rows: Sequence[Sequence[_Cell]] = (),
    *,
    groups: Iterable[tuple[str, Iterable[Sequence[_Cell]]]] = (),
) -> str:
    """A table whose rows are headed by their first cell."""
    head = ""
    if heads is not None:
        cells = "".join(_tag("th", cell, ' scope="col"') for cell in heads)
        head = f"<thead><tr>{cells}</tr></thead>"
    bodies = [f"<tbody>{_rows(rows)}</tbody>"] if rows else []
    for title, own in groups:
        across = len(heads) if heads is not None else 2
        bodies.append(
            f'<tbody><tr class="group"><th class="group" scope="rowgroup" colspan="{across}">'
            f"{escape(title)}</th></tr>\n{_rows(own)}</tbody>"
        )
    return (
        f'<div class="wide" role="region" aria-label="{escape(caption)}" tabindex="0"><table>'
        f"<caption>{escape(caption)}</caption>{head}{''.join(bodies)}</table></div>\n"
    )


def _rows(rows: Iterable[Sequence[_Cell]]) -> str:
    return "".join(
        "<tr>"
        + _tag("th", row[0], ' scope="row"')
        + "".join(_tag("td", cell) for cell in row[1:])
        + "</tr>\n"
        for row in rows
    )


def _tag(tag: str, cell: _Cell, attributes: str = "") -> str:
    is_long = max(map(len, cell.text.split(" "))) >= LONG_WORD
    classes = " ".join(["n"] * cell.number + ["long"] * is_long)
    kind = f' class="{classes}"' if classes else ""
    return f"<{tag}{attributes}{kind}>{escape(cell.text)}</{tag}>"


def _notice(text: str) -> str:
    return f'<p class="notice" role="note">{escape(text)}</p>\n'


def _value(metrics: Mapping[str, Any], key: str) -> str:
    value = metrics[key]
    return "–" if value is None else number(value)


def _spread(dcs: Sequence[dict[str, Any]], key: str) -> list[str]:
    """Lowest, mean and highest, the extremes with the first data center that has them."""
    known = [(dc["metrics"][key], dc["name"]) for dc in dcs if dc["metrics"][key] is not None]
    if not known:
        return ["–"] * 3
    low, high = min(known, key=lambda k: k[0]), max(known, key=lambda k: k[0])
    mean = number(sum(value for value, _ in known) / len(known))
    if low[0] == high[0]:
        return [number(low[0]), mean, number(high[0])]
    return [f"{number(low[0])} {low[1]}", mean, f"{number(high[0])} {high[1]}"]


def _names(names: Sequence[str]) -> str:
    if len(names) <= NAMES_PER_CELL:
        return ", ".join(names)
    return f"{', '.join(names[:NAMES_PER_CELL])} and {len(names) - NAMES_PER_CELL:,} more"


def _cut(texts: Sequence[str]) -> list[str]:
    if len(texts) <= MOST_ROWS:
        return list(texts)
    return [*texts[:MOST_ROWS], f"and {len(texts) - MOST_ROWS} more, see {METRICS_FILE}"]


def _local(run: RunFolder, dc: int, step: int) -> datetime:
    """Start of a step on the clock of a data center."""
    about = run.metrics["data_centers"][dc]
    per_hour = round(1 / run.metrics["step_h"])
    start = np.array([day_of_year(about["start"]) * 24 * per_hour])
    moment: datetime = step_times(start, np.array([step]), per_hour)[0, 0].astype(datetime)
    return moment


def _clock(run: RunFolder, moment: datetime) -> str:
    day = figures.day_of_run(moment, over_a_year=run.hours > HOURS_PER_YEAR)
    return f"{day} {moment:%H:%M}"


def _count(value: float, noun: str) -> str:
    return f"{number(value)} {noun}" + ("" if value == 1 else "s")


def _span(run: RunFolder) -> str:
    begin, last = _local(run, 0, 0), _local(run, 0, run.metrics["steps_done"])
    span = f"{_clock(run, begin)} to {_clock(run, last)}, local standard time"
    return f"{_count(len(run.names), 'data center')}, {_count(run.hours / 24, 'day')} from {span}"
