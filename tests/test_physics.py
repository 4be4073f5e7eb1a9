"""What the presets say as a whole: where the best setpoint lies, and what a year uses."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sdc_taichi import Simulator, drivers_from_arrays, load_config, make_configs, with_values
from sdc_taichi.exogenous import read_epw, site_names

EXAMPLES = Path(__file__).parent.parent / "examples"


def _example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def study() -> ModuleType:
    return _example("setpoint_study")


@pytest.mark.repo
def test_best_setpoint_of_corrected_moves_with_weather_and_load(study: ModuleType) -> None:
    setpoints = np.arange(16.0, 24.0)
    wet_bulb, load = np.arange(-5.0, 28.0, 4.0), np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    power = study.power_kw("corrected", wet_bulb, load, setpoints)
    best = setpoints[power.argmin(axis=2)]
    interior = (best > 16.0) & (best < 23.0)
    assert len(np.unique(best)) >= 4
    assert len(np.unique(best[interior])) >= 3
    assert interior.mean() > 0.2
    assert any(len(np.unique(column)) > 2 for column in best.T), "moves with weather"
    assert any(len(np.unique(row)) > 2 for row in best), "moves with load"
    # Fans turn faster above 25 C alone, so the coldest air is not the best in summer.
    assert np.all(best[wet_bulb >= 15.0] > 17.0)


@pytest.mark.repo
@pytest.mark.parametrize("site", ["NY", "CA", "WA"])
def test_coldest_setpoint_is_best_in_the_released_code(study: ModuleType, site: str) -> None:
    setpoints = np.append(np.arange(15.0, 21.5), 21.6)
    wet_bulb, load = np.arange(-5.0, 28.0, 4.0), np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    power = study.power_kw("sustaindc", wet_bulb, load, setpoints, (f"site.location={site}",))
    coldest = power.argmin(axis=2) == 0
    # Sized for 50 C it holds everywhere; sized for NY or WA at all but the hottest corner.
    assert coldest.all() if site == "CA" else coldest.mean() > 0.7


def test_annual_pue_of_all_sites_is_that_of_real_plants() -> None:
    base = load_config("corrected", ["simulation.steps_per_hour=1"])
    sites = [name for name in site_names() if len(name) == 2]
    assert len(sites) >= 8
    # Ten days of every month, side by side.
    of_months = [
        with_values(config, {"site.start": f"{month:02d}-10", "name": f"{config.name}-{month}"})
        for month in range(1, 13)
        for config in make_configs(base, sites=sites)
    ]
    with Simulator(of_months) as sim:
        sim.reset()
        it_kwh, facility_kwh = np.zeros(sim.size), np.zeros(sim.size)
        for _ in range(240):
            result = sim.step()
            it_kwh += result.it_kwh
            facility_kwh += result.facility_kwh
    pue = facility_kwh.reshape(12, -1).sum(axis=0) / it_kwh.reshape(12, -1).sum(axis=0)
    assert np.all((pue > 1.05) & (pue < 1.7)), dict(zip(sites, pue.round(3), strict=True))
    hot, cold = sites.index("AZ"), sites.index("WA")
    assert pue[hot] > pue[cold]


def test_measured_years_agree_with_synthetic_years(real_data: Path) -> None:
    configs = []
    for site in ("AZ", "NY", "WA"):
        base = load_config("corrected", [f"site.location={site}", "simulation.steps_per_hour=1"])
        (weather,) = real_data.glob(f"weather/USA_{site}_*.epw")
        (carbon,) = real_data.glob(f"carbon/{site}_NG_*.csv")
        design = read_epw(weather).design
        assert design is not None
        sized = {
            "hvac.sizing.design_outdoor_c": design.outdoor_c,
            "hvac.sizing.design_wet_bulb_c": design.wet_bulb_c,
        }
        files = {
            "site.weather_file": str(weather),
            "site.carbon_file": str(carbon),
            "site.workload_file": str(real_data / "workload" / "Alibaba_CPU_Data_Hourly_1.csv"),
        }
        configs += [with_values(base, sized | files), with_values(base, sized)]
    names = ("it_kwh", "hvac_kwh", "grid_kwh", "carbon_g", "water_l")
    with Simulator(configs) as sim:
        sim.reset()
        steps = [sim.step() for _ in range(8760)]
    for name in names:
        sums = np.sum([getattr(result, name) for result in steps], axis=0)
        np.testing.assert_allclose(sums[1::2], sums[0::2], rtol=0.04, err_msg=name)


def test_a_room_that_overheats_recovers_when_load_falls() -> None:
    small = ["hvac.sizing.margin=1", "hvac.sizing.design_wet_bulb_c=10"]
    config = load_config("corrected", ["hvac.chiller.model=electric_water_cooled", *small])
    demand = [1.0] * 40 + [0.1] * 460
    drivers = drivers_from_arrays([36.0] * 500, [30.0] * 500, [300.0] * 500, demand)
    with Simulator(config, drivers=drivers) as sim:
        sim.reset()
        results = [sim.step() for _ in range(500)]
        highest_w = 1.3 * sum(g.count * g.full_w for rack in config.rack_groups() for g in rack)
    inlet_c = np.array([r.inlet_max_c[0] for r in results])
    assert inlet_c.max() > 45.0
    assert max(float(r.it_w[0]) for r in results) < highest_w
    assert results[-1].room_heat_kwh[0] == 0.0
    assert results[-1].supply_c[0] == results[0].supply_c[0]
    assert inlet_c[-1] < inlet_c[0], "less load, less recirculated heat"


@pytest.mark.parametrize("preset", ["corrected", "large", "tiny"])
def test_return_air_is_no_hotter_than_the_hottest_server(preset: str) -> None:
    """The air of the hall closes: CRAC airflow, server airflow and approach fit each other."""
    demand = np.linspace(0.0, 1.0, 21)
    flat = np.full_like(demand, 20.0)
    for setpoint_c in (16.0, 23.0):
        config = load_config(preset, [f"hvac.setpoint.initial_c={setpoint_c}"])
        drivers = drivers_from_arrays(flat, flat - 5.0, flat, demand)
        with Simulator(config, drivers=drivers, precision="f64") as sim:
            sim.reset()
            for _ in demand:
                result = sim.step()
                assert result.return_c[0] <= sim.servers().outlet_c.max() + 1e-9


def test_server_fans_draw_what_is_published() -> None:
    config = load_config("corrected", ["simulation.steps_per_hour=1"])
    with Simulator(config) as sim:
        sim.reset()
        steps = [sim.step() for _ in range(24 * 28)]
    share = sum(float(r.it_fan_w[0]) for r in steps) / sum(float(r.it_w[0]) for r in steps)
    assert 0.02 < share < 0.06
    # A server at 31, 33 and 35 C draws 2.8, 4.6 and 7.8 % more than at 27 C (McManis 2016).
    curves, load = config.servers.curves, np.array(0.7)
    reference = config.servers.fan_reference_share
    assert reference is not None

    def server_w(inlet_c: float) -> float:
        inlet = np.array(inlet_c)
        fan_w = curves.fan_w(curves.airflow_ratio(inlet, load), reference)
        return float(curves.cpu_w(inlet, load, np.ones(1), np.zeros(1))[0] + fan_w)

    assert server_w(27.0) / server_w(20.0) < 1.03
    for inlet_c, measured in ((31.0, 1.028), (33.0, 1.046), (35.0, 1.078)):
        assert server_w(inlet_c) / server_w(27.0) == pytest.approx(measured, abs=0.015)
    # Fans at full speed draw 12 to 21 % of what servers draw without them.
    most = curves.fan_w(np.array(curves.fan_high), reference)
    assert 0.12 < float(most) < 0.21
