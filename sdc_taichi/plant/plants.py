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
from sdc_taichi.plant.tower import TowerModel, TowerPoint, yorkcalc_largest_w, yorkcalc_reset_c
from sdc_taichi.plant.water_side import (
    LEAST_OUTDOOR_UNITS,
    WaterSideDesign,
    chilled_water_c,
    chilled_water_load_w,
    coil_capacity_w,
    economiser_share,
    loop_pump_w,
    warmth_w,
)
from sdc_taichi.types import F64, Values, WaterSideResult, as_array, fields_of

_WETTING_K = moist_air.VAPOUR_J_PER_KG / moist_air.DRY_AIR_J_PER_KG_K
"""Temperature drop of air by adiabatic humidification, divided by the rise of its humidity ratio in
kg/kg; in K."""
_DAMPER_BAND = 0.1
"""Proportional band of the dampers of outdoor air, as a share of the vapour pressure at a limit."""
_CLEARLY_LESS = 1.0 - 1e-9
"""Cost of an operation divided by that of another below which it counts as less."""
_LEAST_GAIN = 1e-9
"""Lower bound of a gain in removed heat, divided by the heat to remove."""
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
    warmed_k: F64 | None = None
    """Temperature of the chilled water above its setpoint at the coils, in K, (B,), whose heat is a
    part of the load; all valves are open then. None for water at its setpoint."""


class Devices(NamedTuple):
    """Models of the devices of a plant."""

    chiller: ChillerModel
    """Chiller model."""
    tower: TowerModel
    """Cooling tower model."""
    limited: bool
    """True if the capacity of the devices limits the heat that the plant removes."""
    reset: bool = False
    """True if the setpoint of the tower water follows load and weather, False if it is the coldest
    useful water down to a fixed approach."""


@dataclass(frozen=True, slots=True)
class PlantModel:
    """Plant model: its equations and the medium to which it rejects heat."""

    step: Callable[[F64, PlantPoint, WaterSideDesign, Devices], WaterSideResult]
    """Function that computes one step from the heat to remove, in W, (B,)."""
    dry: bool
    """True if the chiller rejects its heat to outdoor air, without a cooling tower."""
    outdoor_air: bool = False
    """True if free cooling takes heat from the air, so that no water carries it."""


def water_cooled(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
) -> WaterSideResult:
    """Step a water-cooled plant: remove up to ``requested_w`` and reject it by a cooling tower.

    The chilled-water temperature is setpoint - coil approach, limited to the warmest water that the
    chiller makes. The integrated economiser precools the return water with tower water, and the
    chiller removes the remaining heat. Economiser and chiller also remove the heat of the
    chilled-water pumps, which reduces the capacity available to the hall.

    The plant compares two setpoints of the tower water, one for the chiller alone and a colder one
    for the economiser, and takes the one with which chiller, tower fan and condenser pumps draw
    less, so free cooling never costs more than it saves. A watt of heat that stays in the hall
    counts as a watt of power, more than any chiller needs to remove it.

    The cells that work receive all of the water, however many have failed, and cool it as far as
    they can. Where they cannot reject all heat with water at ``max_condenser_c``, the chiller
    unloads to what they can.
    """
    load_w = (
        np.minimum(requested_w, _most_load_w(point, design)) if devices.limited else requested_w
    )
    chilled_c = chilled_water_c(point.water_setpoint_c, design)
    # The economiser is in the return pipe of the coils, upstream of the bypass of the chiller.
    taken_w, chilled_pump_w, range_ratio = chilled_water_load_w(
        load_w, design, limited=devices.limited, full_flow=point.warmed_k is not None
    )
    loop = _TowerLoop(
        taken_w, chilled_c, design.chilled_water_range_k * range_ratio, point, design, devices
    )
    alone, precooled = (loop.at(setpoint_c) for setpoint_c in loop.setpoints_c())
    pairs = zip(alone, precooled, strict=True)
    # The margin keeps rounding from choosing between equal operations.
    better = precooled.cost_w < alone.cost_w * _CLEARLY_LESS
    chosen = _Operation(*(np.where(better, y, x) for x, y in pairs))
    left_w = taken_w - chosen.economiser_w
    removed_w = np.maximum(load_w - chosen.unmet_w, 0.0) if devices.limited else load_w
    return WaterSideResult(
        heat_removed_w=removed_w,
        economiser_w=chosen.economiser_w,
        chiller_load_w=left_w - chosen.unmet_w if devices.limited else left_w,
        chiller_w=chosen.chiller_w,
        rejected_w=chosen.rejected_w,
        chilled_water_c=chilled_c,
        condenser_water_c=chosen.leaving_c,
        tower_range_k=chosen.range_k,
        tower_water_kg_s=chosen.water_kg_s,
        humidifier_kg_s=0.0 * taken_w,
        tower_airflow_m3s=chosen.airflow_m3s,
        tower_fan_w=chosen.fan_w,
        chilled_pump_w=chilled_pump_w,
        condenser_pump_w=chosen.pump_w,
    )


