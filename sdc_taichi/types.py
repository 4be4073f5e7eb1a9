"""Actions, state and results of a step, and the array types of the package.

In shapes, B counts data centers, U CRAC units, R racks, G server groups and S servers, those of all
data centers end to end. Dataclasses that every step makes are not frozen, which would take three
times as long to make.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import Enum
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
Values = F64 | float
"""An array, or one number for all of its entries."""
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
Status = npt.NDArray[np.int8]
"""Status of racks, see ``hall.protection``."""
Reals = npt.NDArray[np.floating[Any]]
"""Real numbers in the precision of the server kernels."""


def as_array(values: F64 | float) -> F64:
    """An array of what may be a number; quantities of a compiled stage stay what they are."""
    return np.asarray(values) if isinstance(values, float) else values


def fields_of(values: Any) -> dict[str, Any]:
    """Fields of a dataclass by name."""
    return {f.name: getattr(values, f.name) for f in fields(values)}


class LoadAction(Enum):
    """Commands for delay-tolerant work; the values are commands in -1..1."""

    DEFER = -1
    NEUTRAL = 0
    DRAIN = 1


class CoolAction(Enum):
    """How to move the CRAC setpoint, in steps of ``hvac.setpoint.step_k``."""

    LOWER = -1
    HOLD = 0
    RAISE = 1


class FanAction(Enum):
    """How to move the CRAC fan speed, in steps of ``hvac.crac.fan_step``."""

    LOWER = -1
    HOLD = 0
    RAISE = 1


class BatteryAction(Enum):
    """Commands of the battery, as shares of its power limit."""

    DISCHARGE = -1
    IDLE = 0
    CHARGE = 1


@dataclass(frozen=True, slots=True)
class Actions:
    """Commands of one step.

    A command is an enum or a number for all data centers, or a list or an array with one entry for
    each of them. Numbers are continuous commands.
    """

    load: LoadAction | float | F64 | Sequence[LoadAction] = LoadAction.NEUTRAL
    """Share of what can be deferred (below 0) or drained (above 0), -1..1, () or (B,)."""
    cooling: CoolAction | float | F64 | Sequence[CoolAction] | None = None
    """Steps of ``hvac.setpoint.step_k`` by which setpoints move, a number within -1e6..1e6, (),
    (B,) or (U,); None follows ``hvac.setpoint.schedule_c``, and holds where there is none."""
    battery: BatteryAction | float | F64 | Sequence[BatteryAction] = BatteryAction.IDLE
    """Share of the battery's power limit, discharged (below 0) or charged, -1..1, () or (B,)."""
    fan: FanAction | float | F64 | Sequence[FanAction] = FanAction.HOLD
    """Steps of ``hvac.crac.fan_step`` by which CRAC fan speeds move, a number within -1e6..1e6, (),
    (B,) or (U,); for flow model ``controlled`` alone."""
    placement: F64 | None = None
    """Relative load of each rack, (R,), or server group, (G,); None loads all alike; for policy
    ``weights`` alone."""


@dataclass(slots=True)
class Exogenous:
    """Weather, grid and demand during one step of B data centers."""

    outdoor_c: F64
    """Dry-bulb temperature outside, in C, (B,)."""
    wet_bulb_c: F64
    """Wet-bulb temperature outside, in C, (B,)."""
    ci_g_per_kwh: F64
    """Carbon intensity of the grid, in g CO2e/kWh, (B,)."""
    demand: F64
    """Work that arrives as a share of capacity, 0..1, (B,)."""
    price_per_kwh: F64
    """Price of a kWh from the grid, in the currency of the tariff, (B,); 0 without prices."""


