"""Statistics of controllers that ran in the same weeks; some are trained with several seeds.

A sample is an array of objective values, shape (S, W), for S trainings (seeds) and W data-center
weeks; S is 1 for a controller without training. Intervals come from a bootstrap (Efron 1979) that
resamples whole trainings, sites, years within each site, and weeks within each year. The same weeks
are drawn for all samples, so that differences are paired. Interquartile mean, probability of
improvement and performance profiles follow Agarwal et al. (2021, "Deep reinforcement
learning at the edge of the statistical precipice", NeurIPS 34).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.types import F64, I64

DRAWS = 2000
"""Default number of bootstrap resamples."""


class Interval(NamedTuple):
    """Value of a statistic and its confidence interval."""

    value: float
    """Statistic of the samples without resampling."""
    low: float
    """Lower end of the interval, in the unit of the statistic."""
    high: float
    """Upper end of the interval, in the unit of the statistic."""

    def columns(self, name: str) -> dict[str, float]:
        """Return table columns with the value and both ends of the interval.

        Args:
            name: column of the value; the ends have the columns ``NAME_low`` and ``NAME_high``.
        """
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


Statistic = Callable[..., F64]
"""Function of samples, shape (..., S, W) each, that returns an array of shape (...)."""


def bootstrap_interval(
    statistic: Statistic,
    samples: Sequence[F64],
    strata: I64,
    generator: np.random.Generator,
    *,
    paired: bool = False,
) -> Interval:
    """Return a statistic of samples with its 95 % interval by a stratified bootstrap.

    Args:
        statistic: function of the samples.
        samples: samples that share their weeks, (S, W) each; S may differ between samples.
        strata: index of site and of year of each week, (W, 2), as for ``drawn_weeks``.
        generator: random generator of the bootstrap.
        paired: True to resample the same trainings in all samples with the same S, which is needed
            if the seed of a training also determines its inputs.

    Raises:
        ConfigError: a sample and the strata have different numbers of weeks.
    """
    weeks = drawn_weeks(strata, generator, DRAWS)
    values = bootstrap_values(statistic, samples, weeks, generator, paired=paired)
    return percentile_interval(float(statistic(*samples)), values)


def bootstrap_values(
    statistic: Statistic,
    samples: Sequence[F64],
    weeks: I64,
    generator: np.random.Generator,
    *,
    paired: bool = False,
) -> F64:
    """Return the values of a statistic for bootstrap resamples of weeks and trainings.

    Args:
        statistic: function of the samples.
        samples: samples that share their weeks, (S, W) each; S may differ between samples.
        weeks: week indices of each resample, from ``drawn_weeks``, (draws, W).
        generator: random generator that draws the trainings.
        paired: True to resample the same trainings in all samples with the same S.

    Returns:
        Value of the statistic for each resample, (draws,).

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


def percentile_interval(value: float, drawn: F64) -> Interval:
    """Return the 95 % percentile interval of bootstrap values, with equal tails.

    Args:
        value: statistic of the samples without resampling.
        drawn: values of the bootstrap resamples, (draws,).
    """
    low, high = np.percentile(drawn, [2.5, 97.5])
    return Interval(value, float(low), float(high))


def change_pct(figures: F64, idle: F64) -> F64:
    """Return the change of the objective relative to idle commands, summed over all weeks, in %.

    Args:
        figures: objective of a controller, (..., S, W).
        idle: objective of idle commands, (..., 1, W).
    """
    ratio = figures.mean(axis=-2).sum(axis=-1) / idle.mean(axis=-2).sum(axis=-1)
    return np.asarray(100.0 * (ratio - 1.0))


def share_pct(figures: F64, idle: F64, achieved: F64) -> F64:
    """Return the saving of a controller as a share of the achievable saving, in %.

    Both savings are relative to idle commands and summed over all weeks.

    Args:
        figures: objective of a controller, (..., S, W).
        idle: objective of idle commands, (..., 1, W).
        achieved: objective of the optimum's achieved path, (..., 1, W).
    """
    total, base, best = (x.mean(axis=-2).sum(axis=-1) for x in (figures, idle, achieved))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(base > best, 100.0 * (base - total) / (base - best), np.nan))


