"""Read a run folder: its metrics.json and steps.parquet (see docs/run-folder.md).

Rows of steps.parquet follow each other step by step, and within a step in the order of the data
centers, so a column is an array (steps, data centers). It is read a row group at a time: a year of
a large fleet needs no more memory than the columns and data centers that are asked for.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig, config_from_dict, load_json, load_yaml
from sdc_taichi.errors import ConfigError, SdcError, shortened
from sdc_taichi.run.description import FORMAT
from sdc_taichi.run.folder_writer import METRICS_FILE
from sdc_taichi.run.steps_file import AIR_KEY, METADATA_KEY, RACKS_KEY, STEPS_FILE
from sdc_taichi.types import F64
from sdc_taichi.user_file import MOST_METRICS_BYTES, decoding, open_input, read_text

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

MAX_INTERVALS = 400
"""Largest number of intervals in ``FleetSteps.inlet_max_c``."""

_METRICS_TYPES: Mapping[str, type | tuple[type, ...]] = {
    "versions": dict,
    "fingerprint": str,
    "controller": str,
    "seed": int,
    "precision": str,
    "step_h": (int, float),
    "steps_asked": int,
    "steps_done": int,
    "synthetic": bool,
    "notes": list,
    "data_centers": list,
    "total": dict,
}
_DATA_CENTER_TYPES: Mapping[str, type | tuple[type, ...]] = {
    "name": str,
    "location": str,
    "start": str,
    "synthetic": bool,
    "provenance": dict,
    "sha256": dict,
    "metrics": dict,
    "events": list,
}
_EVENT_TYPES: Mapping[str, type | tuple[type, ...]] = {
    "kind": str,
    "start_step": int,
    "end_step": int,
}
_INTERVALS_H = (0.25, 0.5, 1, 2, 3, 6, 12, 24, 48, 96, 168, 336, 720, 2160, 8760)


@dataclass(frozen=True, slots=True)
class RunFolder:
    """A run folder whose metrics.json has been read and checked."""

    path: Path
    """The folder."""
    metrics: dict[str, Any]
    """Content of metrics.json."""

    @property
    def names(self) -> list[str]:
        """Names of the data centers, in order."""
        return [dc["name"] for dc in self.metrics["data_centers"]]

    @property
    def steps_path(self) -> Path:
        """Path of steps.parquet."""
        return self.path / STEPS_FILE

    @property
    def hours(self) -> float:
        """Length of the steps done, in h."""
        return float(self.metrics["steps_done"] * self.metrics["step_h"])


@dataclass(frozen=True, slots=True)
class FleetSteps:
    """All data centers of a run together."""

    series: pd.DataFrame
    """One row per step: ``time`` on the clock of the first data center, sums over the data centers
    of ``it_w``, ``overhead_w`` (W) and ``carbon_g`` (g), and of their hottest inlets the 10 %, 50 %
    and 90 % quantile and the maximum, ``inlet_low_c``, ``inlet_mid_c``, ``inlet_high_c`` and
    ``inlet_max_c`` (C)."""
    edge_times: npt.NDArray[np.datetime64]
    """Beginnings of m intervals, equal but for the last, and the end of the run, (m + 1,)."""
    inlet_max_c: F64
    """Hottest inlet of each interval and data center, in C, (m, B)."""


def read_run(folder: str | Path) -> RunFolder:
    """Read metrics.json and check it and steps.parquet against each other.

    Raises:
        SdcError: there is no such folder, no run in it or one of another format, or a file is
            damaged or of another run.
    """
    path = Path(folder)
    if not os.path.isdir(path):
        problem = "is a file" if os.path.exists(path) else "no such folder"
        raise SdcError(f"{path}: {problem}; valid is a folder that simulate wrote a run to")
    run = RunFolder(path, _read_metrics(path / METRICS_FILE))
    _check_steps_file(run)
    return run


def read_steps(
    run: RunFolder, dcs: Sequence[int], columns: Sequence[str] | None = None
) -> list[pd.DataFrame]:
    """Steps of some data centers, a DataFrame each, with ``step``, ``time`` and other columns.

    Args:
        run: the run.
        dcs: indices of the data centers.
        columns: names of the other columns; None is all of them.

    Raises:
        SdcError: steps.parquet is damaged, lacks a column, or its rows are out of order.
    """
    import pandas as pd

    if columns is None:
        columns = _column_names(run)
    parts: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in ("step", "time", *columns)}
    for group in _row_groups(run, columns):
        for name, values in parts.items():
            values.append(group[name][:, list(dcs)])
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    return [
        pd.DataFrame({name: values[:, i] for name, values in whole.items()})
        for i in range(len(dcs))
    ]


def read_fleet_steps(run: RunFolder) -> FleetSteps:
    """Read the sums over the data centers by step, and their hottest inlets.

    Raises:
        SdcError: steps.parquet is damaged, lacks a column, or its rows are out of order.
    """
    import pandas as pd

    summed = ("it_w", "overhead_w", "carbon_g")
    steps, size = run.metrics["steps_done"], len(run.names)
    step_h = float(run.metrics["step_h"])
    interval = next(
        (round(h / step_h) for h in _INTERVALS_H if h >= step_h and run.hours <= h * MAX_INTERVALS),
        -(-steps // MAX_INTERVALS),
    )
    parts: dict[str, list[npt.NDArray[Any]]] = {}
    hottest = np.full((-(-steps // interval), size), -np.inf)
    done = 0
    for group in _row_groups(run, (*summed, "inlet_max_c")):
        inlets = group["inlet_max_c"]
        low, mid, high = np.quantile(inlets, (0.1, 0.5, 0.9), axis=1)
        columns = {"time": group["time"][:, 0]}
        columns |= {name: group[name].sum(axis=1) for name in summed}
        columns |= {"inlet_low_c": low, "inlet_mid_c": mid, "inlet_high_c": high}
        columns["inlet_max_c"] = inlets.max(axis=1)
        for name, values in columns.items():
            parts.setdefault(name, []).append(values)
        interval_of_step = np.arange(done, done + len(inlets)) // interval
        first_steps = np.flatnonzero(np.diff(interval_of_step, prepend=-1))
        rows = interval_of_step[first_steps]
        highest = np.maximum.reduceat(inlets, first_steps, axis=0)
        hottest[rows] = np.maximum(hottest[rows], highest)
        done += len(inlets)
    series = pd.DataFrame({name: np.concatenate(values) for name, values in parts.items()})
    times = series["time"].to_numpy()
    end = times[-1] + np.timedelta64(round(60 * step_h), "m")
    return FleetSteps(series, np.append(times[::interval], end), hottest)


def read_configs(run: RunFolder, dcs: Sequence[int]) -> list[DataCenterConfig]:
    """Read the configs of some data centers, which steps.parquet holds.

    Raises:
        SdcError: they are missing or not valid.
    """
    text = _stored_metadata(run.steps_path).get("configs_yaml")
    if not isinstance(text, str):
        raise SdcError(f"{run.steps_path}: no configs_yaml; valid is a file written by simulate")
    # YAML allows no other line of three dashes, and reading all of a large fleet takes minutes.
    documents = ("\n" + text).split("\n---\n")
    documents = documents[1:] if len(documents) > 1 else documents
    if len(documents) != len(run.names):
        raise SdcError(
            f"{run.steps_path}: configs of {len(documents)} data centers, expected {len(run.names)}"
        )
    label = f"{run.steps_path}: configs_yaml"
    try:
        return [config_from_dict(load_yaml(documents[dc]), label) for dc in dcs]
    except ConfigError:
        raise
    except ValueError as error:
        raise SdcError(f"{label}: not valid YAML ({error})") from None


def read_racks(run: RunFolder, dcs: Sequence[int]) -> list[pd.DataFrame]:
    """Racks of some data centers over the run, a DataFrame each with a row per rack, in order.

    Columns are ``hottest_h``, the time in which the hottest inlet of the rack was that of the hall,
    up to ``TIE_K``, in h, and ``inlet_max_c``, the highest inlet of the rack, in C.

    Args:
        run: the run.
        dcs: indices of the data centers.

    Raises:
        SdcError: steps.parquet is damaged or lacks them.
    """
    import pandas as pd

    stored = _stored_json(run.steps_path, RACKS_KEY)
    if not isinstance(stored, list) or len(stored) != len(run.names):
        raise SdcError(
            f"{run.steps_path}: no sdc_taichi_racks of {len(run.names)} data centers; simulate the "
            "run again"
        )
    done, step_h = run.metrics["steps_done"], float(run.metrics["step_h"])
    out = []
    for dc in dcs:
        try:
            steps, highest = (
                np.array(stored[dc][name], dtype=float) for name in ("hottest_steps", "inlet_max_c")
            )
        except (KeyError, TypeError, ValueError):
            steps, highest = np.full((2, 1), np.nan)
        whole = steps.ndim == 1 and steps.shape == highest.shape and len(steps) > 0
        if not (whole and np.all((steps >= 0) & (steps <= done)) and np.all(np.isfinite(highest))):
            raise SdcError(
                f"{run.steps_path}: sdc_taichi_racks[{dc}] is {shortened(stored[dc])}; valid are "
                f"hottest_steps, 0..{done}, and inlet_max_c of each rack"
            )
        out.append(pd.DataFrame({"hottest_h": steps * step_h, "inlet_max_c": highest}))
    return out


def read_hottest_air(run: RunFolder, dc: int) -> object:
    """What steps.parquet holds of the air of a data center in its hottest step; None if nothing.

    Raises:
        SdcError: steps.parquet is damaged.
    """
    stored = _stored_json(run.steps_path, AIR_KEY) or []
    if not isinstance(stored, list) or len(stored) not in (0, len(run.names)):
        raise SdcError(
            f"{run.steps_path}: no sdc_taichi_air of {len(run.names)} data centers; simulate the "
            "run again"
        )
    return cast(object, stored[dc]) if stored else None


def _read_metrics(path: Path) -> dict[str, Any]:
    """Content of metrics.json, checked field by field."""
    with _part_of_run():
        text = read_text(path, MOST_METRICS_BYTES)
    try:
        content = load_json(text)
    except ValueError as error:
        raise SdcError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise SdcError(f"{path}: format {found!r}; valid is {FORMAT!r}, simulate the run again")
    _check_fields(path, "", content, _METRICS_TYPES)
    done, asked, step_h = content["steps_done"], content["steps_asked"], content["step_h"]
    if not 1 <= done <= asked:
        raise SdcError(f"{path}: steps_done {done} of steps_asked {asked}; valid is 1..{asked}")
    for index, dc in enumerate(content["data_centers"]):
        where = f"data_centers[{index}]"
        if not isinstance(dc, dict):
            raise SdcError(f"{path}: {where} is {dc!r}; valid is an object")
        _check_fields(path, f"{where}.", dc, _DATA_CENTER_TYPES)
        for number, event in enumerate(dc["events"]):
            place = f"{where}.events[{number}]"
            if not isinstance(event, dict):
                raise SdcError(f"{path}: {place} is {event!r}; valid is an object")
            _check_fields(path, f"{place}.", event, _EVENT_TYPES)
            _check_event(f"{path}: {place}", event, done)
    if not content["data_centers"]:
        raise SdcError(f"{path}: data_centers is empty; valid is one or more")
    if not 0 < step_h <= 1:
        raise SdcError(f"{path}: step_h {step_h!r}; valid is above 0 up to 1")
    return dict(content)


@contextlib.contextmanager
def _part_of_run() -> Iterator[None]:
    """Say of a file that is missing what should hold it.

    Raises:
        SdcError: as in the block.
    """
    try:
        yield
    except SdcError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
        valid = "valid is a folder that simulate wrote a whole run to"
        raise SdcError(f"{error}; {valid}") from None


def is_number(value: object) -> bool:
    """Whether a JSON value is a number that a float holds; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _check_event(place: str, event: Mapping[str, Any], done: int) -> None:
    """Check the steps and amounts of an event against the steps done."""
    start, end = event["start_step"], event["end_step"]
    if not 0 <= start < min(done, end) or end >= 1 << 63:
        raise SdcError(
            f"{place}: steps {start} to {end}; valid is a start in 0..{done - 1} and a later end"
        )
    for name, low, high in (("share", 0.0, 1.0), ("offset_k", -1e3, 1e3)):
        value = event.get(name, 0.0)
        if not is_number(value) or not low <= value <= high:
            raise SdcError(f"{place}.{name} is {value!r}; valid is a number {low:g}..{high:g}")


