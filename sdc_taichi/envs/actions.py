"""Action spaces of agents, and conversion between actions and commands of the simulator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sdc_taichi.config.liquid_schema import POWER_CAP_LIMITS, LiquidConfig
from sdc_taichi.control.view import View
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.envs.site_order import cleaner_first, shares_of_sites
from sdc_taichi.envs.unit_slots import UnitSlots, slots_of_groups
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.plant.chiller import CHILLERS
from sdc_taichi.plant.cooling import avoid_repeats
from sdc_taichi.sim.fleet import STAGE_MODELS, Fleet
from sdc_taichi.sim.step_inputs import LIQUID_COMMANDS
from sdc_taichi.types import F64, Actions, State

BATTERY_COMMANDS = {"paper": (1.0, 0.0, -1.0), "sustaindc": (1.0, -1.0, 0.0)}
"""Battery commands of the discrete actions 0, 1 and 2, by ``action_order``: 1 charges, 0 holds,
-1 discharges."""
PLACEMENT_FACTOR = 10.0
"""Placement weight of a rack at a continuous action of 1; an action of -1 gives the reciprocal."""
_NEUTRAL = {"placement": 1.0}
"""Neutral values of the commands that are not neutral at 0."""
_NEUTRAL_LIQUID: dict[str, Callable[[LiquidConfig], float]] = {
    "facility_approach_k": lambda liquid: liquid.cdus.approach_k,
    "reuse_share": lambda liquid: liquid.reuse.share,
    "power_cap": lambda liquid: POWER_CAP_LIMITS[1],
}
"""Values of the commands for liquid cooling at an action of 0, which are those without command."""
CHILLED_WATER_SPAN_K = 6.0
"""Difference from the warmest possible chilled water to that of a continuous action of -1, in K."""
LARGEST_MOVES = {"cdu_setpoint_c": 2.0, "cdu_flow": 0.1}
"""Change of a CDU's setpoint, in K, and of its flow as a share of design, by an action of 1."""
_NEEDED_MODELS = {"fan": ("crac_flow", "controlled"), "placement": ("placement", "weights")}
"""Simulation stage, and the model of this stage, that a command requires."""


