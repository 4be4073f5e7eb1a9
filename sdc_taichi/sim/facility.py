"""From the air of the halls to the grid: CRAC units, plant, water, battery, carbon and indices.

One pass over B data centers, plain NumPy, which a step runs compiled. Quantities have the names of
``StepResult`` on the way.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from sdc_taichi.hall import air_metrics
from sdc_taichi.plant import cooling
from sdc_taichi.plant.battery import BATTERIES, BatteryResult
from sdc_taichi.plant.carbon import emitted_g
from sdc_taichi.plant.chiller import CHILLERS
from sdc_taichi.plant.electrical import NO_LIMIT_KW, overload_kwh, power_path_loss_w
from sdc_taichi.plant.fans_pumps import crac_fan_w
from sdc_taichi.plant.plants import DRY_PLANTS, PLANTS
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water import WATER, WaterUse
from sdc_taichi.plant.water_side import WaterSideResult
from sdc_taichi.sim.fleet import NO_LIMIT_W, Fleet
from sdc_taichi.sim.sizing import Sizing, air_j_per_m3_k, mean_return_approach_k, sites_pressure_pa
from sdc_taichi.types import F64, StepResult, as_array, fields_of

NOT_USED = cast(F64, None)
BATTERY_PARAMETERS = (
    "charge_efficiency",
    "discharge_factor",
    "charge_limit_c_rate",
    "discharge_limit_c_rate",
    "upper_u_h",
    "upper_v",
    "lower_u_h",
    "lower_v",
)
"""Parameters of the battery models, by their names as arguments and in section ``battery``."""
_PLANT_INPUTS = ("plant_setpoint_c", "outdoor_c", "wet_bulb_c")
_PLANT_EVENT_INPUTS = ("powered", "chiller_share", "pump_share", "outdoor_units", "coil_share")
_STEP_INPUTS = (
    "cpu_w",
    "it_fan_w",
    "it_airflow_m3s",
    "over_27_sum_k",
    "under_18_sum_k",
    "inlet_m3k_s",
    "outlet_m3k_s",
    "supply_c",
    "ci_g_per_kwh",
    "price_per_kwh",
    "battery_command",
    "stored_kwh",
    "room_heat_kwh",
)
_RECIRCULATION_INPUTS = ("crac_flow_m3s", "return_c", "cubed_flow_m3s")
_APPROACH_INPUTS = ("outlet_mean_c", "fan_speed")
_TRANSIENT_INPUTS = ("cooling_load_w", "coil_w", "room_j")
_EVENT_INPUTS = ("grid_up", "no_unit_down")
_RESULTS = {f.name for f in fields(StepResult)}


@dataclass(frozen=True, slots=True)
class FacilityInputs:
    """Inputs of a step of B data centers; those that no model of a fleet reads are left out.

    Sums go over the CRAC units, racks or servers of a data center.
    """

    plant_setpoint_c: F64
    """Supply air setpoint that the chilled water follows, in C, (B,)."""
    outdoor_c: F64
    """Dry-bulb temperature outside, in C, (B,)."""
    wet_bulb_c: F64
    """Wet-bulb temperature outside, in C, (B,)."""

    cpu_w: F64 = NOT_USED
    """Power of the processors, in W, (B,)."""
    it_fan_w: F64 = NOT_USED
    """Power of the server fans, in W, (B,)."""
    it_airflow_m3s: F64 = NOT_USED
    """Airflow through the servers, in m3/s, (B,)."""
    over_27_sum_k: F64 = NOT_USED
    """Sum over the servers of the inlet temperature in excess of 27 C, in K, (B,)."""
    under_18_sum_k: F64 = NOT_USED
    """Sum over the servers of the inlet temperature's shortfall below 18 C, in K, (B,)."""
    inlet_m3k_s: F64 = NOT_USED
    """Sum over the racks of airflow times inlet temperature over supply, in m3 K/s, (B,)."""
    outlet_m3k_s: F64 = NOT_USED
    """Sum over the racks of airflow times outlet temperature over supply, in m3 K/s, (B,)."""
    supply_c: F64 = NOT_USED
    """Supply air temperature, mean over the CRAC airflow, in C, (B,)."""
    outlet_mean_c: F64 = NOT_USED
    """Outlet temperature, plain mean over the racks, in C, (B,); for inlet model ``approach``."""
    fan_speed: F64 = NOT_USED
    """Controlled speed of the CRAC fan over design speed, (B,); for inlet model ``approach``."""
    crac_flow_m3s: F64 = NOT_USED
    """Airflow of the CRAC units, in m3/s, (B,); for halls that recirculate."""
    return_c: F64 = NOT_USED
    """Temperature of the air that returns to the CRAC units, in C, (B,); for halls that
    recirculate."""
    cubed_flow_m3s: F64 = NOT_USED
    """Sum over the CRAC units of design airflow times the mean cube of the fan speed over design
    speed, in m3/s, (B,); for halls that recirculate."""
    cooling_load_w: F64 = NOT_USED
    """Heat of air and fans that reaches the CRAC units, in W, (B,); for transient halls."""
    coil_w: F64 = NOT_USED
    """Heat that the coils take out, in W, (B,); for transient halls."""
    room_j: F64 = NOT_USED
    """Heat held by the room at the end of the step over that at the setpoint, in J, (B,); for
    transient halls."""

    ci_g_per_kwh: F64 = NOT_USED
    """Carbon intensity of the grid, in g CO2 per kWh, (B,)."""
    price_per_kwh: F64 = NOT_USED
    """Price of a kWh from the grid, in the currency of the tariff, (B,)."""
    battery_command: F64 = NOT_USED
    """Share of the battery's power limit, discharged (below 0) or charged, -1..1, (B,)."""
    stored_kwh: F64 = NOT_USED
    """Energy in the battery at the start of the step, in kWh, (B,)."""
    room_heat_kwh: F64 = NOT_USED
    """Heat held by the room at the start of the step, in kWh, (B,)."""

    powered: F64 = NOT_USED
    """Share of the step with power, 0..1, (B,); for fleets with events."""
    grid_up: F64 = NOT_USED
    """1 with grid, 0 in an outage, (B,); for fleets with events."""
    chiller_share: F64 = NOT_USED
    """Share of the chiller's capacity that is available, 0..1, (B,); for fleets with events."""
    pump_share: F64 = NOT_USED
    """Share of the chilled-water pumps that are in order, 0..1, (B,); for fleets with events."""
    outdoor_units: F64 = NOT_USED
    """Share of tower cells, dry coolers or openings for outdoor air that are in order, 0..1, (B,);
    for fleets with events."""
    coil_share: F64 = NOT_USED
    """Airflow at full speed of the CRAC units that run over that of the design point, at most 1,
    (B,); for fleets with events."""
    no_unit_down: F64 = NOT_USED
    """1 if all CRAC units run, 0 if one is down, (B,); for fleets with events."""
    coil_limit_w: F64 = NOT_USED
    """Capacity of the coils of the CRAC units that run, in W, (B,); for fleets with such limits."""


