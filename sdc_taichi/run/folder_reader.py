"""Reader of run folders: metrics.json, steps.parquet and flows.parquet (see docs/run-folder.md).

Rows of steps.parquet are ordered by step, and within a step by data center, so that a column is an
array (steps, data centers). The reader loads one row group at a time, so that memory is needed only
for the requested columns and data centers, even for a year of a large fleet.
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
from sdc_taichi.exogenous.year_clock import UTC_OFFSETS_H, YEARS
from sdc_taichi.run.description import FORMAT
from sdc_taichi.run.flows_file import FLOW_COLUMNS, FLOWS_FILE, PLACES_KEY
from sdc_taichi.run.folder_writer import METRICS_FILE
from sdc_taichi.run.steps_file import AIR_KEY, KEY_COLUMNS, METADATA_KEY, RACKS_KEY, STEPS_FILE
from sdc_taichi.run.time_column import zone
from sdc_taichi.types import F64
from sdc_taichi.user_file import (
    MOST_METRICS_BYTES,
    decoding,
    open_input,
    open_parquet,
    read_parquet,
    read_text,
)

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
    "year": int,
    "utc_offset_h": (int, float),
    "synthetic": bool,
    "provenance": dict,
    "sha256": dict,
    "metrics": dict,
    "events": list,
}
_DATA_CENTER_RANGES = {"year": YEARS, "utc_offset_h": UTC_OFFSETS_H}
_EVENT_TYPES: Mapping[str, type | tuple[type, ...]] = {
    "kind": str,
    "start_step": int,
    "end_step": int,
}
_INTERVALS_H = (0.25, 0.5, 1, 2, 3, 6, 12, 24, 48, 96, 168, 336, 720, 2160, 8760)


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Run folder with the checked content of its metrics.json."""

    path: Path
    """Path of the folder."""
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
        """Simulated time of the completed steps, in h."""
        return float(self.metrics["steps_done"] * self.metrics["step_h"])


@dataclass(frozen=True, slots=True)
class FleetSteps:
    """Fleet totals of a run by step, and hottest inlets of B data centers by interval."""

    series: pd.DataFrame
    """One row per step. ``time`` is the local standard time of the first data center; ``it_w``,
    ``overhead_w`` (W) and ``carbon_g`` (g) are sums over the data centers. ``inlet_low_c``,
    ``inlet_mid_c``, ``inlet_high_c`` and ``inlet_max_c`` (C) are the 10 %, 50 % and 90 % quantile
    and the maximum of the data centers' hottest inlets."""
    edge_times: npt.NDArray[np.datetime64]
    """Start times of m intervals, and the end of the run, (m + 1,), local standard time of the
    first data center; all intervals but the last have equal length."""
    inlet_max_c: F64
    """Highest inlet temperature in each interval and data center, in C, (m, B)."""


@dataclass(frozen=True, slots=True)
class FleetFlows:
    """Work that the sites of fleets have sent to each other in a run, and where the sites are."""

    table: pd.DataFrame
    """One row per hour and pair of sites with flow, with the columns of flows.parquet; ``sender``
    and ``receiver`` are indices of data centers."""
    sites_per_fleet: int
    """Number of sites of each fleet."""
    place_deg: F64
    """Latitude and longitude of each of B data centers, in degrees north and east, nan if they are
    not known, (B, 2)."""


def read_run(folder: str | Path) -> RunFolder:
    """Open a run folder: read metrics.json and check that steps.parquet matches it.

    Raises:
        SdcError: The folder does not exist, contains no run or a run of another format, or a file
            is damaged or belongs to another run.
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
    """Read the steps of some data centers as DataFrames with ``step``, ``time`` and more columns.

    ``time`` is in the time zone of the data center, its local standard time.

    Args:
        run: The run.
        dcs: Indices of the data centers; the result has one DataFrame for each.
        columns: Names of the further columns; None reads all columns.

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
    series = {name: np.concatenate(values) for name, values in parts.items()}
    frames = [
        pd.DataFrame({name: values[:, i] for name, values in series.items()})
        for i in range(len(dcs))
    ]
    for dc, frame in zip(dcs, frames, strict=True):
        local = zone(run.metrics["data_centers"][dc]["utc_offset_h"])
        frame["time"] = frame["time"].dt.tz_localize("UTC").dt.tz_convert(local)
    return frames


