"""The halls of a fleet on the thermal kernel: supply air and load in, temperatures out."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from sdc_taichi import runtime
from sdc_taichi.errors import RuntimeStateError, SdcError
from sdc_taichi.fleet import LOADS, Fleet, starts
from sdc_taichi.types import F64, I64, Reals, ServerLayers

Precision = Literal["f32", "f64"]

_RELEASED_OUTLET_FIT = (1.918, 1.096, 0.526, 0.824, -14.01)
"""Rack outlet fit of the released SustainDC: factor, power exponent, divisor, flow exponent, K."""

_BLOCKS_PER_CHUNK = 8
"""Fewer racks than in so many blocks are not worth a thread of their own."""

TOLERANCE_K: dict[Precision, float] = {"f32": 1e-4, "f64": 1e-12}
"""How little another sweep would move the exhaust mix before any rack."""
MOST_SWEEPS = 2000
"""Steady states take 2 to 40 sweeps, and some hundred where the CRAC units give a tenth of the air
that the servers draw."""


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
    """What each rack gives to the exhaust mixes, times its strength: its outlet, and for the share
    of its air that failing fans do not move the mix before it, (R,)."""
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
    """Plain mean over the racks of ``rack_inlet_c``, as ``outlet_mean_c`` of ``rack_outlet_c``."""
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
    """Mean over the servers, weighted by airflow with inlet model ``recirculation``."""
    rack_inlet_max_c: Reals
    rack_outlet_c: Reals


class Hall:
    """Kernel arguments of a fleet: plain arrays, given back with the object."""

    def __init__(self, fleet: Fleet, precision: Precision) -> None:
        threads = runtime.ensure_started()
        from sdc_taichi.kernels import thermal
        from sdc_taichi.kernels.backend import BoundKernel

        self._thermal = thermal
        self._precision: Precision = precision
        self._dtype = np.dtype(np.float32 if precision == "f32" else np.float64)
        self._fleet = fleet
        self._kernel = BoundKernel(thermal.hall_kernel(precision), thermal.HALL_TEMPLATES)
        self._outlet_model = thermal.OUTLETS.index(fleet.models["outlet"])
        self._recirculates = fleet.air is not None
        self._server_slices = max(1, min(8 * threads, fleet.servers // 4096))
        self._lay_out_racks(thermal.LANES, 8 * threads)
        self._lay_out_groups(thermal)
        self._lay_out_air(thermal)
        self._lay_out_values(thermal)
        self._slices = max(1, min(8 * threads, len(self._tasks) - 1))
        self._solved: bool | None = None
        """Whether the last step was transient; None without one."""

    def _lay_out_racks(self, lanes: int, slices: int) -> None:
        """Blocks of racks, each data center filled up to whole ones, and chunks of blocks."""
        fleet = self._fleet
        racks = np.diff(fleet.rack_start)
        self._blocks = -(-racks // lanes)
        first_block = starts(self._blocks, "blocks of racks")
        within = np.arange(fleet.racks) - np.repeat(fleet.rack_start[:-1], racks)
        self._rack_at = lanes * np.repeat(first_block[:-1], racks) + within
        self._places = int(lanes * first_block[-1])
        self._same_size = int(racks[0]) if np.all(racks == racks[0]) else None
        chunks = [np.arange(a, b, _BLOCKS_PER_CHUNK) for a, b in pairwise(first_block)]
        per_dc = np.array([len(c) for c in chunks])
        chunk_dc = np.repeat(np.arange(fleet.size), per_dc)
        # Data centers of up to a slice are one task, larger ones a task per chunk.
        whole = per_dc * slices <= max(per_dc.sum(), slices)
        chunk_starts_task = ~np.repeat(whole, per_dc)
        chunk_starts_task[np.cumsum(per_dc) - per_dc] = True
        self._tasks = np.append(np.flatnonzero(chunk_starts_task), per_dc.sum()).astype(np.int32)
        first_need = starts(np.diff(fleet.unit_start)[chunk_dc], "needs of chunks")
        self._chunk_ints = _table(np.concatenate([*chunks, first_block[-1:]]), chunk_dc, first_need)
        self._needs = np.zeros(max(int(first_need[-1]), 1))
        units = np.diff(fleet.unit_start)
        first_share = starts(self._blocks * units, "unit shares of blocks")
        self._dc_ints = _table(starts(per_dc, "chunks"), fleet.unit_start, first_share, racks)

    def _lay_out_groups(self, thermal: Any) -> None:
        """Places of the groups, lane by lane, and the tables that equal blocks share."""
        fleet, lanes = self._fleet, thermal.LANES
        block, lane = np.divmod(self._rack_at, lanes)
        groups = np.diff(fleet.group_start)
        most = np.zeros(int(self._blocks.sum()), np.int64)
        np.maximum.at(most, block, groups)
        first_place = starts(most, "groups of blocks")
        zone = np.arange(fleet.groups.shape[1]) - np.repeat(fleet.group_start[:-1], groups)
        self._group_at = (
            np.repeat(lanes * first_place[block] + lane, groups) + lanes * zone
        ).astype(np.int32)
        count = lanes * int(first_place[-1])
        self._group_of = np.zeros(count, np.int64)
        self._group_of[self._group_at] = np.arange(len(self._group_at))
        values = np.zeros((len(thermal.GROUP_ROWS), count), self._dtype)
        values[:, self._group_at] = fleet.groups
        # Places without a rack take the values of the last rack of their block, and no power.
        filled = np.bincount(block, minlength=len(most))
        last = (np.repeat(filled, most) - 1)[:, None]
        values = values.reshape(len(values), -1, lanes)
        values = np.take_along_axis(values, np.minimum(np.arange(lanes), last)[None], axis=2)
        by_place = np.ascontiguousarray(values.swapaxes(0, 1))
        known: dict[bytes, int] = {}
        tables, table, total = [], np.zeros(len(most), np.int64), 0
        for i, (a, b) in enumerate(pairwise(first_place)):
            key = by_place[a:b].tobytes()
            if key not in known:
                known[key] = total
                tables.append(by_place[a:b].reshape(-1, lanes))
                total += int(b - a)
            table[i] = known[key]
        self._tables = np.concatenate(tables).reshape(-1)
        self._block_ints = _table(filled, most, table, first_place[:-1])
        self._server_c = np.zeros((int(first_place[-1]), lanes), self._dtype)
        self._group_load = np.zeros((1, lanes), self._dtype)
        self._group_out: Any = None
        self._no_groups = np.zeros((len(thermal.GROUP_OUT), 1, lanes), self._dtype)

    def _lay_out_air(self, thermal: Any) -> None:
        """Runs of weights and unit shares at the places of the racks."""
        fleet, air, lanes = self._fleet, self._fleet.air, thermal.LANES
        run_counts = np.zeros(self._places, np.int64)
        zeros = np.zeros(1, np.int32)
        if air is None:
            self._run_start = starts(run_counts, "runs of weights")
            self._run_ints = _table(zeros, zeros, zeros)
            self._weights = self._real(np.zeros(1))
            self._shares = self._real(np.zeros((1, lanes)))
            return
        run_counts[self._rack_at] = np.diff(air.run_start)
        self._run_start = starts(run_counts, "runs of weights")
        moved = self._rack_at[fleet.rack_start[:-1]] - fleet.rack_start[:-1]
        first = air.run_first + np.repeat(moved[fleet.rack_dc], np.diff(air.run_start))
        self._run_ints = _table(first, air.run_length, air.run_offset)
        self._weights = self._real(air.weights)
        shares = []
        for dc, (racks, units) in enumerate(
            zip(np.diff(fleet.rack_start), np.diff(fleet.unit_start), strict=True)
        ):
            own = np.zeros((int(self._blocks[dc]) * lanes, int(units)))
            at = air.share_start[dc]
            own[:racks] = air.unit_shares[at : at + racks * units].reshape(racks, units)
            shares.append(own.reshape(-1, lanes, int(units)).swapaxes(1, 2).reshape(-1, lanes))
        self._shares = self._real(np.concatenate(shares))

    def _lay_out_values(self, thermal: Any) -> None:
        fleet, air = self._fleet, self._fleet.air
        blocks = self._places // thermal.LANES
        self._racks = np.ones((len(thermal.RACK_ROWS), self._places), self._dtype)
        self._rack_blocks = self._racks.reshape(len(self._racks), -1, thermal.LANES)
        self._rack = dict(zip(thermal.RACK_ROWS, self._racks, strict=True))
        self._is_rack = np.zeros(self._places, self._dtype)
        self._is_rack[self._rack_at] = 1.0
        for name in ("powered", "airflow"):
            self._rack[name][:] = self._is_rack
        self._of_a_step: set[str] = set()
        """Of these two, what the last step set to other values."""
        rows = {"approach_k": fleet.approach_k, "servers": fleet.group_sums(fleet.groups[0])}
        if air is not None:
            rows |= {
                "norm": air.norm,
                "strength": air.strength,
                "per_strength": 1.0 / air.strength,
                "captured": air.captured,
                "start_approach_k": fleet.approach_k,
                "start_rise_k": air.rise_k,
                "mixed_approach_k": air.mixed_approach_k,
                "mixed_rise_k": air.mixed_rise_k,
            }
        for name, values in rows.items():
            self._rack[name][self._rack_at] = values
        self._dcs = self._real(fleet.dcs)
        self._doubles = np.zeros((len(thermal.DC_DOUBLES), fleet.size))
        self._dc = dict(zip(thermal.DC_DOUBLES, self._doubles, strict=True))
        self._dc["it_airflow_m3s"][:] = fleet.it_airflow_m3s
        self._controls = np.zeros((len(thermal.CONTROL), fleet.size), np.int32)
        self._control = dict(zip(thermal.CONTROL, self._controls, strict=True))
        self._units = self._real(np.ones((len(thermal.UNIT_ROWS), fleet.units)))
        self._unit = dict(zip(thermal.UNIT_ROWS, self._units, strict=True))
        self._unit["design_m3s"][:] = fleet.unit_design_m3s
        self._unit_state = np.ones((len(thermal.UNIT_STATE), fleet.units))
        self._supply = dict(zip(thermal.UNIT_STATE, self._unit_state, strict=True))
        fresh_share = thermal.DC_ROWS.index("fresh_share")
        self._fresh_m3s = fleet.dcs[fresh_share][fleet.unit_dc] * fleet.unit_design_m3s
        state = (len(thermal.RACK_STATE), blocks, thermal.LANES)
        self._rack_store = np.zeros(state, self._dtype)
        self._rack_state = self._rack_store.reshape(len(self._rack_store), -1)
        self._flat_state = self._rack_store.reshape(-1)
        self._memory = dict(zip(thermal.RACK_STATE, self._rack_state, strict=True))
        self._constants = self._real(
            np.array([*_RELEASED_OUTLET_FIT, *thermal.exp_constants(self._precision)])
        )
        self._sums = np.zeros((len(thermal.SUMS), self._chunk_ints.shape[1] - 1))

    def _real(self, values: F64) -> Any:
        return np.array(values, dtype=self._dtype, order="C")

    def _at_racks(self, rows: Any) -> Any:
        """Values of the racks, (..., R), of rows by place."""
        rows = rows.reshape(*rows.shape[:-1], -1) if rows.ndim < 3 else rows.reshape(len(rows), -1)
        if self._same_size is None:
            return rows[..., self._rack_at]
        size = self._fleet.size
        return rows.reshape(*rows.shape[:-1], size, -1)[..., : self._same_size].reshape(
            *rows.shape[:-1], -1
        )

    def _put(self, row: Any, values: Any) -> None:
        """Values of the racks, (R,), to their places."""
        if self._same_size is None:
            row[self._rack_at] = values
        else:
            size = self._fleet.size
            row.reshape(size, -1)[:, : self._same_size] = values.reshape(size, -1)

    def solve(self, met: Conditions) -> HallSums:
        """Quasi-steady temperatures and power.

        Args:
            met: supply air, load and what is out of order.

        Raises:
            SdcError: no steady state, as when no unit moves air, or conditions that are not finite.
        """
        self._set(met)
        self._supply["fresh_ratio"][:] = 1.0
        self._begin(exchange=0)
        out = self._out()
        if self._recirculates:
            self._guess(met)
            self._sweep(out, MOST_SWEEPS)
            ended = self._control["active"]
            if np.any(ended < 0):
                raise SdcError(
                    f"{self._fleet.names[int(np.argmin(ended))]}: no steady air temperatures in "
                    f"{MOST_SWEEPS} sweeps; the CRAC units move too little air: raise "
                    "hvac.crac.coasting_flow_ratio or min_flow_ratio, or set "
                    "simulation.thermal=transient"
                )
        else:
            self._run(out, advance=False)
        self._solved = False
        return self._results(out)

    def _begin(self, exchange: int) -> None:
        """The first sweep exchanges what the exhaust row holds, or starts from ``_guess``."""
        first = {"active": 1, "exchange": exchange, "side": exchange, "sweep": 0, "chunks": 0}
        for name, flag in first.items():
            self._control[name][:] = flag
        for name in ("shift_k", "moved_k", "shifted_k"):
            self._dc[name][:] = 0.0

    def _guess(self, met: Conditions) -> None:
        """Outlets to start from: the racks of the design point, moved as a mean rack would be.

        By the supply air of the first unit, which tells where the others are near enough to start.
        """
        fleet, air = self._fleet, self._fleet.air
        assert air is not None
        supply_c = met.unit_supply_c[fleet.unit_start[:-1]]
        grid = air.supply_c[air.table]
        low, high, last = grid[:, 0], grid[:, -1], grid.shape[1] - 1
        y = np.clip((supply_c - low) / np.maximum(high - low, 1e-9), 0.0, 1.0) * last
        x = np.clip(met.utilisation, 0.0, 1.0) * (len(LOADS) - 1)
        i = np.minimum(y.astype(np.int64), last - 1)
        j = np.minimum(x.astype(np.int64), len(LOADS) - 2)
        rows, columns = (
            np.clip(at[:, None] + np.arange(-1, 3), 0, most)
            for at, most in ((i, last), (j, len(LOADS) - 1))
        )
        at = ((air.table * (last + 1))[:, None] + rows)[:, :, None] * len(LOADS) + columns[:, None]
        weights = _cubic(y - i)[:, :, None] * _cubic(x - j)[:, None, :]
        found = np.matmul(weights.reshape(-1, 1, 16), air.expected[at.reshape(-1, 16)])[:, 0]
        for name, values in zip(("start_scale", "start_warming", "kept"), found.T, strict=True):
            self._dc[name][:] = values
        self._dc["start_c"][:] = supply_c

    def _sweep(self, out: tuple[Any, Any], sweeps: int, **how: Any) -> None:
        """Call the kernel until every data center has come to its end."""
        active = self._control["active"]
        while np.any(active > 0):
            self._run(out, advance=True, sweeps=sweeps, **how)

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
        per_word = 8 // self._dtype.itemsize
        whole = self._fleet.servers // per_word * per_word
        words = [layer[:whole].view(np.float64) if whole else np.zeros(1) for layer in layers]
        expand(
            self._server_slices,
            self._fleet.server_start,
            self._group_at,
            group_out.reshape(len(group_out), -1),
            *layers,
            *words,
        )
        return into

    def group_inlets(self) -> F64:
        """Inlet of every server group in the last step, (G,)."""
        inlets = self._group_values()[0].reshape(-1)[self._group_at]
        return np.asarray(inlets, dtype=np.float64)

    def _group_values(self) -> Any:
        if self._solved is None:
            raise RuntimeStateError("no step has been done yet; server layers exist after one")
        if self._group_out is None:
            shape = (len(self._thermal.GROUP_OUT), *self._server_c.shape)
            self._group_out = np.empty(shape, self._dtype)
        self._control["active"][:] = 1
        self._run(self._out(), self._group_out, advance=False, transient=self._solved)
        return self._group_out

    def forget(self) -> None:
        """Drop the last step, so that ``servers`` cannot show layers of another state."""
        self._solved = None

    def settle(self, met: Conditions) -> HallState:
        """State of transient halls that have been in the given conditions for ever."""
        self.solve(met)
        for name, value in (("room_j", 0.0), ("room_j_per_k", 1.0), ("coil_limit_w", 0.0)):
            self._dc[name][:] = value
        self._server_c[:] = 0.0
        # A substep that lasts for ever brings servers to their steady temperatures; what it makes
        # of the air is not wanted.
        kept = [self._memory["mixed_c"], self._supply["fresh_ratio"], self._supply["supply_c"]]
        steady = [row.copy() for row in kept]
        self._memory["exhaust_c"][:] = self._exhaust()
        self._begin(exchange=1)
        self._sweep(self._out(), 1, transient=True, substep_s=1e9)
        for row, values in zip(kept, steady, strict=True):
            row[:] = values
        return self._state()

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
        fleet = self._fleet
        self._set(met)
        self._server_c.reshape(-1)[self._group_at] = state.server_c
        for name in ("mixed_c", "exhaust_c", "captured_m3s"):
            self._put(self._memory[name], getattr(state, name))
        low, high = (self._unit[name] for name in ("low", "high"))
        speed = np.clip(state.following, low, high)
        covers = self._fresh_m3s * speed / np.maximum(state.need_m3s, 1e-30)
        self._supply["fresh_ratio"][:] = np.minimum(1.0, covers)
        flow_m3s = fleet.unit_sums(fleet.unit_design_m3s * speed)
        self._dc["stirring_m3s"][:] = flow_m3s / np.diff(fleet.rack_start)
        self._unit["setpoint_c"][:] = coil.setpoint_c
        for name, values in (
            ("room_j", coil.room_j),
            ("room_j_per_k", coil.room_j_per_k),
            ("coil_limit_w", coil.limit_w),
            ("crac_fan_w_per_m3s", coil.fan_w_per_m3s),
        ):
            self._dc[name][:] = values
        warmed = (coil.room_j / coil.room_j_per_k)[fleet.unit_dc]
        self._supply["supply_c"][:] = coil.setpoint_c + warmed
        count = int(np.ceil(step_s / substep_s - 1e-9))
        out = self._out()
        self._begin(exchange=1)
        self._sweep(out, count, transient=True, substep_s=step_s / count, weight=1.0 / count)
        self._solved = True
        return self._results(out), self._state()

    def _exhaust(self) -> Any:
        """What the racks gave to the mixes in the last sweep, times strength, by place."""
        side = np.repeat(self._control["side"], self._thermal.LANES * self._blocks)
        return np.where(side == 0, self._memory["exhaust_odd_c"], self._memory["exhaust_c"])

    def _state(self) -> HallState:
        return HallState(
            server_c=self._server_c.reshape(-1)[self._group_at],
            mixed_c=self._at_racks(self._memory["mixed_c"]).copy(),
            exhaust_c=self._at_racks(self._exhaust()).copy(),
            captured_m3s=self._at_racks(self._memory["captured_m3s"]).copy(),
            need_m3s=self._supply["need_m3s"].copy(),
            following=self._supply["following"].copy(),
        )

    def _set(self, met: Conditions) -> None:
        for f in fields(met):
            given = getattr(met, f.name)
            if given is not None and not np.isfinite(np.sum(given)):
                raise SdcError(f"conditions: {f.name} is not finite; valid are finite numbers")
        self._group_loads = met.group_load is not None
        if met.group_load is not None:
            if self._group_load.size < self._server_c.size:
                self._group_load = np.zeros_like(self._server_c)
            self._group_load.reshape(-1)[self._group_at] = met.group_load
        elif met.rack_load is not None:
            self._put(self._rack["load"], met.rack_load)
        elif self._same_size is not None:
            loads = self._rack["load"].reshape(self._fleet.size, -1)
            loads[:] = met.utilisation[:, None]
        else:
            loads = self._rack["load"]
            loads[self._rack_at] = met.utilisation[self._fleet.rack_dc]
        for name, values in (("powered", met.powered), ("airflow", met.rack_airflow)):
            row = self._rack[name]
            if values is not None:
                self._put(row, values)
                self._of_a_step.add(name)
            elif name in self._of_a_step:
                row[:] = self._is_rack
                self._of_a_step.remove(name)
        limits = (("low", met.unit_low), ("high", met.unit_high), ("running", met.unit_running))
        for name, given in limits:
            self._unit[name][:] = 1.0 if given is None else given
        self._supply["supply_c"][:] = met.unit_supply_c

    def _out(self) -> tuple[Any, Any]:
        shape = (len(self._thermal.RACK_OUT), *self._rack_store.shape[1:])
        racks = np.empty(shape, self._dtype)
        return racks, np.empty((len(self._thermal.DC_OUT), self._fleet.size), np.float64)

    def _run(
        self,
        out: tuple[Any, Any],
        group_out: Any = None,
        *,
        advance: bool,
        transient: bool = False,
        sweeps: int = 1,
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
            sweeps,
            substep_s,
            weight,
            TOLERANCE_K[self._precision],
            self._tasks,
            self._run_start,
            self._run_ints,
            self._block_ints,
            self._chunk_ints,
            self._dc_ints,
            self._controls,
            self._weights,
            self._shares,
            self._rack_blocks,
            self._tables,
            self._group_load,
            self._dcs,
            self._doubles,
            self._units,
            self._unit_state,
            self._flat_state,
            self._rack_store,
            self._server_c,
            self._constants,
            racks,
            self._no_groups if group_out is None else group_out,
            self._needs,
            self._sums,
            dcs,
        )

    def _results(self, out: tuple[Any, Any]) -> HallSums:
        racks, dcs = self._at_racks(out[0]), out[1]
        finite = np.isfinite(dcs).all(axis=0)
        if not finite.all():
            raise SdcError(
                f"{self._fleet.names[int(np.argmin(finite))]}: temperatures or power of the hall "
                "are beyond any number; valid are smaller powers or larger airflows"
            )
        named = dict(zip(self._thermal.DC_OUT, dcs, strict=True))
        return HallSums(
            **{**named, "hottest_group": self._group_of[named["hottest_group"].astype(np.int64)]},
            unit_flow_m3s=self._supply["flow_m3s"].copy(),
            unit_cubed_speed=self._supply["cubed_speed"].copy(),
            room_j=self._dc["room_j"].copy(),
            **{
                f"rack_{name}": row for name, row in zip(self._thermal.RACK_OUT, racks, strict=True)
            },
        )


def _cubic(x: F64) -> F64:
    """Weights of four points for the place x between the inner two (Catmull and Rom 1974).

    Racks loaded alike take 1.4 sweeps in f32 from here, 1.9 from a straight line.
    """
    return np.stack(
        [
            0.5 * x * (x * (2.0 - x) - 1.0),
            0.5 * (x * x * (3.0 * x - 5.0) + 2.0),
            0.5 * x * (x * (4.0 - 3.0 * x) + 1.0),
            0.5 * x * x * (x - 1.0),
        ],
        axis=-1,
    )


def _table(*rows: Any) -> Any:
    """Rows of indices, those without a closing entry padded, as the kernel takes them."""
    length = max(len(r) for r in rows)
    out = np.zeros((len(rows), length), np.int32)
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out
