"""Controllers that are not learned, and what a controller sees.

A controller turns a view of the data centers into actions, and knows them by nothing else.
Learning algorithms and physics never live here.
"""

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
