"""Dew point of the rooms with liquid-cooled racks."""

from __future__ import annotations

import numpy as np

from sdc_taichi.plant import moist_air
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import sites_pressure_pa
from sdc_taichi.types import F64


class RoomDewPoint:
    """Dew point of the room of each of B data centers: a configured one, or that of outdoor air.

    Args:
        fleet: the data centers; it is 0 C for those without liquid-cooled racks.
    """

    def __init__(self, fleet: Fleet) -> None:
        sections = [config.liquid for config in fleet.configs]
        self._dew_point_c = np.array(
            [0.0 if s is None else s.dew_point_c for s in sections], dtype=np.float64
        )
        self._is_humid = np.isnan(self._dew_point_c)
        self._pressure_pa = sites_pressure_pa(fleet) if self._is_humid.any() else None

    def at(self, outdoor_c: F64, wet_bulb_c: F64) -> F64:
        """Return the dew point of each room, in C, (B,).

        Args:
            outdoor_c: Outdoor dry bulb, in C, (B,).
            wet_bulb_c: Outdoor wet bulb, in C, (B,).
        """
        if self._pressure_pa is None:
            return self._dew_point_c
        outdoor_dew_c = moist_air.dew_point_c(outdoor_c, wet_bulb_c, self._pressure_pa)
        return np.where(self._is_humid, outdoor_dew_c, self._dew_point_c)
