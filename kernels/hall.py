"""Kernel of the hall: a sweep computes every server group once, then CRAC units and exhaust mixes.

One sweep of a data center, in the symbols of docs/hall.md. T_mix,j and f_k are those of the
previous sweep. Each line names its function on the right:

    for each rack j:                                                        compute_block
        for each group of alike servers, g its height factor, u its load:   compute_groups
            T_in <- T_mix,j + (1 - r_j g) sum_k s_jk f_k (T_sup,k - T_mix,j)     group_inlet
            P, V <- power and airflow of its servers at T_in and u               compute_group
            transient: C dT/dt = P - eps rho c_p V (T - T_in) for the substep    warm_servers
        V_j      <- sum V,  P_j <- sum (P - C dT/dt)
        T_in,j   <- sum V T_in / V_j
        T_out,j  <- T_in,j + P_j / (rho c_p V_j)
        exhaust of rack j <- T_out,j, less with failing fans                store_exhaust
    for each CRAC unit k:                                                   run_crac_units
        need_k   <- sum_j s_jk (1 - r_j) V_j
        V_k      <- clip(need_k / (1 - b_0), low V_k,full, high V_k,full)
        f_k      <- min(1, (1 - b_0) V_k / need_k)
        T_sup,k  <- setpoint, warmer for coils at their limit and return control  set_supply
    V_crac <- sum_k V_k
    T_ret  <- (sum_j V_j T_out,j - sum_j r'_j V_j T_mix,j + V_bypass T_sup) / V_crac
    for each CRAC unit k that draws its own return air:                     draw_own_return
        T_ret,k  <- T_ret + offset, the same sum weighted by q_jk / V_k
    T_mix,j  <- sum_i w_ji T_out,i                                          mixes.py

In steady air, sweeps repeat until another sweep would change no mix by more than ``tolerance_k``,
at most ``sweeps`` times. In transient halls a sweep is a substep: the room air before the racks
follows its mix (``advance_parcels``), and the coils set the supply air of the next substep
(``run_coils``). The inlet model ``approach`` needs one sweep, with T_in,j = T_sup + a_j.

README.md in this folder explains blocks, chunks, tasks, and the loops that advance by ``hall.one``.
"""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .arguments import row_index
from .compiler.functions import part_of
from .compiler.named_kernel import define_kernel
from .decay import decay_series
from .elementary import log_and_exp
from .hall_arguments import (
    BLOCK_TERMS,
    DONE,
    LANES,
    MODE_VECTORS,
    N_BLOCK_TERMS,
    N_TERMS,
    RUNNING,
    SCRATCH,
    STEP_ARGUMENTS,
    SUMS,
    TERMS,
)
from .mixes import (
    ALIKE,
    add_feedback,
    add_spread_of_units,
    advance_parcels,
    exchange_dense,
    guess_supply_c,
    guesses_by_unit,
    look_up_steady_state,
    next_mix,
    set_mode_amounts,
    status_after_sweep,
    update_shift,
)
from .racks import compute_block, no_hottest
from .servers import server_model, warming_model
from .sums import (
    END_OF_TERMS,
    FIRST_OF_SWEEP,
    FIRST_TERM,
    add_chunks,
    combine_chunks,
    find_hottest_rack,
    store_change_range,
    store_present_inlet,
    sum_chunk,
)
from .units import (
    blow_out_casings,
    change_of_air,
    draw_own_return,
    extrapolate_units,
    follow_hottest_inlet,
    keep_supply,
    run_coils,
    run_crac_units,
    set_present_shares,
    set_supply,
    sum_unit_needs,
    weigh_units,
)

END_OF_TERMS_TRANSIENT = row_index(SUMS, "outlet_sum_c")
"""End of the rows of sums in transient halls, which do not need the sum of the outlets."""
MOST_LATER_CHANGE_K = 2.0
"""Change of the air in a substep, in K, up to which substeps become longer after the first of a
step that begins with the shortest. The abrupt change is then over, so errors remain small."""


