"""Parts that all plants share: sized devices, the result of a step, and the chilled-water loop.

Arrays of shape (B,) have one value per data center.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.plant.chiller import ChillerParameters
from sdc_taichi.types import F64, Values, as_array

LEAST_COIL_LOAD = 0.1
"""Coil load divided by design load below which the chilled-water range no longer changes."""
CYCLING_BELOW = 0.05
"""Heat of a water loop divided by its design heat below which its pumps cycle on and off."""
LEAST_PUMPED_W = 1e-3
"""Lower bound of the heat that the pumps can carry in equations that divide by it, in W."""
LEAST_RANGE = 1e-6
"""Lower bound of the range of chilled water at full flow, divided by the design range."""
LEAST_OUTDOOR_UNITS = 0.01
"""Lower bound of the share of outdoor units in equations that divide by it."""


@dataclass(frozen=True, slots=True)
class WaterSideDesign:
    """Sized devices of the plants of B data centers."""

    cooling_w: F64
    """Cooling capacity of coils, economiser and chilled-water pumps, in W, (B,)."""
    chiller_w: F64
    """Cooling capacity of the chiller at its reference point, in W, (B,)."""
    machine: ChillerParameters
    """Chiller parameters from the configuration."""
    rejected_w: F64
    """Heat that the plant rejects at design, in W, (B,)."""
    tower_water_kg_s: F64
    """Condenser water flow at design, in kg/s, (B,)."""
    tower_range_k: F64
    """Range of the tower at design, in K, (B,)."""
    tower_reference_kg_s: F64
    """Reference water flow of the tower's liquid-to-gas ratio, in kg/s, (B,)."""
    tower_air_m3s: F64
    """Airflow at full fan speed of the tower, or of the air-side economiser, in m3/s, (B,)."""
    tower_fan_w: F64
    """Fan power at full speed of the tower, dry cooler or air-side economiser, in W, (B,)."""
    air_j_per_m3_k: F64
    """Volumetric heat capacity of air, in J/(m3 K), (B,)."""
    chilled_pump_w: F64
    """Power of the chilled-water pumps at design flow, in W, (B,)."""
    condenser_pump_w: F64
    """Power of the condenser-water pumps, or of the pumps of the dry cooler, at design flow, in W,
    (B,)."""
    pump_min_ratio: F64
    """Lowest flow of the pumps divided by design flow, (B,); 1 means constant flow."""
    pump_heat_share: F64
    """Share of the power of the chilled-water pumps that heats the chilled water, 0..1, (B,)."""
    coil_approach_k: F64
    """Coil approach: supply air minus chilled-water supply temperature, in K, (B,)."""
    coil_rise_k: F64
    """Rise of the air temperature from supply to return at design, in K, (B,)."""
    chilled_water_range_k: F64
    """Chilled-water range at design: return minus supply temperature, in K, (B,)."""
    coil_valves: F64
    """1 if valves adapt the water flow of the coils to their load, 0 if the range of the chilled
    water is fixed, (B,)."""
    approach_min_k: F64
    """Smallest tower approach: leaving water minus wet-bulb temperature, in K, (B,)."""
    exchanger_approach_k: F64
    """Economiser approach: precooled water minus tower water temperature, in K, (B,)."""
    min_condenser_c: F64
    """Lowest condenser-water temperature that the chiller allows, in C, (B,)."""
    fullest_condenser_c: F64
    """Condenser-water temperature at which the chiller has its largest capacity, in C, (B,)."""
    max_condenser_c: F64
    """Highest condenser-water temperature that the chiller allows, in C, (B,)."""
    design_condenser_c: F64
    """Condenser-water temperature at the design point, in C, (B,)."""
    hot_evaporator_share: F64
    """Heat taken from the chilled water divided by the heat of the condenser, with condenser water
    at ``max_condenser_c``, (B,)."""
    idle_w_per_w_k: F64
    """Growth of the chiller's power with the temperature of its condenser water, extrapolated to no
    load, divided by its reference capacity, in 1/K, (B,)."""
    load_w_per_w_k: F64
    """Growth of that growth with the load, in 1/K, (B,)."""
    idle_w_per_w: F64
    """Power of the chiller with the coldest condenser water that it allows, extrapolated to no
    load, divided by its reference capacity, in W/W, (B,)."""
    load_w_per_w: F64
    """Growth of the power with the load at that temperature, in W/W, (B,)."""
    warmest_chilled_c: F64
    """Highest chilled-water temperature that the chiller makes, in C, (B,)."""
    economiser: F64
    """1 with a water-side economiser or free cooling by a dry cooler, 0 without, (B,)."""
    pumped_w: F64
    """Heat that the working chilled-water pumps carry at the design range, in W, (B,); equal to
    ``cooling_w`` if all pumps work."""
    outdoor_units: F64
    """Working share of the tower cells, dry coolers or outdoor air intakes, 0..1, (B,)."""
    dry_cooler_approach_k: F64
    """Approach of dry cooler and heat exchanger: chilled water minus outdoor air, in K, (B,)."""
    pressure_pa: F64
    """Air pressure of the site, in Pa, (B,)."""
    least_vapour_pa: F64
    """Smallest vapour pressure at which the plant uses outdoor air, in Pa, (B,)."""
    most_vapour_pa: F64
    """Largest vapour pressure at which the plant uses outdoor air, in Pa, (B,)."""
    humidifier: F64
    """1 if the plant humidifies outdoor air that is too dry, 0 if it rejects such air, (B,)."""
    most_humidity: F64
    """Largest relative humidity of outdoor air heated to the supply setpoint, 0..1, (B,)."""
    facility_water_w: Values = 0.0
    """Part of ``cooling_w`` that cools the facility water of liquid-cooled racks instead of coils,
    in W, (B,)."""

    @property
    def coils_w(self) -> F64:
        """Cooling capacity of the coils, in W, (B,)."""
        return as_array(self.cooling_w - self.facility_water_w)


