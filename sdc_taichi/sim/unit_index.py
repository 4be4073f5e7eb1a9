"""CRAC units by data center: from values of the units to values of data centers, and back."""

from __future__ import annotations

import numpy as np

from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64


class UnitIndex:
    """The U CRAC units of B data centers.

    Where every data center has one unit, (U,) and (B,) are the same, and nothing is computed.

    Args:
        fleet: B data centers with one CRAC unit or more each.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._counts = np.diff(fleet.unit_offsets)
        self._first = fleet.unit_offsets[:-1]
        self.dc = fleet.unit_dc
        """Data center of each unit, (U,)."""
        self.one_each = fleet.units == fleet.size
        """Whether every data center has one unit."""

    def of_each(self, per_dc: F64) -> F64:
        """For each unit the value of its data center, (U,)."""
        return per_dc if self.one_each else per_dc[self.dc]

    def mean(self, per_unit: F64) -> F64:
        """Mean over the units of each data center, a new array, (B,)."""
        return per_unit.copy() if self.one_each else self.sum(per_unit) / self._counts

    def sum(self, per_unit: F64) -> F64:
        """Sum over the units of each data center, (B,)."""
        return per_unit if self.one_each else self._fleet.unit_sums(per_unit)

    def lowest(self, per_unit: F64) -> F64:
        """Lowest value among the units of each data center, (B,)."""
        if self.one_each:
            return per_unit
        return np.asarray(np.minimum.reduceat(per_unit, self._first), dtype=np.float64)
