"""Episodes of a batch of data centers; all environments are thin wrappers around ``Core``.

A step decodes the actions, adds the commands of a controller for the agents that do not learn,
advances the simulator, and computes rewards and observations from the view after the step. The
first axis of every array is the environment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import (
    PERFECT,
    Controller,
    View,
    commands_of,
    controller_text,
    make_controller,
    parts_of,
    view_maker,
)
from sdc_taichi.envs.actions import AgentActions, as_numbers
from sdc_taichi.envs.agents import AGENT_DEFINITIONS, commands_by_others
from sdc_taichi.envs.costs import Costs
from sdc_taichi.envs.episodes import (
    Draw,
    DrawnInputs,
    Seed,
    check_state,
    chosen_start_days,
    draw_info,
    draws_inputs,
    seeded_generators,
)
from sdc_taichi.envs.features import Feature
from sdc_taichi.envs.images import heat_map, heat_map_space
from sdc_taichi.envs.observer import make_observer
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.envs.recording import EpisodeRecordings, RecorderOption
from sdc_taichi.envs.rewards import Rewards
from sdc_taichi.errors import ConfigError, RuntimeStateError, whole_number
from sdc_taichi.exogenous.year_clock import day_of_year
from sdc_taichi.sim.events import require_events_start_before
from sdc_taichi.sim.fleet_configs import MOST_DCS
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F32, F64, I64, QUANTITIES_PER_DC, Actions, State, StepResult

Observation = F32 | dict[str, F32]
"""Observations of one agent in B environments: an array (B, n), or with option ``heat_map`` a dict
of ``features``, (B, n), and ``heat_map``, (B, rows, racks per row, channels)."""


REWARD_BEYOND_LIMITS = -1000.0
"""Reward of every agent, and joint reward, of a step that ends an episode at a physical limit: that
of a hundred steps with ten times the carbon of a step at the design point."""


class EndedBy(IntEnum):
    """Reason why an episode ended in a step: the values of ``info["ended_by"]``."""

    NOT_ENDED = 0
    LENGTH = 1
    """The episode has its full length; it is truncated."""
    PHYSICAL_LIMITS = 2
    """A result is beyond the physical limits, or no steady air exists; the episode terminates."""


@dataclass(slots=True)
class Transition:
    """Result of one step of all environments."""

    observations: dict[str, Observation]
    """Observations before the next step, by learning agent."""
    rewards: dict[str, F64]
    """Rewards by learning agent, (B,) each."""
    joint_reward: F64
    """Reward of a single learner that controls all learning agents, (B,)."""
    costs: dict[str, F64]
    """Costs of the step, (B,) each: ``cost_NAME`` for each cost of the option ``costs``, and their
    weighted sum ``cost``. The dict is empty without the option."""
    ended: bool
    """True if all episodes of the batch are over after this step."""
    ended_by: I64
    """Reason why each episode ended, as a value of ``EndedBy``, (B,)."""
    result: StepResult
    """Result of the simulator's step."""

    @property
    def terminated(self) -> npt.NDArray[np.bool_]:
        """True for episodes that a physical limit has ended, (B,)."""
        return np.asarray(self.ended_by == EndedBy.PHYSICAL_LIMITS)

    @property
    def truncated(self) -> npt.NDArray[np.bool_]:
        """True for episodes that ended because of their length, (B,)."""
        return np.asarray(self.ended_by == EndedBy.LENGTH)


