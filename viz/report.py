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
from sdc_taichi.run.comparison import Comparison
from sdc_taichi.run.folder_reader import RunFolder, read_configs, read_flows
from sdc_taichi.run.folder_writer import METRICS_FILE, REPORT_FILE
from sdc_taichi.run.inlets_of_run import InletsAtStep, hottest_inlets
from sdc_taichi.sim.inlet_parts import HOTTEST_RACKS, InletParts, rack_text, state_texts

from .plotting import format_number
from .report_comparison import MAX_MAPPED_DCS, comparison_section
from .report_flows import flows_section
from .report_html import (
    DASH,
    MAX_ROWS,
    Block,
    bullets,
    count_text,
    first_texts,
    html_page,
    key_figures,
    local_time,
    metric_text,
    names_text,
    notice,
    paragraph,
    table,
    time_span_text,
    time_text,
)
from .report_liquid import liquid_section
from .report_metrics import MAX_DC_COLUMNS, has_shifted_work, metrics_section
from .report_pictures import (
    MAX_DETAILED_DCS,
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
    ("electricity bill, currency of the tariff", "cost", ""),
    ("carbon footprint", "cfp_kg", "kg CO₂e"),
    ("make-up water", "water_l", "L"),
    ("highest power from the grid", "peak_kw", "kW"),
    ("hottest inlet", "hottest_inlet_c", "°C"),
)
"""Metrics at the top of the summary: label, name in metrics.json, unit."""
NEUTRAL = "idle"
"""Controller that keeps the configured setpoint and shifts neither work nor energy."""
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


def write_report(
    run: RunFolder, comparison: Comparison | None = None, out: Path | None = None
) -> Path:
    """Write the report of a run, or of several runs of one hall.

    Args:
        run: the run, from ``read_run``.
        comparison: the run beside others, of which it is the first, from ``compare_runs``; None
            reports on the run alone.
        out: path of the file; None is ``report.html`` in the run's folder, which is replaced if it
            exists.

    Returns:
        Path of the written file.

    Raises:
        SdcError: matplotlib is missing, steps.parquet is damaged, or the file cannot be written.
    """
    target = run.path / REPORT_FILE if out is None else out
    # The file is opened first: an unwritable path must fail before the long computation.
    with atomic_write(target) as file:
        file.write(report_html(run, comparison).encode("utf-8", "replace"))
    return target


def report_html(run: RunFolder, comparison: Comparison | None = None) -> str:
    """Return the report of a run, or of several runs of one hall, as an HTML page.

    Args:
        run: the run.
        comparison: the run beside others, of which it is the first; None for the run alone.

    Raises:
        SdcError: matplotlib is missing, or a file is damaged.
    """
    runs = {"": run} if comparison is None else comparison.runs
    optimum = known_optimum(list(runs.values()))
    shown = shown_data_centers(run)
    sections: dict[str, list[Block]] = {}
    of = ""
    if comparison is not None:
        shares = None if optimum is None else [share_of(each, optimum) for each in runs.values()]
        sections["Comparison"] = comparison_section(comparison, shown, shares)
        of = f" of {comparison.names[0]}"
        shown = shown[:MAX_MAPPED_DCS]
    detailed = comparison is None and len(shown) <= MAX_DETAILED_DCS
    sections[f"Summary{of}"] = summary_section(run)
    sections[f"Metrics{of}"] = metrics_section(run)
    sections["Events"] = events_section(run)
    if optimum is not None:
        sections["Known optimum"] = optimum_section(run, optimum, shown)
    if len(run.names) > 1 and run.metrics["steps_done"] > 1:
        sections["All data centers"] = fleet_section(run)
    if (flows := read_flows(run)) is not None:
        sections["Work sent between sites"] = flows_section(run, flows)
    for dc in shown:
        heading = f"Data center {run.names[dc.index]}{of}"
        sections[heading] = data_center_section(
            run, dc, detailed=detailed, has_maps=comparison is None
        )
        if dc.config.liquid is not None:
            name = run.names[dc.index]
            sections[f"Liquid cooling of {name}{of}"] = liquid_section(run, dc)
    sections["Why the hottest racks are hot"] = hot_racks_section(run, [dc.index for dc in shown])
    inputs = input_notes(run)
    if run.metrics["steps_done"] > 1:
        inputs += inputs_section(run, shown)
    sections["Inputs"] = inputs
    sections["Provenance"] = provenance_section(run)
    own_page = {heading for heading in sections if heading.startswith("Data center ")}
    return html_page(page_title(run, comparison), _lead(run), sections, own_page)


def page_title(run: RunFolder, comparison: Comparison | None = None) -> str:
    """Return the title of a report: the halls, and the variants that are compared."""
    count = len(run.names)
    halls = ", ".join(run.names) if count <= MAX_DC_COLUMNS else f"{count:,} data centers"
    if comparison is None:
        return halls
    first, *variants = comparison.names
    several = variants[:-1]
    listed = f"{', '.join(several)} and {variants[-1]}" if several else variants[0]
    return f"{halls}: {listed} against {first}"


