"""Inlet, outlet and power of all racks of a hall over a run, in a bounded amount of memory.

Which racks are the hottest is known only at the end of a run. Until then the values of all racks
are kept as 16-bit numbers; a long run of a large hall is thinned out, by the highest values of two,
four, eight, ... steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.types import F32, F64, I64, Reals, StepResult

MAX_BYTES = 64_000_000
"""Memory of the kept values of a hall, in bytes."""
LEAST_STEPS = 64
"""Smallest number of times that are kept, however large the hall."""
LOWEST_C, PER_K = -50.0, 128.0
"""Temperature of the number 0, in C, and numbers per K."""
_MAX_NUMBER = 65_535
_UNREDUCED_BYTES = 4_000_000
"""Size of buffered step results, in bytes, at which they are converted."""


class RackValues(NamedTuple):
    """Values of some racks of a hall at T times, (T, racks) each."""

    steps: I64
    """First step of each time, counted from 0 at reset, (T,)."""
    inlet_c: F64
    """Hottest server inlet, in C."""
    outlet_c: F64
    """Mean outlet, in C."""
    power_kw: F64
    """Power of servers and their fans, in kW."""


class RackHistory:
    """Collects the values of the R racks of a data center, step by step."""

    def __init__(self, fleet: Fleet, dc: int) -> None:
        first, last = fleet.rack_offsets[dc : dc + 2].tolist()
        self._racks = slice(first, last)
        nameplate_w = np.concatenate([count * full_w for count, full_w, *_ in fleet.group_rows])
        largest_kw = float(fleet.group_sums(nameplate_w)[self._racks].max()) * 2e-3
        self._per_kw = _MAX_NUMBER / largest_kw
        self._capacity = max(LEAST_STEPS, MAX_BYTES // (6 * (last - first)) // 2 * 2)
        self._stride = 1
        self._peak = np.zeros(last - first, np.uint16)
        """Number of the highest inlet of each rack, (R,)."""
        self._unreduced: list[tuple[int, tuple[npt.NDArray[np.floating], ...]]] = []
        self._unreduced_bytes = 0
        self._steps: list[int] = []
        self._numbers: list[npt.NDArray[np.uint16]] = []
        self._pending: list[npt.NDArray[np.uint16]] = []

    def add(self, result: StepResult) -> None:
        """Add a step."""
        fields = result.rack_inlet_max_c, result.rack_outlet_c, result.rack_cpu_w, result.rack_fan_w
        self._unreduced.append((result.step, fields))
        self._unreduced_bytes += 4 * fields[0].nbytes
        if self._unreduced_bytes >= _UNREDUCED_BYTES:
            self._reduce()

    def peak_inlet_c(self) -> F64:
        """Return the highest inlet of each rack over the run, in C, (R,)."""
        self._reduce()
        return np.asarray(self._peak / PER_K + LOWEST_C, np.float64)

    def at(self, step: int) -> RackValues | None:
        """Return the values of all racks at a step, or the highest of the steps kept with it.

        Returns:
            Values at one time, (1, R) each; None if the step is not in the history.
        """
        self._reduce()
        if not self._steps or not self._steps[0] <= step <= self._steps[-1]:
            return None
        index = (step - self._steps[0]) // self._stride
        frames = self._numbers[index : index + 1] or self._pending
        inlet_c, outlet_c, power = np.maximum.reduce(frames)[:, None]
        return RackValues(
            np.array([step]),
            inlet_c / PER_K + LOWEST_C,
            outlet_c / PER_K + LOWEST_C,
            power / self._per_kw,
        )

    def inlet_c(self, step: int) -> F64 | None:
        """Return the inlets of all racks at a step, in C, (R,); None if the history lacks it."""
        values = self.at(step)
        return None if values is None else values.inlet_c[0]

    def of_racks(self, racks: I64) -> RackValues:
        """Return the values of racks of the hall at all times."""
        self._reduce()
        rest = [np.maximum.reduce(self._pending)] if self._pending else []
        numbers = np.stack([frame[:, racks] for frame in [*self._numbers, *rest]], axis=1)
        inlet_c, outlet_c = numbers[:2] / PER_K + LOWEST_C
        steps = self._steps[:: self._stride] if self._stride > 1 else self._steps
        return RackValues(np.array(steps), inlet_c, outlet_c, numbers[2] / self._per_kw)

    def _reduce(self) -> None:
        """Convert the buffered results, and thin out what is kept if there is too much of it."""
        buffered, self._unreduced, self._unreduced_bytes = self._unreduced, [], 0
        if not buffered:
            return
        inlet_c, outlet_c, cpu_w, fan_w = (
            np.stack([fields[i][self._racks] for _, fields in buffered]).astype(np.float32)
            for i in range(4)
        )
        numbers = np.stack(
            [_numbers(inlet_c, LOWEST_C, PER_K), _numbers(outlet_c, LOWEST_C, PER_K),
             _numbers(cpu_w + fan_w, 0.0, self._per_kw * 1e-3)],
            axis=1,
        )  # fmt: skip
        self._peak = np.maximum(self._peak, numbers[:, 0].max(axis=0))
        for (step, _), frame in zip(buffered, numbers, strict=True):
            self._steps.append(step)
            self._keep(frame)

    def _keep(self, frame: npt.NDArray[np.uint16]) -> None:
        """Keep the numbers of a step, (3, R)."""
        self._pending.append(frame)
        if len(self._pending) < self._stride:
            return
        self._numbers.append(np.maximum.reduce(self._pending) if self._stride > 1 else frame)
        self._pending = []
        if len(self._numbers) >= self._capacity:
            pairs = zip(self._numbers[::2], self._numbers[1::2], strict=True)
            self._numbers = [np.maximum(a, b) for a, b in pairs]
            self._stride *= 2


def _numbers(values: F32, lowest: float, per_unit: float) -> npt.NDArray[np.uint16]:
    """Return values as 16-bit numbers."""
    numbers = (values - np.float32(lowest)) * np.float32(per_unit) + np.float32(0.5)
    return np.asarray(np.clip(numbers, 0, _MAX_NUMBER).astype(np.uint16))


def thinned(values: Reals, most: int) -> tuple[Reals, int]:
    """Return the highest values of runs of equal length of T times, at most ``most`` of them.

    Args:
        values: values at T times, (T, ...).
        most: largest number of runs.

    Returns:
        The highest values, and the number of times in a run.
    """
    length = -(-len(values) // most)
    return np.maximum.reduceat(values, np.arange(0, len(values), length), axis=0), length
