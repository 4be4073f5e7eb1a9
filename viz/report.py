"""HTML report of a run: one file with a summary, tables and pictures.

The file contains all its styles and pictures, has no scripts, and forbids network access by its
content security policy. Equal runs give identical files, see docs/run-folder.md. The size of a
report is bounded for large fleets: tables show extreme values, and pictures show a few data
centers.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import ConfigError
from sdc_taichi.hall.air_metrics import RECOMMENDED_C
from sdc_taichi.run.folder_reader import RunFolder, read_configs
from sdc_taichi.run.folder_writer import METRICS_FILE, REPORT_FILE
from sdc_taichi.run.inlets_of_run import InletsAtStep, hottest_inlets
from sdc_taichi.sim.inlet_parts import HOTTEST_RACKS, InletParts, rack_text, state_texts

from .plotting import format_number
from .report_html import (
    DASH,
    MAX_ROWS,
    bullets,
    count_text,
    first_texts,
    html_page,
    html_table,
    key_figures,
    local_time,
    metric_text,
    names_text,
    notice,
    paragraph,
    time_span_text,
    time_text,
)
from .report_metrics import MAX_DC_COLUMNS, comparison_section, metrics_section
from .report_pictures import (
    data_center_section,
    fleet_section,
    inputs_section,
    known_optimum,
    optimum_section,
    share_of,
    shown_data_centers,
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
"""Metrics at the top of the summary: label, name in metrics.json, unit."""
LOSSES = {
    "throttled_rack_h": "Racks were throttled for {} rack h because of hot air.",
    "tripped_rack_h": "Racks were switched off for {} rack h because of hot air.",
    "unserved_kwh": "In grid outages, {} kWh could not be served.",
    "grid_overload_kwh": "The grid connection carried {} kWh beyond its limit.",
    "unmet_cooling_kwh": "The plant lacked capacity for {} kWh of heat.",
}
"""Sentences about failures and losses, keyed by metric; shown if the metric is above zero."""
NAMED_SOURCES = 3
"""Number of racks named in a row of the table of hot racks, as largest sources of exhaust."""
INLET_HEADS = (
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
"""Columns of the table of hot racks in a hall with recirculation.

The inlet is the sum of the next four columns.
"""
APPROACH_HEADS = (*INLET_HEADS[:4], "approach temperature (K)")
"""Columns of the table of hot racks in a hall without recirculation.

