"""Configuration of one data center: one validated, frozen schema for YAML, overrides and Python.

A preset names one model per stage (see docs/presets.md); no stage asks which preset it is in.
Units are part of every field name. An unknown key is an error that suggests the nearest valid one.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from sdc_taichi.errors import ConfigError, suggestion, suggestion_or_valid
from sdc_taichi.plant.chiller import CHILLED_WATER_BOUNDS_C
from sdc_taichi.plant.servers import ServerCurves, linear_curve
from sdc_taichi.year_clock import day_of_year


def _no_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("should be a number")
    return value


def _bounded(value: float) -> float:
    # Beyond any hall, and products of two still fit the kernels' f32.
    if abs(value) > 1e12:
        raise ValueError("should be within -1e12..1e12")
    return value


_Real = Annotated[
    float, BeforeValidator(_no_bool), AfterValidator(_bounded), Field(allow_inf_nan=False)
]
_Whole = Annotated[int, BeforeValidator(_no_bool)]
Positive = Annotated[_Real, Field(gt=0)]
NonNegative = Annotated[_Real, Field(ge=0)]
Share = Annotated[_Real, Field(ge=0, le=1)]
Finite = _Real
Count = Annotated[_Whole, Field(ge=1)]
FileName = Annotated[str, Field(min_length=1)]
Pair = tuple[Finite, Finite]


MOST_RACKS = 10_000_000


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", protected_namespaces=())


class ServerGroup(_Section):
    """Servers of a rack that are alike: computed once, expanded to servers on request.

    ``load_weight`` is relative to the rack's mean (by count) and may reach twice the mean;
    ``inlet_offset_k`` is added to the rack's inlet temperature (height in the rack).
    """

    count: Count
    full_w: Positive
    idle_w: NonNegative
    load_weight: NonNegative = 1.0
    inlet_offset_k: Finite = 0.0

    @model_validator(mode="after")
    def _idle_below_full(self) -> Self:
        if self.idle_w > self.full_w:
            raise ValueError(f"idle_w {self.idle_w:g} must not exceed full_w {self.full_w:g}")
        return self


class LayoutConfig(_Section):
    """Measures of the hall: rows side by side, fronts facing fronts across the cold aisles.

    Row 0 lies along the first wall and faces away from it, row 1 faces row 0, and so on.
    """

    rack_pitch_m: Positive = 0.6
    rack_depth_m: Positive = 1.2
    rack_height_m: Positive = 2.1
    cold_aisle_m: Positive = 1.2
    hot_aisle_m: Positive = 1.2
    end_margin_m: NonNegative = 1.8
    """Between the ends of the rows and the walls."""
    side_margin_m: Positive = 1.2
    """Between the outer rows and the walls."""
    ceiling_m: Positive = 3.6
    containment: Share = 0.0
    """Share of the paths from hot to cold aisles that containment closes."""
    returns: Literal["ceiling", "end_wall"] = "ceiling"
    """Where warm air leaves the hall: grilles above the hot aisles, or the wall at the row ends."""

    @model_validator(mode="after")
    def _racks_fit(self) -> Self:
        if self.ceiling_m <= self.rack_height_m:
            raise ValueError(
                f"ceiling_m {self.ceiling_m:g} must be above rack_height_m {self.rack_height_m:g}"
            )
        return self


class RecirculationConfig(_Section):
    """How exhaust air reaches the inlets of the racks."""

    decay_m: Positive = 3.0
    """Length over which the exhaust of another rack loses weight by a factor of e."""
    cutoff: Annotated[_Real, Field(ge=0, le=0.01)] = 1e-4
    """In halls of more than 64 racks, sources go whose weight is below this share of what a rack
    amid the hall collects; 0 keeps all."""
    matrix_file: FileName | None = None
    """R or D of a CFD study (.npz, .csv) in place of the weights of the layout."""
    matrix_kind: Literal["R", "D"] | None = None
    """What a .csv file holds; an .npz file names it."""
    calibrate: bool = True
    """Take the magnitude from supply_approach_k and the weights alone from the file; False takes
    both from the file, and the approach temperatures are what follows."""

    @model_validator(mode="after")
    def _magnitude_is_known(self) -> Self:
        if not self.calibrate and self.matrix_file is None:
            raise ValueError(
                "calibrate false needs a matrix_file; the layout alone gives weights, no magnitude"
            )
        if self.matrix_kind is not None and self.matrix_file is None:
            raise ValueError(
                f"matrix_kind {self.matrix_kind} needs a matrix_file; valid without one is null"
            )
        return self


class HallConfig(_Section):
    """Rows of racks, their approach temperatures, and how many servers they hold."""

    rows: Count
    racks_per_row: Count
    servers_per_rack: Count | tuple[Count, ...] = 200
    capacity_mw: Positive | None = None
    """IT nameplate to scale the number of servers to; None keeps servers_per_rack."""
    inlet_model: Literal["approach", "recirculation"] = "approach"
    supply_approach_k: NonNegative | tuple[NonNegative, ...]
    supply_approach_limits_k: Pair | None = None
    return_approach_k: Finite | tuple[Finite, ...]
    layout: LayoutConfig = LayoutConfig()
    recirculation: RecirculationConfig = RecirculationConfig()
    height_zones: Count = 5
    """Zones over the height of a rack that share an inlet temperature (recirculation only)."""
    height_gradient: Annotated[_Real, Field(ge=0, lt=1)] = 0.4
    """Recirculated share of the intake at top and bottom over that of the rack, less 1."""
    room_heat_capacity_kj_per_k_per_server: Positive = 2.0
    """Room, coils and what else follows the supply air."""
    air_density_kg_m3: Positive = 1.225
    air_heat_capacity_j_per_kg_k: Positive = 1006.0

    @property
    def racks(self) -> int:
        """Number of racks, rows x racks per row."""
        return self.rows * self.racks_per_row

    def rack_approach_k(self) -> np.ndarray:
        """Supply approach temperature of every rack, within the limits if there are any."""
        given = np.broadcast_to(np.asarray(self.supply_approach_k, np.float64), (self.racks,))
        limits = self.supply_approach_limits_k
        return given.copy() if limits is None else np.asarray(np.clip(given, *limits))

    @model_validator(mode="after")
    def _not_too_many_racks(self) -> Self:
        if self.racks > MOST_RACKS:
            raise ValueError(
                f"rows x racks_per_row is {self.racks:,}; valid is at most {MOST_RACKS:,} racks"
            )
        return self

    @field_validator("supply_approach_limits_k")
    @classmethod
    def _ordered(cls, value: Pair | None) -> Pair | None:
        return _check_ordered(value)

    @model_validator(mode="after")
    def _containment_acts_once(self) -> Self:
        if self.layout.containment > 0 and self.recirculation.matrix_file is not None:
            raise ValueError(
                f"layout.containment {self.layout.containment:g} with recirculation.matrix_file: "
                "a matrix holds what containment does; valid is containment 0"
            )
        return self

    @model_validator(mode="after")
    def _one_entry_per_rack(self) -> Self:
        for name in ("servers_per_rack", "supply_approach_k", "return_approach_k"):
            _check_length(name, getattr(self, name), self.racks)
        return self


class ServerConfig(_Section):
    """Power and airflow of the servers (ITE:AirCooled form of EnergyPlus, curves of Sun 2021)."""

    power_w: Annotated[tuple[Pair, ...], Field(min_length=1)] | None = None
    """(full, idle) power of one server: one pair for all racks or one pair per rack. Without it and
    without groups a server draws 150 W at full load and 10 W idle."""
    groups: tuple[tuple[ServerGroup, ...], ...] | None = None
    """Server groups per rack, or one entry for all, in place of power_w and servers_per_rack."""
    cpu_power_ratio_lb: Pair = (0.01, 1.00)
    cpu_power_ratio_ub: Pair = (0.03, 1.02)
    cpu_slope_offset_per_k: Finite = 0.0
    inlet_range_c: Pair = (16.0, 28.0)
    curve_limit_c: Finite | None = 45.0
    """Power and airflow stay as at this inlet above it (upper limit of ASHRAE class A4); without
    a limit a room that cannot be cooled draws ever more power. None is no limit."""
    fan_airflow_ratio_lb: Pair = (0.01, 0.225)
    fan_airflow_ratio_ub: Pair = (0.225, 1.0)
    fan_model: Literal["linear", "released"] = "linear"
    """Airflow ratio against inlet temperature and load: config curve, or the released scaling."""
    fan_airflow_ratio_limits: Pair | None = None
    """None bounds the ratio at 0 alone: fans never blow backwards."""
    fan_power_exponent: Annotated[_Real, Field(ge=1, le=3)] = 3.0
    fan_full_airflow_m3s: Positive | None = 0.051
    """None takes what the supply and return approach temperatures close on at the design point."""
    fan_reference_ratio: Positive = 1.0
    fan_reference_w: NonNegative = 10.0
    outlet_model: Literal["server", "rack", "released"] = "server"
    heat_capacity_kj_per_k: Positive = 9.75
    """Of one server."""
    heat_exchange_effectiveness: Annotated[_Real, Field(gt=0, le=1)] = 0.95
    """Of a server's mass with the air that passes it."""

    @property
    def power_pairs(self) -> tuple[Pair, ...]:
        """(full, idle) power, one pair for all racks or one per rack."""
        return self.power_w or ((150.0, 10.0),)

    @property
    def curves(self) -> ServerCurves:
        """Coefficients of power and airflow against inlet temperature and load.

        Fan model ``released`` scales slope by 10, offset by 5 and load shift by 5 (shift per 20 %
        of load), as the released SustainDC code does.
        """
        cpu_slope, cpu_offset, cpu_shift = linear_curve(
            self.inlet_range_c, self.cpu_power_ratio_lb, self.cpu_power_ratio_ub
        )
        fan_slope, fan_offset, fan_shift = linear_curve(
            self.inlet_range_c, self.fan_airflow_ratio_lb, self.fan_airflow_ratio_ub
        )
        if self.fan_model == "released":
            fan_slope, fan_offset, fan_shift = 10 * fan_slope, 5 * fan_offset, 5 * fan_shift
        fan_low, fan_high = self.fan_airflow_ratio_limits or (0.0, np.inf)
        return ServerCurves(
            cpu_slope_per_k=cpu_slope + self.cpu_slope_offset_per_k,
            cpu_offset=cpu_offset,
            cpu_shift=cpu_shift,
            fan_slope_per_k=fan_slope,
            fan_offset=fan_offset,
            fan_shift=fan_shift,
            # Fans never blow backwards.
            fan_low=max(fan_low, 0.0),
            fan_high=fan_high,
            fan_reference_ratio=self.fan_reference_ratio,
            fan_exponent=self.fan_power_exponent,
            fan_reference_w=self.fan_reference_w,
            curve_limit_c=np.inf if self.curve_limit_c is None else self.curve_limit_c,
        )

    @field_validator("power_w", mode="before")
    @classmethod
    def _one_pair_is_a_list_of_one(cls, value: Any) -> Any:
        flat = isinstance(value, list | tuple) and not any(
            isinstance(x, list | tuple) for x in value
        )
        return [value] if flat and value else value

    @field_validator("inlet_range_c", "fan_airflow_ratio_limits")
    @classmethod
    def _ordered(cls, value: Pair | None) -> Pair | None:
        return _check_ordered(value)

    @model_validator(mode="after")
    def _idle_below_full(self) -> Self:
        if self.power_w is not None and self.groups is not None:
            raise ValueError("power_w and groups are both given; valid is one, null for the other")
        for rack, (full_w, idle_w) in enumerate(self.power_pairs):
            if not full_w > 0 or not 0 <= idle_w <= full_w:
                raise ValueError(
                    f"power_w entry {rack} is ({full_w:g}, {idle_w:g}); "
                    "valid is (full, idle) with full > 0 and 0 <= idle <= full"
                )
        return self


