"""The command ``sdc-taichi benchmark``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from sdc_taichi.benchmark.executors import Executor
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.cli.app import app
from sdc_taichi.cli.jobs import JobOptions

SUITE = {
    "title": "A week of a small data center",
    "cases": {"tiny": {"config": "tiny", "weeks": [27], "days": 2, "optimum": False}},
    "rows": {
        "idle": {"controller": "idle"},
        "coldest": {"controller": "coldest"},
        "ippo": {"train": {"algorithm": "ippo"}},
    },
}


def call(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["benchmark", *arguments])


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(JobOptions, "executor", lambda _: Executor())
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(SUITE))
    return path


def test_a_suite_is_run_and_goes_on_with_what_is_missing(file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = [str(file), "--out", str(out), "--rows"]
    first = call(*options, "idle")
    assert (first.exit_code, first.stderr.count("\n")) == (0, 2), first.stderr
    assert first.stderr.startswith("jobs to run: 1, about 0:01 of processor time, or 0:01 with")
    assert f"benchmark report {out}" in first.stdout
    refused = call(*options, "idle,coldest")
    assert refused.exit_code == 2
    assert "holds a study; go on with it with --resume" in refused.stderr
    more = call(*options, "idle,coldest", "--resume")
    assert more.exit_code == 0
    assert "1 kept" in more.stderr
    rows = ResultStore(out).rows()
    assert rows[["suite", "case", "row", "seed", "week"]].to_numpy().tolist() == [
        ["mine", "tiny", "coldest", 0, 27],
        ["mine", "tiny", "idle", 0, 27],
    ]
    assert (rows["figure"] == rows["cfp_kg"]).all()
    assert ResultStore(out).study().command.startswith("sdc-taichi ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["carbn"], "carbn: no such suite or file; did you mean 'carbon'?"),
        (["carbon", "--rows", "idel"], "no row 'idel'; did you mean 'idle'?"),
        (["carbon", "--cases", "none"], "no case 'none'; valid: eight-sites"),
        (["carbon", "--seeds", "0"], "--seeds"),
    ],
)
def test_bad_arguments_are_one_line(file: Path, arguments: Sequence[str], message: str) -> None:
    done = call(*(str(file) if word == "FILE" else word for word in arguments))
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
