"""CRAC units of a data center: airflow need of the racks, airflow and supply air, and coils."""

from typing import no_type_check

import taichi as ti

from .compiler.functions import larger
from .decay import halvings_for, phi1, power_of_half
from .hall_arguments import COVERED_WITHIN, LANES, MOST_SUPPLY_RATIO, N_BLOCK_TERMS
from .servers import first_share_at
from .sums import present_substep_s, sum_lanes

USUAL_RISE_K = 15.0
"""Typical temperature rise of air through servers, in K, for the gain of the fan control."""
FAN_RAMP_S = 30.0
"""Time constant of fans that follow the hottest inlet in transient halls, in s."""
EXTRAPOLATES_FROM, EXTRAPOLATES_EVERY = 20, 5
"""First sweep after which the units are extrapolated, since most halls have steady air by then, and
period in sweeps; the sweeps between show the factor by which changes shrink."""
SLOW_FACTOR, MOST_EXTRAPOLATED = 0.3, 100.0
"""Factor of successive changes from which the units are extrapolated, and largest multiple of the
present change that is added."""
COIL_PART, CASING_PART = 4.0, 0.25
"""Factors by which changes of the air behind a coil, at full speed, and in a casing count as
changes of the air of the hall."""
SHORT_OF_AIR = 20.0
"""Factor by which changes of the air count more where units do not cover the need of the racks."""
WEIGHT_WITHIN, LEAST_WEIGHT = 1e-9, 1e-12
"""Relative change at which weights of units are fitted, and smallest weight."""
MOST_WEIGHT_PASSES, WEIGHT_PRODUCTS, LEAST_WEIGHT_PASSES = 300, 2e8, 20
"""Maximum number of passes over the weights of a data center; if these are more than so many
products of share and weight, the number of passes for it, but at least the last number."""
SUPPLY, SUPPLY_NOW, RETURN, RETURN_HEAT = range(4)
"""Air that racks exchange with the units: supply air at the weights of the units, supply air at
their present strengths, return air, or the heat of return air."""
LEAST_NEED_M3S = 1e-6
"""Need of all racks of a data center below which units have no weights, and airflow of a unit below
which it has no return air of its own, in m3/s."""
WEIGHTS_EXTRAPOLATED_EVERY = 4
"""Period in passes by which weights that approach their limit slowly are extrapolated."""
MOST_PASSES = 100
"""Maximum number of passes over the coils of a data center; each pass may saturate a coil."""


@ti.func
@no_type_check
def sum_unit_needs(hall: ti.template(), n, chunk_at, block_terms_0):
    """Sum the supply air that the racks of a chunk need of each unit, sum_j s_jk (1 - r_j) V_j."""
    chunk, n_units = hall.chunks[chunk_at], hall.dcs[n + 1].first_unit - hall.dcs[n].first_unit
    n_blocks = hall.chunks[chunk_at + 1].first_block - chunk.first_block
    unit, share_0 = 0, first_share_at(hall, n, chunk.first_block)
    terms_end = block_terms_0 + n_blocks * N_BLOCK_TERMS
    while unit < n_units:
        # Two units at a time, because their sums do not wait for each other.
        other = ti.min(unit + 1, n_units - 1)
        need_m3s, other_need_m3s = hall.zeros, hall.zeros
        plain_m3s, other_plain_m3s = hall.zeros, hall.zeros
        terms_at, share_at = block_terms_0, share_0
        while terms_at < terms_end:
            terms, share = hall.block_terms[terms_at], hall.unit_shares[share_at + unit]
            other_share = hall.unit_shares[share_at + other]
            need_m3s += share * terms.fresh_m3s
            plain_m3s += share * terms.plain_m3s
            other_need_m3s += other_share * terms.fresh_m3s
            other_plain_m3s += other_share * terms.plain_m3s
            terms_at += N_BLOCK_TERMS
            share_at += n_units
        hall.unit_need_m3s[chunk.first_need + unit] = sum_lanes(need_m3s)
        hall.unit_plain_m3s[chunk.first_need + unit] = sum_lanes(plain_m3s)
        hall.unit_need_m3s[chunk.first_need + other] = sum_lanes(other_need_m3s)
        hall.unit_plain_m3s[chunk.first_need + other] = sum_lanes(other_plain_m3s)
        unit += 2 * hall.one


@ti.func
@no_type_check
def unit_need(hall: ti.template(), n, unit):
    """Return the supply air that all chunks of a data center need of one unit, in m3/s.

    The second value is the need at the exhaust shares of the design point.
    """
    chunk_at = hall.dcs[n].first_chunk
    need_m3s, plain_m3s = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    while chunk_at < hall.dcs[n + 1].first_chunk:
        need_m3s += hall.unit_need_m3s[hall.chunks[chunk_at].first_need + unit]
        plain_m3s += hall.unit_plain_m3s[hall.chunks[chunk_at].first_need + unit]
        chunk_at += hall.one
    return need_m3s, plain_m3s


@ti.func
@no_type_check
def unit_weight(hall: ti.template(), at, air: ti.template()):
    """Return the weight or strength of a unit in the supply or the returns of the racks."""
    weight = hall.units[at].weight
    if ti.static(air == SUPPLY_NOW):
        weight = hall.units[at].strength
    elif ti.static(air != SUPPLY):
        weight = hall.units[at].return_weight
    return weight


@ti.func
@no_type_check
def set_unit_weight(hall: ti.template(), at, air: ti.template(), weight):
    """Set the weight of a unit in the supply of the racks, or in their returns."""
    if ti.static(air != SUPPLY):
        hall.units[at].return_weight = weight
    else:
        hall.units[at].weight = weight


