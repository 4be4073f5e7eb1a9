"""From the air of the halls to the grid: CRAC units, plant, water, battery, carbon and indices.

One stage for all data centers, which runs as one compiled pass. Arrays are (B,).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from sdc_taichi.hall import air_metrics
from sdc_taichi.plant import cooling, water_side
from sdc_taichi.plant.battery import BATTERIES, BatteryResult
from sdc_taichi.plant.carbon import emitted_g
from sdc_taichi.plant.chiller import CHILLERS
from sdc_taichi.plant.fans_pumps import crac_fan_w
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water import WATER
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.sizing import Sizing, air_j_per_m3_k, mean_return_approach_k
from sdc_taichi.types import F64

NOT_USED = cast(F64, None)
_BATTERY = (
    "charge_efficiency",
    "discharge_factor",
    "charge_limit_c_rate",
    "discharge_limit_c_rate",
    "upper_u_h",
    "upper_v",
    "lower_u_h",
    "lower_v",
)


@dataclass(frozen=True, slots=True)
class FacilityInputs:
    """What a step starts from, each (B,); what the models of a fleet do not read may be left out.

    Sums over CRAC units and racks are airflows times what is named.
    """

    plant_setpoint_c: F64
    """Lowest setpoint of the units that run, which the chilled water follows."""
    outdoor_c: F64
    wet_bulb_c: F64

    cpu_w: F64 = NOT_USED
    it_fan_w: F64 = NOT_USED
    it_airflow_m3s: F64 = NOT_USED
    over_27_sum_k: F64 = NOT_USED
    """Sum over the servers, as the next."""
    under_18_sum_k: F64 = NOT_USED
    inlet_m3k_s: F64 = NOT_USED
    """Of racks, over supply, as the next."""
    outlet_m3k_s: F64 = NOT_USED
    supply_c: F64 = NOT_USED
    outlet_mean_c: F64 = NOT_USED
    fan_speed: F64 = NOT_USED
    crac_flow_m3s: F64 = NOT_USED
    """This and the next three of halls that recirculate."""
    return_c: F64 = NOT_USED
    cubed_m3s: F64 = NOT_USED
    """Design airflow times the cube of the fan speed."""
    mixed_m3k_s: F64 = NOT_USED
    """Airflow times setpoint."""
    cooling_load_w: F64 = NOT_USED
    """This and the next two of transient halls, see ``HallSums``."""
    coil_w: F64 = NOT_USED
    room_j: F64 = NOT_USED

    ci_g_per_kwh: F64 = NOT_USED
    battery_command: F64 = NOT_USED
    stored_kwh: F64 = NOT_USED
    room_heat_kwh: F64 = NOT_USED

    powered: F64 = NOT_USED
    """Share of the step with power; this and what follows where events may happen."""
    grid_up: F64 = NOT_USED
    """1 with grid, 0 in an outage."""
    chiller_share: F64 = NOT_USED
    """Capacity left to the chiller."""
    coils: F64 = NOT_USED
    """Share of the coils in use."""
    all_running: F64 = NOT_USED
    """1 if no CRAC unit is down."""
    idle_m3s: F64 = NOT_USED
    """Airflow of units that are down."""
    idle_m3k_s: F64 = NOT_USED
    """The same times setpoint."""


@dataclass(frozen=True, slots=True)
class _Room:
    """Air of the CRAC units, each (B,)."""

    flow_m3s: F64
    fan_w: F64
    supply_c: F64
    warmed_k: F64
    """Supply air over the setpoints."""
    return_c: F64
    load_w: F64
    """Heat of servers and CRAC fans, if nothing stores it."""


@dataclass(frozen=True, slots=True)
class _Heat:
    """Heat that the plant takes, each (B,)."""

    load_w: F64
    """Heat that comes back to the CRAC units."""
    device: water_side.WaterSideResult
    unmet_w: F64
    recovered_w: F64
    held_kwh: F64
    """Heat that the room holds at the end of the step."""


class Facility:
    """Models and sized devices of a fleet, behind its halls.

    Args:
        fleet: B data centers.
        sized: their devices.
        step_h: length of a step.
        calm: whether no event can ever happen: all is in order and has power.
    """

    def __init__(self, fleet: Fleet, sized: Sizing, step_h: float, *, calm: bool) -> None:
        v, models = fleet.values, fleet.models
        self._sized, self._step_h, self._calm = sized, step_h, calm
        self._servers = fleet.per_dc_servers()
        classes = [air_metrics.allowable_c(c.protection.ashrae_class) for c in fleet.configs]
        self._allowable_c = np.array(classes).T.copy()
        self._counted = fleet.configs[0].hvac.total_of
        self._recirculates = models["inlet"] == "recirculation"
        self._transient = models["thermal"] == "transient"
        self._stores_heat = models["cooling_load"] in cooling.STORES_UNMET_HEAT
        self._flow = cooling.CRAC_FLOWS[models["crac_flow"]]
        self._load = cooling.COOLING_LOADS[models["cooling_load"]]
        self._chiller = CHILLERS[models["chiller"]]
        self._tower = TOWERS[models["tower"]]
        self._water_model = WATER[models["water"]]
        self._battery_model = BATTERIES[models["battery"]]
        self._battery = {name: v(f"battery.{name}") for name in _BATTERY}
        self._water = {
            "cycles_of_concentration": v("hvac.water.cycles_of_concentration"),
            "drift_share": v("hvac.water.drift_share"),
        }
        self._flow_limits = {
            "design_flow_m3s": sized.crac_flow_m3s,
            "design_it_airflow_m3s": sized.it_airflow_m3s,
            "min_ratio": v("hvac.crac.min_flow_ratio"),
            "supply_m3s_per_w": v("hvac.crac.supply_m3s_per_w"),
        }
        self._air_j_per_m3_k = air_j_per_m3_k(fleet)
        self._return_approach_k = mean_return_approach_k(fleet)
        self._fan_w_per_m3s = sized.crac_fan_w / sized.crac_flow_m3s

    def removable_w(self, met: FacilityInputs) -> dict[str, F64]:
        """Heat that the plant can take with the coils in use."""
        return {"removed_w": self._operate(self._coils_w(met), met).heat_removed_w}

    def step(self, met: FacilityInputs) -> dict[str, F64]:
        """Everything that follows from the air of the halls.

        Returns:
            Quantities of ``StepResult`` by their names there, and ``warmed_k``, what the supply air
            is warmer than the setpoints.
        """
        sized, step_h = self._sized, self._step_h
        it_w = met.cpu_w + met.it_fan_w
        room = self._room_air(met, it_w)
        heat = self._remove_heat(met, room)
        device = heat.device
        water = self._water_model(
            rejected_w=device.rejected_w,
            range_k=device.tower_range_k,
            water_kg_s=device.tower_water_kg_s,
            wet_bulb_c=met.wet_bulb_c,
            return_c=room.return_c,
            supply_setpoint_c=met.plant_setpoint_c,
            dt_s=step_h * 3600.0,
            **self._water,
        )
        devices = {
            "chiller": device.chiller_w,
            "tower_fan": device.tower_fan_w,
            "chilled_pump": device.chilled_pump_w,
            "condenser_pump": device.condenser_pump_w,
            "crac_fan": room.fan_w,
        }
        first, *rest = (devices[name] for name in self._counted)
        hvac_w = sum(rest, first)
        battery = self.run_battery(
            met.stored_kwh,
            met.battery_command
            if self._calm
            else np.where(met.grid_up > 0, met.battery_command, -1.0),
            load_kw=(it_w + hvac_w) / 1e3,
        )
        grid_kwh = battery.grid_kwh if self._calm else battery.grid_kwh * met.grid_up
        low_c, high_c = self._allowable_c
        return {
            "supply_c": room.supply_c,
            "warmed_k": room.warmed_k,
            "over_27_mean_k": met.over_27_sum_k / self._servers,
            "shi": air_metrics.shi(met.inlet_m3k_s, met.outlet_m3k_s),
            "rti_pct": air_metrics.rti(
                room.return_c,
                room.supply_c,
                air_metrics.it_rise_k(met.inlet_m3k_s, met.outlet_m3k_s, met.it_airflow_m3s),
            ),
            "rci_hi_pct": air_metrics.rci_hi(met.over_27_sum_k, self._servers, allowable_c=high_c),
            "rci_lo_pct": air_metrics.rci_lo(met.under_18_sum_k, self._servers, allowable_c=low_c),
            "it_w": it_w,
            "crac_flow_m3s": room.flow_m3s,
            "return_c": room.return_c,
            "cooling_load_w": heat.load_w,
            "chilled_water_c": device.chilled_water_c,
            "condenser_water_c": device.condenser_water_c,
            "economiser_w": device.economiser_w,
            "chiller_load_w": device.chiller_load_w,
            "unmet_w": heat.unmet_w,
            "recovered_w": heat.recovered_w,
            "heat_removed_w": device.heat_removed_w,
            "rejected_w": device.rejected_w,
            "room_heat_kwh": heat.held_kwh,
            "chiller_w": device.chiller_w,
            "tower_fan_w": device.tower_fan_w,
            "chilled_pump_w": device.chilled_pump_w,
            "condenser_pump_w": device.condenser_pump_w,
            "crac_fan_w": room.fan_w,
            "hvac_w": hvac_w,
            "evaporation_l": water.evaporation_l,
            "drift_l": water.drift_l,
            "blowdown_l": water.blowdown_l,
            "water_l": water.water_l,
            "stored_kwh": battery.stored_kwh,
            "soc": battery.stored_kwh / np.where(sized.battery_kwh > 0, sized.battery_kwh, 1.0),
            "charge_kwh": battery.charge_kwh,
            "discharge_kwh": battery.discharge_kwh,
            "battery_loss_kwh": battery.battery_loss_kwh,
            "it_kwh": it_w * step_h / 1e3,
            "hvac_kwh": hvac_w * step_h / 1e3,
            "grid_kwh": grid_kwh,
            "unserved_kwh": battery.grid_kwh - grid_kwh,
            "carbon_g": emitted_g(grid_kwh, met.ci_g_per_kwh),
        }

    def run_battery(self, stored_kwh: F64, command: F64, *, load_kw: F64) -> BatteryResult:
        """One step of the batteries."""
        return self._battery_model(
            stored_kwh,
            command,
            capacity_kwh=self._sized.battery_kwh,
            load_kw=load_kw,
            dt_h=self._step_h,
            **self._battery,
        )

    def _coils_w(self, met: FacilityInputs) -> F64:
        """Capacity of the coils in use."""
        cooling_w = self._sized.water_side.cooling_w
        return cooling_w if self._calm else cooling_w * met.coils * met.powered

    def _operate(self, request_w: F64, met: FacilityInputs) -> water_side.WaterSideResult:
        """The plant, which stands still while there is no power."""
        design = self._sized.water_side
        if not self._calm:
            on = np.where(met.powered > 0, met.powered, 1.0)
            request_w = np.where(met.powered > 0, request_w / on, 0.0)
            design = replace(design, chiller_w=design.chiller_w * met.chiller_share)
        found = water_side.operate(
            request_w,
            setpoint_c=met.plant_setpoint_c,
            outdoor_c=met.outdoor_c,
            wet_bulb_c=met.wet_bulb_c,
            design=design,
            chiller=self._chiller,
            tower=self._tower,
            limited=self._stores_heat,
        )
        return found if self._calm else found.scaled(met.powered)

    def _room_air(self, met: FacilityInputs, it_w: F64) -> _Room:
        """Airflow, supply and return air, fans and heat of the CRAC units."""
        if self._recirculates:
            fan_w = self._fan_w_per_m3s * met.cubed_m3s
            fan_w = fan_w if self._calm else fan_w * met.powered
            return _Room(
                flow_m3s=met.crac_flow_m3s,
                fan_w=fan_w,
                supply_c=met.supply_c,
                # Units differ by their setpoints alone; the room warms the air of all alike.
                warmed_k=met.supply_c - met.mixed_m3k_s / met.crac_flow_m3s,
                return_c=met.return_c,
                load_w=it_w + fan_w,
            )
        flow, speed = self._flow(it_w, met.it_airflow_m3s, speed=met.fan_speed, **self._flow_limits)
        fan_w = crac_fan_w(speed, design_flow_m3s=1.0, design_w=self._sized.crac_fan_w)
        fan_w = fan_w if self._calm else met.powered * fan_w
        return_c, load_w = self._load(
            it_w,
            fan_w,
            flow,
            met.supply_c,
            met.plant_setpoint_c,
            met.outlet_mean_c,
            air_j_per_m3_k=self._air_j_per_m3_k,
            return_approach_k=self._return_approach_k,
        )
        warmed_k = met.supply_c - met.plant_setpoint_c
        return _Room(flow, fan_w, met.supply_c, warmed_k, return_c, load_w)

    def _remove_heat(self, met: FacilityInputs, room: _Room) -> _Heat:
        """What the plant takes of the heat that comes back and of the heat held by the room."""
        step_h = self._step_h
        if self._transient:
            load_w, device = met.cooling_load_w, self._operate(met.coil_w, met)
            # The room has kept its heat within the step; here is what the plant fell short of.
            held_kwh = met.room_j / 3.6e6 + (met.coil_w - device.heat_removed_w) * step_h / 1e3
            unmet_w, recovered_w = cooling.unmet_and_recovered(load_w, device.heat_removed_w)
        else:
            load_w = room.load_w
            wanted_w = load_w + met.room_heat_kwh * 1e3 / step_h
            if not self._calm:
                # Heat of the air that passes units that are down stays in the room.
                idle_c = (room.return_c - room.warmed_k) * met.idle_m3s - met.idle_m3k_s
                past_w = self._air_j_per_m3_k * idle_c
                reached_w = np.clip(wanted_w - past_w, 0.0, self._coils_w(met))
                wanted_w = np.where(met.all_running > 0, wanted_w, reached_w)
            device = self._operate(wanted_w, met)
            unmet_w, recovered_w, held_kwh = cooling.balance_room_heat(
                load_w, device.heat_removed_w, met.room_heat_kwh, step_h
            )
        if not self._stores_heat:
            unmet_w = recovered_w = 0.0 * load_w
        return _Heat(load_w, device, unmet_w, recovered_w, held_kwh)
