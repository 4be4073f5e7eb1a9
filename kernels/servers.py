"""Servers of a block of racks: intake air, power, airflow, and outlet air.

A server has these curves of inlet T (at most the curve limit) and utilisation u (Sun et al. 2021;
EnergyPlus ElectricEquipment:ITE:AirCooled). Power without fans is max(idle, full (slope T + offset
+ shift u)). The airflow ratio is y = clip(slope T + offset + shift u). Each knee of a curve at
T_k adds (slope_k + shift_k u) max(T, T_k) to its line. Fan power is
reference (y / reference ratio)^exponent. ``sdc_taichi/plant/servers.py`` has the same curves in
NumPy. Fans move the volume y at inlet density, but airflows are volumes at a reference
temperature. The airflow is therefore y times the density at the inlet divided by that at the
reference (``sdc_taichi/plant/air.py``).
"""

from typing import NamedTuple, no_type_check

import taichi as ti

from .compiler.functions import larger, smaller
from .decay import halvings_for, phi1, power_of_half
from .hall_arguments import LANES, LOADS_PER_GROUP, LOADS_PER_RACK, OUTLETS
from .sums import present_substep_s

OUTLET_OF_SERVERS, OUTLET_OF_RACKS = OUTLETS.index("server"), OUTLETS.index("rack")
STILL_AIR_SHARE = 0.02
"""Airflow that cools a rack with all servers off in transient halls, as a share of its airflow at
full fan speed. It stands for the draught of warm air and the surface of the rack; see
docs/transients.md."""


class _ReleasedOutlet(NamedTuple):
    """Constants of the rack outlet fit of the released SustainDC, used in ``rack_outlet``."""

    factor: float = 1.918
    """Factor of the temperature rise, dimensionless."""
    power_excess: float = 1.096 - 1.0
    """Exponent of power minus 1."""
    divisor: float = 0.526
    """Divisor of the temperature rise, dimensionless."""
    flow_excess: float = 0.824 - 1.0
    """Exponent of airflow minus 1."""
    offset_k: float = -14.01
    """Constant added to the temperature rise, in K."""


RELEASED_OUTLET = _ReleasedOutlet()


@ti.func
@no_type_check
def server_model(hall: ti.template(), n):
    """Return the curves and coefficients that all servers of a data center share."""
    dc = hall.dcs[n]
    per_reference = hall.real(1.0) / dc.fan_reference_ratio
    exponent = dc.fan_exponent
    # These are branches on data, not one kernel per exponent: separately compiled kernels would
    # round differently, and the results of a data center must not depend on its batch.
    at_full = per_reference
    if exponent == hall.real(3.0):
        at_full = per_reference * per_reference * per_reference
    elif exponent != hall.real(1.0):
        at_full = ti.pow(per_reference, exponent)
    air_j_per_m3_k = dc.air_j_per_m3_k
    n_knees = ti.static(hall.fan_knees + hall.cpu_knees)
    none = ti.Vector([hall.real(0.0)] * ti.static(max(n_knees, 1)))
    knee_c, knee_slope, knee_shift = none, none, none
    for k in ti.static(range(n_knees)):
        knee = hall.knees[n * n_knees + k]
        knee_c[k], knee_slope[k] = knee.inlet_c, knee.slope_per_k
        knee_shift[k] = knee.shift_per_k
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
        fan_full_w=dc.fan_reference_w * at_full,
        full_m3s=dc.fan_full_m3s,
        curve_limit_c=hall.zeros + dc.curve_limit_c,
        # Knees of the airflow ratio, then those of power.
        knee_c=knee_c,
        knee_slope=knee_slope,
        knee_shift=knee_shift,
        air_j_per_m3_k=air_j_per_m3_k,
        per_air=hall.real(1.0) / air_j_per_m3_k,
        # Heat that the air takes up per airflow and K of server minus inlet temperature.
        uptake_j_per_m3_k=dc.effectiveness * air_j_per_m3_k,
    )


