"""Bound of a planning problem, and a plan that a real queue and a real battery can execute.

Runs of many weeks are divided into windows. In each window the states at both borders are free, and
the objective is

    cost of the steps + price * (state at the start) - price * (state at the end),

where the price is the value of a stored kWh, or the negative cost of a waiting task.
The sum of the windows' minima is a lower bound of the whole run for all prices, because the price
terms of both sides of a border cancel (Lagrangian relaxation; A. M. Geoffrion, "Lagrangean
relaxation for integer programming", Mathematical Programming Study 2 (1974)). Good prices make the
bound tight. The prices used here are dual prices of programmes that contain the border, without
demand charges.

If the end of the run must have the state of an earlier step, a price of at least 0 on the
difference of both states replaces this condition. Work that crosses a border loses its age, which
can only lower the bound. If a month extends to several windows, each window pays the demand charge
of its own highest power, weighted by the window's share of the month. The highest power of the
month is at least this weighted mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

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
from sdc_taichi.types import I64

_WARM_UP_SHARE = 1e-3
"""Weight of steps that are not scored, relative to scored steps. It is positive, so that their plan
is reasonable, and small, so that batteries are filled before the scored steps."""
_DEFERRAL_WEIGHT = 0.01
"""Weight of a task that enters the queue, relative to the median cost of a task. It breaks ties:
work leaves the queue no earlier than necessary."""
_LONGEST_BOUND = 3072
"""Maximum number of steps in the programme of a bound, about a month of quarter hours. The solution
time rises with the square of this number."""
_LONGEST_PLAN = 672
"""Maximum number of steps in the programme of a plan, a week of quarter hours."""
_AROUND = 480
"""Minimum number of steps on each side of a window border in the programme that gives its prices.
"""
_AHEAD = 192
"""Minimum number of steps after a window that the window's plan takes into account."""
_NEGLIGIBLE_TASKS = 1e-7
"""Amount of work below which a solver's result counts as zero, in tasks."""


def bound(
    problem: Problem, ends: Ends | None = None, *, check: Callable[[], None] = lambda: None
) -> Dispatch:
    """Compute a lower bound of the figure in the scored steps, valid for every controller.

    The bound relaxes the problem: setpoints change without a ramp limit, the cost of each step is a
    convex curve below its table, and queue and battery obey the rows of ``dispatch``.

    Args:
        problem: The planning problem.
        ends: States at the first scored step and at the end; the result then contains only the
            scored steps. None starts from the initial state of the problem. The end state must then
            have at least the stored energy and at most the queue of the first scored step.
        check: Called before every window; an error that it raises ends the work.

    Returns:
        The solution of the relaxed problem, with prices of states. A real queue may be unable to
        execute it.

    Raises:
        ConfigError: no plan satisfies the limits.
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
    borders = _window_ends(problem, span.first, _LONGEST_BOUND)
    return _bound_in_windows(problem, stage, span, borders, _ahead(problem, _AROUND), solve)


def plan(problem: Problem, *, check: Callable[[], None] = lambda: None) -> Dispatch:
    """Compute a plan of low cost that a first-in-first-out queue and the battery can execute.

    Each step of the plan has a mode: work only enters the queue, work only leaves it, or exactly
    the due work leaves it. The first modes come from the bound's linear programme, the second from
    the plan under the first modes; the better of both plans is returned. Long plans are computed
    window by window; with a demand charge, they start from the monthly peaks of the bound.

    Args:
        problem: The planning problem.
        check: Called before every window; an error that it raises ends the work.

    Raises:
        ConfigError: no plan satisfies the limits.
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
    # If the end must have the state of an earlier step, one programme should contain both steps.
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
    borders = _window_ends(problem, 0, longest)
    return _plan_in_windows(weighed, stage, span, borders, ahead, solve)


def _curves(problem: Problem, stage: StageCost) -> LoadCurves:
    """Return the curves of cost and energy by executed work.

    If the plan does not control load, the curves are single points at the work of idle commands.
    """
    return load_curves(problem, stage) if "load" in problem.agents else given_curves(problem, stage)


def _ahead(problem: Problem, least: int) -> int:
    """Return the number of steps for which a state has an influence: two deadlines or ``least``."""
    return max(least, 2 * (problem.work.deadline_steps or 0))


