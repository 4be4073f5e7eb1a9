"""Simulation of a run and writer of its run folder.

A run folder contains ``steps.parquet``, ``metrics.json`` and ``config.yaml`` (one data center) or
``configs.yaml`` (several, one YAML document each), ``flows.parquet`` if fleets share work, and on
request ``racks.parquet``. Every file is written under a temporary name and renamed when it is
complete; while a run writes, a second run into the folder is refused. Equal runs produce identical
bytes on processors with the same features. See docs/run-folder.md for the columns.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from sdc_taichi.atomic_file import AtomicFile, atomic_write, naming_errors
from sdc_taichi.config import DataCenterConfig, load_json
from sdc_taichi.control import Controller
from sdc_taichi.errors import ConfigError, PhysicalLimitError
from sdc_taichi.optimum.result import Optimum
from sdc_taichi.run.achievable import achievement, begin_score, put_beside
from sdc_taichi.run.description import RunRequest, describe_run
from sdc_taichi.run.flows_file import FLOWS_FILE, FlowsWriter
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import Totals, empty_totals, metrics_of_fleet, metrics_per_dc
from sdc_taichi.run.rack_history import (
    RACK_HISTORY_FILE,
    HistoryRequest,
    RackHistoryWriter,
    check_history,
)
from sdc_taichi.run.steps_file import STEPS_FILE, StepsWriter
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import StepResult
from sdc_taichi.user_file import MOST_METRICS_BYTES, read_text

METRICS_FILE = "metrics.json"
"""Name of the metrics file, which is written last: its presence marks a complete run folder."""
REPORT_FILE = "report.html"
"""Name of the report that ``sdc-taichi report`` writes from the other files of a run folder."""
OPTIMUM_FILE = "optimum.json"
"""Name of the file that ``optimum_folder.write_optimum`` adds to the run of a known optimum."""
EXPORT_FILES = tuple(
    f"{table}{end}" for table in ("steps", "racks") for end in (".csv", ".xlsx", ".bms.csv")
)
"""Names of the files that ``sdc-taichi export`` writes from the tables of a run folder."""
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def simulate_to_folder(
    sim: Simulator,
    controller: Controller,
    request: RunRequest,
    out: Path,
    *,
    force: bool = False,
    history: HistoryRequest | None = None,
    optimum: Optimum | None = None,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> dict[str, Any] | None:
    """Simulate a run with ``simulate``, and write its files to a folder.

    Args:
        sim: The simulator; its data centers must have distinct names.
        controller: Controller of the run.
        request: Steps, seed, forecast errors and name of the controller.
        out: Folder of the run, created if necessary; files of an earlier run are replaced.
        force: True allows a folder that contains other files.
        history: Requested history of racks, written to racks.parquet; None writes none.
        optimum: Known optimum of the same configs, inputs and steps, with which metrics.json
            compares the run; a run that ends early is not compared.
        on_step: Callback that receives the result of every step.
        stop: Callback before every step; if it returns True, the run ends and the completed steps
            are written.

    Returns:
        The content of metrics.json; None, without files, if the run was stopped before its first
        step.

    Raises:
        PhysicalLimitError: A result is physically impossible; the files contain the steps before.
        SdcError: The folder contains other files, another run is writing to it, a file cannot be
            written, the requested history does not fit the halls or the disk, or an action of the
            controller is not valid.
    """
    sim.fleet.require_distinct_names()
    prepare_folder(out, force=force)
    if history is not None:
        check_history(history, sim.fleet, request.steps, out)
    description = describe_run(sim, request)
    configs = configs_yaml(sim.fleet.configs)
    names = ["config.yaml", "configs.yaml"]
    config_name, other_name = names if sim.size == 1 else names[::-1]
    metadata = {**description, "configs_yaml": configs}
    # A dict serves as an ordered set: events stay in the order of their first step.
    events: dict[ActiveEvent, None] = {}
    # The open temporary file is a lock that keeps a second run out of the folder.
    metrics_file = AtomicFile(out / METRICS_FILE)
    with contextlib.ExitStack() as files:
        files.enter_context(metrics_file)
        writer = files.enter_context(StepsWriter(out / STEPS_FILE, sim, metadata))
        flows = None
        if sim.fleet.shared_work is not None:
            flows = files.enter_context(FlowsWriter(out / FLOWS_FILE, sim, description))
        racks = None
        if history is not None:
            path = out / RACK_HISTORY_FILE
            racks = files.enter_context(RackHistoryWriter(path, sim, history, description))
        # Check again, because another run may have finished here before the lock was taken.
        has_former_run = prepare_folder(out, force=force)

        score = None if optimum is None else begin_score(optimum, sim, request.seed)

        def write_step(result: StepResult) -> None:
            writer.add(result)
            if flows is not None:
                flows.add(result)
            if racks is not None:
                racks.add(result)
            if score is not None:
                score.add(result)
            events.update(dict.fromkeys(sim.active_events(result.step)))
            if on_step is not None:
                on_step(result)

        totals = empty_totals(sim.size, sim.step_h)
        beyond: PhysicalLimitError | None = None
        try:
            simulate(
                sim,
                controller,
                request.steps,
                request.seed,
                forecast_error=request.forecast_error,
                on_step=write_step,
                stop=stop,
                totals=totals,
            )
        except PhysicalLimitError as error:
            if totals.steps == 0:
                raise
            # The completed steps are valid, so their files are written before the error is raised.
            beyond = error
        if totals.steps == 0:
            return None
        writer.commit()
        if flows is not None:
            flows.commit()
        if racks is not None:
            racks.commit()
        write_text(out / config_name, configs)
        if has_former_run:
            tables = {RACK_HISTORY_FILE: racks, FLOWS_FILE: flows}
            former = [name for name, table in tables.items() if table is None]
            for name in (other_name, REPORT_FILE, OPTIMUM_FILE, *EXPORT_FILES, *former):
                with naming_errors(out / name):
                    (out / name).unlink(missing_ok=True)
        content = _metrics_content(description, totals, sim.fleet, events)
        if optimum is not None and score is not None and totals.steps == optimum.steps:
            put_beside(content, optimum, achievement(optimum, request.controller, score))
        with naming_errors(metrics_file.path):
            metrics_file.file.write(f"{metrics_json(content)}\n".encode())
        metrics_file.commit()
    if beyond is not None:
        raise PhysicalLimitError(f"{beyond}; {out} holds the {totals.steps} steps before")
    return content


def metrics_json(content: dict[str, Any]) -> str:
    """Return the content of metrics.json as JSON text."""
    return json.dumps(content, indent=2, allow_nan=False)


def configs_yaml(configs: Sequence[DataCenterConfig]) -> str:
    """Return configs as YAML text, one document per data center."""
    dumped = (c.model_dump(mode="json") for c in configs)
    return yaml.dump_all(
        dumped, Dumper=_DUMPER, sort_keys=False, allow_unicode=True, explicit_start=len(configs) > 1
    )


def prepare_folder(out: Path, *, force: bool = False) -> bool:
    """Create the folder of a run, or check that its files may be replaced.

    Args:
        out: Path of the folder.
        force: True allows a folder that contains other files.

    Returns:
        True if the folder contains an earlier run.

    Raises:
        SdcError: The folder contains files that are not of a run, without ``force``, or it cannot
            be created or read.
    """
    with naming_errors(out):
        if out.exists() and not out.is_dir():
            raise ConfigError(f"{out}: is a file; valid is a folder to write the run to")
        out.mkdir(parents=True, exist_ok=True)
        others = sorted(p.name for p in out.iterdir() if not _is_left_by_broken_run(p))
    has_former_run = _is_run_folder(out)
    if others and not force and not has_former_run:
        some = ", ".join(others[:3]) + (", ..." if len(others) > 3 else "")
        raise ConfigError(
            f"{out}: holds files that are not of a run ({some}); choose an empty folder with --out "
            "or write into it with --force"
        )
    return has_former_run


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically: a reader sees either the old or the complete new content.

    Raises:
        SdcError: The file cannot be written.
    """
    with atomic_write(path) as file:
        file.write(text.encode())


