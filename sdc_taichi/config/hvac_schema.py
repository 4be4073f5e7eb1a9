"""Section ``hvac``: cooling from the CRAC units to the tower, water use, and sizing of devices."""

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
from sdc_taichi.plant.plants import PLANTS, default_chiller, fits, plant_of
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water import EVAPORATION_PER_K, WATER
from sdc_taichi.types import F64

Device = Literal["chiller", "tower_fan", "chilled_pump", "condenser_pump", "crac_fan"]
USUAL_AIR_J_PER_M3_K = 1.2e3
"""Volumetric heat capacity of air near sea level, in J/(m3 K), for checks and for servers with a
rear door."""
USUAL_COUPLING = 0.75
"""Coupling of CRAC units under a raised floor, between fixed shares and one pressure; an
assumption."""
MOST_CRAC_UNITS = 10_000
"""Largest number of CRAC units of a hall, more than the largest fan walls have fans."""
UnitAirflow = Annotated[float, Field(ge=0.01, le=1000)]
"""Airflow of a CRAC unit, 0.01..1,000 m3/s: from a desk fan to a fan wall of a large hall."""

UnitCapacity = Annotated[float, Field(ge=0.1, le=1e5)]
"""Cooling capacity of a CRAC unit, 0.1..100,000 kW: from a small wall unit to a fan wall."""