@ti.func
@no_type_check
def first_share_at(hall: ti.template(), n, block_at):
    """Return the index in unit_shares of a block's first CRAC unit; the other units follow."""
    dc = hall.dcs[n]
    n_units = hall.dcs[n + 1].first_unit - dc.first_unit
    block_0 = hall.chunks[dc.first_chunk].first_block
    return dc.first_share + n_units * (block_at - block_0)


@ti.func
@no_type_check
def intake_air(hall: ti.template(), n, block_at, mixed_c, of_last: ti.template()):
    """Return the intake air of the racks of a block, from the exhaust mix before them in C.

    With inlet model ``approach`` it is supply air plus the rack's approach temperature. With
    ``recirculation`` it is T_in = T_mix + (1 - r_j g) sum_k s_jk f_k (T_sup,k - T_mix), with the
    present shares s_jk and r_j of ``set_present_shares``.
    ``of_last``: the last sweep had this intake air; otherwise the present sweep has it.
    """
    block, dc = hall.blocks[block_at], hall.dcs[n]
    unit_0 = dc.first_unit
    cover, fresh_k, exhaust_share = hall.zeros, hall.zeros, hall.zeros
    if ti.static(hall.recirculates):
        exceeds = dc.exceeds
        if ti.static(of_last):
            exceeds = dc.exceeds_used
        exhaust_share = block.exhaust_share
        if exceeds > 0.0:
            exhaust_share = block.present_exhaust_share
        n_units, share_0 = hall.dcs[n + 1].first_unit - unit_0, first_share_at(hall, n, block_at)
        unit = 0
        while unit < n_units:
            at = unit_0 + unit
            f = hall.units[at].fresh_ratio
            if ti.static(of_last):
                f = hall.units[at].fresh_ratio_used
            part = hall.unit_shares[share_0 + unit] * ti.cast(f, hall.real)
            cover += part
            fresh_k += part * ti.cast(hall.units[at].supply_c, hall.real)
            unit += hall.one
        fresh_k = fresh_k - cover * mixed_c
    else:
        mixed_c = block.approach_k + ti.cast(hall.units[unit_0].supply_c, hall.real)
    return ti.Struct(
        mixed_c=mixed_c,
        # sum_k s_jk f_k.
        cover=cover,
        exhaust_share=exhaust_share,
        # sum_k s_jk f_k (T_sup,k - T_mix).
        fresh_k=fresh_k,
        # Inlet of a server without exhaust intake; per_height_k is the change per height factor g.
        least_c=mixed_c + fresh_k,
        per_height_k=exhaust_share * fresh_k,
    )


@ti.func
@no_type_check
def rack_model(hall: ti.template(), servers: ti.template(), block_at):
    """Return the load of the racks of a block, and the factors that servers of a rack share."""
    block, u = hall.blocks[block_at], servers.utilisation
    if hall.load_level == LOADS_PER_RACK:
        u = block.load
    elif hall.load_level == LOADS_PER_GROUP:
        u = hall.zeros
    first_group = ti.Vector([0] * LANES)
    last_group = first_group
    if hall.load_level == LOADS_PER_GROUP:
        for i in range(LANES):
            place = block_at * LANES + i
            first_group[i] = hall.places[place].first_group
            last_group[i] = hall.places[place + 1].first_group - 1
    powered = block.powered
    blown_airflow = block.fan_airflow * powered
    available_airflow, fan_low = blown_airflow, servers.fan_low
    if ti.static(hall.transient):
        off = hall.real(1.0) - powered
        available_airflow = blown_airflow + hall.real(STILL_AIR_SHARE) * off
        # The draught is a share of the airflow at full speed, for any inlet and load.
        fan_low = ti.select(powered > hall.real(0.0), fan_low, hall.zeros + hall.real(1.0))
    return ti.Struct(
        # A group has the utilisation u + deviation*u*(1 - u): it keeps the total work of the rack
        # and stays within 0..1.
        deviation_scale=u * (hall.real(1.0) - u),
        utilisation=u,
        cpu_base=u * servers.cpu_shift + servers.cpu_offset,
        fan_base=u * servers.fan_shift + servers.fan_offset,
        per_server=block.per_server,
        heat_w=block.heat_w,
        # Indices of the first and last group in group_load, if loads are given per group.
        first_group=first_group,
        last_group=last_group,
        # Factors for sums over the groups, see apply_rack_factors.
        powered=powered,
        available_airflow=available_airflow,
        full_m3s=available_airflow * servers.full_m3s,
        full_fan_w=blown_airflow * servers.fan_full_w,
        fan_low=fan_low,
    )


