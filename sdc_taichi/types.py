"""Actions, state and results of a simulation step, and the array types of the package.

In shapes, B is the number of data centers. U, R, G and S are the numbers of CRAC units, racks,
server groups and servers of all data centers together, concatenated in the order of the data
centers; C, M and L are those of coolant distribution units (CDUs), of their secondary loops
(manifolds), and of liquid-cooled racks. Dataclasses that are created in every step are not frozen,
because creating a frozen one takes three times as long.
"""

from __future__ import annotations

import ast
import inspect
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum
from functools import cache
from itertools import pairwise
from operator import attrgetter
from typing import Annotated, Any, get_origin, get_type_hints

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Values = F64 | float
"""An array, or a scalar that stands for an array of equal entries."""
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
Status = npt.NDArray[np.int8]
"""Status codes of racks as defined in ``hall.protection``: 0 normal, 1 throttled, 2 tripped."""
Reals = npt.NDArray[np.floating[Any]]
"""Array of f32 or f64 numbers, in the precision of the server kernels."""


def as_array(values: F64 | float) -> F64:
    """Convert a float to an array; return arrays and traced quantities of a stage unchanged."""
    return np.asarray(values) if isinstance(values, float) else values


def fields_of(values: Any) -> dict[str, Any]:
    """Return the fields of a dataclass instance as a dict by name."""
    return {f.name: getattr(values, f.name) for f in fields(values)}


def joined(*parts: Mapping[str, Any]) -> dict[str, Any]:
    """Merge mappings whose names must not overlap.

    Raises:
        ValueError: Two parts contain the same name.
    """
    values: dict[str, Any] = {}
    for part in parts:
        values.update(part)
    if len(values) < sum(map(len, parts)):
        names = Counter(name for part in parts for name in part)
        twice = [name for name, count in names.items() if count > 1]
        raise ValueError(f"quantities that two parts of a step have: {', '.join(twice)}")
    return values


class LoadAction(Enum):
    """Commands for delay-tolerant work; each value is the equivalent continuous command, -1..1."""

    DEFER = -1
    NEUTRAL = 0
    DRAIN = 1


class CoolAction(Enum):
    """Changes of the CRAC setpoint, in steps of ``hvac.setpoint.step_k``."""

    LOWER = -1
    HOLD = 0
    RAISE = 1


class FanAction(Enum):
    """Changes of the CRAC fan speed, in steps of ``hvac.crac.fan_step``."""

    LOWER = -1
    HOLD = 0
    RAISE = 1


class BatteryAction(Enum):
    """Battery commands, as shares of the battery's power limit."""

    DISCHARGE = -1
    IDLE = 0
    CHARGE = 1


@dataclass(frozen=True, slots=True)
class Actions:
    """Commands of one step.

    A single enum member or number applies to all data centers; a list or array has one entry per
    data center. Numbers are continuous commands.
    """

    load: LoadAction | float | F64 | Sequence[LoadAction] = LoadAction.NEUTRAL
    """Share of the deferrable work to defer (below 0) or of the queue to drain (above 0), -1..1,
    shape () or (B,)."""
    cooling: CoolAction | float | F64 | Sequence[CoolAction] | None = None
    """Change of the setpoints in steps of ``hvac.setpoint.step_k``, -1e6..1e6, shape (), (B,) or
    (U,); None follows ``hvac.setpoint.schedule_c``, or holds the setpoint without a schedule."""
    battery: BatteryAction | float | F64 | Sequence[BatteryAction] = BatteryAction.IDLE
    """Share of the battery's power limit to discharge (below 0) or charge (above 0), -1..1,
    shape () or (B,)."""
    fan: FanAction | float | F64 | Sequence[FanAction] = FanAction.HOLD
    """Change of the CRAC fan speeds in steps of ``hvac.crac.fan_step``, -1e6..1e6, shape (), (B,)
    or (U,); only flow model ``controlled`` accepts a change."""
    placement: F64 | None = None
    """Relative load of each rack, (R,), or server group, (G,); None weighs all equally. Only
    placement policy ``weights`` accepts it."""
    chilled_water: float | F64 | None = None
    """Temperature of the chilled water that leaves the plant, in C, shape () or (B,): at most the
    coldest supply temperature of the running CRAC units less ``hvac.chiller.coil_approach_k``, and
    within the range of the chiller model. None gives the warmest water that these limits allow."""
    transfer: F64 | None = None
    """Share of the arriving flexible work of each site (row) to send to each site of its fleet
    (column), (B, S), S being ``Fleet.sites_per_fleet``. Values are limited to 0..1 and the sum of a
    row to 1; a site's own column counts as 0. What links and rooms do not allow stays. None sends
    nothing."""
    cdu_setpoint_c: float | F64 | None = None
    """Wanted temperature of the coolant that each CDU sends to its racks, in C, 20..45, shape (),
    (B,) or (C,). The setpoint approaches it by up to 2 K a step; None holds the setpoint."""
    cdu_flow: float | F64 | None = None
    """Flow of each CDU divided by its design flow, 0.4..1.1, shape (), (B,) or (C,); None holds
    it."""
    facility_approach_k: float | F64 | None = None
    """Lowest supply setpoint of the CDUs minus setpoint of the facility water, in K, 2..15, shape
    () or (B,); None means ``liquid.cdus.approach_k``."""
    reuse_share: float | F64 | None = None
    """Share of the facility water's heat that may be reused, 0..1, shape () or (B,); None means
    ``liquid.reuse.share``."""
    power_cap: float | F64 | None = None
    """Power cap of the GPUs of liquid-cooled racks divided by their highest power, 0.5..1, shape ()
    or (B,); None means 1."""


