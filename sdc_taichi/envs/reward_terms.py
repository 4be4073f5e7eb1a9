"""Reward terms of a step, by name.

Energies, carbon, cost, fossil share and water are divided by the consumption, emissions or bill of
the data center in one step at its design point. These terms are about -1 at full load for every
site and hall. ``sla`` is a share of the work of a full step. The other terms have units: ``pue`` is
a ratio, ``hot_inlets`` is in K, ``queue`` is in tens of tasks, ``dropped`` is in tasks, and
``demand_charge`` has the unit of ``cost``. ``demand_charge`` differs from 0 only in the few steps
that raise the highest power. No term is scaled by data of the run. All terms are at most 0, except
``heat_sales`` and the terms of single agents.

**Terms of single agents.** Carbon emissions depend more on demand and weather than on any action.
The terms ``work_carbon``, ``cooling_carbon`` and ``battery_carbon`` therefore split the carbon of a
step into the parts that each agent can change. In addition, waiting work counts as a debt, and
energy in the battery as a credit, at the mean carbon intensity M of the coming 24 h. If w is the IT
energy of a task at full load, Q the waiting tasks and S the stored energy, the sum of the terms is

    work_carbon + cooling_carbon + battery_carbon
        = -CI (E_grid - w (tasks that arrived - those dropped or lost)) + P' - P,  P = M (S - w Q)

where P' is the value of P at the end of the step. Dropped work, and energy that an outage
withholds, count as if they had been used. P is a potential (Ng, Harada, Russell 1999): its changes
add up to the difference between the two ends of an episode. Without discounting, the policy with
the highest sum of these terms therefore has the lowest emissions. The potential rewards an action
immediately instead of at the end of a cycle. ``work_cost``, ``cooling_cost`` and ``battery_cost``
use prices in place of carbon intensities. M is the mean of the true series, even if agents observe
forecasts with errors.

To add a term, write a function with the decorator ``reward_term``. The function's name is the name
of the term, and the first line of its docstring describes the term in the documentation. Terms are
compiled together, so they may only use arithmetic, the NumPy functions of
``kernels/compiler/stage.py``, and ``np.where`` instead of branches on values. A quantity that is
not in the result of a step needs an attribute or a property of ``TermContext``.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sdc_taichi.control.view import View
from sdc_taichi.errors import ConfigError
from sdc_taichi.plant.battery import conversion
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.drivers import FleetSeries
from sdc_taichi.sim.facility import battery_parameters
from sdc_taichi.types import F64, I64, StepResult
from sdc_taichi.user_functions import is_replacement

CI_G_PER_KWH = 500.0
"""Carbon intensity at which the design energy gives a carbon term of -1, in g CO2e/kWh. It is
typical of a grid that runs on gas."""
FOSSIL_G_PER_KWH = 800.0
"""Carbon intensity of a grid without renewables, in g CO2e/kWh, for the estimate of their share.
The value is between the medians of coal, 820, and gas, 490 (IPCC AR5 WG III annex III)."""
WATER_L_PER_KWH = 1.8
"""Average water use of data centers per kWh of IT (Shehabi et al. 2016, LBNL-1005775)."""
QUEUE_SCALE_TASKS = 10.0
"""Number of queued tasks that gives a queue term of -1 at the end of the day (paper, F.2)."""
PRICE_PER_KWH = 0.1
"""Price per kWh at which the design energy gives a cost term of -1."""
BILL_H = 720.0
"""Length of a billing period of 30 days, in h."""
HIGH_POWER_FACTOR = 40.0
"""Weight of the square of high power in the term ``high_power``.

