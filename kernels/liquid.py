"""Liquid-cooled racks, CDUs and facility loop of each data center, in scalar f64.

Heat is given and temperatures float. A sweep goes once downstream:

    racks      power, junction and heat into the coolant at the supply temperature
    CDUs       valves that hold the setpoints at the wanted facility water
    facility   pump, reuse, cooler, trim chiller; what they cannot take warms the water
    racks' supply temperature follows from the facility water and the conductances

Sweeps repeat until the supply stays, since leakage and throttling depend on it; heat is conserved
after any number. In transient halls chips and loops hold heat: each substep advances chips, coolant
and facility water in this order by exact exponentials, with neighbours as before the substep.

``sdc_taichi/sim/liquid.py`` prepares the inputs; docs/liquid.md has the equations.
"""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import part_of
from .compiler.named_kernel import define_kernel
from .decay import decay_series, halvings_for, phi1, power_of_half
from .liquid_arguments import ARGUMENTS

NEWTON_STEPS = 6
"""Most steps of Newton's method for a valve or fan."""
NEWTON_TOLERANCE = 1e-6
"""Relative step with which Newton's method ends; it leaves an error of the square of it."""
SWEEP_TOLERANCE_K = 1e-6
"""Change of supply temperatures at which sweeps end, in K."""
MOST_FLOW = 1.1
"""Largest flow of pumps and of racks, as a share of design."""
LEAST_DRIVE_K = 1e-3
"""Smallest difference of water and air for which a cooler is controlled, in K."""
MOST_TO_DOOR = 0.95
"""Largest share of the heat of a rack that a rear door takes."""
LEAST_COP = 1.25
"""Smallest COP of a heat pump."""
LEAST_LIFT_K = 10.0
"""Smallest difference of sink and source of a heat pump, in K."""


@cache
def liquid_kernel() -> Any:
    """Return the kernel that computes a step of B data centers (ARGUMENTS)."""
    return define_kernel(
        "step_liquid",
        ARGUMENTS,
        _data_centers_of_slice,
        precision="f64",
        constants={"decay_series": decay_series("f64")},
    )


@ti.func
@no_type_check
def _data_centers_of_slice(liquid: ti.template(), number):
    """Compute a step of the data centers of a slice."""
    dc, end = part_of(number, liquid.slices, liquid.manifold_offsets.shape[0] - 1)
    while dc < end:
        if liquid.manifold_offsets[dc] < liquid.manifold_offsets[dc + 1]:
            _begin_step(liquid, dc)
            if ti.static(liquid.transient):
                _advance(liquid, dc)
            else:
                _settle(liquid, dc)
            _finish_step(liquid, dc)
        dc += liquid.one


@ti.func
@no_type_check
def clip(x, low, high):
    """Return x limited to low..high."""
    return ti.min(ti.max(x, low), high)


@ti.func
@no_type_check
def phi(liquid: ti.template(), x):
    """Return (1 - exp(-x)) / x for x >= 0."""
    halvings = halvings_for(liquid, x)
    scale = power_of_half(liquid, halvings)
    return phi1(liquid, x * scale, halvings) * scale


@ti.func
@no_type_check
def power_3_4(x):
    """Return x to the power 3/4."""
    root = ti.sqrt(x)
    return root * ti.sqrt(root)


@ti.func
@no_type_check
def flow_for(liquid: ti.template(), wanted, ua, wall, side, c_s, y_s, c_f, low, high, start):
    """Return the flow ratio of side f at which an exchanger has a wanted conductance, and that one.

    The conductance K is heat per difference of entering temperatures, effectiveness times the
    smaller capacity rate. With D = |1/C_s - 1/C_f|,

        1/K = 1 / (UA phi(UA D)) + min(1/C_s, 1/C_f),
        UA = UA_design / (wall + (1 - wall) (side y_s^-3/4 + (1 - side) y_f^-3/4)),

    which needs no case for equal capacity rates. Newton's method solves for 1/K over 1/y_f, which
    is nearly straight.

    Args:
        liquid: arguments of the kernel.
        wanted: wanted conductance, in W/K.
        ua: UA at design flows, in W/K.
        wall: share of the walls in the resistance at design.
        side: share of side s in the resistance of both films at design.
        c_s: capacity rate of side s, in W/K.
        y_s: flow of side s, as a share of design.
        c_f: capacity rate of side f at design, in W/K.
        low: smallest flow ratio of side f.
        high: largest flow ratio of side f.
        start: estimate of the flow ratio of side f, such as that of the last substep; 0 for none.
    """
    fixed = wall + (1.0 - wall) * side / power_3_4(y_s)
    film = (1.0 - wall) * (1.0 - side)
    per_s, per_f = 1.0 / c_s, 1.0 / c_f
    target = 1.0 / ti.max(wanted, liquid.real(1e-9) * c_f)
    least, most = 1.0 / high, 1.0 / low
    at = c_f * target
    if start > 0.0:
        at = 1.0 / start
    at = clip(at, least, most)
    inverse, step = liquid.real(1.0), 0
    while step <= NEWTON_STEPS:
        power = film * power_3_4(at)
        ua_now = ua / (fixed + power)
        ua_slope = -ua_now * 0.75 * power / ((fixed + power) * at)
        difference, difference_slope, smaller, smaller_slope = (
            per_f * at - per_s,
            per_f,
            per_s,
            liquid.real(0.0),
        )
        if difference < 0.0:
            difference, difference_slope = -difference, -per_f
            smaller, smaller_slope = per_f * at, per_f
        x = ua_now * difference
        value = phi(liquid, x)
        value_slope = -0.5 + x / 3.0
        if x > liquid.real(1e-4):
            value_slope = (1.0 - value) / x - value
        by_films = 1.0 / (ua_now * value)
        x_slope = ua_slope * difference + ua_now * difference_slope
        slope = smaller_slope - by_films * (ua_slope / ua_now + value_slope / value * x_slope)
        inverse = by_films + smaller
        after = clip(at + (target - inverse) / slope, least, most)
        step += liquid.one
        if ti.abs(after - at) <= liquid.real(NEWTON_TOLERANCE) * at:
            # The rest of the way is straight to full precision.
            inverse += slope * (after - at)
            at = after
            step = NEWTON_STEPS + 1
        if step <= NEWTON_STEPS:
            at = after
    return 1.0 / at, 1.0 / inverse


