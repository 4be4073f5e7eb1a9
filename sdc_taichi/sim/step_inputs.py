"""Inputs of a step: commands decoded from actions, and surroundings of the data centers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config.liquid_schema import (
    APPROACH_LIMITS_K,
    FLOW_LIMITS,
    POWER_CAP_LIMITS,
    SETPOINT_LIMITS_C,
)
from sdc_taichi.errors import SdcError
from sdc_taichi.plant.chiller import BOILING_C
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
    """Mapping between values of B data centers, (B,), and of their U CRAC units, (U,).

    If every data center has one unit, values are passed through without computation.

    Args:
        fleet: B data centers with one or more CRAC units each.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self._counts = np.diff(fleet.unit_offsets)
        self._first = fleet.unit_offsets[:-1]
        self.dc = fleet.unit_dc
        """Index of each unit's data center, (U,)."""
        self.one_each = fleet.units == fleet.size
        """True if every data center has exactly one unit."""

    def of_each(self, per_dc: F64) -> F64:
        """Return the value of each unit's data center, (U,)."""
        return per_dc if self.one_each else per_dc[self.dc]

    def mean(self, per_unit: F64) -> F64:
        """Return the mean over the units of each data center as a new array, (B,)."""
        return per_unit.copy() if self.one_each else self.sum(per_unit) / self._counts

    def sum(self, per_unit: F64) -> F64:
        """Return the sum over the units of each data center, (B,)."""
        return per_unit if self.one_each else self._fleet.unit_sums(per_unit)

    def lowest(self, per_unit: F64) -> F64:
        """Return the minimum over the units of each data center, (B,)."""
        if self.one_each:
            return per_unit
        return np.asarray(np.minimum.reduceat(per_unit, self._first), dtype=np.float64)


MOST_MOVES = 1e6
"""Maximum absolute setpoint or fan command, in steps; far beyond the range of both."""


@dataclass
class Commands(CommandQuantities):
    """Actions of one step as arrays: B data centers, U CRAC units, G server groups."""

    unit_cooling_command: F64
    """Commanded change of each CRAC unit's setpoint, in setpoint steps, (U,)."""
    follows_schedule: bool
    """True if no cooling command is given, so that setpoints with a schedule follow it."""
    unit_fan_command: F64 | None
    """Commanded change of each CRAC fan's speed, in fan steps, (U,); None holds all speeds."""
    group_weights: F64 | None
    """Relative load of each server group, (G,); None weighs all groups equally."""
    chilled_water_command_c: F64 | None
    """Commanded temperature of the chilled water, in C, (B,); None follows the setpoints."""
    transfer_shares: F64 | None
    """Share of each site's flexible work to send to each site of its fleet, (B, S); None sends
    nothing."""
    cdu_setpoint_target_c: F64 | None
    """Wanted supply temperature of each CDU, in C, (C,); None holds the setpoints."""
    cdu_flow_command: F64 | None
    """Flow of each CDU divided by its design flow, (C,); None holds it."""
    facility_approach_k: F64 | None
    """Lowest supply setpoint of the CDUs minus setpoint of the facility water, in K, (B,); None
    means the configured one."""
    reuse_share: F64 | None
    """Share of the facility water's heat that may be reused, 0..1, (B,); None means the configured
    one."""
    power_cap: F64 | None
    """Power cap of GPUs divided by their highest power, (B,); None means 1."""


LIQUID_COMMANDS: dict[str, tuple[str, tuple[float, float]]] = {
    "cdu_setpoint_c": ("cdu_setpoint_target_c", SETPOINT_LIMITS_C),
    "cdu_flow": ("cdu_flow_command", FLOW_LIMITS),
    "facility_approach_k": ("facility_approach_k", APPROACH_LIMITS_K),
    "reuse_share": ("reuse_share", (0.0, 1.0)),
    "power_cap": ("power_cap", POWER_CAP_LIMITS),
}
"""Field of ``Commands``, lowest and highest value of each action for liquid cooling, by its field
of ``Actions``."""
_HELD_LIQUID: dict[str, F64 | None] = {name: None for name, _ in LIQUID_COMMANDS.values()}
_liquid_actions = attrgetter(*LIQUID_COMMANDS)
_NEUTRAL = Actions()