def _metrics_content(
    description: dict[str, Any], totals: Totals, fleet: Fleet, events: Iterable[ActiveEvent]
) -> dict[str, Any]:
    """Return the content of metrics.json: description, completed steps, metrics and events."""
    return {
        **description,
        "steps_done": totals.steps,
        "data_centers": [
            {**dc, "metrics": metrics, "events": dc_events}
            for dc, metrics, dc_events in zip(
                description["data_centers"],
                metrics_per_dc(totals, fleet),
                _events_by_dc(events, fleet.size),
                strict=True,
            )
        ],
        "total": metrics_of_fleet(totals, fleet),
    }


def _events_by_dc(events: Iterable[ActiveEvent], size: int) -> list[list[dict[str, Any]]]:
    """Return the events of each of ``size`` data centers as lists for metrics.json."""
    by_dc: list[list[dict[str, Any]]] = [[] for _ in range(size)]
    for event in events:
        fields = asdict(event)
        dc = fields.pop("dc")
        by_dc[dc].append({name: value for name, value in fields.items() if value is not None})
    return by_dc


def _is_left_by_broken_run(path: Path) -> bool:
    """Return True for a file that a run can leave behind if it ends before writing metrics.json."""
    tables = (STEPS_FILE, FLOWS_FILE, RACK_HISTORY_FILE)
    names = (*tables, REPORT_FILE, OPTIMUM_FILE, *EXPORT_FILES)
    return path.name in names or path.suffix in (".part", ".rrd")


def _is_run_folder(out: Path) -> bool:
    """Return True if a folder contains the metrics.json of a run."""
    try:
        content = load_json(read_text(out / METRICS_FILE, MOST_METRICS_BYTES))
    except ValueError:  # Errors of missing or unreadable files are ValueErrors too.
        return False
    return isinstance(content, dict) and str(content.get("format", "")).startswith("sdc-run/")