@ti.func
@no_type_check
def take_from_units(hall: ti.template(), n, of_design, air: ti.template()):
    """Add up, lane by lane, what racks take from each unit per weight of the unit, in m3/s.

    ``air``: SUPPLY or SUPPLY_NOW, or RETURN for what racks return to each unit, or RETURN_HEAT for
    the same times its temperature above the return air of the hall, in m3 K/s.
    """
    dc, unit = hall.dcs[n], 0
    none = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
    n_units = hall.dcs[n + 1].first_unit - dc.first_unit
    while unit < n_units:
        hall.unit_lanes[dc.first_unit + unit] = none
        unit += hall.one
    block_at = hall.chunks[dc.first_chunk].first_block
    while block_at < hall.chunks[hall.dcs[n + 1].first_chunk].first_block:
        share_0, total, unit = first_share_at(hall, n, block_at), none, 0
        while unit < n_units:
            weight = unit_weight(hall, dc.first_unit + unit, air)
            total += share_of_unit(hall, share_0 + unit, air) * weight
            unit += hall.one
        flow_m3s = none
        if ti.static(air <= SUPPLY_NOW):
            flow_m3s = hall.plenum[block_at].present_m3s
            if of_design:
                flow_m3s = hall.plenum[block_at].design_m3s
        else:
            flow_m3s = hall.returns[block_at].flow_m3s
        if ti.static(air == RETURN_HEAT):
            flow_m3s = hall.returns[block_at].flow_m3k_s - flow_m3s * dc.return_c
        per_total = flow_m3s / larger(total, none + ti.cast(1e-30, ti.f64))
        unit = 0
        while unit < n_units:
            at = dc.first_unit + unit
            taken_m3s = share_of_unit(hall, share_0 + unit, air) * per_total
            hall.unit_lanes[at] = hall.unit_lanes[at] + taken_m3s
            unit += hall.one
        block_at += hall.one


@ti.func
@no_type_check
def share_of_unit(hall: ti.template(), share_at, air: ti.template()):
    """Return the shares of a unit in the supply of the racks of a block, or in their returns."""
    share = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
    if ti.static(air > SUPPLY_NOW):
        share = hall.return_shares[share_at]
    else:
        share = hall.plenum_shares[share_at]
    return share


@ti.func
@no_type_check
def fit_weights(hall: ti.template(), n, of_design, need_m3s, air: ti.template()):
    """Fit the weights of units that share a plenum to what they deliver, or to what they draw.

    Each pass multiplies the weight of a unit by what it delivers divided by what racks take from it
    (Deming and Stephan 1940, see ``sdc_taichi.hall.unit_supply``). Where speeds are given, only the
    ratios of the airflows count. Where fans follow the racks, a fan within its range holds a
    constant pressure, weight 1, and only units at the ends of their ranges deliver a given airflow.

    Args:
        hall: arguments of the hall kernel.
        n: index of the data center.
        of_design: True to fit to the need of the racks at the design point.
        need_m3s: need of all racks to which that need is scaled, in m3/s; 0 does not scale it.
        air: SUPPLY, or RETURN to fit the weights in the returns of the racks to the airflow that
            each unit draws from them.
    """
    dc, end_unit = hall.dcs[n], hall.dcs[n + 1].first_unit
    follows, fresh_share = dc.follows_need > 0.0, ti.cast(dc.fresh_share, ti.f64)
    if ti.static(air != SUPPLY):
        follows = False
    products = ti.cast(dc.racks, ti.f64) * ti.cast(end_unit - dc.first_unit, ti.f64)
    most_passes = ti.max(WEIGHT_PRODUCTS / products, ti.cast(LEAST_WEIGHT_PASSES, ti.f64))
    most_passes = ti.min(most_passes, ti.cast(MOST_WEIGHT_PASSES, ti.f64))
    passes, change = ti.cast(0.0, ti.f64), ti.cast(1.0, ti.f64)
    while passes < most_passes and change > WEIGHT_WITHIN:
        take_from_units(hall, n, of_design, air)
        total, flow_m3s = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        at = dc.first_unit
        while at < end_unit:
            unit = hall.units[at]
            taken_m3s = unit_weight(hall, at, air) * sum_lanes(hall.unit_lanes[at])
            unit.taken_m3s = taken_m3s
            total += taken_m3s
            if ti.static(air != SUPPLY):
                flow_m3s += unit.drawn_m3s
            else:
                flow_m3s += ti.cast(unit.design_m3s, ti.f64) * unit.speed
            at += hall.one
        scale = ti.cast(1.0, ti.f64)
        if not follows:
            scale = flow_m3s / ti.max(total, 1e-30)
        elif need_m3s > 0.0:
            scale = need_m3s / ti.max(total, 1e-30)
        least, most = ti.cast(1e30, ti.f64), ti.cast(0.0, ti.f64)
        at = dc.first_unit
        while at < end_unit:
            unit = hall.units[at]
            design_m3s = ti.cast(unit.design_m3s, ti.f64)
            low_m3s = design_m3s * unit.speed
            if ti.static(air != SUPPLY):
                low_m3s = unit.drawn_m3s
            high_m3s = low_m3s
            if follows:
                low_m3s = fresh_share * design_m3s * ti.cast(unit.low, ti.f64)
                high_m3s = fresh_share * design_m3s * ti.cast(unit.high, ti.f64)
            before = unit_weight(hall, at, air)
            per_m3s = before / ti.max(scale * unit.taken_m3s, 1e-30)
            weight = ti.min(ti.max(low_m3s * per_m3s, 1.0), high_m3s * per_m3s)
            if total < LEAST_NEED_M3S:
                weight = ti.cast(1.0, ti.f64)
            least, most = ti.min(least, weight), ti.max(most, weight)
            unit.taken_m3s = weight
            at += hall.one
        # Only the ratios of the weights count, unless a fan within its range has weight 1.
        norm = ti.cast(1.0, ti.f64)
        if not follows or most < 1.0:
            norm = 1.0 / ti.max(most, LEAST_WEIGHT)
        elif least > 1.0:
            norm = 1.0 / least
        product, square = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        change, at = ti.cast(0.0, ti.f64), dc.first_unit
        while at < end_unit:
            unit = hall.units[at]
            weight = ti.min(ti.max(norm * unit.taken_m3s, LEAST_WEIGHT), 1.0 / LEAST_WEIGHT)
            weight_change = weight / unit_weight(hall, at, air) - 1.0
            change = ti.max(change, ti.abs(weight_change))
            product += weight_change * unit.last_weight_change
            square += unit.last_weight_change * unit.last_weight_change
            unit.last_weight_change = weight_change
            set_unit_weight(hall, at, air, weight)
            at += hall.one
        passes += 1.0
        is_due = ti.cast(passes, ti.i32) % WEIGHTS_EXTRAPOLATED_EVERY == 0
        if is_due and change > WEIGHT_WITHIN and product > 0.2 * square and product < square:
            share = ti.min(product / (square - product), 50.0)
            at = dc.first_unit
            while at < end_unit:
                unit = hall.units[at]
                further = ti.pow(1.0 + unit.last_weight_change, share)
                weight = unit_weight(hall, at, air) * ti.min(ti.max(further, 0.3), 3.0)
                set_unit_weight(hall, at, air, weight)
                at += hall.one


