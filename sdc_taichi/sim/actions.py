"""From the actions of a user to checked commands, one for each data center or CRAC unit."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.unit_index import UnitIndex
from sdc_taichi.types import (
    F64,
    Actions,
    BatteryAction,
    CommandQuantities,
    CoolAction,
    FanAction,
    LoadAction,
)

MOST_MOVES = 1e6
"""Most steps by which a setpoint or a fan may be told to move, far beyond the range of either."""


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
        given = actions or Actions()
        load_command = self._command("load", given.load, LoadAction, limit=1.0)
        battery_command = self._command("battery", given.battery, BatteryAction, limit=1.0)
        cooling = CoolAction.HOLD if given.cooling is None else given.cooling
        unit_cooling_command = self._unit_command("cooling", cooling, CoolAction)
        return Commands(
            load_command=load_command,
            battery_command=battery_command,
            cooling_command=self._units.mean(unit_cooling_command),
            unit_cooling_command=unit_cooling_command,
            follows_schedule=given.cooling is None,
            unit_fan_command=self._fan_command(given.fan),
            group_weights=self._group_weights(given.placement),
        )

    def _fan_command(self, given: Any) -> F64 | None:
        if given is FanAction.HOLD:
            return None
        command = self._unit_command("fan", given, FanAction)
        if self._flow_model == "controlled":
            return command
        if np.any(command):
            raise SdcError(
                f"action fan: given, but hvac.crac.flow_model is {self._flow_model}; valid is "
                "HOLD, or flow model controlled"
            )
        return None

    def _group_weights(self, given: Any) -> F64 | None:
        """Weights of the server groups, (G,), from one per rack or per group."""
        if given is None:
            return None
        if self._placement != "weights":
            raise SdcError(
                f"action placement: given, but workload.placement is {self._placement}; valid is "
                "None"
            )
        racks, groups = self._fleet.racks, self._fleet.groups
        try:
            weights = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise SdcError(f"action placement: {given!r} are no numbers") from None
        if weights.shape == (groups,):
            return weights
        if weights.shape == (racks,):
            return np.repeat(weights, np.diff(self._fleet.group_offsets))
        raise SdcError(
            f"action placement: shape {weights.shape}, expected ({racks},), one per rack, or "
            f"({groups},), one per server group"
        )

    def _unit_command(self, name: str, given: Any, kind: type[Enum]) -> F64:
        """A command for each CRAC unit, (U,), given for all, per data center or per unit."""
        command = self._command(name, given, kind, limit=MOST_MOVES, also=self._n_units)
        return command if len(command) == self._n_units else self._units.of_each(command)

    def _command(
        self,
        name: str,
        given: Any,
        kind: type[Enum],
        *,
        limit: float,
        also: int | None = None,
    ) -> F64:
        """A finite command within -limit..limit for each data center, (B,), or ``also`` entries."""
        if isinstance(given, Enum):
            if not isinstance(given, kind):
                raise SdcError(f"action {name}: {given} is no {kind.__name__}")
            return np.full(self._size, float(given.value))
        if isinstance(given, list | tuple) and any(isinstance(x, Enum) for x in given):
            given = [x.value if isinstance(x, kind) else x for x in given]
        try:
            command = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            raise SdcError(
                f"action {name}: {given!r} is neither {kind.__name__} nor numbers"
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
