"""Arguments of the two hall kernels: every array by name, with the names of its rows.

Kernel and caller share this spec. ``ARGUMENTS`` says of each argument its type and, for arrays of
named rows, what the rows are and of which items they are values. From it come the parameters of the
kernels, the names by which they are called (``NamedKernel``), the order in which rows are packed
(``in_row_order``), and inside the kernels the attributes ``hall.<argument>`` and
``hall.<items>[i].<row>``, as in ``hall.unit_shares`` and ``hall.dcs[n].fresh_share``.

See README.md in this folder for how halls lie in these arrays. This module imports no Taichi.
"""

from collections.abc import Mapping

from .arguments import Argument

OUTLETS = ("server", "rack", "released")
"""Outlet models (``servers.outlet_model``), in the order of their numbers in ``outlet_model``."""
LOADS_PER_DC, LOADS_PER_RACK, LOADS_PER_GROUP = range(3)
"""Values of ``load_level``: whose utilisation is given."""
RECOMMENDED_C = (18.0, 27.0)
"""Inlets that all classes are recommended (ASHRAE TC 9.9 Thermal Guidelines, 2021), in C; degrees
count beyond them."""

LANES = 8
"""Racks in a block; the same for all halls, so that results never depend on it."""
LANE_BITS = LANES.bit_length() - 1
"""Binary logarithm of LANES."""
DENSE_LANES = 4
"""Racks whose exhausts one vector of weights takes to all lanes of a block, in dense halls."""
RUN_LANES = 16
"""Racks whose exhausts one vector of weights takes to one rack, in sparse halls."""
RUN_BLOCKS = RUN_LANES // LANES
"""Blocks in a vector of RUN_LANES racks."""
CHUNK_BLOCKS = 16
"""Most blocks of a chunk; fewer racks are not worth a thread of their own."""
RANKS_PER_K = 2.0**27
"""Ranks of temperatures in a kelvin, by which the hottest rack is found. In f64 the temperatures of
alike racks differ in their last bits, which depend on the processor; their ranks, 7.5 nK apart,
agree. Numbers in f32 are further apart than ranks."""
MIX_PATTERNS = LANES - 1
"""Patterns of the exhaust mixes in the table of steady states. An entry of the table is one vector:
how much of each pattern, and last the feedback gain."""
EXHAUST_PATTERNS = 2
"""Patterns of the exhausts of sparse halls; their amounts are those of the first mix patterns."""
PATTERNS = MIX_PATTERNS + EXHAUST_PATTERNS
"""Vectors of patterns of each block."""

