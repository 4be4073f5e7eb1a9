"""Sweeps of halls: every server group once, sums over racks and data centers, CRAC units.

A sweep computes all racks from the air before them. Of quasi-steady halls with recirculation sweeps
repeat until one more would move no mix by more than ``tolerance_k``, at most ``sweeps`` times. Of
transient ones a sweep is a substep.
"""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import SLICE, larger, part_of, reals, smaller
from .compiler.named_rows import NamedRows, shared
from .decay import SERIES_TERMS
from .elementary import log_and_exp
from .mixes import (
    ALIKE,
    exchange_at_once,
    expect,
    follow_mixes,
    judge_sweep,
    next_mix,
    shift_mixes,
)
from .servers import (
    OUTLET_OF_SERVERS,
    add_group,
    air_before,
    complete,
    hand_over,
    inlet_of,
    no_groups,
    of_group,
    rack_outlet,
    racks_of,
    servers_of,
    take_over,
    warm,
    warming_of,
)
from .sums import (
    FIRST_OF_SWEEP,
    N_RACK_SUMS,
    add_up,
    find_hottest,
    join_chunks,
    join_rows,
    keep_range,
)
from .thermal import (
    BLOCK_INTS,
    BLOCK_TERMS,
    CHUNK_INTS,
    CONTROL,
    DC_DOUBLES,
    DC_INTS,
    DC_OUT,
    DC_ROWS,
    GROUP_ROWS,
    LANES,
    N_BLOCK_TERMS,
    N_TERMS,
    RACK_INTS,
    RACK_OUT,
    RACK_ROWS,
    RACK_STATE,
    RECOMMENDED_C,
    RUN_INTS,
    RUN_LANES,
    SCRATCH,
    SOURCES,
    STATE,
    SUM,
    SUMS,
    SUPPLY,
    TERMS,
    UNIT_ROWS,
    UNIT_STATE,
)
from .units import add_needs, cool, run_units

TEMPLATES = 3
"""Template arguments of the kernel, which come first."""


@ti.func
@no_type_check
def compute_groups(
    hall: ti.template(),
    block_at,
    now: ti.template(),
    servers: ti.template(),
    warming: ti.template(),
    racks: ti.template(),
    air: ti.template(),
    sums: ti.template(),
    inlets: ti.template(),
):
    """Groups of a block, to the sums of their racks; return the heat that servers store."""
    block, thermal_storage_w = hall.blocks[block_at], hall.zeros
    z, n_groups, table, place = 0, block.groups, block.table, block.place
    while z < n_groups:
        group = hall.groups[table + z]
        count = group.count
        inlet_c, draws_w, speed, fan_power = of_group(hall, servers, racks, air, group, z)
        if ti.static(hall.transient):
            change_k = warm(hall, warming, racks, place + z, inlet_c, draws_w, speed)
            thermal_storage_w += count * change_k
            if now.ends:
                hand_over(hall, block_at, z, count, hall.server_c[place + z])
        add_group(hall, sums, group, count, inlet_c, draws_w, speed, fan_power)
        add_inlet(hall, inlets, inlet_c)
        z += hall.step
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
    now: ti.template(),
    servers: ti.template(),
    warming: ti.template(),
    hottest: ti.template(),
    moves: ti.template(),
):
    """Racks of a block from the air before them, to their rows and the lanes of the chunk."""
    block, terms = hall.blocks[block_at], hall.terms[terms_at]
    block_terms = hall.block_terms[block_terms_at]
    mixed_c, parcel_w = hall.zeros, hall.zeros
    if ti.static(hall.transient):
        mixed_c, parcel_w = block_terms.mixed_c, block_terms.parcel_w
        if now.begins:
            take_over(hall, block_at)
    elif ti.static(hall.recirculates):
        mixed_c = block.mixed_c
    air = air_before(hall, n, block_at, mixed_c, SUPPLY.fresh_ratio)
    racks = racks_of(hall, servers, block_at)
    sums, inlets = no_groups(hall), no_inlets(hall)
    thermal_storage_w = compute_groups(
        hall, block_at, now, servers, warming, racks, air, sums, inlets
    )
    fresh_m3s = complete(hall, sums, racks, air)
    flow_m3s, mean_c = sums.flow_m3s, sums.inlet_c

    # The exact mean: heat stored plus heat removed is heat generated.
    heat_w = sums.cpu_w + sums.fan_w - thermal_storage_w
    outlet_m3k_s = sums.inlet_m3k_s + heat_w * servers.per_air
    per_flow = hall.real(1.0) / larger(flow_m3s, hall.zeros + hall.real(1e-30))
    outlet_c = outlet_m3k_s * per_flow
    if ti.static(not hall.recirculates):
        if hall.outlet_model != OUTLET_OF_SERVERS:
            outlet_c = rack_outlet(hall, servers, sums, per_flow)
    outlet_c = ti.select(flow_m3s > hall.real(0.0), outlet_c, mean_c)
    if ti.static(hall.recirculates):
        mean_c = ti.select(flow_m3s > hall.real(0.0), sums.inlet_m3k_s * per_flow, mean_c)
        captured_m3s = flow_m3s - air.cover * fresh_m3s
        leaves_m3k_s = outlet_m3k_s - captured_m3s * air.mixed_c - parcel_w * servers.per_air
        # `x = x + y`, since `x += y` would be atomic.
        terms.leaves_m3k_s = terms.leaves_m3k_s + leaves_m3k_s
        block.captured_m3s = captured_m3s
        block_terms.fresh_m3s = fresh_m3s
        give(hall, block_at, now, air.mixed_c, outlet_c, moves)
    else:
        # Their indices are those of the racks, whatever leaves the servers.
        sums.inlet_m3k_s = flow_m3s * mean_c
        outlet_m3k_s = flow_m3s * outlet_c
    terms.inlet_m3k_s = terms.inlet_m3k_s + sums.inlet_m3k_s
    terms.outlet_m3k_s = terms.outlet_m3k_s + outlet_m3k_s
    terms.flow_m3s = terms.flow_m3s + flow_m3s
    add_degrees(hall, block_at, terms_at, racks, air, inlets)
    if ti.static(hall.transient):
        terms.thermal_storage_w = terms.thermal_storage_w + (thermal_storage_w + parcel_w)
    else:
        terms.given_c = terms.given_c + outlet_c

    found = ti.Struct(
        cpu_w=sums.cpu_w,
        fan_w=sums.fan_w,
        airflow_m3s=flow_m3s,
        inlet_c=mean_c,
        outlet_c=outlet_c,
        inlet_max_c=keep_hottest(hall, block_at, racks, inlets, hottest),
    )
    keep_racks(hall, block_at, now, found)