@dataclass(slots=True)
class State:
    """State of the simulation between two steps, from which all other quantities derive.

    Arrays that the configured models do not need are empty.
    """

    step: int
    """Number of steps simulated since reset."""
    seed: I64
    """Seed of the sampled events of each data center, (B,)."""
    start: I64
    """First step of the run, counted from the beginning of the year, (B,)."""
    setpoint_c: F64
    """Setpoint of each CRAC unit, in C, (U,)."""
    cooling_run: I64
    """Number of consecutive equal cooling commands that each CRAC unit has received, (U,)."""
    cooling_last: F64
    """Last cooling command of each CRAC unit, in steps, nan before the first, (U,)."""
    fan_speed: F64
    """Controlled speed of each CRAC fan as a share of full speed, 0..1, (U,)."""
    queue: F64
    """Cumulative sum of the queued tasks by the step in which they arrived, oldest step first,
    shape (B, L) with L the number of arrival steps that a queue distinguishes; read-only."""
    in_flight: F64
    """Work on its way to each data center by the number of steps until it arrives, the next step
    first, in tasks, (B, ``fleet.delay_steps``); (B, 0) for data centers that share no work."""
    stored_kwh: F64
    """Energy in the battery, in kWh, (B,)."""
    room_heat_kwh: F64
    """Heat stored in the room relative to the room at the setpoint, in kWh, (B,); negative while
    the air is colder than the setpoint. In transient halls with that in the chilled water."""
    rack_status: Status
    """Status of each rack: 0 normal, 1 throttled, 2 tripped, (R,)."""
    restart_wait_min: F64
    """Time for which each tripped rack has been able to restart, in min, (R,); empty if no rack
    protects itself."""
    group_inlet_c: F64
    """Inlet temperature of each server group in the last step, in C, (G,); filled only for
    placement policies that read temperatures."""
    server_c: Reals
    """Temperature of the servers of each group, in C, (G,); only in transient halls."""
    mixed_c: Reals
    """Temperature of the recirculated air before each rack, in C, (R,); only in transient
    halls."""
    exhaust_c: Reals
    """Outlet temperature of each rack multiplied by its weight (strength) in the exhaust mixes, in
    C, (R,); only in transient halls."""
    captured_m3s: Reals
    """Recirculated air that each rack draws in, in m3/s, (R,); only in transient halls."""
    need_m3s: F64
    """Supply airflow that the racks would demand from each CRAC unit if all units ran, in m3/s,
    (U,); only in transient halls."""
    plain_m3s: F64
    """Supply airflow that the racks would demand from each CRAC unit if all units ran and no
    oversupply lowered exhaust shares, in m3/s, (U,); only in transient halls."""
    following: F64
    """Speed of fans that follow the hottest inlet, otherwise the speed at which each CRAC unit
    would just meet the demand of the racks, as a share of full speed, (U,); only in transient
    halls."""
    supply_excess_k: F64
    """Temperature behind the coil of each CRAC unit, if the unit runs, minus its setpoint and minus
    the warming of the room by stored heat, in K, (U,); only in transient halls."""
    casing_c: F64
    """Temperature of the air in the casing of each CRAC unit, in C, (U,); only in transient
    halls."""
    return_air_c: F64
    """Temperature of the return air of each CRAC unit, in C, (U,); only in transient halls."""
    water_heat_j: F64
    """Heat stored in the chilled water, with that of a mixed tank, relative to the water at its
    setpoint, in J, (B,); only in transient halls."""
    tank_heat_j: F64
    """Heat stored in a stratified tank relative to water at its setpoint, in J, (B,); only in
    transient halls."""
    cdu_setpoint_c: F64
    """Supply setpoint of each CDU, in C, (C,)."""
    cdu_flow: F64
    """Commanded flow of each CDU divided by its design flow, (C,)."""
    junction_c: F64
    """Junction temperature of the GPUs of each liquid-cooled rack, in C, (L,); only in transient
    halls."""
    manifold_return_c: F64
    """Temperature of the coolant that returns from the racks of each manifold, in C, (M,); only in
    transient halls."""
    manifold_supply_c: F64
    """Temperature of the coolant at the racks of each manifold, in C, (M,); only in transient
    halls."""
    facility_return_c: F64
    """Temperature of the facility water that returns from the CDUs, in C, (B,); only in transient
    halls with liquid-cooled racks."""
    facility_supply_c: F64
    """Temperature of the facility water at the CDUs, in C, (B,); only in transient halls with
    liquid-cooled racks."""