def sample_mean(values: F64) -> F64:
    """Return the mean of a sample over all trainings and weeks, shape (...).

    Args:
        values: samples, (..., S, W).
    """
    return np.asarray(values.mean(axis=(-2, -1)))


def interquartile_mean(values: F64) -> F64:
    """Return the interquartile mean of a sample over all trainings and weeks, shape (...).

    A quarter of the values, rounded down, is left out at each end.

    Args:
        values: samples, (..., S, W).
    """
    flat = np.sort(values.reshape(*values.shape[:-2], -1), axis=-1)
    cut = flat.shape[-1] // 4
    return np.asarray(flat[..., cut : flat.shape[-1] - cut].mean(axis=-1))


def probability_of_improvement(figures: F64, others: F64) -> F64:
    """Return the probability, 0..1, that one controller has a lower objective than another.

    The probability is the mean over all weeks and all pairs of trainings. Equal values count half,
    as in the test of Mann and Whitney (1947).

    Args:
        figures: objective of the one controller, (..., S, W).
        others: objective of the other controller, with R trainings, (..., R, W).
    """
    mine, theirs = figures[..., :, None, :], others[..., None, :, :]
    better = (mine < theirs) + 0.5 * (mine == theirs)
    known = np.isfinite(mine) & np.isfinite(theirs)
    return np.asarray(np.where(known, better, np.nan).mean(axis=(-3, -2, -1)))


def performance_profile(scores: F64, thresholds: F64) -> F64:
    """Return the share, 0..1, of all trainings and weeks with a score above each threshold.

    Args:
        scores: scores, higher is better, (..., S, W); nan values are left out.
        thresholds: thresholds of the score, (T,).

    Returns:
        Shares, (..., T); nan if all scores are nan.
    """
    flat = scores.reshape(*scores.shape[:-2], 1, -1)
    known = np.isfinite(flat).sum(axis=-1)
    above = (flat > thresholds[:, None]).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(known > 0, above / known, np.nan))


def drawn_weeks(strata: I64, generator: np.random.Generator, draws: int) -> I64:
    """Return indices of weeks, drawn with replacement level by level, (draws, W).

    Each site is replaced by a random site, each of its years by a random year of the drawn site,
    and each of its weeks by a random week of the drawn year.

    Args:
        strata: index of site and of year of each week, (W, 2).
        generator: random generator of the bootstrap.
        draws: number of bootstrap resamples.
    """
    years, year_of_week = np.unique(strata, axis=0, return_inverse=True)
    year_of_week = year_of_week.reshape(-1)
    sites, site_of_year = np.unique(years[:, 0], return_inverse=True)
    site_of_site = np.zeros(len(sites), dtype=np.int64)
    drawn_sites = _drawn(site_of_site, site_of_site[None], generator, draws)
    drawn_years = _drawn(site_of_year, drawn_sites[:, site_of_year], generator, draws)
    return _drawn(year_of_week, drawn_years[:, year_of_week], generator, draws)


def _drawn(parents: I64, drawn: I64, generator: np.random.Generator, draws: int) -> I64:
    """Return a random child of the drawn parent of each child.

    Args:
        parents: parent of each of the C children, (C,).
        drawn: parent that is drawn in place of that of each child, (draws or 1, C).
        generator: random generator.
        draws: number of resamples.

    Returns:
        Index of a child, (draws, C).
    """
    order, counts = np.argsort(parents, kind="stable"), np.bincount(parents)
    first = np.cumsum(counts) - counts
    places = generator.random((draws, len(parents)))
    return np.asarray(order[first[drawn] + (places * counts[drawn]).astype(np.int64)])
