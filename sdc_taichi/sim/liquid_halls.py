"""Liquid-cooled racks in the steps of a fleet: inputs, results and effects on other stages."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from sdc_taichi.config.odd_values import odd_w_class, warn_of
from sdc_taichi.hall.protection import TRIPPED
from sdc_taichi.plant.water_side import chilled_water_c
from sdc_taichi.plant.workload import TASKS_PER_STEP
from sdc_taichi.sim.crac_units import Supply
from sdc_taichi.sim.fleet import Fleet
from sdc_taichi.sim.hall_solver import Hall
from sdc_taichi.sim.hall_state import HallSums
from sdc_taichi.sim.junction_parts import JunctionParts, junction_parts
from sdc_taichi.sim.liquid import Liquid, LiquidInputs, LiquidResult, LiquidState
from sdc_taichi.sim.room_dew_point import RoomDewPoint
from sdc_taichi.sim.sizing import Sizing
from sdc_taichi.sim.step_inputs import Commands, Surroundings
from sdc_taichi.sim.work_allocation import Placement
from sdc_taichi.types import (
    CDUS,
    DATA_CENTERS,
    F64,
    I64,
    QUANTITIES,
    RACKS,
    CduQuantities,
    LiquidQuantities,
    LoopQuantities,
    Reals,
    State,
    fields_of,
)

STATE_FIELDS = tuple(f.name for f in fields(LiquidState))
"""Fields of ``State`` that liquid cooling needs."""
_STEADY_FIELDS = ("cdu_setpoint_c", "cdu_flow")
"""Fields of ``State`` that liquid cooling of quasi-steady halls needs."""
_NO_STATE = dict.fromkeys(STATE_FIELDS, np.zeros(0))
_NAMES = {
    axis: tuple(f.name for f in fields(LiquidQuantities) if QUANTITIES[f.name].axis == axis)
    for axis in (DATA_CENTERS, CDUS, RACKS)
}
_ALL_NAMES = (*_NAMES[DATA_CENTERS], *_NAMES[CDUS], *_NAMES[RACKS])
_TIMES = slice(_NAMES[DATA_CENTERS].index("throttle_s"), _NAMES[DATA_CENTERS].index("trip_s") + 1)
"""Rows of the quantities of data centers that are times."""
_OF_LOOPS = tuple(f.name for f in (*fields(LoopQuantities), *fields(CduQuantities)))
_values_of_loops = attrgetter(*_OF_LOOPS)
_DEVICES = ("cdu_pump", "facility_pump", "cooler_fan", "trim_chiller", "heat_pump")
"""Devices of liquid cooling with electric power."""


@dataclass
class LiquidStep:
    """Liquid cooling of B data centers and L liquid-cooled racks in one step."""

    more_it_w: F64
    """IT power less the heat that the hall's air takes from liquid-cooled racks, in W, (B,)."""
    overhead_w: F64
    """Electric power of pumps, fans, trim chiller and heat pump, in W, (B,)."""
    more_water_l: F64
    """Water and coolant that the loops consume, in l, (B,)."""
    quantities: dict[str, Any]
    """``LiquidQuantities`` by name."""
    rack_it_w: F64
    """Power of each liquid-cooled rack, in W, (L,)."""
    more_rack_w: F64
    """Power of each liquid-cooled rack less its heat in the hall's air, in W, (L,)."""
    on: F64
    """Share of the step in which each liquid-cooled rack is on, 0..1, (L,)."""
    tripped: I64
    """Indices of the racks that switch off."""
    without_coolant: I64
    """Indices of the racks with cold plates whose coolant cannot flow or be cooled."""
    throttled_tasks: F64
    """Started work that limited GPUs did not complete, in tasks, (B,)."""
    state: dict[str, F64]
    """Fields of ``State`` at the end of the step."""
    to_plant_w: F64 | None
    """Heat that the plants of the CRAC units take from facility water, in W, (B,); None if no plant
    takes any."""
    without_room_tasks: F64
    """Part of ``throttled_tasks`` for which the queue has no room, in tasks, (B,)."""