@ti.func
@no_type_check
def group_inlet(hall: ti.template(), air: ti.template(), group):
    """Return the inlet of one group in each rack of a block, in C."""
    inlet_c = air.least_c + group.inlet_offset_k
    if ti.static(hall.recirculates):
        inlet_c = air.least_c - group.height_factor * air.per_height_k
    return inlet_c


@ti.func
@no_type_check
def add_knees(
    hall: ti.template(), servers: ti.template(), knees: ti.template(), on_curve_c, load, line
):
    """Return the value of a curve: a line plus the terms of the knees with indices ``knees``."""
    ratio = line
    for k in ti.static(range(*knees)):
        slope = load * servers.knee_shift[k] + servers.knee_slope[k]
        ratio = ratio + larger(on_curve_c, hall.zeros + servers.knee_c[k]) * slope
    return ratio


@ti.func
@no_type_check
def compute_group(
    hall: ti.template(),
    servers: ti.template(),
    racks: ti.template(),
    air: ti.template(),
    group,
    z,
):
    """Return inlet (C), power without fans (W), and airflow and fan power ratios of a server.

    The server belongs to group z in each rack of a block. Ratios are relative to the full airflow
    and full fan power of the data center. Power and airflow assume that the rack is on for the
    whole step and that its fans work.
    """
    inlet_c = group_inlet(hall, air, group)
    # Utilisation minus that of the rack, or utilisation itself if given per group.
    deviation = group.load_deviation * racks.deviation_scale
    if hall.load_level == LOADS_PER_GROUP:
        for i in range(LANES):
            # A rack without group z repeats its last group.
            at = ti.min(racks.first_group[i] + z, racks.last_group[i])
            deviation[i] = hall.group_load[at]
    on_curve_c = smaller(inlet_c, servers.curve_limit_c)
    load = deviation + racks.utilisation
    fan_knees, n_knees = ti.static(hall.fan_knees, hall.fan_knees + hall.cpu_knees)
    fan_line = on_curve_c * servers.fan_slope + (deviation * servers.fan_shift + racks.fan_base)
    airflow = add_knees(hall, servers, (0, fan_knees), on_curve_c, load, fan_line)
    cpu_line = on_curve_c * servers.cpu_slope + (deviation * servers.cpu_shift + racks.cpu_base)
    cpu_ratio = add_knees(hall, servers, (fan_knees, n_knees), on_curve_c, load, cpu_line)
    cpu_w = larger(larger(group.idle_w, racks.heat_w), group.full_w * cpu_ratio)
    airflow = smaller(larger(airflow, racks.fan_low), servers.fan_high)
    fan_power = airflow
    if servers.fan_exponent == hall.real(3.0):
        fan_power = airflow * airflow * airflow
    elif servers.fan_exponent != hall.real(1.0):
        # Compute x^p as x exp((p - 1) log x), which is 0 for x = 0.
        excess = servers.fan_exponent - hall.real(1.0)
        fan_power = airflow * hall.exp_of(hall.log_of(airflow) * excess)
    airflow *= group.full_airflow - on_curve_c * group.airflow_fall_per_k
    fan_power *= group.full_fan_power
    return inlet_c, cpu_w, airflow, fan_power


