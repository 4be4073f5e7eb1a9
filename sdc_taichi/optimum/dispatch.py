"""Linear programme of load, battery and demand charges of one data center.

The variables of step t are the use of each segment of the cost curve, charged energy c, discharged
energy x, stored energy b, waiting work Q, and D, the total work deferred since the first step. With
arriving work A, executed work e, and N steps to the deadline, the constraints (rows) are

    Q_t = Q_(t-1) + A_t - e_t - dropped_t        D_t - D_(t-1) <= min(most deferred, Q_t)
    Q_t <= D_t - D_(t-N)                         b_t <= b_(t-1) + eta_c(c_t) - eta_d(x_t)
    c_t, x_t <= the limits of ``BatteryLimits`` at b_(t-1)
    x_t <= F_t(e_t) + S                          c_t + F_t(e_t) + S <= grid limit, largest F_t + S
    F_t(e_t) + S + c_t - x_t <= step_h * peak of the month

S is the standby energy of the battery. eta_c is a concave and eta_d a convex piecewise linear
function: with a square loss, their pieces are tangents, so that they never store less and never
take more than the battery. Without a square loss the row of b_t is an equation.

Every sequence of commands in the simulator satisfies these rows, or costs at least as much as a
sequence that does. Their optimum is therefore a bound, for three reasons:

- Work that waits after step t entered the queue within the last N steps, because older work is due
  and is executed. The work that enters in a step is at most the work that may be deferred, and at
  most the work that waits afterwards. The rows allow work to leave and to enter in the same step,
  whereas a first-in-first-out queue does so only for due work.
- F_t is a convex curve below the smallest energy of the facility at any setpoint, so no controller
  needs less energy than F_t. In the simulator, a discharge is at most the energy of the facility at
  the chosen setpoint. If a discharge exceeds F_t, reduce it to F_t: the battery then stores more,
  which a smaller charge later compensates, and no more energy is bought, because F + c - x with
  x <= F is at least c. If water has a weight, the cheapest setpoint may differ from that of F_t, so
  the row uses the largest F instead.
- The rows allow charging and discharging in the same step. With weights of at least 0 this never
  lowers the cost.
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
"""Mode of a step in a plan: work only enters the queue (DEFER), work only leaves it (DRAIN), or
exactly the due work leaves while other work may enter (DUE)."""


@dataclass(frozen=True, slots=True)
class Span:
    """A range of steps of a planning problem, with conditions on the start and end states."""

    first: int
    """Number of the first step."""
    end: int
    """Number of the first step after the range."""
    start_kwh: float | None = None
    """Energy stored before the first step, in kWh; None allows any value."""
    start_tasks: float | None = None
    """Work that waits before the first step, in tasks; None allows any value."""
    deferred_before: F64 | None = None
    """Work deferred in each of the N steps before the first step, oldest first, in tasks, (N,). N
    is the deadline in steps. None means that the age of the waiting work is unknown."""
    end_kwh: float | None = None
    """Minimum energy stored after the last step, in kWh; None allows any value."""
    end_tasks: float | None = None
    """Maximum work that waits after the last step, in tasks; None allows any value."""
    least_peaks_kw: tuple[float, ...] = ()
    """Minimum billed power of each month, in kW; an empty tuple means 0 for all months."""
    as_after: int | None = None
    """Number of a step whose end state is a condition on the end of the range: at least its stored
    energy and at most its waiting work. None means no such condition."""
    state_values: tuple[tuple[int, float, float], ...] = ()
    """Costs of states at the end of steps: number of the step, cost per waiting task, cost per
    stored kWh. Step ``first - 1`` stands for the state at the start."""


@dataclass(frozen=True, slots=True)
class Dispatch:
    """Minimum cost of n steps, with the work and the battery use that give this cost."""

    figure: float
    """Weighted cost of the steps, including demand charges and the costs of states."""
    executed_tasks: F64
    """Work executed in each step, in tasks, (n,)."""
    waiting_tasks: F64
    """Work that waits at the end of each step, in tasks, (n,)."""
    deferred_tasks: F64
    """Work that enters the queue in each step, in tasks, (n,); without a deadline, the increase of
    the queue."""
    charge_kwh: F64
    """Energy charged in each step, in kWh, (n,)."""
    discharge_kwh: F64
    """Energy discharged in each step, in kWh, (n,)."""
    stored_kwh: F64
    """Energy stored at the end of each step, in kWh, (n,)."""
    task_price: F64
    """Rise of the figure per additional task that waits at the end of a step, (n,)."""
    kwh_price: F64
    """Fall of the figure per additional kWh stored at the end of a step, (n,)."""
    end_task_price: float
    """Rise of the figure per task by which the condition ``Span.as_after`` is tightened."""
    end_kwh_price: float
    """Rise of the figure per kWh by which the condition ``Span.as_after`` is tightened."""
    peaks_kw: tuple[float, ...]
    """Billed power of each month with a demand charge, in kW."""


class DispatchProgramme:
    """Linear programme of a range of n steps.

    Args:
        problem: The planning problem.
        stage: Minimum cost of each step by the executed work.
        curves: Convex curves of cost and energy of each step by the executed work.
        span: Range of steps, with conditions on the states at its start and end.
    """

    def __init__(self, problem: Problem, stage: StageCost, curves: LoadCurves, span: Span) -> None:
        self._problem, self._span = problem, span
        self._size = span.end - span.first
        self._steps = slice(span.first, span.end)
        self._programme = Programme()
        nothing = Linear(np.zeros(self._size))
        self._converted = problem.storage.conversion(problem.step_h)
        drawn = nothing + float(self._converted.standby_kwh)
        if problem.battery_kwh is not None and not self._has_battery:
            drawn = Linear(problem.battery_kwh[self._steps])
        self._base_cost = float(
            curves.base_cost[self._steps].sum() + problem.kwh_weight[self._steps] @ drawn.constant
        )
        self._executed, self._energy_kwh = self._add_segments(curves)
        self._queue, self._start_tasks = nothing, nothing[0]
        self._entered: Linear | None = None
        self._within_deadline = nothing
        if "load" in problem.agents:
            self._add_queue()
        # All charged energy includes standby, which an idle battery draws as well.
        self._charge, self._discharge = drawn, nothing
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
        """Add a small cost per task that enters the queue, (n,), to choose among equal plans."""
        if self._entered is None:
            return
        self._programme.add_cost("deferred", weight - np.append(weight[1:], 0.0))
        # These rows are needed only with a weight: without it, additional work may always enter.
        self._programme.at_most("entered", 0.0, self._entered)
        self._programme.at_most("left", 0.0, self._left)

    def keep_modes(self, modes: I64) -> None:
        """Restrict work to movements that a first-in-first-out queue can perform.

        In a step of mode DEFER no work leaves the queue, in a step of mode DRAIN no work enters,
        and in a step of mode DUE exactly the due work leaves.

        Args:
            modes: Mode of each step, (n,).
        """
        if self._entered is None:
            return
        defer, drain, due = (np.flatnonzero(modes == m) for m in (DEFER, DRAIN, DUE))
        p, entered, left = self._programme, self._entered, self._left
        p.equal("defer", left[defer], 0.0)
        p.equal("drain", entered[drain], 0.0)
        p.at_most("drained", 0.0, left[drain])
        p.at_most("run", 0.0, left[due])
        if self._problem.work.model != "fluid":
            # In models of whole tasks, a queue without due work falls by at most the flexible work
            # of the step, and a step with due work takes back no deferred work.
            most = self._problem.work.most_deferred_tasks[self._steps]
            fall, others = self._queue.before(self._start_tasks) - self._queue, modes != DUE
            p.at_most("drain_limit", fall[others], most[others])
            p.at_most("entered_due", 0.0, entered[due])
        p.equal("due", self._queue[due], self._within_deadline[due])

    def solve(self) -> Dispatch:
        """Solve the linear programme for the minimum cost of the steps.

        Raises:
            InfeasibleError: No values of the variables satisfy all rows.
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
        """Add variables for the use of each segment of the cost curves, in tasks.

        Returns:
            Executed work of each step, in tasks, and energy of the facility, in kWh, (n,) each.
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
            """Return the sum of value times use over the segments of each step, (n,)."""
            at = (curves.step[part] - self._span.first, np.arange(size))
            matrix = sparse.csr_array((value, at), shape=(self._size, size))
            return Linear(np.zeros(self._size), {"segments": matrix})

        return executed + by_step(np.ones(size)), energy_kwh + by_step(curves.slope_kwh[part])

    def _add_queue(self) -> None:
        """Add the waiting work of each step, with queue limit and deadline."""
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
        # If the age of the initial queue is unknown, the deadline holds only after N steps.
        first = work.deadline_steps if span.deferred_before is None else 0
        aged = np.arange(first, n)
        self._within_deadline = self._deferred_within(work.deadline_steps, deferred)
        p.at_most("deadline", self._queue[aged], self._within_deadline[aged])

    def _deferred_within(self, steps: int, deferred: Linear) -> Linear:
        """Return the work that entered the queue in the ``steps`` steps up to each step, (n,)."""
        earlier, before = np.zeros(self._size), self._span.deferred_before
        if before is not None:
            # Work deferred before the first step whose deadline has not come yet.
            within = np.cumsum(before[::-1])[::-1][1:]
            earlier[: steps - 1] = within[: self._size]
        return deferred - deferred.shifted(steps) + earlier

    def _add_battery(self, stage: StageCost) -> None:
        """Add charged, discharged and stored energy of each step, with their limits."""
        problem, span, p, n = self._problem, self._span, self._programme, self._size
        storage, weight = problem.storage, problem.kwh_weight[self._steps]
        start = storage.stored_kwh if span.start_kwh is None else span.start_kwh
        limits = battery_limits(storage, problem.step_h, start)
        charge = discharge = gain = Linear(np.zeros(n))
        for k, (piece_kwh, efficiency) in enumerate(limits.charge_pieces()):
            piece = p.variables(f"charge_{k}", n, upper=piece_kwh, cost=weight)
            charge, gain = charge + piece, gain + efficiency * piece
        for k, (piece_kwh, factor) in enumerate(limits.discharge_pieces()):
            piece = p.variables(f"discharge_{k}", n, upper=piece_kwh, cost=-weight)
            discharge, gain = discharge + piece, gain - factor * piece
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
        # Pieces that are tangents store more than the battery, which may thus store less.
        relate = p.equal if limits.square_per_kwh == 0.0 else p.at_most
        relate("energy", stored - before - gain, limits.rounding_kwh)
        if span.as_after is not None:
            needed_kwh = stored[span.as_after - span.first] + problem.end_margin_kwh
            p.at_most("end_energy", needed_kwh, stored[-1])
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
        standby = float(self._converted.standby_kwh)
        load = self._energy_kwh + spread + standby
        p.at_most("carried", discharge, limits.discharge_load_share * load)
        if np.isfinite(problem.grid_limit_kw):
            least = least_kwh.max(axis=1) + standby
            most = np.maximum(problem.grid_limit_kw * problem.step_h, least)
            p.at_most("grid", charge + standby + self._energy_kwh, most)
        self._charge, self._discharge, self._stored = charge + standby, discharge, stored
        self._gain = gain

    def _add_peaks(self) -> None:
        """Add the highest power of each month, with its demand charge as cost."""
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
        """Return charge and discharge with the same stored energy, one of them 0 in each step."""
        if not self._has_battery:
            return solution.of(self._charge), solution.of(self._discharge)
        gain, converted = solution.of(self._gain), self._converted
        drawn_kwh = converted.drawn_kwh(np.maximum(gain, 0.0)) + converted.standby_kwh
        bus_kwh = drawn_kwh - converted.delivered_kwh(np.maximum(-gain, 0.0))
        return np.maximum(bus_kwh, 0.0), np.maximum(-bus_kwh, 0.0)

    def _values(self, *, tasks: bool) -> F64:
        """Return the cost per waiting task, or per stored kWh, at the end of each step, (n,)."""
        cost = np.zeros(self._size)
        for step, task, kwh in self._span.state_values:
            if step >= self._span.first:
                cost[step - self._span.first] += task if tasks else kwh
        return cost

    def _start_value(self, *, tasks: bool) -> float:
        """Return the cost per waiting task, or per stored kWh, before the first step."""
        before = self._span.first - 1
        values = self._span.state_values
        return sum(task if tasks else kwh for step, task, kwh in values if step == before)


def _peak_name(month: int) -> str:
    """Return the name of the variable and of the rows for the highest power of a month."""
    return f"peak_{month}"


Line = tuple[float, float]
"""A linear limit in kWh: its value for an empty battery, and its slope per stored kWh."""

Piece = tuple[float, float]
"""A piece of an energy on the bus: its maximum in kWh, and kWh of the store per kWh."""

_TANGENTS = 3
"""Number of tangents that replace the square loss. The pieces store at most 1/16 of the square loss
at full power more than the battery."""
_STATES = 2001
"""Number of states of charge at which the ``released`` battery model is sampled."""
_ROUNDING_KWH = 5e-6
"""Maximum energy that the ``released`` battery gains in a step by rounding, in kWh."""
_UNLIMITED_KW = 1e12
"""Load that is too large to limit any discharge, in kW."""


@dataclass(frozen=True, slots=True)
class BatteryLimits:
    """Limits of the energy that a battery charges or discharges in a step.

    Each limit is the minimum of linear functions of the stored energy.
    """

    charge_efficiency: float
    """Ratio of stored energy to energy drawn."""
    discharge_factor: float
    """Ratio of energy taken from the store to energy delivered."""
    charge: tuple[Line, ...]
    """Linear upper limits of the charged energy."""
    discharge: tuple[Line, ...]
    """Linear upper limits of the discharged energy."""
    most_charge_kwh: float
    """Maximum charged energy at any stored energy, in kWh."""
    most_discharge_kwh: float
    """Maximum discharged energy at any stored energy, in kWh."""
    discharge_load_share: float
    """Maximum ratio of the discharged energy to the energy of the facility."""
    rounding_kwh: float
    """Maximum energy that a step may gain by rounding, in kWh."""
    square_per_kwh: float = 0.0
    """Loss divided by the square of the energy that is converted, in 1/kWh."""

    def charge_pieces(self) -> tuple[Piece, ...]:
        """Return pieces of the charged energy, the piece that stores most per kWh first."""
        ratio = self.charge_efficiency
        return _pieces(self.most_charge_kwh, ratio, -ratio * self.square_per_kwh)

    def discharge_pieces(self) -> tuple[Piece, ...]:
        """Return pieces of the discharged energy, the piece that takes least per kWh first."""
        ratio = self.discharge_factor
        return _pieces(self.most_discharge_kwh, ratio, ratio * self.square_per_kwh)


@lru_cache(maxsize=256)
def battery_limits(storage: Storage, step_h: float, start_kwh: float) -> BatteryLimits:
    """Return linear limits that contain everything that a battery model can do in a step.

    The limits of the models ``clc`` and ``paper`` are linear (``plant.battery``). Those of
    ``released`` are nonlinear in the state of charge and are replaced by lines above them.

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
    # The initial stored energy may be outside these limits until a command moves the battery.
    upper, lower = max(upper, start_kwh), min(lower, start_kwh)
    in_h, out_h = eta_c * step_h + rise_c, eta_d * step_h + rise_d
    converted = storage.conversion(step_h)
    linear_kwh = most_c * capacity * step_h
    most_charge_kwh = float(converted.drawn_kwh(eta_c * linear_kwh))
    most_discharge_kwh = float(converted.delivered_kwh(eta_d * most_d * capacity * step_h))
    # The square loss raises the energy drawn for a rise of the store, at full power most.
    raised = most_charge_kwh / linear_kwh if linear_kwh > 0 else 1.0
    return BatteryLimits(
        charge_efficiency=eta_c,
        discharge_factor=eta_d,
        charge=((raised * upper * step_h / in_h, -raised * step_h / in_h),),
        discharge=((-lower * step_h / out_h, step_h / out_h),),
        most_charge_kwh=most_charge_kwh,
        most_discharge_kwh=most_discharge_kwh,
        discharge_load_share=1.0,
        rounding_kwh=0.0,
        square_per_kwh=float(converted.square_per_kwh),
    )


