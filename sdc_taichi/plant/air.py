"""Fans, pumps and the waterside economiser: pure functions over the batch.

Arguments are float64 arrays of shape (B,), or anything that broadcasts to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sdc_taichi.types import as_array

Array = NDArray[np.float64]
Values = Array | float


def crac_fan_w(flow_m3s: Values, *, design_flow_m3s: Values, design_w: Values) -> Array:
    """CRAC fan power by the affinity law, W.

    The released SustainDC code applies the same cube to its flow per watt of IT load, without
    scaling it to the room: 150 W * (5.663e-5/9.438e-5)^3 = 32.4 W for the whole data center.

    Args:
        flow_m3s: Airflow, m3/s, at least 0.
        design_flow_m3s: Airflow at design power, m3/s, above 0.
        design_w: Fan power at that airflow, W.

    Returns:
        design_w * (flow/design)^3.
    """
    return as_array(design_w * (flow_m3s / design_flow_m3s) ** 3)


def hydraulic_pump_w(pressure_pa: Values, flow_m3s: Values, *, efficiency: Values) -> Array:
    """Pump power at a working point, W: pressure drop times volume flow over efficiency.

    With the SustainDC configuration (300 kPa, 1.1 l/s, 0.87) this is 379.31 W per pump, which the
    released code computes and leaves out of its HVAC total.

    Args:
        pressure_pa: Pressure drop of the circuit, Pa.
        flow_m3s: Water flow, m3/s.
        efficiency: Of pump and motor, above 0.

    Returns:
        Electric power, W.
    """
    return as_array(pressure_pa * flow_m3s / efficiency)


def pump_w(flow: Values, *, design_flow: Values, design_w: Values, min_flow_ratio: Values) -> Array:
    """Variable-speed pump by the affinity law, W, with a lowest speed.

    Args:
        flow: Water flow, in any unit; 0 switches the pump off.
        design_flow: Water flow at design power, same unit, above 0.
        design_w: Pump power at that flow, W.
        min_flow_ratio: Lowest flow over design flow while the pump runs.

    Returns:
        design_w * max(flow/design, min_flow_ratio)^3, or 0 without flow.
    """
    running = np.greater(flow, 0.0)
    return as_array(
        np.where(running, design_w * np.maximum(flow / design_flow, min_flow_ratio) ** 3, 0.0)
    )


def economiser_share(
    return_water_c: Values, *, chilled_water_c: Values, tower_water_c: Values
) -> Array:
    """Share of the cooling load an integrated waterside economiser takes off the chiller.

    A heat exchanger in series ahead of the chiller precools the return water to the temperature
    tower water can give it; the chiller does the rest.

    Args:
        return_water_c: Chilled water coming back from the room, C.
        chilled_water_c: Chilled water supply, C.
        tower_water_c: Lowest temperature the exchanger can reach, wet bulb plus the approach of
            tower and exchanger, C.

    Returns:
        0..1, and 0 where the water does not come back warmer than it left.
    """
    span_k = as_array(return_water_c - chilled_water_c)
    loaded = span_k > 0.0
    precooled_k = return_water_c - tower_water_c
    return as_array(
        np.where(loaded, np.clip(precooled_k / np.where(loaded, span_k, 1.0), 0.0, 1.0), 0.0)
    )
