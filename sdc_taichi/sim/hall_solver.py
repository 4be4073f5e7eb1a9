"""The halls of a fleet on the thermal kernel: supply air and load in, temperatures out."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise
from math import isfinite
from typing import Any, Literal

import numpy as np

from sdc_taichi.errors import RuntimeStateError, SdcError
from sdc_taichi.hall.initial_guess import TABLE_LOADS
from sdc_taichi.hall.mix_weights import DENSE_RACKS
from sdc_taichi.kernels.compiler import runtime
from sdc_taichi.sim.fleet import Fleet, offsets_from_counts
from sdc_taichi.types import F64, Reals, ServerLayers

Precision = Literal["f32", "f64"]

_RELEASED_OUTLET_FIT = (1.918, 1.096 - 1.0, 0.526, 0.824 - 1.0, -14.01)
"""Rack outlet fit of the released SustainDC: factor, exponent of power over 1, divisor, exponent of
flow over 1, K."""

_SERIAL_GROUPS = 8192
"""Up to so many places of groups, counted again in every substep, or servers of layers: waking a
second thread takes longer."""

TOLERANCE_K: dict[Precision, float] = {"f32": 1e-4, "f64": 1e-12}
"""How little another sweep would move the exhaust mix before any rack."""
MOST_SWEEPS = 2000
"""Steady states take 2 to 40 sweeps, and some hundred where the CRAC units give a tenth of the air
that the servers draw."""


@dataclass(slots=True)
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


@dataclass
class HallSums:
    """Sums and means of one evaluation: (B,) per data center, (R,) per rack."""

    cpu_w: F64
    it_fan_w: F64
    it_airflow_m3s: F64
    inlet_mean_c: F64
    """Plain mean over the racks of ``rack_inlet_c``, as ``outlet_mean_c`` of ``rack_outlet_c``."""
    inlet_max_c: F64
    outlet_mean_c: F64
    inlet_m3k_s: F64
    """Airflow times inlet temperature over supply."""
    outlet_m3k_s: F64
    """Airflow times outlet temperature over supply."""
    over_27_sum_k: F64
    """Sum over the servers of what their inlets exceed 27 C by."""
    under_18_sum_k: F64
    """Sum over the servers of what their inlets fall short of 18 C by."""
    hottest_rack: F64
    """Rack with the hottest inlet, counted from 0 in its data center."""
    hottest_server: F64
    """First server of the group with the hottest inlet, counted from 0 in its rack."""
    thermal_storage_w: F64
    """Heat that goes into servers and recirculated air."""
    supply_c: F64
    """Airflow-weighted mean over the units."""
    crac_flow_m3s: F64
    """0 with inlet model ``approach``, as the next."""
    return_c: F64
    cooling_load_w: F64
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
        from sdc_taichi.kernels import decay, hall, layers, thermal
        from sdc_taichi.kernels.compiler.arrays import aligned
        from sdc_taichi.kernels.compiler.launch import BoundKernel

        self._thermal, self._aligned = thermal, aligned
        self._precision: Precision = precision
        self._dtype = np.dtype(np.float32 if precision == "f32" else np.float64)
        self._fleet = fleet
        self._kernel = BoundKernel(hall.hall_kernel(precision), hall.TEMPLATES)
        self._layers_kernel = BoundKernel(layers.layers_kernel(precision), layers.TEMPLATES)
        self._constants = self._real(
            np.array([*_RELEASED_OUTLET_FIT, *decay.decay_constants(precision)])
        )
        sizes = {"unit": fleet.units, "utilisation": fleet.size, "group": fleet.groups}
        self._shapes = {
            f.name: (sizes.get(f.name.split("_")[0], fleet.racks),) for f in fields(Conditions)
        }
        self._outlet_model = thermal.OUTLETS.index(fleet.models["outlet"])
        self._recirculates = fleet.air is not None
        self._lay_out_racks(thermal, 8 * threads)
        self._lay_out_groups(thermal)
        self._lay_out_air(thermal)
        self._lay_out_values(thermal)
        self._slices = max(1, min(8 * threads, len(self._tasks) - 1))
        self._scratch = self._lanes(self._slices * thermal.SCRATCH)
        self._group_values = self._lanes(len(thermal.GROUP_OUT), self._slices * self._most_groups)
        self._result_names = (*thermal.DC_OUT, *(f"rack_{name}" for name in thermal.RACK_OUT))
        self._was_transient: bool | None = None
        """Whether the last step was transient; None without one."""
        self._of_groups: tuple[ServerLayers, tuple[Any, ...]] | None = None
        """Layers of the groups, as such and as the kernel takes them, once they are asked for."""

    def _lay_out_racks(self, thermal: Any, slices: int) -> None:
        """Blocks of racks, each data center filled up to whole ones, and chunks of blocks."""
        fleet, lanes = self._fleet, thermal.LANES
        racks = np.diff(fleet.rack_offsets)
        self._blocks = -(-racks // lanes)
        if fleet.air is not None and racks.max() > DENSE_RACKS:
            # Runs of weights need all halls to begin where their vectors do.
            self._blocks = -(-self._blocks // thermal.RUN_BLOCKS) * thermal.RUN_BLOCKS
        first_block = offsets_from_counts(self._blocks, "blocks of racks")
        within = np.arange(fleet.racks) - np.repeat(fleet.rack_offsets[:-1], racks)
        self._rack_at = lanes * np.repeat(first_block[:-1], racks) + within
        self._places = int(lanes * first_block[-1])
        self._same_size = int(racks[0]) if np.all(racks == racks[0]) else None
        chunks = [np.arange(a, b, thermal.CHUNK_BLOCKS) for a, b in pairwise(first_block)]
        per_dc = np.array([len(c) for c in chunks])
        chunk_dc = np.repeat(np.arange(fleet.size), per_dc)
        # Data centers of up to a slice are one task, larger ones a task per chunk.
        whole = per_dc * slices <= max(per_dc.sum(), slices)
        chunk_starts_task = ~np.repeat(whole, per_dc)
        chunk_starts_task[np.cumsum(per_dc) - per_dc] = True
        self._tasks = np.append(np.flatnonzero(chunk_starts_task), per_dc.sum()).astype(np.int32)
        units = np.diff(fleet.unit_offsets)
        first_need = offsets_from_counts(units[chunk_dc], "needs of chunks")
        self._chunk_ints = _table(np.concatenate([*chunks, first_block[-1:]]), chunk_dc, first_need)
        self._needs = np.zeros(max(int(first_need[-1]), 1))
        first_share = offsets_from_counts(self._blocks * units, "unit shares of blocks")
        first_chunk = offsets_from_counts(per_dc, "chunks")
        self._dc_ints = np.zeros((len(thermal.DC_INTS), fleet.size + 1), np.int32)
        for row, values in enumerate((first_chunk, fleet.unit_offsets, first_share, racks)):
            self._dc_ints[row, : len(values)] = values

    def _lay_out_groups(self, thermal: Any) -> None:
        """Places of the groups, lane by lane, and the tables that equal blocks share."""
        fleet, lanes = self._fleet, thermal.LANES
        block = self._rack_at // lanes
        groups = np.diff(fleet.group_offsets)
        most = np.zeros(int(self._blocks.sum()), np.int64)
        np.maximum.at(most, block, groups)
        filled = np.bincount(block, minlength=len(most))
        first_rack = np.cumsum(filled) - filled
        # Places without a rack, and the closing entry, begin where the rack before them ends.
        rack = np.minimum(np.arange(lanes), filled[:, None]) + first_rack[:, None]
        first_group = fleet.group_offsets[np.append(rack, fleet.racks)]
        self._rack_ints = np.stack([first_group, fleet.server_offsets[first_group]])
        known: dict[Any, int] = {}
        alike: dict[int, slice] = {}
        tables, table, total = [], np.zeros(len(most), np.int64), 0
        for dc, (end, count) in enumerate(zip(np.cumsum(self._blocks), self._blocks, strict=True)):
            rows, blocks = fleet.group_rows[dc], slice(end - count, end)
            same = alike.setdefault(id(rows), blocks)
            if same != blocks:
                table[blocks] = table[same]
                continue
            group_0 = fleet.group_offsets[fleet.rack_offsets[dc]]
            for i in range(end - count, end):
                a, n = first_rack[i], filled[i]
                if n == 0:
                    continue
                ends = fleet.group_offsets[a : a + n + 1] - group_0
                values = rows[:, ends[0] : ends[-1]]
                key = (values.tobytes(), (ends - ends[0]).tobytes())
                if key not in known:
                    known[key] = total
                    zone = np.arange(most[i])
                    group = ends[:-1] + np.minimum(zone[:, None], np.diff(ends) - 1)
                    entry = np.zeros((most[i], len(rows), lanes), self._dtype)
                    entry[:, :, :n] = rows[:, group].swapaxes(0, 1)
                    entry[:, 1:, n:] = entry[:, 1:, n - 1 : n]
                    entry[:, 0, :n] *= zone[:, None] < np.diff(ends)
                    tables.append(entry)
                    total += int(most[i])
                table[i] = known[key]
        self._tables = self._lanes(total * len(thermal.GROUP_ROWS))
        self._tables[:] = np.concatenate(tables).reshape(self._tables.shape)
        first_place = offsets_from_counts(most, "groups of blocks")
        self._block_ints = _table(filled, most, table, first_place[:-1], [])
        self._laid_along = False
        self._group_places, self._most_groups = int(first_place[-1]), int(most.max())
        self._server_c = self._lanes(1)
        self._none = np.zeros(1, self._dtype)

    def _lay_out_along(self) -> None:
        """Tables along the racks, behind the others, which layers alone are computed from."""
        lanes = self._thermal.LANES
        block = dict(zip(self._thermal.BLOCK_INTS, self._block_ints, strict=True))
        tables = self._tables.reshape(-1, len(self._thermal.GROUP_ROWS), lanes)
        at, one, of_block = np.unique(block["table"], return_index=True, return_inverse=True)
        groups = block["groups"][one]
        vectors = -(-groups // lanes)
        first = len(tables) + offsets_from_counts(lanes * vectors, "groups along racks")
        along = self._lanes(int(first[-1]) * tables.shape[1])
        out = along.reshape(-1, *tables.shape[1:])
        out[: len(tables)] = tables
        for a, n, b, v in zip(at, groups, first[:-1], vectors, strict=True):
            zone = np.minimum(np.arange(lanes * v), n - 1)
            squares = tables[a : a + n][zone].reshape(v, lanes, -1, lanes)
            out[b : b + lanes * v] = squares.transpose(3, 0, 2, 1).reshape(-1, *out.shape[1:])
        self._kernel.release(self._tables)
        self._tables = along
        block["along"][:] = first[of_block]
        self._laid_along = True

    def _lay_out_air(self, thermal: Any) -> None:
        """Weights and unit shares at the places of the racks."""
        fleet, air, lanes = self._fleet, self._fleet.air, thermal.LANES
        mix = self._dc_ints[thermal.DC_INTS.index("mix")]
        mix[:] = -1
        self._lay_out_runs(thermal.RUN_LANES)
        if air is None:
            self._shares = self._lanes(1)
            self._mix = self._lanes(1, thermal.SOURCES).reshape(1, -1)
            self._starts = self._lanes(1)
            return
        shares, mixes, known, total = [], [], {}, 0
        for dc, (racks, units) in enumerate(
            zip(np.diff(fleet.rack_offsets), np.diff(fleet.unit_offsets), strict=True)
        ):
            own = np.zeros((int(self._blocks[dc]) * lanes, int(units)))
            at = air.unit_share_offsets[dc]
            own[:racks] = air.unit_shares[at : at + racks * units].reshape(racks, units)
            shares.append(own.reshape(-1, lanes, int(units)).swapaxes(1, 2).reshape(-1, lanes))
            if racks > DENSE_RACKS:
                continue
            entry = int(air.steady_state_of_dc[dc])
            if entry not in known:
                at_once = thermal.SOURCES
                whole = -(-int(racks) // at_once) * at_once
                weights = np.zeros((int(self._blocks[dc]) * lanes, whole))
                weights[:racks, :racks] = _dense(fleet, dc)
                by_block = weights.reshape(-1, lanes, whole).swapaxes(1, 2)
                mixes.append(by_block.reshape(-1, at_once * lanes))
                known[entry] = total
                total += len(mixes[-1])
            mix[dc] = known[entry]
        self._shares = self._lanes(sum(map(len, shares)))
        self._shares[:] = np.concatenate(shares)
        self._mix = self._lanes(max(total, 1), thermal.SOURCES).reshape(-1, thermal.SOURCES * lanes)
        if mixes:
            self._mix[:] = np.concatenate(mixes)
        self._lay_out_starts(thermal)

    def _lay_out_starts(self, thermal: Any) -> None:
        """Patterns of each distinct hall by block, and the table of how much of each."""
        air, lanes = self._fleet.air, thermal.LANES
        assert air is not None
        vectors, firsts = [], []
        total = 0
        first_dcs = np.unique(air.steady_state_of_dc, return_index=True)[1]
        for start, blocks in zip(air.steady_states, self._blocks[first_dcs], strict=True):
            patterns = np.zeros((thermal.PATTERNS, int(blocks) * lanes))
            patterns[: len(start.patterns), : start.patterns.shape[1]] = start.patterns
            shares = np.zeros((*start.feedback_gain.shape, lanes))
            shares[..., : start.pattern_shares.shape[2]] = start.pattern_shares
            shares[..., -1] = start.feedback_gain
            # Cubics reach one row and column beyond.
            beyond = ((1, 1), (1, 1), (0, 0))
            shares = np.pad(shares, beyond, mode="reflect", reflect_type="odd")
            patterns = patterns.reshape(-1, int(blocks), lanes).swapaxes(0, 1).reshape(-1, lanes)
            firsts.append((total, total + len(patterns), len(start.supply_c)))
            vectors += [patterns, shares.reshape(-1, lanes)]
            total += len(vectors[-2]) + len(vectors[-1])
        offsets_from_counts([total], "vectors of starts")
        self._starts = self._lanes(total)
        self._starts[:] = np.concatenate(vectors)
        rows = np.array(firsts)[air.steady_state_of_dc].T
        for name, values in zip(("pattern", "start", "start_rows"), rows, strict=True):
            self._dc_ints[thermal.DC_INTS.index(name), :-1] = values

    def _lay_out_runs(self, lanes: int) -> None:
        """Runs of weights in whole vectors, filled up with zeros, for halls of many racks."""
        fleet, air = self._fleet, self._fleet.air
        run_counts = np.zeros(self._places, np.int64)
        large = np.diff(fleet.rack_offsets)[fleet.rack_dc] > DENSE_RACKS
        if air is None or not large.any():
            self._run_start = offsets_from_counts(run_counts, "runs of weights")
            self._run_ints = np.zeros((3, 1), np.int32)
            self._weights = self._lanes(lanes).reshape(-1, lanes)[:1]
            return
        counts = np.diff(air.mix_weights.run_offsets)
        run_counts[self._rack_at[large]] = counts[large]
        self._run_start = offsets_from_counts(run_counts, "runs of weights")
        of_large = np.repeat(large, counts)
        moved = self._rack_at[fleet.rack_offsets[:-1]] - fleet.rack_offsets[:-1]
        first = (air.mix_weights.run_first_rack + np.repeat(moved[fleet.rack_dc], counts))[of_large]
        length, offset = (
            air.mix_weights.run_length[of_large],
            air.mix_weights.run_first_weight[of_large].astype(np.int64),
        )
        # Runs that share weights share their vectors where they begin at the same lane.
        lane = first % lanes
        key = (offset * (int(length.max()) + 1) + length) * lanes + lane
        _, one, same = np.unique(key, return_index=True, return_inverse=True)
        vectors = -(-(lane + length) // lanes)
        begin = offsets_from_counts(vectors[one], "vectors of weights")
        self._run_ints = _table(first // lanes, vectors, begin[same])
        weights = self._aligned((int(begin[-1]) * lanes,), self._dtype)
        weights[:] = 0.0
        within = np.arange(int(length[one].sum()))
        within -= np.repeat(np.cumsum(length[one]) - length[one], length[one])
        to = np.repeat(begin[:-1].astype(np.int64) * lanes + lane[one], length[one]) + within
        weights[to] = air.mix_weights.weights[np.repeat(offset[one], length[one]) + within]
        self._weights = weights.reshape(-1, lanes)

    def _lay_out_values(self, thermal: Any) -> None:
        fleet, air = self._fleet, self._fleet.air
        blocks = self._places // thermal.LANES
        self._rack_blocks = self._lanes(len(thermal.RACK_ROWS), blocks)
        self._racks = self._rack_blocks.reshape(len(self._rack_blocks), -1)
        self._rack = dict(zip(thermal.RACK_ROWS, self._racks, strict=True))
        self._is_rack = np.zeros(self._places, self._dtype)
        self._is_rack[self._rack_at] = 1.0
        for name in ("powered", "airflow"):
            self._rack[name][:] = self._is_rack
        self._of_a_step: set[str] = set()
        """Of these two, what the last step set to other values."""
        rows = {"approach_k": fleet.approach_k, "per_server": 1.0 / fleet.per_rack_servers()}
        if air is not None:
            rows |= {
                "norm": air.mix_weights.norm,
                "strength": air.mix_weights.strength,
                "per_strength": 1.0 / air.mix_weights.strength,
                "captured_share": air.exhaust_share,
            }
        for name, values in rows.items():
            self._rack[name][self._rack_at] = values
        self._dcs = self._real(fleet.dcs.T).reshape(-1)
        self._doubles = np.zeros((len(thermal.DC_DOUBLES), fleet.size))
        self._dc = dict(zip(thermal.DC_DOUBLES, self._doubles, strict=True))
        self._dc["design_it_airflow_m3s"][:] = fleet.it_airflow_m3s
        if air is not None:
            ends = np.array([start.supply_c[:2] for start in air.steady_states])[
                air.steady_state_of_dc
            ].T
            self._dc["start_low_c"][:] = ends[0]
            self._dc["start_per_k"][:] = 1.0 / (ends[1] - ends[0])
        self._moves = self._doubles[thermal.DC_DOUBLES.index("shift_k") :]
        self._controls = np.zeros((len(thermal.CONTROL), fleet.size), np.int32)
        self._control = dict(zip(thermal.CONTROL, self._controls, strict=True))
        self._units = self._real(np.ones((len(thermal.UNIT_ROWS), fleet.units)))
        self._unit = dict(zip(thermal.UNIT_ROWS, self._units, strict=True))
        self._unit["design_m3s"][:] = fleet.unit_design_m3s
        self._unit_state = np.ones((len(thermal.UNIT_STATE), fleet.units))
        self._supply = dict(zip(thermal.UNIT_STATE, self._unit_state, strict=True))
        fresh_share = thermal.DC_ROWS.index("fresh_share")
        self._fresh_m3s = fleet.dcs[fresh_share][fleet.unit_dc] * fleet.unit_design_m3s
        self._rack_store = self._lanes(len(thermal.RACK_STATE), blocks)
        self._rack_out = self._lanes(len(thermal.RACK_OUT), blocks)
        of_servers = thermal.OUTLETS.index("server")
        self._hands_out = self._places == fleet.racks and self._outlet_model == of_servers
        """Whether the racks' results are given away as they are; other outlets are read again."""
        self._rack_state = self._rack_store.reshape(len(self._rack_store), -1)
        self._sources = self._rack_store.reshape(-1, thermal.SOURCES)
        self._run_sources = self._rack_store.reshape(-1, thermal.RUN_LANES)
        self._memory = dict(zip(thermal.RACK_STATE, self._rack_state, strict=True))
        self._sums = np.zeros(len(thermal.SUMS) * (self._chunk_ints.shape[1] - 1))

    def _real(self, values: Reals) -> Any:
        return np.array(values, dtype=self._dtype, order="C")

    def _lanes(self, *shape: int) -> Any:
        """Zeros that the kernel takes as vectors of lanes."""
        out = self._aligned((*shape, self._thermal.LANES), self._dtype)
        out[:] = 0.0
        return out

    def _at_racks(self, rows: Any) -> Any:
        """Values of the racks, (n, R), of n rows by place; a copy."""
        rows, size = rows.reshape(len(rows), -1), self._fleet.size
        if self._same_size is None:
            return rows[:, self._rack_at]
        # The racks of a data center as one item, in a third of the time of one by one.
        apart, item = rows.strides[0], np.dtype((np.void, self._same_size * rows.itemsize))
        parts: Any = np.ndarray((len(rows), size), item, rows, strides=(apart, apart // size))
        return parts.copy().view(self._dtype)

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
        out = self._new_sums()
        if self._recirculates:
            self._sweep(out, MOST_SWEEPS)
            ended = self._control["active"]
            if np.minimum.reduce(ended) < 0:
                raise SdcError(
                    f"{self._fleet.names[int(np.argmin(ended))]}: no steady air temperatures in "
                    f"{MOST_SWEEPS} sweeps; the CRAC units move too little air: raise "
                    "hvac.crac.coasting_flow_ratio or min_flow_ratio, or set "
                    "simulation.thermal=transient"
                )
        else:
            self._run(out)
        return self._results(out, transient=False)

    def _begin(self, exchange: int) -> None:
        """The first sweep exchanges what the exhaust row holds, or starts as may be expected."""
        first = {"active": 1, "exchange": exchange, "side": exchange, "sweep": 0, "chunks": 0}
        self._controls[:] = [[first[name]] for name in self._thermal.CONTROL]
        self._moves[:] = 0.0

    def _sweep(self, out: F64, sweeps: int, **how: Any) -> None:
        """Call the kernel until every data center has come to its end."""
        active = self._control["active"]
        while np.maximum.reduce(active) > 0:
            self._run(out, sweeps=sweeps, **how)

    def servers(self, into: ServerLayers | None = None) -> ServerLayers:
        """Per-server layers of the last ``solve``, or the end of the last ``advance``, each (S,).

        Args:
            into: layers to overwrite and return; None allocates new ones.

        Raises:
            RuntimeStateError: before the first step.
            SdcError: layers of another shape, type or order, or that may not be written.
        """
        shape = (self._fleet.servers,)
        if into is None:
            into = ServerLayers(*(self._aligned(shape, self._dtype) for _ in range(3)))
        layers = [into.inlet_c, into.outlet_c, into.power_w]
        for name, layer in zip(("inlet_c", "outlet_c", "power_w"), layers, strict=True):
            has = layer.shape, layer.dtype, layer.flags.c_contiguous, layer.flags.writeable
            if has != (shape, self._dtype, True, True):
                raise SdcError(
                    f"layer {name}: {layer.dtype} {layer.shape}"
                    f"{'' if layer.flags.writeable else ', read-only'}; valid is a contiguous, "
                    f"writeable {self._dtype} {shape}"
                )
        lanes = self._thermal.LANES
        fit = [layer.ctypes.data % (lanes * layer.itemsize) == 0 for layer in layers]
        stored = [
            layer if fits else self._aligned(shape, self._dtype)
            for layer, fits in zip(layers, fit, strict=True)
        ]
        written = self._written(stored)
        self._write(written, each_once=0)
        self._layers_kernel.release(*written)
        for layer, values, fits in zip(layers, stored, fit, strict=True):
            if not fits:
                layer[:] = values
        return into

    def groups(self) -> ServerLayers:
        """As ``servers``, but of one server per group, (G,).

        The next call of this or of ``group_inlets`` overwrites them.

        Raises:
            RuntimeStateError: before the first step.
        """
        if self._of_groups is None:
            layers = [self._aligned((self._fleet.groups,), self._dtype) for _ in range(3)]
            self._of_groups = ServerLayers(*layers), self._written(layers)
        found, written = self._of_groups
        self._write(written, each_once=1)
        return found

    def group_inlets(self) -> F64:
        """Inlet of every server group in the last step, (G,)."""
        return self.groups().inlet_c.astype(np.float64)

    def _written(self, layers: list[Any]) -> tuple[Any, ...]:
        """Layers as the kernel takes them: whole, and as vectors of lanes."""
        lanes = self._thermal.LANES
        whole = len(layers[0]) // lanes * lanes
        blocks = (layer[:whole].reshape(-1, lanes) if whole else self._shares for layer in layers)
        return *layers, *blocks

    def _write(self, written: tuple[Any, ...], each_once: int) -> None:
        """Values of the last step to servers, or to each group once."""
        if self._was_transient is None:
            raise RuntimeStateError("no step has been done yet; server layers exist after one")
        runtime.ensure_started()
        if not self._laid_along:
            self._lay_out_along()
        self._layers_kernel(
            self._recirculates,
            self._was_transient,
            len(written[0]) <= _SERIAL_GROUPS,
            self._slices,
            self._outlet_model,
            self._loads_of,
            each_once,
            1,
            self._block_ints,
            self._rack_ints,
            self._chunk_ints,
            self._dc_ints,
            self._shares,
            self._rack_blocks,
            self._tables,
            self._loads,
            self._dcs,
            self._doubles,
            self._unit_state,
            self._rack_store,
            self._server_c,
            self._rack_out,
            self._group_values,
            *written,
        )
        if self._hands_out:
            # Whoever has the results of the step has these, and no other needs them.
            self._layers_kernel.release(self._rack_out)

    def forget(self) -> None:
        """Drop the last step, so that ``servers`` cannot show layers of another state."""
        self._was_transient = None

    def settle(self, met: Conditions) -> HallState:
        """State of transient halls that have been in the given conditions for ever."""
        self.solve(met)
        for name, value in (("room_j", 0.0), ("room_j_per_k", 1.0), ("coil_limit_w", 0.0)):
            self._dc[name][:] = value
        servers = np.zeros(self._fleet.groups, self._dtype)
        # A substep that lasts for ever brings servers to their steady temperatures; what it makes
        # of the air is not wanted.
        kept = [self._memory["mixed_c"], self._supply["fresh_ratio"], self._supply["supply_c"]]
        steady = [row.copy() for row in kept]
        self._memory["exhaust_c"][:] = self._exhaust()
        self._begin(exchange=1)
        self._sweep(self._new_sums(), 1, transient=True, servers=(servers, servers), substep_s=1e9)
        for row, values in zip(kept, steady, strict=True):
            row[:] = values
        self.forget()
        return self._state(servers)

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
        for name in ("mixed_c", "exhaust_c", "captured_m3s"):
            self._put(self._memory[name], getattr(state, name))
        low, high = (self._unit[name] for name in ("low", "high"))
        speed = np.clip(state.following, low, high)
        covers = self._fresh_m3s * speed / np.maximum(state.need_m3s, 1e-30)
        self._supply["fresh_ratio"][:] = np.minimum(1.0, covers)
        flow_m3s = fleet.unit_sums(fleet.unit_design_m3s * speed)
        self._dc["stirring_m3s"][:] = flow_m3s / np.diff(fleet.rack_offsets)
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
        out = self._new_sums()
        self._begin(exchange=1)
        before = np.ascontiguousarray(state.server_c, self._dtype)
        servers = np.empty(fleet.groups, self._dtype)
        self._sweep(
            out,
            count,
            transient=True,
            servers=(before, servers),
            substep_s=step_s / count,
            weight=1.0 / count,
        )
        self._kernel.release(before)
        return self._results(out, transient=True), self._state(servers)

    def _exhaust(self) -> Any:
        """What the racks gave to the mixes in the last sweep, times strength, by place."""
        side = self._control["side"]
        of_side = self._memory["exhaust_odd_c"], self._memory["exhaust_c"]
        # Mostly all data centers have exchanged equally often.
        if np.minimum.reduce(side) == np.maximum.reduce(side):
            return of_side[side[0]]
        return np.where(np.repeat(side, self._thermal.LANES * self._blocks) == 0, *of_side)

    def _state(self, servers: Any) -> HallState:
        return HallState(
            server_c=servers,
            mixed_c=self._at_racks(self._memory["mixed_c"][None])[0],
            exhaust_c=self._at_racks(self._exhaust()[None])[0],
            captured_m3s=self._at_racks(self._memory["captured_m3s"][None])[0],
            need_m3s=self._supply["need_m3s"].copy(),
            following=self._supply["following"].copy(),
        )

    def _set(self, met: Conditions) -> None:
        for name, shape in self._shapes.items():
            given = getattr(met, name)
            if given is None:
                continue
            if np.shape(given) != shape:
                raise SdcError(f"conditions: {name} has shape {np.shape(given)}; valid is {shape}")
            if not isfinite(np.add.reduce(given)):
                raise SdcError(f"conditions: {name} is not finite; valid are finite numbers")
        self.forget()
        self._loads_of, self._loads = self._thermal.OF_DATA_CENTERS, self._none
        self._dc["utilisation"][:] = met.utilisation
        if met.group_load is not None:
            self._loads_of = self._thermal.OF_GROUPS
            self._loads = self._real(met.group_load)
        elif met.rack_load is not None:
            self._loads_of = self._thermal.OF_RACKS
            self._put(self._rack["load"], met.rack_load)
        for name, values in (("powered", met.powered), ("airflow", met.rack_airflow)):
            row = self._rack[name]
            if values is not None:
                self._put(row, values)
                self._of_a_step.add(name)
            elif name in self._of_a_step:
                row[:] = self._is_rack
                self._of_a_step.remove(name)
        unit = self._unit
        unit["low"][:] = 1.0 if met.unit_low is None else met.unit_low
        unit["high"][:] = 1.0 if met.unit_high is None else met.unit_high
        unit["running"][:] = 1.0 if met.unit_running is None else met.unit_running
        self._supply["supply_c"][:] = met.unit_supply_c

    def _run(
        self,
        out: F64,
        *,
        transient: bool = False,
        sweeps: int = 1,
        substep_s: float = 1.0,
        weight: float = 1.0,
        servers: tuple[Any, Any] | None = None,
    ) -> None:
        runtime.ensure_started()
        places = self._group_places * self._thermal.LANES
        if transient and len(self._server_c) < self._group_places:
            self._server_c = self._lanes(self._group_places)
        self._kernel(
            self._recirculates,
            transient,
            places * (sweeps if transient else 1) <= _SERIAL_GROUPS,
            self._slices,
            sweeps,
            self._outlet_model,
            self._loads_of,
            len(TABLE_LOADS),
            1,
            substep_s,
            weight,
            TOLERANCE_K[self._precision],
            self._tasks,
            self._run_start,
            self._run_ints,
            self._block_ints,
            self._rack_ints,
            self._chunk_ints,
            self._dc_ints,
            self._controls,
            self._weights,
            self._mix,
            self._shares,
            self._rack_blocks,
            self._tables,
            self._loads,
            self._dcs,
            self._doubles,
            self._units,
            self._unit_state,
            self._starts,
            self._sources,
            self._run_sources,
            self._rack_store,
            self._server_c,
            *((self._none, self._none) if servers is None else servers),
            self._constants,
            self._scratch,
            self._rack_out,
            self._needs,
            self._sums,
            out,
        )

    def _new_sums(self) -> F64:
        if self._hands_out:
            self._rack_out = self._aligned(self._rack_out.shape, self._dtype)
        return np.empty((len(self._thermal.DC_OUT), self._fleet.size))

    def _results(self, dcs: F64, *, transient: bool) -> HallSums:
        racks = self._rack_out.reshape(len(self._rack_out), -1)
        if not self._hands_out:
            racks = self._at_racks(racks)
        if not isfinite(np.add.reduce(dcs, axis=None)):
            finite = np.isfinite(dcs).all(axis=0)
            raise SdcError(
                f"{self._fleet.names[int(np.argmin(finite))]}: temperatures or power of the hall "
                "are beyond any number; valid are smaller powers or larger airflows"
            )
        # From here on there is a step whose layers can be shown.
        self._was_transient = transient
        found = dict(zip(self._result_names, (*dcs, *racks), strict=True))
        return HallSums(
            unit_flow_m3s=self._supply["flow_m3s"].copy(),
            unit_cubed_speed=self._supply["cubed_speed"].copy(),
            room_j=self._dc["room_j"].copy(),
            **found,
        )


def _dense(fleet: Fleet, dc: int) -> F64:
    """Mix before every rack of a data center from what all its racks give, (R, R)."""
    air = fleet.air
    assert air is not None
    first, end = fleet.rack_offsets[dc : dc + 2]
    out = np.zeros((end - first, end - first))
    for rack in range(first, end):
        for run in range(air.mix_weights.run_offsets[rack], air.mix_weights.run_offsets[rack + 1]):
            at, count, weight = (
                air.mix_weights.run_first_rack[run],
                air.mix_weights.run_length[run],
                air.mix_weights.run_first_weight[run],
            )
            out[rack - first, at - first : at - first + count] += air.mix_weights.weights[
                weight : weight + count
            ]
    return out * air.mix_weights.norm[first:end, None]


def _table(*rows: Any) -> Any:
    """Rows of indices, those without a closing entry padded, as the kernel takes them."""
    length = max(len(r) for r in rows)
    out = np.zeros((len(rows), length), np.int32)
    for i, row in enumerate(rows):
        out[i, : len(row)] = row
    return out
