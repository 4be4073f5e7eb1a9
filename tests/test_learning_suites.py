"""Rows of suites that learn."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sdc_taichi import build_fleet, make_controller
from sdc_taichi.benchmark.cases import data_centers
from sdc_taichi.benchmark.jobs import DoneJob, run_job
from sdc_taichi.benchmark.suite import Suite, make_suite
from sdc_taichi.benchmark.suite_run import row_jobs

pytest.importorskip("torch", reason="torch is not installed: make test-train")

CASE = {
    "config": "tiny",
    "sites": ["NY"],
    "training_weeks": [26],
    "validation_weeks": [28],
    "weeks": [27],
    "days": 2,
    "optimum": False,
}
TRAIN: dict[str, Any] = {"algorithm": "ippo", "steps": 1024, "data_centers": 4}


def suite(**row: Any) -> Suite:
    return make_suite(
        {
            "name": "learners",
            "title": "One week",
            "seeds": 1,
            "training": {"learning": {"hidden": [8], "rollout_decisions": 16}},
            "cases": {"tiny": CASE},
            "rows": {"ippo": row},
        }
    )


def run(chosen: Suite) -> DoneJob:
    done = run_job(row_jobs(chosen, ())[0], {})
    assert not done.error
    return done


def write(done: DoneJob, folder: Path) -> Path:
    for name, content in done.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def test_a_training_is_evaluated_and_leaves_a_policy_and_the_same_bits_again(
    tmp_path: Path,
) -> None:
    chosen = suite(train=TRAIN, agents_alone=True)
    done, again = run(chosen), run(chosen)
    assert (done.rows, done.files, done.metrics) == (again.rows, again.files, again.metrics)
    rows = pd.read_parquet(io.BytesIO(done.rows))
    assert rows["moves"].tolist() == ["all", "load", "cooling", "battery"]
    assert set(done.files) == {
        *("settings.yaml", "training.csv", "validation.csv"),
        *("best/policy.json", "best/policy.safetensors"),
    }
    assert b"seconds" not in done.files["training.csv"].splitlines()[0]
    assert done.metrics["trainings"]["training"]["steps"] == 1024
    fleet = build_fleet(data_centers(chosen.cases["tiny"], "held-out"))
    make_controller(f"policy:{write(done, tmp_path)}", fleet)


def test_agents_trained_apart_act_together(tmp_path: Path) -> None:
    chosen = suite(train=TRAIN, apart=True)
    done = run(chosen)
    assert list(done.metrics["trainings"]) == ["load", "cooling", "battery"]
    folder = write(done, tmp_path)
    spec = ",".join(f"{part}=policy:{folder / part}" for part in done.metrics["trainings"])
    fleet = build_fleet(data_centers(chosen.cases["tiny"], "held-out"))
    make_controller(spec, fleet)
    assert len(pd.read_parquet(io.BytesIO(done.rows))) == 1
