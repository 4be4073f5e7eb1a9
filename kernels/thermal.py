"""Tables of the thermal kernels: names of their rows, and how halls lie in them.

``hall.py`` computes server temperatures and power of a step over all racks of all data centers,
``layers.py`` their values server by server.

Servers of a rack that are alike form a group, which is computed once. Halls may have any size: the
racks of a data center are cut into blocks of LANES, filled up with places without a rack, and all
arithmetic is on vectors of the lanes of a block. Blocks whose groups are equal share a table.
Literals in the kernels are exact in binary, or bounds out of reach, so that f64 runs lose nothing
to the default f32 literals of the runtime; in arithmetic with vectors literals must be of their
type, since vectors are not cast.

Sums run serially over the blocks of a chunk, lane by lane, then over the lanes, and over the chunks
of a data center, so that a data center gives the same bits alone and in any batch.

The functions of a kernel take as ``hall`` what they share: modes, numbers and arrays. Rows are read
and assigned by the names below, as in ``hall.dcs[n].kept``; ``dcs``, ``units``, ``chunks``,
``blocks`` (vectors of racks), ``places`` (of racks) and ``groups`` each join all tables of such
items. Arguments that are templates are handed on as they are and may be changed.
"""

from types import SimpleNamespace

OUTLETS = ("server", "rack", "released")
OF_DATA_CENTERS, OF_RACKS, OF_GROUPS = range(3)
"""Whose utilisation is given."""

LANES = 8
"""Racks that are computed at a time; the same for all, so that results never depend on it."""
LANE_BITS = LANES.bit_length() - 1
SOURCES = 4
"""Racks whose exhausts a vector of weights takes to all lanes of a block, in small halls."""
RUN_LANES = 16
"""Racks whose exhausts a vector of weights takes to one rack, in large halls."""
RUN_BLOCKS = RUN_LANES // LANES
CHUNK_BLOCKS = 16
"""Most blocks of a chunk; fewer racks are not worth a thread of their own."""

BLOCK_INTS = ("racks", "groups", "table", "place", "along")
"""Racks and groups per rack of each block, entry of its table, first place of its groups, and entry
of its table for layers, whose lanes are groups of one rack."""
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
    "captured_share",
    "per_server",
)
"""``norm``: 1 over the sum of the weights, each times the strength of its rack; ``airflow``,
``powered``: what is left of fans and of the step; ``strength``: how much the exhaust of a rack
counts; ``captured_share``: of exhaust in the intake at the design point; ``per_server``: 1 over the
servers, 0 in places without a rack."""
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
    "design_it_airflow_m3s",
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
    "over_27_sum_k",
    "under_18_sum_k",
    "thermal_storage_w",
    "flow_m3s",
    "leaves_m3k_s",
    "given_c",
)
"""Lanes of a chunk while its blocks are computed: sums of what racks do not keep; of the present
sweep airflow, what of the outlets no rack takes in again, and outlets."""
BLOCK_TERMS = ("fresh_m3s", "mixed_c", "parcel_w")
"""Of a block: what its servers would take in of supply air alone; in a substep the recirculated air
that they take in and the heat that warms it."""
N_TERMS, N_BLOCK_TERMS = len(TERMS), len(BLOCK_TERMS)
SCRATCH = N_TERMS + CHUNK_BLOCKS * N_BLOCK_TERMS
"""Vectors of a chunk, those of its blocks behind its own."""
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
    "it_fan_w",
    "it_airflow_m3s",
    "inlet_mean_c",
    "outlet_mean_c",
    "inlet_m3k_s",
    "outlet_m3k_s",
    "over_27_sum_k",
    "under_18_sum_k",
    "thermal_storage_w",
    "crac_flow_m3s",
    "supply_c",
    "return_c",
    "cooling_load_w",
    "coil_w",
    "inlet_max_c",
    "hottest_rack",
    "hottest_server",
)
"""The hottest inlet at the end: rack within its data center and server within its rack, from 0."""


RECOMMENDED_C = (18.0, 27.0)
"""Inlets that all classes are recommended (ASHRAE TC 9.9 Thermal Guidelines, 2021), beyond which
degrees count."""


def _rows(names: tuple[str, ...]) -> SimpleNamespace:
    return SimpleNamespace(**{name: row for row, name in enumerate(names)})


SUM, STATE, SUPPLY, RACK_INT = map(_rows, (SUMS, RACK_STATE, UNIT_STATE, RACK_INTS))
"""Places of rows that are not always told by their names alone."""
