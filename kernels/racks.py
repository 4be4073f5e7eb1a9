"""Racks of a block in one sweep: from their intake air to rack results and sums."""

from typing import no_type_check

import taichi as ti

from .compiler.functions import larger, smaller
from .hall_arguments import LANES, RECOMMENDED_C
from .mixes import store_exhaust
from .servers import (
    OUTLET_OF_SERVERS,
    STILL_AIR_SHARE,
    add_group,
    apply_rack_factors,
    compute_group,
    group_inlet,
    group_outlet,
    intake_air,
    load_server_temperatures,
    outlet_model,
    rack_model,
    rack_outlet,
    store_server_temperatures,
    warm_servers,
    zero_rack_sums,
)
from .sums import rank


@ti.func
@no_type_check
def compute_groups(
    hall: ti.template(),
    block_at,
    sweep: ti.template(),
    servers: ti.template(),
    warming: ti.template(),
    racks: ti.template(),
    air: ti.template(),
    outlets: ti.template(),
    sums: ti.template(),
    extremes: ti.template(),
):
    """Add the groups of a block to the sums of their racks; return heat stored in servers, in W."""
    block, thermal_storage_w = hall.blocks[block_at], hall.zeros
    z, n_groups, first_row, first_place = 0, block.groups, block.first_row, block.first_place
    while z < n_groups:
        group = hall.groups[first_row + z]
        count = group.count
        inlet_c, cpu_w, airflow, fan_power = compute_group(hall, servers, racks, air, group, z)
        server_c = hall.zeros
        if ti.static(hall.transient):
            at = first_place + z
            capacity = group.heat_capacity
            change_k = warm_servers(hall, warming, racks, at, capacity, inlet_c, cpu_w, airflow)
            thermal_storage_w += count * capacity * change_k
            server_c = hall.server_c[at]
            if sweep.is_last:
                store_server_temperatures(hall, block_at, z, count, server_c)
        add_group(hall, sums, group, count, inlet_c, cpu_w, airflow, fan_power)
        outlet_c = group_outlet(hall, outlets, inlet_c, cpu_w, airflow, fan_power, server_c)
        update_extremes(hall, extremes, z, inlet_c, outlet_c)
        z += hall.one
    if ti.static(hall.transient):
        thermal_storage_w *= warming.w_per_k
    return thermal_storage_w


