"""Exports of the tables of a run: CSV, Excel, and trend logs as of building management systems.

Tables are read and written a block at a time, so memory does not grow with the length of a run.
"""

from __future__ import annotations

import csv as csv_text
import io
import json
import string
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt

from sdc_taichi.atomic_file import atomic_write
from sdc_taichi.errors import ConfigError, SdcError, shortened, similar_names
from sdc_taichi.hall.rack_selection import RackSelection
from sdc_taichi.run.folder_reader import RunFolder, read_configs, read_racks
from sdc_taichi.run.rack_history import RACK_HISTORY_FILE, RACK_KEY_COLUMNS, require_room
from sdc_taichi.run.steps_file import KEY_COLUMNS, METADATA_KEY, STEPS_FILE
from sdc_taichi.types import QUANTITIES, meanings
from sdc_taichi.user_file import decoding, open_input, open_parquet, read_parquet

Kind = Literal["csv", "xlsx", "bms"]
"""Kind of an export."""
TableName = Literal["steps", "racks"]
"""Table of a run folder."""
SUFFIXES: dict[Kind, str] = {"csv": ".csv", "xlsx": ".xlsx", "bms": ".bms.csv"}
"""Ends of the names of exports."""
POINTS: dict[TableName, str] = {
    "steps": "{dc}/{quantity}",
    "racks": "{dc}/row{row}/rack{rack}/{quantity}",
}
"""Default templates of point names."""
MOST_SHEET_ROWS, MOST_SHEET_COLUMNS = 1_048_576, 16_384
"""Largest size of a sheet of Excel, in rows and columns."""
_RACK_QUANTITIES = {
    "inlet_c": ("C", "Mean inlet of the rack."),
    "inlet_max_c": ("C", "Highest inlet of a server in the interval."),
    "outlet_c": ("C", "Mean outlet of the rack."),
    "power_w": ("W", "Mean power of servers and their fans."),
    "airflow_m3s": ("m3/s", "Mean airflow through the rack."),
    "status": ("", "Worst status at the end of a step: 0 normal, 1 throttled, 2 tripped."),
}
_SHARE = ("1", "Share of the CRAC unit in the supply air that reaches the rack.")
_KEY_MEANINGS = {
    "dc": "Name of the data center.",
    "step": "Step since the start, from 0; of an interval the first.",
    "time": "Start of the step or interval, local standard time.",
    "utc_offset_h": "Local standard time minus UTC, in h.",
    "row": "Row of the rack, from 0.",
    "rack": "Index of the rack in its hall, from 0.",
}
_BYTES_PER_VALUE: dict[Kind, int] = {"csv": 18, "xlsx": 12, "bms": 75}
_VALUES_AT_A_TIME = 1 << 18
_FILES: dict[TableName, tuple[str, tuple[str, ...]]] = {
    "steps": (STEPS_FILE, KEY_COLUMNS),
    "racks": (RACK_HISTORY_FILE, RACK_KEY_COLUMNS),
}


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """Table, columns and rows of an export."""

    kind: Kind
    """Kind of the export."""
    table: TableName = "steps"
    """Table of the run."""
    columns: tuple[str, ...] | None = None
    """Names of the quantities; None exports all."""
    dcs: tuple[str, ...] | None = None
    """Names of the data centers; None exports all."""
    racks: RackSelection | None = None
    """Racks of table ``racks``; None exports all."""
    points: str | None = None
    """Template of point names for kind ``bms``; None is that of ``POINTS``."""


def export_table(run: RunFolder, request: ExportRequest, out: Path | None = None) -> Path:
    """Write a table of a run to a file; return its path.

    Args:
        run: The run.
        request: What to export.
        out: Path of the file; None names it after the table, in the folder of the run.

    Raises:
        SdcError: The run has no such table, data center, column or rack; a template of point names
            is not valid; a sheet would be too large; the file would not fit on the disk, or cannot
            be written; or a library is missing.
    """
    source = _Source(run, request)
    if out is None:
        out = run.path / f"{request.table}{SUFFIXES[request.kind]}"
    write: Callable[[_Source, IO[bytes]], None] = _write_csv
    if request.kind == "bms":
        template = POINTS[request.table] if request.points is None else request.points
        _check_points(template, request.table)

        def write(source: _Source, file: IO[bytes]) -> None:
            _write_points(source, file, template)

    elif request.points is not None:
        raise ConfigError("--points: names of points; valid with --to bms")
    elif request.kind == "xlsx":
        _require_xlsxwriter()
        _check_sheet(source)
        write = _write_sheets
    values = source.most_rows * (len(source.columns) + 2)
    require_room(
        out,
        values * _BYTES_PER_VALUE[request.kind],
        f"{source.most_rows:,} rows of {len(source.columns)} quantities",
        "fewer quantities (--columns), data centers (--dc) or racks (--racks)",
    )
    with atomic_write(out) as file:
        write(source, file)
    return out


