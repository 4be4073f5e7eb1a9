"""Components and a facility beside EnergyPlus 25.2, on tables that it wrote.

``SDC_REFERENCE_DIR`` names folders of such tables in place of ``reference/energyplus``, whose
README says how each was made. Settings that a table does not hold are those of that README.
"""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_steps import chiller_step
from reference_folders import energyplus_tables
from sdc_taichi import (
    Simulator,
    build_fleet,
    drivers_from_arrays,
    load_config,
    make_configs,
)
from sdc_taichi.exogenous import psychrometrics
from sdc_taichi.plant import chiller, tower, water
from sdc_taichi.sim import stages
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.sim.sizing import Sizing, size
from sdc_taichi.types import F64


def columns(path: Path) -> dict[str, F64]:
    """Columns of a table by their names, (T,) each."""
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    return dict(zip(head, np.array(rows, dtype=np.float64).T, strict=True))


def by_name(path: Path) -> str:
    return path.stem


# Moist air


@pytest.mark.parametrize("path", energyplus_tables("psychrometrics*.csv"), ids=by_name)
def test_wet_bulb(path: Path) -> None:
    table = columns(path)
    wet_bulb_c = psychrometrics.wet_bulb_c(
        table["outdoor_c"], table["relative_humidity_pct"], table["pressure_pa"]
    )
    apart_k = np.abs(wet_bulb_c - table["wet_bulb_c"])
    # Just above 0 C two wet bulbs meet the equations, over water and over ice.
    two_fold = (table["wet_bulb_c"] >= 0.0) & (table["wet_bulb_c"] <= 0.1)
    assert apart_k[~two_fold].max() < 1e-3
    assert apart_k[two_fold].max(initial=0.0) < 0.4


@pytest.mark.parametrize("path", energyplus_tables("psychrometrics*.csv"), ids=by_name)
def test_humidity_ratio(path: Path) -> None:
    table = columns(path)
    ratio = psychrometrics.humidity_ratio(
        table["outdoor_c"], table["relative_humidity_pct"], table["pressure_pa"]
    )
    np.testing.assert_allclose(ratio, table["humidity_ratio"], rtol=5e-4)


# Servers

SERVERS = 4000
RACKS = 100
SERVER_W = 130.0, 10.0
FAN_W = 10.0
ITE = [
    *("hall.rows=1", "hall.racks_per_row=1", f"hall.servers_per_rack={SERVERS // RACKS}"),
    *("hall.inlet_model=approach", "hall.supply_approach_k=5.15"),
    "hall.return_approach_k=-3.1",
    *(f"servers.power_w={list(SERVER_W)}", f"servers.fan_reference_w={FAN_W}"),
    *("servers.fan_reference_ratio=1", "servers.fan_power_exponent=3"),
    *("servers.cpu_power_ratio_lb=[0.01, 1]", "servers.cpu_power_ratio_ub=[0.03, 1.02]"),
    *("servers.fan_airflow_ratio_lb=[0.01, 0.225]", "servers.fan_airflow_ratio_ub=[0.225, 1]"),
    *("servers.fan_airflow_ratio_limits=[0.2, 1]", "hvac.sizing.model=design_day"),
]


@pytest.mark.parametrize("path", energyplus_tables("ite_*.csv"), ids=by_name)
def test_servers(path: Path) -> None:
    table = columns(path)
    inlet_c, load = table["inlet_c"], table["utilisation"]
    curves = load_config("corrected", ITE).servers.curves
    ratio = curves.airflow_ratio(inlet_c, load)
    full_w, idle_w = (np.full(len(load), w) for w in SERVER_W)
    cpu_w = SERVERS * curves.cpu_w(inlet_c, load, full_w, idle_w)
    np.testing.assert_allclose(cpu_w, table["cpu_w"], rtol=1e-5)
    np.testing.assert_allclose(SERVERS * curves.fan_w(ratio, FAN_W), table["fan_w"], rtol=1e-4)
    full_m3s = np.median(table["airflow_m3s"] / ratio)
    np.testing.assert_allclose(full_m3s * ratio, table["airflow_m3s"], rtol=5e-5)


def elevation_m(table: dict[str, F64]) -> float:
    """Height above sea level of the standard atmosphere whose dry air is as dense as the table's.

    Air of 2 g of water per kg is 0.3 % lighter than dry air.
    """
    density_kg_m3 = table["air_kg_s"] / table["airflow_m3s"]
    pressure_pa = 1.003 * np.median(density_kg_m3 * 287.05 * (table["inlet_c"] + 273.15))
    return height_m(float(pressure_pa))


