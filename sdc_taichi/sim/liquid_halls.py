"""Liquid-cooled racks in the steps of a fleet: their state, and results where there are none."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import CDUS, DATA_CENTERS, QUANTITIES, RACKS, LiquidQuantities

STATE_FIELDS = (
    "cdu_setpoint_c",
    "cdu_flow",
    "junction_c",
    "manifold_return_c",
    "manifold_supply_c",
    "facility_return_c",
    "facility_supply_c",
)
"""Fields of ``State`` that liquid cooling needs."""
_NAMES = {
    axis: tuple(f.name for f in fields(LiquidQuantities) if QUANTITIES[f.name].axis == axis)
    for axis in (DATA_CENTERS, CDUS, RACKS)
}


def without_liquid(fleet: Fleet) -> dict[str, Any]:
    """Return ``LiquidQuantities`` of a step without liquid cooling by name, as arrays of their own.

    Args:
        fleet: The data centers.
    """
    sizes = {DATA_CENTERS: fleet.size, CDUS: fleet.cdus, RACKS: fleet.racks}
    values: dict[str, Any] = {}
    for axis, names in _NAMES.items():
        values.update(zip(names, np.zeros((len(names), sizes[axis])), strict=True))
    # These times are -1 in steps in which nothing happens.
    values["throttle_s"] -= 1.0
    values["trip_s"] -= 1.0
    return values


def no_liquid_state() -> dict[str, Any]:
    """Return the fields of ``State`` that liquid cooling needs, empty, by name."""
    return dict.fromkeys(STATE_FIELDS, np.zeros(0))