def _check_fields(
    path: Path,
    where: str,
    values: Mapping[str, Any],
    expected: Mapping[str, type | tuple[type, ...]],
) -> None:
    """Check that the fields of a JSON object are there and of their types."""
    for name, kind in expected.items():
        value = values.get(name)
        # A bool is an int in Python, and no number here.
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            problem = f"is {value!r}" if name in values else "is missing"
            names = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
            raise SdcError(f"{path}: {where}{name} {problem}; valid is of type {names}")


def _check_steps_file(run: RunFolder) -> None:
    """Check that steps.parquet is of the run that metrics.json describes, and has all its rows."""
    path = run.steps_path
    stored, given = _flat_description(_stored_metadata(path)), _flat_description(run.metrics)
    for name in {**stored, **given}:
        if stored.get(name) != given.get(name):
            raise SdcError(
                f"{path}: {name} {shortened(stored.get(name))} is not that of {METRICS_FILE}, "
                f"{shortened(given.get(name))}; simulate the run again"
            )
    with _open_parquet(path) as file:
        rows = file.metadata.num_rows
    expected = run.metrics["steps_done"] * len(run.names)
    if rows != expected:
        raise SdcError(
            f"{path}: {rows} rows, expected {expected} as steps_done and data_centers of "
            f"{METRICS_FILE} say; simulate the run again"
        )


