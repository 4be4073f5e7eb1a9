"""Policies and controllers of users on the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from policies import interface, policy
from sdc_taichi.cli.app import app
from sdc_taichi.learning.policy import About, Policy

PROGRAM = (sys.executable, "-c", "from sdc_taichi.cli.app import main; main()")
RULES = """
from sdc_taichi import Actions

class Charge:
    commands = ("battery",)

    def reset(self, seed):
        pass

    def act(self, view):
        return Actions(battery=1.0)
"""


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = policy(interface(), seed=3)
    about = About(algorithm="happo", seed=7, steps=2_000_000, version="0.2.0")
    Policy(made.networks, made.interface, about).save(tmp_path / "run" / "best")
    return tmp_path / "run"


def test_a_run_under_a_policy(folder: Path, tmp_path: Path) -> None:
    name = f"policy:{folder}"
    arguments = ("simulate", "tiny", "--days", 0.25, "--quiet", "--out", tmp_path / "out")
    done = call(*arguments, "--controller", name)
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["controller"] == name
    steps = pd.read_parquet(tmp_path / "out" / "steps.parquet")
    assert steps["battery_command"].nunique() > 1
    again = call("hall", "why", tmp_path / "out", "--step", 5)
    assert again.exit_code == 0, again.output


def test_what_a_policy_is_shown_to_be(folder: Path) -> None:
    shown = call("policy", "show", folder)
    assert shown.exit_code == 0, shown.output
    first, *rest = shown.stdout.splitlines()
    assert first.endswith("best: happo, 2,000,000 steps, seed 7, sdc-taichi 0.2.0")
    assert any(line.split()[:2] == ["agent_bat", "battery"] for line in rest)
    assert any("actions" in line and "discrete, order paper" in line for line in rest)
    as_json = call("policy", "show", folder, "--json")
    assert as_json.stdout == (folder / "best" / "policy.json").read_text()


def test_a_controller_of_the_current_folder(tmp_path: Path) -> None:
    (tmp_path / "my_rules.py").write_text(RULES)
    name = "my_rules:Charge"
    run = ("simulate", "tiny", "--days", "0.125", "--quiet", "--controller", name, "--out", "out")
    done = subprocess.run([*PROGRAM, *run], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    steps = pd.read_parquet(tmp_path / "out" / "steps.parquet")
    assert (steps["battery_command"] == 1.0).all()
    again = call("hall", "why", tmp_path / "out", "--step", 5)
    assert again.exit_code == 2
    assert "code that a file names is not run" in again.stderr
