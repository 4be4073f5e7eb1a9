"""Section ``hvac``: cooling from the CRAC units to the tower, its water, and its sizing."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from sdc_taichi.config.fields import (
    AirC,
    DeviceW,
    DewPointC,
    ExchangerK,
    FlowM3sPerW,
    LengthM,
    NameIn,
    OutdoorC,
    Plant,
    RiseK,
    Section,
    Share,
    WaterRangeK,
    WorkingShare,
)
from sdc_taichi.exogenous.year_clock import MONTH_OF_DAY
from sdc_taichi.plant.chiller import CHILLERS, MIN_LIFT_K
from sdc_taichi.plant.cooling import COOLING_LOADS, CRAC_FLOWS, SETPOINTS
from sdc_taichi.plant.plants import PLANTS, fits, plant_of
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water import WATER
from sdc_taichi.types import F64

Device = Literal["chiller", "tower_fan", "chilled_pump", "condenser_pump", "crac_fan"]
USUAL_AIR_J_PER_M3_K = 1.2e3
"""Heat capacity of air by volume near sea level, in J/(m3 K), used by checks only."""
MOST_CRAC_UNITS = 10_000
"""Largest number of CRAC units of a hall, one for each fan of the largest fan walls."""
UnitAirflow = Annotated[float, Field(ge=0.01, le=1000)]
"""Airflow of a CRAC unit, 0.01..1,000 m3/s: from a desk fan to a fan wall of a large hall."""

UnitCapacity = Annotated[float, Field(ge=0.1, le=1e5)]
"""Cooling capacity of a CRAC unit, 0.1..100,000 kW: from a small wall unit to a fan wall."""


class SetpointConfig(Section):
    """Setpoint of the CRAC units: range, first value and how actions move it.

    It applies to the supply air, or to the return air with ``crac.temperature_control: return``.
    """

    model: Annotated[str, NameIn(SETPOINTS)] = "symmetric"
    """How a command moves the setpoint: by one step, or by a step that grows with equal commands
    in a row, as in the released SustainDC."""
    min_c: AirC = 16.0
    """Lowest setpoint, in C."""
    max_c: AirC = 23.0
    """Highest setpoint, in C."""
    initial_c: AirC = 18.0
    """Setpoint after a reset, in C."""
    schedule_c: tuple[AirC, ...] | tuple[tuple[AirC, ...], ...] | None = None
    """Setpoint of each month (12 values, January first), of each local hour of the day (24 values,
    midnight first) or of both (12 lists of 24), in C, which steps without a cooling command follow;
    None is no schedule."""
    step_k: Annotated[float, Field(ge=0.001, le=50)] = 1.0
    """Change of the setpoint by one action, in K, 0.001..50: from less than any sensor resolves to
    more than any range of setpoints."""

    @model_validator(mode="after")
    def _schedule_inside(self) -> Self:
        schedule = self.schedule_c
        if schedule is None:
            return self
        rows = [row if isinstance(row, tuple) else (row,) for row in schedule]
        lengths = {len(row) for row in rows}
        whole = isinstance(schedule[0], tuple) if schedule else False
        if (len(schedule), lengths) not in ([(12, {24})] if whole else [(12, {1}), (24, {1})]):
            raise ValueError(
                f"schedule_c has {len(schedule)} entries; valid is 12, one for each month, 24, one "
                "for each hour of the day, or 12 lists of 24"
            )
        for value in (value for row in rows for value in row):
            if not self.min_c <= value <= self.max_c:
                raise ValueError(
                    f"schedule_c {value:g} must lie within min_c {self.min_c:g} and max_c "
                    f"{self.max_c:g}"
                )
        return self

    def hourly_c(self) -> F64 | None:
        """Scheduled setpoint of each hour of the year, in C, (8760,); None without a schedule."""
        if self.schedule_c is None:
            return None
        table = np.array(self.schedule_c)
        by_month = table[:, None] if table.shape == (12,) else np.broadcast_to(table, (12, 24))
        by_day = np.broadcast_to(by_month, (12, 24))[np.array(MONTH_OF_DAY) - 1]
        return np.asarray(by_day.reshape(-1), dtype=np.float64)

    @model_validator(mode="after")
    def _inside(self) -> Self:
        if not self.min_c <= self.initial_c <= self.max_c:
            raise ValueError(
                f"initial_c {self.initial_c:g} must lie within min_c {self.min_c:g} "
                f"and max_c {self.max_c:g}"
            )
        return self


class CracConfig(Section):
    """CRAC units: number, size, fan control, and the racks that each supplies."""

    units: Annotated[int, Field(ge=1, le=MOST_CRAC_UNITS)] = 1
    """Number of CRAC units, along both end walls in turn and evenly spread over the rows,
    1..10,000: more than the fan walls of any hall have fans."""
    spare_units: Annotated[int, Field(ge=0, lt=MOST_CRAC_UNITS)] = 0
    """Number of units that may be lost at the design point, below ``units``: 1 for N+1. The others
    then give the design airflow; while all run, each runs at part speed."""
    airflow_m3s: UnitAirflow | tuple[UnitAirflow, ...] | None = None
    """Airflow of a unit at full speed, in m3/s: one for all units, or one per unit; None sizes them
    for what their racks need at the design point."""
    unit_shares: tuple[tuple[Share, ...], ...] | None = None
    """Share of each unit in the supply air of each rack, 0..1: one row of shares per rack, each row
    summing to 1; None is by distance."""
    supply_length_m: LengthM = 6.0
    """Length over which a unit loses weight in the supply of a rack by a factor of e, in m."""
    capacity_kw: UnitCapacity | tuple[UnitCapacity, ...] | None = None
    """Most heat that the coil of a unit takes out, that of its fan included, in kW: one for all
    units, or one per unit; None is no limit but that of the plant."""
    temperature_control: Literal["supply", "return"] = "supply"
    """Air whose temperature the setpoint controls: that supplied by a unit, or that returning to
    it. With ``return`` the supply air becomes colder as the heat to remove grows, down to the
    setpoint less the temperature rise of the air at the design point."""
    supply_m3s_per_w: FlowM3sPerW = 5.663e-5
    """Design airflow of all units per IT power at the design point, in m3/s per W."""
    reference_m3s_per_w: FlowM3sPerW = 9.438e-5
    """Airflow per IT power at which a fan draws ``released_fan_w``, in m3/s per W."""
    flow_model: Annotated[str, NameIn(CRAC_FLOWS)] = "follow_servers"
    """Control of the units' fans: constant at the speed of the design point; by the pressure under
    a raised floor, which takes the same airflow whichever units run; by the supply air that the
    servers take in; by the hottest inlet of the servers; by IT power; or by the actions of an
    agent."""
    inlet_target_c: Annotated[float, Field(ge=1, le=60)] = 25.0
    """Hottest inlet at which fans of flow model ``hottest_inlet`` reach full speed, in C, 1..60."""
    inlet_band_k: ExchangerK = 4.0
    """Difference between ``inlet_target_c`` and the hottest inlet at which these fans reach their
    lowest speed, in K."""
    min_flow_ratio: WorkingShare = 0.3
    """Lowest airflow of a running unit over its airflow at full speed, 0.01..1."""
    fan_step: Annotated[float, Field(ge=0.001, le=1)] = 0.05
    """Change of fan speed over full speed by one action, for flow model ``controlled``, 0.001..1:
    from less than any drive resolves to the whole range."""
    coasting_flow_ratio: WorkingShare = 0.1
    """Airflow that leaks through the closed dampers of a unit that is down, divided by its airflow
    at full speed, 0.01..1."""
    fan_w_per_m3s: Annotated[float, Field(ge=0, le=20_000)] = 1000.0
    """Design fan power per design airflow (specific fan power), in W per m3/s, 0..20,000: four
    times the worst class of EN 16798-3."""
    released_fan_w: DeviceW = 150.0
    """CRAC_FAN_REF_P of the SustainDC format: power of one unscaled fan, in W."""

    @model_validator(mode="after")
    def _units_fit_together(self) -> Self:
        if self.spare_units >= self.units:
            raise ValueError(
                f"spare_units {self.spare_units} must be below units {self.units}, so that one is "
                "left"
            )
        if self.spare_units and self.airflow_m3s is not None:
            raise ValueError(
                f"spare_units {self.spare_units} sizes units, and airflow_m3s gives their size; "
                "valid is one of the two"
            )
        for name in ("airflow_m3s", "capacity_kw"):
            values = getattr(self, name)
            if isinstance(values, tuple) and len(values) != self.units:
                raise ValueError(
                    f"{name} has {len(values)} entries, expected {self.units} (units), or one "
                    "value for all"
                )
        return self


class ChillerConfig(Section):
    """Chiller model and its reference point."""

    model: Annotated[str, NameIn(CHILLERS)] = "centrifugal_vsd"
    """How power and capacity of the chiller follow from load and temperatures. Chilled water is at
    most as warm as the model is valid for."""
    reference_cop: Annotated[float, Field(ge=0.5, le=50)] | None = None
    """COP at the reference point, in W of heat per W of power, 0.5..50: from an absorption chiller
    to Carnot's limit at a lift of 6 K; None is that of the model's machine."""
    coil_approach_k: ExchangerK = 8.0
    """Supply air setpoint above the chilled water that the coils take, in K; more where the chiller
    makes no water as warm as that."""
    chilled_water_range_k: WaterRangeK = 6.0
    """Return less supply temperature of the chilled water, at design, in K."""
    coil_valves: bool = True
    """Whether control valves match the water flow of the coils to their load: the water then
    returns warmer at part load. Without valves it returns ``chilled_water_range_k`` above the
    supply at any load."""
    min_condenser_c: Annotated[float, Field(ge=0, le=60)] = 12.78
    """Lowest temperature of the condenser water that enters the chiller, in C, 0..60: water that is
    liquid, and below the condensing temperatures of refrigerants."""
    min_lift_k: Annotated[float, Field(ge=0.1, le=50)] = MIN_LIFT_K
    """Smallest lift that a compressor works against, entering condenser water over leaving chilled
    water, in K, for models ``centrifugal_vsd`` and ``carnot``, 0.1..50: towards 0 K the COP of
    ``carnot`` has no limit, and no plant lifts more in its best hour."""


class TowerConfig(Section):
    """Cooling tower, condenser water and waterside economiser."""

    model: Annotated[str, NameIn(TOWERS)] = "yorkcalc"
    """How fan power and water temperature of the tower follow from the heat to reject."""
    approach_min_k: ExchangerK = 4.0
    """Smallest approach: coldest water from the tower less the wet bulb, in K."""
    water_range_k: WaterRangeK = 5.56
    """Temperature of the water that enters the tower less that of the water that leaves it, at the
    design point, in K."""
    fan_w_per_w_rejected: Annotated[float, Field(ge=0, le=1)] = 0.02
    """Design fan power per heat rejected at the design point, in W per W, 0..1: at 1 the fan alone
    would warm the air as much as the heat does."""
    airflow_m3s_per_w_rejected: Annotated[float, Field(ge=5e-6, le=2e-4)] = 2.667e-5
    """Airflow at full fan speed per heat rejected at the design point, in m3/s per W, 5e-6..2e-4:
    from seven kilograms of water per kilogram of air, at a range of 5.56 K, to a fifth of one; the
    default makes 1.4."""
    paper_fan_w: DeviceW = 1000.0
    """CT_FAN_REF_P of the SustainDC format: fan power of the paper's tower at its reference
    airflow, in W."""
    paper_airflow_m3s: Annotated[float, Field(ge=0.01, le=1e6)] = 2.8315
    """CT_REFRENCE_AIR_FLOW_RATE of the SustainDC format: reference airflow of the paper's tower, in
    m3/s, 0.01..1e6: from a fan of 10 cm to the largest towers of power stations and beyond."""
    economiser: bool = True
    """Whether a waterside economiser cools the return water before the chiller."""
    economiser_approach_k: RiseK = 5.0
    """Approach of tower and heat exchanger together: coldest water from the exchanger less the wet
    bulb, in K."""

    @model_validator(mode="after")
    def _exchanger_adds(self) -> Self:
        if self.economiser_approach_k < self.approach_min_k:
            raise ValueError(
                f"economiser_approach_k {self.economiser_approach_k:g} must not be below "
                f"approach_min_k {self.approach_min_k:g}, which it contains"
            )
        return self


class DryCoolerConfig(Section):
    """Dry cooler of plant ``air_cooled``, with the heat exchanger to the chilled water."""

    free_cooling: bool = True
    """Whether the chilled water that returns from the coils passes the dry cooler before the
    chiller."""
    approach_k: ExchangerK = 8.0
    """Chilled water over outdoor air where the dry cooler does all of the work at full load, in K:
    7 K of the cooler and 1 K of the heat exchanger."""
    fan_w_per_w_cooled: Annotated[float, Field(ge=0, le=1)] = 0.03
    """Design fan power per cooling load at the design point, in W per W, 0..1; coolers on the
    market need 0.02 to 0.04."""


class OutdoorAirConfig(Section):
    """Outdoor air of plant ``air_side``: when it is let in, and its fans.

    The default limits of moisture are those that ASHRAE TC 9.9 recommends (Thermal Guidelines for
    Data Processing Environments, 5th edition, 2021). Its allowable range of class A1 is -12..17 C
    of dew point and up to 80 %.
    """

    min_dew_point_c: DewPointC = -9.0
    """Lowest dew point of outdoor air that is let in, in C."""
    humidifier: bool = True
    """Whether an adiabatic humidifier raises the dew point of drier outdoor air to
    ``min_dew_point_c``; air that is drier is left outside without one."""
    max_dew_point_c: DewPointC = 15.0
    """Highest dew point of outdoor air that is let in, in C."""
    max_humidity_pct: Annotated[float, Field(ge=1, le=100)] = 70.0
    """Highest relative humidity of outdoor air at the supply setpoint, in %, 1..100: from the
    driest air of a desert to fog."""
    fan_w_per_m3s: Annotated[float, Field(ge=0, le=20_000)] = 500.0
    """Power of the fans that draw outdoor air through filters and push return air out, at the
    design airflow of the CRAC units, in W per m3/s, 0..20,000: class SFP 1 of EN 16798-3 ends at
    500."""

    @model_validator(mode="after")
    def _dew_points_in_order(self) -> Self:
        if self.min_dew_point_c >= self.max_dew_point_c:
            raise ValueError(
                f"min_dew_point_c {self.min_dew_point_c:g} must be below "
                f"max_dew_point_c {self.max_dew_point_c:g}"
            )
        return self


class PumpConfig(Section):
    """Chilled- and condenser-water pumps."""

    model: Literal["sized", "released"] = "sized"
    """Whether pumps are sized for their flow, or draw the unscaled power of the released
    SustainDC."""
    pressure_drop_pa: Annotated[float, Field(ge=100, le=1e7)] = 300_000.0
    """Pressure drop of each water loop at design flow, in Pa, 100..1e7: from 1 cm of water to ten
    times what flanges of class PN 10 hold."""
    efficiency: WorkingShare = 0.75
    """Hydraulic power over electric power of a pump, 0.01..1."""
    heat_to_water_share: Share = 0.9
    """Share of the power of the chilled-water pumps that warms the chilled water, 0..1: the
    efficiency of motor and drive, whose losses stay with the air beside them; 1 is a motor that
    stands in the water."""
    min_flow_ratio: WorkingShare = 0.6
    """Lowest flow of a running pump over its design flow, 0.01..1."""
    released_chilled_w: DeviceW = 0.0
    """Power of the chilled-water pump of pump model ``released``, in W."""
    released_condenser_w: DeviceW = 0.0
    """Power of the condenser-water pump of pump model ``released``, in W."""


class WaterConfig(Section):
    """Make-up water of the cooling tower."""

    model: Annotated[str, NameIn(WATER)] = "saturated_exit"
    """How evaporation, drift and blowdown of the tower are computed: from air that leaves the tower
    saturated, from heat that leaves as vapour alone, or by the fits of the released SustainDC and
    of its paper."""
    cycles_of_concentration: Annotated[float, Field(ge=1.01, le=1000)] = 5.0
    """Concentration of solids in the tower water divided by that in the make-up water, 1.01..1,000:
    blowdown is 100 times the evaporation at the lower end and a thousandth of it at the upper."""
    drift_share: Annotated[float, Field(ge=0, le=0.01)] = 2e-5
    """Drift over the water flow of the tower, 0..0.01; towers without drift eliminators lose up to
    0.003."""


class SizingConfig(Section):
    """How devices are sized for load and site."""

    model: Literal["design_day", "released"] = "design_day"
    """Rules of sizing: full load on the design day of the site, or the rules of the released
    SustainDC."""
    margin: Annotated[float, Field(ge=1, le=10)] = 1.15
    """Sized cooling power over the cooling load at the design point, 1..10; redundancy of 2N is
    2."""
    design_wet_bulb_c: OutdoorC | None = None
    """Design wet bulb of the site, in C; None takes that of the design conditions of its weather
    file, else the 99.6 % quantile of its weather."""
    design_outdoor_c: OutdoorC | None = None
    """Design dry bulb of the site, in C; None takes that of the design conditions of its weather
    file, else the 99.6 % quantile of its weather, or with sizing model ``released`` 30 in NY, 20 in
    WA and else 50."""

    @model_validator(mode="after")
    def _wet_bulb_below_dry_bulb(self) -> Self:
        dry, wet = self.design_outdoor_c, self.design_wet_bulb_c
        if dry is not None and wet is not None and wet > dry:
            raise ValueError(
                f"design_wet_bulb_c {wet:g} must not be above design_outdoor_c {dry:g}"
            )
        return self


class HvacConfig(Section):
    """Cooling from the CRAC units to the tower."""

    setpoint: SetpointConfig = SetpointConfig()
    """Supply setpoint of the CRAC units."""
    crac: CracConfig = CracConfig()
    """CRAC units and their fans."""
    plant: Plant | None = None
    """How the heat of the hall gets outdoors: by chilled water with a cooling tower and waterside
    economiser, by an air-cooled chiller with a dry cooler, or by outdoor air in the hall with an
    air-cooled chiller for the rest. None is ``water_cooled`` if tower water can cool the
    condenser of the chiller, else ``air_cooled``."""
    cooling_load_model: Annotated[str, NameIn(COOLING_LOADS)] = "heat_balance"
    """How return air and cooling load follow from the hall: a heat balance, or the formulas of the
    released SustainDC or of its paper."""
    chiller: ChillerConfig = ChillerConfig()
    """Chiller and chilled water."""
    tower: TowerConfig = TowerConfig()
    """Cooling tower, condenser water and economiser."""
    dry_cooler: DryCoolerConfig = DryCoolerConfig()
    """Dry cooler of plant ``air_cooled``."""
    outdoor_air: OutdoorAirConfig = OutdoorAirConfig()
    """Outdoor air of plant ``air_side``."""
    pumps: PumpConfig = PumpConfig()
    """Pumps of chilled water and condenser water."""
    water: WaterConfig = WaterConfig()
    """Make-up water of the tower."""
    sizing: SizingConfig = SizingConfig()
    """How devices are sized."""
    total_of: tuple[Device, ...] = (
        "chiller",
        "tower_fan",
        "chilled_pump",
        "condenser_pump",
        "crac_fan",
    )
    """Devices whose power counts in the HVAC total."""

    @field_validator("total_of")
    @classmethod
    def _each_device_once(cls, value: tuple[Device, ...]) -> tuple[Device, ...]:
        if not value or len(set(value)) < len(value):
            raise ValueError(f"{list(value)} must name at least one device and each one once")
        return value

    @property
    def plant_in_use(self) -> Plant:
        """The plant, that of the chiller if the config names none."""
        return plant_of(CHILLERS[self.chiller.model]) if self.plant is None else self.plant

    @model_validator(mode="after")
    def _chiller_fits_the_plant(self) -> Self:
        plant = PLANTS[self.plant_in_use]
        if not fits(CHILLERS[self.chiller.model], plant):
            fitting = {name for name, chiller in CHILLERS.items() if fits(chiller, plant)}
            valid = ", ".join(sorted(fitting if plant.dry else set(CHILLERS) - fitting))
            raise ValueError(
                f"plant {self.plant} and chiller.model {self.chiller.model} do not fit together; "
                f"valid with this plant is {valid if plant.dry else f'any but {valid}'}"
            )
        return self

    @model_validator(mode="after")
    def _chilled_water_within_the_model(self) -> Self:
        bounds_c = CHILLERS[self.chiller.model].chilled_water_bounds_c
        water, rise = self.setpoint.min_c - self.chiller.coil_approach_k, ""
        if self.crac.temperature_control == "return":
            rise_k = 1.0 / (USUAL_AIR_J_PER_M3_K * self.crac.supply_m3s_per_w)
            water, rise = water - rise_k, f" and the rise of the air of {rise_k:.3g} K"
        if bounds_c is not None and water < bounds_c[0]:
            low, high = bounds_c
            raise ValueError(
                f"setpoint.min_c {self.setpoint.min_c:g} less chiller.coil_approach_k "
                f"{self.chiller.coil_approach_k:g}{rise} asks for chilled water of {water:.4g} C; "
                f"model {self.chiller.model} is valid within {low:g}..{high:g} C"
            )
        return self
