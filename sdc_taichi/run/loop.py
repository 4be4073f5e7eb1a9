"""Run a simulator under a controller, and record what it did in files.

A recorded run is a folder of ``steps.parquet``, ``metrics.json`` and ``config.yaml`` (one data
center) or ``configs.yaml`` (several, one YAML document each). Every file is written beside its
place and renamed when it is whole. Equal runs give equal bytes. See docs/cli.md for the columns.
"""

from __future__ import annotations

import functools
import json
import operator
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml

from sdc_taichi.atomic_file import AtomicFile, atomic_write, delete_leftovers, naming_errors
from sdc_taichi.config import DataCenterConfig
from sdc_taichi.control import Controller, viewer
from sdc_taichi.errors import ConfigError
from sdc_taichi.exogenous.files import sha256
from sdc_taichi.run import metrics
from sdc_taichi.sim.events import ActiveEvent
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult
from sdc_taichi.year_clock import step_times

FORMAT = "sdc-run/1"
METADATA_KEY = b"sdc_taichi"
REPORT_FILE = "report.html"
"""Made of the files of a run by ``sdc-taichi report``."""
_ROWS_PER_GROUP = 1 << 16
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What a run was asked to do."""

    controller: str
    """Name, for the record."""
    steps: int
    seed: int = 0


def run(
    sim: Simulator,
    controller: Controller,
    steps: int,
    seed: int = 0,
    *,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> metrics.Totals:
    """Reset and run.

    Args:
        sim: the simulator.
        controller: what drives it.
        steps: number of steps.
        seed: of simulator and controller.
        on_step: called after every step.
        stop: asked before every step; true ends the run.

    Returns:
        The totals of the steps done.

    Raises:
        SdcError: a command that is not valid.
    """
    sim.reset(seed)
    controller.reset(seed)
    look = viewer(sim)
    totals = metrics.begin(sim.size, sim.step_h)
    last: StepResult | None = None
    for _ in range(steps):
        if stop is not None and stop():
            break
        last = sim.step(controller.act(look(last)))
        metrics.add(totals, last)
        if on_step is not None:
            on_step(last)
    return totals


def record(
    sim: Simulator,
    controller: Controller,
    asked: RunRequest,
    out: Path,
    *,
    force: bool = False,
    on_step: Callable[[StepResult], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> dict[str, Any] | None:
    """Run and write the files of the run.

    Args:
        sim: the simulator.
        controller: what drives it.
        asked: steps, seed and the controller's name.
        out: folder, created if need be; files of a former run there are replaced.
        force: also write into a folder with other files.
        on_step: called after every step.
        stop: asked before every step; true ends the run with files of the steps done.

    Returns:
        The content of metrics.json; None, and no files, if it was stopped before the first step.

    Raises:
        SdcError: the folder is not free, a file cannot be written, or a command is not valid.
    """
    sim.fleet.require_distinct_names()
    former = prepare_folder(out, force=force)
    about = describe(sim, asked)
    configs = configs_yaml(sim.fleet.configs)
    names = ["config.yaml", "configs.yaml"]
    config_name, other_name = names if sim.size == 1 else names[::-1]
    with StepsWriter(out / "steps.parquet", sim, {**about, "configs_yaml": configs}) as writer:
        met: dict[ActiveEvent, None] = {}

        def each(result: StepResult) -> None:
            writer.add(result)
            met.update(dict.fromkeys(sim.active_events(result.step)))
            if on_step is not None:
                on_step(result)

        totals = run(sim, controller, asked.steps, asked.seed, on_step=each, stop=stop)
        if totals.steps == 0:
            return None
        writer.commit()
    write_text(out / config_name, configs)
    if former:
        # What a former run left, and what was made of it.
        for name in (other_name, REPORT_FILE):
            with naming_errors(out / name):
                (out / name).unlink(missing_ok=True)
    events = _events_by_dc(met, sim.size)
    report = {
        **about,
        "steps_done": totals.steps,
        "data_centers": [
            {**dc, "metrics": figures, "events": own}
            for dc, figures, own in zip(
                about["data_centers"], metrics.per_dc(totals, sim.fleet), events, strict=True
            )
        ],
        "total": metrics.overall(totals, sim.fleet),
    }
    # Last, because it marks the folder as that of a whole run.
    write_text(out / "metrics.json", report_json(report) + "\n")
    return report


def describe(sim: Simulator, asked: RunRequest) -> dict[str, Any]:
    """What a run is, before any step: versions, seed, inputs and data centers.

    Args:
        sim: the simulator.
        asked: what it is to do.
    """
    drivers = sim.drivers
    hashes = _file_hashes(sim.fleet.configs)
    return {
        "format": FORMAT,
        "versions": dict(_versions()),
        "fingerprint": sim.fingerprint(),
        "controller": asked.controller,
        "seed": asked.seed,
        "precision": sim.precision,
        "step_h": sim.step_h,
        "steps_asked": asked.steps,
        "synthetic": any(drivers.synthetic),
        "notes": list(drivers.notes),
        "data_centers": [
            {
                "name": config.name,
                "location": config.site.location,
                "start": config.site.start,
                "synthetic": synthetic,
                "provenance": sources,
                "sha256": {kind: hashes[path] for kind, path in _input_files(config).items()},
            }
            for config, synthetic, sources in zip(
                sim.fleet.configs, drivers.synthetic, drivers.sources, strict=True
            )
        ],
    }


@functools.cache
def _versions() -> Mapping[str, str]:
    """Of Python and of what results depend on; looking them up reads their packages' metadata."""
    packages = ("sdc-taichi", "taichi", "numpy", "pyarrow")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def report_json(report: dict[str, Any]) -> str:
    """JSON text of the content of metrics.json."""
    return json.dumps(report, indent=2, allow_nan=False)


