"""Physical limits of the results of a step, and the errors for results beyond these limits.

The limits are not design limits. A result beyond a limit means that the hall would burn, or that
inputs contradict each other in a way that the bounds of single fields cannot detect. A run ends at
such a result, because all later results would be meaningless. A simulator with ``limits="flag"``
goes on for the sake of the other data centers; see ``held_air`` in ``air.py``.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import reduce
from typing import Any

import numpy as np

from sdc_taichi.errors import PhysicalLimitError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, Reals

AIR_LIMITS_C = (-100.0, 400.0)
"""Limits of air and water temperatures, in C: colder than any weather, and the autoignition of
cable insulation."""
WEATHER_LIMITS_C = (-130.0, 100.0)
"""Limits of outdoor temperatures with heat waves, in C: the sum of the bounds of both."""
BEYOND_NUMBERS_C = 1e12
"""Outlet temperature, in C, above which sums over a hall may overflow the kernels' f32."""
POWER_LIMITS_W = (-1e-3, 1e12)
"""Limits of powers, in W: negative only by round-off, and below the world's electric power of about
3e12 W."""
ENERGY_LIMITS_KWH = (-1e-3, 1e12)
"""Limits of the energies of a step, in kWh: negative only by round-off."""
LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("outdoor_c", "wet_bulb_c"), WEATHER_LIMITS_C),
    **dict.fromkeys(
        ("supply_c", "inlet_max_c", "outlet_mean_c", "return_c", "condenser_water_c"), AIR_LIMITS_C
    ),
    **dict.fromkeys(("it_w", "hvac_w", "heat_removed_w", "rejected_w"), POWER_LIMITS_W),
    **dict.fromkeys(("grid_kwh", "stored_kwh", "unserved_kwh"), ENERGY_LIMITS_KWH),
}
"""Minimum and maximum of quantities of ``StepResult``; the other quantities derive from these."""
_FEW_OF_NEED = 0.5
"""Airflow of the CRAC units divided by the supply air that the racks demand, below which too little
air is named as the cause of a hall without steady air."""
_WHY = "Airflow, power and events of the configuration do not fit together"


def within_limits(quantities: Mapping[str, Any]) -> Any:
    """Return 1 for data centers whose quantities are all within ``LIMITS``, else 0, (B,).

    NaN counts as beyond the limits. The function is plain NumPy code, which is run compiled.

    Args:
        quantities: Quantities of a step by name, (B,) each, including all names of ``LIMITS``.
    """
    inside = [
        (quantities[name] >= low) & (quantities[name] <= high)
        for name, (low, high) in LIMITS.items()
    ]
    return np.where(reduce(operator.and_, inside), 1.0, 0.0)


def limit_error(
    inside: F64, quantities: Mapping[str, Any], step: int, fleet: Fleet
) -> PhysicalLimitError:
    """Return the error for a result beyond its limits, naming data center, quantity and step.

    Args:
        inside: Return value of ``within_limits``, (B,).
        quantities: Quantities of the step by name, including all names of ``LIMITS``.
        step: Index of the step.
        fleet: The data centers.
    """
    dc = int(np.argmin(inside))
    values = {name: float(quantities[name][dc]) for name in LIMITS}
    beyond = [name for name, (low, high) in LIMITS.items() if not low <= values[name] <= high]
    if beyond:
        low, high = LIMITS[beyond[0]]
        excess = f"{beyond[0]} is {values[beyond[0]]:.6g}"
    else:
        # The means of a hall can hide a single rack that is far too hot.
        outlet_c = quantities["rack_outlet_max_c"]
        (low, high), rack = AIR_LIMITS_C, int(np.argmax(outlet_c))
        dc = int(fleet.rack_dc[rack])
        number = rack - fleet.rack_offsets[dc]
        excess = f"outlet of rack {number} is {outlet_c[rack]:.6g} C"
    return PhysicalLimitError(
        f"{fleet.names[dc]}: {excess} in step {step}; physical is {low:g}..{high:g}. {_WHY}"
    )


def no_steady_air_error(
    name: str,
    sweeps: int,
    *,
    flow_m3s: float,
    most_m3s: float,
    need_m3s: float,
    limits_coils: bool,
) -> PhysicalLimitError:
    """Return the error for a hall whose air temperatures do not converge to a steady state.

    Args:
        name: Name of the data center.
        sweeps: Number of solver sweeps that were done.
        flow_m3s: Airflow of the CRAC units in the last sweep, in m3/s.
        most_m3s: Largest airflow that their fans may have in this step, in m3/s.
        need_m3s: Supply air that the racks demand in the last sweep, in m3/s.
        limits_coils: True if the coils have limited capacities.
    """
    if not flow_m3s >= _FEW_OF_NEED * need_m3s:
        at_limit = "" if flow_m3s < 0.999 * most_m3s else ", the most in this step"
        cause = (
            f"the CRAC units move {flow_m3s:.3g} m3/s{at_limit}, and the racks draw "
            f"{need_m3s:.3g} m3/s: raise hvac.crac.coasting_flow_ratio, min_flow_ratio or the "
            "commanded fan speeds"
        )
    elif limits_coils:
        cause = (
            f"the CRAC units move {flow_m3s:.3g} of the {need_m3s:.3g} m3/s that the racks draw, "
            "but their coils have limits: raise hvac.crac.capacity_kw"
        )
    else:
        cause = (
            f"the CRAC units move {flow_m3s:.3g} of the {need_m3s:.3g} m3/s that the racks draw, "
            "so the air is not short: change the setpoint or the load slightly"
        )
    return PhysicalLimitError(
        f"{name}: no steady air temperatures in {sweeps} sweeps; {cause}, or set "
        "simulation.thermal=transient"
    )


def no_number_error(outlet_max_c: Reals, fleet: Fleet) -> PhysicalLimitError:
    """Return the error for a hall with results that are infinite or NaN.

    Args:
        outlet_max_c: Highest outlet temperature of each rack, in C, (R,), with an infinite or NaN
            entry.
        fleet: The data centers.
    """
    dc = int(fleet.rack_dc[int(np.argmin(outlet_max_c < BEYOND_NUMBERS_C))])
    return PhysicalLimitError(
        f"{fleet.names[dc]}: temperatures or power of the hall are beyond any number; valid are "
        "smaller powers or larger airflows"
    )
