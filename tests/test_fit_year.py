"""The script that fits the embedded year: it gives the figures that the package holds."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sdc_taichi.exogenous.synthetic import coefficients

ROOT = Path(__file__).parent.parent

pytestmark = pytest.mark.repo


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "fit_year", ROOT / "docs" / "make" / "fit_year.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_the_measured_files_give_the_embedded_figures(script: ModuleType, real_data: Path) -> None:
    there = [
        name
        for name in script.PLACES
        if list(real_data.glob(f"weather/USA_{name}_*.epw"))
        and list(real_data.glob(f"carbon/{name}_*.csv"))
    ]
    every = set(there) == set(script.PLACES)
    text = script.as_text(script.fit(real_data, coefficients(), sites=[] if every else there))
    assert text == (ROOT / "data" / "coefficients.json").read_text("utf-8")


def test_a_site_that_is_not_embedded_gets_a_memory_of_its_own(
    script: ModuleType, real_data: Path
) -> None:
    embedded = coefficients()
    others = {
        part: {name: value for name, value in embedded[part].items() if name != "GA"}
        for part in ("weather", "grid")
    }
    figures = script.fit(real_data, {**embedded, **others}, sites=["GA"])
    for part in ("weather", "grid"):
        assert sorted(figures[part]) == sorted(embedded[part])
        assert all(figures[part][name] == value for name, value in others[part].items())
    dry_bulb, known = figures["weather"]["GA"]["T"], embedded["weather"]["GA"]["T"]
    assert {k: dry_bulb[k] for k in ("c", "sd", "q")} == {k: known[k] for k in ("c", "sd", "q")}
    assert dry_bulb["w"] == pytest.approx(known["w"], abs=0.1)
    assert dry_bulb["ts"] == pytest.approx(known["ts"], rel=0.1)
    assert figures["workload"] == embedded["workload"]


def test_memory_of_a_known_residual_is_found(script: ModuleType) -> None:
    known = np.array([[0.7, 60.0, 3.0], [0.4, 100.0, 8.0], [1.0, 30.0, 3.0]])
    noise = np.random.default_rng(5).normal(size=(2, 40 * 8760)).T
    phi = np.exp(-1.0 / known[:, 1:])
    drawn = np.sqrt(1.0 - phi**2) * noise[:, None, :]
    parts = np.zeros_like(drawn)
    for k in range(1, len(noise)):
        parts[k] = phi * parts[k - 1] + drawn[k]
    for (w, ts, tf), series in zip(known, parts.transpose(1, 2, 0), strict=True):
        found = script.fit_memory(np.sqrt(w) * series[0] + np.sqrt(1.0 - w) * series[1])
        assert found["w"] == pytest.approx(w, abs=0.05)
        assert found["ts"] == pytest.approx(ts, rel=0.15)
        if w < 1.0:
            assert found["tf"] == pytest.approx(tf, rel=0.15)


def test_a_missing_file_is_named(script: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no file weather/USA_AZ_\*\.epw"):
        script.fit(tmp_path, coefficients())
