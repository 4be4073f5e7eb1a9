"""Actions, state and results of a step, and the array types of the package.

In shapes, B counts data centers, U CRAC units, R racks, G server groups and S servers, those of all
data centers end to end. Dataclasses that every step makes are not frozen, since a frozen one takes
three times as long to make.
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


def joined(*parts: Mapping[str, Any]) -> dict[str, Any]:
    """Values of all parts by name, each of which one part alone may have.

    Raises:
        ValueError: A name that two parts have.
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


DATA_CENTERS, CRAC_UNITS, RACKS = "B", "U", "R"
"""Axes of quantities: an entry per data center, CRAC unit or rack."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """Unit and axis of a quantity of a step, with which its field is annotated.

    The annotated fields of ``StepResult`` are the one table of quantities: columns of run folders,
    their documentation and labels are derived from it (``QUANTITIES``, ``meanings``).
    """

    unit: str
    """Unit; "1" for shares and ratios, "" for counts and numbers of things."""
    axis: str = DATA_CENTERS
    """What the array has an entry for, along its only axis."""


@dataclass
class Exogenous:
    """Weather, grid and demand during one step of B data centers."""

    outdoor_c: Annotated[F64, Quantity("C")]
    """Dry-bulb temperature outside."""
    wet_bulb_c: Annotated[F64, Quantity("C")]
    """Wet-bulb temperature outside."""
    ci_g_per_kwh: Annotated[F64, Quantity("g CO2e/kWh")]
    """Carbon intensity of the grid."""
    demand: Annotated[F64, Quantity("1")]
    """Work that arrives as a share of capacity, 0..1."""
    price_per_kwh: Annotated[F64, Quantity("currency/kWh")]
    """Price of a kWh from the grid, in the currency of the tariff; 0 without prices."""


@dataclass
class SiteQuantities(Exogenous):
    """Conditions of one step on site, with the effects of events."""

    active_events: Annotated[F64, Quantity("")]
    """Number of events that cover the step."""
    grid_up: Annotated[F64, Quantity("1")]
    """1 with grid, 0 in an outage."""
    powered: Annotated[F64, Quantity("1")]
    """Share of the step that the data center has power, 0..1."""
    unit_running: Annotated[F64, Quantity("1", CRAC_UNITS)]
    """1 for CRAC units that run, 0 for those that are down or without power."""


@dataclass
class CommandQuantities:
    """Commands of one step."""

    load_command: Annotated[F64, Quantity("1")]
    """Share of what could be deferred (below 0) or drained (above 0), -1..1."""
    cooling_command: Annotated[F64, Quantity("")]
    """Setpoint steps that were commanded, mean over the CRAC units; 0 where setpoints follow their
    schedule."""
    battery_command: Annotated[F64, Quantity("1")]
    """Share of the battery's power limit, discharged (below 0) or charged, -1..1."""


@dataclass
class WorkQuantities:
    """Work that arrives, starts, waits and leaves in one step."""

    utilisation: Annotated[F64, Quantity("1")]
    """Work that was started, as a share of capacity, including ``lost_tasks``."""
    arrived_tasks: Annotated[F64, Quantity("tasks")]
    """Work that arrived."""
    deferred_tasks: Annotated[F64, Quantity("tasks")]
    """Work that entered the queue."""
    drained_tasks: Annotated[F64, Quantity("tasks")]
    """Work that left the queue on command."""
    due_tasks: Annotated[F64, Quantity("tasks")]
    """Queued work whose deadline had come at the start of the step."""
    overdue_tasks: Annotated[F64, Quantity("tasks")]
    """Due work that did not fit into the step."""
    dropped_tasks: Annotated[F64, Quantity("tasks")]
    """Work that found the queue full; with model ``tasks`` it runs at once, as part of
    ``executed_tasks``."""


