"""Stage of liquid-cooled racks: CDUs, facility loop, heat reuse and rejection."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sdc_taichi.kernels import liquid_arguments as spec
from sdc_taichi.kernels.arguments import in_row_order
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.plant.chiller import CHILLERS, KELVIN, ChillerParameters, ChillerPoint, carnot
from sdc_taichi.plant.liquid import (
    COOLER_SIDE_SHARE,
    COOLER_WALL_SHARE,
    M3S_PER_LPM,
    PLANT_APPROACH_K,
    REJECTION_KINDS,
    LiquidFleet,
    size_liquid,
)
from sdc_taichi.plant.tower import (
    WATER_J_PER_KG_K,
    TowerPoint,
    TowerResult,
    yorkcalc,
    yorkcalc_reference_water_kg_s,
)
from sdc_taichi.plant.water import EVAPORATION_HEAT_J_PER_KG
from sdc_taichi.types import F64, CduQuantities, LoopQuantities, State, Values

if TYPE_CHECKING:
    from sdc_taichi.kernels.compiler.named_kernel import NamedKernel

SETPOINT_STEP_K = 2.0
"""Largest change of a supply setpoint in a step, in K."""
MOST_SWEEPS = 12
"""Largest number of sweeps of a steady step."""
SERIAL_RACKS, SERIAL_RACKS_TRANSIENT = 1024, 32
"""Largest number of racks that one thread computes faster than several, in steady and in transient
halls."""
SLICES_PER_THREAD = 4
"""Number of parts of the data centers per thread; several parts balance the threads."""
TOWER_WET_BULB_C, TOWER_APPROACH_K = 25.6, 4.0
"""Design wet bulb of towers, and design approach: leaving water minus wet bulb, in C and K."""
TOWER_PASSES = 2
"""Repetitions of the kernel with the tower water for its heat; the first pass assumes the design
approach."""
PUMP_FAILURE_SUBSTEP_S, FAILURE_SUBSTEP_S = 1.0, 5.0
"""Substeps of transient halls without flow in the facility loop or with less than ``LEAST_FLOW`` in
a manifold, and during other failures, in s."""
LEAST_FLOW = 0.5
"""Flow that the CDUs of a manifold can give, as a share of design, with the usual substeps of
failures."""
MOST_FLOW = 1.1
"""Largest flow of coolant, as a share of design."""
NO_LEAST_C = -1000.0
"""Lowest setpoint of facility water that nothing limits, in C."""
LEAST_CAPTURE, LEAST_K_PER_W, LEAST_LOSS_W_PER_K = 1e-3, 1e-6, 1.0
"""Lower bounds of the share of the heat of chips in the coolant, of their resistance in K/W, and of
the losses of the pipes of a rack in W/K, so that every heat flow has a temperature."""


@dataclass
class LiquidState:
    """State of coolant loops between steps; quasi-steady halls read setpoints and flows alone."""

    cdu_setpoint_c: F64
    """Supply setpoint of each CDU, in C, (C,)."""
    cdu_flow: F64
    """Commanded flow of each CDU, as a share of the design flow of its manifold, (C,)."""
    junction_c: F64
    """Junction of the GPUs of each rack with coolant, in C, (L,)."""
    manifold_return_c: F64
    """Coolant that returns to the CDUs of each manifold, in C, (M,)."""
    manifold_supply_c: F64
    """Coolant that reaches the racks of each manifold, in C, (M,)."""
    facility_return_c: F64
    """Facility water that returns to the cooler, in C, (B,)."""
    facility_supply_c: F64
    """Facility water that reaches the CDUs, in C, (B,)."""


@dataclass
class LiquidInputs:
    """Loads, weather, commands and failures of a step; None stands for default or no failure."""

    utilisation: F64
    """Utilisation of each rack with coolant, 0..1, (L,)."""
    powered: F64
    """Share of the step in which each rack with coolant has power; 0 after a trip, (L,)."""
    outdoor_c: F64
    """Outdoor dry bulb, in C, (B,)."""
    wet_bulb_c: F64
    """Outdoor wet bulb, in C, (B,)."""
    dew_point_c: F64
    """Dew point of the room, in C, (B,)."""
    cdu_setpoint_c: F64 | None = None
    """Commanded supply setpoint, in C, (C,); setpoints move by at most ``SETPOINT_STEP_K``."""
    cdu_flow: F64 | None = None
    """Commanded flow, as a share of the design flow of the manifold, (C,)."""
    facility_approach_k: F64 | None = None
    """Lowest supply setpoint minus facility setpoint, in K, (B,); None for that of the CDUs."""
    reuse_share: F64 | None = None
    """Share of the heat that is offered to the consumer, 0..1, (B,)."""
    power_cap: F64 | None = None
    """Largest power of a GPU as a share of that at full load, (B,); 1 means no cap."""
    cdu_up: F64 | None = None
    """1 for CDUs that run, else 0, (C,)."""
    cdu_pumps: F64 | None = None
    """Flow that the working pumps of each CDU can give, as a share of that of all, (C,)."""
    facility_pump: F64 | None = None
    """Share of the facility pumps that work, 0..1, (B,)."""
    cooler_share: F64 | None = None
    """Share of the cooler's fans that work, 0..1, (B,)."""
    plant_share: F64 | None = None
    """Share of chillers and pumps of the plant of the CRAC units that work, 0..1, (B,); read for
    data centers whose plant cools facility water."""
    chilled_water_c: F64 | None = None
    """Chilled water of that plant, in C, (B,); None does not limit the facility water."""
    rack_valve: F64 | None = None
    """Opening of the valve of each rack, 0..1, (L,); a rack with cold plates at 0, such as one that
    leaks, is off."""
    leak_l: F64 | None = None
    """Coolant lost by leaks, in l, (B,)."""


