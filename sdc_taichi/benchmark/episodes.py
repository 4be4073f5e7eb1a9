"""Episodes of controllers in weeks of a data center, as an agent of its environment records them.

A controller acts on its usual view. Its commands become the nearest actions of an environment,
which carries these out. So the actions of an episode reproduce it in that environment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import View, commands_of, make_controller
from sdc_taichi.control.rules import Controller
from sdc_taichi.envs import IDS
from sdc_taichi.envs.actions import as_numbers
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.vector import SdcVectorEnv
from sdc_taichi.errors import ConfigError, whole_number
from sdc_taichi.learning.split import DAYS_PER_WEEK, WEEKS
from sdc_taichi.learning.training_settings import training_environment
from sdc_taichi.optimum import StoppedError
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS as PARTS
from sdc_taichi.optimum.problem import Agent
from sdc_taichi.optimum.rollout import Follower, Targets
from sdc_taichi.optimum.solve import solve
from sdc_taichi.run.achievable import OPTIMUM, AchievedPath
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F32, F64, I64, Actions, StepResult

IDLE, RANDOM = "idle", "random"
"""Controller that changes nothing, and the one that draws actions evenly."""
QUANTITIES = ("carbon_g", "grid_kwh", "energy_cost")
"""Quantities of ``StepResult`` in the infos of each step."""
MOST_REPEATS = 10_000
"""Largest number of episodes of a week and a controller."""
_SET_ELSEWHERE = {
    **dict.fromkeys(("days", "start", "months"), "valid is to choose weeks and days"),
    "heat_map": "valid is False, as learners take features alone",
}
"""Options of environments that are not set here, and what is valid instead."""
_TOGETHER, _STEPS_TOGETHER = 64, 65_536
"""Most episodes that run side by side, and most of their steps, which bounds the memory."""
_TOLERANCE = 1e-5
"""Commands closer than this count as equal, because actions are stored as f32."""

Progress = Callable[[str, int, int], None]
"""Progress callback ``(stage, done, total)``."""


@dataclass(frozen=True)
class Collection:
    """Episodes to collect: controllers, weeks of one data center, options of its environment."""

    config: DataCenterConfig
    """The data center."""
    controllers: tuple[str, ...]
    """Names of controllers, ``random``, ``optimum`` and ``optimum:OBJECTIVE`` among them."""
    weeks: tuple[int, ...]
    """Weeks of the year, 0..51, on whose first days episodes begin."""
    days: int = DAYS_PER_WEEK
    """Length of an episode, in days, 1..7."""
    repeats: int = 1
    """Episodes of each controller in each week, with different seeds."""
    seed: int = 0
    """Seed of the first episode of week 0; those of other episodes follow from it."""
    agent: str | None = None
    """The one agent that acts; None is all agents together."""
    environment: Mapping[str, Any] = field(default_factory=dict)
    """Options of the environment, as ``EnvOptions`` has them."""
    precision: Precision = "f32"
    """Precision of the server kernels."""

    def __post_init__(self) -> None:
        if not self.controllers:
            raise ConfigError("controllers: none; valid is one or more, such as random, mpc-24h")
        for name in self.controllers:
            if self.controllers.count(name) > 1:
                raise ConfigError(f"controller {name!r}: is given twice; valid is each once")
        whole_number("days", self.days, 1, DAYS_PER_WEEK)
        whole_number("repeats", self.repeats, 1, MOST_REPEATS)
        for name, valid in _SET_ELSEWHERE.items():
            if name in self.environment:
                raise ConfigError(f"environment.{name}: is not chosen here; {valid}")

    @property
    def environment_id(self) -> str:
        """Name of the environment in Gymnasium."""
        return next(name for name, agent in IDS.items() if agent == self.agent)

    @cached_property
    def options(self) -> dict[str, Any]:
        """Options of the environment, on top of those that agents are trained with."""
        agents = {} if self.agent is None else {"agents": (self.agent,)}
        beneath = training_environment({**self.environment, **agents})
        # Agents that learn take small steps of the setpoint, some controllers large ones.
        beneath.pop("setpoint_change_k", None)
        return {**beneath, **self.environment, **agents, "days": self.days}

    @property
    def starts(self) -> list[Start]:
        """Beginnings of the episodes of each controller, equal for all."""
        return [
            Start(week=week, seed=self.seed + WEEKS * repeat + week)
            for repeat in range(self.repeats)
            for week in self.weeks
        ]

    def make_env(self) -> gymnasium.Env[Any, Any]:
        """The environment of one data center, in which every episode can be done again.

        Raises:
            SdcError: options that are not valid.
        """
        config = self.config.model_dump(mode="json")
        return gymnasium.make(
            self.environment_id, config=config, precision=self.precision, **self.options
        )

    def make_batch(self, size: int) -> SdcVectorEnv:
        """Environments of equal data centers that step together.

        Args:
            size: their number, B.
        """
        return SdcVectorEnv(
            size,
            self.config,
            agent=self.agent,
            precision=self.precision,
            autoreset_mode="Disabled",
            **self.options,
        )

    def check(self) -> None:
        """Check before any work that all controllers can act in the environment.

        Raises:
            SdcError: an option or a controller that is not valid.
        """
        with closing(self.make_batch(1)) as env:
            for name in self.controllers:
                _make_actor(self, name, env, None, None)


@dataclass(frozen=True, slots=True)
class Start:
    """The beginning of an episode."""

    week: int
    """Week of the year, 0..51."""
    seed: int
    """Seed that the environment is reset with."""

    @property
    def day(self) -> int:
        """First day, counted from 0 in the year."""
        return DAYS_PER_WEEK * self.week


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode of T steps, with what was observed before each step and after the last."""

    controller: str
    """Name of the controller."""
    start: Start
    """How it began."""
    observations: F32
    """Observations, (T + 1, n)."""
    actions: npt.NDArray[Any]
    """Actions, (T, k) numbers within -1..1, or whole numbers, (T, k) or (T,)."""
    rewards: F64
    """Rewards, (T,)."""
    infos: dict[str, F64]
    """Quantities of each step by name, (T + 1,) each; the first, before any step, are 0."""
    changed_commands: float
    """Share of the commands that the nearest action changes."""