class SetpointConfig(_Section):
    """CRAC supply setpoint: range, start value and how actions move it."""

    model: Literal["symmetric", "accelerating"] = "symmetric"
    min_c: Finite = 16.0
    max_c: Finite = 23.0
    initial_c: Finite = 18.0
    step_k: Positive = 1.0

    @model_validator(mode="after")
    def _inside(self) -> Self:
        if not self.min_c <= self.initial_c <= self.max_c:
            raise ValueError(
                f"initial_c {self.initial_c:g} must lie within min_c {self.min_c:g} "
                f"and max_c {self.max_c:g}"
            )
        return self


class CracConfig(_Section):
    """CRAC units: airflow per IT watt at design, fan power, who supplies whom."""

    units: Annotated[_Whole, Field(ge=1, le=64)] = 1
    """They stand along both end walls in turn, evenly spread over the rows."""
    unit_shares: tuple[tuple[Share, ...], ...] | None = None
    """Share of each unit in the supply air of each rack, one row per rack, each summing to 1; None
    is by distance."""
    supply_length_m: Positive = 6.0
    """Length over which a unit loses weight in a rack's supply by a factor of e."""
    supply_m3s_per_w: Positive = 5.663e-5
    reference_m3s_per_w: Positive = 9.438e-5
    flow_model: Literal["constant", "follow_servers", "per_watt", "controlled"] = "follow_servers"
    min_flow_ratio: Annotated[_Real, Field(gt=0, le=1)] = 0.6
    fan_step: Annotated[_Real, Field(gt=0, le=1)] = 0.05
    """Fan speed of one action step over design speed (flow model controlled)."""
    coasting_flow_ratio: Annotated[_Real, Field(gt=0, le=1)] = 0.1
    """Airflow through a unit that is down over its design airflow."""
    fan_w_per_m3s: NonNegative = 1000.0
    """Design fan power per design airflow (specific fan power)."""
    released_fan_w: NonNegative = 150.0
    """CRAC_FAN_REF_P of the SustainDC format: one unscaled fan."""


