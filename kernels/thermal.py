"""Server temperatures and power over all racks of all data centers.

Servers of a rack that are alike form a group, which is computed once; ``expand`` copies its
values to per-server layers. Halls may have any size: the racks of a data center are cut into blocks
of LANES, filled up with racks without servers, and all arithmetic runs over the lanes of a block.
Small local arrays hold a block, because only stores to them let the compiler vectorise a loop.
Blocks whose groups are equal share a table. Every literal here is exact in binary, so that f64 runs
lose nothing to the default f32 literals of the runtime.

Arrays are two-dimensional with one row per quantity; the row names below are the interface. Sums
run serially within a chunk of blocks and over the chunks of a data center, so that a data center
gives the same bits alone and in any batch.
"""

from functools import cache
from math import factorial, log
from typing import Any, no_type_check

from .backend import ti

HALL_TEMPLATES = 6
"""Template arguments of ``hall_kernel``, which come first."""
OUTLETS = ("server", "rack", "released")

LANES = 16
"""Racks that are computed at a time; the same for all, so that results never depend on it."""

BLOCK_INTS = ("racks", "groups", "table", "place")
"""Racks and groups per rack of each block, entry of its tables, and first place of its groups."""
RUN_INTS = ("first", "length", "offset")
CHUNK_INTS = ("first_block", "dc", "first_need")
DC_INTS = ("first_chunk", "first_unit", "first_share", "racks")
CONTROL = ("active", "exchange", "side", "sweep", "chunks")
"""Per data center: whether the next sweep computes it (1), it has ended (0) or come to no end (-1);
whether the next sweep exchanges anew; which row of the exhaust its last exchange saw; sweeps since
the start; chunks that have done the present sweep."""
RACK_ROWS = (
    "approach_k",
    "norm",
    "load",
    "powered",
    "airflow",
    "strength",
    "per_strength",
    "captured",
    "servers",
    "start_approach_k",
    "start_rise_k",
    "mixed_approach_k",
    "mixed_rise_k",
)
"""The last four start the sweeps: of a rack and of the exhaust mix before it."""
GROUP_ROWS = ("count", "full_w", "idle_w", "inlet_offset_k", "load_deviation", "height")
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
    "start_scale",
    "start_warming",
    "kept",
    "start_c",
    "shift_k",
    "moved_k",
    "shifted_k",
    "stirring_m3s",
)
"""Per data center in f64: heat held by the room and what the coil needs in transient runs; where
the sweeps start and what they keep of a common deviation; common shift of the exhaust mixes since
the last exchange, and by how much the outlets and the shift changed in the last sweep; CRAC
air per rack."""
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
RACK_STATE = ("mixed_c", "exhaust_c", "exhaust_odd_c", "captured_m3s", "exchanged_c")
"""Exhaust mix before a rack, what it gives to the mixes times strength at the last exchange and
since in turn, flow that the rack takes of the mix, and the mix at the last exchange."""
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
    "least_change_k",
    "most_change_k",
)
"""Per chunk; all but the last four add up."""
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
"""Ends of the range that ASHRAE TC 9.9 (2021) recommends for inlets, beyond which degrees count."""

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
"""Of so many sweeps one takes no step of that kind, so that wrong ones cannot go on for ever."""
STILL_PER_S = 1.0 / 128.0
"""Fastest rate at which CRAC air stirs the air before racks that stand still, as without fans in
the room; a power of two, exact in both precisions."""
NO_RACK_C = 20.0
"""Temperature of the places that hold no rack: any at which all curves are finite."""

EXP_TERMS = {"f32": 8, "f64": 15}
"""Terms of the series of exp on half an octave of 2 to the last digit."""


def exp_constants(precision: str) -> list[float]:
    """1/ln 2, ln 2 and the series of exp, for ``hall_kernel``."""
    terms = range(EXP_TERMS[precision] - 1, -1, -1)
    return [1.0 / log(2.0), log(2.0), *(1.0 / factorial(k) for k in terms)]


