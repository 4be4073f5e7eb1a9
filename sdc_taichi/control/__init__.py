"""Controllers, and the views of data centers from which they compute actions.

A controller turns a view of the data centers into actions and has no other access to them.
This package contains no learning algorithms and no physics.
"""

from sdc_taichi.control.registry import (
    CONTROLLABLE,
    check_controller,
    controller_names,
    controller_text,
    make_controller,
    parts_of,
    register_controller,
)
from sdc_taichi.control.rules import (
    Controller,
    FixedSetpoint,
    GreedyCarbon,
    Idle,
    PerAgent,
    Random,
    Rank,
    TrimAndRespond,
    commands_of,
    trim_and_respond,
)
from sdc_taichi.control.view import PERFECT, Forecast, ForecastError, Limits, View, view_maker

__all__ = [
    "CONTROLLABLE",
    "PERFECT",
    "Controller",
    "FixedSetpoint",
    "Forecast",
    "ForecastError",
    "GreedyCarbon",
    "Idle",
    "Limits",
    "PerAgent",
    "Random",
    "Rank",
    "TrimAndRespond",
    "View",
    "check_controller",
    "commands_of",
    "controller_names",
    "controller_text",
    "make_controller",
    "parts_of",
    "register_controller",
    "trim_and_respond",
    "view_maker",
]
