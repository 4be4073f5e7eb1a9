"""Parameter sweeps: simulate a data center with all combinations of values of some fields.

Each combination is simulated in chosen months with chosen controllers. A job runs up to
``Sweep.part_size`` combinations as a batch, in one month with one controller. The results of a
combination do not depend on its batch, to the last bit: all combinations have the seed of the sweep
and the name of their site, and so have the same sampled events and forecast errors.
"""

from __future__ import annotations

import itertools
import json
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.benchmark.jobs import (
    FILE_FIELDS,
    Inputs,
    Job,
    JobResult,
    digest_of,
    input_paths,
    read_input,
)
from sdc_taichi.benchmark.result_table import (
    ANY,
    METRIC_COLUMNS,
    NUMBER,
    Column,
    read_any_rows,
)
from sdc_taichi.benchmark.store import METRICS_FILE, ROWS_FILE, Record, ResultStore
from sdc_taichi.benchmark.vary import (
    Grid,
    Kind,
    Varied,
    combination_text,
    draw,
    kind_of,
    value_at,
    value_text,
)
from sdc_taichi.config import DataCenterConfig, config_from_dict, validated, with_values
from sdc_taichi.control import PERFECT, ForecastError, make_controller
from sdc_taichi.errors import ConfigError, OddInputWarning, SdcError
from sdc_taichi.exogenous.year_clock import DAYS_PER_MONTH, DAYS_PER_YEAR, whole_steps
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import Metric, empty_totals, metrics_per_dc
from sdc_taichi.sim.fleet import build_fleet, shared_values
from sdc_taichi.sim.fleet_configs import locations, names_of_runs, place_names
from sdc_taichi.sim.hall_state import Precision
from sdc_taichi.sim.simulator import Simulator

if TYPE_CHECKING:
    import pandas as pd

