"""CRAC units of a data center: what the racks ask of them, what they give, and their coils."""

from typing import no_type_check

import taichi as ti

from .hall_arguments import N_BLOCK_TERMS
from .servers import first_share_at
from .sums import sum_lanes


@ti.func
@no_type_check
def sum_unit_needs(hall: ti.template(), n, chunk_at, block_terms_0):
    """Supply air that the racks of a chunk ask of each CRAC unit, sum_j s_jk (1 - r_j) V_j."""
    dc, chunk = hall.dcs[n], hall.chunks[chunk_at]
    n_units = hall.dcs[n + 1].first_unit - dc.first_unit
    n_blocks = hall.chunks[chunk_at + 1].first_block - chunk.first_block
    unit = 0
    while unit < n_units:
        need_m3s, b = hall.zeros, 0
        while b < n_blocks:
            share = hall.unit_shares[first_share_at(hall, n, chunk.first_block + b) + unit]
            need_m3s += share * hall.block_terms[block_terms_0 + b * N_BLOCK_TERMS].fresh_m3s
            b += hall.one
        hall.unit_need_m3s[chunk.first_need + unit] = sum_lanes(need_m3s)
        unit += hall.one


@ti.func
@no_type_check
def unit_need(hall: ti.template(), n, unit):
    """Supply air that all chunks of a data center ask of one of its units, in m3/s."""
    chunk_at, need_m3s = hall.dcs[n].first_chunk, ti.cast(0.0, ti.f64)
    while chunk_at < hall.dcs[n + 1].first_chunk:
        need_m3s += hall.unit_need_m3s[hall.chunks[chunk_at].first_need + unit]
        chunk_at += hall.one
    return need_m3s


@ti.func
@no_type_check
def run_crac_units(hall: ti.template(), n, is_last):
    """Airflow of the CRAC units for what their racks need, and what share of the need it covers.

    Each unit: V_k = clip(need_k / (1 - b_0), low V_k,design, high V_k,design) and
    f_k = min(1, (1 - b_0) V_k / need_k). ``is_last``: no sweep follows, so the state of the units
    is that at the end of the step.
    """
    dc, none = hall.dcs[n], ti.cast(0.0, ti.f64)
    units = ti.Struct(
        flow_m3s=none,
        supply_m3k_s=none,
        bypass_m3k_s=none,
        most_f_change=none,
        # Sums over the running units, whose fans alone draw power.
        fan_m3s=none,
        running_m3s=none,
        running_m3k_s=none,
        any_running=none,
    )
    fresh_share = ti.cast(dc.fresh_share, ti.f64)
    at = dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        need = unit_need(hall, n, at - dc.first_unit)
        low, high = ti.cast(unit.low, ti.f64), ti.cast(unit.high, ti.f64)
        design_m3s = ti.cast(unit.design_m3s, ti.f64)
        is_running = ti.cast(unit.running, ti.f64)
        f_used, supply_c = unit.fresh_ratio, unit.supply_c
        following = need / ti.max(fresh_share * design_m3s, 1e-30)
        speed = ti.min(ti.max(following, low), high)
        flow = design_m3s * speed
        units.flow_m3s += flow
        units.supply_m3k_s += flow * supply_c
        units.bypass_m3k_s += (flow - f_used * need) * supply_c
        f = ti.min(1.0, fresh_share * flow / ti.max(need, 1e-30))
        units.most_f_change = ti.max(units.most_f_change, ti.abs(f - f_used))
        unit.fresh_ratio = f
        cubed = speed * speed * speed * is_running
        if ti.static(hall.transient):
            units.fan_m3s += cubed * design_m3s
            units.running_m3s += is_running * flow
            units.running_m3k_s += is_running * flow * supply_c
            if is_running > 0.0:
                units.any_running = ti.cast(1.0, ti.f64)
            flow *= hall.weight
            cubed *= hall.weight
            if dc.sweep > 0:
                flow += unit.flow_m3s
                cubed += unit.cubed_speed
        if is_last:
            unit.need_m3s = need
            unit.following = following
        if is_last or ti.static(not hall.transient):
            unit.fresh_ratio_used = f_used
        unit.flow_m3s = flow
        unit.cubed_speed = cubed
        at += hall.one
    return units


@ti.func
@no_type_check
def run_coils(hall: ti.template(), n, units: ti.template(), return_c):
    """Heat that reaches the coils in a substep and what they take out, in W.

    Coils take what brings the supply air back to its setpoint, at most what the plant can. The
    rest is held by the room and warms the supply air of the next substep.
    """
    dc = hall.dcs[n]
    air = ti.cast(dc.air_j_per_m3_k, ti.f64)
    fans_w = units.fan_m3s * dc.crac_fan_w_per_m3s
    load_w = air * (return_c * units.flow_m3s - units.supply_m3k_s) + fans_w
    running_w = air * (return_c * units.running_m3s - units.running_m3k_s) + fans_w
    wanted_w = ti.max(running_w + units.any_running * dc.room_j / hall.substep_s, 0.0)
    coil_w = ti.min(wanted_w, dc.coil_limit_w)
    room_j = dc.room_j + (load_w - coil_w) * hall.substep_s
    dc.room_j = room_j
    warmed_k = room_j / dc.room_j_per_k
    at = dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        unit.supply_c = ti.cast(unit.setpoint_c, ti.f64) + warmed_k
        at += hall.one
    return load_w, coil_w
