"""Setpoint rules, CRAC airflow, the hall's heat balance and the heat it holds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sdc_taichi.plant.cooling import (
    COOLING_LOADS,
    CRAC_FLOWS,
    SETPOINTS,
    CracPoint,
    HallPoint,
    balance_room_heat,
    unmet_and_recovered,
)
from sdc_taichi.types import F64

AIR = np.array([1.225 * 1006.0])


def one(value: float) -> F64:
    return np.array([float(value)])


def follow(
    model: str, start_c: float, commands: list[float], low: float, high: float
) -> list[float]:
    """Setpoints of a row of commands."""
    setpoint, found = one(start_c), []
    run, last = np.zeros(1, dtype=np.int64), one(np.nan)
    for command in commands:
        setpoint, run, last = SETPOINTS[model](
            setpoint, one(command), run, last,
            step_k=one(1.0), low_c=one(low), high_c=one(high),
        )  # fmt: skip
        found.append(float(setpoint[0]))
    return found


COMMANDS = st.lists(st.sampled_from([-1.0, 0.0, 1.0]), min_size=1, max_size=40)


@given(commands=COMMANDS)
def test_accelerating_setpoint_grows_only_upwards(commands: list[float]) -> None:
    expected, at, run, scale, last = [], 18.0, 0, 1.0, None
    for command in commands:
        # Lowering is compared with the wrong number in the released code and so never repeats.
        run, scale = (run + 1, scale) if command == last and command != -1 else (1, 1.0)
        if run > 3:
            scale += 1.0
        at = min(max(at + command * scale, 15.0), 21.6)
        last = command
        expected.append(at)
    assert follow("accelerating", 18, commands, 15, 21.6) == expected


def test_accelerating_setpoint_by_hand() -> None:
    assert follow("accelerating", 15, [1] * 5, 15, 40) == [16, 17, 18, 20, 23]
    assert follow("accelerating", 40, [-1] * 5, 15, 40) == [39, 38, 37, 36, 35]
    assert follow("accelerating", 15, [1, 1, 1, 1, 0, 1], 15, 40) == [16, 17, 18, 20, 20, 21]
    assert follow("accelerating", 15, [0, 0, 0, 0, 0, 1], 15, 40)[-1] == 16


def test_setpoints_move_in_steps_of_their_own_size() -> None:
    moved, *_ = SETPOINTS["symmetric"](
        np.full(3, 20.0),
        np.array([1.0, -2.0, 0.5]),
        np.zeros(3, dtype=np.int64),
        np.full(3, np.nan),
        step_k=np.array([1.0, 0.5, 3.0]),
        low_c=np.array([16.0, 19.5, 16.0]),
        high_c=np.array([23.0, 23.0, 21.0]),
    )
    assert moved.tolist() == [21.0, 19.5, 21.0]


def test_airflow_of_the_crac_units() -> None:
    point = CracPoint(
        it_w=np.array([0.0, 2e5, 4e5]),
        it_airflow_m3s=np.array([1.0, 8.0, 30.0]),
        speed=np.array([0.5, 0.7, 1.0]),
        design_flow_m3s=np.full(3, 20.0),
        design_it_airflow_m3s=np.full(3, 10.0),
        min_ratio=np.full(3, 0.6),
        supply_m3s_per_w=np.full(3, 5e-5),
    )
    flow, speed = CRAC_FLOWS["constant"](point)
    assert flow.tolist() == [20, 20, 20]
    assert speed.tolist() == [1, 1, 1]
    flow, speed = CRAC_FLOWS["follow_servers"](point)
    np.testing.assert_allclose(speed, [0.6, 0.8, 1.0])
    np.testing.assert_allclose(flow, [12, 16, 20])
    flow, speed = CRAC_FLOWS["per_watt"](point)
    np.testing.assert_allclose(flow, [0, 10, 20])
    assert speed.tolist() == [1, 1, 1]


def load_of(model: str, outlet_c: float, setpoint_c: float = 18.0) -> tuple[float, float]:
    return_c, load_w = COOLING_LOADS[model].step(
        HallPoint(
            one(3e5), one(1.2e4), one(20.0), one(18.5), one(setpoint_c), one(outlet_c),
            air_j_per_m3_k=AIR, return_approach_k=one(-3.0),
        )
    )  # fmt: skip
    return float(return_c[0]), float(load_w[0])


def test_balanced_load_is_all_heat_that_enters_the_air() -> None:
    return_c, load_w = load_of("heat_balance", outlet_c=99.0)
    assert load_w == 3e5 + 1.2e4
    assert AIR[0] * 20.0 * (return_c - 18.5) == pytest.approx(3e5, rel=1e-12)


@pytest.mark.parametrize(("outlet_c", "rise_k"), [(30.0, 9.0), (21.0, 0.0), (18.0, -3.0)])
def test_loads_by_return_approach(outlet_c: float, rise_k: float) -> None:
    expected = AIR[0] * 20.0 * rise_k
    assert load_of("paper", outlet_c) == pytest.approx((outlet_c - 3.0, expected), abs=1e-6)
    assert load_of("released", outlet_c) == pytest.approx(
        (outlet_c - 3.0, max(expected, 0.0)), abs=1e-6
    )


@given(
    load_w=st.floats(0, 1e7),
    capacity_w=st.floats(0, 1e7),
    held_kwh=st.floats(0, 1e4),
    step_h=st.sampled_from([1 / 12, 0.25, 1.0]),
)
def test_heat_that_is_not_removed_is_held(
    load_w: float, capacity_w: float, held_kwh: float, step_h: float
) -> None:
    removed_w = min(load_w + held_kwh * 1e3 / step_h, capacity_w)
    unmet, recovered, stored = (
        float(x[0]) for x in balance_room_heat(one(load_w), one(removed_w), one(held_kwh), step_h)
    )
    scale = max(load_w * step_h / 1e3, held_kwh, 1e-9)
    assert stored - held_kwh == pytest.approx(
        (load_w - removed_w) * step_h / 1e3, abs=1e-12 * scale
    )
    assert unmet - recovered == pytest.approx(load_w - removed_w, abs=1e-6 + 1e-12 * load_w)
    assert min(unmet, recovered) == 0.0
    assert stored >= 0.0
    if capacity_w > load_w + held_kwh * 1e3 / step_h:
        assert stored <= 1e-12 * scale


def test_loads_that_differ_by_rounding_leave_no_unmet_heat() -> None:
    load_w = np.full(3, 9e5)
    removed_w = load_w + np.array([-2e-10, 2e-10, -1e-3])
    unmet_w, recovered_w = unmet_and_recovered(load_w, removed_w)
    np.testing.assert_allclose(unmet_w, [0.0, 0.0, 1e-3], rtol=1e-6)
    assert not recovered_w.any()
