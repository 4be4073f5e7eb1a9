"""The halls of a fleet on the thermal kernel: supply air and load in, temperatures out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sdc_taichi import runtime
from sdc_taichi.errors import RuntimeStateError, SdcError
from sdc_taichi.fleet import LOADS, Fleet
from sdc_taichi.types import F64, I64, Reals, ServerLayers

Precision = Literal["f32", "f64"]

_RELEASED_OUTLET_FIT = (1.918, 1.096, 0.526, 0.824, -14.01)
"""Rack outlet fit of the released SustainDC: factor, power exponent, divisor, flow exponent, K."""

_RACKS_PER_CHUNK = 64
"""Fewer racks than this are not worth a thread of their own."""

TOLERANCE_K: dict[Precision, float] = {"f32": 1e-4, "f64": 1e-12}
"""How little another sweep would move the exhaust mix before any rack."""
MOST_SWEEPS = 2000


@dataclass(frozen=True, slots=True)
class Conditions:
    """What the halls meet during one step."""

    unit_supply_c: F64
    """Supply air of each CRAC unit, (U,)."""
    utilisation: F64
    """Mean over the servers of each data center, (B,)."""
    rack_load: F64 | None = None
    """Utilisation of each rack while it is on, (R,); None loads all racks alike."""
    group_load: F64 | None = None
    """The same for each server group, (G,); None spreads the load of a rack by load weights."""
    powered: F64 | None = None
    """Share of the step that each rack is on, (R,); None is all of it."""
    rack_airflow: F64 | None = None
    """Airflow left to the fans of each rack, (R,); None is all of it."""
    unit_low: F64 | None = None
    """Lowest speed of each unit over design speed, (U,); None is full speed."""
    unit_high: F64 | None = None
    """Highest speed of each unit, (U,)."""
    unit_running: F64 | None = None
    """1 for units that run, 0 for those whose fan coasts without cooling, (U,)."""


@dataclass(frozen=True, slots=True)
class HallState:
    """Memory of transient halls; quasi-steady ones have none."""

    server_c: Reals
    """Temperature of the servers of each group, (G,)."""
    mixed_c: Reals
    """Recirculated air before each rack, (R,)."""
    exhaust_c: Reals
    """Outlet temperature times the strength of the rack, (R,)."""
    captured_m3s: Reals
    """Recirculated air that each rack takes in, (R,)."""
    need_m3s: F64
    """Supply air that the racks ask of each CRAC unit, (U,)."""
    following: F64
    """Airflow of the servers over that at the design point, for each CRAC unit, (U,)."""


@dataclass(frozen=True, slots=True)
class Coil:
    """What transient halls need to know of coils and plant, each (B,)."""

    setpoint_c: F64
    """Of each CRAC unit, (U,)."""
    room_j: F64
    """Heat held by the room at the start of the step."""
    room_j_per_k: F64
    limit_w: F64
    """Heat the plant can take during the step."""
    fan_w_per_m3s: F64
    """CRAC fan power per airflow at full speed."""


@dataclass(frozen=True, slots=True)
class HallSums:
    """Sums and means of one evaluation: (B,) per data center, (R,) per rack."""

    cpu_w: F64
    fan_w: F64
    airflow_m3s: F64
    inlet_mean_c: F64
    inlet_max_c: F64
    outlet_mean_c: F64
    inlet_m3k_s: F64
    """Airflow times inlet temperature over supply."""
    outlet_m3k_s: F64
    """Airflow times outlet temperature over supply."""
    hot_k: F64
    """Sum over the servers of what their inlets exceed 27 C by."""
    cold_k: F64
    """Sum over the servers of what their inlets fall short of 18 C by."""
    hottest_group: I64
    """Server group with the hottest inlet."""
    stored_w: F64
    """Heat that goes into servers and recirculated air."""
    crac_flow_m3s: F64
    """0 with inlet model ``approach``, as the next two."""
    supply_c: F64
    """Airflow-weighted mean over the units."""
    return_c: F64
    coil_load_w: F64
    """Heat of air and fans that reaches the CRAC units (transient)."""
    coil_w: F64
    """Heat that the coils take out (transient)."""
    unit_flow_m3s: F64
    """(U,)."""
    unit_cubed_speed: F64
    """Mean cube of the fan speed over design speed, 0 for units that are down, (U,)."""
    room_j: F64
    rack_cpu_w: Reals
    rack_fan_w: Reals
    rack_airflow_m3s: Reals
    rack_inlet_c: Reals
    rack_inlet_max_c: Reals
    rack_outlet_c: Reals


class Hall:
    """Kernel arguments of a fleet: plain arrays, given back with the object."""

    def __init__(self, fleet: Fleet, precision: Precision) -> None:
        threads = runtime.ensure_started()
        from sdc_taichi.kernels import thermal

        self._thermal = thermal
        self._precision: Precision = precision
        self._dtype = np.dtype(np.float32 if precision == "f32" else np.float64)
        self._fleet = fleet
        self._fresh_row = thermal.DC_ROWS.index("fresh_share")
        self._kernel = thermal.hall_kernel(precision)
        self._outlet_model = thermal.OUTLETS.index(fleet.models["outlet"])
        self._recirculates = fleet.air is not None
        self._server_slices = max(1, min(8 * threads, fleet.servers // 4096))
        self._lay_out(thermal)
        self._slices = max(1, min(8 * threads, self._chunk_ints.shape[1] - 1))
        self._solved: bool | None = None
        """Whether the last step was transient; None without one."""

    def _lay_out(self, thermal: Any) -> None:
        fleet, air = self._fleet, self._fleet.air
        chunks = [
            np.arange(a, b, _RACKS_PER_CHUNK)
            for a, b in zip(fleet.rack_start[:-1], fleet.rack_start[1:], strict=True)
        ]
        per_dc = np.array([len(c) for c in chunks])
        chunk_dc = np.repeat(np.arange(fleet.size), per_dc)
        units = np.diff(fleet.unit_start)
        first_need = np.concatenate([[0], np.cumsum(units[chunk_dc])])
        self._chunk_ints = _table(np.concatenate([*chunks, [fleet.racks]]), chunk_dc, first_need)
        zeros = np.zeros(1, np.int32)
        run_start = np.zeros(fleet.racks + 1, np.int32) if air is None else air.run_start
        self._rack_ints = _table(fleet.group_start, run_start, fleet.rack_dc)
        self._run_ints = (
            _table(zeros, zeros, zeros)
            if air is None
            else _table(air.run_first, air.run_length, air.run_offset)
        )
        first_chunk = np.concatenate([[0], np.cumsum(per_dc)])
        share_start = np.zeros(fleet.size, np.int32) if air is None else air.share_start
        self._dc_ints = _table(first_chunk, fleet.unit_start, fleet.rack_start, share_start)
        self._active = np.ones(fleet.size, np.int32)
        self._weights = self._real(np.zeros(1) if air is None else air.weights)
        self._shares = self._real(np.zeros(1) if air is None else air.unit_shares)
        self._racks = self._real(np.ones((len(thermal.RACK_ROWS), fleet.racks)))
        self._racks[0] = fleet.approach_k
        if air is not None:
            self._racks[1], self._racks[5] = air.norm, air.strength
        self._groups = self._real(
            np.concatenate([fleet.groups, np.zeros((1, fleet.groups.shape[1]))])
        )
        self._dcs = self._real(fleet.dcs)
        self._doubles = np.zeros((len(thermal.DC_DOUBLES), fleet.size))
        self._doubles[4] = fleet.it_airflow_m3s
        self._units = self._real(np.ones((len(thermal.UNIT_ROWS), fleet.units)))
        self._units[3] = fleet.unit_design_m3s
        self._unit_state = np.ones((len(thermal.UNIT_STATE), fleet.units))
        self._rack_state = self._real(np.zeros((len(thermal.RACK_STATE), fleet.racks)))
        self._server_c = self._real(np.zeros(1))
        self._fit = self._real(np.array(_RELEASED_OUTLET_FIT))
        self._needs = np.zeros(max(int(first_need[-1]), 1))
        self._sums = np.zeros((len(thermal.SUMS), len(chunk_dc)))
        self._no_groups = np.zeros((len(thermal.GROUP_OUT), 1), self._dtype)

    def _real(self, values: F64) -> Any:
        return np.array(values, dtype=self._dtype, order="C")

    def solve(self, met: Conditions) -> HallSums:
        """Quasi-steady temperatures and power.

        Args:
            met: supply air, load and what is out of order.

        Raises:
            SdcError: no steady state, as when no unit moves air.
        """
        self._set(met)
        self._unit_state[1] = 1.0
        out = self._out()
        if self._recirculates:
            self._guess(met)
            self._sweep(out)
        else:
            self._run(out, advance=False)
        self._solved = False
        return self._results(out)

    def _guess(self, met: Conditions) -> None:
        """Outlets to start from: the racks of the design point, moved as a mean rack would be."""
        fleet, air = self._fleet, self._fleet.air
        assert air is not None
        supply_c = met.unit_supply_c[fleet.unit_start[:-1]]
        grid = air.supply_c[air.table]
        low, high, last = grid[:, 0], grid[:, -1], grid.shape[1] - 1
        y = np.clip((supply_c - low) / np.maximum(high - low, 1e-9), 0.0, 1.0) * last
        x = np.clip(met.utilisation, 0.0, 1.0) * (len(LOADS) - 1)
        i = np.minimum(y.astype(np.int64), last - 1)
        j = np.minimum(x.astype(np.int64), len(LOADS) - 2)
        y, x = y - i, x - j
        corner = air.expected[air.table]
        dc = np.arange(fleet.size)
        scale, warming, kept = (
            (1 - y) * ((1 - x) * corner[dc, k, i, j] + x * corner[dc, k, i, j + 1])
            + y * ((1 - x) * corner[dc, k, i + 1, j] + x * corner[dc, k, i + 1, j + 1])
            for k in range(3)
        )
        rack = fleet.rack_dc
        outlet_c = supply_c[rack] + scale[rack] * fleet.approach_k + warming[rack] * air.rise_k
        self._rack_state[1] = air.strength * outlet_c
        self._rack_state[0] = -1e6
        self._doubles[5] = np.clip(kept / (1.0 - np.minimum(kept, 0.9)), 0.0, 9.0)

    def _sweep(self, out: tuple[Any, Any]) -> None:
        """Repeat until the mix before every rack stands still."""
        self._active[:] = 1
        for sweep in range(MOST_SWEEPS):
            # What is left to come shows from the third sweep on.
            self._run(out, advance=True, source=sweep % 2, first=sweep < 2)
            if not self._active.any():
                break
        else:
            dc = self._fleet.names[int(np.argmax(self._active))]
            raise SdcError(
                f"{dc}: no steady air temperatures in {MOST_SWEEPS} sweeps; the CRAC units move "
                "too little air (hvac.crac.coasting_flow_ratio, min_flow_ratio), or "
                "simulation.thermal=transient"
            )
        self._active[:] = 1

    def servers(self, into: ServerLayers | None = None) -> ServerLayers:
        """Per-server layers of the last ``solve`` or ``advance``, each (S,).

        Args:
            into: layers to overwrite and return; None allocates new ones.

        Raises:
            RuntimeStateError: before the first step.
        """
        group_out = self._group_values()
        if into is None:
            into = ServerLayers(*(np.empty(self._fleet.servers, self._dtype) for _ in range(3)))
        expand = self._thermal.expand_kernel(self._precision)
        layers = (into.inlet_c, into.outlet_c, into.power_w)
        expand(self._server_slices, self._fleet.server_start, group_out, *layers)
        return into

    def group_inlets(self) -> F64:
        """Inlet of every server group in the last step, (G,)."""
        return self._group_values()[0].astype(np.float64)

    def _group_values(self) -> Any:
        if self._solved is None:
            raise RuntimeStateError("no step has been done yet; server layers exist after one")
        group_out = np.empty((len(self._thermal.GROUP_OUT), self._groups.shape[1]), self._dtype)
        self._run(self._out(), group_out, advance=False, transient=self._solved)
        return group_out

    def forget(self) -> None:
        """Drop the last step, so that ``servers`` cannot show layers of another state."""
        self._solved = None

    def settle(self, met: Conditions) -> HallState:
        """State of transient halls that have been in the given conditions for ever."""
        self.solve(met)
        self._server_c = self._real(np.zeros(self._groups.shape[1]))
        self._doubles[0], self._doubles[1], self._doubles[2] = 0.0, 1.0, 0.0
        self._settle_servers()
        return self._state()

    def _settle_servers(self) -> None:
        # A substep that lasts for ever brings servers to their steady temperatures.
        mixed, fresh = self._rack_state[0].copy(), self._unit_state[1].copy()
        supply_c = self._unit_state[0].copy()
        self._run(self._out(), advance=True, transient=True, substep_s=1e9)
        self._rack_state[0], self._unit_state[1], self._unit_state[0] = mixed, fresh, supply_c
        self._rack_state[1] = self._rack_state[2]

    def advance(
        self, met: Conditions, state: HallState, coil: Coil, step_s: float, substep_s: float
    ) -> tuple[HallSums, HallState]:
        """One step of transient halls, in equal substeps of at most ``substep_s``.

        Args:
            met: load and what is out of order; supply air follows from the coil.
            state: memory at the start of the step.
            coil: setpoints, heat held by the room and what the plant can take.
            step_s: length of the step.
            substep_s: longest substep.

        Returns:
            Means over the step, and the memory at its end.
        """
        self._set(met)
        self._server_c = state.server_c.copy()
        self._rack_state[0], self._rack_state[1] = state.mixed_c, state.exhaust_c
        self._rack_state[3] = state.captured_m3s
        speed = np.clip(state.following, self._units[1], self._units[2])
        fresh_share = self._fleet.dcs[self._fresh_row][self._fleet.unit_dc]
        offered = fresh_share * self._fleet.unit_design_m3s * speed
        self._unit_state[1] = np.minimum(1.0, offered / np.maximum(state.need_m3s, 1e-30))
        self._units[0] = coil.setpoint_c
        rows = (coil.room_j, coil.room_j_per_k, coil.limit_w, coil.fan_w_per_m3s)
        for row, values in enumerate(rows):
            self._doubles[row] = values
        warmed = (coil.room_j / coil.room_j_per_k)[self._fleet.unit_dc]
        self._unit_state[0] = coil.setpoint_c + warmed
        count = int(np.ceil(step_s / substep_s - 1e-9))
        out = self._out()
        for i in range(count):
            self._run(
                out,
                advance=True,
                transient=True,
                source=i % 2,
                first=i == 0,
                substep_s=step_s / count,
                weight=1.0 / count,
            )
        if count % 2:
            self._rack_state[1] = self._rack_state[2]
        self._solved = True
        return self._results(out), self._state()

    def _state(self) -> HallState:
        return HallState(
            server_c=self._server_c.copy(),
            mixed_c=self._rack_state[0].copy(),
            exhaust_c=self._rack_state[1].copy(),
            captured_m3s=self._rack_state[3].copy(),
            need_m3s=self._unit_state[5].copy(),
            following=self._unit_state[6].copy(),
        )

    def _set(self, met: Conditions) -> None:
        def put(rows: Any, row: int, values: F64 | None) -> None:
            rows[row] = 1.0 if values is None else values

        self._group_loads = met.group_load is not None
        if met.group_load is not None:
            self._groups[6] = met.group_load
        elif met.rack_load is not None:
            self._racks[2] = met.rack_load
        else:
            self._racks[2] = met.utilisation[self._fleet.rack_dc]
        put(self._racks, 3, met.powered)
        put(self._racks, 4, met.rack_airflow)
        put(self._units, 1, met.unit_low)
        put(self._units, 2, met.unit_high)
        put(self._units, 4, met.unit_running)
        self._unit_state[0] = met.unit_supply_c

    def _out(self) -> tuple[Any, Any]:
        racks = np.empty((len(self._thermal.RACK_OUT), self._fleet.racks), self._dtype)
        return racks, np.empty((len(self._thermal.DC_OUT), self._fleet.size), np.float64)

    def _run(
        self,
        out: tuple[Any, Any],
        group_out: Any = None,
        *,
        advance: bool,
        transient: bool = False,
        source: int = 0,
        first: bool = True,
        substep_s: float = 1.0,
        weight: float = 1.0,
    ) -> None:
        runtime.ensure_started()
        racks, dcs = out
        self._kernel(
            self._recirculates,
            transient,
            self._outlet_model,
            self._group_loads,
            group_out is not None,
            advance,
            self._slices,
            source,
            int(source == 0 and first),
            int(first),
            substep_s,
            weight,
            TOLERANCE_K[self._precision],
            self._rack_ints,
            self._run_ints,
            self._chunk_ints,
            self._dc_ints,
            self._active,
            self._weights,
            self._shares,
            self._racks,
            self._groups,
            self._dcs,
            self._doubles,
            self._units,
            self._unit_state,
            self._rack_state,
            self._server_c,
            self._fit,
            racks,
            self._no_groups if group_out is None else group_out,
            self._needs,
            self._sums,
            dcs,
        )

    def _results(self, out: tuple[Any, Any]) -> HallSums:
        racks, dcs = out
        named = dict(zip(self._thermal.DC_OUT, dcs, strict=True))
        return HallSums(
            **{**named, "hottest_group": named["hottest_group"].astype(np.int64)},
            unit_flow_m3s=self._unit_state[3].copy(),
            unit_cubed_speed=self._unit_state[4].copy(),
            room_j=self._doubles[0].copy(),
            **{
                f"rack_{name}": row for name, row in zip(self._thermal.RACK_OUT, racks, strict=True)
            },
        )


def _table(*rows: Any) -> Any:
    """Rows of indices, those without a closing entry padded, as the kernel takes them."""
    length = max(len(r) for r in rows)
    out = np.zeros((len(rows), length), np.int32)
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out
