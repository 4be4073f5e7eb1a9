"""Folders of studies: damaged results are refused or made again, and never reported."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from fuzz import damage
from fuzz.case import DefectError, Scratch
from fuzz.run_folders import changed_json
from made_studies import write_study
from sdc_taichi.benchmark.report import write_report
from sdc_taichi.benchmark.store import ResultRecord, ResultStore
from sdc_taichi.benchmark.suite_results import read_suites
from sdc_taichi.errors import SdcError

REPORTS = 0.1
"""Share of the cases that write a report, which takes a second."""


@cache
def study_files() -> dict[str, bytes]:
    """Files of a made-up study by their paths."""
    with tempfile.TemporaryDirectory() as name:
        folder = write_study(Path(name) / "study")
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def studies(scratch: Scratch) -> None:
    """Read the folder of a study one file of which is another, and report it."""
    files = dict(study_files())
    kind = scratch.pick(("study.json", "metrics.json", "metrics.json", "rows.parquet"))
    name = scratch.pick([path for path in files if path.endswith(kind)])
    how = int(scratch.rng.integers(6))
    if how == 0:
        del files[name]
    elif how == 1:
        files[name] = files[scratch.pick(list(files))]
    elif kind == "rows.parquet" or how == 2:
        files[name] = damage.damaged_bytes(scratch.rng, files[name])
    else:
        files[name] = changed_json(scratch, files[name])
    folder = scratch.output("study")
    for path, written in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(written)
    scratch.named += ["study", kind]
    store = ResultStore(folder)
    changed = name in files and files[name] != study_files()[name]
    for record in store.results():
        try:
            is_whole = store.is_whole(record)
        except SdcError:
            is_whole = False
        if is_whole and changed and name.startswith(f"results/{_path(record)}/"):
            raise DefectError(f"{name} is not what its metrics.json tells of")
    if scratch.chance(0.3):
        store.study()
        store.rows()
    read_suites([folder])
    if scratch.chance(REPORTS):
        write_report([folder], markdown=scratch.output("tables.md"))


def _path(record: ResultRecord) -> str:
    """Path of a result, whose values need no quotes."""
    return "/".join(f"{column}={value}" for column, value in record.partition.items())
