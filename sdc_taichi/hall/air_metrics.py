"""Indices of air management in a hall: SHI, RHI, RTI, RCI, and the temperature ranges of ASHRAE.

The indices are functions of sums per data center, which the simulator carries; functions of inlets
and flows make these sums from racks.
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.kernels import hall_arguments
from sdc_taichi.types import F64, Reals, Values, as_array

RECOMMENDED_C = hall_arguments.RECOMMENDED_C
"""Lowest and highest recommended inlet, in C (ASHRAE TC 9.9 Thermal Guidelines, 2021)."""
ALLOWABLE_C = {"A1": (15.0, 32.0), "A2": (10.0, 35.0), "A3": (5.0, 40.0), "A4": (5.0, 45.0)}
"""Lowest and highest allowable inlet, in C, by class (ASHRAE TC 9.9 Thermal Guidelines, 2021)."""

TIE_K = 0.05
"""Difference up to which racks count as equally hot, in K; figures with one decimal do not show
it."""
_USUAL_CLASS = "A2"
LEAST_EXCESS_K = 1e-5
"""Smallest excess over a limit that counts, in K: in f32 an inlet at the limit may lie above it by
two units of the last digit, 4e-6 K."""
_ROUND_OFF_K = 1e-4
"""Mean rises up to this, in K and of either sign, count as 0: f32 temperatures do not resolve
smaller ones, and their last bits depend on the order of sums."""
_NO_AIRFLOW_M3S = 1e-9
"""Airflow up to this, in m3/s, counts as none."""


def allowable_c(ashrae_class: str | None) -> tuple[float, float]:
    """Lowest and highest allowable inlet of a class of ``ALLOWABLE_C``, in C; None is A2."""
    return ALLOWABLE_C[ashrae_class or _USUAL_CLASS]


def rank(temperature_c: Reals) -> F64:
    """Rank of temperatures by which they are compared, as in ``kernels.sums.rank``.

    Temperatures of equal racks differ in their last bits, which depend on the processor. Their
    ranks, in steps of 1/``RANKS_PER_K`` K, agree, so that the first of equal racks is the hottest.

    Args:
        temperature_c: Temperatures, C, of any shape.

    Returns:
        A whole number for each, the higher the hotter.
    """
    return np.asarray(np.floor(temperature_c * hall_arguments.RANKS_PER_K + 0.5))


def rise_m3k_s(airflow_m3s: Reals, temperature_c: Reals, supply_c: Values) -> F64:
    """Flow-weighted temperature above the supply air, sum V*(T - T_sup); times rho*cp it is heat.

    Args:
        airflow_m3s: Airflow of each rack, m3/s, (..., N).
        temperature_c: Inlet or outlet temperature of each rack, C, same shape.
        supply_c: Supply air, C, one for all or (..., 1).

    Returns:
        Sum over the racks, m3 K/s, (...).
    """
    return np.asarray((airflow_m3s * (temperature_c - supply_c)).sum(axis=-1))


def over_27_sum_k(inlet_c: F64) -> F64:
    """Sum over the racks of the inlet temperature in excess of 27 C, in K, (...).

    Args:
        inlet_c: Inlet temperature of each rack, C, (..., N).
    """
    return np.asarray(np.maximum(inlet_c - RECOMMENDED_C[1], 0.0).sum(axis=-1))


def under_18_sum_k(inlet_c: F64) -> F64:
    """Sum over the racks of the difference of 18 C and colder inlet temperatures, in K, (...).

    Args:
        inlet_c: Inlet temperature of each rack, C, (..., N).
    """
    return np.asarray(np.maximum(RECOMMENDED_C[0] - inlet_c, 0.0).sum(axis=-1))


def shi(inlet_rise_m3k_s: Values, outlet_rise_m3k_s: Values, airflow_m3s: Values) -> F64:
    """Supply heat index, sum V*(T_in - T_sup) / sum V*(T_out - T_sup).

    The share of the heat in the exhaust that the air had before it reached the racks (Sharma, Bash
    and Patel 2002, "Dimensionless parameters for evaluation of thermal design and performance of
    large-scale data centers", AIAA 2002-3091): 0 without recirculation.

    Args:
        inlet_rise_m3k_s: ``rise_m3k_s`` of the inlets, m3 K/s.
        outlet_rise_m3k_s: ``rise_m3k_s`` of the outlets, m3 K/s.
        airflow_m3s: Sum of the airflow of the racks, m3/s.

    Returns:
        SHI, dimensionless, and 0 where inlets or outlets have no mean rise beyond round-off, as
        without load or airflow.
    """
    round_off_m3k_s = np.multiply(airflow_m3s, _ROUND_OFF_K)
    inlets_differ = np.maximum(inlet_rise_m3k_s, np.negative(inlet_rise_m3k_s)) > round_off_m3k_s
    share = _ratio(inlet_rise_m3k_s, outlet_rise_m3k_s, round_off_m3k_s)
    return as_array(np.where(inlets_differ, share, 0.0))


def rhi(inlet_rise_m3k_s: Values, outlet_rise_m3k_s: Values, airflow_m3s: Values) -> F64:
    """Return heat index, 1 - SHI, dimensionless (Sharma, Bash and Patel 2002).

    Args:
        inlet_rise_m3k_s: ``rise_m3k_s`` of the inlets, m3 K/s.
        outlet_rise_m3k_s: ``rise_m3k_s`` of the outlets, m3 K/s.
        airflow_m3s: Sum of the airflow of the racks, m3/s.
    """
    return as_array(1.0 - shi(inlet_rise_m3k_s, outlet_rise_m3k_s, airflow_m3s))


def it_rise_k(inlet_rise_m3k_s: Values, outlet_rise_m3k_s: Values, airflow_m3s: Values) -> F64:
    """Flow-weighted temperature rise through the equipment, sum V*(T_out - T_in) / sum V, K.

    Args:
        inlet_rise_m3k_s: ``rise_m3k_s`` of the inlets, m3 K/s.
        outlet_rise_m3k_s: ``rise_m3k_s`` of the outlets, m3 K/s.
        airflow_m3s: Sum of the airflow of the racks, m3/s.

    Returns:
        Rise, K, and 0 where there is no airflow.
    """
    return _ratio(np.subtract(outlet_rise_m3k_s, inlet_rise_m3k_s), airflow_m3s, _NO_AIRFLOW_M3S)


def rti(return_c: Values, supply_c: Values, it_rise_k: Values) -> F64:
    """Return temperature index, 100*(T_ret - T_sup)/dT_IT, %.

    Herrlin 2008, "Airflow and cooling performance of data centers: two performance metrics", ASHRAE
    Transactions 114(2). Above 100 % air recirculates on balance, below it bypasses the equipment.

    Args:
        return_c: Return air of the CRAC units, C.
        supply_c: Supply air of the CRAC units, C.
        it_rise_k: ``it_rise_k`` of the equipment, K.

    Returns:
        RTI, %, and 0 where the equipment does not warm its air: all that is supplied bypasses it.
    """
    return 100.0 * _ratio(np.subtract(return_c, supply_c), it_rise_k, _ROUND_OFF_K)


def rci_hi(over_k: Values, racks: Values, *, allowable_c: Values) -> F64:
    """Rack cooling index at the high end, 100*(1 - over/(n*(T_allowable - T_recommended))), %.

    Herrlin 2005, "Rack cooling effectiveness in data centers and telecom central offices: the Rack
    Cooling Index (RCI)", ASHRAE Transactions 111(2). 100 is no inlet above the recommended range; 0
    is over-temperatures that average to the allowable limit, and worse is negative.

    Args:
        over_k: Sum over the inlets of their excess over 27 C, K.
        racks: Number of inlets in the sum, at least 1.
        allowable_c: Upper end of the allowable range, C, above 27.
    """
    return as_array(100.0 * (1.0 - over_k / (racks * (allowable_c - RECOMMENDED_C[1]))))


def rci_lo(under_k: Values, racks: Values, *, allowable_c: Values) -> F64:
    """Rack cooling index at the low end, 100*(1 - under/(n*(T_recommended - T_allowable))), %.

    Herrlin 2005, "Rack cooling effectiveness in data centers and telecom central offices: the Rack
    Cooling Index (RCI)", ASHRAE Transactions 111(2). 100 is no inlet below the recommended range.

    Args:
        under_k: Sum over the inlets colder than 18 C of their difference from it, K.
        racks: Number of inlets in the sum, at least 1.
        allowable_c: Lower end of the allowable range, C, below 18.
    """
    return as_array(100.0 * (1.0 - under_k / (racks * (RECOMMENDED_C[0] - allowable_c))))


def _ratio(part: Values, whole: Values, round_off: Values) -> F64:
    """Part over whole, 0 where the whole is no more than round-off."""
    some = np.greater(whole, round_off)
    return as_array(np.where(some, part / np.where(some, whole, 1.0), 0.0))