class ChillerConfig(_Section):
    """Chiller model and its reference point."""

    model: Literal[
        "carnot",
        "eir_york",
        "electric_water_cooled",
        "electric_air_cooled",
        "constant_cop",
        "released",
        "paper",
    ] = "carnot"
    reference_cop: Positive = 5.96
    coil_approach_k: Positive = 8.0
    chilled_water_range_k: Positive = 6.0
    min_condenser_c: Finite = 12.78


class TowerConfig(_Section):
    """Cooling tower, condenser water and waterside economiser."""

    model: Literal["yorkcalc", "released", "paper"] = "yorkcalc"
    approach_min_k: Positive = 4.0
    water_range_k: Positive = 5.56
    fan_w_per_w_rejected: NonNegative = 0.02
    paper_fan_w: NonNegative = 1000.0
    """CT_FAN_REF_P of the SustainDC format, for the tower of the paper."""
    paper_airflow_m3s: Positive = 2.8315
    """CT_REFRENCE_AIR_FLOW_RATE of the SustainDC format, for the tower of the paper."""
    economiser: bool = True
    economiser_approach_k: NonNegative = 5.0
    """Tower and heat exchanger together: coldest water the exchanger gives, above wet bulb."""

    @model_validator(mode="after")
    def _exchanger_adds(self) -> Self:
        if self.economiser_approach_k < self.approach_min_k:
            raise ValueError(
                f"economiser_approach_k {self.economiser_approach_k:g} must not be below "
                f"approach_min_k {self.approach_min_k:g}, which it contains"
            )
        return self


class PumpConfig(_Section):
    """Chilled- and condenser-water pumps."""

    model: Literal["sized", "released"] = "sized"
    pressure_drop_pa: Positive = 300_000.0
    efficiency: Annotated[_Real, Field(gt=0, le=1)] = 0.75
    min_flow_ratio: Annotated[_Real, Field(gt=0, le=1)] = 0.6
    released_chilled_w: NonNegative = 0.0
    released_condenser_w: NonNegative = 0.0


class WaterConfig(_Section):
    """Make-up water of the cooling tower."""

    model: Literal["mass_balance", "released", "paper"] = "mass_balance"
    cycles_of_concentration: Annotated[_Real, Field(gt=1)] = 5.0
    drift_share: Share = 2e-5


class SizingConfig(_Section):
    """How devices are sized for load and site."""

    model: Literal["design_day", "released"] = "design_day"
    margin: Annotated[_Real, Field(ge=1)] = 1.15
    design_wet_bulb_c: Finite | None = None
    """None takes the 99.6 % quantile of the site's weather."""
    design_outdoor_c: Finite | None = None
    """None takes the 99.6 % quantile of the site's weather (released: 30 NY, 20 WA, else 50 C)."""


Device = Literal["chiller", "tower_fan", "chilled_pump", "condenser_pump", "crac_fan"]


class HvacConfig(_Section):
    """Cooling from the CRAC units to the tower."""

    setpoint: SetpointConfig = SetpointConfig()
    crac: CracConfig = CracConfig()
    cooling_load_model: Literal["heat_balance", "released", "paper"] = "heat_balance"
    chiller: ChillerConfig = ChillerConfig()
    tower: TowerConfig = TowerConfig()
    pumps: PumpConfig = PumpConfig()
    water: WaterConfig = WaterConfig()
    sizing: SizingConfig = SizingConfig()
    total_of: tuple[Device, ...] = (
        "chiller",
        "tower_fan",
        "chilled_pump",
        "condenser_pump",
        "crac_fan",
    )
    """Devices counted in the HVAC total."""
    ups_efficiency: Annotated[_Real, Field(gt=0, le=1)] = 0.96
    """Only for the PUE with UPS losses; the grid balance is IT + HVAC + battery."""

    @field_validator("total_of")
    @classmethod
    def _each_device_once(cls, value: tuple[Device, ...]) -> tuple[Device, ...]:
        if not value or len(set(value)) < len(value):
            raise ValueError(f"{list(value)} must name at least one device and each one once")
        return value

    @model_validator(mode="after")
    def _chilled_water_within_the_model(self) -> Self:
        if self.chiller.model == "carnot":
            low, high = CHILLED_WATER_BOUNDS_C["carnot"]
            for name in ("min_c", "max_c"):
                setpoint = getattr(self.setpoint, name)
                water = setpoint - self.chiller.coil_approach_k
                if not low <= water <= high:
                    raise ValueError(
                        f"setpoint.{name} {setpoint:g} less chiller.coil_approach_k "
                        f"{self.chiller.coil_approach_k:g} makes chilled water of {water:g} C; "
                        f"model carnot is valid within {low:g}..{high:g} C"
                    )
        return self