@ti.func
@no_type_check
def relax(liquid: ti.template(), before_c, gain_w, w_per_k, to_c, j_per_k, dt):
    """Return the temperature after C dT/dt = gain - k (T - to), and the mean of k (T - to)."""
    rate = (gain_w - w_per_k * (before_c - to_c)) / j_per_k
    after_c = before_c + rate * dt * phi(liquid, w_per_k * dt / j_per_k)
    return after_c, gain_w - j_per_k * (after_c - before_c) / dt


@ti.func
@no_type_check
def _begin_step(liquid: ti.template(), dc):
    """Set the results that add up over a step to their first values."""
    m, end = liquid.manifold_offsets[dc], liquid.manifold_offsets[dc + 1]
    c = liquid.cdu_offsets[m]
    while c < liquid.cdu_offsets[end]:
        liquid.cdus[c].heat_w = 0.0
        liquid.cdus[c].valve = 0.0
        liquid.cdus[c].valve_now = 0.0
        c += liquid.one
    while m < end:
        on, r = liquid.real(0.0), liquid.rack_offsets[m]
        while r < liquid.rack_offsets[m + 1]:
            rack = liquid.racks[r]
            runs = ti.select(rack.powered > 0.0, liquid.real(1.0), liquid.real(0.0))
            on += runs
            rack.runs = runs
            rack.tripped = 0.0
            rack.it_w = 0.0
            rack.liquid_w = 0.0
            rack.air_w = 0.0
            rack.lost_utilisation = 0.0
            rack.junction_max_c = -1000.0
            r += liquid.one
        liquid.loops[m].on = on
        liquid.loops[m].heat_w = 0.0
        liquid.loops[m].to_air_w = 0.0
        m += liquid.one
    of_dc = liquid.dcs[dc]
    of_dc.cdu_pump_w = 0.0
    of_dc.airflow = 0.0
    _clear_facility(liquid, dc)
    of_dc.stored_w = 0.0
    of_dc.throttle_s = -1.0
    of_dc.trip_s = -1.0
    of_dc.sweeps = 0.0


@ti.func
@no_type_check
def _clear_facility(liquid: ti.template(), dc):
    """Set powers and heat flows of the facility loop to 0."""
    of_dc = liquid.dcs[dc]
    of_dc.facility_pump_w = 0.0
    of_dc.cooler_fan_w = 0.0
    of_dc.cooler_w = 0.0
    of_dc.trim_load_w = 0.0
    of_dc.taken_w = 0.0
    of_dc.heat_pump_w = 0.0
    of_dc.evaporated_w = 0.0


@ti.func
@no_type_check
def _set_flows(liquid: ti.template(), dc):
    """Set flows, pump powers and setpoints of the manifolds, and what racks have at these flows.

    Returns:
        Largest opening of the valves of CDUs, as a share of their largest opening, by the facility
        pumps.
    """
    of_dc = liquid.dcs[dc]
    m, end = liquid.manifold_offsets[dc], liquid.manifold_offsets[dc + 1]
    lowest_c, lowest_of_all_c = liquid.real(1000.0), liquid.real(1000.0)
    water, j_per_m3_k = liquid.real(0.0), of_dc.j_per_m3_k
    while m < end:
        loop = liquid.loops[m]
        first_rack, end_rack = liquid.rack_offsets[m], liquid.rack_offsets[m + 1]
        first_cdu, end_cdu = liquid.cdu_offsets[m], liquid.cdu_offsets[m + 1]
        design, opening, loss = liquid.real(0.0), liquid.real(0.0), liquid.real(0.0)
        r = first_rack
        while r < end_rack:
            rack = liquid.racks[r]
            design += rack.design_m3s
            opening += rack.design_m3s * rack.open * rack.runs
            loss += rack.loss_w_per_k
            r += liquid.one
        up, flow, c = liquid.real(0.0), liquid.real(0.0), first_cdu
        while c < end_cdu:
            up += liquid.cdus[c].up
            c += liquid.one
        c = first_cdu
        while c < end_cdu:
            cdu = liquid.cdus[c]
            most = liquid.real(MOST_FLOW) * cdu.design_m3s * cdu.pumps
            m3s = ti.min(cdu.flow * design / ti.max(up, 1.0), most) * cdu.up
            cdu.m3s = m3s
            flow += m3s
            water += cdu.design_w_per_k * cdu.up
            c += liquid.one
        scale, per_rack = liquid.real(1.0), liquid.real(0.0)
        if flow > liquid.real(MOST_FLOW) * opening:
            scale = liquid.real(MOST_FLOW) * opening / flow
        if opening > 0.0:
            per_rack = scale * flow / opening
        pump_w, pump_heat_w, wanted = liquid.real(0.0), liquid.real(0.0), liquid.real(0.0)
        loop.least_c = 1000.0
        c = first_cdu
        while c < end_cdu:
            cdu = liquid.cdus[c]
            m3s = cdu.m3s * scale
            y = m3s / cdu.design_m3s
            power = cdu.pump_w * y * 0.5 * (y * y + per_rack * per_rack)
            setpoint_c = ti.max(cdu.setpoint_c, of_dc.least_setpoint_c)
            pump_w += power
            pump_heat_w += cdu.fluid_share * power
            wanted += m3s * setpoint_c
            cdu.m3s = m3s
            cdu.w_per_k = m3s * j_per_m3_k
            lowest_of_all_c = ti.min(lowest_of_all_c, setpoint_c)
            if m3s > 0.0:
                loop.least_c = ti.min(loop.least_c, setpoint_c)
            c += liquid.one
        lowest_c = ti.min(lowest_c, loop.least_c)
        loop.flow_per_rack = per_rack
        loop.loss_w_per_k = loss
        loop.pump_w = pump_w
        loop.pump_heat_w = pump_heat_w
        loop.w_per_k = scale * flow * j_per_m3_k
        loop.wanted_c = 0.0
        if scale * flow > 0.0:
            loop.wanted_c = wanted / (scale * flow)
        r = first_rack
        while r < end_rack:
            rack = liquid.racks[r]
            m3s = per_rack * rack.design_m3s * rack.open * rack.runs
            rack.m3s = m3s
            rack.r_k_per_w = 0.0
            if m3s > 0.0:
                rack.r_k_per_w = rack.r_fixed_k_per_w + rack.r_film_k_m3s_per_w / m3s
            r += liquid.one
        m += liquid.one
    if lowest_c > 999.0:
        lowest_c = lowest_of_all_c
    of_dc.facility_setpoint_c = ti.max(lowest_c - of_dc.approach_k, of_dc.least_water_c)
    return of_dc.facility_pump * ti.min(1.0, of_dc.water_w_per_k / ti.max(water, 1.0))


