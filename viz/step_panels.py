"""Panels of a run of one data center over time: temperatures, power, carbon, queue and battery."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .plotting import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    draw_steps,
    repeat_last,
    step_edges,
    step_hours,
    style_axes,
    style_axes_with_legend,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

POWERS = {
    "it_w": ("IT", BLUE),
    "chiller_w": ("chiller", ORANGE),
    "tower_fan_w": ("tower fan", SKY),
    "chilled_pump_w": ("chilled-water pump", GREEN),
    "condenser_pump_w": ("condenser pump", PINK),
    "crac_fan_w": ("CRAC fan", RED),
}
"""Powers that are stacked: from the column to its name and colour."""

COLUMNS = (
    "time",
    "outdoor_c",
    "wet_bulb_c",
    "setpoint_c",
    *POWERS,
    "overhead_w",
    "ci_g_per_kwh",
    "carbon_g",
    "queue_tasks",
    "soc",
)
"""Columns of steps.parquet that the panels read."""


def draw_temperatures(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw outdoor temperature, wet bulb and setpoint."""
    for name, colour, label in (
        ("outdoor_c", RED, "outdoor"),
        ("wet_bulb_c", SKY, "wet bulb"),
        ("setpoint_c", "black", "setpoint"),
    ):
        draw_steps(axes, steps, steps[name], color=colour, linewidth=1.2, label=label)
    axes.set_ylabel("temperature (°C)")
    style_axes_with_legend(axes)


def draw_power(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw power by device, stacked."""
    powers = [steps[column] / 1e3 for column in POWERS]
    axes.stackplot(
        step_edges(steps),
        [repeat_last(power) for power in powers],
        labels=[name for name, _ in POWERS.values()],
        colors=[colour for _, colour in POWERS.values()],
        linewidth=0,
        step="post",
    )
    counted = (steps["it_w"] + steps["overhead_w"]) / 1e3
    # Presets may leave devices out of the HVAC total.
    if not np.allclose(counted, sum(powers), rtol=1e-6):
        draw_steps(axes, steps, counted, color="black", linewidth=1.2, label="counted in total")
    axes.set_ylabel("power (kW)")
    axes.set_ylim(bottom=0)
    style_axes_with_legend(axes)


def draw_carbon(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw carbon intensity, and emissions behind it."""
    emitted = axes.twinx()
    kg_per_h = steps["carbon_g"] / 1e3 / step_hours(steps)
    emitted.fill_between(step_edges(steps), repeat_last(kg_per_h), color=GREY, alpha=0.35,
                         linewidth=0, step="post")  # fmt: skip
    emitted.set_ylabel("emitted (kg CO₂e/h)", color=GREY)
    emitted.set_ylim(bottom=0)
    draw_steps(axes, steps, steps["ci_g_per_kwh"], color=RED)
    axes.set_ylabel("carbon intensity\n(g CO₂e/kWh)", color=RED)
    _put_in_front(axes, emitted)


def draw_storage(axes: Axes, steps: pd.DataFrame) -> None:
    """Draw queue and battery charge at the ends of the steps, for which they stand."""
    ends = step_edges(steps)[1:]
    charge = axes.twinx()
    charge.fill_between(ends, 100 * steps["soc"], color=GREEN, alpha=0.3, linewidth=0)
    charge.set_ylabel("battery charge (%)", color=GREEN)
    charge.set_ylim(0, 100)
    axes.plot(ends, steps["queue_tasks"], color=PINK, linewidth=1.4)
    axes.set_ylabel("queue (tasks)", color=PINK)
    axes.set_ylim(0, 1.05 * max(1.0, steps["queue_tasks"].max()))
    _put_in_front(axes, charge)


def _put_in_front(axes: Axes, behind: Axes) -> None:
    """Draw axes in front of their twin."""
    axes.set_zorder(behind.get_zorder() + 1)
    axes.patch.set_visible(False)
    behind.spines[:].set_visible(False)
    style_axes(axes)