class LiquidHalls:
    """Runs the liquid cooling of a fleet between the placement of work and the air of the halls.

    Args:
        fleet: B data centers with L liquid-cooled racks.
        hall: Halls of these data centers, whose sizes are known: the heat that liquid-cooled racks
            give to their air is an input from now on.
        sizing: Their sized devices, with the design weather.

    Warns:
        OddInputWarning: A cooler does not reach its W class on the design day.
    """

    def __init__(self, fleet: Fleet, hall: Hall, sizing: Sizing) -> None:
        assert fleet.liquid is not None
        self._fleet, self._hall, self._transient = (
            fleet,
            hall,
            fleet.models["thermal"] == "transient",
        )
        self._racks = fleet.liquid_racks.astype(np.intp)
        self._dc = fleet.rack_dc[self._racks].astype(np.intp)
        self._cdu_dc = fleet.cdu_dc.astype(np.intp)
        self._all_on = np.ones(len(self._racks))
        self._model = Liquid(
            fleet.liquid, step_s=3600.0 / fleet.steps_per_hour, transient=self._transient
        )
        self._servers = fleet.per_rack_servers()
        self._share_of_work = self._servers[self._racks] / fleet.per_dc_servers()[self._dc]
        self._manifold = fleet.liquid.rack_manifold
        self._cdu_manifold = fleet.liquid.cdu_manifold
        self._manifolds = len(fleet.liquid.rack_offsets) - 1
        sections = [config.liquid for config in fleet.configs]
        self._dew_point = RoomDewPoint(fleet)
        self._pump_share = np.array(
            [s.cdus.pump_share if s.cdus.pumps > 1 else 0.0 for s in sections if s is not None]
        ).repeat(np.diff(fleet.cdu_offsets)[[s is not None for s in sections]])
        self._water_side = sizing.water_side
        hall.take_heat_of(self._racks)
        weather = zip(fleet.configs, sizing.design_outdoor_c, sizing.design_wet_bulb_c, strict=True)
        odd = [(c.name, odd_w_class(c, float(dry), float(wet))) for c, dry, wet in weather]
        warn_of([(name, [text]) for name, text in odd if text is not None])

    def initial(self, surroundings_c: tuple[F64, F64], load: F64, supply: Supply) -> dict[str, F64]:
        """Return the fields of ``State`` before the first step; give transient halls the heat.

        Args:
            surroundings_c: Outdoor dry bulb and wet bulb, in C, (B,) each.
            load: Utilisation of each rack, 0..1, (R,).
            supply: Operation of the CRAC units before the first step.
        """
        outdoor_c, wet_bulb_c = surroundings_c
        state = self._model.initial_state(
            LiquidInputs(
                utilisation=load[self._racks],
                powered=np.ones(len(self._racks)),
                outdoor_c=outdoor_c,
                wet_bulb_c=wet_bulb_c,
                dew_point_c=self._dew_point.at(outdoor_c, wet_bulb_c),
                chilled_water_c=self._chilled_water_c(supply),
            )
        )
        if self._transient:
            self._set_heat(self._model.air_w)
        return self._kept(state)

    def step(
        self,
        state: State,
        commands: Commands,
        surroundings: Surroundings,
        placement: Placement,
        supply: Supply,
    ) -> LiquidStep:
        """Compute a step, and tell the halls the heat in their air."""
        on = self._all_on
        if placement.rack_powered is not None:
            on = placement.rack_powered[self._racks]
        share = None
        if not self._transient and not surroundings.fully_powered:
            # Steady loops run while there is power, and their results are means over the step. The
            # loops of transient halls run during the whole step.
            share = surroundings.powered
            powered = (on > 0.0).astype(np.float64)
        else:
            powered = on
        failures = self._failures(surroundings)
        after, result = self._model.step(
            state,
            LiquidInputs(
                utilisation=self._utilisation(placement),
                powered=powered,
                outdoor_c=surroundings.outdoor_c,
                wet_bulb_c=surroundings.wet_bulb_c,
                dew_point_c=self._dew_point.at(surroundings.outdoor_c, surroundings.wet_bulb_c),
                cdu_setpoint_c=commands.cdu_setpoint_target_c,
                cdu_flow=commands.cdu_flow_command,
                facility_approach_k=commands.facility_approach_k,
                reuse_share=commands.reuse_share,
                power_cap=commands.power_cap,
                chilled_water_c=self._chilled_water_c(supply),
                **failures,
            ),
        )
        result.air_w = self._set_heat(result.air_w)
        return self._as_step(
            after, result, on, share, self._racks_without_coolant(surroundings, failures)
        )

    def with_liquid(self, air: HallSums, step: LiquidStep) -> dict[str, Reals]:
        """Return quantities of the halls in which liquid-cooled racks have their whole power."""
        rack_cpu_w = air.rack_cpu_w.copy()
        rack_cpu_w[self._racks] = step.rack_it_w
        return {"cpu_w": air.cpu_w + step.more_it_w, "rack_cpu_w": rack_cpu_w}

    def add_power(self, power_w: Reals, per_rack: npt.NDArray[Any], step: LiquidStep) -> None:
        """Add the power that does not warm the hall's air to servers or server groups.

        Args:
            power_w: Power of each server or group, which is changed, in W, (S,) or (G,).
            per_rack: Number of entries of each rack, (R,).
            step: The step.
        """
        more_w, on = np.zeros(self._fleet.racks), step.on
        while_on_w = np.divide(step.more_rack_w, on, out=np.zeros(len(on)), where=on > 0.0)
        more_w[self._racks] = while_on_w / self._servers[self._racks]
        power_w += np.repeat(more_w, per_rack.astype(np.int64))

    def junction_parts(self, dc: int, rack: int | None) -> JunctionParts:
        """Split the junction of a rack of a data center after the last step.

        Args:
            dc: Index of the data center.
            rack: Index of the rack in its hall; None is that of the hottest junction.
        """
        (of_dc,) = np.nonzero(self._dc == dc)
        in_hall = self._racks[of_dc] - self._fleet.rack_offsets[dc]
        indices = dict(zip(in_hall.tolist(), of_dc.tolist(), strict=True))
        return junction_parts(self._model, indices, rack)

    def close(self) -> None:
        """Release the kernel arrays."""
        self._model.close()

    def _set_heat(self, air_w: F64) -> F64:
        """Set the heat that liquid-cooled racks give to the air of the halls; return it, (L,)."""
        # Cold lines can take up more than racks give while they have no power.
        air_w = np.maximum(air_w, 0.0)
        self._hall.set_heat(air_w)
        return air_w

    def _as_step(
        self,
        after: LiquidState,
        result: LiquidResult,
        on: F64,
        share: F64 | None,
        without_coolant: I64,
    ) -> LiquidStep:
        """Return a step from the results of the model.

        Args:
            after: State after the step.
            result: Results of the model.
            on: Share of the step in which each liquid-cooled rack is on, (L,).
            share: Share of the step that the results of the model describe, (B,); None for all.
            without_coolant: Result of ``_racks_without_coolant``.
        """
        size, racks = self._fleet.size, self._fleet.racks
        values: dict[str, Any] = dict(zip(_OF_LOOPS, _values_of_loops(result), strict=True))
        it_w, liquid_w, lost = result.it_w, result.liquid_w, result.lost_utilisation
        if share is not None:
            of_axis = {DATA_CENTERS: share, CDUS: share[self._cdu_dc]}
            for name, value in values.items():
                if name.endswith(("_w", "_l", "_income", "_m3s")) and name != "leak_l":
                    values[name] = value * of_axis[QUANTITIES[name].axis]
            of_racks = share[self._dc]
            it_w, liquid_w, lost = it_w * of_racks, liquid_w * of_racks, lost * of_racks
        throttled = np.zeros(size)
        if lost.any():
            # The work of racks that switch off is lost as a whole.
            lost = np.where(result.tripped > 0.0, 0.0, lost) * self._share_of_work
            throttled = TASKS_PER_STEP * self._sums(lost)
        of_racks_c, of_racks_w = np.zeros((2, racks))
        of_racks_c[self._racks], of_racks_w[self._racks] = result.junction_each_c, liquid_w
        values["throttled_tasks"] = throttled
        values["rack_junction_c"], values["rack_liquid_w"] = of_racks_c, of_racks_w
        more_rack_w = it_w - on * result.air_w
        return LiquidStep(
            more_it_w=self._sums(more_rack_w),
            overhead_w=sum(values[f"{device}_w"] for device in _DEVICES),
            more_water_l=values["cooler_water_l"] + values["leak_l"],
            quantities=values,
            rack_it_w=it_w,
            more_rack_w=more_rack_w,
            on=on,
            tripped=self._racks[result.tripped > 0.0],
            without_coolant=without_coolant,
            throttled_tasks=throttled,
            state=self._kept(after),
            to_plant_w=values["liquid_to_plant_w"] if self._model.has_plants else None,
            without_room_tasks=np.zeros(size),
        )

    def _chilled_water_c(self, supply: Supply) -> F64 | None:
        """Return the chilled water of plants that cool facility water, in C, (B,)."""
        if not self._model.has_plants:
            return None
        return chilled_water_c(supply.water_setpoint_c, self._water_side)

    def _kept(self, state: LiquidState) -> dict[str, F64]:
        """Return the fields of ``State``, of which quasi-steady halls need setpoints and flows."""
        if self._transient:
            return fields_of(state)
        return no_liquid_state() | {name: getattr(state, name) for name in _STEADY_FIELDS}

    def _sums(self, of_racks: F64) -> F64:
        """Sum values of liquid-cooled racks, (L,), within each data center, (B,)."""
        return np.bincount(self._dc, of_racks, self._fleet.size).astype(np.float64)

    def _utilisation(self, placement: Placement) -> F64:
        """Return the utilisation of each liquid-cooled rack, 0..1, (L,)."""
        if placement.rack_load is not None:
            return placement.rack_load[self._racks]
        if placement.group_load is not None:
            busy = self._fleet.group_sums(self._fleet.per_group_servers() * placement.group_load)
            return (busy / self._servers)[self._racks]
        return placement.utilisation[self._dc]

    def _failures(self, surroundings: Surroundings) -> dict[str, Any]:
        """Return the failures as arguments of ``LiquidInputs``."""
        failures: dict[str, Any] = {"leak_l": surroundings.leaked_l}
        if self._model.has_plants:
            plant = surroundings.chiller_share * surroundings.pump_share
            failures["plant_share"] = np.where(surroundings.powered > 0.0, plant, 0.0)
        if surroundings.cdu_up is None and surroundings.fully_powered:
            return failures
        size, fleet = self._fleet.size, self._fleet
        on = (surroundings.powered > 0.0).astype(np.float64)
        ones = np.ones(size)
        up = np.ones(fleet.cdus) if surroundings.cdu_up is None else surroundings.cdu_up
        failures["cdu_up"] = up * on[self._cdu_dc]
        pump = ones if surroundings.facility_pump is None else surroundings.facility_pump
        failures["facility_pump"] = pump * on
        fans = ones if surroundings.cooler_share is None else surroundings.cooler_share
        failures["cooler_share"] = fans * on
        if surroundings.cdu_pump_up is not None:
            failures["cdu_pumps"] = np.where(surroundings.cdu_pump_up > 0.0, 1.0, self._pump_share)
        if surroundings.rack_leaks is not None and surroundings.rack_leaks.any():
            failures["rack_valve"] = np.where(surroundings.rack_leaks, 0.0, 1.0)
        return failures

    def _racks_without_coolant(self, surroundings: Surroundings, failures: dict[str, Any]) -> I64:
        """Return indices of racks with cold plates whose coolant cannot flow or be cooled.

        Racks with a rear door run on in air.
        """
        if surroundings.cdu_up is None:
            return self._racks[:0]
        assert surroundings.facility_pump is not None
        assert surroundings.rack_leaks is not None
        pumping = failures["cdu_up"] * failures.get("cdu_pumps", 1.0)
        per_manifold = np.bincount(self._cdu_manifold, pumping, self._manifolds)
        has_water = failures["facility_pump"][self._dc] > 0.0
        flows = (per_manifold[self._manifold] > 0.0) & has_water & ~surroundings.rack_leaks
        return np.asarray(self._racks[~flows & self._model.fleet.has_plates])


def with_leaks(state: State, surroundings: Surroundings, fleet: Fleet) -> State:
    """Return the state of a step in which racks whose cold plates leak are off."""
    if surroundings.rack_leaks is None or not surroundings.rack_leaks.any():
        return state
    assert fleet.liquid is not None
    status = state.rack_status.copy()
    status[fleet.liquid_racks[surroundings.rack_leaks & fleet.liquid.has_plates]] = TRIPPED
    return replace(state, rack_status=status)


def without_liquid(fleet: Fleet) -> dict[str, Any]:
    """Return ``LiquidQuantities`` of a step without liquid cooling by name, as new arrays."""
    rows = np.zeros((len(_NAMES[DATA_CENTERS]), fleet.size))
    # These times are -1 in steps in which nothing happens.
    rows[_TIMES] = -1.0
    per_cdu = np.zeros((len(_NAMES[CDUS]), fleet.cdus))
    per_rack = np.zeros((len(_NAMES[RACKS]), fleet.racks))
    return dict(zip(_ALL_NAMES, (*rows, *per_cdu, *per_rack), strict=True))


def no_liquid_state() -> dict[str, F64]:
    """Return the fields of ``State`` that liquid cooling needs, empty, by name."""
    return _NO_STATE
