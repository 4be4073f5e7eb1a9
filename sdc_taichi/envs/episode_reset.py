"""Seeds and first days of episodes, as ``reset`` is given them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.exogenous.year_clock import DAYS_PER_YEAR, day_of_year
from sdc_taichi.types import I64

Seed = int | Sequence[int | None] | I64 | None
"""Seed of environment 0, to which environment i adds i; or one for each environment, of which None
goes on with the generator that is there; or None for all."""


def seeded_generators(
    seed: Seed, present: Sequence[np.random.Generator], num_envs: int
) -> list[np.random.Generator]:
    """A generator for each environment, by its seed or the present one.

    Args:
        seed: environment i takes ``seed + i``, or entry i.
        present: generators of the episode before; none before the first.
        num_envs: number of environments.

    Raises:
        ConfigError: a seed that is not valid, or another number of them than of environments.
    """
    if seed is None and present:
        return list(present)
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1, np.uint32)[0])
    if isinstance(seed, np.ndarray) and seed.ndim == 0:
        seed = seed[()]
    if isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str):
        seeds: list[Any] = list(seed)
    else:
        seeds = [_checked_seed(seed) + i for i in range(num_envs)]
    if len(seeds) != num_envs:
        raise ConfigError(f"seed: {len(seeds)} for {num_envs} environments")
    before: list[np.random.Generator | None] = [*present] or [None] * num_envs
    return [
        (rng or np.random.default_rng())
        if one is None
        else np.random.Generator(np.random.PCG64(_checked_seed(one)))
        for one, rng in zip(seeds, before, strict=True)
    ]


def chosen_start_days(given: Any, num_envs: int) -> I64:
    """First day of each episode, counted from 0 in the year, (B,).

    Args:
        given: a day as ``MM-DD`` or counted from 0, or one for each environment.
        num_envs: number of environments.

    Raises:
        ConfigError: a day that is not valid, or another number of them than of environments.
    """
    if isinstance(given, np.ndarray) and given.ndim == 0:
        given = given[()]
    several = isinstance(given, list | tuple | np.ndarray)
    days = np.array([_checked_day(day) for day in (given if several else [given])], dtype=np.int64)
    if len(days) not in (1, num_envs):
        raise ConfigError(f"start_day: {len(days)} days for {num_envs} environments")
    return np.broadcast_to(days, (num_envs,))


def _checked_seed(seed: Any) -> int:
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or not 0 <= seed < 2**63:
        raise ConfigError(f"seed {seed!r}: valid is an integer of 0..2**63 - 1")
    return int(seed)


def _checked_day(day: Any) -> int:
    """Day of the year, 0..364."""
    if isinstance(day, int | np.integer) and not isinstance(day, bool):
        if 0 <= day < DAYS_PER_YEAR:
            return int(day)
    elif isinstance(day, str):
        try:
            return day_of_year(day)
        except ValueError:
            pass
    raise ConfigError(f"start_day {day!r}: valid is MM-DD or a day of the year, 0..364")