@ti.func
@no_type_check
def is_last_sweep(hall: ti.template(), n):
    """Return True if the present substep ends the step, or if steady air has no further sweep."""
    done = hall.dcs[n].sweep + 1
    if ti.static(hall.transient):
        done = hall.dcs[n].elapsed + hall.dcs[n].length
    return done >= hall.sweeps


@ti.func
@no_type_check
def next_length(hall: ti.template(), n, change_k):
    """Return the length of the next substep, from the change of the air in the present one, in K.

    It is the longest in which air that goes on to change at this rate changes by at most
    ``MOST_LATER_CHANGE_K``, but at most twice the present length. The last substep is what is left.
    """
    dc = hall.dcs[n]
    left, most_k = hall.sweeps - dc.elapsed, ti.cast(MOST_LATER_CHANGE_K, ti.f64) * dc.length
    most = ti.min(ti.min(hall.longest, 2 * dc.length), left)
    length = 1
    while length < most and change_k * (length + 1) <= most_k:
        length += hall.one
    return length


@ti.func
@no_type_check
def describe_sweep(hall: ti.template(), n, slice_at, exchanges_after, reference_c):
    """Return the state of a data center before a sweep, as a struct for functions of the sweep."""
    dc = hall.dcs[n]
    sweep = ti.Struct(
        is_first=dc.sweep == 0,
        # In steady air, the last sweep is known only once the sweeps have converged.
        is_last=is_last_sweep(hall, n),
        # Factor of the results of this substep in sums over the step.
        length=ti.cast(dc.length, hall.real),
        # True: exchange the exhausts before computing the racks (or after them).
        exchanges_before=dc.exchanges_before != 0,
        exchanges_after=exchanges_after,
        # Side of the exhaust arrays that the last exchange reads; racks write the other side.
        side=dc.exhaust_side,
        shift_k=ti.cast(dc.shift_k, hall.real),
        # Supply air, the reference temperature where mixes are computed as differences.
        reference_c=reference_c,
        first_amount=slice_at * (MODE_VECTORS * LANES),
    )
    if sweep.exchanges_before:
        sweep.side = 1 - sweep.side
    return sweep


@ti.func
@no_type_check
def update_mixes(
    hall: ti.template(),
    n,
    chunk_at,
    block_terms_0,
    sweep: ti.template(),
    servers: ti.template(),
    amounts,
):
    """Set the mixes before all racks of a chunk, so that no block depends on an earlier block."""
    if ti.static(hall.transient):
        advance_parcels(hall, n, chunk_at, block_terms_0, sweep, servers)
    elif ti.static(hall.recirculates):
        block_at = hall.chunks[chunk_at].first_block
        while block_at < hall.chunks[chunk_at + 1].first_block:
            hall.blocks[block_at].mixed_c = next_mix(hall, n, block_at, sweep, amounts)
            block_at += hall.one
        if sweep.is_first and guesses_by_unit(hall, n):
            add_spread_of_units(hall, n, chunk_at, sweep.reference_c)


@ti.func
@no_type_check
def begin_terms(
    hall: ti.template(), terms_at, sweep: ti.template(), is_one_chunk, hottest: ti.template()
):
    """Reset the TERMS of a chunk, and its hottest inlets, before a sweep.

    A data center of one chunk keeps its sums of the whole step in its lanes during the substeps.
    """
    row = terms_at
    keeps = False
    if ti.static(hall.transient):
        keeps = is_one_chunk and not sweep.is_first
    if keeps:
        row += FIRST_OF_SWEEP - FIRST_TERM
    else:
        hottest.inlet_c = hall.zeros - hall.real(1e30)
    while row < terms_at + N_TERMS:
        hall.scratch[row] = hall.zeros
        row += hall.one


