"""File racks.parquet of a run folder: temperatures, power and airflow of racks over time.

A row describes one rack in one interval of a whole number of steps. Rows are in the order of
intervals, and within an interval in the order of data centers and racks.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Self

import numpy as np

from sdc_taichi.atomic_file import naming_errors
from sdc_taichi.errors import ConfigError, shortened
from sdc_taichi.hall.rack_selection import RackSelection, parse_racks
from sdc_taichi.hall.unit_supply import weighted_shares
from sdc_taichi.number_text import parse_number
from sdc_taichi.run.parquet_table import ParquetTable, key_columns
from sdc_taichi.run.steps_file import KEY_COLUMNS, METADATA_KEY
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F32, F64, I64, Reals, Status, StepResult

RACK_HISTORY_FILE = "racks.parquet"
"""Name of the history of racks in a run folder."""
HISTORY_KEY = b"sdc_taichi_history"
"""Metadata key of the length of an interval and the selected racks, as JSON."""
RACK_KEY_COLUMNS = (*KEY_COLUMNS, "row", "rack")
"""Columns that identify a row; all others are quantities."""
QUANTUMS = {
    "inlet_c": 2.0**-10,
    "inlet_max_c": 2.0**-10,
    "outlet_c": 2.0**-10,
    "power_w": 2.0**-3,
    "airflow_m3s": 2.0**-16,
}
"""Steps to which quantities are rounded, in their units, by column. Powers of two end in zero bits,
which compress well: to about 8 bytes a row."""
_SHARE_QUANTUM = 2.0**-12
BYTES_PER_ROW, BYTES_PER_SHARE = 14, 2
"""Estimated size of a row without shares, and of a share, in bytes; real runs need less."""
SPARE_BYTES = 50_000_000
"""Disk space that a history leaves free for the other files of its run, in bytes."""
_ROWS_PER_GROUP = 1 << 16
_MINUTES = {"min": 1, "h": 60}


@dataclass(frozen=True, slots=True)
class HistoryRequest:
    """Requested history of racks."""

    racks: RackSelection | None = None
    """Selected racks of each data center; None selects all."""
    every_min: float | None = None
    """Length of an interval, in minutes; None is a step."""
    unit_shares: bool = False
    """True adds the share of each CRAC unit in the supply air of each rack."""

    def steps(self, steps_per_hour: int) -> int:
        """Return the number of steps of an interval.

        Raises:
            ConfigError: The interval is not a whole number of steps.
        """
        if self.every_min is None:
            return 1
        steps = self.every_min * steps_per_hour / 60
        if steps < 1 or abs(steps - round(steps)) > 1e-9:
            raise ConfigError(
                f"--rack-history every={self.every_min:g}min: valid is a whole number of steps of "
                f"{60 // steps_per_hour} min"
            )
        return round(steps)


def parse_history(text: str, racks: RackSelection | None = None) -> HistoryRequest:
    """Parse the option ``--rack-history``, such as ``every=15min`` or ``every=1h,unit-shares``.

    Args:
        text: The text.
        racks: Selected racks; None selects all.

    Raises:
        ConfigError: The text has another form.
    """
    every_min, unit_shares = None, False
    for part in text.split(","):
        name, _, value = part.strip().partition("=")
        unit = next((each for each in _MINUTES if value.endswith(each)), "")
        if part.strip() == "unit-shares":
            unit_shares = True
        elif name == "every" and value == "step":
            every_min = None
        elif name == "every" and unit:
            every_min = _minutes(text, value.removesuffix(unit)) * _MINUTES[unit]
        else:
            raise _history_error(text)
    return HistoryRequest(racks, every_min, unit_shares)


def history_request(racks: str | None, every: str | None) -> HistoryRequest | None:
    """Return the history that options ask for; None if there are none.

    Args:
        racks: Text of ``--racks``.
        every: Text of ``--rack-history``.

    Raises:
        ConfigError: An option is not valid.
    """
    if racks is None and every is None:
        return None
    selection = None if racks is None else parse_racks(racks)
    return HistoryRequest(selection) if every is None else parse_history(every, selection)


def _minutes(text: str, number: str) -> float:
    try:
        value = parse_number(number)
    except ValueError:
        raise _history_error(text) from None
    if not 0 < value <= 525_600:
        raise _history_error(text)
    return value


def _history_error(text: str) -> ConfigError:
    return ConfigError(
        f"--rack-history {shortened(text)}: valid are every=step, every=15min or every=1h, and "
        "unit-shares, separated by commas"
    )


def check_history(request: HistoryRequest, fleet: Fleet, steps: int, out: Path) -> None:
    """Check that a history fits the halls of a fleet and the free disk space.

    Args:
        request: The requested history.
        fleet: The fleet.
        steps: Number of steps of the run.
        out: Folder of the run, which exists.

    Raises:
        ConfigError: A hall does not have a selected rack, or the interval is no whole number of
            steps.
        SdcError: The history would not fit on the disk.
    """
    intervals = -(-steps // request.steps(fleet.steps_per_hour))
    whole_halls = request.racks is None or request.racks.needs_inlets
    if request.racks is not None:
        for config in fleet.configs:
            request.racks.check(config.hall, config.name if fleet.size > 1 else "")
    # The hottest racks are known at the end of the run, so until then all racks are stored.
    racks = fleet.racks if whole_halls else len(_chosen(request, fleet, None))
    shares = int(np.diff(fleet.unit_offsets).max()) if request.unit_shares else 0
    size = intervals * racks * (BYTES_PER_ROW + BYTES_PER_SHARE * shares)
    if request.racks is not None and request.racks.needs_inlets:
        size = intervals * _record(len(QUANTUMS) + shares, racks).itemsize
    require_room(
        out / RACK_HISTORY_FILE,
        size,
        f"{racks:,} racks and {intervals:,} intervals",
        "fewer racks (--racks row:0) or longer intervals (--rack-history every=1h)",
    )


def require_room(path: Path, size: float, content: str, valid: str) -> None:
    """Check that a file of an estimated size fits on the disk.

    Args:
        path: Path of the file, in a folder that exists.
        size: Estimated size, in bytes.
        content: Text on what makes the size.
        valid: Text on what to do instead.

    Raises:
        ConfigError: The file would leave less than ``SPARE_BYTES`` free.
    """
    with naming_errors(path):
        free = shutil.disk_usage(path.parent).free
    if size + SPARE_BYTES > free:
        raise ConfigError(
            f"{path}: about {size / 1e9:.3g} GB for {content}, and {free / 1e9:.3g} GB are free; "
            f"valid are {valid}"
        )


class RackHistoryWriter:
    """Writes the history of racks to a Parquet file, one row group at a time.

    Memory does not grow with the number of steps. ``commit`` gives the file its name; without
    ``commit``, no file remains.

    Args:
        path: Path of the file.
        sim: Simulator whose steps are added.
        request: The requested history, which ``check_history`` accepts.
        metadata: Description of the run, stored as JSON under ``METADATA_KEY``.

    Raises:
        SdcError: The file cannot be written, or another process is writing it.
    """

    def __init__(
        self, path: Path, sim: Simulator, request: HistoryRequest, metadata: Mapping[str, Any]
    ) -> None:
        self._sim, self._fleet, self._request = sim, sim.fleet, request
        self._every = request.steps(self._fleet.steps_per_hour)
        self._needs_choice = request.racks is not None and request.racks.needs_inlets
        stored = None if self._needs_choice else request
        self._racks = _chosen(stored, self._fleet, None)
        self._is_whole = len(self._racks) == self._fleet.racks
        about = {
            "every_steps": self._every,
            "racks": "all" if request.racks is None else _text_of(request.racks),
        }
        units = int(np.diff(self._fleet.unit_offsets).max()) if request.unit_shares else 0
        self._names = (*QUANTUMS, *(f"unit_{unit}_share" for unit in range(units)))
        self._block = np.empty(
            _intervals_per_group(self._racks), _record(len(self._names), len(self._racks))
        )
        self._filled = self._intervals_written = self._steps_in_interval = 0
        # The values of a single step need no sums.
        self._sums: F64 = np.empty((len(self._names) if self._every > 1 else 0, len(self._racks)))
        self._highest_c = np.full(self._fleet.racks, -np.inf)
        self._table = ParquetTable(
            path,
            {
                METADATA_KEY: json.dumps(metadata, allow_nan=False).encode(),
                HISTORY_KEY: json.dumps(about).encode(),
            },
            compression="zstd",
            compression_level=1,
            use_dictionary=[*RACK_KEY_COLUMNS, "status"],
            # Rounded measurements compress best if equal bytes of all values are neighbours.
            use_byte_stream_split=list(self._names),
        )
        # Until the hottest racks are known, the values of all racks are in a file without a name.
        # Compression of this file would take a third of the time of a step.
        self._scratch: IO[bytes] | None = None
        if self._needs_choice:
            with naming_errors(path):
                self._scratch = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115

    def add(self, result: StepResult) -> None:
        """Add a step; steps must be added in order.

        Raises:
            SdcError: The file cannot be written.
        """
        racks, is_first = self._racks, self._steps_in_interval == 0
        hottest_c = result.rack_inlet_max_c
        rows = (
            result.rack_inlet_c,
            hottest_c,
            result.rack_outlet_c,
            result.rack_power_w,
            result.rack_airflow_m3s,
        )
        chosen = rows if self._is_whole else tuple(row[racks] for row in rows)
        status = result.rack_status if self._is_whole else result.rack_status[racks]
        interval = self._block[self._filled]
        values = interval["values"] if self._every == 1 else self._sums
        if is_first:
            for index, row in enumerate(chosen):
                values[index] = row
            interval["status"][:] = status
        else:
            for index, row in enumerate(chosen):
                if index == 1:
                    np.maximum(values[index], row, out=values[index])
                else:
                    values[index] += row
            np.maximum(interval["status"], status, out=interval["status"])
        if self._request.unit_shares:
            shares = values[len(chosen) :]
            if is_first:
                shares[:] = 0.0
            self._add_shares(shares)
        if self._needs_choice:
            np.maximum(self._highest_c, hottest_c, out=self._highest_c)
        self._steps_in_interval += 1
        if self._steps_in_interval == self._every:
            self._end_interval()

    def commit(self) -> None:
        """Complete the file and give it its name.

        Raises:
            SdcError: The file cannot be written.
        """
        if self._steps_in_interval:
            self._end_interval()
        self._end_block()
        if self._scratch is not None:
            self._write_hottest(self._scratch)
        self._table.commit()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._table.discard()
        if self._scratch is not None:
            self._scratch.close()

    def _add_shares(self, sums: Reals) -> None:
        """Add the shares of the CRAC units in the supply air of each rack, (U, R), to sums."""
        fleet, weight = self._fleet, self._sim.intake_air().unit_weight
        shares = np.ones((fleet.racks, len(sums)))
        if fleet.air is not None:
            shares[:] = np.nan
            for dc in range(fleet.size):
                racks = slice(*fleet.rack_offsets[dc : dc + 2])
                units = slice(*fleet.unit_offsets[dc : dc + 2])
                first, end = fleet.air.unit_share_offsets[dc : dc + 2]
                by_layout = fleet.air.unit_shares[first:end].reshape(racks.stop - racks.start, -1)
                shares[racks, : by_layout.shape[1]] = weighted_shares(by_layout, weight[units])
        sums += shares[self._racks].T

    def _end_interval(self) -> None:
        """Store the means and highest inlets of an interval."""
        if self._every > 1:
            values = self._block[self._filled]["values"]
            np.divide(self._sums, self._steps_in_interval, out=values, casting="same_kind")
            values[1] = self._sums[1]
        self._filled += 1
        self._steps_in_interval = 0
        if self._filled == len(self._block):
            self._end_block()

    def _end_block(self) -> None:
        """Write the intervals since the last block, if any, to the table or the scratch file."""
        block, self._filled = self._block[: self._filled], 0
        if self._scratch is None:
            self._write_row_group(self._racks, block["values"], block["status"])
        else:
            with naming_errors(self._table.path):
                self._scratch.write(block.view(np.uint8).data)

    def _write_hottest(self, scratch: IO[bytes]) -> None:
        """Write the rows of the racks that were hottest over the run from the scratch file."""
        with naming_errors(self._table.path):
            scratch.flush()
            stored = np.memmap(scratch, self._block.dtype, mode="r")
        racks = _chosen(self._request, self._fleet, self._highest_c)
        count = _intervals_per_group(racks)
        for first in range(0, len(stored), count):
            block = stored[first : first + count]
            values = block["values"][:, :, racks]
            self._write_row_group(racks, values, block["status"][:, racks])

    def _write_row_group(self, racks: I64, values: F32, status: Status) -> None:
        """Write the next intervals, if any, as a row group.

        Args:
            racks: Indices of the K racks in the fleet, (K,).
            values: Quantities of ``self._names`` in each interval, (intervals, quantities, K).
            status: Worst status of each rack in each interval, (intervals, K).
        """
        count, fleet = len(values), self._fleet
        if count == 0:
            return
        steps = self._every * np.arange(self._intervals_written, self._intervals_written + count)
        dcs = fleet.rack_dc[racks]
        rack = racks - fleet.rack_offsets[dcs]
        per_row = np.array([config.hall.racks_per_row for config in fleet.configs])
        columns = key_columns(fleet, self._sim.drivers, steps, dcs)
        columns["row"] = np.tile((rack // per_row[dcs]).astype(np.int32), count)
        columns["rack"] = np.tile(rack.astype(np.int32), count)
        for number, name in enumerate(self._names):
            quantum = np.float32(QUANTUMS.get(name, _SHARE_QUANTUM))
            column = values[:, number] / quantum
            np.rint(column, out=column)
            column *= quantum
            columns[name] = column.reshape(-1)
        columns["status"] = status.reshape(-1)
        self._table.write(columns)
        self._intervals_written += count


def _record(names: int, racks: int) -> np.dtype[np.void]:
    """Return the layout of an interval in memory and in the scratch file."""
    values, status = (np.float32, (names, racks)), (np.int8, (racks,))
    return np.dtype([("values", *values), ("status", *status)], align=True)


def _intervals_per_group(racks: I64) -> int:
    return max(1, _ROWS_PER_GROUP // max(1, len(racks)))


def _chosen(request: HistoryRequest | None, fleet: Fleet, highest_c: F64 | None) -> I64:
    """Return the indices of the selected racks in the fleet, in order of data center and rack.

    Args:
        request: The requested history; None selects all racks.
        fleet: The fleet, with R racks.
        highest_c: Highest inlet temperature of each rack, in C, (R,); needed if the selection
            depends on inlets.
    """
    selection = None if request is None else request.racks
    if selection is None:
        return np.arange(fleet.racks)
    parts = []
    for dc, config in enumerate(fleet.configs):
        first, end = fleet.rack_offsets[dc : dc + 2]
        inlet_c = None if highest_c is None else highest_c[first:end]
        parts.append(first + np.sort(selection.racks(config.hall, inlet_c)))
    return np.concatenate(parts)


def _text_of(selection: RackSelection) -> str:
    return ",".join(term.text for term in selection.terms)
