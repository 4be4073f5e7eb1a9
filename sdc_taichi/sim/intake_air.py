"""Air before the racks of a fleet at one moment, as the hall kernels left it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sdc_taichi.kernels.hall_arguments import RACK_OUT
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_tables import HallTables
from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class IntakeAir:
    """Air before the racks of a fleet with R racks and U CRAC units at one moment.

    Of quasi-steady halls in the last step, of transient halls at its end; ``airflow_m3s``,
    ``power_w``, ``outlet_c`` and ``unit_m3s`` are means over the step.
    """

    mixed_c: F64
    """Recirculated air before each rack, in C, (R,)."""
    exhaust_c: F64
    """Temperature that each rack gives to the exhaust mixes, in C, (R,): its outlet, and for the
    share of its air that failing fans do not move the mix before it."""
    airflow_m3s: F64
    """Airflow through each rack, in m3/s, (R,)."""
    power_w: F64
    """Power of each rack with its fans, in W, (R,)."""
    outlet_c: F64
    """Outlet of each rack, in C, (R,)."""
    fan_airflow: F64
    """Share of their airflow left to the fans of each rack, 0..1, (R,)."""
    powered: F64
    """Share of the step that each rack is on, 0..1, (R,)."""
    setpoint_c: F64
    """Supply air setpoint of each CRAC unit, in C, (U,)."""
    supply_c: F64
    """Supply air of each CRAC unit, in C, (U,)."""
    fresh_ratio: F64
    """Share of its racks' need for supply air that each CRAC unit covers, 0..1, (U,)."""
    unit_m3s: F64
    """Airflow of each CRAC unit, in m3/s, (U,)."""
    unit_weight: F64
    """Weight of each CRAC unit in the supply of all racks, 0..1, (U,): 1 while all units run."""


UNIT_FIELDS = ("setpoint_c", "supply_c", "fresh_ratio", "unit_m3s", "unit_weight")
"""Fields of ``IntakeAir`` with an entry per CRAC unit."""
RACK_FIELDS = tuple(f.name for f in fields(IntakeAir) if f.name not in UNIT_FIELDS)
"""Fields of ``IntakeAir`` with an entry per rack."""


def read_intake_air(tables: HallTables, rack_out: Any, exhaust: Any, setpoint_c: F64) -> IntakeAir:
    """Air before the racks from the arrays of the kernels after a step.

    Args:
        tables: arrays of the kernels.
        rack_out: rows RACK_OUT by place.
        exhaust: what racks gave to the mixes in the last sweep, times their strength, by place.
        setpoint_c: supply setpoint of each CRAC unit, in C, (U,).
    """
    out = dict(zip(RACK_OUT, rack_out.reshape(len(RACK_OUT), -1), strict=True))
    rack, unit = tables.rows("rack_inputs"), tables.rows("unit_state")
    strength = rack["strength"]
    rows = {
        "mixed_c": tables.rows("rack_state")["mixed_c"],
        "exhaust_c": exhaust.reshape(-1) / np.where(strength > 0, strength, 1.0),
        "airflow_m3s": out["airflow_m3s"],
        "power_w": out["cpu_w"] + out["fan_w"],
        "outlet_c": out["outlet_c"],
        "fan_airflow": rack["fan_airflow"],
        "powered": rack["powered"],
    }
    racks = tables.places.values_of_racks(np.stack([*rows.values()]))
    return IntakeAir(
        **dict(zip(rows, racks.astype(np.float64), strict=True)),
        setpoint_c=np.array(setpoint_c),
        supply_c=unit["supply_c"].copy(),
        fresh_ratio=unit["fresh_ratio_used"].copy(),
        unit_m3s=unit["flow_m3s"].copy(),
        unit_weight=tables.plenum.weight.copy(),
    )


def intake_air_of(fleet: Fleet, air: IntakeAir, dc: int) -> IntakeAir:
    """The part of ``air`` that belongs to one data center of a fleet."""
    racks = slice(fleet.rack_offsets[dc], fleet.rack_offsets[dc + 1])
    units = slice(fleet.unit_offsets[dc], fleet.unit_offsets[dc + 1])
    parts = {name: getattr(air, name)[racks] for name in RACK_FIELDS}
    return IntakeAir(**parts, **{name: getattr(air, name)[units] for name in UNIT_FIELDS})
