"""``sdc-taichi doctor``, and completion of the command line by shells."""

from __future__ import annotations

import json
import os
import subprocess
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
    """What the command finds as JSON, by name."""
    done = CliRunner().invoke(app, ["doctor", "--json"])
    assert done.exit_code == code, done.output
    told = json.loads(done.stdout)
    assert told["works"] == (code == 0)
    return {each["what"]: each for each in told["findings"]}


def test_says_versions_machine_and_that_the_simulator_works() -> None:
    found = findings()
    assert found["Python"]["found"].startswith(sys.version.split()[0])
    assert "may be used" in found["processors"]["found"]
    assert "GiB" in found["memory"]["found"]
    assert found["first step"]["found"].startswith("took ")
    assert not [each for each in found.values() if each["found"] == "cannot be told"]


def test_the_list_ends_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(doctor.MODULES, "plot", ("no_such_module",))
    done = CliRunner().invoke(app, ["doctor"])
    assert done.exit_code == 0
    listed, advice = done.output.split("What can be mended or added:\n")
    assert "extra plot" in listed
    assert 'extra plot: pip install "sdc-taichi[plot]"' in advice
    assert advice.endswith("The simulator works.\n")


def test_a_simulator_that_does_not_step_is_told_by_the_exit_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails() -> int:
        raise RuntimeStateError("Taichi cannot start: no memory")

    monkeypatch.setattr(doctor, "_step_small_hall", fails)
    found = findings(code=1)["first step"]
    assert found["is_broken"]
    assert found["advice"] == "RuntimeStateError: Taichi cannot start: no memory"


def test_a_check_that_fails_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    def _memory() -> Any:
        raise OSError("no such device")

    checks = tuple(_memory if each.__name__ == "_memory" else each for each in doctor.CHECKS)
    monkeypatch.setattr(doctor, "CHECKS", checks)
    found = findings()
    assert found["memory"]["found"] == "cannot be told"
    assert found["memory"]["advice"] == "OSError: no such device"
    assert "first step" in found


def test_keys_are_never_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIA_API_KEY", "very-secret")
    monkeypatch.delenv("ENTSOE_API_KEY", raising=False)
    output = CliRunner().invoke(app, ["doctor"]).output
    assert "very-secret" not in output
    found = findings()
    assert found["EIA_API_KEY"]["found"] == "set"
    assert found["ENTSOE_API_KEY"]["found"] == "not set"
    for key in ("EIA_API_KEY", "ENTSOE_API_KEY"):
        command = found[key]["advice"].partition("see: sdc-taichi ")[2].split()
        assert not command or CliRunner().invoke(app, command).exit_code == 0


def test_a_home_that_cannot_be_made_is_told(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv("SDC_TAICHI_DATA", str(file / "data"))
    found = findings()["imported data"]
    assert "cannot be written" in found["found"]
    assert "SDC_TAICHI_DATA" in found["advice"]


@pytest.mark.repo
def test_extras_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    assert set(extras) - set(doctor.MODULES) == {"dev", "docs", "recipes", "test"}
    assert set(doctor.PURPOSES) == set(doctor.MODULES)
    for extra, modules in doctor.MODULES.items():
        assert modules[0] in " ".join(extras[extra])


@pytest.mark.parametrize(
    ("version", "most", "used"),
    [
        ("", "memory.max", "memory.current"),
        ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ],
)
def test_memory_is_that_of_the_control_group(
    version: str, most: str, used: str, tmp_path: Path
) -> None:
    told = tmp_path / "meminfo"
    told.write_text("MemTotal: 16777216 kB\nMemFree: 1 kB\nMemAvailable: 8388608 kB\n")
    groups = tmp_path / "cgroup"
    groups.write_text("0::/job/step\n" if not version else "7:memory:/job/step\n")
    folder = tmp_path / "mounted" / version / "job"
    folder.mkdir(parents=True)
    gib = 1 << 30
    (folder / most).write_text(f"{4 * gib}\n")
    (folder / used).write_text(f"{3 * gib}\n")
    assert doctor.memory_bytes(told, groups, tmp_path / "mounted") == (4 * gib, gib)
    (folder / most).write_text("max\n")
    assert doctor.memory_bytes(told, groups, tmp_path / "mounted") == (16 * gib, 8 * gib)


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


def test_bash_asks_the_program() -> None:
    """In a process of its own, by the name that the printed script gives."""
    code = "from sdc_taichi.cli.app import main; import sys; sys.argv[0] = 'sdc-taichi'; main()"
    script = CliRunner().invoke(app, ["--show-completion", "bash"], prog_name="sdc-taichi").output
    variable = script.split("=complete_bash")[0].split()[-1]
    environment = os.environ | {
        variable: "complete_bash",
        "COMP_WORDS": "sdc-taichi optim",
        "COMP_CWORD": "1",
    }
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120
    )
    assert (done.stdout, done.stderr) == ("optimum\n", "")


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
        (["benchmark", "run", "carbon-"], ["carbon-rich"]),
        (["new", "mine.yaml", "--from", "hall_"], ["hall_of_2026"]),
        (["simulate", "my_own"], []),
    ],
)
def test_shells_complete(words: list[str], expected: list[str]) -> None:
    assert completed(*words) == expected
