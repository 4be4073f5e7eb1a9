"""Configurations of a fleet: copies of one data center over sites, with sampled values."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig, with_values
from sdc_taichi.errors import ConfigError, DataError, shortened, suggestion, whole_number
from sdc_taichi.exogenous.weather import read_city

MOST_DCS = 10_000_000
"""Most data centers of a fleet, more than any memory holds."""


def make_configs(
    base: DataCenterConfig,
    *,
    count: int | None = None,
    sites: Sequence[str] = (),
    sample: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> list[DataCenterConfig]:
    """Copies of one data center over sites, with domain randomisation.

    A copy is named after its site, or else after its place, see ``locations``; where there are more
    copies than sites, its number is added.

    Args:
        base: The data center to copy.
        count: Number of copies; None is one per site. Sites are dealt in turn.
        sites: Location names; empty keeps the location of ``base``.
        sample: Config path to ``{"uniform": [low, high]}`` or ``{"choice": [a, b, ...]}``.
        seed: Seed of the sampling; copy i draws the same values whatever ``count`` is.

    Raises:
        ConfigError: count below 1, sites beside a weather or carbon file that would be read for
            each of them, or a sampling rule or drawn value that is not valid.
    """
    if isinstance(sites, str):
        raise ConfigError(f"sites {shortened(sites)}: valid is a list of names")
    for field in ("weather_file", "carbon_file"):
        if sites and (file := getattr(base.site, field)) is not None:
            raise ConfigError(
                f"sites {', '.join(sites)}: site.{field} {file!r} of {base.name} would be read for "
                "each of them; valid is one of the two"
            )
    count = max(len(sites), 1) if count is None else count
    count = whole_number("fleet: count", count, 1, MOST_DCS)
    seed = whole_number("fleet: seed", seed, 0, 2**63 - 1)
    if count < len(sites):
        raise ConfigError(
            f"fleet: {count} data centers for {len(sites)} sites; valid is at least one per site"
        )
    rules = dict(sample or {})
    for path, rule in rules.items():
        _check_rule(base, path, rule)
    configs = []
    for index in range(count):
        config = base
        if sites:
            site = base.site.model_copy(update={"location": sites[index % len(sites)].upper()})
            config = config.model_copy(update={"site": site})
        if rules:
            rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, index])))
            config = with_values(config, {path: _draw(rule, rng) for path, rule in rules.items()})
        configs.append(config)
    digits = len(str(count - 1)) if count > max(len(sites), 1) else 0
    return [
        config.model_copy(update={"name": f"{name}-{index:0{digits}d}" if digits else name})
        for index, (config, name) in enumerate(zip(configs, place_names(configs), strict=True))
    ]


def locations(configs: Sequence[DataCenterConfig]) -> list[str]:
    """Where data centers stand: ``site.location``, or the city of the weather file in its place.

    A weather file without a city, or one that cannot be read, is named by its stem.
    """
    cities: dict[str, str] = {}
    places = []
    for config in configs:
        file = config.site.weather_file
        if file is not None and file not in cities:
            cities[file] = _city(file)
        places.append(config.site.location if file is None else cities[file])
    return places


def place_names(configs: Sequence[DataCenterConfig]) -> list[str]:
    """Locations as names: lower case, with ``-`` for all but letters, digits, ``_`` and ``-``."""
    names = (re.sub(r"[^\w-]+", "-", place.lower()).strip("-") for place in locations(configs))
    return [name or "unnamed" for name in names]


def _city(weather_file: str) -> str:
    with contextlib.suppress(DataError):
        if city := read_city(weather_file):
            return city
    return Path(weather_file).stem


def _check_rule(base: DataCenterConfig, path: str, rule: Any) -> None:
    """Make sure that a sampling rule is one, and that its first value suits the config.

    Raises:
        ConfigError: naming the path and what is valid.
    """
    where = f"sample {path}"
    if not isinstance(rule, Mapping) or len(rule) != 1:
        raise ConfigError(f"{where}: valid is {{uniform: [low, high]}} or {{choice: [a, b, ...]}}")
    ((kind, values),) = rule.items()
    if kind not in ("uniform", "choice"):
        meant = suggestion(kind, ("uniform", "choice"), " (did you mean {!r}?)")
        raise ConfigError(f"{where}: unknown kind {shortened(kind)}; valid: uniform, choice{meant}")
    if not isinstance(values, list | tuple) or not values:
        raise ConfigError(f"{where}: {kind} needs a list, got {shortened(values)}")
    if kind == "uniform":
        numbers = all(isinstance(v, int | float) and abs(v) < np.inf for v in values)
        numbers &= not any(isinstance(v, bool) for v in values)
        if len(values) != 2 or not numbers or not values[0] <= values[1]:
            raise ConfigError(
                f"{where}: uniform needs [low, high] with low <= high, got {shortened(values)}"
            )
    with_values(base, {path: values[0]})


def _draw(rule: Mapping[str, Any], rng: np.random.Generator) -> Any:
    """A value by a sampling rule; whole numbers where both ends of ``uniform`` are."""
    ((kind, values),) = rule.items()
    if kind == "choice":
        return values[int(rng.integers(len(values)))]
    low, high = values
    if isinstance(low, int) and isinstance(high, int):
        return int(rng.integers(low, high + 1))
    return float(rng.uniform(low, high))
