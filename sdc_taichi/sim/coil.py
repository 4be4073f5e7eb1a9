"""Coils of the CRAC units, and the plant behind them, as transient halls meet them."""

from __future__ import annotations

from dataclasses import dataclass

from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class Coil:
    """Coils and plant of transient halls during one step."""

    setpoint_c: F64
    """Supply setpoint of each CRAC unit, in C, (U,)."""
    room_j: F64
    """Heat held by the room at the start of the step, over the setpoint, in J, (B,)."""
    room_j_per_k: F64
    """Heat capacity of the room, in J/K, (B,)."""
    limit_w: F64
    """Heat that the plant can take during the step, in W, (B,)."""
    fan_w_per_m3s: F64
    """CRAC fan power over airflow at full speed, in W/(m3/s), (B,)."""
