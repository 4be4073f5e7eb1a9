"""Plants without a cooling tower, whose air-cooled chiller rejects its heat to outdoor air.

Plants are functions of the same signature as ``water_side.water_cooled``. The power of the chiller
includes the fans of its condenser. Nothing evaporates but in the humidifier of outdoor air.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sdc_taichi.plant import moist_air
from sdc_taichi.plant.chiller import ChillerResult
from sdc_taichi.plant.tower import TowerResult
from sdc_taichi.plant.water_side import (
    LEAST_OUTDOOR_UNITS,
    WaterSideDesign,
    WaterSideResult,
    chilled_water_c,
    chilled_water_load_w,
    loop_pump_w,
)
from sdc_taichi.types import F64, Values, as_array

_WETTING_K = moist_air.VAPOUR_J_PER_KG / moist_air.DRY_AIR_J_PER_KG_K
"""Fall in temperature of air that takes up water over the rise of its humidity ratio, in K."""


def air_cooled(
    requested_w: F64,
    *,
    setpoint_c: F64,
    return_c: F64,
    airflow_m3s: F64,
    outdoor_c: F64,
    wet_bulb_c: F64,
    design: WaterSideDesign,
    chiller: Callable[..., ChillerResult],
    tower: Callable[..., TowerResult],
    limited: bool,
) -> WaterSideResult:
    """Remove up to ``requested_w`` from the chilled water with a dry cooler and a chiller.

    The dry cooler, with a heat exchanger in series ahead of the chiller, precools the return water.
    At full load and full fan speed the water comes within the design approach of the outdoor air
    when the cooler does all of the work, and with constant effectiveness

        share = clip((T_return - T_outdoor)/(range + approach), 0, 1)

    with the design range, so that the effectiveness grows as the water flow falls. It never exceeds
    1: no water leaves colder than the outdoor air.

    The heat of a cooler that needs less grows with the airflow to the power 3/4, as that of a film
    does, and the fan power with its cube, so the fans draw the fourth power of the heat over that
    at full speed.

    Args:
        requested_w: Heat to remove, W, (B,).
        setpoint_c: CRAC supply setpoint, C, (B,).
        return_c: Not used.
        airflow_m3s: Not used.
        outdoor_c: Outdoor dry bulb, C, (B,).
        wet_bulb_c: Not used.
        design: Sized devices.
        chiller: Model of ``plant.chiller``.
        tower: Not used.
        limited: Whether the plant's capacity limits the heat removed.

    Returns:
        The plant's step.
    """
    load_w = np.minimum(requested_w, design.pumped_w) if limited else requested_w
    chilled_c = chilled_water_c(setpoint_c, design)
    taken_w, chilled_pump_w, range_ratio = chilled_water_load_w(load_w, design)
    range_k = design.chilled_water_range_k * range_ratio
    over_k = np.maximum(chilled_c + range_k - outdoor_c, 0.0)
    full_range_k = design.chilled_water_range_k + design.dry_cooler_approach_k
    cooler_w = design.cooling_w + design.pump_heat_share * design.chilled_pump_w
    full_speed_w = design.economiser * design.outdoor_units * cooler_w * over_k / full_range_k
    share = np.minimum(over_k / np.maximum(full_range_k, range_k), 1.0)
    free_w = np.minimum(taken_w * share, full_speed_w)
    speed_share = free_w / np.maximum(full_speed_w, 1.0)
    machine = _air_cooled_chiller(taken_w - free_w, chilled_c, outdoor_c, design, chiller)
    return _dry(
        np.maximum(load_w - machine.unmet_w, 0.0) if limited else load_w,
        free_w=free_w,
        chiller_load_w=machine.evaporator_w if limited else taken_w - free_w,
        machine=machine,
        chilled_c=chilled_c,
        outdoor_c=outdoor_c,
        fan_w=design.tower_fan_w * design.outdoor_units * speed_share**4,
        chilled_pump_w=chilled_pump_w,
        condenser_pump_w=loop_pump_w(free_w, cooler_w, design.condenser_pump_w, design),
    )


def air_side(
    requested_w: F64,
    *,
    setpoint_c: F64,
    return_c: F64,
    airflow_m3s: F64,
    outdoor_c: F64,
    wet_bulb_c: F64,
    design: WaterSideDesign,
    chiller: Callable[..., ChillerResult],
    tower: Callable[..., TowerResult],
    limited: bool,
) -> WaterSideResult:
    """Remove up to ``requested_w`` with outdoor air, and the rest with chilled water.

    Outdoor air takes the place of as much return air as the heat asks for, up to all of it:

        heat = rho V_outdoor (cp (T_return - T_outdoor) + h_fg (w_least - w_outdoor))

    It is let in while its moisture stays within the envelope of the config: dew point, and relative
    humidity at the supply setpoint. Air that is too dry is wetted up to the lowest dew point by an
    adiabatic humidifier, the second term, or else left outside. While coils cool as well, the air
    must be so dry that nothing condenses on them (dew point below the chilled water), so their heat
    is sensible alone. The fans that draw it through its filters and push the return air out follow
    the affinity law; their heat leaves with that air.

    Args:
        requested_w: Heat to remove, W, (B,).
        setpoint_c: CRAC supply setpoint, C, (B,).
        return_c: Air that returns to the CRAC units, C, (B,).
        airflow_m3s: Airflow of the CRAC units, m3/s, (B,).
        outdoor_c: Outdoor dry bulb, C, (B,).
        wet_bulb_c: Outdoor wet bulb, C, (B,).
        design: Sized devices.
        chiller: Model of ``plant.chiller``.
        tower: Not used.
        limited: Whether the plant's capacity limits the heat removed.

    Returns:
        The plant's step.
    """
    load_w = np.minimum(requested_w, design.cooling_w) if limited else requested_w
    chilled_c = chilled_water_c(setpoint_c, design)
    vapour_pa = _vapour_pa(outdoor_c, wet_bulb_c, design.pressure_pa)
    ratio, least = (_ratio(pa, design.pressure_pa) for pa in (vapour_pa, design.least_vapour_pa))
    lack = design.humidifier * np.maximum(least - ratio, 0.0)
    over_k = np.maximum(return_c - outdoor_c, 0.0)
    over_w_s_m3 = design.air_j_per_m3_k * (over_k + lack * _WETTING_K)
    most_m3s = np.minimum(airflow_m3s, design.tower_air_m3s * design.outdoor_units)
    units = np.maximum(design.outdoor_units, LEAST_OUTDOOR_UNITS)
    reachable_w = np.where(over_k > 0.0, most_m3s * over_w_s_m3, 0.0)
    within = (
        ((vapour_pa >= design.least_vapour_pa) | (design.humidifier > 0.0))
        & (vapour_pa <= design.most_vapour_pa)
        & (vapour_pa <= design.most_humidity * moist_air.saturation_pa(setpoint_c))
    )
    dry_coil = vapour_pa <= moist_air.saturation_pa(chilled_c)
    let_in = within & (dry_coil | (reachable_w >= load_w))
    free_w = np.where(let_in, np.minimum(np.maximum(load_w, 0.0), reachable_w), 0.0)
    outdoor_m3s = free_w / np.maximum(over_w_s_m3, design.air_j_per_m3_k * 1e-3)
    coil_w = load_w - free_w
    if limited:
        coil_w = np.minimum(coil_w, design.pumped_w)
    taken_w, chilled_pump_w, _ = chilled_water_load_w(coil_w, design)
    machine = _air_cooled_chiller(taken_w, chilled_c, outdoor_c, design, chiller)
    return _dry(
        free_w + (np.maximum(coil_w - machine.unmet_w, 0.0) if limited else coil_w),
        free_w=free_w,
        chiller_load_w=machine.evaporator_w if limited else taken_w,
        machine=machine,
        chilled_c=chilled_c,
        outdoor_c=outdoor_c,
        fan_w=design.tower_fan_w * units * (outdoor_m3s / (design.tower_air_m3s * units)) ** 3,
        humidifier_kg_s=lack * outdoor_m3s * design.air_j_per_m3_k / moist_air.DRY_AIR_J_PER_KG_K,
        chilled_pump_w=chilled_pump_w,
        condenser_pump_w=0.0 * load_w,
    )


def _air_cooled_chiller(
    load_w: F64,
    chilled_c: F64,
    outdoor_c: F64,
    design: WaterSideDesign,
    chiller: Callable[..., ChillerResult],
) -> ChillerResult:
    """The chiller, whose condenser sees the outdoor air."""
    return chiller(
        load_w,
        reference_w=design.chiller_w,
        chilled_water_c=chilled_c,
        condenser_c=outdoor_c,
        outdoor_c=outdoor_c,
        reference_cop=design.reference_cop,
        min_lift_k=design.min_lift_k,
    )


def _dry(
    removed_w: F64,
    *,
    free_w: F64,
    chiller_load_w: F64,
    machine: ChillerResult,
    chilled_c: F64,
    outdoor_c: F64,
    fan_w: F64,
    chilled_pump_w: F64,
    condenser_pump_w: F64,
    humidifier_kg_s: Values = 0.0,
) -> WaterSideResult:
    """Result of a plant without tower water; what cools its condenser is outdoor air."""
    nothing = 0.0 * removed_w
    return WaterSideResult(
        heat_removed_w=removed_w,
        economiser_w=free_w,
        chiller_load_w=chiller_load_w,
        chiller_w=machine.power_w,
        rejected_w=free_w + machine.rejected_w,
        chilled_water_c=chilled_c,
        condenser_water_c=outdoor_c,
        tower_range_k=nothing,
        tower_water_kg_s=nothing,
        tower_airflow_m3s=nothing,
        humidifier_kg_s=nothing + humidifier_kg_s,
        tower_fan_w=fan_w,
        chilled_pump_w=chilled_pump_w,
        condenser_pump_w=condenser_pump_w,
    )


def _ratio(vapour_pa: F64, pressure_pa: F64) -> F64:
    """Humidity ratio of air by the pressure of its vapour, kg/kg, (B,)."""
    return moist_air.WATER_TO_DRY_AIR * vapour_pa / (pressure_pa - vapour_pa)


def _vapour_pa(outdoor_c: F64, wet_bulb_c: F64, pressure_pa: F64) -> F64:
    """Pressure of the vapour in outdoor air, Pa, (B,)."""
    at_wet_bulb = moist_air.saturated_ratio(wet_bulb_c, pressure_pa)
    ratio = moist_air.humidity_ratio(outdoor_c, wet_bulb_c, at_wet_bulb)
    return as_array(pressure_pa * ratio / (moist_air.WATER_TO_DRY_AIR + ratio))
