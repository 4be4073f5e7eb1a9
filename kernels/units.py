"""CRAC units of a data center: what they are asked for, what they give, and their coils."""

from typing import no_type_check

import taichi as ti

from .servers import first_share_of
from .sums import sum_of
from .thermal import N_BLOCK_TERMS


@ti.func
@no_type_check
def add_needs(hall: ti.template(), n, chunk_at, block_terms_0):
    """Supply air that the racks of a chunk ask of each CRAC unit."""
    dc, chunk = hall.dcs[n], hall.chunks[chunk_at]
    n_units = hall.dcs[n + 1].first_unit - dc.first_unit
    n_blocks = hall.chunks[chunk_at + 1].first_block - chunk.first_block
    unit = 0
    while unit < n_units:
        need_m3s, b = hall.zeros, 0
        while b < n_blocks:
            share = hall.shares[first_share_of(hall, n, chunk.first_block + b) + unit]
            need_m3s += share * hall.block_terms[block_terms_0 + b * N_BLOCK_TERMS].fresh_m3s
            b += hall.step
        hall.needs[chunk.first_need + unit] = sum_of(need_m3s)
        unit += hall.step


@ti.func
@no_type_check
def need_of(hall: ti.template(), n, unit):
    """What all chunks of a data center ask of one of its units."""
    chunk_at, need_m3s = hall.dcs[n].first_chunk, ti.cast(0.0, ti.f64)
    while chunk_at < hall.dcs[n + 1].first_chunk:
        need_m3s += hall.needs[hall.chunks[chunk_at].first_need + unit]
        chunk_at += hall.step
    return need_m3s


@ti.func
@no_type_check
def run_units(hall: ti.template(), n, flow_m3s, more):
    """What the CRAC units give at the servers' airflow, and how much of the need it covers."""
    dc, none = hall.dcs[n], ti.cast(0.0, ti.f64)
    units = ti.Struct(
        flow_m3s=none,
        supply_m3k_s=none,
        passing_m3k_s=none,
        uncovered=none,
        # Of units that run, as their fans alone draw power.
        fans_m3s=none,
        run_m3s=none,
        run_m3k_s=none,
        any_runs=none,
    )
    following = flow_m3s / dc.design_it_airflow_m3s
    fresh_share = ti.cast(dc.fresh_share, ti.f64)
    at = dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        need = need_of(hall, n, at - dc.first_unit)
        low, high = ti.cast(unit.low, ti.f64), ti.cast(unit.high, ti.f64)
        design_m3s = ti.cast(unit.design_m3s, ti.f64)
        is_on = ti.cast(unit.running, ti.f64)
        used, gives_c = unit.fresh_ratio, unit.supply_c
        speed = ti.min(ti.max(following, low), high)
        flow = design_m3s * speed
        units.flow_m3s += flow
        units.supply_m3k_s += flow * gives_c
        units.passing_m3k_s += (flow - used * need) * gives_c
        covers = ti.min(1.0, fresh_share * flow / ti.max(need, 1e-30))
        units.uncovered = ti.max(units.uncovered, ti.abs(covers - used))
        unit.fresh_ratio = covers
        cubed = speed * speed * speed * is_on
        if ti.static(hall.transient):
            units.fans_m3s += cubed * design_m3s
            units.run_m3s += is_on * flow
            units.run_m3k_s += is_on * flow * gives_c
            if is_on > 0.0:
                units.any_runs = ti.cast(1.0, ti.f64)
            flow *= hall.weight
            cubed *= hall.weight
            if dc.sweep > 0:
                flow += unit.flow_m3s
                cubed += unit.cubed_speed
        if more == 0:
            unit.need_m3s = need
            unit.following = following
        if more == 0 or ti.static(not hall.transient):
            unit.fresh_ratio_used = used
        unit.flow_m3s = flow
        unit.cubed_speed = cubed
        at += hall.step
    return units


@ti.func
@no_type_check
def cool(hall: ti.template(), n, units: ti.template(), return_c):
    """Heat at the coils in a substep, what they take out, and the supply air of the next one.

    Supply air is the setpoint plus what the heat kept by the room warms it by; the coil takes what
    the plant can.
    """
    dc = hall.dcs[n]
    air = ti.cast(dc.air_j_per_m3_k, ti.f64)
    fans_w = units.fans_m3s * dc.crac_fan_w_per_m3s
    load_w = air * (return_c * units.flow_m3s - units.supply_m3k_s) + fans_w
    running_w = air * (return_c * units.run_m3s - units.run_m3k_s) + fans_w
    wanted_w = ti.max(running_w + units.any_runs * dc.room_j / hall.substep_s, 0.0)
    coil_w = ti.min(wanted_w, dc.coil_limit_w)
    held_j = dc.room_j + (load_w - coil_w) * hall.substep_s
    dc.room_j = held_j
    warmed_k = held_j / dc.room_j_per_k
    at = dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        unit.supply_c = ti.cast(unit.setpoint_c, ti.f64) + warmed_k
        at += hall.step
    return load_w, coil_w
