"""Thermal memory of transient halls."""

from __future__ import annotations

from dataclasses import dataclass

from sdc_taichi.types import F64, Reals


@dataclass(frozen=True, slots=True)
class HallState:
    """Thermal memory of transient halls; quasi-steady halls have none."""

    server_c: Reals
    """Temperature of the servers of each group, in C, (G,)."""
    mixed_c: Reals
    """Temperature of the recirculated air before each rack, in C, (R,)."""
    exhaust_c: Reals
    """Temperature that each rack gives to the exhaust mixes, times its strength, in C, (R,): its
    outlet, and for the share of its air that failing fans do not move the mix before it."""
    captured_m3s: Reals
    """Recirculated air that each rack takes in, in m3/s, (R,)."""
    need_m3s: F64
    """Supply air that the racks ask of each CRAC unit, in m3/s, (U,)."""
    following: F64
    """Fan speed of each CRAC unit over full speed that would just cover the need, (U,)."""
    supply_excess_k: F64
    """Supply air of each CRAC unit over its setpoint and what the room is warmed by, in K, (U,)."""
