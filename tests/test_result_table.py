"""Table rows and metrics of results that others may have made: one reader for all users."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from made_studies import ROWS, done_job, frame_of, frames_of_row
from sdc_taichi import ConfigError, SdcError, load_config
from sdc_taichi.benchmark.executors import Executor, run_jobs
from sdc_taichi.benchmark.jobs import DoneJob, Job, digest_of, run_job
from sdc_taichi.benchmark.report import write_report
from sdc_taichi.benchmark.result_table import MOST_ROWS, SUITE_COLUMNS, read_any_rows
from sdc_taichi.benchmark.store import ResultStore, Study
from sdc_taichi.benchmark.submission import add_submission, write_submission
from sdc_taichi.benchmark.suite_jobs import check_reference, check_row
from sdc_taichi.benchmark.suite_results import read_suites
from sdc_taichi.benchmark.sweep import Sweep, check_part, stored_metrics, sweep_inputs, sweep_jobs
from sdc_taichi.benchmark.vary import Grid
from sdc_taichi.learning.evaluation import METRICS

Forge = Callable[[pd.DataFrame, str], Any]
PATH = Path("rows.parquet")


def parquet_of(table: pd.DataFrame | pa.Table, **options: Any) -> bytes:
    out = io.BytesIO()
    whole = pa.Table.from_pandas(table, preserve_index=False) if isinstance(
        table, pd.DataFrame
    ) else table  # fmt: skip
    pq.write_table(whole, out, **options)
    return out.getvalue()


def cell(value: Any) -> Forge:
    """A forgery that replaces the second value of a column."""

    def forge(frame: pd.DataFrame, name: str) -> pd.DataFrame:
        values = list(frame[name].astype(object))
        return frame.assign(**{name: pd.Series([values[0], value, *values[2:]])})

    return forge


def column(value: Any, of_type: pa.DataType | None = None) -> Forge:
    """A forgery that replaces all values of a column."""

    def forge(frame: pd.DataFrame, name: str) -> pa.Table:
        table = pa.Table.from_pandas(frame, preserve_index=False)
        values = pa.array([value] * len(frame), of_type)
        return table.set_column(table.column_names.index(name), name, values)

    return forge


def twice(frame: pd.DataFrame, name: str) -> pa.Table:
    table = pa.Table.from_pandas(frame, preserve_index=False)
    return table.append_column(name, table.column(name))


NUMBERS = {
    "null": cell(None),
    "nan": cell(float("nan")),
    "infinite": cell(float("inf")),
    "huge": cell(1e300),
    "negative": cell(-5.0),
    "text": column("x"),
    "boolean": column(True),
    "list": column([1.0]),
    "bytes": column(b"x"),
    "struct": column({"a": 1}),
    "nothing": column(None, pa.null()),
    "missing": lambda frame, name: frame.drop(columns=name),
    "twice": twice,
    "fewer rows": lambda frame, _name: frame[:-1],
    "more rows": lambda frame, _name: pd.concat([frame, frame[-1:]]),
    "no rows": lambda frame, _name: frame[:0],
}
TEXTS = {
    "null": cell(None),
    "number": column(1.0),
    "boolean": column(True),
    "list": column(["x"]),
    "bytes": column(b"x"),
    "long": column("x" * 20_000),
    "missing": NUMBERS["missing"],
    "twice": twice,
}
FORGERIES = [
    *((name, "cost", forge) for name, forge in NUMBERS.items()),
    *((name, "idle_figure", NUMBERS[name]) for name in ("nan", "text", "missing")),
    *((name, "week", forge) for name, forge in NUMBERS.items()),
    ("half", "week", column(3.5)),
    ("boolean", "share", column(True)),
    ("huge", "share", cell(1e300)),
    ("hot", "hottest_inlet_c", cell(1e4)),
    *((name, "site", forge) for name, forge in TEXTS.items()),
    *((name, "moves", forge) for name, forge in TEXTS.items()),
    ("other", "moves", column("chiller")),
]
COUNTS = ("fewer rows", "more rows", "no rows")


def forged(frame: pd.DataFrame, name: str, forge: Forge) -> bytes:
    return parquet_of(forge(frame, name))


def refused(error: pytest.ExceptionInfo[SdcError], what: str, name: str) -> bool:
    """True if a message is one line that names file and column."""
    text = str(error.value)
    place = "row" if what in COUNTS else f"column {name}"
    return "\n" not in text and len(text) < 800 and place in text and "seed=0" in text


@pytest.mark.parametrize(("what", "name", "forge"), FORGERIES)
def test_a_forged_cell_is_refused_by_all_users(
    study: Path, tmp_path: Path, what: str, name: str, forge: Forge
) -> None:
    # ``report`` reads a folder with a forged cell.
    target = Path(shutil.copytree(study, tmp_path / "target"))
    store = ResultStore(target)
    of_row = done_job("g36", 0, frames_of_row("g36", 0), spec=ROWS["g36"])
    rows = forged(frames_of_row("g36", 0), name, forge)
    store.keep(DoneJob(of_row.job, rows=rows, metrics=of_row.metrics))
    for output in ("html", "markdown"):
        with pytest.raises(SdcError) as raised:
            write_report([target], **{output: tmp_path / f"report.{output}"})
        assert refused(raised, what, name)
    # ``add`` reads a submitted row with a forged cell.
    row = tmp_path / "row"
    write_submission(row, {0: frame_of(0.05)}, suite="made-up", case="two-sites", row="theirs",
                     kind="controller", author="a")  # fmt: skip
    (record,) = ResultStore(row).results()
    rows = forged(frame_of(0.05), name, forge)
    ResultStore(row).write(record.model_copy(update={"rows_sha256": digest_of(rows)}), rows, {})
    before = sorted(study.rglob("*"))
    with pytest.raises(SdcError) as raised:
        add_submission(row, study)
    assert refused(raised, what, name)
    assert sorted(study.rglob("*")) == before
    # A study that goes on.
    values = {"row": {"best_of": None}, "case": {"weeks": [3, 7, 11]}}
    with pytest.raises(SdcError):
        check_row(values, of_row.metrics, rows)
    check_row(values, of_row.metrics, of_row.rows)


@pytest.mark.parametrize("name", [name for name in SUITE_COLUMNS if name not in ("moves", "site")])
def test_each_number_has_a_range(study: Path, tmp_path: Path, name: str) -> None:
    target = Path(shutil.copytree(study, tmp_path / "target"))
    done = done_job("g36", 0, frames_of_row("g36", 0), spec=ROWS["g36"])
    rows = forged(frames_of_row("g36", 0), name, column(1e300))
    ResultStore(target).keep(DoneJob(done.job, rows=rows, metrics=done.metrics))
    with pytest.raises(ConfigError, match=f"column {name}"):
        read_suites([target])


BOMBS: dict[str, Callable[[], bytes]] = {
    "many rows": lambda: parquet_of(pa.table({"cost": pa.array(np.zeros(5_000_000))})),
    "many columns": lambda: parquet_of(pa.table({f"c{i}": [0.0] for i in range(2000)})),
    "many long texts": lambda: parquet_of(pa.table({"site": repeated("x" * 1_000_000, 150_000)})),
    "different long texts": lambda: parquet_of(
        pa.table({"site": [f"{i}" + "x" * 1_000_000 for i in range(300)]}),
        compression="zstd",
        use_dictionary=False,
    ),
    "texts by their difference": lambda: parquet_of(
        pa.table({"site": [f"{'x' * 100_000}{i}" for i in range(100)]}),
        use_dictionary=False,
        column_encoding={"site": "DELTA_BYTE_ARRAY"},
    ),
}


def repeated(text: str, count: int) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(count, dtype=np.int32)), [text])


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_cannot_fill_the_memory(name: str) -> None:
    content = BOMBS[name]()
    assert len(content) < 1_500_000
    before, pool = pa.default_memory_pool(), pa.proxy_memory_pool(pa.default_memory_pool())
    pa.set_memory_pool(pool)
    try:
        with pytest.raises(ConfigError) as raised:
            read_any_rows(content, PATH)
    finally:
        pa.set_memory_pool(before)
    assert "\n" not in str(raised.value)
    assert pool.max_memory() < 50_000_000


def test_a_table_of_the_largest_size_is_read() -> None:
    values = np.arange(float(MOST_ROWS))
    table = pa.table({"cost": values, "site": repeated("NY", MOST_ROWS)})
    rows = read_any_rows(parquet_of(table), PATH)
    assert rows["cost"].tolist() == values.tolist()
    assert set(rows["site"]) == {"NY"}


SWEEP = Sweep(
    load_config("tiny"),
    (Grid("hvac.setpoint.initial_c", (18.0, 20.0)), Grid("site.location", ("NY", "CA"))),
    days=1,
    batch=2,
)


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Job], dict[str, bytes]]:
    """A finished sweep of two jobs, with its jobs and inputs."""
    folder, inputs = tmp_path_factory.mktemp("sweep"), sweep_inputs(SWEEP)
    jobs = list(sweep_jobs(SWEEP, inputs))
    for job in jobs:
        ResultStore(folder).keep(run_job(job, inputs))
    return folder, jobs, inputs


def resumed(folder: Path, jobs: list[Job], inputs: dict[str, bytes]) -> tuple[int, int]:
    """Number of jobs that a resumed sweep runs and keeps."""
    store = ResultStore(folder)
    study = Study(kind="sweep", command="", settings=SWEEP.settings(), partitions=[])
    with store.claimed(study, resume=(folder / "study.json").exists()):
        done = run_jobs(jobs, store, Executor(), inputs)
    assert [count for count, _ in stored_metrics(store, jobs)] == [2, 2]
    return done.done, done.kept


def copied(swept: tuple[Path, list[Job], dict[str, bytes]], tmp_path: Path) -> Path:
    for part in ("jobs", "results"):
        shutil.copytree(swept[0] / part, tmp_path / "sweep" / part)
    study = Study(kind="sweep", command="", settings=SWEEP.settings(), partitions=[])
    (tmp_path / "sweep" / "study.json").write_text(json.dumps(study.model_dump()))
    return tmp_path / "sweep"


RECORDS: dict[str, dict[str, Any]] = {
    "metrics: {}": {"metrics": {}},
    "failed: null": {"metrics": {"failed": None, "notes": []}},
    "failed: texts": {"metrics": {"failed": ["x"], "notes": []}},
    "failed: numbers": {"metrics": {"failed": [{"combination": 1, "error": []}], "notes": []}},
    "failed: one": {
        "metrics": {"failed": [{"combination": "x", "error": "y"}], "notes": []},
    },
    "notes: number": {"metrics": {"failed": [], "notes": 3}},
    "notes: lists": {"metrics": {"failed": [], "notes": [["x"]]}},
    "values: {}": {"values": {}},
    "cells: null": {"values": {"cells": None}},
    "function": {"function": "other:function"},
    "no rows": {"rows_sha256": ""},
    "core_s": {"core_s": -1.0},
}


@pytest.mark.parametrize("name", RECORDS)
def test_a_sweep_makes_a_forged_job_again(
    swept: tuple[Path, list[Job], dict[str, bytes]], tmp_path: Path, name: str
) -> None:
    folder, jobs = copied(swept, tmp_path), swept[1]
    path = ResultStore(folder).folder_of(jobs[1].partition) / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | RECORDS[name]))
    if "metrics" in RECORDS[name] and name != "failed: one":
        counted = [count for count, _ in stored_metrics(ResultStore(folder), jobs)]
        assert counted == [2], "an interrupted sweep counts its valid jobs"
    assert resumed(folder, *swept[1:]) == (1, 1)


@pytest.mark.parametrize(
    ("what", "name"),
    [(what, "cost") for what in NUMBERS if what not in ("null", "nan", "nothing")]
    + [(what, "pue") for what in ("text", "boolean", "list", "infinite", "huge")]
    + [("text", "hvac.setpoint.initial_c"), ("number", "site.location"), ("null", "site")],
)
def test_a_sweep_makes_forged_rows_again(
    swept: tuple[Path, list[Job], dict[str, bytes]], tmp_path: Path, what: str, name: str
) -> None:
    folder, jobs = copied(swept, tmp_path), swept[1]
    store = ResultStore(folder)
    record = store.result(jobs[1].partition)
    frame = pd.read_parquet(io.BytesIO(store.rows_file(record)))
    rows = forged(frame, name, {**TEXTS, **NUMBERS}[what])
    store.write(record.model_copy(update={"rows_sha256": digest_of(rows)}), rows, {})
    if what not in ("missing", "fewer rows", "more rows", "number", "null"):
        with pytest.raises(ConfigError) as raised:
            store.rows([name, "part"], [name])
        assert "\n" not in str(raised.value)
        assert "part=1" in str(raised.value)
    assert resumed(folder, *swept[1:]) == (1, 1)


def test_valid_jobs_of_a_sweep_are_kept(
    swept: tuple[Path, list[Job], dict[str, bytes]], tmp_path: Path
) -> None:
    folder, jobs = copied(swept, tmp_path), swept[1]
    assert resumed(folder, *swept[1:]) == (0, 2)
    rows = ResultStore(folder).rows()
    assert set(METRICS) <= set(rows.columns)
    assert rows["part"].tolist() == [0, 0, 1, 1]
    failed = {"failed": [{"combination": "x", "error": "y"}] * 2, "notes": []}
    check_part(jobs[0].values, failed, b"")


@pytest.mark.parametrize(
    "metrics", [{}, {"part": "held-out"}, {"part": 1, "site": "ca", "weeks": "x"}]
)
def test_metrics_of_optima_are_whole(metrics: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"^metrics\.json: "):
        check_reference({}, metrics, b"")


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        ({"core_s": float("inf")}, "core_s"),
        ({"metrics": {"x": float("nan")}}, "NaN"),
        ({"metrics": {"chosen": ["g36"]}}, "metrics: chosen"),
        ({"files_sha256": {"a\0.rrd": "0"}}, "valid is a path below the folder"),
        ({"values": []}, "values"),
    ],
)
def test_a_forged_record_is_one_line(
    study: Path, tmp_path: Path, edit: dict[str, Any], said: str
) -> None:
    target = Path(shutil.copytree(study, tmp_path / "target"))
    partition = {"suite": "made-up", "case": "two-sites", "row": "g36", "seed": "0"}
    path = ResultStore(target).folder_of(partition) / "metrics.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | edit))
    with pytest.raises(SdcError, match=said) as raised:
        write_report([target], markdown=tmp_path / "report.md")
    assert "\n" not in str(raised.value)
    assert "metrics.json" in str(raised.value)
