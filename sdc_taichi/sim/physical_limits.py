"""Physical limits of the results of a step, and the errors of results beyond them.

They are no design limits: beyond them a hall has burnt, or inputs contradict each other in a way
that the bounds of single fields cannot show. A run ends there, since later numbers would mean
nothing.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from functools import reduce
from typing import Any

import numpy as np

from sdc_taichi.errors import PhysicalLimitError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, Reals, StepResult

AIR_LIMITS_C = (-100.0, 400.0)
"""Limits of air and water, in C: colder than any weather, and where insulation of cables burns by
itself."""
WEATHER_LIMITS_C = (-130.0, 100.0)
"""Limits of weather with its heat waves, in C: the bounds of both together."""
BEYOND_NUMBERS_C = 1e12
"""Outlet, in C, from which on sums over a hall may not fit the kernels' f32."""
POWER_LIMITS_W = (-1e-3, 1e12)
"""Limits of powers, in W: none is negative but for rounding, and the world draws some 3e12 W of
electricity."""
ENERGY_LIMITS_KWH = (-1e-3, 1e12)
"""Limits of energies of a step, in kWh: as for powers, over one hour."""
LIMITS: dict[str, tuple[float, float]] = {
    **dict.fromkeys(("outdoor_c", "wet_bulb_c"), WEATHER_LIMITS_C),
    **dict.fromkeys(
        ("supply_c", "inlet_max_c", "outlet_mean_c", "return_c", "condenser_water_c"), AIR_LIMITS_C
    ),
    **dict.fromkeys(("it_w", "hvac_w", "heat_removed_w", "rejected_w"), POWER_LIMITS_W),
    **dict.fromkeys(("grid_kwh", "stored_kwh", "unserved_kwh"), ENERGY_LIMITS_KWH),
}
"""Lowest and highest value of quantities of ``StepResult``. Others follow from these."""
_WHY = "Airflow, power and events of the configuration do not fit together"


def within_limits(quantities: Mapping[str, Any]) -> Any:
    """1 for data centers whose quantities are within their limits, else 0, (B,); NaN never is.

    Plain NumPy, which a step runs compiled.

    Args:
        quantities: quantities of a step by name, with all of ``LIMITS``, (B,) each.
    """
    inside = [
        (quantities[name] >= low) & (quantities[name] <= high)
        for name, (low, high) in LIMITS.items()
    ]
    return np.where(reduce(operator.and_, inside), 1.0, 0.0)


def limit_error(inside: F64, result: StepResult, fleet: Fleet) -> PhysicalLimitError:
    """The error of a step with a result beyond its limits: names data center, quantity and step.

    Args:
        inside: what ``within_limits`` returned, (B,).
        result: the result of the step.
        fleet: the data centers.
    """
    dc = int(np.argmin(inside))
    values = {name: float(getattr(result, name)[dc]) for name in LIMITS}
    beyond = [name for name, (low, high) in LIMITS.items() if not low <= values[name] <= high]
    if beyond:
        low, high = LIMITS[beyond[0]]
        excess = f"{beyond[0]} is {values[beyond[0]]:.6g}"
    else:
        # A single rack may burn, which the means of its hall hide.
        (low, high), rack = AIR_LIMITS_C, int(np.argmax(result.rack_outlet_max_c))
        dc = int(fleet.rack_dc[rack])
        number = rack - fleet.rack_offsets[dc]
        excess = f"outlet of rack {number} is {result.rack_outlet_max_c[rack]:.6g} C"
    return PhysicalLimitError(
        f"{fleet.names[dc]}: {excess} in step {result.step}; physical is {low:g}..{high:g}. {_WHY}"
    )


def no_steady_air_error(name: str, sweeps: int) -> PhysicalLimitError:
    """The error of a hall whose air finds no steady state.

    Args:
        name: name of the data center.
        sweeps: number of sweeps that were tried.
    """
    return PhysicalLimitError(
        f"{name}: no steady air temperatures in {sweeps} sweeps; the CRAC units move too little "
        "air: raise hvac.crac.coasting_flow_ratio or min_flow_ratio, or set "
        "simulation.thermal=transient"
    )


def no_number_error(outlet_max_c: Reals, fleet: Fleet) -> PhysicalLimitError:
    """The error of a hall with results that are infinite or not a number.

    Args:
        outlet_max_c: hottest outlet of each rack, in C, (R,), one of them no number.
        fleet: the data centers.
    """
    dc = int(fleet.rack_dc[int(np.argmin(outlet_max_c < BEYOND_NUMBERS_C))])
    return PhysicalLimitError(
        f"{fleet.names[dc]}: temperatures or power of the hall are beyond any number; valid are "
        "smaller powers or larger airflows"
    )