def _flat_description(content: Mapping[str, Any]) -> dict[str, Any]:
    """Fields that steps.parquet and metrics.json both hold, by their paths."""
    others = ("data_centers", "steps_done", "total", "configs_yaml", "optimum")
    out = {name: value for name, value in content.items() if name not in others}
    for index, dc in enumerate(content.get("data_centers", ())):
        fields = {name: value for name, value in dc.items() if name not in ("metrics", "events")}
        out |= {f"data_centers[{index}].{name}": value for name, value in fields.items()}
    return out


@contextlib.contextmanager
def _open_parquet(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file, of which the metadata are read.

    Raises:
        SdcError: there is no such file, or it is damaged.
    """
    import pyarrow.parquet as pq

    with _part_of_run(), open_input(path) as file:
        with decoding(path, "a Parquet file"):
            opened = pq.ParquetFile(file)
        yield opened


def _stored_metadata(path: Path) -> dict[str, Any]:
    """Description of the run that the metadata of steps.parquet hold."""
    stored = _stored_json(path, METADATA_KEY)
    if not isinstance(stored, dict):
        raise SdcError(f"{path}: no sdc_taichi metadata; valid is a file written by simulate")
    return stored


def _stored_json(path: Path, key: bytes) -> object:
    """What the metadata of steps.parquet hold under a key; None if there is no JSON under it."""
    with _open_parquet(path) as file:
        metadata = file.metadata.metadata or {}
    try:
        return cast(object, json.loads(metadata[key]))
    except (KeyError, RecursionError, ValueError):
        return None


def _column_names(run: RunFolder) -> list[str]:
    """Columns of steps.parquet that hold quantities."""
    with _open_parquet(run.steps_path) as file:
        names = file.schema_arrow.names
    return [name for name in names if name not in ("dc", "step", "time")]


def _row_groups(run: RunFolder, columns: Sequence[str]) -> Iterator[dict[str, npt.NDArray[Any]]]:
    """Row groups as arrays (steps, data centers), ``step`` and ``time`` among them."""
    path = run.steps_path
    wanted = ("dc", "step", "time", *columns)
    with _open_parquet(path) as file:
        known = set(file.schema_arrow.names)
        missing = [name for name in wanted if name not in known]
        if missing:
            raise SdcError(f"{path}: no column {', '.join(missing)}; simulate the run again")
        done = 0
        for index in range(file.num_row_groups):
            with decoding(path, f"row group {index}"):
                table = file.read_row_group(index, columns=list(wanted))
            group = _as_steps(run, index, table, done)
            done += len(group["step"])
            yield group


def _as_steps(run: RunFolder, index: int, table: pa.Table, done: int) -> dict[str, Any]:
    """A row group as arrays (steps, data centers), checked.

    Args:
        run: the run.
        index: number of the row group, for messages.
        table: its columns.
        done: number of steps in the row groups before.
    """
    path, size = run.steps_path, len(run.names)
    if table.num_rows % size:
        raise SdcError(f"{path}: row group {index} has {table.num_rows} rows, not whole steps")
    names = [name for name in table.column_names if name != "dc"]
    group = {name: _as_array(path, name, table).reshape(-1, size) for name in names}
    steps = np.arange(done, done + table.num_rows // size)
    dcs = table.column("dc").slice(0, size).to_pylist()
    if dcs != run.names or not np.all(group["step"] == steps[:, None]):
        raise SdcError(
            f"{path}: row group {index}: rows are not in order of step and data center as in "
            f"{METRICS_FILE}; simulate the run again"
        )
    return group


def _as_array(path: Path, name: str, table: Any) -> npt.NDArray[Any]:
    """Values of a column of an Arrow table, whose type is checked."""
    column = table.column(name)
    kind = {"step": "int64", "time": "timestamp[ms]"}.get(name, "double")
    if str(column.type) != kind or column.null_count:
        raise SdcError(
            f"{path}: column {name} is {column.type} with {column.null_count} empty values; valid "
            f"is {kind} without"
        )
    return np.asarray(column.to_numpy())
