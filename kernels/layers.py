"""Kernel of per-server values after a step: inlet, outlet and power, computed group by group."""

from functools import cache
from typing import Any, no_type_check

import taichi as ti

from .arguments import row_index
from .compiler.functions import larger, part_of
from .compiler.named_kernel import define_kernel
from .elementary import log_and_exp
from .hall_arguments import (
    LANE_BITS,
    LANES,
    LAYERS_ARGUMENTS,
    PLACE_INTS,
)
from .servers import OUTLET_OF_SERVERS, compute_group, intake_air, rack_model, server_model

FIRST_GROUP, FIRST_SERVER = (row_index(PLACE_INTS, name) for name in PLACE_INTS)


@ti.func
@no_type_check
def store_vector(hall: ti.template(), b, inlet_c, outlet_c, power_w):
    """Store the values of a vector of servers at index b of the per-server vectors."""
    hall.inlet_vectors[b] = inlet_c
    hall.outlet_vectors[b] = outlet_c
    hall.power_vectors[b] = power_w


@ti.func
@no_type_check
def spread_to_servers(hall: ti.template(), block_at, values_at):
    """Copy the values of the groups of a block to their servers, mostly in whole vectors."""
    block, place_0 = hall.blocks[block_at], block_at * LANES
    start = hall.places[place_0].first_server
    end = hall.places[place_0 + block.racks].first_server
    # Vectors from low to high contain servers of this block only.
    low, high = (start + (LANES - 1)) & -LANES, end & -LANES
    numbers = ti.Vector([i for i in range(LANES)])
    joined = ti.Struct(inlet_c=hall.zeros, outlet_c=hall.zeros, power_w=hall.zeros)
    lane, first_row = 0, block.first_row
    while lane < block.racks:
        end = hall.places[place_0 + lane + 1].first_server
        z = 0
        while start < end:
            s, b = start, start >> LANE_BITS
            start += ti.cast(hall.groups[first_row + z].count[lane], ti.i32)
            values = hall.values[values_at + z]
            inlet_c, outlet_c = values.inlet_c[lane], values.outlet_c[lane]
            power_w = values.power_w[lane]
            inlets, outlets = ti.Vector([inlet_c] * LANES), ti.Vector([outlet_c] * LANES)
            powers = ti.Vector([power_w] * LANES)
            # The vector in which a run of servers begins also contains the end of earlier runs.
            before = numbers < (s & (LANES - 1))
            joined.inlet_c = ti.select(before, joined.inlet_c, inlets)
            joined.outlet_c = ti.select(before, joined.outlet_c, outlets)
            joined.power_w = ti.select(before, joined.power_w, powers)
            if b < start >> LANE_BITS:
                if b << LANE_BITS >= low:
                    store_vector(hall, b, joined.inlet_c, joined.outlet_c, joined.power_w)
                joined.inlet_c = inlets
                joined.outlet_c = outlets
                joined.power_w = powers
                for whole_b in range(b + 1, start >> LANE_BITS):
                    store_vector(hall, whole_b, inlets, outlets, powers)
            if s < low or start > high:
                if s >= low:
                    s = ti.max(s, high)
                while s < ti.min(start, end):
                    hall.inlet_c[s] = inlet_c
                    hall.outlet_c[s] = outlet_c
                    hall.power_w[s] = power_w
                    s += hall.one
                    if s == low:
                        s = ti.max(s, high)
            z += 1
        lane += 1


@ti.func
@no_type_check
def broadcast_rack(
    racks: ti.template(), air: ti.template(), lane, of_racks: ti.template(), of_air: ti.template()
):
    """Copy the values of one rack, and of its intake air, to all lanes, for groups of that rack."""
    of_racks.deviation_scale = ti.Vector([racks.deviation_scale[lane]] * LANES)
    of_racks.utilisation = ti.Vector([racks.utilisation[lane]] * LANES)
    of_racks.cpu_base = ti.Vector([racks.cpu_base[lane]] * LANES)
    of_racks.fan_base = ti.Vector([racks.fan_base[lane]] * LANES)
    of_racks.fan_low = ti.Vector([racks.fan_low[lane]] * LANES)
    of_racks.heat_w = ti.Vector([racks.heat_w[lane]] * LANES)
    of_racks.powered = ti.Vector([racks.powered[lane]] * LANES)
    of_racks.full_m3s = ti.Vector([racks.full_m3s[lane]] * LANES)
    of_racks.full_fan_w = ti.Vector([racks.full_fan_w[lane]] * LANES)
    of_racks.first_group = ti.Vector([racks.first_group[lane] + i for i in range(LANES)])
    of_racks.last_group = ti.Vector([racks.last_group[lane]] * LANES)
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
    """Return inlet, outlet and power of groups in the last sweep, or after the last substep.

    The outlet of a server is T + P/(rho*cp*V). In transient halls it is
    T + eps (T_s - T) + P_fan/(rho*cp*V), with the server temperature T_s and the inlet T from the
    supply air after the last substep.
    """
    inlet_c, cpu_w, airflow, fan_power = compute_group(hall, servers, racks, air, group, z)
    flow_m3s = airflow * racks.full_m3s
    cpu_w, fan_w = racks.powered * cpu_w, fan_power * racks.full_fan_w
    to_air_w = cpu_w
    if ti.static(hall.transient):
        to_air_w = flow_m3s * servers.uptake_j_per_m3_k * (server_c - inlet_c)
    per_k = larger(flow_m3s * servers.air_j_per_m3_k, hall.zeros + hall.real(1e-30))
    return inlet_c, inlet_c + (to_air_w + fan_w) / per_k, cpu_w + fan_w