@ti.func
@no_type_check
def no_inlets(hall: ti.template()):
    """What a rack keeps of the inlets of its groups, of which ``zones`` have been seen."""
    return ti.Struct(
        min_c=hall.zeros + hall.real(1e30),
        max_c=hall.zeros - hall.real(1e30),
        zone=hall.zeros,
        zones=hall.zeros,
    )


@ti.func
@no_type_check
def add_inlet(hall: ti.template(), inlets: ti.template(), inlet_c):
    """Inlet of a group; one without servers is as another one of its rack."""
    inlets.min_c = smaller(inlet_c, inlets.min_c)
    inlets.zone = ti.select(inlet_c > inlets.max_c, inlets.zones, inlets.zone)
    inlets.max_c = larger(inlet_c, inlets.max_c)
    inlets.zones += hall.real(1.0)


@ti.func
@no_type_check
def keep_hottest(
    hall: ti.template(),
    block_at,
    racks: ti.template(),
    inlets: ti.template(),
    hottest: ti.template(),
):
    """Hottest inlet of each rack of a block, also to those of each lane of the chunk."""
    is_rack = racks.per_server > hall.real(0.0)
    inlet_c = ti.select(is_rack, inlets.max_c, hall.zeros - hall.real(1e30))
    is_hotter = inlet_c > hottest.inlet_c
    hottest.block = ti.select(is_hotter, block_at, hottest.block)
    hottest.zone = ti.select(is_hotter, inlets.zone, hottest.zone)
    hottest.inlet_c = larger(inlet_c, hottest.inlet_c)
    return inlet_c