@ti.func
@no_type_check
def store_chunk(
    hall: ti.template(),
    chunk_at,
    terms_at,
    sweep: ti.template(),
    is_one_chunk,
    hottest: ti.template(),
):
    """Store those sums of a chunk that are needed right after this sweep.

    Sums that only the end of the step needs wait for the last substep. In steady air they wait for
    ``finish_sweep``, as the last sweep is known only afterwards. A chunk of a data center with
    several chunks cannot keep TERMS in its lanes, so it sums them up after every sweep.
    """
    first_row, adds, end_row = 0, False, END_OF_TERMS
    if ti.static(hall.transient):
        end_row = END_OF_TERMS_TRANSIENT
        adds = not sweep.is_first and not is_one_chunk
        if not sweep.is_last:
            first_row = FIRST_TERM
            if is_one_chunk:
                first_row = FIRST_OF_SWEEP
    elif is_one_chunk:
        first_row = FIRST_OF_SWEEP
    sum_chunk(hall, chunk_at, terms_at, first_row, end_row, adds)
    if first_row < FIRST_OF_SWEEP:
        find_hottest_rack(hall, chunk_at, hottest, adds)


@ti.func
@no_type_check
def compute_chunk(
    hall: ti.template(),
    n,
    chunk_at,
    terms_at,
    is_one_chunk,
    sweep: ti.template(),
    servers: ti.template(),
    warming: ti.template(),
    hottest: ti.template(),
    amounts,
):
    """Compute and sum the racks of a chunk in a sweep; ``is_one_chunk``: no other in its hall."""
    block_terms_0 = terms_at + N_TERMS
    begin_terms(hall, terms_at, sweep, is_one_chunk, hottest)
    update_mixes(hall, n, chunk_at, block_terms_0, sweep, servers, amounts)
    changes = ti.Struct(
        least_k=hall.zeros + hall.real(1e30),
        most_k=hall.zeros - hall.real(1e30),
        inlet_max_c=hall.zeros - hall.real(1e30),
    )
    block_0 = hall.chunks[chunk_at].first_block
    for b in range(hall.chunks[chunk_at + 1].first_block - block_0):
        block_terms_at = block_terms_0 + b * N_BLOCK_TERMS
        compute_block(
            hall,
            n,
            block_0 + b,
            terms_at,
            block_terms_at,
            sweep,
            servers,
            warming,
            hottest,
            changes,
        )
    if ti.static(hall.recirculates):
        sum_unit_needs(hall, n, chunk_at, block_terms_0)
    store_chunk(hall, chunk_at, terms_at, sweep, is_one_chunk, hottest)
    store_change_range(hall, chunk_at, changes.least_k, changes.most_k)
    if hall.dcs[n].inlet_target_c > 0.0:
        store_present_inlet(hall, chunk_at, changes.inlet_max_c)


@ti.func
@no_type_check
def is_last_chunk(hall: ti.template(), n, n_chunks):
    """Return True if a chunk just computed is the last of its data center in this sweep."""
    is_last = True
    if n_chunks > 1:
        is_last = ti.atomic_add(hall.dcs[n].chunks_done, 1) == n_chunks - 1
        if is_last:
            hall.dcs[n].chunks_done = 0
    return is_last