@dataclass(slots=True)
class State:
    """Values that are carried from step to step; everything else derives from them.

    Arrays that the models in use do not need are empty.
    """

    step: int
    """Steps done since reset."""
    seed: I64
    """Seed of the sampled events of each data center, (B,)."""
    start: I64
    """Index of the first step in the year, (B,)."""
    setpoint_c: F64
    """Setpoint of each CRAC unit, in C, (U,)."""
    cooling_run: I64
    """Equal cooling commands in a row that each CRAC unit has had, (U,)."""
    cooling_last: F64
    """Last cooling command of each CRAC unit, in steps, nan before the first, (U,)."""
    fan_speed: F64
    """Controlled speed of each CRAC fan over full speed, 0..1, (U,)."""
    queue: F64
    """Tasks in the queue by the step that put them in, oldest first, accumulated, (B, L) with L
    the steps that a queue tells apart; read-only."""
    stored_kwh: F64
    """Energy in the battery, in kWh, (B,)."""
    room_heat_kwh: F64
    """Heat held by the room over that at the setpoint, in kWh, below 0 while its air is colder,
    (B,)."""
    rack_status: Status
    """Status of each rack: 0 normal, 1 throttled, 2 tripped, (R,)."""
    restart_wait_min: F64
    """Time for which each tripped rack has been able to restart, in min, (R,); where racks protect
    themselves."""
    group_inlet_c: F64
    """Inlet of each server group in the last step, in C, (G,); for placement by temperature."""
    server_c: Reals
    """Temperature of the servers of each group, in C, (G,); for transient halls."""
    mixed_c: Reals
    """Temperature of the recirculated air before each rack, in C, (R,); for transient halls."""
    exhaust_c: Reals
    """Outlet temperature of each rack times the strength of its exhaust, in C, (R,); for transient
    halls."""
    captured_m3s: Reals
    """Recirculated air that each rack takes in, in m3/s, (R,); for transient halls."""
    need_m3s: F64
    """Supply air that the racks ask of each CRAC unit, in m3/s, (U,); for transient halls."""
    following: F64
    """Fan speed of each CRAC unit over full speed that would just cover the need, (U,); for
    transient halls."""
    supply_excess_k: F64
    """Supply air of each CRAC unit over its setpoint and what the room is warmed by, in K, (U,);
    for transient halls."""


