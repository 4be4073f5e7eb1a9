"""Limits that no result of a step leaves in any data center.

They are no design limits: beyond them a hall has burnt, or an input has no sense that the bounds of
its field could tell. A run ends there, since what follows would be numbers without a meaning.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import PhysicalLimitError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, Reals, StepResult

AIR_LIMITS_C = (-100.0, 400.0)
"""Limits of air and water, in C: colder than any weather, and where insulation of cables burns by
itself."""
WEATHER_LIMITS_C = (-130.0, 100.0)
"""Limits of weather with its heat waves, in C: the bounds of both together."""
POWER_LIMITS_W = (-1e-3, 1e12)
"""Limits of powers, in W: none is negative but for rounding, and the world draws some 3e12 W of
electricity."""
ENERGY_LIMITS_KWH = (-1e-3, 1e12)
"""Limits of energies of a step, in kWh, likewise."""
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


def limit_error(
    inside: F64, result: StepResult, configs: Sequence[DataCenterConfig]
) -> PhysicalLimitError:
    """The error of a step with a result beyond its limits: names data center, quantity and step.

    Args:
        inside: what ``within_limits`` has found, (B,), not 1 everywhere.
        result: the result of the step.
        configs: configurations of the data centers.
    """
    dc = int(np.argmin(inside))
    values = {name: float(getattr(result, name)[dc]) for name in LIMITS}
    name = next(name for name, (low, high) in LIMITS.items() if not low <= values[name] <= high)
    low, high = LIMITS[name]
    return PhysicalLimitError(
        f"{configs[dc].name}: {name} is {values[name]:.6g} in step {result.step}; physical is "
        f"{low:g}..{high:g}. {_WHY}"
    )


def require_bearable_outlets(outlet_max_c: Reals, fleet: Fleet) -> None:
    """Make sure that no rack of a hall burns, which its neighbours may hide in means.

    Args:
        outlet_max_c: hottest outlet of each rack, in C, (R,).
        fleet: the data centers.

    Raises:
        PhysicalLimitError: an outlet beyond the limit, or that is not a number; names data center
            and rack.
    """
    hottest_c = np.maximum.reduce(outlet_max_c)
    # Comparisons with NaN are false, so that it ends here too.
    if hottest_c <= AIR_LIMITS_C[1]:
        return
    rack = int(np.argmax(outlet_max_c))
    dc = int(fleet.rack_dc[rack])
    raise PhysicalLimitError(
        f"{fleet.names[dc]}: outlet of rack {rack - fleet.rack_offsets[dc]} is {hottest_c:.6g} C; "
        f"physical is at most {AIR_LIMITS_C[1]:g} C. {_WHY}"
    )
