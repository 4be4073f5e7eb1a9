"""Shared parts of the environments of all standards: reset options, infos, added methods."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sdc_taichi.envs import rendering
from sdc_taichi.envs.core import Core, Observation, Transition
from sdc_taichi.errors import ConfigError, suggestion_or_valid
from sdc_taichi.types import F32, F64

RESET_OPTIONS = ("start_day",)
"""Names that ``reset(options=...)`` takes."""


class _Env:
    """Attributes and methods that all environments have beyond their standards."""

    core: Core
    """The data centers."""
    render_mode: str | None
    """None or ``rgb_array``."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that decides how the episodes go on; picklable."""
        return self.core.state_dict()


class SingleEnv(_Env):
    """Methods that environments with one data center have beyond their standards."""

    def state(self) -> F32:
        """Shared state for centralised critics, (m,), of ``state_space``."""
        return np.asarray(self.core.state()[0])

    def reward_terms(self) -> dict[str, float]:
        """All reward terms of the last step by name, unscaled; empty before the first."""
        return as_floats(self.core.reward_terms())

    def render(self) -> rendering.Image:
        """The hall after the last step, (height, width, 3).

        Raises:
            ConfigError: made without ``render_mode``.
        """
        rendering.require_render_mode(self.render_mode)
        return rendering.frame(self.core, 0)

    def close(self) -> None:
        """Close the simulator, which is unusable afterwards."""
        self.core.close()


class BatchEnv(_Env):
    """Methods that batches of environments have beyond their standards."""

    def state(self) -> F32:
        """Shared state for centralised critics, (B, m)."""
        return self.core.state()

    def reward_terms(self) -> dict[str, F64]:
        """All reward terms of the last step by name, (B,) each, unscaled; empty before the first.

        A step that ends episodes and starts the next ones counts as the last step too.
        """
        return self.core.reward_terms()

    def render(self) -> tuple[rendering.Image, ...]:
        """The hall of each environment after the last step, (height, width, 3) each.

        Raises:
            ConfigError: made without ``render_mode``.
        """
        rendering.require_render_mode(self.render_mode)
        return tuple(rendering.frame(self.core, i) for i in range(self.core.num_envs))


class AgentSpaces:
    """Spaces by agent, as PettingZoo's environments give them."""

    observation_spaces: dict[str, spaces.Space[Any]]
    """Space of the observations of one environment, by agent."""
    action_spaces: dict[str, spaces.Space[Any]]
    """Space of the actions of one environment, by agent."""

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The space of an agent's observations in one environment.

        Raises:
            ConfigError: an agent that does not learn here.
        """
        return _space_of(agent, self.observation_spaces)

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The space of an agent's actions in one environment.

        Raises:
            ConfigError: an agent that does not learn here.
        """
        return _space_of(agent, self.action_spaces)


def _space_of(agent: str, by_agent: Mapping[str, spaces.Space[Any]]) -> spaces.Space[Any]:
    if agent not in by_agent:
        raise ConfigError(f"agent {agent!r}: does not learn here; valid: {list(by_agent)}")
    return by_agent[agent]


def start_day_option(options: Mapping[str, Any] | None, *, strict: bool = True) -> Any:
    """The first day that the ``options`` of ``reset`` ask for, None if they do not.

    Args:
        options: values by name.
        strict: whether an unknown name is an error; else it is a warning, which PettingZoo's own
            API test needs, as it passes an option of a name that no environment knows.

    Raises:
        ConfigError: an unknown option.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(f"reset options {options!r}: valid is a dict")
    given = dict(options or {})
    for name in given:
        if name not in RESET_OPTIONS:
            meant = suggestion_or_valid(name, RESET_OPTIONS)
            if strict:
                raise ConfigError(f"reset options: unknown {name!r}{meant}")
            warnings.warn(f"reset options: {name!r} is without effect{meant}", stacklevel=3)
    return given.get("start_day")


def first_info(core: Core) -> dict[str, Any]:
    """Infos of the first of a batch before the first step, as numbers and text."""
    return {name: values.tolist()[0] for name, values in core.start_info().items()}


def step_info(transition: Transition) -> dict[str, F64]:
    """Quantities of a step and the costs that are wanted, by name, (B,) each."""
    info = transition.result.per_dc()
    info.update(transition.costs)
    return info


def as_floats(quantities: Mapping[str, F64]) -> dict[str, float]:
    """Quantities, (1,) each, of a batch of one as numbers."""
    return {name: values.item() for name, values in quantities.items()}


def first_of_batch(observation: Observation) -> Observation:
    """The first observation of a batch, (n,) of (B, n)."""
    if isinstance(observation, dict):
        return {name: values[0] for name, values in observation.items()}
    return np.asarray(observation[0])
