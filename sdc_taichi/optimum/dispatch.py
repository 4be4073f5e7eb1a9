"""The linear programme of load, battery and demand charges of one data center over some steps.

Variables of step t: the use of each segment of the cost curve, energy charged c and discharged x,
energy stored b, work that waits Q, and D, all work deferred since the first step. With arriving
work A, work done e, and N steps to the deadline, the rows are

    Q_t = Q_(t-1) + A_t - e_t - dropped_t        D_t - D_(t-1) <= min(most deferred, Q_t)
    Q_t <= D_t - D_(t-N)                         b_t = b_(t-1) + eta_c*c_t - eta_d*x_t
    c_t, x_t <= the limits of ``BatteryLimits`` at b_(t-1)
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
from functools import lru_cache

import numpy as np

from sdc_taichi.optimum.problem import Problem, Storage
from sdc_taichi.optimum.programme import Linear, Programme, Solution
from sdc_taichi.optimum.stage_cost import LoadCurves, StageCost
from sdc_taichi.plant.battery import BATTERIES, BatteryPoint
from sdc_taichi.types import F64, I64

DEFER, DRAIN, DUE = -1, 1, 0
"""Mode of a step of a plan: work enters the queue, leaves it, or due work leaves it."""


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
        problem: The planning problem.
        stage: Least cost of its steps.
        curves: Cost and energy of its steps by the work done.
        span: The steps.
    """

    def __init__(self, problem: Problem, stage: StageCost, curves: LoadCurves, span: Span) -> None:
        self._problem, self._span = problem, span
        self._size = span.end - span.first
        self._steps = slice(span.first, span.end)
        self._programme = Programme()
        nothing = Linear(np.zeros(self._size))
        self._base_cost = float(curves.base_cost[self._steps].sum())
        self._executed, self._energy_kwh = self._add_segments(curves)
        self._queue, self._start_tasks = nothing, nothing[0]
        self._entered: Linear | None = None
        self._within_deadline = nothing
        if "load" in problem.agents:
            self._add_queue()
        self._charge, self._discharge = nothing, nothing
        self._stored = nothing + (span.start_kwh or 0.0)
        if self._has_battery:
            self._add_battery(stage)
        self._add_peaks()

    @property
    def _has_battery(self) -> bool:
        return "battery" in self._problem.agents and self._problem.storage.capacity_kwh > 0

    @property
    def _left(self) -> Linear:
        """Work that leaves the queue in each step of a programme with a deadline, (n,)."""
        assert self._entered is not None
        return self._entered - (self._queue - self._queue.before(self._start_tasks))

    def add_deferral_weight(self, weight: F64) -> None:
        """Weigh each task that enters the queue, as a hint and not a cost, (n,)."""
        if self._entered is None:
            return
        self._programme.add_cost("deferred", weight - np.append(weight[1:], 0.0))
        # Without a weight more may always enter, so the bound does without these rows.
        self._programme.at_most("entered", 0.0, self._entered)
        self._programme.at_most("left", 0.0, self._left)

    def keep_modes(self, modes: I64) -> None:
        """Let work enter and leave as a first-in-first-out queue can do it.

        A step with mode DEFER takes nothing out, one with DRAIN puts nothing in, and one with DUE
        takes out what is due and no more.

        Args:
            modes: DEFER, DRAIN or DUE, (n,).
        """
        if self._entered is None:
            return
        defer, drain, due = (np.flatnonzero(modes == m) for m in (DEFER, DRAIN, DUE))
        p, entered, left = self._programme, self._entered, self._left
        p.equal("defer", left[defer], 0.0)
        p.equal("drain", entered[drain], 0.0)
        p.at_most("drained", 0.0, left[drain])
        p.at_most("run", 0.0, left[due])
        if self._problem.work.model == "tasks":
            # Except for due work, a queue falls by no more than the flexible work of its step, and
            # in a step with due work no work is taken back that was deferred.
            most = self._problem.work.most_deferred_tasks[self._steps]
            fall, others = self._queue.before(self._start_tasks) - self._queue, modes != DUE
            p.at_most("drain_limit", fall[others], most[others])
            p.at_most("entered_due", 0.0, entered[due])
        p.equal("due", self._queue[due], self._within_deadline[due])

    def solve(self) -> Dispatch:
        """Find the least cost of the steps, and how it is reached.

        Raises:
            InfeasibleError: Nothing satisfies all rows.
        """
        solution, none = self._programme.solve(), np.zeros(self._size)
        waiting = solution.of(self._queue)
        rise = np.diff(waiting, prepend=solution.of(self._start_tasks))
        deferred = np.maximum(rise, 0.0) if self._entered is None else solution.of(self._entered)
        charge, discharge = self._net_battery(solution)
        return Dispatch(
            figure=self._base_cost + solution.figure,
            executed_tasks=solution.of(self._executed),
            waiting_tasks=waiting,
            deferred_tasks=deferred,
            charge_kwh=charge,
            discharge_kwh=discharge,
            stored_kwh=solution.of(self._stored),
            task_price=solution.prices.get("work", none),
            kwh_price=-solution.prices.get("energy", none),
            end_task_price=float(-solution.prices.get("end_work", none)[0]),
            end_kwh_price=float(-solution.prices.get("end_energy", none)[0]),
            peaks_kw=tuple(
                float(solution.values.get(_peak_name(k), none)[0])
                for k in range(len(self._problem.months))
            ),
        )

    def _add_segments(self, curves: LoadCurves) -> tuple[Linear, Linear]:
        """Add the use of each segment of the cost curves.

        Returns:
            Work done in each step, in tasks, and energy of the facility, in kWh, (n,) each.
        """
        from scipy import sparse

        executed = Linear(curves.least_tasks[self._steps])
        energy_kwh = Linear(curves.base_kwh[self._steps])
        part = slice(*np.searchsorted(curves.step, [self._span.first, self._span.end]))
        size = part.stop - part.start
        if size == 0:
            return executed, energy_kwh
        self._programme.variables(
            "segments", size, upper=curves.width_tasks[part], cost=curves.slope_cost[part]
        )

        def by_step(value: F64) -> Linear:
            """Sum over the segments of each step of a value times the use of the segment."""
            at = (curves.step[part] - self._span.first, np.arange(size))
            matrix = sparse.csr_array((value, at), shape=(self._size, size))
            return Linear(np.zeros(self._size), {"segments": matrix})

        return executed + by_step(np.ones(size)), energy_kwh + by_step(curves.slope_kwh[part])

    def _add_queue(self) -> None:
        """Add work that waits, its limits and its deadline."""
        span, work, n, p = self._span, self._problem.work, self._size, self._programme
        arrived, limit = work.arrived_tasks[self._steps], work.queue_limit_tasks
        upper = np.full(n, limit)
        if span.end_tasks is not None:
            upper[-1] = min(limit, span.end_tasks)
        self._queue = p.variables("queue", n, upper=upper, cost=self._values(tasks=True))
        if span.start_tasks != 0.0:
            known = span.start_tasks
            self._start_tasks = p.variables(
                "start_tasks",
                1,
                lower=0.0 if known is None else known,
                upper=limit if known is None else known,
                cost=self._start_value(tasks=True),
            )
        lost = Linear(np.zeros(n))
        if work.most_dropped_tasks > 0:
            lost = p.variables("dropped", n, upper=arrived)
            scored = np.arange(span.first, span.end) >= self._problem.scored_from
            p.at_most("drops", lost[scored].sum(), work.most_dropped_tasks)
        rise = self._queue - self._queue.before(self._start_tasks)
        p.equal("work", rise + self._executed + lost, arrived)
        if span.as_after is not None:
            p.at_most("end_work", self._queue[-1], self._queue[span.as_after - span.first])
        if work.deadline_steps is None:
            return
        deferred = p.variables("deferred", n, lower=-np.inf)
        self._entered = deferred - deferred.before(0.0)
        p.at_most("entry", self._entered, work.most_deferred_tasks[self._steps])
        p.at_most("kept", self._entered, self._queue)
        # Without a record of what entered before the first step, its age is not known.
        first = work.deadline_steps if span.deferred_before is None else 0
        aged = np.arange(first, n)
        self._within_deadline = self._deferred_within(work.deadline_steps, deferred)
        p.at_most("deadline", self._queue[aged], self._within_deadline[aged])

    def _deferred_within(self, steps: int, deferred: Linear) -> Linear:
        """Work that entered the queue in the last ``steps`` steps up to each step, (n,)."""
        earlier, before = np.zeros(self._size), self._span.deferred_before
        if before is not None:
            # Of the work deferred before the first step, what is still within its deadline.
            within = np.cumsum(before[::-1])[::-1][1:]
            earlier[: steps - 1] = within[: self._size]
        return deferred - deferred.shifted(steps) + earlier

    def _add_battery(self, stage: StageCost) -> None:
        """Add charge, discharge, energy stored, and what limits them."""
        problem, span, p, n = self._problem, self._span, self._programme, self._size
        storage, weight = problem.storage, problem.kwh_weight[self._steps]
        start = storage.stored_kwh if span.start_kwh is None else span.start_kwh
        limits = battery_limits(storage, problem.step_h, start)
        charge = p.variables("charge", n, upper=limits.most_charge_kwh, cost=weight)
        discharge = p.variables("discharge", n, upper=limits.most_discharge_kwh, cost=-weight)
        lower, capacity = np.zeros(n), storage.capacity_kwh
        if span.end_kwh is not None:
            lower[-1] = span.end_kwh
        value = self._values(tasks=False)
        stored = p.variables("stored", n, lower=lower, upper=capacity, cost=value)
        start_kwh = p.variables(
            "start_kwh",
            1,
            lower=0.0 if span.start_kwh is None else span.start_kwh,
            upper=capacity if span.start_kwh is None else span.start_kwh,
            cost=self._start_value(tasks=False),
        )
        before = stored.before(start_kwh)
        gain = limits.charge_efficiency * charge - limits.discharge_factor * discharge
        p.equal("energy", stored - before - gain, limits.rounding_kwh)
        if span.as_after is not None:
            p.at_most("end_energy", stored[span.as_after - span.first], stored[-1])
        for name, energy, lines in (
            ("charge", charge, limits.charge),
            ("discharge", discharge, limits.discharge),
        ):
            for k, (empty_kwh, slope) in enumerate(lines):
                p.at_most(f"{name}_limit_{k}", energy, empty_kwh + slope * before)
        least_kwh, most_kwh = stage.least_facility_kwh[self._steps], stage.most_facility_kwh
        spread = 0.0
        if problem.litre_weight:
            spread = (most_kwh[self._steps] - least_kwh).max(axis=1)
        p.at_most("carried", discharge, limits.discharge_load_share * (self._energy_kwh + spread))
        if np.isfinite(problem.grid_limit_kw):
            most = np.maximum(problem.grid_limit_kw * problem.step_h, least_kwh.max(axis=1))
            p.at_most("grid", charge + self._energy_kwh, most)
        self._charge, self._discharge, self._stored = charge, discharge, stored

    def _add_peaks(self) -> None:
        """Add the highest power of each month."""
        span = self._span
        bought_kwh = self._energy_kwh + self._charge - self._discharge
        for k, month in enumerate(self._problem.months):
            first, end = max(month.first, span.first), min(month.end, span.end)
            if first >= end or month.weight_per_kw == 0.0:
                continue
            least = span.least_peaks_kw[k] if span.least_peaks_kw else 0.0
            name = _peak_name(k)
            peak_kw = self._programme.variables(name, 1, lower=least, cost=month.weight_per_kw)
            rows = np.arange(first, end) - span.first
            self._programme.at_most(name, bought_kwh[rows], self._problem.step_h * peak_kw)

    def _net_battery(self, solution: Solution) -> tuple[F64, F64]:
        """Charge and discharge, of which one is 0 in each step, with the same energy stored."""
        charge, discharge = solution.of(self._charge), solution.of(self._discharge)
        if not self._has_battery:
            return charge, discharge
        storage = self._problem.storage
        limits = battery_limits(storage, self._problem.step_h, storage.stored_kwh)
        eta_c, eta_d = limits.charge_efficiency, limits.discharge_factor
        gain = eta_c * charge - eta_d * discharge
        return np.maximum(gain, 0.0) / eta_c, np.maximum(-gain, 0.0) / eta_d

    def _values(self, *, tasks: bool) -> F64:
        """Cost of a task that waits, or of a kWh stored, at the end of each step, (n,)."""
        cost = np.zeros(self._size)
        for step, task, kwh in self._span.state_values:
            if step >= self._span.first:
                cost[step - self._span.first] += task if tasks else kwh
        return cost

    def _start_value(self, *, tasks: bool) -> float:
        """Cost of a task that waits, or of a kWh stored, before the first step."""
        before = self._span.first - 1
        values = self._span.state_values
        return sum(task if tasks else kwh for step, task, kwh in values if step == before)