MOST_RUNS = 100_000
"""Default maximum number of runs of a sweep."""
MOST_DCS, MOST_RACKS = 1024, 2**18
"""Default maximum of data centers per job, and of the racks of all of them. Larger batches need
more memory without being faster."""
_CONFIG, _FILE = "config", "file "
_COLUMNS: Mapping[Kind, Column] = {
    "int64": Column("whole number", low=-1e20, high=1e20),
    "float64": NUMBER,
    "bool": ANY,
    "text": Column("text", may_lack=True),
}
"""Valid values of varied fields, by type."""
_TRIED = 100
"""Number of combinations to check before a sweep begins; at least one of them must be valid."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """Definition of a sweep: runs with all combinations of field values, months and controllers."""

    config: DataCenterConfig
    """Configuration of the data center whose fields are varied."""
    varied: tuple[Varied, ...]
    """Varied fields. Each combination of the listed values is run with each sample of the
    ranges."""
    samples: int = 0
    """Number of samples of the ranges; 0 without ranges."""
    controllers: tuple[str, ...] = ("idle",)
    """Names of the controllers."""
    months: tuple[int, ...] = ()
    """Months, 1..12, with a run from the first day of each; if empty, a single run begins at
    ``site.start``."""
    days: float | None = None
    """Length of each run, in days; None selects the whole month, or a year if ``months`` is
    empty."""
    seed: int = 0
    """Seed of samples, sampled events, controllers and forecast errors."""
    forecast_error: ForecastError = PERFECT
    """Sizes of the errors of the forecasts that controllers get."""
    precision: Precision = "f32"
    """Precision of the server kernels."""
    batch: int | None = None
    """Maximum number of data centers per job, which does not affect results; None selects
    ``MOST_DCS``, with at most ``MOST_RACKS`` racks in total."""

    @property
    def fields(self) -> tuple[str, ...]:
        """Dotted paths of the varied fields, in order."""
        return tuple(one.field for one in self.varied)

    @property
    def combinations(self) -> int:
        """Number of combinations of values."""
        grids = (len(one.values) for one in self.varied if isinstance(one, Grid))
        return max(self.samples, 1) * prod(grids)

    @property
    def runs(self) -> int:
        """Number of runs: combinations times months times controllers."""
        return self.combinations * max(len(self.months), 1) * len(self.controllers)

    @property
    def part_size(self) -> int:
        """Number of combinations per job; the last job of a month can have fewer."""
        return self.batch or max(1, min(MOST_DCS, MOST_RACKS // self.config.hall.racks))

    def settings(self) -> dict[str, Any]:
        """Return the values on which the jobs depend, in a form for JSON."""
        return {
            "config": self.config.model_dump(mode="json"),
            "varied": [asdict(one) for one in self.varied],
            "samples": self.samples,
            "controllers": list(self.controllers),
            "months": list(self.months),
            "days": self.days,
            "seed": self.seed,
            "forecast_error": asdict(self.forecast_error),
            "precision": self.precision,
            "batch": self.part_size,
        }


class FailedCombination(Record):
    """Combination of a sweep without a result."""

    combination: str
    """Fields with their values."""
    error: str
    """Error message."""


class PartMetrics(Record):
    """Metrics of a job of a sweep."""

    failed: list[FailedCombination]
    """Combinations whose run failed."""
    notes: list[str]
    """Remarks on inputs."""


def combinations(sweep: Sweep) -> Iterator[tuple[Any, ...]]:
    """Yield each combination of values of a sweep; values have the order of ``sweep.fields``."""
    grids = [one for one in sweep.varied if isinstance(one, Grid)]
    ranges = [one for one in sweep.varied if not isinstance(one, Grid)]
    order = [[*grids, *ranges].index(one) for one in sweep.varied]
    for drawn in draw(ranges, sweep.samples, sweep.seed):
        for listed in itertools.product(*(grid.values for grid in grids)):
            values = (*listed, *drawn)
            yield tuple(values[i] for i in order)


def check_sweep(sweep: Sweep, most_runs: int = MOST_RUNS) -> None:
    """Check that a sweep can begin; single combinations can still fail later.

    Raises:
        SdcError: the sweep has too many runs, options contradict each other, or none of the first
            combinations is valid.
    """
    fields = sweep.fields
    for field in fields:
        if fields.count(field) > 1:
            raise ConfigError(f"vary: {field} is given twice; valid is each field once")
    ranges = [one.field for one in sweep.varied if not isinstance(one, Grid)]
    if bool(ranges) != bool(sweep.samples):
        what = f"{ranges[0]} is a range" if ranges else f"sample {sweep.samples}: no field varies"
        valid = "a number of samples (--sample)" if ranges else "FIELD=LOW..HIGH beside it"
        raise ConfigError(f"vary: {what}; valid is {valid}")
    if sweep.runs > most_runs:
        raise ConfigError(
            f"sweep: {sweep.runs:,} runs ({sweep.combinations:,} combinations of values); valid "
            f"are at most {most_runs:,}, or as many as --most allows"
        )
    if "site.location" in fields:
        for name in ("weather_file", "carbon_file"):
            file = getattr(sweep.config.site, name)
            if file is not None and f"site.{name}" not in fields:
                raise ConfigError(
                    f"vary site.location: site.{name} {file!r} would be read for each location; "
                    "valid is one of the two"
                )
    fleet = build_fleet(_first_valid(sweep))
    whole_steps(_run_days(sweep, 0), fleet.steps_per_hour)
    for name in sweep.controllers:
        if sweep.controllers.count(name) > 1:
            raise ConfigError(f"controller {name}: given twice; valid is each once")
        make_controller(name, fleet)


def sweep_jobs(sweep: Sweep, inputs: Inputs) -> Iterator[Job]:
    """Yield the jobs of a sweep; each runs some combinations in one month with one controller.

    Args:
        sweep: the sweep.
        inputs: content of the inputs, from ``sweep_inputs``.
    """
    digests = {name: digest_of(content) for name, content in inputs.items()}
    columns = [[one.field, one.kind] for one in sweep.varied]
    for controller in sweep.controllers:
        rest = combinations(sweep)
        for part in itertools.count():
            cells = [list(values) for values in itertools.islice(rest, sweep.part_size)]
            if not cells:
                break
            for place, month in enumerate(sweep.months or (0,)):
                values = {
                    "columns": columns,
                    "cells": cells,
                    "controller": controller,
                    "start": f"{month:02d}-01" if month else sweep.config.site.start,
                    "days": _run_days(sweep, place),
                    "seed": sweep.seed,
                    "forecast_error": asdict(sweep.forecast_error),
                    "precision": sweep.precision,
                }
                named = {"controller": controller, "month": str(month), "part": str(part)}
                if not month:
                    del named["month"]
                yield Job("sdc_taichi.benchmark.sweep:run_part", values, named, digests, check_part)


def sweep_inputs(sweep: Sweep) -> dict[str, bytes]:
    """Return the inputs of a sweep by name: its configuration and the content of input files.

    Raises:
        SdcError: a file cannot be read, or is too large.
    """
    config = json.dumps(sweep.config.model_dump(mode="json"), sort_keys=True).encode()
    grids = [one for one in sweep.varied if isinstance(one, Grid) and one.field in FILE_FIELDS]
    listed = [path for one in grids for path in one.values if isinstance(path, str)]
    paths = [*input_paths(sweep.config), *listed]
    files = {f"{_FILE}{path}": read_input(path) for path in paths}
    return {_CONFIG: config, **files}


def run_part(values: Mapping[str, Any], inputs: Inputs) -> JobResult:
    """Run some combinations of a sweep as a batch; this is the function of a sweep's jobs.

    Args:
        values: ``columns`` (name and type of each varied field), ``cells`` (values of each
            combination), ``controller``, ``start`` (MM-DD), ``days``, ``seed``,
            ``forecast_error`` and ``precision``.
        inputs: ``config``, the configuration as JSON, and the content of input files.

    Returns:
        Result with a row for each successful combination: its values, its site and all metrics of
        its run. The metrics of the job are ``failed`` (failed combinations with their errors) and
        ``notes`` (remarks on inputs).
    """
    cells: list[list[Any]] = values["cells"]
    fields = [field for field, _ in values["columns"]]
    outcomes: dict[int, dict[str, Metric] | str] = {}
    notes: list[str] = []
    fleets: dict[tuple[Any, ...], dict[int, DataCenterConfig]] = {}
    with tempfile.TemporaryDirectory() as folder:
        files = _written_files(inputs, Path(folder))
        base = _base(inputs, files, str(values["start"]))
        for place, cell in enumerate(cells):
            assigned = {
                field: files.get(value, value) if field in FILE_FIELDS else value
                for field, value in zip(fields, cell, strict=True)
            }
            try:
                config = with_values(base, assigned)
            except SdcError as error:
                outcomes[place] = str(error)
            else:
                fleets.setdefault(shared_values(config), {})[place] = config
        for configs in fleets.values():
            name_all = place_names if "site.location" in fields else names_of_runs
            names = name_all(list(configs.values()))
            named = [
                (place, config.model_copy(update={"name": name}))
                for (place, config), name in zip(configs.items(), names, strict=True)
            ]
            outcomes |= _run_batch(named, values, notes)

    def with_names(text: str) -> str:
        """Replace paths of temporary files in a message by the original paths."""
        for name, path in files.items():
            text = text.replace(path, name)
        return text

    failed = [
        {
            "combination": combination_text(fields, cells[place]),
            "error": with_names(str(outcomes[place])),
        }
        for place in sorted(outcomes)
        if isinstance(outcomes[place], str)
    ]
    notes = list(dict.fromkeys(map(with_names, notes)))
    return JobResult(_rows(values, outcomes), {"failed": failed, "notes": notes})


def check_part(values: Mapping[str, Any], metrics: Mapping[str, Any], rows: bytes) -> None:
    """Check metrics and table rows that are stored for ``run_part``.

    Args:
        values: values of the job.
        metrics: the metrics.
        rows: content of the Parquet file with the table rows; empty if all combinations failed.

    Raises:
        SdcError: a metric or value is missing or not valid, or the number of rows is another one.
    """
    part = validated(PartMetrics, metrics, METRICS_FILE)
    declared = {field: _COLUMNS[kind] for field, kind in values["columns"]}
    declared["site"] = Column("text")
    count = 0
    if rows:
        frame = read_any_rows(rows, Path(ROWS_FILE), declared=declared, other=NUMBER)
        for name in {**declared, **METRIC_COLUMNS}:
            if name not in frame:
                raise ConfigError(f"{ROWS_FILE}: no column {name}; valid is a table with it")
        count = len(frame)
    expected = len(values["cells"]) - len(part.failed)
    if count != expected:
        raise ConfigError(
            f"{ROWS_FILE}: {count} rows; valid are {expected}, as {METRICS_FILE} says"
        )


def stored_metrics(store: ResultStore, jobs: Iterable[Job]) -> Iterator[tuple[int, PartMetrics]]:
    """Yield number of runs and metrics of each job of a sweep that has a valid result."""
    for job in jobs:
        try:
            metrics = store.result(job.partition).metrics
            yield len(job.values["cells"]), validated(PartMetrics, metrics, METRICS_FILE)
        except SdcError:
            continue  # The job is not done, and --resume runs it again.


def metric_names(config: DataCenterConfig) -> tuple[str, ...]:
    """Return the names of the metrics in the result rows of a sweep of a data center."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OddInputWarning)
        fleet = build_fleet(config)
    totals = empty_totals(1, 1.0 / fleet.steps_per_hour)
    totals.steps = 1
    return tuple(metrics_per_dc(totals, fleet)[0])


