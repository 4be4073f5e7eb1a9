"""The linear programme of load, battery and demand charges of one data center over some steps.

Variables of step t: the use of each segment of the cost curve, energy charged c and discharged x,
energy stored b, work that waits Q, and D, all work deferred since the first step. With arriving
work A, work done e, and N steps to the deadline, the rows are

    Q_t = Q_(t-1) + A_t - e_t - dropped_t        D_t - D_(t-1) <= min(most deferred, Q_t)
    Q_t <= D_t - D_(t-N)                         b_t = b_(t-1) + eta_c*c_t - eta_d*x_t
    c_t, x_t <= the limits of ``battery_limits`` at b_(t-1)
    x_t <= F_t(e_t)                              c_t + F_t(e_t) <= grid limit, largest F_t
    F_t(e_t) + c_t - x_t <= step_h * peak of the month

Whatever a controller does in the simulator keeps these rows, or is no cheaper than something that
does, so their optimum is a bound:

- Work that waits after step t entered within the last N steps, since older work is due and runs;
  what entered is at most what may be deferred, and no more than waits if what leaves is taken as
  it was before the step. Rows let work leave and enter at once, which a first-in-first-out queue
  does for due work alone.
- F_t is the least energy of the facility over setpoints, below which none can come, and its convex
  curve is lower still. A discharge is at most the energy of the facility at the setpoint that was
  chosen. Cut to F_t it leaves more in the store, which costs nothing to waste by charging less
  later, and the energy bought is no higher: F + c - x with x <= F is at least c. With a weight on
  water, the cheapest setpoint may not be that of F_t, and the row has the largest F instead.
- At weights of 0 or more, charging and discharging at once is allowed but never pays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sdc_taichi.optimum.battery_limits import battery_limits
from sdc_taichi.optimum.problem import Problem
from sdc_taichi.optimum.programme import Matrix, Programme, Solution
from sdc_taichi.optimum.stage_cost import LoadCurves, StageCost
from sdc_taichi.types import F64

DEFER, DRAIN, DUE = -1, 1, 0
"""What a step of a plan does with its queue: add work, take work out, or both with due work."""


@dataclass(frozen=True, slots=True)
class Span:
    """Some steps of a problem, what they start from, and what they have to leave."""

    first: int
    """First of the steps."""
    end: int
    """First step after them."""
    start_kwh: float | None = None
    """Energy stored before the first, in kWh; None is any."""
    start_tasks: float | None = None
    """Work that waits before the first, in tasks; None is any."""
    deferred_before: F64 | None = None
    """Work that was deferred in each step of a deadline before the first, oldest first, in tasks,
    (N,); None where the age of work that waits is not known."""
    end_kwh: float | None = None
    """Least energy stored after the last, in kWh; None is any."""
    end_tasks: float | None = None
    """Most work that waits after the last, in tasks; None is any."""
    least_peaks_kw: tuple[float, ...] = ()
    """Least power of each month that is charged for, in kW; 0 of all where it is empty."""
    as_after: int | None = None
    """Step, of all T, whose state at its end the last has to keep; None is none."""
    state_values: tuple[tuple[int, float, float], ...] = ()
    """Steps, of all T, and what each task that waits and each kWh stored at their end costs;
    ``first - 1`` is the start."""


@dataclass(frozen=True, slots=True)
class Dispatch:
    """Least cost of some steps and how it is reached."""

    figure: float
    """Weighed cost of the steps, their peaks and the values of states."""
    executed_tasks: F64
    """Work that is done, in tasks, (n,)."""
    waiting_tasks: F64
    """Work that waits at the end of each step, in tasks, (n,)."""
    deferred_tasks: F64
    """Work that enters the queue, in tasks, (n,); what waits more where there is no deadline."""
    charge_kwh: F64
    """Energy charged, in kWh, (n,)."""
    discharge_kwh: F64
    """Energy discharged, in kWh, (n,)."""
    stored_kwh: F64
    """Energy stored at the end of each step, in kWh, (n,)."""
    task_price: F64
    """What one task more that waits at the end of each step adds to the figure, (n,)."""
    kwh_price: F64
    """What one kWh more stored at the end of each step takes off the figure, (n,)."""
    end_task_price: float
    """What one task fewer to leave at the end adds, where that follows an earlier step."""
    end_kwh_price: float
    """What one kWh more to leave at the end adds, where that follows an earlier step."""
    peaks_kw: tuple[float, ...]
    """Power of each month that is charged for, in kW."""


class DispatchProgramme:
    """The linear programme of some steps.

    Args:
        problem: What is to be planned.
        stage: The least cost of its steps.
        curves: Cost and energy of its steps by the work done.
        span: The steps.
    """

    def __init__(self, problem: Problem, stage: StageCost, curves: LoadCurves, span: Span) -> None:
        from scipy import sparse

        self.problem, self.span = problem, span
        self._size = n = span.end - span.first
        self._programme = Programme()
        self._now: Matrix = sparse.eye_array(n, format="csr")
        self._change: Matrix = self._now - sparse.eye_array(n, k=-1, format="csr")
        steps = slice(span.first, span.end)
        self._base_kwh = curves.base_kwh[steps]
        self._base_tasks = curves.least_tasks[steps]
        self._base_cost = float(curves.base_cost[steps].sum())
        self._stage = stage
        self._has_battery = "battery" in problem.agents and problem.storage.capacity_kwh > 0
        self._has_load = "load" in problem.agents
        self._of_tasks: dict[str, Matrix] = {}
        self._of_kwh: dict[str, Matrix] = {}
        self._add_segments(curves)
        if self._has_load:
            self._add_queue()
        if self._has_battery:
            self._add_battery()
        self._add_peaks()

    def add_deferral_weight(self, weight: F64) -> None:
        """Weigh each task that enters the queue, as a hint and not a cost, (n,)."""
        if "deferred" not in self._programme.sizes:
            return
        self._programme.add_cost("deferred", weight - np.append(weight[1:], 0.0))
        # Without a weight more may always enter, so the bound does without these rows.
        none = np.zeros(self._size)
        self._programme.at_most("entered", none, deferred=-self._change)
        self._programme.at_most(
            "left",
            none,
            deferred=-self._change,
            queue=self._change,
            start_tasks=self._start_column,
        )

    def keep_modes(self, modes: np.ndarray) -> None:
        """Let work enter and leave as a first-in-first-out queue can do it.

        A step with mode DEFER takes nothing out, one with DRAIN puts nothing in, and one with DUE
        takes out what is due and no more.

        Args:
            modes: DEFER, DRAIN or DUE, (n,).
        """
        if "deferred" not in self._programme.sizes:
            return
        defer, drain, due = (np.flatnonzero(modes == m) for m in (DEFER, DRAIN, DUE))
        change, p = self._change, self._programme
        start = self._start_column
        leaves = {"deferred": change, "queue": -change, "start_tasks": -start}
        none = np.zeros(self._size)
        p.equal("defer", none[defer], **_rows(leaves, defer))
        p.equal("drain", none[drain], **_rows({"deferred": change}, drain))
        both = {name: -m for name, m in leaves.items()}
        for name, rows in (("drained", drain), ("run", due)):
            p.at_most(name, none[rows], **_rows(both, rows))
        if self.problem.work.model == "tasks":
            # But for due work, a queue falls by no more than the flexible work of its step, and
            # none that was deferred is taken back in a step with due work.
            most = self.problem.work.most_deferred_tasks[self.span.first : self.span.end]
            falls, others = {"queue": -change, "start_tasks": -start}, np.flatnonzero(modes != DUE)
            p.at_most("drain_limit", most[others], **_rows(falls, others))
            p.at_most("entered_due", none[due], **_rows({"deferred": -change}, due))
        matrices, right = self._deadline()
        p.equal("due", right[due], **_rows(matrices, due))

    def solve(self) -> Dispatch:
        """The least cost of the steps, and how it is reached.

        Raises:
            InfeasibleError: nothing keeps all rows.
        """
        found, n = self._programme.solve(), self._size
        none = np.zeros(n)
        values, span = found.values, self.span
        executed = self._base_tasks.copy()
        for name, matrix in self._of_tasks.items():
            executed += matrix @ values[name]
        waiting = values.get("queue", none)
        start = values["start_tasks"][0] if "start_tasks" in values else 0.0
        change = np.diff(waiting, prepend=start)
        total = values.get("deferred")
        deferred = np.maximum(change, 0.0) if total is None else np.diff(total, prepend=0.0)
        charge, discharge = self._netted(found)
        stored = values.get("stored", np.full(n, span.start_kwh or 0.0))
        return Dispatch(
            figure=self._base_cost + found.figure,
            executed_tasks=executed,
            waiting_tasks=waiting,
            deferred_tasks=deferred,
            charge_kwh=charge,
            discharge_kwh=discharge,
            stored_kwh=stored,
            task_price=found.prices.get("work", none),
            kwh_price=-found.prices.get("energy", none),
            end_task_price=float(-found.prices.get("end_work", np.zeros(1))[0]),
            end_kwh_price=float(-found.prices.get("end_energy", np.zeros(1))[0]),
            peaks_kw=tuple(
                float(values[f"peak_{k}"][0]) if f"peak_{k}" in values else 0.0
                for k in range(len(self.problem.months))
            ),
        )

    def _add_segments(self, curves: LoadCurves) -> None:
        """Use of the segments of the curves."""
        from scipy import sparse

        first, last = np.searchsorted(curves.step, [self.span.first, self.span.end])
        size = int(last - first)
        if size == 0:
            return
        part = slice(first, last)
        at = (curves.step[part] - self.span.first, np.arange(size))
        shape = (self._size, size)
        self._programme.variables(
            "segments", size, upper=curves.width_tasks[part], cost=curves.slope_cost[part]
        )
        self._of_tasks["segments"] = sparse.csr_array((np.ones(size), at), shape=shape)
        self._of_kwh["segments"] = sparse.csr_array((curves.slope_kwh[part], at), shape=shape)

    def _add_queue(self) -> None:
        """Work that waits, its limits and its deadline."""
        from scipy import sparse

        span, work, n, p = self.span, self.problem.work, self._size, self._programme
        steps = slice(span.first, span.end)
        arrived = work.arrived_tasks[steps]
        limit = work.queue_limit_tasks
        upper = np.full(n, limit)
        if span.end_tasks is not None:
            upper[-1] = min(limit, span.end_tasks)
        p.variables("queue", n, upper=upper, cost=self._values(tasks=True))
        rows = {"queue": self._change, **self._of_tasks}
        if span.start_tasks != 0.0:
            given = span.start_tasks
            p.variables(
                "start_tasks",
                1,
                lower=0.0 if given is None else given,
                upper=limit if given is None else given,
                cost=self._start_value(tasks=True),
            )
            rows["start_tasks"] = self._start_column
        if work.most_dropped_tasks > 0:
            p.variables("dropped", n, upper=arrived)
            rows["dropped"] = self._now
            scored = (np.arange(span.first, span.end) >= self.problem.scored_from).astype(float)
            p.at_most(
                "drops", np.array([work.most_dropped_tasks]), dropped=sparse.csr_array([scored])
            )
        p.equal("work", arrived - self._base_tasks, **rows)
        if span.as_after is not None:
            p.at_most("end_work", np.zeros(1), queue=self._last_less_than_after())
        if work.deadline_steps is None:
            return
        p.variables("deferred", n, lower=-np.inf)
        p.at_most("entry", work.most_deferred_tasks[steps], deferred=self._change)
        p.at_most("kept", np.zeros(n), deferred=self._change, queue=-self._now)
        matrices, right = self._deadline()
        aged = np.arange(n)
        if span.deferred_before is None:
            aged = aged[work.deadline_steps :]
        p.at_most("deadline", right[aged], **_rows(matrices, aged))

    def _deadline(self) -> tuple[dict[str, Matrix], F64]:
        """Rows of work that waits less what entered within the deadline, and right-hand sides."""
        from scipy import sparse

        steps, n = self.problem.work.deadline_steps, self._size
        assert steps is not None
        before = self.span.deferred_before
        right = np.zeros(n)
        if before is not None:
            # Of the work deferred earlier, what is within the deadline of each of the first steps.
            within = np.cumsum(before[::-1])[::-1][1:]
            right[: steps - 1] = within[:n]
        earlier = sparse.eye_array(n, k=-steps, format="csr") if steps < n else 0.0 * self._now
        return {"queue": self._now, "deferred": earlier - self._now}, right

    def _add_battery(self) -> None:
        """Charge, discharge, energy stored, and what limits them."""
        span, p, n = self.span, self._programme, self._size
        problem, storage, steps = self.problem, self.problem.storage, slice(span.first, span.end)
        weight = problem.kwh_weight[steps]
        start = storage.stored_kwh if span.start_kwh is None else span.start_kwh
        limits = battery_limits(storage, problem.step_h, start)
        p.variables("charge", n, upper=limits.most_charge_kwh, cost=weight)
        p.variables("discharge", n, upper=limits.most_discharge_kwh, cost=-weight)
        lower = np.zeros(n)
        if span.end_kwh is not None:
            lower[-1] = span.end_kwh
        p.variables(
            "stored",
            n,
            lower=lower,
            upper=storage.capacity_kwh,
            cost=self._values(tasks=False),
        )
        given = span.start_kwh
        p.variables(
            "start_kwh",
            1,
            lower=0.0 if given is None else given,
            upper=storage.capacity_kwh if given is None else given,
            cost=self._start_value(tasks=False),
        )
        now, start_column = self._now, self._start_column
        p.equal(
            "energy",
            np.full(n, limits.rounding_kwh),
            stored=self._change,
            start_kwh=start_column,
            charge=-limits.charge_efficiency * now,
            discharge=limits.discharge_factor * now,
        )
        if span.as_after is not None:
            p.at_most("end_energy", np.zeros(1), stored=-self._last_less_than_after())
        before = now - self._change
        for name, lines in (("charge", limits.charge), ("discharge", limits.discharge)):
            for k, (most, slope) in enumerate(lines):
                blocks = {name: now, "stored": -slope * before, "start_kwh": slope * start_column}
                p.at_most(f"{name}_limit_{k}", np.full(n, most), **blocks)
        spread = np.zeros(n)
        if problem.litre_weight:
            stage = self._stage
            spread = (stage.most_facility_kwh - stage.least_facility_kwh)[steps].max(axis=1)
        share = limits.discharge_load_share
        carried = {name: -share * m for name, m in self._of_kwh.items()}
        p.at_most("carried", share * (self._base_kwh + spread), discharge=now, **carried)
        if np.isfinite(problem.grid_limit_kw):
            largest = self._stage.least_facility_kwh[steps].max(axis=1)
            most = np.maximum(problem.grid_limit_kw * problem.step_h, largest)
            p.at_most("grid", most - self._base_kwh, charge=now, **self._of_kwh)

    def _add_peaks(self) -> None:
        """The highest power of each month."""
        from scipy import sparse

        span, p, step_h = self.span, self._programme, self.problem.step_h
        bought = dict(self._of_kwh)
        if self._has_battery:
            bought |= {"charge": self._now, "discharge": -self._now}
        for k, month in enumerate(self.problem.months):
            first, end = max(month.first, span.first), min(month.end, span.end)
            if first >= end or month.weight_per_kw == 0.0:
                continue
            name = f"peak_{k}"
            least = span.least_peaks_kw[k] if span.least_peaks_kw else 0.0
            p.variables(name, 1, lower=least, cost=month.weight_per_kw)
            rows = np.arange(first, end) - span.first
            column = sparse.csr_array(np.full((len(rows), 1), -step_h))
            p.at_most(name, -self._base_kwh[rows], **_rows(bought, rows), **{name: column})

    def _netted(self, found: Solution) -> tuple[F64, F64]:
        """Charge and discharge, of which one is 0 in each step, with the same energy stored."""
        if not self._has_battery:
            return np.zeros(self._size), np.zeros(self._size)
        storage = self.problem.storage
        limits = battery_limits(storage, self.problem.step_h, storage.stored_kwh)
        eta_c, eta_d = limits.charge_efficiency, limits.discharge_factor
        gain = eta_c * found.values["charge"] - eta_d * found.values["discharge"]
        return np.maximum(gain, 0.0) / eta_c, np.maximum(-gain, 0.0) / eta_d

    def _values(self, *, tasks: bool) -> F64:
        """Cost of a task that waits, or of a kWh stored, at the end of each step, (n,)."""
        cost = np.zeros(self._size)
        for step, task, kwh in self.span.state_values:
            if step >= self.span.first:
                cost[step - self.span.first] += task if tasks else kwh
        return cost

    def _start_value(self, *, tasks: bool) -> float:
        """Cost of a task that waits, or of a kWh stored, before the first step."""
        before = self.span.first - 1
        values = self.span.state_values
        return sum(task if tasks else kwh for step, task, kwh in values if step == before)

    @property
    def _start_column(self) -> Matrix:
        """The state before the first step in the rows of changes, (n, 1)."""
        from scipy import sparse

        column = np.zeros((self._size, 1))
        column[0] = -1.0
        return sparse.csr_array(column)

    def _last_less_than_after(self) -> Matrix:
        """One row: the state after the last step less that after ``as_after``."""
        from scipy import sparse

        assert self.span.as_after is not None
        at = ([0, 0], [self._size - 1, self.span.as_after - self.span.first])
        return sparse.csr_array(([1.0, -1.0], at), shape=(1, self._size))


def _rows(blocks: dict[str, Matrix], rows: np.ndarray) -> dict[str, Matrix]:
    """The rows of each of some matrices."""
    return {name: matrix[rows] for name, matrix in blocks.items()}