def read_fleet_steps(run: RunFolder) -> FleetSteps:
    """Read the fleet totals of every step, and the hottest inlets of the data centers.

    Raises:
        SdcError: steps.parquet is damaged, lacks a column, or its rows are out of order.
    """
    import pandas as pd

    summed = ("it_w", "overhead_w", "carbon_g")
    steps, size = run.metrics["steps_done"], len(run.names)
    step_h = float(run.metrics["step_h"])
    offset = np.timedelta64(round(60 * run.metrics["data_centers"][0]["utc_offset_h"]), "m")
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
        columns = {"time": group["time"][:, 0] + offset}
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


def read_config_texts(run: RunFolder) -> list[str]:
    """Read the config of each data center as YAML text from the metadata of steps.parquet.

    Raises:
        SdcError: The configs are missing.
    """
    text = _stored_metadata(run.steps_path).get("configs_yaml")
    if not isinstance(text, str):
        raise SdcError(f"{run.steps_path}: no configs_yaml; valid is a file written by simulate")
    documents = ("\n" + text).split("\n---\n")
    documents = documents[1:] if len(documents) > 1 else documents
    if len(documents) != len(run.names):
        raise SdcError(
            f"{run.steps_path}: configs of {len(documents)} data centers, expected {len(run.names)}"
        )
    return documents


def read_configs(run: RunFolder, dcs: Sequence[int]) -> list[DataCenterConfig]:
    """Read the configs of some data centers from the metadata of steps.parquet.

    Only these are parsed, because parsing those of a large fleet takes minutes.

    Raises:
        SdcError: The configs are missing or not valid.
    """
    documents = read_config_texts(run)
    label = f"{run.steps_path}: configs_yaml"
    try:
        return [config_from_dict(load_yaml(documents[dc]), label) for dc in dcs]
    except ConfigError:
        raise
    except ValueError as error:
        raise SdcError(f"{label}: not valid YAML ({error})") from None


def read_racks(run: RunFolder, dcs: Sequence[int]) -> list[pd.DataFrame]:
    """Read rack statistics of some data centers as DataFrames with one row per rack.

    Column ``hottest_h`` is the time, in h, during which the rack had the hottest inlet of its hall,
    within ``TIE_K``. Column ``inlet_max_c`` is the highest inlet temperature of the rack, in C.
    Column ``above_27_h`` is the time, in h, during which its hottest inlet was above the
    recommended 27 C. Data centers with cold plates have a column ``junction_c``, the junction
    temperature in the step of the hottest junction, in C, 0 for racks without cold plates.

    Args:
        run: The run.
        dcs: Indices of the data centers; the result has one DataFrame for each.

    Raises:
        SdcError: steps.parquet is damaged or has no rack statistics.
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
            hottest, above, highest_c = (
                np.array(stored[dc][name], dtype=float)
                for name in ("hottest_steps", "above_27_steps", "inlet_max_c")
            )
        except (KeyError, TypeError, ValueError):
            hottest, above, highest_c = np.full((3, 1), np.nan)
        flat = hottest.ndim == 1 and hottest.shape == highest_c.shape == above.shape
        valid = flat and len(hottest) > 0 and np.all(np.isfinite(highest_c))
        if not (valid and all(np.all((s >= 0) & (s <= done)) for s in (hottest, above))):
            raise SdcError(
                f"{run.steps_path}: sdc_taichi_racks[{dc}] is {shortened(stored[dc])}; valid are "
                f"hottest_steps and above_27_steps, 0..{done}, and inlet_max_c of each rack"
            )
        columns = {"hottest_h": hottest * step_h, "inlet_max_c": highest_c}
        columns["above_27_h"] = above * step_h
        if "junction_c" in stored[dc]:
            junction_c = stored[dc]["junction_c"]
            if not (
                isinstance(junction_c, list)
                and len(junction_c) == len(hottest)
                and all(map(is_number, junction_c))
            ):
                raise SdcError(
                    f"{run.steps_path}: junction_c of sdc_taichi_racks[{dc}] is "
                    f"{shortened(junction_c)}; valid is a list of {len(hottest)} numbers"
                )
            columns["junction_c"] = np.array(junction_c, dtype=float)
        out.append(pd.DataFrame(columns))
    return out


def read_hottest_air(run: RunFolder, dc: int) -> object:
    """Read the stored air of a data center in its hottest step; None if the run stored no air.

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


