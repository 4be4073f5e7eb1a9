"""Bounds of data centers with given ends, by which it is told what ending elsewhere is worth."""

from __future__ import annotations

from collections.abc import Sequence

from sdc_taichi.optimum.linear_programme import bound
from sdc_taichi.optimum.problem import Ends, Problem
from sdc_taichi.optimum.task import Task


class BoundOfEnds:
    """Bounds of data centers with given ends, computed when they are first asked for.

    Args:
        task: What was solved.
        kinds: What the bound of each data center is, B.
    """

    def __init__(self, task: Task, kinds: Sequence[str]) -> None:
        self._task, self._kinds = task, kinds
        self._problem: tuple[int, Problem] | None = None
        self._known: dict[tuple[int, Ends], float] = {}

    def __call__(self, dc: int, ends: Ends) -> float:
        """Bound of a data center, by its number, with given ends; nan where there is none."""
        if self._kinds[dc].startswith("none"):
            return float("nan")
        if (dc, ends) not in self._known:
            self._known[dc, ends] = bound(self._problem_of(dc), ends).figure
        return self._known[dc, ends]

    def _problem_of(self, dc: int) -> Problem:
        """Planning problem of a data center; that of the last call is kept."""
        if self._problem is None or self._problem[0] != dc:
            part = self._task.part([dc])
            self._problem = dc, part.problems(part.tables())[0]
        return self._problem[1]