def _peak_name(month: int) -> str:
    """Name of the variable and the rows of the highest power of a month, by its number."""
    return f"peak_{month}"


Line = tuple[float, float]
"""A limit in kWh of an empty battery, and its rise with each kWh stored."""

_STATES = 2001
"""States of charge at which the ``released`` battery is sampled."""
_ROUNDING_KWH = 5e-6
"""Most that the ``released`` battery gains in a step by rounding, in kWh."""
_UNLIMITED_KW = 1e12
"""Load that never limits a discharge, in kW."""


@dataclass(frozen=True, slots=True)
class BatteryLimits:
    """Limits of a battery in a step, each the least of linear functions of the energy stored."""

    charge_efficiency: float
    """Energy stored per energy drawn."""
    discharge_factor: float
    """Energy taken from the store per energy delivered."""
    charge: tuple[Line, ...]
    """Limits of the energy charged."""
    discharge: tuple[Line, ...]
    """Limits of the energy discharged."""
    most_charge_kwh: float
    """Most energy charged at any energy stored, in kWh."""
    most_discharge_kwh: float
    """Most energy discharged at any energy stored, in kWh."""
    discharge_load_share: float
    """Largest ratio of the energy discharged to the energy of the facility."""
    rounding_kwh: float
    """Energy that a step may gain by rounding, in kWh."""