DATA_CENTERS, CRAC_UNITS, RACKS, CDUS = "B", "U", "R", "C"
"""Axis of a quantity: one entry per data center (B), CRAC unit (U), rack (R) or CDU (C)."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """Unit and array axis of a result quantity, as an annotation of its field.

    The annotated fields of ``StepResult`` are the only table of quantities. The columns of run
    folders, their documentation and their labels derive from it (``QUANTITIES``, ``meanings``).
    """

    unit: str
    """Unit; "1" for shares and ratios, "" for counts, indices and status codes."""
    axis: str = DATA_CENTERS
    """Kind of element along the array's single axis: data centers, CRAC units, racks or CDUs."""


@dataclass
class Exogenous:
    """Weather, grid and demand during one step of B data centers."""

    outdoor_c: Annotated[F64, Quantity("C")]
    """Outdoor dry-bulb temperature."""
    wet_bulb_c: Annotated[F64, Quantity("C")]
    """Outdoor wet-bulb temperature."""
    ci_g_per_kwh: Annotated[F64, Quantity("g CO2e/kWh")]
    """Carbon intensity of the grid."""
    demand: Annotated[F64, Quantity("1")]
    """Arriving work as a share of the data center's capacity, 0..1."""
    price_per_kwh: Annotated[F64, Quantity("currency/kWh")]
    """Price of a kWh from the grid, in the currency of the tariff; 0 if no prices are given."""


@dataclass
class SiteQuantities(Exogenous):
    """Site conditions of one step, with the effects of events."""

    active_events: Annotated[F64, Quantity("")]
    """Number of events that cover the step."""
    grid_up: Annotated[F64, Quantity("1")]
    """1 if the grid supplies power, 0 in an outage."""
    powered: Annotated[F64, Quantity("1")]
    """Share of the step during which the data center has power, 0..1."""
    unit_running: Annotated[F64, Quantity("1", CRAC_UNITS)]
    """1 for running CRAC units, 0 for units that are down or without power."""


@dataclass
class CommandQuantities:
    """Commands of one step."""

    load_command: Annotated[F64, Quantity("1")]
    """Commanded share of the deferrable work to defer (below 0) or of the queue to drain (above
    0), -1..1."""
    cooling_command: Annotated[F64, Quantity("")]
    """Commanded change of the setpoint, in setpoint steps, mean over the CRAC units; 0 where
    setpoints follow their schedule."""
    battery_command: Annotated[F64, Quantity("1")]
    """Commanded share of the battery's power limit to discharge (below 0) or charge (above 0),
    -1..1."""


@dataclass
class TransferQuantities:
    """Work that sites of a fleet send to each other in one step; 0 for data centers alone."""

    sent_tasks: Annotated[F64, Quantity("tasks")]
    """Arriving work that leaves for other sites; part of ``arrived_tasks``."""
    landed_tasks: Annotated[F64, Quantity("tasks")]
    """Work of other sites that arrives, with the age it has."""
    refused_tasks: Annotated[F64, Quantity("tasks")]
    """Work that was to leave, and stays because of the limits of links or a lack of room."""
    transfer_kwh: Annotated[F64, Quantity("kWh")]
    """Energy of transfers, half of it at either end in the step of departure; not part of
    ``grid_kwh``."""
    transfer_g: Annotated[F64, Quantity("g CO2e")]
    """Emissions of ``transfer_kwh`` at the site's carbon intensity; not part of ``carbon_g``."""
    in_flight_tasks: Annotated[F64, Quantity("tasks")]
    """Work on its way to the data center at the end of the step."""


