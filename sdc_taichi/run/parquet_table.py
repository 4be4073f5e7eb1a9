"""Parquet tables of a run folder, written a row group at a time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sdc_taichi.atomic_file import AtomicFile, naming_errors
from sdc_taichi.run.time_column import time_column
from sdc_taichi.sim.drivers import Drivers
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import I32, I64


class ParquetTable:
    """Parquet file that is written a row group at a time, and gets its name on ``commit``.

    Args:
        path: Path of the file.
        metadata: Metadata of the table, by key.
        options: Arguments of ``pyarrow.parquet.ParquetWriter`` besides file and schema.

    Raises:
        SdcError: The file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path, metadata: Mapping[bytes, bytes], **options: Any) -> None:
        self.path = path
        self._metadata, self._options = dict(metadata), options
        self._writer: Any = None
        self._output = AtomicFile(path)

    def write(self, columns: Mapping[str, Any]) -> None:
        """Write columns of equal length as a row group.

        Raises:
            SdcError: The file cannot be written.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        group = pa.table(dict(columns)).replace_schema_metadata(self._metadata)
        with naming_errors(self.path):
            if self._writer is None:
                self._writer = pq.ParquetWriter(self._output.file, group.schema, **self._options)
            self._writer.write_table(group)

    def commit(self, further_metadata: Mapping[bytes, bytes] | None = None) -> None:
        """Complete the file and give it its name; at least one row group must have been written.

        Raises:
            SdcError: The file cannot be written.
        """
        with naming_errors(self.path):
            if further_metadata:
                self._writer.add_key_value_metadata(further_metadata)
            self._writer.close()
        self._output.commit()

    def discard(self) -> None:
        """Delete what has been written; this has no effect after ``commit``."""
        self._output.discard()


def key_columns(fleet: Fleet, drivers: Drivers, steps: I64, dcs: I32 | I64) -> dict[str, Any]:
    """Return data center, step, time and UTC offset of the rows of a table.

    The rows are in the order of steps, with K rows for each step.

    Args:
        fleet: B data centers.
        drivers: Their inputs.
        steps: Steps, counted from 0 at reset, (n,).
        dcs: Data center of each of the K rows of a step, (K,).

    Returns:
        Columns ``dc``, ``step``, ``time`` and ``utc_offset_h``, (n * K,) each.
    """
    import pyarrow as pa

    count = len(steps)
    times = time_column(drivers, steps, fleet.steps_per_hour)
    of_row = (np.arange(count)[:, None] * fleet.size + dcs).reshape(-1)
    return {
        "dc": pa.DictionaryArray.from_arrays(
            pa.array(np.tile(dcs.astype(np.int32), count)), pa.array(fleet.names)
        ),
        "step": np.repeat(steps, len(dcs)),
        "time": times.take(pa.array(of_row)),
        "utc_offset_h": np.tile(drivers.utc_offset_h[dcs], count),
    }
