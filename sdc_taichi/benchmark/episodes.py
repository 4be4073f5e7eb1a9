"""Recording of controllers as episodes of an environment, with observations, actions and rewards.

A controller observes its usual view of the data center. Each of its commands is converted to the
nearest action of the environment, which is then executed. Repeating the recorded actions in the
environment therefore reproduces the episode.

In shapes, B is the number of environments, T the number of steps, n the number of entries of an
observation, and k the number of entries of an action.
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
from sdc_taichi.optimum.loop_map import LOOP_COMMANDS
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import AGENTS as PARTS
from sdc_taichi.optimum.problem import ALL_AGENTS, Agent
from sdc_taichi.optimum.rollout import Follower, Targets
from sdc_taichi.optimum.solve import solve
from sdc_taichi.run.achievable import OPTIMUM, AchievedPath
from sdc_taichi.run.loop import simulate
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F32, F64, I64, Actions, StepResult

IDLE, RANDOM = "idle", "random"
"""Names of the controller without commands, and of the one with uniformly random actions."""
QUANTITIES = ("carbon_g", "grid_kwh", "energy_cost")
"""Fields of ``StepResult`` that the infos of each step contain."""
MOST_REPEATS = 10_000
"""Maximum number of episodes per week and controller."""
_SET_ELSEWHERE = {
    **dict.fromkeys(("days", "start", "months"), "valid is to choose weeks and days"),
    "heat_map": "valid is False, as learners take features alone",
}
"""Environment options that must not be set in a collection, with the valid alternative."""
_TOGETHER, _STEPS_TOGETHER = 64, 65_536
"""Maximum number of episodes in a batch, and maximum total number of their steps; they limit the
memory use."""
_TOLERANCE = 1e-5
"""Commands closer than this count as equal, because actions are stored as f32."""

Progress = Callable[[str, int, int], None]
"""Progress callback ``(stage, done, total)``."""


@dataclass(frozen=True)
class Collection:
    """Episodes to collect: controllers, weeks of one data center, and environment options."""

    config: DataCenterConfig
    """The data center."""
    controllers: tuple[str, ...]
    """Names of controllers; ``random``, ``optimum`` and ``optimum:OBJECTIVE`` are also valid."""
    weeks: tuple[int, ...]
    """Weeks of the year, 0..51; episodes begin on the first day of a week."""
    days: int = DAYS_PER_WEEK
    """Length of an episode, in days, 1..7."""
    repeats: int = 1
    """Number of episodes of each controller in each week, with different seeds."""
    seed: int = 0
    """Seed of the first episode of week 0, from which the seeds of other episodes are derived."""
    agent: str | None = None
    """Name of the agent if only one acts; None lets all agents act together."""
    environment: Mapping[str, Any] = field(default_factory=dict)
    """Options of the environment, with the names of ``EnvOptions``."""
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
        """Identifier of the environment in Gymnasium's registry."""
        return next(name for name, agent in IDS.items() if agent == self.agent)

    @cached_property
    def options(self) -> dict[str, Any]:
        """Return the options of the environment; the defaults are those of trainings."""
        agents = {} if self.agent is None else {"agents": (self.agent,)}
        beneath = training_environment({**self.environment, **agents})
        # Trainings use small changes per step, but some controllers make large ones.
        for name in ("setpoint_change_k", "fan_change"):
            beneath.pop(name, None)
        return {**beneath, **self.environment, **agents, "days": self.days}

    @property
    def starts(self) -> list[Start]:
        """Week and seed of each episode; they are the same for all controllers."""
        return [
            Start(week=week, seed=self.seed + WEEKS * repeat + week)
            for repeat in range(self.repeats)
            for week in self.weeks
        ]

    def make_env(self) -> gymnasium.Env[Any, Any]:
        """Create the environment of one data center, which can reproduce every episode.

        Raises:
            SdcError: an option is not valid.
        """
        config = self.config.model_dump(mode="json")
        return gymnasium.make(
            self.environment_id, config=config, precision=self.precision, **self.options
        )

    def make_batch(self, size: int) -> SdcVectorEnv:
        """Create a batch of environments of equal data centers."""
        return SdcVectorEnv(
            size,
            self.config,
            agent=self.agent,
            precision=self.precision,
            autoreset_mode="Disabled",
            **self.options,
        )

    def check(self) -> None:
        """Check before any simulation that all controllers can act in the environment.

        Raises:
            SdcError: an option or a controller is not valid.
        """
        with closing(self.make_batch(1)) as env:
            for name in self.controllers:
                _make_actor(self, name, env, None, None)


@dataclass(frozen=True, slots=True)
class Start:
    """Start of an episode: week and seed."""

    week: int
    """Week of the year, 0..51."""
    seed: int
    """Seed for the reset of the environment."""

    @property
    def day(self) -> int:
        """First day of the episode as day of the year, from 0."""
        return DAYS_PER_WEEK * self.week


@dataclass(frozen=True, slots=True)
class Episode:
    """Recorded episode of T steps, with observations before each step and after the last step."""

    controller: str
    """Name of the controller."""
    start: Start
    """Week and seed of the episode."""
    observations: F32
    """Observations, (T + 1, n)."""
    actions: npt.NDArray[Any]
    """Actions: continuous, (T, k), within -1..1, or discrete integers, (T, k) or (T,)."""
    rewards: F64
    """Rewards, (T,)."""
    infos: dict[str, F64]
    """Quantities of each step by name, (T + 1,) each; entry 0, before the first step, is 0."""
    changed_commands: float
    """Share of the controller's commands, 0..1, that differ from the executed commands, because the
    nearest action does not represent them exactly."""


