"""Make-up water of the cooling tower in one step, models in ``WATER``.

Arguments are float64 arrays of shape (B,), or anything that broadcasts to it. One kilogram of water
counts as one litre.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sdc_taichi.plant import moist_air
from sdc_taichi.types import Values, WaterQuantities

EVAPORATION_HEAT_J_PER_KG = 2.45e6
"""Heat of evaporation of water near 20 C, in J/kg."""
MAX_EVAPORATION_PER_K = 0.002
"""Most water that evaporates, as a share of the water flow per kelvin of range (EnergyPlus, "loss
factor" evaporation)."""
PAPER_DRIFT_RATE = 0.01
"""Drift of the paper and its code, as a share of the water used, not of the water circulated."""


class WaterPoint(NamedTuple):
    """Operation of the towers in one step."""

    rejected_w: Values
    """Heat that the tower rejects, in W, (B,)."""
    range_k: Values
    """Entering less leaving tower water, in K, (B,)."""
    water_kg_s: Values
    """Tower water flow, in kg/s, (B,)."""
    tower_airflow_m3s: Values
    """Airflow into the tower, in m3/s, above 0 wherever there is heat, (B,)."""
    outdoor_c: Values
    """Outdoor dry bulb, in C, (B,)."""
    wet_bulb_c: Values
    """Outdoor wet bulb, in C, (B,)."""
    pressure_pa: Values
    """Air pressure of the site, in Pa, (B,)."""
    return_c: Values
    """CRAC return air, in C, (B,)."""
    supply_setpoint_c: Values
    """CRAC supply setpoint, in C, (B,)."""
    cycles_of_concentration: Values
    """Concentration of solids in the tower water divided by that in the make-up, above 1, (B,)."""
    drift_share: Values
    """Drift as a share of the tower water flow, (B,)."""
    dt_s: Values
    """Length of the step, in s."""


def mass_balance(point: WaterPoint) -> WaterQuantities:
    """Evaporation, drift and blowdown (EnergyPlus Engineering Reference, tower make-up water).

    All heat is taken to leave as vapour, an upper bound (in frost a part leaves as warm air), and
    no more than 0.2 % of the flow per kelvin of range. Blowdown = evaporation/(COC - 1) - drift,
    at least 0.
    """
    latent_kg_s = np.maximum(point.rejected_w, 0.0) / EVAPORATION_HEAT_J_PER_KG
    evaporation_l = (
        np.minimum(latent_kg_s, MAX_EVAPORATION_PER_K * point.range_k * point.water_kg_s)
        * point.dt_s
    )
    return _with_blowdown(
        evaporation_l,
        point.drift_share * point.water_kg_s * point.dt_s,
        point.cycles_of_concentration,
    )


def saturated_exit(point: WaterPoint) -> WaterQuantities:
    """Evaporation into air that leaves the tower saturated, drift and blowdown.

    The heat raises the enthalpy of the tower's air from that of saturated air at the wet bulb, and
    air leaves saturated: evaporation = m*(w_sat,out - w_in) with m the dry air (EnergyPlus
    Engineering Reference, cooling tower make-up water, "saturated exit"). So little water
    evaporates in frost, when the air carries heat as warmth, and much in dry heat. Drift and
    blowdown as in ``mass_balance``.
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
    """The fit of the released SustainDC code, from the air temperatures of the room.

    max(0, 0.044*T_wb + 0.3528*(T_ret - T_set) + 0.101) m3/h, 1 % drift on top, litres rounded to
    4 decimals. The fit does not scale with the heat rejected, so neither with the size of the
    data center; evaporation and blowdown are one number, reported as evaporation.
    """
    use_m3h = 0.044 * point.wet_bulb_c + 0.3528 * (point.return_c - point.supply_setpoint_c) + 0.101
    use_l = np.maximum(use_m3h, 0.0) * _litres_per_m3h(point.dt_s)
    water_l = np.round(use_l * (1.0 + PAPER_DRIFT_RATE), 4)
    drift_l = use_l * PAPER_DRIFT_RATE
    return _water(water_l - drift_l, drift_l, 0.0, water_l)


def paper(point: WaterPoint) -> WaterQuantities:
    """Appendix A.2.6 as printed: w = 0.044*T_wb + 0.35*range + 0.1 m3/h, max(0, w) + 0.01*w.

    The drift term is printed on the unclipped w, so the use is slightly negative where w is.
    """
    use_m3h = 0.044 * point.wet_bulb_c + (0.35 * (point.return_c - point.supply_setpoint_c) + 0.1)
    evaporation_l = np.maximum(use_m3h, 0.0) * _litres_per_m3h(point.dt_s)
    drift_l = use_m3h * PAPER_DRIFT_RATE * _litres_per_m3h(point.dt_s)
    return _water(evaporation_l, drift_l, 0.0, evaporation_l + drift_l)


WATER: dict[str, Callable[[WaterPoint], WaterQuantities]] = {
    "saturated_exit": saturated_exit,
    "mass_balance": mass_balance,
    "released": released,
    "paper": paper,
}
"""Water models by the names that ``hvac.water.model`` takes."""


def _with_blowdown(
    evaporation_l: Values, drift_l: Values, cycles_of_concentration: Values
) -> WaterQuantities:
    """Water of a step whose blowdown holds the concentration of solids."""
    blowdown_l = np.maximum(evaporation_l / (cycles_of_concentration - 1.0) - drift_l, 0.0)
    return _water(evaporation_l, drift_l, blowdown_l, evaporation_l + drift_l + blowdown_l)


def _litres_per_m3h(dt_s: Values) -> Values:
    """Litres that a flow of 1 m3/h gives in a step."""
    return 1000.0 * dt_s / 3600.0


def _water(
    evaporation_l: Values, drift_l: Values, blowdown_l: Values, water_l: Values
) -> WaterQuantities:
    """Result of a step, all fields of one shape."""
    return WaterQuantities(*np.broadcast_arrays(evaporation_l, drift_l, blowdown_l, water_l))
