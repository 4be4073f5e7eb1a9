"""Curves of the servers, by hand and against the compiled ones."""

from __future__ import annotations

import numpy as np
import pytest

from sdc_taichi import Simulator, drivers_from_arrays, load_config
from sdc_taichi.plant.air import CONSTANT, EXACT_AT_C, OF_IDEAL_GAS, density_kg_m3
from sdc_taichi.plant.servers import linear_curve


def test_density_of_air() -> None:
    assert density_kg_m3(101_325.0, 20.0) == pytest.approx(1.2041, abs=1e-4)
    ideal = {t: 293.15 / (t + 273.15) for t in (10.0, 15.0, *EXACT_AT_C, 25.0, 35.0, 45.0)}
    error = {t: float(OF_IDEAL_GAS.at(np.array(t))) / ratio - 1.0 for t, ratio in ideal.items()}
    assert [error[t] for t in EXACT_AT_C] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert max(abs(error[t]) for t in (15.0, 25.0, 35.0)) < 6e-4
    assert abs(error[10.0]) < 2e-3
    assert abs(error[45.0]) < 4e-3
    assert CONSTANT.at(np.array([-40.0, 60.0])).tolist() == [1.0, 1.0]


def test_curve_coefficients_by_hand() -> None:
    curves = load_config("paper").servers.curves
    cpu = curves.cpu_slope_per_k, curves.cpu_offset, curves.cpu_shift
    fan = curves.fan_slope_per_k, curves.fan_offset, curves.fan_shift
    assert cpu == pytest.approx((1 / 600, -1 / 60, 0.99))
    assert fan == pytest.approx((0.215 / 12, 0.225 - 0.215 * 28 / 12, 0.215))
    released = load_config("sustaindc").servers.curves
    assert released.cpu_slope_per_k == pytest.approx(1 / 600 + 0.05)
    released_fan = released.fan_slope_per_k, released.fan_offset, released.fan_shift
    assert released_fan == pytest.approx((10 * fan[0], 5 * fan[1], 5 * fan[2]))


def test_line_goes_through_the_given_points() -> None:
    slope, offset, shift = linear_curve((16.0, 28.0), (0.01, 1.0), (0.03, 1.02))
    assert slope * 16.0 + offset == pytest.approx(0.01)
    assert slope * 28.0 + offset == pytest.approx(0.03)
    assert slope * 16.0 + offset + shift == pytest.approx(1.0)


def test_fans_never_blow_backwards_and_curves_end_at_the_limit() -> None:
    changes = ["servers.fan_model=linear", "servers.fan_airflow_ratio_limits=null"]
    curves = load_config("corrected", changes).servers.curves
    idle = np.zeros(1)
    assert curves.airflow_ratio(np.array([-40.0]), idle) == 0.0
    at_limit, beyond = np.array([45.0]), np.array([60.0])
    assert curves.airflow_ratio(beyond, idle) == curves.airflow_ratio(at_limit, idle)
    watts = np.array([150.0]), np.array([10.0])
    assert curves.cpu_w(beyond, idle, *watts) == curves.cpu_w(at_limit, idle, *watts)
    assert curves.fan_w(np.array([0.5]), 10.0) == pytest.approx(10.0 * (0.5 / 0.44) ** 3)