@dataclass
class WorkQuantities:
    """Work that arrives, starts, waits and leaves in one step."""

    utilisation: Annotated[F64, Quantity("1")]
    """Started work as a share of capacity, including ``lost_tasks``."""
    arrived_tasks: Annotated[F64, Quantity("tasks")]
    """Work that arrived, without work of other sites."""
    deferred_tasks: Annotated[F64, Quantity("tasks")]
    """Work that entered the queue."""
    drained_tasks: Annotated[F64, Quantity("tasks")]
    """Work that left the queue on command."""
    due_tasks: Annotated[F64, Quantity("tasks")]
    """Queued work whose deadline has passed at the start of the step."""
    overdue_tasks: Annotated[F64, Quantity("tasks")]
    """Due work that does not run because the capacity of the step is exhausted."""
    dropped_tasks: Annotated[F64, Quantity("tasks")]
    """Work that exceeds the free space of the queue; with workload model ``tasks`` it runs at once
    and counts in ``executed_tasks``."""


@dataclass
class Work(WorkQuantities):
    """Decision of a workload model on the work of B data centers in one step."""

    started_tasks: F64
    """Work that starts, in tasks, (B,)."""
    dequeued_tasks: F64
    """Work that leaves the queue because it is drained or due, in tasks, (B,)."""


@dataclass
class QueueQuantities:
    """Queue of work at the end of a step."""

    queue_tasks: Annotated[F64, Quantity("tasks")]
    """Work in the queue at the end of the step."""
    oldest_age_h: Annotated[F64, Quantity("h")]
    """Age of the oldest work in the queue at the end of the step."""
    mean_age_h: Annotated[F64, Quantity("h")]
    """Mean age of the work in the queue at the end of the step."""


@dataclass
class SetpointQuantities:
    """Setpoints of the CRAC units in one step."""

    setpoint_c: Annotated[F64, Quantity("C")]
    """Supply air setpoint, mean over the CRAC units."""
    unit_setpoint_c: Annotated[F64, Quantity("C", CRAC_UNITS)]
    """Supply air setpoint of each CRAC unit."""


@dataclass
class HallQuantities:
    """Air temperatures, airflows and server power of the halls in one step."""

    supply_c: Annotated[F64, Quantity("C")]
    """Supply air temperature, airflow-weighted mean over the CRAC units: the setpoint plus the
    warming by unmet cooling."""
    inlet_mean_c: Annotated[F64, Quantity("C")]
    """Mean inlet temperature of the racks."""
    inlet_max_c: Annotated[F64, Quantity("C")]
    """Highest server inlet temperature; in transient halls the maximum over the substeps."""
    hottest_rack: Annotated[F64, Quantity("")]
    """Index of the rack with the hottest inlet, counted from 0 in its data center."""
    hottest_server: Annotated[F64, Quantity("")]
    """Index of the server with the hottest inlet, counted from 0 at the floor of its rack."""
    outlet_mean_c: Annotated[F64, Quantity("C")]
    """Mean outlet temperature of the racks."""
    cpu_w: Annotated[F64, Quantity("W")]
    """Power of the servers without their fans."""
    it_fan_w: Annotated[F64, Quantity("W")]
    """Power of the server fans."""
    it_airflow_m3s: Annotated[F64, Quantity("m3/s")]
    """Airflow through the servers."""
    thermal_storage_w: Annotated[F64, Quantity("W")]
    """Rate at which servers and recirculated air store heat; only in transient halls."""
    unit_supply_c: Annotated[F64, Quantity("C", CRAC_UNITS)]
    """Supply air temperature of each CRAC unit."""
    rack_cpu_w: Annotated[Reals, Quantity("W", RACKS)]
    """Power of the servers of each rack without their fans."""
    rack_fan_w: Annotated[Reals, Quantity("W", RACKS)]
    """Power of the server fans of each rack."""
    rack_airflow_m3s: Annotated[Reals, Quantity("m3/s", RACKS)]
    """Airflow through each rack."""
    rack_inlet_c: Annotated[Reals, Quantity("C", RACKS)]
    """Inlet temperature of each rack, mean over its servers; weighted by airflow with inlet model
    ``recirculation``."""
    rack_inlet_max_c: Annotated[Reals, Quantity("C", RACKS)]
    """Highest server inlet temperature of each rack; in transient halls the maximum over the
    substeps."""
    rack_outlet_c: Annotated[Reals, Quantity("C", RACKS)]
    """Outlet temperature of each rack."""
    rack_outlet_max_c: Annotated[Reals, Quantity("C", RACKS)]
    """Highest server outlet temperature of each rack; in transient halls the maximum over the
    substeps."""


