"""Solver of a fleet's halls: run the hall kernels from supply air and load to temperatures."""

from __future__ import annotations

from dataclasses import fields
from itertools import product
from math import isfinite
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sdc_taichi.errors import PhysicalLimitError, RuntimeStateError, SdcError
from sdc_taichi.hall.initial_guess import TABLE_LOADS, USUAL_GAIN
from sdc_taichi.hall.mix_weights import items_of_ranges
from sdc_taichi.hall.steady_modes import SteadyModes, extended_modes
from sdc_taichi.kernels.arguments import in_row_order, row_index
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.kernels.hall_arguments import (
    COVERED_WITHIN,
    DC_COEFFICIENTS,
    DC_CONTROL,
    DC_DOUBLES,
    DC_OUT,
    DONE,
    GROUP_INPUTS,
    LANES,
    LAYERS_ARGUMENTS,
    LOADS_PER_DC,
    LOADS_PER_GROUP,
    LOADS_PER_RACK,
    MODE_VECTORS,
    MOST_SUPPLY_RATIO,
    NOT_CONVERGED,
    OUTLETS,
    RACK_OUT,
    RUNNING,
    STEP_ARGUMENTS,
)
from sdc_taichi.sim.fleet import NO_LIMIT_W, Fleet, HallAir
from sdc_taichi.sim.hall_state import ChilledWater, Coil, Conditions, HallState, HallSums, Precision
from sdc_taichi.sim.hall_tables import (
    build_hall_tables,
    build_rows_along_racks,
    build_steady_states,
    vectors,
)
from sdc_taichi.sim.inlet_parts import IntakeAir, read_intake_air
from sdc_taichi.sim.physical_limits import BEYOND_NUMBERS_C, no_number_error, no_steady_air_error
from sdc_taichi.sim.sampled_halls import (
    LEVELS,
    SUPPLY_SHARES,
    sampled_fleet,
    sparse_halls,
    supply_range_c,
)
from sdc_taichi.types import F64, I32, Reals, ServerLayers

_FIRST_CONTROL = [
    np.array(
        in_row_order(
            DC_CONTROL,
            {
                "status": RUNNING,
                "exchanges_before": exchanges_before,
                # There are two exhaust buffers: a sweep reads what the sweep before it wrote.
                "exhaust_side": exchanges_before,
                "sweep": 0,
                "elapsed": 0,
                "length": 1,
                "chunks_done": 0,
            },
        ),
        np.int32,
    )[:, None]
    for exchanges_before in (0, 1)
]
"""Rows ``DC_CONTROL`` at the start of a step, (rows, 1), by the value of ``exchanges_before``."""
_SHIFTS = slice(row_index(DC_DOUBLES, "shift_k"), row_index(DC_DOUBLES, "last_shift_k") + 1)
"""Rows of ``DC_DOUBLES`` that are 0 at the start of a step."""


SERIAL_GROUPS = 8192
"""Problem size up to which a kernel runs on one thread, because waking another thread would take
longer: group entries times substeps for steps, servers for layers."""
SLICES_PER_THREAD = 8
"""Number of work slices per thread; several slices balance the load of the threads."""
TOLERANCE_K: dict[Precision, float] = {"f32": 2e-4, "f64": 1e-12}
"""Convergence tolerance in K: change of the exhaust mix before any rack by a further sweep."""
MOST_CHANGE_K = 0.5
"""Change of the air in a substep, in K, above which a step is repeated with shorter substeps."""
MOST_LENGTHENED = 4
"""Longest substep of a step with abrupt changes, divided by its shortest substep."""
SAMPLE_TOLERANCE_K: dict[Precision, float] = {"f32": 5e-5, "f64": 1e-8}
"""Convergence tolerance of sampled racks in K, small enough that large halls rarely need a second
sweep for it."""
SAMPLE_SWEEPS = 20
"""Largest number of sweeps of sampled racks; without success large halls start from the supply
temperature."""
EVEN_WITHIN = 1e-9
"""Largest difference of load, power or airflow between racks that work alike."""
MOST_SWEEPS = 2000
"""Maximum number of sweeps. Steady states take 2 to 40 sweeps, and several hundred if the CRAC
units supply a tenth of the airflow of the servers."""


_Rows = dict[str, Any]
"""Values of named rows of the kernel's arrays."""
RESULT_NAMES = (*DC_OUT, *(f"rack_{name}" for name in RACK_OUT))
"""Fields of ``HallSums`` that the kernel writes, in the order of its rows."""
_OUTLET_MAX_ROW = [*RACK_OUT].index("outlet_max_c")