class _Source:
    """Rows of a table of a run that an export selects."""

    def __init__(self, run: RunFolder, request: ExportRequest) -> None:
        name, self.keys = _FILES[request.table]
        self.run, self.table, self.path = run, request.table, run.path / name
        if request.table == "racks" and not self.path.exists():
            raise SdcError(
                f"{self.path}: no such file; valid is a run of simulate with --racks or "
                "--rack-history"
            )
        with open_input(self.path) as file, decoding(self.path, "a Parquet file"):
            opened = open_parquet(file)
            schema, rows = opened.schema_arrow, opened.metadata.num_rows
        self._check_run(schema.metadata or {})
        names = tuple(each for each in schema.names if each not in self.keys)
        self.columns = _chosen("--columns", request.columns, names)
        self.dcs = _chosen("--dc", request.dcs, tuple(run.names))
        self._racks = self._chosen_racks(request)
        self.most_rows = rows * len(self.dcs) // len(run.names)
        if self._racks is not None:
            per_dc = max(len(racks) for racks in self._racks.values())
            chosen_rows = per_dc * len(self.dcs) * run.metrics["steps_done"]
            self.most_rows = min(self.most_rows, chosen_rows)

    def blocks(self) -> Iterator[Any]:
        """Yield the selected rows as Arrow tables, in the order of the file."""
        import pyarrow as pa
        import pyarrow.compute as pc

        with open_input(self.path) as file:
            with decoding(self.path, "a Parquet file"):
                opened = open_parquet(file)
            for number in range(opened.num_row_groups):
                with decoding(self.path, f"row group {number}"):
                    block = read_parquet(opened, [*self.keys, *self.columns], number)
                names = pc.cast(block["dc"], pa.string())
                if len(self.dcs) < len(self.run.names):
                    is_chosen = pc.is_in(names, pa.array(self.dcs))
                    block, names = block.filter(is_chosen), names.filter(is_chosen)
                if self._racks is not None:
                    block = block.filter(pa.array(self._is_chosen(block, names)))
                if block.num_rows:
                    yield block

    def _is_chosen(self, block: Any, names: Any) -> npt.NDArray[np.bool_]:
        """Return True for the rows of a block that are of selected racks."""
        assert self._racks is not None
        rack, dc = block["rack"].to_numpy(), names.to_numpy(zero_copy_only=False)
        is_chosen = np.zeros(len(rack), dtype=bool)
        for name, racks in self._racks.items():
            is_chosen |= (dc == name) & np.isin(rack, racks)
        return is_chosen

    def _check_run(self, metadata: dict[bytes, bytes]) -> None:
        """Check that the table belongs to the run of metrics.json."""
        try:
            stored = json.loads(metadata[METADATA_KEY])["fingerprint"]
        except (KeyError, TypeError, ValueError, RecursionError):
            stored = None
        if stored != self.run.metrics["fingerprint"]:
            raise SdcError(f"{self.path}: not of the run of metrics.json; simulate the run again")

    def _chosen_racks(self, request: ExportRequest) -> dict[str, npt.NDArray[np.int64]] | None:
        """Return the selected racks of each data center; None for all."""
        if request.racks is None:
            return None
        if request.table != "racks":
            raise ConfigError("--racks: racks of a table; valid with --table racks")
        numbers = [self.run.names.index(name) for name in self.dcs]
        configs, inlets = read_configs(self.run, numbers), read_racks(self.run, numbers)
        chosen = {}
        for name, config, highest in zip(self.dcs, configs, inlets, strict=True):
            request.racks.check(config.hall, name if len(self.dcs) > 1 else "")
            highest_c = highest["inlet_max_c"].to_numpy()
            chosen[name] = request.racks.racks(config.hall, highest_c)
        return chosen


def _chosen(option: str, names: tuple[str, ...] | None, valid: tuple[str, ...]) -> tuple[str, ...]:
    """Return the named entries of ``valid``; None names all."""
    if names is None:
        return valid
    for name in names:
        if name not in valid:
            near = similar_names(name, valid)
            some = ", ".join(near or valid[:5]) + ("" if near or len(valid) <= 5 else ", ...")
            raise ConfigError(f"{option} {shortened(name)}: valid are {some}")
    return tuple(dict.fromkeys(names))


def quantity_texts(table: TableName, name: str) -> tuple[str, str]:
    """Return unit and meaning of a quantity of a table."""
    if table == "steps":
        return QUANTITIES[name].unit, meanings()[name]
    return _RACK_QUANTITIES.get(name, _SHARE)


