"""CRAC units that are down: whose air reaches which racks then, kept up in the kernels' arrays."""

from __future__ import annotations

from typing import Any

import numpy as np

from sdc_taichi.hall.unit_supply import airflow_with_losses_m3s, unit_weights, weighted_shares
from sdc_taichi.sim.fleet import NO_LIMIT_W, Fleet
from sdc_taichi.types import F64

_MOST_KEPT = 4096
"""Most sets of running units whose weights are kept."""


class SharedPlenum:
    """Shares of the CRAC units of a fleet in the supply of its racks, by the units that run.

    They are computed where the set of running units of a data center changes, once for data centers
    that are alike.

    Args:
        fleet: Data centers; without recirculation there is nothing to keep up.
        kernel_shares: The kernels' array of shares, which holds those of all units running.
        first_share: First vector of each data center in it.
        lanes: Racks in a vector.
        adjusts_supply: The kernels' row of whether supply air may differ from setpoints, (B,).
    """

    def __init__(
        self, fleet: Fleet, kernel_shares: Any, first_share: Any, lanes: int, adjusts_supply: F64
    ) -> None:
        self._fleet, self._kernel_shares = fleet, kernel_shares
        self._first_share, self._lanes = first_share, lanes
        self._coasting_ratio = fleet.values("hvac.crac.coasting_flow_ratio")
        limited = fleet.unit_sums(fleet.unit_capacity_w < NO_LIMIT_W) > 0
        self._always_adjusts = limited | (fleet.setpoint_over_supply_k > 0)
        self._adjusts_supply = adjusts_supply
        adjusts_supply[:] = self._always_adjusts
        self.weight = np.ones(fleet.units)
        """Weight of each CRAC unit in the shares of all racks, (U,); 1 where all units run."""
        self._whole = np.ones(fleet.units)
        self._running = self._whole
        self._kept: dict[tuple[int, bytes], F64] = {}

    def supply_from(self, running: F64 | None) -> None:
        """Make the shares those of the units that run: 1 runs, 0 is down, (U,); None is all."""
        if running is None:
            running = self._whole
        if running is self._running or self._fleet.air is None:
            return
        changed = np.flatnonzero(running != self._running)
        for dc in np.unique(self._fleet.unit_dc[changed]):
            self._supply_data_center(int(dc), running)
        if len(changed):
            self._running = running.copy()

    def _supply_data_center(self, dc: int, running: F64) -> None:
        fleet = self._fleet
        assert fleet.air is not None
        units = slice(*fleet.unit_offsets[dc : dc + 2])
        at = slice(*fleet.air.unit_share_offsets[dc : dc + 2])
        own = running[units]
        shares = fleet.air.unit_shares[at].reshape(-1, len(own))
        key = int(fleet.air.steady_state_of_dc[dc]), own.tobytes()
        if key not in self._kept:
            if len(self._kept) == _MOST_KEPT:
                self._kept.clear()
            self._kept[key] = self._weights(dc, shares, own)
        self.weight[units] = self._kept[key]
        some_down = bool(np.any(own > 0) and np.any(own == 0))
        self._adjusts_supply[dc] = some_down or self._always_adjusts[dc]
        by_block = shares_by_block(weighted_shares(shares, self._kept[key]), self._lanes)
        first = int(self._first_share[dc])
        self._kernel_shares[first : first + len(by_block)] = by_block

    def _weights(self, dc: int, shares: F64, running: F64) -> F64:
        """Weights of the units of a data center, (U,)."""
        fleet = self._fleet
        assert fleet.air is not None
        if running.all() or not running.any():
            return np.ones(len(running))
        given_m3s = airflow_with_losses_m3s(
            fleet.unit_design_m3s[slice(*fleet.unit_offsets[dc : dc + 2])],
            running,
            coasting_ratio=float(self._coasting_ratio[dc]),
            design_m3s=float(fleet.design_flow_m3s[dc]),
        )
        need_m3s = fleet.air.rack_need_m3s[slice(*fleet.rack_offsets[dc : dc + 2])]
        return unit_weights(shares, need_m3s, given_m3s)


def shares_by_block(shares: F64, lanes: int) -> Any:
    """Shares as the kernels take them, one vector of racks per block and unit, (blocks U, lanes).

    Args:
        shares: Share of each unit in the supply of each rack, (R, U).
        lanes: Racks in a block; the last one is filled up with zeros.
    """
    racks, units = shares.shape
    blocks = -(-racks // lanes)
    padded = np.zeros((blocks * lanes, units))
    padded[:racks] = shares
    return padded.reshape(blocks, lanes, units).swapaxes(1, 2).reshape(-1, lanes)