@dataclass
class LoopQuantities:
    """Heat, temperatures and power of coolant loops in one step; 0 for data centers without any."""

    liquid_heat_w: Annotated[F64, Quantity("W")]
    """Heat of liquid-cooled racks that goes into the coolant."""
    liquid_air_w: Annotated[F64, Quantity("W")]
    """Heat of liquid-cooled racks, their lines and pumps that goes into the air of the hall."""
    junction_max_c: Annotated[F64, Quantity("C")]
    """Highest junction temperature of GPUs; 0 without GPUs."""
    cdu_supply_c: Annotated[F64, Quantity("C")]
    """Temperature of the coolant to the racks, mean over the CDUs weighted by flow."""
    cdu_return_c: Annotated[F64, Quantity("C")]
    """Temperature of the coolant from the racks, mean over the manifolds weighted by flow."""
    facility_supply_c: Annotated[F64, Quantity("C")]
    """Temperature of the facility water to the CDUs."""
    facility_return_c: Annotated[F64, Quantity("C")]
    """Temperature of the facility water from the CDUs."""
    coolant_m3s: Annotated[F64, Quantity("m3/s")]
    """Flow of coolant through the CDUs."""
    facility_m3s: Annotated[F64, Quantity("m3/s")]
    """Flow of facility water through the CDUs."""
    cdu_pump_w: Annotated[F64, Quantity("W")]
    """Electric power of the pumps of the CDUs."""
    facility_pump_w: Annotated[F64, Quantity("W")]
    """Electric power of the pumps of the facility water."""
    cooler_fan_w: Annotated[F64, Quantity("W")]
    """Electric power of the fans that cool the facility water."""
    trim_chiller_w: Annotated[F64, Quantity("W")]
    """Electric power of the trim chiller of the facility water."""
    trim_load_w: Annotated[F64, Quantity("W")]
    """Heat that the trim chiller removes from the facility water."""
    heat_pump_w: Annotated[F64, Quantity("W")]
    """Electric power of the heat pump that reuses heat."""
    reuse_w: Annotated[F64, Quantity("W")]
    """Heat that is delivered for reuse, with that of the heat pump's power."""
    liquid_rejected_w: Annotated[F64, Quantity("W")]
    """Heat of the facility water and of its trim chiller that is rejected to the outdoors."""
    liquid_to_plant_w: Annotated[F64, Quantity("W")]
    """Heat of the facility water that the plant of the CRAC units removes in place of a trim
    chiller; ``heat_removed_w`` does not contain it."""
    liquid_stored_w: Annotated[F64, Quantity("W")]
    """Rate at which chips and loops store heat; only in transient halls."""
    cooler_water_l: Annotated[F64, Quantity("l")]
    """Water that the cooler of the facility water evaporates and drains; part of ``water_l``."""
    leak_l: Annotated[F64, Quantity("l")]
    """Coolant lost by leaks; part of ``water_l``."""


@dataclass
class LimitedWork:
    """Work of GPUs with limited power in one step."""

    throttled_tasks: Annotated[F64, Quantity("tasks")]
    """Started work that GPUs at their temperature limit or power cap did not complete; it waits in
    the queue again."""


@dataclass
class CduQuantities:
    """Income, first times and CDUs of coolant loops in one step."""

    heat_income: Annotated[F64, Quantity("currency")]
    """Income from delivered heat, in the currency of the tariff."""
    throttle_s: Annotated[F64, Quantity("s")]
    """Time from the start of the step until a GPU first reaches its temperature limit; -1 if none
    does."""
    trip_s: Annotated[F64, Quantity("s")]
    """Time from the start of the step until a liquid-cooled rack first switches off; -1 if none
    does."""
    cdu_supply_each_c: Annotated[F64, Quantity("C", CDUS)]
    """Temperature of the coolant that each CDU sends to its racks."""
    cdu_flow_m3s: Annotated[F64, Quantity("m3/s", CDUS)]
    """Flow of coolant through each CDU."""
    cdu_heat_w: Annotated[F64, Quantity("W", CDUS)]
    """Heat that each CDU transfers to the facility water."""
    cdu_valve: Annotated[F64, Quantity("1", CDUS)]
    """Flow of facility water through each CDU, divided by its design flow."""


@dataclass
class LiquidQuantities(CduQuantities, LimitedWork, LoopQuantities):
    """Liquid cooling in one step; 0 for data centers and racks without it."""

    rack_junction_c: Annotated[F64, Quantity("C", RACKS)]
    """Junction temperature of the GPUs of each rack; 0 for racks without GPUs on cold plates."""
    rack_liquid_w: Annotated[F64, Quantity("W", RACKS)]
    """Heat of each rack that goes into the coolant; 0 for air-cooled racks."""


@dataclass
class CracQuantities:
    """Airflow, fan power and heat load of the CRAC units of B data centers in one step."""

    crac_flow_m3s: Annotated[F64, Quantity("m3/s")]
    """Airflow of the CRAC units."""
    crac_fan_w: Annotated[F64, Quantity("W")]
    """Electric power of the CRAC fans."""
    return_c: Annotated[F64, Quantity("C")]
    """Temperature of the air that returns to the CRAC units."""
    cooling_load_w: Annotated[F64, Quantity("W")]
    """Heat that the CRAC units have to remove from the room."""


