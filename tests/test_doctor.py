"""``sdc-taichi doctor``, and completion of the command line by shells."""

from __future__ import annotations

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from sdc_taichi.cli import doctor
from sdc_taichi.cli.app import app
from sdc_taichi.errors import RuntimeStateError

ROOT = Path(__file__).parents[1]


def findings(code: int = 0) -> dict[str, dict[str, Any]]:
    """Findings of the command by name, printed as JSON."""
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert done.exit_code == code, done.output
    content = json.loads(done.stdout)
    assert content["works"] == (code == 0)
    return {each["what"]: each for each in content["findings"]}


def test_names_versions_keys_and_folders_and_steps_a_hall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("SDC_TAICHI_DATA", str(tmp_path / "file" / "data"))
    monkeypatch.setenv("EIA_API_KEY", "very-secret")
    monkeypatch.delenv("ENTSOE_API_KEY", raising=False)
    found = findings()
    assert "very-secret" not in str(found)
    assert found["EIA_API_KEY"]["found"] == "set"
    assert found["ENTSOE_API_KEY"]["found"] == "not set"
    assert found["Python"]["found"].startswith(sys.version.split()[0])
    assert "may be used" in found["processors"]["found"]
    assert found["first step"]["found"].startswith("took ")
    assert "cannot be written" in found["imported data"]["found"]
    assert "SDC_TAICHI_DATA" in found["imported data"]["advice"]


def test_the_list_ends_with_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    plot = doctor.EXTRAS["plot"]._replace(modules=("no_such_module",))
    monkeypatch.setitem(doctor.EXTRAS, "plot", plot)
    done = CliRunner().invoke(app, ["doctor"])
    assert done.exit_code == 0
    listed, advice = done.output.split("What can be mended or added:\n")
    assert "extra plot" in listed
    assert 'extra plot: pip install "sdc-taichi[plot]"' in advice
    assert advice.endswith("The simulator works.\n")


def test_a_simulator_that_does_not_step_ends_with_exit_code_1(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeStateError("Taichi cannot start: no memory")

    monkeypatch.setattr("sdc_taichi.sim.simulator.Simulator.step", fail)
    step = findings(code=1)["first step"]
    assert step["is_broken"]
    assert step["advice"] == "RuntimeStateError: Taichi cannot start: no memory"


@pytest.mark.repo
def test_extras_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    assert set(extras) - set(doctor.EXTRAS) == {"dev", "docs", "recipes", "test"}
    for name, extra in doctor.EXTRAS.items():
        assert extra.modules[0] in " ".join(extras[name])


def completed(*words: str) -> list[str]:
    """Words that bash is offered for the last one."""
    environment = {
        "_SDC_TAICHI_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(["sdc-taichi", *words]),
        "COMP_CWORD": str(len(words)),
    }
    done = CliRunner().invoke(app, [], env=environment, prog_name="sdc-taichi")
    assert (done.exit_code, done.stderr) == (0, "")
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["sim"], ["simulate"]),
        (["simulate", "--forec"], ["--forecast-error"]),
        (["simulate", "corr"], ["corrected"]),
        (["simulate", "hvac.chiller.reference_c"], ["hvac.chiller.reference_cop="]),
        (["simulate", "--site", "ny,c"], ["ny,ca"]),
        (["simulate", "--controller", "const"], ["constant:"]),
        (["data", "show", "N"], ["NY"]),
        (["train", "had"], ["had3qn"]),
        (["benchmark", "run", "oper"], ["operator"]),
        (["new", "mine.yaml", "--from", "hall_o"], ["hall_of_2026"]),
        (["simulate", "my_own"], []),
    ],
)
def test_shells_complete(words: list[str], expected: list[str]) -> None:
    assert completed(*words) == expected