class SetpointConfig(Section):
    """Setpoint of the CRAC units: its range, initial value and changes by actions.

    It applies to the supply air, or to the return air with ``crac.temperature_control: return``.
    """

    model: Annotated[str, NameIn(SETPOINTS)] = "symmetric"
    """Model of setpoint changes: a command moves the setpoint by one step, or by a step that grows
    with the number of equal commands in a row, as in the released SustainDC."""
    min_c: AirC = 16.0
    """Lowest setpoint, in C."""
    max_c: AirC = 23.0
    """Highest setpoint, in C."""
    initial_c: AirC = 18.0
    """Setpoint after a reset, in C."""
    schedule_c: tuple[AirC, ...] | tuple[tuple[AirC, ...], ...] | None = None
    """Scheduled setpoint in C, which applies in steps without a cooling command: one value per
    month (12, January first), per local hour of the day (24, midnight first), or per month and hour
    (12 lists of 24). None means no schedule."""
    step_k: Annotated[float, Field(ge=0.001, le=50)] = 1.0
    """Change of the setpoint by one action, in K, 0.001..50: from the resolution of sensors to more
    than any range of setpoints."""

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
        """Return the scheduled setpoint of each hour of the year, in C, (8760,), or None."""
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
    """CRAC units: number, size, fan control, and their shares in the supply air of the racks."""

    units: Annotated[int, Field(ge=1, le=MOST_CRAC_UNITS)] = 1
    """Number of CRAC units, 1..10,000, more than the fan walls of any hall have fans. The units
    alternate between both end walls and are evenly spaced across the rows."""
    spare_units: Annotated[int, Field(ge=0, lt=MOST_CRAC_UNITS)] = 0
    """Number of redundant units, below ``units``: 1 for N+1. The other units can deliver the design
    airflow alone; if all units run, each runs at part speed."""
    airflow_m3s: UnitAirflow | tuple[UnitAirflow, ...] | None = None
    """Airflow of a unit at full speed, in m3/s: one value for all units, or one per unit; None
    computes it from the design airflow, see ``unit_sizes``."""
    unit_sizes: Literal["equal", "by_need"] | None = None
    """Sizes of the units if ``airflow_m3s`` is None: ``equal``, or each in proportion to the need
    of its racks at the design point, ``by_need``. None means ``equal`` with spare units, otherwise
    ``by_need``."""
    unit_shares: tuple[tuple[Share, ...], ...] | None = None
    """Share of each unit in the supply air of each rack, 0..1: one row of shares per rack, and each
    row sums to 1; None computes shares from distances."""
    supply_length_m: LengthM = 6.0
    """Distance at which the weight of a unit in the supply of a rack falls to 1/e, in m."""
    plenum_coupling: Share | None = None
    """Coupling of the units by the plenum under a raised floor, 0..1: with 1 it has one pressure,
    so that racks draw from each unit in proportion to its airflow; with 0 each unit keeps its
    share in the supply of each rack while all units run. None means 0.75, or 0 with
    ``unit_shares``."""
    return_air: Literal["own", "common"] | None = None
    """Return air of the units: ``own``, each draws the exhaust of the racks near it (weights as in
    ``supply_length_m``, from the exhaust faces), or ``common``, all draw the mean of the hall.
    None means ``own``, or ``common`` with ``unit_shares``."""
    capacity_kw: UnitCapacity | tuple[UnitCapacity, ...] | None = None
    """Largest heat that the coil of a unit removes, including the heat of its fan, in kW: one value
    for all units, or one per unit; None means that only the plant limits it."""
    temperature_control: Literal["supply", "return"] = "supply"
    """Air temperature that follows the setpoint: that of the supply air or of the return air of a
    unit. With ``return``, the supply air becomes colder with rising heat load, down to the setpoint
    minus the temperature rise of the air at the design point."""
    supply_m3s_per_w: FlowM3sPerW = 5.663e-5
    """Design airflow of all units divided by IT power at the design point, in m3/s per W."""
    reference_m3s_per_w: FlowM3sPerW = 9.438e-5
    """Airflow divided by IT power at which a fan draws ``released_fan_w``, in m3/s per W."""
    flow_model: Annotated[str, NameIn(CRAC_FLOWS)] = "follow_servers"
    """Control of the fans: ``constant`` at the speed of the design point; ``pressure`` under a
    raised floor, which needs the same airflow whichever units run; ``follow_servers``, the supply
    air that servers take in; ``hottest_inlet`` of the servers; ``per_watt`` of IT power; or
    ``controlled`` by an agent."""
    inlet_target_c: Annotated[float, Field(ge=1, le=60)] = 25.0
    """Hottest inlet at which fans of flow model ``hottest_inlet`` reach full speed, in C, 1..60."""
    inlet_band_k: ExchangerK = 4.0
    """Range of the hottest inlet below ``inlet_target_c`` over which fans of flow model
    ``hottest_inlet`` go from lowest to full speed, in K."""
    min_flow_ratio: WorkingShare = 0.3
    """Lowest airflow of a running unit divided by its airflow at full speed, 0.01..1."""
    fan_step: Annotated[float, Field(ge=0.001, le=1)] = 0.05
    """Change of fan speed by one action, divided by full speed, for flow model ``controlled``,
    0.001..1: from the resolution of drives to the whole range."""
    coasting_flow_ratio: WorkingShare = 0.1
    """Airflow that leaks through the closed dampers of a failed unit, divided by its airflow at
    full speed, 0.01..1."""
    fan_w_per_m3s: Annotated[float, Field(ge=0, le=20_000)] = 1000.0
    """Specific fan power: design fan power divided by design airflow, in W per m3/s, 0..20,000; the
    upper bound is four times the worst class of EN 16798-3."""
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
        if self.unit_sizes is not None and self.airflow_m3s is not None:
            raise ValueError(
                f"unit_sizes {self.unit_sizes!r} sizes units, and airflow_m3s gives their size; "
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

    @property
    def coupling(self) -> float:
        """Coupling of the units by the plenum, 0..1; a single unit has none."""
        if self.units == 1:
            return 0.0
        usual = USUAL_COUPLING if self.unit_shares is None else 0.0
        return usual if self.plenum_coupling is None else self.plenum_coupling

    @property
    def draws_own_return(self) -> bool:
        """True if each unit draws its own return air; a single unit draws that of the hall."""
        usual = "own" if self.unit_shares is None else "common"
        return self.units > 1 and (self.return_air or usual) == "own"

    @property
    def sized_by_need(self) -> bool:
        """True if each unit is sized for the need of the racks that it supplies."""
        if self.airflow_m3s is not None or self.unit_sizes == "equal":
            return False
        return self.unit_sizes == "by_need" or self.spare_units == 0


class ChillerConfig(Section):
    """Chiller model and its reference point."""

    model: Annotated[str, NameIn(CHILLERS)] | None = None
    """Chiller model: power and capacity as functions of load and temperatures. The chilled water is
    never warmer than the valid range of the model. None means ``centrifugal_vsd`` for plant
    ``water_cooled``, and ``eir_air_cooled`` for the other plants."""
    reference_cop: Annotated[float, Field(ge=0.5, le=50)] | None = None
    """COP at the reference point, in W of heat per W of power, 0.5..50: from an absorption chiller
    to Carnot's limit at a lift of 6 K; None uses the default of the model."""
    coil_approach_k: ExchangerK = 8.0
    """Supply air setpoint minus chilled-water supply temperature, in K. The difference is larger
    where the water would be warmer than the chiller can make it."""
    chilled_water_range_k: WaterRangeK = 6.0
    """Chilled-water range at design: return minus supply temperature, in K."""
    coil_valves: bool = True
    """True if control valves adapt the water flow of the coils to their load; the water then
    returns warmer at part load. Without valves, return minus supply temperature is
    ``chilled_water_range_k`` at any load."""
    min_condenser_c: Annotated[float, Field(ge=0, le=60)] = 12.78
    """Lowest temperature of the condenser water that enters the chiller, in C, 0..60: from the
    freezing point of water to the condensing temperatures of refrigerants."""
    max_condenser_c: Annotated[float, Field(ge=20, le=80)] = 40.0
    """Highest temperature of the condenser water that enters the chiller, in C, 20..80: from cold
    climates to heat pumps. Where the tower cannot hold it, the control of the head pressure unloads
    the chiller. The default assumes that a machine with R-123 unloads below 1 bar above air
    pressure, at which its rupture disc breaks (Trane CVHE-SVN02D-EN): 46 to 48 C of condensation
    at 93 % of it (the setting of Trane CVGF-SVX03B-EN), minus the range of the water and 1 to
    2 K."""
    min_lift_k: Annotated[float, Field(ge=0.1, le=50)] = MIN_LIFT_K
    """Smallest lift of the compressor (entering condenser water minus leaving chilled water), in K,
    for models ``centrifugal_vsd`` and ``carnot``, 0.1..50: the COP of ``carnot`` diverges at 0 K,
    and every plant has a smaller lift than 50 K in some hours."""


class TowerConfig(Section):
    """Cooling tower, condenser water and water-side economiser."""

    model: Annotated[str, NameIn(TOWERS)] = "yorkcalc"
    """Tower model: fan power and water temperature as functions of the heat to reject."""
    setpoint: Literal["reset", "approach"] | None = None
    """Setpoint of the water that leaves the tower: ``reset`` by load and wet bulb, so that chiller
    and fan together draw least power, or ``approach``, as cold as chiller or economiser can use
    but at least ``approach_min_k`` above the wet bulb. None means ``reset`` for model ``yorkcalc``
    and ``approach`` for the others, which have no water loop and allow nothing else."""
    approach_min_k: ExchangerK = 4.0
    """Approach at the design point: water from the tower minus wet-bulb temperature, in K. With
    ``setpoint: approach`` it is also the smallest approach at any load."""
    water_range_k: WaterRangeK = 5.56
    """Tower range at the design point: entering minus leaving water temperature, in K."""
    fan_w_per_w_rejected: Annotated[float, Field(ge=0, le=1)] = 0.0126
    """Design fan power divided by the heat rejected at the design point, in W per W, 0..1: at 1 the
    fan would heat the air as much as the rejected heat does."""
    airflow_m3s_per_w_rejected: Annotated[float, Field(ge=5e-6, le=2e-4)] = 2.667e-5
    """Airflow at full fan speed divided by the heat rejected at the design point, in m3/s per W,
    5e-6..2e-4. At a range of 5.56 K the bounds correspond to 7 and 0.2 kg of water per kg of air,
    and the default to 1.4."""
    paper_fan_w: DeviceW = 1000.0
    """CT_FAN_REF_P of the SustainDC format: fan power of the paper's tower at its reference
    airflow, in W."""
    paper_airflow_m3s: Annotated[float, Field(ge=0.01, le=1e6)] = 2.8315
    """CT_REFRENCE_AIR_FLOW_RATE of the SustainDC format: reference airflow of the paper's tower, in
    m3/s, 0.01..1e6: from a fan of 10 cm to the largest towers of power stations and beyond."""
    economiser: bool = True
    """True if a water-side economiser cools the return water upstream of the chiller."""
    economiser_approach_k: RiseK = 5.0
    """Approach of tower and heat exchanger together: coldest water from the exchanger minus
    wet-bulb temperature, in K."""

    @property
    def resets(self) -> bool:
        """True if the setpoint of the tower water follows load and wet bulb."""
        return TOWERS[self.model].water_loop and self.setpoint != "approach"

    @model_validator(mode="after")
    def _reset_needs_water(self) -> Self:
        if self.setpoint == "reset" and not TOWERS[self.model].water_loop:
            raise ValueError(
                f"setpoint reset needs a water loop, which model {self.model} does not have; valid "
                "is approach"
            )
        return self

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
    """True if the chilled water that returns from the coils passes through the dry cooler upstream
    of the chiller."""
    approach_k: ExchangerK = 8.0
    """Approach of the dry cooler at full load without chiller: chilled water minus outdoor air
    temperature, in K. The default is 7 K of the cooler and 1 K of the heat exchanger."""
    fan_w_per_w_cooled: Annotated[float, Field(ge=0, le=1)] = 0.03
    """Design fan power divided by the cooling load at the design point, in W per W, 0..1; coolers
    on the market need 0.02 to 0.04."""


class OutdoorAirConfig(Section):
    """Outdoor air of plant ``air_side``: conditions of its use, and its fans.

    The default limits of moisture are those that ASHRAE TC 9.9 recommends (Thermal Guidelines for
    Data Processing Environments, 5th edition, 2021). The allowable range of class A1 is a dew point
    of -12..17 C and a relative humidity of up to 80 %. The dampers close gradually over the tenth
    of the vapour pressure next to a limit.
    """

    min_dew_point_c: DewPointC = -9.0
    """Lowest dew point at which the plant uses outdoor air, in C."""
    humidifier: bool = True
    """True if an adiabatic humidifier raises the dew point of drier outdoor air to
    ``min_dew_point_c``; without a humidifier the plant does not use drier air."""
    max_dew_point_c: DewPointC = 15.0
    """Highest dew point at which the plant uses outdoor air, in C."""
    max_humidity_pct: Annotated[float, Field(ge=1, le=100)] = 70.0
    """Highest relative humidity that outdoor air may have when heated to the supply setpoint, in %,
    1..100: from the driest desert air to fog."""
    fan_w_per_m3s: Annotated[float, Field(ge=0, le=20_000)] = 500.0
    """Power of the fans that move outdoor air in and exhaust air out, divided by the design airflow
    of the CRAC units, in W per m3/s, 0..20,000; 500 is the upper limit of class SFP 1 of EN
    16798-3."""

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
    """Pump model: sized for the design flow, or with the unscaled power of the released
    SustainDC."""
    pressure_drop_pa: Annotated[float, Field(ge=100, le=1e7)] = 300_000.0
    """Pressure drop of each water loop at design flow, in Pa, 100..1e7: from 1 cm of water to ten
    times what flanges of class PN 10 hold."""
    efficiency: WorkingShare = 0.75
    """Hydraulic power divided by electric power of a pump, 0.01..1."""
    heat_to_water_share: Share = 0.9
    """Share of the power of the chilled-water pumps that heats the chilled water, 0..1. It is the
    efficiency of motor and drive, whose losses heat the surrounding air, or 1 for motors that the
    water cools."""
    min_flow_ratio: WorkingShare = 0.6
    """Lowest flow of a running pump divided by its design flow, 0.01..1."""
    released_chilled_w: DeviceW = 0.0
    """Power of the chilled-water pump of pump model ``released``, in W."""
    released_condenser_w: DeviceW = 0.0
    """Power of the condenser-water pump of pump model ``released``, in W."""


class ChilledWaterConfig(Section):
    """Chilled water and buffer tank, which store heat in transient halls.

    They take up the heat that the plant does not remove while pumps and CRAC fans run. Quasi-steady
    halls ignore both.
    """

    volume_l_per_kw: Annotated[float, Field(ge=0, le=1000)] = 6.46
    """Chilled water in pipes, coils and chiller divided by the cooling capacity, in l/kW, 0..1,000.
    Chillers need at least 3.25 l/kW, and 6.46 to 10.76 l/kW where temperatures are critical
    (Carrier, AquaForce 30XA manual)."""
    tank_m3: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Water in the buffer tank, in m3, 0..1e6; 0 means no tank."""
    tank: Literal["mixed", "stratified"] = "stratified"
    """Kind of tank: ``mixed``, whose water warms with the loop, or ``stratified``, which supplies
    cold water until warm water fills it."""


class WaterConfig(Section):
    """Make-up water of the cooling tower."""

    model: Annotated[str, NameIn(WATER)] = "saturated_exit"
    """Water model of the tower: air that leaves the tower saturated, rejection of all heat by
    evaporation, a loss factor for each kelvin of range, or the fits of the released SustainDC and
    of its paper."""
    evaporation_per_k: Annotated[float, Field(ge=0, le=0.01)] = EVAPORATION_PER_K
    """Loss factor of model ``loss_factor``: evaporation divided by the water flow of the tower, for
    each kelvin of range, 0..0.01; all heat rejected by evaporation would be 0.0017."""
    cycles_of_concentration: Annotated[float, Field(ge=1.01, le=1000)] = 5.0
    """Concentration of solids in tower water divided by that in make-up water, 1.01..1,000: at the
    bounds, blowdown is 100 times and a thousandth of the evaporation."""
    drift_share: Annotated[float, Field(ge=0, le=0.01)] = 2e-5
    """Drift divided by the water flow of the tower, 0..0.01; towers without drift eliminators lose
    up to 0.003."""


class SizingConfig(Section):
    """Sizing of devices for load and site."""

    model: Literal["design_day", "released"] = "design_day"
    """Sizing rules: full load on the design day of the site, or the rules of the released
    SustainDC."""
    margin: Annotated[float, Field(ge=1, le=10)] = 1.15
    """Installed cooling capacity divided by the cooling load at the design point, 1..10; 2 means 2N
    redundancy."""
    design_wet_bulb_c: OutdoorC | None = None
    """Design wet-bulb temperature of the site, in C; None uses the design conditions in its weather
    file or, if there are none, the 99.6 % quantile of its weather."""
    design_outdoor_c: OutdoorC | None = None
    """Design dry-bulb temperature of the site, in C; None uses the design conditions in its weather
    file or, if there are none, the 99.6 % quantile of its weather. With sizing model ``released``,
    None means 30 in NY, 20 in WA and 50 elsewhere."""

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
    """Cooling plant: ``water_cooled`` with a cooling tower and a water-side economiser,
    ``air_cooled`` with an air-cooled chiller and a dry cooler, or ``air_side`` with outdoor air in
    the hall and an air-cooled chiller for the remaining heat. None means ``water_cooled`` if tower
    water can cool the condenser of the configured chiller, else ``air_cooled``."""
    cooling_load_model: Annotated[str, NameIn(COOLING_LOADS)] = "heat_balance"
    """Model of return air and cooling load: a heat balance of the hall, or the formulas of the
    released SustainDC or of its paper."""
    chiller: ChillerConfig = ChillerConfig()
    """Chiller and chilled water."""
    tower: TowerConfig = TowerConfig()
    """Cooling tower, condenser water and economiser."""
    dry_cooler: DryCoolerConfig = DryCoolerConfig()
    """Dry cooler of plant ``air_cooled``."""
    outdoor_air: OutdoorAirConfig = OutdoorAirConfig()
    """Outdoor air of plant ``air_side``."""
    chilled_water: ChilledWaterConfig = ChilledWaterConfig()
    """Chilled water and buffer tank."""
    pumps: PumpConfig = PumpConfig()
    """Pumps of chilled water and condenser water."""
    water: WaterConfig = WaterConfig()
    """Make-up water of the tower."""
    sizing: SizingConfig = SizingConfig()
    """Sizing of devices."""
    total_of: tuple[Device, ...] = (
        "chiller",
        "tower_fan",
        "chilled_pump",
        "condenser_pump",
        "crac_fan",
    )
    """Devices whose power is part of the HVAC total."""

    @field_validator("total_of")
    @classmethod
    def _each_device_once(cls, value: tuple[Device, ...]) -> tuple[Device, ...]:
        if not value or len(set(value)) < len(value):
            raise ValueError(f"{list(value)} must name at least one device and each one once")
        return value

    @property
    def plant_in_use(self) -> Plant:
        """Name of the configured plant, or of the chiller's default plant if none is configured."""
        if self.plant is not None:
            return self.plant
        model = self.chiller.model
        return "water_cooled" if model is None else plant_of(CHILLERS[model])

    @property
    def chiller_in_use(self) -> str:
        """Name of the configured chiller model, or the default of the plant if none is."""
        if self.chiller.model is not None:
            return self.chiller.model
        return default_chiller(PLANTS[self.plant_in_use])

    @model_validator(mode="after")
    def _chiller_fits_the_plant(self) -> Self:
        plant = PLANTS[self.plant_in_use]
        if not fits(CHILLERS[self.chiller_in_use], plant):
            fitting = {name for name, chiller in CHILLERS.items() if fits(chiller, plant)}
            valid = ", ".join(sorted(fitting if plant.dry else set(CHILLERS) - fitting))
            raise ValueError(
                f"plant {self.plant} and chiller.model {self.chiller.model} do not fit together; "
                f"valid with this plant is {valid if plant.dry else f'any but {valid}'}"
            )
        return self

    @model_validator(mode="after")
    def _chilled_water_within_the_model(self) -> Self:
        model = self.chiller_in_use
        bounds_c = CHILLERS[model].chilled_water_bounds_c
        water, rise = self.setpoint.min_c - self.chiller.coil_approach_k, ""
        if self.crac.temperature_control == "return":
            rise_k = 1.0 / (USUAL_AIR_J_PER_M3_K * self.crac.supply_m3s_per_w)
            water, rise = water - rise_k, f" and the rise of the air of {rise_k:.3g} K"
        if bounds_c is not None and water < bounds_c[0]:
            low, high = bounds_c
            raise ValueError(
                f"setpoint.min_c {self.setpoint.min_c:g} less chiller.coil_approach_k "
                f"{self.chiller.coil_approach_k:g}{rise} asks for chilled water of {water:.4g} C; "
                f"model {model} is valid within {low:g}..{high:g} C"
            )
        return self
