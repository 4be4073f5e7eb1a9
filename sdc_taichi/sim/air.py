"""Air models of the halls in a step: quasi-steady, or transient with thermal storage.

Both models solve a step from the placement of the work and the operation of the CRAC units. Their
memory between steps is a part of ``State``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.sim.crac_units import Supply, UnitAir
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import ChilledWater, Coil, Conditions, HallState, HallSums
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.step_inputs import Surroundings, UnitIndex
from sdc_taichi.sim.work_allocation import Placement
from sdc_taichi.types import F64, State, fields_of

J_PER_KWH = 3.6e6
SHORTEST_SUBSTEP_S = 5.0
"""Length of the shortest substeps after abrupt changes, in s; the air before a rack follows its mix
within about 20 s."""
_AXES = {"unit": "U", "rack": "R"}
"""Axes of the fields of ``HallSums`` by the first part of their names; all other fields have one
entry per data center, B."""
STATE_AXES = {
    **dict.fromkeys(("queue", "in_flight", "stored_kwh", "room_heat_kwh"), "B"),
    **dict.fromkeys(("water_heat_j", "tank_heat_j"), "B"),
    **dict.fromkeys(("setpoint_c", "cooling_run", "cooling_last", "fan_speed"), "U"),
    **dict.fromkeys(("rack_status", "restart_wait_min"), "R"),
    **dict.fromkeys(("group_inlet_c", "server_c"), "G"),
    **dict.fromkeys(("mixed_c", "exhaust_c", "captured_m3s"), "R"),
    **dict.fromkeys(("need_m3s", "plain_m3s", "following", "supply_excess_k"), "U"),
    **dict.fromkeys(("casing_c", "return_air_c"), "U"),
    **dict.fromkeys(("cdu_setpoint_c", "cdu_flow"), "C"),
    **dict.fromkeys(("manifold_return_c", "manifold_supply_c"), "M"),
    **dict.fromkeys(("facility_return_c", "facility_supply_c"), "B"),
    "junction_c": "L",
}
"""First axes of the fields of ``State``, except its seeds and its clock."""
_HALL_FIELDS = tuple(f.name for f in fields(HallState))
_EMPTY = np.zeros(0)


class SteadyAir:
    """Quasi-steady halls, whose temperatures follow load and supply air immediately.

    Args:
        fleet: B data centers.
        hall: Their halls.
        sizing: Their sized devices.
        units: Their CRAC units.
        keep_inlets: True if the placement policy reads the inlet temperatures of the last step.
    """

    def __init__(
        self, fleet: Fleet, hall: Hall, sizing: Sizing, units: UnitIndex, *, keep_inlets: bool
    ) -> None:
        self._hall, self._units = hall, units
        self._room_kwh_per_k = sizing.room_kwh_per_k
        self._inlets = _GroupInlets(fleet, hall, keep=keep_inlets)
        self._no_memory = dict.fromkeys(_HALL_FIELDS, _EMPTY)

    def initial(self, supply: Supply, demand: F64, rack_load: F64 | None) -> dict[str, Any]:
        """Return the temperatures before the first step, by their field names in ``State``.

        Args:
            supply: Operation of the CRAC units.
            demand: Running work as a share of capacity, 0..1, (B,).
            rack_load: Load of each rack, 0..1, (R,); None loads racks evenly.
        """
        return {**self._no_memory, "group_inlet_c": self._inlets.initial()}

    def solve(
        self,
        state: State,
        placement: Placement,
        supply: Supply,
        surroundings: Surroundings,
        to_plant_w: F64 | None = None,
    ) -> tuple[HallSums, dict[str, Any]]:
        """Compute airflows, temperatures and power of a step.

        Args:
            state: State at the start of the step, of which the heat stored in the room is read.
            placement: Placement of the work.
            supply: Operation of the CRAC units.
            surroundings: Failures of the step.
            to_plant_w: Heat of facility water that the plants remove beside that of the coils, in
                W, (B,); only transient halls read it. None if there is none.

        Returns:
            Results of the step, and the temperatures at its end by their field names in ``State``.

        Raises:
            PhysicalLimitError: There is no steady state, or temperatures or power overflow.
        """
        warmed_k = self._units.of_each(state.room_heat_kwh / self._room_kwh_per_k)
        unit_supply_c = supply.coldest_supply_c + warmed_k
        air = self._hall.solve(_conditions(unit_supply_c, placement, supply, surroundings))
        return air, {**self._no_memory, "group_inlet_c": self._inlets.last()}


class TransientAir:
    """Transient halls, whose servers and recirculated air store heat.

    Args:
        fleet: B data centers.
        hall: Their halls.
        sizing: Their sized devices.
        limits_w: ``FacilityStage.limits_w``, which returns the heat that the plant can remove and
            that coils and pumps can carry during a step.
        keep_inlets: True if the placement policy reads the inlet temperatures of the last step.
    """

    def __init__(
        self,
        fleet: Fleet,
        hall: Hall,
        sizing: Sizing,
        limits_w: Callable[[Surroundings, Supply, UnitAir, F64 | None], Mapping[str, F64]],
        *,
        keep_inlets: bool,
    ) -> None:
        self._hall, self._limits_w, self._water = hall, limits_w, sizing.chilled_water
        self._step_s = 1.0 / fleet.steps_per_hour * 3600.0
        self._substep_s = fleet.configs[0].simulation.substep_s
        self._room_j_per_k = sizing.room_kwh_per_k * J_PER_KWH
        self._fan_w_per_m3s = sizing.crac_fan_w / sizing.crac_flow_m3s
        self._unit_sums, self._unit_m3s = fleet.unit_sums, fleet.unit_design_m3s
        self._inlets = _GroupInlets(fleet, hall, keep=keep_inlets)

    def initial(self, supply: Supply, demand: F64, rack_load: F64 | None) -> dict[str, Any]:
        """Return the steady temperatures at a load; arguments as in ``SteadyAir.initial``."""
        steady = self._hall.steady_state(
            Conditions(
                unit_supply_c=supply.coldest_supply_c,
                utilisation=demand,
                rack_load=rack_load,
                unit_low=supply.unit_low,
                unit_high=supply.unit_high,
            )
        )
        return {**fields_of(steady), "group_inlet_c": self._inlets.initial()}

    def solve(
        self,
        state: State,
        placement: Placement,
        supply: Supply,
        surroundings: Surroundings,
        to_plant_w: F64 | None = None,
    ) -> tuple[HallSums, dict[str, Any]]:
        """Compute a transient step; arguments and results as in ``SteadyAir.solve``.

        Raises:
            PhysicalLimitError: Temperatures or power overflow.
        """
        speed = np.minimum(np.maximum(state.following, supply.unit_low), supply.unit_high)
        water, tank_share = self._water, surroundings.tank_share
        j_per_k = water.loop_j_per_k + tank_share * water.mixed_tank_j_per_k

        def warmed_k(room_j: F64, water_j: F64, tank_j: F64) -> F64:
            of_room = (room_j - water_j - tank_j) / self._room_j_per_k
            return np.maximum(
                np.where(j_per_k > 0.0, water_j / np.maximum(j_per_k, 1.0), of_room), 0.0
            )

        room_j = state.room_heat_kwh * J_PER_KWH
        at_start_k = warmed_k(room_j, state.water_heat_j, state.tank_heat_j)
        flow_m3s = self._unit_sums(self._unit_m3s * speed)
        returned = self._unit_sums(self._unit_m3s * speed * state.return_air_c)
        unit_air = UnitAir(
            return_c=returned / np.maximum(flow_m3s, 1e-30),
            flow_m3s=flow_m3s,
            warmed_k=at_start_k,
        )
        limits = self._limits_w(surroundings, supply, unit_air, to_plant_w)
        coil = Coil(
            setpoint_c=supply.coldest_supply_c,
            room_j=room_j,
            room_j_per_k=self._room_j_per_k,
            limit_w=limits["limit_w"],
            limit_w_per_k=limits["limit_w_per_k"],
            limit_w_per_w=limits["limit_w_per_w"],
            fan_w_per_m3s=self._fan_w_per_m3s * surroundings.powered,
            water=ChilledWater(
                carried_w=limits["carried_w"],
                j_per_k=j_per_k,
                tank_most_j=water.stratified_tank_j,
                tank_share=tank_share,
            ),
        )
        air, after = self._hall.advance(
            # The coil determines the supply temperature of each substep; this one is a start value.
            _conditions(supply.coldest_supply_c, placement, supply, surroundings),
            HallState(**{name: getattr(state, name) for name in _HALL_FIELDS}),
            coil,
            self._step_s,
            self._substep_s,
            shortest_s=SHORTEST_SUBSTEP_S,
        )
        air.most_warmed_k = np.maximum(at_start_k, warmed_k(air.room_j, air.water_j, air.tank_j))
        return air, {**fields_of(after), "group_inlet_c": self._inlets.last()}


class _GroupInlets:
    """Inlet temperatures of the server groups, computed only if the placement policy reads them."""

    def __init__(self, fleet: Fleet, hall: Hall, *, keep: bool) -> None:
        self._fleet, self._hall, self._keep = fleet, hall, keep

    def initial(self) -> F64:
        """Return the inlet temperatures at the initial setpoints, in C, (G,); empty if unused."""
        if not self._keep:
            return _EMPTY
        fleet = self._fleet
        supply_c = fleet.values("hvac.setpoint.initial_c") - fleet.setpoint_over_supply_k
        inlet_c = supply_c[fleet.rack_dc] + fleet.approach_k
        return np.repeat(inlet_c, np.diff(fleet.group_offsets))

    def last(self) -> F64:
        """Return the inlet temperatures of the last step, in C, (G,); empty if unused."""
        return self._hall.group_inlets() if self._keep else _EMPTY


def plain_supply_air(like: HallSums, supply: Supply, fleet: Fleet) -> HallSums:
    """Return the air of halls without heat: all air is supply air, and servers draw no power.

    Args:
        like: Results of a step, for the types of their arrays.
        supply: Operation of the CRAC units.
        fleet: The data centers.
    """
    coldest_c = supply.coldest_supply_c
    mean_c = fleet.unit_sums(coldest_c) / np.diff(fleet.unit_offsets)
    supply_c = {"U": coldest_c, "B": mean_c, "R": mean_c[fleet.rack_dc]}
    values = {name: np.zeros_like(value) for name, value in fields_of(like).items()}
    for name, value in values.items():
        if name.endswith("_c"):
            value[:] = supply_c[_axis(name)]
    values["units_flow_m3s"][:] = fleet.design_flow_m3s
    values["unit_airflow_m3s"][:] = fleet.unit_design_m3s
    return HallSums(**values)


def held_air(
    air: HallSums,
    thermal: Mapping[str, Any],
    beyond: npt.NDArray[np.bool_],
    *,
    last: HallSums,
    state: State,
    fleet: Fleet,
) -> tuple[HallSums, dict[str, Any]]:
    """Replace the air of data centers beyond their limits by air of an earlier step.

    Args:
        air: Results of the step.
        thermal: Temperatures at the end of the step by their field names in ``State``.
        beyond: True for data centers beyond their limits, (B,).
        last: Results of the earlier step.
        state: State at the start of the step, whose temperatures these data centers keep.
        fleet: The data centers.

    Returns:
        Results and temperatures; those of the other data centers are unchanged.
    """
    axes = {name: _axis(name) for name in fields_of(air)}
    values = with_entries_of(last, fields_of(air), beyond, axes, fleet)
    values["room_j"] = np.where(beyond, state.room_heat_kwh * J_PER_KWH, values["room_j"])
    for name, stored_j in (("water_j", state.water_heat_j), ("tank_j", state.tank_heat_j)):
        if len(stored_j):
            values[name] = np.where(beyond, stored_j, values[name])
    return HallSums(**values), with_entries_of(state, thermal, beyond, STATE_AXES, fleet)


def with_entries_of(
    source: Any,
    values: Mapping[str, Any],
    chosen: npt.NDArray[np.bool_],
    axes: Mapping[str, str],
    fleet: Fleet,
) -> dict[str, Any]:
    """Replace the entries of chosen data centers by those of another object.

    Args:
        source: Object with the replacing values as attributes.
        values: Arrays by name; empty arrays stay empty.
        chosen: True for these data centers, (B,).
        axes: First axis of each array by name: ``B``, ``U``, ``R``, ``G``, ``C``, ``M`` or ``L``
            for entries of data centers, CRAC units, racks, server groups, CDUs, manifolds or
            liquid-cooled racks.
        fleet: The data centers.
    """
    racks = chosen[fleet.rack_dc]
    is_chosen = {
        "B": chosen,
        "U": chosen[fleet.unit_dc],
        "R": racks,
        "G": np.repeat(racks, np.diff(fleet.group_offsets)),
        "C": chosen[fleet.cdu_dc],
        "M": chosen[fleet.manifold_dc],
        "L": racks[fleet.liquid_racks],
    }
    replaced = dict(values)
    for name, value in values.items():
        if len(value):
            at = is_chosen[axes[name]].reshape(-1, *[1] * (value.ndim - 1))
            replaced[name] = np.where(at, getattr(source, name), value)
    return replaced


def _axis(name: str) -> str:
    """Return the axis of a field of ``HallSums``."""
    return _AXES.get(name.split("_")[0], "B")


def _conditions(
    unit_supply_c: F64, placement: Placement, supply: Supply, surroundings: Surroundings
) -> Conditions:
    """Collect the boundary conditions of the halls during a step."""
    return Conditions(
        unit_supply_c=unit_supply_c,
        utilisation=placement.utilisation,
        rack_load=placement.rack_load,
        group_load=placement.group_load,
        powered=placement.rack_powered,
        rack_airflow=surroundings.rack_airflow,
        unit_low=supply.unit_low,
        unit_high=supply.unit_high,
        unit_running=None if surroundings.all_running else surroundings.unit_running,
    )
