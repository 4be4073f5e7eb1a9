"""Sums and extremes over the racks of a chunk, and over the chunks of a data center.

The rows of SUMS form three ranges. Sums of RACK_MEANS (rows before ``FIRST_TERM``) are needed at
the end of a step. Sums of TERMS before ``FIRST_OF_SWEEP`` are also needed at the end, in transient
halls for all substeps. CRAC units and convergence test need the other rows after every sweep.
"""

from typing import no_type_check

import taichi as ti

from .arguments import row_index
from .hall_arguments import LANES, RACK_MEANS, RANKS_PER_K, SUMS, TERMS

N_SUMS = len(SUMS)
FIRST_TERM = len(RACK_MEANS)
"""First row with the sum of one of TERMS; the rows have the order of TERMS."""
FIRST_OF_SWEEP = row_index(SUMS, "flow_m3s")
"""First row that concerns only the present sweep or substep."""
END_OF_TERMS = FIRST_TERM + len(TERMS)
"""Index after the last row with a sum."""


@ti.func
@no_type_check
def present_substep_s(hall: ti.template(), n):
    """Return the length of the present substep of a data center, in s."""
    return hall.substep_s * ti.cast(hall.dcs[n].length, ti.f64)


@ti.func
@no_type_check
def sum_lanes(lanes):
    """Return the sum over the lanes of a vector, in f64."""
    total = ti.cast(0.0, ti.f64)
    # Add neighbours first: it shortens the chain of dependent additions.
    for i in ti.static(range(0, LANES, 4)):
        one = ti.cast(lanes[i], ti.f64) + ti.cast(lanes[i + 1], ti.f64)
        other = ti.cast(lanes[i + 2], ti.f64) + ti.cast(lanes[i + 3], ti.f64)
        total += one + other
    return total


@ti.func
@no_type_check
def sum_racks(hall: ti.template(), chunk_at, row):
    """Return the sum of a row of RACK_MEANS over the racks of a chunk, in f64."""
    lanes = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
    block_at = hall.chunks[chunk_at].first_block
    while block_at < hall.chunks[chunk_at + 1].first_block:
        value = hall.rack_out[row, block_at]
        for i in range(LANES):
            lanes[i] += ti.cast(value[i], ti.f64)
        block_at += hall.one
    return sum_lanes(lanes)


@ti.func
@no_type_check
def sum_chunk(hall: ti.template(), chunk_at, terms_at, first_row, end_row, adds):
    """Compute rows of SUMS of a chunk from its racks and its TERMS.

    ``adds``: add TERMS before FIRST_OF_SWEEP to the sums of earlier substeps.
    """
    row, sums_at = first_row, chunk_at * N_SUMS
    while row < end_row:
        total = ti.cast(0.0, ti.f64)
        if row < FIRST_TERM:
            total = sum_racks(hall, chunk_at, row)
        else:
            total = sum_lanes(hall.scratch[terms_at + row - FIRST_TERM])
            if adds and row < FIRST_OF_SWEEP:
                total += hall.chunk_sums[sums_at + row]
        hall.chunk_sums[sums_at + row] = total
        row += hall.one


@ti.func
@no_type_check
def rank(hall: ti.template(), temperature_c):
    """Return the rank of each temperature, an integer that is the same for equal racks."""
    return ti.floor(temperature_c * hall.real(RANKS_PER_K) + hall.real(0.5))


@ti.func
@no_type_check
def find_hottest_rack(hall: ti.template(), chunk_at, hottest: ti.template(), adds):
    """Find the hottest rack of a chunk from the hottest inlet in each lane.

    Of racks with equal rank, the first counts. ``adds``: the rack must also be hotter than the
    hottest of earlier substeps.
    """
    chunk = hall.chunks[chunk_at]
    most_c, block, lane, group = hall.real(-1e30), 0, 0, hall.real(0.0)
    highest, i = rank(hall, most_c), 0
    while i < LANES:
        inlet_c = hottest.inlet_c[i]
        lane_rank = rank(hall, inlet_c)
        if lane_rank > highest or (lane_rank == highest and hottest.block[i] < block):
            highest, block, lane, group = lane_rank, hottest.block[i], i, hottest.group[i]
        most_c = ti.max(inlet_c, most_c)
        i += hall.one
    before_c = chunk.inlet_max_c
    if not adds or ti.cast(most_c, ti.f64) > before_c:
        chunk.inlet_max_c = ti.cast(most_c, ti.f64)
    if not adds or ti.cast(highest, ti.f64) > rank(hall, before_c):
        chunk.hottest_block = ti.cast(block, ti.f64)
        chunk.hottest_lane = ti.cast(lane, ti.f64)
        chunk.hottest_group = ti.cast(group, ti.f64)


@ti.func
@no_type_check
def store_change_range(hall: ti.template(), chunk_at, least_k, most_k):
    """Store the extremes over the lanes of two vectors as bounds of the changes of the mixes."""
    chunk, least, most = hall.chunks[chunk_at], hall.real(1e30), hall.real(-1e30)
    for i in range(LANES):
        least = ti.select(least_k[i] < least, least_k[i], least)
        most = ti.select(most_k[i] > most, most_k[i], most)
    chunk.least_change_k = ti.cast(least, ti.f64)
    chunk.most_change_k = ti.cast(most, ti.f64)


@ti.func
@no_type_check
def store_present_inlet(hall: ti.template(), chunk_at, inlet_max_c):
    """Store the hottest inlet of a chunk in the present sweep, the maximum over the lanes."""
    most_c = hall.real(-1e30)
    for i in range(LANES):
        most_c = ti.select(inlet_max_c[i] > most_c, inlet_max_c[i], most_c)
    hall.chunks[chunk_at].present_inlet_max_c = ti.cast(most_c, ti.f64)


@ti.func
@no_type_check
def add_chunks(hall: ti.template(), n, first_row, end_row):
    """Add rows of SUMS of all chunks of a data center to the rows of its first chunk."""
    first = hall.dcs[n].first_chunk
    chunk_at = first + 1
    while chunk_at < hall.dcs[n + 1].first_chunk:
        row = first_row
        while row < end_row:
            at = first * N_SUMS + row
            hall.chunk_sums[at] = hall.chunk_sums[at] + hall.chunk_sums[chunk_at * N_SUMS + row]
            row += hall.one
        chunk_at += hall.one


@ti.func
@no_type_check
def combine_chunks(hall: ti.template(), n):
    """Combine sums of the sweep, and extremes, of a data center's chunks in its first chunk."""
    add_chunks(hall, n, FIRST_OF_SWEEP, END_OF_TERMS)
    first = hall.dcs[n].first_chunk
    total, chunk_at = hall.chunks[first], first + 1
    while chunk_at < hall.dcs[n + 1].first_chunk:
        chunk = hall.chunks[chunk_at]
        if rank(hall, chunk.inlet_max_c) > rank(hall, total.inlet_max_c):
            total.hottest_block = chunk.hottest_block
            total.hottest_lane = chunk.hottest_lane
            total.hottest_group = chunk.hottest_group
        total.inlet_max_c = ti.max(total.inlet_max_c, chunk.inlet_max_c)
        total.present_inlet_max_c = ti.max(total.present_inlet_max_c, chunk.present_inlet_max_c)
        total.least_change_k = ti.min(total.least_change_k, chunk.least_change_k)
        total.most_change_k = ti.max(total.most_change_k, chunk.most_change_k)
        chunk_at += hall.one