@ti.func
@no_type_check
def add_degrees(
    hall: ti.template(),
    block_at,
    terms_at,
    racks: ti.template(),
    air: ti.template(),
    inlets: ti.template(),
):
    """By what inlets of a block lie beyond the recommended range, which most never leave."""
    low_c, high_c = hall.real(RECOMMENDED_C[0]), hall.real(RECOMMENDED_C[1])
    beyond_k = larger(inlets.max_c - high_c, low_c - inlets.min_c)
    beyond_k *= racks.per_server
    # Written like this, the compiler asks all lanes at once.
    is_any = 0
    for i in ti.static(range(LANES)):
        is_any |= ti.cast(beyond_k[i] > hall.real(0.0), ti.i32)
    if is_any != 0:
        block, terms = hall.blocks[block_at], hall.terms[terms_at]
        over_27_sum_k, under_18_sum_k, z, table = hall.zeros, hall.zeros, 0, block.table
        while z < block.groups:
            group = hall.groups[table + z]
            inlet_c = inlet_of(hall, air, group)
            over_27_sum_k += group.count * larger(inlet_c - high_c, hall.zeros)
            under_18_sum_k += group.count * larger(low_c - inlet_c, hall.zeros)
            z += hall.step
        terms.over_27_sum_k = terms.over_27_sum_k + over_27_sum_k
        terms.under_18_sum_k = terms.under_18_sum_k + under_18_sum_k


@ti.func
@no_type_check
def give(
    hall: ti.template(), block_at, now: ti.template(), mixed_c, outlet_c, moves: ti.template()
):
    """What the racks of a block give to the mixes, and by how much that has changed."""
    block = hall.blocks[block_at]
    # Of air that failing fans do not move, the mix is left.
    seen_c = mixed_c + block.airflow * (outlet_c - mixed_c)
    seen_c *= block.strength
    hall.rack_store[STATE.exhaust_odd_c - now.side, block_at] = seen_c
    if now.at_once:
        block.given_k = seen_c - block.strength * now.reference_c
    else:
        change_k = seen_c - hall.rack_store[STATE.exhaust_c + now.side, block_at]
        change_k *= block.per_strength
        is_rack, far_k = block.per_server > hall.real(0.0), hall.zeros + hall.real(1e30)
        moves.least_k = smaller(ti.select(is_rack, change_k, far_k), moves.least_k)
        moves.most_k = larger(ti.select(is_rack, change_k, hall.zeros - far_k), moves.most_k)


@ti.func
@no_type_check
def keep_racks(hall: ti.template(), block_at, now: ti.template(), found: ti.template()):
    """What racks come to in a sweep, or on the mean of the substeps; the hottest inlet of all."""
    block = hall.blocks[block_at]
    if ti.static(hall.transient):
        if not now.begins:
            found.cpu_w += block.cpu_w
            found.fan_w += block.fan_w
            found.airflow_m3s += block.airflow_m3s
            found.inlet_c += block.inlet_c
            found.outlet_c += block.outlet_c
            found.inlet_max_c = larger(found.inlet_max_c, block.inlet_max_c)
        if now.ends:
            share = ti.cast(hall.weight, hall.real)
            found.cpu_w *= share
            found.fan_w *= share
            found.airflow_m3s *= share
            found.inlet_c *= share
            found.outlet_c *= share
    block.cpu_w = found.cpu_w
    block.fan_w = found.fan_w
    block.airflow_m3s = found.airflow_m3s
    block.inlet_c = found.inlet_c
    block.outlet_c = found.outlet_c
    block.inlet_max_c = found.inlet_max_c


@ti.func
@no_type_check
def compute_chunk(
    hall: ti.template(),
    n,
    chunk_at,
    terms_at,
    late,
    now: ti.template(),
    servers: ti.template(),
    warming: ti.template(),
    hottest: ti.template(),
    start,
):
    """Racks of a chunk and their sums; ``late`` where those a sweep does not need can wait."""
    chunk = hall.chunks[chunk_at]
    block_terms_0 = terms_at + N_TERMS
    # Sums of data centers of one chunk go on over the substeps.
    goes_on = False
    if ti.static(hall.transient):
        goes_on = late and not now.begins
    row = terms_at
    if goes_on:
        row += FIRST_OF_SWEEP - N_RACK_SUMS
    else:
        hottest.inlet_c = hall.zeros - hall.real(1e30)
    while row < terms_at + N_TERMS:
        hall.scratch[row] = hall.zeros
        row += hall.step
    # First the mixes before all racks, which do not wait for each other.
    if ti.static(hall.transient):
        follow_mixes(hall, n, chunk_at, block_terms_0, now, servers)
    elif ti.static(hall.recirculates):
        block_at = chunk.first_block
        while block_at < hall.chunks[chunk_at + 1].first_block:
            hall.blocks[block_at].mixed_c = next_mix(hall, n, block_at, now, start)
            block_at += hall.step
    moves = ti.Struct(least_k=hall.zeros + hall.real(1e30), most_k=hall.zeros - hall.real(1e30))
    block_0 = chunk.first_block
    for b in range(hall.chunks[chunk_at + 1].first_block - block_0):
        compute_block(
            hall,
            n,
            block_0 + b,
            terms_at,
            block_terms_0 + b * N_BLOCK_TERMS,
            now,
            servers,
            warming,
            hottest,
            moves,
        )
    if ti.static(hall.recirculates):
        add_needs(hall, n, chunk_at, block_terms_0)
    first_row, adds = 0, False
    if ti.static(hall.transient):
        adds = not now.begins and not late
        if not now.ends:
            first_row = N_RACK_SUMS
            if late:
                first_row = FIRST_OF_SWEEP
    elif late:
        first_row = FIRST_OF_SWEEP
    end_row = SUM.given_c if ti.static(hall.transient) else SUM.inlet_max_c
    add_up(hall, chunk_at, terms_at, first_row, end_row, adds)
    if first_row < FIRST_OF_SWEEP:
        find_hottest(hall, chunk_at, hottest, adds)
    keep_range(hall, chunk_at, moves.least_k, moves.most_k)


