"""Dynamic programming of model-predictive control: delayed work, and energy stored in batteries.

Both programmes go backwards through the steps of the forecast. The state x is the queue or the
stored energy, on a grid of levels. V(k, x) is the least cost from step k to the end of the
forecast; between levels it is interpolated linearly:

    V(H, x) <- value of the final queue or stored energy           end of the forecast
    for k = H - 1, ..., 1:  V(k, x) <- min over commands of cost(k, x, command) + V(k + 1, x')
    first command: the candidate with the least cost(0) + V(1, x')

The queue programme then goes forwards from the first command and returns the energy that the
facility will need. With a demand charge, each programme runs for several trial peaks. Energy beyond
a trial peak costs the demand charge per kWh, and so does the part of a trial peak that exceeds the
peak of the month to date. ``control/mpc.py`` prepares the inputs.
"""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import part_of
from .compiler.named_kernel import define_kernel
from .planning_arguments import (
    LOWEST_PEAK_SHARE,
    NEGLIGIBLE_SHARE,
    NO_PEAK_KWH,
    QUEUE_ARGUMENTS,
    SECANT_TASKS,
    STORE_ARGUMENTS,
)


@cache
def queue_kernel() -> Any:
    """Return the kernel that plans the work of each data center (QUEUE_ARGUMENTS)."""
    return define_kernel("plan_queues", QUEUE_ARGUMENTS, _queues_of_slice, precision="f64")


@cache
def store_kernel() -> Any:
    """Return the kernel that plans the battery of each data center (STORE_ARGUMENTS)."""
    return define_kernel("plan_stores", STORE_ARGUMENTS, _stores_of_slice, precision="f64")


@ti.func
@no_type_check
def _cost_between(plan: ti.template(), dc, side, place):
    """Return the cost to the end of the forecast at ``place``, interpolated between levels."""
    low = ti.max(ti.min(ti.cast(place, ti.i32), plan.levels - 2), 0)
    share = place - low
    return (1.0 - share) * plan.cost[dc, side, low] + share * plan.cost[dc, side, low + 1]


@ti.func
@no_type_check
def _tried_peak(plan: ti.template(), dc, top_kwh, number):
    """Return trial peak ``number`` of the month, in kWh per step."""
    peak = ti.cast(NO_PEAK_KWH, ti.f64)
    if plan.peaks > 1:
        peak_to_date_kwh = plan.dcs[dc].peak_kwh
        lowest = ti.max(peak_to_date_kwh, LOWEST_PEAK_SHARE * top_kwh)
        top = ti.max(top_kwh, lowest)
        # Space the trial peaks more closely near the top: work and batteries lower a peak little.
        below = ti.cast(plan.peaks - 1 - number, ti.f64) / (plan.peaks - 1)
        peak = top - (top - lowest) * below * below
    return peak


@ti.func
@no_type_check
def _energy_cost(plan: ti.template(), dc, weight, kwh, peak_kwh):
    """Return the cost of the energy of a step, including the energy beyond the trial peak."""
    return weight * kwh + plan.dcs[dc].peak_cost * ti.max(kwh - peak_kwh, 0.0)


@ti.func
@no_type_check
def _charge_for_peak(plan: ti.template(), dc, peak_kwh):
    """Return the demand charge for the part of a peak above the peak of the month to date."""
    cost = ti.cast(0.0, ti.f64)
    if plan.peaks > 1:
        cost = plan.dcs[dc].peak_cost * ti.max(peak_kwh - plan.dcs[dc].peak_kwh, 0.0)
    return cost


@ti.func
@no_type_check
def _queues_of_slice(plan: ti.template(), number):
    """Plan the work of the data centers of a slice."""
    first, end = part_of(number, plan.slices, plan.size)
    for dc in range(first, end):
        top_kwh = ti.cast(0.0, ti.f64)
        for k in range(plan.horizon):
            _read_map(plan, dc, k)
            step = plan.steps[dc * plan.horizon + k]
            neutral = ti.min(step.arrived, step.capacity)
            top_kwh = ti.max(top_kwh, _kwh_of(plan, dc, neutral))
        best, best_peak = ti.cast(ti.math.inf, ti.f64), ti.cast(NO_PEAK_KWH, ti.f64)
        for number_of_peak in range(plan.peaks):
            peak_kwh = _tried_peak(plan, dc, top_kwh, number_of_peak)
            _plan_queue(plan, dc, peak_kwh)
            _read_map(plan, dc, 0)
            charge = _charge_for_peak(plan, dc, peak_kwh)
            least = ti.cast(ti.math.inf, ti.f64)
            at = 0
            for c in range(plan.first_executed.shape[1]):
                cost = _first_queue_cost(plan, dc, c, peak_kwh)
                if c == 0 or cost < least - NEGLIGIBLE_SHARE * ti.abs(least):
                    least, at = cost, c
            if number_of_peak == 0 or charge + least < best:
                best, best_peak = charge + least, peak_kwh
                plan.chosen[dc] = at
        if plan.peaks > 1:
            _plan_queue(plan, dc, best_peak)
        _follow_queue(plan, dc)