class Core:
    """A batch of data centers whose episodes begin and end together.

    A physical limit ends the episode of a single data center earlier. ``restart_ended`` then starts
    an episode of this data center that lasts until those of the batch end.

    Args:
        configs: configs of data centers; environment i uses config i modulo their number.
        options: actions, observations and rewards of the agents.
        num_envs: number of environments; None creates one per config.
        precision: floating-point precision of the server kernels.
        recorder: choice and destination of recorded episodes; None records nothing.
        clip_actions: value of ``options.clip_actions`` if that is None.

    Attributes:
        options: actions, observations and rewards of the agents.
        agents: names of the agents that learn.
        num_envs: number of environments, B.
        steps: number of steps of an episode.
        sim: simulator of all B data centers.
        features: features of each learning agent, in the order of its observation.
        observation_spaces: observation space of each learning agent in one environment.
        action_spaces: action space of each learning agent in one environment.
        state_space: space of the shared state of one environment.
        ended_early: True for environments whose episode has ended at a physical limit, and whose
            next one has not begun, (B,).

    Raises:
        SdcError: a config, option or number is not valid.
    """

    def __init__(
        self,
        configs: Sequence[DataCenterConfig],
        options: EnvOptions,
        num_envs: int | None = None,
        precision: Precision = "f32",
        recorder: RecorderOption = None,
        *,
        clip_actions: bool = False,
    ) -> None:
        size = _checked_size(num_envs, len(configs))
        self.options = options
        self.agents: tuple[str, ...] = options.agents
        self.num_envs = size
        if options.tariff is not None:
            configs = [c.model_copy(update={"tariff": options.tariff}) for c in configs]
        by_env = [configs[i % len(configs)] for i in range(size)]
        self._inputs = DrawnInputs(by_env, options) if draws_inputs(options) else None
        self._draw: Draw | None = None
        first = None if self._inputs is None else self._inputs.first()
        self.sim = Simulator(by_env, drivers=first, precision=precision, limits="flag")
        fleet = self.sim.fleet
        require_events_start_before(24.0 * options.days, fleet.configs, "the episode")
        self._others = make_controller(options.others, fleet)
        _check_others(options, self._others)
        learned = [name for agent in self.agents for name in options.commands_of(agent)]
        self._commands_of_others = commands_by_others(
            self.agents, learned, commands_of(self._others)
        )
        self._learned_commands = learned
        self._rewards = Rewards(
            options.rewards,
            options.collaboration,
            agents=self.agents,
            days=options.days,
        )
        self._costs = Costs(options.costs, fleet)
        # Plain values that identify the environment in saved states. Costs and the clipping of
        # actions are left out because they do not change an episode.
        without_effect = {"costs", "clip_actions"}
        self._identity = options.model_dump(exclude={"rewards", "others", *without_effect}) | {
            "rewards": self._rewards.identity,
            "others": controller_text(options.others),
        }
        self._observer = make_observer(fleet, options, new_inputs=draws_inputs(options))
        self._decoder = AgentActions(fleet, options, clip=clip_actions)
        self.features: dict[str, tuple[Feature, ...]] = {
            a: self._observer.features[a] for a in self.agents
        }
        self.observation_spaces: dict[str, spaces.Space[Any]] = {
            a: self._observation_space(a) for a in self.agents
        }
        self.action_spaces = self._decoder.spaces
        self.state_space = self._observer.state_space
        self._steps_per_day = 24 * fleet.steps_per_hour
        self.steps = options.days * self._steps_per_day
        self._start_days = np.array(options.start_days())
        self._generators: list[np.random.Generator] = []
        self._view_after: Any = None
        self._view: View | None = None
        self._last: tuple[State, dict[str, F64]] | None = None
        self._final_terms: dict[str, F64] = {}
        self._keys: I64 = np.zeros(size, dtype=np.int64)
        self.ended_early: npt.NDArray[np.bool_] = np.zeros(size, dtype=np.bool_)
        self._closed = False
        self._recordings: EpisodeRecordings | None = None
        self.record_episodes(recorder)

    def end_after(self, steps: int) -> None:
        """Shorten all episodes to a number of steps.

        Args:
            steps: number of steps of an episode, at most that of ``EnvOptions.days``.

        Raises:
            ConfigError: a scheduled event would start after the end of the episode.
        """
        fleet = self.sim.fleet
        require_events_start_before(steps / fleet.steps_per_hour, fleet.configs, "the episode")
        self.steps = steps

    def reset(self, seed: Seed = None, start_day: Any = None) -> dict[str, Observation]:
        """Start an episode in all environments.

        Args:
            seed: environment i uses ``seed + i``, or entry i of a sequence. With None each
                environment continues its random generator, or seeds a new one from the operating
                system's entropy.
            start_day: first day of the episodes as ``MM-DD`` or as number of the day in the year,
                from 0; or one day for each environment. None uses the option ``start``.

        Returns:
            Observations before the first step, by learning agent.

        Raises:
            SdcError: a seed or day is not valid.
            RuntimeStateError: the environment is closed.
        """
        self._check_open()
        chosen = None if start_day is None else chosen_start_days(start_day, self.num_envs)
        self._generators = seeded_generators(seed, self._generators, self.num_envs)
        drawn = [rng.integers(2**63 - 1, size=3) for rng in self._generators]
        events, drawn_days, self._keys = np.array(drawn, dtype=np.int64).T
        days = self._drawn_start_days(drawn_days) if chosen is None else chosen
        inputs = None
        if self._inputs is not None:
            self._draw = self._inputs.draw(self._generators)
            inputs = self._inputs.drivers(self._draw)
        self.sim.reset(events, days * self._steps_per_day, inputs)
        self._begin()
        observations = self._observe(self.view)
        self._begin_recording()
        return observations

    def next_episode(self) -> dict[str, Observation]:
        """Start the next episodes within the same step that ended the previous ones.

        ``reward_terms`` keeps returning the terms of the step that ended the previous episodes.

        Returns:
            Observations before the first step, by learning agent.
        """
        terms = self.reward_terms()
        observations = self.reset()
        self._final_terms = terms
        return observations

    def _begin(self) -> None:
        """Reset controller, view, observer and rewards after a reset of the simulator."""
        self._final_terms = {}
        self.ended_early = np.zeros(self.num_envs, dtype=np.bool_)
        self._others.reset(self.sim.state.seed)
        error = self.options.forecast_error
        if self._view_after is None or error != PERFECT:
            self._view_after = view_maker(self.sim, error, self._keys)
        self._last = None
        self._view = view = self._view_after(None)
        self._observer.reset(view)
        self._rewards.reset(view)

    def restart_ended(self) -> npt.NDArray[np.bool_]:
        """Start the next episodes of the environments ``ended_early``, which end with the batch.

        Their data centers have the state of the first step of the batch again; weather, demand,
        events, and the memory of the controller ``others`` continue.

        Returns:
            True for these environments, (B,).
        """
        chosen = self.ended_early
        if chosen.any():
            last = self.view.last
            self.sim.restart(chosen)
            self.ended_early = np.zeros(self.num_envs, dtype=np.bool_)
            self._view = self._view_after(last)
            self._rewards.restart(chosen, self.view)
        return chosen

    def observe(self) -> dict[str, Observation]:
        """Return the observations before the next step, by learning agent.

        Those of environments that have just begun again contain results of the step before.
        """
        return self._observe(self.view)

    def record_episodes(self, recorder: RecorderOption) -> None:
        """Record selected episodes, starting with the next episode.

        Args:
            recorder: choice and destination of recorded episodes; None records nothing.

        Raises:
            RuntimeStateError: there is a recorder already.
            SdcError: the recorder is not valid.
        """
        if recorder is None:
            return
        if self._recordings is not None:
            raise RuntimeStateError("recorder: the episodes are recorded already; valid is one")
        self._recordings = EpisodeRecordings(recorder, self.sim)

    def _begin_recording(self) -> None:
        """Start recording the new episode if the recorder selects it."""
        if self._recordings is not None:
            self._recordings.begin(self.sim)

    def step(
        self, actions: Mapping[str, Any], starting: npt.NDArray[np.bool_] | None = None
    ) -> Transition:
        """Advance all environments by one step.

        In the environments ``ended_early`` the actions are neutral and the rewards are 0, and they
        stay terminated.

        Args:
            actions: actions by learning agent. Discrete actions are integers, (B,), or (B, k) if
                the agent decides k values; continuous actions are floats, (B, k).
            starting: True for environments of ``restart_ended`` that use this step as the reset of
                their next episode, (B,): their actions are neutral and their rewards are 0.

        Raises:
            SdcError: the actions of an agent are missing or outside their space, or there are
                actions of an agent that does not learn.
            RuntimeStateError: the environment has not been reset, or the episode is over.
        """
        view = self.view
        if self.episode_over:
            raise RuntimeStateError("the episode is over; call reset() first")
        waiting = self.ended_early
        idle = waiting if starting is None else waiting | starting
        if idle.any():
            actions = _with_idle(actions, self.idle_actions(), idle)
        commands = self._decoder.decode(actions, view.state)
        if self._commands_of_others:
            by_others = self._others.act(view)
            for name in self._commands_of_others:
                command = getattr(by_others, name)
                if command is not None:
                    commands[name] = as_numbers(command)
        result = self.sim.step(Actions(**commands))
        self._last = (view.state, commands)
        self._view = view = self._view_after(result)
        rewards, joint_reward = self._rewards.rewards(result, view)
        beyond = result.within_limits < 1.0
        if idle.any() or beyond.any():
            replaced = np.where(idle, 0.0, REWARD_BEYOND_LIMITS)
            is_replaced = idle | beyond
            rewards = {a: np.where(is_replaced, replaced, r) for a, r in rewards.items()}
            joint_reward = np.where(is_replaced, replaced, joint_reward)
            self.ended_early = waiting | (beyond & ~idle)
        ended_by = np.where(self.ended_early, EndedBy.PHYSICAL_LIMITS, EndedBy.NOT_ENDED)
        if view.state.step >= self.steps:
            ended_by[~self.ended_early] = EndedBy.LENGTH
        transition = Transition(
            observations=self._observe(view),
            rewards=rewards,
            joint_reward=joint_reward,
            costs=self._costs.of(result, view),
            ended=self.episode_over,
            ended_by=ended_by.astype(np.int64),
            result=result,
        )
        if self._recordings is not None and self._recordings.is_recording:
            terms = self._rewards.terms(result, self._rewards.used_terms)
            self._recordings.add(result, {**rewards, **terms})
            if transition.ended:
                self._recordings.end()
        return transition

    def actions_of(self, commands: Actions) -> dict[str, npt.NDArray[Any]]:
        """Return the actions for ``step`` that are nearest to commands, by learning agent.

        Args:
            commands: commands of one step, for example of a controller.
        """
        return self._decoder.encode(commands)

    @property
    def view(self) -> View:
        """What controllers see of the data centers before the next step.

        Raises:
            RuntimeStateError: the environment has not been reset, or is closed.
        """
        if self._view is None:
            self._check_open()
            raise RuntimeStateError("the environment has not been reset; call reset() first")
        return self._view

    @property
    def episode_over(self) -> bool:
        """True if the episodes have ended and the next ones have not begun."""
        if self._view is None:
            return False
        return self._view.state.step >= self.steps or bool(self.ended_early.all())

    def idle_actions(self) -> dict[str, npt.NDArray[Any]]:
        """Return the neutral action of each learning agent, (B,) or (B, k)."""
        return self._decoder.idle_actions()

    def start_info(self) -> dict[str, npt.NDArray[Any]]:
        """Return the start day and the randomly drawn inputs of the current episodes, (B,) each.

        ``start_day`` is the day of the year, from 0. Option ``years`` adds ``year``, the seed of
        the synthetic series, and option ``traces`` adds ``trace``, the workload trace.
        """
        start = self.view.state.start // self._steps_per_day
        return {"start_day": np.asarray(start, dtype=np.int64), **draw_info(self._draw)}

    def infos(self, transition: Transition | None = None) -> dict[str, npt.NDArray[Any]]:
        """Return the infos of a step, or those of a reset without one, by name, (B,) each.

        Both have the same keys and types, because some libraries read the infos of a reset to know
        those of all steps: the start day and the drawn inputs of the current episodes, and
        quantities and costs of the step, and ``ended_by``, a value of ``EndedBy``. At a reset, all
        but the inputs are 0.

        Args:
            transition: result of the step; None after a reset.
        """
        of_step: dict[str, npt.NDArray[Any]]
        if transition is None:
            names = (*QUANTITIES_PER_DC, *self._costs.names)
            of_step = dict(zip(names, np.zeros((len(names), self.num_envs)), strict=True))
            of_step["ended_by"] = np.zeros(self.num_envs, dtype=np.int64)
        else:
            of_step = {**transition.result.per_dc(), **transition.costs}
            of_step["ended_by"] = transition.ended_by
        return {**self.start_info(), **of_step}

    def state(self) -> F32:
        """Return the shared state for centralised critics: all features of all agents, (B, m)."""
        view = self.view
        return self._observer.state(view)

    def reward_terms(self) -> dict[str, F64]:
        """Return the reward terms of the last step by name, unscaled, (B,) each.

        The dict is empty before the first step. After ``next_episode`` the terms still belong to
        the step that ended the previous episodes.
        """
        last = self.view.last
        return dict(self._final_terms) if last is None else self._rewards.terms(last)

    def state_dict(self) -> dict[str, Any]:
        """Return a picklable state from which ``load_state_dict`` continues bit for bit."""
        view = self.view
        state, commands = self._last or (view.state, None)
        return {
            "options": deepcopy(self._identity),
            "inputs": None if self._draw is None else asdict(self._draw),
            "simulator": self.sim.state_dict(state),
            "actions": deepcopy(commands),
            "rewards": self._rewards.peaks_kw(),
            "generators": [rng.bit_generator.state for rng in self._generators],
            "keys": self._keys.copy(),
        }

    def load_state_dict(self, values: Mapping[str, Any]) -> dict[str, Observation]:
        """Continue from a ``state_dict`` of environments with the same configs and options.

        Returns:
            Observations before the next step.

        Raises:
            SdcError: the state belongs to other environments, is incomplete or is not valid; the
                environments are then unchanged.
        """
        self._check_open()
        saved = check_state(
            values,
            options=self._identity,
            inputs=self._inputs,
            sim=self.sim,
            learned=self._learned_commands,
            by_others=self._commands_of_others,
            steps=self.steps,
        )
        try:
            self.sim.continue_from(saved.simulator, saved.drivers)
            self._generators, self._keys, self._draw = saved.generators, saved.keys, saved.draw
            self._begin()
            if saved.commands is not None:
                # Repeat the last step, because its result is not part of the saved state.
                self._last = (self.sim.state, saved.commands)
                result = self.sim.step(Actions(**saved.commands))
                self.ended_early = result.within_limits < 1.0
                self._view = self._view_after(result)
            self._rewards.load_peaks_kw(saved.peaks_kw)
            self._begin_recording()
        except BaseException:
            self._view = None  # Old and new state are mixed, so the environments need a reset.
            raise
        return self._observe(self.view)

    def close(self) -> None:
        """Release the simulator and all tables; the environments cannot be used afterwards."""
        if self._closed:
            return
        self._closed = True
        if self._recordings is not None:
            self._recordings.end()
        self.sim.close()
        self._view = self._view_after = self._last = None
        self._final_terms = {}
        del self._observer, self._rewards, self._others, self._decoder, self._inputs

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeStateError("the environment is closed; create a new one")

    def _observation_space(self, agent: str) -> spaces.Space[Any]:
        features = self._observer.spaces[agent]
        if not self.options.heat_map:
            return features
        image = heat_map_space(self.sim.fleet)
        return spaces.Dict({"features": features, "heat_map": image})

    def _observe(self, view: View) -> dict[str, Observation]:
        features = self._observer.observe(view)
        if not self.options.heat_map:
            return {**features}
        image = heat_map(view)
        return {a: {"features": features[a], "heat_map": image.copy()} for a in self.agents}

    def _drawn_start_days(self, drawn: I64) -> I64:
        """Return the first day of each episode, by the options and random integers, (B,)."""
        if self.options.start == "fixed":
            starts = [c.site.start for c in self.sim.fleet.configs]
            return np.array([day_of_year(s) for s in starts], dtype=np.int64)
        return np.asarray(self._start_days[drawn % len(self._start_days)], dtype=np.int64)


