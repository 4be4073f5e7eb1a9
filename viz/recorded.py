"""Read the folder of a recorded run: its metrics.json and steps.parquet (see docs/cli.md).

Rows of steps.parquet follow each other step by step, and within a step in the order of the data
centers, so a column is an array (steps, data centers). It is read a row group at a time: a year of
a large fleet needs no more memory than the columns and data centers that are asked for.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config import DataCenterConfig, config_from_dict
from sdc_taichi.errors import SdcError
from sdc_taichi.run.loop import FORMAT, METADATA_KEY
from sdc_taichi.types import F64

if TYPE_CHECKING:
    import pandas as pd

METRICS_FILE, STEPS_FILE = "metrics.json", "steps.parquet"
MAP_INTERVALS = 400
"""Most intervals of ``FleetSteps.inlet_max_c``."""

_ABOUT: Mapping[str, type | tuple[type, ...]] = {
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
_DATA_CENTER: Mapping[str, type | tuple[type, ...]] = {
    "name": str,
    "location": str,
    "start": str,
    "synthetic": bool,
    "provenance": dict,
    "sha256": dict,
    "metrics": dict,
    "events": list,
}
_EVENT: Mapping[str, type | tuple[type, ...]] = {"kind": str, "start_step": int, "end_step": int}
_MOST_CHARACTERS = 80
"""Of a value in an error."""
_HOURS = (0.25, 0.5, 1, 2, 3, 6, 12, 24, 48, 96, 168, 336, 720, 2160, 8760)


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """A run as its folder holds it."""

    folder: Path
    about: dict[str, Any]
    """Content of metrics.json."""

    @property
    def names(self) -> list[str]:
        """Of the data centers, in order."""
        return [dc["name"] for dc in self.about["data_centers"]]

    @property
    def steps_path(self) -> Path:
        """The file of its steps."""
        return self.folder / STEPS_FILE

    @property
    def hours(self) -> float:
        """Length of what was done."""
        return float(self.about["steps_done"] * self.about["step_h"])


@dataclass(frozen=True, slots=True)
class FleetSteps:
    """A run of all data centers together."""

    series: pd.DataFrame
    """By step, as ``fleet_figures.fleet_overview`` reads them."""
    edges: npt.NDArray[np.datetime64]
    """Beginnings of m intervals, equal but for the last, and the end of the run, (m + 1,)."""
    inlet_max_c: F64
    """Hottest inlet of each interval and data center, (m, B)."""


def read_run(folder: str | Path) -> RecordedRun:
    """Read metrics.json and check it and steps.parquet against each other.

    Raises:
        SdcError: there is no such folder, no run in it or one of another format, or a file is
            damaged or of another run.
    """
    place = Path(folder)
    if not place.is_dir():
        found = "is a file" if place.exists() else "no such folder"
        raise SdcError(f"{place}: {found}; valid is a folder that simulate wrote a run to")
    run = RecordedRun(place, _read_metrics(place / METRICS_FILE))
    _check_steps_file(run)
    return run


def read_steps(
    run: RecordedRun, dcs: Sequence[int], columns: Sequence[str] | None = None
) -> list[pd.DataFrame]:
    """Rows of some data centers, one table each, with ``step``, ``time`` and the columns asked for.

    Args:
        run: the run.
        dcs: indices of the data centers.
        columns: names; None is all of them.

    Raises:
        SdcError: steps.parquet is damaged, lacks a column, or its rows are out of order.
    """
    import pandas as pd

    if columns is None:
        columns = _column_names(run)
    parts: dict[str, list[npt.NDArray[Any]]] = {name: [] for name in ("step", "time", *columns)}
    for group in _groups(run, columns):
        for name, values in parts.items():
            values.append(group[name][:, list(dcs)])
    whole = {name: np.concatenate(values) for name, values in parts.items()}
    return [
        pd.DataFrame({name: values[:, i] for name, values in whole.items()})
        for i in range(len(dcs))
    ]


def read_fleet(run: RecordedRun) -> FleetSteps:
    """Sums over the data centers by step, and their hottest inlets.

    Raises:
        SdcError: as ``read_steps``.
    """
    import pandas as pd

    summed = ("it_w", "hvac_w", "carbon_g")
    steps, size = run.about["steps_done"], len(run.names)
    step_h = float(run.about["step_h"])
    interval = next(
        (round(h / step_h) for h in _HOURS if h >= step_h and run.hours <= h * MAP_INTERVALS),
        -(-steps // MAP_INTERVALS),
    )
    parts: dict[str, list[npt.NDArray[Any]]] = {}
    hottest = np.full((-(-steps // interval), size), -np.inf)
    done = 0
    for group in _groups(run, (*summed, "inlet_max_c")):
        inlets = group["inlet_max_c"]
        low, mid, high = np.quantile(inlets, (0.1, 0.5, 0.9), axis=1)
        found = {"time": group["time"][:, 0], **{name: group[name].sum(axis=1) for name in summed}}
        found |= {"inlet_low_c": low, "inlet_mid_c": mid, "inlet_high_c": high}
        for name, values in (found | {"inlet_max_c": inlets.max(axis=1)}).items():
            parts.setdefault(name, []).append(values)
        which = np.arange(done, done + len(inlets)) // interval
        edges = np.flatnonzero(np.diff(which, prepend=-1))
        rows = which[edges]
        hottest[rows] = np.maximum(hottest[rows], np.maximum.reduceat(inlets, edges, axis=0))
        done += len(inlets)
    series = pd.DataFrame({name: np.concatenate(values) for name, values in parts.items()})
    times = series["time"].to_numpy()
    end = times[-1] + np.timedelta64(round(60 * step_h), "m")
    return FleetSteps(series, np.append(times[::interval], end), hottest)


def read_configs(run: RecordedRun, dcs: Sequence[int]) -> list[DataCenterConfig]:
    """Configs of some data centers, as steps.parquet holds them.

    Raises:
        SdcError: they are missing or not valid.
    """
    import yaml

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
        return [config_from_dict(yaml.safe_load(documents[dc]), label) for dc in dcs]
    except yaml.YAMLError as error:
        raise SdcError(f"{label}: not valid YAML ({_one_line(error)})") from None


def _read_metrics(path: Path) -> dict[str, Any]:
    try:
        about = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise SdcError(
            f"{path}: no such file; valid is a folder that simulate wrote a whole run to"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        reason = getattr(error, "strerror", None) or _one_line(error)
        raise SdcError(f"{path}: cannot be read: {reason}") from None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        found = about.get("format") if isinstance(about, dict) else type(about).__name__
        raise SdcError(f"{path}: format {found!r}; valid is {FORMAT!r}, simulate the run again")
    _check_fields(path, "", about, _ABOUT)
    done, asked, step_h = about["steps_done"], about["steps_asked"], about["step_h"]
    if not 1 <= done <= asked:
        raise SdcError(f"{path}: steps_done {done} of steps_asked {asked}; valid is 1..{asked}")
    for index, dc in enumerate(about["data_centers"]):
        where = f"data_centers[{index}]"
        if not isinstance(dc, dict):
            raise SdcError(f"{path}: {where} is {dc!r}; valid is an object")
        _check_fields(path, f"{where}.", dc, _DATA_CENTER)
        for number, event in enumerate(dc["events"]):
            place = f"{where}.events[{number}]"
            if not isinstance(event, dict):
                raise SdcError(f"{path}: {place} is {event!r}; valid is an object")
            _check_fields(path, f"{place}.", event, _EVENT)
            _check_event(f"{path}: {place}", event, done)
    if not about["data_centers"]:
        raise SdcError(f"{path}: data_centers is empty; valid is one or more")
    if not 0 < step_h <= 1:
        raise SdcError(f"{path}: step_h {step_h!r}; valid is above 0 up to 1")
    return dict(about)


def is_number(value: object) -> bool:
    """Whether a JSON value is a number that a float holds; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def _check_event(place: str, event: Mapping[str, Any], done: int) -> None:
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
    given: Mapping[str, Any],
    expected: Mapping[str, type | tuple[type, ...]],
) -> None:
    for name, kind in expected.items():
        value = given.get(name)
        # A bool is an int in Python, and no number here.
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            found = f"is {value!r}" if name in given else "is missing"
            names = " or ".join(k.__name__ for k in (kind if isinstance(kind, tuple) else (kind,)))
            raise SdcError(f"{path}: {where}{name} {found}; valid is of type {names}")