@ti.func
@no_type_check
def weigh_units(hall: ti.template(), n, begins: ti.template()):
    """Update the weights of units that share a plenum; return the largest change of a strength.

    Weights at given speeds depend on nothing but these speeds, so they are kept while these are the
    same. ``begins``: the step begins, so the racks' need is that of the design point.
    """
    dc, end_unit = hall.dcs[n], hall.dcs[n + 1].first_unit
    follows, fresh_share = dc.follows_need > 0.0, ti.cast(dc.fresh_share, ti.f64)
    need_m3s, is_due, at = ti.cast(0.0, ti.f64), False, dc.first_unit
    while at < end_unit:
        unit = hall.units[at]
        low, high = ti.cast(unit.low, ti.f64), ti.cast(unit.high, ti.f64)
        design_m3s = ti.cast(unit.design_m3s, ti.f64)
        if ti.static(begins):
            if follows:
                unit.weight = 1.0
            if ti.static(hall.transient):
                need_m3s += unit.plain_m3s
            else:
                unit.speed = ti.min(ti.max(dc.fan_speed, low), high)
        if follows:
            wanted = unit.plain_m3s / ti.max(fresh_share * design_m3s, 1e-30)
            outside = wanted < low - WEIGHT_WITHIN or wanted > high + WEIGHT_WITHIN
            if ti.static(begins and not hall.transient):
                outside = low == high
            if outside or unit.weight != 1.0:
                is_due = True
        elif unit.fitted_m3s != design_m3s * unit.speed:
            is_due = True
        at += hall.one
    if is_due:
        at = dc.first_unit
        while at < end_unit:
            unit = hall.units[at]
            unit.last_weight_change = 0.0
            unit.fitted_m3s = ti.cast(unit.design_m3s, ti.f64) * unit.speed
            if not follows:
                unit.weight = 1.0
            at += hall.one
    of_design = not follows
    if ti.static(begins):
        of_design = True
    if is_due:
        fit_weights(hall, n, of_design, need_m3s, SUPPLY)
    change = ti.cast(0.0, ti.f64)
    if is_due or ti.static(begins):
        change = set_strengths(hall, n, of_design, begins)
    return change


@ti.func
@no_type_check
def set_strengths(hall: ti.template(), n, of_design, begins: ti.template()):
    """Set the strengths of units to their weights; return the largest relative change."""
    dc, end_unit = hall.dcs[n], hall.dcs[n + 1].first_unit
    change, weighs = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    at = dc.first_unit
    while at < end_unit:
        unit = hall.units[at]
        strength = ti.pow(unit.weight, dc.coupling)
        change = ti.max(change, ti.abs(strength / unit.strength - 1.0))
        if strength != 1.0:
            weighs = ti.cast(1.0, ti.f64)
        at += hall.one
    dc.weighs = weighs
    if change > 0.0:
        dc.shares_due = 1.0
        if ti.static(hall.transient):
            take_from_units(hall, n, of_design, SUPPLY_NOW)
        at = dc.first_unit
        while at < end_unit:
            unit = hall.units[at]
            if ti.static(hall.transient):
                unit.taken_m3s = unit.strength * sum_lanes(hall.unit_lanes[at])
            unit.strength = ti.pow(unit.weight, dc.coupling)
            at += hall.one
        if ti.static(hall.transient):
            take_from_units(hall, n, of_design, SUPPLY_NOW)
            cover_changed_need(hall, n, begins)
    return change