@ti.func
@no_type_check
def go_on(hall: ti.template(), n, air: ti.template()):
    """CRAC units at the servers' airflow, and whether and from where their data center goes on."""
    dc = hall.dcs[n]
    total, sweep = hall.chunks[dc.first_chunk], dc.sweep
    more = ti.cast(sweep + 1 < hall.sweeps, ti.i32)
    units = run_units(hall, n, total.flow_m3s, more)
    air.crac_flow_m3s = units.flow_m3s
    air.supply_c = units.supply_m3k_s / units.flow_m3s
    air.return_c = (total.leaves_m3k_s + units.passing_m3k_s) / units.flow_m3s
    dc.stirring_m3s = units.flow_m3s / ti.cast(dc.racks, ti.f64)
    dc.sweep = sweep + 1
    # All mixes move by the middle of the outlets' changes, give or take half their spread.
    middle_k = 0.5 * (total.least_k + total.most_k)
    apart = 0.5 * (total.most_k - total.least_k) > ALIKE * hall.tolerance_k
    exchanged_now = dc.exchange != 0
    if exchanged_now:
        dc.side = 1 - dc.side
    if ti.static(hall.transient):
        dc.exchange = ti.cast(apart, ti.i32)
        dc.active = more
        dc.shift_k = ti.select(apart, 0.0, middle_k)
        air.adds, air.ends = sweep > 0, more == 0
        air.cooling_load_w, air.coil_w = cool(hall, n, units, air.return_c)
    else:
        air.ends = judge_sweep(hall, n, air.supply_c, units.uncovered, more)
        if dc.mix < 0:
            dc.exchange = ti.cast(apart, ti.i32)
            shift_mixes(hall, n, sweep, exchanged_now, middle_k, apart)


@ti.func
@no_type_check
def so_far(hall: ti.template(), air: ti.template(), before, value):
    """Mean over the substeps until now, or value of the last sweep."""
    out = value * hall.weight
    if air.adds:
        out += before
    return out


@ti.func
@no_type_check
def keep_air(hall: ti.template(), n, air: ti.template()):
    """What air the CRAC units give and take, and heat at their coils."""
    dc = hall.dcs[n]
    supplied_m3k_s = hall.chunks[dc.first_chunk].flow_m3s * air.supply_c
    dc.inlet_m3k_s = so_far(hall, air, dc.inlet_m3k_s, supplied_m3k_s)
    dc.crac_flow_m3s = so_far(hall, air, dc.crac_flow_m3s, air.crac_flow_m3s)
    dc.supply_c = so_far(hall, air, dc.supply_c, air.supply_c)
    dc.return_c = so_far(hall, air, dc.return_c, air.return_c)
    dc.cooling_load_w = so_far(hall, air, dc.cooling_load_w, air.cooling_load_w)
    dc.coil_w = so_far(hall, air, dc.coil_w, air.coil_w)


@ti.func
@no_type_check
def keep_results(hall: ti.template(), n):
    """What comes out of a data center that is at its end, after ``keep_air``."""
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
    dc.thermal_storage_w = total.thermal_storage_w * hall.weight
    block_at = ti.cast(total.hottest_block, ti.i32)
    zone = ti.cast(total.hottest_zone, ti.i32)
    lane = ti.cast(total.hottest_lane, ti.i32)
    rack = (block_at - hall.chunks[first].first_block) * LANES + lane
    server, z = ti.cast(0.0, hall.real), 0
    while z < zone:
        server += hall.groups[hall.blocks[block_at].table + z].count[lane]
        z += hall.step
    dc.inlet_max_c = total.inlet_max_c
    dc.hottest_rack = ti.cast(rack, ti.f64)
    dc.hottest_server = ti.cast(server, ti.f64)