def read_flows(run: RunFolder) -> FleetFlows | None:
    """Read the flows of work between the sites of fleets; None if the run has no flows.parquet.

    Raises:
        SdcError: flows.parquet is damaged or belongs to another run.
    """
    path = run.path / FLOWS_FILE
    if not path.exists():
        return None
    about, places = _stored_metadata(path), _stored_json(path, PLACES_KEY)
    if about.get("fingerprint") != run.metrics["fingerprint"]:
        raise SdcError(f"{path}: of another run than {METRICS_FILE}; simulate the run again")
    index = {name: dc for dc, name in enumerate(run.names)}
    with _open_parquet(path) as file, decoding(path, "flows of a run"):
        table = read_parquet(file, FLOW_COLUMNS).to_pandas()
        for end in ("sender", "receiver"):
            table[end] = table[end].astype(str).map(index).astype(np.int64)
        place_deg = np.array(places["place_deg"], dtype=np.float64)  # type: ignore[index]
        sites = int(places["sites_per_fleet"])  # type: ignore[index]
    return FleetFlows(table, sites, place_deg)


def _read_metrics(path: Path) -> dict[str, Any]:
    """Read metrics.json and check its fields."""
    with _part_of_run():
        text = read_text(path, MOST_METRICS_BYTES)
    try:
        content = load_json(text)
    except ValueError as error:
        raise SdcError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        label = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise SdcError(f"{path}: format {label!r}; valid is {FORMAT!r}, simulate the run again")
    _check_fields(path, "", content, _METRICS_TYPES)
    done, asked, step_h = content["steps_done"], content["steps_asked"], content["step_h"]
    if not 1 <= done <= asked:
        raise SdcError(f"{path}: steps_done {done} of steps_asked {asked}; valid is 1..{asked}")
    for index, dc in enumerate(content["data_centers"]):
        where = f"data_centers[{index}]"
        if not isinstance(dc, dict):
            raise SdcError(f"{path}: {where} is {dc!r}; valid is an object")
        _check_fields(path, f"{where}.", dc, _DATA_CENTER_TYPES)
        for name, (low, high) in _DATA_CENTER_RANGES.items():
            if not low <= dc[name] <= high:
                raise SdcError(f"{path}: {where}.{name} is {dc[name]}; valid is {low}..{high}")
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
    """Extend the error for a missing file by a hint on what a valid folder contains.

    Raises:
        SdcError: The block has raised it.
    """
    try:
        yield
    except SdcError as error:
        if not isinstance(error.__cause__, FileNotFoundError):
            raise
        valid = "valid is a folder that simulate wrote a whole run to"
        raise SdcError(f"{error}; {valid}") from None


