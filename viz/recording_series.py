"""Series of a recording: the recorded quantities of ``StepResult``, and their plots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import rerun as rr

from sdc_taichi.types import F64, QUANTITIES

# Colours that readers with colour vision deficiency can distinguish (Okabe and Ito, Color Universal
# Design, 2008). Grey replaces their black, because the viewer has a dark background.
BLUE, ORANGE, GREEN, RED = 0x0072B2FF, 0xE69F00FF, 0x009E73FF, 0xD55E00FF
PINK, SKY, YELLOW, GREY = 0xCC79A7FF, 0x56B4E9FF, 0xF0E442FF, 0x999999FF
PALETTE = (BLUE, ORANGE, GREEN, RED, PINK, SKY, YELLOW, GREY)
"""Colours of lines without a fixed colour, in their order of use, as 0xRRGGBBAA."""

AGE_EDGES_H = (0.0, 6.0, 12.0, 24.0)
"""Lower edges of the age bands of queued tasks, in h; the last band has no upper edge."""


@dataclass(frozen=True, slots=True)
class Cadence:
    """How often heat maps and 3D halls are recorded, and how finely."""

    map_every_steps: int
    """Steps between two heat maps."""
    map_every_steps_in_events: int
    """Steps between two heat maps while a failure or weather event lasts."""
    hall_every_steps: int
    """Steps between two frames of the 3D hall."""
    hall_every_steps_in_events: int
    """Steps between two frames of the 3D hall while a failure or weather event lasts."""
    levels: tuple[int, ...]
    """Number of levels per rack of the 3D hall, for each data center in focus."""
    has_servers: bool
    """True if each level shows the hottest inlet and the hottest outlet of its servers.

    Otherwise a rack has one level, which shows its hottest inlet and its mean outlet.
    """


class Plot(NamedTuple):
    """A plot whose lines have the same unit and are one entity of the recording."""

    title: str
    """Title of the plot."""
    unit: str
    """Unit of the lines, which title and legend show in brackets."""
    lines: tuple[tuple[str, str, int], ...]
    """Name in the legend, quantity of ``StepResult`` and colour (0xRRGGBBAA) of each line."""
    limits: tuple[float, float] | None = None
    """Ends of the vertical axis; None scales the axis to the values."""


PLOTS: dict[str, Plot] = {
    "temperature_c": Plot(
        "air temperature",
        "C",
        (
            ("setpoint", "setpoint_c", BLUE),
            ("supply", "supply_c", SKY),
            ("inlet mean", "inlet_mean_c", GREEN),
            ("inlet hottest", "inlet_max_c", ORANGE),
            ("outlet mean", "outlet_mean_c", PINK),
            ("return", "return_c", RED),
        ),
    ),
    "power_kw": Plot(
        "power",
        "kW",
        (
            ("IT", "it_w", BLUE),
            ("HVAC", "hvac_w", SKY),
            ("UPS loss", "ups_loss_w", PINK),
            ("distribution loss", "distribution_loss_w", GREY),
            ("grid", "grid_kwh", ORANGE),
            ("battery charge", "charge_kwh", GREEN),
            ("battery discharge", "discharge_kwh", RED),
        ),
    ),
    "carbon_intensity": Plot(
        "grid carbon intensity", "g/kWh", (("grid carbon intensity", "ci_g_per_kwh", RED),)
    ),
    "carbon_kg": Plot("carbon", "kg/step", (("carbon", "carbon_g", RED),)),
    "price": Plot("price of electricity", "currency/kWh", (("price", "price_per_kwh", GREEN),)),
    "energy_cost": Plot(
        "cost of energy", "currency/step", (("cost of energy", "energy_cost", GREEN),)
    ),
    "battery": Plot("battery state of charge", "-", (("state of charge", "soc", GREEN),), (0, 1)),
    "hvac_kw": Plot(
        "HVAC by device",
        "kW",
        (
            ("chiller", "chiller_w", BLUE),
            ("tower fan", "tower_fan_w", SKY),
            ("chilled-water pump", "chilled_pump_w", GREEN),
            ("condenser pump", "condenser_pump_w", PINK),
            ("CRAC fan", "crac_fan_w", ORANGE),
        ),
    ),
    "pue": Plot("PUE", "-", (("PUE", "pue", BLUE),)),
    "water_l": Plot(
        "water",
        "L/step",
        (
            ("make-up", "water_l", BLUE),
            ("evaporation", "evaporation_l", SKY),
            ("blowdown", "blowdown_l", ORANGE),
            ("drift", "drift_l", GREY),
        ),
    ),
    "weather_c": Plot(
        "weather",
        "C",
        (("outdoor dry bulb", "outdoor_c", ORANGE), ("outdoor wet bulb", "wet_bulb_c", SKY)),
    ),
    "queue_age_h": Plot(
        "age of the queue", "h", (("oldest", "oldest_age_h", RED), ("mean", "mean_age_h", BLUE))
    ),
    "work_tasks": Plot(
        "work",
        "tasks/step",
        (
            ("arrived", "arrived_tasks", GREY),
            ("executed", "executed_tasks", BLUE),
            ("overdue", "overdue_tasks", ORANGE),
            ("dropped", "dropped_tasks", RED),
            ("lost", "lost_tasks", PINK),
        ),
    ),
    "load": Plot(
        "load",
        "share of capacity",
        (("demand", "demand", GREY), ("utilisation", "utilisation", BLUE)),
    ),
    "commands": Plot(
        "commands",
        "-",
        (
            ("load, -1 defer to 1 drain", "load_command", PINK),
            ("cooling, setpoint steps", "cooling_command", BLUE),
            ("battery, -1 discharge to 1 charge", "battery_command", GREEN),
        ),
    ),
}
"""Plots of a data center in focus, keyed by entity.

