"""Features: the named entries of observations, with ranges that no data and no result changes.

A value v is scaled to ``(v - low) / (high - low)``, 0..1, or, where the range lies evenly about
zero, to ``v / high``, -1..1. Values beyond the range are cut at it. Nothing looks ahead but the
demand of the step to come and the forecasts.

Add a feature here: its range in ``time_features`` or ``measured_features``, its computation in the
method of ``observer`` for the same kind, and its row in docs/observations.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from sdc_taichi.envs.agents import AGENTS
from sdc_taichi.envs.forecasts import CI_LEADS_H, WEATHER_LEADS_H
from sdc_taichi.errors import ConfigError, suggestion_or_valid
from sdc_taichi.types import F32


@dataclass(frozen=True, slots=True)
class Feature:
    """A named entry of an observation, or several of one kind side by side."""

    name: str
    """Name by which the option ``features`` chooses it."""
    unit: str
    """Unit of the value before scaling."""
    low: float
    """Lower end of the range, in ``unit``; lower values are cut at it."""
    high: float
    """Upper end of the range, in ``unit``; higher values are cut at it."""
    description: str
    """Meaning of the value, for the docs."""
    size: int = 1
    """Number of entries side by side."""

    @property
    def signed(self) -> bool:
        """Whether the range lies evenly about zero, so that values are scaled to -1..1."""
        return self.low == -self.high


AGE_EDGES_H = (0.0, 6.0, 12.0, 18.0, 24.0)
"""Lower edges of the age bins in hours, those of the released code (``carbon_ls.py``); the last bin
is open."""
UNLIMITED_QUEUE_H = 10.0
"""Hours of full work that count as a full queue where the queue has no limit."""

_CLOCK = ("time_of_day", "time_of_year")
_CI = ("ci", "ci_forecast")
_WEATHER = ("outdoor", "outdoor_forecast", "wet_bulb", "wet_bulb_forecast")
DEFAULT_FEATURES: dict[str, tuple[str, ...]] = {
    "agent_ls": (
        *_CLOCK,
        "workload",
        "queue",
        "oldest_age",
        "mean_age",
        "age_histogram",
        *_CI,
        "ci_change",
        "outdoor",
        "outdoor_forecast",
        "soc",
    ),
    "agent_dc": (
        *_CLOCK,
        "workload",
        *_CI,
        *_WEATHER,
        "room",
        "hottest_inlet",
        "setpoint",
        "it_energy",
        "hvac_energy",
    ),
    "agent_bat": (*_CLOCK, *_CI, "ci_change", "dc_load", "soc"),
}
"""Features that each agent observes by default.

