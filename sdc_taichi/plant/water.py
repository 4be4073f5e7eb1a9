"""Make-up water of the cooling tower in one step, by the models in ``WATER``.

Arguments are float64 arrays of shape (B,), B data centers, or anything that broadcasts to it. One
kilogram of water counts as one litre.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sdc_taichi.plant import moist_air
from sdc_taichi.types import Values, WaterQuantities

EVAPORATION_HEAT_J_PER_KG = 2.45e6
"""Heat of evaporation of water near 20 C, in J/kg."""
EVAPORATION_PER_K = 0.002
"""Evaporation for each kelvin of range, as a share of the water flow: the usual loss factor, and
the default of EnergyPlus."""
PAPER_DRIFT_RATE = 0.01
"""Drift in the paper and its released code, as a share of the water use, not of the water flow."""


class WaterPoint(NamedTuple):
    """Operating point of the cooling towers in one step: the input of water models."""

    rejected_w: Values
    """Heat that the tower rejects, in W, (B,)."""
    range_k: Values
    """Entering minus leaving temperature of the tower water, in K, (B,)."""
    water_kg_s: Values
    """Tower water flow, in kg/s, (B,)."""
    tower_airflow_m3s: Values
    """Airflow into the tower, in m3/s, above 0 wherever there is heat to reject, (B,)."""
    outdoor_c: Values
    """Outdoor dry-bulb temperature, in C, (B,)."""
    wet_bulb_c: Values
    """Outdoor wet-bulb temperature, in C, (B,)."""
    pressure_pa: Values
    """Air pressure of the site, in Pa, (B,)."""
    return_c: Values
    """Return air temperature of the CRAC units, in C, (B,)."""
    supply_setpoint_c: Values
    """CRAC supply setpoint, in C, (B,)."""
    cycles_of_concentration: Values
    """Concentration of solids in tower water divided by that in make-up water, above 1, (B,)."""
    drift_share: Values
    """Drift as a share of the tower water flow, (B,)."""
    dt_s: Values
    """Length of the step, in s."""
    evaporation_per_k: Values = EVAPORATION_PER_K
    """Loss factor: evaporation for each kelvin of range, as a share of the water flow, (B,)."""


def mass_balance(point: WaterPoint) -> WaterQuantities:
    """Compute evaporation, drift and blowdown with all heat rejected by evaporation.

    In cold weather part of the heat leaves as warm air, and this model gives too much water; in hot
    dry weather air brings heat of its own, and it gives too little. Blowdown is evaporation/(cycles
    of concentration - 1) - drift, and at least 0 (EnergyPlus Engineering Reference, tower make-up
    water).
    """
    return _with_blowdown(
        np.maximum(point.rejected_w, 0.0) / EVAPORATION_HEAT_J_PER_KG * point.dt_s,
        point.drift_share * point.water_kg_s * point.dt_s,
        point.cycles_of_concentration,
    )


def loss_factor(point: WaterPoint) -> WaterQuantities:
    """Compute evaporation, drift and blowdown with a loss factor for each kelvin of range.

    Evaporation is factor * range * water flow (EnergyPlus Engineering Reference, tower make-up
    water, "LossFactor"; its default factor is 0.2 % per kelvin). All heat rejected by evaporation
    would be 0.17 % per kelvin, so the default is 17 % more than ``mass_balance``. Drift and
    blowdown are those of ``mass_balance``.
    """
    range_k = np.maximum(point.range_k, 0.0)
    return _with_blowdown(
        point.evaporation_per_k * range_k * point.water_kg_s * point.dt_s,
        point.drift_share * point.water_kg_s * point.dt_s,
        point.cycles_of_concentration,
    )


def saturated_exit(point: WaterPoint) -> WaterQuantities:
    """Compute evaporation, drift and blowdown with air that leaves the tower saturated.

    The rejected heat raises the enthalpy of the tower's air, which starts at that of saturated air
    at the wet bulb. With the mass flow m of dry air, evaporation is m*(w_sat,out - w_in)
    (EnergyPlus Engineering Reference, cooling tower make-up water, "saturated exit"). Little water
    thus evaporates in cold weather, when much of the heat is sensible, and much in hot dry weather.
    Drift and blowdown are those of ``mass_balance``.
    """
    at_wet_bulb = moist_air.saturated_ratio(point.wet_bulb_c, point.pressure_pa)
    entering = moist_air.humidity_ratio(point.outdoor_c, point.wet_bulb_c, at_wet_bulb)
    dry_air_kg_s = point.tower_airflow_m3s * moist_air.dry_air_kg_m3(
        point.outdoor_c, entering, point.pressure_pa
    )
    working = np.greater(point.rejected_w, 0.0) & (dry_air_kg_s > 0.0)
    gain_j_per_kg = point.rejected_w / np.where(working, dry_air_kg_s, 1.0)
    leaving = moist_air.saturated_ratio_by_enthalpy(
        moist_air.enthalpy_j_per_kg(point.wet_bulb_c, at_wet_bulb) + gain_j_per_kg,
        point.pressure_pa,
    )
    taken_up_kg_s = np.where(working, dry_air_kg_s * np.maximum(leaving - entering, 0.0), 0.0)
    drift_l = point.drift_share * point.water_kg_s * point.dt_s
    return _with_blowdown(taken_up_kg_s * point.dt_s, drift_l, point.cycles_of_concentration)


def released(point: WaterPoint) -> WaterQuantities:
    """Compute the water use of the released SustainDC code from the air temperatures of the room.

    The use is max(0, 0.044*T_wb + 0.3528*(T_ret - T_set) + 0.101) m3/h plus 1 % drift, with litres
    rounded to 4 decimals. This fit depends neither on the heat rejected nor on the size of the
    data center. It does not separate evaporation from blowdown; their sum is reported as
    evaporation.
    """
    use_m3h = 0.044 * point.wet_bulb_c + 0.3528 * (point.return_c - point.supply_setpoint_c) + 0.101
    use_l = np.maximum(use_m3h, 0.0) * _litres_per_m3h(point.dt_s)
    water_l = np.round(use_l * (1.0 + PAPER_DRIFT_RATE), 4)
    drift_l = use_l * PAPER_DRIFT_RATE
    return _water(water_l - drift_l, drift_l, 0.0, water_l)


def paper(point: WaterPoint) -> WaterQuantities:
    """Compute the water use of the paper (appendix A.2.6): max(0, w) + 0.01*w, in m3/h.

    Here w = 0.044*T_wb + 0.35*(T_ret - T_set) + 0.1. The printed drift term uses w without the
    lower bound, so the water use is slightly negative where w is negative.
    """
    use_m3h = 0.044 * point.wet_bulb_c + (0.35 * (point.return_c - point.supply_setpoint_c) + 0.1)
    evaporation_l = np.maximum(use_m3h, 0.0) * _litres_per_m3h(point.dt_s)
    drift_l = use_m3h * PAPER_DRIFT_RATE * _litres_per_m3h(point.dt_s)
    return _water(evaporation_l, drift_l, 0.0, evaporation_l + drift_l)


WATER: dict[str, Callable[[WaterPoint], WaterQuantities]] = {
    "saturated_exit": saturated_exit,
    "mass_balance": mass_balance,
    "loss_factor": loss_factor,
    "released": released,
    "paper": paper,
}
"""Water models by their names, the valid values of ``hvac.water.model``."""


def _with_blowdown(
    evaporation_l: Values, drift_l: Values, cycles_of_concentration: Values
) -> WaterQuantities:
    """Build the result of a step with the blowdown that keeps the concentration of solids."""
    blowdown_l = np.maximum(evaporation_l / (cycles_of_concentration - 1.0) - drift_l, 0.0)
    return _water(evaporation_l, drift_l, blowdown_l, evaporation_l + drift_l + blowdown_l)


def _litres_per_m3h(dt_s: Values) -> Values:
    """Return the volume, in litres, that a flow of 1 m3/h delivers in a step."""
    return 1000.0 * dt_s / 3600.0


def _water(
    evaporation_l: Values, drift_l: Values, blowdown_l: Values, water_l: Values
) -> WaterQuantities:
    """Build the result of a step with all fields broadcast to the same shape."""
    return WaterQuantities(*np.broadcast_arrays(evaporation_l, drift_l, blowdown_l, water_l))
