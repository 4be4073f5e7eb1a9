from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sdc_taichi.hall.protection import NORMAL, THROTTLED, TRIPPED, capacity, protect
from sdc_taichi.types import Status

LIMITS = {"limit_c": 32.0, "trip_c": 37.0, "restart_c": 27.0}

inlets_c = st.floats(-20.0, 80.0) | st.sampled_from([27.0, 32.0, 37.0])


@pytest.mark.parametrize(
    ("before", "inlet_c", "after"),
    [
        (NORMAL, 32.0, NORMAL),
        (NORMAL, np.nextafter(32.0, 40.0), THROTTLED),
        (NORMAL, 37.0, THROTTLED),
        (NORMAL, np.nextafter(37.0, 40.0), TRIPPED),
        (THROTTLED, 32.0, NORMAL),
        (THROTTLED, 32.1, THROTTLED),
        (THROTTLED, 37.1, TRIPPED),
        (TRIPPED, 36.0, TRIPPED),
        (TRIPPED, 31.0, TRIPPED),
        (TRIPPED, np.nextafter(27.0, 40.0), TRIPPED),
        (TRIPPED, 27.0, NORMAL),
    ],
)
def test_transitions(before: int, inlet_c: float, after: int) -> None:
    found = protect(np.array([before], np.int8), np.array([inlet_c]), **LIMITS)
    assert found.dtype == np.int8
    np.testing.assert_array_equal(found, [after])


def test_a_tripped_rack_stays_off_over_a_range_that_a_normal_rack_runs_in() -> None:
    status = np.zeros(1, np.int8)
    seen = []
    for inlet_c in (26.0, 31.0, 34.0, 38.0, 34.0, 31.0, 27.5, 26.5, 31.0):
        status = protect(status, np.array([inlet_c]), **LIMITS)
        seen.append(int(status[0]))
    assert seen == [0, 0, 1, 2, 2, 2, 2, 0, 0]


def test_a_rack_restarts_as_its_inlet_calls_for() -> None:
    tripped = np.full(3, TRIPPED, np.int8)
    found = protect(
        tripped, np.array([30.0, 34.0, 40.0]), limit_c=32.0, trip_c=37.0, restart_c=50.0
    )
    np.testing.assert_array_equal(found, [NORMAL, THROTTLED, TRIPPED])


def test_without_limits_nothing_happens() -> None:
    found = protect(
        np.zeros(2, np.int8), np.array([20.0, 500.0]), limit_c=np.inf, trip_c=np.inf, restart_c=27.0
    )
    np.testing.assert_array_equal(found, NORMAL)


def test_each_rack_has_its_own_limits() -> None:
    found = protect(
        np.zeros(3, np.int8),
        np.full(3, 36.0),
        limit_c=np.array([32.0, 30.0, np.inf]),
        trip_c=np.array([37.0, 35.0, np.inf]),
        restart_c=np.full(3, 27.0),
    )
    np.testing.assert_array_equal(found, [THROTTLED, TRIPPED, NORMAL])


def test_capacity_by_status() -> None:
    status = np.array([NORMAL, THROTTLED, TRIPPED], np.int8)
    np.testing.assert_array_equal(capacity(status, 0.4), [1.0, 0.4, 0.0])
    np.testing.assert_array_equal(capacity(status, np.array([0.1, 0.2, 0.3])), [1.0, 0.2, 0.0])


@given(
    hnp.arrays(np.int8, 8, elements=st.integers(0, 2)),
    hnp.arrays(np.float64, 8, elements=inlets_c),
    hnp.arrays(np.float64, 8, elements=st.floats(0.0, 20.0)),
)
def test_cooler_inlets_never_worsen_the_status(
    status: Status, inlet_c: np.ndarray, cooler_k: np.ndarray
) -> None:
    hot = protect(status, inlet_c, **LIMITS)
    cool = protect(status, inlet_c - cooler_k, **LIMITS)
    assert np.all(cool <= hot)
    # Seeing the same inlets again changes nothing.
    np.testing.assert_array_equal(protect(hot, inlet_c, **LIMITS), hot)
    alone = [protect(status[i : i + 1], inlet_c[i : i + 1], **LIMITS)[0] for i in range(8)]
    np.testing.assert_array_equal(hot, alone)