class AgentActions:
    """Converts actions of agents to commands of the simulator and back.

    Args:
        fleet: the B data centers, with U CRAC units and R racks in total.
        options: learning agents, their commands and the meaning of their actions.
        clip: whether continuous actions are clipped to -1..1 if ``options.clip_actions`` is None.
        slots: places of units in the actions of their agents by group; None means as few as fit.

    Attributes:
        spaces: action space of a learning agent, by group.
        commands: names of the commands that learning agents decide.
        action_order: order of the battery's discrete actions, ``paper`` or ``sustaindc``.

    Raises:
        ConfigError: the data centers differ in the number of CRAC units or racks that actions
            control, or a model of the fleet does not accept a command.
    """

    def __init__(
        self,
        fleet: Fleet,
        options: EnvOptions,
        *,
        clip: bool = False,
        slots: Mapping[str, UnitSlots] | None = None,
    ) -> None:
        self._clip = clip if options.clip_actions is None else options.clip_actions
        self._agents: tuple[str, ...] = options.agents
        self._continuous = options.actions == "continuous"
        decided = {agent: options.commands_of(agent) for agent in self._agents}
        self.commands = tuple(name for names in decided.values() for name in names)
        _check_models(fleet, self.commands)
        if "transfer" in self.commands and fleet.sites_per_fleet == 1:
            raise ConfigError("agents: agent_geo needs a fleet; valid with a config that has fleet")
        self._fleet = fleet
        self._slots = slots_of_groups(fleet, self._agents) if slots is None else slots
        widths: dict[str, dict[str, int]] = {
            agent: {name: self._width(agent, name) for name in names}
            for agent, names in decided.items()
        }
        self._columns: dict[str, tuple[tuple[str, slice | None], ...]] = {
            agent: _columns(of_commands) for agent, of_commands in widths.items()
        }
        self._widths: dict[str, int] = {agent: sum(x.values()) for agent, x in widths.items()}
        self.spaces: dict[str, spaces.Space[Any]] = {
            agent: self._space(width) for agent, width in self._widths.items()
        }
        self._shapes: dict[str, tuple[int, ...]] = {
            agent: (*self._rows_shape(agent), *(space.shape or ()))
            for agent, space in self.spaces.items()
        }
        order = options.action_order
        if order is None:
            models = {c.battery.model for c in fleet.configs}
            order = "sustaindc" if models == {"released"} else "paper"
        self.action_order = order
        three_ways = np.array([-1.0, 0.0, 1.0])
        self._discrete_commands = dict.fromkeys(self.commands, three_ways) | {
            "battery": np.array(BATTERY_COMMANDS[order]),
            "placement": PLACEMENT_FACTOR**three_ways,
        }
        self._neutral_liquid = {
            name: np.array([neutral(c.liquid) for c in fleet.configs if c.liquid is not None])
            for name, neutral in _NEUTRAL_LIQUID.items()
            if name in self.commands
        }
        self._setpoint_change_k = options.setpoint_change_k
        self._setpoint_step_k = fleet.values("hvac.setpoint.step_k")[fleet.unit_dc]
        self._fan_steps = options.fan_change / fleet.values("hvac.crac.fan_step")[fleet.unit_dc]
        self._lowest_setpoint_c = fleet.values("hvac.setpoint.min_c")[fleet.unit_dc]
        self._coil_approach_k = fleet.values("hvac.chiller.coil_approach_k")
        self._water_range_c = CHILLERS[fleet.models["chiller"]].water_range_c

    def decode(self, actions: Mapping[str, Any], view: View) -> dict[str, F64]:
        """Convert actions to commands of the simulator by name, each (B,), (U,) or (R,).

        Args:
            actions: actions by learning agent. Discrete actions are integers, (B,), or (B, k) if
                the agent decides k values; continuous actions are floats, (B, k). Those of groups
                with an agent for each unit have a second axis, the slots of ``UnitSlots``.
            view: the view before the step.

        Raises:
            SdcError: the actions of an agent are missing or outside their space, or there are
                actions of an agent that does not learn.
        """
        if not isinstance(actions, Mapping):
            raise SdcError(f"actions: {actions!r}; valid is a dict of {list(self._agents)}")
        commands: dict[str, F64] = {}
        state = view.state
        for agent in self._agents:
            action = self._checked(agent, actions)
            for name, columns in self._columns[agent]:
                part = action if columns is None else action[..., columns]
                if agent in self._slots:
                    slots = self._slots[agent]
                    part = slots.units(part.reshape(slots.exists.shape))
                elif agent == "plant" and name == "cooling":
                    part = part.reshape(-1)[self._fleet.unit_dc]
                commands[name] = self._command(name, part.reshape(-1), state)
        if "chilled_water" in commands:
            reset = commands["chilled_water"]
            commands["chilled_water"] = self._chilled_water_c(reset, commands, state)
        for name in commands.keys() & LIQUID_COMMANDS.keys():
            commands[name] = self._liquid_command(name, commands[name], state)
        if "transfer" in commands:
            shares = np.maximum(commands["transfer"], 0.0).reshape(view.size, -1)
            commands["transfer"] = shares_of_sites(shares, view)
        if len(actions) > len(self._agents):
            extra = sorted(set(map(str, actions)) - set(self._agents))
            raise SdcError(f"actions: {extra} do not learn here; valid: {list(self._agents)}")
        return commands

    def encode(self, commands: Actions, view: View) -> dict[str, npt.NDArray[Any]]:
        """Convert commands to the nearest actions of the learning agents.

        Args:
            commands: commands of one step, as enum members or numbers.
            view: the view before the step.

        Returns:
            Actions by learning agent, in the form that ``decode`` takes.
        """
        actions: dict[str, npt.NDArray[Any]] = {}
        for agent, shape in self._shapes.items():
            width = self._widths[agent]
            parts = []
            for name, columns in self._columns[agent]:
                given = getattr(commands, name)
                command = as_numbers(given, _NEUTRAL.get(name, 0.0))
                if name in LIQUID_COMMANDS and given is not None:
                    command = self._liquid_action(name, command, view.state)
                if name == "transfer" and command.ndim:
                    command = np.take_along_axis(command, cleaner_first(view), axis=1)
                count = width if columns is None else columns.stop - columns.start
                rows = self._rows(agent, name, command)
                parts.append(self._action(name, np.broadcast_to(rows, (len(rows), count))))
            together = np.concatenate(parts, axis=1)
            if agent in self._slots:
                together = np.moveaxis(self._slots[agent].fill(together.T), 0, -1)
            actions[agent] = together.reshape(shape)
        return actions

    def _rows(self, agent: str, name: str, command: F64) -> F64:
        """Return a command with one row for each data center, or for each unit of an agent of it.

        Raises:
            SdcError: the command has no corresponding action.
        """
        fleet = self._fleet
        if name == "chilled_water" and command.any():
            raise SdcError(
                f"command chilled_water {command.flat[0]:g} C: no action of {agent} gives it; "
                "valid is None"
            )
        if agent in self._slots:
            slots = self._slots[agent]
            of_units = command.ndim and len(command) == slots.count
            return command.reshape(-1, 1) if of_units else self._of_all(command)[slots.dc]
        if agent == "plant" and command.shape == (fleet.units,):
            return command[fleet.unit_offsets[:-1], None]
        if command.ndim == 0:
            return self._of_all(command)
        return command.reshape(fleet.size, -1)

    def _of_all(self, command: F64) -> F64:
        """Return one value, or one per data center, as (B, 1)."""
        return np.broadcast_to(command, self._fleet.size)[:, None]

    def _width(self, agent: str, name: str) -> int:
        """Return the number of values of a command that an agent decides."""
        if agent == "agent_dc" and name in ("cooling", "fan"):
            return equal_number(self._fleet.unit_offsets, "CRAC units (hvac.crac.units)")
        if name == "placement":
            return equal_number(self._fleet.rack_offsets, "racks")
        if name == "transfer":
            return self._fleet.sites_per_fleet - 1
        return 1

    def _rows_shape(self, agent: str) -> tuple[int, ...]:
        """Return (B,), or (B, W) for a group with an agent for each unit."""
        return self._slots[agent].exists.shape if agent in self._slots else (self._fleet.size,)

    def _chilled_water_c(self, reset: F64, commands: Mapping[str, F64], state: State) -> F64:
        """Return the commanded temperature of the chilled water, in C, (B,).

        Args:
            reset: 0 or more for the warmest water that serves the setpoints before and after the
                step, -1 for the coldest, (B,).
            commands: the other commands of the step.
            state: state of the simulator before the step.
        """
        fleet, (low_c, high_c) = self._fleet, self._water_range_c
        change_k = commands.get("cooling", np.zeros(1)) * self._setpoint_step_k
        unit_c = np.minimum(state.setpoint_c, state.setpoint_c + change_k)
        unit_c = np.maximum(unit_c, self._lowest_setpoint_c)
        coldest_c = np.minimum.reduceat(unit_c, fleet.unit_offsets[:-1])
        most_c = coldest_c - fleet.setpoint_over_supply_k - self._coil_approach_k
        chilled_c = most_c + CHILLED_WATER_SPAN_K * np.minimum(reset, 0.0)
        return np.asarray(np.clip(chilled_c, low_c, high_c))

    def _liquid_command(self, name: str, action: F64, state: State) -> F64:
        """Return the value of a command for liquid cooling, (C,) or (B,).

        An action of a CDU is a change of setpoint or flow. Of all other commands -1, 0 and 1 mean
        the lowest, the neutral and the highest value, with straight lines in between.
        """
        low, high = LIQUID_COMMANDS[name][1]
        if name in LARGEST_MOVES:
            moved = getattr(state, name) + LARGEST_MOVES[name] * action
            return np.asarray(np.clip(moved, low, high))
        neutral = self._neutral_liquid[name]
        span = np.where(action > 0.0, high - neutral, neutral - low)
        return np.asarray(np.clip(neutral + span * action, low, high))

    def _liquid_action(self, name: str, command: F64, state: State) -> F64:
        """Return the action that gives a command for liquid cooling, in -1..1."""
        low, high = LIQUID_COMMANDS[name][1]
        if name in LARGEST_MOVES:
            if command.shape == (self._fleet.size,):
                command = command[self._fleet.cdu_dc]
            return np.asarray((command - getattr(state, name)) / LARGEST_MOVES[name])
        above = command - self._neutral_liquid[name]
        span = np.where(above > 0.0, high - command + above, command - above - low)
        return np.asarray(above / np.where(span > 0.0, span, 1.0))

    def idle_actions(self) -> dict[str, npt.NDArray[Any]]:
        """Neutral actions of the learning agents, (B,) or (B, k)."""
        idle: dict[str, npt.NDArray[Any]] = {}
        for agent, shape in self._shapes.items():
            if self._continuous:
                idle[agent] = np.zeros(shape, dtype=np.float32)
            else:
                (name, _), *_ = self._columns[agent]
                commands = self._discrete_commands[name]
                # The neutral action is 1, except that of the battery, which depends on the order.
                idle[agent] = np.full(shape, 1 if name != "battery" else np.argmin(abs(commands)))
        return idle

    def _space(self, width: int) -> spaces.Space[Any]:
        if self._continuous:
            return spaces.Box(-1.0, 1.0, (width,), dtype=np.float32)
        return spaces.Discrete(3) if width == 1 else spaces.MultiDiscrete([3] * width)

    def _checked(self, agent: str, actions: Mapping[str, Any]) -> npt.NDArray[Any]:
        """Check the shape and values of one agent's action; return it as int64 or float64."""
        if agent not in actions:
            raise SdcError(f"actions: none for {agent}; valid: {list(self._agents)}")
        action = checked_array(actions[agent], f"action of {agent}")
        if action.shape != self._shapes[agent]:
            raise SdcError(
                f"action of {agent}: shape {action.shape}, expected {self._shapes[agent]}"
            )
        if self._continuous:
            return _checked_numbers(agent, action, clip=self._clip)
        whole = action.dtype.kind in "iu"
        if whole:
            choices = action.astype(np.int64)
            # Viewed as unsigned integers, negative choices also exceed 2: one comparison suffices.
            if np.maximum.reduce(choices.view(np.uint64), axis=None) <= 2:
                return choices
            action = action[(action < 0) | (action > 2)]
        kind = "" if whole else f" ({action.dtype})"
        raise SdcError(f"action of {agent}: {action.flat[0]}{kind}; valid is 0, 1 or 2")

    def _command(self, name: str, action: npt.NDArray[Any], state: State) -> F64:
        """Convert the part of an action that sets command ``name``, (B,), (U,) or (R,)."""
        if not self._continuous:
            return self._discrete_commands[name].take(action)
        if name == "placement":
            return np.asarray(PLACEMENT_FACTOR**action)
        if name == "fan":
            return np.asarray(action * self._fan_steps)
        if name == "cooling":
            command = action * self._setpoint_change_k / self._setpoint_step_k
            return avoid_repeats(command, state.cooling_last)
        return action

    def _action(self, name: str, command: F64) -> npt.NDArray[Any]:
        """Return the part of an action that is nearest to a value of command ``name``, (B, k)."""
        if name == "placement":
            command = np.log10(command)
        if not self._continuous:
            choices = self._discrete_commands[name]
            if name == "placement":
                choices = np.log10(choices)
            return np.asarray(np.abs(command[..., None] - choices).argmin(-1))
        if name == "cooling":
            largest = self._setpoint_change_k / self._setpoint_step_k
            command = command / self._of_rows(largest, command.shape)
        elif name == "fan":
            command = command / self._of_rows(self._fan_steps, command.shape)
        return np.clip(command, -1.0, 1.0)

    def _of_rows(self, per_unit: F64, shape: tuple[int, ...]) -> F64:
        """Arrange values of units, (U,), as those of a command: by unit, or by data center.

        A command with one value for all units of a data center uses the first unit's.
        """
        if np.prod(shape) == len(per_unit):
            return per_unit.reshape(shape)
        return per_unit[self._fleet.unit_offsets[:-1], None]


