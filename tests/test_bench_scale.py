"""The benchmark of sweeps in processes, at tiny size."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.repo,
    pytest.mark.skipif(sys.platform != "linux", reason="reads processor time from /proc"),
]

SCRIPT = Path(__file__).parent.parent / "benchmarks" / "scale.py"
SIZE = ("--setpoints", "1", "--months", "2", "--jobs", "8")


def test_a_sweep_and_jobs_that_do_nothing_are_measured(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), str(tmp_path), "--cases", "processes-1", *SIZE]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    sweep, nothing = json.loads((tmp_path / "scale.json").read_text("utf-8"))["runs"]
    assert sweep["steps"] == 8 * 28 * 96
    assert (nothing["jobs"], nothing["steps"]) == (8, 0)
    for run in (sweep, nothing):
        assert run["case"] == "processes-1"
        assert run["wall_s"] > 0
        assert run["most_mb"] > 0
    assert 0 < sweep["job_s"] <= 1.5 * sweep["core_s"]
    assert "| processes-1 |" in done.stdout
