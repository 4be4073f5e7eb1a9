"""Write the steps of a run as a Parquet file, steps.parquet of a run folder."""

from __future__ import annotations

import json
import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np

from sdc_taichi.atomic_file import AtomicFile, naming_errors
from sdc_taichi.exogenous.year_clock import step_times
from sdc_taichi.hall.air_metrics import TIE_K
from sdc_taichi.run.hottest_air import HottestAir, air_values
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, StepResult

STEPS_FILE = "steps.parquet"
"""Name of the file in a run folder."""
METADATA_KEY = b"sdc_taichi"
"""Key of the file's metadata under which the run is described, as JSON."""
RACKS_KEY = b"sdc_taichi_racks"
"""Key of the file's metadata under which it is told how hot each rack became, as JSON.

A list with an object for each data center: ``hottest_steps``, the number of steps in which the
hottest inlet of each rack was that of the hall, up to ``TIE_K``, and ``inlet_max_c``, the highest
inlet of each rack over the run, in C.
"""
AIR_KEY = b"sdc_taichi_air"
"""Key of the file's metadata under which the air before the racks is told, as JSON: a list with
what ``hottest_air.air_values`` says of each data center in its hottest step. Empty for runs of more
than ``MOST_AIR_RACKS`` racks."""
MOST_AIR_RACKS = 20_000
"""Most racks of a run whose air is kept."""
_ROWS_PER_GROUP = 1 << 16
_RACKS_AT_A_TIME = 1 << 14


class StepsWriter:
    """Writes one row per data center and step to a Parquet file, a row group at a time.

    Memory does not grow with the number of steps. The file appears under its name on ``commit``;
    without it, nothing is left behind.

    Args:
        path: the file.
        sim: the simulator whose steps are added.
        metadata: stored as JSON under ``METADATA_KEY`` in the file's metadata.

    Raises:
        SdcError: the file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path, sim: Simulator, metadata: Mapping[str, Any]) -> None:
        self._fleet, self._start = sim.fleet, sim.drivers.start
        self._metadata = {METADATA_KEY: json.dumps(metadata, allow_nan=False).encode()}
        self._steps_per_group = max(1, _ROWS_PER_GROUP // sim.size)
        self._names: tuple[str, ...] = ()
        self._values: F64 = np.empty((0, 0, 0))  # of the row group under way, (columns, steps, B)
        self._filled = 0
        self._first_step = 0
        self._writer: Any = None
        self._racks = _RackCounts(sim.fleet)
        self._air = HottestAir(sim) if sim.fleet.racks <= MOST_AIR_RACKS else None
        self._output = AtomicFile(path)

    def add(self, result: StepResult) -> None:
        """Add one step, the one after the step added before.

        Raises:
            SdcError: the file cannot be written.
        """
        if not self._names:
            self._names = tuple(result.per_dc())
            self._columns = operator.attrgetter(*self._names)
            shape = (len(self._names), self._steps_per_group, self._fleet.size)
            self._values = np.empty(shape)
        if self._filled == 0:
            self._first_step = result.step
        self._values[:, self._filled] = self._columns(result)
        self._racks.add(result)
        if self._air is not None:
            self._air.add(result)
        self._filled += 1
        if self._filled == self._steps_per_group:
            self._write_row_group()

    def commit(self) -> None:
        """Finish the file and give it its name.

        Raises:
            SdcError: the file cannot be written.
        """
        self._write_row_group()
        found = {RACKS_KEY: self._racks.per_dc(), AIR_KEY: self._air_per_dc()}
        texts = {key: json.dumps(value, allow_nan=False) for key, value in found.items()}
        with naming_errors(self._output.path):
            self._writer.add_key_value_metadata({k: text.encode() for k, text in texts.items()})
            self._writer.close()
        self._output.commit()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._output.discard()

    def _air_per_dc(self) -> list[dict[str, Any]]:
        """What ``AIR_KEY`` says, of the steps added."""
        if self._air is None:
            return []
        found = map(self._air.of, range(self._fleet.size))
        return [air_values(each) for each in found if each is not None]

    def _write_row_group(self) -> None:
        """Write the steps added since the last row group, if there are any."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        if self._filled == 0:
            return
        count, size = self._filled, self._fleet.size
        steps = np.arange(self._first_step, self._first_step + count)
        times = step_times(self._start, steps, self._fleet.steps_per_hour)
        names = pa.array(self._fleet.names)
        dc = pa.array(np.tile(np.arange(size, dtype=np.int32), count))
        columns: dict[str, Any] = {
            "dc": pa.DictionaryArray.from_arrays(dc, names),
            "step": np.repeat(steps, size),
            "time": times.reshape(-1),
        }
        for name, values in zip(self._names, self._values, strict=True):
            columns[name] = values[:count].reshape(-1)
        group = pa.table(columns).replace_schema_metadata(self._metadata)
        with naming_errors(self._output.path):
            if self._writer is None:
                self._writer = pq.ParquetWriter(
                    self._output.file, group.schema, compression="zstd", use_dictionary=["dc"]
                )
            self._writer.write_table(group)
        self._filled = 0


class _RackCounts:
    """How long each rack of a fleet had the hottest inlet of its hall, and its highest inlet.

    Steps are counted several at a time, because each operation on a few racks takes as long as
    it takes on a thousand.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._first, self._rack_dc = fleet.rack_offsets, fleet.rack_dc
        rows = max(1, _RACKS_AT_A_TIME // fleet.racks)
        self._inlet_c = np.empty((rows, fleet.racks))
        self._hottest_c = np.empty((rows, fleet.size))
        self._filled = 0
        self._steps = np.zeros(fleet.racks, dtype=np.int64)
        self._highest_c = np.full(fleet.racks, -np.inf)

    def add(self, result: StepResult) -> None:
        """Add a step."""
        self._inlet_c[self._filled] = result.rack_inlet_max_c
        self._hottest_c[self._filled] = result.inlet_max_c
        self._filled += 1
        if self._filled == len(self._inlet_c):
            self._count()

    def per_dc(self) -> list[dict[str, list[float]]]:
        """What ``RACKS_KEY`` says, of the steps added."""
        self._count()
        ends = self._first[1:-1]
        parts = np.split(self._steps, ends), np.split(self._highest_c.round(3), ends)
        return [
            {"hottest_steps": steps.tolist(), "inlet_max_c": highest_c.tolist()}
            for steps, highest_c in zip(*parts, strict=True)
        ]

    def _count(self) -> None:
        """Count the steps that were added since the last time."""
        inlet_c = self._inlet_c[: self._filled]
        limit_c = self._hottest_c[: self._filled] - TIE_K
        self._steps += np.count_nonzero(inlet_c >= limit_c[:, self._rack_dc], axis=0)
        self._highest_c = np.maximum(self._highest_c, inlet_c.max(axis=0, initial=-np.inf))
        self._filled = 0
