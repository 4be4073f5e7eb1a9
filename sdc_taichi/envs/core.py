"""Episodes of many data centers at once: what all environments are thin covers of.

A step decodes actions, lets a named controller play what nobody learns, advances the simulator, and
takes rewards and observations from the view after the step. Arrays have the environments first.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sdc_taichi.config import DataCenterConfig, load_config
from sdc_taichi.control import Idle, View, controlled, make_controller, viewer
from sdc_taichi.control.rules import unrepeated
from sdc_taichi.envs.features import AGENTS, Observer, heat_map, heat_map_space
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.envs.released import ReleasedObserver
from sdc_taichi.envs.rewards import Rewards
from sdc_taichi.errors import ConfigError, RuntimeStateError, SdcError
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F32, F64, I64, Actions, State, StepResult
from sdc_taichi.year_clock import DAYS_PER_YEAR, day_of_year

Observation = F32 | dict[str, F32]
"""(B, n), or with the heat map a dict of ``features`` (B, n) and ``heat_map`` (B, rows, racks per
row, channels)."""
Source = str | os.PathLike[str] | DataCenterConfig | Sequence[DataCenterConfig]

COMMANDS = {"agent_ls": "load", "agent_dc": "cooling", "agent_bat": "battery"}
"""Command of ``Actions`` that each agent gives."""
BATTERY_ORDERS = {"paper": (1.0, 0.0, -1.0), "sustaindc": (1.0, -1.0, 0.0)}
"""Commands of the battery's discrete actions."""


@dataclass(slots=True)
class Step:
    """What a step gives."""

    observations: dict[str, Observation]
    rewards: dict[str, F64]
    """(B,) by learning agent."""
    joint_reward: F64
    """Of all learning agents as one, (B,)."""
    ended: bool
    """Whether the episodes are over; all have the same length."""
    result: StepResult