@ti.func
@no_type_check
def _first_queue_cost(plan: ti.template(), dc, c, peak_kwh):
    """Return the cost of candidate ``c`` of the first step, including all later steps."""
    of_dc = plan.dcs[dc]
    kwh = _kwh_of(plan, dc, plan.first_executed[dc, c])
    now = _energy_cost(plan, dc, plan.steps[dc * plan.horizon].weight, kwh, peak_kwh)
    late = plan.first_late[dc, c] * of_dc.late_cost
    place = plan.first_waiting[dc, c] / plan.steps[dc * plan.horizon].spacing
    return now + late + _cost_between(plan, dc, 1, place)


@ti.func
@no_type_check
def _plan_queue(plan: ti.template(), dc, peak_kwh):
    """Compute the least cost from each level and step on; side 1 of ``cost`` then holds V(1)."""
    of_dc = plan.dcs[dc]
    _read_map(plan, dc, plan.horizon - 1)
    slope = _kwh_of(plan, dc, of_dc.mean_tasks + SECANT_TASKS)
    slope = (slope - _kwh_of(plan, dc, of_dc.mean_tasks - SECANT_TASKS)) / (2.0 * SECANT_TASKS)
    end_price = of_dc.end_weight * slope
    end = dc * plan.horizon + plan.horizon - 1
    for level in range(plan.levels):
        plan.cost[dc, plan.horizon % 2, level] = end_price * level * plan.steps[end].spacing
    for back in range(1, plan.horizon):
        k = plan.horizon - back
        _read_map(plan, dc, k)
        at = dc * plan.horizon + k
        for level in range(plan.levels):
            least, best = ti.cast(ti.math.inf, ti.f64), 0
            for c in range(plan.commands.shape[0]):
                executed, waiting, late = _work_step(
                    plan, dc, at, plan.commands[c], level * plan.steps[at - 1].spacing
                )
                cost = _energy_cost(
                    plan, dc, plan.steps[at].weight, _kwh_of(plan, dc, executed), peak_kwh
                )
                cost += late * of_dc.late_cost
                place = waiting / plan.steps[at].spacing
                cost += _cost_between(plan, dc, (k + 1) % 2, place)
                if cost < least:
                    least, best = cost, c
            plan.cost[dc, k % 2, level] = least
            plan.policy[dc, k, level] = best


@ti.func
@no_type_check
def _follow_queue(plan: ti.template(), dc):
    """Store work and energy of the facility in each step under the planned commands."""
    chosen = plan.chosen[dc]
    waiting = plan.first_waiting[dc, chosen]
    _read_map(plan, dc, 0)
    plan.executed[dc, 0] = plan.first_executed[dc, chosen]
    plan.facility_kwh[dc, 0] = _kwh_of(plan, dc, plan.first_executed[dc, chosen])
    for k in range(1, plan.horizon):
        _read_map(plan, dc, k)
        at = dc * plan.horizon + k
        place = ti.cast(waiting / plan.steps[at - 1].spacing + 0.5, ti.i32)
        command = plan.commands[plan.policy[dc, k, ti.min(place, plan.levels - 1)]]
        executed, left, _ = _work_step(plan, dc, at, command, waiting)
        waiting = left
        plan.executed[dc, k] = executed
        plan.facility_kwh[dc, k] = _kwh_of(plan, dc, executed)


@ti.func
@no_type_check
def _work_step(plan: ti.template(), dc, at, command, waiting):
    """Return the tasks that a step executes, leaves waiting, and delays too long or drops."""
    step = plan.steps[at]
    due = ti.max(waiting - step.not_due, 0.0)
    forced = ti.min(due, step.most_due)
    capacity, waiting_still = step.capacity - forced, waiting - forced
    now = ti.min(step.arrived - ti.max(-command, 0.0) * step.flexible, capacity)
    held_back = step.arrived - now
    deferred = ti.min(held_back, ti.max(plan.dcs[dc].limit - waiting_still, 0.0))
    most = ti.min(waiting_still, step.most_drained)
    drained = ti.min(most, ti.max(command, 0.0) * (capacity - now))
    late = held_back - deferred + due - forced
    return now + drained + forced, waiting_still + deferred - drained, late


@ti.func
@no_type_check
def _kwh_of(plan: ti.template(), dc, executed):
    """Return the facility energy of a step for its executed work, interpolated in the map."""
    last = plan.kwh.shape[1] - 1
    place = ti.max(executed, 0.0) * 0.01 * last
    low = ti.min(ti.cast(place, ti.i32), last - 1)
    share = place - low
    return (1.0 - share) * plan.kwh[dc, low] + share * plan.kwh[dc, low + 1]


