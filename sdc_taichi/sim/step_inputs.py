"""What a step starts from: commands of its actions, and surroundings of the data centers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import SdcError
from sdc_taichi.sim.events import Disturbance
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import (
    F64,
    Actions,
    BatteryAction,
    CommandQuantities,
    CoolAction,
    Exogenous,
    FanAction,
    LoadAction,
    SiteQuantities,
)


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


MOST_MOVES = 1e6
"""Largest command of a setpoint or a fan, in steps; far beyond the range of either."""


@dataclass
class Commands(CommandQuantities):
    """Actions of one step as arrays: B data centers, U CRAC units, G server groups."""

    unit_cooling_command: F64
    """Steps by which the setpoint of each CRAC unit moves, (U,)."""
    follows_schedule: bool
    """Whether setpoints that have a schedule follow it, as no cooling command is given."""
    unit_fan_command: F64 | None
    """Steps by which the speed of each CRAC fan moves, (U,); None holds all of them."""
    group_weights: F64 | None
    """Relative load of each server group, (G,); None weighs all alike."""


class ActionDecoder:
    """Checks actions and brings every form that they may have to arrays.

    Args:
        fleet: B data centers with U CRAC units and G server groups.
        units: The CRAC units by data center.
    """

    def __init__(self, fleet: Fleet, units: UnitIndex) -> None:
        self._fleet, self._units = fleet, units
        self._size, self._n_units = fleet.size, fleet.units
        self._flow_model = fleet.models["crac_flow"]
        self._placement = fleet.models["placement"]

    def decode(self, actions: Actions | None) -> Commands:
        """Commands of one step.

        Args:
            actions: What to do; None is neutral.

        Raises:
            SdcError: Actions of the wrong type, shape or range, or that no model reads.
        """
        if actions is not None and not isinstance(actions, Actions):
            raise SdcError(f"actions are a {type(actions).__name__}; valid is Actions(...)")
        wanted = actions or Actions()
        load_command = self._command("load", wanted.load, LoadAction, limit=1.0)
        battery_command = self._command("battery", wanted.battery, BatteryAction, limit=1.0)
        cooling = CoolAction.HOLD if wanted.cooling is None else wanted.cooling
        unit_cooling_command = self._unit_command("cooling", cooling, CoolAction)
        return Commands(
            load_command=load_command,
            battery_command=battery_command,
            cooling_command=self._units.mean(unit_cooling_command),
            unit_cooling_command=unit_cooling_command,
            follows_schedule=wanted.cooling is None,
            unit_fan_command=self._fan_command(wanted.fan),
            group_weights=self._group_weights(wanted.placement),
        )

    def _fan_command(self, action: Any) -> F64 | None:
        if action is FanAction.HOLD:
            return None
        command = self._unit_command("fan", action, FanAction)
        if self._flow_model == "controlled":
            return command
        if np.any(command):
            raise SdcError(
                f"action fan: given, but hvac.crac.flow_model is {self._flow_model}; valid is "
                "HOLD, or flow model controlled"
            )
        return None

    def _group_weights(self, placement: Any) -> F64 | None:
        """Weights of the server groups, (G,), from one per rack or per group."""
        if placement is None:
            return None
        if self._placement != "weights":
            raise SdcError(
                f"action placement: given, but workload.placement is {self._placement}; valid is "
                "None"
            )
        racks, groups = self._fleet.racks, self._fleet.groups
        try:
            weights = np.asarray(placement, dtype=np.float64)
        except (TypeError, ValueError):
            raise SdcError(f"action placement: {placement!r} are no numbers") from None
        if weights.shape == (groups,):
            return weights
        if weights.shape == (racks,):
            return np.repeat(weights, np.diff(self._fleet.group_offsets))
        raise SdcError(
            f"action placement: shape {weights.shape}, expected ({racks},), one per rack, or "
            f"({groups},), one per server group"
        )

    def _unit_command(self, name: str, action: Any, kind: type[Enum]) -> F64:
        """A command for each CRAC unit, (U,), given for all, per data center or per unit."""
        command = self._command(name, action, kind, limit=MOST_MOVES, also=self._n_units)
        return command if len(command) == self._n_units else self._units.of_each(command)

    def _command(
        self,
        name: str,
        action: Any,
        kind: type[Enum],
        *,
        limit: float,
        also: int | None = None,
    ) -> F64:
        """A finite command within -limit..limit for each data center, (B,), or ``also`` entries."""
        if isinstance(action, Enum):
            if not isinstance(action, kind):
                raise SdcError(f"action {name}: {action} is no {kind.__name__}")
            return np.full(self._size, float(action.value))
        if isinstance(action, list | tuple) and any(isinstance(x, Enum) for x in action):
            action = [x.value if isinstance(x, kind) else x for x in action]
        try:
            command = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise SdcError(
                f"action {name}: {action!r} is neither {kind.__name__} nor numbers"
            ) from None
        if command.shape not in ((), (self._size,), (also,)):
            valid = dict.fromkeys([(), (self._size,), *([] if also is None else [(also,)])])
            raise SdcError(
                f"action {name}: shape {command.shape}, expected {' or '.join(map(str, valid))}"
            )
        largest = np.maximum.reduce(np.abs(command), axis=None)
        # Comparisons with NaN are false, so that it ends here too.
        if not largest <= limit:
            wrong = ~(np.abs(command) <= limit)
            value = command[wrong].flat[0] if command.ndim else command
            raise SdcError(
                f"action {name}: {value}; valid is a finite number within -{limit:g}..{limit:g}"
            )
        return np.full(self._size, float(command)) if command.ndim == 0 else command.copy()


@dataclass
class Surroundings(SiteQuantities):
    """Surroundings of one step of B data centers, U CRAC units and R racks."""

    fully_powered: bool
    """Whether all data centers have power throughout the step."""
    chiller_share: F64
    """Chiller capacity that is available, as a share of its full capacity, 0..1, (B,)."""
    pump_share: F64
    """Chilled-water pumps that are in order, as a share of all, 0..1, (B,)."""
    outdoor_units: F64
    """Tower cells, dry coolers or openings for outdoor air in order, as a share of all, 0..1,
    (B,)."""
    no_unit_down: F64
    """1 if all CRAC units run, 0 if one is down, (B,)."""
    all_running: bool
    """Whether all CRAC units of all data centers run."""
    rack_airflow: F64 | None
    """Airflow of each rack that remains, as a share of its full airflow, 0..1, (R,); None is 1."""


class SurroundingsModel:
    """Puts together what a step meets.

    Args:
        fleet: B data centers.
        units: Their CRAC units.
        powered_share: ``Facility.powered_share``: how long batteries carry them in an outage.
    """

    def __init__(
        self,
        fleet: Fleet,
        units: UnitIndex,
        powered_share: Callable[[npt.NDArray[np.bool_], F64], F64],
    ) -> None:
        self._units, self._powered_share = units, powered_share
        self._ones, self._zeros = np.ones(fleet.size), np.zeros(fleet.size)
        self._unit_ones = np.ones(fleet.units)

    def at(self, exogenous: Exogenous, event: Disturbance, stored_kwh: F64) -> Surroundings:
        """Surroundings of one step.

        Args:
            exogenous: Weather, carbon intensity and demand of the step.
            event: What events do to the step.
            stored_kwh: Energy in the batteries at the start of the step, kWh, (B,).
        """
        if not event.active:
            return Surroundings(
                outdoor_c=exogenous.outdoor_c,
                wet_bulb_c=exogenous.wet_bulb_c,
                ci_g_per_kwh=exogenous.ci_g_per_kwh,
                demand=exogenous.demand,
                active_events=self._zeros.copy(),
                price_per_kwh=exogenous.price_per_kwh,
                grid_up=self._ones.copy(),
                powered=self._ones.copy(),
                fully_powered=True,
                chiller_share=self._ones,
                pump_share=self._ones,
                outdoor_units=self._ones,
                unit_running=self._unit_ones.copy(),
                no_unit_down=self._ones,
                all_running=True,
                rack_airflow=None,
            )
        powered = self._powered_share(event.grid_up, stored_kwh)
        running = event.unit_up & (self._units.of_each(powered) > 0)
        unit_running = running.astype(np.float64)
        return Surroundings(
            outdoor_c=exogenous.outdoor_c + event.outdoor_offset_k,
            wet_bulb_c=exogenous.wet_bulb_c + event.outdoor_offset_k,
            ci_g_per_kwh=exogenous.ci_g_per_kwh,
            demand=exogenous.demand,
            active_events=event.active_events.copy(),
            price_per_kwh=exogenous.price_per_kwh,
            grid_up=event.grid_up.astype(np.float64),
            powered=powered,
            fully_powered=bool(np.all(powered == 1.0)),
            chiller_share=event.chiller_share,
            pump_share=event.pump_share,
            outdoor_units=event.outdoor_units,
            unit_running=unit_running,
            no_unit_down=self._units.lowest(unit_running),
            all_running=bool(np.all(running)),
            rack_airflow=event.rack_airflow,
        )