@ti.func
@no_type_check
def update_crac_and_convergence(hall: ti.template(), n, air: ti.template()):
    """Run the CRAC units at the racks' need; set status and next mixes of the data center."""
    dc = hall.dcs[n]
    total, sweep = hall.chunks[dc.first_chunk], dc.sweep
    is_last = is_last_sweep(hall, n)
    moved_k = ti.cast(0.0, ti.f64)
    if dc.inlet_target_c > 0.0:
        moved_k = follow_hottest_inlet(hall, n, total.present_inlet_max_c)
    units = run_crac_units(hall, n, is_last)
    air.units_flow_m3s = units.flow_m3s
    air.supply_c = units.supply_m3k_s / units.flow_m3s
    air.units_return_c = (total.return_m3k_s + units.bypass_m3k_s) / units.flow_m3s
    dc.return_c = air.units_return_c
    if ti.static(hall.own_return):
        # Return air acts on units that are down, on coils at their limit and on return-air control.
        # Otherwise only the state at the end of a transient step needs it.
        is_due = dc.adjusts_supply > 0.0
        if ti.static(hall.transient):
            is_due = is_due or is_last
        if dc.own_return > 0.0 and is_due:
            is_first = sweep == 0 or dc.adjusts_supply == 0.0
            draw_own_return(hall, n, air.units_return_c, is_first)
    dc.crac_m3s_per_rack = units.flow_m3s / ti.cast(dc.racks, ti.f64)
    dc.sweep = sweep + 1
    # Each mix moves by the midpoint of the exhausts' changes, plus or minus half their spread.
    change_k = 0.5 * (total.least_change_k + total.most_change_k)
    spread_k = 0.5 * (total.most_change_k - total.least_change_k)
    exchanges = spread_k > ALIKE * hall.tolerance_k
    has_exchanged = dc.exchanges_before != 0
    if has_exchanged:
        dc.exhaust_side = 1 - dc.exhaust_side
    if ti.static(hall.transient):
        dc.exchanges_before = ti.cast(exchanges, ti.i32)
        dc.shift_k = ti.select(exchanges, 0.0, change_k)
        air.units_load_w, air.coil_w = run_coils(hall, n, units, air.units_return_c)
        air.casings_w = units.casings_w
        most_k = change_of_air(hall, n, total.least_change_k, total.most_change_k)
        dc.elapsed = dc.elapsed + dc.length
        dc.length = next_length(hall, n, most_k)
        if sweep > 0:
            most_k = ti.max(most_k, dc.most_change_k)
        dc.most_change_k = most_k
        dc.status = RUNNING
        if is_last or most_k > hall.abandoned_above_k:
            dc.status = DONE
    else:
        if dc.adjusts_supply > 0.0:
            load_w = air.units_return_c * units.flow_m3s - units.supply_m3k_s
            load_w *= ti.cast(dc.air_j_per_m3_k, ti.f64)
            load_w += units.fan_m3s * dc.crac_fan_w_per_m3s
            moved_k = ti.max(moved_k, set_supply(hall, n, units, air.units_return_c, 0.0, load_w))
        dc.status = status_after_sweep(hall, n, air.supply_c, units.most_f_change, moved_k, is_last)
        if dc.status == RUNNING and dc.inlet_target_c == 0.0:
            outlet_c = total.outlet_sum_c / ti.cast(dc.racks, ti.f64)
            extrapolate_units(hall, n, ti.abs(outlet_c - air.supply_c))
        if dc.adjusts_supply > 0.0 and dc.status != RUNNING:
            keep_supply(hall, n)
        if dc.first_mix_weight < 0:
            dc.exchanges_before = ti.cast(exchanges, ti.i32)
            update_shift(hall, n, sweep, has_exchanged, change_k, exchanges)


@ti.func
@no_type_check
def running_mean(hall: ti.template(), is_first, weight, before, value):
    """Return the mean over the substeps so far, added to ``before``; in steady air ``value``."""
    mean = value * weight
    if not is_first:
        mean += before
    return mean


@ti.func
@no_type_check
def store_air(hall: ti.template(), n, is_first, weight, air: ti.template()):
    """Store supply and return air of the CRAC units, and heat at their coils, in DC_OUT."""
    dc = hall.dcs[n]
    supplied_m3k_s = hall.chunks[dc.first_chunk].flow_m3s * air.supply_c
    dc.inlet_m3k_s = running_mean(hall, is_first, weight, dc.inlet_m3k_s, supplied_m3k_s)
    dc.units_flow_m3s = running_mean(hall, is_first, weight, dc.units_flow_m3s, air.units_flow_m3s)
    dc.supply_c = running_mean(hall, is_first, weight, dc.supply_c, air.supply_c)
    dc.units_return_c = running_mean(hall, is_first, weight, dc.units_return_c, air.units_return_c)
    dc.units_load_w = running_mean(hall, is_first, weight, dc.units_load_w, air.units_load_w)
    dc.coil_w = running_mean(hall, is_first, weight, dc.coil_w, air.coil_w)
    casings_w = dc.thermal_storage_w
    dc.thermal_storage_w = running_mean(hall, is_first, weight, casings_w, air.casings_w)


