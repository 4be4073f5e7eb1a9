"""Exhaust mixes before the racks: first guess, exchange, and the convergence test of sweeps.

The mix before rack j is T_mix,j = sum_i w_ji T_out,i; the weights w_ji of a rack sum to 1. An
*exchange* computes the mixes from the outlets.

*Dense* halls, of up to 64 racks, store every weight and, in steady air, exchange after each sweep.
The change d of the mixes is then exactly the change that the next sweep would see. Racks respond to
warmer air with a share k of its change, the feedback gain. Without acceleration, the mixes would
further change by k W d, k^2 W^2 d, and so on. The next sweep therefore starts from the sum, about
d + k/(1 - k) W d (Aitken 1926). Example: two racks take in half of each other's exhaust (all
w_ji = 0.5) and respond with k = 0.2. A sweep finds the mixes 1.0 K and 0.6 K warmer, d = (1.0, 0.6)
and W d = (0.8, 0.8). The mixes move by (1.0, 0.6) + 0.25 (0.8, 0.8) = (1.2, 0.8), which is the
limit of all later sweeps.

In *sparse* halls an exchange costs more than a sweep. A mix changes by no more than the exhausts
have changed since the last exchange. Example: if all exhausts have changed by 0.95 to 1.05 K, each
mix would change by 1.00 K, up to 0.05 K more or less. If this spread is below ``ALIKE`` times the
tolerance, the mixes are shifted by 1.00 K without an exchange. The sweeps end when the shifted
mixes would change by less than the tolerance.
"""

from typing import no_type_check

import taichi as ti

from .arguments import row_index
from .compiler.functions import larger, smaller
from .decay import halvings_for, phi1, power_of_half
from .hall_arguments import (
    DENSE_LANES,
    DONE,
    LANES,
    MIX_PATTERNS,
    MODE_VECTORS,
    N_BLOCK_TERMS,
    NOT_CONVERGED,
    RACK_STATE,
    RUNNING,
    SPARSE_BLOCKS,
    SPARSE_LANES,
)
from .servers import first_share_at
from .sums import present_substep_s, store_change_range

EXHAUST_ROW = row_index(RACK_STATE, "exhaust_c")
"""Row of side 0 of the exhausts; the next row is side 1."""
MIX_INPUT_ROW = row_index(RACK_STATE, "mix_input_k")
ALIKE = 0.5
"""Largest spread of outlet changes, as a share of the tolerance, for a shift of the mixes instead
of an exchange. Spread is the deviation from the midpoint of the changes since the last exchange. It
bounds the error of the mixes, and sweeps can still converge within the tolerance."""
MOST_GAIN_EXPECTED, MOST_GAIN_SEEN = 0.5, 0.75
"""Largest feedback gain that is used, from the table and as seen in the last sweep. The step that
sums up all feedback is then at most 2 and 4 times the plain step. These bounds prevent overshoot
at the bends of the airflow curves; a plain step never overshoots."""
GAIN_SEEN_FROM = 32.0
"""Smallest change, in tolerances, from which the feedback gain is estimated; f32 limits it."""
PLAIN_EVERY = 4
"""Period, in sweeps, of plain steps without feedback, so that a wrong gain cannot persist."""
STILL_PER_S = 1.0 / 128.0
"""Fastest rate at which CRAC air stirs the air before racks without airflow, in 1/s, as in a room
without fans. It is a power of two, hence exact in both precisions."""