def _local_times(block: Any) -> npt.NDArray[np.datetime64]:
    """Return the local standard time of each row, in s."""
    utc = np.asarray(block["time"].cast("int64").to_numpy()).astype("datetime64[ms]")
    minutes = np.round(60 * block["utc_offset_h"].to_numpy()).astype("timedelta64[m]")
    return np.asarray((utc + minutes).astype("datetime64[s]"))


def _distinct_texts(
    values: npt.NDArray[Any], text: Callable[[npt.NDArray[Any]], npt.NDArray[np.str_]]
) -> Any:
    """Return the texts of values as an Arrow array; a repeated value is converted once."""
    import pyarrow as pa

    distinct, index = np.unique(values, return_inverse=True)
    return pa.array(text(distinct).astype(object)).take(pa.array(index.reshape(-1)))


def _write_csv(source: _Source, file: IO[bytes]) -> None:
    """Write a table as CSV with ISO 8601 times that have the UTC offset of the site."""
    import pyarrow as pa
    import pyarrow.compute as pc

    writer = None
    for block in source.blocks():
        clock = _distinct_texts(_local_times(block), np.datetime_as_string)
        offset = _distinct_texts(block["utc_offset_h"].to_numpy(), _offset_texts)
        columns = {
            name: (
                pc.binary_join_element_wise(clock, offset, "")
                if name == "time"
                else pc.cast(block["dc"], pa.string())
                if name == "dc"
                else block[name]
            )
            for name in block.column_names
        }
        table = pa.table(columns)
        if writer is None:
            writer = _csv_writer(file, table.schema)
        writer.write_table(table)
    if writer is not None:
        writer.close()


def _csv_writer(file: IO[bytes], schema: Any) -> Any:
    """Write the header of a CSV file, and return the writer of its rows."""
    from pyarrow import csv

    # Older versions of pyarrow quote every name of a header.
    header = io.StringIO()
    csv_text.writer(header, lineterminator="\n").writerow(schema.names)
    file.write(header.getvalue().encode())
    options = csv.WriteOptions(include_header=False, quoting_style="needed")
    return csv.CSVWriter(file, schema, write_options=options)


def _offset_texts(hours: npt.NDArray[Any]) -> npt.NDArray[np.str_]:
    """Return UTC offsets as texts such as ``-07:00``."""
    minutes = np.round(60 * np.asarray(hours)).astype(int)
    return np.array([f"{'-' if m < 0 else '+'}{abs(m) // 60:02}:{abs(m) % 60:02}" for m in minutes])


def _check_points(template: str, table: TableName) -> None:
    """Check the fields of a template of point names."""
    known: dict[str, Any] = {"dc": "", "quantity": ""}
    if table == "racks":
        known |= {"row": 0, "place": 0, "rack": 0}
    try:
        fields = [
            field for _, field, _, _ in string.Formatter().parse(template) if field is not None
        ]
        template.format(**known)
    except (KeyError, ValueError, IndexError, AttributeError, TypeError):
        fields = None
    if fields is None or not set(fields) <= set(known):
        valid = ", ".join(f"{{{name}}}" for name in known)
        raise ConfigError(f"--points {shortened(template)}: valid are texts and {valid}")


