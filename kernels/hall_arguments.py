"""Arguments of the two hall kernels: every array by name, with the names of its rows.

Kernel and caller share this spec. ``ARGUMENTS`` gives the type of each argument and, for arrays
with named rows, the meaning of the rows and the items to which they belong. The spec determines the
parameters of the kernels, the names in calls (``NamedKernel``) and the order in which rows are
packed (``in_row_order``). Inside the kernels it determines the attributes ``hall.<argument>`` and
``hall.<items>[i].<row>``, such as ``hall.unit_shares`` and ``hall.dcs[n].fresh_share``.

README.md in this folder explains the layout of halls in these arrays. This module does not import
Taichi.
"""

from collections.abc import Mapping

from .arguments import Argument

OUTLETS = ("server", "rack", "released")
"""Outlet models (``servers.outlet_model``); their indices are the values of ``outlet_model``."""
LOADS_PER_DC, LOADS_PER_RACK, LOADS_PER_GROUP = range(3)
"""Values of ``load_level``: utilisation is given per data center, per rack or per group."""
RECOMMENDED_C = (18.0, 27.0)
"""Recommended inlet range of all equipment classes, in C (ASHRAE TC 9.9 Thermal Guidelines, 2021);
kernels sum the degrees by which inlets are outside this range."""

LANES = 8
"""Racks in a block. All halls share this number, so that results never depend on it."""
LANE_BITS = LANES.bit_length() - 1
"""Binary logarithm of LANES."""
DENSE_LANES = 4
"""Source racks in one vector of weights of dense halls; it serves all lanes of a block."""
SPARSE_LANES = 16
"""Source racks in one vector of weights of sparse halls; it serves all lanes of a block."""
SPARSE_BLOCKS = SPARSE_LANES // LANES
"""Blocks per vector of SPARSE_LANES racks."""
CHUNK_BLOCKS = 16
"""Maximum number of blocks in a chunk; fewer racks do not justify a thread."""
RANKS_PER_K = 2.0**27
"""Ranks per kelvin; ranks are rounded temperatures that identify the hottest rack. In f64 the
temperatures of equal racks differ in their last bits, depending on the processor. Their ranks,
7.5 nK apart, are equal. Adjacent numbers in f32 are further apart than ranks."""
COVERED_WITHIN = 1e-6
"""Share of their need that units may seem to lack, or to exceed, although they just cover it. At
the design point units deliver just what racks need."""
MOST_SUPPLY_RATIO = 10.0
"""Largest ratio of supply to need that lowers exhaust shares further."""
MIX_PATTERNS = LANES - 1
"""Number of exhaust mix patterns in the table of steady states of a dense hall. An entry of the
table is a vector of the amount of each pattern, followed by the feedback gain."""
MODE_VECTORS = 3
"""Largest number of vectors of LANES modes of a sparse hall."""

