"""The 365-day year: its days, the times of its steps, and what becomes of 29 February."""

from __future__ import annotations

from datetime import datetime, timedelta

import numpy as np
import pytest

from sdc_taichi.exogenous.year_clock import (
    DAYS_PER_MONTH,
    FIRST_DAY_OF_MONTH,
    MONTH_OF_DAY,
    day_of_year,
    is_leap_day,
    minutes_into_year,
    step_times,
)


def test_days_count_from_new_year() -> None:
    days = [
        day_of_year(f"{month:02d}-{day:02d}")
        for month, length in enumerate(DAYS_PER_MONTH, 1)
        for day in range(1, length + 1)
    ]
    assert days == list(range(365))
    assert day_of_year("7-1") == day_of_year(" 07-01 ") == FIRST_DAY_OF_MONTH[6] == 181
    assert [MONTH_OF_DAY[day] for day in (0, 30, 31, 58, 59, 364)] == [1, 1, 2, 2, 3, 12]


@pytest.mark.parametrize("text", ["02-29", "00-01", "13-01", "04-31", "07/01", "", "07", 701, None])
def test_days_that_are_none(text: object) -> None:
    with pytest.raises(ValueError, match=r"valid is MM-DD"):
        day_of_year(text)


def test_step_times_leave_leap_days_out() -> None:
    steps = np.arange(5 * 8760)
    hourly = step_times(np.array([0, 24]), steps, 1, np.array([2001, 2001]))
    assert hourly.shape == (steps.size, 2)
    assert np.array_equal(hourly[24:, 0], hourly[:-24, 1])
    days = set(hourly[:, 0].astype("datetime64[D]").astype(str).tolist())
    assert len(days) == 5 * 365
    assert {"2001-01-01", "2004-02-28", "2004-03-01", "2005-12-31"} <= days
    assert "2004-02-29" not in days
    assert np.all(np.diff(hourly[:, 0]) > np.timedelta64(0))


def test_step_times_count_from_the_year_of_each_data_center() -> None:
    start = np.array([0, 8759])
    (first, next_step) = step_times(start, np.array([0, 1]), 1, np.array([2024, 1999])).astype(str)
    assert first.tolist() == ["2024-01-01T00:00:00.000", "1999-12-31T23:00:00.000"]
    assert next_step.tolist() == ["2024-01-01T01:00:00.000", "2000-01-01T00:00:00.000"]


@pytest.mark.parametrize("year", [1900, 2000, 2023, 2024])
def test_calendar_times_fall_on_the_same_minute_of_every_year(year: int) -> None:
    hours = [datetime(year, 1, 1) + timedelta(hours=h) for h in range(366 * 24)]
    times = np.array([t for t in hours if t.year == year], dtype="datetime64[s]")
    leap = is_leap_day(times)
    assert leap.sum() == (24 if year in (2000, 2024) else 0)
    np.testing.assert_array_equal(
        [minutes_into_year(t) for t in times[~leap]], 60.0 * np.arange(8760)
    )
