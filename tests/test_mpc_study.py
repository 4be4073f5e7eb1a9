"""The study of model-predictive control prints a row for each controller."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest

from known_optimum import made_up_optimum
from sdc_taichi import Simulator
from sdc_taichi.optimum.result import Optimum

pytestmark = pytest.mark.repo

EXAMPLES = Path(__file__).parent.parent / "examples"


def test_rows_say_what_controllers_change_and_which_forecasts_they_had(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def solve(configs: Any, *, steps: int, drivers: Any, objective: str, **_: Any) -> Optimum:
        with Simulator(configs, drivers=drivers) as sim:
            return made_up_optimum(sim, steps, objective)

    monkeypatch.syspath_prepend(str(EXAMPLES))
    study = importlib.import_module("mpc_study")
    monkeypatch.setattr(study, "solve", solve)
    tried = (("idle", study.PERFECT), ("mpc-2h", study.PERFECT), ("mpc-2h", study.ERRING))
    monkeypatch.setattr(study, "CONTROLLERS", tried)
    study.main(["--sites", "CA", "--weeks", "3", "--days", "1", "--objective", "cost"])
    printed = capsys.readouterr().out.splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in printed[4:]]
    assert [row[:2] for row in rows] == [
        ["idle", "perfect"],
        ["mpc-2h:cost", "perfect"],
        ["mpc-2h:cost", "10 %, 1 K"],
    ]
    assert rows[0][2:4] + rows[0][5:] == ["0.00", "0.00", "0", "0", "0"]
    assert rows[1][2] != rows[2][2]