class Core:
    """Data centers that go through episodes together.

    Args:
        config: a preset, a file, or configs; environment i takes config i modulo their number.
        options: what agents do, see and get.
        num_envs: number of environments; None is one per config.
        precision: of the server kernels.

    Raises:
        SdcError: a config, option or number that is not valid.
    """

    def __init__(
        self,
        config: Source,
        options: EnvOptions,
        num_envs: int | None = None,
        precision: Precision = "f32",
    ) -> None:
        listed = _configs(config)
        size = len(listed) if num_envs is None else num_envs
        if isinstance(size, bool) or not isinstance(size, int | np.integer) or size < 1:
            raise ConfigError(f"num_envs {size!r}: valid is a whole number of at least 1")
        size = int(size)
        if size < len(listed):
            raise ConfigError(
                f"num_envs {size}: valid is at least {len(listed)}, one for each config"
            )
        self.options = options
        self.agents: tuple[str, ...] = options.agents
        self.sim = Simulator([listed[i % len(listed)] for i in range(size)], precision=precision)
        fleet = self.sim.fleet
        self.num_envs = size
        self._units = int(fleet.units // size)
        if np.any(np.diff(fleet.unit_offsets) != self._units):
            raise ConfigError(
                "environments of one batch have the same number of CRAC units; hvac.crac.units "
                f"is {np.diff(fleet.unit_offsets).tolist()[:8]}"
            )
        self._others = make_controller(options.others, fleet)
        _check_others(options)
        self._alone = set(self.agents) == set(AGENTS) or isinstance(self._others, Idle)
        self._rewards = Rewards(
            options.rewards,
            options.collaboration,
            options.tariff,
            agents=self.agents,
            days=options.days,
        )
        # As plain values, to tell environments apart.
        self._made_of = options.model_dump(exclude={"rewards"}) | {"rewards": self._rewards.name}
        self._observer: Observer | ReleasedObserver
        if options.observations == "sustaindc":
            self._observer = ReleasedObserver(options.agents)
        else:
            self._observer = Observer(
                fleet,
                agents=options.agents,
                features=options.features,
                ci_leads_h=options.ci_leads_h,
                weather_leads_h=options.weather_leads_h,
                forecast_error=options.forecast_error,
            )
        self.state_space = self._observer.state_space
        self.features = {a: self._observer.features[a] for a in self.agents}
        self.observation_spaces: dict[str, spaces.Space[Any]] = {
            a: self._observation_space(a) for a in self.agents
        }
        self.action_spaces: dict[str, spaces.Space[Any]] = {
            a: self._action_space(a) for a in self.agents
        }
        self._commands = self._discrete_commands()
        self._shapes = {
            agent: (size, *(space.shape or ())) for agent, space in self.action_spaces.items()
        }
        self._setpoint_step_k = np.repeat(fleet.values("hvac.setpoint.step_k"), self._units)
        self._steps_per_day = 24 * fleet.steps_per_hour
        self._steps = options.days * self._steps_per_day
        self._start_days = np.array(options.start_days())
        self._rngs: list[np.random.Generator] = []
        self._look: Any = None
        self._view: View | None = None
        self._last: tuple[State, dict[str, F64]] | None = None
        self._final_terms: dict[str, F64] = {}
        self._keys: I64 = np.zeros(size, dtype=np.int64)

    # --- episodes ---

    def reset(
        self, seed: int | Sequence[int | None] | None = None, start_day: Any = None
    ) -> dict[str, Observation]:
        """Start an episode in all environments.

        Args:
            seed: environment i takes ``seed + i``, or entry i; None goes on with its generator, or
                takes one from the system's entropy before the first.
            start_day: day of the year as ``MM-DD`` or counted from 0, or one for each environment,
                in place of what the options say.

        Raises:
            SdcError: a seed or day that is not valid.
        """
        chosen = None if start_day is None else self._chosen_days(start_day)
        self._rngs = self._seeded(seed)
        drawn = [rng.integers(2**63 - 1, size=3) for rng in self._rngs]
        events, which, self._keys = np.array(drawn, dtype=np.int64).T
        days = self._drawn_days(which) if chosen is None else chosen
        self.sim.reset(events, days * self._steps_per_day)
        self._begin()
        return self._observe(self.view)

    def next_episode(self) -> dict[str, Observation]:
        """As ``reset``, in the step that ended an episode, whose terms stay those of the step."""
        terms = self.terms()
        observations = self.reset()
        self._final_terms = terms
        return observations

    def _begin(self) -> None:
        """Start what goes along with the simulator, which has been reset."""
        self._final_terms = {}
        self._others.reset(self.sim.state.seed)
        if self._look is None:
            self._look = viewer(self.sim)
        self._last = None
        self._view = view = self._look(None)
        self._observer.reset(view, self._keys)
        self._rewards.reset(view)

    def step(self, actions: Mapping[str, Any]) -> Step:
        """Advance all environments.

        Args:
            actions: one entry per learning agent, (B,) whole numbers, or (B, k) numbers with
                continuous actions or several CRAC units.

        Raises:
            SdcError: actions that are missing, too many, or outside their space.
            RuntimeStateError: before ``reset``, or after the end of the episode.
        """
        view = self.view
        if self.over:
            raise RuntimeStateError("the episode is over; call reset() first")
        if not isinstance(actions, Mapping):
            raise SdcError(f"actions: {actions!r}; valid is a dict of {list(self.agents)}")
        commands = {COMMANDS[agent]: self._decode(agent, actions) for agent in self.agents}
        if len(actions) > len(commands):
            extra = sorted(set(map(str, actions)) - set(self.agents))
            raise SdcError(f"actions: {extra} do not learn here; valid: {list(self.agents)}")
        if not self._alone:
            rest = self._others.act(view)
            for name in COMMANDS.values():
                commands.setdefault(name, _numbers(getattr(rest, name)))
        result = self.sim.step(Actions(**commands))
        self._last = (view.state, commands)
        self._view = view = self._look(result)
        rewards, joint_reward = self._rewards.rewards(result, view)
        return Step(
            observations=self._observe(view),
            rewards=rewards,
            joint_reward=joint_reward,
            ended=self.over,
            result=result,
        )

    @property
    def view(self) -> View:
        """The situation before the next step.

        Raises:
            RuntimeStateError: before ``reset``.
        """
        if self._view is None:
            raise RuntimeStateError("the environment has not been reset; call reset() first")
        return self._view

    @property
    def over(self) -> bool:
        """Whether an episode has ended and the next has not begun."""
        return self._view is not None and self._view.state.step >= self._steps

    def state(self) -> F32:
        """Shared state for centralised critics, (B, m): all features, whoever learns."""
        return self._observer.state(self.view)

    def terms(self) -> dict[str, F64]:
        """Reward terms of the last step by name, (B,) each; empty before the first.

        After ``next_episode`` they are those of the step that ended the episode before.
        """
        last = self.view.last
        return dict(self._final_terms) if last is None else self._rewards.terms(last)

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides how the episode goes on, for ``load_state_dict``; picklable."""
        state, actions = self._last or (self.view.state, None)
        return {
            "options": deepcopy(self._made_of),
            "simulator": self.sim.state_dict(state),
            "actions": None if actions is None else dict(actions),
            "rewards": self._rewards.state(),
            "generators": [rng.bit_generator.state for rng in self._rngs],
            "keys": self._keys.copy(),
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> dict[str, Observation]:
        """Go on from a ``state_dict`` of environments with the same configs and options.

        Returns:
            Observations before the next step.

        Raises:
            SdcError: made by other environments, incomplete, or not valid; nothing has changed.
        """
        found = self._checked_state(values)
        try:
            self.sim.load_state_dict(values["simulator"])
        except (TypeError, ValueError) as error:
            if isinstance(error, SdcError):
                raise
            raise SdcError(f"state: simulator is not valid ({error})") from None
        self._rngs, self._keys = found.rngs, found.keys
        self._begin()
        if found.actions is not None:
            # The last step once more: what agents see of it is no part of the state.
            self._last = (self.sim.state, found.actions)
            self._view = self._look(self.sim.step(Actions(**found.actions)))
        self._rewards.load(found.peaks_kw)
        return self._observe(self.view)

    def _checked_state(self, values: Any) -> _Saved:
        """What a state holds apart from the simulator's, which checks its own."""
        if not isinstance(values, Mapping):
            raise SdcError(f"state: is a {type(values).__name__}; valid is what state_dict() gave")
        parts = ("options", "simulator", "actions", "rewards", "generators", "keys")
        missing = [name for name in parts if name not in values]
        if missing:
            raise SdcError(f"state: missing {missing}; valid is what state_dict() gave")
        extra = sorted(map(str, values.keys() - set(parts)))
        if extra:
            raise SdcError(f"state: unknown {extra}; valid is what state_dict() gave")
        for name, kind in (("options", Mapping), ("simulator", Mapping), ("generators", list)):
            if not isinstance(values[name], kind):
                raise SdcError(f"state: {name} is a {type(values[name]).__name__}")
        if len(values["generators"]) != self.num_envs:
            raise SdcError(
                f"state: made by {len(values['generators'])} environments; valid is {self.num_envs}"
            )
        # The simulator checks it too; another fleet would be taken for wrong actions before.
        fingerprint = self.sim.fingerprint()
        if str(values["simulator"].get("fingerprint", fingerprint)) != fingerprint:
            raise SdcError("state: made by another fleet, inputs or precision than this one")
        for name, mine in self._made_of.items():
            made = values["options"].get(name)
            if type(made) is not type(mine) or made != mine:
                raise SdcError(f"state: made with {name} {made!r}; valid is {mine!r}, as here")
        rngs = [np.random.Generator(np.random.PCG64()) for _ in range(self.num_envs)]
        try:
            for rng, state in zip(rngs, values["generators"], strict=True):
                rng.bit_generator.state = state
        except (TypeError, ValueError, KeyError, OverflowError) as error:
            raise SdcError(f"state: a generator is not valid ({error})") from None
        keys = checked_array(values["keys"], "state: keys")
        if keys.shape != (self.num_envs,) or keys.dtype != np.int64 or keys.min() < 0:
            raise SdcError(f"state: keys are {keys.dtype} {keys.shape}; valid is int64 from 0 on")
        peaks_kw = checked_array(values["rewards"], "state: rewards")
        if peaks_kw.shape != (2, self.num_envs) or not _within(peaks_kw, np.inf):
            raise SdcError(
                f"state: rewards are {peaks_kw.dtype} {peaks_kw.shape}; valid is finite numbers "
                f"(2, {self.num_envs})"
            )
        return _Saved(
            rngs, keys, peaks_kw.astype(np.float64), self._checked_actions(values["actions"])
        )

    def _checked_actions(self, given: Any) -> dict[str, F64] | None:
        if given is None:
            return None
        if not isinstance(given, Mapping) or not set(given) <= set(COMMANDS.values()):
            raise SdcError("state: actions are not valid; valid is what state_dict() gave")
        out: dict[str, F64] = {}
        for name, command in given.items():
            values = checked_array(command, f"state: actions of {name}")
            shapes = [(), (self.num_envs,)]
            shapes += [(self.sim.fleet.units,)] if name == "cooling" else []
            highest = np.inf if name == "cooling" else 1.0
            if values.shape not in shapes or not _within(values, highest):
                raise SdcError(f"state: actions of {name} are not valid: {command!r}")
            out[name] = values.astype(np.float64)
        return out

    def close(self) -> None:
        """Let go of the simulator."""
        self.sim.close()

    # --- spaces and actions ---

    def _observation_space(self, agent: str) -> spaces.Space[Any]:
        features = self._observer.spaces[agent]
        if not self.options.heat_map:
            return features
        image = heat_map_space(self.sim.fleet)
        return spaces.Dict({"features": features, "heat_map": image})

    def _action_space(self, agent: str) -> spaces.Space[Any]:
        units = self._units if agent == "agent_dc" else 1
        if self.options.actions == "continuous":
            high = self.options.setpoint_change_k if agent == "agent_dc" else 1.0
            return spaces.Box(-high, high, (units,), dtype=np.float32)
        return spaces.Discrete(3) if units == 1 else spaces.MultiDiscrete([3] * units)

    def _discrete_commands(self) -> dict[str, F64]:
        order = self.options.action_order
        if order is None:
            models = {c.battery.model for c in self.sim.fleet.configs}
            order = "sustaindc" if models == {"released"} else "paper"
        return {
            "agent_ls": np.array([-1.0, 0.0, 1.0]),
            "agent_dc": np.array([-1.0, 0.0, 1.0]),
            "agent_bat": np.array(BATTERY_ORDERS[order]),
        }

    def _decode(self, agent: str, actions: Mapping[str, Any]) -> F64:
        """Command of an agent, (B,), or (U,) for the units of all environments."""
        if agent not in actions:
            raise SdcError(f"actions: none for {agent}; valid: {list(self.agents)}")
        given = checked_array(actions[agent], f"action of {agent}")
        if given.shape != self._shapes[agent]:
            raise SdcError(
                f"action of {agent}: shape {given.shape}, expected {self._shapes[agent]}"
            )
        if self.options.actions == "continuous":
            return self._decode_numbers(agent, given)
        whole = given.dtype.kind in "iu"
        if whole:
            chosen = given.reshape(-1).astype(np.int64)
            # Read without sign, what is below 0 is beyond 2 too.
            if np.maximum.reduce(chosen.view(np.uint64)) <= 2:
                return self._commands[agent].take(chosen)
            given = given[(given < 0) | (given > 2)]
        kind = "" if whole else f" ({given.dtype})"
        raise SdcError(f"action of {agent}: {given.flat[0]}{kind}; valid is 0, 1 or 2")

    def _decode_numbers(self, agent: str, given: npt.NDArray[Any]) -> F64:
        if given.dtype.kind not in "iuf":
            raise SdcError(f"action of {agent}: {given.flat[0]!r}; valid is a number")
        space = self.action_spaces[agent]
        assert isinstance(space, spaces.Box)
        high = float(space.high[0])
        # Bounds in f32, as agents have them.
        if not np.all(np.abs(given) <= high * (1.0 + 1e-6)):
            wrong = given[~(np.abs(given) <= high * (1.0 + 1e-6))].flat[0]
            raise SdcError(f"action of {agent}: {wrong}; valid is within {-high:g}..{high:g}")
        command: F64 = given.astype(np.float64).reshape(-1)
        command = np.minimum(np.maximum(command, -high), high)
        if agent == "agent_dc":
            command /= self._setpoint_step_k
            command = unrepeated(command, self.view.state.cooling_last)
        return command

    def _observe(self, view: View) -> dict[str, Observation]:
        found = self._observer.observe(view)
        if not self.options.heat_map:
            return {**found}
        image = heat_map(view)
        return {a: {"features": found[a], "heat_map": image.copy()} for a in self.agents}

    # --- randomness ---

    def _seeded(self, seed: int | Sequence[int | None] | I64 | None) -> list[np.random.Generator]:
        """A generator for each environment, by its seed or the one that is there."""
        if seed is None and self._rngs:
            return self._rngs
        if seed is None:
            seed = int(np.random.SeedSequence().generate_state(1, np.uint32)[0])
        if isinstance(seed, np.ndarray) and seed.ndim == 0:
            seed = seed[()]
        if isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
            listed = list(seed)
        else:
            listed = [_checked(seed) + i for i in range(self.num_envs)]
        if len(listed) != self.num_envs:
            raise ConfigError(f"seed: {len(listed)} for {self.num_envs} environments")
        before: list[np.random.Generator | None] = [*self._rngs] or [None] * len(listed)
        return [
            (rng or np.random.default_rng())
            if given is None
            else np.random.Generator(np.random.PCG64(_checked(given)))
            for given, rng in zip(listed, before, strict=True)
        ]

    def _drawn_days(self, drawn: I64) -> I64:
        """First day of each episode as the options say, (B,)."""
        if self.options.start == "fixed":
            starts = [c.site.start for c in self.sim.fleet.configs]
            return np.array([day_of_year(s) for s in starts], dtype=np.int64)
        return np.asarray(self._start_days[drawn % len(self._start_days)], dtype=np.int64)

    def _chosen_days(self, given: Any) -> I64:
        """First day of each episode as ``reset`` was told, (B,)."""
        many = isinstance(given, list | tuple) or (isinstance(given, np.ndarray) and given.ndim > 0)
        if isinstance(given, np.ndarray) and given.ndim == 0:
            given = given[()]
        days = np.array([_day(d) for d in (given if many else [given])], dtype=np.int64)
        if len(days) not in (1, self.num_envs):
            raise ConfigError(f"start_day: {len(days)} days for {self.num_envs} environments")
        return np.broadcast_to(days, (self.num_envs,))


@dataclass(frozen=True, slots=True)
class _Saved:
    """Parts of a state that have been checked."""

    rngs: list[np.random.Generator]
    keys: I64
    peaks_kw: F64
    actions: dict[str, F64] | None


def _within(values: npt.NDArray[Any], highest: float) -> bool:
    """Whether an array has finite numbers of at most a size."""
    numbers = values.dtype.kind in "iuf"
    return numbers and bool(np.all(np.isfinite(values) & (np.abs(values) <= highest)))


def _numbers(command: Any) -> F64:
    """A command of a controller, which may be a named one."""
    return np.asarray(command.value if isinstance(command, Enum) else command, dtype=np.float64)


def _check_others(options: EnvOptions) -> None:
    """Refuse controllers of nothing but what learns.

    Raises:
        ConfigError: a part of ``others`` is for an agent that learns, or all it controls learns.
    """
    if "others" not in options.model_fields_set:
        return
    learned = [COMMANDS[agent] for agent in options.agents]
    named = controlled(options.others)
    idle = set(named) & set(learned) if "=" in options.others else set(named) <= set(learned)
    if idle:
        raise ConfigError(
            f"others {options.others!r}: without effect on {', '.join(learned)}, learned here; "
            f"valid is for {', '.join(c for c in COMMANDS.values() if c not in learned)}"
        )


def _configs(source: Source) -> list[DataCenterConfig]:
    if isinstance(source, DataCenterConfig):
        return [source]
    if isinstance(source, str | os.PathLike):
        return [load_config(source)]
    listed: list[Any] = list(source) if isinstance(source, Sequence) else [source]
    if not listed:
        raise ConfigError("config: an empty list; valid is at least one data center")
    for one in listed:
        if not isinstance(one, DataCenterConfig):
            raise ConfigError(f"config {one!r}: valid is a preset, a file, or DataCenterConfigs")
    return listed


def checked_array(given: Any, name: str) -> npt.NDArray[Any]:
    """Numbers of any kind as an array.

    Raises:
        SdcError: nested lists of differing lengths.
    """
    try:
        return np.asarray(given)
    except ValueError as error:
        raise SdcError(f"{name}: is no array ({error})") from None


def _checked(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise ConfigError(f"seed {seed!r}: valid is an integer of 0..2**63 - 1")
    return int(seed)


def _day(given: Any) -> int:
    if isinstance(given, int | np.integer) and not isinstance(given, bool):
        if 0 <= given < DAYS_PER_YEAR:
            return int(given)
    elif isinstance(given, str):
        try:
            return day_of_year(given)
        except ValueError:
            pass
    raise ConfigError(f"start_day {given!r}: valid is MM-DD or a day of the year, 0..364")
