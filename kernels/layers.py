"""Values of the servers of a step that has been done, group by group."""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .compiler.functions import SLICE, larger, part_of, reals
from .compiler.named_rows import NamedRows, shared
from .elementary import log_and_exp
from .servers import (
    OUTLET_OF_SERVERS,
    air_before,
    of_group,
    racks_of,
    servers_of,
)
from .thermal import (
    BLOCK_INTS,
    CHUNK_INTS,
    DC_DOUBLES,
    DC_INTS,
    DC_ROWS,
    GROUP_OUT,
    GROUP_ROWS,
    LANE_BITS,
    LANES,
    RACK_INT,
    RACK_INTS,
    RACK_OUT,
    RACK_ROWS,
    RACK_STATE,
    SUPPLY,
    UNIT_STATE,
)

TEMPLATES = 3
"""Template arguments of the kernel, which come first."""

N_VALUES = len(GROUP_OUT)


@ti.func
@no_type_check
def store(hall: ti.template(), b, inlet_c, outlet_c, power_w):
    """A vector of servers to the layers."""
    hall.layer_blocks[0][b] = inlet_c
    hall.layer_blocks[1][b] = outlet_c
    hall.layer_blocks[2][b] = power_w


@ti.func
@no_type_check
def spread_runs(hall: ti.template(), block_at, values_at):
    """Values of the groups of a block to runs of servers, nearly all in whole vectors."""
    block, place_0 = hall.blocks[block_at], block_at * LANES
    start = hall.places[place_0].first_server
    end = hall.places[place_0 + block.racks].first_server
    # Between these are the vectors that the block has to itself.
    low, high = (start + (LANES - 1)) & -LANES, end & -LANES
    numbers = ti.Vector([i for i in range(LANES)])
    joined = ti.Struct(inlet_c=hall.zeros, outlet_c=hall.zeros, power_w=hall.zeros)
    lane, table = 0, block.table
    while lane < block.racks:
        end = hall.places[place_0 + lane + 1].first_server
        z = 0
        while start < end:
            s, b = start, start >> LANE_BITS
            start += ti.cast(hall.groups[table + z].count[lane], ti.i32)
            values = hall.values[values_at + z]
            inlet_c, outlet_c = values.inlet_c[lane], values.outlet_c[lane]
            power_w = values.power_w[lane]
            inlets, outlets = ti.Vector([inlet_c] * LANES), ti.Vector([outlet_c] * LANES)
            powers = ti.Vector([power_w] * LANES)
            # The vector where a run begins has the ends of those before.
            before = numbers < (s & (LANES - 1))
            joined.inlet_c = ti.select(before, joined.inlet_c, inlets)
            joined.outlet_c = ti.select(before, joined.outlet_c, outlets)
            joined.power_w = ti.select(before, joined.power_w, powers)
            if b < start >> LANE_BITS:
                if b << LANE_BITS >= low:
                    store(hall, b, joined.inlet_c, joined.outlet_c, joined.power_w)
                joined.inlet_c = inlets
                joined.outlet_c = outlets
                joined.power_w = powers
                for whole_b in range(b + 1, start >> LANE_BITS):
                    store(hall, whole_b, inlets, outlets, powers)
            if s < low or start > high:
                if s >= low:
                    s = ti.max(s, high)
                while s < ti.min(start, end):
                    hall.layers[0][s] = inlet_c
                    hall.layers[1][s] = outlet_c
                    hall.layers[2][s] = power_w
                    s += hall.step
                    if s == low:
                        s = ti.max(s, high)
            z += 1
        lane += 1


@ti.func
@no_type_check
def to_all_lanes(
    racks: ti.template(), air: ti.template(), lane, of_racks: ti.template(), of_air: ti.template()
):
    """What groups take of one rack of a block, and of the air before it."""
    of_racks.uneven = ti.Vector([racks.uneven[lane]] * LANES)
    of_racks.cpu_base = ti.Vector([racks.cpu_base[lane]] * LANES)
    of_racks.fan_base = ti.Vector([racks.fan_base[lane]] * LANES)
    of_racks.powered = ti.Vector([racks.powered[lane]] * LANES)
    of_racks.per_speed_m3s = ti.Vector([racks.per_speed_m3s[lane]] * LANES)
    of_racks.per_speed_w = ti.Vector([racks.per_speed_w[lane]] * LANES)
    of_racks.first_group = ti.Vector([racks.first_group[lane] + i for i in range(LANES)])
    of_air.least_c = ti.Vector([air.least_c[lane]] * LANES)
    of_air.per_height_k = ti.Vector([air.per_height_k[lane]] * LANES)


