"""Controllers that are not learned, and what a controller sees."""

from sdc_taichi.control.registry import CONTROLLED, controlled, controller_names, make_controller
from sdc_taichi.control.rules import (
    Controller,
    FixedSetpoint,
    GreedyCarbon,
    Idle,
    Lookahead,
    PerAgent,
    Random,
    TrimAndRespond,
    trim_and_respond,
)
from sdc_taichi.control.view import Forecast, Limits, View, viewer

__all__ = [
    "CONTROLLED",
    "Controller",
    "FixedSetpoint",
    "Forecast",
    "GreedyCarbon",
    "Idle",
    "Limits",
    "Lookahead",
    "PerAgent",
    "Random",
    "TrimAndRespond",
    "View",
    "controlled",
    "controller_names",
    "make_controller",
    "trim_and_respond",
    "viewer",
]
