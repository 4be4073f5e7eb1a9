"""Cooling plants, which move the heat of the halls outdoors, with their models in ``PLANTS``.

A water-cooled plant rejects its heat through a cooling tower. A dry plant has an air-cooled
chiller, whose power includes the fans of its condenser; its only water use is that of the
humidifier of outdoor air. Arrays of shape (B,) have one value per data center.
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
from sdc_taichi.types import F64, Values, WaterSideResult, as_array, fields_of

_WETTING_K = moist_air.VAPOUR_J_PER_KG / moist_air.DRY_AIR_J_PER_KG_K
"""Temperature drop of air by adiabatic humidification, divided by the rise of its humidity ratio in
kg/kg; in K."""
_DAMPER_BAND = 0.1
"""Proportional band of the dampers of outdoor air, as a share of the vapour pressure at a limit."""
_LEAST_W, _LEAST_K, _LEAST_M3S = 1e-3, 1e-3, 1e-9
"""Lower bounds of divisors that are a power, a temperature difference or an airflow."""


class PlantPoint(NamedTuple):
    """State of the hall's air and of the weather in one step: the input of a plant model."""

    setpoint_c: F64
    """CRAC supply setpoint, in C, (B,)."""
    water_setpoint_c: F64
    """Supply temperature that the chilled water is cold enough for, in C, (B,): the setpoint, or
    lower if colder water is commanded."""
    return_c: F64
    """Return air temperature of the CRAC units, in C, (B,)."""
    airflow_m3s: F64
    """Airflow of the CRAC units, in m3/s, (B,)."""
    outdoor_c: F64
    """Outdoor dry-bulb temperature, in C, (B,)."""
    wet_bulb_c: F64
    """Outdoor wet-bulb temperature, in C, (B,)."""


class Devices(NamedTuple):
    """Models of the devices of a plant."""

    chiller: ChillerModel
    """Chiller model."""
    tower: TowerModel
    """Cooling tower model."""
    limited: bool
    """True if the capacity of the devices limits the heat that the plant removes."""


@dataclass(frozen=True, slots=True)
class PlantModel:
    """Plant model: its equations and the medium to which it rejects heat."""

    step: Callable[[F64, PlantPoint, WaterSideDesign, Devices], WaterSideResult]
    """Function that computes one step from the heat to remove, in W, (B,)."""
    dry: bool
    """True if the chiller rejects its heat to outdoor air, without a cooling tower."""


def water_cooled(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
) -> WaterSideResult:
    """Step a water-cooled plant: remove up to ``requested_w`` and reject it by a cooling tower.

    The chilled-water temperature is setpoint - coil approach, limited to the warmest water that the
    chiller makes. The integrated economiser precools the return water with tower water as cold as
    the weather allows, and the chiller removes the remaining heat. Economiser and chiller also
    remove the heat of the chilled-water pumps, which reduces the capacity available to the hall.
    Tower and chiller depend on each other. The tower is therefore solved first, with the chiller
    power at the tower setpoint; then chiller and economiser, at the resulting water temperature.
    """
    # Running tower cells take over the water of failed ones, but the capacity per cell is limited.
    capacity_w = np.minimum(design.pumped_w, design.cooling_w * design.outdoor_units)
    load_w = np.minimum(requested_w, capacity_w) if devices.limited else requested_w
    chilled_c = chilled_water_c(point.water_setpoint_c, design)

    def run_chiller(economiser: F64, condenser_c: F64) -> ChillerResult:
        load_w = taken_w * (1.0 - economiser)
        return _run_chiller(load_w, chilled_c, condenser_c, point, design, devices)

    # The economiser is in the return pipe of the coils, upstream of the bypass of the chiller.
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
    # Head pressure control: a bypass keeps the condenser water at or above the chiller's minimum
    # temperature or, if its capacity is short, at or above the temperature of largest capacity.
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
    """Return the share of the cooling load that the economiser removes, 0..1, (B,)."""
    return design.economiser * economiser_share(
        return_water_c,
        chilled_water_c=chilled_water_c,
        tower_water_c=tower_water_c + design.exchanger_approach_k,
    )