@ti.func
@no_type_check
def compute_values(
    hall: ti.template(),
    servers: ti.template(),
    racks: ti.template(),
    air: ti.template(),
    group,
    z,
    server_c,
):
    """Inlet, outlet and power of groups in the last sweep, or at the end of the last substep.

    A server gives T + P/(rho*cp*V); in transient halls T + eps (T_s - T) + P_fan/(rho*cp*V), with
    its own temperature T_s and the supply air that follows the last substep.
    """
    inlet_c, draws_w, speed, fan_power = of_group(hall, servers, racks, air, group, z)
    flow_m3s = speed * racks.per_speed_m3s
    cpu_w, fan_w = racks.powered * draws_w, fan_power * racks.per_speed_w
    to_air_w = cpu_w
    if ti.static(hall.transient):
        to_air_w = flow_m3s * servers.taken_up_j_per_m3_k * (server_c - inlet_c)
    per_k = larger(flow_m3s * servers.air_j_per_m3_k, hall.zeros + hall.real(1e-30))
    return inlet_c, inlet_c + (to_air_w + fan_w) / per_k, cpu_w + fan_w


@ti.func
@no_type_check
def write_block(hall: ti.template(), n, block_at, values_at, servers: ti.template(), first_row):
    """Values of the groups of a block to runs of servers; lanes are racks.

    Where each group has one place in the layers, lanes are groups of one rack, which are stored as
    they lie.
    """
    block, place_0 = hall.blocks[block_at], block_at * LANES
    place_1 = place_0 + block.racks
    n_groups = hall.places[place_1].first_group - hall.places[place_0].first_group
    n_values = hall.rack_ints[first_row, place_1] - hall.rack_ints[first_row, place_0]
    in_runs = n_values > n_groups
    racks = racks_of(hall, servers, block_at)
    air = air_before(hall, n, block_at, block.mixed_c, SUPPLY.fresh_ratio_used)
    parts, at, n_vectors, part = 1, block.table, block.groups, 0
    if not in_runs:
        parts, at, n_vectors = block.racks, block.along, (n_vectors + (LANES - 1)) >> LANE_BITS
    while part < parts:
        of_racks, of_air, rack_outlet_c, start, end = racks, air, block.outlet_c, 0, 0
        if not in_runs:
            to_all_lanes(racks, air, part, of_racks, of_air)
            rack_outlet_c = ti.Vector([rack_outlet_c[part]] * LANES)
            start = hall.rack_ints[first_row, place_0 + part]
            end = hall.rack_ints[first_row, place_0 + part + 1]
        fits = start & (LANES - 1) == 0
        v, left = 0, 0
        while v < n_vectors:
            server_c, z = hall.zeros, v
            if not in_runs:
                z = v << LANE_BITS
            if ti.static(hall.transient):
                if in_runs:
                    server_c = hall.server_c[block.place + z]
                else:
                    for i in range(LANES):
                        place = block.place + ti.min(z + i, block.groups - 1)
                        server_c[i] = hall.server_c[place][part]
            inlet_c, outlet_c, power_w = compute_values(
                hall, servers, of_racks, of_air, hall.groups[at + v], z, server_c
            )
            if ti.static(not hall.recirculates):
                if hall.outlet_model != OUTLET_OF_SERVERS:
                    outlet_c = rack_outlet_c
            if not in_runs and fits and start + z + LANES <= end:
                store(hall, (start + z) >> LANE_BITS, inlet_c, outlet_c, power_w)
                left = z + LANES
            else:
                values = hall.values[values_at + v]
                values.inlet_c = inlet_c
                values.outlet_c = outlet_c
                values.power_w = power_w
            v += hall.step
        while start + left < end:
            row = values_at + (left >> LANE_BITS)
            for kind in ti.static(range(N_VALUES)):
                value = hall.group_values[kind, row][left & (LANES - 1)]
                hall.layers[kind][start + left] = value
            left += hall.step
        at += n_vectors
        part += hall.step
    if in_runs:
        spread_runs(hall, block_at, values_at)


