"""CRAC units: setpoints and fan speeds of a step, and each unit's share in the racks' supply."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config.hvac_schema import SetpointConfig
from sdc_taichi.errors import SdcError
from sdc_taichi.hall.unit_supply import airflow_with_losses_m3s, unit_weights, weighted_shares
from sdc_taichi.plant import cooling
from sdc_taichi.plant.chiller import CHILLERS
from sdc_taichi.sim.drivers import FleetSeries, fleet_series
from sdc_taichi.sim.fleet import NO_LIMIT_W, Fleet
from sdc_taichi.sim.step_inputs import Commands, Surroundings, UnitIndex
from sdc_taichi.types import F64, I64, SetpointQuantities, State

ROUNDING_K = 1e-9
"""Difference up to which a commanded temperature may exceed its limit, in K."""


@dataclass
class Supply(SetpointQuantities):
    """Operation of the CRAC units during one step: B data centers, U units."""

    coldest_supply_c: F64
    """Coldest supply temperature of each unit, in C, (U,): its setpoint; with control of the return
    air, the setpoint minus the design temperature rise of the hall."""
    cooling_run: I64
    """Number of consecutive equal cooling commands that each unit has received, (U,)."""
    cooling_last: F64
    """Last cooling command of each unit, in setpoint steps, (U,)."""
    fan_speed: F64
    """Controlled speed of each fan as a share of full speed, (U,)."""
    unit_low: F64
    """Minimum speed of each fan in this step, as a share of full speed, (U,)."""
    unit_high: F64
    """Maximum speed of each fan in this step, as a share of full speed, (U,)."""
    plant_setpoint_c: F64
    """Coldest supply temperature of the running units, in C, (B,)."""
    water_setpoint_c: F64
    """Supply temperature that the chilled water is cold enough for, in C, (B,):
    ``plant_setpoint_c``, or lower if an action commands colder water."""
    coil_limit_w: F64
    """Total coil capacity of the running units, in W, (B,)."""
    coil_share: F64
    """Full-speed airflow of the running units as a share of the design airflow, at most 1, (B,)."""


@dataclass
class UnitAir:
    """Air and water of the CRAC units of B data centers at the start of a step."""

    return_c: F64
    """Temperature of the return air, in C, (B,)."""
    flow_m3s: F64
    """Airflow of the units, in m3/s, (B,)."""
    warmed_k: F64
    """Temperature of the chilled water, or in halls without water of the room, minus its setpoint,
    at least 0, in K, (B,)."""


class CracUnits:
    """The CRAC units of a fleet.

    Args:
        fleet: B data centers with U CRAC units.
        units: Mapping between data centers and units.
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
        self._names, self._chiller = fleet.names, fleet.models["chiller"]
        self._coil_approach_k = fleet.values("hvac.chiller.coil_approach_k")
        self._water_range_c = CHILLERS[self._chiller].water_range_c
        self._ones, full_speed = np.ones(fleet.size), np.ones(fleet.units)
        self._design_speed = fleet.design_speed[units.dc]
        flow_model = fleet.models["crac_flow"]
        self._controlled = flow_model == "controlled"
        self._holds_pressure = flow_model == "pressure"
        follows = flow_model in ("follow_servers", "hottest_inlet")
        at_design = self._design_speed, self._design_speed
        self._free_range = (self._min_speed, full_speed) if follows else at_design

    def initial_supply(self) -> Supply:
        """Return initial setpoints and fan speeds before any command, with all units running."""
        n_units = len(self._initial_c)
        setpoint_c = self._initial_c.copy()
        low, high = self._free_range
        coldest_supply_c = self.coldest_supply_c(setpoint_c)
        coldest_c = self._units.lowest(coldest_supply_c)
        return Supply(
            unit_setpoint_c=setpoint_c,
            coldest_supply_c=coldest_supply_c,
            setpoint_c=self._units.mean(setpoint_c),
            cooling_run=np.zeros(n_units, dtype=np.int64),
            cooling_last=np.full(n_units, np.nan),
            fan_speed=self._design_speed.copy(),
            unit_low=low,
            unit_high=high,
            plant_setpoint_c=coldest_c,
            water_setpoint_c=coldest_c,
            coil_limit_w=self._units.sum(self._capacity_w),
            coil_share=self._ones,
        )

    def at_speed(
        self, unit_supply_c: F64, low: F64, high: F64, surroundings: Surroundings
    ) -> Supply:
        """Return the operation of the units at given supply temperatures and fan speeds.

        Args:
            unit_supply_c: Supply temperature of each unit, in C, (U,).
            low: Minimum speed of each fan as a share of full speed, (U,).
            high: Maximum speed of each fan as a share of full speed, (U,).
            surroundings: Surroundings, of which the running units are read.
        """
        plant_setpoint_c, coil_limit_w, coil_share = self._served_by_plant(
            unit_supply_c, surroundings
        )
        return replace(
            self.initial_supply(),
            unit_setpoint_c=unit_supply_c + self._setpoint_over_supply_k,
            coldest_supply_c=unit_supply_c,
            setpoint_c=self._units.mean(unit_supply_c + self._setpoint_over_supply_k),
            fan_speed=low,
            unit_low=low,
            unit_high=high,
            plant_setpoint_c=plant_setpoint_c,
            water_setpoint_c=plant_setpoint_c,
            coil_limit_w=coil_limit_w,
            coil_share=coil_share,
        )

    def coldest_supply_c(self, unit_setpoint_c: F64) -> F64:
        """Return the coldest supply temperature of each unit at a setpoint, both in C, (U,)."""
        return unit_setpoint_c - self._setpoint_over_supply_k

    def supply(self, state: State, commands: Commands, surroundings: Surroundings) -> Supply:
        """Compute setpoints and fan speeds of a step.

        Args:
            state: State at the start of the step.
            commands: Commands for setpoints, fans and chilled water.
            surroundings: Surroundings of the step, of which the running units are read.

        Raises:
            SdcError: The commanded chilled water is too warm for the setpoints, or outside the
                range of the chiller model.
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
            water_setpoint_c=self._water_setpoint_c(
                plant_setpoint_c, commands.chilled_water_command_c
            ),
            coil_limit_w=coil_limit_w,
            coil_share=coil_share,
        )

    def _water_setpoint_c(self, plant_setpoint_c: F64, chilled_water_c: F64 | None) -> F64:
        """Return the supply temperature that the chilled water is cold enough for, in C, (B,).

        Args:
            plant_setpoint_c: Coldest supply temperature of the running units, in C, (B,).
            chilled_water_c: Commanded water temperature, in C, (B,); None follows the setpoints.

        Raises:
            SdcError: The water is too warm for the setpoints, or outside the chiller's range.
        """
        if chilled_water_c is None:
            return plant_setpoint_c
        low_c, high_c = self._water_range_c
        most_c = np.minimum(plant_setpoint_c - self._coil_approach_k, high_c)
        valid = (chilled_water_c >= low_c) & (chilled_water_c <= most_c + ROUNDING_K)
        if not np.all(valid):
            dc = int(np.argmin(valid))
            of_dc = f" of {self._names[dc]}" if len(valid) > 1 else ""
            raise SdcError(
                f"action chilled_water{of_dc}: {chilled_water_c[dc]:g} C; valid is {low_c:g}.."
                f"{most_c[dc]:g} C, as the coldest supply air is {plant_setpoint_c[dc]:g} C, "
                f"hvac.chiller.coil_approach_k {self._coil_approach_k[dc]:g} K, and chiller "
                f"{self._chiller} makes water of {low_c:g}..{high_c:g} C"
            )
        return np.asarray(chilled_water_c + self._coil_approach_k)

    def _moved_fans(self, fan_speed: F64, command: F64 | None) -> F64:
        """Return the speed of each fan after its command, as a share of full speed, (U,)."""
        if command is None:
            return fan_speed
        return np.clip(fan_speed + command * self._fan_step, self._min_speed, 1.0)

    def _speed_range(self, fan_speed: F64, surroundings: Surroundings) -> tuple[F64, F64]:
        """Return minimum and maximum fan speeds, between which fans follow the server airflow.

        Both have shape (U,) and are shares of full speed. Fans of units that are down coast at a
        fixed speed.
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
        """Return the fan speed at which the running units supply the design airflow, (U,).

        The speed is limited to the range from the minimum speed to full speed.
        """
        coasting_m3s = self._units.sum(np.where(runs, 0.0, self._coasting * self._full_m3s))
        running_m3s = self._units.sum(np.where(runs, self._full_m3s, 0.0))
        speed = (self._design_m3s - coasting_m3s) / np.maximum(running_m3s, 1e-30)
        return np.clip(self._units.of_each(speed), self._min_speed, 1.0)

    def _served_by_plant(
        self, coldest_supply_c: F64, surroundings: Surroundings
    ) -> tuple[F64, F64, F64]:
        """Return the coil quantities that the cooling plant depends on, each (B,).

        Returns:
            Coldest supply temperature of the running units, in C (of all units if none runs);
            total coil capacity of the running units, in W; and ``Supply.coil_share``.
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
    """Return the scheduled setpoint of each data center over the steps of a year, in C.

    Data centers without a schedule have the value nan. The result is None if no data center has a
    schedule.
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
"""Maximum number of sets of running units whose weights are cached."""


