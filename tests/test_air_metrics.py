from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sdc_taichi.hall import air_metrics

CHECKS = Path(__file__).parent / "reference" / "physics_checks.json"


def test_indices_of_a_hall_of_two_racks() -> None:
    flow_m3s = np.array([2.0, 1.0])
    inlet_c, outlet_c = np.array([20.0, 30.0]), np.array([32.0, 40.0])
    inlet = air_metrics.rise_m3k_s(flow_m3s, inlet_c, 18.0)
    outlet = air_metrics.rise_m3k_s(flow_m3s, outlet_c, 18.0)
    assert (float(inlet), float(outlet)) == (16.0, 50.0)
    assert float(air_metrics.shi(inlet, outlet, 3.0)) == pytest.approx(0.32)
    assert float(air_metrics.rhi(inlet, outlet, 3.0)) == pytest.approx(0.68)
    rise_k = air_metrics.it_rise_k(inlet, outlet, flow_m3s.sum())
    assert float(rise_k) == pytest.approx(34.0 / 3.0)
    # The CRAC units supply 4 m3/s, so 34 m3 K/s of heat warm it by 8.5 K.
    assert float(air_metrics.rti(26.5, 18.0, rise_k)) == pytest.approx(75.0)
    over_k = air_metrics.over_27_sum_k(inlet_c)
    assert float(over_k) == 3.0
    for name, found in (("A1", 70.0), ("A2", 81.25), ("A3", 88.4615384615), ("A4", 91.6666666667)):
        high_c = air_metrics.ALLOWABLE_C[name][1]
        assert float(air_metrics.rci_hi(over_k, 2, allowable_c=high_c)) == pytest.approx(found)
    under_k = air_metrics.under_18_sum_k(np.array([16.0, 17.5, 30.0]))
    assert float(air_metrics.rci_lo(under_k, 3, allowable_c=15.0)) == pytest.approx(
        100.0 * (1.0 - 2.5 / 9.0)
    )


def test_rci_is_perfect_inside_zero_at_the_limit_and_negative_beyond() -> None:
    low_c, high_c = air_metrics.ALLOWABLE_C["A1"]
    for inlet_c, at_high, at_low in (
        (18.0, 100.0, 100.0),
        (27.0, 100.0, 100.0),
        (high_c, 0.0, 100.0),
        (high_c + 5.0, -100.0, 100.0),
        (low_c, 100.0, 0.0),
        (low_c - 3.0, 100.0, -100.0),
    ):
        inlets = np.full(4, inlet_c)
        over, under = (
            air_metrics.over_27_sum_k(inlets),
            air_metrics.under_18_sum_k(inlets),
        )
        assert float(air_metrics.rci_hi(over, 4, allowable_c=high_c)) == pytest.approx(at_high)
        assert float(air_metrics.rci_lo(under, 4, allowable_c=low_c)) == pytest.approx(at_low)


def test_no_heat_and_no_airflow_have_defined_indices() -> None:
    still, air_c = np.zeros((1, 3)), np.full((1, 3), 22.0)
    rise = air_metrics.rise_m3k_s(still, air_c, 18.0)
    np.testing.assert_array_equal(air_metrics.shi(rise, rise, 0.0), [0.0])
    np.testing.assert_array_equal(air_metrics.rhi(rise, rise, 0.0), [1.0])
    np.testing.assert_array_equal(air_metrics.it_rise_k(rise, rise, still.sum(axis=1)), [0.0])
    np.testing.assert_array_equal(air_metrics.rti(np.array([20.0]), 18.0, np.zeros(1)), [0.0])
    # What rounding leaves of no rise is none.
    for left in (-5e-324, 5e-324, 3e-5):
        found = air_metrics.shi(np.array([4e-15]), np.array([left]), 1.0)
        np.testing.assert_array_equal(found, [0.0])
        np.testing.assert_array_equal(air_metrics.rti(np.array([18.5]), 18.0, left), [0.0])


@given(
    hnp.arrays(np.float64, 6, elements=st.floats(0.01, 10.0)),
    hnp.arrays(np.float64, 6, elements=st.floats(0.0, 20.0)),
    hnp.arrays(np.float64, 6, elements=st.floats(0.1, 20.0)),
)
def test_shi_is_a_share_and_grows_with_recirculation(
    flow_m3s: np.ndarray, above_k: np.ndarray, it_k: np.ndarray
) -> None:
    def index(scale: float) -> float:
        inlet_c = 18.0 + scale * above_k
        inlet = air_metrics.rise_m3k_s(flow_m3s, inlet_c, 18.0)
        outlet = air_metrics.rise_m3k_s(flow_m3s, inlet_c + it_k, 18.0)
        return float(air_metrics.shi(inlet, outlet, flow_m3s.sum()))

    assert index(0.0) == 0.0
    assert 0.0 <= index(1.0) <= index(2.0) + 1e-12 < 1.0


@pytest.mark.parametrize("inlet_rise_k", [-2.5e-16, -1.1e-5, 1.1e-5])
@pytest.mark.parametrize("outlet_rise_k", [0.5, 10.0])
def test_shi_of_what_rounding_leaves_is_zero_of_no_sign(
    inlet_rise_k: float, outlet_rise_k: float
) -> None:
    airflow_m3s = np.array([12.0])
    found = air_metrics.shi(inlet_rise_k * airflow_m3s, outlet_rise_k * airflow_m3s, airflow_m3s)
    assert found == 0.0
    assert not np.signbit(found).any()


def test_alike_temperatures_have_one_rank() -> None:
    assert np.unique(air_metrics.rank(27.0 + np.array([0.0, -2e-14, 4e-15, 3e-10]))).size == 1
    ranks = air_metrics.rank(np.array([26.0, np.nextafter(np.float32(27), 0), 27.0, np.inf]))
    assert np.all(np.diff(ranks) > 0)