class BatteryConfig(_Section):
    """Battery: model, capacity and limits (C/L/C of Kazhamiaka, Rosenberg and Keshav 2019)."""

    model: Literal["clc", "released", "paper"] = "clc"
    capacity_kwh: NonNegative | None = None
    """None sizes it to hours_of_design_load."""
    hours_of_design_load: NonNegative = 1.0
    initial_soc: Share = 0.0
    charge_efficiency: Annotated[_Real, Field(gt=0, le=1)] = 0.97
    discharge_factor: Annotated[_Real, Field(ge=1)] = 1.04
    """Energy drawn from the store per energy delivered."""
    charge_limit_c_rate: Positive = 3.0
    discharge_limit_c_rate: Positive = 3.0
    upper_u_h: Annotated[_Real, Field(le=0)] = -0.04
    upper_v: Share = 1.0
    lower_u_h: NonNegative = 0.01
    lower_v: Share = 0.0

    @model_validator(mode="after")
    def _limits(self) -> Self:
        if self.lower_v >= self.upper_v:
            raise ValueError(f"lower_v {self.lower_v:g} must be below upper_v {self.upper_v:g}")
        return self


class WorkloadConfig(_Section):
    """Delay-tolerant work: its share, queue and deadline (1 task = 1 % of capacity for a step)."""

    model: Literal["fluid", "tasks"] = "fluid"
    trace: str = "alibaba_1"
    placement: Literal["uniform", "fill", "coolest-first", "inlet-aware", "weights"] = "uniform"
    """Where in the hall work runs."""
    flexible_share: Share = 0.2
    max_utilisation: Annotated[_Real, Field(gt=0, le=1)] = 1.0
    queue_limit_h: Positive | None = 2.5
    """Queue capacity in hours of the whole data center at full utilisation; None is unlimited."""
    deadline_h: Positive | None = 24.0
    age_horizon_h: Annotated[Positive, Field(le=8760)] = 24.0
    """Ages are exact up to this; older work counts as one step older than this."""

    @model_validator(mode="after")
    def _deadline_within_horizon(self) -> Self:
        if self.deadline_h is not None and self.deadline_h > self.age_horizon_h:
            raise ValueError(
                f"deadline_h {self.deadline_h:g} must not exceed "
                f"age_horizon_h {self.age_horizon_h:g}"
            )
        return self


class SiteConfig(_Section):
    """Where the data center stands and when its year starts."""

    location: str = "NY"
    start: str = "01-01"
    """Month and day of the first step, MM-DD, local standard time."""
    seed: Annotated[_Whole, Field(ge=0)] = 10
    """Seed of the synthetic year; imported data ignore it."""
    weather_file: FileName | None = None
    carbon_file: FileName | None = None
    workload_file: FileName | None = None
    carbon_pairing: Literal["local", "utc_rows"] = "local"
    """utc_rows pairs UTC rows with local rows, as the released SustainDC does."""

    @field_validator("start", mode="before")
    @classmethod
    def _month_day(cls, value: Any) -> Any:
        day_of_year(value)
        return value


class ProtectionConfig(_Section):
    """What servers do when their inlets leave the allowable range of their ASHRAE class.

    Above the limit a rack throttles; ``trip_margin_k`` above it, it switches off and loses the
    work of the step, until its inlet is at most ``restart_c``.
    """

    ashrae_class: Literal["A1", "A2", "A3", "A4"] | None = None
    """ASHRAE TC 9.9 (2021) class of the servers; None is no protection."""
    throttle_share: Share = 0.5
    """Utilisation a throttled rack may reach."""
    trip_margin_k: NonNegative = 5.0
    restart_c: Finite = 27.0


EventKind = Literal["crac_down", "chiller_derate", "rack_fan_failure", "heat_wave", "grid_outage"]


class ScheduledEvent(_Section):
    """Something that goes wrong at a known time."""

    kind: EventKind
    start_h: NonNegative
    """Hours after reset."""
    duration_h: Positive
    unit: Annotated[_Whole, Field(ge=0)] | None = None
    """CRAC unit that is down; None is all of them."""
    rack: Annotated[_Whole, Field(ge=0)] | None = None
    """Rack whose fans fail."""
    share: Share | None = None
    """What is left: of the chiller's capacity, or of the rack's airflow."""
    offset_k: Finite | None = None
    """Heat wave: added to the dry-bulb and wet-bulb temperature."""

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> Self:
        _check_event(self)
        return self


class SampledEvent(_Section):
    """Something that goes wrong at random times: a Poisson process with uniform durations."""

    kind: EventKind
    per_year: Annotated[_Real, Field(gt=0, le=8760)]
    """At most one an hour."""
    duration_h: Pair
    """Shortest and longest duration; units and racks are drawn evenly."""
    share: Share | None = None
    offset_k: Finite | None = None

    @model_validator(mode="after")
    def _has_what_its_kind_needs(self) -> Self:
        low, high = self.duration_h
        if not 0 < low <= high:
            raise ValueError(
                f"duration_h ({low:g}, {high:g}) must be (low, high) with 0 < low <= high"
            )
        _check_event(self)
        return self


class EventsConfig(_Section):
    """Failures and weather that a run meets."""

    scheduled: tuple[ScheduledEvent, ...] = ()
    sampled: tuple[SampledEvent, ...] = ()


_EVENT_FIELDS = {
    "crac_down": ("unit",),
    "chiller_derate": ("share",),
    "rack_fan_failure": ("rack", "share"),
    "heat_wave": ("offset_k",),
    "grid_outage": (),
}
_OPTIONAL_EVENT_FIELDS = ("unit",)


def _check_event(event: ScheduledEvent | SampledEvent) -> None:
    used = _EVENT_FIELDS[event.kind]
    for name in ("unit", "rack", "share", "offset_k"):
        if name not in type(event).model_fields:
            continue
        given = getattr(event, name) is not None
        if given and name not in used:
            raise ValueError(f"{name} has no meaning for {event.kind}")
        if not given and name in used and name not in _OPTIONAL_EVENT_FIELDS:
            raise ValueError(f"{event.kind} needs {name}")
    if event.kind == "rack_fan_failure" and event.share == 0.0:
        raise ValueError("share 0 leaves a rack without air; valid is above 0")


class SimulationConfig(_Section):
    """Time step, and whether servers and room have thermal mass."""

    thermal: Literal["quasi_steady", "transient"] = "quasi_steady"
    """Quasi-steady temperatures belong to the present load; transient ones remember."""
    substep_s: Annotated[_Real, Field(ge=5, le=120)] = 60.0
    """Longest substep of transient temperatures."""
    steps_per_hour: Annotated[_Whole, Field(ge=1, le=60)] = 4

    @field_validator("steps_per_hour")
    @classmethod
    def _divides(cls, value: int) -> int:
        if 60 % value:
            raise ValueError(
                f"{value} does not divide 60 minutes; "
                "valid are 1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30, 60"
            )
        return value


