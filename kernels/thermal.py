"""Server temperatures and power over all racks of all data centers.

Servers of a rack that are alike form a group, which is computed once. Halls may have any size: the
racks of a data center are cut into blocks of LANES, filled up with places without a rack, and all
arithmetic is on vectors of the lanes of a block. Blocks whose groups are equal share a table. Every
literal here is exact in binary, so that f64 runs lose nothing to the default f32 literals of the
runtime; in arithmetic with vectors literals must be of their type, since vectors are not cast.

Arrays are two-dimensional with one row per quantity; the row names below are the interface. Sums
run serially over the blocks of a chunk, lane by lane, then over the lanes, and over the chunks of a
data center, so that a data center gives the same bits alone and in any batch.
"""

from functools import cache
from math import factorial
from types import SimpleNamespace
from typing import Any, no_type_check

from .backend import SLICE, larger, smaller, ti
from .elementary import log_and_exp

HALL_TEMPLATES = 4
"""Template arguments of ``hall_kernel``, which come first."""
OUTLETS = ("server", "rack", "released")
OF_DATA_CENTERS, OF_RACKS, OF_GROUPS = range(3)
"""Whose utilisation is given."""

LANES = 8
"""Racks that are computed at a time; the same for all, so that results never depend on it."""
LANE_BITS, SQUARE = LANES.bit_length() - 1, LANES * LANES
SOURCES = 4
"""Racks whose exhausts a vector of weights takes to all lanes of a block, in small halls."""
RUN_LANES = 16
"""Racks whose exhausts a vector of weights takes to one rack, in large halls."""
RUN_BLOCKS = RUN_LANES // LANES
CHUNK_BLOCKS = 16
"""Most blocks of a chunk; fewer racks are not worth a thread of their own."""

BLOCK_INTS = ("racks", "groups", "table", "place")
"""Racks and groups per rack of each block, entry of its tables, and first place of its groups."""
RACK_INTS = ("first_group", "first_server")
"""Of each place; those without a rack, and a closing one, begin where the rack before them ends."""
RUN_INTS = ("first", "length", "offset")
"""Runs of weights in whole vectors of RUN_LANES: first vector of sources, how many, and first of
weights."""
CHUNK_INTS = ("first_block", "dc", "first_need")
DC_INTS = (
    "first_chunk",
    "first_unit",
    "first_share",
    "racks",
    "mix",
    "pattern",
    "start",
    "start_rows",
)
"""``mix``: first of the weights of halls that keep every weight, -1 of others. The last three are
of where the sweeps start: first pattern of the racks, first entry and rows of the table."""
PATTERNS = LANES - 1
"""Patterns of a block of racks; an entry of the table tells how much of each, and ``kept``."""
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
    "per_server",
)
"""``per_server``: 1 over the servers, 0 in places without a rack."""
GROUP_ROWS = ("count", "full_w", "idle_w", "inlet_offset_k", "load_deviation", "height")
"""In places without a rack or group all are those of another one, but ``count`` is 0."""
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
    "utilisation",
    "room_j",
    "room_j_per_k",
    "coil_limit_w",
    "crac_fan_w_per_m3s",
    "it_airflow_m3s",
    "start_low_c",
    "start_per_k",
    "kept",
    "stirring_m3s",
    "shift_k",
    "moved_k",
    "shifted_k",
)
"""Per data center in f64: heat held by the room and what the coil needs in transient runs; lowest
supply air of the table of starts and its rows per K; what sweeps keep of a common deviation; CRAC
air per rack; common shift of the exhaust mixes since the last exchange, and by how much the outlets
and the shift changed in the last sweep."""
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
RACK_STATE = (
    "mixed_c",
    "exhaust_c",
    "exhaust_odd_c",
    "captured_m3s",
    "exchanged_c",
    "given_k",
)
"""Exhaust mix before a rack, what it gives to the mixes times strength at the last exchange and
since in turn, flow that the rack takes of the mix, and the mix at the last exchange. Of halls that
keep every weight in steady air: the mix of the next sweep, and what is exchanged."""
RACK_OUT = ("cpu_w", "fan_w", "airflow_m3s", "inlet_c", "outlet_c", "inlet_max_c")
GROUP_OUT = ("inlet_c", "outlet_c", "power_w")
TERMS = (
    "inlet_m3k_s",
    "outlet_m3k_s",
    "hot_k",
    "cold_k",
    "stored_w",
    "flow_m3s",
    "leaves_m3k_s",
    "given_c",
)
"""Lanes of a chunk while its blocks are computed: sums of what racks do not keep; of the present
sweep airflow, what of the outlets no rack takes in again, and outlets."""
BLOCK_TERMS = ("fresh_m3s", "mixed_c", "parcel_w")
"""Of a block: what its servers would take in of supply air alone; in a substep the recirculated air
that they take in and the heat that warms it."""
SCRATCH = len(TERMS) + CHUNK_BLOCKS * len(BLOCK_TERMS)
SUMS = (
    *RACK_OUT[:-1],
    *TERMS,
    "inlet_max_c",
    "hottest_block",
    "hottest_lane",
    "hottest_zone",
    "least_k",
    "most_k",
)
"""Per chunk: sums over its racks, of transient halls means over the substeps, and over them of the
terms before ``flow_m3s``; hottest group, and the range of what the exhaust changed by since the
last exchange, or of what the mixes change by in the next one."""
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
    "hottest_rack",
    "hottest_server",
)
"""The hottest inlet at the end: rack within its data center and server within its rack, from 0."""

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

FIT_END = 5
"""Of the constants, the first after those of the outlet fit."""
SERIES_TO = 0.25
SERIES_TERMS = {"f32": 6, "f64": 12}
"""Terms of the series of (1 - exp(-x)) / x that give the last digit up to there; an even number."""
MOST_DOUBLINGS = 60
"""Of larger x; what lasts longer is at its end."""


def decay_constants(precision: str) -> list[float]:
    """Series of (1 - exp(-x)) / x, highest power first, for ``hall_kernel``."""
    return [(-1.0) ** k / factorial(k + 1) for k in reversed(range(SERIES_TERMS[precision]))]


def _rows(names: tuple[str, ...]) -> SimpleNamespace:
    return SimpleNamespace(**{name: row for row, name in enumerate(names)})


