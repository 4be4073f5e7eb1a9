"""Common base of all environments: constructor arguments, infos, methods and Gymnasium specs."""

from __future__ import annotations

import importlib
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import asdict
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from pydantic import BaseModel

from sdc_taichi.control.view import ForecastError
from sdc_taichi.envs.core import Core, Observation
from sdc_taichi.envs.images import RENDER_MODES, Image, check_render_mode, frame
from sdc_taichi.envs.options import (
    ConfigDraw,
    ConfigSource,
    EnvOptions,
    Overrides,
    configs_and_options,
    fields_set,
)
from sdc_taichi.envs.recording import RecorderOption
from sdc_taichi.errors import ConfigError, suggestion_or_valid
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.types import F32, F64
from sdc_taichi.user_functions import import_path

RESET_OPTIONS = ("start_day",)
"""Valid keys of ``options`` in ``reset(options=...)``."""
METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 8}
"""Metadata of all environments, as Gymnasium and PettingZoo define them."""


class Environment:
    """Base of all environments: attributes and methods that Gymnasium and PettingZoo lack."""

    core: Core
    """Batch of data centers that the environment wraps."""
    render_mode: str | None
    """None or ``rgb_array``."""
    state_space: spaces.Space[Any]
    """Space of the shared state of one environment."""

    def _open(
        self,
        config: ConfigSource,
        num_envs: int | None,
        only_agent: str | None = None,
        *,
        overrides: Overrides = (),
        options: EnvOptions | None = None,
        precision: Precision = "f32",
        render_mode: str | None = None,
        recorder: RecorderOption = None,
        **keywords: Any,
    ) -> None:
        """Create the data centers from the arguments of an environment's constructor.

        Args:
            config: a preset, a file, a config or a dict of its sections. A batch also takes a list
                of configs or dicts; environment i uses entry i modulo the length of the list. A
                function of a random generator draws a config for each environment and episode.
            num_envs: number of environments; None creates one per config.
            only_agent: the learning agent of an environment with a single agent; None otherwise.
            overrides: values that replace those of every config: a dict from section.key to value,
                or a list of ``section.key=value``.
            options: options of the environment; None means the default options.
            precision: floating-point precision of the server kernels, ``f32`` or ``f64``.
            render_mode: None or ``rgb_array``.
            recorder: destination of recordings: a file ending in .rrd, or an ``EpisodeRecorder``.
            keywords: fields of ``EnvOptions``, which take precedence over ``options``.

        Raises:
            SdcError: a config, number or option is not valid.
        """
        check_render_mode(render_mode)
        configs, chosen = configs_and_options(config, overrides, options, keywords, only_agent)
        number = 1 if isinstance(configs, ConfigDraw) else len(configs)
        if isinstance(self, SingleEnv) and number != 1:
            raise ConfigError(f"config: {number} data centers; valid is one, or vector_env")
        batched = isinstance(self, BatchEnv)
        self.core = Core(configs, chosen, num_envs, precision, recorder, clip_actions=batched)
        self.render_mode = render_mode
        self.state_space = self.core.state_space

    def _frame(self, env: int) -> Image:
        """Picture of the hall of one environment, (height, width, 3)."""
        if self.render_mode is None:
            raise ConfigError("render: made without render_mode; valid is render_mode='rgb_array'")
        return frame(self.core.view, env)

    def state_dict(self) -> dict[str, Any]:
        """Return a picklable state from which ``load_state_dict`` continues bit for bit."""
        return self.core.state_dict()

    def close(self) -> None:
        """Close the simulator; the environment cannot be used afterwards."""
        self.core.close()


class SingleEnv(Environment):
    """Base of environments with one data center."""

    def state(self) -> F32:
        """Return the shared state for centralised critics, an element of ``state_space``, (m,)."""
        return np.asarray(self.core.state()[0])

    def reward_terms(self) -> dict[str, float]:
        """Return all reward terms of the last step by name, unscaled; empty before any step."""
        return as_scalars(self.core.reward_terms())

    def render(self) -> Image:
        """Return a picture of the hall after the last step, (height, width, 3).

        Raises:
            ConfigError: the environment was created without ``render_mode``.
        """
        return self._frame(0)


class BatchEnv(Environment):
    """Base of batches of B environments."""

    num_envs: int
    """Number of environments, B."""

    def state(self) -> F32:
        """Return the shared state of each environment for centralised critics, (B, m)."""
        return self.core.state()

    def reward_terms(self) -> dict[str, F64]:
        """Return all reward terms of the last step by name, unscaled, (B,) each.

        The dict is empty before the first step. If the last step ended the episodes and started the
        next ones, the terms still belong to that step.
        """
        return self.core.reward_terms()

    def render(self) -> tuple[Image, ...]:
        """Return a picture of each hall after the last step, (height, width, 3) each.

        Raises:
            ConfigError: the environment was created without ``render_mode``.
        """
        return tuple(self._frame(i) for i in range(self.core.num_envs))


class AgentSpaces:
    """Observation and action spaces by agent, as in PettingZoo.

    Batches have the spaces of groups, which are those of each of their agents.
    """

    observation_spaces: dict[str, spaces.Space[Any]]
    """Space of the observations of one environment, by agent."""
    action_spaces: dict[str, spaces.Space[Any]]
    """Space of the actions of one environment, by agent."""

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return the observation space of an agent in one environment.

        Raises:
            ConfigError: the agent does not learn in this environment.
        """
        return _space_of(agent, self.observation_spaces)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the action space of an agent in one environment.

        Raises:
            ConfigError: the agent does not learn in this environment.
        """
        return _space_of(agent, self.action_spaces)