@ti.func
@no_type_check
def _trips_by_flow(liquid: ti.template(), r):
    """Return whether the coolant of a rack with power flows too slowly."""
    rack = liquid.racks[r]
    least = (rack.trip_flow - liquid.real(1e-6)) * rack.design_m3s
    return rack.runs > 0.0 and rack.m3s < least


@ti.func
@no_type_check
def _trip(liquid: ti.template(), dc, r, time_s):
    """Switch a rack off for the rest of the step."""
    liquid.racks[r].runs = 0.0
    liquid.racks[r].tripped = 1.0
    if liquid.dcs[dc].trip_s < 0.0:
        liquid.dcs[dc].trip_s = time_s


@ti.func
@no_type_check
def _door_share(liquid: ti.template(), dc, r, power_w):
    """Return the share of the heat that a rear door takes with coolant at room temperature.

    It is the effectiveness, or less where the coolant flows so slowly that it leaves as warm as the
    air of the servers.
    """
    rack = liquid.racks[r]
    rate = rack.m3s * liquid.dcs[dc].j_per_m3_k
    of_air = ti.max(power_w * rack.per_door_rise, liquid.real(1e-9))
    return ti.min(rack.door_effectiveness, rate / of_air)


@ti.func
@no_type_check
def _air_servers(liquid: ti.template(), dc, r, supply_c):
    """Return power without GPUs, and the part of it that the coolant takes, in W.

    A rear door takes share (1 + (T_room - T_supply) / rise) of the heat.
    """
    rack = liquid.racks[r]
    u = rack.utilisation
    cpus_w = rack.cpus_idle_w + rack.cpus_span_w * u
    other_w = rack.other_idle_w + rack.other_span_w * u
    capture = rack.capture_other
    if rack.door_effectiveness > 0.0:
        warmer = (liquid.dcs[dc].room_c - supply_c) * rack.per_door_rise
        capture = _door_share(liquid, dc, r, other_w) * (1.0 + warmer)
        capture = clip(capture, liquid.real(0.0), liquid.real(MOST_TO_DOOR))
    return cpus_w + other_w, rack.capture_chip * cpus_w + capture * other_w


@ti.func
@no_type_check
def _clock(liquid: ti.template(), power_w, free_w, idle_w):
    """Return the clock of GPUs, whose dynamic power is proportional to its cube."""
    share = clip((power_w - idle_w) / ti.max(free_w - idle_w, 1.0), 0.0, 1.0)
    return ti.pow(share, liquid.real(1.0 / 3.0))


@ti.func
@no_type_check
def _cap_w(liquid: ti.template(), dc, r):
    """Return the largest power of a GPU of a rack, in W."""
    cap, rack = liquid.dcs[dc].power_cap, liquid.racks[r]
    most_w = liquid.real(1e30)
    if cap < 1.0:
        most_w = ti.max(cap * rack.gpu_max_w, rack.gpu_idle_w)
    return most_w


@ti.func
@no_type_check
def _rack_at_rest(liquid: ti.template(), dc, r, supply_c):
    """Compute power, heat into the coolant and junction of a rack in steady state.

    Racks without GPUs have a junction of 0. A GPU draws p0 (1 + leak (T_junction - T_ref)); solved
    for the power,

        p = p0 (1 + leak (T_supply - T_ref)) / (1 - leak p0 R),   T_junction = T_supply + R p,

    with R per W of GPU power. Throttling limits p to (T_limit - T_supply) / R.
    """
    rack = liquid.racks[r]
    rest_w, rest_to_liquid_w = _air_servers(liquid, dc, r, supply_c)
    u, idle_w, resistance = rack.utilisation, rack.gpu_idle_w, rack.capture_chip * rack.r_k_per_w
    gpus_w, lost = liquid.real(0.0), liquid.real(0.0)
    junction_c = ti.select(rack.gpus > 0.0, supply_c, liquid.real(0.0))
    if rack.gpus > 0.0 and rack.runs > 0.0:
        base_w = idle_w + rack.gpu_span_w * u
        leak_w_per_k = rack.leak_per_k * base_w
        rest = ti.max(1.0 - leak_w_per_k * resistance, liquid.real(0.05))
        free_w = ti.max(base_w + leak_w_per_k * (supply_c - rack.leak_ref_c), 0.0) / rest
        most_w = ti.max((rack.throttle_c - supply_c) / resistance, idle_w)
        if free_w > most_w and liquid.dcs[dc].throttle_s < 0.0:
            liquid.dcs[dc].throttle_s = 0.0
        power_w = ti.min(free_w, ti.min(most_w, _cap_w(liquid, dc, r)))
        if power_w < free_w:
            lost = u * (1.0 - _clock(liquid, power_w, free_w, idle_w))
        junction_c = supply_c + power_w * resistance
        gpus_w = rack.gpus * power_w
    powered = rack.powered * rack.runs
    rack.it_w = powered * (gpus_w + rest_w)
    rack.liquid_w = powered * (rack.capture_chip * gpus_w + rest_to_liquid_w)
    rack.junction_c = junction_c
    rack.junction_max_c = junction_c
    rack.lost_utilisation = powered * lost