class DataCenterConfig(_Section):
    """Everything that defines one data center."""

    name: str = "dc"
    description: str = ""
    hall: HallConfig
    servers: ServerConfig = ServerConfig()
    hvac: HvacConfig = HvacConfig()
    battery: BatteryConfig = BatteryConfig()
    workload: WorkloadConfig = WorkloadConfig()
    protection: ProtectionConfig = ProtectionConfig()
    events: EventsConfig = EventsConfig()
    site: SiteConfig = SiteConfig()
    simulation: SimulationConfig = SimulationConfig()

    @model_validator(mode="after")
    def _air_models_fit_together(self) -> Self:
        crac = self.hvac.crac
        wants: list[tuple[bool, str]] = []
        if self.hall.inlet_model == "approach":
            kinds = {e.kind for e in self.events.scheduled}
            kinds |= {e.kind for e in self.events.sampled}
            wants = [
                (crac.units > 1, f"hvac.crac.units {crac.units}"),
                (
                    self.hall.recirculation.matrix_file is not None,
                    "hall.recirculation.matrix_file",
                ),
                (self.simulation.thermal == "transient", "simulation.thermal transient"),
                ("crac_down" in kinds, "event crac_down"),
                ("rack_fan_failure" in kinds, "event rack_fan_failure"),
            ]
            for given, what in wants:
                if given:
                    raise ValueError(f"{what} needs hall.inlet_model recirculation")
            return self
        groups = self.servers.groups or ()
        wants = [
            (self.servers.outlet_model != "server", "servers.outlet_model server"),
            (
                self.hvac.cooling_load_model != "heat_balance",
                "hvac.cooling_load_model heat_balance",
            ),
            (crac.flow_model == "per_watt", "another hvac.crac.flow_model than per_watt"),
            (
                self.hall.supply_approach_limits_k is not None,
                "hall.supply_approach_limits_k null",
            ),
            (
                any(g.inlet_offset_k for rack in groups for g in rack),
                "inlet_offset_k 0 in servers.groups (hall.height_zones takes its place)",
            ),
        ]
        for missing, what in wants:
            if missing:
                raise ValueError(f"hall.inlet_model recirculation needs {what}")
        return self

    @model_validator(mode="after")
    def _names_existing_places(self) -> Self:
        crac, racks = self.hvac.crac, self.hall.racks
        for index, event in enumerate(self.events.scheduled):
            for name, limit in (("unit", crac.units), ("rack", racks)):
                given = getattr(event, name)
                if given is not None and given >= limit:
                    raise ValueError(
                        f"events.scheduled.{index}.{name} {given}: valid is 0..{limit - 1}"
                    )
        if crac.unit_shares is None:
            return self
        if len(crac.unit_shares) != racks:
            raise ValueError(_length_message("hvac.crac.unit_shares", len(crac.unit_shares), racks))
        for rack, shares in enumerate(crac.unit_shares):
            if len(shares) != crac.units or abs(sum(shares) - 1.0) > 1e-9:
                raise ValueError(
                    f"hvac.crac.unit_shares of rack {rack}: {len(shares)} entries that sum to "
                    f"{sum(shares):g}; valid is {crac.units} (hvac.crac.units) that sum to 1"
                )
        return self

    @model_validator(mode="after")
    def _times_are_whole_steps(self) -> Self:
        for name in ("deadline_h", "age_horizon_h"):
            hours = getattr(self.workload, name)
            steps = None if hours is None else hours * self.simulation.steps_per_hour
            if steps is not None and (steps < 1 or abs(steps - round(steps)) > 1e-9):
                raise ValueError(
                    f"workload.{name} {hours:g} h is {steps:g} steps; valid is a whole number of "
                    f"steps of {60 // self.simulation.steps_per_hour} min"
                )
        return self

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        racks = self.hall.racks
        pairs = self.servers.power_pairs
        groups = self.servers.groups
        if groups is None:
            if len(pairs) not in (1, racks):
                raise ValueError(_length_message("servers.power_w", len(pairs), racks))
        else:
            if len(groups) not in (1, racks):
                raise ValueError(_length_message("servers.groups", len(groups), racks))
            for index, rack in enumerate(groups):
                _check_load_weights(index, rack)
        lowest_k = np.array([min(g.inlet_offset_k for g in r) for r in groups] if groups else [0.0])
        coldest_c = (
            self.hvac.setpoint.min_c
            + lowest_k
            + (
                self.hall.rack_approach_k()
                if self.hall.inlet_model == "approach"
                else np.zeros(racks)
            )
        )
        ratio = self.servers.curves.airflow_ratio(coldest_c, np.zeros(racks))
        worst = int(np.argmin(ratio))
        if ratio[worst] <= 0:
            raise ValueError(
                f"servers: the airflow ratio is {ratio[worst]:.3g} at {coldest_c[worst]:g} C, the "
                f"coldest inlet of rack {worst}, and no load; it must be positive (raise "
                "fan_airflow_ratio_lb or set fan_airflow_ratio_limits)"
            )
        return self

    def rack_groups(self) -> tuple[tuple[ServerGroup, ...], ...]:
        """Server groups of every rack, with capacity_mw applied to the counts."""
        racks = self.hall.racks
        if self.servers.groups is not None:
            found = self.servers.groups
            per_rack = found * racks if len(found) == 1 else found
        else:
            pairs = self.servers.power_pairs
            pairs = pairs * racks if len(pairs) == 1 else pairs
            counts = self.hall.servers_per_rack
            counts = (counts,) * racks if isinstance(counts, int) else counts
            kinds = list(zip(counts, pairs, strict=True))
            groups = {
                kind: (ServerGroup(count=kind[0], full_w=kind[1][0], idle_w=kind[1][1]),)
                for kind in set(kinds)
            }
            per_rack = tuple(map(groups.__getitem__, kinds))
        if self.hall.capacity_mw is None:
            return per_rack
        nameplate_w = sum(g.count * g.full_w for rack in per_rack for g in rack)
        scale = self.hall.capacity_mw * 1e6 / nameplate_w
        fewest = min(g.count for rack in per_rack for g in rack)
        if round(fewest * scale) < 1:
            smallest = 0.51e-6 * nameplate_w / fewest
            raise ConfigError(
                f"{self.name}: hall.capacity_mw {self.hall.capacity_mw:g} leaves racks without "
                f"servers; valid is at least {smallest:.3g} for this hall"
            )
        return tuple(
            tuple(g.model_copy(update={"count": round(g.count * scale)}) for g in rack)
            for rack in per_rack
        )

    def to_yaml(self) -> str:
        """YAML text that ``load_config`` reads back equal."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


def preset_names() -> list[str]:
    """Names of the presets that come with the package."""
    folder = resources.files("sdc_taichi.configs")
    return sorted(entry.name[:-5] for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def load_config(
    source: str | os.PathLike[str] | None = None, overrides: tuple[str, ...] | list[str] = ()
) -> DataCenterConfig:
    """Read a preset, a YAML file or a SustainDC ``dc_config.json``.

    Args:
        source: a preset name (see ``preset_names``), a path to YAML with the schema of this
            module, which may name a preset to start from under ``extends``, or a path to the
            SustainDC JSON format, which starts from preset ``sustaindc``. None is ``corrected``.
        overrides: ``a.b=c`` assignments applied last; ``c`` is read as YAML.

    Raises:
        ConfigError: naming the file, the key, the value and what would be valid.
    """
    if isinstance(overrides, str):
        raise ConfigError(f"overrides {overrides!r}: valid is a list of section.key=value")
    label, values = _read_source("corrected" if source is None else source)
    for override in overrides:
        _apply_override(values, override)
    return config_from_dict(values, label)


def config_from_dict(values: dict[str, Any], label: str = "config") -> DataCenterConfig:
    """Validate plain values; errors start with ``label``."""
    try:
        return DataCenterConfig.model_validate(values)
    except ValidationError as error:
        raise ConfigError(explain(error, label)) from None


def apply_overrides(config: DataCenterConfig, overrides: list[str]) -> DataCenterConfig:
    """A copy of ``config`` with ``a.b=c`` assignments applied."""
    values = config.model_dump(mode="json")
    for override in overrides:
        _apply_override(values, override)
    return config_from_dict(values, config.name)


def with_values(config: DataCenterConfig, assigned: Mapping[str, Any]) -> DataCenterConfig:
    """A copy of ``config`` with plain values put at dotted paths."""
    values = config.model_dump(mode="json")
    for path, value in assigned.items():
        _assign(values, path, value, f"{path}={value!r}")
    return config_from_dict(values, config.name)


def _read_source(source: str | os.PathLike[str]) -> tuple[str, dict[str, Any]]:
    if isinstance(source, str) and source in preset_names():
        text = resources.files("sdc_taichi.configs").joinpath(f"{source}.yaml").read_text("utf-8")
        return _resolve_extends(f"preset {source}", _parse_yaml(text, f"preset {source}"))
    path = Path(source)
    try:
        text = path.read_text("utf-8")
    except FileNotFoundError:
        meant = suggestion(source, preset_names())
        raise ConfigError(
            f"{source}: no such file or preset{meant} (presets: {', '.join(preset_names())})"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{source}: cannot be read ({error})") from None
    if path.suffix.lower() == ".json":
        values = _parse_json(text, str(path))
        if "data_center_configuration" in values:
            return str(path), from_sustaindc(values, str(path))
    else:
        values = _parse_yaml(text, str(path))
    return _resolve_extends(str(path), values)


def _resolve_extends(label: str, values: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    base = values.pop("extends", None)
    if base is None:
        return label, values
    if base not in preset_names():
        raise ConfigError(
            f"{label}: extends: {base!r} is no preset; valid: {', '.join(preset_names())}"
        )
    _, merged = _read_source(str(base))
    merged = _merge(merged, values)
    given = values.get("servers")
    if isinstance(given, dict):
        _replace_other_servers(merged["servers"], given)
    return label, merged


def _replace_other_servers(servers: dict[str, Any], given: Mapping[str, Any]) -> None:
    """Groups take the place of inherited power pairs, and the other way round."""
    for new, old in (("groups", "power_w"), ("power_w", "groups")):
        if given.get(new) is not None and old not in given:
            servers[old] = None


def _merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    out = dict(base)
    for key, value in over.items():
        old = out.get(key)
        out[key] = (
            _merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
        )
    return out


class _Loader(yaml.SafeLoader):
    """Takes no mapping that gives a key twice, of which YAML would drop the first."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key in [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    problem=f"{key.value!r} is given twice", problem_mark=key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def load_yaml(text: str) -> Any:
    """What a YAML text says.

    Raises:
        ValueError: not valid, or a key given twice; says on one line what is wrong.
    """
    try:
        return yaml.load(text, _Loader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ValueError(" ".join(str(error).split())) from None


def _parse_yaml(text: str, label: str) -> dict[str, Any]:
    try:
        values = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"{label}: not valid YAML ({error})") from None
    return _require_mapping(values, label)