def _tower_setpoint_c(
    coldest_c: F64, share: F64, chilled_water_c: F64, design: WaterSideDesign
) -> F64:
    """Return the setpoint of the water that leaves the tower, in C, (B,).

    The setpoint is the coldest temperature that the economiser can use if it runs, else the coldest
    that the chiller can use. It is at least the coldest temperature that the weather allows.
    """
    economiser_c = chilled_water_c - design.exchanger_approach_k
    useful_c = np.where(share > 0, economiser_c, design.min_condenser_c)
    return np.maximum(coldest_c, useful_c)


def air_cooled(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
) -> WaterSideResult:
    """Step an air-cooled plant: remove up to ``requested_w`` with a dry cooler and a chiller.

    The dry cooler precools the return water through a heat exchanger upstream of the chiller. The
    cooler is sized to carry the full load at full fan speed, with water leaving at the design
    approach above outdoor air. At constant effectiveness its share of the load is at most

        share = clip((T_return - T_outdoor)/(range + approach), 0, 1)

    with the design range. The effectiveness thus rises as the water flow falls, but never above 1,
    because no water leaves colder than the outdoor air.

    At lower fan speed the heat is proportional to the airflow to the power 3/4 (film coefficient),
    and the fan power to the airflow cubed. The fan power P is therefore the fourth power of the
    heat q, both relative to full speed. A chiller that draws c watts per watt of heat makes the
    speed worthwhile up to which 4 P_full q^3 = c Q_full. ``_worthwhile`` decides whether the cooler
    runs at all.
    """
    load_w = np.minimum(requested_w, design.pumped_w) if devices.limited else requested_w
    chilled_c = chilled_water_c(point.water_setpoint_c, design)
    taken_w, chilled_pump_w, range_ratio = chilled_water_load_w(load_w, design)
    range_k = design.chilled_water_range_k * range_ratio
    over_k = np.maximum(chilled_c + range_k - point.outdoor_c, 0.0)
    full_range_k = design.chilled_water_range_k + design.dry_cooler_approach_k
    cooler_w = design.cooling_w + design.pump_heat_share * design.chilled_pump_w
    full_speed_w = design.economiser * design.outdoor_units * cooler_w * over_k / full_range_k
    full_fan_w = design.tower_fan_w * design.outdoor_units

    def run(free_w: F64) -> WaterSideResult:
        left_w = taken_w - free_w
        machine = _run_chiller(left_w, chilled_c, point.outdoor_c, point, design, devices)
        return _dry(
            _removed_w(load_w, machine, devices),
            free_w=free_w,
            chiller_load_w=machine.evaporator_w if devices.limited else left_w,
            machine=machine,
            chilled_c=chilled_c,
            outdoor_c=point.outdoor_c,
            fan_w=full_fan_w * (free_w / np.maximum(full_speed_w, _LEAST_W)) ** 4,
            chilled_pump_w=chilled_pump_w,
            condenser_pump_w=loop_pump_w(free_w, cooler_w, design.condenser_pump_w, design),
        )

    without = run(0.0 * taken_w)
    worth = _chiller_w_per_w(without) * full_speed_w / np.maximum(4.0 * full_fan_w, _LEAST_W)
    # Square roots give the power 5/16 for the cube root, which no compiled stage has.
    root = np.sqrt(np.sqrt(worth))
    worthwhile_w = full_speed_w * root * np.sqrt(np.sqrt(root))
    most_w = np.minimum(
        taken_w * np.minimum(over_k / np.maximum(full_range_k, range_k), 1.0), full_speed_w
    )
    short_w = load_w - without.heat_removed_w
    with_free = run(np.minimum(most_w, np.maximum(worthwhile_w, short_w)))
    return _mixed(without, with_free, _worthwhile(without, with_free, short_w))


