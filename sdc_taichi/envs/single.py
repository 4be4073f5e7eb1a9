"""One data center as a Gymnasium environment with one learner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sdc_taichi.envs import rendering
from sdc_taichi.envs.core import Core, Observation, Source, Step, checked_array
from sdc_taichi.envs.parallel import core_of_one
from sdc_taichi.envs.recording import Recording
from sdc_taichi.envs.standards import OneDataCenter, first, floats, start_day, start_days
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.types import F32, F64


class Learner(Protocol):
    """Between the one learner of a batch and its agents; arrays have the environments first."""

    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]

    def actions(self, given: Any) -> dict[str, Any]:
        """What each agent does."""

    def observation(self, found: Mapping[str, Observation]) -> Observation:
        """What the learner sees of what the agents see."""

    def reward(self, done: Step) -> F64:
        """What the learner gets of a step, (B,)."""


class OneAgent:
    """One agent learns; it gets its own reward, shared as ``collaboration`` says.

    Args:
        core: in which it alone learns.
    """

    def __init__(self, core: Core) -> None:
        (self._agent,) = core.agents
        self.observation_space = core.observation_spaces[self._agent]
        self.action_space = core.action_spaces[self._agent]

    def actions(self, given: Any) -> dict[str, Any]:
        """The action as it is."""
        return {self._agent: given}

    def observation(self, found: Mapping[str, Observation]) -> Observation:
        """The observation as it is."""
        return found[self._agent]

    def reward(self, done: Step) -> F64:
        """The reward as it is."""
        return np.array(done.rewards[self._agent])


class Joint:
    """All learning agents as one learner.

    It sees their observations side by side, each feature once, rather than the shared state, which
    would show it features that the option ``features`` left out. Its reward is their sum; with all
    three agents the weights of ``collaboration`` cancel. What a reward function of the user's gives
    for all agents alike, it gets once.

    Args:
        core: in which the agents learn.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._kept = _new_columns(core)
        boxes = {agent: _box(core, agent) for agent in core.agents}
        low = np.concatenate([boxes[agent].low[kept] for agent, kept in self._kept.items()])
        high = np.concatenate([boxes[agent].high[kept] for agent, kept in self._kept.items()])
        seen = spaces.Box(low, high, dtype=np.float32)
        whole = core.observation_spaces[core.agents[0]]
        self.observation_space: spaces.Space[Any] = seen
        if isinstance(whole, spaces.Dict):
            self.observation_space = spaces.Dict({**whole.spaces, "features": seen})
        self.action_space = _side_by_side([core.action_spaces[a] for a in core.agents])

    def actions(self, given: Any) -> dict[str, Any]:
        """Columns of each agent.

        Raises:
            SdcError: of another shape.
        """
        given = checked_array(given, "actions")
        shape = (self._core.num_envs, *(self.action_space.shape or ()))
        if given.shape != shape:
            raise SdcError(f"actions: shape {given.shape}, expected {shape}")
        out: dict[str, Any] = {}
        at = 0
        for agent in self._core.agents:
            size = self._core.action_spaces[agent].shape
            width = size[0] if size else 1
            out[agent] = given[:, at : at + width] if size else given[:, at]
            at += width
        return out

    def observation(self, found: Mapping[str, Observation]) -> Observation:
        """Observations side by side, each feature once."""
        parts = [_features(found[a])[:, kept] for a, kept in self._kept.items()]
        seen: F32 = np.concatenate(parts, axis=1)
        whole = found[self._core.agents[0]]
        return {**whole, "features": seen} if isinstance(whole, dict) else seen

    def reward(self, done: Step) -> F64:
        """That of all agents together."""
        return np.array(done.joint_reward)


def learner(core: Core, agent: str | None) -> Learner:
    """The learner of an environment for one agent, or with None for all that learn."""
    return Joint(core) if agent is None else OneAgent(core)


def one_agent(agent: str | None, registered_agent: str | None) -> str | None:
    """Who is the one learner, None being all agents.

    Raises:
        ConfigError: another agent than that of the id.
    """
    if registered_agent is not None and agent not in (None, registered_agent):
        raise ConfigError(
            f"agent {agent!r}: the one agent here is {registered_agent}; valid with another id"
        )
    return registered_agent or agent


