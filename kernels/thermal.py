"""Server temperatures and power over all racks of all data centers.

Servers of a rack that are alike form a group, which is computed once; ``expand`` copies its
values to per-server layers. Racks point into groups and groups into servers by offsets, so halls
may have any size. Every literal here is exact in binary, so that f64 runs lose nothing to the
default f32 literals of the runtime.

Arrays are two-dimensional with one row per quantity; the row names below are the interface. Sums
run serially within a chunk of racks and over the chunks of a data center, so that a data center
gives the same bits alone and in any batch.
"""

from functools import cache
from typing import Any, no_type_check

from .backend import ti

INLETS = ("approach", "recirculation")
THERMAL = ("quasi_steady", "transient")
OUTLETS = ("server", "rack", "released")

RACK_INTS = ("first_group", "first_run", "dc")
RUN_INTS = ("first", "length", "offset")
CHUNK_INTS = ("first_rack", "dc", "first_need")
DC_INTS = ("first_chunk", "first_unit", "first_rack", "first_share")
RACK_ROWS = ("approach_k", "norm", "load", "powered", "airflow", "strength")
GROUP_ROWS = ("count", "full_w", "idle_w", "inlet_offset_k", "load_deviation", "captured", "load")
DC_ROWS = (
    "cpu_slope_per_k",
    "cpu_offset",
    "cpu_shift",
    "fan_slope_per_k",
    "fan_offset",
    "fan_shift",
    "fan_low",
    "fan_high",
    "fan_reference_ratio",
    "fan_exponent",
    "fan_reference_w",
    "fan_full_m3s",
    "air_j_per_m3_k",
    "curve_limit_c",
    "fresh_share",
    "server_j_per_k",
    "effectiveness",
    "parcel_j_per_k",
)
DC_DOUBLES = (
    "room_j",
    "room_j_per_k",
    "coil_limit_w",
    "crac_fan_w_per_m3s",
    "it_airflow_m3s",
    "overshoot",
    "change_k",
    "shift",
)
"""Per data center in f64: heat held by the room and what the coil needs in transient runs, how far
every second sweep goes beyond its mix, and by how much the last one moved it and the cover."""
UNIT_ROWS = ("setpoint_c", "low", "high", "design_m3s", "running")
UNIT_STATE = (
    "supply_c",
    "fresh_ratio",
    "fresh_ratio_used",
    "flow_m3s",
    "cubed_speed",
    "need_m3s",
    "following",
)
"""What units give and cover; need for supply air and the servers' airflow over that at design."""
RACK_STATE = ("mixed_c", "exhaust_c", "exhaust_c", "captured_m3s")
"""Exhaust mix before a rack, outlets times strength of the sweeps in turn, flow that the rack takes
of the mix."""
RACK_OUT = ("cpu_w", "fan_w", "airflow_m3s", "inlet_c", "inlet_max_c", "outlet_c")
GROUP_OUT = ("inlet_c", "outlet_c", "power_w")
SUMS = (
    "cpu_w",
    "fan_w",
    "airflow_m3s",
    "inlet_c",
    "outlet_c",
    "inlet_m3k_s",
    "outlet_m3k_s",
    "captured_m3k_s",
    "hot_k",
    "cold_k",
    "stored_w",
    "inlet_max_c",
    "hottest_group",
    "change_k",
)
"""Per chunk of racks; all but the last three add up."""
DC_OUT = (
    "cpu_w",
    "fan_w",
    "airflow_m3s",
    "inlet_mean_c",
    "outlet_mean_c",
    "inlet_m3k_s",
    "outlet_m3k_s",
    "hot_k",
    "cold_k",
    "stored_w",
    "crac_flow_m3s",
    "supply_c",
    "return_c",
    "coil_load_w",
    "coil_w",
    "inlet_max_c",
    "hottest_group",
)

RECOMMENDED_HIGH_C = 27.0
RECOMMENDED_LOW_C = 18.0

# A parallel loop of at most 512 iterations runs on one thread, so each slice of racks gets 512.
_BLOCK = 512


def _real(precision: str) -> Any:
    return {"f32": ti.f32, "f64": ti.f64}[precision]


