"""Economiser and coils."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from model_steps import floating_point_errors  # noqa: F401
from sdc_taichi import Simulator, drivers_from_arrays, load_config
from sdc_taichi.plant.water_side import coil_range_ratio, economiser_share


def test_economiser_takes_the_share_tower_water_can_precool() -> None:
    share = economiser_share(
        16.0, chilled_water_c=10.0, tower_water_c=np.array([4.0, 10.0, 11.5, 13.0, 16.0, 25.0])
    )
    np.testing.assert_allclose(share, [1.0, 1.0, 0.75, 0.5, 0.0, 0.0])
    unloaded = economiser_share(np.array([10.0, 9.0]), chilled_water_c=10.0, tower_water_c=0.0)
    np.testing.assert_array_equal(unloaded, 0.0)


def counterflow_range_k(load: float, *, range_k: float, approach_k: float, rise_k: float) -> float:
    """Range of the water of a coil whose airflow follows its load (Wetter 1999), by bisection."""

    def mean_k(water_k: float) -> float:
        warm, cold = rise_k + approach_k - water_k, approach_k
        return cold if abs(warm / cold - 1.0) < 1e-9 else (warm - cold) / np.log(warm / cold)

    low, high = 1e-3, rise_k + approach_k - 1e-6
    for _ in range(60):
        middle = 0.5 * (low + high)
        conductance = 2.0 / (load**-0.8 + (load * range_k / middle) ** -0.85)
        spare = conductance * mean_k(middle) / mean_k(range_k) > load
        low, high = (middle, high) if spare else (low, middle)
    return low


@pytest.mark.parametrize(("approach_k", "rise_k"), [(8.0, 14.3), (8.0, 11.0), (6.0, 14.3)])
def test_range_of_coils_rises_at_part_load(approach_k: float, rise_k: float) -> None:
    with Simulator(load_config("corrected")) as sim:
        design = sim.sizing.water_side
    for load in (0.2, 0.3, 0.4, 0.6, 0.8, 1.0):
        ratio = float(coil_range_ratio(load * design.cooling_w, design)[0])
        expected = counterflow_range_k(load, range_k=6.0, approach_k=approach_k, rise_k=rise_k)
        assert 6.0 * ratio == pytest.approx(expected, rel=0.06 if load < 0.3 else 0.03)
    fixed = replace(design, coil_valves=np.zeros(1))
    assert coil_range_ratio(0.3 * design.cooling_w, fixed)[0] == 1.0


def test_economiser_sees_the_water_of_the_coils() -> None:
    """At wet bulbs of 8..10 C and usual load: 0.48 of the load in EnergyPlus, 0.33 at 6 K."""
    wet_bulb_c = np.linspace(8.0, 10.0, 20)
    weather = wet_bulb_c + 3.0, wet_bulb_c, np.full(20, 300.0), np.full(20, 0.45)
    shares = {}
    for valves in ("true", "false"):
        # EnergyPlus keeps the tower at wet bulb + 4 K.
        overrides = [f"hvac.chiller.coil_valves={valves}", "hvac.sizing.design_wet_bulb_c=25.5",
                     "hvac.tower.setpoint=approach"]  # fmt: skip
        drivers = drivers_from_arrays(*weather)
        with Simulator(load_config("corrected", overrides), drivers=drivers) as sim:
            sim.reset()
            steps = [sim.step() for _ in wet_bulb_c]
            shares[valves] = np.mean([r.economiser_w / r.heat_removed_w for r in steps])
    assert shares["true"] == pytest.approx(0.48, abs=0.03)
    assert shares["false"] == pytest.approx(0.33, abs=0.03)
