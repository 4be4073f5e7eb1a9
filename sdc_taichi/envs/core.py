"""Episodes of a batch of data centers; all environments are thin wrappers around ``Core``.

An environment is a data center, or a fleet of S sites that share work. In shapes, E is the number
of environments, and B = E S that of data centers. The first axis of every array is the environment.

A step decodes the actions, adds the commands of a controller for the agents that do not learn,
advances the simulator, and computes rewards and observations from the view after the step.
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
from sdc_taichi.envs.agents import (
    AGENT_DEFINITIONS,
    HALL_AGENTS,
    LIQUID_AGENTS,
    commands_by_others,
    members_of,
    present_agents,
)
from sdc_taichi.envs.costs import Costs
from sdc_taichi.envs.episodes import (
    Draw,
    DrawnInputs,
    Seed,
    check_state,
    chosen_start_days,
    config_keys_of,
    draw_info,
    draws_inputs,
    seeded_generators,
)
from sdc_taichi.envs.features import Feature
from sdc_taichi.envs.images import heat_map, heat_map_space
from sdc_taichi.envs.observer import Observer, make_observer
from sdc_taichi.envs.options import ConfigDraw, EnvOptions
from sdc_taichi.envs.recording import EpisodeRecordings, RecorderOption
from sdc_taichi.envs.released import ReleasedObserver
from sdc_taichi.envs.rewards import Rewards
from sdc_taichi.envs.unit_slots import slots_of_groups
from sdc_taichi.envs.view_terms import HIGHEST_RECOMMENDED_C
from sdc_taichi.errors import ConfigError, RuntimeStateError, whole_number
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, day_of_year
from sdc_taichi.sim.drivers import local_start, utc_start
from sdc_taichi.sim.events import require_events_start_before
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.fleet_configs import MOST_DCS, with_sites
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.step_inputs import LIQUID_COMMANDS
from sdc_taichi.types import (
    CDUS,
    CRAC_UNITS,
    F32,
    F64,
    I64,
    QUANTITIES_PER_DC,
    Actions,
    State,
    StepResult,
)

Observation = F32 | dict[str, F32]
"""Observations of a group of agents in E environments: an array (E, n), or with option ``heat_map``
a dict of ``features``, (E, n), and ``heat_map``, (E, rows, racks per row, channels). Features of a
group with W agents are (E, W, n), and its rewards (E, W): one agent for each unit, or in a fleet
that shares work for each site."""


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
    """Rewards by learning group, (E,) each, or (E, W) for a group with W agents."""
    joint_reward: F64
    """Reward of a single learner that controls all learning agents, (E,): in a fleet the
    mean over its sites."""
    costs: dict[str, F64]
    """Costs of the step, (E,) each: ``cost_NAME`` for each cost of the option ``costs``, and their
    weighted sum ``cost``; in a fleet the sum over its sites. The dict is empty without the
    option."""
    ended: bool
    """True if all episodes of the batch are over after this step."""
    ended_by: I64
    """Reason why each episode ended, as a value of ``EndedBy``, (E,)."""
    result: StepResult
    """Result of the simulator's step."""

    @property
    def terminated(self) -> npt.NDArray[np.bool_]:
        """True for episodes that a physical limit has ended, (E,)."""
        return np.asarray(self.ended_by == EndedBy.PHYSICAL_LIMITS)

    @property
    def truncated(self) -> npt.NDArray[np.bool_]:
        """True for episodes that ended because of their length, (E,)."""
        return np.asarray(self.ended_by == EndedBy.LENGTH)


