"""``sdc-taichi hall solve``: its report, its file, and its errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from sdc_taichi import load_config
from sdc_taichi.cli.hall import hall_app
from sdc_taichi.errors import ConfigError, SdcError
from sdc_taichi.hall.design_point import design_point
from sdc_taichi.hall.recirculation import calibrate


def call(*arguments: object) -> Result:
    return CliRunner().invoke(hall_app, ["solve", *map(str, arguments)])


def solved(*arguments: object) -> dict[str, Any]:
    done = call("--json", "--cell", 0.8, *arguments)
    assert done.exit_code == 0, done.output
    report: dict[str, Any] = json.loads(done.stdout)
    return report


def failed(error: type[SdcError], *arguments: object) -> str:
    done = call(*arguments)
    assert isinstance(done.exception, error), done.output
    message = str(done.exception)
    assert "\n" not in message
    return message


def test_report_and_file_agree_and_serve_as_matrix_file(tmp_path: Path) -> None:
    out = tmp_path / "new" / "hall.npz"
    report = solved("--out", out)
    with np.load(out) as file:
        assert set(file.files) == {"R", "provenance"}
        R, provenance = file["R"], json.loads(str(file["provenance"]))
    assert R.shape == (20, 20)
    assert R.dtype == np.float64
    np.testing.assert_allclose(R.sum(axis=1), report["recirculated_share"])
    assert provenance == report["provenance"]
    assert provenance["cell_m"] == 0.8
    assert provenance["layout"]["rack_pitch_m"] == 0.6
    assert list(out.parent.iterdir()) == [out]
    config = load_config("corrected", [f"hall.recirculation.matrix_file={out}"])
    weights = calibrate(config).mix_weights.dense()
    np.testing.assert_allclose(weights, R / R.sum(axis=1, keepdims=True), rtol=1e-12)

    design = design_point(load_config("corrected"))
    rise_k = design.it_w / (design.air_j_per_m3_k * design.airflow_m3s)
    inlet_k = np.array(report["approach_k"])
    np.testing.assert_allclose(inlet_k, R @ (inlet_k + rise_k), rtol=1e-9)
    rows = inlet_k.reshape(4, 5)
    assert report["approach_inner_rows_k"] == pytest.approx(rows[1:3].mean())
    assert report["approach_outer_rows_k"] == pytest.approx(rows[[0, 3]].mean())
    assert report["energy_residual"] < 1e-8
    assert report["mass_residual"] < 1e-8


def test_a_hall_of_two_rows_has_no_inner_rows() -> None:
    report = solved("tiny")
    assert load_config("tiny").hall.rows <= 2
    assert report["approach_inner_rows_k"] is None
    assert call("tiny", "--cell", 0.8).exit_code == 0


def test_an_existing_file_is_replaced_only_with_force(tmp_path: Path) -> None:
    out = tmp_path / "hall.npz"
    out.write_text("precious")
    assert "exists; choose another name" in failed(ConfigError, "--out", out)
    assert out.read_text() == "precious"
    solved("--out", out, "--force")
    assert np.load(out)["R"].shape == (20, 20)


def test_bad_options_are_named(tmp_path: Path) -> None:
    assert "ends in .npz" in failed(ConfigError, "--out", tmp_path / "hall.csv")
    folder = tmp_path / "folder.npz"
    folder.mkdir()
    assert "is a folder" in failed(ConfigError, "--out", folder, "--force")
    assert "cell_m 9" in failed(ConfigError, "--cell", 9)
    blocked = tmp_path / "file"
    blocked.write_text("")
    message = failed(SdcError, "tiny", "--cell", 1, "--out", blocked / "hall.npz")
    assert "cannot be written" in message


@pytest.mark.parametrize(("preset", "model"), [("sustaindc", "released"), ("paper", "rack")])
def test_outlet_models_without_a_balance_per_server_are_refused(
    tmp_path: Path, preset: str, model: str
) -> None:
    message = failed(ConfigError, preset, "--cell", 1, "--out", tmp_path / "hall.npz")
    assert message.startswith(f"{preset}: servers.outlet_model {model}: ")
    assert message.endswith("valid is server")
    assert not list(tmp_path.iterdir())