@dataclass
class Work(WorkQuantities):
    """Work of one step of B data centers as a workload model decides on it."""

    started_tasks: F64
    """Work that starts, in tasks, (B,)."""
    dequeued_tasks: F64
    """Work that leaves the queue, drained or due, in tasks, (B,)."""


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
    """Air and servers of the halls in one step."""

    supply_c: Annotated[F64, Quantity("C")]
    """Supply air temperature, mean over the CRAC airflow: the setpoint plus the warming of the
    room by unmet cooling."""
    inlet_mean_c: Annotated[F64, Quantity("C")]
    """Mean over the racks of their inlet temperatures."""
    inlet_max_c: Annotated[F64, Quantity("C")]
    """Hottest inlet of a server, in transient halls of any substep."""
    hottest_rack: Annotated[F64, Quantity("")]
    """Rack with the hottest inlet, counted from 0 in its data center."""
    hottest_server: Annotated[F64, Quantity("")]
    """Server with the hottest inlet, counted from 0 at the floor of its rack."""
    outlet_mean_c: Annotated[F64, Quantity("C")]
    """Mean over the racks of their outlet temperatures."""
    cpu_w: Annotated[F64, Quantity("W")]
    """Power of the servers without their fans."""
    it_fan_w: Annotated[F64, Quantity("W")]
    """Power of the server fans."""
    it_airflow_m3s: Annotated[F64, Quantity("m3/s")]
    """Airflow through the servers."""
    thermal_storage_w: Annotated[F64, Quantity("W")]
    """Heat that goes into servers and recirculated air in transient halls."""
    unit_supply_c: Annotated[F64, Quantity("C", CRAC_UNITS)]
    """Supply air temperature of each CRAC unit."""
    rack_cpu_w: Annotated[Reals, Quantity("W", RACKS)]
    """Power of the servers of each rack without their fans."""
    rack_fan_w: Annotated[Reals, Quantity("W", RACKS)]
    """Power of the server fans of each rack."""
    rack_airflow_m3s: Annotated[Reals, Quantity("m3/s", RACKS)]
    """Airflow through each rack."""
    rack_inlet_c: Annotated[Reals, Quantity("C", RACKS)]
    """Inlet of each rack, mean over its servers, weighted by airflow where air recirculates."""
    rack_inlet_max_c: Annotated[Reals, Quantity("C", RACKS)]
    """Hottest inlet of a server of each rack, in transient halls of any substep."""
    rack_outlet_c: Annotated[Reals, Quantity("C", RACKS)]
    """Outlet of each rack."""
    rack_outlet_max_c: Annotated[Reals, Quantity("C", RACKS)]
    """Hottest outlet of a server of each rack, in transient halls of any substep."""


@dataclass
class CracQuantities:
    """Air that the CRAC units of B data centers move, and heat that they take, in one step."""

    crac_flow_m3s: Annotated[F64, Quantity("m3/s")]
    """Airflow of the CRAC units."""
    crac_fan_w: Annotated[F64, Quantity("W")]
    """Electric power of the CRAC fans."""
    return_c: Annotated[F64, Quantity("C")]
    """Temperature of the air that returns to the CRAC units."""
    cooling_load_w: Annotated[F64, Quantity("W")]
    """Heat that the CRAC units are to take from the room."""


@dataclass
class AirIndices:
    """Indices of how well the air of the halls is managed in one step."""

    over_27_mean_k: Annotated[F64, Quantity("K")]
    """Inlet temperature in excess of 27 C, mean over the servers; times hours, degree-hours."""
    shi: Annotated[F64, Quantity("1")]
    """Supply heat index, 0 when all inlets get supply air; see ``hall.air_metrics``."""
    rti_pct: Annotated[F64, Quantity("%")]
    """Return temperature index, above 100 where air recirculates on balance."""
    rci_hi_pct: Annotated[F64, Quantity("%")]
    """Rack cooling index at the high end, 100 without an inlet above 27 C."""
    rci_lo_pct: Annotated[F64, Quantity("%")]
    """Rack cooling index at the low end, 100 without an inlet below 18 C."""


@dataclass
class PlantQuantities:
    """Heat, water temperatures and power of the plants in one step."""

    heat_removed_w: Annotated[F64, Quantity("W")]
    """Heat that the plant takes from the CRAC units."""
    economiser_w: Annotated[F64, Quantity("W")]
    """Heat that economiser, dry cooler or outdoor air takes past the chiller."""
    chiller_load_w: Annotated[F64, Quantity("W")]
    """Heat that the chiller takes off the chilled water."""
    chiller_w: Annotated[F64, Quantity("W")]
    """Electric power of the chiller."""
    rejected_w: Annotated[F64, Quantity("W")]
    """Heat that goes to the outside."""
    chilled_water_c: Annotated[F64, Quantity("C")]
    """Temperature of the chilled water supply."""
    condenser_water_c: Annotated[F64, Quantity("C")]
    """Temperature of the water that leaves the tower, or of the outdoor air that cools the
    condenser."""
    tower_fan_w: Annotated[F64, Quantity("W")]
    """Electric power of the fans of tower, dry cooler or outdoor air."""
    chilled_pump_w: Annotated[F64, Quantity("W")]
    """Electric power of the chilled-water pumps."""
    condenser_pump_w: Annotated[F64, Quantity("W")]
    """Electric power of the pumps of condenser water, or of the dry cooler's loop."""


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
    """Heat that the plants leave in the room or fetch from it in one step."""

    unmet_w: Annotated[F64, Quantity("W")]
    """Cooling load that is not removed and stays in the room."""
    recovered_w: Annotated[F64, Quantity("W")]
    """Heat held by the room earlier that spare capacity removes."""
    room_heat_kwh: Annotated[F64, Quantity("kWh")]
    """Heat held by the room at the end of the step, relative to that at the setpoint."""


@dataclass
class WaterQuantities:
    """Water of towers and humidifiers in one step."""

    evaporation_l: Annotated[F64, Quantity("l")]
    """Water that tower, or humidifier of outdoor air, evaporates."""
    drift_l: Annotated[F64, Quantity("l")]
    """Water that leaves the tower as drops."""
    blowdown_l: Annotated[F64, Quantity("l")]
    """Water that is drained so that salt does not concentrate."""
    water_l: Annotated[F64, Quantity("l")]
    """Make-up water."""


