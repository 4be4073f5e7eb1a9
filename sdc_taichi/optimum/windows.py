"""Bounds and plans over many weeks, window by window.

A bound over all steps is at least the sum of bounds over windows of steps, each with any state at
its borders, of

    cost of the steps - sum over borders of price * (state that the window leaves or starts from)

for any prices: in the whole, what the windows on both sides add at a border cancels (Lagrangian
relaxation; A. M. Geoffrion, "Lagrangean relaxation for integer programming", Mathematical
Programming Study 2 (1974)). The better the prices, the less is lost; here they are the dual prices
of programmes that span the borders, without demand charges.

Where the last step has to keep the state of an earlier one, a price that is 0 or more of what it
leaves beyond that takes the place of the condition. Work that crosses a border loses its age, which
only helps. A month in several windows is charged in each for its highest power there, with the
window's share of the month as weight: the highest power of the month is at least this mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from sdc_taichi.optimum.dispatch import Dispatch, Span
from sdc_taichi.optimum.problem import Problem
from sdc_taichi.optimum.stage_cost import StageCost
from sdc_taichi.types import I64

_BY_STEP = (
    "executed_tasks",
    "waiting_tasks",
    "deferred_tasks",
    "charge_kwh",
    "discharge_kwh",
    "stored_kwh",
    "task_price",
    "kwh_price",
)
"""Fields of ``Dispatch`` with a value for each step."""
Solve = Callable[[Problem, StageCost, Span], Dispatch]
"""The best dispatch found of some steps of a problem."""


def window_ends(problem: Problem, first: int, longest: int) -> list[int]:
    """First steps after each window of a problem's steps.

    Windows are about equal in length, and end where a month with a demand charge does.

    Args:
        problem: What is to be planned.
        first: First step of the first window.
        longest: Most steps of a window between the ends of months.
    """
    months = sorted({m.end for m in problem.months if first < m.end < problem.steps})
    ends: list[int] = []
    for begin, end in zip([first, *months], [*months, problem.steps], strict=True):
        count = -(-(end - begin) // longest)
        ends += [begin + (end - begin) * (k + 1) // count for k in range(count)]
    return ends


def bound_in_windows(
    problem: Problem, stage: StageCost, span: Span, ends: list[int], around: int, solve: Solve
) -> Dispatch:
    """Bound of a span by windows, as if it were one dispatch.

    Args:
        problem: What is to be planned.
        stage: The least cost of its steps.
        span: The steps.
        ends: First steps after each window; the last is the end of the span.
        around: Steps on both sides of a border of the programmes that give its prices.
        solve: solves the programme of a span.
    """
    prices = {
        end - 1: _border_prices(problem, stage, span, (end - 1, end - 1), around, solve)
        for end in ends[:-1]
    }
    kept: dict[int, tuple[float, float]] = {}
    task = kwh = 0.0
    if span.as_after is not None:
        pair = (span.end - 1, span.as_after)
        task, kwh = _border_prices(problem, stage, span, pair, around, solve)
        task, kwh = max(task, 0.0), max(kwh, 0.0)
        kept = {span.end - 1: (task, kwh), span.as_after: (-task, -kwh)}
    parts = []
    for begin, end in zip([span.first, *ends[:-1]], ends, strict=True):
        inside = replace(
            span,
            first=begin,
            end=end,
            as_after=None,
            state_values=_state_values(prices, kept, begin, end),
        )
        if begin > span.first:
            inside = replace(inside, start_kwh=None, start_tasks=None, deferred_before=None)
        if end < span.end:
            inside = replace(inside, end_kwh=None, end_tasks=None)
        parts.append(solve(_with_part_of_months(problem, begin, end), stage, inside))
    return replace(_joined(parts), end_task_price=task, end_kwh_price=kwh)


def plan_in_windows(
    problem: Problem, stage: StageCost, span: Span, ends: list[int], ahead: int, solve: Solve
) -> Dispatch:
    """Plan of a span by windows that each start from the state that the last has left.

    Args:
        problem: What is to be planned.
        stage: The least cost of its steps.
        span: The steps; ``deferred_before`` is known.
        ends: First steps after each window; the last is the end of the span.
        ahead: Steps after a window that its programme looks ahead.
        solve: finds a plan of a span.
    """
    parts: list[Dispatch] = []
    state, first = span, span.first
    end_kwh, end_tasks = span.end_kwh, span.end_tasks
    for end in ends:
        until = min(end + ahead, span.end)
        last = until == span.end
        within = span.as_after is not None and first <= span.as_after
        found = solve(
            problem,
            stage,
            replace(
                state,
                first=first,
                end=until,
                end_kwh=end_kwh if last else None,
                end_tasks=end_tasks if last else None,
                as_after=span.as_after if last and within else None,
            ),
        )
        kept = _first_steps(found, end - first)
        parts.append(kept)
        if within and span.as_after is not None and span.as_after < end:
            at = span.as_after - first
            end_kwh, end_tasks = float(kept.stored_kwh[at]), float(kept.waiting_tasks[at])
        before = state.deferred_before
        state = replace(
            state,
            start_kwh=float(kept.stored_kwh[-1]),
            start_tasks=float(max(kept.waiting_tasks[-1], 0.0)),
            deferred_before=None
            if before is None
            else np.concatenate([before, kept.deferred_tasks])[-len(before) :],
        )
        first = end
    return _joined(parts)


def _border_prices(
    problem: Problem,
    stage: StageCost,
    span: Span,
    border: tuple[int, int],
    around: int,
    solve: Solve,
) -> tuple[float, float]:
    """What a task that waits at a border adds, and what a kWh stored takes off.

    Args:
        problem: What is to be planned.
        stage: The least cost of its steps.
        span: All steps.
        border: The step before the border and the one whose end is the border's other side, which
            for the end that keeps the state of an earlier step is this step.
        around: Steps on both sides of the border to take into account.
        solve: solves the programme of a span.
    """
    before, after = border
    left = np.arange(max(before + 1 - around, span.first), before + 1)
    right = np.arange(after + 1, min(after + 1 + around, span.end))
    steps = np.concatenate([left, right])
    part = Span(0, len(steps), start_kwh=span.start_kwh, start_tasks=span.start_tasks)
    found = solve(_taken(problem, steps), _taken_stage(stage, steps), part)
    return float(found.task_price[len(left) - 1]), float(found.kwh_price[len(left) - 1])


def _with_part_of_months(problem: Problem, begin: int, end: int) -> Problem:
    """A problem whose months weigh as much as the part of them between two steps."""
    months = []
    for month in problem.months:
        covered = max(min(month.end, end) - max(month.first, begin), 0)
        weight = month.weight_per_kw * covered / (month.end - month.first)
        months.append(replace(month, weight_per_kw=weight))
    return replace(problem, months=tuple(months))


def _state_values(
    prices: dict[int, tuple[float, float]],
    kept: dict[int, tuple[float, float]],
    begin: int,
    end: int,
) -> tuple[tuple[int, float, float], ...]:
    """Costs of states at the ends of steps of a window: step, of a task, of a kWh.

    Args:
        prices: Price of a task and value of a kWh at the end of the last step of each window.
        kept: The same of steps whose states are held against each other.
        begin: First step of the window.
        end: First step after it.
    """
    found = [(step, task, -kwh) for step, (task, kwh) in kept.items() if begin <= step < end]
    if end - 1 in prices:
        task, kwh = prices[end - 1]
        found.append((end - 1, task, -kwh))
    if begin - 1 in prices:
        task, kwh = prices[begin - 1]
        found.append((begin - 1, -task, kwh))
    return tuple(found)


def _taken(problem: Problem, steps: I64) -> Problem:
    """A problem of some steps of another, in the order given, without what lies outside."""
    work = problem.work
    return replace(
        problem,
        kwh_weight=problem.kwh_weight[steps],
        months=(),
        work=replace(
            work,
            arrived_tasks=work.arrived_tasks[steps],
            idle_tasks=work.idle_tasks[steps],
            most_deferred_tasks=work.most_deferred_tasks[steps],
            most_executed_tasks=work.most_executed_tasks[steps],
        ),
        idle_setpoint_c=problem.idle_setpoint_c[steps],
        scored_from=0,
    )


def _taken_stage(stage: StageCost, steps: I64) -> StageCost:
    """Least cost of some steps."""
    return replace(
        stage,
        **{
            f.name: getattr(stage, f.name)[steps]
            for f in fields(StageCost)
            if f.name != "executed_tasks"
        },
    )


def _first_steps(found: Dispatch, count: int) -> Dispatch:
    """The first steps of a dispatch."""
    return replace(found, **{name: getattr(found, name)[:count] for name in _BY_STEP})


def _joined(parts: list[Dispatch]) -> Dispatch:
    """Dispatches of windows end to end; the figure is the sum of theirs."""
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _BY_STEP
    }
    joined["figure"] = sum(part.figure for part in parts)
    joined["peaks_kw"] = tuple(np.max([part.peaks_kw for part in parts], axis=0).tolist())
    return replace(parts[-1], **joined)