The inlet is the sum of the columns after it.
"""


def write_report(run: RunFolder, others: Sequence[RunFolder] = (), out: Path | None = None) -> Path:
    """Write the report of a run.

    Args:
        run: the run, from ``read_run``.
        others: runs of the same length, to compare the run with.
        out: path of the file; None is ``report.html`` in the run's folder, which is replaced if it
            exists.

    Returns:
        Path of the written file.

    Raises:
        SdcError: matplotlib is missing, steps.parquet is damaged, the runs cannot be compared, or
            the file cannot be written.
    """
    target = run.path / REPORT_FILE if out is None else out
    # The file is opened first: an unwritable path must fail before the long computation.
    with atomic_write(target) as file:
        file.write(report_html(run, others).encode("utf-8", "replace"))
    return target


def report_html(run: RunFolder, others: Sequence[RunFolder] = ()) -> str:
    """Return the report of a run as an HTML page.

    Args:
        run: the run.
        others: runs of the same length, to compare the run with.

    Raises:
        SdcError: matplotlib is missing, a file is damaged, or the runs cannot be compared.
    """
    sections = {
        "Summary": summary_section(run),
        "Metrics": metrics_section(run),
    }
    optimum = known_optimum([run, *others])
    if others:
        shares = None if optimum is None else [share_of(x, optimum) for x in (run, *others)]
        sections["Comparison"] = comparison_section([run, *others], shares)
    sections["Events"] = events_section(run)
    shown = shown_data_centers(run)
    if optimum is not None:
        sections["Known optimum"] = optimum_section(run, optimum, shown)
    if len(run.names) > 1 and run.metrics["steps_done"] > 1:
        sections["All data centers"] = fleet_section(run)
    for dc in shown:
        sections[f"Data center {run.names[dc.index]}"] = data_center_section(run, dc)
    sections["Why the hottest racks are hot"] = hot_racks_section(run, [dc.index for dc in shown])
    if run.metrics["steps_done"] > 1:
        sections["Inputs"] = inputs_section(run, shown)
    sections["Provenance"] = provenance_section(run)
    count = len(run.names)
    names = ", ".join(run.names) if count <= MAX_DC_COLUMNS else f"{count:,} data centers"
    title = f"Run of {names} under {run.metrics['controller']}"
    own_page = {f"Data center {name}" for name in run.names}
    return html_page(title, time_span_text(run), sections, own_page)


def summary_section(run: RunFolder) -> str:
    """Return the section with notices, key figures, hottest inlet, task counts and run settings."""
    metrics, names = run.metrics, run.names
    total, done, asked = metrics["total"], metrics["steps_done"], metrics["steps_asked"]
    notices = [f"Note: {note}" for note in first_texts(metrics["notes"])]
    if metrics["synthetic"]:
        notices.insert(
            0,
            "Inputs are SYNTHETIC, at least in part: these figures do not rest on measurements "
            "alone (see Provenance).",
        )
    if done < asked:
        notices.insert(
            0,
            f"The run was interrupted: {done:,} of {asked:,} steps were done, and all figures "
            "are of these.",
        )
    sites = list(dict.fromkeys(dc["location"] for dc in metrics["data_centers"]))
    length = count_text(run.hours / 24, "day")
    facts = {
        "data centers": f"{len(names):,}: {names_text(names)}",
        "sites": names_text(sites),
        "controller": metrics["controller"],
        "steps": f"{done:,} of {60 * metrics['step_h']:g} min, {length}",
        "seed": f"{metrics['seed']}",
        "precision of the kernels": metrics["precision"],
        "folder": run.path.resolve().name,
        "versions": ", ".join(f"{name} {value}" for name, value in metrics["versions"].items()),
        "fingerprint of configs, inputs and precision": metrics["fingerprint"],
    }
    return (
        "".join(map(notice, notices))
        + key_figures((k, f"{metric_text(total, key)} {unit}") for k, key, unit in KEY_METRICS)
        + bullets([_hottest_inlet_text(run), *_work_texts(run)])
        + html_table("What ran", None, list(facts.items()))
    )


def _hottest_inlet_text(run: RunFolder) -> str:
    """Return a text about place and time of the hottest inlet, and the hours above the limit."""
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
    """Return sentences about the tasks, the battery, and the losses of a run."""
    total = run.metrics["total"]
    text = {key: metric_text(total, key) for key in total if key != "hottest_dc"}
    arrived = total["arrived_tasks"]
    dropped_pct = 100 * total["dropped_tasks"] / arrived if arrived else 0.0
    (config,) = read_configs(run, [0])
    dropped = (
        f"{text['dropped_tasks']} of them at once because the queue was full ({dropped_pct:.3g} %),"
        if config.workload.model == "released"
        else f"{text['dropped_tasks']} dropped ({dropped_pct:.3g} %)"
    )
    texts = [
        f"Of {text['arrived_tasks']} tasks that arrived, {text['executed_tasks']} were done, "
        f"{dropped} and {text['lost_tasks']} lost with their servers; {text['queue_end_tasks']} "
        "were queued at the end.",
        f"The battery took {text['battery_charge_kwh']} kWh from the grid and gave "
        f"{text['battery_discharge_kwh']} kWh back."
        if total["battery_charge_kwh"] > 0
        else "The battery was not charged.",
    ]
    texts += [sentence.format(text[key]) for key, sentence in LOSSES.items() if total[key] > 0]
    if total["time_to_throttle_min"] is not None:
        minutes = text["time_to_throttle_min"]
        texts.append(f"The first rack throttled {minutes} min after an event began.")
    return texts


def events_section(run: RunFolder) -> str:
    """Return the table of failures, outages and heat waves of a run, ``MAX_ROWS`` at most."""
    events = [
        (dc, event)
        for dc, about in enumerate(run.metrics["data_centers"])
        for event in about["events"]
    ]
    if not events:
        return paragraph("None: the run met no failure, outage or heat wave.")
    rows = [
        (
            run.names[dc],
            str(event["kind"]).replace("_", " "),
            str(event.get("target", "")),
            (f"{100 * event['share']:.0f} % left" if "share" in event else "")
            + (f"{event['offset_k']:+g} K" if "offset_k" in event else ""),
            time_text(run, local_time(run, dc, event["start_step"])),
            format_number((event["end_step"] - event["start_step"]) * run.metrics["step_h"]),
            f"{event['start_step']} to {event['end_step'] - 1}",
        )
        for dc, event in events[:MAX_ROWS]
    ]
    caption = f"{count_text(len(events), 'event')} that the run met"
    if len(events) > MAX_ROWS:
        caption += f", the first {MAX_ROWS}; all are in {METRICS_FILE}"
    heads = ("data center", "event", "unit or rack in hall", "amount",
             "from (local standard time)", "duration (h)", "steps")  # fmt: skip
    return html_table(caption, heads, rows, numbers=(5, 6))


def hot_racks_section(run: RunFolder, dcs: Sequence[int]) -> str:
    """Return the section that explains the inlet temperatures of the hottest racks.

    Args:
        run: the run.
        dcs: indices of the data centers.

    Raises:
        SdcError: steps.parquet is damaged.
    """
    parts = [
        paragraph(
            "Each inlet is the sum of setpoint, supply air over its setpoint, and exhausts or the "
            "approach temperature of the config. Height and missing CRAC air are why a part of the "
            "exhausts reaches it."
        )
    ]
    for dc in dcs:
        try:
            inlets = hottest_inlets(run, dc)
        except ConfigError as error:
            parts.append(paragraph(f"{run.names[dc]}: {error}"))
            continue
        if inlets is None:
            text = (
                "the run has too many racks for the air of a step to be kept; sdc-taichi hall why"
            )
            parts.append(paragraph(f"{run.names[dc]}: {text} simulates it again."))
        else:
            parts.append(_hot_racks(run, dc, inlets))
    return "".join(parts)


def _hot_racks(run: RunFolder, dc: int, hottest: InletsAtStep) -> str:
    """Return the table of the hottest racks of a data center, and a text about the hottest rack.

    Args:
        run: the run.
        dc: index of the data center.
        hottest: inlets of the data center in the step of its hottest inlet.
    """
    hall = hottest.config.hall
    recirculates = hall.inlet_model == "recirculation"
    racks = [hottest.inlets.parts(rack) for rack in hottest.inlets.hottest(HOTTEST_RACKS)]
    heads = INLET_HEADS if recirculates else APPROACH_HEADS
    caption = (
        f"Hottest racks of {run.names[dc]} at the end of the step of its hottest inlet, "
        f"{hottest.hottest_c:.2f} °C on {time_text(run, local_time(run, dc, hottest.step))}"
    )
    texts = [f"{text[0].upper()}{text[1:]}." for text in state_texts(racks[0])]
    if recirculates:
        share = f"{100 * racks[0].exhaust_share:.1f} %"
        texts.insert(0, f"Of the intake of the hottest, {share} is exhaust air.")
    rows = [_rack_cells(parts, hall.racks_per_row, recirculates=recirculates) for parts in racks]
    numbers = range(1, len(heads) - recirculates)
    return html_table(caption, heads, rows, numbers=numbers) + bullets(texts)


def _rack_cells(parts: InletParts, racks_per_row: int, *, recirculates: bool) -> list[str]:
    """Return the cells of a rack in the table of the hottest racks.

    Args:
        parts: terms whose sum is the inlet temperature of the rack.
        racks_per_row: number of racks in a row of the hall.
        recirculates: True for columns ``INLET_HEADS``, False for ``APPROACH_HEADS``.
    """
    temperatures = [parts.inlet_c, parts.setpoint_c, parts.warming_k]
    if recirculates:
        others_k = float(parts.exhaust_k.sum()) - parts.own_exhaust_k + parts.lag_k
        temperatures += [others_k, parts.own_exhaust_k, parts.height_k, parts.shortfall_k]
    else:
        temperatures.append(parts.approach_k)
    cells = [rack_text(parts.rack, racks_per_row), *(f"{value:z.2f}" for value in temperatures)]
    if recirculates:
        sources = ", ".join(f"rack {rack} {k:.2f}" for rack, k in parts.sources(NAMED_SOURCES))
        cells.append(sources or DASH)
    return cells


def provenance_section(run: RunFolder) -> str:
    """Return the table of input sources, file hashes, and the data centers that use each source."""
    users: dict[tuple[str, str, str], list[str]] = {}
    for dc in run.metrics["data_centers"]:
        sources, hashes = dc["provenance"], dc["sha256"]
        for kind in {**sources, **hashes}:
            source = str(sources.get(kind, "file that the config names"))
            users.setdefault((kind, source, str(hashes.get(kind, ""))), []).append(dc["name"])
    rows = [
        (kind, source, digest or DASH, names_text(names))
        for (kind, source, digest), names in sorted(users.items())
    ]
    caption = f"Where the inputs come from; {count_text(len(rows), 'source')}"
    if len(rows) > MAX_ROWS:
        caption += f", the first {MAX_ROWS}, all are in {METRICS_FILE}"
    heads = ("input", "source", "SHA-256 of the file", "data centers")
    return html_table(caption, heads, rows[:MAX_ROWS])
