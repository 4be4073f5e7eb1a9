from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sdc_taichi.hall.protection import (
    NORMAL,
    THROTTLED,
    TRIPPED,
    capacity,
    first_of_each,
    protect,
    ready_min,
)
from sdc_taichi.types import Status

LIMITS = {"limit_c": 32.0, "trip_c": 37.0, "outlet_limit_c": 70.0, "outlet_trip_c": 80.0}
inlets_c = st.floats(-20.0, 80.0) | st.sampled_from([27.0, 32.0, 37.0])


def after(status: Any, inlet_c: Any, outlet_c: Any = 40.0, **more: Any) -> Status:
    """Status of racks after their temperatures, with fans in order and none that restarts."""
    before = np.atleast_1d(np.asarray(status, np.int8))
    none = np.zeros(len(before), np.bool_)
    given = {**LIMITS, "throttle_share": 0.5, "fans_failed": none, "restarts": none, **more}
    ones = np.ones(len(before))
    found = protect(before, np.asarray(inlet_c) * ones, np.asarray(outlet_c) * ones, **given)
    assert found.dtype == np.int8
    return found


@pytest.mark.parametrize(
    ("before", "inlet_c", "expected"),
    [
        (NORMAL, 32.0, NORMAL),
        (NORMAL, np.nextafter(32.0, 40.0), THROTTLED),
        (NORMAL, 37.0, THROTTLED),
        (NORMAL, np.nextafter(37.0, 40.0), TRIPPED),
        (THROTTLED, 32.0, NORMAL),
        (THROTTLED, 32.1, THROTTLED),
        (THROTTLED, 37.1, TRIPPED),
        (TRIPPED, 20.0, TRIPPED),
    ],
)
def test_inlets_throttle_and_trip(before: int, inlet_c: float, expected: int) -> None:
    assert after(before, inlet_c) == [expected]


@pytest.mark.parametrize(
    ("before", "outlet_c", "expected"),
    [
        (NORMAL, 70.0, NORMAL),
        (NORMAL, 70.1, THROTTLED),
        # Servers throttle before they trip, however hot a step finds them.
        (NORMAL, 160.0, THROTTLED),
        (THROTTLED, 80.0, THROTTLED),
        (THROTTLED, 80.1, TRIPPED),
        (THROTTLED, 69.9, NORMAL),
    ],
)
def test_outlets_throttle_first_and_then_trip(before: int, outlet_c: float, expected: int) -> None:
    assert after(before, 25.0, outlet_c) == [expected]


def test_a_rack_with_failed_fans_stays_throttled_while_full_work_would_be_too_hot() -> None:
    failed = np.ones(1, np.bool_)
    # 57 C at half its work: 25 + 32/0.5 = 89 C at all of it.
    assert after(THROTTLED, 25.0, 57.0, fans_failed=failed) == [THROTTLED]
    assert after(THROTTLED, 25.0, 57.0) == [NORMAL]
    assert after(THROTTLED, 25.0, 45.0, fans_failed=failed) == [NORMAL]
    assert after(NORMAL, 25.0, 57.0, fans_failed=failed) == [NORMAL]
    # Without any work the rise says nothing of full work.
    assert after(THROTTLED, 25.0, 29.0, fans_failed=failed, throttle_share=0.0) == [NORMAL]


def test_a_tripped_rack_is_off_until_it_restarts() -> None:
    found = after([TRIPPED] * 2, 25.0, restarts=np.array([False, True]))
    np.testing.assert_array_equal(found, [TRIPPED, NORMAL])


def test_restart_waits_for_cooling_and_a_cool_inlet() -> None:
    wait = np.zeros(4)
    status = np.array([TRIPPED, TRIPPED, TRIPPED, NORMAL], np.int8)
    for inlet_c, cooled, expected in (
        (25.0, [True, False, True, True], [5, 0, 5, 0]),
        (25.0, [True, False, True, True], [10, 0, 10, 0]),
        (31.0, [True, True, True, True], [0, 0, 0, 0]),
        (25.0, [True, True, False, True], [5, 5, 0, 0]),
    ):
        now_c = np.full(4, inlet_c)
        wait = ready_min(status, wait, now_c, np.array(cooled), restart_c=30.0, dt=5.0)
        np.testing.assert_array_equal(wait, expected)


def test_racks_restart_in_stages_of_each_data_center() -> None:
    wanted = np.array([0, 1, 1, 1, 0, 1, 1], np.bool_)
    found = first_of_each(wanted, np.array([2, 1]), np.array([0, 5, 7]))
    np.testing.assert_array_equal(found, [0, 1, 1, 0, 0, 1, 0])


def test_capacity_by_status() -> None:
    status = np.array([NORMAL, THROTTLED, TRIPPED], np.int8)
    np.testing.assert_array_equal(capacity(status, 0.4), [1.0, 0.4, 0.0])
    np.testing.assert_array_equal(capacity(status, np.array([0.1, 0.2, 0.3])), [1.0, 0.2, 0.0])


@given(
    hnp.arrays(np.int8, 8, elements=st.integers(0, 2)),
    hnp.arrays(np.float64, 8, elements=inlets_c),
    hnp.arrays(np.float64, 8, elements=st.floats(0.0, 60.0)),
    hnp.arrays(np.float64, 8, elements=st.floats(0.0, 20.0)),
)
def test_cooler_air_never_worsens_the_status(
    status: Status, inlet_c: np.ndarray, rise_k: np.ndarray, cooler_k: np.ndarray
) -> None:
    outlet_c = inlet_c + rise_k
    hot = after(status, inlet_c, outlet_c)
    cool = after(status, inlet_c - cooler_k, outlet_c - cooler_k)
    assert np.all(cool <= hot)
    alone = [after(status[i], inlet_c[i], outlet_c[i])[0] for i in range(8)]
    np.testing.assert_array_equal(hot, alone)
