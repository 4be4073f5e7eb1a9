"""The exhaust mixes before the racks: where they start, their exchange, and when they stand still.

Halls that keep every weight exchange after each sweep, which tells exactly what the next would
move. Their next sweep starts from where the mixes go when the share ``kept`` of what they change by
comes back from the racks for ever. In larger halls, whose exchange costs more than a sweep: the
weights of a mix sum to 1, so it moves by no more than the exhausts have moved since the last
exchange; where all of them moved alike, the mixes are shifted and nothing is exchanged. Steps on by
k/(1 - k) of a move, of which k is kept, are those of Aitken (1926).
"""

from typing import no_type_check

import taichi as ti

from .compiler.functions import larger, smaller
from .decay import doublings, gone_per, halved
from .sums import keep_range
from .thermal import (
    LANES,
    N_BLOCK_TERMS,
    PATTERNS,
    RUN_BLOCKS,
    RUN_LANES,
    SOURCES,
    STATE,
)

ALIKE = 0.25
"""Where the outlets' moves since the last exchange differ from their middle by less than this share
of the tolerance, the mixes are shifted instead of exchanged; they err by no more than that, which
leaves the sweeps room to settle within the tolerance."""
EXPECTED_KEPT, SEEN_KEPT = 0.5, 0.75
"""Most of a common deviation that a sweep may keep by expectation, and as the last one showed: the
step that ends it at once is then at most 2 and 4 times the sweep's own. Bounds against overshoot
where the airflow curves bend; a sweep that takes no such step never overshoots."""
SEEN_FROM = 32.0
"""Moves of fewer tolerances than this are too coarse in f32 to tell what a sweep keeps."""
PLAIN_EVERY = 4
"""One sweep of so many goes by what was exchanged alone, so that a wrong share cannot go on for
ever."""
STILL_PER_S = 1.0 / 128.0
"""Fastest rate at which CRAC air stirs the air before racks that stand still, as without fans in
the room; a power of two, exact in both precisions."""


@ti.func
@no_type_check
def cubic(x):
    """Weights of four points for the place x between the inner two (Catmull and Rom 1974).

    Racks loaded alike take fewer sweeps from here than from a straight line.
    """
    return ti.Vector(
        [
            0.5 * x * (x * (2.0 - x) - 1.0),
            0.5 * (x * x * (3.0 * x - 5.0) + 2.0),
            0.5 * x * (x * (4.0 - 3.0 * x) + 1.0),
            0.5 * x * x * (x - 1.0),
        ]
    )


@ti.func
@no_type_check
def expect(hall: ti.template(), n):
    """How much of each pattern to start from, and last ``kept``.

    By the supply air of the first unit; that of the others is near enough to start from.
    """
    dc = hall.dcs[n]
    rows, columns = dc.start_rows, hall.start_columns
    y = (hall.units[dc.first_unit].supply_c - dc.start_low_c) * dc.start_per_k
    y = ti.min(ti.max(y, 0.0), ti.cast(rows - 1, ti.f64))
    x = ti.min(ti.max(dc.utilisation, 0.0), 1.0) * ti.cast(columns - 1, ti.f64)
    row = ti.min(ti.cast(y, ti.i32), rows - 2)
    column = ti.min(ti.cast(x, ti.i32), columns - 2)
    of_rows, of_columns = cubic(y - row), cubic(x - column)
    at = dc.start + row * (columns + 2) + column
    start = hall.zeros
    for i in ti.static(range(4)):
        for j in ti.static(range(4)):
            start += hall.starts[at + j] * ti.cast(of_rows[i] * of_columns[j], hall.real)
        at += columns + 2
    dc.kept = ti.cast(start[PATTERNS], ti.f64)
    return start


@ti.func
@no_type_check
def start_mix(hall: ti.template(), n, block_at, now: ti.template(), start):
    """Mix before the racks of a block that a steady state is looked for from.

    The patterns of halls that keep every weight are mixes. Those of others are of the mixes and of
    what the racks give, which the next exchanges are held against.
    """
    block, chunk_0 = hall.blocks[block_at], hall.dcs[n].first_chunk
    pattern = hall.dcs[n].pattern
    pattern += (block_at - hall.chunks[chunk_0].first_block) * PATTERNS
    mix_c = hall.zeros + now.reference_c
    if now.at_once:
        for k in ti.static(range(PATTERNS)):
            mix_c += hall.starts[pattern + k] * start[k]
    else:
        gives_c = mix_c
        for k in ti.static(range(2)):
            mix_c += hall.starts[pattern + k] * start[k]
            gives_c += hall.starts[pattern + 2 + k] * start[k]
        gives_c *= block.strength
        hall.rack_store[STATE.exhaust_c + now.side, block_at] = gives_c
        block.exchanged_c = mix_c
    return mix_c