def _space_of(agent: str, by_agent: Mapping[str, spaces.Space[Any]]) -> spaces.Space[Any]:
    if agent not in by_agent:
        raise ConfigError(f"agent {agent!r}: does not learn here; valid: {list(by_agent)}")
    return by_agent[agent]


def start_day_option(options: Mapping[str, Any] | None, *, strict: bool = True) -> Any:
    """Check the options of ``reset`` and return ``start_day``, or None without it.

    Args:
        options: values by name.
        strict: True if an unknown name is an error, False if it is a warning. PettingZoo
            environments only warn, because PettingZoo's own API test passes an unknown option.

    Raises:
        ConfigError: an option is unknown and ``strict`` is True, or ``options`` is no dict.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(f"reset options {options!r}: valid is a dict")
    values = dict(options or {})
    for name in values:
        if name not in RESET_OPTIONS:
            meant = suggestion_or_valid(name, RESET_OPTIONS)
            if strict:
                raise ConfigError(f"reset options: unknown {name!r}{meant}")
            warnings.warn(f"reset options: {name!r} is without effect{meant}", stacklevel=3)
    return values.get("start_day")


def as_scalars(by_name: Mapping[str, npt.NDArray[Any]], site: int | None = None) -> dict[str, Any]:
    """Convert the arrays of a batch of one environment, (1,) each, to numbers and text.

    Args:
        by_name: arrays by name; those of the sites of a fleet are (1, S).
        site: index of the site whose values are returned; None returns those of all sites, (S,).
    """
    return {
        name: values.item() if values.ndim == 1 else _of_site(values[0], site)
        for name, values in by_name.items()
    }


def _of_site(values: npt.NDArray[Any], site: int | None) -> Any:
    return values if site is None else values[site].item()


def first_of_batch(observation: Observation) -> Observation:
    """Return the observation of a batch's first environment: (n,) from (B, n)."""
    if isinstance(observation, dict):
        return {name: values[0] for name, values in observation.items()}
    return np.asarray(observation[0])


def agent_part(values: Any, agent: int) -> Any:
    """Return the part of one agent in the values of a group, whose first axis is the agent.

    The agents of a group share the heat map.
    """
    if isinstance(values, dict):
        return {**values, "features": values["features"][agent]}
    return values[agent]


class HasSpec:
    """Mixin with the spec of an environment from ``gymnasium.make`` or ``gymnasium.make_vec``."""

    core: Core
    """Batch of data centers that the environment wraps."""
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec: constructor arguments as plain values, and the episode length.

        The spec is None if the environment was created without a Gymnasium id. ``gymnasium.make``
        or ``make_vec`` creates the same environment from the spec or from
        ``EnvSpec.from_json(spec.to_json())``. Three kinds of arguments have no plain form and stay
        objects: recorders other than paths, functions that cannot be imported, and controllers.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec = copy(spec)
            spec.kwargs = _plain_arguments(spec.kwargs)
            spec.max_episode_steps = self.core.steps
        self._spec = spec


def check_steps(max_steps: Any, core: Core) -> int:
    """Return the number of steps of an episode under Gymnasium's argument ``max_episode_steps``.

    Args:
        max_steps: value of ``max_episode_steps``; None and -1 mean no limit.
        core: batch of data centers.

    Raises:
        ConfigError: ``max_steps`` is not an integer, or exceeds the length of an episode.
    """
    if max_steps is None or (max_steps == -1 and not isinstance(max_steps, bool)):
        return core.steps
    whole = isinstance(max_steps, int | np.integer) and not isinstance(max_steps, bool)
    if not whole or not 1 <= max_steps <= core.steps:
        raise ConfigError(
            f"max_episode_steps {max_steps!r}: valid is 1..{core.steps}, of which the last is an "
            f"episode of days {core.options.days}"
        )
    return int(max_steps)


def _plain_arguments(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return constructor arguments as plain values, with fields of ``options`` as keywords."""
    values = dict(arguments)
    options = values.pop("options", None)
    if isinstance(options, EnvOptions):
        values = fields_set(options) | values
    known: dict[int, Any] = {}
    return {name: _plain(value, known) for name, value in values.items()}


def _plain(value: Any, known: dict[int, Any]) -> Any:
    """Return a value as JSON types, or the value itself if it has no such form.

    Args:
        value: any value.
        known: cache of the plain forms of Pydantic models, by ``id``. The environments of a batch
            often share one config.
    """
    if isinstance(value, BaseModel):
        if id(value) not in known:
            known[id(value)] = value.model_dump(mode="json")
        return known[id(value)]
    if isinstance(value, ForecastError):
        return _plain(asdict(value), known)
    if isinstance(value, Mapping):
        return {name: _plain(entry, known) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(entry, known) for entry in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return _path_of(value) if callable(value) else value


def _path_of(function: Callable[..., Any]) -> Any:
    """Return the import path of a function, or the function if other processes cannot import it."""
    path = import_path(function)
    module, _, name = path.partition(":")
    if module != "__main__":
        try:
            if getattr(importlib.import_module(module), name) is function:
                return path
        except (ImportError, AttributeError):
            pass
    return function
