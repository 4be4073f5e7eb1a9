"""Places of CRAC units or CDUs in arrays with a row per data center and a column per unit."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from sdc_taichi.envs.agents import AGENT_DEFINITIONS
from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import CDUS, CRAC_UNITS, F64, I32

_T = TypeVar("_T", bound=np.generic)


class UnitSlots:
    """Converts between values of U units, (U,), and arrays of B data centers, (B, W).

    W is the number of units of the data center with the most units. Rows of data centers with fewer
    units end with slots without a unit.

    Args:
        fleet: the B data centers.
        width: number of slots, W; None means as few as possible.
        axis: kind of the units: ``CRAC_UNITS`` or ``CDUS``.

    Raises:
        ConfigError: a data center has more units than slots.

    Attributes:
        width: number of slots of each data center, W.
        exists: True for slots with a unit, (B, W).
        count: number of units of all data centers, U.
        counts: number of units of each data center, (B,).
        dc: index of each unit's data center, (U,).
    """

    def __init__(self, fleet: Fleet, width: int | None = None, axis: str = CRAC_UNITS) -> None:
        self._offsets: I32 = {CRAC_UNITS: fleet.unit_offsets, CDUS: fleet.cdu_offsets}[axis]
        self.counts = np.diff(self._offsets).astype(np.int64)
        most = int(self.counts.max())
        if width is not None and most > width:
            raise ConfigError(
                f"config: {fleet.names[int(self.counts.argmax())]} has {most} CRAC units; valid is "
                f"at most {width}, most_units of the draw"
            )
        self.width = width or most
        self.count = int(self._offsets[-1])
        self._is_full = bool(np.all(self.counts == self.width))
        slots = np.arange(self.width)
        self.exists: npt.NDArray[np.bool_] = slots < self.counts[:, None]
        self._units = np.where(self.exists, self._offsets[:-1, None] + slots, 0)
        self.dc = np.repeat(np.arange(fleet.size), self.counts)

    def fill(self, per_unit: npt.NDArray[_T]) -> npt.NDArray[_T]:
        """Arrange values of units, (..., U), by data center and slot, (..., B, W).

        Slots without a unit hold 0.
        """
        if self._is_full:
            return per_unit.reshape(*per_unit.shape[:-1], *self.exists.shape)
        filled: npt.NDArray[_T] = per_unit.take(self._units, axis=-1)
        filled[..., ~self.exists] = 0
        return filled

    def units(self, by_slot: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return the values of the units in an array by data center and slot, (U, ...)."""
        if self._is_full:
            return by_slot.reshape(-1, *by_slot.shape[2:])
        return np.asarray(by_slot[self.exists])

    def sums(self, per_unit: F64) -> F64:
        """Sum values of units, (U,), within each data center, (B,)."""
        return np.asarray(np.add.reduceat(per_unit, self._offsets[:-1]))

    def means(self, per_unit: F64) -> F64:
        """Return the mean over the units of each data center, (B,)."""
        return np.asarray(self.sums(per_unit) / self.counts)


def slots_of_groups(
    fleet: Fleet, groups: Iterable[str], widths: dict[str, int] | None = None
) -> dict[str, UnitSlots]:
    """Return the places of the agents of each group that has an agent for each unit, by group.

    Args:
        fleet: the data centers.
        groups: names of groups.
        widths: number of slots by kind of unit; others have as few as possible.

    Raises:
        ConfigError: a data center has more units than slots.
    """
    axes = {group: AGENT_DEFINITIONS[group].axis for group in groups}
    return {
        group: UnitSlots(fleet, (widths or {}).get(axis), axis)
        for group, axis in axes.items()
        if AGENT_DEFINITIONS[group].per_unit
    }
