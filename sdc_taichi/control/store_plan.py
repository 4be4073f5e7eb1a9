"""Plans of batteries: inputs of the programme over stored energy in ``kernels/planning.py``."""

from __future__ import annotations

import numpy as np

from sdc_taichi.control.planning_kernel import PlanningKernel, first_commands
from sdc_taichi.control.queue_plan import EnergyCost
from sdc_taichi.kernels.arguments import in_row_order
from sdc_taichi.kernels.planning_arguments import STORE_ARGUMENTS, STORE_ROWS
from sdc_taichi.plant.battery import BATTERIES, BatteryResult
from sdc_taichi.sim.facility import BATTERY_PARAMETERS
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.types import F64

LEVELS = 41
"""Levels of the stored energy."""
COMMANDS = (0.0, -0.25, 0.25, -0.5, 0.5, -0.75, 0.75, -1.0, 1.0)
"""Commands of steps after the first; of equal ones the first counts."""
_AMPLE_KW, _SLIGHT_KW = 1e9, 1e-3
"""Powers of a facility that never limit, and always limit, what a battery delivers."""


class StorePlanner:
    """Plans the batteries of B data centers.

    Args:
        fleet: the data centers.
        sizing: their devices.
        step_h: length of a step, in h.
    """

    def __init__(self, fleet: Fleet, sizing: Sizing, step_h: float) -> None:
        from sdc_taichi.kernels.planning import store_kernel

        self._model = BATTERIES[fleet.models["battery"]]
        self._parameters = {n: fleet.values(f"battery.{n}")[:, None] for n in BATTERY_PARAMETERS}
        self._capacity_kwh, self._step_h = sizing.battery_kwh, step_h
        self._limit_kw = sizing.grid_limit_kw
        self._kernel = PlanningKernel(store_kernel(), STORE_ARGUMENTS, LEVELS)
        self._first, self._later = first_commands(), np.array(COMMANDS)
        levels_kwh = sizing.battery_kwh[:, None] * np.linspace(0.0, 1.0, LEVELS)
        charged = self._step(levels_kwh, 1.0, _AMPLE_KW)
        ample, slight = (self._step(levels_kwh, -1.0, kw) for kw in (_AMPLE_KW, _SLIGHT_KW))
        self._most = {
            "most_charge": charged.charge_kwh,
            "most_discharge": ample.discharge_kwh,
            "load_share": slight.discharge_kwh / (_SLIGHT_KW * step_h),
        }
        self._charge_efficiency = _ratio(
            charged.stored_kwh[:, 0] - levels_kwh[:, 0], charged.charge_kwh[:, 0]
        )
        self._discharge_factor = _ratio(
            levels_kwh[:, -1] - ample.stored_kwh[:, -1], ample.discharge_kwh[:, -1]
        )

    def plan(self, stored_kwh: F64, facility_kwh: F64, cost: EnergyCost, *, peaks: int) -> F64:
        """Battery command of the step to come, (B,).

        Args:
            stored_kwh: energy in the store, in kWh, (B,).
            facility_kwh: energy of the facility in the coming steps, in kWh, (B, H).
            cost: what energy costs.
            peaks: peaks of the month that are tried; 1 without a demand charge.
        """
        size, horizon = facility_kwh.shape
        load_kw = facility_kwh[:, :1] / self._step_h
        now = self._step(stored_kwh[:, None], self._first[None], load_kw, self._limit_kw[:, None])
        capacity_kwh = np.where(self._capacity_kwh > 0, self._capacity_kwh, 1.0)
        of_dc = {
            "spacing": capacity_kwh / (LEVELS - 1),
            "charge_efficiency": self._charge_efficiency,
            "discharge_factor": self._discharge_factor,
            "grid_limit": self._limit_kw * self._step_h,
            "end_value": cost.weight.mean(axis=1) / self._discharge_factor,
            "peak_kwh": cost.peak_kwh,
            "peak_cost": cost.peak_cost,
        }
        chosen, _ = self._kernel.run(
            size,
            horizon,
            commands=self._later,
            peaks=peaks,
            facility_kwh=facility_kwh,
            of_dc=np.stack(in_row_order(STORE_ROWS, of_dc), axis=1),
            weight=cost.weight,
            first_grid=now.grid_kwh,
            first_stored=now.stored_kwh,
            **self._most,
        )
        return self._first[chosen]

    def _step(
        self, stored_kwh: F64, command: F64 | float, load_kw: F64 | float, limit: F64 | None = None
    ) -> BatteryResult:
        """One step of each battery from several levels or by several commands, (B, n)."""
        return self._model(
            stored_kwh,
            command,
            capacity_kwh=self._capacity_kwh[:, None],
            load_kw=load_kw,
            dt_h=self._step_h,
            grid_limit_kw=limit,
            **self._parameters,
        )


def _ratio(part: F64, whole: F64) -> F64:
    """Part over whole, (B,); 1 where there is nothing."""
    return np.divide(part, whole, out=np.ones_like(whole), where=whole > 0)
