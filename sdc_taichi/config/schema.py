"""Schema of one data center: a validated, frozen tree of sections for YAML, overrides and Python.

A preset selects one model per stage (see docs/presets.md); the models do not depend on the preset.
Field names include their units. An unknown key is an error that suggests the nearest valid one.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Literal, Self

import numpy as np
import yaml
from pydantic import Field, field_validator, model_validator

from sdc_taichi.config.electrical_schema import ElectricalConfig, TariffConfig
from sdc_taichi.config.event_schema import (
    LIQUID_EVENTS,
    PLANT_OF_EVENT,
    EventsConfig,
    ProtectionConfig,
)
from sdc_taichi.config.fields import (
    CRate,
    FileName,
    Hours,
    Name,
    NameIn,
    Section,
    Seed,
    Share,
    Text,
    WorkingShare,
    check_one_per_rack,
)
from sdc_taichi.config.fleet_schema import FleetConfig
from sdc_taichi.config.hall_schema import (
    MOST_RACK_J_PER_K,
    MOST_RACK_U,
    OVERSUPPLY_DECAY,
    ROOM_J_PER_K_W,
    SERVER_J_PER_K_W,
    HallConfig,
    ServerConfig,
    ServerGroup,
)
from sdc_taichi.config.hvac_schema import HvacConfig
from sdc_taichi.config.liquid_schema import LiquidConfig, LiquidRack
from sdc_taichi.errors import ConfigError
from sdc_taichi.exogenous.year_clock import YEARS, day_of_year
from sdc_taichi.plant.battery import BATTERIES
from sdc_taichi.plant.workload import MODELS as WORK_MODELS

MOST_RACK_W = 200e3
"""Largest nameplate power of an air-cooled rack, in W. At a temperature rise of 20 K, its airflow
of 8 m3/s would pass a door of 1.3 m2 at 6 m/s. The densest racks on the market have about
100 kW."""


class BatteryConfig(Section):
    """Battery: model, capacity and limits (C/L/C of Kazhamiaka, Rosenberg and Keshav 2019)."""

    model: Annotated[str, NameIn(BATTERIES)] = "clc"
    """Battery model: energy stored, drawn and delivered as functions of a command."""
    capacity_kwh: Annotated[float, Field(ge=0, le=1e8)] | None = None
    """Battery capacity, in kWh, up to 1e8, five times the largest plant under construction (19 GWh,
    Abu Dhabi 2025); None sizes the battery by ``hours_of_design_load``."""
    hours_of_design_load: Annotated[float, Field(ge=0, le=1000)] = 1.0
    """Time for which a full battery could supply the facility at its design power, in h, 0..1,000;
    iron-air batteries, which discharge most slowly, reach 100 h."""
    initial_soc: Share = 0.0
    """State of charge after a reset, 0..1."""
    charge_efficiency: WorkingShare = 0.945
    """Energy stored divided by energy drawn from the bus, without ``square_loss_h`` and standby,
    0.01..1."""
    discharge_factor: Annotated[float, Field(ge=1, le=100)] = 1.066
    """Energy taken from the store divided by energy delivered to the bus, without ``square_loss_h``
    and standby, 1..100: from no loss to an efficiency of 1 %."""
    square_loss_h: Annotated[float, Field(ge=0, le=100)] = 0.02
    """Loss of conversion that rises with the square of the power P, in h, 0..100, for model
    ``clc``: the loss is ``square_loss_h`` P^2/capacity, so 0.02 means 2 % of the power at a rate of
    1/h. It includes the resistance of the cells."""
    standby_per_h: Annotated[float, Field(ge=0, le=1)] = 0.0015
    """Power drawn from the bus at all times by inverter, transformer, cooling and controls, divided
    by the capacity, in 1/h, 0..1, for model ``clc``; an outage of the grid ends it."""
    charge_limit_c_rate: CRate = 0.5
    """Largest rate at which the stored energy rises, in capacities per hour (1/h)."""
    discharge_limit_c_rate: CRate = 1.0
    """Largest rate at which the stored energy falls, in capacities per hour (1/h)."""
    upper_u_h: Annotated[float, Field(ge=-100, le=0)] = -0.04
    """Slope u of the upper limit of the stored energy, u P + v capacity, against the charge power
    P, in h, -100..0."""
    upper_v: Share = 1.0
    """Share v of the capacity in the upper limit of the stored energy, 0..1."""
    lower_u_h: Annotated[float, Field(ge=0, le=100)] = 0.01
    """Slope u of the lower limit of the stored energy, u P + v capacity, against the discharge
    power P, in h, 0..100."""
    lower_v: Share = 0.0
    """Share v of the capacity in the lower limit of the stored energy, 0..1."""

    @model_validator(mode="after")
    def _limits(self) -> Self:
        if self.lower_v >= self.upper_v:
            raise ValueError(f"lower_v {self.lower_v:g} must be below upper_v {self.upper_v:g}")
        # At a higher power more energy would be lost than stored in addition.
        most_h = self.charge_efficiency / (4.0 * self.charge_limit_c_rate)
        if self.model == "clc" and self.square_loss_h > most_h:
            raise ValueError(
                f"square_loss_h {self.square_loss_h:g} with charge_limit_c_rate "
                f"{self.charge_limit_c_rate:g}: no power reaches this rate; valid is at most "
                f"{most_h:.3g} h, charge_efficiency / (4 charge_limit_c_rate)"
            )
        return self


class ZoneLoadsConfig(Section):
    """Loads of the zones of a hall: blocks of its rows and of the places in these rows.

    The load of a zone is an Ornstein-Uhlenbeck process around a mean that is drawn for each run,
    clipped to its limits. Zones are numbered from the first row, and in it from the first place.
    """

    row_blocks: Annotated[int, Field(ge=1, le=1000)] = 2
    """Number of blocks into which the rows are divided, of equal size up to one row, 1..1,000."""
    place_blocks: Annotated[int, Field(ge=1, le=1000)] = 2
    """Number of blocks into which the places of a row are divided, of equal size up to one place,
    1..1,000."""
    low: WorkingShare = 0.1
    """Lowest load, 0.01..1."""
    high: WorkingShare = 1.0
    """Highest load, 0.01..1."""
    mean: tuple[WorkingShare, WorkingShare] = (0.3, 0.9)
    """Range of the means: that of each zone and run is uniformly distributed in it."""
    deviation: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Standard deviation of a load from its mean before it is clipped, 0..1."""
    reversion_h: Hours = 2.0
    """Time in which the correlation of a load with its present value falls to 1/e, in h."""
    fixed: tuple[WorkingShare, ...] | None = None
    """Constant load of each zone, in place of the process, 0.01..1; None means the process."""

    @property
    def zones(self) -> int:
        """Number of zones."""
        return self.row_blocks * self.place_blocks

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        low, high = self.mean
        if not self.low <= low <= high <= self.high:
            raise ValueError(
                f"mean ({low:g}, {high:g}) with low {self.low:g} and high {self.high:g}: valid is "
                "low <= mean.0 <= mean.1 <= high"
            )
        if self.fixed is not None and len(self.fixed) != self.zones:
            raise ValueError(
                f"fixed has {len(self.fixed)} loads; valid is {self.zones}, row_blocks "
                f"{self.row_blocks} x place_blocks {self.place_blocks}"
            )
        return self