def _write_points(source: _Source, file: IO[bytes], template: str) -> None:
    """Write one line per value: point name, UTC time, value and unit, in the order of time."""
    import pyarrow as pa

    numbers = [source.run.names.index(name) for name in source.dcs]
    configs = read_configs(source.run, numbers)
    per_row = {
        name: config.hall.racks_per_row for name, config in zip(source.dcs, configs, strict=True)
    }
    units = pa.array([quantity_texts(source.table, name)[0] for name in source.columns])
    count = len(source.columns)
    writer = None
    for block in source.blocks():
        dc = block["dc"].cast("string").to_numpy(zero_copy_only=False)
        racks = block["rack"].to_numpy() if source.table == "racks" else np.zeros(len(dc), int)
        keys, index = _distinct_pairs(dc, racks)
        names = [
            _point_name(template, name, int(rack), per_row[name], quantity)
            for name, rack in keys
            for quantity in source.columns
        ]
        if len(set(names)) < len(names):
            raise ConfigError(
                f"--points {shortened(template)}: several points have the name "
                f"{shortened(next(n for n in names if names.count(n) > 1))}; valid is a template "
                f"whose names differ, such as {POINTS[source.table]}"
            )
        points = pa.array(names)
        utc = np.asarray(block["time"].cast("int64").to_numpy()).astype("datetime64[ms]")
        stamps = _distinct_texts(utc.astype("datetime64[s]"), _utc_texts)
        kind = np.float64 if source.table == "steps" else np.float32
        values = np.stack([block[n].to_numpy().astype(kind) for n in source.columns], axis=1)
        at_a_time = max(1, _VALUES_AT_A_TIME // count)
        for first in range(0, len(dc), at_a_time):
            rows = np.arange(first, min(first + at_a_time, len(dc)))
            place = (index[rows, None] * count + np.arange(count)).reshape(-1)
            table = pa.table(
                {
                    "point": points.take(pa.array(place)),
                    "time": stamps.take(pa.array(np.repeat(rows, count))),
                    "value": values[rows].reshape(-1),
                    "unit": units.take(pa.array(np.tile(np.arange(count), len(rows)))),
                }
            )
            if writer is None:
                writer = _csv_writer(file, table.schema)
            writer.write_table(table)
    if writer is not None:
        writer.close()


def _distinct_pairs(
    dc: npt.NDArray[Any], racks: npt.NDArray[Any]
) -> tuple[list[tuple[str, int]], npt.NDArray[np.int64]]:
    """Return the distinct pairs of data center and rack, and the index of each row into them."""
    names, which = np.unique(dc.astype(str), return_inverse=True)
    code = which.astype(np.int64) * (int(racks.max()) + 1) + racks
    distinct, index = np.unique(code, return_inverse=True)
    size = int(racks.max()) + 1
    return [(str(names[c // size]), int(c % size)) for c in distinct], index.reshape(-1)


def _point_name(template: str, dc: str, rack: int, racks_per_row: int, quantity: str) -> str:
    row, place = divmod(rack, racks_per_row)
    return template.format(dc=dc, row=row, place=place, rack=rack, quantity=quantity)


def _utc_texts(times: npt.NDArray[Any]) -> npt.NDArray[np.str_]:
    return np.char.add(np.datetime_as_string(times), "Z")


def _require_xlsxwriter() -> None:
    try:
        import xlsxwriter  # noqa: F401
    except ImportError:
        raise SdcError(
            'Excel files need XlsxWriter, which is not installed: pip install "sdc-taichi[excel]"'
        ) from None


def _check_sheet(source: _Source) -> None:
    """Check that a table fits on a sheet of Excel."""
    rows, columns = sum(b.num_rows for b in source.blocks()) + 1, len(source.keys + source.columns)
    if rows > MOST_SHEET_ROWS or columns > MOST_SHEET_COLUMNS:
        raise ConfigError(
            f"--to xlsx: {rows:,} rows and {columns:,} columns; valid are at most "
            f"{MOST_SHEET_ROWS:,} rows and {MOST_SHEET_COLUMNS:,} columns of a sheet; choose "
            "data centers (--dc) or racks (--racks), or --to csv"
        )


def _write_sheets(source: _Source, file: IO[bytes]) -> None:
    """Write a table as a sheet of Excel, and sheets of the meaning of its columns and of the run.

    Excel has no time zones: times are local standard time, beside a column of the UTC offset.
    """
    import xlsxwriter

    book = xlsxwriter.Workbook(file, {"constant_memory": True, "nan_inf_to_errors": True})
    bold, clock = (
        book.add_format({"bold": True}),
        book.add_format({"num_format": "yyyy-mm-dd hh:mm"}),
    )
    sheet = book.add_worksheet(source.table)
    names = [*source.keys, *source.columns]
    for column, name in enumerate(names):
        sheet.write_string(0, column, name, bold)
        sheet.set_column(column, column, max(10, len(name) + 2))
    sheet.freeze_panes(1, len(source.keys))
    row = 0
    for block in source.blocks():
        lists = [block[name].to_pylist() for name in names if name != "time"]
        lists.insert(names.index("time"), _local_times(block).tolist())
        for values in zip(*lists, strict=True):
            row += 1
            for column, value in enumerate(values):
                if isinstance(value, str):
                    sheet.write_string(row, column, value)
                elif value is not None and column == names.index("time"):
                    sheet.write_datetime(row, column, value, clock)
                elif value is not None:
                    sheet.write_number(row, column, value)
    about = book.add_worksheet("columns")
    texts: Sequence[Sequence[str]] = [
        ("column", "unit", "meaning"),
        *((name, "", _KEY_MEANINGS[name]) for name in source.keys),
        *((name, *quantity_texts(source.table, name)) for name in source.columns),
    ]
    _write_texts(about, texts, bold)
    described = {k: v for k, v in source.run.metrics.items() if isinstance(v, str | int | float)}
    _write_texts(book.add_worksheet("run"), [(k, str(v)) for k, v in described.items()], None)
    try:
        book.close()
    except BaseException as error:
        # An archive completes itself when its last reference goes, and needs its open file for it.
        traceback.clear_frames(error.__traceback__)
        raise


def _write_texts(sheet: Any, rows: Sequence[Sequence[str]], first_format: Any) -> None:
    for number, texts in enumerate(rows):
        for column, text in enumerate(texts):
            sheet.write_string(number, column, text, first_format if number == 0 else None)
    sheet.set_column(0, 1, 24)
    sheet.set_column(2, 2, 100)
