"""Plants, which move the heat of the halls outdoors: models in ``PLANTS``.

A water-cooled plant rejects its heat by a cooling tower. Dry plants have an air-cooled chiller,
whose power includes the fans of its condenser; nothing evaporates in them but in the humidifier of
outdoor air.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sdc_taichi.plant import moist_air
from sdc_taichi.plant.chiller import ChillerModel, ChillerPoint, ChillerResult
from sdc_taichi.plant.tower import TowerModel, TowerPoint
from sdc_taichi.plant.water_side import (
    LEAST_OUTDOOR_UNITS,
    WaterSideDesign,
    chilled_water_c,
    chilled_water_load_w,
    economiser_share,
    loop_pump_w,
)
from sdc_taichi.types import F64, Values, WaterSideResult, as_array

_WETTING_K = moist_air.VAPOUR_J_PER_KG / moist_air.DRY_AIR_J_PER_KG_K
"""Fall in temperature of air that takes up water, per rise of its humidity ratio, in K."""


class PlantPoint(NamedTuple):
    """Air of the hall and weather in one step of a plant."""

    setpoint_c: F64
    """CRAC supply setpoint, in C, (B,)."""
    return_c: F64
    """Air that returns to the CRAC units, in C, (B,)."""
    airflow_m3s: F64
    """Airflow of the CRAC units, in m3/s, (B,)."""
    outdoor_c: F64
    """Outdoor dry bulb, in C, (B,)."""
    wet_bulb_c: F64
    """Outdoor wet bulb, in C, (B,)."""


class Devices(NamedTuple):
    """Models of the devices of a plant."""

    chiller: ChillerModel
    """Model of the chiller."""
    tower: TowerModel
    """Model of the cooling tower."""
    limited: bool
    """Whether the capacity of the devices limits the heat that the plant removes."""


@dataclass(frozen=True, slots=True)
class PlantModel:
    """A plant."""

    step: Callable[[F64, PlantPoint, WaterSideDesign, Devices], WaterSideResult]
    """One step, from the heat to remove in W, (B,)."""
    dry: bool
    """Whether the chiller rejects its heat to outdoor air, without tower and tower water."""


def water_cooled(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
) -> WaterSideResult:
    """Remove up to ``requested_w`` from the chilled water and reject it by a cooling tower.

    Chilled water follows the air, T_chw = setpoint - coil approach, up to the warmest that the
    chiller makes, and returns as warm as the coils let it. The integrated economiser precools the
    return water with tower water as cold as the weather allows; the chiller does the rest. Both
    take the heat of the chilled-water pumps as well, so the hall gets the capacity less that heat.
    Tower and chiller depend on each other: the tower is solved for the chiller's power at the tower
    setpoint, then chiller and economiser at the water that the tower gives.
    """
    # The cells that run take the water of those that are down, but no more than at design.
    most_w = np.minimum(design.pumped_w, design.cooling_w * design.outdoor_units)
    load_w = np.minimum(requested_w, most_w) if devices.limited else requested_w
    chilled_c = chilled_water_c(point.setpoint_c, design)

    def run_chiller(economiser: F64, condenser_c: F64) -> ChillerResult:
        load_w = taken_w * (1.0 - economiser)
        return _run_chiller(load_w, chilled_c, condenser_c, point, design, devices)

    # The exchanger stands in the return of the coils, ahead of the bypass of pumps and chiller.
    taken_w, chilled_pump_w, range_ratio = chilled_water_load_w(load_w, design)
    return_water_c = chilled_c + design.chilled_water_range_k * range_ratio
    coldest_c = point.wet_bulb_c + design.approach_min_k
    share = _economiser_share_at(coldest_c, chilled_c, return_water_c, design)
    tower_setpoint_c = _tower_setpoint_c(coldest_c, share, chilled_c, design)
    foreseen = run_chiller(share, np.maximum(tower_setpoint_c, design.min_condenser_c))
    heat_w = taken_w * share + foreseen.rejected_w
    flow_ratio = np.maximum(heat_w / design.rejected_w, design.pump_min_ratio)
    tower_water_kg_s = design.tower_water_kg_s * flow_ratio
    units = np.maximum(design.outdoor_units, LEAST_OUTDOOR_UNITS)
    cooled = devices.tower.step(
        heat_w,
        TowerPoint(
            wet_bulb_c=point.wet_bulb_c,
            outdoor_c=point.outdoor_c,
            condenser_setpoint_c=tower_setpoint_c,
            supply_setpoint_c=point.setpoint_c,
            water_kg_s=tower_water_kg_s,
            reference_water_kg_s=design.tower_reference_kg_s * units,
            reference_air_m3s=design.tower_air_m3s * units,
            design_fan_w=design.tower_fan_w * units,
            air_j_per_m3_k=design.air_j_per_m3_k,
        ),
    )
    share = _economiser_share_at(cooled.leaving_c, chilled_c, return_water_c, design)
    # Head pressure control: a bypass keeps the chiller's water as warm as its capacity needs.
    short = foreseen.unmet_w > 0.0
    warm_c = np.where(short, design.fullest_condenser_c, design.min_condenser_c)
    machine = run_chiller(share, np.maximum(cooled.leaving_c, warm_c))
    economiser_w = taken_w * share
    return WaterSideResult(
        heat_removed_w=_removed_w(load_w, machine, devices),
        economiser_w=economiser_w,
        chiller_load_w=machine.evaporator_w if devices.limited else taken_w - economiser_w,
        chiller_w=machine.power_w,
        rejected_w=economiser_w + machine.rejected_w,
        chilled_water_c=chilled_c,
        condenser_water_c=cooled.leaving_c,
        tower_range_k=cooled.range_k,
        tower_water_kg_s=tower_water_kg_s,
        humidifier_kg_s=0.0 * heat_w,
        tower_airflow_m3s=cooled.air_ratio * design.tower_air_m3s * units,
        tower_fan_w=cooled.fan_w,
        chilled_pump_w=chilled_pump_w,
        condenser_pump_w=loop_pump_w(heat_w, design.rejected_w, design.condenser_pump_w, design),
    )


def _economiser_share_at(
    tower_water_c: F64, chilled_water_c: F64, return_water_c: F64, design: WaterSideDesign
) -> F64:
    """Share of the cooling load that the economiser takes with tower water, all in C, (B,)."""
    return design.economiser * economiser_share(
        return_water_c,
        chilled_water_c=chilled_water_c,
        tower_water_c=tower_water_c + design.exchanger_approach_k,
    )


def _tower_setpoint_c(
    coldest_c: F64, share: F64, chilled_water_c: F64, design: WaterSideDesign
) -> F64:
    """Water temperature that the tower is controlled to, in C, (B,).

    It is as cold as the economiser, or else the chiller, can use, but no colder than the weather
    allows.
    """
    economiser_c = chilled_water_c - design.exchanger_approach_k
    useful_c = np.where(share > 0, economiser_c, design.min_condenser_c)
    return np.maximum(coldest_c, useful_c)


def air_cooled(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
) -> WaterSideResult:
    """Remove up to ``requested_w`` from the chilled water with a dry cooler and a chiller.

    The dry cooler, with a heat exchanger in series ahead of the chiller, precools the return water.
    At full load and full fan speed the water comes within the design approach of the outdoor air
    when the cooler does all of the work, and with constant effectiveness

        share = clip((T_return - T_outdoor)/(range + approach), 0, 1)

    with the design range, so that the effectiveness grows as the water flow falls. It never exceeds
    1: no water leaves colder than the outdoor air.

    The heat of a cooler that needs less grows with the airflow to the power 3/4, as that of a film
    does, and the fan power with its cube, so the fans draw the fourth power of the heat divided by
    that at full speed.
    """
    load_w = np.minimum(requested_w, design.pumped_w) if devices.limited else requested_w
    chilled_c = chilled_water_c(point.setpoint_c, design)
    taken_w, chilled_pump_w, range_ratio = chilled_water_load_w(load_w, design)
    range_k = design.chilled_water_range_k * range_ratio
    over_k = np.maximum(chilled_c + range_k - point.outdoor_c, 0.0)
    full_range_k = design.chilled_water_range_k + design.dry_cooler_approach_k
    cooler_w = design.cooling_w + design.pump_heat_share * design.chilled_pump_w
    full_speed_w = design.economiser * design.outdoor_units * cooler_w * over_k / full_range_k
    share = np.minimum(over_k / np.maximum(full_range_k, range_k), 1.0)
    free_w = np.minimum(taken_w * share, full_speed_w)
    speed_share = free_w / np.maximum(full_speed_w, 1.0)
    left_w = taken_w - free_w
    machine = _run_chiller(left_w, chilled_c, point.outdoor_c, point, design, devices)
    return _dry(
        _removed_w(load_w, machine, devices),
        free_w=free_w,
        chiller_load_w=machine.evaporator_w if devices.limited else left_w,
        machine=machine,
        chilled_c=chilled_c,
        outdoor_c=point.outdoor_c,
        fan_w=design.tower_fan_w * design.outdoor_units * speed_share**4,
        chilled_pump_w=chilled_pump_w,
        condenser_pump_w=loop_pump_w(free_w, cooler_w, design.condenser_pump_w, design),
    )


def air_side(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
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
    """
    load_w = np.minimum(requested_w, design.cooling_w) if devices.limited else requested_w
    chilled_c = chilled_water_c(point.setpoint_c, design)
    vapour_pa = _vapour_pa(point.outdoor_c, point.wet_bulb_c, design.pressure_pa)
    ratio, least = (
        moist_air.vapour_ratio(pa, design.pressure_pa) for pa in (vapour_pa, design.least_vapour_pa)
    )
    lack = design.humidifier * np.maximum(least - ratio, 0.0)
    over_k = np.maximum(point.return_c - point.outdoor_c, 0.0)
    over_w_s_m3 = design.air_j_per_m3_k * (over_k + lack * _WETTING_K)
    most_m3s = np.minimum(point.airflow_m3s, design.tower_air_m3s * design.outdoor_units)
    units = np.maximum(design.outdoor_units, LEAST_OUTDOOR_UNITS)
    reachable_w = np.where(over_k > 0.0, most_m3s * over_w_s_m3, 0.0)
    within = (
        ((vapour_pa >= design.least_vapour_pa) | (design.humidifier > 0.0))
        & (vapour_pa <= design.most_vapour_pa)
        & (vapour_pa <= design.most_humidity * moist_air.saturation_pa(point.setpoint_c))
    )
    dry_coil = vapour_pa <= moist_air.saturation_pa(chilled_c)
    let_in = within & (dry_coil | (reachable_w >= load_w))
    free_w = np.where(let_in, np.minimum(np.maximum(load_w, 0.0), reachable_w), 0.0)
    outdoor_m3s = free_w / np.maximum(over_w_s_m3, design.air_j_per_m3_k * 1e-3)
    coil_w = load_w - free_w
    if devices.limited:
        coil_w = np.minimum(coil_w, design.pumped_w)
    taken_w, chilled_pump_w, _ = chilled_water_load_w(coil_w, design)
    machine = _run_chiller(taken_w, chilled_c, point.outdoor_c, point, design, devices)
    return _dry(
        free_w + _removed_w(coil_w, machine, devices),
        free_w=free_w,
        chiller_load_w=machine.evaporator_w if devices.limited else taken_w,
        machine=machine,
        chilled_c=chilled_c,
        outdoor_c=point.outdoor_c,
        fan_w=design.tower_fan_w * units * (outdoor_m3s / (design.tower_air_m3s * units)) ** 3,
        humidifier_kg_s=lack * outdoor_m3s * design.air_j_per_m3_k / moist_air.DRY_AIR_J_PER_KG_K,
        chilled_pump_w=chilled_pump_w,
        condenser_pump_w=0.0 * load_w,
    )