@dataclass(frozen=True, slots=True)
class _CracAir:
    """Air of the CRAC units of B data centers in one step."""

    crac_flow_m3s: F64
    """Airflow of the CRAC units, in m3/s, (B,)."""
    crac_fan_w: F64
    """Power of the CRAC fans, in W, (B,)."""
    supply_c: F64
    """Supply air temperature, mean over the CRAC airflow, in C, (B,)."""
    return_c: F64
    """Temperature of the air that returns to the CRAC units, in C, (B,)."""
    cooling_load_w: F64
    """Heat that the CRAC units take from the room, in W, (B,)."""


@dataclass(frozen=True, slots=True)
class _HeatBalance:
    """Heat that the plants of B data centers leave in the room or fetch from it in one step."""

    unmet_w: F64
    """Cooling load that is not removed, in W, (B,)."""
    recovered_w: F64
    """Heat held earlier that is removed, in W, (B,)."""
    room_heat_kwh: F64
    """Heat held by the room at the end of the step, in kWh, (B,)."""


class Facility:
    """Models and sized devices of a fleet, behind its halls.

    Args:
        fleet: B data centers.
        sizing: Their sized devices.
        event_free: Whether no event can ever happen: all is in order and has power.
    """

    def __init__(self, fleet: Fleet, sizing: Sizing, *, event_free: bool) -> None:
        v, models = fleet.values, fleet.models
        self._sizing, self._event_free = sizing, event_free
        self._step_h = 1.0 / fleet.steps_per_hour
        self._servers = fleet.per_dc_servers()
        classes = [air_metrics.allowable_c(c.protection.ashrae_class) for c in fleet.configs]
        self._allowable_c = np.array(classes).T.copy()
        self._hvac_devices = fleet.configs[0].hvac.total_of
        self._counts_losses = fleet.configs[0].electrical.losses == "counted"
        self._recirculates = models["inlet"] == "recirculation"
        self._transient = models["thermal"] == "transient"
        self._stores_heat = models["cooling_load"] in cooling.STORES_UNMET_HEAT
        self._flow = cooling.CRAC_FLOWS[models["crac_flow"]]
        self._load = cooling.COOLING_LOADS[models["cooling_load"]]
        self._plant = PLANTS[models["plant"]]
        self._dry = models["plant"] in DRY_PLANTS
        self._chiller = CHILLERS[models["chiller"]]
        self._tower = TOWERS[models["tower"]]
        self._water_model = WATER[models["water"]]
        self._battery_model = BATTERIES[models["battery"]]
        self._battery = {name: v(f"battery.{name}") for name in BATTERY_PARAMETERS}
        self._grid_limited = bool(np.any(sizing.grid_limit_kw < NO_LIMIT_KW))
        if self._grid_limited:
            self._battery["grid_limit_kw"] = sizing.grid_limit_kw
        self._outage_battery = dict(self._battery)
        if models["battery"] == "clc":
            # At 1 C a battery of one hour carries the design power: its losses are less than what
            # the design power exceeds any load by.
            self._outage_battery["discharge_limit_c_rate"] = v(
                "battery.discharge_limit_c_rate"
            ) * v("battery.discharge_factor")
        self._water = {
            "cycles_of_concentration": v("hvac.water.cycles_of_concentration"),
            "drift_share": v("hvac.water.drift_share"),
            "pressure_pa": sites_pressure_pa(fleet),
        }
        self._flow_limits = {
            "design_flow_m3s": sizing.crac_flow_m3s,
            "design_it_airflow_m3s": sizing.it_airflow_m3s,
            "min_ratio": v("hvac.crac.min_flow_ratio"),
            "supply_m3s_per_w": v("hvac.crac.supply_m3s_per_w"),
        }
        self._air_j_per_m3_k = air_j_per_m3_k(fleet)
        self._return_approach_k = mean_return_approach_k(fleet)
        self._fan_w_per_m3s = sizing.crac_fan_w / sizing.crac_flow_m3s
        self._limits_coils = bool(np.any(fleet.unit_capacity_w < NO_LIMIT_W))
        self.plant_input_names = (
            *_PLANT_INPUTS,
            *(() if event_free else _PLANT_EVENT_INPUTS),
            *(("coil_limit_w",) if self._limits_coils else ()),
        )
        """Names of the inputs that ``removable_w`` reads."""
        self.input_names = (
            *self.plant_input_names,
            *_STEP_INPUTS,
            *(_RECIRCULATION_INPUTS if self._recirculates else _APPROACH_INPUTS),
            *(_TRANSIENT_INPUTS if self._transient else ()),
            *(() if event_free else _EVENT_INPUTS),
        )
        """Names of the inputs that ``step`` reads."""

    def removable_w(self, inputs: FacilityInputs) -> dict[str, F64]:
        """Heat that the plant can take with the coils in use, W, as ``heat_removed_w``, (B,)."""
        capacity_w, flow_m3s = self._coil_capacity_w(inputs), self._sizing.crac_flow_m3s
        rise_k = self._sizing.water_side.cooling_w / (self._air_j_per_m3_k * flow_m3s)
        plant = self._operate(capacity_w, inputs, inputs.plant_setpoint_c + rise_k, flow_m3s)
        return {"heat_removed_w": plant.heat_removed_w}

    def step(self, inputs: FacilityInputs) -> dict[str, F64]:
        """Everything that follows from the air of the halls.

        Args:
            inputs: What the step starts from.

        Returns:
            Quantities of ``StepResult`` by their names there, each (B,).
        """
        it_w = inputs.cpu_w + inputs.it_fan_w
        air = self._crac_air(inputs, it_w)
        requested_w = self._requested_w(inputs, air)
        plant = self._operate(requested_w, inputs, air.return_c, air.crac_flow_m3s)
        heat = self._balance_heat(inputs, air, plant)
        water = self._use_water(inputs, air, plant)
        hvac_w = self._hvac_w(air, plant)
        found: dict[str, Any] = {
            "it_w": it_w,
            "hvac_w": hvac_w,
            **fields_of(air),
            **fields_of(plant),
            **fields_of(heat),
            **fields_of(water),
            **self._energy(inputs, it_w, hvac_w),
            **self._air_indices(inputs, air),
        }
        return {name: values for name, values in found.items() if name in _RESULTS}

    def powered_share(self, grid_up: npt.NDArray[np.bool_], stored_kwh: F64) -> F64:
        """Share of a step with power, 0..1, (B,).

        In an outage power lasts as long as the battery would carry the facility at its design
        power, which is more than it draws; a battery that cannot deliver the design power carries
        it for a part of the time.

        Args:
            grid_up: Whether the grid supplies, (B,).
            stored_kwh: Energy in the batteries at the start of the step, kWh, (B,).
        """
        all_step = np.ones(len(stored_kwh))
        if np.all(grid_up):
            return all_step
        design_kw = self._sizing.facility_w / 1e3
        carried_kwh = self._run_battery(
            stored_kwh, -all_step, load_kw=design_kw, limits=self._outage_battery
        ).discharge_kwh
        lasts = np.minimum(carried_kwh / (design_kw * self._step_h), 1.0)
        return np.where(grid_up, all_step, lasts)

    def _crac_air(self, inputs: FacilityInputs, it_w: F64) -> _CracAir:
        """Airflow, supply and return air, fans and heat of the CRAC units."""
        if self._recirculates:
            fan_w = self._while_powered(self._fan_w_per_m3s * inputs.cubed_flow_m3s, inputs)
            return _CracAir(
                crac_flow_m3s=inputs.crac_flow_m3s,
                crac_fan_w=fan_w,
                supply_c=inputs.supply_c,
                return_c=inputs.return_c,
                cooling_load_w=inputs.cooling_load_w if self._transient else it_w + fan_w,
            )
        flow, speed = self._flow(
            it_w, inputs.it_airflow_m3s, speed=inputs.fan_speed, **self._flow_limits
        )
        full_w = crac_fan_w(speed, design_flow_m3s=1.0, design_w=self._sizing.crac_fan_w)
        fan_w = self._while_powered(full_w, inputs)
        return_c, load_w = self._load(
            it_w,
            fan_w,
            flow,
            inputs.supply_c,
            inputs.plant_setpoint_c,
            inputs.outlet_mean_c,
            air_j_per_m3_k=self._air_j_per_m3_k,
            return_approach_k=self._return_approach_k,
        )
        return _CracAir(
            crac_flow_m3s=flow,
            crac_fan_w=fan_w,
            supply_c=inputs.supply_c,
            return_c=return_c,
            cooling_load_w=load_w,
        )

    def _requested_w(self, inputs: FacilityInputs, air: _CracAir) -> F64:
        """Heat that the CRAC units ask the plant to take: load, and heat held by the room."""
        if self._transient:
            return inputs.coil_w
        wanted_w = air.cooling_load_w + inputs.room_heat_kwh * 1e3 / self._step_h
        if self._limits_coils:
            wanted_w = np.minimum(wanted_w, self._coil_limit_w(inputs))
        if self._event_free:
            return wanted_w
        reached_w = np.clip(wanted_w, 0.0, self._coil_capacity_w(inputs))
        return np.where(inputs.no_unit_down > 0, wanted_w, reached_w)

    def _operate(
        self, requested_w: F64, inputs: FacilityInputs, return_c: F64, airflow_m3s: F64
    ) -> WaterSideResult:
        """The plant, which stands still while there is no power."""
        design = self._sizing.water_side
        if not self._event_free:
            on = np.where(inputs.powered > 0, inputs.powered, 1.0)
            requested_w = np.where(inputs.powered > 0, requested_w / on, 0.0)
            design = replace(
                design,
                chiller_w=design.chiller_w * inputs.chiller_share,
                pumped_w=design.pumped_w * inputs.pump_share,
                outdoor_units=inputs.outdoor_units,
            )
        found = self._plant(
            requested_w,
            setpoint_c=inputs.plant_setpoint_c,
            return_c=return_c,
            airflow_m3s=airflow_m3s,
            outdoor_c=inputs.outdoor_c,
            wet_bulb_c=inputs.wet_bulb_c,
            design=design,
            chiller=self._chiller,
            tower=self._tower,
            limited=self._stores_heat,
        )
        return found if self._event_free else found.scaled(inputs.powered)

    def _balance_heat(
        self, inputs: FacilityInputs, air: _CracAir, plant: WaterSideResult
    ) -> _HeatBalance:
        """Heat that was not removed stays in the room; spare capacity fetches it later."""
        load_w, removed_w = air.cooling_load_w, plant.heat_removed_w
        if self._transient:
            # The room has kept its heat within the step; here is what the plant fell short of.
            short_kwh = (inputs.coil_w - removed_w) * self._step_h / 1e3
            room_heat_kwh = inputs.room_j / 3.6e6 + short_kwh
            unmet_w, recovered_w = cooling.unmet_and_recovered(load_w, removed_w)
        else:
            unmet_w, recovered_w, room_heat_kwh = cooling.balance_room_heat(
                load_w, removed_w, inputs.room_heat_kwh, self._step_h
            )
        if not self._stores_heat:
            # Of no sign, even where the load is negative.
            unmet_w = recovered_w = 0.0 * load_w + 0.0
        return _HeatBalance(unmet_w, recovered_w, room_heat_kwh)

    def _use_water(self, inputs: FacilityInputs, air: _CracAir, plant: WaterSideResult) -> WaterUse:
        """Water that the tower evaporates, loses and gets; else that of the humidifier."""
        if self._dry:
            nothing = 0.0 * plant.rejected_w
            evaporation_l = plant.humidifier_kg_s * (self._step_h * 3600.0)
            blowdown_l = evaporation_l / (self._water["cycles_of_concentration"] - 1.0)
            return WaterUse(evaporation_l, nothing, blowdown_l, evaporation_l + blowdown_l)
        return self._water_model(
            rejected_w=plant.rejected_w,
            range_k=plant.tower_range_k,
            water_kg_s=plant.tower_water_kg_s,
            tower_airflow_m3s=plant.tower_airflow_m3s,
            outdoor_c=inputs.outdoor_c,
            wet_bulb_c=inputs.wet_bulb_c,
            return_c=air.return_c,
            supply_setpoint_c=inputs.plant_setpoint_c,
            dt_s=self._step_h * 3600.0,
            **self._water,
        )

    def _hvac_w(self, air: _CracAir, plant: WaterSideResult) -> F64:
        """Power of the devices that ``hvac.total_of`` names."""
        power_w = fields_of(plant) | fields_of(air)
        first, *rest = (power_w[f"{device}_w"] for device in self._hvac_devices)
        return cast(F64, sum(rest, first))

    def _power_path_loss_w(self, inputs: FacilityInputs, it_w: F64) -> tuple[F64, F64]:
        """Losses of UPS and distribution, which have no power while the data center has none."""
        path = self._sizing.power_path
        if self._event_free:
            ups_w, distribution_w = power_path_loss_w(it_w, path)
        else:
            on = np.where(inputs.powered > 0, inputs.powered, 1.0)
            ups_w, distribution_w = power_path_loss_w(it_w / on, path)
        return (
            self._while_powered(as_array(ups_w), inputs),
            self._while_powered(as_array(distribution_w), inputs),
        )

    def _energy(self, inputs: FacilityInputs, it_w: F64, hvac_w: F64) -> dict[str, F64]:
        """Losses, battery, grid and emissions; without grid the battery gives what it can."""
        ups_w, distribution_w = self._power_path_loss_w(inputs, it_w)
        overhead_w = hvac_w + (ups_w + distribution_w) if self._counts_losses else hvac_w
        command = inputs.battery_command
        if not self._event_free:
            command = np.where(inputs.grid_up > 0, command, -1.0)
        battery = self._run_battery(
            inputs.stored_kwh, command, load_kw=(it_w + overhead_w) / 1e3, limits=self._battery
        )
        needed_kwh = battery.grid_kwh
        grid_kwh = needed_kwh if self._event_free else needed_kwh * inputs.grid_up
        battery_kwh = self._sizing.battery_kwh
        limit_kwh = self._sizing.grid_limit_kw * self._step_h
        return {
            **fields_of(battery),
            "ups_loss_w": ups_w,
            "distribution_loss_w": distribution_w,
            "overhead_w": overhead_w,
            "soc": battery.stored_kwh / np.where(battery_kwh > 0, battery_kwh, 1.0),
            "it_kwh": it_w * self._step_h / 1e3,
            "hvac_kwh": hvac_w * self._step_h / 1e3,
            "grid_kwh": grid_kwh,
            "grid_overload_kwh": (
                overload_kwh(grid_kwh, limit_kwh) if self._grid_limited else 0.0 * grid_kwh
            ),
            "unserved_kwh": needed_kwh - grid_kwh,
            "carbon_g": emitted_g(grid_kwh, inputs.ci_g_per_kwh),
            "energy_cost": grid_kwh * inputs.price_per_kwh,
        }

    def _air_indices(self, inputs: FacilityInputs, air: _CracAir) -> dict[str, F64]:
        """Indices of how well the air of the hall is managed."""
        servers, (low_c, high_c) = self._servers, self._allowable_c
        it_rise_k = air_metrics.it_rise_k(
            inputs.inlet_m3k_s, inputs.outlet_m3k_s, inputs.it_airflow_m3s
        )
        return {
            "over_27_mean_k": inputs.over_27_sum_k / servers,
            "shi": air_metrics.shi(inputs.inlet_m3k_s, inputs.outlet_m3k_s, inputs.it_airflow_m3s),
            "rti_pct": air_metrics.rti(air.return_c, air.supply_c, it_rise_k),
            "rci_hi_pct": air_metrics.rci_hi(inputs.over_27_sum_k, servers, allowable_c=high_c),
            "rci_lo_pct": air_metrics.rci_lo(inputs.under_18_sum_k, servers, allowable_c=low_c),
        }

    def _run_battery(
        self, stored_kwh: F64, command: F64, *, load_kw: F64, limits: dict[str, F64]
    ) -> BatteryResult:
        """One step of the batteries."""
        return self._battery_model(
            stored_kwh,
            command,
            capacity_kwh=self._sizing.battery_kwh,
            load_kw=load_kw,
            dt_h=self._step_h,
            **limits,
        )

    def _coil_capacity_w(self, inputs: FacilityInputs) -> F64:
        """Heat that the coils in use can take, mean over the step."""
        cooling_w = self._sizing.water_side.cooling_w
        if not self._event_free:
            cooling_w = cooling_w * inputs.coil_share * inputs.powered
        return (
            np.minimum(cooling_w, self._coil_limit_w(inputs)) if self._limits_coils else cooling_w
        )

    def _coil_limit_w(self, inputs: FacilityInputs) -> F64:
        """Capacity of the coils of the units that run, mean over the step."""
        return self._while_powered(inputs.coil_limit_w, inputs)

    def _while_powered(self, power_w: F64, inputs: FacilityInputs) -> F64:
        """Mean over the step of a power that is drawn while there is power."""
        return power_w if self._event_free else power_w * inputs.powered
