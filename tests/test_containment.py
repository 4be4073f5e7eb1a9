"""Containment and the CRAC fans: the design point in every model of airflow, and no jumps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from random_halls import AS_FOUND, SEEDS, fleet_of, random_values
from sdc_taichi import ConfigError, DataCenterConfig, load_config
from sdc_taichi.config import config_from_dict
from sdc_taichi.sim.crac_units import CracUnits
from sdc_taichi.sim.design_hall import DesignHall, solve_design_hall
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions, HallSums
from sdc_taichi.sim.step_inputs import UnitIndex
from sdc_taichi.types import F64

FLOW_MODELS = ("constant", "follow_servers", "controlled")


def simulated(config: DataCenterConfig, supply_c: float, load: float = 1.0) -> HallSums:
    """Air of a hall whose CRAC units run as they do in a step of the simulator."""
    return simulated_at(config, supply_c, np.array([load]))


def simulated_at(config: DataCenterConfig, supply_c: float, loads: F64) -> HallSums:
    """Air of a hall at each of some loads."""
    fleet = fleet_of(*[config] * len(loads))
    supply = CracUnits(fleet, UnitIndex(fleet)).initial_supply()
    conditions = Conditions(
        np.full(fleet.units, supply_c), loads, unit_low=supply.unit_low, unit_high=supply.unit_high
    )
    return Hall(fleet, "f64").solve(conditions)


def assert_at_design(shown: DesignHall, sums: HallSums) -> None:
    """Assert that the simulator finds the inlets and airflows that ``hall show`` prints."""
    np.testing.assert_allclose(sums.rack_inlet_c, shown.inlet_c, rtol=0, atol=1e-6)
    np.testing.assert_allclose(sums.rack_outlet_c, shown.outlet_c, rtol=0, atol=1e-6)
    np.testing.assert_allclose(sums.unit_airflow_m3s, shown.unit_m3s, rtol=1e-6)


@pytest.mark.parametrize("flow_model", FLOW_MODELS)
@pytest.mark.parametrize("containment", [0.0, 0.3, 0.7, 0.9, 1.0])
def test_simulation_at_the_design_point_is_what_hall_show_prints(
    containment: float, flow_model: str
) -> None:
    config = load_config(
        "corrected",
        [f"hall.layout.containment={containment}", f"hvac.crac.flow_model={flow_model}"],
    )
    shown = solve_design_hall(config)
    assert_at_design(shown, simulated(config, shown.supply_c))
    assert shown.air is not None
    # The RTI of an open hall is 117 %; closed paths leave neither recirculation nor bypass.
    assert shown.air.rti_pct >= 100.0 - 1e-9
    if containment == 1.0:
        assert shown.air.rti_pct == pytest.approx(100.0)
    expected_c = {0.0: 28.15, 0.7: 24.34, 0.9: 23.44, 1.0: 23.0}
    if containment in expected_c:
        # The mean holds in the reference hall, whose racks have equal power.
        assert shown.inlet_c.mean() == pytest.approx(expected_c[containment], abs=0.15)


@settings(phases=AS_FOUND, max_examples=12)
@given(
    seed=SEEDS,
    containment=st.floats(0, 1),
    flow_model=st.sampled_from(FLOW_MODELS),
    units=st.integers(1, 5),
)
def test_any_hall_simulates_what_hall_show_prints(
    seed: int, containment: float, flow_model: str, units: int
) -> None:
    values: dict[str, Any] = random_values(np.random.default_rng(seed), "dc", (3, 4))
    values["hall"]["layout"]["containment"] = containment
    values["hvac"]["crac"] |= {"units": units, "unit_shares": None, "flow_model": flow_model}
    try:
        config = config_from_dict(values)
        shown = solve_design_hall(config)
    except ConfigError:
        # Some draws breathe more air than their neighbours exhaust.
        return
    assert_at_design(shown, simulated(config, shown.supply_c))


@pytest.mark.parametrize("supply_c", [16.0, 23.0])
@pytest.mark.parametrize("units", [1, 4])
@pytest.mark.parametrize("containment", [0.0, 0.7, 1.0])
def test_hottest_inlet_is_continuous_in_load(
    containment: float, units: int, supply_c: float
) -> None:
    config = load_config(
        "corrected", [f"hall.layout.containment={containment}", f"hvac.crac.units={units}"]
    )
    inlets_c = simulated_at(config, supply_c, np.linspace(0.0, 1.0, 401)).inlet_max_c
    # A quarter of a percent of load; without containment inlets rise by 10 K over all of it.
    assert np.max(np.abs(np.diff(inlets_c))) < 0.1


def test_design_supply_air_moves_the_design_point() -> None:
    for supply_c in (18.0, 26.0):
        config = load_config("corrected", [f"hall.design_supply_c={supply_c}"])
        shown = solve_design_hall(config)
        assert shown.supply_c == supply_c
        assert shown.approach_k.mean() == pytest.approx(5.15, abs=0.05)
        assert_at_design(shown, simulated(config, supply_c))


def test_fans_cover_what_their_racks_need_and_no_more() -> None:
    low = 0.6
    config = load_config(
        "corrected",
        [
            "hall.layout.containment=0.8",
            "hall.design_supply_c=28",
            "hvac.crac.units=2",
            f"hvac.crac.min_flow_ratio={low}",
        ],
    )
    # Server fans turn faster above 25 C.
    cool, warm = simulated(config, 18.0), simulated(config, 28.0)
    shown = solve_design_hall(config)
    assert np.all(cool.unit_airflow_m3s < warm.unit_airflow_m3s)
    np.testing.assert_allclose(warm.unit_airflow_m3s, shown.unit_m3s, rtol=1e-6)
    idle = simulated(config, 18.0, load=0.0)
    np.testing.assert_allclose(idle.unit_airflow_m3s, low * shown.unit_m3s, rtol=1e-6)
    # Between lowest and full speed racks breathe the exhaust that their share says, no more.
    assert cool.inlet_mean_c[0] - 18.0 < 0.3 * 5.15
