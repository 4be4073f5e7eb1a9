"""Facility model: CRAC units, cooling plant, water, battery, grid, carbon and air indices.

The model is plain NumPy code over B data centers, which ``FacilityStage`` compiles. Intermediate
quantities have the names that they have in ``StepResult``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from sdc_taichi.hall import air_metrics
from sdc_taichi.plant import cooling
from sdc_taichi.plant.battery import (
    BATTERIES,
    BatteryParameters,
    BatteryPoint,
)
from sdc_taichi.plant.chiller import CHILLERS
from sdc_taichi.plant.electrical import NO_LIMIT_KW, ROUND_OFF_SHARE, overload_kwh
from sdc_taichi.plant.plants import PLANTS, Devices, PlantPoint, completed
from sdc_taichi.plant.tower import TOWERS
from sdc_taichi.plant.water import WATER, WaterPoint
from sdc_taichi.plant.water_side import (
    LEAST_PUMPED_W,
    chilled_water_load_w,
    coil_capacity_w,
    warmth_w,
)
from sdc_taichi.sim.crac_units import Supply, UnitAir
from sdc_taichi.sim.fleet import NO_LIMIT_W, Fleet
from sdc_taichi.sim.hall_state import HallSums
from sdc_taichi.sim.physical_limits import within_limits
from sdc_taichi.sim.sizing import Sizing, air_j_per_m3_k, mean_return_approach_k, sites_pressure_pa
from sdc_taichi.sim.step_inputs import Commands, Surroundings
from sdc_taichi.types import (
    F64,
    QUANTITIES,
    AirIndices,
    BatteryResult,
    CracQuantities,
    RoomQuantities,
    State,
    WaterQuantities,
    WaterSideResult,
    as_array,
    fields_of,
    joined,
)

WARMER_K, LESS_LOAD = 2.0, 0.9
"""Warmth of water and air, in K, and load divided by capacity, at which the growth of the plant's
heat is evaluated."""
SHORT_BAND = 0.1
"""Share of the heat of coils and warm water which a plant does not remove, above which the growths
of its heat with warmth and load count in full."""
VALVE_BAND_K = 1.0
"""Warmth of the water above its setpoint at which all valves are open, in K."""


@dataclass(frozen=True, slots=True)
class StepInputs:
    """Inputs of the facility in one step: the results of the preceding stages."""

    state: State
    """State at the start of the step, of which battery energy and room heat are read."""
    commands: Commands
    """Commands of the step, of which the battery command is read."""
    surroundings: Surroundings
    """Weather, carbon intensity, price, grid and failures."""
    supply: Supply
    """Operation of the CRAC units."""
    air: HallSums
    """Airflows, temperatures and power of the halls."""
    liquid: LiquidLoads | None = None
    """Liquid cooling; None for fleets without it."""


class LiquidLoads(Protocol):
    """Liquid cooling of B data centers in one step, see ``LiquidStep``."""

    more_it_w: F64
    overhead_w: F64
    more_water_l: F64
    to_plant_w: F64 | None


def battery_parameters(fleet: Fleet) -> BatteryParameters:
    """Return the battery parameters of a fleet, (B,) each."""
    return BatteryParameters(*(fleet.values(f"battery.{n}") for n in BatteryParameters._fields))


class Facility:
    """Models and sized devices of a fleet, except the halls.

    Args:
        fleet: B data centers.
        sizing: Their sized devices.
        event_free: True if no event can ever occur, so that all devices work and have power.
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
        self._flow = cooling.CRAC_FLOWS[models["crac_flow"]]
        self._load = cooling.COOLING_LOADS[models["cooling_load"]]
        self._stores_heat = self._load.stores_unmet_heat
        self._plant = PLANTS[models["plant"]]
        self._devices = Devices(
            CHILLERS[models["chiller"]],
            TOWERS[models["tower"]],
            limited=self._stores_heat,
            reset=fleet.configs[0].hvac.tower.resets,
        )
        self._water_model = WATER[models["water"]]
        self._battery_model = BATTERIES[models["battery"]]
        self._battery = battery_parameters(fleet)
        limited = bool(np.any(sizing.grid_limit_kw < NO_LIMIT_KW))
        self._grid_limit_kw = sizing.grid_limit_kw if limited else None
        self._outage_battery = self._battery
        if self._battery_model.by_rate_of_store:
            # The discharge limit is relaxed by the losses, so that a one-hour battery at 1 C
            # delivers the design power. The error is small: the design power exceeds any load by
            # more than the losses.
            rate = self._battery.discharge_limit_c_rate
            linear_rate = rate * (1.0 + self._battery.square_loss_h * rate)
            self._outage_battery = self._battery._replace(
                # Rounding errors must not end the power of a step early.
                discharge_limit_c_rate=(
                    self._battery.discharge_factor * linear_rate * (1.0 + ROUND_OFF_SHARE)
                ),
                standby_per_h=0.0 * rate,
            )
        self._water = {
            "cycles_of_concentration": v("hvac.water.cycles_of_concentration"),
            "drift_share": v("hvac.water.drift_share"),
            "evaporation_per_k": v("hvac.water.evaporation_per_k"),
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
        self._cools_liquid = bool(np.any(sizing.water_side.facility_water_w > 0.0))
        self._limits_coils = bool(np.any(fleet.unit_capacity_w < NO_LIMIT_W))

    def removable_w(
        self,
        surroundings: Surroundings,
        supply: Supply,
        air: UnitAir,
        to_plant_w: F64 | float = 0.0,
    ) -> dict[str, F64]:
        """Compute the heat that the plant can remove, and that coils and pumps can carry.

        Free cooling removes more heat from warmer water and air. The heat that the plant can remove
        is therefore ``limit_w`` plus the growths times the warmth of the water and the heat at the
        coils. Both growths are 0 where the plant can remove all heat that coils and pumps bring,
        and begin gradually where it cannot, so that small causes have small effects.

        Args:
            surroundings: Weather and failures.
            supply: Operation of the CRAC units.
            air: Air and water of the CRAC units at the start of the step.
            to_plant_w: Heat of facility water, which the plant removes before that of the coils, in
                W, (B,).

        Returns:
            ``limit_w`` and ``carried_w``, in W, ``limit_w_per_k``, in W/K, and ``limit_w_per_w``,
            in W/W, (B,) each.
        """
        capacity_w = self._coil_capacity_w(surroundings, supply)

        def plant(load_share: float, warmer_k: float) -> WaterSideResult:
            return self._operate(
                load_share * capacity_w + to_plant_w,
                surroundings,
                supply,
                air.return_c + warmer_k,
                air.flow_m3s,
                air.warmed_k + warmer_k,
            )

        full, warmer, less = plant(1.0, 0.0), plant(1.0, WARMER_K), plant(LESS_LOAD, 0.0)
        removed_w = full.heat_removed_w - to_plant_w
        per_k = np.maximum(warmer.heat_removed_w - full.heat_removed_w, 0.0) / WARMER_K
        less_w = (1.0 - LESS_LOAD) * capacity_w
        per_w = (full.economiser_w - less.economiser_w) / np.maximum(less_w, LEAST_PUMPED_W)
        design = self._sizing.water_side
        if not self._event_free:
            design = replace(design, pumped_w=design.pumped_w * surroundings.pump_share)
        offered_w = capacity_w + self._while_powered(warmth_w(air.warmed_k, design), surroundings)
        missing = (1.0 - ROUND_OFF_SHARE) - removed_w / np.maximum(offered_w, LEAST_PUMPED_W)
        short = np.clip(missing / SHORT_BAND, 0.0, 1.0)
        # A watt more at the coils cannot let the plant remove more than a watt more, but the plant
        # may operate differently at less load.
        per_k, per_w = short * per_k, short * np.clip(per_w, 0.0, 1.0)
        return {
            "limit_w": removed_w - per_k * air.warmed_k - per_w * capacity_w,
            "limit_w_per_k": per_k,
            "limit_w_per_w": per_w,
            "carried_w": np.minimum(
                capacity_w, self._while_powered(coil_capacity_w(design), surroundings) - to_plant_w
            ),
        }

    def step(self, inputs: StepInputs) -> dict[str, F64]:
        """Compute CRAC, plant, water, energy and index quantities of a step.

        Returns:
            Quantities of ``StepResult`` by their field names, each (B,).
        """
        air_w = it_w = inputs.air.cpu_w + inputs.air.it_fan_w
        if inputs.liquid is not None:
            it_w = air_w + inputs.liquid.more_it_w
        air = self._crac_air(inputs, air_w)
        to_plant_w: F64 | float = 0.0
        if self._cools_liquid and inputs.liquid is not None:
            to_plant_w = cast(F64, inputs.liquid.to_plant_w)
        requested_w = self._requested_w(inputs, air) + to_plant_w
        at = inputs.surroundings, inputs.supply, air.return_c, air.crac_flow_m3s
        plant = self._operate(requested_w, *at)
        if self._transient:
            carried_w = np.maximum(self._carried_w(inputs), 0.0) + to_plant_w
            # A plant that cools water and tank removes more than the coils bring.
            fullest_w = np.maximum(carried_w, requested_w)
            fullest = self._operate(fullest_w, *at, inputs.air.most_warmed_k)
            plant = completed(plant, fullest, requested_w)
            opened = np.minimum(inputs.air.most_warmed_k / VALVE_BAND_K, 1.0)
            least_w = opened * fullest.chilled_pump_w
            plant = self._with_coil_pumps(plant, carried_w, least_w, inputs.surroundings)
        plant = replace(plant, heat_removed_w=plant.heat_removed_w - to_plant_w)
        heat = self._balance_heat(inputs, air, plant)
        water = self._use_water(inputs, air, plant)
        hvac_w = self._hvac_w(air, plant)
        if inputs.liquid is not None:
            hvac_w = hvac_w + inputs.liquid.overhead_w
            water.water_l = water.water_l + inputs.liquid.more_water_l
        energy = self._energy(inputs, it_w, hvac_w)
        indices = self._air_indices(inputs.air, air.return_c)
        results = joined(*map(fields_of, (air, plant, heat, water, indices)), energy)
        # Internal quantities of the plant, such as its water and airflows, are not reported.
        return {name: values for name, values in results.items() if name in QUANTITIES}

    def powered_share(self, grid_up: npt.NDArray[np.bool_], stored_kwh: F64) -> F64:
        """Return the share of a step during which each data center has power, 0..1, (B,).

        In an outage, power lasts as long as the battery could supply the facility at its design
        power, a conservative estimate because the actual load is lower. A battery with too small a
        power limit supplies the design power for a correspondingly shorter time.

        Args:
            grid_up: True for data centers that the grid supplies, (B,).
            stored_kwh: Energy in the batteries at the start of the step, in kWh, (B,).
        """
        all_step = np.ones(len(stored_kwh))
        if np.all(grid_up):
            return all_step
        design_kw = self._sizing.facility_w / 1e3
        carried_kwh = self._run_battery(
            stored_kwh, -all_step, load_kw=design_kw, parameters=self._outage_battery
        ).discharge_kwh
        lasts = np.minimum(carried_kwh / (design_kw * self._step_h), 1.0)
        return np.where(grid_up, all_step, lasts)

    def _crac_air(self, inputs: StepInputs, it_w: F64) -> CracQuantities:
        """Compute airflow, fan power, return temperature and cooling load of the CRAC units.

        Args:
            inputs: Results of the preceding stages.
            it_w: Heat of the servers in the hall's air, in W, (B,).
        """
        if self._recirculates:
            fan_w = self._while_powered(
                self._fan_w_per_m3s * inputs.air.cubed_flow_m3s, inputs.surroundings
            )
            return CracQuantities(
                crac_flow_m3s=inputs.air.units_flow_m3s,
                crac_fan_w=fan_w,
                return_c=inputs.air.units_return_c,
                cooling_load_w=inputs.air.units_load_w if self._transient else it_w + fan_w,
            )
        flow, speed = self._flow(
            cooling.CracPoint(
                it_w=it_w,
                it_airflow_m3s=inputs.air.it_airflow_m3s,
                speed=inputs.supply.fan_speed,
                **self._flow_limits,
            )
        )
        full_w = cooling.crac_fan_w(speed, design_flow_m3s=1.0, design_w=self._sizing.crac_fan_w)
        fan_w = self._while_powered(full_w, inputs.surroundings)
        return_c, load_w = self._load.step(
            cooling.HallPoint(
                it_w=it_w,
                crac_fan_w=fan_w,
                crac_flow_m3s=flow,
                supply_c=inputs.air.supply_c,
                setpoint_c=inputs.supply.plant_setpoint_c,
                outlet_c=inputs.air.outlet_mean_c,
                air_j_per_m3_k=self._air_j_per_m3_k,
                return_approach_k=self._return_approach_k,
            )
        )
        return CracQuantities(
            crac_flow_m3s=flow,
            crac_fan_w=fan_w,
            return_c=return_c,
            cooling_load_w=load_w,
        )

    def _carried_w(self, inputs: StepInputs) -> F64:
        """Return the heat that coils give to the chilled water of transient halls, in W, (B,).

        What the plant does not remove remains in water and tank.
        """
        state, air = inputs.state, inputs.air
        stored_j = air.water_j - state.water_heat_j + (air.tank_j - state.tank_heat_j)
        return air.coil_w + stored_j / (self._step_h * 3600.0)

    def _with_coil_pumps(
        self, plant: WaterSideResult, carried_w: F64, least_w: F64, surroundings: Surroundings
    ) -> WaterSideResult:
        """Let the pumps carry all heat of the coils, also that which water and tank take up.

        The heat that this gives the water is removed from the hall the less.

        Args:
            plant: Plant with pumps that carry the heat that it removes.
            carried_w: Heat of the coils, in W, (B,).
            least_w: Lowest power of the pumps, with valves open as far as warm water requires, in
                W, (B,).
            surroundings: Failures of the step.
        """
        design = self._sizing.water_side
        if self._plant.outdoor_air:
            carried_w = np.maximum(carried_w - plant.economiser_w, 0.0)
        if not self._event_free:
            carried_w = carried_w / np.where(surroundings.powered > 0, surroundings.powered, 1.0)
            design = replace(design, pumped_w=design.pumped_w * surroundings.pump_share)
        _, pump_w, _ = chilled_water_load_w(carried_w, design, limited=True)
        pump_w = np.maximum(self._while_powered(pump_w, surroundings), least_w)
        more_w = np.maximum(pump_w - plant.chilled_pump_w, 0.0)
        # The heat of pumps that is not removed is neglected, as in the plants.
        removed_w = np.maximum(plant.heat_removed_w - design.pump_heat_share * more_w, 0.0)
        return replace(
            plant, heat_removed_w=removed_w, chilled_pump_w=plant.chilled_pump_w + more_w
        )

    def _requested_w(self, inputs: StepInputs, air: CracQuantities) -> F64:
        """Return the heat requested from the plant, in W: cooling load plus stored room heat."""
        if self._transient:
            return inputs.air.coil_w
        wanted_w = air.cooling_load_w + inputs.state.room_heat_kwh * 1e3 / self._step_h
        if self._limits_coils:
            limit_w = self._while_powered(inputs.supply.coil_limit_w, inputs.surroundings)
            wanted_w = np.minimum(wanted_w, limit_w)
        if self._event_free:
            return wanted_w
        reached_w = np.clip(
            wanted_w, 0.0, self._coil_capacity_w(inputs.surroundings, inputs.supply)
        )
        return np.where(inputs.surroundings.no_unit_down > 0, wanted_w, reached_w)

    def _operate(
        self,
        requested_w: F64,
        surroundings: Surroundings,
        supply: Supply,
        return_c: F64,
        airflow_m3s: F64,
        warmed_k: F64 | None = None,
    ) -> WaterSideResult:
        """Operate the cooling plant, which is off during the share of the step without power.

        With ``warmed_k``, the chilled water is above its setpoint, and its heat is requested too.
        """
        design = self._sizing.water_side
        if not self._event_free:
            on = np.where(surroundings.powered > 0, surroundings.powered, 1.0)
            requested_w = np.where(surroundings.powered > 0, requested_w / on, 0.0)
            design = replace(
                design,
                chiller_w=design.chiller_w * surroundings.chiller_share,
                pumped_w=design.pumped_w * surroundings.pump_share,
                outdoor_units=surroundings.outdoor_units,
            )
        if warmed_k is not None:
            requested_w = requested_w + warmth_w(warmed_k, design)
        point = PlantPoint(
            setpoint_c=supply.plant_setpoint_c,
            water_setpoint_c=supply.water_setpoint_c,
            return_c=return_c,
            airflow_m3s=airflow_m3s,
            outdoor_c=surroundings.outdoor_c,
            wet_bulb_c=surroundings.wet_bulb_c,
            warmed_k=warmed_k,
        )
        result = self._plant.step(requested_w, point, design, self._devices)
        return result if self._event_free else result.scaled(surroundings.powered)

    def _balance_heat(
        self, inputs: StepInputs, air: CracQuantities, plant: WaterSideResult
    ) -> RoomQuantities:
        """Balance the room: unremoved heat is stored, and spare capacity removes it later."""
        load_w, removed_w = air.cooling_load_w, plant.heat_removed_w
        if self._transient:
            # The hall kernel has balanced the room with ``coil_w``; add the heat that the plant
            # did not remove after all.
            short_kwh = (inputs.air.coil_w - removed_w) * self._step_h / 1e3
            room_heat_kwh = inputs.air.room_j / 3.6e6 + short_kwh
            unmet_w, recovered_w = cooling.unmet_and_recovered(load_w, removed_w)
        else:
            unmet_w, recovered_w, room_heat_kwh = cooling.balance_room_heat(
                load_w, removed_w, inputs.state.room_heat_kwh, self._step_h
            )
        if not self._stores_heat:
            # Adding 0.0 turns a negative zero into 0.
            unmet_w = recovered_w = 0.0 * load_w + 0.0
        nothing = 0.0 * load_w
        return RoomQuantities(unmet_w, recovered_w, room_heat_kwh, nothing, nothing)

    def _use_water(
        self, inputs: StepInputs, air: CracQuantities, plant: WaterSideResult
    ) -> WaterQuantities:
        """Compute the water consumption of the tower, or of the humidifier of a dry plant."""
        if self._plant.dry:
            nothing = 0.0 * plant.rejected_w
            evaporation_l = plant.humidifier_kg_s * (self._step_h * 3600.0)
            blowdown_l = evaporation_l / (self._water["cycles_of_concentration"] - 1.0)
            return WaterQuantities(evaporation_l, nothing, blowdown_l, evaporation_l + blowdown_l)
        return self._water_model(
            WaterPoint(
                rejected_w=plant.rejected_w,
                range_k=plant.tower_range_k,
                water_kg_s=plant.tower_water_kg_s,
                tower_airflow_m3s=plant.tower_airflow_m3s,
                outdoor_c=inputs.surroundings.outdoor_c,
                wet_bulb_c=inputs.surroundings.wet_bulb_c,
                return_c=air.return_c,
                supply_setpoint_c=inputs.supply.plant_setpoint_c,
                dt_s=self._step_h * 3600.0,
                **self._water,
            )
        )

    def _hvac_w(self, air: CracQuantities, plant: WaterSideResult) -> F64:
        """Sum the power of the devices that ``hvac.total_of`` lists, in W, (B,)."""
        power_w = fields_of(plant) | fields_of(air)
        first, *rest = (power_w[f"{device}_w"] for device in self._hvac_devices)
        return cast(F64, sum(rest, first))

    def _power_path_loss_w(self, inputs: StepInputs, it_w: F64) -> tuple[F64, F64]:
        """Return the losses of UPS and of distribution, in W, means over the step, (B,) each."""
        path = self._sizing.power_path
        if self._event_free:
            ups_w, distribution_w = path.losses_w(it_w)
        else:
            on = np.where(inputs.surroundings.powered > 0, inputs.surroundings.powered, 1.0)
            ups_w, distribution_w = path.losses_w(it_w / on)
        return (
            self._while_powered(as_array(ups_w), inputs.surroundings),
            self._while_powered(as_array(distribution_w), inputs.surroundings),
        )

    def _energy(self, inputs: StepInputs, it_w: F64, hvac_w: F64) -> dict[str, F64]:
        """Compute losses, battery, grid energy, emissions and cost.

        In an outage, the battery discharges at its maximum, whatever its command.
        """
        ups_w, distribution_w = self._power_path_loss_w(inputs, it_w)
        overhead_w = hvac_w + (ups_w + distribution_w) if self._counts_losses else hvac_w
        command, parameters = inputs.commands.battery_command, self._battery
        if not self._event_free:
            grid_up = inputs.surroundings.grid_up
            command = np.where(grid_up > 0, command, -1.0)
            parameters = parameters._replace(standby_per_h=parameters.standby_per_h * grid_up)
        battery = self._run_battery(
            inputs.state.stored_kwh,
            command,
            load_kw=(it_w + overhead_w) / 1e3,
            parameters=parameters,
        )
        needed_kwh = battery.grid_kwh
        grid_kwh = needed_kwh if self._event_free else needed_kwh * inputs.surroundings.grid_up
        battery_kwh = self._sizing.battery_kwh
        limit_kwh = self._sizing.grid_limit_kw * self._step_h
        return {
            "it_w": it_w,
            "hvac_w": hvac_w,
            "stored_kwh": battery.stored_kwh,
            "charge_kwh": battery.charge_kwh,
            "discharge_kwh": battery.discharge_kwh,
            "battery_loss_kwh": battery.battery_loss_kwh,
            "ups_loss_w": ups_w,
            "distribution_loss_w": distribution_w,
            "overhead_w": overhead_w,
            "soc": battery.stored_kwh / np.where(battery_kwh > 0, battery_kwh, 1.0),
            "it_kwh": it_w * self._step_h / 1e3,
            "hvac_kwh": hvac_w * self._step_h / 1e3,
            "grid_kwh": grid_kwh,
            "grid_overload_kwh": (
                0.0 * grid_kwh if self._grid_limit_kw is None else overload_kwh(grid_kwh, limit_kwh)
            ),
            "unserved_kwh": needed_kwh - grid_kwh,
            "carbon_g": grid_kwh * inputs.surroundings.ci_g_per_kwh,
            "energy_cost": grid_kwh * inputs.surroundings.price_per_kwh,
        }

    def _air_indices(self, air: HallSums, return_c: F64) -> AirIndices:
        """Compute the air-management indices of the halls."""
        servers, (low_c, high_c) = self._servers, self._allowable_c
        rises = air.inlet_m3k_s, air.outlet_m3k_s, air.it_airflow_m3s
        return AirIndices(
            over_27_mean_k=air.over_27_sum_k / servers,
            shi=air_metrics.shi(*rises),
            rti_pct=air_metrics.rti(return_c, air.supply_c, air_metrics.it_rise_k(*rises)),
            rci_hi_pct=air_metrics.rci_hi(air.over_27_sum_k, servers, allowable_c=high_c),
            rci_lo_pct=air_metrics.rci_lo(air.under_18_sum_k, servers, allowable_c=low_c),
        )

    def _run_battery(
        self, stored_kwh: F64, command: F64, *, load_kw: F64, parameters: BatteryParameters
    ) -> BatteryResult:
        """Run one step of the battery model."""
        return self._battery_model.step(
            stored_kwh,
            command,
            BatteryPoint(
                capacity_kwh=self._sizing.battery_kwh,
                load_kw=load_kw,
                dt_h=self._step_h,
                parameters=parameters,
                grid_limit_kw=self._grid_limit_kw,
            ),
        )

    def _coil_capacity_w(self, surroundings: Surroundings, supply: Supply) -> F64:
        """Return the mean heat that the coils in use can remove during the step, in W, (B,)."""
        cooling_w = self._sizing.water_side.coils_w
        if not self._event_free:
            cooling_w = cooling_w * supply.coil_share * surroundings.powered
        if not self._limits_coils:
            return cooling_w
        return np.minimum(cooling_w, self._while_powered(supply.coil_limit_w, surroundings))

    def _while_powered(self, power_w: F64, surroundings: Surroundings) -> F64:
        """Return the step mean of a power that is drawn only while the data center has power."""
        return power_w if self._event_free else power_w * surroundings.powered


class FacilityStage:
    """Runs the models of a facility as compiled kernels over the data centers."""

    def __init__(self, fleet: Fleet, facility: Facility) -> None:
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        self._recirculates = fleet.models["inlet"] == "recirculation"
        self._transient = fleet.models["thermal"] == "transient"
        self._step = CompiledStage(lambda **x: _checked_step(facility, **x), fleet.size)
        self._removable = CompiledStage(facility.removable_w, fleet.size)

    def limits_w(
        self,
        surroundings: Surroundings,
        supply: Supply,
        air: UnitAir,
        to_plant_w: F64 | None = None,
    ) -> dict[str, F64]:
        """Run ``Facility.removable_w``, with its arguments and results."""
        stages: dict[str, Any] = {} if to_plant_w is None else {"to_plant_w": to_plant_w}
        return self._removable(surroundings=surroundings, supply=supply, air=air, **stages)

    def step(
        self,
        state: State,
        commands: Commands,
        surroundings: Surroundings,
        supply: Supply,
        air: HallSums,
        liquid: LiquidLoads | None = None,
    ) -> dict[str, F64]:
        """Run ``Facility.step``; the arguments are the fields of ``StepInputs``.

        Returns:
            Quantities by their field names in ``StepResult``, and ``within_limits``, (B,): 1 for
            data centers whose results are physical, else 0.
        """
        stages: dict[str, Any] = {} if liquid is None else {"liquid": liquid}
        results = self._step(
            state=state,
            commands=commands,
            surroundings=surroundings,
            supply=supply,
            air=air,
            **stages,
        )
        results["unit_flow_m3s"] = (
            air.unit_airflow_m3s if self._recirculates else results["crac_flow_m3s"]
        )
        if self._transient:
            results["water_heat_kwh"] = air.water_j / 3.6e6
            results["tank_heat_kwh"] = air.tank_j / 3.6e6
            results["chilled_water_c"] = results["chilled_water_c"] + air.water_warmed_k
        return results


def _checked_step(facility: Facility, **stages: Any) -> dict[str, F64]:
    """Run a facility step and add ``within_limits``, a check of its inputs and results."""
    results = facility.step(StepInputs(**stages))
    air, surroundings = stages["air"], stages["surroundings"]
    checked = {
        "outdoor_c": surroundings.outdoor_c,
        "wet_bulb_c": surroundings.wet_bulb_c,
        "supply_c": air.supply_c,
        "inlet_max_c": air.inlet_max_c,
        "outlet_mean_c": air.outlet_mean_c,
    }
    return joined(results, {"within_limits": within_limits(joined(results, checked))})
