"""Arrays that flow through a step. Shapes: B data centers, R racks of all, one row each.

Records that every step makes are not frozen, which would take three times as long to make.
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
Reals = npt.NDArray[np.floating[Any]]


def as_array(values: F64 | float) -> F64:
    """An array of what may be a number; quantities of a compiled stage stay what they are."""
    return np.asarray(values) if isinstance(values, float) else values


def fields_of(values: Any) -> dict[str, Any]:
    """Fields of a dataclass by name."""
    return {f.name: getattr(values, f.name) for f in fields(values)}


class LoadAction(Enum):
    """What to do with delay-tolerant work; the value is the command in -1..1."""

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
    """What the battery does, as a share of its power limit."""

    DISCHARGE = -1
    IDLE = 0
    CHARGE = 1


@dataclass(frozen=True, slots=True)
class Actions:
    """One command per data center, a list or an array; an enum or a number serves all of them.

    Numbers are continuous commands: ``load`` and ``battery`` within -1..1 are shares of what could
    be deferred (negative) or drained, discharged (negative) or charged; ``cooling`` and ``fan`` are
    in steps, may exceed 1 and may have one entry per CRAC unit. ``fan`` is for flow model
    ``controlled`` alone, ``placement`` for policy ``weights``: relative loads of the racks, (R,),
    or of the server groups, (G,), None being all alike.
    """

    load: LoadAction | float | F64 | Sequence[LoadAction] = LoadAction.NEUTRAL
    cooling: CoolAction | float | F64 | Sequence[CoolAction] = CoolAction.HOLD
    battery: BatteryAction | float | F64 | Sequence[BatteryAction] = BatteryAction.IDLE
    fan: FanAction | float | F64 | Sequence[FanAction] = FanAction.HOLD
    placement: F64 | None = None


@dataclass(slots=True)
class Exogenous:
    """What the world does during one step, each (B,)."""

    outdoor_c: F64
    wet_bulb_c: F64
    ci_g_per_kwh: F64
    demand: F64
    """Work that arrives, as a share of capacity, 0..1."""


@dataclass(slots=True)
class State:
    """What is carried from step to step; everything else derives from it.

    Arrays that the models in use do not need are empty.
    """

    step: int
    """Steps done since reset."""
    seed: I64
    """Decides the sampled events, (B,)."""
    start: I64
    """Index of the first step in the year, (B,)."""
    setpoint_c: F64
    """Setpoint of each CRAC unit, (U,)."""
    cooling_run: I64
    """Equal non-zero cooling commands in a row, (U,)."""
    cooling_last: F64
    """Last cooling command, (U,)."""
    fan_speed: F64
    """Controlled speed of each CRAC fan over design speed, (U,)."""
    queue: F64
    """Queued tasks by the step that put them in, oldest first, accumulated, (B, L); read-only."""
    stored_kwh: F64
    """Energy in the battery, (B,)."""
    room_heat_kwh: F64
    """Heat held by the room over that at the setpoint, (B,); below 0 while its air is colder."""
    rack_status: Status
    """0 normal, 1 throttled, 2 tripped, (R,)."""
    group_inlet_c: F64
    """Inlet of each server group in the last step, (G,), for placement by temperature."""
    server_c: Reals
    """Temperature of the servers of each group, (G,), in transient halls, as what follows."""
    mixed_c: Reals
    """Recirculated air before each rack, (R,)."""
    exhaust_c: Reals
    """Outlet temperature times the strength of the rack, (R,)."""
    captured_m3s: Reals
    """Recirculated air that each rack takes in, (R,)."""
    need_m3s: F64
    """Supply air that the racks ask of each CRAC unit, (U,)."""
    following: F64
    """Airflow of the servers over that at the design point, for each CRAC unit, (U,)."""


@dataclass(slots=True)
class StepResult:
    """Every quantity of one step, (B,) unless stated; powers are means over the step.

    Energy units: kWh per step. 1 task is 1 % of the data center's capacity for one step. Arrays of
    a step are parts of a few larger ones: whoever keeps some for long had better copy them.
    """

    step: int
    """Index of the step, 0 at reset."""
    step_h: float
    """Length of the step."""
    outdoor_c: F64
    wet_bulb_c: F64
    ci_g_per_kwh: F64
    demand: F64
    load_command: F64
    cooling_command: F64
    battery_command: F64

    utilisation: F64
    """Work that was started, as a share of capacity; ``lost_tasks`` of it went down."""
    arrived_tasks: F64
    executed_tasks: F64
    deferred_tasks: F64
    """Work that entered the queue."""
    drained_tasks: F64
    """Work that left the queue on command."""
    due_tasks: F64
    """Queued work whose deadline has come at the start of the step."""
    overdue_tasks: F64
    """Due work that did not fit into this step."""
    dropped_tasks: F64
    lost_tasks: F64
    """Work that had been started and went down with its servers."""
    queue_tasks: F64
    """Work in the queue at the end of the step."""
    oldest_age_h: F64
    mean_age_h: F64

    setpoint_c: F64
    """Mean over the CRAC units."""
    supply_c: F64
    """CRAC supply air: the setpoint plus what unmet cooling has warmed the room by."""
    inlet_mean_c: F64
    """Mean over racks of any size, as ``outlet_mean_c``."""
    inlet_max_c: F64
    hottest_rack: F64
    """Rack with the hottest inlet, counted from 0 in its data center."""
    hottest_server: F64
    """Server with the hottest inlet, counted from the floor of its rack."""
    over_27_mean_k: F64
    """Mean over the servers of what their inlets exceed 27 C by; times hours, degree-hours."""
    shi: F64
    """Supply heat index, 0 when all inlets get supply air; see ``air_metrics``."""
    rti_pct: F64
    """Return temperature index; above 100 air recirculates on balance."""
    rci_hi_pct: F64
    """Rack cooling index at the high end; 100 is no inlet above 27 C."""
    rci_lo_pct: F64
    throttled_racks: F64
    """At the end of the step, as the next."""
    tripped_racks: F64
    outlet_mean_c: F64
    cpu_w: F64
    it_fan_w: F64
    it_w: F64
    it_airflow_m3s: F64
    crac_flow_m3s: F64
    return_c: F64
    cooling_load_w: F64
    """Heat that the CRAC units take from the room."""

    chilled_water_c: F64
    condenser_water_c: F64
    """Water that leaves the tower."""
    economiser_w: F64
    chiller_load_w: F64
    unmet_w: F64
    """Cooling load beyond the plant's capacity; it stays in the room."""
    recovered_w: F64
    """Heat stored earlier that spare capacity removes."""
    heat_removed_w: F64
    rejected_w: F64
    """Heat that the tower gives to the outside."""
    room_heat_kwh: F64
    """As in ``State``, at the end of the step."""
    thermal_storage_w: F64
    """Heat that went into servers and recirculated air (transient)."""
    chiller_w: F64
    tower_fan_w: F64
    chilled_pump_w: F64
    condenser_pump_w: F64
    crac_fan_w: F64
    hvac_w: F64
    """Sum of the devices that ``hvac.total_of`` names."""

    evaporation_l: F64
    drift_l: F64
    blowdown_l: F64
    water_l: F64
    """Make-up water."""

    stored_kwh: F64
    soc: F64
    charge_kwh: F64
    """Drawn from the grid into the battery."""
    discharge_kwh: F64
    """Delivered by the battery."""
    battery_loss_kwh: F64
    it_kwh: F64
    hvac_kwh: F64
    grid_kwh: F64
    unserved_kwh: F64
    """What facility and battery lacked in an outage while they had power, see ``powered``."""
    carbon_g: F64
    grid_up: F64
    """1 with grid, 0 in an outage."""
    powered: F64
    """Share of the step that the data center had power."""

    unit_setpoint_c: F64
    """(U,), as the other unit arrays."""
    unit_supply_c: F64
    unit_flow_m3s: F64
    unit_running: F64
    """1 for CRAC units that run, 0 for those that are down."""
    rack_status: Status
    """0 normal, 1 throttled, 2 tripped, (R,)."""
    rack_cpu_w: Reals
    """(R,), as the other rack arrays."""
    rack_fan_w: Reals
    rack_airflow_m3s: Reals
    rack_inlet_c: Reals
    rack_inlet_max_c: Reals
    rack_outlet_c: Reals

    @property
    def rack_power_w(self) -> Reals:
        """IT power per rack, (R,)."""
        return self.rack_cpu_w + self.rack_fan_w

    @property
    def facility_kwh(self) -> F64:
        """IT and HVAC energy, without the battery, (B,)."""
        return self.it_kwh + self.hvac_kwh

    @property
    def rhi(self) -> F64:
        """Return heat index, 1 - SHI, (B,)."""
        return 1.0 - self.shi

    @property
    def pue(self) -> F64:
        """(IT + HVAC) / IT, dimensionless, (B,); inf without IT power."""
        some = self.it_w > 0
        return np.where(some, 1.0 + self.hvac_w / np.where(some, self.it_w, 1.0), np.inf)

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
    """Per-server values of one step, each (S,); server order follows racks, then groups."""

    inlet_c: Reals
    outlet_c: Reals
    power_w: Reals