@ti.func
@no_type_check
def close(hall: ti.template(), n, terms_at, late, hottest: ti.template()):
    """End of a sweep of a data center, and at its own end what comes out.

    ``late``: what a sweep does not need is summed up at the end.
    """
    join_chunks(hall, n)
    dc, none = hall.dcs[n], ti.cast(0.0, ti.f64)
    air = ti.Struct(
        adds=False,
        ends=True,
        crac_flow_m3s=none,
        supply_c=hall.units[dc.first_unit].supply_c,
        return_c=none,
        cooling_load_w=none,
        coil_w=none,
    )
    if ti.static(hall.recirculates):
        go_on(hall, n, air)
    if ti.static(hall.transient):
        keep_air(hall, n, air)
    if air.ends:
        if ti.static(not hall.transient):
            keep_air(hall, n, air)
            if late:
                add_up(hall, dc.first_chunk, terms_at, 0, FIRST_OF_SWEEP, False)
                find_hottest(hall, dc.first_chunk, hottest, False)
        join_rows(hall, n, 0, FIRST_OF_SWEEP)
        keep_results(hall, n)


@ti.func
@no_type_check
def run(hall: ti.template(), terms_at, first_chunk, end_chunk):
    """All sweeps of a data center, or one of some of its chunks, which wait for the others."""
    n = hall.chunks[first_chunk].dc
    dc = hall.dcs[n]
    n_parts = hall.dcs[n + 1].first_chunk - dc.first_chunk
    rounds = hall.sweeps if end_chunk - first_chunk == n_parts else 1
    passes, late = 1, n_parts == 1
    start = hall.zeros
    if ti.static(hall.recirculates and not hall.transient):
        if dc.mix >= 0:
            passes = 2
        if dc.sweep == 0:
            start = expect(hall, n)
    reference_c = ti.cast(hall.units[dc.first_unit].supply_c, hall.real)
    servers = servers_of(hall, n)
    warming = warming_of(hall, n, servers)
    hottest = ti.Struct(
        inlet_c=hall.zeros - hall.real(1e30), block=ti.Vector([0] * LANES), zone=hall.zeros
    )
    for _ in range(rounds):
        if dc.active <= 0:
            break
        # What the last sweep left is read anew after it: whether this is the first and the last,
        # exchanges anew, and from which row of the exhaust; a shift of all mixes.
        now = ti.Struct(
            begins=dc.sweep == 0,
            ends=dc.sweep == hall.sweeps - 1,
            anew=dc.exchange != 0,
            side=dc.side,
            shift_k=ti.cast(dc.shift_k, hall.real),
            at_once=passes > 1,
            reference_c=reference_c,
        )
        if now.anew:
            now.side = 1 - now.side
        for chunk_at in range(first_chunk, end_chunk):
            compute_chunk(hall, n, chunk_at, terms_at, late, now, servers, warming, hottest, start)
            for again in range(passes):
                if ti.static(hall.recirculates and not hall.transient):
                    if passes > 1:
                        exchange_at_once(hall, n, chunk_at, again, reference_c)
                if again > 0:
                    continue
                # The chunk that comes last does what is left for its data center.
                if not late:
                    if ti.atomic_add(dc.chunks, 1) < n_parts - 1:
                        break
                    dc.chunks = 0
                close(hall, n, terms_at, late, hottest)
                if dc.active <= 0:
                    break