@ti.func
@no_type_check
def cover_changed_need(hall: ti.template(), n, begins: ti.template()):
    """Set what the units of a data center cover of a need that changed with their strengths.

    Substeps have no sweeps in which the racks could state their need of each unit anew. It changes
    by what they take from the unit now divided by ``taken_m3s``, what they took before. ``begins``:
    the step begins, so fans that follow the need adapt to it within their ranges.
    """
    dc, exceeds = hall.dcs[n], ti.cast(0.0, ti.f64)
    fresh_share, at = ti.cast(dc.fresh_share, ti.f64), dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        factor = unit.strength * sum_lanes(hall.unit_lanes[at]) / ti.max(unit.taken_m3s, 1e-30)
        unit.drawn_ratio = unit.drawn_ratio * factor
        unit.need_m3s = unit.need_m3s * factor
        unit.plain_m3s = unit.plain_m3s * factor
        fresh_m3s = fresh_share * ti.cast(unit.design_m3s, ti.f64)
        if ti.static(begins):
            if dc.follows_need > 0.0:
                low, high = ti.cast(unit.low, ti.f64), ti.cast(unit.high, ti.f64)
                unit.speed = ti.min(ti.max(unit.plain_m3s / fresh_m3s, low), high)
        fresh_m3s *= unit.speed
        unit.fresh_ratio = ti.min(1.0, fresh_m3s / ti.max(unit.need_m3s, 1e-30))
        ratio = ti.min(fresh_m3s / ti.max(unit.plain_m3s, 1e-30), MOST_SUPPLY_RATIO)
        unit.supply_ratio = ratio
        if dc.oversupply > 0.0 and ratio > 1.0 + COVERED_WITHIN:
            exceeds = ti.cast(1.0, ti.f64)
        at += hall.one
    dc.exceeds = exceeds


@ti.func
@no_type_check
def draw_own_return(hall: ti.template(), n, return_c, is_first):
    """Set the return air of each unit of a data center, as a difference from that of the hall.

    V_k T_ret,k = sum_j q_jk (V_j T_out,j - r'_j V_j T_mix,j) + V_bypass,k T_sup,k. The shares q_jk
    fall with the distance from the exhaust face of rack j to unit k; their weights are fitted to
    the air that each rack returns now and each unit draws now. The air that passes the racks
    returns to its own unit. Temperatures are differences from ``return_c``, so that
    sum_k V_k T_ret,k is exact.
    """
    dc, end_unit = hall.dcs[n], hall.dcs[n + 1].first_unit
    drawn_m3s, at = ti.cast(0.0, ti.f64), dc.first_unit
    while at < end_unit:
        unit = hall.units[at]
        if is_first:
            unit.return_weight = 1.0
        unit.last_weight_change = 0.0
        drawn_m3s += unit.drawn_m3s
        at += hall.one
    if drawn_m3s >= LEAST_NEED_M3S:
        fit_weights(hall, n, False, 0.0, RETURN)
    take_from_units(hall, n, False, RETURN_HEAT)
    flow_m3s, mean_k = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    at = dc.first_unit
    while at < end_unit:
        unit = hall.units[at]
        unit_m3s = ti.cast(unit.design_m3s, ti.f64) * unit.speed
        above_m3k_s = unit.return_weight * sum_lanes(hall.unit_lanes[at])
        above_m3k_s += (unit_m3s - unit.drawn_m3s) * (unit.supply_c - return_c)
        unit.return_offset_k = above_m3k_s / ti.max(unit_m3s, 1e-30)
        flow_m3s += unit_m3s
        mean_k += above_m3k_s
        at += hall.one
    mean_k /= ti.max(flow_m3s, 1e-30)
    at = dc.first_unit
    while at < end_unit:
        unit = hall.units[at]
        unit_m3s = ti.cast(unit.design_m3s, ti.f64) * unit.speed
        # A unit that moves no air has the return air of the hall.
        is_drawn = unit_m3s >= LEAST_NEED_M3S
        unit.return_offset_k = ti.select(is_drawn, unit.return_offset_k - mean_k, 0.0)
        at += hall.one


@ti.func
@no_type_check
def set_present_shares(hall: ti.template(), n, first_chunk, end_chunk):
    """Set unit shares and exhaust shares of racks to the present weights and airflow of the units.

    The strengths u_k of the units change the shares to s_jk u_k / sum_l s_jl u_l. Units that
    deliver more than their racks need lower r_j to r_j exp(-kappa max(0, eta_j - 1)), with
    eta_j = sum_k s_jk eta_k of the present shares.
    """
    dc, unit_0 = hall.dcs[n], hall.dcs[n].first_unit
    n_units = hall.dcs[n + 1].first_unit - unit_0
    first_block = hall.chunks[first_chunk].first_block
    end_block = hall.chunks[end_chunk].first_block
    if dc.shares_due > 0.0:
        for block_at in range(first_block, end_block):
            share_0, unit = first_share_at(hall, n, block_at), 0
            per_total = ti.Vector([ti.cast(1.0, ti.f64)] * LANES)
            if dc.weighs > 0.0:
                total = ti.Vector([ti.cast(1e-30, ti.f64)] * LANES)  # Padding has no shares.
                while unit < n_units:
                    total += hall.plenum_shares[share_0 + unit] * hall.units[unit_0 + unit].strength
                    unit += hall.one
                per_total = per_total / total
            unit = 0
            while unit < n_units:
                strength = hall.units[unit_0 + unit].strength
                share = hall.plenum_shares[share_0 + unit] * (per_total * strength)
                present = hall.zeros
                for i in range(LANES):
                    present[i] = ti.cast(share[i], hall.real)
                hall.unit_shares[share_0 + unit] = present
                unit += hall.one
    if dc.exceeds > 0.0:
        # In a loop of their own, the processor computes exponentials of several blocks at once.
        block_at, share_at = first_block, first_share_at(hall, n, first_block)
        while block_at < end_block:
            supply_ratio, at = hall.zeros, unit_0
            while at < unit_0 + n_units:
                ratio = ti.cast(hall.units[at].supply_ratio, hall.real)
                supply_ratio += hall.unit_shares[share_at] * ratio
                at += hall.one
                share_at += hall.one
            hall.blocks[block_at].present_exhaust_share = supply_ratio
            block_at += hall.one
        block_at = first_block
        while block_at < end_block:
            block = hall.blocks[block_at]
            excess = larger(block.present_exhaust_share - hall.real(1.0), hall.zeros)
            factor = hall.exp_of(excess * ti.cast(-dc.oversupply, hall.real))
            block.present_exhaust_share = block.exhaust_share * factor
            block_at += hall.one


