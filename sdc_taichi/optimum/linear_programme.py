"""The bound of a planning problem, and a plan that queue and battery can carry out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sdc_taichi.errors import ConfigError
from sdc_taichi.optimum.dispatch import DEFER, DRAIN, DUE, Dispatch, DispatchProgramme, Span
from sdc_taichi.optimum.problem import Ends, Problem
from sdc_taichi.optimum.programme import InfeasibleError
from sdc_taichi.optimum.stage_cost import (
    LoadCurves,
    StageCost,
    given_curves,
    load_curves,
    stage_cost,
    step_weights,
)
from sdc_taichi.optimum.windows import bound_in_windows, plan_in_windows, window_ends
from sdc_taichi.types import I64

_WARM_UP_SHARE = 1e-3
"""Weight of steps that are not scored, relative to the others: enough for a reasonable plan, and
so little that batteries are filled before the scored steps."""
_DEFERRAL_WEIGHT = 0.01
"""Weight of a task that enters the queue, relative to the median cost of a task: just enough that
work leaves the queue no earlier than it has to."""
_LONGEST_BOUND = 3072
"""Most steps of a bound's programme: a month of quarter hours. Time rises with their square."""
_LONGEST_PLAN = 672
"""Most steps of a plan's programme: a week of quarter hours."""
_AROUND = 480
"""Fewest steps on both sides of a border between windows from which its prices are computed."""
_AHEAD = 192
"""Fewest steps that the plan of a window looks ahead."""
_NEGLIGIBLE_TASKS = 1e-7
"""Amount of work below which a solver's result counts as zero, in tasks."""


def bound(
    problem: Problem, ends: Ends | None = None, *, check: Callable[[], None] = lambda: None
) -> Dispatch:
    """Find a figure of the scored steps below which no controller can come.

    Setpoints change freely, the cost of each step is the convex curve below its table, and queue
    and battery are those of ``dispatch``.

    Args:
        problem: What is to be planned.
        ends: State at the first scored step and at the end; the result then has scored steps
            alone. By default the state before the first step is that of the problem, and the end
            keeps at least the stored energy and at most the queue of the first scored step.
        check: Called before every window; an error that it raises ends the work.

    Returns:
        What reaches the bound, with prices of states; no queue may be able to do it.

    Raises:
        ConfigError: no plan keeps the limits.
    """
    stage = stage_cost(problem)
    curves = _curves(problem, stage)
    span = _span(problem, ends)

    def solve(part: Problem, cost: StageCost, of: Span) -> Dispatch:
        check()
        known = curves if cost is stage else _curves(part, cost)
        return _solve(part, DispatchProgramme(part, cost, known, of))

    if span.end - span.first <= _LONGEST_BOUND:
        return solve(problem, stage, span)
    borders = window_ends(problem, span.first, _LONGEST_BOUND)
    return bound_in_windows(problem, stage, span, borders, _ahead(problem, _AROUND), solve)


def plan(problem: Problem, *, check: Callable[[], None] = lambda: None) -> Dispatch:
    """Find a plan of low cost that a first-in-first-out queue and the battery can carry out.

    In each step of the plan work only enters the queue, or only leaves it, or exactly the due work
    leaves it. The first guess of these modes comes from the bound's linear programme, the second
    from the plan that results; the better plan is returned. Plans of many steps are made window by
    window, with the peaks of the bound where there is a demand charge.

    Args:
        problem: What is to be planned.
        check: Called before every window; an error that it raises ends the work.

    Raises:
        ConfigError: no plan keeps the limits.
    """
    stage = stage_cost(problem, warm_up_share=_WARM_UP_SHARE)
    curves = _curves(problem, stage)
    weighed = replace(problem, kwh_weight=step_weights(problem, _WARM_UP_SHARE)[0])
    span = _span(weighed, None)
    if problem.work.deadline_steps is not None:
        span = replace(span, deferred_before=np.zeros(problem.work.deadline_steps))

    def solve(part: Problem, cost: StageCost, of: Span) -> Dispatch:
        check()
        return _plan_of_span(part, cost, curves, of)

    in_one = "load" not in problem.agents or problem.work.deadline_steps is None
    # An end that keeps the state of an earlier step is planned better with it.
    in_one |= span.as_after is not None
    longest = _LONGEST_BOUND if in_one else _LONGEST_PLAN
    ahead = _ahead(problem, _AHEAD)
    if problem.steps <= longest + ahead:
        return solve(weighed, stage, span)
    if span.as_after is not None or problem.months:
        relaxed = bound(weighed, check=check)
        span = replace(span, least_peaks_kw=relaxed.peaks_kw)
        if span.as_after is not None:
            prices = (span.as_after, -relaxed.end_task_price, relaxed.end_kwh_price)
            span = replace(span, state_values=(prices,))
    borders = window_ends(problem, 0, longest)
    return plan_in_windows(weighed, stage, span, borders, ahead, solve)


def _curves(problem: Problem, stage: StageCost) -> LoadCurves:
    """Cost and energy by the work done, where load is planned, or at the work of idle commands."""
    return load_curves(problem, stage) if "load" in problem.agents else given_curves(problem, stage)


