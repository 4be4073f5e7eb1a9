"""Liquid cooling against measured months, where SDC_REAL_DATA has them, and published figures."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sdc_taichi.plant.liquid import CduParameters, LiquidFleet, PlantParameters, RackParameters
from sdc_taichi.sim.liquid import Liquid, LiquidInputs

pytestmark = pytest.mark.repo


def example(name: str) -> ModuleType:
    """A script of examples/."""
    path = Path(__file__).parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def esif() -> ModuleType:
    return example("esif_fit")


def test_parameters_are_found_again(esif: ModuleType, tmp_path: Path) -> None:
    """From a file as published: gaps, faults of sensors, dates of both kinds, repeated rows."""
    made = esif.Hall(0.93, 120e3, 29.0, 80e3, 2.5)
    rng = np.random.default_rng(3)
    heat_w = rng.uniform(500e3, 1000e3, 4000)
    supply_c = rng.uniform(17.0, 24.0, 4000)
    liquid_kw = esif.liquid_w(made, heat_w) / 1e3
    rows = [
        f"{'09/01/2016 00:00' if i % 2 else '9/1/16 0:00'},{a:.6f},21,31,{b:.6f},{c:.6f},{d:.6f}"
        for i, (a, b, c, d) in enumerate(
            zip(
                heat_w / 1e3 - liquid_kw,
                liquid_kw,
                supply_c,
                esif.return_c(made, heat_w, supply_c),
                strict=True,
            )
        )
    ]
    faults = [",,,,,,", "x,-0.6,-18.33,-18.33,600,23,36", "x,150,21,31,-90,23,36", "x,150,21,31"]
    text = "\ufeffTime,Q,T,T,Q,T,T\n" + "\n".join([*rows, *rows[:3], *faults])
    (tmp_path / "NREL_HPCDC_201609.csv").write_text(text, encoding="utf-8")
    month = esif.months(tmp_path)["201609"]
    assert (month.heat_w.size, month.dropped) == (4003, 4)
    fitted = esif.fit([month])
    for name, value in vars(made).items():
        assert getattr(fitted, name) == pytest.approx(value, rel=1e-3), name
    assert esif.rms(esif.errors(fitted, month)[0]) < 1e-3


def test_prediction_is_that_of_the_kernel(esif: ModuleType) -> None:
    """One rack that holds all equipment, on one CDU without losses, in 50 data centers."""
    hall, count = esif.Hall(), 50
    rng = np.random.default_rng(5)
    heat_w, supply_c = rng.uniform(300e3, 900e3, count), rng.uniform(17.0, 25.0, count)
    ones, design_w = np.ones(count), esif.DESIGN_W
    plants = PlantParameters(head_kpa=1e-9)
    lpm = hall.coolant_w_per_k / (plants.density_kg_m3 * plants.heat_capacity_j_per_kg_k) * 6e4
    fleet = replace(
        LiquidFleet.of_equal(count, racks=1),
        racks=RackParameters(
            cpus=0, gpu_idle_w=0, gpu_max_w=1e-9, other_idle_w=0, other_max_w=1e6,
            capture_other=hall.capture, liquid_design_w=design_w, lpm_per_kw=lpm * 1e3 / design_w,
            loss_w_per_k=0.0,
        ),
        cdus=CduParameters(
            capacity_w=design_w, range_k=design_w / hall.coolant_w_per_k,
            approach_k=hall.approach_k, head_kpa=1e-9, setpoint_c=hall.setpoint_c,
        ),
        plants=plants,
    )  # fmt: skip
    inputs = LiquidInputs(
        (heat_w - hall.air_only_w) / 1e6, ones, -20.0 * ones, -22.0 * ones, 0.0 * ones,
        facility_approach_k=hall.setpoint_c - supply_c,
    )  # fmt: skip
    liquid = Liquid(fleet, step_s=60.0)
    _, result = liquid.step(liquid.initial_state(inputs), inputs)
    np.testing.assert_allclose(result.facility_supply_c, supply_c, atol=1e-4)
    predicted = esif.return_c(hall, heat_w, supply_c)
    np.testing.assert_allclose(result.facility_return_c, predicted, atol=2e-3)
    np.testing.assert_allclose(result.liquid_heat_w, esif.liquid_w(hall, heat_w), rtol=1e-6)


def test_held_out_months(esif: ModuleType, real_data: Path) -> None:
    """Return temperature within 0.5 K and liquid share within 2 points, root mean square."""
    data = esif.months(real_data / "esif")
    if not {*esif.FITTED} < {*data}:
        pytest.skip("SDC_REAL_DATA has no months of esif besides the fitted ones")
    hall = esif.fit([data[name] for name in esif.FITTED])
    for name in {*data} - {*esif.FITTED}:
        kelvin, share = esif.errors(hall, data[name])
        assert esif.rms(kelvin) < 0.5, name
        assert esif.rms(share) < 0.02, name


def test_figures_of_frontier_are_within_published_ranges() -> None:
    """Power of 8..30 MW, water of 30..38 C, PUE of 1.03..1.08, 20..30 % of cooling saved."""
    study = example("frontier_study")
    hours = study.Hours.drawn(60)
    usual = study.simulated(hours)
    it_mw = usual.liquid_it_w * study.RACKS / study.RACKS_PER_CDU / 1e6
    assert 6.5 < it_mw.min() < 9.0
    assert 25.0 < it_mw.max() < 30.0
    assert 30.0 < usual.facility_return_c.min() < 32.0
    assert 33.0 < np.median(usual.facility_return_c) < 38.0
    assert 1.03 < np.average(study.pue(usual), weights=usual.liquid_it_w) < 1.08
    flow, both = study.savings(hours, 38.0)
    assert 0.15 < flow < both < 0.35
