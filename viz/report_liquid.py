"""Section of a report about the liquid-cooled racks of a data center."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from sdc_taichi.config.liquid_schema import W_CLASS_LIMITS_C, WARMEST_CLASS, water_class
from sdc_taichi.run.folder_reader import RunFolder
from sdc_taichi.types import F64

from . import liquid_figures, rack_maps
from .liquid_loop import LOOP_FIELDS, junction_limits_c
from .plotting import format_number
from .report_html import DASH, Block, key_figures, paragraph, picture, time_text
from .report_pictures import ShownDataCenter

if TYPE_CHECKING:
    import pandas as pd


def liquid_section(run: RunFolder, dc: ShownDataCenter) -> list[Block]:
    """Return the section of liquid-cooled racks: key figures, classes of water and pictures.

    Args:
        run: the run.
        dc: the data center, which has liquid-cooled racks.
    """
    liquid, limits_c = dc.config.liquid, junction_limits_c(dc.config)
    assert liquid is not None
    name, steps, step_h = run.names[dc.index], dc.steps, float(run.metrics["step_h"])
    column = "junction_max_c" if limits_c else "liquid_heat_w"
    at = steps.iloc[int(steps[column].to_numpy().argmax())]
    value = at[column]
    most = f"hottest junction, {value:.1f} °C" if limits_c else f"most heat, {value / 1e3:,.1f} kW"
    shown = f"{most} on {time_text(run, at['time'].to_pydatetime())}"
    blocks = [
        key_figures(_figures(steps, step_h).items()),
        paragraph(_water_classes(steps["facility_supply_c"].to_numpy(), step_h)),
        picture(
            liquid_figures.loop_diagram({field: float(at[field]) for field in LOOP_FIELDS}, liquid),
            f"Diagram of the coolant loops of {name} at its {shown}: coolant from "
            f"{at['cdu_supply_c']:.1f} to {at['cdu_return_c']:.1f} °C, facility water from "
            f"{at['facility_supply_c']:.1f} to {at['facility_return_c']:.1f} °C.",
            f"The loops in the step of the {shown}.",
        ),
    ]
    if limits_c:
        blocks.append(
            picture(
                rack_maps.junction_map(dc.racks["junction_c"].to_numpy(), dc.config.hall, limits_c),
                f"Map of the racks of {name} by junction temperature at its {shown}.",
                f"Junction of each rack with cold plates in the step of the {shown}. Other racks "
                "are grey. Row 0 is on top.",
            )
        )
    if len(steps) < 2:
        return [*blocks, paragraph("A single step has no history.")]
    throttle_c = limits_c[0] if limits_c else None
    line = f"The dotted line is {throttle_c:g} °C, at which GPUs throttle. " if limits_c else ""
    history = picture(
        liquid_figures.loop_history(steps, throttle_c, name),
        f"Temperatures of coolant and facility water of {name} over the run, where the heat of its "
        "liquid-cooled racks went, and the power of pumps, fans and chillers.",
        f"The loops over the run. {line}Heat below zero left storage in chips and loops.",
    )
    return [*blocks, history]


def _figures(steps: pd.DataFrame, step_h: float) -> dict[str, str]:
    """Return the key figures of liquid cooling over a run, by label."""
    columns = ("it_w", "overhead_w", "it_fan_w", "reuse_w", "liquid_heat_w")
    it_kwh, overhead_kwh, fan_kwh, reuse_kwh, liquid_kwh = (
        float(steps[name].sum()) * step_h / 1e3 for name in columns
    )
    facility_kwh = it_kwh + overhead_kwh
    ratios = {
        "ERF, heat reused": (reuse_kwh, facility_kwh, ""),
        "ERE": (facility_kwh - reuse_kwh, it_kwh, ""),
        "TUE": (facility_kwh, it_kwh - fan_kwh, ""),
        "WUE": (float(steps["water_l"].sum()), it_kwh, " L/kWh"),
        "IT heat into coolant": (100 * liquid_kwh, it_kwh, " %"),
    }
    texts = {
        label: f"{format_number(part / whole)}{unit}" if whole > 0 else DASH
        for label, (part, whole, unit) in ratios.items()
    }
    throttled = format_number(float(steps["throttled_tasks"].sum()))
    return {**texts, "throttled work": f"{throttled} tasks"}


def _water_classes(facility_c: F64, step_h: float) -> str:
    """Return a sentence about the hours by ASHRAE class of the facility water.

    Args:
        facility_c: temperature of the facility water in each step, in C, (T,).
        step_h: length of a step, in h.
    """
    steps = Counter(map(water_class, facility_c.tolist()))
    hours = ", ".join(
        f"{name} for {format_number(steps[name] * step_h)} h"
        for name in (*W_CLASS_LIMITS_C, WARMEST_CLASS)
        if name in steps
    )
    return (
        f"The facility water had {facility_c.min():.1f} to {facility_c.max():.1f} °C: ASHRAE class "
        f"{hours}."
    )
