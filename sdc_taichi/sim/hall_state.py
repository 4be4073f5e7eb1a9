"""State, boundary conditions and results of a fleet's halls in a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sdc_taichi.types import F64, HallQuantities, Reals

Precision = Literal["f32", "f64"]
"""Precision of the temperatures and powers of servers and racks."""


@dataclass(frozen=True, slots=True)
class HallState:
    """Thermal state of transient halls between steps; quasi-steady halls have no such state."""

    server_c: Reals
    """Temperature of the servers of each group, in C, (G,)."""
    mixed_c: Reals
    """Temperature of the recirculated air before each rack, in C, (R,)."""
    exhaust_c: Reals
    """Exhaust temperature of each rack multiplied by its weight (strength) in the exhaust mixes, in
    C, (R,): that of its outlet, mixed with ``mixed_c`` for the airflow that failed fans lack."""
    captured_m3s: Reals
    """Recirculated air that each rack draws in, in m3/s, (R,)."""
    need_m3s: F64
    """Supply airflow that the racks would demand from each CRAC unit if all units ran, in m3/s,
    (U,)."""
    plain_m3s: F64
    """Supply airflow that the racks would demand from each CRAC unit if all units ran and no
    oversupply lowered exhaust shares, in m3/s, (U,)."""
    following: F64
    """Speed of fans that follow the hottest inlet, otherwise the speed at which each CRAC unit
    would just meet the demand of the racks, as a share of full speed, (U,)."""
    supply_excess_k: F64
    """Temperature behind the coil of each CRAC unit, if the unit runs, minus its setpoint and minus
    the warming of the room by stored heat, in K, (U,)."""
    casing_c: F64
    """Temperature of the air in the casing of each CRAC unit, in C, (U,)."""
    return_air_c: F64
    """Temperature of the return air of each CRAC unit, in C, (U,)."""
    water_heat_j: F64
    """Heat stored in the chilled water, with that of a mixed tank, relative to the water at its
    setpoint, in J, (B,)."""
    tank_heat_j: F64
    """Heat stored in a stratified tank relative to water at its setpoint, in J, (B,)."""


@dataclass(frozen=True, slots=True)
class ChilledWater:
    """Chilled water and buffer tank of transient halls during one step."""

    carried_w: F64
    """Maximum heat that coils and chilled-water pumps can carry, in W, (B,)."""
    j_per_k: F64
    """Heat capacity of the chilled water, with that of a mixed tank, in J/K, (B,)."""
    tank_most_j: F64
    """Maximum heat that a stratified tank can store, in J, (B,)."""
    tank_share: F64
    """Available share of a stratified tank, 0..1, (B,)."""


@dataclass(frozen=True, slots=True)
class Coil:
    """Coils and plant of transient halls during one step."""

    setpoint_c: F64
    """Supply setpoint of each CRAC unit, in C, (U,)."""
    room_j: F64
    """Heat stored in room and chilled water at the start of the step, relative to the setpoint, in
    J, (B,)."""
    room_j_per_k: F64
    """Heat capacity of the room, in J/K, (B,)."""
    limit_w: F64
    """Maximum heat that the plant can remove from water at its setpoint, without the part that
    grows with the heat at the coils, in W, (B,)."""
    fan_w_per_m3s: F64
    """CRAC fan power divided by airflow, both at full speed, in W/(m3/s), (B,)."""
    water: ChilledWater | None = None
    """Chilled water and tank; None for halls without either."""
    limit_w_per_k: F64 | float = 0.0
    """Growth of the maximum heat with the warmth of the water above its setpoint, in W/K, (B,)."""
    limit_w_per_w: F64 | float = 0.0
    """Growth of the maximum heat with the heat at the coils, in W/W, (B,)."""


@dataclass(slots=True)
class Conditions:
    """Boundary conditions of the halls during one step."""

    unit_supply_c: F64
    """Supply temperature of each CRAC unit, in C, (U,)."""
    utilisation: F64
    """Mean utilisation of the servers of each data center, 0..1, (B,)."""
    rack_load: F64 | None = None
    """Utilisation of each rack while it is on, 0..1, (R,); None uses ``utilisation`` for all
    racks."""
    group_load: F64 | None = None
    """Utilisation of each server group while its rack is on, 0..1, (G,); None distributes the load
    of a rack by the load weights of its groups."""
    powered: F64 | None = None
    """Share of the step during which each rack is on, 0..1, (R,); None means the whole step."""
    rack_airflow: F64 | None = None
    """Remaining airflow of each rack's fans as a share of full airflow, 0..1, (R,); None means
    full airflow."""
    unit_low: F64 | None = None
    """Minimum fan speed of each CRAC unit as a share of full speed, (U,); None means full speed."""
    unit_high: F64 | None = None
    """Maximum fan speed of each CRAC unit as a share of full speed, (U,); None means full speed."""
    unit_running: F64 | None = None
    """1 for running CRAC units, 0 for units whose fan coasts without cooling, (U,); None means
    that all run."""


@dataclass
class HallSums(HallQuantities):
    """Hall results of one step: sums and means of each data center, and values of each rack."""

    inlet_m3k_s: F64
    """Sum over the servers of airflow times (inlet minus supply temperature), in m3 K/s, (B,)."""
    outlet_m3k_s: F64
    """Sum over the servers of airflow times (outlet minus supply temperature), in m3 K/s, (B,)."""
    over_27_sum_k: F64
    """Sum over the servers of the inlet temperature's excess above 27 C, in K, (B,)."""
    under_18_sum_k: F64
    """Sum over the servers of the inlet temperature's shortfall below 18 C, in K, (B,)."""
    units_flow_m3s: F64
    """Total airflow of the CRAC units, in m3/s, (B,); 0 with inlet model ``approach``."""
    units_return_c: F64
    """Temperature of the return air of the CRAC units, in C, (B,); 0 with inlet model
    ``approach``."""
    units_load_w: F64
    """Heat from return air and CRAC fans that reaches the CRAC units, in W, (B,); 0 in
    quasi-steady halls."""
    coil_w: F64
    """Heat that the plant removes from room and chilled water, in W, (B,); 0 in quasi-steady
    halls."""
    unit_airflow_m3s: F64
    """Airflow of each CRAC unit, in m3/s, (U,); meaningless with inlet model ``approach``."""
    cubed_flow_m3s: F64
    """Sum over the running CRAC units of full-speed airflow times the step mean of the cubed
    relative fan speed, in m3/s, (B,); 0 with inlet model ``approach``."""
    room_j: F64
    """Heat stored in room and chilled water at the end of the step, relative to the setpoint, in J,
    (B,)."""
    water_j: F64
    """Part of ``room_j`` in the chilled water, with that of a mixed tank, in J, (B,)."""
    tank_j: F64
    """Part of ``room_j`` in a stratified tank, in J, (B,)."""
    water_warmed_k: F64
    """Temperature of the chilled water minus its setpoint at the end of the step, in K, (B,)."""
    most_warmed_k: F64
    """Temperature of the chilled water, or in halls without water of the room, minus its setpoint,
    in K, (B,): the higher of the values at start and end of the step."""
