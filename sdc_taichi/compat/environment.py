"""The class ``SustainDC`` of the released code, around an environment of this package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sdc_taichi.compat.infos import step_infos, time_entries
from sdc_taichi.compat.keys import config_of, read_keys
from sdc_taichi.compat.rewards import Rewards
from sdc_taichi.control.view import View
from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.base import Environment
from sdc_taichi.envs.core import Transition
from sdc_taichi.envs.images import Image
from sdc_taichi.envs.released import (
    CI_STEPS,
    FEATURES,
    ReleasedObserver,
    power_bounds_kw,
    ranges,
)
from sdc_taichi.errors import SdcError, shortened, whole_number
from sdc_taichi.exogenous.year_clock import FIRST_DAY_OF_MONTH
from sdc_taichi.types import F32, F64, StepResult

START_DAYS = 7
"""Largest distance in days of the first day of an episode from that of the month
(``sustaindc_env.py``)."""
_NAMES = [(agent, feature.name) for agent in AGENTS for feature in FEATURES[agent]]
_SHARED = [
    *range(len(FEATURES["agent_ls"])),
    *(_NAMES.index(("agent_dc", name)) for name in ("workload_next", "outdoor_next")),
    _NAMES.index(("agent_bat", "soc")),
]
"""Entries of the shared state among those of all agents: all of agent_ls, and the entries that it
lacks (``harlsustaindc_env.py``)."""
_TASK_AGES = [i for i, (_, name) in enumerate(_NAMES) if name.startswith("queue_")]
"""Entries of the histogram of task ages among those of all agents."""


class SustainDC(Environment):
    """Environment with the interface of the released SustainDC class, and preset ``sustaindc``.

    Episodes start at a random hour of a random day within a week of the first day of the month.
    All episodes have the same inputs; the option ``years`` of ``parallel_env`` draws other ones.

    Args:
        env_config: constructor keys of the released class; see docs/coming-from-sustaindc.md.
        overrides: values that replace those of the configuration, by section.key.
        arguments: further arguments of ``parallel_env``, such as ``years`` or ``precision``.

    Attributes:
        agents: names of the agents that learn.
        observation_space: space of the observations of each agent, in the order of ``agents``.
        action_space: space of the actions of each agent, in the order of ``agents``.
        infos: infos of the last step, or of the reset, by agent and ``__common__``.

    Raises:
        SdcError: a key is unknown, or a value is not valid.
    """

    def __init__(
        self,
        env_config: Mapping[str, Any],
        *,
        overrides: Mapping[str, Any] | None = None,
        **arguments: Any,
    ) -> None:
        keys = read_keys(env_config)
        self._rewards = Rewards(
            {key: getattr(keys, key) for key in ("ls_reward", "dc_reward", "bat_reward")},
            keys.individual_reward_weight,
        )
        self._open(
            config_of(keys, overrides or {}),
            1,
            agents=keys.agents,
            days=keys.days_per_episode,
            observations="sustaindc",
            rewards=self._step_rewards,
            **arguments,
        )
        core = self.core
        self.agents: list[str] = list(core.agents)
        self.observation_space = [core.observation_spaces[agent] for agent in self.agents]
        self.action_space = [core.action_spaces[agent] for agent in self.agents]
        observer = core.observer
        assert isinstance(observer, ReleasedObserver)
        self._observer = observer
        features = [feature for agent in AGENTS for feature in FEATURES[agent]]
        self.state_space = spaces.Box(*ranges([features[i] for i in _SHARED]))
        low_kw, high_kw = power_bounds_kw(core.sim.fleet, core.sim.sizing, core.sim.precision)
        self._bounds_kw = float(low_kw[0]), float(high_kw[0])
        self._shift_h = keys.timezone_shift
        self._first_day = FIRST_DAY_OF_MONTH[keys.month]
        self._generator: np.random.Generator | None = None
        self._params: dict[str, Any] = {}
        self._seen: F32 = np.zeros(len(_NAMES), dtype=np.float32)
        self._forecast_ci: F64 = np.zeros(CI_STEPS)
        self.infos: dict[str, dict[str, Any]] = {}

    def seed(self, seed: int | None = None) -> None:
        """Seed the random generator of the following episodes.

        Without a seed, the seed of each episode is drawn from NumPy's global generator, which the
        wrappers of HARL seed.

        Args:
            seed: seed; None and 0 mean 1, as in the released code.

        Raises:
            ConfigError: the seed is not valid.
        """
        self._generator = np.random.default_rng(whole_number("seed", seed or 1, 0, 2**63 - 1))

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> dict[str, F32]:
        """Start an episode.

        Args:
            seed: seed of this and the following episodes; None continues.
            options: without effect.

        Returns:
            Observations before the first step, by agent.

        Raises:
            ConfigError: the seed is not valid.
        """
        if seed is not None:
            self.seed(seed)
        if self._generator is None:
            # HARL's wrapper seeds this generator before each episode, and passes no seed on.
            drawn = np.random.default_rng(np.random.randint(2**31))  # noqa: NPY002
        else:
            drawn = self._generator
        day = drawn.integers(
            max(0, self._first_day - START_DAYS), min(364, self._first_day + START_DAYS) + 1
        )
        hour, episode = drawn.integers(24), drawn.integers(2**31)
        observations = self.core.reset(int(episode), int(day), int(hour) + self._shift_h)
        view = self.core.view
        self._rewards.reset(view)
        self._look(view)
        no_step: dict[str, dict[str, Any]] = {agent: {} for agent in AGENTS}
        self.infos = no_step | {"__common__": self._common(view)}
        return self._by_agent(observations)

    def step(
        self, action_dict: Mapping[str, Any]
    ) -> tuple[
        dict[str, F32],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Advance the data center by one step.

        Args:
            action_dict: action of each agent, 0..2.

        Returns:
            Observations, rewards, terminations, truncations and infos by agent. Terminations and
            truncations also have the key ``__all__``, and infos the key ``__common__``.

        Raises:
            SdcError: the action of an agent is missing or not valid.
            RuntimeStateError: the environment has not been reset, or the episode is over.
        """
        actions: Any = action_dict
        if isinstance(action_dict, Mapping):
            actions = {agent: np.array([_whole(agent, x)]) for agent, x in action_dict.items()}
        transition = self.core.step(actions)
        by_agent = {agent: dict(self._params) for agent in AGENTS}
        self.infos = by_agent | {"__common__": self._common(self.core.view)}
        return (
            self._by_agent(transition.observations),
            {agent: float(transition.rewards[agent][0]) for agent in self.agents},
            self._flags(transition, "terminated"),
            self._flags(transition, "truncated"),
            {**by_agent, "__common__": dict(self._params)},
        )

    def state(self) -> F32:
        """Return the shared state for centralised critics, (29,)."""
        return self._seen[_SHARED]

    def render(self, mode: str = "human") -> Image | None:
        """Return a picture of the hall with argument ``render_mode``; otherwise do nothing."""
        return None if self.render_mode is None else self._frame(0)

    def get_avail_agent_actions(self, agent_id: int) -> list[int]:
        """Return 1 for each action of an agent, all of which are available."""
        return [1] * 3

    def get_avail_actions(self) -> list[list[int]]:
        """Return the available actions of each agent."""
        return [self.get_avail_agent_actions(i) for i in range(len(self.agents))]

    def _step_rewards(self, result: StepResult, view: View) -> dict[str, F64]:
        """Compute infos and rewards of a step; the core calls this function."""
        self._look(view)
        self._params = step_infos(
            result,
            view,
            bounds_kw=self._bounds_kw,
            forecast_ci=self._forecast_ci,
            task_ages=self._seen[_TASK_AGES],
            shift_h=self._shift_h,
            is_last=view.state.step >= self.core.steps,
        )
        return self._rewards.rewards(result, view, self._params)

    def _by_agent(self, observations: Mapping[str, Any]) -> dict[str, F32]:
        return {agent: observations[agent][0] for agent in self.agents}

    def _flags(self, transition: Transition, name: str) -> dict[str, bool]:
        value = bool(getattr(transition, name)[0])
        return {**dict.fromkeys(self.agents, value), "__all__": value}

    def _look(self, view: View) -> None:
        """Observe all agents, and the scaled carbon intensity of the steps after the coming one."""
        self._seen = self._observer.state(view)[0]
        index = view.drivers.start + view.state.step
        ahead = [self._observer.scaled_ci(index + k)[0] for k in range(1, CI_STEPS + 1)]
        self._forecast_ci = np.array(ahead)

    def _common(self, view: View) -> dict[str, Any]:
        """Return the infos under ``__common__`` that the attribute ``infos`` has."""
        now, index = view.now, int(view.drivers.start[0]) + view.state.step
        ends = np.cumsum([len(FEATURES[agent]) for agent in AGENTS])
        by_agent = np.split(self._seen, ends[:-1])
        return {
            "time": time_entries(index, view.fleet.steps_per_hour, self._shift_h),
            "workload": float(now.demand[0]),
            "weather": float(now.outdoor_c[0]),
            "ci": float(self._seen[_NAMES.index(("agent_ls", "ci"))]),
            "ci_future": self._forecast_ci,
            "states": dict(zip(AGENTS, by_agent, strict=True)),
        }


def _whole(agent: str, action: Any) -> int:
    """Return an action, a whole number or an array with one, as an integer."""
    values = np.asarray(action).reshape(-1)
    if len(values) != 1 or values.dtype.kind not in "iuf" or values[0] != values[0] // 1:
        raise SdcError(f"action of {agent}: {shortened(action)}; valid is 0, 1 or 2")
    return int(values[0])