def _with_idle(
    actions: Any, idle: Mapping[str, npt.NDArray[Any]], chosen: npt.NDArray[np.bool_]
) -> Any:
    """Replace the actions of chosen environments by idle ones; leave what is not valid as it is."""
    if not isinstance(actions, Mapping):
        return actions
    replaced = dict(actions)
    for agent, neutral in idle.items():
        values = np.asarray(actions.get(agent))
        if values.shape == neutral.shape and values.dtype.kind in "fiu":
            replaced[agent] = values.copy()
            replaced[agent][chosen] = neutral[chosen]
    return replaced


def _checked_size(num_envs: Any, configs: int) -> int:
    """Return the number of environments after a check that it is at least that of configs."""
    size = whole_number("num_envs", configs if num_envs is None else num_envs, 1, MOST_DCS)
    if size < configs:
        raise ConfigError(f"num_envs {size}: valid is at least {configs}, one for each config")
    return size


def _check_others(options: EnvOptions, others: Controller) -> None:
    """Refuse a controller ``others`` that would have no effect.

    Raises:
        ConfigError: a part of ``others`` names a command of a learning agent, or learning agents
            decide all commands that ``others`` sets.
    """
    if "others" not in options.model_fields_set:
        return
    learning = [AGENT_DEFINITIONS[agent] for agent in options.agents]
    learned = [definition.command for definition in learning]
    named = parts_of(options.others) if isinstance(options.others, str) else {}
    settable = {name for definition in learning for name in definition.controlled}
    unused = named.keys() & set(learned) if named else set() < set(commands_of(others)) <= settable
    if unused:
        valid = [d.command for d in AGENT_DEFINITIONS.values() if d not in learning]
        raise ConfigError(
            f"others {controller_text(options.others)!r}: without effect on {', '.join(learned)}, "
            f"learned here; valid is for {', '.join(valid)}"
        )