@ti.func
@no_type_check
def catmull_rom(x):
    """Return weights of four points for position x between the inner two (Catmull and Rom 1974).

    Cubic interpolation saves sweeps of evenly loaded racks, compared to linear interpolation.
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
def guess_supply_c(hall: ti.template(), n):
    """Return the supply air for which mixes are guessed, in C: that of the first unit.

    In halls with liquid-cooled racks it is the mean of all units, see ``add_spread_of_units``.
    """
    dc, more_k = hall.dcs[n], ti.cast(0.0, ti.f64)
    first, at = dc.first_unit, dc.first_unit
    if guesses_by_unit(hall, n):
        while at < hall.dcs[n + 1].first_unit:
            more_k += hall.units[at].supply_c - hall.units[first].supply_c
            at += hall.one
        more_k /= ti.cast(at - first, ti.f64)
    return hall.units[first].supply_c + more_k


@ti.func
@no_type_check
def guesses_by_unit(hall: ti.template(), n):
    """Return True if the guess of a data center includes the spread of the supply air."""
    return hall.dcs[n].first_mix_weight >= 0 and hall.dcs[n].heat_levels > 1


@ti.func
@no_type_check
def add_spread_of_units(hall: ti.template(), n, chunk_at, reference_c):
    """Add to the guessed mixes what the units' deviations from the mean supply air change.

    Outlets follow the supply air of their rack, less the share of exhaust in its intake. The
    feedback of the mixes is summed up as in ``add_feedback``.
    """
    dc, block_at = hall.dcs[n], hall.chunks[chunk_at].first_block
    n_units = hall.dcs[n + 1].first_unit - dc.first_unit
    while block_at < hall.chunks[chunk_at + 1].first_block:
        block, over_k = hall.blocks[block_at], hall.zeros
        share_0, unit = first_share_at(hall, n, block_at), 0
        while unit < n_units:
            supply_c = ti.cast(hall.units[dc.first_unit + unit].supply_c, hall.real)
            over_k += hall.unit_shares[share_0 + unit] * (supply_c - reference_c)
            unit += hall.one
        over_k *= hall.real(1.0) - block.exhaust_share
        block.mix_input_k = over_k * block.strength
        block_at += hall.one
    gain = ti.min(dc.feedback_gain, MOST_GAIN_EXPECTED)
    with_feedback = ti.cast(1.0 / (1.0 - gain), hall.real)
    block_at = hall.chunks[chunk_at].first_block
    while block_at < hall.chunks[chunk_at + 1].first_block:
        block = hall.blocks[block_at]
        block.mixed_c = block.mixed_c + dense_mix_of_inputs(hall, n, block_at) * with_feedback
        block_at += hall.one


@ti.func
@no_type_check
def look_up_steady_state(hall: ti.template(), n, supply_c):
    """Look up the steady state: return pattern amounts as a vector, and set the feedback gain.

    Args:
        hall: arguments of the hall kernel.
        n: index of the data center.
        supply_c: supply air of all units, in C.
    """
    dc = hall.dcs[n]
    rows, columns = dc.supply_rows, hall.load_columns
    y = (supply_c - dc.table_low_c) * dc.table_rows_per_k
    y = ti.min(ti.max(y, 0.0), ti.cast(rows - 1, ti.f64))
    x = ti.min(ti.max(dc.utilisation, 0.0), 1.0) * ti.cast(columns - 1, ti.f64)
    row = ti.min(ti.cast(y, ti.i32), rows - 2)
    column = ti.min(ti.cast(x, ti.i32), columns - 2)
    row_weights, column_weights = catmull_rom(y - row), catmull_rom(x - column)
    first = dc.first_steady_state + row * (columns + 2) + column
    amounts, level, scale = hall.zeros, 0, ti.cast(1.0, ti.f64)
    while level < dc.heat_levels:
        at = first
        for i in ti.static(range(4)):
            for j in ti.static(range(4)):
                weight = ti.cast(scale * row_weights[i] * column_weights[j], hall.real)
                amounts += hall.steady_states[at + j] * weight
            at += columns + 2
        first += (rows + 2) * (columns + 2)
        scale *= dc.liquid_heat
        level += hall.one
    dc.feedback_gain = ti.cast(amounts[MIX_PATTERNS], ti.f64)
    return amounts


@ti.func
@no_type_check
def set_mode_amounts(hall: ti.template(), n, slice_at, supply_c):
    """Set the amounts of the modes of a sparse hall from the outlets of its sampled racks."""
    dc = hall.dcs[n]
    n_vectors = (dc.modes + (LANES - 1)) // LANES
    at, sample = dc.first_steady_state, 0
    v = 0
    while v < n_vectors:
        hall.mode_amounts[slice_at * MODE_VECTORS + v] = hall.zeros
        v += hall.one
    while sample < dc.modes:
        outlet_k = hall.sample_outlet_c[dc.first_sample + sample] - supply_c
        v = 0
        while v < n_vectors:
            # Taichi would add in place atomically.
            amounts = hall.mode_amounts[slice_at * MODE_VECTORS + v]
            hall.mode_amounts[slice_at * MODE_VECTORS + v] = (
                amounts + hall.steady_states[at] * outlet_k
            )
            at += hall.one
            v += hall.one
        sample += hall.one


@ti.func
@no_type_check
def guess_mix(hall: ti.template(), n, block_at, sweep: ti.template(), amounts):
    """Return the first guess of the exhaust mix before the racks of a block, in C.

    In sparse halls, also store a first guess of the exhausts, the reference of the next exchange.
    """
    block, chunk_0 = hall.blocks[block_at], hall.dcs[n].first_chunk
    pattern_at = hall.dcs[n].first_pattern
    block_in_hall = block_at - hall.chunks[chunk_0].first_block
    mix_c = hall.zeros + sweep.reference_c
    if sweep.exchanges_after:
        pattern_at += block_in_hall * MIX_PATTERNS
        for k in ti.static(range(MIX_PATTERNS)):
            mix_c += hall.steady_states[pattern_at + k] * amounts[k]
    else:
        exhaust_c, modes = mix_c, hall.dcs[n].modes
        pattern_at += block_in_hall * 2 * modes
        amount_at = sweep.first_amount
        end = amount_at + modes
        while amount_at < end:
            amount = hall.mode_amount[amount_at]
            mix_c += hall.steady_states[pattern_at] * amount
            exhaust_c += hall.steady_states[pattern_at + 1] * amount
            pattern_at += 2
            amount_at += hall.one
        exhaust_c *= block.strength
        hall.rack_state[EXHAUST_ROW + sweep.side, block_at] = exhaust_c
        block.unshifted_mix_c = mix_c
    return mix_c


@ti.func
@no_type_check
def dense_mix(hall: ti.template(), weight_at, source_at, count):
    """Return the weights of a block of a dense hall times a row of all its racks, a vector."""
    sums = ti.Vector([ti.cast(0.0, hall.real)] * (DENSE_LANES * LANES))
    e = 0
    while e < count:
        x = hall.rack_state_by_4[source_at + e]
        sums += hall.mix_weights[weight_at + e] * ti.Vector(
            [x[i // LANES] for i in ti.static(range(DENSE_LANES * LANES))]
        )
        e += hall.one
    out = hall.zeros
    for i in range(LANES):
        for source in ti.static(range(DENSE_LANES)):
            out[i] += sums[source * LANES + i]
    return out


@ti.func
@no_type_check
def sparse_mix(hall: ti.template(), block_at, side):
    """Return the exhaust mix before the racks of a block of a sparse hall, in C."""
    sums = ti.Vector([ti.cast(0.0, hall.real)] * (SPARSE_LANES * LANES))
    vector_0 = (EXHAUST_ROW + side) * hall.rack_state.shape[1] // SPARSE_BLOCKS
    at = hall.source_offsets[block_at]
    while at < hall.source_offsets[block_at + 1]:
        x = hall.rack_state_by_16[vector_0 + hall.sources[at].vector]
        sums += hall.sparse_weights[hall.sources[at].weights] * ti.Vector(
            [x[i // LANES] for i in ti.static(range(SPARSE_LANES * LANES))]
        )
        at += hall.one
    mix_c = hall.zeros
    for source in ti.static(range(SPARSE_LANES)):
        mix_c += ti.Vector([sums[source * LANES + i] for i in ti.static(range(LANES))])
    mix_c *= hall.blocks[block_at].norm
    return mix_c


@ti.func
@no_type_check
def exchange_exhausts(hall: ti.template(), n, block_at, side):
    """Return the exhaust mix before the racks of a block, from the exhausts of ``side``, in C."""
    dc, mix_c = hall.dcs[n], hall.zeros
    is_dense = False
    if ti.static(hall.transient):
        if dc.first_mix_weight >= 0:
            is_dense = True
            block_0 = hall.chunks[dc.first_chunk].first_block
            n_sources = dc.racks + (DENSE_LANES - 1)
            n_sources //= DENSE_LANES
            source_block = (EXHAUST_ROW + side) * hall.rack_state.shape[1] + block_0
            mix_c = dense_mix(
                hall,
                dc.first_mix_weight + (block_at - block_0) * n_sources,
                source_block * (LANES // DENSE_LANES),
                n_sources,
            )
    if not is_dense:
        mix_c = sparse_mix(hall, block_at, side)
    return mix_c


@ti.func
@no_type_check
def next_mix(hall: ti.template(), n, block_at, sweep: ti.template(), amounts):
    """Return the exhaust mix before the racks of a block in the present sweep, in C."""
    block = hall.blocks[block_at]
    mix_c = block.unshifted_mix_c
    if sweep.exchanges_before:
        mix_c = exchange_exhausts(hall, n, block_at, sweep.side)
        block.unshifted_mix_c = mix_c
    elif ti.static(not hall.transient):
        if sweep.is_first:
            mix_c = guess_mix(hall, n, block_at, sweep, amounts)
    return mix_c + sweep.shift_k


@ti.func
@no_type_check
def store_exhaust(
    hall: ti.template(),
    block_at,
    sweep: ti.template(),
    mixed_c,
    outlet_c,
    changes: ti.template(),
):
    """Store the exhausts of the racks of a block, and the range of their changes.

    Failing fans move only a share k of the rack's airflow. The rest stays air of the mix before the
    rack, so the exhaust is k times the outlet plus 1 - k times the mix.
    """
    block = hall.blocks[block_at]
    exhaust_c = mixed_c + block.fan_airflow * (outlet_c - mixed_c)
    exhaust_c *= block.strength
    hall.rack_state[EXHAUST_ROW + 1 - sweep.side, block_at] = exhaust_c
    if sweep.exchanges_after:
        block.mix_input_k = exhaust_c - block.strength * sweep.reference_c
    else:
        change_k = exhaust_c - hall.rack_state[EXHAUST_ROW + sweep.side, block_at]
        change_k *= block.per_strength
        is_rack, far_k = block.per_server > hall.real(0.0), hall.zeros + hall.real(1e30)
        changes.least_k = smaller(ti.select(is_rack, change_k, far_k), changes.least_k)
        changes.most_k = larger(ti.select(is_rack, change_k, hall.zeros - far_k), changes.most_k)


@ti.func
@no_type_check
def exchange_dense(hall: ti.template(), n, chunk_at, reference_c):
    """Exchange the exhausts of a dense hall: set the mixes of the next sweep and their changes."""
    base_c, least_k, most_k = hall.zeros + reference_c, hall.zeros, hall.zeros
    block_at = hall.chunks[chunk_at].first_block
    while block_at < hall.chunks[chunk_at + 1].first_block:
        block = hall.blocks[block_at]
        mix_c = base_c + dense_mix_of_inputs(hall, n, block_at)
        block.unshifted_mix_c = mix_c
        change_k = mix_c - block.mixed_c
        least_k = smaller(change_k, least_k)
        most_k = larger(change_k, most_k)
        block_at += hall.one
    store_change_range(hall, chunk_at, least_k, most_k)


@ti.func
@no_type_check
def dense_mix_of_inputs(hall: ti.template(), n, block_at):
    """Return the weights of a block of a dense hall times ``mix_input_k`` of all racks, in K."""
    dc = hall.dcs[n]
    block_0 = hall.chunks[dc.first_chunk].first_block
    n_sources = (dc.racks + (DENSE_LANES - 1)) // DENSE_LANES
    source_block = MIX_INPUT_ROW * hall.rack_state.shape[1] + block_0
    return dense_mix(
        hall,
        dc.first_mix_weight + (block_at - block_0) * n_sources,
        source_block * (LANES // DENSE_LANES),
        n_sources,
    )


@ti.func
@no_type_check
def add_feedback(hall: ti.template(), n, chunk_at):
    """Add the expected feedback of the racks, k/(1 - k) W d, to the next mixes of a dense hall.

    The feedback is exchanged once; later feedback is assumed to have the same distribution.
    """
    dc, chunk = hall.dcs[n], hall.chunks[chunk_at]
    gain = ti.min(dc.feedback_gain, MOST_GAIN_EXPECTED)
    if dc.sweep % PLAIN_EVERY == 0:
        gain = 0.0
    all_feedback = ti.cast(gain / (1.0 - gain), hall.real)
    block_at = chunk.first_block
    while block_at < hall.chunks[chunk_at + 1].first_block:
        block = hall.blocks[block_at]
        change_k = block.unshifted_mix_c - block.mixed_c
        block.mix_input_k = change_k * block.strength * all_feedback
        block_at += hall.one
    block_at = chunk.first_block
    while block_at < hall.chunks[chunk_at + 1].first_block:
        block = hall.blocks[block_at]
        block.unshifted_mix_c = block.unshifted_mix_c + dense_mix_of_inputs(hall, n, block_at)
        block_at += hall.one


@ti.func
@no_type_check
def parcel_model(hall: ti.template(), n, chunk_at, servers: ti.template()):
    """Return the rates at which the recirculated air before the racks of a chunk follows its mix.

    The time constant is that of each rack's share of the room air. CRAC air stirs the air before
    racks that take in none.
    """
    dc = hall.dcs[n]
    parcel_j_per_k = dc.parcel_j_per_k
    step_s = ti.cast(present_substep_s(hall, n), hall.real)
    per_m3 = servers.air_j_per_m3_k / parcel_j_per_k
    crac_m3s = ti.cast(dc.crac_m3s_per_rack, hall.real)
    still_per_s = ti.min(hall.real(STILL_PER_S), servers.air_j_per_m3_k * crac_m3s / parcel_j_per_k)
    captured_m3s = hall.zeros
    block_at = hall.chunks[chunk_at].first_block
    while block_at < hall.chunks[chunk_at + 1].first_block:
        captured_m3s = larger(hall.blocks[block_at].captured_m3s, captured_m3s)
        block_at += hall.one
    most_m3s = captured_m3s[0]
    for i in range(1, LANES):
        most_m3s = ti.select(captured_m3s[i] > most_m3s, captured_m3s[i], most_m3s)
    halvings = halvings_for(hall, ti.max(most_m3s * per_m3, still_per_s) * step_s)
    scale = power_of_half(hall, halvings)
    return ti.Struct(
        per_m3=per_m3,
        still_per_s=hall.zeros + still_per_s,
        halvings=halvings,
        scale=scale,
        scaled_s=step_s * scale,
        w_per_k=parcel_j_per_k * (hall.real(1.0) / step_s),
    )


@ti.func
@no_type_check
def advance_parcels(
    hall: ti.template(), n, chunk_at, block_terms_0, sweep: ti.template(), servers: ti.template()
):
    """Advance the recirculated air before the racks of a chunk by a substep; store its heat uptake.

    Air enters a parcel of room air at the temperature of the mix and leaves at that of the parcel:
    C_parcel dT/dt = rho*cp*V_captured (T_mix - T).
    """
    parcels = parcel_model(hall, n, chunk_at, servers)
    block_at, terms_at = hall.chunks[chunk_at].first_block, block_terms_0
    while block_at < hall.chunks[chunk_at + 1].first_block:
        block, terms = hall.blocks[block_at], hall.block_terms[terms_at]
        mix_c, before_c = next_mix(hall, n, block_at, sweep, hall.zeros), block.mixed_c
        x = larger(block.captured_m3s * parcels.per_m3, parcels.still_per_s) * parcels.scaled_s
        phi = phi1(hall, x, parcels.halvings)
        change_k = (mix_c - before_c) * (x * phi)
        ones = hall.zeros + hall.real(1.0)
        is_rack = ti.select(block.per_server > hall.real(0.0), ones, hall.zeros)
        terms.parcel_w = is_rack * change_k * parcels.w_per_k
        terms.mixed_c = mix_c + (before_c - mix_c) * (phi * parcels.scale)
        block.mixed_c = before_c + change_k
        block_at += hall.one
        terms_at += N_BLOCK_TERMS


@ti.func
@no_type_check
def status_after_sweep(hall: ti.template(), n, supply_c, most_f_change, moved_k, is_last):
    """Return the status of a data center in steady air: DONE if another sweep moves no mix.

    ``moved_k`` is the largest change of any unit's supply air for the next sweep, in K.
    """
    dc, total = hall.dcs[n], hall.chunks[hall.dcs[n].first_chunk]
    least_k, most_k, shift_k = total.least_change_k, total.most_change_k, dc.shift_k
    left_k = ti.max(most_k - shift_k, shift_k - least_k)
    # A change of f, the share of the need that a unit covers, moves the inlets by at most the
    # difference between outlets and supply air.
    above_k = ti.abs(total.outlet_sum_c / ti.cast(dc.racks, ti.f64) - supply_c)
    left_k = ti.max(left_k, most_f_change * above_k)
    left_k = ti.max(left_k, moved_k)
    status = DONE
    # With the negation, a NaN counts as not converged.
    if not left_k <= hall.tolerance_k:
        status = RUNNING
        if is_last:
            status = NOT_CONVERGED
    return status


@ti.func
@no_type_check
def update_shift(hall: ti.template(), n, sweep, has_exchanged, change_k, exchanges):
    """Update the common shift of the mixes of a sparse hall for its next sweep.

    Most of the remaining change is the same for all racks and shrinks by the feedback gain in each
    sweep. The mixes therefore move by the whole expected change at once. The gain comes from the
    table, or from the last sweep. Every PLAIN_EVERY sweeps, the gain is set to 0 instead.
    """
    dc, shift_k = hall.dcs[n], hall.dcs[n].shift_k
    moved_k = change_k - dc.last_change_k
    gain = ti.min(dc.feedback_gain, MOST_GAIN_EXPECTED)
    moved_far = ti.abs(dc.last_shift_k) > GAIN_SEEN_FROM * hall.tolerance_k
    if sweep > 0 and not has_exchanged and moved_far:
        gain = ti.max(moved_k / dc.last_shift_k, 0.0)
        gain = ti.min(gain, MOST_GAIN_SEEN)
    if sweep % PLAIN_EVERY == PLAIN_EVERY - 1:
        gain = 0.0
    beyond_k = gain / (1.0 - gain) * (change_k - shift_k)
    next_k = change_k + beyond_k
    dc.last_shift_k = next_k - shift_k
    dc.last_change_k = change_k
    if exchanges:
        next_k = beyond_k
        dc.last_change_k = 0.0
    dc.shift_k = next_k