@ti.func
@no_type_check
def outlet_model(hall: ti.template(), n, servers: ti.template(), racks: ti.template()):
    """Return the factors of ``group_outlet`` that all servers of a rack share."""
    per_k = hall.real(1.0) / larger(
        racks.full_m3s * servers.air_j_per_m3_k, hall.zeros + hall.real(1e-30)
    )
    is_blown = racks.full_m3s > hall.real(0.0)
    return ti.Struct(
        # Temperature rise at full airflow: per W of power without fans, and at full fan power.
        cpu_k_per_w=racks.powered * per_k,
        fan_k=racks.full_fan_w * per_k,
        # Share of server minus inlet temperature that the air takes up.
        uptake=ti.select(is_blown, hall.zeros + hall.dcs[n].effectiveness, hall.zeros),
    )


@ti.func
@no_type_check
def group_outlet(
    hall: ti.template(),
    outlets: ti.template(),
    inlet_c,
    cpu_w,
    airflow,
    fan_power,
    server_c,
):
    """Return the outlet of a server in each rack of a block, in C, from ``compute_group``'s values.

    The outlet is T + P/(rho*cp*V). In transient halls it is
    T + eps (T_s - T) + P_fan/(rho*cp*V), with the server temperature T_s. This function needs one
    division, whereas ``layers.py`` divides by the airflow itself.
    """
    # If the curve gives no airflow, the outlet is very large but finite.
    some_airflow = airflow + hall.real(1e-30)
    outlet_c = inlet_c
    if ti.static(hall.transient):
        outlet_c += outlets.uptake * (server_c - inlet_c)
        outlet_c += fan_power * outlets.fan_k / some_airflow
    else:
        outlet_c += (cpu_w * outlets.cpu_k_per_w + fan_power * outlets.fan_k) / some_airflow
    return outlet_c


@ti.func
@no_type_check
def zero_rack_sums(hall: ti.template()):
    """Return zero sums over the groups of each rack of a block."""
    return ti.Struct(
        cpu_w=hall.zeros,
        fan_w=hall.zeros,
        flow_m3s=hall.zeros,
        inlet_c=hall.zeros,
        inlet_m3k_s=hall.zeros,
        height_m3s=hall.zeros,
    )


@ti.func
@no_type_check
def add_group(
    hall: ti.template(), sums: ti.template(), group, count, inlet_c, cpu_w, airflow, fan_power
):
    """Add ``count`` servers of a group to the sums of their racks, without rack factors."""
    counted = count * airflow
    sums.cpu_w += count * cpu_w
    sums.fan_w += count * fan_power
    sums.flow_m3s += counted
    sums.inlet_c += count * inlet_c
    if ti.static(hall.recirculates):
        sums.height_m3s += counted * group.height_factor
    else:
        sums.inlet_m3k_s += counted * inlet_c


@ti.func
@no_type_check
def apply_rack_factors(
    hall: ti.template(), sums: ti.template(), racks: ti.template(), air: ti.template()
):
    """Convert the sums to W, m3/s and m3 K/s; return the racks' need for supply air, in m3/s.

    The need is the supply air that the servers would take in if the CRAC units covered all of it,
    (1 - r_j) V_j.
    """
    sums.cpu_w *= racks.powered
    sums.fan_w *= racks.full_fan_w
    sums.flow_m3s *= racks.full_m3s
    sums.inlet_c *= racks.per_server
    fresh_m3s = hall.zeros
    if ti.static(hall.recirculates):
        fresh_m3s = sums.flow_m3s - air.exhaust_share * (sums.height_m3s * racks.full_m3s)
        sums.inlet_m3k_s = air.mixed_c * sums.flow_m3s + air.fresh_k * fresh_m3s
    else:
        sums.inlet_m3k_s *= racks.full_m3s
    return fresh_m3s


