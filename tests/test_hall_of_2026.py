"""The showcase: preset ``hall_of_2026`` loads, is cooled, and tells where it is hot."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from sdc_taichi import DataCenterConfig, Simulator, load_config
from sdc_taichi.errors import SdcWarning
from sdc_taichi.hall.air_metrics import ALLOWABLE_C, RECOMMENDED_C
from sdc_taichi.sim.design_hall import DesignHall, solve_design_hall
from sdc_taichi.sim.drivers import drivers_from_arrays
from sdc_taichi.sim.fleet_configs import make_configs

NAME = "hall_of_2026"


@pytest.fixture(scope="module")
def config() -> DataCenterConfig:
    with warnings.catch_warnings():
        warnings.simplefilter("error", SdcWarning)
        return load_config(NAME)


@pytest.fixture(scope="module")
def hall(config: DataCenterConfig) -> DesignHall:
    with warnings.catch_warnings():
        warnings.simplefilter("error", SdcWarning)
        return solve_design_hall(config)


def test_all_inlets_are_recommended_at_the_design_point(hall: DesignHall) -> None:
    assert hall.inlet_max_c.max() < RECOMMENDED_C[1]
    assert hall.air is not None
    assert 95.0 < hall.air.rti_pct < 110.0
    rise_k = hall.outlet_c - hall.inlet_c
    assert 10.0 < rise_k.min() < rise_k.max() < 22.0


def test_the_block_with_accelerators_is_hottest(hall: DesignHall) -> None:
    row, place = np.divmod(hall.inlets.hottest(5), 18)
    assert np.all((row >= 4) & (row <= 7))
    assert np.all((place >= 4) & (place <= 13))


def test_any_unit_may_be_lost(config: DataCenterConfig) -> None:
    """Each of six copies loses another unit at full load; the last loses two."""
    lost = [f"{{kind: crac_down, unit: {k}, start_h: 0, duration_h: 1}}" for k in range(6)]
    losses = [*lost, f"{lost[2]}, {lost[3]}"]
    copies = make_configs(config, count=len(losses))
    events = [load_config(NAME, [f"events.scheduled=[{loss}]"]).events for loss in losses]
    configs = [c.model_copy(update={"events": e}) for c, e in zip(copies, events, strict=True)]
    inputs = drivers_from_arrays([33.0], [26.0], [300.0], [1.0], size=len(losses))
    with Simulator(configs, drivers=inputs) as sim:
        sim.reset()
        result = sim.step()
    assert result.inlet_max_c[:6].max() < ALLOWABLE_C["A1"][1]
    assert np.all(result.throttled_racks[:6] == 0)
    assert result.inlet_max_c[6] > result.inlet_max_c[2:4].max() + 3.0


@pytest.mark.parametrize("thermal", ["quasi_steady", "transient"])
def test_heat_of_every_step_is_accounted_for(thermal: str) -> None:
    down = "{kind: crac_down, unit: 2, start_h: 0.5, duration_h: 1}"
    overrides = [f"simulation.thermal={thermal}", f"events.scheduled=[{down}]"]
    inputs = drivers_from_arrays([33.0], [26.0], [300.0], [1.0])
    with Simulator(load_config(NAME, overrides), drivers=inputs, precision="f64") as sim:
        sim.reset()
        before_kwh = np.zeros(1)
        for _ in range(8):
            r = sim.step()
            given_w = r.it_w + r.crac_fan_w - r.thermal_storage_w - r.heat_removed_w
            held_kwh = r.room_heat_kwh - before_kwh
            left_kwh = given_w * r.step_h / 1e3 - held_kwh
            assert abs(left_kwh[0]) < 1e-9 * r.it_kwh[0]
            before_kwh = r.room_heat_kwh