def _plan_of_span(problem: Problem, stage: StageCost, curves: LoadCurves, span: Span) -> Dispatch:
    """Return the cheapest of several dispatches that a first-in-first-out queue can execute."""

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
    by_modes = [
        restricted(_modes(problem, span, first)),
        restricted(_queue_modes(problem, span, first)),
    ]
    plans = [each for each in by_modes if each is not None]
    if not plans:
        # Initially waiting work may be due in a step of mode DEFER. Mode DRAIN is always feasible.
        drained = restricted(np.full(steps, DRAIN))
        plans = [first if drained is None else drained]
    best = min(plans, key=lambda each: each.figure)
    again = restricted(_modes(problem, span, best))
    return best if again is None or again.figure > best.figure else again


def _span(problem: Problem, ends: Ends | None) -> Span:
    """Return the range of all steps, or with ``ends`` the range of the scored steps.

    Without ``ends``, the end state must be at least as good as that of the first scored step.
    """
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
    end_kwh = stored + problem.end_margin_kwh
    return Span(0, problem.steps, start_kwh=stored, start_tasks=0.0, end_kwh=end_kwh, end_tasks=0.0)


def _modes(problem: Problem, span: Span, dispatch: Dispatch) -> I64:
    """Return modes, (n,), under which the work of a dispatch is approximately feasible."""
    steps = problem.work.deadline_steps
    assert steps is not None
    entered, waiting = dispatch.deferred_tasks, dispatch.waiting_tasks
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


def _queue_modes(problem: Problem, span: Span, dispatch: Dispatch) -> I64:
    """Return the modes, (n,), of a simulated queue that follows a dispatch as closely as it can."""
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
        change = dispatch.executed_tasks[t] - arrived[t]
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
    """Solve a linear programme.

    Raises:
        ConfigError: no plan satisfies the limits.
    """
    try:
        return programme.solve()
    except InfeasibleError:
        raise ConfigError(
            f"optimum of {problem.name}: no plan does all work within its deadline and ends with "
            f"at least the stored energy and at most the queue that are asked for; valid are data "
            f"centers that can, see workload.max_utilisation and workload.deadline_h"
        ) from None


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
"""Function that returns the best dispatch of a range of steps."""


