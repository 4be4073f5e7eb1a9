"""The default chiller against the published curves of a machine with variable speed.

Trane CVHE, 1442 kW, COP 6.61, variable-speed drive: Modelica Buildings library (LBNL),
Fluid.Chillers.Data.ElectricEIR. Of the 25 sets of machines with variable speed there, its energy
over a year at the water temperatures of these plants is the median, and it is the one whose curves
reach 35 C of condenser water.
"""

from __future__ import annotations

import numpy as np
import pytest

from model_steps import chiller_step
from sdc_taichi import Simulator, load_config, make_configs
from sdc_taichi.exogenous import site_names
from sdc_taichi.plant import chiller
from sdc_taichi.plant.chiller import CHILLERS, ChillerParameters
from sdc_taichi.plant.plants import Devices, PlantPoint, water_cooled
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water_side import WaterSideDesign
from sdc_taichi.types import F64, WaterSideResult, fields_of

TRANE_CAPACITY = (4.007341e-01, 1.148568e-03, 1.049504e-04, 5.574667e-02, -1.646131e-03,
                  1.323200e-03)  # fmt: skip
TRANE_EIR = (6.287646e-01, -3.024605e-02, 6.137016e-04, 1.805826e-02, 1.640653e-04,
             -1.113802e-04)  # fmt: skip
TRANE_COP, TRANE_LEAST_LOAD = 6.61, 0.1
TRANE_CHILLED_C, TRANE_CONDENSER_C = (4.44, 8.89), (12.78, 35.0)


def trane_eir(chilled_c: F64, condenser_c: F64) -> F64:
    """Full-load power over cooling of the published curves, evaluated within their bounds."""
    water = np.clip(chilled_c, *TRANE_CHILLED_C), np.clip(condenser_c, *TRANE_CONDENSER_C)
    return np.asarray(chiller._biquadratic(TRANE_EIR, *water) / TRANE_COP)


def trane_w(plant: WaterSideResult, design: WaterSideDesign) -> F64:
    """Power of the published curves for the load and water of a plant, of the plant's capacity."""
    available_w = design.chiller_w
    condenser_c = np.maximum(plant.condenser_water_c, design.min_condenser_c)
    plr = np.minimum(plant.chiller_load_w / available_w, 1.0)
    a, b, c = chiller.VSD_PART_LOAD
    running = np.maximum(plr, TRANE_LEAST_LOAD)
    part_load = (a + b * running + c * running**2) * np.minimum(plr / TRANE_LEAST_LOAD, 1.0)
    return available_w * trane_eir(plant.chilled_water_c, condenser_c) * part_load


def test_default_follows_the_published_map_at_full_load() -> None:
    chilled_c, condenser_c = np.meshgrid(np.linspace(4.44, 8.89, 10), np.linspace(12.78, 35, 30))
    lift = condenser_c - chilled_c >= chiller.MIN_LIFT_K
    machine = chiller_step(
        "centrifugal_vsd",
        np.full(lift.sum(), 1e6),
        reference_w=1e6,
        chilled_water_c=chilled_c[lift],
        condenser_c=condenser_c[lift],
        outdoor_c=0.0,
        reference_cop=5.97,
    )
    ratio = machine.power_w / 1e6 / trane_eir(chilled_c[lift], condenser_c[lift])
    assert np.all(np.abs(ratio - 1.0) < 0.03)
    assert abs(ratio.mean() - 1.0) < 0.005


def test_default_needs_the_energy_of_published_curves_in_every_climate() -> None:
    sites = [name for name in site_names() if len(name) == 2]
    assert len(sites) >= 8
    configs = make_configs(load_config("corrected", ["simulation.steps_per_hour=1"]), sites=sites)
    with Simulator(configs) as sim:
        design, weather = fields_of(sim.sizing.water_side), sim.drivers
        it_w, machines = sim.sizing.it_w, design.pop("machine")
    cops, hours = {}, np.arange(8760)
    for dc, site in enumerate(sites):
        outdoor_c, wet_bulb_c = (
            series.at(np.repeat(hours[None], len(sites), axis=0))[dc]
            for series in (weather.outdoor_c, weather.wet_bulb_c)
        )
        machine = ChillerParameters(*(values[dc] for values in machines))
        own = WaterSideDesign(
            machine=machine, **{name: values[dc] for name, values in design.items()}
        )
        for setpoint_c, load in ((18.0, 0.5), (18.0, 0.9), (22.0, 0.5)):
            plant = water_cooled(
                np.full(len(hours), load * it_w[dc]),
                PlantPoint(
                    setpoint_c=np.full(len(hours), setpoint_c),
                    water_setpoint_c=np.full(len(hours), setpoint_c),
                    return_c=np.full(len(hours), setpoint_c + 12.0),
                    airflow_m3s=own.tower_air_m3s,
                    outdoor_c=outdoor_c,
                    wet_bulb_c=wet_bulb_c,
                ),
                own,
                Devices(CHILLERS["centrifugal_vsd"], TOWERS["yorkcalc"], limited=True),
            )
            published_kwh = trane_w(plant, own).sum() / 1e3
            if setpoint_c == 18.0:
                assert plant.chiller_w.sum() / 1e3 == pytest.approx(published_kwh, rel=0.1), site
            else:
                # The curves end at 8.89 C of chilled water; warmer water saves 3 % per kelvin.
                assert 0.75 < plant.chiller_w.sum() / 1e3 / published_kwh < 1.0, site
            cops[site, setpoint_c, load] = plant.chiller_load_w.sum() / plant.chiller_w.sum()
    assert all(7.0 < cop < 14.0 for cop in cops.values()), cops