They are the paper's lists (A.1.2, A.2.4, A.3.3) with ages of the queue and weather for the load
agent, the work to come for the cooling agent, and the change of the carbon intensity.
"""

FEATURE_OF_COMMAND = {"fan": "fan_speed", "placement": "rack_inlets"}
"""Feature that an agent observes by default because it decides a command."""


def time_features(
    ci_leads_h: Sequence[float] = CI_LEADS_H, weather_leads_h: Sequence[float] = WEATHER_LEADS_H
) -> tuple[Feature, ...]:
    """Features that depend on time alone: clock, carbon intensity, weather, work and price.

    Args:
        ci_leads_h: leads of the forecasts of carbon intensity and price, in h.
        weather_leads_h: leads of the weather forecasts, in h.
    """
    ci, weather = (", ".join(f"{h:g}" for h in leads) for leads in (ci_leads_h, weather_leads_h))
    n, k = len(ci_leads_h), len(weather_leads_h)
    features = (
        Feature("time_of_day", "1", -1.0, 1.0, "sine and cosine of the local time", 2),
        Feature("time_of_year", "1", -1.0, 1.0, "sine and cosine of the share of the year", 2),
        Feature("ci", "g/kWh", 0.0, 1000.0, "carbon intensity of the step to come"),
        Feature("ci_forecast", "g/kWh", 0.0, 1000.0, f"CI in {ci} h", n),
        Feature("ci_change", "g/kWh", -300.0, 300.0, f"CI in {ci} h less `ci`", n),
        Feature("ci_rank", "share", 0.0, 1.0, f"of the CI in {ci} h that is below `ci`", min(n, 1)),
        Feature(
            "ci_relative",
            "share",
            0.0,
            1.0,
            f"`ci` and CI in {ci} h between the lowest and the highest of them",
            n + 1 if n else 0,
        ),
        Feature("ci_swing", "1", 0.0, 2.0, f"range of `ci` and CI in {ci} h over `ci`", min(n, 1)),
        Feature("outdoor", "C", -30.0, 50.0, "dry bulb of the step to come"),
        Feature("outdoor_forecast", "C", -30.0, 50.0, f"dry bulb in {weather} h", k),
        Feature("wet_bulb", "C", -30.0, 40.0, "wet bulb of the step to come"),
        Feature("wet_bulb_forecast", "C", -30.0, 40.0, f"wet bulb in {weather} h", k),
        Feature("workload", "share", 0.0, 1.0, "work that arrives in the step to come"),
        Feature("price", "1", 0.0, 3.0, "price of the step to come over its mean"),
        Feature("price_forecast", "1", 0.0, 3.0, f"price in {ci} h over its mean", n),
    )
    return tuple(feature for feature in features if feature.size)


def measured_features(units: int = 1, fans: int = 0, racks: int = 0) -> tuple[Feature, ...]:
    """Features measured in the data center: queue, hall and battery.

    Args:
        units: number of CRAC units whose setpoints stand side by side.
        fans: number of CRAC fans whose speeds are decided; 0 if none are.
        racks: number of racks that work is placed on by agents; 0 if it is not.
    """
    bins = [f"{a:g}-{b:g}" for a, b in pairwise(AGE_EDGES_H)]
    ages = f"{', '.join(bins)}, over {AGE_EDGES_H[-1]:g} h"
    limit = f"`workload.queue_limit_h`, or {UNLIMITED_QUEUE_H:g} h of full work where there is none"
    setpoint = "of the CRAC unit, mean of several" if units == 1 else "of each CRAC unit"
    features = (
        Feature("queue", "share", 0.0, 1.0, f"queued work over {limit}"),
        Feature("oldest_age", "h", 0.0, 24.0, "age of the oldest queued work"),
        Feature("mean_age", "h", 0.0, 24.0, "mean age of queued work"),
        Feature("age_histogram", "share", 0.0, 1.0, f"of the queue by age: {ages}", 5),
        Feature("room", "C", 10.0, 60.0, "return air of the last step"),
        Feature("hottest_inlet", "C", 10.0, 50.0, "hottest server inlet of the last step"),
        Feature("setpoint", "C", 10.0, 30.0, f"supply setpoint {setpoint}", units),
        Feature("it_energy", "share", 0.0, 1.2, "IT energy of the last step over design"),
        Feature("hvac_energy", "share", 0.0, 1.2, "HVAC energy of the last step over design"),
        Feature("dc_load", "share", 0.0, 1.2, "facility power of the last step over design"),
        Feature("soc", "share", 0.0, 1.0, "state of charge; 0 without a battery"),
        Feature("fan_speed", "share", 0.0, 1.0, "speed of each CRAC fan over design", fans),
        Feature("rack_inlets", "C", 10.0, 50.0, "hottest inlet of each rack, last step", racks),
    )
    return tuple(feature for feature in features if feature.size)


def all_features(
    ci_leads_h: Sequence[float] = CI_LEADS_H,
    weather_leads_h: Sequence[float] = WEATHER_LEADS_H,
    units: int = 1,
    fans: int = 0,
    racks: int = 0,
) -> tuple[Feature, ...]:
    """All features in the order of the shared state.

    Args:
        ci_leads_h: leads of the forecasts of carbon intensity and price, in h.
        weather_leads_h: leads of the weather forecasts, in h.
        units: number of CRAC units whose setpoints stand side by side.
        fans: number of CRAC fans whose speeds are decided; 0 if none are.
        racks: number of racks that work is placed on by agents; 0 if it is not.
    """
    return (*time_features(ci_leads_h, weather_leads_h), *measured_features(units, fans, racks))


def features_by_agent(
    chosen: Mapping[str, Sequence[str]] | None,
    known: Sequence[Feature],
    commands: Mapping[str, Sequence[str]] | None = None,
) -> dict[str, tuple[Feature, ...]]:
    """Features of every agent; agents that are not mentioned have ``DEFAULT_FEATURES``.

    By default, an agent also observes what the commands that it decides act on.

    Args:
        chosen: names of features by agent; None changes nothing.
        known: the features that there are.
        commands: commands that agents decide, by agent; None is the default ones.

    Raises:
        ConfigError: an unknown agent or feature, a feature named twice, or no feature.
    """
    given = dict(chosen or {})
    for agent in given:
        if agent not in AGENTS:
            raise ConfigError(
                f"features: unknown agent {agent!r}{suggestion_or_valid(agent, AGENTS)}"
            )
    by_name = {feature.name: feature for feature in known}
    out: dict[str, tuple[Feature, ...]] = {}
    for agent in AGENTS:
        acted_on = [FEATURE_OF_COMMAND.get(name, "") for name in (commands or {}).get(agent, ())]
        default = [n for n in (*DEFAULT_FEATURES[agent], *acted_on) if n in by_name]
        names = given.get(agent, default)
        if isinstance(names, str) or not names:
            raise ConfigError(f"features of {agent}: {names!r}; valid is a list of names")
        for name in names:
            if name not in by_name:
                raise ConfigError(
                    f"features of {agent}: unknown {name!r}{suggestion_or_valid(name, by_name)}"
                )
        twice = next((name for name in names if list(names).count(name) > 1), None)
        if twice is not None:
            raise ConfigError(f"features of {agent}: {twice!r} is named twice")
        out[agent] = tuple(by_name[name] for name in names)
    return out


def features_space(features: Sequence[Feature]) -> Box:
    """Space of an observation made of scaled ``features`` side by side, (n,)."""
    low = np.concatenate([np.full(f.size, -1.0 if f.signed else 0.0) for f in features])
    return Box(low.astype(np.float32), np.ones(len(low), dtype=np.float32), dtype=np.float32)


def scale(values: F32, feature: Feature) -> F32:
    """Values in the unit of ``feature``, of any shape, scaled to its range and cut at it."""
    if feature.signed:
        return np.asarray(np.clip(values / feature.high, -1.0, 1.0))
    return np.asarray(np.clip((values - feature.low) / (feature.high - feature.low), 0.0, 1.0))


def feature_slices(features: Sequence[Feature]) -> dict[str, slice]:
    """Entries of each feature, by name, where ``features`` stand side by side."""
    ends = np.cumsum([0, *(f.size for f in features)]).tolist()
    return {f.name: slice(first, first + f.size) for f, first in zip(features, ends, strict=False)}


class _Sized(Protocol):
    """A named part of an observation; equal parts are one feature."""

    @property
    def size(self) -> int:
        """Number of entries side by side."""


def entries_of_new_features(
    features_of: Mapping[str, Sequence[_Sized]],
) -> dict[str, npt.NDArray[np.int64] | slice]:
    """Entries of each agent's observation whose features no agent before it has.

    Args:
        features_of: features of each agent, in the order of its observation.
    """
    known: set[Any] = set()
    out: dict[str, npt.NDArray[np.int64] | slice] = {}
    for agent, features in features_of.items():
        new = np.repeat([f not in known for f in features], [f.size for f in features])
        entries = np.flatnonzero(new)
        # A slice needs no copy.
        contiguous = len(entries) > 0 and entries[-1] - entries[0] == len(entries) - 1
        out[agent] = slice(int(entries[0]), int(entries[-1]) + 1) if contiguous else entries
        known.update(features)
    return out


def features_markdown() -> str:
    """The table of features in docs/observations.md; a dot marks who observes what by default."""
    lines = [
        "| feature | entries | what it is | unit | range | load | cooling | battery |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for f in all_features():
        seen = [" " if f.name not in DEFAULT_FEATURES[agent] else "●" for agent in AGENTS]
        cells = (f"`{f.name}`", str(f.size), f.description, f.unit, f"{f.low:g}..{f.high:g}", *seen)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"