@cache
def hall_kernel(precision: str) -> Any:
    """Kernel of a step: all data centers, until they are at their ends or wait for each other.

    A data center whose chunks are one task runs all its ``sweeps`` in one call, others one per
    call. ``tasks``: first chunk of each, and the end of the last.

    ``serial``: on the thread that calls; waking others takes longer than the step of a small hall.

    ``step``: 1, which compilers cannot know. Loops that advance by it are compiled as they are;
    others to up to eight copies of their body, which most here gain nothing from and which take
    half of the time to machine code.

    ``rack_sources`` and ``run_sources`` are ``rack_store`` again, in vectors of SOURCES and
    RUN_LANES.

    ``constants``: of the released outlet fit, followed by ``decay_constants``.
    """
    real = reals(precision)
    log_of, exp_of = log_and_exp(precision, LANES)
    series_terms = SERIES_TERMS[precision]
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    blocks_2d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    blocks_1d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=1)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)
    doubles_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)
    doubles_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)
    sources_1d = ti.types.ndarray(dtype=ti.types.vector(SOURCES, real), ndim=1)
    runs_1d = ti.types.ndarray(dtype=ti.types.vector(RUN_LANES, real), ndim=1)
    mix_1d = ti.types.ndarray(dtype=ti.types.vector(SOURCES * LANES, real), ndim=1)

    @ti.kernel
    @no_type_check
    def hall(
        recirculates: ti.template(),
        transient: ti.template(),
        serial: ti.template(),
        slices: ti.i32,
        sweeps: ti.i32,
        outlet_model: ti.i32,
        loads_of: ti.i32,
        start_columns: ti.i32,
        step: ti.i32,
        substep_s: ti.f64,
        weight: ti.f64,
        tolerance_k: ti.f64,
        tasks: ints_1d,
        run_start: ints_1d,
        run_ints: ints_2d,
        block_ints: ints_2d,
        rack_ints: ints_2d,
        chunk_ints: ints_2d,
        dc_ints: ints_2d,
        control: ints_2d,
        weights: runs_1d,
        mix: mix_1d,
        shares: blocks_1d,
        racks: blocks_2d,
        groups: blocks_1d,
        group_load: reals_1d,
        dcs: reals_1d,
        doubles: doubles_2d,
        units: reals_2d,
        unit_state: doubles_2d,
        starts: blocks_1d,
        rack_sources: sources_1d,
        run_sources: runs_1d,
        rack_store: blocks_2d,
        server_c: blocks_1d,
        servers_before: reals_1d,
        servers_after: reals_1d,
        constants: reals_1d,
        scratch: blocks_1d,
        rack_out: blocks_2d,
        needs: doubles_1d,
        sums: doubles_1d,
        dc_out: doubles_2d,
    ):
        n_tasks = tasks.shape[0] - 1
        if ti.static(serial):
            ti.loop_config(serialize=True)
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                hall = ti.static(
                    shared(
                        real=real,
                        zeros=ti.Vector([ti.cast(0.0, real)] * LANES),
                        series_terms=series_terms,
                        log_of=log_of,
                        exp_of=exp_of,
                        recirculates=recirculates,
                        transient=transient,
                        sweeps=sweeps,
                        outlet_model=outlet_model,
                        loads_of=loads_of,
                        start_columns=start_columns,
                        step=step,
                        substep_s=substep_s,
                        weight=weight,
                        tolerance_k=tolerance_k,
                        dcs=NamedRows(
                            (DC_INTS, dc_ints),
                            (CONTROL, control),
                            (DC_ROWS, dcs),
                            (DC_DOUBLES, doubles),
                            (DC_OUT, dc_out),
                        ),
                        units=NamedRows((UNIT_ROWS, units), (UNIT_STATE, unit_state)),
                        chunks=NamedRows((CHUNK_INTS, chunk_ints), (SUMS, sums)),
                        blocks=NamedRows(
                            (BLOCK_INTS, block_ints),
                            (RACK_ROWS, racks),
                            (RACK_STATE, rack_store),
                            (RACK_OUT, rack_out),
                        ),
                        places=NamedRows((RACK_INTS, rack_ints)),
                        groups=NamedRows((GROUP_ROWS, groups)),
                        runs=NamedRows((RUN_INTS, run_ints)),
                        terms=NamedRows((TERMS, scratch), apart=1),
                        block_terms=NamedRows((BLOCK_TERMS, scratch), apart=1),
                        constants=constants,
                        group_load=group_load,
                        scratch=scratch,
                        mix=mix,
                        needs=needs,
                        rack_out=rack_out,
                        rack_sources=rack_sources,
                        rack_store=rack_store,
                        run_sources=run_sources,
                        run_start=run_start,
                        server_c=server_c,
                        servers_after=servers_after,
                        servers_before=servers_before,
                        shares=shares,
                        starts=starts,
                        sums=sums,
                        unit_state=unit_state,
                        weights=weights,
                    )
                )
                first, end = part_of(k // SLICE, slices, n_tasks)
                for task in range(first, end):
                    run(hall, k // SLICE * SCRATCH, tasks[task], tasks[task + 1])

    return hall
