"""Arguments of the kernel of ``liquid.py``. This module does not import Taichi."""

from .arguments import Argument

RACK_COEFFICIENTS = {
    "gpus": "number of GPUs",
    "gpu_idle_w": "power of an idle GPU, in W",
    "gpu_span_w": "power of a GPU at full load less that of an idle one, in W",
    "gpu_max_w": "power of a GPU at full load, in W",
    "cpus_idle_w": "power of all CPUs when idle, in W",
    "cpus_span_w": "power of all CPUs at full load less that when idle, in W",
    "other_idle_w": "power of everything else when idle, in W",
    "other_span_w": "power of everything else at full load less that when idle, in W",
    "capture_chip": "share of the heat of GPUs and CPUs that the coolant takes",
    "capture_other": "share of the heat of everything else that the coolant takes",
    "leak_per_k": "growth of a GPU's power with its junction temperature, in 1/K",
    "leak_ref_c": "junction temperature to which powers refer, in C",
    "r_fixed_k_per_w": "resistance between junction and coolant at very large flow, in K/W",
    "r_film_k_m3s_per_w": "further resistance times the flow of the rack, in K m3/s per W",
    "throttle_c": "junction temperature to which GPUs limit their power, in C",
    "trip_c": "junction temperature above which the rack switches off, in C",
    "trip_flow": "flow below which the rack switches off, as a share of design; 0 for never",
    "design_m3s": "design flow of coolant, in m3/s",
    "loss_w_per_k": "heat that pipes lose for each kelvin of return minus room, in W/K",
    "chips_j_per_k": "heat capacity of all GPUs with their cold plates, in J/K",
    "stagnant_w_per_k": "conductance between all GPUs and their coolant without flow, in W/K",
    "door_effectiveness": "share of the heat that a rear door takes at room temperature, or 0",
    "per_door_rise": "1 / rise of the air of the rack at design, in 1/K",
}
"""Constants of each rack with coolant."""
RACK_INPUTS = {
    "utilisation": "utilisation, 0..1",
    "powered": "share of the step in which the rack has power",
    "open": "opening of the valve of the rack, 0..1",
}
"""Inputs of a step of each rack."""
RACK_STATE = {"junction_c": "hottest junction, in C; transient halls: before and after the step"}
RACK_OUT = {
    "it_w": "mean power, in W",
    "liquid_w": "mean heat of its servers into the coolant, in W",
    "air_w": "heat into the air while the rack has power, with its part of lines and pumps, in W",
    "junction_max_c": "hottest junction during the step, in C; 0 without GPUs",
    "lost_utilisation": "mean of utilisation times (1 - clock)",
    "tripped": "1 if the rack has switched off in the step, else 0",
    "m3s": "flow of coolant, in m3/s",
    "runs": "1 while the rack has not switched off, else 0",
    "r_k_per_w": "junction minus coolant temperature per W of a GPU, in K/W",
    "k_w_per_k": "conductance between all GPUs and their coolant, in W/K",
    "k_per_w": "rise of the junctions in a substep per W of all GPUs, in K/W",
}
"""Results of each rack, those after the flow only used within the kernel."""
CDU_COEFFICIENTS = {
    "design_m3s": "flow of coolant at design, in m3/s",
    "ua_w_per_k": "UA of the exchanger at design, in W/K",
    "design_w_per_k": "heat capacity rate of either side at which it has this UA, in W/K",
    "wall_share": "share of the walls in the resistance",
    "side_share": "share of the coolant's film in that of both films",
    "min_valve": "smallest flow of facility water, as a share of design",
    "max_valve": "largest flow of facility water, as a share of design",
    "pump_w": "power of the pumps at design, in W",
    "fluid_share": "share of the power of the pumps that heats the coolant",
    "alike": "1 if all CDUs of its manifold have equal constants, else 0",
}
"""Constants of each CDU."""
CDU_INPUTS = {
    "setpoint_c": "supply setpoint, in C",
    "flow": "commanded flow of its manifold, as a share of design",
    "up": "1 if the CDU runs, else 0",
    "pumps": "largest flow of its working pumps, as a share of that of all",
}
"""Inputs of a step of each CDU."""
CDU_OUT = {
    "supply_c": "temperature of the coolant that leaves, in C",
    "m3s": "mean flow of coolant, in m3/s",
    "heat_w": "mean heat into facility water, in W",
    "valve": "flow of facility water, as a share of design",
    "k_w_per_k": "heat per kelvin of return minus facility water, in W/K",
    "w_per_k": "heat capacity rate of the coolant, in W/K",
    "is_full": "1 if its valve is fully open, else 0",
    "valve_now": "flow of facility water in the last sweep or substep, as a share of design",
}
"""Results of each CDU, the last three only used within the kernel."""
LOOP_COEFFICIENTS = {"loop_j_per_k": "heat capacity of the coolant of the loop, in J/K"}
"""Constant of each manifold."""
LOOP_STATE = {
    "return_c": "coolant that returns to the CDUs, in C; before and after the step",
    "supply_c": "coolant that reaches the racks, in C; before and after the step",
}
LOOP_OUT = {
    "w_per_k": "heat capacity rate of the coolant, in W/K",
    "wanted_c": "mean setpoint of the CDUs by flow, in C",
    "on": "number of racks that have power in the step",
    "least_c": "lowest setpoint of the CDUs that run, in C",
    "flow_per_rack": "flow of a rack with an open valve, as a share of its design",
    "loss_w_per_k": "heat that pipes lose for each kelvin of return minus room, in W/K",
    "pump_w": "power of the pumps, in W",
    "pump_heat_w": "part of it that heats the coolant, in W",
    "k_w_per_k": "heat of all CDUs per kelvin of return minus facility water, in W/K",
    "heat_w": "heat into facility water, in W",
    "uncooled_c": "supply that only pipes cool, in C",
    "at_c": "supply at which the present sweep computes the racks, in C",
    "last_c": "the same of the last sweep, in C",
    "change_k": "change of the supply by the last sweep, in K",
    "low_c": "last supply that a sweep has made warmer, in C",
    "high_c": "last supply that a sweep has made colder, in C",
    "to_air_w": "heat of pipes and pumps into the air, in W",
}
"""Values of each manifold within the kernel."""
DC_COEFFICIENTS = {
    "j_per_m3_k": "volumetric heat capacity of the coolant, in J/(m3 K)",
    "room_c": "air temperature around the pipes, in C",
    "water_w_per_k": "heat capacity rate of facility water at design, in W/K",
    "water_j_per_k": "heat capacity of the facility loop, in J/K",
    "design_pump_w": "power of the facility pumps at design, in W",
    "facility_fluid_share": "share of that power that heats the water",
    "min_pump": "lowest speed of the facility pumps, as a share of design",
    "cooler_ua_w_per_k": "UA of the cooler at design, in W/K",
    "cooler_air_w_per_k": "heat capacity rate of the cooler's air at full fan speed, in W/K",
    "cooler_wall_share": "share of the walls in the resistance of the cooler",
    "cooler_side_share": "share of the water's film in that of both films",
    "fan_w": "power of the cooler's fans at full speed, in W",
    "min_fan": "smallest airflow of the cooler, as a share of design",
    "reuse_kind": "0 none, 1 direct, 2 heat pump",
    "reuse_demand_w": "largest heat that the consumer takes, in W",
    "reuse_effectiveness": "effectiveness of the exchanger of direct reuse",
    "network_return_c": "water of the consumer before it is heated, in C",
    "sink_c": "mean temperature of the heat pump's sink with pinch, in C",
    "lorenz_k": "COP of the heat pump times its temperature lift, in K",
    "pinch_k": "temperature difference in the heat pump's exchangers, in K",
}
"""Constants of each data center."""
DC_INPUTS = {
    "dry_c": "temperature of the air that cools, or of the tower's water, in C",
    "wet_c": "the same with wet pads, in C",
    "least_setpoint_c": "lowest supply setpoint that keeps the dew point away, in C",
    "approach_k": "lowest supply setpoint minus facility setpoint, in K",
    "reuse_share": "share of the heat offered to the consumer, 0..1",
    "power_cap": "largest power of a GPU as a share of full load; 1 for no cap",
    "facility_pump": "share of the facility pumps that work, 0..1",
    "cooler_share": "share of the cooler's fans that work, 0..1",
    "trim_w": "capacity of the trim chiller, or of the plant for its heat, in W",
    "least_water_c": "lowest setpoint of the facility water, in C",
    "substeps": "number of substeps of a transient hall",
}
"""Inputs of a step of each data center."""
DC_STATE = {
    "water_return_c": "facility water that returns, in C; before and after the step",
    "water_supply_c": "facility water at the CDUs, in C; before and after the step",
}
DC_OUT = {
    "it_w": "mean power of the racks, in W",
    "liquid_heat_w": "mean heat of servers into the coolant, in W",
    "liquid_air_w": "mean heat of racks, pipes and pumps into the air, in W",
    "junction_max_c": "hottest junction during the step, in C",
    "cdu_supply_c": "coolant that reaches the racks, mean by flow, in C",
    "cdu_return_c": "coolant that returns, mean by flow, in C",
    "cdu_pump_w": "mean power of the pumps of CDUs, in W",
    "facility_pump_w": "mean power of the facility pumps, in W",
    "cooler_fan_w": "mean power of the cooler's fans, in W",
    "cooler_w": "mean heat that cooler or tower takes, in W",
    "trim_load_w": "mean heat that the trim chiller, or the plant in its place, takes, in W",
    "taken_w": "mean heat that reuse takes from facility water, in W",
    "heat_pump_w": "mean power of the heat pump, in W",
    "evaporated_w": "mean heat of evaporation of the water of wet pads, in W",
    "stored_w": "mean rate of heat stored in chips and loops, in W",
    "facility_setpoint_c": "setpoint of the facility water, in C",
    "throttle_s": "time of the first throttling, in s; -1 without",
    "trip_s": "time of the first trip, in s; -1 without",
    "sweeps": "number of sweeps, or of substeps",
    "airflow": "airflow of the cooler in the last sweep or substep, as a share of design",
}
"""Results of each data center."""
ARGUMENTS = {
    "serial": Argument("template"),  # True: run on the calling thread alone
    "transient": Argument("template"),  # True: chips and loops hold heat
    "slices": Argument("i32"),  # number of parts of the data centers, one thread each
    "one": Argument("i32"),  # always 1, see "Loops of step 1" in README.md
    "step_s": Argument("f64"),  # length of the step, in s
    "most_sweeps": Argument("i32"),
    "rack_offsets": Argument("i32", 1),  # first rack of each manifold, (M + 1,)
    "cdu_offsets": Argument("i32", 1),  # first CDU of each manifold, (M + 1,)
    "manifold_offsets": Argument("i32", 1),  # first manifold of each data center, (B + 1,)
    "rack_coefficients": Argument("f64", 1, rows=RACK_COEFFICIENTS, of="racks"),
    "rack_inputs": Argument("f64", 2, rows=RACK_INPUTS, of="racks"),
    "rack_state": Argument("f64", 2, rows=RACK_STATE, of="racks"),
    "rack_out": Argument("f64", 2, rows=RACK_OUT, of="racks"),
    "cdu_coefficients": Argument("f64", 1, rows=CDU_COEFFICIENTS, of="cdus"),
    "cdu_inputs": Argument("f64", 2, rows=CDU_INPUTS, of="cdus"),
    "cdu_out": Argument("f64", 2, rows=CDU_OUT, of="cdus"),
    "loop_coefficients": Argument("f64", 1, rows=LOOP_COEFFICIENTS, of="loops"),
    "loop_state": Argument("f64", 2, rows=LOOP_STATE, of="loops"),
    "loop_out": Argument("f64", 2, rows=LOOP_OUT, of="loops"),
    "dc_coefficients": Argument("f64", 1, rows=DC_COEFFICIENTS, of="dcs"),
    "dc_inputs": Argument("f64", 2, rows=DC_INPUTS, of="dcs"),
    "dc_state": Argument("f64", 2, rows=DC_STATE, of="dcs"),
    "dc_out": Argument("f64", 2, rows=DC_OUT, of="dcs"),
}
"""Arguments of the kernel of ``liquid_kernel``."""
