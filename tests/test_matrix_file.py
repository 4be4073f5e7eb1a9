"""Recirculation matrices of the user's: against the twin, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import reference_twin
from random_halls import assert_close, at_design
from sdc_taichi import ConfigError, DataCenterConfig, build_fleet, load_config
from sdc_taichi.hall.design_point import design_point
from sdc_taichi.hall.recirculation import calibrate
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import Conditions
from sdc_taichi.types import F64

SMALL_HALL = [
    "hall.rows=2", "hall.racks_per_row=3", "hall.supply_approach_k=3",
    "hall.return_approach_k=-3", "servers.power_w=[200, 20]",
]  # fmt: skip


def hall_with(path: Path, scaled_to: str, *overrides: str) -> DataCenterConfig:
    """Six racks in two rows whose recirculation stands in a file."""
    settings = {"matrix_file": str(path), "calibrate": scaled_to}
    named = [f"hall.recirculation.{name}={json.dumps(text)}" for name, text in settings.items()]
    return load_config("corrected", [*SMALL_HALL, *named, *overrides])


def random_matrix(rng: np.random.Generator, racks: int) -> F64:
    """An R of a hall of equal racks: no more leaves than comes out, a rack that breathes none."""
    matrix = rng.uniform(0, 1, (racks, racks)) * (rng.random((racks, racks)) < 0.7)
    matrix *= 0.35 / np.maximum(matrix.sum(axis=0), matrix.sum(axis=1)).max()
    matrix[1] = 0.0
    return matrix


def heat_matrix(matrix: F64, scaled_to: str, folder: Path, *overrides: str) -> F64:
    """D of a hall with this R: T_in - T_sup = R (I - R)^-1 K^-1 P, with its design airflow."""
    path = folder / "known.npz"
    np.savez(path, R=matrix)
    config = hall_with(path, scaled_to, *overrides)
    # Where the file gives but shares within a row or the hall, D is that of even inlets.
    design = calibrate(config).design if scaled_to == "none" else design_point(config)
    w_per_k = design.air_j_per_m3_k * design.airflow_m3s
    return np.asarray(matrix @ np.linalg.inv(np.eye(len(matrix)) - matrix) / w_per_k)


@pytest.mark.parametrize("kind", ["R.npz", "D.npz", "R.csv", "D.csv"])
@pytest.mark.parametrize("scaled", ["rack", "row", "hall", "none"])
def test_matrix_of_a_file_agrees_with_the_twin(kind: str, scaled: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    matrix = random_matrix(rng, 6)
    if scaled == "rack":
        # Calibration needs exhaust air for a rack with an approach temperature.
        matrix[1] = matrix[0]
    name, path = kind[0], tmp_path / kind
    values = matrix if name == "R" else heat_matrix(matrix, scaled, tmp_path)
    if path.suffix == ".npz":
        np.savez(path, **{name: values})  # type: ignore[arg-type]
    else:
        np.savetxt(path, values, delimiter=",")
    config = hall_with(path, scaled, f"hall.recirculation.matrix_kind={name}")
    met = Conditions(np.array([20.0]), np.array([0.7]))
    twin = reference_twin.calibrated_to(config, matrix)
    if scaled == "none":
        np.testing.assert_allclose(calibrate(config).matrix(), matrix, rtol=1e-9, atol=1e-12)
    ones, full = np.ones(6), np.ones(1)
    expected = reference_twin.steady(
        twin, met.unit_supply_c, twin.load(np.full(6, 0.7)), low=full, high=full, running=full,
        powered=ones, breath=ones,
    )  # fmt: skip
    sums = Hall(build_fleet(config), "f64").solve(met)
    for field in ("inlet_c", "outlet_c", "cpu_w", "airflow_m3s"):
        assert_close(getattr(sums, f"rack_{field}"), expected.racks[field], 1e-10, field)
    if scaled == "none":
        assert sums.rack_inlet_c[1] == pytest.approx(20.0, abs=1e-9)


def test_power_of_a_rack_warms_the_others_by_d(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(5), tmp_path / "cfd.npz"
    constant_airflow = [
        "servers.fan_full_airflow_m3s=0.019", "servers.fan_airflow_ratio_lb=[1,1]",
        "servers.fan_airflow_ratio_ub=[1,1]", "hall.air_density_kg_m3=1.225",
    ]  # fmt: skip
    d_k_per_w = heat_matrix(random_matrix(rng, 6), "none", tmp_path, *constant_airflow)
    np.savez(path, D=d_k_per_w)
    config = hall_with(path, "none", *constant_airflow)
    # Of design supply air: colder air is denser, and servers move more of it.
    met = Conditions(np.array([23.0]), np.array([0.5]), rack_load=rng.uniform(0, 1, 6))
    sums = Hall(build_fleet(config), "f64").solve(met)
    power_w = sums.rack_cpu_w + sums.rack_fan_w
    np.testing.assert_allclose(sums.rack_inlet_c, 23.0 + d_k_per_w @ power_w, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"R": np.full((4, 4), 0.1)}, r"R has shape \(4, 4\), expected \(6, 6\)"),
        ({"R": np.full((6, 6), np.nan)}, r"R\[0, 0\] is nan; valid is a finite number"),
        ({"D": np.full((6, 6), -0.1)}, r"D\[0, 0\] is -0.1 K/W; valid is at least 0"),
        ({"R": np.full((6, 6), 0.1j)}, "R holds complex128; valid are real numbers"),
        ({"R": np.full((6, 6), True)}, "R holds bool; valid are real numbers"),
        ({"R": np.full((6, 6), -0.1)}, "rack 0 takes a share of -0.1 of its air from rack 0"),
        ({"R": np.full((6, 6), 0.2)}, "row 0 sums to 1.2; valid is below 1"),
        ({"R": np.zeros((6, 6)), "D": np.zeros((6, 6))}, "valid is one of the arrays R and D"),
        ({"X": np.zeros((6, 6))}, r"holds \['X'\]; valid is one of the arrays R and D"),
        ({"D": np.full((6, 6), 1e308)}, r"D\[0, 0\] is 1e\+308 K/W; valid is 0..1000 K/W"),
        ({"R": np.full((6, 6), 1e308)}, r"R\[0, 0\] is 1e\+308; valid is 0..1$"),
        ({"R": np.full((6, 6), None)}, r"R is object \(6, 6\); valid are numbers"),
        ({"R": np.full((6, 6), 0.16)}, "rack 0 needs .* intake to be exhaust air"),
        (b"no archive", r"cannot be read as an \.npz file"),
    ],
)
def test_a_matrix_that_cannot_be_is_refused(
    content: dict[str, F64] | bytes, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "cfd.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)  # type: ignore[arg-type]
    config = hall_with(path, "none")
    with pytest.raises(ConfigError, match=message) as error:
        build_fleet(config)
    assert "cfd.npz" in str(error.value)
    assert "\n" not in str(error.value)


def matrix_hall(path: Path, *more: str) -> DataCenterConfig:
    return hall_with(path, "none", "hall.supply_approach_k=[0, 3, 3, 3, 3, 3]", *more)


def test_files_that_are_no_matrix_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    np.save(tmp_path / "one.npy", np.full((6, 6), 0.1))
    (tmp_path / "one.npy").rename(path)
    as_r, as_d = (f"hall.recirculation.matrix_kind={kind}" for kind in "RD")
    named = tmp_path / "named.npz"
    np.savez(named, R=np.full((6, 6), 0.01))
    for file, overrides, message in (
        (path, [], r"r\.npz: holds one array without a name; valid is an"),
        (tmp_path / "r.txt", [as_r], r"ends in '.txt'; valid are .npz and .csv"),
        (tmp_path / "none.npz", [], r"none\.npz: no such file"),
        (tmp_path / "r.csv", [], r"a \.csv needs hall\.recirculation\.matrix_kind R or D"),
        (named, [as_d], r"holds R, hall\.recirculation\.matrix_kind is D"),
    ):
        with pytest.raises(ConfigError, match=message):
            build_fleet(matrix_hall(file, *overrides))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0,0,0,0,0,0\n\n0,x,0,0,0,0\n", "cannot be read as rows of numbers .*'x' .* row 1, col"),
        ("0,0,0,0,0,0\n0,0\n", "cannot be read as rows of numbers .* columns changed from 6 to 2"),
        ("0,0,0,0,0,\xff\n", "cannot be read as rows of numbers .*utf-8.*0xff"),
        ("", r"R has shape \(0, 1\), expected \(6, 6\)"),
        (" \n \t # note\n0,0,0,0,0,0 # racks\n   \n", r"R has shape \(1, 6\), expected \(6, 6\)"),
        ("0,0,nan,0,0,0\n" * 6, r"R\[0, 2\] is nan; valid is a finite number"),
    ],
)
def test_a_csv_file_that_is_no_matrix_is_told_by_line(
    text: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "r.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match=rf"r\.csv: {message}"):
        build_fleet(matrix_hall(path, "hall.recirculation.matrix_kind=R"))


def test_a_rack_without_exhaust_air_cannot_be_warmed_by_it(tmp_path: Path) -> None:
    path, matrix = tmp_path / "r.npz", np.full((6, 6), 0.05)
    matrix[[0, 2]] = 0.0
    np.savez(path, R=matrix)
    with pytest.raises(ConfigError, match=r"row 2 is zero, so .* rack 2 by the 3 K of hall.supply"):
        build_fleet(matrix_hall(path, "hall.recirculation.calibrate=rack"))
    # On the mean of its row the others make up for it.
    by_row = "hall.recirculation.calibrate=row"
    found = at_design([matrix_hall(path, by_row)]).rack_inlet_c - 23.0
    np.testing.assert_allclose(found, [0, 6, 0, 3, 3, 3], atol=1e-9)
    matrix[2] = 0.05
    np.savez(path, R=matrix)
    by_rack = "hall.recirculation.calibrate=rack"
    found = at_design([matrix_hall(path, by_rack)]).rack_inlet_c - 23.0
    np.testing.assert_allclose(found, [0, 3, 3, 3, 3, 3], atol=1e-9)


def test_settings_that_a_matrix_leaves_without_effect_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"containment 0.5 with recirculation.matrix_file: .* 0$"):
        matrix_hall(tmp_path / "r.npz", "hall.layout.containment=0.5")
    with pytest.raises(ConfigError, match="matrix_kind D needs a matrix_file; valid without one"):
        load_config("corrected", ["hall.recirculation.matrix_kind=D"])
    with pytest.raises(ConfigError, match=r"matrix_file needs hall\.inlet_model recirculation"):
        load_config("tiny", ["hall.recirculation.matrix_file=r.npz"])