@ti.func
@no_type_check
def store_results(hall: ti.template(), n):
    """Store sums and means over the racks of a data center in DC_OUT at the end of its step.

    ``store_air`` must run first: it leaves airflow times supply air in ``inlet_m3k_s``, and the
    heat that warms the air in the casings of CRAC units in ``thermal_storage_w``.
    """
    dc, first = hall.dcs[n], hall.dcs[n].first_chunk
    total, n_racks = hall.chunks[first], ti.cast(dc.racks, ti.f64)
    supplied_m3k_s = dc.inlet_m3k_s
    dc.cpu_w = total.cpu_w
    dc.it_fan_w = total.fan_w
    dc.it_airflow_m3s = total.airflow_m3s
    dc.inlet_mean_c = total.inlet_c / n_racks
    dc.outlet_mean_c = total.outlet_c / n_racks
    dc.inlet_m3k_s = total.inlet_m3k_s * hall.weight - supplied_m3k_s
    dc.outlet_m3k_s = total.outlet_m3k_s * hall.weight - supplied_m3k_s
    dc.over_27_sum_k = total.over_27_sum_k * hall.weight
    dc.under_18_sum_k = total.under_18_sum_k * hall.weight
    dc.thermal_storage_w = dc.thermal_storage_w + total.thermal_storage_w * hall.weight
    block_at = ti.cast(total.hottest_block, ti.i32)
    group = ti.cast(total.hottest_group, ti.i32)
    lane = ti.cast(total.hottest_lane, ti.i32)
    rack = (block_at - hall.chunks[first].first_block) * LANES + lane
    server, z = ti.cast(0.0, hall.real), 0
    while z < group:
        server += hall.groups[hall.blocks[block_at].first_row + z].count[lane]
        z += hall.one
    dc.inlet_max_c = total.inlet_max_c
    dc.hottest_rack = ti.cast(rack, ti.f64)
    dc.hottest_server = ti.cast(server, ti.f64)


@ti.func
@no_type_check
def finish_sweep(
    hall: ti.template(),
    n,
    terms_at,
    is_one_chunk,
    sweep: ti.template(),
    hottest: ti.template(),
):
    """Finish a sweep after the last chunk of a data center; store results if it was the last."""
    combine_chunks(hall, n)
    dc, none = hall.dcs[n], ti.cast(0.0, ti.f64)
    air = ti.Struct(
        units_flow_m3s=none,
        supply_c=hall.units[dc.first_unit].supply_c,
        units_return_c=none,
        units_load_w=none,
        coil_w=none,
        casings_w=none,
    )
    is_done = True
    if ti.static(hall.recirculates):
        update_crac_and_convergence(hall, n, air)
        is_done = dc.status != RUNNING
    if ti.static(hall.transient):
        store_air(hall, n, sweep.is_first, hall.weight * ti.cast(sweep.length, ti.f64), air)
    if is_done:
        if ti.static(not hall.transient):
            store_air(hall, n, True, hall.weight, air)
            if is_one_chunk:
                sum_chunk(hall, dc.first_chunk, terms_at, 0, FIRST_OF_SWEEP, False)
                find_hottest_rack(hall, dc.first_chunk, hottest, False)
        add_chunks(hall, n, 0, FIRST_OF_SWEEP)
        store_results(hall, n)


