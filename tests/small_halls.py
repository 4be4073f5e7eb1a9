"""Small halls with an agent for each CRAC unit."""

from __future__ import annotations

from sdc_taichi import load_config
from sdc_taichi.config import DataCenterConfig

SMALL = [
    *("hall.rows=2", "hall.racks_per_row=6", "hall.rack_plan=[{type: compute}]"),
    *("hvac.crac.spare_units=0", "hvac.crac.unit_sizes=equal"),
]
DOWN = [
    "events.sampled=[]",
    "events.scheduled=[{kind: crac_down, start_h: 0, duration_h: 1, unit: 1}]",
]
"""Overrides of a hall whose unit 1 is down in the first hour."""


def hall(units: int, *more: str) -> DataCenterConfig:
    """Hall of 12 racks with a number of CRAC units, and further overrides."""
    return load_config("hall_agents_6", [*SMALL, f"hvac.crac.units={units}", *more])