def _check_steps_file(run: RecordedRun) -> None:
    path = run.steps_path
    stored, given = _described(_stored_metadata(path)), _described(run.about)
    for name in {**stored, **given}:
        if stored.get(name) != given.get(name):
            raise SdcError(
                f"{path}: {name} {_cut(stored.get(name))} is not that of {METRICS_FILE}, "
                f"{_cut(given.get(name))}; simulate the run again"
            )
    rows = _open(path).metadata.num_rows
    expected = run.about["steps_done"] * len(run.names)
    if rows != expected:
        raise SdcError(
            f"{path}: {rows} rows, expected {expected} as steps_done and data_centers of "
            f"{METRICS_FILE} say; simulate the run again"
        )


def _described(about: Mapping[str, Any]) -> dict[str, Any]:
    """What a run is, field by field, which steps.parquet and metrics.json tell alike."""
    others = ("data_centers", "steps_done", "total", "configs_yaml")
    out = {name: value for name, value in about.items() if name not in others}
    for index, dc in enumerate(about.get("data_centers", ())):
        own = {name: value for name, value in dc.items() if name not in ("metrics", "events")}
        out |= {f"data_centers[{index}].{name}": value for name, value in own.items()}
    return out


def _cut(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _MOST_CHARACTERS else text[:_MOST_CHARACTERS] + "…"


def _open(path: Path) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.ParquetFile(path)
    except FileNotFoundError:
        raise SdcError(
            f"{path}: no such file; valid is a folder that simulate wrote a whole run to"
        ) from None
    except (OSError, pa.ArrowException) as error:
        raise SdcError(f"{path}: cannot be read as Parquet: {_one_line(error)}") from None


def _stored_metadata(path: Path) -> dict[str, Any]:
    metadata = _open(path).schema_arrow.metadata or {}
    try:
        stored = json.loads(metadata[METADATA_KEY])
    except (KeyError, ValueError):
        stored = None
    if not isinstance(stored, dict):
        raise SdcError(f"{path}: no sdc_taichi metadata; valid is a file written by simulate")
    return stored


def _column_names(run: RecordedRun) -> list[str]:
    names = _open(run.steps_path).schema_arrow.names
    return [name for name in names if name not in ("dc", "step", "time")]


def _groups(run: RecordedRun, columns: Sequence[str]) -> Iterator[dict[str, npt.NDArray[Any]]]:
    """Row groups as arrays (steps, data centers), ``step`` and ``time`` among them."""
    import pyarrow as pa

    path, size = run.steps_path, len(run.names)
    file = _open(path)
    wanted = ("dc", "step", "time", *columns)
    known = set(file.schema_arrow.names)
    missing = [name for name in wanted if name not in known]
    if missing:
        raise SdcError(f"{path}: no column {', '.join(missing)}; simulate the run again")
    done = 0
    for index in range(file.num_row_groups):
        try:
            table = file.read_row_group(index, columns=list(wanted))
        except (OSError, pa.ArrowException) as error:
            raise SdcError(f"{path}: row group {index} is damaged: {_one_line(error)}") from None
        if table.num_rows % size:
            raise SdcError(f"{path}: row group {index} has {table.num_rows} rows, not whole steps")
        group = {name: _as_array(path, name, table).reshape(-1, size) for name in wanted[1:]}
        steps = np.arange(done, done + table.num_rows // size)
        names = table.column("dc").slice(0, size).to_pylist()
        if names != run.names or not np.all(group["step"] == steps[:, None]):
            raise SdcError(
                f"{path}: row group {index}: rows are not in order of step and data center as in "
                f"{METRICS_FILE}; simulate the run again"
            )
        done += len(steps)
        yield group


def _as_array(path: Path, name: str, table: Any) -> npt.NDArray[Any]:
    column = table.column(name)
    kind = {"step": "int64", "time": "timestamp[ms]"}.get(name, "double")
    if str(column.type) != kind or column.null_count:
        raise SdcError(
            f"{path}: column {name} is {column.type} with {column.null_count} empty values; valid "
            f"is {kind} without"
        )
    return np.asarray(column.to_numpy())


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