def height_m(pressure_pa: float) -> float:
    """Height above sea level of a pressure of the standard atmosphere, m."""
    return float((1.0 - (pressure_pa / 101_325.0) ** (1.0 / 5.2559)) / 2.25577e-5)


def header_at(folder: Path, elevation_m: float) -> Path:
    """A weather file of which the height above sea level is read, and nothing else."""
    path = folder / "site.epw"
    path.write_text(f"LOCATION,Site,-,-,-,0,0.0,0.0,0.0,{elevation_m:.1f}\n")
    return path


@pytest.mark.parametrize("path", energyplus_tables("ite_*.csv"), ids=by_name)
def test_outlets_of_servers(path: Path, tmp_path: Path) -> None:
    """All rows at once, as copies of one rack at a site as high as that of the table."""
    table = columns(path)
    weather = header_at(tmp_path, elevation_m(table))
    ratio = load_config("corrected", ITE).servers.curves.airflow_ratio(
        table["inlet_c"], table["utilisation"]
    )
    full_m3s = np.median(table["airflow_m3s"] / ratio) / SERVERS
    approach_k = np.median(table["inlet_c"] - table["supply_c"])
    own = [
        f"servers.fan_full_airflow_m3s={full_m3s:.12g}",
        f"hall.supply_approach_k={approach_k:.12g}",
        f"site.weather_file={weather}",
    ]
    fleet = build_fleet(make_configs(load_config("corrected", [*ITE, *own]), count=len(ratio)))
    met = Conditions(table["inlet_c"] - approach_k, table["utilisation"])
    sums = Hall(fleet, "f64").solve(met)
    np.testing.assert_allclose(RACKS * sums.cpu_w, table["cpu_w"], rtol=1e-5)
    np.testing.assert_allclose(RACKS * sums.it_fan_w, table["fan_w"], rtol=1e-4)
    at_inlet_m3s = RACKS * sums.it_airflow_m3s * (table["inlet_c"] + 273.15) / 293.15
    np.testing.assert_allclose(at_inlet_m3s, table["airflow_m3s"], rtol=1e-3)
    apart_k = sums.rack_outlet_c - table["outlet_c"]
    assert np.abs(apart_k).max() < 0.1
    if path.stem == "ite_chicago":
        # O'Hare is 201.8 m high.
        assert elevation_m(table) == pytest.approx(201.8, abs=5.0)


# Tower

TOWERS = energyplus_tables("tower_yorkcalc_*.csv")
DRIFT_SHARE = 2e-5
DESIGN_RANGE_K = 5.56
DESIGN = {"wet_bulb_c": 25.55, "range_k": DESIGN_RANGE_K, "approach_k": 4.0}
FAN_W_PER_KG_S = 24_000.0 / 51.584


def water_kg_m3(temperature_c: F64 | float) -> F64:
    """Density of water (Kell 1975, as in Jones and Harris 1992)."""
    t = np.asarray(temperature_c)
    falling = (t - 3.9863) ** 2 * (t + 288.9414) / (508_929.2 * (t + 68.12963))
    return 999.974 * (1.0 - falling)


def design_water_kg_s(table: dict[str, F64]) -> float:
    """Condenser water flow at design; drift is a share of it, of water at the outdoor air."""
    litres = np.median(table["drift_l"] / table["air_ratio"])
    return float(litres * 0.998 / 3600.0 / DRIFT_SHARE)


def run_tower(table: dict[str, F64]) -> tower.TowerResult:
    """The tower of a table; EnergyPlus counts flow ratios by the volume of the entering water."""
    design_kg_s = design_water_kg_s(table)
    reference_kg_s = tower.yorkcalc_reference_water_kg_s(design_kg_s, **DESIGN)
    by_volume = water_kg_m3(table["entering_c"]) / water_kg_m3(5.05)
    return tower.yorkcalc(
        table["heat_w"],
        tower.TowerPoint(
            wet_bulb_c=table["wet_bulb_c"],
            outdoor_c=table["outdoor_c"],
            air_j_per_m3_k=0.0,
            condenser_setpoint_c=table["setpoint_c"],
            supply_setpoint_c=0.0,
            water_kg_s=table["water_kg_s"],
            reference_water_kg_s=reference_kg_s * by_volume,
            reference_air_m3s=0.0,
            design_fan_w=FAN_W_PER_KG_S * design_kg_s,
        ),
    )


@pytest.mark.parametrize("path", TOWERS, ids=by_name)
def test_tower(path: Path) -> None:
    table = columns(path)
    found = run_tower(table)
    rows = table["consistent"] == 1.0
    assert np.abs(found.leaving_c - table["leaving_c"])[rows].max() < 0.05
    np.testing.assert_allclose(found.fan_w[rows], table["fan_w"][rows], rtol=0.01)


