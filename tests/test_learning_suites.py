"""Rows of suites that learn."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import yaml

from sdc_taichi import build_fleet, make_controller
from sdc_taichi.benchmark.cases import data_centers, training_settings
from sdc_taichi.benchmark.executors import Executor, JobSummary, run_jobs
from sdc_taichi.benchmark.jobs import DoneJob, Inputs, Job, run_job
from sdc_taichi.benchmark.leaderboard import leaderboard
from sdc_taichi.benchmark.store import ResultStore
from sdc_taichi.benchmark.suite import Suite, load_suite, make_suite, suite_names
from sdc_taichi.benchmark.suite_results import read_suites
from sdc_taichi.benchmark.suite_run import row_jobs, run_suite, study_of
from sdc_taichi.learning.evaluation import Contender, evaluate, prepare
from sdc_taichi.learning.training_settings import TrainingSettings

pytest.importorskip("torch", reason="torch is not installed: make test-train")

from sdc_taichi.learning.trainer import train

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
    assert run(chosen).files == done.files
    # The first agent learns beside idle others, and the last one beside those trained before.
    for agent, part, is_equal in (("agent_ls", "load", True), ("agent_bat", "battery", False)):
        one = suite(train=TRAIN | {"environment": {"agents": [agent]}})
        curve = run(one).files["validation.csv"]
        assert (done.files[f"{part}/validation.csv"] == curve) is is_equal


def results_of(chosen: Suite, folder: Path) -> ResultStore:
    """Run a whole suite in this process."""
    store = ResultStore(folder)

    def stage(_: str, jobs: Sequence[Job], __: int, inputs: Inputs | None = None) -> JobSummary:
        return run_jobs(jobs, store, Executor(), inputs)

    with store.claimed(study_of(chosen, chosen, "command")):
        run_suite(chosen, store, stage)
    return store


def test_rows_train_with_the_best_settings_of_the_trials(tmp_path: Path) -> None:
    tuning = {"trials": 3, "steps": 1024, "space": {"ippo": {"rate": [0.01, 0.1, 0.2]}}}
    chosen = make_suite(suite(train=TRAIN).model_dump() | {"tuning": tuning})
    store = results_of(chosen, tmp_path)
    (results,) = read_suites([tmp_path])
    trials = leaderboard(results.cases["tiny"]).trials
    assert trials["trial"].tolist() == [0, 1, 2]
    assert trials["best"].sum() == 1
    best = json.loads(trials.sort_values("change_pct")["settings"].iloc[0])
    partition = {"suite": "learners", "case": "tiny", "row": "ippo", "seed": "0"}
    record = store.result(partition)
    assert record.metrics["tuned"] == best
    settings = yaml.safe_load(store.file(partition, "settings.yaml"))
    assert settings["learning"]["rate"] == best.get("rate", 1e-3)
    assert settings["learning"]["hidden"] == [8]
    assert record.training_core_s > 0.0


def test_policies_run_in_cases_in_which_they_were_not_trained(tmp_path: Path) -> None:
    away = {"trained_in": "tiny", "weeks": [29]}
    chosen = make_suite(suite(train=TRAIN, agents_alone=True).model_dump() | {
        "cases": {"tiny": CASE, "away": away}
    })  # fmt: skip
    store = results_of(chosen, tmp_path)
    rows = store.rows().set_index("case")
    assert rows["week"]["away"].tolist() == [29] * 4
    assert rows["moves"]["away"].tolist() == ["all", "load", "cooling", "battery"]
    policy = store.folder_of({"suite": "learners", "case": "tiny", "row": "ippo", "seed": "0"})
    home = data_centers(chosen.cases["tiny"], "held-out")
    with prepare(home, [29], optimum=False, days=2) as weeks:
        controller = make_controller(f"policy:{policy}", weeks.sim.fleet)
        again = evaluate(weeks, [Contender("again", controller)], beside=False).rows
    assert again["figure"].tolist() == rows["figure"]["away"].tolist()[:1]


def quick_trainings(name: str) -> list[TrainingSettings]:
    chosen = load_suite(name, quick=True)
    return [
        training_settings(
            case.model_copy(update={"optimum": False}),
            row,
            objective=str(chosen.objective),
            seed=0,
            training=chosen.training,
        )
        for of_case, case in chosen.cases.items()
        for of_row, row in chosen.rows.items()
        if case.trained_in is None and chosen.is_for(of_row, of_case)
        if row.train is not None
    ]


@pytest.mark.parametrize("name", [x for x in suite_names() if quick_trainings(x)])
def test_trainings_of_a_quick_suite_can_begin(name: str, tmp_path: Path) -> None:
    for at, settings in enumerate(quick_trainings(name)):
        assert train(settings, tmp_path / str(at), stop=lambda: True).steps == 0