def options_for(agent: str | None, options: Mapping[str, Any]) -> dict[str, Any]:
    """Options of an environment for one agent.

    Raises:
        ConfigError: they name agents themselves.
    """
    if agent is None:
        return dict(options)
    if "agents" in options:
        raise ConfigError(
            f"agents {options['agents']!r}: the one agent here is {agent}; valid with "
            "sdc_taichi/Joint-v0"
        )
    return {**options, "agents": (agent,)}


def _new_columns(core: Core) -> dict[str, npt.NDArray[np.int64] | slice]:
    """Columns of each agent's observation whose features no agent before it has."""
    known: set[Any] = set()
    out: dict[str, npt.NDArray[np.int64] | slice] = {}
    for agent, features in core.features.items():
        new = np.repeat([f not in known for f in features], [f.size for f in features])
        kept = np.flatnonzero(new)
        # Side by side they need no copy of their own.
        run = len(kept) > 0 and kept[-1] - kept[0] == len(kept) - 1
        out[agent] = slice(int(kept[0]), int(kept[-1]) + 1) if run else kept
        known.update(features)
    return out


def _box(core: Core, agent: str) -> spaces.Box:
    space = core.observation_spaces[agent]
    found = space["features"] if isinstance(space, spaces.Dict) else space
    assert isinstance(found, spaces.Box)
    return found


def _features(observation: Observation) -> F32:
    return observation["features"] if isinstance(observation, dict) else observation


def _side_by_side(parts: list[spaces.Space[Any]]) -> spaces.Space[Any]:
    boxes = [p for p in parts if isinstance(p, spaces.Box)]
    if boxes:
        low, high = (np.concatenate([getattr(b, side) for b in boxes]) for side in ("low", "high"))
        return spaces.Box(low, high, dtype=np.float32)
    widths = [p.shape[0] if p.shape else 1 for p in parts]
    return spaces.MultiDiscrete([3] * sum(widths))


class SdcEnv(OneDataCenter, gymnasium.Env[Any, Any]):
    """One data center with one learner.

    Episodes end by truncation: their length is a choice, the data center goes on. Infos:
    ``start_day`` after ``reset``, then every (B,) quantity of ``StepResult`` by name.

    Args:
        config: a preset, a file or a config.
        agent: who learns while ``others`` plays the rest; None is all ``agents`` as one.
        precision: of the server kernels, ``f32`` or ``f64``.
        render_mode: None or ``rgb_array``.
        registered_agent: set by the ids of one agent.
        recorder: records episodes: a file ending in .rrd, or what ``EpisodeRecorder`` says.
        options: fields of ``EnvOptions``.

    Raises:
        SdcError: a config or option that is not valid.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  as the base class has it
        "render_modes": list(rendering.RENDER_MODES),
        "render_fps": 8,
    }

    def __init__(
        self,
        config: Source = "corrected",
        *,
        agent: str | None = None,
        precision: Precision = "f32",
        render_mode: str | None = None,
        registered_agent: str | None = None,
        recorder: Recording = None,
        **options: Any,
    ) -> None:
        rendering.check_render_mode(render_mode)
        agent = one_agent(agent, registered_agent)
        self.core = core_of_one(config, precision, options_for(agent, options), recorder)
        self.render_mode = render_mode
        self._learner = learner(self.core, agent)
        self.observation_space = self._learner.observation_space
        self.action_space = self._learner.action_space
        self.state_space = self.core.state_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: decides everything random from here on; None goes on as before.
            options: ``start_day``, a day of the year as ``MM-DD`` or counted from 0.

        Raises:
            ConfigError: a seed, option or day that is not valid.
        """
        observations = self.core.reset(seed, start_day(options))
        super().reset(seed=None if seed is None else int(seed))
        observation = first(self._learner.observation(observations))
        return observation, {"start_day": int(start_days(self.core)[0])}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Advance by one step.

        Raises:
            SdcError: an action outside its space.
            RuntimeStateError: before ``reset``, or after the end of the episode.
        """
        done = self.core.step(self._learner.actions([action]))
        observation = first(self._learner.observation(done.observations))
        reward = float(self._learner.reward(done)[0])
        return observation, reward, False, done.ended, floats(done.result.per_dc())

    def load_state_dict(self, values: Mapping[str, Any]) -> Observation:
        """Go on from the ``state_dict`` of an environment made alike.

        Returns:
            The observation before the next step.

        Raises:
            SdcError: made by another environment, or incomplete.
        """
        return first(self._learner.observation(self.core.load_state_dict(values)))