@ti.func
@no_type_check
def blow_out_casings(hall: ti.template(), n):
    """Set the supply air of each unit to the mean air that leaves its casing during a substep.

    Air behind the coil, at temperature T_coil, replaces the well-mixed air in the casing:
    V_casing dT/dt = V_k (T_coil - T). With x = V_k t / V_casing, the exact mean of a substep is
    T_coil + (T(0) - T_coil) (1 - exp(-x)) / x. ``V_k`` is the airflow of the substep before.
    """
    at, substep_s = hall.dcs[n].first_unit, present_substep_s(hall, n)
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        flow_m3s = ti.cast(unit.design_m3s, ti.f64) * unit.speed
        x = ti.cast(flow_m3s * substep_s, hall.real) / unit.casing_m3
        halvings = halvings_for(hall, x)
        part = power_of_half(hall, halvings)
        phi = phi1(hall, x * part, halvings) * part
        over_coil_k = unit.casing_c - unit.coil_c
        unit.supply_c = unit.coil_c + over_coil_k * ti.cast(phi, ti.f64)
        unit.casing_change_k = -over_coil_k * ti.cast(x * phi, ti.f64)
        at += hall.one


@ti.func
@no_type_check
def change_of_air(hall: ti.template(), n, least_exhaust_k, most_exhaust_k):
    """Return a measure of how much the air of a data center changes in a substep, in K.

    It is the largest change of an exhaust, ``COIL_PART`` times that of the air behind a coil, or
    ``CASING_PART`` times that in a casing, which shows that a unit has stopped or started. The
    error of a substep grows with it, because exhausts and coils act on the racks one substep later.
    Where units do not cover the need of the racks, warmer servers draw more exhaust, and errors add
    up: there the change counts ``SHORT_OF_AIR`` times.
    """
    most_k, at = ti.max(ti.abs(least_exhaust_k), ti.abs(most_exhaust_k)), hall.dcs[n].first_unit
    factor = ti.cast(1.0, ti.f64)
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        most_k = ti.max(most_k, CASING_PART * ti.abs(unit.casing_change_k))
        most_k = ti.max(most_k, COIL_PART * unit.speed * ti.abs(unit.coil_change_k))
        if unit.fresh_ratio < 1.0 - COVERED_WITHIN:
            factor = SHORT_OF_AIR
        at += hall.one
    return factor * most_k


@ti.func
@no_type_check
def run_crac_units(hall: ti.template(), n, is_last):
    """Set the airflow of the CRAC units to the need of the racks, and the share of it they cover.

    Each unit: V_k = clip(need_k / (1 - b_0), low V_k,full, high V_k,full) with the need at the
    exhaust shares r_j of the design point, eta_k = (1 - b_0) V_k / need_k, and with the need at
    present exhaust shares f_k = min(1, (1 - b_0) V_k / need_k). ``is_last``: this is the last
    sweep, so the state of the units is that at the end of the step.
    """
    dc, none = hall.dcs[n], ti.cast(0.0, ti.f64)
    units = ti.Struct(
        flow_m3s=none,
        supply_m3k_s=none,
        bypass_m3k_s=none,
        most_f_change=none,
        # Sums over running units; the fans of other units draw no power.
        fan_m3s=none,
        running_m3s=none,
        running_m3k_s=none,
        any_running=none,
        # Heat that warms the air in casings, of all units and of running units.
        casings_w=none,
        running_casings_w=none,
    )
    air = ti.cast(dc.air_j_per_m3_k, ti.f64)
    fresh_share, exceeds = ti.cast(dc.fresh_share, ti.f64), none
    substep_s, weight = present_substep_s(hall, n), hall.weight * ti.cast(dc.length, ti.f64)
    at = dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        need, plain = unit_need(hall, n, at - dc.first_unit)
        low, high = ti.cast(unit.low, ti.f64), ti.cast(unit.high, ti.f64)
        design_m3s = ti.cast(unit.design_m3s, ti.f64)
        is_running = ti.cast(unit.running, ti.f64)
        f_used, supply_c = unit.fresh_ratio, unit.supply_c
        mean_supply_c = supply_c
        if ti.static(hall.own_return):
            unit.drawn_m3s = f_used * need
        following = plain / ti.max(fresh_share * design_m3s, 1e-30)
        if dc.inlet_target_c > 0.0:
            following = dc.fan_speed
        speed = ti.min(ti.max(following, low), high)
        flow = design_m3s * speed
        units.flow_m3s += flow
        units.supply_m3k_s += flow * supply_c
        units.bypass_m3k_s += (flow - f_used * need) * supply_c
        f = ti.min(1.0, fresh_share * flow / ti.max(need, 1e-30))
        units.most_f_change = ti.max(units.most_f_change, ti.abs(f - f_used))
        unit.fresh_ratio = f
        ratio_used = unit.supply_ratio
        ratio = ti.min(fresh_share * flow / ti.max(plain, 1e-30), MOST_SUPPLY_RATIO)
        unit.supply_ratio = ratio
        if dc.oversupply > 0.0 and ratio > 1.0 + COVERED_WITHIN:
            exceeds = ti.cast(1.0, ti.f64)
        if dc.oversupply > 0.0 and ti.max(ratio, ratio_used) > 1.0 + COVERED_WITHIN:
            change = dc.oversupply * ti.abs(ratio - ratio_used)
            units.most_f_change = ti.max(units.most_f_change, change)
        cubed = speed * speed * speed * is_running
        units.fan_m3s += cubed * design_m3s
        units.running_m3s += is_running * flow
        units.running_m3k_s += is_running * flow * supply_c
        if is_running > 0.0:
            units.any_running = ti.cast(1.0, ti.f64)
        if ti.static(hall.transient):
            casing_w = air * ti.cast(unit.casing_m3, ti.f64) * unit.casing_change_k / substep_s
            units.casings_w += casing_w
            units.running_casings_w += is_running * casing_w
            unit.casing_c = unit.casing_c + unit.casing_change_k
            flow *= weight
            cubed *= weight
            mean_supply_c *= weight
            if dc.sweep > 0:
                flow += unit.flow_m3s
                cubed += unit.cubed_speed
                mean_supply_c += unit.mean_supply_c
        unit.need_m3s = need
        if is_last:
            unit.following = following
        if is_last or ti.static(not hall.transient):
            unit.fresh_ratio_used = f_used
            unit.supply_ratio_used = ratio_used
            unit.strength_used = unit.strength
        unit.plain_m3s = plain
        unit.flow_m3s = flow
        unit.cubed_speed = cubed
        unit.speed = speed
        unit.mean_supply_c = mean_supply_c
        at += hall.one
    dc.exceeds_used, dc.exceeds, dc.shares_due = dc.exceeds, exceeds, none
    if dc.coupling > 0.0 and not is_last:
        change = weigh_units(hall, n, False)
        units.most_f_change = ti.max(units.most_f_change, change)
    return units