def configs_yaml(configs: Sequence[DataCenterConfig]) -> str:
    """One YAML document per data center."""
    dumped = (c.model_dump(mode="json") for c in configs)
    return yaml.dump_all(
        dumped, Dumper=_DUMPER, sort_keys=False, allow_unicode=True, explicit_start=len(configs) > 1
    )


class StepsWriter:
    """Writes one row per data center and step to a Parquet file, a row group at a time.

    Memory does not grow with the number of steps. The file appears under its name on ``commit``;
    without it, nothing is left behind.

    Args:
        path: the file.
        sim: the simulator whose steps are added.
        metadata: stored as JSON under ``sdc_taichi`` in the file's metadata.

    Raises:
        SdcError: the file cannot be written.
    """

    def __init__(self, path: Path, sim: Simulator, metadata: Mapping[str, Any]) -> None:
        self._fleet, self._start = sim.fleet, sim.drivers.start
        self._metadata = {METADATA_KEY: json.dumps(metadata, allow_nan=False).encode()}
        self._steps_per_group = max(1, _ROWS_PER_GROUP // sim.size)
        self._names: tuple[str, ...] = ()
        self._values: F64 = np.empty((0, 0, 0))
        self._filled = 0
        self._first = 0
        self._writer: Any = None
        with naming_errors(path):
            delete_leftovers(path)
        self._output = AtomicFile(path)

    def add(self, result: StepResult) -> None:
        """Add one step; steps follow each other.

        Raises:
            SdcError: the file cannot be written.
        """
        if not self._names:
            self._names = tuple(result.per_dc())
            self._columns = operator.attrgetter(*self._names)
            shape = (len(self._names), self._steps_per_group, self._fleet.size)
            self._values = np.empty(shape)
        if self._filled == 0:
            self._first = result.step
        self._values[:, self._filled] = self._columns(result)
        self._filled += 1
        if self._filled == self._steps_per_group:
            self._flush()

    def commit(self) -> None:
        """Finish the file and give it its name.

        Raises:
            SdcError: the file cannot be written.
        """
        self._flush()
        with naming_errors(self._output.path):
            self._writer.close()
        self._output.commit()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._output.discard()

    def _flush(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self._filled == 0:
            return
        n, size = self._filled, self._fleet.size
        steps = np.arange(self._first, self._first + n)
        times = step_times(self._start, steps, self._fleet.steps_per_hour)
        names = pa.array(self._fleet.names)
        dc = pa.array(np.tile(np.arange(size, dtype=np.int32), n))
        columns: dict[str, Any] = {
            "dc": pa.DictionaryArray.from_arrays(dc, names),
            "step": np.repeat(steps, size),
            "time": times.reshape(-1),
        }
        for name, values in zip(self._names, self._values, strict=True):
            columns[name] = values[:n].reshape(-1)
        table = pa.table(columns).replace_schema_metadata(self._metadata)
        with naming_errors(self._output.path):
            if self._writer is None:
                self._writer = pq.ParquetWriter(
                    self._output.file, table.schema, compression="zstd", use_dictionary=["dc"]
                )
            self._writer.write_table(table)
        self._filled = 0


def prepare_folder(out: Path, *, force: bool = False) -> bool:
    """Create the folder of a run, or check that its files may be replaced.

    Returns:
        Whether it holds a former run.

    Raises:
        SdcError: it holds other files than those of a run and ``force`` is not set, or it cannot
            be created or read.
    """
    with naming_errors(out):
        if out.exists() and not out.is_dir():
            raise ConfigError(f"{out}: is a file; valid is a folder to write the run to")
        out.mkdir(parents=True, exist_ok=True)
        found = sorted(p.name for p in out.iterdir() if not _is_of_a_run(p))
    former = _is_run(out)
    if found and not force and not former:
        some = ", ".join(found[:3]) + (", ..." if len(found) > 3 else "")
        raise ConfigError(
            f"{out}: holds files that are not of a run ({some}); choose an empty folder with --out "
            "or write into it with --force"
        )
    return former


def write_text(path: Path, text: str) -> None:
    """Write a file so that a reader sees the old one or the whole new one.

    Raises:
        SdcError: it cannot be written.
    """
    with atomic_write(path) as file:
        file.write(text.encode())


def _events_by_dc(met: Iterable[ActiveEvent], size: int) -> list[list[dict[str, Any]]]:
    """Events that each data center met, in the order in which they began."""
    out: list[list[dict[str, Any]]] = [[] for _ in range(size)]
    for event in met:
        given = asdict(event)
        dc = given.pop("dc")
        out[dc].append({k: v for k, v in given.items() if v is not None})
    return out


def _input_files(config: DataCenterConfig) -> dict[str, str]:
    """Files that the config names, by what they give."""
    site = config.site
    named = {
        "weather": site.weather_file,
        "carbon": site.carbon_file,
        "workload": site.workload_file,
        "recirculation": config.hall.recirculation.matrix_file,
    }
    return {kind: path for kind, path in named.items() if path is not None}


def _file_hashes(configs: Sequence[DataCenterConfig]) -> dict[str, str]:
    """SHA-256 of every file that the configs name, by path.

    Drivers made from arrays need no such file, so one that is gone has the hash "missing".
    """
    paths = {path for config in configs for path in _input_files(config).values()}
    return {p: sha256(Path(p)) if Path(p).is_file() else "missing" for p in sorted(paths)}


def _is_of_a_run(path: Path) -> bool:
    """Files that a run may leave without its metrics.json when it is broken off."""
    return path.name in ("steps.parquet", REPORT_FILE) or path.suffix in (".part", ".rrd")


def _is_run(out: Path) -> bool:
    try:
        report = json.loads((out / "metrics.json").read_text("utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(report, dict) and str(report.get("format", "")).startswith("sdc-run/")
