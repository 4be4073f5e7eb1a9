"""Actions of agents: their spaces, and the commands of the simulator that they mean."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sdc_taichi.control.rules import avoid_repeats
from sdc_taichi.envs.agents import COMMAND_OF_AGENT
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.errors import SdcError
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F64, State

BATTERY_COMMANDS = {"paper": (1.0, 0.0, -1.0), "sustaindc": (1.0, -1.0, 0.0)}
"""Commands of the battery's discrete actions 0, 1 and 2, by value of ``action_order``: 1 charges,
-1 discharges."""


class ActionDecoder:
    """Reads what agents do as commands of the simulator.

    Args:
        fleet: the data centers, B.
        options: which agents learn and what their actions mean.
        units: number of CRAC units of each data center.

    Attributes:
        spaces: space of the actions of each agent in one environment.
    """

    def __init__(self, fleet: Fleet, options: EnvOptions, units: int) -> None:
        self._agents: tuple[str, ...] = options.agents
        self._continuous = options.actions == "continuous"
        self._units = units
        self._setpoint_change_k = options.setpoint_change_k
        self.spaces: dict[str, spaces.Space[Any]] = {a: self._space(a) for a in self._agents}
        self._shapes = {
            agent: (fleet.size, *(space.shape or ())) for agent, space in self.spaces.items()
        }
        order = options.action_order
        if order is None:
            models = {c.battery.model for c in fleet.configs}
            order = "sustaindc" if models == {"released"} else "paper"
        self._discrete_commands = {
            "agent_ls": np.array([-1.0, 0.0, 1.0]),
            "agent_dc": np.array([-1.0, 0.0, 1.0]),
            "agent_bat": np.array(BATTERY_COMMANDS[order]),
        }
        self._setpoint_step_k = np.repeat(fleet.values("hvac.setpoint.step_k"), units)

    def decode(self, actions: Mapping[str, Any], state: State) -> dict[str, F64]:
        """Commands of the learning agents by name, (B,) each, or (U,) for all CRAC units.

        Args:
            actions: one entry per learning agent, (B,) whole numbers, or (B, k) numbers with
                continuous actions or several CRAC units.
            state: the situation before the step.

        Raises:
            SdcError: actions that are missing, too many, or outside their space.
        """
        if not isinstance(actions, Mapping):
            raise SdcError(f"actions: {actions!r}; valid is a dict of {list(self._agents)}")
        commands = {
            COMMAND_OF_AGENT[agent]: self._decode(agent, actions, state) for agent in self._agents
        }
        if len(actions) > len(commands):
            extra = sorted(set(map(str, actions)) - set(self._agents))
            raise SdcError(f"actions: {extra} do not learn here; valid: {list(self._agents)}")
        return commands

    def _space(self, agent: str) -> spaces.Space[Any]:
        units = self._units if agent == "agent_dc" else 1
        if self._continuous:
            return spaces.Box(-1.0, 1.0, (units,), dtype=np.float32)
        return spaces.Discrete(3) if units == 1 else spaces.MultiDiscrete([3] * units)

    def _decode(self, agent: str, actions: Mapping[str, Any], state: State) -> F64:
        """Command of one agent, (B,), or (U,) for all CRAC units."""
        if agent not in actions:
            raise SdcError(f"actions: none for {agent}; valid: {list(self._agents)}")
        given = checked_array(actions[agent], f"action of {agent}")
        if given.shape != self._shapes[agent]:
            raise SdcError(
                f"action of {agent}: shape {given.shape}, expected {self._shapes[agent]}"
            )
        if self._continuous:
            return self._decode_continuous(agent, given, state)
        whole = given.dtype.kind in "iu"
        if whole:
            chosen = given.reshape(-1).astype(np.int64)
            # Read without sign, what is below 0 is beyond 2 too.
            if np.maximum.reduce(chosen.view(np.uint64)) <= 2:
                return self._discrete_commands[agent].take(chosen)
            given = given[(given < 0) | (given > 2)]
        kind = "" if whole else f" ({given.dtype})"
        raise SdcError(f"action of {agent}: {given.flat[0]}{kind}; valid is 0, 1 or 2")

    def _decode_continuous(self, agent: str, given: npt.NDArray[Any], state: State) -> F64:
        if given.dtype.kind not in "iuf":
            raise SdcError(f"action of {agent}: {given.flat[0]!r}; valid is a number")
        # Bounds in f32, as agents have them.
        inside = np.abs(given) <= 1.0 + 1e-6
        if not np.all(inside):
            wrong = given[~inside].flat[0]
            raise SdcError(f"action of {agent}: {wrong}; valid is within -1..1")
        command: F64 = given.astype(np.float64).reshape(-1)
        command = np.minimum(np.maximum(command, -1.0), 1.0)
        if agent == "agent_dc":
            command *= self._setpoint_change_k
            command /= self._setpoint_step_k
            command = avoid_repeats(command, state.cooling_last)
        return command


def checked_array(given: Any, name: str) -> npt.NDArray[Any]:
    """Convert a value that a user gave to an array of any kind and shape.

    Args:
        given: a number, an array, or nested lists.
        name: what it is, for errors.

    Raises:
        SdcError: nested lists of differing lengths.
    """
    try:
        return np.asarray(given)
    except ValueError as error:
        raise SdcError(f"{name}: is no array ({error})") from None
