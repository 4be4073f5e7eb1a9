"""The model of the liquid loop against measured months, where SDC_REAL_DATA has them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytestmark = pytest.mark.repo


@pytest.fixture(scope="module")
def esif() -> ModuleType:
    path = Path(__file__).parents[1] / "examples" / "esif_fit.py"
    spec = importlib.util.spec_from_file_location("esif_fit", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["esif_fit"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


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