@ti.func
@no_type_check
def _settle(liquid: ti.template(), dc):
    """Compute the steady state of a data center."""
    of_dc = liquid.dcs[dc]
    first, end = liquid.manifold_offsets[dc], liquid.manifold_offsets[dc + 1]
    most_open, tripped, m = liquid.real(0.0), 1, first
    while tripped > 0:
        # The valves of racks that have tripped are shut.
        most_open = _set_flows(liquid, dc)
        tripped = 0
        r = liquid.rack_offsets[first]
        while r < liquid.rack_offsets[end]:
            # Without facility water the racks that need coolant are off.
            needs = liquid.racks[r].runs > 0.0 and liquid.racks[r].trip_flow > 0.0
            if needs and (most_open <= 0.0 or _trips_by_flow(liquid, r)):
                _trip(liquid, dc, r, liquid.real(0.0))
                tripped += 1
            r += liquid.one
    while m < end:
        liquid.loops[m].at_c = of_dc.room_c
        if liquid.loops[m].w_per_k > 0.0:
            liquid.loops[m].at_c = liquid.loops[m].wanted_c
        of_dc.cdu_pump_w = of_dc.cdu_pump_w + liquid.loops[m].pump_w
        m += liquid.one
    wanted_water_c = of_dc.facility_setpoint_c
    sweep, change_k, excess_k = 0, liquid.real(1.0), liquid.real(0.0)
    while sweep < liquid.most_sweeps and change_k > liquid.real(SWEEP_TOLERANCE_K):
        of_dc.throttle_s = -1.0
        heat_w, water = liquid.real(0.0), liquid.real(0.0)
        m = first
        while m < end:
            water += _settle_manifold(liquid, dc, m, most_open, wanted_water_c, excess_k)
            heat_w += liquid.loops[m].heat_w
            m += liquid.one
        supply_c = _settle_facility(liquid, dc, heat_w, water, wanted_water_c)
        excess_k = supply_c - wanted_water_c
        change_k = 0.0
        m = first
        while m < end:
            change_k = ti.max(change_k, _set_supply(liquid, m, supply_c, sweep))
            m += liquid.one
        sweep += liquid.one
    of_dc.sweeps = sweep


@ti.func
@no_type_check
def _settle_manifold(liquid: ti.template(), dc, m, most_open, wanted_water_c, excess_k):
    """Compute racks and CDUs of a manifold at its present supply temperature.

    Facility water was warmer than wanted by ``excess_k`` in the last sweep.

    Returns:
        Capacity rate of the facility water through its CDUs, in W/K.
    """
    loop, of_dc = liquid.loops[m], liquid.dcs[dc]
    supply_c, rate, loss = loop.at_c, loop.w_per_k, loop.loss_w_per_k
    gain_w, slope, r = loop.pump_heat_w, liquid.real(0.0), liquid.rack_offsets[m]
    while r < liquid.rack_offsets[m + 1]:
        rack = liquid.racks[r]
        _rack_at_rest(liquid, dc, r, supply_c)
        gain_w += rack.liquid_w
        if rack.door_effectiveness > 0.0 and rack.liquid_w > 0.0:
            slope += rack.it_w * rack.per_door_rise * _door_share(liquid, dc, r, rack.it_w)
        r += liquid.one
    room_c = of_dc.room_c
    return_c = (rate * supply_c + gain_w + loss * room_c) / (rate + loss)
    heat_w = gain_w - loss * (return_c - room_c)
    # CDUs cannot make coolant colder than ``least_c``. Where pipes lose all heat at this supply,
    # none is left for facility water. Rear doors give less heat to warmer coolant, by ``slope``.
    least_c = loop.least_c + excess_k
    at_least_w = gain_w - slope * ti.max(least_c - supply_c, 0.0)
    back_c = (rate * least_c + at_least_w + loss * room_c) / (rate + loss)
    is_cooled = rate > 0.0 and most_open > 0.0
    if not is_cooled or heat_w <= 0.0 or at_least_w <= loss * (back_c - room_c):
        return_c = room_c + gain_w / loss
        heat_w = 0.0
    loop.uncooled_c = room_c + (gain_w - slope * (room_c - supply_c)) / (loss + slope)
    loop.return_c = return_c
    loop.heat_w = heat_w
    loop.to_air_w = loss * (return_c - room_c) + loop.pump_w - loop.pump_heat_w
    return _set_valves(liquid, dc, m, most_open, wanted_water_c)


@ti.func
@no_type_check
def _set_valves(liquid: ti.template(), dc, m, most_open, water_c):
    """Set the valves of the CDUs of a manifold for its heat and the wanted facility water.

    Returns:
        Capacity rate of the facility water, in W/K.
    """
    loop, of_dc = liquid.loops[m], liquid.dcs[dc]
    first, end = liquid.cdu_offsets[m], liquid.cdu_offsets[m + 1]
    c = first
    while c < end:
        liquid.cdus[c].is_full = 0.0
        c += liquid.one
    k_sum, water, passes = liquid.real(0.0), liquid.real(0.0), 0
    last = _no_valve(liquid)
    # A CDU whose valve is fully open may give less heat to the facility water than its setpoint
    # needs; the other CDUs of the manifold then give the rest.
    while passes < 3:
        return_c = _wanted_return_c(liquid, dc, m, water_c)
        k_sum, water, c = 0.0, 0.0, first
        passes += 3
        while c < end:
            cdu = liquid.cdus[c]
            if cdu.is_full == 0.0:
                setpoint_c = ti.max(cdu.setpoint_c, of_dc.least_setpoint_c)
                wanted = liquid.real(0.0)
                if loop.heat_w > 0.0:
                    cooled_k = ti.max(return_c - setpoint_c, 0.0)
                    wanted = cdu.w_per_k * cooled_k / (return_c - water_c)
                valve, k = _cdu_valve(liquid, c, wanted, most_open, last)
                cdu.valve = valve
                cdu.k_w_per_k = k
                if end - first > 1 and k < wanted * liquid.real(1.0 - 1e-6):
                    cdu.is_full = 1.0
                    passes = ti.min(passes, 2)
            k_sum += cdu.k_w_per_k
            water += cdu.valve * cdu.design_w_per_k
            c += liquid.one
    loop.k_w_per_k = k_sum
    return water


