"""What a controller may see before each step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.types import F64, I64, Exogenous, State, StepResult


@dataclass(frozen=True, slots=True)
class Limits:
    """What bounds the commands, each (B,)."""

    setpoint_low_c: F64
    setpoint_high_c: F64
    setpoint_step_k: F64
    battery_round_trip: F64
    """Energy delivered per energy drawn to charge."""


def _first_of_units(per_unit: F64, fleet: Fleet) -> F64:
    return per_unit[fleet.unit_offsets[:-1]]


@dataclass(frozen=True, slots=True)
class Forecast:
    """Perfect foresight of the inputs: the present step, then those that follow, each (B, n)."""

    drivers: Drivers
    index: I64
    """Steps since the start of the year, (B, n)."""

    @property
    def ci_g_per_kwh(self) -> F64:
        """Carbon intensity."""
        return self.drivers.ci_g_per_kwh.at(self.index)

    @property
    def outdoor_c(self) -> F64:
        """Dry bulb."""
        return self.drivers.outdoor_c.at(self.index)

    @property
    def wet_bulb_c(self) -> F64:
        """Wet bulb."""
        return self.drivers.wet_bulb_c.at(self.index)


@dataclass(frozen=True, slots=True)
class View:
    """The situation before a step of a fleet of B data centers."""

    last: StepResult | None
    """Result of the step before; None before the first."""
    state: State
    drivers: Drivers
    """Inputs of all steps; a controller that reads on sees the future."""
    fleet: Fleet
    sizing: Sizing
    limits: Limits
    step_h: float
    precision: Precision
    """Of the server kernels."""

    @property
    def now(self) -> Exogenous:
        """Inputs of the step to come."""
        return self.drivers.at(self.state.step)

    def forecast(self, hours: float) -> Forecast:
        """Inputs of the coming hours, the step to come first.

        Raises:
            ConfigError: less than a step.
        """
        steps = round(hours / self.step_h)
        if steps < 1:
            raise ConfigError(f"forecast of {hours:g} h: valid is at least {self.step_h:g} h")
        first = self.drivers.start + self.state.step
        return Forecast(self.drivers, first[:, None] + np.arange(steps))

    @property
    def setpoint_c(self) -> F64:
        """Setpoint of the first CRAC unit; built-in controllers move all units alike, (B,)."""
        return _first_of_units(self.state.setpoint_c, self.fleet)

    @property
    def cooling_last(self) -> F64:
        """Last cooling command of the first CRAC unit, (B,)."""
        return _first_of_units(self.state.cooling_last, self.fleet)

    @property
    def size(self) -> int:
        """Number of data centers, B."""
        return self.fleet.size


def limits_of(fleet: Fleet) -> Limits:
    """Limits from the configs of a fleet."""
    return Limits(
        setpoint_low_c=fleet.values("hvac.setpoint.min_c"),
        setpoint_high_c=fleet.values("hvac.setpoint.max_c"),
        setpoint_step_k=fleet.values("hvac.setpoint.step_k"),
        battery_round_trip=fleet.values("battery.charge_efficiency")
        / fleet.values("battery.discharge_factor"),
    )


def viewer(sim: Simulator) -> Callable[[StepResult | None], View]:
    """A function from the last result to the view before the next step.

    Args:
        sim: a simulator that has been reset.
    """
    step_h = sim.step_h
    limits, sizing = limits_of(sim.fleet), sim.sizing

    def look(last: StepResult | None) -> View:
        return View(last, sim.state, sim.drivers, sim.fleet, sizing, limits, step_h, sim.precision)

    return look