class _Operation(NamedTuple):
    """Operation of tower, economiser and chiller at one setpoint of the tower water."""

    economiser_w: F64
    """Heat that the economiser removes from the chilled water, in W, (B,)."""
    unmet_w: F64
    """Heat that neither economiser nor chiller removes, in W, (B,)."""
    chiller_w: F64
    """Power of the chiller, in W, (B,)."""
    rejected_w: F64
    """Heat of economiser and condenser, in W, (B,)."""
    leaving_c: F64
    """Temperature of the water that leaves the tower, in C, (B,)."""
    range_k: F64
    """Entering minus leaving temperature of the tower water, in K, (B,)."""
    water_kg_s: F64
    """Tower water flow, in kg/s, (B,)."""
    airflow_m3s: F64
    """Airflow into the tower, in m3/s, (B,)."""
    fan_w: F64
    """Power of the tower fan, in W, (B,)."""
    pump_w: F64
    """Power of the condenser-water pumps, in W, (B,)."""
    cost_w: F64
    """Power of chiller, tower fan and condenser pumps, plus the heat that stays, in W, (B,)."""


@dataclass(frozen=True, slots=True)
class _TowerLoop:
    """Loop of the tower water in one step, to which economiser and chiller reject their heat."""

    taken_w: F64
    """Heat of coils and chilled-water pumps, in W, (B,)."""
    chilled_c: F64
    """Chilled-water supply temperature, in C, (B,)."""
    range_k: F64
    """Chilled-water range at the coils, in K, (B,)."""
    point: PlantPoint
    """State of the hall's air and of the weather."""
    design: WaterSideDesign
    """Sized devices."""
    devices: Devices
    """Models of the devices."""

    def setpoints_c(self) -> tuple[F64, F64]:
        """Return the setpoints of the tower water for the chiller alone and for the economiser.

        With the reset they minimise the power of chiller and fan. Otherwise they are the coldest
        water that chiller or economiser can use, but at least wet bulb plus approach. Neither is
        colder than the water at full fan speed.
        """
        design = self.design
        nearest_c = self.point.wet_bulb_c + design.approach_min_k
        useful_c = self.chilled_c - design.exchanger_approach_k
        alone_c = np.maximum(nearest_c, design.min_condenser_c)
        precooled_c = np.maximum(nearest_c, useful_c)
        if self.devices.tower.water_loop:
            heat_w = self._chiller(self.taken_w, alone_c).rejected_w
            if self.point.warmed_k is not None:
                # The economiser may take heat of the coils that the chiller does not.
                coils_w = self.taken_w - warmth_w(self.point.warmed_k, design)
                heat_w = np.maximum(heat_w, np.minimum(coils_w, self._largest_load_w()))
            by_lift = (
                design.idle_w_per_w_k * design.chiller_w + design.load_w_per_w_k * self.taken_w
            )
            chiller_w = design.idle_w_per_w * design.chiller_w + design.load_w_per_w * self.taken_w
            by_share = chiller_w / self.range_k
            full_c, (best_alone_c, best_precooled_c) = yorkcalc_reset_c(
                heat_w, self._tower_point(heat_w, alone_c), (np.maximum(by_lift, 0.0), by_share)
            )
            if self.devices.reset:
                least_c = self._least_c()
                most_c = design.design_condenser_c
                alone_c = np.maximum(np.minimum(best_alone_c, most_c), least_c)
                precooled_c = np.maximum(np.minimum(best_precooled_c, most_c), useful_c)
                alone_c = self._capable_c(self.taken_w, alone_c, np.maximum(full_c, least_c))
            alone_c, precooled_c = np.maximum(alone_c, full_c), np.maximum(precooled_c, full_c)
        return alone_c, precooled_c

    def _least_c(self) -> F64:
        """Return the coldest condenser water that saves power of the chiller, in C, (B,).

        A chiller whose capacity is short in such cold water needs warmer water.
        """
        design, model = self.design, self.devices.chiller
        least_c = design.min_condenser_c
        if model.least_useful_c is not None:
            least_c = np.maximum(least_c, model.least_useful_c(self.chilled_c, design.machine))
        return self._capable_c(
            self.taken_w, least_c, np.maximum(least_c, design.fullest_condenser_c)
        )

    def at(self, setpoint_c: F64) -> _Operation:
        """Operate tower, economiser and chiller at a setpoint of the tower water, in C, (B,).

        Economiser and chiller receive water at the setpoint. Their heat depends on it, and the
        water of a tower at full speed on their heat, so its water may differ from the setpoint by
        some 0.1 K there; see ``setpoints_c``.
        """
        design = self.design
        share = design.economiser * economiser_share(
            self.chilled_c + self.range_k,
            chilled_water_c=self.chilled_c,
            tower_water_c=setpoint_c + design.exchanger_approach_k,
        )
        left_w, economiser_w = self.taken_w * (1.0 - share), self.taken_w * share
        machine = self._chiller(left_w, setpoint_c)
        rejected_w, unmet_w = economiser_w + machine.rejected_w, left_w - machine.evaporator_w
        tower_point = self._tower_point(rejected_w, setpoint_c)
        cooled = self.devices.tower.step(rejected_w, tower_point)
        pump_w = loop_pump_w(rejected_w, design.rejected_w, design.condenser_pump_w, design)
        return _Operation(
            economiser_w=economiser_w,
            unmet_w=unmet_w,
            chiller_w=machine.power_w,
            rejected_w=rejected_w,
            leaving_c=cooled.leaving_c,
            range_k=cooled.range_k,
            water_kg_s=as_array(tower_point.water_kg_s),
            airflow_m3s=cooled.air_ratio * tower_point.reference_air_m3s,
            fan_w=cooled.fan_w,
            pump_w=pump_w,
            cost_w=machine.power_w + cooled.fan_w + pump_w + unmet_w,
        )

    def _tower_point(self, heat_w: F64, setpoint_c: F64) -> TowerPoint:
        """Return the operating point of the working cells for the heat to reject, in W, (B,)."""
        design, point = self.design, self.point
        units = np.maximum(design.outdoor_units, LEAST_OUTDOOR_UNITS)
        flow_ratio = np.maximum(heat_w / design.rejected_w, design.pump_min_ratio)
        return TowerPoint(
            wet_bulb_c=point.wet_bulb_c,
            outdoor_c=point.outdoor_c,
            condenser_setpoint_c=setpoint_c,
            supply_setpoint_c=point.setpoint_c,
            water_kg_s=design.tower_water_kg_s * flow_ratio,
            reference_water_kg_s=design.tower_reference_kg_s * units,
            reference_air_m3s=design.tower_air_m3s * units,
            design_fan_w=design.tower_fan_w * units,
            air_j_per_m3_k=design.air_j_per_m3_k,
            cells_water_kg_s=design.tower_water_kg_s * units,
        )

    def _chiller(self, load_w: F64, water_c: F64) -> ChillerResult:
        """Compute one step of the chiller with tower water at ``water_c``, (B,).

        Head-pressure control: a bypass keeps the condenser water at or above the chiller's lowest
        temperature. Where the capacity is short there, the bypass warms the water towards the
        temperature of the largest capacity, as far as the load needs.
        """
        entering_c = np.maximum(water_c, self.design.min_condenser_c)
        if self.devices.limited:
            load_w = np.minimum(load_w, self._largest_load_w())
            warmest_c = np.maximum(entering_c, self.design.fullest_condenser_c)
            entering_c = self._capable_c(load_w, entering_c, warmest_c)
        return self._chiller_at(load_w, entering_c)

    def _capable_c(self, load_w: F64, water_c: F64, other_c: F64) -> F64:
        """Return water at ``water_c``, or as much closer to ``other_c`` as the load needs, (B,).

        Where the capacity of the chiller is short with the former and larger with the latter, the
        capacity in between is at least that of a straight line.
        """
        available_w, other_w = (
            self._chiller_at(load_w, each_c).available_w for each_c in (water_c, other_c)
        )
        gain_w = np.maximum(other_w - available_w, _LEAST_W)
        needed = np.clip((load_w - available_w) / gain_w, 0.0, 1.0)
        return water_c + (other_c - water_c) * np.where(other_w > available_w, needed, 0.0)

    def _largest_load_w(self) -> Values:
        """Return the load with which the condenser's heat just leaves at ``max_condenser_c``, (B,).

        The control of the head pressure unloads a chiller whose condenser becomes too warm, instead
        of letting it trip (Trane, CVGF-SVX03B-EN, "Condenser Limit").
        """
        design = self.design
        if not self.devices.tower.water_loop:
            return self.taken_w
        lowest_w = design.pump_min_ratio * design.rejected_w
        rejected_w = yorkcalc_largest_w(
            design.max_condenser_c,
            design.tower_range_k,
            self._tower_point(lowest_w, design.max_condenser_c),
        )
        working = np.minimum(design.outdoor_units / LEAST_OUTDOOR_UNITS, 1.0)
        return working * rejected_w * design.hot_evaporator_share

    def _chiller_at(self, load_w: F64, condenser_c: F64) -> ChillerResult:
        """Compute one step of the chiller with the given condenser water, (B,)."""
        return _run_chiller(
            load_w, self.chilled_c, condenser_c, self.point, self.design, self.devices
        )


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
    load_w = (
        np.minimum(requested_w, _most_load_w(point, design)) if devices.limited else requested_w
    )
    chilled_c = chilled_water_c(point.water_setpoint_c, design)
    taken_w, chilled_pump_w, range_ratio = chilled_water_load_w(
        load_w, design, limited=devices.limited, full_flow=point.warmed_k is not None
    )
    range_k = design.chilled_water_range_k * range_ratio
    over_k = np.maximum(chilled_c + range_k - point.outdoor_c, 0.0)
    full_range_k = design.chilled_water_range_k + design.dry_cooler_approach_k
    cooler_w = design.cooling_w + design.pump_heat_share * design.chilled_pump_w
    full_speed_w = design.economiser * _coolers_share(design) * cooler_w * over_k / full_range_k
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