def air_side(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
) -> WaterSideResult:
    """Step an air-side economiser: remove heat with outdoor air, and the rest with chilled water.

    Outdoor air replaces return air, as much as the heat requires and up to all of it:

        heat = rho V_outdoor (cp (T_return - T_outdoor) + h_fg (w_least - w_outdoor))

    Air that is drier than the lowest dew point is wetted by an adiabatic humidifier (second term),
    or stays outside if there is none. A hall contains no source of moisture, so its supply air
    takes on the moisture of the outdoor air. The dampers close gradually towards the limits of dew
    point and of relative humidity at the supply setpoint, see ``_admitted_share``.

    Moisture of outdoor air that condenses on coils at the chilled-water temperature is a load of
    the chiller. Coils that remove the heat Q bring the airflow V_c = Q/(rho cp (T_inlet -
    T_chilled)) to the temperature of their water, and the balance of moisture gives

        latent = rho h_fg (w_outdoor - w_saturated) V_outdoor V_c/(V_outdoor + V_c)

    The power of the fans for outdoor and exhaust air follows the affinity law; the heat of these
    fans leaves with the exhaust air. A chiller that draws c watts per watt of heat makes the
    airflow worthwhile at which the fans draw c watts more per watt of heat. ``_worthwhile`` decides
    whether outdoor air enters at all.
    """
    load_w = np.minimum(requested_w, design.cooling_w) if devices.limited else requested_w
    chilled_c = chilled_water_c(point.water_setpoint_c, design)
    vapour_pa = _vapour_pa(point.outdoor_c, point.wet_bulb_c, design.pressure_pa)
    ratio, least = (
        moist_air.vapour_ratio(pa, design.pressure_pa) for pa in (vapour_pa, design.least_vapour_pa)
    )
    lack = design.humidifier * np.maximum(least - ratio, 0.0)
    cooler_k = point.return_c - point.outdoor_c + lack * _WETTING_K
    over_w_s_m3 = design.air_j_per_m3_k * np.maximum(cooler_k, 0.0)
    wetter = np.maximum(ratio - moist_air.saturated_ratio(chilled_c, design.pressure_pa), 0.0)
    wetter_w_s_m3 = design.air_j_per_m3_k * wetter * _WETTING_K
    units = np.maximum(design.outdoor_units, LEAST_OUTDOOR_UNITS)
    full_m3s, full_fan_w = design.tower_air_m3s * units, design.tower_fan_w * units

    def run(outdoor_m3s: F64) -> WaterSideResult:
        free_w = outdoor_m3s * over_w_s_m3
        coil_w = load_w - free_w
        if devices.limited:
            coil_w = np.minimum(coil_w, design.pumped_w)
        mixed_c = point.return_c - free_w / (design.air_j_per_m3_k * point.airflow_m3s)
        cooled_k = np.maximum(np.maximum(mixed_c, point.setpoint_c) - chilled_c, _LEAST_K)
        dried_m3s = np.maximum(coil_w, 0.0) / (design.air_j_per_m3_k * cooled_k)
        total_m3s = np.maximum(outdoor_m3s + dried_m3s, _LEAST_M3S)
        latent_w = wetter_w_s_m3 * outdoor_m3s * dried_m3s / total_m3s
        taken_w, chilled_pump_w, _ = chilled_water_load_w(coil_w + latent_w, design)
        machine = _run_chiller(taken_w, chilled_c, point.outdoor_c, point, design, devices)
        wetted_kg_s = lack * outdoor_m3s * design.air_j_per_m3_k / moist_air.DRY_AIR_J_PER_KG_K
        return _dry(
            free_w + _removed_w(coil_w, machine, devices),
            free_w=free_w - latent_w,
            chiller_load_w=machine.evaporator_w if devices.limited else taken_w,
            machine=machine,
            chilled_c=chilled_c,
            outdoor_c=point.outdoor_c,
            fan_w=full_fan_w * (outdoor_m3s / full_m3s) ** 3,
            humidifier_kg_s=wetted_kg_s,
            chilled_pump_w=chilled_pump_w,
            condenser_pump_w=0.0 * load_w,
        )

    without = run(0.0 * load_w)
    short_w = load_w - without.heat_removed_w
    worth = _chiller_w_per_w(without) * over_w_s_m3 * full_m3s
    worthwhile_m3s = full_m3s * np.sqrt(worth / np.maximum(3.0 * full_fan_w, _LEAST_W))
    per_m3s_w = np.maximum(over_w_s_m3, _LEAST_K * design.air_j_per_m3_k)
    wanted_m3s = np.minimum(
        np.maximum(load_w, 0.0) / per_m3s_w, np.maximum(worthwhile_m3s, short_w / per_m3s_w)
    )
    most_m3s = np.minimum(point.airflow_m3s, design.tower_air_m3s * design.outdoor_units)
    with_free = run(np.minimum(wanted_m3s, most_m3s))
    admitted = _admitted_share(vapour_pa, point.setpoint_c, design)
    return _mixed(without, with_free, admitted * _worthwhile(without, with_free, short_w))


PLANTS: dict[str, PlantModel] = {
    "water_cooled": PlantModel(water_cooled, dry=False),
    "air_cooled": PlantModel(air_cooled, dry=True),
    "air_side": PlantModel(air_side, dry=True),
}
"""Plant models by their names, the valid values of ``hvac.plant``."""


