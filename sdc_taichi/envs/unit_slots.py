"""Places of CRAC units in arrays with one row per data center and one column per unit."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.fleet import Fleet

_T = TypeVar("_T", bound=np.generic)


class UnitSlots:
    """Converts between values of U CRAC units, (U,), and arrays of B data centers, (B, W).

    W is the number of units of the data center with the most units. Rows of data centers with fewer
    units end with slots without a unit.

    Args:
        fleet: the B data centers.
        width: number of slots, W; None means as few as possible.

    Raises:
        ConfigError: a data center has more units than slots.

    Attributes:
        width: number of slots of each data center, W.
        exists: True for slots with a unit, (B, W).
    """

    def __init__(self, fleet: Fleet, width: int | None = None) -> None:
        counts = np.diff(fleet.unit_offsets).astype(np.int64)
        most = int(counts.max())
        if width is not None and most > width:
            raise ConfigError(
                f"config: {fleet.names[int(counts.argmax())]} has {most} CRAC units; valid is at "
                f"most {width}, most_units of the draw"
            )
        self.width = width or most
        self._is_full = bool(np.all(counts == self.width))
        slots = np.arange(self.width)
        self.exists: npt.NDArray[np.bool_] = slots < counts[:, None]
        self._units = np.where(self.exists, fleet.unit_offsets[:-1, None] + slots, 0)

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