def _lead(run: RunFolder) -> str:
    """Return the text below the title: description, time span, controller, kind of inputs."""
    (config,) = read_configs(run, [0])
    parts = [config.description.rstrip(".")] if len(run.names) == 1 and config.description else []
    parts.append(time_span_text(run))
    if run.metrics["controller"] != NEUTRAL:
        parts.append(f"controlled by {run.metrics['controller']}")
    if run.metrics["synthetic"]:
        parts.append("synthetic inputs (see Inputs)")
    return "; ".join(parts)


def summary_section(run: RunFolder) -> list[Block]:
    """Return the section with key figures, hottest inlet, and what happened to the work."""
    metrics = run.metrics
    total, done, asked = metrics["total"], metrics["steps_done"], metrics["steps_asked"]
    blocks = []
    if done < asked:
        blocks.append(
            notice(
                f"The run was interrupted: {done:,} of {asked:,} steps were done, and all figures "
                "are of these."
            )
        )
    return [
        *blocks,
        key_figures((k, f"{metric_text(total, key)} {unit}") for k, key, unit in KEY_METRICS),
        bullets([_hottest_inlet_text(run), *_work_texts(run)]),
    ]


def input_notes(run: RunFolder) -> list[Block]:
    """Return what a reader must know of the inputs: whether they are synthetic, and repairs."""
    metrics = run.metrics
    notices = []
    if metrics["synthetic"]:
        notices.append(
            "Inputs are SYNTHETIC, at least in part: these figures do not rest on measurements "
            "alone (see Provenance)."
        )
    notices += [f"Note: {note}" for note in first_texts(metrics["notes"])]
    return [*map(notice, notices)]


def _facts(run: RunFolder) -> dict[str, str]:
    """Return with what a run can be repeated."""
    metrics, names = run.metrics, run.names
    sites = list(dict.fromkeys(dc["location"] for dc in metrics["data_centers"]))
    length = count_text(run.hours / 24, "day")
    return {
        "data centers": f"{len(names):,}: {names_text(names)}",
        "sites": names_text(sites),
        "controller": metrics["controller"],
        "steps": f"{metrics['steps_done']:,} of {60 * metrics['step_h']:g} min, {length}",
        "seed": f"{metrics['seed']}",
        "precision of the kernels": metrics["precision"],
        "folder": run.path.resolve().name,
        "versions": ", ".join(f"{name} {value}" for name, value in metrics["versions"].items()),
        "fingerprint of configs, inputs and precision": metrics["fingerprint"],
    }


def _hottest_inlet_text(run: RunFolder) -> str:
    """Return a text about place and time of the hottest inlet, and the hours above the limit."""
    total = run.metrics["total"]
    where = total["hottest_dc"]
    dc = run.names.index(where)
    moment = time_text(run, local_time(run, dc, total["hottest_step"]))
    hours = run.metrics["data_centers"][dc]["metrics"]["inlet_above_27_h"]
    row, rack = total["hottest_row"], total["hottest_rack"]
    recommended = f"{RECOMMENDED_C[1]:g} °C, the highest recommended inlet"
    above = (
        f"An inlet there was above {recommended}, for {format_number(hours)} h, "
        f"{100 * hours / run.hours:.3g} % of the time."
        if hours
        else f"No inlet there was above {recommended}."
    )
    return (
        f"The hottest inlet was {metric_text(total, 'hottest_inlet_c')} °C in {where}, row {row}, "
        f"rack {rack}, server {total['hottest_server']} from the floor, on {moment}. {above}"
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
        "were queued at the end."
        if has_shifted_work(run)
        else "All work was done when it arrived."
    ]
    if total["battery_discharge_kwh"] > 0:
        texts.append(
            f"The battery took {text['battery_charge_kwh']} kWh from the grid and gave "
            f"{text['battery_discharge_kwh']} kWh back."
        )
    texts += [sentence.format(text[key]) for key, sentence in LOSSES.items() if total[key] > 0]
    if total["time_to_throttle_min"] is not None:
        minutes = text["time_to_throttle_min"]
        texts.append(f"The first rack throttled {minutes} min after an event began.")
    return texts


def events_section(run: RunFolder) -> list[Block]:
    """Return the table of failures, outages and heat waves of a run, ``MAX_ROWS`` at most."""
    events = [
        (dc, event)
        for dc, about in enumerate(run.metrics["data_centers"])
        for event in about["events"]
    ]
    if not events:
        return [paragraph("None: the run met no failure, outage or heat wave.")]
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
    return [table(caption, heads, rows, numbers=(5, 6))]


def hot_racks_section(run: RunFolder, dcs: Sequence[int]) -> list[Block]:
    """Return the section that explains the inlet temperatures of the hottest racks.

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
            parts += _hot_racks(run, dc, inlets)
    return parts


def _hot_racks(run: RunFolder, dc: int, hottest: InletsAtStep) -> list[Block]:
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
    return [table(caption, heads, rows, numbers=numbers), bullets(texts)]


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


def provenance_section(run: RunFolder) -> list[Block]:
    """Return the tables of input sources with their files' hashes, and of the run's settings."""
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
    return [
        table(caption, heads, rows[:MAX_ROWS]),
        table("What ran", None, list(_facts(run).items())),
    ]
