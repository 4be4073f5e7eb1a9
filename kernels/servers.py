"""Servers of a block of racks: what they draw, the air that they take in, and what leaves them.

CPU power max(idle, full*(slope*T + offset + shift*u)); airflow ratio
y = clip(slope*T + offset + shift*u); fan power reference*(y/reference ratio)^exponent (Sun et al.
2021; EnergyPlus ElectricEquipment:ITE:AirCooled), T at most the curve limit.
"""

from typing import no_type_check

import taichi as ti

from .compiler.functions import larger, smaller
from .decay import doublings, gone_per, halved
from .thermal import LANES, OF_GROUPS, OF_RACKS, OUTLETS

OUTLET_OF_SERVERS, OUTLET_OF_RACKS = OUTLETS.index("server"), OUTLETS.index("rack")


@ti.func
@no_type_check
def servers_of(hall: ti.template(), n):
    """What the servers of a data center have in common."""
    dc = hall.dcs[n]
    per_reference = hall.real(1.0) / dc.fan_reference_ratio
    exponent = dc.fan_exponent
    # Branches on data, not one kernel per exponent: compiled apart, they would round apart, and
    # a data center must not depend on its batch.
    at_full = per_reference
    if exponent == hall.real(3.0):
        at_full = per_reference * per_reference * per_reference
    elif exponent != hall.real(1.0):
        at_full = ti.pow(per_reference, exponent)
    air_j_per_m3_k = dc.air_j_per_m3_k
    return ti.Struct(
        utilisation=hall.zeros + ti.cast(dc.utilisation, hall.real),
        cpu_slope=dc.cpu_slope_per_k,
        cpu_offset=dc.cpu_offset,
        cpu_shift=dc.cpu_shift,
        fan_slope=dc.fan_slope_per_k,
        fan_offset=dc.fan_offset,
        fan_shift=dc.fan_shift,
        fan_low=hall.zeros + dc.fan_low,
        fan_high=hall.zeros + dc.fan_high,
        fan_exponent=exponent,
        fan_w=dc.fan_reference_w * at_full,
        full_m3s=dc.fan_full_m3s,
        curve_limit_c=hall.zeros + dc.curve_limit_c,
        air_j_per_m3_k=air_j_per_m3_k,
        per_air=hall.real(1.0) / air_j_per_m3_k,
        taken_up_j_per_m3_k=dc.effectiveness * air_j_per_m3_k,
    )


@ti.func
@no_type_check
def first_share_of(hall: ti.template(), n, block_at):
    """Where the shares of the CRAC units in the supply air of a block of racks begin."""
    dc = hall.dcs[n]
    n_units = hall.dcs[n + 1].first_unit - dc.first_unit
    block_0 = hall.chunks[dc.first_chunk].first_block
    return dc.first_share + n_units * (block_at - block_0)


@ti.func
@no_type_check
def air_before(hall: ti.template(), n, block_at, mixed_c, fresh_ratio: ti.template()):
    """Air before the racks of a block.

    ``approach``: supply air plus the rack's approach temperature. ``recirculation``: of the intake
    of a server the share 1 - f (1 - c) is the exhaust mix before its rack; c is its share at the
    design point and f <= 1 how much of their need the CRAC units cover, which is in the row
    ``fresh_ratio`` of theirs.
    """
    block, dc = hall.blocks[block_at], hall.dcs[n]
    unit_0 = dc.first_unit
    cover, fresh_k, captured_share = hall.zeros, hall.zeros, hall.zeros
    if ti.static(hall.recirculates):
        captured_share = block.captured_share
        n_units, share_0 = hall.dcs[n + 1].first_unit - unit_0, first_share_of(hall, n, block_at)
        unit = 0
        while unit < n_units:
            ratio = ti.cast(hall.unit_state[fresh_ratio, unit_0 + unit], hall.real)
            part = hall.shares[share_0 + unit] * ratio
            cover += part
            fresh_k += part * ti.cast(hall.units[unit_0 + unit].supply_c, hall.real)
            unit += hall.step
        fresh_k = fresh_k - cover * mixed_c
    else:
        mixed_c = block.approach_k + ti.cast(hall.units[unit_0].supply_c, hall.real)
    return ti.Struct(
        mixed_c=mixed_c,
        cover=cover,
        captured_share=captured_share,
        # Of supply air over the mix.
        fresh_k=fresh_k,
        # Inlet of a server that takes in no exhaust, and colder by height.
        least_c=mixed_c + fresh_k,
        per_height_k=captured_share * fresh_k,
    )


