"""Emissions."""

from __future__ import annotations

from sdc_taichi.types import F64


def emitted_g(grid_kwh: F64, ci_g_per_kwh: F64) -> F64:
    """Carbon footprint of a step: grid energy times grid carbon intensity.

    Args:
        grid_kwh: Energy bought from the grid, kWh, (B,).
        ci_g_per_kwh: Carbon intensity of the grid, g CO2e/kWh, (B,).

    Returns:
        Emissions, g CO2e, (B,).
    """
    return grid_kwh * ci_g_per_kwh