def _parse_json(text: str, label: str) -> dict[str, Any]:
    try:
        values = json.loads(text)
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"{label}: not valid JSON ({error})") from None
    return _require_mapping(values, label)


def _require_mapping(values: Any, label: str) -> dict[str, Any]:
    if not isinstance(values, dict):
        kind = type(values).__name__
        raise ConfigError(f"{label}: the top level is a {kind}; valid is a mapping of sections")
    return values


def _apply_override(values: dict[str, Any], override: str) -> None:
    path, sign, text = override.partition("=")
    if not sign:
        raise ConfigError(f"override {override!r}: valid is section.key=value")
    try:
        value = load_yaml(text)
    except ValueError as error:
        raise ConfigError(f"override {override!r}: {text!r} is no YAML value ({error})") from None
    _assign(values, path, value, override)


def _assign(values: dict[str, Any], path: str, value: Any, override: str) -> None:
    keys = path.strip().split(".")
    if not all(keys):
        raise ConfigError(f"override {override!r}: valid is section.key=value")
    node: Any = values
    for key in keys[:-1]:
        if isinstance(node, list):
            node = node[_list_index(node, key, override)]
        else:
            node = node.setdefault(key, {})
        if not isinstance(node, dict | list):
            raise ConfigError(f"override {override!r}: {key} is a value, not a section")
    if isinstance(node, list):
        node[_list_index(node, keys[-1], override)] = value
    else:
        node[keys[-1]] = value
        if keys[:-1] == ["servers"]:
            _replace_other_servers(node, {keys[-1]: value})