@ti.func
@no_type_check
def follow_hottest_inlet(hall: ti.template(), n, inlet_c):
    """Update the fan speed for the hottest inlet of a sweep; return its distance from target, in K.

    Proportional control: fans run at lowest speed for inlets ``inlet_band_k`` below the target, and
    at full speed at the target. The derivative of the inlet by the speed s is about
    -(inlet - supply + rise)/s. Dividing the step by 1 plus the loop gain avoids oscillation and
    slow convergence.
    """
    dc = hall.dcs[n]
    s, low, band_k = dc.fan_speed, dc.least_speed, dc.inlet_band_k
    wanted = 1.0 + (1.0 - low) * (inlet_c - dc.inlet_target_c) / band_k
    wanted = ti.min(ti.max(wanted, low), 1.0)
    over_supply_k = ti.max(inlet_c - hall.units[dc.first_unit].supply_c, 0.0)
    gain = (1.0 - low) * (over_supply_k + USUAL_RISE_K) / (ti.max(s, low) * band_k)
    step = (wanted - s) / (1.0 + gain)
    if ti.static(hall.transient):
        step *= ti.min(present_substep_s(hall, n) / FAN_RAMP_S, 1.0)
    dc.fan_speed = s + step
    return ti.abs(wanted - s) * band_k


@ti.func
@no_type_check
def coil_spare_w(hall: ti.template(), n, at, scale):
    """Return ``scale`` times the capacity of a coil minus its fan heat, in W; 0 if it is down."""
    dc, unit = hall.dcs[n], hall.units[at]
    speed, is_running = unit.speed, ti.cast(unit.running, ti.f64)
    fan_w = dc.crac_fan_w_per_m3s * ti.cast(unit.design_m3s, ti.f64) * speed * speed * speed
    return is_running * (scale * ti.cast(unit.capacity_w, ti.f64) - fan_w)


@ti.func
@no_type_check
def spread_load(hall: ti.template(), n, base_k, air_load_w, scale, return_c):
    """Return the return air, in C, at which coils within their capacities remove a load from air.

    Newton's method solves sum_k min(C_k, g_k (theta - b_k)) = load for theta. g_k is the heat
    capacity flow of unit k, and b_k its supply air without a limit. The sum is concave in theta, so
    a step from below never overshoots. Each step saturates another coil or is the last. Units that
    draw their own return air receive theta plus their ``return_offset_k``.
    """
    dc = hall.dcs[n]
    air = ti.cast(dc.air_j_per_m3_k, ti.f64)
    theta, passes, change_k = return_c, 0, ti.cast(1.0, ti.f64)
    while passes < MOST_PASSES and change_k > 1e-9:
        taken_w, slope = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        at = dc.first_unit
        while at < hall.dcs[n + 1].first_unit:
            unit = hall.units[at]
            g = air * ti.cast(unit.design_m3s, ti.f64) * unit.speed * ti.cast(unit.running, ti.f64)
            unit_return_c, unit_base_k = theta, base_k
            if ti.static(hall.own_return):
                unit_return_c = theta + unit.return_offset_k
                unit_base_k = unit.base_k
            wanted_w = g * (unit_return_c - ti.cast(unit.setpoint_c, ti.f64) - unit_base_k)
            most_w = coil_spare_w(hall, n, at, scale)
            # The first pass ignores the limits and finds the starting point.
            if passes > 0 and wanted_w > most_w:
                taken_w += most_w
            else:
                taken_w += wanted_w
                slope += g
            at += hall.one
        change_k = 0.0
        if slope > 0.0:
            change_k = (air_load_w - taken_w) / slope
            theta += change_k
        if passes == 0:
            change_k = ti.cast(1.0, ti.f64)
        passes += 1
    return theta


