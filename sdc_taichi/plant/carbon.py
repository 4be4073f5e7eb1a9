"""Emissions."""

from __future__ import annotations

from sdc_taichi.types import F64


def emitted_g(bought_kwh: F64, ci_g_per_kwh: F64) -> F64:
    """Carbon footprint of a step: grid energy times grid carbon intensity, g, (B,)."""
    return bought_kwh * ci_g_per_kwh