@pytest.mark.parametrize("path", TOWERS, ids=by_name)
def test_tower_fan_goes_off_in_the_same_hours(path: Path) -> None:
    """Regime 1 is a fan that modulates, 0 one that goes on and off, or stands still."""
    table = columns(path)
    found = run_tower(table)
    modulating = (table["regime"] == 1.0) & (table["consistent"] == 1.0)
    assert (found.fan_w[modulating] > 0.0).all()
    cycling = table["regime"] == 0.0
    same = cycling & (found.air_ratio < tower.MIN_AIR_RATIO)
    assert same.sum() >= 0.95 * cycling.sum()
    assert np.abs(found.air_ratio - table["air_ratio"])[same].max(initial=0.0) < 0.03


# Water of the tower

DESIGN_AIR_M3S_PER_KG_S = 32.0 / 51.584
CYCLES = 5.0


@pytest.mark.parametrize("path", TOWERS, ids=by_name)
def test_evaporation(path: Path) -> None:
    """Heat, air and weather give the litres of the year, and those of every 5 K of weather."""
    table = columns(path)
    used = water.saturated_exit(
        water.WaterPoint(
            rejected_w=table["heat_w"],
            range_k=table["entering_c"] - table["leaving_c"],
            water_kg_s=table["water_kg_s"],
            tower_airflow_m3s=run_tower(table).air_ratio
            * (DESIGN_AIR_M3S_PER_KG_S * design_water_kg_s(table)),
            outdoor_c=table["outdoor_c"],
            wet_bulb_c=table["wet_bulb_c"],
            pressure_pa=table["pressure_pa"],
            return_c=0.0,
            supply_setpoint_c=0.0,
            cycles_of_concentration=CYCLES,
            drift_share=DRIFT_SHARE,
            dt_s=3600.0,
        )
    )
    for name in ("evaporation_l", "water_l"):
        expected_l = table["makeup_l" if name == "water_l" else name]
        found_l = getattr(used, name)
        assert found_l.sum() == pytest.approx(expected_l.sum(), rel=0.05)
        bins = np.floor(table["outdoor_c"] / 5.0)
        for warmth in np.unique(bins):
            hours = bins == warmth
            assert found_l[hours].sum() == pytest.approx(expected_l[hours].sum(), rel=0.1)


# Chillers


@pytest.mark.parametrize("path", energyplus_tables("chiller_eir_york*.csv"), ids=by_name)
def test_york_chiller(path: Path) -> None:
    table = columns(path)
    steady = table["cycling_ratio"] == 1.0
    reference_w = np.median((table["load_w"] / table["plr"] / table["capacity_factor"])[steady])
    factors = ("capacity_factor", "eir_factor_t", "eir_factor_plr", "cycling_ratio")
    full_w = reference_w * np.prod([table[name] for name in factors], axis=0)
    machine = chiller_step(
        "eir_york",
        table["load_w"],
        reference_w=reference_w,
        chilled_water_c=table["chilled_water_c"],
        condenser_c=table["condenser_c"],
        outdoor_c=0.0,
        reference_cop=float(np.median(full_w / table["power_w"])),
    )
    np.testing.assert_allclose(machine.power_w, table["power_w"], rtol=1e-9)
    np.testing.assert_allclose(machine.rejected_w, table["rejected_w"], rtol=1e-9)
    np.testing.assert_allclose(machine.unmet_w, 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "path", energyplus_tables("chiller_electric_water_cooled*.csv"), ids=by_name
)
def test_water_cooled_electric_chiller(path: Path) -> None:
    table = columns(path)
    machine = chiller_step(
        "electric_water_cooled",
        table["load_w"],
        reference_w=1e6,
        chilled_water_c=table["chilled_water_c"],
        condenser_c=table["condenser_c"],
        outdoor_c=0.0,
        reference_cop=4.75,
    )
    np.testing.assert_allclose(machine.power_w, table["power_w"], rtol=1e-9)


@pytest.mark.parametrize("path", energyplus_tables("chiller_electric_air_cooled*.csv"), ids=by_name)
def test_air_cooled_electric_chiller(path: Path) -> None:
    table = columns(path)
    machine = chiller_step(
        "electric_air_cooled",
        table["load_w"],
        reference_w=1e6,
        chilled_water_c=table["chilled_water_c"],
        condenser_c=0.0,
        outdoor_c=table["outdoor_c"],
        reference_cop=3.0,
    )
    delta_k = (table["outdoor_c"] - 35.0) / 2.778 - (table["chilled_water_c"] - 6.67)
    # EnergyPlus follows its parabola beyond the maximum.
    beyond = delta_k < chiller.MIN_DELTA_K
    apart = np.abs(machine.power_w / table["power_w"] - 1.0)
    assert apart[~beyond].max() < 1e-9
    assert apart[beyond].max(initial=0.0) < 3e-3