PLANTS: dict[str, PlantModel] = {
    "water_cooled": PlantModel(water_cooled, dry=False),
    "air_cooled": PlantModel(air_cooled, dry=True),
    "air_side": PlantModel(air_side, dry=True),
}
"""Plants by the names that ``hvac.plant`` takes."""


def plant_of(chiller: ChillerModel) -> str:
    """Name of the plant of a chiller for which the configuration names none."""
    return "water_cooled" if chiller.tower_water else "air_cooled"


def fits(chiller: ChillerModel, plant: PlantModel) -> bool:
    """Whether the condenser of a chiller can be cooled as a plant does it."""
    return chiller.outdoor_air if plant.dry else chiller.tower_water


def _run_chiller(
    load_w: F64,
    chilled_c: F64,
    condenser_c: F64,
    point: PlantPoint,
    design: WaterSideDesign,
    devices: Devices,
) -> ChillerResult:
    """One step of the chiller of a plant, for its load in W and its waters in C, (B,) each."""
    return devices.chiller.step(
        load_w,
        ChillerPoint(
            reference_w=design.chiller_w,
            chilled_water_c=chilled_c,
            condenser_c=condenser_c,
            outdoor_c=point.outdoor_c,
            machine=design.machine,
        ),
    )


def _removed_w(load_w: F64, machine: ChillerResult, devices: Devices) -> F64:
    """Part of the load of the coils that the plant removes, in W, (B,)."""
    return np.maximum(load_w - machine.unmet_w, 0.0) if devices.limited else load_w


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
    """Result of a plant without tower water, whose condenser is cooled by outdoor air."""
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


def _vapour_pa(outdoor_c: F64, wet_bulb_c: F64, pressure_pa: F64) -> F64:
    """Pressure of the vapour in outdoor air, Pa, (B,)."""
    at_wet_bulb = moist_air.saturated_ratio(wet_bulb_c, pressure_pa)
    ratio = moist_air.humidity_ratio(outdoor_c, wet_bulb_c, at_wet_bulb)
    return as_array(pressure_pa * ratio / (moist_air.WATER_TO_DRY_AIR + ratio))