def _list_index(node: list[Any], key: str, override: str) -> int:
    if not key.isdigit() or int(key) >= len(node):
        raise ConfigError(f"override {override!r}: index {key!r} is not in 0..{len(node) - 1}")
    return int(key)


def explain(error: ValidationError, label: str, model: type[BaseModel] | None = None) -> str:
    """One line on what is wrong with values for ``model``, None being ``DataCenterConfig``."""
    parts = []
    seen = set()
    for item in error.errors(include_url=False):
        names = [str(p) for p in item["loc"] if not _is_union_branch(p)]
        where = ".".join(names)
        if item["type"] == "extra_forbidden":
            valid = _fields_at(names[:-1], model or DataCenterConfig)
            text = f"{where}: unknown key{suggestion_or_valid(names[-1], valid)}"
        elif item["type"] == "missing":
            text = f"{where}: missing"
        else:
            message = item["msg"].removeprefix("Value error, ")
            given = item["input"]
            scalar = given is None or isinstance(given, str | int | float | bool)
            text = f"{where}: {message}" if where else message
            if scalar:
                text += f" (got {given!r})"
        if where not in seen:
            parts.append(text)
        seen.add(where)
    shown = "; ".join(parts[:3])
    more = f" (and {len(parts) - 3} more)" if len(parts) > 3 else ""
    return f"{label}: {shown}{more}"


def _is_union_branch(part: str | int) -> bool:
    """Pydantic puts the tried type of a union into the location; it is no key of the user's."""
    return isinstance(part, str) and (part in {"int", "float"} or "[" in part)


_LISTED: dict[str, type[BaseModel]] = {
    "groups": ServerGroup,
    "scheduled": ScheduledEvent,
    "sampled": SampledEvent,
}
"""Fields that list sections."""


def _fields_at(path: list[str], model: type[BaseModel]) -> list[str]:
    node: Any = model
    for key in path:
        if key.isdigit():
            continue
        node = _LISTED.get(key, node.model_fields[key].annotation)
    return list(node.model_fields)


def _check_ordered(value: Pair | None) -> Pair | None:
    if value is not None and not value[0] < value[1]:
        raise ValueError(f"({value[0]:g}, {value[1]:g}) must be (low, high) with low < high")
    return value


def _length_message(name: str, found: int, expected: int) -> str:
    return (
        f"{name} has {found} entries, expected {expected} (rows x racks_per_row), "
        "or one value for all"
    )


def _check_length(name: str, value: Any, expected: int) -> None:
    if isinstance(value, tuple) and len(value) != expected:
        raise ValueError(_length_message(name, len(value), expected))


def _check_load_weights(index: int, rack: tuple[ServerGroup, ...]) -> None:
    if not rack:
        raise ValueError(f"servers.groups rack {index} is empty; valid is at least one group")
    mean = sum(g.count * g.load_weight for g in rack) / sum(g.count for g in rack)
    if mean <= 0:
        raise ValueError(f"servers.groups rack {index}: at least one load_weight must be positive")
    highest = max(g.load_weight for g in rack)
    if highest > 2 * mean:
        raise ValueError(
            f"servers.groups rack {index}: load_weight {highest:g} exceeds twice the rack's mean "
            f"{mean:.3g}, which would overload the server at partial load"
        )


_SUSTAINDC_KEYS: dict[str, tuple[str, ...]] = {
    "data_center_configuration": (
        "NUM_ROWS",
        "NUM_RACKS_PER_ROW",
        "RACK_SUPPLY_APPROACH_TEMP_LIST",
        "RACK_RETURN_APPROACH_TEMP_LIST",
        "CPUS_PER_RACK",
    ),
    "hvac_configuration": (
        "C_AIR",
        "RHO_AIR",
        "CRAC_SUPPLY_AIR_FLOW_RATE_pu",
        "CRAC_REFRENCE_AIR_FLOW_RATE_pu",
        "CRAC_FAN_REF_P",
        "CHILLER_COP_BASE",
        "CHILLER_COP_K",
        "CHILLER_COP_T_NOMINAL",
        "CT_FAN_REF_P",
        "CT_REFRENCE_AIR_FLOW_RATE",
        "CW_PRESSURE_DROP",
        "CW_WATER_FLOW_RATE",
        "CW_PUMP_EFFICIENCY",
        "CT_PRESSURE_DROP",
        "CT_WATER_FLOW_RATE",
        "CT_PUMP_EFFICIENCY",
    ),
    "server_characteristics": (
        "CPU_POWER_RATIO_LB",
        "CPU_POWER_RATIO_UB",
        "IT_FAN_AIRFLOW_RATIO_LB",
        "IT_FAN_AIRFLOW_RATIO_UB",
        "IT_FAN_FULL_LOAD_V",
        "ITFAN_REF_V_RATIO",
        "ITFAN_REF_P",
        "INLET_TEMP_RANGE",
        "DEFAULT_SERVER_POWER_CHARACTERISTICS",
        "HP_PROLIANT",
    ),
}


