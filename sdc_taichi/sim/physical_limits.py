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
from sdc_taichi.types import F64, I32, StepResult

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


def require_within_limits(
    inside: F64, result: StepResult, configs: Sequence[DataCenterConfig], rack_offsets: I32
) -> None:
    """Make sure that a step ended within the limits.

    Args:
        inside: what ``within_limits`` has found, (B,).
        result: the result of the step.
        configs: configurations of the data centers.
        rack_offsets: first rack of each data center, and the number of racks, (B + 1,).

    Raises:
        PhysicalLimitError: naming data center, step and quantity.
    """
    hottest_c = np.maximum.reduce(result.rack_outlet_max_c)
    if np.minimum.reduce(inside) == 1.0 and hottest_c <= AIR_LIMITS_C[1]:
        return
    dc = int(np.argmin(inside))
    for name, (low, high) in LIMITS.items():
        value = getattr(result, name)[dc]
        if not low <= value <= high:
            raise PhysicalLimitError(
                f"{configs[dc].name}: {name} is {value:.6g} in step {result.step}; physical is "
                f"{low:g}..{high:g}. {_WHY}"
            )
    rack = int(np.argmax(result.rack_outlet_max_c))
    dc = int(np.searchsorted(rack_offsets, rack, side="right")) - 1
    raise PhysicalLimitError(
        f"{configs[dc].name}: outlet of rack {rack - rack_offsets[dc]} is {hottest_c:.6g} C in "
        f"step {result.step}; physical is at most {AIR_LIMITS_C[1]:g} C. {_WHY}"
    )