class Core:
    """A batch of data centers whose episodes begin and end together.

    A physical limit ends the episode of a single environment earlier. ``restart_ended`` then starts
    an episode of this environment that lasts until those of the batch end.

    Args:
        configs: configs of data centers or fleets; environment i uses config i modulo their number.
            A ``ConfigDraw`` draws a config for each environment and episode.
        options: actions, observations and rewards of the agents.
        num_envs: number of environments; None creates one per config.
        precision: floating-point precision of the server kernels.
        recorder: choice and destination of recorded episodes; None records nothing.
        clip_actions: value of ``options.clip_actions`` if that is None.

    Attributes:
        options: actions, observations and rewards of the agents.
        agents: names of the groups of agents that learn.
        members: names of the agents of each learning group in one environment. A group with an
            agent for each unit has as many as the data center with the most units. In a fleet,
            every group has an agent for each site, such as ``NY/agent_geo``.
        slots: places of the agents in arrays, by learning group with an agent for each unit.
        num_envs: number of environments, E.
        steps: number of steps of an episode.
        sim: simulator of all B data centers.
        features: features of each learning agent, in the order of its observation.
        observation_spaces: observation space of one agent, by learning group.
        action_spaces: action space of one agent, by learning group.
        state_space: space of the shared state of one environment.
        ended_early: True for environments whose episode has ended at a physical limit, and whose
            next one has not begun, (E,).

    Raises:
        SdcError: a config, option or number is not valid.
    """

    def __init__(
        self,
        configs: Sequence[DataCenterConfig] | ConfigDraw,
        options: EnvOptions,
        num_envs: int | None = None,
        precision: Precision = "f32",
        recorder: RecorderOption = None,
        *,
        clip_actions: bool = False,
    ) -> None:
        self.options = options
        self.agents: tuple[str, ...] = options.agents
        self._precision: Precision = precision
        self._clips = clip_actions
        self._source = configs if isinstance(configs, ConfigDraw) else None
        if isinstance(configs, ConfigDraw):
            self.num_envs = size = _checked_size(1 if num_envs is None else num_envs, 1)
            self._config_keys: I64 | None = np.arange(size, dtype=np.int64)
            by_env = configs.configs(self._config_keys)
            most = configs.most_units
            self._widths = {} if most is None else {CRAC_UNITS: most}
        else:
            self.num_envs = size = _checked_size(num_envs, len(configs))
            self._config_keys = None
            by_env = [configs[i % len(configs)] for i in range(size)]
            self._widths = {}
        self._learned_commands = [name for a in self.agents for name in options.commands_of(a)]
        self._rewards = Rewards(
            options.rewards,
            options.collaboration,
            agents=self.agents,
            days=options.days,
            liquid=not LIQUID_COMMANDS.keys().isdisjoint(self._learned_commands),
        )
        # Plain values that identify the environment in saved states. Costs and the clipping of
        # actions are left out because they do not change an episode.
        without_effect = {"costs", "clip_actions", *(() if options.neighbours else ("neighbours",))}
        self._identity = options.model_dump(exclude={"rewards", "others", *without_effect}) | {
            "rewards": self._rewards.identity,
            "others": controller_text(options.others),
        }
        self._build(by_env)
        fleet = self.sim.fleet
        self.observation_spaces: dict[str, spaces.Space[Any]] = {
            a: self._observation_space(a) for a in self.agents
        }
        self.action_spaces = self._decoder.spaces
        self.members: dict[str, tuple[str, ...]] = {a: self._names_of(a) for a in self.agents}
        self.state_space = self._observer.state_space
        if self._sites > 1:
            space = self._observer.state_space
            low, high = (np.tile(x, self._sites) for x in (space.low, space.high))
            self.state_space = spaces.Box(low, high, dtype=np.float32)
        self._steps_per_day = 24 * fleet.steps_per_hour
        self.steps = options.days * self._steps_per_day
        self._start_days = np.array(options.start_days())
        self._generators: list[np.random.Generator] = []
        self._view_after: Any = None
        self._view: View | None = None
        self._last: tuple[State, dict[str, F64]] | None = None
        self._final_terms: dict[str, F64] = {}
        self._keys: I64 = np.zeros(fleet.size, dtype=np.int64)
        self.ended_early: npt.NDArray[np.bool_] = np.zeros(size, dtype=np.bool_)
        self._closed = False
        self._recordings: EpisodeRecordings | None = None
        self.record_episodes(recorder)

    def _build(self, configs: Sequence[DataCenterConfig]) -> None:
        """Create simulator, controller of other agents, observer and decoder of data centers.

        Raises:
            SdcError: a config does not fit the others or the options.
        """
        options = self.options
        if options.tariff is not None:
            configs = [c.model_copy(update={"tariff": options.tariff}) for c in configs]
        by_dc = with_sites(configs)
        self._inputs = DrawnInputs(by_dc, options) if draws_inputs(options) else None
        self._draw: Draw | None = None
        first = None if self._inputs is None else self._inputs.first()
        self.sim = Simulator(by_dc, drivers=first, precision=self._precision, limits="flag")
        fleet = self.sim.fleet
        self._sites = fleet.sites_per_fleet
        if fleet.size != len(configs) * self._sites:
            raise ConfigError("config: data centers of a part of a fleet; valid are whole fleets")
        require_events_start_before(24.0 * options.days, fleet.configs, "the episode")
        self._others = make_controller(options.others, fleet)
        _check_others(options, self._others, fleet)
        _check_groups(options, self._sites)
        self._commands_of_others = commands_by_others(
            self.agents, self._learned_commands, commands_of(self._others)
        )
        self._costs = Costs(options.costs, fleet)
        self.slots = slots_of_groups(fleet, self.agents, self._widths)
        self._observer = make_observer(
            fleet, options, new_inputs=draws_inputs(options), slots=self.slots
        )
        self._decoder = AgentActions(fleet, options, clip=self._clips, slots=self.slots)
        self.features: dict[str, tuple[Feature, ...]] = {
            a: self._observer.features[a] for a in self.agents
        }

    def _draw_configs(self, keys: I64) -> None:
        """Replace the data centers by those that belong to random keys, (E,)."""
        assert self._source is not None
        configs = self._source.configs(keys)
        self.sim.close()
        self._view = self._view_after = None
        self._build(configs)
        members = {agent: self._names_of(agent) for agent in self.agents}
        if self._decoder.spaces != self.action_spaces or members != self.members:
            raise ConfigError(
                "config: draws data centers with other agents or actions; valid are equal numbers "
                "of CRAC units and racks where agents decide on them, or most_units of the function"
            )
        self._config_keys = keys

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

    def reset(
        self, seed: Seed = None, start_day: Any = None, start_hour: int = 0
    ) -> dict[str, Observation]:
        """Start an episode in all environments.

        Args:
            seed: environment i uses ``seed + i``, or entry i of a sequence. With None each
                environment continues its random generator, or seeds a new one from the operating
                system's entropy.
            start_day: first day of the episodes as ``MM-DD`` or as number of the day in the year,
                from 0; or one day for each environment. None uses the option ``start``.
            start_hour: first hour of the episodes after the midnight of the first day; hours before
                and after that day are those of its neighbours.

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
        events, drawn_days, keys = np.array(drawn, dtype=np.int64).T
        if self._source is not None:
            config_keys = [int(rng.integers(2**63 - 1)) for rng in self._generators]
            self._draw_configs(np.array(config_keys, dtype=np.int64))
        days = self._drawn_start_days(drawn_days) if chosen is None else chosen
        inputs = None
        if self._inputs is not None:
            by_dc = [rng for rng in self._generators for _ in range(self._sites)]
            self._draw = self._inputs.draw(by_dc)
            inputs = self._inputs.drivers(self._draw)
        # Sites of a fleet have different events and forecast errors.
        events, self._keys = (self._of_each_site(x) for x in (events, keys))
        steps = days * self._steps_per_day + start_hour * self.sim.fleet.steps_per_hour
        start = np.repeat(steps % (DAYS_PER_YEAR * self._steps_per_day), self._sites)
        if self._sites > 1:
            utc_offset_h = (inputs or self.sim.drivers).utc_offset_h
            start = local_start(start, utc_offset_h, self.sim.fleet.steps_per_hour)
        self.sim.reset(events, start, inputs)
        self._begin()
        observations = self._observe(self.view)
        self._begin_recording()
        return observations

    def _of_each_site(self, drawn: I64) -> I64:
        """Return random integers of 0..2**63 - 1 for each data center from those of environments.

        The integers of a fleet are consecutive.
        """
        if self._sites == 1:
            return drawn
        return ((drawn[:, None] + np.arange(self._sites)) & (2**63 - 1)).reshape(-1)

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
        self._rewards.reset(view, self.slots)

    def restart_ended(self) -> npt.NDArray[np.bool_]:
        """Start the next episodes of the environments ``ended_early``, which end with the batch.

        Their data centers have the state of the first step of the batch again; weather, demand,
        events, and the memory of the controller ``others`` continue.

        Returns:
            True for these environments, (E,).
        """
        chosen = self.ended_early
        if chosen.any():
            last, dcs = self.view.last, np.repeat(chosen, self._sites)
            self.sim.restart(dcs)
            self.ended_early = np.zeros(self.num_envs, dtype=np.bool_)
            self._view = self._view_after(last)
            self._rewards.restart(dcs, self.view)
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
        self,
        actions: Mapping[str, Any],
        starting: npt.NDArray[np.bool_] | None = None,
        *,
        observes: bool = True,
    ) -> Transition:
        """Advance all environments by one step.

        In the environments ``ended_early`` the actions are neutral and the rewards are 0, and they
        stay terminated.

        Args:
            actions: actions by learning group. Discrete actions are integers, (E,), or (E, k) if an
                agent decides k values; continuous actions are floats, (E, k). Groups with W agents
                have a second axis (E, W, ...).
            starting: True for environments of ``restart_ended`` that use this step as the reset of
                their next episode, (E,): their actions are neutral and their rewards are 0.
            observes: False leaves out the observations, which ``observe`` then returns if needed.

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
        commands = self._decoder.decode(self._by_dc(actions), view)
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
        if self._sites > 1:
            rewards = {a: self._by_env(r) for a, r in rewards.items()}
            joint_reward = self._by_env(joint_reward).mean(axis=1)
        beyond = self._by_env(result.within_limits < 1.0)
        if self._sites > 1:
            beyond = beyond.any(axis=1)
        if idle.any() or beyond.any():
            replaced = np.where(idle, 0.0, REWARD_BEYOND_LIMITS)
            is_replaced = idle | beyond
            rewards = {
                a: np.where(_like(is_replaced, r), _like(replaced, r), r)
                for a, r in rewards.items()
            }
            joint_reward = np.where(is_replaced, replaced, joint_reward)
            self.ended_early = waiting | (beyond & ~idle)
        ended_by = np.where(self.ended_early, EndedBy.PHYSICAL_LIMITS, EndedBy.NOT_ENDED)
        if view.state.step >= self.steps:
            ended_by[~self.ended_early] = EndedBy.LENGTH
        transition = Transition(
            observations=self._observe(view) if observes else {},
            rewards=rewards,
            joint_reward=joint_reward,
            costs={n: self._of_env(x) for n, x in self._costs.of(result, view).items()},
            ended=self.episode_over,
            ended_by=ended_by.astype(np.int64),
            result=result,
        )
        if self._recordings is not None and self._recordings.is_recording:
            terms = self._rewards.terms(result, self._rewards.used_terms)
            of_dcs = {a: self._reward_of_dcs(a, r) for a, r in rewards.items()}
            self._recordings.add(result, {**of_dcs, **terms})
            if transition.ended:
                self._recordings.end()
        return transition

    def _reward_of_dcs(self, agent: str, reward: F64) -> F64:
        """Return the reward of a group for each data center, of units their mean, (B,)."""
        return reward.mean(axis=1) if agent in self.slots else reward.reshape(-1)

    def _by_env(self, of_dcs: Any) -> Any:
        """Arrange values of data centers, (B, ...), by site of a fleet, (E, S, ...); see ``Core``.

        Values of data centers that are environments stay as they are, (E, ...).
        """
        if self._sites == 1:
            return of_dcs
        if isinstance(of_dcs, Mapping):
            return {name: self._by_env(values) for name, values in of_dcs.items()}
        return of_dcs.reshape(self.num_envs, self._sites, *of_dcs.shape[1:])

    def _of_env(self, of_dcs: F64) -> F64:
        """Return the sum over the sites of each environment, (E,)."""
        return of_dcs if self._sites == 1 else self._by_env(of_dcs).sum(axis=1)

    def _by_dc(self, actions: Any) -> Any:
        """Arrange actions by site of a fleet, (E, S, ...), by data center; wrong ones stay."""
        if self._sites == 1 or not isinstance(actions, Mapping):
            return actions
        by_dc = dict(actions)
        for agent in by_dc.keys() & self.members.keys():
            values = np.asarray(by_dc[agent])
            if values.shape[:2] == (self.num_envs, self._sites):
                by_dc[agent] = values.reshape(-1, *values.shape[2:])
        return by_dc

    def _names_of(self, agent: str) -> tuple[str, ...]:
        """Return the names of the agents of a group in one environment."""
        if agent in self.slots:
            return members_of(agent, self.slots[agent].width)
        if self._sites == 1:
            return (agent,)
        sites = [config.site.location for config in self.sim.fleet.configs[: self._sites]]
        return tuple(f"{site}/{agent}" for site in sites)

    def actions_of(self, commands: Actions) -> dict[str, npt.NDArray[Any]]:
        """Return the actions for ``step`` that are nearest to commands, by learning agent.

        Args:
            commands: commands of one step, for example of a controller.
        """
        actions = self._decoder.encode(commands, self.view)
        by_env: dict[str, npt.NDArray[Any]] = self._by_env(actions)
        return by_env

    @property
    def observer(self) -> Observer | ReleasedObserver:
        """The observer, which computes the observations."""
        return self._observer

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
        """Return the neutral actions of each learning group, in the form that ``step`` takes."""
        idle: dict[str, npt.NDArray[Any]] = self._by_env(self._decoder.idle_actions())
        return idle

    def masks(self) -> dict[str, npt.NDArray[np.bool_]]:
        """Return True for the agents that act, by group of ``masked_groups``, (B, W) or (E, S).

        The action of an agent is without effect if its unit or the links of its site were down
        in the last step, or if its unit does not exist.
        """
        masks: dict[str, npt.NDArray[np.bool_]] = {}
        for agent in self.masked_groups:
            if (slots := self.slots.get(agent)) is None:
                masks[agent] = self._by_env(self.view.link_up > 0)
            else:
                of_cdus = AGENT_DEFINITIONS[agent].axis == CDUS
                units = self.view.cdu_running if of_cdus else self.view.unit_running
                masks[agent] = (slots.fill(units) > 0) & slots.exists
        return masks

    @property
    def masked_groups(self) -> tuple[str, ...]:
        """Groups whose agents may be without effect: those of units, and of transfers."""
        return tuple(a for a in self.agents if a in self.slots or a == "agent_geo")

    def zone_heat_k_h(self) -> dict[str, F64]:
        """Return the excess of the hottest inlet of each agent's zone over 27 C, in K h, (B, W).

        It is that of the last step, by learning group with an agent for each CRAC unit, and 0
        before the first step.
        """
        if "crac" not in self.slots:
            return {}
        view = self.view
        over_k = np.maximum(view.zone_hottest_true_c - HIGHEST_RECOMMENDED_C, 0.0)
        heat = self.slots["crac"].fill(over_k * (0.0 if view.last is None else view.step_h))
        return {"crac": heat}

    def start_info(self) -> dict[str, npt.NDArray[Any]]:
        """Return the start day and the randomly drawn inputs of the current episodes, (E,) each.

        ``start_day`` is the day of the year, from 0, for a fleet in UTC. Option ``years`` adds
        ``year``, the seed of the synthetic series, and option ``traces`` adds ``trace``, the
        workload trace; those of a fleet are (E, S).
        """
        start = self.view.state.start[:: self._sites]
        if self._sites > 1:
            offset_h = self.view.drivers.utc_offset_h[:: self._sites]
            in_utc = utc_start(start, offset_h, self.sim.fleet.steps_per_hour)
            start = in_utc.astype(np.int64)
        start = start // self._steps_per_day
        drawn: dict[str, npt.NDArray[Any]] = self._by_env(draw_info(self._draw))
        return {"start_day": np.asarray(start, dtype=np.int64), **drawn}

    def infos(self, transition: Transition | None = None) -> dict[str, npt.NDArray[Any]]:
        """Return the infos of a step, or those of a reset without one, by name, (E,) each.

        Quantities of a fleet are (E, S).

        Both have the same keys and types, because some libraries read the infos of a reset to know
        those of all steps: the start day and the drawn inputs of the current episodes, and
        quantities and costs of the step, and ``ended_by``, a value of ``EndedBy``. At a reset, all
        but the inputs are 0.

        Args:
            transition: result of the step; None after a reset.
        """
        of_step: dict[str, npt.NDArray[Any]]
        if transition is None:
            zeros = np.zeros((len(QUANTITIES_PER_DC), self.sim.size))
            of_step = self._by_env(dict(zip(QUANTITIES_PER_DC, zeros, strict=True)))
            of_step |= {name: np.zeros(self.num_envs) for name in self._costs.names}
            of_step["ended_by"] = np.zeros(self.num_envs, dtype=np.int64)
        else:
            of_step = {**self._by_env(transition.result.per_dc()), **transition.costs}
            of_step["ended_by"] = transition.ended_by
        return {**self.start_info(), **of_step}

    def state(self) -> F32:
        """Return the shared state for centralised critics: all features of all agents, (E, m).

        In a fleet the states of its sites are concatenated.
        """
        view = self.view
        return self._observer.state(view).reshape(self.num_envs, -1)

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
        } | ({} if self._config_keys is None else {"configs": self._config_keys.copy()})

    def load_state_dict(self, values: Mapping[str, Any]) -> dict[str, Observation]:
        """Continue from a ``state_dict`` of environments with the same configs and options.

        Returns:
            Observations before the next step.

        Raises:
            SdcError: the state belongs to other environments, is incomplete or is not valid; the
                environments are then unchanged, except that those with drawn configs need a reset.
        """
        self._check_open()
        if self._source is not None:
            self._draw_configs(config_keys_of(values, self.num_envs))
        saved = check_state(
            values,
            options=self._identity,
            inputs=self._inputs,
            sim=self.sim,
            num_envs=self.num_envs,
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
                beyond = (result.within_limits < 1.0).reshape(self.num_envs, -1)
                self.ended_early = np.asarray(beyond.any(axis=1))
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
        features = self._by_env(self._observer.observe(view))
        if not self.options.heat_map:
            return {**features}
        image = heat_map(view)
        return {a: {"features": features[a], "heat_map": image.copy()} for a in self.agents}

    def _drawn_start_days(self, drawn: I64) -> I64:
        """Return the first day of each episode, by the options and random integers, (E,)."""
        if self.options.start == "fixed":
            starts = [c.site.start for c in self.sim.fleet.configs[:: self._sites]]
            return np.array([day_of_year(s) for s in starts], dtype=np.int64)
        return np.asarray(self._start_days[drawn % len(self._start_days)], dtype=np.int64)


def _like(of_envs: npt.NDArray[Any], rewards: F64) -> npt.NDArray[Any]:
    """Return values of environments, (E,), with as many axes as rewards, (E,) or (E, W)."""
    return of_envs.reshape(-1, *[1] * (rewards.ndim - 1))


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


def _check_groups(options: EnvOptions, sites: int) -> None:
    """Refuse groups and observations that environments of a fleet do not have."""
    if sites == 1:
        return
    of_hall = [agent for agent in options.agents if agent in (*HALL_AGENTS, *LIQUID_AGENTS)]
    if of_hall:
        raise ConfigError(
            f"agents: {', '.join(of_hall)} in a fleet; valid with a data center alone, or agent_dc"
        )
    if options.heat_map:
        raise ConfigError("heat_map True: in a fleet; valid with a data center alone, or False")


def _check_others(options: EnvOptions, others: Controller, fleet: Fleet) -> None:
    """Refuse a controller ``others`` that would have no effect.

    Raises:
        ConfigError: a part of ``others`` names a command of a learning agent, or learning agents
            decide all commands that ``others`` sets.
    """
    if "others" not in options.model_fields_set:
        return
    absent = () if fleet.cdus else LIQUID_AGENTS
    present = [agent for agent in present_agents(options.agents) if agent not in absent]
    # A part of which a group does not learn is still commanded by ``others``.
    open_parts = dict.fromkeys(
        AGENT_DEFINITIONS[a].part for a in present if a not in options.agents
    )
    learning = [AGENT_DEFINITIONS[a] for a in options.agents]
    learned = [d.part for d in learning if d.part not in open_parts]
    named = parts_of(options.others) if isinstance(options.others, str) else {}
    settable = {name for d in learning if d.part in learned for name in d.controlled}
    unused = named.keys() & set(learned) if named else set() < set(commands_of(others)) <= settable
    if unused:
        raise ConfigError(
            f"others {controller_text(options.others)!r}: without effect on {', '.join(learned)}, "
            f"learned here; valid is for {', '.join(open_parts)}"
        )
