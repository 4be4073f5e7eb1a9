"""Steady states of one data center under many commands of its CRAC units at once."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.errors import ConfigError, OddInputWarning
from sdc_taichi.sim.bills import with_prices
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.events import schedule
from sdc_taichi.sim.fleet import build_fleet
from sdc_taichi.sim.hall_state import Conditions, Precision
from sdc_taichi.sim.physical_limits import AIR_LIMITS_C
from sdc_taichi.sim.stages import make_stages, without_memory
from sdc_taichi.sim.step_inputs import Surroundings
from sdc_taichi.types import F64


@dataclass(frozen=True, slots=True)
class HallConditions:
    """Load, weather and failures of a data center with R racks and U CRAC units."""

    rack_load: F64
    """Load of each rack, 0..1, (R,)."""
    outdoor_c: float
    """Outdoor dry-bulb temperature, in C."""
    wet_bulb_c: float
    """Outdoor wet-bulb temperature, in C."""
    running: F64
    """1 for running units, 0 for units that are down, (U,)."""


@dataclass(frozen=True, slots=True)
class HallStates:
    """Steady states of n copies of a data center with R racks and U CRAC units."""

    facility_w: F64
    """Power of IT and overhead, in W, (n,); inf for copies without steady air."""
    cooling_w: F64
    """Power of HVAC and of the fans of servers, in W, (n,); inf for copies without steady air."""
    crac_fan_w: F64
    """Power of the CRAC fans, in W, (n,)."""
    chiller_w: F64
    """Power of the chiller, in W, (n,)."""
    unmet_w: F64
    """Heat that is not removed, in W, (n,)."""
    inlet_max_c: F64
    """Hottest server inlet, in C, (n,); inf for copies without steady air."""
    rack_inlet_max_c: F64
    """Hottest server inlet of each rack, in C, (n, R)."""
    speed: F64
    """Speed of each fan as a share of full speed, (n, U)."""


class CommandedHalls:
    """Copies of a data center in steady states, each with its own commands for the CRAC units.

    They have neither events, protection, queue nor thermal memory, and the sizes of the original.

    Args:
        config: The data center.
        drivers: Its inputs, of which the design temperatures are read.
        copies: Number n of copies.
        precision: Precision of the server kernels.
        fans: ``controlled`` for fans at the commanded speeds, ``follow_servers`` for fans that
            follow the need of the racks above these speeds.
    """

    def __init__(
        self,
        config: DataCenterConfig,
        drivers: Drivers,
        copies: int,
        precision: Precision = "f64",
        fans: Literal["controlled", "follow_servers"] = "controlled",
    ) -> None:
        if config.liquid is not None:
            raise ConfigError(
                f"{config.name}: halls with liquid-cooled racks have no known best commands; "
                "valid is a hall without section liquid"
            )
        self.copies = copies
        """Number n of copies."""
        self._follows = fans == "follow_servers"
        with warnings.catch_warnings():
            # Building the original data center has already issued the same warnings.
            warnings.simplefilter("ignore", OddInputWarning)
            fleet = build_fleet([_with_fans(without_memory(config), fans)] * copies)
        self._fleet, self._inputs = fleet, with_prices(drivers.take([0] * copies), fleet.configs)
        self.units = fleet.units // copies
        """Number U of CRAC units of a copy."""
        self.min_speed = config.hvac.crac.min_flow_ratio
        """Lowest speed of a running fan as a share of full speed."""
        self.setpoint_c = (config.hvac.setpoint.min_c, config.hvac.setpoint.max_c)
        """Lowest and highest setpoint, in C."""
        self._coasting = config.hvac.crac.coasting_flow_ratio
        self._server_share = fleet.per_rack_servers() / fleet.per_dc_servers()[0]
        self._stages = make_stages(fleet, self._inputs, precision, event_free=False)
        self._stages.hall.flags_limits = True
        seeds = np.zeros(copies, dtype=np.int64)
        self._state = self._stages.initial_state(fleet, seeds, self._inputs)
        self._commands = self._stages.decoder.decode(None)
        self._normal = schedule(
            fleet.configs,
            fleet.places,
            steps_per_hour=fleet.steps_per_hour,
            seed=0,
        ).at(0)

    def at(self, speed: F64, supply_c: F64, conditions: HallConditions) -> HallStates:
        """Return the steady states at some commands.

        Args:
            speed: Speed of each fan as a share of full speed, (m, U), for m of at most n copies.
            supply_c: Supply temperature of each unit, in C, (m, U).
            conditions: Load, weather and failures.
        """
        m, n, stages = len(speed), self.copies, self._stages
        speed, supply_c = (
            np.repeat(x, [1] * (m - 1) + [n - m + 1], axis=0) for x in (speed, supply_c)
        )
        running = np.tile(conditions.running, n)
        surroundings = self._surroundings(conditions, running)
        low = np.where(running > 0, speed.ravel(), self._coasting)
        high = np.where(running > 0, 1.0, self._coasting) if self._follows else low
        rack_load = np.tile(conditions.rack_load, n)
        air = stages.hall.solve(
            Conditions(
                unit_supply_c=supply_c.ravel(),
                utilisation=self._fleet.rack_sums(rack_load * self._server_share),
                rack_load=rack_load,
                unit_low=low,
                unit_high=high,
                unit_running=None if surroundings.all_running else running,
            )
        )
        supply = stages.crac_units.at_speed(supply_c.ravel(), low, high, surroundings)
        results = stages.facility.step(self._state, self._commands, surroundings, supply, air)
        racks = air.rack_outlet_max_c.astype(np.float64).reshape(n, -1)
        beyond = (results["within_limits"] < 1.0) | ~(racks.max(axis=1) <= AIR_LIMITS_C[1])
        if stages.hall.beyond_limits is not None:
            beyond |= stages.hall.beyond_limits
        facility_w = results["it_w"] + results["overhead_w"]
        inlets_c = air.rack_inlet_max_c.astype(np.float64).reshape(n, -1)
        return HallStates(
            facility_w=np.where(beyond, np.inf, facility_w)[:m],
            cooling_w=np.where(beyond, np.inf, results["hvac_w"] + air.it_fan_w)[:m],
            crac_fan_w=results["crac_fan_w"][:m],
            chiller_w=results["chiller_w"][:m],
            unmet_w=results["unmet_w"][:m],
            inlet_max_c=np.where(beyond, np.inf, inlets_c.max(axis=1))[:m],
            rack_inlet_max_c=inlets_c[:m],
            speed=(air.unit_airflow_m3s / self._fleet.unit_design_m3s).reshape(n, -1)[:m],
        )

    def _surroundings(self, conditions: HallConditions, running: F64) -> Surroundings:
        ones, event = np.ones(self.copies), self._normal
        inputs = replace(
            self._inputs.at(0),
            outdoor_c=conditions.outdoor_c * ones,
            wet_bulb_c=conditions.wet_bulb_c * ones,
        )
        if not running.all():
            event = replace(event, active=True, active_events=ones, unit_up=running > 0)
        return self._stages.surroundings.at(inputs, event, self._state.stored_kwh)


def _with_fans(config: DataCenterConfig, fans: str) -> DataCenterConfig:
    crac = config.hvac.crac.model_copy(update={"flow_model": fans})
    hvac = config.hvac.model_copy(update={"crac": crac})
    return config.model_copy(update={"hvac": hvac})