class SharedPlenum:
    """Keeps each CRAC unit's share in the racks' supply up to date when units stop or start.

    Shares are recomputed only for data centers whose set of running units changes, and the result
    is cached for equal halls.

    Args:
        fleet: Data centers; without recirculation, ``supply_from`` does nothing.
        kernel_shares: Array of shares that the kernels read, initially for all units running.
        first_share: First vector of each data center in ``kernel_shares``.
        lanes: Number of racks in a vector.
        adjusts_supply: Row of the kernels that is 1 if the supply temperature may differ from the
            setpoint, (B,).
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
        """Weight of each CRAC unit in the shares of all racks, (U,); 1 while all units run."""
        self.drawn_ratio = np.ones(fleet.units)
        """Supply air that the racks draw from each unit at the design point, divided by what they
        draw while all units run, (U,); 1 for units from which they draw none."""
        self._whole = np.ones(fleet.units)
        self._running = self._whole
        self._weights_of_set: dict[tuple[int, bytes], F64] = {}

    def supply_from(self, running: F64 | None) -> None:
        """Update the shares for the running units.

        Args:
            running: 1 for running units, 0 for units that are down, (U,); None if all run.
        """
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
        some_down = bool(np.any(runs > 0) and np.any(runs == 0))
        self._adjusts_supply[dc] = some_down or self._always_adjusts[dc]
        if fleet.plenum_coupling[dc] > 0:
            return  # The kernels weigh the units by their airflow, whichever run.
        shares = fleet.air.unit_shares[at].reshape(-1, len(runs))
        key = int(fleet.air.steady_state_of_dc[dc]), runs.tobytes()
        if key not in self._weights_of_set:
            if len(self._weights_of_set) == _MOST_STORED:
                self._weights_of_set.clear()
            self._weights_of_set[key] = self._weights(dc, shares, runs)
        self.weight[units] = weight = self._weights_of_set[key]
        weighted, self.drawn_ratio[units] = self._weighted(dc, weight)
        by_block = shares_by_block(weighted, self._lanes)
        first = int(self._first_share[dc])
        self._kernel_shares[first : first + len(by_block)] = by_block

    def drawn_ratio_at(self, strength: F64) -> F64:
        """Return ``drawn_ratio`` at other weights of the units in coupled halls, both (U,)."""
        ratio = np.ones(len(strength))
        for dc in np.unique(self._fleet.unit_dc[strength != 1.0]):
            units = slice(*self._fleet.unit_offsets[dc : dc + 2])
            _, ratio[units] = self._weighted(int(dc), strength[units])
        return ratio

    def _weighted(self, dc: int, weight: F64) -> tuple[F64, F64]:
        """Return the shares of a data center's units at given weights, and ``drawn_ratio``."""
        fleet = self._fleet
        assert fleet.air is not None
        at = slice(*fleet.air.unit_share_offsets[dc : dc + 2])
        shares = fleet.air.unit_shares[at].reshape(-1, len(weight))
        weighted = weighted_shares(shares, weight)
        need_m3s = fleet.air.rack_need_m3s[slice(*fleet.rack_offsets[dc : dc + 2])]
        drawn_m3s, of_all_m3s = need_m3s @ weighted, need_m3s @ shares
        is_drawn = (drawn_m3s > 0) & (of_all_m3s > 0)
        drawn_ratio = np.where(is_drawn, drawn_m3s, 1.0) / np.where(is_drawn, of_all_m3s, 1.0)
        return weighted, drawn_ratio

    def _weights(self, dc: int, shares: F64, running: F64) -> F64:
        """Compute the supply weights of the units of a data center, (U,)."""
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
    """Arrange shares for the kernels: one vector of racks per block and unit, (blocks * U, lanes).

    Args:
        shares: Share of each unit in the supply of each rack, (R, U).
        lanes: Number of racks in a block; the last block is padded with zeros.
    """
    racks, units = shares.shape
    blocks = -(-racks // lanes)
    padded = np.zeros((blocks * lanes, units))
    padded[:racks] = shares
    return padded.reshape(blocks, lanes, units).swapaxes(1, 2).reshape(-1, lanes)
