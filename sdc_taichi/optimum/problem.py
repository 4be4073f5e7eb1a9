"""The planning problem of one data center over T steps, in the numbers that planners need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sdc_taichi.types import F64

Agent = Literal["load", "cooling", "battery"]
AGENTS: tuple[Agent, ...] = ("load", "cooling", "battery")
"""What a plan may move, by the names of the fields of ``Actions``."""
RAMP_K = 2.0
"""Largest change of the setpoint in a step, in K, as that of environments by default."""


@dataclass(frozen=True, slots=True)
class FacilityTable:
    """What a step costs by utilisation and setpoint: T steps, I utilisations, J setpoints.

    Values are those of the simulator at constant utilisation and setpoint in the weather of each
    step. Between utilisations they are read linearly.
    """

    utilisation: F64
    """Utilisations, rising from 0 to 1, (I,)."""
    setpoint_c: F64
    """Setpoints, rising in equal steps, in C, (J,)."""
    facility_kwh: F64
    """Energy of the facility without its battery, in kWh, (T, I, J)."""
    water_l: F64
    """Make-up water, in l, (T, I, J)."""
    inlet_max_c: F64
    """Hottest inlet of a server, in C, (T, I, J)."""
    unmet_w: F64
    """Cooling load that stays in the room, in W, (T, I, J); inf where racks would throttle or
    results are beyond what is physical."""


@dataclass(frozen=True, slots=True)
class FlexibleWork:
    """Work that arrives over T steps, and what of it may wait; in tasks, 1 % of a full step."""

    arrived_tasks: F64
    """Work that arrives, (T,)."""
    idle_tasks: F64
    """Work that is done under idle commands, (T,)."""
    most_deferred_tasks: F64
    """Most of it that can be deferred, (T,)."""
    most_executed_tasks: F64
    """Most work that a step can do, (T,)."""
    queue_limit_tasks: float
    """Longest queue; inf without a limit."""
    deadline_steps: int | None
    """Steps after which deferred work has to run; None is never."""
    model: str
    """Name of the model of work: ``fluid`` or ``tasks``."""
    most_dropped_tasks: float = 0.0
    """Most work that may be dropped over the scored steps, as under idle commands."""


@dataclass(frozen=True, slots=True)
class Storage:
    """A battery, in the parameters of ``plant.battery``."""

    model: str
    """Name of the battery model: ``clc``, ``paper`` or ``released``."""
    capacity_kwh: float
    """Capacity, in kWh."""
    stored_kwh: float
    """Energy stored before the first step, in kWh."""
    charge_efficiency: float
    """Energy stored per energy drawn."""
    discharge_factor: float
    """Energy taken from the store per energy delivered."""
    charge_limit_c_rate: float
    """Largest rate into the store, in capacities per hour."""
    discharge_limit_c_rate: float
    """Largest rate out of the store, in capacities per hour."""
    upper_u_h: float
    """Rise of the highest stored energy with the charge power, in h."""
    upper_v: float
    """Highest stored energy without charge power, over capacity."""
    lower_u_h: float
    """Rise of the lowest stored energy with the discharge power, in h."""
    lower_v: float
    """Lowest stored energy without discharge power, over capacity."""


@dataclass(frozen=True, slots=True)
class BilledMonth:
    """A month, or the part of it that is scored, whose highest power a bill charges for."""

    first: int
    """First step of the plan that counts."""
    end: int
    """First step after it that does not."""
    weight_per_kw: float
    """Weight of each kW of the highest mean power of a step."""


@dataclass(frozen=True, slots=True)
class Ends:
    """What a plan starts from and has to leave, where it is not the state before the first step.

    Without ``Ends`` a plan leaves at least the stored energy and at most the queue that there were
    at the first scored step.
    """

    start_kwh: float
    """Energy stored at the first scored step, in kWh."""
    start_tasks: float
    """Work that waits at the first scored step, in tasks, of any age."""
    end_kwh: float
    """Least energy stored at the end, in kWh."""
    end_tasks: float
    """Most work that waits at the end, in tasks."""


@dataclass(frozen=True, slots=True)
class Problem:
    """The planning problem of one data center over T steps."""

    name: str
    """Name of the data center."""
    step_h: float
    """Length of a step, in h."""
    agents: tuple[Agent, ...]
    """What the plan may move; the rest does what it does under idle commands."""
    table: FacilityTable
    """Energy, water and inlets of each step."""
    kwh_weight: F64
    """Weight of a kWh bought in each step, (T,); 0 in steps that are not scored."""
    litre_weight: float
    """Weight of a litre of make-up water."""
    months: tuple[BilledMonth, ...]
    """Months with a demand charge."""
    work: FlexibleWork
    """Work to do."""
    storage: Storage
    """The battery; of capacity 0 where there is none."""
    grid_limit_kw: float
    """Power beyond which the battery does not charge, in kW; inf without a limit."""
    inlet_limit_c: float
    """Highest inlet that a plan may cause where it has a choice, in C; inf without a limit."""
    idle_setpoint_c: F64
    """Setpoint of each step under idle commands, in C, (T,)."""
    setpoint_c: float
    """Setpoint before the first step, in C."""
    ramp_k: float
    """Largest change of the setpoint between two steps, in K."""
    scored_from: int
    """First step that is scored."""

    @property
    def steps(self) -> int:
        """Number of steps, T."""
        return len(self.kwh_weight)


@dataclass(frozen=True, slots=True)
class Plan:
    """What a data center is to do in T steps."""

    executed_tasks: F64
    """Work to do, in tasks, (T,)."""
    setpoint_c: F64
    """Setpoint, in C, (T,)."""
    charge_kwh: F64
    """Energy to draw into the battery, in kWh, (T,)."""
    discharge_kwh: F64
    """Energy to deliver from the battery, in kWh, (T,)."""