@pytest.mark.parametrize(
    "changes",
    [
        [],
        ["servers.fan_model=released", "servers.fan_power_exponent=1"],
        ["servers.fan_power_exponent=2.2", "servers.fan_reference_ratio=0.6"],
        ["servers.curve_limit_c=23", "servers.fan_airflow_ratio_limits=[0.1, 0.4]"],
        [
            "servers.fan_airflow_points=[[18, 0.3, 0.4], [24, 0.35, 0.5], [26, 0.3, 0.6]]",
            "servers.cpu_power_points=[[20, 0.1, 0.9], [25.1, 0.2, 0.95], [25.4, 0.2, 1]]",
        ],
    ],
    ids=["cubic", "released", "other exponent", "limits", "points"],
)
def test_kernel_computes_the_same_curves(changes: list[str]) -> None:
    config = load_config("tiny", ["hvac.setpoint.initial_c=20", *changes])
    curves, load = config.servers.curves, np.array([0.6])
    racks, full_w, idle_w = [0, 2], np.array([150.0, 170.0]), np.array([10.0, 20.0])
    drivers = drivers_from_arrays([20.0], [15.0], [300.0], load)
    with Simulator(config, drivers=drivers, precision="f64") as sim:
        sim.reset()
        result = sim.step()
    inlet_c = result.rack_inlet_c[racks].astype(np.float64)
    ratio = curves.airflow_ratio(inlet_c, load)
    cpu_w = curves.cpu_w(inlet_c, load, full_w, idle_w)
    moved = curves.moved_ratio(ratio, inlet_c, OF_IDEAL_GAS)
    np.testing.assert_allclose(result.rack_airflow_m3s[racks], 3 * 0.03 * moved, rtol=1e-12)
    np.testing.assert_allclose(result.rack_cpu_w[racks], 3 * cpu_w, rtol=1e-12)
    np.testing.assert_allclose(result.rack_fan_w[racks], 3 * curves.fan_w(ratio, 10.0), rtol=1e-12)


POINTS = [(18.0, 0.3, 0.4), (24.0, 0.35, 0.5), (26.0, 0.3, 0.6), (50.0, 1.0, 0.7)]


def test_curve_goes_through_all_points_and_is_constant_beyond() -> None:
    changes = [f"servers.fan_airflow_points={[*map(list, POINTS)]}", "servers.curve_limit_c=40"]
    changes += ["servers.fan_airflow_ratio_limits=null"]
    curves = load_config("corrected", changes).servers.curves
    inlet_c = np.array([0.0, 18.0, 21.0, 24.0, 25.2, 26.0, 33.0, 40.0, 55.0])
    for load in (0.0, 0.3, 1.0):
        at_c, idle, full = np.array(POINTS).T
        ratio = (1.0 - load) * idle + load * full
        expected = np.interp(np.minimum(inlet_c, 40.0), at_c, ratio)
        at_load = np.full(inlet_c.shape, load)
        np.testing.assert_allclose(curves.airflow_ratio(inlet_c, at_load), expected, rtol=1e-12)


@pytest.mark.parametrize("preset", ["corrected", "large", "tiny", "hall_of_2026"])
@pytest.mark.parametrize("load", [0.3, 0.6, 1.0])
def test_power_over_inlet_has_a_knee(preset: str, load: float) -> None:
    """ASHRAE TC 9.9 (2011): power at 30 C is 4..8 % and at 35 C 7..20 % above that at 15 C.

    Fans turn faster from 23 to 25 C on, and at 27 C power is at most 3 % above that at 15 C.
    """
    servers = load_config(preset).servers
    curves, utilisation = servers.curves, np.array(load)
    share = servers.fan_reference_share or 10.0 / 150.0

    def power(inlet_c: float) -> float:
        inlet = np.array(inlet_c)
        ratio = curves.airflow_ratio(inlet, utilisation)
        watts = curves.cpu_w(inlet, utilisation, np.array(1.0), np.array(0.05))
        return float(watts + curves.fan_w(ratio, share))

    for cool_c in (15.0, 18.0, 20.0):
        assert 1.0 < power(27.0) / power(cool_c) < 1.03
    assert 1.04 < power(30.0) / power(15.0) < 1.08
    assert 1.07 < power(35.0) / power(15.0) < 1.20
    airflow = curves.airflow_ratio(np.array([10.0, 20.0, 25.0, 27.0]), utilisation)
    assert airflow[0] == pytest.approx(airflow[1]) == pytest.approx(airflow[2])
    assert airflow[3] > airflow[2]


def test_a_straight_line_replaces_the_points_of_a_preset() -> None:
    for line in (
        "fan_airflow_ratio_lb=[0.1, 0.3]",
        "fan_airflow_ratio_ub=[0.3, 0.5]",
        "inlet_range_c=[15, 30]",
        "fan_model=linear",
    ):
        assert load_config("corrected", [f"servers.{line}"]).servers.fan_airflow_points is None
    for line in ("cpu_power_ratio_lb=[0.1, 0.9]", "cpu_power_ratio_ub=[0.1, 1.1]"):
        servers = load_config("corrected", [f"servers.{line}"]).servers
        assert servers.cpu_power_points is None
        assert servers.fan_airflow_points is not None
