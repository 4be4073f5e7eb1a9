"""Statistics of controllers: known answers, and intervals that cover what they should."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from sdc_taichi import ConfigError
from sdc_taichi.learning.statistics import (
    bootstrap_interval,
    change_pct,
    drawn_weeks,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
    share_pct,
)
from sdc_taichi.types import F64, I64


def generator() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(0))


def mean(values: F64) -> F64:
    return np.asarray(values.mean(axis=(-2, -1)))


def test_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    values = np.array([[9.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, -70.0]])
    assert interquartile_mean(values) == 3.5
    assert interquartile_mean(values) == stats.trim_mean(values.ravel(), 0.25)
    assert interquartile_mean(np.stack([values, 2 * values])).tolist() == [3.5, 7.0]


def test_change_and_share_are_of_sums_over_weeks() -> None:
    idle, achieved = np.array([[100.0, 300.0]]), np.array([[90.0, 270.0]])
    figures = np.array([[100.0, 280.0], [90.0, 290.0]])
    assert change_pct(figures, idle) == pytest.approx(-5.0)
    assert share_pct(figures, idle, achieved) == pytest.approx(50.0)
    assert share_pct(idle, idle, achieved) == 0.0
    assert share_pct(achieved, idle, achieved) == pytest.approx(100.0)
    assert np.isnan(share_pct(figures, idle, idle))


def test_probability_of_improvement_is_the_share_of_pairs_that_are_lower() -> None:
    one, other = np.array([[1.0], [3.0]]), np.array([[2.0], [3.0]])
    assert probability_of_improvement(one, other) == (1 + 1 + 0 + 0.5) / 4
    assert probability_of_improvement(other, one) == 1 - (1 + 1 + 0 + 0.5) / 4
    better = np.array([[0.0, 0.0, 5.0, 0.0]])
    assert probability_of_improvement(better, np.ones((3, 4))) == 0.75


def test_interval_of_one_training_is_that_of_its_weeks() -> None:
    sample = generator().normal(3.0, 2.0, size=(1, 400))
    found = bootstrap_interval(mean, [sample], in_years(np.zeros(400)), generator())
    half = 1.96 * sample.std() / 20.0
    assert found.value == pytest.approx(sample.mean())
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.1)
    assert found.low < found.value < found.high


def in_years(years: Any, sites: Any = 0) -> I64:
    """Strata of weeks, of which each is in a year of a site."""
    return np.stack(np.broadcast_arrays(sites, years), axis=1).astype(np.int64)


def test_sites_years_and_weeks_are_drawn_level_by_level() -> None:
    sites, years = np.repeat([0, 1, 2], 6), np.tile(np.repeat([0, 1], 3), 3)
    drawn = drawn_weeks(in_years(years, sites), generator(), 4000)
    for at in range(0, 18, 6):
        assert len(np.unique(sites[drawn[:, at : at + 6]], axis=1)[0]) <= 6
        assert (sites[drawn[:, at : at + 6]] == sites[drawn[:, [at]]]).all()
    assert (years[drawn[:, :3]] == years[drawn[:, [0]]]).all()
    assert (years[drawn[:, 0]] != years[drawn[:, 3]]).mean() == pytest.approx(0.5, abs=0.05)
    assert np.bincount(drawn.ravel()) / drawn.size == pytest.approx(1 / 18, rel=0.1)


def test_differences_between_sites_widen_an_interval() -> None:
    weeks, sites = np.zeros((1, 200)), np.arange(200) % 20
    apart = weeks + generator().normal(size=20)[sites]
    found = bootstrap_interval(mean, [apart], in_years(0, sites), generator())
    # The spread of a mean of twenty draws, which no number of weeks makes smaller.
    half = 1.96 * apart.std() / np.sqrt(20)
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.1)


def test_trainings_are_drawn_whole() -> None:
    trainings = np.repeat([[1.0], [2.0], [4.0], [5.0]], 50, axis=1)
    found = bootstrap_interval(mean, [trainings], in_years(np.zeros(50)), generator())
    # The spread of a mean of four draws, which no number of weeks makes smaller.
    spread = np.std([1.0, 2.0, 4.0, 5.0]) / 2
    assert found.value == 3.0
    assert (found.high - found.low) / 2 == pytest.approx(1.96 * spread, rel=0.15)


def test_samples_of_other_weeks_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"sample \(2, 5\): valid is \(trainings, 4 weeks\)"):
        bootstrap_interval(mean, [np.ones((2, 5))], in_years(np.zeros(4)), generator())


def test_performance_profile_is_the_share_of_runs_above_a_threshold() -> None:
    scores = np.array([[0.0, 0.5, np.nan], [1.0, 0.5, 2.0]])
    found = performance_profile(scores, np.array([-1.0, 0.0, 0.5, 1.5, 2.0]))
    assert found.tolist() == [1.0, 0.8, 0.4, 0.2, 0.0]
    stacked = performance_profile(np.stack([scores, 0 * scores]), np.array([0.2]))
    assert stacked.tolist() == [[0.8], [0.0]]
    assert np.isnan(performance_profile(np.full((1, 2), np.nan), np.array([0.0]))).all()


def test_seeds_that_decide_inputs_are_drawn_together() -> None:
    years = np.repeat([[1.0], [2.0], [40.0], [5.0]], 50, axis=1)
    strata = in_years(np.zeros(50))

    def difference(paired: bool) -> float:
        found = bootstrap_interval(
            lambda one, other: mean(one) - mean(other),
            [years + 1.0, years],
            strata,
            generator(),
            paired=paired,
        )
        return found.high - found.low

    assert difference(True) == pytest.approx(0.0, abs=1e-9)
    assert difference(False) > 10.0