@ti.func
@no_type_check
def _read_map(plan: ti.template(), dc, k):
    """Store the facility energy of step ``k`` at each utilisation of the map in ``plan.kwh``."""
    of_dc, step = plan.dcs[dc], plan.steps[dc * plan.horizon + k]
    number = ti.cast(of_dc.map, ti.i32)
    w, lead = _node(step.weather, plan.table.shape[1])
    d, dry = _node(step.depression, plan.table.shape[2])
    s, setpoint = _node(of_dc.setpoint, plan.table.shape[3])
    for i in range(plan.table.shape[4]):
        total = ti.cast(0.0, ti.f64)
        for x in ti.static(range(2)):
            for y in ti.static(range(2)):
                for z in ti.static(range(2)):
                    share = (
                        (1 - x + (2 * x - 1) * lead)
                        * (1 - y + (2 * y - 1) * dry)
                        * (1 - z + (2 * z - 1) * setpoint)
                    )
                    total += share * plan.table[number, w + x, d + y, s + z, i]
        plan.kwh[dc, i] = total


@ti.func
@no_type_check
def _node(place, count):
    """Return the grid node below ``place``, and the interpolation weight of the next node."""
    low = ti.max(ti.min(ti.cast(place, ti.i32), count - 2), 0)
    return low, place - low


@ti.func
@no_type_check
def _stores_of_slice(plan: ti.template(), number):
    """Plan the batteries of the data centers of a slice."""
    first, end = part_of(number, plan.slices, plan.size)
    for dc in range(first, end):
        top_kwh = ti.cast(0.0, ti.f64)
        for k in range(plan.horizon):
            top_kwh = ti.max(top_kwh, plan.facility_kwh[dc, k])
        best = ti.cast(ti.math.inf, ti.f64)
        for number_of_peak in range(plan.peaks):
            peak_kwh = _tried_peak(plan, dc, top_kwh, number_of_peak)
            _plan_store(plan, dc, peak_kwh)
            charge = _charge_for_peak(plan, dc, peak_kwh)
            for c in range(plan.first_grid.shape[1]):
                now = _energy_cost(plan, dc, plan.weight[dc, 0], plan.first_grid[dc, c], peak_kwh)
                place = plan.first_stored[dc, c] / plan.dcs[dc].spacing
                cost = charge + now + _cost_between(plan, dc, 1, place)
                first_of_all = number_of_peak == 0 and c == 0
                if first_of_all or cost < best - NEGLIGIBLE_SHARE * ti.abs(best):
                    best = cost
                    plan.chosen[dc] = c


@ti.func
@no_type_check
def _plan_store(plan: ti.template(), dc, peak_kwh):
    """Compute the least cost from each level and step on; side 1 of ``cost`` then holds V(1)."""
    of_dc = plan.dcs[dc]
    side = plan.horizon % 2
    for level in range(plan.levels):
        plan.cost[dc, side, level] = -of_dc.end_value * level * of_dc.spacing
    for back in range(1, plan.horizon):
        k = plan.horizon - back
        load_kwh = plan.facility_kwh[dc, k]
        for level in range(plan.levels):
            least = ti.cast(ti.math.inf, ti.f64)
            for c in range(plan.commands.shape[0]):
                drawn, delivered = _battery_step(
                    plan, dc, level, plan.commands[c], load_kwh, peak_kwh
                )
                rise = of_dc.charge_efficiency * (drawn - of_dc.square_per_kwh * drawn * drawn)
                rise -= of_dc.discharge_factor * (
                    delivered + of_dc.square_per_kwh * delivered * delivered
                )
                cost = _energy_cost(
                    plan, dc, plan.weight[dc, k], load_kwh + drawn - delivered, peak_kwh
                )
                cost += _cost_between(plan, dc, (k + 1) % 2, level + rise / of_dc.spacing)
                if cost < least:
                    least = cost
            plan.cost[dc, k % 2, level] = least


@ti.func
@no_type_check
def _battery_step(plan: ti.template(), dc, level, command, load_kwh, peak_kwh):
    """Return the energy that a battery draws and delivers in a step, in kWh.

    The battery also keeps the facility within the grid connection and the trial peak. Commands are
    shares of full power, and no fixed share would follow the load down to a peak.
    """
    limit_kwh = ti.min(plan.dcs[dc].grid_limit, peak_kwh)
    most = ti.min(plan.most_discharge[dc, level], plan.load_share[dc, level] * load_kwh)
    missing = ti.max(load_kwh - limit_kwh, 0.0)
    drawn = ti.min(
        ti.max(command, 0.0) * plan.most_charge[dc, level], ti.max(limit_kwh - load_kwh, 0.0)
    )
    return drawn, ti.max(ti.max(-command, 0.0) * most, ti.min(missing, most))