class WorkloadConfig(Section):
    """Delay-tolerant work: its share, queue and deadline (1 task = 1 % of capacity for a step)."""

    model: Annotated[str, NameIn(WORK_MODELS)] = "fluid"
    """Work model: a continuous quantity, whole tasks, or whole tasks as the released SustainDC
    counts them."""
    trace: Name = "alibaba_1"
    """Name of the workload trace (see ``sdc-taichi data list``)."""
    zone_loads: ZoneLoadsConfig | None = None
    """Loads of the zones of the hall, which replace the arriving work of ``trace`` and, without an
    action for placement, its distribution over the racks; they need placement ``weights``. None
    means the work of ``trace``."""
    placement: Literal["uniform", "fill", "coolest-first", "inlet-aware", "weights"] = "uniform"
    """Policy that distributes the work of a step over the racks."""
    flexible_share: Share = 0.2
    """Share of the work that may wait, 0..1."""
    max_utilisation: WorkingShare = 1.0
    """Highest utilisation of the data center, 0.01..1."""
    queue_limit_h: Hours | None = 2.5
    """Queue capacity, in hours of work of the whole data center at full utilisation; None means an
    unlimited queue."""
    deadline_h: Hours | None = 24.0
    """Time after which waiting work is due, in h; None means no deadline."""
    age_horizon_h: Hours = 24.0
    """Largest age of waiting work that is tracked, in h; all older work counts as one step older
    than this age."""

    @model_validator(mode="after")
    def _deadline_within_horizon(self) -> Self:
        if self.deadline_h is not None and self.deadline_h > self.age_horizon_h:
            raise ValueError(
                f"deadline_h {self.deadline_h:g} must not exceed "
                f"age_horizon_h {self.age_horizon_h:g}"
            )
        return self

    @model_validator(mode="after")
    def _zones_place_the_work(self) -> Self:
        if self.zone_loads is not None and self.placement != "weights":
            raise ValueError(
                f"zone_loads with placement {self.placement}: valid is placement weights, by which "
                "each rack runs at the load of its zone"
            )
        return self