@ti.func
@no_type_check
def set_supply(hall: ti.template(), n, units: ti.template(), return_c, warmed_k, wanted_w):
    """Set the supply air of the units for the next sweep; return the largest change, in K.

    A unit supplies air at its setpoint plus the warmth of the room. With return-air control, supply
    air is warmer if the air warms less on its way:
    b_k = setpoint + gain max(0, rise at design - rise). A coil that would have to remove more than
    its capacity C_k supplies warmer air, theta - C_k / (rho cp V_k). A unit that is down supplies
    theta, the return air. With own return air, theta and the rise are those of each unit. If the
    capacity of all coils together is too small, all fall short by the same share, and the room
    stores the remaining heat. In transient halls, all this is the air behind the coils; the casings
    follow, see ``blow_out_casings``.

    Args:
        hall: arguments of the hall kernel.
        n: index of the data center.
        units: sums over its units in this sweep.
        return_c: return air of this sweep, in C.
        warmed_k: warmth of the room that is not part of the setpoints, in K.
        wanted_w: heat demand on the running coils, in W.
    """
    dc = hall.dcs[n]
    air = ti.cast(dc.air_j_per_m3_k, ti.f64)
    rise_k = return_c - units.running_m3k_s / ti.max(units.running_m3s, 1e-30)
    base_k = warmed_k + dc.return_gain * ti.max(dc.return_rise_k - rise_k, 0.0)
    capacity_w, at = ti.cast(0.0, ti.f64), dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        capacity_w += ti.cast(unit.running, ti.f64) * ti.cast(unit.capacity_w, ti.f64)
        if ti.static(hall.own_return):
            unit.base_k = base_k
            if dc.own_return > 0.0:
                own_rise_k = return_c + unit.return_offset_k - unit.supply_c
                missing_k = ti.max(dc.return_rise_k - own_rise_k, 0.0)
                unit.base_k = warmed_k + dc.return_gain * missing_k
        at += hall.one
    scale = ti.max(wanted_w / ti.max(capacity_w, 1.0), 1.0)
    theta = return_c
    if ti.static(not hall.transient):
        load_w = air * (return_c * units.flow_m3s - units.supply_m3k_s)
        theta = spread_load(hall, n, base_k, load_w, scale, return_c)
    most_change_k, at = ti.cast(0.0, ti.f64), dc.first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        setpoint_c, unit_base_k, unit_return_c = ti.cast(unit.setpoint_c, ti.f64), base_k, theta
        if ti.static(hall.own_return):
            unit_base_k, unit_return_c = unit.base_k, theta + unit.return_offset_k
        supply_c = setpoint_c + unit_base_k
        if units.any_running > 0.0:
            if unit.running > hall.real(0.0):
                g = air * ti.max(ti.cast(unit.design_m3s, ti.f64) * unit.speed, 1e-30)
                supply_c = ti.max(supply_c, unit_return_c - coil_spare_w(hall, n, at, scale) / g)
            else:
                supply_c = unit_return_c
        most_change_k = ti.max(most_change_k, ti.abs(supply_c - unit.supply_c))
        excess_k = supply_c - setpoint_c - warmed_k
        if ti.static(hall.transient):
            # A unit that is down would supply such air as soon as it runs again.
            if units.any_running > 0.0 and unit.running <= hall.real(0.0):
                excess_k = unit_base_k - warmed_k
            unit.coil_change_k = supply_c - unit.coil_c
            unit.coil_c = supply_c
        unit.excess_k = excess_k
        unit.supply_c = supply_c
        at += hall.one
    return most_change_k


@ti.func
@no_type_check
def plant_limit_w(hall: ti.template(), n, running_w, offered_w, j_per_k):
    """Return the heat that the plant can remove in a substep, at least 0, in W.

    Economisers remove more heat from water that returns warmer. The limit is therefore L + G w,
    where L grows with the heat at the coils, and w is the warmth of room and water at the end of
    the substep. Without a plant w would be offered_w h / C. The heat that the plant removes lowers
    w, which gives L + (offered_w - L) a / (1 + a) with a = G h / C, and L where all is removed.

    Args:
        hall: arguments of the hall kernel.
        n: index of the data center.
        running_w: heat from return air and fans that reaches the running coils, in W.
        offered_w: heat above the setpoint, stored or generated in this substep, in W.
        j_per_k: heat capacity C that warms with the water, in J/K.
    """
    dc = hall.dcs[n]
    limit_w = dc.coil_limit_w + dc.limit_w_per_w * ti.max(running_w, 0.0)
    gain = dc.limit_w_per_k * present_substep_s(hall, n) / j_per_k
    more_w = ti.max(offered_w - limit_w, 0.0) * (gain / (1.0 + gain))
    return ti.max(limit_w + more_w, 0.0)


@ti.func
@no_type_check
def share_with_water(hall: ti.template(), n, running_w, wanted_w):
    """Let chilled water and tank take up heat that the plant does not; return plant and coils, W.

    Pumps and fans move heat between room and water much faster than either warms. Both therefore
    end a substep equally far above their setpoints, by (E_room + E_water)/(C_room + C_water),
    unless this exceeds what coils and pumps can carry. A stratified tank supplies water at the
    setpoint until warm water fills it. Spare capacity of the plant cools water and room first, then
    the tank.

    Args:
        hall: arguments of the hall kernel.
        n: index of the data center.
        running_w: heat from return air and fans that reaches the running coils, in W.
        wanted_w: this heat and the heat stored in the room, at least 0, in W.
    """
    dc, h = hall.dcs[n], present_substep_s(hall, n)
    carried_w = ti.max(dc.carried_w, dc.coil_limit_w)
    load_w = ti.min(wanted_w, carried_w) + dc.water_j / h
    recharge_w = ti.select(dc.tank_share > 0.0, dc.tank_j / h, 0.0)
    most_w = ti.max(dc.tank_share * dc.tank_most_j - dc.tank_j, 0.0) / h
    # Room and water are equally warm, unless coils and pumps carry too little heat to the water.
    offered_w = wanted_w + dc.water_j / h - most_w
    limit_w = plant_limit_w(hall, n, running_w, offered_w, dc.room_j_per_k + dc.water_j_per_k)
    offered_w = carried_w + dc.water_j / h - most_w
    limit_w = ti.min(limit_w, plant_limit_w(hall, n, running_w, offered_w, dc.water_j_per_k))
    plant_w = ti.min(ti.max(load_w + recharge_w, 0.0), limit_w)
    tank_w = ti.min(ti.max(load_w - plant_w, -recharge_w), most_w)
    sink_w = plant_w + tank_w
    stored_j = dc.room_j + dc.water_j + (running_w - sink_w) * h
    warmed_k = stored_j / (dc.room_j_per_k + dc.water_j_per_k)
    coil_w = running_w + (dc.room_j - dc.room_j_per_k * warmed_k) / h
    coil_w = ti.min(ti.max(coil_w, 0.0), carried_w)
    dc.water_j = dc.water_j + (coil_w - sink_w) * h
    dc.tank_j = dc.tank_j + tank_w * h
    return plant_w, coil_w