@ti.func
@no_type_check
def racks_of(hall: ti.template(), servers: ti.template(), block_at):
    """Load of the racks of a block, and what all servers of a rack have in common."""
    block, u = hall.blocks[block_at], servers.utilisation
    if hall.loads_of == OF_RACKS:
        u = block.load
    elif hall.loads_of == OF_GROUPS:
        u = hall.zeros
    first_group = ti.Vector([0] * LANES)
    if hall.loads_of == OF_GROUPS:
        for i in range(LANES):
            first_group[i] = hall.places[block_at * LANES + i].first_group
    powered = block.powered
    breath = block.airflow * powered
    return ti.Struct(
        # A group does u + deviation*u*(1 - u), which conserves the work of its rack and stays
        # within 0..1.
        uneven=u * (hall.real(1.0) - u),
        cpu_base=u * servers.cpu_shift + servers.cpu_offset,
        fan_base=u * servers.fan_shift + servers.fan_offset,
        per_server=block.per_server,
        # Where loads are looked up, if they are given for each group.
        first_group=first_group,
        # What all groups have in common is multiplied with their sums.
        powered=powered,
        breath=breath,
        per_speed_m3s=breath * servers.full_m3s,
        per_speed_w=breath * servers.fan_w,
    )


@ti.func
@no_type_check
def inlet_of(hall: ti.template(), air: ti.template(), group):
    """Inlet of a group of each rack."""
    inlet_c = air.least_c + group.inlet_offset_k
    if ti.static(hall.recirculates):
        inlet_c = air.least_c - group.height * air.per_height_k
    return inlet_c


@ti.func
@no_type_check
def of_group(
    hall: ti.template(),
    servers: ti.template(),
    racks: ti.template(),
    air: ti.template(),
    group,
    z,
):
    """Inlet of group z of each rack; of a server CPU power, and fan speed and power as ratios."""
    inlet_c = inlet_of(hall, air, group)
    # Utilisation over that of the rack, where not given.
    apart = group.load_deviation * racks.uneven
    if hall.loads_of == OF_GROUPS:
        for i in range(LANES):
            at = racks.first_group[i] + z
            apart[i] = hall.group_load[ti.min(at, hall.group_load.shape[0] - 1)]
    on_curve_c = smaller(inlet_c, servers.curve_limit_c)
    ratio = on_curve_c * servers.cpu_slope + (apart * servers.cpu_shift + racks.cpu_base)
    draws_w = larger(group.idle_w, group.full_w * ratio)
    speed = on_curve_c * servers.fan_slope + (apart * servers.fan_shift + racks.fan_base)
    speed = smaller(larger(speed, servers.fan_low), servers.fan_high)
    fan_power = speed
    if servers.fan_exponent == hall.real(3.0):
        fan_power = speed * speed * speed
    elif servers.fan_exponent != hall.real(1.0):
        # x^p as x exp((p - 1) log x), which is 0 where x is.
        beyond_1 = servers.fan_exponent - hall.real(1.0)
        fan_power = speed * hall.exp_of(hall.log_of(speed) * beyond_1)
    return inlet_c, draws_w, speed, fan_power


@ti.func
@no_type_check
def no_groups(hall: ti.template()):
    """Sums that begin."""
    return ti.Struct(
        cpu_w=hall.zeros,
        fan_w=hall.zeros,
        flow_m3s=hall.zeros,
        inlet_c=hall.zeros,
        inlet_m3k_s=hall.zeros,
        high_m3s=hall.zeros,
    )


@ti.func
@no_type_check
def add_group(
    hall: ti.template(), sums: ti.template(), group, count, inlet_c, draws_w, speed, fan_power
):
    """A group of so many servers to the sums of its rack."""
    counted = count * speed
    sums.cpu_w += count * draws_w
    sums.fan_w += count * fan_power
    sums.flow_m3s += counted
    sums.inlet_c += count * inlet_c
    if ti.static(hall.recirculates):
        sums.high_m3s += counted * group.height
    else:
        sums.inlet_m3k_s += counted * inlet_c