@ti.func
@no_type_check
def _wanted_return_c(liquid: ti.template(), dc, m, water_c):
    """Return the return temperature at which CDUs at their setpoints take the heat, in C.

    Those whose valve is fully open take K (T_return - T_water); those whose setpoint is above the
    return take nothing.
    """
    return_c, before, count = liquid.real(1000.0), -1, 0
    while count != before:
        before = count
        heat_w, w_per_k, c = liquid.loops[m].heat_w, liquid.real(0.0), liquid.cdu_offsets[m]
        count = 0
        while c < liquid.cdu_offsets[m + 1]:
            cdu = liquid.cdus[c]
            setpoint_c = ti.max(cdu.setpoint_c, liquid.dcs[dc].least_setpoint_c)
            if cdu.is_full > 0.0:
                w_per_k += cdu.k_w_per_k
                heat_w += cdu.k_w_per_k * water_c
            elif cdu.w_per_k > 0.0 and setpoint_c < return_c:
                w_per_k += cdu.w_per_k
                heat_w += cdu.w_per_k * setpoint_c
                count += 1
            c += liquid.one
        if w_per_k > 0.0:
            return_c = heat_w / w_per_k
    return return_c


@ti.func
@no_type_check
def _no_valve(liquid: ti.template()):
    """Return the struct of the last valve that has been found, before any of a manifold."""
    none = liquid.real(-1.0)
    return ti.Struct(wanted=none, w_per_k=none, valve=none, k=none)


@ti.func
@no_type_check
def _cdu_valve(liquid: ti.template(), c, wanted, most_open, last: ti.template()):
    """Return the flow ratio of the facility water of a CDU, and its conductance in W/K.

    They are those of ``last``, a valve of the same manifold, if both CDUs are alike.
    """
    cdu = liquid.cdus[c]
    if cdu.alike == 0.0 or wanted != last.wanted or cdu.w_per_k != last.w_per_k:
        valve, k = liquid.real(0.0), liquid.real(0.0)
        high = cdu.max_valve * most_open
        low = ti.min(cdu.min_valve, high)
        if cdu.w_per_k > 0.0 and high > 0.0:
            valve, k = flow_for(
                liquid,
                wanted,
                cdu.ua_w_per_k,
                cdu.wall_share,
                cdu.side_share,
                cdu.w_per_k,
                cdu.w_per_k / cdu.design_w_per_k,
                cdu.design_w_per_k,
                low,
                high,
                cdu.valve_now,
            )
            # At its smallest flow a bypass keeps the coolant from becoming too cold.
            if valve < low * liquid.real(1.0 + 1e-9):
                k = ti.min(k, wanted)
        cdu.valve_now = valve
        last.wanted, last.w_per_k, last.valve, last.k = wanted, cdu.w_per_k, valve, k
    return last.valve, last.k


@ti.func
@no_type_check
def _set_supply(liquid: ti.template(), m, water_c, sweep):
    """Set the supply of a manifold and results of its CDUs; return the change of the supply in K.

    All CDUs get the same return: Q = K (T_return - T_water) for each and for their sum. The next
    sweep starts from the supply at which the changes of the last two sweeps, continued in a
    straight line, become 0, or between supplies that became warmer and colder if it lies outside.
    """
    loop = liquid.loops[m]
    after_c, before_c = loop.uncooled_c, loop.at_c
    if loop.heat_w > 0.0 and loop.k_w_per_k > 0.0:
        loop.return_c = water_c + loop.heat_w / loop.k_w_per_k
        after_c = loop.return_c - loop.heat_w / loop.w_per_k
    change_k = after_c - before_c
    if sweep == 0:
        loop.low_c = -1000.0
        loop.high_c = 1000.0
    if change_k > 0.0:
        loop.low_c = before_c
    else:
        loop.high_c = before_c
    next_c, moved_k = after_c, before_c - loop.last_c
    if sweep > 0 and ti.abs(moved_k) > liquid.real(1e-9):
        slope = ti.min((change_k - loop.change_k) / moved_k, liquid.real(-0.125))
        next_c = before_c - change_k / slope
    if next_c <= loop.low_c or next_c >= loop.high_c:
        next_c = ti.select(
            loop.low_c > -999.0 and loop.high_c < 999.0, 0.5 * (loop.low_c + loop.high_c), next_c
        )
    loop.last_c = before_c
    loop.change_k = change_k
    loop.at_c = next_c
    loop.supply_c = after_c
    c = liquid.cdu_offsets[m]
    while c < liquid.cdu_offsets[m + 1]:
        cdu = liquid.cdus[c]
        cdu.heat_w = cdu.k_w_per_k * (loop.return_c - water_c)
        cdu.supply_c = loop.return_c
        if cdu.w_per_k > 0.0:
            cdu.supply_c = loop.return_c - cdu.heat_w / cdu.w_per_k
        c += liquid.one
    return ti.abs(change_k)


@ti.func
@no_type_check
def _facility_pump_w(liquid: ti.template(), dc, water):
    """Return the power of the facility pumps at a capacity rate of the water, in W."""
    of_dc = liquid.dcs[dc]
    speed = ti.max(water / of_dc.water_w_per_k, of_dc.min_pump)
    power_w = of_dc.design_pump_w * speed * speed * speed
    return ti.select(water > 0.0, power_w, liquid.real(0.0))


