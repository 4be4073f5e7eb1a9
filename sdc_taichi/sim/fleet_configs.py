"""Configurations of a fleet: copies of one data center over sites, with sampled values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sdc_taichi.config import DataCenterConfig, with_values
from sdc_taichi.errors import ConfigError, suggestion, whole_number

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

    Args:
        base: The data center to copy.
        count: Number of copies; None is one per site. Sites are dealt in turn.
        sites: Location names; empty keeps the location of ``base``.
        sample: Config path to ``{"uniform": [low, high]}`` or ``{"choice": [a, b, ...]}``.
        seed: Seed of the sampling; copy i draws the same values whatever ``count`` is.

    Raises:
        ConfigError: count below 1, or a sampling rule or drawn value that is not valid.
    """
    if isinstance(sites, str):
        raise ConfigError(f"sites {sites!r}: valid is a list of names")
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
        name = config.site.location.lower()
        if count > max(len(sites), 1):
            name += f"-{index:0{len(str(count - 1))}d}"
        configs.append(config.model_copy(update={"name": name}))
    return configs


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
        raise ConfigError(f"{where}: unknown kind {kind!r}; valid: uniform, choice{meant}")
    if not isinstance(values, list | tuple) or not values:
        raise ConfigError(f"{where}: {kind} needs a list, got {values!r}")
    if kind == "uniform":
        numbers = all(isinstance(v, int | float) and abs(v) < np.inf for v in values)
        numbers &= not any(isinstance(v, bool) for v in values)
        if len(values) != 2 or not numbers or not values[0] <= values[1]:
            raise ConfigError(
                f"{where}: uniform needs [low, high] with low <= high, got {values!r}"
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