def is_number(value: object) -> bool:
    """Return True if a JSON value is a number in the range of a float, and not a boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _check_event(place: str, event: Mapping[str, Any], done: int) -> None:
    """Check the steps of an event against the number of completed steps, and its amounts."""
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
    """Check that a JSON object has all expected fields with the expected types."""
    for name, kind in expected.items():
        value = values.get(name)
        # In Python, a bool is also an int, but it is not a valid number here.
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            problem = f"is {value!r}" if name in values else "is missing"
            names = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
            raise SdcError(f"{path}: {where}{name} {problem}; valid is of type {names}")


def _check_steps_file(run: RunFolder) -> None:
    """Check that steps.parquet belongs to the run of metrics.json, and has all its rows."""
    path = run.steps_path
    stored, expected = _flat_description(_stored_metadata(path)), _flat_description(run.metrics)
    for name in {**stored, **expected}:
        if stored.get(name) != expected.get(name):
            raise SdcError(
                f"{path}: {name} {shortened(stored.get(name))} is not that of {METRICS_FILE}, "
                f"{shortened(expected.get(name))}; simulate the run again"
            )
    with _open_parquet(path) as file:
        rows = file.metadata.num_rows
    expected_rows = run.metrics["steps_done"] * len(run.names)
    if rows != expected_rows:
        raise SdcError(
            f"{path}: {rows} rows, expected {expected_rows} as steps_done and data_centers of "
            f"{METRICS_FILE} say; simulate the run again"
        )


def _flat_description(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields that steps.parquet and metrics.json have in common, by their paths."""
    others = ("data_centers", "steps_done", "total", "configs_yaml", "optimum")
    out = {name: value for name, value in content.items() if name not in others}
    for index, dc in enumerate(content.get("data_centers", ())):
        fields = {name: value for name, value in dc.items() if name not in ("metrics", "events")}
        out |= {f"data_centers[{index}].{name}": value for name, value in fields.items()}
    return out


@contextlib.contextmanager
def _open_parquet(path: Path) -> Iterator[pq.ParquetFile]:
    """Open a Parquet file and read its metadata.

    Raises:
        SdcError: The file does not exist or is damaged.
    """
    with _part_of_run(), open_input(path) as file:
        with decoding(path, "a Parquet file"):
            opened = open_parquet(file)
        yield opened


def _stored_metadata(path: Path) -> dict[str, Any]:
    """Read the description of the run from the metadata of a Parquet file of its folder."""
    stored = _stored_json(path, METADATA_KEY)
    if not isinstance(stored, dict):
        raise SdcError(f"{path}: no sdc_taichi metadata; valid is a file written by simulate")
    return stored


def _stored_json(path: Path, key: bytes) -> object:
    """Read the JSON value of a metadata key of a Parquet file; None if missing or not valid."""
    with _open_parquet(path) as file:
        metadata = file.metadata.metadata or {}
    try:
        return cast(object, json.loads(metadata[key]))
    except (KeyError, RecursionError, ValueError):
        return None


def _column_names(run: RunFolder) -> list[str]:
    """Return the names of the quantity columns of steps.parquet."""
    with _open_parquet(run.steps_path) as file:
        names = file.schema_arrow.names
    return [name for name in names if name not in KEY_COLUMNS]


def _row_groups(run: RunFolder, columns: Sequence[str]) -> Iterator[dict[str, npt.NDArray[Any]]]:
    """Yield row groups as arrays (steps, data centers) by column, with ``step`` and ``time``."""
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
                table = read_parquet(file, wanted, index)
            group = _as_steps(run, index, table, done)
            done += len(group["step"])
            yield group


def _as_steps(run: RunFolder, index: int, table: pa.Table, done: int) -> dict[str, Any]:
    """Convert a row group to arrays (steps, data centers) and check the order of its rows.

    Args:
        run: The run.
        index: Index of the row group, for error messages.
        table: Columns of the row group.
        done: Number of steps in the preceding row groups.
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
    """Convert a column of an Arrow table to an array after checking its type."""
    column = table.column(name)
    kind = {"step": "int64", "time": "timestamp[ms, tz="}.get(name, "double")
    if not str(column.type).startswith(kind) or column.null_count:
        raise SdcError(
            f"{path}: column {name} is {column.type} with {column.null_count} empty values; valid "
            f"is {kind} without"
        )
    return np.asarray(column.to_numpy())