@ti.func
@no_type_check
def run_task(hall: ti.template(), slice_at, first_chunk, end_chunk):
    """Run all sweeps of a data center, or one sweep of some of its chunks.

    A data center that is split into several tasks synchronises its chunks after every sweep.
    """
    n = hall.chunks[first_chunk].dc
    dc = hall.dcs[n]
    n_chunks = hall.dcs[n + 1].first_chunk - dc.first_chunk
    is_whole = end_chunk - first_chunk == n_chunks
    sweeps_left = hall.sweeps
    if not is_whole and hall.sweeps > 0:
        sweeps_left = 1
    if ti.static(hall.recirculates):
        # Weights of a data center that is split are fitted by a call without sweeps.
        begins = is_whole
        if hall.sweeps == 0:
            begins = not is_whole and first_chunk == dc.first_chunk
        if begins and dc.sweep == 0 and dc.coupling > 0.0:
            weigh_units(hall, n, True)
    exchanges_after, amounts, terms_at = False, hall.zeros, slice_at * SCRATCH
    supply_c = guess_supply_c(hall, n)
    reference_c = ti.cast(supply_c, hall.real)
    if ti.static(hall.recirculates and not hall.transient):
        exchanges_after = dc.first_mix_weight >= 0
        if dc.sweep == 0:
            if exchanges_after:
                amounts = look_up_steady_state(hall, n, supply_c)
            else:
                set_mode_amounts(hall, n, slice_at, reference_c)
    servers = server_model(hall, n)
    hottest = no_hottest(hall)
    while sweeps_left > 0 and dc.status == RUNNING:
        sweep = describe_sweep(hall, n, slice_at, exchanges_after, reference_c)
        warming = warming_model(hall, n, servers)
        if ti.static(hall.recirculates):
            if dc.shares_due > 0.0 or dc.exceeds > 0.0:
                set_present_shares(hall, n, first_chunk, end_chunk)
        if ti.static(hall.transient and hall.recirculates):
            blow_out_casings(hall, n)
        for chunk_at in range(first_chunk, end_chunk):
            compute_chunk(
                hall,
                n,
                chunk_at,
                terms_at,
                n_chunks == 1,
                sweep,
                servers,
                warming,
                hottest,
                amounts,
            )
            if ti.static(hall.recirculates and not hall.transient):
                if exchanges_after:
                    exchange_dense(hall, n, chunk_at, reference_c)
            if is_last_chunk(hall, n, n_chunks):
                finish_sweep(hall, n, terms_at, n_chunks == 1, sweep, hottest)
            if ti.static(hall.recirculates and not hall.transient):
                if exchanges_after and dc.status == RUNNING:
                    add_feedback(hall, n, chunk_at)
        sweeps_left -= 1


@ti.func
@no_type_check
def run_slice(hall: ti.template(), slice_at):
    """Run the tasks of slice ``slice_at``, one of ``slices`` equal parts of all tasks."""
    n_tasks = hall.task_offsets.shape[0] - 1
    first, end = part_of(slice_at, hall.slices, n_tasks)
    for task in range(first, end):
        run_task(hall, slice_at, hall.task_offsets[task], hall.task_offsets[task + 1])


@cache
def hall_kernel(precision: str) -> Any:
    """Return the kernel of a step; it runs all data centers until each is done or synchronises.

    A data center whose chunks form one task runs all its ``sweeps`` in one call. Other data centers
    run one sweep per call. STEP_ARGUMENTS lists the arguments of the kernel.

    Args:
        precision: ``f32`` or ``f64``, of temperatures and powers; sums are always in f64.
    """
    log_of, exp_of = log_and_exp(precision, LANES)
    return define_kernel(
        "hall_step",
        STEP_ARGUMENTS,
        run_slice,
        precision=precision,
        lanes=LANES,
        constants={
            "log_of": log_of,
            "exp_of": exp_of,
            "decay_series": decay_series(precision),
        },
        views={"terms": (TERMS, "scratch"), "block_terms": (BLOCK_TERMS, "scratch")},
    )