Plots of the queue, CRAC units and rewards are not included.
"""

MAX_DEVICE_LINES = 24
"""Largest number of CRAC units or CDUs with a line each; for more, plots show minimum, mean and
maximum."""
QUEUE_ENTITY = "queue_tasks"
"""Entity of the plot of queued tasks by age."""
QUEUE_COLOURS = (SKY, BLUE, ORANGE, RED)
"""Colours of the age bands of queued tasks, youngest first, as 0xRRGGBBAA."""
QUEUE_NAMES = tuple(
    f"{low:g} h and older [tasks]" if high is None else f"{low:g} to {high:g} h [tasks]"
    for low, high in zip(AGE_EDGES_H, (*AGE_EDGES_H[1:], None), strict=True)
)
"""Names of the age bands of queued tasks in the legend, youngest first."""
REWARDS_ENTITY = "rewards"
"""Entity of the plot of reward terms."""

COMMAND_STATES: dict[str, tuple[str, tuple[str, str, str]]] = {
    "load": ("load_command", ("defer", "neutral", "drain")),
    "cooling": ("cooling_command", ("colder", "hold", "warmer")),
    "battery": ("battery_command", ("discharge", "idle", "charge")),
}
"""Commands that a recording shows as states, keyed by entity.

Each has a field of ``StepResult``, and names of its values below zero, at zero and above zero.
"""
STATE_COLOURS = (BLUE, GREY, ORANGE)
"""Colours of a command below, at and above zero, as 0xRRGGBBAA."""

EVENT_FIELDS = (
    "hottest_rack",
    "hottest_server",
    "unmet_w",
    "unserved_kwh",
    "grid_overload_kwh",
)
"""Fields of ``StepResult`` that only the event log needs."""

FLEET_SUMS = (
    "it_w",
    "overhead_w",
    "carbon_g",
    "water_l",
    "queue_tasks",
    "dropped_tasks",
    "lost_tasks",
    "throttled_racks",
    "tripped_racks",
)
"""Fields of ``StepResult`` whose sums over all data centers of the fleet are recorded."""

FIELDS: tuple[str, ...] = tuple(
    dict.fromkeys(
        [
            *FLEET_SUMS,
            *(field for plot in PLOTS.values() for _, field, _ in plot.lines if field != "pue"),
            *(command for command, _ in COMMAND_STATES.values()),
            *EVENT_FIELDS,
        ]
    )
)
"""Fields of ``StepResult`` that are recorded in every step, ``FLEET_SUMS`` first."""
FIELD_ROWS = {field: row for row, field in enumerate((*FIELDS, "pue"))}
"""Index of each quantity in ``FIELDS``, and after these the index of the PUE.