@dataclass
class AirIndices:
    """Air-management indices of the halls in one step."""

    over_27_mean_k: Annotated[F64, Quantity("K")]
    """Excess of the inlet temperature above 27 C, mean over the servers; multiplied by hours it
    gives degree-hours."""
    shi: Annotated[F64, Quantity("1")]
    """Supply heat index (SHI), 0 if every inlet receives pure supply air; see
    ``hall.air_metrics``."""
    rti_pct: Annotated[F64, Quantity("%")]
    """Return temperature index (RTI); above 100 % recirculation exceeds bypass, below 100 % bypass
    exceeds recirculation."""
    rci_hi_pct: Annotated[F64, Quantity("%")]
    """Rack cooling index at the high end (RCI HI), 100 if no inlet is above 27 C."""
    rci_lo_pct: Annotated[F64, Quantity("%")]
    """Rack cooling index at the low end (RCI LO), 100 if no inlet is below 18 C."""


@dataclass
class PlantQuantities:
    """Heat flows, water temperatures and power of the cooling plants in one step."""

    heat_removed_w: Annotated[F64, Quantity("W")]
    """Heat that the cooling plant removes from the CRAC units."""
    economiser_w: Annotated[F64, Quantity("W")]
    """Heat that the economiser, the dry cooler or outdoor air removes without the chiller."""
    chiller_load_w: Annotated[F64, Quantity("W")]
    """Heat that the chiller removes from the chilled water."""
    chiller_w: Annotated[F64, Quantity("W")]
    """Electric power of the chiller."""
    rejected_w: Annotated[F64, Quantity("W")]
    """Heat rejected to the outdoors."""
    chilled_water_c: Annotated[F64, Quantity("C")]
    """Temperature of the chilled water supply; in transient halls at the end of the step, with the
    warming by heat that the plant did not remove."""
    condenser_water_c: Annotated[F64, Quantity("C")]
    """Temperature of the water leaving the cooling tower, or of the outdoor air that cools an
    air-cooled condenser."""
    tower_fan_w: Annotated[F64, Quantity("W")]
    """Electric power of the fans of the cooling tower, the dry cooler or the outdoor air intake."""
    chilled_pump_w: Annotated[F64, Quantity("W")]
    """Electric power of the chilled-water pumps."""
    condenser_pump_w: Annotated[F64, Quantity("W")]
    """Electric power of the condenser-water pumps, or of the pumps of the dry cooler's loop."""


@dataclass
class WaterSideResult(PlantQuantities):
    """One step of the plants of B data centers, with flows that make-up water is computed from."""

    tower_range_k: F64
    """Entering less leaving water temperature of the tower, in K, (B,)."""
    tower_water_kg_s: F64
    """Condenser water flow, in kg/s, (B,)."""
    tower_airflow_m3s: F64
    """Airflow of the tower, in m3/s, (B,)."""
    humidifier_kg_s: F64
    """Water that evaporates into outdoor air on its way into the hall, in kg/s, (B,)."""

    def scaled(self, share: F64) -> WaterSideResult:
        """Means over a step during a share of which, (B,), the plant ran.

        Powers and flows are multiplied with the share; temperatures stay those while it ran.
        """
        flows = [f.name for f in fields(self) if f.name.endswith(("_w", "_kg_s", "_m3s"))]
        return replace(self, **{name: getattr(self, name) * share for name in flows})


@dataclass
class RoomQuantities:
    """Heat that stays in the room, or is recovered from it, in one step."""

    unmet_w: Annotated[F64, Quantity("W")]
    """Part of the cooling load that the plant does not remove. It stays in the room or, in
    transient halls, in the chilled water."""
    recovered_w: Annotated[F64, Quantity("W")]
    """Heat stored in room and chilled water by earlier steps that spare cooling capacity
    removes."""
    room_heat_kwh: Annotated[F64, Quantity("kWh")]
    """Heat stored in the room at the end of the step, relative to the room at the setpoint; in
    transient halls with that in the chilled water and its tank."""
    water_heat_kwh: Annotated[F64, Quantity("kWh")]
    """Part of ``room_heat_kwh`` in the chilled water, with that of a mixed buffer tank."""
    tank_heat_kwh: Annotated[F64, Quantity("kWh")]
    """Part of ``room_heat_kwh`` in a stratified buffer tank."""


