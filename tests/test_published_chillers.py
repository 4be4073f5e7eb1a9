"""The default chillers against published curves and catalogues.

Air-cooled: Trane CGAF, catalogue CG-PRC007-EN (2003), energy efficiency ratios that include the
condenser fans, along the load line of AHRI 550/590; and curves of screw and scroll machines and of
ASHRAE 90.1-2010, path A, in the OpenStudio standards (NREL), after DOE-2.

Water-cooled, with variable speed:
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
from sdc_taichi.plant.chiller import CHILLERS, ChillerParameters, ChillerResult
from sdc_taichi.plant.plants import PLANTS, Devices, PlantPoint, default_chiller, water_cooled
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water_side import WaterSideDesign
from sdc_taichi.types import F64, WaterSideResult, fields_of

TRANE_EIR = (6.287646e-01, -3.024605e-02, 6.137016e-04, 1.805826e-02, 1.640653e-04,
             -1.113802e-04)  # fmt: skip
TRANE_COP, TRANE_LEAST_LOAD = 6.61, 0.1
TRANE_CHILLED_C, TRANE_CONDENSER_C = (4.44, 8.89), (12.78, 35.0)


def trane_eir(chilled_c: F64, condenser_c: F64) -> F64:
    """Full-load power over cooling of the published curves, evaluated within their bounds."""
    water = np.clip(chilled_c, *TRANE_CHILLED_C), np.clip(condenser_c, *TRANE_CONDENSER_C)
    return np.asarray(chiller.biquadratic(TRANE_EIR, *water) / TRANE_COP)


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
    ratio = machine.power_w / machine.evaporator_w / trane_eir(chilled_c[lift], condenser_c[lift])
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


# Air-cooled machines

CGAF_OUTDOOR_C = np.array([12.8, 18.5, 29.2, 35.0])
CGAF_LOAD = np.array([0.32, 0.52, 0.82, 1.0])
"""Cooling divided by that at 35 C and full load."""
CGAF_COP = np.array([17.6, 14.8, 11.9, 9.7]) * 0.29307
CURVES = {
    "screw": (
        (0.985959, 0.049487, -0.000298, -0.003737, -4.5e-05, -0.000502),
        (0.570624, 0.011954, -0.000522, -3.2e-05, 0.000421, -0.000606),
    ),
    "scroll": (
        (1.05229229, 0.033560892, 0.000215, -0.005180832, -4.42e-05, -0.000215),
        (0.58333562, -0.004036194, 0.000468, -0.000224478, 0.000481, -0.000682),
    ),
    "path A": (
        (1.0433825, 0.0407073, 0.0004506, -0.0041514, -8.86e-5, -0.0003467),
        (0.5961915, -0.0099496, 0.0007888, 0.0004506, 0.0004875, -0.0007623),
    ),
}
"""Capacity and energy input ratio by chilled water and outdoor air, in C."""


def air_cooled(load: F64, outdoor_c: F64, chilled_c: F64 | float, cop: float) -> ChillerResult:
    return chiller_step(
        default_chiller(PLANTS["air_cooled"]),
        1e6 * load,
        reference_w=1e6,
        chilled_water_c=chilled_c,
        condenser_c=0.0,
        outdoor_c=outdoor_c,
        reference_cop=cop,
    )


def test_air_cooled_default_follows_a_catalogue_over_temperature_and_load() -> None:
    config = load_config("corrected", ["hvac.plant=air_cooled"])
    cop = CHILLERS[config.hvac.chiller_in_use].reference_cop
    machine = air_cooled(CGAF_LOAD, CGAF_OUTDOOR_C, 6.67, cop)
    np.testing.assert_allclose(machine.cop, CGAF_COP, rtol=0.035)


@pytest.mark.parametrize("name", CURVES)
def test_air_cooled_default_follows_published_curves_at_full_load(name: str) -> None:
    chilled_c, outdoor_c = np.meshgrid(np.linspace(4.44, 10, 9), np.linspace(23.89, 46.11, 20))
    capacity, eir = (
        chiller.biquadratic(c, chilled_c, outdoor_c) / chiller.biquadratic(c, 6.67, 35.0)
        for c in CURVES[name]
    )
    machine = air_cooled(np.full_like(outdoor_c, 9.0), outdoor_c, chilled_c, 3.0)
    np.testing.assert_allclose(machine.available_w / 1e6, capacity, rtol=0.05)
    np.testing.assert_allclose(machine.cop, 3.0 / np.asarray(eir), rtol=0.05)


def test_air_cooled_default_needs_published_energy_in_every_climate() -> None:
    sites = [name for name in site_names() if len(name) == 2]
    configs = make_configs(load_config("corrected", ["simulation.steps_per_hour=1"]), sites=sites)
    with Simulator(configs) as sim:
        hours = np.repeat(np.arange(8760)[None], len(sites), axis=0)
        weather_c = sim.drivers.outdoor_c.at(hours)
    for site, outdoor_c in zip(sites, weather_c, strict=True):
        # The catalogue gives the machine on its load line alone.
        load = np.interp(outdoor_c, CGAF_OUTDOOR_C, CGAF_LOAD)
        published_w = 1e6 * load / np.interp(outdoor_c, CGAF_OUTDOOR_C, CGAF_COP)
        machine = air_cooled(load, outdoor_c, 6.67, 2.84)
        assert machine.power_w.sum() == pytest.approx(published_w.sum(), rel=0.05), site
        # The curves are extrapolated to their smallest energy input ratio, at 6 to 7 C.
        for name in ("scroll", "path A"):
            curve = CURVES[name][1]
            reach_c = np.arange(0.0, 20.0, 0.1)
            coldest_c = reach_c[np.argmin(chiller.biquadratic(curve, 10.0, reach_c))]
            eir = chiller.biquadratic(curve, 10.0, np.maximum(outdoor_c, coldest_c))
            published = np.mean(np.asarray(eir / chiller.biquadratic(curve, 6.67, 35.0)))
            machine = air_cooled(np.full_like(outdoor_c, 9.0), outdoor_c, 10.0, 1.0)
            ratio = np.mean(1.0 / machine.cop) / published
            assert ratio == pytest.approx(1.0, abs=0.05), (site, name)
