"""``sdc-taichi hall solve`` and ``place``: their reports, files, and errors."""

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
from sdc_taichi.run.rack_places import place_values, study_places


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


def hall_with_blanks(tmp_path: Path, *more: str) -> Path:
    """A hall of 6 rows of 6 racks, whose rows 2 and 5 are empty but for two racks."""
    path = tmp_path / "hall.yaml"
    lines = [
        "extends: corrected",
        "name: hall",
        "hall:",
        "  rows: 6",
        "  racks_per_row: 6",
        "  supply_approach_k: 4",
        "  return_approach_k: -3",
        "  rack_types:",
        "    blank: {servers: {count: 1, full_w: 20, idle_w: 10}}",
        "    cpu: {servers: {count: 20, full_w: 300, idle_w: 90}}",
        "    gpu: {servers: {count: 3, full_w: 3000, idle_w: 800, design_rise_k: 15}}",
        "  rack_plan:",
        '  - {type: cpu, rows: "0-1, 3-4"}',
        '  - {type: cpu, rows: "2, 5", racks: 0}',
        '  - {type: blank, rows: "2, 5", racks: 1-5}',
        "hvac: {crac: {units: 3, spare_units: 1}}",
        *more,
    ]
    path.write_text("\n".join(lines))
    return path


def placed(path: Path, *arguments: object) -> dict[str, Any]:
    words = ["place", str(path), "--type", "gpu", "--json", *map(str, arguments)]
    done = CliRunner().invoke(hall_app, words)
    assert done.exit_code == 0, done.output
    values: dict[str, Any] = json.loads(done.stdout)
    return values


def test_places_are_ranked_by_the_hottest_inlet(tmp_path: Path) -> None:
    values = placed(hall_with_blanks(tmp_path), "--count", 2)
    candidates = values["candidates"]
    inlets = [each["hottest_inlet_c"] for each in candidates if each["fits"]]
    assert len(inlets) > 5
    np.testing.assert_array_equal(inlets, np.sort(inlets), strict=True)
    assert all(len(each["racks"]) == 2 for each in candidates)
    free = {row * 6 + place for row in (2, 5) for place in range(1, 6)}
    assert all(set(each["racks"]) <= free for each in candidates)
    assert candidates[0]["hottest_inlet_c"] < candidates[-1]["hottest_inlet_c"] - 0.1
    new_kw = candidates[0]["it_kw"] - values["base_it_kw"]
    assert 15.0 < new_kw < 22.0, "two racks of 9 kW"


def test_the_best_place_is_that_of_a_hall_solved_alone(tmp_path: Path) -> None:
    config = load_config(hall_with_blanks(tmp_path))
    study = study_places(config, "gpu", 2)
    alone = study_places(config, "gpu", 2)
    best = study.candidates[0]
    assert best.rack_inlet_c.shape == (36,)
    np.testing.assert_array_equal(best.rack_inlet_c, alone.candidates[0].rack_inlet_c)
    named = np.array(study.best.hall.rack_type_names())
    assert np.flatnonzero(named == "gpu").tolist() == list(best.racks)
    assert study.best.hvac.crac.airflow_m3s is not None


def test_limits_of_cooling_and_redundancy_are_told(tmp_path: Path) -> None:
    path = hall_with_blanks(tmp_path)
    several = placed(path, "--count", 10, "--keep", "n+1")["candidates"]
    assert not any(each["fits"] for each in several)
    assert any("cooling" in text for text in several[0]["exceeded"])
    assert any("airflow" in text for text in several[0]["exceeded"])
    one = placed(path, "--count", 1, "--keep", "n+1")["candidates"][0]
    assert one["hottest_inlet_unit_down_c"] >= one["hottest_inlet_c"]
    cold = placed(path, "--count", 1, "--limit-c", 18)["candidates"][0]
    assert cold["exceeded"] == [f"inlet {cold['hottest_inlet_c']:.1f} C"]


def test_some_places_in_a_large_hall_fit() -> None:
    """The example of docs/hall.md."""
    words = ["place", "hall_of_2026", "--type", "gpu_dense", "--count", "8"]
    words += ["--replace", "storage", "--limit-c", "26.8", "--json"]
    done = CliRunner().invoke(hall_app, words)
    assert done.exit_code == 0, done.output
    candidates = json.loads(done.stdout)["candidates"]
    fits = [each["fits"] for each in candidates]
    assert any(fits)
    assert not all(fits)
    assert fits == sorted(fits, reverse=True)
    assert all(each["fits"] == (each["hottest_inlet_c"] < 26.8) for each in candidates)


def test_places_without_steady_air_are_told() -> None:
    """With a unit down, the coils of the others cannot cool the air that the racks draw."""
    study = study_places(load_config("hall_of_2026"), "gpu", 1, replaced=["storage"], keep="n+1")
    hottest_c = [each.lost_unit_c for each in study.candidates]
    told = ["no steady air with a unit down" in each.exceeded for each in study.candidates]
    assert told == [inlet_c == np.inf for inlet_c in hottest_c]
    assert any(told)
    json.dumps(place_values(study), allow_nan=False)


def test_places_are_drawn_and_printed(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    out = tmp_path / "plan.png"
    words = ["place", str(hall_with_blanks(tmp_path)), "--type", "gpu", "--count", "3"]
    done = CliRunner().invoke(hall_app, [*words, "--out", str(out)])
    assert done.exit_code == 0, done.output
    assert "3 x gpu instead of blank" in done.stdout
    assert "row 2 racks" in done.stdout
    assert out.stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--type", "gpo", "--count", "2"], "--type 'gpo': not in hall.rack_types; did you mean"),
        (["--type", "gpu", "--count", "11"], "--count 11: 10 positions of blank; valid is"),
        (
            ["--type", "gpu", "--count", "2", "--replace", "cpuu"],
            "--replace 'cpuu': not in hall.rack_types; did you mean 'cpu'",
        ),
        (
            ["--type", "gpu", "--count", "2", "hall.recirculation.calibrate=rack"],
            "inlets do not follow from the places of racks",
        ),
    ],
)
def test_places_that_cannot_be_studied(tmp_path: Path, words: list[str], message: str) -> None:
    done = CliRunner().invoke(hall_app, ["place", str(hall_with_blanks(tmp_path)), *words])
    assert isinstance(done.exception, ConfigError), done.output
    assert message in str(done.exception)
    assert "\n" not in str(done.exception)
