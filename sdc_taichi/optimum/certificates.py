"""What the simulator measured along a path, and whether it keeps what a plan has to keep."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sdc_taichi.optimum.problem import Problem
from sdc_taichi.optimum.rollout import RollOut
from sdc_taichi.optimum.score import Score
from sdc_taichi.optimum.table_lookup import (
    INLET_MARGIN_K,
    at_utilisation,
    coolest_inlet_c,
    facility_kwh,
)
from sdc_taichi.types import F64

LARGEST_TABLE_ERROR = 1e-4
"""Largest error of a table, as a share of the energy, with which a bound still is one."""
LEAST_TASKS = 1e-6
"""Work that rounding may leave, in tasks."""
LEAST_K = 1e-3
"""Temperature by which the precision of the kernels may exceed a limit, in K."""
_LEAST_STORED_SHARE = 1e-6
"""Share of the capacity that may be missing from the battery at the end."""


@dataclass(frozen=True, slots=True)
class Certificate:
    """What the simulator measured in the scored steps along a path of one data center."""

    figure: float
    """Figure of the scored steps, in the unit of the objective."""
    table_error: float
    """Difference of the facility's energy in each step from the table at the utilisation and
    setpoint of the step, without its sign, summed over the steps and over their energy."""
    start_kwh: float
    """Energy stored at the first scored step, in kWh."""
    end_kwh: float
    """Energy stored at the end, in kWh."""
    start_tasks: float
    """Work that waits at the first scored step, in tasks."""
    end_tasks: float
    """Work that waits at the end, in tasks."""
    dropped_tasks: float
    """Work that finds the queue full, in tasks."""
    overdue_tasks: float
    """Most due work that does not fit into a step, in tasks."""
    hottest_inlet_c: float
    """Hottest inlet, in C."""
    over_limit_k: float
    """Most by which an inlet exceeds the limit, or the coolest of all setpoints where none keeps
    it, in K."""
    unmet_kwh: float
    """Cooling load that stays in the room, in kWh."""

    def failures(self, idle: Certificate, capacity_kwh: float) -> tuple[str, ...]:
        """What the path breaks, in words; nothing where it may count as achieved.

        Args:
            idle: Certificate of idle commands.
            capacity_kwh: Capacity of the battery, in kWh.
        """
        missing_kwh = self.start_kwh - self.end_kwh
        more_tasks = self.end_tasks - self.start_tasks
        dropped = self.dropped_tasks - idle.dropped_tasks
        texts = []
        if missing_kwh > _LEAST_STORED_SHARE * capacity_kwh:
            texts.append(f"ends with {missing_kwh:.4g} kWh less in the battery")
        if more_tasks > LEAST_TASKS:
            texts.append(f"ends with {more_tasks:.4g} tasks more in the queue")
        if dropped > LEAST_TASKS:
            texts.append(f"drops {dropped:.4g} tasks more than idle commands")
        if self.overdue_tasks > idle.overdue_tasks + LEAST_TASKS:
            texts.append(f"leaves up to {self.overdue_tasks:.4g} tasks overdue")
        if self.over_limit_k > LEAST_K:
            texts.append(f"has inlets up to {self.over_limit_k:.3g} K over the limit")
        if self.unmet_kwh > idle.unmet_kwh * (1.0 + 1e-6) + 1e-6:
            texts.append(f"leaves {self.unmet_kwh - idle.unmet_kwh:.4g} kWh of heat in the room")
        return tuple(texts)


def measured(score: Score, i: int) -> Certificate:
    """What the simulator measured of one path.

    ``table_error`` and ``over_limit_k`` are 0 until ``against_table`` has found them.

    Args:
        score: Of several paths.
        i: Number of the path.
    """
    return Certificate(
        figure=float(score.figure[i]),
        table_error=0.0,
        start_kwh=float(score.start_kwh[i]),
        end_kwh=float(score.end_kwh[i]),
        start_tasks=float(score.start_tasks[i]),
        end_tasks=float(score.end_tasks[i]),
        dropped_tasks=float(score.dropped_tasks[i]),
        overdue_tasks=float(score.most_overdue_tasks[i]),
        hottest_inlet_c=float(score.hottest_inlet_c[i]),
        over_limit_k=0.0,
        unmet_kwh=float(score.unmet_kwh[i]),
    )


def against_table(problem: Problem, done: RollOut, found: Certificate) -> Certificate:
    """A certificate with its differences from the table of the data center.

    Args:
        problem: Planning problem of the data center.
        done: What the simulator did, of one data center.
        found: What was measured of it.
    """
    scored = slice(problem.scored_from, None)
    facility = done.facility_kwh[scored, 0]
    expected = facility_kwh(problem.table, done.utilisation[:, 0], done.setpoint_c[:, 0])
    return replace(
        found,
        table_error=float(np.abs(expected[scored] - facility).sum() / facility.sum()),
        over_limit_k=float(_over_limit_k(problem, done)[scored].max()),
    )


def _over_limit_k(problem: Problem, done: RollOut) -> F64:
    """By how much the hottest inlet of each step exceeds what it has to keep, in K, (T,)."""
    table, limit_c = problem.table, problem.inlet_limit_c
    if np.isinf(limit_c):
        return np.zeros(problem.steps)
    inlet_c, unmet_w = (
        at_utilisation(values, table.utilisation, done.utilisation[:, 0])
        for values in (table.inlet_max_c, table.unmet_w)
    )
    coolest_c = coolest_inlet_c(inlet_c, unmet_w)[:, 0]
    within = coolest_c <= limit_c - INLET_MARGIN_K
    return np.asarray(
        done.inlet_max_c[:, 0] - np.where(within, limit_c, coolest_c + INLET_MARGIN_K)
    )