@ti.func
@no_type_check
def write_block(hall: ti.template(), n, block_at, values_at, servers: ti.template(), offset_row):
    """Compute the groups of a block and store their values, once per server or once per group.

    If layers have one value per server, lanes are racks, and their values are copied to runs of
    servers. If they have one value per group, lanes are groups of one rack, stored directly.
    ``offset_row`` is the row of PLACE_INTS with the first index of a rack in the layers.
    """
    block, place_0 = hall.blocks[block_at], block_at * LANES
    place_1 = place_0 + block.racks
    n_groups = hall.places[place_1].first_group - hall.places[place_0].first_group
    n_values = hall.place_ints[offset_row, place_1] - hall.place_ints[offset_row, place_0]
    in_runs = n_values > n_groups
    racks = rack_model(hall, servers, block_at)
    air = intake_air(hall, n, block_at, block.mixed_c, True)
    # One pass computes all racks of the block, or each pass computes one rack.
    passes, row, n_vectors, rack = 1, block.first_row, block.groups, 0
    if not in_runs:
        passes, row = block.racks, block.first_row_along
        n_vectors = (n_vectors + (LANES - 1)) >> LANE_BITS
    while rack < passes:
        of_racks, of_air, rack_outlet_c, start, end = racks, air, block.outlet_c, 0, 0
        if not in_runs:
            broadcast_rack(racks, air, rack, of_racks, of_air)
            rack_outlet_c = ti.Vector([rack_outlet_c[rack]] * LANES)
            start = hall.place_ints[offset_row, place_0 + rack]
            end = hall.place_ints[offset_row, place_0 + rack + 1]
        is_aligned = start & (LANES - 1) == 0
        v, stored = 0, 0
        while v < n_vectors:
            z = v
            if not in_runs:
                z = v << LANE_BITS
            server_c = hall.zeros
            if ti.static(hall.transient):
                server_c = server_temperatures(hall, block_at, rack, z, in_runs)
            inlet_c, outlet_c, power_w = compute_values(
                hall, servers, of_racks, of_air, hall.groups[row + v], z, server_c
            )
            if ti.static(not hall.recirculates):
                if hall.outlet_model != OUTLET_OF_SERVERS:
                    outlet_c = rack_outlet_c
            if not in_runs and is_aligned and start + z + LANES <= end:
                store_vector(hall, (start + z) >> LANE_BITS, inlet_c, outlet_c, power_w)
                stored = z + LANES
            else:
                values = hall.values[values_at + v]
                values.inlet_c = inlet_c
                values.outlet_c = outlet_c
                values.power_w = power_w
            v += hall.one
        while start + stored < end:
            values = hall.values[values_at + (stored >> LANE_BITS)]
            hall.inlet_c[start + stored] = values.inlet_c[stored & (LANES - 1)]
            hall.outlet_c[start + stored] = values.outlet_c[stored & (LANES - 1)]
            hall.power_w[start + stored] = values.power_w[stored & (LANES - 1)]
            stored += hall.one
        row += n_vectors
        rack += hall.one
    if in_runs:
        spread_to_servers(hall, block_at, values_at)


@ti.func
@no_type_check
def server_temperatures(hall: ti.template(), block_at, rack, z, in_runs):
    """Return server temperatures: group z of all racks, or the groups from z on of one rack."""
    block = hall.blocks[block_at]
    server_c = hall.zeros
    if in_runs:
        server_c = hall.server_c[block.first_place + z]
    else:
        for i in range(LANES):
            place = block.first_place + ti.min(z + i, block.groups - 1)
            server_c[i] = hall.server_c[place][rack]
    return server_c


@ti.func
@no_type_check
def write_chunk(hall: ti.template(), chunk_at, values_at):
    """Write per-server values of a chunk, once per server or once per group."""
    chunk = hall.chunks[chunk_at]
    servers = server_model(hall, chunk.dc)
    offset_row = FIRST_SERVER
    if hall.per_group != 0:
        offset_row = FIRST_GROUP
    for block_at in range(chunk.first_block, hall.chunks[chunk_at + 1].first_block):
        write_block(hall, chunk.dc, block_at, values_at, servers, offset_row)


@ti.func
@no_type_check
def write_slice(hall: ti.template(), slice_at):
    """Write the chunks of slice ``slice_at``, one of ``slices`` equal parts of all chunks."""
    first, end = part_of(slice_at, hall.slices, hall.chunk_ints.shape[1] - 1)
    values_at = slice_at * (hall.group_values.shape[1] // hall.slices)
    for chunk_at in range(first, end):
        write_chunk(hall, chunk_at, values_at)


@cache
def layers_kernel(precision: str) -> Any:
    """Return the kernel that recomputes the groups of the last step and stores per-server values.

    LAYERS_ARGUMENTS lists its arguments.

    Args:
        precision: ``f32`` or ``f64``.
    """
    log_of, exp_of = log_and_exp(precision, LANES)
    return define_kernel(
        "hall_layers",
        LAYERS_ARGUMENTS,
        write_slice,
        precision=precision,
        lanes=LANES,
        constants={"log_of": log_of, "exp_of": exp_of},
    )