@dataclass
class WaterQuantities:
    """Water consumption of cooling towers and humidifiers in one step."""

    evaporation_l: Annotated[F64, Quantity("l")]
    """Water evaporated by the cooling tower, or by the humidifier of the outdoor air."""
    drift_l: Annotated[F64, Quantity("l")]
    """Water that leaves the cooling tower as droplets."""
    blowdown_l: Annotated[F64, Quantity("l")]
    """Water drained to limit the concentration of salts."""
    water_l: Annotated[F64, Quantity("l")]
    """Make-up water: evaporation, drift and blowdown."""


@dataclass
class BatteryQuantities:
    """Battery quantities of one step."""

    stored_kwh: Annotated[F64, Quantity("kWh")]
    """Energy in the battery at the end of the step."""
    charge_kwh: Annotated[F64, Quantity("kWh")]
    """Energy that the battery draws from the bus, with that of its standby."""
    discharge_kwh: Annotated[F64, Quantity("kWh")]
    """Energy that the battery delivers to the bus, less that of its standby."""
    battery_loss_kwh: Annotated[F64, Quantity("kWh")]
    """Energy lost in the battery and its inverter, with that of its standby."""


@dataclass
class BatteryResult(BatteryQuantities):
    """One step of the batteries of B data centers."""

    grid_kwh: F64
    """Energy to buy, load plus charge minus discharge, in kWh, (B,), at least 0."""


@dataclass
class EnergyQuantities:
    """Power, energy, emissions and cost of B data centers in one step."""

    it_w: Annotated[F64, Quantity("W")]
    """IT power: servers including their fans."""
    hvac_w: Annotated[F64, Quantity("W")]
    """Electric power of the HVAC devices that ``hvac.total_of`` lists."""
    ups_loss_w: Annotated[F64, Quantity("W")]
    """Power lost in the UPS."""
    distribution_loss_w: Annotated[F64, Quantity("W")]
    """Power lost in transformers, PDUs and wiring downstream of the UPS."""
    overhead_w: Annotated[F64, Quantity("W")]
    """Facility power in addition to IT: ``hvac_w``, and with ``electrical.losses: counted`` also
    the losses of UPS and distribution."""
    soc: Annotated[F64, Quantity("1")]
    """State of charge of the battery at the end of the step, 0..1."""
    it_kwh: Annotated[F64, Quantity("kWh")]
    """IT energy."""
    hvac_kwh: Annotated[F64, Quantity("kWh")]
    """HVAC energy."""
    grid_kwh: Annotated[F64, Quantity("kWh")]
    """Energy bought from the grid."""
    grid_overload_kwh: Annotated[F64, Quantity("kWh")]
    """Energy bought above the limit of the grid connection; part of ``grid_kwh``."""
    unserved_kwh: Annotated[F64, Quantity("kWh")]
    """Energy demand that neither grid nor battery covers in an outage, during the powered part of
    the step (see ``powered``)."""
    carbon_g: Annotated[F64, Quantity("g CO2e")]
    """Emissions of the energy bought from the grid."""
    energy_cost: Annotated[F64, Quantity("currency")]
    """Cost of the energy bought, without demand charges, in the currency of the tariff."""


@dataclass
class RackQuantities:
    """Status of the racks at the end of a step, and their executed and lost work."""

    executed_tasks: Annotated[F64, Quantity("tasks")]
    """Work completed in the step."""
    lost_tasks: Annotated[F64, Quantity("tasks")]
    """Started work that found no server, or was lost when its rack tripped."""
    throttled_racks: Annotated[F64, Quantity("racks")]
    """Number of throttled racks at the end of the step."""
    tripped_racks: Annotated[F64, Quantity("racks")]
    """Number of tripped racks, which are off, at the end of the step."""
    rack_status: Annotated[Status, Quantity("", RACKS)]
    """Status of each rack at the end of the step: 0 normal, 1 throttled, 2 tripped."""


