"""Indices of air management in a hall: SHI, RHI, RTI, RCI, and the temperature ranges of ASHRAE.

The indices are functions of sums over the racks of a data center. The simulator stores these sums;
the functions ``rise_m3k_s``, ``over_27_sum_k`` and ``under_18_sum_k`` compute them from rack data.
"""

from __future__ import annotations

import numpy as np

from sdc_taichi.kernels import hall_arguments
from sdc_taichi.types import F64, Reals, Values, as_array

RECOMMENDED_C = hall_arguments.RECOMMENDED_C
"""Lowest and highest recommended inlet temperature, in C (ASHRAE TC 9.9 Thermal Guidelines,
2021)."""
ALLOWABLE_C = {"A1": (15.0, 32.0), "A2": (10.0, 35.0), "A3": (5.0, 40.0), "A4": (5.0, 45.0)}
"""Lowest and highest allowable inlet temperature by server class, in C (ASHRAE TC 9.9 Thermal
Guidelines, 2021)."""

TIE_K = 0.05
"""Temperature difference up to which racks count as equally hot, in K; it is invisible in figures
with one decimal."""
USUAL_CLASS = "A2"
"""Server class of data centers without a class of their own."""
LEAST_EXCESS_K = 1e-5
"""Smallest excess over a temperature limit that counts, in K. An f32 inlet temperature equal to the
limit may exceed it by a rounding error of 4e-6 K."""
_ROUND_OFF_K = 1e-4
"""Largest absolute value of a mean temperature rise that counts as 0, in K. The rounding errors of
f32 temperatures are of this size and depend on the order of summation."""
_NO_AIRFLOW_M3S = 1e-9
"""Largest airflow that counts as 0, in m3/s."""


def allowable_c(ashrae_class: str | None) -> tuple[float, float]:
    """Return the lowest and highest allowable inlet of an ASHRAE class, in C; None means A2."""
    return ALLOWABLE_C[ashrae_class or USUAL_CLASS]


def rank(temperature_c: Reals) -> F64:
    """Round temperatures to ranks for comparison, as ``kernels.sums.rank`` does.

    The temperatures of identical racks differ in their last bits, which depend on the processor.
    Their ranks, in steps of 1/``RANKS_PER_K`` K, are equal, so a search for the hottest rack always
    finds the first of identical racks.

    Args:
        temperature_c: Temperatures, C, of any shape.

    Returns:
        Whole numbers that rise with temperature, of the same shape.
    """
    return np.asarray(np.floor(temperature_c * hall_arguments.RANKS_PER_K + 0.5))


def rise_m3k_s(airflow_m3s: Reals, temperature_c: Reals, supply_c: Values) -> F64:
    """Return the flow-weighted temperature rise above the supply air, sum V*(T - T_sup).

    Multiplied by rho*cp, the sum is a heat flow.

    Args:
        airflow_m3s: Airflow of each of N racks, m3/s, (..., N).
        temperature_c: Inlet or outlet temperature of each rack, C, same shape.
        supply_c: Supply air temperature, C, a scalar or (..., 1).

    Returns:
        Sum over the racks, m3 K/s, (...).
    """
    return np.asarray((airflow_m3s * (temperature_c - supply_c)).sum(axis=-1))


def over_27_sum_k(inlet_c: F64) -> F64:
    """Return the sum over the racks of max(inlet temperature - 27 C, 0), in K, (...).

    Args:
        inlet_c: Inlet temperature of each of N racks, C, (..., N).
    """
    return np.asarray(np.maximum(inlet_c - RECOMMENDED_C[1], 0.0).sum(axis=-1))


def under_18_sum_k(inlet_c: F64) -> F64:
    """Return the sum over the racks of max(18 C - inlet temperature, 0), in K, (...).

    Args:
        inlet_c: Inlet temperature of each of N racks, C, (..., N).
    """
    return np.asarray(np.maximum(RECOMMENDED_C[0] - inlet_c, 0.0).sum(axis=-1))