def plant_of(chiller: ChillerModel) -> str:
    """Return the name of the default plant of a chiller."""
    return "water_cooled" if chiller.tower_water else "air_cooled"


def default_chiller(plant: PlantModel) -> str:
    """Return the name of the default chiller model of a plant."""
    return "eir_air_cooled" if plant.dry else "centrifugal_vsd"


def fits(chiller: ChillerModel, plant: PlantModel) -> bool:
    """Return True if the plant provides the medium that cools the chiller's condenser."""
    return chiller.outdoor_air if plant.dry else chiller.tower_water


def _run_chiller(
    load_w: F64,
    chilled_c: F64,
    condenser_c: F64,
    point: PlantPoint,
    design: WaterSideDesign,
    devices: Devices,
) -> ChillerResult:
    """Compute one step of the chiller from its load, in W, and water temperatures, in C, (B,)."""
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


def _chiller_w_per_w(result: WaterSideResult) -> F64:
    """Return the chiller power divided by the heat that the chiller removes, in W/W, (B,)."""
    return result.chiller_w / np.maximum(result.chiller_load_w, _LEAST_W)


def _worthwhile(without: WaterSideResult, with_free: WaterSideResult, short_w: F64) -> F64:
    """Return the share of the step during which a plant uses free cooling, 0..1, (B,).

    Free cooling runs all the time if the plant then needs less power. Otherwise it runs only as
    long as is necessary to remove ``short_w``, the heat in W, (B,), that the chiller alone cannot
    remove. The power of the plant is therefore never above its power without free cooling, unless
    the chiller is too small, and it changes without steps.
    """
    gain_w = with_free.heat_removed_w - without.heat_removed_w
    needed = np.clip(short_w / np.maximum(gain_w, _LEAST_W), 0.0, 1.0)
    return np.where(_power_w(with_free) < _power_w(without), 1.0, needed)


def _power_w(result: WaterSideResult) -> F64:
    """Return the power of all devices of a plant, in W, (B,)."""
    pumps_w = result.chilled_pump_w + result.condenser_pump_w
    return as_array(result.chiller_w + result.tower_fan_w + pumps_w)


def _mixed(without: WaterSideResult, with_free: WaterSideResult, share: F64) -> WaterSideResult:
    """Return the means over a step during a share of which, (B,), a plant uses free cooling."""
    first, second = fields_of(without), fields_of(with_free)
    return WaterSideResult(
        **{name: (1.0 - share) * first[name] + share * second[name] for name in first}
    )


def _admitted_share(vapour_pa: F64, setpoint_c: F64, design: WaterSideDesign) -> F64:
    """Return the share of the step during which the dampers admit outdoor air, 0..1, (B,).

    The supply air has the vapour pressure of the outdoor air and the temperature of the setpoint.
    The dampers are shut at the limits of dew point and relative humidity. They open over the tenth
    of the vapour pressure next to a limit, which is 7 points of relative humidity at a limit of
    70 %, and 1.6 K of dew point at 15 C. Near their open position they move slowly, because the
    first chillers that start again cost most.
    """
    most_pa = np.minimum(
        design.most_vapour_pa, design.most_humidity * moist_air.saturation_pa(setpoint_c)
    )
    least_pa = design.least_vapour_pa
    humid = np.clip((most_pa - vapour_pa) / (_DAMPER_BAND * most_pa), 0.0, 1.0)
    dry = np.clip((vapour_pa - least_pa) / (_DAMPER_BAND * least_pa), 0.0, 1.0)
    opened = humid * np.maximum(dry, design.humidifier)
    return as_array(opened * (2.0 - opened))


def _removed_w(load_w: F64, machine: ChillerResult, devices: Devices) -> F64:
    """Return the part of the coil load that the plant removes, in W, (B,)."""
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
    """Build the result of a dry plant, which has no tower water."""
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
    """Return the partial pressure of water vapour in outdoor air, in Pa, (B,)."""
    at_wet_bulb = moist_air.saturated_ratio(wet_bulb_c, pressure_pa)
    ratio = moist_air.humidity_ratio(outdoor_c, wet_bulb_c, at_wet_bulb)
    return as_array(pressure_pa * ratio / (moist_air.WATER_TO_DRY_AIR + ratio))