def chilled_water_c(setpoint_c: F64, design: WaterSideDesign) -> F64:
    """Return the chilled-water supply temperature, in C, (B,).

    It is the supply setpoint minus the coil approach, limited to the warmest water of the chiller.

    Args:
        setpoint_c: CRAC supply setpoint, C, (B,).
        design: Sized devices.
    """
    return np.minimum(setpoint_c - design.coil_approach_k, design.warmest_chilled_c)


def coil_range_ratio(load_w: Values, design: WaterSideDesign) -> F64:
    """Return the chilled-water range at the coils divided by the design range, (B,).

    The ratio is 1 without valves. With valves, coils at part load need less water, which leaves
    them warmer, and the range is proportional to the load to the power -1/4. From full load down to
    a fifth, this agrees within 3 % with a counterflow coil whose airflow is proportional to its
    load. That coil has equal thermal resistances on both sides at design, proportional to the
    airflow to the power -0.8 and to the water flow to the power -0.85 (Wetter 1999, "Simulation
    model: finned water-air-coil without condensation", LBNL).

    Args:
        load_w: Heat that the coils remove from the air, W, (B,).
        design: Sized devices.
    """
    share = np.clip(load_w / design.cooling_w, LEAST_COIL_LOAD, 1.0)
    return as_array(1.0 + design.coil_valves * (1.0 / np.sqrt(np.sqrt(share)) - 1.0))


def economiser_share(
    return_water_c: Values, *, chilled_water_c: Values, tower_water_c: Values
) -> F64:
    """Return the share of the cooling load that an integrated water-side economiser removes.

    A heat exchanger upstream of the chiller precools the return water with tower water, and the
    chiller removes the remaining heat.

    Args:
        return_water_c: Return temperature of the chilled water, C, (B,).
        chilled_water_c: Supply temperature of the chilled water, C, (B,).
        tower_water_c: Lowest temperature that the exchanger can reach: wet bulb plus the approaches
            of tower and exchanger, C, (B,).

    Returns:
        Share 0..1, (B,), and 0 where the return water is no warmer than the supply water.
    """
    span_k = as_array(return_water_c - chilled_water_c)
    loaded = span_k > 0.0
    precooled_k = return_water_c - tower_water_c
    return as_array(
        np.where(loaded, np.clip(precooled_k / np.where(loaded, span_k, 1.0), 0.0, 1.0), 0.0)
    )


def hydraulic_pump_w(pressure_pa: Values, flow_m3s: Values, *, efficiency: Values) -> F64:
    """Return the pump power, in W: pressure drop times volume flow divided by efficiency.

    With the SustainDC configuration (300 kPa, 1.1 l/s, 0.87) the result is 379.31 W per pump. The
    released code computes this power but omits it from its HVAC total.

    Args:
        pressure_pa: Pressure drop of the circuit, Pa.
        flow_m3s: Water flow, m3/s.
        efficiency: Efficiency of pump and motor together, above 0.

    Returns:
        Electric power, W, (B,).
    """
    return as_array(pressure_pa * flow_m3s / efficiency)