@ti.func
@no_type_check
def write_chunk(hall: ti.template(), chunk_at, values_at, each_once):
    """Values of the servers of a chunk, or of each of its groups once."""
    chunk = hall.chunks[chunk_at]
    servers = servers_of(hall, chunk.dc)
    first_row = RACK_INT.first_server
    if each_once != 0:
        first_row = RACK_INT.first_group
    for block_at in range(chunk.first_block, hall.chunks[chunk_at + 1].first_block):
        write_block(hall, chunk.dc, block_at, values_at, servers, first_row)


@cache
def layers_kernel(precision: str) -> Any:
    """Kernel that computes all groups of the last step again and stores their values.

    To all their servers, or with ``each_once`` to themselves; ``..._blocks`` are the layers again
    as vectors. ``group_values`` has room for the groups of a block in each of the slices.
    """
    real = reals(precision)
    log_of, exp_of = log_and_exp(precision, LANES)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    blocks_2d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    blocks_1d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=1)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)
    doubles_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)

    @ti.kernel
    @no_type_check
    def layers(
        recirculates: ti.template(),
        transient: ti.template(),
        serial: ti.template(),
        slices: ti.i32,
        outlet_model: ti.i32,
        loads_of: ti.i32,
        each_once: ti.i32,
        step: ti.i32,
        block_ints: ints_2d,
        rack_ints: ints_2d,
        chunk_ints: ints_2d,
        dc_ints: ints_2d,
        shares: blocks_1d,
        racks: blocks_2d,
        groups: blocks_1d,
        group_load: reals_1d,
        dcs: reals_1d,
        doubles: doubles_2d,
        unit_state: doubles_2d,
        rack_store: blocks_2d,
        server_c: blocks_1d,
        rack_out: blocks_2d,
        group_values: blocks_2d,
        inlet_c: reals_1d,
        outlet_c: reals_1d,
        power_w: reals_1d,
        inlet_blocks: blocks_1d,
        outlet_blocks: blocks_1d,
        power_blocks: blocks_1d,
    ):
        n_chunks = chunk_ints.shape[1] - 1
        if ti.static(serial):
            ti.loop_config(serialize=True)
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                hall = ti.static(
                    shared(
                        real=real,
                        zeros=ti.Vector([ti.cast(0.0, real)] * LANES),
                        log_of=log_of,
                        exp_of=exp_of,
                        recirculates=recirculates,
                        transient=transient,
                        outlet_model=outlet_model,
                        loads_of=loads_of,
                        step=step,
                        dcs=NamedRows((DC_INTS, dc_ints), (DC_ROWS, dcs), (DC_DOUBLES, doubles)),
                        units=NamedRows((UNIT_STATE, unit_state)),
                        chunks=NamedRows((CHUNK_INTS, chunk_ints)),
                        blocks=NamedRows(
                            (BLOCK_INTS, block_ints),
                            (RACK_ROWS, racks),
                            (RACK_STATE, rack_store),
                            (RACK_OUT, rack_out),
                        ),
                        places=NamedRows((RACK_INTS, rack_ints)),
                        groups=NamedRows((GROUP_ROWS, groups)),
                        values=NamedRows((GROUP_OUT, group_values)),
                        group_load=group_load,
                        group_values=group_values,
                        layer_blocks=(inlet_blocks, outlet_blocks, power_blocks),
                        layers=(inlet_c, outlet_c, power_w),
                        rack_ints=rack_ints,
                        server_c=server_c,
                        shares=shares,
                        unit_state=unit_state,
                    )
                )
                values_at = k // SLICE * (group_values.shape[1] // slices)
                first, end = part_of(k // SLICE, slices, n_chunks)
                for chunk_at in range(first, end):
                    write_chunk(hall, chunk_at, values_at, each_once)

    return layers
