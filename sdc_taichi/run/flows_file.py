"""File flows.parquet of a run folder: work that the sites of fleets send to each other, by hour."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from sdc_taichi.run.parquet_table import ParquetTable
from sdc_taichi.run.steps_file import METADATA_KEY
from sdc_taichi.run.time_column import utc_times
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.sim.transfer import task_kwh, transfer_kwh_per_task
from sdc_taichi.types import StepResult

FLOWS_FILE = "flows.parquet"
"""Name of the file of flows in a run folder."""
FLOW_COLUMNS = ("hour", "time", "sender", "receiver", "tasks", "transfer_g", "saved_g")
"""Columns of the file; see docs/run-folder.md."""
PLACES_KEY = b"sdc_taichi_places"
"""Metadata key of the sites, as JSON: ``sites_per_fleet``, and ``place_deg`` with latitude and
longitude of each data center."""
_ROWS_PER_GROUP = 1 << 16


class FlowsWriter:
    """Writes hourly sums of the flows between sites to a Parquet file, a row group at a time.

    The table has a row for each hour, sender and receiver with flow. ``commit`` gives the file its
    name; without ``commit``, no file remains.

    Args:
        path: Path of the file.
        sim: Simulator of fleets whose steps are added.
        metadata: Description of the run, stored as JSON under ``METADATA_KEY``.

    Raises:
        SdcError: The file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path, sim: Simulator, metadata: Mapping[str, Any]) -> None:
        self._sim = sim
        size, sites = sim.size, sim.fleet.sites_per_fleet
        self._fleets = (size // sites, sites)
        self._task_kwh: Any = None
        self._sums = np.zeros((3, size // sites, sites, sites))
        """Tasks, emissions of transfers and savings in the current hour, by fleet and pair."""
        self._hour = 0
        self._rows: list[tuple[Any, ...]] = []
        self._filled = 0
        place_deg = [
            [None if np.isnan(value) else float(value) for value in place]
            for place in sim.drivers.place_deg
        ]
        places = {"sites_per_fleet": sites, "place_deg": place_deg}
        texts = {METADATA_KEY: metadata, PLACES_KEY: places}
        self._table = ParquetTable(
            path,
            {key: json.dumps(value, allow_nan=False).encode() for key, value in texts.items()},
            compression="zstd",
            use_dictionary=["hour", "time", "sender", "receiver"],
        )

    def add(self, result: StepResult) -> None:
        """Add the last step of the simulator; steps must be added in order.

        Raises:
            SdcError: The file cannot be written.
        """
        hour = result.step // self._sim.fleet.steps_per_hour
        if hour != self._hour:
            self._end_hour()
            self._hour = hour
        tasks = self._sim.flows_tasks()
        if not tasks.any():
            return
        if self._task_kwh is None:
            fleet, sizing = self._sim.fleet, self._sim.sizing
            self._task_kwh = tuple(
                each(fleet, sizing).reshape(self._fleets)[:, :1, None]
                for each in (task_kwh, transfer_kwh_per_task)
            )
        facility_kwh, transfer_kwh = self._task_kwh
        ci = result.ci_g_per_kwh.reshape(self._fleets)
        sender_ci, receiver_ci = ci[:, :, None], ci[:, None, :]
        transfer_g = tasks * transfer_kwh * (sender_ci + receiver_ci) / 2.0
        saved_g = tasks * facility_kwh * (sender_ci - receiver_ci) - transfer_g
        self._sums += (tasks, transfer_g, saved_g)

    def commit(self) -> None:
        """Complete the file and give it its name.

        Raises:
            SdcError: The file cannot be written.
        """
        self._end_hour()
        self._write_row_group()
        self._table.commit()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._table.discard()

    def _end_hour(self) -> None:
        """Keep the rows of the current hour, and set its sums to 0."""
        fleet, sender, receiver = np.nonzero(self._sums[0])
        first = fleet * self._fleets[1]
        values = self._sums[:, fleet, sender, receiver]
        self._rows.append(
            (np.full(len(fleet), self._hour), first + sender, first + receiver, values)
        )
        self._sums[:] = 0.0
        self._filled += len(fleet)
        if self._filled >= _ROWS_PER_GROUP:
            self._write_row_group()

    def _write_row_group(self) -> None:
        """Write the rows since the last row group as a new row group."""
        import pyarrow as pa

        if not self._rows:
            return
        hours, senders, receivers, values = (
            np.concatenate(parts, axis=-1) for parts in zip(*self._rows, strict=True)
        )
        fleet, drivers = self._sim.fleet, self._sim.drivers
        names = pa.array(fleet.names)
        different, place = np.unique(hours, return_inverse=True)
        local = drivers.times(different * fleet.steps_per_hour, fleet.steps_per_hour)
        times = utc_times(local, drivers.utc_offset_h)[place, senders]
        kind = pa.timestamp("ms", tz="UTC")
        self._table.write(
            {
                "hour": hours,
                "time": pa.array(times.astype("datetime64[ms]").astype(np.int64)).cast(kind),
                "sender": pa.DictionaryArray.from_arrays(senders.astype(np.int32), names),
                "receiver": pa.DictionaryArray.from_arrays(receivers.astype(np.int32), names),
                **dict(zip(FLOW_COLUMNS[4:], values, strict=True)),
            }
        )
        self._rows, self._filled = [], 0