@lru_cache(maxsize=256)
def battery_limits(storage: Storage, step_h: float, start_kwh: float) -> BatteryLimits:
    """Linear limits of a battery that hold at every energy it can have stored.

    The limits of ``clc`` and ``paper`` are linear themselves (``plant.battery``). Those of
    ``released`` depend on the state of charge in other ways; here they are the least concave curve
    above them, so a battery within these limits does all that the model does, and more.

    Args:
        storage: The battery.
        step_h: Length of a step, in h.
        start_kwh: Energy stored before the first step, in kWh.
    """
    capacity = storage.capacity_kwh
    if storage.model == "released":
        return _released(capacity, step_h)
    eta_c, eta_d = storage.charge_efficiency, storage.discharge_factor
    if storage.model == "paper":
        most_c, most_d = storage.charge_limit_c_rate, storage.discharge_limit_c_rate
        upper, lower, rise_c, rise_d = capacity, 0.0, 0.0, 0.0
    else:
        most_c, most_d = storage.charge_limit_c_rate / eta_c, storage.discharge_limit_c_rate / eta_d
        upper, lower = storage.upper_v * capacity, storage.lower_v * capacity
        rise_c, rise_d = -storage.upper_u_h, storage.lower_u_h
    # A battery that starts beyond these limits stays there until it is used.
    upper, lower = max(upper, start_kwh), min(lower, start_kwh)
    in_h, out_h = eta_c * step_h + rise_c, eta_d * step_h + rise_d
    return BatteryLimits(
        charge_efficiency=eta_c,
        discharge_factor=eta_d,
        charge=((upper * step_h / in_h, -step_h / in_h),),
        discharge=((-lower * step_h / out_h, step_h / out_h),),
        most_charge_kwh=most_c * capacity * step_h,
        most_discharge_kwh=most_d * capacity * step_h,
        discharge_load_share=1.0,
        rounding_kwh=0.0,
    )