def _run_batch(
    configs: Sequence[tuple[int, DataCenterConfig]], values: Mapping[str, Any], notes: list[str]
) -> dict[int, dict[str, Metric] | str]:
    """Simulate data centers as one batch; return site and metrics, or an error, by index.

    If a data center fails, the batch is halved repeatedly until the failing one is isolated.

    Args:
        configs: index and configuration of each data center.
        values: values of the job.
        notes: list to which remarks on inputs are appended.
    """
    batch = [config for _, config in configs]
    try:
        with warnings.catch_warnings():
            # Suppress these warnings: one per combination would hide all other warnings.
            warnings.simplefilter("ignore", OddInputWarning)
            sim = Simulator(batch, precision=values["precision"])
        with sim:
            totals = simulate(
                sim,
                make_controller(values["controller"], sim.fleet),
                whole_steps(values["days"], sim.fleet.steps_per_hour),
                np.full(sim.size, values["seed"]),
                forecast_error=ForecastError(**values["forecast_error"]),
            )
            metrics = metrics_per_dc(totals, sim.fleet)
            notes += sim.drivers.notes
    except SdcError as error:
        if len(configs) == 1:
            return {configs[0][0]: str(error)}
        half = len(configs) // 2
        return _run_batch(configs[:half], values, notes) | _run_batch(configs[half:], values, notes)
    return {
        place: {"site": site, **dc_metrics}
        for (place, _), site, dc_metrics in zip(configs, locations(batch), metrics, strict=True)
    }