# More than 30 attributes are stored faster in slots than in a dict.
@dataclass(slots=True)
class StepResult(
    RackQuantities,
    EnergyQuantities,
    BatteryQuantities,
    WaterQuantities,
    RoomQuantities,
    PlantQuantities,
    AirIndices,
    CracQuantities,
    LiquidQuantities,
    HallQuantities,
    SetpointQuantities,
    QueueQuantities,
    TransferQuantities,
    WorkQuantities,
    CommandQuantities,
    SiteQuantities,
):
    """Every quantity of one step.

    Powers are means over the step, energies and volumes are totals of the step. 1 task is the work
    of 1 % of a data center's capacity during one step. The arrays are views of a few larger
    buffers: copy an array before storing it for long, or the whole buffer stays in memory.
    """

    # The bases are listed in reverse, because a dataclass orders fields from the last base on.
    step: int
    """Index of the step, 0 at reset."""
    step_h: float
    """Length of the step, in h."""
    within_limits: F64
    """1 for data centers within the physical limits, (B,). 0 for data centers beyond them, which
    only simulators with ``limits="flag"`` return: their air is that of an earlier step."""
    unit_flow_m3s: Annotated[F64, Quantity("m3/s", CRAC_UNITS)]
    """Airflow of each CRAC unit."""

    @property
    def rack_power_w(self) -> Reals:
        """IT power of each rack (servers including their fans), in W, (R,)."""
        return self.rack_cpu_w + self.rack_fan_w

    @property
    def facility_kwh(self) -> F64:
        """Energy of IT and of ``overhead_w`` in the step, without the battery, in kWh, (B,)."""
        return self.it_kwh + self.overhead_w * self.step_h / 1e3

    @property
    def reuse_kwh(self) -> F64:
        """Heat delivered for reuse in the step, in kWh, (B,)."""
        return self.reuse_w * self.step_h / 1e3

    @property
    def erf(self) -> F64:
        """Energy reuse factor (ERF), delivered heat / facility energy, (B,); 0 without energy."""
        return _ratio(self.reuse_w, self.it_w + self.overhead_w, 0.0)

    @property
    def ere(self) -> F64:
        """Energy reuse effectiveness (ERE), (facility - delivered heat) / IT, (B,).

        It is inf without IT power.
        """
        return _ratio(self.it_w + self.overhead_w - self.reuse_w, self.it_w, np.inf)

    @property
    def wue(self) -> F64:
        """Water usage effectiveness (WUE), make-up water / IT energy, in l/kWh, (B,).

        It is inf without IT power.
        """
        return _ratio(self.water_l, self.it_kwh, np.inf)

    @property
    def liquid_share(self) -> F64:
        """Share of the IT power whose heat goes into coolant, (B,); 0 without IT power."""
        return _ratio(self.liquid_heat_w, self.it_w, 0.0)

    @property
    def rhi(self) -> F64:
        """Return heat index (RHI), 1 - SHI, (B,)."""
        return 1.0 - self.shi

    @property
    def pue(self) -> F64:
        """Power usage effectiveness, (IT + overhead) / IT, (B,); inf without IT power."""
        return 1.0 + _ratio(self.overhead_w, self.it_w, np.inf)

    @property
    def tue(self) -> F64:
        """Total usage effectiveness (TUE), (IT + overhead) / (IT - server fans), (B,).

        Losses in the power supplies of servers are not known and count as used. It is inf without
        IT power.
        """
        return _ratio(self.it_w + self.overhead_w, self.it_w - self.it_fan_w, np.inf)

    def per_dc(self) -> dict[str, F64]:
        """Return all quantities of shape (B,) by name, in the order of ``QUANTITIES``."""
        return dict(zip(QUANTITIES_PER_DC, _values_per_dc(self), strict=True))


def _ratio(part: F64, whole: F64, otherwise: float) -> F64:
    """Return ``part`` divided by ``whole``, or ``otherwise`` where ``whole`` is not positive."""
    has_any = whole > 0
    return np.where(has_any, part / np.where(has_any, whole, 1.0), otherwise)


QUANTITIES: dict[str, Quantity] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(StepResult, include_extras=True).items()
    if get_origin(hint) is Annotated
}
"""Unit and axis of each quantity of ``StepResult``, in the order of its fields."""
QUANTITIES_PER_DC = tuple(n for n, each in QUANTITIES.items() if each.axis == DATA_CENTERS)
"""Names of the quantities of shape (B,), in the order of ``QUANTITIES``."""
_values_per_dc = attrgetter(*QUANTITIES_PER_DC)


@cache
def meanings() -> dict[str, str]:
    """Return the field docstring of each quantity of ``StepResult`` by name."""
    texts: dict[str, str] = {}
    for part in StepResult.__mro__[-2::-1]:
        (declaration,) = ast.parse(inspect.getsource(part)).body
        assert isinstance(declaration, ast.ClassDef)
        for declared, text in pairwise(declaration.body):
            if isinstance(declared, ast.AnnAssign) and isinstance(text, ast.Expr):
                name, docstring = ast.unparse(declared.target), ast.literal_eval(text.value)
                texts[name] = " ".join(docstring.split())
    return {name: texts[name] for name in QUANTITIES}


@dataclass(frozen=True, slots=True)
class ServerLayers:
    """Temperatures and power of every server in one step.

    Servers are ordered by rack, and within a rack by server group.
    """

    inlet_c: Reals
    """Inlet temperature of each server, in C, (S,)."""
    outlet_c: Reals
    """Outlet temperature of each server, in C, (S,)."""
    power_w: Reals
    """Power of each server with its fans, in W, (S,)."""
