"""Statistics of controllers that ran in the same weeks, some of them trained from several seeds.

A sample is an array (S, W) of figures, by S trainings and W data-center weeks; a controller that is
not trained has one training. Intervals come from a bootstrap (Efron 1979) that draws trainings
whole, and weeks within each site, the same for all samples, so that differences are paired.
Interquartile mean, probability of improvement and performance profiles are those of Agarwal et al.
(2021, "Deep reinforcement learning at the edge of the statistical precipice", NeurIPS 34).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64, I64

DRAWS = 2000
"""Number of samples that a bootstrap draws."""


class Interval(NamedTuple):
    """A statistic of samples, and an interval around it."""

    value: float
    """Statistic of the samples themselves."""
    low: float
    """Lower end of the interval, in the unit of the statistic."""
    high: float
    """Upper end of the interval, in the unit of the statistic."""

    def columns(self, name: str) -> dict[str, float]:
        """Columns of a table with the value and both ends.

        Args:
            name: column of the value; those of the ends are ``NAME_low`` and ``NAME_high``.
        """
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


Statistic = Callable[..., F64]
"""Function of samples, (..., S, W) each, that returns a number for each of the leading axes."""


def bootstrap_interval(
    statistic: Statistic,
    samples: Sequence[F64],
    strata: I64,
    generator: np.random.Generator,
    *,
    draws: int = DRAWS,
    level: float = 0.95,
    paired: bool = False,
) -> Interval:
    """A statistic of samples with its percentile interval by a stratified bootstrap.

    Args:
        statistic: function of the samples.
        samples: samples that are paired by their weeks, (S, W) each, of any S.
        strata: stratum of each week, (W,); weeks are drawn within their stratum.
        generator: draws.
        draws: number of draws.
        level: share of the draws inside the interval.
        paired: whether samples are also paired by their trainings, as when seeds decide inputs.

    Raises:
        ConfigError: a sample and the strata have different numbers of weeks.
    """
    weeks = drawn_weeks(strata, generator, draws)
    values = bootstrap_values(statistic, samples, weeks, generator, paired=paired)
    return percentile_interval(float(statistic(*samples)), values, level)


def bootstrap_values(
    statistic: Statistic,
    samples: Sequence[F64],
    weeks: I64,
    generator: np.random.Generator,
    *,
    paired: bool = False,
) -> F64:
    """Values of a statistic over bootstrap draws of weeks and of trainings.

    Args:
        statistic: function of the samples.
        samples: samples that are paired by their weeks, (S, W) each, of any S.
        weeks: numbers of the weeks of each draw, of ``drawn_weeks``, (draws, W).
        generator: source of the draws of trainings.
        paired: whether the same trainings are drawn from all samples of equal size.

    Returns:
        The values, (draws,).

    Raises:
        ConfigError: a sample has another number of weeks.
    """
    draws, width = weeks.shape
    drawn = []
    trainings: dict[int, I64] = {}
    for sample in samples:
        if sample.ndim != 2 or sample.shape[1] != width or not sample.size:
            raise ConfigError(f"sample {sample.shape}: valid is (trainings, {width} weeks)")
        size = len(sample)
        if size not in trainings or not paired:
            trainings[size] = generator.integers(size, size=(draws, size))
        drawn.append(sample[trainings[size][:, :, None], weeks[:, None, :]])
    return np.asarray(statistic(*drawn))


def percentile_interval(value: float, drawn: F64, level: float = 0.95) -> Interval:
    """The interval that holds a share of the values of a bootstrap, with equal tails.

    Args:
        value: statistic of the samples themselves.
        drawn: values of the draws, (draws,).
        level: share of the draws inside the interval.
    """
    tail = 50.0 * (1.0 - level)
    low, high = np.percentile(drawn, [tail, 100.0 - tail])
    return Interval(value, float(low), float(high))


def change_pct(figures: F64, idle: F64) -> F64:
    """Change of the sum over all weeks against that of idle commands, in %.

    Args:
        figures: of a controller, (..., S, W).
        idle: of idle commands, (..., 1, W).
    """
    ratio = figures.mean(axis=-2).sum(axis=-1) / idle.mean(axis=-2).sum(axis=-1)
    return np.asarray(100.0 * (ratio - 1.0))


def share_pct(figures: F64, idle: F64, achieved: F64) -> F64:
    """Share of the achievable over all weeks together, in %.

    Args:
        figures: of a controller, (..., S, W).
        idle: of idle commands, (..., 1, W).
        achieved: of the optimum's achieved path, (..., 1, W).
    """
    total, base, best = (x.mean(axis=-2).sum(axis=-1) for x in (figures, idle, achieved))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(base > best, 100.0 * (base - total) / (base - best), np.nan))


def sample_mean(values: F64) -> F64:
    """Mean of all values of a sample, trainings and weeks alike.

    Args:
        values: (..., S, W).
    """
    return np.asarray(values.mean(axis=(-2, -1)))


def interquartile_mean(values: F64) -> F64:
    """Mean of the middle half of a sample's values, trainings and weeks alike.

    A quarter of them, rounded down, is left out at each end.

    Args:
        values: (..., S, W).
    """
    flat = np.sort(values.reshape(*values.shape[:-2], -1), axis=-1)
    cut = flat.shape[-1] // 4
    return np.asarray(flat[..., cut : flat.shape[-1] - cut].mean(axis=-1))


def probability_of_improvement(figures: F64, others: F64) -> F64:
    """Probability that a training has the lower figure in a week, mean over the weeks, 0..1.

    Equal figures count half, as in the test of Mann and Whitney (1947).

    Args:
        figures: of a controller, (..., S, W).
        others: of another controller, (..., R, W).
    """
    mine, theirs = figures[..., :, None, :], others[..., None, :, :]
    better = (mine < theirs) + 0.5 * (mine == theirs)
    known = np.isfinite(mine) & np.isfinite(theirs)
    return np.asarray(np.where(known, better, np.nan).mean(axis=(-3, -2, -1)))


def performance_profile(scores: F64, thresholds: F64) -> F64:
    """Share of all trainings and weeks whose score is above each of several thresholds, 0..1.

    Args:
        scores: more is better, (..., S, W); nan is left out.
        thresholds: of the score, (T,).

    Returns:
        Shares, (..., T); nan where no score is known.
    """
    flat = scores.reshape(*scores.shape[:-2], 1, -1)
    known = np.isfinite(flat).sum(axis=-1)
    above = (flat > thresholds[:, None]).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(known > 0, above / known, np.nan))


def drawn_weeks(strata: I64, generator: np.random.Generator, draws: int = DRAWS) -> I64:
    """Numbers of weeks, drawn with replacement within each stratum, (draws, W).

    Args:
        strata: stratum of each week, (W,).
        generator: draws.
        draws: number of draws.
    """
    weeks = np.empty((draws, len(strata)), dtype=np.int64)
    for stratum in np.unique(strata):
        numbers = np.flatnonzero(strata == stratum)
        weeks[:, numbers] = generator.choice(numbers, size=(draws, len(numbers)))
    return weeks
