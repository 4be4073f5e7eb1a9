"""Figures of the coolant loops of a data center: history of a run, and diagram of a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from .liquid_loop import BOXES, LOOP_FIELDS, PLACES, SIZE, has_device, loop_pipes, loop_texts
from .plotting import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    add_title,
    check_steps,
    draw_steps,
    format_time_axis,
    new_figure,
    repeat_last,
    scale_thousands,
    short_name,
    step_edges,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sdc_taichi.config.liquid_schema import LiquidConfig

TEMPERATURES = (
    ("junction_max_c", RED, "hottest junction"),
    ("cdu_return_c", ORANGE, "coolant return"),
    ("cdu_supply_c", PINK, "coolant supply"),
    ("facility_return_c", GREEN, "facility return"),
    ("facility_supply_c", BLUE, "facility supply"),
    ("outdoor_c", GREY, "outdoor"),
)
"""Lines of the temperatures of the loops: column, colour, label."""
HEAT = (
    ("liquid_air_w", GREY, "into the hall's air"),
    ("reuse_w", GREEN, "delivered as heat"),
    ("liquid_rejected_w", SKY, "rejected outdoors"),
    ("liquid_to_plant_w", ORANGE, "to the plant of the CRAC units"),
    ("liquid_stored_w", PINK, "stored"),
)
"""Parts, in W, into which the power of liquid-cooled racks and their loops divides: column, colour,
label."""
POWER = (
    ("cdu_pump_w", BLUE, "CDU pumps"),
    ("facility_pump_w", SKY, "facility pumps"),
    ("cooler_fan_w", GREEN, "cooler fans"),
    ("trim_chiller_w", ORANGE, "trim chiller"),
    ("heat_pump_w", RED, "heat pump"),
)
"""Power of the devices of the loops: column, colour, label."""
COLUMNS = tuple(
    dict.fromkeys([*(name for name, *_ in (*TEMPERATURES, *HEAT, *POWER)), *LOOP_FIELDS])
)
"""Columns of steps.parquet that the figures read besides ``time``."""
_PIPE_COLOURS = {"hot": RED, "cold": BLUE, "heat": ORANGE}


def loop_history(steps: pd.DataFrame, throttle_c: float | None, title: str = "") -> Figure:
    """Draw temperatures of the loops, where the heat goes, and power of the devices over a run.

    Args:
        steps: steps of the data center.
        throttle_c: junction temperature at which GPUs throttle, in C; None without cold plates.
        title: text above the figure, such as the name of the data center.

    Raises:
        SdcError: matplotlib or a column is missing.
    """
    figure = new_figure(12.0, 9.5)
    steps = check_steps(steps, ("time", *COLUMNS))
    panels = figure.subplots(3, 1, sharex=True, height_ratios=[4, 3, 2.5])
    for name, colour, label in TEMPERATURES:
        if throttle_c is not None or name != "junction_max_c":
            draw_steps(panels[0], steps, steps[name], color=colour, label=label)
    if throttle_c is not None:
        panels[0].axhline(throttle_c, color=RED, linewidth=0.8, linestyle=":")
    panels[0].set_ylabel("temperature (°C)")
    for axes, parts, label in ((panels[1], HEAT, "heat"), (panels[2], POWER, "power")):
        _draw_stack(axes, steps, parts, label)
    for axes in panels:
        style_axes_with_legend(axes)
    format_time_axis(panels[-1])
    add_title(figure, short_name(title))
    return figure


def _draw_stack(
    axes: Axes, steps: pd.DataFrame, parts: tuple[tuple[str, str, str], ...], label: str
) -> None:
    """Draw parts of a sum above each other; parts that are always zero are omitted."""
    edges = step_edges(steps)
    names = [name for name, *_ in parts]
    # Stored heat may be negative; positive parts are above zero, and negative ones below it.
    values, unit = scale_thousands(steps[names].to_numpy().T / 1e3, "kW", "MW")
    above, below = np.zeros(len(steps)), np.zeros(len(steps))
    for part, (_, colour, text) in zip(values, parts, strict=True):
        for sign, base in ((1.0, above), (-1.0, below)):
            size = np.maximum(sign * part, 0.0)
            if not size.any():
                continue
            axes.fill_between(edges, repeat_last(sign * base), repeat_last(sign * (base + size)),
                              step="post", color=colour, linewidth=0,
                              label=text if sign > 0 else None)  # fmt: skip
            base += size
    axes.set_ylabel(f"{label} ({unit})")


def loop_diagram(values: Mapping[str, float], liquid: LiquidConfig, title: str = "") -> Figure:
    """Draw the loops with their temperatures, flows and heat in one step.

    Args:
        values: value of each of ``LOOP_FIELDS``, in its unit.
        liquid: config of the loops.
        title: text above the figure, such as name and time.

    Raises:
        SdcError: matplotlib is missing.
    """
    figure = new_figure(11.0, 11.0 * SIZE[1] / SIZE[0] + 0.3)
    from matplotlib.patches import Rectangle

    axes = figure.subplots()
    axes.set(xlim=(0, SIZE[0]), ylim=(SIZE[1], 0))
    axes.set_axis_off()
    for name, (_, left, top, right, bottom) in BOXES.items():
        if has_device(liquid, name):
            rectangle = Rectangle((left, top), right - left, bottom - top, linewidth=1.4)
            rectangle.set(facecolor="white", edgecolor="black")
            axes.add_patch(rectangle)
    for kind, pipes in loop_pipes(liquid).items():
        arrow = {"arrowstyle": "-|>", "shrinkA": 0, "shrinkB": 0, "linewidth": 2.4}
        for begin, end in pipes:
            axes.annotate("", end, begin, arrowprops=arrow | {"color": _PIPE_COLOURS[kind]})
    for place, text in loop_texts(values, liquid).items():
        axes.text(*PLACES[place], text, ha="center", va="center", fontsize=10)
    add_title(figure, short_name(title))
    return figure
