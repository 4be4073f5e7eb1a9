"""What the environment standards share: reset options and infos."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from sdc_taichi.envs.core import Core, Observation
from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64, I64

RESET_OPTIONS = ("start_day",)


def start_day(options: Mapping[str, Any] | None, *, strict: bool = True) -> Any:
    """What ``options`` of ``reset`` say about the first day, None if nothing.

    Args:
        options: by name.
        strict: whether an unknown name is an error; else it is a warning, which PettingZoo's own
            API test needs, as it passes an option of a name that no environment knows.

    Raises:
        ConfigError: an unknown option.
    """
    given = dict(options or {})
    for name in given:
        if name not in RESET_OPTIONS:
            near = difflib.get_close_matches(str(name), RESET_OPTIONS, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"valid: {', '.join(RESET_OPTIONS)}"
            if strict:
                raise ConfigError(f"reset options: unknown {name!r}; {hint}")
            warnings.warn(f"reset options: {name!r} is without effect; {hint}", stacklevel=3)
    return given.get("start_day")


def start_days(core: Core) -> I64:
    """First day of the episode of each environment, counted from 0 in the year, (B,)."""
    view = core.view
    return np.asarray(view.state.start // (24 * view.fleet.steps_per_hour), dtype=np.int64)


def floats(quantities: Mapping[str, F64]) -> dict[str, float]:
    """Quantities of a batch of one."""
    return {name: float(values[0]) for name, values in quantities.items()}


def first(observation: Observation) -> Observation:
    """The observation of a batch of one."""
    if isinstance(observation, dict):
        return {name: values[0] for name, values in observation.items()}
    return np.asarray(observation[0])