@ti.func
@no_type_check
def compute_block(
    hall: ti.template(),
    n,
    block_at,
    terms_at,
    block_terms_at,
    sweep: ti.template(),
    servers: ti.template(),
    warming: ti.template(),
    hottest: ti.template(),
    changes: ti.template(),
):
    """Compute the racks of a block in a sweep: rack results, and the TERMS of their chunk."""
    block, terms = hall.blocks[block_at], hall.terms[terms_at]
    block_terms = hall.block_terms[block_terms_at]
    mixed_c, parcel_w = hall.zeros, hall.zeros
    if ti.static(hall.transient):
        mixed_c, parcel_w = block_terms.mixed_c, block_terms.parcel_w
        if sweep.is_first:
            load_server_temperatures(hall, block_at)
    elif ti.static(hall.recirculates):
        mixed_c = block.mixed_c
    air = intake_air(hall, n, block_at, mixed_c, False)
    racks = rack_model(hall, servers, block_at)
    outlets = outlet_model(hall, n, servers, racks)
    sums, extremes = zero_rack_sums(hall), no_extremes(hall)
    thermal_storage_w = compute_groups(
        hall, block_at, sweep, servers, warming, racks, air, outlets, sums, extremes
    )
    fresh_m3s = apply_rack_factors(hall, sums, racks, air)
    flow_m3s, mean_c = sums.flow_m3s, sums.inlet_c

    # This mean outlet is exact: stored heat plus removed heat equals generated heat.
    heat_w = sums.cpu_w + sums.fan_w - thermal_storage_w
    outlet_m3k_s = sums.inlet_m3k_s + heat_w * servers.per_air
    per_flow = hall.real(1.0) / larger(flow_m3s, hall.zeros + hall.real(1e-30))
    outlet_c = outlet_m3k_s * per_flow
    if ti.static(not hall.recirculates):
        if hall.outlet_model != OUTLET_OF_SERVERS:
            outlet_c = rack_outlet(hall, servers, sums, per_flow)
    outlet_c = ti.select(flow_m3s > hall.real(0.0), outlet_c, mean_c)
    outlet_max_c = extremes.outlet_max_c
    if ti.static(not hall.recirculates):
        if hall.outlet_model != OUTLET_OF_SERVERS:
            outlet_max_c = outlet_c
    if ti.static(hall.recirculates):
        mean_c = ti.select(flow_m3s > hall.real(0.0), sums.inlet_m3k_s * per_flow, mean_c)
        captured_m3s = flow_m3s - air.cover * fresh_m3s
        return_m3k_s = outlet_m3k_s - captured_m3s * air.mixed_c - parcel_w * servers.per_air
        # This is `x = x + y`, because `x += y` would be an atomic operation.
        terms.return_m3k_s = terms.return_m3k_s + return_m3k_s
        block.captured_m3s = captured_m3s
        if ti.static(hall.own_return):
            store_return(hall, n, block_at, air.cover * fresh_m3s, return_m3k_s)
        store_need(hall, n, block_at, block_terms_at, racks, sums, fresh_m3s)
        exhaust_c = outlet_c
        if ti.static(hall.transient):
            # Air at inlet temperature passes a rack that is off, except for a small draught.
            draught_c = mean_c + hall.real(STILL_AIR_SHARE) * (outlet_c - mean_c)
            exhaust_c = ti.select(racks.powered > hall.real(0.0), outlet_c, draught_c)
        store_exhaust(hall, block_at, sweep, air.mixed_c, exhaust_c, changes)
    else:
        # SHI and RHI are computed from rack outlets, with the outlet model of the hall.
        sums.inlet_m3k_s = flow_m3s * mean_c
        outlet_m3k_s = flow_m3s * outlet_c
    terms.inlet_m3k_s = terms.inlet_m3k_s + sweep.length * sums.inlet_m3k_s
    terms.outlet_m3k_s = terms.outlet_m3k_s + sweep.length * outlet_m3k_s
    terms.flow_m3s = terms.flow_m3s + flow_m3s
    add_degrees_out_of_range(hall, block_at, terms_at, sweep, racks, air, extremes)
    if ti.static(hall.transient):
        stored_w = sweep.length * (thermal_storage_w + parcel_w)
        terms.thermal_storage_w = terms.thermal_storage_w + stored_w
    else:
        terms.outlet_sum_c = terms.outlet_sum_c + outlet_c

    inlet_max_c = update_hottest(hall, block_at, racks, extremes, hottest)
    changes.inlet_max_c = larger(inlet_max_c, changes.inlet_max_c)
    results = ti.Struct(
        cpu_w=sums.cpu_w,
        fan_w=sums.fan_w,
        airflow_m3s=flow_m3s,
        inlet_c=mean_c,
        outlet_c=outlet_c,
        inlet_max_c=inlet_max_c,
        outlet_max_c=outlet_max_c,
    )
    store_racks(hall, block_at, sweep, results)


@ti.func
@no_type_check
def store_need(
    hall: ti.template(),
    n,
    block_at,
    block_terms_at,
    racks: ti.template(),
    sums: ti.template(),
    fresh_m3s,
):
    """Store the supply air that the racks of a block need, for the sums of the CRAC units."""
    dc, block, block_terms = hall.dcs[n], hall.blocks[block_at], hall.block_terms[block_terms_at]
    plain_m3s = fresh_m3s
    if dc.exceeds > 0.0:
        plain_m3s = sums.flow_m3s - block.exhaust_share * (sums.height_m3s * racks.full_m3s)
    block_terms.fresh_m3s = fresh_m3s
    block_terms.plain_m3s = plain_m3s
    if dc.coupling > 0.0 and dc.follows_need > 0.0:
        need_m3s = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
        for i in range(LANES):
            need_m3s[i] = ti.cast(plain_m3s[i], ti.f64)
        hall.plenum[block_at].present_m3s = need_m3s


@ti.func
@no_type_check
def store_return(hall: ti.template(), n, block_at, flow_m3s, flow_m3k_s):
    """Store the air of the racks of a block that returns to the units, for ``draw_own_return``."""
    if hall.dcs[n].own_return > 0.0:
        flow_in_f64 = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
        heat_in_f64 = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
        for i in range(LANES):
            flow_in_f64[i] = ti.cast(flow_m3s[i], ti.f64)
            heat_in_f64[i] = ti.cast(flow_m3k_s[i], ti.f64)
        hall.returns[block_at].flow_m3s = flow_in_f64
        hall.returns[block_at].flow_m3k_s = heat_in_f64


@ti.func
@no_type_check
def no_extremes(hall: ti.template()):
    """Return initial extremes of each rack: coolest and hottest inlet, and hottest outlet."""
    return ti.Struct(
        inlet_min_c=hall.zeros + hall.real(1e30),
        inlet_max_c=hall.zeros - hall.real(1e30),
        outlet_max_c=hall.zeros - hall.real(1e30),
        # Group of the rack with the hottest inlet.
        hottest_group=hall.zeros,
    )


