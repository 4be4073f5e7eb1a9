"""``sdc-taichi optimum`` and ``simulate --optimum``: options, tables, files, interruption."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

import sdc_taichi.optimum
from known_optimum import made_up_optimum
from sdc_taichi import Fleet, Simulator
from sdc_taichi.cli.app import app
from sdc_taichi.optimum import StoppedError
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.optimum.uncoordinated import WAYS
from sdc_taichi.run.folder_reader import read_run

CASE = ("tiny", "--site", "ny,ca", "--days", "1", "--start", "07-01")


def call(command: str, *arguments: object) -> Result:
    return CliRunner().invoke(app, [command, *map(str, arguments)])


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the solver was asked; it makes an optimum up."""
    seen: dict[str, Any] = {}

    def solve(fleet: Fleet, *, steps: int, drivers: Any, objective: Any, **options: Any) -> Optimum:
        seen.update(options, steps=steps, objective=str(objective))
        with Simulator(fleet, drivers=drivers, precision=options["precision"]) as sim:
            return made_up_optimum(sim, steps, str(objective))

    monkeypatch.setattr(sdc_taichi.optimum, "solve", solve, raising=False)
    return seen


def rows_of(output: str) -> dict[str, list[str]]:
    """Cells of the rows of a printed table by their titles."""
    cells = [[c.strip() for c in line.split("│")] for line in output.splitlines() if "│" in line]
    return {row[1]: row[2:-1] for row in cells}


def test_table_tells_figures_gaps_and_shares(asked: dict[str, Any]) -> None:
    done = call("optimum", *CASE, "--controller", "g36", "--controller", "battery=lookahead-3h")
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("Optimum of carbon: 2 data centers, 1 day\n")
    rows = rows_of(done.stdout)
    assert list(rows) == ["idle (kg CO2e)", "bound (% against idle)", "achieved (% against idle)",
                          "gap (points)", "cooling alone (%)",
                          "g36 (% of the achievable)",
                          "battery=lookahead-3h (% of the achievable)"]  # fmt: skip
    bound, achieved, gap = ([float(x) for x in rows[title]] for title in list(rows)[1:4])
    assert [a - b for a, b in zip(achieved, bound, strict=True)] == pytest.approx(gap, abs=0.011)
    assert "ca: estimate: made up" in done.stdout
    assert "ca: does not hold: facility energy off by 1e-3" in done.stdout
    assert "no controller that keeps the constraints and ends as it began comes" in done.stdout
    assert asked["agents"] == ("load", "cooling", "battery")
    assert asked["cache"] is True
    assert asked["inlet_limit_c"] is None


def test_options_reach_the_solver(asked: dict[str, Any]) -> None:
    done = call("optimum", *CASE, "--objective", "carbon+0.002*water", "--agents", "battery,load",
                "--warm-up", "0.5", "--max-inlet", "27", "--no-cache",
                "--precision", "f64", "--quiet")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert done.output == ""
    assert asked["objective"] == "carbon+0.002*water"
    assert asked["agents"] == ("load", "battery")
    assert asked["scored_from"] == 48
    assert asked["inlet_limit_c"] == 27.0
    assert asked["cache"] is False
    assert asked["precision"] == "f64"
    assert asked["steps"] == 96


