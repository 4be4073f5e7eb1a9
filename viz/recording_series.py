"""What a recording plots: fields of ``StepResult`` by plot, with names, units and colours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from sdc_taichi.types import F64

# Colours of Okabe and Ito, which stay apart for people who are colour-blind (Okabe, Ito: Color
# Universal Design, 2008). Black is a grey here, since the viewer's ground is dark.
BLUE, ORANGE, GREEN, RED = 0x0072B2FF, 0xE69F00FF, 0x009E73FF, 0xD55E00FF
PINK, SKY, YELLOW, GREY = 0xCC79A7FF, 0x56B4E9FF, 0xF0E442FF, 0x999999FF
PALETTE = (BLUE, ORANGE, GREEN, RED, PINK, SKY, YELLOW, GREY)

AGE_EDGES_H = (0.0, 6.0, 12.0, 24.0)
"""Lower edges of the age bands of the queue; the last is open."""


class Line(NamedTuple):
    """One line of a plot."""

    name: str
    """With its unit."""
    field: str
    """Of ``StepResult``."""
    colour: int
    factor: float = 1.0
    per_hour: bool = False
    """Whether to divide by the length of the step, which turns energies into powers."""


class Plot(NamedTuple):
    """Lines of one unit, which are one entity of the recording."""

    title: str
    lines: tuple[Line, ...]
    limits: tuple[float, float] | None = None
    """Of the axis; None follows the values."""


PLOTS: dict[str, Plot] = {
    "temperature_c": Plot(
        "air temperature [C]",
        (
            Line("setpoint [C]", "setpoint_c", BLUE),
            Line("supply [C]", "supply_c", SKY),
            Line("inlet mean [C]", "inlet_mean_c", GREEN),
            Line("inlet hottest [C]", "inlet_max_c", ORANGE),
            Line("outlet mean [C]", "outlet_mean_c", PINK),
            Line("return [C]", "return_c", RED),
        ),
    ),
    "power_kw": Plot(
        "power [kW]",
        (
            Line("IT [kW]", "it_w", BLUE, 1e-3),
            Line("HVAC [kW]", "hvac_w", SKY, 1e-3),
            Line("grid [kW]", "grid_kwh", ORANGE, per_hour=True),
            Line("battery charge [kW]", "charge_kwh", GREEN, per_hour=True),
            Line("battery discharge [kW]", "discharge_kwh", RED, per_hour=True),
        ),
    ),
    "carbon_intensity": Plot(
        "grid carbon intensity [g/kWh]",
        (Line("grid carbon intensity [g/kWh]", "ci_g_per_kwh", RED),),
    ),
    "carbon_kg": Plot("carbon [kg/step]", (Line("carbon [kg/step]", "carbon_g", RED, 1e-3),)),
    "battery": Plot(
        "battery state of charge [-]", (Line("state of charge [-]", "soc", GREEN),), (0.0, 1.0)
    ),
    "hvac_kw": Plot(
        "HVAC by device [kW]",
        (
            Line("chiller [kW]", "chiller_w", BLUE, 1e-3),
            Line("tower fan [kW]", "tower_fan_w", SKY, 1e-3),
            Line("chilled-water pump [kW]", "chilled_pump_w", GREEN, 1e-3),
            Line("condenser pump [kW]", "condenser_pump_w", PINK, 1e-3),
            Line("CRAC fan [kW]", "crac_fan_w", ORANGE, 1e-3),
        ),
    ),
    "pue": Plot("PUE [-]", (Line("PUE [-]", "pue", BLUE),)),
    "water_l": Plot(
        "water [L/step]",
        (
            Line("make-up [L/step]", "water_l", BLUE),
            Line("evaporation [L/step]", "evaporation_l", SKY),
            Line("blowdown [L/step]", "blowdown_l", ORANGE),
            Line("drift [L/step]", "drift_l", GREY),
        ),
    ),
    "weather_c": Plot(
        "weather [C]",
        (
            Line("outdoor dry bulb [C]", "outdoor_c", ORANGE),
            Line("outdoor wet bulb [C]", "wet_bulb_c", SKY),
        ),
    ),
    "queue_age_h": Plot(
        "age of the queue [h]",
        (Line("oldest [h]", "oldest_age_h", RED), Line("mean [h]", "mean_age_h", BLUE)),
    ),
    "work_tasks": Plot(
        "work [tasks/step]",
        (
            Line("arrived [tasks/step]", "arrived_tasks", GREY),
            Line("executed [tasks/step]", "executed_tasks", BLUE),
            Line("overdue [tasks/step]", "overdue_tasks", ORANGE),
            Line("dropped [tasks/step]", "dropped_tasks", RED),
            Line("lost [tasks/step]", "lost_tasks", PINK),
        ),
    ),
    "load": Plot(
        "load [share of capacity]",
        (Line("demand [-]", "demand", GREY), Line("utilisation [-]", "utilisation", BLUE)),
    ),
    "commands": Plot(
        "commands [-]",
        (
            Line("load, -1 defer to 1 drain [-]", "load_command", PINK),
            Line("cooling, setpoint steps [-]", "cooling_command", BLUE),
            Line("battery, -1 discharge to 1 charge [-]", "battery_command", GREEN),
        ),
    ),
}
"""Plots of a focus data center by entity; those of queue bands, CRAC units and rewards follow."""

QUEUE = "queue_tasks"
QUEUE_COLOURS = (SKY, BLUE, ORANGE, RED)
QUEUE_NAMES = tuple(
    f"{low:g} h and older [tasks]" if high is None else f"{low:g} to {high:g} h [tasks]"
    for low, high in zip(AGE_EDGES_H, (*AGE_EDGES_H[1:], None), strict=True)
)
REWARDS = "rewards"

STATES: dict[str, tuple[str, tuple[str, str, str]]] = {
    "load": ("load_command", ("defer", "neutral", "drain")),
    "cooling": ("cooling_command", ("colder", "hold", "warmer")),
    "battery": ("battery_command", ("discharge", "idle", "charge")),
}
"""Actions as states: entity to command and the names of a command below, at and above zero."""
STATE_COLOURS = (BLUE, GREY, ORANGE)

WATCHED = (
    "hottest_rack",
    "hottest_server",
    "unmet_w",
    "unserved_kwh",
)
"""Fields that the log of events needs besides those plotted."""

SUMMED = (
    "it_w",
    "hvac_w",
    "carbon_g",
    "water_l",
    "queue_tasks",
    "dropped_tasks",
    "lost_tasks",
    "throttled_racks",
    "tripped_racks",
)
"""Fields that are summed over all data centers."""

FIELDS: tuple[str, ...] = tuple(
    dict.fromkeys(
        [
            *SUMMED,
            *(line.field for plot in PLOTS.values() for line in plot.lines if line.field != "pue"),
            *(command for command, _ in STATES.values()),
            *WATCHED,
        ]
    )
)
"""What is read of every step, ``SUMMED`` first; PUE follows from the powers."""
ROW = {field: row for row, field in enumerate(FIELDS)}


class FleetLine(NamedTuple):
    """A series over all data centers."""

    title: str
    colour: int
    value: Callable[[Mapping[str, F64]], F64]
    """From the sums of ``SUMMED`` and the highest ``inlet_max_c`` to the series, all (T,)."""


def _pue(it_w: F64, hvac_w: F64) -> F64:
    """(IT + HVAC) / IT, nan without IT power, which a plot shows as a gap."""
    some = it_w > 0
    return np.where(some, 1.0 + hvac_w / np.where(some, it_w, 1.0), np.nan)


def _total(*fields: str, factor: float = 1.0) -> Callable[[Mapping[str, F64]], F64]:
    return lambda total: np.sum([total[field] for field in fields], axis=0) * factor


FLEET: dict[str, FleetLine] = {
    "pue": FleetLine(
        "PUE of all [-]",
        BLUE,
        lambda total: _pue(total["it_w"], total["hvac_w"]),
    ),
    "hottest_inlet_c": FleetLine(
        "hottest inlet of all [C]", ORANGE, lambda total: total["inlet_max_c"]
    ),
    "it_kw": FleetLine("IT power of all [kW]", BLUE, _total("it_w", factor=1e-3)),
    "carbon_kg": FleetLine("carbon of all [kg/step]", RED, _total("carbon_g", factor=1e-3)),
    "water_l": FleetLine("water of all [L/step]", SKY, _total("water_l")),
    "queue_tasks": FleetLine("queued in all [tasks]", PINK, _total("queue_tasks")),
    "lost_tasks": FleetLine(
        "dropped or lost in all [tasks/step]", RED, _total("dropped_tasks", "lost_tasks")
    ),
    "protected_racks": FleetLine(
        "racks throttled or off [-]", RED, _total("throttled_racks", "tripped_racks")
    ),
}
"""Series over all data centers of the fleet by entity."""


def with_pue(values: F64) -> F64:
    """Values of ``FIELDS``, (T, FIELDS, n), followed by the PUE, (T, FIELDS + 1, n)."""
    pue = _pue(values[:, ROW["it_w"]], values[:, ROW["hvac_w"]])
    return np.concatenate([values, pue[:, None]], axis=1)


def rows_and_factors(plot: Plot, step_h: float) -> tuple[list[int], F64]:
    """Rows of ``with_pue`` that a plot shows, and what they are multiplied by."""
    rows = [len(FIELDS) if line.field == "pue" else ROW[line.field] for line in plot.lines]
    factors = [line.factor / step_h if line.per_hour else line.factor for line in plot.lines]
    return rows, np.array(factors)
