"""Specs of Gymnasium environments, with arguments that can be written as JSON."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import asdict
from enum import Enum
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec
from pydantic import BaseModel

from sdc_taichi.control.forecast_error import ForecastError
from sdc_taichi.envs.core import Core
from sdc_taichi.envs.options import EnvOptions
from sdc_taichi.errors import ConfigError
from sdc_taichi.user_functions import import_path


class HasSpec:
    """Has the spec that Gymnasium keeps of an environment it has made."""

    core: Core
    """The data centers."""
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """The arguments as plain values, and the length of an episode; None if made without an id.

        ``gymnasium.make``, or ``make_vec``, makes the same environment of it, or of
        ``EnvSpec.from_json(spec.to_json())``. What has no plain form stays as it is: a recorder
        other than a path, a function that cannot be imported, and a controller other than a name.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            spec = copy(spec)
            spec.kwargs = _plain_arguments(spec.kwargs)
            spec.max_episode_steps = self.core.steps
        self._spec = spec


def check_steps(given: Any, core: Core) -> int:
    """Number of steps of an episode with Gymnasium's argument ``max_episode_steps``.

    Args:
        given: the argument; None and -1 are no limit.
        core: the data centers.

    Raises:
        ConfigError: no whole number, or more steps than an episode has.
    """
    if given is None or (given == -1 and not isinstance(given, bool)):
        return core.steps
    whole = isinstance(given, int | np.integer) and not isinstance(given, bool)
    if not whole or not 1 <= given <= core.steps:
        raise ConfigError(
            f"max_episode_steps {given!r}: valid is 1..{core.steps}, of which the last is an "
            f"episode of days {core.options.days}"
        )
    return int(given)


def _plain_arguments(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of an entry point; those in ``options`` by keyword, which means the same."""
    given = dict(arguments)
    options = given.pop("options", None)
    if isinstance(options, EnvOptions):
        # Fields left at their default are not given: some are errors where they have no effect.
        given = {name: getattr(options, name) for name in options.model_fields_set} | given
    known: dict[int, Any] = {}
    return {name: _plain(value, known) for name, value in given.items()}


def _plain(value: Any, known: dict[int, Any]) -> Any:
    """A value as JSON has it, or the value itself.

    Args:
        value: any value.
        known: models by id and what became of them, since configs of a batch are often the same.
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
    """Import path of a function, or the function if none leads to it in another process."""
    path = import_path(function)
    module, _, name = path.partition(":")
    if module != "__main__":
        try:
            if getattr(importlib.import_module(module), name) is function:
                return path
        except (ImportError, AttributeError):
            pass
    return function