# One facility

CONFIG = [
    *ITE,
    *("hall.rows=4", "hall.racks_per_row=5", "hall.servers_per_rack=200"),
    *("hall.air_density_kg_m3=1.225", "simulation.steps_per_hour=1"),
    *("hvac.setpoint.initial_c=18", "hvac.crac.flow_model=follow_servers"),
    *("hvac.chiller.model=eir_york", "hvac.tower.economiser=false"),
    *("hvac.sizing.margin=1.35", "hvac.sizing.design_wet_bulb_c=25.5"),
    *("hvac.pumps.min_flow_ratio=1", "hvac.tower.setpoint=approach"),
]
"""Hall and plant of the README; CRAC units, coils and tower are those of ``corrected``."""
AIR_M3S_PER_W_REJECTED = 32.0 / 1.2e6


def resized(found: Sizing, given: dict[str, float]) -> Sizing:
    """Sizes of the table in place of those of the package."""
    of = {name: np.array([value]) for name, value in given.items()}
    water_side = replace(
        found.water_side,
        cooling_w=of["cooling_w"],
        pumped_w=of["cooling_w"],
        chiller_w=of["chiller_w"],
        rejected_w=of["rejected"],
        tower_water_kg_s=of["tower_water"],
        tower_reference_kg_s=tower.yorkcalc_reference_water_kg_s(
            of["tower_water"], wet_bulb_c=of["twb"], range_k=5.56, approach_k=4.0
        ),
        tower_air_m3s=AIR_M3S_PER_W_REJECTED * of["rejected"],
        tower_fan_w=of["tower_fan_w"],
        chilled_pump_w=of["chw_pump_w"],
        condenser_pump_w=of["cw_pump_w"],
    )
    return replace(
        found,
        it_w=of["it_w"],
        crac_flow_m3s=of["crac"],
        crac_fan_w=of["crac_w"],
        water_side=water_side,
    )


def elevation_of_site_m(path: Path) -> float:
    """Height of the site of a facility, by the pressure of its tower's table; else of O'Hare."""
    site = path.stem.removeprefix("facility_").removesuffix("_hourly")
    of_tower = [columns(x)["pressure_pa"] for x in energyplus_tables(f"tower_yorkcalc_{site}.csv")]
    return height_m(float(np.mean(of_tower[0]))) if of_tower else 201.8


def year(
    path: Path, given: dict[str, float], folder: Path, patch: pytest.MonkeyPatch
) -> dict[str, F64]:
    """Quantities of every hour of a table, (T,) each."""
    table = columns(path)
    weather = header_at(folder, elevation_of_site_m(path))
    patch.setattr(stages, "size", lambda *of: resized(size(*of), given))
    wet_bulb_c = np.minimum(table["wb_c"], table["out_c"])
    drivers = drivers_from_arrays(
        table["out_c"], wet_bulb_c, np.full(len(wet_bulb_c), 300.0), table["utilisation"]
    )
    own = [f"servers.fan_full_airflow_m3s={given['vfull']}", f"site.weather_file={weather}"]
    overrides = [*CONFIG, *own]
    with Simulator(load_config("corrected", overrides), drivers=drivers) as sim:
        sim.reset()
        steps = [sim.step() for _ in wet_bulb_c]
    names = [*table, "unmet_w"]
    return {
        name: np.array([getattr(step, name)[0] for step in steps])
        for name in names
        if hasattr(steps[0], name)
    }


@pytest.mark.parametrize("path", energyplus_tables("facility_*_hourly.csv"), ids=by_name)
def test_facility(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    summary: dict[str, Any] = json.loads(
        path.with_name(path.name.replace("_hourly.csv", "_monthly.json")).read_text()
    )
    table = columns(path)
    found = year(path, summary["sizing"], tmp_path, monkeypatch)
    assert found["unmet_w"].max() == 0.0

    def over(*names: str) -> float:
        """Energy or water of the year over that of the table, less 1."""
        sums = [sum(of[name].sum() for name in names) for of in (found, table)]
        return float(sums[0] / sums[1] - 1.0)

    assert abs(over("cpu_w", "it_fan_w")) < 1e-3
    assert abs(over("crac_fan_w")) < 0.05
    assert abs(over("chilled_pump_w", "condenser_pump_w")) < 0.02
    assert abs(over("water_l")) < 0.05
    assert abs(over("chiller_w")) < 0.02