@ti.func
@no_type_check
def _reuse(liquid: ti.template(), dc, water, into_c, heat_w):
    """Return the heat that reuse takes from the water and the power of the heat pump, in W.

    Direct reuse takes share x effectiveness x C (T_in - T_network); a heat pump takes the share of
    all heat. Its COP is that of a Lorenz process between mean temperatures times a constant:
    COP = lorenz T_sink / (T_sink - T_source). The heat delivered is at most the demand.
    """
    of_dc = liquid.dcs[dc]
    taken_w, power_w = liquid.real(0.0), liquid.real(0.0)
    if of_dc.reuse_kind == 1.0:
        offered_w = of_dc.reuse_effectiveness * water * (into_c - of_dc.network_return_c)
        taken_w = of_dc.reuse_share * clip(offered_w, liquid.real(0.0), heat_w)
        taken_w = ti.min(taken_w, of_dc.reuse_demand_w)
    elif of_dc.reuse_kind == 2.0:
        most_w = of_dc.reuse_share * heat_w
        taken_w = most_w
        pass_ = 0
        # After an odd number of passes the heat delivered is below the demand.
        while pass_ < 3:
            source_c = into_c - 0.5 * taken_w / water - of_dc.pinch_k
            cop = of_dc.lorenz_k / ti.max(of_dc.sink_c - source_c, LEAST_LIFT_K)
            cop = ti.max(cop, LEAST_COP)
            power_w = taken_w / (cop - 1.0)
            if taken_w + power_w > of_dc.reuse_demand_w or taken_w < most_w:
                taken_w = ti.min(most_w, of_dc.reuse_demand_w * (1.0 - 1.0 / cop))
                power_w = taken_w / (cop - 1.0)
            pass_ += liquid.one
    return taken_w, power_w


@ti.func
@no_type_check
def _cooler(liquid: ti.template(), dc, water, into_c, heat_w):
    """Return how the cooler takes heat from water that enters at ``into_c``.

    The fans run as slowly as the heat allows. Pads are wet only if dry air at the highest speed
    cannot take the heat; the trim chiller takes what the cooler cannot.
    """
    of_dc = liquid.dcs[dc]
    air_c, fastest = of_dc.dry_c, ti.max(of_dc.cooler_share, of_dc.min_fan)
    z, k, drive_k = liquid.real(0.0), liquid.real(0.0), liquid.real(1.0)
    wets = 0
    while wets < 2:
        drive_k = ti.max(into_c - air_c, liquid.real(LEAST_DRIVE_K))
        wanted = heat_w / drive_k
        z, k = flow_for(
            liquid,
            wanted,
            of_dc.cooler_ua_w_per_k,
            of_dc.cooler_wall_share,
            of_dc.cooler_side_share,
            water,
            water / of_dc.water_w_per_k,
            of_dc.cooler_air_w_per_k,
            of_dc.min_fan,
            fastest,
            of_dc.airflow,
        )
        of_dc.airflow = z
        wets += 2
        if k < wanted * liquid.real(1.0 - 1e-6) and of_dc.wet_c < air_c:
            air_c = of_dc.wet_c
            wets = 1
        k = ti.min(k, wanted)
    if into_c <= air_c and heat_w <= of_dc.trim_w:
        # Warmer air would only add heat: the water bypasses the cooler.
        z, k = liquid.real(0.0), liquid.real(0.0)
    trim_w = clip(heat_w - k * drive_k, liquid.real(0.0), of_dc.trim_w)
    return air_c, z, k, trim_w


@ti.func
@no_type_check
def _fan_w(liquid: ti.template(), dc, z):
    """Return the power of the fans of the cooler at an airflow ratio, in W; fewer run faster."""
    of_dc = liquid.dcs[dc]
    share = ti.max(of_dc.cooler_share, of_dc.min_fan)
    power_w = of_dc.fan_w * z * z * z / (share * share)
    return ti.select(of_dc.cooler_share > 0.0, power_w, liquid.real(0.0))


@ti.func
@no_type_check
def _add_facility(
    liquid: ti.template(), dc, part, water, cooler_w, trim_w, taken_w, heat_pump_w, z, air_c
):
    """Add powers and heat of a part of the step to the results of the facility."""
    of_dc = liquid.dcs[dc]
    of_dc.facility_pump_w = of_dc.facility_pump_w + part * _facility_pump_w(liquid, dc, water)
    of_dc.cooler_fan_w = of_dc.cooler_fan_w + part * _fan_w(liquid, dc, z)
    of_dc.cooler_w = of_dc.cooler_w + part * cooler_w
    of_dc.trim_load_w = of_dc.trim_load_w + part * trim_w
    of_dc.taken_w = of_dc.taken_w + part * taken_w
    of_dc.heat_pump_w = of_dc.heat_pump_w + part * heat_pump_w
    evaporated_w = of_dc.cooler_air_w_per_k * z * (of_dc.dry_c - air_c)
    of_dc.evaporated_w = of_dc.evaporated_w + part * evaporated_w


@ti.func
@no_type_check
def _settle_facility(liquid: ti.template(), dc, heat_w, water, wanted_c):
    """Compute pump, reuse, cooler and trim chiller; return the facility water's supply in C."""
    of_dc = liquid.dcs[dc]
    _clear_facility(liquid, dc)
    supply_c, return_c = wanted_c, wanted_c
    if water > 0.0:
        all_w = heat_w + of_dc.facility_fluid_share * _facility_pump_w(liquid, dc, water)
        into_c = wanted_c + all_w / water
        taken_w, heat_pump_w = _reuse(liquid, dc, water, into_c, all_w)
        to_cooler_w = all_w - taken_w
        into_c -= taken_w / water
        air_c, z, k, trim_w = _cooler(liquid, dc, water, into_c, to_cooler_w)
        cooler_w = to_cooler_w - trim_w
        # Heat that neither cooler nor trim chiller takes warms the water. A bypass of the cooler
        # keeps the water from becoming colder than its setpoint.
        if k > 0.0:
            into_c = ti.max(into_c, air_c + cooler_w / k)
        supply_c = into_c - to_cooler_w / water
        return_c = supply_c + all_w / water
        _add_facility(liquid, dc, 1.0, water, cooler_w, trim_w, taken_w, heat_pump_w, z, air_c)
    of_dc.water_supply_c = supply_c
    of_dc.water_return_c = return_c
    return supply_c