BLOCK_INTS = {
    "racks": "racks in the block, 1..LANES; the other lanes are padding",
    "groups": "largest number of groups of a rack in the block",
    "first_row": "first entry in group_inputs; equal blocks share their entries",
    "first_place": "first entry in server_c",
    "first_row_along": "first entry in group_inputs whose lanes are groups of one rack (layers)",
}
PLACE_INTS = {
    "first_group": "first server group of the rack",
    "first_server": "first server of the rack",
}
"""Padding, and the closing entry, point to the end of the last rack before them."""
SOURCE_INTS = {
    "vector": "vector of SPARSE_LANES racks whose exhausts reach a block of a sparse hall",
    "weights": "entry in sparse_weights",
}
CHUNK_INTS = {
    "first_block": "first block of the chunk",
    "dc": "data center",
    "first_need": "first entry in unit_need_m3s, with one entry per CRAC unit",
}
DC_INTS = {
    "first_chunk": "first chunk of the data center",
    "first_unit": "first CRAC unit",
    "first_share": "first entry in unit_shares",
    "racks": "number of racks",
    "first_mix_weight": "first entry in mix_weights of dense halls, -1 for sparse halls",
    "first_pattern": "first entry in steady_states of the patterns or modes of the hall, by block",
    "first_steady_state": "first entry in steady_states of the table of pattern amounts (dense "
    "halls), or of the amounts of the modes per kelvin of each sampled rack (sparse halls)",
    "supply_rows": "number of supply temperatures in the table (dense halls)",
    "heat_levels": "number of tables, one for each power of liquid_heat (dense halls)",
    "modes": "number of modes, and of sampled racks (sparse halls)",
    "first_sample": "first entry in sample_outlet_c (sparse halls)",
}
KNEES = {
    "inlet_c": "inlet above which the slope is another, C",
    "slope_per_k": "change of the slope at no load, 1/K",
    "shift_per_k": "increase of this change from no load to full load, 1/K",
}
"""Knees of the curves of the servers, see ``sdc_taichi/plant/servers.py``."""
DC_CONTROL = {
    "status": "RUNNING, DONE or NOT_CONVERGED",
    "exchanges_before": "1 if the next sweep starts with an exchange (sparse or transient)",
    "exhaust_side": "array that the last exchange read: exhaust_c (0) or exhaust_odd_c (1)",
    "sweep": "number of sweeps or substeps since the start of the step",
    "elapsed": "time since the start of the step divided by substep_s (transient)",
    "length": "length of the present substep divided by substep_s (transient)",
    "chunks_done": "number of chunks that have finished the present sweep",
}
RUNNING, DONE, NOT_CONVERGED = 1, 0, -1
"""Values of ``status``: more sweeps follow, finished, or not converged within ``sweeps``."""
RACK_INPUTS = {
    "approach_k": "mean inlet minus supply air, K (inlet model approach)",
    "norm": "reciprocal of the sum of weight times source strength (sparse halls)",
    "load": "utilisation while on, 0..1, if given per rack",
    "powered": "share of the step in which the rack is on",
    "fan_airflow": "remaining airflow of the rack's fans, as a share of normal airflow",
    "strength": "weight of the exhaust: design airflow divided by the hall's mean",
    "per_strength": "reciprocal of strength",
    "exhaust_share": "share of exhaust in the intake at the design point, r of docs/hall.md",
    "present_exhaust_share": "exhaust_share at the present excess of supply (if units exceed)",
    "per_server": "reciprocal of the rack's number of servers, 0 in padding",
    "heat_w": "heat of a server without fans, if given per rack, else 0; W (liquid-cooled racks)",
}
GROUP_INPUTS = {
    "count": "number of servers in the group, 0 if the rack has no such group",
    "full_w": "power without fans at full load and a power ratio of 1, W per server",
    "idle_w": "lowest power without fans, W per server",
    "inlet_offset_k": "inlet minus the rack's inlet, K (inlet model approach)",
    "load_deviation": "load minus the rack's load u, divided by u (1 - u)",
    "height_factor": "exhaust share divided by the rack's, g of docs/hall.md",
    "full_airflow": "server airflow at ratio 1 and 0 C inlet, divided by fan_full_m3s",
    "airflow_fall_per_k": "decrease of full_airflow per K of inlet (air density), 1/K",
    "full_fan_power": "server fan power at the reference ratio / fan_reference_w",
    "heat_capacity": "server heat capacity / server_j_per_k, at least full_airflow",
}
"""For a rack with fewer groups than its block, and in padding, all rows but ``count`` repeat the
rack's last group, as do loads and server temperatures. All lanes then have valid numbers."""
DC_COEFFICIENTS = {
    "cpu_slope_per_k": "rise of the power ratio (power without fans / full power) per K of inlet",
    "cpu_offset": "power ratio at 0 C and no load",
    "cpu_shift": "rise of the power ratio from zero to full load",
    "fan_slope_per_k": "rise of the airflow ratio (airflow / full airflow) per K of inlet",
    "fan_offset": "airflow ratio at 0 C and no load",
    "fan_shift": "rise of the airflow ratio from zero to full load",
    "fan_low": "lowest airflow ratio",
    "fan_high": "highest airflow ratio",
    "fan_reference_ratio": "airflow ratio at which fans draw fan_reference_w",
    "fan_exponent": "exponent of the airflow ratio in the fan power, 1..3",
    "fan_reference_w": "largest fan power of any server at the reference ratio, W",
    "fan_full_m3s": "largest airflow of any server at ratio 1, m3/s",
    "air_j_per_m3_k": "volumetric heat capacity of air, rho*cp, J/(m3 K)",
    "curve_limit_c": "inlet above which power and airflow no longer rise, C",
    "fresh_share": "share of supply air through the racks at the design point, 1 - b_0",
    "server_j_per_k": "minimum of server heat capacity / full_airflow, J/K (transient)",
    "effectiveness": "share of server minus inlet temperature taken up by the air (transient)",
    "parcel_j_per_k": "heat capacity of the room air per rack, J/K (transient)",
}
DC_DOUBLES = {
    "utilisation": "mean utilisation of the servers, 0..1",
    "room_j": "heat stored in the room relative to the setpoint, J (transient)",
    "room_j_per_k": "heat capacity of the room, J/K (transient)",
    "coil_limit_w": "heat that the plant can remove with water at its setpoint and no heat at the "
    "coils, W (transient)",
    "limit_w_per_k": "growth of that heat with the warmth of the water, W/K (transient)",
    "limit_w_per_w": "growth of that heat with the heat at the coils, W/W (transient)",
    "carried_w": "heat that coils and chilled-water pumps can carry, W (transient)",
    "water_j": "heat stored in the chilled water relative to the setpoint, J (transient)",
    "water_j_per_k": "heat capacity of the chilled water, with a mixed tank, J/K (transient)",
    "tank_j": "heat stored in a stratified tank, J (transient)",
    "tank_most_j": "heat that a stratified tank can store, J (transient)",
    "tank_share": "available share of a stratified tank, 0..1 (transient)",
    "crac_fan_w_per_m3s": "CRAC fan power divided by airflow, at full speed, W/(m3/s)",
    "adjusts_supply": "1 if supply air may differ from the unit's setpoint, see set_supply",
    "return_rise_k": "air warming from supply to return at the design point, K (return control)",
    "return_gain": "rise of supply air per K of missing air rise, 0 with supply control",
    "inlet_target_c": "hottest inlet with full fan speed, C; 0 if fans do not follow inlets",
    "inlet_band_k": "distance below inlet_target_c at which fans run at lowest speed, K",
    "least_speed": "lowest fan speed / full speed",
    "fan_speed": "speed of fans that follow the hottest inlet / full speed",
    "table_low_c": "lowest supply temperature in the table of steady states, C",
    "table_rows_per_k": "rows of the table per K of supply temperature",
    "liquid_heat": "heat of liquid-cooled racks into the air divided by that at full load",
    "feedback_gain": "change of the mixes by a sweep per previous common change",
    "crac_m3s_per_rack": "CRAC airflow divided by the number of racks, m3/s",
    "coupling": "exponent of the weights of the units in their shares, 0 for shares that are fixed",
    "follows_need": "1 if fans deliver what racks need, 0 if their speed is given",
    "weighs": "1 if the weight of a unit differs from 1 in the next sweep",
    "shares_due": "1 if strengths have changed since unit_shares were set",
    "oversupply": "decay of the exhaust shares per excess of supply over need",
    "own_return": "1 if each unit draws its own return air, 0 if all draw that of the hall",
    "exceeds": "1 if a unit delivers more than its racks need, and thus lowers exhaust shares",
    "exceeds_used": "value of exceeds in the last sweep",
    "shift_k": "common shift of the mixes since the last exchange, K (sparse or transient)",
    "last_change_k": "midpoint of exhaust changes since the exchange, one sweep ago, K",
    "last_shift_k": "change of shift_k in the last sweep, K",
    "return_c": "return air of the last sweep, C",
    "most_change_k": "largest change of the air in a substep so far, see change_of_air, K "
    "(transient)",
}
UNIT_INPUTS = {
    "setpoint_c": "supply setpoint, in steady air including the warmth of the room, C",
    "low": "lowest fan speed / full speed",
    "high": "highest fan speed / full speed",
    "design_m3s": "airflow at full speed, m3/s",
    "running": "1 if the unit runs, 0 if it coasts without cooling",
    "capacity_w": "maximum heat that the coil removes, W",
    "casing_m3": "air in coil and casing, m3 (transient)",
}
UNIT_STATE = {
    "supply_c": "supply air, C",
    "fresh_ratio": "share of the racks' need that the unit covers, f of docs/hall.md",
    "fresh_ratio_used": "fresh_ratio with which the last sweep computed the racks",
    "flow_m3s": "airflow, in transient halls the mean of the substeps so far, m3/s",
    "cubed_speed": "cube of fan speed / full speed, 0 if coasting, mean as for flow_m3s",
    "need_m3s": "supply air that the racks demand, m3/s",
    "following": "fan speed / full speed that would just cover the need",
    "speed": "fan speed / full speed in the present sweep",
    "excess_k": "next sweep's air behind the coil, if the unit runs, minus setpoint and warmth of "
    "the room, K",
    "coil_c": "next sweep's air behind the coil, C (transient)",
    "coil_change_k": "change of coil_c after the substep, K (transient)",
    "casing_c": "air in the casing at the start of the substep, C (transient)",
    "casing_change_k": "change of casing_c in the substep, K (transient)",
    "mean_supply_c": "supply air, in transient halls the mean of the substeps so far, C",
    "last_f_change": "change of fresh_ratio in the sweep before (steady air)",
    "last_supply_change_k": "change of supply air in the sweep before, K (steady air)",
    "plain_m3s": "supply air that the racks demand at the exhaust shares of the design point, m3/s",
    "taken_m3s": "air that racks exchange with the unit in a pass over weights, m3/s; then the "
    "weight of the next pass",
    "supply_ratio": "supply air that reaches the racks / their need at design exhaust shares",
    "supply_ratio_used": "supply_ratio with which the last sweep computed the racks",
    "weight": "weight of the unit in the supply of all racks at a coupling of 1, w of docs/hall.md",
    "last_weight_change": "relative change of weight in the last pass",
    "fitted_m3s": "airflow to which weight was fitted, m3/s; -1 for none",
    "strength": "weight to the power of the coupling",
    "drawn_ratio": "supply air that racks take from the unit / what they would take if all weights "
    "were 1 (transient)",
    "strength_used": "strength with which the last sweep computed the racks",
    "drawn_m3s": "air of the racks that the unit draws, m3/s (own return air)",
    "return_weight": "weight of the unit in the returns of all racks (own return air)",
    "return_offset_k": "return air of the unit minus that of the hall, K",
    "base_k": "supply air without a limit of the coil minus setpoint, K (own return air)",
}
RACK_STATE = {
    "mixed_c": "exhaust mix before the rack; transient: room air at its intake, C",
    "exhaust_c": "exhaust temperature of the rack times its strength, side 0, C",
    "exhaust_odd_c": "exhaust temperature of the rack times its strength, side 1, C",
    "captured_m3s": "airflow that the rack draws from its exhaust mix, m3/s",
    "unshifted_mix_c": "exhaust mix of the next sweep without the data center's shift, C",
    "mix_input_k": "temperature difference that dense halls weight into mixes, K",
}
RACK_MEANS = {
    "cpu_w": "power without fans, W",
    "fan_w": "power of the server fans, W",
    "airflow_m3s": "airflow, m3/s",
    "inlet_c": "mean inlet, weighted by airflow with recirculation, C",
    "outlet_c": "outlet, C",
}
"""Values of each rack, also summed over the racks: those of the last sweep, or in transient halls
means over the substeps."""
RACK_EXTREMES = {
    "inlet_max_c": "hottest inlet of a server, C",
    "outlet_max_c": "hottest outlet of a server, C",
}
"""Extremes of each rack: those of the last sweep, or in transient halls of all substeps."""
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
    "over_27_sum_k": "sum over the servers of inlet degrees above 27 C, K",
    "under_18_sum_k": "sum over the servers of inlet degrees below 18 C, K",
    "thermal_storage_w": "heat flow into servers and room air, W",
    "flow_m3s": "airflow in the present sweep, m3/s",
    "return_m3k_s": "airflow times outlet not recirculated, in the present sweep, m3 K/s",
    "outlet_sum_c": "sum of the outlets in the present sweep, C",
}
"""Sums over the blocks of a chunk, separately for each lane."""
BLOCK_TERMS = {
    "fresh_m3s": "supply air intake of the servers if units covered all need, m3/s",
    "plain_m3s": "the same at the exhaust shares of the design point, m3/s",
    "mixed_c": "mean temperature of recirculated air in the substep, C (transient)",
    "parcel_w": "heat that warms the recirculated air in the substep, W (transient)",
}
"""Values of each block of a chunk in the present sweep."""
N_TERMS, N_BLOCK_TERMS = len(TERMS), len(BLOCK_TERMS)
SCRATCH = N_TERMS + CHUNK_BLOCKS * N_BLOCK_TERMS
"""Work vectors per chunk: its TERMS, then the BLOCK_TERMS of each block."""
SUMS = (
    {name: f"sum over the racks: {text}" for name, text in RACK_MEANS.items()}
    | {name: f"sum over the racks: {text}" for name, text in TERMS.items()}
    | {
        "inlet_max_c": "hottest inlet, C",
        "hottest_block": "block of the rack with the hottest inlet",
        "hottest_lane": "lane of the rack with the hottest inlet",
        "hottest_group": "group with the hottest inlet, from 0 in its rack",
        "present_inlet_max_c": "hottest inlet in the present sweep, C (if fans follow it)",
        "least_change_k": "lower bound of new exhaust mix minus unshifted_mix_c, K",
        "most_change_k": "upper bound of new exhaust mix minus unshifted_mix_c, K",
    }
)
"""Sums and extremes of each chunk. In transient halls, TERMS before ``flow_m3s`` are summed over
the substeps, and the summed RACK_MEANS are means over the substeps."""
PLENUM_NEED = {
    "design_m3s": "supply air that the rack needs at the design point, m3/s",
    "present_m3s": "supply air that the rack needs in the present sweep, m3/s",
}
"""Need of each rack for supply air, to which weights of coupled units are fitted."""
RETURN_AIR = {
    "flow_m3s": "exhaust minus recirculated intake, which returns to the units, m3/s",
    "flow_m3k_s": "airflow times temperature of this air, m3 K/s",
}
"""Air of each rack that returns to the units in the present sweep."""
DC_OUT = {
    "cpu_w": "power without fans, W",
    "it_fan_w": "power of the server fans, W",
    "it_airflow_m3s": "airflow of the servers, m3/s",
    "inlet_mean_c": "mean inlet of the racks, C",
    "outlet_mean_c": "mean outlet of the racks, C",
    "inlet_m3k_s": "sum of airflow times (inlet minus supply air), m3 K/s",
    "outlet_m3k_s": "sum of airflow times (outlet minus supply air), m3 K/s",
    "over_27_sum_k": "sum over the servers of inlet degrees above 27 C, K",
    "under_18_sum_k": "sum over the servers of inlet degrees below 18 C, K",
    "thermal_storage_w": "heat flow into servers and room air, W",
    "units_flow_m3s": "airflow of the CRAC units, m3/s",
    "supply_c": "supply air, mean over the units weighted by airflow, C",
    "units_return_c": "return air, C",
    "units_load_w": "heat of air and CRAC fans that reaches the units, W (transient)",
    "coil_w": "heat that the plant removes, W (transient)",
    "inlet_max_c": "hottest inlet of a server, C",
    "hottest_rack": "rack with the hottest inlet, from 0 in its data center",
    "hottest_server": "first server of the group with the hottest inlet, from 0 in its rack",
}


