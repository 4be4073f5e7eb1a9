"""Air before the racks of a hall in the step of its hottest inlet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sdc_taichi.hall.air_metrics import rank
from sdc_taichi.sim.inlet_parts import RACK_FIELDS, UNIT_FIELDS, IntakeAir, intake_air_of
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import I64, StepResult, fields_of

_DECIMALS = 6
"""Decimals of stored values; temperatures are then right to a millionth of a kelvin."""

_MOST = 1e9
"""What no stored value reaches."""


@dataclass(frozen=True, slots=True)
class AirAtStep:
    """Air before the racks of one data center in one step."""

    step: int
    """The step, counted from 0 at reset."""
    air: IntakeAir
    """Air before its racks."""


class HottestAir:
    """The air of each data center of a simulator in the first of its hottest steps.

    Args:
        sim: the simulator.
        dcs: indices of the data centers whose air is kept; None is all.
    """

    def __init__(self, sim: Simulator, dcs: Sequence[int] | None = None) -> None:
        self._sim = sim
        # No inlet of a data center whose air is not kept is hotter.
        self._rank = np.full(sim.size, -np.inf if dcs is None else np.inf)
        self._rank[[] if dcs is None else list(dcs)] = -np.inf
        self._step: I64 = np.full(sim.size, -1, dtype=np.int64)
        self._air: IntakeAir | None = None

    def add(self, result: StepResult) -> None:
        """Add the last step of the simulator."""
        ranks = rank(result.inlet_max_c)
        hotter = ranks > self._rank
        if not hotter.any():
            return
        self._rank[hotter] = ranks[hotter]
        self._step[hotter] = result.step
        found = self._sim.intake_air()
        if self._air is None or hotter.all():
            self._air = found
            return
        fleet = self._sim.fleet
        for names, of in ((RACK_FIELDS, fleet.rack_dc), (UNIT_FIELDS, fleet.unit_dc)):
            for name in names:
                np.copyto(getattr(self._air, name), getattr(found, name), where=hotter[of])

    def of(self, dc: int) -> AirAtStep | None:
        """The air of a data center in its hottest step; None before the first step."""
        if self._air is None:
            return None
        return AirAtStep(int(self._step[dc]), intake_air_of(self._sim.fleet, self._air, dc))


def air_values(found: AirAtStep) -> dict[str, Any]:
    """Air as plain values for JSON: ``step``, and a list by rack or CRAC unit for each field."""
    lists = {
        name: values.round(_DECIMALS).tolist() for name, values in fields_of(found.air).items()
    }
    return {"step": found.step, **lists}


def air_from_values(values: dict[str, Any], *, racks: int, units: int, steps: int) -> AirAtStep:
    """Air that ``air_values`` made plain.

    Args:
        values: the plain values.
        racks: racks of the hall.
        units: CRAC units of the hall.
        steps: steps of the run.

    Raises:
        ValueError: values that are missing, out of range or of another number of racks or units.
    """
    step = values.get("step")
    if not isinstance(step, int) or not 0 <= step < steps:
        raise ValueError(f"step {step!r}; valid is 0..{steps - 1}")
    arrays = {}
    for names, count in ((RACK_FIELDS, racks), (UNIT_FIELDS, units)):
        for name in names:
            try:
                array = np.array(values.get(name), dtype=np.float64)
            except (TypeError, ValueError):
                array = np.empty(0)
            if array.shape != (count,) or not np.all(np.abs(array) < _MOST):
                raise ValueError(f"{name}; valid is a list of {count} numbers")
            arrays[name] = array
    return AirAtStep(step, IntakeAir(**arrays))