def episodes(
    collection: Collection,
    controller: str,
    *,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Iterator[Episode]:
    """Run a controller through all episodes of a collection.

    Args:
        collection: what is collected.
        controller: one of its controllers, or another name.
        progress: progress callback; counts the steps of each batch.
        stop: called before every step; true ends the run.

    Yields:
        Episodes in the order of ``collection.starts``; a few at a time are in memory.

    Raises:
        SdcError: a controller that is not valid, or what it does is not.
        StoppedError: ``stop`` was true.
    """
    starts = collection.starts
    steps = 24 * collection.days * collection.config.simulation.steps_per_hour
    together = max(1, min(_TOGETHER, _STEPS_TOGETHER // steps))
    for first in range(0, len(starts), together):
        part = starts[first : first + together]
        with closing(collection.make_batch(len(part))) as env:
            actor = _make_actor(collection, controller, env, progress, stop)
            yield from _run(controller, part, env, actor, progress, stop)


class _Commander:
    """Actions nearest to a controller's commands.

    Args:
        controller: gives the commands.
        env: the environments.
        decided: commands that actions decide.
    """

    def __init__(self, controller: Controller, env: SdcVectorEnv, decided: tuple[str, ...]) -> None:
        self._controller, self._env, self._decided = controller, env, decided
        self._commands = Actions()

    def reset(self, starts: list[Start]) -> None:
        """Begin an episode of each environment."""
        self._controller.reset(self._env.core.view.state.seed)

    def act(self) -> npt.NDArray[Any]:
        """Actions for the step to come, (B,) or (B, k)."""
        self._commands = self._controller.act(self._env.core.view)
        return self._env.actions_of(self._commands)

    def changed(self, result: Mapping[str, Any]) -> F64:
        """Share of its last commands that differ from those carried out, (B,).

        Args:
            result: quantities of the step, (B,) each.
        """
        done = [name for name in self._decided if f"{name}_command" in result]
        size = self._env.num_envs
        out = np.zeros(size)
        for name in done:
            commands = as_numbers(getattr(self._commands, name))
            of_each = commands.reshape(size if commands.ndim else 1, -1).mean(axis=1)
            out += np.abs(result[f"{name}_command"] - of_each) > _TOLERANCE
        return out / max(len(done), 1)


class FollowedOptimum:
    """Controller that steers towards the optimum's achieved path of the current episode.

    Each episode is solved before its first step, unless a cache holds its optimum.

    Args:
        steps: number of steps of an episode.
        objective: quantity to minimise.
        agents: agents (load, cooling, battery) that the plan moves; the others are idle.
        progress: progress callback of solving.
        stop: called repeatedly while solving; true raises ``StoppedError``.
    """

    def __init__(
        self,
        steps: int,
        objective: Objective,
        *,
        agents: Sequence[Agent] = PARTS,
        progress: Progress | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        self._steps, self._objective, self._agents = steps, objective, tuple(agents)
        self._progress, self._stop = progress, stop
        self._follower: Follower | None = None

    def reset(self, seed: int | I64) -> None:
        """Begin another episode."""
        self._follower = None

    def act(self, view: View) -> Actions:
        """Commands for work, setpoint and battery."""
        if self._follower is None:
            self._follower = Follower(view.fleet, view.drivers, view.sizing, self._targets(view))
        return self._follower.actions(view.state)

    def _targets(self, view: View) -> Targets:
        """States that the achieved path passes through."""
        optimum = solve(
            view.fleet,
            steps=self._steps,
            start=view.drivers.start,
            drivers=view.drivers,
            objective=self._objective,
            agents=self._agents,
            precision=view.precision,
            progress=self._progress,
            stop=self._stop,
        )
        rows: dict[str, list[F64]] = {name: [] for name in (f.name for f in fields(Targets))}

        def record(result: StepResult) -> None:
            for name, values in rows.items():
                values.append(np.array(getattr(result, name)))

        with Simulator(view.fleet, drivers=view.drivers, precision=view.precision) as sim:
            simulate(sim, AchievedPath(optimum), self._steps, 0, on_step=record)
        return Targets(**{name: np.stack(values) for name, values in rows.items()})


def objective_of_optimum(name: str) -> Objective | None:
    """Objective of ``optimum`` or ``optimum:OBJECTIVE``; None for the name of a controller.

    Raises:
        ConfigError: an objective that is not valid.
    """
    kind, colon, objective = name.partition(":")
    if kind != OPTIMUM:
        return None
    return Objective.parse(objective if colon else "carbon")


class _Chance:
    """Actions drawn evenly from the action space, by a generator for each environment.

    Args:
        env: the environments.
    """

    def __init__(self, env: SdcVectorEnv) -> None:
        self._spaces = [deepcopy(env.single_action_space) for _ in range(env.num_envs)]

    def reset(self, starts: list[Start]) -> None:
        """Begin an episode of each environment."""
        for space, start in zip(self._spaces, starts, strict=True):
            # Differs from the seed of the environment, which draws its events.
            (seed,) = np.random.SeedSequence([start.seed, 1]).generate_state(1)
            space.seed(int(seed))

    def act(self) -> npt.NDArray[Any]:
        """Actions for the step to come, (B,) or (B, k)."""
        return np.stack([space.sample() for space in self._spaces])

    def changed(self, result: Mapping[str, Any]) -> F64:
        """Always 0, because no command precedes its actions, (B,)."""
        return np.zeros(len(self._spaces))


def _make_actor(
    collection: Collection,
    name: str,
    env: SdcVectorEnv,
    progress: Progress | None,
    stop: Callable[[], bool] | None,
) -> _Commander | _Chance:
    """The source of actions in environments, by the name of a controller."""
    if name == RANDOM:
        return _Chance(env)
    options = env.core.options
    decided = tuple(c for agent in options.agents for c in options.commands_of(agent))
    objective = objective_of_optimum(name)
    if objective is None:
        controller = make_controller(name, env.core.sim.fleet)
        able = commands_of(controller)
        if name != IDLE and not set(able) & set(decided):
            raise ConfigError(
                f"controller {name!r}: gives {', '.join(able)}; valid is one that gives "
                f"{', '.join(decided)}, which is decided here"
            )
        return _Commander(controller, env, decided)
    if set(options.agents) != set(AGENTS) and options.others != IDLE:
        raise ConfigError(
            f"controller {name!r}: is not known where others act ({options.others}); valid with "
            f"others {IDLE}"
        )
    planned = tuple(part for part in PARTS if part in decided)
    plan = FollowedOptimum(env.core.steps, objective, agents=planned, progress=progress, stop=stop)
    return _Commander(plan, env, decided)


def _run(
    name: str,
    starts: list[Start],
    env: SdcVectorEnv,
    actor: _Commander | _Chance,
    progress: Progress | None,
    stop: Callable[[], bool] | None,
) -> Iterator[Episode]:
    """Run an episode of each environment."""
    size, steps = env.num_envs, env.core.steps
    first: Any = env.reset(
        seed=[start.seed for start in starts],
        options={"start_day": [start.day for start in starts]},
    )[0]
    actor.reset(starts)
    observations = np.empty((size, steps + 1, first.shape[1]), dtype=np.float32)
    observations[:, 0] = first
    width = env.single_action_space.shape or ()
    actions = np.empty((size, steps, *width), env.single_action_space.dtype)
    rewards, changed = np.empty((size, steps)), np.zeros(size)
    infos: dict[str, F64] = {}
    for step in range(steps):
        if stop is not None and stop():
            raise StoppedError(f"{name} was stopped; nothing of it is kept")
        actions[:, step] = action = actor.act()
        after: Any
        after, rewards[:, step], _, _, info = env.step(action)
        observations[:, step + 1] = after
        changed += actor.changed(info) / steps
        for quantity in info:
            if quantity in QUANTITIES or quantity.startswith("cost"):
                of_steps = infos.setdefault(quantity, np.zeros((size, steps + 1)))
                of_steps[:, step + 1] = info[quantity]
        if progress is not None:
            progress(name, step + 1, steps)
    for i, start in enumerate(starts):
        yield Episode(
            controller=name,
            start=start,
            observations=observations[i],
            actions=actions[i],
            rewards=rewards[i],
            infos={quantity: values[i] for quantity, values in infos.items()},
            changed_commands=float(changed[i]),
        )