The PUE is computed from the recorded powers.
"""


class FleetPlot(NamedTuple):
    """A plot with one line: a quantity of the whole fleet."""

    title: str
    """Title of the plot, with the unit in brackets."""
    colour: int
    """Colour of the line as 0xRRGGBBAA."""
    fields: tuple[str, ...]
    """Names of the entries of ``fleet_series`` whose sum the line shows."""
    factor: float = 1.0
    """Factor that converts the unit of the fields to the unit of the line."""


FLEET_PLOTS: dict[str, FleetPlot] = {
    "pue": FleetPlot("PUE of all [-]", BLUE, ("pue",)),
    "hottest_inlet_c": FleetPlot("hottest inlet of all [C]", ORANGE, ("inlet_max_c",)),
    "it_kw": FleetPlot("IT power of all [kW]", BLUE, ("it_w",), 1e-3),
    "carbon_kg": FleetPlot("carbon of all [kg/step]", RED, ("carbon_g",), 1e-3),
    "water_l": FleetPlot("water of all [L/step]", SKY, ("water_l",)),
    "queue_tasks": FleetPlot("queued in all [tasks]", PINK, ("queue_tasks",)),
    "lost_tasks": FleetPlot(
        "dropped or lost in all [tasks/step]", RED, ("dropped_tasks", "lost_tasks")
    ),
    "protected_racks": FleetPlot(
        "racks throttled or off [-]", RED, ("throttled_racks", "tripped_racks")
    ),
}
"""Plots of the whole fleet, keyed by entity."""


def _pue(it_w: F64, overhead_w: F64) -> F64:
    """Return the PUE, (IT + overhead) / IT; nan without IT power, so that its plot has a gap."""
    has_it = it_w > 0
    return np.where(has_it, 1.0 + overhead_w / np.where(has_it, it_w, 1.0), np.nan)


def append_pue(values: F64) -> F64:
    """Append the PUE to values of the F quantities ``FIELDS``, (T, F, n) to (T, F + 1, n)."""
    pue = _pue(values[:, FIELD_ROWS["it_w"]], values[:, FIELD_ROWS["overhead_w"]])
    return np.concatenate([values, pue[:, None]], axis=1)


def fleet_series(sums: F64, inlet_max_c: F64) -> dict[str, F64]:
    """Return the series of the whole fleet by name, (T,) each: sums, hottest inlet and PUE.

    Args:
        sums: sums of the S fields ``FLEET_SUMS`` over all data centers, (T, S).
        inlet_max_c: hottest inlet of all data centers, in C, (T,).
    """
    series = dict(zip(FLEET_SUMS, sums.T, strict=True))
    return {
        **series,
        "inlet_max_c": inlet_max_c,
        "pue": _pue(series["it_w"], series["overhead_w"]),
    }


def line_factors(plot: Plot, step_h: float) -> F64:
    """Return factors that convert the quantities of a plot to its unit, one per line, (lines,).

    Args:
        plot: the plot.
        step_h: length of a step, in h, by which energies are divided to get powers.
    """
    to_unit = {("W", "kW"): 1e-3, ("kWh", "kW"): 1.0 / step_h, ("g CO2e", "kg/step"): 1e-3}
    units = ["1" if field == "pue" else QUANTITIES[field].unit for _, field, _ in plot.lines]
    return np.array([to_unit.get((unit, plot.unit), 1.0) for unit in units])


def series_lines(names: Sequence[str], colours: Sequence[int]) -> rr.SeriesLines:
    """Return Rerun's description of the names and colours of the lines of a plot."""
    # Colours are an array, because Rerun reads a list of three or four numbers as one colour.
    return rr.SeriesLines(names=list(names), colors=np.array(colours, np.uint32))


def device_lines(count: int, device: str, quantity: str) -> tuple[list[str], list[int]]:
    """Return names and colours of the lines of a quantity of CRAC units or CDUs.

    There is one line per device, or lines for minimum, mean and maximum over many devices.

    Args:
        count: number of devices.
        device: name of a device, such as ``unit``.
        quantity: name of the quantity, with its unit in brackets.
    """
    if count > MAX_DEVICE_LINES:
        return [f"{which} {quantity}" for which in ("lowest", "mean", "highest")], list(PALETTE[:3])
    others = [colour for colour in PALETTE if colour != RED]
    colours = [others[number % len(others)] for number in range(count)]
    return [f"{device} {number} {quantity}" for number in range(count)], colours


def low_mean_high(values: F64) -> F64:
    """Return minimum, mean and maximum over many devices in T steps, (T, n) to (T, 3).

    Values of at most ``MAX_DEVICE_LINES`` devices are returned unchanged.
    """
    if values.shape[1] <= MAX_DEVICE_LINES:
        return values
    return np.stack([values.min(axis=1), values.mean(axis=1), values.max(axis=1)], axis=1)
