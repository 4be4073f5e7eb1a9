"""Parts that all plants share: sized devices, the result of a step, and the chilled-water loop."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.plant.chiller import ChillerParameters
from sdc_taichi.types import F64, Values, as_array

LEAST_COIL_LOAD = 0.1
"""Load of the coils divided by that at design below which the range of their water is constant."""
LEAST_OUTDOOR_UNITS = 0.01
"""Smallest share of outdoor units with which equations are evaluated, so that none divides by 0."""


@dataclass(frozen=True, slots=True)
class WaterSideDesign:
    """Sized devices of the plants of B data centers."""

    cooling_w: F64
    """Cooling capacity of coils, heat exchanger and chilled-water pumps, in W, (B,)."""
    chiller_w: F64
    """Cooling capacity of the chiller at its reference point, in W, (B,)."""
    machine: ChillerParameters
    """Parameters of the chiller that the configuration gives."""
    rejected_w: F64
    """Heat that the plant rejects at design, in W, (B,)."""
    tower_water_kg_s: F64
    """Condenser water flow at design, in kg/s, (B,)."""
    tower_reference_kg_s: F64
    """Water flow at which the water flow ratio of the tower is 1, in kg/s, (B,)."""
    tower_air_m3s: F64
    """Airflow of the tower, or outdoor air let in, at full fan speed, in m3/s, (B,)."""
    tower_fan_w: F64
    """Power of the fans of tower, dry cooler or outdoor air at full speed, in W, (B,)."""
    air_j_per_m3_k: F64
    """Heat capacity of air per volume, in J/(m3 K), (B,)."""
    chilled_pump_w: F64
    """Power of the chilled-water pumps at design flow, in W, (B,)."""
    condenser_pump_w: F64
    """Power of the pumps of condenser water, or of the dry cooler's loop, at design flow, in W,
    (B,)."""
    pump_min_ratio: F64
    """Lowest flow of the pumps over design flow, (B,); 1 is constant flow."""
    pump_heat_share: F64
    """Share of the power of the chilled-water pumps that warms the chilled water, 0..1, (B,)."""
    coil_approach_k: F64
    """Coil approach: supply air temperature less that of the chilled water, in K, (B,)."""
    chilled_water_range_k: F64
    """Return less supply temperature of the chilled water at design, in K, (B,)."""
    coil_valves: F64
    """1 if valves let coils take the water that they need, 0 with a fixed range of it, (B,)."""
    approach_min_k: F64
    """Lowest approach of the tower, leaving water over wet bulb, in K, (B,)."""
    exchanger_approach_k: F64
    """Approach of the economiser, precooled water over tower water, in K, (B,)."""
    min_condenser_c: F64
    """Coldest condenser water that the chiller takes, in C, (B,)."""
    fullest_condenser_c: F64
    """Condenser water at which the chiller has most capacity, in C, (B,)."""
    warmest_chilled_c: F64
    """Warmest chilled water that the chiller makes, in C, (B,)."""
    economiser: F64
    """1 with a waterside economiser or free cooling by a dry cooler, 0 without, (B,)."""
    pumped_w: F64
    """Heat that the chilled-water pumps in order carry, in W, (B,); ``cooling_w`` with all."""
    outdoor_units: F64
    """Share of tower cells, dry coolers or openings for outdoor air that is in order, 0..1,
    (B,)."""
    dry_cooler_approach_k: F64
    """Approach of dry cooler and heat exchanger, chilled water over outdoor air, in K, (B,)."""
    pressure_pa: F64
    """Air pressure of the site, in Pa, (B,)."""
    least_vapour_pa: F64
    """Least vapour pressure of outdoor air that is let in, in Pa, (B,)."""
    most_vapour_pa: F64
    """Largest vapour pressure of outdoor air that is let in, in Pa, (B,)."""
    humidifier: F64
    """1 if outdoor air that is too dry is wetted, 0 if it is left outside, (B,)."""
    most_humidity: F64
    """Largest relative humidity of outdoor air at the supply setpoint, 0..1, (B,)."""


def chilled_water_c(setpoint_c: F64, design: WaterSideDesign) -> F64:
    """Chilled water that the coils take, up to the warmest that the chiller makes, in C, (B,).

    Args:
        setpoint_c: CRAC supply setpoint, C, (B,).
        design: Sized devices.
    """
    return np.minimum(setpoint_c - design.coil_approach_k, design.warmest_chilled_c)


def coil_range_ratio(load_w: Values, design: WaterSideDesign) -> F64:
    """Range of the chilled water at the coils divided by that at design, (B,).

    It is 1 with a fixed range. A coil that is larger than its load needs little water, which leaves
    it warmer: the range rises as the load to the power -1/4. That is within 3 % of a counterflow
    coil whose airflow follows its load, from full load down to a fifth, with resistances alike on
    both sides at design that go with the airflow to the power -0.8 and with the water flow to the
    power -0.85 (Wetter 1999, "Simulation model: finned water-air-coil without condensation", LBNL).

    Args:
        load_w: Heat that the coils take, W, (B,).
        design: Sized devices.
    """
    share = np.clip(load_w / design.cooling_w, LEAST_COIL_LOAD, 1.0)
    return as_array(1.0 + design.coil_valves * (1.0 / np.sqrt(np.sqrt(share)) - 1.0))


def economiser_share(
    return_water_c: Values, *, chilled_water_c: Values, tower_water_c: Values
) -> F64:
    """Share of the cooling load that an integrated waterside economiser takes off the chiller.

    A heat exchanger in series ahead of the chiller precools the return water to the temperature
    tower water can give it; the chiller does the rest.

    Args:
        return_water_c: Chilled water coming back from the room, C, (B,).
        chilled_water_c: Chilled water supply, C, (B,).
        tower_water_c: Lowest temperature the exchanger can reach, wet bulb plus the approach of
            tower and exchanger, C, (B,).

    Returns:
        Share 0..1, (B,), and 0 where the water does not come back warmer than it left.
    """
    span_k = as_array(return_water_c - chilled_water_c)
    loaded = span_k > 0.0
    precooled_k = return_water_c - tower_water_c
    return as_array(
        np.where(loaded, np.clip(precooled_k / np.where(loaded, span_k, 1.0), 0.0, 1.0), 0.0)
    )


def hydraulic_pump_w(pressure_pa: Values, flow_m3s: Values, *, efficiency: Values) -> F64:
    """Pump power at a working point, W: pressure drop times volume flow over efficiency.

    With the SustainDC configuration (300 kPa, 1.1 l/s, 0.87) this is 379.31 W per pump, which the
    released code computes and leaves out of its HVAC total.

    Args:
        pressure_pa: Pressure drop of the circuit, Pa.
        flow_m3s: Water flow, m3/s.
        efficiency: Efficiency of pump and motor together, above 0.

    Returns:
        Electric power, W, (B,).
    """
    return as_array(pressure_pa * flow_m3s / efficiency)


def loop_pump_w(heat_w: F64, design_heat_w: F64, design_w: F64, design: WaterSideDesign) -> F64:
    """Power of the pumps of a loop, W, (B,), whose flow follows the heat that it carries.

    Affinity law: power in proportion to the cube of the flow (ASHRAE Handbook, HVAC Systems and
    Equipment, chapter "Centrifugal pumps"), down to the lowest flow of the pumps.

    Args:
        heat_w: Heat that the loop would carry with its range at design, W, (B,); without any its
            pumps stand still.
        design_heat_w: Heat that it carries at design flow, W, (B,).
        design_w: Power of the pumps at design flow, W, (B,).
        design: Sized devices.
    """
    running = np.greater(heat_w, 0.0)
    flow_ratio = np.maximum(heat_w / design_heat_w, design.pump_min_ratio)
    return as_array(np.where(running, design_w * flow_ratio**3, 0.0))


def chilled_water_load_w(load_w: F64, design: WaterSideDesign) -> tuple[F64, F64, F64]:
    """Heat that economiser and chiller take off the chilled water: that of the coils and the pumps.

    The power at the shaft of a pump ends as heat of the water; the losses of its motor do not
    (EnergyPlus Engineering Reference, "Pumps").

    Args:
        load_w: Heat that the coils take, W, (B,).
        design: Sized devices.

    Returns:
        Heat to take off the chilled water, W, (B,); power of its pumps, W, (B,); and the range of
        the water at the coils divided by that at design, (B,).
    """
    range_ratio = coil_range_ratio(load_w, design)
    flow_w = load_w / range_ratio
    power_w = loop_pump_w(flow_w, design.cooling_w, design.chilled_pump_w, design)
    return load_w + design.pump_heat_share * power_w, power_w, range_ratio