@ti.func
@no_type_check
def complete(hall: ti.template(), sums: ti.template(), racks: ti.template(), air: ti.template()):
    """Multiply the sums with what all groups have in common; return what they take in of fresh air.

    As if the CRAC units covered all of their need.
    """
    sums.cpu_w *= racks.powered
    sums.fan_w *= racks.per_speed_w
    sums.flow_m3s *= racks.per_speed_m3s
    sums.inlet_c *= racks.per_server
    fresh_m3s = hall.zeros
    if ti.static(hall.recirculates):
        fresh_m3s = sums.flow_m3s - air.captured_share * (sums.high_m3s * racks.per_speed_m3s)
        sums.inlet_m3k_s = air.mixed_c * sums.flow_m3s + air.fresh_k * fresh_m3s
    else:
        sums.inlet_m3k_s *= racks.per_speed_m3s
    return fresh_m3s


@ti.func
@no_type_check
def rack_outlet(hall: ti.template(), servers: ti.template(), sums: ti.template(), per_flow):
    """What leaves a rack by the models that know racks alone; not with recirculation.

    ``rack``: T + P/(rho*cp*V). ``released``: the fit T + 1.918*P^1.096/(0.526*rho*cp*V^0.824) -
    14.01 of the released SustainDC. Its exponents are given over 1: P^1.096 / V^0.824 is
    P/V exp(0.096 log P + 0.176 log V), whose exponential is of small numbers and loses no digits.
    """
    drawn_w = sums.cpu_w + sums.fan_w
    outlet_c = sums.inlet_c + drawn_w * per_flow * servers.per_air
    if hall.outlet_model != OUTLET_OF_RACKS:
        powers = hall.log_of(drawn_w) * hall.constants[1]
        flows = hall.log_of(sums.flow_m3s) * hall.constants[3]
        fit = drawn_w * per_flow * hall.exp_of(powers - flows)
        per_fit = hall.constants[0] / (hall.constants[2] * servers.air_j_per_m3_k)
        outlet_c = sums.inlet_c + fit * per_fit
        outlet_c += hall.constants[4]
    return outlet_c


@ti.func
@no_type_check
def warming_of(hall: ti.template(), n, servers: ti.template()):
    """How the servers of a data center become warmer in a substep, C dT/dt = P - eps K (T - T_in).

    C is the heat capacity of a server, K = rho*cp*V that of its air, eps how much of the difference
    the air takes up. By the exact exponential.
    """
    dc, step_s = hall.dcs[n], ti.cast(hall.substep_s, hall.real)
    server_j_per_k = dc.server_j_per_k
    k_per_w, times = step_s / server_j_per_k, 0
    if ti.static(hall.transient):
        most = dc.fan_high * servers.full_m3s * servers.taken_up_j_per_m3_k * k_per_w
        times = doublings(hall, most)
        k_per_w *= halved(hall, times)
    return ti.Struct(
        times=times,
        k_per_w=k_per_w,
        per_speed=servers.full_m3s * servers.taken_up_j_per_m3_k * k_per_w,
        w_per_k=server_j_per_k * (hall.real(1.0) / step_s),
    )


@ti.func
@no_type_check
def warm(
    hall: ti.template(), warming: ti.template(), racks: ti.template(), at, inlet_c, draws_w, speed
):
    """Servers of a group in a substep; return by how much they have become warmer."""
    before_c = hall.server_c[at]
    # Without air a server keeps what it draws.
    x = speed * (racks.breath * warming.per_speed)
    change_k = draws_w * (racks.powered * warming.k_per_w) - (before_c - inlet_c) * x
    change_k *= gone_per(hall, x, warming.times)
    hall.server_c[at] = before_c + change_k
    return change_k


@ti.func
@no_type_check
def take_over(hall: ti.template(), block_at):
    """Temperatures of the servers of a block before the step."""
    block, last = hall.blocks[block_at], hall.servers_before.shape[0] - 1
    for z in range(block.groups):
        before_c = hall.zeros
        for i in range(LANES):
            group = hall.places[block_at * LANES + i].first_group + z
            before_c[i] = hall.servers_before[ti.min(group, last)]
        hall.server_c[block.place + z] = before_c


@ti.func
@no_type_check
def hand_over(hall: ti.template(), block_at, z, count, after_c):
    """Temperatures of the servers of a group after the step."""
    for i in range(LANES):
        if count[i] > hall.real(0.0):
            group = hall.places[block_at * LANES + i].first_group + z
            hall.servers_after[group] = after_c[i]
