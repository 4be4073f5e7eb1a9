"""Configurations of a fleet: copies of one data center at several sites, with sampled values."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig, preset_names, with_values
from sdc_taichi.errors import ConfigError, DataError, shortened, suggestion, whole_number
from sdc_taichi.exogenous.weather import read_city

MOST_DCS = 10_000_000
"""Maximum number of data centers of a fleet, more than fit into any memory."""


def make_configs(
    base: DataCenterConfig,
    *,
    count: int | None = None,
    sites: Sequence[str] = (),
    sample: Mapping[str, Any] | None = None,
    seed: int = 0,
) -> list[DataCenterConfig]:
    """Create copies of one data center at several sites, with domain randomisation.

    Copies at ``sites``, and those of a preset, are named after their location (see
    ``locations``); other copies keep the name of ``base``. If there are more copies than sites, a
    name ends in the index of the copy. If ``base`` describes a fleet that shares work, each copy
    is a whole fleet, with one data center per site of ``fleet.sites``.

    Args:
        base: Config of the data center or fleet to copy.
        count: Number of copies, which are assigned to the sites in rotation; None makes one copy
            per site.
        sites: Location names; an empty sequence keeps the location of ``base``.
        sample: Sampling rule by config path: ``{"uniform": [low, high]}`` or
            ``{"choice": [a, b, ...]}``.
        seed: Seed of the sampling; the values of copy i do not depend on ``count``.

    Raises:
        ConfigError: ``count`` is below 1, ``sites`` are combined with a weather or carbon file of
            ``base`` or with its fleet, or a sampling rule or a sampled value is not valid.
    """
    if isinstance(sites, str):
        raise ConfigError(f"sites {shortened(sites)}: valid is a list of names")
    if sites and base.fleet is not None:
        raise ConfigError(
            f"sites {', '.join(sites)}: {base.name} has fleet.sites; valid is one of the two"
        )
    _check_files(base, sites)
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
    copies = with_sites(configs)
    is_named = sites or len(copies) > len(configs)
    names = place_names(copies) if is_named else names_of_runs(copies)
    digits = len(str(count - 1)) if count > max(len(sites), 1) else 0
    per_copy = len(copies) // count
    return [
        config.model_copy(
            update={"name": f"{name}-{index // per_copy:0{digits}d}" if digits else name}
        )
        for index, (config, name) in enumerate(zip(copies, names, strict=True))
    ]


def with_sites(configs: Iterable[DataCenterConfig]) -> list[DataCenterConfig]:
    """Replace each config of a whole fleet by those of its sites, named after their locations.

    Other configs stay as they are.

    Raises:
        ConfigError: A config of a fleet names a weather or carbon file.
    """
    expanded: list[DataCenterConfig] = []
    sites_of: dict[int, list[DataCenterConfig]] = {}
    for config in configs:
        if config.fleet is None or config.fleet.place is not None:
            expanded.append(config)
            continue
        if id(config) not in sites_of:
            sites_of[id(config)] = _configs_of_sites(config)
        expanded += sites_of[id(config)]
    return expanded


def _configs_of_sites(config: DataCenterConfig) -> list[DataCenterConfig]:
    assert config.fleet is not None
    _check_files(config, config.fleet.sites)
    copies = []
    for place, name in enumerate(config.fleet.sites):
        update = {
            "site": config.site.model_copy(update={"location": name.upper()}),
            "fleet": config.fleet.model_copy(update={"place": place}),
        }
        copies.append(config.model_copy(update=update))
    names = place_names(copies)
    return [
        copy.model_copy(update={"name": name}) for copy, name in zip(copies, names, strict=True)
    ]


def _check_files(base: DataCenterConfig, sites: Sequence[str]) -> None:
    """Refuse weather and carbon files of a config that is copied to several sites."""
    for field in ("weather_file", "carbon_file"):
        if sites and (file := getattr(base.site, field)) is not None:
            raise ConfigError(
                f"sites {', '.join(sites)}: site.{field} {file!r} of {base.name} would be read for "
                "each of them; valid is one of the two"
            )


def names_of_runs(configs: Sequence[DataCenterConfig]) -> list[str]:
    """Return the names of data centers in a run: their own, or the place if it is a preset's."""
    presets = preset_names()
    places = place_names(configs)
    return [
        place if config.name in presets else config.name
        for config, place in zip(configs, places, strict=True)
    ]


def locations(configs: Sequence[DataCenterConfig]) -> list[str]:
    """Return the location of each data center: ``site.location``, or the weather file's city.

    If a weather file has no city or cannot be read, its file name without suffix is the location.
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
    """Return locations as names: lower case, with ``-`` for all but letters, digits and ``_``."""
    names = (re.sub(r"[^\w-]+", "-", place.lower()).strip("-") for place in locations(configs))
    return [name or "unnamed" for name in names]


def _city(weather_file: str) -> str:
    with contextlib.suppress(DataError):
        if city := read_city(weather_file):
            return city
    return Path(weather_file).stem


def _check_rule(base: DataCenterConfig, path: str, rule: Any) -> None:
    """Check the form of a sampling rule, and that its first value is valid in the config.

    Raises:
        ConfigError: The rule is not valid; the message names the config path and valid rules.
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
    """Draw a value by a sampling rule; ``uniform`` with two integer limits draws integers."""
    ((kind, values),) = rule.items()
    if kind == "choice":
        return values[int(rng.integers(len(values)))]
    low, high = values
    if isinstance(low, int) and isinstance(high, int):
        return int(rng.integers(low, high + 1))
    return float(rng.uniform(low, high))