def _window_ends(problem: Problem, first: int, longest: int) -> list[int]:
    """Divide the steps of a problem into windows; return the first step after each window.

    Windows have about equal lengths, and no window crosses the end of a month with a demand charge.

    Args:
        problem: The planning problem.
        first: First step of the first window.
        longest: Maximum number of steps in a window.
    """
    months = sorted({m.end for m in problem.months if first < m.end < problem.steps})
    ends: list[int] = []
    for begin, end in zip([first, *months], [*months, problem.steps], strict=True):
        count = -(-(end - begin) // longest)
        ends += [begin + (end - begin) * (k + 1) // count for k in range(count)]
    return ends


def _bound_in_windows(
    problem: Problem, stage: StageCost, span: Span, ends: list[int], around: int, solve: Solve
) -> Dispatch:
    """Compute the bound of a range of steps window by window, joined to one dispatch.

    Args:
        problem: The planning problem.
        stage: Minimum cost of each step.
        span: The range of steps.
        ends: First step after each window; the last entry is the end of the range.
        around: Number of steps on each side of a border in the programme that gives its prices.
        solve: Solves the programme of a range of steps.
    """
    prices = {
        end - 1: _border_prices(problem, stage, span, (end - 1, end - 1), around, solve)
        for end in ends[:-1]
    }
    end_prices: dict[int, tuple[float, float]] = {}
    task = kwh = 0.0
    if span.as_after is not None:
        pair = (span.end - 1, span.as_after)
        task, kwh = _border_prices(problem, stage, span, pair, around, solve)
        task, kwh = max(task, 0.0), max(kwh, 0.0)
        end_prices = {span.end - 1: (task, kwh), span.as_after: (-task, -kwh)}
    parts = []
    for begin, end in zip([span.first, *ends[:-1]], ends, strict=True):
        inside = replace(
            span,
            first=begin,
            end=end,
            as_after=None,
            state_values=_state_values(prices, end_prices, begin, end),
        )
        if begin > span.first:
            inside = replace(inside, start_kwh=None, start_tasks=None, deferred_before=None)
        if end < span.end:
            inside = replace(inside, end_kwh=None, end_tasks=None)
        parts.append(solve(_with_part_of_months(problem, begin, end), stage, inside))
    return replace(_joined(parts), end_task_price=task, end_kwh_price=kwh)


def _plan_in_windows(
    problem: Problem, stage: StageCost, span: Span, ends: list[int], ahead: int, solve: Solve
) -> Dispatch:
    """Compute a plan window by window; each window starts from the end state of the previous one.

    Args:
        problem: The planning problem.
        stage: Minimum cost of each step.
        span: The range of steps, with ``deferred_before`` set.
        ends: First step after each window; the last entry is the end of the range.
        ahead: Number of steps after a window that its programme contains in addition.
        solve: Computes a plan of a range of steps.
    """
    parts: list[Dispatch] = []
    state, first = span, span.first
    end_kwh, end_tasks = span.end_kwh, span.end_tasks
    for end in ends:
        until = min(end + ahead, span.end)
        last = until == span.end
        within = span.as_after is not None and first <= span.as_after
        dispatch = solve(
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
        window = _first_steps(dispatch, end - first)
        parts.append(window)
        if within and span.as_after is not None and span.as_after < end:
            at = span.as_after - first
            end_kwh, end_tasks = float(window.stored_kwh[at]), float(window.waiting_tasks[at])
        before = state.deferred_before
        state = replace(
            state,
            start_kwh=float(window.stored_kwh[-1]),
            start_tasks=float(max(window.waiting_tasks[-1], 0.0)),
            deferred_before=None
            if before is None
            else np.concatenate([before, window.deferred_tasks])[-len(before) :],
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
    """Compute the cost of a waiting task and the value of a stored kWh at a border of windows.

    Args:
        problem: The planning problem.
        stage: Minimum cost of each step.
        span: The range of all steps.
        border: The last step before the border, and the step whose end state is the state after the
            border. Both are equal except for the condition that the last step has the state of an
            earlier step; the second entry is then this earlier step.
        around: Number of steps on each side of the border in the programme.
        solve: Solves the programme of a range of steps.
    """
    before, after = border
    left = np.arange(max(before + 1 - around, span.first), before + 1)
    right = np.arange(after + 1, min(after + 1 + around, span.end))
    steps = np.concatenate([left, right])
    part = Span(0, len(steps), start_kwh=span.start_kwh, start_tasks=span.start_tasks)
    dispatch = solve(_taken(problem, steps), _taken_stage(stage, steps), part)
    return float(dispatch.task_price[len(left) - 1]), float(dispatch.kwh_price[len(left) - 1])


def _with_part_of_months(problem: Problem, begin: int, end: int) -> Problem:
    """Return a problem whose monthly demand charges are scaled to the part between two steps."""
    months = []
    for month in problem.months:
        covered = max(min(month.end, end) - max(month.first, begin), 0)
        weight = month.weight_per_kw * covered / (month.end - month.first)
        months.append(replace(month, weight_per_kw=weight))
    return replace(problem, months=tuple(months))


def _state_values(
    prices: dict[int, tuple[float, float]],
    held: dict[int, tuple[float, float]],
    begin: int,
    end: int,
) -> tuple[tuple[int, float, float], ...]:
    """Return the costs of states in a window: step, cost per task, cost per kWh at its end.

    Args:
        prices: Cost of a waiting task and value of a stored kWh, by the last step of each window.
        held: Cost of a waiting task and value of a stored kWh, by the two steps of the condition
            that the end has the state of an earlier step.
        begin: First step of the window.
        end: First step after the window.
    """
    values = [(step, task, -kwh) for step, (task, kwh) in held.items() if begin <= step < end]
    if end - 1 in prices:
        task, kwh = prices[end - 1]
        values.append((end - 1, task, -kwh))
    if begin - 1 in prices:
        task, kwh = prices[begin - 1]
        values.append((begin - 1, -task, kwh))
    return tuple(values)


def _taken(problem: Problem, steps: I64) -> Problem:
    """Return a problem that consists of the chosen steps of another problem, in their order.

    The new problem has no demand charges.
    """
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
        battery_kwh=None if problem.battery_kwh is None else problem.battery_kwh[steps],
        scored_from=0,
    )


def _taken_stage(stage: StageCost, steps: I64) -> StageCost:
    """Return the minimum costs of the chosen steps."""
    return replace(
        stage,
        **{
            f.name: getattr(stage, f.name)[steps]
            for f in fields(StageCost)
            if f.name != "executed_tasks"
        },
    )


def _first_steps(dispatch: Dispatch, count: int) -> Dispatch:
    """Return the first ``count`` steps of a dispatch."""
    return replace(dispatch, **{name: getattr(dispatch, name)[:count] for name in _BY_STEP})


def _joined(parts: list[Dispatch]) -> Dispatch:
    """Concatenate the dispatches of windows; the figure is the sum of their figures."""
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in _BY_STEP
    }
    joined["figure"] = sum(part.figure for part in parts)
    joined["peaks_kw"] = tuple(np.max([part.peaks_kw for part in parts], axis=0).tolist())
    return replace(parts[-1], **joined)