class Hall:
    """Computes temperatures and power of all halls of a fleet, steady or in transient substeps.

    The object owns the arrays of the kernels.

    Args:
        fleet: The data centers.
        precision: Precision of the temperatures and powers of servers and racks.
        samples: True if large halls start from sampled racks. False saves the preparation if few
            steps are solved.
        serial_groups: Problem size up to which kernels run on one thread, see ``SERIAL_GROUPS``.
            Solvers on one thread and on several do not share a compiled kernel.
    """

    def __init__(
        self,
        fleet: Fleet,
        precision: Precision,
        *,
        samples: bool = True,
        serial_groups: int = SERIAL_GROUPS,
    ) -> None:
        threads = runtime.ensure_started()
        from sdc_taichi.kernels import hall, layers
        from sdc_taichi.kernels.compiler.named_kernel import NamedKernel

        self._dtype = np.dtype(np.float32 if precision == "f32" else np.float64)
        self._fleet = fleet
        self._shapes = _condition_shapes(fleet)
        self._recirculates = fleet.air is not None
        self._no_flow_m3s = np.zeros(fleet.size)
        self._no_stored_heat = dict.fromkeys(
            ("room_j", "water_j", "tank_j", "water_warmed_k", "most_warmed_k"), np.zeros(fleet.size)
        )
        tables = build_hall_tables(fleet, self._dtype, SLICES_PER_THREAD * threads)
        self._tables, self._places = tables, tables.places
        self._rack, self._unit = tables.rows("rack_inputs"), tables.rows("unit_inputs")
        self._dc, self._unit_state = tables.rows("dc_doubles"), tables.rows("unit_state")
        self._control, self._memory = tables.rows("dc_control"), tables.rows("rack_state")
        self._is_rack = self._rack["powered"].copy()
        fresh_share = fleet.dcs[row_index(DC_COEFFICIENTS, "fresh_share")]
        self._fresh_m3s = fresh_share[fleet.unit_dc] * fleet.unit_design_m3s
        self._overridden_rows: set[str] = set()
        """Names of the rows (``powered``, ``fan_airflow``, ``exhaust_share``) that the last step
        set to values other than those of racks that all work alike."""
        self._even_exhaust_share = self._rack["exhaust_share"].copy()
        self._group_parts: F64 | None = None
        """Part of each group in the airflow of its rack, (G,); None before its first use."""

        self._step_kernel = NamedKernel(hall.hall_kernel(precision), STEP_ARGUMENTS)
        self._layers_kernel = NamedKernel(layers.layers_kernel(precision), LAYERS_ARGUMENTS)
        constant = tables.arrays | {
            "recirculates": self._recirculates,
            "own_return": bool(fleet.own_return.any()),
            "fan_knees": tables.fan_knees,
            "cpu_knees": tables.cpu_knees,
            "slices": tables.slices,
            "one": 1,
            "outlet_model": OUTLETS.index(fleet.models["outlet"]),
            "load_columns": len(TABLE_LOADS),
            "tolerance_k": TOLERANCE_K[precision],
        }
        kernels = self._step_kernel, self._layers_kernel
        for kernel, names in zip(kernels, (STEP_ARGUMENTS, LAYERS_ARGUMENTS), strict=True):
            kernel.bind(**{name: value for name, value in constant.items() if name in names})

        self._none = np.zeros(1, self._dtype)
        self._load_level, self._group_load = LOADS_PER_DC, self._none
        self._no_vectors = vectors(self._dtype, 1)
        self._server_c = self._no_vectors
        self._rack_out = tables.arrays["rack_out"]
        self._returns_buffers = (
            self._places.count == fleet.racks and fleet.models["outlet"] == "server"
        )
        """True if the racks' results are returned without a copy. With an outlet model other than
        ``server``, the layers kernel reads these results again, so callers must get a copy."""
        self._group_rows = len(tables.arrays["group_inputs"])
        """Number of group inputs whose lanes are racks."""
        self._has_rows_along_racks = False
        self.hottest_outlet_c = 0.0
        """Highest server outlet temperature of all halls in the last step, in C."""
        self.flags_limits = False
        """True if halls without steady air, or with infinite temperatures, are entered into
        ``beyond_limits`` instead of raising an error."""
        self.beyond_limits: npt.NDArray[np.bool_] | None = None
        """True for data centers without steady air or with infinite temperatures in the last step,
        (B,); None if there are none."""
        self._was_transient: bool | None = None
        """True if the last step was transient; None if there is no last step."""
        self._group_layers: tuple[ServerLayers, dict[str, Any]] | None = None
        """Buffers of ``groups`` and the same as kernel arguments; None before its first call."""
        self._dc["feedback_gain"][:] = USUAL_GAIN
        self._dc["liquid_heat"][:] = 1.0
        tasks = np.diff(tables.arrays["task_offsets"])
        self._weighs_apart = len(tasks) > fleet.size and bool(np.any(fleet.plenum_coupling > 0))
        """True if a call of its own weighs the CRAC units of data centers that are split."""
        self._sparse_dcs = sparse_halls(fleet)
        self._serial_groups = serial_groups
        self._sample: Hall | None = None
        """Sampled racks of the data centers ``_sparse_dcs``; None if there are none."""
        if samples and len(self._sparse_dcs):
            self._add_sampled_racks(precision)

    def take_heat_of(self, racks: npt.NDArray[np.integer]) -> None:
        """Let the heat of some racks be an input of each step, see ``set_heat``.

        Args:
            racks: Indices of the liquid-cooled racks. The servers of each are equal.
        """
        fleet, arrays = self._fleet, self._tables.arrays
        first, counts = fleet.group_offsets[racks], np.diff(fleet.group_offsets)[racks]
        in_rack, groups = items_of_ranges(first, counts)
        rows = np.concatenate(fleet.group_rows, axis=1)[:, groups]
        count, full_w = (rows[row_index(GROUP_INPUTS, name)] for name in ("count", "full_w"))
        of_rack_w = np.bincount(in_rack, count * full_w)
        self._heat_share = full_w[np.cumsum(counts) - counts] / of_rack_w
        self._heat_dc = fleet.rack_dc[racks].astype(np.intp)
        self._full_heat_w = np.maximum(np.bincount(self._heat_dc, of_rack_w, fleet.size), 1e-30)
        self._heat_places = self._places.of_racks[racks]
        block, of_blocks = self._heat_places // LANES, self._tables.rows("block_ints")
        in_rack, entries = items_of_ranges(
            of_blocks["first_row"][block], of_blocks["groups"][block]
        )
        inputs = arrays["group_inputs"].reshape(-1, len(GROUP_INPUTS), LANES)
        places = self._heat_places[in_rack]
        full, idle = (row_index(GROUP_INPUTS, name) for name in ("full_w", "idle_w"))
        self._rack["heat_w"][places] = inputs[entries, idle, places % LANES]
        for row in (full, idle):
            inputs[entries, row, places % LANES] = 0.0
        # Layers read copies of the group inputs.
        self._has_rows_along_racks = False

    def set_heat(self, rack_w: F64) -> None:
        """Set the heat of the racks of ``take_heat_of`` while they are on, without fans."""
        self._rack["heat_w"][self._heat_places] = self._heat_share * rack_w
        of_dc_w = np.bincount(self._heat_dc, rack_w, self._fleet.size)
        self._dc["liquid_heat"][:] = of_dc_w / self._full_heat_w

    @property
    def sweeps(self) -> I32:
        """Number of sweeps or substeps of each data center in the last step, (B,)."""
        return np.array(self._control["sweep"])

    def solve(self, conditions: Conditions) -> HallSums:
        """Compute quasi-steady temperatures and power.

        Args:
            conditions: Supply air, load and failures.

        Raises:
            PhysicalLimitError: There is no steady state, for example because no unit moves air, and
                ``flags_limits`` is False.
            SdcError: A condition is not finite or has the wrong shape.
        """
        self._begin_steady_step(conditions)
        dc_out = self._new_results()
        self.beyond_limits = None
        if not self._recirculates:
            self._call_step_kernel(dc_out)
        else:
            if self._sample is not None:
                self._solve_sampled_racks(self._sample, conditions)
            self._run_sweeps(dc_out, MOST_SWEEPS)
            status = self._control["status"]
            if np.minimum.reduce(status) == NOT_CONVERGED:
                if not self.flags_limits:
                    raise self._no_steady_air_error(int(np.argmin(status)))
                self.beyond_limits = status == NOT_CONVERGED
        return self._results(dc_out, transient=False)

    def advance(
        self,
        conditions: Conditions,
        state: HallState,
        coil: Coil,
        step_s: float,
        substep_s: float,
        *,
        shortest_s: float | None = None,
    ) -> tuple[HallSums, HallState]:
        """Advance transient halls by one step, in substeps of at most ``substep_s``.

        Exhausts act on the racks one substep later, so abrupt changes need short substeps. A data
        center whose air changes by more than ``MOST_CHANGE_K`` in one of equal substeps
        (``change_of_air`` of the kernels) repeats the step with substeps that are shorter by this
        ratio. If this calls for the shortest, the step begins with those, and they become longer
        where the air changes less.

        Args:
            conditions: Load and failures; the supply temperature follows from ``coil``.
            state: Thermal state at the start of the step.
            coil: Setpoints, heat stored in the room, and the limit of the plant.
            step_s: Length of the step, in s.
            substep_s: Maximum length of a substep, in s.
            shortest_s: Maximum length of the shortest substep of a repeated step, in s; None
                repeats no step.

        Returns:
            Means over the step, and the thermal state at its end.
        """
        self._set_conditions(conditions)
        dc_out = self._new_results()
        self.beyond_limits = None
        start = self._start_of_step(state, coil)
        before = np.ascontiguousarray(state.server_c, self._dtype)
        after = np.empty(self._fleet.groups, self._dtype)

        def advance(
            chosen: npt.NDArray[np.bool_], substeps: int, longest: int, abandoned_above_k: float
        ) -> None:
            self._write_start(start, chosen)
            self._begin_step(exchanges_before=1, chosen=chosen)
            self._run_sweeps(
                dc_out,
                substeps,
                transient=True,
                longest=longest,
                substep_s=step_s / substeps,
                weight=1.0 / substeps,
                abandoned_above_k=abandoned_above_k,
                server_c_before=before,
                server_c_after=after,
            )

        def count(length_s: float) -> int:
            return int(np.ceil(step_s / length_s - 1e-9))

        substeps, every_dc = count(substep_s), np.ones(self._fleet.size, np.bool_)
        most = substeps if shortest_s is None else count(shortest_s)
        if most <= substeps:
            advance(every_dc, substeps, 1, np.inf)
            return self._results(dc_out, transient=True), self._hall_state(after)
        # A step that will be repeated with the shortest substeps need not be finished.
        advance(every_dc, substeps, 1, MOST_CHANGE_K * (np.ceil(most / substeps) - 1.0))
        ratio = np.ceil(self._dc["most_change_k"] / MOST_CHANGE_K)
        # Halls whose temperatures are not numbers are beyond all limits.
        needed = np.nan_to_num(np.minimum(substeps * ratio, most))
        for finer in np.unique(needed[needed > substeps]).tolist():
            # Only part of a step needs the shortest substeps.
            longest = min(most // substeps, MOST_LENGTHENED) if finer == most else 1
            advance(needed == finer, int(finer), longest, np.inf)
        return self._results(dc_out, transient=True), self._hall_state(after)

    def steady_state(self, conditions: Conditions) -> HallState:
        """Return the thermal state of transient halls in equilibrium with constant conditions."""
        self.solve(conditions)
        plant = ("coil_limit_w", "limit_w_per_k", "limit_w_per_w")
        for name in ("room_j", *plant, "water_j", "tank_j", *_water_rows(None)):
            self._dc[name][:] = 0.0
        self._dc["room_j_per_k"][:] = 1.0
        server_c = np.zeros(self._fleet.groups, self._dtype)
        # One very long substep brings the servers to their steady temperatures. It also changes
        # the air, which is already steady and is therefore restored afterwards.
        air = [self._memory["mixed_c"], self._dc["return_c"]]
        air += [self._unit_state[name] for name in ("fresh_ratio", "supply_c", "excess_k")]
        for name in ("coil_c", "casing_c"):
            self._unit_state[name][:] = self._unit_state["supply_c"]
        steady = [row.copy() for row in air]
        strength = self._unit_state["strength"]
        drawn_ratio = self._tables.plenum.drawn_ratio_at(strength)
        for name in ("need_m3s", "plain_m3s"):
            self._unit_state[name][:] /= drawn_ratio
        for row in (strength, self._unit_state["drawn_ratio"]):
            row[:] = 1.0
        self._memory["exhaust_c"][:] = self._exhaust()
        self._begin_step(exchanges_before=1)
        self._run_sweeps(
            self._new_results(),
            1,
            transient=True,
            substep_s=1e9,
            server_c_before=server_c,
            server_c_after=server_c,
        )
        for row, values in zip(air, steady, strict=True):
            row[:] = values
        self._unit_state["casing_c"][:] = self._unit_state["supply_c"]
        self.discard_last_step()
        state = self._hall_state(server_c)
        return state if self.beyond_limits is None else self._at_supply(state, conditions)

    def _at_supply(self, state: HallState, conditions: Conditions) -> HallState:
        """Set all temperatures of data centers beyond their limits to that of their supply air."""
        fleet = self._fleet
        mean_c = fleet.unit_sums(conditions.unit_supply_c) / np.diff(fleet.unit_offsets)
        rack_c = mean_c[fleet.rack_dc]
        assert self.beyond_limits is not None
        racks, units = self.beyond_limits[fleet.rack_dc], self.beyond_limits[fleet.unit_dc]
        groups = np.diff(fleet.group_offsets)
        per_strength = self._places.values_of_racks(self._rack["per_strength"][None])[0]
        strength = np.divide(1.0, per_strength, out=np.zeros(fleet.racks), where=per_strength > 0)
        new = {
            "server_c": (np.repeat(racks, groups), np.repeat(rack_c, groups)),
            "mixed_c": (racks, rack_c),
            "exhaust_c": (racks, rack_c * strength),
            "captured_m3s": (racks, 0.0),
            "need_m3s": (units, fleet.unit_design_m3s),
            "plain_m3s": (units, fleet.unit_design_m3s),
            "following": (units, 1.0),
            "supply_excess_k": (units, 0.0),
            "casing_c": (units, mean_c[fleet.unit_dc]),
            "return_air_c": (units, mean_c[fleet.unit_dc]),
            "water_heat_j": (self.beyond_limits, 0.0),
            "tank_heat_j": (self.beyond_limits, 0.0),
        }
        return HallState(
            **{
                name: np.where(rows, values, before).astype(before.dtype)
                for name, (rows, values) in new.items()
                for before in [getattr(state, name)]
            }
        )

    def supply_ratio(self) -> F64:
        """Return the supply air of each unit divided by the need of it; see ``Simulator``."""
        if not self._recirculates:
            return np.ones(self._fleet.units)
        unit = self._unit_state
        need_m3s, fresh_m3s = unit["plain_m3s"], self._fresh_m3s * unit["speed"]
        # Air beyond the limits of numbers, which is NaN, gives the upper bound.
        is_below = fresh_m3s < MOST_SUPPLY_RATIO * need_m3s
        ratio = np.full(len(need_m3s), MOST_SUPPLY_RATIO)
        return np.asarray(np.divide(fresh_m3s, need_m3s, out=ratio, where=is_below))

    def discard_last_step(self) -> None:
        """Forget the last step, so that ``servers`` cannot return layers of an outdated state."""
        self._was_transient = None

    def servers(self, into: ServerLayers | None = None) -> ServerLayers:
        """Return inlet, outlet and power of every server in the last step, (S,) each.

        After ``advance``, the values are those at the end of the step.

        Args:
            into: Layers to overwrite and return; None allocates new ones.

        Raises:
            RuntimeStateError: No step has been done.
            SdcError: ``into`` has a wrong shape, type or memory order, or is read-only.
        """
        shape = (self._fleet.servers,)
        if into is None:
            into = ServerLayers(*(self._aligned(shape) for _ in range(3)))
        layers = [into.inlet_c, into.outlet_c, into.power_w]
        for name, layer in zip(("inlet_c", "outlet_c", "power_w"), layers, strict=True):
            has = layer.shape, layer.dtype, layer.flags.c_contiguous, layer.flags.writeable
            if has != (shape, self._dtype, True, True):
                raise SdcError(
                    f"layer {name}: {layer.dtype} {layer.shape}"
                    f"{'' if layer.flags.writeable else ', read-only'}; valid is a contiguous, "
                    f"writeable {self._dtype} {shape}"
                )
        is_aligned = [layer.ctypes.data % (LANES * layer.itemsize) == 0 for layer in layers]
        stored = [
            layer if fits else self._aligned(shape)
            for layer, fits in zip(layers, is_aligned, strict=True)
        ]
        arguments = self._layer_arguments(stored)
        self._call_layers_kernel(arguments, per_group=0)
        self._layers_kernel.release(*arguments)
        for layer, values, fits in zip(layers, stored, is_aligned, strict=True):
            if not fits:
                layer[:] = values
        return into

    def groups(self) -> ServerLayers:
        """Return inlet, outlet and power of one server of each group in the last step, (G,) each.

        The next call of ``groups`` or ``group_inlets`` overwrites the returned arrays.

        Raises:
            RuntimeStateError: No step has been done.
        """
        if self._group_layers is None:
            layers = [self._aligned((self._fleet.groups,)) for _ in range(3)]
            self._group_layers = ServerLayers(*layers), self._layer_arguments(layers)
        layers_of_groups, arguments = self._group_layers
        self._call_layers_kernel(arguments, per_group=1)
        return layers_of_groups

    def group_inlets(self) -> F64:
        """Return the inlet temperature of every server group in the last step, in C, (G,).

        Raises:
            RuntimeStateError: No step has been done.
        """
        return self.groups().inlet_c.astype(np.float64)

    def intake_air(self, setpoint_c: F64) -> IntakeAir:
        """Return the air before the racks after the last step.

        Args:
            setpoint_c: Supply setpoint of each CRAC unit, in C, (U,), to store in the result.

        Raises:
            RuntimeStateError: No step has been done.
        """
        self._require_step()
        return read_intake_air(self._tables, self._rack_out, self._exhaust(), setpoint_c)

    def _require_step(self) -> bool:
        """Return True if the last step was transient; raise an error if there is no last step."""
        if self._was_transient is None:
            raise RuntimeStateError("no step has been done yet; air and servers exist after one")
        return self._was_transient

    def _set_conditions(self, conditions: Conditions) -> None:
        """Check the conditions of a step and write them to the input arrays of the kernels."""
        for name, shape in self._shapes.items():
            values = getattr(conditions, name)
            if values is None:
                continue
            if np.shape(values) != shape:
                raise SdcError(f"conditions: {name} has shape {np.shape(values)}; valid is {shape}")
            if not isfinite(np.add.reduce(values)):
                raise SdcError(f"conditions: {name} is not finite; valid are finite numbers")
        self.discard_last_step()
        self._load_level, self._group_load = LOADS_PER_DC, self._none
        self._dc["utilisation"][:] = conditions.utilisation
        if conditions.group_load is not None:
            self._load_level = LOADS_PER_GROUP
            self._group_load = np.array(conditions.group_load, dtype=self._dtype, order="C")
        elif conditions.rack_load is not None:
            self._load_level = LOADS_PER_RACK
            self._places.put(self._rack["load"], conditions.rack_load)
        for name, values in (
            ("powered", conditions.powered),
            ("fan_airflow", conditions.rack_airflow),
        ):
            row = self._rack[name]
            if values is not None:
                self._places.put(row, values)
                self._overridden_rows.add(name)
            elif name in self._overridden_rows:
                row[:] = self._is_rack
                self._overridden_rows.remove(name)
        self._set_exhaust_shares(conditions)
        self._tables.plenum.supply_from(conditions.unit_running)
        unit = self._unit
        unit["low"][:] = 1.0 if conditions.unit_low is None else conditions.unit_low
        unit["high"][:] = 1.0 if conditions.unit_high is None else conditions.unit_high
        unit["running"][:] = 1.0 if conditions.unit_running is None else conditions.unit_running
        unit["setpoint_c"][:] = conditions.unit_supply_c
        self._unit_state["supply_c"][:] = conditions.unit_supply_c
        self._unit_state["excess_k"][:] = 0.0

    def _set_exhaust_shares(self, conditions: Conditions) -> None:
        """Set the exhaust shares of the racks, which depend on where racks draw more air."""
        air, row = self._fleet.air, self._rack["exhaust_share"]
        loads = conditions.rack_load, conditions.group_load
        working = conditions.powered, conditions.rack_airflow
        if air is not None and any(values is not None for values in (*loads, *working)):
            self._places.put(row, self._exhaust_shares(air, conditions))
            self._overridden_rows.add("exhaust_share")
        elif "exhaust_share" in self._overridden_rows:
            row[:] = self._even_exhaust_share
            self._overridden_rows.remove("exhaust_share")

    def _exhaust_shares(self, air: HallAir, conditions: Conditions) -> F64:
        """Return the share of exhaust air in the intake of each rack, 0..1, (R,)."""
        fleet, load = self._fleet, conditions.rack_load
        if conditions.group_load is not None:
            if self._group_parts is None:
                self._group_parts = _group_parts(fleet)
            load = fleet.group_sums(self._group_parts * conditions.group_load)
        elif load is None:
            load = conditions.utilisation[fleet.rack_dc]
        shares = air.exhaust_share.copy()
        work = [x for x in (load, conditions.powered, conditions.rack_airflow) if x is not None]
        for entry, tiles in enumerate(air.tiles):
            dcs = np.flatnonzero(air.steady_state_of_dc == entry)
            racks = fleet.rack_offsets[dcs][:, None] + np.arange(tiles.hall.racks)
            spread = np.max([np.ptp(values[racks], axis=1) for values in work], axis=0)
            # Racks that work alike keep the shares of the design point to the bit.
            racks = racks[spread > EVEN_WITHIN]
            if racks.size:
                airflow_m3s = tiles.airflow_m3s(load[racks])
                for values in work[1:]:
                    airflow_m3s *= values[racks]
                shares[racks] = tiles.exhaust_share(airflow_m3s) * tiles.of_height
        return shares

    def _start_of_step(self, state: HallState, coil: Coil) -> tuple[_Rows, _Rows, _Rows]:
        """Return rows of the racks, the CRAC units and the data centers at the start of a step.

        Args:
            state: State of the air, and with it the airflow and supply air of the CRAC units.
            coil: Setpoints, heat stored in the room, and limit of the plant.
        """
        fleet = self._fleet
        of_racks = {name: getattr(state, name) for name in ("mixed_c", "exhaust_c", "captured_m3s")}
        # Shares, and with them the demand on each unit, change when units stop or start.
        need_m3s = state.need_m3s * self._tables.plenum.drawn_ratio
        plain_m3s = state.plain_m3s * self._tables.plenum.drawn_ratio
        follows_inlet = self._dc["inlet_target_c"][fleet.unit_dc] > 0.0
        following = np.where(
            follows_inlet, state.following, plain_m3s / np.maximum(self._fresh_m3s, 1e-30)
        )
        speed = np.clip(following, self._unit["low"], self._unit["high"])
        covers = self._fresh_m3s * speed / np.maximum(need_m3s, 1e-30)
        ratio = self._fresh_m3s * speed / np.maximum(plain_m3s, 1e-30)
        exceeds = fleet.unit_sums(np.where(ratio > 1.0 + COVERED_WITHIN, 1.0, 0.0)) > 0
        room_j = coil.room_j - (state.water_heat_j + state.tank_heat_j)
        warmed_k = (room_j / coil.room_j_per_k)[fleet.unit_dc]
        coil_c = coil.setpoint_c + warmed_k + state.supply_excess_k
        running = self._unit["running"]
        any_running = fleet.unit_sums(running)[fleet.unit_dc] > 0.0
        passes_return_air = (running == 0.0) & any_running
        coil_c = np.where(passes_return_air, state.return_air_c, coil_c)
        of_units: _Rows = {
            "fresh_ratio": np.minimum(1.0, covers),
            "supply_ratio": np.minimum(ratio, MOST_SUPPLY_RATIO),
            "need_m3s": need_m3s,
            "plain_m3s": plain_m3s,
            "strength": 1.0,
            "drawn_ratio": 1.0,
            "speed": speed,
            "coil_c": coil_c,
            "supply_c": coil_c,
            "casing_c": state.casing_c,
        }
        flow_m3s = fleet.unit_sums(fleet.unit_design_m3s * speed)
        of_dcs: _Rows = {
            "exceeds": exceeds & (fleet.oversupply_decay > 0),
            "fan_speed": state.following[fleet.unit_offsets[:-1]],
            "crac_m3s_per_rack": flow_m3s / np.diff(fleet.rack_offsets),
            "room_j": room_j,
            "water_j": state.water_heat_j,
            "tank_j": state.tank_heat_j,
            "room_j_per_k": coil.room_j_per_k,
            "coil_limit_w": coil.limit_w,
            "limit_w_per_k": coil.limit_w_per_k,
            "limit_w_per_w": coil.limit_w_per_w,
            "crac_fan_w_per_m3s": coil.fan_w_per_m3s,
            **_water_rows(coil.water),
        }
        self._unit["setpoint_c"][:] = coil.setpoint_c
        return of_racks, of_units, of_dcs

    def _write_start(
        self, start: tuple[_Rows, _Rows, _Rows], chosen: npt.NDArray[np.bool_]
    ) -> None:
        """Write rows of ``_start_of_step`` for the data centers with ``chosen`` True, (B,)."""
        of_racks, of_units, of_dcs = start
        fleet, of_unit = self._fleet, chosen[self._fleet.unit_dc]
        for name, values in of_racks.items():
            row = self._memory[name]
            if not chosen.all():
                present = self._places.values_of_racks(row[None])[0]
                values = np.where(chosen[fleet.rack_dc], values, present)
            self._places.put(row, values)
        strengths_differ = np.where(self._unit_state["strength"] != 1.0, 1.0, 0.0)
        shares_due = fleet.unit_sums(strengths_differ) > 0
        for name, values in of_units.items():
            np.copyto(self._unit_state[name], values, where=of_unit)
        for name, values in (of_dcs | {"shares_due": shares_due}).items():
            np.copyto(self._dc[name], values, where=chosen)

    def _begin_steady_step(self, conditions: Conditions) -> None:
        """Set the conditions of a step in steady air, where CRAC units first cover all need."""
        self._set_conditions(conditions)
        self._unit_state["fresh_ratio"][:] = 1.0
        self._unit_state["supply_ratio"][:] = 1.0
        self._dc["exceeds"][:] = 0.0
        self._dc["fan_speed"][:] = 1.0
        self._begin_step(exchanges_before=0)

    def _begin_step(
        self, exchanges_before: int, chosen: npt.NDArray[np.bool_] | Literal[True] = True
    ) -> None:
        """Reset the control rows of the kernel for a new step.

        Args:
            exchanges_before: 1 if the first sweep starts from the stored ``exhaust_c``, 0 if it
                looks up an initial guess.
            chosen: True for the data centers that run the step, (B,).
        """
        arrays = self._tables.arrays
        np.copyto(arrays["dc_control"], _FIRST_CONTROL[exchanges_before], where=chosen)
        np.copyto(arrays["dc_doubles"][_SHIFTS], 0.0, where=chosen)

    def _add_sampled_racks(self, precision: Precision) -> None:
        """Compute the modes of all sparse halls, and the racks that they sample.

        Equal halls are computed once. Their CRAC units run at full speed and supply air at their
        setpoints.
        """
        air = self._fleet.air
        assert air is not None
        entries, first = np.unique(air.steady_state_of_dc[self._sparse_dcs], return_index=True)
        dcs = dict(zip(entries.tolist(), self._sparse_dcs[first].tolist(), strict=True))
        modes: dict[int, SteadyModes] = {}
        names = "adjusts_supply", "inlet_target_c", "coupling", "oversupply", "own_return"
        controls = [self._dc[name] for name in names]
        usual = [row.copy() for row in controls]
        for row in controls:
            row[:] = 0.0
        self._step_kernel.bind(tolerance_k=SAMPLE_TOLERANCE_K[precision])
        for loads in LEVELS:
            states_of_dc = self._steady_states([*dcs.values()], loads)
            states = {entry: states_of_dc[dc] for entry, dc in dcs.items()}
            modes = {
                entry: extended_modes(modes.get(entry), outlet_k, mix_k, MODE_VECTORS * LANES)
                for entry, (outlet_k, mix_k) in states.items()
            }
            self._set_modes(modes, precision)
        self._step_kernel.bind(tolerance_k=TOLERANCE_K[precision])
        for row, values in zip(controls, usual, strict=True):
            row[:] = values

    def _steady_states(self, dcs: list[int], loads: F64) -> dict[int, Reals]:
        """Compute steady states of data centers at ``SUPPLY_SHARES`` and the given loads.

        Returns:
            Outlets and exhaust mixes minus supply temperatures of each data center, in K,
            (2, states, racks); states without steady air are missing.
        """
        fleet, places = self._fleet, self._places
        low_c, high_c = supply_range_c(fleet)
        others = np.isin(np.arange(fleet.size), dcs, invert=True)
        states: dict[int, list[Reals]] = {dc: [] for dc in dcs}
        for share, load in product(SUPPLY_SHARES, loads):
            supply_c = low_c + share * (high_c - low_c)
            conditions = Conditions(supply_c[fleet.unit_dc], np.full(fleet.size, load))
            self._begin_steady_step(conditions)
            self._control["status"][others] = DONE
            if self._sample is not None:
                self._solve_sampled_racks(self._sample, conditions)
            self._run_sweeps(np.empty((len(DC_OUT), fleet.size)), MOST_SWEEPS)
            outlet_c = self._exhaust() * self._rack["per_strength"]
            air_c = places.values_of_racks(np.stack([outlet_c, self._memory["mixed_c"]]))
            for dc, of_dc in states.items():
                air_k = air_c[:, slice(*fleet.rack_offsets[dc : dc + 2])] - supply_c[dc]
                if self._control["status"][dc] == DONE and np.isfinite(air_k).all():
                    of_dc.append(air_k.astype(self._dtype))
        racks = np.diff(fleet.rack_offsets)
        return {
            dc: np.array(of_dc, self._dtype).reshape(-1, 2, racks[dc]).swapaxes(0, 1)
            for dc, of_dc in states.items()
        }

    def _set_modes(self, modes: dict[int, SteadyModes], precision: Precision) -> None:
        """Let the sweeps of sparse halls start from their modes and sampled racks.

        A hall without steady air in any of the computed states has no modes.
        """
        fleet, tables = self._fleet, self._tables
        assert fleet.air is not None
        modes = {entry: of_hall for entry, of_hall in modes.items() if len(of_hall.racks)}
        entries = fleet.air.steady_state_of_dc[self._sparse_dcs]
        self._sparse_dcs = self._sparse_dcs[np.isin(entries, [*modes])]
        if not modes:
            return
        # A hall that runs on several threads and its sampled racks, which would run on one, share
        # one compiled kernel, which shortens the start.
        is_serial = tables.group_places * LANES <= SERIAL_GROUPS
        sampled_racks = sampled_fleet(fleet, self._sparse_dcs, modes)
        sample = Hall(sampled_racks, precision, serial_groups=SERIAL_GROUPS if is_serial else 0)
        sample._step_kernel.bind(tolerance_k=SAMPLE_TOLERANCE_K[precision])
        array, rows = build_steady_states(fleet, self._places, self._dtype, modes)
        dc_ints = tables.rows("dc_ints")
        for name, values in rows.items():
            dc_ints[name][: fleet.size] = values
        dc_ints["first_sample"][self._sparse_dcs] = LANES * sample._places.block_offsets[:-1]
        # The racks of dense halls always write this row.
        outlet_c = sample._memory["exhaust_odd_c"]
        tables.arrays.update(steady_states=array, sample_outlet_c=outlet_c)
        self._step_kernel.bind(steady_states=array, sample_outlet_c=outlet_c)
        self._sample = sample

    def _solve_sampled_racks(self, sample: Hall, conditions: Conditions) -> None:
        """Solve the sampled racks of sparse halls, from whose outlets their sweeps start."""
        dcs = self._sparse_dcs
        supply_c = conditions.unit_supply_c[self._fleet.unit_offsets[dcs]]
        sample._begin_steady_step(Conditions(supply_c, conditions.utilisation[dcs]))
        sample._run_sweeps(np.empty((len(DC_OUT), len(dcs))), SAMPLE_SWEEPS)
        self._dc["feedback_gain"][dcs] = sample._dc["feedback_gain"]
        status = sample._control["status"]
        if np.minimum.reduce(status) == NOT_CONVERGED:
            outlet_c = sample._memory["exhaust_odd_c"]
            start_c = np.repeat(supply_c, LANES * sample._places.blocks).astype(self._dtype)
            failed = np.repeat(status == NOT_CONVERGED, LANES * sample._places.blocks)
            outlet_c[failed] = start_c[failed]

    def _run_sweeps(self, dc_out: F64, sweeps: int, **arguments: Any) -> None:
        """Call the kernel until every data center has converged or reached its last sweep."""
        status = self._control["status"]
        if self._weighs_apart:
            self._call_step_kernel(dc_out, sweeps=0, **arguments)
        while np.maximum.reduce(status) == RUNNING:
            self._call_step_kernel(dc_out, sweeps=sweeps, **arguments)

    def _call_step_kernel(
        self,
        dc_out: F64,
        *,
        transient: bool = False,
        sweeps: int = 1,
        longest: int = 1,
        substep_s: float = 1.0,
        weight: float = 1.0,
        abandoned_above_k: float = np.inf,
        server_c_before: Any = None,
        server_c_after: Any = None,
    ) -> None:
        """Call the step kernel once.

        A call does all sweeps of data centers that form a single task, and one sweep of the others.
        """
        runtime.ensure_started()
        group_places = self._tables.group_places
        if transient and len(self._server_c) < group_places:
            self._server_c = vectors(self._dtype, group_places)
        self._step_kernel(
            transient=transient,
            serial=group_places * LANES * (sweeps if transient else 1) <= self._serial_groups,
            sweeps=sweeps,
            longest=longest,
            load_level=self._load_level,
            substep_s=substep_s,
            weight=weight,
            abandoned_above_k=abandoned_above_k,
            group_load=self._group_load,
            server_c=self._server_c,
            server_c_before=self._none if server_c_before is None else server_c_before,
            server_c_after=self._none if server_c_after is None else server_c_after,
            rack_out=self._rack_out,
            dc_out=dc_out,
        )
        if transient:
            self._step_kernel.release("server_c_before", "server_c_after")

    def _call_layers_kernel(self, arguments: dict[str, Any], per_group: int) -> None:
        """Compute layers of the last step: per group if ``per_group`` is 1, else per server."""
        transient = self._require_step()
        runtime.ensure_started()
        if not self._has_rows_along_racks:
            self._add_rows_along_racks()
        self._layers_kernel(
            transient=transient,
            serial=len(arguments["inlet_c"]) <= SERIAL_GROUPS,
            load_level=self._load_level,
            group_load=self._group_load,
            server_c=self._server_c,
            rack_out=self._rack_out,
            per_group=per_group,
            **arguments,
        )
        if self._returns_buffers:
            # The arrays belong to the returned results, so the kernel must not hold them.
            self._layers_kernel.release("rack_out")

    def _layer_arguments(self, layers: list[Any]) -> dict[str, Any]:
        """Return layers as kernel arguments: as flat arrays, and as views of whole vectors."""
        whole = len(layers[0]) // LANES * LANES
        arguments = dict(zip(("inlet_c", "outlet_c", "power_w"), layers, strict=True))
        for name, layer in zip(("inlet", "outlet", "power"), layers, strict=True):
            by_vector = layer[:whole].reshape(-1, LANES) if whole else self._no_vectors
            arguments[f"{name}_vectors"] = by_vector
        return arguments

    def _add_rows_along_racks(self) -> None:
        """Add group inputs whose lanes are groups of one rack, which only layers read."""
        arrays = self._tables.arrays
        self._step_kernel.release("group_inputs")
        self._layers_kernel.release("group_inputs")
        arrays["group_inputs"], first = build_rows_along_racks(
            arrays["group_inputs"][: self._group_rows], arrays["block_ints"]
        )
        self._tables.rows("block_ints")["first_row_along"][:] = first
        self._step_kernel.bind(group_inputs=arrays["group_inputs"])
        self._layers_kernel.bind(group_inputs=arrays["group_inputs"])
        self._has_rows_along_racks = True

    def _exhaust(self) -> Any:
        """Return exhaust temperature times strength of each rack after the last sweep, padded."""
        side = self._control["exhaust_side"]
        other_side = self._memory["exhaust_odd_c"], self._memory["exhaust_c"]
        # Usually all data centers have used the same side last.
        if np.minimum.reduce(side) == np.maximum.reduce(side):
            return other_side[side[0]]
        return np.where(np.repeat(side, LANES * self._places.blocks) == 0, *other_side)

    def _hall_state(self, server_c: Any) -> HallState:
        """Return the thermal state after the last substep."""
        drawn_ratio = self._tables.plenum.drawn_ratio * self._unit_state["drawn_ratio"]
        return HallState(
            server_c=server_c,
            mixed_c=self._places.values_of_racks(self._memory["mixed_c"][None])[0],
            exhaust_c=self._places.values_of_racks(self._exhaust()[None])[0],
            captured_m3s=self._places.values_of_racks(self._memory["captured_m3s"][None])[0],
            need_m3s=self._unit_state["need_m3s"] / drawn_ratio,
            plain_m3s=self._unit_state["plain_m3s"] / drawn_ratio,
            following=self._unit_state["following"].copy(),
            supply_excess_k=self._unit_state["excess_k"].copy(),
            casing_c=self._unit_state["casing_c"].copy(),
            return_air_c=self._dc["return_c"][self._fleet.unit_dc]
            + self._unit_state["return_offset_k"],
            water_heat_j=self._dc["water_j"].copy(),
            tank_heat_j=self._dc["tank_j"].copy(),
        )

    def _aligned(self, shape: tuple[int, ...]) -> Any:
        """Return an uninitialised array that is aligned for vector access by kernels."""
        from sdc_taichi.kernels.compiler.arrays import aligned

        return aligned(shape, self._dtype)

    def _new_results(self) -> F64:
        """Allocate result rows of the data centers, and of the racks if callers own the old rows.

        Results of racks are returned without a copy if ``_returns_buffers`` is True.
        """
        if self._returns_buffers:
            self._rack_out = self._aligned(self._rack_out.shape)
        return np.empty((len(DC_OUT), self._fleet.size))

    def _no_steady_air_error(self, dc: int) -> PhysicalLimitError:
        """Return the error for a data center whose sweeps have not converged."""
        units = slice(*self._fleet.unit_offsets[dc : dc + 2])
        most_m3s = self._unit["high"][units] * self._fleet.unit_design_m3s[units]
        return no_steady_air_error(
            self._fleet.names[dc],
            MOST_SWEEPS,
            flow_m3s=float(self._unit_state["flow_m3s"][units].sum()),
            most_m3s=float(most_m3s.sum()),
            need_m3s=float(self._unit_state["need_m3s"][units].sum()),
            limits_coils=bool(np.any(self._fleet.unit_capacity_w[units] < NO_LIMIT_W)),
        )

    def _results(self, dc_out: F64, *, transient: bool) -> HallSums:
        """Collect and check the results of a finished step, after which layers are available."""
        racks = self._rack_out.reshape(len(self._rack_out), -1)
        if not self._returns_buffers:
            racks = self._places.values_of_racks(racks)
        outlets_c = racks[_OUTLET_MAX_ROW]
        self.hottest_outlet_c = float(np.maximum.reduce(outlets_c))
        # A NaN anywhere in a hall propagates to its outlets, so checking the outlets is enough.
        if not self.hottest_outlet_c < BEYOND_NUMBERS_C:
            if not self.flags_limits:
                raise no_number_error(outlets_c, self._fleet)
            infinite = self._fleet.rack_sums(~(outlets_c < BEYOND_NUMBERS_C)) > 0
            before = self.beyond_limits
            self.beyond_limits = infinite if before is None else infinite | before
        self._was_transient = transient
        results = dict(zip(RESULT_NAMES, (*dc_out, *racks), strict=True))
        unit = self._unit_state
        if self._recirculates:
            unit_supply_c = unit["mean_supply_c"]
            cubed_flow_m3s = self._fleet.unit_sums(
                unit["cubed_speed"] * self._fleet.unit_design_m3s
            )
        else:
            unit_supply_c, cubed_flow_m3s = results["supply_c"], self._no_flow_m3s
        return HallSums(
            unit_supply_c=unit_supply_c.copy(),
            unit_airflow_m3s=unit["flow_m3s"].copy(),
            cubed_flow_m3s=cubed_flow_m3s,
            **(self._stored_heat() if transient else self._no_stored_heat),
            **results,
        )

    def _stored_heat(self) -> dict[str, F64]:
        """Return the heat stored in room, chilled water and tank at the end of a transient step."""
        dc = self._dc
        water_warmed_k = dc["water_j"] / np.maximum(dc["water_j_per_k"], 1e-30)
        return {
            "room_j": dc["room_j"] + (dc["water_j"] + dc["tank_j"]),
            "water_j": dc["water_j"].copy(),
            "tank_j": dc["tank_j"].copy(),
            "water_warmed_k": water_warmed_k,
            "most_warmed_k": water_warmed_k,
        }


def _water_rows(water: ChilledWater | None) -> dict[str, F64 | float]:
    """Return rows of ``DC_DOUBLES`` with the chilled water of a step; zeros without water."""
    if water is None:
        return dict.fromkeys(("carried_w", "water_j_per_k", "tank_most_j", "tank_share"), 0.0)
    return {
        "carried_w": water.carried_w,
        "water_j_per_k": water.j_per_k,
        "tank_most_j": water.tank_most_j,
        "tank_share": water.tank_share,
    }


def _group_parts(fleet: Fleet) -> F64:
    """Return the airflow of each server group divided by that of its rack, (G,)."""
    count, full = (row_index(GROUP_INPUTS, name) for name in ("count", "full_airflow"))
    airflow = np.concatenate([rows[count] * rows[full] for rows in fleet.group_rows])
    return airflow / np.repeat(fleet.group_sums(airflow), np.diff(fleet.group_offsets))


def _condition_shapes(fleet: Fleet) -> dict[str, tuple[int]]:
    """Return the required shape of each field of ``Conditions``."""
    sizes = {"unit": fleet.units, "utilisation": fleet.size, "group": fleet.groups}
    return {f.name: (sizes.get(f.name.split("_")[0], fleet.racks),) for f in fields(Conditions)}