def _released(capacity_kwh: float, step_h: float) -> BatteryLimits:
    """Limits of the ``released`` battery: the least concave curves above it."""
    stored = np.linspace(0.0, capacity_kwh, _STATES)
    energy = {}
    for name, command in (("charge", 1.0), ("discharge", -1.0)):
        point = BatteryPoint(capacity_kwh, _UNLIMITED_KW, step_h)
        step = BATTERIES["released"].step(stored, command, point)
        energy[name] = np.asarray(getattr(step, f"{name}_kwh"))
    # The load carries a quarter of its power over a duration that depends on the state of charge.
    point = BatteryPoint(capacity_kwh, 1e-6 * capacity_kwh, step_h)
    light = BATTERIES["released"].step(stored, -1.0, point)
    share = float(np.max(light.discharge_kwh) / (1e-6 * capacity_kwh * step_h))
    return BatteryLimits(
        charge_efficiency=1.0,
        discharge_factor=1.0,
        charge=_lines_above(stored, energy["charge"]),
        discharge=_lines_above(stored, energy["discharge"]),
        most_charge_kwh=float(energy["charge"].max()) * (1 + 1e-6),
        most_discharge_kwh=float(energy["discharge"].max()) * (1 + 1e-6),
        discharge_load_share=share * (1 + 1e-6),
        rounding_kwh=_ROUNDING_KWH,
    )


def _lines_above(x: F64, y: F64, count: int = 6) -> tuple[Line, ...]:
    """Lines whose least is above a curve: some edges of its upper hull, raised above all points.

    Between samples the curve rises above its chords by no more than the largest second difference.
    """
    corners = [0]
    for i in range(1, len(x)):
        while len(corners) > 1:
            a, b = corners[-2:]
            if (y[b] - y[a]) * (x[i] - x[a]) > (y[i] - y[a]) * (x[b] - x[a]):
                break
            corners.pop()
        corners.append(i)
    margin = float(np.abs(np.diff(y, 2)).max())
    slopes = np.diff(y[corners]) / np.diff(x[corners])
    picked = np.unique(np.linspace(0, len(slopes) - 1, count).round().astype(int))
    return tuple((float((y - s * x).max()) + margin, float(s)) for s in slopes[picked])