class SiteConfig(Section):
    """Location of the data center, first day of a run, and input files."""

    location: Name = "NY"
    """Name of the site, which selects weather and carbon intensity (see ``sdc-taichi data
    list``)."""
    start: str = "01-01"
    """Month and day of the first step, MM-DD, local standard time."""
    year: Annotated[int, Field(ge=YEARS[0], le=YEARS[1])] | None = None
    """Calendar year of the first step in time stamps; None uses the year of the weather, carbon or
    workload file, the first of them that has one, or else 2018. It selects no data."""
    seed: Seed = 10
    """Seed of the synthetic year, which does not affect imported data."""
    weather_file: FileName | None = None
    """EPW file that replaces the weather of ``location``; None uses no file."""
    carbon_file: FileName | None = None
    """CSV file that replaces the carbon intensity of ``location``; None uses no file."""
    workload_file: FileName | None = None
    """CSV file that replaces the workload trace; None uses no file."""
    carbon_pairing: Literal["local", "utc_rows"] = "local"
    """Time alignment of carbon intensity and weather: both in local standard time, or carbon
    intensity in UTC combined with weather in local time, as in the released SustainDC."""

    @field_validator("start", mode="before")
    @classmethod
    def _month_day(cls, value: Any) -> Any:
        day_of_year(value)
        return value


class SimulationConfig(Section):
    """Time step and thermal model."""

    thermal: Literal["quasi_steady", "transient"] = "quasi_steady"
    """Thermal model: ``quasi_steady`` temperatures depend on the present step alone; ``transient``
    temperatures include the thermal mass of servers and room."""
    substep_s: Annotated[float, Field(ge=5, le=120)] = 60.0
    """Longest substep of the transient thermal model, in s."""
    steps_per_hour: Annotated[int, Field(ge=1, le=60)] = 4
    """Number of steps in an hour."""

    @field_validator("steps_per_hour")
    @classmethod
    def _divides(cls, value: int) -> int:
        if 60 % value:
            raise ValueError(
                f"{value} does not divide 60 minutes; "
                "valid are 1, 2, 3, 4, 5, 6, 10, 12, 15, 20, 30, 60"
            )
        return value