def _pieces(most_kwh: float, ratio: float, square_per_kwh: float) -> tuple[Piece, ...]:
    """Return the pieces of tangents of ratio*x + square_per_kwh*x^2 in 0 <= x <= most_kwh."""
    if square_per_kwh == 0.0:
        return ((most_kwh, ratio),)
    at_kwh = np.linspace(0.0, most_kwh, _TANGENTS)
    # Tangents of a parabola intersect halfway between the points that they touch.
    ends_kwh = np.append((at_kwh[1:] + at_kwh[:-1]) / 2.0, most_kwh)
    slopes = ratio + 2.0 * square_per_kwh * at_kwh
    return tuple(zip(np.diff(ends_kwh, prepend=0.0).tolist(), slopes.tolist(), strict=True))


def _released(capacity_kwh: float, step_h: float) -> BatteryLimits:
    """Return linear limits above the nonlinear limits of the ``released`` battery."""
    stored = np.linspace(0.0, capacity_kwh, _STATES)
    energy = {}
    for name, command in (("charge", 1.0), ("discharge", -1.0)):
        point = BatteryPoint(capacity_kwh, _UNLIMITED_KW, step_h)
        step = BATTERIES["released"].step(stored, command, point)
        energy[name] = np.asarray(getattr(step, f"{name}_kwh"))
    # A small load limits the discharge to a share of the load that depends on the stored energy.
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
    """Return up to ``count`` lines whose minimum is above a sampled curve.

    The lines are edges of the curve's upper convex hull, raised above all samples. Between two
    samples, the curve exceeds its chord by at most the largest second difference, which is added as
    a margin.
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