@ti.func
@no_type_check
def _advance(liquid: ti.template(), dc):
    """Advance a data center by the substeps of a step."""
    of_dc = liquid.dcs[dc]
    count = ti.cast(of_dc.substeps, ti.i32)
    dt, part, most_open = liquid.step_s / count, 1.0 / of_dc.substeps, liquid.real(0.0)
    i, trips = 0, 1
    while i < count:
        if trips > 0:
            most_open = _set_flows(liquid, dc)
            _set_decays(liquid, dc, dt)
        i += liquid.one
        trips = _substep(liquid, dc, most_open, dt, part, dt * i)
    of_dc.sweeps = count


@ti.func
@no_type_check
def _set_decays(liquid: ti.template(), dc, dt):
    """Set conductances of the chips, and how far a power warms them in a substep."""
    r = liquid.rack_offsets[liquid.manifold_offsets[dc]]
    while r < liquid.rack_offsets[liquid.manifold_offsets[dc + 1]]:
        rack = liquid.racks[r]
        if rack.gpus > 0.0:
            k, j_per_k = rack.stagnant_w_per_k, rack.chips_j_per_k
            if rack.m3s > 0.0:
                k = rack.gpus / rack.r_k_per_w
            rack.k_w_per_k = k
            rack.k_per_w = dt / j_per_k * phi(liquid, k * dt / j_per_k)
        r += liquid.one


@ti.func
@no_type_check
def _substep(liquid: ti.template(), dc, most_open, dt, part, time_s):
    """Advance chips, coolant and facility water by a substep; return the number of trips."""
    of_dc = liquid.dcs[dc]
    first, end = liquid.manifold_offsets[dc], liquid.manifold_offsets[dc + 1]
    water_c, room_c, trips = of_dc.water_supply_c, of_dc.room_c, 0
    heat_w, water, m = liquid.real(0.0), liquid.real(0.0), first
    while m < end:
        loop = liquid.loops[m]
        supply_c, return_c, gain_w = loop.supply_c, loop.return_c, loop.pump_heat_w
        r = liquid.rack_offsets[m]
        while r < liquid.rack_offsets[m + 1]:
            gain_w += _advance_rack(liquid, dc, r, supply_c, dt, part, time_s)
            if liquid.racks[r].runs > 0.0 and (
                _trips_by_flow(liquid, r) or liquid.racks[r].junction_c > liquid.racks[r].trip_c
            ):
                _trip(liquid, dc, r, time_s)
                trips += 1
            r += liquid.one
        k_sum, c, last = liquid.real(0.0), liquid.cdu_offsets[m], _no_valve(liquid)
        while c < liquid.cdu_offsets[m + 1]:
            cdu = liquid.cdus[c]
            setpoint_c = ti.max(cdu.setpoint_c, of_dc.least_setpoint_c)
            wanted = (
                cdu.w_per_k
                * (return_c - setpoint_c)
                / ti.max(return_c - water_c, liquid.real(1e-9))
            )
            valve, k = _cdu_valve(liquid, c, ti.max(wanted, 0.0), most_open, last)
            cdu.k_w_per_k = k
            cdu.valve = cdu.valve + part * valve
            k_sum += k
            water += valve * cdu.design_w_per_k
            c += liquid.one
        loss = loop.loss_w_per_k
        k = k_sum + loss
        to_c = (k_sum * water_c + loss * room_c) / k
        after_c, out_w = relax(liquid, return_c, gain_w, k, to_c, loop.loop_j_per_k, dt)
        mean_c = to_c + out_w / k
        to_water_w = k_sum * (mean_c - water_c)
        heat_w += to_water_w
        of_dc.stored_w = of_dc.stored_w + part * loop.loop_j_per_k * (after_c - return_c) / dt
        loop.heat_w = loop.heat_w + part * to_water_w
        loop.to_air_w = loop.to_air_w + part * (out_w - to_water_w + loop.pump_w - loop.pump_heat_w)
        of_dc.cdu_pump_w = of_dc.cdu_pump_w + part * loop.pump_w
        c = liquid.cdu_offsets[m]
        while c < liquid.cdu_offsets[m + 1]:
            cdu = liquid.cdus[c]
            cdu.heat_w = cdu.heat_w + part * cdu.k_w_per_k * (mean_c - water_c)
            cdu.supply_c = after_c
            if cdu.w_per_k > 0.0:
                cdu.supply_c = cdu.supply_c - cdu.k_w_per_k * (after_c - water_c) / cdu.w_per_k
            c += liquid.one
        loop.return_c = after_c
        if loop.w_per_k > 0.0:
            left_c = after_c - k_sum * (after_c - water_c) / loop.w_per_k
            lag = dt * loop.w_per_k / (0.5 * loop.loop_j_per_k)
            loop.supply_c = supply_c + (left_c - supply_c) * lag * phi(liquid, lag)
        m += liquid.one
    _advance_facility(liquid, dc, heat_w, water, dt, part)
    return trips