At three quarters of the design power, a further kWh costs 20 times the demand charge per kW divided
by the hours of a billing period. At a charge of 12 per kW this is 0.33 per kWh.
"""


END_OF_DAY_START_H = 23.0
"""Hour of the day from which the penalty of queued tasks rises (paper, F.1)."""
COMING_H = 24
"""Averaging time of the carbon intensity or price that values waiting work and stored energy, in
h."""


class TermContext:
    """Quantities that reward terms need in addition to the result of the step, (B,) each.

    Args:
        bills: length of the episodes divided by the 30 days of a billing period.
    """

    design_kwh: F64
    """Facility energy of a step at the design point, in kWh."""
    task_kwh: F64
    """IT energy of a task, in kWh; it is 1 % of the IT energy of a step at full load."""
    standby_kwh: F64
    """Energy that the battery draws in a step in any case, but not in an outage, in kWh."""
    demand_charge_per_kw: F64
    """Price per kW of the highest power of a billing period."""
    bills: float
    """Length of the episode divided by the 30 days of a billing period."""
    peak_kw: F64
    """Highest power of the episode before this step, at least half of the design power, in kW."""

    def __init__(self, bills: float) -> None:
        self.bills = bills
        self._index: I64 = np.zeros(0, dtype=np.int64)
        # Pairs of a series and its forward mean, by the name of the series.
        self._means: dict[str, tuple[FleetSeries, FleetSeries]] = {}

    def reset(self, view: View) -> None:
        """Start an episode."""
        per_hour = view.fleet.steps_per_hour
        self._drivers, self._coming_steps = view.drivers, COMING_H * per_hour
        self._weight_of_step = _end_of_day_weight(np.arange(24 * per_hour), view.step_h)
        self.design_kwh = view.sizing.facility_w * view.step_h / 1e3
        self.task_kwh = view.sizing.it_w * view.step_h / (1e3 * TASKS_PER_STEP)
        self.standby_kwh = np.broadcast_to(
            conversion(
                view.fleet.models["battery"],
                battery_parameters(view.fleet),
                view.sizing.battery_kwh,
                view.step_h,
            ).standby_kwh,
            view.size,
        ).copy()
        self.demand_charge_per_kw = view.fleet.values("tariff.demand_charge_per_kw")

    def begin_step(self, step: int, peak_kw: F64) -> None:
        """Set the current step, to which all other attributes then refer.

        Args:
            step: number of the step since reset, from 0.
            peak_kw: highest power of the episode before the step, in kW, (B,).
        """
        self._index, self.peak_kw = self._drivers.start + step, peak_kw

    @property
    def end_of_day_weight(self) -> F64:
        """Weight of queued tasks: 0 before 23:00, then rising to 1 in the last step of the day."""
        return self._weight_of_step[self._index % len(self._weight_of_step)]

    @property
    def coming_ci_before(self) -> F64:
        """Mean carbon intensity of the 24 h from the beginning of the step, in g CO2e/kWh."""
        return self._coming("ci_g_per_kwh").at(self._index)

    @property
    def coming_ci(self) -> F64:
        """Mean carbon intensity of the 24 h from the end of the step, in g CO2e/kWh."""
        return self._coming("ci_g_per_kwh").at(self._index + 1)

    @property
    def coming_price_before(self) -> F64:
        """Mean price of a kWh in the 24 h from the beginning of the step."""
        return self._coming("price_per_kwh").at(self._index)

    @property
    def coming_price(self) -> F64:
        """Mean price of a kWh in the 24 h from the end of the step."""
        return self._coming("price_per_kwh").at(self._index + 1)

    def _coming(self, name: str) -> FleetSeries:
        """Return the forward mean of a series; compute it again if the inputs have changed."""
        series: FleetSeries = getattr(self._drivers, name)
        if name not in self._means or self._means[name][0] is not series:
            self._means[name] = series, coming_means(series, self._coming_steps)
        return self._means[name][1]


Term = Callable[[StepResult, TermContext], F64]
"""A reward term: a function of the result and the context of a step that returns rewards, (B,)."""
TERMS: dict[str, Term] = {}
"""All terms by name."""


def reward_term(function: Term) -> Term:
    """Add a reward term to ``TERMS`` under the name of its function (decorator).

    A function replaces an earlier function of the same module and name, for example when a notebook
    cell runs again.

    Raises:
        ConfigError: the name belongs to a term of another module.
    """
    if not is_replacement(TERMS.get(function.__name__), function):
        raise ConfigError(f"reward term {function.__name__!r}: valid is a name that is not taken")
    TERMS[function.__name__] = function
    return function


@reward_term
def carbon(r: StepResult, c: TermContext) -> F64:
    """Carbon footprint of the step, CFP = (E_it + E_hvac + E_bat) CI (paper, A.3.4)."""
    return -r.carbon_g / (c.design_kwh * CI_G_PER_KWH)


@reward_term
def total_energy(r: StepResult, c: TermContext) -> F64:
    """Energy drawn from the grid, including that of the battery."""
    return -r.grid_kwh / c.design_kwh


@reward_term
def facility_energy(r: StepResult, c: TermContext) -> F64:
    """Energy of IT, HVAC and counted losses (paper, 4.5: r_DC)."""
    return -r.facility_kwh / c.design_kwh


@reward_term
def it_energy(r: StepResult, c: TermContext) -> F64:
    """IT energy."""
    return -r.it_kwh / c.design_kwh


@reward_term
def hvac_energy(r: StepResult, c: TermContext) -> F64:
    """HVAC energy."""
    return -r.hvac_kwh / c.design_kwh


@reward_term
def cost(r: StepResult, c: TermContext) -> F64:
    """Energy cost at the tariff's prices, divided by that of the design energy at 0.1 per kWh."""
    return -r.energy_cost / (PRICE_PER_KWH * c.design_kwh)