class ActionDecoder:
    """Checks actions in any of their forms and converts them to arrays.

    Args:
        fleet: B data centers with U CRAC units and G server groups.
        units: Mapping between data centers and CRAC units.
    """

    def __init__(self, fleet: Fleet, units: UnitIndex) -> None:
        self._fleet, self._units = fleet, units
        self._size, self._n_units = fleet.size, fleet.units
        self._flow_model = fleet.models["crac_flow"]
        self._placement = fleet.models["placement"]
        self._cdus = fleet.cdus

    def decode(self, actions: Actions | None) -> Commands:
        """Convert the actions of one step to commands.

        Args:
            actions: Actions of the step; None means neutral actions.

        Raises:
            SdcError: An action has a wrong type, shape or range, or the configured model does not
                accept it.
        """
        if actions is not None and not isinstance(actions, Actions):
            raise SdcError(f"actions are a {type(actions).__name__}; valid is Actions(...)")
        wanted = _NEUTRAL if actions is None else actions
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
            chilled_water_command_c=self._chilled_water_command_c(wanted.chilled_water),
            transfer_shares=self._transfer_shares(wanted.transfer),
            **self._liquid_commands(wanted),
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

    def _chilled_water_command_c(self, action: Any) -> F64 | None:
        """Return the commanded water temperature, in C, (B,); ``CracUnits`` checks its limits."""
        if action is None:
            return None
        return self._command("chilled_water", action, None, limit=BOILING_C)

    def _group_weights(self, placement: Any) -> F64 | None:
        """Return weights of the server groups, (G,), from weights per rack or per group."""
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

    def _transfer_shares(self, action: Any) -> F64 | None:
        """Return the shares of flexible work to send, (B, S), after a check."""
        if action is None:
            return None
        sites = self._fleet.sites_per_fleet
        if sites == 1:
            raise SdcError(
                "action transfer: given, but the data centers share no work; valid is None, or a "
                "config with section fleet"
            )
        try:
            shares = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            raise SdcError(f"action transfer: {action!r} are no numbers") from None
        if shares.shape != (self._size, sites):
            raise SdcError(
                f"action transfer: shape {shares.shape}, expected ({self._size}, {sites}), a row "
                "per data center and a column per site of its fleet"
            )
        if not np.isfinite(shares).all():
            raise SdcError(
                f"action transfer: {shares[~np.isfinite(shares)][0]}; valid is a finite number"
            )
        return shares

    def _liquid_commands(self, wanted: Actions) -> dict[str, F64 | None]:
        """Return the commands for liquid cooling by their fields of ``Commands``, after a check."""
        actions = _liquid_actions(wanted)
        setpoint_c, flow, approach_k, share, cap = actions
        if setpoint_c is flow is approach_k is share is cap is None:
            return _HELD_LIQUID
        commands = dict(_HELD_LIQUID)
        for (name, (field, (low, high))), action in zip(
            LIQUID_COMMANDS.items(), actions, strict=True
        ):
            if action is None:
                continue
            if not self._cdus:
                raise SdcError(
                    f"action {name}: given, but no rack is liquid-cooled; valid is None, or a "
                    "config with section liquid"
                )
            per_cdu = name in ("cdu_setpoint_c", "cdu_flow")
            also = self._cdus if per_cdu else None
            command = self._command(name, action, None, limit=None, also=also)
            inside = (command >= low) & (command <= high)
            if not inside.all():
                raise SdcError(f"action {name}: {command[~inside][0]}; valid is {low:g}..{high:g}")
            if per_cdu and len(command) != self._cdus:
                command = command[self._fleet.cdu_dc]
            commands[field] = command
        return commands

    def _unit_command(self, name: str, action: Any, kind: type[Enum]) -> F64:
        """Return a command for each CRAC unit, (U,), from one for all, per data center or unit."""
        command = self._command(name, action, kind, limit=MOST_MOVES, also=self._n_units)
        return command if len(command) == self._n_units else self._units.of_each(command)

    def _command(
        self,
        name: str,
        action: Any,
        kind: type[Enum] | None,
        *,
        limit: float | None,
        also: int | None = None,
    ) -> F64:
        """Return a command for each data center, (B,), or per unit if it has ``also`` entries.

        Every entry is checked to be finite and within -limit..limit; None does not check it.
        """
        if isinstance(action, Enum):
            if kind is None or not isinstance(action, kind):
                wanted = "number" if kind is None else kind.__name__
                raise SdcError(f"action {name}: {action} is no {wanted}")
            return np.full(self._size, float(action.value))
        if isinstance(action, list | tuple) and any(isinstance(x, Enum) for x in action):
            action = [x.value if kind is not None and isinstance(x, kind) else x for x in action]
        try:
            command = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError):
            fault = "are no" if kind is None else f"is neither {kind.__name__} nor"
            raise SdcError(f"action {name}: {action!r} {fault} numbers") from None
        if command.shape not in ((), (self._size,), (also,)):
            valid = dict.fromkeys([(), (self._size,), *([] if also is None else [(also,)])])
            raise SdcError(
                f"action {name}: shape {command.shape}, expected {' or '.join(map(str, valid))}"
            )
        # A comparison with NaN is false, so NaN raises the error as well.
        if limit is not None and not np.maximum.reduce(np.abs(command), axis=None) <= limit:
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
    """True if all data centers have power throughout the step."""
    chiller_share: F64
    """Chiller capacity that is available, as a share of its full capacity, 0..1, (B,)."""
    pump_share: F64
    """Share of the chilled-water pumps that work, 0..1, (B,)."""
    tank_share: F64
    """Share of the buffer tank that is in use, 0..1, (B,)."""
    outdoor_units: F64
    """Share of the tower cells, dry coolers or outdoor air openings that work, 0..1, (B,)."""
    no_unit_down: F64
    """1 if all CRAC units of the data center run, else 0, (B,)."""
    all_running: bool
    """True if all CRAC units of all data centers run."""
    rack_airflow: F64 | None
    """Remaining airflow of each rack's fans as a share of full airflow, 0..1, (R,); None means
    full airflow."""
    cdu_up: F64 | None = None
    """1 for CDUs that have not failed, else 0, (C,); None means that nothing of the liquid cooling
    has failed, as for the four fields below."""
    cdu_pump_up: F64 | None = None
    """1 for CDUs of which all pumps work, else 0, (C,)."""
    facility_pump: F64 | None = None
    """Share of the pumps of the facility water that work, 0..1, (B,)."""
    cooler_share: F64 | None = None
    """Share of the fans that cool the facility water that work, 0..1, (B,)."""
    rack_leaks: npt.NDArray[np.bool_] | None = None
    """True for each liquid-cooled rack that leaks, (L,)."""
    leaked_l: F64 | None = None
    """Coolant lost by leaks in the step, in l, (B,)."""


