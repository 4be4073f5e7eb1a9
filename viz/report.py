"""One HTML file that tells what a run did: summary, tables, pictures.

The file holds everything it shows, styles and pictures as data, and no script; its content security
policy forbids whatever would reach for the network. Equal runs give equal bytes, as
docs/run-folder.md says. What grows with the number of data centers is limited: tables show the
extremes, pictures a few chosen data centers.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import SdcError
from sdc_taichi.run.folder_reader import RunFolder, is_number
from sdc_taichi.run.folder_writer import METRICS_FILE, REPORT_FILE

from .report_html import html_page, time_span_text
from .report_metrics import LABELS, MAX_DC_COLUMNS, comparison_section, metrics_section
from .report_optimum import known_optimum, optimum_section, shares_of
from .report_pictures import (
    data_center_section,
    fleet_section,
    inputs_section,
    shown_data_centers,
)
from .report_sections import (
    events_section,
    hot_racks_section,
    provenance_section,
    summary_section,
)

RATIOS = ("pue", "pue_with_losses", "partial_pue", "cue_kg_per_kwh", "wue_l_per_kwh")
"""Metrics that are undefined without IT energy."""


def write_report(run: RunFolder, others: Sequence[RunFolder] = (), out: Path | None = None) -> Path:
    """Write the report of a run.

    Args:
        run: the run, from ``read_run``.
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
    """The report of a run as text.

    Args:
        run: the run.
        others: runs to compare it with, of equal length.

    Raises:
        SdcError: matplotlib is missing, a file is damaged, or the runs cannot be compared.
    """
    for each in (run, *others):
        _check_metrics(each)
    sections = {
        "Summary": summary_section(run),
        "Metrics": metrics_section(run),
    }
    optimum = known_optimum([run, *others])
    if others:
        shares = None if optimum is None else shares_of([run, *others], optimum)
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


def _check_metrics(run: RunFolder) -> None:
    """Refuse a metrics.json that lacks a metric of the report, or has one out of range."""
    path, dcs = run.path / METRICS_FILE, run.metrics["data_centers"]
    # Rows, racks of a hall and servers of a rack are far fewer.
    places = dict.fromkeys(("hottest_row", "hottest_rack", "hottest_server"), 10**9)
    places["hottest_step"] = run.metrics["steps_done"] - 1
    all_metrics = {f"data_centers[{i}].metrics": dc["metrics"] for i, dc in enumerate(dcs)}
    for where, metrics in {"total": run.metrics["total"], **all_metrics}.items():
        undefined = {"time_to_throttle_min", *(RATIOS if metrics.get("it_kwh") == 0 else ())}
        for key in LABELS:
            value = metrics.get(key, "missing")
            if not is_number(value) and (value is not None or key not in undefined):
                raise SdcError(f"{path}: {where}.{key} is {value!r}; valid is a number")
        for key, most in places.items():
            value = metrics.get(key)
            if not (is_number(value) and isinstance(value, int) and 0 <= value <= most):
                raise SdcError(
                    f"{path}: {where}.{key} is {value!r}; valid is a whole number, 0..{most}"
                )
    hottest = run.metrics["total"].get("hottest_dc")
    if hottest not in run.names:
        raise SdcError(f"{path}: total.hottest_dc {hottest!r}: no such data center")
