"""Calls of the kernels of ``kernels/planning.py``, some data centers at a time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sdc_taichi.kernels.arguments import Argument
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.types import F64, I64

MOST_AT_ONCE = 256
"""Data centers of a call, which limits the memory of its work space."""


def first_commands() -> F64:
    """Candidates of the step to come, (C,), the mildest first: of equal ones the first counts."""
    steps = np.concatenate([[0.01, 0.02, 0.04, 0.06, 0.08], np.arange(1, 11) / 10.0])
    return np.concatenate([[0.0], np.stack([-steps, steps], axis=1).ravel()])


class PlanningKernel:
    """One of the two kernels with its work space.

    Args:
        kernel: the kernel.
        arguments: spec of its arguments.
        levels: levels of what is carried from step to step.
    """

    def __init__(self, kernel: Any, arguments: Mapping[str, Argument], levels: int) -> None:
        from sdc_taichi.kernels.compiler.named_kernel import NamedKernel

        self._threads = runtime.ensure_started()
        self._kernel = NamedKernel(kernel, arguments)
        self._kernel.bind(serial=False, levels=levels)
        self._arguments, self._levels = arguments, levels

    def run(
        self,
        size: int,
        horizon: int,
        *,
        commands: F64,
        peaks: int,
        table: F64 | None = None,
        facility_kwh: F64 | None = None,
        **of_each: F64,
    ) -> tuple[I64, F64]:
        """Run the kernel for all data centers.

        Args:
            size: number of data centers, B.
            horizon: number of coming steps, H.
            commands: commands of steps after the first.
            peaks: peaks of the month that are tried.
            table: the kernel's argument of this name, if it has one.
            facility_kwh: energy of the facility in each step, (B, H); None has it computed.
            of_each: other arguments by name, with the data centers first.

        Returns:
            Number of the command of the first step that is best, (B,), and ``facility_kwh``.
        """
        chosen = np.zeros(size, dtype=np.int32)
        kwh = np.zeros((size, horizon)) if facility_kwh is None else facility_kwh
        given: dict[str, Any] = of_each | {"chosen": chosen, "facility_kwh": kwh}
        whole = {"commands": commands, "peaks": peaks, "horizon": horizon}
        if table is not None:
            whole["table"] = table
        for first in range(0, size, MOST_AT_ONCE):
            part = slice(first, min(first + MOST_AT_ONCE, size))
            count = part.stop - first
            mine = {name: np.ascontiguousarray(values[part]) for name, values in given.items()}
            flat = {n: v.reshape(-1) for n, v in mine.items() if self._arguments[n].of}
            self._kernel(
                size=count,
                slices=min(count, 4 * self._threads),
                **whole,
                **(mine | flat),
                **self._work_space(count, horizon, table),
            )
        return chosen.astype(np.int64), kwh

    def _work_space(self, count: int, horizon: int, table: F64 | None) -> dict[str, Any]:
        space: dict[str, Any] = {"cost": np.empty((count, 2, self._levels))}
        if table is not None:
            space["policy"] = np.empty((count, horizon, self._levels), dtype=np.int32)
            space["kwh"] = np.empty((count, table.shape[-1]))
        return space