class SurroundingsModel:
    """Combines exogenous inputs and events to the surroundings of a step.

    Args:
        fleet: B data centers.
        units: Mapping between data centers and CRAC units.
        powered_share: Function ``Facility.powered_share``, which returns the share of an outage
            step that batteries cover.
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
        """Return the surroundings of one step.

        Args:
            exogenous: Weather, carbon intensity, price and demand of the step.
            event: Effects of events on the step.
            stored_kwh: Energy in the batteries at the start of the step, in kWh, (B,).
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
                tank_share=self._ones,
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
            tank_share=event.tank_share,
            outdoor_units=event.outdoor_units,
            unit_running=unit_running,
            no_unit_down=self._units.lowest(unit_running),
            all_running=bool(np.all(running)),
            rack_airflow=event.rack_airflow,
            **self._liquid_failures(event),
        )

    @staticmethod
    def _liquid_failures(event: Disturbance) -> dict[str, Any]:
        """Return failures of liquid cooling by their fields of ``Surroundings``."""
        works = event.cdu_up.all() and event.cdu_pump_up.all() and not event.rack_leaks.any()
        if works and np.all((event.facility_pump == 1.0) & (event.cooler_share == 1.0)):
            return {}
        return {
            "cdu_up": event.cdu_up.astype(np.float64),
            "cdu_pump_up": event.cdu_pump_up.astype(np.float64),
            "facility_pump": event.facility_pump,
            "cooler_share": event.cooler_share,
            "rack_leaks": event.rack_leaks,
            "leaked_l": event.leaked_l,
        }