def _numbers(kind: str, ndim: int, rows: Mapping[str, str] | None = None, of: str = "") -> Argument:
    return Argument(kind, ndim, rows=rows or {}, of=of)


def _lanes(kind: str, ndim: int, rows: Mapping[str, str] | None = None, of: str = "") -> Argument:
    return Argument(kind, ndim, LANES, rows or {}, of)


def _vectors(
    ndim: int, rows: Mapping[str, str] | None = None, of: str = "", lanes: int = LANES
) -> Argument:
    return Argument("real", ndim, lanes, rows or {}, of)


ARGUMENTS = {
    # How the kernel runs.
    "recirculates": Argument("template"),  # True if racks take in exhaust air
    "transient": Argument("template"),  # True if each sweep is a substep
    "own_return": Argument("template"),  # True if units of a data center draw their own return air
    "fan_knees": Argument("template"),  # number of knees of the airflow ratio per data center
    "cpu_knees": Argument("template"),  # number of knees of the power ratio per data center
    "serial": Argument("template"),  # True: run on the calling thread alone
    "slices": Argument("i32"),  # number of parts, one thread each
    "one": Argument("i32"),  # always 1, see "Loops of step 1" in README.md
    "sweeps": Argument("i32"),  # maximum number of sweeps, or of substeps
    "longest": Argument("i32"),  # length of the longest substep divided by substep_s
    "outlet_model": Argument("i32"),  # index into OUTLETS
    "load_level": Argument("i32"),  # LOADS_PER_DC, LOADS_PER_RACK or LOADS_PER_GROUP
    "load_columns": Argument("i32"),  # number of loads in the table of steady states
    "per_group": Argument("i32"),  # 1 if layers hold one server per group
    "substep_s": Argument("f64"),  # length of the shortest substep
    "weight": Argument("f64"),  # weight of a sweep or shortest substep in the results
    "tolerance_k": Argument("f64"),  # convergence: limit of the change of any mix
    "abandoned_above_k": Argument("f64"),  # transient: change of the air that ends a step early, K
    # Indices of the items in the arrays.
    "task_offsets": _numbers("i32", 1),  # first chunk of each task, and the final end
    "dc_ints": _numbers("i32", 2, DC_INTS, "dcs"),
    "chunk_ints": _numbers("i32", 2, CHUNK_INTS, "chunks"),
    "block_ints": _numbers("i32", 2, BLOCK_INTS, "blocks"),
    "place_ints": _numbers("i32", 2, PLACE_INTS, "places"),
    "source_offsets": _numbers("i32", 1),  # first source of each block, and the final end
    "source_ints": _numbers("i32", 2, SOURCE_INTS, "sources"),
    # Halls, and their boundary conditions.
    "dc_coefficients": _numbers("real", 1, DC_COEFFICIENTS, "dcs"),
    "server_knees": _numbers("real", 2, KNEES, "knees"),
    "rack_inputs": _vectors(2, RACK_INPUTS, "blocks"),
    "group_inputs": _vectors(1, GROUP_INPUTS, "groups"),
    "unit_inputs": _numbers("real", 2, UNIT_INPUTS, "units"),
    "group_load": _numbers("real", 1),  # utilisation of each group, if given per group
    "unit_shares": _vectors(1),  # present share of each unit in a rack's supply, s of docs/hall.md
    "mix_weights": _vectors(1, lanes=DENSE_LANES * LANES),  # of dense halls
    "sparse_weights": _vectors(1, lanes=SPARSE_LANES * LANES),  # of sparse halls
    "steady_states": _vectors(1),  # patterns or modes of each hall, and what gives their amounts
    "sample_outlet_c": _numbers("real", 1),  # outlets of the sampled racks of sparse halls
    # State that is carried from sweep to sweep.
    "dc_control": _numbers("i32", 2, DC_CONTROL, "dcs"),
    "dc_doubles": _numbers("f64", 2, DC_DOUBLES, "dcs"),
    "unit_state": _numbers("f64", 2, UNIT_STATE, "units"),
    "rack_state": _vectors(2, RACK_STATE, "blocks"),
    "rack_state_by_4": _vectors(1, lanes=DENSE_LANES),  # rack_state as vectors of 4 lanes
    "rack_state_by_16": _vectors(1, lanes=SPARSE_LANES),  # rack_state as vectors of 16 lanes
    "server_c": _vectors(1),  # server temperatures of transient halls, by block and group
    "server_c_before": _numbers("real", 1),  # group temperatures at step start
    "server_c_after": _numbers("real", 1),  # group temperatures at step end
    # Work space.
    "scratch": _vectors(1),
    "mode_amounts": _vectors(1),  # amounts of the modes, MODE_VECTORS for each slice
    "mode_amount": _numbers("real", 1),  # the memory of mode_amounts, by mode
    "unit_need_m3s": _numbers("f64", 1),  # supply air that a chunk demands from each unit
    "unit_plain_m3s": _numbers("f64", 1),  # the same at the exhaust shares of the design point
    "plenum_shares": _lanes("f64", 1),  # unit_shares of units with equal weights, if coupled
    "plenum_need": _lanes("f64", 2, PLENUM_NEED, "plenum"),
    "return_shares": _lanes("f64", 1),  # share of each unit in a rack's returns, q of docs/hall.md
    "return_air": _lanes("f64", 2, RETURN_AIR, "returns"),
    "unit_lanes": _lanes("f64", 1),  # air that racks exchange with each unit, by lane
    "chunk_sums": _numbers("f64", 1, SUMS, "chunks"),
    "group_values": _vectors(2, GROUP_OUT, "values"),
    # Results.
    "rack_out": _vectors(2, RACK_OUT, "blocks"),
    "dc_out": _numbers("f64", 2, DC_OUT, "dcs"),
    "inlet_c": _numbers("real", 1),  # inlet of each server
    "outlet_c": _numbers("real", 1),
    "power_w": _numbers("real", 1),
    "inlet_vectors": _vectors(1),  # the memory of inlet_c, in vectors
    "outlet_vectors": _vectors(1),
    "power_vectors": _vectors(1),
}
"""Arguments of both kernels by name, template arguments first."""