@dataclass(slots=True)
class StepResult:
    """Every quantity of one step.

    Powers are means over the step, energies and volumes are totals. 1 task is 1 % of the capacity
    of a data center for one step. Arrays of a step are parts of a few larger ones: whoever keeps
    some for long had better copy them.
    """

    step: int
    """Index of the step, 0 at reset."""
    step_h: float
    """Length of the step, in h."""
    outdoor_c: F64
    """Dry-bulb temperature outside, in C, (B,)."""
    wet_bulb_c: F64
    """Wet-bulb temperature outside, in C, (B,)."""
    ci_g_per_kwh: F64
    """Carbon intensity of the grid, in g CO2e/kWh, (B,)."""
    demand: F64
    """Work that arrives as a share of capacity, 0..1, (B,)."""
    active_events: F64
    """Number of events that cover the step, (B,)."""
    price_per_kwh: F64
    """Price of a kWh from the grid, in the currency of the tariff, (B,)."""
    load_command: F64
    """Share of what could be deferred (below 0) or drained (above 0), -1..1, (B,)."""
    cooling_command: F64
    """Steps by which the setpoints were to move, mean over the CRAC units, (B,); 0 where they
    follow their schedule."""
    battery_command: F64
    """Share of the battery's power limit, discharged (below 0) or charged, -1..1, (B,)."""

    utilisation: F64
    """Work that was started, as a share of capacity, including ``lost_tasks``, (B,)."""
    arrived_tasks: F64
    """Work that arrived, in tasks, (B,)."""
    executed_tasks: F64
    """Work that was done, in tasks, (B,)."""
    deferred_tasks: F64
    """Work that entered the queue, in tasks, (B,)."""
    drained_tasks: F64
    """Work that left the queue on command, in tasks, (B,)."""
    due_tasks: F64
    """Queued work whose deadline had come at the start of the step, in tasks, (B,)."""
    overdue_tasks: F64
    """Due work that did not fit into the step, in tasks, (B,)."""
    dropped_tasks: F64
    """Work that found the queue full, in tasks, (B,); with model ``tasks`` it runs at once, as part
    of ``executed_tasks``."""
    lost_tasks: F64
    """Work that had been started and found no server or went down with it, in tasks, (B,)."""
    queue_tasks: F64
    """Work in the queue at the end of the step, in tasks, (B,)."""
    oldest_age_h: F64
    """Age of the oldest work in the queue at the end of the step, in h, (B,)."""
    mean_age_h: F64
    """Mean age of the work in the queue at the end of the step, in h, (B,)."""

    setpoint_c: F64
    """Supply air setpoint, mean over the CRAC units, in C, (B,)."""
    supply_c: F64
    """Supply air temperature, the setpoint plus what unmet cooling has warmed the room by, mean
    over the CRAC airflow, in C, (B,)."""
    inlet_mean_c: F64
    """Mean inlet of each rack, plain mean over the racks, in C, (B,)."""
    inlet_max_c: F64
    """Hottest inlet of a server, in C, (B,)."""
    hottest_rack: F64
    """Rack with the hottest inlet, counted from 0 in its data center, (B,)."""
    hottest_server: F64
    """Server with the hottest inlet, counted from 0 at the floor of its rack, (B,)."""
    over_27_mean_k: F64
    """Mean over the servers of the inlet temperature in excess of 27 C, in K, (B,); times hours,
    degree-hours."""
    shi: F64
    """Supply heat index, 0 when all inlets get supply air, (B,); see ``hall.air_metrics``."""
    rti_pct: F64
    """Return temperature index, in %, above 100 where air recirculates on balance, (B,)."""
    rci_hi_pct: F64
    """Rack cooling index at the high end, in %, 100 without an inlet above 27 C, (B,)."""
    rci_lo_pct: F64
    """Rack cooling index at the low end, in %, 100 without an inlet below 18 C, (B,)."""
    throttled_racks: F64
    """Racks that are throttled at the end of the step, (B,)."""
    tripped_racks: F64
    """Racks that have tripped and are off at the end of the step, (B,)."""
    outlet_mean_c: F64
    """Outlet of each rack, plain mean over the racks, in C, (B,)."""
    cpu_w: F64
    """Power of the servers without their fans, in W, (B,)."""
    it_fan_w: F64
    """Power of the server fans, in W, (B,)."""
    it_w: F64
    """IT power, servers with their fans, in W, (B,)."""
    it_airflow_m3s: F64
    """Airflow through the servers, in m3/s, (B,)."""
    crac_flow_m3s: F64
    """Airflow of the CRAC units, in m3/s, (B,)."""
    return_c: F64
    """Temperature of the air that returns to the CRAC units, in C, (B,)."""
    cooling_load_w: F64
    """Heat that the CRAC units are to take from the room, in W, (B,)."""

    chilled_water_c: F64
    """Temperature of the chilled water supply, in C, (B,)."""
    condenser_water_c: F64
    """Temperature of the water that leaves the tower, or of the outdoor air that cools the
    condenser, in C, (B,)."""
    economiser_w: F64
    """Heat that economiser, dry cooler or outdoor air takes past the chiller, in W, (B,)."""
    chiller_load_w: F64
    """Heat that the chiller takes off the chilled water, in W, (B,)."""
    unmet_w: F64
    """Cooling load that is not removed and stays in the room, in W, (B,)."""
    recovered_w: F64
    """Heat held by the room earlier that spare capacity removes, in W, (B,)."""
    heat_removed_w: F64
    """Heat that the plant takes from the CRAC units, in W, (B,)."""
    rejected_w: F64
    """Heat that goes to the outside, in W, (B,)."""
    room_heat_kwh: F64
    """Heat held by the room over that at the setpoint at the end of the step, in kWh, (B,)."""
    thermal_storage_w: F64
    """Heat that goes into servers and recirculated air in transient halls, in W, (B,)."""
    chiller_w: F64
    """Electric power of the chiller, in W, (B,)."""
    tower_fan_w: F64
    """Electric power of the fans of tower, dry cooler or outdoor air, in W, (B,)."""
    chilled_pump_w: F64
    """Electric power of the chilled-water pumps, in W, (B,)."""
    condenser_pump_w: F64
    """Electric power of the pumps of condenser water, or of the dry cooler's loop, in W, (B,)."""
    crac_fan_w: F64
    """Electric power of the CRAC fans, in W, (B,)."""
    hvac_w: F64
    """Electric power of the devices that ``hvac.total_of`` names, in W, (B,)."""
    ups_loss_w: F64
    """Power that the UPS loses, in W, (B,)."""
    distribution_loss_w: F64
    """Power that transformers, PDUs and wiring lose behind the UPS, in W, (B,)."""
    overhead_w: F64
    """Power of the facility beside IT that the energy bought covers, in W, (B,): ``hvac_w``, and
    with ``electrical.losses: counted`` the losses of UPS and distribution."""

    evaporation_l: F64
    """Water that tower, or humidifier of outdoor air, evaporates, in l, (B,)."""
    drift_l: F64
    """Water that leaves the tower as drops, in l, (B,)."""
    blowdown_l: F64
    """Water that is drained so that salt does not concentrate, in l, (B,)."""
    water_l: F64
    """Make-up water, in l, (B,)."""

    stored_kwh: F64
    """Energy in the battery at the end of the step, in kWh, (B,)."""
    soc: F64
    """State of charge of the battery at the end of the step, 0..1, (B,)."""
    charge_kwh: F64
    """Energy drawn from the grid into the battery, in kWh, (B,)."""
    discharge_kwh: F64
    """Energy delivered by the battery, in kWh, (B,)."""
    battery_loss_kwh: F64
    """Energy that the battery loses, in kWh, (B,)."""
    it_kwh: F64
    """IT energy, in kWh, (B,)."""
    hvac_kwh: F64
    """HVAC energy, in kWh, (B,)."""
    grid_kwh: F64
    """Energy bought from the grid, in kWh, (B,)."""
    grid_overload_kwh: F64
    """Energy bought beyond what the grid connection carries, in kWh, (B,); part of ``grid_kwh``."""
    unserved_kwh: F64
    """Energy that facility and battery lack in an outage while there is power (see ``powered``), in
    kWh, (B,)."""
    carbon_g: F64
    """Emissions of the energy bought, in g CO2e, (B,)."""
    energy_cost: F64
    """Price of the energy bought, without demand charges, in the currency of the tariff, (B,)."""
    grid_up: F64
    """1 with grid, 0 in an outage, (B,)."""
    powered: F64
    """Share of the step that the data center has power, 0..1, (B,)."""

    unit_setpoint_c: F64
    """Supply air setpoint of each CRAC unit, in C, (U,)."""
    unit_supply_c: F64
    """Supply air temperature of each CRAC unit, in C, (U,)."""
    unit_flow_m3s: F64
    """Airflow of each CRAC unit, in m3/s, (U,)."""
    unit_running: F64
    """1 for CRAC units that run, 0 for those that are down or without power, (U,)."""
    rack_status: Status
    """Status of each rack at the end of the step: 0 normal, 1 throttled, 2 tripped, (R,)."""
    rack_cpu_w: Reals
    """Power of the servers of each rack without their fans, in W, (R,)."""
    rack_fan_w: Reals
    """Power of the server fans of each rack, in W, (R,)."""
    rack_airflow_m3s: Reals
    """Airflow through each rack, in m3/s, (R,)."""
    rack_inlet_c: Reals
    """Inlet of each rack, mean over its servers, by airflow where air recirculates, in C, (R,)."""
    rack_inlet_max_c: Reals
    """Hottest inlet of a server of each rack, in C, (R,)."""
    rack_outlet_c: Reals
    """Outlet of each rack, in C, (R,)."""
    rack_outlet_max_c: Reals
    """Hottest outlet of a server of each rack, in C, (R,); in transient halls the highest of any
    substep."""

    @property
    def rack_power_w(self) -> Reals:
        """IT power of each rack, servers with their fans, in W, (R,)."""
        return self.rack_cpu_w + self.rack_fan_w

    @property
    def facility_kwh(self) -> F64:
        """Energy of IT and ``overhead_w``, without the battery, in kWh, (B,)."""
        return self.it_kwh + self.overhead_w * self.step_h / 1e3

    @property
    def rhi(self) -> F64:
        """Return heat index, 1 - SHI, (B,)."""
        return 1.0 - self.shi

    @property
    def pue(self) -> F64:
        """(IT + overhead) / IT, dimensionless, (B,); inf without IT power."""
        some = self.it_w > 0
        return np.where(some, 1.0 + self.overhead_w / np.where(some, self.it_w, 1.0), np.inf)

    def per_dc(self) -> dict[str, F64]:
        """All (B,) quantities by name, in the order of the fields."""
        return dict(zip(_PER_DC, _values_per_dc(self), strict=True))


_PER_DC = tuple(
    f.name
    for f in fields(StepResult)
    if f.name not in ("step", "step_h") and not f.name.startswith(("rack_", "unit_"))
)
_values_per_dc = attrgetter(*_PER_DC)


@dataclass(frozen=True, slots=True)
class ServerLayers:
    """Values of every server in one step; servers follow racks, then groups."""

    inlet_c: Reals
    """Inlet temperature of each server, in C, (S,)."""
    outlet_c: Reals
    """Outlet temperature of each server, in C, (S,)."""
    power_w: Reals
    """Power of each server with its fans, in W, (S,)."""