@ti.func
@no_type_check
def _advance_rack(liquid: ti.template(), dc, r, supply_c, dt, part, time_s):
    """Advance the chips of a rack by a substep; return its mean heat into the coolant, in W.

    Throttling limits the power to that at which the junction ends the substep at its limit.
    """
    rack, of_dc = liquid.racks[r], liquid.dcs[dc]
    rest_w, to_liquid_w = _air_servers(liquid, dc, r, supply_c)
    powered, u = rack.powered * rack.runs, rack.utilisation
    rest_w, to_liquid_w = powered * rest_w, powered * to_liquid_w
    air_w = rest_w - to_liquid_w
    it_w, junction_c = rest_w, liquid.real(0.0)
    if rack.gpus > 0.0:
        before_c, capture, idle_w = rack.junction_c, rack.capture_chip, rack.gpu_idle_w
        to_coolant_w = rack.k_w_per_k * (before_c - supply_c)
        gpus_w = liquid.real(0.0)
        if powered > 0.0:
            base_w = idle_w + rack.gpu_span_w * u
            leakage = ti.max(1.0 + rack.leak_per_k * (before_c - rack.leak_ref_c), 0.0)
            free_w = base_w * leakage
            at_limit_w = to_coolant_w + (rack.throttle_c - before_c) / rack.k_per_w
            most_w = ti.max(at_limit_w / (capture * powered * rack.gpus), idle_w)
            if free_w > most_w and of_dc.throttle_s < 0.0:
                of_dc.throttle_s = time_s
            power_w = ti.min(free_w, ti.min(most_w, _cap_w(liquid, dc, r)))
            if power_w < free_w:
                clock = _clock(liquid, power_w, free_w, idle_w)
                rack.lost_utilisation = rack.lost_utilisation + part * powered * u * (1.0 - clock)
            gpus_w = powered * rack.gpus * power_w
        gain_w = capture * gpus_w
        junction_c = before_c + (gain_w - to_coolant_w) * rack.k_per_w
        stored_w = rack.chips_j_per_k * (junction_c - before_c) / dt
        of_dc.stored_w = of_dc.stored_w + part * stored_w
        to_liquid_w += gain_w - stored_w
        air_w += gpus_w - gain_w
        it_w += gpus_w
    rack.it_w = rack.it_w + part * it_w
    rack.liquid_w = rack.liquid_w + part * to_liquid_w
    rack.air_w = rack.air_w + part * air_w
    rack.junction_c = junction_c
    rack.junction_max_c = ti.max(rack.junction_max_c, junction_c)
    return to_liquid_w


@ti.func
@no_type_check
def _advance_facility(liquid: ti.template(), dc, heat_w, water, dt, part):
    """Advance the facility water by a substep."""
    of_dc = liquid.dcs[dc]
    before_c, setpoint_c = of_dc.water_return_c, of_dc.facility_setpoint_c
    gain_w = heat_w + of_dc.facility_fluid_share * _facility_pump_w(liquid, dc, water)
    taken_w, heat_pump_w, trim_w = liquid.real(0.0), liquid.real(0.0), liquid.real(0.0)
    air_c, z, k, cooled_k = of_dc.dry_c, liquid.real(0.0), liquid.real(0.0), liquid.real(0.0)
    if water > 0.0:
        wanted_w = ti.max(water * (before_c - setpoint_c), 0.0)
        taken_w, heat_pump_w = _reuse(liquid, dc, water, before_c, wanted_w)
        cooled_k = taken_w / water
        air_c, z, k, trim_w = _cooler(liquid, dc, water, before_c - cooled_k, wanted_w - taken_w)
    after_c, cooler_w = relax(
        liquid,
        before_c,
        gain_w - taken_w - trim_w,
        k,
        air_c + cooled_k,
        of_dc.water_j_per_k,
        dt,
    )
    of_dc.stored_w = of_dc.stored_w + part * of_dc.water_j_per_k * (after_c - before_c) / dt
    if water > 0.0:
        at_end_w = taken_w + trim_w + k * (after_c - cooled_k - air_c)
        left_c = after_c - at_end_w / water
        lag = dt * water / (0.5 * of_dc.water_j_per_k)
        of_dc.water_supply_c = of_dc.water_supply_c + (left_c - of_dc.water_supply_c) * lag * phi(
            liquid, lag
        )
    of_dc.water_return_c = after_c
    _add_facility(liquid, dc, part, water, cooler_w, trim_w, taken_w, heat_pump_w, z, air_c)


@ti.func
@no_type_check
def _finish_step(liquid: ti.template(), dc):
    """Sum the results of racks and manifolds, and share the heat of pipes and pumps out.

    The racks of a manifold that have power share that of its pipes and pumps equally. All racks of
    the data center share that of facility pumps, and of manifolds without such racks.
    """
    of_dc = liquid.dcs[dc]
    first, end = liquid.manifold_offsets[dc], liquid.manifold_offsets[dc + 1]
    it_w, liquid_w, hottest_c = liquid.real(0.0), liquid.real(0.0), liquid.real(-1000.0)
    warmed_w = (1.0 - of_dc.facility_fluid_share) * of_dc.facility_pump_w
    air_w, all_on, m = warmed_w, liquid.real(0.0), first
    while m < end:
        if liquid.loops[m].on == 0.0:
            warmed_w += liquid.loops[m].to_air_w
        all_on += liquid.loops[m].on
        m += liquid.one
    of_each_w = warmed_w / ti.max(all_on, 1.0)
    supply, back, rate = liquid.real(0.0), liquid.real(0.0), liquid.real(0.0)
    m = first
    while m < end:
        loop = liquid.loops[m]
        extra_w = of_each_w + loop.to_air_w / ti.max(loop.on, 1.0)
        air_w += loop.to_air_w
        r = liquid.rack_offsets[m]
        while r < liquid.rack_offsets[m + 1]:
            rack = liquid.racks[r]
            it_w += rack.it_w
            liquid_w += rack.liquid_w
            hottest_c = ti.max(hottest_c, rack.junction_max_c)
            from_servers_w = rack.air_w
            if ti.static(not liquid.transient):
                from_servers_w = rack.it_w - rack.liquid_w
                if rack.runs > 0.0 and rack.junction_c > rack.trip_c:
                    _trip(liquid, dc, r, liquid.real(0.0))
            air_w += from_servers_w
            rack.air_w = 0.0
            if rack.powered > 0.0:
                rack.air_w = (from_servers_w + extra_w) / rack.powered
            r += liquid.one
        weight = ti.max(loop.w_per_k, liquid.real(1e-9))
        supply += weight * loop.supply_c
        back += weight * loop.return_c
        rate += weight
        m += liquid.one
    of_dc.it_w = it_w
    of_dc.liquid_heat_w = liquid_w
    of_dc.liquid_air_w = air_w
    of_dc.junction_max_c = hottest_c
    of_dc.cdu_supply_c = supply / rate
    of_dc.cdu_return_c = back / rate
