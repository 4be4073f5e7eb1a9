"""Power of CRAC fans and pumps.

Arguments are float64 arrays of shape (B,), or anything that broadcasts to it. Fans and pumps
follow the affinity law: power in proportion to the cube of the flow (ASHRAE Handbook, HVAC Systems
and Equipment, chapters "Fans" and "Centrifugal pumps").
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.types import F64, Values, as_array


def crac_fan_w(flow_m3s: Values, *, design_flow_m3s: Values, design_w: Values) -> F64:
    """CRAC fan power by the affinity law, W.

    The released SustainDC code applies the same cube to its flow per watt of IT load, without
    scaling it to the room: 150 W * (5.663e-5/9.438e-5)^3 = 32.4 W for the whole data center.

    Args:
        flow_m3s: Airflow, m3/s, at least 0.
        design_flow_m3s: Airflow at design power, m3/s, above 0.
        design_w: Fan power at that airflow, W.

    Returns:
        Fan power design_w * (flow/design)^3, W, (B,).
    """
    return as_array(design_w * (flow_m3s / design_flow_m3s) ** 3)


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


def pump_w(flow: Values, *, design_flow: Values, design_w: Values, min_flow_ratio: Values) -> F64:
    """Variable-speed pump by the affinity law, W, with a lowest speed.

    Args:
        flow: Water flow, in any unit; 0 switches the pump off.
        design_flow: Water flow at design power, same unit, above 0.
        design_w: Pump power at that flow, W.
        min_flow_ratio: Lowest flow over design flow while the pump runs.

    Returns:
        Pump power design_w * max(flow/design, min_flow_ratio)^3, W, (B,), or 0 without flow.
    """
    running = np.greater(flow, 0.0)
    return as_array(
        np.where(running, design_w * np.maximum(flow / design_flow, min_flow_ratio) ** 3, 0.0)
    )