@dataclass
class BatteryQuantities:
    """Batteries in one step."""

    stored_kwh: Annotated[F64, Quantity("kWh")]
    """Energy in the battery at the end of the step."""
    charge_kwh: Annotated[F64, Quantity("kWh")]
    """Energy drawn from the grid into the battery."""
    discharge_kwh: Annotated[F64, Quantity("kWh")]
    """Energy delivered by the battery."""
    battery_loss_kwh: Annotated[F64, Quantity("kWh")]
    """Energy that the battery loses."""


@dataclass
class BatteryResult(BatteryQuantities):
    """One step of the batteries of B data centers."""

    grid_kwh: F64
    """Energy to buy, load plus charge minus discharge, in kWh, (B,), at least 0."""


@dataclass
class EnergyQuantities:
    """Power, energy, emissions and cost of B data centers in one step."""

    it_w: Annotated[F64, Quantity("W")]
    """IT power, servers with their fans."""
    hvac_w: Annotated[F64, Quantity("W")]
    """Electric power of the devices that ``hvac.total_of`` names."""
    ups_loss_w: Annotated[F64, Quantity("W")]
    """Power that the UPS loses."""
    distribution_loss_w: Annotated[F64, Quantity("W")]
    """Power that transformers, PDUs and wiring lose behind the UPS."""
    overhead_w: Annotated[F64, Quantity("W")]
    """Power of the facility besides IT that the energy bought covers: ``hvac_w``, and with
    ``electrical.losses: counted`` the losses of UPS and distribution."""
    soc: Annotated[F64, Quantity("1")]
    """State of charge of the battery at the end of the step, 0..1."""
    it_kwh: Annotated[F64, Quantity("kWh")]
    """IT energy."""
    hvac_kwh: Annotated[F64, Quantity("kWh")]
    """HVAC energy."""
    grid_kwh: Annotated[F64, Quantity("kWh")]
    """Energy bought from the grid."""
    grid_overload_kwh: Annotated[F64, Quantity("kWh")]
    """Energy bought beyond what the grid connection carries; part of ``grid_kwh``."""
    unserved_kwh: Annotated[F64, Quantity("kWh")]
    """Energy that facility and battery lack in an outage while there is power (see
    ``powered``)."""
    carbon_g: Annotated[F64, Quantity("g CO2e")]
    """Emissions of the energy bought."""
    energy_cost: Annotated[F64, Quantity("currency")]
    """Price of the energy bought, without demand charges, in the currency of the tariff."""


@dataclass
class RackQuantities:
    """Status of the racks at the end of a step, and the work that they did and lost."""

    executed_tasks: Annotated[F64, Quantity("tasks")]
    """Work that was done."""
    lost_tasks: Annotated[F64, Quantity("tasks")]
    """Work that had been started and found no server or went down with it."""
    throttled_racks: Annotated[F64, Quantity("racks")]
    """Racks that are throttled at the end of the step."""
    tripped_racks: Annotated[F64, Quantity("racks")]
    """Racks that have tripped and are off at the end of the step."""
    rack_status: Annotated[Status, Quantity("", RACKS)]
    """Status of each rack at the end of the step: 0 normal, 1 throttled, 2 tripped."""


@dataclass
class StepResult(
    RackQuantities,
    EnergyQuantities,
    BatteryQuantities,
    WaterQuantities,
    RoomQuantities,
    PlantQuantities,
    AirIndices,
    CracQuantities,
    HallQuantities,
    SetpointQuantities,
    QueueQuantities,
    WorkQuantities,
    CommandQuantities,
    SiteQuantities,
):
    """Every quantity of one step.

    Powers are means over the step, energies and volumes are totals. 1 task is 1 % of the capacity
    of a data center for one step. Arrays of a step are parts of a few larger ones: copy those that
    are kept for long.
    """

    # A dataclass takes the fields of its last base first.
    step: int
    """Index of the step, 0 at reset."""
    step_h: float
    """Length of the step, in h."""
    unit_flow_m3s: Annotated[F64, Quantity("m3/s", CRAC_UNITS)]
    """Airflow of each CRAC unit."""

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
        """All (B,) quantities by name, in the order of ``QUANTITIES``."""
        return dict(zip(_PER_DC, _values_per_dc(self), strict=True))


QUANTITIES: dict[str, Quantity] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(StepResult, include_extras=True).items()
    if get_origin(hint) is Annotated
}
"""Unit and axis of each quantity of ``StepResult``, in the order of its fields."""
_PER_DC = tuple(name for name, each in QUANTITIES.items() if each.axis == DATA_CENTERS)
_values_per_dc = attrgetter(*_PER_DC)


@cache
def meanings() -> dict[str, str]:
    """Meaning of each quantity of ``StepResult`` by name: the docstrings of its fields."""
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
    """Values of every server in one step; servers follow racks, then groups."""

    inlet_c: Reals
    """Inlet temperature of each server, in C, (S,)."""
    outlet_c: Reals
    """Outlet temperature of each server, in C, (S,)."""
    power_w: Reals
    """Power of each server with its fans, in W, (S,)."""
