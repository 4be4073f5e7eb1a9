"""Plots of a recording: which fields of ``StepResult`` they show, with names and colours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64

# Colours of Okabe and Ito, which stay apart for people who are colour-blind (Okabe, Ito: Color
# Universal Design, 2008). Black is a grey here, since the viewer's ground is dark.
BLUE, ORANGE, GREEN, RED = 0x0072B2FF, 0xE69F00FF, 0x009E73FF, 0xD55E00FF
PINK, SKY, YELLOW, GREY = 0xCC79A7FF, 0x56B4E9FF, 0xF0E442FF, 0x999999FF
PALETTE = (BLUE, ORANGE, GREEN, RED, PINK, SKY, YELLOW, GREY)
"""Colours in the order in which lines without a colour of their own take them, as 0xRRGGBBAA."""

AGE_EDGES_H = (0.0, 6.0, 12.0, 24.0)
"""Lower edges of the age bands of the queue, in h; the last band has no upper edge."""


@dataclass(frozen=True, slots=True)
class Cadence:
    """How often heat maps and 3D halls are recorded, and how finely."""

    map_every_steps: int
    """Steps between two heat maps."""
    hall_every_steps: int
    """Steps between two frames of the 3D hall."""
    hall_every_steps_in_events: int
    """Steps between two frames of the 3D hall while a failure or weather event lasts."""
    levels: tuple[int, ...]
    """Levels per rack of the 3D hall of each data center in focus."""
    has_servers: bool
    """Whether levels show servers; else a rack shows its hottest inlet and its mean outlet."""
    block_steps: int
    """Number of steps in a block."""


class PlotLine(NamedTuple):
    """One line of a plot."""

    name: str
    """Name in the legend, with the unit in brackets."""
    field: str
    """Field of ``StepResult`` that the line shows."""
    colour: int
    """Colour as 0xRRGGBBAA."""
    factor: float = 1.0
    """Unit of the field over the unit of the line; the field is multiplied by it."""
    per_hour: bool = False
    """Whether to divide by the length of the step in h, which turns energies into powers."""


class Plot(NamedTuple):
    """Lines of one unit, which are one entity of the recording."""

    title: str
    """Title of the plot, with the unit in brackets."""
    lines: tuple[PlotLine, ...]
    """Lines from first to last in the legend."""
    limits: tuple[float, float] | None = None
    """Ends of the vertical axis, in the unit of the lines; None follows the values."""


PLOTS: dict[str, Plot] = {
    "temperature_c": Plot(
        "air temperature [C]",
        (
            PlotLine("setpoint [C]", "setpoint_c", BLUE),
            PlotLine("supply [C]", "supply_c", SKY),
            PlotLine("inlet mean [C]", "inlet_mean_c", GREEN),
            PlotLine("inlet hottest [C]", "inlet_max_c", ORANGE),
            PlotLine("outlet mean [C]", "outlet_mean_c", PINK),
            PlotLine("return [C]", "return_c", RED),
        ),
    ),
    "power_kw": Plot(
        "power [kW]",
        (
            PlotLine("IT [kW]", "it_w", BLUE, 1e-3),
            PlotLine("HVAC [kW]", "hvac_w", SKY, 1e-3),
            PlotLine("UPS loss [kW]", "ups_loss_w", PINK, 1e-3),
            PlotLine("distribution loss [kW]", "distribution_loss_w", GREY, 1e-3),
            PlotLine("grid [kW]", "grid_kwh", ORANGE, per_hour=True),
            PlotLine("battery charge [kW]", "charge_kwh", GREEN, per_hour=True),
            PlotLine("battery discharge [kW]", "discharge_kwh", RED, per_hour=True),
        ),
    ),
    "carbon_intensity": Plot(
        "grid carbon intensity [g/kWh]",
        (PlotLine("grid carbon intensity [g/kWh]", "ci_g_per_kwh", RED),),
    ),
    "carbon_kg": Plot("carbon [kg/step]", (PlotLine("carbon [kg/step]", "carbon_g", RED, 1e-3),)),
    "price": Plot(
        "price of electricity [currency/kWh]",
        (PlotLine("price [currency/kWh]", "price_per_kwh", GREEN),),
    ),
    "energy_cost": Plot(
        "cost of energy [currency/step]",
        (PlotLine("cost of energy [currency/step]", "energy_cost", GREEN),),
    ),
    "battery": Plot(
        "battery state of charge [-]", (PlotLine("state of charge [-]", "soc", GREEN),), (0.0, 1.0)
    ),
    "hvac_kw": Plot(
        "HVAC by device [kW]",
        (
            PlotLine("chiller [kW]", "chiller_w", BLUE, 1e-3),
            PlotLine("tower fan [kW]", "tower_fan_w", SKY, 1e-3),
            PlotLine("chilled-water pump [kW]", "chilled_pump_w", GREEN, 1e-3),
            PlotLine("condenser pump [kW]", "condenser_pump_w", PINK, 1e-3),
            PlotLine("CRAC fan [kW]", "crac_fan_w", ORANGE, 1e-3),
        ),
    ),
    "pue": Plot("PUE [-]", (PlotLine("PUE [-]", "pue", BLUE),)),
    "water_l": Plot(
        "water [L/step]",
        (
            PlotLine("make-up [L/step]", "water_l", BLUE),
            PlotLine("evaporation [L/step]", "evaporation_l", SKY),
            PlotLine("blowdown [L/step]", "blowdown_l", ORANGE),
            PlotLine("drift [L/step]", "drift_l", GREY),
        ),
    ),
    "weather_c": Plot(
        "weather [C]",
        (
            PlotLine("outdoor dry bulb [C]", "outdoor_c", ORANGE),
            PlotLine("outdoor wet bulb [C]", "wet_bulb_c", SKY),
        ),
    ),
    "queue_age_h": Plot(
        "age of the queue [h]",
        (PlotLine("oldest [h]", "oldest_age_h", RED), PlotLine("mean [h]", "mean_age_h", BLUE)),
    ),
    "work_tasks": Plot(
        "work [tasks/step]",
        (
            PlotLine("arrived [tasks/step]", "arrived_tasks", GREY),
            PlotLine("executed [tasks/step]", "executed_tasks", BLUE),
            PlotLine("overdue [tasks/step]", "overdue_tasks", ORANGE),
            PlotLine("dropped [tasks/step]", "dropped_tasks", RED),
            PlotLine("lost [tasks/step]", "lost_tasks", PINK),
        ),
    ),
    "load": Plot(
        "load [share of capacity]",
        (PlotLine("demand [-]", "demand", GREY), PlotLine("utilisation [-]", "utilisation", BLUE)),
    ),
    "commands": Plot(
        "commands [-]",
        (
            PlotLine("load, -1 defer to 1 drain [-]", "load_command", PINK),
            PlotLine("cooling, setpoint steps [-]", "cooling_command", BLUE),
            PlotLine("battery, -1 discharge to 1 charge [-]", "battery_command", GREEN),
        ),
    ),
}
"""Plots of a data center in focus, by entity, besides those of queue, CRAC units and rewards."""

QUEUE_ENTITY = "queue_tasks"
"""Entity of the plot of queued work by age."""
QUEUE_COLOURS = (SKY, BLUE, ORANGE, RED)
"""Colours of the age bands, the youngest first, as 0xRRGGBBAA."""
QUEUE_NAMES = tuple(
    f"{low:g} h and older [tasks]" if high is None else f"{low:g} to {high:g} h [tasks]"
    for low, high in zip(AGE_EDGES_H, (*AGE_EDGES_H[1:], None), strict=True)
)
"""Names of the age bands in the legend, the youngest first."""
REWARDS_ENTITY = "rewards"
"""Entity of the plot of reward terms."""

COMMAND_STATES: dict[str, tuple[str, tuple[str, str, str]]] = {
    "load": ("load_command", ("defer", "neutral", "drain")),
    "cooling": ("cooling_command", ("colder", "hold", "warmer")),
    "battery": ("battery_command", ("discharge", "idle", "charge")),
}
"""Commands as states, by entity: field of ``StepResult``, names below, at and above zero."""
STATE_COLOURS = (BLUE, GREY, ORANGE)
"""Colours of a command below, at and above zero, as 0xRRGGBBAA."""

EVENT_FIELDS = (
    "hottest_rack",
    "hottest_server",
    "unmet_w",
    "unserved_kwh",
    "grid_overload_kwh",
)
"""Fields that the log of events needs besides those that are plotted."""

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
"""Fields of which a recording holds the sum over all data centers of the fleet."""

FIELDS: tuple[str, ...] = tuple(
    dict.fromkeys(
        [
            *FLEET_SUMS,
            *(line.field for plot in PLOTS.values() for line in plot.lines if line.field != "pue"),
            *(command for command, _ in COMMAND_STATES.values()),
            *EVENT_FIELDS,
        ]
    )
)
"""Fields that are read of every step, ``FLEET_SUMS`` first; PUE follows from the powers."""
FIELD_ROWS = {field: row for row, field in enumerate(FIELDS)}
"""Place of each field in ``FIELDS``."""


class FleetPlot(NamedTuple):
    """A plot of one line over all data centers."""

    title: str
    """Title of the plot, with the unit in brackets."""
    colour: int
    """Colour of the line as 0xRRGGBBAA."""
    series: Callable[[Mapping[str, F64]], F64]
    """From the sums of ``FLEET_SUMS`` and the highest ``inlet_max_c`` to the line, all (T,)."""


def _pue(it_w: F64, overhead_w: F64) -> F64:
    """(IT + overhead) / IT, nan without IT power, which a plot shows as a gap."""
    some = it_w > 0
    return np.where(some, 1.0 + overhead_w / np.where(some, it_w, 1.0), np.nan)


def _sum_of(*fields: str, factor: float = 1.0) -> Callable[[Mapping[str, F64]], F64]:
    """A function that adds up some fields and multiplies by a factor."""
    return lambda total: np.sum([total[field] for field in fields], axis=0) * factor


FLEET_PLOTS: dict[str, FleetPlot] = {
    "pue": FleetPlot(
        "PUE of all [-]",
        BLUE,
        lambda total: _pue(total["it_w"], total["overhead_w"]),
    ),
    "hottest_inlet_c": FleetPlot(
        "hottest inlet of all [C]", ORANGE, lambda total: total["inlet_max_c"]
    ),
    "it_kw": FleetPlot("IT power of all [kW]", BLUE, _sum_of("it_w", factor=1e-3)),
    "carbon_kg": FleetPlot("carbon of all [kg/step]", RED, _sum_of("carbon_g", factor=1e-3)),
    "water_l": FleetPlot("water of all [L/step]", SKY, _sum_of("water_l")),
    "queue_tasks": FleetPlot("queued in all [tasks]", PINK, _sum_of("queue_tasks")),
    "lost_tasks": FleetPlot(
        "dropped or lost in all [tasks/step]", RED, _sum_of("dropped_tasks", "lost_tasks")
    ),
    "protected_racks": FleetPlot(
        "racks throttled or off [-]", RED, _sum_of("throttled_racks", "tripped_racks")
    ),
}
"""Plots over all data centers of the fleet, by entity."""


def append_pue(values: F64) -> F64:
    """Values of ``FIELDS``, (T, F, n), followed by the PUE, (T, F + 1, n)."""
    pue = _pue(values[:, FIELD_ROWS["it_w"]], values[:, FIELD_ROWS["overhead_w"]])
    return np.concatenate([values, pue[:, None]], axis=1)


def plot_rows_and_factors(plot: Plot, step_h: float) -> tuple[list[int], F64]:
    """Which rows of ``append_pue`` a plot shows, and what they are multiplied by, (lines,) each.

    Args:
        plot: the plot.
        step_h: length of a step, in h.
    """
    rows = [len(FIELDS) if line.field == "pue" else FIELD_ROWS[line.field] for line in plot.lines]
    factors = [line.factor / step_h if line.per_hour else line.factor for line in plot.lines]
    return rows, np.array(factors)
