"""Entries of the observation vectors of the released SustainDC.

Source: the main branch of github.com/HewlettPackard/dc-rl at a92b475 (``sustaindc_env.py``,
``utils/managers.py``, ``envs/carbon_ls.py``).

Carbon intensity and dry bulb are scaled by their minimum and maximum over the 30 days from the
first step. That looks at the future, which is why these vectors are not the default. Windows count
steps, so they cover the stated hours at the 15 minutes of the released code alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sdc_taichi.envs.features import AGE_EDGES_H, Feature
from sdc_taichi.types import F32

CI_STEPS = 8
"""Steps of carbon intensity ahead (``sustaindc_env.py``)."""
TEMPERATURE_STEPS = 16
"""Steps of dry bulb ahead (``sustaindc_env.py``)."""
PAST_STEPS = 16
"""Steps of carbon intensity back (``sustaindc_env.py``)."""
Z_SCORE_EPSILON = 1e-8
"""Added to the standard deviation below the z-score, in scaled units (``sustaindc_env.py``)."""

_SCALED_LIMIT = 10.0
"""Limit of scaled inputs, which are 0..1 in the first 30 days and may exceed that afterwards."""
_Z_SCORE_LIMIT = 1.0 / Z_SCORE_EPSILON
"""Limit of z-scores, which are as large where the window is flat."""
_AGE_LIMIT_DAYS = 400.0
"""Limit of ages in days; the longest ``workload.age_horizon_h`` is 365 days."""


def _scaled(name: str, description: str) -> Feature:
    """An input over its range."""
    return Feature(name, "scaled", -_SCALED_LIMIT, _SCALED_LIMIT, description)


def _slope(name: str, description: str) -> Feature:
    """A trend of a scaled input."""
    return Feature(name, "scaled/step", -_SCALED_LIMIT, _SCALED_LIMIT, description)


def _share(name: str, description: str, unit: str = "-") -> Feature:
    """A value of 0..1."""
    return Feature(name, unit, 0.0, 1.0, description)


def _age(name: str, description: str) -> Feature:
    """An age of queued tasks."""
    return Feature(name, "d", 0.0, _AGE_LIMIT_DAYS, description)


def _window(name: str, what: str, steps: int) -> tuple[Feature, ...]:
    """Entries about the coming steps of an input."""
    return (
        _scaled(f"{name}_mean_next", f"mean {what} of the next {steps} steps"),
        Feature(
            f"{name}_std_next",
            "scaled",
            0.0,
            _SCALED_LIMIT,
            f"standard deviation of the {what} of the next {steps} steps",
        ),
        Feature(
            f"{name}_z_score",
            "-",
            -_Z_SCORE_LIMIT,
            _Z_SCORE_LIMIT,
            f"{what} less its mean over the next {steps} steps, in standard deviations of these",
        ),
        _share(
            f"{name}_steps_to_peak", f"steps to the next peak over {steps}; 1 without", "window"
        ),
        _share(
            f"{name}_steps_to_valley", f"steps to the next valley over {steps}; 1 without", "window"
        ),
    )


def _age_bins() -> tuple[Feature, ...]:
    """Entries of the age histogram."""
    edges = [f"{edge:g}" for edge in AGE_EDGES_H]
    closed = tuple(
        _share(f"queue_{low}_{high}h", f"share of the queued tasks aged {low} h to {high} h")
        for low, high in pairwise(edges)
    )
    return (*closed, _share(f"queue_{edges[-1]}h", f"1 with a task aged {edges[-1]} h or more"))


_CI, _DRY_BULB = "carbon intensity", "dry bulb"
_OF_ALL_AGENTS = (
    _share("time_cos", "0.5 + 0.5 cos of the time of day, which is rounded to a thousandth of it"),
    _share("time_sin", "0.5 + 0.5 sin of the time of day, which is rounded to a thousandth of it"),
    _scaled("ci", f"{_CI} of the step to come"),
    _slope("ci_slope_next", f"trend of the {_CI} over this and the next {CI_STEPS} steps"),
    _slope("ci_slope_past", f"trend of the {_CI} over the last {PAST_STEPS} steps and this one"),
    *_window("ci", _CI, CI_STEPS),
)
_WORKLOAD = _share("workload", "work that arrives in the step to come, as a share of capacity")
_OUTDOOR = _scaled("outdoor", f"{_DRY_BULB} of the step to come")
_AGES = (
    _age("oldest_age", "age of the oldest queued task"),
    _age("mean_age", "mean age of the queued tasks"),
    _share("queue", "queued tasks over the longest queue; 0 where it has no limit"),
)
_OUTDOOR_AHEAD = (
    _slope(
        "outdoor_slope_next",
        f"trend of the {_DRY_BULB} over this and the next {TEMPERATURE_STEPS} steps",
    ),
    *_window("outdoor", _DRY_BULB, TEMPERATURE_STEPS),
)
_WORKLOAD_NEXT = _share("workload_next", "work that arrives one step later, as a share of capacity")
_OUTDOOR_NEXT = _scaled("outdoor_next", f"{_DRY_BULB} one step later")
_SOC = _share("soc", "state of charge of the battery")

FEATURES: dict[str, tuple[Feature, ...]] = {
    "agent_ls": (*_OF_ALL_AGENTS, *_AGES, _WORKLOAD, _OUTDOOR, *_OUTDOOR_AHEAD, *_age_bins()),
    "agent_dc": (*_OF_ALL_AGENTS, _WORKLOAD, _WORKLOAD_NEXT, _OUTDOOR, _OUTDOOR_NEXT),
    "agent_bat": (*_OF_ALL_AGENTS, _WORKLOAD, _OUTDOOR, _SOC),
}
"""Entries of each agent's vector in order; ranges are those of the values as observed.

The unit ``scaled`` is the input less its minimum over the 30 days from the first step, over the
range of these days.
"""

TIME_FEATURES = (
    *_OF_ALL_AGENTS,
    _WORKLOAD,
    _OUTDOOR,
    *_OUTDOOR_AHEAD,
    _WORKLOAD_NEXT,
    _OUTDOOR_NEXT,
)
"""Entries that depend on time and the first step alone, in the order of the rows of
``released_rows``."""
MEASURED_FEATURES = (*_AGES, *_age_bins(), _SOC)
"""Entries of queue and battery, in the order of ``ReleasedObserver``."""
ENTRY_NUMBERS = {f.name: i for i, f in enumerate((*TIME_FEATURES, *MEASURED_FEATURES))}
"""Number of each entry among all time entries and, after them, all measured entries, by name."""


def ranges(features: Sequence[Feature]) -> tuple[F32, F32]:
    """Lowest and highest value of each entry, (n,) each."""
    low, high = ([getattr(f, side) for f in features] for side in ("low", "high"))
    return np.array(low, dtype=np.float32), np.array(high, dtype=np.float32)


def cut(values: F32, low: F32, high: F32) -> F32:
    """Cut values at bounds, in place; bounds are arrays, which NumPy cuts at faster."""
    np.minimum(values, high, out=values)
    return np.maximum(values, low, out=values)