BLOCK_INTS = {
    "racks": "racks in the block, 1..LANES; the other lanes are padding",
    "groups": "most groups of a rack of the block",
    "first_row": "first entry in group_inputs; equal blocks share their entries",
    "first_place": "first entry in server_c",
    "first_row_along": "first entry in group_inputs whose lanes are groups of one rack (layers)",
}
PLACE_INTS = {
    "first_group": "first server group of the rack",
    "first_server": "first server of the rack",
}
"""Padding, and a closing entry, begin where the rack before them ends."""
RUN_INTS = {
    "first_source": "first vector of RUN_LANES racks whose exhausts count",
    "length": "vectors in the run",
    "first_weight": "first vector in run_weights",
}
CHUNK_INTS = {
    "first_block": "first block of the chunk",
    "dc": "data center",
    "first_need": "first entry in unit_need_m3s, which has one per CRAC unit of the data center",
}
DC_INTS = {
    "first_chunk": "first chunk of the data center",
    "first_unit": "first CRAC unit",
    "first_share": "first entry in unit_shares",
    "racks": "number of racks",
    "first_mix_weight": "first entry in mix_weights of dense halls, -1 of sparse ones",
    "first_pattern": "first entry in steady_states: the patterns of the hall by block",
    "first_steady_state": "first entry in steady_states: the table of amounts of each pattern",
    "supply_rows": "supply temperatures of the table",
}
DC_CONTROL = {
    "status": "RUNNING, DONE or NOT_CONVERGED",
    "exchanges_before": "1 where the next sweep first exchanges the exhausts (sparse or transient)",
    "exhaust_side": "which of exhaust_c (0) and exhaust_odd_c (1) the last exchange read from",
    "sweep": "sweeps or substeps done since the start of the step",
    "chunks_done": "chunks that have done the present sweep",
}
RUNNING, DONE, NOT_CONVERGED = 1, 0, -1
"""Values of ``status``: more sweeps to come, at its end, out of sweeps."""
RACK_INPUTS = {
    "approach_k": "mean inlet over supply air, K (inlet model approach)",
    "norm": "1 over the sum of the weights, each times the strength of its rack (sparse halls)",
    "load": "utilisation while on, 0..1, where given per rack",
    "powered": "share of the step that the rack is on",
    "fan_airflow": "share of their airflow left to the fans of the rack",
    "strength": "how much the exhaust counts: design airflow over the mean of the hall",
    "per_strength": "1 over strength",
    "exhaust_share": "share of exhaust in the intake at the design point, r of docs/hall.md",
    "per_server": "1 over the servers of the rack, 0 in padding",
}
GROUP_INPUTS = {
    "count": "servers of the group, 0 where the rack has no such group",
    "full_w": "power without fans at full load and a power ratio of 1, W per server",
    "idle_w": "lowest power without fans, W per server",
    "inlet_offset_k": "inlet over that of the rack, K (inlet model approach)",
    "load_deviation": "load over that of the rack as a share of u (1 - u), u the rack's load",
    "height_factor": "exhaust share over that of the rack, g of docs/hall.md",
    "full_airflow": "airflow of a server at ratio 1 and an inlet of 0 C, over fan_full_m3s",
    "airflow_fall_per_k": "fall of that with the inlet, by the density of air, 1/K",
    "full_fan_power": "fan power of a server at the reference ratio, over fan_reference_w",
    "heat_capacity": "heat capacity of a server over server_j_per_k, at least full_airflow",
}
"""Where a rack has fewer groups than its block, or in padding, all but ``count`` repeat its last
group, as do loads and server temperatures: no lane computes with numbers out of reach."""
DC_COEFFICIENTS = {
    "cpu_slope_per_k": "power without fans over full power: rise with the inlet, 1/K",
    "cpu_offset": "power ratio at 0 C and no load",
    "cpu_shift": "rise of the power ratio from no to full load",
    "fan_slope_per_k": "airflow over full airflow: rise with the inlet, 1/K",
    "fan_offset": "airflow ratio at 0 C and no load",
    "fan_shift": "rise of the airflow ratio from no to full load",
    "fan_low": "lowest airflow ratio",
    "fan_high": "highest airflow ratio",
    "fan_reference_ratio": "airflow ratio at which fans draw fan_reference_w",
    "fan_exponent": "exponent of fan power over the airflow ratio, 1..3",
    "fan_reference_w": "most fan power of a server at the reference ratio, W",
    "fan_full_m3s": "most airflow of a server at ratio 1, m3/s",
    "air_j_per_m3_k": "heat capacity of air by volume, rho*cp, J/(m3 K)",
    "curve_limit_c": "inlet above which power and airflow no longer rise, C",
    "fresh_share": "supply air that does not bypass the racks at the design point, 1 - b_0",
    "server_j_per_k": "least heat capacity of a server over its full_airflow, J/K (transient)",
    "effectiveness": "share of server over inlet temperature that the air takes up (transient)",
    "parcel_j_per_k": "heat capacity of the room air of a rack, J/K (transient)",
}
DC_DOUBLES = {
    "utilisation": "mean utilisation of the servers, 0..1",
    "room_j": "heat that the room holds over the setpoint, J (transient)",
    "room_j_per_k": "heat capacity of the room, J/K (transient)",
    "coil_limit_w": "heat that the plant can take, W (transient)",
    "crac_fan_w_per_m3s": "CRAC fan power over airflow at full speed, W/(m3/s)",
    "adjusts_supply": "1 where supply air may differ from the setpoint of its unit, see set_supply",
    "return_rise_k": "rise of air from supply to return at the design point, K (return control)",
    "return_gain": "rise of the supply air per K that the air rises less, 0 with supply control",
    "inlet_target_c": "hottest inlet at which fans run at full speed, C; 0 where others lead them",
    "inlet_band_k": "how far below that they run at their lowest speed, K",
    "least_speed": "lowest speed of the fans over full speed",
    "fan_speed": "speed of the fans that follow the hottest inlet, over full speed",
    "table_low_c": "lowest supply air of the table of steady states, C",
    "table_rows_per_k": "supply rows of the table per K",
    "feedback_gain": "share of a common change of the mixes that one sweep gives back to them",
    "crac_m3s_per_rack": "CRAC airflow over the number of racks, m3/s",
    "shift_k": "common shift of the mixes since the last exchange, K (sparse or transient)",
    "last_change_k": "middle of the exhausts' changes since the exchange, one sweep ago, K",
    "last_shift_k": "what the last sweep added to shift_k, K",
}
UNIT_INPUTS = {
    "setpoint_c": "supply setpoint; in steady air with what the room is warmed by, C",
    "low": "lowest fan speed over full speed",
    "high": "highest fan speed over full speed",
    "design_m3s": "airflow at full speed, m3/s",
    "running": "1 for a unit that runs, 0 for one that coasts without cooling",
    "capacity_w": "most heat that the coil takes out, W",
}
UNIT_STATE = {
    "supply_c": "supply air, C",
    "fresh_ratio": "share of the racks' need for its air that the unit covers, f of docs/hall.md",
    "fresh_ratio_used": "fresh_ratio that the last sweep computed the racks with",
    "flow_m3s": "airflow, in transient halls mean over the substeps so far, m3/s",
    "cubed_speed": "cube of the fan speed over full speed, 0 where coasting, mean as flow_m3s",
    "need_m3s": "supply air that the racks ask for, m3/s",
    "following": "fan speed over full speed that would just cover the need",
    "speed": "fan speed over full speed in the present sweep",
    "excess_k": "supply air over setpoint and warmth of the room in the next sweep, K",
    "mean_supply_c": "supply air, in transient halls mean over the substeps so far, C",
}
RACK_STATE = {
    "mixed_c": "exhaust mix before the rack; transient: of the room air that it takes in, C",
    "exhaust_c": "what the rack gives to the mixes, times strength, on side 0, C",
    "exhaust_odd_c": "what the rack gives to the mixes, times strength, on side 1, C",
    "captured_m3s": "airflow that the rack takes of its exhaust mix, m3/s",
    "unshifted_mix_c": "exhaust mix of the next sweep but for the shift of its data center, C",
    "mix_input_k": "what the weights of dense halls are multiplied with, K",
}
RACK_MEANS = {
    "cpu_w": "power without fans, W",
    "fan_w": "power of the server fans, W",
    "airflow_m3s": "airflow, m3/s",
    "inlet_c": "mean inlet, weighted by airflow with recirculation, C",
    "outlet_c": "outlet, C",
}
"""Values of each rack in the last sweep, in transient halls means over the substeps; they are also
summed over the racks."""
RACK_EXTREMES = {
    "inlet_max_c": "hottest inlet of a server, C",
    "outlet_max_c": "hottest outlet of a server, C",
}
"""Extremes of each rack in the last sweep, in transient halls in any substep."""
RACK_OUT = RACK_MEANS | RACK_EXTREMES
"""Results of each rack."""
GROUP_OUT = {
    "inlet_c": "inlet, C",
    "outlet_c": "outlet, C",
    "power_w": "power with fans, W per server",
}
TERMS = {
    "inlet_m3k_s": "airflow times inlet, m3 K/s",
    "outlet_m3k_s": "airflow times outlet, m3 K/s",
    "over_27_sum_k": "sum over the servers of what inlets exceed 27 C by, K",
    "under_18_sum_k": "sum over the servers of what inlets fall short of 18 C by, K",
    "thermal_storage_w": "heat that goes into servers and room air, W",
    "flow_m3s": "airflow in the present sweep, m3/s",
    "return_m3k_s": "airflow times outlet that no rack takes in again in the present sweep, m3 K/s",
    "outlet_sum_c": "sum of the outlets in the present sweep, C",
}
"""Sums over the blocks of a chunk, lane by lane."""
BLOCK_TERMS = {
    "fresh_m3s": "supply air that the servers would take in if units covered all need, m3/s",
    "mixed_c": "mean of the recirculated air over the substep, C (transient)",
    "parcel_w": "heat that warms the recirculated air in the substep, W (transient)",
}
"""Values of each block of a chunk in the present sweep."""
N_TERMS, N_BLOCK_TERMS = len(TERMS), len(BLOCK_TERMS)
SCRATCH = N_TERMS + CHUNK_BLOCKS * N_BLOCK_TERMS
"""Vectors of work space for a chunk: its TERMS, then BLOCK_TERMS block by block."""
SUMS = (
    {name: f"sum over the racks: {text}" for name, text in RACK_MEANS.items()}
    | {name: f"sum over the racks: {text}" for name, text in TERMS.items()}
    | {
        "inlet_max_c": "hottest inlet, C",
        "hottest_block": "block of the rack with the hottest inlet",
        "hottest_lane": "lane of the rack with the hottest inlet",
        "hottest_group": "group with the hottest inlet, from 0 in its rack",
        "present_inlet_max_c": "hottest inlet in the present sweep, C; where fans follow it",
        "least_change_k": "lower bound of the exhaust mixes less unshifted_mix_c, K",
        "most_change_k": "upper bound of the exhaust mixes less unshifted_mix_c, K",
    }
)
"""Sums and extremes of each chunk. In transient halls, sums of TERMS before ``flow_m3s`` run over
the substeps, and sums of RACK_MEANS are of means over the substeps."""
DC_OUT = {
    "cpu_w": "power without fans, W",
    "it_fan_w": "power of the server fans, W",
    "it_airflow_m3s": "airflow of the servers, m3/s",
    "inlet_mean_c": "mean over the racks of their inlets, C",
    "outlet_mean_c": "mean over the racks of their outlets, C",
    "inlet_m3k_s": "sum of airflow times inlet over supply, m3 K/s",
    "outlet_m3k_s": "sum of airflow times outlet over supply, m3 K/s",
    "over_27_sum_k": "sum over the servers of what inlets exceed 27 C by, K",
    "under_18_sum_k": "sum over the servers of what inlets fall short of 18 C by, K",
    "thermal_storage_w": "heat that goes into servers and room air, W",
    "units_flow_m3s": "airflow of the CRAC units, m3/s",
    "supply_c": "supply air, mean over the units by airflow, C",
    "units_return_c": "return air, C",
    "units_load_w": "heat of air and CRAC fans that reaches the units, W (transient)",
    "coil_w": "heat that the coils take out, W (transient)",
    "inlet_max_c": "hottest inlet of a server, C",
    "hottest_rack": "rack with the hottest inlet, from 0 in its data center",
    "hottest_server": "first server of the group with the hottest inlet, from 0 in its rack",
}