@cache
def hall_kernel(precision: str) -> Any:
    """Kernel that computes every group once and sums over racks and data centers.

    CPU power max(idle, full*(slope*T + offset + shift*u)); airflow ratio
    y = clip(slope*T + offset + shift*u); fan power reference*(y/reference ratio)^exponent
    (Sun et al. 2021; EnergyPlus ElectricEquipment:ITE:AirCooled), T at most the curve limit.
    Utilisation of a group is u + deviation*u*(1 - u), which conserves the rack's work and stays
    within 0..1.

    Inlets, ``approach``: supply air plus the rack's approach temperature. ``recirculation``: of the
    intake of a server the share 1 - f (1 - c) is exhaust of the racks around, mixed by their
    weights; c is its share at the design point and f <= 1 how much of their need the CRAC units
    cover. Sweeps repeat until the mix before every rack moves by less than ``tolerance_k``.

    Outlets: ``server`` is T + P/(rho*cp*V) per group, ``rack`` the same with the rack's sums, and
    ``released`` the rack fit T + 1.918*P^1.096/(0.526*rho*cp*V^0.824) - 14.01 of the released
    SustainDC, whose constants come in as ``fit``.

    ``transient``: a sweep is a substep. Servers follow C dT/dt = P_cpu - eps K (T - T_in); the
    recirculated air before a rack follows its mix with the time constant of its share of the room
    air, or that of a room without fans. Both by the exact exponential, and what leaves is the exact
    mean, so heat stored plus heat removed is heat generated. Supply air is the setpoint plus what
    the heat kept by the room warms it by; the coil takes what the plant can.
    """
    real = _real(precision)
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)
    doubles_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)
    doubles_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.kernel
    @no_type_check
    def hall(
        recirculates: ti.template(),
        transient: ti.template(),
        outlet_model: ti.template(),
        group_loads: ti.template(),
        write_groups: ti.template(),
        advance: ti.template(),
        slices: ti.i32,
        source: ti.i32,
        first_sweep: ti.i32,
        first_substep: ti.i32,
        substep_s: ti.f64,
        weight: ti.f64,
        tolerance_k: ti.f64,
        rack_ints: ints_2d,
        run_ints: ints_2d,
        chunk_ints: ints_2d,
        dc_ints: ints_2d,
        active: ints_1d,
        weights: reals_1d,
        shares: reals_1d,
        racks: reals_2d,
        groups: reals_2d,
        dcs: reals_2d,
        doubles: doubles_2d,
        units: reals_2d,
        unit_state: doubles_2d,
        rack_state: reals_2d,
        server_c: reals_1d,
        fit: reals_1d,
        rack_out: reals_2d,
        group_out: reals_2d,
        needs: doubles_1d,
        sums: doubles_2d,
        dc_out: doubles_2d,
    ):
        n_chunks = sums.shape[1]
        for k in range(slices * 512):
            if k % 512 == 0:
                first = ti.cast(ti.cast(k // 512, ti.i64) * n_chunks // slices, ti.i32)
                last = ti.cast((ti.cast(k // 512, ti.i64) + 1) * n_chunks // slices, ti.i32)
                for chunk in range(first, last):
                    n = chunk_ints[1, chunk]
                    if active[n] != 0:
                        unit_0 = dc_ints[1, n]
                        n_units = dc_ints[1, n + 1] - unit_0
                        need_0 = chunk_ints[2, chunk]
                        for j in range(n_units):
                            needs[need_0 + j] = 0.0
                        cpu_slope = dcs[0, n]
                        cpu_offset = dcs[1, n]
                        cpu_shift = dcs[2, n]
                        fan_slope = dcs[3, n]
                        fan_offset = dcs[4, n]
                        fan_shift = dcs[5, n]
                        fan_low = dcs[6, n]
                        fan_high = dcs[7, n]
                        per_reference = real(1.0) / dcs[8, n]
                        exponent = dcs[9, n]
                        fan_reference_w = dcs[10, n]
                        full_m3s = dcs[11, n]
                        air = dcs[12, n]
                        limit_c = dcs[13, n]
                        step_s = ti.cast(substep_s, real)
                        still_per_s = real(1.0 / 128.0)
                        # Most of what is left after a sweep is the same for all racks and shrinks
                        # by a known factor, so every second sweep goes all the way.
                        beyond = ti.cast(doubles[5, n], real) * ti.cast(source, real)
                        cpu_sum = ti.cast(0.0, ti.f64)
                        fan_sum = ti.cast(0.0, ti.f64)
                        flow_sum = ti.cast(0.0, ti.f64)
                        inlet_sum = ti.cast(0.0, ti.f64)
                        outlet_sum = ti.cast(0.0, ti.f64)
                        inlet_flow_sum = ti.cast(0.0, ti.f64)
                        outlet_flow_sum = ti.cast(0.0, ti.f64)
                        captured_sum = ti.cast(0.0, ti.f64)
                        hot_sum = ti.cast(0.0, ti.f64)
                        cold_sum = ti.cast(0.0, ti.f64)
                        stored_sum = ti.cast(0.0, ti.f64)
                        change = ti.cast(0.0, ti.f64)
                        chunk_max = real(-1e30)
                        hottest_group = 0
                        for q in range(chunk_ints[0, chunk], chunk_ints[0, chunk + 1]):
                            base = real(0.0)
                            cover = real(0.0)
                            supply = real(0.0)
                            mixed = real(0.0)
                            parcel_w = real(0.0)
                            share_0 = dc_ints[3, n] + (q - dc_ints[2, n]) * n_units
                            if ti.static(recirculates):
                                for j in range(n_units):
                                    part = shares[share_0 + j] * ti.cast(
                                        unit_state[1 if ti.static(advance) else 2, unit_0 + j],
                                        real,
                                    )
                                    cover += part
                                    supply += part * ti.cast(unit_state[0, unit_0 + j], real)
                                supply /= ti.max(cover, real(1e-30))
                                mixed = rack_state[0, q]
                                if ti.static(advance):
                                    target = real(0.0)
                                    for run in range(rack_ints[1, q], rack_ints[1, q + 1]):
                                        from_rack = run_ints[0, run]
                                        from_weight = run_ints[2, run]
                                        total = real(0.0)
                                        for i in range(run_ints[1, run]):
                                            total += (
                                                weights[from_weight + i]
                                                * rack_state[1 + source, from_rack + i]
                                            )
                                        target += total
                                    target *= racks[1, q]
                                    if ti.static(transient):
                                        # The parcel of room air before the rack: enters at the mix,
                                        # leaves at its own temperature.
                                        x = step_s * ti.max(
                                            air * rack_state[3, q] / dcs[17, n], still_per_s
                                        )
                                        gone = real(1.0) - ti.exp(-x)
                                        after = mixed + (target - mixed) * gone
                                        parcel_w = dcs[17, n] * (after - mixed) / step_s
                                        mixed = target + (mixed - target) * gone / x
                                        rack_state[0, q] = after
                                    else:
                                        change = ti.max(
                                            change, ti.cast(ti.abs(target - mixed), ti.f64)
                                        )
                                        mixed = target + beyond * (target - mixed)
                                        rack_state[0, q] = mixed
                            else:
                                base = ti.cast(unit_state[0, unit_0], real) + racks[0, q]
                            u = racks[2, q]
                            spread = u * (real(1.0) - u)
                            powered = racks[3, q]
                            breath = racks[4, q] * powered
                            servers = real(0.0)
                            cpu = real(0.0)
                            fan = real(0.0)
                            flow = real(0.0)
                            inlet = real(0.0)
                            inlet_flow = real(0.0)
                            fresh_flow = real(0.0)
                            heat = real(0.0)
                            hot = real(0.0)
                            cold = real(0.0)
                            stored = real(0.0)
                            hottest = real(-1e30)
                            hottest_here = 0
                            for g in range(rack_ints[0, q], rack_ints[0, q + 1]):
                                t = base + groups[3, g]
                                if ti.static(recirculates):
                                    t = mixed + cover * (real(1.0) - groups[5, g]) * (
                                        supply - mixed
                                    )
                                load = u + groups[4, g] * spread
                                if ti.static(group_loads):
                                    load = groups[6, g]
                                on_curve = ti.min(t, limit_c)
                                ratio = cpu_slope * on_curve + cpu_offset + cpu_shift * load
                                cpu_1 = ti.max(groups[2, g], groups[1, g] * ratio)
                                y = ti.min(
                                    ti.max(
                                        fan_slope * on_curve + fan_offset + fan_shift * load,
                                        fan_low,
                                    ),
                                    fan_high,
                                )
                                speed = y * per_reference
                                fan_1 = fan_reference_w
                                # A branch on data, not one kernel per exponent: compiled apart,
                                # they would round apart, and a data center must not depend on its
                                # batch.
                                if exponent == real(3.0):
                                    fan_1 *= speed * speed * speed
                                elif exponent == real(1.0):
                                    fan_1 *= speed
                                else:
                                    fan_1 *= ti.pow(speed, exponent)
                                flow_1 = full_m3s * y
                                cpu_1 *= powered
                                fan_1 *= breath
                                flow_1 *= breath
                                many = groups[0, g]
                                to_air = cpu_1
                                if ti.static(transient):
                                    exchange = dcs[16, n] * air * flow_1
                                    x = step_s * exchange / dcs[15, n]
                                    before = server_c[g]
                                    to_air = exchange * (before - t)
                                    if ti.static(advance) and x > real(0.0):
                                        steady = t + cpu_1 / exchange
                                        left = ti.exp(-x)
                                        after = steady + (before - steady) * left
                                        to_air = cpu_1 - dcs[15, n] * (after - before) / step_s
                                        server_c[g] = after
                                        stored += many * dcs[15, n] * (after - before) / step_s
                                servers += many
                                cpu += many * cpu_1
                                fan += many * fan_1
                                flow += many * flow_1
                                inlet += many * t
                                inlet_flow += many * flow_1 * t
                                heat += many * (to_air + fan_1)
                                if ti.static(recirculates):
                                    fresh_flow += many * flow_1 * (real(1.0) - groups[5, g])
                                hot += many * ti.max(t - real(27.0), real(0.0))
                                cold += many * ti.max(real(18.0) - t, real(0.0))
                                if t > hottest:
                                    hottest = t
                                    hottest_here = g
                                if ti.static(write_groups):
                                    group_out[0, g] = t
                                    group_out[1, g] = t
                                    if flow_1 > real(0.0):
                                        group_out[1, g] = t + (to_air + fan_1) / (air * flow_1)
                                    group_out[2, g] = cpu_1 + fan_1
                            outlet = inlet / servers
                            if flow > real(0.0):
                                outlet = (inlet_flow + heat / air) / flow
                                if ti.static(outlet_model == 1):
                                    outlet = inlet / servers + (cpu + fan) / (air * flow)
                                elif ti.static(outlet_model == 2):
                                    outlet = (
                                        inlet / servers
                                        + fit[0]
                                        * ti.pow(cpu + fan, fit[1])
                                        / (fit[2] * air * ti.pow(flow, fit[3]))
                                        + fit[4]
                                    )
                            if ti.static(write_groups and outlet_model != 0):
                                for g in range(rack_ints[0, q], rack_ints[0, q + 1]):
                                    group_out[1, g] = outlet
                            if ti.static(recirculates):
                                captured = flow - cover * fresh_flow
                                if ti.static(advance):
                                    rack_state[2 - source, q] = outlet * racks[5, q]
                                    rack_state[3, q] = captured
                                captured_sum += ti.cast(captured * mixed + parcel_w / air, ti.f64)
                                for j in range(n_units):
                                    needs[need_0 + j] += ti.cast(
                                        shares[share_0 + j] * fresh_flow, ti.f64
                                    )
                            inlet /= servers
                            if ti.static(recirculates):
                                if flow > real(0.0):
                                    inlet = inlet_flow / flow
                            cpu_sum += ti.cast(cpu, ti.f64)
                            fan_sum += ti.cast(fan, ti.f64)
                            flow_sum += ti.cast(flow, ti.f64)
                            inlet_sum += ti.cast(inlet, ti.f64)
                            outlet_sum += ti.cast(outlet, ti.f64)
                            inlet_flow_sum += ti.cast(inlet_flow, ti.f64)
                            outlet_flow_sum += ti.cast(inlet_flow + heat / air, ti.f64)
                            hot_sum += ti.cast(hot, ti.f64)
                            cold_sum += ti.cast(cold, ti.f64)
                            stored_sum += ti.cast(stored + parcel_w, ti.f64)
                            if hottest > chunk_max:
                                chunk_max = hottest
                                hottest_group = hottest_here
                            if ti.static(transient):
                                share = ti.cast(weight, real)
                                if first_substep != 0:
                                    for r in ti.static(range(6)):
                                        rack_out[r, q] = real(0.0)
                                    rack_out[4, q] = hottest
                                rack_out[0, q] += share * cpu
                                rack_out[1, q] += share * fan
                                rack_out[2, q] += share * flow
                                rack_out[3, q] += share * inlet
                                rack_out[4, q] = ti.max(hottest, rack_out[4, q])
                                rack_out[5, q] += share * outlet
                            else:
                                rack_out[0, q] = cpu
                                rack_out[1, q] = fan
                                rack_out[2, q] = flow
                                rack_out[3, q] = inlet
                                rack_out[4, q] = hottest
                                rack_out[5, q] = outlet
                        sums[0, chunk] = cpu_sum
                        sums[1, chunk] = fan_sum
                        sums[2, chunk] = flow_sum
                        sums[3, chunk] = inlet_sum
                        sums[4, chunk] = outlet_sum
                        sums[5, chunk] = inlet_flow_sum
                        sums[6, chunk] = outlet_flow_sum
                        sums[7, chunk] = captured_sum
                        sums[8, chunk] = hot_sum
                        sums[9, chunk] = cold_sum
                        sums[10, chunk] = stored_sum
                        sums[11, chunk] = ti.cast(chunk_max, ti.f64)
                        sums[12, chunk] = ti.cast(hottest_group, ti.f64)
                        sums[13, chunk] = change
        for n in range(dc_out.shape[1]):
            if active[n] != 0:
                total = ti.Vector([ti.cast(0.0, ti.f64)] * 11)
                hottest_dc = ti.cast(-1e30, ti.f64)
                hottest_at = ti.cast(0.0, ti.f64)
                change_dc = ti.cast(0.0, ti.f64)
                for chunk in range(dc_ints[0, n], dc_ints[0, n + 1]):
                    for r in ti.static(range(11)):
                        total[r] += sums[r, chunk]
                    if sums[11, chunk] > hottest_dc:
                        hottest_dc = sums[11, chunk]
                        hottest_at = sums[12, chunk]
                    change_dc = ti.max(change_dc, sums[13, chunk])
                n_racks = ti.cast(dc_ints[2, n + 1] - dc_ints[2, n], ti.f64)
                air_dc = ti.cast(dcs[12, n], ti.f64)
                crac_flow = ti.cast(0.0, ti.f64)
                supply_flow = ti.cast(0.0, ti.f64)
                passing = ti.cast(0.0, ti.f64)
                return_c = ti.cast(0.0, ti.f64)
                coil_load = ti.cast(0.0, ti.f64)
                coil_w = ti.cast(0.0, ti.f64)
                if ti.static(recirculates and advance):
                    unit_first = dc_ints[1, n]
                    many_units = dc_ints[1, n + 1] - unit_first
                    following = total[2] / doubles[4, n]
                    shift = ti.cast(0.0, ti.f64)
                    for j in range(many_units):
                        at = unit_first + j
                        need = ti.cast(0.0, ti.f64)
                        for chunk in range(dc_ints[0, n], dc_ints[0, n + 1]):
                            need += needs[chunk_ints[2, chunk] + j]
                        low = ti.cast(units[1, at], ti.f64)
                        high = ti.cast(units[2, at], ti.f64)
                        fan_speed = ti.min(ti.max(following, low), high)
                        flow_unit = ti.cast(units[3, at], ti.f64) * fan_speed
                        offered = ti.cast(dcs[14, n], ti.f64) * flow_unit
                        crac_flow += flow_unit
                        supply_flow += flow_unit * unit_state[0, at]
                        passing += (flow_unit - unit_state[1, at] * need) * unit_state[0, at]
                        unit_state[2, at] = unit_state[1, at]
                        unit_state[1, at] = ti.min(
                            ti.cast(1.0, ti.f64), offered / ti.max(need, ti.cast(1e-30, ti.f64))
                        )
                        unit_state[5, at] = need
                        unit_state[6, at] = following
                        shift = ti.max(shift, ti.abs(unit_state[1, at] - unit_state[2, at]))
                        moved = flow_unit
                        cubed = fan_speed * fan_speed * fan_speed * ti.cast(units[4, at], ti.f64)
                        if ti.static(transient):
                            moved *= weight
                            cubed *= weight
                            if first_substep == 0:
                                moved += unit_state[3, at]
                                cubed += unit_state[4, at]
                        unit_state[3, at] = moved
                        unit_state[4, at] = cubed
                    return_c = (total[6] - total[7] + passing) / crac_flow
                    if ti.static(transient):
                        running = ti.cast(0.0, ti.f64)
                        fans_w = ti.cast(0.0, ti.f64)
                        for j in range(many_units):
                            at = unit_first + j
                            low = ti.cast(units[1, at], ti.f64)
                            high = ti.cast(units[2, at], ti.f64)
                            fan_speed = ti.min(ti.max(following, low), high)
                            design_m3s = ti.cast(units[3, at], ti.f64)
                            is_on = ti.cast(units[4, at], ti.f64)
                            taken = air_dc * design_m3s * fan_speed * (return_c - unit_state[0, at])
                            drawn = (
                                is_on
                                * fan_speed
                                * fan_speed
                                * fan_speed
                                * doubles[3, n]
                                * design_m3s
                            )
                            fans_w += drawn
                            coil_load += taken + drawn
                            running += is_on * (taken + drawn)
                            if is_on > 0.0:
                                coil_w = ti.cast(1.0, ti.f64)
                        wanted = ti.max(running + coil_w * doubles[0, n] / substep_s, 0.0)
                        coil_w = ti.min(wanted, doubles[2, n])
                        doubles[0, n] += (coil_load - coil_w) * substep_s
                        for j in range(many_units):
                            unit_state[0, unit_first + j] = (
                                ti.cast(units[0, unit_first + j], ti.f64)
                                + doubles[0, n] / doubles[1, n]
                            )
                    else:
                        # Where supply air falls short, its share must stand still as well.
                        # The air of a rack feels it one sweep later.
                        earlier = 0.0 * shift
                        if first_sweep == 0:
                            earlier = doubles[7, n]
                        change_dc = ti.max(change_dc, 32.0 * ti.max(shift, earlier))
                        doubles[7, n] = shift
                        shrinks = doubles[5, n] / (1.0 + doubles[5, n])
                        to_come = change_dc
                        if first_substep == 0:
                            shrinks = ti.min(ti.max(shrinks, change_dc / doubles[6, n]), 0.9375)
                            to_come *= shrinks / (1.0 - shrinks)
                        active[n] = ti.cast(to_come > tolerance_k, ti.i32)
                        doubles[6, n] = change_dc
                scale = ti.cast(1.0, ti.f64)
                keep = ti.cast(0.0, ti.f64)
                if ti.static(transient):
                    scale = weight
                    if first_substep == 0:
                        keep = ti.cast(1.0, ti.f64)
                supply_c = ti.cast(0.0, ti.f64)
                if crac_flow > 0.0:
                    supply_c = supply_flow / crac_flow
                now = ti.Vector(
                    [
                        total[0],
                        total[1],
                        total[2],
                        total[3] / n_racks,
                        total[4] / n_racks,
                        total[5] - total[2] * supply_c,
                        total[6] - total[2] * supply_c,
                        total[8],
                        total[9],
                        total[10],
                        crac_flow,
                        supply_c,
                        return_c,
                        coil_load,
                        coil_w,
                    ]
                )
                for r in ti.static(range(15)):
                    value = scale * now[r]
                    if keep > 0.0:
                        value += dc_out[r, n]
                    dc_out[r, n] = value
                if keep == 0.0 or hottest_dc > dc_out[15, n]:
                    dc_out[15, n] = hottest_dc
                    dc_out[16, n] = hottest_at

    return hall


@cache
def expand_kernel(precision: str) -> Any:
    """Kernel that copies the values of every group to its servers.

    It stores at the speed of memory into the caller's arrays, one per layer; no field, whose
    memory would outlive the simulator and whose kernels would be compiled per simulator.
    """
    real = _real(precision)
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.kernel
    @no_type_check
    def expand(
        slices: ti.i32,
        server_start: ints_1d,
        group_out: reals_2d,
        inlet_c: reals_1d,
        outlet_c: reals_1d,
        power_w: reals_1d,
    ):
        n_groups = server_start.shape[0] - 1
        for k in range(slices * 512):
            if k % 512 == 0:
                first = ti.cast(ti.cast(k // 512, ti.i64) * n_groups // slices, ti.i32)
                last = ti.cast((ti.cast(k // 512, ti.i64) + 1) * n_groups // slices, ti.i32)
                for g in range(first, last):
                    inlet = group_out[0, g]
                    outlet = group_out[1, g]
                    power = group_out[2, g]
                    for s in range(server_start[g], server_start[g + 1]):
                        inlet_c[s] = inlet
                        outlet_c[s] = outlet
                        power_w[s] = power

    return expand