def _rows(
    values: Mapping[str, Any], outcomes: Mapping[int, Mapping[str, Metric] | str]
) -> pd.DataFrame | None:
    """Return a table row for each successful combination; None if all combinations failed."""
    import pandas as pd

    metrics = {
        place: outcome for place, outcome in outcomes.items() if not isinstance(outcome, str)
    }
    if not metrics:
        return None
    places = sorted(metrics)
    columns: dict[str, Any] = {}
    for at, (field, kind) in enumerate(values["columns"]):
        columns[field] = _column([values["cells"][place][at] for place in places], kind)
    for name in metrics[places[0]]:
        column = [metrics[place][name] for place in places]
        columns[name] = _column(column, kind_of(column))
    return pd.DataFrame(columns)


def _run_days(sweep: Sweep, place: int) -> float:
    """Return the length of the runs, in days, in the month with index ``place``."""
    if sweep.days is not None:
        return sweep.days
    return DAYS_PER_MONTH[sweep.months[place] - 1] if sweep.months else DAYS_PER_YEAR


def _first_valid(sweep: Sweep) -> DataCenterConfig:
    """Return the data center of the first valid combination, out of the first ``_TRIED`` ones.

    Raises:
        ConfigError: none of these combinations is valid.
    """
    first_error = ""
    for values in itertools.islice(combinations(sweep), _TRIED):
        try:
            return with_values(sweep.config, dict(zip(sweep.fields, values, strict=True)))
        except ConfigError as error:
            first_error = first_error or f"{combination_text(sweep.fields, values)}: {error}"
    raise ConfigError(f"vary {first_error}")


def _base(inputs: Inputs, files: Mapping[str, str], start: str) -> DataCenterConfig:
    """Return the configuration in a job's inputs, with a start day and the local file paths."""
    config = config_from_dict(json.loads(inputs[_CONFIG]))
    named = {field: files.get(value_at(config, field)) for field in FILE_FIELDS}
    assigned = {field: path for field, path in named.items() if path is not None}
    return with_values(config, {**assigned, "site.start": start})


def _written_files(inputs: Inputs, folder: Path) -> dict[str, str]:
    """Write the input files to a folder; return the new path of each original path."""
    written: dict[str, str] = {}
    for name, content in inputs.items():
        if name.startswith(_FILE):
            path = name.removeprefix(_FILE)
            # Preserve the file name: a weather file without a city is named after its stem.
            file = folder / str(len(written)) / Path(path).name
            file.parent.mkdir()
            file.write_bytes(content)
            written[path] = str(file)
    return written


def _column(values: Sequence[Any], kind: Kind) -> pd.Series:
    """Return values as a table column; missing numbers (None) become nan."""
    import pandas as pd

    if kind == "text":
        texts = [None if value is None else value_text(value) for value in values]
        # Use the string type: a column of objects would lose its type if all values are missing.
        return pd.Series(texts, dtype="string")
    if kind == "float64":
        values = [float("nan") if value is None else value for value in values]
    return pd.Series(values, dtype=kind)