def _coolers_share(design: WaterSideDesign) -> F64:
    """Return the heat of the working dry coolers divided by that of all, at full fan speed, (B,).

    The working coolers receive all of the water, so it leaves them warmer, and each removes more
    heat than at design. With the difference of the mean temperatures of water and air, the heat
    for each kelvin between entering water and air is 1/(1/(2 C) + (1/(2 C_air) + 1/UA)/u), with the
    share u of the coolers and the capacity flow C of the water. The design range and approach give
    the second resistance.
    """
    u, range_k = design.outdoor_units, design.chilled_water_range_k
    inlet_k = range_k + design.dry_cooler_approach_k
    return as_array(u * inlet_k / (inlet_k - 0.5 * range_k * (1.0 - u)))


def air_side(
    requested_w: F64, point: PlantPoint, design: WaterSideDesign, devices: Devices
) -> WaterSideResult:
    """Step an air-side economiser: remove heat with outdoor air, and the rest with chilled water.

    Outdoor air replaces return air, as much as the heat requires and up to all of it:

        heat = rho V_outdoor (cp (T_return - T_outdoor) + h_fg (w_least - w_outdoor))

    Air that is drier than the lowest dew point is wetted by an adiabatic humidifier (second term),
    or stays outside if there is none. A hall contains no source of moisture, so its supply air
    takes on the moisture of the outdoor air. The dampers close gradually towards the limits of dew
    point and of relative humidity at the supply setpoint, see ``admitted_share``.

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
    vapour_pa = outdoor_vapour_pa(point.outdoor_c, point.wet_bulb_c, design.pressure_pa)
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
            coil_w = np.minimum(coil_w, coil_capacity_w(design))
        mixed_c = point.return_c - free_w / (design.air_j_per_m3_k * point.airflow_m3s)
        cooled_k = np.maximum(np.maximum(mixed_c, point.setpoint_c) - chilled_c, _LEAST_K)
        dried_m3s = np.maximum(coil_w, 0.0) / (design.air_j_per_m3_k * cooled_k)
        total_m3s = np.maximum(outdoor_m3s + dried_m3s, _LEAST_M3S)
        latent_w = wetter_w_s_m3 * outdoor_m3s * dried_m3s / total_m3s
        taken_w, chilled_pump_w, _ = chilled_water_load_w(
            coil_w + latent_w, design, limited=devices.limited
        )
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
    admitted = admitted_share(vapour_pa, point.setpoint_c, design)
    return _mixed(without, with_free, admitted * _worthwhile(without, with_free, short_w))


def completed(result: WaterSideResult, fullest: WaterSideResult, wanted_w: F64) -> WaterSideResult:
    """Return means over a step in which the chilled water becomes as warm as the heat requires.

    Coils that offer more heat return more or warmer water, of which economiser, dry cooler or
    outdoor air remove more. Where a plant would remove less than ``wanted_w``, it therefore works
    with the heat of ``fullest`` for as long as is necessary.

    Args:
        result: Plant with a load of ``wanted_w``.
        fullest: The same plant with all the heat that coils and pumps can carry.
        wanted_w: Heat to remove, in W, (B,).
    """
    short_w = wanted_w - result.heat_removed_w
    gain_w = fullest.heat_removed_w - result.heat_removed_w
    # The lower bound keeps rounding errors from deciding where there is no more to gain.
    gain_w = np.maximum(gain_w, _LEAST_GAIN * np.maximum(wanted_w, 0.0) + _LEAST_W)
    return _mixed(result, fullest, as_array(np.clip(short_w / gain_w, 0.0, 1.0)))


PLANTS: dict[str, PlantModel] = {
    "water_cooled": PlantModel(water_cooled, dry=False),
    "air_cooled": PlantModel(air_cooled, dry=True),
    "air_side": PlantModel(air_side, dry=True, outdoor_air=True),
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


def _most_load_w(point: PlantPoint, design: WaterSideDesign) -> F64:
    """Return the largest heat that coils and chilled water bring to the plant, in W, (B,)."""
    capacity_w = coil_capacity_w(design)
    return capacity_w if point.warmed_k is None else capacity_w + warmth_w(point.warmed_k, design)


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


def _mixed(one: WaterSideResult, other: WaterSideResult, share: F64) -> WaterSideResult:
    """Return the means over a step during a share of which, (B,), a plant works as in ``other``."""
    first, second = fields_of(one), fields_of(other)
    return WaterSideResult(
        **{name: (1.0 - share) * first[name] + share * second[name] for name in first}
    )


def admitted_share(vapour_pa: F64, setpoint_c: F64, design: WaterSideDesign) -> F64:
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


def outdoor_vapour_pa(outdoor_c: F64, wet_bulb_c: F64, pressure_pa: F64) -> F64:
    """Return the partial pressure of water vapour in outdoor air, in Pa, (B,)."""
    at_wet_bulb = moist_air.saturated_ratio(wet_bulb_c, pressure_pa)
    ratio = moist_air.humidity_ratio(outdoor_c, wet_bulb_c, at_wet_bulb)
    return as_array(pressure_pa * ratio / (moist_air.WATER_TO_DRY_AIR + ratio))
