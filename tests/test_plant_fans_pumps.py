from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sdc_taichi.plant import fans_pumps
from sdc_taichi.plant.water_side import economiser_share

PROPERTY = settings(max_examples=80, deadline=None, derandomize=True)


@pytest.fixture(autouse=True, scope="module")
def _no_floating_point_warnings() -> Any:
    with np.errstate(all="raise", under="ignore"):
        yield


def test_constants_of_the_released_code() -> None:
    fan_w = fans_pumps.crac_fan_w(5.663e-5, design_flow_m3s=9.438e-5, design_w=150.0)
    assert float(fan_w) == pytest.approx(32.40343305195208, rel=1e-12)
    pump_w = fans_pumps.hydraulic_pump_w(300e3, 1.1e-3, efficiency=0.87)
    assert float(pump_w) == pytest.approx(379.3103448275862, rel=1e-12)


def test_fan_follows_the_cube_of_the_flow() -> None:
    fan_w = fans_pumps.crac_fan_w(
        np.array([0.0, 5.0, 10.0, 20.0]), design_flow_m3s=10.0, design_w=800.0
    )
    np.testing.assert_allclose(fan_w, [0.0, 100.0, 800.0, 6400.0])


def test_pump_has_a_lowest_speed_and_stops_without_flow() -> None:
    flow = np.array([0.0, 1.0, 4.0, 5.0, 10.0])
    pump_w = fans_pumps.pump_w(flow, design_flow=10.0, design_w=1000.0, min_flow_ratio=0.4)
    np.testing.assert_allclose(pump_w, [0.0, 64.0, 64.0, 125.0, 1000.0])


def test_economiser_takes_the_share_tower_water_can_precool() -> None:
    share = economiser_share(
        16.0, chilled_water_c=10.0, tower_water_c=np.array([4.0, 10.0, 11.5, 13.0, 16.0, 25.0])
    )
    np.testing.assert_allclose(share, [1.0, 1.0, 0.75, 0.5, 0.0, 0.0])


def test_economiser_without_a_load_does_nothing() -> None:
    share = economiser_share(
        np.array([10.0, 9.0]), chilled_water_c=10.0, tower_water_c=np.array([0.0, 0.0])
    )
    np.testing.assert_array_equal(share, 0.0)


@given(
    st.floats(-5.0, 40.0, allow_subnormal=False),
    st.floats(-5.0, 40.0, allow_subnormal=False),
    st.floats(-40.0, 45.0, allow_subnormal=False),
)
@PROPERTY
def test_economiser_share_is_a_share_and_falls_with_warmer_weather(
    return_c: float, chilled_c: float, tower_c: float
) -> None:
    water = np.array([tower_c, tower_c + 1.0, tower_c + 5.0])
    share = economiser_share(return_c, chilled_water_c=chilled_c, tower_water_c=water)
    assert share.shape == (3,)
    assert ((share >= 0.0) & (share <= 1.0)).all()
    assert (np.diff(share) <= 0.0).all()


def test_batch_equals_each_alone() -> None:
    flow = np.array([0.0, 0.3, 2.0])
    fan = fans_pumps.crac_fan_w(flow, design_flow_m3s=2.0, design_w=np.array([5.0, 6.0, 7.0]))
    pump = fans_pumps.pump_w(flow, design_flow=2.0, design_w=5.0, min_flow_ratio=0.4)
    for i in range(3):
        one = slice(i, i + 1)
        alone = fans_pumps.crac_fan_w(flow[one], design_flow_m3s=2.0, design_w=5.0 + i)
        assert alone.shape == (1,)
        assert alone[0] == fan[i]
        alone = fans_pumps.pump_w(flow[one], design_flow=2.0, design_w=5.0, min_flow_ratio=0.4)
        assert alone[0] == pump[i]
