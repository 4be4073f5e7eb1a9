"""File steps.parquet of a run folder: quantities by step; metadata on racks and hottest air."""

from __future__ import annotations

import json
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np

from sdc_taichi.hall.air_metrics import LEAST_EXCESS_K, RECOMMENDED_C, TIE_K, rank
from sdc_taichi.run.parquet_table import ParquetTable, key_columns
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.inlet_parts import RACK_FIELDS, UNIT_FIELDS, IntakeAir, intake_air_of
from sdc_taichi.sim.simulator import Simulator
from sdc_taichi.types import F64, I64, StepResult, fields_of

STEPS_FILE = "steps.parquet"
"""Name of the steps file in a run folder."""
KEY_COLUMNS = ("dc", "step", "time", "utc_offset_h")
"""Columns that identify a row; all others are quantities."""
METADATA_KEY = b"sdc_taichi"
"""Metadata key of the description of the run, as JSON."""
RACKS_KEY = b"sdc_taichi_racks"
"""Metadata key of rack statistics, as JSON.

The value is a list with one object per data center, whose lists have an entry for each rack.
``hottest_steps`` is the number of steps in which the rack had the hottest inlet of its hall, within
``TIE_K``; ``inlet_max_c`` is the highest inlet temperature of the rack over the run, in C;
``above_27_steps`` is the number of steps in which its hottest inlet was above ``RECOMMENDED_C``.
Data centers with cold plates also have ``junction_c``, the junction temperature of each rack in the
step of the hottest junction, in C, 0 for racks without cold plates.
"""
AIR_KEY = b"sdc_taichi_air"
"""Metadata key of the air before the racks, as JSON.

The value is a list with the ``air_values`` of each data center in its hottest step. It is empty for
runs of more than ``MOST_AIR_RACKS`` racks."""
MOST_AIR_RACKS = 20_000
"""Maximum number of racks of a run whose air is stored."""
_DECIMALS = 8
"""Decimals of stored air, so that inlets that follow from shares and temperatures are exact to a
millionth of a kelvin."""
_MOST = 1e9
"""Limit of the absolute value of stored air; larger values are rejected as damaged."""
_ROWS_PER_GROUP = 1 << 16
_RACKS_AT_A_TIME = 1 << 14