class DataCenterConfig(Section):
    """Complete configuration of one data center."""

    name: Name = "dc"
    """Name of the data center in results and messages."""
    description: Text = ""
    """Description of the data center, on one line."""
    hall: HallConfig
    """Racks, their approach temperatures and the layout of the hall."""
    servers: ServerConfig = ServerConfig()
    """Power and airflow of the servers."""
    hvac: HvacConfig = HvacConfig()
    """Cooling from the CRAC units to the tower."""
    liquid: LiquidConfig | None = None
    """Liquid cooling of racks whose type has ``liquid``; None without such racks."""
    battery: BatteryConfig = BatteryConfig()
    """Battery between grid and facility."""
    electrical: ElectricalConfig = ElectricalConfig()
    """Grid connection, UPS and distribution."""
    tariff: TariffConfig = TariffConfig()
    """Prices of electricity."""
    workload: WorkloadConfig = WorkloadConfig()
    """Work of the servers and its queue."""
    protection: ProtectionConfig = ProtectionConfig()
    """Protection of servers from hot air."""
    events: EventsConfig = EventsConfig()
    """Failures and weather events of a run."""
    site: SiteConfig = SiteConfig()
    """Location, input files, and first day of a run."""
    simulation: SimulationConfig = SimulationConfig()
    """Time step and thermal mass."""
    fleet: FleetConfig | None = None
    """Sites that share work; None describes a data center alone."""

    @model_validator(mode="after")
    def _air_models_fit_together(self) -> Self:
        if self.hall.inlet_model == "approach":
            self._check_approach_model()
        else:
            self._check_recirculation_model()
        return self

    def _check_approach_model(self) -> None:
        kinds = {e.kind for e in self.events.scheduled} | {e.kind for e in self.events.sampled}
        crac = self.hvac.crac
        needs_air_flows = {
            f"hvac.crac.units {crac.units}": crac.units > 1,
            "hvac.crac.airflow_m3s": crac.airflow_m3s is not None,
            "hvac.crac.capacity_kw": crac.capacity_kw is not None,
            "hvac.crac.temperature_control return": crac.temperature_control == "return",
            f"hvac.crac.flow_model {crac.flow_model}": crac.flow_model
            in ("pressure", "hottest_inlet"),
            "hall.recirculation.matrix_file": self.hall.recirculation.matrix_file is not None,
            "simulation.thermal transient": self.simulation.thermal == "transient",
            "event crac_down": "crac_down" in kinds,
            "event rack_fan_failure": "rack_fan_failure" in kinds,
        }
        for setting, is_used in needs_air_flows.items():
            if is_used:
                raise ValueError(f"{setting} needs hall.inlet_model recirculation")

    def _check_recirculation_model(self) -> None:
        groups, hvac = self._given_groups().values(), self.hvac
        conditions = {
            "servers.outlet_model server": self.servers.outlet_model == "server",
            "hvac.cooling_load_model heat_balance": hvac.cooling_load_model == "heat_balance",
            "another hvac.crac.flow_model than per_watt": hvac.crac.flow_model != "per_watt",
            "hall.supply_approach_limits_k null": self.hall.supply_approach_limits_k is None,
            "inlet_offset_k 0 of all groups (hall.height_zones takes its place)": not any(
                g.inlet_offset_k for rack in groups for g in rack
            ),
        }
        for condition, is_met in conditions.items():
            if not is_met:
                raise ValueError(f"hall.inlet_model recirculation needs {condition}")

    @model_validator(mode="after")
    def _events_fit_the_plant(self) -> Self:
        plant = self.hvac.plant_in_use
        for name in ("scheduled", "sampled"):
            for index, event in enumerate(getattr(self.events, name)):
                needed = PLANT_OF_EVENT.get(event.kind, plant)
                if needed != plant:
                    raise ValueError(
                        f"events.{name}.{index}.kind {event.kind} needs hvac.plant {needed}, "
                        f"not {plant}"
                    )
                if event.kind == "link_down" and self.fleet is None:
                    raise ValueError(
                        f"events.{name}.{index}.kind link_down needs a fleet; valid with "
                        "fleet.sites"
                    )
                if event.kind in LIQUID_EVENTS and self.liquid is None:
                    raise ValueError(
                        f"events.{name}.{index}.kind {event.kind} needs section liquid"
                    )
        return self

    @model_validator(mode="after")
    def _names_existing_places(self) -> Self:
        crac, racks = self.hvac.crac, self.hall.racks
        cdus = 0 if self.liquid is None else self.liquid.cdus.count
        for index, event in enumerate(self.events.scheduled):
            units = cdus if event.kind in LIQUID_EVENTS else crac.units
            for name, limit in (("unit", units), ("rack", racks)):
                number = getattr(event, name)
                if number is not None and number >= limit:
                    raise ValueError(
                        f"events.scheduled.{index}.{name} {number}: valid is 0..{limit - 1}"
                    )
            sites = () if self.fleet is None else self.fleet.sites
            if event.site is not None and event.site.upper() not in map(str.upper, sites):
                raise ValueError(
                    f"events.scheduled.{index}.site {event.site!r}: valid is one of "
                    f"{', '.join(sites)}"
                )
            if event.kind == "leak" and event.rack not in self.liquid_racks():
                raise ValueError(
                    f"events.scheduled.{index}.rack {event.rack}: is no liquid-cooled rack"
                )
        check_one_per_rack("hvac.crac.unit_shares", crac.unit_shares, racks)
        for rack, shares in enumerate(crac.unit_shares or ()):
            if len(shares) != crac.units or abs(sum(shares) - 1.0) > 1e-9:
                raise ValueError(
                    f"hvac.crac.unit_shares of rack {rack}: {len(shares)} entries that sum to "
                    f"{sum(shares):g}; valid is {crac.units} (hvac.crac.units) that sum to 1"
                )
        return self

    @model_validator(mode="after")
    def _liquid_fits_the_racks(self) -> Self:
        names = [
            name for name, kind in self.hall.rack_types.items() if kind.liquid_rack is not None
        ]
        racks = len(self.liquid_racks())
        if self.liquid is None:
            if racks:
                raise ValueError(
                    f"hall.rack_types.{names[0]} is liquid-cooled, but section liquid is missing; "
                    "valid is a section such as liquid: {setpoint_c: 40}"
                )
            return self
        if not racks:
            raise ValueError(
                "liquid is given, but no rack is liquid-cooled; valid is null, or a type of "
                "hall.rack_types with liquid or model gb200_nvl72"
            )
        if self.liquid.cdus.manifolds > racks:
            raise ValueError(
                f"liquid.cdus.manifolds {self.liquid.cdus.manifolds}: valid is 1..{racks}, one for "
                "each liquid-cooled rack"
            )
        needs = {
            "hall.inlet_model recirculation": self.hall.inlet_model == "recirculation",
            "hall.capacity_mw null": self.hall.capacity_mw is None,
            "hvac.sizing.model design_day": self.hvac.sizing.model == "design_day",
            "workload.model fluid": self.workload.model == "fluid",
        }
        for condition, is_met in needs.items():
            if not is_met:
                raise ValueError(f"liquid-cooled racks need {condition}")
        if self.liquid.facility.trim_by == "plant" and self.hvac.plant == "air_side":
            raise ValueError(
                "liquid.facility.trim_by plant with hvac.plant air_side: its outdoor air cools no "
                "water; valid is plant water_cooled or air_cooled, or trim_by chiller"
            )
        return self

    @model_validator(mode="after")
    def _zones_fit_the_hall(self) -> Self:
        zones, hall = self.workload.zone_loads, self.hall
        blocks = () if zones is None else (zones.row_blocks, zones.place_blocks)
        names = (("row_blocks", "rows"), ("place_blocks", "racks_per_row"))
        for (block, name), count in zip(names, blocks, strict=False):
            if count > getattr(hall, name):
                raise ValueError(
                    f"workload.zone_loads.{block} {count}: valid is 1..{getattr(hall, name)}, "
                    f"hall.{name}"
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
    def _work_can_move(self) -> Self:
        if self.fleet is None:
            return self
        if self.workload.model != "fluid":
            raise ValueError(f"workload.model {self.workload.model}: a fleet needs fluid")
        hours = self.workload.deadline_h or self.workload.age_horizon_h
        steps = round(hours * self.simulation.steps_per_hour)
        if self.fleet.delay_steps > steps:
            raise ValueError(
                f"fleet.delay_steps {self.fleet.delay_steps}: work would arrive after its "
                f"deadline; valid is 1..{steps}"
            )
        return self

    @model_validator(mode="after")
    def _servers_fit_the_racks(self) -> Self:
        racks, groups = self.hall.racks, self.servers.groups
        if self.hall.rack_types:
            for name in ("power_w", "groups"):
                if getattr(self.servers, name) is not None:
                    raise ValueError(
                        f"hall.rack_types and servers.{name} are both given; valid is one, "
                        f"servers.{name} null for rack_types"
                    )
        elif groups is None:
            check_one_per_rack("servers.power_w", self.servers.power_pairs, racks, one_for_all=True)
        else:
            check_one_per_rack("servers.groups", groups, racks, one_for_all=True)
        for where, rack in self._given_groups().items():
            _check_rack(where, rack)
        self._check_airflow()
        rack_w = self.rack_nameplate_w()
        most = int(np.argmax(rack_w))
        if rack_w[most] > MOST_RACK_W:
            raise ValueError(
                f"hall: rack {most} has servers of {rack_w[most] / 1e3:.4g} kW; valid is at most "
                f"{MOST_RACK_W / 1e3:g} kW in air (power_w is in W; fewer servers or more racks)"
            )
        return self

    def _check_airflow(self) -> None:
        """Raise an error if the airflow of servers is not positive at their coldest inlets."""
        racks, groups = self.hall.racks, self._listed_groups()
        lowest_k = np.array([min(g.inlet_offset_k for g in r) for r in groups] if groups else [0.0])
        approach_k = np.zeros(racks)
        if self.hall.inlet_model == "approach":
            approach_k = self.hall.rack_approach_k()
        coldest_c = self.hvac.setpoint.min_c + lowest_k + approach_k
        ratio = self.servers.curves.airflow_ratio(coldest_c, np.zeros(racks))
        worst = int(np.argmin(ratio))
        if ratio[worst] <= 0:
            raise ValueError(
                f"servers: the airflow ratio is {ratio[worst]:.3g} at {coldest_c[worst]:g} C, the "
                f"coldest inlet of rack {worst}, and no load; it must be positive (raise "
                "the curve of fan_airflow_points or fan_airflow_ratio_lb, or set "
                "fan_airflow_ratio_limits)"
            )

    @property
    def oversupply_decay(self) -> float:
        """Decay of the exhaust shares with oversupply, see ``RecirculationConfig``."""
        recirculation = self.hall.recirculation
        if recirculation.oversupply_decay is not None:
            return recirculation.oversupply_decay
        if self.hvac.crac.units == 1 or recirculation.matrix_file is not None:
            return 0.0
        return OVERSUPPLY_DECAY[self.hall.layout.returns]

    @property
    def server_heat_capacity_kj_per_k(self) -> float:
        """Mean heat capacity of one server of the hall, in kJ/K."""
        configured = self.servers.heat_capacity_kj_per_k
        if configured is not None:
            return configured
        by_power = SERVER_J_PER_K_W * self.rack_nameplate_w()
        share = np.minimum(by_power, MOST_RACK_J_PER_K).sum() / by_power.sum()
        return float(share) * SERVER_J_PER_K_W * self._mean_server_w() / 1e3

    @property
    def room_heat_capacity_kj_per_k(self) -> float:
        """Heat capacity of coils, floor and the rest of the room, in kJ/K per server."""
        configured = self.hall.room_heat_capacity_kj_per_k_per_server
        return ROOM_J_PER_K_W * self._mean_server_w() / 1e3 if configured is None else configured

    def _mean_server_w(self) -> float:
        """Return the mean power of the hall's servers at full load, without fans, in W."""
        listed = self._listed_groups()
        if listed is None:
            count = np.asarray(self.hall.servers_per_rack, dtype=np.float64)
            full_w = np.array([full for full, _ in self.servers.power_pairs])
            return float((count * full_w).mean() / count.mean())
        groups = [group for rack in listed for group in rack]
        return sum(g.count * g.full_w for g in groups) / sum(g.count for g in groups)

    def rack_nameplate_w(self) -> np.ndarray:
        """Return the power of every rack's servers at full load, without fans, in W, (R,)."""
        groups = self._listed_groups()
        if groups is None:
            full_w = np.array([full for full, _ in self.servers.power_pairs])
            rack_w = full_w * np.asarray(self.hall.servers_per_rack, dtype=np.float64)
        else:
            rack_w = np.array([sum(g.count * g.full_w for g in r) for r in groups])
        rack_w = np.broadcast_to(rack_w, (self.hall.racks,))
        if self.hall.capacity_mw is None:
            return rack_w
        return np.asarray(rack_w * (self.hall.capacity_mw * 1e6 / rack_w.sum()))

    def liquid_racks(self) -> dict[int, LiquidRack]:
        """Return the liquid-cooled racks by their index in the hall."""
        types = self.hall.rack_types
        if all(kind.liquid_rack is None for kind in types.values()):
            return {}
        kinds = {name: kind.liquid_rack for name, kind in types.items()}
        of_racks = enumerate(kinds[name] for name in self.hall.rack_type_names())
        return {rack: liquid for rack, liquid in of_racks if liquid is not None}

    def plate_racks(self) -> dict[int, LiquidRack]:
        """Return the racks with cold plates by their index in the hall."""
        return {rack: liquid for rack, liquid in self.liquid_racks().items() if liquid.gpus > 0}

    def _given_groups(self) -> dict[str, tuple[ServerGroup, ...]]:
        """Return all configured server groups by the path of their field."""
        types = {f"hall.rack_types.{k}": v.air_servers for k, v in self.hall.rack_types.items()}
        racks = {f"servers.groups rack {i}": r for i, r in enumerate(self.servers.groups or ())}
        return types | racks

    def _listed_groups(self) -> tuple[tuple[ServerGroup, ...], ...] | None:
        """Return the server groups of every rack, or one entry for all racks, or None."""
        return _groups_of_types(self.hall) or self.servers.groups

    def rack_groups(self) -> tuple[tuple[ServerGroup, ...], ...]:
        """Return the server groups of every rack, with counts scaled to ``hall.capacity_mw``.

        Raises:
            ConfigError: The capacity leaves racks without servers.
        """
        racks, listed = self.hall.racks, self._listed_groups()
        if listed is not None:
            per_rack = listed * racks if len(listed) == 1 else listed
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
        return per_rack if self.hall.capacity_mw is None else self._scaled_to_capacity(per_rack)

    def _scaled_to_capacity(
        self, per_rack: tuple[tuple[ServerGroup, ...], ...]
    ) -> tuple[tuple[ServerGroup, ...], ...]:
        assert self.hall.capacity_mw is not None
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
        """Return YAML text that ``load_config`` reads back as an equal configuration."""
        values = self.model_dump(mode="json")
        text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True)
        if all(map(str.isprintable, text.split("\n"))):
            return text
        # Escape control characters, which could otherwise affect a terminal that shows the text.
        return yaml.safe_dump(values, sort_keys=False)