@reward_term
def demand_charge(r: StepResult, c: TermContext) -> F64:
    """Demand charge for a rise of the peak power above half the design power, in units of `cost`.

    The charge is multiplied by the length of the episode divided by 30 days. Half of the design
    power is always billed, so it is not part of the reward.
    """
    above_kw = np.maximum(r.grid_kwh / r.step_h - c.peak_kw, 0.0)
    charge = above_kw * c.demand_charge_per_kw * c.bills
    return -charge / (PRICE_PER_KWH * c.design_kwh)


@reward_term
def high_power(r: StepResult, c: TermContext) -> F64:
    """Square of the power above half the design power, a smooth demand charge in units of `cost`.

    The term `demand_charge` differs from 0 only in the few steps that raise the highest power.
    During exploration some step raises it early, and later peaks cost nothing. This term instead
    charges every step for power above half of the design power, at a price that rises with the
    power.
    """
    share = np.maximum(r.grid_kwh / c.design_kwh - 0.5, 0.0)
    hourly = c.demand_charge_per_kw / (PRICE_PER_KWH * BILL_H)
    return -HIGH_POWER_FACTOR * hourly * share * share


@reward_term
def fossil_share(r: StepResult, c: TermContext) -> F64:
    """Fossil part of the grid energy; the renewable share is taken as 1 - CI/(800 g/kWh)."""
    share = np.minimum(r.ci_g_per_kwh / FOSSIL_G_PER_KWH, 1.0)
    return -share * r.grid_kwh / c.design_kwh


@reward_term
def pue(r: StepResult, c: TermContext) -> F64:
    """PUE - 1, the overhead power divided by the IT power; 0 without IT power."""
    return np.where(r.it_w > 0.0, -r.overhead_w / np.where(r.it_w > 0.0, r.it_w, 1.0), 0.0)


@reward_term
def water(r: StepResult, c: TermContext) -> F64:
    """Make-up water, divided by the design energy times 1.8 L/kWh."""
    return -r.water_l / (WATER_L_PER_KWH * c.design_kwh)


@reward_term
def hot_inlets(r: StepResult, c: TermContext) -> F64:
    """Excess of inlets over the recommended 27 C, mean of all servers, in K (ASHRAE TC 9.9)."""
    return -r.over_27_mean_k


@reward_term
def queue(r: StepResult, c: TermContext) -> F64:
    """Queued tasks divided by 10, times a weight rising from 0 at 23:00 to 1 (paper, F.1, F.2)."""
    return -c.end_of_day_weight * r.queue_tasks / QUEUE_SCALE_TASKS


@reward_term
def dropped(r: StepResult, c: TermContext) -> F64:
    """Tasks dropped because the queue was full."""
    return -r.dropped_tasks


@reward_term
def sla(r: StepResult, c: TermContext) -> F64:
    """Work past its deadline, dropped or lost, divided by the work of a step at full load."""
    return -(r.overdue_tasks + r.dropped_tasks + r.lost_tasks) / TASKS_PER_STEP


@reward_term
def throttled_work(r: StepResult, c: TermContext) -> F64:
    """Work that hot or capped GPUs delay, divided by the work of a step at full load."""
    return -r.throttled_tasks / TASKS_PER_STEP


@reward_term
def heat_sales(r: StepResult, c: TermContext) -> F64:
    """Cost of delivered heat: minus its income, in units of `cost`."""
    return r.heat_income / (PRICE_PER_KWH * c.design_kwh)


@reward_term
def work_carbon(r: StepResult, c: TermContext) -> F64:
    """Carbon added by shifting work; waiting work counts at the mean CI of the next 24 h."""
    added_g = _moved_work(r, c, r.ci_g_per_kwh, c.coming_ci_before, c.coming_ci)
    return -added_g / (c.design_kwh * CI_G_PER_KWH)


@reward_term
def cooling_carbon(r: StepResult, c: TermContext) -> F64:
    """Carbon of facility and battery standby minus that of the executed tasks at full load."""
    return -r.ci_g_per_kwh * _beyond_work_kwh(r, c) / (c.design_kwh * CI_G_PER_KWH)


@reward_term
def battery_carbon(r: StepResult, c: TermContext) -> F64:
    """Carbon added by the battery; stored energy counts at the mean CI of the next 24 h."""
    added_g = _stored_energy(r, c, r.ci_g_per_kwh, c.coming_ci_before, c.coming_ci)
    return -added_g / (c.design_kwh * CI_G_PER_KWH)