@ti.func
@no_type_check
def mixed_from(hall: ti.template(), at, first, count):
    """Mixes before the racks of a block, or what they change by, from all racks of the hall."""
    sums = ti.Vector([ti.cast(0.0, hall.real)] * (SOURCES * LANES))
    e = 0
    while e < count:
        x = hall.rack_sources[first + e]
        sums += hall.mix[at + e] * ti.Vector(
            [x[i // LANES] for i in ti.static(range(SOURCES * LANES))]
        )
        e += hall.step
    out = hall.zeros
    for i in range(LANES):
        for source in ti.static(range(SOURCES)):
            out[i] += sums[source * LANES + i]
    return out


@ti.func
@no_type_check
def mixed_from_runs(hall: ti.template(), block_at, side):
    """The same of halls that drop weights, by runs of neighbouring racks."""
    mix_c = hall.zeros
    from_0 = (STATE.exhaust_c + side) * hall.rack_store.shape[1] // RUN_BLOCKS
    lane = 0
    while lane < LANES:
        at = block_at * LANES + lane
        parts = ti.Vector([ti.cast(0.0, hall.real)] * RUN_LANES)
        run = hall.run_start[at]
        while run < hall.run_start[at + 1]:
            x = from_0 + hall.runs[run].first
            w = hall.runs[run].offset
            end = w + hall.runs[run].length
            while w < end:
                parts += hall.weights[w] * hall.run_sources[x]
                w += hall.step
                x += hall.step
            run += hall.step
        t = hall.real(0.0)
        for j in range(RUN_LANES):
            t += parts[j]
        mix_c[lane] = t
        lane += hall.step
    mix_c *= hall.blocks[block_at].norm
    return mix_c


@ti.func
@no_type_check
def exchanged(hall: ti.template(), n, block_at, side):
    """Mix before the racks of a block from what the racks gave in the sweep before."""
    dc, mix_c = hall.dcs[n], hall.zeros
    at_once = False
    if ti.static(hall.transient):
        if dc.mix >= 0:
            at_once = True
            block_0 = hall.chunks[dc.first_chunk].first_block
            n_sources = dc.racks + (SOURCES - 1)
            n_sources //= SOURCES
            first = (STATE.exhaust_c + side) * hall.rack_store.shape[1] + block_0
            mix_c = mixed_from(
                hall,
                dc.mix + (block_at - block_0) * n_sources,
                first * (LANES // SOURCES),
                n_sources,
            )
    if not at_once:
        mix_c = mixed_from_runs(hall, block_at, side)
    return mix_c


@ti.func
@no_type_check
def next_mix(hall: ti.template(), n, block_at, now: ti.template(), start):
    """Mix before the racks of a block in the present sweep."""
    block = hall.blocks[block_at]
    mix_c = block.exchanged_c
    if now.anew:
        mix_c = exchanged(hall, n, block_at, now.side)
        block.exchanged_c = mix_c
    elif ti.static(not hall.transient):
        if now.begins:
            mix_c = start_mix(hall, n, block_at, now, start)
    return mix_c + now.shift_k


@ti.func
@no_type_check
def exchange_at_once(hall: ti.template(), n, chunk_at, again, reference_c):
    """Mixes of a data center of one chunk that keeps every weight, in two passes.

    The first tells what the mixes change by if the racks answer no more. The other lets the
    share ``kept`` of that come back from the racks again and again, now and then not; what
    comes back is exchanged once and taken as alike from then on.
    """
    dc, chunk = hall.dcs[n], hall.chunks[chunk_at]
    block_0, block_1 = chunk.first_block, hall.chunks[chunk_at + 1].first_block
    n_sources = (dc.racks + (SOURCES - 1)) // SOURCES
    base_c = hall.zeros
    if again == 0:
        base_c += reference_c
    else:
        kept = ti.min(dc.kept, EXPECTED_KEPT)
        if dc.sweep % PLAIN_EVERY == 0:
            kept = 0.0
        back = ti.cast(kept / (1.0 - kept), hall.real)
        block_at = block_0
        while block_at < block_1:
            block = hall.blocks[block_at]
            move_k = block.exchanged_c - block.mixed_c
            block.given_k = move_k * block.strength * back
            block_at += hall.step
    least_k = hall.zeros
    most_k = least_k
    first = (STATE.given_k * hall.rack_store.shape[1] + block_0) * (LANES // SOURCES)
    block_at = block_0
    while block_at < block_1:
        block = hall.blocks[block_at]
        at = dc.mix + (block_at - block_0) * n_sources
        if again > 0:
            base_c = block.exchanged_c
        mixed_c = base_c + mixed_from(hall, at, first, n_sources)
        block.exchanged_c = mixed_c
        move_k = mixed_c - block.mixed_c
        least_k = smaller(move_k, least_k)
        most_k = larger(move_k, most_k)
        block_at += hall.step
    if again == 0:
        keep_range(hall, chunk_at, least_k, most_k)


@ti.func
@no_type_check
def parcels_of(hall: ti.template(), n, chunk_at, servers: ti.template()):
    """How the recirculated air before the racks of a chunk follows its mix in a substep.

    With the time constant of its share of the room air; before racks that take in none, the CRAC
    air stirs it.
    """
    dc = hall.dcs[n]
    parcel_j_per_k = dc.parcel_j_per_k
    step_s = ti.cast(hall.substep_s, hall.real)
    per_m3 = servers.air_j_per_m3_k / parcel_j_per_k
    stirring_m3s = ti.cast(dc.stirring_m3s, hall.real)
    still_per_s = ti.min(
        hall.real(STILL_PER_S), servers.air_j_per_m3_k * stirring_m3s / parcel_j_per_k
    )
    captured_m3s = hall.zeros
    block_at = hall.chunks[chunk_at].first_block
    while block_at < hall.chunks[chunk_at + 1].first_block:
        captured_m3s = larger(hall.blocks[block_at].captured_m3s, captured_m3s)
        block_at += hall.step
    most_m3s = captured_m3s[0]
    for i in range(1, LANES):
        most_m3s = ti.select(captured_m3s[i] > most_m3s, captured_m3s[i], most_m3s)
    times = doublings(hall, ti.max(most_m3s * per_m3, still_per_s) * step_s)
    scale = halved(hall, times)
    return ti.Struct(
        per_m3=per_m3,
        still_per_s=hall.zeros + still_per_s,
        times=times,
        scale=scale,
        scaled_s=step_s * scale,
        w_per_k=parcel_j_per_k * (hall.real(1.0) / step_s),
    )


@ti.func
@no_type_check
def follow_mixes(
    hall: ti.template(), n, chunk_at, block_terms_0, now: ti.template(), servers: ti.template()
):
    """Means of the air before the racks of a chunk over a substep, and the heat that warms it.

    Parcels of room air before the racks: air enters at the mix and leaves at their own temperature,
    C_parcel dT/dt = rho*cp*V_captured (T_mix - T).
    """
    parcels = parcels_of(hall, n, chunk_at, servers)
    block_at, terms_at = hall.chunks[chunk_at].first_block, block_terms_0
    while block_at < hall.chunks[chunk_at + 1].first_block:
        block, terms = hall.blocks[block_at], hall.block_terms[terms_at]
        mix_c, was_c = next_mix(hall, n, block_at, now, hall.zeros), block.mixed_c
        x = larger(block.captured_m3s * parcels.per_m3, parcels.still_per_s) * parcels.scaled_s
        gone = gone_per(hall, x, parcels.times)
        change_k = (mix_c - was_c) * (x * gone)
        ones = hall.zeros + hall.real(1.0)
        is_rack = ti.select(block.per_server > hall.real(0.0), ones, hall.zeros)
        terms.parcel_w = is_rack * change_k * parcels.w_per_k
        terms.mixed_c = mix_c + (was_c - mix_c) * (gone * parcels.scale)
        block.mixed_c = was_c + change_k
        block_at += hall.step
        terms_at += N_BLOCK_TERMS


@ti.func
@no_type_check
def judge_sweep(hall: ti.template(), n, supply_c, uncovered, more):
    """Whether a data center in steady air is at its end; CRAC units must cover what they did."""
    dc, total = hall.dcs[n], hall.chunks[hall.dcs[n].first_chunk]
    least_k, most_k, shift_k = total.least_k, total.most_k, dc.shift_k
    left_k = ti.max(most_k - shift_k, shift_k - least_k)
    # The mixes cool or warm by less than what they lie above supply air.
    above_k = ti.abs(total.given_c / ti.cast(dc.racks, ti.f64) - supply_c)
    left_k = ti.max(left_k, uncovered * above_k)
    ends = True
    dc.active = 0
    if not left_k <= hall.tolerance_k:
        dc.active = 2 * more - 1
        ends = more == 0
    return ends


@ti.func
@no_type_check
def shift_mixes(hall: ti.template(), n, sweep, exchanged_now, middle_k, apart):
    """Shift of all mixes of a data center that drops weights, in its next sweep.

    Most of what is left is the same for all racks and shrinks by a factor, so a sweep can go all
    the way: as expected, or as the last sweep showed, now and then not.
    """
    dc, shift_k = hall.dcs[n], hall.dcs[n].shift_k
    moved_k = middle_k - dc.moved_k
    kept = ti.min(dc.kept, EXPECTED_KEPT)
    moved_far = ti.abs(dc.shifted_k) > SEEN_FROM * hall.tolerance_k
    if sweep > 0 and not exchanged_now and moved_far:
        kept = ti.max(moved_k / dc.shifted_k, 0.0)
        kept = ti.min(kept, SEEN_KEPT)
    if sweep % PLAIN_EVERY == PLAIN_EVERY - 1:
        kept = 0.0
    beyond_k = kept / (1.0 - kept) * (middle_k - shift_k)
    next_k = middle_k + beyond_k
    dc.shifted_k = next_k - shift_k
    dc.moved_k = middle_k
    if apart:
        next_k = beyond_k
        dc.moved_k = 0.0
    dc.shift_k = next_k
