"""Sweeps: data centers that differ in some fields, each in chosen months under chosen controllers.

A job runs up to ``Sweep.part_size`` combinations of values in one month under one controller. A
combination has the same figures, to the bit, in any batch and alone: all have the seed of the
sweep, and the name of their site, so they meet the same events and errors of forecasts.
"""

from __future__ import annotations

import itertools
import json
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
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
from sdc_taichi.config import DataCenterConfig, config_from_dict, with_values
from sdc_taichi.control import PERFECT, ForecastError, make_controller
from sdc_taichi.errors import ConfigError, OddInputWarning, SdcError
from sdc_taichi.exogenous.year_clock import DAYS_PER_MONTH, DAYS_PER_YEAR, whole_steps
from sdc_taichi.run.loop import simulate
from sdc_taichi.run.metrics import Metric, empty_totals, metrics_per_dc
from sdc_taichi.sim.fleet import build_fleet, shared_values
from sdc_taichi.sim.fleet_configs import locations, place_names
from sdc_taichi.sim.hall_solver import Precision
from sdc_taichi.sim.simulator import Simulator

if TYPE_CHECKING:
    import pandas as pd

MOST_RUNS = 100_000
"""Most runs of a sweep, unless a larger number is allowed."""
MOST_DCS, MOST_RACKS = 1024, 2**18
"""Most data centers of a job, and most racks of all of them, unless a sweep has its own ``batch``:
larger batches are no faster and need more memory."""
_CONFIG, _FILE = "config", "file "
_TRIED = 100
"""Combinations of which one must be valid for a sweep to begin."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """Runs of a data center with all combinations of values, months and controllers."""

    config: DataCenterConfig
    """Data center whose fields are varied."""
    varied: tuple[Varied, ...]
    """Fields that are varied. Combinations are those of all grids with each sample of all
    ranges."""
    samples: int = 0
    """Number of samples of the ranges; 0 without ranges."""
    controllers: tuple[str, ...] = ("idle",)
    """Names of the controllers."""
    months: tuple[int, ...] = ()
    """Months, 1..12, each a run from its first day; empty is one run from ``site.start``."""
    days: float | None = None
    """Length of each run, in days; None is the whole month, or a year without months."""
    seed: int = 0
    """Seed of samples, sampled events, controllers and errors of forecasts."""
    forecast_error: ForecastError = PERFECT
    """How the forecasts of controllers err."""
    precision: Precision = "f32"
    """Precision of the server kernels."""
    batch: int | None = None
    """Most data centers of a job, on which no figure depends; None is ``MOST_DCS`` that have
    ``MOST_RACKS`` together."""

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that are varied, in their order."""
        return tuple(one.field for one in self.varied)

    @property
    def combinations(self) -> int:
        """Number of combinations of values."""
        grids = (len(one.values) for one in self.varied if isinstance(one, Grid))
        return max(self.samples, 1) * prod(grids)

    @property
    def runs(self) -> int:
        """Number of runs: combinations in each month under each controller."""
        return self.combinations * max(len(self.months), 1) * len(self.controllers)

    @property
    def part_size(self) -> int:
        """Number of combinations of a job; the last one of a month may have fewer."""
        return self.batch or max(1, min(MOST_DCS, MOST_RACKS // self.config.hall.racks))

    def settings(self) -> dict[str, Any]:
        """Values on which the jobs depend, as JSON can hold them."""
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


def combinations(sweep: Sweep) -> Iterator[tuple[Any, ...]]:
    """Combinations of values of a sweep, in the order of its fields."""
    grids = [one for one in sweep.varied if isinstance(one, Grid)]
    ranges = [one for one in sweep.varied if not isinstance(one, Grid)]
    order = [[*grids, *ranges].index(one) for one in sweep.varied]
    for drawn in draw(ranges, sweep.samples, sweep.seed):
        for listed in itertools.product(*(grid.values for grid in grids)):
            values = (*listed, *drawn)
            yield tuple(values[i] for i in order)


def check_sweep(sweep: Sweep, most_runs: int = MOST_RUNS) -> None:
    """Check that a sweep can begin; single combinations may still fail.

    Args:
        sweep: the sweep.
        most_runs: most runs that it may have.

    Raises:
        SdcError: too many runs, options that do not fit together, or none of the first
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
    """Jobs of a sweep: parts of its combinations, month by month, for each controller.

    Args:
        sweep: the sweep.
        inputs: content of its inputs, of ``sweep_inputs``.
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
                yield Job("sdc_taichi.benchmark.sweep:run_part", values, named, digests)


def sweep_inputs(sweep: Sweep) -> dict[str, bytes]:
    """Content of the inputs of a sweep by name: its config and the files that it names.

    Raises:
        SdcError: a file that cannot be read, or is too large.
    """
    config = json.dumps(sweep.config.model_dump(mode="json"), sort_keys=True).encode()
    grids = [one for one in sweep.varied if isinstance(one, Grid) and one.field in FILE_FIELDS]
    listed = [path for one in grids for path in one.values if isinstance(path, str)]
    paths = [*input_paths(sweep.config), *listed]
    files = {f"{_FILE}{path}": read_input(path) for path in paths}
    return {_CONFIG: config, **files}


def run_part(values: Mapping[str, Any], inputs: Inputs) -> JobResult:
    """Run a part of a sweep: the function of its jobs.

    Args:
        values: ``columns``, field and kind of each, ``cells`` with the values of each combination,
            ``controller``, ``start`` (MM-DD), ``days``, ``seed``, ``forecast_error`` and
            ``precision``.
        inputs: ``config``, the values of the data center as JSON, and the content of files.

    Returns:
        A row for each combination with its values, its site and all metrics of its run. The metrics
        of the job are ``failed``, combinations without a row and why, and ``notes`` on inputs.
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
            names = place_names(list(configs.values()))
            named = [
                (place, config.model_copy(update={"name": name}))
                for (place, config), name in zip(configs.items(), names, strict=True)
            ]
            outcomes |= _run_batch(named, values, notes)

    def with_names(text: str) -> str:
        """A message with files by their names in the sweep, which are the same everywhere."""
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


def metric_names(config: DataCenterConfig) -> tuple[str, ...]:
    """Names of the metrics that the rows of a sweep of a data center have."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OddInputWarning)
        fleet = build_fleet(config)
    totals = empty_totals(1, 1.0 / fleet.steps_per_hour)
    totals.steps = 1
    return tuple(metrics_per_dc(totals, fleet)[0])


def _run_batch(
    configs: Sequence[tuple[int, DataCenterConfig]], values: Mapping[str, Any], notes: list[str]
) -> dict[int, dict[str, Metric] | str]:
    """Site and metrics of data centers by their places, or the error of those that fail.

    They run as one batch; if one fails, the batch is halved until that one is isolated.

    Args:
        configs: place and configuration of each data center.
        values: values of the job.
        notes: notes on inputs are added to it.
    """
    batch = [config for _, config in configs]
    try:
        with warnings.catch_warnings():
            # A warning for each combination would hide the others.
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
        place: {"site": site, **of_dc}
        for (place, _), site, of_dc in zip(configs, locations(batch), metrics, strict=True)
    }


def _rows(
    values: Mapping[str, Any], outcomes: Mapping[int, Mapping[str, Metric] | str]
) -> pd.DataFrame | None:
    """Rows of combinations: their values, their site and their metrics; None without any."""
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
        of_places = [metrics[place][name] for place in places]
        columns[name] = _column(of_places, kind_of(of_places))
    return pd.DataFrame(columns)


def _run_days(sweep: Sweep, place: int) -> float:
    """Length of the runs of the month at a place of ``months``, in days."""
    if sweep.days is not None:
        return sweep.days
    return DAYS_PER_MONTH[sweep.months[place] - 1] if sweep.months else DAYS_PER_YEAR


def _first_valid(sweep: Sweep) -> DataCenterConfig:
    """Data center of the first combination that is valid, of the first ones.

    Raises:
        ConfigError: none of them is.
    """
    first_error = ""
    for values in itertools.islice(combinations(sweep), _TRIED):
        try:
            return with_values(sweep.config, dict(zip(sweep.fields, values, strict=True)))
        except ConfigError as error:
            first_error = first_error or f"{combination_text(sweep.fields, values)}: {error}"
    raise ConfigError(f"vary {first_error}")


def _base(inputs: Inputs, files: Mapping[str, str], start: str) -> DataCenterConfig:
    """Data center of the inputs of a job, from a day on, with its files where they lie here."""
    config = config_from_dict(json.loads(inputs[_CONFIG]))
    named = {field: files.get(value_at(config, field)) for field in FILE_FIELDS}
    assigned = {field: path for field, path in named.items() if path is not None}
    return with_values(config, {**assigned, "site.start": start})


def _written_files(inputs: Inputs, folder: Path) -> dict[str, str]:
    """Files of the inputs, written to a folder: their paths there by those of the sweep."""
    written: dict[str, str] = {}
    for name, content in inputs.items():
        if name.startswith(_FILE):
            path = name.removeprefix(_FILE)
            # A weather file without a city is named by its stem.
            file = folder / str(len(written)) / Path(path).name
            file.parent.mkdir()
            file.write_bytes(content)
            written[path] = str(file)
    return written


def _column(values: Sequence[Any], kind: Kind) -> pd.Series:
    """A column of values; without a value numbers are nan."""
    import pandas as pd

    if kind == "text":
        texts = [None if value is None else value_text(value) for value in values]
        # Unlike one of objects, it is one of texts even where no value is.
        return pd.Series(texts, dtype="string")
    if kind == "float64":
        values = [float("nan") if value is None else value for value in values]
    return pd.Series(values, dtype=kind)