@reward_term
def work_cost(r: StepResult, c: TermContext) -> F64:
    """Cost added by shifting work, analogous to `work_carbon`, in units of `cost`."""
    added = _moved_work(r, c, r.price_per_kwh, c.coming_price_before, c.coming_price)
    return -added / (c.design_kwh * PRICE_PER_KWH)


@reward_term
def cooling_cost(r: StepResult, c: TermContext) -> F64:
    """Cost of facility and battery standby minus that of the executed tasks, in units of `cost`."""
    return -r.price_per_kwh * _beyond_work_kwh(r, c) / (c.design_kwh * PRICE_PER_KWH)


@reward_term
def battery_cost(r: StepResult, c: TermContext) -> F64:
    """Cost added by the battery, analogous to `battery_carbon`, in units of `cost`."""
    added = _stored_energy(r, c, r.price_per_kwh, c.coming_price_before, c.coming_price)
    return -added / (c.design_kwh * PRICE_PER_KWH)


def _moved_work(r: StepResult, c: TermContext, rate: F64, before: F64, after: F64) -> F64:
    """Compute the carbon or cost added by shifting work in time, (B,).

    The unit is that of ``rate`` times kWh.

    Args:
        r: result of the step.
        c: context of the step.
        rate: carbon intensity or price in the step, per kWh, (B,).
        before: rate that values waiting work at the beginning of the step, (B,).
        after: rate that values waiting work at the end of the step, (B,).
    """
    longer_tasks = r.deferred_tasks - r.drained_tasks - (r.due_tasks - r.overdue_tasks)
    rise = after * r.queue_tasks - before * (r.queue_tasks - longer_tasks)
    return c.task_kwh * (rise - rate * longer_tasks)


def _stored_energy(r: StepResult, c: TermContext, rate: F64, before: F64, after: F64) -> F64:
    """Compute the carbon or cost added by the battery, (B,), in the unit of ``rate`` times kWh.

    Standby is left out, because no command changes it.

    Args:
        r: result of the step.
        c: context of the step.
        rate: carbon intensity or price in the step, per kWh, (B,).
        before: rate that values stored energy at the beginning of the step, (B,).
        after: rate that values stored energy at the end of the step, (B,).
    """
    standby_kwh = c.standby_kwh * r.grid_up
    drawn_kwh = r.charge_kwh - r.discharge_kwh - standby_kwh
    gained_kwh = drawn_kwh - (r.battery_loss_kwh - standby_kwh)
    return rate * drawn_kwh - (after * r.stored_kwh - before * (r.stored_kwh - gained_kwh))


def _beyond_work_kwh(r: StepResult, c: TermContext) -> F64:
    """Return energy of facility and standby minus that of the executed tasks, in kWh, (B,)."""
    return r.facility_kwh + c.standby_kwh * r.grid_up - c.task_kwh * r.executed_tasks


def terms_markdown() -> str:
    """Return the Markdown table of reward terms for docs/environments.md."""
    rows = [f"| `{n}` | {(t.__doc__ or '').split(chr(10))[0]} |" for n, t in TERMS.items()]
    return "\n".join(["| term | negative of |", "|---|---|", *rows])


def _end_of_day_weight(step_of_day: I64, step_h: float) -> F64:
    """Return the weight of queued tasks in each step of the day, 0..1; 1 in the last step."""
    hour, span_h = step_of_day * step_h, 24.0 - step_h - END_OF_DAY_START_H
    weight = (hour - END_OF_DAY_START_H) / span_h if span_h > 0 else np.ones(len(hour))
    return np.where(hour >= END_OF_DAY_START_H, weight, 0.0)


def coming_means(series: FleetSeries, steps: int) -> FleetSeries:
    """Compute the forward moving average of ``steps`` steps.

    Args:
        series: series of each data center. A series repeats after its last value.
        steps: number of averaged steps, the current step included.

    Returns:
        Averages, as many as the series has values.
    """
    distinct, which = series.distinct()
    lengths = np.array([len(values) for values in distinct])
    first_places = np.cumsum(lengths) - lengths
    return FleetSeries(
        values=np.concatenate([_coming_means(values, steps) for values in distinct]),
        offsets=first_places[which],
        lengths=series.lengths,
    )


def _coming_means(values: F64, steps: int) -> F64:
    """Compute the forward moving average from differences of cumulative sums, (T,)."""
    sums: F64 = np.cumsum(np.resize(values, len(values) + steps))
    means: F64 = (sums[steps - 1 : -1] - np.append(0.0, sums[: len(values) - 1])) / steps
    return means