def loop_pump_w(heat_w: F64, design_heat_w: F64, design_w: F64, design: WaterSideDesign) -> F64:
    """Return the pump power of a loop whose flow is proportional to its heat, in W, (B,).

    By the affinity law, power is proportional to the cube of the flow (ASHRAE Handbook, HVAC
    Systems and Equipment, chapter "Centrifugal pumps"), down to the lowest flow of the pumps. For
    less heat than ``CYCLING_BELOW`` of design, the pumps cycle on and off, like the chiller.

    Args:
        heat_w: Heat that the loop would carry at its flow and design range, W, (B,); the pumps are
            off where it is 0.
        design_heat_w: Heat that the loop carries at design flow, W, (B,).
        design_w: Power of the pumps at design flow, W, (B,).
        design: Sized devices.
    """
    heat_ratio = np.maximum(heat_w / design_heat_w, 0.0)
    flow_ratio = np.maximum(heat_ratio, design.pump_min_ratio)
    on_share = np.minimum(heat_ratio / CYCLING_BELOW, 1.0)
    return as_array(on_share * (design_w * flow_ratio**3))


def coil_capacity_w(design: WaterSideDesign) -> F64:
    """Return the heat that the coils remove with the flow of the working pumps, in W, (B,).

    With less water, its range grows, and its film resists the heat more. The heat of a coil for
    each kelvin between return air and chilled water is 1/(1/(2 C) + 1/(2 C_air) + 1/UA), with the
    difference of the mean temperatures of air and water. The design point gives the three
    resistances: half the range of the water, half the rise of the air, and the rest of the
    difference of the means, of which half is in the film of the water and grows with its flow to
    the power -3/4 (see ``coil_range_ratio``). Air side and inlet temperatures are those of the
    design point, at which full flow gives ``cooling_w``.
    """
    flow = design.pumped_w / design.cooling_w
    water_k, air_k = 0.5 * design.chilled_water_range_k, 0.5 * design.coil_rise_k
    wall_k = 0.5 * np.maximum(design.coil_approach_k + air_k - water_k, 0.0)
    # All resistances are multiplied by the flow, which may be 0.
    resistance_k = water_k + flow * (air_k + wall_k) + np.sqrt(np.sqrt(flow)) * wall_k
    whole_k = water_k + (air_k + wall_k) + wall_k
    return as_array(design.cooling_w * (flow * whole_k / resistance_k))


def warmth_w(warmed_k: F64, design: WaterSideDesign) -> F64:
    """Return the heat that the working pumps bring from a loop above its setpoint, in W, (B,).

    Water that supplies the coils ``warmed_k`` too warm returns warmer by as much.

    Args:
        warmed_k: Temperature of the chilled water minus its setpoint, K, (B,).
        design: Sized devices.
    """
    return as_array(design.pumped_w * warmed_k / design.chilled_water_range_k)


def chilled_water_load_w(
    load_w: F64, design: WaterSideDesign, *, limited: bool, full_flow: bool = False
) -> tuple[F64, F64, F64]:
    """Return the load of economiser and chiller: the heat of the coils and of the pumps.

    The shaft power of a pump heats the water, but the losses of its motor do not (EnergyPlus
    Engineering Reference, "Pumps").

    Args:
        load_w: Heat that the coils remove from the air, W, (B,).
        design: Sized devices.
        limited: True if the working pumps limit the flow, and the range grows instead.
        full_flow: True if all valves are open, so that the working pumps give all of their flow.

    Returns:
        Heat to remove from the chilled water, W, (B,); power of the chilled-water pumps, W, (B,);
        and the chilled-water range at the coils divided by the design range, (B,).
    """
    range_ratio = coil_range_ratio(load_w, design)
    flow_w = load_w / range_ratio
    if limited:
        at_full_flow = load_w / np.maximum(design.pumped_w, LEAST_PUMPED_W)
        range_ratio = np.maximum(LEAST_RANGE if full_flow else range_ratio, at_full_flow)
        flow_w = design.pumped_w if full_flow else load_w / range_ratio
    power_w = loop_pump_w(flow_w, design.cooling_w, design.chilled_pump_w, design)
    return load_w + design.pump_heat_share * power_w, power_w, range_ratio