class StepsWriter:
    """Writes one row per data center and step to a Parquet file, a row group at a time.

    Memory does not grow with the number of steps. ``commit`` gives the file its name; without
    ``commit``, no file remains.

    Args:
        path: Path of the file.
        sim: Simulator whose steps are added.
        metadata: Description of the run, stored as JSON under ``METADATA_KEY``.

    Raises:
        SdcError: The file cannot be written, or another process is writing it.
    """

    def __init__(self, path: Path, sim: Simulator, metadata: Mapping[str, Any]) -> None:
        self._fleet, self._drivers = sim.fleet, sim.drivers
        self._steps_per_group = max(1, _ROWS_PER_GROUP // sim.size)
        self._names: tuple[str, ...] = ()
        self._values: F64 = np.empty((0, 0, 0))  # Current row group, (columns, steps, B).
        self._filled = 0
        self._first_step = 0
        self._racks = _RackCounts(sim.fleet)
        self._junctions = _HottestJunctions(sim.fleet)
        self._air = HottestAir(sim) if sim.fleet.racks <= MOST_AIR_RACKS else None
        self._table = ParquetTable(
            path,
            {METADATA_KEY: json.dumps(metadata, allow_nan=False).encode()},
            compression="zstd",
            use_dictionary=["dc", "utc_offset_h"],
        )

    def add(self, result: StepResult) -> None:
        """Add a step; steps must be added in order.

        Raises:
            SdcError: The file cannot be written.
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
        self._junctions.add(result)
        if self._air is not None:
            self._air.add(result)
        self._filled += 1
        if self._filled == self._steps_per_group:
            self._write_row_group()

    def commit(self) -> None:
        """Complete the file and give it its name.

        Raises:
            SdcError: The file cannot be written.
        """
        self._write_row_group()
        pairs = zip(self._racks.per_dc(), self._junctions.per_dc(), strict=True)
        racks = [counts | junctions for counts, junctions in pairs]
        tables = {RACKS_KEY: racks, AIR_KEY: self._air_per_dc()}
        texts = {key: json.dumps(value, allow_nan=False) for key, value in tables.items()}
        self._table.commit({key: text.encode() for key, text in texts.items()})

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._table.discard()

    def _air_per_dc(self) -> list[dict[str, Any]]:
        """Return the value for ``AIR_KEY`` from the added steps."""
        if self._air is None:
            return []
        of_dcs = map(self._air.of, range(self._fleet.size))
        return [air_values(each) for each in of_dcs if each is not None]

    def _write_row_group(self) -> None:
        """Write the steps since the last row group, if any, as a new row group."""
        if self._filled == 0:
            return
        steps = np.arange(self._first_step, self._first_step + self._filled)
        columns = key_columns(self._fleet, self._drivers, steps, np.arange(self._fleet.size))
        for name, values in zip(self._names, self._values, strict=True):
            columns[name] = values[: self._filled].reshape(-1)
        self._table.write(columns)
        self._filled = 0


class _RackCounts:
    """Counts steps with a hot inlet for each rack, and tracks the highest inlet of the rack.

    Several steps are processed at a time, because the cost of a NumPy call on a few racks is mostly
    overhead.
    """

    def __init__(self, fleet: Fleet) -> None:
        self._first, self._rack_dc = fleet.rack_offsets, fleet.rack_dc
        rows = max(1, _RACKS_AT_A_TIME // fleet.racks)
        self._inlet_c = np.empty((rows, fleet.racks))
        self._hottest_c = np.empty((rows, fleet.size))
        self._filled = 0
        self._steps = np.zeros(fleet.racks, dtype=np.int64)
        self._above_steps = np.zeros(fleet.racks, dtype=np.int64)
        self._highest_c = np.full(fleet.racks, -np.inf)

    def add(self, result: StepResult) -> None:
        """Add the inlet temperatures of a step."""
        self._inlet_c[self._filled] = result.rack_inlet_max_c
        self._hottest_c[self._filled] = result.inlet_max_c
        self._filled += 1
        if self._filled == len(self._inlet_c):
            self._count()

    def per_dc(self) -> list[dict[str, list[float]]]:
        """Return the value for ``RACKS_KEY`` from the added steps."""
        self._count()
        values = {
            "hottest_steps": self._steps,
            "inlet_max_c": self._highest_c.round(3),
            "above_27_steps": self._above_steps,
        }
        parts = [np.split(of_racks, self._first[1:-1]) for of_racks in values.values()]
        return [
            {name: part.tolist() for name, part in zip(values, of_dc, strict=True)}
            for of_dc in zip(*parts, strict=True)
        ]

    def _count(self) -> None:
        """Process the steps that were added since the last call."""
        inlet_c = self._inlet_c[: self._filled]
        limit_c = self._hottest_c[: self._filled] - TIE_K
        self._steps += np.count_nonzero(inlet_c >= limit_c[:, self._rack_dc], axis=0)
        too_warm = inlet_c > RECOMMENDED_C[1] + LEAST_EXCESS_K
        self._above_steps += np.count_nonzero(too_warm, axis=0)
        self._highest_c = np.maximum(self._highest_c, inlet_c.max(axis=0, initial=-np.inf))
        self._filled = 0


class _HottestJunctions:
    """Records the junctions of each data center in the step of its hottest junction."""

    def __init__(self, fleet: Fleet) -> None:
        self._racks = [slice(*pair) for pair in pairwise(fleet.rack_offsets.tolist())]
        self._hottest_c = {
            dc: -np.inf for dc, config in enumerate(fleet.configs) if config.plate_racks()
        }
        self._junction_c: dict[int, list[float]] = {}

    def add(self, result: StepResult) -> None:
        """Add the junction temperatures of a step."""
        for dc, hottest_c in self._hottest_c.items():
            if result.junction_max_c[dc] > hottest_c:
                self._hottest_c[dc] = float(result.junction_max_c[dc])
                junction_c = result.rack_junction_c[self._racks[dc]]
                self._junction_c[dc] = np.asarray(junction_c, np.float64).round(3).tolist()

    def per_dc(self) -> list[dict[str, list[float]]]:
        """Return the part of the value for ``RACKS_KEY`` of each data center."""
        return [
            {"junction_c": self._junction_c[dc]} if dc in self._junction_c else {}
            for dc in range(len(self._racks))
        ]


@dataclass(frozen=True, slots=True)
class AirAtStep:
    """Air before the racks of one data center in one step."""

    step: int
    """Index of the step, counted from 0 at reset."""
    air: IntakeAir
    """Air before the racks of the data center."""


class HottestAir:
    """Records the air of each data center in its hottest step, the first of several equal ones."""

    def __init__(self, sim: Simulator) -> None:
        self._sim = sim
        self._rank = np.full(sim.size, -np.inf)
        self._step: I64 = np.full(sim.size, -1, dtype=np.int64)
        self._air: IntakeAir | None = None

    def add(self, result: StepResult) -> None:
        """Process the last step of the simulator."""
        ranks = rank(result.inlet_max_c)
        hotter = ranks > self._rank
        if not hotter.any():
            return
        self._rank[hotter] = ranks[hotter]
        self._step[hotter] = result.step
        current = self._sim.intake_air()
        if self._air is None or hotter.all():
            self._air = current
            return
        fleet = self._sim.fleet
        for names, of in ((RACK_FIELDS, fleet.rack_dc), (UNIT_FIELDS, fleet.unit_dc)):
            for name in names:
                np.copyto(getattr(self._air, name), getattr(current, name), where=hotter[of])

    def of(self, dc: int) -> AirAtStep | None:
        """Return the air of a data center in its hottest step; None before the first step."""
        if self._air is None:
            return None
        return AirAtStep(int(self._step[dc]), intake_air_of(self._sim.fleet, self._air, dc))


def air_values(hottest: AirAtStep) -> dict[str, Any]:
    """Convert air to plain values for JSON: ``step``, and for each field a list by rack or unit."""
    lists = {
        name: values.round(_DECIMALS).tolist() for name, values in fields_of(hottest.air).items()
    }
    return {"step": hottest.step, **lists}


def air_from_values(values: dict[str, Any], *, racks: int, units: int, steps: int) -> AirAtStep:
    """Convert plain values of ``air_values`` back to air.

    Raises:
        ValueError: A value is missing or out of range, or a list has a wrong length.
    """
    step = values.get("step")
    if not isinstance(step, int) or not 0 <= step < steps:
        raise ValueError(f"step {step!r}; valid is 0..{steps - 1}")
    arrays = {}
    for names, count in ((RACK_FIELDS, racks), (UNIT_FIELDS, units)):
        for name in names:
            try:
                array = np.array(values.get(name), dtype=np.float64)
            except (TypeError, ValueError):
                array = np.empty(0)
            if array.shape != (count,) or not np.all(np.abs(array) < _MOST):
                raise ValueError(f"{name}; valid is a list of {count} numbers")
            arrays[name] = array
    return AirAtStep(step, IntakeAir(**arrays))
