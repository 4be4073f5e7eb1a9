"""``sdc-taichi evaluate``: runs, tables, files, errors."""

from __future__ import annotations

import json
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner, Result

from known_optimum import made_up_solve
from policies import interface, network
from sdc_taichi import ConfigError
from sdc_taichi.cli import evaluate as commands
from sdc_taichi.cli.app import app
from sdc_taichi.learning import evaluation
from sdc_taichi.learning.policy import About, Policy

CASE = ("--config", "tiny", "--site", "ny,ca", "--weeks", "27", "--days", "2")


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["evaluate", *map(str, arguments)])


@pytest.fixture(autouse=True)
def _solved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "solve", made_up_solve)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Policies of two agents of two seeds, and one of another algorithm."""
    folder = tmp_path_factory.mktemp("runs")
    of = interface(agents=["agent_dc", "agent_bat"])
    for name, algorithm, seed in (("a-0", "ippo", 0), ("a-1", "ippo", 1), ("b", "happo", 0)):
        networks = tuple(
            network((agent,), of.width(agent), 3, seed=seed + (name == "b")) for agent in of.agents
        )
        Policy(networks, of, About(algorithm=algorithm, seed=seed, steps=100)).save(folder / name)
    return folder


def test_seeds_are_put_together_and_files_tell_all(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = call(runs / "a-0", runs / "a-1", runs / "b", *CASE, "--controller", "g36", "--out", out)
    assert done.exit_code == 0, done.output
    content = json.loads((out / "evaluation.json").read_text())
    standing = {row["controller"]: row for row in content["summary"]}
    assert list(standing) == ["idle", "ippo", "happo", "g36", "optimum"]
    assert [row["trainings"] for row in standing.values()] == [1, 2, 1, 1, 1]
    assert standing["idle"]["share_pct"] == 0.0
    assert standing["optimum"]["share_pct"] == pytest.approx(100.0, abs=15.0)
    ippo = standing["ippo"]
    assert ippo["change_pct_low"] <= ippo["change_pct"] <= ippo["change_pct_high"]
    rows = pd.read_csv(out / "rows.csv")
    own = rows[(rows["controller"] == "ippo") & (rows["moves"] == "all")]
    assert own["training"].tolist() == [0, 0, 1, 1]
    change = 100 * (own["valued_figure"].mean() / own["idle_figure"].mean() - 1)
    assert ippo["change_pct"] == pytest.approx(change)
    assert [row["moves"] for row in content["by_agent"]] == ["cooling"] * 2 + ["battery"] * 2
    assert [row["than"] for row in content["differences"]] == ["idle", "happo", "g36", "optimum"]
    assert content["command"].startswith(f"sdc-taichi evaluate {runs}/a-0 ")
    assert [policy["seed"] for policy in content["policies"]] == [0, 1, 0]
    text = (out / "table.md").read_text()
    assert "| ippo | 2 | " in text
    assert content["command"] in text
    assert "happo" in done.stdout
    again = call(runs / "b", *CASE, "--no-agents", "--out", out)
    assert again.exit_code == 0, again.output
    assert json.loads((out / "evaluation.json").read_text())["by_agent"] == []


def test_without_an_optimum_there_is_no_share(runs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any, **__: Any) -> Any:
        raise ConfigError("no plan")

    monkeypatch.setattr(evaluation, "solve", fails)
    done = call(runs / "b", *CASE, "--no-agents", "--json")
    assert done.exit_code == 2, done.output
    assert done.stderr.splitlines() == [
        "note: no optimum, so no shares: no plan",
        "error: evaluate: no optimum, so no shares; valid without an optimum is --no-optimum",
    ]
    content = json.loads(done.stdout)
    assert [row["controller"] for row in content["summary"]] == ["idle", "happo"]
    assert [row["share_pct"] for row in content["summary"]] == [None, None]
    assert content["remarks"][0].startswith("Without an optimum ends have no value")
    asked = call(runs / "b", *CASE, "--no-agents", "--no-optimum", "--json")
    assert asked.exit_code == 0, asked.output
    assert asked.stderr == ""
    assert json.loads(asked.stdout)["summary"] == content["summary"]


def test_loads_by_zone_have_no_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "solve", None)
    zones = ("--set", "workload.zone_loads={}", "--set", "workload.placement=weights")
    done = call("--controller", "g36", *CASE, *zones, "--json")
    assert done.exit_code == 0, done.output
    (note,) = done.stderr.splitlines()
    assert note.startswith("note: no optimum, so no shares: ")
    assert "workload.zone_loads" in note
    summary = json.loads(done.stdout)["summary"]
    assert [row["controller"] for row in summary] == ["idle", "g36"]
    assert [row["share_pct"] for row in summary] == [None, None]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--exact-ends",), "interrupted; figures are whole, without idle, g36, optimum"),
        (("--no-optimum",), "interrupted: idle commands are not run to the end, nothing is kept"),
    ],
)
def test_an_interruption_before_the_first_run_is_told(
    options: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "interruptible", lambda: nullcontext(lambda: True))
    done = call("--controller", "g36", *CASE, *options, "--out", tmp_path)
    assert done.exit_code == 130
    assert done.stderr == f"{said}\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "nothing to evaluate; valid is RUN or --controller"),
        (("runs/none", *CASE), "runs/none: no such folder"),
        (("--controller", "g38", *CASE), "controller 'g38': unknown"),
        (("--controller", "g36", *CASE, "--objective", "coal"), "objective 'coal'"),
        (("{runs}/b", *CASE, "--set", "simulation.steps_per_hour=2"), "b: does not fit these data"),
        (("{runs}/b", *CASE, "--out", "{runs}"), "holds other files (a-0, a-1, b)"),
    ],
)
def test_errors_are_one_line(arguments: tuple[str, ...], said: str, runs: Path) -> None:
    done = call(*(text.format(runs=runs) for text in arguments))
    assert done.exit_code == 2, done.output
    assert said in done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: ")


def test_trainings_say_what_they_are_evaluated_in(runs: Path, tmp_path: Path) -> None:
    for seed in (0, 1):
        run = tmp_path / f"run-{seed}"
        shutil.copytree(runs / f"a-{seed}", run / "best")
        settings = {"algorithm": "ippo", "config": "tiny", "sites": ["NY", "CA"], "seed": seed}
        (run / "settings.yaml").write_text(json.dumps(settings))
    both = tmp_path / "run-0", tmp_path / "run-1"
    done = call(*both, "--weeks", "27", "--days", "2", "--no-agents", "--json")
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    assert content["sites"] == ["ny", "ca"]
    assert content["objective"] == "carbon"
    assert content["summary"][1]["trainings"] == 2
    settings |= {"config": "corrected"}
    (both[1] / "settings.yaml").write_text(json.dumps(settings))
    other = call(*both, "--weeks", "27", "--days", "2")
    assert other.exit_code == 2
    assert "was trained with another config than" in other.stderr
    assert np.isfinite(content["summary"][1]["change_pct"])
