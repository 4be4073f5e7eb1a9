"""Run folders: damaged ones are refused, and reports escape whatever a config says."""

from __future__ import annotations

import json
import tempfile
from functools import cache
from pathlib import Path

from fuzz import damage
from fuzz.case import DefectError, Scratch
from sdc_taichi import (
    DataCenterConfig,
    RunRequest,
    Simulator,
    load_config,
    make_configs,
    make_controller,
    simulate_to_folder,
)
from sdc_taichi.config import with_values
from sdc_taichi.run.folder_reader import read_configs, read_fleet_steps, read_run, read_steps
from sdc_taichi.viz.report import write_report

REPORTS = 0.02
"""Share of the cases that draw a report, which takes a second."""


def simulate_into(folder: Path, configs: list[DataCenterConfig]) -> None:
    """Write the folder of a short run."""
    with Simulator(configs) as sim:
        simulate_to_folder(sim, make_controller("idle", sim.fleet), RunRequest("idle", 6), folder)


@cache
def run_files(dcs: int) -> dict[str, bytes]:
    """Files of a run of one or two data centers."""
    with tempfile.TemporaryDirectory() as folder:
        simulate_into(Path(folder), make_configs(load_config("tiny"), count=dcs))
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def run_folders(scratch: Scratch) -> None:
    """Read the damaged folder of a run, or one whose config says odd things."""
    by_name = scratch.chance(0.15)
    if by_name:
        folder = scratch.output("run")
        texts = {field: damage.scalar(scratch.rng)[:500] for field in ("name", "description")}
        config = with_values(load_config("tiny"), texts)
        simulate_into(folder, [config])
    else:
        folder = _damaged(scratch)
    run = read_run(folder)
    dcs = range(len(run.names))
    read_configs(run, dcs)
    read_steps(run, dcs)
    read_fleet_steps(run)
    if scratch.chance(0.25 if by_name else REPORTS):
        text = write_report(run, [], scratch.output("report.html")).read_text("utf-8")
        for odd in ("<script>alert", "\x1b", "\x07", "\x00"):
            if odd in text:
                raise DefectError(f"{odd!r} in the report")


def _damaged(scratch: Scratch) -> Path:
    """The folder of a run, one file of which is another in most cases."""
    rng = scratch.rng
    files = dict(run_files(1 + int(rng.integers(2))))
    name = scratch.pick(("metrics.json", "metrics.json", "steps.parquet"))
    content = files[name]
    how = int(rng.integers(5))
    if how == 0:
        del files[name]
    elif how == 1:
        files[name] = run_files(1 if "configs.yaml" in files else 2)[name]
    elif name == "metrics.json" and how < 4:
        files[name] = changed_json(scratch, content)
    elif how < 4:
        files[name] = damage.damaged_bytes(rng, content)
    for file, written in files.items():
        scratch.write(file, written)
    scratch.named += ["metrics.json", "steps.parquet"]
    return scratch.folder


def changed_json(scratch: Scratch, content: bytes) -> bytes:
    """JSON with another value somewhere."""
    values = json.loads(content)
    node = values
    while True:
        key = scratch.pick(list(node) if isinstance(node, dict) else list(range(len(node))))
        if not isinstance(node[key], dict | list) or not node[key] or scratch.chance(0.2):
            break
        node = node[key]
    node[key] = "MARK"
    return json.dumps(values).replace('"MARK"', scratch.pick(damage.JSON_VALUES)).encode()
