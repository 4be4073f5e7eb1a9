"""What is known of the best that controllers can do with given data centers, inputs and steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from sdc_taichi.errors import SdcError
from sdc_taichi.optimum.objective import Objective
from sdc_taichi.optimum.problem import Agent, Ends
from sdc_taichi.types import F64, I64


class StoppedError(SdcError):
    """Solving was stopped before its end; the message says what is kept."""


@dataclass(frozen=True, slots=True)
class Optimum:
    """Bound and achieved figure of B data centers over T steps, and the commands that achieve it.

    Figures are in the unit of the objective, and less is better.
    """

    names: tuple[str, ...]
    """Names of the data centers."""
    fingerprint: str
    """Fingerprint of configs, inputs and precision (``Simulator.fingerprint``)."""
    objective: Objective
    """Objective that plans minimise."""
    agents: tuple[Agent, ...]
    """What the plans may move."""
    start: I64
    """First step of each data center, counted from the beginning of the year, (B,)."""
    seed: I64
    """Seed of the sampled events of each data center, (B,); 0 where none are sampled."""
    steps: int
    """Number of steps, T."""
    scored_from: int
    """First step that counts."""
    inlet_limit_c: F64
    """Highest inlet that plans may cause where they have a choice, in C, (B,); inf without."""
    idle: F64
    """Figure under idle commands, (B,)."""
    idle_dropped_tasks: F64
    """Work that finds the queue full under idle commands, in tasks, (B,)."""
    bound: F64
    """No controller that keeps the constraints and ends as it began comes below this figure, (B,);
    nan if none is known."""
    achieved: F64
    """Lowest figure that the simulator reached and that keeps the constraints, (B,)."""
    alone: Mapping[str, F64]
    """Lowest figure reached with one agent alone, by its name, (B,) each."""
    bound_kinds: tuple[str, ...]
    """What the bound of each data center is: ``bound``, or ``estimate`` or ``none``, and why."""
    failures: tuple[tuple[str, ...], ...]
    """Certificates of each data center that do not hold, in words."""
    certificates: tuple[Mapping[str, float], ...]
    """What was measured when the simulator ran the plan of each data center, by name."""
    load: F64
    """Load commands of the achieved path, (T, B)."""
    cooling: F64
    """Cooling commands of the achieved path, in steps of the setpoint, (T, B)."""
    battery: F64
    """Battery commands of the achieved path, (T, B)."""
    bound_of_ends: Callable[[int, Ends], float]
    """Bound of a data center, by its index, with given ends; nan where there is none."""

    @property
    def gap_points(self) -> F64:
        """Distance of the achieved figure from the bound, in % of the idle figure, (B,)."""
        return np.asarray(100.0 * (self.achieved - self.bound) / self.idle)

    def end_value(self, start_kwh: F64, start_tasks: F64, end_kwh: F64, end_tasks: F64) -> F64:
        """Least cost of ending as a controller did, beyond that of ending as it began.

        It is V(start, end) - V(start, start), where V is the bound with given ends.

        Args:
            start_kwh: Energy stored at the first scored step, in kWh, (B,).
            start_tasks: Work that waits at the first scored step, in tasks, (B,).
            end_kwh: Energy stored at the end, in kWh, (B,).
            end_tasks: Work that waits at the end, in tasks, (B,).

        Returns:
            The value in the unit of the objective, (B,); nan where there is no bound and ends
            differ.
        """
        value = np.zeros(len(self.names))
        for i in range(len(self.names)):
            kwh, tasks = start_kwh[i], start_tasks[i]
            if (end_kwh[i], end_tasks[i]) == (kwh, tasks):
                continue
            own, cyclic = Ends(kwh, tasks, end_kwh[i], end_tasks[i]), Ends(kwh, tasks, kwh, tasks)
            value[i] = self.bound_of_ends(i, own) - self.bound_of_ends(i, cyclic)
        return value