BLOCK, RACK_INT, RUN = map(_rows, (BLOCK_INTS, RACK_INTS, RUN_INTS))
CHUNK, DC, CTL = map(_rows, (CHUNK_INTS, DC_INTS, CONTROL))
RACK, GROUP, VALUE, EXACT = map(_rows, (RACK_ROWS, GROUP_ROWS, DC_ROWS, DC_DOUBLES))
UNIT, SUPPLY, STATE = map(_rows, (UNIT_ROWS, UNIT_STATE, RACK_STATE))
OUT, PER_GROUP, SUM, TOTAL = map(_rows, (RACK_OUT, GROUP_OUT, SUMS, DC_OUT))
TERM, OF_BLOCK = map(_rows, (TERMS, BLOCK_TERMS))
"""Places of the rows by their names."""


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
    would move no mix by more than ``tolerance_k``, at most ``sweeps`` times.

    Halls that keep every weight exchange after each sweep, which tells exactly what the next would
    move. Their next sweep starts from where the mixes go when the share ``kept`` of what they
    change by comes back from the racks for ever. In larger halls, whose exchange costs
    more than a sweep: the weights of a mix sum to 1, so it moves by no more than the exhausts have
    moved since the last exchange; where all of them moved alike, the mixes are shifted and nothing
    is exchanged.

    Outlets: ``server`` is T + P/(rho*cp*V) per group, ``rack`` the same with the rack's sums, and
    ``released`` the rack fit T + 1.918*P^1.096/(0.526*rho*cp*V^0.824) - 14.01 of the released
    SustainDC, whose constants come in as ``constants``, followed by ``decay_constants``. Its
    exponents are given over 1: P^1.096 / V^0.824 is P/V exp(0.096 log P + 0.176 log V), whose
    exponential is of small numbers and loses no digits.

    ``transient``: a sweep is a substep. Servers follow C dT/dt = P_cpu - eps K (T - T_in); the
    recirculated air before a rack follows its mix with the time constant of its share of the room
    air; before racks that take in none, the CRAC air stirs it. Both by the exact exponential, and
    what leaves is the exact mean, so heat stored plus heat removed is heat generated. Supply air is
    the setpoint plus what the heat kept by the room warms it by; the coil takes what the plant can.

    A data center whose chunks are one task runs all its ``sweeps`` in one call, others one per
    call. ``tasks``: first chunk of each, and the end of the last.

    ``serial``: on the thread that calls; waking others takes longer than the step of a small hall.

    ``step``: 1, which compilers cannot know. Loops that advance by it are compiled as they are;
    others to up to eight copies of their body, which most here gain nothing from and which take
    half of the time to machine code.

    ``write``: instead, compute all groups again as in the last sweep or substep, and store their
    values to their servers, or with ``each_once`` to themselves; ``..._blocks`` are the layers
    again as vectors.
    """
    real = _real(precision)
    series_terms = SERIES_TERMS[precision]
    log_of, exp_of = log_and_exp(precision, LANES)
    n_rows, n_values = len(GROUP_ROWS), len(GROUP_OUT)
    n_terms, n_of_block = len(TERMS), len(BLOCK_TERMS)
    of_racks, of_steps = len(RACK_OUT) - 1, SUM.flow_m3s
    n_sums, n_exact, n_of_dc = len(SUMS), len(DC_DOUBLES), len(DC_ROWS)
    reals_2d = ti.types.ndarray(dtype=real, ndim=2)
    reals_1d = ti.types.ndarray(dtype=real, ndim=1)
    blocks_2d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=2)
    blocks_1d = ti.types.ndarray(dtype=ti.types.vector(LANES, real), ndim=1)
    squares_2d = ti.types.ndarray(dtype=ti.types.vector(SQUARE, real), ndim=2)
    ints_2d = ti.types.ndarray(dtype=ti.i32, ndim=2)
    ints_1d = ti.types.ndarray(dtype=ti.i32, ndim=1)
    doubles_2d = ti.types.ndarray(dtype=ti.f64, ndim=2)
    sources_1d = ti.types.ndarray(dtype=ti.types.vector(SOURCES, real), ndim=1)
    runs_1d = ti.types.ndarray(dtype=ti.types.vector(RUN_LANES, real), ndim=1)
    mix_1d = ti.types.ndarray(dtype=ti.types.vector(SOURCES * LANES, real), ndim=1)
    doubles_1d = ti.types.ndarray(dtype=ti.f64, ndim=1)

    @ti.func
    @no_type_check
    def doublings(most):
        """How often ``most`` is halved to be where the series holds."""
        count = 0
        while most > real(SERIES_TO) and count < MOST_DOUBLINGS:
            most *= real(0.5)
            count += 1
        return count

    @ti.func
    @no_type_check
    def gone_per(y, times, step, constants: ti.template()):
        """(1 - exp(-x)) / y of a vector, where y >= 0 doubled so many times is x.

        By the series of its mean, and doubled again: calls would go lane by lane. To the last
        digits of small x too, whose differences large capacities multiply.
        """
        # Terms in pairs, since each addition waits for the one before.
        square = y * y
        gone = y * constants[FIT_END] + constants[FIT_END + 1]
        for i in ti.static(range(FIT_END + 2, FIT_END + series_terms, 2)):
            gone = gone * square + (y * constants[i] + constants[i + 1])
        time = 0
        while time < times:
            gone *= real(2.0) - y * gone
            time += step
        return gone

    @ti.func
    @no_type_check
    def halved(times, step):
        """0.5 to so many times."""
        x, time = real(1.0), 0
        while time < times:
            x *= real(0.5)
            time += step
        return x

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
    def expect(
        n,
        columns,
        dc_ints: ti.template(),
        doubles: ti.template(),
        unit_state: ti.template(),
        starts: ti.template(),
    ):
        """How much of each pattern to start from, and last ``kept``.

        By the supply air of the first unit, which tells where the others are near enough to start.
        """
        supply_c = unit_state[SUPPLY.supply_c, dc_ints[DC.first_unit, n]]
        rows = dc_ints[DC.start_rows, n]
        y = (supply_c - doubles[n * n_exact + EXACT.start_low_c]) * doubles[
            n * n_exact + EXACT.start_per_k
        ]
        y = ti.min(ti.max(y, 0.0), ti.cast(rows - 1, ti.f64))
        x = ti.min(ti.max(doubles[n * n_exact + EXACT.utilisation], 0.0), 1.0) * ti.cast(
            columns - 1, ti.f64
        )
        row = ti.min(ti.cast(y, ti.i32), rows - 2)
        column = ti.min(ti.cast(x, ti.i32), columns - 2)
        of_rows, of_columns = cubic(y - row), cubic(x - column)
        at = dc_ints[DC.start, n] + row * (columns + 2) + column
        start = ti.Vector([ti.cast(0.0, real)] * LANES)
        for i in ti.static(range(4)):
            for j in ti.static(range(4)):
                start += starts[at + j] * ti.cast(of_rows[i] * of_columns[j], real)
            at += columns + 2
        doubles[n * n_exact + EXACT.kept] = ti.cast(start[PATTERNS], ti.f64)
        return start

    @ti.func
    @no_type_check
    def mixed_from(mix: ti.template(), at, rack_sources: ti.template(), first, count, step):
        """Mixes before the racks of a block, or what they change by, from all racks of the hall."""
        sums = ti.Vector([ti.cast(0.0, real)] * (SOURCES * LANES))
        e = 0
        while e < count:
            x = rack_sources[first + e]
            sums += mix[at + e] * ti.Vector(
                [x[i // LANES] for i in ti.static(range(SOURCES * LANES))]
            )
            e += step
        out = ti.Vector([ti.cast(0.0, real)] * LANES)
        for i in range(LANES):
            for source in ti.static(range(SOURCES)):
                out[i] += sums[source * LANES + i]
        return out

    @ti.func
    @no_type_check
    def exchange_mixes(
        again,
        n,
        chunk,
        step,
        reference_c,
        chunk_ints: ti.template(),
        dc_ints: ti.template(),
        control: ti.template(),
        doubles: ti.template(),
        mix: ti.template(),
        racks: ti.template(),
        rack_sources: ti.template(),
        rack_store: ti.template(),
        sums: ti.template(),
    ):
        """Mixes of a data center of one chunk that keeps every weight, in two passes.

        The first tells what the mixes change by if the racks answer no more. The other lets the
        share ``kept`` of that come back from the racks again and again, now and then not; what
        comes back is exchanged once and taken as alike from then on.
        """
        block_0 = chunk_ints[CHUNK.first_block, chunk]
        block_1 = chunk_ints[CHUNK.first_block, chunk + 1]
        n_sources = (dc_ints[DC.racks, n] + (SOURCES - 1)) // SOURCES
        base = ti.Vector([ti.cast(0.0, real)] * LANES)
        if again == 0:
            base += reference_c
        else:
            kept = ti.min(doubles[n * n_exact + EXACT.kept], EXPECTED_KEPT)
            if control[CTL.sweep, n] % PLAIN_EVERY == 0:
                kept = 0.0
            back = ti.cast(kept / (1.0 - kept), real)
            block = block_0
            while block < block_1:
                move = rack_store[STATE.exchanged_c, block] - rack_store[STATE.mixed_c, block]
                rack_store[STATE.given_k, block] = move * racks[RACK.strength, block] * back
                block += step
        least = ti.Vector([ti.cast(0.0, real)] * LANES)
        most = least
        first = (STATE.given_k * rack_store.shape[1] + block_0) * (LANES // SOURCES)
        block = block_0
        while block < block_1:
            at = dc_ints[DC.mix, n] + (block - block_0) * n_sources
            if again > 0:
                base = rack_store[STATE.exchanged_c, block]
            mixed = base + mixed_from(mix, at, rack_sources, first, n_sources, step)
            rack_store[STATE.exchanged_c, block] = mixed
            move = mixed - rack_store[STATE.mixed_c, block]
            least = smaller(move, least)
            most = larger(move, most)
            block += step
        if again == 0:
            least_k, most_k = real(0.0), real(0.0)
            for i in range(LANES):
                least_k = ti.min(least_k, least[i])
                most_k = ti.max(most_k, most[i])
            sums[chunk * n_sums + SUM.least_k] = ti.cast(least_k, ti.f64)
            sums[chunk * n_sums + SUM.most_k] = ti.cast(most_k, ti.f64)

    @ti.func
    @no_type_check
    def gather(terms: ti.template(), row, value):
        """To the lanes of a chunk; `+=` would be atomic."""
        terms[row] = terms[row] + value

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
    def add_up(
        chunk,
        first_row,
        end_row,
        adds,
        slice_at,
        step,
        chunk_ints: ti.template(),
        terms: ti.template(),
        rack_out: ti.template(),
        sums: ti.template(),
    ):
        """Sums over the racks of a chunk, ``adds`` to those of substeps before."""
        row = first_row
        while row < end_row:
            total = ti.cast(0.0, ti.f64)
            if row < of_racks:
                lanes = ti.Vector([ti.cast(0.0, ti.f64)] * LANES)
                block = chunk_ints[CHUNK.first_block, chunk]
                while block < chunk_ints[CHUNK.first_block, chunk + 1]:
                    value = rack_out[row, block]
                    for i in range(LANES):
                        lanes[i] += ti.cast(value[i], ti.f64)
                    block += step
                total = sum_of(lanes)
            else:
                total = sum_of(terms[slice_at + row - of_racks])
                if adds and row < of_steps:
                    total += sums[chunk * n_sums + row]
            sums[chunk * n_sums + row] = total
            row += step

    @ti.func
    @no_type_check
    def find_hottest(chunk, adds, step, hottest, of_block, of_zone, sums: ti.template()):
        """The first of the racks with the hottest inlet, ``adds`` to those of substeps before."""
        most_c, block, lane, zone = real(-1e30), 0, 0, real(0.0)
        i = 0
        while i < LANES:
            if hottest[i] > most_c or (hottest[i] == most_c and of_block[i] < block):
                most_c, block, lane, zone = hottest[i], of_block[i], i, of_zone[i]
            i += step
        if not adds or ti.cast(most_c, ti.f64) > sums[chunk * n_sums + SUM.inlet_max_c]:
            sums[chunk * n_sums + SUM.inlet_max_c] = ti.cast(most_c, ti.f64)
            sums[chunk * n_sums + SUM.hottest_block] = ti.cast(block, ti.f64)
            sums[chunk * n_sums + SUM.hottest_lane] = ti.cast(lane, ti.f64)
            sums[chunk * n_sums + SUM.hottest_zone] = ti.cast(zone, ti.f64)

    @ti.func
    @no_type_check
    def close(
        recirculates: ti.template(),
        transient: ti.template(),
        n,
        late,
        slice_at,
        step,
        hottest,
        of_block,
        of_zone,
        sweeps,
        substep_s,
        weight,
        tolerance_k,
        block_ints: ti.template(),
        chunk_ints: ti.template(),
        dc_ints: ti.template(),
        control: ti.template(),
        dcs: ti.template(),
        doubles: ti.template(),
        units: ti.template(),
        unit_state: ti.template(),
        counts: ti.template(),
        needs: ti.template(),
        terms: ti.template(),
        rack_out: ti.template(),
        sums: ti.template(),
        dc_out: ti.template(),
    ):
        """CRAC units of a data center, what its next sweep is, and at its end what comes out.

        ``late``: what a sweep does not need is summed up at the end.
        """
        chunk_0 = dc_ints[DC.first_chunk, n]
        # `x = x + y`, since `x += y` would be atomic.
        chunk = chunk_0 + 1
        while chunk < dc_ints[DC.first_chunk, n + 1]:
            r = of_steps
            while r < SUM.inlet_max_c:
                sums[chunk_0 * n_sums + r] = sums[chunk_0 * n_sums + r] + sums[chunk * n_sums + r]
                r += step
            if sums[chunk * n_sums + SUM.inlet_max_c] > sums[chunk_0 * n_sums + SUM.inlet_max_c]:
                sums[chunk_0 * n_sums + SUM.inlet_max_c] = sums[chunk * n_sums + SUM.inlet_max_c]
                sums[chunk_0 * n_sums + SUM.hottest_block] = sums[
                    chunk * n_sums + SUM.hottest_block
                ]
                sums[chunk_0 * n_sums + SUM.hottest_lane] = sums[chunk * n_sums + SUM.hottest_lane]
                sums[chunk_0 * n_sums + SUM.hottest_zone] = sums[chunk * n_sums + SUM.hottest_zone]
            least_k = ti.min(
                sums[chunk_0 * n_sums + SUM.least_k], sums[chunk * n_sums + SUM.least_k]
            )
            most_k = ti.max(sums[chunk_0 * n_sums + SUM.most_k], sums[chunk * n_sums + SUM.most_k])
            sums[chunk_0 * n_sums + SUM.least_k] = least_k
            sums[chunk_0 * n_sums + SUM.most_k] = most_k
            chunk += step
        n_racks = ti.cast(dc_ints[DC.racks, n], ti.f64)
        flow_m3s = sums[chunk_0 * n_sums + SUM.flow_m3s]
        sweep = control[CTL.sweep, n]
        crac_flow = ti.cast(0.0, ti.f64)
        supply_c = unit_state[SUPPLY.supply_c, dc_ints[DC.first_unit, n]]
        passing = ti.cast(0.0, ti.f64)
        return_c = ti.cast(0.0, ti.f64)
        coil_load = ti.cast(0.0, ti.f64)
        coil_w = ti.cast(0.0, ti.f64)
        adds = False
        ends = True
        if ti.static(recirculates):
            least_k, most_k = (
                sums[chunk_0 * n_sums + SUM.least_k],
                sums[chunk_0 * n_sums + SUM.most_k],
            )
            unit_first = dc_ints[DC.first_unit, n]
            following = flow_m3s / doubles[n * n_exact + EXACT.it_airflow_m3s]
            uncovered = ti.cast(0.0, ti.f64)
            supply_flow = ti.cast(0.0, ti.f64)
            # Of units that run, as their fans alone draw power.
            fans_m3s = ti.cast(0.0, ti.f64)
            run_flow = ti.cast(0.0, ti.f64)
            run_supply_flow = ti.cast(0.0, ti.f64)
            fresh_share = ti.cast(dcs[n * n_of_dc + VALUE.fresh_share], ti.f64)
            more = ti.cast(sweep + 1 < sweeps, ti.i32)
            at = unit_first
            while at < dc_ints[DC.first_unit, n + 1]:
                need_at = chunk_ints[CHUNK.first_need, chunk_0] + at - unit_first
                chunk = chunk_0 + 1
                while chunk < dc_ints[DC.first_chunk, n + 1]:
                    other = chunk_ints[CHUNK.first_need, chunk] + at - unit_first
                    needs[need_at] = needs[need_at] + needs[other]
                    chunk += step
                need = needs[need_at]
                low = ti.cast(units[UNIT.low, at], ti.f64)
                high = ti.cast(units[UNIT.high, at], ti.f64)
                design_m3s = ti.cast(units[UNIT.design_m3s, at], ti.f64)
                is_on = ti.cast(units[UNIT.running, at], ti.f64)
                used = unit_state[SUPPLY.fresh_ratio, at]
                gives_c = unit_state[SUPPLY.supply_c, at]
                speed = ti.min(ti.max(following, low), high)
                flow = design_m3s * speed
                crac_flow += flow
                supply_flow += flow * gives_c
                passing += (flow - used * need) * gives_c
                covers = ti.min(1.0, fresh_share * flow / ti.max(need, 1e-30))
                uncovered = ti.max(uncovered, ti.abs(covers - used))
                unit_state[SUPPLY.fresh_ratio, at] = covers
                cubed = speed * speed * speed * is_on
                if ti.static(transient):
                    fans_m3s += cubed * design_m3s
                    run_flow += is_on * flow
                    run_supply_flow += is_on * flow * gives_c
                    if is_on > 0.0:
                        coil_w = ti.cast(1.0, ti.f64)
                    flow *= weight
                    cubed *= weight
                    if sweep > 0:
                        flow += unit_state[SUPPLY.flow_m3s, at]
                        cubed += unit_state[SUPPLY.cubed_speed, at]
                if more == 0:
                    unit_state[SUPPLY.need_m3s, at] = need
                    unit_state[SUPPLY.following, at] = following
                if more == 0 or ti.static(not transient):
                    unit_state[SUPPLY.fresh_ratio_used, at] = used
                unit_state[SUPPLY.flow_m3s, at] = flow
                unit_state[SUPPLY.cubed_speed, at] = cubed
                at += step
            supply_c = supply_flow / crac_flow
            doubles[n * n_exact + EXACT.stirring_m3s] = crac_flow / n_racks
            control[CTL.sweep, n] = sweep + 1
            # All mixes move by the middle of the outlets' changes, give or take half their spread.
            middle_k = 0.5 * (least_k + most_k)
            apart = 0.5 * (most_k - least_k) > ALIKE * tolerance_k
            exchanged = control[CTL.exchange, n] != 0
            if exchanged:
                control[CTL.side, n] = 1 - control[CTL.side, n]
            if ti.static(transient):
                return_c = (sums[chunk_0 * n_sums + SUM.leaves_m3k_s] + passing) / crac_flow
                control[CTL.exchange, n] = ti.cast(apart, ti.i32)
                control[CTL.active, n] = more
                adds = sweep > 0
                ends = more == 0
                air = ti.cast(dcs[n * n_of_dc + VALUE.air_j_per_m3_k], ti.f64)
                fans_w = fans_m3s * doubles[n * n_exact + EXACT.crac_fan_w_per_m3s]
                coil_load = air * (return_c * crac_flow - supply_flow) + fans_w
                running = air * (return_c * run_flow - run_supply_flow) + fans_w
                wanted = ti.max(
                    running + coil_w * doubles[n * n_exact + EXACT.room_j] / substep_s, 0.0
                )
                coil_w = ti.min(wanted, doubles[n * n_exact + EXACT.coil_limit_w])
                held_j = doubles[n * n_exact + EXACT.room_j] + (coil_load - coil_w) * substep_s
                doubles[n * n_exact + EXACT.room_j] = held_j
                warmed_k = held_j / doubles[n * n_exact + EXACT.room_j_per_k]
                at = unit_first
                while at < dc_ints[DC.first_unit, n + 1]:
                    setpoint_c = ti.cast(units[UNIT.setpoint_c, at], ti.f64)
                    unit_state[SUPPLY.supply_c, at] = setpoint_c + warmed_k
                    at += step
                doubles[n * n_exact + EXACT.shift_k] = ti.select(apart, 0.0, middle_k)
            else:
                shift_k = doubles[n * n_exact + EXACT.shift_k]
                left_k = ti.max(most_k - shift_k, shift_k - least_k)
                # The mixes cool or warm by less than what they lie above supply air.
                above_k = ti.abs(sums[chunk_0 * n_sums + SUM.given_c] / n_racks - supply_c)
                left_k = ti.max(left_k, uncovered * above_k)
                control[CTL.active, n] = 0
                if not left_k <= tolerance_k:
                    control[CTL.active, n] = 2 * more - 1
                    ends = more == 0
                if dc_ints[DC.mix, n] < 0:
                    control[CTL.exchange, n] = ti.cast(apart, ti.i32)
                    # Most of what is left is the same for all racks and shrinks by a factor, so a
                    # sweep can go all the way: as expected, or as the last sweep showed, now and
                    # then not.
                    moved_k = middle_k - doubles[n * n_exact + EXACT.moved_k]
                    kept = ti.min(doubles[n * n_exact + EXACT.kept], EXPECTED_KEPT)
                    moved_far = (
                        ti.abs(doubles[n * n_exact + EXACT.shifted_k]) > SEEN_FROM * tolerance_k
                    )
                    if sweep > 0 and not exchanged and moved_far:
                        kept = ti.max(moved_k / doubles[n * n_exact + EXACT.shifted_k], 0.0)
                        kept = ti.min(kept, SEEN_KEPT)
                    if sweep % PLAIN_EVERY == PLAIN_EVERY - 1:
                        kept = 0.0
                    beyond_k = kept / (1.0 - kept) * (middle_k - shift_k)
                    next_k = middle_k + beyond_k
                    doubles[n * n_exact + EXACT.shifted_k] = next_k - shift_k
                    doubles[n * n_exact + EXACT.moved_k] = middle_k
                    if apart:
                        next_k = beyond_k
                        doubles[n * n_exact + EXACT.moved_k] = 0.0
                    doubles[n * n_exact + EXACT.shift_k] = next_k
        if ends:
            if ti.static(not transient):
                if ti.static(recirculates):
                    return_c = (sums[chunk_0 * n_sums + SUM.leaves_m3k_s] + passing) / crac_flow
                if late:
                    add_up(
                        chunk_0,
                        0,
                        of_steps,
                        False,
                        slice_at,
                        step,
                        chunk_ints,
                        terms,
                        rack_out,
                        sums,
                    )
                    find_hottest(chunk_0, False, step, hottest, of_block, of_zone, sums)
            chunk = chunk_0 + 1
            while chunk < dc_ints[DC.first_chunk, n + 1]:
                r = 0
                while r < of_steps:
                    sums[chunk_0 * n_sums + r] = (
                        sums[chunk_0 * n_sums + r] + sums[chunk * n_sums + r]
                    )
                    r += step
                chunk += step
        supplied = flow_m3s * supply_c * weight
        closes = ends
        if ti.static(transient):
            closes = True
        if closes:
            now = ti.Vector([crac_flow, supply_c, return_c, coil_load, coil_w]) * weight
            if adds:
                supplied += dc_out[TOTAL.inlet_m3k_s, n]
            dc_out[TOTAL.inlet_m3k_s, n] = supplied
            for r in ti.static(range(TOTAL.inlet_max_c - TOTAL.crac_flow_m3s)):
                value = now[r]
                if adds:
                    value += dc_out[TOTAL.crac_flow_m3s + r, n]
                dc_out[TOTAL.crac_flow_m3s + r, n] = value
        if ends:
            dc_out[TOTAL.cpu_w, n] = sums[chunk_0 * n_sums + SUM.cpu_w]
            dc_out[TOTAL.fan_w, n] = sums[chunk_0 * n_sums + SUM.fan_w]
            dc_out[TOTAL.airflow_m3s, n] = sums[chunk_0 * n_sums + SUM.airflow_m3s]
            dc_out[TOTAL.inlet_mean_c, n] = sums[chunk_0 * n_sums + SUM.inlet_c] / n_racks
            dc_out[TOTAL.outlet_mean_c, n] = sums[chunk_0 * n_sums + SUM.outlet_c] / n_racks
            dc_out[TOTAL.inlet_m3k_s, n] = (
                sums[chunk_0 * n_sums + SUM.inlet_m3k_s] * weight - supplied
            )
            dc_out[TOTAL.outlet_m3k_s, n] = (
                sums[chunk_0 * n_sums + SUM.outlet_m3k_s] * weight - supplied
            )
            dc_out[TOTAL.hot_k, n] = sums[chunk_0 * n_sums + SUM.hot_k] * weight
            dc_out[TOTAL.cold_k, n] = sums[chunk_0 * n_sums + SUM.cold_k] * weight
            dc_out[TOTAL.stored_w, n] = sums[chunk_0 * n_sums + SUM.stored_w] * weight
            block = ti.cast(sums[chunk_0 * n_sums + SUM.hottest_block], ti.i32)
            zone = ti.cast(sums[chunk_0 * n_sums + SUM.hottest_zone], ti.i32)
            lane = ti.cast(sums[chunk_0 * n_sums + SUM.hottest_lane], ti.i32)
            rack = (block - chunk_ints[CHUNK.first_block, chunk_0]) * LANES + lane
            count_at = block_ints[BLOCK.table, block] * (n_rows * LANES) + lane
            server = ti.cast(0.0, real)
            z = 0
            while z < zone:
                server += counts[count_at + z * (n_rows * LANES)]
                z += 1
            dc_out[TOTAL.inlet_max_c, n] = sums[chunk_0 * n_sums + SUM.inlet_max_c]
            dc_out[TOTAL.hottest_rack, n] = ti.cast(rack, ti.f64)
            dc_out[TOTAL.hottest_server, n] = ti.cast(server, ti.f64)

    @ti.func
    @no_type_check
    def spread(
        each_once,
        block,
        table,
        scratch,
        block_ints: ti.template(),
        counts: ti.template(),
        rack_ints: ti.template(),
        group_values: ti.template(),
        squares: ti.template(),
        values: ti.template(),
        layers: ti.template(),
        layer_blocks: ti.template(),
    ):
        """Values of the groups of a block to their servers, nearly all in whole vectors."""
        apart = values.shape[0] // n_values
        first_row = RACK_INT.first_server
        if each_once != 0:
            first_row = RACK_INT.first_group
        rack_0 = block * LANES
        rack, rack_1 = rack_0, rack_0 + block_ints[BLOCK.racks, block]
        start, end = rack_ints[first_row, rack_0], rack_ints[first_row, rack_1]
        n_groups = rack_ints[RACK_INT.first_group, rack_1] - rack_ints[RACK_INT.first_group, rack_0]
        if end - start == n_groups:
            # Each is a group of its own. Transpose the values of LANES groups at a time, all kinds
            # by turns: halves of a square element by turns, as often as 2 is in LANES. See
            # ``close`` for the loops.
            at = scratch >> LANE_BITS
            while at << LANE_BITS < scratch + block_ints[BLOCK.groups, block]:
                turn = 0
                while turn < LANE_BITS * squares.shape[0]:
                    square = squares[turn % n_values, at]
                    squares[turn % n_values, at] = ti.Vector(
                        [square[i // 2 + i % 2 * (SQUARE // 2)] for i in range(SQUARE)]
                    )
                    turn += 1
                at += 1
            while rack < rack_0 + block_ints[BLOCK.racks, block]:
                row = scratch + rack - rack_0
                end = rack_ints[first_row, rack + 1]
                if start & (LANES - 1) == 0:
                    b = start >> LANE_BITS
                    while b < rack_ints[first_row, rack + 1] >> LANE_BITS:
                        for kind in ti.static(range(n_values)):
                            layer_blocks[kind][b] = group_values[kind, row]
                        row += LANES
                        b += 1
                    start = b << LANE_BITS
                while start < end:
                    at = row << LANE_BITS
                    s = start
                    start = ti.min(start + LANES, end)
                    while s < ti.min(start, rack_ints[first_row, rack + 1]):
                        for kind in ti.static(range(n_values)):
                            layers[kind][s] = values[at + kind * apart]
                        at += 1
                        s += 1
                    row += LANES
                rack += 1
        else:
            numbers = ti.Vector([i for i in range(LANES)])
            # Between these are the vectors that the block has to itself.
            low, high = (start + (LANES - 1)) & -LANES, end & -LANES
            inlets = ti.Vector([ti.cast(0.0, real)] * LANES)
            outlets, powers = inlets, inlets
            while rack < rack_0 + block_ints[BLOCK.racks, block]:
                end = rack_ints[RACK_INT.first_server, rack + 1]
                count_at = table * (n_rows * LANES) + rack - rack_0
                at = (scratch << LANE_BITS) + rack - rack_0
                while start < end:
                    s, b = start, start >> LANE_BITS
                    start += ti.cast(counts[count_at], ti.i32)
                    inlet_c, outlet_c = values[at], values[at + apart]
                    power_w = values[at + 2 * apart]
                    # The vector where a run begins has the ends of those before.
                    before = numbers < (s & (LANES - 1))
                    inlets = ti.select(before, inlets, ti.Vector([inlet_c] * LANES))
                    outlets = ti.select(before, outlets, ti.Vector([outlet_c] * LANES))
                    powers = ti.select(before, powers, ti.Vector([power_w] * LANES))
                    if b < start >> LANE_BITS:
                        if b << LANE_BITS >= low:
                            layer_blocks[0][b] = inlets
                            layer_blocks[1][b] = outlets
                            layer_blocks[2][b] = powers
                        inlets = ti.Vector([inlet_c] * LANES)
                        outlets = ti.Vector([outlet_c] * LANES)
                        powers = ti.Vector([power_w] * LANES)
                        for whole_b in range(b + 1, start >> LANE_BITS):
                            layer_blocks[0][whole_b] = inlets
                            layer_blocks[1][whole_b] = outlets
                            layer_blocks[2][whole_b] = powers
                    if s < low or start > high:
                        if s >= low:
                            s = ti.max(s, high)
                        while s < ti.min(start, rack_ints[RACK_INT.first_server, rack + 1]):
                            layers[0][s] = inlet_c
                            layers[1][s] = outlet_c
                            layers[2][s] = power_w
                            s += 1
                            if s == low:
                                s = ti.max(s, high)
                    count_at += n_rows * LANES
                    at += LANES
                rack += 1

    @ti.func
    @no_type_check
    def run(
        recirculates: ti.template(),
        transient: ti.template(),
        write: ti.template(),
        slice_at,
        first_chunk,
        end_chunk,
        sweeps,
        outlet_model,
        loads_of,
        each_once,
        start_columns,
        step,
        substep_s,
        weight,
        tolerance_k,
        run_start: ti.template(),
        run_ints: ti.template(),
        block_ints: ti.template(),
        rack_ints: ti.template(),
        chunk_ints: ti.template(),
        dc_ints: ti.template(),
        control: ti.template(),
        weights: ti.template(),
        mix: ti.template(),
        shares: ti.template(),
        racks: ti.template(),
        tables: ti.template(),
        group_load: ti.template(),
        dcs: ti.template(),
        doubles: ti.template(),
        units: ti.template(),
        unit_state: ti.template(),
        starts: ti.template(),
        rack_sources: ti.template(),
        run_sources: ti.template(),
        rack_store: ti.template(),
        server_c: ti.template(),
        servers_before: ti.template(),
        servers_after: ti.template(),
        constants: ti.template(),
        terms: ti.template(),
        rack_out: ti.template(),
        needs: ti.template(),
        sums: ti.template(),
        dc_out: ti.template(),
        counts: ti.template(),
        group_values: ti.template(),
        squares: ti.template(),
        values: ti.template(),
        layers: ti.template(),
        layer_blocks: ti.template(),
    ):
        """Sweeps of a data center or chunks of it, or the values of its servers."""
        n = chunk_ints[CHUNK.dc, first_chunk]
        dc_chunk_0 = dc_ints[DC.first_chunk, n]
        n_parts = dc_ints[DC.first_chunk, n + 1] - dc_chunk_0
        dc_block_0 = chunk_ints[CHUNK.first_block, dc_chunk_0]
        # Chunks that are tasks of their own wait for each other after every sweep.
        rounds = sweeps if end_chunk - first_chunk == n_parts else 1
        passes, late = 1, n_parts == 1
        start = ti.Vector([ti.cast(0.0, real)] * LANES)
        if ti.static(recirculates and not transient and not write):
            if dc_ints[DC.mix, n] >= 0:
                passes = 2
            if control[CTL.sweep, n] == 0:
                start = expect(n, start_columns, dc_ints, doubles, unit_state, starts)
        zeros = ti.Vector([ti.cast(0.0, real)] * LANES)
        ones = zeros + real(1.0)
        unit_0 = dc_ints[DC.first_unit, n]
        n_units = dc_ints[DC.first_unit, n + 1] - unit_0
        reference_c = ti.cast(unit_state[SUPPLY.supply_c, unit_0], real)
        utilisation = zeros + ti.cast(doubles[n * n_exact + EXACT.utilisation], real)
        cpu_slope = dcs[n * n_of_dc + VALUE.cpu_slope_per_k]
        cpu_offset = dcs[n * n_of_dc + VALUE.cpu_offset]
        cpu_shift = dcs[n * n_of_dc + VALUE.cpu_shift]
        fan_slope = dcs[n * n_of_dc + VALUE.fan_slope_per_k]
        fan_offset = dcs[n * n_of_dc + VALUE.fan_offset]
        fan_shift = dcs[n * n_of_dc + VALUE.fan_shift]
        fan_low = zeros + dcs[n * n_of_dc + VALUE.fan_low]
        fan_high = zeros + dcs[n * n_of_dc + VALUE.fan_high]
        per_reference = real(1.0) / dcs[n * n_of_dc + VALUE.fan_reference_ratio]
        exponent = dcs[n * n_of_dc + VALUE.fan_exponent]
        # Branches on data, not one kernel per exponent: compiled apart, they would round apart, and
        # a data center must not depend on its batch.
        at_full = per_reference
        if exponent == real(3.0):
            at_full = per_reference * per_reference * per_reference
        elif exponent != real(1.0):
            at_full = ti.pow(per_reference, exponent)
        fan_w = dcs[n * n_of_dc + VALUE.fan_reference_w] * at_full
        full_m3s = dcs[n * n_of_dc + VALUE.fan_full_m3s]
        air = dcs[n * n_of_dc + VALUE.air_j_per_m3_k]
        per_air = real(1.0) / air
        limit_c = zeros + dcs[n * n_of_dc + VALUE.curve_limit_c]
        server_j = dcs[n * n_of_dc + VALUE.server_j_per_k]
        taken_up = dcs[n * n_of_dc + VALUE.effectiveness] * air
        parcel_j = dcs[n * n_of_dc + VALUE.parcel_j_per_k]
        step_s = ti.cast(substep_s, real)
        per_step_s = real(1.0) / step_s
        times, mix_times, k_per_w, mix_scale = 0, 0, step_s / server_j, real(1.0)
        if ti.static(transient and not write):
            times = doublings(dcs[n * n_of_dc + VALUE.fan_high] * full_m3s * taken_up * k_per_w)
            k_per_w *= halved(times, step)
        chunk_hottest = zeros - real(1e30)
        chunk_zone = zeros
        chunk_block = ti.Vector([0] * LANES)
        for _ in range(rounds):
            if ti.static(not write):
                if control[CTL.active, n] <= 0:
                    break
            # CRAC air of the room stirs the air before racks that stand still.
            still_per_s = ti.min(
                real(STILL_PER_S),
                air * ti.cast(doubles[n * n_exact + EXACT.stirring_m3s], real) / parcel_j,
            )
            begins = control[CTL.sweep, n] == 0
            ends = control[CTL.sweep, n] == sweeps - 1
            # What the last sweep left is read anew after it.
            shift = ti.cast(doubles[n * n_exact + EXACT.shift_k], real)
            side = control[CTL.side, n]
            anew = control[CTL.exchange, n] != 0
            if anew:
                side = 1 - side
            for chunk in range(first_chunk, end_chunk):
                least = zeros + real(1e30)
                most = zeros - real(1e30)
                need_0 = chunk_ints[CHUNK.first_need, chunk]
                block_0 = chunk_ints[CHUNK.first_block, chunk]
                n_blocks = chunk_ints[CHUNK.first_block, chunk + 1] - block_0
                if ti.static(not write):
                    # Sums of data centers of one chunk go on over the substeps.
                    goes_on = False
                    if ti.static(transient):
                        goes_on = late and not begins
                    row = slice_at
                    if goes_on:
                        row += of_steps - of_racks
                    else:
                        chunk_hottest = zeros - real(1e30)
                    while row < slice_at + n_terms:
                        terms[row] = zeros
                        row += step
                if ti.static(recirculates and transient and not write):
                    captured = zeros
                    block = block_0
                    while block < block_0 + n_blocks:
                        captured = larger(rack_store[STATE.captured_m3s, block], captured)
                        block += step
                    most_m3s = captured[0]
                    for i in range(1, LANES):
                        most_m3s = ti.select(captured[i] > most_m3s, captured[i], most_m3s)
                    mix_times = doublings(ti.max(most_m3s * (air / parcel_j), still_per_s) * step_s)
                    mix_scale = halved(mix_times, step)
                if ti.static(not write):
                    # First the mixes before all racks, which do not wait for each other.
                    b = 0
                    while b < n_blocks:
                        block = block_0 + b
                        at_block = slice_at + n_terms + b * n_of_block
                        if ti.static(recirculates):
                            target = zeros
                            if anew:
                                at_once = False
                                if ti.static(transient):
                                    if dc_ints[DC.mix, n] >= 0:
                                        at_once = True
                                        n_sources = dc_ints[DC.racks, n] + (SOURCES - 1)
                                        n_sources //= SOURCES
                                        first = (1 + side) * rack_store.shape[1] + dc_block_0
                                        target = mixed_from(
                                            mix,
                                            dc_ints[DC.mix, n] + b * n_sources,
                                            rack_sources,
                                            first * (LANES // SOURCES),
                                            n_sources,
                                            step,
                                        )
                                if not at_once:
                                    from_0 = (1 + side) * rack_store.shape[1] // RUN_BLOCKS
                                    lane = 0
                                    while lane < LANES:
                                        at = block * LANES + lane
                                        parts = ti.Vector([ti.cast(0.0, real)] * RUN_LANES)
                                        run = run_start[at]
                                        while run < run_start[at + 1]:
                                            x = from_0 + run_ints[RUN.first, run]
                                            w = run_ints[RUN.offset, run]
                                            end = w + run_ints[RUN.length, run]
                                            while w < end:
                                                parts += weights[w] * run_sources[x]
                                                w += step
                                                x += step
                                            run += step
                                        t = real(0.0)
                                        for j in range(RUN_LANES):
                                            t += parts[j]
                                        target[lane] = t
                                        lane += step
                                    target *= racks[RACK.norm, block]
                                rack_store[STATE.exchanged_c, block] = target
                            elif begins:
                                pattern = dc_ints[DC.pattern, n]
                                pattern += (block - dc_block_0) * PATTERNS
                                target = zeros + reference_c
                                if passes > 1:
                                    for k in ti.static(range(PATTERNS)):
                                        target += starts[pattern + k] * start[k]
                                else:
                                    gives = target
                                    for k in ti.static(range(2)):
                                        target += starts[pattern + k] * start[k]
                                        gives += starts[pattern + 2 + k] * start[k]
                                    gives *= racks[RACK.strength, block]
                                    rack_store[1 + side, block] = gives
                                    rack_store[STATE.exchanged_c, block] = target
                            else:
                                target = rack_store[STATE.exchanged_c, block]
                            target += shift
                            if ti.static(transient):
                                # The parcel of room air before the rack: enters at the mix,
                                # leaves at its own temperature.
                                was = rack_store[STATE.mixed_c, block]
                                rate = rack_store[STATE.captured_m3s, block] * (air / parcel_j)
                                x = larger(rate, zeros + still_per_s) * (step_s * mix_scale)
                                gone = gone_per(x, mix_times, step, constants)
                                change = (target - was) * (x * gone)
                                per_server = racks[RACK.per_server, block]
                                is_rack = ti.select(per_server > real(0.0), ones, zeros)
                                parcel_w = is_rack * change * (parcel_j * per_step_s)
                                terms[at_block + OF_BLOCK.parcel_w] = parcel_w
                                mixed = target + (was - target) * (gone * mix_scale)
                                terms[at_block + OF_BLOCK.mixed_c] = mixed
                                rack_store[STATE.mixed_c, block] = was + change
                            else:
                                rack_store[STATE.mixed_c, block] = target
                        b += step
                for b in range(n_blocks):
                    block = block_0 + b
                    at_block = slice_at + n_terms + b * n_of_block
                    n_groups = block_ints[BLOCK.groups, block]
                    table = block_ints[BLOCK.table, block]
                    place = block_ints[BLOCK.place, block]
                    share_0 = dc_ints[DC.first_share, n] + n_units * (block - dc_block_0)
                    per_server = racks[RACK.per_server, block]
                    u = utilisation
                    if loads_of == OF_RACKS:
                        u = racks[RACK.load, block]
                    elif loads_of == OF_GROUPS:
                        u = zeros
                    powered = racks[RACK.powered, block]
                    air_left = racks[RACK.airflow, block]
                    breath = air_left * powered
                    uneven = u * (real(1.0) - u)
                    cpu_base, fan_base = u * cpu_shift + cpu_offset, u * fan_shift + fan_offset
                    cover = zeros
                    mixed = zeros
                    fresh = zeros
                    captured_share = zeros
                    parcel_w = zeros
                    if ti.static(recirculates):
                        captured_share = racks[RACK.captured, block]
                        unit = 0
                        while unit < n_units:
                            used = (
                                SUPPLY.fresh_ratio_used if ti.static(write) else SUPPLY.fresh_ratio
                            )
                            ratio = ti.cast(unit_state[used, unit_0 + unit], real)
                            part = shares[share_0 + unit] * ratio
                            cover += part
                            fresh += part * ti.cast(
                                unit_state[SUPPLY.supply_c, unit_0 + unit], real
                            )
                            unit += step
                        mixed = rack_store[STATE.mixed_c, block]
                        if ti.static(transient and not write):
                            mixed = terms[at_block + OF_BLOCK.mixed_c]
                            parcel_w = terms[at_block + OF_BLOCK.parcel_w]
                        fresh = fresh - cover * mixed
                    else:
                        air_c = ti.cast(unit_state[SUPPLY.supply_c, unit_0], real)
                        mixed = racks[RACK.approach_k, block] + air_c
                    # Inlet of a server that takes in no exhaust, and colder by height.
                    least_c = mixed + fresh
                    per_height_k = captured_share * fresh
                    # What all groups of a rack have in common is multiplied with their sums.
                    per_speed_m3s = breath * full_m3s
                    per_speed_w = breath * fan_w
                    # Of servers in a substep: decay per speed, warming per power.
                    per_speed_x = breath * (full_m3s * taken_up * k_per_w)
                    per_draw_k = powered * k_per_w
                    cpu = zeros
                    fan = zeros
                    flow = zeros
                    inlet = zeros
                    inlet_flow = zeros
                    fresh_flow = zeros
                    high_flow = zeros
                    hot = zeros
                    cold = zeros
                    stored = zeros
                    hottest = zeros - real(1e30)
                    zone = zeros
                    this_zone = zeros
                    if ti.static(transient and not write):
                        if begins:
                            for z in range(n_groups):
                                before = zeros
                                for i in range(LANES):
                                    group = rack_ints[RACK_INT.first_group, block * LANES + i] + z
                                    before[i] = servers_before[
                                        ti.min(group, servers_before.shape[0] - 1)
                                    ]
                                server_c[place + z] = before
                    z = 0
                    while z < n_groups:
                        count = tables[table + z, GROUP.count]
                        t = least_c + tables[table + z, GROUP.inlet_offset_k]
                        if ti.static(recirculates):
                            t = least_c - tables[table + z, GROUP.height] * per_height_k
                        # Utilisation over that of the rack, where not given.
                        apart = tables[table + z, GROUP.load_deviation] * uneven
                        if loads_of == OF_GROUPS:
                            for i in range(LANES):
                                group = rack_ints[RACK_INT.first_group, block * LANES + i] + z
                                apart[i] = group_load[ti.min(group, group_load.shape[0] - 1)]
                        on_curve = smaller(t, limit_c)
                        ratio = on_curve * cpu_slope + (apart * cpu_shift + cpu_base)
                        idle = tables[table + z, GROUP.idle_w]
                        draws = larger(idle, tables[table + z, GROUP.full_w] * ratio)
                        y = on_curve * fan_slope + (apart * fan_shift + fan_base)
                        y = smaller(larger(y, fan_low), fan_high)
                        turns = y
                        if exponent == real(3.0):
                            turns = y * y * y
                        elif exponent != real(1.0):
                            turns = y * exp_of(log_of(y) * (exponent - real(1.0)))
                        if ti.static(write):
                            flow_1 = y * per_speed_m3s
                            cpu_1, fan_1 = powered * draws, turns * per_speed_w
                            to_air = cpu_1
                            if ti.static(transient):
                                to_air = flow_1 * taken_up * (server_c[place + z] - t)
                            rise = (to_air + fan_1) / larger(flow_1 * air, zeros + real(1e-30))
                            group_values[PER_GROUP.inlet_c, slice_at + z] = t
                            group_values[PER_GROUP.outlet_c, slice_at + z] = t + rise
                            group_values[PER_GROUP.power_w, slice_at + z] = cpu_1 + fan_1
                            # Read anew for no copies of the loop's body; see ``close``.
                            n_groups = block_ints[BLOCK.groups, block]
                        elif ti.static(transient):
                            # Without air a server keeps what it draws.
                            before = server_c[place + z]
                            x = y * per_speed_x
                            change = draws * per_draw_k - (before - t) * x
                            change *= gone_per(x, times, step, constants)
                            after = before + change
                            stored += count * change
                            server_c[place + z] = after
                            if ends:
                                for i in range(LANES):
                                    if count[i] > real(0.0):
                                        group = (
                                            rack_ints[RACK_INT.first_group, block * LANES + i] + z
                                        )
                                        servers_after[group] = after[i]
                        counted = count * y
                        cpu += count * draws
                        fan += count * turns
                        flow += counted
                        inlet += count * t
                        if ti.static(recirculates):
                            high_flow += counted * tables[table + z, GROUP.height]
                        else:
                            inlet_flow += counted * t
                        if ti.static(not write):
                            hot += count * larger(t - real(RECOMMENDED_HIGH_C), zeros)
                            cold += count * larger(real(RECOMMENDED_LOW_C) - t, zeros)
                            # Groups without servers are as another one of their rack.
                            zone = ti.select(t > hottest, this_zone, zone)
                            hottest = larger(t, hottest)
                            this_zone += real(1.0)
                        z += 1
                    cpu *= powered
                    fan *= per_speed_w
                    flow *= per_speed_m3s
                    if ti.static(recirculates):
                        fresh_flow = flow - captured_share * (high_flow * per_speed_m3s)
                        inlet_flow = mixed * flow + fresh * fresh_flow
                    else:
                        inlet_flow *= per_speed_m3s
                    hottest = ti.select(per_server > real(0.0), hottest, zeros - real(1e30))
                    stored *= server_j * per_step_s
                    heat = cpu + fan - stored
                    mean = inlet * per_server
                    per_flow = real(1.0) / larger(flow, zeros + real(1e-30))
                    outlet = (inlet_flow + heat * per_air) * per_flow
                    if outlet_model != 0:
                        if outlet_model == 1:
                            outlet = mean + (cpu + fan) * per_flow * per_air
                        else:
                            drawn = cpu + fan
                            rest = log_of(drawn) * constants[1] - log_of(flow) * constants[3]
                            fit = drawn * per_flow * exp_of(rest)
                            outlet = mean + fit * (constants[0] / (constants[2] * air))
                            outlet += constants[4]
                    outlet = ti.select(flow > real(0.0), outlet, mean)
                    if ti.static(write):
                        if outlet_model != 0:
                            for i in range(n_groups):
                                group_values[PER_GROUP.outlet_c, slice_at + i] = outlet
                        spread(
                            each_once,
                            block,
                            table,
                            slice_at,
                            block_ints,
                            counts,
                            rack_ints,
                            group_values,
                            squares,
                            values,
                            layers,
                            layer_blocks,
                        )
                    else:
                        outlet_flow = inlet_flow + heat * per_air
                        if ti.static(not recirculates):
                            # Their indices are those of the racks, whatever leaves the servers.
                            inlet_flow = flow * mean
                            outlet_flow = flow * outlet
                        if ti.static(recirculates):
                            mean = ti.select(flow > real(0.0), inlet_flow * per_flow, mean)
                            captured = flow - cover * fresh_flow
                            # Of air that failing fans do not move, the mix is left.
                            seen = mixed + air_left * (outlet - mixed)
                            seen *= racks[RACK.strength, block]
                            rack_store[2 - side, block] = seen
                            rack_store[STATE.captured_m3s, block] = captured
                            if passes > 1:
                                rack_store[STATE.given_k, block] = (
                                    seen - racks[RACK.strength, block] * reference_c
                                )
                            else:
                                change = seen - rack_store[1 + side, block]
                                change *= racks[RACK.per_strength, block]
                                least = smaller(
                                    ti.select(per_server > real(0.0), change, zeros + real(1e30)),
                                    least,
                                )
                                most = larger(
                                    ti.select(per_server > real(0.0), change, zeros - real(1e30)),
                                    most,
                                )
                            leaves = outlet_flow - captured * mixed - parcel_w * per_air
                            gather(terms, slice_at + TERM.leaves_m3k_s, leaves)
                            terms[at_block + OF_BLOCK.fresh_m3s] = fresh_flow
                        gather(terms, slice_at + TERM.inlet_m3k_s, inlet_flow)
                        gather(terms, slice_at + TERM.outlet_m3k_s, outlet_flow)
                        gather(terms, slice_at + TERM.hot_k, hot)
                        gather(terms, slice_at + TERM.cold_k, cold)
                        gather(terms, slice_at + TERM.flow_m3s, flow)
                        if ti.static(transient):
                            gather(terms, slice_at + TERM.stored_w, stored + parcel_w)
                        else:
                            gather(terms, slice_at + TERM.given_c, outlet)
                        chunk_block = ti.select(hottest > chunk_hottest, block, chunk_block)
                        chunk_zone = ti.select(hottest > chunk_hottest, zone, chunk_zone)
                        chunk_hottest = larger(hottest, chunk_hottest)
                        if ti.static(transient):
                            if not begins:
                                cpu += rack_out[OUT.cpu_w, block]
                                fan += rack_out[OUT.fan_w, block]
                                flow += rack_out[OUT.airflow_m3s, block]
                                mean += rack_out[OUT.inlet_c, block]
                                hottest = larger(hottest, rack_out[OUT.inlet_max_c, block])
                                outlet += rack_out[OUT.outlet_c, block]
                            if ends:
                                share = ti.cast(weight, real)
                                cpu *= share
                                fan *= share
                                flow *= share
                                mean *= share
                                outlet *= share
                        rack_out[OUT.cpu_w, block] = cpu
                        rack_out[OUT.fan_w, block] = fan
                        rack_out[OUT.airflow_m3s, block] = flow
                        rack_out[OUT.inlet_c, block] = mean
                        rack_out[OUT.inlet_max_c, block] = hottest
                        rack_out[OUT.outlet_c, block] = outlet
                if ti.static(not write):
                    if ti.static(recirculates):
                        unit = 0
                        while unit < n_units:
                            need, b = zeros, 0
                            while b < n_blocks:
                                at = n_units * (block_0 + b - dc_block_0) + unit
                                share = shares[dc_ints[DC.first_share, n] + at]
                                at = slice_at + n_terms + b * n_of_block
                                need += share * terms[at + OF_BLOCK.fresh_m3s]
                                b += step
                            needs[need_0 + unit] = sum_of(need)
                            unit += step
                    first_row, adds = 0, False
                    if ti.static(transient):
                        adds = not begins and not late
                        if not ends:
                            first_row = of_racks
                            if late:
                                first_row = of_steps
                    elif late:
                        first_row = of_steps
                    add_up(
                        chunk,
                        first_row,
                        SUM.given_c if ti.static(transient) else SUM.inlet_max_c,
                        adds,
                        slice_at,
                        step,
                        chunk_ints,
                        terms,
                        rack_out,
                        sums,
                    )
                    if first_row < of_steps:
                        find_hottest(
                            chunk, adds, step, chunk_hottest, chunk_block, chunk_zone, sums
                        )
                    least_k, most_k = real(1e30), real(-1e30)
                    for i in range(LANES):
                        least_k = ti.select(least[i] < least_k, least[i], least_k)
                        most_k = ti.select(most[i] > most_k, most[i], most_k)
                    sums[chunk * n_sums + SUM.least_k] = ti.cast(least_k, ti.f64)
                    sums[chunk * n_sums + SUM.most_k] = ti.cast(most_k, ti.f64)
                    for again in range(passes):
                        if ti.static(recirculates and not transient):
                            if passes > 1:
                                exchange_mixes(
                                    again,
                                    n,
                                    chunk,
                                    step,
                                    reference_c,
                                    chunk_ints,
                                    dc_ints,
                                    control,
                                    doubles,
                                    mix,
                                    racks,
                                    rack_sources,
                                    rack_store,
                                    sums,
                                )
                        if again > 0:
                            continue
                        # The chunk that comes last does what is left for its data center.
                        if not late:
                            if ti.atomic_add(control[CTL.chunks, n], 1) < n_parts - 1:
                                break
                            control[CTL.chunks, n] = 0
                        close(
                            recirculates,
                            transient,
                            n,
                            late,
                            slice_at,
                            step,
                            chunk_hottest,
                            chunk_block,
                            chunk_zone,
                            sweeps,
                            substep_s,
                            weight,
                            tolerance_k,
                            block_ints,
                            chunk_ints,
                            dc_ints,
                            control,
                            dcs,
                            doubles,
                            units,
                            unit_state,
                            counts,
                            needs,
                            terms,
                            rack_out,
                            sums,
                            dc_out,
                        )
                        if control[CTL.active, n] <= 0:
                            break

    @ti.kernel
    @no_type_check
    def hall(
        recirculates: ti.template(),
        transient: ti.template(),
        write: ti.template(),
        serial: ti.template(),
        slices: ti.i32,
        sweeps: ti.i32,
        outlet_model: ti.i32,
        loads_of: ti.i32,
        each_once: ti.i32,
        start_columns: ti.i32,
        step: ti.i32,
        substep_s: ti.f64,
        weight: ti.f64,
        tolerance_k: ti.f64,
        tasks: ints_1d,
        run_start: ints_1d,
        run_ints: ints_2d,
        block_ints: ints_2d,
        rack_ints: ints_2d,
        chunk_ints: ints_2d,
        dc_ints: ints_2d,
        control: ints_2d,
        weights: runs_1d,
        mix: mix_1d,
        shares: blocks_1d,
        racks: blocks_2d,
        tables: blocks_2d,
        group_load: reals_1d,
        dcs: reals_1d,
        doubles: doubles_1d,
        units: reals_2d,
        unit_state: doubles_2d,
        starts: blocks_1d,
        rack_sources: sources_1d,
        run_sources: runs_1d,
        rack_store: blocks_2d,
        server_c: blocks_1d,
        servers_before: reals_1d,
        servers_after: reals_1d,
        constants: reals_1d,
        terms: blocks_1d,
        rack_out: blocks_2d,
        needs: doubles_1d,
        sums: doubles_1d,
        dc_out: doubles_2d,
        counts: reals_1d,
        group_values: blocks_2d,
        squares: squares_2d,
        values: reals_1d,
        inlet_c: reals_1d,
        outlet_c: reals_1d,
        power_w: reals_1d,
        inlet_blocks: blocks_1d,
        outlet_blocks: blocks_1d,
        power_blocks: blocks_1d,
    ):
        n_tasks = tasks.shape[0] - 1
        if ti.static(serial):
            ti.loop_config(serialize=True)
        for k in range(slices * SLICE):
            if k % SLICE == 0:
                first = ti.cast(ti.cast(k // SLICE, ti.i64) * n_tasks // slices, ti.i32)
                last = ti.cast((ti.cast(k // SLICE, ti.i64) + 1) * n_tasks // slices, ti.i32)
                slice_at = k // SLICE * SCRATCH
                if ti.static(write):
                    slice_at = k // SLICE * (group_values.shape[1] // slices)
                for task in range(first, last):
                    run(
                        recirculates,
                        transient,
                        write,
                        slice_at,
                        tasks[task],
                        tasks[task + 1],
                        sweeps,
                        outlet_model,
                        loads_of,
                        each_once,
                        start_columns,
                        step,
                        substep_s,
                        weight,
                        tolerance_k,
                        run_start,
                        run_ints,
                        block_ints,
                        rack_ints,
                        chunk_ints,
                        dc_ints,
                        control,
                        weights,
                        mix,
                        shares,
                        racks,
                        tables,
                        group_load,
                        dcs,
                        doubles,
                        units,
                        unit_state,
                        starts,
                        rack_sources,
                        run_sources,
                        rack_store,
                        server_c,
                        servers_before,
                        servers_after,
                        constants,
                        terms,
                        rack_out,
                        needs,
                        sums,
                        dc_out,
                        counts,
                        group_values,
                        squares,
                        values,
                        (inlet_c, outlet_c, power_w),
                        (inlet_blocks, outlet_blocks, power_blocks),
                    )

    return hall