@ti.func
@no_type_check
def run_coils(hall: ti.template(), n, units: ti.template(), return_c):
    """Return the heat that reaches the coils in a substep, and what the plant removes, in W.

    The heat that warms the air in the casings does not reach the coils. Coils remove the heat that
    brings supply air back to its setpoint, up to the limit of the plant. The room and the chilled
    water store the rest, which warms the supply air of the next substep.
    """
    dc, substep_s = hall.dcs[n], present_substep_s(hall, n)
    air = ti.cast(dc.air_j_per_m3_k, ti.f64)
    fans_w = units.fan_m3s * dc.crac_fan_w_per_m3s
    load_w = air * (return_c * units.flow_m3s - units.supply_m3k_s) + fans_w - units.casings_w
    running_w = air * (return_c * units.running_m3s - units.running_m3k_s) + fans_w
    running_w -= units.running_casings_w
    if ti.static(hall.own_return):
        if dc.own_return > 0.0 and dc.adjusts_supply > 0.0:
            at = dc.first_unit
            while at < hall.dcs[n + 1].first_unit:
                unit = hall.units[at]
                flow_m3s = ti.cast(unit.design_m3s * unit.running, ti.f64) * unit.speed
                running_w += air * flow_m3s * unit.return_offset_k
                at += hall.one
    wanted_w = ti.max(running_w + units.any_running * dc.room_j / substep_s, 0.0)
    plant_w = ti.min(wanted_w, plant_limit_w(hall, n, running_w, wanted_w, dc.room_j_per_k))
    coil_w = plant_w
    if dc.water_j_per_k > 0.0 and dc.carried_w > 0.0:
        plant_w, coil_w = share_with_water(hall, n, running_w, wanted_w)
    room_j = dc.room_j + (load_w - coil_w) * substep_s
    dc.room_j = room_j
    warmed_k = room_j / dc.room_j_per_k
    if dc.adjusts_supply > 0.0:
        set_supply(hall, n, units, return_c, warmed_k, wanted_w)
    else:
        at = dc.first_unit
        while at < hall.dcs[n + 1].first_unit:
            unit = hall.units[at]
            coil_c = ti.cast(unit.setpoint_c, ti.f64) + warmed_k
            unit.excess_k = 0.0
            unit.coil_change_k = coil_c - unit.coil_c
            unit.coil_c = coil_c
            unit.supply_c = coil_c
            at += hall.one
    return load_w, plant_w


@ti.func
@no_type_check
def extrapolate_units(hall: ti.template(), n, above_k):
    """Extrapolate the units of a data center where their sweeps approach the steady air slowly.

    Warmer servers draw more air, of which units at full speed cover a smaller share, and coils at
    their limit supply warmer air, so servers become still warmer. Then each sweep changes both by
    a factor just below 1 times the change before, and the remaining changes sum up to that factor
    divided by 1 minus the factor, times the present change (Aitken 1926). Fans that follow the
    hottest inlet are controlled without oscillation already, see ``follow_hottest_inlet``.

    Args:
        hall: arguments of the hall kernel.
        n: index of the data center.
        above_k: mean outlet minus supply temperature, by which a change of the share that the units
            cover changes the inlets, in K.
    """
    product, square, none = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    sweep, at = hall.dcs[n].sweep, hall.dcs[n].first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        f_change = unit.fresh_ratio - unit.fresh_ratio_used
        supply_change_k = unit.supply_c - unit.mean_supply_c
        product += f_change * unit.last_f_change * above_k * above_k
        product += supply_change_k * unit.last_supply_change_k
        square += unit.last_f_change * unit.last_f_change * above_k * above_k
        square += unit.last_supply_change_k * unit.last_supply_change_k
        at += hall.one
    factor, share = none, none
    is_due = sweep >= EXTRAPOLATES_FROM and sweep % EXTRAPOLATES_EVERY == 0
    if is_due and square > hall.tolerance_k * hall.tolerance_k:
        factor = product / square
        if factor > SLOW_FACTOR and factor < 1.0:
            share = ti.min(factor / (1.0 - factor), MOST_EXTRAPOLATED)
    at = hall.dcs[n].first_unit
    while at < hall.dcs[n + 1].first_unit:
        unit = hall.units[at]
        f_change = unit.fresh_ratio - unit.fresh_ratio_used
        supply_change_k = unit.supply_c - unit.mean_supply_c
        unit.last_f_change = f_change
        unit.last_supply_change_k = supply_change_k
        unit.fresh_ratio = ti.min(ti.max(unit.fresh_ratio + share * f_change, 0.0), 1.0)
        # The error of the mixes would otherwise grow in servers that draw more air when warmer.
        if factor >= 1.0 and unit.fresh_ratio > 1.0 - COVERED_WITHIN:
            unit.fresh_ratio = 1.0
        unit.supply_c = unit.supply_c + share * supply_change_k
        at += hall.one


@ti.func
@no_type_check
def keep_supply(hall: ti.template(), n):
    """Reset the supply air of the units to that of the last sweep, to which the results belong."""
    at = hall.dcs[n].first_unit
    while at < hall.dcs[n + 1].first_unit:
        hall.units[at].supply_c = hall.units[at].mean_supply_c
        at += hall.one