def episodes(
    collection: Collection,
    controller: str,
    *,
    progress: Progress | None = None,
    stop: Callable[[], bool] | None = None,
) -> Iterator[Episode]:
    """Run a controller in all episodes of a collection.

    Args:
        collection: data center, weeks and options of the episodes.
        controller: name of a controller, which does not need to belong to the collection.
        progress: progress callback, which counts the steps of each batch.
        stop: called before every step; the run ends if it returns true.

    Yields:
        Episodes in the order of ``collection.starts``; only one batch at a time is in memory.

    Raises:
        SdcError: the controller or one of its commands is not valid.
        StoppedError: ``stop`` returned true.
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
    """Converter from a controller's commands to the nearest actions of the environments.

    Args:
        controller: controller that gives the commands.
        env: batch of environments.
        decided: names of the commands that actions determine.
    """

    def __init__(self, controller: Controller, env: SdcVectorEnv, decided: tuple[str, ...]) -> None:
        self._controller, self._env, self._decided = controller, env, decided
        self._commands = Actions()

    def reset(self, starts: list[Start]) -> None:
        """Begin a new episode in each environment."""
        self._controller.reset(self._env.core.view.state.seed)

    def act(self) -> npt.NDArray[Any]:
        """Return the actions for the next step, (B,) or (B, k)."""
        self._commands = self._controller.act(self._env.core.view)
        return self._env.actions_of(self._commands)

    def changed(self, result: Mapping[str, Any]) -> F64:
        """Return the share of the last commands that differ from the executed commands, (B,).

        Args:
            result: quantities of the step, (B,) each.
        """
        executed = [name for name in self._decided if f"{name}_command" in result]
        size = self._env.num_envs
        changed = np.zeros(size)
        for name in executed:
            commands = as_numbers(getattr(self._commands, name))
            means = commands.reshape(size if commands.ndim else 1, -1).mean(axis=1)
            changed += np.abs(result[f"{name}_command"] - means) > _TOLERANCE
        return changed / max(len(executed), 1)


class FollowedOptimum:
    """Controller that follows the optimum's achieved path of the current episode.

    The optimum of each episode is computed before its first step, or read from a cache.

    Args:
        steps: number of steps of an episode.
        objective: quantity to minimise.
        agents: agents that the optimum controls; the others are idle.
        progress: progress callback of the optimiser.
        stop: called repeatedly by the optimiser; if it returns true, ``StoppedError`` is raised.
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
        """Begin a new episode."""
        self._follower = None

    def act(self, view: View) -> Actions:
        """Return the commands for work, setpoint and battery."""
        if self._follower is None:
            self._follower = Follower(view.fleet, view.drivers, view.sizing, self._targets(view))
        return self._follower.actions(view.state)

    def _targets(self, view: View) -> Targets:
        """Return the states of the achieved path in each step."""
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
        names = {f.name for f in fields(Targets)} - {"loops"}
        rows: dict[str, list[F64]] = {name: [] for name in names}

        def record(result: StepResult) -> None:
            for name, values in rows.items():
                values.append(np.array(getattr(result, name)))

        with Simulator(view.fleet, drivers=view.drivers, precision=view.precision) as sim:
            simulate(sim, AchievedPath(optimum), self._steps, 0, on_step=record)
        return Targets(
            **{name: np.stack(values) for name, values in rows.items()}, loops=optimum.loops
        )


def objective_of_optimum(name: str) -> Objective | None:
    """Return the objective in ``optimum`` or ``optimum:OBJECTIVE``; None for other names.

    Raises:
        ConfigError: the objective is not valid.
    """
    kind, colon, objective = name.partition(":")
    if kind != OPTIMUM:
        return None
    return Objective.parse(objective if colon else "carbon")


class _Chance:
    """Uniformly random actions, from a separate random generator for each environment."""

    def __init__(self, env: SdcVectorEnv) -> None:
        self._spaces = [deepcopy(env.single_action_space) for _ in range(env.num_envs)]

    def reset(self, starts: list[Start]) -> None:
        """Begin a new episode in each environment."""
        for space, start in zip(self._spaces, starts, strict=True):
            # The environment uses its seed for sampled events, so actions need a different seed.
            (seed,) = np.random.SeedSequence([start.seed, 1]).generate_state(1)
            space.seed(int(seed))

    def act(self) -> npt.NDArray[Any]:
        """Return the actions for the next step, (B,) or (B, k)."""
        return np.stack([space.sample() for space in self._spaces])

    def changed(self, result: Mapping[str, Any]) -> F64:
        """Return zeros, (B,), because random actions are not derived from commands."""
        return np.zeros(len(self._spaces))


def _make_actor(
    collection: Collection,
    name: str,
    env: SdcVectorEnv,
    progress: Progress | None,
    stop: Callable[[], bool] | None,
) -> _Commander | _Chance:
    """Create the object that chooses the actions, by the name of a controller."""
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
    moves_loops = set(LOOP_COMMANDS) <= set(decided)
    planned = tuple(x for x in ALL_AGENTS if x in decided or (x == "liquid" and moves_loops))
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
    """Run one episode in each environment, and yield the episodes."""
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
                values = infos.setdefault(quantity, np.zeros((size, steps + 1)))
                values[:, step + 1] = info[quantity]
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