@dataclass
class LiquidResult(CduQuantities, LoopQuantities):
    """One step of racks with coolant: temperatures at its end, and means of all else over it."""

    liquid_it_w: F64
    """Power of racks with coolant, in W, (B,)."""
    facility_setpoint_c: F64
    """Setpoint of the facility water, in C, (B,)."""
    it_w: F64
    """Power of each rack with coolant, in W, (L,)."""
    liquid_w: F64
    """Heat of the servers of each rack into the coolant, in W, (L,)."""
    air_w: F64
    """Heat of each rack into the air while it has power, with its part of pipes and pumps, in W,
    (L,)."""
    junction_each_c: F64
    """Hottest junction of each rack during the step, in C, (L,); 0 without GPUs."""
    rack_m3s: F64
    """Flow of coolant of each rack at the end of the step, in m3/s, (L,)."""
    lost_utilisation: F64
    """Mean of utilisation times (1 - clock) of each rack, (L,)."""
    tripped: F64
    """1 for racks that have switched off in the step, else 0, (L,)."""


_WET_COOLER, _TOWER = REJECTION_KINDS.index("adiabatic"), REJECTION_KINDS.index("tower")


class Liquid:
    """Computes racks with coolant, their CDUs and facility loops with a kernel.

    Args:
        fleet: Racks, manifolds, CDUs and facility loops of B data centers.
        step_s: Length of a step, in s.
        transient: True if chips and loops hold heat; False for steady states.
    """

    def __init__(self, fleet: LiquidFleet, *, step_s: float, transient: bool = False) -> None:
        self.fleet, self.sizing = fleet, size_liquid(fleet)
        self._step_s, self._transient = step_s, transient
        loops, racks = len(fleet.rack_offsets) - 1, int(fleet.rack_offsets[-1])
        self._size, self._loops, self._racks = len(fleet.manifold_offsets) - 1, loops, racks
        self._cdus = int(fleet.cdu_offsets[-1])
        self._cdu_dc = fleet.manifold_dc[fleet.cdu_manifold]
        plants, cdus = fleet.plants, fleet.cdus
        self._dew_margin_k = self._per_dc(plants.dew_margin_k)
        self._approach_k = self._design_approach_k()
        self._reuse_share = self._per_dc(plants.reuse_share)
        rejection = self._per_dc(plants.rejection)
        self._pads = np.where(
            rejection == _WET_COOLER, self._per_dc(plants.adiabatic_effectiveness), 0.0
        )
        self._has_pads = bool(self._pads.any())
        self._is_tower = rejection == _TOWER
        self._trims = bool(np.any(self._per_dc(plants.trim_w) > 0.0))
        self._trim_w, self._trim_cop = self._per_dc(plants.trim_w), self._per_dc(plants.trim_cop)
        self._by_plant = self._per_dc(plants.trim_by_plant) > 0.0
        self.has_plants = bool(self._by_plant.any())
        """True if the plant of the CRAC units cools facility water in some data center."""
        cycles = self._per_dc(plants.cycles)
        self._litres_per_w = step_s / EVAPORATION_HEAT_J_PER_KG * cycles / (cycles - 1.0)
        self._income_per_w = self._per_dc(plants.heat_price_per_kwh) * (step_s / 3.6e6)
        self._cooler_approach_k = self._per_dc(plants.approach_k)
        self._size_towers()
        self._design_m3s = np.bincount(fleet.rack_manifold, self.sizing.rack_m3s, loops)
        self._usual_substeps = np.ceil(step_s / np.minimum(plants.substep_s, self._turnover_s()))
        self._initial = LiquidState(
            cdu_setpoint_c=np.broadcast_to(cdus.setpoint_c, self._cdus).astype(np.float64),
            cdu_flow=np.broadcast_to(cdus.flow, self._cdus).astype(np.float64),
            junction_c=np.full(racks, np.nan),
            manifold_return_c=np.full(loops, np.nan),
            manifold_supply_c=np.full(loops, np.nan),
            facility_return_c=np.full(self._size, np.nan),
            facility_supply_c=np.full(self._size, np.nan),
        )
        sizes = {"rack": racks, "cdu": self._cdus, "loop": loops, "dc": self._size}
        # These arrays are bound once: passing a new array costs more than copying its entries.
        self._arrays: dict[str, Any] = {
            f"{of}_{kind}": np.zeros((len(rows), sizes[of]))
            for of, kind, rows in (
                ("rack", "inputs", spec.RACK_INPUTS),
                ("rack", "state", spec.RACK_STATE),
                ("rack", "out", spec.RACK_OUT),
                ("cdu", "inputs", spec.CDU_INPUTS),
                ("cdu", "out", spec.CDU_OUT),
                ("loop", "state", spec.LOOP_STATE),
                ("loop", "out", spec.LOOP_OUT),
                ("dc", "inputs", spec.DC_INPUTS),
                ("dc", "state", spec.DC_STATE),
                ("dc", "out", spec.DC_OUT),
            )
        }
        self._inputs = {
            name: self._arrays[f"{of}_inputs"][row]
            for of, rows in (
                ("rack", spec.RACK_INPUTS),
                ("cdu", spec.CDU_INPUTS),
                ("dc", spec.DC_INPUTS),
            )
            for row, name in enumerate(rows)
        }
        self._states = {
            name: self._arrays[f"{of}_state"][row]
            for of, rows in (
                ("rack", spec.RACK_STATE),
                ("loop", spec.LOOP_STATE),
                ("dc", spec.DC_STATE),
            )
            for row, name in enumerate(rows)
        }
        out = self._arrays["dc_out"]
        out[[list(spec.DC_OUT).index("throttle_s"), list(spec.DC_OUT).index("trip_s")]] = -1.0
        for name in ("up", "pumps", "facility_pump", "cooler_share"):
            self._inputs[name][:] = 1.0
        self._inputs["substeps"][:] = self._usual_substeps
        self._inputs["trim_w"][:] = self._trim_w
        self._inputs["least_water_c"][:] = NO_LEAST_C
        self._had_failures = False
        self._arrays |= {
            "rack_coefficients": self._packed(
                spec.RACK_COEFFICIENTS, self._rack_coefficients(), racks
            ),
            "cdu_coefficients": self._packed(
                spec.CDU_COEFFICIENTS, self._cdu_coefficients(), self._cdus
            ),
            "loop_coefficients": self._packed(
                spec.LOOP_COEFFICIENTS, {"loop_j_per_k": self.sizing.loop_j_per_k}, loops
            ),
            "dc_coefficients": self._packed(
                spec.DC_COEFFICIENTS, self._dc_coefficients(), self._size
            ),
            "rack_offsets": fleet.rack_offsets.astype(np.int32),
            "cdu_offsets": fleet.cdu_offsets.astype(np.int32),
            "manifold_offsets": fleet.manifold_offsets.astype(np.int32),
        }
        self._kernel: NamedKernel | None = None

    def initial_state(self, inputs: LiquidInputs) -> LiquidState:
        """Return the state before the first step: the steady state at its inputs, uncommanded."""
        inputs = replace(inputs, cdu_setpoint_c=None, cdu_flow=None)
        state, _ = self._run(self._initial, inputs, transient=False)
        return state

    def step(
        self, state: LiquidState | State, inputs: LiquidInputs
    ) -> tuple[LiquidState, LiquidResult]:
        """Compute one step of B data centers.

        Returns:
            State after the step, and results.
        """
        return self._run(state, inputs, self._transient)

    def _run(
        self, state: LiquidState | State, inputs: LiquidInputs, transient: bool
    ) -> tuple[LiquidState, LiquidResult]:
        """Run the kernel, and a second time where its heat sets the temperature of tower water."""
        setpoint_c, flow = self._set_inputs(state, inputs)
        self._launch(state, transient)
        if self._has_towers:
            for _ in range(TOWER_PASSES):
                tower = self._tower(inputs)
                self._set_air(np.where(self._is_tower, tower.leaving_c, inputs.outdoor_c), inputs)
                self._launch(state, transient)
        return self._after(setpoint_c, flow), self._result(inputs)

    def _set_inputs(self, state: LiquidState | State, inputs: LiquidInputs) -> tuple[F64, F64]:
        """Write the inputs of a step; return setpoints in C and flows of the CDUs, (C,) each."""
        rows = self._inputs
        setpoint_c, flow = state.cdu_setpoint_c, state.cdu_flow
        if inputs.cdu_setpoint_c is not None:
            low_c, high_c = setpoint_c - SETPOINT_STEP_K, setpoint_c + SETPOINT_STEP_K
            setpoint_c = np.clip(inputs.cdu_setpoint_c, low_c, high_c)
        if inputs.cdu_flow is not None:
            flow = inputs.cdu_flow
        rows["setpoint_c"][:], rows["flow"][:] = setpoint_c, flow
        rows["utilisation"][:], rows["powered"][:] = inputs.utilisation, inputs.powered
        np.greater(inputs.powered, 0.0, out=rows["open"])
        rows["least_setpoint_c"][:] = inputs.dew_point_c + self._dew_margin_k
        wanted_k, share, cap = inputs.facility_approach_k, inputs.reuse_share, inputs.power_cap
        rows["approach_k"][:] = self._approach_k if wanted_k is None else wanted_k
        rows["reuse_share"][:] = self._reuse_share if share is None else share
        rows["power_cap"][:] = 1.0 if cap is None else cap
        air_c = inputs.outdoor_c
        if self._has_towers:
            air_c = np.where(self._is_tower, inputs.wet_bulb_c + TOWER_APPROACH_K, air_c)
        self._set_air(air_c, inputs)
        if self.has_plants:
            self._set_plant(inputs)
        self._set_failures(inputs)
        return setpoint_c, flow

    def _set_plant(self, inputs: LiquidInputs) -> None:
        """Write what the plant of the CRAC units can do for facility water."""
        share, water_c = inputs.plant_share, inputs.chilled_water_c
        by_plant = self._trim_w if share is None else self._trim_w * share
        self._inputs["trim_w"][:] = np.where(self._by_plant, by_plant, self._trim_w)
        least_c = NO_LEAST_C if water_c is None else water_c + PLANT_APPROACH_K
        self._inputs["least_water_c"][:] = np.where(self._by_plant, least_c, NO_LEAST_C)

    def _set_air(self, air_c: F64, inputs: LiquidInputs) -> None:
        """Write the temperature of the air or tower water that cools, without and with pads."""
        dry_c, wet_c = self._inputs["dry_c"], self._inputs["wet_c"]
        dry_c[:] = air_c
        wet_c[:] = air_c
        if self._has_pads:
            wet_c -= self._pads * (air_c - inputs.wet_bulb_c)

    def _set_failures(self, inputs: LiquidInputs) -> None:
        """Write failures, and the substeps that they need."""
        rows = self._inputs
        failures = {
            "up": inputs.cdu_up,
            "pumps": inputs.cdu_pumps,
            "facility_pump": inputs.facility_pump,
            "cooler_share": inputs.cooler_share,
        }
        fails = inputs.rack_valve is not None or any(x is not None for x in failures.values())
        if not fails and not self._had_failures:
            return
        self._had_failures = fails
        for name, values in failures.items():
            rows[name][:] = 1.0 if values is None else values
        substeps = rows["substeps"]
        substeps[:] = self._usual_substeps
        has_failure = (rows["cooler_share"] < 1.0) | (rows["facility_pump"] < 1.0)
        if inputs.rack_valve is not None:
            shut = inputs.rack_valve <= 0.0
            rows["open"] *= inputs.rack_valve
            rows["powered"][shut & self.fleet.has_plates] = 0.0
            has_failure[self.fleet.manifold_dc[self.fleet.rack_manifold[shut]]] = True
        loop = self.fleet.cdu_manifold[(rows["up"] < 1.0) | (rows["pumps"] < 1.0)]
        has_failure[self.fleet.manifold_dc[loop]] = True
        at_least = np.ceil(self._step_s / FAILURE_SUBSTEP_S)
        np.maximum(substeps, np.where(has_failure, at_least, 0.0), out=substeps)
        loop = self.fleet.cdu_manifold
        left_m3s = rows["up"] * rows["pumps"] * self.sizing.cdu_m3s
        few = np.bincount(loop, left_m3s, self._loops) < LEAST_FLOW * self._design_m3s
        short_of_flow = rows["facility_pump"] <= 0.0
        short_of_flow[self.fleet.manifold_dc[few]] = True
        at_least = np.ceil(self._step_s / PUMP_FAILURE_SUBSTEP_S)
        np.maximum(substeps, np.where(short_of_flow, at_least, 0.0), out=substeps)

    def _launch(self, state: LiquidState | State, transient: bool) -> None:
        """Run the kernel from a state."""
        if transient:
            rows = self._states
            rows["junction_c"][:] = state.junction_c
            rows["return_c"][:] = state.manifold_return_c
            rows["supply_c"][:] = state.manifold_supply_c
            rows["water_return_c"][:] = state.facility_return_c
            rows["water_supply_c"][:] = state.facility_supply_c
        if self._kernel is None:
            self._kernel = self._bound_kernel()
        most = SERIAL_RACKS_TRANSIENT if transient else SERIAL_RACKS
        self._kernel(transient=transient, serial=self._racks <= most)

    def _bound_kernel(self) -> NamedKernel:
        """Return the kernel with all arrays bound."""
        from sdc_taichi.kernels.compiler.named_kernel import NamedKernel
        from sdc_taichi.kernels.liquid import liquid_kernel

        threads = runtime.ensure_started()
        kernel = NamedKernel(liquid_kernel(), spec.ARGUMENTS)
        kernel.bind(
            slices=min(self._size, SLICES_PER_THREAD * threads),
            one=1,
            step_s=float(self._step_s),
            most_sweeps=MOST_SWEEPS,
            **self._arrays,
        )
        return kernel

    def _tower(self, inputs: LiquidInputs) -> TowerResult:
        """Compute the towers for the heat of the last run of the kernel."""
        out = self._rows_out("dc", spec.DC_OUT)
        share = self._inputs["cooler_share"]
        return yorkcalc(
            out["cooler_w"],
            TowerPoint(
                wet_bulb_c=inputs.wet_bulb_c,
                outdoor_c=inputs.outdoor_c,
                condenser_setpoint_c=out["facility_setpoint_c"] - self._cooler_approach_k,
                supply_setpoint_c=out["facility_setpoint_c"],
                water_kg_s=self._tower_kg_s,
                reference_water_kg_s=self._tower_reference_kg_s * np.maximum(share, 1e-3),
                reference_air_m3s=np.ones(self._size),
                design_fan_w=self.sizing.fan_w * share,
                air_j_per_m3_k=1.0,
                cells_water_kg_s=self._tower_kg_s * np.maximum(share, 1e-3),
            ),
        )

    def _rows_out(self, of: str, rows: Mapping[str, str], end: str = "") -> dict[str, F64]:
        """Return a copy of results of the kernel by name, without ``end`` and those behind it."""
        names = [*rows]
        names = names[: names.index(end)] if end else names
        copy = self._arrays[f"{of}_out"][: len(names)].copy()
        return dict(zip(names, copy, strict=True))

    def _after(self, setpoint_c: F64, flow: F64) -> LiquidState:
        """Return the state after a step."""
        racks, loops, dcs = (self._arrays[f"{of}_state"].copy() for of in ("rack", "loop", "dc"))
        return LiquidState(setpoint_c.copy(), flow.copy(), racks[0], *loops, *dcs)

    def _result(self, inputs: LiquidInputs) -> LiquidResult:
        """Return the results of a step."""
        dc = self._rows_out("dc", spec.DC_OUT)
        cdu = self._rows_out("cdu", spec.CDU_OUT, end="k_w_per_k")
        rack = self._rows_out("rack", spec.RACK_OUT, end="runs")
        states = self._arrays["dc_state"].copy()
        fan_w, evaporated_w = dc["cooler_fan_w"], dc["evaporated_w"]
        if self._has_towers:
            fan_w = np.where(self._is_tower, self._tower(inputs).fan_w, fan_w)
            evaporated_w = np.where(self._is_tower, np.maximum(dc["cooler_w"], 0.0), evaporated_w)
        chiller_w = np.zeros(self._size)
        trim_load_w, to_plant_w = dc["trim_load_w"], np.zeros(self._size)
        if self.has_plants:
            to_plant_w = np.where(self._by_plant, trim_load_w, 0.0)
            trim_load_w = trim_load_w - to_plant_w
        if self._trims and trim_load_w.any():
            chiller_w = self._trim_chiller_w(trim_load_w, dc["facility_setpoint_c"], inputs)
        reuse_w = dc["taken_w"] + dc["heat_pump_w"]
        return LiquidResult(
            liquid_it_w=dc["it_w"],
            liquid_heat_w=dc["liquid_heat_w"],
            liquid_air_w=dc["liquid_air_w"],
            junction_max_c=dc["junction_max_c"],
            cdu_supply_c=dc["cdu_supply_c"],
            cdu_return_c=dc["cdu_return_c"],
            facility_supply_c=states[1],
            facility_return_c=states[0],
            facility_setpoint_c=dc["facility_setpoint_c"],
            coolant_m3s=self._of_cdus(cdu["m3s"]),
            facility_m3s=self._of_cdus(cdu["valve"] * self.sizing.cdu_water_m3s),
            cdu_pump_w=dc["cdu_pump_w"],
            facility_pump_w=dc["facility_pump_w"],
            cooler_fan_w=fan_w,
            trim_chiller_w=chiller_w,
            trim_load_w=trim_load_w,
            heat_pump_w=dc["heat_pump_w"],
            reuse_w=reuse_w,
            liquid_rejected_w=dc["cooler_w"] + trim_load_w + chiller_w,
            liquid_to_plant_w=to_plant_w,
            liquid_stored_w=dc["stored_w"],
            cooler_water_l=evaporated_w * self._litres_per_w,
            leak_l=np.zeros(self._size) if inputs.leak_l is None else inputs.leak_l,
            heat_income=self._income_per_w * reuse_w,
            throttle_s=dc["throttle_s"],
            trip_s=dc["trip_s"],
            cdu_supply_each_c=cdu["supply_c"],
            cdu_flow_m3s=cdu["m3s"],
            cdu_heat_w=cdu["heat_w"],
            cdu_valve=cdu["valve"],
            it_w=rack["it_w"],
            liquid_w=rack["liquid_w"],
            air_w=rack["air_w"],
            junction_each_c=rack["junction_max_c"],
            rack_m3s=rack["m3s"],
            lost_utilisation=rack["lost_utilisation"],
            tripped=rack["tripped"],
        )

    def _trim_chiller_w(self, load_w: F64, water_c: F64, inputs: LiquidInputs) -> F64:
        """Return the power of the trim chillers, whose condensers stand in outdoor air, in W."""
        point = ChillerPoint(
            reference_w=self._trim_w,
            chilled_water_c=water_c,
            condenser_c=inputs.outdoor_c + self._cooler_approach_k,
            outdoor_c=inputs.outdoor_c,
            machine=ChillerParameters(CHILLERS["carnot"].reference_cop),
        )
        by_cop_w = load_w / np.where(np.isnan(self._trim_cop), 1.0, self._trim_cop)
        by_model_w = carnot(load_w, point).power_w
        return np.where(np.isnan(self._trim_cop), by_model_w, by_cop_w)

    @property
    def air_w(self) -> F64:
        """Heat of each rack into the air in the last step, as in ``LiquidResult``, in W, (L,)."""
        return np.asarray(self._arrays["rack_out"][[*spec.RACK_OUT].index("air_w")])

    @property
    def junction_c(self) -> F64:
        """Junction temperature of each rack at the end of the last step, in C, (L,)."""
        return np.asarray(self._arrays["rack_state"][0])

    def values_of_rack(self, rack: int) -> dict[str, float]:
        """Return what decides the junction of a rack at the end of the last step, by name.

        Coefficients, inputs and results have the names of ``kernels/liquid_arguments.py``. Besides,
        ``cdus`` and ``cdus_up`` are the numbers of all and of running CDUs of its manifold, and
        ``valve`` is the mean opening of their valves.

        Args:
            rack: Index of the rack among all racks with coolant.
        """
        loop = self.fleet.rack_manifold[rack]
        coefficients = {
            name: np.broadcast_to(values, self._racks)[rack]
            for name, values in self._rack_coefficients().items()
        }
        parts = (
            ("rack", "inputs", spec.RACK_INPUTS, rack),
            ("rack", "out", spec.RACK_OUT, rack),
            ("rack", "state", spec.RACK_STATE, rack),
            ("loop", "out", ("w_per_k", "wanted_c"), loop),
            ("loop", "state", spec.LOOP_STATE, loop),
            ("dc", "state", spec.DC_STATE, self.fleet.manifold_dc[loop]),
        )
        values = dict(coefficients)
        for of, kind, names, index in parts:
            values |= dict(zip(names, self._arrays[f"{of}_{kind}"][:, index], strict=False))
        cdus = slice(*self.fleet.cdu_offsets[loop : loop + 2])
        up = self._inputs["up"][cdus]
        valve = dict(zip(spec.CDU_OUT, self._arrays["cdu_out"], strict=True))["valve"][cdus]
        values |= {"cdus": len(up), "cdus_up": up.sum(), "valve": valve.mean()}
        return {name: float(value) for name, value in values.items()}

    def close(self) -> None:
        """Release the kernel and its arrays."""
        self._kernel = None

    def _of_cdus(self, values: F64) -> F64:
        """Return the sum of values of the CDUs of each data center, (B,)."""
        return np.bincount(self._cdu_dc, values, self._size).astype(np.float64)

    def _per_dc(self, values: Values) -> F64:
        return np.broadcast_to(values, self._size).astype(np.float64)

    def _design_approach_k(self) -> F64:
        """Return the approach of the first CDU of each data center, in K, (B,)."""
        of_cdus_k = np.broadcast_to(self.fleet.cdus.approach_k, self._cdus)
        first = self.fleet.cdu_offsets[self.fleet.manifold_offsets[:-1]]
        return of_cdus_k[np.minimum(first, self._cdus - 1)].astype(np.float64)

    def _turnover_s(self) -> F64:
        """Return the time in which the smallest loop of each data center turns over, in s, (B,).

        Longer substeps would make the explicit parts of a step unstable. Rear doors, whose heat
        falls with the temperature of the coolant, count as flow.
        """
        racks, sizes, loops = self.fleet.racks, self.sizing, self._loops
        dc = self.fleet.manifold_dc
        plants = self.fleet.plants
        j_per_m3_k = self._per_dc(plants.density_kg_m3 * plants.heat_capacity_j_per_kg_k)
        doors = racks.door_effectiveness * racks.other_max_w / racks.door_rise_k
        of_doors = np.broadcast_to(doors, self._racks)
        rate = MOST_FLOW * self._design_m3s * j_per_m3_k[dc]
        rate += np.bincount(self.fleet.rack_manifold, of_doors, loops)
        least_s = np.full(self._size, np.inf)
        np.minimum.at(least_s, dc, sizes.loop_j_per_k / rate)
        most_valve = np.broadcast_to(self.fleet.cdus.max_valve, self._cdus).max()
        water = most_valve * np.maximum(sizes.water_w_per_k, 1e-9)
        water_s = np.where(sizes.water_w_per_k > 0.0, sizes.water_j_per_k / water, np.inf)
        return np.asarray(np.minimum(least_s, water_s))

    def _size_towers(self) -> None:
        """Size towers; the water of a tower has the capacity rate of the facility water."""
        self._has_towers = bool(self._is_tower.any())
        if not self._has_towers:
            return
        kg_s = np.maximum(self.sizing.water_w_per_k / WATER_J_PER_KG_K, 1e-3)
        range_k = self.sizing.heat_w / (kg_s * WATER_J_PER_KG_K)
        self._tower_kg_s = kg_s
        self._tower_reference_kg_s = yorkcalc_reference_water_kg_s(
            kg_s, wet_bulb_c=TOWER_WET_BULB_C, range_k=range_k, approach_k=TOWER_APPROACH_K
        )

    @staticmethod
    def _packed(rows: Mapping[str, str], values: Mapping[str, Values], count: int) -> F64:
        """Return coefficients with those of an item next to each other."""
        of_rows = [np.broadcast_to(x, count) for x in in_row_order(rows, values)]
        return np.ascontiguousarray(np.stack(of_rows, axis=-1), dtype=np.float64).reshape(-1)

    def _rack_coefficients(self) -> dict[str, Values]:
        p = self.fleet.racks
        gpus = np.asarray(p.gpus, dtype=np.float64)
        return {
            "gpus": gpus,
            "gpu_idle_w": p.gpu_idle_w,
            "gpu_span_w": np.subtract(p.gpu_max_w, p.gpu_idle_w),
            "gpu_max_w": p.gpu_max_w,
            "cpus_idle_w": np.multiply(p.cpus, p.cpu_idle_w),
            "cpus_span_w": p.cpus * np.subtract(p.cpu_max_w, p.cpu_idle_w),
            "other_idle_w": p.other_idle_w,
            "other_span_w": np.subtract(p.other_max_w, p.other_idle_w),
            "capture_chip": np.maximum(p.capture_chip, LEAST_CAPTURE),
            "capture_other": p.capture_other,
            "leak_per_k": p.leak_per_k,
            "leak_ref_c": p.leak_ref_c,
            "r_fixed_k_per_w": np.maximum(np.add(p.r_jc_k_per_w, p.r0_k_per_w), LEAST_K_PER_W),
            "r_film_k_m3s_per_w": p.a_k_lpm_per_w * M3S_PER_LPM * gpus / p.chip_flow_share,
            "throttle_c": p.throttle_c,
            "trip_c": p.trip_c,
            "trip_flow": np.where(self.fleet.has_plates, p.trip_flow_share, 0.0),
            "design_m3s": self.sizing.rack_m3s,
            "loss_w_per_k": np.maximum(p.loss_w_per_k, LEAST_LOSS_W_PER_K),
            "chips_j_per_k": gpus * p.chip_j_per_k,
            "stagnant_w_per_k": gpus * p.stagnant_w_per_k,
            "door_effectiveness": p.door_effectiveness,
            "per_door_rise": np.divide(1.0, p.door_rise_k),
        }

    def _cdu_coefficients(self) -> dict[str, Values]:
        p, sizes = self.fleet.cdus, self.sizing
        coefficients: dict[str, Values] = {
            "design_m3s": sizes.cdu_m3s,
            "ua_w_per_k": sizes.cdu_ua_w_per_k,
            "design_w_per_k": sizes.cdu_w_per_k,
            "wall_share": p.wall_share,
            "side_share": p.side_share,
            "min_valve": p.min_valve,
            "max_valve": p.max_valve,
            "pump_w": sizes.cdu_pump_w,
            "fluid_share": p.fluid_share,
        }
        loop = self.fleet.cdu_manifold
        each = np.array([np.broadcast_to(x, self._cdus) for x in coefficients.values()])
        differs = (each != each[:, self.fleet.cdu_offsets[loop]]).any(axis=0)
        return coefficients | {"alike": np.bincount(loop, differs, self._loops)[loop] == 0.0}

    def _dc_coefficients(self) -> dict[str, Values]:
        p, sizes = self.fleet.plants, self.sizing
        sink_c = 0.5 * np.add(p.network_return_c, p.network_supply_c) + p.pinch_k
        return {
            "j_per_m3_k": np.multiply(p.density_kg_m3, p.heat_capacity_j_per_kg_k),
            "room_c": p.room_c,
            "water_w_per_k": np.maximum(sizes.water_w_per_k, 1e-9),
            "water_j_per_k": sizes.water_j_per_k,
            "design_pump_w": sizes.facility_pump_w,
            "facility_fluid_share": p.pump_fluid_share,
            "min_pump": p.min_pump,
            "cooler_ua_w_per_k": sizes.cooler_ua_w_per_k,
            "cooler_air_w_per_k": sizes.water_w_per_k,
            "cooler_wall_share": COOLER_WALL_SHARE,
            "cooler_side_share": COOLER_SIDE_SHARE,
            "fan_w": np.where(self._is_tower, 0.0, sizes.fan_w),
            # The pumps of towers keep the flow through the exchanger.
            "min_fan": np.where(self._is_tower, 1.0, p.min_fan),
            "reuse_kind": p.reuse_kind,
            "reuse_demand_w": p.reuse_demand_w,
            "reuse_effectiveness": p.reuse_effectiveness,
            "network_return_c": p.network_return_c,
            "sink_c": sink_c,
            "lorenz_k": p.lorenz * (sink_c + KELVIN),
            "pinch_k": p.pinch_k,
        }