def _ahead(problem: Problem, least: int) -> int:
    """Steps over which the state at one step matters to another: those of two deadlines."""
    return max(least, 2 * (problem.work.deadline_steps or 0))


def _plan_of_span(problem: Problem, stage: StageCost, curves: LoadCurves, span: Span) -> Dispatch:
    """The best dispatch found of those that the queue can carry out."""

    def restricted(modes: I64) -> Dispatch | None:
        programme = DispatchProgramme(problem, stage, curves, span)
        programme.keep_modes(modes)
        try:
            return programme.solve()
        except InfeasibleError:
            return None

    relaxed = DispatchProgramme(problem, stage, curves, span)
    if "load" not in problem.agents or problem.work.deadline_steps is None:
        return _solve(problem, relaxed)
    steps = span.end - span.first
    of_task = float(np.median(np.abs(curves.slope_cost))) if len(curves.slope_cost) else 0.0
    late = 2.0 - np.arange(steps) / steps
    relaxed.add_deferral_weight(_DEFERRAL_WEIGHT * of_task * late)
    first = _solve(problem, relaxed)
    found = [
        restricted(_modes(problem, span, first)),
        restricted(_queue_modes(problem, span, first)),
    ]
    plans = [each for each in found if each is not None]
    if not plans:
        # Work that waits already may be due in a step that was to defer; draining always goes.
        drained = restricted(np.full(steps, DRAIN))
        plans = [first if drained is None else drained]
    best = min(plans, key=lambda each: each.figure)
    again = restricted(_modes(problem, span, best))
    return best if again is None or again.figure > best.figure else again


def _span(problem: Problem, ends: Ends | None) -> Span:
    """All steps of a problem with the ends that it asks for, or the scored ones with given ends."""
    if ends is not None:
        return Span(
            problem.scored_from,
            problem.steps,
            start_kwh=ends.start_kwh,
            start_tasks=ends.start_tasks,
            end_kwh=ends.end_kwh,
            end_tasks=ends.end_tasks,
        )
    stored = problem.storage.stored_kwh
    if problem.scored_from:
        return Span(
            0, problem.steps, start_kwh=stored, start_tasks=0.0, as_after=problem.scored_from - 1
        )
    return Span(0, problem.steps, start_kwh=stored, start_tasks=0.0, end_kwh=stored, end_tasks=0.0)


def _modes(problem: Problem, span: Span, found: Dispatch) -> I64:
    """I64 that allow about what a dispatch does in each step."""
    steps = problem.work.deadline_steps
    assert steps is not None
    entered, waiting = found.deferred_tasks, found.waiting_tasks
    start = span.start_tasks or 0.0
    left = entered - np.diff(waiting, prepend=start)
    before = np.zeros(steps) if span.deferred_before is None else span.deferred_before
    total = np.cumsum(np.concatenate([before, entered]))
    within = total[steps:] - total[:-steps]
    due = (within - waiting < _NEGLIGIBLE_TASKS) & (waiting > _NEGLIGIBLE_TASKS)
    modes = np.where(waiting > _NEGLIGIBLE_TASKS, DRAIN, DEFER)
    modes = np.where(left > entered + _NEGLIGIBLE_TASKS, DRAIN, modes)
    modes = np.where(entered > left + _NEGLIGIBLE_TASKS, DEFER, modes)
    return np.where(due & (entered > _NEGLIGIBLE_TASKS), DUE, modes)


def _queue_modes(problem: Problem, span: Span, found: Dispatch) -> I64:
    """I64 of a queue that is asked to do the work of a dispatch, as far as it can."""
    work, steps = problem.work, problem.work.deadline_steps
    assert steps is not None
    arrived = work.arrived_tasks[span.first : span.end]
    most = work.most_deferred_tasks[span.first : span.end]
    before = np.zeros(steps) if span.deferred_before is None else span.deferred_before
    entered = np.concatenate([before, np.zeros(len(arrived))])
    total_in = np.cumsum(entered)
    total_out = total_in[steps - 1] - (span.start_tasks or 0.0)
    modes = np.empty(len(arrived), np.int64)
    total = total_in[steps - 1]
    for t in range(len(arrived)):
        waiting = total - total_out
        due = max(total_in[t] - total_out, 0.0)
        change = found.executed_tasks[t] - arrived[t]
        out = min(max(due, change), waiting)
        into = min(max(out - change, 0.0), most[t])
        if into > _NEGLIGIBLE_TASKS:
            modes[t] = DUE if out > _NEGLIGIBLE_TASKS else DEFER
        else:
            modes[t] = DRAIN if waiting > _NEGLIGIBLE_TASKS else DEFER
        total, total_out = total + into, total_out + out
        total_in[t + steps] = total
    return modes


def _solve(problem: Problem, programme: DispatchProgramme) -> Dispatch:
    """Solve a programme.

    Raises:
        ConfigError: no plan keeps the limits.
    """
    try:
        return programme.solve()
    except InfeasibleError:
        raise ConfigError(
            f"optimum of {problem.name}: no plan does all work within its deadline and ends with "
            f"at least the stored energy and at most the queue that are asked for; valid are data "
            f"centers that can, see workload.max_utilisation and workload.deadline_h"
        ) from None