def from_sustaindc(values: dict[str, Any], label: str) -> dict[str, Any]:
    """Map the SustainDC ``dc_config.json`` onto this schema, starting from preset ``sustaindc``.

    The CHILLER_COP values and HP_PROLIANT are checked but, as in the released code, not used.

    Raises:
        ConfigError: for a missing or unknown key, a wrong type, or a wrong length.
    """
    problems = _sustaindc_problems(values)
    if problems:
        raise ConfigError(f"{label}: {'; '.join(problems)}")
    hall, hvac, servers = (values[section] for section in _SUSTAINDC_KEYS)

    def pump_w(prefix: str) -> float:
        drop, flow = hvac[f"{prefix}_PRESSURE_DROP"], hvac[f"{prefix}_WATER_FLOW_RATE"]
        return float(drop * flow / hvac[f"{prefix}_PUMP_EFFICIENCY"])

    per_rack = hall["CPUS_PER_RACK"]
    mapped = {
        "name": Path(label).stem,
        "description": "read from the SustainDC dc_config.json format",
        "hall": {
            "rows": int(hall["NUM_ROWS"]),
            "racks_per_row": int(hall["NUM_RACKS_PER_ROW"]),
            "servers_per_rack": [int(n) for n in per_rack]
            if isinstance(per_rack, list)
            else int(per_rack),
            "supply_approach_k": hall["RACK_SUPPLY_APPROACH_TEMP_LIST"],
            "return_approach_k": hall["RACK_RETURN_APPROACH_TEMP_LIST"],
            "air_density_kg_m3": hvac["RHO_AIR"],
            "air_heat_capacity_j_per_kg_k": hvac["C_AIR"],
        },
        "servers": {
            "power_w": [
                (pair[0], pair[-1]) for pair in servers["DEFAULT_SERVER_POWER_CHARACTERISTICS"]
            ],
            "cpu_power_ratio_lb": servers["CPU_POWER_RATIO_LB"],
            "cpu_power_ratio_ub": servers["CPU_POWER_RATIO_UB"],
            "inlet_range_c": servers["INLET_TEMP_RANGE"],
            "fan_airflow_ratio_lb": servers["IT_FAN_AIRFLOW_RATIO_LB"],
            "fan_airflow_ratio_ub": servers["IT_FAN_AIRFLOW_RATIO_UB"],
            "fan_full_airflow_m3s": servers["IT_FAN_FULL_LOAD_V"],
            "fan_reference_ratio": servers["ITFAN_REF_V_RATIO"],
            "fan_reference_w": servers["ITFAN_REF_P"],
        },
        "hvac": {
            "crac": {
                "supply_m3s_per_w": hvac["CRAC_SUPPLY_AIR_FLOW_RATE_pu"],
                "reference_m3s_per_w": hvac["CRAC_REFRENCE_AIR_FLOW_RATE_pu"],
                "released_fan_w": hvac["CRAC_FAN_REF_P"],
            },
            "tower": {
                "paper_fan_w": hvac["CT_FAN_REF_P"],
                "paper_airflow_m3s": hvac["CT_REFRENCE_AIR_FLOW_RATE"],
            },
            "pumps": {"released_chilled_w": pump_w("CW"), "released_condenser_w": pump_w("CT")},
        },
    }
    _, base = _read_source("sustaindc")
    return _merge(base, mapped)


def _sustaindc_problems(values: dict[str, Any]) -> list[str]:
    problems = []
    for section in values:
        if section not in _SUSTAINDC_KEYS:
            problems.append(f"{section}: unknown section; valid: {', '.join(_SUSTAINDC_KEYS)}")
    for section, keys in _SUSTAINDC_KEYS.items():
        found = values.get(section)
        if not isinstance(found, dict):
            problems.append(f"{section}: missing section")
            continue
        for key in found:
            if key not in keys:
                problems.append(f"{section}.{key}: unknown key{suggestion(key, keys)}")
        problems.extend(f"{section}.{key}: missing" for key in keys if key not in found)
    if problems and not all(isinstance(values.get(s), dict) for s in _SUSTAINDC_KEYS):
        return problems
    problems.extend(_sustaindc_value_problems(values))
    return problems


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_count(value: Any) -> bool:
    return _is_number(value) and 1 <= value <= 1e9 and value == int(value)


def _sustaindc_value_problems(values: dict[str, Any]) -> list[str]:
    problems = []
    hall, servers = values["data_center_configuration"], values["server_characteristics"]
    for section, keys in _SUSTAINDC_KEYS.items():
        for key in keys:
            value = values[section].get(key, 0)
            flat = value if isinstance(value, list) else [value]
            flat = [x for item in flat for x in (item if isinstance(item, list) else [item])]
            wrong = next((x for x in flat if not _is_number(x)), None)
            if wrong is not None or not flat:
                problems.append(f"{section}.{key}: {wrong!r} is not a number")
    counts = {key: hall.get(key, 1) for key in ("NUM_ROWS", "NUM_RACKS_PER_ROW")}
    for key, count in counts.items():
        if _is_number(count) and not _is_count(count):
            problems.append(f"data_center_configuration.{key}: {count!r} is no positive integer")
    counted = all(key in hall and _is_count(count) for key, count in counts.items())
    racks = int(np.prod([int(c) for c in counts.values()])) if counted else 0
    lists = (
        (hall, "data_center_configuration", "RACK_SUPPLY_APPROACH_TEMP_LIST"),
        (hall, "data_center_configuration", "RACK_RETURN_APPROACH_TEMP_LIST"),
        (servers, "server_characteristics", "DEFAULT_SERVER_POWER_CHARACTERISTICS"),
    )
    for section_values, section, key in lists:
        if counted and key in section_values:
            value = section_values[key]
            length = len(value) if isinstance(value, list) else 0
            if length != racks:
                problems.append(
                    f"{section}.{key}: length {length}, expected {racks} "
                    "(NUM_ROWS x NUM_RACKS_PER_ROW)"
                )
    per_rack = hall.get("CPUS_PER_RACK", 1)
    for count in per_rack if isinstance(per_rack, list) else [per_rack]:
        if _is_number(count) and not _is_count(count):
            problems.append(
                f"data_center_configuration.CPUS_PER_RACK: {count!r} is no positive integer"
            )
    if isinstance(per_rack, list) and counted and len(per_rack) != racks:
        problems.append(
            f"data_center_configuration.CPUS_PER_RACK: length {len(per_rack)}, expected {racks}"
        )
    for key in ("CW_PUMP_EFFICIENCY", "CT_PUMP_EFFICIENCY"):
        efficiency = values["hvac_configuration"].get(key, 1)
        if _is_number(efficiency) and efficiency <= 0:
            problems.append(f"hvac_configuration.{key}: {efficiency!r} must be positive")
    for key in (
        "CPU_POWER_RATIO_LB",
        "CPU_POWER_RATIO_UB",
        "IT_FAN_AIRFLOW_RATIO_LB",
        "IT_FAN_AIRFLOW_RATIO_UB",
        "INLET_TEMP_RANGE",
    ):
        value = servers.get(key)
        if key in servers and (not isinstance(value, list) or len(value) != 2):
            length = len(value) if isinstance(value, list) else 0
            problems.append(f"server_characteristics.{key}: length {length}, expected 2")
    pairs = servers.get("DEFAULT_SERVER_POWER_CHARACTERISTICS", [])
    for index, pair in enumerate(pairs if isinstance(pairs, list) else []):
        if not isinstance(pair, list) or len(pair) != 2:
            length = len(pair) if isinstance(pair, list) else 0
            problems.append(
                f"server_characteristics.DEFAULT_SERVER_POWER_CHARACTERISTICS[{index}]: "
                f"length {length}, expected 2 (full, idle)"
            )
    return problems
