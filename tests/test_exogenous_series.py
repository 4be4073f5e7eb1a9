"""Series on the simulator's clock, and their resampling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sdc_taichi.errors import DataError
from sdc_taichi.exogenous import Series, resample, statistics


def series(values: object, minutes: float = 60.0) -> Series:
    return Series(np.asarray(values), minutes, "x", "1", "test", synthetic=False)


YEAR = np.sin(np.arange(8760) / 11.0) + 0.3 * np.cos(np.arange(8760) / 700.0)


def test_values_are_a_read_only_copy() -> None:
    mine = np.arange(24.0)
    s = series(mine)
    mine[0] = 99.0
    assert s.values[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        s.values[0] = 1.0


@pytest.mark.parametrize(
    ("values", "minutes", "message"),
    [
        ([], 60.0, "shape"),
        ([[1.0]], 60.0, "shape"),
        ([1.0, np.nan], 60.0, "index 1"),
        ([1.0, np.inf], 60.0, "index 1"),
        ([1.0], 0.0, "minutes"),
        ([1.0], np.nan, "minutes"),
    ],
)
def test_bad_series_are_rejected(values: object, minutes: float, message: str) -> None:
    with pytest.raises(DataError, match=message):
        series(values, minutes)


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30, 60])
@pytest.mark.parametrize("hold", [False, True])
def test_every_divisor_of_an_hour_conserves_the_mean(steps: int, hold: bool) -> None:
    out = resample(series(YEAR), steps, hold=hold)
    assert out.shape == (8760 * steps,)
    assert out.dtype == np.float64
    assert out.mean() == pytest.approx(YEAR.mean(), abs=1e-12)


@pytest.mark.parametrize("steps", [0, -4, 7, 8, 61, 2.5, True, "4"])
def test_other_steps_are_rejected(steps: object) -> None:
    with pytest.raises(DataError, match="steps_per_hour"):
        resample(series(YEAR), steps)  # type: ignore[arg-type]


def test_interpolation_is_exact_at_centres_and_does_not_stretch_the_year() -> None:
    # With three steps per hour the middle step has the centre of the hour.
    out = resample(series(YEAR), 3)
    np.testing.assert_allclose(out[1::3], YEAR, rtol=0, atol=1e-12)
    # A straight line stays straight with the slope per hour, right to the last day.
    line = resample(series(np.arange(8760.0)), 4)
    np.testing.assert_allclose(np.diff(line[2:-2]), 0.25, rtol=0, atol=1e-9)
    assert line[4 * 8000 + 2] == pytest.approx(8000.125, abs=1e-9)


def test_the_wrap_is_periodic() -> None:
    values = np.zeros(48)
    values[0], values[-1] = 8.0, 16.0
    out = resample(series(values), 4)
    np.testing.assert_allclose(out[:4], [11.0, 9.0, 7.0, 5.0])
    np.testing.assert_allclose(out[-4:], [10.0, 14.0, 15.0, 13.0])


def test_coarser_steps_that_do_not_nest_average_by_overlap() -> None:
    out = resample(series([0.0, 12.0, 24.0, 36.0], 15.0), 3)
    # 20 minutes: 15 of the first and 5 of the second, 10 and 10, 5 and 15.
    np.testing.assert_allclose(out, [3.0, 18.0, 33.0])


def test_a_rest_of_a_step_is_rejected() -> None:
    with pytest.raises(DataError, match="not a whole number of 60 min steps"):
        resample(series(np.ones(7), 5.0), 1)


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=40),
    st.sampled_from([5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 180.0]),
    st.sampled_from([1, 2, 3, 4, 6, 12]),
    st.booleans(),
)
def test_values_stay_between_the_extremes(
    values: list[float], minutes: float, steps: int, hold: bool
) -> None:
    s = series(values, minutes)
    if (len(values) * minutes) % (60 // steps):
        with pytest.raises(DataError, match="not a whole number"):
            resample(s, steps, hold=hold)
        return
    out = resample(s, steps, hold=hold)
    assert out.size * (60 // steps) == len(values) * minutes
    assert out.min() >= min(values) - 1e-9
    assert out.max() <= max(values) + 1e-9
    if hold or 60 // steps >= minutes:
        assert out.mean() == pytest.approx(np.mean(values), abs=1e-9)


def test_statistics_of_a_known_year() -> None:
    hour = np.arange(8760)
    wave = 10.0 + 3.0 * np.cos(2 * np.pi * hour / 24)
    found = statistics(series(wave))
    assert found["mean"] == pytest.approx(10.0)
    assert found["diurnal"] == pytest.approx(6.0)
    assert found["seasonal"] == pytest.approx(0.0, abs=1e-9)
    assert found["daily_std"] == pytest.approx(3.0 / np.sqrt(2.0))
    assert found["acf24"] == pytest.approx(1.0)
    with pytest.raises(DataError, match="whole years"):
        statistics(series(wave[:720]))
