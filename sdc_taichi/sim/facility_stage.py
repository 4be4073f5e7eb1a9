"""The facility as a stage of a step: its inputs from the stages before it, compiled."""

from __future__ import annotations

from typing import Any

from sdc_taichi.sim.actions import Commands
from sdc_taichi.sim.crac_units import Supply
from sdc_taichi.sim.facility import Facility, FacilityInputs
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import HallSums
from sdc_taichi.sim.physical_limits import within_limits
from sdc_taichi.sim.surroundings import Surroundings
from sdc_taichi.sim.unit_index import UnitIndex
from sdc_taichi.types import F64, State


class FacilityStage:
    """Runs the models of a facility as compiled passes over the data centers.

    Args:
        fleet: B data centers.
        units: Their CRAC units.
        facility: Their models and sized devices.
        event_free: Whether no event can ever happen.
    """

    def __init__(
        self, fleet: Fleet, units: UnitIndex, facility: Facility, *, event_free: bool
    ) -> None:
        from sdc_taichi.kernels.compiler.stage import CompiledStage

        self._units, self._event_free = units, event_free
        self._recirculates = fleet.models["inlet"] == "recirculation"
        self._unit_design_m3s = fleet.unit_design_m3s
        self._step = CompiledStage(
            lambda **x: _checked_step(facility, x),
            fleet.size,
            reads=(*facility.input_names, *_only_checked(facility)),
        )
        self._removable = CompiledStage(
            lambda **x: facility.removable_w(FacilityInputs(**x)),
            fleet.size,
            reads=facility.plant_input_names,
        )

    def removable_w(self, supply: Supply, surroundings: Surroundings) -> F64:
        """Heat that the plant can take during a step, W, (B,)."""
        return self._removable.select(vars(surroundings) | vars(supply))["heat_removed_w"]

    def step(
        self,
        state: State,
        commands: Commands,
        surroundings: Surroundings,
        supply: Supply,
        air: HallSums,
    ) -> dict[str, Any]:
        """Everything that follows from the air of the halls, by the names of ``StepResult``.

        ``within_limits`` is 1 for data centers whose results are physical, else 0, (B,).

        Args:
            state: State at the start of the step, with battery and heat held by the room.
            commands: What the battery is to do.
            surroundings: Weather, carbon intensity, grid and what is out of order.
            supply: How the CRAC units run.
            air: Air, temperatures and power of the halls.
        """
        known = {
            **vars(surroundings),
            **vars(supply),
            **vars(air),
            **self._unit_sums(surroundings, air),
            "battery_command": commands.battery_command,
            "stored_kwh": state.stored_kwh,
            "room_heat_kwh": state.room_heat_kwh,
        }
        found = self._step.select(known)
        found["unit_supply_c"] = air.unit_supply_c if self._recirculates else found["supply_c"]
        found["unit_flow_m3s"] = air.unit_flow_m3s if self._recirculates else found["crac_flow_m3s"]
        return found

    def _unit_sums(self, surroundings: Surroundings, air: HallSums) -> dict[str, F64]:
        """Sums over the CRAC units that the facility reads, see ``FacilityInputs``."""
        units, sums = self._units, {}
        if self._recirculates:
            cubed_m3s = self._unit_design_m3s * air.unit_cubed_speed
            sums["cubed_flow_m3s"] = units.sum(cubed_m3s)
        if not self._event_free:
            sums["no_unit_down"] = units.lowest(surroundings.unit_running)
        return sums


def _only_checked(facility: Facility) -> tuple[str, ...]:
    """Names of quantities of a hall that the facility does not read, but that have limits."""
    return tuple(x for x in ("inlet_max_c", "outlet_mean_c") if x not in facility.input_names)


def _checked_step(facility: Facility, quantities: dict[str, Any]) -> dict[str, Any]:
    """Results of a facility, and whether they and those of its hall are physical."""
    inputs = FacilityInputs(**{name: quantities[name] for name in facility.input_names})
    found = facility.step(inputs)
    return {**found, "within_limits": within_limits({**quantities, **found})}