@lru_cache(maxsize=64)
def _groups_of_types(hall: HallConfig) -> tuple[tuple[ServerGroup, ...], ...]:
    """Return the server groups of the type of every rack, (R,); empty without ``rack_types``."""
    types = hall.rack_types
    return tuple(types[name].air_servers for name in hall.rack_type_names())


def _check_rack(where: str, rack: tuple[ServerGroup, ...]) -> None:
    """Raise an error if the servers of a rack do not fit into it, or if one is overloaded."""
    if not rack:
        raise ValueError(f"{where} is empty; valid is at least one group")
    height_u = sum(g.count * g.height_u for g in rack if g.height_u is not None)
    if height_u > MOST_RACK_U:
        raise ValueError(
            f"{where}: servers of {height_u:g} units of height; the tallest racks have "
            f"{MOST_RACK_U:g}"
        )
    mean = sum(g.count * g.load_weight for g in rack) / sum(g.count for g in rack)
    if mean <= 0:
        raise ValueError(f"{where}: at least one load_weight must be positive")
    highest = max(g.load_weight for g in rack)
    if highest > 2 * mean:
        raise ValueError(
            f"{where}: load_weight {highest:g} exceeds twice the rack's mean {mean:.3g}, which "
            "would overload the server at partial load"
        )
