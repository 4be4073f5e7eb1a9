"""Sums and extremes over the racks of a chunk, and over the chunks of a data center."""

from typing import no_type_check

import taichi as ti

from .thermal import LANES, RACK_OUT, SUM, SUMS

N_SUMS = len(SUMS)
N_RACK_SUMS = len(RACK_OUT) - 1
"""Sums of what racks keep come first, then those of the lanes that ``TERMS`` name."""
FIRST_OF_SWEEP = SUM.flow_m3s
"""From here on sums are of the present sweep or substep alone."""


@ti.func
@no_type_check
def sum_of(lanes):
    """In f64; neighbours first, since each addition waits for the one before."""
    total = ti.cast(0.0, ti.f64)
    for i in ti.static(range(0, LANES, 4)):
        one = ti.cast(lanes[i], ti.f64) + ti.cast(lanes[i + 1], ti.f64)
        other = ti.cast(lanes[i + 2], ti.f64) + ti.cast(lanes[i + 3], ti.f64)
        total += one + other
    return total


@ti.func
@no_type_check
def add_up(hall: ti.template(), chunk_at, terms_at, first_row, end_row, adds):
    """Sums over the racks of a chunk, ``adds`` to those of substeps before."""
    row, at = first_row, chunk_at * N_SUMS
    while row < end_row:
        total = ti.cast(0.0, ti.f64)
        if row < N_RACK_SUMS:
            lanes = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
            block_at = hall.chunks[chunk_at].first_block
            while block_at < hall.chunks[chunk_at + 1].first_block:
                value = hall.rack_out[row, block_at]
                for i in range(LANES):
                    lanes[i] += ti.cast(value[i], ti.f64)
                block_at += hall.step
            total = sum_of(lanes)
        else:
            total = sum_of(hall.scratch[terms_at + row - N_RACK_SUMS])
            if adds and row < FIRST_OF_SWEEP:
                total += hall.sums[at + row]
        hall.sums[at + row] = total
        row += hall.step


@ti.func
@no_type_check
def find_hottest(hall: ti.template(), chunk_at, hottest: ti.template(), adds):
    """The first of the racks with the hottest inlet, ``adds`` to those of substeps before."""
    chunk = hall.chunks[chunk_at]
    most_c, block, lane, zone = hall.real(-1e30), 0, 0, hall.real(0.0)
    i = 0
    while i < LANES:
        inlet_c = hottest.inlet_c[i]
        if inlet_c > most_c or (inlet_c == most_c and hottest.block[i] < block):
            most_c, block, lane, zone = inlet_c, hottest.block[i], i, hottest.zone[i]
        i += hall.step
    if not adds or ti.cast(most_c, ti.f64) > chunk.inlet_max_c:
        chunk.inlet_max_c = ti.cast(most_c, ti.f64)
        chunk.hottest_block = ti.cast(block, ti.f64)
        chunk.hottest_lane = ti.cast(lane, ti.f64)
        chunk.hottest_zone = ti.cast(zone, ti.f64)


@ti.func
@no_type_check
def keep_range(hall: ti.template(), chunk_at, least_k, most_k):
    """Least and most over the lanes of a chunk."""
    chunk, least, most = hall.chunks[chunk_at], hall.real(1e30), hall.real(-1e30)
    for i in range(LANES):
        least = ti.select(least_k[i] < least, least_k[i], least)
        most = ti.select(most_k[i] > most, most_k[i], most)
    chunk.least_k = ti.cast(least, ti.f64)
    chunk.most_k = ti.cast(most, ti.f64)


@ti.func
@no_type_check
def join_rows(hall: ti.template(), n, first_row, end_row):
    """Rows of the sums of all chunks of a data center to those of its first."""
    first = hall.dcs[n].first_chunk
    chunk_at = first + 1
    while chunk_at < hall.dcs[n + 1].first_chunk:
        row = first_row
        while row < end_row:
            at = first * N_SUMS + row
            hall.sums[at] = hall.sums[at] + hall.sums[chunk_at * N_SUMS + row]
            row += hall.step
        chunk_at += hall.step


@ti.func
@no_type_check
def join_chunks(hall: ti.template(), n):
    """What a sweep needs of all chunks of a data center, to its first."""
    join_rows(hall, n, FIRST_OF_SWEEP, SUM.inlet_max_c)
    first = hall.dcs[n].first_chunk
    total, chunk_at = hall.chunks[first], first + 1
    while chunk_at < hall.dcs[n + 1].first_chunk:
        chunk = hall.chunks[chunk_at]
        if chunk.inlet_max_c > total.inlet_max_c:
            total.inlet_max_c = chunk.inlet_max_c
            total.hottest_block = chunk.hottest_block
            total.hottest_lane = chunk.hottest_lane
            total.hottest_zone = chunk.hottest_zone
        total.least_k = ti.min(total.least_k, chunk.least_k)
        total.most_k = ti.max(total.most_k, chunk.most_k)
        chunk_at += hall.step