def as_numbers(command: Any, neutral: float = 0.0) -> F64:
    """Return the numeric values of a command of ``Actions``.

    Args:
        command: number, array, enum member or None.
        neutral: numeric value that replaces None.
    """
    if command is None:
        command = neutral
    return np.asarray(command.value if isinstance(command, Enum) else command, dtype=np.float64)


def equal_number(offsets: npt.NDArray[np.integer], what: str) -> int:
    """Return the number of units or racks per data center, which must be the same in all.

    Args:
        offsets: index of each data center's first unit or rack, then the total number, (B + 1,).
        what: plural noun for the units or racks in error messages.

    Raises:
        ConfigError: the data centers have different numbers.
    """
    numbers = np.diff(offsets)
    if np.any(numbers != numbers[0]):
        raise ConfigError(
            f"environments of one batch need the same number of {what}; "
            f"it is {numbers.tolist()[:8]}"
        )
    return int(numbers[0])


def _check_models(fleet: Fleet, commands: Sequence[str]) -> None:
    """Refuse commands that the models of the fleet do not accept.

    Raises:
        ConfigError: the error names the field of the config, its value and the valid value.
    """
    of_liquid = [name for name in commands if name in LIQUID_COMMANDS]
    dry = [c.name for c in fleet.configs if c.liquid is None]
    if of_liquid and dry:
        raise ConfigError(
            f"commands: {of_liquid[0]} needs liquid-cooled racks; {dry[0]} has none, valid is a "
            "config with section liquid, such as preset ai_hall_2026"
        )
    for name, (stage, needed) in _NEEDED_MODELS.items():
        model = fleet.models[stage]
        if name in commands and model != needed:
            raise ConfigError(
                f"commands: {name} needs {STAGE_MODELS[stage]}={needed}; it is {model}"
            )


