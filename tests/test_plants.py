"""Plants as a whole: what they remove in any weather, and what they cannot be made of."""

from __future__ import annotations

import numpy as np
import pytest

from sdc_taichi import Simulator, drivers_from_arrays, load_config
from sdc_taichi.config import apply_overrides
from sdc_taichi.plant.chiller import CHILLERS

WATER_COOLED = ["centrifugal_vsd", "carnot", "eir_york", "electric_water_cooled", "constant_cop"]


@pytest.mark.parametrize("economiser", ["true", "false"])
@pytest.mark.parametrize("model", WATER_COOLED)
def test_full_load_is_removed_in_any_weather(model: str, economiser: str) -> None:
    base = load_config(
        "corrected",
        [f"hvac.chiller.model={model}", f"hvac.tower.economiser={economiser}",
         "hvac.sizing.design_wet_bulb_c=26", "hvac.sizing.design_outdoor_c=33",
         "workload.max_utilisation=1"],
    )  # fmt: skip
    weather = [(-20.0, 16), (-10.0, 18), (-10.0, 23), (5.0, 20), (15.0, 16), (26.0, 16), (26.0, 23)]
    configs = [apply_overrides(base, [f"hvac.setpoint.initial_c={c}"]) for _, c in weather]
    wet_bulb_c = np.array([[wet_bulb_c] for wet_bulb_c, _ in weather])
    full = np.ones_like(wet_bulb_c)
    with Simulator(
        configs, drivers=drivers_from_arrays(wet_bulb_c + 5.0, wet_bulb_c, 300.0 * full, full)
    ) as sim:
        sim.reset()
        for _ in range(3):
            result = sim.step()
    np.testing.assert_array_equal(result.unmet_w, 0.0)
    np.testing.assert_allclose(result.heat_removed_w, result.cooling_load_w, rtol=1e-12)
    np.testing.assert_allclose(result.supply_c, result.setpoint_c, atol=1e-4)


def test_york_machine_is_sized_for_cold_condenser_water() -> None:
    drivers = drivers_from_arrays([20.0], [15.0], [300.0], [0.5])
    overrides = ["hvac.chiller.model=eir_york", "hvac.sizing.design_wet_bulb_c=26"]
    with Simulator(load_config("corrected", overrides), drivers=drivers) as sim:
        design = sim.sizing.water_side
    for condenser_c in np.linspace(12.78, 30.0, 9):
        for chilled_c in (8.0, 8.89):
            machine = CHILLERS["eir_york"](
                design.cooling_w,
                reference_w=design.chiller_w,
                chilled_water_c=chilled_c,
                condenser_c=condenser_c,
                outdoor_c=0.0,
                reference_cop=5.96,
            )
            assert machine.unmet_w <= 1e-9 * design.cooling_w


@pytest.mark.parametrize(("model", "warmest_c"), [("eir_york", 8.89), ("centrifugal_vsd", 20.0)])
def test_plant_makes_no_warmer_water_than_its_chiller_is_valid_for(
    model: str, warmest_c: float
) -> None:
    base = load_config("corrected", [f"hvac.chiller.model={model}", "hvac.setpoint.max_c=30"])
    configs = [apply_overrides(base, [f"hvac.setpoint.initial_c={c}"]) for c in (16, 23, 30)]
    drivers = drivers_from_arrays([20.0], [15.0], [300.0], [0.5], size=3)
    with Simulator(configs, drivers=drivers) as sim:
        sim.reset()
        result = sim.step()
    expected_c = np.minimum([8.0, 15.0, 22.0], warmest_c)
    np.testing.assert_allclose(result.chilled_water_c, expected_c, rtol=1e-12)