def shi(inlet_rise_m3k_s: Values, outlet_rise_m3k_s: Values, airflow_m3s: Values) -> F64:
    """Return the supply heat index (SHI), sum V*(T_in - T_sup) / sum V*(T_out - T_sup).

    It is the share of the heat in the exhaust air that the air already had at the inlets, and 0
    without recirculation (Sharma, Bash and Patel 2002, "Dimensionless parameters for evaluation of
    thermal design and performance of large-scale data centers", AIAA 2002-3091).

    Args:
        inlet_rise_m3k_s: ``rise_m3k_s`` of the inlets, m3 K/s.
        outlet_rise_m3k_s: ``rise_m3k_s`` of the outlets, m3 K/s.
        airflow_m3s: Sum of the airflow of the racks, m3/s.

    Returns:
        SHI, dimensionless. It is 0 where the mean rise of inlets or outlets is within rounding
        errors, for example without load or airflow.
    """
    round_off_m3k_s = np.multiply(airflow_m3s, _ROUND_OFF_K)
    inlets_differ = np.maximum(inlet_rise_m3k_s, np.negative(inlet_rise_m3k_s)) > round_off_m3k_s
    share = _ratio(inlet_rise_m3k_s, outlet_rise_m3k_s, round_off_m3k_s)
    return as_array(np.where(inlets_differ, share, 0.0))


def rhi(inlet_rise_m3k_s: Values, outlet_rise_m3k_s: Values, airflow_m3s: Values) -> F64:
    """Return the return heat index (RHI), 1 - SHI, dimensionless (Sharma, Bash and Patel 2002).

    Arguments are as in ``shi``.
    """
    return as_array(1.0 - shi(inlet_rise_m3k_s, outlet_rise_m3k_s, airflow_m3s))


def it_rise_k(inlet_rise_m3k_s: Values, outlet_rise_m3k_s: Values, airflow_m3s: Values) -> F64:
    """Return the flow-weighted rise through the racks, sum V*(T_out - T_in) / sum V, in K.

    It is 0 without airflow. Arguments are as in ``shi``.
    """
    return _ratio(np.subtract(outlet_rise_m3k_s, inlet_rise_m3k_s), airflow_m3s, _NO_AIRFLOW_M3S)


def rti(return_c: Values, supply_c: Values, it_rise_k: Values) -> F64:
    """Return the return temperature index (RTI), 100*(T_ret - T_sup)/dT_IT, in %.

    Above 100 %, net recirculation of exhaust air prevails; below 100 %, supply air bypasses the
    racks (Herrlin 2008, "Airflow and cooling performance of data centers: two performance metrics",
    ASHRAE Transactions 114(2)).

    Args:
        return_c: Return air temperature of the CRAC units, C.
        supply_c: Supply air temperature of the CRAC units, C.
        it_rise_k: Temperature rise through the racks, see ``it_rise_k``, K.

    Returns:
        RTI, %, and 0 where the racks do not heat their air: then all supply air bypasses them.
    """
    return 100.0 * _ratio(np.subtract(return_c, supply_c), it_rise_k, _ROUND_OFF_K)


def rci_hi(over_k: Values, racks: Values, *, allowable_c: Values) -> F64:
    """Return the high-end rack cooling index, 100*(1 - over/(n*(T_allow - T_recommend))), in %.

    The index is 100 if no inlet is above the recommended range, and 0 if inlets on average are at
    the allowable limit; higher temperatures give negative values (Herrlin 2005, "Rack cooling
    effectiveness in data centers and telecom central offices: the Rack Cooling Index (RCI)", ASHRAE
    Transactions 111(2)).

    Args:
        over_k: Sum over the inlets of max(inlet temperature - 27 C, 0), K.
        racks: Number of inlets in the sum, at least 1.
        allowable_c: Upper end of the allowable range, C, above 27.
    """
    return as_array(100.0 * (1.0 - over_k / (racks * (allowable_c - RECOMMENDED_C[1]))))


def rci_lo(under_k: Values, racks: Values, *, allowable_c: Values) -> F64:
    """Return the low-end rack cooling index, 100*(1 - under/(n*(T_recommend - T_allow))), in %.

    The index is 100 if no inlet is below the recommended range (Herrlin 2005, "Rack cooling
    effectiveness in data centers and telecom central offices: the Rack Cooling Index (RCI)", ASHRAE
    Transactions 111(2)).

    Args:
        under_k: Sum over the inlets of max(18 C - inlet temperature, 0), K.
        racks: Number of inlets in the sum, at least 1.
        allowable_c: Lower end of the allowable range, C, below 18.
    """
    return as_array(100.0 * (1.0 - under_k / (racks * (RECOMMENDED_C[0] - allowable_c))))


def _ratio(part: Values, whole: Values, round_off: Values) -> F64:
    """Return part / whole, and 0 where the whole is within the rounding error ``round_off``."""
    some = np.greater(whole, round_off)
    return as_array(np.where(some, part / np.where(some, whole, 1.0), 0.0))