def _numbers(kind: str, ndim: int, rows: Mapping[str, str] | None = None, of: str = "") -> Argument:
    return Argument(kind, ndim, rows=rows or {}, of=of)


def _vectors(
    ndim: int, rows: Mapping[str, str] | None = None, of: str = "", lanes: int = LANES
) -> Argument:
    return Argument("real", ndim, lanes, rows or {}, of)


ARGUMENTS = {
    # How the kernel runs.
    "recirculates": Argument("template"),  # whether racks take in exhaust air
    "transient": Argument("template"),  # whether a sweep is a substep
    "serial": Argument("template"),  # on the calling thread alone
    "slices": Argument("i32"),  # parts that threads take on
    "one": Argument("i32"),  # 1, see "Loops of step 1" in README.md
    "sweeps": Argument("i32"),  # most sweeps, or number of substeps
    "outlet_model": Argument("i32"),  # place in OUTLETS
    "load_level": Argument("i32"),  # LOADS_PER_DC, LOADS_PER_RACK or LOADS_PER_GROUP
    "load_columns": Argument("i32"),  # loads of the table of steady states
    "per_group": Argument("i32"),  # 1 for layers of one server per group
    "substep_s": Argument("f64"),
    "weight": Argument("f64"),  # of a sweep in the results: 1 over the number of substeps
    "tolerance_k": Argument("f64"),  # how little another sweep would move any mix
    # Where the items are.
    "task_offsets": _numbers("i32", 1),  # first chunk of each task, and the end of the last
    "dc_ints": _numbers("i32", 2, DC_INTS, "dcs"),
    "chunk_ints": _numbers("i32", 2, CHUNK_INTS, "chunks"),
    "block_ints": _numbers("i32", 2, BLOCK_INTS, "blocks"),
    "place_ints": _numbers("i32", 2, PLACE_INTS, "places"),
    "run_offsets": _numbers("i32", 1),  # first run of weights of each place, and the end
    "run_ints": _numbers("i32", 2, RUN_INTS, "runs"),
    # Halls, and their boundary conditions.
    "dc_coefficients": _numbers("real", 1, DC_COEFFICIENTS, "dcs"),
    "rack_inputs": _vectors(2, RACK_INPUTS, "blocks"),
    "group_inputs": _vectors(1, GROUP_INPUTS, "groups"),
    "unit_inputs": _numbers("real", 2, UNIT_INPUTS, "units"),
    "group_load": _numbers("real", 1),  # utilisation of each group, where given
    "unit_shares": _vectors(1),  # share of each unit in the supply of a block, s of docs/hall.md
    "mix_weights": _vectors(1, lanes=DENSE_LANES * LANES),  # of dense halls
    "run_weights": _vectors(1, lanes=RUN_LANES),  # of sparse halls
    "steady_states": _vectors(1),  # patterns of each hall, and its table
    # State that is carried from sweep to sweep.
    "dc_control": _numbers("i32", 2, DC_CONTROL, "dcs"),
    "dc_doubles": _numbers("f64", 2, DC_DOUBLES, "dcs"),
    "unit_state": _numbers("f64", 2, UNIT_STATE, "units"),
    "rack_state": _vectors(2, RACK_STATE, "blocks"),
    "rack_state_by_4": _vectors(1, lanes=DENSE_LANES),  # rack_state again, in other vectors
    "rack_state_by_16": _vectors(1, lanes=RUN_LANES),  # rack_state again, in other vectors
    "server_c": _vectors(1),  # of transient halls, by block and group
    "server_c_before": _numbers("real", 1),  # of each group at the start of the step
    "server_c_after": _numbers("real", 1),  # of each group at its end
    # Work space.
    "scratch": _vectors(1),
    "unit_need_m3s": _numbers("f64", 1),  # supply air that a chunk asks of each unit
    "chunk_sums": _numbers("f64", 1, SUMS, "chunks"),
    "group_values": _vectors(2, GROUP_OUT, "values"),
    # Results.
    "rack_out": _vectors(2, RACK_OUT, "blocks"),
    "dc_out": _numbers("f64", 2, DC_OUT, "dcs"),
    "inlet_c": _numbers("real", 1),  # of each server
    "outlet_c": _numbers("real", 1),
    "power_w": _numbers("real", 1),
    "inlet_vectors": _vectors(1),  # inlet_c again, in vectors
    "outlet_vectors": _vectors(1),
    "power_vectors": _vectors(1),
}
"""Arguments of both kernels by name, those that are templates first."""

_LAYERS_ALONE = (
    *("per_group", "group_values", "inlet_c", "outlet_c", "power_w"),
    *("inlet_vectors", "outlet_vectors", "power_vectors"),
)
_STEP_ALONE = (
    *("sweeps", "load_columns", "substep_s", "weight", "tolerance_k", "task_offsets"),
    *("run_offsets", "run_ints", "unit_inputs", "mix_weights", "run_weights", "steady_states"),
    *("dc_control", "rack_state_by_4", "rack_state_by_16", "server_c_before", "server_c_after"),
    *("scratch", "unit_need_m3s", "chunk_sums", "dc_out"),
)
STEP_ARGUMENTS = {name: ARGUMENTS[name] for name in ARGUMENTS if name not in _LAYERS_ALONE}
"""Arguments of the kernel of a step (hall.py)."""
LAYERS_ARGUMENTS = {name: ARGUMENTS[name] for name in ARGUMENTS if name not in _STEP_ALONE}
"""Arguments of the kernel of per-server values (layers.py)."""