def _columns(widths: Mapping[str, int]) -> tuple[tuple[str, slice | None], ...]:
    """Return each command of an agent with its columns in the action; None means all columns.

    Args:
        widths: number of columns of each command, in order.
    """
    names = list(widths)
    if len(names) == 1:
        return ((names[0], None),)
    ends = np.cumsum(list(widths.values())).tolist()
    starts = [0, *ends[:-1]]
    return tuple(
        (name, slice(first, end)) for name, first, end in zip(names, starts, ends, strict=True)
    )


def _checked_numbers(agent: str, action: npt.NDArray[Any], *, clip: bool) -> F64:
    """Check a continuous action and clip it to -1..1.

    Args:
        agent: name of the agent in error messages.
        action: numbers, (B, k).
        clip: True to clip all finite values, False only those that exceed -1..1 by rounding in f32.

    Raises:
        SdcError: the action has other values.
    """
    if action.dtype.kind not in "iuf":
        raise SdcError(f"action of {agent}: {action.flat[0]!r}; valid is a number")
    valid = np.isfinite(action) if clip else np.abs(action) <= 1.0 + 1e-6
    if not np.all(valid):
        wrong = action[~valid].flat[0]
        range_text = "a finite number" if clip else "within -1..1"
        advice = "" if clip or not np.isfinite(wrong) else ", or any number with clip_actions=True"
        raise SdcError(f"action of {agent}: {wrong}; valid is {range_text}{advice}")
    return np.minimum(np.maximum(action.astype(np.float64), -1.0), 1.0)


def checked_array(values: Any, name: str) -> npt.NDArray[Any]:
    """Convert a user's number, array or nested lists to an array of any type and shape.

    Args:
        values: number, array or nested lists.
        name: name of the value in error messages.

    Raises:
        SdcError: the nested lists have different lengths.
    """
    try:
        return np.asarray(values)
    except ValueError as error:
        raise SdcError(f"{name}: is no array ({error})") from None
