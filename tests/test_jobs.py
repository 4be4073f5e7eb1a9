"""Jobs, the processes that run them, and the folder in which their results are kept."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow.dataset as ds
import pytest

import toy_jobs
from sdc_taichi.benchmark import executors
from sdc_taichi.benchmark.executors import Executor, JobSummary, LocalProcesses, run_jobs
from sdc_taichi.benchmark.jobs import Job, digest_of
from sdc_taichi.benchmark.store import ResultStore, Study, partition_path
from sdc_taichi.errors import ConfigError, SdcError, SdcWarning

SETTINGS = {"seeds": 2, "cases": {"a": {"days": 7}}}
STUDY = Study(kind="suite", command="sdc-taichi benchmark toy", settings=SETTINGS, partitions=[])


def run(
    jobs: Sequence[Job], folder: Path, executor: Executor | None = None, **options: Any
) -> JobSummary:
    """Run jobs as a study of its own, or go on with it."""
    store = ResultStore(folder)
    with store.claimed(STUDY, resume=True), executor or Executor() as workers:
        return run_jobs(jobs, store, workers, **options)


def content_of(folder: Path) -> dict[str, Any]:
    """Content of all files, without what may differ between equal runs."""
    content: dict[str, Any] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            content[str(path.relative_to(folder))] = path.read_bytes()
            if path.name == "metrics.json":
                metrics = json.loads(path.read_bytes())
                assert metrics.pop("core_s") >= 0.0
                content[str(path.relative_to(folder))] = json.dumps(metrics)
    return content


def draws(count: int, **values: Any) -> list[Job]:
    return [toy_jobs.job("draw", i, **values) for i in range(count)]


def test_results_are_equal_to_the_bit_in_any_number_of_processes(
    tmp_path: Path,
) -> None:
    content = {"trace": b"a" * 100_000, "other": b"b"}
    jobs = draws(5, inputs={"trace": digest_of(content["trace"])})
    for name, executor in (("here", Executor()), ("two", LocalProcesses(2))):
        done = run(jobs, tmp_path / name, executor, inputs=content)
        assert done == JobSummary(5, 0, (), True)
    here = content_of(tmp_path / "here")
    assert here == content_of(tmp_path / "two")
    assert len(here) == 1 + 5 * 3
    metrics = ResultStore(tmp_path / "two").result(jobs[3].partition).metrics
    assert metrics["read"] == {"trace": 100_000}
    assert metrics["bound"] is None


def test_a_process_computes_in_one_thread(tmp_path: Path) -> None:
    job = toy_jobs.job("about_process", 0)
    run([job], tmp_path, LocalProcesses(2))
    worker = ResultStore(tmp_path).result(job.partition).metrics
    assert set(worker["pools"]) <= {1}
    assert worker["taichi"] == "1"
    assert worker["main"] is True
    assert worker["pid"] != os.getpid()


def test_rows_are_a_dataset_with_hive_partitions(tmp_path: Path) -> None:
    run([*draws(2), toy_jobs.job("without_rows", 7)], tmp_path)
    rows = ResultStore(tmp_path).rows()
    assert list(rows.columns) == ["site", "sum", "suite", "case", "number"]
    assert rows["case"].unique().tolist() == ["c/draw"]
    assert rows["number"].tolist() == [0, 0, 1, 1]
    results = tmp_path / "results"
    by_pandas = pd.read_parquet(results, filters=[("number", "==", 1)])
    assert by_pandas["sum"].tolist() == rows["sum"].tolist()[2:]
    table = ds.dataset(results, partitioning="hive").to_table(filter=ds.field("site") == "NY")
    assert table["sum"].to_pylist() == rows["sum"].tolist()[::2]
    run([toy_jobs.job("other_columns", 1)], tmp_path)
    rows = ResultStore(tmp_path).rows().set_index("site")
    assert rows.loc["AZ", "cost"] == 5
    assert rows["cost"].isna().sum() == 4
    with pytest.raises(ConfigError, match=r"toy/c/draw/1: two jobs"):
        run([*draws(2), toy_jobs.job("draw", 1, seconds=0.0)], tmp_path)


def test_jobs_that_are_done_are_kept(tmp_path: Path) -> None:
    jobs = draws(4)
    run(jobs[:3], tmp_path)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.*") if path.is_file()}
    seen: list[tuple[str, bool]] = []
    done = run(jobs, tmp_path, on_done=lambda job, ended: seen.append((job.name, ended is None)))
    assert done == JobSummary(1, 3, (), True)
    assert seen == [(job.name, i < 3) for i, job in enumerate(jobs)]
    changed = {path.name for path, time_ns in before.items() if path.stat().st_mtime_ns != time_ns}
    assert changed == {"study.json"}
    other = [toy_jobs.job("draw", i, seconds=0.0) for i in range(3)]
    assert run(other, tmp_path).done == 3, "other values"


@pytest.mark.parametrize("name", ["metrics.json", "rows.parquet", "policy/weights.bin"])
@pytest.mark.parametrize("damage", ["truncated", "changed", "missing"])
def test_a_damaged_result_is_made_again(tmp_path: Path, name: str, damage: str) -> None:
    jobs = draws(2)
    run(jobs, tmp_path)
    before = content_of(tmp_path)
    folder = "results" if name == "rows.parquet" else "jobs"
    path = tmp_path / folder / partition_path(jobs[1].partition) / name
    content = path.read_bytes()
    half = len(content) // 2
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(content[:half] + (b"" if damage == "truncated" else b"\xff\xff") * half)
    assert run(jobs, tmp_path) == JobSummary(1, 1, (), True)
    assert content_of(tmp_path) == before


def test_a_job_that_fails_is_one_line_and_the_others_are_done(tmp_path: Path) -> None:
    jobs = [toy_jobs.job("refuse", 1), toy_jobs.job("divide", 2), *draws(2)]
    jobs.append(toy_jobs.job("no_such_function", 3))
    jobs.append(toy_jobs.job("draw", 4, inputs={"optimum": "0"}))
    done = run(jobs, tmp_path, LocalProcesses(2))
    assert (done.done, done.is_whole) == (2, True)
    errors = dict(done.failed)
    assert errors["toy/c/refuse/1"] == "number 1: valid is another"
    assert errors["toy/c/divide/2"].startswith(
        f"ZeroDivisionError: division by zero (at {toy_jobs.__file__}:"
    )
    assert "toy_jobs.py:" in errors["toy/c/divide/2"]
    assert "no_such_function" in errors["toy/c/no_such_function/3"]
    assert "input optimum is missing" in errors["toy/c/draw/4"]
    assert len(list(ResultStore(tmp_path).results())) == 2


def test_warnings_of_jobs_are_issued_again(tmp_path: Path) -> None:
    with pytest.warns(SdcWarning, match="^odd$"):
        run([toy_jobs.job("warn", 0)], tmp_path)


def test_a_killed_process_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "MOST_ATTEMPTS", 2)
    mark = str(tmp_path / "mark")
    jobs = [*draws(3), toy_jobs.job("killed_once", 3, mark=mark), toy_jobs.job("killed", 4)]
    done = run(jobs, tmp_path / "out", LocalProcesses(2))
    assert (done.done, done.is_whole) == (4, True)
    ((name, error),) = done.failed
    assert name == "toy/c/killed/4"
    assert "killed 2 times; memory may be short" in error
    # Files are those of the same jobs that nothing happened to.
    assert run(jobs[:4], tmp_path / "again").done == 4
    undisturbed = content_of(tmp_path / "again")
    assert content_of(tmp_path / "out") == undisturbed


def test_an_interruption_ends_running_jobs_and_keeps_the_others(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    jobs = [toy_jobs.job("sleep_long", 1, mark=str(mark)), *draws(2)]
    ended: list[str] = []

    def stop() -> bool:
        return bool(ended) and mark.exists() and bool(mark.read_text())

    done = run(
        jobs,
        tmp_path / "out",
        LocalProcesses(2),
        stop=stop,
        on_done=lambda job, _: ended.append(job.name),
    )
    assert not done.is_whole
    assert not done.failed
    assert ended
    assert done.done == len(ended) == len(list(ResultStore(tmp_path / "out").results()))
    assert not is_running(int(mark.read_text()))


def test_processes_end_with_a_driver_that_is_killed_and_a_resumed_study_is_equal(
    tmp_path: Path,
) -> None:
    out, mark = tmp_path / "out", tmp_path / "mark"
    code = (
        "from pathlib import Path; import test_jobs, toy_jobs\n"
        "from sdc_taichi.benchmark.executors import LocalProcesses\n"
        "if __name__ == '__main__':\n"
        f"    jobs = [*test_jobs.draws(2), toy_jobs.job('sleep_long', 2, mark={str(mark)!r})]\n"
        f"    test_jobs.run(jobs, Path({str(out)!r}), LocalProcesses(1))\n"
    )
    here = str(Path(__file__).parent)
    environment = {**os.environ, "PYTHONPATH": here}
    with subprocess.Popen([sys.executable, "-c", code], env=environment) as driver:
        wait_until(lambda: mark.exists() and bool(mark.read_text()))
        wait_until(lambda: len(list(out.rglob("metrics.json"))) == 2)
        with pytest.raises(SdcError, match="another run is writing it"):
            run(draws(1), out)
        driver.kill()
    pid = int(mark.read_text())
    wait_until(lambda: not is_running(pid))
    assert run(draws(3), out) == JobSummary(1, 2, (), True)
    run(draws(3), tmp_path / "whole")
    assert content_of(out) == content_of(tmp_path / "whole")


def wait_until(reached: Any, most_s: float = 30.0) -> None:
    """Wait until something is so, or fail."""
    end_s = time.monotonic() + most_s
    while not reached():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def is_running(pid: int) -> bool:
    """Whether a process runs, and is not merely waited for."""
    try:
        os.kill(pid, 0)
        state = Path(f"/proc/{pid}/stat")
        return not (state.exists() and state.read_text().rpartition(")")[2].split()[0] == "Z")
    except (ProcessLookupError, FileNotFoundError):
        return False


def study(command: str, *seeds: str) -> Study:
    """A study with a job for each seed."""
    partitions = [{"seed": seed} for seed in seeds]
    return Study(kind="suite", command=command, settings=SETTINGS, partitions=partitions)


def test_a_study_is_begun_once_and_continued_with_its_settings(tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    with store.claimed(study("a", "0", "1"), resume=True) as notes:
        assert notes == ()
    with pytest.raises(ConfigError, match="holds a study; go on with it with --resume"):
        store.claimed(study("a")).__enter__()
    for command, seeds in (("b", "12"), ("d", "1")):
        with store.claimed(study(command, *seeds), resume=True):
            pass
        assert store.study().command == "b"
        assert store.study().partitions == [{"seed": "0"}, {"seed": "1"}, {"seed": "2"}]
    settings = {"seeds": 3, "cases": {"a": {"days": 7, "boundary": "cyclic"}}}
    other = STUDY.model_copy(update={"settings": settings})
    said = "seeds 2, here 3; cases.a.boundary not given, here 'cyclic'"
    with pytest.raises(ConfigError, match=said):
        store.claimed(other, resume=True).__enter__()
    assert store.study().command == "b"


def test_folders_that_are_not_free_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for out, said in (
        (tmp_path, r"holds other files \('file'\)"),
        (tmp_path / "file", "is a file"),
        (tmp_path / "file" / "out", "cannot be written"),
    ):
        with pytest.raises(SdcError, match=said):
            ResultStore(out).claimed(STUDY).__enter__()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "study.json").write_text('{"format": "sdc-study/1"')
    with pytest.raises(ConfigError, match=r"study\.json: Invalid JSON"):
        ResultStore(tmp_path / "out").claimed(STUDY, resume=True).__enter__()


@pytest.mark.parametrize("name", ["", "/a", "../a", "a/../b", ".hidden", "metrics.json", "a\\b"])
def test_names_of_files_stay_in_the_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(SdcError, match="valid is a path below"):
        ResultStore(tmp_path).file({"a": "b"}, name)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("format", "sdc-result/0", "format: should be 'sdc-result/1'"),
        ("core_s", True, "core_s: should be a valid number"),
        ("files_sha256", {"../../study.json": "0"}, "valid is a path below the folder"),
    ],
)
def test_metrics_that_others_have_edited_are_refused(
    tmp_path: Path, key: str, value: Any, said: str
) -> None:
    jobs, store = draws(1), ResultStore(tmp_path)
    run(jobs, tmp_path)
    path = store.folder_of(jobs[0].partition) / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(SdcError, match=said):
        store.is_whole(store.result(jobs[0].partition))
    assert not store.is_done(jobs[0])
