"""CRAC units: setpoints and fan speeds in a step, and whose air reaches which racks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config.hvac_schema import SetpointConfig
from sdc_taichi.hall.unit_supply import airflow_with_losses_m3s, unit_weights, weighted_shares
from sdc_taichi.plant import cooling
from sdc_taichi.sim.drivers import FleetSeries, fleet_series
from sdc_taichi.sim.fleet import NO_LIMIT_W, Fleet
from sdc_taichi.sim.step_inputs import Commands, Surroundings, UnitIndex
from sdc_taichi.types import F64, I64, SetpointQuantities, State


@dataclass
class Supply(SetpointQuantities):
    """How the CRAC units run during one step: B data centers, U units."""

    coldest_supply_c: F64
    """Coldest supply air of each unit, in C, (U,): its setpoint, less the design rise of the air
    where that is of the return air."""
    cooling_run: I64
    """Equal cooling commands in a row that each unit has had, (U,)."""
    cooling_last: F64
    """Cooling command of each unit, in steps, (U,)."""
    fan_speed: F64
    """Controlled speed of each fan over full speed, (U,)."""
    unit_low: F64
    """Lowest speed of each fan over full speed in this step, (U,)."""
    unit_high: F64
    """Highest speed of each fan over full speed in this step, (U,)."""
    plant_setpoint_c: F64
    """Coldest supply air, which the chilled water follows, in C, (B,)."""
    coil_limit_w: F64
    """Capacity of the coils of the units that run, in W, (B,)."""
    coil_share: F64
    """Airflow at full speed of the units that run over that of the design point, at most 1,
    (B,)."""


class CracUnits:
    """The CRAC units of a fleet.

    Args:
        fleet: B data centers with U CRAC units.
        units: The units by data center.
    """

    def __init__(self, fleet: Fleet, units: UnitIndex) -> None:
        self._units = units

        def of_each(path: str) -> F64:
            return fleet.values(path)[units.dc]

        self._setpoint_model = cooling.SETPOINTS[fleet.models["setpoint"]]
        self._setpoint_limits = {
            "step_k": of_each("hvac.setpoint.step_k"),
            "low_c": of_each("hvac.setpoint.min_c"),
            "high_c": of_each("hvac.setpoint.max_c"),
        }
        self._initial_c = of_each("hvac.setpoint.initial_c")
        self._schedule_c = schedules_c(fleet)
        self._fan_step = of_each("hvac.crac.fan_step")
        self._coasting = of_each("hvac.crac.coasting_flow_ratio")
        self._min_speed = of_each("hvac.crac.min_flow_ratio")
        self._setpoint_over_supply_k = fleet.setpoint_over_supply_k[units.dc]
        self._capacity_w = fleet.unit_capacity_w
        self._full_m3s, self._design_m3s = fleet.unit_design_m3s, fleet.design_flow_m3s
        self._ones, full_speed = np.ones(fleet.size), np.ones(fleet.units)
        self._design_speed = fleet.design_speed[units.dc]
        flow_model = fleet.models["crac_flow"]
        self._controlled = flow_model == "controlled"
        self._holds_pressure = flow_model == "pressure"
        follows = flow_model in ("follow_servers", "hottest_inlet")
        at_design = self._design_speed, self._design_speed
        self._free_range = (self._min_speed, full_speed) if follows else at_design

    def initial_supply(self) -> Supply:
        """Initial setpoints and fan speeds of units that all run, before any command."""
        n_units = len(self._initial_c)
        setpoint_c = self._initial_c.copy()
        low, high = self._free_range
        return Supply(
            unit_setpoint_c=setpoint_c,
            coldest_supply_c=self.coldest_supply_c(setpoint_c),
            setpoint_c=self._units.mean(setpoint_c),
            cooling_run=np.zeros(n_units, dtype=np.int64),
            cooling_last=np.full(n_units, np.nan),
            fan_speed=self._design_speed.copy(),
            unit_low=low,
            unit_high=high,
            plant_setpoint_c=self._units.lowest(self.coldest_supply_c(setpoint_c)),
            coil_limit_w=self._units.sum(self._capacity_w),
            coil_share=self._ones,
        )

    def coldest_supply_c(self, unit_setpoint_c: F64) -> F64:
        """Coldest supply air of each unit by its setpoint, each in C, (U,)."""
        return unit_setpoint_c - self._setpoint_over_supply_k

    def supply(self, state: State, commands: Commands, surroundings: Surroundings) -> Supply:
        """Setpoints and fan speeds of a step.

        Args:
            state: State at the start of the step.
            commands: What to do with setpoints and fans.
            surroundings: Which units run.
        """
        unit_setpoint_c, cooling_run, cooling_last = self._setpoint_model(
            state.setpoint_c,
            commands.unit_cooling_command,
            state.cooling_run,
            state.cooling_last,
            **self._setpoint_limits,
        )
        if commands.follows_schedule and self._schedule_c is not None:
            scheduled_c = self._units.of_each(self._schedule_c.at(state.start + state.step))
            unit_setpoint_c = np.where(np.isnan(scheduled_c), unit_setpoint_c, scheduled_c)
        fan_speed = self._moved_fans(state.fan_speed, commands.unit_fan_command)
        unit_low, unit_high = self._speed_range(fan_speed, surroundings)
        coldest_c = self.coldest_supply_c(unit_setpoint_c)
        plant_setpoint_c, coil_limit_w, coil_share = self._served_by_plant(coldest_c, surroundings)
        return Supply(
            unit_setpoint_c=unit_setpoint_c,
            coldest_supply_c=coldest_c,
            setpoint_c=self._units.mean(unit_setpoint_c),
            cooling_run=cooling_run,
            cooling_last=cooling_last,
            fan_speed=fan_speed,
            unit_low=unit_low,
            unit_high=unit_high,
            plant_setpoint_c=plant_setpoint_c,
            coil_limit_w=coil_limit_w,
            coil_share=coil_share,
        )

    def _moved_fans(self, fan_speed: F64, command: F64 | None) -> F64:
        """Speed of each fan after its command, (U,)."""
        if command is None:
            return fan_speed
        return np.clip(fan_speed + command * self._fan_step, self._min_speed, 1.0)

    def _speed_range(self, fan_speed: F64, surroundings: Surroundings) -> tuple[F64, F64]:
        """Speeds between which each fan follows the airflow of the servers, each (U,).

        Fans of units that are down coast at one speed.
        """
        low, high = self._free_range
        if self._controlled:
            low = high = fan_speed
        if surroundings.all_running:
            return low, high
        runs = surroundings.unit_running > 0
        if self._holds_pressure:
            low = high = self._speed_that_holds_pressure(runs)
        return np.where(runs, low, self._coasting), np.where(runs, high, self._coasting)

    def _speed_that_holds_pressure(self, runs: npt.NDArray[np.bool_]) -> F64:
        """Speed at which the units that run give the design airflow, at most full speed, (U,)."""
        coasting_m3s = self._units.sum(np.where(runs, 0.0, self._coasting * self._full_m3s))
        running_m3s = self._units.sum(np.where(runs, self._full_m3s, 0.0))
        speed = (self._design_m3s - coasting_m3s) / np.maximum(running_m3s, 1e-30)
        return np.clip(self._units.of_each(speed), self._min_speed, 1.0)

    def _served_by_plant(
        self, coldest_supply_c: F64, surroundings: Surroundings
    ) -> tuple[F64, F64, F64]:
        """What the plant sees of the coils in use, each (B,).

        Returns:
            Coldest supply air, in C, which the chilled water follows, of the units that run, or
            without any of all; capacity of the coils, in W; and their share of the airflow.
        """
        lowest_c = self._units.lowest(coldest_supply_c)
        if surroundings.all_running:
            return lowest_c, self._units.sum(self._capacity_w), self._ones
        running = surroundings.unit_running
        coldest_c = self._units.lowest(np.where(running > 0, coldest_supply_c, np.inf))
        coldest_c = np.where(np.isinf(coldest_c), lowest_c, coldest_c)
        in_use_m3s = self._units.sum(running * self._full_m3s)
        share = np.minimum(in_use_m3s / self._design_m3s, 1.0)
        return coldest_c, self._units.sum(running * self._capacity_w), share


def schedules_c(fleet: Fleet) -> FleetSeries | None:
    """Scheduled setpoints over the steps of a year, in C; nan without a schedule.

    None if no data center has one.
    """
    hourly_c: dict[SetpointConfig, F64] = {}
    none_c = np.array([np.nan])
    for setpoint in (config.hvac.setpoint for config in fleet.configs):
        if setpoint not in hourly_c:
            of_day_c = setpoint.hourly_c()
            hourly_c[setpoint] = (
                none_c if of_day_c is None else np.repeat(of_day_c, fleet.steps_per_hour)
            )
    schedules = [hourly_c[config.hvac.setpoint] for config in fleet.configs]
    return None if all(x is none_c for x in schedules) else fleet_series(schedules)


_MOST_STORED = 4096
"""Most sets of running units whose weights are stored."""


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
        self._weights_of_set: dict[tuple[int, bytes], F64] = {}

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
        runs = running[units]
        shares = fleet.air.unit_shares[at].reshape(-1, len(runs))
        key = int(fleet.air.steady_state_of_dc[dc]), runs.tobytes()
        if key not in self._weights_of_set:
            if len(self._weights_of_set) == _MOST_STORED:
                self._weights_of_set.clear()
            self._weights_of_set[key] = self._weights(dc, shares, runs)
        self.weight[units] = self._weights_of_set[key]
        some_down = bool(np.any(runs > 0) and np.any(runs == 0))
        self._adjusts_supply[dc] = some_down or self._always_adjusts[dc]
        by_block = shares_by_block(weighted_shares(shares, self._weights_of_set[key]), self._lanes)
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