def test_json_is_the_file_of_the_folder(asked: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "best"
    done = call("optimum", *CASE, "--controller", "g36", "--json", "--out", out)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == json.loads((out / "optimum.json").read_text())
    run = read_run(out)
    assert run.metrics["controller"] == "optimum"
    assert run.metrics["steps_done"] == 96


def test_simulate_tells_its_share(asked: dict[str, Any], tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = call("simulate", *CASE, "--controller", "g36", "--optimum", "carbon", "--out", out)
    assert done.exit_code == 0, done.output
    run = read_run(out)
    share = run.metrics["total"]["achievable_share"]
    assert f"Share of the achievable (carbon): {100 * share:.1f} %" in done.stdout
    assert "work and energy left at the end are valued" in " ".join(done.stdout.split())
    assert "\nca: estimate: made up\n" in done.stdout
    assert read_run(out / "optimum").metrics["fingerprint"] == run.metrics["fingerprint"]
    again = call("simulate", *CASE, "--out", out, "--quiet")
    assert again.exit_code == 0, again.output
    assert "optimum" not in read_run(out).metrics


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--objective", "carbn"], "did you mean 'carbon'"),
        (["--objective", "-1*carbon"], "weight -1 of carbon"),
        (["--agents", "load,cool"], "--agents 'load,cool': 'cool'; valid are load, cooling"),
        (["--agents", "load", "--uncoordinated"], "valid is with two or more of load"),
        (["--agents", "load,load"], "load is given twice"),
        (["--warm-up", "1"], "--warm-up 1: valid is less than --days"),
        (["--warm-up", "0.001"], "--warm-up 0.001: valid is a positive number of days"),
        (["--max-inlet", "400"], "--max-inlet"),
        (["--controller", "g37"], "controller 'g37'"),
        (
            ["--agents", "load,cooling", "--controller", "greedy-ci"],
            "--controller greedy-ci: moves battery, which --agents load,cooling leaves idle",
        ),
        (["--forecast-error", "ci=x"], "ci"),
        (["--site", "ny,ny"], "is given twice"),
        (["--days", "0"], "--days 0"),
    ],
)
def test_bad_options_are_one_line(asked: dict[str, Any], options: list[str], said: str) -> None:
    done = call("optimum", *CASE, *options)
    assert done.exit_code == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""
    assert asked == {}


@pytest.mark.parametrize("command", ["optimum", "simulate"])
def test_interrupted_solver_says_what_it_keeps(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str
) -> None:
    def solve(*_: Any, stop: Any, **__: Any) -> Optimum:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop()
        raise StoppedError("1 of 2 data centers are solved and kept")

    monkeypatch.setattr(sdc_taichi.optimum, "solve", solve, raising=False)
    extra = ["--optimum", "carbon"] if command == "simulate" else []
    done = call(command, *CASE, *extra, "--out", tmp_path / "out")
    assert done.exit_code == 130
    assert done.stderr == "interrupted: 1 of 2 data centers are solved and kept\n"
    assert done.stdout == ""


def test_interrupted_controllers_leave_the_figures(
    asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made_up = sdc_taichi.optimum.solve

    def solve(*arguments: Any, **options: Any) -> Optimum:
        found: Optimum = made_up(*arguments, **options)
        os.kill(os.getpid(), signal.SIGINT)
        return found

    monkeypatch.setattr(sdc_taichi.optimum, "solve", solve)
    done = call("optimum", *CASE, "--controller", "g36", "--out", tmp_path / "out")
    assert done.exit_code == 130
    assert "gap (points)" in done.stdout
    assert done.stderr == (
        f"interrupted; without controllers g36 and files in {tmp_path / 'out'}; the figures above "
        "are whole\n"
    )
    assert not (tmp_path / "out" / "optimum.json").exists()


def test_solved_figures_are_in_order(tmp_path: Path) -> None:
    out = tmp_path / "best"
    done = call("optimum", *CASE, "--days", "0.5", "--no-cache", "--controller", "idle",
                "--controller", "g36", "--uncoordinated", "--json", "--out", out)  # fmt: skip
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    idle, g36 = content["controllers"]
    for dc, at_rest, rule in zip(
        content["data_centers"], idle["data_centers"], g36["data_centers"], strict=True
    ):
        assert dc["bound"] <= dc["achieved"] < dc["idle"]
        assert dc["bound_kind"] == "bound"
        assert dc["failures"] == []
        assert at_rest["share"] == 0.0
        assert rule["share"] < 1.0
        assert min(dc["alone"].values()) >= dc["achieved"] * (1.0 - 1e-9)
        assert tuple(dc["uncoordinated"]) == WAYS
        assert min(dc["uncoordinated"].values()) >= dc["bound"]
    cfp = [dc["metrics"]["cfp_kg"] for dc in read_run(out).metrics["data_centers"]]
    assert cfp == pytest.approx([dc["achieved"] for dc in content["data_centers"]], rel=1e-9)