@ti.func
@no_type_check
def rack_outlet(hall: ti.template(), servers: ti.template(), sums: ti.template(), per_flow):
    """Return the outlet of racks in C, by outlet models of whole racks (inlet model approach).

    Model ``rack`` is T + P/(rho*cp*V). Model ``released`` is the fit of the released SustainDC,
    T + 1.918*P^1.096/(0.526*rho*cp*V^0.824) - 14.01. The term P^1.096 / V^0.824 is computed as
    P/V exp(0.096 log P + 0.176 log V), because the exponential of small numbers loses no digits.
    """
    power_w = sums.cpu_w + sums.fan_w
    outlet_c = sums.inlet_c + power_w * per_flow * servers.per_air
    if hall.outlet_model != OUTLET_OF_RACKS:
        power_part = hall.log_of(power_w) * hall.real(RELEASED_OUTLET.power_excess)
        flow_part = hall.log_of(sums.flow_m3s) * hall.real(RELEASED_OUTLET.flow_excess)
        fit = power_w * per_flow * hall.exp_of(power_part - flow_part)
        divisor = hall.real(RELEASED_OUTLET.divisor) * servers.air_j_per_m3_k
        outlet_c = sums.inlet_c + fit * (hall.real(RELEASED_OUTLET.factor) / divisor)
        outlet_c += hall.real(RELEASED_OUTLET.offset_k)
    return outlet_c


@ti.func
@no_type_check
def warming_model(hall: ti.template(), n, servers: ti.template()):
    """Return the coefficients of server warming in a substep, C dT/dt = P - eps K (T - T_in).

    C is the heat capacity of a server, K = rho*cp*V that of its airflow, and eps the share of
    T - T_in that the air takes up. The solution is exact: T(t) - T(0) = phi1(x) (P/C t - x (T(0) -
    T_in)) with x = eps K t / C.
    """
    dc, step_s = hall.dcs[n], ti.cast(present_substep_s(hall, n), hall.real)
    server_j_per_k = dc.server_j_per_k
    k_per_w, halvings = step_s / server_j_per_k, 0
    if ti.static(hall.transient):
        # Air at 0 C is 7 % denser than at the reference.
        most = hall.real(1.07) * dc.fan_high * servers.full_m3s
        most *= servers.uptake_j_per_m3_k * k_per_w
        halvings = halvings_for(hall, most)
        k_per_w *= power_of_half(hall, halvings)
    return ti.Struct(
        halvings=halvings,
        k_per_w=k_per_w,
        # Value of x for a server at full airflow.
        per_airflow=servers.full_m3s * servers.uptake_j_per_m3_k * k_per_w,
        w_per_k=server_j_per_k * (hall.real(1.0) / step_s),
    )


@ti.func
@no_type_check
def warm_servers(
    hall: ti.template(),
    warming: ti.template(),
    racks: ti.template(),
    at,
    capacity,
    inlet_c,
    cpu_w,
    airflow,
):
    """Advance the server temperatures of a group by a substep; return their change, in K."""
    before_c = hall.server_c[at]
    # Without airflow (x = 0) a server stores all of its power as heat.
    per_capacity = hall.real(1.0) / capacity
    x = airflow * (racks.available_airflow * warming.per_airflow) * per_capacity
    change_k = cpu_w * (racks.powered * warming.k_per_w) * per_capacity - (before_c - inlet_c) * x
    change_k *= phi1(hall, x, warming.halvings)
    hall.server_c[at] = before_c + change_k
    return change_k


@ti.func
@no_type_check
def group_at(hall: ti.template(), place, z):
    """Return the index of group z of the rack at a place, or of the last group if it has fewer."""
    return ti.min(hall.places[place].first_group + z, hall.places[place + 1].first_group - 1)


@ti.func
@no_type_check
def load_server_temperatures(hall: ti.template(), block_at):
    """Load the server temperatures of a block at the start of the step into server_c."""
    block = hall.blocks[block_at]
    for z in range(block.groups):
        before_c = hall.zeros
        for i in range(LANES):
            before_c[i] = hall.server_c_before[group_at(hall, block_at * LANES + i, z)]
        hall.server_c[block.first_place + z] = before_c


@ti.func
@no_type_check
def store_server_temperatures(hall: ti.template(), block_at, z, count, after_c):
    """Store the server temperatures of a group at the end of the step in server_c_after."""
    for i in range(LANES):
        if count[i] > hall.real(0.0):
            group = hall.places[block_at * LANES + i].first_group + z
            hall.server_c_after[group] = after_c[i]