@ti.func
@no_type_check
def update_extremes(hall: ti.template(), extremes: ti.template(), z, inlet_c, outlet_c):
    """Update the extremes of each rack with its group z.

    A group without servers repeats another group of its rack, so it does not change the extremes.
    """
    extremes.inlet_min_c = smaller(inlet_c, extremes.inlet_min_c)
    is_hotter = inlet_c > extremes.inlet_max_c
    extremes.hottest_group = ti.select(is_hotter, ti.cast(z, hall.real), extremes.hottest_group)
    extremes.inlet_max_c = larger(inlet_c, extremes.inlet_max_c)
    extremes.outlet_max_c = larger(outlet_c, extremes.outlet_max_c)


@ti.func
@no_type_check
def no_hottest(hall: ti.template()):
    """Return the initial struct of the hottest inlet in each lane of a chunk."""
    return ti.Struct(
        inlet_c=hall.zeros - hall.real(1e30), block=ti.Vector([0] * LANES), group=hall.zeros
    )


@ti.func
@no_type_check
def update_hottest(
    hall: ti.template(),
    block_at,
    racks: ti.template(),
    extremes: ti.template(),
    hottest: ti.template(),
):
    """Return the hottest inlet of each rack of a block, in C; update the hottest of each lane."""
    is_rack = racks.per_server > hall.real(0.0)
    inlet_c = ti.select(is_rack, extremes.inlet_max_c, hall.zeros - hall.real(1e30))
    is_hotter = rank(hall, inlet_c) > rank(hall, hottest.inlet_c)
    hottest.block = ti.select(is_hotter, block_at, hottest.block)
    hottest.group = ti.select(is_hotter, extremes.hottest_group, hottest.group)
    hottest.inlet_c = larger(inlet_c, hottest.inlet_c)
    return inlet_c


@ti.func
@no_type_check
def add_degrees_out_of_range(
    hall: ti.template(),
    block_at,
    terms_at,
    sweep: ti.template(),
    racks: ti.template(),
    air: ti.template(),
    extremes: ti.template(),
):
    """Add the degrees by which inlets of a block are outside the recommended range, a rare case."""
    low_c, high_c = hall.real(RECOMMENDED_C[0]), hall.real(RECOMMENDED_C[1])
    beyond_k = larger(extremes.inlet_max_c - high_c, low_c - extremes.inlet_min_c)
    beyond_k *= racks.per_server
    # In this form the compiler tests all lanes at once.
    is_any = 0
    for i in ti.static(range(LANES)):
        is_any |= ti.cast(beyond_k[i] > hall.real(0.0), ti.i32)
    if is_any != 0:
        block, terms = hall.blocks[block_at], hall.terms[terms_at]
        over_27_sum_k, under_18_sum_k, z, first_row = hall.zeros, hall.zeros, 0, block.first_row
        while z < block.groups:
            group = hall.groups[first_row + z]
            inlet_c = group_inlet(hall, air, group)
            over_27_sum_k += group.count * larger(inlet_c - high_c, hall.zeros)
            under_18_sum_k += group.count * larger(low_c - inlet_c, hall.zeros)
            z += hall.one
        terms.over_27_sum_k = terms.over_27_sum_k + sweep.length * over_27_sum_k
        terms.under_18_sum_k = terms.under_18_sum_k + sweep.length * under_18_sum_k


@ti.func
@no_type_check
def store_racks(hall: ti.template(), block_at, sweep: ti.template(), results: ti.template()):
    """Store the results of the racks of a block: of the last sweep, or means over the substeps.

    The hottest inlet and outlet are maxima over the substeps.
    """
    block = hall.blocks[block_at]
    if ti.static(hall.transient):
        results.cpu_w *= sweep.length
        results.fan_w *= sweep.length
        results.airflow_m3s *= sweep.length
        results.inlet_c *= sweep.length
        results.outlet_c *= sweep.length
        if not sweep.is_first:
            results.cpu_w += block.cpu_w
            results.fan_w += block.fan_w
            results.airflow_m3s += block.airflow_m3s
            results.inlet_c += block.inlet_c
            results.outlet_c += block.outlet_c
            results.inlet_max_c = larger(results.inlet_max_c, block.inlet_max_c)
            results.outlet_max_c = larger(results.outlet_max_c, block.outlet_max_c)
        if sweep.is_last:
            weight = ti.cast(hall.weight, hall.real)
            results.cpu_w *= weight
            results.fan_w *= weight
            results.airflow_m3s *= weight
            results.inlet_c *= weight
            results.outlet_c *= weight
    block.cpu_w = results.cpu_w
    block.fan_w = results.fan_w
    block.airflow_m3s = results.airflow_m3s
    block.inlet_c = results.inlet_c
    block.outlet_c = results.outlet_c
    block.inlet_max_c = results.inlet_max_c
    block.outlet_max_c = results.outlet_max_c