_LAYERS_ALONE = (
    *("per_group", "group_values", "inlet_c", "outlet_c", "power_w"),
    *("inlet_vectors", "outlet_vectors", "power_vectors"),
)
_STEP_ALONE = (
    *(
        "sweeps",
        "longest",
        "load_columns",
        "substep_s",
        "weight",
        "tolerance_k",
        "abandoned_above_k",
    ),
    "task_offsets",
    *(
        "source_offsets",
        "source_ints",
        "unit_inputs",
        "mix_weights",
        "sparse_weights",
        "steady_states",
    ),
    *("sample_outlet_c", "mode_amounts", "mode_amount"),
    *("dc_control", "rack_state_by_4", "rack_state_by_16", "server_c_before", "server_c_after"),
    *("scratch", "unit_need_m3s", "unit_plain_m3s", "plenum_shares", "plenum_need", "unit_lanes"),
    *("own_return", "return_shares", "return_air"),
    *("chunk_sums", "dc_out"),
)
STEP_ARGUMENTS = {name: ARGUMENTS[name] for name in ARGUMENTS if name not in _LAYERS_ALONE}
"""Arguments of the kernel of a step (hall.py)."""
LAYERS_ARGUMENTS = {name: ARGUMENTS[name] for name in ARGUMENTS if name not in _STEP_ALONE}
"""Arguments of the kernel of per-server values (layers.py)."""