SLICE = 512
"""Iterations of a slice of chunks: a parallel loop of at most so many runs on one thread."""


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
    cover. Where a rack's fans move less air than there, the mix before it takes the place of what
    its exhaust lacks, so that no rack gives more heat than it has. Sweeps repeat until one more
    would move no mix by more than ``tolerance_k``, at most ``sweeps`` times. The weights of a mix
    sum to 1, so it moves by no more than the exhausts have moved since the last exchange; where all
    of them moved alike, the mixes are shifted and nothing is exchanged.

    Outlets: ``server`` is T + P/(rho*cp*V) per group, ``rack`` the same with the rack's sums, and
    ``released`` the rack fit T + 1.918*P^1.096/(0.526*rho*cp*V^0.824) - 14.01 of the released
    SustainDC, whose constants come in as ``constants``, followed by ``exp_constants``.

    ``transient``: a sweep is a substep. Servers follow C dT/dt = P_cpu - eps K (T - T_in); the
    recirculated air before a rack follows its mix with the time constant of its share of the room
    air; before racks that take in none, the CRAC air stirs it. Both by the exact exponential, and
    what leaves is the exact mean, so heat stored plus heat removed is heat generated. Supply air is
    the setpoint plus what the heat kept by the room warms it by; the coil takes what the plant can.

    A data center whose chunks are one task runs all its ``sweeps`` in one call, others one per
    call. ``tasks``: first chunk of each, and the end of the last.
    """
    real = _real(precision)
    whole = ti.i32 if precision == "f32" else ti.i64
    mantissa, bias = (23, 127) if precision == "f32" else (52, 1023)
    terms = EXP_TERMS[precision]
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    blocks_2d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    blocks_1d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=1)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)
    doubles_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)
    doubles_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.func
    @no_type_check
    def lanes(value):
        return ti.Vector([ti.cast(value, real)] * LANES)

    @ti.func
    @no_type_check
    def sums_of_lanes():
        return ti.Vector([ti.cast(0.0, ti.f64)] * LANES)

    @ti.func
    @no_type_check
    def total_of(values):
        total = ti.cast(0.0, ti.f64)
        for i in ti.static(range(LANES)):
            total += values[i]
        return total

    @ti.func
    @no_type_check
    def larger(a, b):
        """As ``ti.max`` of numbers; one instruction, where that looks for NaN as well."""
        return ti.select(a > b, a, b)

    @ti.func
    @no_type_check
    def smaller(a, b):
        return ti.select(a < b, a, b)

    @ti.func
    @no_type_check
    def exp_of_minus(x, constants: ti.template()):
        """exp(-x) for 0 <= x, by its series; calls would keep loops from being vectorised."""
        y = -smaller(x, real(80.0))
        octave = ti.floor(y * constants[5] + real(0.5))
        rest = y - octave * constants[6]
        out = constants[7]
        for i in ti.static(range(8, 7 + terms)):
            out = out * rest + constants[i]
        return out * ti.bit_cast((ti.cast(octave, whole) + bias) << mantissa, real)

    @ti.func
    @no_type_check
    def close(
        recirculates: ti.template(),
        transient: ti.template(),
        advance: ti.template(),
        n,
        sweeps,
        substep_s,
        weight,
        tolerance_k,
        chunk_ints: ti.template(),
        dc_ints: ti.template(),
        control: ti.template(),
        dcs: ti.template(),
        doubles: ti.template(),
        units: ti.template(),
        unit_state: ti.template(),
        needs: ti.template(),
        sums: ti.template(),
        dc_out: ti.template(),
    ):
        """Sums of a data center, its CRAC units, and what its next sweep is."""
        total = ti.Vector([ti.cast(0.0, ti.f64)] * 11)
        hottest_dc = ti.cast(-1e30, ti.f64)
        hottest_at = ti.cast(0.0, ti.f64)
        least_k = ti.cast(1e30, ti.f64)
        most_k = ti.cast(-1e30, ti.f64)
        for chunk in range(dc_ints[0, n], dc_ints[0, n + 1]):
            for r in ti.static(range(11)):
                total[r] += sums[r, chunk]
            if sums[11, chunk] > hottest_dc:
                hottest_dc = sums[11, chunk]
                hottest_at = sums[12, chunk]
            least_k = ti.min(least_k, sums[13, chunk])
            most_k = ti.max(most_k, sums[14, chunk])
        n_racks = ti.cast(dc_ints[3, n], ti.f64)
        sweep = control[3, n]
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
            uncovered = ti.cast(0.0, ti.f64)
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
                used = unit_state[1, at]
                passing += (flow_unit - used * need) * unit_state[0, at]
                unit_state[2, at] = used
                covers = ti.min(
                    ti.cast(1.0, ti.f64), offered / ti.max(need, ti.cast(1e-30, ti.f64))
                )
                uncovered = ti.max(uncovered, ti.abs(covers - used))
                unit_state[1, at] = covers
                unit_state[5, at] = need
                unit_state[6, at] = following
                moved = flow_unit
                cubed = fan_speed * fan_speed * fan_speed * ti.cast(units[4, at], ti.f64)
                if ti.static(transient):
                    moved *= weight
                    cubed *= weight
                    if sweep > 0:
                        moved += unit_state[3, at]
                        cubed += unit_state[4, at]
                unit_state[3, at] = moved
                unit_state[4, at] = cubed
            return_c = (total[6] - total[7] + passing) / crac_flow
            doubles[12, n] = crac_flow / n_racks
            # All mixes move by the middle of the outlets' changes, give or take half their spread.
            middle_k = 0.5 * (least_k + most_k)
            apart = 0.5 * (most_k - least_k) > ALIKE * tolerance_k
            exchanged = control[1, n] != 0
            if exchanged:
                control[2, n] = 1 - control[2, n]
            control[3, n] = sweep + 1
            control[1, n] = ti.cast(apart, ti.i32)
            more = ti.cast(sweep + 1 < sweeps, ti.i32)
            if ti.static(transient):
                control[0, n] = more
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
                    drawn = is_on * fan_speed * fan_speed * fan_speed * doubles[3, n] * design_m3s
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
                        ti.cast(units[0, unit_first + j], ti.f64) + doubles[0, n] / doubles[1, n]
                    )
                doubles[9, n] = ti.select(apart, ti.cast(0.0, ti.f64), middle_k)
            else:
                shift_k = doubles[9, n]
                left_k = ti.max(most_k - shift_k, shift_k - least_k)
                # The mixes cool or warm by less than what they lie above supply air.
                above_k = ti.abs(total[4] / n_racks - supply_flow / crac_flow)
                left_k = ti.max(left_k, uncovered * above_k)
                control[0, n] = 0
                if not left_k <= tolerance_k:
                    control[0, n] = 2 * more - 1
                # Most of what is left is the same for all racks and shrinks by a factor, so a sweep
                # can go all the way: as expected, or as the last sweep showed, now and then not.
                moved_k = middle_k - doubles[10, n]
                kept = ti.min(doubles[7, n], EXPECTED_KEPT)
                moved_far = ti.abs(doubles[11, n]) > SEEN_FROM * tolerance_k
                if sweep > 0 and not exchanged and moved_far:
                    kept = ti.min(ti.max(moved_k / doubles[11, n], 0.0), SEEN_KEPT)
                if sweep % PLAIN_EVERY == PLAIN_EVERY - 1:
                    kept = ti.cast(0.0, ti.f64)
                beyond_k = kept / (1.0 - kept) * (middle_k - shift_k)
                next_k = middle_k + beyond_k
                doubles[11, n] = next_k - shift_k
                doubles[10, n] = middle_k
                if apart:
                    next_k = beyond_k
                    doubles[10, n] = 0.0
                doubles[9, n] = next_k
        scale = ti.cast(1.0, ti.f64)
        adds = False
        if ti.static(transient):
            scale = weight
            adds = sweep > 0
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
            if adds:
                value += dc_out[r, n]
            dc_out[r, n] = value
        if not adds or hottest_dc > dc_out[15, n]:
            dc_out[15, n] = hottest_dc
            dc_out[16, n] = hottest_at

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
        sweeps: ti.i32,
        substep_s: ti.f64,
        weight: ti.f64,
        tolerance_k: ti.f64,
        tasks: ints_1d,
        run_start: ints_1d,
        run_ints: ints_2d,
        block_ints: ints_2d,
        chunk_ints: ints_2d,
        dc_ints: ints_2d,
        control: ints_2d,
        weights: reals_1d,
        shares: blocks_1d,
        racks: blocks_2d,
        tables: reals_1d,
        group_load: blocks_1d,
        dcs: reals_2d,
        doubles: doubles_2d,
        units: reals_2d,
        unit_state: doubles_2d,
        rack_state: reals_1d,
        rack_store: blocks_2d,
        server_c: blocks_1d,
        constants: reals_1d,
        rack_out: blocks_2d,
        group_out: blocks_2d,
        needs: doubles_1d,
        sums: doubles_2d,
        dc_out: doubles_2d,
    ):
        n_tasks = tasks.shape[0] - 1
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                first = ti.cast(ti.cast(k // SLICE, ti.i64) * n_tasks // slices, ti.i32)
                last = ti.cast((ti.cast(k // SLICE, ti.i64) + 1) * n_tasks // slices, ti.i32)
                for task in range(first, last):
                    n = chunk_ints[1, tasks[task]]
                    n_parts = dc_ints[0, n + 1] - dc_ints[0, n]
                    # Chunks that are tasks of their own wait for each other after every sweep.
                    rounds = sweeps if tasks[task + 1] - tasks[task] == n_parts else 1
                    for _ in range(rounds):
                        if control[0, n] <= 0:
                            break
                        for chunk in range(tasks[task], tasks[task + 1]):
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
                            cubic = exponent == real(3.0)
                            fan_reference_w = dcs[10, n]
                            full_m3s = dcs[11, n]
                            air = dcs[12, n]
                            per_air = real(1.0) / air
                            limit_c = dcs[13, n]
                            server_j = dcs[15, n]
                            taken_up = dcs[16, n] * air
                            parcel_j = dcs[17, n]
                            step_s = ti.cast(substep_s, real)
                            per_step_s = real(1.0) / step_s
                            # CRAC air of the room stirs the air before racks that stand still.
                            still_per_s = smaller(
                                real(STILL_PER_S),
                                air * ti.cast(doubles[12, n], real) / dcs[17, n],
                            )
                            begins = control[3, n] == 0
                            # What the last sweep left is read anew after it.
                            shift = ti.cast(doubles[9, n], real)
                            side = control[2, n]
                            anew = control[1, n] != 0
                            if anew:
                                side = 1 - side
                            cpu_sum = sums_of_lanes()
                            fan_sum = sums_of_lanes()
                            flow_sum = sums_of_lanes()
                            inlet_sum = sums_of_lanes()
                            outlet_sum = sums_of_lanes()
                            inlet_flow_sum = sums_of_lanes()
                            heat_sum = sums_of_lanes()
                            captured_sum = sums_of_lanes()
                            hot_sum = sums_of_lanes()
                            cold_sum = sums_of_lanes()
                            stored_sum = sums_of_lanes()
                            least = lanes(1e30)
                            most = lanes(-1e30)
                            chunk_hottest = lanes(-1e30)
                            hottest_at = ti.Vector([0] * LANES)
                            for block in range(chunk_ints[0, chunk], chunk_ints[0, chunk + 1]):
                                q = block * LANES
                                many = block_ints[0, block]
                                n_groups = block_ints[1, block]
                                table = block_ints[2, block]
                                place = block_ints[3, block]
                                cover = lanes(0.0)
                                supply = lanes(0.0)
                                mixed = lanes(0.0)
                                share_0 = dc_ints[2, n] + n_units * (
                                    block - chunk_ints[0, dc_ints[0, n]]
                                )
                                parcel_w = lanes(0.0)
                                if ti.static(recirculates):
                                    for j in range(n_units):
                                        ratio = ti.cast(
                                            unit_state[1 if ti.static(advance) else 2, unit_0 + j],
                                            real,
                                        )
                                        air_c = ti.cast(unit_state[0, unit_0 + j], real)
                                        share = shares[share_0 + j]
                                        for i in range(LANES):
                                            part = share[i] * ratio
                                            cover[i] += part
                                            supply[i] += part * air_c
                                    for i in range(LANES):
                                        supply[i] /= larger(cover[i], real(1e-30))
                                    if ti.static(advance):
                                        target = lanes(0.0)
                                        if anew:
                                            from_row = (1 + side) * (rack_store.shape[1] * LANES)
                                            for i in range(LANES):
                                                t = real(0.0)
                                                for run in range(
                                                    run_start[q + i], run_start[q + i + 1]
                                                ):
                                                    x = from_row + run_ints[0, run]
                                                    w = run_ints[2, run]
                                                    s = real(0.0)
                                                    for e in range(run_ints[1, run]):
                                                        s += weights[w + e] * rack_state[x + e]
                                                    t += s
                                                target[i] = t
                                            norm = racks[1, block]
                                            for i in range(LANES):
                                                target[i] *= norm[i]
                                        elif begins:
                                            start_c = ti.cast(doubles[8, n], real)
                                            scale = ti.cast(doubles[5, n], real)
                                            warming = ti.cast(doubles[6, n], real)
                                            strength = racks[5, block]
                                            approach = racks[9, block]
                                            rise = racks[10, block]
                                            mixed_approach = racks[11, block]
                                            mixed_rise = racks[12, block]
                                            seen = lanes(0.0)
                                            for i in range(LANES):
                                                target[i] = (
                                                    start_c
                                                    + scale * mixed_approach[i]
                                                    + warming * mixed_rise[i]
                                                )
                                                seen[i] = strength[i] * (
                                                    start_c
                                                    + scale * approach[i]
                                                    + warming * rise[i]
                                                )
                                            rack_store[1 + side, block] = seen
                                        else:
                                            target = rack_store[4, block]
                                        if anew or begins:
                                            rack_store[4, block] = target
                                        for i in range(LANES):
                                            target[i] += shift
                                        if ti.static(transient):
                                            # The parcel of room air before the rack: enters at the
                                            # mix, leaves at its own temperature.
                                            after = lanes(0.0)
                                            before_c = rack_store[0, block]
                                            taken = rack_store[3, block]
                                            for i in range(LANES):
                                                was = before_c[i]
                                                x = step_s * larger(
                                                    air * taken[i] / parcel_j, still_per_s
                                                )
                                                gone = real(1.0) - exp_of_minus(x, constants)
                                                now_c = was + (target[i] - was) * gone
                                                after[i] = now_c
                                                parcel_w[i] = parcel_j * (now_c - was) * per_step_s
                                                mixed[i] = target[i] + (was - target[i]) * gone / x
                                            rack_store[0, block] = after
                                        else:
                                            rack_store[0, block] = target
                                            for i in range(LANES):
                                                mixed[i] = target[i]
                                    else:
                                        mixed = rack_store[0, block]
                                else:
                                    air_c = ti.cast(unit_state[0, unit_0], real)
                                    approach = racks[0, block]
                                    for i in range(LANES):
                                        mixed[i] = air_c + approach[i]
                                for i in range(LANES):
                                    mixed[i] = ti.select(i < many, mixed[i], real(NO_RACK_C))
                                u = racks[2, block]
                                powered = racks[3, block]
                                air_left = racks[4, block]
                                breath = lanes(0.0)
                                rack_captured = racks[7, block]
                                servers = racks[8, block]
                                spread = lanes(0.0)
                                fresh = lanes(0.0)
                                for i in range(LANES):
                                    spread[i] = u[i] * (real(1.0) - u[i])
                                    breath[i] = air_left[i] * powered[i]
                                    fresh[i] = cover[i] * (supply[i] - mixed[i])
                                cpu = lanes(0.0)
                                fan = lanes(0.0)
                                flow = lanes(0.0)
                                inlet = lanes(0.0)
                                inlet_flow = lanes(0.0)
                                fresh_flow = lanes(0.0)
                                heat = lanes(0.0)
                                hot = lanes(0.0)
                                cold = lanes(0.0)
                                stored = lanes(0.0)
                                hottest = lanes(-1e30)
                                hottest_zone = ti.Vector([0] * LANES)
                                for z in range(n_groups):
                                    row = (table + z) * (6 * LANES)
                                    full_row = row + LANES
                                    idle_row = row + 2 * LANES
                                    offset_row = row + 3 * LANES
                                    deviation_row = row + 4 * LANES
                                    height_row = row + 5 * LANES
                                    given_load = lanes(0.0)
                                    if ti.static(group_loads):
                                        given_load = group_load[place + z]
                                    t = lanes(0.0)
                                    own = lanes(0.0)
                                    speed = lanes(0.0)
                                    cpu_1 = lanes(0.0)
                                    fan_1 = lanes(0.0)
                                    flow_1 = lanes(0.0)
                                    to_air = lanes(0.0)
                                    for i in range(LANES):
                                        if ti.static(recirculates):
                                            own[i] = (
                                                real(1.0)
                                                - rack_captured[i] * tables[height_row + i]
                                            )
                                            t[i] = mixed[i] + own[i] * fresh[i]
                                        else:
                                            t[i] = mixed[i] + tables[offset_row + i]
                                        load = u[i] + tables[deviation_row + i] * spread[i]
                                        if ti.static(group_loads):
                                            load = given_load[i]
                                        on_curve = smaller(t[i], limit_c)
                                        ratio = cpu_slope * on_curve + cpu_offset + cpu_shift * load
                                        cpu_1[i] = powered[i] * larger(
                                            tables[idle_row + i], tables[full_row + i] * ratio
                                        )
                                        y = fan_slope * on_curve + fan_offset + fan_shift * load
                                        y = smaller(larger(y, fan_low), fan_high)
                                        flow_1[i] = full_m3s * y * breath[i]
                                        speed[i] = y * per_reference
                                        cube = speed[i] * speed[i] * speed[i]
                                        fan_1[i] = ti.select(cubic, cube, speed[i])
                                    # A branch on data, not one kernel per exponent: compiled
                                    # apart, they would round apart, and a data center must not
                                    # depend on its batch.
                                    if exponent != real(1.0) and not cubic:
                                        for i in range(LANES):
                                            fan_1[i] = ti.pow(speed[i], exponent)
                                    start_c = lanes(0.0)
                                    end_c = lanes(0.0)
                                    if ti.static(transient):
                                        start_c = server_c[place + z]
                                    for i in range(LANES):
                                        count = tables[row + i]
                                        fan_1[i] *= fan_reference_w * breath[i]
                                        to_air[i] = cpu_1[i]
                                        if ti.static(transient):
                                            before = start_c[i]
                                            exchange = taken_up * flow_1[i]
                                            if ti.static(advance):
                                                steady = t[i] + cpu_1[i] / larger(
                                                    exchange, real(1e-30)
                                                )
                                                left = exp_of_minus(
                                                    step_s * exchange / server_j, constants
                                                )
                                                moves = exchange > real(0.0)
                                                after = ti.select(
                                                    moves, steady + (before - steady) * left, before
                                                )
                                                warmed_w = server_j * (after - before) * per_step_s
                                                to_air[i] = ti.select(
                                                    moves, cpu_1[i] - warmed_w, real(0.0)
                                                )
                                                stored[i] += count * warmed_w
                                                end_c[i] = after
                                            else:
                                                to_air[i] = exchange * (before - t[i])
                                        counted_flow = count * flow_1[i]
                                        cpu[i] += count * cpu_1[i]
                                        fan[i] += count * fan_1[i]
                                        flow[i] += counted_flow
                                        inlet[i] += count * t[i]
                                        inlet_flow[i] += counted_flow * t[i]
                                        heat[i] += count * (to_air[i] + fan_1[i])
                                        if ti.static(recirculates):
                                            fresh_flow[i] += counted_flow * own[i]
                                        hot[i] += count * larger(
                                            t[i] - real(RECOMMENDED_HIGH_C), real(0.0)
                                        )
                                        cold[i] += count * larger(
                                            real(RECOMMENDED_LOW_C) - t[i], real(0.0)
                                        )
                                        here = ti.select(count > real(0.0), t[i], real(-1e30))
                                        hottest_zone[i] = ti.select(
                                            here > hottest[i], z, hottest_zone[i]
                                        )
                                        hottest[i] = larger(here, hottest[i])
                                    if ti.static(transient and advance):
                                        server_c[place + z] = end_c
                                    if ti.static(write_groups):
                                        out = lanes(0.0)
                                        drawn = lanes(0.0)
                                        for i in range(LANES):
                                            out[i] = t[i] + ti.select(
                                                flow_1[i] > real(0.0),
                                                (to_air[i] + fan_1[i])
                                                / larger(air * flow_1[i], real(1e-30)),
                                                real(0.0),
                                            )
                                            drawn[i] = cpu_1[i] + fan_1[i]
                                        group_out[0, place + z] = t
                                        group_out[1, place + z] = out
                                        group_out[2, place + z] = drawn
                                outlet = lanes(0.0)
                                for i in range(LANES):
                                    mean = inlet[i] / servers[i]
                                    moves = flow[i] > real(0.0)
                                    per_flow = real(1.0) / larger(flow[i], real(1e-30))
                                    leaves = (inlet_flow[i] + heat[i] * per_air) * per_flow
                                    if ti.static(outlet_model == 1):
                                        leaves = mean + (cpu[i] + fan[i]) * per_air * per_flow
                                    elif ti.static(outlet_model == 2):
                                        leaves = (
                                            mean
                                            + constants[0]
                                            * ti.pow(cpu[i] + fan[i], constants[1])
                                            / (
                                                constants[2]
                                                * air
                                                * ti.pow(larger(flow[i], real(1e-30)), constants[3])
                                            )
                                            + constants[4]
                                        )
                                    outlet[i] = ti.select(moves, leaves, mean)
                                    inlet[i] = mean
                                    if ti.static(recirculates):
                                        inlet[i] = ti.select(moves, inlet_flow[i] * per_flow, mean)
                                if ti.static(write_groups and outlet_model != 0):
                                    for z in range(n_groups):
                                        group_out[1, place + z] = outlet
                                if ti.static(not write_groups):
                                    if ti.static(recirculates):
                                        captured = lanes(0.0)
                                        seen = lanes(0.0)
                                        strength = racks[5, block]
                                        for i in range(LANES):
                                            captured[i] = flow[i] - cover[i] * fresh_flow[i]
                                            # Of air that failing fans do not move, the mix is left.
                                            gives_c = mixed[i] + air_left[i] * (
                                                outlet[i] - mixed[i]
                                            )
                                            seen[i] = gives_c * strength[i]
                                        if ti.static(advance):
                                            per_strength = racks[6, block]
                                            exchanged = rack_store[1 + side, block]
                                            for i in range(LANES):
                                                change = (seen[i] - exchanged[i]) * per_strength[i]
                                                there = i < many
                                                least[i] = smaller(
                                                    least[i], ti.select(there, change, real(1e30))
                                                )
                                                most[i] = larger(
                                                    most[i], ti.select(there, change, real(-1e30))
                                                )
                                            rack_store[2 - side, block] = seen
                                            rack_store[3, block] = captured
                                        for i in range(LANES):
                                            captured_sum[i] += ti.cast(
                                                captured[i] * mixed[i]
                                                + ti.select(i < many, parcel_w[i], real(0.0))
                                                * per_air,
                                                ti.f64,
                                            )
                                        for j in range(n_units):
                                            share = shares[share_0 + j]
                                            needed = real(0.0)
                                            for i in range(LANES):
                                                needed += share[i] * fresh_flow[i]
                                            needs[need_0 + j] += ti.cast(needed, ti.f64)
                                    for i in range(LANES):
                                        cpu_sum[i] += ti.cast(cpu[i], ti.f64)
                                        fan_sum[i] += ti.cast(fan[i], ti.f64)
                                        flow_sum[i] += ti.cast(flow[i], ti.f64)
                                        inlet_flow_sum[i] += ti.cast(inlet_flow[i], ti.f64)
                                        heat_sum[i] += ti.cast(
                                            inlet_flow[i] + heat[i] * per_air, ti.f64
                                        )
                                    for i in range(LANES):
                                        there = ti.select(i < many, real(1.0), real(0.0))
                                        inlet_sum[i] += ti.cast(there * inlet[i], ti.f64)
                                        outlet_sum[i] += ti.cast(there * outlet[i], ti.f64)
                                        hot_sum[i] += ti.cast(there * hot[i], ti.f64)
                                        cold_sum[i] += ti.cast(there * cold[i], ti.f64)
                                        stored_sum[i] += ti.cast(
                                            there * (stored[i] + parcel_w[i]), ti.f64
                                        )
                                    for i in range(LANES):
                                        here = ti.select(i < many, hottest[i], real(-1e30))
                                        at = (place + hottest_zone[i]) * LANES + i
                                        hottest_at[i] = ti.select(
                                            here > chunk_hottest[i], at, hottest_at[i]
                                        )
                                        chunk_hottest[i] = larger(here, chunk_hottest[i])
                                    if ti.static(transient):
                                        share = ti.cast(weight, real)
                                        for i in range(LANES):
                                            cpu[i] = share * cpu[i]
                                            fan[i] = share * fan[i]
                                            flow[i] = share * flow[i]
                                            inlet[i] = share * inlet[i]
                                            outlet[i] = share * outlet[i]
                                        if not begins:
                                            cpu += rack_out[0, block]
                                            fan += rack_out[1, block]
                                            flow += rack_out[2, block]
                                            inlet += rack_out[3, block]
                                            hottest = larger(hottest, rack_out[4, block])
                                            outlet += rack_out[5, block]
                                    rack_out[0, block] = cpu
                                    rack_out[1, block] = fan
                                    rack_out[2, block] = flow
                                    rack_out[3, block] = inlet
                                    rack_out[4, block] = hottest
                                    rack_out[5, block] = outlet
                            if ti.static(not write_groups):
                                totals = (
                                    cpu_sum,
                                    fan_sum,
                                    flow_sum,
                                    inlet_sum,
                                    outlet_sum,
                                    inlet_flow_sum,
                                    heat_sum,
                                    captured_sum,
                                    hot_sum,
                                    cold_sum,
                                    stored_sum,
                                )
                                for r in ti.static(range(11)):
                                    sums[r, chunk] = total_of(totals[r])
                                least_k = real(1e30)
                                most_k = real(-1e30)
                                for i in range(LANES):
                                    least_k = smaller(least_k, least[i])
                                    most_k = larger(most_k, most[i])
                                chunk_max = chunk_hottest[0]
                                hottest_group = hottest_at[0]
                                for i in range(LANES):
                                    first_of_all = chunk_hottest[i] == chunk_max
                                    first_of_all = first_of_all and hottest_at[i] < hottest_group
                                    if chunk_hottest[i] > chunk_max or first_of_all:
                                        chunk_max = chunk_hottest[i]
                                        hottest_group = hottest_at[i]
                                sums[11, chunk] = ti.cast(chunk_max, ti.f64)
                                sums[12, chunk] = ti.cast(hottest_group, ti.f64)
                                sums[13, chunk] = ti.cast(least_k, ti.f64)
                                sums[14, chunk] = ti.cast(most_k, ti.f64)
                                # The chunk that comes last does what is left for its data center.
                                if ti.atomic_add(control[4, n], 1) == n_parts - 1:
                                    control[4, n] = 0
                                    close(
                                        recirculates,
                                        transient,
                                        advance,
                                        n,
                                        sweeps,
                                        substep_s,
                                        weight,
                                        tolerance_k,
                                        chunk_ints,
                                        dc_ints,
                                        control,
                                        dcs,
                                        doubles,
                                        units,
                                        unit_state,
                                        needs,
                                        sums,
                                        dc_out,
                                    )

    return hall


@cache
def expand_kernel(precision: str) -> Any:
    """Kernel that copies the values of every group to its servers.

    The layers come in twice, by servers and by words of eight bytes: two f32 values are stored at
    once, because the compiler does not join stores to arrays, and single ones reach a third of the
    memory's speed.
    """
    real = _real(precision)
    per_word = 2 if precision == "f32" else 1
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    words_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.func
    @no_type_check
    def word_of(value):
        """The value as often as it fits into a word."""
        word = ti.cast(value, ti.f64)
        if ti.static(per_word == 2):
            bits = ti.cast(ti.bit_cast(value, ti.u32), ti.u64)
            word = ti.bit_cast(bits | (bits << ti.u64(32)), ti.f64)
        return word

    @ti.kernel
    @no_type_check
    def expand(
        slices: ti.i32,
        server_start: ints_1d,
        group_at: ints_1d,
        group_out: reals_2d,
        inlet_c: reals_1d,
        outlet_c: reals_1d,
        power_w: reals_1d,
        inlet_words: words_1d,
        outlet_words: words_1d,
        power_words: words_1d,
    ):
        n_groups = server_start.shape[0] - 1
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                first = ti.cast(ti.cast(k // SLICE, ti.i64) * n_groups // slices, ti.i32)
                last = ti.cast((ti.cast(k // SLICE, ti.i64) + 1) * n_groups // slices, ti.i32)
                for g in range(first, last):
                    at = group_at[g]
                    inlet = group_out[0, at]
                    outlet = group_out[1, at]
                    power = group_out[2, at]
                    start = server_start[g]
                    end = server_start[g + 1]
                    # Whole words between the first and the last multiple of their length.
                    first_word = (start + (per_word - 1)) // per_word
                    last_word = ti.max(end // per_word, first_word)
                    inlets, outlets, powers = word_of(inlet), word_of(outlet), word_of(power)
                    for w in range(first_word, last_word):
                        inlet_words[w] = inlets
                        outlet_words[w] = outlets
                        power_words[w] = powers
                    for s in range(start, ti.min(first_word * per_word, end)):
                        inlet_c[s] = inlet
                        outlet_c[s] = outlet
                        power_w[s] = power
                    for s in range(ti.max(last_word * per_word, start), end):
                        inlet_c[s] = inlet
                        outlet_c[s] = outlet
                        power_w[s] = power

    return expand
